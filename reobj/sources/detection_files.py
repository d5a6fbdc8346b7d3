"""Recorded detections and tracks of other tools: read MOT, CSV, COCO, CVAT, and our own npz.

Start at `read_detections`, `read_tracks` and `read_mot_rows`. Every reader makes a
`RecordedDetections`, which is then checked in one place: what cannot be meant is an error that
names the line, single rows that are of no use are dropped and counted in its messages.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import math
import re
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from reobj.files import (
    check_unpacked,
    did_you_mean,
    load_json,
    load_npz,
    read_lines,
    shortened,
)
from reobj.sources.looked import frames_looked_at, looked_message
from reobj.sources.masks import NO_RUNS, Counts, coco_runs, polygon_runs
from reobj.sources.recorded import RecordedDetections, read_npz
from reobj.sources.video import Video
from reobj.types import (
    CLASS_MAX,
    COCO_NAMES,
    COORDINATE_MAX,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    Tracks,
    box_iou,
    option,
    printable,
    rows_by,
)


@dataclass(frozen=True, slots=True)
class DetectConfig:
    """Choose the detector and which detections are used, recorded ones included."""

    model: str = option(
        "deimv2-n",
        "detector: a name of `models`, fast (deimv2-femto), or a .onnx file",
        "--detector",
    )
    tiles: str = option(
        "",
        "detect in so many overlapping tiles too, COLUMNSxROWS such as 2x2: finds smaller things, "
        "for 1 + COLUMNS * ROWS times the time",
        "--detector-tiles",
    )
    min_score: float = option(0.1, "drop detections with a lower score (ByteTrack: .1)")
    classes: str = option("", "comma-separated class names to keep (default: all)", "--classes")
    class_names: str = option("", "text file, one class name a line, where they are not COCO's")
    max_detections: int = option(100, "most detections that are kept in a frame, best scores first")


def load_class_names(path: str | Path) -> tuple[str, ...]:
    """Read class names, one a line in the order of their ids; empty lines do not count."""
    names = tuple(filter(None, (line.strip() for line in read_lines(Path(path)))))
    if len(names) > CLASS_MAX:
        raise ReobjError(f"{path}: {len(names)} class names, at most {CLASS_MAX} are taken")
    return names


def unnamed_class(class_id: int, count: int) -> str:
    """Write the message about a class id beyond the class names."""
    return (f"class {class_id}, but there are only {count} class names: give a file of names with "
            "--set detect.class_names=FILE")  # fmt: skip


def class_filter(wanted: str, names: Sequence[str]) -> IntArray:
    """Return the ids of comma-separated class names, whatever their case.

    Raises:
        ReobjError: a name that is not among `names`.
    """
    known = {name.lower(): i for i, name in enumerate(names)}
    chosen = [name.strip().lower().replace("_", " ") for name in wanted.split(",") if name.strip()]
    unknown = [name for name in chosen if name not in known]
    if unknown:
        close = did_you_mean(unknown[0], known) or f" among {', '.join(names)}"
        raise ReobjError(f"--classes: no class {', '.join(unknown)}{close}")
    return np.array([known[name] for name in chosen], np.int64)


def read_detections(
    path: str | Path, video: Video, config: DetectConfig | None = None
) -> RecordedDetections:
    """Read recorded detections of a video: MOT txt, CSV with a header, COCO JSON or our npz.

    Args:
        path: the file; boxes in px of the source, frame numbers of the source (MOT: from 1).
        config: min_score, classes, class_names and max_detections apply.
    Raises:
        ReobjError: names the file, the line and what was expected there.
    """
    path, config = Path(path), config or DetectConfig()
    found = _read(path, video, config)
    _note_looked(found, video.frame_count)
    _check(found, path, config, video.frame_count)
    return found


def _read(path: Path, video: Video, config: DetectConfig) -> RecordedDetections:
    """Read a file of any format as it is, unchecked."""
    if not path.is_file():
        raise ReobjError(f"{path}: no such file of detections")
    names = load_class_names(config.class_names) if config.class_names else ()
    try:
        if path.suffix.lower() == ".npz":
            found, _ = read_npz(path, video.size, video.working_size)
        else:
            read = _read_coco if path.suffix.lower() == ".json" else _read_table
            found = read(path, names, video)
    except ReobjError:
        raise
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise ReobjError(f"{path}: an entry is not as expected: {error!r}") from error
    return found


def _note_looked(found: RecordedDetections, frame_count: int) -> None:
    """Note which frames the detector was run on: those that the file lists, else inferred."""
    listed = found.looked is not None
    if found.looked is None:
        found.looked = frames_looked_at(found.frame, frame_count)
    elif not 0 < len(found.looked) < (frame_count or sys.maxsize):
        found.looked = None
    if found.looked is not None:
        found.messages.append(looked_message(found.looked, listed))


def read_mot_rows(path: Path) -> Array:
    """Read a MOTChallenge file as numbers.

    Returns:
        (N, 6 to 10) frame (from 1), id, left, top, w, h[, score[, class or x[, y[, z]]]]; of an
        empty file (0, 10).
    Raises:
        ReobjError: names the line that has another number of columns or is no number.
    """
    columns, cells, lines, is_mot = _table_cells(path)
    if not is_mot:
        raise ReobjError(f"{path}, line 1: no MOTChallenge file; expected frame,id,left,top,w,h")
    texts = [[row[i] for row in cells] for i in range(len(columns))]
    rows = np.stack([_column(column, lines, path) for column in texts], 1)  # (N, 6 to 10)
    for at in (0, 1):
        _check_whole(rows[:, at], texts[at], lines, path, columns[at])
    if (far := (np.abs(rows[:, 2:6]) > COORDINATE_MAX).any(1)).any():
        box, line = rows[far][0, 2:6], lines[far][0]
        raise ReobjError(f"{path}, line {line}: box {box}, expected at most {COORDINATE_MAX:g} px")
    return rows


MOT_COLUMNS = ("frame", "id", "x1", "y1", "w", "h", "score", "class", "", "")
NUMBERS = ("frame", "time", "id", "x1", "y1", "x2", "y2", "w", "h", "score")
ROLES = (*NUMBERS, "class")  # of columns; those before hold numbers


WHOLE_MAX = 2.0**53  # of frame and identity; beyond, a float skips whole numbers


def _read_table(path: Path, names: Sequence[str], video: Video) -> RecordedDetections:
    """Read MOT rows (frame from 1, id, left, top, w, h[, score[, class]]), or CSV with a header."""
    columns, cells, lines, is_mot = _table_cells(path)
    texts = {role: [row[i] for row in cells] for i, role in enumerate(columns)}
    column = {role: _column(texts[role], lines, path) for role in NUMBERS if role in texts}
    if is_mot and (column["id"] % 1 != 0).any():
        raise ReobjError(f"{path}: the second column is no identity. If this is no MOT file: CSV "
                         "needs a header such as frame,x1,y1,x2,y2,score,class")  # fmt: skip
    for role in ("frame", "id"):
        if role in column:
            _check_whole(column[role], texts[role], lines, path, role)
    if "x2" not in column:
        column["x2"], column["y2"] = column["x1"] + column["w"], column["y1"] + column["h"]
    xyxy = np.stack([column[role] for role in ("x1", "y1", "x2", "y2")], 1)  # (N, 4)
    count = len(lines)
    try:
        class_id, names, new = _table_classes(texts.get("class", [""] * count), is_mot, names)
    except (OverflowError, ReobjError) as error:
        raise ReobjError(f"{path}: {error}") from error
    messages = (
        [f"{len(new)} class names not in the list: {printable(shortened(new))}"] if new else []
    )
    if "frame" not in column:
        column["frame"] = _frames_at(column["time"], video, path)
    frame = column["frame"].astype(np.int64) - is_mot
    if frame.min(initial=0) == -1 and is_mot:
        frame += 1
        messages.append("MOT frames start at 1, this file has a frame 0: taken as 0-based")
    return RecordedDetections(
        frame, xyxy, column.get("score", np.ones(count)), class_id, [NO_RUNS] * count, tuple(names),
        video.size, video.working_size, lines, "line", messages,
        column["id"].astype(np.int64) if "id" in column else np.empty(0, np.int64),
    )  # fmt: skip


def _table_cells(path: Path) -> tuple[tuple[str, ...], list[list[str]], IntArray, bool]:
    """Split a table into cells.

    Returns:
        What each column holds (a name of ROLES), the N rows of cells, the lines they stand on (N,),
        and whether it is MOT (no header). Other columns of a header are left out.
    """
    lines_read = read_lines(path)
    first = next((line for line in lines_read if line.strip()), "")
    if "," not in first and len(first.split()) in range(6, 11):  # MOT with spaces
        lines_read = [",".join(line.split()) for line in lines_read]
    reader = csv.reader(lines_read, strict=True)
    columns: tuple[str, ...] = ()
    expected, is_mot = "6 to 10 (frame, id, left, top, w, h, score)", False
    kept, lines = list[list[str]](), list[int]()
    used: list[int] = []  # numbers of the columns that mean something here
    try:
        for cells in filter(None, reader):
            if not columns:
                is_mot = cells[0].strip()[:1] in "+-.0123456789"
                columns = MOT_COLUMNS[: len(cells)] if is_mot else _csv_columns(cells, path)
                used = [i for i, role in enumerate(columns) if is_mot or role in ROLES]
                if not is_mot or len(cells) in range(6, 11):
                    expected = str(len(columns))
                if not is_mot:
                    continue
            if str(len(cells)) != expected:
                where = f"{path}, line {reader.line_num}"
                raise ReobjError(f"{where}: {len(cells)} columns, expected {expected}")
            kept.append([cells[i].strip() for i in used])
            lines.append(reader.line_num)
    except csv.Error as error:
        raise ReobjError(f"{path}, line {reader.line_num}: no table ({error})") from error
    is_mot, columns = is_mot or not columns, columns or MOT_COLUMNS
    roles = tuple(columns[i] for i in used) if used else columns
    return roles, kept, np.array(lines, np.int64), is_mot


def _frames_at(time_s: Array, video: Video, path: Path) -> Array:
    """Find the frames at times (N,) in s, -1 where none is within half a frame interval."""
    if video.times_s is None:
        raise ReobjError(f"{path}, line 1: no column frame; time stamps are of use only where the "
                         "names of the images are time stamps too")  # fmt: skip
    half = 0.5 * float(np.median(np.diff(video.times_s))) if len(video.times_s) > 1 else 0.0
    after = np.searchsorted(video.times_s, time_s).clip(max=len(video.times_s) - 1)  # (N,)
    pair = np.stack([(after - 1).clip(0), after], 1)  # (N, 2)
    offset = np.abs(video.times_s[pair] - time_s[:, None])
    nearest = np.take_along_axis(pair, offset.argmin(1)[:, None], 1)[:, 0]
    return np.where(offset.min(1) <= half, nearest, -1).astype(np.float64)


def recorded_times(path: Path) -> Array | None:
    """Return the distinct times, ascending, of a CSV with a column of them and none of frames."""
    if path.suffix.lower() in (".npz", ".json", ".xml", ".zip"):
        return None
    columns, cells, lines, _ = _table_cells(path)
    if "frame" in columns or "time" not in columns:
        return None
    at = columns.index("time")
    return np.unique(_column([row[at] for row in cells], lines, path))


def image_size(path: Path) -> tuple[int, int] | None:
    """Return the (w, h) of the images that a file of detections was made for, if it says so."""
    data: Any = {}
    if path.suffix.lower() == ".npz":
        data = load_npz(path)[0].get("image_size", ())
    elif path.suffix.lower() == ".json":
        images = (_dataset(path, load_json(path)) or {}).get("images") or [{}]
        first = images[0]
        data = [first[key] for key in ("width", "height") if key in first]
    return (int(data[0]), int(data[1])) if len(data) == 2 else None


def image_names(path: Path) -> list[str]:
    """List the images of a COCO dataset, in the file or beside it; [] of any other file."""
    if path.suffix.lower() != ".json":
        return []
    images = (_dataset(path, load_json(path)) or {}).get("images", ())
    return [Path(image["file_name"]).name for image in images if "file_name" in image]


CSV_ALIASES = {"x": "x1", "y": "y1", "width": "w", "height": "h", "confidence": "score",
               "conf": "score", "class_id": "class", "class_name": "class",
               "coco80_class": "class", "timestamp": "time", "time_s": "time"}  # fmt: skip


def _csv_columns(cells: Sequence[str], path: Path) -> tuple[str, ...]:
    """Name the columns by a header, without its remarks in () and after ;."""
    header = re.sub(r"\(.*?\)", "", ",".join(cells)).split(";")[0].lower()
    plain = [name.strip() for name in header.lstrip("# ").split(",")]
    columns = tuple(CSV_ALIASES.get(name, name) for name in plain)
    ends = ("w", "h") if "w" in columns else ("x2", "y2")
    when = "time" if "time" in columns else "frame"
    missing = [role for role in (when, "x1", "y1", *ends) if role not in columns]
    if missing:
        raise ReobjError(f"{path}, line 1: no column {', '.join(missing)} in the header {header}: "
                         "expected one such as frame,x1,y1,x2,y2,score,class")  # fmt: skip
    return columns


def _column(cells: Sequence[str], lines: IntArray, path: Path) -> Array:
    """Convert a column to finite numbers (N,); an error names the line."""
    with contextlib.suppress(ValueError):
        values = np.array(cells, np.float64)
        if np.isfinite(values).all():
            return values
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        with contextlib.suppress(ValueError):
            values[i] = float(cell)
        if not math.isfinite(values[i]):
            raise ReobjError(f"{path}, line {lines[i]}: {cell!r} is no finite number")
    return values


def _check_whole(
    values: Array, cells: Sequence[str], lines: IntArray, path: Path, role: str
) -> None:
    """Refuse a column of numbers (N,) that are not whole, or beyond WHOLE_MAX."""
    bad = (np.abs(values) > WHOLE_MAX) | (values % 1 != 0)
    if bad.any():
        row = int(bad.argmax())
        where = f"{path}, line {lines[row]}: {role}"
        raise ReobjError(f"{where} {cells[row]}, expected a whole number")


def _table_classes(
    cells: Sequence[str], is_mot: bool, names: Sequence[str]
) -> tuple[IntArray, Sequence[str], list[str]]:
    """Read the column of classes: ids or names; in MOT ids from 1, and -1 for "no class".

    Returns:
        Class ids (N,) from 0, class names, and those of them that were not among `names`.
    """
    ids = np.array([int(cell) if cell.isdigit() else -1 for cell in cells], np.int64)
    if not any(cells) or (is_mot and ids.min() < 1):
        return np.zeros_like(ids), ("object",), []
    if is_mot and ids.max() > CLASS_MAX:
        raise ReobjError(f"class number {ids.max()}, expected at most {CLASS_MAX}")
    if is_mot:
        return ids - 1, [*names, *(f"class {i + 1}" for i in range(len(names), ids.max()))], []
    names = names or COCO_NAMES
    if ids.min() >= 0:
        return ids, names, []
    new = sorted(set(cells) - set(names))
    index = {name: i for i, name in enumerate([*names, *new])}
    return np.array([index[cell] for cell in cells], np.int64), list(index), new


def _read_coco(path: Path, names: Sequence[str], video: Video) -> RecordedDetections:
    """Read COCO results, or a COCO or COCO-VID dataset that holds its annotations itself."""
    entries = data = load_json(path)
    if isinstance(data, dict) and "images" in data:
        entries = data.get("annotations")
    if not isinstance(entries, list):
        raise ReobjError(f"{path}: expected COCO results: [{{image_id, category_id, bbox, score}}]")
    frame_of, name_of, messages = _coco_dataset(path, names, video, data)
    for at, entry in enumerate(entries):
        found = {key: entry.get(key) for key in ("image_id", "category_id", "bbox")}
        if None in found.values() or len(entry["bbox"]) != 4:
            raise ReobjError(f"{path}, entry {at}: {found}, expected two ids and a bbox of 4")
        if entry["category_id"] not in name_of:
            raise ReobjError(f"{path}, entry {at}: category_id {entry['category_id']} is unknown: "
                             "put the dataset JSON beside this file, or give a file of names (ids "
                             "from 0) with --set detect.class_names=FILE")  # fmt: skip
        if frame_of and entry["image_id"] not in frame_of:
            raise ReobjError(f"{path}, entry {at}: image_id {entry['image_id']} is not in the "
                             "dataset JSON beside this file")  # fmt: skip
    box = np.array([entry["bbox"] for entry in entries], np.float64).reshape(-1, 4)  # x, y, w, h
    classes = list(dict.fromkeys(name_of.values()))
    image_ids = [entry["image_id"] for entry in entries]
    return RecordedDetections(
        np.array([frame_of.get(i, i) for i in image_ids], np.int64),
        np.hstack([box[:, :2], box[:, :2] + box[:, 2:]]),
        np.array([entry.get("score", 1.0) for entry in entries], np.float64),
        np.array([classes.index(name_of[entry["category_id"]]) for entry in entries], np.int64),
        [_coco_mask(entry.get("segmentation"), video.size, f"{path}, entry {at}")
         for at, entry in enumerate(entries)],
        tuple(classes), video.size, video.working_size, np.arange(len(entries)), "entry", messages,
        np.array([entry.get("track_id", entry.get("instance_id", -1)) for entry in entries]),
        np.array(sorted({f for f in frame_of.values() if f >= 0}), np.int64) if frame_of else None,
    )  # fmt: skip


COCO_GAPS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # of COCO's ids 1 to 90, without a class


def _coco_dataset(
    path: Path, names: Sequence[str], video: Video, own: Any
) -> tuple[dict[int, int], dict[int, str], list[str]]:
    """Look up what image and category ids mean, in the file itself or in a dataset beside it.

    A dataset is a JSON file with `images`. They belong to frames by `file_name`; where the video
    has no file names by `frame_id` (COCO-VID), else by their order.

    Args:
        own: content of the file.
    Returns:
        Frame by image id (empty: the id is the frame), class name by category id, and messages.
    """
    data = _dataset(path, own)
    ids = list(range(len(names))) or [i for i in range(1, 91) if i not in COCO_GAPS]
    name_of = dict(zip(ids, names or COCO_NAMES, strict=True))
    if data is None:
        return {}, name_of, ["no dataset JSON beside it: image_id is taken as the 0-based frame"]
    if data.get("categories") and not names:
        name_of = {c["id"]: c["name"] for c in data["categories"]}
        if not all(isinstance(name, str) for name in name_of.values()):
            raise ReobjError(f"{path}: a category without a name, expected {{id, name}}")
    row = {name: i for i, name in enumerate(video.names)}
    frame_of = {
        image["id"]: row.get(Path(image["file_name"]).name, -1) if row else image.get("frame_id", i)
        for i, image in enumerate(data["images"])
    }
    return frame_of, name_of, []


def _dataset(path: Path, own: Any) -> dict[str, Any] | None:
    """Return the COCO dataset that a file holds (its content is `own`) or that lies beside it."""
    data = own if isinstance(own, dict) else None
    for other in sorted(path.parent.glob("*.json")) if data is None else ():
        with contextlib.suppress(ValueError, OSError):  # what is no JSON is no dataset either
            found = load_json(other) if other != path else None
            data = found if isinstance(found, dict) and found.get("images") else data
    return data


def _coco_mask(mask: Any, size: tuple[int, int], where: str) -> Counts:
    """Read a COCO segmentation as run lengths: RLE (compressed or not), polygons or none."""
    if not mask:
        return NO_RUNS
    if not isinstance(mask, dict):
        return polygon_runs(mask, size)
    counts = mask["counts"]
    if tuple(mask["size"]) != size[::-1]:
        raise ReobjError(f"{where}: mask of (h, w) {mask['size']} in a video of {size[::-1]}")
    return coco_runs(counts) if isinstance(counts, str) else np.array(counts, np.uint32).ravel()


def _check(found: RecordedDetections, path: Path, config: DetectConfig, frame_count: int) -> None:
    """Check detections of any format, drop what is not used and sort the rest by frame and score.

    Errors for what cannot be meant, messages for single rows.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # inf - inf
        finite = np.isfinite(found.xyxy.sum(1) + found.score)  # (N,)
    finite &= (np.abs(found.xyxy) <= COORDINATE_MAX).all(1)
    named = np.isin(found.class_id, np.arange(len(found.class_names)))
    pixels = np.array([runs.sum() for runs in found.runs], np.int64)  # (N,)
    masked = np.array([len(runs) > 0 for runs in found.runs], bool)
    fits = ~masked | (pixels == math.prod(found.size))
    for row in np.flatnonzero(~(finite & named & fits))[:1]:
        text = f"mask of {pixels[row]} pixels in a video of {found.size}"
        if not finite[row]:
            text = f"{found.xyxy[row]}, {found.score[row]}: NaN, infinite or beyond 1e7 pixels"
        elif not named[row]:
            text = unnamed_class(int(found.class_id[row]), len(found.class_names))
        raise ReobjError(f"{path}, {found.unit} {found.line[row]}: {text}")
    keep = _usable(found, path, frame_count)
    if len(found) and (found.score == -1).all():
        found.messages.append("scores are all -1: taken as 1")
        found.score = -found.score
    if ((found.score < 0) | (found.score > 1)).any():
        found.messages.append(f"scores from {found.score.min():g} to {found.score.max():g} clipped "
                              "to [0, 1]")  # fmt: skip
        found.score = np.clip(found.score, 0, 1)
    keep &= found.score >= config.min_score
    if config.classes:
        keep &= np.isin(found.class_id, class_filter(config.classes, found.class_names))
    if not len(found):
        found.messages.append("no detections in this file")
    elif not keep.any():
        found.messages.append(
            f"none of {len(found)} boxes is left: those of score {config.min_score:g} or more "
            f"(detect.min_score){f' and class {config.classes}' * bool(config.classes)} are used"
        )
    rows = np.flatnonzero(keep)
    rows = rows[np.lexsort((rows, -found.score[rows], found.frame[rows]))]  # best first
    frame = found.frame[rows]
    rank = np.arange(len(rows)) - np.searchsorted(frame, frame)  # within its frame
    rows = rows[rank < config.max_detections]
    found.identity = found.identity[rows] if len(found.identity) else found.identity
    for name in ("frame", "xyxy", "score", "class_id", "line"):
        setattr(found, name, getattr(found, name)[rows])
    found.runs = [found.runs[row] for row in rows]
    found.messages[:] = [f"{path.name}: {text}" for text in found.messages]


