"""Zoom detection: each image is compared with its neighbours on one side."""

from __future__ import annotations

import numpy as np
import pytest
from test_consistency import CAMERA, Scene

from reobj.poses import verification
from reobj.poses.bundle import read_arrays
from reobj.poses.verification import ZoomOptions, constant_focal


def zoomed_scene(zoomed, ratio, seed=0, noise_px=0.3):
    """A walk whose model is right, except for an interval of images at another focal length.

    Those images are rendered with that focal length, and their poses are shifted by the distance
    that compensates it best: the model of a mapper with a single focal length.
    """
    scene = Scene(count=20, seed=seed)
    centre = np.array([CAMERA.principal_point_x, CAMERA.principal_point_y])
    scene.poses = scene.truth.copy()
    for image in zoomed:
        scene.xy[image] = centre + (scene.xy[image] - centre) * ratio
        inside = ((scene.xy[image] > 0) & (scene.xy[image] < (640, 480))).all(1)
        scene.seen[image] &= inside
        scene.poses[image, 2, 3] -= 4.2 * (1 - 1 / ratio)  # the wall is 3.5 to 5 m away
    scene.xy = scene.xy + np.random.default_rng(seed).normal(0, noise_px, scene.xy.shape)
    return scene


def views_of(*scene, **options):
    return read_arrays(zoomed_scene(*scene, **options).model())


@pytest.mark.parametrize("ratio", [1.3, 1 / 1.3])
def test_images_of_another_focal_length_are_detected(ratio):
    others, changes = constant_focal([views_of(range(7, 13), ratio)])
    assert set(range(8, 14)) <= set(others.tolist())
    assert [(a, b) for a, b, _ in changes] == [(7, 8), (13, 14)]
    np.testing.assert_allclose([r for _, _, r in changes], [ratio, 1 / ratio], rtol=0.1)


@pytest.mark.parametrize("log, sigma, found", [(0.3, 0.03, 1), (0.2, 0.01, 0), (0.3, 0.07, 0)])
def test_evidence_of_one_side_must_be_stronger(monkeypatch, log, sigma, found):
    """Earlier images give another focal length for one image; later ones give none."""
    views = views_of(range(0), 1.0)

    def log_focal(arrays, image, side):
        if side.start > image:
            return np.nan, np.nan
        return (log, sigma) if image == 13 else (0.0, 0.003)

    monkeypatch.setattr(verification, "_triangulate", lambda arrays, terms, side: side)
    monkeypatch.setattr(verification, "_log_focal", log_focal)
    assert [(a, b) for a, b, _ in verification._changes(views, ZoomOptions(resected=1))] == [
        (13, 14)
    ] * found


def test_the_focal_length_of_most_images_is_kept():
    others, _ = constant_focal([views_of(range(6, 20), 1.3)])
    assert others.tolist() == list(range(1, 7))


@pytest.mark.parametrize("ratio", [1.0, 1.04])
def test_one_focal_length_is_no_zoom(ratio):
    """Also with focus breathing of a few per cent."""
    others, changes = constant_focal([views_of(range(7, 13), ratio, noise_px=1.0)])
    assert len(others) == 0 and changes == []


def test_a_short_zoom_separates_its_two_sides():
    """Between two near changes no focal length can be measured from one side alone."""
    views = views_of(range(7, 13), 1.3)
    assert constant_focal([views])[0].tolist() == list(range(8, 21))  # the first of equal sides
    narrow = ZoomOptions(window=6)  # both sides of it are measured separately
    assert constant_focal([views], narrow)[0].tolist() == list(range(8, 14))


def test_models_are_checked_individually():
    one, other = views_of(range(0), 1.0), views_of(range(7, 13), 1.3)
    assert constant_focal([one])[1] == [] and len(constant_focal([one, other])[1]) == 2
    assert constant_focal([])[0].tolist() == []


def test_too_few_points_give_no_zoom():
    scene = zoomed_scene(range(7, 13), 1.3)
    scene.seen[:, 30:] = False
    assert constant_focal([read_arrays(scene.model())])[1] == []
