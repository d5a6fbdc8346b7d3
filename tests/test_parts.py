"""A trajectory in two unconnected components: each has its own frame, in every file."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from simulated import (
    BREAK,
    CHAIR,
    PARTS,
    SIZE,
    chair_solids,
    finished,
    into_part,
    tracks_in_two_parts,
    tracks_of,
    two_parts,
    unlinked,
    walk,
    with_columns,
)

import quadrics
import reobj.objects.fit
import reobj_track as rt
from reobj.cameras import invert_rigid, read_sparse_model, write_colmap
from reobj.files import part_path
from reobj.objects.description import components_message
from reobj.poses.floor import Floor
from reobj.results.evaluation_3d import score_objects
from reobj.results.overlay import Overlay
from reobj.results.saving import validate_objects
from reobj.results.scene import Pictures, write_scene
from reobj.types import Embeddings

CENTERS = chair_solids().center_in_world
NAMES = rt.COCO_NAMES


# ---- Linked and fitted ----


def test_every_component_has_its_own_identities(parted: rt.Result) -> None:
    """Tracks continue over the break, but their positions after it are unrelated."""
    assert [(o.id, o.part) for o in parted.objects] == [
        (1, 0), (2, 0), (3, 0), (4, 1), (5, 1), (6, 1),
    ]  # fmt: skip
    tracks = parted.tracks
    assert set(tracks.track_id[tracks.frame < BREAK]) == {1, 2, 3}
    assert set(tracks.track_id[tracks.frame >= BREAK]) == {4, 5, 6}
    np.testing.assert_array_equal(tracks.track_id % 3, (tracks.detection_index + 1) % 3)
    assert [o.visits for o in parted.objects] == [[[0, 39]]] * 3 + [[[40, 63]]] * 3
    assert len({t for o in parted.objects for t in o.tracklet_ids}) == 6


def test_every_component_has_its_own_frame_and_scale(parted: rt.Result) -> None:
    for part, (scale, *_) in enumerate(PARTS):
        own = [o for o in parted.objects if o.part == part]
        centers = np.array([o.center for o in own])
        np.testing.assert_allclose(centers, into_part(part, CENTERS), atol=0.02 * scale)
        np.testing.assert_allclose([o.size[2] for o in own], 0.82 * scale, rtol=0.03)
        np.testing.assert_allclose([o.size_m[2] for o in own], 0.82, rtol=0.2)


def test_a_component_equals_the_result_of_a_separate_video(parted: rt.Result) -> None:
    for part in (0, 1):
        poses = parted.poses.of_part(part)
        tracks = tracks_in_two_parts(parted.poses)
        alone = finished(unlinked(poses, tracks[np.isin(tracks.frame, poses.frame)]))
        own = [o for o in parted.objects if o.part == part]
        assert len(alone.objects) == len(own) == 3
        for a, b in zip(alone.objects, own, strict=True):
            a, b = a.to_json(), b.to_json()
            for key in ("id", "part", "tracks"):
                del a[key], b[key]
            assert a == b
        (facts,) = alone.world.to_json()["parts"]
        assert facts == parted.world.to_json()["parts"][part]


def test_the_world_describes_its_components(parted: rt.Result) -> None:
    world = parted.world
    assert [(p.spans, p.frames, p.registered_frames) for p in world.parts] == [
        ([[0, 39]], 40, 38), ([[40, 63]], 24, 23),
    ]  # fmt: skip
    for part, (scale, turn, _) in zip(world.parts, PARTS, strict=True):
        assert part.scale.source == "priors"
        np.testing.assert_allclose(part.scale.value, 1 / scale, rtol=0.2)
        up = into_part(PARTS.index((scale, turn, _)), np.array([[0, 0, 1.0], [0, 0, 0]]))
        np.testing.assert_allclose(part.up_in_world, (up[0] - up[1]) / scale, atol=0.03)
    largest = world.parts[0]  # the fields that predate components
    assert world.registered_frames == 38 and world.frames == 64
    assert world.scale == largest.scale and world.up_source == largest.up_source
    np.testing.assert_array_equal(world.up_in_world, largest.up_in_world)


def test_fits_are_in_the_order_of_the_objects(parted: rt.Result) -> None:
    fits, poses = parted.fits, parted.poses
    assert len(fits) == len(fits.reason) == len(fits.cov) == 6
    np.testing.assert_allclose(
        fits.ellipsoids.center_in_world, [o.center for o in parted.objects], rtol=1e-5
    )
    seen = poses.part[poses.known]  # of the rows of `inlier`
    assert fits.inlier.shape == (61, 6)
    assert fits.inlier[seen == 0, :3].mean() > 0.9 < fits.inlier[seen == 1, 3:].mean()
    assert not fits.inlier[seen == 0, 3:].any() and not fits.inlier[seen == 1, :3].any()
    assert fits.scale.value == pytest.approx(parted.world.scale.value, abs=1e-6)
    of_second = parted.of_part(1)
    assert [o.id for o in of_second.located] == [4, 5, 6]
    np.testing.assert_allclose(
        of_second.ellipsoids().half_axes, parted.ellipsoids().half_axes[3:], rtol=1e-5
    )
    assert of_second.world.scale == parted.world.parts[1].scale
    assert len(of_second.poses.frame) == of_second.world.frames == 24


def test_a_single_component_is_the_result_itself() -> None:
    poses = two_parts().of_part(0)
    result = finished(unlinked(poses, tracks_in_two_parts(two_parts())[: 3 * BREAK]))
    assert result.of_part(0) is result and result.parts() == [result]
    assert components_message(poses) == []
    assert {o.part for o in result.objects} == {0} and len(result.world.parts) == 1


def test_identities_end_with_their_component_without_linking() -> None:
    result = finished(unlinked(), link=False)
    assert [(o.id, o.part) for o in result.objects] == [(i + 1, i // 3) for i in range(6)]


def test_a_track_that_starts_in_the_break_belongs_to_the_next_component() -> None:
    """Frames 38 to 40 have no pose; the third chair is detected from frame 39 on."""
    given = unlinked()
    third = given.tracks.detection_index == 2
    given = dataclasses.replace(
        given, tracks=given.tracks[~third | (given.tracks.frame >= BREAK - 1)]
    )
    objects = finished(given).objects
    assert [(o.part, o.status != "rejected") for o in objects] == [(0, True)] * 2 + [(1, True)] * 3
    assert sorted(o.visits[0][0] for o in objects) == [0, 0, BREAK - 1, BREAK, BREAK]


def test_embeddings_stay_aligned_with_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The linker of each component gets the embeddings of its frames, indexed by its rows."""
    given = unlinked()
    row = np.arange(0, len(given.tracks), 7)  # of the embedded tracks
    frame = given.tracks.frame[row]
    given = dataclasses.replace(
        given,
        embeddings=Embeddings(frame[:, None] + 0.0, -frame[:, None] - 0.0),
        embedding_row=row,
    )
    seen = []

    def noted(tracks: rt.Tracks, names: Any, embeddings: Embeddings, rows: Any, *a: Any, **k: Any):
        np.testing.assert_array_equal(embeddings.foreground[:, 0], tracks.frame[rows])
        np.testing.assert_array_equal(embeddings.background[:, 0], -tracks.frame[rows])
        seen.extend(tracks.frame[rows].tolist())
        return tracks, []

    monkeypatch.setattr(reobj.objects.fit, "link", noted)
    finished(given)
    assert seen == frame.tolist()


