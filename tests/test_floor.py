"""The floor of synthetic rooms: its position and sigma, and rooms without one."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from pose_worlds import motion, supplied
from scipy.spatial.transform import Rotation
from simulated import walk

import quadrics
import reobj_track as rt
from reobj.objects.description import describe_world
from reobj.poses.floor import find_floor, floor_of
from reobj.results.entries import decode

UP = np.array([0, 0, 1.0])


def room(seed=0, on_floor=400, noise=0.01, wrong=0.01, table=True, half=3.0):
    """Points (N, 3) of a room of 6 x 6 m, floor at z = 0: walls, a table, chairs, stray points."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-half, half, (on_floor, 2)), np.zeros(on_floor)])
    side = rng.integers(0, 4, 1200)
    along, up = rng.uniform(-half, half, 1200), rng.uniform(0, 2.4, 1200)
    wall = np.where((side % 2 == 0)[:, None], np.column_stack([along, half + 0 * along]),
                    np.column_stack([half + 0 * along, along]))  # fmt: skip
    wall = np.column_stack([wall * np.where(side < 2, 1, -1)[:, None], up])
    top = np.column_stack([rng.uniform([-0.8, -0.5], [0.8, 0.5], (900, 2)), np.full(900, 0.74)])
    clutter = rng.uniform([-2, -2, 0], [2, 2, 1], (300, 3))
    stray = rng.uniform([-half, -half, -2], [half, half, 0], (int(wrong * 2000), 3))
    parts = [floor, wall, clutter, stray] + [top] * table
    points = np.concatenate([part for part in parts if len(part)])
    return points + rng.normal(0, noise, points.shape)


def cameras(height=1.5, radius=2.0, count=30):
    angle = np.linspace(0, 2 * np.pi, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + height])


def tilted(deg, axis=0):
    return Rotation.from_rotvec(np.radians(deg) * np.eye(3)[axis]).apply(UP)


@pytest.mark.parametrize(
    ("noise", "on_floor", "tilt_deg"), [(0.003, 400, 0), (0.02, 400, 3), (0.02, 120, 3)]
)
def test_the_floor_is_found_within_its_sigma(noise, on_floor, tilt_deg):
    """Not the table top, which has more points; gravity is a few degrees off."""
    errors = []
    for seed in range(4):
        points = room(seed, on_floor, noise)
        floor, reason = find_floor(points, tilted(tilt_deg, seed % 2), cameras(), 1.0)
        assert floor is not None and reason == ""
        height = floor.middle[2]  # the true floor is z = 0
        tilt = np.degrees(np.arccos(floor.normal @ UP))
        errors += [height / floor.sigma, tilt / floor.tilt_sigma_deg]
        assert abs(height) < 0.03 and tilt < 1.5
        assert 0.95 * on_floor < floor.inliers < 1.5 * on_floor
        assert floor.normal @ floor.middle == pytest.approx(floor.offset, abs=1e-5)
        assert 0.001 < floor.sigma < 0.05
        np.testing.assert_allclose(floor.middle[:2], 0, atol=0.2)
    assert np.mean(np.abs(errors) < 2) >= 0.85


def test_unit_and_axes_of_the_world_do_not_matter():
    turn = Rotation.from_euler("zyx", [30, 100, -20], degrees=True)
    points, centres = room(), cameras()
    plain, _ = find_floor(points, UP, centres, 1.0)
    moved, _ = find_floor(
        20 * turn.apply(points) + 7, turn.apply(UP), 20 * turn.apply(centres) + 7, 0.05
    )
    assert plain is not None and moved is not None
    np.testing.assert_allclose(moved.normal, turn.apply(plain.normal), atol=2e-3)
    np.testing.assert_allclose(moved.middle, 20 * turn.apply(plain.middle) + 7, atol=0.1)
    assert moved.sigma == pytest.approx(20 * plain.sigma, rel=0.3)


def table_top(size=0.7):
    """A table top with objects on it, and nothing else."""
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-size, size, (900, 2)), rng.normal(0, 0.002, 900)])
    return np.concatenate([top, rng.uniform([-0.3, -0.3, 0], [0.3, 0.3, 0.3], (400, 3))])


ORBIT, HIGHER = cameras(0.5, 0.8), np.array([0, 0, 9.0])
TABLE = np.array([0, 0, 0.74])


