"""Associate detections with 3D objects within one connected component of the trajectory.

Classes that move, and detections that no object explains, are left to the linking by appearance
(`reobj.tracking.linking`).

The association chooses from hypotheses: the shapes fitted to the boxes of each tracklet fragment
and, as few views do not determine the depth, shapes at several depths along the rays of its best
boxes and of untracked detections. Wrong hypotheses are rejected by later observations.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, VisiblePoints, place_of, points_in_boxes, undistort_boxes
from reobj.objects.association import Association, Associator, FitShapes
from reobj.objects.description import objects_confidence
from reobj.objects.likelihood import (
    DEPTH_QUANTILES,
    INNER_BOX,
    MIN_POINTS,
    NO_SHAPES,
    Categories,
    PosedDetections,
    Shapes,
)
from reobj.objects.observations import (
    Fit,
    Scene,
    Views,
    edges_above_floor,
    gather_views,
    informative_frames,
    only_frames,
    see_through_ratio,
)
from reobj.poses.floor import floor_of
from reobj.tracking.linking import DUPLICATE_IOU, cut_at_gaps
from reobj.types import (
    Array,
    BoolArray,
    Existence,
    IntArray,
    Tracks,
    box_area,
    box_iou,
    class_shares,
    rows_by,
)

# Least score of untracked detections that give hypotheses (.3 finds 73.5 objects instead of 72, in
# 1.2 times the time: benchmarks/LOG.md)
HYPOTHESIS_SCORE = 0.4


@dataclass(frozen=True, slots=True)
class ComponentObjects:
    """The O objects of a component and the detections assigned to them.

    Attributes:
        label: (N,) object of each row, or -1. iou: (N,) of the box with the projected object, NaN
            without one. confidence: probability that each object exists.
        floor: of the component, or None. ellipsoids: (O + 1,) of the objects, and NaN at the end.
    """

    label: IntArray
    iou: Array
    confidence: Sequence[Existence]
    floor: quadrics.Floor | None
    ellipsoids: quadrics.Ellipsoids


def associate_component(
    rows: Tracks,
    class_names: Sequence[str],
    poses: Poses,
    fit: Fit,
    priors: quadrics.Priors,
    moving: Collection[str] = (),
    detector_ran: IntArray | None = None,
) -> ComponentObjects:
    """Associate the detections of a component with 3D objects.

    Args:
        rows: all detections by frame; tracklet 0: untracked. moving: names of classes that move.
        detector_ran: frames that the detector was run on, the only ones in which a detection can be
            missed; None: all.
    """
    names = np.array([*class_names, ""])
    processed = poses.frame[poses.known]
    if detector_ran is not None:
        processed = processed[np.isin(processed, detector_ran)]
    moves = _moves(rows, names, moving)
    used = np.flatnonzero(~moves & np.isin(rows.frame, processed) & ~_duplicates(rows))
    table = rows[used]
    tracked = table[table.tracklet_id > 0]
    label = np.full(len(rows), -1)
    iou = np.full(len(rows), np.nan)
    unknown = quadrics.Ellipsoids.unknown(1)
    if not len(tracked):
        return ComponentObjects(label, iou, [], None, unknown)
    frames, informative = informative_frames(tracked, poses, processed)
    fragment = cut_at_gaps(tracked, detector_ran)
    # Skip fragments without new viewpoints: earlier fragments already produced these hypotheses
    chosen = np.isin(tracked.frame, frames) & np.isin(fragment, fragment[informative])
    tracked = tracked[chosen]
    fragment = np.unique(fragment[chosen], return_inverse=True)[1]
    count = int(fragment.max()) + 1
    observing = only_frames(poses, frames)
    views = gather_views(tracked, observing, fragment, count, 0.0)
    classes = class_shares(tracked, fragment, count).argmax(1)
    fits = fit(views, classes.tolist(), Scene(trusts_classes=True))
    floor = find_floor(poses, fits)
    categories = Categories(priors, names, fits.scale)
    in_chosen = np.isin(table.frame, frames)
    hypotheses = Shapes.concatenate([
        propose(fits, views, classes, categories, floor),
        _propose_from_untracked(table[in_chosen], observing, categories, fits.up, floor),
    ])  # fmt: skip
    detections = _posed_detections(table[in_chosen], poses, frames)
    scene = Scene(floor, None, None if poses.metric else fits.scale, trusts_classes=True)
    fit_shapes = _cached_fit(detections, categories, scene, fit)
    associator = Associator(detections, fit_shapes, categories.size_log_odds)
    found = associator.run(hypotheses, floor is not None)
    if len(frames) < len(processed):
        detections = _posed_detections(table, poses, processed)
        start = np.full(len(table), -1)
        start[in_chosen] = found.label
        associator = Associator(detections, fit_shapes, categories.size_log_odds)
        found = associator.assign(found.shapes, start)
    label[used] = found.label
    iou[used] = _iou_with_projections(detections, found)
    see_through = see_through_ratio(
        found.shapes.ellipsoids, found.evidence.expected, poses, processed
    )
    certainty = objects_confidence(found, detections, see_through)
    ellipsoids = quadrics.Ellipsoids.concatenate([found.shapes.ellipsoids, unknown])
    return ComponentObjects(label, iou, certainty, floor, ellipsoids)


def _moves(rows: Tracks, names: npt.NDArray[np.str_], moving: Collection[str]) -> BoolArray:
    """Mark rows (N,) of classes that move."""
    moves = np.isin(names, list(moving))  # (C + 1,), the last: unknown class
    return np.asarray(moves[rows.class_id.clip(-1, len(names) - 1)], bool)


def _duplicates(rows: Tracks) -> BoolArray:
    """Mark untracked detections that overlap a better one of their class."""
    found = np.zeros(len(rows), bool)
    for frame_rows in rows_by(rows.frame):
        untracked = rows.tracklet_id[frame_rows] == 0
        best_first = frame_rows[np.lexsort((-rows.score[frame_rows], untracked))]
        overlaps = box_iou(rows.xyxy[best_first], rows.xyxy[best_first]) > DUPLICATE_IOU
        overlaps &= rows.class_id[best_first][:, None] == rows.class_id[best_first]
        for i in range(len(best_first)):
            if not found[best_first[i]]:
                later = best_first[i + 1 :]
                found[later] |= overlaps[i, i + 1 :] & (rows.tracklet_id[later] == 0)
    return found


def find_floor(poses: Poses, fits: quadrics.ObjectFits) -> quadrics.Floor | None:
    """Find the floor, given the scale and gravity of the fits; None: unknown."""
    if fits.scale.source == "none" or not fits.up.any():
        return None
    plane, _ = floor_of(poses, fits.up, fits.scale.value)
    return None if plane is None else quadrics.Floor(plane.normal, plane.offset, plane.sigma)


def _propose_from_untracked(
    table: Tracks, poses: Poses, categories: Categories, up: Array, floor: quadrics.Floor | None
) -> Shapes:
    """Propose shapes along the rays of good untracked detections: photos have many."""
    good = (table.tracklet_id == 0) & (table.score >= HYPOTHESIS_SCORE)
    table = table[good & np.isin(table.frame, poses.frame[poses.measured])]
    box = undistort_boxes(table.xyxy, poses.camera)
    has_area = box_area(box) > 0
    row, _ = place_of(poses, table.frame)
    cams = poses.camera.K @ poses.cam_from_world[row[has_area]]
    return propose_along_rays(box[has_area], cams, table.class_id[has_area], categories, up, floor)


def _posed_detections(table: Tracks, poses: Poses, frames: IntArray) -> PosedDetections:
    """Arrange the rows of some frames with a pose.

    Args:
        frames: (V,) numbers, ascending.
    """
    before, after = np.full((2, len(table)), -1)
    order = np.lexsort((table.frame, table.tracklet_id))
    tracklet = table.tracklet_id[order]
    follows = (np.diff(tracklet) == 0) & (tracklet[1:] > 0)
    after[order[:-1][follows]] = order[1:][follows]
    before[order[1:][follows]] = order[:-1][follows]
    row, _ = place_of(poses, frames)
    view = np.searchsorted(frames, table.frame)
    box = undistort_boxes(table.xyxy, poses.camera)
    return PosedDetections(
        view,
        box,
        table.score,
        table.class_id,
        before,
        after,
        poses.camera.K @ poses.cam_from_world[row],
        (poses.camera.width, poses.camera.height),
        _depths_in(box, view, row, poses),
    )


def _depths_in(box: Array, view: IntArray, row: IntArray, poses: Poses) -> Array:
    """Return quantiles (N, DEPTH_QUANTILES) of the depths of sparse points in the inner boxes.

    Args:
        box: (N, 4) undistorted. view: (N,) ascending. row: (V,) of the views in the poses.
    """
    depths = np.full((len(box), DEPTH_QUANTILES), np.nan)
    visible = VisiblePoints(poses)
    margin = (1 - INNER_BOX) / 2 * (box[:, 2:] - box[:, :2])
    inner = np.concatenate([box[:, :2] + margin, box[:, 2:] - margin], 1)
    level = (np.arange(DEPTH_QUANTILES) + 0.5) / DEPTH_QUANTILES
    for rows in rows_by(view):
        place = row[view[rows[0]]]
        points = poses.points[visible.in_frame(place)]
        camera = poses.camera.K @ poses.cam_from_world[place]
        found, _, depth = points_in_boxes(points, camera, inner[rows])
        for k, inside in zip(np.unique(found), rows_by(found), strict=True):
            if len(inside) >= MIN_POINTS:
                depths[rows[k]] = np.quantile(depth[inside], level)
    return depths


def _project(shapes: Shapes, cams: Array, image_size: tuple[int, int]) -> Array:
    """Return the boxes (V, O, 4) of shapes in the images, NaN where they are out of view."""
    boxes = quadrics.solid_boxes(shapes.ellipsoids, list(shapes.shape), cams)
    return quadrics.clip_boxes(boxes, image_size)


def _iou_with_projections(detections: PosedDetections, found: Association) -> Array:
    """Return the IoU (N,) of detections with the projections of their objects; NaN without one."""
    iou = np.full(len(detections.view), np.nan)
    block = 256  # frames that are projected together, to bound the memory
    for first in range(0, len(detections.img_from_world), block):
        in_block = (detections.view >= first) & (detections.view < first + block)
        rows = np.flatnonzero(in_block & (found.label >= 0))
        cams = detections.img_from_world[first : first + block]
        boxes = _project(found.shapes, cams, detections.image_size)
        boxes = boxes[detections.view[rows] - first, found.label[rows]]
        iou[rows] = quadrics.box_iou(boxes, detections.box[rows])
    return iou


def _cached_fit(
    detections: PosedDetections, categories: Categories, scene: Scene, fit: Fit
) -> FitShapes:
    """Return the function that fits shapes to detections; it fits each set of them once."""
    cache: dict[tuple[bytes, int], Shapes] = {}
    cams = detections.img_from_world
    size = detections.image_size

    def fit_shapes(
        rows: IntArray, label: IntArray, classes: IntArray, current: Shapes | None
    ) -> Shapes:
        order = np.lexsort((rows, label))
        rows = rows[order]
        label = label[order]
        occluded = np.zeros((len(rows), 4), bool)
        if current is not None and scene.floor is not None:
            projected = _project(current, cams, size)[detections.view[rows], label]
            occluded = edges_above_floor(detections.box[rows], projected)
            occluded &= categories.on_floor(classes)[label, None]
        start = np.searchsorted(label, np.arange(len(classes) + 1))
        slices = [slice(a, b) for a, b in itertools.pairwise(start)]
        keys = [
            (rows[s].tobytes() + occluded[s].tobytes(), c)
            for s, c in zip(slices, classes.tolist(), strict=True)
        ]
        missing = [k for k, key in enumerate(keys) if key not in cache]
        if missing:
            boxes = np.full((len(cams), len(missing), 4), np.nan)
            score = np.zeros(boxes.shape[:2])
            edges = np.zeros(boxes.shape, bool)
            for column, k in enumerate(missing):
                cell = detections.view[rows[slices[k]]], column
                boxes[cell] = detections.box[rows[slices[k]]]
                score[cell] = detections.score[rows[slices[k]]]
                edges[cell] = occluded[slices[k]]
            seen = Views(np.arange(len(cams)), boxes, score, cams, size, edges)
            fits = fit(seen, classes[missing].tolist(), scene)
            shapes = Shapes(fits.ellipsoids, fits.support, classes[missing])
            cache.update((keys[k], shapes[[column]]) for column, k in enumerate(missing))
        return Shapes.concatenate([NO_SHAPES, *(cache[key] for key in keys)])

    return fit_shapes


# ---- Hypotheses ----

# Depths that are tried, over the depth at which a box shows an object of the usual size of its
# class: smaller if a part is occluded (a step of a fifth is less than a chair's depth at 3 m)
DEPTHS = np.geomspace(0.4, 1.6, 8)
# Weight of the area of a box at the image border, to choose the best view: it may be truncated, but
# a much larger one still shows the object better (with 1 the shapes of 25 of 38 refitted recordings
# change, their scores within the noise)
BORDER_WEIGHT = 0.3
# Heights of floor-standing objects, over the usual height (without: .7 more false chairs a run of
# the kitchen, benchmarks/RESULTS.md)
STANDING_HEIGHTS = (0.3, 1.8)


def propose(
    fits: quadrics.ObjectFits,
    views: Views,
    classes: IntArray,
    categories: Categories,
    floor: quadrics.Floor | None,
) -> Shapes:
    """Propose shapes for groups of boxes: the fits, and several along rays of each group.

    Args:
        fits, views: of G groups. classes: (G,). floor: None if unknown.
    """
    good = np.isfinite(fits.ellipsoids.center_in_world[:, 0])
    fitted = Shapes(fits.ellipsoids[good], fits.support[good], classes[good])
    group, view = _best_views(views)
    box = views.boxes[view, group]
    cams = views.img_from_world[view]
    rays = propose_along_rays(box, cams, classes[group], categories, fits.up, floor)
    return Shapes.concatenate([fitted, rays])


def propose_along_rays(
    box: Array,
    img_from_world: Array,
    classes: IntArray,
    categories: Categories,
    up: Array,
    floor: quadrics.Floor | None,
) -> Shapes:
    """Propose shapes at several depths along the rays of g boxes.

    Args:
        box: (g, 4) xyxy in undistorted pixels. img_from_world: (g, 3, 4) of its frame.
        classes: (g,). floor: None if unknown.
        up: (3,) unit; all 0: unknown, and nothing is proposed.
    """
    sets = [NO_SHAPES]
    usual_size = categories.usual_size(classes)
    stands = categories.on_floor(classes) & (floor is not None)
    for standing in (True, False):
        pick = np.flatnonzero((stands == standing) & bool(up.any()))
        if len(pick):
            boxes = (box[pick], img_from_world[pick], usual_size[pick])
            ellipsoids, source = _along_rays(*boxes, up, floor if standing else None)
            sets.append(Shapes(ellipsoids, np.full(len(source), "cylinder"), classes[pick[source]]))
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
    box: Array, img: Array, usual_size: Array, up: Array, floor: quadrics.Floor | None
) -> tuple[quadrics.Ellipsoids, IntArray]:
    """Place upright shapes along the rays of boxes (g, 4), in images (g, 3, 4).

    One kind fills the box. The other has the usual width and extends from the top of the box down
    to the floor, or over the usual height, as the lower part of the object may be occluded.

    Returns:
        ellipsoids; the box of each.
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
    usual = np.broadcast_to(usual[:, None], size.shape)

    def from_top(height: Array) -> Array:
        """Return centres (g, D, 3) of shapes of this height (g, D) below the top of the box."""
        return np.asarray(point + ((top_height - height / 2) - point @ up)[..., None] * up)

    if floor is None:
        shorter = size[..., 1] < usual[..., 1]
        kinds = [
            (size, point, np.ones_like(shorter)), (usual, from_top(usual[..., 1]), shorter)
        ]  # fmt: skip
    else:
        # height of the point above the floor n x = d
        lift = (point @ floor.normal - floor.offset) / (floor.normal @ up)
        whole = top_height - (point @ up - lift)
        low, high = (factor * usual[..., 1] for factor in STANDING_HEIGHTS)
        stands = (whole > low) & (whole < high)
        kinds = [
            (np.stack([width[..., 0], whole], -1), from_top(whole), stands)
            for width in (size, usual)
        ]
    center = np.concatenate([middles[keep] for _, middles, keep in kinds])
    half = np.concatenate([extents[keep][:, [0, 0, 1]] / 2 for extents, _, keep in kinds])
    source = np.concatenate([np.nonzero(keep)[0] for _, _, keep in kinds])
    axes = np.tile(_upright_axes(up), (len(center), 1, 1))
    return quadrics.Ellipsoids(center, half, axes), source


def _upright_axes(up: Array) -> Array:
    """Return a rotation (3, 3) whose third column is up."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(up, first), up])
