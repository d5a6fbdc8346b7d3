"""The earlier recordings of a map, for the viewer: objects as they were, and what changed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from reobj.maps.fusion import ObjectState, object_state, scale_of
from reobj.maps.room_map import MapObject, Observation, RoomMap, Session
from reobj.results.changes import Change, Changes, EarlierSession, Shape
from reobj.results.result import Object


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
        before = None if stayed else _state_before(found, session.number, room)
        change = _change(found.id, name, own, before, room)
        if not change.fault(own.status):  # without it: the session before was forgotten
            lists[own.status].append(change)
    changes = None if is_first else Changes(str(path), session.name, **lists)
    return EarlierSession(session.name, session.date, tuple(objects), changes, pictures)


def _state_before(found: MapObject, session: int, room: RoomMap) -> ObjectState | None:
    """Return the state of an object before a session; None: it was not known."""
    rows = tuple(o for o in found.observations if o.session < session)
    if not any(o.detected for o in rows):
        return None
    return object_state(dataclasses.replace(found, observations=rows), room)


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
