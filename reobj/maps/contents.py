"""What a map holds: listed, corrected, exported, shown in the viewer; undo for `serve`.

Corrections return a new map.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import quadrics
from reobj import __version__
from reobj.export.source import formula_safe
from reobj.files import atomic, cut, numbers, rounded, spans, texts_with_sigma
from reobj.maps.fusion import (
    CHI2_3,
    ObjectState,
    class_weights,
    object_state,
    observed_shapes,
    scale_of,
    shapes_of,
    state_before,
)
from reobj.maps.room_map import (
    MapObject,
    MapPoints,
    Observation,
    RoomMap,
    Session,
    encoded,
    map_lock,
)
from reobj.results.changes import Change, Changes, EarlierSession, Shape
from reobj.results.edits import Edits
from reobj.results.ply import write_ply
from reobj.results.result import Object
from reobj.types import CLASS_NAME_MAX, Array, ReobjError, counted, visible_name

NAME_WIDTH = 24  # characters of a name in a table, as in the overlay
MOST_SESSIONS = 20  # in the viewer, the latest; an object takes 1.2 kB of the page in each

# ---- Corrections -------------------------------------------------------------------------------


def find_session(room: RoomMap, session: int | str) -> Session:
    """Return a session by its number, or by the name of its recording.

    Raises:
        ReobjError: no such session, or several of this name.
    """
    text = str(session).strip()
    found = [s for s in room.sessions if str(s.number) == text]
    found = found or [s for s in room.sessions if s.name == text]
    if len(found) != 1:
        known = ", ".join(f"{s.number} ({s.name})" for s in found or room.sessions) or "none"
        text = f"{len(found) or 'no'} session{'s' if found else ''} {text!r} in the map"
        raise ReobjError(f"{text}; it has {known}" + ("; give a number" if found else ""))
    return found[0]


def forget(room: RoomMap, session: int | str) -> RoomMap:
    """Remove the observations and points that a session added.

    An object that no other session detected is removed; its number is not used again. The world
    stays the same, also without the first session.

    Args:
        session: number, or name of the recording.
    Raises:
        ReobjError: no such session.
    """
    number = find_session(room, session).number
    left = ((o, _without_session(o.observations, number)) for o in room.objects)
    objects = [dataclasses.replace(o, observations=rows) for o, rows in left if rows]
    ids = [o.id for o in objects]
    points = room.points[room.points.session != number]
    on_known = np.isin(points.object_id, ids)
    return dataclasses.replace(
        room,
        sessions=tuple(s for s in room.sessions if s.number != number),
        objects=tuple(objects),
        points=dataclasses.replace(points, object_id=np.where(on_known, points.object_id, 0)),
        merged={old: kept for old, kept in room.merged.items() if kept in ids},
    )


def _without_session(rows: Sequence[Observation], session: int) -> tuple[Observation, ...]:
    """Remove the observation of a session; the next one then has the status of its place.

    Observations without a detection say nothing before the first detection and are removed too.
    """
    left = list[Observation]()
    other_place = False
    for o in sorted(rows, key=lambda o: o.session):
        other_place |= o.status in ("new", "moved")
        if o.session == session:
            continue
        if o.detected:
            kind = "new" if not left else "moved" if other_place else "stayed"
            left.append(dataclasses.replace(o, status=kind))
            other_place = False
        elif left:
            left.append(o)
    return tuple(left)


def merge(room: RoomMap, keep: int, drop: int) -> RoomMap:
    """Merge two objects that are one; the number `drop` then refers to `keep`.

    Where a session detected both, the observation of more views is kept. The object counts as moved
    where the places of its consecutive observations differ by more than 3 sigma.

    Raises:
        ReobjError: no such object, or both are the same.
    """
    kept = room.object(keep)
    dropped = room.object(drop)
    if kept.id == dropped.id:
        raise ReobjError(f"objects {keep} and {drop} are the same: {kept.id}")
    rows = _joined(kept, dropped, room)
    joined = dataclasses.replace(kept, observations=rows, name=kept.name or dropped.name)
    number = room.points.object_id
    number = np.where(number == dropped.id, kept.id, number)
    merged = {old: kept.id if to == dropped.id else to for old, to in room.merged.items()}
    return dataclasses.replace(
        _with(room, joined, without=dropped.id),
        points=dataclasses.replace(room.points, object_id=number),
        merged=merged | {dropped.id: kept.id},
    )


def _joined(a: MapObject, b: MapObject, room: RoomMap) -> tuple[Observation, ...]:
    """Join the observations of two objects, one a session."""
    rows = list[Observation]()
    last: tuple[Observation, int] | None = None  # detection, and the object that it is from
    both = [(o, found.id) for found in (a, b) for o in found.observations]
    for session in sorted({o.session for o, _ in both}):
        here = [(o, source) for o, source in both if o.session == session]
        seen = [(o, source) for o, source in here if o.detected]
        if not seen:  # the status is about the place of the last detection
            rows += [o for o, source in here if last is not None and source == last[1]]
            continue
        best, source = max(seen, key=lambda entry: entry[0].views)
        status = "new"
        if last is not None:
            same = source == last[1]
            moved = best.status == "moved" if same else _elsewhere(last[0], best, room)
            status = "moved" if moved else "stayed"
        classes = class_weights([o for o, _ in seen])
        best = dataclasses.replace(best, classes=classes, status=status)
        rows.append(best)
        last = best, source
    return tuple(rows)


def _elsewhere(before: Observation, after: Observation, room: RoomMap) -> bool:
    """Test whether the centres of two observations differ by more than 3 sigma."""
    shapes = observed_shapes([before, after], room)
    shift = shapes.center[1] - shapes.center[0]
    return bool(shift @ np.linalg.solve(shapes.cov[:, :3, :3].sum(0), shift) > CHI2_3)


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
    """Mark an object as deleted: it is matched in later sessions and left out of results.

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
        known = {o.id for o in room.objects} | room.merged.keys()
        numbers = [ref.id for ref in (edit.object, edit.other) if ref is not None]
        if not known.issuperset(numbers):
            continue
        if edit.do == "rename":
            room = rename(room, numbers[0], edit.class_name)
        elif edit.do == "delete":
            room = delete(room, numbers[0])
        elif edit.do == "merge" and len({room.object(number).id for number in numbers}) == 2:
            room = merge(room, *numbers)
    return room


