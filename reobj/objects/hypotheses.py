"""Where things might be: solids that the association chooses from.

Of every fragment of a tracklet the solid that is fitted to its boxes; and, as few views tell no
distance, solids at several distances along the rays of its best boxes, and of the detections in no
tracklet. Which of them are right other fragments tell, at other times.
"""

from __future__ import annotations

import numpy as np

import quadrics
from reobj.objects.likelihood import NO_SOLIDS, Solids
from reobj.objects.observations import Views
from reobj.types import Array, BoolArray, IntArray

# Distances that are tried, over that at which a box shows a thing of the usual size of its class:
# nearer where a part is hidden (chosen; a step of a fifth is less than a chair's depth at 3 m)
DISTANCES = np.geomspace(0.4, 1.6, 8)
CUT_BOX = 0.3  # weight of the area of a box that touches the border, as the best view (chosen)
STANDING_HEIGHTS = (0.3, 1.8)  # over the usual height, of what stands on the floor (chosen)


def propose(
    fits: quadrics.ObjectFits,
    views: Views,
    classes: IntArray,
    usual_size: Array,
    floor: quadrics.Floor | None,
    on_floor: BoolArray,
) -> Solids:
    """Propose solids for groups of boxes.

    Args:
        fits, views: of G groups. classes: (G,).
        usual_size: (G, 3) width, depth and height of their categories, in units of the world.
        floor: None if unknown. on_floor: (G,) the category stands on it.
    Returns:
        the fits, and several solids along a few rays of each group.
    """
    good = np.isfinite(fits.ellipsoids.center_in_world[:, 0])
    own = Solids(fits.ellipsoids[good], fits.support[good], classes[good])
    rays = propose_along_rays(views, classes, usual_size, fits.up, floor, on_floor)
    return Solids.concatenate([own, rays])


def propose_along_rays(
    views: Views,
    classes: IntArray,
    usual_size: Array,
    up: Array,
    floor: quadrics.Floor | None,
    on_floor: BoolArray,
) -> Solids:
    """Propose solids at several distances along the rays of the best boxes of G groups.

    Args:
        up: (3,) unit; all 0: unknown, and nothing is proposed. The others: as in `propose`.
    """
    made = [NO_SOLIDS]
    group, view = _best_views(views)
    stands = on_floor[group] & (floor is not None)
    for standing in (True, False):
        pick = (stands == standing) & bool(up.any())
        if pick.any():
            own = (view[pick], group[pick], usual_size[group[pick]])
            ellipsoids, of = _along_rays(views, *own, up, floor if standing else None)
            made.append(Solids(ellipsoids, np.full(len(of), "cylinder"), classes[of]))
    return Solids.concatenate(made)


def _best_views(views: Views) -> tuple[IntArray, IntArray]:
    """Choose views of each group, those with the largest boxes: one of each third of its views.

    A tracklet may have slipped from one thing to another on its way.

    Returns:
        groups (P,) and views (P,).
    """
    box = views.boxes
    inside = (box[..., :2] > 2).all(-1) & (box[..., 2:] < np.array(views.image_size) - 2).all(-1)
    area = (box[..., 2:] - box[..., :2]).prod(-1) * np.where(inside, 1.0, CUT_BOX)  # (V, G)
    seen = np.isfinite(area)
    third = (3 * (seen.cumsum(0) - 1)) // seen.sum(0).clip(1)
    best = [np.where(seen & (third == k), area, -1.0) for k in range(3)]
    view = np.stack([a.argmax(0) for a in best])  # (3, G)
    known = np.stack([a.max(0) > 0 for a in best])
    part, group = np.nonzero(known)
    return group, view[part, group]


def _along_rays(
    views: Views,
    view: IntArray,
    group: IntArray,
    usual_size: Array,
    up: Array,
    floor: quadrics.Floor | None,
) -> tuple[quadrics.Ellipsoids, IntArray]:
    """Put upright solids along the rays of boxes, of views (g,) of groups (g,).

    They fill the box; and, wide as usual, they reach from its top down to the floor, or as far as
    is usual: the lower part of the box is hidden then.

    Returns:
        ellipsoids; the group of each.
    """
    img = views.img_from_world[view]  # (g, 3, 4)
    box = views.boxes[view, group]  # (g, 4)
    inverse = np.linalg.inv(img[:, :, :3])
    centre = -np.einsum("gij,gj->gi", inverse, img[:, :, 3])
    middle = (box[:, :2] + box[:, 2:]) / 2
    focal = np.sqrt(np.abs(np.linalg.det(img[:, :, :3])))  # px, of a camera in units of the world
    extent = (box[:, 2:] - box[:, :2]) / focal[:, None]  # (g, 2) at depth 1
    usual = np.column_stack([np.sqrt(usual_size[:, 0] * usual_size[:, 1]), usual_size[:, 2]])
    depth = (usual / extent).min(1)[:, None] * DISTANCES  # (g, D)
    size = extent[:, None] * depth[..., None]  # (g, D, 2) that fills the box
    far = depth + size[..., 0] / 2  # of the solid's middle
    ray = np.einsum("gij,gj->gi", inverse, np.column_stack([middle, np.ones(len(box))]))
    top = np.einsum("gij,gj->gi", inverse, np.column_stack([middle[:, 0], box[:, 1], focal**0]))
    point = centre[:, None] + ray[:, None] * far[..., None]  # (g, D, 3)
    height = (centre[:, None] + top[:, None] * far[..., None]) @ up  # (g, D) of its upper side
    narrow = np.broadcast_to(usual[:, None, 0], depth.shape)
    if floor is None:
        whole = np.broadcast_to(usual[:, None, 1], depth.shape)
        kinds = [(size[..., 0], size[..., 1], point), (narrow, whole, None)]
        good = [np.ones(depth.shape, bool), size[..., 1] < whole]
    else:
        # the floor's height below each point: n x = d
        lift = (point @ floor.normal - floor.offset) / (floor.normal @ up)
        whole = height - (point @ up - lift)
        low, high = (share * usual[:, None, 1] for share in STANDING_HEIGHTS)
        stands = (whole > low) & (whole < high)
        kinds = [(size[..., 0], whole, None), (narrow, whole, None)]
        good = [stands, stands]
    axes = _upright_axes(up)
    solids, of = [], []
    for (wide, tall, at), keep in zip(kinds, good, strict=True):
        if at is None:  # from the upper side downwards
            at = point + ((height - tall / 2) - point @ up)[..., None] * up
        half = np.stack([wide, wide, tall], -1)[keep] / 2
        solids.append((at[keep], half))
        of.append(np.broadcast_to(group[:, None], depth.shape)[keep])
    centres, halves = (np.concatenate(column) for column in zip(*solids, strict=True))
    ellipsoids = quadrics.Ellipsoids(centres, halves, np.tile(axes, (len(centres), 1, 1)))
    return ellipsoids, np.concatenate(of)


def _upright_axes(up: Array) -> Array:
    """Return a rotation (3, 3) whose third column is up."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(up, first), up])
