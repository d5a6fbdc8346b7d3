"""Which detection belongs to which track: pairs that may, which of them compete, who gets whom.

Only pairs that pass a gate are looked at, a few a track: what grows with their number, not with
the number of tracks times that of detections, stays cheap with a thousand objects.

Axes: T tracks, D detections, M pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from reobj.types import Array, BoolArray, IntArray

AMBIGUITY_MARGIN = 0.3  # of costs in [0, 1]; chosen on the rendered rooms and redkitchen


@dataclass(frozen=True, slots=True)
class Pairs:
    """Tracks and detections of a frame that may belong together, by track and detection.

    Attributes:
        track, detection: (M,) rows. cost: (M,) of overlap and gated distance, 0 to 1. iou: (M,).
        share: (M,) of what their overlap says (`overlap_within_reach`).
        same_class: (M,) the detection has the class that the track was mostly seen as.
    """

    track: IntArray
    detection: IntArray
    cost: Array
    iou: Array
    share: Array
    same_class: BoolArray


def touching(center: Array, reach: Array, xyxy: Array) -> tuple[IntArray, IntArray]:
    """Find the detections (D, 4) that touch the area within reach of each track.

    Args:
        center, reach: (2, T) px.
    Returns:
        track, detection: (M,) rows, in the order of tracks, then of detections.
    """
    low, high = (center - reach)[..., None], (center + reach)[..., None]  # (2, T, 1)
    corners = np.ascontiguousarray(xyxy.T)[:, None]  # (4, 1, D)
    touch = (corners[:2] <= high) & (corners[2:] >= low)  # (2, T, D)
    return np.divmod(np.flatnonzero(touch[0] & touch[1]), max(len(xyxy), 1))


def ambiguous_pairs(pairs: Pairs, possible: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Mark possible pairs that have a rival of the class, and those that are rivals, (M,) each.

    A pair is a rival where it costs little more than the best of its track and detection. (Two
    boxes of two classes around one thing are no rivals: they show the same.)
    """
    rivals = possible & pairs.same_class
    cost = np.where(possible, pairs.cost, np.inf)
    best = []  # of the track and of the detection of each pair
    for side in (pairs.track, pairs.detection):
        least = np.full(side.max(initial=0) + 1, np.inf)
        np.minimum.at(least, side, cost)
        best.append(least[side])
    rivals &= pairs.cost <= np.minimum(*best) + AMBIGUITY_MARGIN
    several = [np.bincount(side, rivals)[side] > 1 for side in (pairs.track, pairs.detection)]
    return rivals & (several[0] | several[1]), rivals


def assign(row: IntArray, column: IntArray, cost: Array) -> IntArray:
    """Match as many rows to columns as possible, then at least cost.

    Args:
        row, column: (M,) pairs that are possible, in the order of rows. cost: (M,) below 1e3.
    Returns:
        pairs that are matched. What has no rival needs no solver.
    """
    rival = (np.bincount(row)[row] > 1) | (np.bincount(column)[column] > 1)
    if not rival.any():
        return np.arange(len(row))
    some = np.flatnonzero(rival)
    rows, columns = (np.flatnonzero(np.bincount(x[some])) for x in (row, column))
    r, c = np.searchsorted(rows, row[some]), np.searchsorted(columns, column[some])
    pair = np.full((len(rows), len(columns)), -1)
    pair[r, c] = some
    costs = np.full(pair.shape, 1e3)
    costs[r, c] = cost[some]
    found = pair[linear_sum_assignment(costs)]
    return np.concatenate([np.flatnonzero(~rival), found[found >= 0]])
