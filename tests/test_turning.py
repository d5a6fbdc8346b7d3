"""Rotations of a camera that turns on one spot, from verified matches."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from point_worlds import PointWorld
from scipy.spatial.transform import Rotation

from reobj.poses.features import MatchedPairs
from reobj.poses.turning import Turn, estimate_turn, pin, turning_model

pycolmap = pytest.importorskip("pycolmap")
FOCAL_PX = 500.0


def camera_of(focal_px: float) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, 640, 480)


def matched(
    rotation: np.ndarray, centre: np.ndarray, wrong: float = 0.0, points: int = 1500
) -> MatchedPairs:
    """Match images up to four apart, and last with first, that see a sphere of 1.5 to 4 m.

    Args:
        rotation: (K, 3, 3), centre: (K, 3) m. wrong: fraction of matches with another point.
    """
    rng = np.random.default_rng(0)
    ray = rng.normal(size=(points, 3))
    xyz = ray / np.linalg.norm(ray, axis=1, keepdims=True) * rng.uniform(1.5, 4, (points, 1))
    camera = camera_of(FOCAL_PX)
    in_cam = np.einsum("kij,knj->kni", rotation, xyz - centre[:, None])
    seen = []
    keypoints = {}
    for k, local in enumerate(in_cam):
        xy = camera.img_from_cam(local * np.sign(local[:, 2:]))
        inside = (local[:, 2] > 0.1) & ((xy > 0) & (xy < (640, 480))).all(1)
        seen.append(np.flatnonzero(inside))
        keypoints[k + 1] = xy[inside] + rng.normal(0, 0.5, (inside.sum(), 2))
    ids = []
    inliers = []
    for a, b in itertools.combinations(range(len(rotation)), 2):
        _, one, other = np.intersect1d(seen[a], seen[b], return_indices=True)
        if min(b - a, a + len(rotation) - b) <= 4 and len(one) >= 15:
            mixed = rng.random(len(one)) < wrong
            other[mixed] = rng.permutation(other[mixed])
            ids.append((a + 1, b + 1))
            inliers.append(np.column_stack([one, other]))
    none = np.full((len(ids), 3, 3), np.nan)
    return MatchedPairs(np.array(ids), inliers, keypoints, none)


def full_turn(count: int = 36) -> np.ndarray:
    """Turn once to the left, looking up and down: cam_from_world (K, 3, 3)."""
    yaw = np.linspace(0, 360, count, endpoint=False)
    angles = np.column_stack([yaw, 8 * np.sin(np.radians(3 * yaw))])
    return Rotation.from_euler("yx", angles, degrees=True).inv().as_matrix()


def errors_deg(turn: Turn, truth: np.ndarray) -> np.ndarray:
    """Compare with the true rotations after the best common one."""
    found = Rotation.from_matrix(np.swapaxes(turn.cam_from_world, 1, 2) @ truth[turn.ids - 1])
    return np.degrees((found.mean().inv() * found).magnitude())


@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("guess", [400.0, 500.0, 620.0])
def test_a_full_turn_closes_and_gives_the_focal_length(guess: float, wrong: float) -> None:
    truth = full_turn()
    turn = estimate_turn(matched(truth, np.zeros((36, 3)), wrong), camera_of(guess), False)
    assert turn is not None and turn.problem == "" and len(turn.ids) == 36
    assert turn.camera.mean_focal_length() == pytest.approx(FOCAL_PX, rel=0.003)
    assert errors_deg(turn, truth).max() < 0.15
    if not wrong:
        assert turn.spread_rad < 2 / FOCAL_PX and turn.closing_deg < 0.1
        assert turn.unexplained < 0.01


def test_the_sway_of_a_hand_is_measured_as_spread() -> None:
    truth = full_turn()
    sway = np.random.default_rng(1).normal(0, 0.02, (36, 3))
    turn = estimate_turn(matched(truth, sway), camera_of(400.0), False)
    assert turn is not None and turn.problem == ""
    assert 0.003 < turn.spread_rad < 0.03  # 2 cm at 1.5 to 4 m
    assert np.median(errors_deg(turn, truth)) < 1.0


def test_part_of_a_turn_gives_the_focal_length() -> None:
    """Nothing closes: in rad, a longer focal length would have smaller residuals."""
    truth = full_turn()[:14]
    sway = np.random.default_rng(1).normal(0, 0.03, (14, 3))
    turn = estimate_turn(matched(truth, sway), camera_of(620.0), False)
    assert turn is not None and turn.camera.mean_focal_length() == pytest.approx(FOCAL_PX, rel=0.05)


def test_points_are_directions_that_all_their_images_agree_on() -> None:
    truth = full_turn()
    turn = estimate_turn(matched(truth, np.zeros((36, 3))), camera_of(FOCAL_PX), True)
    assert turn is not None
    assert turn.camera.mean_focal_length() == FOCAL_PX and turn.focal_sigma == 0  # given
    assert len(turn.direction) > 500
    np.testing.assert_allclose(np.linalg.norm(turn.direction, axis=1), 1)
    local = np.einsum("mij,mj->mi", turn.cam_from_world[turn.image], turn.direction[turn.point])
    xy = turn.camera.img_from_cam(local)
    pairs = matched(truth, np.zeros((36, 3)))
    measured = [
        pairs.keypoints[int(turn.ids[i])][k] for i, k in zip(turn.image, turn.keypoint, strict=True)
    ]
    assert np.median(np.linalg.norm(xy - measured, axis=1)) < 1.0


@pytest.mark.parametrize("is_given", [True, False])
def test_a_walk_is_no_turn(is_given: bool) -> None:
    """Sideways past a wall of the room, and round on a circle of .8 m."""
    still = np.tile(np.eye(3), (12, 1, 1))
    sideways = np.column_stack([np.linspace(-0.6, 0.6, 12), np.zeros(12), np.zeros(12)])
    truth = full_turn()
    for rotation, centre in ((still, sideways), (truth, 0.8 * truth[:, 2])):
        turn = estimate_turn(matched(rotation, centre), camera_of(FOCAL_PX), is_given)
        assert turn is None or turn.problem


def test_images_that_do_not_connect_are_left_out() -> None:
    pairs = matched(full_turn(), np.zeros((36, 3)))
    both = (pairs.image_ids <= 20).all(1) | (pairs.image_ids > 30).all(1)
    turn = estimate_turn(pairs_of(pairs, both), camera_of(FOCAL_PX), True)
    assert turn is not None and turn.ids.tolist() == list(range(1, 21))
    assert estimate_turn(pairs_of(pairs, both & False), camera_of(FOCAL_PX), True) is None


@pytest.mark.parametrize("sway_m", [0.0, 0.03])
def test_a_bundle_adjustment_from_the_turn_finds_the_sway(sway_m: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    ray = rng.normal(size=(2500, 3))
    points = ray / np.linalg.norm(ray, axis=1, keepdims=True) * rng.uniform(1.5, 4, (2500, 1))
    rotation = full_turn()
    centre = rng.normal(0, sway_m, (36, 3))
    cams = np.concatenate([rotation, -rotation @ centre[:, :, None]], 2)
    world = PointWorld(cams, points)
    pairs = world.pairs(reach=35)
    world.write(tmp_path / "database.db", range(1, 37), pairs)
    turn = estimate_turn(pairs, world.camera.to_pycolmap(), True)
    assert turn is not None
    model, moves = turning_model(turn, tmp_path / "database.db")
    assert moves == bool(sway_m) and model.num_reg_images() == 36 and len(model.points3D) > 500
    found = np.array([model.image(i).projection_center() for i in range(1, 37)])
    if not sway_m:
        np.testing.assert_array_equal(found, np.zeros((36, 3)))
        return
    similarity = pycolmap.estimate_sim3d(found, centre)
    assert np.sqrt(((similarity * found - centre) ** 2).sum(1).mean()) < 0.1 * sway_m
    pin(model)
    assert not np.array([model.image(i).projection_center() for i in range(1, 37)]).any()


def pairs_of(pairs: MatchedPairs, keep: np.ndarray) -> MatchedPairs:
    rows = np.flatnonzero(keep)
    inliers = [pairs.inliers[row] for row in rows]
    return MatchedPairs(pairs.image_ids[rows], inliers, pairs.keypoints, pairs.fundamental[rows])
