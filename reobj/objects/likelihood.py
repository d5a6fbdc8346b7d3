"""Log odds that detections show solids: what the association adds up.

For a detection and a solid these are the odds that the detector saw this solid there, against a
detection of something else: by its box beside the solid's projection, its score and its class. A
box inside the projection may be of a thing that is half hidden; one outside may not.

Axes: V frames with a pose, S solids, N detections, M pairs of a solid and a detection.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.types import Array, BoolArray, IntArray, box_area

# Chosen on hololens_kitchen and redkitchen, but for those with a source (docs/tracking.md).
EDGE_SIGMA = 0.08  # of an edge of a box, over the size of the box
# Shares of edges that are hidden (measured on hololens_kitchen's chairs: .29 of the upper ones, .53
# of the lower), and that are anywhere (as quadrics.py)
HIDDEN, WRONG = 0.3, 0.02
CLUTTER_LOG_SIZES = 3.0  # range of the log of the width and of the height of other boxes
# Most that a box says for a solid against no solid: other boxes gather around things, they do not
# lie anywhere. And for one solid against another.
MAX_BOX_LOG_ODDS, MAX_BOX_CHOICE = 2.5, 8.0
CLASS_KEPT = 0.85  # of the detections of a thing have its class; the others any
MIN_VISIBLE = 0.05  # share of a projected box in the image from which detections are compared
EXPECTED = 0.6  # and from which one is expected
MIN_OVERLAP = 0.25  # of the smaller box, for a pair to be compared (chosen: speed)
MIN_LOG_ODDS = -6.0  # of a pair that is kept (chosen: a tracklet is worth less)


@dataclass(frozen=True, slots=True)
class Detected:
    """Detections in frames with a pose.

    Attributes:
        view: (N,) frame, 0 .. V - 1, ascending. box: (N, 4) xyxy in undistorted pixels.
        score, class_id: (N,). before, after: (N,) the tracklet's rows before and after, or -1.
        img_from_world: (V, 3, 4). image_size: (w, h) px.
    """

    view: IntArray
    box: Array
    score: Array
    class_id: IntArray
    before: IntArray
    after: IntArray
    img_from_world: Array
    image_size: tuple[int, int]

    @property
    def rows_of_view(self) -> IntArray:
        """(V + 1,) first row of every frame, and the end."""
        return np.searchsorted(self.view, np.arange(len(self.img_from_world) + 1))


@dataclass(frozen=True, slots=True)
class Solids:
    """S solids, each of a class.

    Attributes:
        ellipsoids: centres, half extents, rotations. support: (S,) names. class_id: (S,).
    """

    ellipsoids: quadrics.Ellipsoids
    support: npt.NDArray[np.str_]
    class_id: IntArray

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, keep: Any) -> Solids:
        return Solids(self.ellipsoids[keep], self.support[keep], self.class_id[keep])

    @staticmethod
    def concatenate(sets: list[Solids]) -> Solids:
        """Put sets of solids behind each other."""
        names = ("center_in_world", "half_axes", "world_from_obj")
        arrays = [np.concatenate([getattr(s.ellipsoids, name) for s in sets]) for name in names]
        return Solids(
            quadrics.Ellipsoids(*arrays),
            np.concatenate([s.support for s in sets]),
            np.concatenate([s.class_id for s in sets]),
        )


NO_SOLIDS = Solids(
    quadrics.Ellipsoids(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3))),
    np.empty(0, str),
    np.empty(0, np.int64),
)


@dataclass(frozen=True, slots=True)
class Evidence:
    """Pairs of a solid and a detection that may be of it, by solid and then by detection.

    Attributes:
        solid, row: (M,). log_odds: (M,) of the solid against no solid at all. choice: (M,) the
            same without its limit, to choose among solids.
        expected: (V, S) where a detection should be.
    """

    solid: IntArray
    row: IntArray
    log_odds: Array
    choice: Array
    expected: BoolArray


SOLIDS_AT_ONCE = 500  # that are projected together (chosen: memory)
FRAMES_AT_ONCE = 64  # whose pairs are compared together (chosen: memory)


def gather_evidence(solids: Solids, detected: Detected, least: float = MIN_LOG_ODDS) -> Evidence:
    """Compare the projections of solids with the detections of all frames.

    Args:
        least: `choice` above which pairs are kept.
    """
    share = np.asarray(np.bincount(detected.class_id.clip(0), detected.score) + 0.5, np.float64)
    share /= share.sum()
    starts = range(0, max(len(solids), 1), SOLIDS_AT_ONCE)
    parts = [_gather(solids[k : k + SOLIDS_AT_ONCE], detected, share, least) for k in starts]
    solid = np.concatenate([part.solid + k for k, part in zip(starts, parts, strict=True)])
    row = np.concatenate([part.row for part in parts])
    log_odds = np.concatenate([part.log_odds for part in parts])
    choice = np.concatenate([part.choice for part in parts])
    expected = np.concatenate([part.expected for part in parts], 1)
    return Evidence(solid, row, log_odds, choice, expected)


def _gather(solids: Solids, detected: Detected, share: Array, least: float) -> Evidence:
    """Gather the evidence of some solids.

    Args:
        share: of the classes in all detections. least: `choice` above which pairs are kept.
    """
    cams, size = detected.img_from_world, detected.image_size
    whole = quadrics.solid_boxes(solids.ellipsoids, list(solids.support), cams)  # (V, S, 4)
    seen = quadrics.clip_boxes(whole, size)
    visible = np.nan_to_num(box_area(seen) / box_area(whole))  # (V, S)
    of_detection = logit(detected.score)
    starts = detected.rows_of_view
    found: list[tuple[IntArray, IntArray, Array, Array]] = []
    for first in range(0, len(cams), FRAMES_AT_ONCE):
        pairs = list[tuple[IntArray, IntArray]]()
        for v in range(first, min(first + FRAMES_AT_ONCE, len(cams))):
            here = np.flatnonzero(visible[v] > MIN_VISIBLE)
            rows = slice(starts[v], starts[v + 1])
            i, j = np.nonzero(_overlapping(seen[v, here], detected.box[rows]))
            pairs.append((here[i], starts[v] + j))
        solid, row = (np.concatenate(column) for column in zip(*pairs, strict=True))
        box = _box_log_odds(seen[detected.view[row], solid], detected.box[row], size)
        own, other = solids.class_id[solid], detected.class_id[row]
        named = np.log(CLASS_KEPT * (own == other) / share[other.clip(0)] + 1 - CLASS_KEPT)
        rest = of_detection[row] + named
        choice = box.clip(max=MAX_BOX_CHOICE) + rest
        keep = choice > least
        log_odds = box.clip(max=MAX_BOX_LOG_ODDS) + rest
        found.append((solid[keep], row[keep], log_odds[keep], choice[keep]))
    solid, row, log_odds, choice = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((row, solid))
    return Evidence(solid[order], row[order], log_odds[order], choice[order], visible > EXPECTED)


def logit(score: Array) -> Array:
    """Turn scores into log odds: detectors are calibrated about so (docs/tracking.md)."""
    score = score.clip(1e-3, 1 - 1e-3)
    return np.asarray(np.log(score / (1 - score)))


def _overlapping(a: Array, b: Array) -> BoolArray:
    """Mark pairs (A, B) of boxes that share enough of the smaller one's area."""
    (ax, ay, ax2, ay2), (bx, by, bx2, by2) = a.T[..., None], b.T  # (A, 1), (B,) each
    width = np.minimum(ax2, bx2) - np.maximum(ax, bx)  # (A, B)
    height = np.minimum(ay2, by2) - np.maximum(ay, by)
    least = np.minimum(box_area(a)[:, None], box_area(b))
    return np.asarray(width.clip(0) * height.clip(0) > MIN_OVERLAP * least)


