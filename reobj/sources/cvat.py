"""CVAT for video 1.1 and for images 1.1: boxes, masks, and bounding boxes of other shapes."""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np

from reobj.files import MEMORY_MAX, check_unpacked
from reobj.sources.class_names import check_length
from reobj.sources.image_frames import frames_of_names
from reobj.sources.masks import NO_RUNS, Counts, crop_runs, polygon_runs
from reobj.sources.recorded import RecordedDetections, scale_to
from reobj.sources.video import Video
from reobj.types import Array, IntArray, ReobjError


def read_cvat(path: Path, video: Video, first: str = "") -> RecordedDetections:
    """Read all shapes that are not "outside"; the identity is the track id + 1.

    Polygons and masks have a mask. Other shapes than these and upright boxes become their bounding
    boxes, and are counted in a message.

    Args:
        path: XML, or CVAT's zip. first: number of the first frame, "": 0.
    Raises:
        ReobjError: the file is missing, of another format, or has no shapes.
    """
    most = MEMORY_MAX // 16  # bytes, 800,000 boxes: the parser needs ten times as much memory
    try:
        check_unpacked(path.stat().st_size, most)
        text = path.read_bytes()
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as packed:
                check_unpacked(packed.getinfo("annotations.xml").file_size, most)
                text = packed.read("annotations.xml")
        root = ET.fromstring(text)
        bounded = Counter[str]()  # number of shapes of each kind that became bounding boxes
        shapes = list(_of_tracks(root)) or list(_of_images(root))
        boxes = [_bounds(shape, bounded) for _, _, _, shape in shapes]
        frames = [f for f, _, _, _ in shapes]
        labels = [name for _, _, name, _ in shapes]
        ids = np.array([identity for _, identity, _, _ in shapes], np.int64)
        size = root.find(".//meta//original_size")
        image_size = [0.0, 0.0]
        if size is not None:
            image_size = [float(size.findtext(side, "0")) for side in ("width", "height")]
    except ReobjError as error:
        raise ReobjError(f"{path}: {error}") from error
    except Exception as error:  # zip, zlib and expat have their own exceptions for damaged files
        raise ReobjError(f"{path}: no annotations of CVAT for video 1.1 ({error!r:.200})") from None
    looked = None
    skeletons = sum(1 for _ in root.iter("skeleton"))
    if not shapes:
        raise ReobjError(f"{path}: no track with a box; export the task as 'CVAT for video 1.1'")
    messages = [f"{n} {kind} taken as their bounding boxes" for kind, n in sorted(bounded.items())]
    messages += [f"{skeletons} skeletons left out"] if skeletons else []
    if isinstance(frames[0], str):
        frame, note = frames_of_names([str(f) for f in frames], video, str(path), first, None, True)
        messages += [note] if note else []
    else:
        frame = np.array(frames, np.int64) - int(first or 0)
        looked = _listed_frames(root, frames)
        looked = None if looked is None else looked - int(first or 0)
    names, class_id = np.unique(labels, return_inverse=True)
    for name in names.tolist():
        check_length(name, f"{path}, label")
    n = len(shapes)
    size_of = np.tile(image_size, (n, 1))
    scale = scale_to(video.size, size_of, np.ones(n, bool), str(path), messages)
    runs = [
        _runs(shape, ratio, video.size, f"{path}, box {at}")
        for at, ((_, _, _, shape), ratio) in enumerate(zip(shapes, scale[:, :2], strict=True))
    ]
    return RecordedDetections(
        frame, np.array(boxes, np.float64) * scale, np.ones(n), class_id.astype(np.int64),
        runs, tuple(names.tolist()), video.size, video.working_size, np.arange(n), "box",
        messages, ids if (ids > 0).any() else np.empty(0, np.int64), looked=looked,
    )  # fmt: skip


def _listed_frames(root: ET.Element, frames: Sequence[int | str]) -> IntArray | None:
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
    return np.array(listed, np.int64)


Shape = tuple[int | str, int, str, ET.Element]  # frame or image, identity, label, element


def _of_tracks(root: ET.Element) -> Iterator[Shape]:
    """Yield the shapes of tracks."""
    for track in root.iter("track"):
        for shape in _shapes(track):
            if shape.attrib.get("outside") != "1":
                identity = int(track.attrib["id"]) + 1
                yield int(shape.attrib["frame"]), identity, track.attrib["label"], shape


