"""Ground truth of a frame: boxes, visibility, identities."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import find_objects

from rendering.config import NEAR_M, Array
from rendering.models import SPHERE
from rendering.surfaces import Room, RoomObject, apply


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """What one frame shows; NaN boxes where there is nothing to box."""

    visible_px: npt.NDArray[np.int64]  # (O,) pixels of each object in the instance map
    visible_xyxy: Array  # (O, 4) tight box of those pixels
    amodal_xyxy: Array  # (O, 4) box of the whole object, including occluded and truncated parts
    solid_xyxy: Array  # (O, 4) box of the annotated shape (box, cylinder, ellipsoid)
    visibility: Array  # (O,) visible pixels / pixels of the whole silhouette


def project_points(points_in_world: Array, K: Array, cam_from_world: Array) -> tuple[Array, Array]:
    """Pixels (..., 2) and depths (...,)."""
    in_cam = apply(cam_from_world, points_in_world)
    pixels = in_cam @ K.T
    return pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-9), in_cam[..., 2]


def sphere_rim(world_from_patch: Array, center_in_world: Array, count: int = 96) -> Array:
    """(count, 3) points where rays from the camera centre touch an ellipsoid.

    Where it is the unit sphere and the camera is at o, they are the circle x . o = 1, |x| = 1.
    """
    linear = world_from_patch[:, :3]
    o = np.linalg.solve(linear, center_in_world - world_from_patch[:, 3])
    squared = max(float(o @ o), 1.0 + 1e-9)
    first = np.cross(o, np.eye(3)[int(np.abs(o).argmin())])
    first /= np.linalg.norm(first)
    second = np.cross(o, first) / np.linalg.norm(o)
    turn = np.arange(count)[:, None] * 2 * np.pi / count
    ring = np.sqrt(1 - 1 / squared) * (np.cos(turn) * first + np.sin(turn) * second)
    return apply(world_from_patch, o / squared + ring)


def object_outline(room: Room, index: int, center_in_world: Array) -> Array:
    """(parts, 96, 3) points whose projections span the object's outline from this camera centre."""
    points = room.outline_in_world[index].copy()
    own = np.nonzero(room.surfaces.owner == index)[0]
    for k in np.nonzero(room.surfaces.kind[own] == SPHERE)[0]:
        points[k] = sphere_rim(room.surfaces.world_from_patch[own[k]], center_in_world)
    return points


def solid_outline(truth: RoomObject, center_in_world: Array) -> Array:
    """(P, 3) points whose projections span the outline of the object's solid."""
    half = truth.size_m / 2
    frame = np.concatenate(
        [truth.world_from_obj * half, truth.center_in_world[:, None]], 1
    )  # (3, 4)
    if truth.shape == "ellipsoid":
        return sphere_rim(frame, center_in_world)
    if truth.shape == "box":
        signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), -1).reshape(8, 3)
        return apply(frame, signs)
    turn = np.arange(96) * 2 * np.pi / 96
    rims = [np.stack([np.cos(turn), np.sin(turn), np.full(96, z)], -1) for z in (-1.0, 1.0)]
    return apply(frame, np.concatenate(rims))


def box_of(points: Array) -> Array:
    """(4,) x0, y0, x1, y1 of (..., 2) pixels."""
    flat = points.reshape(-1, 2)
    return np.concatenate([flat.min(0), flat.max(0)])


def silhouette_area(part_pixels: Array, canvas: int = 640) -> float:
    """Area in px^2 of the union of the parts' convex hulls, uncut; part_pixels (n, P, 2)."""
    x0, y0, x1, y1 = box_of(part_pixels)
    scale = (canvas - 8) / max(x1 - x0, y1 - y0, 1e-6)
    mask = np.zeros((canvas, canvas), np.uint8)
    for pixels in part_pixels:
        hull = cv2.convexHull(((pixels - [x0, y0]) * scale + 3.5).astype(np.float32))
        cv2.fillConvexPoly(mask, np.round(hull * 16).astype(np.int32), (1,), cv2.LINE_8, 4)
    return float(mask.sum() / scale**2)


def visible_boxes(
    instance: npt.NDArray[np.int32], count: int
) -> tuple[npt.NDArray[np.int64], Array]:
    """Pixel counts (O,) and tight boxes (O, 4) of the labels 0 .. count - 1."""
    pixels = np.bincount(instance.ravel() + 1, minlength=count + 1)[1:]
    boxes = np.full((count, 4), np.nan)
    for index, found in enumerate(find_objects(instance + 1, count)):
        if found:
            rows, cols = found
            boxes[index] = cols.start, rows.start, cols.stop, rows.stop
    return pixels, boxes


def ground_truth(
    room: Room, K: Array, cam_from_world: Array, instance: npt.NDArray[np.int32]
) -> FrameTruth:
    """Boxes and visibility of every object in one view; `instance` is `render`'s map."""
    count = len(room.objects)
    pixels, visible = visible_boxes(instance, count)
    center = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    amodal = np.full((count, 4), np.nan)
    solid = np.full((count, 4), np.nan)
    visibility = np.zeros(count)
    for truth in room.objects:
        spread, depth = project_points(solid_outline(truth, center), K, cam_from_world)
        if depth.min() < NEAR_M:
            continue
        solid[truth.index] = box_of(spread)
        parts, _ = project_points(
            object_outline(room, truth.index, center), K, cam_from_world
        )  # (n, 96, 2)
        amodal[truth.index] = box_of(parts)
        if pixels[truth.index]:
            visibility[truth.index] = min(1.0, pixels[truth.index] / silhouette_area(parts))
    return FrameTruth(pixels, visible, amodal, solid, visibility)
