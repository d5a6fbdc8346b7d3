"""Appearance in the style of re-OBJ: embeddings from two masked crops of every object.

`CropEmbedder` has the interface of `Embedder` (`reobj.appearance.embedding`), which needs one pass
per frame instead of two crops per object. `make_embedder` builds the one that a config names.
"""

from __future__ import annotations

import cv2
import numpy as np

from reobj.appearance.embedding import (
    Embedder,
    SamplingLayout,
    inside_object,
    trained_head,
)
from reobj.sources.weights import IMAGENET_MEAN, onnx_metadata, onnx_session
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
    unit_rows,
)

CROP_BACKBONE = "mobilenetv2_feat"  # its ConvBlock is bundled (re-OBJ: a ResNet)


def make_embedder(
    model: str, head: str = "", threads: int = 0, offline: bool = False, device: str = "cpu"
) -> Embedder | None:
    """Build the embedder named by `EmbedConfig.model` and `.head`.

    Args:
        model: "none"; "crops" or "crops:BACKBONE" for a `CropEmbedder`; else as of `Embedder`.
        head, threads, offline, device: as of `Embedder`.
    Returns:
        None for "none": the tracker then uses motion alone.
    """
    if model == "none":
        return None
    kind, _, backbone = model.partition(":")
    if kind == "crops":
        return CropEmbedder(backbone or CROP_BACKBONE, head, None, threads, offline, device)
    return Embedder(model, head, None, threads, offline, device)


