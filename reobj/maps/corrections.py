"""Corrections of a map: forget a session, merge, rename and delete objects; undo for `serve`.

All functions return a new map.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from reobj.files import atomic, spans
from reobj.maps.fusion import CHI2_3, observed_shapes
from reobj.maps.listing import earlier_sessions
from reobj.maps.room_map import MapObject, MapPoints, Observation, RoomMap, Session, map_lock
from reobj.results.changes import EarlierSession
from reobj.results.edits import Edits
from reobj.types import CLASS_NAME_MAX, ReobjError, visible_name


def find_session(room: RoomMap, session: int | str) -> Session:
    """Return a session by its number, or by the name of its recording.

    Raises:
        ReobjError: no such session, or several of this name.
    """
    text = str(session).strip()
    found = [s for s in room.sessions if str(s.number) == text]
    found = found or [s for s in room.sessions if s.name == text]
    if len(found) == 1:
        return found[0]
    listed = found or room.sessions
    known = ", ".join(f"{s.number} ({s.name})" for s in listed) or "none"
    if found:
        raise ReobjError(f"{len(found)} sessions are called {text!r}; give a number: {known}")
    raise ReobjError(f"no session {text!r} in the map; it has {known}")


def forget(room: RoomMap, session: int | str) -> RoomMap:
    """Remove what a session added: its observations and points.

    An object that no other session detected is removed; its number is not used again. The world
    stays the same, also without the first session.

    Args:
        session: number, or name of the recording.
    Raises:
        ReobjError: no such session.
    """
    number = find_session(room, session).number
    objects = []
    for found in room.objects:
        left = _without_session(found.observations, number)
        if left:
            objects.append(dataclasses.replace(found, observations=left))
    ids = [found.id for found in objects]
    points = room.points[room.points.session != number]
    on_known = np.isin(points.object_id, ids)
    return dataclasses.replace(
        room,
        sessions=tuple(s for s in room.sessions if s.number != number),
        objects=tuple(objects),
        points=dataclasses.replace(points, object_id=np.where(on_known, points.object_id, 0)),
        merged={old: kept for old, kept in room.merged.items() if kept in ids},
    )


def _without_session(
    observations: tuple[Observation, ...], session: int
) -> tuple[Observation, ...]:
    """Remove the observation of a session; the next one then has the status of its place.

    Observations without a detection say nothing before the first detection and are removed too.
    """
    left = list[Observation]()
    other_place = False
    for o in sorted(observations, key=lambda o: o.session):
        moved = o.status in ("new", "moved")
        if o.session == session:
            other_place = other_place or moved
        elif not o.detected:
            left += [o] if left else []
        else:
            kind = "new" if not left else "moved" if moved or other_place else "stayed"
            left.append(dataclasses.replace(o, status=kind))
            other_place = False
    return tuple(left)


def merge(room: RoomMap, keep: int, drop: int) -> RoomMap:
    """Join two objects that are one; the number `drop` then means `keep`.

    Where a session detected both, the observation of more views is kept. The object counts as moved
    where the places of its consecutive observations differ by more than 3 sigma.

    Raises:
        ReobjError: no such object, or both are the same.
    """
    kept = room.object(keep)
    dropped = room.object(drop)
    if kept.id == dropped.id:
        raise ReobjError(f"objects {keep} and {drop} are the same: {kept.id}")
    joined = dataclasses.replace(
        kept, observations=_joined(kept, dropped, room), name=kept.name or dropped.name
    )
    number = room.points.object_id
    points = dataclasses.replace(
        room.points, object_id=np.where(number == dropped.id, kept.id, number)
    )
    merged = {old: kept.id if to == dropped.id else to for old, to in room.merged.items()}
    return dataclasses.replace(
        _with(room, joined, without=dropped.id),
        points=points,
        merged=merged | {dropped.id: kept.id},
    )


def _joined(a: MapObject, b: MapObject, room: RoomMap) -> tuple[Observation, ...]:
    """Join the observations of two objects, one a session."""
    rows = list[Observation]()
    sources = list[int]()  # object that each detection is from
    detections = list[Observation]()
    for session in sorted({o.session for found in (a, b) for o in found.observations}):
        pair = [(o, found.id) for found in (a, b) for o in found.observations
                if o.session == session]  # fmt: skip
        seen = [(o, source) for o, source in pair if o.detected]
        if not seen:  # what it says is of the place of the object that was detected last
            rows += [o for o, source in pair if sources and source == sources[-1]]
            continue
        best, source = max(seen, key=lambda entry: entry[0].views)
        classes = {
            name: sum(o.classes.get(name, 0.0) for o, _ in seen)
            for name in sorted({name for o, _ in seen for name in o.classes})
        }
        status = "new"
        if sources:
            status = "moved" if best.status == "moved" else "stayed"
        if sources and source != sources[-1]:
            status = "moved" if _elsewhere(detections[-1], best, room) else "stayed"
        best = dataclasses.replace(best, classes=classes, status=status)
        rows.append(best)
        detections.append(best)
        sources.append(source)
    return tuple(rows)


def _elsewhere(before: Observation, after: Observation, room: RoomMap) -> bool:
    """Test whether the centres of two observations differ by more than 3 sigma."""
    shapes = observed_shapes([before, after], room)
    shift = shapes.center[1] - shapes.center[0]
    distance = shift @ np.linalg.solve(shapes.cov[:, :3, :3].sum(0), shift)
    return bool(distance > CHI2_3)


def rename(room: RoomMap, number: int, name: str) -> RoomMap:
    """Give an object a class that its detections do not change.

    Raises:
        ReobjError: no such object, or an unusable name.
    """
    name = name.strip()
    if not name or not name.isprintable() or len(name) > CLASS_NAME_MAX:
        expected = f"1 to {CLASS_NAME_MAX} printable characters"
        raise ReobjError(f"{name[:40]!r} is no name of an object; expected {expected}")
    return _with(room, dataclasses.replace(room.object(number), name=name))


def delete(room: RoomMap, number: int, deleted: bool = True) -> RoomMap:
    """Mark an object as none: it is matched in later sessions and left out of results.

    Args:
        deleted: False undoes it.
    Raises:
        ReobjError: no such object.
    """
    return _with(room, dataclasses.replace(room.object(number), deleted=deleted))


def _with(room: RoomMap, changed: MapObject, without: int = 0) -> RoomMap:
    """Replace an object by its number, and remove another one."""
    objects = [changed if o.id == changed.id else o for o in room.objects if o.id != without]
    return dataclasses.replace(room, objects=tuple(objects))


def with_edits(room: RoomMap, edits: Edits) -> RoomMap:
    """Apply the corrections of the viewer to the objects of the map, by their numbers.

    A split has no number of the map yet. Edits of objects that the map does not have, and those
    that were applied before, change nothing.
    """
    for edit in edits.edits if edits.map_id == room.map_id else ():
        ids = {o.id for o in room.objects} | set(room.merged)
        numbers = [edit.object.id] + ([] if edit.other is None else [edit.other.id])
        if not ids.issuperset(numbers):
            continue
        if edit.do == "rename":
            room = rename(room, edit.object.id, edit.class_name)
        elif edit.do == "delete":
            room = delete(room, edit.object.id)
        elif edit.do == "merge" and len({room.object(number).id for number in numbers}) == 2:
            room = merge(room, *numbers)
    return room


def corrected(
    room: RoomMap,
    forgotten: Sequence[str] = (),
    merges: Sequence[tuple[int, int]] = (),
    renames: Sequence[tuple[int, str]] = (),
    deleted: Sequence[int] = (),
    undeleted: Sequence[int] = (),
) -> tuple[RoomMap, list[str]]:
    """Apply corrections in the order of the arguments.

    Args:
        forgotten: sessions, by number or name. merges: numbers to keep and to drop.
        renames: numbers and names. deleted, undeleted: numbers.
    Returns:
        the new map, and a line for each correction.
    Raises:
        ReobjError: of the first correction that is not possible.
    """
    lines = []
    for text in forgotten:
        session = find_session(room, text)
        left = forget(room, text)
        lost = sorted({o.id for o in room.objects} - {o.id for o in left.objects})
        line = f"forgotten: session {session.number} ({visible_name(session.name)})"
        line += f", {len(room.points) - len(left.points)} points"
        lines.append(line + (f", and what it alone saw: objects {spans(lost)}" if lost else ""))
        room = left
    for keep, drop in merges:
        number = room.object(drop).id
        room = merge(room, keep, drop)
        lines.append(f"merged: object {number} into {room.object(keep).id}")
    for number, name in renames:
        room = rename(room, number, name)
        found = room.object(number)
        lines.append(f"renamed: object {found.id} is called {found.name}")
    for text, state, chosen in (
        ("deleted", True, deleted),
        ("no longer deleted", False, undeleted),
    ):
        for number in chosen:
            room = delete(room, number, state)
            lines.append(f"{text}: object {room.object(number).id}")
    return room, lines


# ---- Undo of corrections that were saved in the viewer ------------------------------------------


class FolderMap:
    """The map of an output folder, and copies of it from before corrections were saved.

    Beside a copy lies a file of digests (`_digest`): of the map when it was copied, and with the
    corrections. Undo restores the copy if the map still has one of them: then no other run, and no
    `map` command, has written it. The recording itself may have been fitted again since.

    Args:
        path: of the map. recording: key of the recording, as `session_key` returns it.
        frozen: fits of the folder do not change the map.
    """

    def __init__(self, path: Path, recording: str, frozen: bool) -> None:
        self.path = path
        self.recording = recording
        self.frozen = frozen

    def others(self) -> Sequence[EarlierSession]:
        """Return the other recordings that the map has now.

        Raises:
            ReobjError: the map is missing or damaged.
        """
        return earlier_sessions(RoomMap.load(self.path), self.path, self.recording)

    def keep(self, copy: Path, edits: Edits) -> None:
        """Copy the map before corrections are applied.

        Args:
            copy: file to write. edits: the corrections; their digest is stored in advance, for a
                program that is killed after it applied them.
        Raises:
            ReobjError: the map is missing or damaged.
        """
        before = RoomMap.load(self.path)
        _write(copy, self.path.read_bytes())
        self._add(copy, before, with_edits(before, edits))

    def applied(self, copy: Path) -> None:
        """Store the digest of the map with the corrections that were applied after `copy`."""
        self._add(copy, RoomMap.load(self.path))

    def restore(self, copy: Path) -> Callable[[], None]:
        """Replace the map by a copy.

        Returns:
            a function that undoes it, unless another run has written the map since.
        Raises:
            ReobjError: another run writes the map, or has changed it since; it stays as it is.
        """
        with map_lock(self.path):
            after = self.path.read_bytes()
            if self._digest(RoomMap.load(self.path)) not in _digests(copy):
                raise ReobjError(
                    f"{self.path}: another command has changed the map since this save, and undo "
                    "would lose it; nothing was undone. `map MAP --rename`, `--undelete` correct it"
                )
            _write(self.path, copy.read_bytes())

        def put_back() -> None:
            with map_lock(self.path):
                if self._digest(RoomMap.load(self.path)) == self._digest(RoomMap.load(copy)):
                    _write(self.path, after)

        return put_back

    def _add(self, copy: Path, *rooms: RoomMap) -> None:
        """Add digests of maps to those of a copy."""
        found = dict.fromkeys([*_digests(copy), *map(self._digest, rooms)])
        _write(_digests_path(copy), "\n".join(found).encode())

    def _digest(self, room: RoomMap) -> str:
        """Hash the corrections of a map, and all that its other recordings added, except points.

        A refit of the recording itself does not change it.
        """
        corrections = [[o.id, o.name, o.deleted] for o in room.objects if o.name or o.deleted]
        merged = sorted(room.merged.items())
        own = room.session_of(self.recording)
        others = room if own is None else forget(room, own.number)
        largest = 1 << 30  # free numbers grow with each refit
        others = dataclasses.replace(
            others, points=MapPoints.empty(), next_id=largest, next_session=largest, merged={}
        )
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "others.map"
            others.save(file)  # the same map gives the same bytes
            content = file.read_bytes()
        return hashlib.sha256(content + json.dumps([corrections, merged]).encode()).hexdigest()


def _digests_path(copy: Path) -> Path:
    return copy.with_suffix(".digests")


def _digests(copy: Path) -> list[str]:
    """Read the digests of a copy."""
    path = _digests_path(copy)
    return path.read_text(encoding="utf-8").split() if path.is_file() else []


def _write(path: Path, content: bytes) -> None:
    with atomic(path) as part:
        part.write_bytes(content)
