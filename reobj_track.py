#!/usr/bin/env python3
"""reobj_track: objects of a hand-held video: which detections are the same one, and where each is.

    python reobj_track.py run VIDEO -o OUT        # identities, cameras, one 3D ellipsoid per object
    python reobj_track.py run VIDEO -o OUT --detections det.txt --poses colmap_model/
    python reobj_track.py --help

    import reobj_track as rt
    tracker = rt.Tracker()
    for frame in rt.Video("room.mp4"):
        tracks = tracker.update(detector(frame.image), frame.image)

How it works (start reading at `run()`, then `Tracker.update()`):
  1. detect    boxes, scores, classes and masks of every frame: an ONNX model, a file, or a callable
  2. embed     one feature map a frame, pooled under each object and around it
  3. predict   constant-velocity Kalman filter, moved along with the camera's own motion
  4. associate gate by motion, then one cost from overlap and appearance; high scores first; objects
               that come back are recognised from a gallery that never expires
  5. poses     keyframes -> pycolmap -> PnP for the frames between; or poses supplied by the user
  6. link      tracklets that explain the same place in 3D become one object, or are split again
  7. fit       one solid and its ellipsoid per object from its boxes and a size prior (quadrics.py)

Conventions: frames 0-based (1-based in MOT files); boxes `xyxy` in pixels, the top-left pixel spans
[0, 1] and has its centre at (0.5, 0.5) as in COLMAP; `b_from_a` maps coordinates in a to b;
cameras are `cam_from_world`, x right, y down, z forward; quaternions carry their order in the name.

References: re-OBJ (Bansal et al., ICIAP 2019), PSfMO (Gay et al., ICCV 2017), LfD (Rubino et al.,
PAMI 2018), SORT (Bewley et al., ICIP 2016), DeepSORT (Wojke et al., ICIP 2017), ByteTrack (Zhang et
al., ECCV 2022), BoT-SORT (Aharon et al., 2022), COLMAP (Schoenberger and Frahm, CVPR 2016).
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import logging
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

import quadrics
from reobj import __version__
from reobj.cameras import Camera, Poses, load_poses, save_poses, scaled_camera, viewing_rays
from reobj.files import Progress, atomic, load_npz, save_npz
from reobj.identity.camera_motion import CameraMotion
from reobj.identity.crops import CropEmbedder
from reobj.identity.embedding import EmbedConfig, Embedder, LazyEmbeddings, as_embeddings
from reobj.identity.linking import Linker
from reobj.identity.reid import (
    EllipsoidMap,
    Gallery,
    SimilarityCalibration,
    match_probability,
    part_cosines,
)
from reobj.objects import ObjectsConfig, fitter, object_entries, world_entry
from reobj.poses.checks import check_poses
from reobj.poses.estimate import PosesConfig, estimate_poses
from reobj.poses.readers import read_poses
from reobj.results.evaluation import evaluate, score_table
from reobj.results.export import EXPORTS, export
from reobj.results.overlay import Overlay
from reobj.results.scene import Pictures, write_scene
from reobj.results.workspace import (
    RunResult,
    Workspace,
    summary,
    validate_objects,
    write_cameras,
    write_mot,
    write_objects_json,
    write_ply,
)
from reobj.sources.detection_files import (
    DetectConfig,
    TrackResult,
    read_detections,  # noqa: F401
    read_tracks,
)
from reobj.sources.detectors import DetectionSource, OnnxDetector, open_detections  # noqa: F401
from reobj.sources.recorded import write_detections_npz  # noqa: F401
from reobj.sources.video import InputConfig, Video, source_fingerprint
from reobj.sources.weights import list_models, model_path
from reobj.types import (
    COCO_NAMES,  # noqa: F401
    Array,
    BoolArray,
    Detections,
    Embeddings,
    Floats,
    Frame,
    Image,
    IntArray,
    ReobjError,
    Tracks,
    as_detections,
    box_iou,
    cxcywh_from_xyxy,
    log,
    object_classes,
    option,
    rows_by,
    unit_rows,
    widen,
    xyxy_from_cxcywh,
)
from reobj.views import gather_views

# ---- Configuration: the only home of numbers ---------------------------------------------------


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Tracking and re-identification."""

    high_score: float = option(
        0.4, "first association round: detections of at least this score", "--high-score"
    )
    low_score: float = option(0.1, "second round: of at least this score (ByteTrack)")
    new_score: float = option(0.5, "a new track needs this score")
    n_init: int = option(
        3, "detections before a new object gets its identity (DeepSORT); a return needs one less"
    )
    coast_frames: int = option(30, "frames a track is predicted without a detection", "--coast")
    remember: bool = option(True, "recognise objects that return, however long they were away")
    std_position: float = option(
        0.05, "process noise of a position over the box size (DeepSORT: 1/20)"
    )
    std_velocity: float = option(
        1 / 80, "process noise of a velocity over the box size (DeepSORT: 1/160)"
    )
    class_cost: float = option(
        0.2, "added to the cost, and taken off the overlap in doubt, when the class differs"
    )
    appearance_weight: float = option(0.7, "share of appearance in the cost of doubtful matches")
    foreground_weight: float = option(0.5, "share of the foreground in the appearance")
    embed_every: int = option(10, "refresh the appearance of a track after this many frames")
    return_probability: float = option(
        0.5, "recognise a return from this probability on, rivals and a new object considered"
    )
    camera_motion: bool = option(True, "compensate the camera's motion from sparse optical flow")


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """Files written."""

    overlay: bool = option(True, "write overlay.mp4")
    scene: bool = option(True, "write scene.html")


