"""Furniture and small objects made of textured patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rendering.config import Array, Rng

QUAD, DISC, SPHERE, FRUSTUM = range(4)


@dataclass(frozen=True, slots=True)
class Part:
    """One textured patch. Local coordinates (s, t) for flat parts, (x, y, z) for round ones.

    QUAD: origin + s a + t b with s, t in 0..1; a runs right, b down, a x b into the surface.
    DISC: the ellipse inscribed in that quad. SPHERE: |x, y, z| = 1.
    FRUSTUM: x^2 + y^2 = (r0 + (r1 - r0) z)^2, z in 0..1.
    """

    kind: int
    obj_from_patch: Array  # (3, 4) columns a, b, third axis, origin
    texture: str
    fit: bool = True  # whole texture over the patch; else a piece of it at its natural scale
    radii: tuple[float, float] = (0.0, 0.0)  # FRUSTUM, m at z = 0 and z = 1
    two_sided: bool = False
    emission: float = 0.0  # > 0: shines by itself, not lit


@dataclass(frozen=True, slots=True)
class Model:
    """A piece of furniture in its own frame: footprint around the origin, floor at z = 0."""

    class_name: str
    support: str  # the solid that describes it: box | cylinder | ellipsoid
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a model stands: its origin in world and its turn about z."""

    model: str
    position: tuple[float, float, float]
    yaw_rad: float = 0.0


def rotation_z(yaw_rad: float) -> Array:
    """(3, 3) rotation about z."""
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle_rad: float) -> Array:
    """(3, 3) rotation about x."""
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def quad(
    origin: npt.ArrayLike, right: npt.ArrayLike, down: npt.ArrayLike, texture: str, **options: Any
) -> Part:
    """Parallelogram from its top left corner and two edges (m)."""
    a = np.asarray(right, float)
    b = np.asarray(down, float)
    into = np.cross(a, b)
    frame = np.stack(
        [a, b, into / np.linalg.norm(into), np.asarray(origin, float)], axis=1
    )  # (3, 4)
    return Part(options.pop("kind", QUAD), frame, texture, **options)


def box(
    center: Sequence[float],
    size: Sequence[float],
    texture: str,
    faces: dict[str, str] | None = None,
    rotation: Array | None = None,
) -> list[Part]:
    """Six quads; `faces`: textures fitted to front (-y), back, left (-x), right, top, bottom."""
    hx, hy, hz = (0.5 * float(v) for v in size)
    layout: dict[str, tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]] = {
        "front": ((-hx, -hy, hz), (2 * hx, 0, 0), (0, 0, -2 * hz)),
        "back": ((hx, hy, hz), (-2 * hx, 0, 0), (0, 0, -2 * hz)),
        "left": ((-hx, hy, hz), (0, -2 * hy, 0), (0, 0, -2 * hz)),
        "right": ((hx, -hy, hz), (0, 2 * hy, 0), (0, 0, -2 * hz)),
        "top": ((-hx, hy, hz), (2 * hx, 0, 0), (0, -2 * hy, 0)),
        "bottom": ((-hx, -hy, -hz), (2 * hx, 0, 0), (0, 2 * hy, 0)),
    }
    own = faces or {}
    parts = []
    for face, (origin, right, down) in layout.items():
        if face not in own and np.linalg.norm(down) > 1.5 * np.linalg.norm(
            right
        ):  # grain lengthwise
            origin, right, down = np.add(origin, right), np.asarray(down), -np.asarray(right)
        parts.append(quad(origin, right, down, own.get(face, texture), fit=face in own))
    turn = np.eye(3) if rotation is None else rotation
    return [moved(part, turn, np.asarray(center, float)) for part in parts]


def moved(part: Part, rotation: Array, offset: Array) -> Part:
    """Turn, then shift a part."""
    frame = rotation @ part.obj_from_patch  # (3, 4)
    frame[:, 3] += offset
    return Part(part.kind, frame, part.texture, part.fit, part.radii, part.two_sided, part.emission)


