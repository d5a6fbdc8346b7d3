"""Detections of a video as arrays: frames of a file, masks, and the npz format.

A reader of `detection_files.DETECTIONS` makes `RecordedDetections` from a `Source`, with one rule
for frames in all formats: names are matched to those of the source's images (`frame_lookup`). If
none matches, the number in a name is that of an image, or of a frame. A number 0, or one that only
counting from 1 places in the video, decides where frames begin; else the convention of the format;
else it is an error.

Masks are run lengths along the columns of the image (COCO's order) that start with a run of zeros.
A mask without pixels has none (`NO_RUNS`) and means "no mask".
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from reobj.cameras import Poses
from reobj.files import load_npz, save_npz, shortened
from reobj.formats import frames_by_name
from reobj.types import (
    COORDINATE_MAX,
    Array,
    BoolArray,
    Detections,
    IntArray,
    ReobjError,
    cxcywh_from_xyxy,
    visible_name,
    xyxy_from_cxcywh,
)

CORNERS, SIZES, CENTRES = "x1, y1, x2, y2", "x, y, w, h", "cx, cy, w, h"  # forms of a box
Counts = npt.NDArray[np.uint32]
NO_RUNS: Counts = np.empty(0, np.uint32)
# Coordinates up to this are fractions of the image size: boxes may extend a little outside
NORMALISED_MAX = 1.5


# ---- Forms of boxes ------------------------------------------------------------------------------


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
    remedy = "convert them, or name these columns in the header of a CSV"
    size_of = xyxy[:, 2:] - xyxy[:, :2]
    sizes = np.hstack([xyxy[:, :2], size_of])
    given = {CORNERS: xyxy, SIZES: sizes, CENTRES: cxcywh_from_xyxy(xyxy)}[form]
    if form != CORNERS and _move_as_corners(given, frame, identity):
        return (f"all boxes are {CORNERS}, expected {form}: the third and fourth number are above "
                f"the first and second, and change with them; {remedy}")  # fmt: skip
    inverted = (size_of < 0).any(1)
    leave = ~_inside(xyxy, size)
    if 0 in size or (not inverted.any() and leave.sum() <= max(2, 0.1 * len(xyxy))):
        return ""
    fits = " or ".join(other for other in (CORNERS, SIZES, CENTRES)
                       if other != form and _inside(corners(given, other), size).mean() > 0.98
                       )  # fmt: skip
    why = (f"{leave.sum()} of {len(xyxy)} boxes leave the image of {size[0]:g}x{size[1]:g}, "
           f"{inverted.sum()} have x2 < x1 or y2 < y1")  # fmt: skip
    if fits:
        return f"as {form}, {why}; all fit it as {fits}: {remedy}"
    turned = _inside(xyxy, size[::-1]).all()
    return f"{why}; all fit the frame turned by 90 deg: detect on upright frames" * bool(turned)


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


# ---- Detections ----------------------------------------------------------------------------------


@dataclass(slots=True)
class RecordedDetections:
    """Detections of a video as a struct of arrays; `at` returns those of a frame.

    Attributes:
        frame: (N,) source frame numbers, ascending once validated.
        xyxy: (N, 4) px of the source. score: (N,) in [0, 1]. class_id: (N,) index into class_names.
        runs: run lengths of the N masks, empty where there is none.
        size, working_size: (w, h) of the masks, and of the frames of `at`.
        line: (N,) position in the file, a number of `unit`s or text; for messages.
        messages: about dropped rows and assumptions, for the user.
        identity: (N,) as in the file, -1: none.
        ignored: (N,) regions that do not count, as the file marks them.
        detector_ran: frames on which the detector was run, ascending; None: all.
        boxes_3d: (N, 15) of `tables.Boxes3D`; None: the detector gives none.
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
    messages: list[str]
    identity: IntArray
    ignored: BoolArray
    detector_ran: IntArray | None = None
    boxes_3d: Array | None = None
    form: str = CORNERS

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: IntArray) -> None:
        """Select rows (n,), in this order."""
        for name in "frame xyxy score class_id line identity ignored boxes_3d".split():
            if (values := getattr(self, name)) is not None:
                setattr(self, name, values[rows])
        self.runs = [self.runs[row] for row in rows]

    def fingerprint(self) -> str:
        """Hash the detections, independently of the format of the file."""
        digest = hashlib.sha256(repr((self.class_names, self.size)).encode())
        boxes_3d = () if self.boxes_3d is None else (self.boxes_3d,)
        columns = (self.frame, self.xyxy, self.score, self.class_id, *boxes_3d, *self.runs)
        for values in columns:
            digest.update(repr(values.shape).encode() + values.tobytes())
        return digest.hexdigest()[:16]

    def at(self, frame_index: int) -> Detections:
        """Return the detections of a frame, with masks, in px of the working size."""
        rows = slice(*np.searchsorted(self.frame, [frame_index, frame_index + 1]))
        masks = None
        ratio = np.tile(np.divide(self.working_size, self.size), 2)  # (4,)
        if any(map(len, self.runs[rows])):
            decoded = (rle_decode(counts, self.size) for counts in self.runs[rows])
            masks = np.stack([_resized_mask(mask, self.working_size) for mask in decoded])
        return Detections(self.xyxy[rows] * ratio, self.score[rows], self.class_id[rows], masks)


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

    def say(self, text: str) -> None:
        """Add a message, unless it is empty."""
        self.messages += [text] if text else []

    def recorded(
        self, frame: IntArray, box: Any, classes: tuple[IntArray, Sequence[str]],
        form: str = CORNERS, scale: Any = 1.0, unit: str = "entry", **columns: Any,
    ) -> RecordedDetections:  # fmt: skip
        """Return the detections of N rows; columns: further attributes of RecordedDetections.

        scale: px of the video for each unit of the boxes (N, 4).
        """
        count = len(frame)
        usual: dict[str, Any] = {
            "score": np.ones(count), "runs": [NO_RUNS] * count, "line": np.arange(count),
            "identity": np.full(count, -1), "ignored": np.zeros(count, bool),
        }  # fmt: skip
        return RecordedDetections(
            frame=frame, xyxy=corners(np.reshape(box, (-1, 4)).astype(np.float64), form) * scale,
            class_id=classes[0], class_names=tuple(map(visible_name, classes[1])),
            size=self.video.size, working_size=self.video.working_size, unit=unit,
            messages=self.messages, form=form, **usual | columns,
        )  # fmt: skip

    def scale(self, made_for: Array, used: BoolArray | bool = True) -> Array:
        """Return the factors (N, 4) from the images of the boxes to those of the video.

        Args:
            made_for: (N, 2) size of each box's image, 0: unknown. used: (N,) the box belongs to a
                frame.
        Raises:
            ReobjError: images of another aspect ratio.
        """
        size = self.video.size
        self.image_sizes |= {(int(w), int(h)) for w, h in np.unique(made_for, axis=0)}
        scale = np.ones((len(made_for), 4))
        known = (made_for > 0).all(1) & used
        for w, h in np.unique(made_for[known], axis=0).tolist() if size != (0, 0) else ():
            text = f"made for images of {w:g}x{h:g}, but the video is {size[0]}x{size[1]}"
            if abs(w * size[1] / size[0] - h) > 1:  # px: sides of resized images are rounded
                raise ReobjError(f"{self.path}: {text}, of another shape: run the detector on the "
                                 "frames of this video, turned upright")  # fmt: skip
            scale[(made_for == (w, h)).all(1)] = np.tile([size[0] / w, size[1] / h], 2)
            self.say(f"{text}: boxes are scaled" * ((w, h) != size))
        return scale


