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
    occupancy_map,
    pool_cells,
    sample_parts,
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
    Without a ConvBlock the maps are flattened (the thesis's "no-train"). A model of
    `benchmarks/train_embedding.py` has its own head: its cells are pooled from the crops' maps as
    `Embedder` pools them from the frame's.

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
        self.model = f"crops:{model}"
        # stride 32: a map of 7 x 7 for 224 px, as the last of a ResNet
        self.backbone.use_output_at_stride(32, self.layout.crop_px)
        self.head = None if self.trained else trained_head(self.model, head)
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
            return Embeddings(np.empty((0, 0)), np.empty((0, 0)))
        crops, on_object = self.cut(frame, detections, rows)
        masked = self.masked(crops, on_object)
        if self.trained:
            cells = self._crop_cells(masked, detections, rows, frame.shape[:2], on_object)
            return Embeddings(*self.backbone.embed(*cells))
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
        side = self.layout.crop_px
        (height, width) = frame.shape[:2]
        low, high = self._windows(detections.xyxy[rows], frame.shape[:2])
        pad = max(0, int(-low.min()), int((high - [width, height]).max()))
        wide = cv2.copyMakeBorder(frame, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=(0, 0, 0))
        crops = [
            cv2.resize(wide[y1:y2, x1:x2], (side, side), interpolation=cv2.INTER_AREA)
            for (x1, y1), (x2, y2) in zip(low + pad, high + pad, strict=True)
        ]
        grid = self._pixel_centres(low, high)  # (N, 2, S)
        at = np.stack(np.broadcast_arrays(grid[:, 0, None, :], grid[:, 1, :, None]))  # (2, N, S, S)
        box = cxcywh_from_xyxy(detections.xyxy[rows]).T[..., None, None]  # (4, N, 1, 1)
        on_object = inside_object(detections, rows[:, None, None], at, box[:2], box[2:] / 2)
        return np.stack(crops), on_object

    def masked(self, crops: Image, on_object: BoolArray) -> Image:
        """Mask all but the object, and mask the object, in crops (N, S, S, 3).

        Masked pixels are ImageNet's mean colour with a soft edge for a frozen backbone: a hard edge
        would be the strongest feature of the crop, and another mask of the same object would look
        different. They are black for our trained models, as in training.

        Args:
            on_object: (N, S, S) pixels on the object.
        Returns:
            (2N, S, S, 3): the N objects alone, then their N backgrounds.
        """
        if self.trained:
            return np.concatenate([crops * on_object[..., None], crops * ~on_object[..., None]])
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
        wanted = entry.shape[1:] if len(entry.shape) == 4 else []
        if len(wanted) != 3 or any(
            isinstance(w, int) and w != n for w, n in zip(wanted, maps.shape[1:], strict=True)
        ):
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

    def _pixel_centres(self, low: IntArray, high: IntArray) -> Array:
        """Return (N, 2, S): x of the columns and y of the rows of the crops, in the frame."""
        unit = (np.arange(self.layout.crop_px) + 0.5) / self.layout.crop_px  # (S,)
        return np.asarray(low[:, :, None] + (high - low)[:, :, None] * unit)

    def _crop_cells(
        self,
        masked: Image,
        detections: Detections,
        rows: IntArray,
        size_hw: tuple[int, ...],
        on_object: BoolArray,
    ) -> tuple[Floats, Floats]:
        """Pool the maps of masked crops (2N, S, S, 3) into the cells of a trained head.

        In the coordinates of its crop each object is detection 0, and all others are detection 1.

        Returns:
            foreground and background (N, cells, C + 2) of `pool_cells`.
        """
        side = self.layout.crop_px
        count = len(rows)
        low, high = self._windows(detections.xyxy[rows], size_hw)
        box = (detections.xyxy[rows] - np.tile(low, 2)) * np.tile(side / (high - low), 2)  # (N, 4)
        others = self._occupied_crops(detections, size_hw, low, high) & ~on_object  # (N, S, S)
        maps = self.backbone.maps(masked)  # (2N, h, w, C)
        cells = []
        for i in range(2 * count):  # each crop has its own map
            k = i % count
            some = [True, bool(others[k].any())]
            found = Detections(
                np.stack([box[k], [0, 0, side, side]])[some],
                np.ones(sum(some)),
                np.zeros(sum(some), np.int64),
                np.stack([on_object[k], others[k]])[some],
            )
            occupied = occupancy_map(found, (side, side), maps.shape[1:3])
            samples = sample_parts(found, [np.arange(1)] * 2, (side, side), occupied, self.layout)
            cells.append(pool_cells(maps[i], samples, self.layout)[i // count])
        return np.concatenate(cells[:count]), np.concatenate(cells[count:])

    def _occupied_crops(
        self, detections: Detections, size_hw: tuple[int, ...], low: IntArray, high: IntArray
    ) -> BoolArray:
        """Return (N, S, S): the pixels of the crops that show any object."""
        height, width = size_hw
        occupied = occupancy_map(detections, size_hw, (height, width), self.layout.object_score)
        at = self._pixel_centres(low, high).astype(int)  # (N, 2, S)
        x = at[:, 0, None, :]
        y = at[:, 1, :, None]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.asarray(occupied[y.clip(0, height - 1), x.clip(0, width - 1)] & inside)


def flat_maps(maps: Floats) -> Array:
    """Flatten maps (N, C, h, w) to unit rows (N, C * h * w) of signed square roots."""
    flat = maps.reshape(len(maps), -1)
    return unit_rows(np.sign(flat) * np.sqrt(np.abs(flat)))
