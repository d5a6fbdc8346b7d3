"""Alignment of a recording with a map by objects alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from map_alignment import changed, simulated_room
from map_alignment import measured as landmarks
from scipy.spatial.transform import Rotation
from test_map_run import CAMERA, ROOM

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.maps.object_alignment import AlignmentOptions, align
from reobj.maps.object_placement import place_by_objects
from reobj.maps.placement import ComponentPlacement, Placement
from reobj.maps.room_map import MapPoints

TURN = Rotation.from_euler("z", 2.0).as_matrix()
SHIFT = np.array([3.0, -2.0, 0.4])
SCALE = 1.05  # metres of the map per metre of the recording
SCALE_SIGMA = 0.07


def in_session(objects):
    """Move objects (centre, class, log size) from the map to the world of a recording."""
    center, kind, size = objects
    return (center - SHIFT) @ TURN / SCALE, kind, size - np.log(SCALE)


def distances(aligned, found, objects):
    """Distances of the objects of the recording, placed in the map, from their true centres."""
    placed = aligned.scale * found.center @ aligned.rotation.T + aligned.shift
    return np.linalg.norm(placed - objects[0], axis=1)


def test_a_room_of_which_a_quarter_changed_is_aligned():
    aligned_rooms = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        room = simulated_room(rng, 14)
        now = changed(rng, room)
        found = landmarks(rng, in_session(now), 0.1)
        aligned = align(landmarks(rng, room, 0.1), found, SCALE_SIGMA)
        if not aligned.reason:
            aligned_rooms += 1
            assert np.median(distances(aligned, found, now)) < 0.3
            assert abs(np.log(aligned.scale / SCALE)) < 0.1
            assert len(aligned.pairs) >= max(aligned.rival, aligned.mirror) + 2
    assert aligned_rooms >= 8


def test_without_a_known_scale_it_is_free():
    rng = np.random.default_rng(0)
    room = simulated_room(rng, 14)
    center, kind, size = in_session(room)
    found = landmarks(rng, (center / 1.5, kind, size - np.log(1.5)), 0.05)
    aligned = align(landmarks(rng, room, 0.1), found, np.inf)
    assert aligned.reason == "" and aligned.scale == pytest.approx(SCALE * 1.5, rel=0.05)


def test_objects_of_another_size_do_not_coincide():
    """Two of 14 have become three times as large; the others give the place."""
    rng = np.random.default_rng(0)
    room = simulated_room(rng, 14)
    center, kind, size = in_session(room)
    size[[4, 9]] += np.log(3)
    aligned = align(
        landmarks(rng, room, 0.1), landmarks(rng, (center, kind, size), 0.1), SCALE_SIGMA
    )
    assert aligned.reason == "" and len(aligned.pairs) >= 10
    assert not {4, 9} & set(aligned.pairs[:, 0].tolist())


def test_distances_beyond_the_covariances_enlarge_that_of_the_place():
    """Both sides claim a sigma of 4 cm; in the second case the centres are off by 10 cm."""
    sigmas = []
    for error in (0.0, 0.1):
        rng = np.random.default_rng(5)
        room = simulated_room(rng, 16)
        of_map = landmarks(rng, room, 0.0)
        found = landmarks(rng, in_session(room), error)
        claimed = np.tile(np.eye(3) * 0.04**2, (16, 1, 1))
        aligned = align(
            dataclasses.replace(of_map, cov=claimed),
            dataclasses.replace(found, cov=claimed),
            SCALE_SIGMA,
        )
        assert aligned.reason == "" and len(aligned.pairs) >= 12
        sigmas.append(np.sqrt(np.diag(aligned.cov)[3:5].sum()))
    assert sigmas[1] > 1.3 * sigmas[0]


def test_errors_agree_with_the_covariance():
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        room = simulated_room(rng, 16)
        aligned = align(
            landmarks(rng, room, 0.1), landmarks(rng, in_session(room), 0.1), SCALE_SIGMA
        )
        assert aligned.reason == ""
        turn = TURN @ aligned.rotation.T  # the correction that leads to the truth
        grow = SCALE / aligned.scale
        moved = SHIFT - grow * turn @ aligned.shift
        error = np.array([*Rotation.from_matrix(turn).as_rotvec(), *moved, np.log(grow)])
        squares.append(error @ np.linalg.solve(aligned.cov, error))
    assert 2 < np.median(squares) < 15  # 6.3 of seven degrees of freedom, less with priors


@pytest.mark.parametrize("mirrored", [False, True])
def test_another_room_and_a_mirrored_one_are_refused(mirrored):
    for seed in range(15):
        rng = np.random.default_rng(seed)
        room = simulated_room(rng, 16)
        other = simulated_room(rng, 16)
        if mirrored:
            other = (room[0] * (-1, 1, 1), *room[1:])
        found = landmarks(rng, in_session(other), 0.1)
        aligned = align(landmarks(rng, room, 0.1), found, SCALE_SIGMA)
        assert f"{len(aligned.pairs)} objects coincide with the map, " in aligned.reason
        assert f"{aligned.rival} in another place" in aligned.reason
        if mirrored:
            assert aligned.mirror >= 14 and f"{aligned.mirror} in a mirror image" in aligned.reason


def test_a_repeated_room_is_refused():
    """The recording shows one of two equal rooms, both of which are in the map."""
    rng = np.random.default_rng(1)
    room = simulated_room(rng, 12)
    both = tuple(np.concatenate([x, y]) for x, y in zip(room, room, strict=True))
    both[0][12:] += (8.0, 0, 0)
    aligned = align(landmarks(rng, both, 0.05), landmarks(rng, in_session(room), 0.05), SCALE_SIGMA)
    assert aligned.rival >= 10 and aligned.reason.startswith(f"{len(aligned.pairs)} objects")


def test_few_objects_or_vague_ones_are_refused():
    rng = np.random.default_rng(2)
    room = simulated_room(rng, 12)
    seven = tuple(values[:7] for values in room)
    of_map = landmarks(rng, room, 0.02)
    reason = align(of_map, landmarks(rng, in_session(seven), 0.02), SCALE_SIGMA).reason
    assert reason.startswith("7 of the objects of the recording and 12 of those of the map are ")
    found = landmarks(rng, in_session(room), 0.02)
    vague = dataclasses.replace(found, cov=np.tile(np.eye(3), (12, 1, 1)))
    reason = align(of_map, vague, SCALE_SIGMA).reason
    assert reason.startswith("0 of the objects of the recording and 12 of those of the map are ")


def test_looks_distinguish_equal_places():
    """Of two equal halves of a room the one with the right looks is chosen."""
    rng = np.random.default_rng(3)
    room = simulated_room(rng, 10)
    both = tuple(np.concatenate([x, y]) for x, y in zip(room, room, strict=True))
    both[0][10:] += (8.0, 0, 0)
    looks = rng.normal(size=(20, 32))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    of_map = dataclasses.replace(landmarks(rng, both, 0.05), looks=looks)
    for half in (slice(10), slice(10, 20)):
        shown = in_session(tuple(values[half] for values in both))
        found = dataclasses.replace(landmarks(rng, shown, 0.05), looks=looks[half])
        aligned = align(of_map, found, SCALE_SIGMA, AlignmentOptions(margin=0))
        assert len(aligned.pairs) >= 9
        np.testing.assert_array_equal(aligned.pairs[:, 1], np.arange(20)[half][aligned.pairs[:, 0]])


def test_points_that_contradict_a_place_are_not_overruled():
    """Only a recording whose images match too few points is placed by objects."""
    few = ComponentPlacement(None, (), 40, "few", unmatched=True)
    contradicted = dataclasses.replace(few, reason="two positions", unmatched=False)
    assert Placement(None, (few, few), "few").unmatched
    assert not Placement(None, (few, contradicted), "few").unmatched
    assert not Placement(None, (few,), "").unmatched


# ---- The command line --------------------------------------------------------------------------


def config(start: int) -> rt.Config:
    """Every twelfth frame of the example, no embeddings, no pictures."""
    return rt.Config(
        input=rt.InputConfig(every=12, start=start),
        embed=rt.EmbedConfig(model="none"),
        output=rt.OutputConfig(overlay="none", scene=False),
    )


def with_poses(start: int, path: Path) -> rt.Config:
    """The same with given cameras."""
    return dataclasses.replace(config(start), poses=rt.PosesConfig(camera=CAMERA, mode=str(path)))


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A map without points, and poses of the example in another world."""
    folder = tmp_path_factory.mktemp("bare")
    path = folder / "flat.map"
    boxes = ROOM / "detections.npz"
    rt.run(ROOM / "room.mp4", folder / "a", with_poses(0, ROOM / "poses.txt"), detections=boxes,
           map=path)  # fmt: skip
    dataclasses.replace(rt.RoomMap.load(path), points=MapPoints.empty()).save(path)
    rows = np.loadtxt(ROOM / "poses.txt")
    rows[:, 1:4] = rows[:, 1:4] @ TURN.T + SHIFT
    rows[:, 4:] = (Rotation.from_matrix(TURN) * Rotation.from_quat(rows[:, 4:])).as_quat()
    np.savetxt(folder / "moved.txt", rows)
    return path, folder / "moved.txt"


