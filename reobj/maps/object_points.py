"""Own points of objects: triangulated from enlarged boxes, and recognised where an object moved.

Objects are small in the images that the reconstruction uses, so it has few points of them. Here
some boxes of each object, from directions that differ, are enlarged before features are detected.
The features of one object are matched between its views under the epipolar constraint, and give
points of a map.

In the next recording the features in the boxes of a found object are matched to the points of a map
object. Matches that agree with the old place are evidence that it stayed. The others give the pose
of the cameras, as one rig, relative to the points at their old place: that pose is the rigid motion
of the object. At least two images must agree with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, import_pycolmap, invert_rigid
from reobj.files import Progress
from reobj.maps.compare import FoundObject, PointMotion
from reobj.maps.fusion import ObjectState, scaled_radius, shapes_of
from reobj.maps.placement import (
    best_features,
    described_points,
    of_frames,
    transformed,
    unit_descriptors,
)
from reobj.maps.room_map import MapPoints
from reobj.results.result import Object
from reobj.sources.video import Video
from reobj.types import Array, BoolArray, Floats, Frame, IntArray, Tracks
from reobj.words import merged

# ---- Constants of features ----
VIEWS = 12  # boxes of each object that are described
APART_DEG = 15.0  # difference of direction from which on only the size of a box counts
# Longer side to which a small box is enlarged, by ENLARGE at most; larger ones are shrunk to twice
# of it
SIDE_PX = 160.0
ENLARGE = 4.0
MARGIN_PX = 6.0  # around a box, for the surroundings of features near its border
CONTRAST = 0.01  # of SIFT (OpenCV's default: .04)
MOST = 150  # features of a box, the strongest
# ---- of points ----
POINT_ANGLE = 0.7  # largest angle between descriptors of one point, radians
POINT_ERROR_PX = 1.5  # largest reprojection error, px of an image 640 px wide
LEAST_VIEWS = 3  # of a point
PARALLAX_DEG = 3.0  # least largest angle between the rays of a point
INSIDE = 1.2  # of the half axes; points farther out are of something else
# ---- of motions ----
# An object has obviously stayed, and its points are not needed, if its centre is displaced by less
# than this share of its largest half axis
IN_PLACE = 0.25
# Largest ratio of the angles to the best point of the map object and to the best other point: of
# the background, of an object of another class, or of the same object at another place of it.
# (Objects of the same class do not compete: the points of identical instances have the same
# descriptors.)
RATIO = 0.85
ANGLE = 0.6  # largest angle between descriptors, radians
SAME_POINT = 0.05  # cells of this share of the largest half axis hold one point
OWN_SPREAD = 0.25  # of the largest half axis: points of an object nearer than this do not compete
# Largest error of an inlier, px of an image 640 px wide. (With 6 px, as in the placement, any few
# points fit on a small object.)
ERROR_PX = 3.0
POINTS = 5  # least different points of a map object
INLIERS = 2  # least in an image that agrees
AGREEING = 2  # least images that agree
TRIALS = 2000  # of RANSAC; enough for 15 % of inliers: (1 - .15^3)^2000 = .1 %
TILT_DEG = 25.0  # an object that is turned over more than this needs TILTED points
TILTED = 12
# Share of the height over the lower end of the object, below which its points may belong to the
# surface that it stands on
BOTTOM = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView:
    """Features in a box of an object.

    Attributes:
        row: of the frame in the poses. identity: of the object.
        xy: (n, 2) native pixels, COLMAP's. descriptor: (n, 128) RootSIFT x 512.
    """

    row: int
    identity: int
    xy: Array
    descriptor: npt.NDArray[np.uint8]


# ---- Features ----------------------------------------------------------------------------------


def object_views(
    objects: Sequence[Object], poses: Poses, tracks: Tracks, video: Video, line: Progress
) -> list[ObjectView]:
    """Describe some boxes of each object, large ones from different directions.

    Args:
        objects: with a shape, in the world of the poses; `tracks` has their boxes, native pixels.
    """
    usable = np.flatnonzero(poses.measured & (poses.part == 0)).tolist()
    row_of = {int(poses.frame[k]): k for k in usable}
    tracks = tracks[(tracks.detection_index >= 0) & np.isin(tracks.frame, poses.frame[usable])]
    size = np.sqrt(np.prod(tracks.xyxy[:, 2:] - tracks.xyxy[:, :2], axis=1))
    centre = invert_rigid(poses.cam_from_world)[[row_of[f] for f in tracks.frame.tolist()], :, 3]
    of_frame: dict[int, list[tuple[int, Array]]] = {}
    for o in objects:
        rows = np.flatnonzero(tracks.track_id == o.id)
        for k in rows[_spread(centre[rows] - np.asarray(o.center), size[rows])].tolist():
            of_frame.setdefault(int(tracks.frame[k]), []).append((o.id, tracks.xyxy[k]))

    def describe(frame: Frame) -> list[ObjectView]:
        image = np.ascontiguousarray(frame.image)
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        return [
            ObjectView(row_of[frame.index], identity, *_features(gray, box))
            for identity, box in of_frame[frame.index]
        ]

    return list(itertools.chain.from_iterable(of_frames(video, of_frame, describe, line)))


def _spread(ray: Array, size: Array) -> list[int]:
    """Choose views by rays (n, 3) to the cameras and sizes (n,), one after the other."""
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-9)
    chosen = list[int]()
    nearest = np.full(len(ray), np.inf)
    for _ in range(min(VIEWS, len(ray))):
        worth = np.minimum(nearest, np.radians(APART_DEG)) * size
        if worth.max() <= 0:
            break
        chosen.append(int(worth.argmax()))
        nearest = np.minimum(nearest, np.arccos((ray @ ray[chosen[-1]]).clip(-1, 1)))
    return chosen


def _features(gray: npt.NDArray[np.uint8], box: Array) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return positions (n, 2) in native pixels and RootSIFT descriptors (n, 128) in a box."""
    side = float(max(box[2] - box[0], box[3] - box[1], 1.0))
    scale = min(float(np.clip(SIDE_PX / side, 1.0, ENLARGE)), 2 * SIDE_PX / side)
    low = np.floor((box[:2] - MARGIN_PX).clip(0)).astype(int)
    high = np.ceil(np.minimum(box[2:] + MARGIN_PX, gray.shape[::-1])).astype(int)
    found = None
    if (high - low >= 4).all():
        size = np.maximum(np.round((high - low) * scale), 1).astype(int)
        sampling = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
        crop = gray[low[1] : high[1], low[0] : high[0]]
        crop = np.asarray(cv2.resize(crop, size.tolist(), interpolation=sampling), np.uint8)
        sift: Any = cv2.SIFT.create(nfeatures=MOST, contrastThreshold=CONTRAST)
        keypoints, found = sift.detectAndCompute(crop, None)
    if found is None:
        return np.empty((0, 2)), np.empty((0, 128), np.uint8)
    xy = (np.array([k.pt for k in keypoints]) + 0.5) * ((high - low) / size) + low
    inside = ((xy >= box[:2] - 1) & (xy <= box[2:] + 1)).all(1)
    root = np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-9)) * 512
    return xy[inside], np.minimum(root[inside], 255).astype(np.uint8)


