"""Boxes of groups in frames with a pose, against pycolmap and by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pycolmap
from simulated import CAMERA, SIZE, chair_solids, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.cameras import VisiblePoints, points_in_boxes
from reobj.objects.observations import gather_views, points_on


def one_box_each(frames: list[int], box: tuple[float, ...] = (10, 20, 60, 90)) -> rt.Tracks:
    """A box in each of some frames, of one object."""
    n = len(frames)
    one, zero = np.ones(n, np.int64), np.zeros(n, np.int64)
    xyxy = np.tile(np.array(box, float), (n, 1))
    return rt.Tracks(np.array(frames), one, one, xyxy, np.full(n, 0.9), zero, zero)


def test_every_box_lies_in_its_frame_and_group() -> None:
    """Frames of the source that are not consecutive, groups in another order than the rows."""
    poses = walk(4)
    poses = dataclasses.replace(poses, frame=np.array([5, 7, 9, 11]))
    tracks = one_box_each([5, 9, 9])
    tracks.xyxy[:, 0] = [1, 2, 3]
    views = gather_views(tracks, poses, np.array([1, 1, 0]), 2, 0.0)
    assert views.frame.tolist() == [5, 7, 9, 11] and views.boxes.shape == (4, 2, 4)
    nan = np.nan
    np.testing.assert_array_equal(views.boxes[:, :, 0], [[nan, 1], [nan, nan], [3, 2], [nan, nan]])
    np.testing.assert_array_equal(views.score, [[0, 0.9], [0, 0], [0.9, 0.9], [0, 0]])
    assert views.image_size == SIZE


def test_boxes_are_undistorted_as_pycolmap_does() -> None:
    """Each edge goes through its undistorted middle; edges at the border of the image stay."""
    params = (520.0, 320.0, 240.0, 0.2)
    poses = walk(2, camera=rt.Camera("SIMPLE_RADIAL", *SIZE, params))
    inner, border = (400.0, 300, 600, 450), (0.0, 100, 200, 480)
    tracks = one_box_each([0, 1])
    tracks.xyxy[:] = [inner, border]
    views = gather_views(tracks, poses, np.zeros(2, np.int64), 1, 0.0)
    model = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=list(params))

    def ideal(x: float, y: float) -> np.ndarray:
        return 520 * np.asarray(model.cam_from_img(np.array([[x, y]])))[0] + [320, 240]

    x1, y1, x2, y2 = inner
    x, y = (x1 + x2) / 2, (y1 + y2) / 2
    expected = [ideal(x1, y)[0], ideal(x, y1)[1], ideal(x2, y)[0], ideal(x, y2)[1]]
    np.testing.assert_allclose(views.boxes[0, 0], expected, atol=1e-6)
    assert (views.boxes[0, 0] < inner).all()  # the lens pushes points outwards
    assert views.boxes[1, 0, 0] == 0 and views.boxes[1, 0, 3] == 480
    assert views.boxes[1, 0, 2] > 200  # left of the middle: outwards is to the left


def test_points_in_boxes_project_into_them() -> None:
    """Against a loop; points behind the camera lie in no box, although they project into one."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-6, 6, (800, 3))
    pose = walk(3).cam_from_world[1]
    corner = rng.uniform(0, 400, (7, 2))
    xyxy = np.column_stack([corner, corner + rng.uniform(50, 250, (7, 2))])
    xyxy[3] = np.nan
    found = points_in_boxes(points, CAMERA.K @ pose, xyxy)
    expected = []
    for b, (x1, y1, x2, y2) in enumerate(xyxy):
        for p, point in enumerate(points):
            in_cam = pose[:, :3] @ point + pose[:, 3]
            x, y, z = CAMERA.K @ in_cam
            if z > 0 and x1 <= x / z <= x2 and y1 <= y / z <= y2:
                expected.append((b, p, in_cam[2]))
    assert len(expected) > 50 and (points @ pose[2, :3] + pose[2, 3] < 0).any()
    np.testing.assert_allclose(np.column_stack(found), expected)


