"""Detectors of other libraries, by their public API: one adapter each.

Start at `library_detector`. The libraries are no requirement of this package: each adapter imports
its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.sources.class_names import names_by_number
from reobj.types import Image, ReobjError


@dataclass(frozen=True, slots=True, eq=False)
class LibraryDetector:
    """Detector of another library.

    Attributes:
        run: RGB images (H, W, 3) uint8 (BGR of ultralytics) -> of each, detections as
            `reobj.types.as_detections` accepts them.
        class_names: by class id. name: on the command line. batch: most images at once.
    """

    run: Callable[[list[Image]], Iterable[Any]]
    class_names: tuple[str, ...]
    is_rgb: bool = True
    name: str = ""
    batch: int = 1
    messages: tuple[str, ...] = ()

    def detect(self, images: list[Image]) -> Iterator[Any]:
        """Detect the objects in each of several images, all at once."""
        with failing(f"--detector {self.name}", len(images)):
            rgb = [image[..., ::-1].copy() for image in images] if self.is_rgb else images
            yield from self.run(rgb)


@contextlib.contextmanager
def failing(name: str, count: int = 0) -> Iterator[None]:
    """Convert any error of a network's library to one line.

    Args:
        count: images that it gets at once; 0: it is being opened.
    """
    try:
        yield
    except ReobjError:
        raise
    except Exception as error:  # no memory on the device, no such file, no download, ...
        at_once = f" on {count} images at once (detect.batch)" if count > 1 else ""
        text = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
        if not text or not isinstance(error, OSError | RuntimeError):
            text = f"{type(error).__name__}: {text}"
        failed = f" failed{at_once}" if count else ""
        raise ReobjError(f"{name}{failed}: {text}") from error


@dataclass(frozen=True, slots=True)
class Library:
    """A library whose detectors can be used.

    Attributes:
        open: makes a detector of a model (name or file, as the library expects it), words that it
            looks for ((): its classes), least score, and device of PyTorch.
        install: what pip installs.
        takes_words: an example of a model that finds free text; "": none.
    """

    open: Callable[[str, list[str], float, str], LibraryDetector]
    install: str
    takes_words: str = ""


def _ultralytics(name: str, words: list[str], min_score: float, device: str) -> LibraryDetector:
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

    return LibraryDetector(run, names_by_number(model.names), is_rgb=False)


def _rfdetr(name: str, _: list[str], min_score: float, device: str) -> LibraryDetector:
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

    return LibraryDetector(run, tuple(map(str, model.class_names)))


def _torchvision(name: str, _: list[str], min_score: float, device: str) -> LibraryDetector:
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

    return LibraryDetector(run, tuple(trained.meta["categories"]))


def _transformers(name: str, words: list[str], min_score: float, device: str) -> LibraryDetector:
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

    return LibraryDetector(run, tuple(words) or names_by_number(model.config.id2label))


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
    "ultralytics": Library(_ultralytics, "ultralytics", "yolov8s-worldv2.pt"),
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


def library_detector(
    detector: str, words: tuple[str, ...], min_score: float, device: str, batch: int
) -> tuple[LibraryDetector, str]:
    """Open a detector of another library.

    Args:
        detector: `library:model`, or a .pt file of ultralytics. words: to look for; (): the
            model's classes. device: of PyTorch. batch: most images at once.
    Returns:
        the detector, and name and version of its library for cache keys.
    Raises:
        ReobjError: the library is not installed, has no such model, or does not take words.
    """
    named = library_of(detector)
    assert named is not None
    name, model = named
    library = LIBRARIES[name]
    if words and not library.takes_words:
        raise fixed_classes(detector)
    with failing(f"--detector {detector}"):
        try:
            found = library.open(model, list(words), min_score, device)
        except ImportError as error:
            remedy = f"it needs: pip install {library.install}"
            missing = (error.name or "").partition(".")[0]
            if missing not in ("", "torch", *library.install.split()):  # of one model, as CLIP
                remedy = f"{name} needs it for this model; its documentation says how to install it"
            raise ReobjError(f"--detector {detector}: {error}; {remedy}") from error
    package = library.install.partition(" ")[0]
    version = f"{package} {importlib.metadata.version(package)}"
    return dataclasses.replace(found, name=detector, batch=batch), version


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
