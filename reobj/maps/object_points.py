"""Points of objects: features in their boxes, enlarged, and triangulated with the known cameras.

Objects are small in the images that the reconstruction uses, so it has few points of them. Here
some boxes of each object, from directions that differ, are enlarged before features are detected.
The features of one object are matched between its views under the epipolar constraint.
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
from reobj.cameras import Poses, invert_rigid
from reobj.files import Progress
from reobj.maps.fusion import scaled_radius, shapes_of
from reobj.maps.placement import described_points, of_frames, unit_descriptors
from reobj.maps.room_map import MapPoints
from reobj.results.result import Object
from reobj.sources.video import Video
from reobj.types import Array, Frame, IntArray, Tracks

VIEWS = 12  # boxes of each object that are described
APART_DEG = 15.0  # difference of direction from which on only the size of a box counts
# Longer side to which a small box is enlarged, by ENLARGE at most; larger ones are shrunk to twice
# of it
SIDE_PX = 160.0
ENLARGE = 4.0
CONTRAST = 0.01  # of SIFT (OpenCV's default: .04)
MOST = 150  # features of a box, the strongest
ANGLE = 0.7  # largest angle between descriptors of one point, radians
ERROR_PX = 1.5  # largest reprojection error, px of an image 640 px wide
LEAST_VIEWS = 3  # of a point
PARALLAX_DEG = 3.0  # least largest angle between the rays of a point
INSIDE = 1.2  # of the half axes; points farther out are of something else


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView:
    """Features in a box of an object.

    Attributes:
        row: of the frame in the poses. identity: of the object. box: (4,) native pixels.
        xy: (n, 2) native pixels, COLMAP's. descriptor: (n, 128) RootSIFT x 512.
    """

    row: int
    identity: int
    box: Array
    xy: Array
    descriptor: npt.NDArray[np.uint8]


# ---- Features ----------------------------------------------------------------------------------


def object_views(
    objects: Sequence[Object],
    poses: Poses,
    tracks: Tracks,
    video: Video,
    line: Progress,
) -> list[ObjectView]:
    """Describe some boxes of each object, large ones from different directions.

    Args:
        objects: with a shape, in the world of the poses; `tracks` has their boxes, native pixels.
    """
    usable = np.flatnonzero(poses.measured & (poses.part == 0)).tolist()
    row_of = {int(poses.frame[k]): k for k in usable}
    centre = invert_rigid(poses.cam_from_world)[:, :, 3]
    of_frame: dict[int, list[tuple[int, Array]]] = {}
    for o in objects:
        rows = np.flatnonzero((tracks.track_id == o.id) & (tracks.detection_index >= 0))
        rows = rows[[int(f) in row_of for f in tracks.frame[rows]]] if len(rows) else rows
        if o.center is None or not len(rows):
            continue
        boxes = tracks.xyxy[rows]
        ray = centre[[row_of[int(f)] for f in tracks.frame[rows]]] - o.center
        for k in _spread(ray, np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1))):
            of_frame.setdefault(int(tracks.frame[rows[k]]), []).append((o.id, boxes[k]))

    def describe(frame: Frame) -> list[ObjectView]:
        image = np.ascontiguousarray(frame.image)
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        return [
            ObjectView(row_of[frame.index], identity, box, *_features(gray, box))
            for identity, box in of_frame[frame.index]
        ]

    return list(itertools.chain.from_iterable(of_frames(video, of_frame, describe, line)))


def _spread(ray: Array, size: Array) -> list[int]:
    """Choose views by rays (n, 3) to the cameras and sizes (n,), one after the other."""
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-9)
    chosen = [int(size.argmax())]
    nearest = np.full(len(ray), np.inf)
    while len(chosen) < min(VIEWS, len(ray)):
        nearest = np.minimum(nearest, np.arccos((ray @ ray[chosen[-1]]).clip(-1, 1)))
        worth = np.minimum(nearest, np.radians(APART_DEG)) * size
        best = int(worth.argmax())
        if worth[best] <= 0:
            break
        chosen.append(best)
    return chosen


def _features(gray: npt.NDArray[np.uint8], box: Array) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return positions (n, 2) in native pixels and RootSIFT descriptors (n, 128) in a box."""
    side = float(max(box[2] - box[0], box[3] - box[1], 1.0))
    scale = float(np.clip(SIDE_PX / side, 1.0, ENLARGE))
    scale = min(scale, 2 * SIDE_PX / side)
    margin = 6.0  # px, for the surroundings of features near the border
    limit = np.array(gray.shape[::-1])
    low = np.floor((box[:2] - margin).clip(0)).astype(int)
    high = np.ceil(np.minimum(box[2:] + margin, limit)).astype(int)
    nothing = np.empty((0, 2)), np.empty((0, 128), np.uint8)
    if (high - low < 4).any():
        return nothing
    crop = gray[low[1] : high[1], low[0] : high[0]]
    size = np.maximum(np.round((high - low) * scale), 1).astype(int)
    sampling = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    sift: Any = cv2.SIFT.create(nfeatures=MOST, contrastThreshold=CONTRAST)
    keypoints, found = sift.detectAndCompute(
        cv2.resize(crop, size.tolist(), interpolation=sampling), None
    )
    if found is None:
        return nothing
    xy = (np.array([k.pt for k in keypoints]) + 0.5) * ((high - low) / size) + low
    inside = ((xy >= box[:2] - 1) & (xy <= box[2:] + 1)).all(1)
    root = np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-9)) * 512
    return xy[inside], np.minimum(root[inside], 255).astype(np.uint8)


