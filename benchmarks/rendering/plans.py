"""Floor plans: positions of furniture, wall pictures and clutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rendering.config import Rng, RoomConfig
from rendering.models import (
    Model,
    Part,
    Placement,
    box,
    chair_model,
    disc,
    frustum,
    moved,
    office_chair_model,
    quad,
    rotation_z,
    stretched,
    tub_chair_model,
    upright,
)


def dining_placements(config: RoomConfig, rng: Rng, center: tuple[float, float]) -> list[Placement]:
    """Table in the middle, up to four chairs around it, objects on top."""
    x, y = center
    turn = float(rng.uniform(-0.12, 0.12))
    seats = [(-0.36, -0.72, np.pi), (0.38, -0.70, np.pi), (-0.37, 0.71, 0.0), (0.36, 0.73, 0.0)]
    tops = [
        ("bowl", 0.02, 0.03),
        ("cup", -0.5, -0.2),
        ("cup", 0.45, 0.22),
        ("bottle0", 0.27, -0.06),
    ]
    tops += [("bottle1", -0.24, 0.2), ("cup", 0.52, -0.26), ("book0", -0.52, 0.16)]

    def place(model: str, dx: float, dy: float, z: float, yaw: float) -> Placement:
        px, py, _ = rotation_z(turn) @ [dx, dy, 0.0]
        return Placement(model, (x + float(px), y + float(py), z), turn + yaw)

    placements = [place("table", 0, 0, 0, 0)]
    for dx, dy, yaw in seats:
        nudge = rng.normal(0, [0.03, 0.03, 0.1])
        placements.append(place("chair", dx + nudge[0], dy + nudge[1], 0, yaw + nudge[2]))
    return placements + [
        place(name, dx, dy, 0.74, float(rng.uniform(0, 6))) for name, dx, dy in tops
    ]


def desk_placements(rng: Rng, size: tuple[float, float, float]) -> list[Placement]:
    """Desk on the +x wall, screens facing the room, two chairs of the same kind as at the table."""
    x = size[0] / 2 - 0.40
    y = -0.55 + float(rng.uniform(-0.15, 0.15))
    z = 0.73
    face = -np.pi / 2  # the front looks along -x
    placements = [Placement("desk", (x, y, 0.0), face)]
    placements += [
        Placement("monitor", (x + 0.1, y + dy, z), face + tilt)
        for dy, tilt in ((0.33, 0.18), (-0.33, -0.18))
    ]
    placements += [
        Placement("keyboard", (x - 0.17, y + 0.1, z), face),
        Placement("mouse", (x - 0.16, y - 0.24, z), face),
    ]
    placements += [
        Placement("cup", (x - 0.2, y + 0.55, z), 1.0),
        Placement("bottle1", (x + 0.05, y - 0.72, z), 2.0),
    ]
    placements += [Placement("book1", (x - 0.12, y - 0.58, z), face + 0.4)]
    for dy in (0.42, -0.40):
        nudge = rng.normal(0, [0.04, 0.04, 0.15])
        placements.append(
            Placement(
                "chair",
                (x - 0.72 + nudge[0], y + dy + nudge[1], 0.0),
                face + np.pi + 0.25 * dy + nudge[2],
            )
        )
    return placements


def lounge_placements(rng: Rng, size: tuple[float, float, float]) -> list[Placement]:
    """Couch on the +y wall, coffee table, plants, toys."""
    x = 0.55 + float(rng.uniform(-0.15, 0.15))
    y = size[1] / 2 - 0.5
    placements = [
        Placement("couch", (x, y, 0.0)),
        Placement("coffee", (x + 0.05, y - 1.0, 0.0), float(rng.uniform(-0.1, 0.1))),
    ]
    placements += [
        Placement("plant", (x + 1.35, y + 0.02, 0.0), 0.4),
        Placement("plant", (-size[0] / 2 + 0.5, y, 0.0), 2.2),
    ]
    placements += [
        Placement("bear", (x + 0.42, y - 0.16, 0.435), 0.25),
        Placement("ball", (x - 1.2, y - 0.35, 0.0)),
    ]
    placements += [
        Placement("laptop", (x - 0.12, y - 1.0, 0.42), 0.2),
        Placement("cup", (x + 0.33, y - 0.92, 0.42), 2.0),
    ]
    placements += [
        Placement("book2", (x + 0.3, y - 1.1, 0.42), 0.8),
        Placement("suitcase", (size[0] / 2 - 0.55, y - 0.1, 0.0), -0.5),
    ]
    return placements


def shelf_placements(size: tuple[float, float, float]) -> list[Placement]:
    """On the sideboard of the -x wall and on top of the bookcase of the -y wall."""
    x = -size[0] / 2 + 0.26
    y = size[1] / 2 - 1.75
    side = -np.pi / 2 + np.pi  # the front looks along +x
    placements = [
        Placement("vase", (x, y + 0.45, 0.8)),
        Placement("stood0", (x - 0.05, y + 0.05, 0.8), side),
    ]
    placements += [
        Placement("stood1", (x - 0.05, y - 0.2, 0.8), side),
        Placement("bottle0", (x + 0.03, y - 0.48, 0.8), 1.0),
    ]
    return [*placements, Placement("clock", (1.9, -size[1] / 2 + 0.03, 1.75), np.pi)]


def limit_placements(placements: list[Placement], config: RoomConfig) -> list[Placement]:
    """Keep at most the given number of each counted kind."""
    left = {
        "chair": config.chairs,
        "monitor": config.monitors,
        "cup": config.cups,
        "bottle": config.bottles,
    }
    left |= {"book": config.books, "plant": config.plants, "couch": int(config.couch)}
    extras = {"bowl", "laptop", "keyboard", "mouse", "vase", "clock", "bear", "ball", "suitcase"}
    kept = []
    for placement in placements:
        kind = placement.model.rstrip("0123456789").replace("stood", "book")
        if kind in left:
            left[kind] -= 1
        floats = kind == "bear" and not config.couch  # it sits on the couch
        if left.get(kind, 0) >= 0 and (config.extras or kind not in extras) and not floats:
            kept.append(placement)
    return kept


def room_shell(size: tuple[float, float, float]) -> list[Part]:
    """Walls, floor, ceiling (inward), without furniture."""
    w, d, h = size
    x = w / 2
    y = d / 2
    down = (0.0, 0.0, -h)
    return [
        quad((-x, y, h), (w, 0, 0), down, "wall_north"),
        quad((x, -y, h), (-w, 0, 0), down, "wall_south"),
        quad((x, y, h), (0, -d, 0), down, "wall_east"),
        quad((-x, -y, h), (0, d, 0), down, "wall_west"),
        quad((-x, y, 0), (w, 0, 0), (0, -d, 0), "floor"),
        quad((-x, -y, h), (w, 0, 0), (0, d, 0), "ceiling"),
    ]


def skirting(size: tuple[float, float, float]) -> list[Part]:
    """Boards along the foot of the walls."""
    w, d, _ = size
    parts = box((0, d / 2 - 0.01, 0.05), (w, 0.02, 0.1), "white_wood") + box(
        (0, 0.01 - d / 2, 0.05), (w, 0.02, 0.1), "white_wood"
    )
    return (
        parts
        + box((w / 2 - 0.01, 0, 0.05), (0.02, d, 0.1), "white_wood")
        + box((0.01 - w / 2, 0, 0.05), (0.02, d, 0.1), "white_wood")
    )


def wall_pictures(size: tuple[float, float, float], rng: Rng) -> list[Part]:
    """Framed posters on the four walls, at fixed positions with seeded shifts."""
    w, d, _ = size
    spots = [
        ("n", -0.2, 1.55, 0.8, 0.6),
        ("n", 1.0, 1.6, 0.5, 0.7),
        ("n", -1.75, 1.5, 0.9, 0.65),
        ("n", 2.35, 1.6, 0.7, 0.9),
    ]
    spots += [
        ("e", -0.55, 1.75, 1.0, 0.6),
        ("e", 0.75, 1.5, 0.6, 0.85),
        ("e", 1.7, 1.6, 0.55, 0.55),
        ("e", -1.85, 1.5, 0.6, 0.8),
    ]
    spots += [
        ("w", 0.95, 1.55, 0.8, 0.6),
        ("w", 1.9, 1.55, 0.5, 0.7),
        ("s", -2.6, 1.6, 0.6, 0.8),
        ("s", -1.7, 1.5, 0.7, 0.5),
    ]
    turns = {"n": 0.0, "e": -np.pi / 2, "s": np.pi, "w": np.pi / 2}
    parts: list[Part] = []
    for index, (wall, along, z, width, height) in enumerate(spots):
        reach = (d if wall in "ns" else w) / 2 - 0.015
        shift = rng.uniform(-0.06, 0.06, 2)
        center = rotation_z(turns[wall]) @ [0.0, reach, z + shift[1]]
        center += (np.array([1.0, 0, 0]) if wall in "ns" else np.array([0, 1.0, 0])) * (
            along + shift[0]
        )
        parts += box(
            center,
            (width, 0.03, height),
            "plastic",
            {"front": f"poster{index}"},
            rotation_z(turns[wall]),
        )
    return parts


def fixed_furniture(size: tuple[float, float, float]) -> list[Part]:
    """Bookcase, sideboard, rug, door, window: background, not objects to track."""
    w, d, h = size
    shelf: list[Part] = box((0, 0.14, 0.98), (1.3, 0.02, 1.96), "case_wood")
    for x in (-0.65, 0.65):
        shelf += box((x, 0, 0.98), (0.03, 0.3, 1.96), "case_wood")
    for row in range(6):
        shelf += box((0, 0, 0.03 + 0.38 * row), (1.3, 0.3, 0.03), "case_wood")
    for row in range(5):
        shelf += box(
            (0.02 * row - 0.04, 0.03, 0.19 + 0.38 * row),
            (1.18, 0.2, 0.28),
            "paper",
            {"front": f"spines{row}"},
        )
    position = np.array([0.35, -d / 2 + 0.17, 0.0])
    parts = [moved(part, rotation_z(np.pi), position) for part in shelf]
    side = box((0, 0, 0.4), (1.4, 0.45, 0.8), "side_wood", {"front": "cabinet"})
    parts += [
        moved(part, rotation_z(np.pi / 2), np.array([0.25 - w / 2, d / 2 - 1.75, 0.0]))
        for part in side
    ]
    parts += box((0.55, d / 2 - 1.55, 0.006), (2.3, 1.5, 0.012), "rug", {"top": "rug"})
    door = box((0, 0, 1.02), (0.95, 0.05, 2.04), "white_wood", {"front": "door"})
    parts += [
        moved(part, rotation_z(np.pi), np.array([w / 2 - 0.75, -d / 2 + 0.025, 0.0]))
        for part in door
    ]
    parts.append(
        quad((-w / 2 + 0.02, -1.75, 2.15), (0, 1.7, 0), (0, 0, -1.25), "window", emission=1.5)
    )
    parts += box((0.06 - w / 2, -0.9, 0.87), (0.16, 1.8, 0.04), "white_wood")
    parts += clutter(size)
    lamp = [
        quad((x - 0.4, y - 0.4, h - 0.01), (0.8, 0, 0), (0, 0.8, 0), "lamp", emission=3.0)
        for x, y in lamp_spots()
    ]
    return parts + lamp


def clutter(size: tuple[float, float, float]) -> list[Part]:
    """Curtains, floor lamp, cartons, basket, wall board: they make the room distinctive."""
    w, d, _ = size
    parts: list[Part] = []
    for y in (-1.98, 0.18):
        for fold in range(5):
            parts.append(
                frustum(
                    (0.09 - w / 2, y - 0.16 + 0.08 * fold, 0.25), 2.05, (0.05, 0.045), "curtain"
                )
            )
    parts += box((0.09 - w / 2, -0.9, 2.32), (0.03, 2.7, 0.03), "case_wood")
    x = -0.95
    y = d / 2 - 0.4
    parts += upright((x, y, 0), 0.03, (0.15, 0.15), "plastic", "plastic")
    parts += [
        frustum((x, y, 0.03), 1.45, (0.013, 0.013), "plastic"),
        frustum((x, y, 1.45), 0.3, (0.2, 0.13), "shade"),
    ]
    parts += box(
        (w / 2 - 0.3, -d / 2 + 1.55, 0.17),
        (0.45, 0.38, 0.34),
        "carton",
        {"left": "carton"},
        rotation_z(0.15),
    )
    parts += box(
        (w / 2 - 0.31, -d / 2 + 1.53, 0.46),
        (0.34, 0.30, 0.24),
        "carton",
        {"left": "carton"},
        rotation_z(-0.2),
    )
    parts += [
        frustum((w / 2 - 0.3, 0.55, 0), 0.32, (0.12, 0.16), "basket"),
        disc((w / 2 - 0.3, 0.55, 0.2), 0.14, "paper"),
    ]
    parts += box((-1.0, -d / 2 + 0.12, 1.35), (1.0, 0.22, 0.03), "side_wood")
    for i, dx in enumerate((-0.36, -0.22, 0.05, 0.3)):
        size_m = (0.1, 0.16, 0.2 + 0.03 * (i % 3)) if i < 2 else (0.2, 0.18, 0.16 + 0.05 * i)
        name = ("pillow", "couch", "carton", "basket")[i]
        parts += box(
            (-1.0 + dx, -d / 2 + 0.12, 1.365 + size_m[2] / 2), size_m, name, {"back": name}
        )
    return parts


def turned(placements: Sequence[Placement], yaw_rad: float, x: float, y: float) -> list[Placement]:
    """Turn a group about the origin and move it there."""
    turn = rotation_z(yaw_rad)
    at = np.array([x, y, 0.0])
    spots = [turn @ np.asarray(placement.position) + at for placement in placements]
    return [
        Placement(
            placement.model,
            (float(spot[0]), float(spot[1]), float(spot[2])),
            placement.yaw_rad + yaw_rad,
        )
        for placement, spot in zip(placements, spots, strict=True)
    ]


def varied_group(config: RoomConfig, rng: Rng, kind: int | None = None) -> list[Placement]:
    """A table with chairs (0), a desk (1) or a lounge (2) around the origin; some furniture
    missing; without a kind, a random one.
    """
    if kind is None:
        kind = int(rng.choice(3, p=[0.4, 0.4, 0.2]))
    if kind == 0:
        group = dining_placements(config, rng, (0.0, 0.0))
    elif kind == 1:
        group = turned(desk_placements(rng, (0.8, 0.0, 0.0)), 0.0, 0.35, 0.55)
    else:
        group = turned(lounge_placements(rng, (3.4, 1.0, 0.0)), 0.0, -0.55, 0.4)
        group = [placement for placement in group if placement.position[0] < 1.6]
    second = rng.random() < 0.3
    names = {"chair": "chair2"} if second else {}
    names |= {
        f"{kind}{i}": f"{kind}{rng.integers(2)}" for kind in ("bottle", "book") for i in (0, 1)
    }
    large = ("table", "desk", "couch", "coffee")
    return [
        replace(placement, model=names.get(placement.model, placement.model))
        for placement in group
        if placement.model in large or rng.random() < 0.8
    ]


def varied_plan(
    config: RoomConfig, rng: Rng, size: tuple[float, float, float]
) -> tuple[list[Placement], list[Part]]:
    """Groups on a jittered grid, each turned by its own right angle; furniture and pictures on
    walls of this seed's choice.
    """
    w, d, h = size
    columns = max(int((w - 0.6) / 2.5), 1)
    rows = max(int((d - 0.6) / 2.3), 1)
    plan: list[Placement] = []
    for cell in rng.permutation(columns * rows)[: max(2, columns * rows - int(rng.integers(2)))]:
        x = (cell % columns + 0.5) / columns * (w - 0.8) - (w - 0.8) / 2
        y = (cell // columns + 0.5) / rows * (d - 0.8) - (d - 0.8) / 2
        yaw = float(rng.integers(4)) * np.pi / 2 + float(rng.normal(0, 0.08))
        jitter = rng.normal(0, 0.12, 2)
        plan += turned(varied_group(config, rng), yaw, x + jitter[0], y + jitter[1])
    quarter = int(rng.integers(4))
    fixed = fixed_furniture((d, w, h) if quarter % 2 else size)
    parts = [moved(part, rotation_z(quarter * np.pi / 2), np.zeros(3)) for part in fixed]
    inside = np.array([w / 2 - 0.3, d / 2 - 0.3])
    kept = [placement for placement in plan if (np.abs(placement.position[:2]) < inside).all()]
    return kept, parts + wall_objects(rng, size)


def wall_objects(rng: Rng, size: tuple[float, float, float]) -> list[Part]:
    """Pictures, boxes, boards and radiators along all walls: background that differs
    everywhere.
    """
    names = ["carton", "basket", "side_wood", "case_wood", "white_wood", "curtain", "plastic"]
    names += [f"poster{i}" for i in range(12)] + [f"spines{i}" for i in range(5)]
    parts: list[Part] = []
    for _ in range(int(rng.integers(14, 34))):
        side = int(rng.integers(4))
        reach, length = (size[1], size[0]) if side % 2 == 0 else (size[0], size[1])
        hung = rng.random() < 0.6
        extent = rng.uniform([0.12, 0.02, 0.15], [0.9, 0.06 if hung else 0.45, 0.9])
        z = rng.uniform(0.9, 2.0) if hung else extent[2] / 2
        along = rng.uniform(-0.5, 0.5) * (length - 1.0)
        center = rotation_z(side * np.pi / 2) @ [along, reach / 2 - extent[1] / 2 - 0.01, z]
        name = names[int(rng.integers(len(names)))]
        faces = {"front": name}
        parts += box(center, extent.tolist(), name, faces, rotation_z(side * np.pi / 2))
    return parts


def varied_models(rng: Rng, models: dict[str, Model]) -> dict[str, Model]:
    """Other proportions for everything and two kinds of chairs."""
    chairs = [chair_model(), office_chair_model(), tub_chair_model()]
    first, second = rng.permutation(3)[:2]
    models = models | {"chair": chairs[first], "chair2": chairs[second]}
    return {
        name: stretched(model, rng.uniform(0.87, 1.15) * rng.uniform(0.93, 1.07, 3))
        if name not in ("table", "desk", "coffee")  # objects stand on them
        else stretched(model, (*rng.uniform(0.9, 1.2, 2), 1.0))
        for name, model in models.items()
    }


def lamp_spots() -> tuple[tuple[float, float], ...]:
    """Where the two ceiling panels hang (x, y in m)."""
    return ((-1.4, -0.5), (1.5, 0.4))