@pytest.mark.parametrize("every", [1, 8])
def test_a_tracklet_is_once_in_a_frame(every: int) -> None:
    """It switches from the first chair to the second; duplicate rows lose their tracklet."""
    poses = walk(60)
    poses = dataclasses.replace(poses, frame=poses.frame * every)
    table, chair = tracks_of(poses), tracks_of(poses).detection_index
    late = table.frame >= 30 * every
    tracklet = np.where(late, np.array([0, 1, 3])[chair], chair + 1)
    table = with_columns(table, tracklet_id=tracklet, track_id=tracklet)
    given = unlinked(poses, table[tracklet > 0])
    given = dataclasses.replace(given, untracked=table[tracklet == 0])
    tracks = finished(given).tracks
    for column in (tracks.track_id, tracks.tracklet_id):
        assert len(set(zip(tracks.frame.tolist(), column.tolist(), strict=True))) == len(tracks)
    owner = [np.unique(tracks.track_id[tracks.detection_index == k]) for k in range(3)]
    assert [len(ids) for ids in owner] == [1, 1, 1] and len(tracks) == len(table)
    again = tracks.tracklet_id[(tracks.detection_index == 0) & (tracks.frame >= 30 * every)]
    assert len(np.unique(again)) == 1  # joined although it was not tracked


def test_a_switched_tracklet_belongs_to_one_object() -> None:
    """It shows one object in frame 0 and the other in frame 1; in frame 2 both have none."""
    none, chair = np.zeros((4, 4)), np.full(4, CHAIR)
    tracklet = np.array([1, 1, 0, 0])
    table = rt.Tracks(np.array([0, 1, 2, 2]), tracklet, tracklet, none, none[0], chair, chair)
    found = reobj.objects.fit._with_tracklets(table, np.array([0, 1, 0, 1])).tracklet_id
    assert found.tolist() == [1, 1, 1, 2]


