"""3D state of the online tracker: ellipsoids of known identities, depth intervals of new tracks.

`EllipsoidMap` fits an ellipsoid to every identity that was seen from several directions. Before
that, a track lies on its viewing ray within a *depth interval*, estimated from the sparse points in
its box (`depth_intervals`). Both are projected to predict where a track is seen next, and with what
uncertainty in pixels. Results do not depend on the unit of the world.

Axes: I identities, V views, G groups of boxes, D detections, T tracks, N points.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, VisiblePoints, scaled_camera, viewing_rays
from reobj.types import Array, BoolArray, IntArray, cxcywh_from_xyxy

# ---- Ellipsoids of identities ------------------------------------------------------------------


# between the views of a fit (chosen; lower: positions whose depth is the prior of the size, higher:
# objects are unknown until the camera has walked round them)
MIN_PARALLAX_DEG = 2.0


def quick_fit(
    boxes: Array, img_from_world: Array, image_size: tuple[int, int], usual_size: float
) -> quadrics.ObjectFits:
    """Fit ellipsoids of any size to boxes (V, G, 4) in a few steps (`quadrics.fit_objects`).

    Args:
        img_from_world: (V, 3, 4) K @ cam_from_world.
        usual_size: of the scene's objects in the unit of the world (`usual_size`): the world may
            have any unit, but the prior of the fit is in metres.
    """
    ratio = float(np.exp(np.log(quadrics.UNKNOWN_SIZE.mean_m).mean())) / usual_size
    cameras = img_from_world.copy()
    cameras[..., 3] *= ratio
    config = quadrics.FitConfig(iterations=10, start_views=4, start_iterations=4)
    fits = quadrics.fit_objects(boxes, cameras, image_size, support="ellipsoid", config=config)
    ellipsoids = dataclasses.replace(
        fits.ellipsoids,
        center_in_world=fits.ellipsoids.center_in_world / ratio,
        half_axes=fits.ellipsoids.half_axes / ratio,
    )
    cov = fits.cov.copy()
    cov[:, :3] /= ratio
    cov[:, :, :3] /= ratio
    return dataclasses.replace(fits, ellipsoids=ellipsoids, size=fits.size / ratio, cov=cov)


def rough_sizes(boxes: Array, img_from_world: Array) -> Array:
    """Estimate object sizes by triangulating the centres of their boxes (V, G, 4).

    Returns:
        (V, G) estimate of each view, in the unit of the world; NaN without parallax.
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
    """Return the median of an array of sizes, ignoring NaN; 1 if all are NaN."""
    known = sizes[np.isfinite(sizes) & (sizes > 0)]
    return float(np.median(known)) if len(known) else 1.0


# fraction of a projected box in the image above which the object is expected there (not measured)
EXPECTED_IN_VIEW = 0.5
# longest half axis over the middle one: half-occluded objects give needles that reach behind the
# camera (95 % of priors.json are below 5.8; IDF1 of redkitchen with poses 79.1 -> 88.4)
MAP_MAX_ELONGATION = 6.0