def _box_log_odds(projected: Array, box: Array, image_size: tuple[int, int]) -> Array:
    """Compare boxes (K, 4) with projections (K, 4): log density over that of boxes anywhere."""
    # float32 in rows of K, each in one piece: a third of the time, and right to .001
    of, at = (np.ascontiguousarray(x.T, np.float32) for x in (projected, box))  # (4, K)
    whole, shown = ((x[2:] - x[:2]).clip(1e-6) for x in (of, at))  # (2, K) widths and heights
    size = (whole + shown) / 2
    inside = np.stack([at[:2] - of[:2], of[2:] - at[2:]])
    inside /= size  # (2, 2, K) how far each edge lies inside the projection
    gaussian = np.exp(inside * inside * np.float32(-0.5 / EDGE_SIGMA**2))
    gaussian *= np.float32((1 - HIDDEN - WRONG) / (np.sqrt(2 * np.pi) * EDGE_SIGMA))
    across = whole / size  # of a hidden edge, which may be anywhere in the projection
    hidden = ((inside >= 0) & (inside <= across)) / across
    density = gaussian + np.float32(HIDDEN) * hidden + np.float32(WRONG / CLUTTER_LOG_SIZES)
    anywhere = (size * size / shown).prod(0) / (image_size[0] * image_size[1])
    anywhere /= np.float32(CLUTTER_LOG_SIZES**2)
    edges = density[0, 0] * density[0, 1] * density[1, 0] * density[1, 1]
    return np.asarray(np.log(edges / anywhere), np.float64)
