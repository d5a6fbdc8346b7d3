"""A COLMAP model as arrays, its last bundle adjustment, and the covariance of its cameras.

A model with little parallax fits its observations in many ways, and a mapper returns one of them.
The covariance shows this: points are marginalised out, and the gauge (a similarity) is fixed by the
mean, size and orientation of the camera centres.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from reobj.cameras import import_pycolmap
from reobj.types import Array, BoolArray, IntArray

MIN_TRI_ANGLE_DEG = 1.5  # between rays that triangulate a point (COLMAP's min_tri_angle)
INLIER_PX = 4.0  # largest error of an inlier, resized images (COLMAP's filter_max_reproj_error)
FOCAL_RANGE = (0.4, 2.0)  # plausible focal length over the longer side: 103 to 28 deg wide


def triangulates(count: Array, squared_sum: Array) -> BoolArray:
    """True (N,) where the rays to a point spread enough to triangulate it.

    Of n unit rays u, n - |sum of u|^2 / n is 1 - cos(angle) for two.

    Args:
        count: (N,) n. squared_sum: (N,) |sum of u|^2.
    """
    spread = count - squared_sum / np.maximum(count, 1)
    return np.asarray(spread >= 1 - np.cos(np.radians(MIN_TRI_ANGLE_DEG)), bool)


def unit_rows(vectors: Array) -> Array:
    """Return vectors (N, 3) at length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def skew(x: Array, y: Array, z: Array) -> Array:
    """Return the matrices (N, 3, 3) of the cross products with vectors (N,), (N,), (N,)."""
    zero = np.zeros(len(x))
    return np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), 2, 0)


@dataclass(frozen=True, slots=True)
class ModelArrays:
    """The images of one camera, their poses and observations: R images, N points, M observations.

    Attributes:
        camera: `pycolmap.Camera` of all images.
        ids: (R,) of the images, ascending. cam_from_world: (R, 3, 4). centre: (R, 3).
        xyz: (N, 3) points, by ascending id.
        image, point: (M,) rows of each observation, by image. keypoint: (M,) its row in the image.
        ideal: (M, 2) at depth 1, without distortion.
    """

    camera: Any
    ids: IntArray
    cam_from_world: Array
    centre: Array
    xyz: Array
    image: IntArray
    point: IntArray
    keypoint: IntArray
    ideal: Array

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(self.camera.mean_focal_length())

    @property
    def focal_over_size(self) -> float:
        """Focal length over the longer side."""
        return self.focal / float(max(self.camera.width, self.camera.height))

    def covisibility(self) -> Any:
        """Return the observations as a sparse (R, N), 1 where an image observes a point."""
        observed = sparse.csr_matrix(
            (np.ones(len(self.image)), (self.image, self.point)), (len(self.ids), len(self.xyz))
        )
        observed.data[:] = 1  # a point may be observed twice in an image
        return observed

    def triangulated_by(self, rows: IntArray) -> BoolArray:
        """Mark the points (N,) that some images alone triangulate, by `triangulates`."""
        mine = np.isin(self.image, rows)
        image = self.image[mine]
        count = len(self.xyz)
        ray = unit_rows(self.xyz[self.point[mine]] - self.centre[image])  # (m, 3)
        entries = (np.ones(len(image)), (self.point[mine], np.arange(len(image))))
        sums = sparse.csr_matrix(entries, (count, len(image))) @ np.insert(ray, 3, 1, 1)  # (N, 4)
        return triangulates(sums[:, 3], (sums[:, :3] ** 2).sum(1))

    def point_of_keypoints(self, keypoints: Mapping[int, Array]) -> dict[int, IntArray]:
        """Return the points (n,) of all keypoints (n, 2) by image id, -1: none."""
        start = np.searchsorted(self.image, np.arange(len(self.ids) + 1))
        point_of: dict[int, IntArray] = {}
        for row, number in enumerate(self.ids.tolist()):
            mine = slice(start[row], start[row + 1])
            point_of[number] = np.full(len(keypoints[number]), -1)
            point_of[number][self.keypoint[mine]] = self.point[mine]
        return point_of

    def points_in_cam(self) -> Array:
        """Return the observed points (M, 3) in the frames of their images."""
        pose = self.cam_from_world[self.image]
        xyz = self.xyz[self.point]
        xyz_in_cam: Array = np.einsum("mij,mj->mi", pose[:, :, :3], xyz) + pose[:, :, 3]
        return xyz_in_cam


