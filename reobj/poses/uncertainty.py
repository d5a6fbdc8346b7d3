"""How well the observations of a reconstruction determine where its cameras are.

A model with little parallax fits its observations in many ways, and the mapper returns one of them.
The covariance of the adjustment tells: points are marginalised out, and the similarity that no
observation determines is fixed by the mean of the camera centres, their size and orientation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from reobj.types import Array, IntArray

# n - |sum of u|^2 / n of the unit rays u to a point that tell its depth: 1 - cos(angle) for two
MIN_RAY_SPREAD = 1 - np.cos(np.radians(1.5))  # (COLMAP's min_tri_angle)
CAUCHY_SIGMAS = 2.0  # residual from where an observation counts less, in sigmas (chosen)
MIN_NOISE_PX = 0.1  # of an observation, pixels of the resized image (chosen: SIFT's best)


def relative_centre_sigma(model: Any, free_focal: bool) -> float:
    """Estimate the largest sigma of a camera centre over the extent of the camera's path.

    Args:
        model: a `pycolmap.Reconstruction`, adjusted. free_focal: its focal length was adjusted too.
    Returns:
        infinite if the observations do not determine the model.
    Ref: Triggs et al., Bundle Adjustment - A Modern Synthesis, 1999, sections 6 and 9.
    """
    if model.num_reg_images() < 3 or model.num_points3D() == 0:
        return float("inf")
    image, point, pose, J, J_point, J_focal = _weighted_jacobians(model)
    count, points = len(pose), int(point.max()) + 1
    size = 6 * count + free_focal
    V = np.zeros((points, 3, 3))
    np.add.at(V, point, np.swapaxes(J_point, 1, 2) @ J_point)
    V += 1e-9 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(V))  # V^-1 = root' root
    mixed = np.swapaxes(J, 1, 2) @ J_point @ np.swapaxes(root[point], 1, 2)  # (m, 6, 3)
    rows = np.broadcast_to(6 * image[:, None, None] + np.arange(6)[:, None], mixed.shape)
    columns = np.broadcast_to(3 * point[:, None, None] + np.arange(3), mixed.shape)
    entries, at = mixed.ravel(), (rows.ravel(), columns.ravel())
    W = sparse.csr_matrix((entries, at), (size, 3 * points))
    normal, own = np.zeros((size, size)), np.zeros((count, 6, 6))
    np.add.at(own, image, np.swapaxes(J, 1, 2) @ J)
    for k, block in enumerate(own):
        normal[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
    if free_focal:
        of_point, of_pose = np.zeros((points, 3)), np.zeros((count, 6))
        np.add.at(of_point, point, np.einsum("mai,ma->mi", J_point, J_focal))
        np.add.at(of_pose, image, np.einsum("mai,ma->mi", J, J_focal))
        of_point = (root @ of_point[:, :, None]).reshape(1, -1)
        last = np.full(3 * points, size - 1), np.arange(3 * points)
        W = W + sparse.csr_matrix((of_point[0], last), W.shape)
        normal[-1, :-1] = normal[:-1, -1] = of_pose.ravel()
        normal[-1, -1] = (J_focal**2).sum()
    normal -= np.asarray((W @ W.T).todense())
    centre, similarity = _similarity(pose, size)
    normal += np.median(np.diag(normal)) * similarity @ similarity.T
    values, vectors = np.linalg.eigh(normal)
    if values[0] <= 1e-12 * values[-1]:
        return float("inf")
    variance = ((vectors**2 / values).sum(1)[: 6 * count]).reshape(count, 6)[:, :3].sum(1)
    extent = np.linalg.norm(np.ptp(centre, axis=0))
    return float(np.sqrt(variance.max()) / max(extent, 1e-12))


def _weighted_jacobians(model: Any) -> tuple[IntArray, IntArray, Array, Array, Array, Array]:
    """Differentiate the observations, in sigmas of their noise.

    Returns:
        image, point: (m,) rows of each observation. pose: (R, 3, 4) cam_from_world; the median
        depth is the unit of length. Derivatives by centre and turn of the camera (m, 2, 6), by the
        point (m, 2, 3), by the log of the focal length (m, 2).
    """
    camera, ids = model.camera(1), sorted(model.reg_image_ids())
    seen = [(k, p) for k, i in enumerate(ids) for p in model.image(i).get_observation_points2D()]
    image = np.array([k for k, _ in seen])
    point_ids, point = np.unique([p.point3D_id for _, p in seen], return_inverse=True)
    xyz = np.array([model.point3D(int(i)).xyz for i in point_ids])
    pose = np.array([model.image(i).cam_from_world().matrix() for i in ids])
    focal = camera.mean_focal_length()
    xy = focal * np.reshape(camera.cam_from_img(np.array([p.xy for _, p in seen])), (-1, 2))
    in_cam = np.einsum("mij,mj->mi", pose[image][:, :, :3], xyz[point]) + pose[image][:, :, 3]
    unit = np.median(in_cam[:, 2])
    pose[:, :, 3] /= unit
    X, Y, Z = (in_cam / unit).T
    x, y, none = X / Z, Y / Z, np.zeros(len(X))
    residual = xy - focal * np.column_stack([x, y])
    noise = max(1.4826 * float(np.median(np.abs(residual))), MIN_NOISE_PX)
    weight = 1 / (1 + (residual**2).sum(1) / (CAUCHY_SIGMAS * noise) ** 2)
    scale = np.sqrt(weight) / noise
    shift = focal * np.array([[1 / Z, none, -x / Z], [none, 1 / Z, -y / Z]])  # (2, 3, m)
    shift = np.moveaxis(shift, 2, 0) * scale[:, None, None]
    turn = focal * np.array([[-x * y, 1 + x * x, -y], [-1 - y * y, x * y, x]])
    turn = np.moveaxis(turn, 2, 0) * scale[:, None, None]
    by_point = shift @ pose[image][:, :, :3]
    by_focal = focal * np.column_stack([x, y]) * scale[:, None]
    return image, point, pose, np.concatenate([-by_point, turn], 2), by_point, by_focal


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
