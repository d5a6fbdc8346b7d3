"""Find where the camera of a reconstruction zoomed.

One focal length for all images is assumed by the mapper: images of a zoomed stretch are put nearer
to what they show, and neither the reprojection error nor the number of shared points tells. What
tells is each image against its neighbours on one side alone: points triangulated by these give its
pose and its focal length.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from reobj.poses.bundle import MIN_RAY_SPREAD, ModelArrays
from reobj.types import Array, IntArray

WINDOW = 10  # images on one side whose points are used (chosen: a zoom bends those further off)
MIN_POINTS = 20  # of such points seen in the image (chosen; two determine a focal length and pose)
# Log of the focal length's change that is a zoom (measured, mean of both sides: zoomed by 1.25 to
# 1.5 .15-.30, right models below .03; one side alone .34-.39, right models up to .12)
MIN_ZOOM, MIN_ZOOM_ONE_SIDE = 0.12, 0.24
MIN_SIGMAS = 5.0  # of that change over its sigma (chosen)
TOLD_BY = 2  # images on each side of a gap that are looked at (chosen)
UNLIKE = 10.0  # log of a change that nothing measures: no two sides of it are alike
RESECTION_STEPS = 8  # Gauss-Newton steps (chosen: focal lengths of a third more need 5)


def constant_focal(models: list[ModelArrays]) -> tuple[IntArray, list[tuple[int, int, float]]]:
    """Choose the images that were taken at one focal length.

    Args:
        models: ids of images ascend in time.
    Returns:
        ids of the images of the other focal lengths, or of one that is not known to be the same;
        of each change the ids of the images before and after it and the ratio of their focal
        lengths.
    """
    changes = sorted(change for arrays in models for change in _changes(arrays))
    changes = [c for c in changes if not any(_beside(c, other) for other in changes)]
    ids = np.array(sorted({int(i) for arrays in models for i in arrays.ids}), np.int64)
    starts = np.searchsorted(ids, [after for _, after, _ in changes])
    log = np.zeros(len(ids))
    for k, (start, (_, _, ratio)) in enumerate(zip(starts, changes, strict=True)):
        told = not k or start - starts[k - 1] >= WINDOW  # else each bends the other's images
        log[start:] += np.log(ratio) if told else UNLIKE
    alike = np.abs(log[:, None] - log) < MIN_ZOOM  # (R, R)
    return ids[~alike[alike.sum(1).argmax()]] if len(ids) else ids, changes


def _beside(one: tuple[int, int, float], other: tuple[int, int, float]) -> bool:
    """True for the lesser of two changes of the same direction beside each other.

    Images next to a change are bent by it.
    """
    adjacent = one is not other and (one[0] == other[1] or one[1] == other[0])
    log, rival = np.log(one[2]), np.log(other[2])
    return bool(adjacent and log * rival > 0 and abs(log) < abs(rival))


def _changes(arrays: ModelArrays) -> list[tuple[int, int, float]]:
    """List the changes of the focal length between images that follow each other.

    On both sides of each gap the next images are seen from the other side. Where one side tells
    nothing, more is asked of the other: it is biased by the noise of its depths.
    """
    count, found = len(arrays.ids), list[tuple[int, int, float]]()
    ray = np.insert(arrays.ideal, 2, 1, 1)[:, None] @ arrays.cam_from_world[arrays.image][:, :, :3]
    ray = ray[:, 0] / np.linalg.norm(ray[:, 0], axis=1, keepdims=True)  # (M, 3) in world
    across = np.eye(3) - ray[:, :, None] * ray[:, None]  # (M, 3, 3)
    start = (across @ arrays.centre[arrays.image][:, :, None])[:, :, 0]
    terms = np.hstack([across.reshape(-1, 9), start, ray, np.ones((len(ray), 1))])  # (M, 16)
    for k in range(1, count):
        before, after = range(max(0, k - WINDOW), k), range(k, min(k + WINDOW, count))
        sides = list[list[list[float]]]()
        for side, seen, sign in ((before, after[:TOLD_BY], 1), (after, before[-TOLD_BY:], -1)):
            points = _triangulate(arrays, terms, side)
            values = np.array([_log_focal(arrays, image, points) for image in seen]) * [sign, 1]
            sides.append(values[np.isfinite(values[:, 0])].tolist())
        if any(sides):
            log, sigma = np.median(list(itertools.chain(*sides)), axis=0)
            least = MIN_ZOOM if all(sides) else MIN_ZOOM_ONE_SIDE
            if abs(log) > max(least, MIN_SIGMAS * sigma):
                ids = int(arrays.ids[k - 1]), int(arrays.ids[k])
                found.append((*ids, float(np.exp(log))))
    return found


def _triangulate(arrays: ModelArrays, terms: Array, side: range) -> Array:
    """Triangulate points from some images that follow each other: the nearest to all their rays.

    Args:
        terms: (M, 16) of each observation with unit ray u from centre c, in world: I - u u' (9),
            (I - u u') c, u, 1.
    Returns:
        (N, 3) points, NaN where the rays do not tell the depth.
    """
    first, last = np.searchsorted(arrays.image, (side.start, side.stop))
    at, row = np.unique(arrays.point[first:last], return_inverse=True)
    entries = (np.ones(len(row)), (row, np.arange(len(row))))
    sums = sparse.csr_matrix(entries, (len(at), len(row))) @ terms[first:last]
    n = sums[:, 15]
    told = n - (sums[:, 12:15] ** 2).sum(1) / np.maximum(n, 1) >= MIN_RAY_SPREAD
    xyz = np.full((len(arrays.xyz), 3), np.nan)
    A, b = sums[told, :9].reshape(-1, 3, 3), sums[told, 9:12, None]
    xyz[at[told]] = np.linalg.solve(A, b)[:, :, 0]
    return xyz


def _log_focal(arrays: ModelArrays, image: int, points: Array) -> tuple[float, float]:
    """Estimate an image's focal length from points (N, 3), NaN where there are none.

    Returns:
        log of it over that of the model, and its sigma; NaN with too few points.
    """
    first, last = np.searchsorted(arrays.image, (image, image + 1))
    pose, ideal = arrays.cam_from_world[image], arrays.ideal[first:last]
    in_cam = points[arrays.point[first:last]] @ pose[:, :3].T + pose[:, 3]
    front = in_cam[:, 2] > 0  # no NaN
    if front.sum() < MIN_POINTS:
        return np.nan, np.nan
    return _resect(in_cam[front], ideal[front] * arrays.focal, arrays.focal)


def _resect(in_cam: Array, xy: Array, focal: float) -> tuple[float, float]:
    """Fit a small motion and the focal length of a camera to points, with a Cauchy loss of 1 px.

    Args:
        in_cam: (n, 3) points in the camera's frame, nearly. xy: (n, 2) pixels from the centre.
    Returns:
        log of the focal length over `focal`, and its sigma; NaN if the fit fails.
    """
    turn, shift, log = np.eye(3), np.zeros(3), 0.0
    for _ in range(RESECTION_STEPS):
        moved = in_cam @ turn.T + shift
        if (moved[:, 2] <= 0).any():
            return np.nan, np.nan
        f, none = focal * np.exp(log), np.zeros(len(moved))
        inverse = 1 / moved[:, 2]
        x, y = moved[:, 0] * inverse, moved[:, 1] * inverse
        residual = xy - f * np.column_stack([x, y])  # (n, 2)
        weight = 1 / (1 + (residual**2).sum(1))
        J = f * np.array([  # (2, 7, n) by turn, shift and log focal length
            [-x * y, 1 + x * x, -y, inverse, none, -x * inverse, x],
            [-1 - y * y, x * y, x, none, inverse, -y * inverse, y],
        ])  # fmt: skip
        normal = np.einsum("ain,ajn,n->ij", J, J, weight)
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e14:
            return np.nan, np.nan
        step = np.linalg.solve(normal, np.einsum("ain,na,n->i", J, residual, weight))
        rotation = Rotation.from_rotvec(step[:3]).as_matrix()
        turn, shift, log = rotation @ turn, rotation @ shift + step[3:6], log + step[6]
        log = float(np.clip(log, -1, 1))
    variance = np.average((residual**2).sum(1), weights=weight) / 2
    return log, float(np.sqrt(np.linalg.inv(normal)[6, 6] * variance))
