"""Recorded detections and tracks of other tools, in one table of readers, checked in one place.

Start at `read_detections` and `read_tracks`. Every reader makes a `RecordedDetections`, which is
then checked here: what cannot be meant is an error that names the line, single rows that are of no
use are dropped and counted in its messages.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reobj.files import did_you_mean, load_json, shortened
from reobj.sources import coco, tables
from reobj.sources.class_names import check_length, load_class_names
from reobj.sources.cvat import read_cvat
from reobj.sources.label_folders import label_files, read_label_folder
from reobj.sources.looked import frames_looked_at, looked_message
from reobj.sources.recorded import (
    NORMALISED_MAX,
    RecordedDetections,
    npz_image_size,
    read_npz,
)
from reobj.sources.tables import read_cells, read_table, recorded_table, seconds, table_of_records
from reobj.sources.video import Video
from reobj.types import (
    CLASS_NAME_MAX,
    COORDINATE_MAX,
    DETECTIONS_MAX,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    Tracks,
    box_iou,
    option,
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
    class_names: str = option(
        "", "class names where they are not COCO's: a text file, one a line, or a data.yaml"
    )
    first_frame: str = option(
        "", "number that a file of detections gives the first frame, 0 or 1 (default: found out)"
    )
    max_detections: int = option(
        0, "most detections that are kept in a frame, best first (0: 100 of a model, all of a file)"
    )


def unnamed_class(class_id: int, count: int) -> str:
    """Write the message about a class id beyond the class names."""
    return (f"class {class_id}, but there are only {count} class names: give a file of names with "
            "--set detect.class_names=FILE")  # fmt: skip


def class_filter(wanted: str, names: Sequence[str]) -> IntArray:
    """Return the ids of comma-separated class names, whatever their case.

    Raises:
        ReobjError: a name that is not among `names`.
    """
    known = {name.lower().replace("_", " "): i for i, name in enumerate(names)}
    chosen = [name.strip().lower().replace("_", " ") for name in wanted.split(",") if name.strip()]
    unknown = [name for name in chosen if name not in known]
    if unknown:
        close = did_you_mean(unknown[0], known) or f" among {', '.join(names)}"
        raise ReobjError(f"--classes: no class {', '.join(unknown)}{close}")
    return np.array([known[name] for name in chosen], np.int64)


def read_detections(
    path: str | Path, video: Video, config: DetectConfig | None = None
) -> RecordedDetections:
    """Read recorded detections of a video, in any format of READERS.

    Args:
        path: the file, or a folder of YOLO labels; boxes in px of the source, frame numbers of the
            source.
        config: min_score, classes, class_names, first_frame and max_detections apply.
    Raises:
        ReobjError: names the file, the line and what was expected there.
    """
    path = Path(path)
    config = config or DetectConfig()
    found = _read(path, video, config)
    _note_looked(found, video.frame_count)
    _check(found, path, config, video.frame_count)
    return found


def _read(path: Path, video: Video, config: DetectConfig) -> RecordedDetections:
    """Read a file of any format as it is, unchecked."""
    if not path.exists():
        raise ReobjError(f"{path}: no such file of detections")
    if config.first_frame not in ("", "0", "1"):
        raise ReobjError(f"detect.first_frame {config.first_frame}: expected 0 or 1")
    names = load_class_names(config.class_names) if config.class_names else ()
    try:
        return READERS[_kind(path)](path, names, video, config.first_frame)
    except ReobjError:
        raise
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise ReobjError(f"{path}: an entry is not as expected: {error!r}") from error


def _note_looked(found: RecordedDetections, frame_count: int) -> None:
    """Note which frames the detector was run on: those that the file lists, else inferred."""
    listed = found.looked is not None
    if found.looked is None:
        found.looked = frames_looked_at(found.frame, frame_count)
    elif not 0 < len(found.looked) < (frame_count or sys.maxsize):
        found.looked = None
    if found.looked is not None:
        found.messages.append(looked_message(found.looked, listed))


Reader = Callable[[Path, Sequence[str], Video, str], RecordedDetections]
READERS: dict[str, Reader] = {
    "npz": lambda path, _, video, __: read_npz(path, video.size, video.working_size)[0],
    "json": lambda path, names, video, first: _read_json(path, names, video, first),
    "cvat": lambda path, _, video, first: read_cvat(path, video, first),
    "folder": read_label_folder,
    "table": read_table,
}
SUFFIXES = {".npz": "npz", ".json": "json", ".xml": "cvat", ".zip": "cvat"}  # others: table


def _read_json(path: Path, names: Sequence[str], video: Video, first: str) -> RecordedDetections:
    """Read a table of records, or one of COCO's kinds."""
    data = load_json(path)
    table = table_of_records(path, data)
    if table is not None:
        return recorded_table(table, names, video, first)
    return coco.read_coco(path, data, names, video, first)