NORMALISED_MAX = 1.5  # px; chosen: boxes wholly below are shares of the image, some a bit outside
UNUSABLE_SHARE = 0.5  # chosen: where most boxes are of no use, it is the format that is wrong


def _usable(found: RecordedDetections, path: Path, frame_count: int) -> BoolArray:
    """Tell which boxes (N,) have an area, touch the image and belong to a frame of the video."""
    count, low, high = len(found), found.xyxy[:, :2], found.xyxy[:, 2:]
    empty = (high <= low).any(1)  # (N,)
    outside = np.logical_and(~empty, ((high <= 0) | (low >= np.array(found.size))).any(1))
    missing = (found.frame < 0) | (found.frame >= (frame_count or sys.maxsize))
    if count and found.xyxy.max() <= NORMALISED_MAX:
        raise ReobjError(f"{path}: no coordinate above {NORMALISED_MAX}: normalised to 0..1? "
                         "Multiply them by the image size")  # fmt: skip
    if (empty | outside).sum() > UNUSABLE_SHARE * count:
        raise ReobjError(
            f"{path}: {empty.sum()} of {count} boxes have no area and {outside.sum()} lie outside "
            f"the image of {found.size}: x, y, w, h where x1, y1, x2, y2 is expected, or another "
            "video?"
        )
    numbers = shortened(np.unique(found.frame[missing]).tolist())
    text = f"of frames that the video has not (0-based: {numbers}; it has {frame_count or 'some'})"
    if count and missing.all():
        raise ReobjError(f"{path}: all detections are {text}: detections of another video?")
    for bad, what in ((empty, "without area"), (outside, "wholly outside the image"),
                      (missing, text)):  # fmt: skip
        if bad.any():
            first = f"{found.unit} {found.line[bad][0]}"
            found.messages.append(f"{bad.sum()} boxes {what} dropped, the first at {first}")
    return np.logical_not(empty | outside | missing)


