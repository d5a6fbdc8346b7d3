"""The map file: what is written is read, all else is refused in one line; corrections."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_worlds import a_map, a_session, observed, random_map, some_points, true_shape

from reobj.files import load_npz, save_npz
from reobj.maps.contents import forget, merge, rename
from reobj.maps.fusion import object_state
from reobj.maps.room_map import MapObject, Observation, RoomMap
from reobj.types import ReobjError

HERE = true_shape()
THERE = true_shape(center=(-2, 0, 0.5))
JPEG = b"\xff\xd8\xff of a chair"


@pytest.fixture(scope="module")
def room() -> RoomMap:
    """Three objects in three sessions, one moved, one gone; names, merged numbers, a picture."""
    found = random_map(3, 3, 50, 8)
    objects = list(found.objects)
    rows = objects[1].observations
    gone = Observation(2, "gone", expected=6, missed=6, log_odds=-3.5)
    shown = dataclasses.replace(rows[0], picture=JPEG)
    objects[1] = MapObject(2, (shown, gone, Observation(3, "not_seen")), "armchair", True)
    rows = objects[2].observations
    objects[2] = MapObject(5, (*rows[:2], dataclasses.replace(rows[2], status="moved")))
    points = dataclasses.replace(found.points, object_id=found.points.object_id % 3)
    return dataclasses.replace(
        found, objects=tuple(objects), points=points, next_id=6, merged={4: 5, 3: 5}
    )


@pytest.fixture(scope="module")
def saved(room: RoomMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "flat.map"
    room.save(path)
    return path


def assert_same(a: Any, b: Any, rtol: float = 1e-6) -> None:
    """Compare dataclasses, tuples, dicts, arrays and plain values."""
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for f in dataclasses.fields(a):
            at = 1e-3 if f.name in ("foreground", "background", "viewing_ray") else rtol
            assert_same(getattr(a, f.name), getattr(b, f.name), at)
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other, rtol)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.nanmax(np.abs(a), initial=1e-9))
    else:
        assert a == b


def test_what_is_written_is_read(room: RoomMap, saved: Path, tmp_path: Path) -> None:
    """Also an empty map, and one far from the origin (poses in a map projection)."""
    assert_same(room, RoomMap.load(saved))
    far = room.points.xyz + np.array([500_000.0, 5_400_000.0, 300.0])
    far_map = dataclasses.replace(room, points=dataclasses.replace(room.points, xyz=far))
    for made in (RoomMap(map_id="x"), far_map):
        made.save(tmp_path / "a.map")
        found = RoomMap.load(tmp_path / "a.map")
        np.testing.assert_allclose(found.points.xyz, made.points.xyz, rtol=0, atol=1e-4)
        assert_same(dataclasses.replace(found, points=made.points), made)


def test_same_map_gives_the_same_bytes(room: RoomMap, saved: Path, tmp_path: Path) -> None:
    """Also after reading, and whatever the order of objects, sessions and classes."""
    RoomMap.load(saved).save(tmp_path / "a.map")
    other = dataclasses.replace(
        room,
        objects=room.objects[::-1],
        sessions=room.sessions[::-1],
        merged=dict(reversed(room.merged.items())),
    )
    other.save(tmp_path / "b.map")
    assert (tmp_path / "a.map").read_bytes() == saved.read_bytes()
    assert (tmp_path / "b.map").read_bytes() == saved.read_bytes()


def test_maps_of_version_0_2_0_are_read(room: RoomMap, saved: Path, tmp_path: Path) -> None:
    """Their sessions have cameras."""
    arrays, facts = load_npz(saved)
    for session in facts["sessions"]:
        session["camera"] = {"model": "PINHOLE", "width": 4, "height": 3, "params": [1, 1, 2, 1]}
        arrays[f"session{session['number']}_cam_from_map"] = np.zeros((2, 3, 4))
    save_npz(tmp_path / "a.map", arrays, **facts | {"version": 1, "reobj_track": "0.2.0"})
    assert_same(room, RoomMap.load(tmp_path / "a.map"))


# ---- Damaged and foreign files ----


def refusal(path: Path) -> str:
    with pytest.raises(ReobjError) as caught:
        RoomMap.load(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text and len(text) < 800
    return text


def test_other_files_are_named(saved: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    assert "no such map; `run VIDEO -o OUT --map" in refusal(path)
    assert "is a folder, but a map is a file" in refusal(tmp_path)
    for content, text in ((b"", "not a map"), (b"PK\x03\x04", "damaged, or no npz file")):
        path.write_bytes(content)
        assert text in refusal(path)
    save_npz(path, {}, format="reobj-tracks", version=1)
    assert "not a map of reobj_track" in refusal(path)
    with np.load(saved) as file:  # edited by hand
        arrays = dict(file)
    arrays["points_xyz"][0, 0] += 0.1
    np.savez(path.open("wb"), **arrays)
    assert "does not match its digest" in refusal(path)


def test_newer_map(saved: Path, tmp_path: Path) -> None:
    """Also of another digest."""
    arrays, facts = load_npz(saved)
    newer = facts | {"version": 3, "reobj_track": "9.1"}
    save_npz(tmp_path / "a.map", arrays, **newer)
    text = refusal(tmp_path / "a.map")
    assert "a map of format 3, this version reads up to 2; it was written by reobj_track 9" in text
    np.savez((tmp_path / "a.map").open("wb"), metadata=json.dumps(newer))
    assert "a map of format 3" in refusal(tmp_path / "a.map")


def test_flipped_and_missing_bytes_are_found(room: RoomMap, saved: Path, tmp_path: Path) -> None:
    """The same map is read, where the bytes mean nothing, or one line says that it is damaged."""
    path = tmp_path / "a.map"
    rng = np.random.default_rng(0)
    content = saved.read_bytes()
    for place in [*rng.integers(0, len(content), 40), *-rng.integers(1, 1500, 40)]:
        changed = bytearray(content)
        changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            found = RoomMap.load(path)
        except ReobjError as error:
            assert "\n" not in str(error)
        else:
            assert_same(room, found)
    for length in rng.integers(0, len(content), 20):
        path.write_bytes(content[:length])
        refusal(path)


def test_content_of_another_program_is_refused(saved: Path, tmp_path: Path) -> None:
    """With a right digest."""
    arrays, facts = load_npz(saved)
    facts["sessions"][0]["name"] = 3
    save_npz(tmp_path / "a.map", arrays, **facts)
    assert "Expected `str`, got `int` - at `$.sessions[0].name" in refusal(tmp_path / "a.map")


def test_map_that_could_not_be_read_is_not_written(room: RoomMap, saved: Path) -> None:
    content = saved.read_bytes()
    bad = dataclasses.replace(room.sessions[0], metres_per_unit=np.nan)
    with pytest.raises(Exception, match="metres_per_unit"):
        dataclasses.replace(room, sessions=(bad, *room.sessions[1:])).save(saved)
    assert saved.read_bytes() == content


# ---- Corrections ----


def statuses(found: MapObject) -> list[tuple[int, str]]:
    return [(o.session, o.status) for o in found.observations]


def test_object_of_the_forgotten_session_alone_disappears(tmp_path: Path) -> None:
    """Its number is not used again, its points stay for localisation, its merged numbers go."""
    made = a_map(
        [[observed(1, "new", HERE)], [observed(2, "new", THERE), Observation(3, "not_seen")]],
        next_id=9,
        merged={7: 2},
        next_session=4,
        sessions=tuple(a_session(k) for k in (1, 2, 3)),
    )
    points = dataclasses.replace(some_points(2, 1, []), object_id=np.array([1, 2]))
    left = forget(dataclasses.replace(made, points=points), 2)
    assert [found.id for found in left.objects] == [1] and left.next_id == 9
    assert left.merged == {} and left.points.object_id.tolist() == [1, 0]
    left.save(tmp_path / "a.map")


@pytest.mark.parametrize(
    ("before", "session", "after"),
    [
        ("new stayed moved stayed", 3, "new stayed moved"),
        ("new stayed moved stayed", 1, "new moved stayed"),
        ("new stayed moved stayed", 4, "new stayed moved"),
        ("new moved gone stayed", 2, "new gone moved"),
        ("new not_seen gone stayed", 1, "new"),
        ("new moved not_seen stayed", 3, "new moved stayed"),
    ],
)
def test_status_after_a_forgotten_session(before: str, session: int, after: str) -> None:
    """An object is never fused with a place that it had left."""
    rows = [
        observed(k, status, HERE) if status in ("new", "stayed", "moved") else
        Observation(k, status) for k, status in enumerate(before.split(), 1)
    ]  # fmt: skip
    sessions = tuple(a_session(k) for k in range(1, 5))
    (left,) = forget(a_map([rows], sessions=sessions), session).objects
    assert " ".join(o.status for o in left.observations) == after


def test_merged_object_has_the_observations_of_both() -> None:
    """Seen under another number after it had moved: one object that moved."""
    first = [observed(1, "new", HERE), Observation(2, "gone"), Observation(3, "gone")]
    second = [observed(2, "new", THERE, classes={"sofa": 1.0}), observed(3, "stayed", THERE)]
    made = a_map([first, second, [observed(1, "new", HERE)]], merged={9: 2}, next_id=10)
    points = dataclasses.replace(some_points(3, 1, []), object_id=np.array([2, 3, 0]))
    made = rename(dataclasses.replace(made, points=points), 2, "armchair")
    joined = merge(made, 1, 2)
    assert [found.id for found in joined.objects] == [1, 3]
    assert statuses(joined.objects[0]) == [(1, "new"), (2, "moved"), (3, "stayed")]
    assert joined.objects[0].name == "armchair" and joined.merged == {9: 1, 2: 1}
    assert joined.points.object_id.tolist() == [1, 3, 0]
    assert joined.object(2).id == joined.object(9).id == 1
    np.testing.assert_allclose(object_state(joined.objects[0], joined).center, THERE["center"])


def test_merged_duplicates_of_one_session() -> None:
    """Two objects at one place: the observation of more views counts; nothing moved."""
    near = true_shape(center=(1.02, 2, 0.5))
    first = [observed(1, "new", HERE, views=4), Observation(2, "not_seen")]
    second = [observed(1, "new", near, views=7, classes={"sofa": 2.0}), observed(2, "stayed", near)]
    (found,) = merge(a_map([first, second]), 1, 2).objects
    assert statuses(found) == [(1, "new"), (2, "stayed")]
    assert found.observations[0].views == 7
    assert found.observations[0].classes == {"chair": 5.0, "sofa": 2.0}
    (other,) = merge(a_map([first, [observed(2, "new", near)]]), 1, 2).objects
    assert statuses(other) == [(1, "new"), (2, "stayed")]  # 2 cm is no move
