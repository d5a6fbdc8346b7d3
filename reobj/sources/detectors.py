"""Detectors: ONNX models, a cache, and one interface to all sources of detections.

Start at `open_detections` (from a configuration) or `as_source` (from a detector): both return a
`DetectionSource`, which maps frames to detections. Output layouts of ONNX models: `onnx_layouts`;
files of detections: `detection_files`.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Poses
from reobj.files import did_you_mean, save_npz
from reobj.sources.class_names import (
    Vocabulary,
    load_class_names,
    names_by_number,
    parse_class_names,
)
from reobj.sources.detection_files import (
    DetectConfig,
    class_filter,
    read_detections,
    unnamed_class,
)
from reobj.sources.libraries import (
    LibraryDetector,
    failing,
    fixed_classes,
    is_function,
    library_detector,
    library_of,
    user_function,
)
from reobj.sources.onnx_layouts import (
    UNIT_RGB,
    Geometry,
    Layout,
    ModelProbe,
    Pixels,
    best_rows,
    find_layout,
    fit_image,
    nms,
)
from reobj.sources.recorded import RecordedDetections, pack_detections, read_npz
from reobj.sources.video import Video, in_batches, source_fingerprint
from reobj.sources.weights import (
    WEIGHTS,
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
    Frame,
    Image,
    IntArray,
    ReobjError,
    as_detections,
    as_frame,
    log,
    text_labels,
    visible_name,
)
from reobj.words import among


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
        if self._fixed and self.config.batch not in (0, self._fixed):
            log.warning("%s: takes %d images at once, not detect.batch=%d", self.path, self._fixed,
                        self.config.batch)  # fmt: skip
        self._model = self._trial_run()
        self._layout, self.class_names = self._recognise(weights.layout if weights else "")
        self.layout = self._layout.name
        wanted = self.config.classes
        self._allowed = class_filter(wanted, self.class_names) if wanted else None

    def __call__(self, image: Image) -> Detections:
        """Detect the objects in one BGR image (H, W, 3); best first, boxes clipped to the image."""
        return next(self.detect([image]))

    def detect(self, images: Sequence[Image]) -> Iterator[Detections]:
        """Detect the objects in each of several images, as one call for each would."""
        images = [as_frame(image) for image in images]
        # Images of the same input size are given to the network together
        for size, group in itertools.groupby(images, lambda a: self._input_size(*a.shape[1::-1])):
            for batch in in_batches(group, self.batch):
                fitted = [fit_image(image, size, self._layout.fit) for image in batch]
                with failing(str(self.path), len(batch)):
                    each = self._run(fitted, self._layout.pixels)
                for outputs, (_, geometry) in zip(each, fitted, strict=True):
                    yield self._decoded(outputs, geometry)

    def _decoded(self, outputs: list[Any], geometry: Geometry) -> Detections:
        """Decode and select the detections of one image."""
        assert self._layout.read is not None
        decoded = self._layout.read(outputs, geometry, self._model)
        label = decoded.class_id
        use = label >= 0 if self._allowed is None else np.isin(label, self._allowed)
        size = geometry.image_size
        boxes, keep = _best(decoded.xyxy, decoded.score, use, size, self.config)
        if self._layout.nms_iou is not None:
            keep = keep[nms(boxes[keep], label[keep], self._layout.nms_iou)]
        keep = keep[: self.config.max_detections or 100]  # of a frame (COCO's maxDets)
        _check_names(label[keep], self.class_names, f"{self.path}: ")
        masks = decoded.masks(keep) if decoded.masks is not None else None
        return Detections(boxes[keep], decoded.score[keep], label[keep], masks)

    def _input_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the input (w, h) for an image: the model's, or, if dynamic, the image's shape."""
        fixed = self._inputs[self._image_input][:-3:-1]
        longer = 640  # px, longer side (YOLO11's training size)
        stride = 32  # px, largest cells of YOLO: sides are multiples of it
        ratio = longer / max(width, height) / stride
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
            (outputs,) = self._run([(grey, Geometry(size, size, (1.0, 1.0), (0, 0)))], UNIT_RGB)
            names = [output.name for output in self._session.get_outputs()]
            metadata = self._session.get_modelmeta().custom_metadata_map
        of_name = dict(zip(names, outputs, strict=True))
        return ModelProbe(self.path, self._inputs, of_name, size, metadata)

    def _recognise(self, declared: str) -> tuple[Layout, tuple[str, ...]]:
        """Find the layout, and the names of its classes: by option, metadata, COCO, or numbers.

        declared: layout of known weights.
        """
        names: tuple[str, ...] = ()
        names_of = f"of COCO, as the model names none; {NAMES}"
        if self.config.class_names:
            names_of = self.config.class_names
            names = load_class_names(names_of)
        elif text := self._model.metadata.get("names", "").strip():
            names_of = "of its metadata"
            names = parse_class_names(text, f"{self.path}: metadata `names`; {NAMES}")
        self._model.count = len(names or COCO_NAMES)
        declared = self.config.layout or declared
        layout = find_layout(self._model, declared, names_of)
        count = layout.classes(self._model)
        if count not in (None, self._model.count):
            if names:
                raise ReobjError(f"{self.path}: {len(names)} class names ({names_of}), but layout "
                                 f"{layout.name} has {count} classes")  # fmt: skip
            log.warning("%s: %d classes without names: %s", self.path, count, NAMES)
            names = tuple(f"class {i}" for i in range(count or 0))
        names = names or COCO_NAMES
        self._model.count = len(names)
        unread = f"; not read: {layout.unread}" if layout.unread else ""
        text = f"{NOTE_START}{self.path}: read as {layout.name} ({layout.title}){unread}"
        self.messages = () if declared else (text,)
        return layout, names


