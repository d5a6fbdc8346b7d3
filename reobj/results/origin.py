"""Worlds far from their origin (map projections), moved near it: float32 holds seven digits."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from reobj.cameras import Poses, invert_rigid
from reobj.results.result import Result
from reobj.types import Array

FAR = 100  # extents: float32 has 24 bits, 2 ** -24 of 100 extents is 6e-6 of one


def far_origin(poses: Poses | None, places: Array | None = None) -> Array:
    """Return a place (3,) amid the cameras of one world if its origin is far, else zeros.

    It is a multiple of the power of ten below the extent, so that it is short to state.

    Args:
        places: (N, 3) of objects, which count for the extent.
    """
    if poses is None or not poses.known.any():
        return np.zeros(3)
    eye = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]  # (F, 3)
    middle = np.median(eye, 0)
    spread = eye if places is None else np.concatenate([eye, places])
    extent = float(np.linalg.norm(spread - middle, axis=1).max())
    if not np.linalg.norm(middle) > FAR * extent > 0:
        return np.zeros(3)
    step = 10.0 ** math.floor(math.log10(extent))
    return np.asarray(np.round(middle / step) * step)


def shifted(poses: Poses, origin: Array) -> Poses:
    """Return the cameras and points of a world whose origin is another place (3,)."""
    cams = poses.cam_from_world.copy()
    cams[:, :, 3] += cams[:, :, :3] @ origin
    return dataclasses.replace(poses, cam_from_world=cams, points=poses.points - origin)


def centred(part: Result) -> tuple[Result, Array]:
    """Move the world of a part (`Result.of_part`) near its origin, if it is far; without the fits.

    Returns:
        the part, and the place (3,) in its world that is the origin now.
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
