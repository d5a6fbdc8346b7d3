"""Detectors: ONNX layouts, callables, and the cache of what they found."""

from __future__ import annotations

import ast
import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reobj.files import save_npz
from reobj.sources.detection_files import (
    NORMALISED_MAX,
    DetectConfig,
    RecordedDetections,
    class_filter,
    load_class_names,
    pack_detections,
    read_npz,
    unnamed_class,
)
from reobj.sources.weights import IMAGENET_MEAN, IMAGENET_STD, model_path, onnx_session
from reobj.types import (
    COCO_NAMES,
    Array,
    BoolArray,
    Detections,
    Image,
    IntArray,
    ReobjError,
    as_detections,
    log,
    xyxy_from_cxcywh,
)

PAD_VALUE = 114  # grey of letterbox borders (YOLOX, Ultralytics)
DYNAMIC_SIDE = 640  # longer side for models that take any size (YOLO11 was trained so)
SIZE_MULTIPLE = 32  # such models want multiples of their largest stride
PRE_NMS = 1000  # best candidates that enter NMS
GFL_BINS = 8  # distance bins of NanoDet-Plus and PicoDet (reg_max 7)
YOLO_STRIDES, GFL_STRIDES = (8, 16, 32), (8, 16, 32, 64)
RAW_YOLOX_MAX = 8.0  # median |x, y| of raw YOLOX is below 2, of decoded boxes half the image
RCNN_MASK = (28, 28)  # masks of Mask R-CNN that cover their box
NANODET_STD = (57.375, 57.12, 58.395)  # BGR
CAFFE_MEAN = (102.9801, 115.9465, 122.7717)  # BGR


@dataclass(frozen=True, slots=True)
class _Geometry:
    """Where the image lies in the network's input: input = image * scale + pad, all (x, y)."""

    image_size: tuple[int, int]
    input_size: tuple[int, int]
    scale: tuple[float, float]
    pad: tuple[int, int]

    def to_image(self, xyxy: Array) -> Array:
        """Map (N, 4) boxes from the input to the image."""
        return np.asarray((xyxy - np.tile(self.pad, 2)) / np.tile(self.scale, 2), np.float64)


@dataclass(frozen=True, slots=True)
class _Found:
    """What a decoder finds: boxes in the image, and what makes the masks of chosen rows."""

    xyxy: Array
    score: Array
    class_id: IntArray
    masks: Callable[[IntArray], BoolArray] | None = None


@dataclass(frozen=True, slots=True)
class _Trial:
    """What a trial run tells: the outputs, for how many inputs and which (w, h)."""

    outputs: list[Any]
    inputs: int
    size: tuple[int, int]

    @property
    def rows(self) -> tuple[int, int]:
        """(rows, columns) of the first output if it is the only one but for masks, else (0, 0)."""
        first, *others = (output.shape for output in self.outputs)
        single = len(first) == 3 and all(len(shape) == 4 for shape in others)
        return (first[1], first[2]) if single else (0, 0)

    def anchors(self, strides: Sequence[int]) -> int:
        return sum(math.ceil(self.size[0] / s) * math.ceil(self.size[1] / s) for s in strides)


@dataclass(frozen=True, slots=True)
class _Layout:
    """One family of detectors: how to know it, what it is fed, how its outputs are read.

    Attributes:
        fit: "stretch" to the input, or keep the aspect with the image in the "corner" or "centre".
        mean, std: of 0..255 values, in the order that the network wants. nms: its boxes need NMS.
        first: label of the first class. classes: number of classes (0: the model does not tell).
    """

    name: str
    accepts: Callable[[_Trial], bool]
    decode: Callable[[list[Any], _Geometry], _Found]
    fit: str = "stretch"
    rgb: bool = True
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (255.0, 255.0, 255.0)
    nms: bool = True
    first: int = 0
    classes: Callable[[_Trial], int] = lambda trial: 0


