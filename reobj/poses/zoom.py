"""Find where the camera of a reconstruction zoomed.

One focal length for all images is assumed by the mapper: images of a zoomed stretch are put nearer
to what they show, and neither the reprojection error nor the number of shared points tells. What
tells is each image against its neighbours on one side alone: points triangulated by these give its
pose and its focal length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.poses.uncertainty import MIN_RAY_SPREAD
from reobj.types import Array, IntArray

WINDOW = 10  # images on one side whose points are used (chosen: a zoom bends those further off)
MIN_POINTS = 20  # of such points seen in the image (chosen; two determine a focal length and pose)
# Log of the focal length's change that is a zoom (measured, mean of both sides: zoomed by 1.25 to
# 1.5 .15-.30, right models below .03; one side alone up to .12)
MIN_ZOOM = 0.12
MIN_SIGMAS = 5.0  # of that change over its sigma (chosen)
TOLD_BY = 2  # images on each side of a gap that are looked at, and must tell together (chosen)
RESECTION_STEPS = 8  # Gauss-Newton steps (chosen: focal lengths of a third more need 5)


def constant_focal(models: list[Any]) -> tuple[IntArray, list[tuple[int, int, float]]]:
    """Choose the images that were taken at one focal length.

    Args:
        models: `pycolmap.Reconstruction`s; ids of images ascend in time.
    Returns:
        ids of the images of the other focal lengths; and of each change the ids of the images
        before and after it and the ratio of their focal lengths.
    """
    changes = sorted(change for model in models for change in _changes(model))
    changes = [c for c in changes if not any(_beside(c, other) for other in changes)]
    ids = np.array(sorted({i for model in models for i in model.reg_image_ids()}), np.int64)
    log = np.zeros(len(ids))
    for _, after, ratio in changes:
        log[ids >= after] += np.log(ratio)
    alike = np.abs(log[:, None] - log) < MIN_ZOOM  # (R, R)
    return ids[~alike[alike.sum(1).argmax()]] if len(ids) else ids, changes


def _beside(one: tuple[int, int, float], other: tuple[int, int, float]) -> bool:
    """True for the lesser of two changes of the same direction beside each other.

    Images next to a change are bent by it.
    """
    adjacent = one is not other and (one[0] == other[1] or one[1] == other[0])
    log, rival = np.log(one[2]), np.log(other[2])
    return bool(adjacent and log * rival > 0 and abs(log) < abs(rival))


def _changes(model: Any) -> list[tuple[int, int, float]]:
    """List the changes of the focal length between images that follow each other.

    On both sides of each gap the next images are seen from the other side; at least two must tell.
    """
    views, found = _read_rays(model), []
    focal = model.camera(1).mean_focal_length()
    for k in range(1, len(views)):
        before, after = views[max(0, k - WINDOW) : k], views[k : k + WINDOW]
        ahead = [_log_focal(image, before, focal) for image in after[:TOLD_BY]]
        back = [_log_focal(image, after, focal) for image in before[: -1 - TOLD_BY : -1]]
        told = np.array(ahead + [(-log, sigma) for log, sigma in back])
        told = told[np.isfinite(told[:, 0])]
        if len(told) >= TOLD_BY:
            log, sigma = np.median(told, axis=0)
            if abs(log) > max(MIN_ZOOM, MIN_SIGMAS * sigma):
                found.append((before[-1].image_id, after[0].image_id, float(np.exp(log))))
    return found


@dataclass(frozen=True, slots=True)
class _Rays:
    """An image's rays to points: point_ids (n,) ascending, ideal (n, 2) at depth 1."""

    image_id: int
    cam_from_world: Array
    point_ids: IntArray
    ideal: Array


def _read_rays(model: Any) -> list[_Rays]:
    """Read the images of a model in the order of time."""
    rays = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        point_ids, rows = np.unique(
            np.array([p.point3D_id for p in seen], np.int64), return_index=True
        )
        xy = np.array([p.xy for p in seen], np.float64).reshape(-1, 2)[rows]
        ideal = np.reshape(model.camera(1).cam_from_img(xy), (-1, 2))
        rays.append(_Rays(image_id, image.cam_from_world().matrix(), point_ids, ideal))
    return rays


def _log_focal(image: _Rays, side: list[_Rays], focal: float) -> tuple[float, float]:
    """Estimate an image's focal length from points that its neighbours on one side triangulate.

    Returns:
        log of it over `focal`, and its sigma; NaN with too few points.
    """
    point_ids, points = _triangulate(side, image.point_ids)
    rows = np.searchsorted(image.point_ids, point_ids)
    in_cam = points @ image.cam_from_world[:, :3].T + image.cam_from_world[:, 3]
    front = in_cam[:, 2] > 0
    if front.sum() < MIN_POINTS:
        return np.nan, np.nan
    return _resect(in_cam[front], image.ideal[rows[front]] * focal, focal)


def _triangulate(side: list[_Rays], wanted: IntArray) -> tuple[IntArray, Array]:
    """Triangulate the wanted points from some images: ids (n,) ascending, xyz (n, 3).

    The point nearest to all its rays in space; points whose depth the rays do not tell are left
    out.
    """
    ids, direction, origin = [], [], []
    for rays in side:
        mine = np.isin(rays.point_ids, wanted)
        rotation, shift = rays.cam_from_world[:, :3], rays.cam_from_world[:, 3]
        ids.append(rays.point_ids[mine])
        direction.append(np.insert(rays.ideal[mine], 2, 1, 1) @ rotation)
        origin.append(np.broadcast_to(-shift @ rotation, direction[-1].shape))
    unit, start = np.concatenate(direction), np.concatenate(origin)  # (m, 3)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    point_ids, at = np.unique(np.concatenate(ids), return_inverse=True)
    n = np.bincount(at, minlength=len(point_ids))
    across = np.eye(3) - unit[:, :, None] * unit[:, None]  # (m, 3, 3)
    A, b, total = (np.zeros((len(n), *shape)) for shape in ((3, 3), (3,), (3,)))
    np.add.at(A, at, across)
    np.add.at(b, at, (across @ start[:, :, None])[:, :, 0])
    np.add.at(total, at, unit)
    told = n - (total**2).sum(1) / np.maximum(n, 1) >= MIN_RAY_SPREAD
    return point_ids[told], np.linalg.solve(A[told], b[told][:, :, None])[:, :, 0]


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
