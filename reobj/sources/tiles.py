"""Detection in overlapping tiles: small things are larger in what the network is fed.

Start at `detect_in_tiles`. Weighted box fusion stands here in a few lines: the package
ensemble-boxes gives the same boxes (a test compares), but knows no masks and brings numba, llvmlite
and pandas, 290 MB, for a function that is plain numpy.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from reobj.types import Array, Detections, Image, IntArray, ReobjError, box_iou

MAX_TILES = 8  # a side; chosen: each tile costs a run of the network a frame
# Of a tile's side, with its neighbour (SAHI: .2): what is smaller is whole in one of them
TILE_OVERLAP = 0.25
CUT = 0.01  # of a tile's side: boxes that come so near to an edge inside the image are cut off
FUSION_IOU = 0.55  # above it boxes of a class are one (Solovyev et al.)


def parse_tiles(text: str) -> tuple[int, int]:
    """Parse COLUMNSxROWS; "" is 1x1, the whole image.

    >>> parse_tiles("3x2")
    (3, 2)
    """
    found = re.fullmatch(r"(\d+)x(\d+)", text or "1x1")
    columns, rows = (int(n) for n in found.groups()) if found else (0, 0)
    if not (1 <= columns <= MAX_TILES and 1 <= rows <= MAX_TILES):
        expected = f"COLUMNSxROWS of 1 to {MAX_TILES}, such as 2x2"
        raise ReobjError(f"--detector-tiles {text!r}: expected {expected}")
    return columns, rows


def tile_boxes(size: tuple[int, int], grid: tuple[int, int]) -> IntArray:
    """Cut an image of (w, h) into overlapping tiles, (columns * rows, 4) x1, y1, x2, y2."""
    spans = []
    for length, count in zip(size, grid, strict=True):
        side = length / (count - (count - 1) * TILE_OVERLAP)
        start = np.linspace(0, length - side, count)
        spans.append(np.stack([np.floor(start), np.ceil(start + side)], 1).clip(0, length))
    (x, y), (columns, rows) = spans, grid
    corners = np.hstack([np.tile(x, (rows, 1)), np.repeat(y, columns, 0)])  # x1, x2, y1, y2
    return corners[:, [0, 2, 1, 3]].astype(np.int64)


def weighted_box_fusion(xyxy: Array, score: Array, class_id: IntArray) -> tuple[Array, IntArray]:
    """Fuse boxes of a class that overlap into their mean, weighted by the scores.

    Ref: Solovyev et al., Image and Vision Computing 2021. The score of a fused box is the best one,
    not the mean over the views: that a tile does not show a thing says nothing about it.

    Args:
        xyxy: (N, 4). score, class_id: (N,).
    Returns:
        boxes (K, 4), best score first; (K,) the row of the best box of each.
    """
    fused = np.empty_like(xyxy)  # (N, 4), of which the first K count
    groups: list[list[int]] = []
    for row in np.argsort(-score, kind="stable").tolist():
        best = np.array([group[0] for group in groups], np.int64)  # (K,)
        iou = box_iou(xyxy[[row]], fused[: len(groups)])[0] * (class_id[best] == class_id[row])
        if iou.max(initial=0) > FUSION_IOU:
            groups[k := int(iou.argmax())].append(row)
        else:
            k = len(groups)
            groups.append([row])
        weights = np.maximum(score[groups[k]], 1e-9)
        fused[k] = np.average(xyxy[groups[k]], 0, weights)
    return fused[: len(groups)], np.array([group[0] for group in groups], np.int64)


def detect_in_tiles(
    detect: Callable[[Image], Detections], image: Image, grid: tuple[int, int]
) -> Detections:
    """Detect in the whole image and in its tiles, and fuse what was found; best first.

    Boxes that an edge of their tile cuts are left out: the whole image or the next tile has all of
    the object. A mask is that of the best box.
    """
    height, width = image.shape[:2]
    tiles = np.vstack([[0, 0, width, height], tile_boxes((width, height), grid)])  # (V, 4)
    found = []
    for tile in tiles:
        x1, y1, x2, y2 = tile.tolist()
        own = detect(np.ascontiguousarray(image[y1:y2, x1:x2]))
        inside = np.array([x1 > 0, y1 > 0, x2 < width, y2 < height])  # edges that may cut
        margin = CUT * np.array([x2 - x1, y2 - y1])
        gap = np.hstack([own.xyxy[:, :2], (x2 - x1, y2 - y1) - own.xyxy[:, 2:]])  # (D, 4) to edges
        found.append(own[~((gap <= np.tile(margin, 2)) & inside).any(1)])
    view = np.repeat(np.arange(len(tiles)), [len(own) for own in found])  # (N,)
    xyxy, score, class_id = (
        np.concatenate([getattr(own, n) for own in found]) for n in ("xyxy", "score", "class_id")
    )
    boxes, best = weighted_box_fusion(xyxy + tiles[view][:, [0, 1, 0, 1]], score, class_id)
    masks = None
    if any(own.masks is not None for own in found):
        masks = np.zeros((len(best), height, width), bool)
        row = best - np.searchsorted(view, view[best])  # (K,) in its own view
        for k, v in enumerate(view[best].tolist()):
            x1, y1, x2, y2 = tiles[v].tolist()
            masks[k, y1:y2, x1:x2] = found[v].masks[row[k]]
    return Detections(boxes, score[best], class_id[best], masks)
