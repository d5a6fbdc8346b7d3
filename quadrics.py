"""Fit boxes, cylinders and ellipsoids of static objects to 2D detection boxes in several views.

Usage:
    import quadrics
    priors = quadrics.load_priors()                       # priors.json beside this file
    fits = quadrics.fit_objects(boxes_xyxy, img_from_world, (width, height),
                                categories=["chair", "cup"], priors=priors, up=(0.0, 0.0, 1.0))
    fits.ellipsoids.center_in_world, fits.size, fits.cov, fits.status, fits.reason

How `fit_objects` works:
    1. Every visible box edge is an image line l; its back-projected plane P'l = (n, d) touches
       the object: -(n.c + d) = h(n), h the support function of the shape (box, cylinder or
       ellipsoid). Edges on the image border are one-sided constraints.
    2. Starts: consensus of the viewing rays and of the depths at which the size priors hold;
       several orientations; robust loss; one batched Levenberg-Marquardt with analytic Jacobians.
    3. Explicit inlier test per view, noise level re-estimated, final fit, 9x9 covariance.
    4. Scale and gravity from the priors of the categories when the poses give none.

Conventions: float64; boxes (F, O, 4) x1 y1 x2 y2 in pixels of the COLMAP corner convention, NaN
where an object is unseen; img_from_world (F, 3, 4) = K [R | t] of cameras looking along +z; half
axes; rotation world_from_obj with the object's axes as columns (third axis = up where up is
known); covariance order: center (3, world), log half axes (3), rotation vector (3, object frame).
Axes of the shape comments: F frames, O objects, V views of one object, E = 4 edges of one view
(left, top, right, bottom), B problems (object x shape x start) of one batch, L live objects
(those with a usable box).
"Solid": the shape with its pose and size. Constants stand beside their use; those without a source
are measured on simulated and recorded scenes (docs/quadrics.md, benchmarks/RESULTS.md).

References:
    [LfD]   Rubino, Crocco, Del Bue: 3D object localisation from multi-view detections. PAMI 2018
    [SfMO]  Crocco, Rubino, Del Bue: Structure from motion with objects. CVPR 2016.
    [PSfMO] Gay, Rubino, Bansal, Del Bue: Probabilistic structure from motion with objects.
            ICCV 2017.
    [HZ]    Hartley, Zisserman: Multiple view geometry. 2004, section 8.3.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

__all__ = [
    "SUPPORTS", "Array", "BoolArray", "Ellipsoids", "FitConfig", "IntArray", "ObjectFits", "Priors",
    "PsfmoResult", "QuadricsError", "Scale", "SfmoResult",
    "box_iou", "boxes_from_dual_conics", "camera_up", "clip_boxes", "fit_lfd", "fit_objects",
    "fit_psfmo", "fit_sfmo", "load_priors", "project", "reprojection_iou", "rotation_vectors",
    "rotations", "solid_boxes", "volume_overlap",
]  # fmt: skip

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Shape(IntEnum):
    """Codes of the shapes; negative: the caller leaves the shape open."""

    ELLIPSOID = 0
    BOX = 1
    CYLINDER = 2
    BY_CATEGORY = -1
    BY_EVIDENCE = -2


SUPPORTS = tuple(shape.name.lower() for shape in Shape if shape >= 0)  # names, index = code
# Row k marks the axes under the same root as axis k in the support function
# h = sum over groups of sqrt(sum a_k^2 m_k^2)
AXIS_GROUPS: Array = np.array(
    [np.ones((3, 3)), np.eye(3), [[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]
)  # (3 shapes, 3, 3)
AXIS_ORDERS: IntArray = np.array(list(itertools.permutations(range(3))))  # (6, 3)


SIGNS: Array = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)  # of corners
SKEW: Array = np.cross(np.eye(3), np.eye(3)[:, None])  # (3, 3, 3) cross product matrices of x, y, z


class Rows:
    """Struct of arrays with a common first axis; indexing selects rows of all of them."""

    __slots__: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(getattr(self, self.__slots__[0]))

    def __getitem__(self, index: Any) -> Self:
        """Select rows by number, slice, mask or index array."""
        index = [index] if isinstance(index, int | np.integer) else index
        return type(self)(*(getattr(self, name)[index] for name in self.__slots__))

    def put(self, index: Any, other: Self) -> None:
        """Overwrite rows by those of another struct."""
        for name in self.__slots__:
            column = getattr(self, name)
            put = column.put if isinstance(column, Rows) else column.__setitem__
            put(index, getattr(other, name))

    @classmethod
    def concatenate(cls, sets: Sequence[Self]) -> Self:
        """Concatenate structs."""
        columns = ([getattr(rows, name) for rows in sets] for name in cls.__slots__)
        return cls(*(getattr(type(c[0]), "concatenate", np.concatenate)(c) for c in columns))


class QuadricsError(ValueError):
    """Unusable input; the message names the argument and what was expected."""


# ---- Configuration and results -------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FitConfig:
    """Options of `fit_objects`.

    Attributes:
        edge_noise_px, edge_noise_rel: Standard deviation of a box edge about the object's true
            outline: hypot(edge_noise_px, edge_noise_rel * box width or height). Initial values:
            one factor an object is estimated from the boxes.
        border_px: An edge nearer to the image border than this (px) plus twice its noise is
            one-sided: the object reaches it and may extend beyond.
        correlation_deg: Views of an object less than this (deg) apart have correlated errors and
            count as fewer; 0: all views are independent.
        max_views: Most views of an object that are used, spread evenly over the camera's path.
        path_where_seen: The path excludes the parts on which an object was not seen (for a long
            video, of which it is in view for a small part).
        start_views: Number of views on which the candidate orientations and shapes of an object
            are compared; fewer are faster and select a wrong candidate more often.
        start_iterations: Optimisation steps of each candidate on those views.
        iterations: Most optimisation steps on all views; a fit that has converged stops earlier.
        wrong_class: Probability that an object's category is wrong; 0: no category is overruled.
    """

    edge_noise_px: float = 1.0
    edge_noise_rel: float = 0.02
    border_px: float = 3.0
    correlation_deg: float = 3.0
    max_views: int = 48
    path_where_seen: bool = False
    start_views: int = 8
    start_iterations: int = 7
    iterations: int = 40
    wrong_class: float = 0.05  # measured: .03 to .25 give nearly the same results


@dataclass(frozen=True, slots=True)
class Ellipsoids(Rows):
    """Struct of arrays of O ellipsoids (or of the solids in which they are inscribed)."""

    center_in_world: Array  # (O, 3)
    half_axes: Array  # (O, 3) along the columns of world_from_obj
    world_from_obj: Array  # (O, 3, 3) rotations

    @staticmethod
    def unknown(n: int) -> Ellipsoids:
        """Return n ellipsoids of NaN."""
        return Ellipsoids(*(np.full((n, *shape), np.nan) for shape in ((3,), (3,), (3, 3))))

    def dual_quadrics(self) -> Array:
        """Return (O, 4, 4) dual quadrics with [3, 3] = -1: R diag(a^2) R' - c c', -c, -1."""
        rot = self.world_from_obj
        spread = np.einsum("oik,ok,ojk->oij", rot, self.half_axes**2, rot)
        return _dual_quadrics(self.center_in_world, spread)

    @staticmethod
    @np.errstate(all="ignore")
    def from_dual_quadrics(dual_q: Array) -> tuple[Ellipsoids, BoolArray]:
        """Decompose dual quadrics into ellipsoids and test which of them are real.

        Args:
            dual_q: (O, 4, 4), any scale.
        Returns:
            ellipsoids (axes ascending; sqrt|eigenvalue| where negative, NaN where not finite), and
            is_ellipsoid (O,): True where all eigenvalues of the centred block are positive.
        """
        center, block = _centred(dual_q)
        finite = _finite(center, 1) & _finite(block, 1, 2)  # (O,)
        value, rot = _eigh(block)
        rot[np.linalg.det(rot) < 0, :, 0] *= -1.0
        value[~finite] = np.nan
        ellipsoids = Ellipsoids(center, np.sqrt(np.abs(value)), rot)
        return ellipsoids, finite & (value > 0).all(1)


class Scale(NamedTuple):
    """Metres per world unit, its relative standard deviation and its source."""

    value: float
    rel_sigma: float
    source: str  # "poses" | "priors" | "known_size" | "none"


class Floor(NamedTuple):
    """The plane on which objects stand."""

    normal: Array  # (3,) unit, upwards
    offset: float  # normal @ x == offset on it, world units
    sigma: float  # of its height, world units


@dataclass(frozen=True, slots=True)
class ObjectFits:
    """Result of `fit_objects` for O objects, in world units."""

    ellipsoids: Ellipsoids  # inscribed in the solid for box and cylinder
    size: Array  # (O, 3) full extents of the solid along the object's axes
    cov: Array  # (O, 9, 9) center, log half axes, rotation vector in the object frame
    support: npt.NDArray[np.str_]  # (O,) shape, one of SUPPORTS
    inlier: BoolArray  # (F, O)
    rms_px: Array  # (O,) of the inlier edges
    status: npt.NDArray[np.str_]  # (O,) "ok" | "prior_dominated" | "implausible" | "rejected"
    reason: list[str]  # (O,)
    parallax_deg: Array  # (O,) widest angle between inlier viewing rays
    prior_share: Array  # (O, 3) posterior / prior sigma of each log axis; 1: the data add nothing
    scale: Scale
    up: Array  # (3,) unit, or zeros when unknown
    up_source: str  # "given" | "cameras" | "none"

    def __len__(self) -> int:
        return len(self.status)

    def put(self, index: IntArray, fits: ObjectFits) -> None:
        """Overwrite objects (not the inliers) by those of another result."""
        self.ellipsoids.put(index, fits.ellipsoids)
        columns = ("size", "cov", "support", "rms_px", "status", "parallax_deg", "prior_share")
        for name in columns:
            getattr(self, name)[index] = getattr(fits, name)
        for k, reason in zip(index.tolist(), fits.reason, strict=True):
            self.reason[k] = reason

    @staticmethod
    def unfitted(shape: tuple[int, ...], reason: str) -> ObjectFits:
        """Return the result of (F, O) `shape` where all objects are rejected for one reason."""
        n = shape[1]
        return ObjectFits(
            ellipsoids=Ellipsoids.unknown(n),
            size=np.full((n, 3), np.nan),
            cov=np.full((n, 9, 9), np.nan),
            support=np.full(n, "ellipsoid"),
            inlier=np.zeros(shape, bool),
            rms_px=np.full(n, np.nan),
            status=np.full(n, "rejected", "U15"),  # as long as "prior_dominated"
            reason=[reason] * n,
            parallax_deg=np.zeros(n),
            prior_share=np.ones((n, 3)),
            scale=Scale(1.0, np.inf, "none"),
            up=np.zeros(3),
            up_source="none",
        )


# ---- fit_objects ---------------------------------------------------------------------------

# sigma of an edge, margin of the image border: of the edges that the border cuts a third lie more
# than 3 px inside it, a tenth more than this (two recordings, two detectors: docs/quadrics.md)
BORDER_SIGMAS = 2.0


@np.errstate(all="ignore")
def fit_objects(
    boxes_xyxy: npt.ArrayLike,
    img_from_world: npt.ArrayLike,
    image_size: tuple[float, float],
    categories: Sequence[str | None] | None = None,
    priors: Priors | None = None,
    up: Sequence[float] | Array | None = None,
    support: str | Sequence[str | None] | None = None,
    *,
    score: npt.ArrayLike | None = None,
    hidden: npt.ArrayLike | None = None,
    metric: bool | Scale = True,
    known_size: Mapping[str | int, tuple[str, float]] | None = None,
    floor: Floor | None = None,
    points: npt.ArrayLike | None = None,
    config: FitConfig | None = None,
) -> ObjectFits:
    """Fit one solid and its inscribed ellipsoid to every object's boxes, all objects at once.

    Args:
        boxes_xyxy: (F, O, 4) px, NaN where unseen. img_from_world: (F, 3, 4), NaN where unknown.
        image_size: (width, height) px; edges on the border are one-sided.
        categories, priors: category of each object, `load_priors()`.
        up: (3,) world direction against gravity; None: estimated, assuming level cameras.
        support: shape of all objects or of each: "box", "cylinder", "ellipsoid", "evidence" (model
            selection), or None (that of the category; model selection where it is unknown).
        score: (F, O) detection scores; of many views those of high score are preferred.
        hidden: (F, O, 4) True where the object may be occluded at an edge (left, upper, right,
            lower) and extend beyond it.
        metric: True: world units are metres; False: one global scale is estimated from the priors;
            a Scale: given.
        known_size: {category or object number: ("w" | "d" | "h", metres)}; replaces metric=True.
        floor: plane of the objects whose category stands on the floor; used once the scale is
            given or estimated.
        points: (O, P, 3) sparse points that may lie on each object, padded with NaN; outliers are
            down-weighted.
    Returns:
        ObjectFits in world units; objects whose numbers are unusable have status "rejected".
    Raises:
        QuadricsError: array shapes do not fit together, or an invalid support or known_size.
    """
    cfg = config or FitConfig()
    priors = priors or NO_PRIORS
    boxes = np.asarray(boxes_xyxy, np.float64)
    cameras = np.asarray(img_from_world, np.float64)
    sparse = np.zeros((boxes.shape[1], 0, 3)) if points is None else np.asarray(points, np.float64)
    _check_input(boxes, cameras, image_size, categories, sparse)
    codes = _shape_codes(support, boxes.shape[1])
    cams = _cameras(cameras)
    usable = _usable_boxes(boxes, cams)
    quality = np.nan_to_num(np.asarray(1.0 if score is None else score, np.float64))
    margin = cfg.border_px + BORDER_SIGMAS * cfg.edge_noise_rel * (boxes[..., 2:] - boxes[..., :2])
    limit = np.array(image_size) - margin
    one_sided = np.concatenate([boxes[..., :2] <= margin, boxes[..., 2:] >= limit], -1)  # (F, O, 4)
    one_sided |= False if hidden is None else np.asarray(hidden, bool)
    quality = quality + ~one_sided.any(-1)  # (F, O), complete boxes first
    live = np.flatnonzero(usable.any(0))  # (L,)
    names = ["" if categories is None else categories[k] or "" for k in live.tolist()]
    sizes = _known_sizes(known_size or {}, names, live, priors)
    world = _first_world(up, metric, bool(sizes), cams, floor)
    result = ObjectFits.unfitted(usable.shape, "no usable box in a posed frame")
    if len(live):
        measured = _Measured(boxes[:, live], one_sided[:, live], usable[:, live], cams)
        data = _gather_data(measured, quality[:, live], cfg)
        rows = priors.index(names)
        given = _Given(rows, priors, codes[live], sparse[live], sizes, cfg.wrong_class)
        fit, spec, world = _solve_passes(data, given, world, cfg)
        fits = _report(fit, spec, data, measured, cfg)
        result.put(live, fits)
        result.inlier[:, live] = fits.inlier
    return replace(result, scale=world.scale(), up=world.up, up_source=world.up_source)


def _check_input(
    boxes: Array, cams: Array, image_size: tuple[float, float], names: Sequence[Any] | None,
    points: Array,
) -> None:  # fmt: skip
    """Raise QuadricsError where array shapes do not fit together."""
    frames, count = boxes.shape[:2] if boxes.ndim == 3 else ("frames", "objects")
    for name, shape, expected in (
        ("boxes_xyxy", boxes.shape, (frames, count, 4)),
        ("img_from_world", cams.shape, (frames, 3, 4)),
        ("image_size", np.shape(image_size), (2,)),
        ("categories", (count if names is None else len(names),), (count,)),
        ("points", points.shape, (count, *points.shape[1:2], 3)),
    ):
        if shape != expected:
            raise QuadricsError(f"{name} has shape {shape}, expected {expected}")


def _shape_codes(shape: str | Sequence[str | None] | None, n: int) -> IntArray:
    """Convert shape names to codes (n,); None: by category, "evidence": by evidence."""
    names = [shape] * n if shape is None or isinstance(shape, str) else list(shape)
    codes = {None: Shape.BY_CATEGORY, "evidence": Shape.BY_EVIDENCE}
    codes |= {name: Shape(code) for code, name in enumerate(SUPPORTS)}
    unknown = {str(name) for name in names if name not in codes}
    if unknown or len(names) != n:
        raise QuadricsError(
            f"support: {', '.join(sorted(unknown)) or len(names)} for {n} objects; give one shape "
            f"for all or one for each: {', '.join(SUPPORTS)} or evidence"
        )
    return np.array([codes[name] for name in names], np.int64)


def _known_sizes(
    known_size: Mapping[str | int, tuple[str, float]], names: list[str], live: IntArray,
    priors: Priors,
) -> list[tuple[int, int, float]]:  # fmt: skip
    """Assign the sizes that the user measured to live objects: (row, axis, metres) each."""
    sizes = []
    for key, (side, metres) in known_size.items():
        axis = "wdh".find(side[:1].lower())
        if axis < 0 or not metres > 0:
            raise QuadricsError(f"known_size[{key!r}] = {side, metres}: give (w|d|h, metres > 0)")
        rows = priors.meant(key, names) if isinstance(key, str) else np.flatnonzero(live == key)
        sizes += [(int(row), axis, metres) for row in rows]
    return sizes


UNKNOWN_SCALE_LOG = 3.0  # log, prior sigma of the global scale where the poses have none
UPRIGHT_TILT_DEG = 1.5  # deg, sigma of an object's vertical axis where gravity is given


class _World(NamedTuple):
    """Scale and gravity of one pass."""

    log_scale: float  # log metres per world unit
    scale_sigma: float
    scale_source: str
    up: Array  # (3,) unit or zeros
    tilt_rad: float  # sigma of an object's vertical axis about `up`
    up_source: str
    floor: Floor | None = None

    def scale(self) -> Scale:
        """Return the scale as metres per unit."""
        return Scale(float(np.exp(self.log_scale)), self.scale_sigma, self.scale_source)


def _first_world(
    up: Sequence[float] | Array | None, metric: bool | Scale, sized: bool, cams: _Cameras,
    floor: Floor | None,
) -> _World:  # fmt: skip
    """Return scale and gravity as given; gravity defaults to that of level cameras.

    sized: the size of an object is known, which replaces metric=True.
    """
    scale = (0.0, UNKNOWN_SCALE_LOG, "none")
    if isinstance(metric, Scale):
        if metric.source != "none":
            scale = (float(np.log(metric.value)), metric.rel_sigma, metric.source)
    elif metric and not sized:
        scale = (0.0, 0.0, "poses")
    given = np.zeros(3) if up is None else np.nan_to_num(np.asarray(up, np.float64).reshape(3))
    size = float(np.linalg.norm(given))
    upright = float(np.deg2rad(UPRIGHT_TILT_DEG))
    if size > 0:
        return _World(*scale, given / size, upright, "given", floor)
    rough, sigma = camera_up(cams.matrix)
    source = "cameras" if rough.any() else "none"
    return _World(*scale, rough, float(np.hypot(sigma, upright)), source, floor)


@np.errstate(all="ignore")
def camera_up(img_from_world: Array) -> tuple[Array, float]:
    """Estimate "up" roughly from the cameras of a hand-held video.

    Assumes level cameras: up is perpendicular to every camera's x axis (small roll) and near the
    mean upward image direction m (free pitch). Minimises
    mean((x.u)^2) / roll^2 + |u - m|^2 / pitch^2.

    Args:
        img_from_world: (F, 3, 4), NaN where unknown.
    Returns:
        up (3,), a unit vector, or zeros where the cameras' orientations disagree; its sigma, rad.
    """
    ray = _cameras(img_from_world).ray
    ray = ray[_finite(ray, 1, 2)]  # (F, 3, 3)
    if not len(ray):
        return np.zeros(3), np.inf
    x, up = (_unit(v) for v in (ray[:, :, 0], -ray[:, :, 1]))
    mean = up.mean(0)
    if np.linalg.norm(mean) < 0.3:
        return np.zeros(3), np.inf
    roll = np.deg2rad(6.0)  # sigma of a hand-held camera's
    pitch = np.deg2rad(35.0)
    independent = min(len(x), 4.0)  # views whose rolls do not repeat each other
    info = independent * x.T @ x / len(x) / roll**2 + np.eye(3) / pitch**2
    best = np.linalg.solve(info, mean / pitch**2)
    best /= np.linalg.norm(best)
    level = np.eye(3) - np.outer(best, best)
    worst = np.linalg.eigvalsh(level @ info @ level)[1]  # the less certain of the two tilts
    return best, float(1.0 / np.sqrt(worst))


def _solve_passes(
    data: _Data, given: _Given, world: _World, cfg: FitConfig
) -> tuple[_Fit, _Spec, _World]:
    """Fit; if the poses lack a scale and the fits determine one, fit again with it."""
    spec = _prior_spec(given, world)
    fit = _fit_all(data, spec, cfg)
    if world.scale_source != "none":
        return fit, spec, world
    scale = _scale_from_known(fit, given.sizes, cfg)
    source = "known_size"
    if scale is None:
        metric = _prior_spec(given, world._replace(scale_sigma=0.0))
        scale = _scale_from_priors(fit, data, metric)
        source = "priors"
    if scale is None:
        return fit, spec, world
    world = world._replace(log_scale=scale[0], scale_sigma=scale[1], scale_source=source)
    spec = _prior_spec(given, world)
    return _fit_all(data, spec, cfg), spec, world


def _report(fit: _Fit, spec: _Spec, data: _Data, measured: _Measured, cfg: FitConfig) -> ObjectFits:
    """Describe the fits of the L live objects; scale and gravity are left open."""
    posterior = _posterior(fit, data, measured.boxes, cfg)
    square = (_all_residuals(fit, data) * data.edges.sigma_px) ** 2 * fit.inlier
    parallax = _parallax(fit, data)
    status, reason = _status(fit, spec, posterior, parallax, (data.index >= 0).sum(1))
    return replace(
        ObjectFits.unfitted(measured.usable.shape, ""),
        ellipsoids=posterior.solids,
        size=2.0 * posterior.solids.half_axes,
        cov=posterior.cov,
        support=np.array(SUPPORTS)[fit.code],
        inlier=_inlier_table(posterior.solids, fit.code, fit.noise, measured, cfg),
        rms_px=np.sqrt(square.sum((1, 2)) / np.maximum(fit.inlier.sum((1, 2)), 1)),
        status=np.array(status),
        reason=reason,
        parallax_deg=parallax,
        prior_share=posterior.prior_share,
    )


# ---- Views: cameras, selection, tangent planes ---------------------------------------------


class _Cameras(NamedTuple):
    """F cameras, scaled so that the third row gives the depth in world units."""

    matrix: Array  # (F, 3, 4), NaN where unusable
    center: Array  # (F, 3)
    ray: Array  # (F, 3, 3): ray @ (u, v, 1) has depth 1


def _cameras(img_from_world: Array) -> _Cameras:
    """Invert cameras; NaN where singular, not finite or with entries beyond 1e12."""
    cams = np.array(img_from_world, np.float64).reshape(-1, 3, 4)
    cams[~(np.abs(cams) < 1e12).all((1, 2))] = np.nan
    cams = _with_positive_depth(cams)  # (F, 3, 4)
    linear = np.nan_to_num(cams[:, :, :3])
    size = np.linalg.norm(linear, axis=2, keepdims=True)  # (F, 3, 1) row norms
    unit = linear / np.where(size > 0, size, 1.0)
    bad = ~(np.abs(np.linalg.det(unit)) > 1e-9) | ~_finite(cams, 1, 2)
    inverse = np.linalg.inv(np.where(bad[:, None, None], np.eye(3), linear))
    cams[bad] = np.nan
    inverse[bad] = np.nan
    center = -np.einsum("fij,fj->fi", inverse, cams[:, :, 3])  # (F, 3)
    return _Cameras(cams, center, inverse)


def _with_positive_depth(img_from_world: Array) -> Array:
    """Scale cameras (..., 3, 4) so that the third row gives metric depth, positive in front."""
    norm = np.linalg.norm(img_from_world[..., 2, :3], axis=-1)  # (...)
    safe = np.where(_finite(img_from_world, -1, -2), 1.0, np.nan)
    sign = np.sign(np.linalg.det(np.nan_to_num(img_from_world[..., :3])))
    scale = safe * sign / norm
    out: Array = img_from_world * np.where(np.isfinite(scale), scale, np.nan)[..., None, None]
    return out


def _usable_boxes(boxes_xyxy: Array, cams: _Cameras) -> BoolArray:
    """Test which boxes (F, O) are finite, below 1e7 px, of positive area, and have a pose."""
    bounded = (np.abs(boxes_xyxy) < 1e7).all(-1)
    has_area = (boxes_xyxy[..., 2:] - boxes_xyxy[..., :2] > 1e-6).all(-1)
    return bounded & has_area & _finite(cams.center, 1)[:, None]


class _Measured(NamedTuple):
    """Checked boxes and cameras."""

    boxes: Array  # (F, O, 4)
    one_sided: BoolArray  # (F, O, 4)
    usable: BoolArray  # (F, O)
    cams: _Cameras


@dataclass(frozen=True, slots=True)
class _Edges(Rows):
    """Back-projected tangent planes of V views with E edges each, for a batch of objects."""

    normal: Array  # (O, V, E, 3) unit, outward
    offset: Array  # (O, V, E)
    gain: Array  # (O, V, E) residual in sigma = gain * (n.c + d + h) / depth
    one_sided: BoolArray  # (O, V, E) no residual where the solid extends beyond the edge
    used: BoolArray  # (O, V, E)
    depth_row: Array  # (O, V, 4) third row of the camera
    sigma_px: Array  # (O, V, E)
    redundancy: Array  # (O, V, E) effective number of views with the same errors; gain has 1 / sqrt


@dataclass(frozen=True, slots=True)
class _Data(Rows):
    """Gathered views of O objects."""

    index: IntArray  # (O, V) frame or -1
    ray: Array  # (O, V, 3) of the box centre, depth 1
    extent: Array  # (O, V, 2) box size at depth 1
    cam_center: Array  # (O, V, 3)
    edges: _Edges

    def take_views(self, n: int) -> _Data:
        """Keep up to n views of each object, evenly spread."""
        count = (self.index >= 0).sum(1)[:, None]  # (O, 1)
        size = min(n, self.index.shape[1])
        even = np.round(np.linspace(0.0, 1.0, size) * (count - 1)).astype(np.int64)
        slot = np.where(count <= size, np.arange(size), even)  # (O, S)
        return self[np.arange(len(slot))[:, None], slot]


def _gather_data(measured: _Measured, quality: Array, cfg: FitConfig) -> _Data:
    """Choose each object's views by `quality` (F, O) and back-project their edges."""
    index = _select_views(
        measured.usable, quality, measured.cams, cfg.max_views, cfg.path_where_seen
    )  # (O, V)
    seen = index >= 0
    column = np.arange(len(index))[:, None]
    boxes = _where(seen, measured.boxes[index, column], np.nan)  # (O, V, 4)
    rays = _rays(boxes, measured.cams, index)
    edges = _tangent_planes(boxes, rays.matrix, measured.one_sided[index, column], cfg)
    # Errors of the detector, of occlusion and of the shape model correlate between neighbouring
    # frames: independent measurements of all of them would give too small a covariance.
    if cfg.correlation_deg > 0:
        angle = np.arccos(np.clip(_cosines(rays.center, rays.point), -1.0, 1.0))  # (O, V, V)
        corr = np.exp(-0.5 * (angle / np.deg2rad(cfg.correlation_deg)) ** 2) * seen[:, None]
        redundancy = np.maximum(corr.sum(-1), 1.0)[..., None] * edges.redundancy  # (O, V, E)
        edges = replace(edges, gain=edges.gain / np.sqrt(redundancy), redundancy=redundancy)
    return _Data(index, rays.direction, rays.extent, rays.center, edges)