@dataclass(frozen=True, slots=True)
class Config:
    """All options; sections are set by `--set section.field=value` on the command line."""

    input: InputConfig = field(default_factory=InputConfig)
    detect: DetectConfig = field(default_factory=DetectConfig)
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    poses: PosesConfig = field(default_factory=PosesConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    threads: int = option(0, "threads of onnxruntime, OpenCV and numpy (0: all cores)", "--threads")
    offline: bool = option(False, "never download weights", "--offline")


# ---- Motion: Kalman filter and camera motion ---------------------------------------------------


def kalman_predict(mean: Array, cov: Array, config: TrackerConfig) -> tuple[Array, Array]:
    """Predict all tracks by one frame with a constant-velocity model.

    The state is (cx, cy, w, h) and its velocity. F, H, Q and R do not couple the four coordinates,
    so the 8x8 covariance falls into four symmetric 2x2 blocks: equal to filterpy's filter, at a
    fraction of the cost.

    Args:
        mean: (T, 4, 2) position and velocity, px and px/frame.
        cov: (T, 4, 3) variances p00 (position), p01, p11 (velocity).
    Returns:
        mean, cov after x = F x, P = F P F' + Q.
    Ref: noise relative to the box size as in DeepSORT (Wojke et al., ICIP 2017).
    """
    scale = _noise_scale(mean)  # (T, 4)
    p00, p01, p11 = np.moveaxis(cov, -1, 0)  # (T, 4) each
    q0, q1 = (config.std_position * scale) ** 2, (config.std_velocity * scale) ** 2
    new_cov = np.stack([p00 + 2 * p01 + p11 + q0, p01 + p11, p11 + q1], -1)  # (T, 4, 3)
    new_mean = np.stack([mean[..., 0] + mean[..., 1], mean[..., 1]], -1)  # (T, 4, 2)
    return new_mean, new_cov


def kalman_update(mean: Array, cov: Array, box: Array, noise: Array) -> tuple[Array, Array]:
    """Correct tracks with measured boxes.

    Args:
        mean, cov: as in `kalman_predict`.
        box: (T, 4) measured cx, cy, w, h.
        noise: (T, 4) standard deviation of the measurement, px.
    Returns:
        mean, cov after K = P H' / S, x = x + K y, P = (I - K H) P.
    """
    p00, p01, p11 = np.moveaxis(cov, -1, 0)
    innovation_var = p00 + noise**2  # S (T, 4)
    k0, k1 = p00 / innovation_var, p01 / innovation_var  # K (T, 4)
    residual = box - mean[..., 0]  # y (T, 4)
    new_mean = np.stack([mean[..., 0] + k0 * residual, mean[..., 1] + k1 * residual], -1)
    new_cov = np.stack([(1 - k0) * p00, (1 - k0) * p01, p11 - k1 * p01], -1)
    return new_mean, new_cov


def _noise_scale(mean: Array) -> Array:
    """Length that noise is relative to, (T, 4): the box's mean side for x, y and its own side for
    w, h.
    """
    size = mean[:, 2:, 0].clip(1.0)  # (T, 2)
    side = np.sqrt(size.prod(1, keepdims=True))  # (T, 1)
    return np.concatenate([side, side, size], 1)


def _warp_state(mean: Array, cov: Array, new_from_old: Array) -> tuple[Array, Array]:
    """Move tracks along with the camera: positions by the homography, sizes and velocities by its
    scale.
    """
    x, y = mean[:, 0, 0], mean[:, 1, 0]  # (T,)
    points = np.stack([x, y, np.ones_like(x)], 1) @ new_from_old.T  # (T, 3)
    depth = np.where(np.abs(points[:, 2]) < 1e-6, 1e-6, points[:, 2])  # (T,)
    det = np.linalg.det(new_from_old)
    scale = np.sqrt(np.abs(det / depth**3)).clip(
        0.5, 2.0
    )  # (T,) of the local Jacobian of the homography
    warped = mean * scale[:, None, None]  # (T, 4, 2)
    warped[:, :2, 0] = points[:, :2] / depth[:, None]
    return warped, cov * scale[:, None, None] ** 2


# ---- Tracker -----------------------------------------------------------------------------------


STATE_VERSION = 2  # of the files of Tracker.save


STD_START = 0.2  # spread of a new track's velocity over the box size (DeepSORT: 1/16; SORT: wide)


@dataclass(slots=True)
class _Live:
    """State of the live tracks, one row a track (T rows)."""

    mean: Array  # (T, 4, 2) cx, cy, w, h and velocities
    cov: Array  # (T, 4, 3)
    tracklet: IntArray  # (T,)
    identity: IntArray  # (T,) index of the identity, -1 while tentative
    hits: IntArray  # (T,) frames with a detection
    missed: IntArray  # (T,) frames since the last one
    first: IntArray  # (T,) frame of birth
    embedded: IntArray  # (T,) frame of the last embedding
    votes: Array  # (T, C) score sums of the classes
    look: Floats  # (T, E) running mean of the embeddings

    def select(self, keep: npt.NDArray[Any]) -> _Live:
        return _Live(*(getattr(self, f.name)[keep] for f in dataclasses.fields(self)))

    def append(self, other: _Live) -> _Live:
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))
        return _Live(*(np.concatenate([widen(a, b), widen(b, a)]) for a, b in pairs))

    @staticmethod
    def born(box: Array, tracklet: IntArray, frame: int, config: TrackerConfig) -> _Live:
        """New tentative tracks from boxes cx, cy, w, h (N, 4); initial spread as in DeepSORT (2 x
        and 10 x).
        """
        n = len(box)
        mean = np.stack([box, np.zeros_like(box)], -1)
        scale = _noise_scale(mean)
        cov = np.stack(
            [
                (2 * config.std_position * scale) ** 2,
                0 * scale,
                (STD_START * scale) ** 2,
            ],
            -1,
        )
        zero, one = np.zeros(n, np.int64), np.ones(n, np.int64)
        return _Live(
            mean,
            cov,
            tracklet,
            zero - 1,
            one - 1,
            zero,
            zero + frame,
            zero - 1,
            np.zeros((n, 1)),
            np.zeros((n, 0), np.float32),
        )


STD_MEASURE = 0.05  # measurement noise over the box size at score .8 (DeepSORT: 1/20)
SCORE_NOISE = 0.25  # and how it grows with doubt, (1 - score) to this power (StrongSORT: 1)
GATE_CHI2 = 9.2103  # gate on the centre's squared Mahalanobis distance (chi2 .99, 2 dof)
GATE_IOU = 0.2  # overlap that passes the gate by itself
MOTION_ONLY_IOU = 0.1  # overlap needed by all where there is no look to compare
MOTION_ONLY_SIZE = 2.0  # and most that width or height may differ then, as a factor
LOW_IOU = 0.3  # overlap needed for low scores and for a change of class
MAX_COST = 0.9  # most that an accepted match may cost (0: perfect, 1: at the gate)
DISTANCE_WEIGHT = 0.2  # share of the distance in the cost, the rest is overlap
AGE_COST = 0.2  # added for tracks not seen for 10 frames, in proportion before
UNCONFIRMED_COST = 0.2  # added for tracks that are not confirmed yet
AMBIGUITY_MARGIN = 0.3  # a match is doubtful where a rival costs less than this more
WEAK_MATCH_COST = 0.5  # and where it costs more than this: perhaps a new object
# log odds that the look must give a doubtful match of boxes that do not overlap
NO_OVERLAP_ODDS = 6.0
IOU_ODDS = 20.0  # log odds that full overlap is worth
EMBEDDING_MOMENTUM = 0.8  # memory of a track's running mean appearance (StrongSORT: .9 every frame)
RETURN_ODDS = 1.8  # odds beforehand that a newcomer is a certain known object and not a new one
JUMP_ODDS = 2.0  # log odds against a return far from where the object's own track still coasts
PRIOR_PAIRS = (
    10.0  # pairs that the usual looks of one and of two objects are worth (SimilarityCalibration)
)
PLACE_REFIT = 10  # places are fitted again every so many frames, where views are new
PLACE_IN_VIEW = 0.5  # a detection is expected from this share of a box in view on