# ---- Points ------------------------------------------------------------------------------------


def triangulated(objects: Sequence[Object], views: Sequence[ObjectView], poses: Poses) -> MapPoints:
    """Triangulate features that the views of an object have in common.

    Returns:
        points with the identity of their object, in the world of the poses; session 0.
    """
    tables = [MapPoints.empty()]
    for o in objects:
        of_object = [v for v in views if v.identity == o.id and len(v.xy)]
        if len(of_object) >= LEAST_VIEWS:
            tables.append(_points_of(o, _Rays(of_object, poses)))
    return MapPoints.joined(tables)


class _Rays:
    """Viewing rays of the features of one object.

    Attributes:
        view: (n,) index. start, direction: (n, 3) of unit rays. unit: (n, 128) descriptors.
        px: length at unit depth that is one pixel of an image 640 px wide.
    """

    def __init__(self, views: Sequence[ObjectView], poses: Poses) -> None:
        camera = poses.camera
        xy = camera.undistort(np.concatenate([v.xy for v in views]))
        known = np.isfinite(xy).all(1)
        self.view = np.repeat(np.arange(len(views)), [len(v.xy) for v in views])[known]
        self.unit = unit_descriptors(np.concatenate([v.descriptor for v in views]))[known]
        world_from_cam = invert_rigid(poses.cam_from_world[[v.row for v in views]])[self.view]
        in_cam = np.column_stack([xy, np.ones(len(xy))])[known] @ np.linalg.inv(camera.K).T
        in_world = np.einsum("nij,nj->ni", world_from_cam[:, :, :3], in_cam)
        self.start = world_from_cam[:, :, 3]
        self.direction = in_world / np.linalg.norm(in_world, axis=1, keepdims=True)
        self.px = max(camera.width, camera.height) / 640 / float(camera.K[0, 0])


