"""The whole chain from a video to the pose of every frame, and its options."""

from __future__ import annotations

import dataclasses
import struct

import cv2
import numpy as np
import pytest
from pose_worlds import FakeVideo, ate_percent, blank, textured_room

import reobj_track as rt
from reobj.poses import estimate
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
        patch.setattr("reobj.poses.estimate.MIN_KEYFRAMES", 12)  # a short video for the others
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
    assert sorted(p.name for p in folder.iterdir()) == ["pycolmap.log", "sparse"]
    back = rt.read_poses(folder / "sparse", video)
    keys = poses.status == "keyframe"
    np.testing.assert_array_equal(back.known, keys)
    np.testing.assert_allclose(back.cam_from_world[keys], poses.cam_from_world[keys], atol=1e-9)


def seen_job(monkeypatch, video, folder, **changes):
    """The job of the reconstruction that `estimate_poses` asks for."""
    jobs = []

    def record(job, *_):
        jobs.append((job, {number: job.images[number] for number in job.frame_of}))
        return Mapped([], ["stopped here"])

    monkeypatch.setattr(estimate, "reconstruct", record)
    boxes = changes.pop("boxes", None)
    poses = rt.estimate_poses(video, config(**changes), folder, boxes_to_mask=boxes)
    assert poses.messages == ("stopped here",)
    return jobs[0]


def test_options_reach_the_reconstruction(walk, tmp_path, monkeypatch):
    job, images = seen_job(monkeypatch, walk[0], tmp_path)
    assert images[1].shape == (240, 320, 3) and job.size == (320, 240)
    assert (job.camera, job.focal_guess, job.seed) == (None, 0.8, 0)
    assert list(job.frame_of.values()) == list(range(30))  # of up to 40 pictures all are taken
    mask = lambda frame: np.full((2, 4), float(frame))  # noqa: E731
    job, images = seen_job(monkeypatch, walk[0], tmp_path, size_px=160, seed=3,
                           camera="288,288,160,120", boxes=mask)  # fmt: skip
    assert images[1].shape == (120, 160, 3) and job.camera.params[0] == 288 and job.seed == 3
    assert all(job.boxes_of[i][0, 0] == frame for i, frame in job.frame_of.items())
    np.testing.assert_array_equal([*images], [frame + 1 for frame in job.frame_of.values()])


# ---- Failures ------------------------------------------------------------------------------------


def test_a_smaller_step_is_advised_first(tmp_path):
    """Of every sixth frame some do not connect: two rooms."""
    video = FakeVideo(textured_room(5, 3.0)[0] + textured_room(4, 3.0, seed=5)[0])
    video.config = rt.InputConfig(every=6)
    first, *others = rt.estimate_poses(video, config(), tmp_path).messages
    assert "--every 6" in first and "--every 3" in first and others
    assert not any("--every" in text for text in others)


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
    "components, steps",
    [
        ([[0, 30, 60, 90, 120, 150]], []),  # nothing broke
        ([[0, 30, 60], [90, 120, 150]], [1, 2, 3]),  # between, and one on each side
        ([[0, 30, 60, 120, 150]], [1, 2, 3, 4]),  # a keyframe in no component
        ([[30, 60, 90, 120, 150]], [0, 1]),  # the first
        ([[0, 30, 60, 90, 120]], [3, 4]),  # the last
    ],
)
def test_more_keyframes_around_breaks(components, steps):
    """At most eight in each step, evenly spread."""
    found = rows_around_breaks(
        [0, 30, 60, 90, 120, 150], [np.array(component) for component in components]
    )
    assert found == [30 * k + row for k in steps for row in (3, 7, 10, 13, 17, 20, 23, 27)]


def test_no_keyframes_between_adjacent_rows():
    components = [np.array([0, 1, 2]), np.array([5, 6])]
    assert rows_around_breaks([0, 1, 2, 5, 6], components) == [3, 4]


def test_a_broken_reconstruction_is_repeated_with_more_keyframes(walk, tmp_path, monkeypatch):
    """Once, including the earlier keyframes; the model of the keyframes is cut into two."""
    calls = []

    def broken(job, child, progress):
        calls.append([*job.frame_of])
        source = pycolmap.Reconstruction(str(walk[2] / "sparse"))
        models = []
        keys = sorted(source.reg_image_ids())
        for number, own in enumerate((keys[:6], keys[6:])):
            made = pycolmap.Reconstruction(source)
            for image_id in set(keys) - set(own):
                made.deregister_frame(made.image(image_id).frame_id)
            models.append(tmp_path / (f"sparse_part{number}" if number else "sparse"))
            models[-1].mkdir(exist_ok=True)
            made.write(str(models[-1]))
        return Mapped(models, [])

    monkeypatch.setattr(estimate, "reconstruct", broken)
    monkeypatch.setattr(estimate, "MIN_KEYFRAMES", 12)
    poses = rt.estimate_poses(walk[0], config(), tmp_path)
    assert len(calls) == 2 and set(calls[0]) < set(calls[1]) and calls[1] == sorted(calls[1])
    keyframes = walk[3].status == "keyframe"
    assert poses.part_count == 2 and poses.known[keyframes].all()
    seen = poses.part[poses.visibility[:, 0]]  # (M,) rows of points of component 0 come first
    assert poses.visibility[seen == 0, 1].max() < poses.visibility[seen == 1, 1].min()
    assert "broke between frames" in poses.messages[0]


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
    (tmp_path / "photos").mkdir()
    for i, image in enumerate(textured_room(3, 0.5)[0]):
        photo_with_exif(tmp_path / "photos" / f"{i}.jpg", image, focal_35mm)
    video = rt.Video(tmp_path / "photos")
    guess = seen_job(monkeypatch, video, tmp_path / "work")[0].focal_guess
    exif = 48 / np.hypot(36, 24) * np.hypot(480, 360) / 480
    assert guess == (pytest.approx(exif, rel=1e-3) if focal_35mm else 0.8)
