"""Assignment of detections to tracks, and competing pairs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from reobj.tracking.assignment import Pairs, ambiguous_pairs, assign, touching


def random_pairs(seed: int, rows: int, columns: int, density: float) -> tuple:
    """(M, 2) row and column of the allowed pairs, and their costs (M,)."""
    rng = np.random.default_rng(seed)
    pairs = np.argwhere(rng.random((rows, columns)) < density)
    return pairs, rng.random(len(pairs))


@pytest.mark.parametrize("density", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize(("rows", "columns"), [(0, 3), (1, 1), (6, 9), (30, 20)])
def test_most_pairs_then_least_cost(rows: int, columns: int, density: float) -> None:
    """Equals scipy on the full matrix with a prohibitive cost for pairs that are not allowed."""
    for seed in range(10):
        pairs, cost = random_pairs(seed, rows, columns, density)
        whole = np.full((rows, columns), 1e3)
        whole[tuple(pairs.T)] = cost
        row, column = linear_sum_assignment(whole)
        expected = {(r, c) for r, c in zip(row, column, strict=True) if whole[r, c] < 1e3}
        assert {tuple(p) for p in pairs[assign(*pairs.T, cost)]} == expected


@pytest.mark.parametrize("density", [0.0, 0.2, 0.7])
def test_rivals_cost_little_more_than_the_best_of_track_and_detection(density: float) -> None:
    """Equals the same rule on the full matrix."""
    for seed in range(10):
        pairs, cost = random_pairs(seed, 8, 7, density)
        rng = np.random.default_rng(seed)
        same, possible = rng.random((2, len(pairs))) < 0.8
        given = Pairs(*pairs.T, cost, cost, cost, same)
        whole = np.full((8, 7), np.inf)
        whole[tuple(pairs[possible].T)] = cost[possible]
        near = whole <= np.minimum(whole.min(0)[None], whole.min(1)[:, None]) + 0.3
        of_class = np.zeros((8, 7), bool)
        of_class[tuple(pairs[same & possible].T)] = True
        rivals = near & of_class
        several = (rivals.sum(0) > 1)[None] | (rivals.sum(1) > 1)[:, None]
        for found, expected in zip(
            ambiguous_pairs(given, possible, 0.3), (rivals & several, rivals), strict=True
        ):
            whole_found = np.zeros((8, 7), bool)
            whole_found[tuple(pairs[found].T)] = True
            np.testing.assert_array_equal(whole_found, expected)


def test_candidate_detections_overlap_the_gate_in_x_and_y() -> None:
    """Equals a test of each pair; sorted by track, then by detection."""
    rng = np.random.default_rng(0)
    center, reach = rng.uniform(0, 100, (2, 20)), rng.uniform(1, 20, (2, 20))
    corner, size = rng.uniform(0, 100, (30, 2)), rng.uniform(0, 20, (30, 2))
    expected = [
        (t, d)
        for t, d in np.ndindex(20, 30)
        if (corner[d] <= center[:, t] + reach[:, t]).all()
        and (corner[d] + size[d] >= center[:, t] - reach[:, t]).all()
    ]
    found = touching(center, reach, np.hstack([corner, corner + size]))
    assert 20 < len(expected) < 300 and list(zip(*found, strict=True)) == expected
    assert [len(x) for x in touching(center, reach, np.empty((0, 4)))] == [0, 0]
    assert [len(x) for x in touching(center[:, :0], reach[:, :0], np.ones((3, 4)))] == [0, 0]