def _points_of(found: Object, rays: _Rays) -> MapPoints:
    """Triangulate the points of one object, and give them mean descriptors."""
    partners: list[list[int]] = [[] for _ in range(len(rays.view))]
    for i, j in zip(*_pairs(rays, shapes_of([found])), strict=True):
        partners[i].append(j)
        partners[j].append(i)
    free = np.ones(len(rays.view), bool)
    xyz = list[Array]()
    tracks = list[IntArray]()
    for seed in np.argsort([-len(p) for p in partners], kind="stable").tolist():
        rows = np.array([seed, *partners[seed]])
        point, rows = _triangulated(rays, rows[free[rows] & free[seed]])
        if len(rows):
            free[rows] = False
            xyz.append(point)
            tracks.append(rows)
    if not tracks:
        return MapPoints.empty()
    return described_points(
        np.array(xyz),
        np.array([rays.unit[rows].mean(0) for rows in tracks]),
        np.array([rays.direction[rows].mean(0) for rows in tracks]),
        np.array([
            np.median(np.linalg.norm(point - rays.start[rows], axis=1))
            for point, rows in zip(xyz, tracks, strict=True)
        ]),
        found.id,
    )  # fmt: skip


def _pairs(rays: _Rays, shape: quadrics.Ellipsoids) -> tuple[list[int], list[int]]:
    """Find pairs of features of two views that may be one point.

    Each feature is paired with the most similar one of another view that meets the epipolar
    constraint inside the object, if the choice is mutual.
    """
    cosine = rays.unit @ rays.unit.T
    i, j = np.nonzero((cosine > np.cos(POINT_ANGLE)) & (rays.view[:, None] < rays.view))
    a = rays.direction[i]
    b = rays.direction[j]
    between = rays.start[j] - rays.start[i]
    cross = (a * b).sum(1)
    sine = 1 - cross**2  # squared
    good = sine > np.sin(np.radians(PARALLAX_DEG / 2)) ** 2
    sine = np.where(good, sine, 1.0)
    of_a = (between * a).sum(1)
    of_b = (between * b).sum(1)
    depth_a = (of_a - cross * of_b) / sine  # where the rays are nearest to each other
    depth_b = (cross * of_a - of_b) / sine
    on_a = rays.start[i] + depth_a[:, None] * a
    on_b = rays.start[j] + depth_b[:, None] * b
    gap = np.linalg.norm(on_a - on_b, axis=1) / 2
    depth = np.minimum(depth_a, depth_b)
    good &= (gap < POINT_ERROR_PX * rays.px * depth) & (depth > 0)
    good &= scaled_radius((on_a + on_b) / 2, shape, 0) < INSIDE**2
    order = np.argsort(-cosine[i[good], j[good]], kind="stable")
    i = i[good][order]
    j = j[good][order]
    count = int(rays.view.max(initial=0)) + 1
    _, best_of_i = np.unique(i * count + rays.view[j], return_index=True)
    _, best_of_j = np.unique(j * count + rays.view[i], return_index=True)
    mutual = np.intersect1d(best_of_i, best_of_j)
    return i[mutual].tolist(), j[mutual].tolist()


