"""Shapes that flow through the tool: boxes, detections, tables of tracks."""

from __future__ import annotations

import numpy as np
import pytest

import reobj_track as rt
from reobj.types import (
    as_detections,
    box_iou,
    class_shares,
    cxcywh_from_xyxy,
    object_classes,
    object_color,
    rows_by,
    unit_rows,
    widen,
    xyxy_from_cxcywh,
)


def step(*found: tuple[int, int, float]) -> rt.Tracks:
    """Tracks of a frame from (identity, tracklet, left) tuples; detections are numbered."""
    table = np.array(found, float).reshape(-1, 3)
    ids = table[:, :2].astype(np.int64)
    left, n = table[:, 2], len(table)
    xyxy = np.column_stack([left, 0 * left, left + 10, 0 * left + 20])
    zero = np.zeros(n, np.int64)
    return rt.Tracks(zero, ids[:, 0], ids[:, 1], xyxy, np.full(n, 0.9), zero, np.arange(n))


# ---- Boxes ----


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0, 0, 10, 10), (0, 0, 10, 10), 1.0),  # equal
        ((0, 0, 10, 10), (10, 0, 20, 10), 0.0),  # touching edges
        ((0, 0, 10, 10), (10, 10, 20, 20), 0.0),  # touching corners
        ((0, 0, 10, 10), (20, 20, 30, 30), 0.0),  # apart in both axes
        ((0, 0, 10, 10), (5, 0, 15, 10), 1 / 3),  # half over half
        ((0, 0, 10, 10), (2, 2, 4, 4), 0.04),  # one inside the other
        ((0, 0, 0, 0), (0, 0, 0, 0), 0.0),  # zero area
    ],
)
def test_box_iou(a: tuple[float, ...], b: tuple[float, ...], expected: float) -> None:
    iou = box_iou(np.array([a], float), np.array([b], float))
    assert iou[0, 0] == pytest.approx(expected)


def test_box_iou_compares_every_pair() -> None:
    a, b = np.array([[0, 0, 10, 10], [0, 0, 4, 10.0]]), np.array([[0, 0, 5, 10.0]])
    np.testing.assert_allclose(box_iou(a, b), [[0.5], [0.8]])
    assert box_iou(np.empty((0, 4)), np.ones((3, 4))).shape == (0, 3)


def test_box_conventions_turn_into_each_other() -> None:
    box = np.array([[10, 20, 30, 60.0], [-5, 0, 5, 1]])
    np.testing.assert_allclose(cxcywh_from_xyxy(box), [[20, 40, 20, 40], [0, 0.5, 10, 1]])
    np.testing.assert_allclose(xyxy_from_cxcywh(cxcywh_from_xyxy(box)), box)


# ---- Detections ----


def test_detections_are_selected_with_their_masks() -> None:
    found = rt.Detections.from_array([[0, 0, 1, 1, 0.5, 3], [0, 0, 2, 2, 0.7, 4]])
    masks = np.zeros((2, 4, 4), bool)
    masks[1] = True
    found = rt.Detections(found.xyxy, found.score, found.class_id, masks)
    for keep in (np.array([1]), np.array([False, True]), slice(1, 2)):
        part = found[keep]
        assert len(part) == 1 and part.class_id.tolist() == [4] and part.score.tolist() == [0.7]
        assert part.masks is not None and part.masks.all()
    assert rt.Detections.from_array([]).xyxy.shape == rt.Detections.empty().xyxy.shape == (0, 4)


@pytest.mark.parametrize(
    "wrong",
    [
        rt.Detections(np.zeros((2, 4)), np.ones(1), np.zeros(2, np.int64)),
        rt.Detections(np.zeros((2, 4)), np.ones(2), np.zeros(3, np.int64)),
        rt.Detections(
            np.zeros((1, 4)), np.ones(1), np.zeros(1, np.int64), np.zeros((2, 3, 3), bool)
        ),
        [[0, 0, np.nan, 1, 0.5, 1]],
    ],
)
def test_detections_that_do_not_fit_are_refused(wrong: object) -> None:
    with pytest.raises(rt.ReobjError, match="do not fit, or hold NaN"):
        as_detections(wrong)


@pytest.mark.parametrize("shape", [(2, 5), (6, 5), (6,), (1, 2, 6)])
def test_rows_of_another_width_are_refused(shape: tuple[int, ...]) -> None:
    """Six rows of five numbers are not five rows of six."""
    with pytest.raises(rt.ReobjError, match=r"expected \(N, 6\)"):
        rt.Detections.from_array(np.ones(shape))


