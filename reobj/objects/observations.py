"""Input of the fit: boxes of groups of tracks in frames with a pose, and sparse points on them.

The caller decides which rows form a group: tracklet fragments before the association, identities
after it. Of a long video the frames with new evidence are used (`informative_frames`). Edges of
boxes at which an occluder hides the object are one-sided (`occluded_edges`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

import quadrics
from reobj.cameras import (
    Poses,
    VisiblePoints,
    invert_rigid,
    place_of,
    points_in_boxes,
    undistort_boxes,
    viewing_rays,
)
from reobj.types import Array, BoolArray, IntArray, Tracks, rows_by

# Boxes below this score, and interpolated boxes, do not enter the last fit (of the weakest boxes 1
# in 25 is real)
MIN_SCORE = 0.05


@dataclass(frozen=True, slots=True)
class Views:
    """Boxes of G groups in V frames with a pose, as `quadrics.fit_objects` takes them.

    Attributes:
        frame: (V,) source frames. boxes: (V, G, 4) xyxy in undistorted pixels, NaN where unseen.
        score: (V, G), 0 where unseen. img_from_world: (V, 3, 4) K @ cam_from_world.
        image_size: (w, h) px. occluded: (V, G, 4) edges of boxes caused by an occluder.
        points: (G, P, 3) sparse points that may lie on each group's object, padded with NaN.
    """

    frame: IntArray
    boxes: Array
    score: Array
    img_from_world: Array
    image_size: tuple[int, int]
    occluded: BoolArray | None = None
    points: Array | None = None


class Scene(NamedTuple):
    """Facts about a component of the trajectory, estimated before its objects are fitted.

    Attributes:
        floor: that objects may stand on. up: (3,) unit, against gravity, if the user gives none.
        scale: metres per unit; None: the poses are metric, or the fit estimates it.
        trusts_classes: never overrule a category. While the assignment of boxes is open, a box of
            an object part, or of two objects, must not be explained by another category.
    """

    floor: quadrics.Floor | None = None
    up: Array | None = None
    scale: quadrics.Scale | None = None
    trusts_classes: bool = False


# views of G groups, their classes, facts about the scene -> G fits
Fit = Callable[[Views, list[int], Scene], quadrics.ObjectFits]


def gather_views(
    table: Tracks, poses: Poses, groups: IntArray, count: int, min_score: float
) -> Views:
    """Arrange rows of tracks by frame with a pose and by group.

    Args:
        groups: (N,) group of each row of the table, 0 .. count - 1, one row per frame and group.
        min_score: rows below it, and rows of frames without a measured pose, are left out.
    """
    frame = poses.frame[poses.known]
    measured = poses.measured[poses.known]
    view_of = {int(frame[view]): int(view) for view in np.flatnonzero(measured)}
    view = np.array([view_of.get(f, -1) for f in table.frame.tolist()], np.int64)  # (N,)
    use = (view >= 0) & (table.score >= min_score)
    boxes = np.full((len(frame), count, 4), np.nan)
    score = np.zeros((len(frame), count))
    boxes[view[use], groups[use]] = undistort_boxes(table.xyxy[use], poses.camera)
    score[view[use], groups[use]] = table.score[use]
    img_from_world = poses.camera.K @ poses.cam_from_world[poses.known]  # (V, 3, 4)
    size = (poses.camera.width, poses.camera.height)
    return Views(frame, boxes, score, img_from_world, size)


# Least fraction of the views that observe a point in which it is inside the box: boxes are cut off
# where the object is occluded (.95 is alike: benchmarks/LOG.md)
INSIDE_FRACTION = 0.8
MIN_POINTS = 5  # per object: fewer may all belong to another object


def points_on(
    views: Views, poses: Poses, ellipsoids: quadrics.Ellipsoids, max_points: int = 100
) -> Array:
    """Find the sparse points that may lie on the object of each group: inside most of its boxes.

    A point inside the boxes of several groups is assigned to the nearest ellipsoid, and of several
    that contain it to the smallest: to the cup rather than to the table.

    Args:
        ellipsoids: of the G groups, NaN where unknown.
        max_points: per object; more take more time.
    Returns:
        (G, P, 3), spread over the points of each group, padded with NaN.
    """
    group, point = _points_inside_most_boxes(views, poses)
    in_obj = np.einsum(
        "ki,kij->kj",
        poses.points[point] - ellipsoids.center_in_world[group],
        ellipsoids.world_from_obj[group],
    )
    half = ellipsoids.half_axes[group]
    width = half.mean(1)
    distance = np.linalg.norm((np.abs(in_obj) - half).clip(0), axis=1) / width
    order = np.lexsort((width, np.nan_to_num(distance, nan=np.inf), point))
    order = order[np.append(True, np.diff(point[order]) != 0)[: len(order)]]  # nearest group
    found = np.full((views.boxes.shape[1], max_points, 3), np.nan)
    for pairs in rows_by(group[order]):
        if len(pairs) >= MIN_POINTS:
            pairs = order[pairs[:: -(-len(pairs) // max_points)]]
            found[group[pairs[0]], : len(pairs)] = poses.points[point[pairs]]
    return found


def _points_inside_most_boxes(views: Views, poses: Poses) -> tuple[IntArray, IntArray]:
    """Return pairs of a group (K,) and a point (K,) that lies in most boxes of the group."""
    visible = VisiblePoints(poses)
    row, _ = place_of(poses, views.frame)
    shown = np.isfinite(views.boxes[..., 0])  # (V, G)
    inside = [np.empty((2, 0), np.int64)]  # groups and points
    observed = [np.empty((2, 0), np.int64)]  # views and points
    for v, camera in enumerate(views.img_from_world):
        points = visible.observed(row[v])
        groups = np.flatnonzero(shown[v])
        box, point, _ = points_in_boxes(poses.points[points], camera, views.boxes[v, groups])
        inside.append(np.stack([groups[box], points[point]]))
        observed.append(np.stack([np.full(len(points), v), points]))
    size = (shown.shape[1], len(poses.points))
    views_inside = _count_pairs(np.concatenate(inside, 1), size)  # (G, P)
    of_view = _count_pairs(np.concatenate(observed, 1), (len(shown), size[1]))  # (V, P)
    views_observing = sparse.csr_array(shown.T.astype(np.int64)) @ of_view  # (G, P)
    group, point = views_inside.nonzero()
    # csr_array: before scipy 1.14 fancy indexing returns a sparse array
    total = np.asarray(sparse.csr_matrix(views_observing)[group, point]).ravel()
    count = views_inside.data
    mostly = (count >= 2) & (count >= INSIDE_FRACTION * total)
    return group[mostly], point[mostly]


def _count_pairs(pairs: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    """Count pairs (2, K) of rows and columns."""
    return sparse.csr_array((np.ones(len(pairs[0]), np.int64), tuple(pairs)), shape)


# ---- Frames of a long video ----


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOptions:
    """How many frames of a video are informative.

    Attributes:
        all_of: videos of at most this number of frames are used whole; of longer ones at least it.
        same_direction_deg: viewing rays of an object within this angle see it from one side.
        identity_frames: least number of selected frames of each identity of the tracker, so that an
            object that is seen briefly has enough views.
        longest_step: frames from one selected frame to the next: where nothing is detected, missing
            detections are evidence too.
    """

    all_of: int = 600
    same_direction_deg: float = 1.0
    identity_frames: int = 10
    longest_step: int = 30


def informative_frames(
    tracks: Tracks, poses: Poses, frames: IntArray, options: FrameOptions | None = None
) -> tuple[IntArray, BoolArray]:
    """Choose frames with new viewing directions and new identities, in the order of time.

    Detections of nearly equal views repeat their errors: an object is detected, missed or occluded
    in the same way. Objects of a long video are therefore associated on frames that differ in their
    view of the objects; the detections of the other frames are assigned to the objects found.

    A frame is selected if at least half of the identities detected in it were not seen from their
    direction in any frame selected before, or if one of them has too few selected frames. If few
    are selected, further frames follow at even steps.

    Args:
        tracks: N rows with identities of the tracker, by frame. poses: of one component.
        frames: (F,) numbers to choose from, ascending, with a pose and a detector output.
    Returns:
        (K,) the selected numbers, ascending; (N,) rows in them that show an identity from a new
        direction, or one with too few selected frames. If all frames are selected: all rows of the
        frames.
    """
    options = options or FrameOptions()
    in_frames = np.flatnonzero(np.isin(tracks.frame, frames))
    informative = np.zeros(len(tracks), bool)
    if len(frames) <= options.all_of:
        informative[in_frames] = True
        return frames, informative
    tracks = tracks[in_frames]
    row, _ = place_of(poses, tracks.frame)
    img_from_world = (poses.camera.K @ poses.cam_from_world)[row]
    ray = viewing_rays(undistort_boxes(tracks.xyxy, poses.camera), img_from_world)
    identity = np.unique(tracks.track_id, return_inverse=True)[1]
    start = np.searchsorted(tracks.frame, frames)
    end = np.searchsorted(tracks.frame, frames, side="right")
    same = np.cos(np.radians(options.same_direction_deg))
    # rays of identities in selected frames
    seen = np.full((int(identity.max(initial=-1)) + 1, 16, 3), np.nan)
    count = np.zeros(len(seen), np.int64)
    chosen = np.zeros(len(frames), bool)
    last = -options.longest_step
    for k in range(len(frames)):
        rows = slice(start[k], end[k])
        ids = identity[rows]
        new = ~(np.einsum("nkj,nj->nk", seen[ids], ray[rows]) > same).any(1)
        few = count[ids] < options.identity_frames
        if 2 * new.sum() <= len(ids) and not few.any() and k - last < options.longest_step:
            continue
        chosen[k] = True
        last = k
        if count[ids].max(initial=0) == seen.shape[1]:
            seen = np.concatenate([seen, np.full_like(seen, np.nan)], 1)
        seen[ids, count[ids]] = ray[rows]
        count[ids] += 1
        informative[in_frames[rows]] = new | few
    others = np.flatnonzero(~chosen)
    missing = max(options.all_of - int(chosen.sum()), 0)
    chosen[others[np.linspace(0, len(others) - 1, missing).round().astype(np.int64)]] = True
    return frames[chosen], informative


def only_frames(poses: Poses, frames: IntArray) -> Poses:
    """Remove the poses of all other frames."""
    other = ~np.isin(poses.frame, frames)[:, None, None]
    return dataclasses.replace(poses, cam_from_world=np.where(other, np.nan, poses.cam_from_world))


# ---- Occlusion ----

# Offsets from the edge, over the size of the box: outside, where an occluder must be, and inside,
# where none may be: the outline of the occluder is not known better
BESIDE_EDGE = (0.1, -0.2)
# Fraction of its height that a box may end above the lower edge of its object and still show all of
# it (on hololens_kitchen .05 to .2 are alike)
ABOVE_FLOOR = 0.1


def occluded_edges(
    views: Views, ellipsoids: quadrics.Ellipsoids, standing: BoolArray, floor_known: bool = True
) -> BoolArray:
    """Mark box edges where the object is occluded rather than ends.

    Args:
        ellipsoids: of the G groups of the views, NaN where unknown: they occlude nothing.
        standing: (G,) of a category that stands on the floor. floor_known: where it is.
    Returns:
        (V, G, 4) left, upper, right and lower edge.
    """
    projected = quadrics.solid_boxes(ellipsoids, "box", views.img_from_world)
    above = edges_above_floor(views.boxes, quadrics.clip_boxes(projected, views.image_size))
    above &= (standing & floor_known)[:, None]
    return _occluded_by_nearer(views, ellipsoids, standing) | above


def edges_above_floor(boxes: Array, projected: Array) -> BoolArray:
    """Mark the unreliable edges of boxes (..., 4) that end above the floor.

    The lower part of a floor-standing object is occluded then. It may be the wider one: of a chair
    at a table only the back is visible.

    Args:
        projected: (..., 4) boxes of the projected objects, which extend down to the floor.
    Returns:
        (..., 4) left, upper, right and lower edge.
    """
    height = projected[..., 3] - projected[..., 1]
    above = boxes[..., 3] < projected[..., 3] - ABOVE_FLOOR * height
    return np.asarray(above[..., None] & np.array([True, False, True, True]), bool)


def _occluded_by_nearer(
    views: Views, ellipsoids: quadrics.Ellipsoids, standing: BoolArray
) -> BoolArray:
    """Mark box edges (V, G, 4) with a nearer object just outside and none just inside.

    A nearer object is there if it covers half of the points beside the edge or more. One that is
    behind the object at the points inside carries it, and hides nothing, unless the object stands
    on the floor.
    """
    occluded = np.zeros(views.boxes.shape, bool)
    known = np.isfinite(ellipsoids.half_axes.sum(1) + ellipsoids.center_in_world.sum(1))
    seen = np.isfinite(views.boxes.sum(2)) & known  # (V, G)
    column = np.cumsum(known) - 1  # (G,) number among the S known shapes
    shapes = ellipsoids[known]
    outline = quadrics.solid_boxes(shapes, "box", views.img_from_world)  # (V, S, 4)
    for v in np.flatnonzero(seen.any(1)):
        camera = views.img_from_world[v]  # (D,)
        groups = np.flatnonzero(seen[v])
        points = _beside_edges(views.boxes[v, groups])  # (2, D, 4, P, 2)
        aside = (outline[v, :, :2] > points.max((0, 1, 2, 3))).any(1)
        aside |= (outline[v, :, 2:] < points.min((0, 1, 2, 3))).any(1)
        candidates = np.flatnonzero(~aside)  # (N,) shapes that some of the rays may hit
        depth = shapes.center_in_world @ camera[2, :3] + camera[2, 3]  # (S,)
        entry = entry_depths(points.reshape(-1, 2), camera, shapes[candidates])
        entry = entry.reshape(*points.shape[:4], -1)  # (2, D, 4, P, N)
        itself = candidates == column[groups, None]  # (D, N)
        entry = np.where(itself[:, None, None], np.inf, entry)
        outside, inside = entry < depth[column[groups], None, None, None]  # (D, 4, P, N)
        carries = np.isfinite(entry[1]) & ~inside & ~standing[groups, None, None, None]
        outside &= ~carries
        covered = [hit.any(3).mean(2) >= 0.5 for hit in (outside, inside)]  # (D, 4)
        occluded[v, groups] = covered[0] & ~covered[1]
    return occluded


def _beside_edges(box: Array) -> Array:
    """Return points (2, D, 4, P, 2) along the edges of boxes (D, 4), for each `BESIDE_EDGE`."""
    low = box[:, None, :2]  # (D, 1, 2)
    high = box[:, None, 2:]
    point = (np.arange(8) + 0.5) / 8  # (P,) of the length of an edge; more take more time
    along = low + (high - low) * point[:, None]  # (D, P, 2)
    found = []
    for beyond in BESIDE_EDGE:
        off = beyond * (high - low)
        sides = np.tile(along[:, None], (1, 4, 1, 1))  # (D, 4, P, 2)
        for k in (0, 1):
            sides[:, k, :, k] = (low - off)[..., k]
            sides[:, k + 2, :, k] = (high + off)[..., k]
        found.append(sides)
    return np.stack(found)


def entry_depths(points: Array, camera: Array, boxes: quadrics.Ellipsoids) -> Array:
    """Return the depths (K, S) where rays of image points (K, 2) enter boxes; inf: no hit."""
    inverse = np.linalg.inv(camera[:, :3])
    ray = np.column_stack([points, np.ones(len(points))]) @ inverse.T  # (K, 3), of depth 1
    start = -inverse @ camera[:, 3] - boxes.center_in_world  # (S, 3)
    start = np.einsum("sij,si->sj", boxes.world_from_obj, start)
    ray = np.einsum("sij,ki->ksj", boxes.world_from_obj, ray)  # (K, S, 3)
    faces = np.stack([-boxes.half_axes - start, boxes.half_axes - start]).transpose(0, 2, 1)
    ray = np.ascontiguousarray(ray.transpose(2, 0, 1))  # (3, K, S): short axes first are fast
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = faces[:, :, None] / ray  # (2, 3, K, S)
    enter = ends.min(0).max(0)  # (K, S)
    leave = ends.max(0).min(0)
    return np.where((enter < leave) & (leave > 0), np.maximum(enter, 0), np.inf)


# Largest distance of a ray from the centre, over the half axes (larger: more points, but also rays
# beside an object that fills its ellipsoid poorly)
MIDDLE = 0.6
# Least distance behind the object, over that from the camera (smaller: errors of depth count)
BEHIND = 0.05
# Ratio of points behind to points on an object that exists (measured: chairs, tables 1.8)
HOLES = 2.0
PRIOR_POINTS = 10.0  # added to both counts: few points are no evidence (5 and 10 are alike)


def see_through_ratio(
    ellipsoids: quadrics.Ellipsoids,
    expected: BoolArray,
    poses: Poses,
    frame: IntArray,
    most_points: int = 500,
) -> Array:
    """Measure how many sparse points are seen behind objects, compared with on or before them.

    Args:
        ellipsoids: O. expected: (V, O) frames in which the objects should be visible.
        poses: with points and their visibility. frame: (V,) numbers.
        most_points: of a frame that are tested; more take more time.
    Returns:
        (O,) log ratio of points behind to the others on rays through the middle, at least 0.
    """
    visible = VisiblePoints(poses)
    row, _ = place_of(poses, frame)
    camera = invert_rigid(poses.cam_from_world[row])[:, :, 3]  # (V, 3)
    behind, others = np.zeros((2, expected.shape[1]))
    for v in np.flatnonzero(expected.any(1)):
        points = visible.observed(row[v])
        if not len(points):
            continue
        objects = np.flatnonzero(expected[v])
        ray = poses.points[points[:: len(points) // most_points + 1]] - camera[v]  # (N, 3)
        scaled = ellipsoids.world_from_obj[objects] / ellipsoids.half_axes[objects][:, None]
        start = np.einsum("si,sij->sj", camera[v] - ellipsoids.center_in_world[objects], scaled)
        along = np.einsum("ni,sij->nsj", ray, scaled)  # in units of the half axes: unit spheres
        a = (along**2).sum(2)  # (N, S)
        b = (along * start).sum(2)
        square = (start**2).sum(1)
        root = np.sqrt((b**2 - a * (square - 1)).clip(0))
        leave = (root - b) / a  # the point is at 1
        middle = (square - b**2 / a < MIDDLE**2) & (leave > 0)
        passes = leave < 1 - BEHIND
        behind[objects] += (middle & passes).sum(0)
        others[objects] += (middle & ~passes).sum(0)
    return np.log((behind + PRIOR_POINTS) / (HOLES * others + PRIOR_POINTS)).clip(0)
