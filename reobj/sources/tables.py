"""Detections and tracks in text tables: MOTChallenge and similar, KITTI tracking, CSV with header.

Cells are separated by commas, semicolons, tabs or spaces; a comma that is no separator may be the
decimal point. A row of Boxer's CSV, which WildDet3D writes too, is a box in the world of the
supplied cameras, seen in the frame of its time stamp. Its projection is a detection like any other;
the boxes themselves are measurements of the objects' shapes (`objects.config`).

Ref: github.com/facebookresearch/boxer, utils/file_io.py (`ObbCsvWriter2`): z up, full extents,
quaternions w first.
"""

from __future__ import annotations

import csv
import functools
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import distort_boxes
from reobj.files import load_json, read_lines
from reobj.formats import Probe
from reobj.sources.class_names import load_class_names
from reobj.sources.image_files import TimeUnit
from reobj.sources.recorded import (
    CENTRES,
    CORNERS,
    SIZES,
    RecordedDetections,
    Source,
    frames_of_names,
    frames_of_numbers,
)
from reobj.types import (
    CLASS_MAX,
    COCO_NAMES,
    Array,
    IntArray,
    ReobjError,
    Tracks,
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
BOX_FORMS: dict[tuple[str, ...], str] = {
    ("x1", "y1", "x2", "y2"): CORNERS,
    ("x1", "y1", "w", "h"): SIZES,
    ("cx", "cy", "w", "h"): CENTRES,
}
BOXES_3D = (
    "tx_world_object ty_world_object tz_world_object qw_world_object qx_world_object "
    "qy_world_object qz_world_object scale_x scale_y scale_z"
).split()


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
    header: Sequence[str] = ()

    def numbers(self, role: str, whole: bool = False) -> Array:
        """Convert a column to finite numbers (N,), perhaps whole ones; an error names the line."""
        values = np.array([_number(cell) for cell in self.cells[role]], np.float64)
        # Above 2^53 not every integer is a float64
        exact = (np.abs(values) <= 2.0**53) & (values == np.round(values))
        for row in np.flatnonzero(~(exact if whole else np.isfinite(values)))[:1].tolist():
            raise ReobjError(
                f"{self.path}, {self.unit} {self.line[row]}: {role} {self.cells[role][row]!r}, "
                f"expected a {'whole' if whole else 'finite'} number"
            )
        return values

    def columns(self, roles: Sequence[str]) -> Array:
        """Convert columns to finite numbers (N, count)."""
        return np.stack([self.numbers(role) for role in roles], 1)

    def whole(self, role: str) -> IntArray:
        """Convert a column to whole numbers (N,)."""
        return self.numbers(role, whole=True).astype(np.int64)


# ---- Cells ---------------------------------------------------------------------------------------


def _number(cell: str) -> float:
    """Convert a cell to a number, NaN: none; a comma is the decimal point."""
    try:
        return float(cell.replace(",", "."))
    except ValueError:
        return math.nan


def _is_empty(cell: str) -> bool:
    return cell.lower() in ("", "nan", "none", "null", "na")  # as pandas and others write it


def split(lines: Sequence[str]) -> tuple[list[list[str]], IntArray]:
    """Split lines into rows of cells, without comments and an empty last column.

    A line that begins with # is a comment, unless it is a header.

    Returns:
        rows, and the lines on which they end.
    """
    header = re.compile(r"(^|[^a-z])(frame|image|file|time)(stamp|_?[a-z]+)?\b", re.IGNORECASE)
    lines = ["\n" if line[:1] == "#" and not header.search(line) else line for line in lines]
    first = next((line for line in lines if line.strip()), "")
    separator = max(";\t,", key=first.count)  # else a space
    data = first.lstrip()[:1] in tuple("+-.0123456789")
    if len(first.split()) > first.count(separator) + 1 and (data or separator not in first):
        separator = " "
    reader: Any = csv.reader(lines, delimiter=separator, strict=True)
    if separator == " ":
        pairs = [(line.split(), i) for i, line in enumerate(lines, 1)]
    else:
        pairs = [([cell.strip() for cell in cells], reader.line_num) for cells in reader]
    pairs = [(cells, i) for cells, i in pairs if any(cells)]
    rows = [cells for cells, _ in pairs]
    if rows and rows[0][0] == "#":  # of a header, separated from its first name
        rows[0] = rows[0][1:]
    if rows and len(rows[0]) > 1 and not any(cells[-1] for cells in rows):
        rows = [cells[:-1] for cells in rows]
    return rows, np.array([i for _, i in pairs], np.int64)


def read_columns(path: Path, roles: Sequence[str] = (), least: int = 0) -> Table:
    """Read a table: by the names in its header, or columns `roles`, of which the last may lack."""
    try:
        rows, line = split(read_lines(path))
    except csv.Error as error:
        raise ReobjError(f"{path}: no table ({error})") from error
    header = () if roles or not rows else _header(rows.pop(0))
    line = line[len(line) - len(rows) :]
    names = header or roles
    count = len(rows[0]) if rows and roles else len(names)
    for cells, at in zip(rows, line, strict=True):
        if not least <= len(cells) == count <= len(names):
            expected = str(count) if least <= count <= len(names) else f"{least} to {len(names)}"
            raise ReobjError(f"{path}, line {at}: {len(cells)} columns, expected {expected}")
    columns = map(list, zip(*rows, strict=True)) if rows else ([] for _ in names)
    return Table(path, dict(zip(names, columns, strict=False)), line, header=header)


def _header(cells: Sequence[str]) -> list[str]:
    """Normalise the names of columns: without text in brackets or after a semicolon; distinct."""
    text = re.sub(r"\s*[\[(](s|ms|us|ns)[\])]", r"_\1", ",".join(cells).lower())  # unit of a time
    text = re.sub(r"\(.*?\)|\[.*?\]", "", text).split(";")[0]
    names = [re.sub(r"[\s.-]+", "_", name.strip()) for name in text.lstrip("# ").split(",")]
    if "detection_id" in names:  # Roboflow's inference: x, y is the centre
        names = [{"x": "cx", "y": "cy"}.get(name, name) for name in names]
    return [name if name not in names[:i] else f"column {i}" for i, name in enumerate(names)]


def _box_roles(roles: Collection[str]) -> tuple[str, ...]:
    """Return the four roles that give the boxes; () if one is missing."""
    return next((form for form in BOX_FORMS if {*form} <= {*roles}), ())


def by_role(table: Table) -> None:
    """Name the columns of a CSV by their roles.

    Raises:
        ReobjError: there are no columns of frames or boxes.
    """
    cells = table.cells
    empty = {name for name, column in cells.items() if all(map(_is_empty, column))}
    name_of: dict[str, str] = {}
    for role, names in ALIASES.items():
        present = sorted((name for name in names.split() if name in cells), key=empty.__contains__)
        if present and not (role in ("id", "score", "class") and present[0] in empty):
            name_of[role] = present[0]
    form = _box_roles(name_of)
    for role in ("w", "h"):  # without corners, width and height are those of the box
        if role not in form:
            name_of.pop(role, None)
        elif name_of.get(f"image {role}") == name_of[role]:
            del name_of[f"image {role}"]
    missing = ["frame"] * name_of.keys().isdisjoint(("frame", "image", "time"))
    missing += [role for role in ("x1", "y1", "x2", "y2") if role not in name_of and not form]
    if missing:
        raise ReobjError(f"{table.path}, line 1: no column {', '.join(missing)} in the header "
                         f"{','.join(cells)}: expected one such as frame,x1,y1,x2,y2,score,class"
                         )  # fmt: skip
    table.cells = {role: cells[name] for role, name in name_of.items()}


# ---- Structure -----------------------------------------------------------------------------------


@functools.lru_cache(maxsize=1)
def forms(probe: Probe) -> frozenset[str]:
    """Return the formats of tables that the first rows fit.

    VisDrone: the eighth of ten columns is one of its categories, the last two are 0 to 2. Boxmot:
    nine columns end in 1, a class and a score, without the names of classes that CVAT writes beside
    them; if all identities are below 0, they are detections, which ground truth is not.
    """
    mot = frozenset({"mot"})
    if probe.kind != "text" or probe.suffix == ".npz":
        empty = not probe.is_dir and not probe.path.read_bytes()[:4096].strip()
        return mot if empty else frozenset()
    try:
        rows = split(probe.lines)[0] or [["0"]]
    except csv.Error:
        rows = [probe.lines[0].split(",")]
    count = len(rows[0])
    if math.isnan(_number(rows[0][0])):
        return frozenset({"boxer-3d" if "tx_world_object" in rows[0] else "csv"})
    if count in (17, 18) and math.isnan(_number(rows[0][2])):
        return frozenset({"kitti"})
    if count not in (9, 10) or any(len(cells) != count for cells in rows):
        return mot
    values = np.array([[_number(cell) for cell in cells] for cells in rows])  # (N, 9 or 10)
    flag, kind, *last = values[:, 6:].T
    whole = (kind >= 0) & (kind == np.floor(kind))
    if count == 10:
        fits = whole & (kind <= 11) & np.isin(last, range(3)).all(0) & ((kind > 0) | (flag == 0))
        return frozenset({"visdrone"}) if fits.all() and kind.any() else mot
    named = (probe.path.parent / "labels.txt").exists()
    if named or not (whole & (flag == 1) & (last[0] <= 1)).all():
        return mot
    return frozenset({"boxmot"}) | (mot if (values[:, 1] >= 0).any() else set())


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
    table.whole("frame"), table.whole("id")
    return table.columns(list(table.cells))  # (N, 6 to 10)


def read_mot(source: Source) -> RecordedDetections:
    """Read MOTChallenge rows; classes count from 1, or from 0 if there is a 0."""
    table = read_columns(source.path, MOT, 6)
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
    table = read_columns(source.path, MOT, 6)
    table.cells["score"] = table.cells["extra"]
    return _recorded(table, source, 1, _numbered(table.whole("class"), 0, source))


def read_visdrone(source: Source) -> RecordedDetections:
    """Read VisDrone's annotations: class 0 is an ignored region."""
    table = read_columns(source.path, MOT, 6)
    number = table.whole("class")
    classes = _numbered(np.maximum(number, 1) - 1, 1, source, VISDRONE.split())
    return _recorded(table, source, 1, classes, ignored=number == 0)


def read_kitti(source: Source) -> RecordedDetections:
    """Read KITTI's tracking labels or results; DontCare is an ignored region."""
    table = read_columns(source.path, KITTI, 17)
    care = np.array(table.cells["class"]) == "DontCare"
    return _recorded(table, source, 0, _text_classes(table, source, ()), ignored=care)


def read_csv(source: Source) -> RecordedDetections:
    """Read a table with a header."""
    return _read_named(read_columns(source.path), source)


def read_records(source: Source) -> RecordedDetections:
    """Read a JSON list of flat objects (supervision's JSONSink)."""
    records = load_json(source.path)
    names = list(dict.fromkeys(name for record in records for name in record))
    texts = ([str(r.get(name, "")).strip() for r in records] for name in names)
    header = _header([name.replace(",", " ") for name in names])
    by_name = dict(zip(header, texts, strict=True))
    table = Table(source.path, by_name, np.arange(len(records)), "entry", header)
    return _read_named(table, source)


def _read_named(table: Table, source: Source) -> RecordedDetections:
    """Convert a table with named columns to detections; rows without a box are left out."""
    by_role(table)
    boxes = [table.cells[role] for role in _box_roles(table.cells)]
    none = np.array([all(map(_is_empty, cells)) for cells in zip(*boxes, strict=True)], bool)
    if none.any():
        first = f"{table.unit} {table.line[none][0]}"
        source.say(f"{none.sum()} rows without a box left out, the first at {first}")
        table.cells = {role: np.array(cells, object)[~none].tolist()
                       for role, cells in table.cells.items()}  # fmt: skip
        table.line = table.line[~none]
    if "id" in table.cells:
        table.cells["id"] = ["-1" if _is_empty(cell) else cell for cell in table.cells["id"]]
    # MOTChallenge counts frames from 1; its names of columns begin with bb_
    usual = int(any(name.startswith("bb_") for name in table.header))
    return _recorded(table, source, usual, _text_classes(table, source, COCO_NAMES))


def _recorded(
    table: Table, source: Source, usual: int, classes: tuple[IntArray, Sequence[str]],
    **columns: Any,
) -> RecordedDetections:  # fmt: skip
    """Convert a table to detections; usual: number of the first frame."""
    roles = _box_roles(table.cells)
    box = table.columns(roles)  # (N, 4)
    frame = _frames(table, source, usual)
    scale = np.ones(box.shape)
    if {"image w", "image h"} <= table.cells.keys():
        size = table.columns(("image w", "image h"))  # (N, 2)
        if np.abs(size - (box[:, 2:] - box[:, :2])).max(initial=0) > 1.01:  # else the boxes'
            scale = source.scale(size, frame >= 0)
    if "score" in table.cells:
        columns["score"] = table.numbers("score")
    if "id" in table.cells:
        columns["identity"] = table.whole("id")
    return source.recorded(frame, box, classes, BOX_FORMS[roles], scale, table.unit,
                           line=table.line, **columns)  # fmt: skip


def _frames(table: Table, source: Source, usual: int) -> IntArray:
    """Return the frames of the source (N,), -1: none."""
    names = table.cells.get("frame", table.cells.get("image"))
    if "frame" in table.cells and not any(math.isnan(_number(cell)) for cell in names or ()):
        return frames_of_numbers(table.whole("frame"), source, usual)
    if names is not None:
        return frames_of_names(names, source, 0)
    source.times_s = _seconds(table)
    if source.describes:
        return np.zeros(len(source.times_s), np.int64)
    if source.video.times_s is None:
        raise ReobjError(f"{source.path}, line 1: no column frame; time stamps can be used only if "
                         "the names of the images are time stamps too")  # fmt: skip
    return _nearest_times(source.video.times_s, source.times_s)


def _seconds(table: Table) -> Array:
    """Return the times (N,) of a table in s: of the unit that ends the column's name, else in s."""
    name = next(name for name in ALIASES["time"].split() if name in table.header)
    unit: TimeUnit = getattr(TimeUnit, name.rpartition("_")[2], TimeUnit.s)
    return table.numbers("time") / unit.value


def _nearest_times(times_s: Array, time_s: Array) -> IntArray:
    """Return the rows of the nearest times (N,); -1 beyond half of the usual step (1 s)."""
    if not len(times_s):
        return np.full(len(time_s), -1)
    half = float(np.median(np.diff(times_s))) / 2 if len(times_s) > 1 else 0.5
    nearest = nearest_of(time_s, times_s)
    return np.where(np.abs(times_s[nearest] - time_s) <= half, nearest, -1)


# ---- Classes -------------------------------------------------------------------------------------


def _text_classes(table: Table, source: Source, base: Sequence[str]) -> tuple[IntArray, list[str]]:
    """Read a column of class names or of numbers from 0; empty cells and -1: no class.

    base: names by number, if the user gives none; other names in the file follow them.
    """
    cells = table.cells.get("class", [""] * len(table.line))
    names = list(source.names or base)
    texts = {cell for cell in cells if not _is_empty(cell) and cell != "-1"}
    if all(re.fullmatch(r"[0-9]{1,18}(\.0*)?", cell) for cell in texts):
        index = {cell: int(float(cell)) for cell in texts}
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


# ---- Boxes in 3D ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Boxes3D:
    """Boxes in the world of the cameras, each of one detection of a video.

    Attributes (N rows, by frame):
        frame: (N,) source frame numbers. detection_index: (N,) as in `Tracks`.
        box: (N, 15) centre (3), half extents (3) and rotation world_from_box (9, by rows).
        score: (N,) in [0, 1].
    """

    frame: IntArray
    detection_index: IntArray
    box: Array
    score: Array

    def of_rows(self, tracks: Tracks) -> IntArray:
        """Return the row of each detection (M,) of tracks; -1: it has no box in 3D."""
        keys = zip(self.frame.tolist(), self.detection_index.tolist(), strict=True)
        row_of = {key: row for row, key in enumerate(keys)}
        wanted = zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True)
        return np.array([row_of.get(key, -1) for key in wanted], np.int64)


