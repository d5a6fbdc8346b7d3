"""Detections and tracks in text tables: MOTChallenge, KITTI tracking, CSV with a header.

Start at `read_table` and `read_mot_rows`. Cells are separated by commas, semicolons, tabs or
spaces; a comma that is no separator may be the decimal point.
"""

from __future__ import annotations

import contextlib
import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reobj.files import read_lines, shortened
from reobj.sources.class_names import check_length
from reobj.sources.image_files import TimeUnit, is_date
from reobj.sources.image_frames import frames_of_names, frames_of_numbers
from reobj.sources.masks import NO_RUNS
from reobj.sources.recorded import RecordedDetections
from reobj.sources.video import Video
from reobj.types import (
    CLASS_MAX,
    CLASS_NAME_MAX,
    COCO_NAMES,
    COORDINATE_MAX,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    printable,
    xyxy_from_cxcywh,
)

BOXES_3D = (
    "tx_world_object", "ty_world_object", "tz_world_object", "qw_world_object", "qx_world_object",
    "qy_world_object", "qz_world_object", "scale_x", "scale_y", "scale_z",
)  # fmt: skip
ALIASES: dict[str, tuple[str, ...]] = {  # names of columns; the first one with values is used
    "frame": ("frame", "frame_id", "frame_index", "frame_number", "frame_idx", "frame_no",
              "frame_num", "frame_nr", "frameid", "framenumber"),
    "image": ("file_name", "filename", "image_name", "image_path", "image_id", "imageid", "image",
              "img_name", "img_path", "img", "path", "file"),
    "time": ("time", "timestamp", "time_s", "timestamp_s", "time_ns", "timestamp_ns", "time_us",
             "timestamp_us", "time_ms", "timestamp_ms"),
    "id": ("id", "track_id", "tracker_id", "trackid", "track", "object_id", "obj_id", "object_uid",
           "instance_id", "instance", "identity"),
    "x1": ("x1", "x_min", "xmin", "left", "bb_left", "bbox_left", "box_left", "x_left", "xtl",
           "bbox_x1", "bbox_xmin", "x", "bbox_x", "bb_x"),
    "y1": ("y1", "y_min", "ymin", "top", "bb_top", "bbox_top", "box_top", "y_top", "ytl",
           "bbox_y1", "bbox_ymin", "y", "bbox_y", "bb_y"),
    "x2": ("x2", "x_max", "xmax", "right", "bb_right", "bbox_right", "box_right", "x_right", "xbr",
           "bbox_x2", "bbox_xmax"),
    "y2": ("y2", "y_max", "ymax", "bottom", "bb_bottom", "bbox_bottom", "box_bottom", "y_bottom",
           "ybr", "bbox_y2", "bbox_ymax"),
    "w": ("w", "width", "bb_width", "bbox_width", "box_width", "bbox_w", "bb_w"),
    "h": ("h", "height", "bb_height", "bbox_height", "box_height", "bbox_h", "bb_h"),
    "cx": ("cx", "xc", "x_center", "x_centre", "center_x", "xcenter", "bbox_cx"),
    "cy": ("cy", "yc", "y_center", "y_centre", "center_y", "ycenter", "bbox_cy"),
    "score": ("score", "confidence", "conf", "prob", "probability", "detection_score"),
    "class": ("class_name", "category_name", "class_label", "label", "name", "category", "type",
              "class", "class_id", "cls", "category_id", "label_id", "coco80_class"),
}  # fmt: skip


