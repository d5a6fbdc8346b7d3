"""Placement of a recording in a map: points with descriptors, PnP, one similarity a component."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from map_worlds import descriptors
from scipy.spatial.transform import Rotation

from reobj.cameras import Camera, Poses
from reobj.maps.placement import ImageFeatures, Similarity, place, points_with_descriptors
from reobj.maps.room_map import MapPoints

CAMERA = Camera("PINHOLE", 640, 480, (520.0, 520.0, 320.0, 240.0))
SCALE = 0.4  # session units of a map unit
TURN = Rotation.from_euler("zyx", [2.0, 0.3, -0.4]).as_matrix()
SHIFT = np.array([3.0, -2.0, 0.7])


def room(rng, count=900):
    """Points on the walls of a room of 5 x 4 x 2.5 m, as a map that a walk observed."""
    xyz = rng.uniform([-2.5, -2, 0], [2.5, 2, 2.5], (count, 3))
    wall = rng.integers(0, 2, count)
    xyz[wall == 0, 0] = np.where(rng.random((wall == 0).sum()) < 0.5, -2.5, 2.5)
    xyz[wall == 1, 1] = np.where(rng.random((wall == 1).sum()) < 0.5, -2, 2)
    centre = np.array([0, 0, 1.4])
    ray = xyz - centre
    distance = np.linalg.norm(ray, axis=1)
    return MapPoints(
        xyz, descriptors(rng, count), np.ones(count, np.int64), np.zeros(count, np.int64),
        ray / distance[:, None], distance,
    )  # fmt: skip


def walk(count=16, radius=0.6):
    """Poses in the map of cameras on a circle, looking outwards."""
    poses = []
    for a in np.linspace(0, 2 * np.pi, count, endpoint=False):
        forward = np.array([np.cos(a), np.sin(a), 0])
        rotation = np.stack([np.cross(forward, [0, 0, 1.0]), [0, 0, -1.0], forward])
        centre = np.array([radius * np.cos(a), radius * np.sin(a), 1.4 + 0.1 * np.sin(3 * a)])
        poses.append(np.column_stack([rotation, -rotation @ centre]))
    return np.array(poses)


def project(points, cam_from_map):
    """Positions (N, 2) of points, and which of them lie in the image."""
    in_cam = points.xyz @ cam_from_map[:, :3].T + cam_from_map[:, 3]
    xy = in_cam[:, :2] / in_cam[:, 2:] @ CAMERA.K[:2, :2].T + CAMERA.K[:2, 2]
    return xy, (in_cam[:, 2] > 0.1) & ((xy > 0) & (xy < (640, 480))).all(1)


def recording(rng, points, cam_from_map, noise_px=0.5, outliers=100, components=None):
    """Poses in a session's own world, and features of every image with wrong ones among them."""
    to_session = Similarity(SCALE, TURN.T, -SCALE * TURN.T @ SHIFT)  # of map_from_session
    count = len(cam_from_map)
    session = to_session.poses(cam_from_map)
    features = []
    visibility = []
    for row, pose in enumerate(cam_from_map):
        xy, inside = project(points, pose)
        seen = np.flatnonzero(inside)
        again = seen[rng.random(len(seen)) < 0.6]
        found = points.descriptor[again].astype(float) + rng.normal(0, 6, (len(again), 128))
        wrong = rng.uniform(0, (640, 480), (outliers, 2))
        features.append(ImageFeatures(
            row,
            np.concatenate([xy[again] + rng.normal(0, noise_px, (len(again), 2)), wrong]),
            np.concatenate([found.clip(0, 255).astype(np.uint8), descriptors(rng, outliers)]),
        ))  # fmt: skip
        visibility += [(row, k) for k in again]
    poses = Poses(
        CAMERA, np.arange(count), np.arange(count) / 10.0, session, np.full(count, "keyframe"),
        "pycolmap", points=to_session.apply(points.xyz), visibility=np.array(visibility),
        colors=np.zeros((len(points), 3), np.uint8),
        part=np.zeros(count, np.int64) if components is None else components,
    )  # fmt: skip
    return poses, features


def test_a_recording_is_moved_as_a_whole_into_a_map_of_another_recording():
    """The map has the points of the first one, described by the keypoints that show them."""
    rng = np.random.default_rng(0)
    world = room(rng)
    first, features = recording(rng, world, walk(14))
    points = points_with_descriptors(first, features)
    assert len(points) > 0.95 * len(np.unique(first.visibility[:, 1]))
    truth = first.cam_from_world  # the same walk, in the world of the first recording
    poses, features = recording(rng, world, walk(14))
    placement = place(poses, features, points)
    assert placement.refused == ""
    np.testing.assert_allclose(placement.poses.cam_from_world, truth, atol=0.01)
    np.testing.assert_allclose(placement.poses.points, poses.points, atol=0.02)
    (component,) = placement.components
    assert component.similarity.scale == pytest.approx(1, rel=0.003)
    assert len(component.images) == component.tried == len(truth)