def _select_views(
    usable: BoolArray, quality: Array, cams: _Cameras, max_views: int, path_where_seen: bool = False
) -> IntArray:
    """Choose up to `max_views` frames an object, spread evenly along the camera's path.

    Args:
        usable, quality: (F, O); in each segment of the path the frame of best quality is taken.
        path_where_seen: as in `FitConfig`.
    Returns:
        (O, V) frame numbers, -1 where an object has fewer; V = the most any object has.
    """
    out = np.full((usable.shape[1], max_views), -1, np.int64)
    posed = _finite(cams.center, 1)
    center = cams.center[posed]
    step = np.zeros(len(posed))
    if len(center):
        length = np.linalg.norm(np.diff(center, axis=0, prepend=center[:1]), axis=1)
        # at most twice the upper quartile: outliers of the positions must not attract all views
        length = np.minimum(length, 2.0 * np.quantile(length, 0.75))
        # a fifth of the length is time: also a camera that rests gives several views
        step[posed] = length + (0.2 * length.sum() / len(length) + 1e-12)
    for o in range(len(out)):
        frames = np.flatnonzero(usable[:, o])
        if len(frames) > max_views:  # the best of each bucket of the path
            path = np.cumsum(step * usable[:, o] if path_where_seen else step)
            path = path[frames] - path[frames[0]]
            fraction = path / np.maximum(path[-1], 1e-12)
            bucket = np.minimum((fraction * max_views).astype(np.int64), max_views - 1)
            best_first = np.lexsort((-quality[frames, o], bucket))
            frames = frames[best_first[_group_starts(bucket[best_first])]]
        out[o, : len(frames)] = frames
    return out[:, : max(int((out >= 0).sum(1).max(initial=0)), 1)]


def _tangent_planes(boxes: Array, cams: Array, one_sided: BoolArray, cfg: FitConfig) -> _Edges:
    """Back-project the box edges of gathered views.

    Args:
        boxes: (O, V, 4), NaN where there is no view; cams: (O, V, 3, 4), with metric depth.
        one_sided: (O, V, 4) edges beyond which the object may extend.
    """
    size = np.tile(boxes[..., 2:] - boxes[..., :2], 2)  # (O, V, E) px across the edge
    sigma = np.hypot(cfg.edge_noise_px, cfg.edge_noise_rel * size)
    # P'l of the image line l: its distance is positive outside the box
    outward = np.array([-1.0, -1.0, 1.0, 1.0])[:, None]
    plane = cams[..., [0, 1, 0, 1], :] - boxes[..., None] * cams[..., 2:, :]
    plane = outward * plane  # (O, V, E, 4)
    norm = np.linalg.norm(plane[..., :3], axis=-1)  # (O, V, E) px per metre at depth 1
    plane = plane / _nonzero(norm)[..., None]
    used = _finite(plane, -1) & (norm > 0) & np.isfinite(sigma)
    clean = _where(used, plane)
    gain = _where(used, norm / sigma)
    depth_row = _where(used.any(-1), cams[..., 2, :], [0.0, 0.0, 0.0, 1.0])
    return _Edges(
        clean[..., :3], clean[..., 3], gain, one_sided & used, used, depth_row,
        _where(used, sigma, 1.0), np.ones_like(gain),
    )  # fmt: skip


class _Rays(NamedTuple):
    """Rays through the centres of gathered boxes."""

    matrix: Array  # (O, V, 3, 4) cameras
    center: Array  # (O, V, 3) of the cameras
    direction: Array  # (O, V, 3), depth 1
    extent: Array  # (O, V, 2) widths and heights of the boxes at depth 1
    point: Array  # (O, 3) nearest to all rays of an object


def _rays(boxes: Array, cams: _Cameras, index: IntArray) -> _Rays:
    """Back-project boxes (O, V, 4) of frames index (O, V), -1 where there is none."""
    seen = index >= 0
    boxes = _where(seen, boxes, [0.0, 0.0, 1.0, 1.0])
    inverse = _where(seen, cams.ray[index], np.eye(3))
    center = _where(seen, cams.center[index])
    mid = 0.5 * (boxes[..., :2] + boxes[..., 2:])
    ones = np.ones((*mid.shape[:-1], 1))
    ray = np.einsum("ovij,ovj->ovi", inverse, np.concatenate([mid, ones], -1))
    pixel = np.linalg.norm(inverse[..., :2], axis=-2)  # (O, V, 2) size of one px at depth 1
    extent = (boxes[..., 2:] - boxes[..., :2]) * pixel
    point = _ray_point(center, ray, seen.astype(np.float64))
    return _Rays(_where(seen, cams.matrix[index], np.eye(3, 4)), center, ray, extent, point)


def _ray_point(center: Array, ray: Array, weight: Array) -> Array:
    """Intersect rays (O, V, 3) from `center` (O, V, 3) by weighted least squares: points (O, 3)."""
    unit = _unit(ray)
    across = np.eye(3) - unit[..., :, None] * unit[..., None, :]  # (O, V, 3, 3)
    lhs = np.einsum("ov,ovij->oij", weight, across) + 1e-9 * np.eye(3)
    shift = np.einsum("ov,ovi->oi", weight, center) / np.maximum(weight.sum(1), 1e-12)[:, None]
    rhs = np.einsum("ov,ovij,ovj->oi", weight, across, center - shift[:, None], optimize=True)
    return np.asarray(shift + _solve(lhs, rhs))


def _cosines(center: Array, point: Array) -> Array:
    """Compute cosines (O, V, V) of the angles at which points (O, 3) see pairs of cameras."""
    view = center - point[:, None]
    view = view / np.maximum(np.linalg.norm(view, axis=-1, keepdims=True), 1e-300)
    return np.asarray(view @ view.transpose(0, 2, 1))


# ---- Size priors ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Priors:
    """Size, axis-ratio and shape priors of C categories, as arrays."""

    names: tuple[str, ...]
    aliases: Mapping[str, str]
    log_mean: Array  # (C, 3) log of full size in metres: width, depth, height
    log_cov: Array  # (C, 3, 3)
    ratio_mean: Array  # (C, 2) mean of log(w/h), log(d/h)
    ratio_cov: Array  # (C, 2, 2)
    support: IntArray  # (C,) `Shape`; Shape.BY_EVIDENCE ("auto"): by model selection
    yaw_symmetric: BoolArray  # (C,)
    upright: BoolArray  # (C,)
    on_floor: BoolArray  # (C,) objects of the category stand on the floor

    def index(self, categories: Sequence[str | None]) -> IntArray:
        """Find the row of each category (O,): of its name, else of what it is a synonym of; or -1.

        A synonym may have a row: "monitor" means the same as "tv", but is smaller.
        """
        row_of = {_normalised(name): k for k, name in enumerate(self.names)}
        aliases = _normalised_aliases(self.aliases)
        names = [_followed(_normalised(c or ""), aliases, row_of) for c in categories]
        return np.array([row_of.get(name, -1) for name in names], np.int64)

    def of(self, column: str, rows: IntArray) -> npt.NDArray[Any]:
        """Return a column of the priors for rows (O,), -1: of an unknown category."""
        values = getattr(self, column)
        unknown = np.broadcast_to(UNKNOWN_CATEGORY[column], (1, *values.shape[1:]))
        return np.asarray(np.concatenate([values, unknown])[rows])

    def canonical(self, names: Sequence[str]) -> list[str]:
        """Replace synonyms by one name of their category, in lower case; other names stay.

        Names that mean the same get the same name.
        """
        aliases = _normalised_aliases(self.aliases)
        return [_followed(_normalised(name), aliases) for name in names]

    def meant(self, word: str, names: Sequence[str]) -> list[int]:
        """List the rows of names that a word means: of that name, else of its synonyms."""
        same = [k for k, name in enumerate(names) if _normalised(name) == _normalised(word)]
        one, *others = self.canonical([word, *names])
        return same or [k for k, name in enumerate(others) if name == one]


def _normalised_aliases(aliases: Mapping[str, str]) -> dict[str, str]:
    """Return the normalised name for each normalised synonym."""
    pairs = ((_normalised(alias), _normalised(name)) for alias, name in aliases.items())
    return {alias: name for alias, name in pairs if alias != name}


def _normalised(name: str) -> str:
    """Normalise a category: "Potted_Plant" and "potted plant" are the same."""
    return re.sub(r"[\s_\-]+", " ", name.strip().lower())


def _followed(name: str, aliases: Mapping[str, str], known: Container[str] = ()) -> str:
    """Follow synonyms from a normalised name, as far as a known name; a circle ends somewhere."""
    for _ in aliases:
        if name in known or name not in aliases:
            break
        name = aliases[name]
    return name


