"""Detections and tracks in JSON: COCO results and datasets, OA-SLAM.

Start at `read_coco`. Image and category ids are resolved by the file itself, by a dataset JSON
beside it, or as numbers and names of images.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reobj.files import load_json, shortened
from reobj.frame_lookup import frames_by_name
from reobj.sources.class_names import check_length
from reobj.sources.image_frames import (
    first_number,
    frames_of_names,
    frames_of_numbers,
    last_numbers,
)
from reobj.sources.masks import NO_RUNS, Counts, coco_runs, polygon_runs
from reobj.sources.recorded import RecordedDetections, scale_to
from reobj.sources.video import Video
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError

Id = int | str


@dataclass(frozen=True, slots=True)
class Dataset:
    """Images and categories of a valid COCO dataset.

    Attributes:
        path: of the file. images: by id. categories: names by id. videos: names by id.
        entries: annotations, or None.
    """

    path: Path
    images: dict[Id, dict[str, Any]] = field(default_factory=dict)
    categories: dict[Id, str] = field(default_factory=dict)
    videos: dict[Id, str] = field(default_factory=dict)
    entries: list[Any] | None = None


def _objects(path: Path, data: Mapping[str, Any], key: str, expected: str) -> list[dict[str, Any]]:
    """Return the JSON objects in the list `key`, each with a valid id; an error names the entry."""
    entries = data.get(key) or []
    if not isinstance(entries, list):
        raise ReobjError(f"{path}: {key} is {entries!r:.40}, expected a list of {expected}")
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict) or not _is_id(entry.get("id")):
            raise ReobjError(f"{path}, {key}[{i}]: {entry!r:.40}, expected {expected}")
    return entries


def _is_id(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, int) and not isinstance(value, bool))


def _is_side(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and 0 < value < 1 << 31)


def parse_dataset(path: Path, data: Mapping[str, Any]) -> Dataset:
    """Validate the fields of a COCO dataset that are used.

    Raises:
        ReobjError: an invalid entry, and what was expected.
    """
    expected = "{id, file_name, width, height}"
    images = _objects(path, data, "images", expected)
    for i, image in enumerate(images):
        name = image.get("file_name")
        sides = (image.get("width"), image.get("height"))
        number = image.get("frame_id", image.get("frame_index", 0))
        if not isinstance(name, str | None) or not all(map(_is_side, sides)):
            raise ReobjError(f"{path}, images[{i}]: {image!r:.80}, expected {expected}")
        if not isinstance(number, int) or abs(number) >= 1 << 53:
            raise ReobjError(f"{path}, images[{i}]: frame_id {number!r:.40}, expected a number")
    categories = _objects(path, data, "categories", "{id, name}")
    for i, category in enumerate(categories):
        if not isinstance(category.get("name"), str):
            raise ReobjError(f"{path}, categories[{i}]: a category without a name, expected "
                             "{id, name}")  # fmt: skip
        check_length(category["name"], f"{path}, categories[{i}]")
    videos = _objects(path, data, "videos", "{id, name}")
    return Dataset(
        path, {image["id"]: image for image in images}, {c["id"]: c["name"] for c in categories},
        {v["id"]: str(v.get("name", v["id"])) for v in videos}, data.get("annotations"),
    )  # fmt: skip


def dataset_of(path: Path, data: Any) -> Dataset | None:
    """Return the dataset in the content of a JSON file, or the matching one beside the file."""
    if isinstance(data, dict):
        return parse_dataset(path, data) if "images" in data else None
    entries = [e for e in data if isinstance(e, dict)] if isinstance(data, list) else []
    entries = [e for e in entries if _is_id(e.get("image_id"))]
    return _beside(path, entries) if entries else None


def _beside(path: Path, entries: Sequence[Mapping[str, Any]]) -> Dataset | None:
    """Find the dataset beside a file of results that has all ids of the results.

    Raises:
        ReobjError: several datasets match and disagree; or none does, and the results do not name
            their images.
    """
    datasets = list[Dataset]()
    faults = list[ReobjError]()
    for other in sorted(path.parent.glob("*.json")):
        data = None
        with contextlib.suppress(ValueError, OSError):  # an invalid JSON file is no dataset
            data = load_json(other) if other != path else None
        if isinstance(data, dict) and data.get("images"):
            try:
                datasets.append(parse_dataset(other, data))
            except ReobjError as error:
                faults.append(error)
    ids = {entry["image_id"] for entry in entries}
    kinds = {e["category_id"] for e in entries if _is_id(e.get("category_id"))}
    matches = [d for d in datasets if ids <= d.images.keys()]
    matches = [d for d in matches if not d.categories or kinds <= d.categories.keys()]
    if len(matches) > 1:
        names = [
            ([d.images[i].get("file_name") for i in sorted(ids, key=str)],
             [d.categories.get(k) for k in sorted(kinds, key=str)])
            for d in matches
        ]  # fmt: skip
        if any(other_names != names[0] for other_names in names[1:]):
            both = " and ".join(d.path.name for d in matches[:2])
            raise ReobjError(f"{path}: {both} beside it both have the ids of its images, for other "
                             "images or classes; keep only the dataset of this file")  # fmt: skip
    if matches or all("file_name" in e or isinstance(e["image_id"], str) for e in entries):
        return matches[0] if matches else None
    if faults:
        raise faults[0]
    if not datasets:
        return None
    missing: list[Any] = sorted(ids - datasets[0].images.keys(), key=str)
    fault = f"image_id {missing[0]}" if missing else f"category_id {min(kinds, key=str)}"
    raise ReobjError(f"{path}: {fault} is not in the dataset JSON beside this file "
                     f"({shortened([d.path.name for d in datasets])}); put the dataset of this "
                     "file there, or remove them")  # fmt: skip


def read_coco(
    path: Path, data: Any, names: Sequence[str], video: Video, first: str = ""
) -> RecordedDetections:
    """Read COCO results, a COCO or COCO-VID dataset, or OA-SLAM's file.

    Args:
        data: content of the file.
        names: class names by category id from 0, (): not given.
        first: number of the first frame, "": inferred.
    """
    entries = data
    dataset = dataset_of(path, data)
    if dataset is not None and dataset.path == path:
        entries = dataset.entries
    if not isinstance(entries, list):
        raise ReobjError(f"{path}: expected COCO results: [{{image_id, category_id, bbox, score}}]")
    if not all(isinstance(entry, dict) for entry in entries):
        at = next(i for i, entry in enumerate(entries) if not isinstance(entry, dict))
        raise ReobjError(f"{path}, entry {at}: {entries[at]!r:.40}, expected an object such as "
                         "{image_id, category_id, bbox, score}")  # fmt: skip
    keys = entries[0].keys() if entries else ()
    if "detections" in keys:
        return _read_oa_slam(path, entries, names, video, first)
    return _read_coco(path, entries, dataset, names, video, first)


def _read_coco(
    path: Path,
    entries: Sequence[Mapping[str, Any]],
    dataset: Dataset | None,
    names: Sequence[str],
    video: Video,
    first: str,
) -> RecordedDetections:
    """Read COCO entries with ids of a dataset, or with names or numbers of images."""
    for at, entry in enumerate(entries):
        fields = {key: entry.get(key) for key in ("image_id", "category_id", "bbox")}
        has_ids = _is_id(fields["image_id"]) and _is_id(fields["category_id"])
        if not has_ids or not isinstance(fields["bbox"], list) or len(fields["bbox"]) != 4:
            raise ReobjError(f"{path}, entry {at}: {fields}, expected two ids and a bbox of 4")
    messages: list[str] = []
    class_id, class_names = _categories(path, entries, dataset, names, messages)
    frame, size, looked = _images(path, entries, dataset, video, first, messages)
    box, score = _box_and_score(path, entries)
    scale = scale_to(video.size, size, frame >= 0, str(path), messages)
    masks = [
        _mask(entry.get("segmentation"), video.size, ratio, f"{path}, entry {at}")
        for at, (entry, ratio) in enumerate(zip(entries, scale[:, :2], strict=True))
    ]
    return RecordedDetections(
        frame, np.hstack([box[:, :2], box[:, :2] + box[:, 2:]]) * scale,
        score, class_id, masks,
        class_names, video.size, video.working_size, np.arange(len(entries)), "entry", messages,
        np.array([_identity(entry, f"{path}, entry {at}") for at, entry in enumerate(entries)],
                 np.int64),
        looked,
    )  # fmt: skip


def _box_and_score(path: Path, entries: Sequence[Mapping[str, Any]]) -> tuple[Array, Array]:
    """Return the boxes (N, 4) x, y, w, h and scores (N,); an error names the entry."""
    rows = []
    for at, entry in enumerate(entries):
        row = [*entry["bbox"], entry.get("score", 1.0)]
        if any(isinstance(v, bool) or not isinstance(v, int | float) for v in row):
            fields = {key: entry.get(key) for key in ("bbox", "score")}
            raise ReobjError(f"{path}, entry {at}: {fields!r:.80}, expected numbers")
        rows.append(row)
    values = np.array(rows, np.float64).reshape(-1, 5)
    return values[:, :4], values[:, 4]


def _identity(entry: Mapping[str, Any], where: str) -> int:
    """Return track_id or instance_id, also from CVAT's attributes; -1: none."""
    attributes = entry.get("attributes")
    for holder in (entry, attributes if isinstance(attributes, dict) else {}):
        for key in ("track_id", "instance_id"):
            if (value := holder.get(key)) is not None:
                if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= 1 << 53:
                    raise ReobjError(f"{where}: {key} {value!r:.40}, expected a whole number")
                return value
    return -1


