"""Places in 3D: where identities and tracks are, as far as boxes, cameras and points tell.

`EllipsoidMap` keeps an ellipsoid of every identity that was seen from several sides. Before that, a
track is known to lie on its viewing ray, at about the depth of the sparse points in its box: a
*span* of that ray (`spans_of_boxes`). Both are projected to say where a track is seen next, and how
far off that may be. No unit of the world makes a difference.

Axes: I identities, V views, G groups of boxes, D detections, T tracks, N points.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, scaled_camera, viewing_rays
from reobj.types import Array, BoolArray, IntArray, cxcywh_from_xyxy

# ---- Ellipsoids of identities ------------------------------------------------------------------


MIN_PARALLAX_DEG = 2.0  # between the views of a fit (chosen)


def quick_fit(
    boxes: Array, img_from_world: Array, image_size: tuple[int, int], usual_size: float
) -> quadrics.ObjectFits:
    """Fit ellipsoids of any size to boxes (V, G, 4) in a few steps (`quadrics.fit_objects`).

    Args:
        img_from_world: (V, 3, 4) K @ cam_from_world.
        usual_size: of the scene's things in the unit of the world (`usual_size`): the world may
            have any unit, but the prior of the fit is in metres.
    """
    ratio = float(np.exp(np.log(quadrics.UNKNOWN_SIZE_M).mean())) / usual_size
    cameras = img_from_world.copy()
    cameras[..., 3] *= ratio
    config = quadrics.FitConfig(iterations=10, start_views=4, start_iterations=4)
    fits = quadrics.fit_objects(boxes, cameras, image_size, support="ellipsoid", config=config)
    own = dataclasses.replace(
        fits.ellipsoids,
        center_in_world=fits.ellipsoids.center_in_world / ratio,
        half_axes=fits.ellipsoids.half_axes / ratio,
    )
    cov = fits.cov.copy()
    cov[:, :3] /= ratio
    cov[:, :, :3] /= ratio
    return dataclasses.replace(fits, ellipsoids=own, size=fits.size / ratio, cov=cov)


def rough_sizes(boxes: Array, img_from_world: Array) -> Array:
    """Estimate the sizes of things by triangulating the centres of their boxes (V, G, 4).

    Returns:
        (V, G) that each view gives, in the unit of the world; NaN without parallax.
    """
    views, groups = boxes.shape[:2]
    cameras = np.broadcast_to(img_from_world[:, None], (views, groups, 3, 4)).reshape(-1, 3, 4)
    rays = viewing_rays(boxes.reshape(-1, 4), cameras).reshape(views, groups, 3)
    seen = np.isfinite(rays[..., 0])  # (V, G)
    turned = np.linalg.norm(np.fmax.reduce(rays) - np.fmin.reduce(rays), axis=1)  # (G,) rad
    rays = np.where(seen[..., None], rays, 0)
    inverse = np.linalg.inv(img_from_world[:, :, :3])  # (V, 3, 3)
    centres = -np.einsum("vij,vj->vi", inverse, img_from_world[:, :, 3])  # (V, 3)
    # sum_v (I - d d') (X - c) = 0
    across = seen[..., None, None] * np.eye(3) - rays[..., :, None] * rays[..., None, :]
    target = np.einsum("vgij,vj->gi", across, centres)[..., None]  # (G, 3, 1)
    point = (np.linalg.pinv(across.sum(0), hermitian=True) @ target)[..., 0]  # (G, 3)
    depth = ((point - centres[:, None]) * rays).sum(-1)  # (V, G)
    side = np.sqrt((boxes[..., 2:] - boxes[..., :2]).clip(0).prod(-1))  # (V, G) px
    focal = np.sqrt(np.abs(np.linalg.det(img_from_world[:, :, :3])))  # (V,) px
    use = seen & (depth > 0) & (turned >= np.radians(MIN_PARALLAX_DEG))
    return np.where(use, side * depth / focal[:, None], np.nan)


def usual_size(sizes: Array) -> float:
    """Return the median of sizes of any shape, of which some are unknown (NaN); 1 if all are."""
    known = sizes[np.isfinite(sizes) & (sizes > 0)]
    return float(np.median(known)) if len(known) else 1.0


MAP_VIEWS = 16  # views kept of every identity (chosen)
MAP_FIRST_STEP_DEG = 1.0  # between the viewing rays of two views; doubled whenever they are full
MAP_MIN_VIEWS = 3  # of a fit: fewer boxes leave an ellipsoid undetermined (9 unknowns, 4 a box)
# longest half axis over the middle one: objects that were half seen give needles, reaching behind
# the camera (95 % of priors.json are below 5.8; IDF1 of redkitchen with poses 79.1 -> 88.4)
MAP_MAX_ELONGATION = 6.0
NO_FRAME = -1000  # of a free view: long before the first frame


class EllipsoidMap:
    """The place in 3D of every identity, for a tracker that is given the camera's poses.

    Of every identity a few views are kept, evenly over the directions that it was seen from, and an
    ellipsoid is fitted to them now and then. Memory grows with the number of identities, not with
    time.

    Attributes:
        frame: (I, V) frame of each view, negative: free. boxes: (I, V, 4) x1, y1, x2, y2.
        img_from_world: (I, V, 3, 4). rays: (I, V, 3) viewing rays, NaN: free.
        step_deg: (I,) between the rays of two views. fresh: (I,) views since the last fit.
        size: (I, V) rough, NaN unknown. dual_q: (I, 4, 4) ellipsoids, NaN unknown.
        ends: (I, 2, 3) one sigma to either side of the centre, in the direction known least.
    """

    ARRAYS = (
        "frame", "boxes", "img_from_world", "rays", "step_deg", "fresh", "size", "dual_q", "ends"
    )  # fmt: skip

    def __init__(self) -> None:
        self.frame = np.zeros((0, MAP_VIEWS), np.int64)
        self.boxes = np.zeros((0, MAP_VIEWS, 4))
        self.img_from_world = np.zeros((0, MAP_VIEWS, 3, 4))
        self.rays = np.zeros((0, MAP_VIEWS, 3))
        self.step_deg = np.zeros(0)
        self.fresh = np.zeros(0, np.int64)
        self.size = np.zeros((0, MAP_VIEWS))
        self.dual_q = np.zeros((0, 4, 4))
        self.ends = np.zeros((0, 2, 3))

    def add(self, frame: int, identity: IntArray, xyxy: Array, img_from_world: Array) -> None:
        """Add a view (N, 4) of each of N different identities that are seen from a new direction.

        When an identity's views are full, every other one goes and the step between them doubles.
        """
        self._grow(int(identity.max(initial=-1)) + 1)
        rays = viewing_rays(xyxy, img_from_world)  # (N, 3)
        cosine = np.einsum("nvi,ni->nv", np.nan_to_num(self.rays[identity]), rays)
        due = cosine.max(1, initial=0) <= np.cos(np.radians(self.step_deg[identity]))
        for i, box, ray in zip(identity[due], xyxy[due], rays[due], strict=True):
            if (self.frame[i] >= 0).all():
                old = self.frame[i].argsort()[1::2]
                self.frame[i, old], self.rays[i, old] = NO_FRAME, np.nan
                self.step_deg[i] *= 2
            slot = self.frame[i].argmin()
            self.frame[i, slot], self.boxes[i, slot], self.rays[i, slot] = frame, box, ray
            self.img_from_world[i, slot] = img_from_world
            self.fresh[i] += 1

    @property
    def due(self) -> BoolArray:
        """(I,) which identities have enough views for a fit, more than a quarter of them fresh."""
        count = (self.frame >= 0).sum(1)
        return np.asarray((count >= MAP_MIN_VIEWS) & (self.fresh > count // 4), bool)

    def refit(self, image_size: tuple[int, int]) -> bool:
        """Fit the ellipsoids of all identities that are due.

        A fit that is rejected, has no parallax or is a needle makes the place unknown.

        Returns:
            Whether any was due.
        """
        seen, due = self.frame >= 0, np.flatnonzero(self.due)  # (I, V)
        if not len(due):
            return False
        at, slot = np.nonzero(seen[due])
        frames, first, row = np.unique(
            self.frame[due][at, slot], return_index=True, return_inverse=True
        )
        boxes = np.full((len(frames), len(due), 4), np.nan)  # (F, O, 4)
        boxes[row, at] = self.boxes[due][at, slot]
        cameras = self.img_from_world[due][at, slot][first]  # (F, 3, 4)
        self.size[due[at], slot] = rough_sizes(boxes, cameras)[row, at]
        fits = quick_fit(boxes, cameras, image_size, usual_size(self.size))
        good = (fits.status != "rejected") & (fits.parallax_deg >= MIN_PARALLAX_DEG)  # (O,)
        axes = np.sort(fits.ellipsoids.half_axes, 1)  # (O, 3)
        good &= axes[:, 2] <= MAP_MAX_ELONGATION * axes[:, 1]
        self.dual_q[due] = np.where(good[:, None, None], fits.ellipsoids.dual_quadrics(), np.nan)
        value, vector = np.linalg.eigh(np.where(good[:, None, None], fits.cov[:, :3, :3], 0.0))
        sigma = np.sqrt(value[:, -1:].clip(0)) * vector[..., -1]  # (O, 3)
        centre = np.where(good[:, None], fits.ellipsoids.center_in_world, np.nan)
        self.ends[due] = np.stack([centre - sigma, centre + sigma], 1)
        self.fresh[due] = 0
        return True

    @property
    def known(self) -> BoolArray:
        """(I,) whether the place of the identity is known."""
        return np.asarray(np.isfinite(self.dual_q[:, 0, 0]), bool)

    def project(self, img_from_world: Array, image_size: tuple[int, int], share: float) -> Array:
        """Project the ellipsoids into an image.

        Returns:
            (I, 4) boxes cx, cy, w, h of their parts in the image; NaN where the place is unknown,
            or where no more than `share` of the box lies in the image.
        """
        dual_c, before_camera = quadrics.project(self.dual_q, img_from_world[None])
        boxes = quadrics.boxes_from_dual_conics(dual_c[0])  # (I, 4)
        cut = quadrics.clip_boxes(boxes, image_size)
        area, whole = ((b[:, 2:] - b[:, :2]).prod(1) for b in (cut, boxes))
        seen = before_camera[0] & (area > share * whole)
        return np.where(seen[:, None], cxcywh_from_xyxy(cut), np.nan)

    def tracks_seen(
        self, cam_from_world: Array, identity: IntArray, ends: Array, size: Array, K: Array,
        image_size: tuple[int, int],
    ) -> tuple[Array, Array]:  # fmt: skip
        """Project the places of tracks: of their identities (T,) where known, else their spans.

        Args:
            ends, size: (T, 2, 3), (T, 2) of the spans (`spans_of_boxes`).
        Returns:
            (T, 4) boxes cx, cy, w, h, NaN where unknown or out of view; (T, 2) px, one sigma of
            their centre in the direction that is known least.
        """
        view, known = K @ cam_from_world, rows_of(self.known, identity, False)
        boxes = rows_of(self.project(view, image_size, 0.0), identity, np.nan)
        spans = project_spans(ends, size, K, cam_from_world)
        own = rows_of(self.ends, identity, np.nan)
        reach = project_ends(np.where(known[:, None, None], own, ends), view)
        return np.where(known[:, None], boxes, spans), np.nan_to_num(reach)

    def overlap(
        self, box: Array, identity: IntArray, view: Array | None, image_size: tuple[int, int]
    ) -> tuple[Array, Array]:
        """Compare boxes (n, 4) cx, cy, w, h with places of identities (I,), within two sigma.

        Args:
            view: (3, 4) img_from_world; None: nothing is known.
        Returns:
            IoU (n, I), NaN: unknown; share (I,) of what an overlap says (`overlap_within_reach`).
        """
        iou, share = np.full((len(box), len(identity)), np.nan), np.ones(len(identity))
        if view is not None and len(identity):
            places = rows_of(self.project(view, image_size, 0.0), identity, np.nan)  # (I, 4)
            reach = 2 * np.abs(project_ends(rows_of(self.ends, identity, np.nan), view))
            where = (places.T[:, None], np.nan_to_num(reach).T[:, None])  # (4, 1, I), (2, 1, I)
            found, share = overlap_within_reach(*where, box.T[..., None])  # (n, I), (1, I)
            known = rows_of(self.known, identity, False)
            iou[:, known] = np.nan_to_num(found[:, known])
            share = np.nan_to_num(share[0])
        return iou, share

    def _grow(self, identities: int) -> None:
        extra = identities - len(self.frame)
        if extra > 0:
            extra = max(extra, len(self.frame), 16)  # doubling: amortised O(1)
            fills = {"frame": NO_FRAME, "dual_q": np.nan, "rays": np.nan, "ends": np.nan}
            fills |= {"size": np.nan, "step_deg": MAP_FIRST_STEP_DEG}
            for name in self.ARRAYS:
                old = getattr(self, name)
                new = np.full((extra, *old.shape[1:]), fills.get(name, 0), old.dtype)
                setattr(self, name, np.concatenate([old, new]))


def rows_of(rows: Any, identity: IntArray, missing: Any) -> npt.NDArray[Any]:
    """Take rows of a table of identities (I, ...), `missing` where there is none: (T, ...)."""
    table = np.concatenate([rows, np.full((1, *rows.shape[1:]), missing, rows.dtype)])
    return np.asarray(table[np.where(identity < len(rows), identity, -1)])


# ---- Spans of tracks ---------------------------------------------------------------------------

MIN_POINTS = 3  # in a box, to tell its depth: fewer have no median and spread (chosen)


class VisiblePoints:
    """Answer which sparse points the frames of a video see.

    A frame that was located without observations of its own sees what the frames with observations
    before and after it see.
    """

    def __init__(self, poses: Poses) -> None:
        order = np.argsort(poses.visibility[:, 0], kind="stable")
        rows, self.observed = poses.visibility[order].T
        self.rows, self.starts = np.unique(rows, return_index=True)  # (R,) rows of such frames
        self.stops = np.append(self.starts[1:], len(rows))
        self.part, self.points = poses.part, poses.points

    def __call__(self, row: int) -> Array:
        """Return the points (N, 3) in world that a row of the poses sees."""
        at = int(np.searchsorted(self.rows, row))
        beside = [at] if at < len(self.rows) and self.rows[at] == row else [at - 1, at]
        beside = [i for i in beside if 0 <= i < len(self.rows)]
        beside = [i for i in beside if self.part[self.rows[i]] == self.part[row]]
        seen = [self.observed[self.starts[i] : self.stops[i]] for i in beside]
        rows = np.unique(np.concatenate([np.empty(0, np.int64), *seen]))
        return np.asarray(self.points[rows], np.float64)


class CamerasOfFrames:
    """Answer what a tracker is told of the camera of a frame: keyword arguments of its `update`.

    Args:
        poses: of the video; None: nothing is known. scale: px of the frames per native px.
    """

    def __init__(self, poses: Poses | None, scale: float) -> None:
        self.poses, self.row_of = poses, {}
        if poses is not None:
            self.row_of = {frame: row for row, frame in enumerate(poses.frame.tolist())}
            self.camera, self.visible = scaled_camera(poses.camera, scale), VisiblePoints(poses)

    def __call__(self, frame: int) -> dict[str, Any]:
        """Return pose, camera, points and part of a frame, by its number in the source."""
        if self.poses is None or frame not in self.row_of:
            return {}
        row = self.row_of[frame]
        return {
            "cam_from_world": self.poses.cam_from_world[row],
            "camera": self.camera,
            "points": self.visible(row),
            "part": int(self.poses.part[row]),
        }


def spans_of_boxes(
    xyxy: Array, points: Array, cam_from_world: Array, K: Array
) -> tuple[Array, Array]:
    """Estimate where on their viewing rays the things in boxes lie, by the points in the boxes.

    The depth is the median of the points in the middle half of a box, else in all of it, else in
    the image; its sigma their spread (MAD), and no less than half the size of the thing.

    Args:
        xyxy: (D, 4) px. points: (N, 3) in world, that this frame sees.
    Returns:
        ends: (D, 2, 3) in world, one sigma nearer and one farther than the depth. size: (D, 2) its
        width and height, in the unit of the world. NaN if there are too few points.
    """
    ends, size = np.full((len(xyxy), 2, 3), np.nan), np.full((len(xyxy), 2), np.nan)
    in_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]  # (N, 3)
    in_cam = in_cam[in_cam[:, 2] > 0]
    if len(in_cam) < MIN_POINTS:
        return ends, size
    xy = (in_cam @ K.T)[:, :2] / in_cam[:, 2:]
    log_depth = np.log(in_cam[:, 2])
    box = cxcywh_from_xyxy(xyxy)
    offset = np.abs(xy - box[:, None, :2]) / box[:, None, 2:].clip(1e-9)  # (D, N, 2) box sizes
    offset = offset.max(-1)  # (D, N)
    everywhere = _median_and_spread(log_depth)
    middle, sigma = np.empty(len(xyxy)), np.empty(len(xyxy))
    for d, away in enumerate(offset):  # over boxes: each has its own number of points
        sets = (log_depth[away < reach] for reach in (0.25, 0.5))
        found = next((s for s in sets if len(s) >= MIN_POINTS), None)
        middle[d], sigma[d] = everywhere if found is None else _median_and_spread(found)
    least = (box[:, 2:] / np.diag(K)[:2]).mean(1) / 2  # (D,) half the size over the depth
    depth = np.exp(middle[:, None] + np.maximum(sigma, least)[:, None] * [-1, 1])  # (D, 2)
    rays = np.c_[box[:, :2], np.ones(len(box))] @ np.linalg.inv(K).T  # (D, 3) depth 1
    rotation, offset_in_cam = cam_from_world[:, :3], cam_from_world[:, 3]
    ends = (depth[..., None] * rays[:, None] - offset_in_cam) @ rotation  # R' (x - t)
    return ends, box[:, 2:] / np.diag(K)[:2] * depth.mean(1, keepdims=True)


def _median_and_spread(values: Array) -> tuple[float, float]:
    """Return the median, and sigma from the median absolute deviation."""
    median = float(np.median(values))
    return median, 1.4826 * float(np.median(np.abs(values - median)))


def project_spans(ends: Array, size: Array, K: Array, cam_from_world: Array) -> Array:
    """Project things of known size (T, 2) in the middle of their spans (T, 2, 3).

    Returns:
        (T, 4) boxes cx, cy, w, h; NaN where unknown or behind the camera.
    """
    in_cam = ends.mean(1) @ cam_from_world[:, :3].T + cam_from_world[:, 3]  # (T, 3)
    depth = np.where(in_cam[:, 2:] > 0, in_cam[:, 2:], np.nan)
    return np.concatenate([(in_cam @ K.T)[:, :2] / depth, size * np.diag(K)[:2] / depth], 1)


def project_ends(ends: Array, img_from_world: Array) -> Array:
    """Project the ends of spans (T, 2, 3): half the way from one to the other, (T, 2) px.

    NaN where unknown or behind the camera.
    """
    in_image = ends @ img_from_world[:, :3].T + img_from_world[:, 3]  # (T, 2, 3)
    depth = np.where(in_image[..., 2:] > 0, in_image[..., 2:], np.nan)
    xy = in_image[..., :2] / depth
    return np.asarray((xy[:, 1] - xy[:, 0]) / 2)


def overlap_within_reach(box: Array, reach: Array, detected: Array) -> tuple[Array, Array]:
    """Compare boxes whose place is uncertain with detections, each moved where it fits best.

    Args:
        box, detected: (4, ...) cx, cy, w, h. reach: (2, ...) px that a box may lie to either side.
    Returns:
        iou: (...) after that move. share: (...) of the reachable area that a box covers: how much
        an overlap says.
    """
    away = np.maximum(np.abs(box[:2] - detected[:2]) - reach, 0)  # (2, ...)
    a, b = box[2:], detected[2:]
    width, height = np.maximum(np.minimum(np.minimum(a, b), (a + b) / 2 - away), 0)
    overlap = width * height
    union = a[0] * a[1] + b[0] * b[1] - overlap
    x, y = a / np.maximum(a + 2 * reach, 1e-9)
    return overlap / np.maximum(union, 1e-9), x * y
