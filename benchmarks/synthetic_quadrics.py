"""Measure quadrics.py on synthetic scenes with known truth.

Usage:
    python benchmarks/synthetic_quadrics.py [--quick] [--only NAME ...] [-o benchmarks]

Prints each table. With -o FOLDER, writes it between its markers in FOLDER/RESULTS.md and the plot
to FOLDER/img.

All experiments are seeded. Boxes are the exact bounds of the projected shape (ellipsoid: dual
conic; cuboid: corners; cylinder: rims). Gaussian noise with a standard deviation proportional to
the box's width or height moves each edge.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from tables import table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import quadrics
from quadrics import Array, Ellipsoids, FitConfig, Priors

IMAGE = (1280, 960)  # px
FOCAL = 1000.0  # px
UP = (0.0, 0.0, 1.0)
TILT_DEG = 1.5  # deg, sigma of the tilt of objects in fit_objects
CUBOIDS = ((0.59, 0.60, 0.82), (0.60, 0.19, 0.45), (0.22, 0.28, 0.04))  # m


def look_at(center: Array, target: Array, roll: Array) -> Array:
    """Cameras (F, 3, 4) img_from_world at `center` (F, 3) looking at `target`, rolled (F,) rad."""
    forward = target - center
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    rot = np.stack([c * right + s * down, c * down - s * right, forward], 1)  # (F, 3, 3)
    calib = np.array([[FOCAL, 0, IMAGE[0] / 2], [0, FOCAL, IMAGE[1] / 2], [0, 0, 1.0]])
    return np.asarray(calib @ np.concatenate([rot, -rot @ center[:, :, None]], 2))


def arc_cameras(
    n: int,
    arc_deg: float,
    rng: np.random.Generator,
    distance: float = 2.5,
    elevation_deg: float = 25.0,
) -> Array:
    """n cameras on an arc around the origin, with jitter in position, aim and roll."""
    yaw = np.deg2rad(np.linspace(-0.5, 0.5, n) * arc_deg) + rng.uniform(0, 2 * np.pi)
    lift = np.deg2rad(elevation_deg + rng.normal(0, 4, n))
    center = np.stack([np.cos(yaw) * np.cos(lift), np.sin(yaw) * np.cos(lift), np.sin(lift)], 1)
    center = center * distance + rng.normal(0, 0.03, (n, 3))
    return look_at(center, rng.normal(0, 0.1, (n, 3)), rng.normal(0, 0.03, n))


def random_yaw(n: int, rng: np.random.Generator, tilt_deg: float = 0.0) -> Array:
    """Upright rotations (n, 3, 3), leaning by a Gaussian tilt about both level axes."""
    angle = rng.uniform(0, 2 * np.pi, n)
    lean = np.zeros((n, 3))
    lean[:, :2] = rng.normal(0, np.deg2rad(tilt_deg), (n, 2))
    yaw = quadrics.rotations(angle[:, None] * np.array([0.0, 0.0, 1.0]))
    return np.asarray(yaw @ quadrics.rotations(lean))


def noisy(boxes: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Move edges by Gaussian noise of `sigma` times the width (left, right) or height."""
    side = np.tile(boxes[..., 2:] - boxes[..., :2], 2)
    return boxes + rng.normal(0, sigma, boxes.shape) * side


def individual_priors(log_size: Array, sigma: float, shape: str) -> tuple[Priors, list[str]]:
    """Priors with one category an object: mean log full size (O, 3), isotropic log sigma."""
    n = len(log_size)
    names = [f"object {k}" for k in range(n)]
    cov = np.tile(np.eye(3) * sigma**2, (n, 1, 1))
    diff = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])
    code = np.full(n, quadrics.SUPPORTS.index(shape))
    flags = np.zeros(n, bool)
    ratio = (log_size @ diff.T, diff @ cov @ diff.T)
    return Priors(tuple(names), {}, log_size, cov, *ratio, code, flags, ~flags, flags), names


