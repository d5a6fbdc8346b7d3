"""ONNX detectors: `OnnxDetector` runs a model in one of the layouts.

LAYOUTS is the registry of families: how each is recognised, fed and decoded. docs/input_formats.md
has its table.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reobj.formats import Format, Registry
from reobj.sources.class_names import load_class_names, names_by_number, parse_yaml
from reobj.sources.detection_files import DetectConfig, class_filter, unnamed_class
from reobj.sources.video import in_batches
from reobj.sources.weights import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    failing,
    frames_at_once,
    known_weights,
    model_path,
    onnx_session,
)
from reobj.types import (
    COCO_NAMES,
    NOTE_START,
    Array,
    BoolArray,
    Detections,
    Image,
    IntArray,
    ReobjError,
    as_frame,
    log,
    xyxy_from_cxcywh,
)

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


@dataclass(slots=True)
class ModelProbe:
    """What a layout is recognised by.

    Attributes:
        path: of the file. inputs: their shapes by name. outputs: of a trial run, by name.
        size: (w, h) of the input. metadata: of the file.
        count: number of class names, then of classes of the layout. found, kind: as of a `Probe`.
    """

    path: Path
    inputs: Mapping[str, Sequence[Any]]
    outputs: Mapping[str, Any]
    size: tuple[int, int]
    metadata: Mapping[str, str]
    count: int = 0
    found: str = ""
    kind: str = ""

    @property
    def first(self) -> Any:
        """The first output."""
        return next(iter(self.outputs.values()))

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the outputs."""
        return [output.shape for output in self.outputs.values()]

    def values(self, axis: int, levels: int = 3, boxes: int = 1) -> int:
        """Return the length of axis 1 + `axis` of the first output, the other one being its cells.

        Args:
            levels: of cells, of 8, 16, 32, ... px. boxes: of each cell.
        Returns:
            0: the output has other axes, or there are others than prototypes of masks.
        """
        first, *others = self.shapes
        if len(first) != 3 or not all(len(shape) == 4 for shape in others):
            return 0
        cells = boxes * len(_grid(self.size, levels)[0])
        return int(first[1 + axis] if first[2 - axis] == cells else 0)

    @property
    def in_px(self) -> bool:
        """Whether rows begin with centres in px, across the input; else with offsets in cells."""
        return bool(np.median(np.abs(self.first[0, :, :2])) >= 8)  # offsets: below 2


Decode = Callable[[Sequence[Any], Geometry, ModelProbe], Decoded]


@dataclass(frozen=True, slots=True)
class Pixels:
    """Pixels of a network's input: order of the channels, mean and deviation of 0..255."""

    title: str
    rgb: bool
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (255.0, 255.0, 255.0)


UNIT_RGB = Pixels("RGB, 0..1", True)


@dataclass(frozen=True, slots=True)
class Layout(Format[Decode]):
    """Family of detectors: how it is recognised, fed and decoded.

    Attributes:
        shape: of the outputs, for the table.
        classes: number of classes that the outputs have in this layout, by their shapes; None:
            these leave it open; less than 1: their shapes are others.
        fit: "stretch" the image to the input, or keep its aspect ratio and pad: "corner" (image at
            the top left) or "centre".
        nms_iou: IoU above which two boxes of a class are duplicates (NanoDet: .6); None: the model
            has selected its boxes. px: boxes are in px of the input, centres and sizes first.
    """

    shape: str = ""
    classes: Callable[[ModelProbe], int | None] = lambda model: 0
    pixels: Pixels = UNIT_RGB
    fit: str = "stretch"
    nms_iou: float | None = 0.6
    px: bool = False


def fit_image(image: Image, size: tuple[int, int], fit: str) -> tuple[Image, Geometry]:
    """Resize an image to a network's input of (w, h); fit: see `Layout`.

    Borders have the grey level of YOLOX and Ultralytics.
    """
    height, width = image.shape[:2]
    w, h = size
    if fit != "stretch":
        ratio = min(w / width, h / height)
        w = max(round(width * ratio), 1)
        h = max(round(height * ratio), 1)
    left, top = ((size[0] - w) // 2, (size[1] - h) // 2) if fit == "centre" else (0, 0)
    canvas = np.full((size[1], size[0], 3), 114, np.uint8)
    canvas[top : top + h, left : left + w] = cv2.resize(image, (w, h))
    return canvas, Geometry((width, height), size, (w / width, h / height), (left, top))


def _grid(size: tuple[int, int], levels: int) -> tuple[Array, Array]:
    """List the cells of all levels, of 8, 16, 32, ... px: x, y (A, 2) and stride (A, 1)."""
    cells = []
    for s in (8 << k for k in range(levels)):
        y, x = np.mgrid[: math.ceil(size[1] / s), : math.ceil(size[0] / s)]
        cells.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, s)], 1).astype(np.float64))
    rows = np.concatenate(cells)  # (A, 3)
    return rows[:, :2], rows[:, 2:]


