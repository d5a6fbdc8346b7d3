"""The floor: the lowest level that sparse points support, with its sigma, or why there is none.

A plane is looked for near the horizontal: every tilt of a grid, every height, then refined by
robust least squares. Whether it is a floor and not a table is asked at the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from reobj.cameras import Poses, invert_rigid
from reobj.files import numbers
from reobj.types import Array, BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """A plane; lengths in world units.

    Attributes:
        normal: (3,) unit vector upwards; offset: normal @ x == offset for points x of the floor.
        sigma: standard deviation of its height at `middle` (3,), that of the room, on the floor.
        tilt_sigma_deg: standard deviation of the normal's direction, about the worse axis.
        inliers: points on it.
    """

    normal: Array
    offset: float
    middle: Array
    sigma: float
    tilt_sigma_deg: float
    inliers: int


MIN_POINTS = 100  # fewer say nothing (chosen)
MIN_OBSERVATIONS = 3  # of a point that is used, if so many are left (chosen: two views may err)
NOISE = 0.012  # of points along the height, over their distance (chosen: 4 cm at 3 m)
# What half samples of the room cannot see: drift of the cameras, gravity, truth (chosen: 9 mm at
# 3 m; hololens_kitchen's floor lies .5 deg off its gravity).
SYSTEMATIC = 0.003  # sigma of the height, over the distance
SYSTEMATIC_DEG = 0.3  # sigma of the tilt


def floor_of(
    poses: Poses, up: Array | None, metres_per_unit: float | None
) -> tuple[Floor | None, str]:
    """Find the floor in the largest part of a world; None and the reason where there is none.

    Args:
        up: (3,) unit vector against gravity, None if unknown. metres_per_unit: None if unknown.
    """
    largest = poses.of_part(0)
    if up is None:
        return None, "gravity is unknown"
    count = np.bincount(largest.visibility[:, 1], minlength=len(largest.points))
    often = count >= MIN_OBSERVATIONS
    points = largest.points[often] if often.sum() >= MIN_POINTS else largest.points
    centres = invert_rigid(largest.cam_from_world[largest.known])[:, :, 3]
    return find_floor(points, up, centres, metres_per_unit)


def find_floor(
    points: Array, up: Array, centres: Array, metres_per_unit: float | None
) -> tuple[Floor | None, str]:
    """Find the floor under cameras.

    Args:
        points: (N, 3) sparse points. up: (3,) unit vector against gravity, a few degrees off at
            most. centres: (C, 3) of the cameras. metres_per_unit: None if unknown.
    Returns:
        the floor and ""; or None and the reason.
    """
    if len(points) < MIN_POINTS or not len(centres):
        return None, f"{len(points)} points, {MIN_POINTS} are needed"
    if metres_per_unit is None:
        return None, "the scale is unknown: a table's top cannot be told from a floor"
    some = centres[:: -(-len(centres) // 50)]
    distance = float(np.median(np.linalg.norm(points[:, None] - some, axis=2).min(1)))
    noise, axes = NOISE * distance, _axes(up)  # (3, 3) rows: two across, up
    local = _one_a_voxel(points, noise) @ axes.T  # (N, 3) across, across, height
    local = local[local[:, 2] < np.median(centres @ up)]
    if len(local) < MIN_POINTS:
        return None, f"{len(local)} points lie lower than the cameras, {MIN_POINTS} are needed"
    middle = centres.mean(0) @ axes[:2].T  # (2,) across
    local[:, :2] -= middle
    start = _best_level(local, noise)
    if start is None:
        return None, "no level near the horizontal has many points on it and few below"
    plane, on_it = _refine(local, start, noise)
    off = _half_samples(local, noise) - plane  # (H, 3)
    cov = off.T @ off / max(len(off), 1)  # (3, 3)
    normal = np.array([-plane[1], -plane[2], 1.0]) @ axes
    normal /= np.linalg.norm(normal)
    foot = np.array([*middle, plane[0]]) @ axes
    tilt_deg = math.degrees(np.sqrt(np.linalg.eigvalsh(cov[1:, 1:])[-1].clip(0)))
    sigma = math.hypot(math.sqrt(cov[0, 0]), SYSTEMATIC * distance)
    values = (sigma, math.hypot(tilt_deg, SYSTEMATIC_DEG))
    sigma, tilt_sigma_deg = numbers(np.array(values))  # as objects.json has them
    normal, foot = np.array(numbers(normal)), np.array(numbers(foot, distance))
    (offset,) = numbers(normal @ foot, distance)  # of the rounded plane: it goes through `foot`
    directions = (normal, offset, foot)
    floor = Floor(*directions, sigma, tilt_sigma_deg, int(on_it.sum()))
    height_m = float(np.median(centres @ floor.normal - floor.offset)) * metres_per_unit
    off = local[:, 2] - np.column_stack([np.ones(len(local)), local[:, :2]]) @ plane
    on, above = ((low * noise < off) & (off < high * noise) for low, high in ((-1, 1), ABOVE))
    if on.sum() < MIN_EDGE * above.sum() * 2 / (ABOVE[1] - ABOVE[0]):
        return None, "no level has clearly more points on it than above it"
    reason = _fault(floor, local, on_it, noise, height_m, metres_per_unit)
    return (None, reason) if reason else (floor, "")


MIN_INLIERS, MIN_SHARE = 30, 0.015  # of the points, after thinning (chosen)
MIN_SPREAD = 0.3  # rms spread across of the points on it over that of all (chosen)
MIN_EDGE = 1.5  # density of points on it over that shortly above (chosen)
MAX_SIGMA = 3.0  # of the height, in `noise` (chosen: 11 cm at 3 m)
CAMERA_HEIGHT_M = (0.3, 2.5)  # of a camera in a hand above a floor (chosen: wide)
STANDING_M = 1.1  # a camera so high is above a floor, not above a table (chosen) ...
TABLE_M = 2.5  # ... and a level so long is no table's (chosen: tables for eight are 2.4 m)


def _fault(
    floor: Floor,
    local: Array,
    on_it: BoolArray,
    noise: float,
    height_m: float,
    metres_per_unit: float,
) -> str:
    """Say why a level is not to be taken for the floor, "" if it is."""
    across = local[on_it, :2]
    low, high = CAMERA_HEIGHT_M
    if len(across) < max(MIN_INLIERS, MIN_SHARE * len(local)):
        return f"only {len(across)} points lie on the lowest level"
    if np.var(across, axis=0).sum() < MIN_SPREAD**2 * np.var(local[:, :2], axis=0).sum():
        return "the lowest level with points is but a small place"
    if floor.sigma > MAX_SIGMA * noise:
        sigma_m = floor.sigma * metres_per_unit
        return f"no level is clear: halves of the room put it {sigma_m:.2g} m apart"
    if not low <= height_m <= high:
        return f"the lowest level lies {height_m:.2g} m below the cameras ({low}-{high} m expected)"
    length_m = float(np.ptp(np.percentile(across, (5, 95), axis=0), axis=0).max()) * metres_per_unit
    if height_m < STANDING_M and length_m < TABLE_M:
        size = f"{length_m:.2g} m long, {height_m:.2g} m below the cameras"
        return f"the lowest level may be a table's top: {size}"
    return ""


def _axes(up: Array) -> Array:
    """Return right-handed axes (3, 3), rows, the last of them `up`."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(up, first), up])


