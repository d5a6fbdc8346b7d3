"""Fit the ellipsoids of a video by published closed forms instead of `quadrics.fit_objects`.

Identities, cameras, gravity and scale stay those that `link_and_fit` found: the solvers know none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

import quadrics
from reobj.cameras import Poses, import_pycolmap, triangulate_rays
from reobj.objects.description import MIN_SCORE, OURS, ObjectsConfig, describe_objects, name_of
from reobj.objects.observations import Views, gather_views
from reobj.results.result import Object, Result
from reobj.types import Array, BoolArray, object_classes

NO_SCALE = quadrics.Scale(1.0, 0.0, "none")
# views, their cameras, categories -> ellipsoids of the G groups (NaN: none), why others have none
Solved = tuple[quadrics.Ellipsoids, str]
Solver = Callable[[Views, Poses, Sequence[str], quadrics.Priors], Solved]


def solve_again(result: Result, config: ObjectsConfig) -> None:
    """Replace the solids of all objects by the ellipsoids of `config.solver`: in place.

    Sets objects, fits (None: these are no `ObjectFits` of ours) and a warning that says what the
    solver does not know. Without cameras, and of "solids", all stays.
    """
    if config.solver == OURS or result.poses is None or result.fits is None:
        return
    solve, text = SOLVERS[config.solver]
    priors, objects = quadrics.load_priors(config.priors or None), list[Object]()
    for k, part in enumerate(result.world.parts):
        before = {o.id: o for o in result.objects if o.part == k}
        rows = result.tracks[np.isin(result.tracks.track_id, list(before))]
        poses, classes = result.poses.of_part(k), object_classes(rows)
        if not len(rows) or not poses.known.any():
            objects += before.values()
            continue
        group = np.searchsorted(list(classes), rows.track_id)
        views = gather_views(rows, poses, group, len(classes), MIN_SCORE)
        names = [name_of(result.class_names, c) for c in classes.values()]
        solids, why = solve(views, poses, names, priors)
        solids = _vertical_axis_last(solids, part.up_in_world)
        scale = NO_SCALE if config.solver == "sfmo" or part.scale is None else part.scale
        parallax = [before[i].parallax_deg for i in classes]
        fits = _as_fits(solids, views, np.array(parallax, np.float64), scale, why)
        sure = {i: o.confidence for i, o in before.items() if o.confidence is not None}
        found = describe_objects(rows, result.class_names, fits, views, config, sure)
        objects += [dataclasses.replace(o, part=k) for o in found]
    result.objects, result.fits = sorted(objects, key=lambda o: o.id), None
    result.warnings.append(f"objects.solver={config.solver}: {text}")


def _lfd(views: Views, poses: Poses, names: Sequence[str], priors: quadrics.Priors) -> Solved:
    """Solve each object's dual quadric in closed form; of no ellipsoid the axes are NaN."""
    dual_q, real = quadrics.fit_lfd(views.boxes, views.img_from_world)
    solids = quadrics.Ellipsoids.from_dual_quadrics(dual_q)[0]
    return _only(solids, real), "what LfD finds is no ellipsoid"


def _psfmo(views: Views, poses: Poses, names: Sequence[str], priors: quadrics.Priors) -> Solved:
    """Draw the axis ratios from the category, the cameras known and linearised at each object."""
    found = quadrics.fit_psfmo(views.boxes, priors, names, views.img_from_world)
    return found.ellipsoids, "PSfMO finds no ellipsoid"


def _sfmo(views: Views, poses: Poses, names: Sequence[str], priors: quadrics.Priors) -> Solved:
    """Factorise the boxes, and lay the result on the points that the cameras give.

    The affine frame is free up to a similarity and a mirror image: those of least squared distance
    of the centres from where the viewing rays of the boxes' centres meet. Ref: Umeyama, PAMI 1991.
    """
    found = quadrics.fit_sfmo(views.boxes)
    target = _ray_points(views, poses)  # (G, 3)
    use = np.isfinite(target).all(1) & np.isfinite(found.ellipsoids.center_in_world).all(1)
    best, least = None, np.inf
    for twin in (found.ellipsoids, found.mirrored) if use.sum() >= 3 else ():
        sim = import_pycolmap().estimate_sim3d(twin.center_in_world[use], target[use])
        if sim is None:
            continue
        turn, scale = np.asarray(sim.rotation.matrix()), float(sim.scale)
        center = scale * twin.center_in_world @ turn.T + np.asarray(sim.translation)
        error = float(((center - target)[use] ** 2).sum())
        if error < least:
            half, axes = scale * twin.half_axes, turn @ twin.world_from_obj
            best, least = quadrics.Ellipsoids(center, half, axes), error
    if best is None:
        nothing = np.zeros(len(target), bool)
        return _only(found.ellipsoids, nothing), f"SfMO: {found.note}"
    return _only(best, found.is_ellipsoid), "what SfMO finds is no ellipsoid"


