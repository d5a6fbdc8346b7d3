"""Detection in overlapping tiles, which enlarge small objects at the network's input.

Start at `detect_in_tiles`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

import numpy as np

from reobj.sources.onnx_layouts import nms
from reobj.types import Detections, Image, IntArray, ReobjError


def parse_tiles(text: str) -> tuple[int, int]:
    """Parse COLUMNSxROWS; "" is 1x1, the whole image.

    >>> parse_tiles("3x2")
    (3, 2)
    """
    text = text or "1x1"
    if not re.fullmatch("[1-8]x[1-8]", text):  # each tile costs a run of the network per frame
        raise ReobjError(f"--detector-tiles {text!r}: expected COLUMNSxROWS of 1 to 8, such as 2x2")
    return int(text[0]), int(text[2])


def tile_boxes(size: tuple[int, int], grid: tuple[int, int], overlap: float = 0.25) -> IntArray:
    """Cut an image of (w, h) into overlapping tiles, (columns * rows, 4) x1, y1, x2, y2.

    overlap: of neighbouring tiles, over their side: smaller objects are complete in one of them
    (SAHI: .2).
    """
    spans = []
    for length, count in zip(size, grid, strict=True):
        side = length / (count - (count - 1) * overlap)
        start = np.linspace(0, length - side, count)
        spans.append(np.stack([np.floor(start), np.ceil(start + side)], 1).clip(0, length))
    (x, y) = spans
    (columns, rows) = grid
    corners = np.hstack([np.tile(x, (rows, 1)), np.repeat(y, columns, 0)])  # x1, x2, y1, y2
    return corners[:, [0, 2, 1, 3]].astype(np.int64)


def detect_in_tiles(
    detect: Callable[[list[Image]], Iterable[Detections]], image: Image, grid: tuple[int, int]
) -> Detections:
    """Detect in the whole image and in its tiles; best first, without duplicates.

    Boxes cut by an edge of their tile are dropped: the object is complete in the whole image or in
    the next tile.

    Args:
        detect: images -> the detections of each.
    """
    height, width = image.shape[:2]
    tiles = np.vstack([[0, 0, width, height], tile_boxes((width, height), grid)])  # (V, 4)
    parts = [np.ascontiguousarray(image[y1:y2, x1:x2]) for x1, y1, x2, y2 in tiles.tolist()]
    found = []
    for (x1, y1, x2, y2), one in zip(tiles.tolist(), detect(parts), strict=True):
        inside = np.array([x1 > 0, y1 > 0, x2 < width, y2 < height])  # edges inside the image
        size = np.array([x2 - x1, y2 - y1])
        gap = np.hstack([one.xyxy[:, :2], size - one.xyxy[:, 2:]])  # (D, 4) to the edges
        cut = (gap <= np.tile(0.01 * size, 2)) & inside  # boxes nearer to an edge count as cut
        found.append(one[~cut.any(1)])
    view = np.repeat(np.arange(len(tiles)), list(map(len, found)))  # (N,)
    xyxy = np.concatenate([one.xyxy for one in found]) + tiles[view][:, [0, 1, 0, 1]]
    score = np.concatenate([one.score for one in found])
    class_id = np.concatenate([one.class_id for one in found])
    rows = np.argsort(-score, kind="stable")
    rows = rows[nms(xyxy[rows], class_id[rows], 0.55)]  # as weighted box fusion (.55): RESULTS.md
    masks = None
    if any(one.masks is not None for one in found):
        masks = np.zeros((len(rows), height, width), bool)
        for mask, row, v in zip(masks, rows.tolist(), view[rows].tolist(), strict=True):
            x1, y1, x2, y2 = tiles[v].tolist()
            mask[y1:y2, x1:x2] = found[v].masks[row - np.searchsorted(view, v)]
    return Detections(xyxy[rows], score[rows], class_id[rows], masks)
