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
    crop_runs,
    frames_of_names,
    frames_of_numbers,
    original_name,
    polygon_runs,
)
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError

T = TypeVar("T")
Box = tuple[float, float, float, float]
Whole = Annotated[int, msgspec.Meta(gt=-(1 << 53), lt=1 << 53)]
Id = Whole | str


class Image(msgspec.Struct):
    """An image of a dataset."""

    id: Id
    file_name: str | None = None
    width: float | None = None
    height: float | None = None
    frame_id: Whole | None = None  # COCO-VID
    frame_index: Whole | None = None  # TAO
    video_id: Id | None = None

    @property
    def number(self) -> int | None:
        """Number of the frame."""
        return self.frame_index if self.frame_id is None else self.frame_id


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
        values = [self.track_id, self.instance_id]
        if isinstance(self.attributes, Identities):
            values += [self.attributes.track_id, self.attributes.instance_id]
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
    path = source.path
    ids = {entry.image_id for entry in entries}
    kinds = {entry.category_id for entry in entries}
    fault = ""
    matches: dict[str, Dataset] = {}
    for other in sorted(path.parent.glob("*.json")):
        data = None
        with contextlib.suppress(ReobjError, OSError):  # an invalid JSON file is no dataset
            data = load_json(other) if other != path else None
        if not isinstance(data, dict) or not data.get("images"):
            continue
        dataset = converted(data | {"annotations": None}, Dataset, other)
        missing = [*ids.difference(image.id for image in dataset.images)]
        missing += kinds.difference(named.id for named in dataset.categories or ())
        if missing:
            fault = f"id {missing[0]!r} is not in the dataset JSON {other.name} beside this file"
        else:
            matches[other.name] = dataset
    if len(matches) > 1:
        raise ReobjError(f"{path}: {' and '.join(matches)} beside it all have the ids of its "
                         "images; keep only the dataset of this file")  # fmt: skip
    by_name = all(entry.file_name or isinstance(entry.image_id, str) for entry in entries)
    if fault and not matches and not by_name:
        raise ReobjError(f"{path}: {fault}; put its own dataset there, or remove the other")
    for name, dataset in matches.items():
        source.say(f"images and classes of {name} beside it")
        return dataset
    return None


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
    frame, size, looked = _images(source, entries, dataset)
    scale = source.scale(size, frame >= 0)
    modes = {entry.bbox_mode for entry in entries}
    masks = [_mask(entry.segmentation, source.video.size, ratio)
             for entry, ratio in zip(entries, scale[:, :2], strict=True)]  # fmt: skip
    return source.recorded(
        frame, np.array([entry.bbox for entry in entries]), classes,
        np.array([entry.score for entry in entries], np.float64), masks,
        form=CORNERS if 0 in modes else SIZES, scale=scale, looked=looked,
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
    used = list(dict.fromkeys(entry.category_id for entry in entries))
    gaps = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # unused among COCO's category ids 1 to 90
    numbers = [number for number in range(1, 91) if number not in gaps]
    name_of: dict[Id, str] = dict(zip(numbers, COCO_NAMES, strict=True))
    if source.names:
        from_1 = 0 not in used and len(source.names) in used
        name_of = dict(enumerate(source.names, int(from_1)))
        text = f"category ids are taken as positions in the class names, from {int(from_1)}"
        source.say(text * bool(used and 0 not in used))
    elif dataset is not None and dataset.categories:
        name_of = {category.id: category.name for category in dataset.categories}
    elif used:
        source.say("no categories in it or beside it: category_id is taken as COCO's (1 to 90)")
    for at, entry in enumerate(entries):
        if entry.category_id not in name_of:
            known = shortened([repr(i) for i in name_of])
            raise ReobjError(f"{source.path}, entry {at}: category_id {entry.category_id!r} is "
                             f"unknown, expected one of {known}: put the dataset JSON beside this "
                             "file, or give a file of names (ids from 0) with --set "
                             "detect.class_names=FILE")  # fmt: skip
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
        size_of = {image.id: (image.width or 0, image.height or 0) for image in dataset.images}
        for at in [at for at, i in enumerate(ids) if i not in size_of][:1]:
            known = shortened([*map(repr, size_of)])
            raise ReobjError(f"{source.path}, entry {at}: image_id {ids[at]!r} is not in the "
                             f"dataset, which has {known}")  # fmt: skip
        listed = np.unique(np.array(list(frame_of.values()), np.int64))
        size = np.array([size_of[i] for i in ids], np.float64).reshape(-1, 2)
        return np.array([frame_of[i] for i in ids], np.int64), size, listed[listed >= 0]
    size = np.zeros((len(entries), 2))
    numbers = [i for i in ids if isinstance(i, int)]
    if source.video.names or len(numbers) < len(ids):
        names = [entry.file_name or str(entry.image_id) for entry in entries]
        return frames_of_names(names, source, 0), size, None
    source.say("no dataset JSON beside it: image_id is taken as the frame number" * bool(ids))
    return frames_of_numbers(np.array(numbers, np.int64), source, 0), size, None


def _dataset_frames(dataset: Dataset, source: Source) -> dict[Id, int]:
    """Return the frame of every image of a dataset, -1: none.

    By file name; else by `frame_id` (COCO-VID) or `frame_index` (TAO); else by the numbers in the
    file names; in the order of the list only if the user says so.
    """
    video = source.video
    images = _of_one_video(dataset, source)
    names = [original_name(image.file_name or "") for image in images]
    named = bool(images) and all(names)
    numbers = [image.number for image in images]
    rule = named and frames_by_name(list(dict.fromkeys(names)), video.files or video.names)[1]
    if source.first == "order":
        frame = np.arange(len(images))
    elif not (rule or (named and source.describes)) and all(
        number is not None for number in numbers
    ):
        frame = frames_of_numbers(np.array(numbers, np.int64), source, 0)
    elif named or not images:
        frame = frames_of_names(names, source)
    else:
        raise ReobjError(f"{source.path}: {len(images)} images without file_name or frame_id; add "
                         "them, or say that the list has the order of the frames "
                         "(--set detect.first_frame=order)")  # fmt: skip
    frame_of: dict[Id, int] = dict.fromkeys((image.id for image in dataset.images), -1)
    return frame_of | dict(zip((image.id for image in images), frame.tolist(), strict=True))


def _of_one_video(dataset: Dataset, source: Source) -> list[Image]:
    """Return the images of the video, of a dataset of several; all if images are found by name."""
    images = dataset.images
    stem = Path(source.video.source).stem
    of_video = {video.id for video in dataset.videos or () if Path(video.name).stem == stem}
    kept = [image for image in images if image.video_id in of_video and len(of_video) == 1]
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
    return source.recorded(
        np.repeat(frames, [len(image.detections) for image in images]),
        np.array([row.bbox for row in rows], np.float64),
        (np.array([row.category_id for row in rows], np.int64), source.names or COCO_NAMES),
        np.array([row.detection_score for row in rows], np.float64), unit="detection",
    )  # fmt: skip


# ---- CVAT ---------------------------------------------------------------------------------------


KINDS = ("box", "polygon", "polyline", "points", "ellipse", "mask")


def read_cvat(source: Source) -> RecordedDetections:
    """Read all shapes of an XML file or CVAT's zip that are not "outside".

    The identity is the track id + 1. Polygons and masks have a mask. Other shapes than these and
    upright boxes become their bounding boxes, and are counted in a message.
    """
    bounded = Counter[str]()  # number of shapes of each kind that became bounding boxes
    identity = np.empty(0, np.int64)
    looked = None
    root = _cvat_root(source.path)
    tracks = list(root.iter("track"))
    parents = tracks or list(root.iter("image"))
    left = Counter(child.tag for parent in parents for child in parent)
    shapes = [(parent, shape) for parent in parents for shape in parent
              if shape.tag in KINDS and shape.get("outside") != "1"]  # fmt: skip
    if not shapes:
        raise ReobjError(f"{source.path}: no track with a box; export the task as 'CVAT for video "
                         "1.1'")  # fmt: skip
    boxes = np.array([_bounds(shape, bounded) for _, shape in shapes])
    size = [float(root.findtext(f".//meta//original_size/{side}", "0"))
            for side in ("width", "height")]  # fmt: skip
    scale = source.scale(np.tile(size, (len(shapes), 1)))
    runs = [_cvat_runs(shape, ratio, source.video.size)
            for (_, shape), ratio in zip(shapes, scale[:, :2], strict=True)]  # fmt: skip
    if tracks:
        begin = int(source.first == "1")
        numbers = [int(shape.attrib["frame"]) for _, shape in shapes]
        frame = np.array(numbers, np.int64) - begin
        looked = _listed_frames(root, numbers, begin)
        identity = np.array([int(track.attrib["id"]) + 1 for track, _ in shapes], np.int64)
        labels = [track.attrib["label"] for track, _ in shapes]
    else:
        frame = frames_of_names([image.attrib["name"] for image, _ in shapes], source)
        labels = [shape.attrib["label"] for _, shape in shapes]
    for kind, count in sorted(bounded.items()):
        source.say(f"{count} {kind} taken as their bounding boxes")
    for kind in sorted(left.keys() - {*KINDS, "tag"}):
        source.say(f"{left[kind]} shapes {kind} left out")
    names, class_id = np.unique(labels, return_inverse=True)
    return source.recorded(
        frame, boxes, (class_id.astype(np.int64), names.tolist()), runs=runs, unit="box",
        scale=scale, identity=identity, looked=looked,
    )  # fmt: skip


def _cvat_root(path: Path) -> ET.Element:
    """Parse the annotations in an XML file or a zip archive."""
    most = MEMORY_MAX // 16  # bytes, 800,000 boxes: the parser needs ten times as much memory
    if not zipfile.is_zipfile(path):
        check_unpacked(path.stat().st_size, most)
        return ET.fromstring(path.read_bytes())
    with zipfile.ZipFile(path) as packed:
        check_unpacked(packed.getinfo("annotations.xml").file_size, most)
        return ET.fromstring(packed.read("annotations.xml"))


def _listed_frames(root: ET.Element, frames: Sequence[int], begin: int) -> IntArray | None:
    """Return the frames (F,) of a task that skips some; None: all, or `frames` are not in them.

    Our exports begin at 0 and have no step, whatever frames were read.
    """
    start, stop, step = (
        root.findtext(f"meta/task/{key}", "").removeprefix("step=").strip() or default
        for key, default in (("start_frame", "0"), ("stop_frame", "-1"), ("frame_filter", "1"))
    )
    listed = range(int(start), int(stop) + 1, max(int(step), 1))
    if (listed.start == 0 and listed.step == 1) or not all(f in listed for f in frames):
        return None
    return np.array(listed, np.int64) - begin


def _floats(shape: ET.Element, names: str) -> Array:
    """Return attributes of a shape as numbers."""
    return np.array([float(shape.attrib[name]) for name in names.split()])


def _bounds(shape: ET.Element, bounded: Counter[str]) -> Array:
    """Return the bounding box (4,) of a shape; count shapes that have no mask and are no box."""
    angle = np.radians(float(shape.get("rotation") or 0) % 180)
    turn = np.abs([[np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if shape.tag == "box":
        box = _floats(shape, "xtl ytl xbr ybr")
        if not angle:
            return box
        bounded["turned boxes"] += 1
        centre = (box[:2] + box[2:]) / 2
        reach = turn @ (box[2:] - box[:2]) / 2
        return np.hstack([centre - reach, centre + reach])
    if shape.tag not in ("polygon", "mask"):
        bounded[shape.tag + "s" * (shape.tag != "points")] += 1
    if shape.tag == "ellipse":
        centre = _floats(shape, "cx cy")
        reach = np.sqrt(turn**2 @ _floats(shape, "rx ry") ** 2)
        return np.hstack([centre - reach, centre + reach])
    if shape.tag == "mask":
        low = _floats(shape, "left top")
        return np.hstack([low, low + _floats(shape, "width height")])
    corners = _corners(shape)
    return np.hstack([corners.min(0), corners.max(0)])


def _corners(shape: ET.Element) -> Array:
    """Return the points (K, 2) of a polygon, a polyline or points."""
    pairs = [pair.split(",") for pair in shape.attrib["points"].split(";") if pair]
    return np.array(pairs, np.float64)


def _cvat_runs(shape: ET.Element, scale: Array, size: tuple[int, int]) -> Counts:
    """Return the mask of a polygon or a mask as run lengths; of other shapes none.

    The file's run lengths of a mask follow its rows.

    Args:
        scale: (2,) pixels of the video for each of the annotation. size: (w, h) of the video,
            (0, 0): unknown, no mask.
    """
    if size == (0, 0) or shape.tag not in ("polygon", "mask"):
        return NO_RUNS
    if shape.tag == "polygon":
        return polygon_runs([_corners(shape) * scale], size)
    left, top, width, height = _floats(shape, "left top width height").astype(int).tolist()
    box = np.array([[left, top], [left + width, top + height]]) * scale  # (2, 2) corners
    if (box[0] < -scale).any() or (box[1] > size + scale).any():
        raise ValueError(f"mask of {width}x{height} from {left}, {top} on, beyond the image")
    counts = np.array(shape.attrib["rle"].split(","), np.int64)
    if counts.min() < 0 or counts.sum() != width * height:
        raise ValueError(f"mask of {counts.sum()} pixels, expected {width}x{height}")
    mask = np.repeat(np.arange(len(counts)) % 2, counts).reshape(height, width)  # (H, W) 0, 1
    (x1, y1), (x2, y2) = box.round().astype(int).tolist()
    scaled = (max(x2 - x1, 1), max(y2 - y1, 1))
    crop = cv2.resize(mask.astype(np.uint8), scaled, interpolation=cv2.INTER_NEAREST)
    return crop_runs(crop > 0, (x1, y1), size)
