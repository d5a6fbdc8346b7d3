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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.files import load_json, read_lines, shortened
from reobj.formats import AUTO, Format, Registry
from reobj.results.result import Result
from reobj.sources.detection_files import DETECTIONS, FROM_1, Reader, check_rows, read_source
from reobj.sources.recorded import SIZES, NoVideo, Source, corners, other_form
from reobj.sources.tables import forms, read_mot_rows
from reobj.types import CLASS_MAX, Array, BoolArray, IntArray, ReobjError, counted
from reobj.words import among, canonical

TruthReader = Callable[..., "LabelledBoxes"]


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
    n = len(rows)
    xyxy = corners(rows[:, 2:6], SIZES)  # (N, 4)
    whole = rows[:, :2].astype(np.int64)
    names = np.broadcast_to(np.asarray(name, str), n)
    roles = np.broadcast_to(role, n)
    return LabelledBoxes(whole[:, 0], whole[:, 1], xyxy, names, np.asarray(roles, np.int64))


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
    notes = [] if notes is None else notes
    reader = TRUTH.reader(path, fmt)
    if first not in ("", "0", "1"):
        raise ReobjError(f"detect.first_frame {first}: expected 0 or 1 for ground truth")
    truth = reader(path, class_names, min_visibility, notes, size, first)
    _check_identities(truth, path)
    return truth


def _with_roles(entry: Format[Reader]) -> Format[TruthReader]:
    """Return a format of detections with identities as one of ground truth."""

    def read(
        path: Path, _: Sequence[str], __: float, notes: list[str], size: tuple[int, int], first: str
    ) -> LabelledBoxes:
        video = NoVideo(path.stem, size, size)
        source = Source(path, video, first=first, messages=notes)
        assert entry.read is not None
        recorded = read_source(source, entry.read)
        check_rows(recorded, path)
        sizes = {size, *source.image_sizes} - {(0, 0)}
        image = min(sizes) if len(sizes) == 1 else (0, 0)
        if fault := other_form(
            recorded.xyxy, recorded.form, image, recorded.frame, recorded.identity
        ):
            raise ReobjError(f"{path}: {fault}")
        if not len(recorded.identity):
            raise ReobjError(f"{path}: boxes without identities; expected tracks")
        names = np.array([*recorded.class_names, ""], str)[recorded.class_id]
        role = np.full(len(recorded), Role.SCORED)
        if len(recorded.ignored):
            role[recorded.ignored] = Role.IGNORED
        if entry.name == "kitti":
            names[recorded.ignored] = ""
            notes.append("KITTI's labels: frames from 0; boxes on DontCare do not count; KITTI's "
                         "rules of distractors, occlusion and height are not applied"
                         )  # fmt: skip
        listed = None if recorded.looked is None else recorded.looked + 1
        ids = recorded.identity
        return LabelledBoxes(recorded.frame + 1, ids, recorded.xyxy, names, role, listed)

    return Format(entry.name, entry.title, entry.recognise, entry.read and read, entry.frames,
                  entry.units, entry.unread, WITH_TRACKS, entry.kind)  # fmt: skip


def read_result(out: Path, notes: list[str] | None = None) -> LabelledBoxes:
    """Read boxes, identities and classes of an output folder; or MOT rows, without classes.

    Args:
        notes: assumptions about the file are appended.
    """
    notes = [] if notes is None else notes
    if out.is_dir():
        result = Result.load(out)
        tracks = result.tracks
        names = np.array([*result.class_names, ""], str)  # the last one is that of class -1
        role = np.full(len(tracks), Role.SCORED)
        ids = tracks.track_id
        frame = tracks.frame + 1
        predicted = LabelledBoxes(frame, ids, tracks.xyxy, names[tracks.class_id], role)
    else:
        predicted = labelled(_checked(read_mot_rows(out), out, notes))
    _check_identities(predicted, out / "tracks.txt" if out.is_dir() else out)
    return predicted


class MotClass(enum.IntEnum):
    """Classes of MOTChallenge: the one that counts, and those that do not count if matched.

    The latter in TrackEval 1.3.0, mot_challenge_2d_box.py.
    """

    PEDESTRIAN = 1
    PERSON_ON_VEHICLE = 2
    NON_MOTORISED_VEHICLE = 6  # of MOT20 only
    STATIC_PERSON = 7
    DISTRACTOR = 8
    REFLECTION = 12