@dataclass(slots=True)
class Table:
    """Cells of a table by the role of their column.

    Attributes:
        path: of the file. kind: "MOT", "KITTI" or "CSV".
        cells: N texts by role: a key of ALIASES, or a column of MOT or KITTI in `read_cells`.
        line: (N,) position of each row, in `unit`s. header: names of the columns, () without.
        comma: may be the decimal point. messages: for the user.
    """

    path: Path
    kind: str
    cells: dict[str, list[str]]
    line: IntArray
    unit: str = "line"
    header: tuple[str, ...] = ()
    comma: bool = False
    messages: list[str] = field(default_factory=list)

    def where(self, row: int) -> str:
        """Return the position of a row, for messages."""
        return f"{self.path}, {self.unit} {self.line[row]}"

    def select(self, keep: BoolArray) -> None:
        """Keep some of the N rows."""
        rows = np.flatnonzero(keep)
        self.cells = {role: [cells[i] for i in rows] for role, cells in self.cells.items()}
        self.line = self.line[rows]

    def numbers(self, role: str) -> Array:
        """Convert a column to finite numbers (N,); an error names the line."""
        cells = self.cells[role]
        if self.comma:
            cells = [cell.replace(",", ".") for cell in cells]
        with contextlib.suppress(ValueError):
            values = np.array(cells, np.float64)
            if np.isfinite(values).all():
                return values
        values = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            with contextlib.suppress(ValueError):
                values[i] = float(cell)
            if not math.isfinite(values[i]):
                raise ReobjError(f"{self.where(i)}: {self.cells[role][i]!r} is no finite number")
        return values

    def whole(self, role: str) -> IntArray:
        """Convert a column to whole numbers (N,)."""
        values = self.numbers(role)
        # Above 2^53 not every integer is a float64
        bad = (np.abs(values) > 2.0**53) | (values % 1 != 0)
        if bad.any():
            row = int(bad.argmax())
            text = f"{role} {self.cells[role][row]}, expected a whole number"
            raise ReobjError(f"{self.where(row)}: {text}")
        return values.astype(np.int64)


# ---- Cells ---------------------------------------------------------------------------------------


def _is_number(cell: str) -> bool:
    with contextlib.suppress(ValueError):
        float(cell.strip().replace(",", "."))
        return True
    return False


def _are_numbers(cells: Sequence[str]) -> bool:
    with contextlib.suppress(ValueError):
        return np.array(cells, np.float64).ndim == 1
    return all(map(_is_number, cells))


def _separator(line: str) -> str:
    """Infer the separator of a line: the most frequent of ; tab and comma, or a space."""
    best = max(";\t,", key=line.count)
    data = line.lstrip()[:1] in tuple("+-.0123456789")
    if len(line.split()) > line.count(best) + 1 and (data or best not in line):
        return " "
    return best


def _is_comment(line: str) -> bool:
    """Test whether a line begins with # and is no header."""
    if line[:1] != "#":
        return False
    words = set(re.split(r"[^a-z0-9]+", line.lower())) | set(re.split(r"\W+", line.lower()))
    return not words & {name for role in ("frame", "image", "time") for name in ALIASES[role]}


def _rows(path: Path) -> tuple[list[list[str]], list[int], str]:
    """Split a file into rows of cells, the lines on which they end, and the separator."""
    lines = read_lines(path)
    lines = ["\n" if _is_comment(line) else line for line in lines]
    first = next((line for line in lines if line.strip()), "")
    separator = _separator(first)
    if separator == " ":
        split = [(line.split(), i) for i, line in enumerate(lines, 1)]
    else:
        reader = csv.reader(lines, delimiter=separator, strict=True)
        try:
            split = [(cells, reader.line_num) for cells in reader]
        except csv.Error as error:
            raise ReobjError(f"{path}, line {reader.line_num}: no table ({error})") from error
    kept = [([cell.strip() for cell in cells], i) for cells, i in split]
    kept = [(cells, i) for cells, i in kept if any(cells)]
    if kept and kept[0][0][0] == "#":  # of a header, separated from its first name
        kept[0][0].pop(0)
    return [cells for cells, _ in kept], [i for _, i in kept], separator


def read_cells(path: Path) -> Table:
    """Read the cells of a text table of any kind.

    Raises:
        ReobjError: a row has another length than the first one, or a header has no box columns.
    """
    mot = ("frame", "id", "x1", "y1", "w", "h", "score", "class", "extra", "z")
    kitti = ("frame", "id", "class", "truncated", "occluded", "alpha", "x1", "y1", "x2", "y2",
             "3d h", "3d w", "3d l", "3d x", "3d y", "3d z", "yaw", "score")  # fmt: skip
    rows, lines, separator = _rows(path)
    first = rows[0] if rows else []
    table = Table(path, "MOT", {}, np.array(lines, np.int64), comma=separator != ",")
    if not first:
        table.cells = {role: [] for role in mot}
        return table
    columns: Sequence[str] = mot
    expected = "6 to 10 (frame, id, left, top, w, h, score)"
    count = len(first)
    if not _is_number(first[0]):
        table.kind = "CSV"
        table.header = _header(first)
        columns = table.header
        count = len(table.header)
        rows = rows[1:]
        lines = lines[1:]
        table.line = table.line[1:]
        expected = str(count)
    elif count > 1 and not any(cells[-1] for cells in rows):  # each line ends in a separator
        rows = [cells[:-1] for cells in rows]
        count = count - 1
        expected = str(count) if 6 <= count <= len(mot) else expected
    elif len(first) in (17, 18) and not _is_number(first[2]):
        table.kind = "KITTI"
        columns = kitti
        expected = str(count)
    elif 6 <= count <= len(mot):
        expected = str(count)
    for cells, line in zip(rows, lines, strict=True):
        if str(len(cells)) != expected:
            raise ReobjError(f"{path}, line {line}: {len(cells)} columns, expected {expected}")
    by_name = {name: [row[i] for row in rows] for i, name in enumerate(columns[:count])}
    table.cells = _by_role(by_name, path) if table.kind == "CSV" else by_name
    return table


