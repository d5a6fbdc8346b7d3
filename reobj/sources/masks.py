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
    flat = cv2.transpose(mask.view(np.uint8)).ravel()  # (W * H,)
    edges = np.flatnonzero(np.diff(flat, prepend=np.uint8(0)))
    counts = np.diff(edges, prepend=0, append=flat.size).astype(np.uint32)
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


def polygon_runs(rings: Sequence[Sequence[float]], size: tuple[int, int]) -> Counts:
    """Fill polygons (x, y, x, y, ... in px, corner convention) in a (w, h) image."""
    flat = np.concatenate([np.empty(0), *(np.asarray(ring, np.float64).ravel() for ring in rings)])
    if not (np.abs(flat) <= COORDINATE_MAX).all():
        raise ValueError(
            f"a polygon with corners that are not finite, or beyond {COORDINATE_MAX:g}"
        )
    canvas = np.zeros(size[::-1], np.uint8)
    bits = 4  # of fractions of a pixel, 1/16 px: finer than annotations
    for ring in rings:  # OpenCV's first pixel has its centre at (0, 0), ours at (0.5, 0.5)
        corners = np.round((np.reshape(ring, (-1, 2)) - 0.5) * (1 << bits)).astype(np.int32)
        cv2.fillPoly(canvas, [corners], 1, shift=bits)
    return rle_encode(canvas > 0)
