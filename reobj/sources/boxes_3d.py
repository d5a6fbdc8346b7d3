"""Detections with a box in 3D: CSV of Boxer, which WildDet3D writes too.

A row is a box in the world of the supplied cameras, seen in the frame of its time stamp. Its
projection is a detection like any other; the boxes themselves are measurements of the objects'
shapes (`objects.config`).

Ref: github.com/facebookresearch/boxer, utils/file_io.py (`ObbCsvWriter2`): z up, full extents,
quaternions w first.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Poses, distort_boxes
from reobj.formats import Probe
from reobj.sources.recorded import RecordedDetections, Source
from reobj.sources.tables import (
    Table,
    forms,
    nearest_times,
    read_columns,
    seconds,
    text_classes,
)
from reobj.sources.video import Video
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError, Tracks

BOXES_3D = (
    "tx_world_object ty_world_object tz_world_object qw_world_object qx_world_object "
    "qy_world_object qz_world_object scale_x scale_y scale_z"
).split()


@dataclass(frozen=True, slots=True)
class Boxes3D:
    """Boxes in the world of the cameras, each of one detection of a video.

    Attributes (N rows, by frame):
        frame: (N,) source frame numbers. detection_index: (N,) as in `Tracks`.
        box: (N, 15) centre (3), half extents (3) and rotation world_from_box (9, by rows).
        score: (N,) in [0, 1].
    """

    frame: IntArray
    detection_index: IntArray
    box: Array
    score: Array

    def of_rows(self, tracks: Tracks) -> IntArray:
        """Return the row of each detection (M,) of tracks; -1: it has no box in 3D."""
        keys = zip(self.frame.tolist(), self.detection_index.tolist(), strict=True)
        row_of = {key: row for row, key in enumerate(keys)}
        wanted = zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True)
        return np.array([row_of.get(key, -1) for key in wanted], np.int64)


def boxes_3d_of(recorded: RecordedDetections | None) -> Boxes3D | None:
    """Return the boxes in 3D of validated detections; None: they have none."""
    if recorded is None or not len(recorded.boxes_3d):
        return None
    index = np.arange(len(recorded)) - np.searchsorted(recorded.frame, recorded.frame)
    return Boxes3D(recorded.frame, index, recorded.boxes_3d, recorded.score)


def has_boxes_3d(path: Path) -> bool:
    """Test whether a file is a table of boxes in 3D."""
    return path.is_file() and "boxer-3d" in forms(Probe(path))


def read_cells(path: Path) -> Table:
    """Read a table of boxes in the world."""
    table = read_columns(path)
    role_of = {name: name for name in BOXES_3D}
    role_of |= {"time_ns": "time", "prob": "score", "name": "class"}
    if missing := [name for name in role_of if name not in table.cells]:
        text = f"3D boxes without the columns {', '.join(missing)}"
        raise ReobjError(f"{path}, line 1: {text}; expected those of Boxer's 3D boxes")
    table.cells = {role: table.cells[name] for name, role in role_of.items()}
    return table


def read_source_3d(source: Source) -> RecordedDetections:
    """Read boxes in 3D and project them to the frames of their time stamps.

    Raises:
        ReobjError: no cameras, an invalid value, or no box that is visible in its frame.
    """
    path = source.path
    video = source.video
    poses = source.poses
    if source.describes:
        source.times_s = seconds(read_cells(path))
        return source.recorded(np.empty(0, np.int64), np.empty((0, 4)), (np.empty(0, np.int64), ()))
    if poses is None:
        fault = "these are 3D boxes in the world, which need its cameras"
        raise ReobjError(f"{path}, line 1: {fault}: `run` with --detections and --poses FILE")
    table = read_cells(path)
    box = _boxes(table)
    time_s = seconds(table)
    frame, xyxy = _projected(box, time_s, poses, video)
    visible = np.isfinite(xyxy[:, 0])
    if len(box) and (frame < 0).all():
        span = f"{time_s.min():.3f} to {time_s.max():.3f} s"
        ours = _frame_times(poses, video)[1]
        raise ReobjError(f"{path}: no time stamp ({span}) is that of a frame with a pose "
                         f"({ours.min(initial=0):.3f} to {ours.max(initial=0):.3f} s)")  # fmt: skip
    if len(box) and not visible.any():
        raise ReobjError(f"{path}: no box is in the image of its frame: expected boxes in the "
                         "world of --poses, at the times of its frames")  # fmt: skip
    recorded = source.recorded(
        frame, xyxy, text_classes(table, source, COCO_NAMES), table.numbers("score"),
        line=table.line, unit=table.unit, boxes_3d=box,
    )  # fmt: skip
    without = (frame < 0).sum()
    if without:
        recorded.messages.append(f"{without} boxes at times without a frame with a pose left out")
    if hidden := (~visible & (frame >= 0)).sum():
        recorded.messages.append(f"{hidden} boxes outside the image of their frame left out")
    recorded.select(np.flatnonzero(visible))
    return recorded


def _boxes(table: Table) -> Array:
    """Return centre, half extents and rotation (N, 15) of the rows."""
    center, quat, size = (table.columns(roles)
                          for roles in (BOXES_3D[:3], BOXES_3D[3:7], BOXES_3D[7:]))  # fmt: skip
    bad = (size <= 0).any(1) | (np.abs(np.linalg.norm(quat, axis=1) - 1) > 0.01)
    if bad.any():
        row = int(bad.argmax())
        raise ReobjError(f"{table.where(row)}: extents {size[row]} and quaternion {quat[row]}, "
                         "expected extents above 0 and a quaternion of length 1")  # fmt: skip
    turn = np.empty((0, 3, 3))
    if len(quat):
        turn = Rotation.from_quat(np.roll(quat, -1, 1)).as_matrix()
    return np.hstack([center, size / 2, turn.reshape(-1, 9)])


def _frame_times(poses: Poses, video: Video) -> tuple[IntArray, Array]:
    """Return the frames with a pose and their times in s, ascending."""
    frame = poses.frame[poses.known]
    if video.times_s is not None:
        return frame, video.times_s[frame]
    return frame, poses.time_s[poses.known]


def _projected(box: Array, time_s: Array, poses: Poses, video: Video) -> tuple[IntArray, Array]:
    """Return the frames (N,), -1: none with a pose, and image bounds (N, 4), NaN: not visible."""
    frames, times_s = _frame_times(poses, video)
    nearest = nearest_times(times_s, time_s, 0.5)
    frame = np.where(nearest >= 0, frames[nearest] if len(frames) else -1, -1)
    xyxy = np.full((len(box), 4), np.nan)
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (F, 3, 4)
    solids = quadrics.Ellipsoids(box[:, :3], box[:, 3:6], box[:, 6:].reshape(-1, 3, 3))
    for k in np.unique(nearest[nearest >= 0]):
        rows = np.flatnonzero(nearest == k)
        xyxy[rows] = quadrics.solid_boxes(solids[rows], "box", img_from_world[k : k + 1])[0]
    size = (poses.camera.width, poses.camera.height)
    xyxy = quadrics.clip_boxes(distort_boxes(xyxy, poses.camera), size)
    return frame, xyxy * np.tile(np.divide(video.size, size), 2)
