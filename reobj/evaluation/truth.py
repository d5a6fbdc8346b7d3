"""Readers of ground truth and results: boxes with identities and classes.

Start at `read_truth` and `read_result`. Formats of truth (TRUTH) are those of detections with
identities; of MOTChallenge rows and files of the same form (CVAT's MOT 1.1, DanceTrack, our rooms)
the columns of ground truth are read too. Assumptions about a file are reported in `notes`.
"""

from __future__ import annotations

import configparser
import dataclasses
import enum
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from reobj.files import load_json, read_lines, shortened
from reobj.formats import AUTO, Format, Registry
from reobj.results.entries import OutputFile
from reobj.results.result import Result
from reobj.sources.detection_files import DETECTIONS, FROM_1, Reader, check_rows, read_source
from reobj.sources.recorded import SIZES, Source, corners, other_form
from reobj.sources.tables import forms, read_mot_rows
from reobj.sources.video import ImagelessVideo
from reobj.types import CLASS_MAX, Array, BoolArray, IntArray, ReobjError, Tracks, counted
from reobj.words import among, canonical

TruthReader = Callable[[Source, float], "LabelledBoxes"]


class Role(enum.IntEnum):
    """What a true box counts for."""

    SCORED = 0
    IGNORED = 1  # does not count; boxes of the result that match it are dropped
    ABSENT = 2  # left out


@dataclass(frozen=True, slots=True)
class LabelledBoxes:
    """Boxes of a video with identities and classes: ground truth or result.

    Attributes (N rows in any order):
        frame: (N,) from 1, as in MOTChallenge files. identity: (N,). xyxy: (N, 4) native pixels.
        name: (N,) class names; "" matches every class.
        role: (N,) Role.SCORED, Role.IGNORED or Role.ABSENT; all Role.SCORED in a result.
        listed: (F,) frames that the file of the truth lists; None: it lists none.
    """

    frame: IntArray
    identity: IntArray
    xyxy: Array
    name: npt.NDArray[np.str_]
    role: IntArray
    listed: IntArray | None = None

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, keep: Any) -> LabelledBoxes:
        columns = ("frame", "identity", "xyxy", "name", "role")
        return dataclasses.replace(self, **{name: getattr(self, name)[keep] for name in columns})


def labelled(rows: Array, name: Any = "", role: Any = Role.SCORED) -> LabelledBoxes:
    """Convert MOTChallenge rows (N, 6+) to labelled boxes; name, role: for all rows, or (N,)."""
    frame, identity = rows[:, :2].T.astype(np.int64)
    names = np.broadcast_to(np.asarray(name, str), len(rows))
    roles = np.broadcast_to(np.asarray(role, np.int64), len(rows))
    return LabelledBoxes(frame, identity, corners(rows[:, 2:6], SIZES), names, roles)


def of_tracks(tracks: Tracks, class_names: Sequence[str]) -> LabelledBoxes:
    """Convert tracks of a result; class -1 is unknown."""
    names = np.array([*class_names, ""], str)[tracks.class_id]
    role = np.full(len(tracks), Role.SCORED)
    return LabelledBoxes(tracks.frame + 1, tracks.track_id, tracks.xyxy, names, role)


def read_truth(
    path: Path,
    class_names: Sequence[str],
    min_visibility: float,
    notes: list[str] | None = None,
    size: tuple[int, int] = (0, 0),
    fmt: str = AUTO,
    first: str = "",
) -> LabelledBoxes:
    """Read true boxes in any of the formats TRUTH.

    Args:
        class_names: by the numbers of files that do not name their classes (from 0).
        min_visibility: rows of lower visibility are Role.IGNORED.
        notes: assumptions about the file are appended. size: (w, h) of the video, (0, 0): unknown.
        fmt: a format of TRUTH, or auto. first: number of the first frame, "": as the format says.
    Raises:
        ReobjError: the file cannot be read, or an identity has two boxes in a frame.
    """
    reader = TRUTH.find(path, fmt).read
    if first not in ("", "0", "1"):
        raise ReobjError(f"detect.first_frame {first}: expected 0 or 1 for ground truth")
    notes = [] if notes is None else notes
    source = Source(path, ImagelessVideo(path, size), class_names, first, messages=notes)
    truth = reader(source, min_visibility)
    _check_identities(truth, path)
    return truth


