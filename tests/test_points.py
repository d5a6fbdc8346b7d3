"""Points triangulated with known poses: positions, observing frames, and refusals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from pose_worlds import FakeVideo, motion, supplied, textured_room

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.files import Progress
from reobj.poses.features import choose_posed_pairs
from reobj.poses.keyframes import choose_posed_keyframes, path_steps, sharpest_images
from reobj.poses.sfm import triangulate

pytest.importorskip("pycolmap")
SIZE = (320, 240)
CAMERA = rt.Camera("PINHOLE", *SIZE, (288.0, 288.0, 160.0, 120.0))


def run(video, poses, folder, **options):
    return triangulate(poses, video, size_px=320, seed=0, work_dir=folder, **options)


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """Ten views of a wall at z = 6 and a floor at y = 1.2; frame 4 has no pose."""
    images, cams = textured_room(10, 0.45, -3, size=SIZE)
    cams[4] = np.nan
    given = dataclasses.replace(supplied(cams, CAMERA), frame=np.arange(10) * 2)
    video = FakeVideo(images)
    numbered = [rt.Frame(2 * f.index, f.time_s, f.image) for f in video]
    folder = tmp_path_factory.mktemp("points")
    return images, given, numbered, folder, run(numbered, given, folder)


def test_points_lie_on_the_walls_of_the_supplied_poses(corner):
    _, given, _, folder, poses = corner
    _, y, z = poses.points.T
    off = np.minimum(np.abs(z - 6), np.abs(y - 1.2))
    assert len(off) > 200 and np.median(off) < 0.02 and np.percentile(off, 95) < 0.1
    assert (np.abs(z - 6) < 0.1).sum() > 50 and (np.abs(y - 1.2) < 0.1).sum() > 30
    np.testing.assert_array_equal(poses.cam_from_world, given.cam_from_world)
    assert poses.messages == () and {p.suffix for p in folder.iterdir()} == {".log"}


def test_points_come_with_the_frames_that_observed_them_and_their_colour(corner):
    images, given, _, _, poses = corner
    row, point = poses.visibility.T
    assert set(row.tolist()) == set(range(10)) - {4}
    assert np.bincount(point, minlength=len(poses.points)).min() >= 2
    in_cam = np.einsum("mij,mj->mi", given.cam_from_world[row, :, :3], poses.points[point])
    xy = (in_cam + given.cam_from_world[row, :, 3]) @ CAMERA.K.T
    xy = xy[:, :2] / xy[:, 2:]
    assert (xy > -2).all() and (xy < np.array(SIZE) + 2).all()
    x, y = xy.round().astype(int).clip(0, np.array(SIZE) - 1).T
    seen = np.array(images)[row, y, x, ::-1].astype(float)
    own, other = poses.colors[point].astype(float), np.roll(poses.colors, 7, 0)[point]
    assert np.abs(seen - own).mean() < 0.6 * np.abs(seen - other).mean()


def test_the_scale_is_that_of_the_poses(corner, tmp_path):
    _, given, video, _, poses = corner
    cams = given.cam_from_world.copy()
    cams[:, :, 3] *= 50
    larger = run(video, dataclasses.replace(given, cam_from_world=cams), tmp_path)
    assert len(larger.points) == pytest.approx(len(poses.points), rel=0.1)
    assert np.median(larger.points[:, 2]) == pytest.approx(50 * np.median(poses.points[:, 2]), 0.05)


@pytest.mark.parametrize("mistake", ["inverted", "of other frames"])
def test_poses_that_do_not_fit_the_images_are_reported(corner, tmp_path, mistake):
    _, given, video, _, _ = corner
    wrong = invert_rigid(given.cam_from_world)
    if mistake == "of other frames":
        wrong = given.cam_from_world[[7, 2, 9, 0, 4, 6, 1, 8, 3, 5]]
    turned = dataclasses.replace(given, cam_from_world=wrong)
    poses = run(video, turned, tmp_path)
    assert len(poses.points) == 0 and len(poses.messages) == 1
    assert "matched features of 9 images triangulate" in poses.messages[0]
    np.testing.assert_array_equal(poses.cam_from_world, turned.cam_from_world)


def test_a_wrong_interval_of_poses_is_reported(corner, tmp_path):
    """Frames 12 and 14 are 40 m too low; all others are right."""
    _, given, video, _, _ = corner
    cams = given.cam_from_world.copy()
    cams[6:8, 1, 3] += 40
    poses = run(video, dataclasses.replace(given, cam_from_world=cams), tmp_path)
    (message,) = poses.messages
    assert message.startswith(
        "the supplied poses are inconsistent between frames 10 and 12, 14 and 16: "
    )
    assert len(poses.points) > 100


@pytest.mark.parametrize("images", [0, 1, 3])
def test_nothing_to_triangulate_gives_a_message(images, tmp_path):
    """No images at all, one alone, and three without texture."""
    video = FakeVideo([np.zeros((240, 320, 3), np.uint8)] * images)
    given = supplied(motion("orbit", max(images, 2)), CAMERA)
    poses = run(video, given, tmp_path)
    assert len(poses.points) == 0 and len(poses.messages) == 1
    assert poses.messages[0].startswith("no sparse points: ")
    unknown = dataclasses.replace(given, cam_from_world=np.full_like(given.cam_from_world, np.nan))
    assert "0 images have a pose" in run(video, unknown, tmp_path).messages[0]


# ---- Keyframes and pairs -------------------------------------------------------------------------


@pytest.mark.parametrize("kind, count", [("orbit", 600), ("pan", 600), ("forward", 3000)])
def test_keyframes_are_evenly_spread_whatever_the_unit(kind, count):
    cams = motion(kind, count)
    rows = choose_posed_keyframes(path_steps(supplied(cams)))
    assert 40 <= len(rows) <= 150 and rows[0] == 0 and (np.diff(rows) > 0).all()
    assert np.diff(rows).max() < 0.15 * count
    cams[:, :, 3] *= 1e-3
    np.testing.assert_array_equal(choose_posed_keyframes(path_steps(supplied(cams))), rows)


def test_few_frames_are_all_keyframes_and_those_without_a_pose_none():
    cams = motion("orbit", 13)
    cams[5] = np.nan
    rows = choose_posed_keyframes(path_steps(supplied(cams)))
    assert rows.tolist() == [i for i in range(13) if i != 5]
    assert choose_posed_keyframes(np.full((4, 6), np.nan)).tolist() == []


def test_pairs_are_neighbours_and_loop_closures():
    cams = np.concatenate([motion("walk", 20), motion("walk", 20)[::-1]])
    pairs = set(map(tuple, choose_posed_pairs(path_steps(supplied(cams))).tolist()))
    assert all(a < b for a, b in pairs)
    assert {(i, i + 1) for i in range(39)} <= pairs
    assert {(i, 39 - i) for i in range(15)} <= pairs  # the way back
    assert len(pairs) < 40 * 7


def test_opposite_views_are_no_pair():
    """Back to back at one position."""
    turned = motion("orbit", 12)
    turned[6:, [0, 2]] *= -1
    pairs = choose_posed_pairs(path_steps(supplied(turned)))
    far = pairs[(pairs[:, 1] - pairs[:, 0] > 4)]
    assert ((far[:, 0] < 6) == (far[:, 1] < 6)).all()


def test_the_sharpest_image_near_a_keyframe_replaces_it():
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    images = [np.full_like(noise, 99)] * 40
    images[11] = images[20] = images[33] = noise
    given = supplied(motion("walk", 40), CAMERA)
    given.cam_from_world[20] = np.nan  # sharp, but without a pose
    keys = np.array([10, 20 + 2, 34])
    found = sharpest_images(given, FakeVideo(images), keys, 160, Progress("k"))
    assert sorted(found)[0] == 11 and 33 in found and 20 not in found
    assert all(image.shape == (120, 160, 3) for image in found.values())
