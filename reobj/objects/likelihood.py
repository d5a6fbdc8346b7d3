"""Log odds that detections show objects: the terms of the association's objective.

For a detection and an object these are the log odds that the detector saw this object, against a
detection of anything else: from the box and the object's projection, the score and the class. A box
inside the projection may show a half-occluded object; a box that extends beyond it may not.

Axes: V frames with a pose, O objects, N detections, M pairs of an object and a detection.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.objects.phases import Reach, ignore
from reobj.types import Array, BoolArray, IntArray, box_area

# Chosen on hololens_kitchen and redkitchen unless a source is given (benchmarks/RESULTS.md).
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
class Shapes:
    """Shapes of O objects, each with a class.

    Attributes:
        ellipsoids: centres, half extents, rotations. support: (O,) names of the kind of shape.
        class_id: (O,).
    """

    ellipsoids: quadrics.Ellipsoids
    support: npt.NDArray[np.str_]
    class_id: IntArray

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, keep: Any) -> Shapes:
        return Shapes(self.ellipsoids[keep], self.support[keep], self.class_id[keep])

    @staticmethod
    def concatenate(sets: list[Shapes]) -> Shapes:
        """Concatenate sets of shapes."""
        names = ("center_in_world", "half_axes", "world_from_obj")
        arrays = [np.concatenate([getattr(s.ellipsoids, name) for s in sets]) for name in names]
        return Shapes(
            quadrics.Ellipsoids(*arrays),
            np.concatenate([s.support for s in sets]),
            np.concatenate([s.class_id for s in sets]),
        )


NO_SHAPES = Shapes(
    quadrics.Ellipsoids(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3))),
    np.empty(0, str),
    np.empty(0, np.int64),
)


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


def gather_evidence(
    shapes: Shapes,
    detections: PosedDetections,
    min_log_odds: float,
    at_once: int = 500,
    reach: Reach = ignore,
) -> Evidence:
    """Compare the projections of objects with the detections of all frames.

    Args:
        min_log_odds: pairs of a lower `assignment` are dropped.
        at_once: objects that are projected together, to bound the memory.
        reach: reports the progress of the hypotheses.
    """
    votes = np.bincount(detections.class_id.clip(0), detections.score) + 0.5
    frequency: Array = np.asarray(votes, np.float64)
    frequency /= frequency.sum()
    starts = range(0, max(len(shapes), 1), at_once)
    batches = list[Evidence]()
    for done, k in enumerate(starts):
        batches.append(_gather(shapes[k : k + at_once], detections, frequency, min_log_odds))
        reach("hypotheses", (done + 0.8) / len(starts))  # the selection follows
    return Evidence(
        np.concatenate([batch.obj + k for k, batch in zip(starts, batches, strict=True)]),
        np.concatenate([batch.row for batch in batches]),
        np.concatenate([batch.existence for batch in batches]),
        np.concatenate([batch.assignment for batch in batches]),
        np.concatenate([batch.expected for batch in batches], 1),
    )


def _gather(
    shapes: Shapes, detections: PosedDetections, frequency: Array, min_log_odds: float
) -> Evidence:
    """Gather the evidence of some objects.

    Args:
        frequency: of the classes in all detections.
    """
    size = detections.image_size
    score_log_odds = logit(detections.score)
    starts = detections.start_of_view
    expected = np.zeros((len(detections.img_from_world), len(shapes)), bool)
    found: list[tuple[IntArray, IntArray, Array, Array]] = []
    chunk = 64  # frames whose pairs are compared together, to bound the memory
    for first in range(0, len(expected), chunk):
        cams = detections.img_from_world[first : first + chunk]
        whole = quadrics.solid_boxes(shapes.ellipsoids, list(shapes.support), cams)  # (v, O, 4)
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
        obj_class = shapes.class_id[obj]
        row_class = detections.class_id[row]
        class_log_odds = np.log(
            CLASS_KEPT * (obj_class == row_class) / frequency[row_class.clip(0)] + 1 - CLASS_KEPT
        )
        rest = score_log_odds[row] + class_log_odds
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

    (The least overlap saves the time of comparing the others; chosen.)
    """
    (ax, ay, ax2, ay2), (bx, by, bx2, by2) = a.T[..., None], b.T  # (A, 1), (B,) each
    width = np.minimum(ax2, bx2) - np.maximum(ax, bx)  # (A, B)
    height = np.minimum(ay2, by2) - np.maximum(ay, by)
    smaller = np.minimum(box_area(a)[:, None], box_area(b))
    return np.asarray(width.clip(0) * height.clip(0) > smaller / 4)


def _box_log_odds(projected: Array, box: Array, image_size: tuple[int, int]) -> Array:
    """Compare boxes (K, 4) with projections (K, 4): log density over that of clutter."""
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