class Tracker:
    """Give every detection of a video the identity of its physical object.

    Call `update` once a frame, also with no detections. Identities start at 1, belong to this
    tracker alone and are never given to another object. An object that was away is recognised by
    appearance, whatever its place in the image, unless two identities fit about equally well: then
    it gets a new identity (the linker of `run` decides later, with 3D evidence).

    Args:
        config: thresholds; the defaults serve video of static scenes from 5 to 60 frames a second.
        embedder: computes embeddings where they matter; without one, pass `embeddings=` or track by
            motion.

    >>> tracker = Tracker(TrackerConfig(n_init=1))
    >>> tracker.update(Detections.from_array([[10, 10, 50, 90, 0.9, 56]])).track_id
    array([1])
    """

    def __init__(
        self, config: TrackerConfig | None = None, embedder: Embedder | None = None
    ) -> None:
        self.config = config or TrackerConfig()
        self.embedder = embedder
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next video starts with identity 1."""
        self.frame_number = -1
        self.gallery = Gallery()
        self.same = SimilarityCalibration(PRIOR_PAIRS)  # of views coast_frames apart
        self.same_soon = SimilarityCalibration(PRIOR_PAIRS)  # of a track and a detection
        self.last_seen = np.zeros(0, np.int64)  # (I,) frame of each identity's last detection
        self.identity_class = np.zeros(0, np.int64)  # (I,)
        self._next_tracklet = 1
        self._camera_motion = CameraMotion()
        self.places = EllipsoidMap()
        self._place_boxes = np.empty((0, 4))  # (I, 4) of the places in the latest frame
        self._last_pose: Array | None = None
        self._latest: LazyEmbeddings | None = None  # of the latest frame
        self._view: Array | None = None  # (3, 4) img_from_world of the frame
        self._image_size = (0, 0)
        self._live = _Live.born(np.empty((0, 4)), np.empty(0, np.int64), 0, self.config)

    def save(self, path: str | Path) -> None:
        """Write the whole state, without the embedder, as an .npz file: what `load` reads goes on
        exactly as this tracker does.
        """
        state: dict[str, Any] = {}
        for key, (owner, name) in self._state().items():
            value = getattr(owner, name)
            if value is not None:
                state[key] = list(value.values()) if isinstance(value, dict) else value
        save_npz(Path(path), state, version=STATE_VERSION, config=dataclasses.asdict(self.config))

    @classmethod
    def load(cls, path: str | Path, embedder: Embedder | None = None) -> Tracker:
        """Read a tracker that `save` wrote; embedder: as the saved one had."""
        try:
            state, facts = load_npz(Path(path))
            if facts["version"] != STATE_VERSION:
                raise ValueError(f"version {facts['version']}, this is {STATE_VERSION}")
            tracker = cls(TrackerConfig(**facts["config"]), embedder)
            for key, (owner, name) in tracker._state().items():
                old = getattr(owner, name)
                if old is None and key not in state:
                    continue
                value: Any = state[key]
                value = dict(zip(old, value, strict=True)) if isinstance(old, dict) else value
                setattr(owner, name, int(value) if isinstance(old, int) else value)
        except (KeyError, TypeError, ValueError) as error:
            raise ReobjError(
                f"{path}: not the state of a tracker of this version ({error}); "
                "expected a file written by Tracker.save"
            ) from error
        return tracker

    def _state(self) -> dict[str, tuple[Any, str]]:
        """All that changes from frame to frame: owners and names of their attributes, by name."""
        own = "frame_number last_seen identity_class _next_tracklet _last_pose _place_boxes"
        parts: dict[str, tuple[Any, Sequence[str]]] = {
            "tracker": (self, own.split()),
            "live": (self._live, [f.name for f in dataclasses.fields(_Live)]),
            "gallery": (self.gallery, ("rows", "viewing_ray", "count", "foreground_width")),
            "places": (self.places, EllipsoidMap.ARRAYS),
            "same": (self.same, ("sums",)),
            "same_soon": (self.same_soon, ("sums",)),
            "camera": (self._camera_motion, ("_gray", "_corners")),
        }
        return {f"{part}.{n}": (owner, n) for part, (owner, names) in parts.items() for n in names}

    def update(
        self,
        detections: Any,
        frame: Image | None = None,
        *,
        embeddings: Embeddings | npt.ArrayLike | None = None,
        cam_from_world: Array | None = None,
        camera: Camera | None = None,
    ) -> Tracks:
        """Track the detections of the next frame.

        Args:
            detections: `Detections`, an (N, 6) array x1, y1, x2, y2, confidence, class, or an
                object with xyxy, confidence, class_id and mask (supervision).
            frame: (H, W, 3) BGR image: camera motion, and the input of the embedder.
            embeddings: of all detections: an (D, E) array or `Embeddings`.
            cam_from_world: (3, 4) pose of this frame, with `camera`: objects are known by their
                place in 3D.
        Returns:
            The detections that belong to a confirmed track; decided once.
        """
        tracks = self.step(
            detections, frame, embeddings=embeddings, cam_from_world=cam_from_world, camera=camera
        )
        return tracks[tracks.track_id > 0]

    def latest_embeddings(self) -> tuple[IntArray, Floats]:
        """Which detections of the latest frame were embedded (n,), and their fused rows (n, E)."""
        lazy = self._latest
        if lazy is None or lazy.rows is None:
            return np.empty(0, np.int64), np.empty((0, 0), np.float32)
        return np.flatnonzero(lazy.done), lazy.rows[lazy.done]

    def step(
        self,
        detections: Any,
        frame: Image | None = None,
        *,
        embeddings: Embeddings | npt.ArrayLike | None = None,
        cam_from_world: Array | None = None,
        camera: Camera | None = None,
    ) -> Tracks:
        """As `update`, with the tentative tracks too (track_id 0), for those who look back."""
        self.frame_number += 1
        detections = as_detections(detections)
        lazy = LazyEmbeddings(
            as_embeddings(embeddings, len(detections)),
            self.embedder,
            frame,
            detections,
            self.config.foreground_weight,
        )
        self._latest = lazy
        self._predict(frame, cam_from_world, camera)
        track_of = self._associate(detections, lazy)  # (D,) row of the live track, or -1
        self._correct(detections, track_of)
        track_of = self._begin(detections, track_of)
        self._look(detections, track_of, lazy)
        track_of = self._confirm(track_of)
        result = self._report(detections, track_of)
        self._retire()
        if self._view is not None:
            self._locate(result, self._view)
        return result

    def _predict(
        self, frame: Image | None, cam_from_world: Array | None, camera: Camera | None
    ) -> None:
        """Kalman prediction, then the camera's own motion: as the image shows it, without an image
        by the known rotation; with a pose, what has a place in 3D goes where that is seen.
        """
        live = self._live
        live.mean, live.cov = kalman_predict(live.mean, live.cov, self.config)
        live.mean[:, 2:, 0] = live.mean[:, 2:, 0].clip(1.0)  # a size stays positive
        self._view, before, pose = None, live.mean[..., 0].copy(), None
        if cam_from_world is not None and camera is not None and np.isfinite(cam_from_world).all():
            pose = np.asarray(cam_from_world, np.float64)
        if frame is not None and self.config.camera_motion:
            motion = self._camera_motion(frame)
            live.mean, live.cov = _warp_state(live.mean, live.cov, motion)
            live.mean[:, :2, 0] += self._camera_motion.parallax(before[:, :2])
        elif pose is not None and camera is not None and self._last_pose is not None:
            rotation = pose[:, :3] @ self._last_pose[:, :3].T
            turn = camera.K @ rotation @ np.linalg.inv(camera.K)  # exact for what is far
            live.mean, live.cov = _warp_state(live.mean, live.cov, turn)
        in_view = np.ones(len(live.mean), bool)
        if pose is not None and camera is not None:
            in_view = self._place_tracks(pose, camera, before)
        live.missed += in_view | (live.missed == 0)

    def _place_tracks(self, cam_from_world: Array, camera: Camera, predicted: Array) -> BoolArray:
        """Move tracks of known place as their ellipsoid's image does, from where they were
        predicted for a camera at rest (T, 4). Returns (T,): should a detection be expected?
        """
        live = self._live
        self._image_size = size = (camera.width, camera.height)
        self._view = view = camera.K @ cam_from_world  # (3, 4)
        self._last_pose = cam_from_world
        now, before = self.places.project(view, size, PLACE_IN_VIEW), self._place_boxes
        self._place_boxes = now
        known = _rows_of(self.places.known, live.identity, False)
        now, before = (_rows_of(boxes, live.identity, np.nan) for boxes in (now, before))
        in_view = ~known | np.isfinite(now[:, 0])
        followed = known & (live.missed == 0) & np.isfinite(now[:, 0] + before[:, 0])
        shift, grown = now[:, :2] - before[:, :2], (now[:, 2:] / before[:, 2:]).clip(0.5, 2)
        moved = np.concatenate([predicted[:, :2] + shift, predicted[:, 2:] * grown], 1)  # (T, 4)
        live.mean[followed, :, 0] = moved[followed]
        lost = known & (live.missed > 0)
        where = np.where(in_view[:, None], now, [-1e6, -1e6, 1, 1])  # out of view: matches nothing
        again = _Live.born(where[lost], live.tracklet[lost], 0, self.config)
        live.mean[lost], live.cov[lost] = again.mean, again.cov
        return np.asarray(in_view, bool)

    def _locate(self, tracks: Tracks, view: Array) -> None:
        """Keep the boxes of this frame as views of their objects, and fit places now and then."""
        own = tracks[tracks.track_id > 0]
        self.places.add(self.frame_number, own.track_id - 1, own.xyxy, view)
        if self.frame_number % PLACE_REFIT == 0 and self.places.refit(self._image_size):
            share = PLACE_IN_VIEW
            self._place_boxes = self.places.project(view, self._image_size, share)

    def _associate(self, detections: Detections, lazy: LazyEmbeddings) -> IntArray:
        """Match detections to live tracks: high scores by motion, then what is left, low scores
        too, by overlap. Both times what is matched in doubt must look alike: where a rival costs
        little more, or the match is so dear that the detection may be of an object without a track.
        """
        config = self.config
        same_class = _same_class(self._live.votes, detections.class_id)  # (T, D), as all below
        cost, feasible, iou = self._motion_cost(detections.xyxy, same_class, lazy.available)
        evidence = IOU_ODDS * (iou - config.class_cost * ~same_class) - NO_OVERLAP_ODDS
        handicap = self._handicap()[:, None]
        first = feasible & (detections.score >= config.high_score)
        dear = (cost + handicap > WEAK_MATCH_COST) & (self._live.embedded >= 0)[:, None]
        rivals, close = self._rivals(cost, first, same_class)
        doubt = rivals | dear, close
        track_of, refused = self._matched(cost, handicap, first, doubt, evidence, lazy)
        free = np.ones(len(iou) + 1, bool)
        free[track_of] = False  # -1: the one too many
        low = (track_of < 0) & (detections.score >= config.low_score)
        second = feasible & ~refused & (iou >= LOW_IOU) & low & free[:-1, None]
        if second.any():
            doubt = dear, np.zeros_like(dear)
            late, _ = self._matched(1 - iou, 0 * handicap, second, doubt, evidence, lazy)
            track_of = np.maximum(track_of, late)
        return track_of

    def _matched(
        self, cost: Array, handicap: Array, possible: BoolArray, doubt: tuple[BoolArray, BoolArray],
        evidence: Array, lazy: LazyEmbeddings,
    ) -> tuple[IntArray, BoolArray]:  # fmt: skip
        """Match at least cost; look at what was matched in doubt and at its rivals; match again.

        Args:
            doubt: which pairs must look alike, and which compete, (T, D) each.
            evidence: log odds of the boxes (T, D).
        Returns:
            row of the live track of each detection (D,), or -1; pairs refused by their looks.
        """
        track_of = np.full(cost.shape[1], -1, np.int64)
        refused = np.zeros(cost.shape, bool)
        asked = np.full(cost.shape[1], not (lazy.available and self._live.look.shape[1]))
        while True:
            track_of[:] = -1
            good = possible & ~refused & (cost < MAX_COST)
            _assign(cost + handicap, good, track_of)
            rows = self._unsure(track_of, *doubt, asked)
            if not len(rows):
                return track_of, refused
            asked[rows] = True
            cost, against = self._compare_looks(cost, evidence, rows, lazy)
            refused[:, rows] |= against & doubt[0][:, rows]

    def _motion_cost(
        self, xyxy: Array, same_class: BoolArray, looks: bool
    ) -> tuple[Array, BoolArray, Array]:
        """Cost in [0, 1] from overlap and gated distance, feasibility and IoU, (T, D) each."""
        live, config, box = self._live, self.config, cxcywh_from_xyxy(xyxy)
        iou = box_iou(xyxy_from_cxcywh(live.mean[..., 0]), xyxy)
        var = live.cov[:, :2, 0] + (STD_MEASURE * _noise_scale(live.mean)[:, :2]) ** 2  # (T, 2) S
        offset = live.mean[:, None, :2, 0] - box[None, :, :2]  # (T, D, 2)
        distance = (offset**2 / var[:, None]).sum(-1)  # (T, D) squared Mahalanobis, 2 dof
        distance = distance / GATE_CHI2
        feasible = (distance < 1) | (iou > GATE_IOU)
        if not looks:
            growth = np.log(live.mean[:, None, 2:, 0] / box[None, :, 2:].clip(1e-3))  # (T, D, 2)
            feasible &= (np.abs(growth) < math.log(MOTION_ONLY_SIZE)).all(-1)
            feasible &= iou >= MOTION_ONLY_IOU
        share = DISTANCE_WEIGHT
        cost = (1 - share) * (1 - iou) + share * distance.clip(0, 1)
        cost = cost + config.class_cost * ~same_class
        return cost, feasible & (same_class | (iou > LOW_IOU)), iou

    def _handicap(self) -> Array:
        """What a match costs extra (T,): tracks just seen and confirmed ones choose first."""
        live = self._live
        waited = ((live.missed - 1) / 10).clip(0, 1)
        return np.asarray(AGE_COST * waited + UNCONFIRMED_COST * (live.identity < 0))

    def _rivals(
        self, cost: Array, gate: BoolArray, same_class: BoolArray
    ) -> tuple[BoolArray, BoolArray]:
        """Which pairs (T, D) have a rival of the class that costs little more (two boxes of two
        classes around one thing look alike), and which cost little more than the best of both.
        """
        open_cost = np.where(gate, cost, np.inf)
        best = np.minimum(
            open_cost.min(0, initial=np.inf)[None], open_cost.min(1, initial=np.inf)[:, None]
        )
        close = gate & same_class & (cost <= best + AMBIGUITY_MARGIN)
        return close & ((close.sum(0) > 1)[None] | (close.sum(1) > 1)[:, None]), close

    @staticmethod
    def _unsure(
        track_of: IntArray, doubtful: BoolArray, close: BoolArray, asked: BoolArray
    ) -> IntArray:
        """Detections (n,) that were matched in doubt, and their rivals, not looked at yet."""
        matched = np.flatnonzero(track_of >= 0)
        matched = matched[doubtful[track_of[matched], matched] & ~asked[matched]]
        ask: BoolArray = np.asarray((close & doubtful)[track_of[matched]].any(0), bool)
        ask[matched] = True
        return np.flatnonzero(ask & ~asked)

    def _compare_looks(
        self, cost: Array, evidence: Array, rows: IntArray, lazy: LazyEmbeddings
    ) -> tuple[Array, BoolArray]:
        """Blend the looks of detections (n,) into the cost (T, D), half alike where unknown; and
        what boxes and look together speak against, (T, n).
        """
        known = (self._live.embedded >= 0)[:, None]
        cosines = part_cosines(self._live.look, lazy.get(rows), lazy.foreground_width)
        logit = self.same_soon.logit(*cosines)  # (T, n)
        weight, cost = self.config.appearance_weight, cost.copy()
        unlike = 1 / (1 + np.exp(np.where(known, logit, 0)))
        cost[:, rows] = (1 - weight) * cost[:, rows] + weight * unlike
        return cost, known & (logit + evidence[:, rows] < 0)

    def _correct(self, detections: Detections, track_of: IntArray) -> None:
        """Kalman update of the matched tracks."""
        rows = np.flatnonzero(track_of >= 0)
        t, live = track_of[rows], self._live
        box = cxcywh_from_xyxy(detections.xyxy[rows])
        doubt = ((1 - detections.score[rows]).clip(0.05) / 0.2) ** SCORE_NOISE  # (n,)
        noise = STD_MEASURE * _noise_scale(live.mean[t]) * doubt[:, None]
        live.mean[t], live.cov[t] = kalman_update(live.mean[t], live.cov[t], box, noise)
        self._count(detections, rows, t)

    def _count(self, detections: Detections, rows: IntArray, t: IntArray) -> None:
        """Book a detection for each of the tracks t."""
        live = self._live
        live.hits[t] += 1
        live.missed[t] = 0
        classes = detections.class_id[rows].clip(0)
        live.votes = widen(live.votes, np.empty((0, int(classes.max(initial=0)) + 1)))
        live.votes[t, classes] += detections.score[rows]

    def _begin(self, detections: Detections, track_of: IntArray) -> IntArray:
        """Start a tentative track at every unmatched detection of sufficient score."""
        rows = np.flatnonzero((track_of < 0) & (detections.score >= self.config.new_score))
        if not len(rows):
            return track_of
        ids = self._next_tracklet + np.arange(len(rows))
        self._next_tracklet += len(rows)
        born = _Live.born(
            cxcywh_from_xyxy(detections.xyxy[rows]), ids, self.frame_number, self.config
        )
        track_of[rows] = len(self._live.mean) + np.arange(len(rows))
        self._live = self._live.append(born)
        self._count(detections, rows, track_of[rows])
        return track_of

    def _look(self, detections: Detections, track_of: IntArray, lazy: LazyEmbeddings) -> None:
        """Embed tentative tracks, tracks that were not embedded lately, and learn the similarity
        statistics.
        """
        if not lazy.available:
            return
        live = self._live
        rows = np.flatnonzero(track_of >= 0)
        t = track_of[rows]
        soon = (live.identity[t] < 0) & (live.hits[t] >= self.config.n_init - 1)
        due = soon | (self.frame_number % self.config.embed_every == 0)  # all in one pass
        self._learn_looks(detections, track_of, rows[lazy.done[rows] | due], lazy)
        rows = rows[due]  # not those of doubtful matches: their view may be half of a neighbour
        t = track_of[rows]
        if not len(rows):
            return
        look = lazy.get(rows)  # (n, E)
        self.gallery.foreground_width = lazy.foreground_width
        live.look = widen(live.look, look)
        known = live.embedded[t] >= 0
        keep = np.where(known, EMBEDDING_MOMENTUM, 0.0)[:, None]
        live.look[t] = unit_rows(keep * live.look[t] + (1 - keep) * look)
        live.embedded[t] = self.frame_number
        self._learn(look, live.identity[t], detections.class_id[rows], self._viewing_rays(t))

    def _learn_looks(
        self, detections: Detections, track_of: IntArray, rows: IntArray, lazy: LazyEmbeddings
    ) -> None:
        """Feed the statistics of a track's look against the detections of the next frames."""
        live = self._live
        rows = rows[(live.embedded[track_of[rows]] >= 0) & (live.identity[track_of[rows]] >= 0)]
        if not len(rows):
            return
        parts = part_cosines(
            live.look[track_of[rows]], lazy.get(rows), lazy.foreground_width
        )  # (n, n) each
        own = np.eye(len(rows), dtype=bool)
        self._compare(self.same_soon, parts, own, detections.class_id[rows])

    @staticmethod
    def _compare(
        same: SimilarityCalibration, parts: tuple[Array, Array], own: BoolArray, kind: IntArray
    ) -> None:
        """Show all pairs of one class in a frame, (n, n)."""
        fore, back = parts
        other = (kind[:, None] == kind) & ~own
        same.add(fore[own], back[own], True)
        same.add(fore[other], back[other], False)

    def _viewing_rays(self, t: IntArray) -> Array:
        """Directions (n, 3) in which tracks are seen in this frame, NaN without a pose."""
        if self._view is None:
            return np.full((len(t), 3), np.nan)
        return viewing_rays(xyxy_from_cxcywh(self._live.mean[t, :, 0]), self._view)

    def _learn(
        self, look: Floats, identity: IntArray, class_id: IntArray, viewing_ray: Array
    ) -> None:
        """Feed the similarity statistics and the gallery with embeddings (n, E) of one frame."""
        old = np.flatnonzero(identity >= 0)
        look, identity = look[old], identity[old]
        if not len(old):
            return
        if len(self.gallery.count):
            first = self.gallery.rows[identity, 0] * (self.gallery.count[identity, None] > 1)
            parts = part_cosines(look, first, self.gallery.foreground_width)
            self._compare(self.same, parts, np.eye(len(old), dtype=bool), class_id[old])
        self.gallery.add(identity, look, viewing_ray[old])

    def _confirm(self, track_of: IntArray) -> IntArray:
        """Give tracks that were seen often enough an identity: a known one that returns, or a new
        one. A return has a look to show for it and needs one detection less. Where nothing is
        known yet, one detection is enough (as in SORT's first frames).
        """
        live = self._live
        needed = self.config.n_init if len(self.last_seen) else 1
        young = (live.identity < 0) & (live.missed == 0)
        ready = np.flatnonzero(young & (live.hits >= min(needed, self.config.n_init - 1)))
        self.last_seen[live.identity[(live.identity >= 0) & (live.missed == 0)]] = self.frame_number
        returning = self._returns(ready)  # (n,) identity or -1
        sure = (returning >= 0) | (live.hits[ready] >= needed)
        ready, returning = ready[sure], returning[sure]
        fresh = ready[returning < 0]
        ids = len(self.last_seen) + np.arange(len(fresh))
        self.last_seen = np.append(self.last_seen, np.zeros(len(fresh), np.int64))
        self.identity_class = np.append(
            self.identity_class, live.votes[fresh].argmax(1) if len(fresh) else []
        )
        self.identity_class = self.identity_class.astype(np.int64)
        back = np.zeros(len(self.last_seen) + 1, bool)  # the one too many: of no identity
        back[returning[returning >= 0]] = True
        stale = back[live.identity]  # coasting tracks of those who came back
        live.identity[ready[returning >= 0]], live.identity[fresh] = returning[returning >= 0], ids
        self.last_seen[live.identity[ready]] = self.frame_number
        seen = ready[live.embedded[ready] >= 0]
        if len(seen):
            self.gallery.add(live.identity[seen], live.look[seen], self._viewing_rays(seen))
        return self._drop(stale, track_of)

    def _home_iou(self, ready: IntArray, identity: IntArray) -> Array:
        """Overlap (n, I) of tracks with the places of identities in this frame, NaN: unknown."""
        iou = np.full((len(ready), len(identity)), np.nan)
        if self._view is not None and len(identity):
            places = self.places.project(self._view, self._image_size, 0.0)
            homes = _rows_of(places, identity, np.nan)  # (I, 4)
            box = xyxy_from_cxcywh(self._live.mean[ready, :, 0])
            iou = np.nan_to_num(box_iou(box, xyxy_from_cxcywh(homes)))
            iou[:, ~_rows_of(self.places.known, identity, False)] = np.nan
        return iou

    def _jumps(self, ready: IntArray, identity: IntArray) -> BoolArray:
        """(n, I): does the identity's own track still coast, and is it predicted far from the
        newcomer (three times the gate)? With poses the places in 3D tell.
        """
        live = self._live
        row = np.full(len(self.last_seen), -1)
        coasting = np.flatnonzero((live.identity >= 0) & (live.missed > 0))
        row[live.identity[coasting]] = coasting
        row = row[identity]  # (I,)
        var = live.cov[row, :2, 0] + (STD_MEASURE * _noise_scale(live.mean[row])[:, :2]) ** 2
        offset = live.mean[ready, None, :2, 0] - live.mean[row, :2, 0]  # (n, I, 2)
        far = (offset**2 / var).sum(-1) > 9 * GATE_CHI2
        return np.asarray(far & (row >= 0) & (self._view is None), bool)

    def _returns(self, ready: IntArray) -> IntArray:
        """Recognise known identities in newly confirmed tracks: look and place, where known, must
        make it probable, also in view of the other candidates.

        Never gated by overlap, aspect ratio or pixel distance: the camera may return from anywhere;
        but a track that still coasts says where its object should be.
        An identity that was seen while the newcomer was already in view is another object, and so
        is one whose place in 3D is not here. Things that move have no place: no ellipsoid fits.
        """
        live, config = self._live, self.config
        result = np.full(len(ready), -1, np.int64)
        identity = np.flatnonzero(self.last_seen < live.first[ready].max(initial=0))  # (I,)
        if not len(identity) or not config.remember:
            return result
        iou = self._home_iou(ready, identity)  # (n, I)
        home = iou > LOW_IOU
        logit = self.same.logit(
            *self.gallery.parts(live.look[ready], identity, self._viewing_rays(ready))
        )
        logit[home & np.isinf(logit)] = 0  # no look: the place decides
        logit += np.where(home, IOU_ODDS * iou - NO_OVERLAP_ODDS, 0)
        logit -= JUMP_ODDS * self._jumps(ready, identity)
        possible = self.last_seen[identity] < live.first[ready][:, None]
        possible &= self.identity_class[identity] == live.votes[ready].argmax(1)[:, None]
        logit[~possible | (iou == 0)] = -np.inf
        chance = match_probability(logit, RETURN_ODDS)
        claimed = np.full(len(identity), -1, np.int64)
        good = (chance >= config.return_probability) | (home & (logit > 0))
        _assign(1 - chance, good, claimed)
        column = np.flatnonzero(claimed >= 0)
        result[claimed[column]] = identity[column]
        return result

    def _drop(self, rows: BoolArray, track_of: IntArray) -> IntArray:
        """Remove live tracks; returns the detections' rows renumbered."""
        if not rows.any():
            return track_of
        renumber = np.append(np.where(rows, -1, np.cumsum(~rows) - 1), -1)
        self._live = self._live.select(~rows)
        return np.asarray(renumber[track_of], np.int64)

    def _report(self, detections: Detections, track_of: IntArray) -> Tracks:
        rows = np.flatnonzero(track_of >= 0)
        t = track_of[rows]
        return Tracks(
            np.full(len(rows), self.frame_number),
            self._live.identity[t] + 1,
            self._live.tracklet[t],
            detections.xyxy[rows],
            detections.score[rows],
            detections.class_id[rows],
            rows,
        )

    def _retire(self) -> None:
        """Drop tracks that coasted too long; their identities stay in the gallery."""
        live = self._live
        patience = np.where(
            live.identity < 0, np.minimum(live.hits, self.config.n_init), self.config.coast_frames
        )
        if (live.missed > patience).any():
            self._live = live.select(live.missed <= patience)


