"""Layouts of ONNX detectors: how each family is recognised, fed and decoded.

LAYOUTS lists the families. `OnnxDetector` runs the models.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from reobj.sources.recorded import NORMALISED_MAX
from reobj.sources.weights import IMAGENET_MEAN, IMAGENET_STD
from reobj.types import Array, BoolArray, Image, IntArray, xyxy_from_cxcywh

GFL_BINS = 8  # bins of a distance, 0 to 7 strides (NanoDet-Plus, PicoDet: reg_max 7)


@dataclass(frozen=True, slots=True)
class Geometry:
    """Map between image and network input: input = image * scale + pad; all (x, y), px."""

    image_size: tuple[int, int]
    input_size: tuple[int, int]
    scale: tuple[float, float]
    pad: tuple[int, int]

    def to_image(self, xyxy: Array) -> Array:
        """Map (N, 4) boxes from the input to the image."""
        return np.asarray((xyxy - np.tile(self.pad, 2)) / np.tile(self.scale, 2), np.float64)


@dataclass(frozen=True, slots=True)
class Decoded:
    """Decoded outputs: boxes in px of the image.

    `masks` decodes the masks of K rows, (K, H, W); None: the model has no masks.
    """

    xyxy: Array
    score: Array
    class_id: IntArray
    masks: Callable[[IntArray], BoolArray] | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """Outputs of a trial run, the number of inputs and the input's (w, h)."""

    outputs: list[Any]
    inputs: int
    size: tuple[int, int]

    @property
    def rows(self) -> tuple[int, int]:
        """Return the (rows, columns) of a single output, besides masks; (0, 0) for several."""
        first, *others = (output.shape for output in self.outputs)
        single = len(first) == 3 and all(len(shape) == 4 for shape in others)
        return (first[1], first[2]) if single else (0, 0)

    def anchors(self, levels: int) -> int:
        """Count the cells of all levels, of 8, 16, 32, ... px."""
        return sum(math.prod(math.ceil(v / (8 << k)) for v in self.size) for k in range(levels))


@dataclass(frozen=True, slots=True)
class Layout:
    """Family of detectors: how it is recognised, fed and decoded.

    Attributes:
        fit: "stretch" the image to the input, or keep its aspect ratio and pad: "corner" (image at
            the top left) or "centre".
        rgb: channel order of the network. mean, std: of the pixels, 0..255, in that order.
        nms_iou: IoU above which two boxes of a class are duplicates (NanoDet: .6); None: the model
            has selected its boxes.
        first: label of the first class. classes: number of classes (0: unknown from the outputs).
    """

    name: str
    accepts: Callable[[Trial], bool]
    decode: Callable[[list[Any], Geometry], Decoded]
    fit: str = "stretch"
    rgb: bool = True
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (255.0, 255.0, 255.0)
    nms_iou: float | None = 0.6
    first: int = 0
    classes: Callable[[Trial], int] = lambda trial: 0


