"""Detections and tracks in text tables: MOTChallenge and similar, KITTI tracking, CSV with header.

Cells are separated by commas, semicolons, tabs or spaces; a comma that is no separator may be the
decimal point. `detection_formats` lists the formats.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.files import load_json, read_lines
from reobj.formats import HEAD_BYTES, Probe
from reobj.sources.class_names import load_class_names
from reobj.sources.image_files import TimeUnit
from reobj.sources.image_frames import frames_of_names, frames_of_numbers
from reobj.sources.recorded import CENTRES, CORNERS, SIZES, RecordedDetections, Source
from reobj.types import (
    CLASS_MAX,
    COCO_NAMES,
    COORDINATE_MAX,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    nearest_of,
)

MOT = "frame id x1 y1 w h score class extra z".split()
KITTI = ("frame id class truncated occluded alpha x1 y1 x2 y2 "
         "height width length x y z yaw score").split()  # fmt: skip
VISDRONE = "pedestrian people bicycle car van truck tricycle awning-tricycle bus motor others"
ALIASES: dict[str, str] = {  # names of columns; the first one with values is used
    "frame": "frame frame_id frame_index frame_number frame_idx frame_no frame_num frame_nr "
             "frameid framenumber",
    "image": "file_name filename image_name image_path image_id imageid image img_name img_path "
             "img path file",
    "time": "time timestamp time_s timestamp_s time_ns timestamp_ns time_us timestamp_us time_ms "
            "timestamp_ms",
    "id": "id track_id tracker_id trackid track object_id obj_id object_uid instance_id instance "
          "identity",
    "x1": "x1 x_min xmin left bb_left bbox_left box_left x_left xtl bbox_x1 box_x1 bbox_xmin "
          "x bbox_x bb_x",
    "y1": "y1 y_min ymin top bb_top bbox_top box_top y_top ytl bbox_y1 box_y1 bbox_ymin "
          "y bbox_y bb_y",
    "x2": "x2 x_max xmax right bb_right bbox_right box_right x_right xbr bbox_x2 box_x2 bbox_xmax",
    "y2": "y2 y_max ymax bottom bb_bottom bbox_bottom box_bottom y_bottom ybr bbox_y2 box_y2 "
          "bbox_ymax",
    "w": "w bb_width bbox_width box_width bbox_w bb_w width",
    "h": "h bb_height bbox_height box_height bbox_h bb_h height",
    "image w": "img_width image_width img_w image_w frame_width original_width imw im_w "
               "im_width imgw width w",
    "image h": "img_height image_height img_h image_h frame_height original_height imh im_h "
               "im_height imgh height h",
    "cx": "cx xc x_center x_centre center_x xcenter bbox_cx",
    "cy": "cy yc y_center y_centre center_y ycenter bbox_cy",
    "score": "score confidence conf prob probability detection_score",
    "class": "class_name category_name class_label label name category type class class_id cls "
             "category_id label_id coco80_class",
}  # fmt: skip
NONE = np.empty(0, bool)
BOX_FORMS: dict[tuple[str, ...], str] = {
    ("x1", "y1", "x2", "y2"): CORNERS,
    ("x1", "y1", "w", "h"): SIZES,
    ("cx", "cy", "w", "h"): CENTRES,
}


@dataclass(slots=True)
class Table:
    """Cells of a table by the role of their column.

    Attributes:
        path: of the file. cells: N texts by role: a key of ALIASES, or a column of MOT or KITTI.
        line: (N,) position of each row, in `unit`s. header: names of the columns, () without.
    """

    path: Path
    cells: dict[str, list[str]]
    line: IntArray
    unit: str = "line"
    header: tuple[str, ...] = ()

    def where(self, row: int) -> str:
        """Return the position of a row, for messages."""
        return f"{self.path}, {self.unit} {self.line[row]}"

    def numbers(self, role: str) -> Array:
        """Convert a column to finite numbers (N,); an error names the line."""
        values = np.array([_number(cell) for cell in self.cells[role]], np.float64)
        self._check(role, ~np.isfinite(values), "{!r} is no finite number")
        return values

    def columns(self, roles: Sequence[str]) -> Array:
        """Convert columns to finite numbers (N, count)."""
        return np.stack([self.numbers(role) for role in roles], 1)

    def whole(self, role: str) -> IntArray:
        """Convert a column to whole numbers (N,)."""
        values = self.numbers(role)
        # Above 2^53 not every integer is a float64
        bad = (np.abs(values) > 2.0**53) | (values % 1 != 0)
        self._check(role, bad, f"{role} {{}}, expected a whole number")
        return values.astype(np.int64)

    def _check(self, role: str, bad: BoolArray, why: str) -> None:
        """Refuse the first cell of a column that is `bad` (N,); why: its text in braces."""
        for row in np.flatnonzero(bad)[:1].tolist():
            raise ReobjError(f"{self.where(row)}: {why.format(self.cells[role][row])}")


# ---- Cells ---------------------------------------------------------------------------------------


def _number(cell: str) -> float:
    """Convert a cell to a number, NaN: none; a comma is the decimal point."""
    try:
        return float(cell.replace(",", "."))
    except ValueError:
        return math.nan


def are_numbers(cells: Sequence[str]) -> bool:
    """Test whether all cells are numbers."""
    return not any(math.isnan(_number(cell)) for cell in cells)


def _separator(line: str) -> str:
    """Return the separator of a line: the most frequent of ; tab and comma, or a space."""
    best = max(";\t,", key=line.count)
    data = line.lstrip()[:1] in tuple("+-.0123456789")
    if len(line.split()) > line.count(best) + 1 and (data or best not in line):
        return " "
    return best


def _is_comment(line: str) -> bool:
    """Test whether a line begins with # and is no header."""
    header = re.search(r"(^|[^a-z])(frame|image|file|time)(stamp|_?[a-z]+)?\b", line.lower())
    return line[:1] == "#" and not header


