"""The patches of a room as arrays, their texture atlas, and the objects they belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import COCO_NAMES, Array, Image, Rect, Rng, Size
from rendering.models import DISC, FRUSTUM, QUAD, SPHERE, Model, Part, Placement, placed, rotation_z

MIP_LEVELS = 5
ATLAS_WIDTH = 4096  # texels; OpenCV's remap refuses images of 32,768 and more
LIGHT_WIDTH = 512  # texels of the light map
ATLAS_PAD = 16  # texels of replicated border, 2**(MIP_LEVELS - 1): keeps mip levels from bleeding


@dataclass(frozen=True, slots=True)
class Surfaces:
    """All patches of a room as arrays."""

    kind: npt.NDArray[np.int64]  # (S,)
    world_from_patch: Array  # (S, 3, 4)
    quadric: Array  # (S, 5) a, b, c, zmin, zmax of x^2 + y^2 + a z^2 + b z + c = 0
    radii: Array  # (S, 2)
    texture_rect: Array  # (S, 4) x, y, w, h in the atlas
    light_rect: Array  # (S, 4) x, y, w, h in the light map
    owner: npt.NDArray[np.int64]  # (S,) object index, -1 for the room itself
    two_sided: npt.NDArray[np.bool_]  # (S,)
    emission: Array  # (S,)
    corners_in_world: Array  # (S, 8, 3) of a bounding parallelepiped


@dataclass(frozen=True, slots=True)
class RoomObject:
    """The truth about one object."""

    index: int  # 0-based, in the order of the room's objects
    identity: int  # in gt_mot.txt and gt_objects.json
    class_name: str
    class_id: int  # COCO-80
    twin_group: int  # objects of one model share it: they look the same
    shape: str  # box | cylinder | ellipsoid
    center_in_world: Array  # (3,) m
    size_m: Array  # (3,) full width, depth, height
    yaw_rad: float
    world_from_obj: Array  # (3, 3)


@dataclass(frozen=True, slots=True)
class Room:
    """Geometry, looks and truth of one room."""

    size_m: Size
    objects: tuple[RoomObject, ...]
    surfaces: Surfaces
    atlas: tuple[Image, ...]  # mip levels, BGR
    light: npt.NDArray[np.float32]  # (h, w, 3) linear irradiance
    outline_in_world: tuple[Array, ...]  # per object (parts, P, 3) hull points of each part


def pack(
    sizes: Sequence[tuple[int, int]], width: int, grid: int
) -> tuple[list[tuple[int, int]], int]:
    """Placement rectangles (w, h) on shelves of an image; positions are multiples of `grid`."""
    positions = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: (-sizes[i][1], i)):
        w, h = (-(-side // grid) * grid for side in sizes[index])
        if x + w > width:
            x = 0
            y = y + shelf
            shelf = 0
        positions[index] = (x, y)
        x = x + w
        shelf = max(shelf, h)
    return positions, y + shelf


def build_atlas(textures: dict[str, Image]) -> tuple[tuple[Image, ...], dict[str, Rect]]:
    """Pack all textures, with replicated borders, and shrink by two for each mip level."""
    pad = ATLAS_PAD
    padded = [
        cv2.copyMakeBorder(t, pad, pad, pad, pad, cv2.BORDER_REPLICATE) for t in textures.values()
    ]
    positions, height = pack([(p.shape[1], p.shape[0]) for p in padded], ATLAS_WIDTH, pad)
    level = np.zeros((height, ATLAS_WIDTH, 3), np.uint8)
    rects = {}
    for name, image, (x, y) in zip(textures, padded, positions, strict=True):
        h, w = image.shape[:2]
        level[y : y + h, x : x + w] = image
        rects[name] = (x + pad, y + pad, w - 2 * pad, h - 2 * pad)
    levels = [level]
    for _ in range(MIP_LEVELS - 1):
        half = (levels[-1].shape[1] // 2, levels[-1].shape[0] // 2)
        small = cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(small, np.uint8))
    return tuple(levels), rects


def patch_extent_m(part: Part) -> tuple[float, float]:
    """Size of a patch along s and t."""
    lengths = np.linalg.norm(part.obj_from_patch[:, :3], axis=0)
    if part.kind == SPHERE:
        return float(2 * np.pi * lengths[:2].mean()), float(np.pi * lengths[2])
    if part.kind == FRUSTUM:
        return float(2 * np.pi * max(part.radii)), float(lengths[2])
    return float(lengths[0]), float(lengths[1])


def texture_window(part: Part, rect: Rect, scale: float, rng: Rng) -> Sequence[float]:
    """What of the texture a patch shows: all of it, or a piece at natural scale somewhere."""
    if part.fit:
        return rect
    x, y, w, h = rect
    width, height = patch_extent_m(part)
    width = min(scale * width, w)
    height = min(scale * height, h)
    return [x + rng.uniform(0, w - width), y + rng.uniform(0, h - height), width, height]


def quadric_of(part: Part) -> list[float]:
    """Coefficients a, b, c and z limits of x^2 + y^2 + a z^2 + b z + c = 0 in the patch's frame."""
    if part.kind == SPHERE:
        return [1.0, 0.0, -1.0, -1.0, 1.0]
    r0 = part.radii[0]
    slope = part.radii[1] - part.radii[0]
    return [-(slope**2), -2 * r0 * slope, -(r0**2), 0.0, 1.0]