def _categories(
    path: Path,
    entries: Sequence[Mapping[str, Any]],
    dataset: Dataset | None,
    names: Sequence[str],
    messages: list[str],
) -> tuple[IntArray, tuple[str, ...]]:
    """Return the class (N,) of every entry and the class names.

    Category ids are those of the dataset; else positions in `names` from 0, or from 1 if only that
    is possible; else COCO's.
    """
    used = list(dict.fromkeys(entry["category_id"] for entry in entries))
    gaps = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # unused among COCO's category ids 1 to 90
    coco_ids = (i for i in range(1, 91) if i not in gaps)
    name_of: dict[Id, str] = dict(zip(coco_ids, COCO_NAMES, strict=True))
    if names:
        name_of = dict(enumerate(names))
        text = "category ids are taken as positions in the class names, "
        if used and not set(used) <= name_of.keys() and set(used) <= set(range(1, len(names) + 1)):
            name_of = dict(enumerate(names, 1))
            messages.append(text + "from 1")
        elif used and 0 not in used:
            messages.append(text + "from 0")
    elif dataset is not None and dataset.categories:
        name_of = dict(dataset.categories)
    elif used:
        messages.append(
            "no categories in it or beside it: category_id is taken as COCO's (1 to 90)"
        )
    for at, entry in enumerate(entries):
        if entry["category_id"] not in name_of:
            raise ReobjError(f"{path}, entry {at}: category_id {entry['category_id']} is unknown: "
                             "put the dataset JSON beside this file, or give a file of names (ids "
                             "from 0) with --set detect.class_names=FILE")  # fmt: skip
    classes = list(dict.fromkeys(name_of.values()))
    index = {key: classes.index(name) for key, name in name_of.items()}
    return np.array([index[e["category_id"]] for e in entries], np.int64), tuple(classes)


