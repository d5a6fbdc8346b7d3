"""Frames between keyframes: PnP, tracked points, jumps, gaps, on exactly rendered scenes."""

from __future__ import annotations

import numpy as np
import pytest
from pose_worlds import DotWorld, FakeVideo, sideways, some_cameras, turn_deg
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import SparseModel, invert_rigid
from reobj.files import Progress
from reobj.poses.keyframes import ResizedVideo
from reobj.poses.localize import Located, absolute_pose, fill_gaps, locate_between

pytest.importorskip("pycolmap")


def centres(cams):
    return invert_rigid(cams)[..., 3]


# ---- PnP -----------------------------------------------------------------------------------------

OPENCV = rt.Camera("OPENCV", 640, 480, (500.0, 490.0, 322.0, 238.0, -0.1, 0.02, 0.001, -0.001))


def seen_points(count, wrong=0, noise_px=0.3, seed=0, camera=OPENCV):
    """A pose, points, and their pixels by pycolmap's camera; the first `wrong` are outliers."""
    rng, pose = np.random.default_rng(seed), some_cameras()[4]
    in_cam = np.column_stack([rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(2, 6, count)])
    points = (in_cam - pose[:, 3]) @ pose[:, :3]
    xy = np.array(camera.to_pycolmap().img_from_cam(in_cam)).reshape(-1, 2)
    xy += rng.normal(0, noise_px, xy.shape)
    xy[:wrong] = rng.uniform([0, 0], [640, 480], (wrong, 2))
    return pose, points, xy


def test_a_pose_is_found_among_outliers():
    pose, points, xy = seen_points(80, wrong=30)
    found = absolute_pose(xy, points, OPENCV, 640, 0)
    assert turn_deg(found[None], pose[None]) < 0.1
    assert np.linalg.norm(centres(found) - centres(pose)) < 0.01


@pytest.mark.parametrize(
    "count, wrong, found",
    [(15, 0, True), (14, 0, False), (60, 25, True), (60, 40, False)],  # 15 inliers, half of all
)
def test_a_pose_needs_inliers(count, wrong, found):
    _, points, xy = seen_points(count, wrong, noise_px=0.1)
    assert (absolute_pose(xy, points, OPENCV, 640, 0) is not None) == found


def test_the_error_is_counted_in_pixels_of_the_resized_image():
    """6 px of noise at 640: too much at full size, 1.5 px of an image a quarter as wide."""
    _, points, xy = seen_points(200, noise_px=6)
    assert absolute_pose(xy, points, OPENCV, 640, 0) is None
    assert absolute_pose(xy, points, OPENCV, 160, 0) is not None


# ---- Frames between keyframes of a given model ---------------------------------------------------

WORLD = DotWorld()


def true_model(cams, key_rows, native=1):
    """A perfect reconstruction of the keyframes, with pixels `native` times as fine."""
    obs = []
    for image, row in enumerate(key_rows):
        xy, seen = WORLD.project(cams[row])
        obs += [(image, point, *(native * xy[point])) for point in np.flatnonzero(seen)]
    table, count = np.array(obs), len(WORLD.points)
    camera = WORLD.camera.resized((native * 480, native * 360))
    point = table[:, 1].astype(np.int64)
    return SparseModel(
        tuple(map(str, key_rows)),
        [camera] * len(key_rows),
        cams[key_rows],
        WORLD.points,
        np.zeros((count, 3), np.uint8),
        np.bincount(point, minlength=count),
        table[:, 0].astype(np.int64),
        point,
        table[:, 2:],
    )


def locate(cams, key_rows, images=None, native=1, seed=0, left_out=()):
    images = [WORLD.image(c) for c in cams] if images is None else images
    resized = ResizedVideo(FakeVideo(images), 480)
    list(resized.first_pass(Progress("test")))
    model = true_model(cams, key_rows, native)
    rows, others = np.array(key_rows), np.array(left_out, int)
    found = locate_between(model, rows, others, resized, seed, Progress("test"))
    return found.cam_from_world, found.status


@pytest.mark.parametrize("native", [1, 2])
def test_frames_between_before_and_after_keyframes_are_located(native):
    """An offset of half a pixel would rotate the cameras by .07 deg: pixel centres are right."""
    cams = sideways(14)
    found, status = locate(cams, [2, 7, 11], native=native)
    expected = ["keyframe" if i in (2, 7, 11) else "pnp" for i in range(14)]
    assert status.tolist() == expected
    assert np.median(turn_deg(found, cams)) < 0.02 and turn_deg(found, cams).max() < 0.04
    assert np.linalg.norm(centres(found) - centres(cams), axis=1).max() < 0.004


def test_frames_are_not_located_beyond_an_unregistered_keyframe():
    """Frames 4 and 8 were keyframes, and the model does not hold them."""
    _, status = locate(sideways(12), [1, 10], left_out=[4, 8])
    near = ["pnp", "keyframe", "pnp", "pnp", *["none"] * 5, "pnp", "keyframe", "pnp"]
    assert status.tolist() == near
    _, status = locate(sideways(6), [2], left_out=[0, 4])
    assert status.tolist() == ["none", "pnp", "keyframe", "pnp", "none", "none"]


def test_frames_without_the_points_are_lost():
    cams = sideways(9)
    images = [WORLD.image(c) for c in cams]
    images[3:6] = [np.full_like(images[0], 128)] * 3
    _, status = locate(cams, [0, 8], images)
    assert status.tolist() == ["keyframe", "pnp", "pnp", *["none"] * 3, "pnp", "pnp", "keyframe"]