def test_a_run_is_placed_by_its_objects(bare, tmp_path):
    path, moved = bare
    boxes = ROOM / "detections.npz"
    result = rt.run(ROOM / "room.mp4", tmp_path, with_poses(6, moved), detections=boxes, map=path)
    changes = rt.Result.load(tmp_path).changes
    assert changes.placed_by == "objects" and changes.refused == ""
    assert 0.003 < changes.sigma_m < 0.2
    frame = result.poses.frame
    rows = np.loadtxt(ROOM / "poses.txt")[frame, 1:4]
    centre = invert_rigid(result.poses.cam_from_world)[:, :, 3]
    assert np.median(np.linalg.norm(centre - rows, axis=1)) < 0.15  # m
    known = {o.id: o for o in rt.RoomMap.load(path).objects}
    assert len(changes.stayed) >= 10 and not changes.gone
    assert all(c.id in known for c in changes.stayed)
    assert any("was placed in the map by" in w and "objects" in w for w in result.warnings)
    room = rt.RoomMap.load(path)
    assert len(room.sessions) == 2 and room.sessions[1].localised_frames == 0
    assert len(room.points) == 0  # objects do not locate points well enough
    again = rt.refit(tmp_path).changes
    assert again.placed_by == "objects" and again.sigma_m == pytest.approx(
        changes.sigma_m, rel=0.01
    )


