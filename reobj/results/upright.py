"""Objects in an upright metric frame: z up, metres, the origin of their world.

Robots plan in such a frame (ROS REP 103), whatever the axes and units of the poses.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.files import numbers, rounded
from reobj.results.entries import Object, Part, World
from reobj.types import Array


def rotation_to_up(up: Array | None) -> Array:
    """Return the smallest rotation (3, 3) that maps `up` (3,) to z; identity for None."""
    z = np.array([0.0, 0, 1])
    return np.asarray(Rotation.align_vectors([z], [z if up is None else up])[0].as_matrix())


def upright_pose(found: Object, world: World | Part) -> dict[str, Any]:
    """Return the position and heading of an object in the upright metric frame of its world.

    Args:
        world: of the object's component.
    Returns:
        "center_m": [x, y, z] in metres, z up, None where scale or up is unknown. "yaw_deg": angle
        of the object's x axis about z from the frame's x axis, in (-180, 180], None where up is
        unknown. Both are None without a shape.
    """
    entry: dict[str, Any] = {"center_m": None, "yaw_deg": None}
    up = world.up_in_world
    if found.center is None or found.quat_wxyz is None or up is None:
        return entry
    rotation = rotation_to_up(up)
    w, x, y, z = found.quat_wxyz.tolist()
    axis = rotation @ Rotation.from_quat([x, y, z, w]).as_matrix()[:, 0]
    entry["yaw_deg"] = rounded(math.degrees(math.atan2(axis[1], axis[0])), 2)
    scale = world.scale
    if scale is not None and scale.source != "none":
        center = scale.value * rotation @ found.center
        extent = 1.0 if found.half_axes is None else scale.value * float(found.half_axes.max())
        entry["center_m"] = numbers(center, extent)
    return entry


def component_of(found: Object, world: World) -> World | Part:
    """Return the world of the component that an object lies in."""
    return world.parts[found.part] if len(world.parts) > 1 else world
