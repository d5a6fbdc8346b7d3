#!/usr/bin/env python3
"""reobj_track: re-identify object instances in a hand-held video and localise them in 3D.

    python reobj_track.py run VIDEO -o OUT        # identities, cameras, one 3D ellipsoid per object
    python reobj_track.py run VIDEO -o OUT --detections det.txt --poses colmap_model/
    python reobj_track.py --help

    import reobj_track as rt
    for frame, tracks in rt.track(rt.Video("room.mp4"), detector):      # online
        print(frame.index, tracks.track_id, tracks.xyxy)
    result = rt.run("room.mp4", "out")                                  # the whole chain
    result.objects[0].class_name, result.objects[0].center, result.objects[0].size_m

How it works (start reading at `run()`, then `track()`, then `Tracker.update()`):
  1. detect    boxes, scores, classes and masks of every frame: an ONNX model, a file, or a callable
  2. poses     keyframes -> pycolmap -> PnP for the frames between; or poses supplied by the user
  3. predict   constant-velocity Kalman filter with camera-motion compensation: by the 3D position
               of each object where the frame has a pose, else by the motion of the image
  4. associate gate by motion, then one cost from overlap and appearance; high scores first
  5. embed     one feature map per frame, pooled over each object (foreground) and around it
  6. re-identify objects that return, by 3D position and from a gallery that never expires
  7. link      associate detections with 3D objects; tracklets are joined or split
  8. fit       one shape and its ellipsoid per object, from its boxes and a size prior (quadrics.py)

This file holds the Kalman filter, association, re-identification and the order of the stages. The
package `reobj` holds the rest: config, cli, pipeline (the stages), sources/ (video, detections,
weights), appearance/ (embeddings, gallery), tracking/ (camera motion, linking), poses/ (cameras),
objects/ (association and fit), results/ (files, pages), maps/ (maps of a room).

Conventions: frames 0-based (1-based in MOT files); boxes `xyxy` in pixels, the top-left pixel spans
[0, 1] and has its centre at (0.5, 0.5) as in COLMAP; `b_from_a` maps coordinates in a to b;
cameras are `cam_from_world`, x right, y down, z forward; quaternions carry their order in the name.
Axes of the shape comments: D detections and T tracks of a frame, I identities, E embedding.

References: re-OBJ (Bansal et al., ICIAP 2019), PSfMO (Gay et al., ICCV 2017), LfD (Rubino et al.,
PAMI 2018), SORT (Bewley et al., ICIP 2016), DeepSORT (Wojke et al., ICIP 2017), ByteTrack (Zhang et
al., ECCV 2022), BoT-SORT (Aharon et al., 2022), COLMAP (Schoenberger and Frahm, CVPR 2016).
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from reobj import __version__, cli, pipeline
from reobj.appearance.crops import CropEmbedder, make_embedder
from reobj.appearance.embedding import (
    EmbedConfig,
    Embedder,
    LazyEmbeddings,
    SamplingLayout,
    as_embeddings,
    fused_rows,
)
from reobj.appearance.reid import (
    Gallery,
    SimilarityCalibration,
    match_probability,
    part_cosines,
)  # fmt: skip
from reobj.cameras import Camera, Poses, checked_pose, viewing_rays
from reobj.config import Config, OutputConfig, TrackerConfig, as_config
from reobj.evaluation.tracks import evaluate
from reobj.export.registry import export
from reobj.files import load_cached, load_npz, restore_state, save_npz, state_arrays
from reobj.maps.fusion import class_ids, ellipsoid_map_of, embeddings_of, object_state
from reobj.maps.room_map import RoomMap
from reobj.maps.stage import MapConfig, opened_map
from reobj.objects.config import ObjectsConfig
from reobj.poses.estimate import PosesConfig, estimate_poses
from reobj.poses.stage import poses_key, supplied_poses
from reobj.poses.supplied.readers import read_poses
from reobj.results.changes import Change, Changes
from reobj.results.edits import read_edits
from reobj.results.result import Object, Part, Result, World, load_tracked, save_tracked
from reobj.results.workspace import Workspace, collect_tracks, detections_key
from reobj.sources.detection_files import DetectConfig, read_detections, read_tracks
from reobj.sources.detectors import DetectionSource, open_detections, with_detector
from reobj.sources.onnx_layouts import OnnxDetector
from reobj.sources.recorded import Intervals, write_detections_npz
from reobj.sources.tables import boxes_3d_of
from reobj.sources.video import InputConfig, Video, in_batches
from reobj.sources.weights import list_models, model_path
from reobj.tracking.camera_motion import CameraMotion
from reobj.tracking.ellipsoid_map import (
    EXPECTED_IN_VIEW,
    EllipsoidMap,
    camera_inputs,
    depth_intervals,
    iou_within_uncertainty,
    rows_of,
)  # fmt: skip
from reobj.tracking.linking import STD_POSITION, STD_START
from reobj.types import (
    COCO_NAMES,
    Array,
    BoolArray,
    Detections,
    Embeddings,
    Floats,
    Frame,
    Image,
    IntArray,
    LinkEvent,
    ReobjError,
    Tracks,
    as_detections,
    as_frame,
    cxcywh_from_xyxy,
    log,
    rows_by,
    unit_rows,
    widen,
    xyxy_from_cxcywh,
)

__all__ = [
    "COCO_NAMES", "Camera", "Change", "Changes", "Config", "CropEmbedder", "DetectConfig",
    "DetectionSource", "Detections", "EmbedConfig", "Embedder", "Embeddings", "Frame",
    "InputConfig", "LinkEvent", "MapConfig", "MatchingOptions", "Object", "ObjectsConfig",
    "OnnxDetector", "OutputConfig", "Part", "Poses", "PosesConfig", "ReobjError", "Result",
    "RoomMap", "SamplingLayout", "Tracker", "TrackerConfig", "Tracks", "Video", "World",
    "__version__", "estimate_poses", "evaluate", "export", "list_models", "main", "model_path",
    "open_detections", "read_detections", "read_poses", "read_tracks", "refit", "run", "track",
    "write_detections_npz",
]  # fmt: skip


def __dir__() -> list[str]:
    """List the public names, for completion."""
    return list(__all__)


# ---- Kalman filter -----------------------------------------------------------------------------

# Noise is relative to the box, as in DeepSORT: its mean side for x and y, its own side for w and h
# (a measurement has `STD_POSITION` of `reobj.tracking.linking` at score .8).
SCORE_NOISE = 0.25  # it grows with (1 - score) to this power (StrongSORT: 1)


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
    """
    scale = _noise_scale(mean)  # (T, 4)
    p01, p11 = cov[..., 1], cov[..., 2]  # (T, 4) each
    new_mean = mean.copy()
    new_cov = cov.copy()
    new_mean[..., 0] += mean[..., 1]
    new_cov[..., 0] = cov[..., 0] + 2 * p01 + p11 + (config.std_position * scale) ** 2
    new_cov[..., 1] += p11
    new_cov[..., 2] += (config.std_velocity * scale) ** 2
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
    p00, p01 = cov[..., 0], cov[..., 1]  # (T, 4), as all below
    innovation_var, residual = p00 + noise**2, box - mean[..., 0]  # S, y
    gain, velocity_gain = p00 / innovation_var, p01 / innovation_var  # K
    new_mean = mean.copy()
    new_cov = cov.copy()
    new_mean[..., 0] += gain * residual
    new_mean[..., 1] += velocity_gain * residual
    new_cov[..., 0] *= 1 - gain
    new_cov[..., 1] *= 1 - gain
    new_cov[..., 2] -= velocity_gain * p01
    return new_mean, new_cov