def test_classes_of_the_map_may_have_other_names(bare, tmp_path):
    """A detector that writes "Chair" and "Dining_Table" made the map."""
    path, moved = bare
    room = rt.RoomMap.load(path)
    objects = [
        dataclasses.replace(o, observations=tuple(
            dataclasses.replace(
                seen, classes={k.title().replace(" ", "_"): v for k, v in seen.classes.items()})
            for seen in o.observations))
        for o in room.objects
    ]  # fmt: skip
    dataclasses.replace(room, objects=tuple(objects)).save(tmp_path / "titles.map")
    result = rt.run(
        ROOM / "room.mp4", tmp_path / "out", with_poses(6, moved), map=tmp_path / "titles.map",
        detections=ROOM / "detections.npz", map_frozen=True,
    )  # fmt: skip
    assert result.changes.placed_by == "objects" and len(result.changes.stayed) >= 10


def test_too_few_of_the_objects_in_view_are_refused(bare):
    """The recording in its map: nearly all coincide; more than are in view are never there."""
    path, _ = bare
    result = rt.Result.load(path.parent / "a")
    unmatched = (ComponentPlacement(None, (), 1, "no points", unmatched=True),)
    by_points = Placement(result.poses, unmatched, "no points")

    def placed(**options):
        of = AlignmentOptions(**options)
        return place_by_objects(rt.RoomMap.load(path), result, "", by_points, of)

    found = placed()
    assert found.refused == "" and found.by == "objects"
    count = int(found.poses.messages[-1].split("in the map by ")[1].split()[0])
    assert count >= 10
    refused = placed(share=1.5).refused
    assert refused.startswith(f"no points; by objects: {count} objects coincide with the map, of ")
    in_view = int(refused.split("map, of ")[1].split()[0])
    assert count <= in_view and f"in view; {int(np.ceil(1.5 * in_view))} of at least 8" in refused


def test_a_frozen_map_leaves_the_placement_to_the_output_folder(bare, tmp_path):
    """`objects OUT` knows by what the recording was placed, and how well."""
    path, moved = bare
    boxes = ROOM / "detections.npz"
    before = path.read_bytes()
    result = rt.run(
        ROOM / "room.mp4", tmp_path, with_poses(3, moved), detections=boxes, map=path,
        map_frozen=True,
    )  # fmt: skip
    again = rt.refit(tmp_path).changes
    assert path.read_bytes() == before
    assert again.placed_by == result.changes.placed_by == "objects"
    assert again.sigma_m == pytest.approx(result.changes.sigma_m, rel=0.01)
    assert {c.id for c in again.stayed} == {c.id for c in result.changes.stayed}
