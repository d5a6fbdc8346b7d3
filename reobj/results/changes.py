"""Changes between a map and a recording: objects that stayed, moved, left, arrived; changes.json"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec

from reobj.files import numbers, rounded
from reobj.results.entries import Object, check_shape, read_json, write_json
from reobj.types import (
    Array,
    FiniteFloat,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    Quaternion,
    Vector,
    counted,
)

HEADER = {"format": "reobj-changes", "version": 1}


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Shape and orientation of an object, without its centre.

    Attributes:
        support: "box", "cylinder" or "ellipsoid". half_axes: (3,) world units.
        quat_wxyz: (4,) unit quaternion, world_from_obj.
    """

    support: Annotated[str, msgspec.Meta(pattern="^(box|cylinder|ellipsoid)$")]
    half_axes: Vector
    quat_wxyz: Quaternion

    def __post_init__(self) -> None:
        """Check sizes and orientation."""
        check_shape(self.quat_wxyz, self.half_axes)

    def to_json(self) -> dict[str, Any]:
        """Return the `from_shape` of changes.json."""
        axes = {k: numbers(getattr(self, k)) for k in ("half_axes", "quat_wxyz")}
        return {"support": self.support, **axes}


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
        before_shape: at `before`; None: not known. Page and film draw it at the former place.
    """

    id: PositiveInt
    class_name: str
    before: Vector | None = None
    after: Vector | None = None
    distance_m: NonNegativeFloat | None = None
    sigma_m: NonNegativeFloat | None = None
    evidence: str = ""
    candidates: tuple[NonNegativeInt, ...] = ()
    before_shape: Shape | None = None

    @property
    def name(self) -> str:
        """Class and number: "chair 6"."""
        return f"{self.class_name} {self.id}"

    @property
    def _text(self) -> str:
        """Its name, of a moved object with the distance: "chair 6 by 0.56 m"."""
        return self.name if self.distance_m is None else f"{self.name} by {self.distance_m:.2f} m"

    def to_json(self) -> dict[str, Any]:
        """Return the entry of changes.json."""
        return {
            "id": self.id,
            "class": self.class_name,
            "from": self._rounded(self.before),
            "to": self._rounded(self.after),
            "distance_m": rounded(self.distance_m, 4),
            "sigma_m": rounded(self.sigma_m, 4),
            "evidence": self.evidence,
            "candidates": list(self.candidates),
            "from_shape": None if self.before_shape is None else self.before_shape.to_json(),
        }

    def _rounded(self, center: Array | None) -> list[float] | None:
        """Round a centre as in objects.json, where the size is known."""
        if center is None or self.before_shape is None:
            return None if center is None else center.tolist()
        return numbers(center, 2 * float(self.before_shape.half_axes.max()))

    def fault(self, kind: str) -> str:
        """Name the positions that a change of a kind lacks, as keys of changes.json; "": none."""
        wanted = {"moved": "from to", "gone": "from", "new": "to"}.get(kind, "")
        known = {"from": self.before, "to": self.after}
        return " ".join(key for key in wanted.split() if known[key] is None)


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Changes between a map and a recording.

    Every object of the map is in exactly one of stayed, moved, gone, not_seen; every object of the
    recording with a shape in exactly one of stayed, moved, new. The number of an object of the
    recording (`Object.id`) is that of its change, and its world is that of the map.

    Attributes:
        map_path, session: of the map, and the name of this recording in it.
        refused: why the recording was not placed in the map; "": it was placed.
        placed_by: "points" of the map in its images, or its "objects"; "": it made the map, or was
            refused.
        localised_frames, tried_frames: that agree with the map, and that were compared with it.
        components: components of the trajectory (`Object.part`) that were placed in the map.
        sigma_m: standard deviation of positions due to the alignment with the map, metres.
        stayed, moved, gone, new: changes. not_seen: objects of the map where no view passed, or
            of which the evidence is too weak.
        ambiguous: objects, listed above too, that another object of the same look may be.
    """

    map_path: str
    session: str
    refused: str = ""
    localised_frames: NonNegativeInt = 0
    tried_frames: NonNegativeInt = 0
    components: tuple[NonNegativeInt, ...] = (0,)
    sigma_m: FiniteFloat | None = None
    stayed: tuple[Change, ...] = ()
    moved: tuple[Change, ...] = ()
    gone: tuple[Change, ...] = ()
    new: tuple[Change, ...] = ()
    not_seen: tuple[Change, ...] = ()
    ambiguous: tuple[Change, ...] = ()
    placed_by: Annotated[str, msgspec.Meta(pattern="^(points|objects|)$")] = ""

    KINDS = ("stayed", "moved", "gone", "new", "not_seen", "ambiguous")

    def of_objects(self) -> dict[int, tuple[str, Change]]:
        """Map the number of each object to its kind of change, other than ambiguous, and change."""
        kinds = [kind for kind in self.KINDS if kind != "ambiguous"]
        return {c.id: (kind, c) for kind in kinds for c in getattr(self, kind)}

    def to_json(self) -> dict[str, Any]:
        """Return the content of changes.json."""
        facts = {
            **HEADER,
            "map": self.map_path,
            "session": self.session,
            "refused": self.refused,
            "placed_by": self.placed_by,
            "localised_frames": self.localised_frames,
            "tried_frames": self.tried_frames,
            "components": list(self.components),
            "sigma_m": rounded(self.sigma_m, 5),
        }
        return facts | {kind: [c.to_json() for c in getattr(self, kind)] for kind in self.KINDS}

    @property
    def made_the_map(self) -> bool:
        """True of the recording that made the map: that its objects are new is no change."""
        return bool(self.new) and not self.placed_by and len(self.of_objects()) == len(self.new)

    def summary(self) -> str:
        """Summarise the changes in a line: "12 stayed, 1 moved (chair 6 by 0.56 m)"."""
        if self.refused:
            return f"map {self.map_path}: not placed; {self.refused}"
        if self.made_the_map:
            return f"map {self.map_path}: made with {counted(len(self.new), 'object', 'objects')}"
        counts = []
        for kind in ("stayed", "moved", "gone", "new", "not_seen"):
            changes = getattr(self, kind)
            if not changes and kind != "stayed":
                continue
            text = f"{len(changes)} {kind.replace('_', ' ')}"
            if kind in ("moved", "gone", "new"):
                text += f" ({', '.join(c._text for c in changes)})"
            counts.append(text)
        if self.ambiguous:
            counts.append(f"{len(self.ambiguous)} ambiguous among identical objects")
        return f"map {self.map_path}: " + ", ".join(counts)