def _triangulated(rays: _Rays, rows: IntArray) -> tuple[Array, IntArray]:
    """Triangulate rows of features that may be one point (3,); rows that agree, or no rows."""
    nothing = np.empty(0), rows[:0]
    for _ in range(3):
        if len(rows) < LEAST_VIEWS:
            return nothing
        direction = rays.direction[rows]
        across = np.eye(3) - direction[:, :, None] * direction[:, None]  # (k, 3, 3)
        start = np.einsum("kij,kj->i", across, rays.start[rows])
        point = np.linalg.solve(across.sum(0) + 1e-12 * np.eye(3), start)
        away = point - rays.start[rows]
        depth = (away * direction).sum(1)
        off = np.linalg.norm(away - depth[:, None] * direction, axis=1)
        good = (off / np.maximum(depth, 1e-9) / rays.px < POINT_ERROR_PX) & (depth > 0)
        if good.all():
            widest = float((direction @ direction.T).min())
            return (point, rows) if widest <= np.cos(np.radians(PARALLAX_DEG)) else nothing
        rows = rows[good]
    return nothing


# ---- Motions -----------------------------------------------------------------------------------


def point_motions(
    points: MapPoints,
    states: Sequence[ObjectState],
    found: Sequence[FoundObject],
    views: Sequence[ObjectView],
    poses: Poses,
    up: Array | None,
) -> list[dict[int, PointMotion]]:
    """Find the motions of map objects by their points.

    Args:
        points: of the map. states, found: objects of the map and of the recording.
        views: features in boxes of the found objects. poses: in the world of the map.
        up: (3,) unit vector against gravity in the map; None: unknown.
    Returns:
        for each found object, the motions of map objects onto it, by their number.
    """
    motions: list[dict[int, PointMotion]] = [{} for _ in found]
    in_place = _in_place(states, found)
    search = _Search(points, states, np.flatnonzero(~in_place.any(1)).tolist())
    if not search.usable:
        return motions
    row_of = {o.id: j for j, o in enumerate(found) if not in_place[:, j].any()}
    matches: dict[tuple[int, int], list[tuple[int, Array, IntArray]]] = {}
    for view in views:
        for k, xy, point in search.match(view) if view.identity in row_of else ():
            matches.setdefault((k, row_of[view.identity]), []).append((view.row, xy, point))
    for (k, j), of_pair in sorted(matches.items(), key=lambda item: item[0]):
        row = np.repeat([r for r, _, _ in of_pair], [len(xy) for _, xy, _ in of_pair])
        xyz = search.points.xyz[np.concatenate([point for *_, point in of_pair])]
        pair = _Pair(states[k], found[j], row, np.concatenate([xy for _, xy, _ in of_pair]), xyz)
        motion = pair.motion(poses, up)
        if motion is not None:
            motions[j][states[k].id] = motion
    return motions


def _in_place(states: Sequence[ObjectState], found: Sequence[FoundObject]) -> BoolArray:
    """Mark pairs (N, M) of objects that have obviously stayed; their points are not needed.

    They have a class in common, their centres are nearer than a share of the largest half axis of
    both, and neither is as near to another object.
    """
    distance = np.full((len(states), len(found)), np.inf)
    for i, s in enumerate(states):
        for j, f in enumerate(found):
            away = float(np.linalg.norm(f.center - s.center))
            near = away < IN_PLACE * min(s.half_axes.max(), f.half_axes.max())
            if near and merged(s.classes).keys() & merged(f.classes).keys():
                distance[i, j] = away
    nearest = distance == distance.min(1, keepdims=True, initial=np.inf)
    nearest &= distance == distance.min(0, keepdims=True, initial=np.inf)
    return np.asarray(nearest & np.isfinite(distance))


