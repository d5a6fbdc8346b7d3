"""What a map holds: as text, as PLY, CSV and JSON, and its earlier recordings for the viewer."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import quadrics
from reobj import __version__
from reobj.export.source import formula_safe
from reobj.files import atomic, cut, numbers, rounded, spans, texts_with_sigma
from reobj.maps.fusion import ObjectState, object_state, scale_of, shapes_of, state_before
from reobj.maps.room_map import MapObject, Observation, RoomMap, Session
from reobj.results.changes import Change, Changes, EarlierSession, Shape
from reobj.results.ply import write_ply
from reobj.results.result import Object
from reobj.types import Array, ReobjError, visible_name

NAME_WIDTH = 24  # characters of a name in a table, as in the overlay


def listing(room: RoomMap, path: Path) -> str:
    """Describe a map and its file: sessions, objects, points."""
    scale = scale_of(room)
    states = _states(room)
    deleted = sum(s.deleted for s in states)
    counts = [
        _count(len(states) - deleted, "object") + (f" ({deleted} deleted)" if deleted else ""),
        _count(len(room.sessions), "session"),
        _count(len(room.points), "point"),
        f"{path.stat().st_size / 1e6:.1f} MB",
    ]
    unit = "units of the map, whose scale is unknown"
    if scale.source != "none":
        unit = f"1 unit = {scale.value:.3g} m"
        unit += f" +- {100 * scale.rel_sigma:.1f} % ({scale.source})" if not room.metric else ""
    lines = [f"{path}: {', '.join(counts)}; {unit}", ""]
    head = ["session", "name", "date", "localised frames", "metres per unit"]
    lines += _table(head, [_session_row(room, k) for k in range(len(room.sessions))])
    size = "size in units" if scale.source == "none" else "size in m"
    head = ["object", "class", size, "sigma", "sessions", "moved", "state"]
    rows = zip(room.objects, states, strict=True)
    lines += ["", *_table(head, [_object_row(found, s, scale) for found, s in rows])]
    if room.merged:
        merged = ", ".join(f"{old} into {kept}" for old, kept in sorted(room.merged.items()))
        lines += ["", f"merged: {merged}"]
    return "\n".join(lines)


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Align columns to the left."""
    width = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = [
        "  ".join(text.ljust(w) for text, w in zip(row, width, strict=True))
        for row in (head, *rows)
    ]
    return [line.rstrip() for line in lines]


def _states(room: RoomMap) -> list[ObjectState]:
    return [object_state(found, room) for found in room.objects]


def _session_row(room: RoomMap, row: int) -> list[str]:
    session = room.sessions[row]
    agreed = f"{session.localised_frames} of {session.tried_frames}"
    scale = "-"
    if session.scale_source != "none":
        sigma = 100 * session.scale_rel_sigma
        scale = f"{session.metres_per_unit:.3g} +- {sigma:.1f} % ({session.scale_source})"
    name = cut(visible_name(session.name), NAME_WIDTH)
    date = visible_name(session.date)
    return [str(session.number), name, date, agreed if session.tried_frames else "-", scale]


def _object_row(found: MapObject, state: ObjectState, scale: quadrics.Scale) -> list[str]:
    size, rel_sigma = _size(state, scale)
    texts = texts_with_sigma(size, size * rel_sigma)
    seen = [o.session for o in found.observations if o.detected]
    moves = sum(o.status == "moved" for o in found.observations)
    return [
        str(state.id),
        cut(state.class_name, NAME_WIDTH),
        " x ".join(value for value, _ in texts),
        " x ".join(sigma for _, sigma in texts),
        spans(sorted(seen)),
        f"{moves} x" if moves else "-",
        _presence(state),
    ]


def _presence(state: ObjectState) -> str:
    return "deleted" if state.deleted else "present" if state.present else "gone"


def _size(state: ObjectState, scale: quadrics.Scale) -> tuple[Array, Array]:
    """Return the extents (3,) in metres, if the scale is known, and their relative sigma (3,)."""
    variance = np.diag(state.cov)[3:6] + scale.rel_sigma**2
    return 2 * state.half_axes * scale.value, np.sqrt(variance)


# ---- Export ------------------------------------------------------------------------------------


def export_map(room: RoomMap, to: str, path: Path) -> Path:
    """Write the objects of a map in the format of another tool.

    Args:
        to: a name in MAP_EXPORTS.
    Returns:
        path of the written file.
    Raises:
        ReobjError: no such format.
    """
    if to not in MAP_EXPORTS:
        raise ReobjError(f"no export of maps called {to!r}; there are {', '.join(MAP_EXPORTS)}")
    MAP_EXPORTS[to](room, path)
    return path


def _write_ply(room: RoomMap, path: Path) -> None:
    """Write the shapes of the present objects as one mesh, world of the map."""
    states = [s for s in _states(room) if s.present and not s.deleted]
    write_ply(path, shapes_of(states), [s.id for s in states], [s.support for s in states])


