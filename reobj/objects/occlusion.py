"""Occluded edges of boxes, and background points seen through objects.

A box edge caused by an occluder does not bound the object. An edge counts as occluded if a nearer
object covers the image just outside it but not just inside it, unless that object continues behind
this one, which stands on it; or if the box of a floor-standing object ends above the floor. Sparse
points seen behind an object, on rays through its middle, are evidence that the object does not
exist.
"""

from __future__ import annotations

import numpy as np

import quadrics
from reobj.cameras import Poses, VisiblePoints, invert_rigid, place_of
from reobj.objects.observations import Views
from reobj.types import Array, BoolArray, IntArray

# Offsets from the edge, over the size of the box: outside, where an occluder must be, and inside,
# where none may be (chosen: the outline of the occluder is not known better)
BESIDE_EDGE = (0.1, -0.2)
# Fraction of its height that a box may end above the lower edge of its object and still show all of
# it (chosen on hololens_kitchen, where .05 to .2 are alike)
ABOVE_FLOOR = 0.1


def occluded_edges(
    views: Views, ellipsoids: quadrics.Ellipsoids, standing: BoolArray, floor_known: bool = True
) -> BoolArray:
    """Mark box edges where the object is occluded rather than ends.

    Args:
        ellipsoids: of the G groups of the views, NaN where unknown: they occlude nothing.
        standing: (G,) of a category that stands on the floor. floor_known: where it is.
    Returns:
        (V, G, 4) left, upper, right and lower edge.
    """
    projected = quadrics.solid_boxes(ellipsoids, "box", views.img_from_world)
    above = edges_above_floor(views.boxes, quadrics.clip_boxes(projected, views.image_size))
    above &= (standing & floor_known)[:, None]
    return _occluded_by_nearer(views, ellipsoids, standing) | above


def edges_above_floor(boxes: Array, projected: Array) -> BoolArray:
    """Mark the unreliable edges of boxes (..., 4) that end above the floor.

    The lower part of a floor-standing object is occluded then. It may be the wider one: of a chair
    at a table only the back is visible.

    Args:
        projected: (..., 4) boxes of the projected objects, which extend down to the floor.
    Returns:
        (..., 4) left, upper, right and lower edge.
    """
    height = projected[..., 3] - projected[..., 1]
    above = boxes[..., 3] < projected[..., 3] - ABOVE_FLOOR * height
    return np.asarray(above[..., None] & np.array([True, False, True, True]), bool)


def _occluded_by_nearer(
    views: Views, ellipsoids: quadrics.Ellipsoids, standing: BoolArray
) -> BoolArray:
    """Mark box edges (V, G, 4) with a nearer object just outside and none just inside.

    A nearer object is there if it covers half of the points beside the edge or more. One that is
    behind the object at the points inside supports it, and hides nothing, unless the object stands
    on the floor.
    """
    occluded = np.zeros(views.boxes.shape, bool)
    known = np.isfinite(ellipsoids.half_axes.sum(1) + ellipsoids.center_in_world.sum(1))
    seen = np.isfinite(views.boxes.sum(2)) & known  # (V, G)
    column = np.cumsum(known) - 1  # (G,) number among the S known shapes
    shapes = ellipsoids[known]
    outline = quadrics.solid_boxes(shapes, "box", views.img_from_world)  # (V, S, 4)
    for v in np.flatnonzero(seen.any(1)):
        camera = views.img_from_world[v]  # (D,)
        groups = np.flatnonzero(seen[v])
        points = _beside_edges(views.boxes[v, groups])  # (2, D, 4, P, 2)
        aside = (outline[v, :, :2] > points.max((0, 1, 2, 3))).any(1)
        aside |= (outline[v, :, 2:] < points.min((0, 1, 2, 3))).any(1)
        candidates = np.flatnonzero(~aside)  # (N,) shapes that some of the rays may hit
        depth = shapes.center_in_world @ camera[2, :3] + camera[2, 3]  # (S,)
        entry = entry_depths(points.reshape(-1, 2), camera, shapes[candidates])
        entry = entry.reshape(*points.shape[:4], -1)  # (2, D, 4, P, N)
        itself = candidates == column[groups, None]  # (D, N)
        entry = np.where(itself[:, None, None], np.inf, entry)
        outside, inside = entry < depth[column[groups], None, None, None]  # (D, 4, P, N)
        supports = np.isfinite(entry[1]) & ~inside & ~standing[groups, None, None, None]
        outside &= ~supports
        covered = [hit.any(3).mean(2) >= 0.5 for hit in (outside, inside)]  # (D, 4)
        occluded[v, groups] = covered[0] & ~covered[1]
    return occluded