def read_arrays(model: Any) -> ModelArrays:
    """Copy a `pycolmap.Reconstruction` with one camera into arrays."""
    ids = np.array(sorted(model.reg_image_ids()), np.int64)
    point_ids = np.array(sorted(model.point3D_ids()), np.int64)
    camera = copy.copy(model.camera(1))
    images = [model.image(i) for i in ids.tolist()]
    observed = [image.get_observation_points2D() for image in images]
    observed_ids = np.array([p.point3D_id for points in observed for p in points], np.int64)
    xy = np.array([p.xy for points in observed for p in points], np.float64)
    poses = [image.cam_from_world().matrix() for image in images]
    cam_from_world = np.array(poses, np.float64).reshape(-1, 3, 4)
    return ModelArrays(
        camera,
        ids,
        cam_from_world,
        -np.einsum("rji,rj->ri", cam_from_world[:, :, :3], cam_from_world[:, :, 3]),
        np.array([model.point3D(i).xyz for i in point_ids.tolist()], np.float64).reshape(-1, 3),
        np.repeat(np.arange(len(ids)), [len(points) for points in observed]),
        np.searchsorted(point_ids, observed_ids),
        np.array([k for image in images for k in image.get_observation_point2D_idxs()], np.int64),
        np.reshape(camera.cam_from_img(xy.reshape(-1, 2)), (-1, 2)),
    )


def submodel(model: Any, image_ids: set[int]) -> Any:
    """Return a copy of a `pycolmap.Reconstruction` with only some of its images."""
    made = import_pycolmap().Reconstruction(model)
    for image_id in sorted(made.reg_image_ids()):
        if image_id not in image_ids:
            made.deregister_frame(made.image(image_id).frame_id)
    return made


# ---- Bundle adjustment ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Adjusted:
    """A model after the last adjustment.

    Attributes:
        arrays: of the model. calibrated: its intrinsics were adjusted too. centre_sigma: largest of
            a camera centre, over the extent of the trajectory.
    """

    model: Any
    arrays: ModelArrays
    calibrated: bool
    centre_sigma: float


# Largest sigma of the log of an adjusted focal length (measured on components of 6 to 136 images,
# median of the errors: up to .005 .9 %, to .02 2 %, to .03 4 %, above more; kept at the estimate
# from matches 4 %)
MAX_FOCAL_SIGMA = 0.03
# Log of a ratio up to which two focal lengths are the same (measured where the principal point
# drifts off, with and without it freed: right .0003, half of the true focal length .12 to .2)
SAME_FOCAL = 0.05


MAX_DENSE = 500  # images whose covariance is computed: a dense (6 R)^2 matrix, .1 GB


def adjusted(model: Any, calibrate: bool) -> Adjusted:
    """Adjust a model, with its intrinsics if the observations determine them.

    Of more than MAX_DENSE images, whose windows were measured each, the covariance is not computed;
    their centre_sigma is 0.

    Args:
        model: changed where its intrinsics stay; a copy is returned where they do not.
        calibrate: free the focal length, two distortion terms and, unless it drifts off, the
            principal point.
    """
    if calibrate:
        free = import_pycolmap().Reconstruction(model)
        is_determined = _calibrate(free)
        arrays = read_arrays(free)
        centre_sigma, focal_sigma = relative_sigmas(arrays, True)
        low, high = FOCAL_RANGE
        is_plausible = low <= arrays.focal_over_size <= high
        if is_determined and focal_sigma <= MAX_FOCAL_SIGMA and is_plausible:
            return Adjusted(free, arrays, True, centre_sigma)
    refine(model)
    arrays = read_arrays(model)
    return Adjusted(model, arrays, False, relative_sigmas(arrays, False)[0])