# ---- Points ------------------------------------------------------------------------------------


def triangulated(
    objects: Sequence[Object],
    views: Sequence[ObjectView],
    poses: Poses,
) -> MapPoints:
    """Triangulate features that the views of an object have in common.

    Returns:
        points with the identity of their object, in the world of the poses; session 0.
    """
    tables = [MapPoints.empty()]
    for o in objects:
        of_object = [v for v in views if v.identity == o.id and len(v.xy)]
        if len(of_object) >= LEAST_VIEWS:
            tables.append(_points_of(o, of_object, poses))
    return MapPoints.joined(tables)


class _Rays:
    """Viewing rays of the features of one object.

    Attributes:
        view: (n,) index. start, direction: (n, 3) of unit rays. unit: (n, 128) descriptors.
        px: (n,) length at unit depth that is one pixel of an image 640 px wide.
    """

    def __init__(self, views: Sequence[ObjectView], poses: Poses) -> None:
        camera = poses.camera
        counts = [len(v.xy) for v in views]
        view = np.repeat(np.arange(len(views)), counts)
        xy = camera.undistort(np.concatenate([v.xy for v in views]))
        known = np.isfinite(xy).all(1)
        pose = poses.cam_from_world[[v.row for v in views]]
        in_cam = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.K).T
        in_world = np.einsum("nji,nj->ni", pose[view][:, :, :3], in_cam)
        self.view = view[known]
        self.start = invert_rigid(pose)[self.view][:, :, 3]
        self.direction = (in_world / np.linalg.norm(in_world, axis=1, keepdims=True))[known]
        unit = unit_descriptors(np.concatenate([v.descriptor for v in views]))
        self.unit = unit[known]
        self.px = max(camera.width, camera.height) / 640 / float(camera.K[0, 0])

    def errors(self, point: Array, rows: IntArray) -> tuple[Array, Array]:
        """Return distances (k,) of a point (3,) from rays in px, and depths (k,) along them."""
        away = point - self.start[rows]
        depth = (away * self.direction[rows]).sum(1)
        off = np.linalg.norm(away - depth[:, None] * self.direction[rows], axis=1)
        return off / np.maximum(depth, 1e-9) / self.px, depth