def _one_a_voxel(points: Array, size: float) -> Array:
    """Thin points to one a voxel, so that texture does not outvote area."""
    cell = np.floor((points - points.min(0)) / size).astype(np.int64)
    return points[np.unique(cell, axis=0, return_index=True)[1]]


MAX_TILT_DEG = 6.0  # of the floor from `up` (chosen: errors of an estimated direction)
TILT_STEP_DEG = 1.0  # of the search (chosen: refined later)
TILT_SIGMA_DEG = 2.0  # of `up`, beforehand (chosen)
MAX_BELOW = 0.03  # share of the points that may be wrong and lie below the floor (chosen)
ABOVE = (4, 10)  # `noise` above a level where what stands on it counts against it (chosen)


def _best_level(local: Array, noise: float) -> Array | None:
    """Find the plane with the most points on it, more than shortly above it, and few below.

    Args:
        local: (N, 3) across, across, height, from the middle.
    Returns:
        (3,) a, b, c of height = a + b x + c y; None if there is none.
    """
    steps = np.arange(-MAX_TILT_DEG, MAX_TILT_DEG + 1e-6, TILT_STEP_DEG)
    tilts = np.array([(b, c) for b in steps for c in steps if math.hypot(b, c) <= MAX_TILT_DEG])
    best, found, pad = 0.0, None, max(ABOVE)
    for tilt_deg, (b, c) in zip(np.hypot(*tilts.T), np.tan(np.radians(tilts)), strict=True):
        height = local[:, 2] - local[:, 0] * b - local[:, 1] * c
        low = height.min()
        count = np.bincount(((height - low) / noise).astype(np.int64))  # (B,)
        lower = np.repeat((0, len(local)), (pad + 1, len(count) + pad))
        np.cumsum(count, out=lower[pad + 1 : -pad])
        below = {k: lower[pad + k : pad + k + len(count)] for k in (-2, 0, 2, *ABOVE)}  # bin + k
        on_it, width = below[2] - below[0], ABOVE[1] - ABOVE[0]
        above = (below[ABOVE[1]] - below[ABOVE[0]]) * 2 / width  # of as many bins
        likely = math.exp(-0.5 * (tilt_deg / TILT_SIGMA_DEG) ** 2)
        score = np.where(below[-2] <= MAX_BELOW * len(local), on_it - above, 0) * likely
        at = int(score.argmax())
        if score[at] > best:
            best, found = float(score[at]), np.array([low + (at + 1) * noise, b, c])
    return found


