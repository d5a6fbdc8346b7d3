"""Shift worlds far from their origin (map projections), as float32 has seven digits."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from reobj.cameras import Poses, invert_rigid
from reobj.types import Array

if TYPE_CHECKING:
    from reobj.results.result import Result


def far_origin(poses: Poses | None, points: Array | None = None) -> Array:
    """Return a point (3,) amid the cameras of a world if its origin is far away, else zeros.

    It is rounded to the power of ten below the extent, for short numbers.

    Args:
        points: (N, 3) of objects, included in the extent.
    """
    if poses is None or not poses.known.any():
        return np.zeros(3)
    eye = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]  # (F, 3)
    middle = np.median(eye, 0)
    every = eye if points is None else np.concatenate([eye, points])
    extent = float(np.linalg.norm(every - middle, axis=1).max())
    # float32 has 24 bits: 2 ** -24 of 100 extents is 6e-6 of one
    if not np.linalg.norm(middle) > 100 * extent > 0:
        return np.zeros(3)
    step = 10.0 ** math.floor(math.log10(extent))
    return np.asarray(np.round(middle / step) * step)


def shifted(poses: Poses, origin: Array) -> Poses:
    """Return the cameras and points of a world after a shift of its origin to `origin` (3,)."""
    cams = poses.cam_from_world.copy()
    cams[:, :, 3] += cams[:, :, :3] @ origin
    return dataclasses.replace(poses, cam_from_world=cams, points=poses.points - origin)


def centred(part: Result) -> tuple[Result, Array]:
    """Shift the world of a component (`Result.of_part`) if its origin is far away.

    Returns:
        the component, then without fits, and the position (3,) of the new origin in the old world.
    """
    centers = np.array([o.center for o in part.located], np.float64).reshape(-1, 3)
    origin = far_origin(part.poses, centers)
    if part.poses is None or not origin.any():
        return part, origin
    floor = part.world.floor
    if floor is not None:
        offset = floor.offset - float(floor.normal @ origin)
        floor = dataclasses.replace(floor, offset=offset, middle=floor.middle - origin)
    objects = [
        o if o.center is None else dataclasses.replace(o, center=o.center - origin)
        for o in part.objects
    ]
    world = dataclasses.replace(part.world, floor=floor)
    poses = shifted(part.poses, origin)
    return dataclasses.replace(part, objects=objects, world=world, poses=poses, fits=None), origin