def best_rows(score: Array, most: int = 1000) -> IntArray:
    """Return the rows of the highest of (N,) scores, best first; most: as in NanoDet."""
    return np.argsort(-score, kind="stable")[:most]


def nms(xyxy: Array, class_id: IntArray, max_iou: float) -> IntArray:
    """Suppress boxes that overlap a better one of their class (greedy NMS).

    Args:
        xyxy: (N, 4), best first. max_iou: largest IoU of two remaining boxes of a class.
    Returns:
        remaining rows, ascending.
    """
    xywh = np.hstack([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]])
    rank = np.arange(len(xyxy), 0, -1)
    kept = cv2.dnn.NMSBoxesBatched(xywh.tolist(), rank.tolist(), class_id.tolist(), 0.0, max_iou)
    return np.sort(np.array(kept, np.int64))


def _best_class(scores: Array) -> tuple[Array, IntArray]:
    """Return the best score (N,) in each row of (N, C), and its class (N,)."""
    return scores.max(1).astype(np.float64), scores.argmax(1).astype(np.int64)


def _decode_detr(outs: Sequence[Any], geometry: Geometry, model: ModelProbe) -> Decoded:
    """Decode labels, boxes and scores; the model selects the boxes and scales them to the image."""
    of = dict(zip(model.outputs, outs, strict=True))
    boxes, score = (of[name].astype(np.float64) for name in ("boxes", "scores"))
    return Decoded(boxes.reshape(-1, 4), score.ravel(), of["labels"].ravel().astype(np.int64))


def _decode_zoo(outs: Sequence[Any], geometry: Geometry, model: ModelProbe) -> Decoded:
    """Decode boxes, labels from 1 (0: background), scores[, masks of the boxes, 0..1]."""
    unit = geometry.input_size if "bboxes" in model.outputs else (1, 1)  # SSD: in 0..1
    boxes = geometry.to_image(outs[0].reshape(-1, 4) * np.tile(unit, 2))

    def masks(rows: IntArray) -> BoolArray:
        return _paste(outs[3][rows, 0] - 0.5, boxes[rows], boxes[rows], geometry.image_size)

    score = outs[2].ravel().astype(np.float64)
    label = outs[1].ravel().astype(np.int64) - 1
    return Decoded(boxes, score, label, masks if len(outs) > 3 else None)


def _decode_yolo(
    outs: Sequence[Any], geometry: Geometry, model: ModelProbe, *, rows: bool = False,
    objectness: bool = False, offsets: bool = False, rotated: bool = False,
) -> Decoded:  # fmt: skip
    """Decode centre, size, [objectness,] class scores of each cell[, mask coefficients; and masks].

    A mask is the region of positive sums of the prototypes, weighted by the coefficients (YOLACT,
    Bolya et al. 2019).

    Args:
        rows: of cells, else columns. offsets: where the boxes are not in px, they are offsets from
            the cell and logarithms of sizes, in strides (YOLOX, Ge et al. 2021). rotated: the last
            value is an angle; its boxes become the upright ones around them.
    """
    cells = outs[0][0] if rows else outs[0][0].T  # (A, values)
    if offsets and not model.in_px:
        corner, stride = _grid(geometry.input_size, 3)
        center = (cells[:, :2] + corner) * stride
        size = np.exp(cells[:, 2:4]) * stride
        cells = np.hstack([center, size, cells[:, 4:]])
    if rotated:
        cos, sin = np.abs([np.cos(cells[:, -1:]), np.sin(cells[:, -1:])])
        upright = cos * cells[:, 2:4] + sin * cells[:, 3:1:-1]
        cells = np.hstack([cells[:, :2], upright, cells[:, 4:]])
    begin = 4 + objectness
    end = begin + model.count
    score, label = _best_class(cells[:, begin:end])
    boxes = geometry.to_image(xyxy_from_cxcywh(cells))

    def masks(keep: IntArray) -> BoolArray:
        maps = np.tensordot(cells[keep, end:], outs[1][0], 1)  # (K, h, w) of the whole input
        whole = geometry.to_image(np.tile([0, 0, *geometry.input_size], (len(keep), 1)))
        return _paste(maps, whole, boxes[keep], geometry.image_size)

    score = score * cells[:, 4] if objectness else score
    return Decoded(boxes, score, label, masks if len(outs) > 1 else None)


