"""Motion of map objects, by their points that images of the recording show on a found object.

The keypoints in the boxes of a found object are matched to the points of a map object. Matches that
agree with the old place are evidence that it stayed. The others give the pose of the cameras, as
one rig, relative to the points at their old place: that pose is the rigid motion of the object. At
least two images must agree with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import quadrics
from reobj.cameras import Camera, Poses, import_pycolmap
from reobj.maps.compare import FoundObject, PointMotion
from reobj.maps.fusion import ObjectState, scaled_radius, shapes_of
from reobj.maps.object_points import ObjectView
from reobj.maps.placement import best_features, unit_descriptors
from reobj.maps.room_map import MapPoints
from reobj.types import Array, BoolArray, Floats, IntArray
from reobj.words import merged

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
# Share of the height over the lower end of the object, below which its points may belong to what
# it stands on
BOTTOM = 0.15


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
    search = _Search(points, states, up)
    motions: list[dict[int, PointMotion]] = [{} for _ in found]
    in_place = _in_place(states, found)
    search.usable = [k for k in search.usable if not in_place[k].any()]
    if not search.usable:
        return motions
    row_of = {o.id: j for j, o in enumerate(found) if not in_place[:, j].any()}
    matches: dict[tuple[int, int], list[_View]] = {}
    for view in views:
        for k, match in search.match(view, poses) if view.identity in row_of else ():
            matches.setdefault((k, row_of[view.identity]), []).append(match)
    for (k, j), of_pair in sorted(matches.items()):
        motion = _motion(states[k], found[j], of_pair, poses.camera, up)
        if motion is not None:
            motions[j][states[k].id] = motion
    return motions


def _in_place(
    states: Sequence[ObjectState], found: Sequence[FoundObject], share: float = 0.25
) -> BoolArray:
    """Mark pairs (N, M) of objects that have obviously stayed; their points are not needed.

    They have a class in common, their centres are nearer than a share of the largest half axis of
    both, and neither is as near to another object.
    """
    offset = np.array([[f.center - s.center for f in found] for s in states])
    distance = np.linalg.norm(offset.reshape(len(states), len(found), 3), axis=2)
    reach = np.array(
        [[min(s.half_axes.max(), f.half_axes.max()) for f in found] for s in states]
    ).reshape(distance.shape)
    of_states = [merged(s.classes).keys() for s in states]
    of_found = [merged(f.classes).keys() for f in found]
    common = np.array([[not a.isdisjoint(b) for b in of_found] for a in of_states], bool)
    common = common.reshape(distance.shape)
    distance = np.where(common & (distance < share * reach), distance, np.inf)
    nearest = (distance == distance.min(1, keepdims=True, initial=np.inf)) & (
        distance == distance.min(0, keepdims=True, initial=np.inf)
    )
    return np.asarray(nearest & np.isfinite(distance))


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Matches of one map object in the box of a found object.

    Attributes:
        pose: (3, 4) cam_from_map. xy: (n, 2) native pixels. point: (n,) rows of the map's points;
        xyz: (n, 3). still: (n,) bool: it agrees with the old place. above: (n,) bool: not near the
            lower end of the object.
    """

    pose: Array
    xy: Array
    point: IntArray
    xyz: Array
    still: BoolArray
    above: BoolArray


# ---- Matches -----------------------------------------------------------------------------------


