"""Supplied poses against boxes and matched features: what is named, and no false alarm."""

from __future__ import annotations

import numpy as np
import pytest
from pose_worlds import FOCAL, PINHOLE, SIZE, motion, supplied
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.poses.supplied.check import Supplied, check_boxes, check_matches, without_frozen

GL3 = np.diag([1.0, -1, -1])
UNITY = np.diag([1.0, -1, 1])


def projected(cams, points):
    """Pixels (F, N, 2) of points (N, 3), and whether they are in view."""
    in_cam = np.einsum("fij,nj->fni", cams[:, :, :3], points) + cams[:, None, :, 3]
    xy = in_cam[..., :2] / in_cam[..., 2:] * FOCAL + np.array(SIZE) / 2
    return xy, (in_cam[..., 2] > 0.3) & (xy > 0).all(2) & (xy < SIZE).all(2)


def box_tracks(cams, noise_px, seed, objects=12):
    """Boxes of 120 px around points in view, noisy, as tracks."""
    rng = np.random.default_rng(seed)
    xy, seen = projected(cams, rng.uniform([-3, -3, 0], [3, 3, 1.2], (objects, 3)))
    bias = rng.normal(0, noise_px, (objects, 2))  # boxes are not centred on a point
    xy = xy + rng.normal(0, noise_px, xy.shape)
    xy = xy + bias * np.linspace(-1, 1, len(cams))[:, None, None]
    frame, obj = np.nonzero(seen)
    boxes = np.concatenate([xy - 60, xy + 60], 2)[frame, obj]
    return rt.Tracks(frame, obj, obj, boxes, np.ones(len(obj)), obj, obj)


def matches(cams, noise_px, seed=0):
    """Matches of 200 points in all pairs of frames 1, 2, 4 and 8 apart: rows and rays."""
    rng = np.random.default_rng(seed)
    xy, seen = projected(cams, rng.uniform([-3, -3, 0], [3, 3, 1.2], (200, 3)))
    rays = (xy + rng.normal(0, noise_px, xy.shape) - np.array(SIZE) / 2) / FOCAL
    rows, found = [], []
    for step in (1, 2, 4, 8):
        for i in range(0, len(cams) - step, 4):
            both = seen[i] & seen[i + step]
            rows += [(i, i + step)] * both.sum()
            found.append(np.stack([rays[i][both], rays[i + step][both]], 1))
    return np.arange(len(cams)), np.array(rows), np.concatenate(found)


def rolled(cams, count):
    """Read the quaternions in another order."""
    given = invert_rigid(cams)
    xyzw = Rotation.from_matrix(given[:, :, :3]).as_quat()
    given[:, :, :3] = Rotation.from_quat(np.roll(xyzw, count, 1)).as_matrix()
    return invert_rigid(given)


MISTAKES = {
    "the inverse direction": invert_rigid,
    "y up, z backward (OpenGL)": lambda c: GL3 @ c,
    "OpenGL": lambda c: invert_rigid(GL3 @ c),
    "left-handed camera axes x right, y up, z forward (Unity)": lambda c: (
        UNITY @ c * np.array([-1, -1, -1, 1])
    ),
    "left-handed camera axes x left, y down, z forward": lambda c: (
        np.diag([-1.0, 1, 1]) @ c * np.array([-1, -1, -1, 1])
    ),
    "turned by 180 deg": lambda c: np.diag([-1.0, -1, 1]) @ c,
    "x forward, y left, z up (ROS)": lambda c: np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ c,
    "w first given as w last": lambda c: rolled(c, 1),
    "w last given as w first": lambda c: rolled(c, -1),
}


@pytest.mark.parametrize("noise_px", [1, 8, 20])
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan", "forward", "still"])
def test_right_poses_raise_no_alarm(kind, noise_px):
    cams = motion(kind)
    for seed in range(3):
        check_boxes(Supplied(supplied(cams)), box_tracks(cams, noise_px, seed))
    assert check_matches(Supplied(supplied(cams)), False, *matches(cams, noise_px / 20)) > 0.9


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan"])
def test_wrong_poses_are_named(kind, mistake):
    """By boxes alone, and by images alone."""
    cams = motion(kind)
    given = Supplied(supplied(MISTAKES[mistake](cams)))
    with pytest.raises(rt.ReobjError) as refused:
        check_matches(given, False, *matches(cams, 0.5))
    assert mistake in str(refused.value)
    with pytest.raises(rt.ReobjError) as refused:
        check_boxes(given, box_tracks(cams, 4, 0))
    assert mistake in str(refused.value)


