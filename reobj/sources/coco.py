"""Detections and tracks in JSON: COCO results and datasets (COCO-VID, TAO), OA-SLAM.

Image and category ids are resolved by the file itself, by a dataset JSON beside it, or as numbers
and names of images.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from reobj.files import load_json, shortened
from reobj.frame_lookup import frames_by_name
from reobj.sources.class_names import check_length
from reobj.sources.image_frames import frames_of_names, frames_of_numbers, original_name
from reobj.sources.masks import NO_RUNS, Counts, coco_runs, polygon_runs
from reobj.sources.recorded import CORNERS, SIZES, RecordedDetections, Source
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError

T = TypeVar("T")
D = TypeVar("D", bound="Dataset")
Id = int | str
Box = tuple[float, float, float, float]


class Image(msgspec.Struct):
    """An image of a dataset; `extra` holds its name before an export by Roboflow."""

    id: Id
    file_name: str | None = None
    width: float | None = None
    height: float | None = None
    frame_id: int | None = None  # COCO-VID
    frame_index: int | None = None  # TAO
    video_id: Id | None = None
    extra: Any = None

    @property
    def name(self) -> str | None:
        """Name of the image before its export."""
        extra = self.extra.get("name") if isinstance(self.extra, dict) else None
        return extra if isinstance(extra, str) else self.file_name

    @property
    def number(self) -> int | None:
        """Number of the frame."""
        return self.frame_index if self.frame_id is None else self.frame_id


class Named(msgspec.Struct):
    """A category or a video."""

    id: Id
    name: str


class Annotation(msgspec.Struct):
    """A box of an image."""

    image_id: Id
    category_id: Id
    bbox: Box
    bbox_mode: Literal[0, 1] = 1  # detectron2: 0 corners, 1 x, y, w, h; in px
    score: float = 1.0
    file_name: str | None = None
    track_id: float | None = None
    instance_id: float | None = None
    attributes: Any = None  # CVAT's hold the identity
    segmentation: Any = None
    iscrowd: Any = False
    ignore: Any = False

    @property
    def identity(self) -> int:
        """Identity, -1: none."""
        inner = self.attributes if isinstance(self.attributes, dict) else {}
        holders = (self.track_id, self.instance_id, inner.get("track_id"), inner.get("instance_id"))
        value = next((value for value in holders if value is not None), -1)
        if type(value) not in (int, float) or value % 1 or abs(value) >= 1 << 53:
            raise ReobjError(f"track_id {value!r:.40}, expected a whole number")
        return int(value)


class Dataset(msgspec.Struct):
    """Images and classes of a COCO dataset."""

    images: list[Image]
    categories: list[Named] = []
    videos: list[Named] | None = None


class Annotated(Dataset):
    """A dataset with boxes."""

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


def read_dataset(path: Path, data: Any, kind: type[D]) -> D:
    """Validate a COCO dataset."""
    dataset = converted(data, kind, path)
    for category in dataset.categories:
        check_length(category.name, f"{path}, categories")
    return dataset


def _beside(path: Path, entries: Sequence[Annotation]) -> tuple[str, Dataset | None]:
    """Find the dataset beside a file of results that has all ids of the results, and its name.

    Raises:
        ReobjError: several datasets match and disagree; or none does, and the results do not name
            their images.
    """
    ids = {entry.image_id for entry in entries}
    kinds = {entry.category_id for entry in entries}
    fault = ""
    matches: list[tuple[str, Dataset]] = []
    used: list[list[Any]] = []
    for other in sorted(path.parent.glob("*.json")):
        data = None
        with contextlib.suppress(ValueError, OSError):  # an invalid JSON file is no dataset
            data = load_json(other) if other != path else None
        if not isinstance(data, dict) or not data.get("images"):
            continue
        dataset = read_dataset(other, data, Dataset)
        images = {image.id: image.name for image in dataset.images}
        names = {category.id: category.name for category in dataset.categories}
        missing = [*ids.difference(images), *(kinds.difference(names) if names else ())]
        if missing:
            fault = f"id {missing[0]!r} is not in the dataset JSON {other.name} beside this file"
            continue
        matches.append((other.name, dataset))
        used.append([{i: images[i] for i in ids}, {k: names.get(k) for k in kinds}])
    if any(one != used[0] for one in used):
        both = " and ".join(name for name, _ in matches[:2])
        raise ReobjError(f"{path}: {both} beside it both have the ids of its images, for other "
                         "images or classes; keep only the dataset of this file")  # fmt: skip
    by_name = all(entry.file_name or isinstance(entry.image_id, str) for entry in entries)
    if fault and not matches and not by_name:
        raise ReobjError(f"{path}: {fault}; put its own dataset there, or remove the other")
    return matches[0] if matches else ("", None)


def read_coco(source: Source) -> RecordedDetections:
    """Read a COCO, COCO-VID or TAO dataset with its own annotations."""
    dataset = read_dataset(source.path, load_json(source.path), Annotated)
    if dataset.annotations is None:
        raise ReobjError(f"{source.path}: a dataset without annotations; give the file of COCO "
                         "results [{image_id, category_id, bbox, score}] beside it")  # fmt: skip
    return _read(source, dataset.annotations, dataset)


def read_coco_results(source: Source) -> RecordedDetections:
    """Read COCO results with ids of a dataset beside them, or with names or numbers of images."""
    entries = converted(load_json(source.path), list[Annotation], source.path)
    name, dataset = _beside(source.path, entries) if entries else ("", None)
    source.say(f"images and classes of {name} beside it" * bool(name))
    return _read(source, entries, dataset)


def _read(source: Source, entries: list[Annotation], dataset: Dataset | None) -> RecordedDetections:
    """Convert COCO annotations."""
    classes = _categories(source, entries, dataset)
    frame, size, looked = _images(source, entries, dataset)
    scale = source.scale(size, frame >= 0)
    masks = []
    identity = np.full(len(entries), -1)
    for at, (entry, ratio) in enumerate(zip(entries, scale[:, :2], strict=True)):
        try:
            masks.append(_mask(entry.segmentation, source.video.size, ratio))
            identity[at] = entry.identity
        except ReobjError as error:
            raise ReobjError(f"{source.path}, entry {at}: {error}") from error
    modes = {entry.bbox_mode for entry in entries}
    if len(modes) > 1:
        raise ReobjError(f"{source.path}: entries of several bbox_mode; expected one")
    return source.recorded(
        frame, np.array([entry.bbox for entry in entries]), classes,
        np.array([entry.score for entry in entries], np.float64), masks,
        form=CORNERS if 0 in modes else SIZES, scale=scale, identity=identity, looked=looked,
        ignored=np.array([bool(entry.iscrowd or entry.ignore) for entry in entries], bool),
    )  # fmt: skip


def _categories(
    source: Source, entries: Sequence[Annotation], dataset: Dataset | None
) -> tuple[IntArray, Sequence[str]]:
    """Return the class (N,) of every entry and the class names.

    Category ids are those of the dataset; else positions in the names that the user gives, from 0,
    or from 1 if only that is possible; else COCO's.
    """
    used = list(dict.fromkeys(entry.category_id for entry in entries))
    gaps = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # unused among COCO's category ids 1 to 90
    name_of: dict[Id, str] = dict(zip(sorted({*range(1, 91)} - {*gaps}), COCO_NAMES, strict=True))
    if source.names:
        from_1 = not {*used} <= {*range(len(source.names))} and 0 not in used
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
    size = np.zeros((len(entries), 2))
    ids = [entry.image_id for entry in entries]
    if dataset is not None:
        frame_of = _dataset_frames(dataset, source)
        image_of = {image.id: image for image in dataset.images}
        for at, i in enumerate(ids):
            if i not in image_of:
                raise ReobjError(
                    f"{source.path}, entry {at}: image_id {i!r} is not in the "
                    f"dataset, which has {shortened([*map(repr, image_of)])}"
                )
            size[at] = image_of[i].width or 0, image_of[i].height or 0
        listed = np.unique(np.array(list(frame_of.values()), np.int64))
        return np.array([frame_of[i] for i in ids], np.int64), size, listed[listed >= 0]
    if source.video.names or not all(isinstance(i, int) for i in ids):
        names = [entry.file_name or str(entry.image_id) for entry in entries]
        return frames_of_names(names, source, 0), size, None
    numbers = np.array(ids, np.float64)
    if (np.abs(numbers) >= 1 << 53).any():
        raise ReobjError(f"{source.path}: image_id {numbers.max():.0f}, expected a frame number")
    source.say("no dataset JSON beside it: image_id is taken as the frame number" * bool(ids))
    return frames_of_numbers(numbers.astype(np.int64), source, 0), size, None


def _dataset_frames(dataset: Dataset, source: Source) -> dict[Id, int]:
    """Return the frame of every image of a dataset, -1: none.

    By file name; else by `frame_id` (COCO-VID) or `frame_index` (TAO); else by the numbers in the
    file names; in the order of the list only if the user says so.
    """
    video = source.video
    images = _of_one_video(dataset, source)
    names = [original_name(image.name or "") for image in images]
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
    ids = {image.video_id for image in images}
    if len(ids) < 2:
        return images
    name_of = {video.id: video.name for video in dataset.videos or ()}
    stem = Path(source.video.source).stem
    same = [i for i in ids if i is not None and Path(name_of.get(i, str(i))).stem == stem]
    if len(same) == 1:
        kept = [image for image in images if image.video_id == same[0]]
        source.say(f"{len(images) - len(kept)} images of other videos left out")
        return kept
    if source.video.names and any(image.file_name for image in images):
        return images
    some = shortened(sorted(map(str, name_of.values())))
    raise ReobjError(f"{source.path}: images of {len(ids)} videos ({some}), none of them called "
                     f"{stem}; keep one, or rename it")  # fmt: skip


def _mask(mask: Any, size: tuple[int, int], scale: Array) -> Counts:
    """Read a COCO segmentation as run lengths: RLE (compressed or not), polygons or none."""
    if not mask or size == (0, 0):
        return NO_RUNS
    try:
        if not isinstance(mask, dict):
            rings = [np.reshape(np.asarray(ring, np.float64), (-1, 2)) * scale for ring in mask]
            return polygon_runs([ring.ravel().tolist() for ring in rings], size)
        counts = mask["counts"]
        if tuple(mask["size"]) != size[::-1]:
            raise ReobjError(f"mask of (h, w) {mask['size']} in a video of {size[::-1]}")
        return coco_runs(counts) if isinstance(counts, str) else np.array(counts, np.uint32).ravel()
    except ReobjError:
        raise
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        text = f"segmentation cannot be read ({error!r:.80})"
        raise ReobjError(f"{text}; expected polygons or RLE") from error


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
