"""Manual corrections: merge, split, rename, delete objects; edits.json, which the viewer saves.

An edit refers to an object by one of its boxes, so that it stays valid when the linker renumbers
the identities.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from reobj.results.entries import OutputFile, read_json, write_json
from reobj.types import (
    CLASS_NAME_MAX,
    COORDINATE_MAX,
    NOTE_START,
    Array,
    BoolArray,
    IntArray,
    NonNegativeInt,
    ReobjError,
    Tracks,
    box_area,
    box_iou,
    counted,
    rows_by,
)

HEADER = {"format": "reobj-edits", "version": 1}
KEYS = {  # besides `do` and `object`, one each
    "merge": ("with",), "split": ("frames", "visits"), "rename": ("class",), "delete": ("",),
}  # fmt: skip
Coordinate = Annotated[float, msgspec.Meta(ge=-COORDINATE_MAX, le=COORDINATE_MAX)]  # px

# Two boxes of a merged object in one frame
DUPLICATE_IOU = 0.6  # above it they show the same (as in the association)
LARGEST_GAP = 0.1  # between boxes of parts, over the side of the box around both
LEAST_COVERED = 0.55  # by the boxes of parts, of the box around both


@dataclass(frozen=True, slots=True)
class BoxRef:
    """Reference to an object by one of its boxes.

    Attributes:
        frame: frame number of the source. box: (4,) x1, y1, x2, y2, native pixels.
        id: of the object when the edit was made; 0: unknown.
    """

    frame: NonNegativeInt
    box: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    id: NonNegativeInt = 0


class Edit(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    rename={"other": "with", "class_name": "class"},
):
    """One correction.

    Attributes:
        do: "merge", "split", "rename" or "delete". object: the object to correct.
        other: of a merge: the other object. class_name: of a rename.
        frames: of a split: first and last frame in which it is another object; visits: instead, a
            box of each tracklet that is another object.
    """

    do: Literal["merge", "split", "rename", "delete"]
    object: BoxRef
    other: BoxRef | None = None
    visits: tuple[BoxRef, ...] = ()
    frames: tuple[NonNegativeInt, NonNegativeInt] | None = None
    class_name: Annotated[str, msgspec.Meta(max_length=CLASS_NAME_MAX)] = ""

    def __post_init__(self) -> None:
        """Check the keys of the kind of edit, the order of frames, and the class."""
        msgspec.structs.force_setattr(self, "class_name", self.class_name.strip())
        values = {"with": self.other, "frames": self.frames, "visits": self.visits,
                  "class": self.class_name}  # fmt: skip
        given = " and ".join(key for key, value in values.items() if value)
        if given not in KEYS[self.do]:
            expected = " or ".join(KEYS[self.do]) or "nothing"
            found = f"{given or 'nothing'} besides object"
            raise ValueError(f"{self.do} has {found}, expected {expected}")
        if self.frames is not None and self.frames[0] > self.frames[1]:
            raise ValueError(f"frames {list(self.frames)} are not in order")
        if not self.class_name.isprintable():
            raise ValueError(f"class {self.class_name!r} has characters that cannot be printed")

    @property
    def text(self) -> str:
        """Short description, for messages."""
        other = f" with {self.other.id}" if self.other else ""
        return f"{self.do} {self.object.id}{other}"


@dataclass(frozen=True, slots=True)
class Edits:
    """The edits of a file, in the order of their application.

    Attributes:
        edits: parsed. path: of the file, for messages.
        kept: stored by an earlier fit; they may not match the current result.
        map_id: of the map whose numbers the edits' objects have; "": none.
    """

    edits: tuple[Edit, ...]
    path: Path
    kept: bool = False
    map_id: str = ""

    def to_json(self) -> Any:
        """Return the list `edits` of the file."""
        return msgspec.to_builtins(self.edits)


class _EditsFile(msgspec.Struct):
    """Content of a file of edits."""

    edits: tuple[Edit, ...]
    map_path: str = ""  # identifier of the map


def read_edits(path: str | Path) -> Edits:
    """Read a file of edits.

    Raises:
        ReobjError: another kind of file, or an invalid edit.
    """
    path = Path(path)
    content = read_json(_EditsFile, path, HEADER)
    return Edits(content.edits, path, map_id=content.map_path)


def write_edits(folder: Path, edits: Edits | None) -> None:
    """Write edits into a new folder of results, for later fits; no file for an empty list."""
    if edits is None or not edits.edits:
        return
    data = HEADER | {"map": edits.map_id, "edits": edits.to_json()}
    write_json(folder / OutputFile.EDITS, data)


def kept_edits(folder: Path) -> Edits | None:
    """Read the edits in an output folder; None if there are none."""
    path = folder / OutputFile.EDITS
    return dataclasses.replace(read_edits(path), kept=True) if path.exists() else None


@dataclass(frozen=True, slots=True)
class Edited:
    """Tracks after corrections.

    Attributes:
        tracks: the N rows with their new identities, classes and boxes. keep: (N,) False: deleted,
            or another row has the box of the object in this frame.
        class_names: of the tracks. confirmed: identities that the user confirmed by an edit.
        messages: for the user.
    """

    tracks: Tracks
    keep: BoolArray
    class_names: tuple[str, ...]
    confirmed: set[int]
    messages: list[str]


def apply_edits(
    tracks: Tracks,
    class_names: tuple[str, ...],
    edits: Edits,
    last: IntArray | None = None,
    highest: int = 0,
) -> Edited:
    """Correct identities and classes of tracks.

    A merged object keeps the lower identity; what is split off gets the number that it had in the
    last result, or one that no identity had; other identities stay. Where merged objects have boxes
    in the same frame, the row of the highest score is kept, with the box of `joined_box`.

    Args:
        last: (N,) number of each row in the last result, 0: none; None: those of the tracks.
        highest: number that an identity ever had.
    Raises:
        ReobjError: the box of an edit does not exist.
    """
    table = _Tables(tracks, class_names, last, highest)
    for number, edit in enumerate(edits.edits, 1):
        where = f"{edits.path}, edit {number} ({edit.text})"
        try:
            table.apply(edit)
        except LookupError as error:
            hint = "were these edits made for another result? make them anew in scene.html"
            raise ReobjError(f"{where}: {error.args[0]}; {hint}") from error
    keep, boxes, messages = table.one_box_a_frame(str(edits.path))
    if edits.edits:
        corrections = counted(len(edits.edits), "correction", "corrections")
        messages.append(f"{NOTE_START}{corrections} by hand applied ({OutputFile.EDITS})")
    edited = dataclasses.replace(
        tracks, track_id=table.identity, class_id=table.class_id, xyxy=boxes
    )
    confirmed = table.confirmed & set(table.identity[keep].tolist())
    return Edited(edited, keep, tuple(table.names), confirmed, messages)


class _Tables:
    """Columns of tracks during the application of edits; deleted rows have identity 0."""

    def __init__(
        self, tracks: Tracks, class_names: tuple[str, ...], last: IntArray | None, highest: int
    ) -> None:
        self.tracks = tracks
        self.last = tracks.track_id if last is None else last
        self.highest = max(highest, int(tracks.track_id.max(initial=0)))
        self.names = list(class_names)
        self.identity = tracks.track_id.copy()  # (N,)
        self.class_id = tracks.class_id.copy()  # (N,)
        self.confirmed: set[int] = set()

    def apply(self, edit: Edit) -> None:
        """Apply one edit; LookupError if its object does not exist."""
        identity = int(self.identity[self._row_of(edit.object)])
        if edit.do == "delete":
            self.identity[self.identity == identity] = 0
        elif edit.do == "rename":
            if edit.class_name not in self.names:
                self.names.append(edit.class_name)
            self.class_id[self.identity == identity] = self.names.index(edit.class_name)
            self.confirmed.add(identity)
        elif edit.do == "split":
            self._split(identity, edit)
        elif edit.other is not None:  # merge; without effect if the linker has merged them since
            kept, removed = sorted((identity, int(self.identity[self._row_of(edit.other)])))
            self.identity[self.identity == removed] = kept
            self.confirmed.add(kept)

    def _row_of(self, ref: BoxRef) -> int:
        """Find the row of a box: prefer the identity of the reference, then the highest IoU.

        An edit that was made after a merge may refer to a joined box.
        """
        rows = np.flatnonzero((self.identity > 0) & (self.tracks.frame == ref.frame))
        boxes = (self.tracks.xyxy[rows], self.joined(rows)[0][rows])
        iou = np.maximum(*(box_iou(xyxy, np.array([ref.box]))[:, 0] for xyxy in boxes))  # (n,)
        # the box of an edit is rounded to .1 px, which costs .02 at 10 px
        order = np.lexsort((-iou, self.identity[rows] != ref.id, iou < 0.9))
        if not (iou >= 0.9).any():
            box = ", ".join(f"{value:.1f}" for value in ref.box)
            raise LookupError(f"no object has the box {box} in frame {ref.frame}")
        return int(rows[order[0]])

    def _split(self, identity: int, edit: Edit) -> None:
        of_object = self.identity == identity  # (N,)
        if edit.frames is None:
            refs = [self._row_of(visit) for visit in edit.visits]
            rows = [row for row in refs if of_object[row]]
            tracklets = self.tracks.tracklet_id[np.array(rows, np.int64)]
            moved = of_object & np.isin(self.tracks.tracklet_id, tracklets)
        else:
            first, last = edit.frames
            moved = of_object & (first <= self.tracks.frame) & (self.tracks.frame <= last)
        if not (of_object & ~moved).any():
            raise LookupError("these are all boxes of the object")
        if moved.any():  # else they are another object already
            self.identity[moved] = self._number_of_split(moved)

    def _number_of_split(self, moved: BoolArray) -> int:
        """Number what is split off: as in the last result, if no other identity has this number."""
        known, count = np.unique(self.last[moved], return_counts=True)
        number = int(known[count.argmax()])
        if number and number not in self.identity:
            return number
        self.highest += 1
        return self.highest

    def joined(self, rows: IntArray) -> tuple[Array, IntArray]:
        """Join the boxes that an object has in one frame, among rows (n,) of objects.

        Returns:
            the boxes (N, 4), and the rows (k,) whose box another one has taken over.
        """
        boxes = self.tracks.xyxy.copy()
        rows = rows[np.lexsort((-self.tracks.score[rows], self.tracks.frame[rows]))]
        pairs = np.stack([self.identity[rows], self.tracks.frame[rows]], 1)  # (n, 2)
        _, group, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        several = count[group] > 1
        removed = list[int]()
        for members in rows_by(group[several]):
            best, *others = rows[several][members].tolist()
            boxes[best] = joined_box(boxes[[best, *others]])
            removed += others
        return boxes, np.array(removed, np.int64)

    def one_box_a_frame(self, where: str) -> tuple[BoolArray, Array, list[str]]:
        """Give every object one box a frame.

        Returns:
            True for rows to keep (N,), the boxes (N, 4), and messages about the others.
        """
        keep = self.identity > 0
        boxes, removed = self.joined(np.flatnonzero(keep))
        keep[removed] = False
        messages = list[str]()
        for rows in rows_by(self.identity[removed]):
            number = self.identity[removed[rows[0]]]
            frames = counted(len(np.unique(self.tracks.frame[removed[rows]])), "frame", "frames")
            text = f"merged object {number} has two boxes in {frames}"
            messages.append(
                f"{where}: {text}; boxes of parts are joined, of others the best is kept"
            )
        return keep, boxes, messages


def joined_box(boxes: Array) -> Array:
    """Return the box (4,) of one object by its boxes (K, 4) in one frame, the best one first.

    Boxes of its parts, which adjoin or overlap, are joined. Of duplicates the better one counts;
    boxes elsewhere do not count.
    """
    whole: Array = boxes[0]
    others = list(boxes[1:])
    while others:
        for k, other in enumerate(others):
            low = np.minimum(whole, other)
            high = np.maximum(whole, other)
            around = np.append(low[:2], high[2:])  # (4,) the box around both
            side = low[2:] - high[:2]  # (2,) of what they share, < 0: a gap
            common = side.clip(0).prod()
            covered = box_area(whole) + box_area(other) - common
            adjoins = (side >= -LARGEST_GAP * (around[2:] - around[:2])).all()
            is_part = adjoins and covered >= LEAST_COVERED * box_area(around)
            if is_part and common <= DUPLICATE_IOU * covered:
                whole = around  # those before may adjoin it now
                del others[k]
                break
        else:
            break
    return whole