def load_priors(
    path: str | Path | None = None, more: Mapping[str, Mapping[str, Any] | str] | None = None
) -> Priors:
    """Read a priors.json (default: the one beside this file).

    Keys "about" and "aliases" are reserved; every other key is a category.

    Args:
        more: entries of the same form that are added or replaced; a string: the entry of that
            category.
    Raises:
        QuadricsError: no such JSON, a field is missing or invalid, or no such category.
    """
    path = Path(__file__).with_name("priors.json") if path is None else Path(path)
    fault = "not valid JSON"
    try:
        table = dict(json.loads(path.read_text(encoding="utf-8")))
        aliases = {a: str(name) for a, name in dict(table.pop("aliases", {})).items()}
        table.pop("about", None)
        fault = "a category has a missing or invalid field"
        table = _with_more(table, aliases, more or {})
        return Priors(tuple(table), aliases, *_prior_columns(map(_prior_row, table.values())))
    except QuadricsError:
        raise
    except (AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        raise QuadricsError(f"{path}: {fault} ({error}); see docs/quadrics.md") from error


def _with_more(
    table: dict[str, Any], aliases: Mapping[str, str], more: Mapping[str, Mapping[str, Any] | str]
) -> dict[str, Any]:
    """Add or replace entries of the table of a priors.json."""
    known = {_normalised(name): entry for name, entry in table.items()}
    entries = {}
    for word, entry in more.items():
        if isinstance(entry, str):
            like = _followed(_normalised(entry), _normalised_aliases(aliases), known)
            if like not in known:
                raise QuadricsError(f"{entry}: no such category of size priors")
            entry = known[like]
        entries[_normalised(word)] = entry
    return {name: e for name, e in table.items() if _normalised(name) not in entries} | entries


@np.errstate(over="ignore", invalid="ignore")  # values that are not finite are refused below
def _prior_row(entry: Mapping[str, Any]) -> list[Any]:
    """Parse one category into the columns of `Priors`; "axis_ratio" defaults to that of the sizes.

    Raises:
        ValueError: a size or variance is not finite or not positive.
    """
    size = entry["size_m"]
    mean, std = (np.array(size[key], np.float64).reshape(3) for key in ("mean", "log_std"))
    corr = np.eye(3)
    corr[np.triu_indices(3, 1)] = size.get("corr", 0.0)  # of w d, w h, d h
    log_mean = np.log(np.where(mean > 0, mean, np.nan))
    log_cov = (corr + np.triu(corr, 1).T) * std[:, None] * std
    difference = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])
    implied = {"mean_log": difference @ log_mean, "cov_log": difference @ log_cov @ difference.T}
    ratio = entry.get("axis_ratio", implied)
    ratio_mean = np.array(ratio["mean_log"], np.float64).reshape(2)
    ratio_cov = np.array(ratio["cov_log"], np.float64).reshape(2, 2)
    values = (log_mean, log_cov, ratio_mean, ratio_cov)
    finite = all(np.isfinite(x).all() for x in values)
    if not finite or min(np.linalg.eigvalsh(cov)[0] for cov in (log_cov, ratio_cov)) <= 0:
        raise ValueError("sizes and variances must be finite and positive")
    shape = entry.get("support", "ellipsoid")
    code = Shape.BY_EVIDENCE if shape == "auto" else SUPPORTS.index(shape)
    round_ = bool(entry.get("yaw_symmetric", False))
    upright = bool(entry.get("upright", True))
    return [*values, int(code), round_, upright, entry.get("stands_on") == "floor"]


@dataclass(frozen=True, slots=True)
class SizePrior:
    """Log-normal prior of the size of an object.

    Attributes:
        mean_m: m, geometric mean of width, depth and height.
        size_log: log, standard deviation of the common size.
        aspect_log: log, standard deviation of each axis about the common size.
    """

    mean_m: tuple[float, float, float]
    size_log: float
    aspect_log: float


# of a category that is unknown: the distribution of the 110 indoor categories of priors.json
UNKNOWN_SIZE = SizePrior(mean_m=(0.29, 0.25, 0.25), size_log=0.9, aspect_log=0.6)


UNKNOWN_CATEGORY: dict[str, Any] = {
    "log_mean": np.log(UNKNOWN_SIZE.mean_m),
    "log_cov": UNKNOWN_SIZE.aspect_log**2 * np.eye(3) + UNKNOWN_SIZE.size_log**2,
    "ratio_mean": np.zeros(2),
    "ratio_cov": 0.5 * np.eye(2) + 0.25,
    "support": -1,
    "yaw_symmetric": False,
    "upright": True,
    "on_floor": False,
}


def _prior_columns(rows: Iterable[list[Any]]) -> list[npt.NDArray[Any]]:
    """Arrange rows of priors as columns, each with the rank of its value of an unknown category."""
    table = list(rows)
    return [
        np.array([row[k] for row in table], np.asarray(x).dtype).reshape(-1, *np.shape(x))
        for k, x in enumerate(UNKNOWN_CATEGORY.values())
    ]


NO_PRIORS = Priors((), {}, *_prior_columns([]))


# ---- Hypotheses: priors of the objects in world units --------------------------------------


class _Given(NamedTuple):
    """Arguments of `fit_objects` about the L live objects, besides their boxes."""

    rows: IntArray  # (L,) of the categories in the priors, -1 unknown
    priors: Priors
    codes: IntArray  # (L,) `Shape`
    points: Array  # (L, P, 3), NaN: no point
    sizes: list[tuple[int, int, float]]  # row, axis of the prior, metres
    wrong_class: float  # probability that a category is wrong


@dataclass(frozen=True, slots=True)
class _Spec:
    """Priors of H hypotheses about the objects.

    An object without a known category has one hypothesis, any other has two: the category is right,
    or it is wrong and the priors of unknown categories hold. If the category is round, a third one:
    it is right, but this object is not round.
    """

    obj: IntArray  # (H,) object; the first hypotheses are those of objects 0, 1, ... in order
    log_odds: Array  # (H,) log of the hypothesis's probability, and of its density on the floor
    size_mean: Array  # (H, 3) log half axes, world units
    size_cov: Array  # (H, 3, 3)
    kind: IntArray  # (H,) row of the category in the priors, -1 unknown or wrong
    natural: IntArray  # (H,) shape to which the size prior applies, -1 unknown category
    allowed: BoolArray  # (H, 3) shapes to try
    round_: BoolArray  # (H,) yaw symmetric
    upright: BoolArray  # (H,)
    up: Array  # (3,) unit or zeros
    tilt_rad: float  # sigma of an object's vertical axis about `up`
    floor: Array  # (4,) plane n, d: n x = d
    floor_sigma: Array  # (H,) of the height of an object's lower side; inf: need not stand there
    points: Array  # (H, P, 3) that may lie on the object
    point_weight: Array  # (H, P) of the points, 0: no point


# Probability that an object of a yaw-symmetric category is not round, as a flat bottle (without
# this hypothesis 30 of 38 refitted recordings change)
NOT_ROUND = 0.03
FREE_CORR = 0.3  # correlation of its log sizes, as of the other categories
STANDING_REL = 0.012  # sigma of the lower side's height over the floor, over the object's height
# Total weight of an object's points: the errors of neighbours correlate (10 to 60 are alike)
POINTS_WORTH = 20.0


def _prior_spec(given: _Given, world: _World) -> _Spec:
    """Look up the priors of size, shape and uprightness in world units; list the hypotheses."""
    priors = given.priors
    # without a scale all sizes are free: a wrong category is considered by `_scale_from_priors`
    doubts = given.wrong_class > 0 and world.scale_sigma < UNKNOWN_SCALE_LOG
    obj, rows, flat, log_odds = _hypotheses(given, doubts)
    codes = given.codes[obj]
    points = given.points[obj]
    cov = priors.of("log_cov", rows)  # (H, 3, 3)
    sigma = np.sqrt(_diagonal(cov[flat]))
    cov[flat] = (FREE_CORR + (1.0 - FREE_CORR) * np.eye(3)) * sigma[:, :, None] * sigma[:, None]
    natural = priors.of("support", rows)
    code = np.where(codes == Shape.BY_EVIDENCE, -1, np.where(codes >= 0, codes, natural))  # (H,)
    allowed = (code[:, None] == np.arange(3)) | (code < 0)[:, None]
    size_mean = priors.of("log_mean", rows) - np.log(2.0) - world.log_scale
    plane = np.zeros(4)
    floor_sigma = np.full(len(obj), np.inf)
    if world.floor is not None and world.scale_source != "none":
        plane = np.append(world.floor.normal, world.floor.offset)
        stands = priors.of("on_floor", rows)
        standing_sigma = STANDING_REL * 2.0 * np.exp(size_mean[:, 2])
        floor_sigma = np.where(stands, np.hypot(world.floor.sigma, standing_sigma), np.inf)
        elsewhere = 1.0 / np.exp(world.log_scale)  # 1 m, sigma of the height of other objects
        log_odds += np.where(stands, np.log(elsewhere / floor_sigma), 0.0)
    is_point = _finite(points, 2)  # (H, P)
    weight = is_point * np.minimum(POINTS_WORTH / np.maximum(is_point.sum(1, keepdims=True), 1), 1)
    return _Spec(
        obj, log_odds, size_mean, cov + world.scale_sigma**2, rows, natural, allowed,
        priors.of("yaw_symmetric", rows) & ~flat, priors.of("upright", rows), world.up,
        world.tilt_rad, plane, floor_sigma, _where(is_point, points), weight,
    )  # fmt: skip


def _hypotheses(given: _Given, doubts: bool) -> tuple[IntArray, IntArray, BoolArray, Array]:
    """List the hypotheses about the objects; see `_Spec`.

    Returns:
        object (H,), row of the category (H,), is the object not round (H,), log of the probability
        (H,).
    """
    rows = given.rows
    wrong = np.flatnonzero((rows >= 0) & doubts)
    turned = wrong[given.priors.of("yaw_symmetric", rows[wrong])]
    obj = np.concatenate([np.arange(len(rows)), wrong, turned])
    first_flat = len(rows) + len(wrong)
    log_odds = np.where(rows >= 0, np.log1p(-given.wrong_class), 0.0)[obj]
    if doubts:
        log_odds[turned] += np.log1p(-NOT_ROUND)
        log_odds[len(rows) : first_flat] = np.log(given.wrong_class / len(SUPPORTS))
        log_odds[first_flat:] += np.log(NOT_ROUND)
    rows = np.concatenate([rows, np.full(len(wrong), -1), rows[turned]])
    return obj, rows, np.arange(len(obj)) >= first_flat, log_odds


@dataclass(frozen=True, slots=True)
class _Problem(Rows):
    """Priors, floor and points of B problems, constant during the optimisation."""

    groups: Array  # (B, 3, 3) of AXIS_GROUPS
    log_odds: Array  # (B,) of the hypothesis
    kind: IntArray  # (B,) row of the category in the priors, -1 unknown or wrong
    overrules: BoolArray  # (B,) the hypothesis is that the category of the object is wrong
    size_mean: Array  # (B, 3) prior of log half axes, world units
    size_cov: Array  # (B, 3, 3)
    own_info: Array  # (B, 3, 3) inverse of the covariance
    size_info: Array  # (B, 3, 3) the same; ties width and depth of round objects
    size_var: Array  # (B, 3) its variance an axis, at least SIZE_WALL_LOG^2: the unit of SIZE_WALL
    up: Array  # (B, 3) unit, or zeros
    tilt_info: Array  # (B, 3) 1 / rad^2 for the three components of up in object axes
    vertical: Array  # (B, 3) 1 for the vertical axis
    floor: Array  # (B, 4) plane n, d: n x = d
    floor_info: Array  # (B,) 1 / sigma^2 of the height of the lower side over the floor; 0: free
    points: Array  # (B, P, 3) that may lie on the object
    point_weight: Array  # (B, P) of the points, 0: no point
    point_sigma: Array  # (B,) of a point's distance outside the solid, world units


ROUND_LOG = 0.05  # log, sigma of width / depth of yaw-symmetric categories
SIZE_WALL_LOG = 0.25  # log, least sigma of which SIZE_WALL is a multiple: a category may be wrong
# Sigma of a point's distance, over the usual half width of the category (hololens_kitchen and
# redkitchen: .05 to .15 are alike)
POINT_REL = 0.08


def _problems(spec: _Spec, hyp: IntArray, code: IntArray, axis: IntArray) -> _Problem:
    """Gather the constant terms of fits of a hypothesis, shape and vertical axis, each (B,)."""
    mean = spec.size_mean[hyp]
    shift = _shape_shift(mean, spec.natural[hyp], code)
    vertical = np.eye(3)[axis]
    tilt = (1.0 - vertical) / spec.tilt_rad**2 * bool(np.any(spec.up))
    round_ = spec.round_[hyp] | ((code == Shape.CYLINDER) & (spec.natural[hyp] != Shape.CYLINDER))
    tie = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) / ROUND_LOG**2
    own_info = np.asarray(np.linalg.inv(spec.size_cov)[hyp], np.float64)
    level = 0.5 * (mean[:, [0, 0, 2]] + mean[:, [1, 1, 2]])
    mean = np.where(round_[:, None], level, mean)
    kind = spec.kind[hyp]
    var = np.maximum(_diagonal(spec.size_cov), SIZE_WALL_LOG**2)[hyp]
    # without a category the axes' errors are common: their mean square counts, not the sum
    var = np.where(kind[:, None] < 0, 3.0 * var, var)
    overrules = (kind < 0) & (spec.kind[spec.obj[hyp]] >= 0)
    up, floor = (np.tile(x, (len(hyp), 1)) for x in (spec.up, spec.floor))
    return _Problem(
        AXIS_GROUPS[code], spec.log_odds[hyp], kind, overrules, mean + shift[:, None],
        spec.size_cov[hyp], own_info,
        own_info + round_[:, None, None] * tie, var, up, tilt, vertical, floor,
        spec.floor_sigma[hyp] ** -2.0, spec.points[hyp], spec.point_weight[hyp],
        POINT_REL * np.exp(mean.mean(1)),
    )  # fmt: skip


def _shape_shift(log_half: Array, natural: IntArray, code: IntArray) -> Array:
    """Compute the log ratio (B,) of the sizes of shape `code` and of shape `natural`.

    An ellipsoid tangent to the boxes of a cuboid is larger than the cuboid. Both have the same mean
    support: sum(a) / 2 and sqrt(sum(a^2) / 3) (rms over directions; 1.5 for a cube, 1 for a rod).
    """
    half = np.exp(log_half - log_half.max(1, keepdims=True))
    factor = 0.5 * half.sum(1) / np.sqrt((half**2).sum(1) / 3.0)
    shift = np.log(np.clip(factor, 1.0, 1.5))
    swapped = np.where((natural == Shape.BOX) & (code == Shape.ELLIPSOID), shift, 0.0)
    return swapped - np.where((natural == Shape.ELLIPSOID) & (code == Shape.BOX), shift, 0.0)


# ---- All steps of the fit of one pass ------------------------------------------------------


@dataclass(slots=True)
class _Fit(Rows):
    """Fits of B problems (later: the best one of each object)."""

    obj: IntArray  # (B,)
    hyp: IntArray  # (B,) hypothesis of `_Spec`
    code: IntArray  # (B,) shape
    axis: IntArray  # (B,) vertical axis
    prob: _Problem
    state: _State
    hessian: Array  # (B, 9, 9) at unit noise
    inlier: BoolArray  # (B, V, E) edges in use
    noise: Array  # (B,) factor on the nominal edge sigma
    common: Array  # (B,) part of it for errors that all boxes of the object have in common
    evidence: Array  # (B,)
    views: BoolArray  # (B, V) inlier views
    spread: Array  # (B, 9, 9) second moment of the other local minima


def _fit_all(data: _Data, spec: _Spec, cfg: FitConfig) -> _Fit:
    """Fit every object: starts, robust fit, noise level, inliers, final fit, model selection."""
    few = data.take_views(cfg.start_views)
    fit = _best_starts(few, spec, cfg)
    _refit(fit, few, cfg, _cauchy_loss)
    fit.evidence = _log_evidence(fit, _all_residuals(fit, few), few)
    # 3 in 1,000 of the winners on all views are lower than this on the first (simulated boxes)
    likely = fit.evidence >= -6.0 - _least(-fit.evidence, fit.obj)
    fit = fit[likely | ~fit.prob.overrules & (fit.evidence >= _best_of_category(fit))]
    fit.inlier = data.edges.used[fit.obj]
    _refit(fit, data, cfg, _cauchy_loss)
    for largest in (None, HUBER):
        value = _all_residuals(fit, data)
        _update_noise(fit, value, data, largest)
        _refit_inliers(fit, value, data, cfg)
    fit.evidence = _log_evidence(fit, _all_residuals(fit, data), data)
    fit = _best_of_groups(fit, fit.hyp)
    doubted = fit[fit.prob.overrules & (fit.evidence > _best_of_category(fit))]
    if len(doubted):
        kept = doubted.obj[_log_odds_of_sizes(doubted, data, spec) <= 0]
        fit = fit[~fit.prob.overrules | ~np.isin(fit.obj, kept)]
    fit = _best_of_groups(fit, fit.obj)
    for _ in range(2 if cfg.wrong_class > 0 else 0):
        _allow_common_errors(fit, data, cfg)
    return fit


def _group_starts(*keys: IntArray) -> BoolArray:
    """Mark where a sorted list of key tuples starts a new group."""
    first = np.ones(len(keys[0]), bool)
    first[1:] = np.any([np.diff(key) != 0 for key in keys], axis=0)
    return first


def _refit(fit: _Fit, data: _Data, cfg: FitConfig, loss: _Loss) -> None:
    """Minimise over all views with the fit's inlier edges and noise level, in place."""
    solved = _minimise_all(
        fit.state, lambda rows: _inlier_edges(fit, data, rows), fit.prob, loss, cfg.iterations
    )
    fit.state = solved.state
    fit.hessian = solved.hessian


def _refit_inliers(fit: _Fit, value: Array, data: _Data, cfg: FitConfig) -> None:
    """Classify edges by their residuals (B, V, E) in nominal sigma, and fit again, in place."""
    used = data.edges.used[fit.obj]
    standard = value / fit.noise[:, None, None]  # (B, V, E)
    fit.views = _inlier_views(standard, used)
    fit.inlier = used & (np.abs(standard) <= EDGE_OUTLIER) & fit.views[..., None]
    _refit(fit, data, cfg, _huber_loss)


def _inlier_edges(fit: _Fit, data: _Data, rows: IntArray) -> _Edges:
    """Gather the inlier edges of problems at their noise level."""
    inlier = fit.inlier[rows]
    edges = data.edges[fit.obj[rows]]
    return replace(edges, gain=edges.gain * inlier / fit.noise[rows, None, None], used=inlier)


