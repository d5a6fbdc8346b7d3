"""Gaps of tracks, filled after the video: by the objects' solids, else by smoothing (filterpy).

The tracker cannot know what comes; afterwards both ends of a gap are known, and where the object
is. Filled boxes are no detections: their score is 0, and neither fit nor linker sees them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses
from reobj.types import (
    Array,
    IntArray,
    Tracks,
    box_area,
    box_iou,
    cxcywh_from_xyxy,
    frame_step,
    looks,
    xyxy_from_cxcywh,
)

MIN_END_IOU = 0.3  # overlap of the boxes at both ends; less: it moved too far to say where it was
WINDOW = 10  # frames on either side that the smoother reads; with 40 boxes move by 1.3 px at most
# over the box's mean side, as in the tracker (DeepSORT: 1/20, 1/160, 1/20, 1/16)
STD_POSITION, STD_VELOCITY, STD_MEASURE, STD_START = 0.05, 1 / 80, 0.05, 0.2


def fill_gaps(
    tracks: Tracks, image_size: tuple[int, int], max_gap: int, looked: IntArray | None = None
) -> Tracks:
    """Fill gaps of at most `max_gap` frames between two detections of an identity.

    Args:
        tracks: of a video, in frames that were all read. image_size: (w, h) that boxes stay in.
        looked: frames that the detector was run on, the only ones that count and are filled;
            None: all that were read.
    Returns:
        the tracks with rows of score 0 and detection index -1 in the gaps, ordered by frame.
    """
    parts = [tracks]
    step = frame_step(tracks.frame if looked is None else looked)
    number, unit = looks(tracks, looked)
    for identity in np.unique(tracks.track_id):
        own = tracks.track_id == identity
        rows = tracks[own]
        between = np.diff(rows.frame) // step - 1  # (n - 1,) frames after each row
        missed = np.diff(number[own]) // unit - 1  # of them looked at
        for i in np.flatnonzero((missed > 0) & (missed <= max_gap)):
            if box_iou(rows.xyxy[i : i + 1], rows.xyxy[i + 1 : i + 2])[0, 0] < MIN_END_IOU:
                continue
            window = np.abs(rows.frame - rows.frame[i]) <= (WINDOW + between[i]) * step
            at = (rows.frame[window] - rows.frame[window][0]) // step
            box = smooth_boxes(at, rows.xyxy[window])  # (F, 4) of every frame of the window
            frame = rows.frame[i] + step * np.arange(1, between[i] + 1)
            frame = frame if looked is None else np.intersect1d(frame, looked)
            filled = box[(frame - rows.frame[window][0]) // step]
            filled = filled.clip(0, np.tile(image_size, 2))
            one = np.ones(len(frame), np.int64)
            ids = (one * identity, one * rows.tracklet_id[i])
            parts.append(
                Tracks(frame, *ids, filled, np.zeros(len(frame)), one * rows.class_id[i], -one)
            )
    return Tracks.joined(parts)


MIN_VISIBLE = 0.5  # share of the projected solid in the image that makes a box (chosen)
# A camera that is as near to another as this sees the same parts of a thing: at the thing, and of
# the log of the distance. Chosen on hololens_kitchen, redkitchen and office_loop: up to 25 deg and
# 2 times the distance are as good where nothing hides the rooms from each other.
SAME_ANGLE, SAME_LOG_DISTANCE = np.radians(10.0), np.log(1.25)
# Share of a detection that lies in the projection, so that this tells where the thing is there: it
# may be half hidden, but not stick out (chosen on hololens_kitchen and office_loop)
WITHIN = 0.8


def fill_by_place(
    tracks: Tracks,
    poses: Poses,
    identity: IntArray,
    solids: quadrics.Ellipsoids,
    support: list[str],
) -> Tracks:
    """Add the boxes of projected solids where no detection is, if one was from about there.

    Neither things nor what hides them moves: what was seen from near a camera is seen by it too.
    Only detections that the projection explains count.

    Args:
        poses: of one part. identity: (O,) of the solids, which lie in that part.
    Returns:
        the tracks with rows of score 0 and detection index -1, ordered by frame.
    """
    frame = poses.frame[poses.known]  # (V,)
    size = (poses.camera.width, poses.camera.height)
    cam_from_world = poses.cam_from_world[poses.known]
    whole = quadrics.solid_boxes(solids, support, poses.camera.K @ cam_from_world)
    box = quadrics.clip_boxes(whole, size)  # (V, O, 4)
    visible = box_area(box) > MIN_VISIBLE * box_area(whole)  # False where NaN
    center = -np.einsum("vij,vi->vj", cam_from_world[:, :, :3], cam_from_world[:, :, 3])
    ray = center[:, None] - solids.center_in_world  # (V, O, 3)
    distance = np.linalg.norm(ray, axis=2)
    made = [tracks]
    for i, own in enumerate(identity.tolist()):
        rows = tracks[(tracks.track_id == own) & np.isin(tracks.frame, frame)]  # (n,)
        at = np.searchsorted(frame, rows.frame)
        to = np.setdiff1d(np.flatnonzero(visible[:, i]), at)  # (T,) views without a detection
        low, high = np.split(box[at, i], 2, axis=1)
        common = (np.minimum(rows.xyxy[:, 2:], high) - np.maximum(rows.xyxy[:, :2], low)).clip(0)
        explained = common.prod(1) > WITHIN * box_area(rows.xyxy)
        rows, at = rows[explained], at[explained]
        if not (len(rows) and len(to)):
            continue
        toward = ray[:, i] / distance[:, i, None]
        angle = np.arccos((toward[to] @ toward[at].T).clip(-1, 1)) / SAME_ANGLE  # (T, n)
        farther = np.log(distance[to, None, i] / distance[at, i]) / SAME_LOG_DISTANCE
        change = np.maximum(angle, np.abs(farther))
        to, like = to[change.min(1) < 1], rows[change.argmin(1)[change.min(1) < 1]]
        ids, one = (like.track_id, like.tracklet_id), np.ones(len(to), np.int64)
        made.append(Tracks(frame[to], *ids, box[to, i], np.zeros(len(to)), like.class_id, -one))
    return Tracks.joined(made)


def smooth_boxes(at: npt.NDArray[np.int64], xyxy: Array) -> Array:
    """Smooth boxes (n, 4) seen at frames (n,), ascending from 0, with a constant-velocity model.

    Returns:
        (F, 4) boxes of all frames from the first to the last.
    Ref: Rauch, Tung and Striebel, AIAA Journal 1965.
    """
    from filterpy.kalman import KalmanFilter  # brings scipy.stats: .4 s

    box = cxcywh_from_xyxy(xyxy)
    side = float(np.median(np.sqrt(box[:, 2] * box[:, 3])))
    measured: list[Array | None] = [None] * (int(at[-1]) + 1)
    for frame, z in zip(at.tolist(), box, strict=True):
        measured[frame] = z[:, None]
    kalman = KalmanFilter(dim_x=8, dim_z=4)  # cx, cy, w, h and their velocities
    kalman.F = np.eye(8) + np.eye(8, k=4)
    kalman.H = np.eye(4, 8)
    kalman.R = np.eye(4) * (STD_MEASURE * side) ** 2
    kalman.Q = np.diag(np.repeat([STD_POSITION * side, STD_VELOCITY * side], 4) ** 2)
    kalman.P = np.diag(np.repeat([STD_MEASURE * side, STD_START * side], 4) ** 2)
    kalman.x = np.concatenate([box[0], np.zeros(4)])[:, None]
    mean, cov, _, _ = kalman.batch_filter(measured)
    smoothed = kalman.rts_smoother(mean, cov)[0]  # (F, 8, 1)
    return xyxy_from_cxcywh(np.asarray(smoothed[:, :4, 0], np.float64))
