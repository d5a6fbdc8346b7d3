"""Appearance of detections: foreground and background embeddings from one feature map per frame.

`Embedder` computes them, `LazyEmbeddings` only for requested detections. See
`reobj.appearance.sampling` for the sampling grid, `reobj.appearance.crops` for the paper's two-crop
variant, `reobj.appearance.reid` for matching.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.appearance.sampling import SamplingLayout, occupancy_map, pool_cells, sample_parts
from reobj.sources.video import resized
from reobj.sources.weights import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    model_path,
    onnx_metadata,
    onnx_session,
    own_models,
)
from reobj.types import (
    Array,
    BoolArray,
    Detections,
    Embeddings,
    Floats,
    Image,
    IntArray,
    ReobjError,
    as_numbers,
    cxcywh_from_xyxy,
    option,
    unit_rows,
    widen,
)


@dataclass(frozen=True, slots=True)
class EmbedConfig:
    """Appearance."""

    model: str = option(
        "reobj",
        "appearance model: reobj (bundled), none (motion only), a backbone (name or .onnx file), "
        "or crops[:BACKBONE] (two crops per object, as in re-OBJ)",
        "--embed",
    )
    head: str = option(
        "",
        "trained head (.onnx) of a backbone; empty: the bundled one, if any; none: raw features "
        "of the backbone",
    )


class Embedder:
    """Foreground and background embeddings, pooled from one feature map per frame.

    re-OBJ sends two masked crops of each object through a ResNet; here all objects share one pass
    over the frame. The box and the enlarged box are sampled on grids. Samples on the object (its
    mask, else the ellipse inscribed in its box) form the foreground, samples on no object the
    background; both keep a coarse spatial layout (cells). The head of a trained model turns the
    cells into two short embeddings; `neighbour_embedding` is appended to its background.

    Args:
        model: "reobj" for the bundled weights, or a backbone: a name listed by
            `reobj_track.py models` or an ONNX file with an image input and a spatial output (one of
            `benchmarks/train_embedding.py` names its head and its layout).
        head: trained head (.onnx) of a backbone; "": the bundled one; "none": no head.
        layout: sampling of the map of an untrained backbone.
        threads: of onnxruntime; 0: all cores.
        offline: never download weights.
        device: cpu, cuda, coreml, ... that onnxruntime has.
    Raises:
        ReobjError: the model is not found, or has no spatial output.

    Attributes:
        layout: sampling of the map; that of the model if it was trained.
        backbone: the network, `Backbone`.
        key: names model and head, as in a map of a room.
    """

    def __init__(
        self,
        model: str = "reobj",
        head: str = "",
        layout: SamplingLayout | None = None,
        threads: int = 0,
        offline: bool = False,
        device: str = "cpu",
    ) -> None:
        self.model = model
        self.key = f"{model} {head}"
        self.backbone = Backbone(model, head, layout or SamplingLayout(), threads, offline, device)
        self.layout = self.backbone.layout
        self._latest: _LatestFrame | None = None

    def __call__(
        self, frame: Image, detections: Detections, rows: IntArray | None = None
    ) -> Embeddings:
        """Embed detections of one frame.

        Args:
            frame: (H, W, 3) BGR.
            detections: all D detections of the frame; those that are not embedded still mask the
                background, and count as neighbours.
            rows: (N,) the detections to embed; default all. In further calls for the same frame and
                detections (identical objects in memory), only new rows are computed.
        Returns:
            Embeddings with unit rows: foreground (N, E1), background (N, E2).
        """
        rows = np.arange(len(detections)) if rows is None else rows
        if not len(rows):
            return Embeddings(np.zeros((0, 0)), np.zeros((0, 0)))
        latest = self._frame(frame, detections)
        weight = self.layout.neighbours * self.trained
        wanted = latest.confident & (weight > 0)
        wanted[rows] = True
        new = np.flatnonzero(wanted & ~latest.known)
        fore, back = self._embed_cells(*self.cells(frame, detections, new, rows))
        latest.foreground = widen(latest.foreground, fore)
        latest.foreground[new] = fore
        latest.known[new] = True
        if weight:
            around = neighbour_embedding(detections.xyxy, latest.foreground, latest.confident, rows)
            back = np.concatenate([math.sqrt(1 - weight) * back, math.sqrt(weight) * around], 1)
        return Embeddings(latest.foreground[rows], unit_rows(back))

    def cells(
        self,
        frame: Image,
        detections: Detections,
        foreground_rows: IntArray,
        background_rows: IntArray | None = None,
    ) -> tuple[Floats, Floats]:
        """Pool the frame's feature map into cells, the input of a head.

        Args:
            foreground_rows: (M,) detections whose foreground is pooled.
            background_rows: (N,) detections whose background is pooled; default the same.
        Returns:
            foreground (M, cells, C + 2) and background (N, cells, C + 2) of `pool_cells`.
        """
        rows = (foreground_rows, foreground_rows if background_rows is None else background_rows)
        latest = self._frame(frame, detections)
        samples = sample_parts(detections, rows, frame.shape[:2], latest.occupied, self.layout)
        return pool_cells(latest.features, samples, self.layout)

    @property
    def trained(self) -> bool:
        """Whether the model has a head."""
        return self.backbone.head is not None

    @property
    def frozen(self) -> bool:
        """Whether the backbone was trained for another task (it lacks our metadata)."""
        return not self.backbone.channels_last

    def _frame(self, frame: Image, detections: Detections) -> _LatestFrame:
        """Return the cached values of a frame; computes the feature map of a new frame."""
        latest = self._latest
        if latest is None or latest.frame is not frame or latest.detections is not detections:
            features = self.backbone(frame)
            latest = self._latest = _LatestFrame(frame, detections, features, self.layout)
        return latest

    def _embed_cells(self, fore: Floats, back: Floats) -> tuple[Array, Array]:
        """Turn cells (M, ...) and (N, ...) into foreground (M, E1) and background (N, E2)."""
        if self.trained:
            return self.backbone.embed(fore, back)
        count = self.layout.background_cells**2  # the other cells belong to the wider box
        boxes = (back[:, :count], back[:, count:])[: 1 + (self.layout.surround_scale > 0)]
        return _hellinger_rows(fore), np.concatenate([_hellinger_rows(b) for b in boxes], 1)


class _LatestFrame:
    """Values that are computed once per frame.

    Attributes:
        features: (h, w, C) feature map. occupied: (h, w) `occupancy_map`.
        confident: (D,) detections that mask the background and count as neighbours.
        known: (D,) detections whose foreground (D, E) is computed.
    """

    def __init__(
        self, frame: Image, detections: Detections, features: Floats, layout: SamplingLayout
    ) -> None:
        self.frame = frame
        self.detections = detections
        self.features = features
        shape = features.shape[:2]
        self.confident = detections.score >= layout.object_score
        self.occupied = occupancy_map(detections, frame.shape, shape, layout.object_score)
        self.known = np.zeros(len(detections), bool)
        self.foreground = np.zeros((len(detections), 0))


def neighbour_embedding(
    xyxy: Array, foreground: npt.NDArray[Any], confident: BoolArray, rows: IntArray
) -> Array:
    """Sum the foreground embeddings of the other objects of a frame, weighted by distance.

    The weight is exp(-distance of the centres / size of the object). Seen from behind, an object
    has another background but the same neighbours.

    Args:
        xyxy: (D, 4). foreground: (D, E) embeddings of all detections.
        confident: (D,) detections that count as neighbours.
        rows: (N,) detections whose neighbours are summed.
    Returns:
        (N, E) unit rows; 0 for a detection without neighbours.
    """
    others, (x, y, w, h) = np.flatnonzero(confident), cxcywh_from_xyxy(xyxy).T  # (O,), (D,) each
    centre = x + 1j * y
    size = np.sqrt(np.maximum(w, 1) * np.maximum(h, 1))
    distance = np.abs(centre[rows, None] - centre[others])  # (N, O)
    weight = np.exp(-distance / size[rows, None]) * (rows[:, None] != others)
    return unit_rows(weight @ foreground[others])


def _hellinger_rows(cells: Floats) -> Array:
    """Concatenate cells (N, K, C + 2) of `pool_cells` into unit rows (N, K * C).

    The signed square root makes a cosine of histograms a Hellinger kernel and damps strong
    channels; cells with few valid samples weigh less.
    """
    mean = cells[..., :-2]
    fraction = cells[..., -2]
    weight = np.sqrt(fraction / np.maximum(fraction.max(1, keepdims=True), 1e-9))
    rows = np.sign(mean) * np.sqrt(np.abs(mean)) * weight[..., None]
    return unit_rows(_joined_cells(rows))


def _joined_cells(cells: Floats) -> Floats:
    """Reshape cells (N, K, C) to rows (N, K * C), also where N is 0."""
    return cells.reshape(len(cells), cells.shape[1] * cells.shape[2])


# ---- Networks ----------------------------------------------------------------------------------


class Backbone:
    """Feature maps from an ONNX network with an image input and a spatial output.

    The metadata ("reobj", JSON) of files of `benchmarks/train_embedding.py` contain the size of the
    frame, the sampling layout and the file of the head. These networks take BGR bytes and return
    channels last. Any other network takes RGB normalised as for ImageNet, channels first; a head
    that was trained for it has the same metadata.

    Attributes:
        layout: sampling of its maps. head: session of the trained head, or None.
        input, output: names of the tensors that are used.
        channels_last: of the network's output; such networks take BGR bytes.
    """

    def __init__(
        self,
        model: str,
        head: str,
        layout: SamplingLayout,
        threads: int,
        offline: bool,
        device: str = "cpu",
    ) -> None:
        path = model_path(model, offline, "backbone")
        self.session = onnx_session(path, threads, device)
        spatial = [o.name for o in self.session.get_outputs() if len(o.shape) == 4]
        if not spatial or len(self.session.get_inputs()[0].shape) != 4:
            raise ReobjError(
                f"{model}: expected a backbone with one image input and a spatial output "
                f"(N, C, h, w), found outputs {[o.name for o in self.session.get_outputs()]}; "
                "give another --embed model"
            )
        self.input = self.session.get_inputs()[0].name
        self.output = spatial[0]
        metadata = onnx_metadata(self.session)
        self.channels_last = bool(metadata)
        self.multiple = int(metadata.get("multiple", 32))  # sides of the input, pixels
        file = path.parent / metadata["head"] if metadata else trained_head(model, head)
        self.head: Any = onnx_session(file, threads, device) if file else None
        self.layout = layout
        if self.head is not None:
            self.layout = layout.updated(metadata or onnx_metadata(self.head))

    def __call__(self, frame: Image) -> Floats:
        """Compute the feature map (h, w, C) of a frame (H, W, 3) BGR."""
        shrink = min(1.0, self.layout.size_px / max(frame.shape[:2]))
        side = self.multiple
        size = [max(side, round(n * shrink / side) * side) for n in frame.shape[1::-1]]
        return np.asarray(self.maps(resized(frame, size)[None])[0])

    def maps(self, images: Image) -> Floats:
        """Compute the feature maps (N, h, w, C) of BGR images (N, H, W, 3) of a valid size."""
        if self.channels_last:
            return self._run(images)
        rgb = (images[..., ::-1].astype(np.float32) - IMAGENET_MEAN) / IMAGENET_STD
        maps = self._run(np.ascontiguousarray(rgb.transpose(0, 3, 1, 2), np.float32))
        return np.ascontiguousarray(maps.transpose(0, 2, 3, 1))

    def use_output_at_stride(self, stride: int, size_px: int) -> None:
        """Select the first output with this stride for square images of size_px, if any."""
        if self.channels_last:
            return
        names = [o.name for o in self.session.get_outputs()]
        blank = np.zeros((1, 3, size_px, size_px), np.float32)
        maps = self.session.run(names, {self.input: blank})
        side = size_px // stride
        fit = [n for n, m in zip(names, maps, strict=True) if m.shape[2:] == (side, side)]
        self.output = fit[0] if fit else self.output

    def embed(self, fore: Floats, back: Floats) -> tuple[Array, Array]:
        """Turn cells of foregrounds (M, ...) and backgrounds (N, ...) into unit rows by the head.

        Returns:
            foreground (M, E1) and background (N, E2).
        """
        fed = {"fg": _joined_cells(fore), "bg": _joined_cells(back)}
        foreground, background = self.head.run(None, fed)
        return np.asarray(foreground, np.float64), np.asarray(background, np.float64)

    def _run(self, images: npt.NDArray[Any]) -> Floats:
        return np.asarray(self.session.run([self.output], {self.input: images})[0], np.float32)


def trained_head(model: str, head: str = "") -> Path | None:
    """Find the head of a frozen backbone; of "crops:BACKBONE" its ConvBlock.

    Args:
        head: its file, "none", or "" for BACKBONE_head.onnx (crops_BACKBONE_head.onnx) beside the
            backbone's file, else among the bundled weights.
    Returns:
        None: no head, the raw features of the backbone are used.
    Raises:
        ReobjError: `head` is neither a file nor "none".
    """
    if head:
        return None if head == "none" else model_path(head, True, "head")
    kind, _, backbone = model.rpartition(":")
    path = Path(backbone)
    folder = path.parent if path.suffix == ".onnx" else own_models()
    path = folder / f"{kind + '_' if kind else ''}{path.stem}_head.onnx"
    return path if path.is_file() else None


# ---- Embeddings on request ---------------------------------------------------------------------


def as_embeddings(
    embeddings: Embeddings | npt.ArrayLike | None, count: int, width: int = 0
) -> Embeddings | None:
    """Validate embeddings; a (D, E) array is a foreground without background; None stays None.

    Args:
        width: E of foreground and background together in earlier frames; 0: there were none.
    Raises:
        ReobjError: they are not `count` finite rows of this width.
    """
    if embeddings is None:
        return None
    if not isinstance(embeddings, Embeddings):
        array = as_numbers(embeddings, "embeddings")
        array = array.reshape(0, 0) if array.ndim == 1 and not array.size else array
        embeddings = Embeddings(array, np.empty((count, 0)))
    for rows in (embeddings.foreground, embeddings.background):
        if rows.ndim != 2 or len(rows) != count:
            raise ReobjError(f"embeddings are an array of shape {rows.shape}, expected ({count}, "
                             "E): one row per detection")  # fmt: skip
        if not np.abs(rows).max(initial=0) <= np.finfo(np.float32).max:  # False for NaN
            raise ReobjError("embeddings are not finite as float32")
    found = embeddings.foreground.shape[1] + embeddings.background.shape[1]
    if count and (not found or width not in (0, found)):
        expected = f"{width}, as in earlier frames" if width else "at least 1"
        raise ReobjError(f"embeddings of width {found}, expected {expected}")
    return embeddings


class LazyEmbeddings:
    """Fused embeddings of one frame's detections, computed only for requested rows.

    A fused row concatenates foreground and background, weighted so that the cosine of two rows is
    weight * cosine of the foregrounds + (1 - weight) * cosine of the backgrounds.

    Args:
        given: embeddings of all detections, if the caller has them.
        embedder, frame: compute the others; without both and without `given` there are none.
        weight: of the foreground; 1 without a background.

    Attributes:
        rows: (D, E) unit rows, 0 where not done; None before the first request.
        done: (D,) rows that are computed.
        foreground_width: width of the foreground in the rows.
    """

    def __init__(
        self,
        given: Embeddings | None,
        embedder: Embedder | None,
        frame: Image | None,
        detections: Detections,
        weight: float,
    ) -> None:
        self.given = given
        self.embedder = embedder
        self.frame = frame
        self.detections = detections
        self.weight = weight
        self.rows: Floats | None = None
        self.foreground_width = 0
        self.done = np.zeros(len(detections), bool)

    @property
    def available(self) -> bool:
        """Whether embeddings can be computed or were given."""
        return self.given is not None or (self.embedder is not None and self.frame is not None)

    def get(self, rows: IntArray) -> Floats:
        """Return the fused rows (N, E) of detections (N,); (0, 0) if none was requested yet."""
        todo = rows[~self.done[rows]]
        if len(todo):
            fused = self._fuse(todo)  # (n, E)
            if self.rows is None:
                self.rows = np.zeros((len(self.detections), fused.shape[1]), np.float32)
            self.rows[todo] = fused
            self.done[todo] = True
        return np.empty((0, 0), np.float32) if self.rows is None else self.rows[rows]

    def _fuse(self, rows: IntArray) -> Floats:
        """Compute the fused rows of detections (n,)."""
        if self.given is not None:
            fore = self.given.foreground[rows]
            back = self.given.background[rows]
        else:
            assert self.embedder is not None and self.frame is not None
            found = self.embedder(self.frame, self.detections, rows)
            fore = found.foreground
            back = found.background
        self.foreground_width = fore.shape[1]
        return fused_rows(Embeddings(fore, back), self.weight)


def fused_rows(embeddings: Embeddings, foreground_weight: float) -> Floats:
    """Return the fused unit rows (n, E) of embeddings (`LazyEmbeddings`)."""
    weight = foreground_weight if embeddings.background.shape[1] else 1.0
    parts = [
        math.sqrt(weight) * unit_rows(embeddings.foreground),
        math.sqrt(1 - weight) * unit_rows(embeddings.background),
    ]
    return unit_rows(np.concatenate(parts, 1)).astype(np.float32)