def _all_residuals(fit: _Fit, data: _Data) -> Array:
    """Compute residuals (B, V, E) in nominal sigma of all edges, outliers included."""
    residuals = np.zeros(fit.inlier.shape)
    for rows in _chunks(len(fit.obj)):
        edges = data.edges[fit.obj[rows]]
        value, _ = _residuals(fit.state[rows], edges, AXIS_GROUPS[fit.code[rows]], jacobian=False)
        residuals[rows] = value.reshape(residuals[rows].shape) * np.sqrt(edges.redundancy)
    return residuals


def _best_of_category(fit: _Fit) -> Array:
    """Return for each fit the highest evidence (B,) of its object's fits with the category."""
    return -_least(np.where(fit.prob.overrules, np.inf, -fit.evidence), fit.obj)


def _best_of_groups(fit: _Fit, group: IntArray) -> _Fit:
    """Keep the fit of highest evidence of each group (B,)."""
    order = np.lexsort((-fit.evidence, group))
    return fit[order[_group_starts(group[order])]]


def _least(values: Array, obj: IntArray) -> Array:
    """Return for each fit the lowest value (B,) of all fits to the same object."""
    best = np.full(int(obj.max()) + 1, np.inf)
    np.minimum.at(best, obj, values)
    return np.asarray(best[obj])


# ---- Starts --------------------------------------------------------------------------------


def _best_starts(few: _Data, spec: _Spec, cfg: FitConfig) -> _Fit:
    """Try all starts on few views; keep the best of each hypothesis and shape."""
    hyp, code, axis, yaw = _start_table(spec)
    center, log_half, agrees = _start_points(few[spec.obj], spec)
    edges = few.edges[spec.obj]
    used = edges.used & agrees[..., None]  # (H, S, E)
    edges = replace(edges, used=used, gain=edges.gain * used)
    prob = _problems(spec, hyp, code, axis)
    shift = _shape_shift(log_half[hyp], spec.natural[hyp], code)
    rot = _start_rotations(spec.up)[axis, yaw]
    start = _State(center[hyp], log_half[hyp] + shift[:, None], rot)
    solved = _minimise_all(
        start, lambda chunk: edges[hyp[chunk]], prob, _cauchy_loss, cfg.start_iterations
    )
    state = solved.state
    # noise level integrated out (Student t): an absurd size must not win by a slightly better fit
    pull = _size_prior(state, prob)[0]
    n = _count(used[hyp], few, spec.obj[hyp])
    misfit = np.log1p(np.maximum(solved.cost - pull, 0.0) / NOISE_PRIOR_DOF)
    cost = (NOISE_PRIOR_DOF + n) * misfit + pull
    order = np.lexsort((cost, code, hyp))  # groups of one hypothesis and shape, best first
    first = _group_starts(hyp[order], code[order])
    best = order[first][np.cumsum(first) - 1]  # (B,) best of its group, in sorted order
    delta = _state_difference(state[order], state[best], code[order])
    # The solution of each start has its likelihood ratio as weight: modes that the data do not
    # distinguish (yaw of a box in few views) widen the covariance by their second moment.
    weight = np.exp(-0.5 * np.clip(cost[order] - cost[best], 0.0, 100.0))
    delta = np.where((weight < 1e-3)[:, None], 0.0, delta)
    moment = weight[:, None, None] * delta[:, :, None] * delta[:, None]  # (B, 9, 9)
    total, mass = (np.add.reduceat(x, np.flatnonzero(first)) for x in (moment, weight))
    keep = order[first]
    inlier = used[hyp[keep]]
    noise, common, evidence = np.ones((3, len(keep)))
    return _Fit(
        spec.obj[hyp[keep]], hyp[keep], code[keep], axis[keep], prob[keep], state[keep],
        solved.hessian[keep], inlier, noise, common, evidence, np.asarray(inlier.any(-1)),
        total / mass[:, None, None],
    )  # fmt: skip


def _start_table(spec: _Spec) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """List the starts: hypothesis, shape, vertical axis, yaw, each (B,)."""
    n = len(spec.size_mean)
    use = np.ones((n, 3, 3, 4), bool) & spec.allowed[:, :, None, None]  # H, shape, axis, yaw
    use[spec.upright & bool(np.any(spec.up)), :, :2] = False  # up unknown: any axis is vertical
    use[:, Shape.CYLINDER, 1] = False  # a lying cylinder: axes 0 and 1 are equivalent
    round_ = (
        spec.round_[:, None]
        | (np.arange(3) == Shape.CYLINDER) & (spec.natural != Shape.CYLINDER)[:, None]
    )
    use[:, :, 2, 1:] &= ~round_[:, :, None]
    use[spec.natural < 0, :, 2, 2:] = False  # same prior of width and depth: symmetric by 90 deg
    hyp, code, axis, yaw = np.nonzero(use)
    return hyp, code, axis, yaw


def _start_rotations(up: Array) -> Array:
    """List rotations (3 axes, 4 yaws, 3, 3) with object axis k along up (z if up is zero)."""
    frame = np.eye(3)
    if np.any(up):
        x = np.cross(frame[np.argmin(np.abs(up))], up)
        x /= np.linalg.norm(x)
        frame = np.stack([x, np.cross(up, x), up], 1)
    yaws = rotations(np.outer(np.arange(4) * (np.pi / 4), [0.0, 0.0, 1.0]))  # (4, 3, 3)
    standing = np.eye(3)[:, [[2, 0, 1], [1, 2, 0], [0, 1, 2]]].transpose(1, 0, 2)  # (3, 3, 3)
    out: Array = frame @ yaws[None] @ standing[:, None]
    return out


START_OFFSET = 0.5  # box sizes, inlier threshold of the distance of a ray from the centre


def _start_points(data: _Data, spec: _Spec) -> tuple[Array, Array, BoolArray]:
    """Estimate robust starts from rays and prior depths.

    Candidates are the midpoints of all pairs of rays and one point a ray at the depth where the box
    has the prior's mean extent. The candidate of best consensus is refined by weighted least
    squares over the inlier rays and the prior depth with its sigma.

    Returns:
        centres (O, 3), log half axes (O, 3), and inlier (O, S) of the S views.
    """
    seen = data.edges.used.any(-1).astype(np.float64)  # (O, S)
    weight = seen * np.where(data.edges.one_sided.any(-1), 0.3, 1.0)  # less at the image border
    extent = np.maximum(data.extent.mean(-1), 1e-12)  # (O, S)
    common = spec.size_cov.mean((1, 2))  # (O,) variance of the common log size
    # of log prior depth: sizes differ, and an extent depends on the direction of the view (.3)
    sigma = np.sqrt(common + 0.3**2)[:, None]
    # mean extent of a box over all directions is sum(a): E|m_k| = 1 / 2, full size 2 a_k
    prior_depth = np.exp(spec.size_mean).sum(1)[:, None] / extent  # (O, S)
    single = data.cam_center + prior_depth[..., None] * data.ray
    points = np.concatenate([_pair_points(data.cam_center, data.ray), single], 1)  # (O, C, 3)
    misfit, depth = _ray_misfit(data, points)  # (O, C, S)
    ratio = np.log(np.maximum(depth, 1e-12) / prior_depth[:, None]) / sigma[:, None]
    vote = np.minimum(np.nan_to_num(misfit / START_OFFSET**2, nan=1.0), 1.0)
    vote += 0.1 * np.minimum(ratio**2, 4.0)
    best = np.argmin((vote * weight[:, None]).sum(-1), 1)  # (O,)
    row = np.arange(len(best))
    distance = 4.0 * np.nan_to_num(misfit[row, best], posinf=1e6) / START_OFFSET**2  # (O, S)
    agree = weight / (1.0 + distance) ** 2
    center, z = _refine_start(data, single, points[row, best], agree, prior_depth, sigma)
    seen_size = (agree * z * extent).sum(1) / np.maximum(agree.sum(1), 1e-12)
    growth = np.log(np.maximum(seen_size, 1e-12)) - np.log(np.exp(spec.size_mean).sum(1))
    gain = common / (common + 0.25**2)  # sigma of the log size from extents and depths
    log_half = spec.size_mean + (gain * np.clip(growth, -12.0, 12.0))[:, None]
    inlier = (seen > 0) & (distance < 4.0)
    inlier |= (2.0 * inlier.sum(1) < seen.sum(1))[:, None]  # no majority: all views are used
    return center, log_half, inlier


def _pair_points(cam_center: Array, ray: Array) -> Array:
    """Find the midpoints (O, S (S - 1) / 2, 3) of the shortest segments between pairs of rays."""
    i, j = np.triu_indices(ray.shape[1], 1)
    unit = _unit(ray)
    a = unit[:, i]
    b = unit[:, j]
    base = cam_center[:, j] - cam_center[:, i]
    cos = (a * b).sum(-1)
    det = np.maximum(1.0 - cos**2, 1e-12)
    s = ((base * a).sum(-1) - cos * (base * b).sum(-1)) / det
    t = (cos * (base * a).sum(-1) - (base * b).sum(-1)) / det
    middle = cam_center[:, i] + s[..., None] * a + cam_center[:, j] + t[..., None] * b
    return np.asarray(0.5 * middle)


def _ray_misfit(data: _Data, points: Array) -> tuple[Array, Array]:
    """Project points (O, C, 3): squared distances from box centres in box sizes, depths.

    Both (O, C, V).
    """
    rows = data.edges.depth_row
    depth = np.einsum("ocj,ovj->ocv", points, rows[..., :3]) + rows[:, None, :, 3]
    safe = np.where(depth > 0, depth, np.inf)[..., None]
    delta = (points[:, :, None] - data.cam_center[:, None]) / safe - data.ray[:, None]
    size = np.linalg.norm(data.extent, axis=-1)[:, None]  # (O, 1, V)
    misfit = (delta**2).sum(-1) / np.maximum(size, 1e-12) ** 2 * 2.0
    return np.where(depth > 0, misfit, np.inf), depth


def _refine_start(
    data: _Data, single: Array, center: Array, agree: Array, prior_depth: Array, sigma: Array
) -> tuple[Array, Array]:
    """Refine centres (O, 3) by weighted least squares over rays and prior depths.

    Args:
        single: (O, S, 3) points of the rays at `prior_depth` (O, S), whose sigma is `sigma` (log).
        agree: (O, S) weights.
    Returns:
        centres (O, 3) and their depths (O, S).
    """
    unit = _unit(data.ray)
    along = unit[..., :, None] * unit[..., None, :]  # (O, S, 3, 3)
    extent = np.maximum(data.extent.mean(-1), 1e-12)
    z = np.abs(_ray_misfit(data, center[:, None])[1][:, 0]) + 1e-9  # (O, S)
    count = np.maximum((agree > 0).sum(1), 1)[:, None]
    for _ in range(2):
        across = agree / (z * 0.1 * extent) ** 2  # a box's centre is the object's to a tenth of it
        depth = agree / (prior_depth * sigma) ** 2 / count  # the error is common to all views
        info = across[..., None, None] * (np.eye(3) - along) + depth[..., None, None] * along
        target = (info @ (single - center[:, None])[..., None]).sum(1)[..., 0]  # (O, 3)
        lhs = info.sum(1)
        size = np.trace(lhs, axis1=1, axis2=2) + 1e-300
        step = _solve(lhs / size[:, None, None] + 1e-12 * np.eye(3), target / size[:, None])
        new_z = _ray_misfit(data, (center + step)[:, None])[1][:, 0]  # (O, S)
        accepted = _finite(step, 1) & (((new_z > 0) * agree).sum(1) > 0.5 * agree.sum(1))
        center = np.where(accepted[:, None], center + step, center)
        z = np.where(accepted[:, None], np.maximum(new_z, 1e-9), z)
    return center, z


def _state_difference(a: _State, b: _State, code: IntArray) -> Array:
    """Find the smallest increment (B, 9) from solid b to solid a over permutations of a's axes."""
    axes = nearest_axes(a.rot, b.rot, code == Shape.CYLINDER)  # (B, 3, 3)
    rotvec = rotation_vectors(b.rot.transpose(0, 2, 1) @ (a.rot @ axes))
    half = (np.abs(axes).transpose(0, 2, 1) @ a.log_half[..., None])[..., 0]
    return np.concatenate([a.center - b.center, half - b.log_half, rotvec], 1)


def nearest_axes(rot: Array, target: Array, keep_third: BoolArray | bool = False) -> Array:
    """Find the rotations of axes onto themselves that bring frames nearest to others.

    Args:
        rot, target: (B, 3, 3) rotations. keep_third: (B,) the third axis keeps its place.
    Returns:
        (B, 3, 3): rot @ these are nearest to target.
    """
    group = np.array([np.eye(3)[:, order] * s for order in AXIS_ORDERS for s in -SIGNS.T])
    group = group[np.linalg.det(group) > 0]  # the 24 rotations of the axes onto themselves
    trace = np.einsum("bij,bgij->bg", target, rot[:, None] @ group)
    keeps_axis = np.abs(group[:, 2, 2]) > 0.5
    trace = np.where(np.reshape(keep_third, (-1, 1)) & ~keeps_axis, -9.0, trace)
    return np.asarray(group[np.argmax(trace, 1)])


# ---- Noise level and inliers ---------------------------------------------------------------

NOISE_PRIOR_DOF = 12.0  # residuals, weight of the nominal noise level
OBJECT_NOISE_DOF = 20.0  # residuals, weight of the pooled noise level in that of one object


def _update_noise(fit: _Fit, value: Array, data: _Data, largest: float | None) -> None:
    """Estimate the noise factor: pooled over all objects, then per object with shrinkage.

    Inverse-gamma posteriors: prior weights NOISE_PRIOR_DOF of the nominal and OBJECT_NOISE_DOF of
    the pooled level. The pooled level is the median over the objects, so that objects in a segment
    of bad poses do not affect the others.

    Args:
        largest: residual (sigma) above which residuals count as this large; None: the median
            residual is used, not the mean square.
    """
    n = np.maximum(_count(fit.inlier, data, fit.obj), 1.0)
    dof = _free_dof(fit, data)
    if largest is None:
        size = np.where(fit.inlier, np.abs(value), np.nan).reshape(len(n), -1)
        size[~fit.inlier.any((1, 2))] = 0.0
        square = (np.nanmedian(size, 1) / 0.6745) ** 2 * n  # .6745: median of |N(0, 1)|
    else:
        capped = np.minimum(value**2, (largest * fit.noise[:, None, None]) ** 2)
        square = (capped * fit.inlier / data.edges.redundancy[fit.obj]).sum((1, 2))
    level = square / dof
    best = level <= _least(level, fit.obj)  # the hypothesis and shape of each object that fits best
    level /= (1.0 - 2.0 / (9.0 * dof)) ** 3  # median of chi2 / dof. Ref: Wilson and Hilferty 1931
    median = _weighted_median(level[best], np.minimum(dof[best], OBJECT_NOISE_DOF))
    total = dof[best].sum()
    pooled = (NOISE_PRIOR_DOF + median * total) / (NOISE_PRIOR_DOF + total)
    variance = (OBJECT_NOISE_DOF * pooled + square) / (OBJECT_NOISE_DOF + dof)
    fit.noise = np.clip(np.sqrt(variance), 0.05, 20.0)


def _free_dof(fit: _Fit, data: _Data) -> Array:
    """Compute degrees of freedom (B,): residuals minus the trace of the hat matrix."""
    prior_info = np.zeros((len(fit), 9, 9))
    prior_info[:, 3:6, 3:6] = fit.prob.own_info
    cov = _safe_inverse(fit.hessian)
    trace = 9.0 - np.einsum("bij,bji->b", cov, prior_info)
    trace -= 2.0 * bool(fit.prob.up.any())  # tilt: two angles determined by the upright prior
    return np.asarray(np.maximum(_count(fit.inlier, data, fit.obj) - np.clip(trace, 3.0, 9.0), 0.5))


def _count(used: BoolArray, data: _Data, obj: IntArray) -> Array:
    """Compute the effective number (B,) of independent residuals of the edges (B, V, E) in use."""
    return np.asarray((used / data.edges.redundancy[obj]).sum((1, 2)))