def _kind(path: Path) -> str:
    """Return the reader that a file is for."""
    return "folder" if path.is_dir() else SUFFIXES.get(path.suffix.lower(), "table")


def recorded_times(path: Path) -> Array | None:
    """Return the distinct times in s, ascending, of a table with times and without frames."""
    if _kind(path) != "table":
        return None
    table = read_cells(path)
    if "time" not in table.cells or "frame" in table.cells or "image" in table.cells:
        return None
    return np.unique(seconds(table))


def image_size(path: Path) -> tuple[int, int] | None:
    """Return the (w, h) of the images that a file of detections was made for, if it says so."""
    kind = _kind(path)
    if kind == "npz":
        return npz_image_size(path)
    return coco.image_size_of(coco.dataset_of(path, load_json(path))) if kind == "json" else None


def image_names(path: Path) -> list[str]:
    """List the images that a file of detections or a dataset beside it names; [] where none."""
    kind = _kind(path)
    if kind == "json":
        return coco.image_names_of(path, load_json(path))
    if kind == "folder":
        return [str(file.relative_to(path)) for file in label_files(path)]
    return tables.image_names_of(read_cells(path)) if kind == "table" else []


def _check(found: RecordedDetections, path: Path, config: DetectConfig, frame_count: int) -> None:
    """Check detections of any format, drop what is not used and sort the rest by frame and score.

    Errors for what cannot be meant, messages for single rows.
    """
    _check_rows(found, path)
    keep = _usable(found, path, frame_count)
    _check_scores(found)
    if (low := keep & (found.score < config.min_score)).any():
        text = f"{low.sum()} of {len(found)} boxes have a score below {config.min_score:g}"
        found.messages.append(f"{text} (detect.min_score): left out")
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
    found.select(_most(found, rows, path, config.max_detections))
    found.messages[:] = [f"{path.name}: {text}" for text in found.messages]


def _check_rows(found: RecordedDetections, path: Path) -> None:
    """Refuse values and masks that cannot be meant; names the first row at fault."""
    with np.errstate(invalid="ignore", over="ignore"):  # inf - inf
        finite = np.isfinite(found.xyxy.sum(1) + found.score)  # (N,)
    finite &= (np.abs(found.xyxy) <= COORDINATE_MAX).all(1)
    named = np.isin(found.class_id, np.arange(len(found.class_names)))
    lengths = np.array([*map(len, found.class_names), 0])
    short = lengths[np.where(named, found.class_id, -1)] <= CLASS_NAME_MAX
    pixels = np.array([runs.sum() for runs in found.runs], np.int64)  # (N,)
    masked = np.array([len(runs) > 0 for runs in found.runs], bool)
    fits = ~masked | (pixels == math.prod(found.size))
    for row in np.flatnonzero(~(finite & named & short & fits))[:1]:
        where = f"{path}, {found.unit} {found.line[row]}"
        text = f"mask of {pixels[row]} pixels in a video of {found.size}"
        if not finite[row]:
            text = f"{found.xyxy[row]}, {found.score[row]}: NaN, infinite or beyond 1e7 pixels"
        elif not named[row]:
            text = unnamed_class(int(found.class_id[row]), len(found.class_names))
        elif not short[row]:
            check_length(found.class_names[found.class_id[row]], where)
        raise ReobjError(f"{where}: {text}")
    for name in found.class_names:
        check_length(name, f"{path}, class names")


PERCENT = 100.0
PERCENT_MIN = 2.0  # a file whose best detection has 2 % holds no percents


