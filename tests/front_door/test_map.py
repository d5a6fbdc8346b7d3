"""`run --map`: the same numbers in the next recording of a room, what changed, and refusals.

Monday is the first five seconds of examples/room, Tuesday is examples/room_later: a chair and the
bowl moved, a bottle is gone, a ball is new. Tuesday's poses are in a world of their own, of another
scale.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from map_sessions import read_mot, true_objects
from scipy.spatial.transform import Rotation

import reobj_track as rt
from front_door.room import CAMERA, ROOM, ROOT, SMALL, cli, info, refusal
from reobj.cameras import invert_rigid
from reobj.maps.room_map import RoomMap, map_lock
from reobj.maps.stage import OpenMap, place_recording
from reobj.results.changes import read_changes

LATER = ROOT / "examples" / "room_later"
PLAIN = ("--set", "output.overlay=none", "--set", "output.scene=0")
CHAIR = 5  # in gt_objects.json of both recordings, as the next ones
BOWL = 6
BOTTLE = 9
BALL = 36
KINDS = ("stayed", "moved", "gone", "new", "not_seen")


def moved_poses(path: Path, to: Path, scale: float = 1.0) -> None:
    """Write TUM rows in another world: a random similarity of this scale is applied."""
    rng = np.random.default_rng(7)
    turn = Rotation.random(random_state=7)
    rows = np.loadtxt(path)
    rows[:, 1:4] = scale * turn.apply(rows[:, 1:4]) + rng.uniform(-20, 20, 3)
    rows[:, 4:] = (turn * Rotation.from_quat(rows[:, 4:])).as_quat()
    np.savetxt(to, rows, fmt="%.9f")


def words(folder: Path, out: Path, room: Path, *more: object) -> tuple[object, ...]:
    """Words of a run of a rendered recording."""
    poses = folder / "moved.txt" if (folder / "moved.txt").exists() else folder / "poses.txt"
    given = ("--detections", folder / "detections.npz", "--poses", poses, "--camera", CAMERA)
    return ("run", folder / "room.mp4", "-o", out, "--map", room, *given, *SMALL, *PLAIN, *more)


def monday(base: Path, out: str = "monday", room: str = "flat.map") -> tuple[object, ...]:
    return words(ROOM, base / out, base / room, "--stop", 60, "--every", 4)


def tuesday(base: Path, *more: object) -> tuple[object, ...]:
    return words(base / "later", base / "tuesday", base / "flat.map", "--every", 4, *more)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outputs monday/ and tuesday/, monday.map (after Monday) and flat.map (after both)."""
    base = tmp_path_factory.mktemp("map")
    (base / "later").mkdir()
    for name in ("room.mp4", "detections.npz"):
        (base / "later" / name).symlink_to(LATER / name)
    moved_poses(LATER / "poses.txt", base / "later" / "moved.txt", scale=0.4)
    assert cli(*monday(base), "--set", "map.pictures=true") == 0
    shutil.copy(base / "flat.map", base / "monday.map")
    assert cli(*tuesday(base)) == 0
    return base


@pytest.fixture
def desk(made: Path, tmp_path: Path) -> Path:
    """A copy of everything that `made` holds."""
    shutil.copytree(made, tmp_path, symlinks=True, dirs_exist_ok=True)
    return tmp_path


def true_of(out: Path, folder: Path) -> dict[int, int]:
    """Map the numbers of located objects to true objects, by most of their boxes in tracks.txt."""
    located = {o["id"] for o in info(out)["objects"] if o["status"] in ("ok", "prior_dominated")}
    found = true_objects(read_mot(out / "tracks.txt"), read_mot(folder / "gt_mot.txt"))
    return {number: identity for number, identity in found.items() if number in located}


def refit(base: Path, *more: object) -> int:
    """Run `objects` on Tuesday, with the map in the same folder."""
    return cli("objects", base / "tuesday", "--set", f"map.path={base}/flat.map", *more)


def true_objects_of(folder: Path) -> dict[int, dict[str, Any]]:
    listed = json.loads((folder / "gt_objects.json").read_text())["objects"]
    return {o["id"]: o for o in listed}


def number_of(true: dict[int, int], identity: int) -> int:
    """The only number of a true object."""
    (number,) = (n for n, i in true.items() if i == identity)
    return number


def ids(out: Path, kind: str) -> set[int]:
    return {c.id for c in getattr(read_changes(out / "changes.json"), kind)}


