"""Corrections by hand: merge, split, rename, delete objects; edits.json, which the page saves.

An edit names an object by one of its boxes, so that it still finds the object when the linker
numbers identities anew.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.files import atomic, load_json, shortened
from reobj.types import (
    CLASS_NAME_MAX,
    COORDINATE_MAX,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    Tracks,
    box_iou,
)

FORMAT = "reobj-edits"
FORMAT_VERSION = 1
EDITS = "edits.json"  # in an output folder
FIELDS = {  # of an edit, beside `do`
    "merge": ("object", "with"),
    "split": ("object", "visits"),
    "rename": ("object", "class"),
    "delete": ("object",),
}


@dataclass(frozen=True, slots=True)
class BoxRef:
    """A box that shows an object.

    Attributes:
        frame: number of the source's frame. box: (4,) x1, y1, x2, y2, native pixels.
        id: of the object when the edit was made; 0: of no interest.
    """

    frame: int
    box: tuple[float, ...]
    id: int = 0


@dataclass(frozen=True, slots=True)
class Edit:
    """One correction; the file's entry is `entry`.

    Attributes:
        do: "merge", "split", "rename" or "delete". object: what it is about.
        other: merge: the one that `object` is the same as. visits: split: a box of each visit that
            becomes another object. class_name: rename.
    """

    do: str
    object: BoxRef
    other: BoxRef | None = None
    visits: tuple[BoxRef, ...] = ()
    class_name: str = ""

    @property
    def text(self) -> str:
        """Say what is done, for messages."""
        other = f" with {self.other.id}" if self.other else ""
        return f"{self.do} {self.object.id}{other}"


@dataclass(frozen=True, slots=True)
class Edits:
    """The edits of a file, in the order in which they are made.

    Attributes:
        edits: of them. entries: the same as the file has them. path: of the file, for messages.
        kept: they were made earlier, and may not fit any more.
    """

    edits: tuple[Edit, ...]
    entries: list[dict[str, Any]]
    path: Path
    kept: bool = False


def read_edits(path: str | Path) -> Edits:
    """Read a file of edits.

    Raises:
        ReobjError: it is no such file, with the edit at fault.
    """
    path = Path(path)
    data = load_json(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ReobjError(f'{path}: no edits; expected "format": "{FORMAT}", as scene.html saves it')
    if data.get("version") != FORMAT_VERSION or not isinstance(data.get("edits"), list):
        expected = f'"version": {FORMAT_VERSION} and a list "edits"'
        raise ReobjError(f"{path}: version {data.get('version')}; expected {expected}")
    edits = []
    for number, entry in enumerate(data["edits"], 1):
        try:
            edits.append(_parse(entry))
        except (KeyError, TypeError, ValueError) as error:
            what = f"{path}, edit {number}: {error if str(error) else 'cannot be read'}"
            raise ReobjError(f"{what}; expected {_expected(entry)}") from error
    return Edits(tuple(edits), data["edits"], path)


def _expected(entry: Any) -> str:
    """Say what an edit of this kind consists of."""
    do = entry.get("do") if isinstance(entry, dict) else None
    if not isinstance(do, str) or do not in FIELDS:
        return f'"do": one of {", ".join(FIELDS)}'
    return ", ".join(FIELDS[do]) + ' (an object or visit: "id", "frame", "box": [x1, y1, x2, y2])'


def _parse(entry: Any) -> Edit:
    do = entry["do"]
    fields = FIELDS[do]
    if set(entry) != {"do", *fields}:
        raise ValueError(f"has {shortened(sorted(set(entry) - {'do'}))}")
    name = entry.get("class", "")
    if not isinstance(name, str) or ("class" in fields and not name.strip()):
        raise ValueError(f"class {name!r} is no name")
    if len(name) > CLASS_NAME_MAX:
        raise ValueError(f"class of {len(name)} characters, at most {CLASS_NAME_MAX} are allowed")
    if not name.isprintable():
        raise ValueError(f"class {name!r} has characters that cannot be printed")
    visits = tuple(_box_ref(item) for item in entry.get("visits", ()))
    if "visits" in fields and not visits:
        raise ValueError("visits is empty")
    other = _box_ref(entry["with"]) if "with" in fields else None
    return Edit(do, _box_ref(entry["object"]), other, visits, name.strip())


def _box_ref(item: Any) -> BoxRef:
    box = tuple(float(value) for value in item["box"])
    if len(box) != 4 or not (np.abs(box) <= COORDINATE_MAX).all():  # NaN too
        raise ValueError(f"box {item['box']} is no box")
    if type(item["frame"]) is not int or type(item.get("id", 0)) is not int:
        raise ValueError(f"frame {item['frame']}, id {item.get('id')}: whole numbers")
    return BoxRef(item["frame"], box, item.get("id", 0))


def write_edits(folder: Path, edits: Edits | None) -> None:
    """Write edits into a new folder of results, for later fits; an empty list makes no file."""
    if edits is None or not edits.edits:
        return
    data = {"format": FORMAT, "version": FORMAT_VERSION, "edits": edits.entries}
    with atomic(folder / EDITS) as part:
        part.write_text(json.dumps(data, indent=1) + "\n")


def kept_edits(folder: Path) -> Edits | None:
    """Read the edits that an output folder keeps; None if it has none."""
    path = folder / EDITS
    return dataclasses.replace(read_edits(path), kept=True) if path.exists() else None


@dataclass(frozen=True, slots=True)
class Edited:
    """Tracks after corrections.

    Attributes:
        tracks: the N rows with their new identities and classes. keep: (N,) False: deleted.
        class_names: of the tracks. confirmed: identities that the user says are there.
        messages: what the user should know.
    """

    tracks: Tracks
    keep: BoolArray
    class_names: tuple[str, ...]
    confirmed: set[int]
    messages: list[str]


def apply_edits(tracks: Tracks, class_names: tuple[str, ...], edits: Edits) -> Edited:
    """Correct identities and classes of tracks.

    A merged object keeps the lower identity; what is split off gets the next free one; nothing else
    is renumbered. Where both of two merged objects have a box in a frame, the weaker is left out.

    Raises:
        ReobjError: an edit finds no such box, with its number.
    """
    made = _Tables(tracks, class_names)
    for number, edit in enumerate(edits.edits, 1):
        where = f"{edits.path}, edit {number} ({edit.text})"
        try:
            made.make(edit)
        except LookupError as error:
            hint = "were these edits made for another result? make them anew in scene.html"
            raise ReobjError(f"{where}: {error.args[0]}; {hint}") from error
    keep, messages = made.without_duplicates(str(edits.path))
    if (count := len(edits.edits)) > 0:
        messages.append(f"{count} correction{'s' * (count != 1)} by hand applied ({EDITS})")
    table = dataclasses.replace(tracks, track_id=made.identity, class_id=made.class_id)
    confirmed = made.confirmed & set(made.identity[keep].tolist())
    return Edited(table, keep, tuple(made.names), confirmed, messages)


SAME_BOX_IOU = 0.9  # chosen: a box rounded to .1 px, 10 px wide, overlaps itself by .98


class _Tables:
    """Columns of tracks while edits change them; deleted rows have identity 0."""

    def __init__(self, tracks: Tracks, class_names: tuple[str, ...]) -> None:
        self.tracks = tracks
        self.names = list(class_names)
        self.identity = tracks.track_id.copy()  # (N,)
        self.class_id = tracks.class_id.copy()
        self.confirmed: set[int] = set()

    def make(self, edit: Edit) -> None:
        """Make one edit; LookupError where it finds nothing."""
        own = int(self.identity[self._row_of(edit.object)])
        if edit.do == "delete":
            self.identity[self.identity == own] = 0
        elif edit.do == "rename":
            if edit.class_name not in self.names:
                self.names.append(edit.class_name)
            self.class_id[self.identity == own] = self.names.index(edit.class_name)
            self.confirmed.add(own)
        elif edit.do == "split":
            self._split(own, edit.visits)
        elif edit.other is not None:  # merge; one already where the linker sees it by itself now
            kept, gone = sorted((own, int(self.identity[self._row_of(edit.other)])))
            self.identity[self.identity == gone] = kept
            self.confirmed.add(kept)

    def _row_of(self, ref: BoxRef) -> int:
        """Find the row of a box; of several alike, that of the identity named, then the nearest."""
        rows = np.flatnonzero((self.identity > 0) & (self.tracks.frame == ref.frame))
        iou: Array = box_iou(self.tracks.xyxy[rows], np.array([ref.box]))[:, 0]  # (n,)
        rows = rows[iou >= SAME_BOX_IOU]
        iou = iou[iou >= SAME_BOX_IOU]
        if not len(rows):
            box = ", ".join(f"{value:.1f}" for value in ref.box)
            raise LookupError(f"no object has the box {box} in frame {ref.frame}")
        return int(rows[np.lexsort((-iou, self.identity[rows] != ref.id))[0]])

    def _split(self, own: int, visits: tuple[BoxRef, ...]) -> None:
        found = [row for visit in visits if self.identity[row := self._row_of(visit)] == own]
        pieces = self.tracks.tracklet_id[np.array(found, np.int64)]
        off = (self.identity == own) & np.isin(self.tracks.tracklet_id, pieces)
        if not ((self.identity == own) & ~off).any():
            raise LookupError("these are all visits of the object")
        if off.any():  # else it is apart already
            self.identity[off] = self.identity.max() + 1

    def without_duplicates(self, where: str) -> tuple[BoolArray, list[str]]:
        """Choose the rows (N,) that stay: of a merged object's boxes in a frame the best scored.

        Returns:
            also what to say about the others.
        """
        keep = self.identity > 0
        messages = list[str]()
        for number in sorted(self.confirmed):
            rows: IntArray = np.flatnonzero(self.identity == number)
            rows = rows[np.argsort(-self.tracks.score[rows], kind="stable")]
            best = rows[np.unique(self.tracks.frame[rows], return_index=True)[1]]
            keep[np.setdiff1d(rows, best)] = False
            if (both := len(rows) - len(best)) > 0:
                frames = f"{both} frame{'s' * (both != 1)}"
                text = f"what is now object {number} is seen twice in {frames}"
                messages.append(f"{where}: {text}; the weaker box is left out")
        return keep, messages