NAMES = "give a file of names with --set detect.class_names=FILE"


def _check_names(class_id: IntArray, names: Sequence[str], where: str = "") -> None:
    """Refuse class ids (D,) without a name."""
    if len(class_id) and class_id.max() >= len(names):
        raise ReobjError(where + unnamed_class(int(class_id.max()), len(names)))


def _best(
    xyxy: Array, score: Array, use: BoolArray, size: Sequence[int], config: DetectConfig
) -> tuple[Array, IntArray]:
    """Clip boxes to the image of (w, h); select rows, among those to `use`, by score and area.

    Returns:
        the boxes (N, 4) of all rows, and the selected rows, best first.
    """
    boxes = np.clip(xyxy, 0, np.tile(size, 2))
    rows = np.flatnonzero(use & (score >= config.min_score) & (boxes[:, 2:] > boxes[:, :2]).all(1))
    return boxes, rows[best_rows(score[rows])]


class DetectionCache:
    """Cache of the detections of a video on disk, from which a killed run resumes.

    A folder of npz files, written atomically: a kill loses the frames since the last `flush`.
    Damaged files are removed with a warning.

    Args:
        folder: for the cache alone. image_size: (w, h) of the frames and of their masks.
        file_frames: frames of a file; a kill loses a few seconds of work at most. mask_frames: of
            one with masks, which fill the memory.
    """

    def __init__(
        self,
        folder: str | Path,
        image_size: tuple[int, int],
        file_frames: int = 64,
        mask_frames: int = 8,
    ) -> None:
        self.folder = Path(folder)
        self.image_size = image_size
        self._frames = (file_frames, mask_frames)
        self._stored: dict[int, RecordedDetections | None] = {}  # by frame; None: skipped
        self._pending: dict[int, Detections] = {}  # by frame, not on disk yet
        chunks = sorted(self.folder.glob("chunk_*.npz"))
        self._next = 1 + max((int(path.stem[6:]) for path in chunks), default=-1)
        for path in chunks:
            try:
                self._load(path)
            except ReobjError as error:
                log.warning("%s; removed, its frames are detected again", error)
                path.unlink(missing_ok=True)

    def _load(self, path: Path) -> None:
        """Add the frames of a file, with packed masks."""
        chunk, done = read_npz(path, self.image_size, self.image_size, sealed=True)
        self._stored |= dict.fromkeys(done.tolist(), chunk)

    def __contains__(self, index: int) -> bool:
        """Test whether `put` was called for a frame."""
        return index in self._stored

    def get(self, index: int) -> Detections | None:
        """Return the detections of a frame; None if the detector was not run on it."""
        chunk = self._stored.get(index)
        return self._pending.get(index) if chunk is None else chunk.at(index)

    def put(self, index: int, detections: Detections | None) -> None:
        """Store the detections of a frame; None: the detector was not run on it."""
        self._stored[index] = None
        if detections is None:
            return
        self._pending[index] = detections
        if len(self._pending) >= self._frames[detections.masks is not None]:
            self._write()

    def _write(self) -> None:
        """Write the pending frames to disk."""
        if not self._pending:
            return
        frames = sorted(self._pending.items())
        path = self.folder / f"chunk_{self._next:06d}.npz"
        done = {"done": np.array([index for index, _ in frames])}
        save_npz(path, pack_detections(frames, [], self.image_size) | done)
        self._next += 1
        self._pending.clear()
        self._load(path)

    def flush(self) -> None:
        """Write the pending frames; a failure is a warning: safe in a `finally`."""
        try:
            self._write()
        except ReobjError as error:
            log.warning("%s: the last frames will be detected again", error)


