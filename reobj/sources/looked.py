"""Frames on which a detector was run, from the frames with boxes: all, or every n-th.

Tracks must not count frames that the detector skipped as missed detections. `looked` in the code:
frames on which the detector was run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from reobj.files import shortened
from reobj.types import IntArray


@dataclass(slots=True)
class Intervals:
    """Intervals of the frames with boxes so far.

    Attributes:
        first, last: frame with boxes. count: of such frames. step: greatest common divisor of their
            intervals.
    """

    first: int = 0
    last: int = 0
    count: int = 0
    step: int = 0

    def add(self, frame: int) -> None:
        """Add the next frame with boxes."""
        if self.count:
            self.step = math.gcd(self.step, frame - self.last)
        else:
            self.first = frame
        self.last = frame
        self.count = self.count + 1

    def looked_at(self, frame: int) -> bool:
        """Return whether the detector was run on a frame without boxes."""
        return self.count < 3 or self.step < 2 or (frame - self.first) % self.step == 0


def frames_looked_at(frame: IntArray, frame_count: int) -> IntArray | None:
    """Return the frames on which a detector was run: every n-th if all boxes are in such frames.

    Args:
        frame: (N,) of each box. frame_count: of the video, 0: unknown.
    Returns:
        frame numbers, ascending; None: all frames of the video.
    """
    seen = np.unique(frame[frame >= 0])
    step = int(np.gcd.reduce(np.diff(seen))) if len(seen) > 2 else 1
    end = max(frame_count, int(seen.max(initial=-1)) + 1)
    return np.arange(seen[0] % step, end, step) if step > 1 else None


def looked_message(looked: IntArray, listed: bool) -> str:
    """Return the message about the frames on which the detector was run.

    Args:
        looked: frame numbers, ascending. listed: in the file; else inferred from its boxes.
    """
    step = int(np.gcd.reduce(np.diff(looked))) if len(looked) > 2 else 1
    which = f"1 frame in {step}" if step > 1 else f"{len(looked)} frames only"
    return (
        f"{'lists' if listed else 'has boxes in'} {which} ({shortened(looked.tolist())}): the "
        "detector was not run on the others, which do not count as empty frames"
    )
