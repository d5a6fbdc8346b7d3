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
from reobj.maps.compare import Decision, FoundObject, compare
from reobj.maps.fusion import (
    ObjectState,
    alignment_jacobian,
    object_state,
    scale_of,
    scaled_radius,
    shapes_of,
    state_before,
)
from reobj.maps.object_points import ObjectView, point_motions
from reobj.maps.room_map import OBSERVATIONS, MapObject, MapPoints, Observation, RoomMap, Session
from reobj.maps.visibility import visibility_of
from reobj.results.changes import Change, Changes, Shape
from reobj.results.result import Object, Result
from reobj.types import Array, Embeddings, Floats, unit_rows

# Distance of a point of the map from a new one that may be the same, over that from the cameras
SAME_POINT = 0.01
ALIKE = 0.85  # least cosine of their descriptors; in another light a point is added again
MOST_POINTS = 40_000  # of a map (about 5 MB); of new ones a part spread over them is added


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording that is added to a map.

    Attributes:
        map_path: of the map's file, for changes.json. placed_by: as in `Changes`.
        session: facts about it; number and date are given by `add_recording`.
        points: with descriptors, in the world of the map; None: those of the map are kept.
        views: features in boxes of its objects, in which the points of map objects are recognised.
        object_points: triangulated from the views, with the identities of the recording.
        pictures: JPEG of its objects, by identity; None: those that the map has are kept.
    """

    map_path: Path
    session: Session
    placed_by: str = ""
    points: MapPoints | None = None
    views: Sequence[ObjectView] = ()
    object_points: MapPoints = field(default_factory=MapPoints.empty)
    pictures: Mapping[int, bytes] | None = field(default_factory=dict)


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
    session = recording.session
    old = room.session_of(session.fingerprint)
    number = room.next_session if old is None else old.number
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    session = dataclasses.replace(session, number=number, date=now if old is None else old.date)
    own = {
        o.id: x for o in room.objects for x in o.observations if x.session == number and x.detected
    }
    before = {o.id: s for o in room.objects if (s := state_before(o, number, room)) is not None}
    states = [object_state(o, room) for o in room.objects]
    for k, o in enumerate(room.objects):  # in this recording it is where this recording saw it
        if o.id in own:
            alone = object_state(dataclasses.replace(o, observations=(own[o.id],)), room)
            states[k] = dataclasses.replace(alone, class_name=states[k].class_name)
    objects = [o for o in result.located if o.part == 0]
    found = found_objects(result, objects)
    others = room.points[room.points.session != number]
    motions = point_motions(others, states, found, recording.views, result.poses, room.up)
    found = [dataclasses.replace(o, motion_of=m) for o, m in zip(found, motions, strict=True)]
    visibility = visibility_of(states, result, objects, session.alignment_cov)
    links = result.links
    decisions = compare(
        states,
        found,
        visibility,
        session.alignment_cov,
        scale_of(room).value if room.sessions else session.metres_per_unit,
        any(s.embedder == session.embedder for s in states),
        known=() if links is None else links.before & (own.keys() | links.in_map),
    )
    if old is not None:
        decisions = _as_before(decisions, before, own)
    numbers = _numbers(result, decisions, room, {o.id for o in objects})
    pictures = recording.pictures
    if pictures is None:
        pictures = {i: own[n].picture for i, n in numbers.items() if n in own}
    expected = {s.id: int(n) for s, n in zip(states, visibility.expected, strict=True)}
    found_of = {o.id: o for o in found}
    observations = {
        d.map_id or numbers[d.found_id]: _observation(
            number, d.kind, found_of.get(d.found_id), expected.get(d.map_id, 0), pictures
        )
        for d in decisions
    }
    map_objects = _with_observations(room, number, observations, own)
    points = room.points
    if recording.points is not None:
        of_objects = recording.object_points
        known_as = np.array([numbers[i] for i in of_objects.object_id.tolist()], np.int64)
        of_objects = dataclasses.replace(of_objects, object_id=known_as)
        new = [_on_objects(recording.points, objects, numbers), of_objects]
        points = _with_new_points(others, MapPoints.joined(new), number)
    known = np.isin(points.object_id, [o.id for o in map_objects])
    new_room = dataclasses.replace(
        room,
        sessions=(*(s for s in room.sessions if s.number < number), session,
                  *(s for s in room.sessions if s.number > number)),
        objects=map_objects,
        points=dataclasses.replace(points, object_id=np.where(known, points.object_id, 0)),
        metric=room.metric if room.sessions else result.poses.metric,
        up=result.world.up_in_world if room.up is None else room.up,
        next_id=max(room.next_id, max(numbers.values(), default=0) + 1),
        next_session=max(room.next_session, number + 1),
    )  # fmt: skip
    names = {s.id: s.class_name for s in states if not s.deleted}
    metres = scale_of(new_room)
    lists = _changes(decisions, before, names, found_of, numbers, session.alignment_cov, metres)
    sigma = float(np.sqrt(np.diag(session.alignment_cov)[3:6].sum()))
    changes = Changes(
        str(recording.map_path),
        session.name,
        placed_by=recording.placed_by,
        localised_frames=session.localised_frames,
        tried_frames=session.tried_frames,
        sigma_m=None if metres.source == "none" else metres.value * sigma,
        **lists,
    )
    return new_room, _renumbered(result, numbers, states, decisions, changes)


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
            d = dataclasses.replace(d, kind=own[d.map_id].status, evidence=evidence)
        elif d.found_id and d.map_id not in before:
            d = dataclasses.replace(d, kind="new")
        kept.append(d)
    return kept


# ---- Objects and points of the recording -------------------------------------------------------


def found_objects(result: Result, objects: Sequence[Object]) -> list[FoundObject]:
    """Collect shape, classes and mean embeddings of objects."""
    identity = result.tracks.track_id[result.embedding_row]
    return [
        FoundObject(
            o.id,
            {c: max(o.views, 1) * share for c, share in (o.classes or {o.class_name: 1}).items()},
            str(o.support),
            np.asarray(o.center),
            np.asarray(o.half_axes),
            np.asarray(o.quat_wxyz),
            np.full((9, 9), np.nan) if o.cov is None else o.cov,
            _mean_unit(result.embeddings.foreground[identity == o.id]),
            _mean_unit(result.embeddings.background[identity == o.id]),
            o.views,
            1.0 if o.confidence is None else o.confidence,
            {},
        )
        for o in objects
    ]


def _mean_unit(rows: Floats) -> Floats:
    """Return the mean direction of rows (n, E); empty without rows."""
    values = np.asarray(rows, np.float32)
    if not values.any():
        return np.empty(0, np.float32)
    return np.asarray(unit_rows(unit_rows(values).mean(0, keepdims=True))[0], np.float32)


def _on_objects(
    points: MapPoints, objects: Sequence[Object], numbers: Mapping[int, int]
) -> MapPoints:
    """Mark points inside the ellipsoid of an object, enlarged by a tenth, with its number."""
    shapes = shapes_of(objects)
    radius = [scaled_radius(points.xyz, shapes, k) for k in range(len(objects))]
    nearest = np.array([np.full(len(points), 1.1**2), *radius]).argmin(0)
    number = np.array([0, *(numbers[o.id] for o in objects)])
    return dataclasses.replace(points, object_id=number[nearest])


def _with_new_points(old: MapPoints, new: MapPoints, session: int) -> MapPoints:
    """Add points of a session that the map does not have yet."""
    if len(old) and len(new):
        neighbours = cKDTree(old.xyz).query_ball_point(new.xyz, SAME_POINT * new.distance)
        of_new = np.repeat(np.arange(len(new)), [len(rows) for rows in neighbours])
        of_old = np.concatenate([*neighbours, []]).astype(int)
        a = unit_rows(new.descriptor.astype(np.float32))[of_new]
        b = unit_rows(old.descriptor.astype(np.float32))[of_old]
        new = new[np.setdiff1d(np.arange(len(new)), of_new[(a * b).sum(1) > ALIKE])]
    left = max(MOST_POINTS - len(old), 0)
    if len(new) > left:
        new = new[np.linspace(0, len(new) - 1, left).round().astype(np.int64)]
    added = dataclasses.replace(new, session=np.full(len(new), session))
    return MapPoints.joined([old, added])


# ---- Numbers -----------------------------------------------------------------------------------


def _numbers(
    result: Result, decisions: Sequence[Decision], room: RoomMap, compared: Collection[int]
) -> dict[int, int]:
    """Return the number in the map of every identity of the result.

    In the first session identities are the numbers. Otherwise objects that match keep theirs; so do
    identities of the last result of the folder, unless the map has another object of this number.
    All others get numbers that no object had.

    Args:
        compared: identities of the objects that were compared with the map.
    """
    identities = [o.id for o in result.objects]
    if not room.sessions:
        return {identity: identity for identity in identities}
    numbers = {d.found_id: d.map_id for d in decisions if d.found_id and d.map_id}
    unused = room.next_id
    if result.links is not None and result.links.before:
        unused = max(unused, result.links.highest + 1)
        free = result.links.before - set(numbers) - set(numbers.values())
        others = {o.id for o in room.objects} & set(compared)
        numbers |= {i: i for i in identities if i in free - others}
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
    """Give tracks and objects the numbers of the map; leave out objects deleted there."""
    found = {d.map_id for d in decisions if d.found_id}
    matched = {s.id: s for s in states if s.id in found}
    deleted = [s.id for s in matched.values() if s.deleted]
    links = result.links
    if links is not None:
        links = links.renumbered(numbers)
        links = dataclasses.replace(links, in_map=links.in_map | matched.keys())
    identities, row = np.unique(result.tracks.track_id, return_inverse=True)
    track_id = np.array([numbers.get(i, i) for i in identities.tolist()], np.int64)[row]
    kept = ~np.isin(track_id, deleted)
    rows = sorted(range(len(result.objects)), key=lambda k: numbers[result.objects[k].id])
    rows = [k for k in rows if numbers[result.objects[k].id] not in deleted]
    objects = []
    for o in (result.objects[k] for k in rows):
        state = matched.get(numbers[o.id])
        name = o.class_name if state is None else state.class_name
        objects.append(dataclasses.replace(o, id=numbers[o.id], class_name=name))
    fits = result.fits
    if fits is not None:
        columns = "ellipsoids size cov support rms_px status parallax_deg prior_share".split()
        chosen: dict[str, Any] = {name: getattr(fits, name)[rows] for name in columns}
        reason = [fits.reason[k] for k in rows]
        fits = dataclasses.replace(fits, inlier=fits.inlier[:, rows], reason=reason, **chosen)
    embedded = kept[result.embedding_row]
    return dataclasses.replace(
        result,
        tracks=dataclasses.replace(result.tracks, track_id=track_id)[kept],
        objects=objects,
        fits=fits,
        embeddings=Embeddings(
            result.embeddings.foreground[embedded], result.embeddings.background[embedded]
        ),
        embedding_row=(np.cumsum(kept) - 1)[result.embedding_row[embedded]],
        changes=changes,
        links=links,
    )


# ---- The new session ---------------------------------------------------------------------------


def _observation(
    session: int,
    kind: str,
    found: FoundObject | None,
    expected: int,
    pictures: Mapping[int, bytes],
) -> Observation:
    """Make the observation of an object in a session; found: None: it was not detected."""
    if found is None:
        return Observation(session, kind, expected=expected, missed=expected)
    confidence = float(np.clip(found.confidence, 0.01, 0.99))
    names = ("support", *OBSERVATIONS, "classes", "foreground", "background", "views")
    facts: dict[str, Any] = {name: getattr(found, name) for name in names}
    return Observation(
        session,
        kind,
        **facts,
        embedded=found.views if len(found.foreground) else 0,
        expected=expected,
        log_odds=float(np.log(confidence / (1 - confidence))),
        picture=pictures.get(found.id, b""),
    )


def _with_observations(
    room: RoomMap,
    session: int,
    observations: Mapping[int, Observation],
    own: Mapping[int, Observation],
) -> tuple[MapObject, ...]:
    """Replace the observations of a session by new ones; return the objects.

    Args:
        observations: by number. own: the former ones, kept for deleted objects that are not
            detected, as corrections of the recording delete their tracks.
    """
    objects = {o.id: o for o in room.objects}
    for number in objects.keys() | observations.keys():
        known = objects.get(number, MapObject(number, ()))
        rows = [x for x in known.observations if x.session != session]
        new = observations.get(number)
        if new is not None and known.deleted and number in own and not new.detected:
            new = own[number]
        # without a detection it says nothing before the first one
        if new is not None and (
            new.detected or any(x.detected and x.session < session for x in rows)
        ):
            rows.append(new if rows else dataclasses.replace(new, status="new"))
        objects[number] = dataclasses.replace(known, observations=tuple(rows))
    return tuple(
        objects[k] for k in sorted(objects) if any(x.detected for x in objects[k].observations)
    )


# ---- What changed ------------------------------------------------------------------------------


def _changes(
    decisions: Sequence[Decision],
    before: Mapping[int, ObjectState],
    names: Mapping[int, str],
    found_of: Mapping[int, FoundObject],
    numbers: Mapping[int, int],
    alignment_cov: Array,
    scale: quadrics.Scale,
) -> dict[str, Any]:
    """List what is unchanged, moved, removed and added, by the kinds of `Changes`.

    Args:
        before: objects of the map before this recording, by number. names: of all that are not
            deleted. found_of: objects of the recording, by identity.
    """
    lists: dict[str, Any] = {kind: [] for kind in Changes.KINDS}
    for d in sorted(decisions, key=lambda d: d.map_id or numbers[d.found_id]):
        state = before.get(d.map_id)
        found = found_of.get(d.found_id)
        if d.map_id and (d.map_id not in names or (state is None and found is None)):
            continue
        classes = {"object": 0.0} if found is None else found.classes
        distance: tuple[float | None, float | None] = (None, None)
        if state is not None and found is not None and scale.source != "none":
            distance = _displacement(state, found, alignment_cov, scale.value)
        change = Change(
            d.map_id or numbers[d.found_id],
            names.get(d.map_id, max(classes, key=lambda c: classes[c])),
            None if state is None else state.center,
            None if found is None else found.center,
            *distance,
            evidence=d.evidence,
            candidates=d.candidates,
            before_shape=None
            if state is None
            else Shape(state.support, state.half_axes, state.quat_wxyz),
        )
        for kind in (d.kind, *(["ambiguous"] if d.candidates else [])):
            lists[kind].append(change)
    return lists


def _displacement(
    state: ObjectState, found: FoundObject, alignment_cov: Array, metres_per_unit: float
) -> tuple[float, float | None]:
    """Return the displacement and its standard deviation, metres: of points, or of the centres."""
    offset = found.center - state.center
    own = state.cov[:3, :3] + found.cov[:3, :3]
    if motion := found.proven_motion(state.id):
        offset = motion.shift
        own = motion.cov
    distance = float(np.linalg.norm(offset))
    (J,) = alignment_jacobian(found.center[None])
    along = offset / distance if distance > 0 else np.array([1.0, 0, 0])
    variance = along @ (own + J @ alignment_cov @ J.T) @ along
    sigma = metres_per_unit * float(np.sqrt(variance)) if np.isfinite(variance) else None
    return metres_per_unit * distance, sigma