def test_objects_without_poses_have_no_confidence() -> None:
    """The third chair is detected only after frame 40, in frames without poses."""
    poses = walk(60)
    poses.cam_from_world[40:] = np.nan
    poses = dataclasses.replace(poses, status=np.where(np.arange(60) < 40, poses.status, "missing"))
    table = tracks_of(poses)
    third = table.detection_index == 2
    found = finished(unlinked(poses, table[~third | (table.frame >= 40)])).objects
    confidences = {o.class_name: [x.confidence for x in found] for o in found}["chair"]
    assert len(confidences) == 3 and confidences.count(None) == 1
    (alone,) = (o for o in found if o.confidence is None)
    assert alone.status == "rejected" and "camera" in alone.reason


def test_the_last_fit_uses_occluded_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lower third of every chair is occluded and marked as such."""
    given = unlinked(walk(), tracks_of(walk()))
    box = given.tracks.xyxy
    box[:, 3] -= 0.35 * (box[:, 3] - box[:, 1])
    heights = []
    for occluded in ([False] * 4, [False, False, False, True]):
        monkeypatch.setattr(
            reobj.objects.fit,
            "occluded_edges",
            lambda v, *_, own=occluded: np.broadcast_to(own, v.boxes.shape),
        )
        found = finished(dataclasses.replace(given), link=False).objects
        heights.append([o.size[2] for o in found if o.size is not None])
    assert len(heights[1]) == 3 and (np.array(heights[1]) > 1.2 * np.array(heights[0])).all()


def test_the_last_fit_uses_the_points_on_each_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten points on the second chair, observed by all frames; no other fit has points."""
    points = chair_solids().center_in_world[1] + np.linspace(-0.1, 0.1, 10)[:, None]
    every = np.indices((40, 10)).reshape(2, -1).T
    poses = dataclasses.replace(
        walk(), points=points, colors=np.zeros((10, 3), np.uint8), visibility=every
    )
    calls = Mock(wraps=quadrics.fit_objects)
    monkeypatch.setattr(quadrics, "fit_objects", calls)
    finished(unlinked(poses, tracks_of(poses)))
    given = [call.kwargs["points"] for call in calls.call_args_list]
    assert len(given) > 2 and all(own is None for own in given[:-1])
    assert np.isfinite(given[-1]).all(2).sum(1).tolist() == [0, 10, 0]
    found = given[-1][1][:10]
    np.testing.assert_array_equal(found[np.argsort(found[:, 2])], points)