def _decode_gfl(outs: Sequence[Any], geometry: Geometry, _: ModelProbe) -> Decoded:
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


def _paste(maps: Any, covered: Array, boxes: Array, size: tuple[int, int]) -> BoolArray:
    """Resample the maps of masks inside their boxes.

    Args:
        maps: (K, h, w) positive in the mask. covered: (K, 4) px of the image that each map covers.
        boxes: (K, 4) px of the image. size: (w, h) of the image.
    Returns:
        (K, H, W) masks, False outside the boxes.
    """
    masks = np.zeros((len(maps), size[1], size[0]), bool)  # (K, H, W)
    scale = np.divide(maps.shape[:0:-1], covered[:, 2:] - covered[:, :2])  # (K, 2) map / image
    low = np.clip(np.floor(boxes[:, :2]), 0, size).astype(int)
    high = np.clip(np.ceil(boxes[:, 2:]), 0, size).astype(int)
    shift = scale * (low + 0.5 - covered[:, :2]) - 0.5  # pixel centres on pixel centres
    for k in np.flatnonzero((high > low).all(1)):
        affine = np.column_stack([np.diag(scale[k]), shift[k]])  # (2, 3)
        values = cv2.warpAffine(
            np.ascontiguousarray(maps[k], np.float32), affine, (high[k] - low[k]).tolist(),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        masks[k, low[k, 1] : high[k, 1], low[k, 0] : high[k, 0]] = values > 0
    return masks


def _keypoint_values(model: ModelProbe) -> int:
    """Return how many values a pose model has for the key points of a box; default: COCO's."""
    return math.prod(map(int, re.findall(r"\d{1,4}", model.metadata.get("kpt_shape", "17, 3"))))


def _layout(
    name: str, title: str, shape: str, classes: Callable[[ModelProbe], int | None],
    decode: Decode, tasks: Sequence[str] = ("", "detect"),
    also: Callable[[ModelProbe], bool] = lambda model: True, **fields: Any,
) -> Layout:  # fmt: skip
    """Make an entry, recognised where number of names and task agree with the outputs' shapes.

    Args:
        tasks: in the metadata, as ultralytics writes it; "": none. also: what else is required.
    """

    def recognise(model: ModelProbe) -> bool:
        agree = model.metadata.get("task", "") in tasks and classes(model) in (None, model.count)
        return agree and also(model)

    return Layout(name, title, recognise, decode, shape=shape, classes=classes, **fields)


IMAGENET_RGB = Pixels("RGB, ImageNet", True, IMAGENET_MEAN, IMAGENET_STD)
IMAGENET_BGR = Pixels("BGR, ImageNet", False, IMAGENET_MEAN[::-1], IMAGENET_STD[::-1])
BYTES_BGR = Pixels("BGR, 0..255", False, std=(1.0, 1.0, 1.0))
CAFFE_BGR = Pixels("BGR, less the mean", False, (102.9801, 115.9465, 122.7717), (1.0, 1.0, 1.0))
YOLO = "YOLOv8, YOLO11"
CENTRED: dict[str, Any] = {"fit": "centre", "px": True}

ENTRIES: list[Layout] = [
    _layout("detr", "DEIM, D-FINE, RT-DETR", "labels, boxes, scores",
            lambda m: None if "orig_target_sizes" in m.inputs
            and {"labels", "boxes", "scores"} <= m.outputs.keys() else 0,
            _decode_detr, nms_iou=None),
    _layout("ssd", "SSD of ONNX' model zoo", "bboxes, labels, scores",
            lambda m: None if m.outputs.keys() == {"bboxes", "labels", "scores"} else 0,
            _decode_zoo, pixels=IMAGENET_RGB, nms_iou=None),
    _layout("r-cnn", "Mask R-CNN and Faster R-CNN of ONNX' model zoo",
            "boxes, labels, scores[, (n, 1, 28, 28)]",
            lambda m: None if [*map(len, m.inputs.values())] == [3]
            and [*map(len, m.shapes)] in ([2, 1, 1], [2, 1, 1, 4]) else 0,
            _decode_zoo, fit="corner", pixels=CAFFE_BGR, nms_iou=None),
    _layout("yolo", f"{YOLO}, also -seg", "(1, 4 + classes [+ 32], cells)[, (1, 32, h, w)]",
            lambda m: m.values(0) - 4 - sum(shape[1] for shape in m.shapes[1:] if len(shape) == 4),
            _decode_yolo, ("", "detect", "segment"), **CENTRED),
    _layout("yolo-rows", f"{YOLO}, transposed", "(1, cells, 4 + classes)",
            lambda m: m.values(1) - 4, partial(_decode_yolo, rows=True), **CENTRED),
    _layout("yolo-obb", f"{YOLO}, rotated boxes: the upright one around each",
            "(1, 4 + classes + 1, cells)", lambda m: m.values(0) - 5,
            partial(_decode_yolo, rotated=True), ("obb",), **CENTRED),
    _layout("yolo-pose", f"{YOLO}, key points", "(1, 4 + classes + key points, cells)",
            lambda m: m.values(0) - 4 - _keypoint_values(m), _decode_yolo, ("pose",),
            unread="the key points", **CENTRED),
    _layout("yolov5", "YOLOv5, YOLOv7, YOLOv6", "(1, cells or 3 * cells, 5 + classes)",
            lambda m: max(m.values(1), m.values(1, boxes=3)) - 5,
            partial(_decode_yolo, rows=True, objectness=True),
            also=lambda m: m.in_px and ("output" not in m.outputs or not m.values(1)),
            **CENTRED),
    _layout("yolox", "YOLOX", "(1, cells, 5 + classes)", lambda m: m.values(1) - 5,
            partial(_decode_yolo, rows=True, objectness=True, offsets=True),
            also=lambda m: not m.in_px or "outputs" not in m.outputs,  # which YOLOv6 has
            fit="corner", pixels=BYTES_BGR),
    _layout("nanodet", "NanoDet-Plus", "(1, cells, classes + 32)",
            lambda m: m.values(1, levels=4) - 4 * GFL_BINS, _decode_gfl, pixels=IMAGENET_BGR),
    _layout("picodet", "PicoDet", "of each level (1, cells, classes), then (1, cells, 32)",
            lambda m: m.shapes[0][2] if [*map(len, m.shapes)] in ([3] * 6, [3] * 8)
            and m.shapes[-1][2] == 4 * GFL_BINS else 0,
            _decode_gfl, pixels=IMAGENET_RGB),
]  # fmt: skip
LAYOUTS: Registry[Decode] = Registry("object detectors", "--detector-layout", ENTRIES)


def find_layout(model: ModelProbe, declared: str, names_of: str) -> Layout:
    """Find the layout of a model, by its name if it is declared.

    names_of: who gives the class names, for messages.

    Raises:
        ReobjError: its outputs fit no layout, or several, or not the declared one; or the boxes are
            not in px.
    """
    shapes = ", ".join(f"{name} {output.shape}" for name, output in model.outputs.items())
    counts = {entry.name: entry.classes(model) for entry in ENTRIES}
    near = [f"{name} with {count} classes" for name, count in counts.items() if (count or 0) > 0]
    model.found = (
        f": {shapes}; {model.count} class names ({names_of}), task "
        f"{model.metadata.get('task') or 'not named'}, by shape {' or '.join(near) or 'none'}"
    )
    layout = LAYOUTS.choose(model, declared)
    assert isinstance(layout, Layout)
    count = counts[layout.name]
    if count is not None and count < 1:
        raise ReobjError(f"{model.path}: {shapes}: not the outputs of layout {declared}, "
                         f"{layout.shape}")  # fmt: skip
    boxes = np.abs(model.first[..., :4] if layout.shape[4] == "c" else model.first[:, :4])
    if layout.px and 0 < boxes.max() <= 1.5:
        raise ReobjError(f"{model.path}: its boxes are fractions: export them in px of the input")
    return layout


# ---- The detector -------------------------------------------------------------------------------


NAMES = "give a file of names with --set detect.class_names=FILE"


def check_names(class_id: IntArray, names: Sequence[str], where: str = "") -> None:
    """Refuse class ids (D,) without a name."""
    if len(class_id) and class_id.max() >= len(names):
        raise ReobjError(where + unnamed_class(int(class_id.max()), len(names)))


def best_boxes(
    xyxy: Array, score: Array, use: BoolArray, size: Sequence[int], config: DetectConfig
) -> tuple[Array, IntArray]:
    """Clip boxes to the image of (w, h); select rows, among those to `use`, by score and area.

    Returns:
        the boxes (N, 4) of all rows, and the selected rows, best first.
    """
    boxes = np.clip(xyxy, 0, np.tile(size, 2))
    rows = np.flatnonzero(use & (score >= config.min_score) & (boxes[:, 2:] > boxes[:, :2]).all(1))
    return boxes, rows[best_rows(score[rows])]


class OnnxDetector:
    """Detect objects with an ONNX model of one of the `onnx_layouts`.

        detector = OnnxDetector("fast")
        detections = detector(image)  # BGR; boxes in its pixels

    Args:
        path_or_name: file or name of a model ("": `config.model`).
        threads: of onnxruntime (0: all cores). offline: never download.
        device: cpu, cuda, coreml, ... (`onnx_session`).
    Attributes:
        class_names: names by class id. layout: name of the layout. path: of the file.
        batch: most images that `detect` gives the network at once. messages: which layout was
            recognised; (): it is declared.
    Raises:
        ReobjError: no such file; outputs of no layout, or of several; or names of the classes that
            are not as many as the layout has.
    """

    def __init__(
        self,
        path_or_name: str | Path = "",
        config: DetectConfig | None = None,
        threads: int = 0,
        offline: bool = False,
        device: str = "cpu",
    ) -> None:
        self.config = config or DetectConfig()
        name = path_or_name or self.config.model
        weights = known_weights(name)
        self.path = model_path(name, offline)
        self._session = onnx_session(self.path, threads, device)
        self._inputs = {i.name: list(i.shape) for i in self._session.get_inputs()}
        kind = self._session.get_inputs()[0].type
        self._image_input, shape = next(iter(self._inputs.items()))
        if kind != "tensor(float)" or len(shape) not in (3, 4) or shape[-3] != 3:
            raise ReobjError(f"{self.path}: no known object detector: input is {kind} {shape}, "
                             "expected an image (1, 3, H, W)")  # fmt: skip
        axis = shape[0] if len(shape) == 4 else 1
        self._fixed = axis if isinstance(axis, int) else 0  # images of every run; 0: any number
        self.batch = self._fixed or frames_at_once(self.config.batch, device)
        self._model = self._trial_run()
        declared = self.config.layout or (weights.layout if weights else "")
        self._layout, self.class_names = self._recognise(declared)
        self.layout = self._layout.name
        unread = f"; not read: {self._layout.unread}" if self._layout.unread else ""
        text = f"{NOTE_START}{self.path}: read as {self.layout} ({self._layout.title}){unread}"
        self.messages = () if declared else (text,)
        wanted = self.config.classes
        self._allowed = class_filter(wanted, self.class_names) if wanted else None

    def __call__(self, image: Image) -> Detections:
        """Detect the objects in one BGR image (H, W, 3); best first, boxes clipped to the image."""
        return next(self.detect([image]))

    def detect(self, images: Sequence[Image]) -> Iterator[Detections]:
        """Detect the objects in each of several images, as one call for each would."""
        fit = self._layout.fit
        fitted = [fit_image(image, self._input_size(*image.shape[1::-1]), fit)
                  for image in map(as_frame, images)]  # fmt: skip
        # Images of the same input size are given to the network together
        for _, group in itertools.groupby(fitted, lambda one: one[1].input_size):
            for batch in in_batches(group, self.batch):
                with failing(str(self.path), len(batch)):
                    each = self._run(batch, self._layout.pixels)
                for outputs, (_, geometry) in zip(each, batch, strict=True):
                    yield self._decoded(outputs, geometry)

    def _decoded(self, outputs: list[Any], geometry: Geometry) -> Detections:
        """Decode and select the detections of one image."""
        assert self._layout.read is not None
        decoded = self._layout.read(outputs, geometry, self._model)
        label = decoded.class_id
        use = label >= 0 if self._allowed is None else np.isin(label, self._allowed)
        size = geometry.image_size
        boxes, keep = best_boxes(decoded.xyxy, decoded.score, use, size, self.config)
        if self._layout.nms_iou is not None:
            keep = keep[nms(boxes[keep], label[keep], self._layout.nms_iou)]
        keep = keep[: self.config.max_detections or 100]  # of a frame (COCO's maxDets)
        check_names(label[keep], self.class_names, f"{self.path}: ")
        masks = decoded.masks(keep) if decoded.masks is not None else None
        return Detections(boxes[keep], decoded.score[keep], label[keep], masks)

    def _input_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the input (w, h) for an image: the model's, or, if dynamic, the image's shape."""
        fixed = self._inputs[self._image_input][:-3:-1]
        stride = 32  # px, largest cells of YOLO: sides are multiples of it
        ratio = 640 / max(width, height) / stride  # px of the longer side (YOLO11's training size)
        scaled = [max(math.ceil(round(v * ratio, 3)), 1) * stride for v in (width, height)]
        w, h = (a if isinstance(a, int) else b for a, b in zip(fixed, scaled, strict=True))
        return w, h

    def _run(self, fitted: list[tuple[Image, Geometry]], pixels: Pixels) -> list[list[Any]]:
        """Run the model on fitted BGR images; return the outputs of each, with a batch axis of 1.

        A fixed batch is filled up with the last image.
        """
        count = len(fitted)
        fitted = fitted + fitted[-1:] * (self._fixed - count)
        mean, std = np.array([pixels.mean, pixels.std], np.float32)
        canvases = np.stack([canvas for canvas, _ in fitted])
        blob = (canvases[..., ::-1] if pixels.rgb else canvases).astype(np.float32)
        blob = np.ascontiguousarray(((blob - mean) / std).transpose(0, 3, 1, 2))  # (B, 3, H, W)
        sizes = np.array([geometry.image_size for _, geometry in fitted])
        image = blob if len(self._inputs[self._image_input]) == 4 else blob[0]
        feeds = dict.fromkeys(self._inputs, sizes) | {self._image_input: image}
        outputs = [np.asarray(output) for output in self._session.run(None, feeds)]
        if len(fitted) == 1:
            return [outputs]  # some have no batch axis
        if any(output.shape[:1] != (len(fitted),) for output in outputs):
            raise RuntimeError("its outputs have no batch axis")
        return [[output[i : i + 1] for output in outputs] for i in range(count)]

    def _trial_run(self) -> ModelProbe:
        """Run the model on a square grey image to get the shapes of its outputs."""
        size = self._input_size(1, 1)
        grey = np.full((size[1], size[0], 3), 114, np.uint8)
        with failing(f"{self.path}: no known object detector: a trial run", 1):
            (outputs,) = self._run([fit_image(grey, size, "stretch")], UNIT_RGB)
        names = (output.name for output in self._session.get_outputs())
        metadata = self._session.get_modelmeta().custom_metadata_map
        of_name = dict(zip(names, outputs, strict=True))
        return ModelProbe(self.path, self._inputs, of_name, size, metadata)

    def _recognise(self, declared: str) -> tuple[Layout, tuple[str, ...]]:
        """Find the layout, and the names of its classes: by option, metadata, COCO, or numbers.

        declared: by the user, or of known weights.
        """
        model = self._model
        names: tuple[str, ...] = ()
        names_of = self.config.class_names
        if names_of:
            names = load_class_names(names_of)
        elif text := model.metadata.get("names", "").strip():
            names_of = "of its metadata"
            where = f"{self.path}: metadata `names`; {NAMES}"
            names = names_by_number(parse_yaml(text, where), where)
        known = names or COCO_NAMES
        model.count = len(known)
        names_of = names_of or f"of COCO, as the model names none; {NAMES}"
        layout = find_layout(model, declared, names_of)
        count = layout.classes(model)
        if count is None or count == model.count:
            return layout, known
        if names:
            raise ReobjError(f"{self.path}: {len(names)} class names ({names_of}), but layout "
                             f"{layout.name} has {count} classes")  # fmt: skip
        log.warning("%s: %d classes without names: %s", self.path, count, NAMES)
        model.count = count
        return layout, tuple(f"class {i}" for i in range(count))