def scenes(
    n_trials: int, n_views: int, arc_deg: float, noise: float, shape: str,
    rng: np.random.Generator,
    sizes: tuple[float, float, float] | None = None, spread: float = 0.25, tilt_deg: float = 0.0,
) -> tuple[Array, Array, Ellipsoids, Priors, list[str]]:  # fmt: skip
    """Independent one-object scenes: boxes (T, V, 1, 4), cameras (T, V, 3, 4), truth, priors.

    Without `sizes` half axes are log-uniform in .1 to .4 m; the truth differs from the prior's
    mean by `spread` (log sigma) an axis, so that the prior is right in its own terms.
    """
    if sizes is None:
        mean = rng.uniform(np.log(0.1), np.log(0.4), (n_trials, 3)) + np.log(2.0)
    else:
        mean = np.tile(np.log(sizes), (n_trials, 1))
    log_size = mean + rng.normal(0, spread, mean.shape)
    rot = random_yaw(n_trials, rng, tilt_deg)
    truth = Ellipsoids(rng.normal(0, 0.05, (n_trials, 3)), 0.5 * np.exp(log_size), rot)
    cams = np.stack([arc_cameras(n_views, arc_deg, rng) for _ in range(n_trials)])
    boxes = np.stack(
        [quadrics.solid_boxes(truth[k : k + 1], shape, cams[k]) for k in range(n_trials)]
    )  # (T, V, 1, 4)
    return noisy(boxes, noise, rng), cams, truth, *individual_priors(mean, spread, shape)


def as_one(boxes: Array, cams: Array) -> tuple[Array, Array]:
    """Put T scenes side by side: frames are concatenated, objects unseen elsewhere are NaN."""
    trials, views = boxes.shape[:2]
    joint = np.full((trials * views, trials, 4), np.nan)
    for k in range(trials):
        joint[k * views : (k + 1) * views, k] = boxes[k, :, 0]
    return joint, cams.reshape(-1, 3, 4)


# ---- References and helpers ----------------------------------------------------------------


def box_overlap(a: Ellipsoids, b: Ellipsoids, nodes: int = 40) -> Array:
    """Measure intersection over union of oriented boxes (half extents = half_axes), pair by pair.

    In the frame where `a` is the cube [-1, 1]^3, chords of both boxes along x are exact (slabs)
    and integrated over the common extent in y and z. Accuracy ~1e-3. Returns (O,); NaN where an
    input is not finite.
    """
    to_cube = a.world_from_obj.transpose(0, 2, 1) / a.half_axes[:, :, None]  # (O, 3, 3)
    edges = to_cube @ (b.world_from_obj * b.half_axes[:, None, :])  # (O, 3, 3) columns
    safe = np.isfinite(edges).all((1, 2)) & (np.abs(np.linalg.det(edges)) > 1e-300)
    edges = np.where(safe[:, None, None], edges, np.eye(3))
    center = (to_cube @ (b.center_in_world - a.center_in_world)[..., None])[..., 0]
    reach = np.abs(edges).sum(2)  # (O, 3) half extent of b along the cube's axes
    low, high = np.maximum(-1.0, center - reach), np.minimum(1.0, center + reach)
    span = np.clip(high - low, 0.0, None)  # (O, 3)
    x, w = np.polynomial.legendre.leggauss(nodes)
    y, z = (0.5 * (low + high)[:, k, None] + 0.5 * span[:, k, None] * x for k in (1, 2))
    slab = np.linalg.inv(edges)  # (O, 3, 3): rows n_k with |n_k (p - c)| <= 1 inside b
    slab[np.abs(slab[:, :, 0]) < 1e-12, 0] = 1e-12  # a slab along the chords
    first, last = low[:, 0, None, None], high[:, 0, None, None]
    for k in range(3):  # over slabs
        along = slab[:, k, 0, None, None]
        level_y = slab[:, k, 1, None] * (y - center[:, 1, None])  # (O, N)
        level_z = slab[:, k, 2, None] * (z - center[:, 2, None])
        mid = center[:, 0, None, None] - (level_y[:, :, None] + level_z[:, None]) / along
        first = np.maximum(first, mid - 1.0 / np.abs(along))  # (O, N, N)
        last = np.minimum(last, mid + 1.0 / np.abs(along))
    chord = np.clip(last - first, 0.0, None)
    inter = 0.25 * span[:, 1] * span[:, 2] * np.einsum("oyz,y,z->o", chord, w, w, optimize=True)
    volume_b = 8.0 * np.abs(np.linalg.det(edges))
    iou = np.clip(inter / (8.0 + volume_b - inter), 0.0, 1.0)
    return np.where(safe & np.isfinite(center).all(1), iou, np.nan)


