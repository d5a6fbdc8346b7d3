"""Frames located in a map one by one: photos, and recordings that could not be reconstructed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_placement import CAMERA, descriptors, recording, room, walk

from reobj.cameras import Camera
from reobj.maps.placement import ImageFeatures, PlacementOptions, PointMatcher
from reobj.maps.single_frames import SingleFrameOptions, common_camera, locate_frames

GUESS = Camera("SIMPLE_PINHOLE", 640, 480, (768.0, 320.0, 240.0))  # of a failed reconstruction


def unposed(seed, count=16, points=900, depth=0.0, **options):
    """Points of a map, true poses, and a recording without poses with features of every frame.

    Args:
        depth: of the walls, on each side; 0: every image shows planes.
    """
    rng = np.random.default_rng(seed)
    world = room(rng, points)
    world = dataclasses.replace(world, xyz=world.xyz + rng.uniform(-depth, depth, (points, 3)))
    truth = walk(count)
    posed, features = recording(rng, world, truth, **options)
    nowhere = dataclasses.replace(
        posed, camera=GUESS, cam_from_world=np.full((count, 3, 4), np.nan), source="none",
        status=np.full(count, "none"), points=np.empty((0, 3)), colors=np.empty((0, 3), np.uint8),
        visibility=np.empty((0, 2), np.int64),
    )  # fmt: skip
    return world, truth, nowhere, features


def with_matches(image, most):
    """The features of an image, of which at most this many are those of the map's points."""
    wrong = 100  # `recording` appends them
    kept = np.r_[:most, len(image.xy) - wrong : len(image.xy)]
    return ImageFeatures(image.row, image.xy[kept], image.descriptor[kept])


def test_frames_are_located_with_their_common_focal_length():
    world, truth, poses, features = unposed(0)
    placement = locate_frames(poses, features, world)
    assert placement.refused == ""
    found = placement.poses
    assert found.camera.params[0] == pytest.approx(CAMERA.params[0], rel=0.005)
    np.testing.assert_allclose(found.cam_from_world, truth, atol=0.02)
    assert (found.status == "pnp").all() and found.source == "map"
    # observations are the inliers: the points project where they were seen
    row, point = found.visibility.T
    assert len(row) == sum(len(image.point) for image in placement.components[0].images)
    in_cam = np.einsum("nij,nj->ni", truth[row, :, :3], found.points[point]) + truth[row, :, 3]
    xy = in_cam[:, :2] / in_cam[:, 2:] @ CAMERA.K[:2, :2].T + CAMERA.K[:2, 2]
    assert (in_cam[:, 2] > 0).all()
    assert ((xy > -6) & (xy < (646, 486))).all()
    assert len(row) > 500


def test_a_given_camera_is_not_changed():
    world, truth, poses, features = unposed(1)
    placement = locate_frames(poses, features, world, CAMERA)
    assert placement.poses.camera is CAMERA
    np.testing.assert_allclose(placement.poses.cam_from_world, truth, atol=0.02)


def test_frames_that_do_not_match_have_no_pose():
    world, truth, poses, features = unposed(2)
    rng = np.random.default_rng(3)
    for image in features[6:]:
        image.descriptor[:] = descriptors(rng, len(image.descriptor))
    placement = locate_frames(poses, features, world)
    assert placement.refused == ""
    assert placement.poses.known.tolist() == [True] * 6 + [False] * 10
    np.testing.assert_allclose(placement.poses.cam_from_world[:6], truth[:6], atol=0.03)


def test_few_images_with_few_matches_are_refused():
    world, _, poses, features = unposed(4)
    rng = np.random.default_rng(5)
    for image in features[4:]:
        image.descriptor[:] = descriptors(rng, len(image.descriptor))
    few = [with_matches(image, 25) for image in features]
    text = "4 of 16 images match points of the map, 5 are needed, or one with 40 matches"
    refused = locate_frames(poses, few, world)
    assert refused.refused == text and refused.poses is poses
    assert locate_frames(poses, few, world, options=PlacementOptions(frames=4)).refused == ""


def test_one_photo_needs_many_matches():
    world, truth, poses, features = unposed(6, points=3000, depth=0.5)
    photo = features[5:6]
    located = locate_frames(poses, photo, world)
    assert located.refused == "" and located.poses.known.sum() == 1
    assert np.isfinite(located.best.similarity.cov).all()
    np.testing.assert_allclose(located.poses.cam_from_world[5], truth[5], atol=0.1)
    few = locate_frames(poses, [with_matches(photo[0], 30)], world)
    assert few.refused.startswith("1 of 1 images match points of the map, 2 are needed")
    two = locate_frames(poses, [with_matches(image, 30) for image in features[5:7]], world)
    assert two.refused == ""


def test_another_room_and_a_mirrored_one_are_refused():
    """A mirrored wall fits a camera behind it, but no wall is seen from behind."""
    world, _, poses, features = unposed(7)
    other = room(np.random.default_rng(8))
    flip = np.array([-1, 1, 1])
    mirrored = dataclasses.replace(
        world, xyz=world.xyz * flip, viewing_ray=world.viewing_ray * flip
    )  # fmt: skip
    for points in (other, mirrored):
        placement = locate_frames(poses, features, points)
        assert placement.refused.startswith("0 of 16 images")
        assert placement.components[0].tried == 16


def test_images_that_show_hardly_any_of_the_points_in_view_are_refused():
    """18 matches of more than a thousand points that the map has there."""
    world, _, poses, features = unposed(9, count=6, points=14000)
    few = [with_matches(image, 18) for image in features]
    assert "points that they should show" in locate_frames(poses, few, world).refused
    any_share = SingleFrameOptions(found_again=0.0)
    assert locate_frames(poses, few, world, single=any_share).refused == ""


def test_a_photo_of_one_wall_needs_the_intrinsics():
    """Seen from the front, its distance and the focal length change the image alike."""
    world, truth, poses, features = unposed(6, points=3000)
    photo = features[5:6]
    refused = locate_frames(poses, photo, world).refused
    assert refused.endswith("do not determine the focal length; give --camera")
    known = locate_frames(poses, photo, world, CAMERA)
    assert known.refused == ""
    np.testing.assert_allclose(known.poses.cam_from_world[5], truth[5], atol=0.03)


def test_the_sigma_of_the_focal_length_agrees_with_its_errors():
    ratios = []
    for seed in range(12):
        world, _, _, features = unposed(seed, count=3, points=2500, depth=0.4, noise_px=1.0)
        matcher = PointMatcher(world, PlacementOptions())
        for image in features:
            found = matcher.solve(image, *matcher.match(image), GUESS, free_focal=True)
            camera, sigma = common_camera([found], GUESS, world.xyz, SingleFrameOptions())
            ratios.append((camera.params[0] / CAMERA.params[0] - 1) / sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6  # of 36


def test_the_most_certain_focal_lengths_are_taken():
    world, _, poses, features = unposed(10, count=4, points=2500, depth=0.4)
    images = list(locate_frames(poses, features, world, CAMERA).components[0].images)
    short = slice(None, None, 5)
    fewer = {"xy": images[0].xy[short], "point": images[0].point[short]}
    images[0] = dataclasses.replace(images[0], focal=600.0, **fewer)
    camera, sigma = common_camera(images, GUESS, world.xyz, SingleFrameOptions(for_focal=2))
    assert camera.params[0] == 520.0 and 0 < sigma < 0.02
    assert common_camera([], GUESS, world.xyz, SingleFrameOptions()) == (GUESS, np.inf)
