"""CVAT for video 1.1 and for images 1.1: boxes, masks, and bounding boxes of other shapes."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np

from reobj.files import MEMORY_MAX, check_unpacked
from reobj.sources.image_frames import frames_of_names
from reobj.sources.masks import NO_RUNS, Counts, crop_runs, polygon_runs
from reobj.sources.recorded import RecordedDetections, Source
from reobj.types import Array, IntArray, ReobjError


def read_cvat(source: Source) -> RecordedDetections:
    """Read all shapes of an XML file or CVAT's zip that are not "outside".

    The identity is the track id + 1. Polygons and masks have a mask. Other shapes than these and
    upright boxes become their bounding boxes, and are counted in a message.
    """
    path = source.path
    try:
        root = _root(path)
        bounded = Counter[str]()  # number of shapes of each kind that became bounding boxes
        left = Counter(child.tag for parent in _parents(root) for child in parent)
        shapes = list(_shapes(root))
        boxes = np.array([_bounds(shape, bounded) for *_, shape in shapes], np.float64)
        size = [float(root.findtext(f".//meta//original_size/{side}", "0"))
                for side in ("width", "height")]  # fmt: skip
    except ReobjError as error:
        raise ReobjError(f"{path}: {error}") from error
    except Exception as error:  # zip, zlib and expat have their own exceptions for damaged files
        raise ReobjError(f"{path}: no annotations of CVAT for video 1.1 ({error!r:.200})") from None
    if not shapes:
        raise ReobjError(f"{path}: no track with a box; export the task as 'CVAT for video 1.1'")
    frames, identity, labels, _ = zip(*shapes, strict=True)
    for kind, count in sorted(bounded.items()):
        source.say(f"{count} {kind} taken as their bounding boxes")
    for kind in sorted(left.keys() - {*KINDS, "tag"}):
        source.say(f"{left[kind]} shapes {kind} left out")
    looked = None
    if isinstance(frames[0], str):
        frame = frames_of_names(frames, source)
    else:
        begin = int(source.first == "1")
        frame = np.array(frames, np.int64) - begin
        looked = _listed_frames(root, frames, begin)
    names, class_id = np.unique(labels, return_inverse=True)
    scale = source.scale(np.tile(size, (len(shapes), 1)))
    runs = [
        _runs(shape, ratio, source.video.size, f"{path}, box {at}")
        for at, ((*_, shape), ratio) in enumerate(zip(shapes, scale[:, :2], strict=True))
    ]
    ids = np.array(identity, np.int64)
    return source.recorded(
        frame, boxes, (class_id.astype(np.int64), names.tolist()), runs=runs, unit="box",
        scale=scale,
        identity=ids if (ids > 0).any() else np.empty(0, np.int64), looked=looked,
    )  # fmt: skip


def _root(path: Path) -> ET.Element:
    """Parse the annotations in an XML file or a zip archive."""
    most = MEMORY_MAX // 16  # bytes, 800,000 boxes: the parser needs ten times as much memory
    check_unpacked(path.stat().st_size, most)
    if not zipfile.is_zipfile(path):
        return ET.fromstring(path.read_bytes())
    with zipfile.ZipFile(path) as packed:
        check_unpacked(packed.getinfo("annotations.xml").file_size, most)
        return ET.fromstring(packed.read("annotations.xml"))


def _listed_frames(root: ET.Element, frames: Sequence[int | str], begin: int) -> IntArray | None:
    """Return the frames (F,) of a task that skips some; None: all, or `frames` are not in them.

    Our exports begin at 0 and have no step, whatever frames were read.
    """
    start, stop, step = (
        root.findtext(f"meta/task/{key}", "").removeprefix("step=").strip()
        for key in ("start_frame", "stop_frame", "frame_filter")
    )
    if not start.isdecimal() or not stop.isdecimal() or not (step or "1").isdecimal():
        return None
    listed = range(int(start), int(stop) + 1, max(int(step or 1), 1))
    if (listed.start == 0 and listed.step == 1) or not all(f in listed for f in frames):
        return None
    return np.array(listed, np.int64) - begin


Shape = tuple[int | str, int, str, ET.Element]  # frame or image, identity, label, element


KINDS = ("box", "polygon", "polyline", "points", "ellipse", "mask")


def _parents(root: ET.Element) -> list[ET.Element]:
    """List the tracks, or the images of CVAT for images."""
    return list(root.iter("track")) or list(root.iter("image"))


def _shapes(root: ET.Element) -> Iterator[Shape]:
    """Yield the shapes that are in view; those of images have no identities (0)."""
    for parent in _parents(root):
        for shape in parent:
            if shape.tag not in KINDS or shape.get("outside") == "1":
                continue
            if parent.tag == "track":
                identity = int(parent.attrib["id"]) + 1
                yield int(shape.attrib["frame"]), identity, parent.attrib["label"], shape
            else:
                yield parent.attrib["name"], 0, shape.attrib["label"], shape


def _floats(shape: ET.Element, names: str) -> Array:
    """Return attributes of a shape as numbers."""
    return np.array([float(shape.attrib[name]) for name in names.split()])


def _bounds(shape: ET.Element, bounded: Counter[str]) -> Array:
    """Return the bounding box (4,) of a shape; count shapes that have no mask and are no box."""
    angle_deg = float(shape.get("rotation") or 0)
    if shape.tag == "box":
        box = _floats(shape, "xtl ytl xbr ybr")
        if not angle_deg % 180:
            return box
        bounded["turned boxes"] += 1
        return _rotated_bounds((box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2, angle_deg, True)
    if shape.tag not in ("polygon", "mask"):
        bounded[shape.tag + "s" * (shape.tag != "points")] += 1
    if shape.tag == "ellipse":
        radii = _floats(shape, "rx ry")
        return _rotated_bounds(_floats(shape, "cx cy"), radii, angle_deg, False)
    if shape.tag == "mask":
        low = _floats(shape, "left top")
        return np.hstack([low, low + _floats(shape, "width height")])
    corners = _corners(shape)
    return np.hstack([corners.min(0), corners.max(0)])


def _corners(shape: ET.Element) -> Array:
    """Return the points (K, 2) of a polygon, a polyline or points."""
    pairs = [pair.split(",") for pair in shape.attrib["points"].split(";") if pair]
    return np.array(pairs, np.float64)


def _runs(shape: ET.Element, scale: Array, size: tuple[int, int], where: str) -> Counts:
    """Return the mask of a polygon or a mask as run lengths; of other shapes none.

    Args:
        scale: (2,) pixels of the video for each of the annotation. size: (w, h) of the video,
            (0, 0): unknown, no mask.
    """
    if size == (0, 0) or shape.tag not in ("polygon", "mask"):
        return NO_RUNS
    try:
        if shape.tag == "polygon":
            return polygon_runs([(_corners(shape) * scale).ravel().tolist()], size)
        return _mask_runs(shape, scale, size)
    except (KeyError, OverflowError, ValueError) as error:
        raise ReobjError(f"{where}: {shape.tag} cannot be read ({error!r:.120})") from error


def _mask_runs(shape: ET.Element, scale: Array, size: tuple[int, int]) -> Counts:
    """Return a mask as run lengths down the columns of the image; the file's follow its rows."""
    left, top, width, height = _floats(shape, "left top width height").astype(int).tolist()
    box = np.array([[left, top], [left + width, top + height]]) * scale  # (2, 2) corners
    if width < 1 or height < 1 or (box[0] < -scale).any() or (box[1] > size + scale).any():
        raise ValueError(f"{width}x{height} pixels from {left}, {top} on, beyond the image")
    counts = np.array(shape.attrib["rle"].split(","), np.int64)
    if counts.min() < 0 or counts.max() > width * height or counts.sum() != width * height:
        raise ValueError(f"run lengths of {counts.sum()} pixels for {width}x{height}")
    mask = np.repeat(np.arange(len(counts)) % 2, counts).reshape(height, width)  # (H, W) 0, 1
    (x1, y1), (x2, y2) = box.round().astype(int).tolist()
    scaled = (max(x2 - x1, 1), max(y2 - y1, 1))
    crop = cv2.resize(mask.astype(np.uint8), scaled, interpolation=cv2.INTER_NEAREST)
    return crop_runs(crop > 0, (x1, y1), size)


def _rotated_bounds(centre: Array, half: Array, angle_deg: float, box: bool) -> Array:
    """Bound a box or ellipse of half sides (2,), rotated about its centre (2,)."""
    c = np.cos(np.radians(angle_deg))
    s = np.sin(np.radians(angle_deg))
    sides = np.abs([[c, s], [s, c]]) * half
    reach = sides.sum(1) if box else np.sqrt((sides**2).sum(1))
    return np.hstack([centre - reach, centre + reach])
