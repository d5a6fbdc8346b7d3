"""Floor plans: positions of furniture, wall pictures and clutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from rendering.config import Array, Rng, Size
from rendering.models import (
    Model,
    Part,
    Placement,
    box,
    chair_model,
    disc,
    frustum,
    office_chair_model,
    placed,
    quad,
    rotation_z,
    stretched,
    tub_chair_model,
    upright,
)
from rendering.surfaces import apply, part_bounds, patch_corners

LAMP_SPOTS = ((-1.4, -0.5), (1.5, 0.4))  # where the two ceiling panels hang (x, y in m)


# ---- Furniture with objects ----------------------------------------------------------------------


def dining_placements(rng: Rng, center: tuple[float, float]) -> list[Placement]:
    """Table in the middle, four chairs around it, objects on top."""
    x, y = center
    turn = float(rng.uniform(-0.12, 0.12))
    seats = [(-0.36, -0.72, np.pi), (0.38, -0.70, np.pi), (-0.37, 0.71, 0.0), (0.36, 0.73, 0.0)]
    tops = [
        ("bowl", 0.02, 0.03), ("cup", -0.5, -0.2), ("cup", 0.45, 0.22), ("bottle0", 0.27, -0.06),
        ("bottle1", -0.24, 0.2), ("cup", 0.52, -0.26), ("book0", -0.52, 0.16),
    ]  # fmt: skip

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


def desk_placements(rng: Rng, size: Size) -> list[Placement]:
    """Desk on the +x wall, screens facing the room, two chairs of the same kind as at the table."""
    x = size[0] / 2 - 0.40
    y = -0.55 + float(rng.uniform(-0.15, 0.15))
    z = 0.73
    face = -np.pi / 2  # the front looks along -x
    placements = [
        Placement("desk", (x, y, 0.0), face),
        Placement("monitor", (x + 0.1, y + 0.33, z), face + 0.18),
        Placement("monitor", (x + 0.1, y - 0.33, z), face - 0.18),
        Placement("keyboard", (x - 0.17, y + 0.1, z), face),
        Placement("mouse", (x - 0.16, y - 0.24, z), face),
        Placement("cup", (x - 0.2, y + 0.55, z), 1.0),
        Placement("bottle1", (x + 0.05, y - 0.72, z), 2.0),
        Placement("book1", (x - 0.12, y - 0.58, z), face + 0.4),
    ]
    for dy in (0.42, -0.40):
        nudge = rng.normal(0, [0.04, 0.04, 0.15])
        spot = (x - 0.72 + nudge[0], y + dy + nudge[1], 0.0)
        placements.append(Placement("chair", spot, face + np.pi + 0.25 * dy + nudge[2]))
    return placements


def lounge_placements(rng: Rng, size: Size) -> list[Placement]:
    """Couch on the +y wall, coffee table, plants, toys."""
    x = 0.55 + float(rng.uniform(-0.15, 0.15))
    y = size[1] / 2 - 0.5
    return [
        Placement("couch", (x, y, 0.0)),
        Placement("coffee", (x + 0.05, y - 1.0, 0.0), float(rng.uniform(-0.1, 0.1))),
        Placement("plant", (x + 1.35, y + 0.02, 0.0), 0.4),
        Placement("plant", (-size[0] / 2 + 0.5, y, 0.0), 2.2),
        Placement("bear", (x + 0.42, y - 0.16, 0.435), 0.25),
        Placement("ball", (x - 1.2, y - 0.35, 0.0)),
        Placement("laptop", (x - 0.12, y - 1.0, 0.42), 0.2),
        Placement("cup", (x + 0.33, y - 0.92, 0.42), 2.0),
        Placement("book2", (x + 0.3, y - 1.1, 0.42), 0.8),
        Placement("suitcase", (size[0] / 2 - 0.55, y - 0.1, 0.0), -0.5),
    ]


def home_plan(rng: Rng, size: Size) -> list[Placement]:
    """Dining table, desk, lounge and shelves, each at its own position; four cups."""
    x = -size[0] / 2 + 1.65 + float(rng.uniform(-0.1, 0.1))
    y = -0.95 + float(rng.uniform(-0.1, 0.1))
    dining = dining_placements(rng, (x, y))
    desk = desk_placements(rng, size)
    lounge = [p for p in lounge_placements(rng, size) if p.model != "cup"]
    shelf_x = -size[0] / 2 + 0.26  # on the sideboard of the -x wall
    shelf_y = size[1] / 2 - 1.75
    return [
        *dining,
        *desk,
        *lounge,
        Placement("vase", (shelf_x, shelf_y + 0.45, 0.8)),
        Placement("stood0", (shelf_x - 0.05, shelf_y + 0.05, 0.8), np.pi / 2),
        Placement("stood1", (shelf_x - 0.05, shelf_y - 0.2, 0.8), np.pi / 2),
        Placement("clock", (1.9, -size[1] / 2 + 0.03, 1.75), np.pi),
    ]


def later_plan(plan: list[Placement]) -> tuple[list[Placement], int]:
    """The home plan on another day: a chair and the bowl moved, a bottle is gone, a ball is new.

    Returns: the placements, in their order, new ones last; index of the one that is gone.
    """
    chair = 4
    bowl = 5
    bottle = 8
    later = list(plan)
    later[chair] = replace(plan[chair], position=(-2.75, -0.05, 0.0), yaw_rad=0.9)
    x, y, z = plan[bowl].position
    later[bowl] = replace(plan[bowl], position=(x - 0.29, y - 0.13, z))
    return [*later, Placement("ball", (-0.75, -1.5, 0.0))], bottle


# ---- Background ----------------------------------------------------------------------------------


def room_shell(size: Size) -> list[Part]:
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


def skirting(size: Size, order: str = "nsew", gap_m: float = 0.0) -> list[Part]:
    """Boards along the foot of the walls; those in the east and west are shorter by a gap."""
    w, d, _ = size
    boards = {
        "n": ((0, d / 2 - 0.01), (w, 0.02)),
        "s": ((0, 0.01 - d / 2), (w, 0.02)),
        "e": ((w / 2 - 0.01, 0), (0.02, d - gap_m)),
        "w": ((0.01 - w / 2, 0), (0.02, d - gap_m)),
    }
    return [
        part
        for center, extent in (boards[side] for side in order)
        for part in box((*center, 0.05), (*extent, 0.1), "white_wood")
    ]


PICTURES = {  # by wall: its turn from the north, and along, height, size of each picture, m
    "n": (0.0, [(-0.2, 1.55, 0.8, 0.6), (1.0, 1.6, 0.5, 0.7), (-1.75, 1.5, 0.9, 0.65),
                (2.35, 1.6, 0.7, 0.9)]),
    "e": (-np.pi / 2, [(-0.55, 1.75, 1.0, 0.6), (0.75, 1.5, 0.6, 0.85), (1.7, 1.6, 0.55, 0.55),
                       (-1.85, 1.5, 0.6, 0.8)]),
    "w": (np.pi / 2, [(0.95, 1.55, 0.8, 0.6), (1.9, 1.55, 0.5, 0.7)]),
    "s": (np.pi, [(-2.6, 1.6, 0.6, 0.8), (-1.7, 1.5, 0.7, 0.5)]),
}  # fmt: skip


def wall_pictures(size: Size, rng: Rng) -> list[Part]:
    """Framed posters on the four walls, at fixed positions with seeded shifts."""
    parts: list[Part] = []
    posters = 0
    for wall, (yaw, pictures) in PICTURES.items():
        across, axis = (size[1], 0) if wall in "ns" else (size[0], 1)
        turn = rotation_z(yaw)
        for along, z, width, height in pictures:
            shift = rng.uniform(-0.06, 0.06, 2)
            center = turn @ [0.0, across / 2 - 0.015, z + shift[1]]
            center[axis] += along + shift[0]
            poster = f"poster{posters}"
            parts += box(center, (width, 0.03, height), "plastic", "front", poster, turn)
            posters += 1
    return parts


def fixed_furniture(size: Size) -> list[Part]:
    """Bookcase, sideboard, rug, door, window: background, not objects to track."""
    w, d, h = size
    shelf = box((0, 0.14, 0.98), (1.3, 0.02, 1.96), "case_wood")
    for x in (-0.65, 0.65):
        shelf += box((x, 0, 0.98), (0.03, 0.3, 1.96), "case_wood")
    for row in range(6):
        shelf += box((0, 0, 0.03 + 0.38 * row), (1.3, 0.3, 0.03), "case_wood")
    for row in range(5):
        books = (0.02 * row - 0.04, 0.03, 0.19 + 0.38 * row)
        shelf += box(books, (1.18, 0.2, 0.28), "paper", "front", f"spines{row}")
    parts = placed(shelf, rotation_z(np.pi), (0.35, -d / 2 + 0.17, 0.0))
    side = box((0, 0, 0.4), (1.4, 0.45, 0.8), "side_wood", "front", "cabinet")
    parts += placed(side, rotation_z(np.pi / 2), (0.25 - w / 2, d / 2 - 1.75, 0.0))
    parts += box((0.55, d / 2 - 1.55, 0.006), (2.3, 1.5, 0.012), "rug", "top")
    door = box((0, 0, 1.02), (0.95, 0.05, 2.04), "white_wood", "front", "door")
    parts += placed(door, rotation_z(np.pi), (w / 2 - 0.75, -d / 2 + 0.025, 0.0))
    corner = (-w / 2 + 0.02, -1.75, 2.15)
    parts.append(quad(corner, (0, 1.7, 0), (0, 0, -1.25), "window", emission=1.5))
    parts += box((0.06 - w / 2, -0.9, 0.87), (0.16, 1.8, 0.04), "white_wood")
    parts += clutter(size)
    for x, y in LAMP_SPOTS:
        corner = (x - 0.4, y - 0.4, h - 0.01)
        parts.append(quad(corner, (0.8, 0, 0), (0, 0.8, 0), "lamp", emission=3.0))
    return parts


def clutter(size: Size) -> list[Part]:
    """Curtains, floor lamp, cartons, basket, wall board: they make the room distinctive."""
    w, d, _ = size
    parts: list[Part] = []
    for y in (-1.98, 0.18):
        for fold in range(5):
            base = (0.09 - w / 2, y - 0.16 + 0.08 * fold, 0.25)
            parts.append(frustum(base, 2.05, (0.05, 0.045), "curtain"))
    parts += box((0.09 - w / 2, -0.9, 2.32), (0.03, 2.7, 0.03), "case_wood")
    x = -0.95
    y = d / 2 - 0.4
    parts += upright((x, y, 0), 0.03, (0.15, 0.15), "plastic", "plastic")
    parts.append(frustum((x, y, 0.03), 1.45, (0.013, 0.013), "plastic"))
    parts.append(frustum((x, y, 1.45), 0.3, (0.2, 0.13), "shade"))
    for dx, dy, z, extent, yaw in (
        (0.3, 1.55, 0.17, (0.45, 0.38, 0.34), 0.15),
        (0.31, 1.53, 0.46, (0.34, 0.30, 0.24), -0.2),
    ):
        spot = (w / 2 - dx, -d / 2 + dy, z)
        parts += box(spot, extent, "carton", "left", rotation=rotation_z(yaw))
    parts.append(frustum((w / 2 - 0.3, 0.55, 0), 0.32, (0.12, 0.16), "basket"))
    parts.append(disc((w / 2 - 0.3, 0.55, 0.2), 0.14, "paper"))
    parts += box((-1.0, -d / 2 + 0.12, 1.35), (1.0, 0.22, 0.03), "side_wood")
    for i, (dx, name) in enumerate(
        ((-0.36, "pillow"), (-0.22, "couch"), (0.05, "carton"), (0.3, "basket"))
    ):
        extent = (0.1, 0.16, 0.2 + 0.03 * (i % 3)) if i < 2 else (0.2, 0.18, 0.16 + 0.05 * i)
        parts += box((-1.0 + dx, -d / 2 + 0.12, 1.365 + extent[2] / 2), extent, name, "back")
    return parts


def wall_objects(rng: Rng, size: Size) -> list[list[Part]]:
    """Pictures, boxes, boards and radiators along all walls: background that differs
    everywhere.
    """
    names = ["carton", "basket", "side_wood", "case_wood", "white_wood", "curtain", "plastic"]
    names += [f"poster{i}" for i in range(12)] + [f"spines{i}" for i in range(5)]
    boxes = []
    for _ in range(int(rng.integers(14, 34))):
        side = int(rng.integers(4))
        turn = rotation_z(side * np.pi / 2)
        reach, length = (size[1], size[0]) if side % 2 == 0 else (size[0], size[1])
        hung = rng.random() < 0.6
        extent = rng.uniform([0.12, 0.02, 0.15], [0.9, 0.06 if hung else 0.45, 0.9])
        z = rng.uniform(0.9, 2.0) if hung else extent[2] / 2
        along = rng.uniform(-0.5, 0.5) * (length - 1.0)
        center = turn @ [along, reach / 2 - extent[1] / 2 - 0.01, z]
        name = names[int(rng.integers(len(names)))]
        boxes.append(box(center, extent.tolist(), name, "front", rotation=turn))
    return boxes


def turned_furniture(size: Size, quarter: int) -> list[Part]:
    """Fixed furniture of a room that is turned by a number of right angles."""
    own = (size[1], size[0], size[2]) if quarter % 2 else size
    return placed(fixed_furniture(own), rotation_z(quarter * np.pi / 2))


# ---- Another plan for every seed -----------------------------------------------------------------


def turned(placements: Sequence[Placement], yaw_rad: float, x: float, y: float) -> list[Placement]:
    """Turn a group about the origin and move it there."""
    turn = rotation_z(yaw_rad)
    result = []
    for p in placements:
        px, py, pz = (turn @ np.asarray(p.position) + np.array([x, y, 0.0])).tolist()
        result.append(Placement(p.model, (px, py, pz), p.yaw_rad + yaw_rad))
    return result


def varied_group(rng: Rng, kind: int) -> list[Placement]:
    """A table with chairs (0), a desk (1) or a lounge (2) around the origin, some furniture
    missing.
    """
    if kind == 0:
        group = dining_placements(rng, (0.0, 0.0))
    elif kind == 1:
        group = turned(desk_placements(rng, (0.8, 0.0, 0.0)), 0.0, 0.35, 0.55)
    else:
        group = turned(lounge_placements(rng, (3.4, 1.0, 0.0)), 0.0, -0.55, 0.4)
        group = [placement for placement in group if placement.position[0] < 1.6]
    names = {"chair": "chair2"} if rng.random() < 0.3 else {}
    names |= {
        f"{kind}{i}": f"{kind}{rng.integers(2)}" for kind in ("bottle", "book") for i in (0, 1)
    }
    large = ("table", "desk", "couch", "coffee")
    return [
        replace(placement, model=names.get(placement.model, placement.model))
        for placement in group
        if placement.model in large or rng.random() < 0.8
    ]


def varied_plan(rng: Rng, size: Size) -> tuple[list[Placement], list[Part]]:
    """Groups on a jittered grid, each turned by its own right angle; furniture and pictures on
    walls of this seed's choice.
    """
    w, d, _ = size
    columns = max(int((w - 0.6) / 2.5), 1)
    rows = max(int((d - 0.6) / 2.3), 1)
    plan: list[Placement] = []
    for cell in rng.permutation(columns * rows)[: max(2, columns * rows - int(rng.integers(2)))]:
        x = (cell % columns + 0.5) / columns * (w - 0.8) - (w - 0.8) / 2
        y = (cell // columns + 0.5) / rows * (d - 0.8) - (d - 0.8) / 2
        yaw = float(rng.integers(4)) * np.pi / 2 + float(rng.normal(0, 0.08))
        jitter = rng.normal(0, 0.12, 2)
        group = varied_group(rng, int(rng.choice(3, p=[0.4, 0.4, 0.2])))
        plan += turned(group, yaw, x + jitter[0], y + jitter[1])
    fixed = turned_furniture(size, int(rng.integers(4)))
    inside = np.array([w / 2 - 0.3, d / 2 - 0.3])
    kept = [placement for placement in plan if (np.abs(placement.position[:2]) < inside).all()]
    return kept, fixed + [part for parts in wall_objects(rng, size) for part in parts]


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


# ---- A plan whose furniture does not touch: rooms of several sessions ----------------------------

AISLE_M = 0.75  # between groups of furniture
CLEARANCE_M = 0.3  # from a walker to furniture and walls
CELL_M = 0.1  # of the grid in which free floor is measured
GROUP_TRIES = 60


def overlap(first: Array, second: Array, margin: float) -> bool:
    """Is any of the (A, 4) rectangles closer than the margin to one of (B, 4), along x and y?"""
    a = first[:, None]
    apart = (a[..., :2] - margin >= second[..., 2:]) | (second[..., :2] >= a[..., 2:] + margin)
    return bool((~apart.any(-1)).any())


def rectangles(parts: Sequence[Part], low: float, high: float) -> Array:
    """(B, 4) x0, y0, x1, y1 of the parts that reach into a range of heights."""
    bounds = np.array([part_bounds(part) for part in parts])  # (N, 2, 3)
    inside = (bounds[:, 1, 2] > low) & (bounds[:, 0, 2] < high)
    return np.asarray(bounds[inside, :, :2].reshape(-1, 4))


def footprints(placements: Sequence[Placement], corners: dict[str, Array]) -> Array:
    """(N, 4) x0, y0, x1, y1 that hold each placed model."""
    prints = []
    for placement in placements:
        spread = corners[placement.model] @ rotation_z(placement.yaw_rad).T + placement.position
        prints.append([*spread[:, :2].min(0), *spread[:, :2].max(0)])
    return np.array(prints).reshape(-1, 4)


def free_share(size: Size, boxes: Array) -> float:
    """Share of the floor in the largest area that one can walk in, between rectangles (B, 4)."""
    columns, rows = (int(side / CELL_M) for side in size[:2])
    cells = np.meshgrid(*((np.arange(n) + 0.5 - n / 2) * CELL_M for n in (columns, rows)))
    points = np.stack(cells, -1)[:, :, None]  # (rows, columns, 1, 2)
    outside = np.maximum(np.maximum(boxes[:, :2] - points, points - boxes[:, 2:]), 0)
    distance = np.linalg.norm(outside, axis=-1).min(-1)  # (rows, columns)
    to_wall = (np.array(size[:2]) / 2 - np.abs(points)).min((2, 3))
    free = np.minimum(distance, to_wall) >= CLEARANCE_M
    _, labels = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    return float(np.bincount(labels.ravel())[1:].max(initial=0) / labels.size)


def group_spots(rng: Rng, size: Size, kind: int) -> list[tuple[float, Array]]:
    """Yaws and places (2,) to try for a group: desks and lounges first with their back to a wall,
    where the place is a point of that wall.
    """
    spots = []
    for number in range(GROUP_TRIES):
        quarter = int(rng.integers(4))
        yaw = quarter * np.pi / 2 + float(rng.normal(0, 0.03))
        place = rng.uniform(-0.5, 0.5, 2) * np.array(size[:2])
        if kind > 0 and number < 2 * GROUP_TRIES // 3:
            back = np.round(rotation_z(quarter * np.pi / 2)[:2, kind - 1])  # desk: +x, lounge: +y
            place = np.where(back == 0, place, back * np.array(size[:2]))
        spots.append((yaw, place))
    return spots


def free_group(
    rng: Rng, kind: int, corners: dict[str, Array], size: Size, fixed: Array, others: Array
) -> list[Placement]:
    """Place one group where it has room; nothing if no place was found.

    Args:
        corners: points (N, 3) around each model. fixed, others: rectangles (A, 4) of fixed
            furniture, and (B, 4) of other groups with their aisles.
    """
    half = np.array(size[:2]) / 2 - 0.09  # pictures hang behind the furniture
    group = varied_group(rng, kind)
    for yaw, place in group_spots(rng, size, kind):
        candidate = turned(group, yaw, 0.0, 0.0)
        prints = footprints(candidate, corners)
        # A place behind a wall means: as close to that wall as the group fits.
        low = -half - prints[:, :2].min(0)
        high = half - prints[:, 2:].max(0)
        at = np.clip(place, low, high)
        prints = prints + np.tile(at, 2)
        if (low <= high).all() and not (
            overlap(prints, fixed, 0.03) or overlap(prints, others, 0.0)
        ):
            return turned(candidate, 0.0, float(at[0]), float(at[1]))
    return []


def session_background(rng: Rng, size: Size) -> list[Part]:
    """Fixed furniture and objects on the walls that do not touch each other."""
    parts = turned_furniture(size, int(rng.choice([1, 3])))
    beside = rectangles(parts, 0.3, 3.0)
    for group in wall_objects(rng, size) + wall_objects(rng, size):
        taken = rectangles(group, 0.05, 3.0)
        if not overlap(taken, beside, 0.02):
            parts += group
            beside = np.concatenate([beside, taken])
    return parts + skirting(size, "swne", gap_m=0.18)


def session_plan(seed: int, models: dict[str, Model]) -> tuple[Size, list[Placement], list[Part]]:
    """Size, furniture and background of a room with space to walk in.

    Raises: ValueError if no plan leaves enough (never seen).
    """
    corners = {
        name: np.concatenate([apply(p.obj_from_patch, patch_corners(p)) for p in model.parts])
        for name, model in models.items()
    }
    for attempt in range(20):
        rng = np.random.default_rng([seed, 21, 0, attempt])
        w, d, h = rng.uniform((5.8, 5.0, 2.5), (7.6, 6.6, 2.9)).tolist()
        size = (w, d, h)
        fixed = session_background(rng, size)
        low = rectangles(fixed, 0.12, 0.9)
        others = np.empty((0, 4))
        placements: list[Placement] = []
        for kind in [*rng.permutation(3), int(rng.integers(2))]:
            group = free_group(rng, int(kind), corners, size, low, others)
            if group:
                prints = footprints(group, corners)
                whole = [*prints[:, :2].min(0) - AISLE_M, *prints[:, 2:].max(0) + AISLE_M]
                others = np.concatenate([others, [whole]])
                placements += group
        prints = footprints(placements, corners)
        boxes = np.concatenate([rectangles(fixed, 0.12, 1.8), prints])
        if len(others) >= 2 and free_share(size, boxes) > 0.2:
            return size, placements, fixed
    raise ValueError(f"seed {seed}: no plan leaves space to walk in")
