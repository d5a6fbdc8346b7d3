"""A flat: furnished rooms in a row along x, joined by door openings, in one world frame.

The world frame is that of the first room: origin in the middle of its floor, z up, metres. Every
room has its own plan, furniture and textures; the models in SHARED look the same in all rooms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rendering.config import Array, Color, Image, Rng, RoomConfig
from rendering.light import DEFAULT_LIGHTING, Lighting, bake_light
from rendering.models import Model, Part, Placement, box, furniture_models, moved, quad, rotation_z
from rendering.plans import (
    fixed_furniture,
    room_shell,
    turned,
    varied_group,
    varied_models,
    wall_objects,
)
from rendering.surfaces import (
    Room,
    RoomObject,
    apply,
    build_surfaces,
    patch_corners,
    place_object,
    texture_window,
)
from rendering.texture_set import make_textures, pale_color, varied_textures
from rendering.textures import bricks, fabric, planks, plaster, wallpaper, wood

SHARED = frozenset({"chair", "monitor", "keyboard", "mouse", "cup", "bottle0", "book0", "plant"})
WALL_M = 0.16  # thickness of the wall between two rooms
DOOR_M = (0.98, 2.06)  # width and height of a door opening
ZONE_M = (1.2, 0.7)  # kept free on both sides of an opening: depth, half width
AISLE_M = 0.75  # between groups of furniture
REACH_M = (0.12, 1.8)  # what is between these heights stands in a walker's way
ENTRY_M = 0.85  # the path crosses a wall in a straight line from this distance to this distance
CLEARANCE_M = 0.3  # from the planned path to furniture and walls
CELL_M = 0.1  # of the grids in which paths are planned
PLAN_TRIES = 60


ATLAS_LIMIT = 32767  # OpenCV's remap refuses larger images

Walls = dict[int, float]  # y of the middle of the door opening, by side: -1 west, 1 east


@dataclass(frozen=True, slots=True)
class RoomPlan:
    """One room in its own frame: origin in the middle of the floor."""

    size_m: tuple[float, float, float]
    doors: Walls
    placements: tuple[Placement, ...]
    fixed: tuple[Part, ...]
    boxes: Array  # (B, 4) x0, y0, x1, y1 of furniture and walls at walking height


def box_distances(points: Array, boxes: Array) -> Array:
    """(P,) distance in m of points (P, 2) to the nearest of (B, 4) rectangles, 0 inside."""
    low = boxes[None, :, :2] - points[:, None]  # (P, B, 2)
    high = points[:, None] - boxes[None, :, 2:]
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(low, high), 0), axis=2).min(1))


def overlap(first: Array, second: Array, margin: float) -> bool:
    """Is any of the (A, 4) rectangles closer than the margin to one of (B, 4), along x and y?"""
    a = first[:, None]
    b = second[None]
    apart = (a[..., :2] - margin >= b[..., 2:]) | (b[..., :2] >= a[..., 2:] + margin)
    return bool((~apart.any(-1)).any())


def part_bounds(part: Part) -> Array:
    """(2, 3) lowest and highest corner of a part."""
    corners = apply(part.obj_from_patch, patch_corners(part))
    return np.stack([corners.min(0), corners.max(0)])


def touching_groups(parts: Sequence[Part]) -> list[list[int]]:
    """Indices of parts, grouped by whether their bounding boxes touch (to 2 cm), directly or
    through other parts: the boards of one shelf stay together.
    """
    bounds = np.stack([part_bounds(part) for part in parts])  # (N, 2, 3)
    apart = np.asarray((bounds[:, None, 0] > bounds[None, :, 1] + 0.02).any(-1))
    touch = np.logical_not(apart | apart.T)
    left = set(range(len(parts)))
    groups = []
    while left:
        group = {left.pop()}
        fresh = set(group)
        while fresh:
            fresh = {j for i in fresh for j in np.nonzero(touch[i])[0].tolist()} - group
            group |= fresh
        left -= group
        groups.append(sorted(group))
    return groups


def rectangles(parts: Sequence[Part], heights: tuple[float, float] = REACH_M) -> Array:
    """(B, 4) x0, y0, x1, y1 of the parts that reach into a range of heights."""
    bounds = np.array([part_bounds(part) for part in parts]).reshape(-1, 2, 3)
    inside = (bounds[:, 1, 2] > heights[0]) & (bounds[:, 0, 2] < heights[1])
    return np.concatenate([bounds[inside, 0, :2], bounds[inside, 1, :2]], 1)


def door_zones(size: tuple[float, float, float], doors: Walls) -> Array:
    """(D, 4) floor in front of the openings."""
    zones = []
    for side, y in doors.items():
        wall = side * size[0] / 2
        inner = wall - side * ZONE_M[0]
        zones.append([min(wall, inner), y - ZONE_M[1], max(wall, inner), y + ZONE_M[1]])
    return np.array(zones).reshape(-1, 4)


def wall_runs(size: tuple[float, float, float], doors: Walls, side: int) -> list[list[float]]:
    """[y0, y1] of the pieces of the west (-1) or east (1) wall beside the opening."""
    half = size[1] / 2
    if side not in doors:
        return [[-half, half]]
    return [[-half, doors[side] - DOOR_M[0] / 2], [doors[side] + DOOR_M[0] / 2, half]]


def wall_boxes(size: tuple[float, float, float], doors: Walls) -> Array:
    """(B, 4) the walls of a room, each half of its thickness outside the room."""
    x = size[0] / 2
    y = size[1] / 2
    thick = WALL_M / 2
    boxes = [[-x, y, x, y + thick], [-x, -y - thick, x, -y]]
    boxes += [[x, y0, x + thick, y1] for y0, y1 in wall_runs(size, doors, 1)]
    boxes += [[-x - thick, y0, -x, y1] for y0, y1 in wall_runs(size, doors, -1)]
    return np.array(boxes)


def shell_with_doors(
    size: tuple[float, float, float], doors: Walls
) -> list[tuple[Part, tuple[float, float, float, float]]]:
    """Walls, floor and ceiling, each with the piece of its texture: s0, t0, s1, t1 in 0..1."""
    pieces = []
    top = 1 - DOOR_M[1] / size[2]
    for part in room_shell(size):
        side = {"wall_east": 1, "wall_west": -1}.get(part.texture, 0)
        if side not in doors:
            pieces.append((part, (0.0, 0.0, 1.0, 1.0)))
            continue
        middle = 0.5 - side * doors[side] / size[1]  # of the opening, along s
        half = DOOR_M[0] / 2 / size[1]
        for s0, s1, t1 in (
            (0.0, middle - half, 1.0),
            (middle - half, middle + half, top),
            (middle + half, 1.0, 1.0),
        ):
            frame = part.obj_from_patch.copy()
            frame[:, 3] += s0 * frame[:, 0]
            frame[:, 0] *= s1 - s0
            frame[:, 1] *= t1
            pieces.append((replace(part, obj_from_patch=frame), (s0, 0.0, s1, t1)))
    return pieces


def door_parts(size: tuple[float, float, float], side: int, y: float) -> list[Part]:
    """Lining of this room's half of the wall, threshold, frame and two posters beside it."""
    wide, high = DOOR_M
    thick = WALL_M / 2
    x = side * size[0] / 2
    low = min(x, x + side * thick)
    north = y + wide / 2
    south = y - wide / 2
    parts = [
        quad((low, north, high), (thick, 0, 0), (0, 0, -high), "case_wood", fit=False),
        quad((low + thick, south, high), (-thick, 0, 0), (0, 0, -high), "case_wood", fit=False),
        quad((low, south, high), (thick, 0, 0), (0, wide, 0), "case_wood", fit=False),
        quad((low, north, 0), (thick, 0, 0), (0, -wide, 0), "side_wood", fit=False),
    ]
    inner = x - side * 0.01
    for edge in (south - 0.045, north + 0.045):
        parts += box((inner, edge, high / 2), (0.02, 0.09, high), "case_wood")
    parts += box((inner, y, high + 0.045), (0.02, wide + 0.18, 0.09), "case_wood")
    turn = rotation_z(-side * np.pi / 2)
    for number, away in enumerate((-1, 1)):
        if abs(y + away * 0.95) < size[1] / 2 - 0.3:
            name = f"poster{(2 + side + 5 * number) % 12}"
            center = (x - side * 0.015, y + away * (0.95), 1.5)
            parts += box(center, (0.5, 0.03, 0.66), "plastic", {"front": name}, turn)
    return parts


