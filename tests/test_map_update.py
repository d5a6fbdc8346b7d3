"""A recording is compared with the map, numbered, and added to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from simulated import (
    CUP,
    chair_solids,
    finished,
    fitted,
    tracks_of,
    turn,
    two_components,
    unlinked,
    walk,
    with_columns,
)

import reobj_track as rt
from reobj.maps import update
from reobj.maps.compare import PointMotion
from reobj.maps.contents import delete, earlier_sessions, forget
from reobj.maps.fusion import object_state
from reobj.maps.placement import DIRECTIONS_ONLY, ComponentPlacement, joined, place
from reobj.maps.room_map import MapPoints, RoomMap, Session
from reobj.maps.stage import OpenMap, finish_map, place_recording
from reobj.maps.update import Recording, add_recording
from reobj.maps.visibility import visibility_of


def recording(name: str, **changes: Any) -> Recording:
    """A recording without features, perfectly aligned."""
    session = Session(
        1, name, "", f"content of {name}", "reobj", scale_source="poses",
        alignment_cov=np.diag([1e-8] * 7),
    )  # fmt: skip
    return Recording(Path("room.map"), session, **changes)


def wall_behind(poses: rt.Poses, count: int = 400) -> rt.Poses:
    """The poses with points on a wall 2 m behind the chairs, which all frames observe."""
    rng = np.random.default_rng(1)
    points = np.column_stack(
        [rng.uniform(-4, 4, count), np.full(count, 2.0), rng.uniform(0, 2, count)]
    )
    row, point = np.divmod(np.arange(len(poses.frame) * count), count)
    return dataclasses.replace(
        poses, points=points, colors=np.zeros((count, 3), np.uint8),
        visibility=np.column_stack([row, point]),
    )  # fmt: skip


def seen(chairs: list[int], numbers: list[int] | None = None, wall: bool = False) -> rt.Result:
    """A recording of some of the three chairs; their identities are `numbers`, or 1, 2, ..."""
    poses = walk(24)
    tracks = tracks_of(poses)
    tracks = tracks[np.isin(tracks.detection_index, chairs)]
    names = numbers or list(range(1, len(chairs) + 1))
    identity = np.zeros(3, np.int64)
    identity[chairs] = names
    track_id = identity[tracks.detection_index]
    tracks = dataclasses.replace(tracks, track_id=track_id, tracklet_id=track_id)
    result = fitted(tracks, wall_behind(poses) if wall else poses)
    row = np.arange(len(tracks))
    looks = rt.Embeddings(*(np.ones((len(row), n), np.float16) for n in (8, 4)))  # identical
    return dataclasses.replace(result, embeddings=looks, embedding_row=row)


def moved_by(result: rt.Result, number: int, offset: list[float]) -> rt.Result:
    """The recording with one object elsewhere."""
    objects = [
        dataclasses.replace(o, center=o.center + offset) if o.id == number else o
        for o in result.objects
    ]
    return dataclasses.replace(result, objects=objects)


MOVE = np.array([-0.6, 0.4, 0])


@pytest.fixture
def recognised(monkeypatch: pytest.MonkeyPatch):
    """A function that lets the points of a map object be recognised on one of the recording."""

    def recognise(number: int, identity: int) -> None:
        def motions(points, states, found, *_):
            motion = PointMotion(9, 3, MOVE, 1e-4 * np.eye(3))
            return [{number: motion} if o.id == identity else {} for o in found]

        monkeypatch.setattr(update, "point_motions", motions)

    return recognise


@pytest.fixture(scope="module")
def monday() -> RoomMap:
    room, result = add_recording(RoomMap(), seen([0, 1, 2]), recording("monday"))
    assert [o.id for o in result.objects] == [1, 2, 3]
    assert [c.id for c in result.changes.new] == [1, 2, 3]
    return room


def test_objects_that_stayed_get_their_numbers_in_tracks_objects_and_fits(monday):
    """The tracker numbered them in another order, and from 7 on."""
    tuesday = seen([0, 1, 2], numbers=[9, 7, 8])
    room, result = add_recording(monday, tuesday, recording("tuesday"))
    assert [c.id for c in result.changes.stayed] == [1, 2, 3]
    assert [o.id for o in result.objects] == [1, 2, 3]
    chair = result.tracks.detection_index  # column of the chair
    np.testing.assert_array_equal(result.tracks.track_id, chair + 1)
    centers = result.fits.ellipsoids.center_in_world
    np.testing.assert_allclose(centers, [o.center for o in result.objects], atol=1e-4)
    assert room.next_id == 4 and len(room.sessions) == 2
    before, after = (object_state(m.objects[0], m) for m in (monday, room))
    assert np.trace(after.cov[:3, :3]) < 0.7 * np.trace(before.cov[:3, :3])


def test_a_moved_object_keeps_its_number(monday, recognised):
    tuesday = moved_by(seen([0, 1, 2], numbers=[3, 1, 2]), 3, MOVE)
    _, result = add_recording(monday, tuesday, recording("tuesday"))
    assert not result.changes.moved and 4 in {o.id for o in result.objects}  # looks are not enough
    recognised(1, 3)
    room, result = add_recording(monday, tuesday, recording("tuesday"))
    (change,) = result.changes.moved
    assert change.id == 1 and change.distance_m == pytest.approx(np.hypot(0.6, 0.4), abs=0.03)
    assert 0 < change.sigma_m < 0.1
    assert change.before_shape.support == "box"
    state = object_state(room.objects[0], room)
    np.testing.assert_allclose(state.center, change.after, atol=0.02)
    # a refit keeps date and change, and names its comparison
    dated = dataclasses.replace(room.sessions[1], date="2026-01-06T08:00:00+00:00")
    room = dataclasses.replace(room, sessions=(room.sessions[0], dated))
    recognised(1, 0)  # the images are not read again
    again, result = add_recording(room, tuesday, recording("tuesday"))
    assert again.sessions[1].date == dated.date
    (change,) = result.changes.moved
    assert change.distance_m == pytest.approx(np.hypot(0.6, 0.4), abs=0.03)
    assert change.evidence.startswith("compared with the last run of this recording: 0.00 m")


def test_what_is_seen_through_is_gone_and_gets_its_number_back(monday):
    room, result = add_recording(monday, seen([0, 2], wall=True), recording("tuesday"))
    assert [c.id for c in result.changes.gone] == [2]
    assert not object_state(room.objects[1], room).present
    room, result = add_recording(room, seen([0, 1, 2]), recording("friday"))
    assert [o.id for o in result.objects] == [1, 2, 3]
    assert object_state(room.objects[1], room).present


def weakly(result: rt.Result, every: int, grown: float = 0.0) -> rt.Result:
    """The recording with untracked cups of low score on the middle chair, in every n-th frame.

    Args:
        grown: on each side, of the size of the box.
    """
    rows = tracks_of(walk(24))
    rows = rows[(rows.detection_index == 1) & (rows.frame % every == 0)]
    side = np.tile(rows.xyxy[:, 2:] - rows.xyxy[:, :2], 2) * [-1, -1, 1, 1]
    weak = with_columns(
        rows, track_id=0, tracklet_id=0, score=0.12, class_id=CUP, xyxy=rows.xyxy + grown * side
    )
    return dataclasses.replace(result, untracked=weak)


@pytest.mark.parametrize(
    ("every", "grown", "gone"),
    [(2, 0.0, False), (12, 0.0, True), (1, 0.5, True)],  # half; by accident; something larger
)
def test_weak_detections_on_its_place_show_that_an_object_is_there(monday, every, grown, gone):
    tuesday = weakly(seen([0, 2], wall=True), every, grown)
    room, result = add_recording(monday, tuesday, recording("tuesday"))
    (change,) = result.changes.gone if gone else result.changes.not_seen
    assert change.id == 2 and ("detected on its place" in change.evidence) is not gone
    assert object_state(room.objects[1], room).present is not gone


def test_the_same_recording_again_replaces_its_session(monday):
    """Its objects keep their numbers, also with another detector; nothing counts twice."""
    again, result = add_recording(monday, seen([2, 0, 1], numbers=[1, 2, 3]), recording("monday"))
    assert [c.id for c in result.changes.new] == [1, 2, 3]  # as against the sessions before it
    assert [o.id for o in result.objects] == [1, 2, 3]
    assert len(again.sessions) == 1 and again.next_id == 4
    assert [len(o.observations) for o in again.objects] == [1, 1, 1]
    assert [o.observations[0].status for o in again.objects] == ["new"] * 3


def test_a_deleted_object_stays_out_of_later_results(monday):
    room = delete(monday, 2)
    room, result = add_recording(room, seen([0, 1, 2], numbers=[3, 1, 2]), recording("tuesday"))
    assert [o.id for o in result.objects] == [1, 3]
    assert set(result.tracks.track_id) == {1, 3} and len(result.fits) == 2
    assert room.object(2).deleted and result.changes.of_objects().keys() == {1, 3}


def test_pictures_of_a_recording_are_replaced_with_it(monday):
    """None: its video cannot be read, and the pictures that the map has are kept."""

    def pictures_of(room: RoomMap, numbers: list[int], pictures: dict[int, bytes] | None):
        again = recording("monday", pictures=pictures)
        new, _ = add_recording(room, seen([0, 1, 2], numbers=numbers), again)
        return new, [o.observations[0].picture for o in new.objects]

    # identity 8 is chair 2
    room, found = pictures_of(monday, [7, 8, 9], {8: b"\xff\xd8\xff8"})
    assert found == [b"", b"\xff\xd8\xff8", b""]
    assert pictures_of(room, [9, 7, 8], None)[1] == found
    assert pictures_of(room, [9, 7, 8], {})[1] == [b""] * 3


def test_distances_and_sizes_are_metres_if_the_unit_of_the_map_is_another(monday, recognised):
    """A unit is half a metre: 3 % by the first recording, 4 % by the second."""
    unit = {"metres_per_unit": 0.5, "alignment_cov": np.diag([0, 0, 0, 1e-4, 4e-4, 4e-4, 0])}
    (first,) = monday.sessions
    first = dataclasses.replace(first, **unit, scale_rel_sigma=0.03)
    room = dataclasses.replace(monday, metric=False, sessions=(first,))
    tuesday = recording("tuesday")
    session = dataclasses.replace(tuesday.session, **unit, scale_rel_sigma=0.04)
    recognised(1, 1)
    room, result = add_recording(
        room, moved_by(seen([0, 1, 2]), 1, MOVE), dataclasses.replace(tuesday, session=session)
    )
    assert result.changes.sigma_m == pytest.approx(0.5 * 0.03)
    (change,) = result.changes.moved
    assert change.distance_m == pytest.approx(0.5 * np.hypot(0.6, 0.4))
    earlier, later = earlier_sessions(room, Path("room.map"), "")
    (change,) = later.changes.moved
    assert change.distance_m == pytest.approx(0.5 * np.hypot(0.6, 0.4), abs=0.02)
    (chair,) = (o for o in earlier.objects if o.id == 2)
    np.testing.assert_allclose(chair.size, 2 * chair.half_axes)
    np.testing.assert_allclose(chair.size_m, chair.half_axes)
    of_unit = 0.03 * 0.04 / 0.05  # of both recordings
    np.testing.assert_allclose(
        chair.size_rel_sigma, np.hypot(np.sqrt(np.diag(chair.cov)[3:6]), of_unit), rtol=1e-3
    )


@pytest.mark.parametrize(
    ("confidence", "odds"), [(0.8, 4.0), (0.5, 1.0), (0.2, 0.25), (None, 99.0), (0.0, 1 / 99)]
)
def test_confidence_of_an_object_adds_to_the_log_odds_that_it_exists(monday, confidence, odds):
    tuesday = seen([0, 1, 2])
    objects = [dataclasses.replace(o, confidence=confidence) for o in tuesday.objects]
    room, _ = add_recording(
        monday, dataclasses.replace(tuesday, objects=objects), recording("tuesday")
    )
    added = object_state(room.objects[1], room).log_odds
    added -= object_state(monday.objects[1], monday).log_odds
    assert added == pytest.approx(np.log(odds))


# ---- Earlier recordings for the viewer ---------------------------------------------------------


def test_the_viewer_gets_the_objects_of_other_recordings(monday, recognised):
    """Where they were then, and what had changed; not those that the user deleted."""
    moved = moved_by(seen([0, 1, 2]), 1, MOVE)
    shown = recording("tuesday", pictures={1: b"\xff\xd8\xff1"})
    recognised(1, 1)
    room, tuesday = add_recording(monday, moved, shown)
    room, _ = add_recording(room, seen([1, 2], wall=True), recording("friday"))
    path = Path("room.map")
    first, second = earlier_sessions(room, path, "content of friday")
    assert [s.name for s in earlier_sessions(room, path, "content of monday")] == [
        "tuesday", "friday"
    ]  # fmt: skip
    assert (first.name, first.changes, dict(first.pictures)) == ("monday", None, {})
    assert [o.id for o in first.objects] == [o.id for o in second.objects] == [1, 2, 3]
    np.testing.assert_array_equal(first.objects[0].center, monday.objects[0].observations[0].center)
    np.testing.assert_array_equal(second.objects[0].center, moved.objects[0].center)
    np.testing.assert_array_equal(second.objects[1].half_axes, moved.objects[1].half_axes)
    np.testing.assert_allclose(second.objects[0].size_m, 2 * moved.objects[0].half_axes)
    assert second.pictures == {1: b"\xff\xd8\xff1"}
    assert second.changes.summary() == tuesday.changes.summary()
    (change,) = second.changes.moved
    (said,) = tuesday.changes.moved
    np.testing.assert_allclose(change.before, said.before)
    np.testing.assert_allclose(change.before_shape.half_axes, said.before_shape.half_axes)
    (_, _, third) = earlier_sessions(delete(room, 2), path, "")
    assert [o.id for o in third.objects] == [3] and [c.id for c in third.changes.gone] == [1]
    assert len(earlier_sessions(forget(room, "monday"), path, "content of friday")) == 1


def test_a_map_needs_positions(monday, tmp_path):
    poses, tracks = turn()
    result = finished(unlinked(poses, tracks))
    video: Any = SimpleNamespace(source="turn.mp4", has_images=True, config=rt.InputConfig())
    for room, said in (RoomMap(), "not made: its cameras"), (monday, "the map is unchanged"):
        opened = OpenMap(tmp_path / "flat.map", room, False)
        for placed in place_recording(opened, poses, video), None:  # None: a refit
            found = finish_map(opened, result, video, "reobj", placed)
            (warning,) = found.warnings
            assert said in warning and "steps to the side" in warning
            assert "directions only" in found.changes.refused
            assert [o.id for o in found.objects] == [o.id for o in result.objects]
    assert not list(tmp_path.iterdir())


def test_a_component_with_directions_only_is_not_placed(monday):
    poses = dataclasses.replace(two_components(), direction_sigma=np.array([0, 0.02]))
    components = place(poses, [], monday.points).components
    assert components[1].refused == DIRECTIONS_ONLY != components[0].refused
    placed = joined(poses, [ComponentPlacement(5), components[1]], [0])
    np.testing.assert_array_equal(placed.direction_sigma, [0, 0.02])


def test_known_points_are_not_added_again():
    rng = np.random.default_rng(2)
    count = 300
    descriptor = rng.integers(0, 100, (count, 128)).astype(np.uint8)
    xyz = rng.uniform(-2, 2, (count, 3))
    points = MapPoints(
        xyz, descriptor, np.zeros(count, np.int64), np.zeros(count, np.int64),
        np.tile([0, 0, 1.0], (count, 1)), np.full(count, 2.0),
    )  # fmt: skip
    room, _ = add_recording(RoomMap(), seen([0]), recording("monday", points=points))
    other = rng.integers(0, 100, (100, 128)).astype(np.uint8)
    again = dataclasses.replace(points, xyz=xyz + 0.002)
    again.descriptor[:100] = descriptor[:100]
    again = dataclasses.replace(again, descriptor=np.concatenate([other, descriptor[100:]]))
    room, _ = add_recording(room, seen([0]), recording("tuesday", points=again))
    assert len(room.points) == count + 100  # a hundred look different today
    assert np.bincount(room.points.session).tolist() == [0, count, 100]
    center = chair_solids().center_in_world[0]
    on = np.linalg.norm(room.points.xyz - center, axis=1) < 0.25
    assert (room.points.object_id[on] == 1).all()


# ---- Visibility --------------------------------------------------------------------------------


def visible(room: RoomMap, poses: rt.Poses, occluders: Sequence[rt.Object] = (), vague: float = 0):
    """How poses saw the objects of a map, without detections; vague: added variance of places."""
    states = [object_state(o, room) for o in room.objects]
    nobody = dataclasses.replace(seen([0, 1, 2]), poses=poses, objects=[])
    nobody = dataclasses.replace(nobody, tracks=nobody.tracks[:0])
    cov = np.diag([0, 0, 0, *[vague] * 3, 0])
    return visibility_of(states, nobody, occluders, cov)


def test_views_less_than_ten_degrees_apart_count_once(monday):
    """The walk is an arc of 120 degrees around the chairs."""
    found = visible(monday, walk(60))
    assert (found.expected >= 10).all() and (found.expected <= 16).all()
    assert not found.seen_through.any() and not found.vague.any()


def test_what_is_occluded_or_of_unknown_place_is_not_expected(monday):
    poses = walk(24, 40.0)
    chair = seen([0]).objects[0]
    cupboard = dataclasses.replace(
        chair, center=np.array([-1.1, -1.2, 1.0]), half_axes=np.array([2.5, 0.2, 1.0])
    )
    behind = wall_behind(poses, 2000)
    assert visible(monday, poses, [chair]).expected[0] > 2  # itself is no occluder
    assert visible(monday, poses, [cupboard]).expected[0] == 0
    # points before, on, and behind the chairs; of those on them one view may show its surroundings
    for y, expected, through in ((-0.6, 0, 0), (0.3, 4, 3), (0.7, 4, 4), (2.0, 4, 4)):
        wall = dataclasses.replace(behind, points=behind.points * (1, 0, 1) + (0, y, 0))
        found = visible(monday, wall)
        assert found.expected.tolist() == [expected] * 3
        assert found.seen_through.tolist() == [through] * 3
    unknown = visible(monday, behind, vague=1.0)
    assert not unknown.expected.any() and unknown.vague.all()
