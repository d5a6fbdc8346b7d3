"""Weights: the table of known files, their download, and onnxruntime sessions.

Start at `model_path`.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import json
import os
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reobj.files import Progress, atomic, locked
from reobj.types import NOTE, ReobjError, log

# Mean and standard deviation of the pixels of ImageNet, RGB, 0..255 (torchvision: .485, .456, .406
# and .229, .224, .225, times 255), as used to train most published networks
IMAGENET_MEAN = (123.675, 116.28, 103.53)
IMAGENET_STD = (58.395, 57.12, 57.375)


@dataclass(frozen=True, slots=True)
class Weights:
    """File of pre-trained weights.

    Attributes:
        name, file, alias: names of the weights on the command line. role: "detector" or "backbone".
        url: of the download, pinned at a commit; "": bundled in reobj/models.
        digest: of the file, hex: sha256 (64 digits) or git blob id (40 digits). size: bytes; 0:
            unknown.
        note: for the table; AP on 164 images of COCO val2017, ms an image with one thread; what
            was run here before it was listed.
        layout: of a detector, in `onnx_layouts`.
    """

    name: str
    role: str
    file: str
    url: str
    digest: str
    size: int
    licence: str
    note: str = ""
    layout: str = ""
    alias: str = ""

    @property
    def digest_kind(self) -> str:
        """Name the kind of `digest`."""
        return "sha256" if len(self.digest) == 64 else "git blob id"

    def digest_of(self, path: Path) -> str:
        """Hash a file with the algorithm of `digest`."""
        with path.open("rb") as file:
            if self.digest_kind == "sha256":
                return hashlib.file_digest(file, "sha256").hexdigest()
            blob = hashlib.sha1(b"blob %d\0" % path.stat().st_size, usedforsecurity=False)
            return hashlib.file_digest(file, lambda: blob).hexdigest()


def _deimv2(name: str, digest: str, size: int, note: str, alias: str = "") -> Weights:
    """Describe one size of DEIMv2."""
    file = f"deimv2_hgnetv2_{name}_coco.onnx"
    source = "https://github.com/Kazuhito00/DEIMv2-ONNX-Sample/raw/"
    url = f"{source}f88d4382abca74edb26ed4c7f46190ac40da0ea5/model/{file}"
    return Weights(f"deimv2-{name}", "detector", file, url, digest, size, "Apache-2.0", note,
                   "detr", alias)  # fmt: skip


NOT_RUN = "by its authors; not run here; the layout of its family is verified"
WEIGHTS: tuple[Weights, ...] = (
    _deimv2("femto", "c6ad358f750132b891165e034c2ba507abefc5ebe1c1d2732a0acbcacc47e52c", 4116144,
            "default; COCO, AP 33.2, 39 ms; run here on 6 recordings"),
    _deimv2("atto", "b114aa6610ac7c2bd9b3186ffb001afa872430db957407ef2473f7148d00646e", 2248408,
            "`--detector fast`; COCO, AP 25.5, 21 ms; run here on 1 recording", "fast"),
    _deimv2("n", "facaa27741d600e993b80f981b86997adbf7d556", 0,
            f"the largest; COCO, AP 43.0 {NOT_RUN}"),
    _deimv2("pico", "e049f81944cdb9a4e0fd07de741abadcce9de516", 0,
            f"COCO, AP 38.5 {NOT_RUN}"),
    Weights("yolox-nano", "detector", "yolox_nano_416.onnx",
            "https://github.com/Kazuhito00/YOLOX-ONNX-TFLite-Sample/raw/"
            "3d4f1119d0694200671c08069ecb847aa0d8495a/model/yolox_nano.onnx",
            "695e750a5d5754bb5a8d5325643b59282191a7e7a564e435a415fd3c578eab14", 3660092,
            "Apache-2.0", "COCO, AP 28.6, 27 ms; run here on 164 images", "yolox"),
    Weights("picodet-s-416", "detector", "picodet_s_416_coco.onnx",
            "https://github.com/hpc203/picodet-onnxruntime/raw/"
            "dfe4d6cd0a18cd4126ee381e81df8a0b1e6ad97b/coco/picodet_s_416_coco.onnx",
            "cdab77bdde16e4f76bec734c4e5791801d1739e4c7ec1995e0e110e04300d0c2", 4040573,
            "Apache-2.0", "COCO, AP 33.5, 46 ms; run here on 164 images", "picodet"),
    Weights("reobj", "backbone", "reobj.onnx", "",
            "a8abc894869a29b63c244aaeff0a96bd9521fc3146bd2a1f4ac495b2bcfc39a5", 392965,
            "MIT", "ours, bundled: foreground and background, trained with its head"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ModelRow:
    """State of a known file on this machine: "verified", "changed" or "missing"."""

    weights: Weights
    state: str
    path: Path | None


def _model_folders() -> list[Path]:
    """List the folders for downloads: REOBJ_MODELS, if set, then the cache of the user."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    chosen = os.environ.get("REOBJ_MODELS")
    return [*([Path(chosen).expanduser()] if chosen else []), cache / "reobj_track"]


def own_models() -> Path:
    """Return the folder of the bundled weights."""
    return Path(__file__).resolve().parents[1] / "models"


def _find_model(*files: str) -> Path | None:
    """Return the first of the files that exists in a folder of weights."""
    folders = [*_model_folders(), own_models()]
    paths = (folder / file for folder in folders for file in files)
    return next((path for path in paths if path.is_file()), None)


def known_weights(name: str | Path) -> Weights | None:
    """Look up a name in the table; None for other names and for existing files."""
    if Path(name).expanduser().is_file():
        return None
    return next((w for w in WEIGHTS if str(name) in (w.name, w.file, w.alias or w.name)), None)


