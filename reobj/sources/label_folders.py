"""Folders of YOLO labels: a text file an image, `class cx cy w h [conf] [id]` or polygons.

Coordinates are fractions of the image size.
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
from reobj.sources.recorded import NORMALISED_MAX, RecordedDetections
from reobj.sources.video import Video
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError, xyxy_from_cxcywh


def label_files(path: Path) -> list[Path]:
    """List the label files of a folder, or of the label folders of a dataset in it."""
    folders = {"labels", "obj_train_data"}  # of YOLO datasets, and of CVAT's export of YOLO 1.1
    no_labels = ("classes.txt", "train.txt", "val.txt", "valid.txt", "test.txt", "readme.txt",
                 "readme.dataset.txt", "readme.roboflow.txt", "requirements.txt")  # fmt: skip
    files = [p for p in path.glob("*.txt") if p.name.lower() not in no_labels]
    if not files or any((path / name).is_dir() for name in folders):
        files = [p for p in path.rglob("*.txt") if p.name.lower() not in no_labels]
        files = [p for p in files if folders & set(p.relative_to(path).parts[:-1])]
    if not files:
        raise ReobjError(f"{path}: a folder without label files; expected YOLO's NAME.txt, one an "
                         "image, in it or in its folder labels/")  # fmt: skip
    return sorted(files)


def names_file(path: Path) -> Path | None:
    """Find the file of class names of a folder of labels: in it, or in one of two folders above."""
    labels = path.resolve()
    known = ("classes.txt", "obj.names", "data.yaml", "dataset.yaml", "data.yml", "dataset.yml")
    for folder in (labels, *labels.parents[:2]):
        for name in known:
            if (folder / name).is_file():
                return folder / name
        for file in sorted(filter(is_yaml, folder.glob("*"))):
            if any(line.startswith("names") for line in read_lines(file)):
                return file
    return None


def read_label_folder(
    path: Path, names: Sequence[str], video: Video, first: str = ""
) -> RecordedDetections:
    """Read a folder of YOLO labels.

    NAME.txt belongs to the image of that name; NAME_N.txt to frame N of a video (from 1, as in
    ultralytics, if NAME is that of the video).

    Args:
        names: class names by number; (): from a file beside the labels, else COCO's.
        first: number of the first frame, "": inferred.
    """
    files = label_files(path)
    messages = [f"a folder of YOLO labels: {len(files)} files"]
    of_video = re.compile(re.escape(Path(video.source).stem) + r"_\d+")
    video_files = [] if video.names else [f for f in files if of_video.fullmatch(f.stem)]
    if video_files and len(video_files) < len(files):
        count = len(files) - len(video_files)
        messages.append(f"{count} files of other names than the video's left out")
        files = video_files
    if not names and (beside := names_file(path)) is not None:
        names = load_class_names(beside)
        messages.append(f"class names of {beside.name}")
    elif not names:
        messages.append("no class names beside it: class numbers are taken as COCO's 80")
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
    box, score, identity, polygons = _columns(rows)
    stems = [str(file.relative_to(path)) for file in files]
    usual = 1 if video_files else None
    frame, text = frames_of_names(stems, video, str(path), first, usual, not video_files)
    messages += [text] if text else []
    scaled = xyxy_from_cxcywh(box) * np.tile(np.array(video.size, np.float64), 2)
    runs = [NO_RUNS] * len(rows)
    for row, corners in polygons.items():
        runs[row] = polygon_runs([(corners * video.size).ravel().tolist()], video.size)
    return RecordedDetections(
        frame[np.array(of_file, np.int64)], scaled, score,
        np.array([row[0] for row in rows], np.float64).astype(np.int64), runs,
        tuple(names or COCO_NAMES), video.size, video.working_size, np.array(lines, object), "line",
        messages, identity,
    )  # fmt: skip


def _row(cells: Sequence[str], where: str) -> list[float]:
    """Read the numbers of a line, the class first."""
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        raise ReobjError(f"{where}: {' '.join(cells)[:60]!r}, expected numbers: class cx cy w h "
                         "[conf] [id]") from None  # fmt: skip
    if len(row) < 5 or not np.isfinite(row).all() or row[0] % 1 or not 0 <= row[0] < 1 << 31:
        raise ReobjError(f"{where}: {' '.join(cells)[:60]!r}, expected class cx cy w h [conf] [id] "
                         "or class x1 y1 x2 y2 ...")  # fmt: skip
    coordinates = row[1:5] if len(row) < 8 else row[1 : len(row) - 2]
    if np.abs(coordinates).max() > NORMALISED_MAX:
        raise ReobjError(f"{where}: {max(coordinates, key=abs):g} is no fraction of the image "
                         "size; expected numbers of 0..1, not pixels")  # fmt: skip
    return row


def _columns(
    rows: Sequence[Sequence[float]],
) -> tuple[Array, Array, IntArray, dict[int, Array]]:
    """Split rows into boxes (N, 4) cx, cy, w, h, scores (N,) and identities (N,), -1: none.

    The corners (K, 2) of polygons are returned by the number of their row.

    Rows of up to seven numbers are boxes with optional confidence (at most 1) and identity (whole);
    if a seventh number is not whole, rows of seven are triangles. Longer rows are polygons, also
    with optional confidence and identity.
    """
    count = len(rows)
    box = np.zeros((count, 4))
    score = np.ones(count)
    identity = np.full(count, -1, np.int64)
    polygons: dict[int, Array] = {}
    seventh = [row[6] for row in rows if len(row) == 7]
    triangles = any(value % 1 for value in seventh)
    for i, row in enumerate(rows):
        polygon = len(row) > 7 or (len(row) == 7 and triangles)
        rest = row[5:] if not polygon else _tail(row)
        if polygon:
            corners = np.reshape(row[1 : len(row) - len(rest)], (-1, 2))
            low = corners.min(0)
            high = corners.max(0)
            box[i] = *(low + high) / 2, *(high - low)
            polygons[i] = corners
        else:
            box[i] = row[1:5]
        for value in rest:
            if value > 1 or (value % 1 == 0 and len(rest) == 2 and value == rest[1]):
                identity[i] = int(value)
            else:
                score[i] = value
    return box, score, identity, polygons


def _tail(row: Sequence[float]) -> Sequence[float]:
    """Return the numbers after the corners of a polygon: [], [conf], [id] or [conf, id]."""
    if len(row) % 2 == 0:
        return row[-1:]
    return row[-2:] if row[-1] > NORMALISED_MAX and row[-1] % 1 == 0 else []
