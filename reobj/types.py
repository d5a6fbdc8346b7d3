"""Data types of the tool: frames, detections, embeddings, tracks; box geometry; errors."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Image = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
Vector = np.ndarray[tuple[Literal[3]], np.dtype[np.float64]]
Quaternion = np.ndarray[tuple[Literal[4]], np.dtype[np.float64]]
Covariance = np.ndarray[tuple[Literal[9], Literal[9]], np.dtype[np.float64]]

# Numbers in JSON files. Up to 2**53 parsers that use doubles are exact; products of a few lengths
# of at most NUMBER_MAX stay within the range of doubles.
NUMBER_MAX = 1e12
NonNegativeInt = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
PositiveInt = Annotated[int, msgspec.Meta(ge=1, le=2**53)]
Int32 = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
FiniteFloat = Annotated[float, msgspec.Meta(ge=-NUMBER_MAX, le=NUMBER_MAX)]
NonNegativeFloat = Annotated[float, msgspec.Meta(ge=0, le=NUMBER_MAX)]
PositiveFloat = Annotated[float, msgspec.Meta(gt=0, le=NUMBER_MAX)]

log = logging.getLogger("reobj_track")
NOTE = 25  # level of a log line that is no warning, but is shown without --verbose
NOTE_START = "note: "  # of a message of a result that is no warning


def log_message(text: str) -> None:
    """Log a message of a result as a note or a warning."""
    if text.startswith(NOTE_START):
        log.log(NOTE, "%s", text.removeprefix(NOTE_START))
    else:
        log.warning("%s", text)


class ReobjError(ValueError):
    """Unusable input (exit code 2): what is wrong, where, what was expected and what to do.

    The message passes through `one_line`.
    """

    def __init__(self, text: str = "") -> None:
        super().__init__(one_line(text))


def one_line(text: str) -> str:
    """Make a text that may quote any input safe to print as one line.

    Removes the secrets of URLs, escapes control characters, cuts the middle out of long texts.
    """
    text = printable(without_secrets(text))
    most = 700  # characters: our messages are shorter, longer ones quote the input
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 3 :]}"


def printable(text: str) -> str:
    """Escape characters that are not printable, so that a name cannot control the terminal.

    >>> printable("a chair\\n")
    'a chair\\\\n'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def without_secrets(text: str) -> str:
    """Remove secrets from the URLs in a text: scheme, host and path remain.

    Removed are user and password, also a password that contains "@" or "/", and all after the path:
    queries and parameters may hold passwords of cameras. A URL whose components are ambiguous is
    reduced to its scheme.

    >>> without_secrets("rtsp://me:secret@10.0.0.7/stream?pwd=x")
    'rtsp://10.0.0.7/stream'
    """
    # The scheme has at least two letters (C:/ is a drive) and at most 31, for linear time
    return re.sub(r"([a-z][a-z0-9+.-]{1,30}:/+)(\S*)", _public_part, text, flags=re.IGNORECASE)


def _public_part(url: re.Match[str]) -> str:
    """Cut a URL to scheme, host and path."""
    scheme, rest = url.groups()
    user, _, rest = rest.rpartition("@")
    parameters = r"[?#;&=]"  # end the path; rtsp://host/user=me&password=x has one too
    if re.search(parameters, user):  # the password has a parameter sign, or the "@" is in a query
        return f"{scheme}..."
    return scheme + re.split(parameters, rest)[0]


def counted(count: int, one: str, more: str) -> str:
    """Format a number with its noun.

    >>> counted(1, "box", "boxes")
    '1 box'
    """
    return f"{count:,} {one if count == 1 else more}"


def visible_name(name: str) -> str:
    """Replace control characters of a name by U+FFFD; XML cannot hold them either.

    >>> visible_name("a chair").isprintable()
    True
    """
    # C0, C1, surrogates, marks of text direction, noncharacters
    controls = "[\x00-\x1f\x7f-\x9f\ud800-\udfff\u202a-\u202e\u2066-\u2069\ufffe\uffff]"
    return re.sub(controls, "\ufffd", name)