def split(lines: Sequence[str]) -> tuple[list[list[str]], IntArray]:
    """Split lines into rows of cells, without comments and the empty cells at all their ends.

    Returns:
        rows, and the lines on which they end.
    """
    lines = ["\n" if _is_comment(line) else line for line in lines]
    separator = _separator(next((line for line in lines if line.strip()), ""))
    reader: Any = csv.reader(lines, delimiter=separator, strict=True)
    split = [([cell.strip() for cell in cells], reader.line_num) for cells in reader]
    if separator == " ":
        split = [(line.split(), i) for i, line in enumerate(lines, 1)]
    kept = [(cells, i) for cells, i in split if any(cells)]
    if kept and kept[0][0][0] == "#":  # of a header, separated from its first name
        kept[0][0].pop(0)
    rows = [cells for cells, _ in kept]
    if rows and len(rows[0]) > 1 and not any(cells[-1] for cells in rows):
        rows = [cells[:-1] for cells in rows]
    return rows, np.array([i for _, i in kept], np.int64)


def read_columns(path: Path, roles: Sequence[str] = (), least: int = 0) -> Table:
    """Read a table: by the names in its header, or columns `roles`, of which the last may lack."""
    try:
        rows, line = split(read_lines(path))
    except csv.Error as error:
        raise ReobjError(f"{path}: no table ({error})") from error
    header = () if roles or not rows else _header(rows.pop(0))
    line = line[len(line) - len(rows) :]
    names = header or roles
    count = len(rows[0]) if rows and not header else len(names)
    fits = least <= count <= len(names)
    for cells, at in zip(rows, line.tolist(), strict=True):
        if len(cells) != count or not fits:
            expected = str(count) if fits else f"{least} to {len(names)}"
            raise ReobjError(f"{path}, line {at}: {len(cells)} columns, expected {expected}")
    columns = zip(*rows, strict=True) if rows else [()] * len(names)
    by_name = {name: list(column) for name, column in zip(names, columns, strict=False)}
    return Table(path, by_name, line, header=header)


