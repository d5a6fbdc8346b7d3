"""What tells a sound model of a reconstruction from a wrong one, by its geometry alone.

Parallax, triangulation angles, the covariance of the cameras' centres, another mapper's model. The
reprojection error is no help: wrong models had the smallest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.poses.bundle import FOCAL_RANGE, ModelArrays
from reobj.types import IntArray

MIN_PARALLAX_PX = 3.0  # refuse a model with less (chosen; walks have more than 4)
MIN_POINTS = 100  # refuse a model with fewer (chosen)
MIN_POINTS_PER_IMAGE = 30  # of the median image; refuse a model with fewer (chosen)
# A model whose cameras' centres all have a smaller sigma, over the extent of the path and by the
# adjustment's covariance, is believed. Above, it may be one of many nearly equal solutions, and
# another mapper must find the same (measured: right models of 40 keyframes and more .0001 to .0025,
# wrong ones of short stretches from .0011 on).
SURE_CENTRE_SIGMA = 0.001
# Above this that is no proof if nothing but the model told the focal length: where the camera
# zoomed, two mappers come to the same wrong scale (measured: one of .0045).
MAX_UNTOLD_SIGMA = 0.004
# The same: no centre further off, over the extent, no camera turned by more.
SAME_CENTRE, SAME_TURN_DEG = 0.05, 5.0  # half of what examples/pose_breaks.py calls wrong
SAME_IMAGES = 0.75  # of the part, that the other mapper must hold (chosen)
MIN_SAME = 3  # images of a piece of it; fewer lie as they like (chosen)
# Points whose depth each of two pieces tells that prove how they are joined: they fix rotation,
# shift and scale (measured: right joins 191 to 386, a mirrored stretch 24, a free scale 0 to 3)
MIN_JOINT = 100
MIN_TRI_ANGLE_DEG = 1.5  # median; refuse a model with less (chosen; COLMAP's points: 1.5)
MIN_REGISTERED = 0.5  # share of the keyframes that makes a model worth having ...
MIN_PART_IMAGES = 10  # ... or as many images of a larger video (COLMAP's min_model_size)


SIDEWAYS = "move the camera sideways around the objects (turning on the spot gives no depth)"
LENS = "give measured intrinsics (--camera); pixels must be square"


@dataclass(frozen=True, slots=True)
class Part:
    """A model that holds together, and the measures that tell a sound one from a wrong one."""

    model: Any
    arrays: ModelArrays
    calibrated: bool  # its focal length came out of the adjustment
    tri_angle_deg: float  # median over points of the widest angle between two rays
    registered: float  # share of the keyframes
    parallax_px: float  # what turns of the camera alone cannot explain
    centre_sigma: float  # largest of a camera's centre, over the extent of the path
    explained: int  # verified matches
    problem: str  # what was measured
    held: IntArray  # ids of the images that are to be kept
    help: str = ""  # what the user can do, where the cause is established

    @property
    def focal(self) -> float:
        """Focal length over the longer side."""
        return self.arrays.focal_over_size


def measured(
    model: Any,
    arrays: ModelArrays,
    centre_sigma: float,
    *,
    count: int,
    explained: int,
    calibrated: bool,
) -> Part:
    """Measure an adjusted model of some of `count` keyframes and name its first problem.

    Args:
        arrays: of the model. explained: verified matches that it explains.
    """
    camera, images, angle = arrays.camera, len(arrays.ids), _median_tri_angle_deg(arrays)
    seen = np.bincount(arrays.image, minlength=max(images, 1))  # (R,)
    parallax = _parallax_px(arrays)
    few = images < min(MIN_REGISTERED * count, MIN_PART_IMAGES)
    focal = arrays.focal_over_size
    # at a wrong focal length a walk along a wall looks like a turn
    no_depth = ": there is no depth" if calibrated else f", at a focal length of {focal:.2f} widths"
    checks = (
        (few, f"only {images} of {count} keyframes connect", ""),
        (len(arrays.xyz) < MIN_POINTS, f"only {len(arrays.xyz)} points could be triangulated", ""),
        (np.median(seen) < MIN_POINTS_PER_IMAGE,
         f"half of the keyframes see {np.median(seen):.0f} points or fewer", ""),
        (parallax < MIN_PARALLAX_PX,
         f"a mere turn of the camera explains all images to {parallax:.1f} px{no_depth}",
         SIDEWAYS if calibrated else ""),
        (angle < MIN_TRI_ANGLE_DEG,
         f"half of the points are seen from directions within {angle:.1f} deg",
         SIDEWAYS if calibrated else ""),
        (camera.has_bogus_params(*FOCAL_RANGE, 1.0),
         f"the focal length came out as {focal:.2f} x the longer side", LENS),
    )  # fmt: skip
    problem, advice = next(((text, what) for bad, text, what in checks if bad), ("", ""))
    registered = images / count
    measures = angle, registered, parallax, centre_sigma, explained
    return Part(model, arrays, calibrated, *measures, problem, arrays.ids, advice)


def confirmed(parts: list[Part], others: list[Part], told: bool) -> list[Part]:
    """Find a problem in parts of uncertain cameras, unless another mapper came to the same.

    Images that it has elsewhere, or not at all, are not to be kept.

    Args:
        told: the focal length was known before, by the user or from the matches.
    """
    found = []
    for part in parts:
        if not part.problem and part.centre_sigma > SURE_CENTRE_SIGMA:
            proof = told or part.centre_sigma <= MAX_UNTOLD_SIGMA
            held = _found_by(part.arrays, [other.arrays for other in others if proof])
            part = replace(part, held=part.arrays.ids[held])
            if len(held) < SAME_IMAGES * len(part.arrays.ids):
                why = (
                    "where the camera was is uncertain, and no second way of mapping confirms it "
                    f"(largest sigma {100 * part.centre_sigma:.2g} % of the path, parallax "
                    f"{part.parallax_px:.0f} px, rays meet at {part.tri_angle_deg:.1f} deg)"
                )
                part = replace(part, problem=why)
        found.append(part)
    return sorted(found, key=lambda p: (bool(p.problem), -p.registered))


def _found_by(one: ModelArrays, others: Sequence[ModelArrays]) -> IntArray:
    """Return the images (rows of one) that another mapper has in the same places, maybe in pieces.

    A piece says nothing but how its own cameras lie. What joins it to the rest are points whose
    depth both sides tell: of two worlds that look alike in part there are few, and none where
    only one image, or a pair without a third, ties two scales.
    """
    pieces = sorted((_same(one, other) for other in others), key=len, reverse=True)
    held, todo = pieces[0] if pieces else np.empty(0, np.int64), pieces[1:]
    while joined := [p for p in todo if (one.told_by(held) & one.told_by(p)).sum() >= MIN_JOINT]:
        held, todo = np.union1d(held, joined[0]), [p for p in todo if p is not joined[0]]
    return np.sort(held)


def _same(one: ModelArrays, other: ModelArrays) -> IntArray:
    """Return the images that another model has, rows (n,) of one; none unless in the same places.

    One is brought to the other by the mean of the relative orientations, then scale and shift.
    """
    ids = np.intersect1d(one.ids, other.ids)
    if len(ids) < MIN_SAME:
        return np.empty(0, np.int64)
    rows = np.searchsorted(one.ids, ids), np.searchsorted(other.ids, ids)
    a, b = (v.cam_from_world[r][:, :, :3] for v, r in zip((one, other), rows, strict=True))
    relative = Rotation.from_matrix(np.swapaxes(b, 1, 2) @ a)
    mean = relative.mean()
    turn = np.degrees((mean.inv() * relative).magnitude())
    a, b = (v.centre[r] for v, r in zip((one, other), rows, strict=True))
    moved, end = mean.apply(a - a.mean(0)), b - b.mean(0)
    moved *= (moved * end).sum() / max((moved**2).sum(), 1e-12)
    off = np.linalg.norm(moved - end, axis=1).max() / np.linalg.norm(np.ptp(end, axis=0))
    return rows[0][: len(ids) if off <= SAME_CENTRE and turn.max() <= SAME_TURN_DEG else 0]


ANGLE_SAMPLE = 2000  # points of which the median angle is taken, at least (chosen: time)


def _median_tri_angle_deg(arrays: ModelArrays) -> float:
    """Measure how well points are triangulated: the median of the widest angle of two rays."""
    if not len(arrays.xyz):
        return 0.0
    step = max(1, len(arrays.xyz) // ANGLE_SAMPLE)
    mine = np.flatnonzero(arrays.point % step == 0)
    mine = mine[np.argsort(arrays.point[mine], kind="stable")]
    ray = arrays.xyz[arrays.point[mine]] - arrays.centre[arrays.image[mine]]  # (m, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    starts = np.flatnonzero(np.diff(arrays.point[mine], prepend=-1))
    cosine = [(u @ u.T).min() for u in np.split(ray, starts[1:])]  # of each point
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))


MIN_SHARED = 15  # points of a pair of images whose parallax counts (chosen)


def _parallax_px(arrays: ModelArrays) -> float:
    """Measure the parallax that turns of the camera cannot explain.

    Of each pair of images the rays of the shared points are aligned by a rotation; the median
    residual is the pair's parallax. Returned is the 95th percentile over pairs, in pixels. A camera
    that only turned looks sound otherwise: a wrong focal length makes up triangulation angles.
    """
    unit = np.insert(arrays.ideal, 2, 1, 1)  # (M, 3)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    ends = np.searchsorted(arrays.image, np.arange(len(arrays.ids) + 1))
    residuals = []
    for a, b in itertools.combinations(range(len(arrays.ids)), 2):
        if (b - a) & (b - a - 1) == 0:  # 1, 2, 4, 8 ... keyframes apart
            p, q = (arrays.point[ends[i] : ends[i + 1]] for i in (a, b))
            both, one, other = np.intersect1d(p, q, return_indices=True)
            if len(both) >= MIN_SHARED:
                u, v = unit[ends[a] + one], unit[ends[b] + other]  # (n, 3)
                turned = Rotation.align_vectors(v, u)[0].apply(u)
                residuals.append(np.median(np.linalg.norm(turned - v, axis=1)))
    return float(np.percentile(residuals, 95)) * arrays.focal if residuals else 0.0
