"""Foreground and background embeddings of detections from one feature map a frame."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

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
        "appearance: reobj (comes along), none, a backbone name / .onnx file, or "
        "crops[:BACKBONE] (re-OBJ as published: two crops an object)",
        "--embed",
    )
    head: str = option(
        "", "trained head (.onnx) of a backbone; empty: the one that comes along; none: no training"
    )


@dataclass(frozen=True, slots=True)
class SamplingLayout:
    """Where a feature map is sampled for foreground and background; trained models bring their own.

    Attributes:
        size_px: longer side of the backbone's input. samples: a side of every cell.
        context, min_margin: the box grows by this share of its size on every side, and by at least
            this share of the image's longer side.
        object_score: detections from this score on are no background for the others.
        foreground_cells, background_cells: a side, of the box and of the grown box.
        surround_scale, surround_min_margin, surround_cells: the same for a wider box that shows
            other objects too (scale 0: none).
        foreground_channels: the foreground reads only the first so many channels (0: all).
        neighbours: share of the objects around in the background part of trained models.
        crop_px: side of the crops of re-OBJ (`CropEmbedder`).
    """

    size_px: int = 480
    samples: int = 4
    context: float = 0.5
    min_margin: float = 0.0
    object_score: float = 0.3
    foreground_cells: int = 2
    background_cells: int = 4
    surround_scale: float = 0.0
    surround_min_margin: float = 0.2
    surround_cells: int = 4
    foreground_channels: int = 0
    neighbours: float = 0.2
    crop_px: int = 224

    def updated(self, metadata: dict[str, Any]) -> SamplingLayout:
        """Take what a model's metadata say in `layout`, also by the names of earlier versions."""
        given = metadata.get("layout", {})
        return dataclasses.replace(self, **{_EARLIER_NAMES.get(k, k): v for k, v in given.items()})


_EARLIER_NAMES = {"reach": "min_margin", "wide": "surround_scale",
                  "wide_reach": "surround_min_margin", "wide_cells": "surround_cells"}  # fmt: skip


class Embedder:
    """Foreground and background embeddings from one feature map a frame, pooled under masks.

    The thesis (re-OBJ) sends two masked crops of each object through a ResNet; here one pass over
    the frame serves all objects. The box and the expanded box are sampled on grids; samples under
    the object's mask (or the ellipse inscribed in its box) make the foreground, samples under no
    mask at all the background; both keep a coarse spatial layout (cells). A trained model brings a
    head that turns the cells into two short embeddings; its background also holds what the objects
    around look like (`look_around`).

    Args:
        model: "reobj" for the weights that come along, or a backbone: a name listed by
            `reobj_track.py models` or a path to an ONNX file with an image input and a spatial
            output (of `train_embedding.py`: its head and its layout are found through the file).
        head: trained head (.onnx) of a backbone; "": the one that comes along; "none": no training.
        layout: where the map of an untrained backbone is sampled.

    Attributes:
        layout: where the map is sampled; that of the model if it was trained.
    """

    def __init__(
        self,
        model: str = "reobj",
        head: str = "",
        layout: SamplingLayout | None = None,
        threads: int = 0,
        offline: bool = False,
    ) -> None:
        self.model = model
        self._net = _Backbone(model, head, layout or SamplingLayout(), threads, offline)
        self.layout = self._net.layout
        self._last: _Seen | None = None

    def __call__(
        self, frame: Image, detections: Detections, rows: IntArray | None = None
    ) -> Embeddings:
        """Embed the detections of one frame.

        Args:
            frame: (H, W, 3) BGR.
            detections: all detections of the frame (their masks also say what is no background).
            rows: (N,) the detections to embed; default all. Asked again about the same frame and
                detections, only what is new is computed.
        """
        rows = np.arange(len(detections)) if rows is None else rows
        if not len(rows):
            return Embeddings(np.zeros((0, 0)), np.zeros((0, 0)))
        seen, share = self._last, self.layout.neighbours if self.trained else 0.0
        if seen is None or seen.frame is not frame or seen.detections is not detections:
            seen = self._last = _Seen(frame, detections, self._net(frame), self.layout)
        wanted = seen.sure & (share > 0)
        wanted[rows] = True
        new = np.flatnonzero(wanted & ~seen.known)
        fore, back = self._parts(seen, new, rows)
        seen.foreground = widen(seen.foreground, fore)
        seen.foreground[new], seen.known[new] = fore, True
        if share:
            around = look_around(detections.xyxy, seen.foreground, seen.sure, rows)
            back = np.concatenate([math.sqrt(1 - share) * back, math.sqrt(share) * around], 1)
        return Embeddings(seen.foreground[rows], unit_rows(back))

    @property
    def trained(self) -> bool:
        """Does the model come with a head?"""
        return self._net.head is not None

    @property
    def frozen(self) -> bool:
        """Is it a backbone that was trained for something else?"""
        return not self._net.channels_last

    def _parts(self, seen: _Seen, new: IntArray, rows: IntArray) -> tuple[Array, Array]:
        """Foreground (M, E1) of the new rows and background (N, E2) of the chosen ones."""
        size_hw, chosen = seen.frame.shape[:2], (new, rows)
        samples = part_samples(seen.detections, chosen, size_hw, seen.objects, self.layout)
        fore, back = part_cells(seen.features, samples, self.layout)
        if self.trained:
            return self._net.embed(fore, back)
        near = self.layout.background_cells**2
        around = (back[:, :near], back[:, near:])[: 1 + (self.layout.surround_scale > 0)]
        return _unit_histogram(fore), np.concatenate([_unit_histogram(b) for b in around], 1)