XML_MAX = 1 << 27  # bytes; chosen: 800,000 boxes; the parser takes ten times as much
CVAT_BOX = ("xtl", "ytl", "xbr", "ybr")
SAME_BOX = 0.95  # overlap (IoU) from which a box of a tracks file counts as the tracker's own


def read_tracks(
    path: str | Path,
    video: Video,
    config: DetectConfig | None = None,
    known: Tracks | None = None,
    known_names: Sequence[str] = (),
) -> tuple[Tracks, tuple[str, ...], list[str]]:
    """Read identities made elsewhere or corrected by hand.

    Args:
        path: CVAT for video 1.1 (XML or its zip), COCO-VID JSON (track_id or instance_id), MOT rows
            or CSV with ids, in native pixels; frames that the video's options leave out are not
            used.
        known, known_names: earlier tracks of the video and their class names: they lend their
            scores to boxes that were not moved, and their classes to files that have none.
    Returns:
        tracks, their class names, and messages for the user.
    """
    path, config = Path(path), config or DetectConfig()
    limit = dataclasses.replace(config, min_score=0.0, max_detections=sys.maxsize)
    if path.suffix.lower() in (".xml", ".zip"):
        found = read_cvat(path, video)
    else:
        found = _read(path, video, limit)
    _check(found, path, limit, video.frame_count)
    kind = found.identity.dtype.kind
    if len(found.identity) and (kind not in "iu" or found.identity.max() > WHOLE_MAX):
        raise ReobjError(f"{path}: identities are {found.identity.dtype}, expected whole numbers")
    if len(found) and (not len(found.identity) or found.identity.min() < 0):
        raise ReobjError(f"{path}: not every box has an identity: no file of tracks")
    start, stop, every = video.config.start, video.config.stop, video.config.every
    use = (found.frame >= start) & ((found.frame - start) % every == 0)
    use &= found.frame < (stop or sys.maxsize)
    pairs = np.column_stack([found.frame, found.identity])[use]  # (N, 2)
    unique, first, count = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        frame, identity = unique[count.argmax()]
        raise ReobjError(f"{path}: identity {identity} has {count.max()} boxes in frame {frame} "
                         "(0-based); an object is in one place at a time")  # fmt: skip
    rows = np.flatnonzero(use)[first]
    ids, unknown = found.identity[rows], np.full(len(rows), -1, np.int64)
    columns = (found.xyxy[rows], found.score[rows], found.class_id[rows], unknown)
    tracks, names = Tracks(found.frame[rows], ids, ids, *columns), found.class_names
    if known is not None:
        unnamed = names == ("object",)
        tracks = _lend(known, tracks, unnamed)
        names = tuple(known_names) if unnamed else names
    return tracks, names, found.messages