def list_models() -> list[ModelRow]:
    """List all known weights with their state on this machine; reads and hashes the files."""
    rows = []
    for weights in WEIGHTS:
        path = _find_model(weights.file)
        state = "missing"
        if path is not None:
            state = "verified" if weights.digest_of(path) == weights.digest else "changed"
        rows.append(ModelRow(weights, state, path))
    return rows


def model_path(name_or_path: str | Path, offline: bool = False, role: str = "detector") -> Path:
    """Find a file of weights, or download it.

    Args:
        name_or_path: an existing file, which is not verified; a name of the table, whose file is
            verified or downloaded; or another file in a folder of weights, with or without ".onnx".
        offline: never download. role: detector or backbone, whose names an error lists.
    Raises:
        ReobjError: an unknown name, a changed file, or a failed download.
    """
    path = Path(name_or_path).expanduser()
    name = str(name_or_path)
    if path.is_file():
        return path
    weights = known_weights(name)
    file = _find_model(*([weights.file] if weights else [name, name + ".onnx"]))
    if file is None:
        if weights is not None:
            return _fetch(weights, offline)
        known = ", ".join(w.name for w in WEIGHTS if w.role == role)
        raise ReobjError(f"{role} {name}: no such file, nor one of the known names ({known})")
    if weights is not None and (digest := weights.digest_of(file)) != weights.digest:
        raise ReobjError(
            f"{file}: {weights.digest_kind} is {digest}, expected {weights.digest}: delete the "
            "file to fetch it again, or give its path instead of its name to use it as it is"
        )
    return file


def _fetch(weights: Weights, offline: bool) -> Path:
    """Download weights into the first folder; keep the file if its digest matches."""
    folder = _model_folders()[0]
    target = folder / weights.file
    expected = f"{weights.digest_kind} {weights.digest}"
    by_hand = (f"get a file with {expected} from {weights.url}, put it at {target}, or set "
               "REOBJ_MODELS to its folder")  # fmt: skip
    if offline:
        raise ReobjError(f"model {weights.name} is not in {folder}, and --offline forbids the "
                         f"download: {by_hand}")  # fmt: skip
    size = f"{weights.size / 1e6:.1f} MB" if weights.size else "size unknown"
    with locked(folder / ".lock", wait_s=600.0):  # 100 MB at 1.3 Mbit/s
        if not target.is_file() or weights.digest_of(target) != weights.digest:
            log.log(NOTE, "fetching %s: %s, licence %s, from %s, %s", weights.name, size,
                    weights.licence, weights.url, expected)  # fmt: skip
            try:
                _download(weights, target)
            except (OSError, http.client.HTTPException, ReobjError) as error:
                raise ReobjError(f"model {weights.name}: download failed ({error}): run again, or "
                                 f"{by_hand}") from error  # fmt: skip
    return target


def _download(weights: Weights, target: Path) -> None:
    """Download a file, and keep it if its digest matches."""
    request = urllib.request.Request(weights.url, headers={"User-Agent": "reobj_track"})
    with atomic(target) as part:
        with (
            urllib.request.urlopen(request, timeout=30) as response,  # s
            part.open("wb") as file,
            Progress("fetch kB", weights.size // 1000) as progress,
        ):
            while chunk := response.read(1 << 16):
                file.write(chunk)
                progress.step(file.tell() // 1000 - progress.done)
        if (digest := weights.digest_of(part)) != weights.digest:
            raise ReobjError(f"{weights.digest_kind} is {digest}, not kept: an incomplete download "
                             "or another file")  # fmt: skip


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


def frames_at_once(asked: int, device: str) -> int:
    """Return how many frames a network gets at once; asked: by the user, 0: by device.

    On two CPU cores batches are slower. On an H100 4 images at once took 25 to 62 % of the time of
    single ones, and 16 took 15 to 54 % (benchmarks/RESULTS.md); 8 need half the memory of 16.
    """
    return asked or (8 if device.partition(":")[0] in ("cuda", "tensorrt") else 1)


def onnx_session(path: Path, threads: int = 0, device: str = "cpu") -> Any:
    """Make an onnxruntime session on a device (threads 0: all cores).

    Raises:
        ReobjError: the device is unknown or not supported by this onnxruntime; or no ONNX model.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ReobjError("ONNX models need onnxruntime: pip install onnxruntime") from error
    names = {"DmlExecutionProvider": "directml"}
    providers = {
        names.get(provider, provider.removesuffix("ExecutionProvider").lower()): provider
        for provider in onnxruntime.get_all_providers()
    }
    available = onnxruntime.get_available_providers()
    provider = providers.get(device)
    if provider not in available:
        have = ", ".join(name for name, known in providers.items() if known in available)
        need = f"; {provider} needs another package in place of onnxruntime" * bool(provider)
        raise ReobjError(f"--device {device}: this onnxruntime has {have} only{need}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors only: warnings concern the export of the model
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # no busy waiting
    try:
        order = list(dict.fromkeys([provider, providers["cpu"]]))  # CPU for missing operators
        session = onnxruntime.InferenceSession(str(path), options, providers=order)
    except Exception as error:
        reason = str(error).partition("\n")[0]
        raise ReobjError(f"{path}: onnxruntime cannot load it: {reason}") from error
    if session.get_providers()[0] != provider:  # onnxruntime falls back, with a line on stderr
        raise ReobjError(f"--device {device}: {provider} did not start: its driver or libraries "
                         "are missing, or of another version")  # fmt: skip
    return session


def onnx_metadata(session: Any) -> dict[str, Any]:
    """Read the metadata of `benchmarks/train_embedding.py` in a model file; {} for other models."""
    return dict(json.loads(session.get_modelmeta().custom_metadata_map.get("reobj", "{}")))
