"""Which sparse points of the reconstruction each frame sees."""

from __future__ import annotations

import numpy as np

from reobj.cameras import Poses, undistort_boxes
from reobj.types import Array, IntArray


class VisiblePoints:
    """Index of the sparse points that each frame sees.

    A frame without observations of its own (between two keyframes, or without a depth map) is
    assumed to see what the nearest observing frames before and after it, of its component of the
    trajectory, observed. Occlusion is not tested: such a point may lie behind a nearer object.
    """

    def __init__(self, poses: Poses) -> None:
        self.poses = poses
        observer, self._point = np.unique(poses.visibility, axis=0).T  # (M,) rows each
        self._start = np.searchsorted(observer, np.arange(len(poses.frame) + 1))
        self._observers = np.flatnonzero(np.diff(self._start))  # frames with observations
        self._img_from_world = poses.camera.K @ poses.cam_from_world  # (F, 3, 4)

    def observed(self, row: int) -> IntArray:
        """Return the points that the frame in this row of the poses observed itself."""
        return np.asarray(self._point[self._start[row] : self._start[row + 1]], np.int64)

    def nearby(self, row: int) -> IntArray:
        """Return the points that a frame observed, else those of its neighbours, ascending.

        Neighbours' points may project outside the image of this frame (see `in_frame`).
        """
        if len(observed := self.observed(row)):
            return observed
        same_component = self.poses.part[self._observers] == self.poses.part[row]
        observers = self._observers[same_component]
        after = np.searchsorted(observers, row)
        sets = [self.observed(other) for other in observers[max(after - 1, 0) : after + 1]]
        return np.unique(np.concatenate([np.empty(0, np.int64), *sets]))

    def in_frame(self, row: int) -> IntArray:
        """Return the rows of the points in the image of a frame, ascending; none without a pose."""
        if not self.poses.known[row]:
            return np.empty(0, np.int64)
        points = self.nearby(row)
        if len(self.observed(row)):
            return points
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
        points = self.in_frame(row)
        boxes = undistort_boxes(xyxy, self.poses.camera)
        box, inside, depth = points_in_boxes(
            self.poses.points[points], self._img_from_world[row], boxes
        )
        return box, points[inside], depth


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