def _check_scores(found: RecordedDetections) -> None:
    """Bring scores to [0, 1] and say how: no scores at all, percents, or clipped."""
    low = found.score.min(initial=0)
    high = found.score.max(initial=0)
    if len(found) and (found.score == -1).all():
        found.messages.append("scores are all -1: taken as 1")
        found.score = -found.score
    elif PERCENT_MIN < high <= PERCENT and low >= 0:
        found.messages.append(f"scores from {found.score.min():g} to {high:g} are taken as percent")
        found.score = found.score / PERCENT
    elif low < 0 or high > 1:
        out = (found.score < 0) | (found.score > 1)
        text = f"scores from {found.score.min():g} to {high:g} clipped to [0, 1]"
        found.messages.append(f"{text}: {out.sum()} of {len(found)} boxes")
        found.score = np.clip(found.score, 0, 1)


def _most(found: RecordedDetections, rows: IntArray, path: Path, most: int) -> IntArray:
    """Keep of the rows, sorted by frame and score, the best `most` (0: all) of each frame."""
    frame = found.frame[rows]
    rank = np.arange(len(rows)) - np.searchsorted(frame, frame)  # within its frame
    if most and (rank >= most).any():
        text = f"{(rank >= most).sum()} boxes beyond the best {most} of a frame left out"
        found.messages.append(f"{text} (detect.max_detections)")
        return rows[rank < most]
    if (worst := int(rank.max(initial=-1)) + 1) > DETECTIONS_MAX:
        text = f"{worst} boxes in frame {frame[rank.argmax()]} (0-based)"
        advice = "raise detect.min_score, or keep the best with --set detect.max_detections=N"
        raise ReobjError(f"{path}: {text}, at most {DETECTIONS_MAX} are allowed; {advice}")
    return rows


UNUSABLE_SHARE = 0.5  # chosen: where most boxes are of no use, it is the format that is wrong
EDGE_PX = 1.0  # chosen: detectors round boxes at the border to whole pixels


def _usable(found: RecordedDetections, path: Path, frame_count: int) -> BoolArray:
    """Tell which boxes (N,) have an area, touch the image and belong to a frame of the video."""
    count = len(found)
    low = found.xyxy[:, :2]
    high = found.xyxy[:, 2:]
    empty = (high <= low).any(1)  # (N,)
    outside = np.logical_and(~empty, ((high <= 0) | (low >= np.array(found.size))).any(1))
    missing = (found.frame < 0) | (found.frame >= (frame_count or sys.maxsize))
    if count and found.xyxy.max() <= NORMALISED_MAX:
        raise ReobjError(f"{path}: no coordinate above {NORMALISED_MAX}: normalised to 0..1? "
                         "Multiply them by the image size")  # fmt: skip
    if reading := _other_reading(found.xyxy, found.size):
        raise ReobjError(f"{path}: {reading}")
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


def _other_reading(xyxy: Array, size: tuple[int, int]) -> str:
    """Name what boxes (N, 4) fit that cannot be meant as they are, "" where they can.

    A box with its second corner before the first, or with its centre outside the image, cannot.
    Then the usual mistakes are tried; one counts if all boxes fit the image with it.
    """
    image = np.array(size, np.float64)
    centre = (xyxy[:, :2] + xyxy[:, 2:]) / 2
    inverted = (xyxy[:, 2:] < xyxy[:, :2]).any(1)
    beyond = ((centre < 0) | (centre > image)).any(1)
    if not (inverted | beyond).any():
        return ""
    why = f"{inverted.sum()} of {len(xyxy)} boxes have x2 < x1 or y2 < y1 and {beyond.sum()} have "
    why += f"their centre outside the image of {size}"
    added = np.hstack([xyxy[:, :2], xyxy[:, :2] + xyxy[:, 2:]])
    taken = np.hstack([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]])
    for box, limit, what in (
        (xyxy, image[::-1], f"all fit the frame turned by 90 deg, {size[::-1]}: made on frames "
                            "that were not turned upright? Detect on upright frames"),
        (added, image, "all fit it as x, y, w, h: name the columns so, or give corners"),
        (taken, image, "all fit it if w and h are the corner x2, y2: name them so, or give sizes"),
    ):  # fmt: skip
        inside = (box >= -EDGE_PX).all(1) & (box[:, :2] <= box[:, 2:]).all(1)
        if (inside & (box[:, 2:] <= limit + EDGE_PX).all(1)).all():
            return f"{why}; {what}"
    return ""


SAME_BOX = 0.95  # overlap (IoU) from which a box of a tracks file counts as the tracker's own
SAME_OBJECT = 0.5  # overlap (IoU) from which two boxes show one object (PASCAL VOC)