def frustum(
    base: Sequence[float], height: float, radii: tuple[float, float], texture: str, **options: Any
) -> Part:
    """Lateral surface of a cone piece that stands on `base` (m)."""
    frame = np.concatenate([np.eye(3), np.asarray(base, float)[:, None]], axis=1)  # (3, 4)
    frame[:, 2] *= height
    return Part(FRUSTUM, frame, texture, radii=radii, **options)


def disc(
    center: Sequence[float], radius: float, texture: str, up: bool = True, **options: Any
) -> Part:
    """Horizontal circle, seen from above or from below."""
    x, y, z = center
    sign = 1.0 if up else -1.0
    corner = (x - radius, y + sign * radius, z)
    down = (0.0, -2 * sign * radius, 0.0)
    return quad(corner, (2 * radius, 0, 0), down, texture, kind=DISC, **options)


def upright(
    base: Sequence[float], height: float, radii: tuple[float, float], side: str, cap: str
) -> list[Part]:
    """A closed cylinder or cone piece."""
    x, y, z = base
    lids = [
        disc((x, y, z + height), radii[1], cap, fit=False),
        disc((x, y, z), radii[0], cap, up=False, fit=False),
    ]
    return [frustum(base, height, radii, side), *lids]


def ball(
    center: Sequence[float], half_axes: Sequence[float], texture: str, rotation: Array | None = None
) -> Part:
    """An ellipsoid."""
    axes = (
        np.diag(np.asarray(half_axes, float))
        if rotation is None
        else rotation * np.asarray(half_axes, float)
    )
    return Part(SPHERE, np.concatenate([axes, np.asarray(center, float)[:, None]], axis=1), texture)


def chair_model() -> Model:
    """Wooden chair: seat, cushion, four legs, back rest with slats."""
    parts = box((0, 0, 0.44), (0.43, 0.43, 0.035), "chair_wood")
    parts += box(
        (0, -0.005, 0.478),
        (0.40, 0.39, 0.045),
        "chair_cloth",
        {"top": "chair_cloth", "front": "chair_cloth"},
    )
    for x in (-0.195, 0.195):
        parts += box((x, -0.195, 0.212), (0.04, 0.04, 0.424), "chair_wood")
        parts += box((x, 0.205, 0.45), (0.04, 0.04, 0.90), "chair_wood")
    for z, height in ((0.84, 0.11), (0.69, 0.06), (0.58, 0.05)):
        parts += box((0, 0.205, z), (0.35, 0.024, height), "chair_wood")
    for y in (-0.195, 0.205):
        parts += box((0, y, 0.2), (0.35, 0.02, 0.03), "chair_wood")
    return Model("chair", "box", tuple(parts))


def office_chair_model() -> Model:
    """Swivel chair: five-armed foot, gas lift, padded seat and back."""
    parts = [frustum((0, 0, 0.1), 0.34, (0.03, 0.025), "plastic")]
    for turn in np.arange(5) * 2 * np.pi / 5:
        tip = (0.15 * float(np.sin(turn)), -0.15 * float(np.cos(turn)), 0.08)
        parts += box(tip, (0.05, 0.3, 0.04), "plastic", None, rotation_z(float(turn)))
    cloth = {side: "chair_cloth" for side in ("top", "front", "back")}
    parts += box((0, -0.02, 0.47), (0.48, 0.46, 0.08), "chair_cloth", cloth)
    parts += box((0, 0.24, 0.56), (0.07, 0.04, 0.3), "plastic")
    parts += box((0, 0.22, 0.84), (0.44, 0.07, 0.46), "chair_cloth", cloth, rotation_x(-0.12))
    for x in (-0.27, 0.27):
        parts += box((x, 0.02, 0.66), (0.05, 0.26, 0.03), "plastic")
        parts += box((x, 0.1, 0.57), (0.03, 0.04, 0.18), "plastic")
    return Model("chair", "box", tuple(parts))


def tub_chair_model() -> Model:
    """Low arm chair of one colour on a round plinth."""
    parts = upright((0, 0, 0), 0.22, (0.2, 0.24), "plastic", "plastic")
    parts += upright((0, 0, 0.22), 0.2, (0.3, 0.33), "chair_cloth", "chair_cloth")
    for turn in np.linspace(-1.9, 1.9, 9):
        spot = (0.3 * np.sin(turn), 0.3 * np.cos(turn), 0.55)
        parts += box(spot, (0.16, 0.08, 0.3), "chair_cloth", None, rotation_z(-float(turn)))
    return Model("chair", "box", tuple(parts))


