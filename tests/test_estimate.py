"""The whole chain from a video to the pose of every frame, and its options."""

from __future__ import annotations

import dataclasses
import shutil
import struct

import cv2
import numpy as np
import pytest
from pose_worlds import FakeVideo, ate_percent, blank, textured_room

import reobj_track as rt
from reobj.poses.estimate import rows_around_breaks
from reobj.poses.sfm import Mapped

pycolmap = pytest.importorskip("pycolmap")


def config(**changes):
    return dataclasses.replace(rt.PosesConfig(), **changes)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    images, truth = textured_room(30, 0.12, -0.8, size=(320, 240))
    folder = tmp_path_factory.mktemp("walk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 12)
        patch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
        poses = rt.estimate_poses(FakeVideo(images), config(), folder)
    return FakeVideo(images), truth, folder, poses


def test_a_walk_gets_a_pose_for_every_frame(walk):
    video, truth, folder, poses = walk
    assert poses.known.all() and poses.source == "pycolmap" and not poses.metric
    assert set(poses.status) == {"keyframe", "pnp"} and not poses.messages
    assert poses.frame.tolist() == list(range(30))
    np.testing.assert_allclose(poses.time_s, np.arange(30) / 30)
    assert ate_percent(poses.cam_from_world, truth) < 1.0
    assert len(poses.points) > 300 and poses.colors.any() and len(poses.colors) == len(poses.points)
    assert (poses.camera.width, poses.camera.height) == video.size
    assert sorted(p.name for p in folder.iterdir()) == ["mapping.lock", "pycolmap.log", "sparse"]


def test_the_sparse_model_holds_the_keyframes(walk):
    video, _, folder, poses = walk
    back = rt.read_poses(folder / "sparse", video)
    keys = poses.status == "keyframe"
    np.testing.assert_array_equal(back.known, keys)
    np.testing.assert_allclose(back.cam_from_world[keys], poses.cam_from_world[keys], atol=1e-9)
    np.testing.assert_allclose(back.camera.params, poses.camera.params)


# ---- Options -------------------------------------------------------------------------------------


def seen_job(monkeypatch, video, folder, **changes):
    """Input of the reconstruction from `estimate_poses`."""
    seen = {}

    def record(images, ids, frames, names, boxes, size, **options):
        assert len(ids) == len(frames) == len(names) == len(images)
        seen.update(images=images, ids=ids, names=names, boxes=boxes, size=size, **options)
        return Mapped([], ["stopped here"])

    monkeypatch.setattr("reobj.poses.estimate.reconstruct", record)
    boxes = changes.pop("boxes", None)
    poses = rt.estimate_poses(video, config(**changes), folder, boxes_to_mask=boxes)
    assert poses.messages == ("stopped here",)
    return seen


def test_options_reach_the_reconstruction(walk, tmp_path, monkeypatch):
    video = walk[0]
    seen = seen_job(monkeypatch, video, tmp_path)
    assert seen["images"][0].shape == (240, 320, 3) and seen["size"] == (320, 240)
    assert (seen["camera"], seen["focal_guess"], seen["seed"]) == (None, 0.8, 0)
    assert len(seen["images"]) == 30  # of up to 40 pictures all are taken
    assert all(boxes.shape == (0, 4) for boxes in seen["boxes"])
    mask = lambda frame: np.full((2, 4), float(frame))  # noqa: E731
    monkeypatch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 8)
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 8)
    changed = seen_job(monkeypatch, video, tmp_path, size_px=160, seed=3,
                       camera="288,288,160,120", boxes=mask)  # fmt: skip
    assert changed["images"][0].shape == (120, 160, 3) and len(changed["images"]) <= 8
    assert changed["camera"].params[0] == 288 and changed["seed"] == 3
    numbers = [int(name.removesuffix(".jpg").split("_")[1]) for name in changed["names"]]
    assert [boxes[0, 0] for boxes in changed["boxes"]] == numbers
    assert changed["ids"] == [number + 1 for number in numbers]


