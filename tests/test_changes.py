"""Changes since a map: changes.json, the summary, and how a result keeps them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj.results.changes import Change, Changes, Shape, read_changes, write_changes

HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])
SHAPE = Shape("box", np.array([0.2, 0.25, 0.4]), HALF_TURN)


def room_changes() -> Changes:
    """A stayed table, a moved chair, a gone lamp, a new cup, a bottle out of view."""
    table = Change(1, "table", np.zeros(3), np.array([0.0, 0.01, 0.0]), 0.01, 0.02, "same place")
    chair = Change(6, "chair", np.array([1.0, 0, 0.4]), np.array([1.5, 0.25, 0.4]), 0.559, 0.03,
                   "own points", (7,), SHAPE)  # fmt: skip
    lamp = Change(9, "lamp", np.array([2.0, 1, 0.5]), None, evidence="seen through in 3 of 4 views",
                  before_shape=dataclasses.replace(SHAPE, support="cylinder"))  # fmt: skip
    cup = Change(12, "cup", None, np.array([0.1, 0.2, 0.8]))
    bottle = Change(3, "bottle", np.array([9.0, 9, 1]), None, evidence="no view passed")
    return Changes("flat.map", "tuesday", "", 30, 40, (0, 1), 0.0125, (table,), (chair,), (lamp,),
                   (cup,), (bottle,), (chair,))  # fmt: skip


def assert_equal(a: Any, b: Any) -> None:
    """Compare dataclasses with arrays, also nested."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for f in dataclasses.fields(a):
            assert_equal(getattr(a, f.name), getattr(b, f.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    else:
        np.testing.assert_array_equal(a, b)


def test_entries_have_the_documented_keys(tmp_path: Path) -> None:
    write_changes(tmp_path / "changes.json", room_changes())
    data = json.loads((tmp_path / "changes.json").read_text())
    assert data["moved"] == [{
        "id": 6, "class": "chair", "from": [1, 0, 0.4], "to": [1.5, 0.25, 0.4],
        "distance_m": 0.559, "sigma_m": 0.03, "evidence": "own points", "candidates": [7],
        "from_shape": {"support": "box", "half_axes": [0.2, 0.25, 0.4], "quat_wxyz": [0, 0, 0, 1]},
    }]  # fmt: skip
    assert (data["map"], data["session"], data["components"]) == ("flat.map", "tuesday", [0, 1])
    assert data["gone"][0]["to"] is None and data["new"][0]["from"] is None


def test_the_summary_counts_the_changes() -> None:
    assert room_changes().summary() == (
        "map flat.map: 1 stayed, 1 moved (chair 6 by 0.56 m), 1 gone (lamp 9), 1 new (cup 12), "
        "1 not seen, 1 ambiguous among identical objects"
    )
    assert Changes("a.map", "b").summary() == "map a.map: 0 stayed"
    first = Changes("a.map", "b", new=room_changes().new)
    assert first.summary() == "map a.map: made with 1 object"
    later = dataclasses.replace(first, placed_by="points")
    assert later.summary() == "map a.map: 0 stayed, 1 new (cup 12)"
    unscaled = Change(6, "chair", np.zeros(3), np.ones(3))
    assert Changes("a.map", "b", moved=(unscaled,)).summary().endswith("1 moved (chair 6)")
    refused = Changes("a.map", "b", "3 of 40 frames agree")
    assert refused.summary() == "map a.map: not placed; 3 of 40 frames agree"


def _set(kind: str, **values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data[kind][0].update(values)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.update(version=2), 'expected .*"reobj-changes", "version": 1'),
        (lambda d: d["new"][0].pop("class"), r"\$\.new\[0\]: .*missing .* class"),
        (_set("moved", to=[1, 2, float("nan")]), r"\$\.moved\[0\]\.to: Expected 3 finite numbers"),
        (_set("moved", distance_m=-1), r"\$\.moved\[0\]\.distance_m: Expected float >= 0"),
        (lambda d: d["gone"][0]["from_shape"].update(support="cone"), "from_shape.support: .*box"),
        (lambda d: d.update(placed_by="luck"), r"\$\.placed_by: .*points"),
    ],
)
def test_damaged_files_are_refused_in_one_line(
    tmp_path: Path, damage: Callable[[dict[str, Any]], None], message: str
) -> None:
    path = tmp_path / "changes.json"
    data = room_changes().to_json()
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(rt.ReobjError, match=message) as caught:
        read_changes(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and text.endswith("run the video again")
    assert "\n" not in text
