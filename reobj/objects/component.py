"""Associate detections with 3D objects within one connected component of the trajectory.

Classes that move, and detections that no object explains, are left to the linking by appearance
(`reobj.tracking.linking`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, VisiblePoints, place_of, points_in_boxes, undistort_boxes
from reobj.objects import confidence
from reobj.objects.association import (
    Association,
    AssociationOptions,
    Associator,
    FitShapes,
)
from reobj.objects.categories import Categories
from reobj.objects.frames import informative_frames, only_frames
from reobj.objects.hypotheses import propose, propose_along_rays
from reobj.objects.likelihood import (
    DEPTH_QUANTILES,
    INNER_BOX,
    MIN_POINTS,
    NO_SHAPES,
    PosedDetections,
    Shapes,
)
from reobj.objects.observations import Fit, Scene, Views, gather_views
from reobj.objects.occlusion import edges_above_floor, see_through_ratio
from reobj.objects.phases import Reach, ignore
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
    looked: IntArray | None = None,
    options: AssociationOptions | None = None,
    reach: Reach = ignore,
) -> ComponentObjects:
    """Associate the detections of a component with 3D objects.

    Args:
        rows: all detections by frame; tracklet 0: untracked. moving: names of classes that move.
        looked: frames that the detector was run on, the only ones in which a detection can be
            missed; None: all. options: None: the defaults. reach: reports the progress.
    """
    names = np.array([*class_names, ""])
    processed = poses.frame[poses.known]
    if looked is not None:
        processed = processed[np.isin(processed, looked)]
    moves = _moves(rows, names, moving)
    used = np.flatnonzero(~moves & np.isin(rows.frame, processed) & ~_duplicates(rows))
    table = rows[used]
    tracked = table[table.tracklet_id > 0]
    label = np.full(len(rows), -1)
    iou = np.full(len(rows), np.nan)
    unknown = quadrics.Ellipsoids(*(np.full(s, np.nan) for s in ((1, 3), (1, 3), (1, 3, 3))))
    if not len(tracked):
        return ComponentObjects(label, iou, [], None, unknown)
    frames, informative = informative_frames(tracked, poses, processed)
    fragment = cut_at_gaps(tracked, looked)
    # fragments that show nothing new need no hypotheses: those before them have them
    chosen = np.isin(tracked.frame, frames) & np.isin(fragment, fragment[informative])
    tracked = tracked[chosen]
    fragment = np.unique(fragment[chosen], return_inverse=True)[1]
    count = int(fragment.max()) + 1
    observing = only_frames(poses, frames)
    views = gather_views(tracked, observing, fragment, count, 0.0)
    classes = class_shares(tracked, fragment, count).argmax(1)
    fits = fit(views, classes.tolist(), Scene(trusts_classes=True))
    floor = find_floor(poses, fits)
    reach("first fit", 1.0)
    categories = Categories(priors, names, fits.scale)
    usual_size = categories.usual_size(classes)
    on_floor = categories.on_floor(classes)
    in_chosen = np.isin(table.frame, frames)
    hypotheses = Shapes.concatenate([
        propose(fits, views, classes, usual_size, floor, on_floor),
        _propose_from_untracked(table[in_chosen], observing, categories, fits.up, floor),
    ])  # fmt: skip
    detections = _posed_detections(table[in_chosen], poses, frames)
    scene = Scene(floor, None, None if poses.metric else fits.scale, trusts_classes=True)
    fit_shapes = _cached_fit(detections, categories, scene, fit)
    associator = Associator(detections, fit_shapes, categories.size_log_odds, options, reach)
    found = associator.run(hypotheses, floor is not None)
    if len(frames) < len(processed):
        detections = _posed_detections(table, poses, processed)
        start = np.full(len(table), -1)
        start[in_chosen] = found.label
        associator = Associator(detections, fit_shapes, categories.size_log_odds, options, reach)
        found = associator.assign(found.shapes, start)
        reach("assign", 0.5)
    label[used] = found.label
    iou[used] = _iou_with_projections(detections, found)
    see_through = see_through_ratio(
        found.shapes.ellipsoids, found.evidence.expected, poses, processed
    )
    reach("assign", 1.0)
    none = Shapes(unknown, np.array([""]), np.array([-1]))
    return ComponentObjects(
        label,
        iou,
        confidence.of_objects(found, detections, see_through),
        floor,
        Shapes.concatenate([found.shapes, none]).ellipsoids,
    )


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
    table: Tracks,
    poses: Poses,
    categories: Categories,
    up: Array,
    floor: quadrics.Floor | None,
) -> Shapes:
    """Propose shapes along the rays of good untracked detections: photos have many."""
    measured = np.isin(table.frame, poses.frame[poses.measured])
    table = table[measured & (table.tracklet_id == 0) & (table.score >= HYPOTHESIS_SCORE)]
    box = undistort_boxes(table.xyxy, poses.camera)
    row, _ = place_of(poses, table.frame)
    cams = poses.camera.K @ poses.cam_from_world[row]
    group = np.flatnonzero(box_area(box) > 0)
    classes = table.class_id
    usual_size = categories.usual_size(classes)
    on_floor = categories.on_floor(classes)
    best = (box[group], cams[group], group)
    return propose_along_rays(*best, classes, usual_size, up, floor, on_floor)


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
    boxes = quadrics.solid_boxes(shapes.ellipsoids, list(shapes.support), cams)
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
