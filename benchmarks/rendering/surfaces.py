"""The patches of a room as arrays, their texture atlas, and the objects they belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import COCO_NAMES, Array, Image, Rng
from rendering.models import DISC, FRUSTUM, QUAD, SPHERE, Model, Part, Placement, moved, rotation_z

MIP_LEVELS = 5
ATLAS_WIDTH = 4096  # texels; OpenCV's remap refuses images of 32,768 and more
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
    identity: int  # in gt_mot.txt and gt_objects.json; index + 1 unless sessions share numbers
    class_name: str
    class_id: int  # COCO-80
    twin_group: int  # objects of one model share it: they look the same
    support: str  # box | cylinder | ellipsoid
    center_in_world: Array  # (3,) m
    size_m: Array  # (3,) full width, depth, height
    yaw_rad: float
    world_from_obj: Array  # (3, 3)


@dataclass(frozen=True, slots=True)
class Room:
    """Geometry, looks and truth of one room."""

    size_m: tuple[float, float, float]
    objects: tuple[RoomObject, ...]
    surfaces: Surfaces
    atlas: tuple[Image, ...]  # mip levels, BGR
    light: npt.NDArray[np.float32]  # (h, w, 3) linear irradiance
    outline_in_world: tuple[Array, ...] = field(
        repr=False
    )  # per object (parts, P, 3) hull points of each part


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


def build_atlas(
    textures: dict[str, Image], width: int = ATLAS_WIDTH
) -> tuple[tuple[Image, ...], dict[str, tuple[int, int, int, int]]]:
    """Pack all textures, with replicated borders, and shrink by two for each mip level."""
    pad = ATLAS_PAD
    padded = [
        cv2.copyMakeBorder(t, pad, pad, pad, pad, cv2.BORDER_REPLICATE) for t in textures.values()
    ]
    positions, height = pack([(p.shape[1], p.shape[0]) for p in padded], width, ATLAS_PAD)
    level = np.zeros((height, width, 3), np.uint8)
    rects = {}
    for (name, texture), image, (x, y) in zip(textures.items(), padded, positions, strict=True):
        level[y : y + image.shape[0], x : x + image.shape[1]] = image
        rects[name] = (x + pad, y + pad, texture.shape[1], texture.shape[0])
    levels = [level]
    for _ in range(MIP_LEVELS - 1):
        half = (levels[-1].shape[1] // 2, levels[-1].shape[0] // 2)
        levels.append(
            np.asarray(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA), np.uint8)
        )
    return tuple(levels), rects


def patch_extent_m(part: Part) -> tuple[float, float]:
    """Size of a patch along s and t."""
    lengths = np.linalg.norm(part.obj_from_patch[:, :3], axis=0)
    if part.kind == SPHERE:
        return float(2 * np.pi * lengths[:2].mean()), float(np.pi * lengths[2])
    if part.kind == FRUSTUM:
        return float(2 * np.pi * max(part.radii)), float(lengths[2])
    return float(lengths[0]), float(lengths[1])


def texture_window(
    part: Part, rect: tuple[int, int, int, int], scale: float, rng: Rng
) -> list[float]:
    """What of the texture a patch shows: all of it, or a piece at natural scale somewhere."""
    x, y, w, h = rect
    if part.fit:
        return [x, y, w, h]
    width, height = (
        min(scale * side, limit) for side, limit in zip(patch_extent_m(part), (w, h), strict=True)
    )
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
    if part.kind in (QUAD, DISC):
        low = np.zeros(3)
        high = np.array([1.0, 1.0, 0.0])
    elif part.kind == SPHERE:
        low = -np.ones(3)
        high = np.ones(3)
    else:
        r = max(part.radii)
        low = np.array([-r, -r, 0.0])
        high = np.array([r, r, 1.0])
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
    return np.where(picks == 0, low, high)


def apply(b_from_a: Array, points_in_a: Array) -> Array:
    """(3, 4) transform of (..., 3) points."""
    return np.asarray(points_in_a @ b_from_a[:, :3].T + b_from_a[:, 3])


def build_surfaces(
    parts: Sequence[Part], owners: Sequence[int], windows: Sequence[Sequence[float]]
) -> tuple[Surfaces, int]:
    """Stack world parts into arrays and give each a piece of the light map (and its height)."""
    cells = []
    for part in parts:
        step = 0.06 if max(patch_extent_m(part)) > 1.2 else 0.08
        cells.append(
            tuple(int(np.clip(np.ceil(side / step), 3, 160)) for side in patch_extent_m(part))
        )
    positions, height = pack([(w, h) for w, h in cells], 512, 1)
    surfaces = Surfaces(
        kind=np.array([p.kind for p in parts]),
        world_from_patch=np.stack([p.obj_from_patch for p in parts]),
        quadric=np.array([quadric_of(p) for p in parts]),
        radii=np.array([p.radii for p in parts]),
        texture_rect=np.array(windows, float),
        light_rect=np.array(
            [(*placement, *cell) for placement, cell in zip(positions, cells, strict=True)], float
        ),
        owner=np.array(owners),
        two_sided=np.array([p.two_sided for p in parts]),
        emission=np.array([p.emission for p in parts]),
        corners_in_world=np.stack([apply(p.obj_from_patch, patch_corners(p)) for p in parts]),
    )
    return surfaces, height


def surface_points(
    kind: int, frame: Array, radii: Array, s: Array, t: Array
) -> tuple[Array, Array]:
    """Points and outward normals of a patch at texture coordinates s, t in 0..1.

    Args:
        frame: (3, 4) b_from_patch. s, t: (N,).
    Returns:
        points (N, 3) and unit normals (N, 3), both in b.
    """
    if kind in (QUAD, DISC):
        local = np.stack([s, t, np.zeros_like(s)], -1)
        normals = np.broadcast_to(-frame[:, 2], (len(s), 3))
        return apply(frame, local), normals
    angle = 2 * np.pi * (s - 0.5)
    if kind == SPHERE:
        z = 1 - 2 * t
        ring = np.sqrt(np.maximum(1 - z**2, 0))
        slope = z
    else:
        z = 1 - t
        ring = radii[0] + (radii[1] - radii[0]) * z
        slope = np.full_like(s, radii[0] - radii[1])
    local = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)  # (N, 3)
    flat = np.ones_like(s) if kind == FRUSTUM else ring
    gradient = np.stack([flat * np.cos(angle), flat * np.sin(angle), slope], -1) @ np.linalg.inv(
        frame[:, :3]
    )
    length = np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    return apply(frame, local), np.asarray(gradient / length)


def part_outline(part: Part) -> Array:
    """(96, 3) points whose convex hull is that of the part (round rims to 1e-3 of the radius)."""
    turn = np.arange(48) * 2 * np.pi / 48
    c = np.cos(turn)
    s = np.sin(turn)
    if part.kind == QUAD:
        local = np.tile(patch_corners(part), (12, 1))
    elif part.kind == DISC:
        local = np.tile(np.stack([0.5 + 0.5 * c, 0.5 + 0.5 * s, 0 * c], -1), (2, 1))
    elif part.kind == FRUSTUM:
        rims = [
            np.stack([r * c, r * s, np.full(48, z)], -1)
            for r, z in zip(part.radii, (0.0, 1.0), strict=True)
        ]
        local = np.concatenate(rims)
    else:
        z = 1 - 2 * (np.arange(96) + 0.5) / 96  # Fibonacci lattice
        golden = np.arange(96) * np.pi * (3 - np.sqrt(5))
        ring = np.sqrt(1 - z**2)
        local = np.stack([ring * np.cos(golden), ring * np.sin(golden), z], -1)
    return apply(part.obj_from_patch, local)


def place_object(
    index: int, placement: Placement, model: Model, twin_group: int
) -> tuple[RoomObject, list[Part], Array]:
    """Move a model into the room: truth, world parts, outline points (parts, 96, 3)."""
    rotation = rotation_z(placement.yaw_rad)
    extent = np.concatenate([part_extremes(part) for part in model.parts])
    low, high = extent.min(0), extent.max(0)  # (3,) in the model's frame
    offset = np.asarray(placement.position, float)
    parts = [moved(part, rotation, offset) for part in model.parts]
    truth = RoomObject(
        index=index,
        identity=index + 1,
        class_name=model.class_name,
        class_id=COCO_NAMES.index(model.class_name),
        twin_group=twin_group,
        support=model.support,
        center_in_world=rotation @ ((low + high) / 2) + offset,
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