def skirting_with_doors(size: tuple[float, float, float], doors: Walls) -> list[Part]:
    """Boards along the foot of the walls, open at the doors."""
    w, d, _ = size
    parts: list[Part] = []
    for side in (-1, 1):
        parts += box((0, side * (d / 2 - 0.01), 0.05), (w, 0.02, 0.1), "white_wood")
        for y0, y1 in wall_runs(size, doors, side):
            length = y1 - y0 - 0.18  # the door's frame stands beside the opening
            middle = (y0 + y1) / 2
            parts += box((side * (w / 2 - 0.01), middle, 0.05), (0.02, length, 0.1), "white_wood")
    return parts


def fixed_parts(rng: Rng, size: tuple[float, float, float], doors: Walls) -> list[Part]:
    """Background furniture and objects on the walls, none of them in front of an opening."""
    quarter = int(rng.choice([1, 3]))  # the window is in the north or south wall: a wall outside
    turn = rotation_z(quarter * np.pi / 2)
    candidates = [moved(p, turn, np.zeros(3)) for p in fixed_furniture((size[1], size[0], size[2]))]
    openings = [part for side, y in doors.items() for part in door_parts(size, side, y)]
    kept = list(openings)
    zones = door_zones(size, doors)
    for group in touching_groups(candidates):
        parts = [candidates[i] for i in group]
        high = DOOR_M[1] + 0.2
        if not overlap(rectangles(parts, (0.05, high)), zones, 0.0):
            kept += parts
    beside = rectangles(kept, (0.3, 3.0))
    for _ in range(2):
        on_walls = wall_objects(rng, size)
        for first in range(0, len(on_walls), 6):  # boxes of six quads
            parts = on_walls[first : first + 6]
            taken = rectangles(parts, (0.05, 3.0))
            if not (overlap(taken, zones, 0.0) or overlap(taken, beside, 0.02)):
                kept += parts
                beside = np.concatenate([beside, taken])
    return kept + skirting_with_doors(size, doors)


