"""Detections of a video as arrays, and the npz format for them and their masks.

A reader (`detection_formats`) makes them from a `Source`; `detection_files` validates the content.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from reobj.cameras import Poses
from reobj.files import LINES_MAX, MEMORY_MAX, load_npz, save_npz
from reobj.sources.masks import NO_RUNS, Counts, rle_decode, rle_encode
from reobj.types import (
    CLASS_MAX,
    Array,
    BoolArray,
    Detections,
    IntArray,
    ReobjError,
    visible_name,
    xyxy_from_cxcywh,
)

CORNERS, SIZES, CENTRES = "x1, y1, x2, y2", "x, y, w, h", "cx, cy, w, h"  # forms of a box


def corners(box: Array, form: str) -> Array:
    """Convert boxes (N, 4) of a form to corners (N, 4)."""
    if form == CENTRES:
        return xyxy_from_cxcywh(box)
    return np.hstack([box[:, :2], box[:, :2] + box[:, 2:]]) if form == SIZES else box


def other_form(
    xyxy: Array, form: str, size: Sequence[float], frame: IntArray, identity: IntArray
) -> str:
    """Describe the form that boxes of an image of (w, h) `size` have instead of `form`.

    Args:
        xyxy: (N, 4) boxes as read. form: in which the file has them. size: (0, 0): unknown.
        frame, identity: (N,); no identities: empty, or below 0.
    Returns:
        the fault and the remedy; "" if the boxes fit, or fit in no other form either. A box that is
        inverted is a fault; so are more than a tenth of boxes, and more than two, that leave the
        image (of boxes in another form 41 % or more do); and sizes of an identity that change as
        its place does.
    """
    low, high = xyxy[:, :2], xyxy[:, 2:]
    centre = (low + high) / 2
    given = xyxy  # the numbers in the file
    if form != CORNERS:
        given = np.hstack([low if form == SIZES else centre, high - low])
        if len(identity) and _move_as_corners(given, frame, identity):
            return (f"all boxes are {CORNERS}, expected {form}: the third and fourth number "
                    f"are above the first and second, and change with them; {REMEDY}")  # fmt: skip
    if 0 in size:
        return ""
    inverted = (high < low).any(1)
    leave = ~_inside(xyxy, size)
    if not inverted.any() and leave.sum() <= max(2, 0.1 * len(xyxy)):
        return ""
    image = f"the image of {size[0]:g}x{size[1]:g}"
    why = f"as {form}, {leave.sum()} of {len(xyxy)} boxes leave {image}"
    why += f", and {inverted.sum()} have x2 < x1 or y2 < y1" * bool(inverted.any())
    others = [other for other in (CORNERS, SIZES, CENTRES) if other != form]
    fits = [other for other in others if _inside(corners(given, other), size).mean() > 0.98]
    if fits:
        return f"{why}; all fit it as {' or '.join(fits)}: {REMEDY}"
    if _inside(xyxy, size[::-1]).all():
        return (f"{why}; all fit the frame turned by 90 deg: made on frames that were not turned "
                "upright? Detect on upright frames")  # fmt: skip
    return ""


REMEDY = "convert them, or name these columns in the header of a CSV"


def _move_as_corners(box: Array, frame: IntArray, identity: IntArray) -> bool:
    """Test whether numbers (N, 4) are corners: the last two change as the first two do.

    From one frame of an identity to its next, sizes change little: the difference of both changes
    is at least 1.58 times the change of a size (1.57 in 24 files of tracks), but at most 1.41 times
    that of a corner; both are reached where the corners move independently.
    """
    order = np.lexsort((frame, identity))
    same = (np.diff(identity[order]) == 0) & (identity[order[1:]] >= 0)
    step = np.diff(box[order], axis=0)[same]  # (M, 4)
    apart = np.abs(step[:, 2:] - step[:, :2]).sum()
    return bool((box[:, 2:] > box[:, :2]).all() and apart < 1.25 * np.abs(step[:, 2:]).sum())


def _inside(xyxy: Array, size: Sequence[float]) -> BoolArray:
    """Test which boxes (N,) are not inverted and lie in the image.

    Tolerance of 1 px: detectors round boxes to whole pixels.
    """
    low, high = xyxy[:, :2], xyxy[:, 2:]
    return np.asarray(((low >= -1) & (low <= high) & (high <= np.add(size, 1))).all(1))


@dataclass(slots=True)
class RecordedDetections:
    """Detections of a video as a struct of arrays; `at` returns those of a frame.

    Attributes:
        frame: (N,) source frame numbers, ascending once validated.
        xyxy: (N, 4) px of the source. score: (N,) in [0, 1]. class_id: (N,) index into class_names.
        runs: run lengths of the N masks (see `masks`), empty where there is none.
        size, working_size: (w, h) of the masks, and of the frames of `at`.
        line: (N,) position in the file, a number of `unit`s or text; for messages.
        messages: about dropped rows and assumptions, for the user.
        identity: (N,) as in the file, or empty.
        looked: frames on which the detector was run, ascending; None: all.
        boxes_3d: (N, 15) of `boxes_3d.Boxes3D`, or empty.
        ignored: (N,) regions that do not count, as the file marks them, or empty.
        form: of the boxes in the file.
    """

    frame: IntArray
    xyxy: Array
    score: Array
    class_id: IntArray
    runs: list[Counts]
    class_names: tuple[str, ...]
    size: tuple[int, int]
    working_size: tuple[int, int]
    line: npt.NDArray[Any]
    unit: str
    messages: list[str] = field(default_factory=list)
    identity: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    looked: IntArray | None = None
    boxes_3d: Array = field(default_factory=lambda: np.empty((0, 15)))
    ignored: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    form: str = CORNERS

    def __post_init__(self) -> None:
        self.class_names = tuple(map(visible_name, self.class_names))

    def __len__(self) -> int:
        return len(self.frame)

    def other_form(self, size: Sequence[float]) -> str:
        """Describe another form of the boxes, as the function of this name."""
        return other_form(self.xyxy, self.form, size, self.frame, self.identity)

    def select(self, rows: IntArray) -> None:
        """Select rows (n,), in this order."""
        count = len(self)
        for name in "frame xyxy score class_id line identity boxes_3d ignored".split():
            values = getattr(self, name)
            setattr(self, name, values[rows] if len(values) == count else values)
        self.runs = [self.runs[row] for row in rows]

    def fingerprint(self) -> str:
        """Hash the detections, independently of the format of the file."""
        digest = hashlib.sha256(repr((self.class_names, self.size)).encode())
        given: list[npt.NDArray[Any]] = [self.boxes_3d] if len(self.boxes_3d) else []
        given = [self.frame, self.xyxy, self.score, self.class_id, *given, *self.runs]
        for values in given:
            digest.update(repr(values.shape).encode() + np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()[:16]

    def at(self, frame_index: int) -> Detections:
        """Return the detections of a frame, with masks, in px of the working size."""
        low, high = np.searchsorted(self.frame, [frame_index, frame_index + 1])
        rows = slice(low, high)
        runs = self.runs[low:high]
        masks = None
        ratio = np.tile(np.divide(self.working_size, self.size), 2)  # (4,)
        if any(map(len, runs)):
            decoded = (rle_decode(counts, self.size) for counts in runs)
            masks = np.stack([_resized_mask(mask, self.working_size) for mask in decoded])
        return Detections(self.xyxy[rows] * ratio, self.score[rows], self.class_id[rows], masks)


@dataclass(slots=True)
class NoVideo:
    """The video of a file that is read alone: frames of unknown number, size and names."""

    source: str
    size: tuple[int, int] = (0, 0)
    working_size: tuple[int, int] = (0, 0)
    names: Sequence[str] = ()
    files: Sequence[Path] = ()
    frame_count: int = 0
    times_s: Array | None = None


@dataclass(slots=True)
class Source:
    """A file or folder of detections, and what its reader needs besides.

    Attributes:
        path: of the file. video: whose frames the boxes belong to (attributes of `Video`).
        names: class names by number, (): not given. first: number of the first frame, "": as the
            format says, or "order": listed images are the frames in this order.
        poses: cameras that project boxes in 3D; None: unknown.
        messages: about assumptions, for the user.
        describes: only what the file says about its images is needed: names, sizes and times_s of
            the frames, which the reader adds.
    """

    path: Path
    video: Any
    names: Sequence[str] = ()
    first: str = ""
    poses: Poses | None = None
    messages: list[str] = field(default_factory=list)
    describes: bool = False
    image_names: list[str] = field(default_factory=list)
    image_sizes: set[tuple[int, int]] = field(default_factory=set)
    times_s: Array | None = None

    def say(self, *texts: str) -> None:
        """Add messages, without empty ones."""
        self.messages += filter(None, texts)

    def recorded(
        self,
        frame: IntArray,
        box: Array,
        classes: tuple[IntArray, Sequence[str]],
        score: Array | None = None,
        runs: list[Counts] | None = None,
        line: npt.NDArray[Any] | None = None,
        unit: str = "entry",
        form: str = CORNERS,
        scale: Array | float = 1.0,
        **columns: Any,
    ) -> RecordedDetections:
        """Return the detections of N rows; columns: further attributes of RecordedDetections.

        scale: px of the video for each unit of the boxes (N, 4).
        """
        count = len(frame)
        xyxy = corners(np.reshape(box, (-1, 4)).astype(np.float64), form) * scale  # (N, 4)
        return RecordedDetections(
            frame, xyxy, np.ones(count) if score is None else score, classes[0],
            [NO_RUNS] * count if runs is None else runs, tuple(classes[1]), self.video.size,
            self.video.working_size, np.arange(count) if line is None else line, unit,
            self.messages, form=form, **columns,
        )  # fmt: skip

    def scale(self, made_for: Array, used: BoolArray | None = None) -> Array:
        """Return the factors (N, 4) from the images of the boxes to those of the video.

        Args:
            made_for: (N, 2) size of each box's image, 0: unknown. used: (N,) the box belongs to a
                frame; None: all do.
        Raises:
            ReobjError: images of another aspect ratio.
        """
        size = self.video.size
        self.image_sizes |= {(int(w), int(h)) for w, h in np.unique(made_for, axis=0)}
        scale = np.ones((len(made_for), 4))
        known = (made_for > 0).all(1) & (True if used is None else used)
        for w, h in np.unique(made_for[known], axis=0).tolist() if size != (0, 0) else ():
            text = f"made for images of {w:g}x{h:g}, but the video is {size[0]}x{size[1]}"
            if (w, h) == size:
                continue
            if abs(w * size[1] / size[0] - h) > 1:  # px: sides of resized images are rounded
                turned = (h, w) == size
                why = ": made on frames that were not turned upright?" if turned else ""
                raise ReobjError(f"{self.path}: {text}, of another shape{why or ': other images?'} "
                                 "Run the detector on the frames of this video")  # fmt: skip
            scale[(made_for == (w, h)).all(1)] = np.tile([size[0] / w, size[1] / h], 2)
            self.say(f"{text}: boxes are scaled")
        return scale


def _resized_mask(mask: BoolArray, size: tuple[int, int]) -> BoolArray:
    """Resize an (H, W) mask to (w, h): pixels that are covered by at least half."""
    if mask.shape == size[::-1]:
        return mask
    covered = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(covered >= 0.5)


def pack_detections(
    frames: Sequence[tuple[int, Detections]], names: Sequence[str], size: tuple[int, int]
) -> dict[str, Any]:
    """Pack (frame number, Detections) pairs into the arrays of our npz format.

    Returns:
        frame (N,), xyxy (N, 4), score (N,), class_id (N,), class_names (C,), image_size (w, h),
        done (F,) the frames, and the run lengths of the masks: those of row i are
        mask_counts[mask_offsets[i] : mask_offsets[i + 1]].
    """
    parts = [Detections.empty(), *(detections for _, detections in frames)]
    index = np.array([i for i, _ in frames], np.int64)  # (F,)
    runs = [NO_RUNS]
    for detections in parts:
        masks = detections.masks
        expected = (len(detections), size[1], size[0])
        if masks is not None and masks.shape != expected:
            raise ReobjError(f"masks are {masks.shape}, expected (D, H, W) = {expected}")
        runs += [NO_RUNS] * len(detections) if masks is None else map(rle_encode, masks)
    return {
        "frame": np.repeat(index, list(map(len, parts[1:]))),
        "xyxy": np.concatenate([d.xyxy for d in parts]).astype(np.float64),
        "score": np.concatenate([d.score for d in parts]).astype(np.float64),
        "class_id": np.concatenate([d.class_id for d in parts]).astype(np.int64),
        "class_names": np.array(list(names), np.str_),
        "image_size": np.array(size, np.int64),
        "mask_counts": np.concatenate(runs),
        "mask_offsets": np.cumsum([len(run) for run in runs]),
        "done": np.unique(index),
    }


def write_detections_npz(
    path: str | Path,
    frames: Iterable[tuple[int, Detections]],
    class_names: Sequence[str],
    image_size: tuple[int, int],
) -> None:
    """Write detections to an npz file for `read_detections`.

    Args:
        frames: (frame number of the source, Detections) pairs of all frames on which the detector
            was run, including those without detections; boxes and masks in pixels of the source.
        class_names: by class id. image_size: (w, h) of the source.
    """
    save_npz(Path(path), pack_detections(list(frames), class_names, image_size))


# Coordinates up to this are fractions of the image size; chosen: boxes may extend a little outside
NORMALISED_MAX = 1.5


def read_npz(
    path: Path, size: tuple[int, int], working_size: tuple[int, int], sealed: bool = False
) -> tuple[RecordedDetections, IntArray]:
    """Read the format of `pack_detections` for a video of (w, h) `size`, (0, 0): any.

    Args:
        sealed: as in `load_npz`.
    Returns:
        the detections, not validated, and the numbers of the frames that were `done`, including
        those without detections (default: the frame of every detection).
    """
    data, _ = load_npz(path, sealed)
    take = functools.partial(_array, data, path)
    frame = take("frame", "iu", (-1,), LINES_MAX).astype(np.int64)
    count = len(frame)
    data.setdefault("mask_counts", NO_RUNS)
    data.setdefault("mask_offsets", np.zeros(count + 1, np.int64))
    runs = take("mask_counts", "iu", (-1,), MEMORY_MAX // 8)  # uint32, held twice
    offsets = take("mask_offsets", "iu", (count + 1,)).astype(np.int64)
    if (np.diff(offsets, prepend=0) < 0).any() or offsets[-1] > runs.size or (runs < 0).any():
        raise ReobjError(f"{path}: mask_counts and mask_offsets are inconsistent")
    width, height = take("image_size", "iu", (2,)).tolist()
    if min(width, height) < 1:
        raise ReobjError(f"{path}: image_size {width}, {height}, expected (w, h) in px")
    if (width, height) != size and size != (0, 0):
        turned = (height, width) == size
        why = ": made on frames that were not turned upright?" if turned else ""
        text = f"made for images of {(width, height)} px, but the video is {size} px"
        raise ReobjError(f"{path}: {text}{why}")
    recorded = RecordedDetections(
        frame, take("xyxy", "fiu", (count, 4)).astype(np.float64),
        take("score", "fiu", (count,)).astype(np.float64),
        take("class_id", "iu", (count,)).astype(np.int64),
        np.split(runs.astype(np.uint32), offsets[1:])[:count],
        tuple(take("class_names", "U", (-1,), CLASS_MAX).tolist()), (width, height), working_size,
        np.arange(count), "row",
    )  # fmt: skip
    if "done" not in data:
        return recorded, recorded.frame
    recorded.looked = np.unique(take("done", "iu", (-1,), LINES_MAX)).astype(np.int64)
    return recorded, recorded.looked


def _array(
    data: dict[str, npt.NDArray[Any]], path: Path, key: str, kinds: str, shape: tuple[int, ...],
    most: int = MEMORY_MAX,
) -> npt.NDArray[Any]:  # fmt: skip
    """Return an array of an npz file; refuse another kind, shape (-1: any) or more numbers."""
    if key not in data:
        raise ReobjError(f"{path}: array {key} is missing")
    array = data[key]
    if array.ndim != len(shape) or any(
        n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)
    ):
        raise ReobjError(f"{path}: array {key} is {array.shape}, expected shape {shape}")
    if array.dtype.kind not in kinds and array.size:
        raise ReobjError(f"{path}: array {key} is of {array.dtype}, expected {kinds}")
    if len(array) > most:
        raise ReobjError(f"{path}: {len(array)} {key}, at most {most} are allowed")
    return array