class _Search:
    """Matches keypoints to the points of each map object.

    Attributes:
        usable: rows of map objects with enough points. tagged: first row of points that lie on
            objects; those before it lie on none.
    """

    def __init__(
        self,
        points: MapPoints,
        states: Sequence[ObjectState],
        up: Array | None,
    ) -> None:
        row_of = {s.id: k for k, s in enumerate(states)}
        owner = np.array([row_of.get(int(i), -1) for i in points.object_id], np.int64)
        order = np.argsort(owner, kind="stable")
        self.points = points[order]
        self.owner = owner[order]
        self.tagged = int((owner < 0).sum())
        self.descriptor = unit_descriptors(self.points.descriptor)
        shapes = shapes_of(states)
        # an object that moved has points at its earlier places too: they are of no use
        owned = np.flatnonzero(self.owner >= 0)
        inside = np.zeros(len(self.owner), bool)
        inside[owned] = scaled_radius(self.points.xyz[owned], shapes, self.owner[owned]) < 1.1**2
        self.above = _above_bottom(self.points.xyz, self.owner, shapes, up)
        self.own = [np.flatnonzero((self.owner == k) & inside) for k in range(len(states))]
        self.usable = [k for k, rows in enumerate(self.own) if len(rows) >= POINTS]
        names = [merged(s.classes).keys() for s in states]
        self.group, self.first = np.unique(self.owner, return_index=True)
        self.rivals = np.array(
            [[g < 0 or not names[k] & names[g] for g in self.group] for k in range(len(states))]
        ).reshape(len(states), len(self.group))  # fmt: skip
        self.apart = OWN_SPREAD * np.array([s.half_axes.max() for s in states])

    def match(self, view: ObjectView, poses: Poses) -> list[tuple[int, _View]]:
        """Match the features in a box; return rows of map objects and their matches."""
        unit = unit_descriptors(view.descriptor)
        least = float(np.cos(ANGLE))
        on_objects = unit @ self.descriptor[self.tagged :].T  # (n, tagged)
        similar = np.flatnonzero(on_objects.max(1, initial=-1.0) > least)
        if len(similar) < INLIERS:
            return []
        unit = unit[similar]
        cosine = np.hstack([unit @ self.descriptor[: self.tagged].T, on_objects[similar]])  # (n, N)
        best_of_group = np.maximum.reduceat(cosine, self.first, axis=1)  # (n, G)
        pose = poses.cam_from_world[view.row]
        matches = []
        for k in self.usable:
            of_object = cosine[:, self.own[k]]
            rows = np.flatnonzero(of_object.max(1) > least)
            if len(rows) < INLIERS:
                continue
            rival = best_of_group[np.ix_(rows, np.flatnonzero(self.rivals[k]))].max(1, initial=-1.0)
            feature, point = self._of_object(k, of_object[rows], rival)
            if len(feature) < INLIERS:
                continue
            xyz = self.points.xyz[point]
            xy = view.xy[similar[rows[feature]]]
            still = _errors(xyz, xy, pose, poses.camera) < _limit(poses.camera)
            matches.append((k, _View(pose, xy, point, xyz, still, self.above[point])))
        return matches

    def _of_object(self, k: int, own: Floats, rival: Floats) -> tuple[IntArray, IntArray]:
        """Match features to the points of a map object; each point keeps its best feature.

        Args:
            own: (n, P) cosines of its points. rival: (n,) best cosine of the points of others.
        """
        rows = self.own[k]
        best = own.argmax(1)
        value = own[np.arange(len(own)), best]
        xyz = self.points.xyz[rows]
        apart = np.linalg.norm(xyz[best, None] - xyz[None], axis=2) > self.apart[k]  # (n, P)
        rival = np.maximum(rival, np.where(apart, own, -1.0).max(1))
        angle = np.arccos(value.clip(-1, 1))
        good = np.flatnonzero(angle < RATIO * np.arccos(rival.clip(-1, 1)))
        feature = best_features(good, best, angle)
        return feature, rows[best[feature]]


def _above_bottom(
    xyz: Array, owner: IntArray, shapes: quadrics.Ellipsoids, up: Array | None
) -> BoolArray:
    """Mark points (N,) that are above BOTTOM of the height of their object; all without `up`."""
    above = np.ones(len(xyz), bool)
    if up is None:
        return above
    rows = np.flatnonzero(owner >= 0)
    k = owner[rows]
    height = (xyz[rows] - shapes.center_in_world[k]) @ up
    axes = np.einsum("i,nij->nj", up, shapes.world_from_obj) * shapes.half_axes
    half = np.linalg.norm(axes, axis=1)[k]  # of the ellipsoid along `up`
    above[rows] = height > (2 * BOTTOM - 1) * half
    return above


def _errors(xyz: Array, xy: Array, cam_from_map: Array, camera: Camera) -> Array:
    """Return reprojection errors (n,) in native pixels; infinite out of view."""
    in_cam = xyz @ cam_from_map[:, :3].T + cam_from_map[:, 3]
    error = np.linalg.norm(camera.project(in_cam) - xy, axis=1)
    return np.asarray(np.nan_to_num(error, nan=np.inf))


def _limit(camera: Camera) -> float:
    """Return the largest error of an inlier in native pixels."""
    return ERROR_PX * max(max(camera.width, camera.height) / 640, 1.0)


# ---- Motion ------------------------------------------------------------------------------------


def _motion(
    state: ObjectState,
    found: FoundObject,
    views: Sequence[_View],
    camera: Camera,
    up: Array | None,
) -> PointMotion | None:
    """Return the motion of a map object that most points follow; None: no images agree."""
    still = _stayed(state, found, views, camera)
    moved = _moved(state, found, views, camera)
    if moved is not None and up is not None and moved.inliers < TILTED:
        upright = float(up @ moved.new_from_old[:, :3] @ up)
        moved = moved if upright > np.cos(np.radians(TILT_DEG)) else None
    if still is None or moved is None:
        return still or moved
    return max(still, moved, key=lambda m: m.inliers)


