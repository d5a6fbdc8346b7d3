"""Soundness of a model: covariance of its cameras, and agreement of two mappers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_consistency import Scene

from reobj.cameras import invert_rigid
from reobj.poses.bundle import adjusted, read_arrays, refine, relative_sigmas, submodel
from reobj.poses.mapping import models_of_one_camera
from reobj.poses.verification import JOINT_POINTS, Component, FocalSource, confirmed

pycolmap = pytest.importorskip("pycolmap")


def centres_of(model):
    ids = sorted(model.reg_image_ids())
    return np.array([model.image(i).projection_center() for i in ids])


def true_centres(scene):
    return invert_rigid(scene.truth)[:, :, 3]


def seen_from(scene, centre, rotation=None, noise_px=0.0):
    """Move the cameras of a scene to centres (F, 3); what they see, with noise."""
    rotation = scene.truth[:, :, :3] if rotation is None else rotation
    scene.poses = scene.truth = np.append(rotation, -rotation @ centre[:, :, None], 2)
    scene.xy = np.array([scene.project(pose)[0] for pose in scene.truth])
    scene.seen = np.array([scene.project(pose)[1] for pose in scene.truth])
    scene.xy = scene.xy + np.random.default_rng(0).normal(0, noise_px, scene.xy.shape)


def noisy(scene, noise_px, seed):
    clean = scene.xy
    scene.xy = clean + np.random.default_rng(seed).normal(0, noise_px, clean.shape)
    model = scene.model()
    scene.xy = clean
    refine(model)
    return model


def test_the_sigma_of_centres_equals_that_of_repeated_noise():
    """40 adjustments with new noise, each aligned to the truth by a similarity."""
    scene, truth = Scene(count=6, points=150), None
    off, estimated = [], []
    for seed in range(40):
        model = noisy(scene, 0.5, seed)
        estimated.append(relative_sigmas(read_arrays(model), False)[0])
        found = centres_of(model)
        truth = centres_of(scene.model()) if truth is None else truth
        a, b = found - found.mean(0), truth - truth.mean(0)
        turn, _ = Rotation.align_vectors(b, a)
        a = turn.apply(a)
        off.append(a * (a * b).sum() / (a**2).sum() - b)
    extent = np.linalg.norm(np.ptp(truth, axis=0))
    shown = np.sqrt((np.array(off) ** 2).sum(2).mean(0)).max() / extent
    assert np.median(estimated) == pytest.approx(shown, rel=0.3)


def test_less_parallax_and_a_free_focal_length_increase_the_sigma():
    far, near = Scene(count=6, points=150), Scene(count=6, points=150)
    seen_from(near, 0.2 * true_centres(far))
    near.seen &= far.seen
    small, large = (relative_sigmas(read_arrays(noisy(s, 0.5, 0)), False)[0] for s in (far, near))
    assert large > 3 * small
    assert relative_sigmas(read_arrays(noisy(near, 0.5, 0)), True)[0] > large


def test_undetermined_sigmas_are_infinite():
    scene = Scene(count=6, points=150)
    scene.seen[:, 2:] = False  # two points
    assert relative_sigmas(read_arrays(scene.model()), False)[0] == np.inf
    assert relative_sigmas(read_arrays(Scene(count=2).model()), False)[0] == np.inf


@pytest.mark.parametrize("turns", [True, False])
def test_a_focal_length_is_accepted_if_determined_by_the_views(turns):
    """It is for a walk with camera shake; a dolly fits any focal length by scaling the depths."""
    scene = Scene(count=8, points=400)
    turn = None if turns else np.broadcast_to(np.eye(3), (8, 3, 3))
    seen_from(scene, true_centres(scene), turn, noise_px=0.3)
    model = scene.model()
    model.camera(1).model = pycolmap.CameraModelId.SIMPLE_RADIAL
    model.camera(1).params = [550.0, 320, 240, 0]  # a tenth too long
    found = adjusted(model, True)
    assert found.calibrated == turns
    assert found.arrays.focal == (pytest.approx(500, rel=0.02) if turns else 550)
    assert found.centre_sigma < np.inf


def test_coincident_cameras_do_not_fix_the_scale():
    """Their distance is noise only, so it must not be the gauge."""
    scene = Scene(count=8, points=400)
    centre = true_centres(scene)
    centre[1:3] = centre[0] + np.array([[1e-5, 0, 0], [0, 1e-5, 0]])
    seen_from(scene, centre, noise_px=0.5)
    model = scene.model()
    model.camera(1).focal_length *= 1.02  # the camera of a larger component
    refine(model)
    step = np.linalg.norm(np.diff(centres_of(model), axis=0), axis=1)
    true = np.linalg.norm(np.diff(centre, axis=0), axis=1)
    assert step[3:] / step[3] == pytest.approx(true[3:] / true[3], rel=0.05)
    assert step[:2].max() < 0.05 * step[3:].min()


# ---- Two mappers ---------------------------------------------------------------------------------


def component(model, sigma, problem=""):
    arrays = read_arrays(model)
    measures = 10.0, 1.0, 20.0, sigma, 1000
    return Component(model, arrays, FocalSource.MODEL, *measures, problem, arrays.ids)


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
    "other, sound",
    [
        (dict(), True),
        (dict(step_m=0.08), True),  # 3 % of the path
        (dict(step_m=0.5), False),
        (dict(turn_deg=3), True),
        (dict(turn_deg=8), False),
        (dict(count=7), False),  # half of the images
    ],
)
def test_weak_geometry_needs_agreement_of_another_mapper(other, sound):
    weak = component(Scene().model(), 0.002)
    second = component(moved(**other), 0.002)
    (found,) = confirmed([weak], [second], FocalSource.MATCHES)
    assert (not found.problem) == sound and ("parallax" in found.problem) != sound


def piece(first, last):
    """Some images of the scene in a world and scale of their own."""
    model = moved()
    model.transform(pycolmap.Sim3d(1 + 0.1 * first, pycolmap.Rotation3d(), [first, 0, 0]))
    return component(submodel(model, set(range(first, last))), 0.002)


@pytest.mark.parametrize(
    "ends, count, sound",
    [
        ([(1, 7), (7, 13)], None, True),  # two pieces, by all common points
        ([(7, 13), (1, 4), (4, 7)], None, True),  # in any order
        ([(1, 7), (7, 13)], JOINT_POINTS, True),
        ([(1, 7), (7, 13)], JOINT_POINTS - 1, False),
        ([(1, 7), (8, 13)], None, True),  # without an image
        ([(1, 5), (9, 13)], None, False),  # without a third of them
        ([(1, 9), (9, 11)], None, False),  # the scale of a pair is arbitrary
    ],
)
def test_pieces_of_another_mapper_count_if_points_connect_them(ends, count, sound):
    scene = Scene()
    if count is not None:  # other common points are split into two
        arrays, seen = read_arrays(scene.model()), scene.seen
        joint = arrays.triangulated_by(np.arange(6)) & arrays.triangulated_by(np.arange(6, 12))
        ids = np.flatnonzero(seen.sum(0) >= 2)[joint]  # as the model has them
        both = np.flatnonzero(seen[:6].any(0) & seen[6:].any(0))
        scene.untie(6, int(np.flatnonzero(both == ids[count])[0]))
    weak = component(scene.model(), 0.002)
    (found,) = confirmed([weak], [piece(*end) for end in ends], FocalSource.MATCHES)
    assert (not found.problem) == sound
    if sound:  # only images of both stay
        assert set(found.kept) == {i for end in ends for i in range(*end)}


@pytest.mark.parametrize("turn_deg, images", [(0.0, 12), (2.0, 12), (6.0, 11)])
def test_rotations_of_two_mappers_that_agree_give_directions(turn_deg, images):
    """The other mapper has one camera elsewhere, turned by an angle."""
    weak = component(Scene().model(), 0.02)
    (found,) = confirmed([weak], [component(moved(3.0, turn_deg), 0.02)], FocalSource.MATCHES)
    assert found.problem and found.is_weak and len(found.kept) == images
    assert np.radians(0.05) < found.direction_sigma < np.radians(1)


def test_rotations_that_differ_give_nothing():
    weak = component(Scene().model(), 0.02)
    other = moved(3.0)
    for number in range(1, 13, 2):
        image = other.image(number)
        turned = pycolmap.Rigid3d(pycolmap.Rotation3d([0.2, 0, 0]), np.zeros(3))
        pose = turned * image.cam_from_world()
        other.frame(image.frame_id).rig_from_world = pose
    (found,) = confirmed([weak], [component(other, 0.02)], FocalSource.MATCHES)
    assert found.problem and found.direction_sigma == 0
    (sound,) = confirmed([component(Scene().model(), 0.0005)], [], FocalSource.MATCHES)
    assert not sound.problem and sound.direction_sigma == 0


def test_images_missing_in_the_other_mapper_are_dropped():
    weak = component(Scene().model(), 0.002)
    (found,) = confirmed([weak], [piece(1, 11)], FocalSource.MATCHES)
    (model,) = models_of_one_camera([found])
    assert not found.problem and sorted(model.reg_image_ids()) == list(range(1, 11))
    (model,) = models_of_one_camera([weak])
    assert len(model.reg_image_ids()) == 12


def test_points_are_triangulated_by_images_whose_rays_spread():
    scene = Scene(count=4, points=50)
    scene.seen[:] = True
    scene.poses[1] = scene.poses[0]  # from one position
    scene.seen[3, 10:] = False
    mark = read_arrays(scene.model()).triangulated_by
    assert [mark(np.array(rows)).sum() for rows in ([0], [0, 1], [0, 2], [2, 3])] == [0, 0, 50, 10]


@pytest.mark.parametrize(
    "sigma, source, others, sound",
    [
        (0.005, FocalSource.MATCHES, True, True),
        (0.005, FocalSource.GUESS, True, False),  # both came to the same wrong scale
        (0.003, FocalSource.GUESS, True, True),
        (0.003, FocalSource.GUESS, False, False),
        (0.0005, FocalSource.GUESS, False, True),  # strong geometry
    ],
)
def test_what_needs_confirmation(sigma, source, others, sound):
    """Problems remain, and sound components come first."""
    bad = component(Scene().model(), 0.0005, "too few points")
    second = [component(moved(), 0.002)] * others
    *_, last = found = confirmed([bad, component(Scene().model(), sigma)], second, source)
    assert [not c.problem for c in found].count(True) == sound and last.problem
