"""Shapes that flow through the tool: frames, detections, embeddings, tracks; boxes; errors."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Image = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
log = logging.getLogger("reobj_track")


class ReobjError(ValueError):
    """A mistake in the input: says what, where, what was expected and what to do (exit code 2)."""


COCO_CLASSES = (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant "
    "stop_sign parking_meter bench bird cat dog horse sheep cow elephant bear zebra giraffe "
    "backpack umbrella handbag tie suitcase frisbee skis snowboard sports_ball kite "
    "baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork "
    "knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake "
    "chair couch potted_plant bed dining_table toilet tv laptop mouse remote keyboard "
    "cell_phone microwave oven toaster sink refrigerator book clock vase scissors teddy_bear "
    "hair_drier toothbrush"
)
COCO_NAMES: tuple[str, ...] = tuple(name.replace("_", " ") for name in COCO_CLASSES.split())


def option(default: Any, text: str, flag: str = "") -> Any:
    """Declare a config field: default, help text and, for the few that users need, a flag."""
    return field(default=default, metadata={"help": text, "flag": flag})


@dataclass(frozen=True, slots=True)
class Frame:
    """One video frame: source number (0-based), time in seconds, BGR image (H, W, 3) uint8.

    (The image is None in an `ImagelessVideo`.)
    """

    index: int
    time_s: float
    image: Image


@dataclass(frozen=True, slots=True)
class Detections:
    """Detections of one frame as a struct of arrays.

    Attributes:
        xyxy: (D, 4) boxes x1, y1, x2, y2, pixels, corner convention.
        score: (D,) in [0, 1].
        class_id: (D,) index into the class names.
        masks: (D, H, W) bool at the frame's size, or None. A mask without any pixel means "no
            mask".
    """

    xyxy: Array
    score: Array
    class_id: IntArray
    masks: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.xyxy)

    def __getitem__(self, keep: Any) -> Detections:
        """Select by index array, boolean mask or slice."""
        masks = None if self.masks is None else self.masks[keep]
        return Detections(self.xyxy[keep], self.score[keep], self.class_id[keep], masks)

    @staticmethod
    def empty() -> Detections:
        """Make the detections of a frame without any."""
        return Detections(np.empty((0, 4)), np.empty(0), np.empty(0, np.int64))

    @staticmethod
    def from_array(rows: npt.ArrayLike) -> Detections:
        """Make from (N, 6) rows x1, y1, x2, y2, confidence, class.

        >>> Detections.from_array([[0, 0, 10, 20, 0.9, 56]]).class_id
        array([56])
        """
        rows = np.asarray(rows, np.float64) if np.size(rows) else np.empty((0, 6))
        if rows.ndim != 2 or rows.shape[1] != 6:
            expected = "(N, 6): x1, y1, x2, y2, confidence, class"
            raise ReobjError(f"detections of shape {rows.shape}, expected {expected}")
        return Detections(rows[:, :4], rows[:, 4], rows[:, 5].astype(np.int64))

    @staticmethod
    def from_supervision(found: Any) -> Detections:
        """Make from an object with xyxy (N, 4), confidence, class_id and mask, as supervision's.

        What is None there counts as score 1, class 0, no mask. `Tracker.update` takes such objects
        as they are; `Tracks.to_supervision` goes back.
        """
        return as_detections(found)


@dataclass(frozen=True, slots=True)
class Embeddings:
    """Two-part appearance of detections: rows of unit length for object and surroundings.

    Attributes:
        foreground: (D, E1); background: (D, E2), E2 may be 0.
    """

    foreground: npt.NDArray[np.floating[Any]]
    background: npt.NDArray[np.floating[Any]]

    @staticmethod
    def empty() -> Embeddings:
        """Make the embeddings of no detections."""
        return Embeddings(np.empty((0, 0)), np.empty((0, 0)))


@dataclass(frozen=True, slots=True)
class Tracks:
    """Tracked detections as a struct of arrays of length M: of a frame, or of a whole video.

    Attributes:
        frame: number of the frame: what a `Tracker` returns counts its updates, from 0; a table of
            a video has the source's numbers, in ascending order.
        track_id: identity, from 1; 0 while a track is still tentative.
        tracklet_id: uninterrupted piece of track, from 1; an identity that returns has several.
        xyxy, score, class_id: of the detection; in the table of a video in native pixels.
        detection_index: row of the detection in what was handed to the tracker; -1: unknown, or a
            filled gap (score 0).
    """

    frame: IntArray
    track_id: IntArray
    tracklet_id: IntArray
    xyxy: Array
    score: Array
    class_id: IntArray
    detection_index: IntArray

    def __len__(self) -> int:
        return len(self.track_id)

    def __getitem__(self, keep: Any) -> Tracks:
        return Tracks(*(getattr(self, f.name)[keep] for f in dataclasses.fields(self)))

    @staticmethod
    def empty() -> Tracks:
        """Make the tracks of a frame or video without any."""
        none = np.empty(0, np.int64)
        return Tracks(none, none, none, np.empty((0, 4)), np.empty(0), none, none)

    @staticmethod
    def concatenate(frames: Sequence[int], steps: Sequence[Tracks], scale: float = 1.0) -> Tracks:
        """Make the table of a video from a tracker's results, frame by frame.

        Rows of a tracklet get the identity that was confirmed later; what never was is left out.

        Args:
            frames: source number of each. scale: pixels of the frames per native pixel.
        """
        if not steps:
            return Tracks.empty()
        columns = [f.name for f in dataclasses.fields(Tracks)]
        all_of = {n: np.concatenate([getattr(s, n) for s in steps]) for n in columns}
        all_of["frame"] = np.repeat(np.asarray(frames, np.int64), [len(s) for s in steps])
        tracklets, inverse = np.unique(all_of["tracklet_id"], return_inverse=True)
        identity = np.zeros(len(tracklets), np.int64)
        np.maximum.at(identity, inverse, all_of["track_id"])
        all_of |= {"track_id": identity[inverse], "xyxy": all_of["xyxy"] / scale}
        table = Tracks(**all_of)
        return table[table.track_id > 0]

    @staticmethod
    def joined(tables: Sequence[Tracks]) -> Tracks:
        """Put tables behind each other and order their rows by frame."""
        names = [f.name for f in dataclasses.fields(Tracks)]
        rows = Tracks(*(np.concatenate([getattr(t, name) for t in tables]) for name in names))
        return rows[np.argsort(rows.frame, kind="stable")]

    def with_identities(self, track_id: IntArray) -> Tracks:
        """Return the rows with other identities, renumbered 1, 2, ... by first appearance."""
        _, first, inverse = np.unique(track_id, return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(1, len(first) + 1)
        return dataclasses.replace(self, track_id=rank[inverse.ravel()])

    def to_array(self) -> Array:
        """Return (M, 8) rows x1, y1, x2, y2, id, score, class, detection index."""
        columns = (self.xyxy, self.track_id, self.score, self.class_id, self.detection_index)
        return np.column_stack(columns).astype(np.float64).reshape(-1, 8)

    def to_supervision(self, detections: Any) -> Any:
        """Return the rows of supervision's `Detections` that are tracked, with `tracker_id` set.

        Args:
            detections: what was handed to `update` (anything that has `tracker_id` and can be
                indexed by rows); its masks and data are kept, itself it stays as it is.
        """
        found = detections[self.detection_index]
        found.tracker_id = self.track_id
        return found


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """A join or a split of tracklets and its evidence.

    Attributes:
        kind: "join" or "split". tracklets: ids of all that it concerns. kept: always True; False
            in older files, of a join that was tried and undone.
        place_iou: median overlap of the boxes with their solid, None where appearance decided.
        appearance_log_odds: that it is one object, by its embeddings (`SimilarityCalibration`).
    """

    kind: str
    tracklets: tuple[int, ...]
    place_iou: float | None
    appearance_log_odds: float
    kept: bool

    @staticmethod
    def from_json(entry: dict[str, Any]) -> LinkEvent:
        """Read an entry of objects.json's links; before 0.2 the log odds were called `look`."""
        log_odds = entry.get("appearance_log_odds", entry.get("look", 0.0))
        found = (entry["kind"], tuple(entry["tracklets"]), entry["place_iou"], log_odds)
        return LinkEvent(*found, entry["kept"])


