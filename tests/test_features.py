"""Matches of descriptors against the definition."""

from __future__ import annotations

import numpy as np
import pytest

from reobj.poses.features import MAX_RATIO, _matches


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def brute_force(a, b):
    """Pairs that are the best of each other, clearly better than the second best on both sides."""
    angle = np.arccos(np.clip(a.astype(np.float64) @ b.astype(np.float64).T, -1, 1))
    found = []
    for i, row in enumerate(angle):
        j = int(row.argmin())
        column = angle[:, j]
        rivals = np.delete(row, j).min(), np.delete(column, i).min()
        if row[j] < 0.7 and all(row[j] < MAX_RATIO * rival for rival in rivals):
            found.append((i, j))
    return found


@pytest.mark.parametrize("noise", [0.02, 0.06, 0.12])
def test_matches_are_those_of_a_loop(noise):
    """Some rows are common, a few duplicated, the rest unrelated."""
    rng = np.random.default_rng(0)
    a = unit(rng.uniform(0, 1, (200, 16)) ** 3)
    common = a[rng.permutation(200)[:120]]
    b = np.concatenate([common, common[:20], rng.uniform(0, 1, (60, 16)) ** 3])
    b = unit(np.abs(b + rng.normal(0, noise, b.shape)))
    found = _matches(a, b)
    assert found.dtype == np.uint32 and found.tolist() == [list(p) for p in brute_force(a, b)]
    assert 10 < len(found) < 121


@pytest.mark.parametrize("sizes", [(0, 9), (9, 0), (1, 9), (9, 1)])
def test_without_a_second_best_nothing_matches(sizes):
    a, b = (unit(np.ones((n, 16))) for n in sizes)
    assert _matches(a, b).shape == (0, 2)
