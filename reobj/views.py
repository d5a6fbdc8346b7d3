"""Boxes of groups of tracks in the frames that have a pose: the input of the fit.

Which rows make a group is decided by linking (tracklets) or by the identities (objects).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reobj.cameras import Poses, undistort_boxes
from reobj.types import Array, IntArray, Tracks


@dataclass(frozen=True, slots=True)
class Views:
    """Boxes of G groups in V frames with a pose, as `quadrics.fit_objects` takes them.

    Attributes:
        frame: (V,) source frames. boxes: (V, G, 4) xyxy in undistorted pixels, NaN where unseen.
        score: (V, G), 0 where unseen. img_from_world: (V, 3, 4) K @ cam_from_world.
        image_size: (w, h) px.
    """

    frame: IntArray
    boxes: Array
    score: Array
    img_from_world: Array
    image_size: tuple[int, int]


def gather_views(
    table: Tracks, poses: Poses, groups: IntArray, count: int, min_score: float
) -> Views:
    """Arrange rows of tracks by frame with a pose and by group.

    Args:
        groups: (N,) group of each row of the table, 0 .. count - 1, one row a frame and group.
        min_score: rows below it, and rows of frames without a pose, are left out.
    """
    view_of = {frame: view for view, frame in enumerate(poses.frame[poses.known].tolist())}
    view = np.array([view_of.get(frame, -1) for frame in table.frame.tolist()], np.int64)  # (N,)
    use = (view >= 0) & (table.score >= min_score)
    boxes = np.full((len(view_of), count, 4), np.nan)
    score = np.zeros((len(view_of), count))
    boxes[view[use], groups[use]] = undistort_boxes(table.xyxy[use], poses.camera)
    score[view[use], groups[use]] = table.score[use]
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (V, 3, 4)
    size = (poses.camera.width, poses.camera.height)
    return Views(poses.frame[poses.known], boxes, score, img_from_world, size)