def test_tuesday_has_the_numbers_of_monday(made: Path) -> None:
    first = true_of(made / "monday", ROOM)
    second = true_of(made / "tuesday", LATER)
    known = {i: number for number, i in first.items()}
    again = {i: number for number, i in second.items() if i in known}
    assert len(known) >= 12 and len(again) >= 11
    wrong = {i: (known[i], n) for i, n in again.items() if known[i] != n and n in first}
    assert wrong == {}  # no number of another object
    kept = {i for i, number in again.items() if known[i] == number}
    assert set(again) - kept <= {CHAIR}  # one of four identical chairs may get a new number
    assert {number_of(first, BOWL)} == ids(made / "tuesday", "moved") - {known[CHAIR]}
    assert ids(made / "tuesday", "stayed") == {known[i] for i in kept - {BOWL, CHAIR}}
    assert known[BOTTLE] in ids(made / "tuesday", "gone")
    assert ids(made / "tuesday", "gone") <= {known[BOTTLE], known[CHAIR]}
    new = ids(made / "tuesday", "new")
    assert number_of(second, BALL) in new and not new & set(first)
    for found in RoomMap.load(made / "monday.map").objects:  # with pictures on request
        jpeg = np.frombuffer(found.observations[0].picture, np.uint8)
        assert max(cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape) <= 160


def test_a_recording_without_images_is_not_placed(made: Path, tmp_path: Path) -> None:
    """Its boxes and poses are used as without a map."""
    before = (made / "monday.map").read_bytes()
    poses = rt.PosesConfig(camera=CAMERA, mode=str(ROOM / "poses.txt"))
    config = rt.Config(poses=poses, output=rt.OutputConfig(overlay="none", scene=False))
    config = dataclasses.replace(config, input=rt.InputConfig(every=8, stop=80))
    given = {"detections": ROOM / "detections.npz", "map": made / "monday.map"}
    result = rt.run(None, tmp_path, config, **given)
    assert result.changes.refused == "a recording without images cannot be placed in a map"
    assert result.located and (made / "monday.map").read_bytes() == before


def test_images_between_keyframes_place_a_recording(made: Path) -> None:
    """One keyframe alone is too few."""
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(start=12, stop=24))
    frames = np.arange(12, 24)
    rows = np.loadtxt(ROOM / "poses.txt")[frames]
    rotation = Rotation.from_quat(rows[:, 4:]).as_matrix()
    truth = invert_rigid(np.concatenate([rotation, rows[:, 1:4, None]], 2))
    camera = rt.Camera("PINHOLE", *video.size, tuple(map(float, CAMERA.split(","))))
    poses = rt.Poses(
        camera, frames, frames / 12, truth, np.full(12, "user"), "user",
        points=np.zeros((1, 3)), visibility=np.zeros((1, 2), np.int64),
    )  # fmt: skip
    opened = OpenMap(made / "monday.map", RoomMap.load(made / "monday.map"), True)
    placed = place_recording(opened, poses, video)
    assert placed.placement.refused == "" and len(placed.features) == 12
    moved = invert_rigid(placed.poses.cam_from_world)[:, :, 3] - rows[:, 1:4]
    assert np.linalg.norm(moved, axis=1).max() < 0.03  # m


def test_refits_against_a_frozen_map_keep_all_numbers(desk: Path) -> None:
    """Those of the map, which another run is updating, and those of doubtful objects."""
    out = desk / "tuesday"
    where = ("--set", f"map.path={desk / 'monday.map'}", "--set", "map.frozen=true")
    before = (desk / "monday.map").read_bytes()
    changes = read_changes(out / "changes.json")
    found = []
    with map_lock(desk / "monday.map"):
        for options in ((), ("--known-size", "chair=1.2m"), ("--shape", "box")):
            assert cli("objects", out, *where, *options) == 0
            objects = rt.Result.load(out).objects
            found.append({o.id: (o.class_name, o.tracklet_ids) for o in objects})
            if not options:
                again = read_changes(out / "changes.json")
    assert found[0] == found[1] == found[2]
    assert (desk / "monday.map").read_bytes() == before
    for kind in KINDS:
        assert [c.id for c in getattr(again, kind)] == [c.id for c in getattr(changes, kind)], kind