def boxes_3d_of(recorded: RecordedDetections | None) -> Boxes3D | None:
    """Return the boxes in 3D of validated detections; None: they have none."""
    if recorded is None or recorded.boxes_3d is None:
        return None
    index = np.arange(len(recorded)) - np.searchsorted(recorded.frame, recorded.frame)
    return Boxes3D(recorded.frame, index, recorded.boxes_3d, recorded.score)


def read_source_3d(source: Source) -> RecordedDetections:
    """Read boxes in 3D and project them to the frames of their time stamps.

    Raises:
        ReobjError: no cameras, an invalid value, or no box that is visible in its frame.
    """
    path = source.path
    video = source.video
    table = read_columns(path)
    role_of = {"time_ns": "time", "prob": "score", "name": "class"}
    if missing := [name for name in (*BOXES_3D, *role_of) if name not in table.cells]:
        raise ReobjError(f"{path}, line 1: 3D boxes without the columns {', '.join(missing)}")
    table.cells = {role_of.get(name, name): cells for name, cells in table.cells.items()}
    time_s = _seconds(table)
    if source.describes:
        source.times_s = time_s
        return source.recorded(np.empty(0, np.int64), (), (np.empty(0, np.int64), ()))
    poses = source.poses
    if poses is None:
        raise ReobjError(f"{path}, line 1: these are 3D boxes in the world, which need its cameras:"
                         " `run` with --detections and --poses FILE")  # fmt: skip
    box = _boxes(table)
    frames = poses.frame[poses.known]
    times_s = poses.time_s[poses.known] if video.times_s is None else video.times_s[frames]
    nearest = _nearest_times(times_s, time_s)
    timed = nearest >= 0
    xyxy = np.full((len(box), 4), np.nan)
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (F, 3, 4)
    solids = quadrics.Ellipsoids(box[:, :3], box[:, 3:6], box[:, 6:].reshape(-1, 3, 3))
    for k in np.unique(nearest[timed]):
        rows = np.flatnonzero(nearest == k)
        xyxy[rows] = quadrics.solid_boxes(solids[rows], "box", img_from_world[k : k + 1])[0]
    size = (poses.camera.width, poses.camera.height)
    xyxy = quadrics.clip_boxes(distort_boxes(xyxy, poses.camera), size)
    visible = np.isfinite(xyxy[:, 0])
    if len(box) and not visible.any():
        span = f"{time_s.min():.3f} to {time_s.max():.3f} s"
        poses_span = f"{times_s.min(initial=0):.3f} to {times_s.max(initial=0):.3f} s"
        raise ReobjError(f"{path}: no box ({span}) is in the image of a frame with a pose at its "
                         f"time stamp ({poses_span}); expected boxes in the world of --poses"
                         )  # fmt: skip
    recorded = source.recorded(
        frames[nearest], xyxy, _text_classes(table, source, COCO_NAMES), CORNERS,
        np.tile(np.divide(video.size, size), 2), table.unit, score=table.numbers("score"),
        line=table.line, boxes_3d=box,
    )  # fmt: skip
    for left, why in ((~timed, "at times without a frame with a pose"),
                      (timed & ~visible, "outside the image of their frame")):  # fmt: skip
        source.say(f"{left.sum()} boxes {why} left out" * bool(left.any()))
    recorded.select(np.flatnonzero(visible))
    return recorded


def _boxes(table: Table) -> Array:
    """Return centre, half extents and rotation (N, 15) of the rows."""
    center, quat, size = np.split(table.columns(BOXES_3D), [3, 7], 1)
    bad = (size <= 0).any(1) | (np.abs(np.linalg.norm(quat, axis=1) - 1) > 0.01)
    for row in np.flatnonzero(bad)[:1]:
        raise ReobjError(f"{table.path}, {table.unit} {table.line[row]}: extents {size[row]} and "
                         f"quaternion {quat[row]}, expected extents above 0 and a quaternion of "
                         "length 1")  # fmt: skip
    turn = np.empty((0, 3, 3))
    if len(quat):
        turn = Rotation.from_quat(np.roll(quat, -1, 1)).as_matrix()
    return np.hstack([center, size / 2, turn.reshape(-1, 9)])
