"""Recordings of one room on several days: persistent numbers, true changes, mirror, cameras."""

from __future__ import annotations

import functools
import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import render_sessions
from rendering.camera import camera_matrix, look_along
from rendering.config import RoomConfig
from rendering.flat import part_bounds
from rendering.models import QUAD
from rendering.photograph import render_clip
from rendering.raster import render
from rendering.sessions import (
    SessionOptions,
    Sightings,
    by_identity,
    change_entries,
    make_sessions,
    mirrored,
    only,
    session_path,
)

SMALL = RoomConfig(
    seed=7, width=160, height=120, frames=24, texels_per_m=40, light_rays=1,
    plan="session", path="session",
)  # fmt: skip


@pytest.fixture(scope="module")
def made():
    """The studio and three sessions."""
    return make_sessions(SMALL, SessionOptions(sessions=3))


def moved_distances(before, after) -> dict[int, float]:
    """Of the objects that are in both rooms, m."""
    first, second = by_identity(before), by_identity(after)
    return {
        i: float(np.linalg.norm(second[i].center_in_world - first[i].center_in_world))
        for i in first.keys() & second.keys()
    }


def test_numbers_are_those_of_the_same_object_in_all_sessions(made) -> None:
    rooms = [session.room for session in made[1]]
    looks: dict[int, tuple] = {}
    for room in rooms:
        identities = [o.identity for o in room.objects]
        assert len(set(identities)) == len(identities)
        assert [o.index for o in room.objects] == list(range(len(identities)))
        for item in room.objects:
            own = room.surfaces.owner == item.index
            look = (item.class_name, item.twin_group, room.surfaces.texture_rect[own])
            known = looks.setdefault(item.identity, look)
            assert known[:2] == look[:2]
            np.testing.assert_array_equal(known[2], look[2])
    chairs = [o.identity for o in rooms[0].objects if o.class_name == "chair"]
    assert len(chairs) >= 3


def test_a_third_of_the_objects_changes_also_one_of_identical_ones(made) -> None:
    rooms = [session.room for session in made[1]]
    for before, after in itertools.pairwise(rooms):
        first, second = by_identity(before), by_identity(after)
        distances = moved_distances(before, after)
        moved = {i for i, d in distances.items() if d > 1e-6}
        gone = first.keys() - second.keys()
        added = second.keys() - first.keys()
        share = len(moved | gone | added) / len(first)
        assert 0.2 <= share <= 0.4 and moved and gone and added
        assert min(distances[i] for i in moved) > 0.2
        groups = [o.twin_group for o in before.objects if o.class_name == "chair"]
        assert any(
            first[i].class_name == "chair" and groups.count(first[i].twin_group) > 1 for i in moved
        )


def test_light_only_moves_nothing_but_changes_light_path_and_lens() -> None:
    _, (first, second) = make_sessions(SMALL, SessionOptions(light_only=True))
    assert {o.identity for o in first.room.objects} == {o.identity for o in second.room.objects}
    assert max(moved_distances(first.room, second.room).values()) == 0
    one, other = (
        render(s.room, camera_matrix(SMALL), first.cameras[0], (160, 120), 1)[0].astype(int)
        for s in (first, second)
    )
    assert np.abs(one - other).mean() > 5
    assert first.lighting != second.lighting
    centers = [-np.einsum("fji,fj->fi", s.cameras[:, :, :3], s.cameras[:, :, 3])
               for s in (first, second)]  # fmt: skip
    assert np.linalg.norm(centers[0][0] - centers[1][0]) > 0.3
    ratio = camera_matrix(second.config)[0, 0] / camera_matrix(first.config)[0, 0]
    assert ratio == pytest.approx(1.2)


def surface_corners(room, index: int) -> np.ndarray:
    """(N, 3) corners of the flat patches of an object."""
    own = (room.surfaces.owner == index) & (room.surfaces.kind == QUAD)
    return room.surfaces.corners_in_world[own].reshape(-1, 3)


