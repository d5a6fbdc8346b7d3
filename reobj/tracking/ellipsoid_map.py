"""3D state of the online tracker: ellipsoids of known identities, depth intervals of new tracks.

`EllipsoidMap` fits an ellipsoid to every identity that was seen from several directions. Before
that, a track lies on its viewing ray within a *depth interval*, estimated from the sparse points in
its box (`depth_intervals`). Both are projected to predict where a track is seen next, and with what
uncertainty in pixels. Results do not depend on the unit of the world.

Axes: I identities, V views, G groups of boxes, D detections, T tracks, N points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, VisiblePoints, scaled_camera, viewing_rays
from reobj.types import Array, BoolArray, IntArray, box_area, cxcywh_from_xyxy

# ---- Ellipsoids of identities ------------------------------------------------------------------


VIEWS = 16  # V, kept of every identity: memory, and time of a fit
# between the views of a fit; lower: positions whose depth is the prior of the size, higher: objects
# are unknown until the camera has walked round them
MIN_PARALLAX_DEG = 2.0


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

    Attributes:
        frame: (I, V) frame of each view, -1: free slot. boxes: (I, V, 4) x1, y1, x2, y2.
        img_from_world: (I, V, 3, 4). rays: (I, V, 3) viewing rays, NaN: free slot.
        step_deg: (I,) least angle between the rays of two views. fresh: (I,) views since the fit.
        size: (I, V) rough size, NaN unknown. dual_q: (I, 4, 4) dual quadrics, NaN unknown.
        ends: (I, 2, 3) centre -+ one sigma along the axis of largest uncertainty.
        given: (I,) ellipsoids known from a map of the room; they are not fitted.
    """

    # values of a new identity; step_deg is doubled when all slots are used
    NEW: ClassVar[dict[str, npt.NDArray[Any]]] = {
        "frame": np.full(VIEWS, -1, np.int64), "boxes": np.zeros((VIEWS, 4)),
        "img_from_world": np.zeros((VIEWS, 3, 4)), "rays": np.full((VIEWS, 3), np.nan),
        "step_deg": np.array(1.0), "fresh": np.array(0, np.int64), "size": np.full(VIEWS, np.nan),
        "dual_q": np.full((4, 4), np.nan), "ends": np.full((2, 3), np.nan),
        "given": np.array(False),
    }  # fmt: skip
    ARRAYS = tuple(NEW)
    frame: IntArray
    boxes: Array
    img_from_world: Array
    rays: Array
    step_deg: Array
    fresh: IntArray
    size: Array
    dual_q: Array
    ends: Array
    given: BoolArray

    def __init__(self) -> None:
        for name, new in self.NEW.items():
            setattr(self, name, new[None][:0])

    def give(self, ellipsoids: quadrics.Ellipsoids, cov: Array) -> None:
        """Set the ellipsoids of the first identities, which are then not fitted.

        Args:
            ellipsoids: I; NaN: unknown, fitted as others. cov: (I, 3, 3) of their centres.
        """
        count = len(ellipsoids)
        self._grow(count)
        finite = np.isfinite(ellipsoids.dual_quadrics()).all((1, 2)) & np.isfinite(cov).all((1, 2))
        known = np.asarray(finite, bool)
        self._set(np.arange(count), ellipsoids, cov, known)
        self.given[:count] = known

    def _set(
        self, identity: IntArray, ellipsoids: quadrics.Ellipsoids, cov: Array, known: BoolArray
    ) -> None:
        """Set the ellipsoids of identities (n,), unknown where `known` is False.

        Args:
            cov: (n, 3, 3) of the centres.
        """
        known = known[:, None, None]
        value, vector = np.linalg.eigh(np.where(known, cov, 0.0))
        sigma = np.sqrt(value[:, -1:].clip(0)) * vector[..., -1]  # (n, 3)
        centre = ellipsoids.center_in_world
        ends = np.stack([centre - sigma, centre + sigma], 1)  # (n, 2, 3)
        self.dual_q[identity] = np.where(known, ellipsoids.dual_quadrics(), np.nan)
        self.ends[identity] = np.where(known, ends, np.nan)

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
        """Fit the ellipsoids of all identities that are due, in a few steps.

        The world may have any unit: its scale for the size prior of the fit is that of the usual
        rough size. A fit that is rejected, lacks parallax or is a needle makes the position
        unknown.

        Returns:
            Whether any was due.
        """
        due = np.flatnonzero(self.due)
        if not len(due):
            return False
        at, slot = np.nonzero(self.frame[due] >= 0)
        views = (due[at], slot)
        frames, first, row = np.unique(self.frame[views], return_index=True, return_inverse=True)
        boxes = np.full((len(frames), len(due), 4), np.nan)  # (F, O, 4)
        boxes[row, at] = self.boxes[views]
        cameras = self.img_from_world[views][first]  # (F, 3, 4)
        self.size[views] = rough_sizes(boxes, cameras)[row, at]
        known = self.size[self.size > 0]  # False for NaN
        usual_size = np.median(known) if len(known) else 1.0
        usual_m = np.exp(np.log(quadrics.UNKNOWN_SIZE.mean_m).mean())
        fits = quadrics.fit_objects(
            boxes, cameras, image_size, support="ellipsoid",
            metric=quadrics.Scale(float(usual_m / usual_size), 0.0, "usual size"),
            config=quadrics.FitConfig(iterations=10, start_views=4, start_iterations=4),
        )  # fmt: skip
        good = (fits.status != "rejected") & (fits.parallax_deg >= MIN_PARALLAX_DEG)  # (O,)
        axes = np.sort(fits.ellipsoids.half_axes, 1)  # (O, 3)
        good &= axes[:, 2] <= MAP_MAX_ELONGATION * axes[:, 1]
        self._set(due, fits.ellipsoids, fits.cov[:, :3, :3], good)
        self.fresh[due] = 0
        return True

    @property
    def known(self) -> BoolArray:
        """(I,) identities whose 3D position is known."""
        return np.asarray(np.isfinite(self.dual_q[:, 0, 0]), bool)

    def project(
        self, img_from_world: Array, image_size: tuple[int, int], min_visible: float = 0.0
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
        seen = in_front[0] & (box_area(clipped) > min_visible * box_area(boxes))
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
        known = rows_of(self.known, identity, False)[:, None]
        ellipsoid_boxes = rows_of(self.project(view, image_size), identity, np.nan)
        interval_boxes = project_depth_intervals(ends, size, K, cam_from_world)
        boxes = np.where(known, ellipsoid_boxes, interval_boxes)
        ends = np.where(known[..., None], rows_of(self.ends, identity, np.nan), ends)
        return boxes, np.nan_to_num(project_half_intervals(ends, view))

    def overlap(
        self, box: Array, identity: IntArray, view: Array | None, image_size: tuple[int, int]
    ) -> tuple[Array, Array]:
        """Compare boxes (n, 4) cx, cy, w, h with identities (I,), within two sigma.

        Args:
            view: (3, 4) img_from_world; None: without a pose nothing is known.
        Returns:
            iou: (n, I), NaN unknown. weight: (I,) of the overlap (`iou_within_uncertainty`).
        """
        if view is None:
            return np.full((len(box), len(identity)), np.nan), np.ones(len(identity))
        projected = rows_of(self.project(view, image_size), identity, np.nan)  # (I, 4)
        ends = rows_of(self.ends, identity, np.nan)
        uncertainty = np.nan_to_num(2 * np.abs(project_half_intervals(ends, view)))  # (I, 2)
        iou, weight = iou_within_uncertainty(
            projected.T[:, None], uncertainty.T[:, None], box.T[..., None]
        )  # (n, I), (1, I)
        known = rows_of(self.known, identity, False)
        return np.where(known, np.nan_to_num(iou), np.nan), np.nan_to_num(weight[0])

    def _grow(self, identities: int) -> None:
        extra = identities - len(self.frame)
        if extra > 0:
            extra = max(extra, len(self.frame), 16)  # doubling: amortised O(1)
            for name, new in self.NEW.items():
                rows = np.broadcast_to(new, (extra, *new.shape))
                setattr(self, name, np.concatenate([getattr(self, name), rows]))


def rows_of(rows: Any, identity: IntArray, missing: Any) -> npt.NDArray[Any]:
    """Take rows (T, ...) of a table of identities (I, ...), `missing` beyond its end or at -1."""
    table = np.concatenate([rows, np.full((1, *rows.shape[1:]), missing, rows.dtype)])
    return np.asarray(table[np.where(identity < len(rows), identity, -1)])


# ---- Depth intervals of tracks -----------------------------------------------------------------


def camera_inputs(poses: Poses | None, scale: float) -> Callable[[int], dict[str, Any]]:
    """Return a function: number of a frame in the source -> keyword arguments of `Tracker.update`.

    These are pose, camera, points and component. The points are those nearby, not only those in the
    image: their median depth is the fallback of boxes without points (cropping them would change
    depth intervals).

    Args:
        poses: of the video; None: no camera inputs. scale: px of the frames per native px.
    """
    if poses is None:
        return lambda _: {}
    row_of = {frame: row for row, frame in enumerate(poses.frame.tolist())}
    camera = scaled_camera(poses.camera, scale)
    visible = VisiblePoints(poses)

    def inputs(frame: int) -> dict[str, Any]:
        row = row_of.get(frame)
        if row is None:
            return {}
        points = np.asarray(poses.points[visible.nearby(row)], np.float64)
        pose = poses.cam_from_world[row]
        component = int(poses.part[row])
        return {"cam_from_world": pose, "camera": camera, "points": points, "part": component}

    return inputs


MIN_POINTS = 3  # in a box to estimate its depth; fewer have no median and spread


def depth_intervals(
    xyxy: Array, points: Array, cam_from_world: Array, K: Array
) -> tuple[Array, Array]:
    """Estimate the depth intervals of the objects in boxes from the sparse points in the boxes.

    The depth is the median over the points in the middle half of a box, else in the whole box, else
    in the image. Its sigma is their spread (MAD), but at least half the size of the object.

    Args:
        xyxy: (D, 4) px. points: (N, 3) in world, seen in this frame.
    Returns:
        ends: (D, 2, 3) in world, end points of the interval on the viewing ray, one sigma in front
        of and behind the depth. size: (D, 2) width and height there, in the unit of the world. NaN
        with fewer than MIN_POINTS points.
    """
    in_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]  # (N, 3)
    in_cam = in_cam[in_cam[:, 2] > 0]
    if len(in_cam) < MIN_POINTS:
        return np.full((len(xyxy), 2, 3), np.nan), np.full((len(xyxy), 2), np.nan)
    xy = (in_cam @ K.T)[:, :2] / in_cam[:, 2:]
    log_depth = np.log(in_cam[:, 2])
    box = cxcywh_from_xyxy(xyxy)
    offset = np.abs(xy - box[:, None, :2]) / box[:, None, 2:].clip(1e-9)  # (D, N, 2) box sizes
    offset = offset.max(-1)  # (D, N)
    median = np.empty((len(xyxy), 1))
    sigma = np.empty((len(xyxy), 1))
    for d, distance in enumerate(offset):  # each box has its own number of points
        sets = (log_depth[distance < limit] for limit in (0.25, 0.5, np.inf))
        found = next(s for s in sets if len(s) >= MIN_POINTS)
        median[d] = np.median(found)
        sigma[d] = 1.4826 * np.median(np.abs(found - median[d]))  # normal distribution
    per_depth = box[:, 2:] / np.diag(K)[:2]  # (D, 2) width and height over the depth
    least = per_depth.mean(1, keepdims=True) / 2
    depth = np.exp(median + np.maximum(sigma, least) * [-1, 1])  # (D, 2)
    rays = np.c_[box[:, :2], np.ones(len(box))] @ np.linalg.inv(K).T  # (D, 3) depth 1
    ends = (depth[..., None] * rays[:, None] - cam_from_world[:, 3]) @ cam_from_world[:, :3]
    return ends, per_depth * depth.mean(1, keepdims=True)  # R' (x - t)


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
