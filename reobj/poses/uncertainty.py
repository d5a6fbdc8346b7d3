"""How well the observations of a reconstruction determine where its cameras are.

A model with little parallax fits its observations in many ways, and the mapper returns one of them.
The covariance of the adjustment tells: points are marginalised out, and the similarity that no
observation determines is fixed by the mean of the camera centres, their size and orientation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from reobj.poses.bundle import ModelArrays
from reobj.types import Array, IntArray

CAUCHY_SIGMAS = 2.0  # residual from where an observation counts less, in sigmas (chosen)
MIN_DEPTH = 0.01  # median depths; points at a centre would be infinitely sure (chosen)
MIN_NOISE_PX = 0.1  # of an observation, pixels of the resized image (chosen: SIFT's best)


def relative_sigmas(arrays: ModelArrays, free_camera: bool) -> tuple[float, float]:
    """Estimate sigmas of cameras and focal length.

    Args:
        arrays: of an adjusted model. free_camera: its intrinsics were adjusted too.
    Returns:
        the largest of a camera centre over the extent of the camera's path; that of the log of the
        focal length, 0 if it is not free. Infinite if the observations do not determine the model.
    Ref: Triggs et al., Bundle Adjustment - A Modern Synthesis, 1999, sections 6 and 9.
    """
    if len(arrays.ids) < 3 or not len(arrays.image):
        return np.inf, np.inf
    pose, by_pose, by_point, by_camera = _weighted_jacobians(arrays)
    by_camera = by_camera.reshape(-1, by_camera.shape[2])[:, : None if free_camera else 0]
    poses = 6 * len(pose)
    J = sparse.hstack(
        [_spread(by_pose, arrays.image, len(pose)), sparse.csr_matrix(by_camera)]
    ).tocsr()
    V = np.zeros((len(arrays.xyz), 3, 3))
    np.add.at(V, arrays.point, np.swapaxes(by_point, 1, 2) @ by_point)
    V += 1e-9 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(V))  # V^-1 = root' root
    at = np.arange(len(root) + 1)
    W = J.T @ _spread(by_point, arrays.point, len(root)) @ sparse.bsr_matrix((root, at[:-1], at)).T
    normal = (J.T @ J - W @ W.T).toarray()
    centre, similarity = _similarity(pose, len(normal))
    normal += np.median(np.diag(normal)) * similarity @ similarity.T
    values, vectors = np.linalg.eigh(normal)
    if values[0] <= 1e-12 * values[-1]:
        return np.inf, np.inf
    variance = (vectors**2 / values).sum(1)
    of_centre = variance[:poses].reshape(-1, 6)[:, :3].sum(1)
    extent = np.linalg.norm(np.ptp(centre, axis=0))
    focal_sigma = float(np.sqrt(variance[poses])) if free_camera else 0.0
    return float(np.sqrt(of_centre.max()) / max(extent, 1e-12)), focal_sigma


def _spread(blocks: Array, column: IntArray, count: int) -> Any:
    """Put blocks (M, 2, k) below each other, each at one of `count` block columns, sparse."""
    at, shape = np.arange(len(blocks) + 1), (2 * len(blocks), blocks.shape[2] * count)
    return sparse.bsr_matrix((blocks, column, at), shape)


def _weighted_jacobians(arrays: ModelArrays) -> tuple[Array, Array, Array, Array]:
    """Differentiate the observations, in sigmas of their noise.

    Returns:
        pose: (R, 3, 4) cam_from_world; the median depth is the unit of length. Derivatives by
        centre and turn of the camera (M, 2, 6), by the point (M, 2, 3), by the log of the focal
        length, the principal point and two terms of radial distortion (M, 2, 5).
    """
    image, focal, pose = arrays.image, arrays.focal, arrays.cam_from_world.copy()
    xy, in_cam = focal * arrays.ideal, arrays.in_cam()
    unit = np.median(in_cam[:, 2])
    pose[:, :, 3] /= unit
    X, Y, Z = (in_cam / unit).T
    in_front = Z > MIN_DEPTH
    Z = np.where(in_front, Z, 1)
    x, y, none = X / Z, Y / Z, np.zeros(len(X))
    residual = xy - focal * np.column_stack([x, y])
    noise = max(1.4826 * float(np.median(np.abs(residual))), MIN_NOISE_PX)
    weight = 1 / (1 + (residual**2).sum(1) / (CAUCHY_SIGMAS * noise) ** 2)
    scale = np.where(in_front, np.sqrt(weight) / noise, 0)
    shift = focal * np.array([[1 / Z, none, -x / Z], [none, 1 / Z, -y / Z]])  # (2, 3, m)
    shift = np.moveaxis(shift, 2, 0) * scale[:, None, None]
    turn = focal * np.array([[-x * y, 1 + x * x, -y], [-1 - y * y, x * y, x]])
    turn = np.moveaxis(turn, 2, 0) * scale[:, None, None]
    by_point = shift @ pose[image][:, :, :3]
    one, r2 = np.ones(len(x)), x * x + y * y
    by_camera = focal * np.array(
        [[x, one, none, x * r2, x * r2 * r2], [y, none, one, y * r2, y * r2 * r2]]
    )
    by_camera = np.moveaxis(by_camera, 2, 0) * scale[:, None, None]
    return pose, np.concatenate([-by_point, turn], 2), by_point, by_camera


def _similarity(pose: Array, size: int) -> tuple[Array, Array]:
    """Return the centres (R, 3) and an orthonormal basis (size, 7) of what moves them alone."""
    rotation = pose[:, :, :3]
    centre = -np.einsum("rji,rj->ri", rotation, pose[:, :, 3])
    x, y, z = (centre - centre.mean(0)).T
    none, basis = np.zeros(len(centre)), np.zeros((len(centre), 6, 7))
    basis[:, :3, :3] = np.eye(3)
    basis[:, :3, 3:6] = np.moveaxis(np.array([[none, z, -y], [-z, none, x], [y, -x, none]]), 2, 0)
    basis[:, :3, 6] = np.column_stack([x, y, z])
    found = np.zeros((size, 7))
    found[: basis.size // 7] = basis.reshape(-1, 7)
    return centre, np.linalg.qr(found)[0]