def test_the_axes_of_the_file_are_named_not_those_of_the_reading():
    """OpenCV's axes in a format that has OpenGL's: the reader flipped them."""
    cams = motion("orbit")
    given = Supplied(supplied(GL3 @ cams), GL3)
    with pytest.raises(rt.ReobjError, match=r"z forward \(OpenCV\); they were read .*OpenGL"):
        check_matches(given, False, *matches(cams, 0.5))


@pytest.mark.parametrize("kind", ["orbit", "pan"])
def test_poses_of_other_frames_fit_in_no_convention(kind):
    cams = motion(kind)
    shuffled = np.random.default_rng(0).permutation(cams)
    with pytest.raises(rt.ReobjError, match="fit in no convention"):
        check_matches(Supplied(supplied(shuffled)), False, *matches(cams, 0.5))


@pytest.mark.parametrize("kind", ["orbit", "walk", "forward"])
@pytest.mark.parametrize("step", [2, 3])
def test_another_number_of_poses_than_one_a_frame_is_named(kind, step):
    """By boxes alone: every k-th pose as one for each frame, and poses at k times the rate."""
    cams = motion(kind, 60)
    seen = box_tracks(cams, 1, 0)
    sparse = np.concatenate([cams[::step], np.full((60 - len(cams[::step]), 3, 4), np.nan)])
    with pytest.raises(rt.ReobjError, match=f"one pose for {step} frames"):
        check_boxes(Supplied(supplied(sparse)), seen)
    first = box_tracks(cams[::step], 1, 0)
    with pytest.raises(rt.ReobjError, match=f"{step} poses for each frame"):
        check_boxes(Supplied(supplied(cams)), first)


def test_another_order_of_the_images_is_named():
    cams = motion("orbit")
    order = np.argsort([str(k) for k in range(len(cams))])
    with pytest.raises(rt.ReobjError, match="the order of numbers from 0 as text"):
        check_matches(Supplied(supplied(cams[order])), False, *matches(cams, 0.5))


def test_matches_that_fit_nothing_do_not_contradict_boxes_that_agree():
    """Pictures that do not show the objects: a rolling test image."""
    cams = motion("orbit")
    given = Supplied(supplied(cams))
    confirmed = check_boxes(given, box_tracks(cams, 1, 0))
    rows, match_rows, rays = matches(np.random.default_rng(0).permutation(cams), 0.5)
    assert check_matches(given, confirmed, rows, match_rows, rays) < 0.3
    with pytest.raises(rt.ReobjError, match="fit in no convention"):
        check_matches(given, False, rows, match_rows, rays)


def test_few_tracks_and_matches_decide_nothing():
    cams = motion("orbit")
    wrong = Supplied(supplied(invert_rigid(cams)))
    tracks = box_tracks(cams, 1, 0)
    assert not check_boxes(wrong, tracks[tracks.track_id < 3])
    assert not check_boxes(wrong, rt.Tracks.empty())
    rows, match_rows, rays = matches(cams, 0.5)
    assert np.isnan(check_matches(wrong, False, rows, match_rows[:99], rays[:99]))


@pytest.mark.parametrize("moving", [True, False])
def test_repeats_of_a_pose_are_no_poses_while_the_boxes_move(moving):
    """A camera that stands still repeats its pose too; twice is no run."""
    cams = motion("orbit", 40)
    frozen = cams.copy()
    frozen[20:30] = cams[20]
    frozen[5] = cams[4]
    seen = cams if moving else frozen
    poses = without_frozen(supplied(frozen), box_tracks(seen, 0.3, 0))
    assert np.flatnonzero(~poses.known).tolist() == (list(range(21, 30)) if moving else [])
    assert len(poses.messages) == moving
    assert PINHOLE == poses.camera
