"""Appearance of detections: foreground and background embeddings from one feature map per frame.

`Embedder` computes them, `LazyEmbeddings` only for requested detections. `sample_parts` places the
samples on the map, `pool_cells` averages them to cells. See `reobj.appearance.crops` for the
paper's two-crop variant, `reobj.appearance.reid` for matching.

Axes: D detections of a frame, M foregrounds, N backgrounds, K cells of S samples each, L = K * S.
"""

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
    as_numbers,
    cxcywh_from_xyxy,
    option,
    unit_rows,
    widen,
)


@dataclass(frozen=True, slots=True)
class SamplingLayout:
    """Sampling layout of a feature map for foreground and background embeddings.

    Trained models have their own in their metadata; the defaults are for untrained backbones.

    Attributes:
        size_px: longer side of the backbone's input.
        samples: samples along a side of every cell.
        context, min_margin: margin of the enlarged box on every side: this fraction of the box
            size, and at least this fraction of the image's longer side.
        object_score: detections of at least this score mask the background of the others, and count
            as neighbours.
        foreground_cells, background_cells: cells along a side of the box and of the enlarged box.
        surround_scale, surround_min_margin, surround_cells: the same for a wider box, in which
            other objects count too; scale 0: no such box.
        foreground_channels: the foreground is pooled from this many first channels only; 0: all.
        neighbours: weight of `neighbour_embedding` in the background of trained models; 0.2 and its
            distance are best on the six videos of benchmarks/RESULTS.md.
        crop_px: side of the crops of `CropEmbedder` (224: ImageNet's).
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
        """Apply the `layout` of a model's metadata, with current names or those of old versions."""
        stated = metadata.get("layout", {})
        names = {"reach": "min_margin", "wide": "surround_scale",
                 "wide_reach": "surround_min_margin", "wide_cells": "surround_cells"}  # fmt: skip
        return dataclasses.replace(self, **{names.get(k, k): v for k, v in stated.items()})


@dataclass(frozen=True, slots=True)
class PartSamples:
    """Samples of a feature map: S in each of K cells.

    First the cells of M foregrounds, then those of N backgrounds (of each the enlarged box, then
    the wider one).

    Attributes:
        index: (K, S) flat index into the map. weight: (K, S) bool, valid samples.
        share: (K, 2) fraction of valid samples, and of samples on other objects.
        shape: (M, cells of a foreground), (N, cells of a background).
    """

    index: IntArray
    weight: BoolArray
    share: Floats
    shape: tuple[tuple[int, int], tuple[int, int]]

    def split(self, values: Any) -> tuple[Any, Any]:
        """Split values (K, ...) into foreground (M, cells, ...) and background (N, cells, ...)."""
        fore, back = self.shape
        first = values[: math.prod(fore)]
        rest = values[math.prod(fore) :]
        return first.reshape(*fore, *values.shape[1:]), rest.reshape(*back, *values.shape[1:])


def sample_parts(
    detections: Detections,
    rows: Sequence[IntArray],
    size_hw: tuple[int, ...],
    occupied: BoolArray,
    layout: SamplingLayout,
) -> PartSamples:
    """Sample foregrounds and backgrounds of detections on a feature map.

    Valid are, in the box, samples on the object itself; in the enlarged box, samples on no object;
    in the wider box, if the layout has one, samples not on the object itself. Samples beyond the
    image are never valid.

    Args:
        detections: of one frame of size_hw pixels.
        rows: (M,) detections for the foreground, and (N,) those for the background.
        occupied: (h, w) `occupancy_map` on the feature map.
    """
    size, cells_wh = (np.array(v[1::-1])[:, None] for v in (size_hw, occupied.shape))
    part, grid, excludes, shape = _sample_grid(layout, len(rows[0]), len(rows[1]))
    row = np.concatenate(rows).take(part)  # (L,)
    low, high = detections.xyxy.T.take(row, 1).reshape(2, 2, -1)  # (2, L) x, y, as all below
    centre = (low + high) / 2
    box_half = (high - low) / 2
    half = box_half + np.maximum((high - low) * grid[2], grid[3] * max(size_hw))
    at = centre + half * grid[:2]
    inside = ((at >= 0) & (at < size)).all(0)  # (L,)
    cell = (at / size * cells_wh).astype(int)
    index = (cell[1] * occupied.shape[1] + cell[0]) * inside
    on_object = inside_object(detections, row, at, centre, box_half) & inside
    others = occupied.take(index) & (inside > on_object)
    weight = inside > (on_object | others & excludes)
    fine = layout.samples**2
    weight[: fine * math.prod(shape[0])] = on_object[: fine * math.prod(shape[0])]
    counts = np.concatenate([weight, others]).reshape(2, -1, fine).sum(-1, dtype=np.float32)
    return PartSamples(index.reshape(-1, fine), weight.reshape(-1, fine), counts.T / fine, shape)