def _beside_edges(box: Array) -> Array:
    """Return points (2, D, 4, P, 2) along the edges of boxes (D, 4), for each `BESIDE_EDGE`."""
    low = box[:, None, :2]  # (D, 1, 2)
    high = box[:, None, 2:]
    point = (np.arange(8) + 0.5) / 8  # (P,) of the length of an edge; more take more time
    along = low + (high - low) * point[:, None]  # (D, P, 2)
    found = []
    for beyond in BESIDE_EDGE:
        off = beyond * (high - low)
        first, last = (np.broadcast_to(edge, along.shape) for edge in (low - off, high + off))
        sides = [(first, along), (along, first), (last, along), (along, last)]
        found.append(np.stack([np.stack([x[..., 0], y[..., 1]], -1) for x, y in sides], 1))
    return np.stack(found)


def entry_depths(points: Array, camera: Array, boxes: quadrics.Ellipsoids) -> Array:
    """Return the depths (K, S) where rays of image points (K, 2) enter boxes; inf: no hit."""
    inverse = np.linalg.inv(camera[:, :3])
    ray = np.column_stack([points, np.ones(len(points))]) @ inverse.T  # (K, 3), of depth 1
    start = -inverse @ camera[:, 3] - boxes.center_in_world  # (S, 3)
    start = np.einsum("sij,si->sj", boxes.world_from_obj, start)
    ray = np.einsum("sij,ki->ksj", boxes.world_from_obj, ray)  # (K, S, 3)
    faces = np.stack([-boxes.half_axes - start, boxes.half_axes - start]).transpose(0, 2, 1)
    ray = np.ascontiguousarray(ray.transpose(2, 0, 1))  # (3, K, S): short axes first are fast
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = faces[:, :, None] / ray  # (2, 3, K, S)
    enter = ends.min(0).max(0)  # (K, S)
    leave = ends.max(0).min(0)
    return np.where((enter < leave) & (leave > 0), np.maximum(enter, 0), np.inf)


# Largest distance of a ray from the centre, over the half axes (larger: more points, but also rays
# beside an object that fills its ellipsoid poorly)
MIDDLE = 0.6
# Least distance behind the object, over that from the camera (smaller: errors of depth count)
BEHIND = 0.05
# Ratio of points behind to points on an object that exists (measured: chairs, tables 1.8)
HOLES = 2.0
PRIOR_POINTS = 10.0  # added to both counts: few points are no evidence (5 and 10 are alike)


def see_through_ratio(
    ellipsoids: quadrics.Ellipsoids,
    expected: BoolArray,
    poses: Poses,
    frame: IntArray,
    most_points: int = 500,
) -> Array:
    """Measure how many sparse points are seen behind objects, compared with on or before them.

    Args:
        ellipsoids: O. expected: (V, O) frames in which the objects should be visible.
        poses: with points and their visibility. frame: (V,) numbers.
        most_points: of a frame that are tested; more take more time.
    Returns:
        (O,) log ratio of points behind to the others on rays through the middle, at least 0.
    """
    visible = VisiblePoints(poses)
    row, _ = place_of(poses, frame)
    camera = invert_rigid(poses.cam_from_world[row])[:, :, 3]  # (V, 3)
    behind, others = np.zeros((2, expected.shape[1]))
    for v in np.flatnonzero(expected.any(1)):
        points = visible.observed(row[v])
        if not len(points):
            continue
        objects = np.flatnonzero(expected[v])
        ray = poses.points[points[:: len(points) // most_points + 1]] - camera[v]  # (N, 3)
        scaled = ellipsoids.world_from_obj[objects] / ellipsoids.half_axes[objects][:, None]
        start = np.einsum("si,sij->sj", camera[v] - ellipsoids.center_in_world[objects], scaled)
        along = np.einsum("ni,sij->nsj", ray, scaled)  # in units of the half axes: unit spheres
        a = (along**2).sum(2)  # (N, S)
        b = (along * start).sum(2)
        square = (start**2).sum(1)
        root = np.sqrt((b**2 - a * (square - 1)).clip(0))
        leave = (root - b) / a  # the point is at 1
        middle = (square - b**2 / a < MIDDLE**2) & (leave > 0)
        passes = leave < 1 - BEHIND
        behind[objects] += (middle & passes).sum(0)
        others[objects] += (middle & ~passes).sum(0)
    return np.log((behind + PRIOR_POINTS) / (HOLES * others + PRIOR_POINTS)).clip(0)