def stretched(model: Model, factors: npt.ArrayLike) -> Model:
    """The model with other proportions: (3,) factors along x, y, z."""
    parts = []
    for part in model.parts:
        frame = np.diag(np.asarray(factors, float)) @ part.obj_from_patch
        if part.kind in (QUAD, DISC):
            into = np.cross(frame[:, 0], frame[:, 1])
            frame[:, 2] = into / np.linalg.norm(into)
        parts.append(replace(part, obj_from_patch=frame))
    return Model(model.class_name, model.support, tuple(parts))


def table_model(size: tuple[float, float, float], wood_name: str) -> Model:
    """Four-legged table with aprons."""
    w, d, h = size
    parts = box((0, 0, h - 0.02), (w, d, 0.04), wood_name, {"top": wood_name})
    for x in (-w / 2 + 0.06, w / 2 - 0.06):
        for y in (-d / 2 + 0.06, d / 2 - 0.06):
            parts += box((x, y, (h - 0.04) / 2), (0.07, 0.07, h - 0.04), wood_name)
    for y in (-d / 2 + 0.07, d / 2 - 0.07):
        parts += box((0, y, h - 0.08), (w - 0.2, 0.02, 0.08), wood_name)
    for x in (-w / 2 + 0.07, w / 2 - 0.07):
        parts += box((x, 0, h - 0.08), (0.02, d - 0.2, 0.08), wood_name)
    return Model("dining table", "box", tuple(parts))


def monitor_model() -> Model:
    """Screen on a foot."""
    parts = box((0, 0.02, 0.008), (0.24, 0.18, 0.016), "plastic")
    parts += box((0, 0.05, 0.13), (0.06, 0.03, 0.23), "plastic")
    parts += box((0, 0, 0.28), (0.56, 0.04, 0.34), "plastic")
    face = quad((-0.28, -0.021, 0.45), (0.56, 0, 0), (0, 0, -0.34), "screen", emission=0.55)
    return Model("tv", "box", (*parts, face))


def couch_model() -> Model:
    """Two-seater with arms, cushions and two pillows."""
    parts = box((0, 0.0, 0.16), (1.74, 0.86, 0.22), "couch")
    parts += box((0, 0.33, 0.47), (1.74, 0.20, 0.62), "couch")
    for x in (-0.79, 0.79):
        parts += box((x, -0.02, 0.36), (0.18, 0.84, 0.42), "couch")
    for x in (-0.35, 0.35):
        cloth = {"top": "couch_cushion", "front": "couch_cushion"}
        parts += box((x, -0.08, 0.35), (0.68, 0.68, 0.17), "couch_cushion", cloth)
        parts += box(
            (x, 0.19, 0.60),
            (0.66, 0.15, 0.36),
            "couch_cushion",
            {"front": "couch_cushion"},
            rotation_x(-0.15),
        )
    parts += box(
        (-0.48, 0.06, 0.60), (0.40, 0.12, 0.36), "pillow", {"front": "pillow"}, rotation_x(-0.35)
    )
    for x in (-0.78, 0.78):
        for y in (-0.36, 0.36):
            parts += box((x, y, 0.025), (0.06, 0.06, 0.05), "chair_wood")
    return Model("couch", "box", tuple(parts))


