"""The last adjustment of a model, and how well it determines cameras and focal length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from reobj.cameras import import_pycolmap
from reobj.poses.bundle import FOCAL_RANGE, ModelArrays, read_arrays
from reobj.poses.uncertainty import relative_sigmas


@dataclass(frozen=True, slots=True)
class Adjusted:
    """A model after the last adjustment.

    Attributes:
        arrays: of the model. calibrated: its focal length came out of it. centre_sigma: largest of
            a camera's centre, over the extent of the path.
    """

    model: Any
    arrays: ModelArrays
    calibrated: bool
    centre_sigma: float


# Sigma of the log of a focal length that came out (measured on parts of 6 to 136 images, median of
# the errors: up to .005 .9 %, to .02 2 %, to .03 4 %, above more; held as the matches tell it 4 %)
MAX_FOCAL_SIGMA = 0.03
MAX_CENTRE_SHIFT = 0.05  # of the principal point when it is freed, over the size (chosen)
# Log of a ratio up to which two focal lengths are the same (measured where the principal point
# drifts off, with and without: right .0003, half as long as the true one .12 to .2)
SAME_FOCAL = 0.05


def adjusted(model: Any, calibrate: bool) -> Adjusted:
    """Adjust a model, with its intrinsics if the observations determine them.

    Args:
        model: changed where its intrinsics stay; a copy is returned where they do not.
        calibrate: its intrinsics are not known: the focal length, two distortion terms and, unless
            it drifts off, the principal point are freed.
    """
    if calibrate:
        free = import_pycolmap().Reconstruction(model)
        told = _calibrate(free)
        arrays = read_arrays(free)
        centre_sigma, focal_sigma = relative_sigmas(arrays, True)
        low, high = FOCAL_RANGE
        if told and focal_sigma <= MAX_FOCAL_SIGMA and low <= arrays.focal_over_size <= high:
            return Adjusted(free, arrays, True, centre_sigma)
    refine(model)
    arrays = read_arrays(model)
    return Adjusted(model, arrays, False, relative_sigmas(arrays, False)[0])


def refine(model: Any) -> None:
    """Adjust cameras and points once more, with a robust loss."""
    _bundle_adjust(model, False, False)


def _calibrate(model: Any) -> bool:
    """Adjust a model with its intrinsics.

    Returns:
        False where the focal length depends on the principal point: then neither is told.
    """
    camera, radial = model.camera(1), ("SIMPLE_RADIAL", "RADIAL")
    size, focal = np.array([camera.width, camera.height]), camera.mean_focal_length()
    start = [focal, *size / 2, camera.params[3] if camera.model.name in radial else 0, 0]
    camera.model = import_pycolmap().CameraModelId.RADIAL
    camera.params = start
    _bundle_adjust(model, True, True)
    free = camera.params[0]
    if (np.abs(camera.params[1:3] / size - 0.5) <= MAX_CENTRE_SHIFT).all():
        return True
    camera.params = start
    _bundle_adjust(model, True, False)
    return bool(abs(np.log(camera.params[0] / free)) < SAME_FOCAL)


SOFT_L1_PX = 0.5  # from where a residual counts less, pixels of the resized image (chosen)


def _bundle_adjust(model: Any, calibrate: bool, free_centre: bool) -> None:
    """Adjust all images and points.

    Nothing fixes the gauge: no residual depends on it. COLMAP would by the first two cameras, and
    a scale that is told by two in one place tears the model.
    """
    pc = import_pycolmap()
    options, chosen = pc.BundleAdjustmentOptions(), pc.BundleAdjustmentConfig()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = calibrate
    options.refine_principal_point = free_centre
    options.ceres.loss_function_type = pc.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = SOFT_L1_PX
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1  # the same result every time
    for i in model.reg_image_ids():
        chosen.add_image(i)
    pc.create_default_bundle_adjuster(options, chosen, model).solve()