def align(found: Ellipsoids, truth: Ellipsoids) -> Ellipsoids:
    """Similarity (no reflection) of `found` onto `truth` by their centres. Ref: Umeyama 1991."""
    a = found.center_in_world - found.center_in_world.mean(0)
    b = truth.center_in_world - truth.center_in_world.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rot = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    scale = np.trace(b.T @ a @ rot.T) / (a**2).sum()
    center = scale * a @ rot.T + truth.center_in_world.mean(0)
    return Ellipsoids(center, scale * found.half_axes, rot @ found.world_from_obj)


def far_scene(
    n_views: int, n_objects: int, sweep_deg: float, rng: np.random.Generator
) -> tuple[Ellipsoids, Array]:
    """Objects within 2 m seen by nearly affine cameras from 60 m (as in the SfMO papers)."""
    half = np.exp(rng.uniform(np.log(0.1), np.log(0.4), (n_objects, 3)))
    truth = Ellipsoids(rng.uniform(-1, 1, (n_objects, 3)), half, random_yaw(n_objects, rng))
    yaw = np.deg2rad(np.linspace(-0.5, 0.5, n_views) * sweep_deg) + rng.uniform(0, 2 * np.pi)
    lift = np.deg2rad(20 + 0.25 * sweep_deg * np.sin(np.arange(n_views)))
    center = np.stack([np.cos(yaw) * np.cos(lift), np.sin(yaw) * np.cos(lift), np.sin(lift)], 1)
    cams = look_at(60.0 * center, np.zeros((n_views, 3)), np.zeros(n_views))
    zoom = np.array([[20.0, 0, -19 * IMAGE[0] / 2], [0, 20.0, -19 * IMAGE[1] / 2], [0, 0, 1]])
    return truth, zoom @ cams


def furnished_room(
    rng: np.random.Generator, noise: float = 0.02
) -> tuple[Array, Array, Ellipsoids, list[str]]:
    """Known objects in a 5 m room, sizes drawn from priors.json, 24 cameras around, cut boxes."""
    names = (
        "chair,chair,couch,dining table,refrigerator,toilet,night stand,microwave,bed,bottle,"
        "cup,laptop,vase,keyboard,potted plant,sports ball"
    ).split(",")
    priors = quadrics.load_priors()
    rows = priors.index(names)
    draw = np.einsum(
        "oij,oj->oi", np.linalg.cholesky(priors.log_cov[rows]), rng.normal(0, 1, (len(names), 3))
    )
    log_size = priors.log_mean[rows] + draw
    round_ = priors.yaw_symmetric[rows]
    log_size[round_, 1] = log_size[round_, 0]
    half = 0.5 * np.exp(log_size)
    spot = np.array([(x, y) for x in np.linspace(-2, 2, 4) for y in np.linspace(-2, 2, 4)])
    lift = np.where(half.max(1) < 0.25, 0.75, 0.0) + half[:, 2]  # small objects on tables
    center = np.concatenate([rng.permutation(spot)[: len(names)], lift[:, None]], 1)
    truth = Ellipsoids(center, half, random_yaw(len(names), rng, 1.0))
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    eye = np.stack([3.2 * np.cos(turn), 3.2 * np.sin(turn), np.full(24, 1.6)], 1)
    aim = np.stack([0.8 * np.cos(turn + 2.4), 0.8 * np.sin(turn + 2.4), np.full(24, 0.5)], 1)
    cams = look_at(eye + rng.normal(0, 0.1, eye.shape), aim, rng.normal(0, 0.03, 24))
    codes = [quadrics.SUPPORTS[k] for k in priors.support[rows]]
    boxes = noisy(quadrics.solid_boxes(truth, codes, cams, near=0.1), noise, rng)
    far_edge = np.array(IMAGE) - 20
    inside = np.all((boxes[..., 2:] > 20) & (boxes[..., :2] < far_edge), -1, keepdims=True)
    boxes = np.where(inside, quadrics.clip_boxes(boxes, IMAGE), np.nan)
    return boxes, cams, truth, names