def test_errors_agree_with_the_covariance():
    """Of rotation, translation and scale, over eight recordings."""
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points = room(rng, 500)
        poses, features = recording(rng, points, walk(10), noise_px=1.5)
        (component,) = place(poses, features, points).components
        found = component.similarity
        truth = Similarity(1 / SCALE, TURN, SHIFT)
        turn = truth.rotation @ found.rotation.T  # the correction that leads to the truth
        grow = truth.scale / found.scale
        moved = truth.translation - grow * turn @ found.translation
        error = np.array([*Rotation.from_matrix(turn).as_rotvec(), *moved, np.log(grow)])
        squares.append(error @ np.linalg.solve(component.similarity.cov, error))
    assert 3 < np.median(squares) < 25  # 6.3 of seven degrees of freedom; ten images: rough


def test_another_room_is_refused():
    rng = np.random.default_rng(1)
    poses, features = recording(rng, room(rng), walk())
    placement = place(poses, features, room(rng))
    assert placement.refused.startswith("0 of 16 images match points of the map, 5 are needed")
    assert placement.poses is poses


def test_two_equal_rooms_are_refused():
    """Of a repeated office half of the images match one copy, half the other."""
    rng = np.random.default_rng(3)
    points = room(rng)
    copy = dataclasses.replace(points, xyz=points.xyz + np.array([8.0, 0, 0]))
    poses, features = recording(rng, points, walk())
    for image in features[::2]:  # their features are those of the copy only
        image.descriptor[:] = image.descriptor[:, ::-1]
    copy = dataclasses.replace(copy, descriptor=copy.descriptor[:, ::-1].copy())
    placement = place(poses, features, MapPoints.joined([points, copy]))
    assert placement.refused == "two positions in the map are alike (8 and 8 images)"


def test_components_are_placed_one_by_one_and_become_one():
    """The second one has its own scale; a third one of another room stays as it is."""
    rng = np.random.default_rng(5)
    points = room(rng)
    truth = walk(21)
    components = np.repeat([0, 1, 2], 7)
    poses, features = recording(rng, points, truth, components=components)
    other = Similarity(3.0, TURN, SHIFT)
    cam = poses.cam_from_world.copy()
    cam[7:14] = other.poses(cam[7:14])
    poses = dataclasses.replace(poses, cam_from_world=cam)
    for image in features[14:]:
        image.descriptor[:] = descriptors(rng, len(image.descriptor))
    placement = place(poses, features, points)
    assert placement.refused == ""
    assert placement.poses.part.tolist() == [0] * 14 + [1] * 7
    np.testing.assert_allclose(placement.poses.cam_from_world[:14], truth[:14], atol=0.02)
    np.testing.assert_array_equal(placement.poses.cam_from_world[14:], cam[14:])
    reason = placement.components[2].refused
    assert reason == "0 of 7 images match points of the map, 4 are needed"


def with_few_matches(rng, features, matching):
    """Features of which only those of the first images, 14 each, are in the map."""
    few = [dataclasses.replace(im, xy=im.xy[:14], descriptor=im.descriptor[:14]) for im in features]
    for image in few[matching:]:
        image.descriptor[:] = descriptors(rng, len(image.descriptor))
    return few


def test_a_short_view_of_the_mapped_part_places_a_recording():
    """Eight of sixty images show the part that the map has."""
    rng = np.random.default_rng(8)
    points = room(rng)
    truth = walk(60)
    poses, features = recording(rng, points, truth, outliers=0)
    part = points[np.flatnonzero(project(points, truth[4])[1])]
    few = with_few_matches(rng, features, 8)
    placement = place(poses, few, part, most=60)
    assert placement.refused == ""
    (component,) = placement.components
    assert len(component.images) >= 7 and max(len(im.point) for im in component.images) < 15
    np.testing.assert_allclose(placement.poses.cam_from_world[:8], truth[:8], atol=0.1)


def test_images_that_show_nothing_of_what_they_should_contradict_a_placement():
    """Of a mirrored room, a few images agree by chance."""
    rng = np.random.default_rng(8)
    points = room(rng)
    poses, features = recording(rng, points, walk(60), outliers=0)
    few = with_few_matches(rng, features, 8)
    reason = "8 of 60 images agree on a position in the map, where 57 should show points of it"
    assert place(poses, few, points, most=60).refused.startswith(reason)