def _rows_of(rows: Any, identity: IntArray, missing: Any) -> npt.NDArray[Any]:
    """Rows of a table of identities (I, ...), `missing` where the identity has none: (T, ...)."""
    table = np.concatenate([rows, np.full((1, *rows.shape[1:]), missing, rows.dtype)])
    return np.asarray(table[np.where(identity < len(rows), identity, -1)])


def _same_class(votes: Array, class_id: IntArray) -> BoolArray:
    """(T, D): is the detection's class the one the track was mostly seen as?"""
    own = votes.argmax(1) if votes.size else np.zeros(len(votes), np.int64)
    return np.asarray(own[:, None] == class_id[None], bool)


def _assign(cost: Array, possible: BoolArray, row_of_column: IntArray) -> None:
    """Match as many rows to columns as possible, then at least cost; fills row_of_column (C,)."""
    if possible.any():
        rows, columns = linear_sum_assignment(np.where(possible, cost, 1e3))
        good = possible[rows, columns]
        row_of_column[columns[good]] = rows[good]


# ---- Poses -------------------------------------------------------------------------------------


# Keyframes: optical flow


# Frames between the keyframes: points followed from both sides, PnP


# Reconstruction of the keyframes in a child process


# All calls of pycolmap


# Poses supplied by the user