def _points_of(found: Object, views: Sequence[ObjectView], poses: Poses) -> MapPoints:
    """Triangulate the points of one object."""
    rays = _Rays(views, poses)
    first, second = _pairs(rays, shapes_of([found]))
    partners: list[list[int]] = [[] for _ in range(len(rays.view))]
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        partners[i].append(j)
        partners[j].append(i)
    free = np.ones(len(rays.view), bool)
    tracks = []
    for seed in np.argsort([-len(p) for p in partners], kind="stable").tolist():
        rows = np.array([seed, *partners[seed]])
        rows = rows[free[rows]]
        if not free[seed] or len(rows) < LEAST_VIEWS:
            continue
        track = _track(rays, rows)
        if track is not None:
            free[track[1]] = False
            tracks.append(track)
    return _described(found.id, rays, tracks)


def _pairs(rays: _Rays, shape: quadrics.Ellipsoids) -> tuple[IntArray, IntArray]:
    """Find pairs of features of two views that may be one point.

    Each feature is paired with the most similar one of another view that meets the epipolar
    constraint inside the object, if the choice is mutual.
    """
    cosine = rays.unit @ rays.unit.T
    similar = cosine > np.cos(ANGLE)
    i, j = np.nonzero(similar & (rays.view[:, None] < rays.view))
    a = rays.direction[i]
    b = rays.direction[j]
    between = rays.start[j] - rays.start[i]
    cross = (a * b).sum(1)
    sine = 1 - cross**2
    usable = sine > np.sin(np.radians(PARALLAX_DEG / 2)) ** 2
    sine = np.where(usable, sine, 1.0)
    of_a = (between * a).sum(1)
    of_b = (between * b).sum(1)
    depth_a = (of_a - cross * of_b) / sine
    depth_b = (cross * of_a - of_b) / sine
    on_a = rays.start[i] + depth_a[:, None] * a
    on_b = rays.start[j] + depth_b[:, None] * b
    gap = np.linalg.norm(on_a - on_b, axis=1) / 2
    near = gap < ERROR_PX * rays.px * np.minimum(depth_a, depth_b)
    good = usable & near & (np.minimum(depth_a, depth_b) > 0)
    good &= scaled_radius((on_a + on_b) / 2, shape, 0) < INSIDE**2
    i = i[good]
    j = j[good]
    order = np.argsort(-cosine[i, j], kind="stable")
    i = i[order]
    j = j[order]
    count = int(rays.view.max(initial=0)) + 1
    _, best_of_i = np.unique(i * count + rays.view[j], return_index=True)
    _, best_of_j = np.unique(j * count + rays.view[i], return_index=True)
    mutual = np.intersect1d(best_of_i, best_of_j)
    return i[mutual], j[mutual]


def _track(rays: _Rays, rows: IntArray) -> tuple[Array, IntArray] | None:
    """Triangulate rows of features that may be one point; None: they are none."""
    for _ in range(3):
        direction = rays.direction[rows]
        across = np.eye(3) - direction[:, :, None] * direction[:, None]  # (k, 3, 3)
        start = np.einsum("kij,kj->i", across, rays.start[rows])
        point = np.linalg.solve(across.sum(0) + 1e-12 * np.eye(3), start)
        error, depth = rays.errors(point, rows)
        good = (error < ERROR_PX) & (depth > 0)
        if good.all():
            break
        rows = rows[good]
        if len(rows) < LEAST_VIEWS:
            return None
    else:
        return None
    widest = float((rays.direction[rows] @ rays.direction[rows].T).min())
    if widest > np.cos(np.radians(PARALLAX_DEG)):
        return None
    return point, rows


def _described(identity: int, rays: _Rays, tracks: Sequence[tuple[Array, IntArray]]) -> MapPoints:
    """Return points with mean descriptors."""
    if not tracks:
        return MapPoints.empty()
    rows = [rows for _, rows in tracks]
    distance = [np.median(np.linalg.norm(p - rays.start[rows], axis=1)) for p, rows in tracks]
    return described_points(
        np.array([point for point, _ in tracks]),
        np.array([rays.unit[k].mean(0) for k in rows]),
        np.array([rays.direction[k].mean(0) for k in rows]),
        np.array(distance),
        identity,
    )