def _images(
    path: Path,
    entries: Sequence[Mapping[str, Any]],
    dataset: Dataset | None,
    video: Video,
    first: str,
    messages: list[str],
) -> tuple[IntArray, Array, IntArray | None]:
    """Find the image of every entry.

    Returns:
        frame (N,) of every entry, -1: none; size (N, 2) of its image, 0: unknown; and the frames
        listed in the dataset, ascending, None without a dataset.
    """
    size = np.zeros((len(entries), 2))
    ids = [entry["image_id"] for entry in entries]
    if dataset is not None:
        frame_of, text = _dataset_frames(dataset, video, first)
        messages += [text] if text else []
        for at, i in enumerate(ids):
            if i not in dataset.images:
                raise ReobjError(f"{path}, entry {at}: image_id {i} is not in the dataset JSON")
            image = dataset.images[i]
            size[at] = image.get("width") or 0, image.get("height") or 0
        listed = np.unique(np.array(list(frame_of.values()), np.int64))
        return np.array([frame_of[i] for i in ids], np.int64), size, listed[listed >= 0]
    names = [entry.get("file_name") for entry in entries]
    if not names or not all(isinstance(name, str) for name in names):
        names = [str(i) for i in ids]
    where = f"{path}, image_id"
    if video.names or not all(isinstance(i, int) for i in ids):
        frame, text = frames_of_names([str(n) for n in names], video, where, first, 0)
        messages += [text] if text else []
        return frame, size, None
    if any(abs(i) >= 1 << 53 for i in ids):
        raise ReobjError(f"{where}: {max(ids, key=abs)}, expected a frame number")
    frame = np.array(ids, np.int64)
    frame, text = frames_of_numbers(frame, video.frame_count, first, 0, False, where)
    messages.append(text or "no dataset JSON beside it: image_id is taken as the 0-based frame")
    return frame, size, None