def _read_labelled(entry: Format[Reader], source: Source, _: float) -> LabelledBoxes:
    """Read a format of detections with identities as ground truth."""
    path = source.path
    source.names = ()  # the file has its own
    recorded = read_source(source, entry.read)
    check_rows(recorded, path)
    sizes = {source.video.size, *source.image_sizes} - {(0, 0)}
    image = min(sizes) if len(sizes) == 1 else (0, 0)
    if fault := other_form(recorded.xyxy, recorded.form, image, recorded.frame, recorded.identity):
        raise ReobjError(f"{path}: {fault}")
    names = np.array([*recorded.class_names, ""], str)[recorded.class_id]
    role = np.full(len(recorded), Role.SCORED)
    role[recorded.ignored] = Role.IGNORED
    if entry.name == "kitti":
        names[recorded.ignored] = ""
        source.say("KITTI's labels: frames from 0; boxes on DontCare do not count; KITTI's rules "
                   "of distractors, occlusion and height are not applied")  # fmt: skip
    listed = None if recorded.detector_ran is None else recorded.detector_ran + 1
    ids = recorded.identity
    return LabelledBoxes(recorded.frame + 1, ids, recorded.xyxy, names, role, listed)


def read_result(out: Path, notes: list[str] | None = None) -> LabelledBoxes:
    """Read boxes, identities and classes of an output folder; or MOT rows, without classes.

    Args:
        notes: assumptions about the file are appended.
    """
    if out.is_dir():
        result = Result.load(out)
        predicted = of_tracks(result.tracks, result.class_names)
        out = out / OutputFile.TRACKS
    else:
        rows = _checked(read_mot_rows(out), out, [] if notes is None else notes)
        predicted = labelled(rows)
    _check_identities(predicted, out)
    return predicted


# Classes of MOTChallenge (TrackEval 1.3.0, mot_challenge_2d_box.py)
PEDESTRIAN = 1
# boxes on a person on a vehicle, a static person, a distractor or a reflection do not count
DISTRACTORS = (2, 7, 8, 12)
NON_MOTORISED_VEHICLE = 6  # a distractor of MOT20 only


def _read_mot(source: Source, min_visibility: float) -> LabelledBoxes:
    """Read MOTChallenge rows.

    Column 7 is a flag (0: the row does not count). In files of nine columns, column 8 is the class
    and column 9 the visibility; MOT15 has ten columns, with world coordinates instead.
    """
    path = source.path
    sequence = _sequence(path)
    size = source.video.size
    sides = [sequence.get(key, "") for key in ("imwidth", "imheight")]
    if 0 in size and all(map(str.isdecimal, sides)):
        size = (int(sides[0]), int(sides[1]))
    rows = _checked(read_mot_rows(path), path, source.messages, source.first, size)
    flagged = rows[:, 6] == 0 if rows.shape[1] > 6 else np.zeros(len(rows), bool)
    length = sequence.get("seqlength", "")
    last = rows[:, 0].max(initial=0)
    if length.isdecimal() and last > int(length):  # refused by TrackEval too
        known = f"seqinfo.ini says seqLength={length}"
        raise ReobjError(f"{path}: frame {last:.0f}, but {known}: truth of another sequence?")
    if rows.shape[1] != 9:
        return labelled(rows, "", flagged * Role.ABSENT)
    number = rows[:, 7].clip(-CLASS_MAX, CLASS_MAX).astype(np.int64)
    names, role, note = _mot_classes(number, flagged, source, sequence)
    source.say(note)
    occluded = (rows[:, 8] < min_visibility) & (role == Role.SCORED)
    return labelled(rows, names, np.where(occluded, Role.IGNORED, role))