def read_tracks(
    path: str | Path,
    video: Video,
    config: DetectConfig | None = None,
    known: Tracks | None = None,
    known_names: Sequence[str] = (),
) -> tuple[Tracks, tuple[str, ...], list[str]]:
    """Read identities made elsewhere or corrected by hand.

    Args:
        path: any file of `read_detections` that has identities: CVAT for video 1.1 (XML or its
            zip), COCO (track_id or instance_id, also in CVAT's attributes), MOT, KITTI, CSV,
            YOLO labels; frames that the video's options leave out are not used.
        known, known_names: earlier tracks of the video and their class names: they lend their
            scores to boxes that were not moved, and their classes to files that have none.
    Returns:
        tracks, their class names, and messages for the user.
    """
    path = Path(path)
    config = config or DetectConfig()
    limit = dataclasses.replace(config, min_score=0.0, max_detections=0)
    found = _read(path, video, limit)
    _check(found, path, limit, video.frame_count)
    if len(found):
        _check_identities(found, path)
    start = video.config.start
    stop = video.config.stop
    every = video.config.every
    use = (found.frame >= start) & ((found.frame - start) % every == 0)
    use &= found.frame < (stop or sys.maxsize)
    pairs = np.column_stack([found.frame, found.identity])[use]  # (N, 2)
    unique, first, count = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        frame, identity = unique[count.argmax()]
        raise ReobjError(f"{path}: identity {identity} has {count.max()} boxes in frame {frame} "
                         "(0-based); an object is in one place at a time")  # fmt: skip
    rows = np.flatnonzero(use)[first]
    ids = found.identity[rows]
    unknown = np.full(len(rows), -1, np.int64)
    columns = (found.xyxy[rows], found.score[rows], found.class_id[rows], unknown)
    tracks = Tracks(found.frame[rows], ids, ids, *columns)
    names = found.class_names
    if known is not None:
        unnamed = names == ("object",)
        tracks = _lend(known, tracks, unnamed)
        names = tuple(known_names) if unnamed else names
        if unnamed:
            without = (tracks.class_id < 0).sum()
            text = f"{path.name}: no classes: {len(tracks) - without} boxes have the class of the "
            found.messages.append(f"{text}earlier object that they show, {without} are `object`")
    return tracks, names, found.messages


def _check_identities(found: RecordedDetections, path: Path) -> None:
    """Leave out boxes without an identity (-1), and count from 1; refuse a file without any."""
    has = found.identity >= 0 if len(found.identity) else np.zeros(len(found), bool)
    if not has.any():
        raise ReobjError(f"{path}: not every box has an identity, none has: no file of tracks")
    if not has.all():
        text = f"{path.name}: {(~has).sum()} of {len(found)} boxes without an identity left out"
        found.messages.append(text)
        found.select(np.flatnonzero(has))
    if found.identity.min() == 0:
        found.messages.append(f"{path.name}: there is an identity 0: 1 is added to all of them")
        found.identity = found.identity + 1


def _lend(known: Tracks, tracks: Tracks, unnamed: bool) -> Tracks:
    """Give unmoved boxes their earlier scores, and unnamed objects their class.

    The class is that of the earlier boxes that overlap an object's most, in sum over its frames,
    -1 where none shows it.
    """
    class_id = tracks.class_id.copy()
    score = tracks.score.copy()
    overlap = np.zeros(len(tracks))
    old_class = np.full(len(tracks), -1, np.int64)
    for rows in rows_by(tracks.frame):
        there = known[known.frame == tracks.frame[rows[0]]]
        if not len(there):
            continue
        iou = box_iou(tracks.xyxy[rows], there.xyxy)  # (n, m)
        best = iou.argmax(1)
        most = iou.max(1)
        same = most > SAME_BOX
        score[rows[same]] = there.score[best[same]]
        overlap[rows] = np.where(most >= SAME_OBJECT, most, 0)
        old_class[rows] = np.where(most >= SAME_OBJECT, there.class_id[best], -1)
    if unnamed:
        for rows in rows_by(tracks.track_id):
            votes = rows[old_class[rows] >= 0]
            shares = np.bincount(old_class[votes], overlap[votes])
            class_id[rows] = int(shares.argmax()) if len(votes) else -1
    return dataclasses.replace(tracks, class_id=class_id, score=score)