@dataclass(frozen=True, slots=True)
class DetectionSource:
    """Source of the detections of a video: `source.detect(frames)`.

    Attributes:
        run: several frames -> Detections of each in px of its image; None: the detector was not
            run on it.
        class_names: by class id; a `Vocabulary` grows with the labels of an open-vocabulary
            detector.
        key: cache key of all inputs of the detections besides the video; "": unknown, so results
            derived from them must not be cached either.
        messages: for the user.
        slow: detections are worth caching. cache: of the detections.
        recorded: detections of a file, all available in advance.
        always_looks: zero detections mean an empty frame, and only None a frame on which the
            detector was not run.
        batch: most frames that `run` should be given.
    """

    run: Callable[[Sequence[Frame]], Iterator[Detections | None]]
    class_names: Sequence[str] = COCO_NAMES
    key: str = ""
    messages: Sequence[str] = ()
    slow: bool = False
    cache: DetectionCache | None = None
    recorded: RecordedDetections | None = None
    always_looks: bool = False
    batch: int = 1

    def __post_init__(self) -> None:
        if not isinstance(self.class_names, Vocabulary):
            object.__setattr__(self, "class_names", tuple(map(visible_name, self.class_names)))

    def detect(self, frames: Sequence[Frame]) -> Iterator[Detections | None]:
        """Yield the detections of each frame, cached if possible; None: the detector was not run.

        Frames that are not cached are detected together.
        """
        cache = self.cache
        found = self.run([frame for frame in frames if cache is None or frame.index not in cache])
        for frame in frames:
            if cache is not None and frame.index in cache:
                yield cache.get(frame.index)
                continue
            try:
                detections = next(found)
            except ReobjError as error:
                raise ReobjError(f"frame {frame.index}: {error}") from error
            if cache is not None:
                cache.put(frame.index, detections)
            yield detections


def open_detections(
    video: Video,
    config: DetectConfig,
    detections: str | Path | Callable[[Image], Any] | None = None,
    threads: int = 0,
    offline: bool = False,
    device: str = "cpu",
    poses: Poses | None = None,
) -> DetectionSource:
    """Open the source of the detections of a video.

    Args:
        detections: a file for `read_detections`; a function or another argument of `as_source`, for
            which `config` gives only the class names; a detector of `with_detector`; or None: the
            ONNX model of `config`.
        threads: of onnxruntime (0: all cores). offline: never download weights. device: of the
            ONNX model, cpu, cuda, coreml, ... poses: for files of boxes in 3D.
    """
    config, detections = with_detector(config, detections)
    names = load_class_names(config.class_names) if config.class_names else ()
    if detections and isinstance(detections, str | Path):
        recorded = read_detections(detections, video, config, poses)
        key = _cache_key(config, recorded.fingerprint())
        return dataclasses.replace(as_source(recorded), key=key)
    if detections not in (None, ""):
        return as_source(detections, names)
    words = tuple(word.strip() for word in config.words.split(",") if word.strip())
    if library_of(config.model):
        batch = frames_at_once(config.batch, device)
        opened, version = library_detector(config.model, words, config.min_score, device, batch)
        file = config.model.partition(":")[2] or config.model
        key = _cache_key(config, version, file, device)
        return dataclasses.replace(_filtered(as_source(opened), config), key=key, slow=True)
    if words:
        raise fixed_classes(config.model)
    if is_function(config.model):
        function = user_function(config.model)
        is_open = not (names or _stated_names(function))  # its labels are the class names
        return _filtered(as_source(function, names), config, is_open)
    detector = OnnxDetector("", config, threads, offline, device)
    key = _cache_key(config, detector.path, device)
    return dataclasses.replace(as_source(detector), key=key, slow=True)


def _filtered(
    source: DetectionSource, config: DetectConfig, is_open: bool = False
) -> DetectionSource:
    """Clip the detections of a source to the image; select them by score, area, class and number.

    Best first.

    Args:
        is_open: the class names are not known in advance.
    """
    wanted = config.classes
    allowed = class_filter(wanted, source.class_names) if wanted and not is_open else None

    def select(frame: Frame, found: Detections | None) -> Detections | None:
        if found is None:
            return None
        use = np.ones(len(found), bool) if allowed is None else np.isin(found.class_id, allowed)
        if wanted and allowed is None:
            use = among(source.class_names, wanted.split(","))[found.class_id]
        boxes, rows = _best(found.xyxy, found.score, use, frame.image.shape[1::-1], config)
        return dataclasses.replace(found, xyxy=boxes)[rows[: config.max_detections or None]]

    def run(frames: Sequence[Frame]) -> Iterator[Detections | None]:
        return map(select, frames, source.run(frames))

    return dataclasses.replace(source, run=run)


