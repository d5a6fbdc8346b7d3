"""Sampling of a feature map for the foreground and the background of detections.

`sample_parts` places the samples on the map, `pool_cells` averages them to cells. The map is
computed in `reobj.appearance.embedding`.

Axes: D detections of a frame, M foregrounds, N backgrounds, K cells of S samples each, L = K * S.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from reobj.types import Array, BoolArray, Detections, Floats, IntArray, cxcywh_from_xyxy


@dataclass(frozen=True, slots=True)
class SamplingLayout:
    """Sampling layout of a feature map for foreground and background embeddings.

    Trained models have their own in their metadata; the defaults are for untrained backbones
    (chosen).

    Attributes:
        size_px: longer side of the backbone's input.
        samples: samples along a side of every cell.
        context, min_margin: margin of the enlarged box on every side: this fraction of the box
            size, and at least this fraction of the image's longer side.
        object_score: detections of at least this score mask the background of the others, and count
            as neighbours.
        foreground_cells, background_cells: cells along a side of the box and of the enlarged box.
        surround_scale, surround_min_margin, surround_cells: the same for a wider box, in which
            other objects count too; scale 0: no such box.
        foreground_channels: the foreground is pooled from this many first channels only; 0: all.
        neighbours: weight of `neighbour_embedding` in the background of trained models. 0.2 and its
            distance were chosen on the six videos of benchmarks/RESULTS.md.
        crop_px: side of the crops of `CropEmbedder` (224: ImageNet's).
    """

    size_px: int = 480
    samples: int = 4
    context: float = 0.5
    min_margin: float = 0.0
    object_score: float = 0.3
    foreground_cells: int = 2
    background_cells: int = 4
    surround_scale: float = 0.0
    surround_min_margin: float = 0.2
    surround_cells: int = 4
    foreground_channels: int = 0
    neighbours: float = 0.2
    crop_px: int = 224

    def updated(self, metadata: dict[str, Any]) -> SamplingLayout:
        """Apply the `layout` of a model's metadata, with current names or those of old versions."""
        stated = metadata.get("layout", {})
        names = {"reach": "min_margin", "wide": "surround_scale",
                 "wide_reach": "surround_min_margin", "wide_cells": "surround_cells"}  # fmt: skip
        return dataclasses.replace(self, **{names.get(k, k): v for k, v in stated.items()})


@dataclass(frozen=True, slots=True)
class PartSamples:
    """Samples of a feature map: S in each of K cells.

    First the cells of M foregrounds, then those of N backgrounds (of each the enlarged box, then
    the wider one).

    Attributes:
        index: (K, S) flat index into the map. weight: (K, S) bool, valid samples.
        share: (K, 2) fraction of valid samples, and of samples on other objects.
        shape: (M, cells of a foreground), (N, cells of a background).
    """

    index: IntArray
    weight: BoolArray
    share: Floats
    shape: tuple[tuple[int, int], tuple[int, int]]

    def split(self, values: Any) -> tuple[Any, Any]:
        """Split values (K, ...) into foreground (M, cells, ...) and background (N, cells, ...)."""
        fore, back = self.shape
        first = values[: math.prod(fore)]
        rest = values[math.prod(fore) :]
        return first.reshape(*fore, *values.shape[1:]), rest.reshape(*back, *values.shape[1:])


def sample_parts(
    detections: Detections,
    rows: Sequence[IntArray],
    size_hw: tuple[int, ...],
    occupied: BoolArray,
    layout: SamplingLayout,
) -> PartSamples:
    """Sample foregrounds and backgrounds of detections on a feature map.

    Valid are, in the box, samples on the object itself; in the enlarged box, samples on no object;
    in the wider box, if the layout has one, samples not on the object itself. Samples beyond the
    image are never valid.

    Args:
        detections: of one frame of size_hw pixels.
        rows: (M,) detections for the foreground, and (N,) those for the background.
        occupied: (h, w) `occupancy_map` on the feature map.
    """
    size, cells_wh = (np.array(v[1::-1])[:, None] for v in (size_hw, occupied.shape))
    part, grid, excludes, shape = _sample_grid(layout, len(rows[0]), len(rows[1]))
    row = np.concatenate(rows).take(part)  # (L,)
    low, high = detections.xyxy.T.take(row, 1).reshape(2, 2, -1)  # (2, L) x, y, as all below
    centre = (low + high) / 2
    box_half = (high - low) / 2
    half = box_half + np.maximum((high - low) * grid[2], grid[3] * max(size_hw))
    at = centre + half * grid[:2]
    inside = ((at >= 0) & (at < size)).all(0)  # (L,)
    cell = (at / size * cells_wh).astype(int)
    index = (cell[1] * occupied.shape[1] + cell[0]) * inside
    on_object = inside_object(detections, row, at, centre, box_half) & inside
    others = occupied.take(index) & (inside > on_object)
    weight = inside > (on_object | others & excludes)
    fine = layout.samples**2
    weight[: fine * math.prod(shape[0])] = on_object[: fine * math.prod(shape[0])]
    counts = np.concatenate([weight, others]).reshape(2, -1, fine).sum(-1, dtype=np.float32)
    return PartSamples(index.reshape(-1, fine), weight.reshape(-1, fine), counts.T / fine, shape)


@functools.lru_cache(64)
def _sample_grid(
    layout: SamplingLayout, foregrounds: int, backgrounds: int
) -> tuple[IntArray, Array, BoolArray, Any]:
    """Lay out the L samples: of the foregrounds first, then of the backgrounds.

    Returns:
        part: (L,) number of the foreground or background that a sample belongs to.
        grid: (4, L) x and y in its box, -1 to 1; margin of that box as a fraction of the size of
            the detection, and its least margin as a fraction of the image's longer side.
        excludes: (L,) samples on other objects are not valid (enlarged boxes).
        shape: `PartSamples.shape`.
    """
    box = (0.0, 0.0, 0, layout.foreground_cells)
    enlarged = (layout.context, layout.min_margin, 1, layout.background_cells)
    wider = (layout.surround_scale, layout.surround_min_margin, 0, layout.surround_cells)
    grids = []
    for *kind, cells in (box, enlarged, wider)[: 2 + (layout.surround_scale > 0)]:
        side = cells * layout.samples
        line = ((np.arange(side) + 0.5) / side * 2 - 1).reshape(cells, -1)
        x = line[:, None]
        y = line[:, None, :, None]
        grids.append(np.stack(np.broadcast_arrays(x, y, *kind)).reshape(5, -1))
    fore = grids[0]  # (5, samples of one part)
    back = np.concatenate(grids[1:], 1)
    grid = np.concatenate([fore[:, :0], *[fore] * foregrounds, *[back] * backgrounds], 1)
    sizes = np.array([fore.shape[1], back.shape[1]])
    part = np.arange(foregrounds + backgrounds).repeat(sizes.repeat([foregrounds, backgrounds]))
    cells = (sizes // layout.samples**2).tolist()
    return part, grid[:4], grid[4] > 0, ((foregrounds, cells[0]), (backgrounds, cells[1]))


def pool_cells(
    features: Floats, samples: PartSamples, layout: SamplingLayout
) -> tuple[Floats, Floats]:
    """Average the valid samples in each cell of a feature map (h, w, C).

    Returns:
        foreground (M, cells, C + 2) and background (N, cells, C + 2): the mean of the channels, 0
        without valid samples, and `PartSamples.share`. The foreground has only the layout's first
        `foreground_channels`.
    """
    sampled = features.reshape(-1, features.shape[-1]).take(samples.index, 0)  # (K, S, C)
    total = (samples.weight.astype(np.float32)[:, None] @ sampled)[:, 0]  # (K, C)
    mean = total / np.maximum(samples.share[:, :1] * samples.index.shape[1], 1)
    fore, back = samples.split(np.concatenate([mean, samples.share], 1))
    if channels := layout.foreground_channels:
        fore = np.concatenate([fore[..., :channels], fore[..., -2:]], -1)
    return fore, back


def inside_object(
    detections: Detections, rows: IntArray, at: Array, centre: Array, half: Array
) -> BoolArray:
    """Test whether points lie on their detection: in its mask, else in the inscribed ellipse.

    Args:
        rows: (...) detection of each point. at: (2, ...) x, y of the points, pixels.
        centre, half: (2, ...) centre and half size of the detection's box.
    """
    inside = (((at - centre) / np.maximum(half, 0.5)) ** 2).sum(0) <= 1
    if detections.masks is not None:
        height, width = detections.masks.shape[1:]
        column = at[0].astype(int).clip(0, width - 1)
        row = at[1].astype(int).clip(0, height - 1)
        masked = np.zeros(len(detections), bool)
        masked[[i for i in np.unique(rows) if detections.masks[i].any()]] = True
        inside = np.where(masked[rows], detections.masks[rows, row, column], inside)
    return np.asarray(inside, bool)


def occupancy_map(
    detections: Detections,
    size_hw: tuple[int, ...],
    shape: tuple[int, ...],
    min_score: float = 0.0,
) -> BoolArray:
    """Draw the detections of at least min_score on a grid (h, w): True where any object is.

    Args:
        size_hw: of the frame, pixels. shape: (h, w) of the grid, such as a feature map's.
    """
    confident = np.flatnonzero(detections.score >= min_score)
    canvas = np.zeros(shape, np.uint8)
    scale = np.array([shape[1] / size_hw[1], shape[0] / size_hw[0]] * 2)
    boxes = (cxcywh_from_xyxy(detections.xyxy[confident]) * scale).round().clip(-9999, 9999)
    for i, (x, y, w, h) in zip(confident, boxes.astype(int).tolist(), strict=True):
        mask = None if detections.masks is None else detections.masks[i].view(np.uint8)
        if mask is not None and mask.any():
            canvas |= cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST)
        else:
            axes = (max(w // 2, 1), max(h // 2, 1))
            cv2.ellipse(canvas, (x, y), axes, 0, 0, 360, (1,), -1)
    return canvas.view(bool)
