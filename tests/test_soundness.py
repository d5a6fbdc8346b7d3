"""What tells a sound model: the covariance of its cameras, and two mappers that agree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_consistency import Scene

from reobj.poses.mapping import _bundle_adjust
from reobj.poses.soundness import Part, confirmed, geometry_of
from reobj.poses.uncertainty import relative_centre_sigma

pycolmap = pytest.importorskip("pycolmap")


def centres_of(model):
    ids = sorted(model.reg_image_ids())
    return np.array([model.image(i).projection_center() for i in ids])


def noisy(scene, noise_px, seed):
    clean = scene.xy
    scene.xy = clean + np.random.default_rng(seed).normal(0, noise_px, clean.shape)
    model = scene.model()
    scene.xy = clean
    _bundle_adjust(model, False, False)
    return model


def test_the_sigma_of_centres_is_what_repeated_noise_shows():
    """80 adjustments with fresh noise, each brought to the truth by a similarity."""
    scene, truth = Scene(count=6, points=150), None
    off, told = [], []
    for seed in range(80):
        model = noisy(scene, 0.5, seed)
        told.append(relative_centre_sigma(model, False))
        found = centres_of(model)
        truth = centres_of(scene.model()) if truth is None else truth
        a, b = found - found.mean(0), truth - truth.mean(0)
        turn, _ = Rotation.align_vectors(b, a)
        a = turn.apply(a)
        off.append(a * (a * b).sum() / (a**2).sum() - b)
    extent = np.linalg.norm(np.ptp(truth, axis=0))
    shown = np.sqrt((np.array(off) ** 2).sum(2).mean(0)).max() / extent
    assert np.median(told) == pytest.approx(shown, rel=0.3)


def test_less_parallax_and_a_free_focal_length_are_less_sure():
    far, near = Scene(count=6, points=150), Scene(count=6, points=150)
    rotation = far.truth[:, :, :3]
    centre = -np.einsum("nji,nj->ni", rotation, far.truth[:, :, 3])
    near.poses = near.truth = np.concatenate([rotation, -rotation @ (0.2 * centre)[:, :, None]], 2)
    near.xy = np.array([near.project(pose)[0] for pose in near.truth])
    near.seen = far.seen & np.array([near.project(pose)[1] for pose in near.truth])
    sure, unsure = (relative_centre_sigma(noisy(s, 0.5, 0), False) for s in (far, near))
    assert unsure > 3 * sure
    assert relative_centre_sigma(noisy(near, 0.5, 0), True) > unsure


def test_what_nothing_determines_is_infinite():
    scene = Scene(count=6, points=150)
    scene.seen[:, 2:] = False  # two points
    assert relative_centre_sigma(scene.model(), False) == np.inf
    assert relative_centre_sigma(pycolmap.Reconstruction(), False) == np.inf


# ---- Two mappers ---------------------------------------------------------------------------------


def part(model, sigma, problem=""):
    return Part(model, geometry_of(model), 1.0, 20.0, sigma, 1000, problem)


def moved(step_m=0.0, turn_deg=0.0, count=12):
    """The scene in another world and scale; one camera is off."""
    scene = Scene(count=count)
    turn = Rotation.from_rotvec([0, np.radians(turn_deg), 0]).as_matrix()
    scene.poses = scene.truth.copy()
    scene.poses[3, :, 3] -= scene.truth[3, :, :3] @ [0, step_m, 0]
    scene.poses[3] = turn @ scene.poses[3]
    model = scene.model()
    there = pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3, 0.9])), [3.0, -1, 2])
    model.transform(there)
    return model


@pytest.mark.parametrize(
    "other, sure",
    [
        (dict(), True),
        (dict(step_m=0.08), True),  # 3 % of the path
        (dict(step_m=0.5), False),
        (dict(turn_deg=3), True),
        (dict(turn_deg=8), False),
        (dict(count=7), False),  # half of the images
    ],
)
def test_weak_geometry_needs_the_same_from_another_mapper(other, sure):
    weak = part(Scene().model(), 0.002)
    (found,) = confirmed([weak], [part(moved(**other), 0.002)], 0.001)
    assert (not found.problem) == sure and ("parallax" in found.problem) != sure


def test_strong_geometry_needs_nobody_and_a_problem_stays():
    strong, bad = part(Scene().model(), 0.0005), part(Scene().model(), 0.0005, "too few points")
    first, second = confirmed([bad, strong], [], 0.001)
    assert first is strong and second is bad
