"""Log odds that detections show objects, and of sizes: the terms of the association's objective.

For a detection and an object these are the log odds that the detector saw this object, against a
detection of anything else: from the box and the object's projection, the score and the class. A box
inside the projection may show a half-occluded object; a box that extends beyond it may not. For an
object they are those of its size by the prior of its category.

Axes: V frames with a pose, O objects, N detections, M pairs of an object and a detection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.types import Array, BoolArray, IntArray, box_area

# Measured on hololens_kitchen and redkitchen unless a source is given (benchmarks/RESULTS.md).
EDGE_SIGMA = 0.08  # of an edge of a box, over the size of the box
# Fraction of edges that are occluded (measured on hololens_kitchen's chairs: .29 of the upper ones,
# .53 of the lower), and of edges that are outliers (as in quadrics.py)
OCCLUDED_EDGES = 0.3
OUTLIER_EDGES = 0.02
CLUTTER_LOG_SIZES = 3.0  # range of the log width and of the log height of clutter boxes
# Upper limits on the log odds of a box: for an object against clutter (clutter boxes cluster around
# objects, they are not uniform), and for choosing between objects
MAX_BOX_EXISTENCE = 2.5
MAX_BOX_ASSIGNMENT = 8.0
CLASS_KEPT = 0.85  # of an object's detections have its class; the others have any class
MIN_VISIBLE = 0.05  # least fraction of a projected box in the image to compare it with detections
EXPECTED = 0.6  # and to expect a detection
# Depths of the sparse points in the inner part of a box: their range elsewhere (log), their sigma
# about the solid (log), the probability that they are of the object, and the inner part
LOG_DEPTHS = 3.0
DEPTH_SIGMA = 0.15
POINTS_ON_OBJECT = 0.8
INNER_BOX = 0.6
DEPTH_QUANTILES = 9
MIN_POINTS = 5  # of a box


@dataclass(frozen=True, slots=True)
class PosedDetections:
    """Detections in frames with a pose.

    Attributes:
        view: (N,) frame, 0 .. V - 1, ascending. box: (N, 4) xyxy in undistorted pixels.
        score, class_id: (N,). before, after: (N,) previous and next row of the tracklet, or -1.
        img_from_world: (V, 3, 4). image_size: (w, h) px.
        depths: (N, DEPTH_QUANTILES) quantiles of the depths of sparse points in the box, NaN: none.
    """

    view: IntArray
    box: Array
    score: Array
    class_id: IntArray
    before: IntArray
    after: IntArray
    img_from_world: Array
    image_size: tuple[int, int]
    depths: Array

    @property
    def start_of_view(self) -> IntArray:
        """(V + 1,) first row of every frame, and the end."""
        return np.searchsorted(self.view, np.arange(len(self.img_from_world) + 1))


@dataclass(frozen=True, slots=True)
class Shapes(quadrics.Rows):
    """Shapes of O objects, each with a class.

    Attributes:
        ellipsoids: centres, half extents, rotations. shape: (O,) names of the kind of shape.
        class_id: (O,).
    """

    ellipsoids: quadrics.Ellipsoids
    shape: npt.NDArray[np.str_]
    class_id: IntArray


NO_SHAPES = Shapes(quadrics.Ellipsoids.unknown(0), np.empty(0, str), np.empty(0, np.int64))


@dataclass(frozen=True, slots=True)
class Evidence:
    """Pairs of an object and a detection that may show it, by object, then by detection.

    Attributes:
        obj, row: (M,). existence: (M,) log odds of the object against clutter. assignment: (M,) the
            same with the higher limit on the box, to choose between objects.
        expected: (V, O) frames in which a detection is expected.
    """

    obj: IntArray
    row: IntArray
    existence: Array
    assignment: Array
    expected: BoolArray


def gather_evidence(shapes: Shapes, detections: PosedDetections, min_log_odds: float) -> Evidence:
    """Compare the projections of objects with the detections of all frames.

    Args:
        min_log_odds: pairs of a lower `assignment` are dropped.
    """
    votes = np.bincount(detections.class_id.clip(0), detections.score) + 0.5
    frequency = votes / votes.sum()  # of the classes in all detections
    size = detections.image_size
    score_log_odds = logit(detections.score)
    starts = detections.start_of_view
    expected = np.zeros((len(detections.img_from_world), len(shapes)), bool)
    found = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0))]
    chunk = 1 + 30_000 // (1 + len(shapes))  # frames that are compared together, bounds the memory
    for first in range(0, len(expected), chunk):
        cams = detections.img_from_world[first : first + chunk]
        whole = quadrics.solid_boxes(shapes.ellipsoids, list(shapes.shape), cams)  # (v, O, 4)
        clipped = quadrics.clip_boxes(whole, size)
        visible = np.nan_to_num(box_area(clipped) / box_area(whole))  # (v, O)
        expected[first : first + chunk] = visible > EXPECTED
        pairs = list[tuple[IntArray, IntArray]]()
        for v in range(len(cams)):
            shown = np.flatnonzero(visible[v] > MIN_VISIBLE)
            rows = slice(starts[first + v], starts[first + v + 1])
            i, j = np.nonzero(_overlapping(clipped[v, shown], detections.box[rows]))
            pairs.append((shown[i], starts[first + v] + j))
        obj, row = (np.concatenate(column) for column in zip(*pairs, strict=True))
        box = _box_log_odds(clipped[detections.view[row] - first, obj], detections.box[row], size)
        row_class = detections.class_id[row]
        same_class = shapes.class_id[obj] == row_class
        rest = score_log_odds[row]
        rest += np.log(CLASS_KEPT * same_class / frequency[row_class.clip(0)] + 1 - CLASS_KEPT)
        rest += _depth_log_odds(
            *_depth_span(shapes.ellipsoids[obj], detections.img_from_world[detections.view[row]]),
            detections.depths[row],
        )
        assignment = box.clip(max=MAX_BOX_ASSIGNMENT) + rest
        existence = box.clip(max=MAX_BOX_EXISTENCE) + rest
        keep = assignment > min_log_odds
        found.append((obj[keep], row[keep], existence[keep], assignment[keep]))
    obj, row, existence, assignment = (
        np.concatenate(column) for column in zip(*found, strict=True)
    )
    order = np.lexsort((row, obj))
    return Evidence(obj[order], row[order], existence[order], assignment[order], expected)


def _depth_span(solids: quadrics.Ellipsoids, cams: Array) -> tuple[Array, Array]:
    """Return the least and largest depth (K,) of solids in cameras (K, 3, 4)."""
    axis = cams[:, 2, :3]
    middle = (axis * solids.center_in_world).sum(1) + cams[:, 2, 3]
    in_object = np.einsum("ki,kij->kj", axis, solids.world_from_obj)
    half = np.linalg.norm(in_object * solids.half_axes, axis=1)
    return np.maximum(middle - half, 0.1 * middle), middle + half


def _depth_log_odds(near: Array, far: Array, depths: Array) -> Array:
    """Compare depths (K, Q) of points in boxes with spans (K,) of depth: log odds against clutter.

    Points of the object are uniform over its span in log depth, others over LOG_DEPTHS. 0: none.
    """
    known = np.isfinite(depths[:, 0])
    log_depth = np.log(np.where(known[:, None], depths, 1.0))
    low = np.log(near)[:, None]
    high = np.log(far)[:, None]
    beyond = np.maximum(low - log_depth, log_depth - high).clip(0)
    on_it = np.exp(-0.5 * (beyond / DEPTH_SIGMA) ** 2).mean(1)
    span = (high - low)[:, 0] + 2.5 * DEPTH_SIGMA  # sqrt(2 pi) sigma: the area of both tails
    odds = POINTS_ON_OBJECT * on_it * LOG_DEPTHS / span + 1 - POINTS_ON_OBJECT
    return np.where(known, np.log(odds), 0.0)


def logit(score: Array) -> Array:
    """Turn scores into log odds: detectors are roughly calibrated (benchmarks/RESULTS.md)."""
    score = score.clip(1e-3, 1 - 1e-3)
    return np.asarray(np.log(score / (1 - score)))


def _overlapping(a: Array, b: Array) -> BoolArray:
    """Mark pairs (A, B) of boxes whose overlap is more than a quarter of the smaller one.

    (The least overlap saves the time of comparing the others.)
    """
    (ax, ay, ax2, ay2), (bx, by, bx2, by2) = a.T[..., None], b.T  # (A, 1), (B,) each
    width = np.minimum(ax2, bx2) - np.maximum(ax, bx)  # (A, B)
    height = np.minimum(ay2, by2) - np.maximum(ay, by)
    smaller = np.minimum(box_area(a)[:, None], box_area(b))
    return np.asarray(width.clip(0) * height.clip(0) > smaller / 4)


def _box_log_odds(projected: Array, box: Array, image_size: tuple[int, int]) -> Array:
    """Compare boxes (K, 4) with projections (K, 4): log density ratio to clutter."""
    # float32 in contiguous rows of K: a third of the time, accurate to .001
    expected, measured = (np.ascontiguousarray(x.T, np.float32) for x in (projected, box))  # (4, K)
    expected_size, measured_size = ((x[2:] - x[:2]).clip(1e-6) for x in (expected, measured))
    size = (expected_size + measured_size) / 2  # (2, K)
    inside = np.stack([measured[:2] - expected[:2], expected[2:] - measured[2:]])
    inside /= size  # (2, 2, K) distance of each edge inside the projection
    gaussian = np.exp(inside * inside * np.float32(-0.5 / EDGE_SIGMA**2))
    gaussian *= np.float32((1 - OCCLUDED_EDGES - OUTLIER_EDGES) / (np.sqrt(2 * np.pi) * EDGE_SIGMA))
    across = expected_size / size  # an occluded edge is uniform over the projection
    occluded = ((inside >= 0) & (inside <= across)) / across
    density = gaussian + np.float32(OCCLUDED_EDGES) * occluded
    density = density + np.float32(OUTLIER_EDGES / CLUTTER_LOG_SIZES)
    clutter = (size * size / measured_size).prod(0) / (image_size[0] * image_size[1])
    clutter /= np.float32(CLUTTER_LOG_SIZES**2)
    edges = density[0, 0] * density[0, 1] * density[1, 0] * density[1, 1]
    return np.asarray(np.log(edges / clutter), np.float64)


# ---- Sizes ----

SIZE_SIGMAS = 6.0  # limit on the deviation of a size: a class may be wrong (3 and 12 are alike)


def name_of(class_names: Sequence[str], class_id: int) -> str:
    """Return the name of a class, "object" if it has none."""
    return class_names[class_id] if 0 <= class_id < len(class_names) else "object"


def on_floor(priors: quadrics.Priors, names: list[str]) -> BoolArray:
    """Mark the categories (G,) that stand on the floor."""
    return np.asarray(priors.of("on_floor", priors.index(names)), bool)


@dataclass(frozen=True, slots=True)
class Categories:
    """Size priors of the classes of a detector, in units of the world.

    Attributes:
        names: of the classes, and "" at the end. scale: metres per unit.
    """

    priors: quadrics.Priors
    names: npt.NDArray[np.str_]
    scale: quadrics.Scale

    def rows(self, classes: IntArray) -> IntArray:
        """Return the rows (G,) of classes in the priors, -1 unknown."""
        return self.priors.index(self.names[classes.clip(-1, len(self.names) - 1)].tolist())

    def usual_size(self, classes: IntArray) -> Array:
        """Return width, depth and height (G, 3)."""
        log_size = self.priors.of("log_mean", self.rows(classes))
        return np.asarray(np.exp(log_size) / self.scale.value)

    def on_floor(self, classes: IntArray) -> BoolArray:
        """Mark the classes (G,) that stand on the floor."""
        return np.asarray(self.priors.of("on_floor", self.rows(classes)), bool)

    def size_log_odds(self, shapes: Shapes) -> Array:
        """Return the log odds (O,) of the sizes, 0 at the usual size, rotated by 90 deg or not."""
        rows = self.rows(shapes.class_id)
        no_scale = quadrics.UNKNOWN_SCALE_LOG
        sigma = no_scale if self.scale.source == "none" else self.scale.rel_sigma
        cov = self.priors.of("log_cov", rows)
        cov[rows < 0] = no_scale**2 * np.eye(3)
        cov += sigma**2
        size = np.log(2 * shapes.ellipsoids.half_axes)
        off = size[:, [[0, 1, 2], [1, 0, 2]]] - np.log(self.usual_size(shapes.class_id))[:, None]
        square = np.einsum("ski,sij,skj->sk", off, np.linalg.inv(cov), off).min(1)  # (O,)
        return np.asarray(-0.5 * np.nan_to_num(square, nan=np.inf).clip(max=SIZE_SIGMAS**2))