# The 80 classes of COCO in the order of their numbers; a name of two words has an underscore here
COCO_NAMES: tuple[str, ...] = tuple(name.replace("_", " ") for name in (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant "
    "stop_sign parking_meter bench bird cat dog horse sheep cow elephant bear zebra giraffe "
    "backpack umbrella handbag tie suitcase frisbee skis snowboard sports_ball kite "
    "baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork "
    "knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake "
    "chair couch potted_plant bed dining_table toilet tv laptop mouse remote keyboard "
    "cell_phone microwave oven toaster sink refrigerator book clock vase scissors teddy_bear "
    "hair_drier toothbrush"
).split())  # fmt: skip


def option(
    default: Any, text: str, flag: str = "", old_flag: str = "", repeated: bool = False
) -> Any:
    """Declare a config field: default, help text and, for common options, a flag.

    old_flag: an earlier name of the flag that still works. repeated: the flag may be given several
    times; its values are joined by commas.
    """
    flags = [name for name in (flag, old_flag) if name]
    return field(default=default, metadata={"help": text, "flags": flags, "repeated": repeated})


@dataclass(frozen=True, slots=True)
class Frame:
    """One video frame: source number (0-based), time in seconds, BGR image (H, W, 3) uint8.

    (The image is None in an `ImagelessVideo`.)
    """

    index: int
    time_s: float
    image: Image = field(repr=False)


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
        """Return zero detections."""
        return Detections(np.empty((0, 4)), np.empty(0), np.empty(0, np.int64))

    @staticmethod
    def from_array(rows: npt.ArrayLike) -> Detections:
        """Convert (N, 6) rows x1, y1, x2, y2, confidence, class; [] gives zero detections.

        >>> Detections.from_array([[0, 0, 10, 20, 0.9, 56]]).class_id
        array([56])
        """
        return as_detections(rows)

    @staticmethod
    def from_supervision(detections: Any) -> Detections:
        """Convert supervision's `Detections`; None becomes score 1, class 0, no mask."""
        return as_detections(detections)

    def to_supervision(self) -> Any:
        """Convert to `supervision.Detections` (needs supervision)."""
        try:
            import supervision
        except ImportError as error:
            raise ReobjError("to_supervision needs supervision: pip install supervision") from error
        return supervision.Detections(
            xyxy=self.xyxy, mask=self.masks, confidence=self.score, class_id=self.class_id
        )


@dataclass(frozen=True, slots=True)
class Embeddings:
    """Appearance of detections: rows of unit length for the object and for its surroundings.

    Attributes:
        foreground: (D, E1); background: (D, E2), E2 may be 0.
    """

    foreground: npt.NDArray[np.floating[Any]]
    background: npt.NDArray[np.floating[Any]]

    @staticmethod
    def empty() -> Embeddings:
        """Return the embeddings of zero detections."""
        return Embeddings(np.empty((0, 0)), np.empty((0, 0)))