def model_corners(models: dict[str, Model]) -> dict[str, Array]:
    """By name: corners (N, 3) of the boxes around all parts of a model, in its own frame."""
    return {
        name: np.concatenate([apply(p.obj_from_patch, patch_corners(p)) for p in model.parts])
        for name, model in models.items()
    }


def footprints(placements: Sequence[Placement], corners: dict[str, Array]) -> Array:
    """(N, 4) x0, y0, x1, y1 that hold each placed model."""
    prints = []
    for placement in placements:
        spread = corners[placement.model] @ rotation_z(placement.yaw_rad).T + placement.position
        prints.append([*spread[:, :2].min(0), *spread[:, :2].max(0)])
    return np.array(prints).reshape(-1, 4)


def grid_points(size: tuple[float, float, float]) -> tuple[Array, tuple[int, int]]:
    """Middles (P, 2) of the cells of a room's floor, in its frame, and the grid's columns, rows."""
    columns = int(size[0] / CELL_M)
    rows = int(size[1] / CELL_M)
    x = (np.arange(columns) + 0.5 - columns / 2) * CELL_M
    y = (np.arange(rows) + 0.5 - rows / 2) * CELL_M
    u, v = np.meshgrid(x, y)
    return np.stack([u.ravel(), v.ravel()], 1), (columns, rows)


def reachable(size: tuple[float, float, float], boxes: Array, doors: Walls) -> Array:
    """(rows, columns) distance in m to furniture and walls of the cells that can be walked to from
    the first door; 0 elsewhere, and everywhere if another door cannot be reached. Without doors,
    the cells of the largest connected free area.
    """
    points, (columns, rows) = grid_points(size)
    distance = box_distances(points, boxes).reshape(rows, columns)
    free = (distance >= CLEARANCE_M).astype(np.uint8)
    _, labels = cv2.connectedComponents(free, connectivity=4)
    areas = np.bincount(labels.ravel())[1:]  # label 0 is not free
    found = set() if doors or not len(areas) else {int(areas.argmax()) + 1}
    for side, y in doors.items():
        spot = (side * (size[0] / 2 - ENTRY_M), y)
        nearest = int(np.linalg.norm(points - spot, axis=1).argmin())
        found.add(int(labels.ravel()[nearest]))
    if len(found) != 1 or 0 in found:
        return np.zeros((rows, columns))
    return np.asarray(np.where(labels == found.pop(), distance, 0.0))


