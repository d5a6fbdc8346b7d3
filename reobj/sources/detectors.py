"""Detectors: one interface to all sources of detections, a cache, and other libraries' detectors.

Start at `open_detections` (from a configuration) or `as_source` (from a detector): both return a
`DetectionSource`, which maps frames to detections. ONNX models: `onnx_layouts`; files of
detections: `detection_files`. The libraries are no requirement of this package: each adapter
imports its own.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Poses
from reobj.files import did_you_mean, load_cached, save_npz
from reobj.sources.class_names import Vocabulary, names_by_number
from reobj.sources.detection_files import DetectConfig, class_filter, class_names, read_detections
from reobj.sources.onnx_layouts import OnnxDetector, best_boxes, check_names
from reobj.sources.recorded import RecordedDetections, pack_detections, read_npz
from reobj.sources.video import Video, source_fingerprint
from reobj.sources.weights import WEIGHTS, failing, frames_at_once
from reobj.types import (
    COCO_NAMES,
    Detections,
    Frame,
    Image,
    ReobjError,
    as_detections,
    log,
    text_labels,
    visible_name,
)
from reobj.words import among


class DetectionCache:
    """Cache of the detections of a video on disk, from which a killed run resumes.

    A folder of npz files, written atomically: a kill loses the frames since the last `flush`.
    Damaged files are removed with a warning.

    Args:
        folder: for the cache alone. image_size: (w, h) of the frames and of their masks.
    """

    def __init__(self, folder: str | Path, image_size: tuple[int, int]) -> None:
        self.folder = Path(folder)
        self.image_size = image_size
        self._stored: dict[int, RecordedDetections | None] = {}  # by frame; None: skipped
        self._pending: dict[int, Detections] = {}  # by frame, not on disk yet
        chunks = sorted(self.folder.glob("chunk_*.npz"))
        self._next = 1 + max((int(path.stem[6:]) for path in chunks), default=-1)
        for path in chunks:
            self._load(path)

    def _load(self, path: Path) -> None:
        """Add the frames of a file, with packed masks; a damaged one is removed."""
        size = self.image_size
        chunk = load_cached(path, lambda path: read_npz(path, size, size, sealed=True))
        if chunk is not None and chunk.detector_ran is not None:
            self._stored |= dict.fromkeys(chunk.detector_ran.tolist(), chunk)

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
        # Of a file; a kill loses a few seconds of work at most, and masks fill the memory
        if len(self._pending) >= (64 if detections.masks is None else 8):
            self._write()

    def _write(self) -> None:
        """Write the pending frames to disk."""
        if not self._pending:
            return
        path = self.folder / f"chunk_{self._next:06d}.npz"
        save_npz(path, pack_detections(sorted(self._pending.items()), [], self.image_size))
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
    names = class_names(config)
    if detections and isinstance(detections, str | Path):
        recorded = read_detections(detections, video, config, poses)
        key = _cache_key(config, recorded.fingerprint())
        return dataclasses.replace(as_source(recorded), key=key)
    if detections not in (None, ""):
        return as_source(detections, names)
    words = [word.strip() for word in config.words.split(",") if word.strip()]
    if library := library_of(config.model):
        return _library_source(*library, words, config, device)
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
    if wanted and not is_open:
        class_filter(wanted, source.class_names)  # refuses unknown ones

    def select(frame: Frame, found: Detections | None) -> Detections | None:
        if found is None:
            return None
        named = among(source.class_names, wanted.split(",")) if wanted else None
        use = np.ones(len(found), bool) if named is None else named[found.class_id]
        boxes, rows = best_boxes(found.xyxy, found.score, use, frame.image.shape[1::-1], config)
        return dataclasses.replace(found, xyxy=boxes)[rows[: config.max_detections or None]]

    return dataclasses.replace(source, run=lambda frames: map(select, frames, source.run(frames)))


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
        detector_ran = (
            None if detector.detector_ran is None else set(detector.detector_ran.tolist())
        )

        def run(frames: Sequence[Frame]) -> Iterator[Detections | None]:
            for frame in frames:
                ran = detector_ran is None or frame.index in detector_ran
                yield detector.at(frame.index) if ran else None

        return DetectionSource(
            run, detector.class_names, "", detector.messages, recorded=detector, always_looks=True
        )
    several = isinstance(detector, OnnxDetector)
    if not callable(detector):
        raise ReobjError(f"{detector!r:.80} is no detector: expected a function image -> detections"
                         "; a file is opened by read_detections(path, video)")  # fmt: skip
    source = _source_of(
        detector.detect if several else lambda images: map(detector, images),
        tuple(class_names) or _stated_names(detector),
        has_numbers=bool(class_names),
    )
    if not several:
        return source
    return dataclasses.replace(
        source, messages=detector.messages, always_looks=True, batch=detector.batch
    )


def _source_of(
    answer: Callable[[list[Image]], Iterable[Any]], stated: Sequence[str], has_numbers: bool
) -> DetectionSource:
    """Make a source from a function of BGR images that returns detections of each.

    Args:
        stated: class names by number, (): COCO's. has_numbers: they name the numbers, so that text
            labels are not read.
    """
    names = Vocabulary(map(visible_name, stated or COCO_NAMES))
    warn = not stated

    def checked(found: Any) -> Detections | None:
        nonlocal warn
        if found is None:
            return None
        labels = None if has_numbers else text_labels(found)
        kinds = None if labels is None else np.array(names.numbers(labels), np.int64)
        detections = as_detections(found, kinds)
        check_names(detections.class_id, names)
        if warn and isinstance(found, Mapping) and kinds is None and len(detections):
            log.warning(
                "the detector has no class names: its numbers are read as COCO's 80 classes, from "
                "0; torchvision and DETR count 91 from 1: give the names (detect.class_names, or "
                "an attribute `names` of the function)"
            )
            warn = False  # one warning is enough
        return detections

    return DetectionSource(
        lambda frames: map(checked, answer([frame.image for frame in frames])), names
    )


def _stated_names(detector: Any) -> tuple[str, ...]:
    """Return the class names in a detector's attributes, a list or a dict by id; () if none."""
    names = getattr(detector, "class_names", None) or getattr(detector, "names", None)
    if names and isinstance(names, Mapping | list | tuple):
        return names_by_number(names)
    return ()


