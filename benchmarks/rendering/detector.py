"""Simulate the boxes, masks and errors of a detector."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import COCO_NAMES, Array, DetectorConfig, Rng
from rendering.ground_truth import FrameTruth
from rendering.surfaces import Room
from rendering.textures import fractal_noise


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """Simulated detections of one frame."""

    xyxy: Array  # (D, 4) px, corner convention
    score: Array  # (D,)
    class_id: npt.NDArray[np.int64]  # (D,)
    masks: tuple[npt.NDArray[np.bool_], ...]  # D times (H, W); an empty array where there is none
    truth_index: npt.NDArray[np.int64]  # (D,) object index, -1 for a false positive; not written


def sigmoid(x: Array) -> Array:
    """1 / (1 + exp(-x))."""
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30, 30))))


def jitter_mask(
    mask: npt.NDArray[np.bool_], config: DetectorConfig, rng: Rng
) -> npt.NDArray[np.bool_]:
    """Move the outline a little: smooth noise on a blurred mask, a high threshold erodes."""
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.5)
    wobble = fractal_noise(rng, mask.shape[0], mask.shape[1], (12, 40))
    return np.asarray((soft > 0.5 + 0.25 * config.mask_erosion_px + 0.12 * wobble) & (soft > 0.05))


def simulate_detections(
    room: Room, truth: FrameTruth, instance: npt.NDArray[np.int32], config: DetectorConfig, rng: Rng
) -> FrameDetections:
    """Detector-like boxes and masks: jitter, misses, low scores when occluded, false positives."""
    height, width = instance.shape
    sides = np.nan_to_num(truth.visible_xyxy[:, 2:] - truth.visible_xyxy[:, :2]).min(1)  # (O,)
    clear = sigmoid((truth.visibility - config.min_visibility) / 0.06) * sigmoid(
        (sides - config.min_side_px) / 2
    )
    found = np.nonzero(
        (truth.visible_px > 0) & (rng.random(len(sides)) < (1 - config.miss_rate) * clear)
    )[0]
    boxes = truth.visible_xyxy[found]  # (D, 4)
    extent = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = np.clip(
        boxes + rng.normal(0, config.box_sigma, boxes.shape) * extent, 0, [width, height] * 2
    )
    score = 0.30 + 0.62 * clear[found] * (0.55 + 0.45 * truth.visibility[found])
    score = np.clip(score + rng.normal(0, config.score_sigma, len(found)), 0.05, 0.99)
    class_id = np.array([room.objects[i].class_id for i in found], np.int64)
    confused = rng.random(len(found)) < config.class_confusion
    class_id = np.where(confused, rng.integers(0, len(COCO_NAMES), len(found)), class_id)
    masks = [jitter_mask(instance == i, config, rng) for i in found]
    false = false_positives(room, (width, height), config, rng)
    masks += [np.zeros((0, 0), bool)] * len(false[0])
    return FrameDetections(
        np.concatenate([boxes, false[0]]),
        np.concatenate([score, false[1]]),
        np.concatenate([class_id, false[2]]),
        tuple(masks),
        np.concatenate([found, np.full(len(false[0]), -1)]),
    )


def false_positives(
    room: Room, size: tuple[int, int], config: DetectorConfig, rng: Rng
) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Boxes where nothing is: classes of this room, low scores."""
    count = int(rng.poisson(config.false_positives))
    extent = rng.uniform(20, 110, (count, 2))
    corner = rng.uniform(0, 1, (count, 2)) * (np.array(size) - extent)
    classes = np.array([truth.class_id for truth in room.objects], np.int64)
    picked = rng.choice(classes, count) if len(classes) else np.zeros(count, np.int64)
    return np.concatenate([corner, corner + extent], 1), rng.uniform(0.2, 0.5, count), picked
