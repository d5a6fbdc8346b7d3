"""Folders of YOLO labels: a text file an image, `class cx cy w h [conf] [id]` or polygons.

Coordinates are fractions of the image size. Keypoints after `class cx cy w h` are not read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reobj.files import LINES_MAX, read_lines
from reobj.sources.class_names import is_yaml, load_class_names
from reobj.sources.image_frames import frames_of_names
from reobj.sources.masks import NO_RUNS, polygon_runs
from reobj.sources.recorded import CENTRES, NORMALISED_MAX, RecordedDetections, Source
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError

NO_LABELS = ("classes.txt train.txt val.txt valid.txt test.txt readme.txt readme.dataset.txt "
             "readme.roboflow.txt requirements.txt labels.txt").split()  # fmt: skip
NAMES_FILES = (
    "classes.txt obj.names data.yaml dataset.yaml data.yml dataset.yml labels.txt _darknet.labels "
    "notes.json"
).split()


def label_files(path: Path) -> list[Path]:
    """List the label files of a folder, or of the label folders of a dataset in it."""
    folders = {"labels", "obj_train_data"}  # of YOLO datasets, and of CVAT's export of YOLO 1.1
    files = [p for p in path.glob("*.txt") if p.name.lower() not in NO_LABELS]
    if not files or any((path / name).is_dir() for name in folders):
        files = [p for p in path.rglob("*.txt") if p.name.lower() not in NO_LABELS]
        files = [p for p in files if folders & set(p.relative_to(path).parts[:-1])]
    if not files:
        raise ReobjError(f"{path}: a folder without label files; expected YOLO's NAME.txt, one an "
                         "image, in it or in its folder labels/")  # fmt: skip
    return sorted(files)


def names_file(path: Path) -> Path | None:
    """Find the file of class names of a folder of labels: in it, or in one of two folders above."""
    labels = path.resolve()
    for folder in (labels, *labels.parents[:2]):
        known = [*(folder / name for name in NAMES_FILES), *sorted(folder.glob("*.names"))]
        for file in (*filter(Path.is_file, known), *sorted(filter(is_yaml, folder.glob("*")))):
            if file in known or any(line.startswith("names") for line in read_lines(file)):
                return file
    return None


def read_label_folder(source: Source, pose: int = 0) -> RecordedDetections:
    """Read a folder of YOLO labels.

    NAME.txt belongs to the image of that name; NAME_N.txt to frame N of a video (from 1, as in
    ultralytics, if NAME is that of the video). Class names are the user's, or those of a file
    beside the labels, else COCO's. pose: numbers of each keypoint between box and confidence.
    """
    path = source.path
    video = source.video
    files = label_files(path)
    source.say(f"a folder of YOLO labels: {len(files)} files")
    of_video = re.compile(re.escape(Path(video.source).stem) + r"_\d+")
    video_files = [] if video.names else [f for f in files if of_video.fullmatch(f.stem)]
    if video_files and len(video_files) < len(files):
        count = len(files) - len(video_files)
        source.say(f"{count} files of other names than the video's left out")
        files = video_files
    names = source.names
    beside = None if names else names_file(path)
    if beside is not None:
        names = load_class_names(beside)
        source.say(f"class names of {beside}")
    elif not names:
        source.say("no class names beside it: class numbers are taken as COCO's 80")
    rows = list[list[float]]()
    lines = list[str]()
    of_file = list[int]()
    for at, file in enumerate(files):
        for number, line in enumerate(read_lines(file), 1):
            if cells := line.split():
                rows.append(_row(cells, f"{file}, line {number}"))
                lines.append(f"{number} of {file.name}")
                of_file.append(at)
        if len(rows) > LINES_MAX:
            raise ReobjError(f"{path}: more than {LINES_MAX} boxes; take fewer frames")
    if pose:
        rows = [row[:5] + row[len(row) - (len(row) - 5) % pose :] for row in rows]
        source.say("keypoints after class cx cy w h are not read")
    box, score, identity, polygons = _columns(rows, [f"{path}, line {line}" for line in lines])
    stems = [str(file.relative_to(path)) for file in files]
    frame = frames_of_names(stems, source, 1 if video_files else None)
    runs = [NO_RUNS] * len(rows)
    for row, corners in polygons.items() if not source.describes else ():
        runs[row] = polygon_runs([(corners * video.size).ravel().tolist()], video.size)
    class_id = np.array([row[0] for row in rows], np.float64).astype(np.int64)
    return source.recorded(
        frame[np.array(of_file, np.int64)], box, (class_id, names or COCO_NAMES), score, runs,
        np.array(lines, object), "line", CENTRES, np.tile(video.size, 2), identity=identity,
    )  # fmt: skip


def _row(cells: Sequence[str], where: str) -> list[float]:
    """Read the numbers of a line, the class first."""
    shown = repr(" ".join(cells)[:60])
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        text = f"{shown}, expected numbers: class cx cy w h [conf] [id]"
        raise ReobjError(f"{where}: {text}") from None
    if len(row) < 5 or not np.isfinite(row).all() or row[0] % 1 or not 0 <= row[0] < 1 << 31:
        expected = "expected class cx cy w h [conf] [id] or class x1 y1 x2 y2 ..."
        raise ReobjError(f"{where}: {shown}, {expected}")
    if max(map(abs, row[1:5])) > NORMALISED_MAX:
        text = f"{max(row[1:5], key=abs):g} is no fraction of the image size"
        raise ReobjError(f"{where}: {text}; expected numbers of 0..1, not pixels")
    return row


def forms(path: Path) -> frozenset[int]:
    """Return what may follow the class in the first label files.

    0: a box or a polygon; 3: a box with keypoints x y visibility; 2: one with keypoints x y.
    Visibilities are 0, 1 or 2. Where they are confidences, or missing, polygons of as many corners
    each are possible too.
    """
    lines = [line for file in label_files(path)[:50] for line in read_lines(file)]
    rows = [line.split() for line in lines if line.strip()]
    try:
        values = np.array(rows, np.float64)  # (N, count)
    except ValueError:  # rows of other lengths, or text
        return frozenset({0})
    count = values.shape[1] if rows else 0
    if count >= 8 and count % 3 == 2 and all(c in ("0", "1", "2") for r in rows for c in r[7::3]):
        return frozenset({3})
    found = {0} | ({3} if count >= 14 and count % 3 != 1 and len(rows) > 1 else set())
    return frozenset(found | ({2} if count >= 11 and _points_in_boxes(values) else set()))


def _points_in_boxes(rows: Array) -> bool:
    """Test whether all points x y after class cx cy w h of (N, count) are in their box, or 0."""
    points = rows[:, 5 : 5 + (rows.shape[1] - 5) // 2 * 2].reshape(len(rows), -1, 2)  # (N, K, 2)
    inside = np.abs(points - rows[:, None, 1:3]) <= rows[:, None, 3:5] / 2 + 1e-3
    return bool((inside | (points == 0)).all())


def _columns(
    rows: Sequence[Sequence[float]], where: Sequence[str]
) -> tuple[Array, Array, IntArray, dict[int, Array]]:
    """Split rows into boxes (N, 4) cx, cy, w, h, scores (N,) and identities (N,), -1: none.

    The corners (K, 2) of polygons are returned by the number of their row.

    Rows of up to seven numbers are boxes with optional confidence and identity (whole); if a
    seventh number is not whole, rows of seven are triangles. Longer rows are polygons, also with
    optional confidence and identity. A single number at the end is the identity if all such are
    whole and one is above 1.
    """
    box = np.zeros((len(rows), 4))
    score = np.ones(len(rows))
    identity = np.full(len(rows), -1, np.int64)
    polygons: dict[int, Array] = {}
    triangles = any(row[6] % 1 for row in rows if len(row) == 7)
    begin = [len(row) - _tail(row) if len(row) > 7 - triangles else 5 for row in rows]
    alone = [row[-1] for row, at in zip(rows, begin, strict=True) if len(row) == at + 1]
    whole = max(alone, default=0) > 1
    for i, (row, at) in enumerate(zip(rows, begin, strict=True)):
        rest = list(row[at:])
        if at > 5:
            corners = np.reshape(row[1:at], (-1, 2))  # (K, 2)
            if np.abs(corners).max() > NORMALISED_MAX:
                raise ReobjError(f"{where[i]}: {len(row)} columns that are no polygon: a corner is "
                                 "no fraction of the image size")  # fmt: skip
            low, high = corners.min(0), corners.max(0)
            box[i] = *(low + high) / 2, *(high - low)
            polygons[i] = corners
        else:
            box[i] = row[1:5]
        if len(rest) == 2 or (rest and whole):
            identity[i] = int(rest.pop())
        score[i] = rest[0] if rest else 1.0
    if whole and any(value % 1 for value in alone):
        raise ReobjError(f"{where[0]}: the last column of the labels holds numbers above 1 and "
                         "fractions: neither confidences nor identities")  # fmt: skip
    return box, score, identity, polygons


def _tail(row: Sequence[float]) -> int:
    """Count the numbers after the corners of a polygon: none, conf, id, or conf and id."""
    if len(row) % 2 == 0:
        return 1
    return 2 if row[-1] > NORMALISED_MAX and row[-1] % 1 == 0 else 0