@pytest.fixture
def reconstructed(walk, monkeypatch):
    """Replaces the reconstruction of the keyframes by that of `walk`."""

    def copy(*args, work_dir, **options):
        shutil.copytree(walk[2] / "sparse", work_dir / "sparse", dirs_exist_ok=True)
        (work_dir / "mapping").mkdir(exist_ok=True)
        return Mapped([work_dir / "sparse"], [])

    monkeypatch.setattr("reobj.poses.estimate.reconstruct", copy)
    monkeypatch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 12)  # those of the walk
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
    return walk


def test_the_seed_reaches_pnp(reconstructed, tmp_path, monkeypatch):
    seeds = []

    def note(model, key_rows, unmapped, video, seed, line):
        seeds.append(seed)
        count = len(video.frames)
        return np.full((count, 3, 4), np.nan), np.full(count, "none")

    monkeypatch.setattr("reobj.poses.estimate.locate_between", note)
    poses = rt.estimate_poses(reconstructed[0], config(seed=4), tmp_path)
    assert set(seeds) == {4} and not poses.known.any()


@pytest.mark.parametrize("max_gap, filled", [(2, True), (1, False)])
def test_gaps_are_filled_up_to_max_gap(reconstructed, tmp_path, monkeypatch, max_gap, filled):
    """Where the error is small enough; frames without a camera are named."""
    monkeypatch.setattr("reobj.poses.estimate.MAX_GAP", max_gap)
    monkeypatch.setattr("reobj.poses.localize.INLIER_PX", 1000.0)  # camera shake
    video, _, _, poses = reconstructed
    video = FakeVideo(video.images, [f"{k:03d}.jpg" for k in range(30)])
    cams, status = poses.cam_from_world.copy(), poses.status.copy()
    cams[11:13], status[11:13] = np.nan, "none"
    monkeypatch.setattr("reobj.poses.estimate._frame_name", lambda _, k: f"frame_{k:06d}.jpg")
    monkeypatch.setattr("reobj.poses.estimate.locate_between", lambda *a: (cams, status))
    found = rt.estimate_poses(video, config(), tmp_path)
    assert found.known.all() == filled and (found.status[11] == "interpolated") == filled
    assert ("2 interpolated" in found.cameras_text) == filled and found.measured.sum() == 28
    assert bool(found.messages) != filled
    if not filled:
        assert "2 of 30 frames have no camera: frames 11-12 (2: 011.jpg, 012" in found.messages[0]
        assert "show too few points" in found.messages[0] and "are next to" not in found.messages[0]


# ---- Failures ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "images, message",
    [
        (textured_room(1, 0)[0], "only 1 different view"),
        ([np.zeros((240, 320, 3), np.uint8)] * 45, "no image has texture"),  # black
        (textured_room(1, 0)[0] * 45, "only 2 different views"),  # still
    ],
)
def test_failures_are_reported_with_a_remedy(tmp_path, images, message):
    poses = rt.estimate_poses(FakeVideo(images), config(), tmp_path)
    assert not poses.known.any() and poses.source == "none" and set(poses.status) == {"none"}
    assert len(poses.frame) == len(images) and poses.cam_from_world.shape == (len(images), 3, 4)
    assert message in poses.messages[0] and "--poses" in poses.messages[0]
    assert poses.camera.K[0, 0] == pytest.approx(0.8 * images[0].shape[1])


def test_empty_video_and_live_camera_are_refused(tmp_path):
    with pytest.raises(rt.ReobjError, match="no readable frame"):
        rt.estimate_poses(FakeVideo([]), config(), tmp_path)
    video = blank(3)
    video.is_live = True
    with pytest.raises(rt.ReobjError, match="live"):
        rt.estimate_poses(video, config(), tmp_path)


# ---- Breaks --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parts, rows",
    [
        ([[0, 10, 20, 30, 40, 50]], []),  # nothing broke
        ([[0, 10, 20], [30, 40, 50]], [*range(11, 40)]),  # the step between, and one on each side
        ([[0, 10, 20, 40, 50]], [*range(11, 50)]),  # a keyframe in no component
        ([[10, 20, 30, 40, 50]], [*range(1, 20)]),  # the first
        ([[0, 10, 20, 30, 40]], [*range(31, 50)]),  # the last
    ],
)
def test_more_keyframes_around_breaks(parts, rows, monkeypatch):
    keys, parts = [0, 10, 20, 30, 40, 50], [np.array(part) for part in parts]
    monkeypatch.setattr("reobj.poses.estimate.MAX_EXTRA", 9)
    assert rows_around_breaks(keys, parts) == [row for row in rows if row % 10]
    monkeypatch.setattr("reobj.poses.estimate.MAX_EXTRA", 1)
    assert rows_around_breaks(keys, parts) == [row for row in rows if row % 10 == 5]