def center_variance(mean: Array, cov: Array) -> Array:
    """Return the variances (T, 2) of a measured centre: S = H P H' + R, R at score .8."""
    return np.asarray(cov[:, :2, 0] + (STD_POSITION * _noise_scale(mean)[:, :2]) ** 2)


def squared_mahalanobis(residual: Array, variance: Array) -> Array:
    """Return squared Mahalanobis distances (...), 2 dof: y' S^-1 y of residuals y (2, ...)."""
    x, y = residual**2 / variance
    return np.asarray(x + y)


def _noise_scale(mean: Array) -> Array:
    """Return the length (T, 4) that noise is relative to: mean side for x, y, own side for w, h."""
    scale = np.maximum(mean[..., 0], 1.0)  # (T, 4)
    scale[:, 0] = scale[:, 1] = np.sqrt(scale[:, 2] * scale[:, 3])
    return scale


def warp_states(mean: Array, cov: Array, new_from_old: Array) -> tuple[Array, Array]:
    """Move tracks along with the camera by a homography (3, 3) of the image.

    Positions go through it; sizes, velocities and their deviations grow by its local scale.
    """
    x, y = mean[:, 0, 0], mean[:, 1, 0]  # (T,)
    points = np.stack([x, y, np.ones_like(x)], 1) @ new_from_old.T  # (T, 3)
    depth = np.where(np.abs(points[:, 2]) < 1e-6, 1e-6, points[:, 2])  # (T,)
    jacobian = np.abs(np.linalg.det(new_from_old) / depth**3)  # (T,) local change of areas
    scale = np.sqrt(jacobian).clip(0.5, 2.0)
    warped = mean * scale[:, None, None]  # (T, 4, 2)
    warped[:, :2, 0] = points[:, :2] / depth[:, None]
    return warped, cov * scale[:, None, None] ** 2


@dataclass(slots=True)
class TrackState:
    """State of the live tracks, one row a track (T rows)."""

    mean: Array  # (T, 4, 2) cx, cy, w, h and velocities
    cov: Array  # (T, 4, 3)
    tracklet: IntArray  # (T,)
    identity: IntArray  # (T,) index of the identity, -1 while tentative
    missed: IntArray  # (T,) frames on which the detector ran since the last detection
    first: IntArray  # (T,) frame of birth
    embedded: IntArray  # (T,) frame of the last embedding, -1: never
    votes: Array  # (T, C) score sums of the classes
    embedding: Floats  # (T, E) running mean of the embeddings
    interval: Array  # (T, 2, 3) ends of the depth interval on the viewing ray, in world, or NaN
    size: Array  # (T, 2) width and height at its middle, world units
    uncertainty: Array  # (T, 2) px, of the projected position

    def select(self, keep: npt.NDArray[Any]) -> TrackState:
        """Return the tracks of some rows."""
        return TrackState(*(getattr(self, name)[keep] for name in self.__slots__))

    def append(self, other: TrackState) -> TrackState:
        """Return these tracks and others, with as many classes and embedding columns as either."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__slots__)
        return TrackState(*(np.concatenate([widen(a, b), widen(b, a)]) for a, b in pairs))

    @property
    def evidence(self) -> Array:
        """Sum of a track's scores (T,) over .5, the default of `new_score`; at least 1."""
        return np.asarray(np.maximum(self.votes.sum(1) / 0.5, 1))

    @staticmethod
    def spawn(box: Array, tracklet: IntArray, frame: int, config: TrackerConfig) -> TrackState:
        """Make tentative tracks at rest from boxes cx, cy, w, h (N, 4); covariance: DeepSORT."""
        mean = np.stack([box, np.zeros_like(box)], -1)
        scale = _noise_scale(mean)
        position = 2 * config.std_position * scale
        velocity = STD_START * scale
        cov = np.stack([position**2, 0 * scale, velocity**2], -1)
        zero = np.zeros(len(box), np.int64)
        none = np.zeros((len(box), 1))
        nothing = np.zeros((len(box), 0), np.float32)
        return TrackState(
            mean, cov, tracklet, zero - 1, zero, zero + frame, zero - 1, none, nothing,
            np.full((len(box), 2, 3), np.nan), np.full((len(box), 2), np.nan), 0 * box[:, :2],
        )  # fmt: skip


# ---- Association -------------------------------------------------------------------------------

# Only pairs that pass a gate are stored, a few per track: the cost grows with their number, not
# with tracks times detections, so it stays low with a thousand objects. Axis M: pairs.


@dataclass(frozen=True, slots=True)
class Pairs:
    """Gated pairs of a track and a detection of a frame, by track, then by detection.

    Attributes:
        track, detection: (M,) rows. cost: (M,) of overlap and gated distance, 0 to 1. iou: (M,).
        overlap_weight: (M,) of the overlap as evidence (`iou_within_uncertainty`).
        same_class: (M,) the detection has the majority class of the track.
    """

    track: IntArray
    detection: IntArray
    cost: Array
    iou: Array
    overlap_weight: Array
    same_class: BoolArray


def touching(center: Array, radius: Array, xyxy: Array) -> tuple[IntArray, IntArray]:
    """Find the detections (D, 4) that touch the search window of each track.

    Args:
        center, radius: (2, T) px, centre and half size of the windows.
    Returns:
        track, detection: (M,) rows, in the order of tracks, then of detections.
    """
    left, top = (center - radius)[..., None]  # (T, 1) each
    right, bottom = (center + radius)[..., None]
    x1, y1, x2, y2 = np.ascontiguousarray(xyxy.T)  # (D,) each
    touch = x1 <= right  # (T, D)
    touch &= x2 >= left
    touch &= y1 <= bottom
    touch &= y2 >= top
    return np.divmod(np.flatnonzero(touch), max(len(xyxy), 1))


def ambiguous_pairs(
    pairs: Pairs, possible: BoolArray, margin: float
) -> tuple[BoolArray, BoolArray]:
    """Mark possible pairs that have a rival of their class, and pairs that are rivals, (M,) each.

    A pair is a rival if it costs at most `margin` more than the best pair of its track and of its
    detection.
    (Two boxes of different classes around one object are not rivals: they show the same object.)
    """
    rivals = possible & pairs.same_class
    cost = np.where(possible, pairs.cost, np.inf)
    best = []  # least cost of the track and of the detection of each pair
    for side in (pairs.track, pairs.detection):
        least = np.full(side.max(initial=0) + 1, np.inf)
        np.minimum.at(least, side, cost)
        best.append(least[side])
    rivals &= pairs.cost <= np.minimum(*best) + margin
    several = [np.bincount(side, rivals)[side] > 1 for side in (pairs.track, pairs.detection)]
    return rivals & (several[0] | several[1]), rivals


def assign(row: IntArray, column: IntArray, cost: Array) -> IntArray:
    """Find the matching with the most pairs, and among those the least total cost.

    Args:
        row, column: (M,) possible pairs, in the order of rows. cost: (M,) below 1e3.
    Returns:
        numbers of the matched pairs, ascending.
    """
    rival = (np.bincount(row)[row] > 1) | (np.bincount(column)[column] > 1)
    if not rival.any():
        return np.arange(len(row))
    matched = ~rival  # need no solver
    some = np.flatnonzero(rival)
    r = np.unique(row[some], return_inverse=True)[1]
    c = np.unique(column[some], return_inverse=True)[1]
    # columns first: scipy copies and transposes a matrix with more rows than columns, and a frame
    # usually has more tracks than detections
    costs = np.full((c.max() + 1, r.max() + 1), 1e3)
    costs[c, r] = cost[some]
    solved, row_of_solved = linear_sum_assignment(costs)
    row_of = np.full(len(costs), -1)
    row_of[solved] = row_of_solved
    matched[some] = row_of[c] == r
    return np.flatnonzero(matched)