@dataclass(frozen=True, slots=True, eq=False)
class EarlierSession:
    """Another recording in the map, for the viewer.

    Attributes:
        name: of the recording. date: when it was added to the map, ISO 8601, UTC.
        objects: that were detected in it: places and sizes then, in the world of the map.
        changes: since the recordings before it, as far as the map has them; None: it is the first.
        pictures: JPEG of objects, by number; {}: the map has none.
    """

    name: str
    date: str
    objects: Sequence[Object]
    changes: Changes | None = None
    pictures: Mapping[int, bytes] = field(default_factory=dict)


def write_earlier(path: Path, sessions: Sequence[EarlierSession]) -> None:
    """Write the other recordings of a map, for `read_earlier`."""
    data = [
        {
            "name": session.name,
            "date": session.date,
            "objects": [o.to_json() for o in session.objects],
            "changes": None if session.changes is None else session.changes.to_json(),
            "pictures": msgspec.to_builtins(session.pictures, str_keys=True),
        }
        for session in sessions
    ]  # fmt: skip
    write_json(path, {"sessions": data}, indent=None)


@dataclass(frozen=True, slots=True)
class _EarlierFile:
    """Content of the file of `write_earlier`."""

    sessions: tuple[EarlierSession, ...]


def read_earlier(path: Path) -> tuple[EarlierSession, ...]:
    """Read what `write_earlier` wrote.

    Raises:
        ReobjError: damaged, or another kind of file.
    """
    return read_json(_EarlierFile, path, own=True).sessions


def write_changes(path: Path, changes: Changes) -> None:
    """Write changes.json."""
    write_json(path, changes.to_json())


def read_changes(path: Path) -> Changes:
    """Read changes.json, and check the types, shapes and ranges of its values.

    Raises:
        ReobjError: damaged, or another kind of file.
    """
    return read_json(Changes, path, HEADER, own=True)
