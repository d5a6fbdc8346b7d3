"""What hides solids, and what is seen through them.

Edges of boxes tell less than where an object ends where it goes on behind something nearer. That
shows where just outside the edge something nearer is in the way and just inside it is not; and
where the box of a thing that stands on the floor ends above the floor. And where sparse points are
seen behind a solid, on rays through its middle, it is not there.
"""

from __future__ import annotations

import numpy as np

import quadrics
from reobj.cameras import Poses, invert_rigid, place_of
from reobj.objects.observations import Views, VisiblePoints
from reobj.types import Array, BoolArray, IntArray

EDGE_POINTS = (np.arange(8) + 0.5) / 8  # along an edge (chosen)
# Sizes of the box outside its edge, where something nearer must be, and inside, where it must not
# (chosen: the outline of what hides is known no better)
BESIDE = (0.1, -0.2)
MIN_COVERED = 0.5  # share of these points that nearer things cover (chosen)
# Share of its height that a box may end above the lower edge of its solid and still show the whole
# (chosen on hololens_kitchen, where .05 to .2 are alike)
ABOVE = 0.1


def hidden_edges(views: Views, ellipsoids: quadrics.Ellipsoids, on_floor: BoolArray) -> BoolArray:
    """Find the edges of boxes behind which their things go on.

    Args:
        ellipsoids: of the G groups of the views, NaN where unknown: they hide nothing.
        on_floor: (G,) these stand on a known floor.
    Returns:
        (V, G, 4) left, upper, right and lower edge.
    """
    projected = quadrics.solid_boxes(ellipsoids, "box", views.img_from_world)
    hidden = edges_above_floor(views.boxes, quadrics.clip_boxes(projected, views.image_size))
    return _behind_nearer(views, ellipsoids) | hidden & on_floor[:, None]


def edges_above_floor(boxes: Array, projected: Array) -> BoolArray:
    """Find what boxes (..., 4) of things on the floor that end above it tell nothing of.

    Their lower part is hidden, and it may be the wider one: of a chair at a table the back shows.

    Args:
        projected: (..., 4) boxes of their solids, which reach down to the floor.
    Returns:
        (..., 4) left, upper, right and lower edge.
    """
    height = projected[..., 3] - projected[..., 1]
    above = boxes[..., 3] < projected[..., 3] - ABOVE * height
    return np.asarray(above[..., None] & np.array([True, False, True, True]), bool)


def _behind_nearer(views: Views, ellipsoids: quadrics.Ellipsoids) -> BoolArray:
    """Find the edges (V, G, 4) of boxes where something nearer begins."""
    hidden = np.zeros(views.boxes.shape, bool)
    known = np.isfinite(ellipsoids.half_axes.sum(1) + ellipsoids.center_in_world.sum(1))
    seen = np.isfinite(views.boxes.sum(2)) & known  # (V, G)
    column = np.cumsum(known) - 1  # (G,) among the S known ones
    solids = ellipsoids[known]
    outline = quadrics.solid_boxes(solids, "box", views.img_from_world)  # (V, S, 4)
    for v in np.flatnonzero(seen.any(1)):
        camera, own = views.img_from_world[v], np.flatnonzero(seen[v])  # (D,)
        points = _beside_edges(views.boxes[v, own])  # (2, D, 4, P, 2)
        beside = (outline[v, :, :2] > points.max((0, 1, 2, 3))).any(1)
        beside |= (outline[v, :, 2:] < points.min((0, 1, 2, 3))).any(1)
        front = np.flatnonzero(~beside)  # (N,) solids that some of the rays may meet
        depth = solids.center_in_world @ camera[2, :3] + camera[2, 3]  # (S,)
        entry = _entry_depths(points.reshape(-1, 2), camera, solids[front])
        entry = entry.reshape(*points.shape[:4], -1)  # (2, D, 4, P, N)
        itself = front == column[own, None]  # (D, N)
        entry = np.where(itself[:, None, None], np.inf, entry)
        nearest = entry.min(4, initial=np.inf)
        covered = (nearest < depth[column[own], None, None]).mean(3) >= MIN_COVERED  # (2, D, 4)
        hidden[v, own] = covered[0] & ~covered[1]
    return hidden