def _weighted_median(values: Array, weight: Array) -> float:
    """Compute the weighted median of values (N,)."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _inlier_views(standard: Array, used: BoolArray) -> BoolArray:
    """Classify views (...) as inliers of the solid by their residuals (..., E) in sigma.

    Of an inlier three quarters of the edges are inliers; or half of them where all other residuals
    are positive, as of a partly occluded object.
    """
    close = used & (np.abs(standard) <= EDGE_OUTLIER)
    fraction = close.sum(-1) / np.maximum(used.sum(-1), 1)
    occluded = ~(used & (standard < -EDGE_OUTLIER)).any(-1)
    inlier = (fraction >= 0.75) | ((fraction >= 0.5) & occluded)
    return np.asarray(used.any(-1) & inlier)


def _inlier_table(
    solids: Ellipsoids, codes: IntArray, noise: Array, measured: _Measured, cfg: FitConfig
) -> BoolArray:
    """Apply the inlier test (F, O) to all usable boxes, including those that were not fitted."""
    inlier = np.zeros(measured.usable.shape, bool)
    frame, obj = np.nonzero(measured.usable)
    for chunk in _chunks(len(frame), 60000):  # bounds the memory
        o = obj[chunk]
        at = (frame[chunk, None], o[:, None])
        cams = measured.cams.matrix[at[0]]
        edges = _tangent_planes(measured.boxes[at], cams, measured.one_sided[at], cfg)
        solid = solids[o]
        state = _State(solid.center_in_world, np.log(solid.half_axes), solid.world_from_obj)
        value = _residuals(state, edges, AXIS_GROUPS[codes[o]], jacobian=False)[0]
        inlier[frame[chunk], o] = _inlier_views(value / noise[o, None], edges.used[:, 0])
    return inlier


# ---- Evidence, and doubts about the category -----------------------------------------------

# Fraction of the objects on the floor whose lower part is occluded in all views
OCCLUDED_BELOW = 0.25


def _log_evidence(fit: _Fit, value: Array, data: _Data) -> Array:
    """Compute the Laplace evidence (B,) of each fit, noise integrated out (Student t).

    -2 log p = (v + n) log(1 + S / v) + priors of size, tilt, floor + log det(H) + 6 log(depth)
    - log det(information of the size prior) - 2 log_odds, S the truncated squares.
    The lower part of an object on a known floor may be occluded in all views: with probability
    OCCLUDED_BELOW, positive residuals in views whose lower edge is above the floor are free.
    """
    used = data.edges.used[fit.obj]
    pull = _prior_terms(fit.state, fit.prob).cost
    standard = value / _least(fit.noise, fit.obj)[:, None, None]  # (B, V, E)
    cap = np.where(value > 0, OCCLUDED_CAP, OUTLIER_CAP)
    cost = np.minimum(standard**2, cap) * used / data.edges.redundancy[fit.obj]
    dof = NOISE_PRIOR_DOF + _count(used, data, fit.obj)
    misfit = dof * np.log1p(cost.sum((1, 2)) / NOISE_PRIOR_DOF)
    stands = fit.prob.floor_info > 0
    above = stands[:, None] & (standard[..., 3] > EDGE_OUTLIER)  # (B, V), lower edge
    free = above[..., None] & (value > 0)
    free[..., 1] = False  # upper edge
    occluded = dof * np.log1p(np.where(free, 0.0, cost).sum((1, 2)) / NOISE_PRIOR_DOF)
    either = np.logaddexp(
        np.log1p(-OCCLUDED_BELOW) - 0.5 * misfit, np.log(OCCLUDED_BELOW) - 0.5 * occluded
    )
    fits_boxes = np.where(stands, either, -0.5 * misfit)
    determinant = np.linalg.slogdet(fit.hessian + ROTATION_CAP)[1]
    determinant -= np.linalg.slogdet(fit.prob.size_info)[1]
    # a centre is uniform in direction and log distance: the volume of its region, over depth^3
    determinant += 6.0 * np.log(_mean_depth(fit.state, data.edges[fit.obj]))
    return np.asarray(fits_boxes - 0.5 * (pull + determinant) + fit.prob.log_odds)


def _log_odds_of_sizes(fit: _Fit, data: _Data, spec: _Spec) -> Array:
    """Compute the log odds (B,) of the sizes of all categories against those of the category.

    They are a ratio of marginal likelihoods of the boxes, infinite where the boxes determine the
    size. The likelihood of the log size x is normal; its information I is that of the posterior
    without a category, less the prior's. Of a prior N(m, S), but for a constant:
    -2 log p = log det S + log det(I + S^-1) + m' S^-1 m - b' (I + S^-1)^-1 b, b = I x + S^-1 m.
    The axes of the category may have any order that its uprightness allows.
    """
    cov = _curved_covariance(fit, data)[:, 3:6, 3:6]
    usual = _problems(spec, fit.obj, fit.code, fit.axis)
    own = fit.prob.own_info
    mean = fit.prob.size_mean
    value, vector = _eigh(_safe_inverse(cov) - own)
    info = (vector * np.maximum(value, 0.0)[:, None]) @ vector.transpose(0, 2, 1)
    at = fit.state.log_half[..., None]  # (B, 3, 1), where the gradients of both terms cancel
    pull_here = vector.transpose(0, 2, 1) @ (own @ (at - mean[..., None]))
    known = info @ at + vector @ np.where(value[..., None] > 0, pull_here, 0.0)

    def cost(mean: Array, prior: Any) -> Array:
        pull = prior @ mean[..., None]  # (B, 3, 1)
        b = known + pull
        both = info + prior
        square = (mean * pull[..., 0]).sum(1) - (b * np.linalg.solve(both, b)).sum((1, 2))
        return np.asarray(np.linalg.slogdet(both)[1] - np.linalg.slogdet(prior)[1] + square)

    same_up = spec.upright[fit.obj] & bool(np.any(spec.up))
    costs = [
        np.where(
            same_up & (order[2] != 2),
            np.inf,
            cost(usual.size_mean[:, order], usual.own_info[:, order][:, :, order]),
        )
        for order in AXIS_ORDERS
    ]
    odds = fit.prob.log_odds - usual.log_odds + np.log(len(SUPPORTS))
    determined = (_diagonal(cov) < LOOSE_SIZE**2).all(1)
    return np.where(determined, np.inf, odds + 0.5 * (np.min(costs, 0) - cost(mean, own)))


def _allow_common_errors(fit: _Fit, data: _Data, cfg: FitConfig) -> None:
    """Fit objects of an implausible size again with larger errors of their boxes, in place.

    If all boxes of an object show the same part of it, or the same surroundings, their errors are
    common to all views, and neither the residuals nor the number of views tell how large they are.
    """
    odd = _size_deviation(fit)[0] > IMPLAUSIBLE_SIZE
    if odd.any():
        again = fit[odd]
        again.noise *= COMMON_ERRORS
        again.common *= COMMON_ERRORS
        _refit_inliers(again, _all_residuals(again, data), data, cfg)
        fit.put(odd, again)


# Factor on the errors of boxes that contradict every size prior (without the second fit 15 of 38
# refitted recordings change, and five more objects are implausible)
COMMON_ERRORS = 3.0


def _size_deviation(fit: _Fit) -> tuple[Array, Array]:
    """Compute the distance (B,) of sizes from the prior of their hypothesis, sigma of the prior.

    Returns:
        the distance, and that of the axes that are larger than usual.
    """
    error = fit.state.log_half - fit.prob.size_mean
    deviation = np.sqrt(np.einsum("bi,bij,bj->b", error, fit.prob.own_info, error))
    return deviation, np.sqrt(((error > 0) / fit.prob.size_var * error**2).sum(1))


# ---- Levenberg-Marquardt over a batch of solids --------------------------------------------

BEHIND = 12.0  # sigma, residual of an edge whose point of contact is behind the camera
SMOOTH = 1e-3  # smooths the kink of |m| in the support function of box and cylinder
SIZE_WALL = 2.5  # sigma of growth beyond which the size prior is quartic
SIZE_WALL_RISE = 16.0  # factor of the extra cost: rise * (s^2 - wall^2)^2 / wall^2
# Prior odds of a point on another object, uniform in space; about half of the points in the boxes
# of an object lie on it (up to .3 alike)
POINT_ELSEWHERE = 0.1
_Loss = Callable[[Array], tuple[Array, Array]]  # `_cauchy_loss` or `_huber_loss`
# Losses and outlier tests of residuals. Positive residuals (the solid extends beyond the box) also
# arise from occlusion: their losses have a smaller scale, and they cost less in the evidence.
CAUCHY = 3.0  # sigma, scale of the loss before the inlier test; of positive residuals:
CAUCHY_OCCLUDED = 2.0
HUBER = 3.0  # sigma, scale of the loss after the inlier test; of positive residuals:
HUBER_OCCLUDED = 2.5
EDGE_OUTLIER = 5.0  # sigma beyond which an edge is an outlier (occlusion)
# sigma^2, largest cost of an edge in the evidence, of a negative and a positive residual:
# -2 log(p / 20 sigma / .4), the probability p of an outlier .02, or .2 if hidden
OUTLIER_CAP = 12.0
OCCLUDED_CAP = 7.4


def _cauchy_loss(value: Array) -> tuple[Array, Array]:
    """Return the loss rho(r^2) of residuals in sigma and its weight drho/dr^2."""
    square = value * value
    c2 = np.where(value > 0, CAUCHY_OCCLUDED, CAUCHY) ** 2
    return c2 * np.log1p(square / c2), 1.0 / (1.0 + square / c2)


def _huber_loss(value: Array) -> tuple[Array, Array]:
    """Return the same as `_cauchy_loss` for the loss after the inlier test."""
    size = np.abs(value)
    k = np.where(value > 0, HUBER_OCCLUDED, HUBER)
    outer = size > k
    rho = np.where(outer, 2.0 * k * size - k**2, value * value)
    return rho, np.where(outer, k / np.maximum(size, k), 1.0)


@dataclass(slots=True)
class _State(Rows):
    """Current solids of B problems."""

    center: Array  # (B, 3)
    log_half: Array  # (B, 3)
    rot: Array  # (B, 3, 3) world_from_obj

    def moved(self, delta: Array) -> _State:
        """Apply increments (B, 9): center, log half axes, rotation vector in the object frame."""
        limited = np.clip(self.log_half + delta[:, 3:6], -25.0, 25.0)
        return _State(self.center + delta[:, :3], limited, self.rot @ rotations(delta[:, 6:]))


@dataclass(slots=True)
class _Solution(Rows):
    """States of B problems and their normal equations."""

    state: _State
    cost: Array  # (B,)
    hessian: Array  # (B, 9, 9) Gauss-Newton, half of the cost's second derivative
    gradient: Array  # (B, 9) half of the cost's gradient


def _minimise_all(
    state: _State, edges_of: Callable[[IntArray], _Edges], prob: _Problem, loss: _Loss, steps: int
) -> _Solution:
    """Run `_minimise` in chunks of problems; `edges_of` gathers the edges of a chunk."""
    return _Solution.concatenate([
        _minimise(state[chunk], edges_of(chunk), prob[chunk], loss, steps)
        for chunk in _chunks(len(state))
    ])  # fmt: skip


def _minimise(
    state: _State, edges: _Edges, prob: _Problem, loss: _Loss, iterations: int
) -> _Solution:
    """Run Levenberg-Marquardt on a batch of B problems; converged ones leave the batch."""
    current = _normal_equations(state, edges, prob, loss)
    final = current[np.arange(len(current))]
    alive = np.arange(len(current))  # (A,) problems that have not converged
    damping = np.full(len(current), 1e-3)
    reach = _mean_depth(state, edges)
    for _ in range(iterations):
        moved = current.state.moved(_step(current, damping, reach))
        trial = _normal_equations(moved, edges, prob, loss)
        gain = current.cost - trial.cost
        better = gain > 0
        damping = np.clip(np.where(better, 0.2 * damping, 5.0 * damping), 1e-9, 1e9)
        current.put(better, trial[better])
        final.put(alive[better], trial[better])
        done = (better & (gain < 1e-5 * (1.0 + trial.cost))) | (damping > 1e6)
        if done.all():
            break
        if done.mean() > 0.25:  # shrink the batch
            keep = np.flatnonzero(~done)
            current = current[keep]
            edges = edges[keep]
            prob = prob[keep]
            alive = alive[keep]
            damping = damping[keep]
            reach = reach[keep]
    return final


def _step(current: _Solution, damping: Array, reach: Array) -> Array:
    """Solve for the damped step (B, 9), scaled by the Hessian's diagonal (Marquardt), and limit it.

    Limits: a third of the mean depth `reach` (B,), a factor 4 in size, 0.7 rad in rotation.
    """
    diag = _diagonal(current.hessian)  # (B, 9)
    scale = 1.0 / np.sqrt(np.maximum(diag, 1e-12 * (1e-300 + diag.max(1, keepdims=True))))
    scale[:, 6:] = np.minimum(scale[:, 6:], 30.0)
    system = current.hessian * scale[:, :, None] * scale[:, None, :]
    system[:, np.arange(9), np.arange(9)] += damping[:, None] + 1e-10
    step = scale * _solve(system, -scale * current.gradient)
    bound = np.stack([reach / 3.0, np.full(len(reach), 1.4), np.full(len(reach), 0.7)], 1)
    length = np.linalg.norm(step.reshape(-1, 3, 3), axis=2)  # (B, 3)
    factor = np.min(bound / np.maximum(length, 1e-300), axis=1)
    return np.asarray(step * np.minimum(factor, 1.0)[:, None])


def _normal_equations(
    state: _State, edges: _Edges, prob: _Problem, loss: _Loss, smooth: float = SMOOTH
) -> _Solution:
    """Sum cost, gradient and Gauss-Newton Hessian of edges, points, size, tilt and floor."""
    value, jacobian = _residuals(state, edges, prob.groups, True, smooth)
    rho, weight = loss(value)
    weighted = (jacobian * weight[..., None]).transpose(0, 2, 1)  # (B, 9, M)
    total = _prior_terms(state, prob)
    total.hessian += weighted @ jacobian
    total.gradient += (weighted @ value[..., None])[..., 0]
    total.cost += rho.sum(1)
    if prob.points.shape[1]:
        value, jacobian = _points_outside(state, prob)
        on_it = (1.0 - POINT_ELSEWHERE) * np.exp(-0.5 * (value**2).sum(2))  # (B, P)
        weight = prob.point_weight * on_it / (on_it + POINT_ELSEWHERE)
        weighted = jacobian * weight[..., None, None]  # (B, P, 3, 9)
        total.hessian += np.einsum("bpki,bpkj->bij", weighted, jacobian, optimize=True)
        total.gradient += np.einsum("bpki,bpk->bi", weighted, value, optimize=True)
        total.cost -= 2.0 * (prob.point_weight * np.log(on_it + POINT_ELSEWHERE)).sum(1)
    return total


def _residuals(
    state: _State, edges: _Edges, groups: Array, jacobian: bool, smooth: float = SMOOTH
) -> tuple[Array, Array]:
    """Compute signed edge residuals: how far the solid extends beyond each tangent plane.

    h = sum_k p_k with p_k = a_k^2 m_k^2 / sqrt(sum of its group), m = R' n; then dh/dlog a_k = p_k
    and dh/dm_k = v_k = a_k^2 m_k / sqrt(...). The plane that is parallel to (n, d) and tangent to
    the solid touches it at x = c + R v. Residual = gain (n.x + d) / depth(x): the distance in the
    image between the projection of x and the edge.

    Returns:
        value (B, M) in sigma, M = V E, 0 where unused; jacobian (B, M, 9), empty on request.
    """
    n_prob, n_view, n_edge = edges.offset.shape
    flat = n_view * n_edge
    normal = edges.normal.reshape(n_prob, flat, 3)
    half = np.exp(state.log_half)[:, None]  # (B, 1, 3)
    m = normal @ state.rot  # (B, M, 3)
    square = (m * m + smooth**2) * (half * half)
    inv_root = 1.0 / (np.sqrt(square @ groups) + 1e-300)
    p = square * inv_root  # (B, M, 3)
    v = m * (half * half) * inv_root  # (B, M, 3)
    excess = (normal @ state.center[:, :, None])[..., 0] + edges.offset.reshape(n_prob, flat)
    excess += p.sum(-1)
    rows = np.repeat(edges.depth_row[..., :3], n_edge, 1)  # (B, M, 3)
    ahead = np.repeat(edges.depth_row[..., :3] @ state.rot, n_edge, 1)  # (B, M, 3)
    depth = np.repeat(_depth(state, edges), n_edge, 1) + (ahead * v).sum(-1)  # (B, M) of x
    near = 1e-3 * np.exp(state.log_half.max(1))[:, None]  # (B, 1) less depth counts as behind
    behind = depth <= near
    inv_depth = 1.0 / np.where(behind, np.inf, depth)  # (B, M), 0 where behind
    scale = edges.gain.reshape(n_prob, flat) * inv_depth  # (B, M)
    scale[edges.one_sided.reshape(n_prob, flat) & (excess > 0)] = 0.0
    value = scale * excess
    value[behind & edges.used.reshape(n_prob, flat)] = BEHIND
    if not jacobian:
        return value, np.empty(0)
    weight = scale[..., None]  # (B, M, 1)
    shrink = (inv_depth * value * (scale > 0))[..., None]  # (B, M, 1)
    pull = ahead * v  # (B, M, 3)
    spread = (pull * inv_root * inv_root) @ groups  # (B, M, 3)
    # d depth = w . (v x ahead + (J' ahead) x m), J = dv/dm
    bent = half * half * (ahead * inv_root - m * spread)  # (B, M, 3) J' ahead
    turn = np.cross(weight * v - shrink * bent, m) - np.cross(shrink * v, ahead)
    size = weight * p - shrink * (2.0 * pull - square * spread)
    return value, np.concatenate([weight * normal - shrink * rows, size, turn], -1)


def _depth(state: _State, edges: _Edges) -> Array:
    """Compute the depth (B, V) of the centres in the views."""
    ahead = edges.depth_row[..., :3] @ state.center[:, :, None]  # (B, V, 1)
    return np.asarray(ahead[..., 0] + edges.depth_row[..., 3])


def _mean_depth(state: _State, edges: _Edges) -> Array:
    """Average the depth (B,) of the centres over the views with edges in use."""
    seen = edges.used.any(-1)  # (B, V)
    total = np.sum(np.abs(_depth(state, edges)) * seen, 1)
    return np.asarray(total / np.maximum(seen.sum(1), 1) + 1e-12)


def _prior_terms(state: _State, prob: _Problem) -> _Solution:
    """Sum cost, gradient and Hessian of the priors of size, tilt and height over the floor."""
    hessian = np.zeros((len(state), 9, 9))
    gradient = np.zeros((len(state), 9))
    cost, gradient[:, 3:6], hessian[:, 3:6, 3:6] = _size_prior(state, prob)
    up = (prob.up[:, None] @ state.rot)[:, 0]  # (B, 3) in object axes
    turn = _skew(up)  # (B, 3, 3): d up / d rotvec
    tilt = prob.tilt_info
    hessian[:, 6:, 6:] = turn.transpose(0, 2, 1) @ (tilt[..., None] * turn)
    gradient[:, 6:] = (turn.transpose(0, 2, 1) @ (tilt * up)[..., None])[..., 0]
    half = prob.vertical * np.exp(state.log_half)  # (B, 3)
    height = (prob.floor[:, :3] * state.center).sum(1) - prob.floor[:, 3] - half.sum(1)
    row = np.concatenate([prob.floor[:, :3], -half], 1)  # (B, 6) derivative of the height
    weighted_row = prob.floor_info[:, None] * row
    hessian[:, :6, :6] += weighted_row[:, :, None] * row[:, None]
    gradient[:, :6] += weighted_row * height[:, None]
    cost = cost + (tilt * up * up).sum(1) + prob.floor_info * height**2
    return _Solution(state, cost, hessian, gradient)


def _size_prior(state: _State, prob: _Problem) -> tuple[Array, Array, Array]:
    """Return cost (B,), half gradient (B, 3), information (B, 3, 3) of the log-normal size prior.

    Quadratic in log size; quartic for growth beyond SIZE_WALL: occluded edges and edges on the
    image border do not bound a solid from above. Shrinking stays quadratic: a partly occluded
    object looks smaller.
    """
    error = state.log_half - prob.size_mean  # (B, 3)
    pull = (prob.size_info @ error[..., None])[..., 0]
    growth_info = (error > 0) / prob.size_var  # (B, 3)
    wall = SIZE_WALL**2
    over = np.maximum((growth_info * error**2).sum(1) - wall, 0.0)  # (B,) sigma^2
    steep = (2.0 * SIZE_WALL_RISE / wall * over)[:, None]  # (B, 1)
    cost = (error * pull).sum(1) + SIZE_WALL_RISE / wall * over**2
    extra = (steep * growth_info)[:, None] * np.eye(3)  # (B, 3, 3)
    return cost, pull + steep * growth_info * error, prob.size_info + extra


def _points_outside(state: _State, prob: _Problem) -> tuple[Array, Array]:
    """Compute how far points lie outside the box around a solid, along its axes; 0 inside.

    Returns:
        value (B, P, 3) in sigma; jacobian (B, P, 3, 9).
    """
    at = (prob.points - state.center[:, None]) @ state.rot  # (B, P, 3)
    half = np.exp(state.log_half)[:, None]  # (B, 1, 3)
    beyond = np.abs(at) - half
    side = np.where(beyond > 0, np.sign(at), 0.0) / prob.point_sigma[:, None, None]
    jacobian = np.zeros((*at.shape, 9))
    jacobian[..., :3] = -side[..., None] * state.rot.transpose(0, 2, 1)[:, None]
    jacobian[..., [0, 1, 2], [3, 4, 5]] = -np.abs(side) * half
    jacobian[..., 6:] = side[..., None] * _skew(at)
    return np.abs(side) * beyond, jacobian


# ---- Covariance ----------------------------------------------------------------------------

# (9, 9) information that keeps unobservable rotations finite: sigma .9 rad, that of a uniform angle
# within +-90 deg
ROTATION_CAP: Array = np.diag([0.0] * 6 + [0.9**-2] * 3)


@dataclass(frozen=True, slots=True)
class _Posterior:
    """Posterior of L fits, the vertical axis last."""

    solids: Ellipsoids
    cov: Array  # (L, 9, 9)
    size_sigma: Array  # (L, 3) of the log axes
    prior_share: Array  # (L, 3) as in `ObjectFits`


def _posterior(fit: _Fit, data: _Data, boxes: Array, cfg: FitConfig) -> _Posterior:
    """Compute the covariance of the fits to `boxes` (F, L, 4), and the prior's weight in it."""
    wide = _curved_covariance(fit, data) + fit.spread
    # the noise level is itself estimated: Student's 95 % region for three parameters
    wide *= (1.0 + 3.5 / (OBJECT_NOISE_DOF + _free_dof(fit, data)))[:, None, None]
    if cfg.correlation_deg > 0:  # error common to all boxes of an object, as large as that of one
        size_px = np.nanmedian(boxes[..., 2:] - boxes[..., :2], (0, 2))
        edge = fit.noise * np.hypot(cfg.edge_noise_px / size_px, cfg.edge_noise_rel)
        wide[:, [3, 4, 5], [3, 4, 5]] += 2.0 * edge[:, None] ** 2  # opposite edges, of the size
    solids, cov, order = _vertical_axis_last(fit, wide)
    prior = np.sqrt(np.take_along_axis(_diagonal(fit.prob.size_cov), order, 1))
    size_sigma = np.sqrt(_diagonal(cov)[:, 3:6])
    shrink = np.ones((len(cov), 9))
    shrink[:, 3:6] = np.minimum(1.0, prior / size_sigma)  # data never make a size less certain
    cov *= shrink[:, :, None] * shrink[:, None]
    laplace = _safe_inverse(fit.hessian + ROTATION_CAP)[:, [3, 4, 5], [3, 4, 5]]
    no_gain = np.all(shrink[:, 3:6] < 1.0, axis=1, keepdims=True)  # no axis is more certain
    ratio = np.sqrt(np.take_along_axis(laplace, order, 1)) / prior
    return _Posterior(solids, cov, size_sigma * shrink[:, 3:6], np.where(no_gain, 1.0, ratio))