def _fit_image(image: Image, size: tuple[int, int], fit: str) -> tuple[Image, _Geometry]:
    """Resize an image into a network's input of (w, h)."""
    height, width = image.shape[:2]
    w, h = size
    if fit != "stretch":
        ratio = min(size[0] / width, size[1] / height)
        w, h = max(round(width * ratio), 1), max(round(height * ratio), 1)
    left, top = ((size[0] - w) // 2, (size[1] - h) // 2) if fit == "centre" else (0, 0)
    canvas = np.full((size[1], size[0], 3), PAD_VALUE, np.uint8)
    canvas[top : top + h, left : left + w] = cv2.resize(image, (w, h))
    return canvas, _Geometry((width, height), size, (w / width, h / height), (left, top))


def _grid(size: tuple[int, int], strides: Sequence[int]) -> tuple[Array, Array]:
    """Return (A, 2) cells x, y and their (A, 1) strides, row by row, level by level."""
    cells, stride = [], []
    for s in strides:
        y, x = np.mgrid[: math.ceil(size[1] / s), : math.ceil(size[0] / s)]
        cells.append(np.stack([x.ravel(), y.ravel()], 1).astype(np.float64))
        stride.append(np.full((x.size, 1), float(s)))
    return np.concatenate(cells), np.concatenate(stride)


def _best_class(scores: Array) -> tuple[Array, IntArray]:
    """Return the best score of each row of (N, C), and its class."""
    return scores.max(1).astype(np.float64), scores.argmax(1).astype(np.int64)


def _pick_outputs(outs: list[Any]) -> tuple[Array, Array, IntArray]:
    """Return boxes (N, 4), scores (N,) and integer labels (N,) of a model with those outputs."""
    boxes = next(o for o in outs if o.ndim in (2, 3) and o.shape[-1] == 4).reshape(-1, 4)
    flat = [o.ravel() for o in outs if o.ndim < 3 and o.size == len(boxes)]
    labels = next(o for o in flat if o.dtype.kind == "i")
    scores = next(o for o in flat if o.dtype.kind == "f")
    return boxes.astype(np.float64), scores.astype(np.float64), labels.astype(np.int64)


def _decode_yolox(outs: list[Any], geometry: _Geometry) -> _Found:
    """Centre, log size, objectness and classes of each cell, or the same already decoded."""
    rows = outs[0][0].astype(np.float64)  # (A, 5 + C)
    if np.median(np.abs(rows[:, :2])) < RAW_YOLOX_MAX:
        cells, stride = _grid(geometry.input_size, YOLO_STRIDES)
        rows[:, :2] = (rows[:, :2] + cells) * stride
        rows[:, 2:4] = np.exp(rows[:, 2:4]) * stride
    score, label = _best_class(rows[:, 5:])
    return _Found(geometry.to_image(xyxy_from_cxcywh(rows)), score * rows[:, 4], label)


def _decode_yolo(outs: list[Any], geometry: _Geometry) -> _Found:
    """Columns of centre, size, class scores[, mask coefficients]; mask prototypes (YOLOv8, 11)."""
    rows = outs[0][0].T  # (A, 4 + C [+ 32])
    proto = next((o[0] for o in outs[1:]), np.empty((0, 1, 1)))  # (32, h, w)
    end = rows.shape[1] - len(proto)
    score, label = _best_class(rows[:, 4:end])
    boxes = geometry.to_image(xyxy_from_cxcywh(rows))
    ratio = np.divide(proto.shape[:0:-1], geometry.input_size)  # (2,) map / input

    def masks(chosen: IntArray) -> BoolArray:
        maps = np.tensordot(rows[chosen, end:], proto, 1)  # (K, h, w)
        scale, pad = ratio * geometry.scale, ratio * geometry.pad
        return _paste(maps, boxes[chosen], geometry.image_size, scale, pad, 0.0)

    return _Found(boxes, score, label, masks if len(proto) else None)


def _decode_gfl(outs: list[Any], geometry: _Geometry) -> _Found:
    """Class scores and distance bins of each cell (Generalized Focal Loss, Li et al. 2020).

    NanoDet-Plus: rows of both, distances from the cell's corner. PicoDet: scores by level, then
    bins by level, distances from the cell's centre.
    """
    if len(outs) == 1:
        levels, center = len(GFL_STRIDES), 0.0
        scores, bins = np.split(outs[0][0], [-4 * GFL_BINS], 1)
    else:
        levels, center = len(outs) // 2, 0.5
        scores, bins = (np.concatenate(part, 1)[0] for part in (outs[:levels], outs[levels:]))
    score, label = _best_class(scores)
    keep = np.argsort(-score, kind="stable")[:PRE_NMS]  # bins of the rest are not worth it
    cells, stride = (v[keep] for v in _grid(geometry.input_size, GFL_STRIDES[:levels]))
    logits = bins[keep].reshape(-1, 4, GFL_BINS).astype(np.float64)
    weight = np.exp(logits - logits.max(2, keepdims=True))
    distance = weight @ np.arange(GFL_BINS) / weight.sum(2) * stride  # (K, 4) to the sides
    xy = (cells + center) * stride
    boxes = np.hstack([xy - distance[:, :2], xy + distance[:, 2:]])
    return _Found(geometry.to_image(boxes), score[keep], label[keep])


def _decode_with_nms(outs: list[Any], geometry: _Geometry) -> _Found:
    """Boxes, labels, scores[, masks that cover the box] after the model's own NMS."""
    boxes, scores, labels = _pick_outputs(outs)
    if len(boxes) and boxes.max() <= NORMALISED_MAX:
        boxes = boxes * np.tile(geometry.input_size, 2)
    boxes = geometry.to_image(boxes)
    maps = [o[:, 0] for o in outs if o.ndim == 4]  # (N, h, w) probabilities

    def masks(chosen: IntArray) -> BoolArray:
        low, high = boxes[chosen, :2], boxes[chosen, 2:]
        ratio = np.array(RCNN_MASK) / np.maximum(high - low, 1e-6)  # (K, 2)
        return _paste(maps[0][chosen], boxes[chosen], geometry.image_size, ratio, -low * ratio, 0.5)

    return _Found(boxes, scores, labels, masks if maps else None)


def _paste(maps: Any, boxes: Array, size: tuple[int, int], ratio: Array, offset: Array,
           threshold: float) -> BoolArray:  # fmt: skip
    """Sample (K, h, w) maps inside their boxes: map = image * ratio + offset, (2,) or (K, 2)."""
    masks = np.zeros((len(maps), size[1], size[0]), bool)  # (K, H, W)
    ratio, offset = (np.broadcast_to(v, (len(maps), 2)) for v in (ratio, offset))
    low = np.clip(np.floor(boxes[:, :2]), 0, size).astype(int)
    high = np.clip(np.ceil(boxes[:, 2:]), 0, size).astype(int)
    for k in np.flatnonzero((high > low).all(1)):
        (x1, y1), (x2, y2) = low[k].tolist(), high[k].tolist()
        shift = ratio[k] * (low[k] + 0.5) + offset[k] - 0.5  # pixel centres on pixel centres
        affine = np.column_stack([np.diag(ratio[k]), shift])  # (2, 3)
        values = cv2.warpAffine(
            np.ascontiguousarray(maps[k], np.float32), affine, (x2 - x1, y2 - y1),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        masks[k, y1:y2, x1:x2] = values > threshold
    return masks


def _has_nms(trial: _Trial) -> bool:
    """Say whether there are boxes (.., N, 4), integer labels and scores of the same N."""
    with contextlib.suppress(StopIteration):
        return len(_pick_outputs(trial.outputs)) == 3
    return False


LAYOUTS: tuple[_Layout, ...] = (  # the first that accepts a model reads it
    _Layout("DEIM, D-FINE, RT-DETR (labels, boxes, scores)",
            lambda t: t.inputs == 2 and _has_nms(t),  # the second is the image size: no scaling
            lambda outs, geometry: _Found(*_pick_outputs(outs)), nms=False),
    _Layout("PicoDet",
            lambda t: len(t.outputs) in (6, 8) and t.outputs[-1].shape[2:] == (4 * GFL_BINS,),
            _decode_gfl, mean=IMAGENET_MEAN, std=IMAGENET_STD,
            classes=lambda t: int(t.outputs[0].shape[2])),
    _Layout("NanoDet-Plus",
            lambda t: t.rows[0] == t.anchors(GFL_STRIDES) and t.rows[1] > 4 * GFL_BINS,
            _decode_gfl, rgb=False, mean=IMAGENET_MEAN[::-1], std=NANODET_STD,
            classes=lambda t: t.rows[1] - 4 * GFL_BINS),
    _Layout("YOLOX", lambda t: t.rows[0] == t.anchors(YOLO_STRIDES) and t.rows[1] > 5,
            _decode_yolox, "corner", rgb=False, std=(1.0, 1.0, 1.0),
            classes=lambda t: t.rows[1] - 5),
    _Layout("YOLOv8, YOLO11 (and -seg)",
            lambda t: t.rows[1] == t.anchors(YOLO_STRIDES) and t.rows[0] > 4,
            _decode_yolo, "centre",
            classes=lambda t: t.rows[0] - 4 - sum(o.shape[1] for o in t.outputs[1:])),
    _Layout("Mask R-CNN",
            lambda t: _has_nms(t) and any(o.shape[2:] == RCNN_MASK for o in t.outputs),
            _decode_with_nms, "corner", rgb=False, mean=CAFFE_MEAN, std=(1.0, 1.0, 1.0),
            nms=False, first=1),
    _Layout("SSD with built-in NMS", _has_nms, _decode_with_nms, mean=IMAGENET_MEAN,
            std=IMAGENET_STD, nms=False, first=1),
)  # fmt: skip


class OnnxDetector:
    """A detector from an ONNX file; its layout is read from its inputs and outputs.

        detector = OnnxDetector("deimv2-femto")
        detections = detector(image)  # BGR; boxes in its pixels

    Attributes:
        class_names: names by class id. layout: name of the layout found. path: the file.
    """

    def __init__(
        self,
        path_or_name: str | Path = "",
        config: DetectConfig | None = None,
        threads: int = 0,
        offline: bool = False,
    ) -> None:
        self.config = config or DetectConfig()
        self.path = model_path(path_or_name or self.config.model, offline)
        self._session = onnx_session(self.path, threads)
        self._inputs = [(i.name, list(i.shape), i.type) for i in self._session.get_inputs()]
        _, shape, kind = self._inputs[0]
        if kind != "tensor(float)" or len(shape) not in (3, 4) or shape[-3] != 3:
            raise self._refusal(f"input is {kind} {shape}, expected an image (1, 3, H, W)")
        trial = self._try_out()
        accepting = [layout for layout in LAYOUTS if layout.accepts(trial)]
        if not accepting:
            outputs = zip(self._session.get_outputs(), trial.outputs, strict=True)
            found = ", ".join(f"{output.name} {array.shape}" for output, array in outputs)
            known = "; ".join(layout.name for layout in LAYOUTS)
            raise self._refusal(f"outputs {found}; known layouts: {known}")
        self._layout = accepting[0]
        self.layout = self._layout.name
        self.class_names = self._names(self._layout.classes(trial))
        wanted = self.config.classes
        self._allowed = class_filter(wanted, self.class_names) if wanted else None

    def __call__(self, image: Image) -> Detections:
        """Detect the objects in one BGR image (H, W, 3), best first."""
        size = self._input_size(image.shape[1], image.shape[0])
        canvas, geometry = _fit_image(image, size, self._layout.fit)
        outputs = self._session.run(None, self._feeds(canvas, geometry.image_size, self._layout))
        found = self._layout.decode(outputs, geometry)
        boxes = np.clip(found.xyxy, 0, np.tile(geometry.image_size, 2))
        label = found.class_id - self._layout.first
        keep = self._select(boxes, found.score, label)
        if len(keep) and label[keep].max() >= len(self.class_names):
            text = unnamed_class(label[keep].max(), len(self.class_names))
            raise ReobjError(f"{self.path}: {text}")
        masks = found.masks(keep) if found.masks is not None else None
        return Detections(boxes[keep], found.score[keep], label[keep], masks)

    def _refusal(self, reason: str) -> ReobjError:
        return ReobjError(f"{self.path}: no known object detector: {reason}")

    def _select(self, boxes: Array, score: Array, label: IntArray) -> IntArray:
        """Return the rows to keep, best first: by score, class, area and NMS."""
        good = (score >= self.config.min_score) & (boxes[:, 2:] > boxes[:, :2]).all(1)
        good &= label >= 0
        if self._allowed is not None:
            good &= np.isin(label, self._allowed)
        rows = np.flatnonzero(good)
        rows = rows[np.argsort(-score[rows], kind="stable")][:PRE_NMS]
        if self._layout.nms:
            rows = rows[nms(boxes[rows], label[rows], self.config.nms_iou)]
        return rows[: self.config.max_detections]

    def _input_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the (w, h) that the model is fed: its own, or the image's at DYNAMIC_SIDE."""
        own = self._inputs[0][1][:-3:-1]
        ratio = DYNAMIC_SIDE / max(width, height) / SIZE_MULTIPLE
        free = [max(math.ceil(round(v * ratio, 3)), 1) * SIZE_MULTIPLE for v in (width, height)]
        w, h = (a if isinstance(a, int) else b for a, b in zip(own, free, strict=True))
        return w, h

    def _feeds(self, canvas: Image, image_size: tuple[int, int], layout: _Layout) -> dict[str, Any]:
        """Return the model's inputs for a fitted BGR image."""
        name, shape, _ = self._inputs[0]
        mean, std = np.array([layout.mean, layout.std], np.float32)
        blob = (canvas[..., ::-1] if layout.rgb else canvas).astype(np.float32)
        blob = np.ascontiguousarray(((blob - mean) / std).transpose(2, 0, 1))  # (3, H, W)
        feeds = {name: blob[None] if len(shape) == 4 else blob}
        return feeds | {other: np.array([image_size]) for other, _, _ in self._inputs[1:]}

    def _try_out(self) -> _Trial:
        """Run the model on a grey image to learn the shapes of its outputs."""
        size = self._input_size(DYNAMIC_SIDE, DYNAMIC_SIDE)
        grey = np.full((size[1], size[0], 3), PAD_VALUE, np.uint8)
        try:
            outputs = self._session.run(None, self._feeds(grey, size, LAYOUTS[0]))
        except Exception as error:
            reason = f"a trial run with {self._inputs} failed: {str(error).splitlines()[0]}"
            raise self._refusal(reason) from error
        return _Trial([np.asarray(output) for output in outputs], len(self._inputs), size)

    def _names(self, count: int) -> tuple[str, ...]:
        """Return the class names: the user's, the model's own, COCO's, or numbers."""
        if self.config.class_names:
            return load_class_names(self.config.class_names)
        own = self._session.get_modelmeta().custom_metadata_map.get("names", "")
        if own.startswith("{"):
            return tuple(str(name) for _, name in sorted(ast.literal_eval(own).items()))
        if count in (0, len(COCO_NAMES)):
            return COCO_NAMES
        log.warning("%s: %d classes without names: give a file of names with --set "
                    "detect.class_names=FILE", self.path, count)  # fmt: skip
        return tuple(f"class {i}" for i in range(count))


def nms(xyxy: Array, class_id: IntArray, max_iou: float) -> IntArray:
    """Return the rows that survive greedy NMS by class; rows come best first."""
    xywh = np.hstack([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]])
    rank = np.arange(len(xyxy), 0, -1)
    kept = cv2.dnn.NMSBoxesBatched(xywh.tolist(), rank.tolist(), class_id.tolist(), 0.0, max_iou)
    return np.sort(np.array(kept, np.int64))


class CallableDetector:
    """Any function image -> detections as a detector; `as_detections` says what it may return."""

    def __init__(
        self, function: Callable[[Image], Any], class_names: Sequence[str] = COCO_NAMES
    ) -> None:
        self.function, self.class_names = function, tuple(class_names)

    def __call__(self, image: Image) -> Detections:
        """Detect the objects in one BGR image (H, W, 3)."""
        return as_detections(self.function(image))


CACHE_FRAMES = 64  # frames in one file of the detection cache


class DetectionCache:
    """Detections of a detector on disk, so that a killed run goes on where it stopped.

    A folder of npz files with `CACHE_FRAMES` frames each, written whole or not at all: a kill loses
    the frames since the last `flush`, never half of one. Masks have the `image_size` of the frames.
    """

    def __init__(self, folder: str | Path, image_size: tuple[int, int]) -> None:
        self.folder, self.image_size = Path(folder), image_size
        self._stored: dict[int, RecordedDetections] = {}
        self._fresh: dict[int, Detections] = {}
        chunks = sorted(self.folder.glob("chunk_*.npz"))
        self._next = 1 + max((int(path.stem[6:]) for path in chunks), default=-1)
        for path in chunks:
            self._load(path)

    def _load(self, path: Path) -> None:
        try:
            chunk, done = read_npz(path, self.image_size, self.image_size)
            self._stored |= dict.fromkeys(done.tolist(), chunk)
        except ReobjError as error:
            log.warning("%s; its frames are detected again", error)

    def get(self, index: int) -> Detections | None:
        """Return the stored detections of a frame, None if it was not detected yet."""
        if index in self._fresh or index not in self._stored:
            return self._fresh.get(index)
        return self._stored[index].at(index)

    def put(self, index: int, detections: Detections) -> None:
        """Store the detections of a frame, also when there are none."""
        self._fresh[index] = detections
        if len(self._fresh) >= CACHE_FRAMES:
            self.flush()

    def flush(self) -> None:
        """Write what is not on disk yet."""
        if not self._fresh:
            return
        frames = sorted(self._fresh.items())
        path = self.folder / f"chunk_{self._next:06d}.npz"
        done = {"done": np.array([index for index, _ in frames])}
        save_npz(path, pack_detections(frames, [], self.image_size) | done)
        self._next += 1
        self._fresh.clear()
        self._load(path)
