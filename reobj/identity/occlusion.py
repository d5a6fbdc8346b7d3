"""What is hidden of solids, and what is seen through them.

The box of a thing that stands on the floor and ends above it tells less than where the thing ends.
And where sparse points are seen behind a solid, on rays through its middle, it is not there.
"""

from __future__ import annotations

import numpy as np

import quadrics
from reobj.cameras import Poses, place_of
from reobj.types import Array, BoolArray, IntArray
from reobj.views import Views, VisiblePoints

# Share of its height that a box may end above the lower edge of its solid and still show the whole
# (chosen on hololens_kitchen, where .05 to .2 are alike)
ABOVE = 0.1


def hidden_edges(views: Views, ellipsoids: quadrics.Ellipsoids, on_floor: BoolArray) -> BoolArray:
    """Find the edges of boxes beyond which their things go on.

    Args:
        ellipsoids: of the G groups of the views, NaN where unknown: nothing is known to be hidden.
        on_floor: (G,) these stand on a known floor.
    Returns:
        (V, G, 4) left, upper, right and lower edge.
    """
    projected = quadrics.solid_boxes(ellipsoids, "box", views.img_from_world)
    hidden = edges_above_floor(views.boxes, quadrics.clip_boxes(projected, views.image_size))
    return np.asarray(hidden & on_floor[:, None], bool)


def edges_above_floor(boxes: Array, projected: Array) -> BoolArray:
    """Find what boxes (..., 4) of things on the floor that end above it tell nothing of.

    Their lower part is hidden, and it may be the wider one: of a chair at a table the back shows.

    Args:
        projected: (..., 4) boxes of their solids, which reach down to the floor.
    Returns:
        (..., 4) left, upper, right and lower edge.
    """
    height = projected[..., 3] - projected[..., 1]
    above = boxes[..., 3] < projected[..., 3] - ABOVE * height
    return np.asarray(above[..., None] & np.array([True, False, True, True]), bool)


MIDDLE = 0.6  # of the half axes, that a ray must pass the centre within (chosen)
CLEARLY = 0.05  # of a point's distance, by which it lies behind a solid (chosen)
HOLES = 2.0  # times as much as else is seen through real things (measured: chairs, tables 1.8)
FEW_POINTS = 10.0  # seen behind or not, that tell little (chosen: 5 and 10 are alike)
MOST_POINTS = 500  # of a frame that are looked at (chosen: time)


def seen_through(
    solids: quadrics.Ellipsoids, expected: BoolArray, poses: Poses, frame: IntArray
) -> Array:
    """Measure how much more is seen behind solids than on them or before them.

    Args:
        solids: S. expected: (V, S) frames that should show them. poses: with points and their
            visibility. frame: (V,) numbers.
    Returns:
        (S,) log of points observed behind over the others on rays through the middle, at least 0.
    """
    points, row = VisiblePoints(poses), place_of(poses, frame)[0]
    cam_from_world = poses.cam_from_world[row]
    camera = -np.einsum("vji,vj->vi", cam_from_world[:, :, :3], cam_from_world[:, :, 3])  # (V, 3)
    behind, rest = np.zeros((2, expected.shape[1]))
    for v in np.flatnonzero(expected.any(1)):
        seen, own = points.observed(row[v]), np.flatnonzero(expected[v])
        ray = poses.points[seen[:: len(seen) // MOST_POINTS + 1]] - camera[v]  # (N, 3)
        scaled = solids.world_from_obj[own] / solids.half_axes[own][:, None]  # (S', 3, 3)
        start = np.einsum("si,sij->sj", camera[v] - solids.center_in_world[own], scaled)
        along = np.einsum("ni,sij->nsj", ray, scaled)  # the solids are unit spheres now
        a, b = (along**2).sum(2), (along * start).sum(2)  # (N, S')
        square = (start**2).sum(1)
        root = np.sqrt((b**2 - a * (square - 1)).clip(0))
        leave = (root - b) / a  # the point is at 1
        middle = (square - b**2 / a < MIDDLE**2) & (leave > 0)
        through = leave < 1 - CLEARLY
        behind[own] += (middle & through).sum(0)
        rest[own] += (middle & ~through).sum(0)
    return np.log((behind + FEW_POINTS) / (HOLES * rest + FEW_POINTS)).clip(0)