def group_spots(
    rng: Rng, size: tuple[float, float, float], kind: int, count: int
) -> list[tuple[float, Array]]:
    """Yaws and places (2,) to try for a group: desks and lounges first with their back to a wall,
    where the place is a point of that wall.
    """
    spots = []
    for number in range(count):
        quarter = int(rng.integers(4))
        yaw = quarter * np.pi / 2 + float(rng.normal(0, 0.03))
        place = rng.uniform(-0.5, 0.5, 2) * np.array(size[:2])
        if kind > 0 and number < 2 * count // 3:
            back = np.round(rotation_z(quarter * np.pi / 2)[:2, kind - 1])  # desk: +x, lounge: +y
            place = np.where(back == 0, place, back * np.array(size[:2]))
        spots.append((yaw, place))
    return spots


def furnish_group(
    config: RoomConfig,
    rng: Rng,
    kind: int,
    corners: dict[str, Array],
    size: tuple[float, float, float],
    taken: tuple[Array, Array],
) -> list[Placement]:
    """Place one group where it has room; nothing if no place was found.

    Args:
        corners: of `model_corners`.
        taken: rectangles (A, 4) of fixed furniture, and (B, 4) of other groups and door zones.
    """
    fixed, others = taken
    half = np.array(size[:2]) / 2 - 0.09  # pictures hang behind the furniture
    group = varied_group(config, rng, kind)
    for yaw, place in group_spots(rng, size, kind, PLAN_TRIES):
        placed = turned(group, yaw, 0.0, 0.0)
        prints = footprints(placed, corners)
        # A place behind a wall means: as close to that wall as the group fits.
        low = -half - prints[:, :2].min(0)
        high = half - prints[:, 2:].max(0)
        at = np.clip(place, low, high)
        prints = prints + np.tile(at, 2)
        if (low > high).any() or overlap(prints, fixed, 0.03) or overlap(prints, others, 0.0):
            continue
        return turned(placed, 0.0, float(at[0]), float(at[1]))
    return []


def plan_room(config: RoomConfig, index: int, count: int, models: dict[str, Model]) -> RoomPlan:
    """Size, openings, furniture and free ways of one room of the flat.

    Raises: ValueError if no plan leaves a way between the doors (never seen).
    """
    corners = model_corners(models)
    for attempt in range(20):
        rng = np.random.default_rng([config.seed, 21, index, attempt])
        w, d, h = rng.uniform((5.8, 5.0, 2.5), (7.6, 6.6, 2.9))
        size = (float(w), float(d), float(h))
        sides = [side for side in (-1, 1) if 0 <= index + side < count]
        doors = {side: float(rng.uniform(-1, 1)) * (d / 2 - 1.1) for side in sides}
        fixed = fixed_parts(rng, size, doors)
        obstacles = np.concatenate([rectangles(fixed, (REACH_M[0], 0.9)), wall_boxes(size, doors)])
        others = door_zones(size, doors)
        placements: list[Placement] = []
        groups = 0
        for kind in [*rng.permutation(3), int(rng.integers(2))]:
            group = furnish_group(config, rng, int(kind), corners, size, (obstacles, others))
            if group:
                prints = footprints(group, corners)
                whole = [*prints[:, :2].min(0) - AISLE_M, *prints[:, 2:].max(0) + AISLE_M]
                others = np.concatenate([others, [whole]])
                placements += group
                groups += 1
        prints = footprints(placements, corners)
        boxes = np.concatenate([rectangles(fixed), wall_boxes(size, doors), prints])
        free = reachable(size, boxes, doors) > 0
        if groups >= 2 and free.mean() > 0.2:
            return RoomPlan(size, doors, tuple(placements), tuple(fixed), boxes)
    raise ValueError(f"seed {config.seed}: no plan for room {index + 1} leaves a way through")