def _of_images(root: ET.Element) -> Iterator[Shape]:
    """Yield the shapes of CVAT for images, which have no identities (0)."""
    for image in root.iter("image"):
        for shape in _shapes(image):
            yield image.attrib["name"], 0, shape.attrib["label"], shape


def _shapes(parent: ET.Element) -> list[ET.Element]:
    """List the shapes of a track or an image that have a bounding box."""
    kinds = ("box", "polygon", "polyline", "points", "ellipse", "mask", "cuboid")
    return [child for child in parent if child.tag in kinds]


def _bounds(shape: ET.Element, bounded: Counter[str]) -> Array:
    """Return the bounding box (4,) of a shape; count shapes that have no mask and are no box."""
    attributes = shape.attrib
    if shape.tag == "box":
        sides = [float(attributes[key]) for key in ("xtl", "ytl", "xbr", "ybr")]
        low, high = np.array(sides).reshape(2, 2)
        angle = float(attributes.get("rotation", "0") or 0)
        if not angle % 180:
            return np.hstack([low, high])
        bounded["turned boxes"] += 1
        return _rotated_bounds((low + high) / 2, (high - low) / 2, angle, box=True)
    if shape.tag not in ("polygon", "mask"):
        bounded[shape.tag + "s" * (shape.tag != "points")] += 1
    if shape.tag == "ellipse":
        centre = np.array([float(attributes["cx"]), float(attributes["cy"])])
        radii = np.array([float(attributes["rx"]), float(attributes["ry"])])
        angle = float(attributes.get("rotation", "0") or 0)
        return _rotated_bounds(centre, radii, angle, box=False)
    if shape.tag == "mask":
        low = np.array([float(attributes["left"]), float(attributes["top"])])
        size = np.array([float(attributes["width"]), float(attributes["height"])])
        return np.hstack([low, low + size])
    if shape.tag == "cuboid":
        x, y = ([float(v) for k, v in attributes.items() if re.fullmatch(axis + "[tb][lr][12]", k)]
                for axis in "xy")  # fmt: skip
        return np.array([min(x), min(y), max(x), max(y)])
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
    if size == (0, 0):
        return NO_RUNS
    try:
        if shape.tag == "polygon":
            return polygon_runs([(_corners(shape) * scale).ravel().tolist()], size)
        return _mask_runs(shape, scale, size) if shape.tag == "mask" else NO_RUNS
    except (KeyError, OverflowError, ValueError) as error:
        raise ReobjError(f"{where}: {shape.tag} cannot be read ({error!r:.120})") from error


def _mask_runs(shape: ET.Element, scale: Array, size: tuple[int, int]) -> Counts:
    """Return a mask as run lengths down the columns of the image; the file's follow its rows."""
    left, top, width, height = (
        int(float(shape.attrib[key])) for key in ("left", "top", "width", "height")
    )
    low = np.array([left, top], np.float64) * scale
    high = np.array([left + width, top + height], np.float64) * scale
    if width < 1 or height < 1 or (low < -scale).any() or (high > size + scale).any():
        raise ValueError(f"{width}x{height} pixels from {left}, {top} on, beyond the image")
    counts = np.array(shape.attrib["rle"].split(","), np.int64)
    if counts.min() < 0 or counts.max() > width * height or counts.sum() != width * height:
        raise ValueError(f"run lengths of {counts.sum()} pixels for {width}x{height}")
    crop = np.repeat(np.arange(len(counts)) % 2 > 0, counts).reshape(height, width)
    corner = low.round().astype(int)
    if (scale != 1).any():
        scaled = np.maximum(high.round().astype(int) - corner, 1).tolist()
        small = crop.astype(np.uint8)
        crop = cv2.resize(small, scaled, interpolation=cv2.INTER_NEAREST) > 0
    return crop_runs(crop, (int(corner[0]), int(corner[1])), size)


def _rotated_bounds(centre: Array, half: Array, angle_deg: float, box: bool) -> Array:
    """Bound a box or ellipse of half sides (2,), rotated about its centre (2,)."""
    c = np.cos(np.radians(angle_deg))
    s = np.sin(np.radians(angle_deg))
    sides = np.abs([[c, s], [s, c]]) * half
    reach = sides.sum(1) if box else np.sqrt((sides**2).sum(1))
    return np.hstack([centre - reach, centre + reach])