def test_corrections_keep_all_other_numbers(desk: Path) -> None:
    """A split object gets a number that no object of the map had, in every later refit the same."""
    out = desk / "tuesday"
    before = {o.id: o.tracklet_ids for o in rt.Result.load(out).objects}
    rows = np.loadtxt(out / "tracks.txt", delimiter=",")
    rows = rows[(rows[:, 1] == rows[0, 1]) & (rows[:, 6] > 0)]
    frame, number, x, y, w, h = rows[0, :6]
    edit = {"do": "split", "object": {"id": int(number), "frame": int(frame) - 1,
            "box": [x, y, x + w, y + h]}, "frames": [int(rows[len(rows) // 2, 0]) - 1,
            int(rows[-1, 0]) - 1]}  # fmt: skip
    path = desk / "e.json"
    path.write_text(json.dumps({"format": "reobj-edits", "version": 1, "edits": [edit]}))
    highest = RoomMap.load(desk / "flat.map").next_id - 1
    found = []
    for options in (("--edits", path), ("--shape", "box")):
        assert refit(desk, *options) == 0
        now = {o.id: o.tracklet_ids for o in rt.Result.load(out).objects}
        (new,) = now.keys() - before.keys()
        assert before.keys() <= now.keys() and new > max(highest, *before)
        assert {i: now[i] for i in before if i != number} == {
            i: before[i] for i in before if i != number
        }
        found.append(new)
    assert len(set(found)) == 1


def test_places_are_true_in_the_world_of_the_map(made: Path) -> None:
    """Monday's poses are in the room's frame, and so is everything of Tuesday."""
    second = true_of(made / "tuesday", LATER)
    before = true_objects_of(ROOM)
    after = true_objects_of(LATER)
    changes = read_changes(made / "tuesday" / "changes.json")
    moved = np.subtract(after[BOWL]["center"], before[BOWL]["center"])
    bowl = next(c for c in changes.moved if c.class_name == "bowl")
    assert bowl.distance_m == pytest.approx(np.linalg.norm(moved), abs=0.03)
    assert 0 < bowl.sigma_m < 0.1
    assert bowl.before is not None and bowl.after is not None
    np.testing.assert_allclose((bowl.after - bowl.before)[:2], moved[:2], atol=0.03)
    objects = {o["id"]: o for o in info(made / "tuesday")["objects"] if o["status"] == "ok"}
    error = {n: np.linalg.norm(np.subtract(o["center"], after[second[n]]["center"]))
             for n, o in objects.items()}  # fmt: skip
    assert len(error) >= 8 and np.median(list(error.values())) < 0.03, error
    assert info(made / "tuesday")["world"]["units"] == "m"
    assert changes.localised_frames == changes.tried_frames == 15 and changes.sigma_m < 0.01


@pytest.mark.slow
def test_a_renamed_copy_of_a_recording_is_its_session(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is no second observation of the objects, whose sigmas would shrink."""
    shutil.copy(desk / "monday.map", desk / "flat.map")
    before = RoomMap.load(desk / "flat.map")
    shutil.copy(ROOM / "room.mp4", desk / "VID_1 (1).mp4")
    video, *rest = monday(desk, "copy")[1:]
    assert video == ROOM / "room.mp4"
    assert cli("run", desk / "VID_1 (1).mp4", *rest) == 0
    streams = capsys.readouterr()
    assert streams.err.count("it has this recording as session 1 (room.mp4") == 1
    assert f"made with {len(before.objects)} objects" in streams.out  # not: all of them are new
    after = RoomMap.load(desk / "flat.map")
    assert [s.number for s in after.sessions] == [1]
    assert statuses(after) == statuses(before)
    assert true_of(desk / "copy", ROOM) == true_of(desk / "monday", ROOM)


@pytest.fixture
def mirrored(desk: Path) -> Path:
    """A few frames of a room that is the mirror image of Tuesday's, in the same folder."""
    folder = desk / "mirrored"
    folder.mkdir()
    frames = range(0, 60, 6)
    size = (640, 480)
    writer = cv2.VideoWriter(str(folder / "room.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 12, size)
    for frame in rt.Video(LATER / "room.mp4", rt.InputConfig(every=6)):
        writer.write(np.ascontiguousarray(frame.image[:, ::-1]))
    writer.release()
    with np.load(LATER / "detections.npz") as file:
        rows = np.isin(file["frame"], list(frames))
        xyxy = file["xyxy"][rows]
        xyxy[:, [0, 2]] = size[0] - xyxy[:, [2, 0]]
        given = {name: file[name][rows] for name in ("score", "class_id")}
        whole = {name: file[name] for name in ("image_size", "class_names")}
        np.savez(folder / "detections.npz", frame=file["frame"][rows] // 6, xyxy=xyxy,
                 **given, **whole)  # fmt: skip
    poses = np.loadtxt(LATER / "poses.txt")[list(frames)]
    poses[:, 0] = np.arange(len(frames)) / 12
    poses[:, 1] *= -1  # x -> -x of the world and of the camera
    poses[:, [5, 6]] *= -1
    np.savetxt(folder / "poses.txt", poses, fmt="%.9f")
    return folder


def test_another_room_is_refused(
    desk: Path, mirrored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (desk / "flat.map").read_bytes()
    capsys.readouterr()
    assert cli(*words(mirrored, desk / "other", desk / "flat.map")) == 0
    said = capsys.readouterr()
    why = "this is not the room of flat.map, or nothing in view matches it"
    assert " ".join(said.out.split()).count(why) == 1 and said.err.count(why) == 1
    assert (desk / "flat.map").read_bytes() == before
    changes = read_changes(desk / "other" / "changes.json")
    assert why in changes.refused and changes.tried_frames == 10
    assert not any(getattr(changes, kind) for kind in KINDS)
    objects = info(desk / "other")["objects"]
    assert len(objects) >= 8 and [o["id"] for o in objects] == list(range(1, len(objects) + 1))


def test_unusable_maps_end_the_run_before_any_work(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = (desk / "flat.map").read_bytes()

    def refused(content: bytes | None, *more: object) -> str:
        if content is None:
            (desk / "flat.map").unlink()
        else:
            (desk / "flat.map").write_bytes(content)
        shutil.rmtree(desk / "tuesday", ignore_errors=True)
        text = refusal(capsys, *tuesday(desk, *more))
        assert not (desk / "tuesday" / "objects.json").exists()
        assert not list((desk / "tuesday").rglob("*.npz"))  # no stage was run
        if content is not None:
            assert (desk / "flat.map").read_bytes() == content
        return text

    assert "flat.map: damaged" in refused(good[:-100])
    assert "flat.map: not a map" in refused((ROOM / "detections.npz").read_bytes())
    with map_lock(desk / "flat.map"):
        text = refused(good)
    assert "another run is updating this map" in text and "--map-frozen" in text
    assert "no such map" in refused(None, "--map-frozen")
    text = refusal(capsys, *tuesday(desk, "--map-frozen", "--map", ""))
    assert "--map-frozen without --map" in text
    text = refusal(capsys, "objects", desk / "monday", "--set", f"map.path={desk}/flat.map")
    assert "is missing" in text and "--set map.path=" in text
    assert not (desk / "flat.map").exists()


def test_corrections_of_the_page_reach_the_map(desk: Path) -> None:
    """The edits are those that scene.html saves: boxes, numbers of the map and its identifier."""
    room = RoomMap.load(desk / "flat.map")
    changes = read_changes(desk / "tuesday" / "changes.json")
    tracks = read_mot(desk / "tuesday" / "tracks.txt")
    true = true_of(desk / "tuesday", LATER)
    bowl = number_of(true, BOWL)
    ball = number_of(true, BALL)

    def reference(number: int) -> dict[str, Any]:
        row = tracks[tracks[:, 1] == number][0]
        return {"id": number, "frame": int(row[0]) - 1, "box": row[2:].tolist()}

    edits = [
        {"do": "rename", "object": reference(bowl), "class": "fruit bowl"},
        {"do": "delete", "object": reference(ball)},
    ]
    page = {"format": "reobj-edits", "version": 1, "map": room.map_id, "edits": edits}
    (desk / "edits.json").write_text(json.dumps(page))
    assert refit(desk, "--edits", desk / "edits.json") == 0
    after = RoomMap.load(desk / "flat.map")
    assert after.object(bowl).name == "fruit bowl" and after.object(ball).deleted
    assert {o.id for o in after.objects} == {o.id for o in room.objects}
    classes = {o["id"]: o["class"] for o in info(desk / "tuesday")["objects"]}
    assert classes[bowl] == "fruit bowl" and ball not in classes
    del true[ball]
    assert true_of(desk / "tuesday", LATER) == true
    # the changes are those since the session before, although the map has this one by now
    assert statuses(after) == statuses(room)
    again = read_changes(desk / "tuesday" / "changes.json")
    for kind in KINDS:
        known = [c.id for c in getattr(changes, kind) if c.id != ball]
        assert [c.id for c in getattr(again, kind)] == known, kind


def statuses(room: RoomMap) -> dict[tuple[int, int], str]:
    """What happened, by object and session."""
    return {(o.id, x.session): x.status for o in room.objects for x in o.observations}