# ---- Frames --------------------------------------------------------------------------------------


def original_name(name: str) -> str:
    """Return the name that an image had before its export by Roboflow; other names unchanged.

    >>> original_name("frame_0001_png.rf.3f2a9c.jpg")
    'frame_0001.png'
    """
    match = re.search(r"_(jpe?g|png|bmp|webp|tiff?)\.rf\.[^./\\]+", name, re.IGNORECASE)
    return f"{name[: match.start()]}.{match[1]}" if match else name


def _last_numbers(names: Sequence[str]) -> IntArray:
    """Return the last whole number (N,) in each name without its suffix, -1 where there is none.

    Numbers before a letter do not count: they may be part of a hash.
    """
    stems = [re.split(r"[\\/]", name)[-1] for name in names]
    stems = [stem.rpartition(".")[0] or stem for stem in stems]
    digits = [re.findall(r"\d+(?![0-9A-Za-z])", stem) for stem in stems]
    return np.array([int(d[-1][-18:]) if d else -1 for d in digits], np.int64)  # 18 digits fit


def _first_number(numbers: IntArray, frame_count: int) -> int | None:
    """Return the number of the first frame if only 0 or only 1 is possible; else None.

    Args:
        numbers: (N,) at least one. frame_count: of the source, 0: unknown.
    """
    if numbers.min() <= 0:
        return 0
    return 1 if numbers.max() == frame_count else None  # from 0 it is beyond the last frame


