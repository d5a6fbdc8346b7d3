"""Files of annotation tools: COCO results and datasets (COCO-VID, TAO), OA-SLAM, and CVAT's XML.

Image and category ids of COCO are resolved by the file itself, by a dataset JSON beside it, or as
numbers and names of images. Of CVAT 1.1 (for video, for images) boxes, masks, and bounding boxes of
other shapes are read.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar
from xml.etree import ElementTree as ET

import cv2
import msgspec
import numpy as np

from reobj.files import MEMORY_MAX, check_unpacked, load_json, shortened
from reobj.formats import frames_by_name
from reobj.sources.recorded import (
    CORNERS,
    NO_RUNS,
    SIZES,
    Counts,
    RecordedDetections,
    Source,
    coco_runs,
    frames_of_names,
    frames_of_numbers,
    original_name,
    polygon_runs,
    rle_encode,
)
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError

T = TypeVar("T")
Box = tuple[float, float, float, float]
Whole = Annotated[int, msgspec.Meta(gt=-(1 << 53), lt=1 << 53)]
Id = Whole | str


class Image(msgspec.Struct):
    """An image of a dataset; frame_id: COCO-VID, frame_index: TAO."""

    id: Id
    file_name: str | None = None
    width: float = 0
    height: float = 0
    frame_id: Whole | None = None
    frame_index: Whole | None = None
    video_id: Id | None = None


class Named(msgspec.Struct):
    """A category or a video."""

    id: Id
    name: str


class Identities(msgspec.Struct, kw_only=True):
    """Attributes that hold the identity of a box, as CVAT writes them, or the box itself."""

    track_id: Whole | float | None = None
    instance_id: Whole | float | None = None


class Rle(msgspec.Struct):
    """A mask as run lengths, compressed or not; size: (h, w)."""

    size: tuple[int, int]
    counts: str | list[int]


class Annotation(Identities, kw_only=True):
    """A box of an image."""

    image_id: Id
    category_id: Id
    bbox: Box
    bbox_mode: Literal[0, 1] = 1  # detectron2: 0 corners, 1 x, y, w, h; in px
    score: float = 1.0
    file_name: str | None = None
    attributes: Identities | list[Any] | None = None
    segmentation: Rle | list[list[float]] | None = None
    iscrowd: Any = False
    ignore: Any = False

    @property
    def identity(self) -> int:
        """Identity, -1: none."""
        stated = [one for one in (self, self.attributes) if isinstance(one, Identities)]
        values = [value for one in stated for value in (one.track_id, one.instance_id)]
        value = next((value for value in values if value is not None), -1)
        if value % 1:
            raise ValueError(f"track_id {value}, expected a whole number")
        return int(value)


class Dataset(msgspec.Struct):
    """Images and classes of a COCO dataset, perhaps with boxes."""

    images: list[Image]
    categories: list[Named] = []
    videos: list[Named] | None = None
    annotations: list[Annotation] | None = None


class _Found(msgspec.Struct):
    category_id: int
    bbox: Box
    detection_score: float = 1.0


class _OaImage(msgspec.Struct):
    file_name: str
    detections: list[_Found]


def converted(data: Any, kind: type[T], where: object) -> T:
    """Convert the content of a JSON file to a type; an error names the entry."""
    try:
        return msgspec.convert(data, kind)
    except ValueError as error:  # also a text that is no Unicode
        raise ReobjError(f"{where}: {error}") from error


def _beside(source: Source, entries: Sequence[Annotation]) -> Dataset | None:
    """Read the dataset beside a file of results that has all ids of the results.

    Raises:
        ReobjError: several datasets have them; or none does, and the results do not name their
            images.
    """
    fault = ""
    matches: dict[str, Dataset] = {}
    for other in sorted({*source.path.parent.glob("*.json")} - {source.path}):
        data = None
        with contextlib.suppress(ReobjError, OSError):  # an invalid JSON file is no dataset
            data = load_json(other)
        if not isinstance(data, dict) or not data.get("images"):
            continue
        dataset = converted(data | {"annotations": None}, Dataset, other)
        missing = {entry.image_id for entry in entries} - {image.id for image in dataset.images}
        missing |= {one.category_id for one in entries} - {one.id for one in dataset.categories}
        if missing:
            fault = f"id {min(missing, key=str)!r} is not in {other.name} beside it"
        else:
            matches[other.name] = dataset
    if len(matches) > 1:
        fault = f"{' and '.join(matches)} beside it all have the ids of its images"
    by_name = all(entry.file_name or isinstance(entry.image_id, str) for entry in entries)
    if fault and len(matches) != 1 and not (by_name and not matches):
        raise ReobjError(f"{source.path}: {fault}; keep only the dataset of this file there")
    source.say("".join(f"images and classes of {name} beside it" for name in matches))
    return next(iter(matches.values()), None)


def read_coco(source: Source) -> RecordedDetections:
    """Read a COCO, COCO-VID or TAO dataset with its own annotations."""
    dataset = converted(load_json(source.path), Dataset, source.path)
    if dataset.annotations is None:
        raise ReobjError(f"{source.path}: a dataset without annotations; give the file of COCO "
                         "results [{image_id, category_id, bbox, score}] beside it")  # fmt: skip
    return _read(source, dataset.annotations, dataset)


def read_coco_results(source: Source) -> RecordedDetections:
    """Read COCO results with ids of a dataset beside them, or with names or numbers of images."""
    entries = converted(load_json(source.path), list[Annotation], source.path)
    return _read(source, entries, _beside(source, entries) if entries else None)


def _read(source: Source, entries: list[Annotation], dataset: Dataset | None) -> RecordedDetections:
    """Convert COCO annotations."""
    classes = _categories(source, entries, dataset)
    frame, size, detector_ran = _images(source, entries, dataset)
    scale = source.scale(size, frame >= 0)
    masks = [_mask(entry.segmentation, source.video.size, ratio)
             for entry, ratio in zip(entries, scale[:, :2], strict=True)]  # fmt: skip
    form = CORNERS if any(entry.bbox_mode == 0 for entry in entries) else SIZES
    return source.recorded(
        frame, [entry.bbox for entry in entries], classes, form, scale, runs=masks,
        detector_ran=detector_ran,
        score=np.array([entry.score for entry in entries], np.float64),
        identity=np.array([entry.identity for entry in entries], np.int64),
        ignored=np.array([bool(entry.iscrowd or entry.ignore) for entry in entries], bool),
    )  # fmt: skip


def _categories(
    source: Source, entries: Sequence[Annotation], dataset: Dataset | None
) -> tuple[IntArray, Sequence[str]]:
    """Return the class (N,) of every entry and the class names.

    Category ids are those of the dataset; else positions in the names that the user gives, from 0,
    or from 1 if none is 0 and one is their number; else COCO's.
    """
    used = {entry.category_id for entry in entries}
    gaps = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # unused among COCO's category ids 1 to 90
    name_of: dict[Id, str] = dict(zip(sorted({*range(1, 91)} - {*gaps}), COCO_NAMES, strict=True))
    if source.names:
        from_1 = int(0 not in used and len(source.names) in used)
        name_of = dict(enumerate(source.names, from_1))
        text = f"category ids are taken as positions in the class names, from {from_1}"
        source.say(text * bool(used and 0 not in used))
    elif dataset is not None and dataset.categories:
        name_of = {category.id: category.name for category in dataset.categories}
    elif used:
        source.say("no categories in it or beside it: category_id is taken as COCO's (1 to 90)")
    for at, entry in enumerate(entries):
        if entry.category_id not in name_of:
            raise ReobjError(f"{source.path}, entry {at}: category_id {entry.category_id!r} is "
                             f"unknown, expected one of {shortened([*map(repr, name_of)])}: put "
                             "the dataset JSON beside this file, or give a file of names (ids from "
                             "0) with --set detect.class_names=FILE")  # fmt: skip
    names = list(dict.fromkeys(name_of.values()))
    return np.array([names.index(name_of[e.category_id]) for e in entries], np.int64), names


def _images(
    source: Source, entries: Sequence[Annotation], dataset: Dataset | None
) -> tuple[IntArray, Array, IntArray | None]:
    """Find the image of every entry.

    Returns:
        frame (N,) of every entry, -1: none; size (N, 2) of its image, 0: unknown; and the frames
        listed in the dataset, ascending, None without a dataset.
    """
    ids = [entry.image_id for entry in entries]
    if dataset is not None:
        frame_of = _dataset_frames(dataset, source)
        size_of = {image.id: (image.width, image.height) for image in dataset.images}
        for at in [at for at, i in enumerate(ids) if i not in size_of][:1]:
            raise ReobjError(f"{source.path}, entry {at}: image_id {ids[at]!r} is not in the "
                             f"dataset, which has {shortened([*map(repr, size_of)])}")  # fmt: skip
        listed = np.unique(np.array(list(frame_of.values()), np.int64))
        size = np.array([size_of[i] for i in ids], np.float64).reshape(-1, 2)
        frame = np.array([frame_of.get(i, -1) for i in ids], np.int64)
        return frame, size, listed[listed >= 0]
    size = np.zeros((len(entries), 2))
    numbers = [i for i in ids if isinstance(i, int)]
    if source.video.names or len(numbers) < len(ids):
        names = [entry.file_name or str(entry.image_id) for entry in entries]
        return frames_of_names(names, source, 0), size, None
    source.say("no dataset JSON beside it: image_id is taken as the frame number" * bool(ids))
    return frames_of_numbers(np.array(numbers, np.int64), source, 0), size, None


def _dataset_frames(dataset: Dataset, source: Source) -> dict[Id, int]:
    """Return the frames of the images of a dataset, -1: none.

    By file name; else by `frame_id` (COCO-VID) or `frame_index` (TAO); else by the numbers in the
    file names; in the order of the list only if the user says so.
    """
    video = source.video
    images = _of_one_video(dataset, source)
    names = [original_name(image.file_name or "") for image in images]
    numbers = [i.frame_index if i.frame_id is None else i.frame_id for i in images]
    rule = all(names) and frames_by_name([*dict.fromkeys(names)], video.files or video.names)[1]
    if source.first == "order":
        frame = np.arange(len(images))
    elif not (rule or (all(names) and source.describes)) and None not in numbers:
        frame = frames_of_numbers(np.array(numbers, np.int64), source, 0)
    elif all(names):
        frame = frames_of_names(names, source)
    else:
        raise ReobjError(f"{source.path}: {len(images)} images without file_name or frame_id; add "
                         "them, or say that the list has the order of the frames "
                         "(--set detect.first_frame=order)")  # fmt: skip
    return dict(zip((image.id for image in images), frame.tolist(), strict=True))


def _of_one_video(dataset: Dataset, source: Source) -> list[Image]:
    """Return the images of the video, of a dataset of several; all if images are found by name."""
    images = dataset.images
    stem = Path(source.video.source).stem
    of_video = [video.id for video in dataset.videos or () if Path(video.name).stem == stem]
    kept = [image for image in images if [image.video_id] == of_video]
    ids = {image.video_id for image in images}
    if len(ids) < 2 or (not kept and source.video.names and any(i.file_name for i in images)):
        return images
    if not kept:
        some = shortened([video.name for video in dataset.videos or ()])
        raise ReobjError(f"{source.path}: images of {len(ids)} videos ({some}), none of them "
                         f"called {stem}; keep one, or rename it")  # fmt: skip
    source.say(f"{len(images) - len(kept)} images of other videos left out")
    return kept


def _mask(mask: Rle | list[list[float]] | None, size: tuple[int, int], scale: Array) -> Counts:
    """Return a segmentation as run lengths."""
    if not mask or size == (0, 0):
        return NO_RUNS
    if not isinstance(mask, Rle):
        rings = [np.reshape(ring, (-1, 2)) * scale for ring in mask]
        return polygon_runs(rings, size)
    if mask.size != size[::-1]:
        raise ValueError(f"mask of (h, w) {mask.size} in a video of {size[::-1]}")
    counts = mask.counts
    return coco_runs(counts) if isinstance(counts, str) else np.array(counts, np.uint32)


def read_oa_slam(source: Source) -> RecordedDetections:
    """Read the file of OA-SLAM and VOOM: one entry per image, boxes as corners, classes from 0."""
    images = converted(load_json(source.path), list[_OaImage], source.path)
    rows = [found for image in images for found in image.detections]
    frames = frames_of_names([image.file_name for image in images], source)
    kinds = np.array([row.category_id for row in rows], np.int64)
    return source.recorded(
        np.repeat(frames, [len(image.detections) for image in images]),
        [row.bbox for row in rows], (kinds, source.names or COCO_NAMES), unit="detection",
        score=np.array([row.detection_score for row in rows], np.float64),
    )  # fmt: skip


# ---- CVAT ---------------------------------------------------------------------------------------


# Kinds of shapes that are read, and as what those without a mask are counted in a message
KINDS = {"box": "turned boxes", "polygon": "", "mask": "", "polyline": "polylines",
         "points": "points", "ellipse": "ellipses"}  # fmt: skip


def read_cvat(source: Source) -> RecordedDetections:
    """Read all shapes of an XML file or CVAT's zip that are not "outside".

    The identity is the track id + 1. Polygons and masks have a mask. Other shapes than these and
    upright boxes become their bounding boxes, and are counted in a message.
    """
    path = source.path
    most = MEMORY_MAX // 16  # bytes, 800,000 boxes: the parser needs ten times as much memory
    with contextlib.ExitStack() as opened:
        file: Any = path
        size = path.stat().st_size
        if zipfile.is_zipfile(path):
            packed = opened.enter_context(zipfile.ZipFile(path))
            size = packed.getinfo("annotations.xml").file_size
            file = opened.enter_context(packed.open("annotations.xml"))
        check_unpacked(size, most)
        root = ET.parse(file).getroot()
    tracks = list(root.iter("track"))
    parents = tracks or list(root.iter("image"))
    shapes = [(parent, shape) for parent in parents for shape in parent
              if shape.tag in KINDS and shape.get("outside") != "1"]  # fmt: skip
    if not shapes:
        raise ReobjError(f"{path}: no track with a box; export the task as 'CVAT for video 1.1'")
    outlines = [_outline(shape) for _, shape in shapes]
    sides = [float(root.findtext(f".//meta//original_size/{side}", "0"))
             for side in ("width", "height")]  # fmt: skip
    scale = source.scale(np.tile(sides, (len(shapes), 1)))
    columns: dict[str, Any] = {}
    if tracks:
        begin = int(source.first == "1")
        numbers = np.array([int(shape.attrib["frame"]) for _, shape in shapes], np.int64)
        frame = numbers - begin
        columns["detector_ran"] = _listed_frames(root, numbers, begin)
        columns["identity"] = np.array([int(track.attrib["id"]) + 1 for track, _ in shapes])
    else:
        frame = frames_of_names([image.attrib["name"] for image, _ in shapes], source)
    labels = [(track if tracks else shape).attrib["label"] for track, shape in shapes]
    bounded = Counter(KINDS[shape.tag] for _, shape in shapes
                      if shape.tag != "box" or _angle(shape))  # fmt: skip
    others = Counter(shape.tag for parent in parents for shape in parent
                     if shape.tag not in (*KINDS, "tag"))  # fmt: skip
    for kind, count in sorted(bounded.items()):
        source.say(f"{count} {kind} taken as their bounding boxes" * bool(kind))
    for kind, count in sorted(others.items()):
        source.say(f"{count} shapes {kind} left out")
    names, class_id = np.unique(labels, return_inverse=True)
    return source.recorded(
        frame, [np.hstack([outline.min(0), outline.max(0)]) for outline in outlines],
        (class_id.astype(np.int64), names.tolist()), CORNERS, scale, "box",
        runs=[_cvat_runs(shape, outline, ratio, source.video.size)
              for (_, shape), outline, ratio in zip(shapes, outlines, scale[:, :2], strict=True)],
        **columns,
    )  # fmt: skip


def _listed_frames(root: ET.Element, frames: IntArray, begin: int) -> IntArray | None:
    """Return the frames (F,) of a task that skips some; None: all, or `frames` are not in them.

    Our exports begin at 0 and have no step, whatever frames were read.
    """
    start, stop, step = (
        int(root.findtext(f"meta/task/{key}", "").removeprefix("step=").strip() or default)
        for key, default in (("start_frame", 0), ("stop_frame", -1), ("frame_filter", 1))
    )
    listed = np.arange(start, stop + 1, max(step, 1))
    if (start == 0 and step == 1) or not np.isin(frames, listed).all():
        return None
    return listed - begin


def _angle(shape: ET.Element) -> float:
    """Return the rotation of a shape, deg clockwise in the image; 180 deg are none."""
    return float(shape.get("rotation") or 0) % 180


def _outline(shape: ET.Element) -> Array:
    """Return points (K, 2) on the outline of a shape: its corners, or 360 points of an ellipse."""

    def floats(names: str) -> Array:
        return np.array([float(shape.attrib[name]) for name in names.split()])

    if "points" in shape.attrib:
        pairs = [pair.split(",") for pair in shape.attrib["points"].split(";") if pair]
        return np.array(pairs, np.float64)
    if shape.tag == "mask":
        return np.array([floats("left top"), floats("left top") + floats("width height")])
    angle = np.radians(_angle(shape))
    if shape.tag == "ellipse":
        center = floats("cx cy")
        half = floats("rx ry")
        around = np.radians(np.arange(360))
        unit = np.stack([np.cos(around), np.sin(around)], 1)
    else:
        box = floats("xtl ytl xbr ybr").reshape(2, 2)
        if not angle:
            return box
        center = box.mean(0)
        half = np.ptp(box, 0) / 2
        unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.asarray(center + unit * half @ turn)


def _cvat_runs(shape: ET.Element, outline: Array, scale: Array, size: tuple[int, int]) -> Counts:
    """Return the mask of a polygon or a mask as run lengths; of other shapes none.

    The file's run lengths of a mask follow its rows.

    Args:
        scale: (2,) pixels of the video for each of the annotation. size: (w, h) of the video,
            (0, 0): unknown, no mask.
    """
    scaled = outline * scale
    if size == (0, 0) or shape.tag not in ("polygon", "mask"):
        return NO_RUNS
    if shape.tag == "polygon":
        return polygon_runs([scaled], size)
    width, height = np.ptp(outline, 0).astype(int).tolist()
    counts = np.array(shape.attrib["rle"].split(","), np.int64)
    if (scaled < -scale).any() or (scaled > size + scale).any() or counts.sum() != width * height:
        raise ValueError(f"a mask of {counts.sum()} pixels that is not {width}x{height}, or not in "
                         "the image")  # fmt: skip
    mask = np.repeat(np.arange(len(counts)) % 2, counts).reshape(height, width)  # (H, W) 0, 1
    low, high = scaled.round().astype(int)  # (2,) corners
    resized = np.maximum(high - low, 1).tolist()
    crop = cv2.resize(mask.astype(np.uint8), resized, interpolation=cv2.INTER_NEAREST)
    return rle_encode(crop > 0, low.tolist(), size)
