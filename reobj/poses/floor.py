"""Find the floor plane, with its uncertainty, in the sparse points.

Near-horizontal planes are searched on a grid of tilts and heights and refined by robust least
squares. Checks at the end reject other surfaces such as table tops.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from reobj.cameras import Poses, invert_rigid
from reobj.files import numbers
from reobj.types import Array, BoolArray, FiniteFloat, IntArray, NonNegativeInt, Vector


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """A floor plane; lengths in world units.

    Attributes:
        normal: (3,) unit vector upwards; offset: normal @ x == offset for points x of the floor.
        sigma: standard deviation of its height at `middle` (3,), the point below the cameras' mean.
        tilt_sigma_deg: standard deviation of the normal's direction, about the worse axis.
        inliers: number of points on it.
    """

    normal: Vector
    offset: FiniteFloat
    middle: Vector
    sigma: FiniteFloat
    tilt_sigma_deg: FiniteFloat
    inliers: NonNegativeInt


NOISE = 0.012  # of points along the height, over their distance: 4 cm at 3 m


# Points of a component, and of it below the cameras; fewer lie on a plane by chance
MIN_POINTS = 100
UP_SIGMA_DEG = 2.0  # prior of `up`: error of an estimated direction
# Fraction of the points below the floor, outliers (measured: at .05 redkitchen gets a floor that
# lies .08 m high)
MAX_BELOW = 0.03
# Heights in NOISE, whole numbers, beyond the noise of the floor itself: points between them count
# against a plane
ABOVE = (4, 10)
# Density of points on the plane over that shortly above it: a higher limit refuses floors with
# much on them
MIN_EDGE = 1.5
# Sigmas of the height, over the distance, and of the tilt that are common to all half samples:
# drift of the cameras, gravity (9 mm at 3 m; the floor of hololens_kitchen lies .5 deg off its
# gravity: benchmarks/RESULTS.md)
COMMON_SIGMA = 0.003
COMMON_TILT_DEG = 0.3
CAMERA_HEIGHT_M = (0.3, 2.5)  # lowest and highest hand-held camera above a floor


def floor_of(
    poses: Poses, up: Array | None, metres_per_unit: float | None
) -> tuple[Floor | None, str]:
    """Find the floor in the largest component of the trajectory; or None and the reason.

    Args:
        up: (3,) unit vector against gravity, None if unknown. metres_per_unit: None if unknown.
    """
    largest = poses.of_part(0)
    if up is None:
        return None, "gravity is unknown"
    if largest.direction_sigma.any():
        return None, "the cameras have directions only"
    views = np.bincount(largest.visibility[:, 1], minlength=len(largest.points))
    often = views >= 3  # two views may be a false match
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
        return None, "the scale is unknown: a table top cannot be distinguished from a floor"
    sample = centres[:: -(-len(centres) // 50)]
    distance = float(np.median(np.linalg.norm(points[:, None] - sample, axis=2).min(1)))
    noise = NOISE * distance
    axes = _axes(up)  # (3, 3) rows: two across, up
    local = _one_per_voxel(points, noise) @ axes.T  # (N, 3) across, across, height
    local = local[local[:, 2] < np.median(centres @ up)]
    if len(local) < MIN_POINTS:
        return None, f"{len(local)} points below the cameras, {MIN_POINTS} are needed"
    middle = centres.mean(0) @ axes[:2].T  # (2,) across
    local[:, :2] -= middle
    start = _best_level(local, noise)
    if start is None:
        return None, "no near-horizontal plane has many points on it and few below"
    plane, on_plane = _refine(local, start, noise)
    deviation = _half_samples(local, noise) - plane  # (H, 3)
    cov = deviation.T @ deviation / max(len(deviation), 1)  # (3, 3)
    normal = np.array([-plane[1], -plane[2], 1.0]) @ axes
    normal /= np.linalg.norm(normal)
    foot = np.array([*middle, plane[0]]) @ axes
    tilt_deg = math.degrees(np.sqrt(np.linalg.eigvalsh(cov[1:, 1:])[-1].clip(0)))
    sigma = math.hypot(math.sqrt(cov[0, 0]), COMMON_SIGMA * distance)
    values = (sigma, math.hypot(tilt_deg, COMMON_TILT_DEG))
    sigma, tilt_sigma_deg = numbers(np.array(values))  # as objects.json has them
    normal = np.array(numbers(normal))
    foot = np.array(numbers(foot, distance))
    (offset,) = numbers(normal @ foot, distance)  # of the rounded plane: it contains `foot`
    floor = Floor(normal, offset, foot, sigma, tilt_sigma_deg, int(on_plane.sum()))
    height_m = float(np.median(centres @ floor.normal - floor.offset)) * metres_per_unit
    height = local[:, 2] - np.column_stack([np.ones(len(local)), local[:, :2]]) @ plane
    on, above = ((low * noise < height) & (height < high * noise) for low, high in ((-1, 1), ABOVE))
    if on.sum() < MIN_EDGE * above.sum() * 2 / (ABOVE[1] - ABOVE[0]):
        return None, "no plane has clearly more points on it than above it"
    reason = _fault(floor, local, on_plane, noise, height_m, metres_per_unit)
    return (None, reason) if reason else (floor, "")


def _fault(
    floor: Floor,
    local: Array,
    on_plane: BoolArray,
    noise: float,
    height_m: float,
    metres_per_unit: float,
) -> str:
    """Return why a plane is unlikely to be the floor, "" if it is likely."""
    across = local[on_plane, :2]
    low, high = CAMERA_HEIGHT_M
    if len(across) < max(30, 0.015 * len(local)):
        return f"only {len(across)} points lie on the lowest plane"
    # rms extent below .3 of the extent of all points
    if np.var(across, axis=0).sum() < 0.3**2 * np.var(local[:, :2], axis=0).sum():
        return "the lowest plane with points is small"
    if floor.sigma > 3 * noise:  # 11 cm at 3 m
        sigma_m = floor.sigma * metres_per_unit
        return f"its height is uncertain: halves of the room differ by {sigma_m:.2g} m"
    if not low <= height_m <= high:
        return f"the lowest plane is {height_m:.2g} m below the cameras ({low}-{high} m expected)"
    length_m = float(np.ptp(np.percentile(across, (5, 95), axis=0), axis=0).max()) * metres_per_unit
    if height_m < 1.1 and length_m < 2.5:  # tables for eight are 2.4 m long
        size = f"{length_m:.2g} m long, {height_m:.2g} m below the cameras"
        return f"the lowest plane may be a table top: {size}"
    return ""


def _axes(up: Array) -> Array:
    """Return right-handed axes (3, 3), rows, the last of them `up`."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(up, first), up])