# Check of direction and axes


# Separate reconstructions, joined by the objects that both see


# Writers


# ---- Run: the whole chain ----------------------------------------------------------------------


def run(
    source: str | Path | int,
    out: str | Path,
    config: Config | None = None,
    *,
    detections: str | Path | Callable[[Image], Any] | None = None,
    tracks: str | Path | None = None,
    in_3d: bool = True,
    overwrite: bool = False,
) -> RunResult:
    """Run the chain on a video: detect, track, poses, objects; write the output folder's files.

    Args:
        source: video file, folder of images, glob, camera index or URL of a stream. Ctrl-C ends a
            live one: its files are written.
        out: output folder; results of earlier stages found there are used again.
        detections: file with recorded detections, or a callable image -> Detections; default:
            config.detect.model.
        tracks: file of identities that take the place of detector, tracker and linker.
        in_3d: False for identities only, without cameras and ellipsoids.
    Returns:
        RunResult; if the reconstruction fails, without cameras and ellipsoids, and with a warning.
    Raises:
        ReobjError: for input that cannot be used, with what to do.
    """
    config = config or Config()
    _set_threads(config.threads)
    video = Video(source, config.input)
    space = Workspace(Path(out), overwrite)
    space.claim(video, overwrite)
    seconds: dict[str, float] = {}
    in_3d = in_3d and config.poses.mode != "none"
    poses = _supplied_poses(video, config) if in_3d else None
    if tracks:
        track = read_tracks(tracks, video, config.detect, space.last_tracks())
    else:
        track = track_video(video, space, config, detections, poses, seconds)
    model = None
    if in_3d and poses is None and not video.is_live:
        moving = _moving_rows(track, config.objects)
        poses, model = _reconstruct(video, space, config, seconds, moving)
    if poses is not None:
        _check_supplied(poses, track.table)
    space.remember(track, poses)
    space.show_model(model)
    return _finish_objects(video, space, track, poses, config, seconds)


