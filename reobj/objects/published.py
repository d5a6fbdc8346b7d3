"""Fit the ellipsoids of a video by published closed-form solvers instead of `quadrics.fit_objects`.

Identities, cameras, gravity and scale remain those of `link_and_fit`: the solvers estimate none of
them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

import quadrics
from reobj.cameras import Poses, import_pycolmap, triangulate_rays
from reobj.objects.categories import name_of
from reobj.objects.config import ObjectsConfig, Solver
from reobj.objects.description import describe_objects
from reobj.objects.observations import MIN_SCORE, Views, gather_views
from reobj.results.result import Object, Result
from reobj.types import Array, BoolArray, object_classes

# views, their cameras, categories -> ellipsoids of the G groups (NaN: none), why others have none
Solved = tuple[quadrics.Ellipsoids, str]
Solve = Callable[[Views, Poses, Sequence[str], quadrics.Priors], Solved]


def solve_again(result: Result, config: ObjectsConfig) -> Result:
    """Replace the shapes of all objects by the ellipsoids of `config.solver`.

    Returns:
        the result with other objects, without fits (there are no `ObjectFits` of the default fit),
        and with a warning of the solver's limitations; unchanged for the default solver or without
        cameras.
    """
    if config.solver == Solver.SOLIDS or result.poses is None or result.fits is None:
        return result
    solve, text = SOLVERS[config.solver]
    priors = config.size_priors()
    objects = list[Object]()
    for k, component in enumerate(result.world.parts):
        before = {o.id: o for o in result.objects if o.part == k}
        rows = result.tracks[np.isin(result.tracks.track_id, list(before))]
        poses = result.poses.of_part(k)
        classes = object_classes(rows)
        if not len(rows) or not poses.known.any():
            objects += before.values()
            continue
        group = np.searchsorted(list(classes), rows.track_id)
        views = gather_views(rows, poses, group, len(classes), MIN_SCORE)
        names = [name_of(result.class_names, c) for c in classes.values()]
        ellipsoids, reason = solve(views, poses, names, priors)
        ellipsoids = _vertical_axis_last(ellipsoids, component.up_in_world)
        scale = quadrics.Scale(1.0, 0.0, "none")
        if config.solver != Solver.SFMO and component.scale is not None:
            scale = component.scale
        parallax = [before[i].parallax_deg for i in classes]
        fits = _as_fits(ellipsoids, views, np.array(parallax, np.float64), scale, reason)
        confidence = {i: o.confidence for i, o in before.items() if o.confidence is not None}
        objects += describe_objects(
            rows,
            result.class_names,
            fits,
            views,
            config,
            confidence,
            component=k,
            fps=result.video.fps,
        )
    warning = f"objects.solver={config.solver}: {text}"
    return dataclasses.replace(
        result,
        objects=sorted(objects, key=lambda o: o.id),
        fits=None,
        warnings=[*result.warnings, warning],
    )


def _lfd(views: Views, poses: Poses, names: Sequence[str], priors: quadrics.Priors) -> Solved:
    """Solve each object's dual quadric in closed form; the axes are NaN if it is no ellipsoid."""
    dual_q, real = quadrics.fit_lfd(views.boxes, views.img_from_world)
    ellipsoids = quadrics.Ellipsoids.from_dual_quadrics(dual_q)[0]
    return _only(ellipsoids, real), "the LfD solution is not an ellipsoid"


def _psfmo(views: Views, poses: Poses, names: Sequence[str], priors: quadrics.Priors) -> Solved:
    """Fit with axis-ratio priors of the category; cameras are linearised at each object."""
    found = quadrics.fit_psfmo(views.boxes, priors, names, views.img_from_world)
    return found.ellipsoids, "PSfMO found no ellipsoid"


