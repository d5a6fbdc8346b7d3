"""The published solvers on an output folder: right ellipsoids, the same files."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from simulated import CUP, looking_at, unlinked, walk

import quadrics
import reobj_track as rt
from reobj.objects.config import solve_again
from reobj.objects.fit import link_and_fit

CAMERA = rt.Camera("PINHOLE", 640, 480, (2600.0, 2600.0, 320.0, 240.0))


def truth(mirror: int = 1) -> quadrics.Ellipsoids:
    """Six upright ellipsoids in a room of 2 m; -1: its mirror image."""
    rng = np.random.default_rng(3)
    center = rng.uniform(-1, 1, (6, 3)) * [mirror, 1, 0.6]
    return quadrics.Ellipsoids(center, rng.uniform(0.1, 0.3, (6, 3)), np.tile(np.eye(3), (6, 1, 1)))


def recorded(shift: float = 0.0, mirror: int = 1) -> rt.Result:
    """Exact boxes of them, from a camera 14 m away that moves around, up and down.

    (shift: of one edge, px; mirror: -1 for the mirror image of all.)
    """
    angle = np.radians(np.linspace(-70, 70, 30))
    height = 4 + 4 * np.sin(3 * angle)
    eyes = np.stack([14 * mirror * np.sin(angle), -14 * np.cos(angle), height], 1)
    cams = np.stack([looking_at(eye, np.zeros(3)) for eye in eyes])
    still = walk(30)
    poses = dataclasses.replace(still, camera=CAMERA, cam_from_world=cams)
    boxes = quadrics.solid_boxes(truth(mirror), "ellipsoid", CAMERA.K @ cams)  # (30, 6, 4)
    boxes[..., 2] += shift
    row, item = np.divmod(np.arange(180), 6)
    columns = (boxes.reshape(-1, 4), np.full(180, 0.9), np.full(180, CUP), item)
    result = unlinked(poses, rt.Tracks(poses.frame[row], item + 1, item + 1, *columns))
    result = dataclasses.replace(result, identities_given=True)
    return result


def solved(result: rt.Result, **options: object) -> rt.Result:
    config = rt.ObjectsConfig(support="ellipsoid", **options)  # type: ignore[arg-type]
    return solve_again(link_and_fit(result, config), config)


@pytest.mark.parametrize(
    ("solver", "overlap"),  # mean O3D: boxes leave the rotation of the ellipse free
    [("lfd", 0.8), ("psfmo", 0.75), ("sfmo", 0.6)],
)
@pytest.mark.parametrize("mirror", [1, -1])  # affine views are ambiguous
def test_each_solver_finds_the_ellipsoids(solver: str, overlap: float, mirror: int) -> None:
    result = solved(recorded(mirror=mirror), solver=solver)
    assert [o.status for o in result.objects] == ["ok"] * 6
    found = result.ellipsoids()
    assert quadrics.volume_overlap(found, truth(mirror)).mean() > overlap
    for o in result.objects:  # the vertical axis is the third, and points up
        _, x, y, _ = o.quat_wxyz
        assert 1 - 2 * (x * x + y * y) > 0.7


def test_values_that_a_solver_does_not_estimate_are_null() -> None:
    """No covariance; the size of SfMO is not metric, with a warning."""
    ours = solved(recorded(), solver="solids")
    assert ours.warnings == [] and ours.fits is not None
    for solver, metres in (("lfd", True), ("psfmo", True), ("sfmo", False)):
        result = solved(recorded(), solver=solver)
        assert len(result.warnings) == 1 and f"objects.solver={solver}" in result.warnings[0]
        assert ("without metric meaning" in result.warnings[0]) == (not metres)
        assert repr(result.world) == repr(ours.world)
        for o, own in zip(result.objects, ours.objects, strict=True):
            assert o.cov is None and o.size_rel_sigma is None and o.support == "ellipsoid"
            assert (o.size_m is not None) == metres and o.size is not None
            assert (o.id, o.visits, o.views) == (own.id, own.visits, own.views)
            assert o.parallax_deg == own.parallax_deg and o.reprojection_iou_median > 0.7


def test_the_solvers_differ() -> None:
    """Boxes that are too wide on one side give different results."""
    sizes = [solved(recorded(shift=15), solver=s).ellipsoids().half_axes
             for s in ("solids", "lfd", "psfmo", "sfmo")]  # fmt: skip
    for i, a in enumerate(sizes):
        assert all(np.abs(a - b).max() > 1e-3 for b in sizes[:i])


def test_sfmo_of_three_objects_reports_its_requirement() -> None:
    result = recorded()
    result = dataclasses.replace(result, tracks=result.tracks[result.tracks.track_id <= 3])
    result = solved(result, solver="sfmo")
    assert {o.status for o in result.objects} == {"rejected"}
    assert {o.reason for o in result.objects} == {
        "SfMO: needs at least 3 frames that show the same 4 objects"
    }
    assert all(o.center is None for o in result.objects)


def test_unknown_solver(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    shutil.copytree(room, out)
    before = (out / "objects.json").read_bytes()
    assert rt.main(["objects", str(out), "--solver", "dlt"]) == 2
    assert "--solver dlt: expected solids or lfd, sfmo, psfmo" in capsys.readouterr().err
    assert (out / "objects.json").read_bytes() == before