def refit(
    out: str | Path, config: Config | None = None, tracks: str | Path | None = None
) -> RunResult:
    """Link and fit again from what an output folder holds; tracks: identities from this file."""
    if not (Path(out) / "cache").is_dir():
        raise ReobjError(f"{out}: no output folder of reobj_track; make one with `run` or `track`")
    space = Workspace(Path(out))
    track, poses = space.recall()
    source = json.loads((space.cache / "source.json").read_text())
    config = dataclasses.replace(config or Config(), input=InputConfig(**source["input"]))
    video = Video(source["source"], config.input)
    if tracks:
        track = read_tracks(tracks, video, config.detect, track)
        space.remember(track, poses)
    return _finish_objects(video, space, track, poses, config, {})


def _finish_objects(
    video: Video,
    space: Workspace,
    track: TrackResult,
    poses: Poses | None,
    config: Config,
    seconds: dict[str, float],
) -> RunResult:
    """Objects from tracks and poses, and all files of the output folder."""
    result = make_objects(track, poses, config, space.out, seconds)
    result.warnings += [*track.messages, *(poses.messages if poses is not None else ())]
    for warning in result.warnings:
        log.warning(warning)
    result.poses = poses
    write_results(result, video, config)
    return result


def _set_threads(threads: int) -> None:
    """Limit OpenCV (numpy's BLAS reads OMP_NUM_THREADS when it is imported)."""
    if threads:
        cv2.setNumThreads(threads)


def track_video(
    video: Video,
    space: Workspace,
    config: Config,
    detections: Any,
    poses: Poses | None,
    seconds: dict[str, float],
) -> TrackResult:
    """Detect and track all frames, or take both from the cache."""
    source = open_detections(video, config.detect, detections, config.threads, config.offline)
    if video.is_live:  # what it showed before is no answer
        source = dataclasses.replace(source, key="")
    key = (source_fingerprint(video.source), config.input, source.key)
    supplied = "" if poses is None else hashlib.sha256(poses.cam_from_world.tobytes()).hexdigest()
    path = space.path("tracks", *key, config.embed, config.tracker, supplied)
    if path.exists() and source.key:
        return TrackResult.load(path)
    started = time.monotonic()
    cache_path = space.path("detections", *key).with_suffix("") if source.key else None
    result = _track_frames(video, source, cache_path, config, poses)
    seconds["track"] = time.monotonic() - started
    result.save(path)
    return result


def track(
    source: str | Path | int | Video,
    config: Config | None = None,
    *,
    detections: str | Path | Callable[[Image], Any] | None = None,
) -> Iterator[tuple[Frame, Tracks]]:
    """Track a video as it is read: yields each frame with the tracks decided in it.

    Args:
        source: video file, folder of images, glob, camera index, stream URL, or a `Video`.
        detections: as for `run`: file, callable image -> detections, or None for the detector.
    Yields:
        Frame, and its Tracks in pixels of the frame's image. Online: without the linking in 3D and
        the look back of `run`.

    >>> for frame, tracks in track("room.mp4", detections="det.txt"):  # doctest: +SKIP
    ...     print(frame.index, tracks.track_id)
    """
    config = config or Config()
    video = source if isinstance(source, Video) else Video(source, config.input)
    found = open_detections(video, config.detect, detections, config.threads, config.offline)
    tracker = Tracker(config.tracker, _embedder(config))
    for frame in video:
        yield frame, tracker.update(found(frame), frame.image)


def _track_frames(
    video: Video,
    source: DetectionSource,
    cache_path: Path | None,
    config: Config,
    poses: Poses | None,
) -> TrackResult:
    """One pass over the video: detections (cached if they are dear), tracker, progress."""
    source = source.cached(cache_path, video.working_size) if cache_path else source
    tracker = Tracker(config.tracker, _embedder(config))
    pose_of = dict(zip(poses.frame.tolist(), poses.cam_from_world, strict=True)) if poses else {}
    camera = None if poses is None else scaled_camera(poses.camera, video.scale)
    steps: list[tuple[int, Tracks]] = []
    looks: list[tuple[IntArray, Floats]] = []
    progress = Progress("track", video.expected)
    try:
        for frame in video:
            detections = source(frame)
            pose = pose_of.get(frame.index)
            step = tracker.step(detections, frame.image, cam_from_world=pose, camera=camera)
            steps.append((frame.index, step))
            looks.append(tracker.latest_embeddings())
            progress.step()
    except KeyboardInterrupt:  # the way to end a live source
        if not video.is_live:
            raise
    finally:
        progress.close()
        source.flush()
    if not steps:
        why = "--start/--stop/--every leave none, or the file is damaged"
        raise ReobjError(f"{video.source}: no frame could be read ({why})")
    table = Tracks.concatenate([i for i, _ in steps], [s for _, s in steps], video.scale)
    messages = [*source.messages, *_video_messages(video, table)]
    look, look_row = _table_looks(table, [i for i, _ in steps], looks)
    names, split = source.class_names, tracker.gallery.foreground_width
    return TrackResult(table, names, tuple(messages), False, look, look_row, split)


def _table_looks(
    table: Tracks, frames: Sequence[int], looks: Sequence[tuple[IntArray, Floats]]
) -> tuple[npt.NDArray[np.float16], IntArray]:
    """Embeddings that the tracker computed, (n, E), and the table rows they belong to, (n,)."""
    keys = zip(table.frame.tolist(), table.detection_index.tolist(), strict=True)
    at = {key: i for i, key in enumerate(keys)}
    found = zip(frames, looks, strict=True)
    rows = [at.get((frame, d), -1) for frame, (index, _) in found for d in index.tolist()]
    row = np.array(rows, np.int64)
    parts = [part for _, part in looks if part.size] or [np.empty((0, 0), np.float32)]
    return np.concatenate(parts)[row >= 0].astype(np.float16), row[row >= 0]


def _embedder(config: Config) -> Embedder | None:
    if config.embed.model == "none":
        return None
    kind, _, backbone = config.embed.model.partition(":")
    if kind == "crops":
        backbone = backbone or "mobilenetv2_feat"
        made = CropEmbedder(backbone, config.embed.head, None, config.threads, config.offline)
        return made
    return Embedder(config.embed.model, config.embed.head, None, config.threads, config.offline)