def with_detector(config: DetectConfig, detections: Any) -> tuple[DetectConfig, Any]:
    """Move the name of a detector from the argument `detections` to the option `model`.

    Args:
        detections: a name that `--detector` takes where no file has this name, or the path of a
            .onnx or .pt file; any other argument of `open_detections` is returned unchanged.
    Returns:
        config, detections; None for a detector.
    Raises:
        ReobjError: no such file, and a name similar to that of a detector.
    """
    if not isinstance(detections, str | Path):
        return config, detections
    path = Path(detections)
    named = str(detections)
    names = [name for w in WEIGHTS if w.role == "detector" for name in (w.name, w.alias) if name]
    known = named in names or library_of(named) is not None or is_function(named)
    if path.suffix.lower() in (".onnx", ".pt") or (known and not path.exists()):
        return dataclasses.replace(config, model=named), None
    if not path.exists() and (close := did_you_mean(named, names)):
        raise ReobjError(f"{path}: no such file of detections, and no known detector{close}")
    return config, detections


def _cache_key(config: DetectConfig, *source: str | Path) -> str:
    """Make a cache key from the identity of a source, the options, and the files of both.

    The size of the batches is left out: it does not change the detections.
    """
    files = [Path(text).expanduser() for text in (*source, config.class_names) if text]
    contents = [source_fingerprint(file) for file in files if file.is_file()]
    options = dataclasses.asdict(config)
    del options["batch"]
    return json.dumps([*map(str, source), options, contents])


def as_source(detector: Any, class_names: Sequence[str] = ()) -> DetectionSource:
    """Make a source of detections from any detector.

    Args:
        detector: a DetectionSource, RecordedDetections (by frame number), an OnnxDetector, or a
            function of a BGR image (H, W, 3) uint8 that returns detections as `Tracker.update`
            accepts them, in px of the image; None: it was not run on this image.
        class_names: of a function; default: its attribute `class_names` or `names` (ultralytics),
            else COCO's.
    """
    if isinstance(detector, DetectionSource):
        return detector
    if isinstance(detector, RecordedDetections):
        return _recorded_source(detector)
    known = isinstance(detector, OnnxDetector | LibraryDetector)
    several = type(detector) in (OnnxDetector, LibraryDetector)  # a subclass may change a call
    if not several and not callable(detector):
        raise ReobjError(f"{detector!r:.80} is no detector: expected a function image -> detections"
                         "; a file is opened by read_detections(path, video)")  # fmt: skip
    answer = detector.detect if several else lambda images: map(detector, images)
    stated = tuple(class_names) or _stated_names(detector)
    names = Vocabulary(stated or COCO_NAMES)
    warn = not stated

    def checked(found: Any) -> Detections | None:
        nonlocal warn
        if found is None:
            return None
        labels = None if class_names else text_labels(found)  # else its numbers have names
        kinds = None if labels is None else np.array(names.numbers(labels), np.int64)
        detections = as_detections(found, kinds)
        _check_names(detections.class_id, names)
        if warn and isinstance(found, Mapping) and kinds is None and len(detections):
            log.warning(
                "the detector has no class names: its numbers are read as COCO's 80 classes, from "
                "0; torchvision and DETR count 91 from 1: give the names (detect.class_names, or "
                "an attribute `names` of the function)"
            )
            warn = False  # one warning is enough
        return detections

    return DetectionSource(
        lambda frames: map(checked, answer([frame.image for frame in frames])), names,
        messages=detector.messages if known else (), always_looks=known,
        batch=detector.batch if several else 1,
    )  # fmt: skip


def _recorded_source(recorded: RecordedDetections) -> DetectionSource:
    """Make a source from the detections of a file; None for frames without detector output."""
    looked = None if recorded.looked is None else set(recorded.looked.tolist())

    def run(frames: Sequence[Frame]) -> Iterator[Detections | None]:
        for frame in frames:
            ran = looked is None or frame.index in looked
            yield recorded.at(frame.index) if ran else None

    return DetectionSource(
        run, recorded.class_names, "", recorded.messages, recorded=recorded, always_looks=True
    )


def _stated_names(detector: Any) -> tuple[str, ...]:
    """Return the class names in a detector's attributes, a list or a dict by id; () if none."""
    names = getattr(detector, "class_names", None) or getattr(detector, "names", None)
    if names and isinstance(names, Mapping | list | tuple):
        return names_by_number(names)
    return ()