def as_detections(found: Any) -> Detections:
    """Take detections as they come: ours, (N, 6) rows, or an object like supervision's."""
    if isinstance(found, Detections):
        made = found
    elif hasattr(found, "xyxy"):
        count, masks = len(found.xyxy), getattr(found, "mask", None)
        score, label = getattr(found, "confidence", None), getattr(found, "class_id", None)
        made = Detections(
            np.asarray(found.xyxy, np.float64).reshape(-1, 4),
            np.asarray(np.ones(count) if score is None else score, np.float64),
            np.asarray(np.zeros(count) if label is None else label, np.int64),
            None if masks is None else np.asarray(masks, bool),
        )
    else:
        made = Detections.from_array(found)
    masks = made.xyxy if made.masks is None else made.masks
    lengths = [len(values) for values in (made.xyxy, made.score, made.class_id, masks)]
    if len(set(lengths)) > 1 or not np.isfinite(made.xyxy).all():
        raise ReobjError(f"{lengths} boxes, scores, classes, masks do not fit, or hold NaN")
    return made


def frame_step(table: Tracks) -> int:
    """Return the frames from one that was read to the next: more than 1 with `--every`."""
    frames = np.unique(table.frame)
    return int(np.diff(frames).min()) if len(frames) > 1 else 1


