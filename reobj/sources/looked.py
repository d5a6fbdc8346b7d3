"""Infer the frames on which a detector was run from the frames with boxes.

A frame without boxes is either empty or was skipped by the detector; tracks must not count skipped
frames as missed detections. `looked` in the code: frames on which the detector was run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from reobj.files import shortened
from reobj.types import IntArray


@dataclass(slots=True)
class Intervals:
    """Statistics of the frames with boxes.

    Attributes:
        first, last: frame with boxes. count: of such frames. step: greatest common divisor of their
            intervals. apart: number of intervals above 1. boxes: total number.
    """

    first: int = 0
    last: int = 0
    count: int = 0
    step: int = 0
    apart: int = 0
    boxes: int = 0

    def add(self, frame: int, boxes: int) -> None:
        """Add the next frame with boxes."""
        if self.count:
            self.step = math.gcd(self.step, frame - self.last)
            self.apart += frame - self.last > 1
        else:
            self.first = frame
        self.last = frame
        self.count = self.count + 1
        self.boxes = self.boxes + boxes

    def looked_at(self, frame: int) -> bool:
        """Decide whether the detector was run on a frame without boxes."""
        if self.count > 2 and self.step > 1:
            return (frame - self.first) % self.step == 0
        return not self.irregular

    @property
    def irregular(self) -> bool:
        """True if the detector was run at irregular intervals: frames without boxes were skipped.

        Most frames with boxes are not followed by another one, and the expected number of frames
        with detector output (Poisson) is less than half of all frames.
        """
        if self.count < 2 or self.step > 1 or 2 * self.apart <= self.count - 1:
            return False
        looked = self.count / _fraction_with_boxes(self.boxes / self.count)
        return 2 * looked < self.last - self.first + 1


def frames_looked_at(frame: IntArray, frame_count: int) -> IntArray | None:
    """Infer the frames on which a detector was run from the frames of its boxes.

    Args:
        frame: (N,) of each box. frame_count: of the video, 0: unknown.
    Returns:
        frame numbers, ascending; None: all frames of the video.
    """
    seen, boxes = np.unique(frame[frame >= 0], return_counts=True)
    intervals = Intervals()
    for at, count in zip(seen.tolist(), boxes.tolist(), strict=True):
        intervals.add(at, count)
    if intervals.count > 2 and intervals.step > 1:
        end = max(frame_count, intervals.last + 1)
        return np.arange(intervals.first % intervals.step, end, intervals.step)
    return seen if intervals.irregular else None


def _fraction_with_boxes(mean: float) -> float:
    """Return the expected fraction of frames with boxes; mean: number of boxes in such a frame.

    Boxes are Poisson distributed over the frames: mean = rate / (1 - exp(-rate)).
    """
    if mean < 1 + 1e-6:  # one box in each: the fraction of empty frames is unknown
        return 1e-9
    rate = brentq(lambda x: x / -math.expm1(-x) - mean, 1e-9, mean)
    return -math.expm1(-float(rate))


def looked_message(looked: IntArray, listed: bool) -> str:
    """Return the message about the frames on which the detector was run.

    Args:
        looked: frame numbers, ascending. listed: in the file; else inferred from its boxes.
    """
    step = int(np.gcd.reduce(np.diff(looked))) if len(looked) > 1 else 0
    which = f"1 frame in {step}" if step > 1 and len(looked) > 2 else f"{len(looked)} frames only"
    return (
        f"{'lists' if listed else 'has boxes in'} {which} ({shortened(looked.tolist())}): the "
        "detector was not run on the others, which do not count as empty frames"
    )