def test_changed_objects_stand_on_something_and_do_not_intersect(made) -> None:
    _, sessions = made
    first = by_identity(sessions[0].room)
    checked = 0
    for session in sessions[1:]:
        room = session.room
        for item in room.objects:
            old = first.get(item.identity)
            if old is not None and np.allclose(old.center_in_world, item.center_in_world):
                continue
            bottom = item.center_in_world[2] - item.size_m[2] / 2
            others = [o for o in room.objects if o is not item]
            if bottom > 0.05:  # exactly one table under it
                tops = [
                    o.center_in_world[2] + o.size_m[2] / 2
                    for o in others
                    if o.class_name == "dining table"
                    and (
                        np.abs((item.center_in_world - o.center_in_world) @ o.world_from_obj)[:2]
                        < o.size_m[:2] / 2
                    ).all()
                ]
                assert len(tops) == 1 and bottom == pytest.approx(tops[0], abs=0.02)
            for o in others:
                if o.class_name == "dining table" and bottom > 0.05:
                    continue
                inside = np.abs((surface_corners(room, o.index) - item.center_in_world)
                                @ item.world_from_obj) < item.size_m / 2 - 0.01  # fmt: skip
                assert not inside.all(1).any(), (item.class_name, o.class_name)
            assert (np.abs(item.center_in_world[:2]) < np.array(room.size_m[:2]) / 2).all()
            checked += 1
    assert checked >= 6


def test_camera_keeps_clear_of_furniture(made) -> None:
    studio, sessions = made
    bounds = np.array([part_bounds(part) for part in studio.plan.fixed])  # (B, 2, 3)
    for session in sessions:
        centers = -np.einsum(
            "fji,fj->fi", session.cameras[:, :, :3], session.cameras[:, :, 3]
        )  # (F, 3)
        inside = (centers[:, None] > bounds[:, 0] - 0.15) & (centers[:, None] < bounds[:, 1] + 0.15)
        assert not inside.all(2).any()
        for item in session.room.objects:
            local = np.abs((centers - item.center_in_world) @ item.world_from_obj)
            assert not (local < item.size_m / 2 + 0.15).all(1).any()


def test_a_room_without_a_free_path_is_refused(made) -> None:
    session = made[1][0]
    everywhere = np.array([[[-9.0, -9.0, 1.2], [9.0, 9.0, 1.9]]])
    with pytest.raises(ValueError, match="no camera path keeps clear"):
        session_path(session.room, everywhere, session.config, whole=True)


def test_mirrored_room_gives_mirrored_pictures(made) -> None:
    session = made[1][0]
    other = mirrored(session.room)
    # The middle of the image is on the optical axis, so a flip of x needs no shift of pixels.
    K = camera_matrix(SMALL)
    angles = [np.array([v]) for v in (0.7, -0.3, 0.0)]
    pose = look_along(np.array([[-0.4, -0.5, 1.5]]), *angles)[0]
    angles[0] = np.pi - angles[0]
    flipped_pose = look_along(np.array([[0.4, -0.5, 1.5]]), *angles)[0]
    image, instance, depth = render(session.room, K, pose, (160, 120), 2)
    image2, instance2, depth2 = render(other, K, flipped_pose, (160, 120), 2)
    assert len(np.unique(instance)) >= 4
    assert (instance != instance2[:, ::-1]).mean() < 0.005
    np.testing.assert_allclose(np.median(np.abs(depth - depth2[:, ::-1])), 0, atol=1e-4)
    assert np.abs(image.astype(int) - image2[:, ::-1]).mean() < 2
    assert np.abs(image.astype(int) - image2).mean() > 10
    for truth, turned in zip(session.room.objects, other.objects, strict=True):
        np.testing.assert_allclose(turned.center_in_world, truth.center_in_world * [-1, 1, 1])
        assert np.linalg.det(turned.world_from_obj) == pytest.approx(1)
        assert turned.yaw_rad == pytest.approx(-truth.yaw_rad)
        reach = np.abs(
            (surface_corners(other, turned.index) - turned.center_in_world) @ turned.world_from_obj
        )
        assert not len(reach) or (reach <= turned.size_m / 2 + 0.2).all()