def _header(cells: Sequence[str]) -> tuple[str, ...]:
    """Normalise the names of columns: without text in brackets or after a semicolon; distinct."""
    text = re.sub(r"\(.*?\)|\[.*?\]", "", ",".join(cells)).split(";")[0].lower()
    names = [re.sub(r"[\s.-]+", "_", name.strip()) for name in text.lstrip("# ").split(",")]
    if "x0" in names and "y0" in names:  # corners counted from 0
        other = {"x0": "x1", "y0": "y1", "x1": "x2", "y1": "y2"}
        names = [other.get(name, name) for name in names]
    return tuple(name if name not in names[:i] else f"column {i}" for i, name in enumerate(names))


def _by_role(by_name: Mapping[str, list[str]], path: Path) -> dict[str, list[str]]:
    """Find the columns of a CSV by their names."""
    cells = {}
    optional = ("id", "score", "class")  # roles whose empty columns count as missing
    for role, names in ALIASES.items():
        present = [name for name in names if name in by_name]
        filled = [name for name in present if not all(map(_is_empty, by_name[name]))]
        used = filled or (present if role not in optional else [])
        if used:
            cells[role] = by_name[used[0]]
    has_frame = any(role in cells for role in ("frame", "image", "time"))
    if "tx_world_object" in by_name:
        return _of_boxes_3d(by_name, path)
    if not has_frame or not _box_roles(cells):
        missing = [role for role in ("x1", "y1", "x2", "y2") if role not in cells]
        missing = ["frame"] * (not has_frame) + missing
        text = f"no column {', '.join(missing)} in the header {','.join(by_name)}"
        example = "expected one such as frame,x1,y1,x2,y2,score,class"
        raise ReobjError(f"{path}, line 1: {text}: {example}")
    return cells


def _of_boxes_3d(by_name: Mapping[str, list[str]], path: Path) -> dict[str, list[str]]:
    """Find the columns of a table of boxes in the world (Boxer, WildDet3D)."""
    role_of = {"time_ns": "time", "prob": "score", "name": "class"}
    columns = (*BOXES_3D, *role_of)
    if missing := [name for name in columns if name not in by_name]:
        text = f"3D boxes without the columns {', '.join(missing)}"
        raise ReobjError(f"{path}, line 1: {text}; expected those of Boxer's 3D boxes")
    return {role_of.get(name, name): by_name[name] for name in columns}


def _is_empty(cell: str) -> bool:
    return cell.lower() in ("", "nan", "none", "null", "na")  # as pandas and others write it


def _box_roles(cells: Mapping[str, list[str]]) -> tuple[str, ...]:
    """Return the four roles that give the boxes; () if one is missing."""
    forms = (("x1", "y1", "x2", "y2"), ("x1", "y1", "w", "h"), ("cx", "cy", "w", "h"))
    return next((roles for roles in forms if all(role in cells for role in roles)), ())


def table_of_records(path: Path, records: Any) -> Table | None:
    """Convert a JSON list of flat objects (supervision's JSONSink) to a table; None: other data."""
    flat = isinstance(records, list) and all(isinstance(record, dict) for record in records)
    if not flat or not any({"x_min", "xmin", "x1"} & record.keys() for record in records[:1]):
        return None
    names = list(dict.fromkeys(name for record in records for name in record))
    header = _header([name.replace(",", " ") for name in names])
    texts = [["" if r.get(name) is None else str(r[name]).strip() for r in records]
             for name in names]  # fmt: skip
    cells = _by_role(dict(zip(header, texts, strict=True)), path)
    return Table(path, "CSV", cells, np.arange(len(records)), "entry", header)