@pytest.mark.parametrize(
    ("points", "centres", "metres", "reason"),
    [
        (table_top(), ORBIT, 1.0, "may be a table top"),
        (table_top(), ORBIT, None, "scale is unknown"),
        (room(on_floor=0, table=False, wrong=0), cameras(), 1.0, "no plane|points lie|no near"),
        (room(), cameras(), 0.1, "m below the cameras"),  # a doll's house
        (room()[:50], cameras(), 1.0, "50 points, 100 are needed"),
        (room() + HIGHER, cameras(), 1.0, "0 points below the cameras"),
        (room(), np.empty((0, 3)), 1.0, "are needed"),
        (np.random.default_rng(0).normal(0, 2, (3000, 3)), cameras(), 1.0, "plane"),
    ],
)
def test_scenes_without_a_floor(points, centres, metres, reason):
    floor, why = find_floor(points, UP, centres, metres)
    assert floor is None
    assert any(part in why for part in reason.split("|")), why


def test_a_table_top_is_not_the_floor_if_the_floor_is_visible():
    """The cameras are near the table; a strip of floor beside it is enough."""
    rng = np.random.default_rng(0)
    strip = np.column_stack([rng.uniform([-2, 0.8], [2, 2], (250, 2)), rng.normal(0, 0.005, 250)])
    points = np.concatenate([table_top() + TABLE, strip])
    floor, why = find_floor(points, UP, ORBIT + TABLE, 1.0)
    assert floor is not None, why
    assert abs(floor.normal @ [0, 1.4, 0] - floor.offset) < 0.02


# ---- From poses, and in a result -----------------------------------------------------------------


def poses_in_room(**changes):
    cams = motion("orbit", 30)
    points = room()
    seen = np.column_stack(
        [np.tile(np.arange(3), len(points)), np.repeat(np.arange(len(points)), 3)]
    )
    poses = dataclasses.replace(
        supplied(cams), points=points, colors=np.zeros(points.shape, np.uint8), visibility=seen,
        metric=True, up_in_world=UP,
    )  # fmt: skip
    return dataclasses.replace(poses, **changes)


def test_points_that_only_two_frames_observed_do_not_count():
    poses = poses_in_room()
    assert floor_of(poses, None, 1.0) == (None, "gravity is unknown")
    count = len(poses.points)
    ghost = poses.points[:500] - TABLE  # a second level below
    seen = np.column_stack([np.tile([0, 1], 500), np.repeat(np.arange(500) + count, 2)])
    poses = dataclasses.replace(
        poses, points=np.concatenate([poses.points, ghost]),
        colors=np.zeros((count + 500, 3), np.uint8),
        visibility=np.concatenate([poses.visibility, seen]),
    )  # fmt: skip
    floor, _ = floor_of(poses, UP, 1.0)
    assert floor is not None and abs(floor.middle[2]) < 0.03


def poses_in_two_components():
    """The same room again in the component of frames 15-29, 5 m higher."""
    poses = poses_in_room(part=np.repeat([0, 1], 15))
    count = len(poses.points)
    cams = poses.cam_from_world.copy()
    cams[15:, :, 3] -= cams[15:, :, :3] @ (5 * HIGHER)
    return dataclasses.replace(
        poses, cam_from_world=cams,
        points=np.concatenate([poses.points, poses.points + 5 * HIGHER]),
        colors=np.zeros((2 * count, 3), np.uint8),
        visibility=np.concatenate([poses.visibility, poses.visibility + np.array([20, count])]),
    )  # fmt: skip


def test_every_component_has_its_own_floor():
    scale = quadrics.Scale(1.0, 0.05, "priors")
    fit = SimpleNamespace(scale=scale, up=UP, up_source="cameras")  # the used attributes of a fit
    world = describe_world(poses_in_two_components(), [fit, fit], [])
    for component, height in zip(world.parts, (0, 5 * HIGHER @ UP), strict=True):
        assert component.floor is not None and component.floor_reason == ""
        assert abs(component.floor.middle @ UP - height) < 0.03
    assert world.floor is world.parts[0].floor
    back = decode(rt.World, json.loads(json.dumps(world.to_json())))
    assert back.to_json() == world.to_json()
    np.testing.assert_array_equal(back.parts[1].floor.middle, world.parts[1].floor.middle)
    assert describe_world(poses_in_two_components(), [fit, None], []).parts[1].floor is None


def test_the_reason_for_a_missing_floor_is_saved():
    world = describe_world(poses_in_room(metric=False), [None], [])
    assert world.floor is None and "scale is unknown" in world.floor_reason
    assert "0 points" in describe_world(walk(4), [None], []).floor_reason