# ---- Tables of tracks ----


def test_concatenate_gives_earlier_rows_the_identity_confirmed_later() -> None:
    """Tracklet 2 is named in the last frame, tracklet 3 never, tracklet 4 is a return of 1."""
    steps = [
        step((1, 1, 0), (0, 2, 50)),
        step((0, 3, 90), (0, 2, 52)),
        step(),
        step((2, 2, 54), (1, 4, 70)),
    ]
    table = rt.Tracks.concatenate([10, 12, 14, 16], steps, scale=0.5)
    assert table.frame.tolist() == [10, 10, 12, 16, 16]
    assert table.track_id.tolist() == [1, 2, 2, 2, 1]
    assert table.tracklet_id.tolist() == [1, 2, 2, 2, 4]
    assert table.detection_index.tolist() == [0, 1, 1, 0, 1]
    np.testing.assert_allclose(table.xyxy[:, 0], [0, 100, 104, 108, 140])
    np.testing.assert_allclose(table.xyxy[0], [0, 0, 20, 40])


def test_concatenate_nothing() -> None:
    for steps in ([], [step(), step()], [step((0, 1, 5))]):
        table = rt.Tracks.concatenate(list(range(len(steps))), steps)
        assert len(table) == 0 and table.xyxy.shape == (0, 4)


def test_identities_are_numbered_by_first_appearance() -> None:
    table = step(*[(1, i, 10 * i) for i in range(6)])
    named = table.with_identities(np.array([7, 3, 7, -2, 3, 9]))
    assert named.track_id.tolist() == [1, 2, 1, 3, 2, 4]
    assert named.tracklet_id.tolist() == table.tracklet_id.tolist()
    assert table.track_id.tolist() == [1] * 6
    assert len(rt.Tracks.empty().with_identities(np.empty(0, np.int64))) == 0


def test_rows_of_a_table_are_selected_together() -> None:
    table = step((1, 1, 0), (2, 2, 50), (3, 3, 90))
    part = table[table.track_id != 2]
    assert part.track_id.tolist() == [1, 3] and part.xyxy[:, 0].tolist() == [0, 90]
    assert part.detection_index.tolist() == [0, 2]


def test_a_class_is_voted_by_the_sum_of_scores() -> None:
    """Two faint boxes say 5, one clear box says 7; the second object is always 5."""
    table = step((1, 1, 0), (1, 1, 0), (1, 1, 0), (2, 2, 0))
    score, kind = np.array([0.3, 0.3, 0.9, 0.2]), np.array([5, 5, 7, 5])
    table = rt.Tracks(*(table.frame, table.track_id, table.tracklet_id, table.xyxy), score, kind,
                      table.detection_index)  # fmt: skip
    assert object_classes(table) == {1: 7, 2: 5}
    shares = class_shares(table, table.track_id - 1, 3)
    np.testing.assert_allclose(shares[:, [5, 7]], [[0.4, 0.6], [1, 0], [0, 0]])


def test_link_events_survive_json() -> None:
    entry = {"kind": "join", "tracklets": [1, 4], "place_iou": None, "kept": True}
    for name in ("appearance_log_odds", "look"):  # the second: before 0.2
        event = rt.LinkEvent.from_json(entry | {name: 2.5})
        assert event == rt.LinkEvent("join", (1, 4), None, 2.5, True)


# ---- Small helpers ----


def test_rows_by_value() -> None:
    assert [r.tolist() for r in rows_by(np.array([4, 1, 4, 9, 1]))] == [[1, 4], [0, 2], [3]]
    assert rows_by(np.empty(0, np.int64)) == []


def test_widen_pads_with_zeros() -> None:
    wide = widen(np.ones((2, 1)), np.empty((5, 3)))
    np.testing.assert_array_equal(wide, [[1, 0, 0], [1, 0, 0]])
    assert widen(np.ones((2, 4)), np.empty((0, 3))).shape == (2, 4)


def test_unit_rows_leave_zero_rows() -> None:
    np.testing.assert_allclose(unit_rows(np.array([[3, 4], [0, 0.0]])), [[0.6, 0.8], [0, 0]])


def test_neighbouring_identities_have_clearly_different_colours() -> None:
    colors = np.array([object_color(i) for i in range(1, 40)], float)
    assert colors.min() >= 0 and colors.max() <= 255
    assert np.linalg.norm(np.diff(colors, axis=0), axis=1).min() > 90
    assert object_color(3) == object_color(3)