# ---- Columns -------------------------------------------------------------------------------------


def read_mot_rows(path: Path) -> Array:
    """Read a MOTChallenge file as numbers.

    Returns:
        (N, 6 to 10) frame (from 1), id, left, top, w, h[, score[, class or x[, y[, z]]]]; of an
        empty file (0, 10).
    Raises:
        ReobjError: a line with another number of columns, or with a cell that is no number.
    """
    table = read_cells(path)
    if table.kind != "MOT":
        raise ReobjError(f"{path}, line 1: no MOTChallenge file; expected frame,id,left,top,w,h")
    rows = np.stack([table.numbers(role) for role in table.cells], 1)  # (N, 6 to 10)
    table.whole("frame"), table.whole("id")
    if (too_large := (np.abs(rows[:, 2:6]) > COORDINATE_MAX).any(1)).any():
        row = int(too_large.argmax())
        text = f"box {rows[row, 2:6]}, expected at most {COORDINATE_MAX:g} px"
        raise ReobjError(f"{table.where(row)}: {text}")
    return rows


def read_table(
    path: Path, names: Sequence[str], video: Video, first: str = ""
) -> RecordedDetections:
    """Read the detections of a text table.

    Args:
        names: class names by number, (): not given.
        first: number of the first frame, "": inferred.
    """
    return recorded_table(read_cells(path), names, video, first)


def recorded_table(
    table: Table, names: Sequence[str], video: Video, first: str = ""
) -> RecordedDetections:
    """Convert a table of any kind to detections."""
    if BOXES_3D[0] in table.cells:
        fault = "these are 3D boxes in the world, which need its cameras"
        raise ReobjError(f"{table.path}, line 1: {fault}: `run` with --detections and --poses FILE")
    _drop_rows(table)
    xyxy = _boxes(table)
    count = len(table.line)
    mot = table.kind == "MOT"
    if mot and (table.numbers("id") % 1 != 0).any():
        raise ReobjError(f"{table.path}: the second column is no identity. If this is no MOT file: "
                         "CSV needs a header such as frame,x1,y1,x2,y2,score,class")  # fmt: skip
    identity = _identities(table)
    score = table.numbers("score") if "score" in table.cells else np.ones(count)
    classes = _mot_classes(table, score, names) if mot else text_classes(table, names)
    frame = _frames(table, video, first)
    recorded = RecordedDetections(
        frame, xyxy, score, classes[0], [NO_RUNS] * count, tuple(classes[1]), video.size,
        video.working_size, table.line, table.unit, table.messages, identity,
    )  # fmt: skip
    return _without_ignored(recorded) if mot else recorded


def _drop_rows(table: Table) -> None:
    """Drop, and count, rows without a box and rows that the format marks as ignored."""
    if table.kind == "KITTI":
        keep = np.array([name != "DontCare" for name in table.cells["class"]], bool)
        if not keep.all():
            table.messages.append(f"{(~keep).sum()} rows DontCare left out")
            table.select(keep)
    roles = [role for role in ("x1", "y1", "x2", "y2", "w", "h", "cx", "cy") if role in table.cells]
    none = np.ones(len(table.line), bool)
    for role in roles:
        rows = np.flatnonzero(none)
        none[rows] = [_is_empty(table.cells[role][row]) for row in rows]
    if none.any():
        first = f"{table.unit} {table.line[none][0]}"
        table.messages.append(f"{none.sum()} rows without a box left out, the first at {first}")
        table.select(~none)


def _boxes(table: Table) -> Array:
    """Return the boxes (N, 4), corners."""
    roles = _box_roles(table.cells)
    box = np.stack([table.numbers(role) for role in roles], 1)
    if roles[0] == "cx":
        return xyxy_from_cxcywh(box)
    return np.hstack([box[:, :2], box[:, :2] + box[:, 2:]]) if roles[2] == "w" else box


def _identities(table: Table) -> IntArray:
    """Return the identities (N,), -1 where a row has none; empty without such a column."""
    if "id" not in table.cells:
        return np.empty(0, np.int64)
    if table.kind == "CSV":
        table.cells["id"] = ["-1" if _is_empty(cell) else cell for cell in table.cells["id"]]
    return table.whole("id")