def sparse_walk(count: int = 7, **options: Any) -> rt.Poses:
    """A walk with points at the origin, of which frames 0 and 4 observed one each, 4 another."""
    points = np.array([[0.0, 0, 0.5], [0.1, 0, 0.5], [1.0, 0, 1.2], [50.0, 50, 50]])
    visibility = np.array([[4, 2], [0, 0], [4, 0], [4, 3]])
    colors = np.zeros((4, 3), np.uint8)
    poses = walk(count, **options)
    return dataclasses.replace(poses, points=points, colors=colors, visibility=visibility)


def test_frames_have_the_points_observed_by_neighbours() -> None:
    poses = sparse_walk()
    visible = VisiblePoints(poses)
    assert visible.observed(4).tolist() == [0, 2, 3] and visible.observed(1).tolist() == []
    assert visible.in_frame(0).tolist() == [0]  # its own observation alone
    assert visible.in_frame(2).tolist() == [0, 2]  # both neighbours'; point 3 is out of its image
    assert visible.in_frame(6).tolist() == [0, 2]  # nothing after it
    assert not any(1 in visible.in_frame(row) for row in range(7))  # observed by no frame


CHAIRS = chair_solids()


def seen_points(points: np.ndarray, frames: int = 8) -> tuple[rt.Poses, Any]:
    """Poses whose frames all observe all points, and views of three chairs."""
    poses = walk(frames)
    every = np.indices((frames, len(points))).reshape(2, -1).T
    colors = np.zeros((len(points), 3), np.uint8)
    poses = dataclasses.replace(poses, points=points, colors=colors, visibility=every)
    tracks = tracks_of(poses, 0.0)
    return poses, gather_views(tracks, poses, tracks.track_id - 1, 3, 0.0)


def rows_of(found: np.ndarray, points: np.ndarray) -> list[list[int]]:
    """The numbers of the points of each group."""
    known = [own[np.isfinite(own[:, 0])] for own in found]
    return [[int((points == p).all(1).argmax()) for p in own] for own in known]


def test_points_on_an_object_are_in_most_of_its_boxes() -> None:
    """Points far behind it are in some; six points on the front of each chair."""
    rng = np.random.default_rng(0)
    near = [c + rng.uniform(-0.15, 0.15, (6, 3)) for c in CHAIRS.center_in_world]
    points = np.concatenate([*near, CHAIRS.center_in_world + np.array([0, 2.5, 0])])
    poses, views = seen_points(points)
    found = rows_of(points_on(views, poses, CHAIRS), points)
    assert [sorted(own) for own in found] == [[*range(6)], [*range(6, 12)], [*range(12, 18)]]
    views.boxes[2:5, 1] = [0, 0, 5, 5]  # in three of eight views elsewhere: not in most
    assert rows_of(points_on(views, poses, CHAIRS), points)[1] == []
    views.boxes[2:5, 1] = np.nan  # not observed there: no evidence
    assert len(rows_of(points_on(views, poses, CHAIRS), points)[1]) == 6


def test_a_point_belongs_to_the_nearest_then_smallest_object() -> None:
    """A cup on a table, and its neighbour: all have the same boxes."""
    points = np.tile([[0.0, 0, 0.5]], (12, 1)) + 0.01 * np.arange(12)[:, None]
    poses, views = seen_points(points)
    views.boxes[:] = [0, 0, *SIZE]
    half = np.array([[0.2, 0.2, 0.2], [1.0, 1.0, 0.6], [0.1, 0.1, 0.1]])
    centre = np.array([[0.0, 0, 0.5], [0, 0, 0.4], [0.6, 0, 0.5]])
    solids = quadrics.Ellipsoids(centre, half, np.tile(np.eye(3), (3, 1, 1)))
    assert [len(own) for own in rows_of(points_on(views, poses, solids), points)] == [12, 0, 0]
    solids.center_in_world[0, 0] = solids.half_axes[0, 0] = np.nan  # unknown: the others are nearer
    assert [len(own) for own in rows_of(points_on(views, poses, solids), points)] == [0, 12, 0]
