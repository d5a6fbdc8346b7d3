"""Detection in overlapping tiles, which enlarge small objects at the network's input.

Start at `detect_in_tiles`. Weighted box fusion is implemented here: the package ensemble-boxes
gives the same boxes (a test compares), but lacks masks and depends on numba, llvmlite and pandas,
290 MB, for a function that is plain numpy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

import numpy as np

from reobj.types import Array, Detections, Image, IntArray, ReobjError, box_iou


def parse_tiles(text: str) -> tuple[int, int]:
    """Parse COLUMNSxROWS; "" is 1x1, the whole image.

    >>> parse_tiles("3x2")
    (3, 2)
    """
    match = re.fullmatch(r"(\d+)x(\d+)", text or "1x1")
    columns, rows = (int(n) for n in match.groups()) if match else (0, 0)
    if not (1 <= columns <= 8 and 1 <= rows <= 8):  # each tile costs a run of the network per frame
        expected = "COLUMNSxROWS of 1 to 8, such as 2x2"
        raise ReobjError(f"--detector-tiles {text!r}: expected {expected}")
    return columns, rows


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


def weighted_box_fusion(
    xyxy: Array, score: Array, class_id: IntArray, min_iou: float = 0.55
) -> tuple[Array, IntArray]:
    """Fuse boxes of a class that overlap into their mean, weighted by the scores.

    Ref: Solovyev et al., Image and Vision Computing 2021. The score of a fused box is the highest,
    not the mean over the views: most tiles do not show the object.

    Args:
        xyxy: (N, 4). score, class_id: (N,).
        min_iou: IoU above which boxes of a class are fused (.55 in the paper).
    Returns:
        boxes (K, 4), by descending score; row (K,) of the best box of each.
    """
    fused = np.empty_like(xyxy)  # (N, 4), of which the first K count
    groups: list[list[int]] = []
    for row in np.argsort(-score, kind="stable").tolist():
        best = np.array([group[0] for group in groups], np.int64)  # (K,)
        iou = box_iou(xyxy[[row]], fused[: len(groups)])[0] * (class_id[best] == class_id[row])
        if iou.max(initial=0) > min_iou:
            groups[k := int(iou.argmax())].append(row)
        else:
            k = len(groups)
            groups.append([row])
        weights = np.maximum(score[groups[k]], 1e-9)
        fused[k] = np.average(xyxy[groups[k]], 0, weights)
    return fused[: len(groups)], np.array([group[0] for group in groups], np.int64)


def detect_in_tiles(
    detect: Callable[[list[Image]], Iterable[Detections]], image: Image, grid: tuple[int, int]
) -> Detections:
    """Detect in the whole image and in its tiles, and fuse the boxes; best first.

    detect: images -> the detections of each.

    Boxes cut by an edge of their tile are dropped: the object is complete in the whole image or in
    the next tile. The mask of fused boxes is that of the best one.
    """
    height, width = image.shape[:2]
    tiles = np.vstack([[0, 0, width, height], tile_boxes((width, height), grid)])  # (V, 4)
    parts = [np.ascontiguousarray(image[y1:y2, x1:x2]) for x1, y1, x2, y2 in tiles.tolist()]
    per_tile = []
    for tile, detections in zip(tiles, detect(parts), strict=True):
        x1, y1, x2, y2 = tile.tolist()
        xyxy = detections.xyxy
        inside = np.array([x1 > 0, y1 > 0, x2 < width, y2 < height])  # edges inside the image
        margin = 0.01 * np.array([x2 - x1, y2 - y1])  # boxes nearer to an edge count as cut
        gap = np.hstack([xyxy[:, :2], (x2 - x1, y2 - y1) - xyxy[:, 2:]])  # (D, 4) to the edges
        per_tile.append(detections[~((gap <= np.tile(margin, 2)) & inside).any(1)])
    view = np.repeat(np.arange(len(tiles)), [len(detections) for detections in per_tile])  # (N,)
    xyxy, score, class_id = (
        np.concatenate([getattr(detections, name) for detections in per_tile])
        for name in ("xyxy", "score", "class_id")
    )
    boxes, best = weighted_box_fusion(xyxy + tiles[view][:, [0, 1, 0, 1]], score, class_id)
    masks = None
    if any(detections.masks is not None for detections in per_tile):
        masks = np.zeros((len(best), height, width), bool)
        row = best - np.searchsorted(view, view[best])  # (K,) in the view
        for k, v in enumerate(view[best].tolist()):
            x1, y1, x2, y2 = tiles[v].tolist()
            masks[k, y1:y2, x1:x2] = per_tile[v].masks[row[k]]
    return Detections(boxes, score[best], class_id[best], masks)
