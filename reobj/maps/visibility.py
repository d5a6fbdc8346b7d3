"""How the cameras of a recording saw the places of the objects of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Poses, VisiblePoints, invert_rigid, undistort_boxes
from reobj.maps.compare import Visibility
from reobj.maps.fusion import ObjectState
from reobj.objects.occlusion import entry_depths
from reobj.results.result import Object
from reobj.types import Array, BoolArray, IntArray, Tracks

# IoU of a detection with a projection: that a view of a place without the object has one above it
# by accident has these probabilities. (On 18 recordings with the shapes of their objects shifted by
# 1.2 diameters 0 to .26, median .09, and 0 to .07, median .01; not shifted .92 and .81.)
IOU = (0.5, 0.7)
ACCIDENT = (0.1, 0.01)
LEAST_SHARE = 0.75  # of the detections of an object with a shape, to be that object


@dataclass(frozen=True, slots=True, eq=False)
class MapDetections:
    """Detections of a recording, for N objects of a map.

    Attributes:
        rows: in native pixels, of all scores, also those that no track has.
        located: (M,) identities of objects with a shape.
        cov: (N, 3, 3) of the centres of the map's objects, as the recording is placed.
    """

    rows: Tracks
    located: IntArray
    cov: Array


def shapes_of(states: Sequence[ObjectState] | Sequence[Object]) -> quadrics.Ellipsoids:
    """Return the ellipsoids of objects, in the world of the map."""
    wxyz = np.array([s.quat_wxyz for s in states]).reshape(-1, 4)
    axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() if len(states) else wxyz
    return quadrics.Ellipsoids(
        np.array([s.center for s in states]).reshape(-1, 3),
        np.array([s.half_axes for s in states]).reshape(-1, 3),
        axes.reshape(-1, 3, 3),
    )


def visibility_of(
    states: Sequence[ObjectState],
    poses: Poses,
    nearer: quadrics.Ellipsoids,
    looked: IntArray | None = None,
    detections: MapDetections | None = None,
    most_views: int = 60,
    least_px: float = 16.0,
    in_view: float = 0.7,
    apart_deg: float = 10.0,
    least_points: int = 3,
    most_spread: float = 0.5,
) -> Visibility:
    """Count the independent views in which each object would be seen, was seen, and through it.

    An object is expected in an image if most of its projection lies inside, is large enough, and
    neither objects of the recording nor most of the sparse points in its outline lie nearer. Views
    say nothing about an object whose centre is too uncertain.

    Args:
        states: N objects of the map. poses: placed in the map; only its first component is used.
        nearer: objects of the recording, which may occlude. looked: frames that the detector was
            run on; None: all. detections: in these frames; None: there are none.
        most_views: spread over the recording; more take longer.
        least_px: root of the area of the projected box in an image 640 px wide; detectors miss
            smaller objects.
        in_view: fraction of the projected box inside the image.
        apart_deg: views of an object less than this apart fail together and count once.
        least_points: different points behind an object, over all views, that show that it is
            seen through; one or two may be wrong.
        most_spread: largest standard deviation of the centre, over the mean half axis: with more,
            a detection of the object may lie beside its projection.
    """
    shapes = shapes_of(states)
    support = [s.support for s in states]
    measured = poses.measured & (poses.part == 0)
    if looked is not None:
        measured &= np.isin(poses.frame, looked)
    rows = np.flatnonzero(measured)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, most_views).round().astype(int))] \
        if len(rows) else rows  # fmt: skip
    size = (poses.camera.width, poses.camera.height)
    cameras = poses.camera.K @ poses.cam_from_world[rows]
    centre = invert_rigid(poses.cam_from_world[rows])[:, :, 3]
    visible = VisiblePoints(poses)
    expected = np.zeros((len(rows), len(states)), bool)
    through = np.zeros((len(rows), len(states)), bool)
    around = np.zeros((len(rows), len(states)), bool)
    behind: list[set[int]] = [set() for _ in states]
    for v, row in enumerate(rows.tolist()):
        whole = quadrics.solid_boxes(shapes, support, cameras[v : v + 1])[0]  # (N, 4)
        clipped = quadrics.clip_boxes(whole[None], size)[0]
        ratio = _area(clipped) / np.maximum(_area(whole), 1e-9)
        sides = np.sqrt(_area(clipped)) * 640 / max(size)
        with np.errstate(invalid="ignore"):
            shown = np.flatnonzero((ratio >= in_view) & (sides >= least_px))
        shown = shown[~_behind_objects(shapes[shown], clipped[shown], nearer, cameras[v])]
        points = visible.in_frame(row)
        occluded, beside, seen = _points_around(
            shapes[shown], clipped[shown], poses.points[points], cameras[v], centre[v]
        )
        expected[v, shown[~occluded]] = True
        around[v, shown[~occluded & beside]] = True
        for k, inside in zip(shown.tolist(), seen, strict=True):
            through[v, k] = bool(len(inside)) and expected[v, k]
            behind[k].update(points[inside].tolist() if expected[v, k] else ())
    through[:, [len(ids) < least_points for ids in behind]] = False
    cov = np.array([s.cov[:3, :3] for s in states]).reshape(-1, 3, 3)
    spread = np.linalg.eigvalsh(cov if detections is None else detections.cov)[:, -1]  # (N,)
    vague = ~(np.sqrt(spread) < most_spread * shapes.half_axes.mean(1))
    expected[:, vague] = False
    best, unlocated = np.zeros((2, *expected.shape))
    if detections is not None and len(states):
        best, unlocated = _best_iou(shapes, support, poses, rows, detections, expected)
    detected = best >= IOU[0]
    accident = np.where(detected, np.interp(best, IOU, np.log(ACCIDENT)), 0.0)
    through &= expected & ~detected
    around &= expected & ~detected
    ray = shapes.center_in_world - centre[:, None]  # (V, N, 3)
    ray = ray / np.linalg.norm(ray, axis=2, keepdims=True).clip(1e-9)

    def independent(mask: BoolArray, value: Array | BoolArray | None = None) -> Array:
        """Count the independent views (N,) among those marked (V, N), or add their mean values."""
        value = mask if value is None else value
        counts = [
            _independent(ray[mask[:, k], k], value[mask[:, k], k], apart_deg)
            for k in range(len(states))
        ]
        return np.array(counts, np.float64)

    # one view of its surroundings may show them beside what stands before the object
    seen_through = np.maximum(independent(through), independent(around) - 1)
    return Visibility(
        independent(expected),
        seen_through,
        vague,
        independent(expected, detected),
        independent(expected, accident),
        independent(expected, unlocated >= IOU[0]),
    )


def _best_iou(
    shapes: quadrics.Ellipsoids,
    support: list[str],
    poses: Poses,
    rows: IntArray,
    detections: MapDetections,
    expected: BoolArray,
) -> tuple[Array, Array]:
    """Return the IoU of projections with the best detection that may show the object.

    It may be of any class. Detections of an object with a shape count only if most of them lie on
    the projection: those of an object beside it do in some views. (In four pairs of recordings at
    least .9 of those of the object itself, and at most .5 of those of another one, a bottle 9 cm
    beside it.)

    Args:
        shapes: (N,) of the map, each of its support. rows: (V,) of the poses.
        expected: (V, N) views in which the map's objects are expected.
    Returns:
        (V, N) of any detection; (V, N) of one that belongs to no object with a shape.
    """
    known = np.unique(detections.located)  # (M,)
    owner = np.searchsorted(known, detections.rows.track_id)  # (D,)
    owner[~np.isin(detections.rows.track_id, known)] = len(known)
    best = np.zeros((len(rows), len(known) + 1, len(support)))  # the last: of no such object
    shown = np.zeros((len(rows), len(known)), np.int64)
    for v, row in enumerate(rows.tolist()):
        here = np.flatnonzero(detections.rows.frame == poses.frame[row])
        box = undistort_boxes(detections.rows.xyxy[here], poses.camera)  # (d, 4)
        camera = poses.camera.K @ poses.cam_from_world[row]
        projected = quadrics.solid_boxes(shapes, support, camera[None])
        projected = quadrics.clip_boxes(projected, (poses.camera.width, poses.camera.height))[0]
        np.maximum.at(best[v], owner[here], quadrics.box_iou(projected, box[:, None]))
        shown[v, owner[here][owner[here] < len(known)]] = 1
    best *= expected[:, None]
    share = (best[:, :-1] >= IOU[0]).sum(0) / np.maximum(shown.T @ expected, 1)  # (M, N)
    best[:, :-1] *= share >= LEAST_SHARE
    return np.asarray(best.max(1), np.float64), best[:, -1]


def _area(box: Array) -> Array:
    """Return the areas (N,) of boxes (N, 4), 0 for NaN."""
    side = np.nan_to_num(box[:, 2:] - box[:, :2]).clip(0)
    return np.asarray(side[:, 0] * side[:, 1])


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
) -> tuple[BoolArray, BoolArray, list[IntArray]]:
    """Mark shapes that points occlude or surround, and find points behind shapes.

    Args:
        box: (n, 4) projected. points: (P, 3) that the image shows. centre: (3,) of the camera.
    Returns:
        occluded: (n,) at least five points lie on rays through the middle of the object, most of
        them before it. beside: (n,) at least three points lie in the box enlarged by its size on
        each side, not nearer than the object, and no more lie before it: nothing large stands
        there. behind: for each object the points (k,) behind it on rays through its
        middle; none if as many lie on it or before it.
    """
    occluded = np.zeros(len(shapes), bool)
    beside = np.zeros(len(shapes), bool)
    through = [np.empty(0, np.int64) for _ in range(len(shapes))]
    projected = points @ camera[:, :3].T + camera[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = projected[:, :2] / projected[:, 2:]
    for k in range(len(shapes)):
        middle = (box[k, :2] + box[k, 2:]) / 2
        side = box[k, 2:] - box[k, :2]
        depth = projected[:, 2]
        near = np.flatnonzero((np.abs(xy - middle) < 1.5 * side).all(1) & (depth > 0))
        front = shapes.center_in_world[k] @ camera[2, :3] + camera[2, 3]
        front -= float(shapes.half_axes[k].max())
        beyond = int((depth[near] > front).sum())
        beside[k] = beyond >= 3 and len(near) - beyond <= beyond
        half = 0.7 * side / 2  # beside it the ray may miss the object
        inside = np.flatnonzero((np.abs(xy - middle) < half).all(1) & (depth > 0))
        if not len(inside):
            continue
        scaled = shapes.world_from_obj[k] / shapes.half_axes[k]
        start = (centre - shapes.center_in_world[k]) @ scaled
        along = (points[inside] - centre) @ scaled  # the point is at 1
        a = (along**2).sum(1)
        b = along @ start
        square = float(start @ start)
        hit = b**2 - a * (square - 1)
        root = np.sqrt(hit.clip(0))
        enter = (-b - root) / a
        leave = (-b + root) / a
        crosses = (square - b**2 / a < 0.6**2) & (leave > 0)  # through its middle
        behind = crosses & (leave < 1 - 0.05)  # errors of depth
        before = crosses & (enter > 1 + 0.05)
        others = crosses & ~behind
        occluded[k] = before.sum() >= 5 and before.sum() > 0.5 * crosses.sum()
        if behind.sum() > others.sum():
            through[k] = inside[behind]
    return occluded, beside, through


def _independent(ray: Array, value: Array | BoolArray, apart_deg: float) -> float:
    """Add the values of views; those of rays (n, 3) less than some degrees apart are averaged."""
    total = 0.0
    least = np.cos(np.radians(apart_deg))
    while len(ray):
        near = ray @ ray[0] >= least
        total += float(value[near].mean())
        ray = ray[~near]
        value = value[~near]
    return total