def solve(
    boxes: Array, cams: Array, priors: Priors, names: Sequence[str],
    config: FitConfig | None = None, support: str | None = None,
) -> quadrics.ObjectFits:  # fmt: skip
    """Fit independent one-object scenes side by side, gravity known."""
    joint, flat = as_one(boxes, cams)
    return quadrics.fit_objects(
        joint, flat, IMAGE, names, priors, up=UP, support=support, config=config
    )


def region_error(fits: quadrics.ObjectFits, truth: Ellipsoids) -> tuple[Array, Array]:
    """Errors (O, 9) in the covariance's coordinates and their squared Mahalanobis distance (O,).

    A solid turned by 90 degrees with width and depth swapped is the same solid: nearest one counts.
    """
    best, errors = np.full(len(truth), np.inf), np.zeros((len(truth), 9))
    inverse = np.linalg.inv(fits.cov)
    for k in range(4):
        turn = quadrics.rotations(np.array([[0, 0, k * np.pi / 2]]))[0]
        half = truth.half_axes[:, [1, 0, 2]] if k % 2 else truth.half_axes
        rot = fits.ellipsoids.world_from_obj.transpose(0, 2, 1) @ truth.world_from_obj @ turn
        center = truth.center_in_world - fits.ellipsoids.center_in_world
        ratio = np.log(half / fits.ellipsoids.half_axes)
        error = np.concatenate([center, ratio, quadrics.rotation_vectors(rot)], 1)
        square = np.einsum("oi,oij,oj->o", error, inverse, error)
        closer = square < best
        best[closer], errors[closer] = square[closer], error[closer]
    return errors, best


def coverage(
    n: int, views: int, arc_deg: float, noise: float, shape: str, rng: np.random.Generator,
    config: FitConfig | None = None,
) -> dict[str, float]:  # fmt: skip
    """Rate of trials with the truth in the 95 % region: all nine, and each block of three.

    The truth is drawn from the prior, tilt included, so that the region is calibrated.
    """
    boxes, cams, truth, priors, names = scenes(
        n, views, arc_deg, noise, shape, rng, tilt_deg=TILT_DEG
    )
    fits = solve(boxes, cams, priors, names, config)
    errors, square = region_error(fits, truth)
    out = {"all": float((square < 16.919).mean())}  # chi2 0.95, 9 dof
    for name, part in (("center", slice(0, 3)), ("size", slice(3, 6)), ("rotation", slice(6, 9))):
        block = np.linalg.inv(fits.cov[:, part, part])
        own = np.einsum("oi,oij,oj->o", errors[:, part], block, errors[:, part])
        out[name] = float((own < 7.815).mean())  # chi2 0.95, 3 dof
    return out


# ---- Tables --------------------------------------------------------------------------------


def lfd_overlap(boxes: Array, cams: Array, truth: Ellipsoids) -> tuple[float, float]:
    """Mean O3D of closed-form LfD (0 if it is no ellipsoid) and fraction of ellipsoids."""
    dual_q, real = quadrics.fit_lfd(*as_one(boxes, cams))
    found = Ellipsoids.from_dual_quadrics(dual_q)[0]
    return float(np.nan_to_num(quadrics.volume_overlap(found, truth)).mean()), float(real.mean())


def ellipsoids_table(trials: int) -> str:
    """O3D of true ellipsoids: LfD and fit_objects over arcs, views and noise."""
    rows = []
    for views in (3, 10):
        for arc in (5, 20, 90):
            row: list[object] = [views, arc]
            for noise in (0.01, 0.03, 0.10):
                rng = np.random.default_rng(1)
                boxes, cams, truth, priors, names = scenes(
                    trials, views, arc, noise, "ellipsoid", rng
                )
                closed, real = lfd_overlap(boxes, cams, truth)
                fits = solve(boxes, cams, priors, names)
                ours = quadrics.volume_overlap(fits.ellipsoids, truth).mean()
                row.append(f"{closed:.2f} ({real:.0%} real) -> **{ours:.2f}**")
            rows.append(row)
    return table(["views", "arc deg", "noise 1 %", "3 %", "10 %"], rows)


