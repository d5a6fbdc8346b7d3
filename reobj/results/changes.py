"""Changes of a room between a map and a recording: what stayed, moved, went, came; changes.json."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reobj.files import atomic, significant
from reobj.types import Array

HEADER = {"format": "reobj-changes", "version": 1}


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """What happened to one object since the map was last updated.

    Lengths are in the unit of the map's world unless the name ends in _m (metres).

    Attributes:
        id: number of the object in the map. class_name: of the object.
        before, after: (3,) centre in the map and in this recording; None: not known there.
        distance_m: between them, and sigma_m, its standard deviation; None: the scale is unknown.
        evidence: for the decision, in one sentence.
        candidates: of an ambiguous object: numbers that it may have as well.
    """

    id: int
    class_name: str
    before: Array | None = None
    after: Array | None = None
    distance_m: float | None = None
    sigma_m: float | None = None
    evidence: str = ""
    candidates: tuple[int, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the entry of changes.json."""
        entry: dict[str, Any] = {"id": self.id, "class": self.class_name}
        for key, center in (("from", self.before), ("to", self.after)):
            entry[key] = None if center is None else significant(center).tolist()
        for key in ("distance_m", "sigma_m"):
            value = getattr(self, key)
            entry[key] = None if value is None else round(float(value), 4)
        entry["evidence"] = self.evidence
        if self.candidates:
            entry["candidates"] = list(self.candidates)
        return entry


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Changes between a map and a recording.

    Every object of the map is in exactly one of stayed, moved, gone, not_seen; every object of the
    recording with a shape in exactly one of stayed, moved, new.

    Attributes:
        map_path, session: of the map, and the name of this recording in it.
        refused: why the recording was not placed in the map; "": it was placed.
        localised_frames, tried_frames: that agree with the map, and that were compared with it.
        sigma_m: standard deviation of positions due to the alignment with the map, metres.
        stayed, moved, gone, new: changes. not_seen: objects of the map where no view passed.
        ambiguous: objects, listed above too, that another object of the same look may be.
    """

    map_path: str
    session: str
    refused: str = ""
    localised_frames: int = 0
    tried_frames: int = 0
    sigma_m: float | None = None
    stayed: Sequence[Change] = field(default_factory=tuple)
    moved: Sequence[Change] = field(default_factory=tuple)
    gone: Sequence[Change] = field(default_factory=tuple)
    new: Sequence[Change] = field(default_factory=tuple)
    not_seen: Sequence[Change] = field(default_factory=tuple)
    ambiguous: Sequence[Change] = field(default_factory=tuple)

    KINDS = ("stayed", "moved", "gone", "new", "not_seen", "ambiguous")

    def to_json(self) -> dict[str, Any]:
        """Return the content of changes.json."""
        facts = {
            **HEADER,
            "map": self.map_path,
            "session": self.session,
            "refused": self.refused,
            "localised_frames": self.localised_frames,
            "tried_frames": self.tried_frames,
            "sigma_m": None if self.sigma_m is None else round(self.sigma_m, 5),
        }
        return facts | {kind: [c.to_json() for c in getattr(self, kind)] for kind in self.KINDS}

    def summary(self) -> str:
        """Summarise the changes in a line: "12 stayed, 2 moved (chair 6 by .56 m), 9 not seen"."""
        if self.refused:
            return f"map {self.map_path}: not placed; {self.refused}"
        counts = []
        for kind in ("stayed", "moved", "gone", "new", "not_seen"):
            changes = getattr(self, kind)
            if not changes and kind != "stayed":
                continue
            text = f"{len(changes)} {kind.replace('_', ' ')}"
            if kind == "moved":
                text += f" ({', '.join(map(_moved_text, changes))})"
            elif kind in ("gone", "new"):
                text += f" ({', '.join(f'{c.class_name} {c.id}' for c in changes)})"
            counts.append(text)
        if self.ambiguous:
            counts.append(f"{len(self.ambiguous)} ambiguous among identical objects")
        return f"map {self.map_path}: " + ", ".join(counts)


def _moved_text(change: Change) -> str:
    """Format a moved object: "chair 6 by .56 m"."""
    text = f"{change.class_name} {change.id}"
    if change.distance_m is not None:
        text += f" by {change.distance_m:.2f} m"
    return text


def write_changes(path: Path, changes: Changes) -> None:
    """Write changes.json."""
    with atomic(path) as part:
        part.write_text(json.dumps(changes.to_json(), indent=1) + "\n")


def read_changes(path: Path) -> Changes:
    """Read changes.json.

    Raises:
        ReobjError: damaged, or another kind of file.
    """
    from reobj.files import load_json
    from reobj.types import ReobjError

    data = load_json(path)
    try:
        if {key: data[key] for key in HEADER} != HEADER:
            raise ReobjError(f"{path}: expected format {HEADER['format']}, version "
                             f"{HEADER['version']}")  # fmt: skip
        lists = {kind: tuple(_change(entry) for entry in data[kind]) for kind in Changes.KINDS}
        names = {f.name for f in dataclasses.fields(Changes)} - {"map_path", *Changes.KINDS}
        facts = {name: data[name] for name in names}
        return Changes(map_path=data["map"], **facts, **lists)
    except (KeyError, TypeError, ValueError) as error:
        raise ReobjError(f"{path}: damaged ({error}); run the video again") from error


def _change(entry: dict[str, Any]) -> Change:
    """Read an entry of changes.json."""
    before, after = (
        None if entry[key] is None else np.array(entry[key], np.float64).reshape(3)
        for key in ("from", "to")
    )
    return Change(
        int(entry["id"]), str(entry["class"]), before, after, entry["distance_m"],
        entry["sigma_m"], str(entry["evidence"]), tuple(entry.get("candidates", ())),
    )  # fmt: skip