class _Seen:
    """A frame, its detections, its feature map (h, w, C), the cells (h, w) that show objects, and
    the foreground (D, E) of those of the detections that are known.
    """

    def __init__(
        self, frame: Image, detections: Detections, features: Floats, layout: SamplingLayout
    ) -> None:
        self.frame, self.detections, self.features = frame, detections, features
        self.sure = detections.score >= layout.object_score
        self.objects = object_map(detections, frame.shape, features.shape[:2], layout.object_score)
        self.known = np.zeros(len(detections), bool)
        self.foreground = np.zeros((len(detections), 0))


def look_around(
    xyxy: Array, foreground: npt.NDArray[Any], sure: BoolArray, rows: IntArray
) -> Array:
    """What stands around the chosen objects of a frame: unit rows (N, E), 0 where nothing does.

    The sum of the looks of the others, each weighted by exp(-distance / own size). Seen from behind
    an object has another background, but the same neighbours.

    Args:
        xyxy: (D, 4). foreground: (D, E). sure: (D,) which of them count as neighbours.
        rows: (N,) the chosen ones.
    """
    others, (x, y, w, h) = np.flatnonzero(sure), cxcywh_from_xyxy(xyxy).T  # (O,), (D,) each
    centre, size = x + 1j * y, np.sqrt(np.maximum(w, 1) * np.maximum(h, 1))
    distance = np.abs(centre[rows, None] - centre[others])  # (N, O)
    weight = np.exp(-distance / size[rows, None]) * (rows[:, None] != others)
    return unit_rows(weight @ foreground[others])


@dataclass(frozen=True, slots=True)
class PartSamples:
    """Where objects look at a feature map: S samples in each of C cells, first those of M
    foregrounds, then those of N backgrounds (of each the grown box, then the wider one).

    Attributes:
        index: (C, S) flat index into the map's cells. weight: (C, S) bool, samples that count.
        share: (C, 2) of the samples that count, and of those on other objects.
        shape: (M, cells of each), (N, cells of each).
    """

    index: IntArray
    weight: BoolArray
    share: Floats
    shape: tuple[tuple[int, int], tuple[int, int]]

    def split(self, values: Any) -> tuple[Any, Any]:
        """Give foreground (M, cells, ...) and background (N, cells, ...) of values (C, ...)."""
        fore, back = self.shape
        first, rest = values[: math.prod(fore)], values[math.prod(fore) :]
        return first.reshape(*fore, *values.shape[1:]), rest.reshape(*back, *values.shape[1:])