def _read_mot(
    path: Path,
    class_names: Sequence[str],
    min_visibility: float,
    notes: list[str],
    size: tuple[int, int],
    first: str,
) -> LabelledBoxes:
    """Read MOTChallenge rows.

    Column 7 is a flag (0: the row does not count). In files of nine columns, column 8 is the class
    and column 9 the visibility; MOT15 has ten columns, with world coordinates instead.
    """
    sequence = _sequence(path)
    sides = [sequence.get(key, "") for key in ("imwidth", "imheight")]
    if 0 in size and all(map(str.isdecimal, sides)):
        size = (int(sides[0]), int(sides[1]))
    rows = _checked(read_mot_rows(path), path, notes, first, size)
    flagged = rows[:, 6] == 0 if rows.shape[1] > 6 else np.zeros(len(rows), bool)
    _check_length(rows, path, sequence)
    if rows.shape[1] != 9:
        return labelled(rows, "", np.where(flagged, Role.ABSENT, Role.SCORED))
    number = rows[:, 7].clip(-CLASS_MAX, CLASS_MAX).astype(np.int64)
    hidden = rows[:, 8] < min_visibility
    labels = path.with_name("labels.txt")
    stated = path.with_name("gt_mot_format.json")
    if labels.exists():
        notes.append(f"classes are lines of {labels.name}, from 1 (CVAT's MOT 1.1)")
        role = np.where(flagged, Role.ABSENT, hidden * Role.IGNORED)
        return labelled(rows, _by_line(number, labels, path), role)
    if stated.exists():
        notes.append(f"classes are named by {stated.name}")
        return labelled(
            rows, _names_of(number, stated, class_names), (flagged | hidden) * Role.IGNORED
        )
    benchmark, why = _benchmark(sequence.get("name", ""), path, number, flagged)
    if benchmark:
        text = "pedestrians count, boxes on distractors do not"
        notes.append(f"classes are {benchmark}'s, by {why}: {text}")
        pedestrian = number == MotClass.PEDESTRIAN
        role = np.where(flagged | ~pedestrian, Role.ABSENT, hidden * Role.IGNORED)
        only_mot20 = {MotClass.NON_MOTORISED_VEHICLE} if benchmark != "MOT20" else set()
        distractors = set(MotClass) - {MotClass.PEDESTRIAN} - only_mot20
        role[np.isin(number, list(distractors))] = Role.IGNORED
        return labelled(rows, "", role)
    if (number < 0).all() or (sequence and (number == MotClass.PEDESTRIAN).all()):
        by = " (class 1, by seqinfo.ini)" if sequence else ""
        notes.append(f"the truth has one class without a name{by}: classes do not count")
        return labelled(rows, "", np.where(flagged, Role.ABSENT, hidden * Role.IGNORED))
    notes.append("class numbers of the truth are those of the detector (COCO's), from 0")
    unnamed = number < 0
    if unnamed.any():
        boxes = counted(int(unnamed.sum()), "true box", "true boxes")
        notes.append(f"{boxes} without a class (below 0) do not count, nor do boxes on them")
    names = np.where(unnamed, "", _names_of(number, None, class_names))
    return labelled(rows, names, (flagged | hidden | unnamed) * Role.IGNORED)


WITH_TRACKS = "export it as COCO JSON with track_id, or as MOTChallenge rows"
WITH_IDENTITIES = "visdrone kitti csv records coco cvat".split()
TRUTH: Registry[TruthReader] = Registry("ground truth", "--gt-format", [
    Format("mot", "MOTChallenge, CVAT's MOT 1.1, DanceTrack: rows of 6 to 10 numbers",
           lambda probe: bool(forms(probe) & {"mot", "boxmot"}), _read_mot, FROM_1, "px",
           "x, y, z in ten columns", kind="text"),
    *(_with_roles(entry) for entry in DETECTIONS.formats
      if entry.name in WITH_IDENTITIES or entry.read is None),
])  # fmt: skip