def plant_model(rng: Rng, height: float) -> Model:
    """Leaves (ellipses) around stems in a conical pot."""
    parts = upright((0, 0, 0), 0.30, (0.12, 0.16), "pot", "soil")
    for _ in range(64):
        turn = rng.uniform(0, 2 * np.pi)
        lift = rng.uniform(0, 1)
        reach = 0.05 + 0.27 * np.sin(np.pi * (0.15 + 0.75 * lift)) * rng.uniform(0.6, 1.0)
        center = np.array(
            [reach * np.cos(turn), reach * np.sin(turn), 0.36 + (height - 0.45) * lift]
        )
        droop = rng.uniform(-0.5, 0.9)
        along = np.array(
            [np.cos(turn) * np.cos(droop), np.sin(turn) * np.cos(droop), np.sin(droop)]
        )
        across = np.cross(along, rng.normal(0, 0.35, 3) + np.array([0.0, 0, 1]))
        along, across = (
            along * rng.uniform(0.2, 0.32),
            across / np.linalg.norm(across) * rng.uniform(0.08, 0.12),
        )
        texture = f"leaf{int(rng.integers(3))}"
        parts.append(
            quad(center - along / 2 - across / 2, along, across, texture, kind=DISC, two_sided=True)
        )
    for _ in range(6):
        turn = rng.uniform(0, 2 * np.pi)
        tip = np.array([0.06 * np.cos(turn), 0.06 * np.sin(turn), height - 0.5])
        parts.append(
            quad(
                (0, 0, 0.3),
                tip,
                (0.012 * np.sin(turn), -0.012 * np.cos(turn), 0),
                "leaf0",
                two_sided=True,
            )
        )
    return Model("potted plant", "cylinder", tuple(parts))


def bottle_model(texture: str) -> Model:
    """Body, shoulder, neck, cap."""
    parts = upright((0, 0, 0), 0.19, (0.038, 0.038), texture, "glass")
    parts.append(frustum((0, 0, 0.19), 0.05, (0.038, 0.015), "glass"))
    parts.append(frustum((0, 0, 0.24), 0.045, (0.015, 0.014), "glass"))
    parts += upright((0, 0, 0.285), 0.02, (0.017, 0.017), "cap", "cap")
    return Model("bottle", "cylinder", tuple(parts))


def cup_model() -> Model:
    """Mug with coffee and a handle."""
    parts = upright((0, 0, 0), 0.10, (0.038, 0.043), "cup", "china")[::2]
    parts.append(frustum((0, 0, 0.0), 0.1, (0.037, 0.042), "china"))
    parts.append(disc((0, 0, 0.085), 0.041, "soil", fit=False))
    for x, z, size in ((0.052, 0.075, (0.026, 0.012, 0.012)), (0.052, 0.03, (0.026, 0.012, 0.012))):
        parts += box((x, 0, z), size, "china")
    parts += box((0.066, 0, 0.0525), (0.012, 0.012, 0.057), "china")
    return Model("cup", "cylinder", tuple(parts))


def bowl_model(rng: Rng) -> Model:
    """Bowl heaped with oranges (all one object)."""
    parts = [
        frustum((0, 0, 0), 0.07, (0.07, 0.14), "china_blue"),
        disc((0, 0, 0.055), 0.125, "soil", fit=False),
    ]
    for turn in np.arange(5) * 2 * np.pi / 5:
        parts.append(
            ball((0.07 * np.cos(turn), 0.07 * np.sin(turn), 0.085), (0.037,) * 3, "orange")
        )
    parts.append(
        ball((0.0, 0.0, 0.125), (0.037,) * 3, "orange", rotation_z(float(rng.uniform(0, 6))))
    )
    return Model("bowl", "cylinder", tuple(parts))


def book_model(index: int, upright_book: bool) -> Model:
    """A book lying flat, or standing with its cover to the front."""
    faces = {"top": f"book{index}", "bottom": f"book{index}"}
    parts = box((0, 0, 0.0175), (0.17, 0.24, 0.035), "paper", faces)
    parts += box((-0.087, 0, 0.0175), (0.004, 0.24, 0.036), f"book{index}")
    if upright_book:
        stand = rotation_x(np.pi / 2 - 0.18)
        parts = [moved(part, stand, np.array([0, 0, 0.118])) for part in parts]
    return Model("book", "box", tuple(parts))