def _video_messages(video: Video, table: Tracks) -> list[str]:
    """What the user should know about the input."""
    messages = list(video.messages)
    if video.is_live:
        messages.append(f"live: {video.read} frames came, {video.dropped} of them were dropped to "
                        "keep up")  # fmt: skip
        messages.append("a live source cannot be read twice: identities only; record it for 3D")
    if not len(table):
        messages.append("no object was tracked: no detections, or all below tracker.new_score")
    return messages


def _supplied_poses(video: Video, config: Config) -> Poses | None:
    """Poses given by the user, or None if they are to be reconstructed."""
    if config.poses.mode in ("auto", "none"):
        return None
    return read_poses(config.poses.mode, video, config.poses.fmt, config.poses.camera)


def _check_supplied(poses: Poses, table: Tracks) -> None:
    """Refuse supplied poses whose direction or axes contradict the tracks."""
    if poses.source != "user":
        return
    centers = (table.xyxy[:, :2] + table.xyxy[:, 2:]) / 2
    tracks = [(table.frame[rows], centers[rows]) for rows in rows_by(table.tracklet_id)]
    fault = check_poses(poses, tracks)
    if fault:
        raise ReobjError(fault)


def _reconstruct(
    video: Video,
    space: Workspace,
    config: Config,
    seconds: dict[str, float],
    moving: Tracks | None = None,
) -> tuple[Poses, Path]:
    """Poses from pycolmap, no features on moving things, and their model's folder, both cached."""
    boxes = np.empty((0, 5)) if moving is None else np.column_stack([moving.frame, moving.xyxy])
    digest = hashlib.sha256(boxes.round(1).tobytes()).hexdigest()
    content = source_fingerprint(video.source)
    path = space.path("poses", content, config.input, config.poses, digest)
    model = path.with_suffix(".sparse")
    if path.exists():
        return load_poses(path), model
    started = time.monotonic()
    work = space.cache / "sfm"
    mask = (lambda frame: boxes[boxes[:, 0] == frame, 1:]) if len(boxes) else None
    poses = estimate_poses(video, config.poses, work, boxes_to_mask=mask)
    if poses.known.any():
        shutil.rmtree(model, ignore_errors=True)
        (work / "sparse").replace(model)
        save_poses(path, poses)
    seconds["poses"] = time.monotonic() - started
    return poses, model


def _moving_rows(track: TrackResult, config: ObjectsConfig) -> Tracks:
    """Rows of the classes that move."""
    moving = [i for i, n in enumerate(track.class_names) if n in config.moving.split(",")]
    return track.table[np.isin(track.table.class_id, moving)]


def make_objects(
    track: TrackResult, poses: Poses | None, config: Config, out: Path, seconds: dict[str, float]
) -> RunResult:
    """Link tracklets, by looks and with poses by place, and fit one solid per object."""
    started = time.monotonic()
    table, events, fits, views, fit = track.table, [], None, None, None
    located = poses is not None and poses.known.sum() >= config.objects.min_views
    if located and poses is not None:
        fit = fitter(config.objects, poses, track.class_names)
    if len(table) and config.objects.link and not track.fixed:
        own = config.objects
        linker = Linker(
            track, poses if located else None, fit, own.moving.split(","), own.min_score,
            own.min_views,
        )  # fmt: skip
        table, events = table.with_identities(linker.run()), linker.events
    elif len(table) and not track.fixed:
        table = table.with_identities(table.track_id)
    if len(table) and poses is not None and fit is not None:
        classes = object_classes(table)
        group = np.searchsorted(list(classes), table.track_id)
        views = gather_views(table, poses, group, len(classes), config.objects.min_score)
        fits = fit(views, list(classes.values()))
    objects = object_entries(table, track.class_names, fits, views, config.objects)
    seconds["objects"] = time.monotonic() - started
    result = RunResult(out, table, track.class_names, objects, poses, fits, seconds, [])
    result.world = world_entry(poses, fits, events)
    return result


# ---- Results -----------------------------------------------------------------------------------


def write_results(result: RunResult, video: Video, config: Config) -> None:
    """Write the files of the output folder; each appears only when it is complete."""
    out, started = result.out, time.monotonic()
    old = ("poses.txt", "cameras.csv", "objects.ply", "overlay.mp4", "scene.html")
    for name in old:  # of an earlier run; cameras.csv: of an earlier version
        (out / name).unlink(missing_ok=True)
    write_mot(out / "tracks.txt", result.table)
    write_objects_json(result, video)
    if result.poses is not None:
        write_cameras(out, result.poses, video)
    kept = np.array([o["status"] != "rejected" for o in result.objects], bool)
    solids = None if result.fits is None else result.fits.ellipsoids[kept]
    if solids is not None:
        ids = [o["id"] for o in result.objects if o["status"] != "rejected"]
        write_ply(out / "objects.ply", solids, ids)
    pictures = Pictures(result, video) if config.output.scene else None
    overlay = None
    if config.output.overlay and not video.is_live:
        overlay = Overlay(result, solids, video)
    sinks = [sink for sink in (overlay, pictures) if sink is not None and not video.is_live]
    progress, complete = Progress("pictures", video.expected), False
    try:
        for frame in video if sinks else ():
            for sink in sinks:
                sink.take(frame)
            progress.step()
        complete = True
    finally:
        progress.close()
        if overlay is not None:
            overlay.close(complete)
    if pictures is not None:
        write_scene(result, pictures, video)
    result.seconds["write"] = time.monotonic() - started


# ---- Command line ------------------------------------------------------------------------------


def _options(parser: argparse.ArgumentParser, *sections: str) -> None:
    """Add the flags that the configs declare for these sections ("" for the top level)."""
    for section in sections:
        cls: Any = Config if not section else Config.__dataclass_fields__[section].default_factory
        for f in dataclasses.fields(cls):
            flag = f.metadata.get("flag", "")
            if not flag:
                continue
            dest = f"{section}.{f.name}" if section else f.name
            kind: Any = type(f.default)
            how = {"type": kind, "metavar": kind.__name__.upper()}
            if kind is bool:
                how = {"action": "store_true"}
            default = f" (default: {f.default})" if f.default else ""
            text = f"{f.metadata['help']}{default}".replace("%", "%%")
            parser.add_argument(flag, dest=dest, default=None, help=text, **how)


def config_from_args(args: argparse.Namespace) -> Config:
    """Build the config from flags and from --set section.field=value."""
    config = Config()
    for dest, value in vars(args).items():
        section, _, name = dest.rpartition(".")
        if value is not None and (section or dest in ("threads", "offline")):
            config = _replaced(config, section, name or dest, value)
    for item in args.set or []:
        target, equals, text = item.partition("=")
        section, _, name = target.rpartition(".")
        value = _parse_value(config, section, name, text if equals else None)
        config = _replaced(config, section, name, value)
    return config


def _replaced(config: Config, section: str, name: str, value: Any) -> Config:
    if not section:
        return dataclasses.replace(config, **{name: value})
    changed = dataclasses.replace(getattr(config, section), **{name: value})
    return dataclasses.replace(config, **{section: changed})


def _every_option() -> dict[str, dataclasses.Field[Any]]:
    """All fields that --set takes, by section.field."""
    sections = {f.name: f.default_factory for f in dataclasses.fields(Config)}
    made = {name: make() for name, make in sections.items() if callable(make)}
    return {f"{name}.{f.name}": f for name, own in made.items() for f in dataclasses.fields(own)}


def _parse_value(config: Config, section: str, name: str, text: str | None) -> Any:
    """Convert the text of --set to the type of the field."""
    key, options = f"{section}.{name}", _every_option()
    if key not in options and not (section == "" and name in ("threads", "offline")):
        import difflib

        close = difflib.get_close_matches(key, options, 1) or ["tracker.coast_frames"]
        raise ReobjError(f"--set {key}: no such option; did you mean {close[0]}?")
    kind = type(getattr(getattr(config, section) if section else config, name))
    try:
        if text is None:
            raise ValueError
        return text.lower() in ("1", "true", "yes", "on") if kind is bool else kind(text)
    except ValueError:
        expected = kind.__name__.upper()
        raise ReobjError(f"--set {key}: expected ={expected}, found {text!r}") from None