@pytest.mark.parametrize("aside, status", [(0.0, "pnp"), (0.03, "pnp"), (0.3, "none")])
def test_a_frame_far_from_both_neighbours_is_refused(aside, status):
    """Steps are 2 cm: an offset of 3 cm is camera shake, one of 30 cm a jump."""
    cams = sideways(11)
    moved = cams.copy()
    moved[5, :, 3] -= cams[5, :, :3] @ [0, aside, 0]
    found, seen = locate(cams, [0, 10], [WORLD.image(c) for c in moved])
    assert seen.tolist() == ["keyframe", *["pnp"] * 4, status, *["pnp"] * 4, "keyframe"]
    assert np.isnan(found[5]).all() == (status == "none")
    if status == "pnp":
        np.testing.assert_allclose(centres(found[5]), centres(moved[5]), atol=0.004)


def test_a_reversal_of_the_camera_is_no_jump():
    """The neighbours of the farthest frame progress a position; it is a usual step away."""
    cams = sideways(6, step=0.04)
    there_and_back = cams[[0, 1, 2, 3, 2, 1, 0]]
    _, status = locate(there_and_back, [0, 6])
    assert status.tolist() == ["keyframe", *["pnp"] * 5, "keyframe"]


# ---- Gaps ----------------------------------------------------------------------------------------


def filled(cams, lost, left_out=(), frame=None, time_s=None):
    """Poses and status after `fill_gaps`, by a model of every fifth frame."""
    frame = np.arange(len(cams)) if frame is None else frame
    keys = np.setdiff1d(np.arange(0, len(cams), 5), lost)
    known, status = cams.copy(), np.full(len(cams), "pnp", "<U12")
    known[lost], status[lost] = np.nan, "none"
    time_s = frame / 30 if time_s is None else time_s
    located = Located(true_model(cams, keys), keys, known, status)
    return fill_gaps(located, frame, time_s, 1.0, left_out)


def test_gaps_of_an_even_motion_are_filled_and_never_beyond():
    cams = sideways(40)
    lost = [0, 1, 15, 16, 17]
    poses, status = filled(cams, lost)
    np.testing.assert_allclose(poses[2:], cams[2:], atol=1e-3)
    assert np.isnan(poses[:2]).all() and np.isin(status[:2], "none").all()
    assert (status[15:18] == "interpolated").all() and (status[18:] == "pnp").all()
    for refused in (
        filled(cams, lost, left_out=[16]),
        filled(cams, lost, frame=10 * np.arange(40)),  # every 10th frame: 39 are missing
    ):
        assert np.isnan(refused[0][15:18]).all() and np.isin(refused[1][15:18], "none").all()


@pytest.mark.parametrize("count, status", [(15, "interpolated"), (16, "none")])
def test_up_to_fifteen_frames_are_filled(count, status):
    """Lost frames, and frames that were not read and a lost one."""
    lost = np.arange(20, 20 + count)
    assert (filled(sideways(60), lost)[1][lost] == status).all()
    frame = np.arange(60) + (count - 1) * (np.arange(60) > 30)
    assert filled(sideways(60), [30], frame=frame, time_s=np.arange(60) / 30)[1][30] == status


def test_a_gap_is_filled_by_time():
    """At an uneven rate: the lost frame comes just after the one before it."""
    moment = 10 * np.arange(40)
    moment[15] = 141
    cams = sideways(400, step=0.002)[moment]
    poses, _ = filled(cams, [15], time_s=moment / 300)
    np.testing.assert_allclose(centres(poses[15]), centres(cams[15]), atol=1e-3)


def turned(cams, row, degrees):
    """The camera turns by so much in the frames from `row` to `row` + 5, and goes on as before."""
    progress = np.clip((np.arange(len(cams)) - row) / 5, 0, 1)[:, None]
    turn = Rotation.from_rotvec(np.radians(degrees) * progress * [0, 1, 0]).as_matrix()
    rotation = turn @ cams[:, :, :3]
    return np.concatenate([rotation, -rotation @ centres(cams)[:, :, None]], 2)


def test_a_turn_in_the_gap_is_not_filled():
    """Even motion on both sides, different from that in the gap: a blurred corner."""
    gap = [16, 17, 18, 19]
    assert (filled(turned(sideways(40), 15, 0.3), gap)[1][gap] == "interpolated").all()
    assert (filled(turned(sideways(40), 15, 20.0), gap)[1][gap] == "none").all()


def test_gaps_of_a_shaking_camera_or_between_photos_are_not_filled():
    """Before or after the gap, interpolation would differ from the known poses."""
    rng = np.random.default_rng(0)
    for first, last in ((0, 14), (20, 40)):
        shaken = sideways(40)
        for row in range(first, last):
            shake = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()
            centre = centres(shaken[row])
            shaken[row, :, :3] = shake @ shaken[row, :, :3]
            shaken[row, :, 3] = -shaken[row, :, :3] @ centre
        assert (filled(shaken, [16, 17])[1][[16, 17]] == "none").all()
    photos = sideways(40)
    photos[:, :, 3] -= np.einsum("nij,nj->ni", photos[:, :, :3], rng.uniform(-0.3, 0.3, (40, 3)))
    assert filled(photos, [16])[1][16] == "none"


@pytest.mark.parametrize("row, status", [(2, "none"), (3, "interpolated"), (37, "none")])
def test_a_gap_with_few_neighbouring_frames_is_not_filled(row, status):
    assert filled(sideways(40), [row])[1][row] == status