class EllipsoidMap:
    """3D position and shape of every identity, for a tracker that is given camera poses.

    A few views of every identity are kept, spread evenly over the viewing directions, and an
    ellipsoid is fitted to them from time to time. Memory grows with the number of identities, not
    with time.

    Args:
        views: V, views kept of every identity.

    Attributes:
        frame: (I, V) frame of each view, -1: free slot. boxes: (I, V, 4) x1, y1, x2, y2.
        img_from_world: (I, V, 3, 4). rays: (I, V, 3) viewing rays, NaN: free slot.
        step_deg: (I,) least angle between the rays of two views. fresh: (I,) views since the fit.
        size: (I, V) rough size, NaN unknown. dual_q: (I, 4, 4) dual quadrics, NaN unknown.
        ends: (I, 2, 3) centre -+ one sigma along the axis of largest uncertainty.
        given: (I,) ellipsoids known from a map of the room; they are not fitted.
    """

    ARRAYS = (
        "frame", "boxes", "img_from_world", "rays", "step_deg", "fresh", "size", "dual_q", "ends",
        "given",
    )  # fmt: skip

    def __init__(self, views: int = 16) -> None:
        self.frame = np.zeros((0, views), np.int64)
        self.boxes = np.zeros((0, views, 4))
        self.img_from_world = np.zeros((0, views, 3, 4))
        self.rays = np.zeros((0, views, 3))
        self.step_deg = np.zeros(0)
        self.fresh = np.zeros(0, np.int64)
        self.size = np.zeros((0, views))
        self.dual_q = np.zeros((0, 4, 4))
        self.ends = np.zeros((0, 2, 3))
        self.given = np.zeros(0, bool)

    def give(self, ellipsoids: quadrics.Ellipsoids, cov: Array) -> None:
        """Set the ellipsoids of the first identities, which are then not fitted.

        Args:
            ellipsoids: I; NaN: unknown, fitted as others. cov: (I, 3, 3) of their centres.
        """
        count = len(ellipsoids)
        self._grow(count)
        dual_q = ellipsoids.dual_quadrics()
        finite = np.isfinite(dual_q).all((1, 2)) & np.isfinite(cov).all((1, 2))
        known = np.asarray(finite, bool)
        value, vector = np.linalg.eigh(np.where(known[:, None, None], cov, 0.0))
        sigma = np.sqrt(value[:, -1:].clip(0)) * vector[..., -1]  # (I, 3)
        ends = ellipsoids.center_in_world[:, None] + np.stack([-sigma, sigma], 1)
        self.dual_q[:count] = np.where(known[:, None, None], dual_q, np.nan)
        self.ends[:count] = np.where(known[:, None, None], ends, np.nan)
        self.given[:count] = known

    def add(self, frame: int, identity: IntArray, xyxy: Array, img_from_world: Array) -> None:
        """Add a view (N, 4) of each of N different identities that are seen from a new direction.

        When all slots of an identity are used, every other view is dropped and the angle between
        views doubles.
        """
        self._grow(int(identity.max(initial=-1)) + 1)
        rays = viewing_rays(xyxy, img_from_world)  # (N, 3)
        cosine = np.einsum("nvi,ni->nv", np.nan_to_num(self.rays[identity]), rays)
        due = cosine.max(1, initial=0) <= np.cos(np.radians(self.step_deg[identity]))
        for i, box, ray in zip(identity[due], xyxy[due], rays[due], strict=True):
            if (self.frame[i] >= 0).all():
                old = self.frame[i].argsort()[1::2]
                self.frame[i, old] = -1
                self.rays[i, old] = np.nan
                self.step_deg[i] *= 2
            slot = self.frame[i].argmin()
            self.frame[i, slot] = frame
            self.boxes[i, slot] = box
            self.rays[i, slot] = ray
            self.img_from_world[i, slot] = img_from_world
            self.fresh[i] += 1

    @property
    def due(self) -> BoolArray:
        """(I,) identities with enough views for a fit, more than a quarter of them new."""
        count = (self.frame >= 0).sum(1)
        # fewer than three boxes leave an ellipsoid undetermined: 9 unknowns, 4 a box
        return np.asarray((count >= 3) & (self.fresh > count // 4) & ~self.given, bool)

    def refit(self, image_size: tuple[int, int]) -> bool:
        """Fit the ellipsoids of all identities that are due.

        A fit that is rejected, lacks parallax or is a needle makes the position unknown.

        Returns:
            Whether any was due.
        """
        seen = self.frame >= 0  # (I, V)
        due = np.flatnonzero(self.due)
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
        """(I,) identities whose 3D position is known."""
        return np.asarray(np.isfinite(self.dual_q[:, 0, 0]), bool)

    def project(
        self, img_from_world: Array, image_size: tuple[int, int], min_visible: float
    ) -> Array:
        """Project the ellipsoids into an image.

        Args:
            min_visible: fraction of the box that must lie in the image.
        Returns:
            (I, 4) boxes cx, cy, w, h clipped to the image; NaN where the position is unknown or
            the ellipsoid is out of view.
        """
        dual_c, in_front = quadrics.project(self.dual_q, img_from_world[None])
        boxes = quadrics.boxes_from_dual_conics(dual_c[0])  # (I, 4)
        clipped = quadrics.clip_boxes(boxes, image_size)
        area, whole = ((b[:, 2:] - b[:, :2]).prod(1) for b in (clipped, boxes))
        seen = in_front[0] & (area > min_visible * whole)
        return np.where(seen[:, None], cxcywh_from_xyxy(clipped), np.nan)

    def project_tracks(
        self, cam_from_world: Array, identity: IntArray, ends: Array, size: Array, K: Array,
        image_size: tuple[int, int],
    ) -> tuple[Array, Array]:  # fmt: skip
        """Project tracks: the ellipsoids of their identities (T,), else their depth intervals.

        Args:
            ends, size: (T, 2, 3), (T, 2) of the depth intervals (`depth_intervals`).
        Returns:
            boxes: (T, 4) cx, cy, w, h, NaN where unknown or out of view. uncertainty: (T, 2) px,
            one sigma of the centre along the direction of largest uncertainty.
        """
        view = K @ cam_from_world
        known = rows_of(self.known, identity, False)
        boxes = rows_of(self.project(view, image_size, 0.0), identity, np.nan)
        interval_boxes = project_depth_intervals(ends, size, K, cam_from_world)
        ellipsoid_ends = rows_of(self.ends, identity, np.nan)
        uncertainty = project_half_intervals(
            np.where(known[:, None, None], ellipsoid_ends, ends), view
        )
        return np.where(known[:, None], boxes, interval_boxes), np.nan_to_num(uncertainty)

    def overlap(
        self, box: Array, identity: IntArray, view: Array | None, image_size: tuple[int, int]
    ) -> tuple[Array, Array]:
        """Compare boxes (n, 4) cx, cy, w, h with identities (I,), within two sigma.

        Args:
            view: (3, 4) img_from_world; None: without a pose nothing is known.
        Returns:
            iou: (n, I), NaN unknown. weight: (I,) of the overlap (`iou_within_uncertainty`).
        """
        iou = np.full((len(box), len(identity)), np.nan)
        weight = np.ones(len(identity))
        if view is not None and len(identity):
            projected = rows_of(self.project(view, image_size, 0.0), identity, np.nan)  # (I, 4)
            ends = rows_of(self.ends, identity, np.nan)
            uncertainty = np.nan_to_num(2 * np.abs(project_half_intervals(ends, view)))  # (I, 2)
            found, weight = iou_within_uncertainty(
                projected.T[:, None], uncertainty.T[:, None], box.T[..., None]
            )  # (n, I), (1, I)
            known = rows_of(self.known, identity, False)
            iou[:, known] = np.nan_to_num(found[:, known])
            weight = np.nan_to_num(weight[0])
        return iou, weight

    def _grow(self, identities: int) -> None:
        extra = identities - len(self.frame)
        if extra > 0:
            extra = max(extra, len(self.frame), 16)  # doubling: amortised O(1)
            fills = {"frame": -1, "dual_q": np.nan, "rays": np.nan, "ends": np.nan}
            fills |= {"size": np.nan, "step_deg": 1.0}  # between viewing rays; doubled when full
            for name in self.ARRAYS:
                old = getattr(self, name)
                new = np.full((extra, *old.shape[1:]), fills.get(name, 0), old.dtype)
                setattr(self, name, np.concatenate([old, new]))


def rows_of(rows: Any, identity: IntArray, missing: Any) -> npt.NDArray[Any]:
    """Take rows (T, ...) of a table of identities (I, ...), `missing` beyond its end or at -1."""
    table = np.concatenate([rows, np.full((1, *rows.shape[1:]), missing, rows.dtype)])
    return np.asarray(table[np.where(identity < len(rows), identity, -1)])


# ---- Depth intervals of tracks -----------------------------------------------------------------


class CameraInputs:
    """Look up a frame's camera inputs as keyword arguments for `Tracker.update`.

    Args:
        poses: of the video; None: no camera inputs. scale: px of the frames per native px.
    """

    def __init__(self, poses: Poses | None, scale: float) -> None:
        self.poses = poses
        self.row_of: dict[int, int] = {}
        if poses is not None:
            self.row_of = {frame: row for row, frame in enumerate(poses.frame.tolist())}
            self.camera = scaled_camera(poses.camera, scale)
            self.visible = VisiblePoints(poses)

    def __call__(self, frame: int) -> dict[str, Any]:
        """Return pose, camera, points and component of a frame, by its number in the source.

        The points are those nearby, not only those in the image: their median depth is the fallback
        of boxes without points (cropping them would change depth intervals).
        """
        if self.poses is None or frame not in self.row_of:
            return {}
        row = self.row_of[frame]
        return {
            "cam_from_world": self.poses.cam_from_world[row],
            "camera": self.camera,
            "points": np.asarray(self.poses.points[self.visible.nearby(row)], np.float64),
            "part": int(self.poses.part[row]),
        }


def depth_intervals(
    xyxy: Array, points: Array, cam_from_world: Array, K: Array, min_points: int = 3
) -> tuple[Array, Array]:
    """Estimate the depth intervals of the objects in boxes from the sparse points in the boxes.

    The depth is the median over the points in the middle half of a box, else in the whole box, else
    in the image. Its sigma is their spread (MAD), but at least half the size of the object.

    Args:
        xyxy: (D, 4) px. points: (N, 3) in world, seen in this frame.
        min_points: in a box to estimate its depth; fewer than 3 have no median and spread.
    Returns:
        ends: (D, 2, 3) in world, end points of the interval on the viewing ray, one sigma in front
        of and behind the depth. size: (D, 2) width and height there, in the unit of the world. NaN
        with too few points.
    """
    ends = np.full((len(xyxy), 2, 3), np.nan)
    size = np.full((len(xyxy), 2), np.nan)
    in_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]  # (N, 3)
    in_cam = in_cam[in_cam[:, 2] > 0]
    if len(in_cam) < min_points:
        return ends, size
    xy = (in_cam @ K.T)[:, :2] / in_cam[:, 2:]
    log_depth = np.log(in_cam[:, 2])
    box = cxcywh_from_xyxy(xyxy)
    offset = np.abs(xy - box[:, None, :2]) / box[:, None, 2:].clip(1e-9)  # (D, N, 2) box sizes
    offset = offset.max(-1)  # (D, N)
    of_image = _median_and_spread(log_depth)
    median = np.empty(len(xyxy))
    sigma = np.empty(len(xyxy))
    for d, distance in enumerate(offset):  # each box has its own number of points
        sets = (log_depth[distance < limit] for limit in (0.25, 0.5))
        found = next((s for s in sets if len(s) >= min_points), None)
        median[d], sigma[d] = of_image if found is None else _median_and_spread(found)
    least = (box[:, 2:] / np.diag(K)[:2]).mean(1) / 2  # (D,) half the size over the depth
    depth = np.exp(median[:, None] + np.maximum(sigma, least)[:, None] * [-1, 1])  # (D, 2)
    rays = np.c_[box[:, :2], np.ones(len(box))] @ np.linalg.inv(K).T  # (D, 3) depth 1
    rotation = cam_from_world[:, :3]
    offset_in_cam = cam_from_world[:, 3]
    ends = (depth[..., None] * rays[:, None] - offset_in_cam) @ rotation  # R' (x - t)
    return ends, box[:, 2:] / np.diag(K)[:2] * depth.mean(1, keepdims=True)


def _median_and_spread(values: Array) -> tuple[float, float]:
    """Return the median, and sigma from the median absolute deviation."""
    median = float(np.median(values))
    return median, 1.4826 * float(np.median(np.abs(values - median)))


def project_depth_intervals(ends: Array, size: Array, K: Array, cam_from_world: Array) -> Array:
    """Project objects of given size (T, 2) in the middle of their depth intervals (T, 2, 3).

    Returns:
        (T, 4) boxes cx, cy, w, h; NaN where unknown or behind the camera.
    """
    in_cam = ends.mean(1) @ cam_from_world[:, :3].T + cam_from_world[:, 3]  # (T, 3)
    depth = np.where(in_cam[:, 2:] > 0, in_cam[:, 2:], np.nan)
    return np.concatenate([(in_cam @ K.T)[:, :2] / depth, size * np.diag(K)[:2] / depth], 1)


def project_half_intervals(ends: Array, img_from_world: Array) -> Array:
    """Return half the vector (T, 2) px between the projected ends of intervals (T, 2, 3).

    NaN where unknown or behind the camera.
    """
    in_image = ends @ img_from_world[:, :3].T + img_from_world[:, 3]  # (T, 2, 3)
    depth = np.where(in_image[..., 2:] > 0, in_image[..., 2:], np.nan)
    xy = in_image[..., :2] / depth
    return np.asarray((xy[:, 1] - xy[:, 0]) / 2)


def iou_within_uncertainty(box: Array, uncertainty: Array, detected: Array) -> tuple[Array, Array]:
    """Compare boxes of uncertain position with detections, each moved to where it fits best.

    Args:
        box, detected: (4, ...) cx, cy, w, h. uncertainty: (2, ...) px that a box may be off.
    Returns:
        iou: (...) after that move. weight: (...) of the overlap as evidence: area of the box over
        the area that it may cover.
    """
    distance = np.maximum(np.abs(box[:2] - detected[:2]) - uncertainty, 0)  # (2, ...)
    a = box[2:]
    b = detected[2:]
    width, height = np.maximum(np.minimum(np.minimum(a, b), (a + b) / 2 - distance), 0)
    overlap = width * height
    union = a[0] * a[1] + b[0] * b[1] - overlap
    x, y = a / np.maximum(a + 2 * uncertainty, 1e-9)
    return overlap / np.maximum(union, 1e-9), x * y
