"""How the cameras of a recording saw the places of the objects of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import quadrics
from reobj.cameras import VisiblePoints, invert_rigid, undistort_boxes
from reobj.maps.fusion import ObjectState, alignment_jacobian, shapes_of
from reobj.objects.observations import entry_depths
from reobj.results.result import Object, Result
from reobj.types import Array, BoolArray, IntArray, Tracks

# IoU of a detection with a projection: that a view of a place without the object has one above it
# by accident has these probabilities. (On 18 recordings with the shapes of their objects shifted by
# 1.2 diameters 0 to .26, median .09, and 0 to .07, median .01; not shifted .92 and .81.)
IOU = (0.5, 0.7)
ACCIDENT = (0.1, 0.01)
LEAST_SHARE = 0.75  # of the detections of an object with a shape, to be that object


MOST_VIEWS = 60  # spread over the recording; more take longer
# Least root of the area of the projected box in an image 640 px wide: detectors miss smaller ones
LEAST_PX = 16.0
IN_VIEW = 0.7  # fraction of the projected box inside the image
APART_DEG = 10.0  # views of an object less than this apart fail together and count once
# Different points behind an object, over all views, that show that it is seen through; one or two
# may be wrong
LEAST_POINTS = 3
# Largest standard deviation of the centre, over the mean half axis: with more, a detection of the
# object may lie beside its projection
MOST_SPREAD = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """How the cameras of the recording saw the places of the N objects of the map.

    Views less than 10 degrees apart fail together and count once.

    Attributes:
        expected: (N,) independent views in which the object would be in the image and unoccluded.
        seen_through: (N,) of those, views that show what is behind the object (sparse points on
            rays through its middle), or views besides a first one that show its surroundings.
        vague: (N,) the position in the map is too uncertain to know what a view shows.
        detected: (N,) of the expected ones, views in which a detection may show the object; a
            fraction if some of the views that count as one have one.
        accident: (N,) log probability that these detections lie there by accident.
        unlocated: (N,) as `detected`, by detections that belong to no object of the recording.
    """

    expected: Array
    seen_through: Array
    vague: BoolArray
    detected: Array
    accident: Array
    unlocated: Array


def visibility_of(
    states: Sequence[ObjectState],
    result: Result,
    objects: Sequence[Object],
    alignment_cov: Array,
) -> Visibility:
    """Count the independent views in which each object would be seen, was seen, and through it.

    An object is expected in an image if most of its projection lies inside, is large enough, and
    neither objects of the recording nor most of the sparse points in its outline lie nearer. Views
    say nothing about an object whose centre is too uncertain. All detections of frames in which
    the detector ran count, of all scores, also those that no track has.

    Args:
        states: N objects of the map. result: its first component is placed in the map.
        objects: of this component, which may occlude. alignment_cov: (7, 7) of the placement.
    """
    poses = result.poses
    assert poses is not None
    shapes = shapes_of(states)
    nearer = shapes_of(objects)
    measured = poses.measured & (poses.part == 0)
    if result.looked is not None:
        measured &= np.isin(poses.frame, result.looked)
    rows = np.flatnonzero(measured)
    if len(rows):
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_VIEWS).round().astype(int))]
    size = (poses.camera.width, poses.camera.height)
    cameras = poses.camera.K @ poses.cam_from_world[rows]
    centre = invert_rigid(poses.cam_from_world[rows])[:, :, 3]
    whole = quadrics.solid_boxes(shapes, [s.support for s in states], cameras)  # (V, N, 4)
    boxes = quadrics.clip_boxes(whole, size)
    area = _area(boxes)
    large = np.sqrt(area) * 640 / max(size) >= LEAST_PX
    large &= area >= IN_VIEW * np.maximum(_area(whole), 1e-9)
    visible = VisiblePoints(poses)
    expected, through, around = np.zeros((3, len(rows), len(states)), bool)
    behind = np.zeros((len(states), len(poses.points)), bool)  # points behind, in any view
    for v, row in enumerate(rows.tolist()):
        shown = np.flatnonzero(large[v])
        shown = shown[~_behind_objects(shapes[shown], boxes[v, shown], nearer, cameras[v])]
        points = visible.in_frame(row)
        occluded, beside, beyond = _points_around(
            shapes[shown], boxes[v, shown], poses.points[points], cameras[v], centre[v]
        )
        clear = shown[~occluded]
        expected[v, clear] = True
        around[v, clear] = beside[~occluded]
        through[v, clear] = beyond[~occluded].any(1)
        behind[np.ix_(clear, points)] |= beyond[~occluded]
    through[:, behind.sum(1) < LEAST_POINTS] = False
    jacobian = alignment_jacobian(shapes.center_in_world)
    cov = np.array([s.cov[:3, :3] for s in states]).reshape(-1, 3, 3)
    cov = cov + jacobian @ alignment_cov @ jacobian.swapaxes(1, 2)
    vague = ~(np.sqrt(np.linalg.eigvalsh(cov)[:, -1]) < MOST_SPREAD * shapes.half_axes.mean(1))
    expected[:, vague] = False
    best, unlocated = _best_iou(boxes, result, poses.frame[rows], expected)
    detected = best >= IOU[0]
    accident = np.where(detected, np.interp(best, IOU, np.log(ACCIDENT)), 0.0)
    through &= expected & ~detected
    around &= expected & ~detected
    ray = shapes.center_in_world - centre[:, None]  # (V, N, 3)
    ray = ray / np.linalg.norm(ray, axis=2, keepdims=True).clip(1e-9)

    def independent(mask: BoolArray, value: Array | BoolArray) -> Array:
        """Add the values of the independent views (N,) among those marked (V, N).

        Of rays less than APART_DEG apart the mean value counts.
        """
        total = np.zeros(len(states))
        for k in range(len(states)):
            left = mask[:, k].copy()
            while left.any():
                near = left & (ray[:, k] @ ray[left.argmax(), k] >= np.cos(np.radians(APART_DEG)))
                total[k] += float(value[near, k].mean())
                left &= ~near
        return total

    # one view of the surroundings may show them beside an occluder
    seen_through = np.maximum(independent(through, through), independent(around, around) - 1)
    return Visibility(
        independent(expected, expected),
        seen_through,
        vague,
        independent(expected, detected),
        independent(expected, accident),
        independent(expected, unlocated >= IOU[0]),
    )


def _best_iou(
    boxes: Array, result: Result, frames: IntArray, expected: BoolArray
) -> tuple[Array, Array]:
    """Return the IoU of projections with the best detection that may show the object.

    It may be of any class. Detections of an object with a shape count only if most of them lie on
    the projection: those of an object beside it do in some views. (In four pairs of recordings at
    least .9 of those of the object itself, and at most .5 of those of another one, a bottle 9 cm
    beside it.)

    Args:
        boxes: (V, N, 4) projections. frames: (V,) of the recording.
        expected: (V, N) views in which the map's objects are expected.
    Returns:
        (V, N) of any detection; (V, N) of one that belongs to no object with a shape.
    """
    assert result.poses is not None
    camera = result.poses.camera
    tracked = result.tracks[result.tracks.detection_index >= 0]
    detections = Tracks.joined([tracked, result.untracked])
    known = np.unique(np.array([o.id for o in result.located], np.int64))  # (M,)
    owner = np.searchsorted(known, detections.track_id)  # (D,)
    owner[~np.isin(detections.track_id, known)] = len(known)
    best = np.zeros((len(frames), len(known) + 1, boxes.shape[1]))  # the last: of no such object
    shown = np.zeros((len(frames), len(known)), np.int64)
    for v, frame in enumerate(frames.tolist()):
        here = np.flatnonzero(detections.frame == frame)
        box = undistort_boxes(detections.xyxy[here], camera)  # (d, 4)
        np.maximum.at(best[v], owner[here], quadrics.box_iou(boxes[v], box[:, None]))
        shown[v, owner[here][owner[here] < len(known)]] = 1
    best *= expected[:, None]
    share = (best[:, :-1] >= IOU[0]).sum(0) / np.maximum(shown.T @ expected, 1)  # (M, N)
    best[:, :-1] *= share >= LEAST_SHARE
    return np.asarray(best.max(1), np.float64), best[:, -1]


def _area(box: Array) -> Array:
    """Return the areas (...) of boxes (..., 4), 0 for NaN."""
    return np.asarray(np.nan_to_num(box[..., 2:] - box[..., :2]).clip(0).prod(-1))


def _behind_objects(
    shapes: quadrics.Ellipsoids, box: Array, nearer: quadrics.Ellipsoids, camera: Array
) -> BoolArray:
    """Mark shapes (n,) before which other objects cover half of their box or more.

    An object whose box contains the centre of a shape is no occluder: the shape itself, or a couch
    on which it lies.
    """
    if not len(shapes) or not len(nearer):
        return np.zeros(len(shapes), bool)
    depth = shapes.center_in_world @ camera[2, :3] + camera[2, 3]  # (n,)
    front = depth - np.linalg.norm(shapes.half_axes, axis=1)
    step = np.array([0.2, 0.5, 0.8])  # of the box: 9 rays
    grid = np.stack(np.meshgrid(step, step), -1).reshape(1, -1, 2)
    points = box[:, None, :2] + grid * (box[:, None, 2:] - box[:, None, :2])  # (n, 9, 2)
    entry = entry_depths(points.reshape(-1, 2), camera, nearer).reshape(len(shapes), 9, -1)
    offset = shapes.center_in_world[:, None] - nearer.center_in_world  # (n, m, 3)
    inside = np.abs(np.einsum("nmi,mij->nmj", offset, nearer.world_from_obj))
    contains = (inside < 1.1 * nearer.half_axes).all(2)  # (n, m)
    entry = np.where(contains[:, None], np.inf, entry)
    return np.asarray((entry.min(2) < front[:, None]).mean(1) >= 0.5, bool)


def _points_around(
    shapes: quadrics.Ellipsoids, box: Array, points: Array, camera: Array, centre: Array
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Mark shapes that points occlude or surround, and points behind shapes.

    Args:
        box: (n, 4) projected. points: (P, 3) that the image shows. centre: (3,) of the camera.
    Returns:
        occluded: (n,) at least five points lie on rays through the middle of the object, most of
        them before it. beside: (n,) at least three points lie in the box enlarged by its size on
        each side, not nearer than the object, and no more lie before it: nothing large stands
        there. behind: (n, P) points behind it on rays through its middle; none if as many lie on it
        or before it.
    """
    in_cam = points @ camera[:, :3].T + camera[:, 3]  # (P, 3)
    depth = np.where(in_cam[:, 2] > 0, in_cam[:, 2], np.nan)
    xy = in_cam[:, :2] / depth[:, None]
    middle = (box[:, :2] + box[:, 2:]) / 2
    off = np.abs(xy - middle[:, None]) / (box[:, 2:] - box[:, :2])[:, None]  # (n, P, 2) of its size
    near = (off < 1.5).all(2)
    front = shapes.center_in_world @ camera[2, :3] + camera[2, 3] - shapes.half_axes.max(1)
    beyond = (near & (depth > front[:, None])).sum(1)
    beside = (beyond >= 3) & (near.sum(1) <= 2 * beyond)
    scaled = shapes.world_from_obj / shapes.half_axes[:, None]  # (n, 3, 3): to unit spheres
    start = np.einsum("ni,nij->nj", centre - shapes.center_in_world, scaled)
    along = np.einsum("pi,nij->npj", points - centre, scaled)  # the point is at 1
    a = (along**2).sum(2)  # (n, P)
    b = np.einsum("npj,nj->np", along, start)
    square = (start**2).sum(1)[:, None]
    root = np.sqrt((b**2 - a * (square - 1)).clip(0))
    leave = (root - b) / a
    crosses = (square - b**2 / a < 0.6**2) & (leave > 0)  # through its middle
    crosses &= (off < 0.35).all(2)  # beside the box's middle the ray may miss the object
    behind = crosses & (leave < 1 - 0.05)  # errors of depth
    before = (crosses & (-(b + root) / a > 1 + 0.05)).sum(1)
    total = crosses.sum(1)
    behind[2 * behind.sum(1) <= total] = False
    return (before >= 5) & (2 * before > total), beside, behind