def _sfmo(views: Views, poses: Poses, names: Sequence[str], priors: quadrics.Priors) -> Solved:
    """Factorise the boxes, and align the result with points triangulated by the cameras.

    The affine frame is determined up to a similarity and a reflection: those of least squared
    distance between the centres and the triangulated box centres. Ref: Umeyama, PAMI 1991.
    """
    found = quadrics.fit_sfmo(views.boxes)
    target = _triangulated_centers(views, poses)  # (G, 3)
    use = np.isfinite(target).all(1) & np.isfinite(found.ellipsoids.center_in_world).all(1)
    best = None
    least = np.inf
    for candidate in (found.ellipsoids, found.mirrored) if use.sum() >= 3 else ():
        sim = import_pycolmap().estimate_sim3d(candidate.center_in_world[use], target[use])
        if sim is None:
            continue
        rotation = np.asarray(sim.rotation.matrix())
        scale = float(sim.scale)
        center = scale * candidate.center_in_world @ rotation.T + np.asarray(sim.translation)
        error = float(((center - target)[use] ** 2).sum())
        if error < least:
            half_axes = scale * candidate.half_axes
            axes = rotation @ candidate.world_from_obj
            best = quadrics.Ellipsoids(center, half_axes, axes)
            least = error
    if best is None:
        none = np.zeros(len(target), bool)
        return _only(found.ellipsoids, none), f"SfMO: {found.note}"
    return _only(best, found.is_ellipsoid), "the SfMO solution is not an ellipsoid"


def _only(ellipsoids: quadrics.Ellipsoids, good: BoolArray) -> quadrics.Ellipsoids:
    """Set the axes to NaN where there is no ellipsoid; good: (O,)."""
    half_axes = np.where(good[:, None], ellipsoids.half_axes, np.nan)
    return dataclasses.replace(ellipsoids, half_axes=half_axes)


def _triangulated_centers(views: Views, poses: Poses) -> Array:
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


def _vertical_axis_last(ellipsoids: quadrics.Ellipsoids, up: Array | None) -> quadrics.Ellipsoids:
    """Permute the axes so that the third is the one nearest to up, as in the default fit."""
    if up is None:
        return ellipsoids
    along = np.einsum("oij,i->oj", np.nan_to_num(ellipsoids.world_from_obj), up)  # (O, 3)
    last = np.abs(along).argmax(1)
    order = (last[:, None] + np.array([1, 2, 3])) % 3  # cyclic: stays right-handed
    sign = np.ones((len(order), 3))
    sign[:, [0, 2]] = np.where(along[np.arange(len(last)), last] < 0, -1.0, 1.0)[:, None]
    axes = np.take_along_axis(ellipsoids.world_from_obj, order[:, None], 2) * sign[:, None]
    half_axes = np.take_along_axis(ellipsoids.half_axes, order, 1)
    return dataclasses.replace(ellipsoids, half_axes=half_axes, world_from_obj=axes)


def _as_fits(
    ellipsoids: quadrics.Ellipsoids,
    views: Views,
    parallax: Array,
    scale: quadrics.Scale,
    reason: str,
) -> quadrics.ObjectFits:
    """Describe ellipsoids as a fit without covariance, in which every box is an inlier.

    Args:
        reason: why the others have no ellipsoid.
    """
    axes = ellipsoids.world_from_obj.reshape(-1, 9)
    arrays = (ellipsoids.center_in_world, ellipsoids.half_axes, axes)
    finite = np.isfinite(np.concatenate(arrays, 1))  # (O, 15)
    good: BoolArray = np.all(finite, 1) & np.all(ellipsoids.half_axes > 0, 1)  # (O,)
    n = len(finite)
    return quadrics.ObjectFits(
        ellipsoids=ellipsoids,
        size=2 * ellipsoids.half_axes,
        cov=np.full((n, 9, 9), np.nan),
        support=np.full(n, "ellipsoid"),
        inlier=np.ones(views.boxes.shape[:2], bool),
        rms_px=np.full(n, np.nan),
        status=np.where(good, "ok", "rejected"),
        reason=["" if g else reason for g in good.tolist()],
        parallax_deg=parallax,
        prior_share=np.full((n, 3), np.nan),
        scale=scale,
        up=np.zeros(3),
        up_source="none",
    )


SOLVERS: dict[str, tuple[Solve, str]] = {
    Solver.LFD: (
        _lfd,
        "ellipsoids in closed form, in the units of the cameras; "
        "no priors, no outlier rejection, no uncertainty",
    ),
    Solver.SFMO: (
        _sfmo,
        "shapes from boxes alone, with affine cameras, without metric meaning (size_m is null); "
        "the similarity transform and reflection are those that fit the cameras best",
    ),
    Solver.PSFMO: (
        _psfmo,
        "axis ratios from the category, cameras linearised at each object, in the units of the "
        "cameras; no size priors, no outlier rejection, no uncertainty",
    ),
}
