"""The published solvers on an output folder: right ellipsoids, the same files."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import CUP, looking_at, unlinked, walk

import quadrics
import reobj_track as rt
from reobj.objects.config import make_fit, solve_again
from reobj.objects.fit import link_and_fit

CAMERA = rt.Camera("PINHOLE", 640, 480, (2600.0, 2600.0, 320.0, 240.0))


def truth(mirror: int = 1) -> quadrics.Ellipsoids:
    """Six upright ellipsoids in a room of 2 m; -1: its mirror image."""
    rng = np.random.default_rng(3)
    center = rng.uniform(-1, 1, (6, 3)) * [mirror, 1, 0.6]
    return quadrics.Ellipsoids(center, rng.uniform(0.1, 0.3, (6, 3)), np.tile(np.eye(3), (6, 1, 1)))


def recorded(mirror: int = 1) -> rt.Result:
    """Exact boxes of them, from a camera 14 m away that moves around, up and down."""
    angle = np.radians(np.linspace(-70, 70, 30))
    height = 4 + 4 * np.sin(3 * angle)
    eyes = np.stack([14 * mirror * np.sin(angle), -14 * np.cos(angle), height], 1)
    cams = np.stack([looking_at(eye, np.zeros(3)) for eye in eyes])
    poses = dataclasses.replace(walk(30), camera=CAMERA, cam_from_world=cams)
    boxes = quadrics.solid_boxes(truth(mirror), "ellipsoid", CAMERA.K @ cams)  # (30, 6, 4)
    row, item = np.divmod(np.arange(180), 6)
    columns = (boxes.reshape(-1, 4), np.full(180, 0.9), np.full(180, CUP), item)
    result = unlinked(poses, rt.Tracks(poses.frame[row], item + 1, item + 1, *columns))
    return dataclasses.replace(result, identities_given=True)


def solved(result: rt.Result, solver: str) -> rt.Result:
    return solve_again(result, rt.ObjectsConfig(support="ellipsoid", solver=solver))


@pytest.fixture(scope="module", params=[1, -1])  # affine views are ambiguous
def room(request: pytest.FixtureRequest) -> tuple[rt.Result, quadrics.Ellipsoids]:
    mirror = request.param
    fitted = link_and_fit(recorded(mirror), rt.ObjectsConfig(support="ellipsoid"))
    return fitted, truth(mirror)


@pytest.mark.parametrize(
    ("solver", "overlap", "metric"),  # mean O3D: boxes leave the rotation of the ellipse free
    [("lfd", 0.8, True), ("psfmo", 0.75, True), ("sfmo", 0.6, False)],
)
def test_each_solver_finds_the_ellipsoids(
    room: tuple[rt.Result, quadrics.Ellipsoids], solver: str, overlap: float, metric: bool
) -> None:
    """Values that it does not estimate are null: the covariance, metres of SfMO, with a warning."""
    ours, true = room
    assert solved(ours, "solids") is ours and ours.fits is not None
    result = solved(ours, solver)
    assert [o.status for o in result.objects] == ["ok"] * 6
    found = result.ellipsoids()
    assert quadrics.volume_overlap(found, true).mean() > overlap
    assert np.abs(found.half_axes - ours.ellipsoids().half_axes).max() > 1e-3
    (warning,) = result.warnings
    assert f"objects.solver={solver}" in warning
    assert ("without metric meaning" in warning) == (not metric)
    assert repr(result.world) == repr(ours.world)
    for o, own in zip(result.objects, ours.objects, strict=True):
        _, x, y, _ = o.quat_wxyz  # the vertical axis is the third, and points up
        assert 1 - 2 * (x * x + y * y) > 0.7
        assert o.cov is None and o.size_rel_sigma is None and o.support == "ellipsoid"
        assert (o.size_m is not None) == metric and o.size is not None
        assert (o.id, o.visits, o.views) == (own.id, own.visits, own.views)
        assert o.parallax_deg == own.parallax_deg and o.reprojection_iou_median > 0.7


def test_sfmo_of_three_objects_reports_its_requirement() -> None:
    result = recorded()
    result = dataclasses.replace(result, tracks=result.tracks[result.tracks.track_id <= 3])
    result = solved(link_and_fit(result, rt.ObjectsConfig(support="ellipsoid")), "sfmo")
    assert {o.status for o in result.objects} == {"rejected"}
    assert {o.reason for o in result.objects} == {
        "SfMO: needs at least 3 frames that show the same 4 objects"
    }
    assert all(o.center is None for o in result.objects)


def test_unknown_solver() -> None:
    with pytest.raises(rt.ReobjError, match="--solver dlt: expected solids or lfd, sfmo, psfmo"):
        make_fit(rt.ObjectsConfig(solver="dlt"), walk(3), ("cup",))