def _beside_edges(box: Array) -> Array:
    """Return points (2, D, 4, P, 2) along the edges of boxes (D, 4), for each of `BESIDE`."""
    low, high = box[:, None, :2], box[:, None, 2:]  # (D, 1, 2)
    along = low + (high - low) * EDGE_POINTS[:, None]  # (D, P, 2)
    found = []
    for beyond in BESIDE:
        off = beyond * (high - low)
        first, last = (np.broadcast_to(edge, along.shape) for edge in (low - off, high + off))
        sides = [(first, along), (along, first), (last, along), (along, last)]
        found.append(np.stack([np.stack([x[..., 0], y[..., 1]], -1) for x, y in sides], 1))
    return np.stack(found)


def _entry_depths(points: Array, camera: Array, solids: quadrics.Ellipsoids) -> Array:
    """Return the depths (K, S) where rays of image points (K, 2) enter boxes; inf: nowhere."""
    inverse = np.linalg.inv(camera[:, :3])
    ray = np.column_stack([points, np.ones(len(points))]) @ inverse.T  # (K, 3), of depth 1
    start = -inverse @ camera[:, 3] - solids.center_in_world  # (S, 3)
    start = np.einsum("sij,si->sj", solids.world_from_obj, start)
    ray = np.einsum("sij,ki->ksj", solids.world_from_obj, ray)  # (K, S, 3)
    faces = np.stack([-solids.half_axes - start, solids.half_axes - start]).transpose(0, 2, 1)
    ray = np.ascontiguousarray(ray.transpose(2, 0, 1))  # (3, K, S): short axes first are fast
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = faces[:, :, None] / ray  # (2, 3, K, S)
    enter, leave = ends.min(0).max(0), ends.max(0).min(0)  # (K, S)
    return np.where((enter < leave) & (leave > 0), np.maximum(enter, 0), np.inf)


MIDDLE = 0.6  # of the half axes, that a ray must pass the centre within (chosen)
CLEARLY = 0.05  # of a point's distance, by which it lies behind a solid (chosen)
HOLES = 2.0  # times as much as else is seen through real things (measured: chairs, tables 1.8)
FEW_POINTS = 10.0  # seen behind or not, that tell little (chosen: 5 and 10 are alike)
MOST_POINTS = 500  # of a frame that are looked at (chosen: time)


def seen_through(
    solids: quadrics.Ellipsoids, expected: BoolArray, poses: Poses, frame: IntArray
) -> Array:
    """Measure how much more is seen behind solids than on them or before them.

    Args:
        solids: S. expected: (V, S) frames that should show them. poses: with points and their
            visibility. frame: (V,) numbers.
    Returns:
        (S,) log of points observed behind over the others on rays through the middle, at least 0.
    """
    points, row = VisiblePoints(poses), place_of(poses, frame)[0]
    camera = invert_rigid(poses.cam_from_world[row])[:, :, 3]  # (V, 3)
    behind, rest = np.zeros((2, expected.shape[1]))
    for v in np.flatnonzero(expected.any(1)):
        seen, own = points.observed(row[v]), np.flatnonzero(expected[v])
        ray = poses.points[seen[:: len(seen) // MOST_POINTS + 1]] - camera[v]  # (N, 3)
        scaled = solids.world_from_obj[own] / solids.half_axes[own][:, None]  # (S', 3, 3)
        start = np.einsum("si,sij->sj", camera[v] - solids.center_in_world[own], scaled)
        along = np.einsum("ni,sij->nsj", ray, scaled)  # the solids are unit spheres now
        a, b = (along**2).sum(2), (along * start).sum(2)  # (N, S')
        square = (start**2).sum(1)
        root = np.sqrt((b**2 - a * (square - 1)).clip(0))
        leave = (root - b) / a  # the point is at 1
        middle = (square - b**2 / a < MIDDLE**2) & (leave > 0)
        through = leave < 1 - CLEARLY
        behind[own] += (middle & through).sum(0)
        rest[own] += (middle & ~through).sum(0)
    return np.log((behind + FEW_POINTS) / (HOLES * rest + FEW_POINTS)).clip(0)
