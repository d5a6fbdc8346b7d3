"""Object hypotheses that the association chooses from.

They are the shapes fitted to the boxes of each tracklet fragment and, as few views do not determine
the depth, shapes at several depths along the rays of its best boxes and of untracked detections.
Wrong hypotheses are rejected by later observations.
"""

from __future__ import annotations

import numpy as np

import quadrics
from reobj.objects.likelihood import NO_SHAPES, Shapes
from reobj.objects.observations import Views
from reobj.types import Array, BoolArray, IntArray

# Depths that are tried, over the depth at which a box shows an object of the usual size of its
# class: smaller if a part is occluded (chosen; a step of a fifth is less than a chair's depth at
# 3 m)
DEPTHS = np.geomspace(0.4, 1.6, 8)
# Weight of the area of a box at the image border, to choose the best view: it may be truncated, but
# a much larger one still shows the object better (1: within the noise, benchmarks/RESULTS.md)
BORDER_WEIGHT = 0.3
# Heights of floor-standing objects, over the usual height (without: .7 more false chairs a run of
# the kitchen, benchmarks/RESULTS.md)
STANDING_HEIGHTS = (0.3, 1.8)


def propose(
    fits: quadrics.ObjectFits,
    views: Views,
    classes: IntArray,
    usual_size: Array,
    floor: quadrics.Floor | None,
    on_floor: BoolArray,
) -> Shapes:
    """Propose shapes for groups of boxes: the fits, and several along rays of each group.

    Args:
        fits, views: of G groups. classes: (G,).
        usual_size: (G, 3) width, depth and height of their categories, in units of the world.
        floor: None if unknown. on_floor: (G,) the category stands on it.
    """
    good = np.isfinite(fits.ellipsoids.center_in_world[:, 0])
    fitted = Shapes(fits.ellipsoids[good], fits.support[good], classes[good])
    group, view = _best_views(views)
    best = (views.boxes[view, group], views.img_from_world[view], group)
    rays = propose_along_rays(*best, classes, usual_size, fits.up, floor, on_floor)
    return Shapes.concatenate([fitted, rays])


def propose_along_rays(
    box: Array,
    img_from_world: Array,
    group: IntArray,
    classes: IntArray,
    usual_size: Array,
    up: Array,
    floor: quadrics.Floor | None,
    on_floor: BoolArray,
) -> Shapes:
    """Propose shapes at several depths along the rays of boxes of G groups.

    Args:
        box: (g, 4) xyxy in undistorted pixels. img_from_world: (g, 3, 4) of its frame.
        group: (g,) of the boxes.
        up: (3,) unit; all 0: unknown, and nothing is proposed. The others: as in `propose`.
    """
    sets = [NO_SHAPES]
    stands = on_floor[group] & (floor is not None)
    for standing in (True, False):
        pick = (stands == standing) & bool(up.any())
        if pick.any():
            boxes = (box[pick], img_from_world[pick], group[pick], usual_size[group[pick]])
            ellipsoids, source = _along_rays(*boxes, up, floor if standing else None)
            sets.append(Shapes(ellipsoids, np.full(len(source), "cylinder"), classes[source]))
    return Shapes.concatenate(sets)


def _best_views(views: Views) -> tuple[IntArray, IntArray]:
    """Choose the largest box of each third of the views of each group.

    (Three, as a tracklet may have slipped from one object to another.)

    Returns:
        groups (P,) and views (P,).
    """
    box = views.boxes
    far_border = np.array(views.image_size) - 2  # px: a box this near to the border is truncated
    whole = (box[..., :2] > 2).all(-1) & (box[..., 2:] < far_border).all(-1)
    area = (box[..., 2:] - box[..., :2]).prod(-1) * np.where(whole, 1.0, BORDER_WEIGHT)  # (V, G)
    seen = np.isfinite(area)
    third = (3 * (seen.cumsum(0) - 1)) // seen.sum(0).clip(1)
    best = [np.where(seen & (third == k), area, -1.0) for k in range(3)]
    view = np.stack([a.argmax(0) for a in best])  # (3, G)
    known = np.stack([a.max(0) > 0 for a in best])
    index, group = np.nonzero(known)
    return group, view[index, group]


def _along_rays(
    box: Array,
    img: Array,
    group: IntArray,
    usual_size: Array,
    up: Array,
    floor: quadrics.Floor | None,
) -> tuple[quadrics.Ellipsoids, IntArray]:
    """Place upright shapes along the rays of boxes (g, 4), in images (g, 3, 4) of groups (g,).

    One kind fills the box. The other has the usual width and extends from the top of the box down
    to the floor, or over the usual height, as the lower part of the object may be occluded.

    Returns:
        ellipsoids; the group of each.
    """
    inverse = np.linalg.inv(img[:, :, :3])
    centre = -np.einsum("gij,gj->gi", inverse, img[:, :, 3])
    middle = (box[:, :2] + box[:, 2:]) / 2
    focal = np.sqrt(np.abs(np.linalg.det(img[:, :, :3])))  # px, of a camera in units of the world
    extent = (box[:, 2:] - box[:, :2]) / focal[:, None]  # (g, 2) at depth 1
    usual = np.column_stack([np.sqrt(usual_size[:, 0] * usual_size[:, 1]), usual_size[:, 2]])
    depth = (usual / extent).min(1)[:, None] * DEPTHS  # (g, D)
    size = extent[:, None] * depth[..., None]  # (g, D, 2) that fills the box
    center_depth = depth + size[..., 0] / 2
    ray = np.einsum("gij,gj->gi", inverse, np.column_stack([middle, np.ones(len(box))]))
    top = np.einsum("gij,gj->gi", inverse, np.column_stack([middle[:, 0], box[:, 1], focal**0]))
    point = centre[:, None] + ray[:, None] * center_depth[..., None]  # (g, D, 3)
    top_height = (centre[:, None] + top[:, None] * center_depth[..., None]) @ up  # (g, D)
    narrow = np.broadcast_to(usual[:, None, 0], depth.shape)
    if floor is None:
        whole = np.broadcast_to(usual[:, None, 1], depth.shape)
        kinds = [(size[..., 0], size[..., 1], point), (narrow, whole, None)]
        good = [np.ones(depth.shape, bool), size[..., 1] < whole]
    else:
        # height of the point above the floor n x = d
        lift = (point @ floor.normal - floor.offset) / (floor.normal @ up)
        whole = top_height - (point @ up - lift)
        low, high = (factor * usual[:, None, 1] for factor in STANDING_HEIGHTS)
        stands = (whole > low) & (whole < high)
        kinds = [(size[..., 0], whole, None), (narrow, whole, None)]
        good = [stands, stands]
    axes = _upright_axes(up)
    shapes = []
    source = []
    for (width, height, center), keep in zip(kinds, good, strict=True):
        if center is None:  # from the top downwards
            center = point + ((top_height - height / 2) - point @ up)[..., None] * up
        half = np.stack([width, width, height], -1)[keep] / 2
        shapes.append((center[keep], half))
        source.append(np.broadcast_to(group[:, None], depth.shape)[keep])
    centers, halves = (np.concatenate(column) for column in zip(*shapes, strict=True))
    ellipsoids = quadrics.Ellipsoids(centers, halves, np.tile(axes, (len(centers), 1, 1)))
    return ellipsoids, np.concatenate(source)


def _upright_axes(up: Array) -> Array:
    """Return a rotation (3, 3) whose third column is up."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(up, first), up])
