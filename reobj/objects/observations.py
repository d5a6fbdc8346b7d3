"""What frames with a pose see: boxes of groups of tracks (the input of the fit), sparse points.

Which rows make a group is decided by linking (tracklets) or by the identities (objects).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

import quadrics
from reobj.cameras import Poses, place_of, undistort_boxes
from reobj.types import Array, BoolArray, IntArray, Tracks, rows_by


@dataclass(frozen=True, slots=True)
class Views:
    """Boxes of G groups in V frames with a pose, as `quadrics.fit_objects` takes them.

    Attributes:
        frame: (V,) source frames. boxes: (V, G, 4) xyxy in undistorted pixels, NaN where unseen.
        score: (V, G), 0 where unseen. img_from_world: (V, 3, 4) K @ cam_from_world.
        image_size: (w, h) px. hidden: (V, G, 4) edges of boxes where something nearer begins.
        points: (G, P, 3) sparse points that may lie on each group's thing, NaN: fewer.
    """

    frame: IntArray
    boxes: Array
    score: Array
    img_from_world: Array
    image_size: tuple[int, int]
    hidden: BoolArray | None = None
    points: Array | None = None


class Scene(NamedTuple):
    """What is known of a part before its objects are fitted.

    Attributes:
        floor: that things may stand on. up: (3,) unit, against gravity, where the user gives none.
        scale: metres per unit; None: the poses are metric, or the categories tell.
        trusts_classes: no category is overruled: while it is open which boxes are of an object,
            a part of it, or what two share, must not be explained as something else.
    """

    floor: quadrics.Floor | None = None
    up: Array | None = None
    scale: quadrics.Scale | None = None
    trusts_classes: bool = False


NOTHING_KNOWN = Scene()
# views of G groups, their classes, what is known besides -> G fits
Fit = Callable[[Views, list[int], Scene], quadrics.ObjectFits]


def gather_views(
    table: Tracks, poses: Poses, groups: IntArray, count: int, min_score: float
) -> Views:
    """Arrange rows of tracks by frame with a pose and by group.

    Args:
        groups: (N,) group of each row of the table, 0 .. count - 1, one row a frame and group.
        min_score: rows below it, and rows of frames without a measured pose, are left out.
    """
    seen, measured = poses.frame[poses.known], poses.measured[poses.known]
    view_of = {int(seen[view]): int(view) for view in np.flatnonzero(measured)}
    view = np.array([view_of.get(frame, -1) for frame in table.frame.tolist()], np.int64)  # (N,)
    use = (view >= 0) & (table.score >= min_score)
    boxes = np.full((len(seen), count, 4), np.nan)
    score = np.zeros((len(seen), count))
    boxes[view[use], groups[use]] = undistort_boxes(table.xyxy[use], poses.camera)
    score[view[use], groups[use]] = table.score[use]
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (V, 3, 4)
    size = (poses.camera.width, poses.camera.height)
    return Views(seen, boxes, score, img_from_world, size)


class VisiblePoints:
    """Index of the sparse points that each frame sees.

    A frame that observed none itself (between two keyframes, or without depth map) is taken to see
    what the nearest frames of its part before and after it observed, as far as that lies in its
    image. What hides in between is not known: such a point may lie behind something near.
    """

    def __init__(self, poses: Poses) -> None:
        self.poses = poses
        observer, self._point = np.unique(poses.visibility, axis=0).T  # (M,) rows each
        self._start = np.searchsorted(observer, np.arange(len(poses.frame) + 1))
        self._observers = np.flatnonzero(np.diff(self._start))  # frames that observed something
        self._img_from_world = poses.camera.K @ poses.cam_from_world  # (F, 3, 4)

    def observed(self, row: int) -> IntArray:
        """Return the points that the frame in this row of the poses observed itself."""
        return np.asarray(self._point[self._start[row] : self._start[row + 1]], np.int64)

    def in_frame(self, row: int) -> IntArray:
        """Return the rows of the points seen by the frame in this row of the poses, ascending."""
        if not self.poses.known[row]:
            return np.empty(0, np.int64)
        if len(own := self.observed(row)):
            return own
        of_part = self._observers[self.poses.part[self._observers] == self.poses.part[row]]
        after = np.searchsorted(of_part, row)
        found = [self.observed(other) for other in of_part[max(after - 1, 0) : after + 1]]
        points = np.unique(np.concatenate([np.empty(0, np.int64), *found]))
        size = (self.poses.camera.width, self.poses.camera.height)
        image = np.array([[0.0, 0.0, *size]])
        _, inside, _ = points_in_boxes(self.poses.points[points], self._img_from_world[row], image)
        return points[inside]

    def in_boxes(self, row: int, xyxy: Array) -> tuple[IntArray, IntArray, Array]:
        """Find the points that a frame sees inside boxes.

        Args:
            row: of the frame in the poses. xyxy: (D, 4) boxes in native pixels.
        Returns:
            one entry for each of K pairs of a box and a point in it, by box: rows of the boxes
            (K,) and of the points (K,), depth (K,) of the point in the frame's camera.
        """
        points, boxes = self.in_frame(row), undistort_boxes(xyxy, self.poses.camera)
        inside = points_in_boxes(self.poses.points[points], self._img_from_world[row], boxes)
        return inside[0], points[inside[1]], inside[2]


def points_in_boxes(
    points: Array, img_from_world: Array, xyxy: Array
) -> tuple[IntArray, IntArray, Array]:
    """Find the points in front of a camera that project into boxes.

    Args:
        points: (N, 3) in world. img_from_world: (3, 4) K @ cam_from_world of a pinhole camera.
        xyxy: (D, 4) undistorted boxes in its pixels; NaN: none.
    Returns:
        one entry for each of K pairs of a box and a point in it, by box: rows of the boxes (K,)
        and of the points (K,), depth (K,) of the point along the optical axis, in world units.
    """
    projected = points @ img_from_world[:, :3].T + img_from_world[:, 3]  # (N, 3)
    depth = projected[:, 2]
    xy = projected[:, :2] / np.where(depth > 0, depth, np.nan)[:, None]  # (N, 2)
    boxes = xyxy[:, None]  # (D, 1, 4)
    inside = ((xy >= boxes[..., :2]) & (xy <= boxes[..., 2:])).all(2)  # (D, N)
    box, point = np.nonzero(inside)
    return box, point, depth[point]


INSIDE_SHARE = 0.8  # of the views that observe a point (chosen; .95 is alike: docs/trials.md)
POINT_VIEWS = 2  # and so many (one view tells no distance)
MIN_POINTS, MAX_POINTS = 5, 100  # of a thing (chosen: fewer may all be of something else; time)


def points_on(views: Views, poses: Poses, solids: quadrics.Ellipsoids) -> Array:
    """Find the points that may lie on the thing of each group: inside most of its boxes.

    Where that holds for several groups, the point is of the one whose solid is nearest to it, of
    those that hold it the smallest: the cup's and not the table's.

    Args:
        solids: of the G groups as far as they are known, else NaN.
    Returns:
        (G, P, 3), spread over the points of each group, NaN where there are no more.
    """
    visible, row = VisiblePoints(poses), place_of(poses, views.frame)[0]
    shown = np.isfinite(views.boxes[..., 0])  # (V, G)
    inside, observed = ([np.empty((2, 0), np.int64)] for _ in range(2))  # rows and columns
    for v, camera in enumerate(views.img_from_world):
        own, group = visible.observed(row[v]), np.flatnonzero(shown[v])
        box, point, _ = points_in_boxes(poses.points[own], camera, views.boxes[v, group])
        inside.append(np.stack([group[box], own[point]]))
        observed.append(np.stack([np.full(len(own), v), own]))
    size = (shown.shape[1], len(poses.points))
    views_inside = _counted(np.concatenate(inside, 1), size)
    of_view = _counted(np.concatenate(observed, 1), (len(shown), size[1]))
    seen = sparse.csr_array(shown.T.astype(np.int64)) @ of_view  # (G, P) views that observe it
    group, point = views_inside.nonzero()
    count = views_inside.data
    # of an array, scipy before 1.14 makes a sparse one of these
    every = np.asarray(sparse.csr_matrix(seen)[group, point]).ravel()
    mostly = (count >= POINT_VIEWS) & (count >= INSIDE_SHARE * every)
    group, point = group[mostly], point[mostly]
    at = np.einsum(
        "ki,kij->kj",
        poses.points[point] - solids.center_in_world[group],
        solids.world_from_obj[group],
    )
    half = solids.half_axes[group]
    width = half.mean(1)
    away = np.linalg.norm((np.abs(at) - half).clip(0), axis=1) / width
    order = np.lexsort((width, np.nan_to_num(away, nan=np.inf), point))
    order = order[np.append(True, np.diff(point[order]) != 0)[: len(order)]]  # the nearest of each
    found = np.full((size[0], MAX_POINTS, 3), np.nan)
    for own in rows_by(group[order]):
        if len(own) >= MIN_POINTS:
            own = order[own[:: -(-len(own) // MAX_POINTS)]]
            found[group[own[0]], : len(own)] = poses.points[point[own]]
    return found


def _counted(pairs: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    """Count pairs (2, K) of rows and columns."""
    return sparse.csr_array((np.ones(len(pairs[0]), np.int64), tuple(pairs)), shape)