# ---- Other libraries ----------------------------------------------------------------------------


Opened = tuple[Callable[[list[Image]], Iterable[Any]], Sequence[str]]


@dataclass(frozen=True, slots=True)
class Library:
    """A library whose detectors can be used.

    Attributes:
        open: makes a detector of a model (name or file, as the library expects it), words that it
            looks for ((): its classes), least score, and device of PyTorch: a function of images
            (H, W, 3) uint8 that returns detections of each as `reobj.types.as_detections` accepts
            them, and class names by number.
        install: what pip installs.
        takes_words: an example of a model that finds free text; "": none.
        is_rgb: images are RGB; else BGR.
    """

    open: Callable[[str, list[str], float, str], Opened]
    install: str
    takes_words: str = ""
    is_rgb: bool = True


def _ultralytics(name: str, words: list[str], min_score: float, device: str) -> Opened:
    from ultralytics import YOLO

    model = YOLO(name)
    if words:
        if not hasattr(model.model, "set_classes"):
            raise fixed_classes(f"ultralytics:{name}")
        model.set_classes(words)

    def run(images: list[Image]) -> Any:
        return model.predict(
            images, conf=min_score, device=device, retina_masks=True, verbose=False
        )

    return run, names_by_number(model.names)


def _rfdetr(name: str, _: list[str], min_score: float, device: str) -> Opened:
    import rfdetr

    name, given, weights = name.partition("=")
    classes = {key[6:].lower(): key for key in dir(rfdetr) if key[:6] == "RFDETR" and key[6:]}
    wanted = name.lower().replace("-", "")
    if wanted not in classes:
        raise _unknown(f"rfdetr:{name}", classes)
    options = {"pretrain_weights": weights or None} if given else {}
    model = getattr(rfdetr, classes[wanted])(device=device, **options)

    def run(images: list[Image]) -> Iterator[Any]:
        answer = model.predict(images, threshold=min_score)
        for found in answer if isinstance(answer, list) else [answer]:  # of one image: no list
            yield found[np.array([bool(name) for name in found.data["class_name"]], bool)]

    return run, tuple(map(str, model.class_names))


def _torchvision(name: str, _: list[str], min_score: float, device: str) -> Opened:
    import torch
    from torchvision.models import detection, get_model, get_model_weights, list_models

    name, given, weights = name.partition("=")
    known = list_models(detection)
    if name not in known:
        raise _unknown(f"torchvision:{name}", known)
    trained = get_model_weights(name).DEFAULT
    if given:
        model = get_model(name, weights=None, weights_backbone=None)
        if weights:
            model.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    else:
        model = get_model(name, weights=trained)
    model = model.to(device).eval()

    def run(images: list[Image]) -> Iterator[dict[str, Any]]:
        stack = torch.from_numpy(np.stack(images)).to(device)
        with torch.inference_mode():
            answers = model(list(stack.permute(0, 3, 1, 2).float() / 255))
        for found in answers:
            keep = (found["scores"] >= min_score) & (found["labels"] > 0)  # 0: background
            yield {key: value[keep].cpu() for key, value in found.items()}

    return run, tuple(trained.meta["categories"])