def frames_of_numbers(numbers: IntArray, source: Source, usual: int | None) -> IntArray:
    """Convert frame numbers (N,) of a file to those of the source, from 0.

    Args:
        usual: number of the first frame by the convention of the format; None: it has none, and
            numbers that leave it open are an error.
    """
    if not len(numbers):
        return numbers
    low, high = int(numbers.min()), int(numbers.max())
    known = _first_number(numbers, source.video.frame_count)
    begin = int(source.first) if source.first in ("0", "1") else usual if known is None else known
    if begin is None:
        raise ReobjError(
            f"{source.path}: numbers {low} to {high} count frames from 0, or from 1 (then the "
            f"first of them is frame {low - 1}); say which with --set detect.first_frame=0 or "
            "detect.first_frame=1"
        )
    unclear = not begin and low == 1
    if not source.first and (unclear or begin != usual):
        text = f"frame numbers {low} to {high} are taken as "
        text += "counted from 1" if begin else "0-based"
        unclear_text = ", there is no 0; if they count from 1: --set detect.first_frame=1"
        source.say(text + unclear_text * unclear)
    return numbers - begin


def frames_of_names(names: Sequence[str], source: Source, usual: int | None = None) -> IntArray:
    """Find the frames (N,) of image names, or of ids used as names; -1: none.

    Args:
        names: (N,) with or without folders and suffix. usual: as in `frames_of_numbers`.
    Raises:
        ReobjError: no rule matches, or several do.
    """
    video = source.video
    distinct, row = np.unique(np.array(names, object), return_inverse=True)
    given = [original_name(name) for name in distinct.tolist()]
    if source.describes and not all(name.isdecimal() for name in given):
        source.image_names += given
    if source.describes or not given:
        return np.zeros(len(names), np.int64)
    frame, rule = frames_by_name(given, video.files or video.names, str(source.path))
    if rule:
        unmatched = [name for name, f in zip(given, frame.tolist(), strict=True) if f < 0]
        text = f"{len(unmatched)} names match no image of the video: {shortened(unmatched)}"
        source.say(text * bool(unmatched))
        return np.asarray(frame[row], np.int64)
    number = _last_numbers(given)
    if number.min() < 0 or len(np.unique(number)) < len(number):
        raise ReobjError(
            f"{source.path}: names such as {given[int(number.argmin())]!r} match no frame of the "
            "video, and have no number, or the same as another; name them as the images "
            f"{shortened(video.names)}, or by the frame, or list the images of all frames in order "
            "(--set detect.first_frame=order)"
        )
    image = _last_numbers(video.names).tolist()  # (F,)
    frame_of = {n: frame for frame, n in enumerate(image) if video.times_s is None}
    by_image = np.array([frame_of.get(n, -1) for n in number.tolist()], np.int64)
    matched = by_image >= 0
    begin = _first_number(number, video.frame_count)
    is_frame = begin is not None and number.max() - begin < video.frame_count
    if source.first or len(frame_of) < len(image):
        matched[:] = False
    if matched.all() or (matched.any() and not is_frame):
        missing = [given[k] for k in np.flatnonzero(~matched)]
        k = matched.argmax()
        source.say(f"the number in a name or id is that of an image ({given[k]}: "
                   f"{video.names[by_image[k]]})"
                   + f"; {len(missing)} match none: {shortened(missing)}" * bool(missing)
                   )  # fmt: skip
        return by_image[row]
    if (number.min(), number.max()) != (0, video.frame_count - 1):  # else it is unambiguous
        source.say("the number in a name is the frame's")
        number = frames_of_numbers(number, source, usual)
    return np.asarray(number[row], np.int64)