def _mot_classes(
    number: IntArray, flagged: BoolArray, source: Source, sequence: dict[str, str]
) -> tuple[Any, IntArray, str]:
    """Interpret the classes (N,) of MOTChallenge rows, and their flags (N,): 0 in the file.

    Returns:
        class names, (N,) or of all rows; roles (N,); the interpretation, for the user.
    """
    labels = source.path.with_name("labels.txt")
    stated = source.path.with_name("gt_mot_format.json")
    absent = flagged * Role.ABSENT
    if labels.exists():
        lines = np.array(["", *(line.strip() for line in read_lines(labels))])
        if number.max(initial=0) >= len(lines):
            found = f"class {number.max()}, but {labels} has {len(lines) - 1} lines"
            raise ReobjError(f"{source.path}: {found}")
        note = f"classes are lines of {labels.name}, from 1 (CVAT's MOT 1.1)"
        return lines[number.clip(0)], absent, note
    if stated.exists():
        names = _names_of(number, load_json(stated)["classes"])
        return names, flagged * Role.IGNORED, f"classes are named by {stated.name}"
    benchmark, why = _benchmark(sequence.get("name", ""), source.path, number, flagged)
    if benchmark:
        role = (flagged | (number != PEDESTRIAN)) * Role.ABSENT
        role[np.isin(number, DISTRACTORS)] = Role.IGNORED
        if benchmark == "MOT20":
            role[number == NON_MOTORISED_VEHICLE] = Role.IGNORED
        return "", role, (f"classes are {benchmark}'s, by {why}: pedestrians count, boxes on "
                          "distractors do not")  # fmt: skip
    if (number < 0).all() or (sequence and (number == PEDESTRIAN).all()):
        by = " (class 1, by seqinfo.ini)" if sequence else ""
        note = f"the truth has one class without a name{by}: classes do not count"
        return "", absent, note
    unnamed = number < 0
    note = "class numbers of the truth are those of the detector (COCO's), from 0"
    if unnamed.any():
        boxes = counted(int(unnamed.sum()), "true box", "true boxes")
        note += f"; {boxes} without a class (below 0) do not count, nor do boxes on them"
    by_number = {str(i): name for i, name in enumerate(source.names)}
    named = np.where(unnamed, "", _names_of(number, by_number))
    return named, (flagged | unnamed) * Role.IGNORED, note


WITH_IDENTITIES = "visdrone kitti csv records coco cvat".split()
TRUTH: Registry[TruthReader] = Registry("ground truth", "--gt-format", [
    Format("mot", "MOTChallenge, CVAT's MOT 1.1, DanceTrack: rows of 6 to 10 numbers",
           lambda probe: bool(forms(probe) & {"mot", "boxmot"}), _read_mot, FROM_1, "px",
           "x, y, z in ten columns", kind="text"),
    *(dataclasses.replace(entry, read=partial(_read_labelled, entry))
      for entry in cast(Sequence[Any], DETECTIONS.formats) if entry.name in WITH_IDENTITIES),
])  # fmt: skip


def _checked(
    rows: Array, path: Path, notes: list[str], begin: str = "", size: tuple[int, int] = (0, 0)
) -> Array:
    """Refuse rows of another form; return them with frames that count from 1."""
    frame, identity = rows[:, :2].T.astype(np.int64)
    if fault := other_form(corners(rows[:, 2:6], SIZES), SIZES, size, frame, identity):
        raise ReobjError(f"{path}: {fault}")
    first = frame.min(initial=1)
    if first < int(begin or 0):
        expected = f"from {begin}" if begin else "from 1, or from 0"
        raise ReobjError(f"{path}: frame {first}; expected frames {expected}")
    for at in np.flatnonzero((rows[:, 4:6] < 0).any(1))[:1]:
        where = f"frame {frame[at]}, identity {identity[at]}"
        expected = "expected left,top,width,height"
        raise ReobjError(f"{path}, {where}: width or height below 0; {expected}")
    if first == 0 or begin == "0":
        why = f"{path.name} has a frame 0: its" if first == 0 else f"{path.name}: its"
        notes.append(f"{why} frames are taken as 0-based")
        rows = rows + np.eye(1, rows.shape[1])
    return rows


def _sequence(path: Path) -> dict[str, str]:
    """Return the section Sequence of the seqinfo.ini beside the gt folder; {} without the file."""
    file = path.parent.parent / "seqinfo.ini"
    if not file.exists():
        return {}
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string("\n".join(read_lines(file)))
    except configparser.Error as error:
        raise ReobjError(f"{file}: {error}; expected [Sequence] with name, seqLength") from error
    return dict(parser["Sequence"]) if parser.has_section("Sequence") else {"name": ""}