def _curved_covariance(fit: _Fit, data: _Data) -> Array:
    """Compute the covariance (B, 9, 9) of a bent posterior, to second order around its mode.

    Along each principal axis v of the Laplace covariance the mode is displaced by +-k sigma and the
    other eight directions are re-minimised (one Gauss-Newton step): the path s v + s^2 q / 2. With
    s ~ N(0, 1) its second moment is v v' + 3/4 q q' (the weight is more, for the tail); where
    the cost along the path grows slower than s^2 (kinks of box and cylinder; points that disagree
    with the boxes), v is stretched. Points have no other effect: they are one-sided bounds.
    Ref: second-order delta method.
    """
    prob = replace(fit.prob, points=fit.prob.points[:, :0])
    cov = np.empty_like(fit.hessian)
    for rows in _chunks(len(cov), 10):  # 18 displacements of each (size measured)
        batch = (fit.state[rows], _inlier_edges(fit, data, rows), prob[rows])
        # the support function is smoothed over about the variation of m near its kink
        info = _normal_equations(*batch, _huber_loss, 0.05).hessian + ROTATION_CAP
        scale, value, vector = _scaled_eigh(info)
        axes = scale[:, :, None] * vector / np.sqrt(value)[:, None]  # (B, 9, 9)
        cov[rows] = _second_moment(*batch, axes)
    return cov


def _second_moment(state: _State, edges: _Edges, prob: _Problem, axes: Array) -> Array:
    """Sum stretched v v' + 4 q q' over the principal axes v (B, 9, 9 as columns)."""
    probe = 1.5  # sigma, displacement at which the cost is evaluated
    bend_weight = 4.0  # 3/4 is the second moment; the 95 % region of nine parameters needs more
    base = _normal_equations(state, edges, prob, _huber_loss).cost
    row = np.arange(18 * len(axes))
    side, i, b = np.unravel_index(row, (2, 9, len(axes)))  # of R = 18 B displaced solids
    basis = axes[b]  # (R, 9, 9)
    moved = state[b].moved(np.array([-probe, probe])[side, None] * basis[row, :, i])
    there = _normal_equations(moved, edges[b], prob[b], _huber_loss)
    hess = basis.transpose(0, 2, 1) @ there.hessian @ basis + 1e-3 * np.eye(9)  # whitened
    grad = (basis.transpose(0, 2, 1) @ there.gradient[..., None])[..., 0]
    hess[row, i] = 0.0
    hess[row, :, i] = 0.0
    hess[row, i, i] = 1.0
    grad[row, i] = 0.0
    step = np.clip(-_solve(hess, grad), -30.0, 30.0)  # (R, 9) whitened
    rise = there.cost + 2.0 * (grad * step).sum(1)
    rise = rise + np.einsum("bi,bij,bj->b", step, hess, step) - base[b]
    widen = probe**2 / np.maximum(rise, probe**2 / 4.0**2)  # at most four times the sigma
    widen = widen.reshape(2, 9, -1, 1).max(0, initial=1.0)  # (9, B, 1)
    bend = ((basis @ step[..., None]) / probe**2).reshape(2, 9, -1, 9).sum(0)  # (9, B, 9)
    v = axes.transpose(2, 0, 1) * np.sqrt(widen)  # (9, B, 9)
    moments = v[..., None] * v[..., None, :] + bend_weight * bend[..., None] * bend[..., None, :]
    return np.asarray(moments.sum(0))


def _scaled_eigh(info: Array) -> tuple[Array, Array, Array]:
    """Decompose information matrices (B, 9, 9), scaled to a unit diagonal.

    Returns:
        the scale (B, 9), eigenvalues (B, 9) of at least 1e-10, eigenvectors.
    """
    scale = 1.0 / np.sqrt(np.maximum(_diagonal(info), 1e-30))
    value, vector = _eigh(info * scale[:, :, None] * scale[:, None, :])
    return scale, np.maximum(value, 1e-10), vector


def _safe_inverse(info: Array) -> Array:
    """Invert information matrices (B, 9, 9) by scaled eigenvalues."""
    scale, value, vector = _scaled_eigh(info)
    inverse = (vector / value[:, None]) @ vector.transpose(0, 2, 1)
    return np.asarray(inverse * scale[:, :, None] * scale[:, None, :])


def _vertical_last(fit: _Fit) -> IntArray:
    """Return the cyclic order (B, 3) of the axes that puts the vertical one last.

    The axis of a cylinder is its third one, also where it lies.
    """
    vertical = np.where(fit.code == Shape.CYLINDER, 2, fit.axis)
    return np.asarray((vertical[:, None] + [1, 2, 3]) % 3)


def _vertical_axis_last(fit: _Fit, cov: Array) -> tuple[Ellipsoids, Array, IntArray]:
    """Permute axes so that the vertical one is the third (not for lying cylinders).

    The vertical axis of every start points up, so the third axis does too.

    Returns:
        solids, their covariance (B, 9, 9), and order (B, 3): the prior's axis of each new one.
    """
    order = _vertical_last(fit)
    row = np.arange(len(fit.obj))[:, None]
    half = np.exp(fit.state.log_half)[row, order]
    rot = np.take_along_axis(fit.state.rot, order[:, None, :], 2)
    full = np.concatenate([np.tile(np.arange(3), (len(order), 1)), 3 + order, 6 + order], 1)
    cov = cov[row[:, :, None], full[:, :, None], full[:, None, :]]
    return Ellipsoids(fit.state.center, half, rot), cov, order


# ---- Scale ---------------------------------------------------------------------------------

SCALE_MIN_PARALLAX_DEG = 3.0  # deg, least parallax of an object that votes for the scale
# log, sigma of a scene's sizes about the priors; twice the median sigma of their axes
SCENE_LOG = 0.5
# Mixture of votes for the scale: weight, bias (log), sigma (log). The terms are right votes, wrong
# classes (10 to 38 % of the listed objects in two recordings) and partly occluded objects, of
# whose size at least half is visible.
VOTES = (
    (0.5, 0.0, 0.0),
    (0.25, 0.0, UNKNOWN_SIZE.size_log),
    *((0.25 / 3.0, float(-np.log(seen)), 0.0) for seen in (0.58, 0.75, 0.92)),
)


def _scale_from_priors(fit: _Fit, data: _Data, spec: _Spec) -> tuple[float, float] | None:
    """Estimate log metres per unit and its sigma from the sizes of objects of known categories.

    One vote an object: generalised least squares of log(prior) - log(fitted) over its axes, with
    the priors of `spec` in metres. Then one vote a category: the weighted median, which is robust
    to partly occluded objects (they look small and vote too high).
    """
    prior = _problems(spec, fit.hyp, fit.code, fit.axis)
    prior_cov = np.linalg.inv(prior.size_info)  # (B, 3, 3)
    inverse = np.linalg.inv(prior_cov + _safe_inverse(fit.hessian + ROTATION_CAP)[:, 3:6, 3:6])
    info = inverse.sum((1, 2))
    weight = inverse.sum(2) / info[:, None]  # (B, 3) of the axes
    vote = (weight * (prior.size_mean - fit.state.log_half)).sum(1)
    kind_var = np.einsum("bi,bij,bj->b", weight, prior_cov, weight)  # (B,) variance in the category
    use = (prior.kind >= 0) & np.isfinite(vote) & (fit.views.sum(1) >= 2)
    use &= _parallax(fit, data) >= SCALE_MIN_PARALLAX_DEG
    votes = []
    for category in np.unique(prior.kind[use]):
        member = use & (prior.kind == category)
        median = _weighted_median(vote[member], info[member])
        spread = np.median((vote[member] - median) ** 2 * info[member]) / 0.6745**2
        # look-alikes: all objects of a category count as one draw of its size
        common = kind_var[member].mean() * (1.0 - 1.0 / member.sum())
        votes.append((median, max(spread, 1.0) / info[member].sum() + common))
    return _pool_categories(*np.array(votes).T) if votes else None


def _pool_categories(vote: Array, variance: Array) -> tuple[float, float]:
    """Pool the votes (C,) of categories: mean and standard deviation of the posterior, on a grid.

    The variance of a vote is the sum of `variance` (C,) and of one of the scene (its objects differ
    from those of the priors), common to all categories and integrated out. VOTES models outliers.
    Ref: random effects, DerSimonian and Laird 1986; contaminated normal, Tukey 1960.
    """
    grid = np.linspace(vote.min() - 2.0, vote.max() + 2.0, 501)  # (G,)
    extra = np.linspace(0.0, 3.0, 7)  # (T,) sigma of the half-normal
    total = variance + (SCENE_LOG * extra[:, None]) ** 2  # (T, C)
    likelihood = np.zeros((len(grid), *total.shape))  # (G, T, C)
    for mass, bias, sigma in VOTES:
        square = (vote - bias - grid[:, None, None]) ** 2 / (total + sigma**2)
        likelihood += mass * np.exp(-0.5 * square) / np.sqrt(total + sigma**2)
    log_post = np.log(likelihood + 1e-300).sum(2) - 0.5 * extra**2  # (G, T)
    post = np.exp(log_post - log_post.max()).sum(1)
    mean = np.average(grid, weights=post)
    return float(mean), float(np.sqrt(np.average((grid - mean) ** 2, weights=post)))


def _scale_from_known(
    fit: _Fit, sizes: list[tuple[int, int, float]], cfg: FitConfig
) -> tuple[float, float] | None:
    """Estimate log metres per unit and its sigma from sizes that the user measured.

    The sigma includes the error that the boxes of all objects have in common (`_posterior`): a
    detector whose boxes are too tight draws all of them too tight.
    """
    if not sizes:
        return None
    row, axis, metres = (np.array(column) for column in zip(*sizes, strict=True))
    axis = _vertical_last(fit)[row, axis]
    cov = _safe_inverse(fit.hessian + ROTATION_CAP)
    vote = np.log(metres) - fit.state.log_half[row, axis] - np.log(2.0)
    info = 1.0 / (cov[row, 3 + axis, 3 + axis] + 1e-6)
    common = 2.0 * (cfg.edge_noise_rel * np.median(fit.noise[row])) ** 2  # of opposite edges
    common *= cfg.correlation_deg > 0
    return _weighted_median(vote, info), float(np.sqrt(1.0 / info.sum() + common))


# ---- Status --------------------------------------------------------------------------------

# Limits of the status of a fit. They refuse bad fits: halved or doubled they change nothing on four
# recordings (benchmarks/RESULTS.md, "Which numbers matter").
# Noise factor above which a fit is rejected: the errors of its boxes are about a third of its size,
# more than those of one object
MAX_NOISE = 18.0
MIN_INLIER_SHARE = 0.4  # of the views, below which a fit is rejected
ABSURD_SIZE = 6.0  # sigma of growth over the size prior above which it is rejected
ODD_SIZE = 3.5  # sigma from the size prior above which `reason` reports the size
IMPLAUSIBLE_SIZE = 4.0  # the same, above which the shape is wrong, or the category: "implausible"
# Sigma of a log axis above which its size counts as not measured: the status is "prior_dominated",
# and the category is not overruled
LOOSE_SIZE = 0.35
MIN_PARALLAX_DEG = 1.0  # below it the depth rests on the size prior


def _status(
    fit: _Fit, spec: _Spec, posterior: _Posterior, parallax: Array, seen: IntArray
) -> tuple[list[str], list[str]]:
    """Classify each of B fits and give the reason.

    Args:
        parallax: (B,) deg; seen: (B,) number of views.
    Returns:
        "ok", "prior_dominated", "implausible" or "rejected", and the reason (empty: none), B each.
    """
    weak = posterior.prior_share > np.sqrt(0.5)  # more information from the prior than from data
    weak |= posterior.size_sigma > LOOSE_SIZE
    deviation, growth = _size_deviation(fit)
    finite = _finite(fit.state.center, 1) & _finite(posterior.size_sigma, 1)
    noise = fit.noise / fit.common
    inside = fit.views.sum(1)
    contradiction = _contradictions(fit, spec)
    status = []
    reason = []
    for b in range(len(fit)):
        # where the category is unknown or overruled the sizes of all of them are the prior
        source = "the category" if fit.prob.kind[b] >= 0 else "the sizes of all categories"
        names = [name for name, w in zip(("width", "depth", "height"), weak[b], strict=True) if w]
        guessed = "size" if len(names) == 3 else " and ".join(names)
        why = "another object?" if growth[b] > 0.7 * deviation[b] else "partly occluded?"
        rejected = _that_hold(
            (not finite[b], "no finite solution"),
            (
                noise[b] > MAX_NOISE,
                f"the boxes fit no solid: errors {noise[b]:.1f} times the usual",
            ),
            (growth[b] > ABSURD_SIZE, f"size is {growth[b]:.1f} sigma above its category's"),
            (
                inside[b] < max(1.0, MIN_INLIER_SHARE * seen[b]),
                f"only {inside[b]} of {seen[b]} boxes agree on one solid",
            ),
        )[:1]
        doubts = _that_hold(
            (weak[b].any(), f"{guessed} guessed from {source}"),
            (
                parallax[b] < MIN_PARALLAX_DEG,
                f"distance guessed from {source}, parallax {parallax[b]:.1f} deg",
            ),
        )
        odd = _that_hold(
            (
                deviation[b] > ODD_SIZE,
                f"size is {deviation[b]:.1f} sigma from the usual one: {why}",
            ),
            (fit.prob.overrules[b], f"category overruled: {contradiction[b]}"),
        )
        implausible = deviation[b] > IMPLAUSIBLE_SIZE
        grades = _that_hold(
            (rejected, "rejected"), (implausible, "implausible"), (doubts, "prior_dominated")
        )
        status.append([*grades, "ok"][0])
        reason.append("; ".join([*rejected, *doubts, *odd]))
    return status, reason


def _that_hold(*rows: tuple[object, str]) -> list[str]:
    """List the texts whose condition holds."""
    return [text for holds, text in rows if holds]


def _contradictions(fit: _Fit, spec: _Spec) -> list[str]:
    """Say how each of B solids differs from the usual ones of its category."""
    usual = _problems(spec, fit.obj, fit.code, fit.axis).size_mean
    size = np.exp((fit.state.log_half - usual).mean(1))  # (B,)
    # axis 2 of `usual` is the height: of an object on its side another axis has that length
    turned = np.abs(fit.state.log_half[:, AXIS_ORDERS] - usual[:, None]).sum(2).argmin(1)
    shape = np.where(
        AXIS_ORDERS[turned, 2] != 2, "it lies on its side", "its proportions are not the usual ones"
    )
    return [
        why if max(s, 1.0 / s) < 1.25 else f"size is {s:.2g} times the usual"
        for s, why in zip(size, shape.tolist(), strict=True)
    ]