def part_samples(
    detections: Detections,
    rows: Sequence[IntArray],
    size_hw: tuple[int, ...],
    objects: BoolArray,
    layout: SamplingLayout,
) -> PartSamples:
    """Sample boxes (foreground), and for the background grown boxes (no other object) and, if the
    layout has them, wider boxes (everything but the object).

    Args:
        detections: of one frame of size_hw. rows: (M,) those for the foreground, (N,) those for the
            background. objects: (h, w) cells of the feature map that show any (`object_map`).
    """
    size, cells_wh = (np.array(v[1::-1])[:, None] for v in (size_hw, objects.shape))
    window, grid, near, shape = _grids(layout, len(rows[0]), len(rows[1]))
    row = np.concatenate(rows).take(window)  # (L,)
    low, high = detections.xyxy.T.take(row, 1).reshape(2, 2, -1)  # (2, L) x, y, as all below
    centre, own_half = (low + high) / 2, (high - low) / 2
    half = own_half + np.maximum((high - low) * grid[2], grid[3] * max(size_hw))
    at = centre + half * grid[:2]
    inside = ((at >= 0) & (at < size)).all(0)  # (L,)
    cell = (at / size * cells_wh).astype(int)
    index = (cell[1] * objects.shape[1] + cell[0]) * inside
    own = on_object(detections, row, at, centre, own_half) & inside
    others = objects.take(index) & (inside > own)
    weight, fine = inside > (own | others & near), layout.samples**2
    weight[: fine * math.prod(shape[0])] = own[: fine * math.prod(shape[0])]
    counts = np.concatenate([weight, others]).reshape(2, -1, fine).sum(-1, dtype=np.float32)
    return PartSamples(index.reshape(-1, fine), weight.reshape(-1, fine), counts.T / fine, shape)