class CropEmbedder(Embedder):
    """Foreground and background embeddings as in re-OBJ: two masked crops of every object.

    The enlarged box is cropped twice, once with everything but the object masked and once with the
    object masked. A backbone turns each crop into a map. A trained ConvBlock turns the two maps,
    stacked in the channels, into one embedding (the bundled one processes each map alone first).
    Without a ConvBlock the maps are flattened (the thesis's "no-train").

    Args:
        model: backbone, a name listed by `reobj_track.py models` or an ONNX file with an image
            input (any batch) and a spatial output.
        head: ConvBlock (.onnx); "": crops_BACKBONE_head.onnx beside the backbone's file, else the
            bundled one; "none": none.
        layout, threads, offline, device: as of `Embedder`.
    Raises:
        ReobjError: the model has no spatial output, or (when called) the ConvBlock does not fit it.
    """

    def __init__(
        self,
        model: str = CROP_BACKBONE,
        head: str = "",
        layout: SamplingLayout | None = None,
        threads: int = 0,
        offline: bool = False,
        device: str = "cpu",
    ) -> None:
        super().__init__(model, "none", layout, threads, offline, device)
        if self.trained:
            raise ReobjError(f"--embed crops:{model}: is a model of whole frames: --embed {model}")
        self.model = f"crops:{model}"
        # stride 32: a map of 7 x 7 for 224 px, as the last of a ResNet
        self.backbone.use_output_at_stride(32, self.layout.crop_px)
        self.head = trained_head(self.model, head)
        self.conv_block = onnx_session(self.head, threads, device) if self.head else None
        if self.conv_block is not None:
            self.layout = self.layout.updated(onnx_metadata(self.conv_block))

    def __call__(
        self, frame: Image, detections: Detections, rows: IntArray | None = None
    ) -> Embeddings:
        """Embed detections of one frame; arguments as of `Embedder`.

        Returns:
            Embeddings with unit rows; a ConvBlock's joint rows as foreground, no background.
        """
        rows = np.arange(len(detections)) if rows is None else rows
        if not len(rows):
            return Embeddings.empty()
        masked = self.masked(*self.cut(frame, detections, rows))
        fore, back = np.split(self.maps(masked), 2)  # (N, C, h, w) each
        if self.conv_block is None:
            return Embeddings(flat_maps(fore), flat_maps(back))
        joint = self.run_conv_block(np.concatenate([fore, back], 1))
        return Embeddings(unit_rows(joint), np.empty((len(rows), 0)))

    def cut(self, frame: Image, detections: Detections, rows: IntArray) -> tuple[Image, BoolArray]:
        """Crop the enlarged boxes of detections (N,), black beyond the frame.

        Returns:
            crops (N, S, S, 3), and (N, S, S) the pixels on the object.
        """
        layout = self.layout
        side = layout.crop_px
        size = np.array(frame.shape[1::-1])
        box = cxcywh_from_xyxy(detections.xyxy[rows])  # (N, 4)
        least = max(1.0, layout.min_margin * max(size))  # px
        half = box[:, 2:] / 2 + np.maximum(box[:, 2:] * layout.context, least)
        low = np.floor(box[:, :2] - half).astype(np.int64)  # (N, 2), may lie beyond the frame
        high = np.ceil(box[:, :2] + half).astype(np.int64)
        pad = max(0, int(-low.min()), int((high - size).max()))
        wide = cv2.copyMakeBorder(frame, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=(0, 0, 0))
        crops = [
            cv2.resize(wide[y1:y2, x1:x2], (side, side), interpolation=cv2.INTER_AREA)
            for (x1, y1), (x2, y2) in zip(low + pad, high + pad, strict=True)
        ]
        unit = (np.arange(side) + 0.5) / side  # (S,)
        x, y = (low[:, :, None] + (high - low)[:, :, None] * unit).swapaxes(0, 1)  # (N, S) each
        at = np.stack(np.broadcast_arrays(x[:, None, :], y[:, :, None]))  # (2, N, S, S)
        centre, whole = np.split(box.T[..., None, None], 2)  # (2, N, 1, 1)
        on_object = inside_object(detections, rows[:, None, None], at, centre, whole / 2)
        return np.stack(crops), on_object

    def masked(self, crops: Image, on_object: BoolArray) -> Image:
        """Mask all but the object, and mask the object, in crops (N, S, S, 3).

        Masked pixels are ImageNet's mean colour with a soft edge: a hard edge would be the
        strongest feature of the crop, and another mask of the same object would look different.

        Args:
            on_object: (N, S, S) pixels on the object.
        Returns:
            (2N, S, S, 3): the N objects alone, then their N backgrounds.
        """
        edge = self.layout.crop_px / 28  # sigma of the soft edge: 8 px of 224
        soft = [cv2.GaussianBlur(o.astype(np.float32), (0, 0), edge) for o in on_object]
        grey = np.array(IMAGENET_MEAN[::-1], np.float32)
        fore = (crops - grey) * np.stack(soft)[..., None]
        both = np.concatenate([grey + fore, crops - fore])
        return np.asarray(both.round(), np.uint8)

    def maps(self, crops: Image) -> Floats:
        """Compute the backbone's maps (B, C, h, w) of BGR crops (B, S, S, 3)."""
        return np.ascontiguousarray(self.backbone.maps(crops).transpose(0, 3, 1, 2))

    def run_conv_block(self, maps: Floats) -> Array:
        """Turn the stacked maps of objects (N, C, h, w) into embeddings (N, E).

        Raises:
            ReobjError: the ConvBlock takes maps of another shape.
        """
        assert self.conv_block is not None
        entry = self.conv_block.get_inputs()[0]
        sides = zip(entry.shape, maps.shape, strict=False)
        if len(entry.shape) != 4 or any(isinstance(a, int) and a != b for a, b in [*sides][1:]):
            raise ReobjError(
                f"{self.head}: expects input {entry.shape}, but the two maps of the backbone are "
                f"(N, {', '.join(map(str, maps.shape[1:]))}): give a ConvBlock trained with this "
                "backbone"
            )
        joint = self.conv_block.run(None, {entry.name: maps})[0]
        return np.asarray(joint.reshape(len(maps), -1), np.float64)

    def _windows(self, xyxy: Array, size_hw: tuple[int, ...]) -> tuple[IntArray, IntArray]:
        """Return the corners (N, 2) low and high of the enlarged boxes, whole pixels.

        They may lie beyond the frame.
        """
        box = cxcywh_from_xyxy(xyxy)  # (N, 4)
        layout = self.layout
        surround = self.layout.surround_scale > 0
        scale = max(layout.context, layout.surround_scale)
        least = max(layout.min_margin, layout.surround_min_margin * surround)
        margin = np.maximum(box[:, 2:] * scale, max(1.0, least * max(size_hw)))
        half = box[:, 2:] / 2 + margin  # (N, 2)
        low = np.floor(box[:, :2] - half)
        high = np.ceil(box[:, :2] + half)
        return low.astype(np.int64), high.astype(np.int64)


def flat_maps(maps: Floats) -> Array:
    """Flatten maps (N, C, h, w) to unit rows (N, C * h * w) of signed square roots."""
    flat = maps.reshape(len(maps), -1)
    return unit_rows(np.sign(flat) * np.sqrt(np.abs(flat)))