def _transformers(name: str, words: list[str], min_score: float, device: str) -> Opened:
    import torch
    import transformers

    kind = "ZeroShotObjectDetection" if words else "ObjectDetection"
    try:
        model = getattr(transformers, f"AutoModelFor{kind}").from_pretrained(name)
        loader = transformers.AutoProcessor if words else transformers.AutoImageProcessor
        processor = loader.from_pretrained(name)
    except (OSError, ValueError) as error:
        advice = "" if words else "; a detector of free text needs --words"
        raise ReobjError(f"hf:{name}: {str(error).splitlines()[0]}{advice}") from error
    model = model.to(device).eval()

    def run(images: list[Image]) -> Any:
        count = len(images)
        text = {"text": [words] * count, "padding": True, "truncation": True} if words else {}
        inputs = processor(images=images, return_tensors="pt", **text).to(device)
        with torch.inference_mode():
            outputs = model(**inputs)
        asked: dict[str, Any] = {"threshold": min_score}
        asked["target_sizes"] = [image.shape[:2] for image in images]
        if not words:
            return processor.post_process_object_detection(outputs, **asked)
        if "input_ids" in inputs and type(processor).__name__.startswith("GroundingDino"):
            asked |= {"input_ids": inputs["input_ids"], "text_threshold": min_score}
        else:
            asked["text_labels"] = [words] * count
        answers = processor.post_process_grounded_object_detection(outputs, **asked)
        return (_with_words(found, words) for found in answers)

    return run, tuple(words) or names_by_number(model.config.id2label)


def _with_words(image: Any, words: list[str]) -> dict[str, Any]:
    """Number detections of one image by the word that shares most tokens with their phrase.

    Grounding DINO returns phrases, which may lack tokens of a word or join several words.
    """
    phrases = [set(str(text).lower().split()) for text in image["text_labels"]]
    tokens = [set(word.lower().split()) for word in words]
    shared = np.array([[len(p & t) / len(t) for t in tokens] for p in phrases])
    shared = shared.reshape(len(phrases), len(words))
    rows = np.flatnonzero(shared.max(1, initial=0) > 0)
    kept = {key: image[key][rows] for key in ("boxes", "scores")}
    return kept | {"labels": shared[rows].argmax(1)}


LIBRARIES = {
    "ultralytics": Library(_ultralytics, "ultralytics", "yolov8s-worldv2.pt", is_rgb=False),
    "rfdetr": Library(_rfdetr, "rfdetr"),
    "torchvision": Library(_torchvision, "torchvision"),
    "hf": Library(_transformers, "transformers torchvision", "IDEA-Research/grounding-dino-tiny"),
}


def library_of(detector: str) -> tuple[str, str] | None:
    """Split `library:model` or `FILE.pt`; None: another kind of detector."""
    name, _, model = detector.partition(":")
    if name in LIBRARIES and model:
        return name, model
    return ("ultralytics", detector) if Path(detector).suffix == ".pt" else None


def _library_source(
    name: str, model: str, words: list[str], config: DetectConfig, device: str
) -> DetectionSource:
    """Open a detector of another library.

    Args:
        name: of the library. words: to look for; []: the model's classes. device: of PyTorch.
    Raises:
        ReobjError: the library is not installed, has no such model, or does not take words.
    """
    library = LIBRARIES[name]
    detector = config.model
    if words and not library.takes_words:
        raise fixed_classes(detector)
    with failing(f"--detector {detector}"):
        try:
            run, names = library.open(model, words, config.min_score, device)
        except ImportError as error:
            raise ReobjError(f"--detector {detector}: {error}; it needs: pip install "
                             f"{library.install}, or what {name} needs for this model"
                             ) from error  # fmt: skip

    def answer(images: list[Image]) -> Iterator[Any]:
        with failing(f"--detector {detector}", len(images)):
            yield from run([a[..., ::-1].copy() for a in images] if library.is_rgb else images)

    package = library.install.partition(" ")[0]
    version = f"{package} {importlib.metadata.version(package)}"
    source = dataclasses.replace(
        _source_of(answer, names, has_numbers=False), slow=True, always_looks=True,
        batch=frames_at_once(config.batch, device), key=_cache_key(config, version, model, device),
    )  # fmt: skip
    return _filtered(source, config)


def is_function(detector: str) -> bool:
    """Return whether a detector is named as `module:function`."""
    module, _, function = detector.partition(":")
    return all(part.isidentifier() for part in [*module.split("."), function])


def user_function(detector: str) -> Any:
    """Import `module:function`, also from the current folder."""
    module, _, function = detector.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        known = ", ".join(LIBRARIES)
        text = f"expected a function of a module in this folder or installed, or one of {known}"
        raise ReobjError(f"--detector {detector}: {error}; {text}") from error
    finally:
        sys.path.pop(0)
    if not callable(found):
        raise ReobjError(f"--detector {detector}: it is no function image -> detections")
    return found


def fixed_classes(detector: str) -> ReobjError:
    """Make the error for words given to a detector with fixed classes."""
    others = [f"{name}:{lib.takes_words}" for name, lib in LIBRARIES.items() if lib.takes_words]
    return ReobjError(
        f"--words: {detector} has fixed classes; detectors that take words: {', '.join(others)}"
    )


def _unknown(detector: str, known: Any) -> ReobjError:
    """Make the error for a name that a library does not have."""
    return ReobjError(f"--detector {detector}: no such model; there are {', '.join(sorted(known))}")