ITERATIONS = 10  # of the refinement (chosen)
CELL = 6.0  # side of the cells that count as one measurement each, in `noise` (chosen)
WINDOW = 2.5  # residuals on the floor, in their own sigma (chosen)


def _refine(local: Array, plane: Array, noise: float) -> tuple[Array, BoolArray]:
    """Fit a plane to the points on it by robust least squares.

    Texture does not count: each cell across is one measurement. What stands on the floor lies above
    it, so the noise is told from the points below.

    Returns:
        plane (3,) and the points on it (N,).
    """
    across = np.column_stack([np.ones(len(local)), local[:, :2]])  # (N, 3)
    cell = np.floor(local[:, :2] / (CELL * noise)).astype(np.int64)
    cell_of = np.unique(cell, axis=0, return_inverse=True)[1].ravel()  # (N,)
    on_it = np.zeros(len(local), bool)
    for _ in range(ITERATIONS):
        residual = local[:, 2] - across @ plane
        below = residual[(residual < 0) & (residual > -3 * noise)]
        sigma = noise
        if len(below) > 5:  # of a normal distribution the median of |r| is .67 sigma
            sigma = float(np.clip(np.median(-below) / 0.6745, 0.1 * noise, noise))
        on_it = np.abs(residual) < WINDOW * sigma
        design, height = _cell_means(cell_of[on_it], across[on_it], local[on_it, 2])
        plane = _fit_plane(design, height, plane, sigma)
    return plane, on_it


HALVES = 16  # half samples of the room (chosen: each takes as long as the whole)
PATCH = 20.0  # side of the patches of half samples, in `noise` (chosen: .8 m at 3 m)


def _half_samples(local: Array, noise: float) -> Array:
    """Find the plane again in halves of the room, patch by patch (3,) each.

    Errors of neighbouring points are alike (of the cameras, of a floor that is not even), and
    another level may win: the scatter of the halves holds all of that. Its mean square about the
    whole is the variance of the whole (Efron: half-sampling; McCarthy, 1969).
    """
    rng, planes = np.random.default_rng(0), []
    patch = np.floor(local[:, :2] / (PATCH * noise)).astype(np.int64)
    patch_of = np.unique(patch, axis=0, return_inverse=True)[1].ravel()  # (N,)
    for _ in range(HALVES // 2):
        one = rng.permutation(patch_of.max() + 1) % 2 == 0
        for half in (local[one[patch_of]], local[~one[patch_of]]):
            if len(half) and (start := _best_level(half, noise)) is not None:
                planes.append(_refine(half, start, noise)[0])
    return np.array(planes).reshape(-1, 3)


def _fit_plane(design: Array, height: Array, plane: Array, sigma: float) -> Array:
    """Improve a plane by one robust step, with the prior on its tilt."""
    prior = np.diag([0.0, *[1 / math.tan(math.radians(TILT_SIGMA_DEG)) ** 2] * 2])
    off = height - design @ plane
    weight = 1 / (sigma**2 + off**2)  # Cauchy's
    information = (design.T * weight) @ design + prior
    step = np.linalg.lstsq(information, design.T @ (weight * off) - prior @ plane, rcond=1e-12)[0]
    return np.asarray(plane + step)


def _cell_means(cell: IntArray, across: Array, height: Array) -> tuple[Array, Array]:
    """Return the mean of rows (N, 3) and heights (N,) in each cell that has any."""
    _, cell = np.unique(cell, return_inverse=True)
    count = np.bincount(cell).astype(float)
    columns = [np.bincount(cell, column) / count for column in across.T]
    return np.column_stack(columns).reshape(-1, 3), np.bincount(cell, height) / count