def test_foreign_room_has_the_same_models_in_another_room(made) -> None:
    studio, _ = made
    foreign, (session,) = make_sessions(SMALL, SessionOptions(sessions=1, foreign=8))
    assert foreign.plan.size_m != studio.plan.size_m
    first = made[1][0].room
    looks = {o.twin_group: (o.size_m, o.index) for o in first.objects}
    shared = [o for o in session.room.objects if o.twin_group in looks]
    assert len({o.twin_group for o in shared}) >= 5

    def texels(room, index: int) -> list[np.ndarray]:
        rects = room.surfaces.texture_rect[room.surfaces.owner == index].round().astype(int)
        return [room.atlas[0][y : y + h, x : x + w] for x, y, w, h in rects]

    same = 0
    total = 0
    for item in shared:
        size, index = looks[item.twin_group]
        np.testing.assert_allclose(item.size_m, size)
        for a, b in zip(texels(session.room, item.index), texels(first, index), strict=True):
            if min(a.shape[:2]) > 4:
                rows, cols = np.minimum(a.shape[:2], b.shape[:2])
                same += np.abs(a[:rows, :cols].astype(int) - b[:rows, :cols]).mean() < 12
                total += 1
    assert total > 20 and same / total > 0.95


def test_a_place_is_seen_when_the_object_that_stands_there_is(made) -> None:
    session = made[1][0]
    config = replace(session.config, noise=0.0, shutter=0.0, frames=24)
    sightings = Sightings(SessionOptions(), config, session.room)
    for item in session.room.objects:
        sightings.expect(0, session.room, item.index)
    table = next(o for o in session.room.objects if o.class_name == "dining table")
    shifts = np.array([[6.5, 0, 0], [-6.5, 0, 0], [0, 6.5, 0], [0, -6.5, 0]])  # behind each wall
    for number, shift in enumerate(shifts, start=1):
        ghost = only(session.room, table.index)
        parts = ghost.surfaces
        frame = parts.world_from_patch + np.pad(shift[:, None], ((0, 0), (3, 0)))
        parts = replace(
            parts, world_from_patch=frame, corners_in_world=parts.corners_in_world + shift
        )
        place = replace(table, index=0, center_in_world=table.center_in_world + shift)
        outline = (ghost.outline_in_world[0] + shift,)
        sightings.ghosts[number, table.identity] = replace(
            ghost, surfaces=parts, objects=(place,), outline_in_world=outline
        )
        sightings.places[number, table.identity] = 0
    for frame in render_clip(session.room, config, session.cameras):
        sightings.watch(frame)
    counts = np.array([[sightings.objects[i], sightings.places[0, i]] for i in sightings.objects])
    assert counts[:, 0].max() >= 8 and (counts[:, 0] == 0).sum() < len(counts) / 2
    assert np.abs(counts[:, 0] - counts[:, 1]).max() <= 2
    assert [sightings.places[number, table.identity] for number in (1, 2, 3, 4)] == [0, 0, 0, 0]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three sessions, as the command writes it."""
    folder = tmp_path_factory.mktemp("sessions")
    with pytest.MonkeyPatch.context() as patch:
        quick = functools.partial(RoomConfig, light_rays=1)
        patch.setattr(render_sessions, "RoomConfig", quick)
        options = ["--seed", "7", "--sessions", "3", "--frames", "6", "--size", "160x120"]
        options += ["--texels", "40", "--boxes", "exact"]
        assert render_sessions.main(["-o", str(folder), *options]) == 0
    return folder


def truth_of(folder: Path) -> dict:
    return json.loads((folder / "gt_objects.json").read_text())


def test_changes_are_the_difference_of_the_truths_of_the_sessions(written: Path) -> None:
    changes = json.loads((written / "changes.json").read_text())
    truths = [{o["id"]: o for o in truth_of(written / f"session{n}")["objects"]} for n in (1, 2, 3)]
    pairs = [(c["session"], c["against"]) for c in changes["changes"]]
    assert pairs == [(2, 1), (3, 1), (3, 2)]
    states = set()
    for change in changes["changes"]:
        before, now = truths[change["against"] - 1], truths[change["session"] - 1]
        entries = {entry["id"]: entry for entry in change["objects"]}
        assert entries.keys() == before.keys() | now.keys()
        for i, entry in entries.items():
            states.add(entry["state"])
            if i not in now:
                assert entry["state"] == "gone" and "to" not in entry
                continue
            assert entry["to"] == pytest.approx(now[i]["center"])
            if i not in before:
                earlier = any(i in truth for truth in truths[: change["against"] - 1])
                assert entry["state"] == ("returned" if earlier else "new")
                continue
            assert entry["from"] == pytest.approx(before[i]["center"])
            shift = np.linalg.norm(np.subtract(now[i]["center"], before[i]["center"]))
            assert entry["distance_m"] == pytest.approx(shift, abs=1e-5)
            turn = np.exp(1j * (now[i]["yaw_rad"] - before[i]["yaw_rad"]))
            assert np.exp(1j * entry["turn_rad"]) == pytest.approx(turn, abs=1e-5)
            assert entry["state"] == ("moved" if shift > 0.01 else "stayed")
    assert states >= {"stayed", "moved", "gone", "new"}


def test_an_object_that_comes_back_is_returned_and_not_new(made) -> None:
    whole = made[1][0].room
    without = replace(whole, objects=whole.objects[:-1])
    seen = [Sightings(SessionOptions(), made[1][0].config, room) for room in (whole, without)]
    rooms = [whole, without, whole]
    sightings = [seen[0], seen[1], seen[0]]
    last = whole.objects[-1].identity

    def state(session: int, reference: int, chosen=rooms) -> str:
        entries = change_entries(chosen, session, reference, sightings)
        return {entry["id"]: entry["state"] for entry in entries}[last]

    assert state(1, 0) == "gone"
    assert state(2, 1) == "returned"
    assert state(2, 0) == "stayed"
    assert state(2, 1, [without, without, whole]) == "new"


def test_frames_seen_are_those_of_the_mot_truth(written: Path) -> None:
    changes = json.loads((written / "changes.json").read_text())
    for session in changes["sessions"]:
        rows = np.loadtxt(written / session["folder"] / "gt_mot.txt", delimiter=",")
        seen = rows[rows[:, 8] >= 0.2]
        counts = {str(int(i)): int((seen[:, 1] == i).sum()) for i in np.unique(seen[:, 1])}
        assert counts == {i: n for i, n in session["frames_seen"].items() if n}
        assert sum(counts.values()) > 10


def test_every_session_is_a_clip_with_its_own_lens(written: Path) -> None:
    focal = []
    for n in (1, 2, 3):
        folder = written / f"session{n}"
        names = {path.name for path in folder.iterdir()}
        assert names == {"room.mp4", "detections.npz", "gt_mot.txt", "gt_objects.json",
                         "poses.txt", "camera.txt"}  # fmt: skip
        focal.append(float((folder / "camera.txt").read_text().split()[4]))
        assert np.loadtxt(folder / "poses.txt").shape == (6, 8)
        assert truth_of(folder)["room_m"] == truth_of(written / "session1")["room_m"]
    assert focal[1] / focal[0] == pytest.approx(1.2) and focal[2] == focal[0]


def test_exact_boxes_are_those_of_the_truth(written: Path) -> None:
    folder = written / "session1"
    rows = np.loadtxt(folder / "gt_mot.txt", delimiter=",")
    data = np.load(folder / "detections.npz")
    boxes, frames = data["xyxy"], data["frame"]
    clear = rows[rows[:, 8] > 0.5]
    found = [
        np.abs(boxes[frames == row[0] - 1] - [*row[2:4], *(row[2:4] + row[4:6])]).max(1).min()
        for row in clear
    ]
    assert len(found) > 10 and np.mean(np.array(found) < 0.02) > 0.9


@pytest.mark.parametrize("options", [["--sessions", "0"], ["--size", "640"], ["--zoom", "-1"]])
def test_bad_options_are_refused(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert render_sessions.main(["-o", str(tmp_path), *options]) == 2
    assert "error:" in capsys.readouterr().err
