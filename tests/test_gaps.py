"""Gaps of tracks, filled after the video: against filterpy's smoother and simulated truth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import reobj_track as rt
from reobj.tracking.linking import fill_gaps

SIZE = (640, 480)


def moving(frames: np.ndarray, start: tuple[float, ...], step: tuple[float, ...]) -> np.ndarray:
    """Boxes (F, 4) cx, cy, w, h of constant velocity, as corners."""
    box = np.array(start) + frames[:, None] * np.array(step)
    return np.concatenate([box[:, :2] - box[:, 2:] / 2, box[:, :2] + box[:, 2:] / 2], 1)


def table(frames: np.ndarray, xyxy: np.ndarray, identity: int = 1) -> rt.Tracks:
    """One identity, tracklets of 20 frames, one detection per frame."""
    one = np.ones(len(frames), np.int64)
    tracklet = 10 * identity + frames // 20
    return rt.Tracks(
        frames, identity * one, tracklet, xyxy, 0.9 * one, 7 * one, np.arange(len(one))
    )


def joined(*parts: rt.Tracks) -> rt.Tracks:
    names = [f.name for f in dataclasses.fields(rt.Tracks)]
    whole = rt.Tracks(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))
    return whole[np.argsort(whole.frame, kind="stable")]


ALL = np.arange(40)
BOXES = moving(ALL, (100, 200, 60, 90), (4, -1, 0.5, 0.8))


@pytest.mark.parametrize("every", [1, 2, 7])
def test_gaps_are_filled_with_the_true_boxes(every: int) -> None:
    """Exact boxes of constant velocity: the filled ones are the true ones, whatever the stride."""
    seen = np.delete(ALL, [17, 18, 19])
    filled = fill_gaps(table(every * seen, BOXES[seen]), SIZE, 3)
    assert filled.frame.tolist() == (every * ALL).tolist()
    np.testing.assert_allclose(filled.xyxy, BOXES, atol=0.05)
    new = filled.score == 0
    assert filled.frame[new].tolist() == [every * i for i in (17, 18, 19)]
    assert filled.detection_index[new].tolist() == [-1] * 3
    assert filled.track_id[new].tolist() == [1] * 3 and filled.class_id[new].tolist() == [7] * 3
    assert (filled.score[~new] == 0.9).all()
    before = np.flatnonzero(new)[0] - 1
    assert (filled.tracklet_id[new] == filled.tracklet_id[before]).all()
    np.testing.assert_array_equal(filled.xyxy[~new], BOXES[seen])  # detections are unchanged


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize(("max_gap", "filled"), [(0, 0), (3, 0), (4, 4), (5, 4)])
def test_only_gaps_up_to_the_limit_are_filled(every: int, max_gap: int, filled: int) -> None:
    seen = np.delete(ALL, [10, 11, 12, 13])
    found = fill_gaps(table(every * seen, BOXES[seen]), SIZE, max_gap)
    assert (found.score == 0).sum() == filled


@pytest.mark.parametrize(("jump", "filled"), [(38, True), (52, False)])
def test_gaps_with_a_large_motion_are_not_filled(jump: float, filled: bool) -> None:
    """Boxes of 80 px, that overlap after the gap by .36 and by .21."""
    boxes = moving(ALL, (100, 200, 80, 80), (0, 0, 0, 0))
    boxes[20:, [0, 2]] += jump
    seen = np.delete(ALL, [20])
    assert (fill_gaps(table(seen, boxes[seen]), SIZE, 5).score == 0).any() == filled


def test_gaps_belong_to_one_identity() -> None:
    """One track ends, another starts at its position; a third has no gap. Rows stay ordered."""
    still = moving(ALL, (100, 200, 60, 90), (0, 0, 0, 0))
    other = moving(ALL, (400, 200, 60, 90), (0, 0, 0, 0))
    whole = joined(
        table(ALL[:10], still[:10], 1), table(ALL[13:], still[13:], 2), table(ALL, other, 3)
    )
    filled = fill_gaps(whole, SIZE, 5)
    assert len(filled) == len(whole) and (np.diff(filled.frame) >= 0).all()
    gap = np.delete(ALL, [30])
    filled = fill_gaps(joined(whole, table(gap, still[gap] + 200, 4)), SIZE, 5)
    assert filled.track_id[filled.score == 0].tolist() == [4]
    assert (np.diff(filled.frame) >= 0).all()


def test_boxes_stay_in_the_image() -> None:
    """It leaves the image by half and comes back: the filled boxes end at the border."""
    boxes = moving(ALL, (640, 30, 100, 90), (0, 0, 0, 0))
    seen = np.delete(ALL, [15, 16])
    filled = fill_gaps(table(seen, boxes[seen]), SIZE, 5)
    new = filled.xyxy[filled.score == 0]
    np.testing.assert_allclose(new, [[590, 0, 640, 75]] * 2, atol=1e-6)
