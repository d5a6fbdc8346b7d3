"""What tells a sound model of a reconstruction from a wrong one, by its geometry alone.

Parallax, triangulation angles, the spread of the cameras, the covariance of their centres. The
reprojection error is no help: wrong models had the smallest.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.poses.uncertainty import relative_centre_sigma
from reobj.types import Array

STRONG_TRI_ANGLE_DEG = 5.0  # triangulation angle that calibrates a focal length (chosen)
STRONG_TURN_DEG = 45.0  # or turn of the camera on the way: an orbit, however flat (chosen)
STRONG_SPREAD = 0.1  # and spread of the cameras over the depth that does (chosen)
FOCAL_RANGE = (0.4, 2.0)  # plausible focal length over the longer side (chosen: 28-103 deg wide)
MIN_PARALLAX_PX = 3.0  # refuse a model with less (chosen; walks have more than 4)
MIN_POINTS = 100  # refuse a model with fewer (chosen)
MIN_POINTS_PER_IMAGE = 30  # of the median image; refuse a model with fewer (chosen)
# A model whose cameras' centres all have a smaller sigma, over the extent of the path and by the
# adjustment's covariance, is believed. Above, it may be one of many nearly equal solutions, and
# another mapper must find the same (measured: right models of 40 keyframes and more .0001 to .002,
# wrong ones of short stretches from .0015 on). Without another mapper MAX_CENTRE_SIGMA counts.
SURE_CENTRE_SIGMA = 0.001
MAX_CENTRE_SIGMA = 0.0025
# The same: no centre further off, over the extent, no camera turned by more.
SAME_CENTRE, SAME_TURN_DEG = 0.05, 5.0  # half of what examples/pose_breaks.py calls wrong
SAME_IMAGES = 0.75  # of the larger model that both must hold (chosen)
MIN_TRI_ANGLE_DEG = 1.5  # median; refuse a model with less (chosen; COLMAP's points: 1.5)
MIN_REGISTERED = 0.5  # share of the keyframes that makes a model worth having ...
MIN_PART_IMAGES = 10  # ... or as many images of a larger video (COLMAP's min_model_size)


@dataclass(frozen=True, slots=True)
class Geometry:
    """How strongly the rays of a model tell its depths and its focal length."""

    tri_angle_deg: float  # median over points of the widest angle between two rays
    turn_deg: float  # widest angle of a viewing direction from their mean, twice
    spread: float  # rms distance of the cameras from their mean over the median depth
    focal: float  # over the longer side

    @property
    def calibrates(self) -> bool:
        """True if the geometry is strong enough to trust the focal length that came out."""
        low, high = FOCAL_RANGE
        wide = self.tri_angle_deg >= STRONG_TRI_ANGLE_DEG or self.turn_deg >= STRONG_TURN_DEG
        return wide and self.spread >= STRONG_SPREAD and low <= self.focal <= high


def geometry_of(model: Any) -> Geometry:
    """Measure the geometry of a model."""
    camera = model.camera(1)
    centre = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    angle, depth = _angle_and_depth(model, centre)
    if not centre:
        return Geometry(angle, 0.0, 0.0, focal)
    spread = float(np.sqrt(np.var(list(centre.values()), axis=0).sum()) / max(depth, 1e-12))
    axes = np.array([model.image(i).cam_from_world().matrix()[2, :3] for i in centre])  # (R, 3)
    off_mean = (axes @ axes.mean(0)).min() / max(np.linalg.norm(axes.mean(0)), 1e-12)
    turn = 2 * math.degrees(math.acos(np.clip(off_mean, -1, 1)))
    return Geometry(angle, turn, spread, focal)


@dataclass(frozen=True, slots=True)
class Part:
    """A model that holds together, and the measures that tell a sound one from a wrong one."""

    model: Any
    geometry: Geometry
    registered: float  # share of the keyframes
    parallax_px: float  # what turns of the camera alone cannot explain
    centre_sigma: float  # largest of a camera's centre, over the extent of the path
    explained: float  # verified matches
    problem: str


def measured(model: Any, count: int, explained: int, fixed: bool) -> Part:
    """Measure a model of some of `count` keyframes and name its first problem.

    Args:
        explained: verified matches that it explains. fixed: its intrinsics were known.
    """
    camera, geometry = model.camera(1), geometry_of(model)
    seen = [model.image(i).num_points3D for i in model.reg_image_ids()] or [0]
    parallax, angle = _parallax_px(model), geometry.tri_angle_deg
    sigma = relative_centre_sigma(model, not fixed and geometry.calibrates)
    few = model.num_reg_images() < min(MIN_REGISTERED * count, MIN_PART_IMAGES)
    checks = (
        (few, f"only {model.num_reg_images()} of {count} keyframes connect"),
        (model.num_points3D() < MIN_POINTS,
         f"only {model.num_points3D()} points could be triangulated"),
        (np.median(seen) < MIN_POINTS_PER_IMAGE, "the images share too few points"),
        (parallax < MIN_PARALLAX_PX,
         "a mere turn of the camera explains all images, so there is no depth"),
        (angle < MIN_TRI_ANGLE_DEG,
         f"rays meet at {angle:.1f} deg only: the camera hardly moved sideways"),
        (camera.has_bogus_params(*FOCAL_RANGE, 1.0),
         f"the focal length came out as {geometry.focal:.2f} x the width"),
    )  # fmt: skip
    problem = next((text for bad, text in checks if bad), "")
    registered = model.num_reg_images() / count
    return Part(model, geometry, registered, parallax, sigma, explained, problem)


def confirmed(parts: list[Part], others: list[Part], sigma: float) -> list[Part]:
    """Find a problem in parts of a larger sigma, unless another mapper came to the same."""
    found = [
        replace(part, problem="there is too little parallax to tell where the camera was")
        if not part.problem
        and part.centre_sigma > sigma
        and not any(_same(part.model, other.model) for other in others)
        else part
        for part in parts
    ]
    return sorted(found, key=lambda p: (bool(p.problem), -p.registered))


def _same(one: Any, other: Any) -> bool:
    """Tell whether two models have their common cameras in the same places.

    One is brought to the other by the mean of the relative orientations, then scale and shift.
    """
    ids = sorted({*one.reg_image_ids()} & {*other.reg_image_ids()})
    if len(ids) < max(3, SAME_IMAGES * max(one.num_reg_images(), other.num_reg_images())):
        return False
    a, b = (
        invert_rigid(np.array([m.image(i).cam_from_world().matrix() for i in ids]))
        for m in (one, other)
    )
    relative = Rotation.from_matrix(b[:, :, :3] @ np.swapaxes(a[:, :, :3], 1, 2))
    mean = relative.mean()
    turn = np.degrees((mean.inv() * relative).magnitude())
    start, end = (c[:, :, 3] - c[:, :, 3].mean(0) for c in (a, b))
    moved = mean.apply(start)
    moved *= (moved * end).sum() / max((moved**2).sum(), 1e-12)
    off = np.linalg.norm(moved - end, axis=1).max() / np.linalg.norm(np.ptp(end, axis=0))
    return bool(off <= SAME_CENTRE and turn.max() <= SAME_TURN_DEG)


ANGLE_SAMPLE = 2000  # points of which the median angle is taken, at least (chosen: time)


def _angle_and_depth(model: Any, centre: dict[int, Array]) -> tuple[float, float]:
    """Measure how well points are triangulated.

    Args:
        centre: of the camera of each image id.
    Returns:
        medians over points of the widest angle between two of its rays, in degrees, and of its
        distance from the cameras.
    """
    ids = sorted(model.point3D_ids())
    if not ids:
        return 0.0, 0.0
    angles, depths = [], []
    for point_id in ids[:: max(1, len(ids) // ANGLE_SAMPLE)]:
        point = model.point3D(point_id)
        rays = point.xyz - np.array([centre[e.image_id] for e in point.track.elements])  # (L, 3)
        length = np.linalg.norm(rays, axis=1)
        unit = rays / length[:, None]
        angles.append(math.degrees(math.acos(float(np.clip((unit @ unit.T).min(), -1, 1)))))
        depths.append(float(np.median(length)))
    return float(np.median(angles)), float(np.median(depths))


MIN_SHARED = 15  # points of a pair of images whose parallax counts (chosen)


def _parallax_px(model: Any) -> float:
    """Measure the parallax that turns of the camera cannot explain.

    Of each pair of images the rays of the shared points are aligned by a rotation; the median
    residual is the pair's parallax. Returned is the 95th percentile over pairs, in pixels. A camera
    that only turned looks sound otherwise: a wrong focal length makes up triangulation angles.
    """
    rays: dict[int, dict[int, Array]] = {}
    for image_id in sorted(model.reg_image_ids()):
        seen = model.image(image_id).get_observation_points2D()
        xy = np.array([p.xy for p in seen]).reshape(-1, 2)
        ideal = np.reshape(model.camera(1).cam_from_img(xy), (-1, 2))
        unit = np.column_stack([ideal, np.ones(len(seen))])  # (n, 3)
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        rays[image_id] = dict(zip([p.point3D_id for p in seen], unit, strict=True))
    residuals = []
    for a, b in itertools.combinations(rays, 2):
        if (b - a) & (b - a - 1) == 0:  # 1, 2, 4, 8 ... keyframes apart
            both = sorted(rays[a].keys() & rays[b].keys())
            if len(both) >= MIN_SHARED:
                one, other = (np.array([rays[i][p] for p in both]) for i in (a, b))  # (n, 3)
                turned = Rotation.align_vectors(other, one)[0].apply(one)
                residuals.append(np.median(np.linalg.norm(turned - other, axis=1)))
    widest = float(np.percentile(residuals, 95)) if residuals else 0.0
    return widest * float(model.camera(1).mean_focal_length())