def _one_per_voxel(points: Array, size: float) -> Array:
    """Keep one point per voxel, so that textured areas have no more weight."""
    cell = np.floor((points - points.min(0)) / size).astype(np.int64)
    return points[np.unique(cell, axis=0, return_index=True)[1]]


def _best_level(local: Array, noise: float) -> Array | None:
    """Find the plane with the most points on it minus the ones shortly above it, and few below.

    The search is to three sigmas of `up`, in steps of a degree: it is refined later.

    Args:
        local: (N, 3) across, across, height, from the middle.
    Returns:
        (3,) a, b, c of height = a + b x + c y; None if there is none.
    """
    first, last = ABOVE
    most = 3 * UP_SIGMA_DEG
    steps = np.arange(-most, most + 1e-6)
    tilts = np.array([(b, c) for b in steps for c in steps if math.hypot(b, c) <= most])
    best = 0.0
    plane: Array | None = None
    for tilt_deg, (b, c) in zip(np.hypot(*tilts.T), np.tan(np.radians(tilts)), strict=True):
        height = local[:, 2] - local[:, 0] * b - local[:, 1] * c
        low = height.min()
        count = np.bincount(((height - low) / noise).astype(np.int64))  # (B,)
        lower = np.repeat((0, len(local)), (last + 1, len(count) + last))
        np.cumsum(count, out=lower[last + 1 : -last])
        bins = (-2, 0, 2, first, last)
        below = {k: lower[last + k : last + k + len(count)] for k in bins}  # bin + k
        on_plane = below[2] - below[0]
        above = (below[last] - below[first]) * 2 / (last - first)  # of as many bins
        prior = math.exp(-0.5 * (tilt_deg / UP_SIGMA_DEG) ** 2)
        score = np.where(below[-2] <= MAX_BELOW * len(local), on_plane - above, 0)
        score = score * prior
        highest = int(score.argmax())
        if score[highest] > best:
            best = float(score[highest])
            plane = np.array([low + (highest + 1) * noise, b, c])
    return plane