def _only(solids: quadrics.Ellipsoids, good: BoolArray) -> quadrics.Ellipsoids:
    """Take away the axes (NaN) of what is no ellipsoid; good: (O,)."""
    return dataclasses.replace(solids, half_axes=np.where(good[:, None], solids.half_axes, np.nan))


def _ray_points(views: Views, poses: Poses) -> Array:
    """Triangulate the centres (G, 3) of the boxes of each group, NaN with fewer than two."""
    points = np.full((views.boxes.shape[1], 3), np.nan)
    cam_from_world = poses.cam_from_world[poses.known]  # (V, 3, 4)
    for g in range(len(points)):
        seen = np.isfinite(views.boxes[:, g, 0])
        if seen.sum() >= 2:
            middle = (views.boxes[seen, g, :2] + views.boxes[seen, g, 2:]) / 2
            ray = np.c_[middle, np.ones(len(middle))] @ np.linalg.inv(poses.camera.K).T
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            points[g] = triangulate_rays(cam_from_world[seen], ray)[2]
    return points


def _vertical_axis_last(solids: quadrics.Ellipsoids, up: Array | None) -> quadrics.Ellipsoids:
    """Name the axes anew, so that the third is the one nearest to up, as in our own solids."""
    if up is None:
        return solids
    along = np.einsum("oij,i->oj", np.nan_to_num(solids.world_from_obj), up)  # (O, 3)
    last = np.abs(along).argmax(1)
    order = (last[:, None] + np.array([1, 2, 3])) % 3  # cyclic: stays right-handed
    sign = np.ones((len(order), 3))
    sign[:, [0, 2]] = np.where(along[np.arange(len(last)), last] < 0, -1.0, 1.0)[:, None]
    axes = np.take_along_axis(solids.world_from_obj, order[:, None], 2) * sign[:, None]
    half = np.take_along_axis(solids.half_axes, order, 1)
    return dataclasses.replace(solids, half_axes=half, world_from_obj=axes)


def _as_fits(
    solids: quadrics.Ellipsoids, views: Views, parallax: Array, scale: quadrics.Scale, why: str
) -> quadrics.ObjectFits:
    """Describe ellipsoids as a fit without covariance, in which every box counts."""
    arrays = (solids.center_in_world, solids.half_axes, solids.world_from_obj.reshape(-1, 9))
    finite = np.isfinite(np.concatenate(arrays, 1))  # (O, 15)
    good: BoolArray = np.all(finite, 1) & np.all(solids.half_axes > 0, 1)  # (O,)
    n = len(finite)
    return quadrics.ObjectFits(
        solids, 2 * solids.half_axes, np.full((n, 9, 9), np.nan), np.full(n, "ellipsoid"),
        np.ones(views.boxes.shape[:2], bool), np.full(n, np.nan),
        np.where(good, "ok", "rejected"), ["" if g else why for g in good.tolist()],
        parallax, np.full((n, 3), np.nan), scale, np.zeros(3), "none",
    )  # fmt: skip


NO_SIGMA = "no priors, no test of outliers, no uncertainty"
SOLVERS: dict[str, tuple[Solver, str]] = {
    "lfd": (_lfd, f"ellipsoids in closed form, in the units of the cameras; {NO_SIGMA}"),
    "sfmo": (
        _sfmo,
        "shapes from boxes alone, by affine cameras, without metric meaning (size_m is null); "
        "place, turn, size and mirror image are those that fit the cameras best",
    ),
    "psfmo": (
        _psfmo,
        "axis ratios from the category, cameras linearised at each object, in their units; only "
        "the ratios are a prior, sizes are not; no test of outliers, no uncertainty",
    ),
}