def object_classes(table: Tracks) -> dict[int, int]:
    """Return the class of each object: the one with the largest sum of scores."""
    objects, row = np.unique(table.track_id, return_inverse=True)
    classes, column = np.unique(table.class_id, return_inverse=True)
    votes = np.zeros((len(objects), len(classes)))
    np.add.at(votes, (row, column), table.score)
    best = classes[votes.argmax(1)] if len(objects) else classes
    return dict(zip(objects.tolist(), best.tolist(), strict=True))


def class_shares(table: Tracks, group: IntArray, count: int) -> Array:
    """Return the share of every class in the scores of each group of rows, (count, C)."""
    votes = np.zeros((count, int(table.class_id.max(initial=0)) + 1))
    np.add.at(votes, (group, table.class_id.clip(0)), table.score)
    return np.asarray(votes / np.maximum(votes.sum(1, keepdims=True), 1e-9))


def box_area(xyxy: Array) -> Array:
    """Return the area (...) of boxes (..., 4)."""
    return np.asarray((xyxy[..., 2:] - xyxy[..., :2]).prod(-1), np.float64)


def box_iou(a_xyxy: Array, b_xyxy: Array) -> Array:
    """Return the intersection over union (A, B) of boxes a (A, 4) with boxes b (B, 4)."""
    a, b = a_xyxy[:, None], b_xyxy[None]  # (A, 1, 4), (1, B, 4)
    overlap = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])  # (A, B, 2)
    inter = overlap.clip(0).prod(-1)  # (A, B)
    union = box_area(a) + box_area(b) - inter
    return np.asarray(inter / np.maximum(union, 1e-9), np.float64)


def cxcywh_from_xyxy(xyxy: Array) -> Array:
    """Convert boxes (N, 4) from corners to centre and size."""
    return np.concatenate([(xyxy[:, :2] + xyxy[:, 2:]) / 2, xyxy[:, 2:] - xyxy[:, :2]], 1)


def xyxy_from_cxcywh(box: Array) -> Array:
    """Convert boxes (N, 4+) from centre and size to corners (N, 4)."""
    half = box[:, 2:4] / 2
    return np.concatenate([box[:, :2] - half, box[:, :2] + half], 1)


def rows_by(group: IntArray) -> list[IntArray]:
    """List the row numbers of each distinct value, in the order of the values."""
    order = np.argsort(group, kind="stable")
    _, starts = np.unique(group[order], return_index=True)
    return np.split(order, starts[1:]) if len(group) else []


def widen(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Pad the second axis of a with zeros to the width of b.

    (For classes or embeddings that are seen for the first time.)
    """
    if a.ndim != 2 or a.shape[1] >= b.shape[1]:
        return a
    return np.concatenate([a, np.zeros((len(a), b.shape[1] - a.shape[1]), a.dtype)], 1)


def unit_rows(rows: npt.NDArray[Any]) -> Array:
    """Scale rows (N, E) to unit length; zero rows stay zero."""
    rows = np.asarray(rows, np.float64)
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12))


def object_color(object_id: int) -> tuple[int, int, int]:
    """Return the BGR colour of an identity, well apart from its neighbours (golden-angle hues)."""
    hue = object_id * 0.381966 % 1.0
    color = (round(hue * 179), 200 - 60 * (object_id % 2), 255 - 45 * (object_id // 2 % 2))
    hsv = np.array([[color]], np.uint8)
    blue, green, red = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red
