"""Samples of a feature map for foreground and background, on known masks and maps."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

import reobj_track as rt
from reobj.appearance.embedding import (
    occupancy_map,
    pool_cells,
    sample_parts,
)

LAYOUT = rt.SamplingLayout(context=0.5, samples=4, foreground_cells=3, background_cells=4)


def boxes(*xyxy: tuple[float, ...], masks: np.ndarray | None = None) -> rt.Detections:
    n = len(xyxy)
    return rt.Detections(np.array(xyxy, float), np.full(n, 0.9), np.zeros(n, np.int64), masks)


def samples(detections: rt.Detections, layout: rt.SamplingLayout = LAYOUT) -> list[SimpleNamespace]:
    """Of foreground, grown and wider boxes: index, weight (N, k, k, S), share, others (N, k, k), on
    a map of a quarter of an image of 400 x 200.
    """
    rows = np.arange(len(detections))
    occupied = occupancy_map(detections, (200, 400), (50, 100), layout.object_score)
    both = sample_parts(detections, [rows, rows], (200, 400), occupied, layout)
    values = {"index": both.index, "weight": both.weight}
    values |= {"share": both.share[:, 0], "others": both.share[:, 1]}
    near, parts = layout.background_cells**2, []
    for part, some in ((0, slice(None)), (1, slice(near)), (1, slice(near, None))):
        cut = {name: both.split(value)[part][:, some] for name, value in values.items()}
        side = math.isqrt(cut["share"].shape[1])
        cut = {n: v.reshape(len(rows), side, side, *v.shape[2:]) for n, v in cut.items()}
        parts.append(SimpleNamespace(**cut))
    return parts[: 2 + (layout.surround_scale > 0)]


def masks_at(mask: np.ndarray, part: SimpleNamespace) -> np.ndarray:
    row, column = np.divmod(part.index[0], 100)
    return np.asarray(mask[row * 4 + 2, column * 4 + 2])


def test_foreground_is_the_inscribed_ellipse_and_background_the_rest() -> None:
    fore, back = samples(boxes((100, 50, 200, 150)))
    assert fore.weight.mean() == pytest.approx(np.pi / 4, abs=0.03)
    assert back.weight.mean() == pytest.approx(1 - np.pi / 16, abs=0.03)
    row, column = np.divmod(back.index[0][back.weight[0]], 100)
    assert column.min() * 4 >= 48 and column.max() * 4 <= 250  # grown by half a box on every side
    assert column.min() * 4 <= 56 and column.max() * 4 >= 240
    assert row.min() <= 2 and row.max() >= 47  # rows 0..200
    assert fore.share.shape == (1, 3, 3) and back.share.shape == (1, 4, 4)
    assert back.others.mean() < 0.02  # the rim of its own outline, drawn on the coarse map


def test_the_wider_box_contains_other_objects_but_not_its_own() -> None:
    masks = np.zeros((2, 200, 400), bool)
    masks[0, 80:120, 180:220] = masks[1, :, 240:] = True
    found = boxes((180, 80, 220, 120), (240, 0, 400, 200), masks=masks)
    layout = rt.SamplingLayout(
        context=0.5, samples=4, surround_scale=1.5, surround_min_margin=0.2, surround_cells=5
    )
    _, _, wide = samples(found, layout)
    column = wide.index[0] % 100
    assert (column.min() * 4, column.max() * 4) == (104, 292)  # 200 -+ (20 + .2 * 400), 4 px a cell
    assert wide.weight[0][column > 60].all()
    assert not (wide.weight[0] & masks_at(masks[0], wide)).any()
    assert wide.share.shape == (1 + 1, 5, 5) and wide.share[0, 2, 2] == 0
    np.testing.assert_allclose(wide.others[0][:, 4], 1.0)


def test_cells_are_means_of_the_valid_samples() -> None:
    """On a map of column and row indices; the foreground uses only the first channel."""
    layout = rt.SamplingLayout(
        context=0.5, samples=4, surround_scale=1.0, surround_cells=5, foreground_channels=1
    )
    found = boxes((100, 50, 200, 150), (120, 60, 150, 90))
    rows, occupied = [np.array([1]), np.array([0, 1])], np.zeros((50, 100), bool)
    both = sample_parts(found, rows, (200, 400), occupied, layout)
    y, x = np.mgrid[:50, :100].astype(np.float32)
    fore, back = pool_cells(np.stack([x, y], -1), both, layout)
    assert fore.shape == (1, 4, 3) and back.shape == (2, 16 + 25, 4)
    np.testing.assert_allclose(fore[0, :, 0].reshape(2, 2).mean(0), [32, 35.5], atol=0.6)
    first = np.where(both.weight[4], np.divmod(both.index[4], 100), np.nan)  # of the grown box
    np.testing.assert_allclose(back[0, 0, 1::-1], np.nanmean(first, 1), rtol=1e-5)
    assert fore[0, 0, 1] == both.weight[0].mean()
    assert back[1, 20, 2] == both.weight[4 + 41 + 20].mean()


def test_layouts_of_older_models_are_read() -> None:
    old = {"size_px": 320, "reach": 0.05, "wide": 1.5, "wide_reach": 0.1, "wide_cells": 3}
    layout = rt.SamplingLayout(neighbours=0.1).updated({"layout": old})
    assert layout == rt.SamplingLayout(
        size_px=320, min_margin=0.05, surround_scale=1.5, surround_min_margin=0.1,
        surround_cells=3, neighbours=0.1,
    )  # fmt: skip
    assert rt.SamplingLayout().updated({"layout": {"min_margin": 0.2}}).min_margin == 0.2
    assert rt.SamplingLayout().updated({}) == rt.SamplingLayout()