def _frames(table: Table, video: Video, first: str) -> IntArray:
    """Return the frames of the source (N,), -1: none."""
    if "frame" in table.cells and _are_numbers(table.cells["frame"]):
        # MOTChallenge counts frames from 1; its names of columns begin with bb_
        of_mot = table.kind == "MOT" or any(name.startswith("bb_") for name in table.header)
        usual = 1 if of_mot else 0
        numbers = table.whole("frame")
        count = video.frame_count
        where = str(table.path)
        frame, text = frames_of_numbers(numbers, count, first, usual, False, where)
    elif "frame" in table.cells or "image" in table.cells:
        names = table.cells["frame" if "frame" in table.cells else "image"]
        frame, text = frames_of_names(names, video, str(table.path), first, 0)
    else:
        return _frames_at(seconds(table), video, table.path)
    table.messages += [text] if text else []
    return frame


def image_names_of(table: Table) -> list[str]:
    """Return the distinct names of images in a table, [] if it has numbers or times."""
    if "frame" in table.cells or "image" not in table.cells:
        return []
    names = list(dict.fromkeys(table.cells["image"]))
    return [] if _are_numbers(names) else names


def seconds(table: Table) -> Array:
    """Return the times (N,) of a table in s.

    The unit is that in the name of the column; else the one of s, ms, us and ns in which the times
    are plausible dates since 1970; else s.
    """
    values = table.numbers("time")
    named = [name for name in ALIASES["time"] if name in table.header]
    per_s = next((TimeUnit[name[-2:]].value for name in named[:1] if name[-3:-2] == "_"
                  and name[-2:] in TimeUnit.__members__), 0.0)  # fmt: skip
    if not per_s and len(values):
        dated = [u.value for u in TimeUnit if is_date(float(values.min()) / u.value)]
        per_s = dated[0] if dated else 1.0
    return values / (per_s or 1.0)


def _frames_at(time_s: Array, video: Video, path: Path) -> IntArray:
    """Find the frames nearest to times (N,) in s, -1 if none is within half a frame interval."""
    if video.times_s is None:
        raise ReobjError(f"{path}, line 1: no column frame; time stamps can be used only if the "
                         "names of the images are time stamps too")  # fmt: skip
    half = 0.5 * float(np.median(np.diff(video.times_s))) if len(video.times_s) > 1 else 0.0
    after = np.searchsorted(video.times_s, time_s).clip(max=len(video.times_s) - 1)  # (N,)
    pair = np.stack([(after - 1).clip(0), after], 1)  # (N, 2)
    offset = np.abs(video.times_s[pair] - time_s[:, None])
    nearest = np.take_along_axis(pair, offset.argmin(1)[:, None], 1)[:, 0]
    return np.where(offset.min(1) <= half, nearest, -1)


# ---- Classes -------------------------------------------------------------------------------------


def text_classes(table: Table, names: Sequence[str]) -> tuple[IntArray, list[str]]:
    """Read a column of class names or of numbers from 0; empty cells and -1: no class."""
    cells = table.cells.get("class", [""] * len(table.line))
    blank = np.array([_is_empty(cell) or cell == "-1" for cell in cells], bool)
    filled = [cell for cell, none in zip(cells, blank.tolist(), strict=True) if not none]
    numbers = _whole_numbers(filled)
    class_id = np.zeros(len(cells), np.int64)
    if not filled:
        return class_id, ["object"]
    known: list[str]
    if numbers is not None:
        known = list(names or COCO_NAMES)
        class_id[~blank] = numbers
    else:
        for name in set(filled):
            if len(name) > CLASS_NAME_MAX:
                check_length(name, table.where(cells.index(name)))
        base = list(names) if table.kind == "KITTI" else list(names or COCO_NAMES)
        new = sorted(set(filled) - set(base))
        known = [*base, *new]
        index = {name: i for i, name in reversed(list(enumerate(known)))}
        class_id[~blank] = [index[cell] for cell in filled]
        if new and names:
            text = f"{len(new)} class names that detect.class_names does not have"
            table.messages.append(f"{text}: {printable(shortened(new))}")
    return _with_unnamed(class_id, blank, known, table)