def _header(cells: Sequence[str]) -> tuple[str, ...]:
    """Normalise the names of columns: without text in brackets or after a semicolon; distinct."""
    text = re.sub(r"\s*[\[(](s|ms|us|ns)[\])]", r"_\1", ",".join(cells).lower())  # unit of a time
    text = re.sub(r"\(.*?\)|\[.*?\]", "", text).split(";")[0]
    names = [re.sub(r"[\s.-]+", "_", name.strip()) for name in text.lstrip("# ").split(",")]
    if "detection_id" in names:  # Roboflow's inference: x, y is the centre
        names = [{"x": "cx", "y": "cy"}.get(name, name) for name in names]
    return tuple(name if name not in names[:i] else f"column {i}" for i, name in enumerate(names))


def _roles(by_name: Mapping[str, list[str]]) -> dict[str, str]:
    """Return the names of the columns of a CSV by their role."""
    name_of: dict[str, str] = {}
    optional = ("id", "score", "class")  # roles whose empty columns count as missing
    for role, names in ALIASES.items():
        present = [name for name in names.split() if name in by_name]
        filled = [name for name in present if not all(map(_is_empty, by_name[name]))]
        used = filled or (present if role not in optional else [])
        if used:
            name_of[role] = used[0]
    form = _box_roles(name_of)
    for role in ("w", "h"):  # without corners, width and height are those of the box
        if role in form and name_of.get(f"image {role}") == name_of[role]:
            del name_of[f"image {role}"]
        elif role not in form:
            name_of.pop(role, None)
    return name_of


def _unread(by_name: Mapping[str, list[str]], used: set[str]) -> list[str]:
    """List the columns with values that name a class, an identity or a size and are not read."""
    kinds = r"class|label|categor|type|track|inst|obj|ident|width|height|size|resolution|"
    kinds += r"(^|_)(id|w|h)($|_)"
    names = [name for name in by_name if name not in used and re.search(kinds, name)]
    return [name for name in names if not {"-1", ""} >= {*by_name[name]}]


def _is_empty(cell: str) -> bool:
    return cell.lower() in ("", "nan", "none", "null", "na")  # as pandas and others write it


def _box_roles(roles: Mapping[str, object]) -> tuple[str, ...]:
    """Return the four roles that give the boxes; () if one is missing."""
    return next((form for form in BOX_FORMS if all(role in roles for role in form)), ())


# ---- Structure -----------------------------------------------------------------------------------


def head(probe: Probe) -> list[list[str]]:
    """Return the cells of the first rows of a text table; [] of other files and folders."""
    if probe.kind != "text" or probe.suffix == ".npz":
        return []
    cut = len(probe.lines) > 1 and probe.path.stat().st_size > HEAD_BYTES  # within the last line
    with contextlib.suppress(csv.Error):
        return split(probe.lines[: -1 if cut else None])[0]
    return [probe.lines[0].split(",")]


@functools.lru_cache(maxsize=1)
def forms(probe: Probe) -> frozenset[str]:
    """Return the formats of tables that the first rows fit.

    VisDrone: the eighth of ten columns is one of its categories, the last two are 0 to 2. Boxmot:
    nine columns end in 1, a class and a score, without the names of classes that CVAT writes beside
    them; if all identities are below 0, they are detections, which ground truth is not.
    """
    rows = head(probe)
    if not rows:
        empty = not probe.is_dir and not probe.path.read_bytes()[:4096].strip()
        return frozenset({"mot"} if empty else ())
    if not are_numbers(rows[0][:1]):
        return frozenset({"boxer-3d" if "tx_world_object" in rows[0] else "csv"})
    if len(rows[0]) in (17, 18) and not are_numbers(rows[0][2:3]):
        return frozenset({"kitti"})
    count = len(rows[0])
    if count not in (9, 10) or any(len(cells) != count for cells in rows):
        return frozenset({"mot"})
    values = np.array([[_number(cell) for cell in cells] for cells in rows])  # (N, 9 or 10)
    flag, kind, last = values[:, 6], values[:, 7], values[:, 8:]
    whole = (kind >= 0) & (kind == np.floor(kind))
    if count == 10:
        fits = whole & (kind <= 11) & np.isin(last, range(3)).all(1) & ((kind > 0) | (flag == 0))
        return frozenset({"visdrone" if fits.all() and kind.any() else "mot"})
    named = (probe.path.parent / "labels.txt").exists()
    if named or not (whole & (flag == 1) & (last[:, 0] <= 1)).all():
        return frozenset({"mot"})
    return frozenset({"boxmot"} if (values[:, 1] < 0).all() else {"boxmot", "mot"})


