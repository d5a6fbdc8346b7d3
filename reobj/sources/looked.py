"""Which frames a detector was run on, where nobody says so.

A frame that was not looked at is no frame in which nothing was found: no track may count it as
missed. Of a frame without a box only the frames with boxes can tell which of the two it is.
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
    """Intervals of the frames with boxes, and what follows for those without.

    Attributes:
        first, last: frame with boxes. count: of such frames. step: greatest common divisor of their
            intervals. apart: intervals above 1. boxes: in all frames.
    """

    first: int = 0
    last: int = 0
    count: int = 0
    step: int = 0
    apart: int = 0
    boxes: int = 0

    def add(self, frame: int, boxes: int) -> None:
        """Count the next frame with boxes."""
        if self.count:
            self.step = math.gcd(self.step, frame - self.last)
            self.apart += frame - self.last > 1
        else:
            self.first = frame
        self.last = frame
        self.count = self.count + 1
        self.boxes = self.boxes + boxes

    def looked_at(self, frame: int) -> bool:
        """Tell whether the detector was run on a frame without a box."""
        if self.count > 2 and self.step > 1:
            return (frame - self.first) % self.step == 0
        return not self.irregular

    @property
    def irregular(self) -> bool:
        """True where frames without a box were not looked at, though there is no regular interval.

        Most frames with a box are not followed by another, and the number of boxes in a frame
        leaves few frames without any by chance: fewer than half of the frames were looked at.
        """
        if self.count < 2 or self.step > 1 or 2 * self.apart <= self.count - 1:
            return False
        looked = self.count / _share_with_boxes(self.boxes / self.count)
        return 2 * looked < self.last - self.first + 1


def frames_looked_at(frame: IntArray, frame_count: int) -> IntArray | None:
    """Infer the frames that a detector was run on from the frames of all its boxes.

    Args:
        frame: (N,) of each box. frame_count: of the video, 0: unknown.
    Returns:
        frame numbers, ascending; None: all frames of the video.
    """
    seen, boxes = np.unique(frame[frame >= 0], return_counts=True)
    known = Intervals()
    for at, count in zip(seen.tolist(), boxes.tolist(), strict=True):
        known.add(at, count)
    if known.count > 2 and known.step > 1:
        end = max(frame_count, known.last + 1)
        return np.arange(known.first % known.step, end, known.step)
    return seen if known.irregular else None


def _share_with_boxes(mean: float) -> float:
    """Return the share of frames that have a box, from the mean number of boxes of those that do.

    Boxes are Poisson distributed over the frames: mean = rate / (1 - exp(-rate)).
    """
    if mean < 1 + 1e-6:  # one box in each: any number of frames may have none
        return 1e-9
    rate = brentq(lambda x: x / -math.expm1(-x) - mean, 1e-9, mean)
    return -math.expm1(-float(rate))


def looked_message(looked: IntArray, listed: bool) -> str:
    """Say which frames count as looked at, and what that means.

    Args:
        looked: frame numbers, ascending. listed: in the file; else inferred from its boxes.
    """
    step = int(np.gcd.reduce(np.diff(looked))) if len(looked) > 1 else 0
    which = f"1 frame in {step}" if step > 1 and len(looked) > 2 else f"{len(looked)} frames only"
    return (
        f"{'lists' if listed else 'has boxes in'} {which} ({shortened(looked.tolist())}): the "
        "others count as not looked at, not as frames with nothing in them"
    )
