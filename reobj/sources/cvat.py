"""CVAT for video 1.1 and for images 1.1: boxes, and the shapes that are taken as boxes."""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from reobj.files import check_unpacked
from reobj.sources.class_names import check_length
from reobj.sources.image_frames import frames_of_names
from reobj.sources.masks import NO_RUNS
from reobj.sources.recorded import RecordedDetections, scale_to
from reobj.sources.video import Video
from reobj.types import Array, ReobjError

XML_MAX = 1 << 27  # bytes; chosen: 800,000 boxes; the parser takes ten times as much
CVAT_BOX = ("xtl", "ytl", "xbr", "ybr")
SHAPES = ("box", "polygon", "polyline", "points", "ellipse", "mask", "cuboid")


def read_cvat(path: Path, video: Video, first: str = "") -> RecordedDetections:
    """Read what is not "outside"; identity is track id + 1.

    Shapes that are no upright boxes are taken as their bounding boxes, and counted.

    Args:
        path: XML, or the zip that CVAT gives. first: number of the first frame as the user says it.
    Raises:
        ReobjError: no such file, or no shape in it.
    """
    try:
        check_unpacked(path.stat().st_size, XML_MAX)
        text = path.read_bytes()
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as packed:
                check_unpacked(packed.getinfo("annotations.xml").file_size, XML_MAX)
                text = packed.read("annotations.xml")
        root = ET.fromstring(text)
        made = Counter[str]()
        shapes = list(_of_tracks(root)) or list(_of_images(root))
        boxes = [_bounds(shape, made) for _, _, _, shape in shapes]
        frames = [f for f, _, _, _ in shapes]
        labels = [name for _, _, name, _ in shapes]
        ids = np.array([identity for _, identity, _, _ in shapes], np.int64)
        size = root.find(".//meta//original_size")
        made_for = [0.0, 0.0]
        if size is not None:
            made_for = [float(size.findtext(side, "0")) for side in ("width", "height")]
    except ReobjError as error:
        raise ReobjError(f"{path}: {error}") from error
    except Exception as error:  # zip and zlib have their own for damaged files, and so has expat
        raise ReobjError(f"{path}: no annotations of CVAT for video 1.1 ({error!r:.200})") from None
    skeletons = sum(1 for _ in root.iter("skeleton"))
    if not shapes:
        raise ReobjError(f"{path}: no track with a box; export the task as 'CVAT for video 1.1'")
    messages = [f"{n} {what} taken as their bounding boxes" for what, n in sorted(made.items())]
    messages += [f"{skeletons} skeletons left out"] if skeletons else []
    if isinstance(frames[0], str):
        frame, said = frames_of_names([str(f) for f in frames], video, str(path), first, None, True)
        messages += [said] if said else []
    else:
        frame = np.array(frames, np.int64) - int(first or 0)
    names, class_id = np.unique(labels, return_inverse=True)
    for name in names.tolist():
        check_length(name, f"{path}, label")
    n = len(shapes)
    scale = scale_to(video.size, np.tile(made_for, (n, 1)), np.ones(n, bool), str(path), messages)
    return RecordedDetections(
        frame, np.array(boxes, np.float64) * scale, np.ones(n), class_id.astype(np.int64),
        [NO_RUNS] * n, tuple(names.tolist()), video.size, video.working_size, np.arange(n), "box",
        messages, ids if (ids > 0).any() else np.empty(0, np.int64),
    )  # fmt: skip


Shape = tuple[int | str, int, str, ET.Element]  # frame or image, identity, label, element


def _of_tracks(root: ET.Element) -> Iterator[Shape]:
    """Yield the shapes of tracks."""
    for track in root.iter("track"):
        for shape in track:
            if shape.tag in SHAPES and shape.attrib.get("outside") != "1":
                identity = int(track.attrib["id"]) + 1
                yield int(shape.attrib["frame"]), identity, track.attrib["label"], shape


def _of_images(root: ET.Element) -> Iterator[Shape]:
    """Yield the shapes of images (CVAT for images), which have no identities."""
    for image in root.iter("image"):
        for shape in image:
            if shape.tag in SHAPES:
                yield image.attrib["name"], 0, shape.attrib["label"], shape


def _bounds(shape: ET.Element, made: Counter[str]) -> Array:
    """Return the bounding box (4,) of a shape; count what is no upright box."""
    own = shape.attrib
    if shape.tag == "box":
        low, high = np.array([float(own[key]) for key in CVAT_BOX]).reshape(2, 2)
        angle = float(own.get("rotation", "0") or 0)
        if not angle % 180:
            return np.hstack([low, high])
        made["turned boxes"] += 1
        return _turned((low + high) / 2, (high - low) / 2, angle, box=True)
    made[shape.tag + "s" * (shape.tag != "points")] += 1
    if shape.tag == "ellipse":
        centre = np.array([float(own["cx"]), float(own["cy"])])
        radii = np.array([float(own["rx"]), float(own["ry"])])
        return _turned(centre, radii, float(own.get("rotation", "0") or 0), box=False)
    if shape.tag == "mask":
        low = np.array([float(own["left"]), float(own["top"])])
        return np.hstack([low, low + np.array([float(own["width"]), float(own["height"])])])
    if shape.tag == "cuboid":
        places = [[float(v) for k, v in own.items() if re.fullmatch(axis + "[tb][lr][12]", k)]
                  for axis in "xy"]  # fmt: skip
        return np.array([min(places[0]), min(places[1]), max(places[0]), max(places[1])])
    corners = np.array([pair.split(",") for pair in own["points"].split(";") if pair], np.float64)
    return np.hstack([corners.min(0), corners.max(0)])


def _turned(centre: Array, half: Array, angle_deg: float, box: bool) -> Array:
    """Bound a box or ellipse of half sides (2,) that is turned about its centre (2,)."""
    c = np.cos(np.radians(angle_deg))
    s = np.sin(np.radians(angle_deg))
    sides = np.abs([[c, s], [s, c]]) * half
    reach = sides.sum(1) if box else np.sqrt((sides**2).sum(1))
    return np.hstack([centre - reach, centre + reach])