def _parallax(fit: _Fit, data: _Data) -> Array:
    """Compute the widest angle (B,), deg, between rays from inlier cameras to the centre."""
    cos = _cosines(data.cam_center[fit.obj], fit.state.center)  # (B, V, V)
    pair = fit.views[:, :, None] & fit.views[:, None]
    lowest = np.where(pair, cos, 1.0).min((1, 2))
    return np.asarray(np.rad2deg(np.arccos(np.clip(lowest, -1.0, 1.0))))


# ---- Projection of solids, overlaps --------------------------------------------------------


@np.errstate(all="ignore")
def project(dual_q: Array, img_from_world: Array) -> tuple[Array, BoolArray]:
    """Project O ellipsoids into F images as dual conics.

    Args:
        dual_q: (O, 4, 4) dual quadrics with [3, 3] = -1.
        img_from_world: (F, 3, 4) cameras, pixels.
    Returns:
        dual_c: (F, O, 3, 3), and visible (F, O): True where the outline is a real ellipse in front
        of the camera (False: behind, crossing the focal plane, around the camera, NaN).
    Ref: [HZ] eq. 8.8: C* = P Q* P'.
    """
    cams = _with_positive_depth(img_from_world)  # (F, 3, 4)
    # For one camera the contraction order is given: numpy's search takes longer than the product
    path: Any = ("einsum_path", (0, 1), (0, 1)) if len(cams) == 1 else True
    dual_c = np.einsum("fik,okl,fjl->foij", cams, dual_q, cams, optimize=path)  # (F, O, 3, 3)
    depth = -np.einsum("ok,fk->fo", dual_q[:, :, 3], cams[:, 2])  # (F, O) of the centre
    return dual_c, (dual_c[..., 2, 2] < 0) & (depth > 0)


@np.errstate(all="ignore")
def boxes_from_dual_conics(dual_c: Array) -> Array:
    """Return the exact (..., 4) xyxy bounds of (..., 3, 3) dual conics; NaN where none exist."""
    c33 = _nonzero(dual_c[..., 2, 2])
    mid = dual_c[..., :2, 2] / c33[..., None]  # (..., 2)
    square = mid**2 - np.stack([dual_c[..., 0, 0], dual_c[..., 1, 1]], -1) / c33[..., None]
    half = np.sqrt(square)  # (..., 2)
    return np.concatenate([mid - half, mid + half], -1)


@np.errstate(all="ignore")
def solid_boxes(
    solids: Ellipsoids, support: str | Sequence[str], img_from_world: Array, near: float = 1e-3
) -> Array:
    """Project solids and return their image bounds.

    Args:
        solids: O centres, half extents, rotations.
        support: shape of all, one of SUPPORTS, or of each.
        img_from_world: (F, 3, 4).
        near: least depth of a projected corner of a box, world units.
    Returns:
        (F, O, 4) xyxy in pixels, not clipped; NaN where no part is in front of the camera.
    """
    codes = _shape_codes(support, len(solids))
    if (codes < 0).any():
        raise QuadricsError(f"support: a shape is missing; name one of {SUPPORTS} for each solid")
    cams = _with_positive_depth(np.asarray(img_from_world, np.float64))  # (F, 3, 4)
    boxes = np.full((len(cams), len(solids), 4), np.nan)
    for code in np.unique(codes):
        row = np.flatnonzero(codes == code)
        same_shape = solids[row]
        if code == Shape.BOX:
            boxes[:, row] = _corner_bounds(same_shape, cams, near)
        elif code == Shape.CYLINDER:
            boxes[:, row] = _rim_bounds(same_shape, cams)
        else:
            dual_c, visible = project(same_shape.dual_quadrics(), cams)
            outline = boxes_from_dual_conics(dual_c)
            boxes[:, row] = np.where(visible[..., None], outline, np.nan)
    return boxes


def _corner_bounds(solids: Ellipsoids, cams: Array, near: float) -> Array:
    """Bound the eight projected corners (F, O, 4); corners behind the camera get depth `near`."""
    offset = solids.world_from_obj @ (solids.half_axes[:, :, None] * SIGNS)  # (O, 3, 8)
    corner = solids.center_in_world[:, :, None] + offset  # (O, 3, 8)
    img = np.einsum("fik,okc->foic", cams[..., :3], corner, optimize=True) + cams[:, None, :, 3:]
    depth = img[:, :, 2]  # (F, O, 8)
    uv = img[:, :, :2] / np.maximum(depth, near)[:, :, None]  # (F, O, 2, 8)
    bounds = np.concatenate([uv.min(-1), uv.max(-1)], -1)  # (F, O, 4)
    bounds[(depth < near).all(-1)] = np.nan
    return bounds


def _rim_bounds(solids: Ellipsoids, cams: Array) -> Array:
    """Bound a projected cylinder (F, O, 4): union of the exact bounds of its two rims."""
    flat = solids.half_axes * np.array([1.0, 1.0, 0.0])
    lift = solids.world_from_obj[:, :, 2] * solids.half_axes[:, 2:]  # (O, 3)
    out = []
    for side in (-1.0, 1.0):
        rim = Ellipsoids(solids.center_in_world + side * lift, flat, solids.world_from_obj)
        dual_c, visible = project(rim.dual_quadrics(), cams)
        out.append(np.where(visible[..., None], boxes_from_dual_conics(dual_c), np.nan))
    both = np.stack(out)  # (2, F, O, 4)
    return np.concatenate([both[..., :2].min(0), both[..., 2:].max(0)], -1)


@np.errstate(all="ignore")
def clip_boxes(boxes_xyxy: Array, image_size: tuple[float, float]) -> Array:
    """Clip (..., 4) boxes to the image; boxes outside become NaN."""
    limit = np.array([*image_size, *image_size], np.float64)
    clipped = np.clip(boxes_xyxy, 0.0, limit)
    empty = (clipped[..., 2] <= clipped[..., 0]) | (clipped[..., 3] <= clipped[..., 1])
    return np.where(empty[..., None], np.nan, clipped)


@np.errstate(all="ignore")
def box_iou(a: Array, b: Array) -> Array:
    """Compute the IoU (...) of (..., 4) xyxy boxes pair by pair; 0 where one of them is NaN."""
    size = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    inter = np.prod(np.clip(size, 0.0, None), -1)
    union = np.prod(a[..., 2:] - a[..., :2], -1) + np.prod(b[..., 2:] - b[..., :2], -1) - inter
    return np.asarray(np.nan_to_num(inter / union, nan=0.0, posinf=0.0, neginf=0.0))


def reprojection_iou(
    fits: ObjectFits, boxes_xyxy: Array, img_from_world: Array, image_size: tuple[float, float]
) -> Array:
    """Compute the IoU of each fitted solid's projected box, clipped to the image, and its box.

    Args:
        boxes_xyxy: (F, O, 4); img_from_world: (F, 3, 4).
    Returns:
        IoU (F, O); 0 where the object is unseen, behind the camera or outside the image.
    """
    iou = np.zeros(boxes_xyxy.shape[:2])
    for frames in _chunks(len(boxes_xyxy), 256):  # bounds the memory
        solids = solid_boxes(fits.ellipsoids, list(fits.support), img_from_world[frames])
        clipped = (clip_boxes(boxes, image_size) for boxes in (solids, boxes_xyxy[frames]))
        iou[frames] = box_iou(*clipped)
    return iou


@np.errstate(all="ignore")
def volume_overlap(a: Ellipsoids, b: Ellipsoids) -> Array:
    """Measure O3D, the intersection over union of the volumes of ellipsoids, pair by pair.

    In the frame where `a` is the unit ball, chords of both along x are exact, and summed over a
    grid of the other two axes (accurate to 1e-4).

    Args:
        a, b: O ellipsoids each.
    Returns:
        (O,); NaN where an input is not finite.
    """
    if len(a) != len(b):
        raise QuadricsError(f"{len(a)} and {len(b)} ellipsoids: the two lists must pair up")
    middle = (np.arange(400) + 0.5) / 200.0 - 1.0
    y, z = (axis.ravel() for axis in np.meshgrid(middle, middle))  # (N,)
    chord = np.sqrt(np.maximum(1.0 - y**2 - z**2, 0.0))  # half of the ball's
    to_unit = b.world_from_obj.transpose(0, 2, 1) / b.half_axes[:, :, None]  # (O, 3, 3): b a ball
    axes = to_unit @ (a.world_from_obj * a.half_axes[:, None])  # (O, 3, 3) of a in that frame
    shift = (to_unit @ (a.center_in_world - b.center_in_world)[..., None])[..., 0]
    iou = np.empty(len(a))
    for k in range(len(a)):
        at = axes[k, :, 1:] @ np.stack([y, z]) + shift[k, :, None]  # (3, N) where x = 0
        square = axes[k, :, 0] @ axes[k, :, 0]
        mid = -(axes[k, :, 0] @ at) / square
        half = np.sqrt(np.maximum(mid**2 - ((at**2).sum(0) - 1.0) / square, 0.0))
        common = np.minimum(chord, mid + half) - np.maximum(-chord, mid - half)
        share = np.maximum(common, 0.0).sum() / (2.0 * chord.sum())  # of the volume of a
        ratio = b.half_axes[k].prod() / a.half_axes[k].prod()
        iou[k] = share / (1.0 + ratio - share)
    return np.asarray(np.clip(iou, 0.0, 1.0))


# ---- Rotations, linear algebra -------------------------------------------------------------


def rotations(rotvec: Array) -> Array:
    """Convert rotation vectors (B, 3), rad, to matrices (B, 3, 3). Ref: Rodrigues."""
    angle = np.linalg.norm(rotvec, axis=-1)[:, None, None]  # (B, 1, 1)
    skew = _skew(rotvec)
    s = np.sinc(angle / np.pi)
    c = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    out: Array = np.eye(3) + s * skew + c * (skew @ skew)
    return out