def cuboids_table(trials: int) -> str:
    """Box IoU of true cuboids when fitted as an ellipsoid, as a box, and by the evidence."""
    rows = []
    for size in CUBOIDS:
        rng = np.random.default_rng(2)
        boxes, cams, truth, priors, names = scenes(trials, 10, 120, 0.02, "box", rng, size)
        row: list[object] = [" x ".join(f"{x:.2f}" for x in size)]
        for shape in ("ellipsoid", "box", "evidence"):
            fits = solve(boxes, cams, priors, names, support=shape)
            iou = box_overlap(fits.ellipsoids, truth).mean()
            cuboids = (fits.support == "box").mean()
            row.append(f"{iou:.3f}" + (f" ({cuboids:.0%} boxes)" if shape == "evidence" else ""))
        rows.append(row)
    return table(["size m", "ellipsoid", "box", "evidence"], rows)


def room_table(trials: int) -> str:
    """Scale and gravity of furnished rooms, nothing given but boxes, categories and cameras."""
    priors, rows = quadrics.load_priors(), []
    for given in ("scale and up", "up", "scale", "nothing"):
        scales, tilts, sizes, inside = [], [], [], []
        for seed in range(max(4, trials // 15)):
            boxes, cams, truth, names = furnished_room(np.random.default_rng(seed))
            unit = 1.0 if "scale" in given else 0.37
            fits = quadrics.fit_objects(
                boxes, cams @ np.diag([1 / unit] * 3 + [1.0]), IMAGE, names, priors,
                up=UP if "up" in given else None, metric="scale" in given,
            )  # fmt: skip
            error = np.log(fits.scale.value * unit)
            scales.append(abs(error))
            inside.append(abs(error) <= 1.96 * fits.scale.rel_sigma or "scale" in given)
            tilts.append(np.rad2deg(np.arccos(np.clip(fits.up @ np.array(UP), -1, 1))))
            ratio = np.log(np.sort(fits.size * fits.scale.value) / np.sort(2 * truth.half_axes))
            sizes.append(np.nanmedian(np.abs(ratio)))
        medians = [f"{100 * np.median(scales):.1f} %", f"{np.mean(inside):.0%}"]
        rows.append([given, *medians, f"{np.median(tilts):.2f}", f"{100 * np.median(sizes):.1f} %"])
    head = ["given", "scale error", "within its 95 %", "up error deg", "median size error"]
    return table(head, rows)


# ---- Figure 4.2 of the thesis --------------------------------------------------------------


def disturb(dual_c: Array, rotation_deg: float, size: float, rng: np.random.Generator) -> Array:
    """Turn ellipses about their centres and scale their axes by Gaussian errors."""
    scaled = -dual_c / dual_c[..., 2:, 2:]
    center = -scaled[..., :2, 2]
    block = scaled[..., :2, :2] + center[..., :, None] * center[..., None, :]
    value, vector = np.linalg.eigh(block)
    value = value * np.exp(2 * rng.normal(0, size, value.shape))
    turn = rng.normal(0, np.deg2rad(rotation_deg), dual_c.shape[:-2])
    c, s = np.cos(turn), np.sin(turn)
    rot = np.stack([c, -s, s, c], -1).reshape(*turn.shape, 2, 2) @ vector
    out = -np.ones((*turn.shape, 3, 3))
    spread = np.einsum("...ik,...k,...jk->...ij", rot, value, rot)
    out[..., :2, :2] = spread - center[..., :, None] * center[..., None, :]
    out[..., :2, 2] = out[..., 2, :2] = -center
    return out


def ratio_priors(mean_log: Array, cov_log: Array) -> Priors:
    """Priors that know axis ratios only: the common size is free (log sigma 3)."""
    names = tuple(f"kind {k}" for k in range(len(mean_log)))
    full = np.zeros((len(names), 3, 3))
    full[:, :2, :2] = cov_log
    full += 1e-4 * np.eye(3) + 9.0
    log_mean = np.concatenate([mean_log, np.zeros((len(names), 1))], 1)
    flags = np.ones(len(names), bool)
    code = np.zeros(len(names), np.int64)
    return Priors(names, {}, log_mean, full, mean_log, cov_log, code, ~flags, flags, ~flags)


METHODS = ["SfMO", "PSfMO", "PSfMO, cameras known", "fit_objects, cameras known"]


def thesis_trial(rotation_deg: float, size: float, seed: int) -> list[float]:
    """Mean O3D of METHODS for one disturbed scene."""
    rng = np.random.default_rng(seed)
    truth, cams = far_scene(15, 8, 25.0, rng)
    table_ = quadrics.load_priors()
    kinds = table_.index(["chair", "couch", "bottle", "monitor", "bed", "laptop", "mug", "bench"])
    known = ratio_priors(table_.ratio_mean[kinds], table_.ratio_cov[kinds])
    draw = np.einsum("oij,oj->oi", np.linalg.cholesky(known.ratio_cov), rng.normal(0, 1, (8, 2)))
    ratio = np.exp(np.concatenate([known.ratio_mean + draw, np.zeros((8, 1))], 1))
    half = ratio / np.linalg.norm(ratio, axis=1, keepdims=True) * rng.uniform(0.25, 0.45, (8, 1))
    truth = Ellipsoids(truth.center_in_world, half, truth.world_from_obj)
    dual_c = disturb(quadrics.project(truth.dual_quadrics(), cams)[0], rotation_deg, size, rng)
    names = list(known.names)
    boxes = quadrics.boxes_from_dual_conics(dual_c)
    affine = quadrics.fit_psfmo(None, known, names, None, dual_c)
    posed = quadrics.fit_psfmo(None, known, names, cams, dual_c)
    ours = quadrics.fit_objects(boxes, cams, (10**5, 10**5), names, known, up=UP)
    assert affine.start is not None

    def score(*found: Ellipsoids | None) -> float:
        return max(
            float(np.nan_to_num(quadrics.volume_overlap(x, truth).mean()))
            for x in found
            if x is not None
        )

    pairs = ((x.ellipsoids, x.mirrored) for x in (affine.start, affine))
    free = [score(*(align(x, truth) for x in pair if x is not None)) for pair in pairs]
    return [*free, score(posed.ellipsoids), score(ours.ellipsoids)]


def thesis_table(trials: int) -> str:
    """O3D (mean and sigma over scenes) against both errors of the ellipses."""
    sweeps = {
        "ellipse rotation error, deg": [(x, 0.02, x) for x in (0, 5, 10, 20, 30, 45)],
        "size error, %": [(2, x / 100, x) for x in (0, 5, 10, 20, 30, 50)],
    }
    rows = []
    for label, settings in sweeps.items():
        for rotation, size, value in settings:
            scores = [thesis_trial(rotation, size, seed) for seed in range(max(6, trials // 10))]
            pairs = zip(np.mean(scores, 0), np.std(scores, 0), strict=True)
            rows.append([label, value, *(f"{mean:.2f} ± {sigma:.2f}" for mean, sigma in pairs)])
    return table(["disturbance", "value", *METHODS], rows)


TABLES: dict[str, Callable[[int], str]] = {
    "ellipsoids": ellipsoids_table,
    "cuboids": cuboids_table,
    "room": room_table,
    "thesis": thesis_table,
}


def write_table(page: Path, name: str, text: str) -> None:
    """Replace the text between the markers of a table in a Markdown page."""
    old = page.read_text(encoding="utf-8")
    begin, end = f"<!-- table {name} -->", f"<!-- end {name} -->"
    if begin not in old or end not in old:
        raise SystemExit(f"error: {page} has no markers {begin} ... {end}")
    head, rest = old.split(begin, 1)
    page.write_text(f"{head}{begin}\n{text}\n{end}{rest.split(end, 1)[1]}", encoding="utf-8")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer trials: a smoke test")
    parser.add_argument("--only", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("-o", type=Path, metavar="FOLDER", help="fill in FOLDER/RESULTS.md")
    args = parser.parse_args(argv)
    for name in args.only:
        start = time.perf_counter()
        trials = 40 if args.quick else 300
        text = TABLES[name](trials)
        print(f"## {name} ({time.perf_counter() - start:.0f} s)\n\n{text}\n", flush=True)
        if args.o:
            write_table(args.o / "RESULTS.md", name, text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
