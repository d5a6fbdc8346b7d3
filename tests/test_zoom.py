"""Zoom detection: each image is compared with its neighbours on one side."""

from __future__ import annotations

import numpy as np
import pytest
from test_consistency import CAMERA, Scene

from reobj.poses.bundle import read_arrays
from reobj.poses.verification import constant_focal


def views_of(zoomed=range(0), ratio=1.0, noise_px=0.3, points=900):
    """A walk whose model is right, except for an interval of images at another focal length.

    Those images are rendered with that focal length, and their poses are shifted by the distance
    that compensates it best: the model of a mapper with a single focal length.
    """
    scene = Scene(count=20)
    centre = np.array([CAMERA.principal_point_x, CAMERA.principal_point_y])
    scene.poses = scene.truth.copy()
    for image in zoomed:
        scene.xy[image] = centre + (scene.xy[image] - centre) * ratio
        inside = ((scene.xy[image] > 0) & (scene.xy[image] < (640, 480))).all(1)
        scene.seen[image] &= inside
        scene.poses[image, 2, 3] -= 4.2 * (1 - 1 / ratio)  # the wall is 3.5 to 5 m away
    scene.xy = scene.xy + np.random.default_rng(0).normal(0, noise_px, scene.xy.shape)
    scene.seen[:, points:] = False
    return read_arrays(scene.model())


@pytest.mark.parametrize("ratio", [1.3, 1 / 1.3])
def test_images_of_another_focal_length_are_detected(ratio):
    """Between two near changes no focal length can be measured from one side alone."""
    views = views_of(range(7, 13), ratio)
    others, changes = constant_focal([views])
    assert others.tolist() == list(range(8, 21))  # the first of equal sides is kept
    assert [(a, b) for a, b, _ in changes] == [(7, 8), (13, 14)]
    np.testing.assert_allclose([r for _, _, r in changes], [ratio, 1 / ratio], rtol=0.1)
    narrow, _ = constant_focal([views], window=6)  # both sides of it are measured separately
    assert narrow.tolist() == list(range(8, 14))


def test_the_focal_length_of_most_images_is_kept():
    assert constant_focal([views_of(range(6, 20), 1.3)])[0].tolist() == list(range(1, 7))


@pytest.mark.parametrize(
    "ratio, noise_px, points",
    [(1.0, 1.0, 900), (1.04, 1.0, 900), (1.3, 0.3, 30)],  # focus breathing; too few points
)
def test_what_is_no_zoom(ratio, noise_px, points):
    others, changes = constant_focal([views_of(range(7, 13), ratio, noise_px, points)])
    assert len(others) == 0 and changes == []


def test_models_are_checked_individually():
    one, other = views_of(), views_of(range(7, 13), 1.3)
    assert constant_focal([one])[1] == [] and len(constant_focal([one, other])[1]) == 2
