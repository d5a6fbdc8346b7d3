"""Furniture and small objects made of textured patches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rendering.config import Array, Rng, Size

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
    shape: str  # the solid that describes it: box | cylinder | ellipsoid
    parts: Sequence[Part]


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


def placed(parts: Iterable[Part], rotation: Array, offset: npt.ArrayLike = 0.0) -> list[Part]:
    """Parts that are turned, then shifted."""
    result = []
    for part in parts:
        frame = rotation @ part.obj_from_patch  # (3, 4)
        frame[:, 3] += np.asarray(offset, float)
        result.append(replace(part, obj_from_patch=frame))
    return result


# ---- Shapes ------------------------------------------------------------------------------------


def quad(
    origin: npt.ArrayLike, right: npt.ArrayLike, down: npt.ArrayLike, texture: str, **options: Any
) -> Part:
    """Parallelogram from its top left corner and two edges (m)."""
    a = np.asarray(right, float)
    b = np.asarray(down, float)
    into = np.cross(a, b)
    frame = np.column_stack([a, b, into / np.linalg.norm(into), origin])  # (3, 4)
    return Part(options.pop("kind", QUAD), frame, texture, **options)


def box(
    center: npt.ArrayLike,
    size: Sequence[float],
    texture: str,
    fitted: str = "",
    picture: str = "",
    rotation: Array | None = None,
) -> list[Part]:
    """Six quads with pieces of a texture.

    Args:
        fitted: faces that show a whole texture, of front (-y), back, left (-x), right, top, bottom.
        picture: that texture, `texture` by default.
    """
    x, y, z = (0.5 * float(v) for v in size)
    layout: dict[str, tuple[Sequence[float], Sequence[float], Sequence[float]]] = {
        "front": ((-x, -y, z), (2 * x, 0, 0), (0, 0, -2 * z)),
        "back": ((x, y, z), (-2 * x, 0, 0), (0, 0, -2 * z)),
        "left": ((-x, y, z), (0, -2 * y, 0), (0, 0, -2 * z)),
        "right": ((x, -y, z), (0, 2 * y, 0), (0, 0, -2 * z)),
        "top": ((-x, y, z), (2 * x, 0, 0), (0, -2 * y, 0)),
        "bottom": ((-x, -y, -z), (2 * x, 0, 0), (0, 2 * y, 0)),
    }
    parts = []
    for face, (origin, right, down) in layout.items():
        if face in fitted:
            parts.append(quad(origin, right, down, picture or texture))
        elif np.linalg.norm(down) > 1.5 * np.linalg.norm(right):  # the grain runs lengthwise
            turned = -np.array(right)
            parts.append(quad(np.add(origin, right), down, turned, texture, fit=False))
        else:
            parts.append(quad(origin, right, down, texture, fit=False))
    return placed(parts, np.eye(3) if rotation is None else rotation, center)


def frustum(base: Sequence[float], height: float, radii: tuple[float, float], texture: str) -> Part:
    """Lateral surface of a cone piece that stands on `base` (m)."""
    frame = np.column_stack([np.diag([1.0, 1.0, height]), base])  # (3, 4)
    return Part(FRUSTUM, frame, texture, radii=radii)


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
    return [
        frustum(base, height, radii, side),
        disc((x, y, z + height), radii[1], cap, fit=False),
        disc((x, y, z), radii[0], cap, up=False, fit=False),
    ]


def ball(
    center: Sequence[float], half_axes: Sequence[float], texture: str, rotation: Array | None = None
) -> Part:
    """An ellipsoid."""
    turn = np.eye(3) if rotation is None else rotation
    return Part(SPHERE, np.column_stack([turn * np.array(half_axes), center]), texture)


def stretched(model: Model, factors: npt.ArrayLike) -> Model:
    """The model with other proportions: (3,) factors along x, y, z."""
    parts = []
    for part in model.parts:
        frame = np.diag(np.asarray(factors, float)) @ part.obj_from_patch
        if part.kind in (QUAD, DISC):
            into = np.cross(frame[:, 0], frame[:, 1])
            frame[:, 2] = into / np.linalg.norm(into)
        parts.append(replace(part, obj_from_patch=frame))
    return replace(model, parts=parts)


# ---- Models ------------------------------------------------------------------------------------


def chair_model() -> Model:
    """Wooden chair: seat, cushion, four legs, back rest with slats."""
    parts = box((0, 0, 0.44), (0.43, 0.43, 0.035), "chair_wood")
    parts += box((0, -0.005, 0.478), (0.40, 0.39, 0.045), "chair_cloth", "top front")
    for x in (-0.195, 0.195):
        parts += box((x, -0.195, 0.212), (0.04, 0.04, 0.424), "chair_wood")
        parts += box((x, 0.205, 0.45), (0.04, 0.04, 0.90), "chair_wood")
    for z, height in ((0.84, 0.11), (0.69, 0.06), (0.58, 0.05)):
        parts += box((0, 0.205, z), (0.35, 0.024, height), "chair_wood")
    for y in (-0.195, 0.205):
        parts += box((0, y, 0.2), (0.35, 0.02, 0.03), "chair_wood")
    return Model("chair", "box", parts)


def office_chair_model() -> Model:
    """Swivel chair: five-armed foot, gas lift, padded seat and back."""
    parts = [frustum((0, 0, 0.1), 0.34, (0.03, 0.025), "plastic")]
    for turn in np.arange(5) * 2 * np.pi / 5:
        tip = (0.15 * np.sin(turn), -0.15 * np.cos(turn), 0.08)
        parts += box(tip, (0.05, 0.3, 0.04), "plastic", rotation=rotation_z(turn))
    faces = "top front back"
    parts += box((0, -0.02, 0.47), (0.48, 0.46, 0.08), "chair_cloth", faces)
    parts += box((0, 0.24, 0.56), (0.07, 0.04, 0.3), "plastic")
    back = rotation_x(-0.12)
    parts += box((0, 0.22, 0.84), (0.44, 0.07, 0.46), "chair_cloth", faces, rotation=back)
    for x in (-0.27, 0.27):
        parts += box((x, 0.02, 0.66), (0.05, 0.26, 0.03), "plastic")
        parts += box((x, 0.1, 0.57), (0.03, 0.04, 0.18), "plastic")
    return Model("chair", "box", parts)


def tub_chair_model() -> Model:
    """Low arm chair of one colour on a round plinth."""
    parts = upright((0, 0, 0), 0.22, (0.2, 0.24), "plastic", "plastic")
    parts += upright((0, 0, 0.22), 0.2, (0.3, 0.33), "chair_cloth", "chair_cloth")
    for turn in np.linspace(-1.9, 1.9, 9):
        spot = (0.3 * np.sin(turn), 0.3 * np.cos(turn), 0.55)
        parts += box(spot, (0.16, 0.08, 0.3), "chair_cloth", rotation=rotation_z(-turn))
    return Model("chair", "box", parts)


def table_model(size: Size, wood_name: str) -> Model:
    """Four-legged table with aprons."""
    w, d, h = size
    parts = box((0, 0, h - 0.02), (w, d, 0.04), wood_name, "top")
    for x in (-w / 2 + 0.06, w / 2 - 0.06):
        for y in (-d / 2 + 0.06, d / 2 - 0.06):
            parts += box((x, y, (h - 0.04) / 2), (0.07, 0.07, h - 0.04), wood_name)
    for y in (-d / 2 + 0.07, d / 2 - 0.07):
        parts += box((0, y, h - 0.08), (w - 0.2, 0.02, 0.08), wood_name)
    for x in (-w / 2 + 0.07, w / 2 - 0.07):
        parts += box((x, 0, h - 0.08), (0.02, d - 0.2, 0.08), wood_name)
    return Model("dining table", "box", parts)


def monitor_model() -> Model:
    """Screen on a foot."""
    parts = box((0, 0.02, 0.008), (0.24, 0.18, 0.016), "plastic")
    parts += box((0, 0.05, 0.13), (0.06, 0.03, 0.23), "plastic")
    parts += box((0, 0, 0.28), (0.56, 0.04, 0.34), "plastic")
    face = quad((-0.28, -0.021, 0.45), (0.56, 0, 0), (0, 0, -0.34), "screen", emission=0.55)
    return Model("tv", "box", [*parts, face])


def couch_model() -> Model:
    """Two-seater with arms, cushions and two pillows."""
    parts = box((0, 0.0, 0.16), (1.74, 0.86, 0.22), "couch")
    parts += box((0, 0.33, 0.47), (1.74, 0.20, 0.62), "couch")
    for x in (-0.79, 0.79):
        parts += box((x, -0.02, 0.36), (0.18, 0.84, 0.42), "couch")
    back = rotation_x(-0.15)
    for x in (-0.35, 0.35):
        parts += box((x, -0.08, 0.35), (0.68, 0.68, 0.17), "couch_cushion", "top front")
        parts += box((x, 0.19, 0.60), (0.66, 0.15, 0.36), "couch_cushion", "front", rotation=back)
    pillow = rotation_x(-0.35)
    parts += box((-0.48, 0.06, 0.60), (0.40, 0.12, 0.36), "pillow", "front", rotation=pillow)
    for x in (-0.78, 0.78):
        for y in (-0.36, 0.36):
            parts += box((x, y, 0.025), (0.06, 0.06, 0.05), "chair_wood")
    return Model("couch", "box", parts)


def plant_model(rng: Rng, height: float) -> Model:
    """Leaves (ellipses) around stems in a conical pot."""
    parts = upright((0, 0, 0), 0.30, (0.12, 0.16), "pot", "soil")
    for _ in range(64):
        turn = rng.uniform(0, 2 * np.pi)
        lift = rng.uniform(0, 1)
        reach = 0.05 + 0.27 * np.sin(np.pi * (0.15 + 0.75 * lift)) * rng.uniform(0.6, 1.0)
        heading = np.array([np.cos(turn), np.sin(turn)])
        center = np.append(reach * heading, 0.36 + (height - 0.45) * lift)
        droop = rng.uniform(-0.5, 0.9)
        along = np.append(heading * np.cos(droop), np.sin(droop))
        across = np.cross(along, rng.normal(0, 0.35, 3) + np.array([0.0, 0, 1]))
        along = along * rng.uniform(0.2, 0.32)
        across = across / np.linalg.norm(across) * rng.uniform(0.08, 0.12)
        texture = f"leaf{int(rng.integers(3))}"
        corner = center - along / 2 - across / 2
        parts.append(quad(corner, along, across, texture, kind=DISC, two_sided=True))
    for _ in range(6):
        turn = rng.uniform(0, 2 * np.pi)
        tip = (0.06 * np.cos(turn), 0.06 * np.sin(turn), height - 0.5)
        width = (0.012 * np.sin(turn), -0.012 * np.cos(turn), 0)
        parts.append(quad((0, 0, 0.3), tip, width, "leaf0", two_sided=True))
    return Model("potted plant", "cylinder", parts)


def bottle_model(texture: str) -> Model:
    """Body, shoulder, neck, cap."""
    parts = upright((0, 0, 0), 0.19, (0.038, 0.038), texture, "glass")
    parts.append(frustum((0, 0, 0.19), 0.05, (0.038, 0.015), "glass"))
    parts.append(frustum((0, 0, 0.24), 0.045, (0.015, 0.014), "glass"))
    parts += upright((0, 0, 0.285), 0.02, (0.017, 0.017), "cap", "cap")
    return Model("bottle", "cylinder", parts)


def cup_model() -> Model:
    """Mug with coffee and a handle."""
    parts = upright((0, 0, 0), 0.10, (0.038, 0.043), "cup", "china")[::2]
    parts.append(frustum((0, 0, 0.0), 0.1, (0.037, 0.042), "china"))
    parts.append(disc((0, 0, 0.085), 0.041, "soil", fit=False))
    for z in (0.075, 0.03):
        parts += box((0.052, 0, z), (0.026, 0.012, 0.012), "china")
    parts += box((0.066, 0, 0.0525), (0.012, 0.012, 0.057), "china")
    return Model("cup", "cylinder", parts)


def bowl_model(rng: Rng) -> Model:
    """Bowl heaped with oranges (all one object)."""
    parts = [
        frustum((0, 0, 0), 0.07, (0.07, 0.14), "china_blue"),
        disc((0, 0, 0.055), 0.125, "soil", fit=False),
    ]
    for turn in np.arange(5) * 2 * np.pi / 5:
        spot = (0.07 * np.cos(turn), 0.07 * np.sin(turn), 0.085)
        parts.append(ball(spot, (0.037,) * 3, "orange"))
    parts.append(ball((0, 0, 0.125), (0.037,) * 3, "orange", rotation_z(rng.uniform(0, 6))))
    return Model("bowl", "cylinder", parts)


def book_model(index: int, upright_book: bool) -> Model:
    """A book lying flat, or standing with its cover to the front."""
    cover = f"book{index}"
    parts = box((0, 0, 0.0175), (0.17, 0.24, 0.035), "paper", "top bottom", cover)
    parts += box((-0.087, 0, 0.0175), (0.004, 0.24, 0.036), cover)
    if upright_book:
        parts = placed(parts, rotation_x(np.pi / 2 - 0.18), (0, 0, 0.118))
    return Model("book", "box", parts)


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
    return Model("teddy bear", "ellipsoid", bear)


def small_models(rng: Rng) -> dict[str, Model]:
    """Objects for desks, shelves and corners."""
    laptop = box((0, 0, 0.01), (0.34, 0.24, 0.02), "alu", "top", "keys")
    lid = rotation_x(-0.3)
    laptop += box((0, 0.16, 0.12), (0.34, 0.01, 0.23), "alu", "front", "screen2", lid)
    vase = upright((0, 0, 0), 0.12, (0.05, 0.09), "vase", "soil")
    vase.append(frustum((0, 0, 0.12), 0.14, (0.09, 0.035), "vase"))
    vase.append(frustum((0, 0, 0.26), 0.04, (0.035, 0.05), "vase"))
    clock = [disc((0, 0, 0.04), 0.16, "clock"), frustum((0, 0, 0), 0.04, (0.16, 0.16), "plastic")]
    case = box((0, 0, 0.35), (0.42, 0.25, 0.56), "suitcase", "front back")
    for x in (-0.17, 0.17):
        case += upright((x, 0, 0), 0.07, (0.03, 0.03), "plastic", "plastic")
    case += box((0, 0.1, 0.68), (0.2, 0.02, 0.02), "plastic")
    for x in (-0.1, 0.1):
        case += box((x, 0.1, 0.655), (0.02, 0.02, 0.05), "plastic")
    keyboard = box((0, 0, 0.013), (0.44, 0.15, 0.026), "plastic", "top", "keys")
    football = ball((0, 0, 0.12), (0.12,) * 3, "ball", rotation_x(rng.uniform(0.4, 1.2)))
    return {
        "laptop": Model("laptop", "box", laptop),
        "keyboard": Model("keyboard", "box", keyboard),
        "mouse": Model("mouse", "ellipsoid", [ball((0, 0, 0.018), (0.033, 0.055, 0.018), "alu")]),
        "vase": Model("vase", "cylinder", vase),
        "clock": Model("clock", "box", placed(clock, rotation_x(np.pi / 2), (0, 0, 0.16))),
        "bear": bear_model(),
        "ball": Model("sports ball", "ellipsoid", [football]),
        "suitcase": Model("suitcase", "box", case),
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