@functools.lru_cache(64)
def _sample_grid(
    layout: SamplingLayout, foregrounds: int, backgrounds: int
) -> tuple[IntArray, Array, BoolArray, Any]:
    """Lay out the L samples: of the foregrounds first, then of the backgrounds.

    Returns:
        part: (L,) number of the foreground or background that a sample belongs to.
        grid: (4, L) x and y in its box, -1 to 1; margin of that box as a fraction of the size of
            the detection, and its least margin as a fraction of the image's longer side.
        excludes: (L,) samples on other objects are not valid (enlarged boxes).
        shape: `PartSamples.shape`.
    """
    box = (0.0, 0.0, 0, layout.foreground_cells)
    enlarged = (layout.context, layout.min_margin, 1, layout.background_cells)
    wider = (layout.surround_scale, layout.surround_min_margin, 0, layout.surround_cells)
    grids = []
    for *kind, cells in (box, enlarged, wider)[: 2 + (layout.surround_scale > 0)]:
        side = cells * layout.samples
        line = ((np.arange(side) + 0.5) / side * 2 - 1).reshape(cells, -1)
        x = line[:, None]
        y = line[:, None, :, None]
        grids.append(np.stack(np.broadcast_arrays(x, y, *kind)).reshape(5, -1))
    fore = grids[0]  # (5, samples of one part)
    back = np.concatenate(grids[1:], 1)
    grid = np.concatenate([fore[:, :0], *[fore] * foregrounds, *[back] * backgrounds], 1)
    sizes = np.array([fore.shape[1], back.shape[1]])
    part = np.arange(foregrounds + backgrounds).repeat(sizes.repeat([foregrounds, backgrounds]))
    cells = (sizes // layout.samples**2).tolist()
    return part, grid[:4], grid[4] > 0, ((foregrounds, cells[0]), (backgrounds, cells[1]))


def pool_cells(
    features: Floats, samples: PartSamples, layout: SamplingLayout
) -> tuple[Floats, Floats]:
    """Average the valid samples in each cell of a feature map (h, w, C).

    Returns:
        foreground (M, cells, C + 2) and background (N, cells, C + 2): the mean of the channels, 0
        without valid samples, and `PartSamples.share`. The foreground has only the layout's first
        `foreground_channels`.
    """
    sampled = features.reshape(-1, features.shape[-1]).take(samples.index, 0)  # (K, S, C)
    total = (samples.weight.astype(np.float32)[:, None] @ sampled)[:, 0]  # (K, C)
    mean = total / np.maximum(samples.share[:, :1] * samples.index.shape[1], 1)
    fore, back = samples.split(np.concatenate([mean, samples.share], 1))
    if channels := layout.foreground_channels:
        fore = np.concatenate([fore[..., :channels], fore[..., -2:]], -1)
    return fore, back


def inside_object(
    detections: Detections, rows: IntArray, at: Array, centre: Array, half: Array
) -> BoolArray:
    """Test whether points lie on their detection: in its mask, else in the inscribed ellipse.

    Args:
        rows: (...) detection of each point. at: (2, ...) x, y of the points, pixels.
        centre, half: (2, ...) centre and half size of the detection's box.
    """
    inside = (((at - centre) / np.maximum(half, 0.5)) ** 2).sum(0) <= 1
    if detections.masks is not None:
        height, width = detections.masks.shape[1:]
        column = at[0].astype(int).clip(0, width - 1)
        row = at[1].astype(int).clip(0, height - 1)
        masked = np.zeros(len(detections), bool)
        masked[[i for i in np.unique(rows) if detections.masks[i].any()]] = True
        inside = np.where(masked[rows], detections.masks[rows, row, column], inside)
    return np.asarray(inside, bool)


def occupancy_map(
    detections: Detections,
    size_hw: tuple[int, ...],
    shape: tuple[int, ...],
    min_score: float = 0.0,
) -> BoolArray:
    """Draw the detections of at least min_score on a grid (h, w): True where any object is.

    Args:
        size_hw: of the frame, pixels. shape: (h, w) of the grid, such as a feature map's.
    """
    confident = np.flatnonzero(detections.score >= min_score)
    canvas = np.zeros(shape, np.uint8)
    scale = np.array([shape[1] / size_hw[1], shape[0] / size_hw[0]] * 2)
    boxes = (cxcywh_from_xyxy(detections.xyxy[confident]) * scale).round().clip(-9999, 9999)
    for i, (x, y, w, h) in zip(confident, boxes.astype(int).tolist(), strict=True):
        mask = None if detections.masks is None else detections.masks[i].view(np.uint8)
        if mask is not None and mask.any():
            canvas |= cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST)
        else:
            axes = (max(w // 2, 1), max(h // 2, 1))
            cv2.ellipse(canvas, (x, y), axes, 0, 0, 360, (1,), -1)
    return canvas.view(bool)


# ---- Embedding -----------------------------------------------------------------------------------


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
            return Embeddings.empty()
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

    def _frame(self, frame: Image, detections: Detections) -> _LatestFrame:
        """Return the cached values of a frame; computes the feature map of a new frame."""
        latest = self._latest
        if latest is None or latest.frame is not frame or latest.detections is not detections:
            features = self.backbone(frame)
            score = self.layout.object_score
            occupied = occupancy_map(detections, frame.shape, features.shape[:2], score)
            known = np.zeros(len(detections), bool)
            arrays = (
                features,
                occupied,
                detections.score >= score,
                known,
                np.zeros((len(known), 0)),
            )
            latest = self._latest = _LatestFrame(frame, detections, *arrays)
        return latest

    def _embed_cells(self, fore: Floats, back: Floats) -> tuple[Array, Array]:
        """Turn cells (M, ...) and (N, ...) into foreground (M, E1) and background (N, E2)."""
        if self.trained:
            return self.backbone.embed(fore, back)
        count = self.layout.background_cells**2  # the other cells belong to the wider box
        boxes = (back[:, :count], back[:, count:])[: 1 + (self.layout.surround_scale > 0)]
        return _hellinger_rows(fore), np.concatenate([_hellinger_rows(b) for b in boxes], 1)


@dataclass(slots=True, eq=False)
class _LatestFrame:
    """Values that are computed once per frame.

    Attributes:
        features: (h, w, C) feature map. occupied: (h, w) `occupancy_map`.
        confident: (D,) detections that mask the background and count as neighbours.
        known: (D,) detections whose foreground (D, E) is computed.
    """

    frame: Image
    detections: Detections
    features: Floats
    occupied: BoolArray
    confident: BoolArray
    known: BoolArray
    foreground: Array


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