def refine(model: Any) -> None:
    """Adjust the poses and points of a model, with a robust loss."""
    _bundle_adjust(model, False, False)


def _calibrate(model: Any) -> bool:
    """Adjust a model with its intrinsics.

    Returns:
        False where the focal length depends on the principal point: both are undetermined.
    """
    camera = model.camera(1)
    size = np.array([camera.width, camera.height])
    focal = camera.mean_focal_length()
    has_radial_term = camera.model.name in ("SIMPLE_RADIAL", "RADIAL")
    start = [focal, *size / 2, camera.params[3] if has_radial_term else 0, 0]
    camera.model = import_pycolmap().CameraModelId.RADIAL
    camera.params = start
    _bundle_adjust(model, True, True)
    free = camera.params[0]
    if (np.abs(camera.params[1:3] / size - 0.5) <= 0.05).all():  # else it drifts off
        return True
    camera.params = start
    _bundle_adjust(model, True, False)
    return bool(abs(np.log(camera.params[0] / free)) < SAME_FOCAL)


def _bundle_adjust(model: Any, calibrate: bool, free_centre: bool) -> None:
    """Adjust all images and points.

    The gauge is left free: no residual depends on it. COLMAP fixes it by two cameras, which is
    ill-conditioned if they coincide.
    """
    pc = import_pycolmap()
    options = pc.BundleAdjustmentOptions()
    config = pc.BundleAdjustmentConfig()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = calibrate
    options.refine_principal_point = free_centre
    options.ceres.loss_function_type = pc.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = 0.5  # px of the resized image
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1  # reproducible
    for i in model.reg_image_ids():
        config.add_image(i)
    pc.create_default_bundle_adjuster(options, config, model).solve()


# ---- Covariance ----------------------------------------------------------------------------------


def relative_sigmas(arrays: ModelArrays, free_camera: bool) -> tuple[float, float]:
    """Estimate sigmas of camera centres and focal length.

    Args:
        arrays: of an adjusted model. free_camera: its intrinsics were adjusted too.
    Returns:
        the largest of a camera centre over the extent of the trajectory; that of the log of the
        focal length, 0 if it is not free. Infinite if the observations do not determine the model;
        0 for more than MAX_DENSE images.
    Ref: Triggs et al., Bundle Adjustment - A Modern Synthesis, 1999, sections 6 and 9.
    """
    if len(arrays.ids) < 3 or not len(arrays.image):
        return np.inf, np.inf
    if len(arrays.ids) > MAX_DENSE:
        return 0.0, 0.0
    pose, by_pose, by_point, by_camera = _weighted_jacobians(arrays)
    by_camera = by_camera.reshape(-1, by_camera.shape[2])[:, : None if free_camera else 0]
    poses = 6 * len(pose)
    J = sparse.hstack(
        [_block_columns(by_pose, arrays.image, len(pose)), sparse.csr_matrix(by_camera)]
    ).tocsr()
    V = np.zeros((len(arrays.xyz), 3, 3))
    np.add.at(V, arrays.point, np.swapaxes(by_point, 1, 2) @ by_point)
    V += 1e-9 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(V))  # V^-1 = root' root
    rows = np.arange(len(root) + 1)
    roots = sparse.bsr_matrix((root, rows[:-1], rows))
    W = J.T @ _block_columns(by_point, arrays.point, len(root)) @ roots.T
    normal = (J.T @ J - W @ W.T).toarray()
    centre, gauge = _gauge(pose, len(normal))
    normal += np.median(np.diag(normal)) * gauge @ gauge.T
    values, vectors = np.linalg.eigh(normal)
    if values[0] <= 1e-12 * values[-1]:
        return np.inf, np.inf
    variance = (vectors**2 / values).sum(1)
    centre_variance = variance[:poses].reshape(-1, 6)[:, :3].sum(1)
    extent = np.linalg.norm(np.ptp(centre, axis=0))
    focal_sigma = float(np.sqrt(variance[poses])) if free_camera else 0.0
    return float(np.sqrt(centre_variance.max()) / max(extent, 1e-12)), focal_sigma