def _benchmark(name: str, path: Path, number: IntArray, flagged: BoolArray) -> tuple[str, str]:
    """Return the MOTChallenge benchmark whose classes a file has, "": none, and what shows it.

    By the name of the sequence or of its folder; else by the rows: all have classes 1 to 13, and
    exactly those of other classes than pedestrians have flag 0.
    """
    folder = path.resolve().parent.parent.name
    for text, why in ((name, "seqinfo.ini"), (folder, f"the folder {folder}")):
        if match := re.match(r"(MOT16|MOT17|MOT20)-\d+", text):
            return match[1], why
    other = number != PEDESTRIAN
    known = ((number >= 1) & (number <= 13)).all()
    return ("MOT17" if known and other.any() and (flagged == other).all() else ""), "its rows"


def _names_of(number: IntArray, names: Mapping[str, str]) -> list[str]:
    """Name classes (N,) by number; those without a name by their number."""
    return [names.get(str(n), str(n)) for n in number]


def _check_identities(boxes: LabelledBoxes, path: Path) -> None:
    """Refuse boxes without identity, and an identity that has two boxes in a frame."""
    scored = boxes[boxes.role == Role.SCORED]
    without = scored.identity < 0
    if without.any():
        raise ReobjError(f"{path}: {without.sum()} of {len(scored)} boxes have no identity (below "
                         f"0), the first in frame {scored.frame[without].min()} (from 1): "
                         "detections, not tracks?")  # fmt: skip
    pairs = np.column_stack([scored.frame, scored.identity])
    unique, count = np.unique(pairs, axis=0, return_counts=True)
    for row in np.flatnonzero(count > 1)[:1]:
        frame, identity = unique[row]
        raise ReobjError(
            f"{path}: identity {identity} has {count[row]} boxes in frame {frame} (from 1; "
            f"{(count > 1).sum()} such cases); expected one box per object and frame"
        )


def check_counts(truth: LabelledBoxes, path: Path, left_out: str = "") -> None:
    """Refuse ground truth without any box that counts.

    Args:
        left_out: reason why boxes of the file were removed before.
    """
    if (truth.role == Role.SCORED).any():
        return
    why = "no boxes in it"
    if len(truth):
        why = (f"of {len(truth)} rows {(truth.role == Role.ABSENT).sum()} are marked not to count "
               f"(column 7 is 0, or another class), the others to be ignored")  # fmt: skip
    raise ReobjError(f"{path}: no true box counts: {left_out or why}")


def with_common_names(
    truth: LabelledBoxes, predicted: LabelledBoxes, notes: list[str]
) -> tuple[LabelledBoxes, LabelledBoxes, bool]:
    """Bring the class names of truth and result together.

    Names that mean the same (`words.canonical`) become one: the result's first, else the truth's.
    If the result has no classes, or none in common with the truth, classes are not compared: all
    names of the result become "".

    Returns:
        truth, result, and whether classes are compared.
    """
    unnamed = {"", "object"}  # names of boxes without a class
    our_names = sorted(set(predicted.name.tolist()) - unnamed)
    true_names = sorted(set(truth.name[truth.role == Role.SCORED].tolist()) - unnamed)
    names = list(dict.fromkeys([*our_names, *sorted(set(truth.name.tolist()))]))
    one_of = {canonical(name): name for name in reversed(names)}
    truth, predicted = (
        dataclasses.replace(
            boxes, name=np.array([one_of.get(canonical(n), n) for n in boxes.name.tolist()], str)
        )
        for boxes in (truth, predicted)
    )
    if not true_names or not len(predicted) or among(true_names, our_names).any():
        return truth, predicted, True
    why = "the result has no classes"
    if our_names:
        why = f"no class in common (truth: {shortened(true_names)}; result: {shortened(our_names)})"
    notes.append(f"{why}: boxes match whatever their class")
    return truth, dataclasses.replace(predicted, name=np.full(len(predicted), "")), False