def corrected(
    room: RoomMap,
    forgotten: Sequence[str],
    merges: Sequence[tuple[int, int]],
    renames: Sequence[tuple[int, str]],
    deleted: Sequence[int],
    undeleted: Sequence[int],
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
    for text, chosen in (("deleted", deleted), ("no longer deleted", undeleted)):
        for number in chosen:
            room = delete(room, number, chosen is deleted)
            lines.append(f"{text}: object {room.object(number).id}")
    return room, lines


# ---- As text -----------------------------------------------------------------------------------


def listing(room: RoomMap, path: Path) -> str:
    """Describe a map and its file: sessions, objects, points."""
    scale = scale_of(room)
    states = _states(room)
    deleted = sum(s.deleted for s in states)
    counts = [
        counted(len(states) - deleted, "object", "objects"),
        counted(len(room.sessions), "session", "sessions"),
        counted(len(room.points), "point", "points"),
        f"{path.stat().st_size / 1e6:.1f} MB",
    ]
    counts[0] += f" ({deleted} deleted)" if deleted else ""
    unit = "units of the map, whose scale is unknown"
    if scale.source != "none":
        unit = "1 unit = " + (f"{scale.value:.3g} m" if room.metric else _scale_text(scale, " m"))
    sessions = [["session", "name", "date", "localised frames", "metres per unit"]]
    for s in room.sessions:
        agreed = f"{s.localised_frames} of {s.tried_frames}" if s.tried_frames else "-"
        name = cut(visible_name(s.name), NAME_WIDTH)
        measured = "-" if s.scale_source == "none" else _scale_text(s.scale)
        sessions.append([str(s.number), name, visible_name(s.date), agreed, measured])
    size = "size in units" if scale.source == "none" else "size in m"
    objects = [["object", "class", size, "sigma", "sessions", "moved", "state"]]
    for found, state in zip(room.objects, states, strict=True):
        extents, rel_sigma = _size(state, scale)
        texts = zip(*texts_with_sigma(extents, extents * rel_sigma), strict=True)
        moves = len(_sessions(found, "moved"))
        objects.append([
            str(state.id), cut(state.class_name, NAME_WIDTH), *(" x ".join(t) for t in texts),
            spans(_sessions(found)), f"{moves} x" if moves else "-", _presence(state),
        ])  # fmt: skip
    lines = [f"{path}: {', '.join(counts)}; {unit}", ""]
    lines += [*_table(sessions), "", *_table(objects)]
    if room.merged:
        merged = ", ".join(f"{old} into {kept}" for old, kept in sorted(room.merged.items()))
        lines += ["", f"merged: {merged}"]
    return "\n".join(lines)


def _scale_text(scale: quadrics.Scale, unit: str = "") -> str:
    return f"{scale.value:.3g}{unit} +- {100 * scale.rel_sigma:.1f} % ({scale.source})"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align columns to the left."""
    width = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, width)).rstrip() for row in rows]


def _states(room: RoomMap) -> list[ObjectState]:
    return [object_state(found, room) for found in room.objects]


def _sessions(found: MapObject, status: str = "") -> list[int]:
    """Return the sessions that detected an object, or only the ones with a status."""
    rows = found.observations
    return sorted(o.session for o in rows if (o.status == status if status else o.detected))


def _presence(state: ObjectState) -> str:
    return "deleted" if state.deleted else "present" if state.present else "gone"


def _size(state: ObjectState, scale: quadrics.Scale) -> tuple[Array, Array]:
    """Return the extents (3,) in metres, if the scale is known, and their relative sigma (3,)."""
    variance = np.diag(state.cov)[3:6] + scale.rel_sigma**2
    return 2 * state.half_axes * scale.value, np.sqrt(variance)


# ---- Exports -----------------------------------------------------------------------------------


def _write_ply(room: RoomMap, path: Path) -> None:
    """Write the shapes of the present objects as one mesh, world of the map."""
    states = [s for s in _states(room) if s.present and not s.deleted]
    write_ply(path, shapes_of(states), [s.id for s in states], [s.support for s in states])


def _entry(found: MapObject, state: ObjectState, scale: quadrics.Scale) -> dict[str, Any]:
    """Describe an object; keys as in objects.json where they mean the same."""
    size, rel_sigma = _size(state, scale)
    return {
        "id": state.id,
        "class": state.class_name,
        "state": _presence(state),
        "support": state.support,
        "center": numbers(state.center, float(state.half_axes.max())),
        "size": numbers(2 * state.half_axes),
        "size_m": numbers(size) if scale.source != "none" else None,
        "size_rel_sigma": numbers(rel_sigma),
        "quat_wxyz": numbers(state.quat_wxyz),
        "cov": np.reshape(numbers(state.cov), (9, 9)).tolist(),
        "classes": {name: rounded(weight, 3) for name, weight in state.classes.items()},
        "detection_rate": rounded(state.detection_rate, 3),
        "log_odds": rounded(state.log_odds, 2),
        "sessions": _sessions(found),
        "moved": _sessions(found, "moved"),
        "gone": _sessions(found, "gone"),
    }


def _entries(room: RoomMap) -> list[dict[str, Any]]:
    scale = scale_of(room)
    return [_entry(found, object_state(found, room), scale) for found in room.objects]


def _write_json(room: RoomMap, path: Path) -> None:
    """Write sessions and objects with their covariances."""
    scale = scale_of(room)
    facts = ("number", "name", "date", "embedder", "localised_frames", "tried_frames")
    data = {
        "format": "reobj-map-objects",
        "version": 1,
        "reobj_track": __version__,
        "map": room.map_id,
        "units": "m" if room.metric else "arbitrary",
        "up_in_world": None if room.up is None else numbers(room.up),
        "scale": {
            "metres_per_unit": float(f"{scale.value:.6g}"),
            "rel_sigma": rounded(scale.rel_sigma, 4),
            "source": scale.source,
        },
        "sessions": [{name: getattr(s, name) for name in facts} for s in room.sessions],
        "objects": _entries(room),
        "merged": {str(old): kept for old, kept in sorted(room.merged.items())},
    }
    _write(path, (json.dumps(data, indent=1) + "\n").encode())


def _write_csv(room: RoomMap, path: Path) -> None:
    """Write one line per object; lengths in units of the map, `_m` in metres."""
    facts = ["id", "class", "state", "support"]
    vectors = ("center", "size", "size_m", "size_rel_sigma")
    head = [*facts, *(f"{name}_{axis}" for name in vectors for axis in "xyz")]
    head += ["qw", "qx", "qy", "qz", "sessions", "moved", "gone"]
    with atomic(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        for entry in _entries(room):
            row = [entry[name] for name in facts]
            for name in vectors:
                row += entry[name] or [None] * 3
            row += entry["quat_wxyz"]
            row += [len(entry[name]) for name in head[-3:]]
            table.writerow([formula_safe(value) for value in row])


MAP_EXPORTS: dict[str, Callable[[RoomMap, Path], None]] = {
    "csv": _write_csv,
    "json": _write_json,
    "ply": _write_ply,
}


# ---- For the viewer ----------------------------------------------------------------------------


def earlier_sessions(room: RoomMap, path: Path, fingerprint: str) -> tuple[EarlierSession, ...]:
    """List the sessions of a map without the one of a video, in their order.

    Objects that the user deleted are left out. Classes are those that the map has now.

    Args:
        path: of the map, for the summaries.
    """
    shown = [(o, object_state(o, room).class_name) for o in room.objects if not o.deleted]
    others = [session for session in room.sessions if session.fingerprint != fingerprint]
    return tuple(_earlier_session(s, shown, room, path) for s in others[-MOST_SESSIONS:])


def _earlier_session(
    session: Session, shown: Sequence[tuple[MapObject, str]], room: RoomMap, path: Path
) -> EarlierSession:
    """Describe a session. shown: objects and their classes."""
    objects = []
    pictures = {}
    lists: dict[str, Any] = {kind: [] for kind in Changes.KINDS}
    scale = scale_of(room)
    for found, name in shown:
        own = next((o for o in found.observations if o.session == session.number), None)
        if own is None:
            continue
        if own.detected:
            size = 2 * own.half_axes
            objects.append(Object(
                found.id, name, score=0.0, status="ok", reason="", support=own.support,
                center=own.center, half_axes=own.half_axes, quat_wxyz=own.quat_wxyz, size=size,
                size_m=None if scale.source == "none" else size * scale.value,
                size_rel_sigma=np.sqrt(np.diag(own.cov)[3:6] + scale.rel_sigma**2), cov=own.cov,
            ))  # fmt: skip
        if own.picture:
            pictures[found.id] = own.picture
        change = Change(found.id, name, after=own.center if own.detected else None)
        before = None if own.status == "stayed" else state_before(found, session.number, room)
        if before is not None:
            distance = None
            if change.after is not None and scale.source != "none":
                distance = scale.value * float(np.linalg.norm(change.after - before.center))
            shape = Shape(before.support, before.half_axes, before.quat_wxyz)
            change = dataclasses.replace(
                change, before=before.center, distance_m=distance, before_shape=shape
            )
        if not change.fault(own.status):  # without it: the session before was forgotten
            lists[own.status].append(change)
    # in the first session nothing can have changed
    changes = None if session is room.sessions[0] else Changes(str(path), session.name, **lists)
    return EarlierSession(session.name, session.date, tuple(objects), changes, pictures)


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
        """Add digests of maps to the digests of a copy."""
        found = [*_digests(copy), *map(self._digest, rooms)]
        _write(copy.with_suffix(".digests"), "\n".join(found).encode())

    def _digest(self, room: RoomMap) -> str:
        """Hash the corrections of a map, and all that its other recordings added, except points.

        A refit of the recording itself does not change it.
        """
        corrections = [[o.id, o.name, o.deleted] for o in room.objects if o.name or o.deleted]
        own = room.session_of(self.recording)
        others = room if own is None else forget(room, own.number)
        others = dataclasses.replace(  # free numbers grow with each refit
            others, points=MapPoints.empty(), next_id=1, next_session=1, merged=room.merged
        )
        arrays, facts = encoded(others)
        digest = hashlib.sha256(json.dumps([facts, corrections]).encode())
        for values in arrays.values():
            digest.update(np.asarray(values).tobytes())
        return digest.hexdigest()


def _digests(copy: Path) -> list[str]:
    """Read the digests of a copy."""
    path = copy.with_suffix(".digests")
    return path.read_text(encoding="utf-8").split() if path.is_file() else []


def _write(path: Path, content: bytes) -> None:
    with atomic(path) as part:
        part.write_bytes(content)
