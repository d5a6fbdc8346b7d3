"""Give the objects of a recording their numbers in the map, and add the recording to the map."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import quadrics
from reobj.cameras import Poses
from reobj.maps.compare import (
    ENOUGH_INLIERS,
    Decision,
    FoundObject,
    PointMotion,
    Visibility,
    compare,
)
from reobj.maps.fusion import (
    ObjectState,
    alignment_jacobian,
    object_state,
    scale_of,
    scaled_radius,
    shapes_of,
    state_before,
)
from reobj.maps.motion import point_motions
from reobj.maps.object_points import ObjectView
from reobj.maps.room_map import (
    OBSERVATIONS,
    MapObject,
    MapPoints,
    Observation,
    RoomMap,
    Session,
)
from reobj.maps.visibility import visibility_of
from reobj.results.changes import Change, Changes, Shape
from reobj.results.result import Object, Result
from reobj.types import Array, Embeddings, Floats, IntArray, unit_rows


@dataclass(frozen=True, slots=True)
class Recording:
    """Facts about a recording that is added to a map.

    Attributes:
        map_path: of the map's file, for changes.json. name: of the session. fingerprint: of the
            video's content. embedder: key of the embedding model.
        alignment_cov: (7, 7) of its placement, zeros for the first session.
        localised_frames, tried_frames: images that agreed, that were compared.
        scale: metres per unit of the map as this recording measured it; source "none": it did not.
        points: with descriptors, in the world of the map; None: those of the map are kept.
        views: features in boxes of its objects, in which the points of map objects are recognised.
        object_points: triangulated from the views, with the identities of the recording.
        pictures: JPEG of its objects, by identity; None: those that the map has are kept.
        placed_by: as in `Changes`. moved: by its last run, if its images are not read again.
    """

    map_path: Path
    name: str
    fingerprint: str
    embedder: str
    alignment_cov: Array
    localised_frames: int
    tried_frames: int
    scale: quadrics.Scale
    points: MapPoints | None
    views: tuple[ObjectView, ...] = ()
    object_points: MapPoints = field(default_factory=MapPoints.empty)
    pictures: Mapping[int, bytes] | None = field(default_factory=dict)
    placed_by: str = ""
    moved: Sequence[Change] = ()


def add_recording(room: RoomMap, result: Result, recording: Recording) -> tuple[RoomMap, Result]:
    """Compare a recording with the map, number its objects, and add it as a session.

    A session of the same video is replaced: its objects keep their numbers, and what happened to
    them since the sessions before it.

    Args:
        result: its first component is in the world of the map.
    Returns:
        the new map; the result with the numbers of the map and with `changes`.
    """
    assert result.poses is not None
    old = room.session_of(recording.fingerprint)
    number = room.next_session if old is None else old.number
    own = {
        o.id: x for o in room.objects for x in o.observations if x.session == number and x.detected
    }
    states = _states_for(room, own)
    states_before = {o.id: state_before(o, number, room) for o in room.objects}
    before = {i: state for i, state in states_before.items() if state is not None}
    objects = [o for o in result.located if o.part == 0]
    found = _with_motions(found_objects(result, objects), states, result, room, recording)
    is_first = not room.sessions
    visibility = visibility_of(states, result, objects, recording.alignment_cov)
    metres = scale_of(room).value if room.sessions else recording.scale.value
    given = frozenset[int]()
    if result.links is not None:
        given = result.links.before & (own.keys() | result.links.in_map)
    decisions = compare(
        states,
        found,
        visibility,
        recording.alignment_cov,
        metres,
        any(s.embedder == recording.embedder for s in states),
        known=given,
    )
    if old is not None:
        decisions = _as_before(decisions, before, own)
    numbers = _numbers(result, decisions, room, is_first, {o.id for o in objects})
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    session = _session(number, recording, result.poses, now if old is None else old.date)
    sessions = (*(s for s in room.sessions if s.number != number), session)
    pictures = recording.pictures
    if pictures is None:
        pictures = {i: own[n].picture for i, n in numbers.items() if n in own}
    observations = {
        d.map_id or numbers[d.found_id]: _observation(
            number, d, found, states, visibility, pictures
        )
        for d in decisions
    }
    points = room.points
    if recording.points is not None:
        marked = _on_objects(recording.points, result, objects, numbers)
        of_objects = recording.object_points
        known_as = np.array([numbers[i] for i in of_objects.object_id.tolist()], np.int64)
        of_objects = dataclasses.replace(of_objects, object_id=known_as)
        marked = MapPoints.joined([marked, of_objects])
        marked = dataclasses.replace(marked, session=np.full(len(marked), number))
        points = _with_new_points(points[points.session != number], marked)
    map_objects = _with_observations(room, number, observations, own)
    known = np.isin(points.object_id, [o.id for o in map_objects])
    points = dataclasses.replace(points, object_id=np.where(known, points.object_id, 0))
    new_room = dataclasses.replace(
        room,
        sessions=tuple(sorted(sessions, key=lambda s: s.number)),
        objects=map_objects,
        points=points,
        metric=result.poses.metric if is_first else room.metric,
        up=result.world.up_in_world if room.up is None else room.up,
        next_id=max(room.next_id, max(numbers.values(), default=0) + 1),
        next_session=max(room.next_session, number + 1),
    )
    names = {s.id: s.class_name for s in states if not s.deleted}
    changes = _changes(decisions, before, names, found, numbers, recording, scale_of(new_room))
    return new_room, _renumbered(result, numbers, states, decisions, changes)


def _states_for(room: RoomMap, own: Mapping[int, Observation]) -> list[ObjectState]:
    """Return the states of the map's objects that a recording is compared with.

    Args:
        own: earlier observations of this recording, by number. Such an object is where it was then,
            wherever other sessions saw it; its class is that of all sessions.
    """
    states = []
    for o in room.objects:
        state = object_state(o, room)
        if o.id in own:
            alone = dataclasses.replace(o, observations=(own[o.id],))
            state = dataclasses.replace(object_state(alone, room), class_name=state.class_name)
        states.append(state)
    return states


def _as_before(
    decisions: Sequence[Decision],
    before: Mapping[int, ObjectState],
    own: Mapping[int, Observation],
) -> list[Decision]:
    """Return decisions about a session that the map has, relative to the sessions before it.

    Args:
        decisions: by comparison with the map, which has the session. before: states before it.
        own: the session's earlier observations, by number.
    """
    kept = []
    for d in decisions:
        if d.found_id and d.map_id in own:
            evidence = f"compared with the last run of this recording: {d.evidence}"
            kept.append(dataclasses.replace(d, kind=own[d.map_id].status, evidence=evidence))
        elif d.found_id and d.map_id not in before:
            kept.append(dataclasses.replace(d, kind="new"))
        else:
            kept.append(d)
    return kept


# ---- Objects of the recording ------------------------------------------------------------------


def found_objects(result: Result, objects: Sequence[Object]) -> list[FoundObject]:
    """Collect shape, classes and mean embeddings of objects."""
    identity = result.tracks.track_id[result.embedding_row]
    found = []
    for o in objects:
        rows = np.flatnonzero(identity == o.id)
        count = max(o.views, 1)
        found.append(
            FoundObject(
                o.id,
                {name: count * share for name, share in o.classes.items()} or {o.class_name: count},
                str(o.support),
                np.asarray(o.center),
                np.asarray(o.half_axes),
                np.asarray(o.quat_wxyz),
                np.full((9, 9), np.nan) if o.cov is None else o.cov,
                _mean_unit(result.embeddings.foreground[rows]),
                _mean_unit(result.embeddings.background[rows]),
                o.views,
                1.0 if o.confidence is None else o.confidence,
                {},
            )
        )
    return found


def _with_motions(
    found: Sequence[FoundObject],
    states: Sequence[ObjectState],
    result: Result,
    room: RoomMap,
    recording: Recording,
) -> list[FoundObject]:
    """Add the motions of map objects whose points the images of the recording show."""
    assert result.poses is not None
    old = room.session_of(recording.fingerprint)
    points = room.points if old is None else room.points[room.points.session != old.number]
    motions = point_motions(points, states, found, recording.views, result.poses, room.up)
    known = _known_motions(recording.moved, found, scale_of(room).value)
    return [
        dataclasses.replace(o, motion_of={**of_map, **known.get(o.id, {})})
        for o, of_map in zip(found, motions, strict=True)
    ]


def _known_motions(
    moved: Sequence[Change], found: Sequence[FoundObject], metres_per_unit: float
) -> dict[int, dict[int, PointMotion]]:
    """Return the motions that the last run found, by identity and number of the map object.

    Each belongs to the object of the recording that is nearest to its place, within its extent.
    """
    motions: dict[int, dict[int, PointMotion]] = {}
    for change in moved:
        if change.before is None or change.after is None or not found:
            continue
        after = change.after
        nearest = min(found, key=lambda o: float(np.linalg.norm(o.center - after)))
        if np.linalg.norm(nearest.center - after) > nearest.half_axes.max():
            continue
        shift = change.after - change.before
        sigma = (change.sigma_m or 0.0) / metres_per_unit
        motion = PointMotion(
            ENOUGH_INLIERS, 0, np.column_stack([np.eye(3), shift]), shift,
            sigma**2 / 3 * np.eye(3),
        )  # fmt: skip
        motions.setdefault(nearest.id, {})[change.id] = motion
    return motions


def _mean_unit(rows: Floats) -> Floats:
    """Return the mean direction of rows (n, E); empty without rows."""
    values = np.asarray(rows, np.float32)
    if not values.size or not values.any():
        return np.empty(0, np.float32)
    return np.asarray(unit_rows(unit_rows(values).mean(0, keepdims=True))[0], np.float32)


def _on_objects(
    points: MapPoints, result: Result, objects: Sequence[Object], numbers: Mapping[int, int]
) -> MapPoints:
    """Mark points inside the ellipsoid of an object, enlarged by a tenth, with its number."""
    object_id = np.zeros(len(points), np.int64)
    shapes = shapes_of(objects)
    best = np.full(len(points), 1.1**2)
    for k, o in enumerate(objects):
        distance = scaled_radius(points.xyz, shapes, k)
        nearer = distance < best
        object_id[nearer] = numbers[o.id]
        best[nearer] = distance[nearer]
    return dataclasses.replace(points, object_id=object_id)


def _with_new_points(
    old: MapPoints, new: MapPoints, near: float = 0.01, alike: float = 0.85, most: int = 40_000
) -> MapPoints:
    """Add points that the map does not have yet.

    Args:
        near: distance of an old point from a new one that may be the same, over that from the
            cameras. alike: least cosine of their descriptors; in another light a point gets
            another descriptor, and is added.
        most: points of the map (about 5 MB); of the new ones a part spread over them is added.
    """
    if len(old) and len(new):
        neighbours = cKDTree(old.xyz).query_ball_point(new.xyz, near * new.distance)
        count = np.array([len(rows) for rows in neighbours])
        of_new = np.repeat(np.arange(len(new)), count)
        of_old = np.concatenate([np.empty(0, np.int64), *map(np.array, neighbours)]).astype(int)
        a = unit_rows(new.descriptor.astype(np.float32))[of_new]
        b = unit_rows(old.descriptor.astype(np.float32))[of_old]
        known = of_new[(a * b).sum(1) > alike]
        new = new[np.setdiff1d(np.arange(len(new)), known)]
    room = max(most - len(old), 0)
    if len(new) > room:
        new = new[np.linspace(0, len(new) - 1, room).round().astype(np.int64)]
    return MapPoints.joined([old, new])


# ---- Numbers -----------------------------------------------------------------------------------


def _numbers(
    result: Result,
    decisions: Sequence[Decision],
    room: RoomMap,
    is_first: bool,
    compared: Collection[int],
) -> dict[int, int]:
    """Return the number in the map of every identity of the result.

    In the first session identities are the numbers. Otherwise objects that match keep theirs; so do
    identities of the last result of the folder, unless the map has another object of this number.
    All others get numbers that no object had.

    Args:
        compared: identities of the objects that were compared with the map.
    """
    identities = [o.id for o in result.objects]
    if is_first:
        return {identity: identity for identity in identities}
    numbers = {d.found_id: d.map_id for d in decisions if d.found_id and d.map_id}
    before = frozenset[int]() if result.links is None else result.links.before
    known = {o.id for o in room.objects}
    taken = set(numbers.values())
    kept = [i for i in identities if i in before and i not in numbers and i not in taken]
    numbers |= {i: i for i in kept if i not in known or i not in compared}
    highest = 0 if result.links is None or not before else result.links.highest
    unused = max(room.next_id, highest + 1)
    for identity in identities:
        if identity not in numbers:
            numbers[identity] = unused
            unused += 1
    return numbers


def _renumbered(
    result: Result,
    numbers: Mapping[int, int],
    states: Sequence[ObjectState],
    decisions: Sequence[Decision],
    changes: Changes,
) -> Result:
    """Give tracks and objects the numbers of the map; leave out what the user deleted there."""
    deleted = {s.id for s in states if s.deleted}
    name_of = {s.id: s.class_name for s in states}
    matched = {d.map_id for d in decisions if d.found_id and d.map_id}
    links = result.links
    if links is not None:
        links = links.renumbered(numbers)
        links = dataclasses.replace(links, in_map=links.in_map | matched)
    identities, row = np.unique(result.tracks.track_id, return_inverse=True)
    new = np.array([numbers.get(i, i) for i in identities.tolist()], np.int64)
    track_id = new[row] if len(new) else result.tracks.track_id
    kept = ~np.isin(track_id, list(deleted & matched))
    objects = [
        dataclasses.replace(
            o,
            id=numbers[o.id],
            class_name=name_of[numbers[o.id]] if numbers[o.id] in matched else o.class_name,
        )
        for o in result.objects
    ]
    left = [k for k, o in enumerate(objects) if o.id not in deleted & matched]
    order = np.array(sorted(left, key=lambda k: objects[k].id), np.int64)
    row_of = np.cumsum(kept) - 1
    embedded = kept[result.embedding_row]
    embeddings = Embeddings(
        result.embeddings.foreground[embedded], result.embeddings.background[embedded]
    )
    return dataclasses.replace(
        result,
        tracks=dataclasses.replace(result.tracks, track_id=track_id)[kept],
        objects=[objects[k] for k in order.tolist()],
        fits=None if result.fits is None else _chosen(result.fits, order),
        embeddings=embeddings,
        embedding_row=row_of[result.embedding_row[embedded]],
        changes=changes,
        links=links,
    )


def _chosen(fits: quadrics.ObjectFits, order: IntArray) -> quadrics.ObjectFits:
    """Select fits by object."""
    columns = ("ellipsoids", "size", "cov", "support", "rms_px", "status", "parallax_deg",
               "prior_share")  # fmt: skip
    return dataclasses.replace(
        fits,
        inlier=fits.inlier[:, order],
        reason=[fits.reason[k] for k in order.tolist()],
        **{name: getattr(fits, name)[order] for name in columns},
    )


# ---- The new session ---------------------------------------------------------------------------


def _session(number: int, recording: Recording, poses: Poses, date: str) -> Session:
    """Describe the recording; at most 100 cameras spread over its first component."""
    rows = np.flatnonzero(poses.measured & (poses.part == 0))
    chosen = np.unique(np.linspace(0, max(len(rows) - 1, 0), min(100, len(rows))).round())
    rows = rows[chosen.astype(np.int64)]
    return Session(
        number,
        recording.name,
        date,
        recording.fingerprint,
        recording.embedder,
        poses.camera,
        poses.cam_from_world[rows],
        float(recording.scale.value),
        float(recording.scale.rel_sigma) if np.isfinite(recording.scale.rel_sigma) else 0.0,
        recording.scale.source,
        recording.alignment_cov,
        recording.localised_frames,
        recording.tried_frames,
    )


def _observation(
    session: int,
    decision: Decision,
    found: Sequence[FoundObject],
    states: Sequence[ObjectState],
    visibility: Visibility,
    pictures: Mapping[int, bytes],
) -> Observation:
    """Return what a session says about the object of a decision."""
    rows = [k for k, s in enumerate(states) if s.id == decision.map_id]
    expected = int(visibility.expected[rows[0]]) if rows else 0
    if not decision.found_id:
        return Observation(session, decision.kind, expected=expected, missed=expected)
    o = next(o for o in found if o.id == decision.found_id)
    confidence = float(np.clip(o.confidence, 0.01, 0.99))
    shape = {name: getattr(o, name) for name in ("support", *OBSERVATIONS, "classes")}
    return Observation(
        session,
        decision.kind,
        **shape,
        foreground=o.foreground,
        background=o.background,
        embedded=o.views if len(o.foreground) else 0,
        views=o.views,
        expected=expected,
        log_odds=float(np.log(confidence / (1 - confidence))),
        picture=pictures.get(o.id, b""),
    )


def _with_observations(
    room: RoomMap,
    session: int,
    observations: Mapping[int, Observation],
    own: Mapping[int, Observation],
) -> tuple[MapObject, ...]:
    """Return the objects with the observations of a session instead of those that it had.

    Args:
        observations: by number. own: that it had. They are kept for deleted objects that are not
            detected, as corrections of the recording delete their tracks.
    """
    objects = {
        o.id: dataclasses.replace(
            o, observations=tuple(x for x in o.observations if x.session != session)
        )
        for o in room.objects
    }
    for number, observation in observations.items():
        before = objects.get(number, MapObject(number, ()))
        if before.deleted and number in own and not observation.detected:
            observation = own[number]
        known = any(x.detected and x.session < session for x in before.observations)
        if not observation.detected and not known:
            continue  # it says nothing before the first detection
        if not before.observations and observation.detected:
            observation = dataclasses.replace(observation, status="new")
        objects[number] = dataclasses.replace(
            before, observations=(*before.observations, observation)
        )
    kept = [o for o in objects.values() if any(x.detected for x in o.observations)]
    return tuple(sorted(kept, key=lambda o: o.id))


# ---- What changed ------------------------------------------------------------------------------


def _changes(
    decisions: Sequence[Decision],
    before: Mapping[int, ObjectState],
    names: Mapping[int, str],
    found: Sequence[FoundObject],
    numbers: Mapping[int, int],
    recording: Recording,
    scale: quadrics.Scale,
) -> Changes:
    """List what stayed, moved, went and came.

    Args:
        before: objects of the map before this recording, by number. names: of all that are not
            deleted.
    """
    found_of = {o.id: o for o in found}
    metres = scale.value if scale.source != "none" else None
    lists: dict[str, list[Change]] = {kind: [] for kind in Changes.KINDS}
    for d in decisions:
        state = before.get(d.map_id)
        if d.map_id and (d.map_id not in names or (state is None and not d.found_id)):
            continue
        o = found_of.get(d.found_id)
        name = max(o.classes, key=lambda c: o.classes[c]) if o is not None else "object"
        change = Change(
            d.map_id or numbers[d.found_id],
            names.get(d.map_id, name),
            None if state is None else state.center,
            None if o is None else o.center,
            *_displacement(state, o, recording.alignment_cov, metres),
            d.evidence,
            tuple(c for c in d.candidates if c != d.map_id),
            None if state is None else Shape(state.support, state.half_axes, state.quat_wxyz),
        )
        lists[d.kind].append(change)
        if change.candidates:
            lists["ambiguous"].append(change)
    sigma = float(np.sqrt(np.diag(recording.alignment_cov)[3:6].sum()))
    by_id: dict[str, Any] = {k: sorted(rows, key=lambda c: c.id) for k, rows in lists.items()}
    changes = Changes(
        str(recording.map_path),
        recording.name,
        placed_by=recording.placed_by,
        localised_frames=recording.localised_frames,
        tried_frames=recording.tried_frames,
        sigma_m=None if metres is None else metres * sigma,
    )
    return dataclasses.replace(changes, **by_id)


def _displacement(
    state: ObjectState | None, found: FoundObject | None, alignment_cov: Array, metres: float | None
) -> tuple[float | None, float | None]:
    """Return the displacement and its standard deviation, metres: of points, or of the centres."""
    if state is None or found is None or metres is None:
        return None, None
    motion = found.motion_of.get(state.id)
    if motion is not None and motion.inliers >= ENOUGH_INLIERS:
        offset = motion.shift
        own = motion.cov
    else:
        offset = found.center - state.center
        own = state.cov[:3, :3] + found.cov[:3, :3]
    distance = float(np.linalg.norm(offset))
    (J,) = alignment_jacobian(found.center[None])
    cov = own + J @ alignment_cov @ J.T
    along = offset / distance if distance > 0 else np.array([1.0, 0, 0])
    sigma = float(np.sqrt(along @ cov @ along)) if np.isfinite(cov).all() else None
    return metres * distance, None if sigma is None else metres * sigma