def test_the_last_fit_starts_from_the_association(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Occluders come from the association; without one, from a first fit."""
    for link in (True, False):
        seen = Mock(wraps=reobj.objects.fit.occluded_edges)
        monkeypatch.setattr(reobj.objects.fit, "occluded_edges", seen)
        calls = Mock(wraps=quadrics.fit_objects)
        monkeypatch.setattr(quadrics, "fit_objects", calls)
        result = finished(unlinked(walk(), tracks_of(walk())), link=link)
        (_, ellipsoids, *_), _ = seen.call_args
        center = [o.center for o in result.objects]
        np.testing.assert_allclose(ellipsoids.center_in_world, center, atol=0.05)
        occluded = [call.kwargs["hidden"] is not None for call in calls.call_args_list]
        assert not occluded[0] and all(occluded[1:])
        assert link or len(occluded) == 2
        monkeypatch.undo()


@pytest.mark.parametrize("given", [True, False])
def test_the_last_fit_uses_the_floor(given: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gravity is that of the floor, unless the poses define it."""
    normal = np.array([0.0, np.sin(0.05), np.cos(0.05)])
    floor = quadrics.Floor(normal, 0.0, 0.01)
    monkeypatch.setattr(reobj.objects.fit, "find_floor", lambda poses, fits: floor)
    poses = walk() if given else dataclasses.replace(walk(), up_in_world=None)
    world = finished(unlinked(poses, tracks_of(poses)), link=False).world
    assert world.up_source == ("given" if given else "floor")
    up = poses.up_in_world if given else normal
    np.testing.assert_allclose(world.up_in_world, up, atol=1e-5)


def test_identities_of_the_user_may_span_components() -> None:
    """They are unchanged; the shape belongs to the component with most of the boxes."""
    poses = two_parts()
    tracks = tracks_in_two_parts(poses)
    tracks = tracks[(tracks.detection_index < 2) | (tracks.frame >= BREAK - 10)]  # chair 3: late
    given = unlinked(
        poses, with_columns(tracks, track_id=np.array([7, 5, 6])[tracks.detection_index])
    )
    given = dataclasses.replace(given, identities_given=True)
    result = finished(given)
    assert [(o.id, o.part, o.status) for o in result.objects] == [
        (5, 0, "ok"), (6, 1, "ok"), (7, 0, "ok"),
    ]  # fmt: skip
    assert [o.frames_seen for o in result.objects] == [64, 34, 64]
    assert [o.views for o in result.objects] == [38, 23, 38]
    at = (0, CENTERS[1:2]), (1, CENTERS[2:]), (0, CENTERS)
    centers = [into_part(*a)[0] for a in at]
    np.testing.assert_allclose([o.center for o in result.objects], centers, atol=0.06)
    np.testing.assert_allclose(result.ellipsoids().center_in_world, centers, atol=0.06)
    np.testing.assert_array_equal(result.tracks.track_id, given.tracks.track_id)


def test_a_component_with_too_few_cameras_rejects_its_objects_only() -> None:
    poses = two_parts()
    lost = poses.cam_from_world.copy()
    lost[BREAK + 3 :] = np.nan  # two cameras are left: 41 and 42
    result = finished(unlinked(dataclasses.replace(poses, cam_from_world=lost)))
    assert [o.status for o in result.objects] == ["ok"] * 3 + ["rejected"] * 3
    assert result.objects[4].reason == "seen in 2 frames with a camera pose (3 are needed)"
    assert [p.registered_frames for p in result.world.parts] == [38, 2]
    assert len(result.ellipsoids()) == 3


@pytest.mark.parametrize("empty", [0, 1])
def test_a_component_without_objects(empty: int, tmp_path: Path) -> None:
    poses = two_parts()
    tracks = tracks_in_two_parts(poses)
    result = finished(unlinked(poses, tracks[poses.part_of(tracks.frame) != empty]))
    assert [(o.id, o.part, o.status) for o in result.objects] == [
        (i, 1 - empty, "ok") for i in (1, 2, 3)
    ]
    assert result.world.parts[empty].scale is None is not result.world.parts[1 - empty].scale
    assert (result.fits.scale.source == "none") == (empty == 0) == (result.world.scale is None)
    result.save(tmp_path)
    assert f"component {empty}: " in rt.Result.load(tmp_path).summary()


def test_no_object_at_all(tmp_path: Path) -> None:
    result = finished(unlinked(tracks=rt.Tracks.empty()))
    assert result.objects == [] and result.fits is None and len(result.world.parts) == 2
    result.save(tmp_path)
    assert len(rt.Result.load(tmp_path).world.parts) == 2


def test_the_up_option_applies_to_the_largest_component() -> None:
    up = into_part(0, np.array([[0, 0, 1.0], [0, 0, 0]]))
    text = ",".join(map(str, up[0] - up[1]))
    parts = finished(unlinked(), up=text).world.parts
    assert [p.up_source == "given" for p in parts] == [True, False]


def test_unusable_boxes_do_not_decide_the_component() -> None:
    tracks = tracks_in_two_parts(two_parts())
    weak = (tracks.detection_index == 0) & (tracks.frame < BREAK)
    given = unlinked(tracks=with_columns(tracks, score=np.where(weak, 0.01, 0.9)))
    given = dataclasses.replace(given, identities_given=True)
    assert [(o.part, o.status) for o in finished(given).objects] == [
        (1, "ok"),
        (0, "ok"),
        (0, "ok"),
    ]


def test_up_of_the_poses_is_that_of_the_largest_component() -> None:
    up = into_part(0, np.array([[0, 0, 1.0], [0, 0, 0]]))
    poses = dataclasses.replace(two_parts(), up_in_world=(up[0] - up[1]) / PARTS[0][0])
    parts = finished(unlinked(poses)).world.parts
    assert [p.up_source == "given" for p in parts] == [True, False]
    true = into_part(1, np.array([[0, 0, 1.0], [0, 0, 0]]))
    np.testing.assert_allclose(parts[1].up_in_world, (true[0] - true[1]) / PARTS[1][0], atol=0.03)


def test_the_message_explains_the_break_and_a_remedy() -> None:
    (text,) = components_message(two_parts())
    for words in ("2 components", "component 0: frames 0-39", "component 1: frames 40-63",
                  "own frame and scale", "listed twice", "more overlap", "--poses",
                  "objects OUT --edits"):  # fmt: skip
        assert words in text


def test_manually_merged_identities_are_kept(parted_folder: Path, tmp_path: Path) -> None:
    """Object 4 is object 1 after the break: merged in tracks.txt and supplied again."""
    out = tmp_path / "out"
    shutil.copytree(parted_folder, out)
    rows = np.loadtxt(out / "tracks.txt", delimiter=",")
    rows[rows[:, 1] == 4, 1] = 1
    np.savetxt(tmp_path / "mot.txt", rows, delimiter=",", fmt="%.6g")
    assert rt.main(["objects", str(out), "--tracks", str(tmp_path / "mot.txt")]) == 0
    found = rt.Result.load(out).objects
    assert [(o.id, o.part, o.frames_seen, o.status) for o in found] == [
        (1, 0, 64, "ok"), (2, 0, 40, "ok"), (3, 0, 40, "ok"), (5, 1, 24, "ok"), (6, 1, 24, "ok"),
    ]  # fmt: skip
    np.testing.assert_allclose(found[0].center, into_part(0, CENTERS[:1])[0], atol=0.02)


# ---- Files ----


def test_each_component_has_its_own_files(parted_folder: Path) -> None:
    poses = two_parts()
    for part, name in enumerate(("poses.txt", "poses_part1.txt")):
        own = poses.of_part(part)
        table = np.loadtxt(parted_folder / name)
        np.testing.assert_allclose(table[:, 0], own.time_s[own.known], atol=1e-6)
        centers = invert_rigid(own.cam_from_world[own.known])[:, :, 3]
        np.testing.assert_allclose(table[:, 1:4], centers, atol=1e-6)
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    for part, name in enumerate(("objects.ply", "objects_part1.ply")):
        mesh = trimesh.load(parted_folder / name)
        middle = into_part(part, CENTERS).mean(0)
        np.testing.assert_allclose(mesh.vertices.mean(0), middle, atol=0.02 * PARTS[part][0])


def test_components_are_loaded(parted_folder: Path, parted: rt.Result, tmp_path: Path) -> None:
    found = rt.Result.load(parted_folder)
    assert found.world.to_json() == parted.world.to_json()
    assert [o.to_json() for o in found.objects] == [o.to_json() for o in parted.objects]
    assert [w for w in found.warnings if "2 components" in w]
    np.testing.assert_array_equal(found.poses.part, parted.poses.part)
    found.save(tmp_path)
    for name in ("objects.json", "poses.txt", "poses_part1.txt", "cache/last-poses.npz"):
        assert (tmp_path / name).read_bytes() == (parted_folder / name).read_bytes(), name


def test_objects_json_is_as_its_schema_says(parted_folder: Path, tmp_path: Path) -> None:
    assert validate_objects(parted_folder / "objects.json") == []
    data = json.loads((parted_folder / "objects.json").read_text())
    assert [o["part"] for o in data["objects"]] == [0, 0, 0, 1, 1, 1]
    data["objects"][0]["part"] = -1
    del data["world"]["parts"][1]["spans"]
    (tmp_path / "a.json").write_text(json.dumps(data))
    faults = " ".join(validate_objects(tmp_path / "a.json"))
    assert "objects[0].part" in faults and "world.parts[1]" in faults


def test_components_are_those_of_the_cameras(parted_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(parted_folder, tmp_path / "out")
    data = json.loads((parted_folder / "objects.json").read_text())
    data["world"]["parts"].append(data["world"]["parts"][0])
    (tmp_path / "out/objects.json").write_text(json.dumps(data))
    with pytest.raises(rt.ReobjError, match="3 components of a trajectory that has 2; is damaged"):
        rt.Result.load(tmp_path / "out")


def test_an_objects_json_without_components_loads(chairs: rt.Result, tmp_path: Path) -> None:
    dataclasses.replace(chairs).save(tmp_path)
    data = json.loads((tmp_path / "objects.json").read_text())
    del data["world"]["parts"]
    for entry in data["objects"]:
        del entry["part"]
    (tmp_path / "objects.json").write_text(json.dumps(data))
    found = rt.Result.load(tmp_path)
    assert [o.part for o in found.objects] == [0, 0, 0] and found.world.parts == ()
    assert found.poses.part_count == 1 and found.of_part(0) is found
    assert "component" not in found.summary() and "scale: 1.0" in found.summary()


def test_component_files_of_an_earlier_run_are_deleted(parted: rt.Result, tmp_path: Path) -> None:
    dataclasses.replace(parted).save(tmp_path)
    names = ("poses_part1.txt", "objects_part1.ply")
    assert all((tmp_path / name).exists() for name in names)
    (tmp_path / "poses_part2.txt").write_text("of three parts")
    (tmp_path / "poses_partial.txt").write_text("mine")
    poses = two_parts().of_part(0)
    one = finished(unlinked(poses, tracks_in_two_parts(two_parts())[: 3 * BREAK]))
    one.save(tmp_path)
    left = {path.name for path in tmp_path.iterdir()} - {"cache"}
    assert left == {"tracks.txt", "objects.json", "poses.txt", "objects.ply", "poses_partial.txt"}


def test_run_writes_a_reconstruction_in_components(
    parted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the pose stage on: models, files, cache; a later unbroken run deletes them."""
    found, calls = two_parts(), list[int]()

    def estimate(video: Any, config: rt.PosesConfig, work_dir: Path, **_: Any) -> rt.Poses:
        calls.append(config.seed)
        poses = found if config.seed == 0 else dataclasses.replace(found, part=0 * found.part)
        for k in range(poses.part_count):
            names = [f"{f:03d}.jpg" for f in poses.of_part(k).frame]
            write_colmap(part_path(work_dir / "sparse", k), poses.of_part(k), names)
        return poses

    monkeypatch.setattr("reobj.poses.stage.estimate_poses", estimate)
    tracks = tracks_in_two_parts(found)
    ltwh = np.column_stack([tracks.xyxy[:, :2], tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]])
    rows = np.column_stack([tracks.frame + 1, 0 * tracks.frame - 1, ltwh, tracks.score,
                            np.full(len(tracks), CHAIR + 1)])  # fmt: skip
    np.savetxt(tmp_path / "det.txt", rows, delimiter=",", fmt="%.6g")
    args = ["run", str(parted_folder.parent / "frames"), "-o", str(tmp_path / "out"),
            "--detections", str(tmp_path / "det.txt"), "--set", "output.overlay=0"]  # fmt: skip
    names = ("poses_part1.txt", "objects_part1.ply", "sparse_part1")
    for _ in range(2):  # the second time from the cache
        assert rt.main(args) == 0
        result = rt.Result.load(tmp_path / "out")
        assert {o.part for o in result.objects if o.located} == {0, 1}
        assert all((tmp_path / "out" / name).exists() for name in names)
        for k, registered in enumerate((38, 23)):
            model = read_sparse_model(part_path(tmp_path / "out/sparse", k))
            assert len(model.names) == registered and len(model.points) == 3
    assert calls == [0]
    assert rt.main([*args, "--set", "poses.seed=1"]) == 0
    assert not any((tmp_path / "out" / name).exists() for name in names)
    assert (tmp_path / "out/sparse").is_dir() and calls == [0, 1]


def test_poses_command_writes_a_file_for_each_component(
    parted_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = (two_parts(), None)
    monkeypatch.setattr(rt, "reconstruct_cached", lambda *a, **k: given)
    frames = str(parted_folder.parent / "frames")
    assert rt.main(["poses", frames, "-o", str(tmp_path)]) == 0
    lengths = [len(np.loadtxt(tmp_path / name)) for name in ("poses.txt", "poses_part1.txt")]
    assert lengths == [38, 23]
    assert "the trajectory has 2 components" in capsys.readouterr().err


def test_the_summary_has_a_line_for_each_component(parted: rt.Result) -> None:
    lines = parted.summary().splitlines()
    cameras = "cameras: 61 of 64 frames (pycolmap) in 2 components"
    assert f"{cameras}, each with its own frame and scale" in lines
    first, second = (line for line in lines if re.match(r"component \d: ", line))
    objects = "3 objects with a shape; scale "
    assert first.startswith(f"component 0: frames 0-39; 38 of 40 frames; {objects}")
    assert second.startswith(f"component 1: frames 40-63; 23 of 24 frames; {objects}")
    groups = [k for k, line in enumerate(lines) if line in ("component 0", "component 1")]
    assert ["measured" in line for line in lines[groups[1] + 1 : groups[1] + 4]] == [True] * 3
    assert groups[1] - groups[0] == 4
    assert not [line for line in lines if line.startswith("scale")]
    mixed = dataclasses.replace(parted, objects=sorted(parted.objects, key=lambda o: o.id % 3))
    lines = mixed.summary().splitlines()
    assert [k for k, line in enumerate(lines) if line in ("component 0", "component 1")] == groups


def test_a_component_without_scale_is_not_reported_in_metres(parted: rt.Result) -> None:
    unscaled = [dataclasses.replace(o, size_m=None) if o.part else o for o in parted.objects]
    lines = dataclasses.replace(parted, objects=unscaled).summary().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("object "))
    assert "height, m  " in lines[start]
    rows = [line for line in lines[start + 1 : start + 9] if "component" not in line]
    assert ["units" in line for line in rows] == [False] * 3 + [True] * 3


# ---- Overlay and viewer ----


def test_the_overlay_draws_each_component_in_its_frames(parted: rt.Result, tmp_path: Path) -> None:
    class Facts:
        config, fps, size = rt.InputConfig(), 30.0, SIZE
        files: tuple[str, ...] = ()

    video: Any = Facts()
    overlay = Overlay(parted, tmp_path / "a.mp4", video)
    overlay.close(False)
    assert sorted(overlay.cameras) == [f for f in range(64) if f not in (38, 39, 40)]
    for frame in (0, 20, 37, 41, 63):
        component, pose = overlay.cameras[frame]
        assert component.ids == ([1, 2, 3] if frame < BREAK else [4, 5, 6])
        ends = component.solids.ends.reshape(3, -1, 3)
        pixels = component.poses.camera.project(ends @ pose[:, :3].T + pose[:, 3])
        boxes = np.concatenate([pixels.min(1), pixels.max(1)], 1)
        seen = parted.tracks.xyxy[parted.tracks.frame == frame]
        np.testing.assert_allclose(boxes, seen, atol=0.2 * (seen[:, 3] - seen[:, 1]).max())


def test_the_viewer_contains_every_component(parted_folder: Path) -> None:
    text = (parted_folder / "scene.html").read_text()
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert data["steps"]["part"] == [0] * 40 + [1] * 24
    assert [p["name"] for p in data["parts"]] == [
        "component 0: frames 0-39; 3 objects", "component 1: frames 40-63; 3 objects",
    ]  # fmt: skip
    assert [p["facts"].split(" · ")[0] for p in data["parts"]] == [
        "cameras of 38 of 40 frames", "cameras of 23 of 24 frames",
    ]  # fmt: skip
    poses = two_parts()
    for part, entry in enumerate(data["parts"]):
        points = np.frombuffer(base64.b64decode(entry["points"]), "<f4")
        np.testing.assert_allclose(points.reshape(-1, 3), poses.of_part(part).points, atol=1e-5)
        assert entry["scale"]["metres_per_unit"] == pytest.approx(1 / PARTS[part][0], rel=0.2)
    assert [o["part"] for o in data["objects"]] == [0, 0, 0, 1, 1, 1]
    assert all(len(o["crops"]) >= 3 for o in data["objects"])


def test_the_viewer_has_the_floor_of_every_component(parted: rt.Result, tmp_path: Path) -> None:
    floor = Floor(np.array([0, 0, 1.0]), -0.25, np.zeros(3), 0.01, 0.3, 200)
    first, second = (dataclasses.replace(p, floor=None) for p in parted.world.parts)
    parts = (first, dataclasses.replace(second, floor=floor))
    world = dataclasses.replace(parted.world, parts=parts, floor=None)
    result = dataclasses.replace(parted, world=world)
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames/0.jpg"), np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    video = rt.Video(tmp_path / "frames")
    write_scene(result, Pictures(result, video), tmp_path / "a.html", video)
    text = (tmp_path / "a.html").read_text()
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert "floor" not in data["parts"][0]
    assert data["parts"][1]["floor"] == {"normal": [0, 0, 1], "offset": -0.25}


# ---- Exports and scores ----


def exported(folder: Path, to: str, path: Path, caplog: pytest.LogCaptureFixture) -> str:
    caplog.clear()
    rt.export(folder, to, path)
    return caplog.text


def test_3d_exports_contain_the_largest_component(
    parted_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    text = exported(parted_folder, "glb", tmp_path / "a.glb", caplog)
    assert "contains component 0 of 2 (frames 0-39)" in text
    scene: Any = trimesh.load(tmp_path / "a.glb")
    assert set(scene.graph.nodes_geometry) == {"chair 1", "chair 2", "chair 3", "points", "cameras"}
    assert len(scene.geometry["points"].vertices) == 3
    pytest.importorskip("rerun", reason="pip install rerun-sdk (extra viewer)")
    assert "contains component 0 of 2" in exported(parted_folder, "rrd", tmp_path / "a.rrd", caplog)
    assert (tmp_path / "a.rrd").stat().st_size > 1000


def test_2d_exports_name_the_component(
    parted_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = exported(parted_folder, "coco-vid", tmp_path / "a.json", caplog)
    assert "frames 0-39: 1-3; frames 40-63: 4-6" in text
    rows = json.loads((tmp_path / "a.json").read_text())["annotations"]
    assert {(row["track_id"], row["part"]) for row in rows} == {
        (1, 0), (2, 0), (3, 0), (4, 1), (5, 1), (6, 1),
    }  # fmt: skip
    assert "frames 40-63: 4-6" in exported(parted_folder, "cvat", tmp_path / "a.xml", caplog)


def truth(tmp_path: Path, frames: int = 64) -> tuple[Path, Path]:
    """True solids 1 to 3, and true cameras of the first frames."""
    solids, eyes = chair_solids(), true_eyes()
    entries = [
        {"id": i + 1, "center": solids.center_in_world[i].tolist(),
         "size": (2 * solids.half_axes[i]).tolist(), "R": solids.world_from_obj[i].tolist()}
        for i in range(3)
    ]  # fmt: skip
    (tmp_path / "gt_objects.json").write_text(json.dumps({"objects": entries}))
    c2w = np.tile(np.eye(4), (frames, 1, 1))
    c2w[:, :3, 3] = eyes[:frames]
    np.savetxt(tmp_path / "poses_c2w.txt", c2w.reshape(-1, 16))
    return tmp_path / "gt_objects.json", tmp_path / "poses_c2w.txt"


def true_eyes() -> np.ndarray:
    return invert_rigid(walk(64, 200.0).cam_from_world)[:, :, 3]


def test_each_component_is_aligned_and_scored_separately(parted: rt.Result, tmp_path: Path) -> None:
    pairs: dict[int, int | None] = {1: 1, 2: 5, 3: 6}  # one of component 0, two of component 1
    found = score_objects(parted, *truth(tmp_path), pairs)
    assert (found["true"], found["found"]) == (3, 3)
    assert found["o3d_all"] > 0.9 and found["center_error_median"] < 0.02
    errors = found["part_scale_errors"]
    assert found["scale_error"] == errors[0] and len(errors) == 2 and max(errors) < 0.2
    scales = [part.scale.value * scale for part, (scale, *_) in zip(
        parted.world.parts, PARTS, strict=True)]  # fmt: skip
    np.testing.assert_allclose(errors, np.abs(np.array(scales) - 1), atol=5e-3)


def test_a_component_without_true_cameras_is_not_found(
    parted: rt.Result, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = score_objects(parted, *truth(tmp_path, BREAK), {1: 1, 2: 5, 3: 6})
    assert found["found"] == 1 and found["part_scale_errors"][1] is None
    assert "component 1 of the trajectory is not evaluated in 3D" in caplog.text
    with pytest.raises(rt.ReobjError, match="poses in common"):
        score_objects(parted, *truth(tmp_path, 2), {1: 1})


def test_eval_reports_both_components(parted_folder: Path, tmp_path: Path) -> None:
    tracks = tracks_in_two_parts(two_parts())
    ltwh = np.column_stack([tracks.xyxy[:, :2], tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]])
    rows = np.column_stack([tracks.frame + 1, tracks.track_id, ltwh, np.ones(len(tracks)),
                            np.full(len(tracks), CHAIR), np.ones(len(tracks))])  # fmt: skip
    np.savetxt(tmp_path / "gt.txt", rows, delimiter=",")
    scores = rt.evaluate(parted_folder, tmp_path / "gt.txt", *truth(tmp_path))
    assert scores["objects"]["found"] == 3 and scores["objects"]["o3d_all"] > 0.9
    assert "scale_error" in rt.score_report(scores)
    assert scores["tracks"]["all"]["ids_per_object"] == 2


def test_objects_that_are_seen_through_are_less_probable() -> None:
    """Every camera observes points behind the first chair, on rays through its middle."""
    plain = finished(unlinked(walk(), tracks_of(walk()))).objects
    poses, chair = walk(), np.array(plain[0].center)
    camera = -np.einsum("fji,fj->fi", poses.cam_from_world[:, :, :3], poses.cam_from_world[:, :, 3])
    points = camera + 1.5 * (chair - camera)  # (F, 3)
    own = np.repeat(np.arange(len(points))[:, None], 2, 1)
    colors = np.zeros(points.shape, np.uint8)
    poses = dataclasses.replace(poses, points=points, colors=colors, visibility=own)
    seen = finished(unlinked(poses, tracks_of(poses))).objects
    assert [o.id for o in seen] == [o.id for o in plain]
    change = [a.confidence - b.confidence for a, b in zip(plain, seen, strict=True)]
    assert change[0] > 0.005 and np.allclose(change[1:], 0)


def test_a_scale_of_depth_maps_is_one_statement_with_a_sigma() -> None:
    """In the summary and in every size, in each component; a known size replaces it."""
    metric = dataclasses.replace(walk(), metric=True, scale=(1.0, 0.03), source="pycolmap")
    result = finished(unlinked(metric, tracks_of(metric)))
    (line,) = (line for line in result.summary().splitlines() if line.startswith("scale"))
    assert line == "scale: 1.00 m per unit, sigma 3 % (from depth maps)"
    supplied = finished(unlinked(dataclasses.replace(metric, scale=None), tracks_of(metric)))
    for ours, theirs in zip(result.objects, supplied.objects, strict=True):
        more = np.square(ours.size_rel_sigma) - np.square(theirs.size_rel_sigma)
        np.testing.assert_allclose(more, 0.03**2, rtol=0.05)
    parts = finished(unlinked(dataclasses.replace(two_parts(), metric=True, scale=(1.0, 0.03))))
    assert [p.scale.source for p in parts.world.parts] == ["depth_maps"] * 2
    known = finished(unlinked(metric, tracks_of(metric)), known_size="chair=.8m")
    assert known.world.scale.source == "known_size"


def test_the_reason_of_a_low_confidence_names_its_cause() -> None:
    """The second chair has scores of .12; it is detected wherever it should be."""
    tracks = tracks_of(walk())
    tracks = with_columns(tracks, score=np.where(tracks.track_id == 2, 0.12, tracks.score))
    found = finished(unlinked(walk(), tracks)).objects
    assert [o.status for o in found] == ["ok", "doubtful", "ok"]
    assert "low scores (about 0.12)" in found[1].reason
    assert "detected in" not in found[1].reason and "background" not in found[1].reason