def _dataset_frames(dataset: Dataset, video: Video, first: str) -> tuple[dict[Id, int], str]:
    """Return the frame of every image of a dataset, -1: none, and a message about the rule.

    By file name; else by `frame_id` (COCO-VID) or `frame_index` (TAO); else by the numbers in the
    file names; else in order, if there is an image for every frame.
    """
    images = list(dataset.images.values())
    where = str(dataset.path)
    note = ""
    ids = {image.get("video_id") for image in images} & dataset.videos.keys()
    if len(ids) > 1:
        stem = Path(video.source).stem
        same_name = [
            i for i, name in dataset.videos.items() if i in ids and Path(name).stem == stem
        ]
        named = video.names and any("file_name" in image for image in images)
        if len(same_name) != 1 and not named:
            some = shortened(sorted(dataset.videos.values()))
            raise ReobjError(f"{where}: {len(ids)} videos ({some}), none of them called {stem}; "
                             "keep one, or rename it")  # fmt: skip
        if len(same_name) == 1:
            kept = [image for image in images if image.get("video_id") == same_name[0]]
            note = f"{len(images) - len(kept)} images of other videos left out"
            images = kept
    frame, text = _image_frames(images, video, first, where)
    frame_of: dict[Id, int] = dict.fromkeys(dataset.images, -1)
    frame_of |= dict(zip((image["id"] for image in images), frame.tolist(), strict=True))
    return frame_of, "; ".join(filter(None, (note, text)))


def _image_frames(
    images: Sequence[Mapping[str, Any]], video: Video, first: str, where: str
) -> tuple[IntArray, str]:
    """Find the frames of the images (N,) of a dataset that belong to one video."""
    names = [image.get("file_name") for image in images]
    named = bool(names) and all(isinstance(name, str) for name in names)
    if named and video.names:
        distinct = list(dict.fromkeys(map(str, names)))
        frame, rule = frames_by_name(distinct, video.files or video.names, where)
        if rule:
            frame_of = dict(zip(distinct, frame.tolist(), strict=True))
            return np.array([frame_of[str(name)] for name in names], np.int64), ""
    for key in ("frame_id", "frame_index"):
        if images and all(key in image for image in images):
            number = np.array([image[key] for image in images], np.int64)
            return frames_of_numbers(number, video.frame_count, first, 0, True, where)
    every = len(images) == video.frame_count
    number = last_numbers(list(map(str, names))) if named else np.empty(0, np.int64)
    counted = named and number.min() >= 0 and len(np.unique(number)) == len(number)
    if every and not first and (not counted or first_number(number, 0) is None):
        text = (
            "" if not counted else "as many images as frames: taken in the order of their numbers"
        )
        return (number.argsort().argsort() if counted else np.arange(len(images))), text
    if counted:
        return frames_of_names(list(map(str, names)), video, where, first, None, True)
    if not images:
        return np.empty(0, np.int64), ""
    raise ReobjError(
        f"{where}: {len(images)} images, whose names have no numbers, for {video.frame_count} "
        "frames; expected names of the images, frame_id, or an image for every frame"
    )