# ---- Tracker -----------------------------------------------------------------------------------

STATE_VERSION = 10  # of the files of Tracker.save
EMBEDDING_MOMENTUM = 0.8  # of a track's mean embedding (StrongSORT: .9 every frame)
# With poses
MAP_REFIT = 10  # frames between two fits of the ellipsoids that have new views
OUT_OF_VIEW = -1e6  # px, position of tracks whose ellipsoid is out of view


@dataclass(frozen=True, slots=True)
class MatchingOptions:
    """Gates, costs and odds of matching detections to tracks, and of re-identification.

    Costs lie in [0, 1]. Values without a source are those of highest IDF1 on rendered rooms and
    redkitchen (benchmarks/RESULTS.md).

    Attributes:
        gate_chi2: gate on the squared Mahalanobis distance of the centres (chi2 .99, 2 dof).
        gate_iou: IoU that passes the gate whatever the distance.
        motion_only_iou, motion_only_size: without embeddings: least IoU of every match, largest
            ratio of widths or heights.
        low_iou: least IoU for low scores and for a change of class (ByteTrack: .5), and with the
            projected ellipsoid of a known identity.
        max_cost: of an accepted match.
        distance_weight: of the gated distance in the cost; the rest is 1 - IoU.
        penalty: cost of each kind of weak evidence: a track not detected for age_frames frames
            (linear before), a tentative track, track and detection of different classes (then also
            taken off the overlap as evidence).
        weak_cost: a match of at least this cost may be an object without a track.
        ambiguity_margin: cost above that of the best pair up to which pairs are rivals.
        iou_odds, no_overlap_odds: log odds for the same object per unit of IoU, and log odds
            against it at IoU 0 (of 12 pairs none has .8 more IDF1 at any step of the camera:
            benchmarks/LOG.md).
        map_agreement: least share of the detections, of classes that a given map has, that lie on
            one of its objects (`Tracker.start_from`); below it the poses are not in the frame of
            the map, and no new track gets a number of the map.
    """

    gate_chi2: float = 9.2103
    gate_iou: float = 0.2
    motion_only_iou: float = 0.1
    motion_only_size: float = 2.0
    low_iou: float = 0.3
    max_cost: float = 0.9
    distance_weight: float = 0.2
    penalty: float = 0.2
    age_frames: int = 10
    weak_cost: float = 0.5
    ambiguity_margin: float = 0.3
    iou_odds: float = 20.0
    no_overlap_odds: float = 6.0
    map_agreement: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class FrameContext:
    """Inputs of one call of `Tracker.update`, passed to every step and never changed.

    Attributes:
        number: index of the frame among the calls, from 0.
        detector_ran: False if the detector was not run on this frame.
        box: (D, 4) cx, cy, w, h of the detections, px.
        lazy: embeddings of the detections, computed on request.
        cam_from_world: (3, 4), None without a pose. K: (3, 3). image_size: width, height, px.
        points: (N, 3) sparse points in world that this frame observes, None if not given.
        view: (3, 4) K @ cam_from_world, img_from_world; None without a pose.
    """

    number: int
    detector_ran: bool
    image: Image | None
    detections: Detections
    box: Array
    lazy: LazyEmbeddings
    cam_from_world: Array | None
    K: Array
    image_size: tuple[int, int]
    points: Array | None
    view: Array | None


@dataclass(slots=True)
class TrackerState:
    """Everything that changes from frame to frame; `Tracker.save` writes exactly these fields.

    Attributes:
        tracks: the live tracks.
        last_seen: (I,) frame of each identity's last detection, -1: known from a map, not yet
            detected. identity_class: (I,) its class. numbers: (I,) its number, ascending.
        next_number: of the next new identity.
        map_votes: (2,) detections compared with the objects of a map, and those that lie on one.
        frame_number: of the latest frame, -1 before the first.
        detector_runs: number of frames on which the detector was run, minus one.
        component: component of the trajectory that the latest frame belongs to.
        last_pose: (3, 4) cam_from_world of the previous frame, None without a pose.
        intervals: between frames with detections.
        maps: ellipsoids of the identities, one map per component of the trajectory.
        reid_calibration: of views some time apart. match_calibration: of a track and a detection.
    """

    tracks: TrackState
    last_seen: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    identity_class: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    numbers: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    next_number: int = 1
    map_votes: IntArray = field(default_factory=lambda: np.zeros(2, np.int64))
    frame_number: int = -1
    detector_runs: int = -1
    next_tracklet: int = 1
    component: int = 0
    last_pose: Array | None = None
    intervals: Intervals = field(default_factory=Intervals)
    maps: list[EllipsoidMap] = field(default_factory=lambda: [EllipsoidMap()])
    gallery: Gallery = field(default_factory=Gallery)
    reid_calibration: SimilarityCalibration = field(default_factory=SimilarityCalibration)
    match_calibration: SimilarityCalibration = field(default_factory=SimilarityCalibration)
    camera_motion: CameraMotion = field(default_factory=CameraMotion)