def _stayed(
    state: ObjectState,
    found: FoundObject,
    views: Sequence[_View],
    camera: Camera,
) -> PointMotion | None:
    """Count the points of an object that are where they were."""
    of_view = [v.xyz[v.still & v.above] for v in views]
    of_view = [xyz for xyz in of_view if len(xyz) >= INLIERS]
    if len(of_view) < AGREEING or not _coincide(state.center, state, found, 1.0):
        return None
    count = _distinct(np.concatenate(of_view), state)
    if count < POINTS:
        return None
    camera_at = np.array([-v.pose[:, :3].T @ v.pose[:, 3] for v in views])
    distance = float(np.median(np.linalg.norm(camera_at - state.center, axis=1)))
    # a smaller displacement cannot be measured: uniform within the limit of the error
    sigma = _limit(camera) / camera.K[0, 0] * distance / np.sqrt(3)
    return PointMotion(
        count, len(of_view), np.eye(3, 4), np.zeros(3), float(sigma) ** 2 * np.eye(3)
    )


def _moved(
    state: ObjectState,
    found: FoundObject,
    views: Sequence[_View],
    camera: Camera,
) -> PointMotion | None:
    """Find the motion of the points that are not where they were, from all images at once.

    The images are a rig of cameras with known poses in the map: its pose relative to the points at
    their old place is the motion.
    """
    pc = import_pycolmap()
    kept = [view for view in views if (~view.still).sum() >= INLIERS]
    if len(kept) < AGREEING:
        return None
    moving = [~view.still for view in kept]
    image = np.repeat(np.arange(len(kept)), [int(m.sum()) for m in moving])  # (n,)
    point = np.concatenate([v.point[m] for v, m in zip(kept, moving, strict=True)])
    if len(np.unique(point)) < POINTS:
        return None
    xyz = np.concatenate([v.xyz[m] for v, m in zip(kept, moving, strict=True)])
    xy = np.concatenate([v.xy[m] for v, m in zip(kept, moving, strict=True)])
    ransac = {"max_error": _limit(camera), "random_seed": 0,
              "max_num_trials": TRIALS}  # fmt: skip
    estimate = pc.estimate_and_refine_generalized_absolute_pose(
        xy, xyz - state.center, image,
        [pc.Rigid3d(v.pose) for v in kept], [camera.to_pycolmap()] * len(kept),
        estimation_options=ransac, return_covariance=True,
    )  # fmt: skip
    if estimate is None:
        return None
    motion = np.array(estimate["rig_from_world"].matrix(), np.float64)  # about the object's centre
    moved = motion[:, 3].copy()
    motion[:, 3] -= motion[:, :3] @ state.center
    if not np.isfinite(motion).all() or not _coincide(moved, state, found, 0.5):
        return None
    inlier = np.asarray(estimate["inlier_mask"], bool)
    agrees = np.bincount(image[inlier], minlength=len(kept)) >= INLIERS  # (L,)
    count = _distinct(xyz[inlier & agrees[image]], state)
    if agrees.sum() < AGREEING or count < POINTS:
        return None
    error = np.concatenate([
        _errors(v.xyz[m], v.xy[m], _composed(v.pose, motion), camera)
        for v, m in zip(kept, moving, strict=True)
    ])  # fmt: skip
    variance = float((error[inlier] ** 2).mean() / 2)  # of a coordinate, px^2
    # the error of a point of the map is common to all images of it
    repeated = float(inlier.sum() / len(np.unique(point[inlier])))
    cov = np.asarray(estimate["covariance"], np.float64)[3:, 3:] * variance * repeated
    return PointMotion(count, int(agrees.sum()), motion, moved - state.center, cov)


def _distinct(xyz: Array, state: ObjectState) -> int:
    """Count different places of points (n, 3): the map may have a point several times."""
    cell = SAME_POINT * float(state.half_axes.max())
    return len(np.unique(np.round((xyz - state.center) / cell), axis=0))


def _composed(cam_from_map: Array, motion: Array) -> Array:
    """Return the pose (3, 4) of a camera relative to the map before a motion (3, 4)."""
    turn = cam_from_map[:, :3] @ motion[:, :3]
    return np.column_stack([turn, cam_from_map[:, :3] @ motion[:, 3] + cam_from_map[:, 3]])


def _coincide(center: Array, state: ObjectState, found: FoundObject, share: float) -> bool:
    """Return whether a map object with its centre there is the found object, not one beside it.

    The centres are nearer than a share of the largest half axis of the smaller object; uncertainty
    at most doubles it. (The points of a cup on a table are in the box of the table, and keys of a
    keyboard look alike.)
    """
    offset = center - found.center
    distance = float(np.linalg.norm(offset))
    reach = min(float(state.half_axes.max()), float(found.half_axes.max()))
    reach *= share
    along = offset / max(distance, 1e-9)
    variance = float(along @ (found.cov[:3, :3] + state.cov[:3, :3]) @ along)
    sigma = np.sqrt(max(variance, 0.0)) if np.isfinite(variance) else 0.0
    return bool(distance < reach + min(2 * sigma, reach))