# ---- Readers -------------------------------------------------------------------------------------


def read_mot_rows(path: Path) -> Array:
    """Read a MOTChallenge file as numbers.

    Returns:
        (N, 6 to 10) frame (from 1), id, left, top, w, h[, score[, class or x[, y[, z]]]]; of an
        empty file (0, 10).
    Raises:
        ReobjError: a line with another number of columns, or with a cell that is no number.
    """
    table = read_columns(path, MOT, 6)
    rows = table.columns(list(table.cells))  # (N, 6 to 10)
    table.whole("frame"), table.whole("id")
    if (too_large := (np.abs(rows[:, 2:6]) > COORDINATE_MAX).any(1)).any():
        row = int(too_large.argmax())
        text = f"box {rows[row, 2:6]}, expected at most {COORDINATE_MAX:g} px"
        raise ReobjError(f"{table.where(row)}: {text}")
    return rows


def read_mot(source: Source) -> RecordedDetections:
    """Read MOTChallenge rows; classes count from 1, or from 0 if there is a 0."""
    table = _mot_table(source)
    number = np.full(len(table.line), -1)
    if "z" in table.cells and (table.numbers("z") != -1).any():
        source.say("columns 8 to 10 are x, y, z in the world, which are not read")
    elif "class" in table.cells:
        number = table.whole("class")
    labels = source.path.parent / "labels.txt"
    if not source.names and labels.exists() and (number >= 0).any():
        source.names = load_class_names(labels)
        source.say("class names of labels.txt beside it, from 1")
    first = int((number != 0).all() or 0 < len(source.names) == number.max())
    if (number == 0).any():
        text = "count from 1; 0: no class" if first else "are taken as 0-based, as there is a 0"
        source.say(f"class numbers {text}")
    return _recorded(table, source, 1, _numbered(number - first, first, source))


def read_boxmot(source: Source) -> RecordedDetections:
    """Read results of boxmot: columns 7 to 9 are 1, class from 0, score."""
    table = _mot_table(source)
    table.cells["score"] = table.cells["extra"]
    source.say("read as boxmot's results: columns 7 to 9 are 1, class from 0, score")
    return _recorded(table, source, 1, _numbered(table.whole("class"), 0, source))


def read_visdrone(source: Source) -> RecordedDetections:
    """Read VisDrone's annotations: class 0 is an ignored region."""
    table = _mot_table(source)
    number = table.whole("class")
    classes = _numbered(np.maximum(number, 1) - 1, 1, source, VISDRONE.split())
    return _recorded(table, source, 1, classes, number == 0)


def read_kitti(source: Source) -> RecordedDetections:
    """Read KITTI's tracking labels or results; DontCare is an ignored region."""
    table = read_columns(source.path, KITTI, 17)
    care = np.array(table.cells["class"]) == "DontCare"
    return _recorded(table, source, 0, text_classes(table, source, ()), care)


def read_csv(source: Source) -> RecordedDetections:
    """Read a table with a header."""
    return _read_named(read_columns(source.path), source)