def room_textures(
    config: RoomConfig, index: int, size: tuple[float, float, float]
) -> dict[str, Image]:
    """All textures of one room, with strong patterns on walls and floor."""
    rng = np.random.default_rng([config.seed, 22, index])
    small = (0.5, 0.5, 0.5)  # the walls of these two sets are replaced
    textures = make_textures(rng, config, small) | varied_textures(rng, config, (150, 150, 150))
    w, d, h = (int(side * config.texels_per_m) for side in size)
    walls = rng.permutation(4)
    for number, side in enumerate(("north", "south", "east", "west")):
        kind = (plaster, wallpaper, bricks, planks)[walls[number]]
        textures[f"wall_{side}"] = kind(rng, h, w if number < 2 else d, pale_color(rng))
    floor = (planks, fabric, planks, bricks)[int(rng.integers(4))]
    tone: Color = (78.0, 122.0, 165.0)
    textures["floor"] = floor(rng, d, w, tone if index % 2 == 0 else pale_color(rng))
    textures["ceiling"] = plaster(rng, d // 3, w // 3, (222.0, 228.0, 230.0), 0.03)
    for name in ("case_wood", "side_wood"):  # around the doors
        textures[name] = wood(rng, 512, 512, (60.0 + 25 * index % 90, 100.0, 150.0))
    return textures


def model_windows(
    config: RoomConfig, model: Model, rects: dict[str, tuple[int, int, int, int]], group: int
) -> list[list[float]]:
    """Texture piece (x, y, w, h) in the atlas of every part; the same for the same twin group."""
    rng = np.random.default_rng([config.seed, 24, group])
    return [texture_window(p, rects[p.texture], config.texels_per_m, rng) for p in model.parts]


def room_surfaces(
    config: RoomConfig,
    index: int,
    plan: RoomPlan,
    models: dict[str, tuple[str, Model]],
    looks: tuple[dict[str, tuple[int, int, int, int]], dict[str, list[list[float]]]],
    numbers: dict[str, int],
    lighting: Lighting = DEFAULT_LIGHTING,
) -> Room:
    """Surfaces, light and objects of one room in its own frame, without its atlas.

    Args:
        models: by name: the key of its look in the flat (the same in all rooms that share it) and
            the model with the names of the flat's textures.
        looks: rectangle of every texture in the atlas; texture pieces by key, filled here.
        numbers: twin group by key, filled here.
    """
    rects, windows_of = looks
    shell = shell_with_doors(plan.size_m, plan.doors)
    rng = np.random.default_rng([config.seed, 23, index])
    windows: list[list[float]] = []
    for part, (s0, t0, s1, t1) in shell:
        x, y, w, h = rects[f"{index}/{part.texture}"]
        windows.append([x + s0 * w, y + t0 * h, (s1 - s0) * w, (t1 - t0) * h])
    parts = [part for part, _ in shell]
    for part in plan.fixed:
        rect = rects[f"{index}/{part.texture}"]
        windows.append(texture_window(part, rect, config.texels_per_m, rng))
    parts += plan.fixed
    owners = [-1] * len(parts)
    placed: list[tuple[RoomObject, Array]] = []
    for placement in plan.placements:
        key, model = models[placement.model]
        group = numbers.setdefault(key, len(numbers))
        if key not in windows_of:
            windows_of[key] = model_windows(config, model, rects, group)
        truth, own, outline = place_object(len(placed), placement, model, group)
        placed.append((truth, outline))
        owners += [truth.index] * len(own)
        parts += own
        windows += windows_of[key]
    surfaces, height = build_surfaces(parts, owners, windows)
    extent = (plan.size_m[0] + WALL_M, *plan.size_m[1:])  # the lining of the doors is lit too
    rng = np.random.default_rng([config.seed, 25, index])
    light = bake_light(surfaces, extent, height, config.light_rays, rng, len(shell), lighting)
    truths = tuple(truth for truth, _ in placed)
    return Room(plan.size_m, truths, surfaces, (), light, tuple(o for _, o in placed))


def flat_models(config: RoomConfig, count: int) -> list[dict[str, tuple[str, Model]]]:
    """Models of each room by name: the key of the look, the model with the flat's textures."""
    rooms: list[dict[str, tuple[str, Model]]] = []
    for index in range(count):
        rng = np.random.default_rng([config.seed, 20, index])
        own = {}
        for name, model in varied_models(rng, furniture_models(rng)).items():
            if index and name in SHARED:
                own[name] = rooms[0][name]
                continue
            parts = tuple(replace(p, texture=f"{index}/{p.texture}") for p in model.parts)
            own[name] = (f"{index}/{name}", replace(model, parts=parts))
        rooms.append(own)
    return rooms