def _refine(local: Array, plane: Array, noise: float) -> tuple[Array, BoolArray]:
    """Fit a plane to the points on it by robust least squares.

    Each horizontal cell, 6 `noise` wide, is one measurement, whatever its texture. Objects on the
    floor are above it, so the noise is estimated from the points below.

    Returns:
        plane (3,) and the points on it (N,).
    """
    across = np.column_stack([np.ones(len(local)), local[:, :2]])  # (N, 3)
    cell = np.floor(local[:, :2] / (6 * noise)).astype(np.int64)
    cell_of = np.unique(cell, axis=0, return_inverse=True)[1].ravel()  # (N,)
    on_plane = np.zeros(len(local), bool)
    for _ in range(10):
        residual = local[:, 2] - across @ plane
        below = residual[(residual < 0) & (residual > -3 * noise)]
        sigma = noise
        if len(below) > 5:  # the median of a half-normal distribution is .67 sigma
            sigma = float(np.clip(np.median(-below) / 0.6745, 0.1 * noise, noise))
        on_plane = np.abs(residual) < 2.5 * sigma
        design, height = _cell_means(cell_of[on_plane], across[on_plane], local[on_plane, 2])
        plane = _fit_plane(design, height, plane, sigma)
    return plane, on_plane


def _half_samples(local: Array, noise: float) -> Array:
    """Find the plane (3,) again in half samples of patches of the room.

    The scatter of the halves includes correlated errors of neighbouring points (of the cameras, of
    an uneven floor) and the choice of another plane. Its mean square about the plane of all points
    is the variance of that plane (Efron: half-sampling; McCarthy, 1969).
    """
    rng = np.random.default_rng(0)
    planes = []
    patch = np.floor(local[:, :2] / (20 * noise)).astype(np.int64)  # .8 m at 3 m
    patch_of = np.unique(patch, axis=0, return_inverse=True)[1].ravel()  # (N,)
    for _ in range(8):  # each half takes as long as the whole room
        in_first = rng.permutation(patch_of.max() + 1) % 2 == 0
        for half in (local[in_first[patch_of]], local[~in_first[patch_of]]):
            if len(half) and (start := _best_level(half, noise)) is not None:
                planes.append(_refine(half, start, noise)[0])
    return np.array(planes).reshape(-1, 3)


def _fit_plane(design: Array, height: Array, plane: Array, sigma: float) -> Array:
    """Update a plane by one robust Gauss-Newton step, with the prior on its tilt."""
    prior = np.diag([0.0, *[1 / math.tan(math.radians(UP_SIGMA_DEG)) ** 2] * 2])
    residual = height - design @ plane
    weight = 1 / (sigma**2 + residual**2)  # Cauchy's
    information = (design.T * weight) @ design + prior
    gradient = design.T @ (weight * residual) - prior @ plane
    return np.asarray(plane + np.linalg.lstsq(information, gradient, rcond=1e-12)[0])


def _cell_means(cell: IntArray, across: Array, height: Array) -> tuple[Array, Array]:
    """Return the mean of rows (N, 3) and heights (N,) in each cell that has any."""
    _, cell = np.unique(cell, return_inverse=True)
    count = np.bincount(cell).astype(float)
    columns = [np.bincount(cell, column) / count for column in across.T]
    return np.column_stack(columns).reshape(-1, 3), np.bincount(cell, height) / count
