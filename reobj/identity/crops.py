"""re-OBJ as published: embeddings from two masked crops of every object."""

from __future__ import annotations

import cv2
import numpy as np

from reobj.identity.embedding import (
    Embedder,
    SamplingLayout,
    object_map,
    on_object,
    part_cells,
    part_samples,
    trained_head,
)
from reobj.sources.weights import IMAGENET_MEAN, IMAGENET_STD, onnx_metadata, onnx_session
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


class CropEmbedder(Embedder):
    """Foreground and background embeddings as in re-OBJ: two masked crops of every object.

    The grown box is cut out twice, once with all but the object hidden and once with the object
    hidden. A backbone turns each into a map (7 x 7 x C for 224 px), and a trained ConvBlock turns
    the two maps, one behind the other in the channels, into one embedding. Without a ConvBlock the
    maps are flattened: the thesis's "no-train". A model of `train_embedding.py` has its own head:
    its cells are pooled from the crops' maps as `Embedder` does from the frame's. This is the
    reference for `Embedder`, which needs one pass a frame instead of two crops an object.

    Args:
        model: backbone, a name listed by `reobj_track.py models` or an ONNX file with an image
            input (any batch) and a spatial output. A ConvBlock for mobilenetv2_feat comes along.
    Raises:
        ReobjError: the model has no spatial output, or the ConvBlock does not fit it.
    """

    def __init__(
        self,
        model: str = "mobilenetv2_feat",
        head: str = "",
        layout: SamplingLayout | None = None,
        threads: int = 0,
        offline: bool = False,
    ) -> None:
        super().__init__(model, "none", layout, threads, offline)
        self.model = f"crops:{model}"
        self.output = self._deepest_map()
        self.head = None if self.trained else trained_head(self.model, head)
        self.conv_block = onnx_session(self.head, threads) if self.head else None
        if self.conv_block is not None:
            self.layout = self.layout.updated(onnx_metadata(self.conv_block))

    def __call__(
        self, frame: Image, detections: Detections, rows: IntArray | None = None
    ) -> Embeddings:
        """Embed the detections of one frame; arguments and result as of `Embedder`."""
        rows = np.arange(len(detections)) if rows is None else rows
        if not len(rows):
            return Embeddings(np.empty((0, 0)), np.empty((0, 0)))
        crops, on_object = self.cut(frame, detections, rows)
        masked = self.masked(crops, on_object)
        if self.trained:
            return self._trained(masked, detections, rows, frame.shape[:2], on_object)
        fore, back = np.split(self.maps(masked), 2)  # (N, C, h, w) each
        if self.conv_block is None:
            return Embeddings(_flat_map(fore), _flat_map(back))
        joint = self._joint(np.concatenate([fore, back], 1))
        return Embeddings(unit_rows(joint), np.empty((len(rows), 0)))

    def cut(self, frame: Image, detections: Detections, rows: IntArray) -> tuple[Image, BoolArray]:
        """Grown boxes, black beyond the frame: crops (N, S, S, 3), object pixels (N, S, S)."""
        side, (height, width) = self.layout.crop_px, frame.shape[:2]
        low, high = self._windows(detections.xyxy[rows], frame.shape[:2])
        pad = max(0, int(-low.min()), int((high - [width, height]).max()))
        wide = cv2.copyMakeBorder(frame, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=(0, 0, 0))
        crops = [
            cv2.resize(wide[y1:y2, x1:x2], (side, side), interpolation=cv2.INTER_AREA)
            for (x1, y1), (x2, y2) in zip(low + pad, high + pad, strict=True)
        ]
        unit = (np.arange(side) + 0.5) / side  # (S,)
        grid = low[:, :, None] + (high - low)[:, :, None] * unit  # (N, 2, S)
        at = np.stack(np.broadcast_arrays(grid[:, 0, None, :], grid[:, 1, :, None]))  # (2, N, S, S)
        box = cxcywh_from_xyxy(detections.xyxy[rows]).T[..., None, None]  # (4, N, 1, 1)
        own = on_object(detections, rows[:, None, None], at, box[:2], box[2:] / 2)
        return np.stack(crops), own

    def masked(self, crops: Image, on_object: BoolArray) -> Image:
        """Objects alone, then surroundings alone: (2N, S, S, 3) of crops (N, S, S, 3).

        A pre-trained backbone gets a mean grey with a soft edge (sigma S / 28): a hard edge is the
        strongest thing in the crop, and another mask of the same object would look different.
        """
        own = on_object[..., None]
        if self.trained:
            return np.concatenate([crops * own, crops * ~own])
        edge = self.layout.crop_px / 28
        soft = [cv2.GaussianBlur(o.astype(np.float32), (0, 0), edge) for o in on_object]
        grey = np.array(IMAGENET_MEAN[::-1], np.float32)
        fore = (crops - grey) * np.stack(soft)[..., None]
        both = np.concatenate([grey + fore, crops - fore])
        return np.asarray(both.round(), np.uint8)

    def _windows(self, xyxy: Array, size_hw: tuple[int, ...]) -> tuple[IntArray, IntArray]:
        """Corners (N, 2) of the grown boxes, whole pixels; may lie beyond the frame."""
        box = cxcywh_from_xyxy(xyxy)  # (N, 4)
        layout, surround = self.layout, self.layout.surround_scale > 0
        grow = max(layout.context, layout.surround_scale)
        least = max(layout.min_margin, layout.surround_min_margin * surround)
        least = max(1.0, least * max(size_hw))
        half = box[:, 2:] / 2 + np.maximum(box[:, 2:] * grow, least)  # (N, 2)
        low, high = np.floor(box[:, :2] - half), np.ceil(box[:, :2] + half)
        return low.astype(np.int64), high.astype(np.int64)

    def _trained(
        self,
        masked: Image,
        detections: Detections,
        rows: IntArray,
        size_hw: tuple[int, ...],
        on_object: BoolArray,
    ) -> Embeddings:
        """Pool the maps of foreground and background crops (2N, S, S, 3) for a trained head."""
        net, side, count = self._net, self.layout.crop_px, len(rows)
        low, high = self._windows(detections.xyxy[rows], size_hw)
        own = (detections.xyxy[rows] - np.tile(low, 2)) * np.tile(side / (high - low), 2)  # (N, 4)
        others = self._crop_objects(detections, size_hw, low, high) & ~on_object  # (N, S, S)
        maps = net.maps(masked)  # (2N, h, w, C)
        fed = []
        for i in range(2 * count):  # over crops: each has a map of its own
            k = i % count
            some = [True, bool(others[k].any())]
            found = Detections(
                np.stack([own[k], [0, 0, side, side]])[some],
                np.ones(sum(some)),
                np.zeros(sum(some), np.int64),
                np.stack([on_object[k], others[k]])[some],
            )
            objects = object_map(found, (side, side), maps.shape[1:3])
            samples = part_samples(found, [np.arange(1)] * 2, (side, side), objects, self.layout)
            fed.append(part_cells(maps[i], samples, self.layout)[i // count])
        return Embeddings(*net.embed(np.concatenate(fed[:count]), np.concatenate(fed[count:])))

    def _crop_objects(
        self, detections: Detections, size_hw: tuple[int, ...], low: IntArray, high: IntArray
    ) -> BoolArray:
        """(N, S, S): which pixels of the crops show any object."""
        height, width = size_hw
        score = self.layout.object_score
        objects = object_map(detections, size_hw, (height, width), score)  # (H, W)
        side = self.layout.crop_px
        unit = (np.arange(side) + 0.5) / side
        at = (low[:, :, None] + (high - low)[:, :, None] * unit).astype(int)  # (N, 2, S)
        x, y = at[:, 0, None, :], at[:, 1, :, None]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.asarray(objects[y.clip(0, height - 1), x.clip(0, width - 1)] & inside)

    def maps(self, crops: Image) -> Floats:
        """Backbone features (B, C, h, w) of BGR images (B, S, S, 3)."""
        net = self._net
        if net.channels_last:
            return np.ascontiguousarray(net.maps(crops).transpose(0, 3, 1, 2))
        rgb = (crops[..., ::-1].astype(np.float32) - IMAGENET_MEAN) / IMAGENET_STD
        feed = {net.input: np.ascontiguousarray(rgb.transpose(0, 3, 1, 2), np.float32)}
        return np.asarray(net.session.run([self.output], feed)[0], np.float32)

    def _deepest_map(self) -> str:
        """Name of the backbone's first output at stride 32 (7 x 7 for 224 px), else its first."""
        net, side = self._net, self.layout.crop_px
        if net.channels_last:
            return str(net.output)
        names: list[str] = [o.name for o in net.session.get_outputs()]
        maps = net.session.run(names, {net.input: np.zeros((1, 3, side, side), np.float32)})
        deep = [n for n, m in zip(names, maps, strict=True) if m.shape[2:] == (side // 32,) * 2]
        return deep[0] if deep else str(net.output)

    def _joint(self, both: Floats) -> Array:
        """Embeddings (N, E) of the stacked maps (N, 2C, h, w)."""
        assert self.conv_block is not None
        entry = self.conv_block.get_inputs()[0]
        wanted = entry.shape[1:] if len(entry.shape) == 4 else []
        if len(wanted) != 3 or any(
            isinstance(w, int) and w != n for w, n in zip(wanted, both.shape[1:], strict=True)
        ):
            raise ReobjError(
                f"{self.head}: takes {entry.shape}, the two maps of the backbone are "
                f"(N, {', '.join(map(str, both.shape[1:]))}): give a ConvBlock trained with this "
                "backbone"
            )
        joint = self.conv_block.run(None, {entry.name: both})[0]
        return np.asarray(joint.reshape(len(both), -1), np.float64)


def _flat_map(maps: Floats) -> Array:
    """Maps (N, C, h, w) as unit rows (N, C * h * w); signed square root as in `_unit_histogram`."""
    flat = maps.reshape(len(maps), -1)
    return unit_rows(np.sign(flat) * np.sqrt(np.abs(flat)))
