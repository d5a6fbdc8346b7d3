"""The online tracker's 3D state: ellipsoids of identities and depth intervals, in any unit."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import SIZE, walk

import quadrics
import reobj_track as rt
from reobj.cameras import VisiblePoints
from reobj.tracking.ellipsoid_map import (
    EllipsoidMap,
    depth_intervals,
    iou_within_uncertainty,
    project_depth_intervals,
    project_half_intervals,
)
from reobj.types import box_iou, xyxy_from_cxcywh


def unit(rng: np.random.Generator, n: int, dim: int = 64) -> np.ndarray:
    vectors = rng.normal(size=(n, dim))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def one(value: int = 0) -> np.ndarray:
    return np.array([value])


# ---- Ellipsoids ----
CAMERA = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))


def view_at(x: float, turn_deg: float = 0.0) -> np.ndarray:
    """img_from_world (3, 4) of a camera at (x, 0, 0), turned to the right."""
    a = np.radians(turn_deg)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    return CAMERA.K @ np.c_[turn, turn @ [-x, 0, 0]]


def ball(
    x: float, half_axes: tuple[float, ...] = (0.2, 0.2, 0.2), z: float = 4.0
) -> quadrics.Ellipsoids:
    return quadrics.Ellipsoids(np.array([[x, 0.1, z]]), np.array([half_axes]), np.eye(3)[None])


def outline(ellipsoid: quadrics.Ellipsoids, view: np.ndarray) -> np.ndarray:
    """Box (4,) of the image of points sampled on the surface."""
    rng = np.random.default_rng(0)
    sphere = unit(rng, 20000, 3)
    points = ellipsoid.center_in_world[0] + sphere * ellipsoid.half_axes[0]
    seen = np.c_[points, np.ones(len(points))] @ view.T
    xy = seen[:, :2] / seen[:, 2:]
    return np.concatenate([xy.min(0), xy.max(0)])


def mapped(
    objects: list[quadrics.Ellipsoids], views: list[np.ndarray], step: int = 5
) -> EllipsoidMap:
    ellipsoids = EllipsoidMap()
    identity = np.arange(len(objects))
    for i, view in enumerate(views):
        ellipsoids.add(step * i, identity, np.stack([outline(t, view) for t in objects]), view)
    ellipsoids.refit(SIZE)
    return ellipsoids


WALK = [view_at(x) for x in np.linspace(-1.1, 1.1, 12)]


def test_ellipsoids_are_estimated_and_projected() -> None:
    """In a view that was not used the boxes are the true projections."""
    objects = [ball(-0.5), ball(0.6, (0.3, 0.2, 0.25))]
    ellipsoids = mapped(objects, WALK)
    assert ellipsoids.known[:3].tolist() == [True, True, False]
    projected = ellipsoids.project(view_at(0.3, 8), SIZE, 0.5)
    for box, ellipsoid in zip(projected[:2], objects, strict=True):
        x1, y1, x2, y2 = outline(ellipsoid, view_at(0.3, 8))
        np.testing.assert_allclose(box, [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1], atol=3)
    assert np.isnan(projected[2:]).all()
    assert np.isnan(ellipsoids.project(view_at(0, 180), SIZE, 0.0)).all()  # behind the camera


@pytest.mark.parametrize(("length", "known"), [(0.2, True), (6.0, False)])
def test_elongated_ellipsoids_are_rejected(length: float, known: bool) -> None:
    """Truncated objects give ellipsoids that extend beyond the camera and are uninformative."""
    assert bool(mapped([ball(0, (length, 0.1, 0.1))], WALK).known[0]) is known


@pytest.mark.parametrize(("walked", "known"), [(0.0, False), (0.05, False), (0.4, True)])
def test_without_parallax_there_is_no_ellipsoid(walked: float, known: bool) -> None:
    """A ball at 4 m and a camera that turns, and walks 0, 0.7 or 5.7 degrees of parallax."""
    xs = np.linspace(-walked / 2, walked / 2, 12)
    views = [view_at(x, turn) for x, turn in zip(xs, np.linspace(-10, 10, 12), strict=True)]
    assert bool(mapped([ball(0)], views).known[0]) is known


def test_outlier_views_do_not_move_an_ellipsoid() -> None:
    ellipsoids = mapped([ball(0)], WALK)
    before = ellipsoids.ends[0].mean(0)
    for i, wrong in enumerate(([0.0, 0, 20, 20], [600.0, 400, 640, 480])):
        ellipsoids.add(100 + i, one(), np.array([wrong]), view_at(0.1))
    ellipsoids.fresh[0] = 10
    assert ellipsoids.refit(SIZE)
    assert np.linalg.norm(ellipsoids.ends[0].mean(0) - before) < 0.05


def test_kept_views_are_bounded_and_cover_all_directions() -> None:
    """A thousand frames around a ball, then a hundred from one spot, which add nothing."""
    ellipsoids = EllipsoidMap()
    angles = np.radians(np.linspace(0, 120, 1000))
    for frame in range(1100):
        a = angles[min(frame, 999)]
        eye, turn = np.array([-4 * np.sin(a), 0, 4 - 4 * np.cos(a)]), np.eye(3)
        turn[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
        view = CAMERA.K @ np.c_[turn, -turn @ eye]
        ellipsoids.add(frame, one(), np.array([[300.0, 220, 340, 260]]), view)
    held = ellipsoids.frame[0] >= 0
    frames = np.sort(ellipsoids.frame[0][held])
    assert 8 <= len(frames) <= 16 and frames[0] == 0 and 850 < frames[-1] < 1000
    assert np.diff(frames).max() < 200


# ---- Depth intervals ----

EYE = np.c_[np.eye(3), [0, 0, 0]]


def test_points_in_a_box_give_its_depth_interval() -> None:
    """A ball of 20 cm at 4 m in front of a wall at 6 m; a box without points uses all points."""
    rng = np.random.default_rng(0)
    on_ball = np.array([0.5, 0, 4.0]) + 0.2 * unit(rng, 60, 3)
    wall = np.c_[rng.uniform(-3, 3, (300, 2)), np.full(300, 6.0)]
    wall = wall[np.abs(wall[:, 0] / 6 + 0.3) > 0.1]  # a region without points
    boxes = np.array([[352.5, 210, 412.5, 270], [150, 220, 190, 260.0]])
    ends, size = depth_intervals(boxes, np.concatenate([on_ball, wall]), EYE, CAMERA.K)
    assert 3.7 < ends[0, 0, 2] < 4.0 < ends[0, 1, 2] < 4.6 and 5 < ends[1].mean(0)[2] < 7
    np.testing.assert_allclose(size[0], 60 / 500 * 4, rtol=0.06)
    there = project_depth_intervals(ends, size, CAMERA.K, EYE)
    np.testing.assert_allclose(xyxy_from_cxcywh(there), boxes, atol=1e-6)
    half = project_half_intervals(ends, CAMERA.K @ EYE)
    assert np.abs(half).max() < 1e-6  # on the rays of this view
    aside = np.c_[np.eye(3), [-1.0, 0, 0]]  # a metre to the right: 125 px at 4 m
    moved = project_depth_intervals(ends, size, CAMERA.K, aside)[0, 0] - there[0, 0]
    half = project_half_intervals(ends, CAMERA.K @ aside)
    assert abs(moved + 125) < 6 and 2 < abs(half[0, 0]) < 12
    nothing, _ = depth_intervals(boxes, np.empty((0, 3)), EYE, CAMERA.K)
    assert np.isnan(nothing).all()
    behind = np.c_[np.eye(3), [0, 0, -20.0]]
    assert np.isnan(project_depth_intervals(ends, size, CAMERA.K, behind)).all()


def test_an_uncertain_box_overlaps_within_its_uncertainty() -> None:
    box = np.array([[100.0, 100, 40, 20], [300, 100, 40, 20]])
    seen = np.array([[160.0, 100, 40, 20], [100, 160, 40, 20]])
    columns = box.T[..., None], seen.T[:, None]
    iou, inside = iou_within_uncertainty(columns[0], np.zeros((2, 1, 1)), columns[1])
    boxes = xyxy_from_cxcywh(box), xyxy_from_cxcywh(seen)
    np.testing.assert_allclose(iou, box_iou(*boxes), atol=1e-9)
    assert inside.ravel().tolist() == [1, 1]
    uncertainty = np.array([[60.0, 20], [0, 0]])[..., None]
    iou, inside = iou_within_uncertainty(columns[0], uncertainty, columns[1])
    np.testing.assert_allclose(iou, [[1, 0], [0, 0]], atol=1e-9)  # to the side, not below
    np.testing.assert_allclose(inside.ravel(), [0.25, 0.5])


def test_a_frame_has_the_points_of_neighbours_in_its_component() -> None:
    poses = walk(6)
    seen = np.array([[0, 0], [0, 1], [3, 1], [3, 2], [5, 3]])
    points, component = np.arange(12.0).reshape(4, 3), np.array([0, 0, 0, 0, 1, 1])
    visible = VisiblePoints(rt.Poses(
        poses.camera, poses.frame, poses.time_s, poses.cam_from_world, poses.status, "user",
        points=points, visibility=seen, part=component,
    ))  # fmt: skip
    assert [visible.nearby(row).tolist() for row in range(6)] == [
        [0, 1], [0, 1, 2], [0, 1, 2], [1, 2], [3], [3],
    ]  # fmt: skip
    assert len(VisiblePoints(poses).nearby(2)) == 0
