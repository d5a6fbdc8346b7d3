"""A model of pycolmap as arrays, for the checks.

Read once, after the last adjustment; what the checks compute from it is vectorised.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from reobj.types import Array, BoolArray, IntArray

# n - |sum of u|^2 / n of the unit rays u to a point that tell its depth: 1 - cos(angle) for two
MIN_RAY_SPREAD = 1 - np.cos(np.radians(1.5))  # (COLMAP's min_tri_angle)

FOCAL_RANGE = (0.4, 2.0)  # plausible focal length over the longer side (chosen: 28-103 deg wide)


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

    def seen(self) -> Any:
        """Return the observations as a sparse (R, N), 1 where an image observes a point."""
        found = sparse.csr_matrix(
            (np.ones(len(self.image)), (self.image, self.point)), (len(self.ids), len(self.xyz))
        )
        found.data[:] = 1  # a point may be observed twice in an image
        return found

    def told_by(self, rows: IntArray) -> BoolArray:
        """Mark the points (N,) whose depth some images alone tell, by `MIN_RAY_SPREAD`."""
        mine = np.isin(self.image, rows)
        image, count = self.image[mine], len(self.xyz)
        ray = self.xyz[self.point[mine]] - self.centre[image]  # (m, 3)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        entries = (np.ones(len(image)), (self.point[mine], np.arange(len(image))))
        sums = sparse.csr_matrix(entries, (count, len(image))) @ np.insert(ray, 3, 1, 1)  # (N, 4)
        spread = sums[:, 3] - (sums[:, :3] ** 2).sum(1) / np.maximum(sums[:, 3], 1)
        return np.asarray(spread >= MIN_RAY_SPREAD, bool)

    def in_cam(self) -> Array:
        """Return the observed points (M, 3) in the frames of their images."""
        pose, xyz = self.cam_from_world[self.image], self.xyz[self.point]
        found: Array = np.einsum("mij,mj->mi", pose[:, :, :3], xyz) + pose[:, :, 3]
        return found


def read_arrays(model: Any) -> ModelArrays:
    """Read a `pycolmap.Reconstruction` with one camera.

    Args:
        model: its poses and points are copied, a later change of it is not seen.
    """
    ids = np.array(sorted(model.reg_image_ids()), np.int64)
    point_ids = np.array(sorted(model.point3D_ids()), np.int64)
    camera = copy.copy(model.camera(1))
    images = [model.image(i) for i in ids.tolist()]
    points = [image.get_observation_points2D() for image in images]
    found = np.array([p.point3D_id for of_image in points for p in of_image], np.int64)
    xy = np.array([p.xy for of_image in points for p in of_image], np.float64)
    poses = [image.cam_from_world().matrix() for image in images]
    cam_from_world = np.array(poses, np.float64).reshape(-1, 3, 4)
    return ModelArrays(
        camera,
        ids,
        cam_from_world,
        -np.einsum("rji,rj->ri", cam_from_world[:, :, :3], cam_from_world[:, :, 3]),
        np.array([model.point3D(i).xyz for i in point_ids.tolist()], np.float64).reshape(-1, 3),
        np.repeat(np.arange(len(ids)), [len(of_image) for of_image in points]),
        np.searchsorted(point_ids, found),
        np.array([k for image in images for k in image.get_observation_point2D_idxs()], np.int64),
        np.reshape(camera.cam_from_img(xy.reshape(-1, 2)), (-1, 2)),
    )