def _mask(mask: Any, size: tuple[int, int], scale: Array, where: str) -> Counts:
    """Read a COCO segmentation as run lengths: RLE (compressed or not), polygons or none."""
    if not mask:
        return NO_RUNS
    try:
        if not isinstance(mask, dict):
            rings = [np.reshape(np.asarray(ring, np.float64), (-1, 2)) * scale for ring in mask]
            return polygon_runs([ring.ravel().tolist() for ring in rings], size)
        counts = mask["counts"]
        if tuple(mask["size"]) != size[::-1]:
            raise ReobjError(f"{where}: mask of (h, w) {mask['size']} in a video of {size[::-1]}")
        return coco_runs(counts) if isinstance(counts, str) else np.array(counts, np.uint32).ravel()
    except ReobjError:
        raise
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        text = f"segmentation cannot be read ({error!r:.80})"
        raise ReobjError(f"{where}: {text}; expected polygons or RLE") from error


def _read_oa_slam(
    path: Path, entries: Sequence[Mapping[str, Any]], names: Sequence[str], video: Video, first: str
) -> RecordedDetections:
    """Read the file of OA-SLAM and VOOM: one entry per image, boxes as corners, classes from 0."""
    rows = list[Mapping[str, Any]]()
    images = list[str]()
    for at, entry in enumerate(entries):
        name = entry.get("file_name")
        detections = entry.get("detections")
        valid = isinstance(name, str) and isinstance(detections, list)
        if not valid or not all(isinstance(d, dict) and _is_row(d) for d in detections or ()):
            expected = "expected {file_name, detections: [{category_id, detection_score, bbox}]}"
            raise ReobjError(f"{path}, entry {at}: {entry!r:.80}, {expected}")
        rows += detections or []
        images += [str(name)] * len(detections or ())
    distinct = list(dict.fromkeys(str(entry["file_name"]) for entry in entries))
    frame, text = frames_of_names(distinct, video, str(path), first, None, True)
    frame_of = dict(zip(distinct, frame.tolist(), strict=True))
    count = len(rows)
    return RecordedDetections(
        np.array([frame_of[name] for name in images], np.int64),
        np.array([row["bbox"] for row in rows], np.float64).reshape(-1, 4),
        np.array([row.get("detection_score", 1.0) for row in rows], np.float64),
        np.array([row["category_id"] for row in rows], np.int64), [NO_RUNS] * count,
        tuple(names or COCO_NAMES), video.size, video.working_size, np.arange(count), "detection",
        [text] if text else [],
    )  # fmt: skip


def _is_row(row: Mapping[str, Any]) -> bool:
    box = row.get("bbox")
    kind = row.get("category_id")
    whole = isinstance(kind, int) and 0 <= kind < 1 << 31
    return whole and isinstance(box, list) and len(box) == 4


def image_size_of(dataset: Dataset | None) -> tuple[int, int] | None:
    """Return the (w, h) common to all images of a dataset; None where they differ or lack it."""
    images: Iterable[Mapping[str, Any]] = dataset.images.values() if dataset else ()
    sizes = {(image.get("width"), image.get("height")) for image in images}
    if len(sizes) != 1:
        return None
    width, height = sizes.pop()
    return (int(width), int(height)) if width and height else None


def image_names_of(path: Path, data: Any) -> list[str]:
    """List the image names in a JSON file's dataset or entries; [] where there are none."""
    dataset = dataset_of(path, data)
    entries: Any = dataset.images.values() if dataset else data if isinstance(data, list) else ()
    names = [e.get("file_name") for e in entries if isinstance(e, dict)]
    return [name for name in names if isinstance(name, str)]