class _Search:
    """Matches keypoints to the points of each map object.

    Args:
        wanted: rows of map objects.
    Attributes:
        points: of the map, ordered by object; `tagged`: first row of those that lie on objects.
        own: rows of the points of each map object at its last place.
        usable: rows of the wanted map objects with enough points.
    """

    def __init__(
        self, points: MapPoints, states: Sequence[ObjectState], wanted: Sequence[int]
    ) -> None:
        row_of = {s.id: k for k, s in enumerate(states)}
        owner = np.array([row_of.get(i, -1) for i in points.object_id.tolist()], np.int64)
        order = np.argsort(owner, kind="stable")
        self.points = points[order]
        owner = owner[order]
        self.tagged = int((owner < 0).sum())
        self.descriptor = unit_descriptors(self.points.descriptor)
        shapes = shapes_of(states)
        self.own = list[IntArray]()
        for k in range(len(states)):
            rows = np.flatnonzero(owner == k)
            self.own.append(rows[scaled_radius(self.points.xyz[rows], shapes, k) < 1.1**2])
        self.usable = [k for k in wanted if len(self.own[k]) >= POINTS]
        names = [merged(s.classes).keys() for s in states]
        groups, self.first = np.unique(owner, return_index=True)
        rivals = [[g < 0 or not mine & names[g] for g in groups] for mine in names]
        self.rivals = [np.flatnonzero(row) for row in rivals]
        self.apart = [OWN_SPREAD * float(s.half_axes.max()) for s in states]

    def match(self, view: ObjectView) -> list[tuple[int, Array, IntArray]]:
        """Match the features in a box to map objects.

        Returns:
            of each object with matches its row, positions (n, 2), and rows of points (n,).
        """
        unit = unit_descriptors(view.descriptor)
        least = float(np.cos(ANGLE))
        on_objects = unit @ self.descriptor[self.tagged :].T  # (n, tagged)
        similar = np.flatnonzero(on_objects.max(1, initial=-1.0) > least)
        if len(similar) < INLIERS:
            return []
        on_none = unit[similar] @ self.descriptor[: self.tagged].T
        cosine = np.hstack([on_none, on_objects[similar]])  # (n, N)
        best_of_group = np.maximum.reduceat(cosine, self.first, axis=1)  # (n, G)
        matches = []
        for k in self.usable:
            own = cosine[:, self.own[k]]
            rows = np.flatnonzero(own.max(1) > least)
            rival = best_of_group[np.ix_(rows, self.rivals[k])].max(1, initial=-1.0)
            feature, best = self._of_object(k, own[rows], rival)
            if len(feature) >= INLIERS:
                matches.append((k, view.xy[similar[rows[feature]]], self.own[k][best]))
        return matches

    def _of_object(self, k: int, own: Floats, rival: Floats) -> tuple[IntArray, IntArray]:
        """Match features to the points of a map object; each point keeps its best feature.

        Args:
            own: (n, P) cosines of its points. rival: (n,) best cosine of the points of others.
        """
        best = own.argmax(1)
        xyz = self.points.xyz[self.own[k]]
        apart = np.linalg.norm(xyz[best, None] - xyz[None], axis=2) > self.apart[k]  # (n, P)
        rival = np.maximum(rival, np.where(apart, own, -1.0).max(1))
        angle = np.arccos(own.max(1).clip(-1, 1))
        good = np.flatnonzero(angle < RATIO * np.arccos(rival.clip(-1, 1)))
        feature = best_features(good, best, angle)
        return feature, best[feature]


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Matches of the points of a map object in the boxes of a found object.

    Attributes:
        row: (n,) of the image in the poses. xy: (n, 2) native pixels. xyz: (n, 3) of the points.
    """

    state: ObjectState
    found: FoundObject
    row: IntArray
    xy: Array
    xyz: Array

    def motion(self, poses: Poses, up: Array | None) -> PointMotion | None:
        """Return the motion of the map object that most points follow; None: no images agree."""
        limit = ERROR_PX * max(max(poses.camera.width, poses.camera.height) / 640, 1.0)
        in_place = self._errors(self.xyz, poses) < limit
        still = self._stayed(in_place, poses, up, limit)
        moved = self._moved(self._agreeing(~in_place), poses, up, limit)
        if still is None or moved is None:
            return still or moved
        return max(still, moved, key=lambda m: m.inliers)

    def _errors(self, xyz: Array, poses: Poses) -> Array:
        """Return reprojection errors (n,) in native pixels; infinite out of view."""
        pose = poses.cam_from_world[self.row]
        in_cam = np.einsum("nij,nj->ni", pose[:, :, :3], xyz) + pose[:, :, 3]
        error = np.linalg.norm(poses.camera.project(in_cam) - self.xy, axis=1)
        return np.asarray(np.nan_to_num(error, nan=np.inf))

    def _agreeing(self, mask: BoolArray) -> BoolArray:
        """Restrict matches (n,) to the images that have enough of them."""
        count = np.bincount(self.row[mask], minlength=self.row.max() + 1)
        return np.asarray(mask & (count >= INLIERS)[self.row])

    def _counts(self, mask: BoolArray) -> tuple[int, int]:
        """Count different points among matches (n,), as the map may have one several times.

        Returns:
            points, and images; zeros if these are too few.
        """
        cell = SAME_POINT * float(self.state.half_axes.max())
        points = len(np.unique(np.round((self.xyz[mask] - self.state.center) / cell), axis=0))
        images = len(np.unique(self.row[mask]))
        return (points, images) if points >= POINTS and images >= AGREEING else (0, 0)

    def _stayed(
        self, in_place: BoolArray, poses: Poses, up: Array | None, limit: float
    ) -> PointMotion | None:
        """Count the points of the object that are where they were."""
        center = self.state.center
        if up is not None:
            axes = shapes_of([self.state]).world_from_obj[0]
            half = np.linalg.norm(up @ axes * self.state.half_axes)  # of the ellipsoid along `up`
            in_place = in_place & ((self.xyz - center) @ up > (2 * BOTTOM - 1) * half)
        in_place = self._agreeing(in_place)
        count, images = self._counts(in_place)
        if not count or not self._coincides(center, 1.0):
            return None
        camera_at = invert_rigid(poses.cam_from_world[np.unique(self.row)])[:, :, 3]
        distance = float(np.median(np.linalg.norm(camera_at - center, axis=1)))
        # a smaller displacement cannot be measured: uniform within the limit of the error
        sigma = limit / poses.camera.K[0, 0] * distance / np.sqrt(3)
        return PointMotion(count, images, np.zeros(3), float(sigma) ** 2 * np.eye(3))

    def _moved(
        self, mask: BoolArray, poses: Poses, up: Array | None, limit: float
    ) -> PointMotion | None:
        """Find the motion of points that are not where they were, from all images at once.

        The images are a rig of cameras with known poses in the map: its pose relative to the points
        at their old place is the motion.
        """
        if not self._counts(mask)[0]:
            return None
        pc = import_pycolmap()
        center = self.state.center
        rows, image = np.unique(self.row[mask], return_inverse=True)
        estimate = pc.estimate_and_refine_generalized_absolute_pose(
            self.xy[mask], self.xyz[mask] - center, image,
            [pc.Rigid3d(pose) for pose in poses.cam_from_world[rows]],
            [poses.camera.to_pycolmap()] * len(rows),
            estimation_options={"max_error": limit, "random_seed": 0, "max_num_trials": TRIALS},
            return_covariance=True,
        )  # fmt: skip
        if estimate is None:
            return None
        motion = np.array(estimate["rig_from_world"].matrix(), np.float64)  # about the centre
        if not np.isfinite(motion).all() or not self._coincides(motion[:, 3], 0.5):
            return None
        inlier = mask.copy()
        inlier[mask] = np.asarray(estimate["inlier_mask"], bool)
        count, images = self._counts(self._agreeing(inlier))
        tilted = up is not None and up @ motion[:, :3] @ up <= np.cos(np.radians(TILT_DEG))
        if not count or (tilted and count < TILTED):
            return None
        error = self._errors(transformed(motion, self.xyz - center), poses)[inlier]
        variance = float((error**2).mean() / 2)  # of a coordinate, px^2
        # the error of a point of the map is common to all images of it
        repeated = float(inlier.sum() / len(np.unique(self.xyz[inlier], axis=0)))
        cov = np.asarray(estimate["covariance"], np.float64)[3:, 3:] * variance * repeated
        return PointMotion(count, images, motion[:, 3] - center, cov)

    def _coincides(self, center: Array, share: float) -> bool:
        """Return whether the map object with its centre there is the found one, not beside it.

        The centres are nearer than a share of the largest half axis of the smaller object;
        uncertainty at most doubles it. (The points of a cup on a table are in the box of the table,
        and keys of a keyboard look alike.)
        """
        offset = center - self.found.center
        distance = float(np.linalg.norm(offset))
        reach = share * min(float(o.half_axes.max()) for o in (self.state, self.found))
        along = offset / max(distance, 1e-9)
        variance = float(along @ (self.found.cov[:3, :3] + self.state.cov[:3, :3]) @ along)
        sigma = np.sqrt(max(variance, 0.0)) if np.isfinite(variance) else 0.0
        return bool(distance < reach + min(2 * sigma, reach))