def _checked(
    rows: Array, path: Path, notes: list[str], begin: str = "", size: tuple[int, int] = (0, 0)
) -> Array:
    """Refuse rows of another form; return them with frames that count from 1."""
    whole = rows[:, :2].astype(np.int64)
    xyxy = corners(rows[:, 2:6], SIZES)
    fault = other_form(xyxy, SIZES, size, whole[:, 0], whole[:, 1])
    if fault:
        raise ReobjError(f"{path}: {fault}")
    first = rows[:, 0].min(initial=1)
    if first < int(begin or 0):
        expected = f"from {begin}" if begin else "from 1, or from 0"
        raise ReobjError(f"{path}: frame {first:.0f}; expected frames {expected}")
    if (rows[:, 4:6] < 0).any():
        at = int((rows[:, 4:6] < 0).any(1).argmax())
        where = f"frame {rows[at, 0]:.0f}, identity {rows[at, 1]:.0f}"
        raise ReobjError(
            f"{path}, {where}: width or height below 0; expected left,top,width,height"
        )
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


def _check_length(rows: Array, path: Path, sequence: dict[str, str]) -> None:
    """Refuse frames beyond the length of the sequence, as TrackEval does."""
    length = sequence.get("seqlength", "")
    last = rows[:, 0].max(initial=0)
    if length.isdecimal() and last > int(length):
        known = f"seqinfo.ini says seqLength={length}"
        raise ReobjError(f"{path}: frame {last:.0f}, but {known}: truth of another sequence?")


def _benchmark(name: str, path: Path, number: IntArray, flagged: BoolArray) -> tuple[str, str]:
    """Return the MOTChallenge benchmark whose classes a file has, "": none, and what shows it.

    By the name of the sequence or of its folder; else by the rows: all have classes 1 to 13, and
    exactly those of other classes than pedestrians have flag 0.
    """
    folder = path.resolve().parent.parent.name
    for text, why in ((name, "seqinfo.ini"), (folder, f"the folder {folder}")):
        if match := re.match(r"(MOT16|MOT17|MOT20)-\d+", text):
            return match[1], why
    other = number != MotClass.PEDESTRIAN
    known = ((number >= 1) & (number <= 13)).all()
    return ("MOT17" if known and other.any() and (flagged == other).all() else ""), "its rows"


def _by_line(number: IntArray, labels: Path, path: Path) -> list[str]:
    """Name classes by the lines of a file, from 1; 0 or less: no class."""
    lines = [line.strip() for line in read_lines(labels)]
    if number.max(initial=0) > len(lines):
        raise ReobjError(f"{path}: class {number.max()}, but {labels} has {len(lines)} lines")
    return [lines[n - 1] if n > 0 else "" for n in number.tolist()]


def _names_of(number: IntArray, stated: Path | None, class_names: Sequence[str]) -> list[str]:
    """Name classes by our JSON file, {"classes": {number: name}}, or by class_names."""
    names = {str(i): n for i, n in enumerate(class_names)}
    if stated is not None:
        classes = load_json(stated)
        classes = classes.get("classes") if isinstance(classes, dict) else None
        if isinstance(classes, dict):
            names = {str(k): str(v) for k, v in classes.items()}
    return [names.get(str(n), str(n)) for n in number]


def _check_identities(boxes: LabelledBoxes, path: Path) -> None:
    """Refuse boxes without identity, and an identity that has two boxes in a frame."""
    scored = boxes[boxes.role == Role.SCORED]
    if (scored.identity < 0).any():
        count = (scored.identity < 0).sum()
        total = len(scored)
        frame = scored.frame[scored.identity < 0].min()
        why = ": detections, not tracks?" if count == total else ""
        raise ReobjError(f"{path}: {count} of {total} boxes have no identity (below 0), the first "
                         f"in frame {frame} (from 1){why}")  # fmt: skip
    pairs = np.column_stack([scored.frame, scored.identity])
    unique, count = np.unique(pairs, axis=0, return_counts=True)
    if (count > 1).any():
        frame, identity = unique[(count > 1).argmax()]
        more = (count > 1).sum()
        raise ReobjError(
            f"{path}: identity {identity} has {count[(count > 1).argmax()]} boxes in frame {frame} "
            f"(from 1; {more} such cases); expected one box per object and frame"
        )


def check_counts(truth: LabelledBoxes, path: Path, left_out: str = "") -> None:
    """Refuse ground truth without any box that counts.

    Args:
        left_out: reason why boxes of the file were removed before.
    """
    if (truth.role == Role.SCORED).any():
        return
    absent = (truth.role == Role.ABSENT).sum()
    ignored = (truth.role == Role.IGNORED).sum()
    why = "no boxes in it"
    if len(truth):
        why = (f"of {len(truth)} rows {absent} are marked not to count (column 7 is 0, or another "
               f"class) and {ignored} to be ignored")  # fmt: skip
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
