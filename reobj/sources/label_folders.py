"""Folders of YOLO labels: a text file an image, `class cx cy w h [conf] [id]` or polygons.

Coordinates are fractions of the image size. Keypoints after `class cx cy w h` are not read.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reobj.files import LINES_MAX, read_lines, read_text
from reobj.sources.class_names import is_yaml, load_class_names
from reobj.sources.recorded import (
    CENTRES,
    NO_RUNS,
    NORMALISED_MAX,
    RecordedDetections,
    Source,
    frames_of_names,
    polygon_runs,
)
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError, cxcywh_from_xyxy

NO_LABELS = ("classes.txt train.txt val.txt valid.txt test.txt readme.txt readme.dataset.txt "
             "readme.roboflow.txt requirements.txt labels.txt").split()  # fmt: skip
NAMES_FILES = (
    "classes.txt obj.names data.yaml dataset.yaml data.yml dataset.yml labels.txt _darknet.labels"
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
        other = [*sorted(filter(is_yaml, folder.glob("*"))), *folder.glob("notes.json")]
        for file in (*filter(Path.is_file, known), *other):
            if file in known or re.search(r'^names|"categories"', read_text(file), re.MULTILINE):
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
    named = [f for f in files if of_video.fullmatch(f.stem) and not video.names]
    others = len(files) - len(named)
    source.say(f"{others} files of other names than the video's left out" * bool(named and others))
    files = named or files
    rows = list[list[float]]()
    lines = list[str]()
    of_file = list[int]()
    for at, file in enumerate(files):
        for number, line in enumerate(read_lines(file), 1):
            if line.strip():
                rows.append(_row(line, f"{file}, line {number}"))
                lines.append(f"{number} of {file.name}")
                of_file.append(at)
        if len(rows) > LINES_MAX:
            raise ReobjError(f"{path}: more than {LINES_MAX} boxes; take fewer frames")
    if pose:
        rows = [row[:5] + row[len(row) - (len(row) - 5) % pose :] for row in rows]
        source.say("keypoints after class cx cy w h are not read")
    triangles = any(row[6] % 1 for row in rows if len(row) == 7)  # else of box, conf and id
    begin = [len(row) - _tail(row) if len(row) > 7 - triangles else 5 for row in rows]
    box = np.array([row[1:5] for row in rows]).reshape(-1, 4)
    runs = [NO_RUNS] * len(rows)
    for i in np.flatnonzero(np.array(begin) > 5).tolist():
        points = np.reshape(rows[i][1 : begin[i]], (-1, 2))
        if np.abs(points).max() > NORMALISED_MAX:
            raise ReobjError(f"{path}, line {lines[i]}: {len(rows[i])} columns that are no polygon:"
                             " a corner is no fraction of the image size")  # fmt: skip
        box[i] = cxcywh_from_xyxy(np.hstack([points.min(0), points.max(0)])[None])[0]
        if not source.describes:
            runs[i] = polygon_runs([points * video.size], video.size)
    six = np.array([row[2:] for row in rows if len(row) == 6]).reshape(-1, 4)
    if len(six) == len(box) and _leaving(box) > 0.1 and _leaving(six) < 0.02:
        raise ReobjError(f"{path}: boxes that leave the image as class cx cy w h conf fit it as "
                         "class conf cx cy w h: write the confidence after the box")  # fmt: skip
    score, identity = _tails([row[at:] for row, at in zip(rows, begin, strict=True)], path)
    stems = [str(file.relative_to(path)) for file in files]
    frame = frames_of_names(stems, source, 1 if named else None)
    kinds = np.array([row[0] for row in rows], np.int64)
    return source.recorded(
        frame[np.array(of_file, np.int64)], box, (kinds, _names(source)), CENTRES,
        np.tile(video.size, 2), "line", score=score, runs=runs, line=np.array(lines, object),
        identity=identity,
    )  # fmt: skip


def _leaving(box: Array) -> float:
    """Return the fraction of boxes (N, 4), cx cy w h in image sizes, that leave the image."""
    reach = np.abs(box[:, :2] - 0.5) + box[:, 2:] / 2
    return float((reach > 0.502).any(1).mean()) if len(box) else 0.0  # rounded numbers


def _names(source: Source) -> Sequence[str]:
    """Return the class names: the user's, those of a file beside the labels, else COCO's."""
    if source.names:
        return source.names
    if beside := names_file(source.path):
        source.say(f"class names of {beside}")
        return load_class_names(beside)
    source.say("no class names beside it: class numbers are taken as COCO's 80")
    return COCO_NAMES


def _row(line: str, where: str) -> list[float]:
    """Read the numbers of a line, the class first."""
    row = list[float]()
    with contextlib.suppress(ValueError):
        row = [float(cell) for cell in line.split()]
    if len(row) < 5 or not np.isfinite(row).all() or row[0] % 1 or not 0 <= row[0] < 1 << 31:
        expected = "expected class cx cy w h [conf] [id] or class x1 y1 x2 y2 ..., all numbers"
        raise ReobjError(f"{where}: {line.strip()[:60]!r}, {expected}")
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


def _tails(tails: Sequence[Sequence[float]], path: Path) -> tuple[Array, IntArray]:
    """Return scores and identities (N,), -1: none, of the numbers after boxes and polygons.

    Two are confidence and identity. One is the confidence; or the identity, if all such are whole
    and one is above 1.
    """
    alone = np.array([tail[0] for tail in tails if len(tail) == 1])
    whole = bool((alone > 1).any())
    if whole and (alone % 1).any():
        raise ReobjError(f"{path}: the last column of the labels holds numbers above 1 and "
                         "fractions: neither confidences nor identities")  # fmt: skip
    pairs = [tail if len(tail) != 1 else (1, tail[0]) if whole else (tail[0], -1) for tail in tails]
    columns = np.array([pair or (1, -1) for pair in pairs], np.float64).reshape(-1, 2)
    return columns[:, 0], columns[:, 1].astype(np.int64)


def _tail(row: Sequence[float]) -> int:
    """Count the numbers after the corners of a polygon: none, conf, id, or conf and id."""
    if len(row) % 2 == 0:
        return 1
    return 2 if row[-1] > NORMALISED_MAX and row[-1] % 1 == 0 else 0