@dataclass(slots=True)
class Intervals:
    """Intervals of the frames with boxes so far.

    Attributes:
        first, last: frame with boxes. count: of such frames. step: greatest common divisor of their
            intervals.
    """

    first: int = 0
    last: int = 0
    count: int = 0
    step: int = 0

    def add(self, frame: int) -> None:
        """Add the next frame with boxes."""
        if self.count:
            self.step = math.gcd(self.step, frame - self.last)
        else:
            self.first = frame
        self.last = frame
        self.count = self.count + 1

    def detector_ran(self, frame: int) -> bool:
        """Return whether the detector was run on a frame without boxes."""
        return self.count < 3 or self.step < 2 or (frame - self.first) % self.step == 0


def _usual_step(frames: IntArray) -> int:
    """Return the greatest common divisor of the intervals of at least three frames; else 1."""
    return int(np.gcd.reduce(np.diff(frames))) if len(frames) > 2 else 1


def infer_detector_ran(frame: IntArray, frame_count: int) -> IntArray | None:
    """Return the frames on which a detector was run: every n-th if all boxes are in such frames.

    Tracks must not count frames that the detector skipped as missed detections.

    Args:
        frame: (N,) of each box. frame_count: of the video, 0: unknown.
    Returns:
        frame numbers, ascending; None: all frames of the video.
    """
    seen = np.unique(frame[frame >= 0])
    step = _usual_step(seen)
    end = max(frame_count, int(seen.max(initial=-1)) + 1)
    return np.arange(seen[0] % step, end, step) if step > 1 else None


def detector_ran_message(detector_ran: IntArray, listed: bool) -> str:
    """Return the message about the frames on which the detector was run.

    Args:
        detector_ran: frame numbers, ascending. listed: in the file; else inferred from its boxes.
    """
    step = _usual_step(detector_ran)
    which = f"1 frame in {step}" if step > 1 else f"{len(detector_ran)} frames only"
    verb = "lists" if listed else "has boxes in"
    return (
        f"{verb} {which} ({shortened(detector_ran.tolist())}): the "
        "detector was not run on the others, which do not count as empty frames"
    )


# ---- Masks ---------------------------------------------------------------------------------------


def rle_encode(mask: BoolArray, corner: Sequence[int] = (0, 0), size: Sequence[int] = ()) -> Counts:
    """Encode an (h, w) part of the mask of an image; what lies outside the image is cut off.

    Args:
        corner: (x, y) of its first pixel in the image. size: (w, h) of the image; default: (h, w).
    """
    width, height = size or mask.shape[::-1]
    x, y = corner
    mask = mask[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0)]
    if not mask.size:
        return NO_RUNS
    strip = np.zeros((height, mask.shape[1]), bool)  # whole columns: runs follow them
    strip[max(y, 0) :][: len(mask)] = mask
    flat = cv2.transpose(strip.view(np.uint8)).ravel()  # (w * H,)
    none = np.uint8(0)
    edges = np.flatnonzero(np.diff(flat, prepend=none, append=none)) + max(x, 0) * height
    end = width * height
    counts = np.diff(edges[edges < end], prepend=0, append=end).astype(np.uint32)
    return counts if len(counts) > 1 else NO_RUNS


def rle_decode(counts: Counts, size: tuple[int, int]) -> BoolArray:
    """Decode run lengths to the (H, W) mask of a (w, h) image."""
    if not len(counts):
        return np.zeros(size[::-1], bool)
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)  # (W * H,)
    return np.asarray(cv2.transpose(flat.view(np.uint8).reshape(size))).view(bool)


def coco_runs(text: str) -> Counts:
    """Decode COCO's compressed run lengths (maskApi.c of pycocotools, rleFrString).

    Each character holds five bits, lowest first; flag 0x20: more follow; 0x10 of the last: sign.
    From the fourth run on a number is the difference to the last run but one.
    """
    runs: list[int] = []
    value = shift = 0
    for byte in text.encode():
        value |= (byte - 48 & 0x1F) << shift
        shift += 5
        if byte - 48 & 0x20:
            if shift >= 35:  # holds any signed uint32; longer ones would take quadratic time
                raise ValueError("a run length of more than 35 bits")
            continue
        value -= (byte - 48 >> 4 & 1) << shift  # sign
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    return np.array(runs, np.uint32)


