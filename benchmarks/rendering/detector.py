"""Simulate the boxes, masks and errors of a detector."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import expit

from rendering.config import COCO_NAMES, Rng
from rendering.ground_truth import FrameTruth
from rendering.surfaces import Room
from rendering.textures import fractal_noise

BOX_SIGMA = 0.012  # of the box side, each edge
MISS_RATE = 0.03  # of clearly visible objects
HALF_VISIBILITY = 0.25  # half of the objects this visible are found
HALF_SIDE_PX = 10.0  # half of the objects this small are found
FALSE_POSITIVES = 0.04  # per frame
CLASS_CONFUSION = 0.0  # probability of a wrong class
EROSION_PX = 0.6  # mean shift of the mask's outline, inwards
SCORE_SIGMA = 0.05

FrameDetections = dict[str, Any]  # xyxy (D, 4) px, score (D,), class_id (D,), runs: D arrays


def jitter_mask(mask: npt.NDArray[np.bool_], rng: Rng) -> npt.NDArray[np.bool_]:
    """Move the outline a little: smooth noise on a blurred mask, a high threshold erodes."""
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.5)
    wobble = fractal_noise(rng, mask.shape[0], mask.shape[1], (12, 40))
    return np.asarray((soft > 0.5 + 0.25 * EROSION_PX + 0.12 * wobble) & (soft > 0.05))


def run_lengths(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint32]:
    """COCO-style run lengths, column-major, zeros first."""
    flat = mask.ravel(order="F")
    turns = np.nonzero(flat[1:] != flat[:-1])[0] + 1
    edges = np.concatenate([[0] if not flat[0] else [0, 0], turns, [flat.size]])
    return np.diff(edges).astype(np.uint32)


def simulate_detections(
    room: Room, truth: FrameTruth, instance: npt.NDArray[np.int32], rng: Rng
) -> FrameDetections:
    """Detector-like boxes and masks: jitter, misses, low scores when occluded, false positives."""
    height, width = instance.shape
    sides = np.nan_to_num(truth.visible_xyxy[:, 2:] - truth.visible_xyxy[:, :2]).min(1)  # (O,)
    clear = expit((truth.visibility - HALF_VISIBILITY) / 0.06) * expit((sides - HALF_SIDE_PX) / 2)
    lucky = rng.random(len(sides)) < (1 - MISS_RATE) * clear
    found = np.nonzero((truth.visible_px > 0) & lucky)[0]
    boxes = truth.visible_xyxy[found]  # (D, 4)
    extent = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = boxes + rng.normal(0, BOX_SIGMA, boxes.shape) * extent
    score = 0.30 + 0.62 * clear[found] * (0.55 + 0.45 * truth.visibility[found])
    score = np.clip(score + rng.normal(0, SCORE_SIGMA, len(found)), 0.05, 0.99)
    classes = np.array([o.class_id for o in room.objects], np.int64)  # (O,)
    confused = rng.random(len(found)) < CLASS_CONFUSION
    class_id = np.where(confused, rng.integers(0, len(COCO_NAMES), len(found)), classes[found])
    runs = [run_lengths(jitter_mask(instance == i, rng)) for i in found]
    # False positives: boxes where nothing is, of classes of this room, with low scores
    false = int(rng.poisson(FALSE_POSITIVES))
    sizes = rng.uniform(20, 110, (false, 2))
    corner = rng.uniform(0, 1, (false, 2)) * (np.array([width, height]) - sizes)
    picked = rng.choice(classes, false)
    scores = rng.uniform(0.2, 0.5, false)
    return {
        "xyxy": np.concatenate(
            [np.clip(boxes, 0, [width, height] * 2), np.hstack([corner, corner + sizes])]
        ),
        "score": np.concatenate([score, scores]),
        "class_id": np.concatenate([class_id, picked]),
        "runs": runs + [np.zeros(0, np.uint32)] * false,
    }
