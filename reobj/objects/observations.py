"""Input of the fit: boxes of groups of tracks in frames with a pose, and sparse points on them.

The caller decides which rows form a group: tracklet fragments before the association, identities
after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

import quadrics
from reobj.cameras import Poses, VisiblePoints, place_of, points_in_boxes, undistort_boxes
from reobj.types import Array, BoolArray, IntArray, Tracks, rows_by

# Boxes below this score, and interpolated boxes, do not enter the last fit (of the weakest boxes 1
# in 25 is real)
MIN_SCORE = 0.05


@dataclass(frozen=True, slots=True)
class Views:
    """Boxes of G groups in V frames with a pose, as `quadrics.fit_objects` takes them.

    Attributes:
        frame: (V,) source frames. boxes: (V, G, 4) xyxy in undistorted pixels, NaN where unseen.
        score: (V, G), 0 where unseen. img_from_world: (V, 3, 4) K @ cam_from_world.
        image_size: (w, h) px. occluded: (V, G, 4) edges of boxes caused by an occluder.
        points: (G, P, 3) sparse points that may lie on each group's object, padded with NaN.
    """

    frame: IntArray
    boxes: Array
    score: Array
    img_from_world: Array
    image_size: tuple[int, int]
    occluded: BoolArray | None = None
    points: Array | None = None


class Scene(NamedTuple):
    """Facts about a component of the trajectory, estimated before its objects are fitted.

    Attributes:
        floor: that objects may stand on. up: (3,) unit, against gravity, if the user gives none.
        scale: metres per unit; None: the poses are metric, or the fit estimates it.
        trusts_classes: never overrule a category. While the assignment of boxes is open, a box of
            an object part, or of two objects, must not be explained by another category.
    """

    floor: quadrics.Floor | None = None
    up: Array | None = None
    scale: quadrics.Scale | None = None
    trusts_classes: bool = False


# views of G groups, their classes, facts about the scene -> G fits
Fit = Callable[[Views, list[int], Scene], quadrics.ObjectFits]


def gather_views(
    table: Tracks, poses: Poses, groups: IntArray, count: int, min_score: float
) -> Views:
    """Arrange rows of tracks by frame with a pose and by group.

    Args:
        groups: (N,) group of each row of the table, 0 .. count - 1, one row per frame and group.
        min_score: rows below it, and rows of frames without a measured pose, are left out.
    """
    frame = poses.frame[poses.known]
    measured = poses.measured[poses.known]
    view_of = {int(frame[view]): int(view) for view in np.flatnonzero(measured)}
    view = np.array([view_of.get(f, -1) for f in table.frame.tolist()], np.int64)  # (N,)
    use = (view >= 0) & (table.score >= min_score)
    boxes = np.full((len(frame), count, 4), np.nan)
    score = np.zeros((len(frame), count))
    boxes[view[use], groups[use]] = undistort_boxes(table.xyxy[use], poses.camera)
    score[view[use], groups[use]] = table.score[use]
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (V, 3, 4)
    size = (poses.camera.width, poses.camera.height)
    return Views(frame, boxes, score, img_from_world, size)


# Least fraction of the views that observe a point in which it is inside the box: boxes are cut off
# where the object is occluded (.95 is alike: benchmarks/LOG.md)
INSIDE_FRACTION = 0.8
MIN_POINTS = 5  # per object (chosen: fewer may all belong to another object)


def points_on(
    views: Views, poses: Poses, ellipsoids: quadrics.Ellipsoids, max_points: int = 100
) -> Array:
    """Find the sparse points that may lie on the object of each group: inside most of its boxes.

    A point inside the boxes of several groups is assigned to the nearest ellipsoid, and of several
    that contain it to the smallest: to the cup rather than to the table.

    Args:
        ellipsoids: of the G groups, NaN where unknown.
        max_points: per object; more take more time.
    Returns:
        (G, P, 3), spread over the points of each group, padded with NaN.
    """
    group, point = _points_inside_most_boxes(views, poses)
    in_obj = np.einsum(
        "ki,kij->kj",
        poses.points[point] - ellipsoids.center_in_world[group],
        ellipsoids.world_from_obj[group],
    )
    half = ellipsoids.half_axes[group]
    width = half.mean(1)
    distance = np.linalg.norm((np.abs(in_obj) - half).clip(0), axis=1) / width
    order = np.lexsort((width, np.nan_to_num(distance, nan=np.inf), point))
    order = order[np.append(True, np.diff(point[order]) != 0)[: len(order)]]  # nearest group
    found = np.full((views.boxes.shape[1], max_points, 3), np.nan)
    for pairs in rows_by(group[order]):
        if len(pairs) >= MIN_POINTS:
            pairs = order[pairs[:: -(-len(pairs) // max_points)]]
            found[group[pairs[0]], : len(pairs)] = poses.points[point[pairs]]
    return found


def _points_inside_most_boxes(views: Views, poses: Poses) -> tuple[IntArray, IntArray]:
    """Return pairs of a group (K,) and a point (K,) that lies in most boxes of the group."""
    visible = VisiblePoints(poses)
    row, _ = place_of(poses, views.frame)
    shown = np.isfinite(views.boxes[..., 0])  # (V, G)
    inside = [np.empty((2, 0), np.int64)]  # groups and points
    observed = [np.empty((2, 0), np.int64)]  # views and points
    for v, camera in enumerate(views.img_from_world):
        points = visible.observed(row[v])
        groups = np.flatnonzero(shown[v])
        box, point, _ = points_in_boxes(poses.points[points], camera, views.boxes[v, groups])
        inside.append(np.stack([groups[box], points[point]]))
        observed.append(np.stack([np.full(len(points), v), points]))
    size = (shown.shape[1], len(poses.points))
    views_inside = _count_pairs(np.concatenate(inside, 1), size)  # (G, P)
    of_view = _count_pairs(np.concatenate(observed, 1), (len(shown), size[1]))  # (V, P)
    views_observing = sparse.csr_array(shown.T.astype(np.int64)) @ of_view  # (G, P)
    group, point = views_inside.nonzero()
    # csr_array: before scipy 1.14 fancy indexing returns a sparse array
    total = np.asarray(sparse.csr_matrix(views_observing)[group, point]).ravel()
    count = views_inside.data
    mostly = (count >= 2) & (count >= INSIDE_FRACTION * total)
    return group[mostly], point[mostly]


def _count_pairs(pairs: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    """Count pairs (2, K) of rows and columns."""
    return sparse.csr_array((np.ones(len(pairs[0]), np.int64), tuple(pairs)), shape)