def polygon_runs(rings: Sequence[Array], size: tuple[int, int]) -> Counts:
    """Fill polygons (K, 2), in px (corner convention), in a (w, h) image."""
    flat = np.concatenate([np.empty((0, 2)), *rings])
    if not (np.abs(flat) <= COORDINATE_MAX).all():
        raise ValueError("a polygon with corners that are not finite, or beyond 1e7 px")
    low = np.clip(np.floor(flat.min(0, initial=max(size))) - 1, 0, size).astype(int)
    high = np.clip(np.ceil(flat.max(0, initial=0)) + 1, low, size).astype(int)
    canvas = np.zeros((high - low)[::-1], np.uint8)  # only the part of the polygon
    bits = 4  # of fractions of a pixel, 1/16 px: finer than annotations
    for ring in rings if canvas.size else ():
        # OpenCV's first pixel has its centre at (0, 0), ours at (0.5, 0.5)
        fixed = np.round((ring - (low + 0.5)) * (1 << bits)).astype(np.int32)
        cv2.fillPoly(canvas, [fixed], 1, shift=bits)
    return rle_encode(canvas > 0, low.tolist(), size)


def _resized_mask(mask: BoolArray, size: tuple[int, int]) -> BoolArray:
    """Resize an (H, W) mask to (w, h): pixels that are covered by at least half."""
    if mask.shape == size[::-1]:
        return mask
    covered = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(covered >= 0.5)


# ---- npz files -----------------------------------------------------------------------------------


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


def read_npz(
    path: Path, size: tuple[int, int], working_size: tuple[int, int], sealed: bool = False
) -> RecordedDetections:
    """Read the format of `pack_detections` for a video of (w, h) `size`, (0, 0): any.

    The detections are not validated. `detector_ran`: the frames in `done`; None: not stated.

    Args:
        sealed: as in `load_npz`.
    """
    data, _ = load_npz(path, sealed)

    def take(key: str, kind: type, *shape: int) -> Any:
        """Return an array of a shape, (): one axis of any length, converted to a type."""
        if (array := data.get(key)) is None:
            raise ReobjError(f"{path}: array {key} is missing")
        fits = array.shape == (shape or (array.size,))
        if not fits or (array.size and not np.can_cast(array.dtype, kind, "same_kind")):
            expected = f"{kind.__name__} of shape {shape or '(N,)'}"
            raise ReobjError(f"{path}: array {key} is {array.dtype} of shape {array.shape}, "
                             f"expected {expected}")  # fmt: skip
        return array.astype(kind)

    frame = take("frame", np.int64)
    count = len(frame)
    offsets = np.zeros(count + 1, np.int64)
    data = {"mask_counts": NO_RUNS, "mask_offsets": offsets} | data
    runs = take("mask_counts", np.int64)
    offsets = take("mask_offsets", np.int64, count + 1)
    if (np.diff(offsets, prepend=0) < 0).any() or offsets[-1] > len(runs) or (runs < 0).any():
        raise ReobjError(f"{path}: mask_counts and mask_offsets are inconsistent")
    width, height = take("image_size", np.int64, 2).tolist()
    if min(width, height) < 1 or size not in ((0, 0), (width, height)):
        raise ReobjError(f"{path}: made for images of {(width, height)} px, but the video is "
                         f"{size} px, turned upright")  # fmt: skip
    source = Source(path, SimpleNamespace(size=(width, height), working_size=working_size))
    classes = (take("class_id", np.int64, count), take("class_names", np.str_).tolist())
    return source.recorded(
        frame, take("xyxy", np.float64, count, 4), classes, unit="row",
        score=take("score", np.float64, count), detector_ran=np.unique(take("done", np.int64))
        if "done" in data else None, runs=np.split(runs.astype(np.uint32), offsets[1:])[:count],
    )  # fmt: skip