def fit_image(image: Image, size: tuple[int, int], fit: str) -> tuple[Image, Geometry]:
    """Resize an image to a network's input of (w, h); fit: see `Layout`.

    Borders have the grey level of YOLOX and Ultralytics.
    """
    height, width = image.shape[:2]
    w, h = size
    if fit != "stretch":
        ratio = min(size[0] / width, size[1] / height)
        w = max(round(width * ratio), 1)
        h = max(round(height * ratio), 1)
    left, top = ((size[0] - w) // 2, (size[1] - h) // 2) if fit == "centre" else (0, 0)
    canvas = np.full((size[1], size[0], 3), 114, np.uint8)
    canvas[top : top + h, left : left + w] = cv2.resize(image, (w, h))
    return canvas, Geometry((width, height), size, (w / width, h / height), (left, top))


def _grid(size: tuple[int, int], levels: int) -> tuple[Array, Array]:
    """List the cells of all levels, of 8, 16, 32, ... px: x, y (A, 2) and stride (A, 1)."""
    cells = []
    stride = []
    for s in (8 << k for k in range(levels)):
        y, x = np.mgrid[: math.ceil(size[1] / s), : math.ceil(size[0] / s)]
        cells.append(np.stack([x.ravel(), y.ravel()], 1).astype(np.float64))
        stride.append(np.full((x.size, 1), float(s)))
    return np.concatenate(cells), np.concatenate(stride)


def best_rows(score: Array, most: int = 1000) -> IntArray:
    """Return the rows of the highest of (N,) scores, best first; most: as in NanoDet."""
    return np.argsort(-score, kind="stable")[:most]


def _best_class(scores: Array) -> tuple[Array, IntArray]:
    """Return the best score (N,) in each row of (N, C), and its class (N,)."""
    return scores.max(1).astype(np.float64), scores.argmax(1).astype(np.int64)


def _pick_outputs(outs: list[Any]) -> tuple[Array, Array, IntArray]:
    """Find boxes, scores and labels among the outputs of a model with its own selection.

    Returns:
        boxes (N, 4), scores (N,), integer labels (N,).
    Raises:
        StopIteration: one of them is missing.
    """
    boxes = next(o for o in outs if o.ndim in (2, 3) and o.shape[-1] == 4).reshape(-1, 4)
    flat = [o.ravel() for o in outs if o.ndim < 3 and o.size == len(boxes)]
    labels = next(o for o in flat if o.dtype.kind == "i")
    scores = next(o for o in flat if o.dtype.kind == "f")
    return boxes.astype(np.float64), scores.astype(np.float64), labels.astype(np.int64)


def _decode_yolox(outs: list[Any], geometry: Geometry) -> Decoded:
    """Decode centre, log size, objectness and class scores of each cell, or of decoded boxes.

    Ref: YOLOX (Ge et al. 2021), whose exports are raw or with the decoder included.
    """
    rows = outs[0][0].astype(np.float64)  # (A, 5 + C)
    if np.median(np.abs(rows[:, :2])) < 8:  # raw: below 2; decoded: half of the image, px
        cells, stride = _grid(geometry.input_size, 3)
        rows[:, :2] = (rows[:, :2] + cells) * stride
        rows[:, 2:4] = np.exp(rows[:, 2:4]) * stride
    score, label = _best_class(rows[:, 5:])
    return Decoded(geometry.to_image(xyxy_from_cxcywh(rows)), score * rows[:, 4], label)


def _decode_yolo(outs: list[Any], geometry: Geometry) -> Decoded:
    """Decode columns of centre, size, class scores[, mask coefficients]; and mask prototypes.

    A mask is the region of positive sums of the prototypes, weighted by the coefficients (YOLACT,
    Bolya et al. 2019).
    """
    rows = outs[0][0].T  # (A, 4 + C [+ 32])
    proto = next((o[0] for o in outs[1:]), np.empty((0, 1, 1)))  # (32, h, w)
    end = rows.shape[1] - len(proto)
    score, label = _best_class(rows[:, 4:end])
    boxes = geometry.to_image(xyxy_from_cxcywh(rows))
    ratio = np.divide(proto.shape[:0:-1], geometry.input_size)  # (2,) map / input

    def masks(chosen: IntArray) -> BoolArray:
        maps = np.tensordot(rows[chosen, end:], proto, 1)  # (K, h, w)
        scale = ratio * geometry.scale
        pad = ratio * geometry.pad
        return _paste(maps, boxes[chosen], geometry.image_size, scale, pad, 0.0)

    return Decoded(boxes, score, label, masks if len(proto) else None)


def _decode_gfl(outs: list[Any], geometry: Geometry) -> Decoded:
    """Decode class scores and, for each side, the distribution of its distance from the cell.

    The distance is the expectation over the bins, in strides (Generalized Focal Loss, Li et al.
    2020). NanoDet-Plus: rows of both, distances from the cell's corner. PicoDet: scores by level,
    then bins by level, distances from the cell's centre.
    """
    if len(outs) == 1:
        levels = 4
        center = 0.0
        scores, bins = np.split(outs[0][0], [-4 * GFL_BINS], 1)
    else:
        levels = len(outs) // 2
        center = 0.5
        scores, bins = (np.concatenate(half, 1)[0] for half in (outs[:levels], outs[levels:]))
    score, label = _best_class(scores)
    keep = best_rows(score)  # saves the time of the other bins
    cells, stride = (v[keep] for v in _grid(geometry.input_size, levels))
    logits = bins[keep].reshape(-1, 4, GFL_BINS).astype(np.float64)
    weight = np.exp(logits - logits.max(2, keepdims=True))
    distance = weight @ np.arange(GFL_BINS) / weight.sum(2) * stride  # (K, 4) to the sides
    xy = (cells + center) * stride
    boxes = np.hstack([xy - distance[:, :2], xy + distance[:, 2:]])
    return Decoded(geometry.to_image(boxes), score[keep], label[keep])


def _decode_with_nms(outs: list[Any], geometry: Geometry) -> Decoded:
    """Decode boxes, labels, scores[, masks] after the model's own NMS."""
    boxes, scores, labels = _pick_outputs(outs)
    if len(boxes) and boxes.max() <= NORMALISED_MAX:
        boxes = boxes * np.tile(geometry.input_size, 2)
    boxes = geometry.to_image(boxes)
    maps = [o[:, 0] for o in outs if o.ndim == 4]  # (N, h, w) probabilities

    def masks(chosen: IntArray) -> BoolArray:
        low = boxes[chosen, :2]
        high = boxes[chosen, 2:]
        ratio = np.array(maps[0].shape[:0:-1]) / np.maximum(high - low, 1e-6)  # (K, 2)
        return _paste(maps[0][chosen], boxes[chosen], geometry.image_size, ratio, -low * ratio, 0.5)

    return Decoded(boxes, scores, labels, masks if maps else None)


def _paste(maps: Any, boxes: Array, size: tuple[int, int], ratio: Array, offset: Array,
           threshold: float) -> BoolArray:  # fmt: skip
    """Resample the maps of masks inside their boxes.

    Args:
        maps: (K, h, w). boxes: (K, 4) in px of the image of (w, h) `size`.
        ratio, offset: (2,) or (K, 2): map = image * ratio + offset, both (x, y) from the corner.
        threshold: a pixel belongs to the mask where the map is above.
    Returns:
        (K, H, W) masks, False outside the boxes.
    """
    masks = np.zeros((len(maps), size[1], size[0]), bool)  # (K, H, W)
    ratio, offset = (np.broadcast_to(v, (len(maps), 2)) for v in (ratio, offset))
    low = np.clip(np.floor(boxes[:, :2]), 0, size).astype(int)
    high = np.clip(np.ceil(boxes[:, 2:]), 0, size).astype(int)
    for k in np.flatnonzero((high > low).all(1)):
        (x1, y1) = low[k].tolist()
        (x2, y2) = high[k].tolist()
        shift = ratio[k] * (low[k] + 0.5) + offset[k] - 0.5  # pixel centres on pixel centres
        affine = np.column_stack([np.diag(ratio[k]), shift])  # (2, 3)
        values = cv2.warpAffine(
            np.ascontiguousarray(maps[k], np.float32), affine, (x2 - x1, y2 - y1),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        masks[k, y1:y2, x1:x2] = values > threshold
    return masks


def _has_nms(trial: Trial) -> bool:
    """Test whether the outputs have boxes (.., N, 4), integer labels and scores of the same N."""
    with contextlib.suppress(StopIteration):
        return len(_pick_outputs(trial.outputs)) == 3
    return False


LAYOUTS: tuple[Layout, ...] = (  # the first that accepts a model is used
    Layout("DEIM, D-FINE, RT-DETR (labels, boxes, scores)",
            lambda t: t.inputs == 2 and _has_nms(t),  # the second is the image size: no scaling
            lambda outs, geometry: Decoded(*_pick_outputs(outs)), nms_iou=None),
    Layout("PicoDet",
            lambda t: len(t.outputs) in (6, 8) and t.outputs[-1].shape[2:] == (4 * GFL_BINS,),
            _decode_gfl, mean=IMAGENET_MEAN, std=IMAGENET_STD,
            classes=lambda t: int(t.outputs[0].shape[2])),
    Layout("NanoDet-Plus",
            lambda t: t.rows[0] == t.anchors(4) and t.rows[1] > 4 * GFL_BINS,
            _decode_gfl, rgb=False, mean=IMAGENET_MEAN[::-1], std=IMAGENET_STD[::-1],
            classes=lambda t: t.rows[1] - 4 * GFL_BINS),
    Layout("YOLOX", lambda t: t.rows[0] == t.anchors(3) and t.rows[1] > 5,
            _decode_yolox, "corner", rgb=False, std=(1.0, 1.0, 1.0),
            classes=lambda t: t.rows[1] - 5),
    Layout("YOLOv8, YOLO11 (and -seg)",
            lambda t: t.rows[1] == t.anchors(3) and t.rows[0] > 4,
            _decode_yolo, "centre",
            classes=lambda t: t.rows[0] - 4 - sum(o.shape[1] for o in t.outputs[1:])),
    Layout("Mask R-CNN",
            lambda t: _has_nms(t) and any(o.shape[2:] == (28, 28) for o in t.outputs),
            _decode_with_nms, "corner", rgb=False,
            mean=(102.9801, 115.9465, 122.7717), std=(1.0, 1.0, 1.0),  # as maskrcnn-benchmark
            nms_iou=None, first=1),
    Layout("SSD with built-in NMS", _has_nms, _decode_with_nms, mean=IMAGENET_MEAN,
            std=IMAGENET_STD, nms_iou=None, first=1),
)  # fmt: skip