def read_records(source: Source) -> RecordedDetections:
    """Read a JSON list of flat objects (supervision's JSONSink)."""
    records = load_json(source.path)
    if not all(isinstance(record, dict) for record in records):
        raise ReobjError(f"{source.path}: an entry is no object; expected objects with the same "
                         "keys")  # fmt: skip
    names = list(dict.fromkeys(name for record in records for name in record))
    header = _header([name.replace(",", " ") for name in names])
    texts = [["" if r.get(name) is None else str(r[name]).strip() for r in records]
             for name in names]  # fmt: skip
    by_name = dict(zip(header, texts, strict=True))
    return _read_named(
        Table(source.path, by_name, np.arange(len(records)), "entry", header), source
    )


def _read_named(table: Table, source: Source) -> RecordedDetections:
    """Convert a table with named columns to detections.

    Raises:
        ReobjError: there are no columns of frames or boxes, or a cell is invalid.
    """
    by_name = table.cells
    name_of = _roles(by_name)
    found = {"frame", "image", "time"} & name_of.keys()
    if not found or not _box_roles(name_of):
        missing = ["frame"] * (not found)
        missing += [role for role in ("x1", "y1", "x2", "y2") if role not in name_of]
        text = f"no column {', '.join(missing)} in the header {','.join(by_name)}"
        example = "expected one such as frame,x1,y1,x2,y2,score,class"
        raise ReobjError(f"{table.path}, line 1: {text}: {example}")
    table.cells = {role: by_name[name] for role, name in name_of.items()}
    unread = _unread(by_name, {*name_of.values()})
    source.say(f"columns that are not read: {', '.join(unread)}" * bool(unread))
    if "detection_id" in table.header and _box_roles(table.cells)[0] == "cx":
        source.say("x, y are the centres of boxes, as in all files with detection_id (Roboflow)")
    _drop_empty(table, source)
    if "id" in table.cells:
        table.cells["id"] = ["-1" if _is_empty(cell) else cell for cell in table.cells["id"]]
    # MOTChallenge counts frames from 1; its names of columns begin with bb_
    usual = 1 if any(name.startswith("bb_") for name in table.header) else 0
    return _recorded(table, source, usual, text_classes(table, source, COCO_NAMES))


def _mot_table(source: Source) -> Table:
    table = read_columns(source.path, MOT, 6)
    if (table.numbers("id") % 1 != 0).any():
        raise ReobjError(f"{table.path}: the second column is no identity. If this is no MOT file: "
                         "CSV needs a header such as frame,x1,y1,x2,y2,score,class")  # fmt: skip
    return table


def _recorded(
    table: Table,
    source: Source,
    usual: int,
    classes: tuple[IntArray, Sequence[str]],
    ignored: BoolArray = NONE,
) -> RecordedDetections:
    """Convert a table to detections; usual: number of the first frame."""
    roles = _box_roles(table.cells)
    box = table.columns(roles)  # (N, 4)
    frame = _frames(table, source, usual)
    scale = np.ones(box.shape)
    if "image w" in table.cells and "image h" in table.cells:
        size = table.columns(("image w", "image h"))  # (N, 2)
        if np.abs(size - (box[:, 2:] - box[:, :2])).max(initial=0) > 1.01:  # else the boxes'
            scale = source.scale(size, frame >= 0)
    return source.recorded(
        frame, box, classes, table.numbers("score") if "score" in table.cells else None,
        line=table.line, unit=table.unit, form=BOX_FORMS[roles], scale=scale, ignored=ignored,
        identity=table.whole("id") if "id" in table.cells else np.empty(0, np.int64),
    )  # fmt: skip


def _drop_empty(table: Table, source: Source) -> None:
    """Drop, and count, rows without a box."""
    boxes = [table.cells[role] for role in _box_roles(table.cells)]
    none = np.array([all(map(_is_empty, cells)) for cells in zip(*boxes, strict=True)], bool)
    if none.any():
        first = f"{table.unit} {table.line[none][0]}"
        source.say(f"{none.sum()} rows without a box left out, the first at {first}")
        rows = np.flatnonzero(~none)
        table.cells = {role: [cells[i] for i in rows] for role, cells in table.cells.items()}
        table.line = table.line[rows]


