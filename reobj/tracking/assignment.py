"""Assignment of detections to tracks: gated pairs, ambiguous pairs, minimum-cost matching.

Only pairs that pass a gate are stored, a few per track. The cost grows with their number, not with
tracks times detections, so it stays low with a thousand objects.

Axes: T tracks, D detections, M pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from reobj.types import Array, BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class Pairs:
    """Gated pairs of a track and a detection of a frame, by track, then by detection.

    Attributes:
        track, detection: (M,) rows. cost: (M,) of overlap and gated distance, 0 to 1. iou: (M,).
        overlap_weight: (M,) of the overlap as evidence (`iou_within_uncertainty`).
        same_class: (M,) the detection has the majority class of the track.
    """

    track: IntArray
    detection: IntArray
    cost: Array
    iou: Array
    overlap_weight: Array
    same_class: BoolArray


def touching(center: Array, radius: Array, xyxy: Array) -> tuple[IntArray, IntArray]:
    """Find the detections (D, 4) that touch the search window of each track.

    Args:
        center, radius: (2, T) px, centre and half size of the windows.
    Returns:
        track, detection: (M,) rows, in the order of tracks, then of detections.
    """
    left, top = (center - radius)[..., None]  # (T, 1) each
    right, bottom = (center + radius)[..., None]
    x1, y1, x2, y2 = np.ascontiguousarray(xyxy.T)  # (D,) each
    touch = x1 <= right  # (T, D)
    touch &= x2 >= left
    touch &= y1 <= bottom
    touch &= y2 >= top
    return np.divmod(np.flatnonzero(touch), max(len(xyxy), 1))


def ambiguous_pairs(
    pairs: Pairs, possible: BoolArray, margin: float
) -> tuple[BoolArray, BoolArray]:
    """Mark possible pairs that have a rival of their class, and pairs that are rivals, (M,) each.

    A pair is a rival if it costs at most `margin` more than the best pair of its track and of its
    detection.
    (Two boxes of different classes around one object are not rivals: they show the same object.)
    """
    rivals = possible & pairs.same_class
    cost = np.where(possible, pairs.cost, np.inf)
    best = []  # least cost of the track and of the detection of each pair
    for side in (pairs.track, pairs.detection):
        least = np.full(side.max(initial=0) + 1, np.inf)
        np.minimum.at(least, side, cost)
        best.append(least[side])
    rivals &= pairs.cost <= np.minimum(*best) + margin
    several = [np.bincount(side, rivals)[side] > 1 for side in (pairs.track, pairs.detection)]
    return rivals & (several[0] | several[1]), rivals


def assign(row: IntArray, column: IntArray, cost: Array) -> IntArray:
    """Find the matching with the most pairs, and among those the least total cost.

    Args:
        row, column: (M,) possible pairs, in the order of rows. cost: (M,) below 1e3.
    Returns:
        numbers of the matched pairs, ascending.
    """
    rival = (np.bincount(row)[row] > 1) | (np.bincount(column)[column] > 1)
    if not rival.any():
        return np.arange(len(row))
    matched = ~rival  # need no solver
    some = np.flatnonzero(rival)
    r = _ranks(row[some])
    c = _ranks(column[some])
    # columns first: scipy copies and transposes a matrix with more rows than columns, and a frame
    # usually has more tracks than detections
    costs = np.full((c.max() + 1, r.max() + 1), 1e3)
    costs[c, r] = cost[some]
    solved, row_of_solved = linear_sum_assignment(costs)
    row_of = np.full(len(costs), -1)
    row_of[solved] = row_of_solved
    matched[some] = row_of[c] == r
    return np.flatnonzero(matched)


def _ranks(values: IntArray) -> IntArray:
    """Number the distinct values (N,), none below 0, from 0 in ascending order."""
    return np.asarray((np.bincount(values) > 0).cumsum()[values] - 1, np.int64)