class _ListOptions(argparse.Action):
    """--options: print every field of the config with its default and meaning, then stop."""

    def __call__(self, parser: argparse.ArgumentParser, *args: Any) -> None:
        for name, f in _every_option().items():
            print(f"{name}={f.default}\n        {f.metadata['help']}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="reobj_track",
        description="Objects of a hand-held video of a static scene: which detections are the same "
        "physical object, and where each one is in 3D.",
        epilog="Example: reobj_track.py run room.mp4 -o out; then open out/overlay.mp4.",
    )
    parser.add_argument("--version", action="version", version=f"reobj_track {__version__}")
    text = "list what --set section.field=value can set"
    parser.add_argument("--options", action=_ListOptions, nargs=0, help=text)
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(sub, "run", "video -> identities -> cameras -> ellipsoids -> files to look at")
    _add_run(sub, "track", "identities only (2D)")
    _add_run(sub, "poses", "cameras only (pycolmap)")
    _add_objects(sub)
    _add_eval(sub)
    _add_export(sub)
    _add_models(sub)
    return parser


TRACKS_HELP = "identities from a file instead of the tracker: CVAT XML, COCO-VID JSON, MOT, CSV"


def _common(parser: argparse.ArgumentParser) -> None:
    text = "any other option, e.g. tracker.coast_frames=60; --options lists them"
    parser.add_argument("--set", action="append", metavar="SECTION.FIELD=VALUE", help=text)
    parser.add_argument("-v", "--verbose", action="store_true", help="say what is being done")
    parser.add_argument("--debug", action="store_true", help="say more, and show tracebacks")


def _add_run(sub: Any, name: str, text: str) -> None:
    parser = sub.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    add = parser.add_argument
    add("video", help="video file, folder of images, glob in quotes, camera index, stream URL")
    add("-o", "--out", required=True, help="output folder")
    add("--overwrite", action="store_true", help="write into a folder that holds something else")
    sections = {
        "run": ("input", "detect", "embed", "tracker", "poses", "objects"),
        "track": ("input", "detect", "embed", "tracker"),
        "poses": ("input", "poses"),
    }[name]
    if name != "poses":
        add("--detections", help="recorded detections instead: MOT txt, CSV, COCO JSON, npz")
        add("--tracks", help=TRACKS_HELP)
    _options(parser, *sections, "")
    _common(parser)
    parser.set_defaults(func=_cmd_poses if name == "poses" else _cmd_run)


def _cmd_run(args: argparse.Namespace) -> int:
    given = {"detections": args.detections, "tracks": args.tracks, "overwrite": args.overwrite}
    config, in_3d = config_from_args(args), args.command == "run"
    print(summary(run(args.video, args.out, config, in_3d=in_3d, **given)))
    return 0


def _cmd_poses(args: argparse.Namespace) -> int:
    config = config_from_args(args)
    video = Video(args.video, config.input)
    space = Workspace(Path(args.out), args.overwrite)
    space.claim(video, args.overwrite)
    seconds: dict[str, float] = {}
    poses, model = _supplied_poses(video, config), None
    if poses is None:
        poses, model = _reconstruct(video, space, config, seconds)
    space.show_model(model)
    write_cameras(space.out, poses, video)
    known, count = poses.known.sum(), len(poses.frame)
    where = f"{space.out / 'poses.txt'}, {space.out / 'sparse'}"
    print(f"cameras: {known} of {count} frames, {len(poses.points)} points; look at: {where}")
    for message in poses.messages:
        log.warning(message)
    return 0


def _add_objects(sub: Any) -> None:
    text = "(re)fit the ellipsoids from what an output folder already holds"
    parser = sub.add_parser("objects", help=text, description=text[0].upper() + text[1:] + ".")
    parser.add_argument("out", help="output folder of an earlier `run`")
    text = "only check objects.json against its format"
    parser.add_argument("--validate", action="store_true", help=text)
    parser.add_argument("--tracks", help=TRACKS_HELP)
    _options(parser, "objects")
    _common(parser)
    parser.set_defaults(func=_cmd_objects)


def _cmd_objects(args: argparse.Namespace) -> int:
    out = Path(args.out)
    if args.validate:
        faults = validate_objects(out / "objects.json" if out.is_dir() else out)
        print("\n".join(faults) or "valid")
        return 2 if faults else 0
    print(summary(refit(out, config_from_args(args), args.tracks)))
    return 0


def _add_eval(sub: Any) -> None:
    parser = sub.add_parser("eval", help="compare with ground truth: HOTA, IDF1, MOTA, O3D ...")
    add = parser.add_argument
    add("out", type=Path, help="output folder of an earlier `run`, or a tracks.txt")
    add("--gt", type=Path, required=True, help="true tracks, MOTChallenge gt.txt")
    add("--gt-objects", type=Path, help="true solids, e.g. a gt_objects.json")
    add("--gt-poses", type=Path, help="true cameras, TUM or 4x4 world_from_cam a line (default: "
        "poses.txt or poses_c2w.txt beside --gt-objects)")  # fmt: skip
    add("--classes", default="", help="score these classes only, comma-separated")
    add("--min-visibility", type=float, default=0.0, help="ignore truth that is less visible")
    _common(parser)
    parser.set_defaults(func=_cmd_eval)


def _cmd_eval(args: argparse.Namespace) -> int:
    poses: Path | None = args.gt_poses
    if poses is None and args.gt_objects:
        beside = [args.gt_objects.with_name(n) for n in ("poses_c2w.txt", "poses.txt")]
        poses = next((p for p in beside if p.exists()), None)
    classes = [c.strip() for c in args.classes.split(",") if c.strip()]
    result = evaluate(args.out, args.gt, args.gt_objects, poses, classes, args.min_visibility)
    print(score_table(result["tracks"]))
    print(_ranks_line(result["ranks"]))
    if "objects" in result:
        facts = {k: v for k, v in result["objects"].items() if k != "objects"}
        print("3D: " + ", ".join(f"{k} {v:.3g}" for k, v in facts.items() if v is not None))
    if args.out.is_dir():
        with atomic(args.out / "eval.json") as part:
            part.write_text(json.dumps(result, indent=1))
    return 0


def _add_export(sub: Any) -> None:
    text = "write what an output folder holds in another tool's format"
    parser = sub.add_parser("export", help=text, description=text[0].upper() + text[1:] + ".")
    parser.add_argument("out", help="output folder of an earlier `run`")
    parser.add_argument("--to", required=True, choices=EXPORTS, help="the format")
    parser.add_argument("-o", "--output", help="file to write (default: in the output folder)")
    _common(parser)
    parser.set_defaults(func=_cmd_export)


def _cmd_export(args: argparse.Namespace) -> int:
    print(export(args.out, args.to, args.output))
    return 0


def _ranks_line(ranks: dict[str, float]) -> str:
    """One line on Rank-k, or why there is none."""
    if not ranks:
        return "Rank-k: no embeddings here (an output folder of `run` or `track` keeps them)"
    shares = ", ".join(f"{k.replace('rank', 'Rank-')} {v:.3f}" for k, v in list(ranks.items())[1:])
    return f"returns by looks alone, {ranks['queries']:.0f} queries: {shares or 'no returns'}"


def _add_models(sub: Any) -> None:
    text = "list, download and verify weights"
    parser = sub.add_parser("models", help=text, description=text[0].upper() + text[1:] + ".")
    names = "weights to download or verify; none: list all"
    parser.add_argument("names", nargs="*", metavar="NAME", help=names)
    _options(parser, "")
    _common(parser)
    parser.set_defaults(func=_cmd_models)


def _cmd_models(args: argparse.Namespace) -> int:
    for name in args.names:
        print(model_path(name, offline=bool(args.offline)))
    if not args.names:
        for row in list_models():
            w = row.weights
            facts = f"{w.name:<20} {w.role:<9} {w.size / 1e6:5.1f} MB  {w.licence:<11}"
            print(f"{facts} {row.state:<13} {w.note}")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 130 after Ctrl-C, 1 for a fault of ours.

    Ctrl-C is the way to end a live source: its files are written, and 0 is returned.
    """
    args = _parser().parse_args(argv)
    level = logging.DEBUG if args.debug else logging.INFO if args.verbose else logging.WARNING
    logging.addLevelName(logging.WARNING, "warning")
    form = "%(levelname)s: %(message)s"
    logging.basicConfig(level=level, format=form, stream=sys.stderr, force=True)
    try:
        return int(args.func(args))
    except KeyboardInterrupt:
        text = "interrupted: what was computed is kept; run the same command again to go on"
        print(f"\n{text}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output (head, less) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ReobjError, quadrics.QuadricsError, OSError) as error:
        if args.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
