"""Boxes of groups of tracks in the frames that have a pose: the input of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reobj.cameras import Poses, undistort_boxes
from reobj.types import Array, IntArray, Tracks


@dataclass(frozen=True, slots=True)
class Views:
    """Boxes of G groups of track rows in V frames with poses: input of `quadrics.fit_objects`.

    Attributes:
        frame: (V,) source frames. boxes: (V, G, 4) undistorted pixels, NaN where unseen.
        score: (V, G). img_from_world: (V, 3, 4).
    """

    frame: IntArray
    boxes: Array
    score: Array
    img_from_world: Array
    image_size: tuple[int, int]


def gather_views(
    table: Tracks, poses: Poses, groups: IntArray, count: int, min_score: float
) -> Views:
    """Spread the track rows over frames and groups.

    Args:
        groups: (N,) group of each row of the table, 0 .. count - 1.
        min_score: rows below it are left out.
    """
    row_of_frame = {int(f): i for i, f in enumerate(poses.frame[poses.known])}
    view = np.array([row_of_frame.get(int(f), -1) for f in table.frame], np.int64)  # (N,)
    use = (view >= 0) & (table.score >= min_score)
    boxes = np.full((len(row_of_frame), count, 4), np.nan)
    score = np.zeros((len(row_of_frame), count))
    boxes[view[use], groups[use]] = undistort_boxes(table.xyxy[use], poses.camera)
    score[view[use], groups[use]] = table.score[use]
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (V, 3, 4)
    size = (poses.camera.width, poses.camera.height)
    return Views(poses.frame[poses.known], boxes, score, img_from_world, size)
