"""The check of supplied poses against tracks: wrong direction, wrong axes, no false alarm."""

from __future__ import annotations

import numpy as np
import pytest
from pose_worlds import FOCAL, SIZE, motion, supplied
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.poses.supplied.interpretation import check_poses


def box_tracks(cams, noise_px, seed, objects=12):
    """Noisy centres of points in view, as tracks."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, 0], [3, 3, 1.2], (objects, 3))
    K = np.array([[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]])
    in_cam = np.einsum("fij,oj->ofi", cams[:, :, :3], points) + cams[None, :, :, 3]
    xy = np.einsum("ij,ofj->ofi", K, in_cam)
    xy = xy[..., :2] / xy[..., 2:]
    seen = (in_cam[..., 2] > 0.3) & (xy > 0).all(2) & (xy < SIZE).all(2)
    bias = rng.normal(0, noise_px, (objects, 1, 2))  # boxes are not centred on one point
    xy = (
        xy + rng.normal(0, noise_px, xy.shape) + bias * np.linspace(-1, 1, len(cams))[None, :, None]
    )
    return [(np.flatnonzero(s), xy[o][s]) for o, s in enumerate(seen) if s.any()]


GL3 = np.diag([1.0, -1, -1])
MISTAKES = {
    "direction": lambda c: invert_rigid(c),
    "axes": lambda c: GL3 @ c,
    "both": lambda c: invert_rigid(GL3 @ c),
}


@pytest.mark.parametrize("noise_px", [1, 8, 20])
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan", "forward", "still"])
def test_right_poses_raise_no_alarm(kind, noise_px):
    cams = motion(kind)
    for seed in range(20):
        tracks = box_tracks(cams, noise_px, seed)
        assert check_poses(supplied(cams), tracks) is None
        assert check_poses(supplied(cams), tracks[:4]) is None


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan"])
def test_wrong_poses_are_named(kind, mistake):
    cams = motion(kind)
    for seed in range(5):
        message = check_poses(supplied(MISTAKES[mistake](cams)), box_tracks(cams, 4, seed))
        assert message is not None
        named = {
            "direction": "world_from_cam given",
            "axes": "OpenGL axes (y up",
            "both": "inverted and with OpenGL",
        }
        assert named[mistake] in message


def test_quaternions_in_the_other_order_are_named():
    for kind in ("orbit", "walk", "pan"):
        cams = motion(kind)
        given = invert_rigid(cams)
        xyzw = Rotation.from_matrix(given[:, :, :3]).as_quat()
        for places, named in ((1, "w first given as"), (-1, "w last given as")):
            given[:, :, :3] = Rotation.from_quat(np.roll(xyzw, places, 1)).as_matrix()
            message = check_poses(supplied(invert_rigid(given)), box_tracks(cams, 4, 0))
            assert message is not None and named in message


@pytest.mark.parametrize("kind", ["orbit", "walk", "forward"])
def test_poses_of_other_frames_are_not_called_inverted(kind):
    """Every 6th pose given to every frame, another path, the path read backwards."""
    cams = motion(kind, 240)
    other = motion("walk" if kind == "orbit" else "orbit")
    for seed in range(5):
        tracks = box_tracks(cams[:60], 4, seed)
        for given in (cams[::4], other, cams[59::-1], cams[30:90]):
            assert check_poses(supplied(given), tracks) is None


def test_check_needs_tracks():
    assert check_poses(supplied(motion("orbit")), []) is None
    assert check_poses(supplied(motion("orbit")), [(np.array([1, 2]), np.ones((2, 2)))]) is None


def test_what_fits_within_a_degree_is_beyond_doubt():
    """A camera that moves by a centimetre: the other direction fits better, and means nothing."""
    cams = motion("still")
    for seed in range(5):
        assert check_poses(supplied(invert_rigid(cams)), box_tracks(cams, 0, seed)) is None
