"""Options of the object stage, and what they select to fit the shapes of objects.

The default is `quadrics.fit_objects` (`make_fit`). Boxes in 3D that a detector gives replace its
shapes (`with_given_boxes`), and so do the ellipsoids of a published closed-form solver
(`solve_again`): identities, cameras, gravity and scale remain those of the default.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import quadrics
from reobj.cameras import Poses, import_pycolmap
from reobj.objects.description import describe_objects, with_directions
from reobj.objects.likelihood import name_of
from reobj.objects.observations import MIN_SCORE, Fit, FrameOptions, Scene, Views, gather_views
from reobj.results.result import Object, Result
from reobj.sources.tables import Boxes3D
from reobj.types import (
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    Tracks,
    object_classes,
    option,
    rows_by,
)
from reobj.words import load_size_priors, parse_known_size, parse_up


class Solver(enum.StrEnum):
    """What fits the ellipsoids: `quadrics.fit_objects`, or a published closed-form solver."""

    SOLIDS = "solids"
    LFD = "lfd"
    SFMO = "sfmo"
    PSFMO = "psfmo"


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """Fit one shape and its ellipsoid to every object, from tracks and cameras."""

    priors: str = option("", "size priors, JSON (default: the bundled priors.json)", "--priors")
    prior: str = option(
        "",
        "usual size (width x depth x height) of objects of a word, 'mixer=.2x.3x.4m', or the "
        "category that they are like, 'red toolbox=suitcase'; may be repeated",
        "--prior",
        repeated=True,
    )
    known_size: str = option(
        "", "true heights that set the metric scale: 'chair=.82m,door=2m'", "--known-size"
    )
    support: str = option(
        "auto",
        "kind of shape: box, cylinder, ellipsoid, or auto (from the category, else model "
        "selection); old flag: --support",
        "--shape",
        "--support",
    )
    solver: str = option(
        Solver.SOLIDS.value,
        "solids (default), or a published closed-form solver: lfd, sfmo, psfmo",
        "--solver",
    )
    up: str = option("", "direction against gravity in the world, x,y,z (default: estimated)")
    link: bool = option(True, "join and split the tracks after the video")
    min_views: int = option(3, "an object seen in fewer frames with a pose gets no ellipsoid")
    moving: str = option(
        "person,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe",
        "classes that move, comma-separated: tracked, but without an ellipsoid",
    )

    @property
    def moving_classes(self) -> tuple[str, ...]:
        """Names in `moving`."""
        return tuple(filter(None, (name.strip() for name in self.moving.split(","))))

    def size_priors(self) -> quadrics.Priors:
        """Load the size priors, and add the ones of `prior`."""
        return load_size_priors(self.priors, self.prior)


def make_fit(config: ObjectsConfig, poses: Poses, class_names: Sequence[str]) -> Fit:
    """Bind priors, known sizes, gravity and the kind of shape to `quadrics.fit_objects`.

    Raises:
        ReobjError, QuadricsError: an option is invalid, or the priors file cannot be read.
    """
    priors = config.size_priors()
    known_size = parse_known_size(config.known_size)
    if config.solver not in list(Solver):
        default, *published = Solver
        expected = f"{default} or {', '.join(published)}"
        raise ReobjError(f"--solver {config.solver}: expected {expected}")
    up = parse_up(config.up) if config.up else poses.up_in_world
    shape = None if config.support == "auto" else config.support
    given = by_depth = None
    if poses.scale is not None and poses.metric and not poses.map_id:
        by_depth = quadrics.Scale(*poses.scale, "depth_maps")
    elif poses.scale is not None:
        given = quadrics.Scale(*poses.scale, "map")
    elif poses.is_spot and not poses.metric:  # any scale explains the boxes: metres by the category
        given = quadrics.Scale(1.0, SPOT_SCALE_SIGMA, "priors")
    plain = quadrics.FitConfig(path_where_seen=int(poses.known.sum()) > FrameOptions().all_of)

    def fit(views: Views, classes: list[int], scene: Scene) -> quadrics.ObjectFits:
        names = [class_names[c] if c < len(class_names) else "" for c in classes]
        scale = scene.scale or given
        fits = quadrics.fit_objects(
            views.boxes, views.img_from_world, views.image_size, names, priors,
            up=scene.up if up is None else up, support=shape, score=views.score,
            hidden=views.occluded, metric=poses.metric if scale is None else scale,
            known_size=known_size, floor=scene.floor, points=views.points,
            config=dataclasses.replace(plain, wrong_class=0) if scene.trusts_classes else plain,
        )  # fmt: skip
        if by_depth is not None and fits.scale.source == "poses":
            fits = dataclasses.replace(fits, scale=by_depth)
        up_is_given = up is not None or scene.up is None
        return fits if up_is_given else dataclasses.replace(fits, up_source="floor")

    return fit


SPOT_SCALE_SIGMA = 0.15  # of the usual sizes of one room (benchmarks/RESULTS.md: .07 to .22)


# ---- Boxes in 3D of a detector ----

OUTLIER = 3.0  # robust sigmas; a box beyond is not used
BOXES_PER_ERROR = 10.0  # errors of ten boxes count as one: neighbouring frames have similar errors
FLOOR = 0.05  # sigma common to all boxes, relative to the size, and in rad: their bias is unknown


def with_given_boxes(
    fits: quadrics.ObjectFits, boxes: Boxes3D | None, tracks: Tracks, group: IntArray
) -> quadrics.ObjectFits:
    """Replace the shapes of objects that have boxes in 3D by the robust mean of their boxes.

    Args:
        tracks: N rows. group: (N,) object of each.
    """
    row = np.full(len(tracks), -1) if boxes is None else boxes.of_rows(tracks)
    given = np.flatnonzero(row >= 0)
    if boxes is None or not len(given):
        return fits

    solids = fits.ellipsoids[np.arange(len(fits))]  # a copy
    cov = fits.cov.copy()
    replaced = np.unique(group[given])
    for i, rows in zip(replaced, rows_by(group[given]), strict=True):
        own = row[given[rows]]
        mean = mean_box(boxes.box[own], boxes.score[own], fits.up)
        solids.center_in_world[i], solids.half_axes[i], solids.world_from_obj[i], cov[i] = mean
    is_given = np.isin(np.arange(len(fits)), replaced)
    return dataclasses.replace(
        fits,
        ellipsoids=solids,
        size=np.where(is_given[:, None], 2 * solids.half_axes, fits.size),
        cov=cov,
        support=np.where(is_given, "box", fits.support),
        status=np.where(is_given, "ok", fits.status),
        reason=["" if g else why for g, why in zip(is_given, fits.reason, strict=True)],
        prior_share=np.where(is_given[:, None], 0.0, fits.prior_share),
    )


def mean_box(box: Array, score: Array, up: Array) -> tuple[Array, Array, Array, Array]:
    """Average boxes (n, 15) of one object, robustly; a box may have its axes in any order.

    The mean is weighted by the score, without boxes of which a value is more than OUTLIER robust
    sigmas from the median. Its covariance is that of the boxes over their number (of which
    BOXES_PER_ERROR count as one, each as much as its score), and FLOOR.

    Args:
        up: (3,) the third axis of the mean is the one nearest to it; zeros: unknown.
    Returns:
        centre (3,), half extents (3,), rotation (3, 3), covariance (9, 9) of centre, log half
        extents and rotation vector in the frame of the box.
    """
    turn = box[:, 6:].reshape(-1, 3, 3)
    best = quadrics.Ellipsoids(box[:, :3], box[:, 3:6], turn)[score.argmax()]
    first = _vertical_axis_last(best, up).world_from_obj[0]
    order = quadrics.nearest_axes(turn, np.broadcast_to(first, turn.shape))
    log_half = (np.abs(order).transpose(0, 2, 1) @ np.log(box[:, 3:6, None]))[..., 0]
    values = np.hstack([box[:, :3], log_half, quadrics.rotation_vectors(first.T @ turn @ order)])
    off = np.abs(values - np.median(values, 0))
    sigma = 1.4826 * np.median(off, 0)  # of a normal distribution
    size = FLOOR * np.exp(log_half).mean()
    usual = np.append(np.full(3, size), np.full(6, FLOOR))  # boxes may be identical
    keep = (off <= OUTLIER * np.maximum(sigma, usual)).all(1)
    keep = keep if keep.any() else off.max(1) == off.max(1).min()
    weight = np.maximum(score[keep], 1e-3)
    mean = np.average(values[keep], axis=0, weights=weight)
    difference = values[keep] - mean
    scatter = (weight[:, None] * difference).T @ difference / weight.sum()
    cov = scatter / max(weight.sum() / BOXES_PER_ERROR, 1.0)
    half_mean = np.exp(mean[3:6])
    cov += np.diag(FLOOR**2 * np.concatenate([np.full(3, (half_mean**2).mean()), np.ones(6)]))
    return mean[:3], half_mean, first @ quadrics.rotations(mean[None, 6:])[0], cov


def _vertical_axis_last(ellipsoids: quadrics.Ellipsoids, up: Array | None) -> quadrics.Ellipsoids:
    """Permute the axes so that the third is the one nearest to up, and points up."""
    if up is None or not up.any():
        return ellipsoids
    along = np.einsum("oij,i->oj", np.nan_to_num(ellipsoids.world_from_obj), up)  # (O, 3)
    last = np.abs(along).argmax(1)
    order = (last[:, None] + np.array([1, 2, 3])) % 3  # cyclic: stays right-handed
    sign = np.ones((len(order), 3))
    sign[:, [0, 2]] = np.where(along[np.arange(len(last)), last] < 0, -1.0, 1.0)[:, None]
    axes = np.take_along_axis(ellipsoids.world_from_obj, order[:, None], 2) * sign[:, None]
    half_axes = np.take_along_axis(ellipsoids.half_axes, order, 1)
    return dataclasses.replace(ellipsoids, half_axes=half_axes, world_from_obj=axes)


# ---- Published solvers ----

LIMITS = {
    Solver.LFD: "ellipsoids in closed form, in the units of the cameras; "
    "no priors, no outlier rejection, no uncertainty",
    Solver.SFMO: "shapes from boxes alone, with affine cameras, without metric meaning (size_m is "
    "null); the similarity transform and reflection are those that fit the cameras best",
    Solver.PSFMO: "axis ratios from the category, cameras linearised at each object, in the units "
    "of the cameras; no size priors, no outlier rejection, no uncertainty",
}


def solve_again(result: Result, config: ObjectsConfig) -> Result:
    """Replace the shapes of all objects by the ellipsoids of `config.solver`.

    Returns:
        the result with other objects, without fits (there are no `ObjectFits` of the default fit),
        and with a warning of the solver's limitations; unchanged for the default solver or without
        cameras.
    """
    if config.solver == Solver.SOLIDS or result.poses is None or result.fits is None:
        return result
    solver = Solver(config.solver)
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
        ellipsoids, reason = _solved(solver, views, names, priors)
        ellipsoids = _vertical_axis_last(ellipsoids, component.up_in_world)
        scale = None if solver == Solver.SFMO else component.scale
        parallax = np.array([before[i].parallax_deg for i in classes], np.float64)
        fits = _as_fits(ellipsoids, views, parallax, scale, reason)
        confidence = {i: o.confidence for i, o in before.items() if o.confidence is not None}
        described = describe_objects(
            rows, result.class_names, fits, views, config.min_views, config.moving_classes,
            confidence, component=k, fps=result.video.fps,
        )  # fmt: skip
        objects += with_directions(described, rows, poses)
    warning = f"objects.solver={solver}: {LIMITS[solver]}"
    return dataclasses.replace(
        result,
        objects=sorted(objects, key=lambda o: o.id),
        fits=None,
        warnings=[*result.warnings, warning],
    )


def _solved(
    solver: Solver, views: Views, names: Sequence[str], priors: quadrics.Priors
) -> tuple[quadrics.Ellipsoids, str]:
    """Return the ellipsoids of G groups, NaN: none, and the reason why a group has none."""
    if solver == Solver.LFD:
        dual_q, real = quadrics.fit_lfd(views.boxes, views.img_from_world)
        found = quadrics.Ellipsoids.from_dual_quadrics(dual_q)[0]
        return _only(found, real), "the LfD solution is not an ellipsoid"
    known = quadrics.fit_psfmo(views.boxes, priors, names, views.img_from_world).ellipsoids
    if solver == Solver.PSFMO:
        return known, "PSfMO found no ellipsoid"
    seen_twice = np.all(np.isfinite(known.half_axes), 1)
    return _sfmo(views, np.where(seen_twice[:, None], known.center_in_world, np.nan))


def _sfmo(views: Views, target: Array) -> tuple[quadrics.Ellipsoids, str]:
    """Factorise the boxes, and align the result with points triangulated by the cameras.

    The affine frame is determined up to a similarity and a reflection: those of least squared
    distance between the centres and the triangulated box centres. Ref: Umeyama, PAMI 1991.

    Args:
        target: (G, 3) triangulated box centres, NaN where unknown.
    """
    found = quadrics.fit_sfmo(views.boxes)
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
            axes = rotation @ candidate.world_from_obj
            best = quadrics.Ellipsoids(center, scale * candidate.half_axes, axes)
            least = error
    if best is None:
        return quadrics.Ellipsoids.unknown(len(target)), f"SfMO: {found.note}"
    return _only(best, found.is_ellipsoid), "the SfMO solution is not an ellipsoid"


def _only(ellipsoids: quadrics.Ellipsoids, good: BoolArray) -> quadrics.Ellipsoids:
    """Set the axes to NaN where there is no ellipsoid; good: (O,)."""
    half_axes = np.where(good[:, None], ellipsoids.half_axes, np.nan)
    return dataclasses.replace(ellipsoids, half_axes=half_axes)


def _as_fits(
    ellipsoids: quadrics.Ellipsoids,
    views: Views,
    parallax: Array,
    scale: quadrics.Scale | None,
    reason: str,
) -> quadrics.ObjectFits:
    """Describe ellipsoids as a fit without covariance, in which every box is an inlier.

    Args:
        reason: why the others have no ellipsoid.
    """
    none = quadrics.ObjectFits.unfitted(views.boxes.shape[:2], reason)
    finite = np.isfinite(ellipsoids.dual_quadrics()).all((1, 2))
    good = np.asarray(finite & (ellipsoids.half_axes > 0).all(1))  # (O,)
    return dataclasses.replace(
        none,
        ellipsoids=ellipsoids,
        size=2 * ellipsoids.half_axes,
        inlier=np.ones_like(none.inlier),
        status=np.where(good, "ok", "rejected"),
        reason=["" if g else reason for g in good.tolist()],
        parallax_deg=parallax,
        prior_share=np.full_like(none.prior_share, np.nan),
        scale=scale or none.scale,
    )