def _whole_numbers(cells: Sequence[str]) -> IntArray | None:
    """Convert cells such as 56 or 56.0 to numbers (N,); None if they are names."""
    if not all(re.fullmatch(r"[0-9]{1,18}(\.0*)?", cell) for cell in cells):
        return None
    return np.array([int(cell.partition(".")[0]) for cell in cells], np.int64)


def _with_unnamed(
    class_id: IntArray, blank: BoolArray, names: list[str], table: Table
) -> tuple[IntArray, list[str]]:
    """Name the class of rows without one, `blank` (N,), `object`, and count them."""
    if blank.any():
        class_id = np.where(blank, len(names), class_id)
        names = [*names, "object"]
        table.messages.append(f"{blank.sum()} boxes without a class are called object")
    return class_id, names


def _mot_classes(table: Table, score: Array, names: Sequence[str]) -> tuple[IntArray, list[str]]:
    """Read the class numbers of MOT rows; the content of the column is inferred.

    Numbers count from 1 in the order of the names, or from 0 if a 0 is consistent with the names;
    -1: no class. Older results of boxmot (1, class from 0, score in the last three of nine columns)
    are recognised: their scores replace `score` in place. Other numbers are world coordinates
    (columns 8 to 10 of MOTChallenge's detections).

    Returns:
        class (N,), -1: an ignored region; and the class names.
    """
    count = len(score)
    number = table.numbers("class") if "class" in table.cells else np.full(count, -1.0)
    none = np.zeros(count, np.int64), ["object"]
    if not count or (number == -1).all():
        return none
    if (odd := (number % 1 != 0) | (number < -1)).any():
        value = table.cells["class"][int(odd.argmax())]
        table.messages.append(f"column 8 holds no class numbers ({value}): no classes are read")
        return none
    if number.max() > CLASS_MAX:
        text = f"class number {table.cells['class'][int(number.argmax())]}"
        raise ReobjError(f"{table.path}: {text}, expected at most {CLASS_MAX}")
    kind = number.astype(np.int64)
    first = 1
    if _is_boxmot(table, score, kind):
        score[:] = table.numbers("extra")
        first = 0
        table.messages.append(
            "columns 7 to 9 are taken as 1, class from 0, score, as boxmot writes them"
        )
    ignored = (kind == 0) & (score == 0)  # VisDrone's ignored regions
    used = kind[~ignored]
    if (used == 0).any() and first:
        first = 0 if not ignored.any() and (not names or used.max() < len(names)) else 1
        text = "are taken as 0-based, as there is a 0" if not first else "count from 1; 0: no class"
        table.messages.append(f"class numbers {text}")
    known = list(names)
    if (most := int(kind.max(initial=0)) - first) >= len(known):
        if known:
            text = f"class numbers up to {kind.max()}, but only {len(known)} class names"
            table.messages.append(f"{text}: the others are called by their numbers")
        known += [f"class {i + first}" for i in range(len(known), most + 1)]
    blank = (kind < first) & ~ignored
    class_id, known = _with_unnamed((kind - first).clip(0), blank, known, table)
    return np.where(ignored, -1, class_id), known


def _is_boxmot(table: Table, score: Array, number: IntArray) -> bool:
    """Test whether the last column is a score: all scores are 1, and no value of it is 0 or 1.

    In MOTChallenge's ground truth it is the visibility, 1 for boxes that are not occluded, and
    identities and classes count from 1.
    """
    if "extra" not in table.cells or "z" in table.cells or (score != 1).any():
        return False
    extra = table.numbers("extra")
    if not ((extra > 0) & (extra < 1)).all():
        return False
    no_truth = (table.numbers("id") < 0).all() or (number == 0).any()
    as_written = all(re.fullmatch(r"0?\.\d{6}", cell) for cell in table.cells["extra"])  # %.6f
    # Of 20 true boxes at least one has visibility 1
    return bool(no_truth or as_written or len(extra) >= 20)


def _without_ignored(recorded: RecordedDetections) -> RecordedDetections:
    """Drop, and count, ignored regions (class -1)."""
    ignored = recorded.class_id < 0
    if ignored.any():
        text = f"{ignored.sum()} rows of class 0 and score 0 (ignored regions) left out"
        recorded.messages.append(text)
        recorded.select(np.flatnonzero(~ignored))
    return recorded