def _entry(found: MapObject, state: ObjectState, scale: quadrics.Scale) -> dict[str, Any]:
    """Describe an object; keys as in objects.json where they mean the same."""
    size, rel_sigma = _size(state, scale)
    seen = [o.session for o in found.observations if o.detected]
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
        "sessions": sorted(seen),
        "moved": sorted(o.session for o in found.observations if o.status == "moved"),
        "gone": sorted(o.session for o in found.observations if o.status == "gone"),
    }


def _entries(room: RoomMap) -> list[dict[str, Any]]:
    scale = scale_of(room)
    rows = zip(room.objects, _states(room), strict=True)
    return [_entry(found, state, scale) for found, state in rows]


def _write_json(room: RoomMap, path: Path) -> None:
    """Write sessions and objects with their covariances."""
    scale = scale_of(room)
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
        "sessions": [
            {
                "number": s.number, "name": s.name, "date": s.date, "embedder": s.embedder,
                "localised_frames": s.localised_frames, "tried_frames": s.tried_frames,
            }
            for s in room.sessions
        ],
        "objects": _entries(room),
        "merged": {str(old): kept for old, kept in sorted(room.merged.items())},
    }  # fmt: skip
    with atomic(path) as part:
        part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _write_csv(room: RoomMap, path: Path) -> None:
    """Write one line per object; lengths in units of the map, `_m` in metres."""
    head = ["id", "class", "state", "support"]
    vectors = ("center", "size", "size_m", "size_rel_sigma")
    head += [f"{name}_{axis}" for name in vectors for axis in "xyz"]
    head += ["qw", "qx", "qy", "qz", "sessions", "moved", "gone"]
    with atomic(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        for entry in _entries(room):
            row = [entry[name] for name in head[:4]]
            for name in vectors:
                row += entry[name] or [None] * 3
            row += entry["quat_wxyz"]
            row += [len(entry[name]) for name in ("sessions", "moved", "gone")]
            table.writerow([formula_safe(value) for value in row])


MAP_EXPORTS: dict[str, Callable[[RoomMap, Path], None]] = {
    "csv": _write_csv,
    "json": _write_json,
    "ply": _write_ply,
}


# ---- For the viewer ----------------------------------------------------------------------------


def earlier_sessions(
    room: RoomMap, path: Path, fingerprint: str, most: int = 20
) -> tuple[EarlierSession, ...]:
    """List the sessions of a map other than that of one video, in their order.

    Objects that the user deleted are left out. Classes are those that the map has now.

    Args:
        path: of the map, for the summaries. most: sessions, the latest; an object takes 1.2 kB of
            the page in each, without its picture.
    """
    shown = [(o, object_state(o, room).class_name) for o in room.objects if not o.deleted]
    first = min((s.number for s in room.sessions), default=0)
    others = [session for session in room.sessions if session.fingerprint != fingerprint]
    return tuple(
        _earlier_session(session, shown, room, path, session.number == first)
        for session in others[-most:]
    )


def _earlier_session(
    session: Session, shown: list[tuple[MapObject, str]], room: RoomMap, path: Path, is_first: bool
) -> EarlierSession:
    """Describe a session.

    Args:
        shown: objects and their classes. is_first: nothing can have changed.
    """
    objects = []
    pictures = {}
    lists: dict[str, Any] = {kind: [] for kind in Changes.KINDS}
    for found, name in shown:
        own = next((o for o in found.observations if o.session == session.number), None)
        if own is None:
            continue
        if own.detected:
            objects.append(_object(found.id, name, own, room))
        if own.picture:
            pictures[found.id] = own.picture
        stayed = own.status == "stayed"
        before = None if stayed else state_before(found, session.number, room)
        change = _change(found.id, name, own, before, room)
        if not change.fault(own.status):  # without it: the session before was forgotten
            lists[own.status].append(change)
    changes = None if is_first else Changes(str(path), session.name, **lists)
    return EarlierSession(session.name, session.date, tuple(objects), changes, pictures)


def _change(
    number: int, name: str, own: Observation, before: ObjectState | None, room: RoomMap
) -> Change:
    """Describe what a session found out about an object."""
    after = own.center if own.detected else None
    if before is None:
        return Change(number, name, None, after)
    scale = scale_of(room)
    distance = None
    if after is not None and scale.source != "none":
        distance = scale.value * float(np.linalg.norm(after - before.center))
    shape = Shape(before.support, before.half_axes, before.quat_wxyz)
    return Change(number, name, before.center, after, distance, before_shape=shape)


def _object(number: int, name: str, own: Observation, room: RoomMap) -> Object:
    """Return an object as a session saw it."""
    scale = scale_of(room)
    size = 2 * own.half_axes
    return Object(
        number,
        name,
        score=0.0,
        status="ok",
        reason="",
        support=own.support,
        center=own.center,
        half_axes=own.half_axes,
        quat_wxyz=own.quat_wxyz,
        size=size,
        size_m=None if scale.source == "none" else size * scale.value,
        size_rel_sigma=np.sqrt(np.diag(own.cov)[3:6] + scale.rel_sigma**2),
        cov=own.cov,
    )