def patch_corners(part: Part) -> Array:
    """(8, 3) corners of a parallelepiped around the patch, in the patch's own coordinates."""
    r = max(part.radii)
    low, high = {
        QUAD: ((0, 0, 0), (1, 1, 0)),
        DISC: ((0, 0, 0), (1, 1, 0)),
        SPHERE: ((-1, -1, -1), (1, 1, 1)),
        FRUSTUM: ((-r, -r, 0), (r, r, 1)),
    }[part.kind]
    picks = np.indices((2, 2, 2)).reshape(3, 8).T  # (8, 3)
    return np.where(picks == 0, low, np.array(high, float))


def apply(b_from_a: Array, points_in_a: Array) -> Array:
    """(3, 4) transform of (..., 3) points."""
    return np.asarray(points_in_a @ b_from_a[:, :3].T + b_from_a[:, 3])


def part_bounds(part: Part) -> Array:
    """(2, 3) lowest and highest corner around a part."""
    corners = apply(part.obj_from_patch, patch_corners(part))
    return np.stack([corners.min(0), corners.max(0)])


def build_surfaces(
    parts: Sequence[Part], owners: Sequence[int], windows: Sequence[Sequence[float]]
) -> tuple[Surfaces, int]:
    """Stack world parts into arrays and give each a piece of the light map (and its height)."""
    cells = []
    for part in parts:
        extent = patch_extent_m(part)
        step = 0.06 if max(extent) > 1.2 else 0.08
        w, h = (int(np.clip(np.ceil(side / step), 3, 160)) for side in extent)
        cells.append((w, h))
    positions, height = pack(cells, LIGHT_WIDTH, 1)
    surfaces = Surfaces(
        kind=np.array([p.kind for p in parts]),
        world_from_patch=np.stack([p.obj_from_patch for p in parts]),
        quadric=np.array([quadric_of(p) for p in parts]),
        radii=np.array([p.radii for p in parts]),
        texture_rect=np.array(windows, float),
        light_rect=np.hstack([positions, cells]).astype(float),
        owner=np.array(owners),
        two_sided=np.array([p.two_sided for p in parts]),
        emission=np.array([p.emission for p in parts]),
        corners_in_world=np.stack([apply(p.obj_from_patch, patch_corners(p)) for p in parts]),
    )
    return surfaces, height


def surface_points(surfaces: Surfaces, index: int, size: tuple[int, int]) -> tuple[Array, Array]:
    """Points (N, 3) and outward unit normals (N, 3) in world of a grid of w x h = N texels."""
    kind = surfaces.kind[index]
    frame = surfaces.world_from_patch[index]
    low, high = surfaces.radii[index]
    s, t = (v.ravel() for v in np.meshgrid(*((np.arange(n) + 0.5) / n for n in size)))
    if kind in (QUAD, DISC):
        local = np.stack([s, t, np.zeros_like(s)], -1)
        return apply(frame, local), np.broadcast_to(-frame[:, 2], (len(s), 3))
    angle = 2 * np.pi * (s - 0.5)
    if kind == SPHERE:
        z = 1 - 2 * t
        ring = np.sqrt(np.maximum(1 - z**2, 0))
        flat = ring
        slope = z
    else:
        z = 1 - t
        ring = low + (high - low) * z
        flat = np.ones_like(s)
        slope = np.full_like(s, low - high)
    local = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)  # (N, 3)
    gradient = np.stack([flat * np.cos(angle), flat * np.sin(angle), slope], -1)
    normal = gradient @ np.linalg.inv(frame[:, :3])
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return apply(frame, local), np.asarray(normal / length)


def part_outline(part: Part) -> Array:
    """(96, 3) points whose convex hull is that of the part (round rims to 1e-3 of the radius)."""
    turn = np.arange(48) * 2 * np.pi / 48
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)  # (48, 3)
    if part.kind == QUAD:
        local = np.tile(patch_corners(part), (12, 1))
    elif part.kind == DISC:
        local = np.tile(0.5 * ring + [0.5, 0.5, 0], (2, 1))
    elif part.kind == FRUSTUM:
        low, high = part.radii
        local = np.concatenate([low * ring, high * ring + [0, 0, 1]])
    else:
        z = 1 - 2 * (np.arange(96) + 0.5) / 96  # Fibonacci lattice
        golden = np.arange(96) * np.pi * (3 - np.sqrt(5))
        width = np.sqrt(1 - z**2)
        local = np.stack([width * np.cos(golden), width * np.sin(golden), z], -1)
    return apply(part.obj_from_patch, local)


def place_object(
    index: int, identity: int, placement: Placement, model: Model, twin_group: int
) -> tuple[RoomObject, list[Part], Array]:
    """Move a model into the room: truth, world parts, outline points (parts, 96, 3)."""
    rotation = rotation_z(placement.yaw_rad)
    extent = np.concatenate([part_extremes(part) for part in model.parts])
    low = extent.min(0)  # (3,) in the model's frame
    high = extent.max(0)
    parts = placed(model.parts, rotation, placement.position)
    truth = RoomObject(
        index=index,
        identity=identity,
        class_name=model.class_name,
        class_id=COCO_NAMES.index(model.class_name),
        twin_group=twin_group,
        shape=model.shape,
        center_in_world=rotation @ ((low + high) / 2) + placement.position,
        size_m=high - low,
        yaw_rad=float((placement.yaw_rad + np.pi) % (2 * np.pi) - np.pi),
        world_from_obj=rotation,
    )
    return truth, parts, np.stack([part_outline(part) for part in parts])


def part_extremes(part: Part) -> Array:
    """(P, 3) points that hold the exact axis-aligned extent of a part."""
    if part.kind != SPHERE:
        return part_outline(part)
    reach = np.linalg.norm(part.obj_from_patch[:, :3], axis=1)  # (3,) half extent along each axis
    return np.asarray(part.obj_from_patch[:, 3] + np.stack([-reach, reach]))