def _lend(known: Tracks, tracks: Tracks, unnamed: bool) -> Tracks:
    """Give unmoved boxes their earlier scores, and unnamed ones the class that overlaps most."""
    class_id, score = tracks.class_id.copy(), tracks.score.copy()
    for rows in rows_by(tracks.frame):
        there = known[known.frame == tracks.frame[rows[0]]]
        iou = np.hstack([box_iou(tracks.xyxy[rows], there.xyxy), np.zeros((len(rows), 1))])
        best, same = iou.argmax(1), iou.max(1) > SAME_BOX
        score[rows[same]] = there.score[best[same]]
        if unnamed:
            class_id[rows] = np.append(there.class_id, -1)[best]  # -1: "object"
    return dataclasses.replace(tracks, class_id=class_id, score=score)


def read_cvat(path: Path, video: Video) -> RecordedDetections:
    """Read the boxes of "CVAT for video 1.1" that are not "outside"; identity is track id + 1."""
    try:
        check_unpacked(path.stat().st_size, XML_MAX)
        text = path.read_bytes()
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as packed:
                check_unpacked(packed.getinfo("annotations.xml").file_size, XML_MAX)
                text = packed.read("annotations.xml")
        tracks = [(t, b) for t in ET.fromstring(text).iter("track") for b in t.iter("box")]
        tracks = [(t, b) for t, b in tracks if b.attrib.get("outside") != "1"]
        xyxy = [[float(b.attrib[k]) for k in CVAT_BOX] for _, b in tracks]
        frame = np.array([int(b.attrib["frame"]) for _, b in tracks], np.int64)
        ids = np.array([int(t.attrib["id"]) + 1 for t, _ in tracks], np.int64)
        labels = [t.attrib["label"] for t, _ in tracks]
    except ReobjError as error:
        raise ReobjError(f"{path}: {error}") from error
    except Exception as error:  # zip and zlib have their own for damaged files, and so has expat
        raise ReobjError(f"{path}: no annotations of CVAT for video 1.1 ({error!r:.200})") from None
    if not tracks:
        raise ReobjError(f"{path}: no track with a box; export the task as 'CVAT for video 1.1'")
    names, class_id = np.unique(labels, return_inverse=True)
    n = len(tracks)
    return RecordedDetections(
        frame, np.array(xyxy, np.float64), np.ones(n), class_id.astype(np.int64), [NO_RUNS] * n,
        tuple(names.tolist()), video.size, video.working_size, np.arange(n), "box", [], ids,
    )  # fmt: skip