@functools.lru_cache(64)
def _grids(layout: SamplingLayout, fore: int, back: int) -> tuple[IntArray, Array, BoolArray, Any]:
    """The L samples of so many foregrounds and backgrounds: the number of the one each is of (L,);
    x and y in the box, -1 to 1, and by what share of itself and at least of the image that is grown
    (4, L); do other objects not count (L,)? Last `PartSamples.shape`.
    """
    own = (0.0, 0.0, 0, layout.foreground_cells)
    near = (layout.context, layout.min_margin, 1, layout.background_cells)
    wide = (layout.surround_scale, layout.surround_min_margin, 0, layout.surround_cells)
    grids = []
    for *kind, cells in (own, near, wide)[: 2 + (layout.surround_scale > 0)]:
        side = cells * layout.samples
        line = ((np.arange(side) + 0.5) / side * 2 - 1).reshape(cells, -1)
        x, y = line[:, None], line[:, None, :, None]
        grids.append(np.stack(np.broadcast_arrays(x, y, *kind)).reshape(5, -1))
    one, other = grids[0], np.concatenate(grids[1:], 1)
    grid = np.concatenate([one[:, :0], *[one] * fore, *[other] * back], 1)
    sizes = np.array([one.shape[1], other.shape[1]])
    of = np.arange(fore + back).repeat(sizes.repeat([fore, back]))
    cells = (sizes // layout.samples**2).tolist()
    return of, grid[:4], grid[4] > 0, ((fore, cells[0]), (back, cells[1]))


def part_cells(
    features: Floats, samples: PartSamples, layout: SamplingLayout
) -> tuple[Floats, Floats]:
    """What foregrounds and backgrounds see in each cell, (M, cells, C + 2) and (N, cells, C + 2):
    mean of the samples that count on a map (h, w, C), 0 where none does; `PartSamples.share`.
    """
    sampled = features.reshape(-1, features.shape[-1]).take(samples.index, 0)  # (cells, S, C)
    total = (samples.weight.astype(np.float32)[:, None] @ sampled)[:, 0]  # (cells, C)
    mean = total / np.maximum(samples.share[:, :1] * samples.index.shape[1], 1)
    fore, back = samples.split(np.concatenate([mean, samples.share], 1))
    if channels := layout.foreground_channels:
        fore = np.concatenate([fore[..., :channels], fore[..., -2:]], -1)
    return fore, back


def on_object(
    detections: Detections, rows: IntArray, at: Array, centre: Array, half: Array
) -> BoolArray:
    """Are samples at (2, ...) of detections rows (...) on their own object? Its mask, else the
    ellipse inscribed in its box, centre and half size (2, ...).
    """
    on = (((at - centre) / np.maximum(half, 0.5)) ** 2).sum(0) <= 1
    if detections.masks is not None:
        height, width = detections.masks.shape[1:]
        column, row = at[0].astype(int).clip(0, width - 1), at[1].astype(int).clip(0, height - 1)
        masked = np.zeros(len(detections), bool)
        masked[[i for i in np.unique(rows) if detections.masks[i].any()]] = True
        on = np.where(masked[rows], detections.masks[rows, row, column], on)
    return np.asarray(on, bool)


def object_map(
    detections: Detections,
    size_hw: tuple[int, ...],
    shape: tuple[int, ...],
    min_score: float = 0.0,
) -> BoolArray:
    """Which cells of a feature map (h, w) show any object of the frame? size_hw: of the frame."""
    sure = np.flatnonzero(detections.score >= min_score)
    canvas = np.zeros(shape, np.uint8)
    scale = np.array([shape[1] / size_hw[1], shape[0] / size_hw[0]] * 2)
    boxes = (cxcywh_from_xyxy(detections.xyxy[sure]) * scale).round().clip(-9999, 9999)
    for i, (x, y, w, h) in zip(sure, boxes.astype(int).tolist(), strict=True):
        mask = None if detections.masks is None else detections.masks[i].view(np.uint8)
        if mask is not None and mask.any():
            canvas |= cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST)
        else:
            axes = (max(w // 2, 1), max(h // 2, 1))
            cv2.ellipse(canvas, (x, y), axes, 0, 0, 360, (1,), -1)
    return canvas.view(bool)


def _unit_histogram(cells: Floats) -> Array:
    """Cells (N, K, C + 2) of `part_cells` side by side as unit rows (N, K * C).

    The signed square root makes a cosine of histograms a Hellinger kernel and tames strong
    channels; part-empty cells count less.
    """
    mean, share = cells[..., :-2], cells[..., -2]
    trust = np.sqrt(share / np.maximum(share.max(1, keepdims=True), 1e-9))
    rows = np.sign(mean) * np.sqrt(np.abs(mean)) * trust[..., None]
    return unit_rows(_side_by_side(rows))


def _side_by_side(cells: Floats) -> Floats:
    """Cells (N, K, C) as rows (N, K * C); N may be 0."""
    return cells.reshape(len(cells), cells.shape[1] * cells.shape[2])


class _Backbone:
    """Feature map of a frame from an ONNX backbone with an image input and a spatial output.

    Files of `examples/train_embedding.py` say in their metadata ("reobj", JSON) how the frame is
    resized, where the map is sampled and which file holds the head; they take BGR bytes and give
    channels last. Any other backbone: RGB, ImageNet mean and deviation, channels first; where a
    head was trained for it, the head's metadata say the same.

    Attributes:
        layout: where its maps are sampled. head: session of the trained head, or None.
        channels_last: of the maps that the network itself gives; such networks take BGR bytes.
    """

    def __init__(
        self, model: str, head: str, layout: SamplingLayout, threads: int, offline: bool
    ) -> None:
        path = model_path(model, offline=offline)
        self.session = onnx_session(path, threads)
        spatial = [o.name for o in self.session.get_outputs() if len(o.shape) == 4]
        if not spatial or len(self.session.get_inputs()[0].shape) != 4:
            raise ReobjError(
                f"{model}: expected a backbone with one image input and a spatial output "
                f"(N, C, h, w), found outputs {[o.name for o in self.session.get_outputs()]}; "
                "give another --embed model"
            )
        self.input, self.output = self.session.get_inputs()[0].name, spatial[0]
        metadata = onnx_metadata(self.session)
        self.channels_last = bool(metadata)
        self.multiple = int(metadata.get("multiple", 32))
        file = path.parent / metadata["head"] if metadata else trained_head(model, head)
        self.head: Any = onnx_session(file, threads) if file else None
        self.layout = layout
        if self.head is not None:
            self.layout = layout.updated(metadata or onnx_metadata(self.head))

    def __call__(self, frame: Image) -> Floats:
        """Return the features (h, w, C) of a frame (H, W, 3) BGR."""
        shrink = min(1.0, self.layout.size_px / max(frame.shape[:2]))
        side = self.multiple
        size = [max(side, round(n * shrink / side) * side) for n in frame.shape[1::-1]]
        return np.asarray(self.maps(resized(frame, size)[None])[0])

    def maps(self, images: Image) -> Floats:
        """Return the features (N, h, w, C) of BGR images (N, H, W, 3) of a fit size."""
        if self.channels_last:
            return self._run(images)
        rgb = (images[..., ::-1].astype(np.float32) - IMAGENET_MEAN) / IMAGENET_STD
        maps = self._run(np.ascontiguousarray(rgb.transpose(0, 3, 1, 2), np.float32))
        return np.ascontiguousarray(maps.transpose(0, 2, 3, 1))

    def _run(self, images: npt.NDArray[Any]) -> Floats:
        return np.asarray(self.session.run([self.output], {self.input: images})[0], np.float32)

    def embed(self, fore: Floats, back: Floats) -> tuple[Array, Array]:
        """Both parts' cells through the head, all objects at once: unit rows (M, E1), (N, E2)."""
        fed = {"fg": _side_by_side(fore), "bg": _side_by_side(back)}
        foreground, background = self.head.run(None, fed)
        return np.asarray(foreground, np.float64), np.asarray(background, np.float64)


def trained_head(model: str, head: str = "") -> Path | None:
    """Find the head of a frozen backbone ("crops:" before its name: the ConvBlock).

    Args:
        head: its file, "none", or "" for BACKBONE_head.onnx beside the backbone's file, else among
            the weights that come along.
    Returns:
        None: no head, the backbone's own features serve.
    Raises:
        ReobjError: `head` is neither a file nor "none".
    """
    if head:
        return None if head == "none" else model_path(head, offline=True)
    kind, _, backbone = model.rpartition(":")
    path = Path(backbone)
    folder = path.parent if path.suffix == ".onnx" else own_models()
    path = folder / f"{kind + '_' if kind else ''}{path.stem}_head.onnx"
    return path if path.is_file() else None


def as_embeddings(embeddings: Embeddings | npt.ArrayLike | None, count: int) -> Embeddings | None:
    """Accept one (D, E) array as foreground-only embeddings; check the number of rows."""
    if embeddings is None:
        return None
    if not isinstance(embeddings, Embeddings):
        rows = np.asarray(embeddings, np.float64).reshape(count, -1) if count else np.empty((0, 0))
        embeddings = Embeddings(rows, np.empty((count, 0)))
    if len(embeddings.foreground) != count:
        raise ReobjError(
            f"{len(embeddings.foreground)} embeddings for {count} detections: "
            "give one row a detection"
        )
    return embeddings


class LazyEmbeddings:
    """Fused embeddings of one frame's detections, computed only for the rows that are asked for."""

    def __init__(
        self,
        given: Embeddings | None,
        embedder: Embedder | None,
        frame: Image | None,
        detections: Detections,
        weight: float,
    ) -> None:
        self.given, self.embedder, self.frame, self.detections = given, embedder, frame, detections
        self.weight = weight
        self.rows: Floats | None = None  # (D, E)
        self.foreground_width = 0  # width of the foreground in the rows
        self.done = np.zeros(len(detections), bool)

    @property
    def available(self) -> bool:
        return self.given is not None or (self.embedder is not None and self.frame is not None)

    def get(self, rows: IntArray) -> Floats:
        """Return unit rows (N, E): foreground and background side by side, weighted."""
        todo = rows[~self.done[rows]]
        if len(todo):
            fused = self._fuse(todo)  # (n, E)
            if self.rows is None:
                self.rows = np.zeros((len(self.detections), fused.shape[1]), np.float32)
            self.rows[todo], self.done[todo] = fused, True
        return np.empty((0, 0), np.float32) if self.rows is None else self.rows[rows]

    def _fuse(self, rows: IntArray) -> Floats:
        """cos(fused) = w cos(foreground) + (1 - w) cos(background)."""
        if self.given is not None:
            parts = (self.given.foreground[rows], self.given.background[rows])
        else:
            assert self.embedder is not None and self.frame is not None
            embeddings = self.embedder(self.frame, self.detections, rows)
            parts = (embeddings.foreground, embeddings.background)
        weight, self.foreground_width = self.weight if parts[1].shape[1] else 1.0, parts[0].shape[1]
        fused = np.concatenate(
            [
                math.sqrt(weight) * unit_rows(parts[0]),
                math.sqrt(1 - weight) * unit_rows(parts[1]),
            ],
            1,
        )
        return unit_rows(fused).astype(np.float32)