def _frames(table: Table, source: Source, usual: int) -> IntArray:
    """Return the frames of the source (N,), -1: none."""
    names = table.cells.get("frame", table.cells.get("image"))
    if "frame" in table.cells and are_numbers(table.cells["frame"]):
        return frames_of_numbers(table.whole("frame"), source, usual)
    if names is not None:
        return frames_of_names(names, source, 0)
    source.times_s = seconds(table)
    if source.describes:
        return np.zeros(len(source.times_s), np.int64)
    if source.video.times_s is None:
        raise ReobjError(f"{source.path}, line 1: no column frame; time stamps can be used only if "
                         "the names of the images are time stamps too")  # fmt: skip
    return nearest_times(source.video.times_s, source.times_s, 0.0)


def seconds(table: Table) -> Array:
    """Return the times (N,) of a table in s: of the unit that ends the column's name, else in s."""
    values = table.numbers("time")
    name = next(name for name in ALIASES["time"].split() if name in table.header)
    per_s = next((unit.value for unit in TimeUnit if name.endswith(f"_{unit.name}")), 1.0)
    if (latest := values.max(initial=0)) > 1e11 * per_s:
        raise ReobjError(f"{table.path}: column {name}: {latest:g} is no time in s; name its unit: "
                         "timestamp_ms, timestamp_us or timestamp_ns")  # fmt: skip
    return values / per_s


def nearest_times(times_s: Array, time_s: Array, alone_s: float) -> IntArray:
    """Return the rows of the nearest times (N,); -1 beyond half of the usual step.

    alone_s: half the step of a single time.
    """
    if not len(times_s):
        return np.full(len(time_s), -1)
    half = 0.5 * float(np.median(np.diff(times_s))) if len(times_s) > 1 else alone_s
    nearest = nearest_of(time_s, times_s)
    return np.where(np.abs(times_s[nearest] - time_s) <= half, nearest, -1)


# ---- Classes -------------------------------------------------------------------------------------


def text_classes(table: Table, source: Source, base: Sequence[str]) -> tuple[IntArray, list[str]]:
    """Read a column of class names or of numbers from 0; empty cells and -1: no class.

    base: names by number, if the user gives none; other names in the file follow them.
    """
    cells = table.cells.get("class", [""] * len(table.line))
    names = list(source.names or base)
    texts = {cell for cell in cells if not _is_empty(cell) and cell != "-1"}
    if all(re.fullmatch(r"[0-9]{1,18}(\.0*)?", cell) for cell in texts):
        index = {cell: int(cell.partition(".")[0]) for cell in texts}
    else:
        names += sorted(texts - set(names))
        index = {name: i for i, name in reversed(list(enumerate(names)))}
    return _with_unnamed(np.array([index.get(cell, -1) for cell in cells], np.int64), names, source)


def _numbered(
    class_id: IntArray, first: int, source: Source, names: Sequence[str] = ()
) -> tuple[IntArray, list[str]]:
    """Name classes (N,) by number, which the file counts from `first`; below 0: no class."""
    last = int(class_id.max(initial=-1)) + first
    if last > CLASS_MAX:
        raise ReobjError(f"{source.path}: class number {last}, expected at most {CLASS_MAX}")
    known = list(source.names or names) or [f"class {i}" for i in range(first, last + 1)]
    return _with_unnamed(class_id, known, source)


def _with_unnamed(
    class_id: IntArray, names: list[str], source: Source
) -> tuple[IntArray, list[str]]:
    """Name the class of rows without one, below 0, `object`, and count them."""
    blank = class_id < 0
    if blank.all():
        return np.zeros(len(class_id), np.int64), ["object"]
    if not blank.any():
        return class_id, names
    source.say(f"{blank.sum()} boxes without a class are called object")
    return np.where(blank, len(names), class_id), [*names, "object"]
