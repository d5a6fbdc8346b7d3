"""The backward elimination, and the scaling of constants, without any recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import eliminate as el
import numpy as np
import pytest
import sensitivity as se

import quadrics


def figures(idf1: Sequence[float], found: int = 4, false: int = 0) -> list[list[el.Figures]]:
    """Two recordings with two box noises each; the second has no O3D."""
    a, b, c, d = (
        {"idf1": x, "found": found, "doubles": false, "elsewhere": 0, "true": 5} for x in idf1
    )
    a["o3d"] = b["o3d"] = 0.5
    return [[a, b], [c, d]]


def test_loss_adds_identities_objects_and_overlaps() -> None:
    full = figures([0.8, 0.8, 0.6, 0.6])
    reduced = figures([0.7, 0.8, 0.6, 0.65], found=3, false=2)
    reduced[0][1]["o3d"] = 0.4
    loss = el.losses(full, reduced)
    np.testing.assert_allclose(loss, [0.7, 0.7, 0.6, 0.55])
    assert el.noise(loss) == pytest.approx(2 * np.std(loss, ddof=1) / 2)


def test_elimination_stops_where_the_loss_exceeds_its_noise(tmp_path: Path) -> None:
    """Of five mechanisms two are worth nothing, one .001 with noise; the last two refuse."""
    worth = {"inert": 0.0, "useless": 0.0, "weak": 0.001, "strong": 0.2, "vital": 0.3}
    asked = []

    def run(key: str) -> list[list[el.Figures]]:
        asked.append(key)
        loss = sum(worth[name] for name in filter(None, key.split(" + ")))
        noise = np.array([0.01, -0.01, 0.02, -0.02]) if "weak" in key else 0
        return figures(0.8 - loss + noise * np.ones(4))

    evaluate = el.Evaluations(tmp_path / "known.json", run)
    rows = el.eliminate(evaluate, list(worth))
    assert [row[:2] for row in rows if row[0] == "together"] == [
        ("together", "inert"), ("together", "useless"), ("together", "weak")
    ]  # fmt: skip
    assert {row[1] for row in rows if row[0] == "refused"} == {"strong", "vital"}
    asked.clear()
    again = el.Evaluations(tmp_path / "known.json", run)
    assert el.eliminate(again, list(worth)) == rows and not asked


def test_constants_are_scaled_by_kind() -> None:
    assert se.scaled(3, 0.5) == 2 and se.scaled(1, 0.5) == 1 and se.scaled(3, 2.0) == 6
    assert se.scaled((1.0, 4), 2.0) == (2.0, 8)
    assert se.scaled(0.875, 2.0) == 0.9375 and se.scaled(0.875, 0.5) == 0.75
    np.testing.assert_array_equal(se.scaled(np.array([1.0, 2]), 0.5), [0.5, 1])
    names = set(se.constants("quadrics"))
    assert {"SMOOTH", "HUBER"} <= names
    assert not names & {"AXIS_ORDERS", "SUPPORTS"}
    assert quadrics.HUBER == 3.0
    assert "NEW_OBJECT" in set(se.constants("reobj.objects.association"))