def test_no_keyframes_between_adjacent_rows():
    parts = [np.array([0, 1, 2]), np.array([3, 4])]
    assert rows_around_breaks([0, 1, 2, 3, 4], parts) == []
    assert rows_around_breaks([0, 1, 2, 5, 6], [np.array([0, 1, 2]), np.array([5, 6])]) == [3, 4]


def test_a_broken_reconstruction_is_repeated_with_more_keyframes(walk, tmp_path, monkeypatch):
    """Once, including the earlier keyframes; ids are frame numbers."""
    calls = []

    def broken(images, ids, names, *args, work_dir, **options):
        calls.append(list(ids))
        source = pycolmap.Reconstruction(str(walk[2] / "sparse"))
        models = []
        keys = sorted(source.reg_image_ids())
        for number, own in enumerate((keys[:6], keys[6:])):
            made = pycolmap.Reconstruction(source)
            for image_id in set(keys) - set(own):
                made.deregister_frame(made.image(image_id).frame_id)
            models.append(work_dir / (f"sparse_part{number}" if number else "sparse"))
            shutil.rmtree(models[-1], ignore_errors=True)
            models[-1].mkdir()
            made.write(str(models[-1]))
        return Mapped(models, [])

    monkeypatch.setattr("reobj.poses.estimate.reconstruct", broken)
    monkeypatch.setattr("reobj.poses.estimate.MAX_KEYFRAMES", 12)
    monkeypatch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)
    poses = rt.estimate_poses(walk[0], config(), tmp_path)
    assert len(calls) == 2 and set(calls[0]) < set(calls[1])
    keys = [row + 1 for row in np.flatnonzero(walk[3].status == "keyframe")]
    assert calls[0] == keys and calls[1] == sorted(calls[1])
    assert poses.part_count == 2 and poses.known[walk[3].status == "keyframe"].all()
    assert (np.diff(poses.part) >= 0).all() or set(poses.part) == {0, 1}
    assert poses.visibility[:, 1].max() < len(poses.points)
    seen = poses.part[poses.visibility[:, 0]]  # (M,) rows of points of component 0 come first
    assert poses.visibility[seen == 0, 1].max() < poses.visibility[seen == 1, 1].min()
    assert "broke between frames 22 and 23" in poses.messages[0]


# ---- EXIF ----------------------------------------------------------------------------------------


def photo_with_exif(path, image, focal_35mm):
    """Write a JPEG whose EXIF says FocalLengthIn35mmFilm."""
    number = struct.pack("<H", 1)
    tiff = b"II*\0\x08\0\0\0" + number + struct.pack("<HHII", 0x8769, 4, 1, 26) + bytes(4)
    tiff += number + struct.pack("<HHIHH", 0xA405, 3, 1, focal_35mm, 0) + bytes(4)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    head = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(head) + 2) + head + data[2:])


@pytest.mark.parametrize("focal_35mm", [48, 0])
def test_the_exif_focal_length_replaces_the_default_guess(tmp_path, monkeypatch, focal_35mm):
    """COLMAP: 48 mm of a film whose diagonal is 43.27 mm."""
    images = textured_room(3, 0.5)[0]
    (tmp_path / "photos").mkdir()
    for i, image in enumerate(images):
        photo_with_exif(tmp_path / "photos" / f"{i}.jpg", image, focal_35mm)
    video = rt.Video(tmp_path / "photos")
    guess = seen_job(monkeypatch, video, tmp_path / "work")["focal_guess"]
    exif = 48 / np.hypot(36, 24) * np.hypot(480, 360) / 480
    assert guess == (pytest.approx(exif, rel=1e-3) if focal_35mm else 0.8)