def rotation_vectors(rot: Array) -> Array:
    """Convert rotation matrices (B, 3, 3) to vectors (B, 3) by quaternions: accurate near pi."""
    diag = _diagonal(rot)
    trace = diag.sum(1)
    square = np.concatenate([1.0 + trace[:, None], 1.0 + 2.0 * diag - trace[:, None]], 1)  # (B, 4)
    big = np.argmax(square, 1)  # the largest of 4 w^2, 4 x^2, 4 y^2, 4 z^2
    odd = rot - rot.transpose(0, 2, 1)
    even = rot + rot.transpose(0, 2, 1)
    rows = np.empty((len(rot), 4, 4))  # outer product 4 q q'
    rows[:, 0, 1:] = rows[:, 1:, 0] = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], 1)
    rows[:, 1:, 1:] = even
    rows[:, np.arange(4), np.arange(4)] = square
    quat = rows[np.arange(len(rot)), big]
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    quat *= np.where(quat[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(quat[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quat[:, :1])
    return np.asarray(quat[:, 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0))


def _diagonal(matrix: Array) -> Array:
    """Return the diagonals (B, n) of matrices (B, n, n)."""
    return np.asarray(np.einsum("bii->bi", matrix))


def _unit(v: Array) -> Array:
    """Scale vectors (..., 3) to length 1."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _skew(v: Array) -> Array:
    """Return the cross product matrix (..., 3, 3) of v (..., 3): _skew(v) @ x = v x x."""
    out: Array = np.tensordot(v, SKEW, 1)
    return out


def _centred(dual: Array) -> tuple[Array, Array]:
    """Split dual quadrics or conics (..., n, n) of any scale into centres and centred blocks."""
    scaled = -dual / _nonzero(dual[..., -1:, -1:])
    center = -scaled[..., :-1, -1]
    return center, scaled[..., :-1, :-1] + center[..., :, None] * center[..., None, :]


def _where(mask: BoolArray, values: Array, fill: npt.ArrayLike = 0.0) -> Array:
    """Replace values (..., *) where the mask (...) is False."""
    mask = mask.reshape(mask.shape + (1,) * (values.ndim - mask.ndim))
    return np.where(mask, values, fill)


def _dual_quadrics(center: Array, block: Array) -> Array:
    """Join centres (O, 3) and centred blocks (O, 3, 3) into dual quadrics with [3, 3] = -1."""
    center_h = np.concatenate([center, np.ones((len(center), 1))], 1)  # (O, 4)
    dual_q: Array = -center_h[:, :, None] * center_h[:, None, :]  # (O, 4, 4)
    dual_q[:, :3, :3] += block
    return dual_q


def _chunks(n: int, size: int = 384) -> Iterator[IntArray]:
    """Split the indices 0 to n - 1 into consecutive chunks of at most `size`.

    384 problems of `_minimise` fit the second-level cache of a core.
    """
    for lo in range(0, n, size):
        yield np.arange(lo, min(lo + size, n))


def _finite(x: Array, *axes: int) -> BoolArray:
    """Test whether all values along the given axes are finite."""
    return np.asarray(np.isfinite(x).all(axis=axes))


def _nonzero(x: Array, tiny: float = 1e-300) -> Array:
    return np.where(np.abs(x) < tiny, tiny, x)


def _solve(lhs: Array, rhs: Array) -> Array:
    """Solve (B, n, n) x = (B, n); 0 where not finite, the least norm solution where singular."""
    bad = ~(_finite(lhs, 1, 2) & _finite(rhs, 1))
    if bad.any():
        lhs = np.where(bad[:, None, None], np.eye(lhs.shape[1]), lhs)
        rhs = np.where(bad[:, None], 0.0, rhs)
    try:
        return np.asarray(np.linalg.solve(lhs, rhs[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.asarray((np.linalg.pinv(lhs) @ rhs[..., None])[..., 0])


def _eigh(matrix: Array) -> tuple[Array, Array]:
    """Decompose symmetric (B, n, n) into eigenvalues and vectors; the identity where not finite."""
    bad = np.asarray(~(np.abs(matrix) < 1e150).all((1, 2)))[:, None, None]
    value, vector = np.linalg.eigh(np.where(bad, np.eye(matrix.shape[1]), matrix))
    return value, vector


# ---- LfD -----------------------------------------------------------------------------------


@np.errstate(all="ignore")
def fit_lfd(boxes_xyxy: Array, img_from_world: Array) -> tuple[Array, BoolArray]:
    """Fit ellipsoids to boxes in closed form, all objects at once.

    Needs >= 3 views and > ~20 deg between them; with less the result is often no ellipsoid.
    Invariant to shifts and units of the world: solved about the intersection of the rays.

    Args:
        boxes_xyxy: (F, O, 4), NaN where unseen; img_from_world: (F, 3, 4).
    Returns:
        dual_q: (O, 4, 4) with [3, 3] = -1 (NaN with fewer than 3 views), and is_ellipsoid (O,).
    Ref: [LfD] eq. 9-12.
    """
    boxes_xyxy = np.asarray(boxes_xyxy, np.float64)
    cams = _cameras(img_from_world)
    usable = _usable_boxes(boxes_xyxy, cams)
    index = _select_views(usable, np.zeros(usable.shape), cams, FitConfig().max_views)  # (O, V)
    enough = np.flatnonzero((index >= 0).sum(1) >= 3)
    dual_q = np.full((len(index), 4, 4), np.nan)
    if len(enough):
        index = index[enough]
        seen = index >= 0
        boxes = _where(seen, boxes_xyxy[index, enough[:, None]], [0, 0, 1, 1.0])  # (O, V, 4)
        rays = _rays(boxes, cams, index)
        row = rays.matrix[..., 2, :]
        depth = np.abs(np.einsum("ovj,oj->ov", row[..., :3], rays.point) + row[..., 3])
        # an object measures about .1 units, as in the authors' data: the norm of the null vector
        # depends on the scale
        unit = 10.0 * np.sum(seen * depth * rays.extent.mean(-1), 1) / seen.sum(1) + 1e-12  # (O,)
        system = _lfd_system(boxes, rays.matrix, rays.point, unit, seen)
        solution = np.linalg.svd(system, full_matrices=False)[2][:, -1, :10]  # (O, 10)
        local_q = _symmetric(solution, 4)  # (O, 4, 4), may be at infinity
        local_q = local_q / -_nonzero(local_q[:, 3:, 3:], 1e-12)
        world_from_local = unit[:, None, None] * np.eye(4)  # (O, 4, 4)
        world_from_local[:, :3, 3] = rays.point
        world_from_local[:, 3, 3] = 1.0
        dual_q[enough] = world_from_local @ local_q @ world_from_local.transpose(0, 2, 1)
    return dual_q, Ellipsoids.from_dual_quadrics(dual_q)[1]


def _lfd_system(boxes: Array, cams: Array, origin: Array, unit: Array, seen: BoolArray) -> Array:
    """Stack the homogeneous systems (O, 6V + V, 10 + V) of LfD in normalised coordinates.

    Rows: (normalised P) applied to the 10 entries of Q*, minus beta times the conic; one more row
    per view fixes beta = 0 where the object is unseen. Ref: [LfD]: beta C* = P Q* P'.
    """
    n_obj, n_view = seen.shape
    half = 0.5 * (boxes[..., 2:] - boxes[..., :2])  # (O, V, 2)
    scale = np.linalg.norm(half, axis=-1)  # (O, V)
    local = cams.copy()  # (O, V, 3, 4) world -> object-centred world in object units
    local[..., 3] += np.einsum("ovij,oj->ovi", cams[..., :3], origin)
    local[..., 3] /= unit[:, None, None]
    local *= 10.0  # large against beta's entries: from 3 up the solution no longer depends on it
    mid = 0.5 * (boxes[..., 2:] + boxes[..., :2])
    local[..., :2, :] -= mid[..., None] * local[..., 2:, :]
    local[..., :2, :] /= scale[..., None, None]
    block = _congruence(local)  # (O, V, 6, 10)
    conic = np.zeros((n_obj, n_view, 6))
    conic[..., 0] = (half[..., 0] / scale) ** 2
    conic[..., 3] = (half[..., 1] / scale) ** 2
    conic[..., 5] = -1.0
    view = np.arange(n_view)  # (V,)
    on = seen[..., None]  # (O, V, 1)
    top = np.zeros((n_obj, n_view, 6, 10 + n_view))
    top[..., :10] = np.where(on[..., None], block, 0.0)
    top[:, view, :, 10 + view] = np.where(on, -conic, 0.0).transpose(1, 0, 2)
    pin = np.zeros((n_obj, n_view, 10 + n_view))
    pin[:, view, 10 + view] = np.where(seen, 0.0, 1e3)
    return np.concatenate([top.reshape(n_obj, 6 * n_view, -1), pin], 1)


def _congruence(matrix: Array) -> Array:
    """Return the matrix (..., R, C) of the map Q -> M Q M' between their upper triangles.

    matrix: (..., k, n) M; R = k (k + 1) / 2, C = n (n + 1) / 2. Ref: [LfD]; [SfMO] G_red.
    """
    (r, s), (i, j) = (np.triu_indices(n) for n in matrix.shape[-2:])
    r = r[:, None]
    s = s[:, None]
    rows: Array = matrix[..., r, i] * matrix[..., s, j]
    rows += np.where(i != j, matrix[..., r, j] * matrix[..., s, i], 0.0)
    return rows


def _symmetric(entries: Array, n: int) -> Array:
    """Fill symmetric matrices (O, n, n) from their upper triangles, row by row."""
    i, j = np.triu_indices(n)
    out = np.zeros((len(entries), n, n))
    out[:, i, j] = out[:, j, i] = entries
    return out


# ---- SfMO: affine cameras ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SfmoResult:
    """Affine cameras and ellipsoids from boxes alone, without metric meaning.

    Defined up to a similarity (arbitrary frame) and a reflection (z -> -z), which affine views
    cannot distinguish: `mirrored` is the reflected solution. `ok` is False where there are too few
    frames or objects to factorise; `note` gives the reason.
    """

    ellipsoids: Ellipsoids
    mirrored: Ellipsoids
    img_from_world: Array  # (F, 2, 4) affine cameras: pixel = A X + t
    is_ellipsoid: BoolArray  # (O,)
    rms_px: float  # of the box centres
    ok: bool
    note: str


@np.errstate(all="ignore")
def fit_sfmo(boxes_xyxy: Array | None, dual_c: Array | None = None) -> SfmoResult:
    """Factorise boxes into affine cameras and ellipsoids: structure from motion with objects.

    Needs >= 4 objects in general position and >= 3 frames. Unseen boxes (NaN) are completed by a
    rank-3 model. Scale, rotation and mirror image of the result are arbitrary.

    Args:
        boxes_xyxy: (F, O, 4), NaN where unseen, or None when dual_c (F, O, 3, 3) holds ellipses.
    Returns:
        SfmoResult; `ok` is False where there are too few frames or objects.
    Ref: [SfMO].
    """
    center_px, rows, seen = _ellipses(boxes_xyxy, dual_c)
    n_obj = seen.shape[1]
    # frames with few objects are ill-conditioned: used only where too few others remain
    rich, enough = (np.flatnonzero(seen.sum(1) >= k) for k in (max(5, 0.65 * n_obj), 4))
    frames = rich if len(rich) >= 3 else enough
    cams = np.full((len(seen), 2, 4), np.nan)
    if n_obj < 4 or len(frames) < 3:
        nan = Ellipsoids.unknown(n_obj)
        note = "needs at least 3 frames that show the same 4 objects"
        return SfmoResult(nan, nan, cams, np.zeros(n_obj, bool), np.nan, False, note)
    on = seen[frames]
    tracks = _complete_rank3(center_px[frames].transpose(0, 2, 1), on)  # (F', 2, O)
    offset = tracks.mean(2)  # (F', 2)
    flat = (tracks - offset[..., None]).reshape(-1, n_obj)
    u, d, vt = np.linalg.svd(flat, full_matrices=False)
    motion = (u[:, :3] * np.sqrt(d[:3])).reshape(-1, 2, 3)  # (F', 2, 3)
    upgrade = _metric_upgrade(motion)
    affine = motion @ upgrade
    points = (np.linalg.inv(upgrade) @ (np.sqrt(d[:3, None]) * vt[:3])).T  # (O, 3)
    error = (tracks - offset[..., None] - affine @ points.T).transpose(0, 2, 1)[on]
    design = np.broadcast_to(_congruence(affine), (n_obj, len(frames), 3, 6))
    block = _fit_shapes(design, rows[frames], on)  # (O, 3, 3)
    ellipsoids, real = Ellipsoids.from_dual_quadrics(_dual_quadrics(points, block))
    cams[frames] = np.concatenate([affine, offset[..., None]], 2)
    flip = np.array([1.0, 1.0, -1.0])
    reflected = _dual_quadrics(points * flip, block * flip[:, None] * flip)
    mirrored = Ellipsoids.from_dual_quadrics(reflected)[0]
    rms = float(np.sqrt((error**2).mean()))
    return SfmoResult(ellipsoids, mirrored, cams, real, rms, True, "affine, no metric meaning")


def _ellipses(boxes_xyxy: Array | None, dual_c: Array | None) -> tuple[Array, Array, BoolArray]:
    """Convert dual conics, or the ellipses inscribed in boxes, to centres and shapes.

    Returns:
        centres (F, O, 2), shape rows (F, O, 3) = entries 11, 12, 22 of the centred dual ellipse
        ((a^2, 0, b^2) for a box), and seen (F, O).
    """
    if dual_c is not None:
        center, block = _centred(np.asarray(dual_c, np.float64))
    elif boxes_xyxy is not None:
        boxes = np.asarray(boxes_xyxy, np.float64)
        center = 0.5 * (boxes[..., :2] + boxes[..., 2:])
        half = 0.5 * (boxes[..., 2:] - boxes[..., :2])
        block = (half**2)[..., None] * np.eye(2)
    else:
        raise QuadricsError("no measurements: give boxes_xyxy (F, O, 4) or dual_c (F, O, 3, 3)")
    rows = block[..., [0, 0, 1], [0, 1, 1]]
    return center, rows, _finite(rows, -1) & (np.abs(center) < 1e7).all(-1)


def _complete_rank3(tracks: Array, seen: BoolArray) -> Array:
    """Complete centre tracks (F, 2, O) with a rank-3 affine model x = M S + t.

    Masked alternation: cameras (M, t) by least squares with the points fixed, then points with the
    cameras fixed, lightly damped. Initial value: truncated SVD of the tracks, with missing entries
    interpolated over the frames (assumed to be in temporal order).
    Ref: Hartley and Schaffalitzky, PowerFactorization, 2003.
    """
    n_frame, _, n_obj = tracks.shape
    mask = np.repeat(seen[:, None], 2, 1).reshape(-1, n_obj).astype(np.float64)  # (2F, O)
    given = np.where(mask > 0, tracks.reshape(-1, n_obj), 0.0)
    if mask.all():
        return tracks
    filled = np.zeros((n_obj, 2 * n_frame))
    for o in np.flatnonzero(seen.any(0)):
        on = np.flatnonzero(seen[:, o])
        for k in (0, 1):
            filled[o, k::2] = np.interp(np.arange(n_frame), on, tracks[on, k, o])
    filled = filled.T  # (2F, O)
    mean = filled.mean(1, keepdims=True)
    points = np.linalg.svd(filled - mean, full_matrices=False)[2][:3].T  # (O, 3)
    last = np.inf
    ridge = np.diag([1e-2, 1e-2, 1e-2, 1e-9])  # regularises frames with few objects
    for _ in range(500):
        points = np.linalg.qr(points - points.mean(0))[0] * np.sqrt(n_obj)  # (O, 3)
        wide = np.concatenate([points, np.ones((n_obj, 1))], 1)  # (O, 4)
        lhs = np.einsum("ro,oi,oj->rij", mask, wide, wide, optimize=True) + ridge
        motion = _solve(lhs, given @ wide)  # (2F, 4)
        rest = (given - motion[:, 3:]) * mask
        lhs = np.einsum("ro,ri,rj->oij", mask, motion[:, :3], motion[:, :3], optimize=True)
        points = _solve(lhs + 1e-9 * np.eye(3), rest.T @ motion[:, :3])  # (O, 3)
        model = motion[:, :3] @ points.T + motion[:, 3:]
        error = float((((given - model) * mask) ** 2).sum())
        if last - error < 1e-9 * error:
            break
        last = error
    return np.where(mask > 0, given, model).reshape(n_frame, 2, n_obj)


def _metric_upgrade(motion: Array) -> Array:
    """Find Q (3, 3) for which the rows of motion (F, 2, 3) @ Q are orthogonal and equally long.

    Linear in L = Q Q': m1 L m1 = m2 L m2, m1 L m2 = 0, mean of m L m = 1; L is made positive.
    Ref: [SfMO] section 3; Tomasi and Kanade 1992.
    """
    f11, f12, f22 = _congruence(motion).transpose(1, 0, 2)  # (F, 6) each
    rows = np.concatenate([f11 - f22, f12, (f11 + f22).mean(0, keepdims=True)])
    target = np.zeros(len(rows))
    target[-1] = 2.0
    solution: Array = np.linalg.lstsq(rows, target, rcond=None)[0]
    value, vector = np.linalg.eigh(_symmetric(solution[None], 3)[0])
    return np.asarray(vector * np.sqrt(np.maximum(value, 1e-3 * np.abs(value).max() + 1e-12)))


def _fit_shapes(design: Array, rows: Array, seen: BoolArray) -> Array:
    """Fit centred quadrics (O, 3, 3) to shape rows (F, O, 3) by least squares, no prior."""
    target = _where(seen.T, rows.transpose(1, 0, 2))  # (O, F, 3)
    flat = (design * seen.T[..., None, None]).reshape(len(target), -1, 6)
    # not finite: the system is set to 0, and so is the quadric
    flat = _where(_finite(flat, 1, 2), flat)
    entries = np.linalg.pinv(flat) @ target.reshape(len(target), -1, 1)  # (O, 6, 1)
    return _symmetric(entries[..., 0], 3)


# ---- PSfMO ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PsfmoResult:
    """Result of PSfMO: ellipsoids with a prior on the axis ratios of their category."""

    ellipsoids: Ellipsoids
    mirrored: Ellipsoids | None  # reflected solution of affine cameras; None with known cameras
    noise: Array  # (O,) sigma of the shape rows, relative to their mean
    permutation: IntArray  # (O, 3) prior axis (w, d, h) assigned to each ellipsoid axis
    log_likelihood: Array  # (O,)
    start: SfmoResult | None  # None when the cameras were given


@np.errstate(all="ignore")
def fit_psfmo(
    boxes_xyxy: Array | None,
    priors: Priors,
    categories: Sequence[str | None],
    img_from_world: Array | None = None,
    dual_c: Array | None = None,
) -> PsfmoResult:
    """Fit ellipsoids with a prior on the axis ratios of their category (probabilistic SfMO).

    Without cameras `fit_sfmo` initialises it (affine frame, no metric meaning); with img_from_world
    (F, 3, 4) each camera is linearised at the object's centre and the result is in world units.
    The orientation is that of the initial value; of the six assignments of the category's axes
    (w, d, h) to the ellipsoid's the one of highest likelihood is returned.

    Args:
        boxes_xyxy, dual_c: as in `fit_sfmo`. categories: (O,); unknown ones get a broad prior.
    Returns:
        PsfmoResult; NaN axes where an object is seen in fewer than two frames.
    Ref: [PSfMO].
    """
    center_px, rows, seen = _ellipses(boxes_xyxy, dual_c)
    start = None
    if img_from_world is None:
        start = fit_sfmo(boxes_xyxy, dual_c)
        affine = np.broadcast_to(start.img_from_world[..., :3], (seen.shape[1], len(seen), 2, 3))
        solids = start.ellipsoids
    else:
        solids, affine = _known_camera_start(center_px, rows, seen, img_from_world)
    seen = seen & _finite(affine, 2, 3).T
    design = _congruence(np.where(np.isfinite(affine), affine, 0.0))  # (O, F, 3, 6)
    mean, cov = _shape_gaussian(priors, categories)
    usable = _finite(solids.half_axes, 1) & (seen.sum(0) >= 2)
    rot = np.where(usable[:, None, None], solids.world_from_obj, np.eye(3))
    i, j = np.triu_indices(3)
    outer = rot[:, i] * rot[:, j]  # (O, 6, 3): upper triangle of R diag(l) R' = outer l
    n = len(solids)
    on = seen.T[..., None]  # (O, F, 1)
    target = np.where(on, rows.transpose(1, 0, 2), 0.0)  # (O, F, 3)
    count = np.maximum(3.0 * seen.sum(0), 1.0)
    unit = np.abs(target).sum((1, 2)) / count + 1e-12  # (O,) measurements over their mean
    system = np.where(on[..., None], design @ outer[:, None], 0.0).reshape(n, -1, 3)
    system = system / unit[:, None, None]
    target = target.reshape(n, -1) / unit[:, None]
    results = [
        _psfmo_em(system, target, count, mean[:, p], cov[:, p][:, :, p]) for p in AXIS_ORDERS
    ]
    squared, noise, likelihood = (np.stack(column) for column in zip(*results, strict=True))
    best = np.argmax(np.nan_to_num(likelihood, nan=-np.inf), 0)  # (O,)
    row = np.arange(n)
    half = np.where(usable[:, None], np.sqrt(np.maximum(squared[best, row], 0.0)), np.nan)
    mirrored = None if start is None else replace(start.mirrored, half_axes=half)
    return PsfmoResult(
        replace(solids, half_axes=half), mirrored, noise[best, row], AXIS_ORDERS[best],
        likelihood[best, row], start,
    )  # fmt: skip


def _shape_gaussian(priors: Priors, categories: Sequence[str | None]) -> tuple[Array, Array]:
    """Convert priors of log axis ratios to Gaussians of u = a^2 / sum a^2: (O, 3), (O, 3, 3).

    Five-point Gauss-Hermite rule in both directions. Ref: [PSfMO] shape model.
    """
    index = priors.index(categories)
    node, weight = np.polynomial.hermite_e.hermegauss(5)
    grid = np.stack(np.meshgrid(node, node), -1).reshape(-1, 2)  # (25, 2)
    mass = np.outer(weight, weight).ravel() / weight.sum() ** 2
    root = np.linalg.cholesky(priors.of("ratio_cov", index) + 1e-10 * np.eye(2))
    log_ratio = priors.of("ratio_mean", index)[:, None] + np.einsum("oij,kj->oki", root, grid)
    square = np.exp(2.0 * np.concatenate([log_ratio, np.zeros_like(log_ratio[..., :1])], -1))
    u = square / square.sum(-1, keepdims=True)  # (O, 25, 3)
    mean = np.einsum("k,oki->oi", mass, u)
    return mean, np.einsum("k,oki,okj->oij", mass, u - mean[:, None], u - mean[:, None])


EM_ITERATIONS = 50  # of PSfMO: 80 % of the axes are within .1 % of those after 200


def _psfmo_em(
    system: Array, target: Array, count: Array, mean: Array, cov: Array
) -> tuple[Array, Array, Array]:
    """Fit the PPCA shape model by EM to a batch of objects, orientation fixed.

    c = s^2 A (P h + mu) + e, h ~ N(0, S), e ~ N(0, sigma^2). E step: Gaussian posterior of h in
    closed form; M step: s^2 by least squares, then sigma^2. Ref: [PSfMO].

    Args:
        system: (B, M, 3) A, rows of unseen views zero; target: (B, M) c; count: (B,) rows in use.
        mean, cov: (B, 3) mu, (B, 3, 3) covariance of P h.
    Returns:
        s^2 (P h + mu) (B, 3): squared half axes, sigma (B,), log likelihood (B,).
    """
    value, vector = np.linalg.eigh(cov)
    basis = vector[:, :, 1:]  # (B, 3, 2)
    spread = np.maximum(value[:, 1:], 1e-8)  # (B, 2)
    h = np.zeros((len(mean), 2))
    sigma2 = np.full(len(mean), 1e-2)
    for _ in range(EM_ITERATIONS):
        shape = mean + (basis @ h[..., None])[..., 0]
        image = (system @ shape[..., None])[..., 0]  # (B, M)
        scale = np.maximum((image * target).sum(1) / _nonzero((image**2).sum(1)), 1e-12)
        loading = scale[:, None, None] * (system @ basis)  # (B, M, 2)
        rest = target - scale[:, None] * (system @ mean[..., None])[..., 0]
        precision = loading.transpose(0, 2, 1) @ loading / sigma2[:, None, None]
        precision[:, [0, 1], [0, 1]] += 1.0 / spread
        cov_h = np.stack([_solve(precision, np.tile(e, (len(h), 1))) for e in np.eye(2)], 2)
        h = (cov_h @ (loading.transpose(0, 2, 1) @ rest[..., None]))[..., 0] / sigma2[:, None]
        left = rest - (loading @ h[..., None])[..., 0]
        extra = np.einsum("bmi,bij,bmj->b", loading, cov_h, loading, optimize=True)
        sigma2 = np.maximum(((left**2).sum(1) + extra) / count, 1e-10)
    shape = np.maximum(mean + (basis @ h[..., None])[..., 0], 1e-4)
    # marginal likelihood: determinant lemma over the two latent dimensions
    inner = np.linalg.slogdet(precision)[1] + np.log(spread).sum(1)
    fit = ((left**2).sum(1)) / sigma2 + (h**2 / spread).sum(1)
    likelihood = -0.5 * (count * np.log(2.0 * np.pi * sigma2) + inner + fit)
    return scale[:, None] * shape, np.sqrt(sigma2), likelihood


def _known_camera_start(
    center_px: Array, rows: Array, seen: BoolArray, img_from_world: Array
) -> tuple[Ellipsoids, Array]:
    """Triangulate the box centres, linearise the cameras there and fit the ellipsoids.

    Returns:
        the ellipsoids (least squares, no prior) and the affine cameras (O, F, 2, 3).
    """
    cams = _cameras(img_from_world)
    seen = seen & _finite(cams.center, 1)[:, None]
    boxes = np.concatenate([center_px, center_px], -1).transpose(1, 0, 2)  # (O, F, 4)
    rays = _rays(boxes, cams, np.where(seen.T, np.arange(len(seen)), -1))
    mats = rays.matrix  # (O, F, 3, 4)
    image = np.einsum("ofij,oj->ofi", mats[..., :3], rays.point) + mats[..., 3]
    depth = _nonzero(image[..., 2:])[..., None]
    affine = (mats[..., :2, :3] - image[..., :2, None] / depth * mats[..., 2:, :3]) / depth
    block = _fit_shapes(_congruence(affine), rows, seen & _finite(affine, 2, 3).T)
    solids = Ellipsoids.from_dual_quadrics(_dual_quadrics(rays.point, block))[0]
    return solids, _where(seen.T, affine, np.nan)