def _block_columns(blocks: Array, column: IntArray, count: int) -> Any:
    """Stack blocks (M, 2, k), each at one of `count` block columns, as a sparse matrix."""
    rows = np.arange(len(blocks) + 1)
    shape = (2 * len(blocks), blocks.shape[2] * count)
    return sparse.bsr_matrix((blocks, column, rows), shape)


def _weighted_jacobians(arrays: ModelArrays) -> tuple[Array, Array, Array, Array]:
    """Differentiate the observations, in sigmas of their noise.

    Returns:
        pose: (R, 3, 4) cam_from_world; the median depth is the unit of length. Derivatives by
        centre and rotation of the camera (M, 2, 6), by the point (M, 2, 3), by the log of the focal
        length, the principal point and two terms of radial distortion (M, 2, 5).
    """
    image = arrays.image
    focal = arrays.focal
    pose = arrays.cam_from_world.copy()
    xy = focal * arrays.ideal
    xyz_in_cam = arrays.points_in_cam()
    unit = np.median(xyz_in_cam[:, 2])
    pose[:, :, 3] /= unit
    X, Y, Z = (xyz_in_cam / unit).T
    in_front = Z > 0.01  # a point at a camera centre would have no uncertainty
    Z = np.where(in_front, Z, 1)
    x = X / Z
    y = Y / Z
    zero = np.zeros(len(X))
    residual = xy - focal * np.column_stack([x, y])
    noise = max(1.4826 * float(np.median(np.abs(residual))), 0.1)  # px: SIFT's best
    weight = 1 / (1 + (residual**2).sum(1) / (2 * noise) ** 2)  # Cauchy's, scale 2 sigma
    scale = np.where(in_front, np.sqrt(weight) / noise, 0)
    by_shift = focal * np.array([[1 / Z, zero, -x / Z], [zero, 1 / Z, -y / Z]])  # (2, 3, m)
    by_shift = np.moveaxis(by_shift, 2, 0) * scale[:, None, None]
    by_turn = focal * np.array([[-x * y, 1 + x * x, -y], [-1 - y * y, x * y, x]])
    by_turn = np.moveaxis(by_turn, 2, 0) * scale[:, None, None]
    by_point = by_shift @ pose[image][:, :, :3]
    one = np.ones(len(x))
    r2 = x * x + y * y
    by_camera = focal * np.array(
        [[x, one, zero, x * r2, x * r2 * r2], [y, zero, one, y * r2, y * r2 * r2]]
    )
    by_camera = np.moveaxis(by_camera, 2, 0) * scale[:, None, None]
    return pose, np.concatenate([-by_point, by_turn], 2), by_point, by_camera


def _gauge(pose: Array, size: int) -> tuple[Array, Array]:
    """Return the centres (R, 3) and an orthonormal basis (size, 7) of their similarities."""
    rotation = pose[:, :, :3]
    centre = -np.einsum("rji,rj->ri", rotation, pose[:, :, 3])
    offset = centre - centre.mean(0)
    basis = np.zeros((len(centre), 6, 7))
    basis[:, :3, :3] = np.eye(3)
    basis[:, :3, 3:6] = -skew(*offset.T)
    basis[:, :3, 6] = offset
    columns = np.zeros((size, 7))
    columns[: basis.size // 7] = basis.reshape(-1, 7)
    return centre, np.linalg.qr(columns)[0]
