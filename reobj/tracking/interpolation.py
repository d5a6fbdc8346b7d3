"""Interpolation of track gaps after the video: by projected objects, else by smoothing (filterpy).

Interpolated boxes are not detections: their score is 0, and neither the fit nor the linker uses
them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, distort_boxes
from reobj.tracking.ellipsoid_map import EXPECTED_IN_VIEW
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

# Noise of the constant-velocity model of boxes, in the online filter and in the smoother: standard
# deviations, relative to the size of the box, as in DeepSORT's filter.
# of a measured box (of score .8, in the online filter), and process noise of a position, per frame
# (DeepSORT: one weight for both, 1/20)
STD_POSITION = 0.05
# process noise of a velocity, per frame (DeepSORT: 1/160; without images and poses the camera's
# motion is in it too)
STD_VELOCITY = 1 / 80
# of a new track's velocity (DeepSORT: 1/16; SORT: nearly unknown); higher: the second box of an
# object may be farther from the first, and then also be a neighbour's
STD_START = 0.2


# ---- Interpolation -------------------------------------------------------------------------------


def fill_gaps(
    tracks: Tracks,
    image_size: tuple[int, int],
    max_gap: int,
    looked: IntArray | None = None,
    min_iou: float = 0.3,
) -> Tracks:
    """Interpolate gaps of at most `max_gap` frames between two detections of an identity.

    Args:
        tracks: of a video, in frames that were all read. image_size: (w, h) that boxes stay in.
        looked: frames that the detector was run on, the only ones that count and are filled;
            None: all that were read.
        min_iou: of the boxes at both ends; less: too much motion to interpolate (not measured).
    Returns:
        the tracks with rows of score 0 and detection index -1 in the gaps, ordered by frame.
    """
    tables = [tracks]
    step = frame_step(tracks.frame if looked is None else looked)
    number, unit = looks(tracks, looked)
    for identity in np.unique(tracks.track_id):
        of_identity = tracks.track_id == identity
        rows = tracks[of_identity]
        between = np.diff(rows.frame) // step - 1  # (n - 1,) frames after each row
        missed = np.diff(number[of_identity]) // unit - 1  # of them the detector was run on
        for i in np.flatnonzero((missed > 0) & (missed <= max_gap)):
            if box_iou(rows.xyxy[i : i + 1], rows.xyxy[i + 1 : i + 2])[0, 0] < min_iou:
                continue
            # 10 frames on either side; with 40 boxes move by 1.3 px at most
            window = np.abs(rows.frame - rows.frame[i]) <= (10 + between[i]) * step
            at = (rows.frame[window] - rows.frame[window][0]) // step
            box = smooth_boxes(at, rows.xyxy[window])  # (F, 4) of every frame of the window
            frame = rows.frame[i] + step * np.arange(1, between[i] + 1)
            frame = frame if looked is None else np.intersect1d(frame, looked)
            filled = box[(frame - rows.frame[window][0]) // step]
            filled = filled.clip(0, np.tile(image_size, 2))
            one = np.ones(len(frame), np.int64)
            ids = (one * identity, one * rows.tracklet_id[i])
            tables.append(
                Tracks(frame, *ids, filled, np.zeros(len(frame)), one * rows.class_id[i], -one)
            )
    return Tracks.joined(tables)


def fill_from_objects(
    tracks: Tracks,
    poses: Poses,
    identity: IntArray,
    ellipsoids: quadrics.Ellipsoids,
    support: list[str],
    max_angle_deg: float = 10.0,
    max_distance_ratio: float = 1.25,
    min_inside: float = 0.8,
    sources: IntArray | None = None,
) -> Tracks:
    """Add projected boxes in frames without a detection if a nearby view has one.

    The scene is static: an object visible from a nearby viewpoint is visible here as well. Only
    detections that agree with the projection count.

    Args:
        poses: of one component. identity: (O,) of the objects, which lie in that component.
        max_angle_deg, max_distance_ratio: a camera this near to another has the same view of an
            object: angle at the object, ratio of the distances. Chosen on hololens_kitchen,
            redkitchen and office_loop: up to 25 deg and 2 times the distance are as good where no
            walls occlude; without limits the IDF1 of office_loop falls from .420 to .318
            (benchmarks/RESULTS.md, "Gaps filled by projection").
        min_inside: least fraction of a detection inside the projected object: it may be half
            occluded, but not extend beyond the projection (chosen on hololens_kitchen and
            office_loop).
        sources: (K,) frames whose detections are tried; None: all.
    Returns:
        the tracks with rows of score 0 and detection index -1, ordered by frame.
    """
    frame = poses.frame[poses.known]  # (V,)
    size = (poses.camera.width, poses.camera.height)
    cam_from_world = poses.cam_from_world[poses.known]
    cams = poses.camera.K @ cam_from_world
    center = -np.einsum("vij,vi->vj", cam_from_world[:, :, :3], cam_from_world[:, :, 3])
    tables = [tracks]
    for o, track_id in enumerate(identity.tolist()):
        whole = quadrics.solid_boxes(ellipsoids[[o]], [support[o]], cams)[:, 0]
        inside = box_area(quadrics.clip_boxes(whole, size))
        visible = inside > EXPECTED_IN_VIEW * box_area(whole)  # False where NaN
        box = np.full_like(whole, np.nan)  # (V, 4)
        shown = inside > 0
        box[shown] = quadrics.clip_boxes(distort_boxes(whole[shown], poses.camera), size)
        visible &= np.isfinite(box[:, 0])
        rows = tracks[(tracks.track_id == track_id) & np.isin(tracks.frame, frame)]  # (n,)
        empty = np.setdiff1d(np.flatnonzero(visible), np.searchsorted(frame, rows.frame))  # (T,)
        rows = rows if sources is None else rows[np.isin(rows.frame, sources)]
        view = np.searchsorted(frame, rows.frame)
        low, high = np.split(box[view], 2, axis=1)
        common = (np.minimum(rows.xyxy[:, 2:], high) - np.maximum(rows.xyxy[:, :2], low)).clip(0)
        agrees = common.prod(1) > min_inside * box_area(rows.xyxy)
        rows = rows[agrees]
        view = view[agrees]
        if not (len(rows) and len(empty)):
            continue
        ray = center - ellipsoids.center_in_world[o]  # (V, 3)
        distance = np.linalg.norm(ray, axis=1)
        direction = ray / distance[:, None]
        nearest = np.empty((2, len(empty)))  # row and change of the most similar view
        for block in np.array_split(np.arange(len(empty)), len(empty) // 1024 + 1):  # memory
            angle = np.arccos((direction[empty[block]] @ direction[view].T).clip(-1, 1))  # (t, n)
            log_ratio = np.abs(np.log(distance[empty[block], None] / distance[view]))
            change = np.maximum(
                angle / np.radians(max_angle_deg), log_ratio / np.log(max_distance_ratio)
            )
            nearest[:, block] = change.argmin(1), change.min(1)
        near = nearest[1] < 1
        filled = empty[near]
        source = rows[nearest[0, near].astype(np.int64)]
        one = np.ones(len(filled), np.int64)
        tables.append(
            Tracks(
                frame[filled], source.track_id, source.tracklet_id, box[filled],
                np.zeros(len(filled)), source.class_id, -one,
            )
        )  # fmt: skip
    return Tracks.joined(tables)


def smooth_boxes(at: npt.NDArray[np.int64], xyxy: Array) -> Array:
    """Smooth boxes (n, 4) of frames (n,), ascending from 0, with a constant-velocity model.

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
    kalman.R = np.eye(4) * (STD_POSITION * side) ** 2
    kalman.Q = np.diag(np.repeat([STD_POSITION * side, STD_VELOCITY * side], 4) ** 2)
    kalman.P = np.diag(np.repeat([STD_POSITION * side, STD_START * side], 4) ** 2)
    kalman.x = np.concatenate([box[0], np.zeros(4)])[:, None]
    mean, cov, _, _ = kalman.batch_filter(measured)
    smoothed = kalman.rts_smoother(mean, cov)[0]  # (F, 8, 1)
    return xyxy_from_cxcywh(np.asarray(smoothed[:, :4, 0], np.float64))