class Tracker:
    """Give every detection of a video the identity of its physical object.

    Call `update` once per frame: with [] if the detector found nothing, with None if it was not
    run. Identities start at 1, are unique within this tracker and are never reused (`start_from`:
    those of a map are known). An object that
    returns is re-identified by appearance anywhere in the image, unless two identities fit about
    equally well: then it gets a new identity (`run` decides later, with 3D evidence).

    Args:
        config: thresholds, or a dict of them; the defaults suit video of static scenes at 5 to 60
            frames per second.
        embedder: computes embeddings of ambiguous matches; without one, pass `embeddings=` or
            track by motion alone.
        matching: gates, costs and odds.

    >>> tracker = Tracker(TrackerConfig(n_init=1))
    >>> tracker.update(Detections.from_array([[10, 10, 50, 90, 0.9, 56]])).track_id
    array([1])
    """

    def __init__(
        self,
        config: TrackerConfig | Mapping[str, Any] | None = None,
        embedder: Embedder | None = None,
        matching: MatchingOptions | None = None,
    ) -> None:
        self.config = as_config(TrackerConfig(), config)
        self.embedder = embedder
        self.matching = matching or MatchingOptions()
        self.reset()

    def reset(self) -> None:
        """Reset the state: the next video starts with identity 1."""
        none = np.empty(0, np.int64)
        tracks = TrackState.spawn(np.empty((0, 4)), none, 0, self.config)
        self.state = TrackerState(tracks)
        self._frame: FrameContext | None = None  # the latest
        self._latest = Tracks.empty()

    def start_from(self, room: RoomMap, class_names: Sequence[str] = COCO_NAMES) -> None:
        """Start with the objects of a map: they are known before the first frame.

        A detection of their class on the projection of one gets its number at once; this needs
        poses in the world of the map (component 0). Without poses the appearance decides, if the
        map was made with the same embedder. New objects get numbers that the map does not have.
        Objects that were deleted are left out; of those that were gone only the appearance is used.
        Positions of the map are not changed.

        Args:
            class_names: of the detections' class ids; an object of another class is not recognised.
        Raises:
            ReobjError: frames were tracked already.
        """
        if self.state.frame_number >= 0:
            raise ReobjError("start_from after frames were tracked; call it first, or after reset")
        self.reset()
        every = [object_state(found, room) for found in room.objects]
        known = sorted((s for s in every if not s.deleted), key=lambda s: s.id)
        state = self.state
        state.numbers = np.array([s.id for s in known], np.int64)
        state.next_number = room.next_id
        state.last_seen = np.full(len(known), -1)
        state.identity_class = class_ids(known, class_names)
        state.maps[0] = ellipsoid_map_of(known)
        model = getattr(self.embedder, "key", "")
        identity, embeddings = embeddings_of(known, model)
        if len(identity):
            rows = fused_rows(embeddings, self.config.foreground_weight)
            state.gallery.foreground_width = embeddings.foreground.shape[1]
            state.gallery.add(identity, rows, np.full((len(identity), 3), np.nan))

    def update(
        self,
        detections: Any,
        frame: Image | None = None,
        *,
        embeddings: Embeddings | npt.ArrayLike | None = None,
        cam_from_world: Array | None = None,
        camera: Camera | None = None,
        points: Array | None = None,
        part: int = 0,
        looked: bool | None = None,
    ) -> Tracks:
        """Track the detections of the next frame.

        Args:
            detections: `Detections`; (N, 6) rows x1, y1, x2, y2, confidence, class; ultralytics'
                Results or Boxes; supervision's Detections; or a dict of boxes, scores, labels.
                None: the detector was not run on this frame; tracks are predicted, and none is
                counted as missed.
            frame: (H, W, 3) uint8 BGR image, for camera motion and the embedder.
            embeddings: of all detections: a (D, E) array or `Embeddings`; E is constant.
            cam_from_world: (3, 4) pose of this frame, given with `camera`: objects are then also
                re-identified by 3D position. NaN: unknown.
            points: (N, 3) sparse points in world observed in this frame: depth of new tracks.
            part: component of the trajectory; each has its own world frame.
            looked: whether the detector was run on this frame. None: inferred. A frame without
                detections then counts as not run only if the frames with detections come at
                regular intervals.
        Returns:
            The detections that belong to a confirmed track; the assignment is final.
        Raises:
            ReobjError: invalid input; the state is unchanged.
        """
        state = self.state
        run = detections is not None and looked is not False
        detections = as_detections(detections) if run else Detections.empty()
        image = None if frame is None else as_frame(frame, detections.masks)
        given = as_embeddings(embeddings, len(detections), state.tracks.embedding.shape[1])
        pose = checked_pose(cam_from_world, camera, points, part)
        state.frame_number += 1
        if len(detections):
            state.intervals.add(state.frame_number)
        elif run and looked is None:
            run = state.intervals.detector_ran(state.frame_number)
        state.detector_runs += run
        weight = self.config.foreground_weight
        lazy = LazyEmbeddings(given, self.embedder, image, detections, weight)
        box = cxcywh_from_xyxy(detections.xyxy)
        size = (0, 0) if camera is None else (camera.width, camera.height)
        K = np.eye(3) if camera is None else camera.K
        view = None if pose is None else K @ pose
        inputs = (image, detections, box, lazy, pose, K, size, points, view)
        self._frame = FrameContext(state.frame_number, run, *inputs)
        self._enter(part)
        self._predict(self._frame)
        self._latest = self._track(self._frame) if run else Tracks.empty()
        return self._latest[self._latest.track_id > 0]

    def _track(self, frame: FrameContext) -> Tracks:
        """Match, start, embed, confirm and retire tracks; return the tracks of this frame."""
        track_of = self._associate(frame)  # (D,) row of the tracks' state, or -1
        self._update_states(frame, track_of)
        self._spawn(frame, track_of)
        self._update_depth_intervals(frame, track_of)
        self._embed(frame, track_of)
        self._compare_with_map(frame)
        self._confirm(frame)
        tracks = self._report(frame, track_of)
        self._retire()
        self._add_views(frame, tracks)
        return tracks

    @property
    def latest(self) -> Tracks:
        """Tracks of the latest frame, including tentative ones (track_id 0)."""
        return self._latest

    @property
    def looked(self) -> bool:
        """Whether the detector was run on the latest frame."""
        return self._frame is not None and self._frame.detector_ran

    @property
    def detections(self) -> Detections:
        """Detections of the latest frame."""
        return Detections.empty() if self._frame is None else self._frame.detections

    def predicted(self, frames: int = 5) -> Tracks:
        """Return the boxes predicted in the latest frame for identities not detected in it.

        Predicted boxes may lie outside the image.

        Args:
            frames: maximum number of frames with detector output since the last detection.
                5 has the best HOTA on benchmarks/benchmark.py's stream of 50 objects.
        Returns:
            Tracks of score 0 and detection_index -1, like interpolated boxes.
        """
        tracks = self.state.tracks
        absent = (tracks.missed > 0) | (not self.looked)
        t = np.flatnonzero((tracks.identity >= 0) & absent & (tracks.missed <= frames))
        t = t[tracks.mean[t, 0, 0] > OUT_OF_VIEW / 2]
        box = xyxy_from_cxcywh(tracks.mean[t, :, 0])
        none = np.full(len(t), -1)
        number = self.state.numbers[tracks.identity[t]]
        ids = (np.full(len(t), self.state.frame_number), number, tracks.tracklet[t])
        return Tracks(*ids, box, np.zeros(len(t)), tracks.votes[t].argmax(1), none)

    def latest_embeddings(self) -> tuple[IntArray, Floats]:
        """Return indices (n,) and embeddings (n, E) of the latest frame's embedded detections."""
        lazy = None if self._frame is None else self._frame.lazy
        if lazy is None or lazy.rows is None:
            return np.empty(0, np.int64), np.empty((0, 0), np.float32)
        return np.flatnonzero(lazy.done), lazy.rows[lazy.done]

    @property
    def ellipsoid_map(self) -> EllipsoidMap:
        """Ellipsoids of the identities in the world of the latest frame."""
        return self.state.maps[self.state.component]

    def _enter(self, component: int) -> None:
        """Switch to the world of a component of the trajectory; depth intervals become invalid."""
        state = self.state
        if component != state.component:
            state.component = component
            state.last_pose = None
            state.tracks.interval[:] = np.nan
            state.maps += [EllipsoidMap() for _ in range(component + 1 - len(state.maps))]

    def _predict(self, frame: FrameContext) -> None:
        """Predict all tracks, then compensate the motion of the camera.

        The motion comes from optical flow, or without an image from the given rotation. With a
        pose, tracks whose 3D position is known follow its projection instead.
        """
        state = self.state
        tracks = state.tracks
        tracks.mean, tracks.cov = kalman_predict(tracks.mean, tracks.cov, self.config)
        size = tracks.mean[:, 2:, 0]
        np.maximum(size, 1.0, out=size)  # stays positive
        tracks.uncertainty[:] = 0
        before = tracks.mean[..., 0].copy()
        pose = frame.cam_from_world
        if frame.image is not None and self.config.camera_motion:
            motion = state.camera_motion(frame.image)
            tracks.mean, tracks.cov = warp_states(tracks.mean, tracks.cov, motion)
            tracks.mean[:, :2, 0] += state.camera_motion.parallax(before[:, :2])
            if pose is None:
                state.last_pose = None  # flow moved the tracks away from its projections
        elif pose is not None and state.last_pose is not None:
            rotation = pose[:, :3] @ state.last_pose[:, :3].T
            turn = frame.K @ rotation @ np.linalg.inv(frame.K)  # exact for distant objects
            tracks.mean, tracks.cov = warp_states(tracks.mean, tracks.cov, turn)
        in_view = np.ones(len(tracks.mean), bool)
        if pose is not None and frame.view is not None:
            in_view = self._follow_projections(frame, pose, frame.view, before)
        if frame.detector_ran:
            tracks.missed += in_view | (tracks.missed == 0)

    def _follow_projections(
        self, frame: FrameContext, cam_from_world: Array, view: Array, predicted: Array
    ) -> BoolArray:
        """Move tracks of known 3D position to the projection of ellipsoid or depth interval.

        Args:
            predicted: (T, 4) boxes cx, cy, w, h predicted for a static camera.
        Returns:
            (T,) True where a detection is expected.
        """
        tracks = self.state.tracks
        ellipsoids = self.ellipsoid_map
        last = self.state.last_pose
        self.state.last_pose = cam_from_world
        known = rows_of(ellipsoids.known, tracks.identity, False)
        inside = np.isfinite(ellipsoids.project(view, frame.image_size, EXPECTED_IN_VIEW)[:, 0])
        in_view = ~known | rows_of(inside, tracks.identity, False)
        tracked = (tracks.identity, tracks.interval, tracks.size, frame.K, frame.image_size)
        now, reach = ellipsoids.project_tracks(cam_from_world, *tracked)
        if last is not None:
            before, reach_before = ellipsoids.project_tracks(last, *tracked)
            followed = (tracks.missed == 0) & np.isfinite(now[:, 0] + before[:, 0])
            shift = now[:, :2] - before[:, :2]
            growth = (now[:, 2:] / before[:, 2:]).clip(0.5, 2)
            moved = np.concatenate([predicted[:, :2] + shift, predicted[:, 2:] * growth], 1)
            tracks.mean[followed, :, 0] = moved[followed]  # (T, 4)
            tracks.uncertainty[followed] = np.abs(reach - reach_before)[followed]
        located = known | np.isfinite(tracks.interval[:, 0, 0])
        lost = located & (tracks.missed > 0)
        shown = (in_view & np.isfinite(now[:, 0]))[:, None]
        where = np.where(shown, now, [OUT_OF_VIEW, OUT_OF_VIEW, 1, 1])  # matches nothing
        again = TrackState.spawn(where[lost], tracks.tracklet[lost], 0, self.config)
        tracks.mean[lost] = again.mean
        tracks.cov[lost] = again.cov
        tracks.uncertainty[lost] = np.abs(reach[lost])
        tracks.cov[:, :2, 0] += tracks.uncertainty**2
        return np.asarray(in_view, bool)

    def _update_depth_intervals(self, frame: FrameContext, track_of: IntArray) -> None:
        """Estimate depth intervals of matched tracks without an ellipsoid, from points in boxes."""
        pose = frame.cam_from_world
        if frame.points is None or pose is None:
            return
        tracks = self.state.tracks
        rows = np.flatnonzero(track_of >= 0)
        rows = rows[~rows_of(self.ellipsoid_map.known, tracks.identity[track_of[rows]], False)]
        t = track_of[rows]
        found = depth_intervals(frame.detections.xyxy[rows], frame.points, pose, frame.K)
        tracks.interval[t], tracks.size[t] = found

    def _add_views(self, frame: FrameContext, tracks: Tracks) -> None:
        """Add the boxes of confirmed tracks as views of their objects; refit periodically.

        Also refit when at least half of the identities in view have enough new views, as after a
        large camera motion.
        """
        if frame.view is None:
            return
        confirmed = tracks[tracks.track_id > 0]
        identity = np.searchsorted(self.state.numbers, confirmed.track_id)
        ellipsoids = self.ellipsoid_map
        ellipsoids.add(frame.number, identity, confirmed.xyxy, frame.view)
        many_due = 2 * ellipsoids.due[identity].sum() >= max(len(identity), 1)
        if self.state.detector_runs % MAP_REFIT == 0 or many_due:
            ellipsoids.refit(frame.image_size)

    def _associate(self, frame: FrameContext) -> IntArray:
        """Match detections to tracks: high scores by motion, then the rest by overlap.

        In both rounds an ambiguous match (a rival costs little more) and a weak one (perhaps an
        object without a track) must agree in appearance.

        Returns:
            (D,) row of the track's state, or -1.
        """
        config = self.config
        options = self.matching
        tracks = self.state.tracks
        detections = frame.detections
        lazy = frame.lazy
        pairs = self._gate(frame)
        t = pairs.track
        d = pairs.detection
        score = detections.score[d]
        priority = self._priority_cost()[t]
        first = score >= config.high_score  # (M,), as all below
        weak = (pairs.cost + priority > options.weak_cost) & (tracks.embedded[t] >= 0)
        ambiguous, rivals = ambiguous_pairs(pairs, first, options.ambiguity_margin)
        agree = ambiguous | weak
        matched, refused = self._match(pairs, pairs.cost, priority, first, agree, rivals, lazy)
        track_of = np.full(len(detections), -1)
        track_of[d[matched]] = t[matched]
        free = np.ones(len(tracks.mean), bool)
        free[t[matched]] = False
        low = free[t] & (track_of[d] < 0) & (score >= config.low_score)
        second = low & ~refused & (pairs.iou >= options.low_iou)
        if second.any():
            none = np.zeros(len(t), bool)
            matched, _ = self._match(pairs, 1 - pairs.iou, 0.0, second, weak, none, lazy)
            track_of[d[matched]] = t[matched]
        return track_of

    def _gate(self, frame: FrameContext) -> Pairs:
        """Gate pairs of tracks and detections by motion, and compute their cost."""
        options = self.matching
        tracks = self.state.tracks
        detections = frame.detections
        track, reach = tracks.mean[..., 0].T, tracks.uncertainty.T  # (4, T) cx, cy, w, h; (2, T)
        variance = center_variance(tracks.mean, tracks.cov).T  # (2, T)
        # distance, overlap
        gate = np.maximum(np.sqrt(options.gate_chi2 * variance), track[2:] / 2 + reach)
        t, d = touching(track[:2], gate, detections.xyxy)  # (M,) each
        track, seen, reach = track.take(t, 1), frame.box.T.take(d, 1), reach.take(t, 1)  # (4, M)
        iou, weight = iou_within_uncertainty(track, reach, seen)
        distance = squared_mahalanobis(track[:2] - seen[:2], variance.take(t, 1))
        distance /= options.gate_chi2
        overlap = iou * weight
        same_class = tracks.votes.argmax(1)[t] == detections.class_id[d]
        cost = (1 - options.distance_weight) * (1 - overlap)
        cost += options.distance_weight * np.minimum(distance, 1) + options.penalty * ~same_class
        near = (distance < 1) | (iou > options.gate_iou)
        good = near & (same_class | (overlap > options.low_iou))
        if not frame.lazy.available:
            growth = np.log(track[2:] / np.maximum(seen[2:], 1e-3))  # (2, M)
            good &= (np.abs(growth) < math.log(options.motion_only_size)).all(0)
            good &= iou >= options.motion_only_iou
        return Pairs(*(x[good] for x in (t, d, cost, iou, weight, same_class)))

    def _priority_cost(self) -> Array:
        """Return the extra cost (T,) that lets confirmed tracks just seen choose first."""
        tracks = self.state.tracks
        penalty = self.matching.penalty
        age = np.minimum(np.maximum((tracks.missed - 1) / self.matching.age_frames, 0), 1)
        return np.asarray(penalty * age + penalty * (tracks.identity < 0))

    def _match(
        self, pairs: Pairs, cost: Array, priority: Array | float, possible: BoolArray,
        must_agree: BoolArray, rivals: BoolArray, lazy: LazyEmbeddings,
    ) -> tuple[IntArray, BoolArray]:  # fmt: skip
        """Assign at least cost; compare the appearance where it must agree; assign again.

        The loop terminates: every round compares at least one new detection.

        Args:
            cost, possible: (M,). priority: added to the cost. must_agree: (M,) pairs whose
                appearance must agree. rivals: (M,) pairs that compete.
        Returns:
            pairs that are matched, their numbers; pairs refused by appearance (M,).
        """
        t = pairs.track
        d = pairs.detection
        refused = np.zeros(len(cost), bool)
        tracks = self.state.tracks
        compared = np.full(len(lazy.done), not (lazy.available and tracks.embedding.shape[1]))
        while True:
            good = np.flatnonzero(possible & ~refused & (cost < self.matching.max_cost))
            matched = good[assign(t[good], d[good], (cost + priority)[good])]
            to_embed = matched[must_agree[matched] & ~compared[d[matched]]]
            if not len(to_embed):
                return matched, refused
            rivalled = rivals & must_agree & np.isin(t, t[to_embed])
            requested = np.zeros_like(compared)
            requested[d[to_embed]] = requested[d[rivalled]] = True
            requested &= ~compared
            compared |= requested
            cost, against = self._blend_appearance(pairs, cost, requested, lazy)
            refused |= against & must_agree

    def _blend_appearance(
        self, pairs: Pairs, cost: Array, requested: BoolArray, lazy: LazyEmbeddings
    ) -> tuple[Array, BoolArray]:
        """Blend the appearance of the requested detections (D,) into the cost.

        Tracks without an embedding count as half similar.

        Returns:
            cost (M,), and the pairs (M,) that boxes and appearance together contradict.
        """
        rows = np.flatnonzero(requested)
        some = np.flatnonzero(requested[pairs.detection])
        tracks = self.state.tracks
        cosines = part_cosines(tracks.embedding, lazy.get(rows), lazy.foreground_width)
        t = pairs.track[some]
        column = np.searchsorted(rows, pairs.detection[some])
        known = tracks.embedded[t] >= 0
        logit = self.state.match_calibration.logit(*(part[t, column] for part in cosines))
        unlike = 1 / (1 + np.exp(np.where(known, logit, 0)))
        weight = self.config.appearance_weight
        against = np.zeros(len(cost), bool)
        cost = cost.copy()
        cost[some] = (1 - weight) * cost[some] + weight * unlike
        overlap = pairs.iou[some] - self.matching.penalty * ~pairs.same_class[some]
        evidence = self._place_evidence(overlap, pairs.overlap_weight[some])
        against[some] = known & (logit + evidence < 0)
        return cost, against

    def _place_evidence(self, iou: Array, weight: Array) -> Array:
        """Return the log odds (...) of one object by the overlap of its boxes and its weight."""
        options = self.matching
        return (options.iou_odds * iou - options.no_overlap_odds) * weight

    def _update_states(self, frame: FrameContext, track_of: IntArray) -> None:
        """Update the matched tracks; boxes of low score have a larger measurement noise."""
        rows = np.flatnonzero(track_of >= 0)
        t = track_of[rows]
        tracks = self.state.tracks
        mean = tracks.mean[t]
        score = frame.detections.score[rows]
        growth = (np.maximum(1 - score, 0.05) / 0.2) ** SCORE_NOISE  # (n,) 1 at .8
        noise = STD_POSITION * _noise_scale(mean) * growth[:, None]
        tracks.mean[t], tracks.cov[t] = kalman_update(mean, tracks.cov[t], frame.box[rows], noise)
        self._count(frame.detections, rows, t)

    def _count(self, detections: Detections, rows: IntArray, t: IntArray) -> None:
        """Reset the missed frames of the tracks t and add the class votes of their detections."""
        tracks = self.state.tracks
        tracks.missed[t] = 0
        classes = detections.class_id[rows]
        tracks.votes = widen(tracks.votes, np.empty((0, classes.max(initial=0) + 1)))
        tracks.votes[t, classes] += detections.score[rows]

    def _spawn(self, frame: FrameContext, track_of: IntArray) -> None:
        """Start a tentative track at every unmatched detection of sufficient score."""
        state = self.state
        detections = frame.detections
        rows = np.flatnonzero((track_of < 0) & (detections.score >= self.config.new_score))
        if not len(rows):
            return
        new = np.arange(len(rows))
        track_of[rows] = len(state.tracks.mean) + new
        tracklet = state.next_tracklet + new
        spawned = TrackState.spawn(frame.box[rows], tracklet, frame.number, self.config)
        state.tracks = state.tracks.append(spawned)
        state.next_tracklet += len(rows)
        self._count(detections, rows, track_of[rows])

    def _embed(self, frame: FrameContext, track_of: IntArray) -> None:
        """Embed tracks before confirmation and periodically; calibrate the similarity.

        Embeddings requested by ambiguous matches are used for calibration only, not for a track's
        mean: their box may cover half of a neighbour.
        """
        lazy = frame.lazy
        if not lazy.available:
            return
        state = self.state
        tracks = state.tracks
        rows = np.flatnonzero(track_of >= 0)
        t = track_of[rows]
        confirmed = tracks.identity[t] >= 0
        soon = ~confirmed & (tracks.evidence[t] >= self.config.n_init - 1)
        due = soon | (state.detector_runs % max(1, self.config.embed_every) == 0)
        # Positive pairs: a track and its own detection. Negative pairs: detections of other tracks
        known = confirmed & (tracks.embedded[t] >= 0) & (lazy.done[rows] | due)
        if known.any():
            found = lazy.get(rows[known])
            parts = part_cosines(tracks.embedding[t[known]], found, lazy.foreground_width)  # (n, n)
            state.match_calibration.add_frame(*parts, frame.detections.class_id[rows[known]])
        rows = rows[due]
        t = t[due]
        if not len(rows):
            return
        embedding = lazy.get(rows)  # (n, E)
        state.gallery.foreground_width = lazy.foreground_width
        tracks.embedding = widen(tracks.embedding, embedding)
        keep = np.where(tracks.embedded[t] >= 0, EMBEDDING_MOMENTUM, 0.0)[:, None]
        tracks.embedding[t] = unit_rows(keep * tracks.embedding[t] + (1 - keep) * embedding)
        tracks.embedded[t] = frame.number
        old = tracks.identity[t] >= 0
        if old.any():
            class_id = frame.detections.class_id[rows[old]]
            self._add_to_gallery(frame, embedding[old], t[old], class_id)

    def _add_to_gallery(
        self, frame: FrameContext, embedding: Floats, t: IntArray, class_id: IntArray
    ) -> None:
        """Add embeddings (n, E) of tracks t to the gallery; calibrate against its first views."""
        state = self.state
        identity = state.tracks.identity[t]
        gallery = state.gallery
        if len(gallery.count):
            gallery.reserve(len(state.last_seen), embedding.shape[1])
            first = gallery.rows[identity, 0] * (gallery.count[identity, None] > 1)
            parts = part_cosines(embedding, first, gallery.foreground_width)
            state.reid_calibration.add_frame(*parts, class_id)
        gallery.add(identity, embedding, self._viewing_rays(frame, t))

    def _viewing_rays(self, frame: FrameContext, t: IntArray) -> Array:
        """Return viewing directions (n, 3) of tracks in the world of component 0, else NaN."""
        if frame.view is None or self.state.component:
            return np.full((len(t), 3), np.nan)
        return viewing_rays(xyxy_from_cxcywh(self.state.tracks.mean[t, :, 0]), frame.view)

    def _confirm(self, frame: FrameContext) -> None:
        """Assign an identity, known or new, to tracks with enough detections.

        A re-identified track needs one detection less, as its appearance agrees. The first tracks
        of a video need only one detection (as in SORT).
        """
        state = self.state
        tracks = state.tracks
        needed = self.config.n_init if (state.last_seen >= 0).any() else 1
        detected = tracks.missed == 0
        enough = tracks.evidence >= min(needed, self.config.n_init - 1)
        ready = np.flatnonzero(detected & (tracks.identity < 0) & enough)
        state.last_seen[tracks.identity[detected & (tracks.identity >= 0)]] = frame.number
        if not len(ready):
            return
        identity = self._reidentify(frame, ready)  # (n,) identity or -1
        confirmed = (identity >= 0) | (tracks.evidence[ready] >= needed)
        ready = ready[confirmed]
        identity = identity[confirmed]
        # coasting tracks of identities that returned are retired
        tracks.missed[np.isin(tracks.identity, identity[identity >= 0])] = np.iinfo(np.int64).max
        fresh = identity < 0
        count = np.arange(fresh.sum())
        identity[fresh] = len(state.last_seen) + count
        tracks.identity[ready] = identity
        new_classes = tracks.votes[ready[fresh]].argmax(1)
        state.last_seen = np.append(state.last_seen, 0 * count)
        state.identity_class = np.append(state.identity_class, new_classes)
        state.numbers = np.append(state.numbers, state.next_number + count)
        state.next_number += len(count)
        state.last_seen[identity] = frame.number
        seen = ready[tracks.embedded[ready] >= 0]
        if len(seen):
            rays = self._viewing_rays(frame, seen)
            state.gallery.add(tracks.identity[seen], tracks.embedding[seen], rays)

    def _reidentify(self, frame: FrameContext, ready: IntArray) -> IntArray:
        """Re-identify tracks about to be confirmed: identity (n,), or -1.

        A match needs a sufficient probability from appearance and, where known, 3D position,
        relative to the other candidates. It is not gated by overlap, aspect ratio or pixel
        distance, as the camera may return from anywhere. Identities seen since the new track
        started, and those whose ellipsoid projects elsewhere, are excluded. Moving objects have no
        ellipsoid.
        """
        state = self.state
        tracks = state.tracks
        result = np.full(len(ready), -1, np.int64)
        identity = np.flatnonzero(state.last_seen < tracks.first[ready].max(initial=0))  # (I,)
        if not len(identity) or not self.config.remember:
            return result
        box = tracks.mean[ready, :, 0]
        overlap = (box, identity, frame.view, frame.image_size)
        iou, weight = self.ellipsoid_map.overlap(*overlap)
        at_projection = iou * weight > self.matching.low_iou
        embedding = tracks.embedding[ready]
        rays = self._viewing_rays(frame, ready)
        logit = state.reid_calibration.logit(*state.gallery.parts(embedding, identity, rays))
        logit[at_projection & np.isinf(logit)] = 0  # without appearance the position decides
        logit += np.where(at_projection, self._place_evidence(iou, weight), 0)
        possible = state.last_seen[identity] < tracks.first[ready][:, None]
        possible &= state.identity_class[identity] == tracks.votes[ready].argmax(1)[:, None]
        compared, on_map = state.map_votes
        if frame.view is not None and on_map < self.matching.map_agreement * compared:
            possible &= state.last_seen[identity] >= 0  # not those known from the map only
        logit[~possible | (iou == 0)] = -np.inf
        probability = match_probability(logit)
        good = probability >= self.config.return_probability
        row, column = np.nonzero(good | (at_projection & (logit > 0)))
        taken = assign(row, column, 1 - probability[row, column])
        result[row[taken]] = identity[column[taken]]
        return result

    def _compare_with_map(self, frame: FrameContext) -> None:
        """Count detections of classes that the given map has, and those that lie on its objects."""
        identity = np.flatnonzero(self.ellipsoid_map.given & self.ellipsoid_map.known)
        if frame.view is None or not len(identity):
            return
        state = self.state
        detections = frame.detections
        same_class = detections.class_id[:, None] == state.identity_class[identity]  # (D, I)
        rows = (detections.score >= self.config.high_score) & same_class.any(1)
        where = (frame.box, identity, frame.view, frame.image_size)
        iou, weight = self.ellipsoid_map.overlap(*where)
        on_object = (same_class & (iou * weight > self.matching.low_iou)).any(1)
        state.map_votes += [rows.sum(), (rows & on_object).sum()]

    def _report(self, frame: FrameContext, track_of: IntArray) -> Tracks:
        """Return the tracked detections of this frame, tentative ones with track_id 0."""
        tracks = self.state.tracks
        detections = frame.detections
        rows = np.flatnonzero(track_of >= 0)
        t = track_of[rows]
        return Tracks(
            frame=np.full(len(rows), frame.number),
            track_id=np.append(self.state.numbers, 0)[tracks.identity[t]],  # -1: the last
            tracklet_id=tracks.tracklet[t],
            xyxy=detections.xyxy[rows],
            score=detections.score[rows],
            class_id=detections.class_id[rows],
            detection_index=rows,
        )

    def _retire(self) -> None:
        """Drop tracks that coasted too long; their identities stay in the gallery."""
        tracks = self.state.tracks
        config = self.config
        tentative = np.minimum(tracks.evidence, config.n_init)
        stays = tracks.missed <= np.where(tracks.identity < 0, tentative, config.coast_frames)
        if not stays.all():
            self.state.tracks = tracks.select(stays)

    def save(self, path: str | Path) -> None:
        """Write the state, without the embedder, as an .npz file.

        A tracker that `load` reads continues exactly as this one does.
        """
        options = {name: dataclasses.asdict(getattr(self, name)) for name in ("config", "matching")}
        facts = {"version": STATE_VERSION, "components": len(self.state.maps)}
        save_npz(Path(path), state_arrays(self.state), **facts, **options)

    @classmethod
    def load(cls, path: str | Path, embedder: Embedder | None = None) -> Tracker:
        """Read a tracker that `save` wrote; embedder: the same as that of the saved tracker."""
        try:
            arrays, facts = load_npz(Path(path), sealed=True)
            if facts["version"] != STATE_VERSION:
                raise ValueError(f"version {facts['version']}, this is {STATE_VERSION}")
            matching = MatchingOptions(**facts["matching"])
            tracker = cls(TrackerConfig(**facts["config"]), embedder, matching)
            tracker.state.maps = [EllipsoidMap() for _ in range(facts["components"])]
            restore_state(tracker.state, arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise ReobjError(
                f"{path}: not the state of a tracker of this version ({error}); "
                "expected a file written by Tracker.save"
            ) from error
        return tracker


# ---- The loop ----------------------------------------------------------------------------------


def track(
    video: Video | str | Path | int,
    detector: Any = None,
    tracker: Tracker | None = None,
    *,
    poses: Poses | None = None,
) -> Iterator[tuple[Frame, Tracks]]:
    """Track a video frame by frame (online).

    Args:
        video: a `Video`, or its source: file, folder of images, glob, camera index, stream URL.
        detector: function image -> detections (`OnnxDetector`, your own), a name of `list_models`
            such as "fast", a .onnx file, a file of recorded detections, or a `DetectionSource`;
            default: the default detector. A function returns None for frames that it skips.
        tracker: default: a `Tracker` with the bundled embedder.
        poses: cameras of the video, if known; objects are then also re-identified by 3D position.
    Yields:
        Frame, and its Tracks in pixels of the frame's image. Decisions that `run` takes after the
        video are not included. `tracker.latest` has the tentative tracks of the frame too.

    >>> for frame, tracks in track("room.mp4", "det.txt"):  # doctest: +SKIP
    ...     print(frame.index, tracks.track_id)
    """
    video = video if isinstance(video, Video) else Video(video)
    source = open_detections(video, DetectConfig(), detector)
    tracker = tracker or Tracker(embedder=Embedder())
    cameras = camera_inputs(poses, video.scale)
    detector_ran = True if source.always_looks else None
    for frames in in_batches(video, 1 if video.is_live else source.batch):
        for frame, found in zip(frames, source.detect(frames), strict=True):
            tracks = tracker.update(found, frame.image, looked=detector_ran, **cameras(frame.index))
            yield frame, dataclasses.replace(tracks, frame=np.full(len(tracks), frame.index))


# ---- The whole chain ---------------------------------------------------------------------------


def run(
    source: Video | str | Path | int | None,
    out: str | Path | None = None,
    config: Config | Mapping[str, Any] | None = None,
    *,
    detector: Any = None,
    detections: pipeline.DetectionInput = None,
    tracks: str | Path | None = None,
    map: str | Path | None = None,
    map_frozen: bool = False,
    in_3d: bool = True,
    overwrite: bool = False,
    show: bool = False,
) -> Result:
    """Run the pipeline on a video (detect, poses, track, fit) and write the output folder.

    Args:
        source: video file, folder of images, glob, camera index or stream URL (Ctrl-C ends a live
            source and writes its files), or a `Video`, whose options replace config.input; None: no
            images, only detections and poses.
        out: output folder; cached results of earlier stages in it are used again. Default: in the
            working folder, with the name of the source: room_out for room.mp4.
        config: options, or a dict of them: {"detect": {"classes": "chair"}}.
        detector: as in `track`; default: config.detect.model. detections: the same argument, by
            the name of the flag --detections.
        tracks: file of identities, instead of detector, tracker and linker.
        map: map of the room, in which objects keep their numbers over several recordings; it is
            made if it does not exist. map_frozen: do not change the file. They replace the
            options of config.map.
        in_3d: False for 2D identities only. show: show frames and identities live, in rerun's
            viewer or, where rerun is missing, on a page of this machine.
    Returns:
        Result; if the reconstruction fails, it has a warning and no cameras and ellipsoids. With a
        map, `Result.changes` is what changed in the room.
    Raises:
        ReobjError: invalid input; the message says what to do.
    """
    if detector is not None and detections is not None:
        raise ReobjError("detector and detections are the same argument: give one of them")
    config = as_config(Config(), config)
    detect, detections = with_detector(config.detect, detections if detector is None else detector)
    room = config.map
    if map is not None or map_frozen:
        room = dataclasses.replace(room, path=str(map or room.path), frozen=map_frozen)
    config = dataclasses.replace(config, detect=detect, map=room)
    with pipeline.open_job(source, out, config, tracks or detections, overwrite, show) as job:
        in_3d = in_3d and job.config.poses.mode != "none"
        supplied = supplied_poses(job.video, job.config.poses) if in_3d else None
        detected = None
        if tracks:
            result = pipeline.given_tracks(job, tracks, job.workspace.last_tracks)
            boxes = result.tracks
            class_names = result.class_names
        else:
            cameras = supplied.poses if supplied else None
            detected, boxes = pipeline.detect(job, detections, in_3d, cameras)
            class_names = tuple(detected.class_names)
        poses: Poses | None = None
        models: list[Path] = []
        if supplied:
            poses = pipeline.check_cameras(job, supplied, boxes if tracks else _tracklets(boxes))
        elif in_3d and not job.video.is_live:
            poses, models = pipeline.reconstruct(job, boxes, class_names)
        poses, models, placed = pipeline.place(job, poses, models)
        if detected is not None:
            result = _track_video(job, detected, poses)
        log.info("identities: %d", len(np.unique(result.tracks.track_id)))
        result = pipeline.save_last(job, result, poses, models, placed)
        return pipeline.finish(job, result, placed)


def refit(
    out: str | Path,
    config: Config | Mapping[str, Any] | None = None,
    tracks: str | Path | None = None,
    edits: str | Path | None = None,
) -> Result:
    """Fit the objects of an output folder again, by default with its last options.

    Identities keep their numbers; other options of linking (`objects.link`, `objects.moving`) link
    the tracks again, and new identities get new numbers. `config.map` names the map of the room.

    Args:
        config: options; or a dict of those that differ from the last ones.
        tracks: file of identities that replace the tracks.
        edits: file of corrections that replace those of the folder.
    """
    if tracks and edits:
        raise ReobjError("--tracks replaces all identities, --edits corrects them: one at a time")
    with Workspace.open(out) as workspace:
        last = workspace.load_last()
        video, warnings = (workspace.video(), []) if tracks else workspace.video_or_frames(last)
        corrections = read_edits(edits) if edits else None
        before = pipeline.last_config(out)
        config = as_config(before, config)
        config = dataclasses.replace(config, input=video.config, poses=config.poses.absolute())
        pipeline.check_objects(config.objects)
        job = pipeline.Job(video, workspace, config)
        job.check_known_size(last.class_names)
        result = dataclasses.replace(last, warnings=[*last.warnings, *warnings])
        links = None
        if tracks:
            result = pipeline.given_tracks(job, tracks, last)
            result = pipeline.save_last(job, result, last.poses, workspace.last_models())
        else:
            links = workspace.last_links()
        result = dataclasses.replace(result, edits=corrections)
        placed = last.poses is not None and bool(last.poses.map_id)
        with opened_map(config.map, must_exist=placed) as room:
            return pipeline.finish(dataclasses.replace(job, room=room), result, links=links)


def _track_video(job: pipeline.Job, source: DetectionSource, poses: Poses | None) -> Result:
    """Track all frames, or load the tracks from the cache; live sources are not cached."""
    video = job.video
    config = job.config
    poses = poses if poses is not None and poses.known.any() else None
    setup = (config.embed, config.tracker, config.device, poses_key(poses))
    path = job.workspace.path("tracks", *detections_key(source, video), *setup)
    keep = bool(source.key) and not video.is_live
    with job.timed("track", may_be_cached=keep):
        if keep and (known := load_cached(path, load_tracked)):
            return known
        embedder = make_embedder(config.embed.model, config.embed.head, *job.runtime)
        tracker = Tracker(config.tracker, embedder)
        steps = track(video, source, tracker, poses=poses)
        if job.viewer is not None:
            steps = job.viewer.follow(steps, source.class_names, video, poses)
        result = collect_tracks(steps, tracker, video, source, job.progress)
        result = dataclasses.replace(result, boxes_3d=boxes_3d_of(source.recorded))
        save_tracked(result, path)
    return result


def _tracklets(boxes: Tracks) -> Tracks:
    """Track detections by motion alone, to check supplied poses before they are used."""
    tracker = Tracker()
    tracks_of_frames = list[Tracks]()
    rows_of_frames = rows_by(boxes.frame)
    for rows in rows_of_frames:
        tracker.update(Detections(boxes.xyxy[rows], boxes.score[rows], boxes.class_id[rows]))
        tracks_of_frames.append(tracker.latest)
    frames = [int(boxes.frame[rows[0]]) for rows in rows_of_frames]
    return Tracks.concatenate(frames, tracks_of_frames)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 130 after Ctrl-C, 1 for a fault of ours.

    Ctrl-C is the way to end a live source: its files are written, and 0 is returned.
    """
    return cli.main(list(sys.argv[1:] if argv is None else argv), run, refit)


if __name__ == "__main__":
    sys.exit(main())
