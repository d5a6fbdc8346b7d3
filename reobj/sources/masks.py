"""Masks as run lengths: encode, decode, COCO's compressed strings and polygons.

Run lengths follow the columns of the image (COCO's order) and start with a run of zeros. A mask
without pixels has none (`NO_RUNS`) and means "no mask".
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from reobj.types import COORDINATE_MAX, BoolArray

Counts = npt.NDArray[np.uint32]
NO_RUNS: Counts = np.empty(0, np.uint32)


def rle_encode(mask: BoolArray) -> Counts:
    """Encode an (H, W) mask as run lengths."""
    return _runs_of_columns(mask, 0, mask.shape[1])


def _runs_of_columns(columns: BoolArray, first: int, width: int) -> Counts:
    """Encode columns (H, w) of the mask of an image, from `first` of `width`; others are zero."""
    flat = cv2.transpose(columns.view(np.uint8)).ravel()  # (w * H,)
    none = np.uint8(0)
    edges = np.flatnonzero(np.diff(flat, prepend=none, append=none)) + first * len(columns)
    end = width * len(columns)
    counts = np.diff(edges[edges < end], prepend=0, append=end).astype(np.uint32)
    return counts if len(counts) > 1 else NO_RUNS


def rle_decode(counts: Counts, size: tuple[int, int]) -> BoolArray:
    """Decode run lengths to the (H, W) mask of a (w, h) image."""
    if not len(counts):
        return np.zeros(size[::-1], bool)
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)  # (W * H,)
    return np.asarray(cv2.transpose(flat.view(np.uint8).reshape(size))).view(bool)


def coco_runs(text: str) -> Counts:
    """Decode COCO's compressed run lengths (maskApi.c of pycocotools, rleFrString).

    Each character holds five bits, lowest first; flag 0x20: more follow; 0x10 of the last: sign.
    From the fourth run on a number is the difference to the last run but one.
    """
    runs: list[int] = []
    value = shift = 0
    for byte in text.encode():
        value |= (byte - 48 & 0x1F) << shift
        shift += 5
        if byte - 48 & 0x20:
            if shift >= 35:  # holds any signed uint32; longer ones would take quadratic time
                raise ValueError("a run length of more than 35 bits")
            continue
        value -= (byte - 48 >> 4 & 1) << shift  # sign
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    return np.array(runs, np.uint32)


def crop_runs(mask: BoolArray, corner: tuple[int, int], size: tuple[int, int]) -> Counts:
    """Encode an (h, w) part of the mask of an image; what lies outside the image is cut off.

    Args:
        corner: (x, y) of its first pixel in the image. size: (w, h) of the image.
    """
    width, height = size
    x, y = corner
    mask = mask[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0)]
    if not mask.size:
        return NO_RUNS
    strip = np.zeros((height, mask.shape[1]), bool)  # whole columns: runs follow them
    strip[max(y, 0) :][: len(mask)] = mask
    return _runs_of_columns(strip, max(x, 0), width)


def polygon_runs(rings: Sequence[Sequence[float]], size: tuple[int, int]) -> Counts:
    """Fill polygons (x, y, x, y, ... in px, corner convention) in a (w, h) image."""
    corners = [np.reshape(np.asarray(ring, np.float64), (-1, 2)) for ring in rings]
    flat = np.concatenate([np.empty((0, 2)), *corners])
    if not (np.abs(flat) <= COORDINATE_MAX).all():
        raise ValueError("a polygon with corners that are not finite, or beyond 1e7 px")
    if not len(flat):
        return NO_RUNS
    width, height = size
    left = int(np.clip(np.floor(flat[:, 0].min()) - 1, 0, width))  # only the columns of the polygon
    right = int(np.clip(np.ceil(flat[:, 0].max()) + 1, left, width))
    canvas = np.zeros((height, right - left), np.uint8)
    if not canvas.size:
        return NO_RUNS
    bits = 4  # of fractions of a pixel, 1/16 px: finer than annotations
    for ring in corners:  # OpenCV's first pixel has its centre at (0, 0), ours at (0.5, 0.5)
        fixed = np.round((ring - (left + 0.5, 0.5)) * (1 << bits)).astype(np.int32)
        cv2.fillPoly(canvas, [fixed], 1, shift=bits)
    return _runs_of_columns(canvas > 0, left, width)