@dataclass(frozen=True, slots=True)
class Tracks:
    """Tracked detections of a frame or of a video, as a struct of arrays of length M.

    Attributes:
        frame: frame numbers. Of a `Tracker`: number of its update, from 0. Of a video: numbers of
            the source, ascending.
        track_id: identity, from 1; 0 while the track is tentative.
        tracklet_id: uninterrupted segment of a track, from 1; an identity that returns has several.
        xyxy, score, class_id: of the detection; of a video in native pixels.
        detection_index: row among the detections that the tracker was given; -1: unknown, or an
            interpolated gap (score 0).
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
        return Tracks(*(getattr(self, name)[keep] for name in self.__slots__))

    @staticmethod
    def empty() -> Tracks:
        """Return zero tracked detections."""
        none = np.empty(0, np.int64)
        return Tracks(none, none, none, np.empty((0, 4)), np.empty(0), none, none)

    @staticmethod
    def concatenate(frames: Sequence[int], steps: Sequence[Tracks], scale: float = 1.0) -> Tracks:
        """Concatenate a tracker's results of each frame to the table of a video.

        All rows of a tracklet get the identity that it was confirmed with later; rows of tracklets
        that were never confirmed are left out.

        Args:
            frames: source number of each step. scale: pixels of the frames per native pixel.
        """
        table = Tracks._stacked(steps)
        tracklets, inverse = np.unique(table.tracklet_id, return_inverse=True)
        identity = np.zeros(len(tracklets), np.int64)
        np.maximum.at(identity, inverse, table.track_id)
        counts = np.array([len(step) for step in steps], np.int64)
        frame = np.repeat(np.asarray(frames, np.int64), counts)
        rows = (identity[inverse], table.tracklet_id, table.xyxy / scale)
        table = Tracks(frame, *rows, table.score, table.class_id, table.detection_index)
        return table[table.track_id > 0]

    @staticmethod
    def joined(tables: Sequence[Tracks]) -> Tracks:
        """Concatenate tables and sort their rows by frame."""
        rows = Tracks._stacked(tables)
        return rows[np.argsort(rows.frame, kind="stable")]

    @staticmethod
    def _stacked(tables: Sequence[Tracks]) -> Tracks:
        """Concatenate the columns of tables."""
        tables = tables or [Tracks.empty()]
        names = Tracks.__slots__
        return Tracks(*(np.concatenate([getattr(t, name) for t in tables]) for name in names))

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
        """Select the tracked rows of supervision's `Detections` and set their `tracker_id`.

        Args:
            detections: those that `update` was given (any type with `tracker_id` that can be
                indexed by rows); unchanged. Masks and data are copied.
        """
        tracked = detections[self.detection_index]
        tracked.tracker_id = self.track_id
        return tracked


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """A join or a split of tracklets and its evidence.

    Attributes:
        kind: "join" or "split". tracklets: ids of the tracklets. kept: always True; False in older
            files, for a join that was undone.
        place_iou: median IoU of the boxes with the projected object; None where appearance decided.
        appearance_log_odds: of one object, from the embeddings (`SimilarityCalibration`); None in
            a file: infinite.
    """

    kind: str
    tracklets: tuple[NonNegativeInt, ...]
    place_iou: FiniteFloat | None
    appearance_log_odds: FiniteFloat | None
    kept: bool


# ---- Detections of other libraries --------------------------------------------------------------

COORDINATE_MAX = 1e7  # px, a thousand times the widest images; larger ones are errors
CLASS_MAX = 32_767  # class number, above ImageNet-21k's 21,841; each costs 8 bytes a track
CLASS_NAME_MAX = 200  # characters; arrays of names are as wide as the longest
DETECTIONS_MAX = 3_000  # of a frame; a matrix of as many tracks takes 72 MB


def as_detections(detections: Any, class_id: Any = None) -> Detections:
    """Convert the detections of one frame from the types of common libraries.

    Accepts `Detections`; (N, 6) rows x1, y1, x2, y2, confidence, class, as array, tensor or list;
    ultralytics' `Results` and `Boxes`; supervision's `Detections`; dicts of boxes, scores, labels
    and masks (torchvision, transformers); and a list of one of these, as models return for a batch
    of one image. Class ids are not mapped (torchvision counts COCO's from 1). Nothing is reshaped,
    clipped, reordered or dropped.

    Args:
        class_id: (D,) replaces the classes, e.g. by the numbers of `text_labels`.
    Raises:
        ReobjError: another type, or invalid values: inverted boxes, coordinates that are not finite
            or beyond 1e7, scores outside [0, 1], classes that are no index.
    """
    xyxy, score, own_class_id, masks = _columns(_single(detections))
    return _checked(xyxy, score, own_class_id if class_id is None else class_id, masks)


def _unusable(fault: str) -> ReobjError:
    """Make the error about detections of an unknown type."""
    return ReobjError(
        f"{fault}; expected (N, 6) rows x1, y1, x2, y2, confidence, class; ultralytics Results or "
        "Boxes; supervision Detections; a dict of boxes, scores, labels; or rt.Detections"
    )


def _single(detections: Any) -> Any:
    """Return the only element of a batch of one image; other types unchanged."""
    if isinstance(detections, list | tuple) and len(detections) == 1:
        (item,) = detections  # detections of a frame, or one row of them
        if isinstance(item, Mapping) or hasattr(item, "xyxy") or hasattr(item, "boxes"):
            return item
    return detections


# Names of boxes, scores and classes: of ours and supervision, of dicts, of ultralytics
COLUMNS = (("xyxy", "boxes"), ("score", "confidence", "scores", "conf"),
           ("class_id", "labels", "cls"))  # fmt: skip


def _columns(detections: Any) -> tuple[Any, ...]:
    """Return boxes, scores, classes and masks of detections of any of the types.

    Scores and classes that are None (supervision) become 1 and 0.
    """
    source = detections
    if hasattr(detections, "orig_shape") and hasattr(detections, "boxes"):
        source = detections.boxes  # of ultralytics' Results
        if source is None:
            raise _unusable("ultralytics Results without boxes (another task?)")
    elif not isinstance(detections, Mapping) and not hasattr(detections, "xyxy"):
        rows = as_numbers(detections, "detections")
        rows = rows if rows.size or rows.ndim > 1 else np.empty((0, 6))
        if rows.ndim != 2 or rows.shape[1] != 6:
            raise _unusable(f"detections are an array of shape {rows.shape}")
        return rows[:, :4], rows[:, 4], rows[:, 5], None
    if not isinstance(source, Mapping):
        names = (*itertools.chain(*COLUMNS), "mask", "masks")
        source = {name: getattr(source, name) for name in names if hasattr(source, name)}
    columns: list[Any] = []
    for default, names in zip((np.empty, np.ones, np.zeros), COLUMNS, strict=True):
        name = next((name for name in names if name in source), None)
        if name is None:
            raise _unusable(f"detections have no {' or '.join(names)}")
        values = source[name]
        columns.append(default(len(columns[0])) if values is None and columns else values)
    masks = source.get("masks", source.get("mask"))
    if hasattr(detections, "orig_shape") and getattr(detections, "masks", None) is not None:
        masks = _full_masks(detections.masks, detections.orig_shape)
    return *columns, masks


def text_labels(detections: Any) -> list[str] | None:
    """Return the text labels of detections; None where they have class numbers only.

    Of dicts `labels`, `text_labels` or `class_names` of strings (transformers' open-vocabulary
    models); of ultralytics' `Results` by its `names`; of supervision's `Detections`
    `data["class_name"]`.
    """
    detections = _single(detections)
    if isinstance(detections, Mapping):
        keys = ("text_labels", "labels", "class_names")
        texts = (detections[key] for key in keys if _is_text(detections.get(key)))
        labels: Any = next(texts, None)
    elif hasattr(detections, "orig_shape") and getattr(detections, "boxes", None) is not None:
        names = getattr(detections, "names", None)
        kinds = as_numbers(detections.boxes.cls, "classes")
        names = names if isinstance(names, Mapping) else dict(enumerate(names or ()))
        named = all(int(kind) in names for kind in kinds)
        labels = [str(names[int(kind)]) for kind in kinds] if named else None
    else:
        data = getattr(detections, "data", None)
        labels = data.get("class_name") if isinstance(data, Mapping) else None
        labels = labels if _is_text(labels) else None
    return None if labels is None else [str(label) for label in labels]


def _is_text(labels: Any) -> bool:
    """Test whether labels are a list or array of at least one string."""
    if isinstance(labels, np.ndarray):
        labels = labels.tolist()
    usable = isinstance(labels, list | tuple) and len(labels) > 0
    return usable and all(isinstance(label, str) for label in labels)


def _full_masks(masks: Any, size_hw: Sequence[int]) -> BoolArray:
    """Resize the masks of ultralytics' `Results`, of its padded input, to the image (N, H, W)."""
    maps = as_numbers(masks.data, "masks").astype(np.float32)  # (N, h, w)
    image_hw = [int(side) for side in size_hw]
    scale = min(m / side for m, side in zip(maps.shape[1:], image_hw, strict=True))
    h, w = (max(round(side * scale), 1) for side in image_hw)
    top, left = ((m - side) // 2 for m, side in zip(maps.shape[1:], (h, w), strict=True))
    full = [cv2.resize(m, image_hw[::-1]) > 0.5  # probability
            for m in maps[:, top : top + h, left : left + w]]  # fmt: skip
    return np.array(full, bool).reshape(-1, *image_hw)


def as_numbers(values: Any, name: str) -> npt.NDArray[Any]:
    """Convert arrays, lists and tensors of any library to a numeric array; name: for errors."""
    if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
        return values
    if hasattr(values, "detach") and hasattr(values, "cpu"):  # a tensor, perhaps on a GPU
        values = values.detach().cpu()
    try:
        array = np.asarray(values)
        if array.dtype.kind == "O":
            array = array.astype(np.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        reason = str(error).partition("\n")[0]
        raise _unusable(f"{name} are no array of numbers ({reason})") from error
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        kind = type(values).__name__ if array.ndim == 0 else array.dtype.name
        raise _unusable(f"{name} are {kind}, no array of numbers")
    return array


def _checked(xyxy: Any, score: Any, class_id: Any, masks: Any) -> Detections:
    """Validate the arrays and build `Detections`."""
    given = {"boxes": xyxy, "scores": score, "classes": class_id}
    arrays = {name: as_numbers(values, name) for name, values in given.items()}
    count = len(arrays["boxes"])
    shapes = {"boxes": (count, 4), "scores": (count,), "classes": (count,)}
    if masks is not None:
        masks = as_numbers(masks, "masks")
        masks = masks[:, 0] if masks.ndim == 4 and masks.shape[1] == 1 else masks  # (N, 1, H, W)
        arrays["masks"] = masks if masks.dtype == bool else masks > 0.5  # probability (torchvision)
        shapes["masks"] = (count, *masks.shape[-2:])
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            found = f"{name} are an array of shape {arrays[name].shape}"
            raise ReobjError(
                f"{found}, expected {shape}: one for each box, masks of the frame's size"
            )
    if count > DETECTIONS_MAX:
        raise ReobjError(f"{count} detections in a frame, at most {DETECTIONS_MAX} are allowed: "
                         "keep those of the highest scores")  # fmt: skip
    xyxy = arrays["boxes"].astype(np.float64, copy=False)
    score = arrays["scores"].astype(np.float64, copy=False)
    class_id = arrays["classes"]
    finite = np.abs(xyxy) <= COORDINATE_MAX  # False for NaN
    ordered = xyxy[:, 2:] >= xyxy[:, :2]
    index = (class_id >= 0) & (class_id <= CLASS_MAX) & (class_id == np.floor(class_id))
    for valid, values, expected in (
        (finite, xyxy, f"finite coordinates in pixels, at most {COORDINATE_MAX:g}"),
        (ordered, xyxy, "x1 <= x2 and y1 <= y2: corners, not x, y, width, height"),
        ((score >= 0) & (score <= 1), score, "a confidence in [0, 1]"),
        (index, class_id, f"a class number from 0 to {CLASS_MAX}"),
    ):
        if not valid.all():
            row = int(np.argwhere(~valid)[0, 0])
            raise ReobjError(f"detection {row}: {values[row]}, expected {expected}")
    class_id = class_id.astype(np.int64, copy=False)
    return Detections(xyxy, score, class_id, arrays.get("masks"))


def as_frame(image: Any, masks: BoolArray | None = None) -> Image:
    """Validate a BGR image (H, W, 3) uint8; a view is copied to C order.

    Raises:
        ReobjError: the image is grey, has alpha, no pixels or another type; or masks (D, H, W) have
            another size.
    """
    shape = getattr(image, "shape", ())
    if getattr(image, "dtype", None) != np.uint8 or shape[2:] != (3,) or 0 in shape:
        found = f"{type(image).__name__} {shape} of {getattr(image, 'dtype', 'no dtype')}"
        raise ReobjError(f"the frame is {found}, expected a BGR image (H, W, 3) of uint8, as "
                         "cv2.imread gives it")  # fmt: skip
    if masks is not None and masks.shape[1:] != shape[:2]:
        raise ReobjError(f"masks of (h, w) {masks.shape[1:]}, expected {shape[:2]}, as the "
                         "frame has")  # fmt: skip
    return np.ascontiguousarray(image)


def frame_step(frame: IntArray) -> int:
    """Return the interval between frames that were read (more than 1 with `--every`).

    frame: (N,) numbers of frames that were read.
    """
    frames = np.unique(frame)
    return int(np.gcd.reduce(np.diff(frames))) if len(frames) > 1 else 1


def detector_run_numbers(table: Tracks, detector_ran: IntArray | None) -> tuple[IntArray, int]:
    """Number the frames on which the detector was run.

    Args:
        detector_ran: (F,) their numbers, ascending; None: all that were read, `frame_step` apart.
    Returns:
        (N,) number of the frame of each row, and the difference between consecutive frames.
    """
    if detector_ran is None:
        return table.frame, frame_step(table.frame)
    return np.searchsorted(detector_ran, table.frame), 1


def object_classes(table: Tracks) -> dict[int, int]:
    """Return the class of each object: the one with the largest sum of scores."""
    objects, row = np.unique(table.track_id, return_inverse=True)
    classes, column = np.unique(table.class_id, return_inverse=True)
    votes = np.zeros((len(objects), len(classes)))
    np.add.at(votes, (row, column), table.score)
    best = classes[votes.argmax(1)] if len(objects) else classes
    return dict(zip(objects.tolist(), best.tolist(), strict=True))


def class_shares(table: Tracks, group: IntArray, count: int) -> Array:
    """Return the fraction of every class in the scores of each group of rows, (count, C)."""
    votes = np.zeros((count, int(table.class_id.max(initial=0)) + 1))
    np.add.at(votes, (group, table.class_id.clip(0)), table.score)
    return np.asarray(votes / np.maximum(votes.sum(1, keepdims=True), 1e-9))


def box_area(xyxy: Array) -> Array:
    """Return the area (...) of boxes (..., 4)."""
    width = xyxy[..., 2] - xyxy[..., 0]
    height = xyxy[..., 3] - xyxy[..., 1]
    return np.asarray(width * height, np.float64)


def box_iou(a_xyxy: Array, b_xyxy: Array) -> Array:
    """Return the intersection over union (A, B) of boxes a (A, 4) with boxes b (B, 4)."""
    (ax, ay, ax2, ay2), (bx, by, bx2, by2) = a_xyxy.T[..., None], b_xyxy.T  # (A, 1), (B,) each
    width = np.minimum(ax2, bx2) - np.maximum(ax, bx)  # (A, B)
    height = np.minimum(ay2, by2) - np.maximum(ay, by)
    inter = np.maximum(width, 0) * np.maximum(height, 0)
    union = (ax2 - ax) * (ay2 - ay) + (bx2 - bx) * (by2 - by) - inter
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


class Existence(float):
    """Probability that an object exists, with its evidence (`objects.description`).

    Attributes:
        score: log odds of the best detections. hit_rate: over the frames where it should be
            visible, NaN without a shape. see_through: log ratio of points behind it.
    """

    def __new__(cls, probability: float, *_: float) -> Existence:
        """Make the number."""
        return super().__new__(cls, probability)

    def __init__(
        self, probability: float, score: float, hit_rate: float, see_through: float
    ) -> None:
        self.score = score
        self.hit_rate = hit_rate
        self.see_through = see_through


def nearest_of(values: npt.NDArray[Any], known: npt.NDArray[Any]) -> IntArray:
    """Return the index of the nearest of K known values, ascending, to each value (N,).

    Of two equally near ones it is the first.
    """
    after = np.searchsorted(known, values).clip(max=len(known) - 1)
    before = (after - 1).clip(0)
    nearer = np.abs(known[before] - values) <= np.abs(known[after] - values)
    return np.where(nearer, before, after)


def widen(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Pad the second axis of a with zeros to the width of b.

    (For the first occurrence of a class or an embedding.)
    """
    if a.ndim != 2 or a.shape[1] >= b.shape[1]:
        return a
    return np.concatenate([a, np.zeros((len(a), b.shape[1] - a.shape[1]), a.dtype)], 1)


def unit_rows(rows: npt.NDArray[Any]) -> Array:
    """Scale rows (N, E) to unit length; zero rows stay zero."""
    rows = np.asarray(rows, np.float64)
    return np.asarray(rows / np.maximum(np.sqrt((rows * rows).sum(-1, keepdims=True)), 1e-12))


def object_color(object_id: int) -> tuple[int, int, int]:
    """Return the BGR colour of an identity, well apart from its neighbours (golden-angle hues)."""
    hue = object_id * 0.381966 % 1.0
    color = (round(hue * 179), 200 - 60 * (object_id % 2), 255 - 45 * (object_id // 2 % 2))
    hsv = np.array([[color]], np.uint8)
    blue, green, red = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red