def bear_model() -> Model:
    """Teddy bear of ellipsoids, sitting."""
    bear = [
        ball((0, 0, 0.13), (0.11, 0.095, 0.13), "bear"),
        ball((0, -0.02, 0.31), (0.09, 0.08, 0.08), "bear"),
    ]
    bear += [ball((x, 0, 0.385), (0.032, 0.018, 0.032), "bear") for x in (-0.065, 0.065)]
    bear += [ball((x, -0.08, 0.19), (0.035, 0.07, 0.035), "bear") for x in (-0.1, 0.1)]
    bear += [ball((x, -0.12, 0.045), (0.045, 0.085, 0.045), "bear") for x in (-0.07, 0.07)]
    bear += [
        ball((0, -0.095, 0.29), (0.035, 0.025, 0.026), "bear_snout"),
        ball((0, -0.122, 0.3), (0.012, 0.01, 0.008), "plastic"),
    ]
    bear += [ball((x, -0.088, 0.335), (0.009, 0.008, 0.009), "plastic") for x in (-0.035, 0.035)]
    return Model("teddy bear", "ellipsoid", tuple(bear))


def small_models(rng: Rng) -> dict[str, Model]:
    """Objects for desks, shelves and corners."""
    laptop = box((0, 0, 0.01), (0.34, 0.24, 0.02), "alu", {"top": "keys"})
    laptop += box(
        (0, 0.16, 0.12), (0.34, 0.01, 0.23), "alu", {"front": "screen2"}, rotation_x(-0.3)
    )
    vase = upright((0, 0, 0), 0.12, (0.05, 0.09), "vase", "soil")
    vase.append(frustum((0, 0, 0.12), 0.14, (0.09, 0.035), "vase"))
    vase.append(frustum((0, 0, 0.26), 0.04, (0.035, 0.05), "vase"))
    clock = [disc((0, 0, 0.04), 0.16, "clock"), frustum((0, 0, 0), 0.04, (0.16, 0.16), "plastic")]
    hang = rotation_x(np.pi / 2)
    case = box(
        (0, 0, 0.35), (0.42, 0.25, 0.56), "suitcase", {"front": "suitcase", "back": "suitcase"}
    )
    case += [
        p
        for x in (-0.17, 0.17)
        for p in upright((x, 0, 0), 0.07, (0.03, 0.03), "plastic", "plastic")
    ]
    case += box((0, 0.1, 0.68), (0.2, 0.02, 0.02), "plastic")
    case += [p for x in (-0.1, 0.1) for p in box((x, 0.1, 0.655), (0.02, 0.02, 0.05), "plastic")]
    return {
        "laptop": Model("laptop", "box", tuple(laptop)),
        "keyboard": Model(
            "keyboard",
            "box",
            tuple(box((0, 0, 0.013), (0.44, 0.15, 0.026), "plastic", {"top": "keys"})),
        ),
        "mouse": Model("mouse", "ellipsoid", (ball((0, 0, 0.018), (0.033, 0.055, 0.018), "alu"),)),
        "vase": Model("vase", "cylinder", tuple(vase)),
        "clock": Model(
            "clock", "box", tuple(moved(p, hang, np.array([0.0, 0.0, 0.16])) for p in clock)
        ),
        "bear": bear_model(),
        "ball": Model(
            "sports ball",
            "ellipsoid",
            (ball((0, 0, 0.12), (0.12,) * 3, "ball", rotation_x(float(rng.uniform(0.4, 1.2)))),),
        ),
        "suitcase": Model("suitcase", "box", tuple(case)),
        "bowl": bowl_model(rng),
    }


def furniture_models(rng: Rng) -> dict[str, Model]:
    """Every model that a plan may place."""
    models = {
        "chair": chair_model(),
        "table": table_model((1.5, 0.9, 0.74), "table_wood"),
        "desk": table_model((1.6, 0.7, 0.73), "desk_wood"),
        "coffee": table_model((0.9, 0.5, 0.42), "desk_wood"),
        "monitor": monitor_model(),
        "couch": couch_model(),
        "plant": plant_model(rng, 1.25),
        "cup": cup_model(),
        "bottle0": bottle_model("bottle0"),
        "bottle1": bottle_model("bottle1"),
    }
    models |= {f"book{i}": book_model(i, upright_book=False) for i in range(3)}
    models |= {f"stood{i}": book_model(i, upright_book=True) for i in range(3)}
    return models | small_models(rng)
