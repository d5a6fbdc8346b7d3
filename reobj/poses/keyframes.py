"""Keyframes by optical flow."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from reobj.files import Progress
from reobj.sources.video import shrunk
from reobj.types import Array, BoolArray, Image

CACHE_MB = 1000  # gray images kept in memory; beyond it the video is read twice


@dataclass(frozen=True, slots=True)
class WorkImage:
    """One frame at working size: place in the video, source frame number, time, BGR, gray."""

    place: int
    frame: int
    time_s: float
    bgr: Image
    gray: Image


class WorkVideo:
    """A video at working size; gray images are kept up to `cache_mb`, else it is read again."""

    def __init__(self, video: Any, size_px: int) -> None:
        self.video, self.size_px, self.used_mb = video, size_px, 0.0
        self.frames: list[int] = []
        self.times: list[float] = []
        self.cache: list[Image] = []

    def __iter__(self) -> Iterator[WorkImage]:
        for place, frame in enumerate(self.video):
            bgr = shrunk(frame.image, self.size_px)
            gray = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
            yield WorkImage(place, frame.index, frame.time_s, bgr, gray)

    def first_pass(self, line: Progress) -> Iterator[WorkImage]:
        for work in self:
            self.frames.append(work.frame)
            self.times.append(work.time_s)
            self.used_mb += work.gray.nbytes / 1e6
            self.cache = [] if self.used_mb > CACHE_MB else self.cache
            self.cache.append(work.gray)
            line.step()
            yield work
        line.close()

    def grays(self) -> Iterator[Image]:
        kept = self.used_mb <= CACHE_MB
        return iter(self.cache) if kept else (work.gray for work in self)


KLT_WINDOW_PX = 15  # Lucas-Kanade window on the working image
KLT_ERROR_PX = 1.0  # forward-backward error of a followed point


def follow_points(old: Image, new: Image, xy: Array) -> tuple[Array, BoolArray]:
    """Follow points (N, 2) (OpenCV pixels) into the next image; kept: those that come back."""
    if not len(xy):
        return xy, np.zeros(0, bool)
    start, window = xy.astype(np.float32).reshape(-1, 1, 2), (KLT_WINDOW_PX,) * 2
    flow: Any = cv2.calcOpticalFlowPyrLK
    ahead, found, _ = flow(old, new, start, None, winSize=window)
    back, found_back, _ = flow(new, old, ahead, None, winSize=window)
    error = np.linalg.norm(back - start, axis=2)[:, 0]  # (N,)
    kept = (found[:, 0] > 0) & (found_back[:, 0] > 0) & (error < KLT_ERROR_PX)
    return ahead[:, 0].astype(np.float64), kept


CORNERS = 300  # corners followed to choose keyframes
MIN_CORNERS = 20  # with fewer corners a frame counts as textureless


class _FlowSinceKeyframe:
    """Corners of a keyframe followed from frame to frame."""

    def __init__(self, key: WorkImage) -> None:
        self.place, self.gray = key.place, key.gray
        self.start = self.at = self.corners(key.gray)
        self.count = len(self.start)

    def corners(self, gray: Image) -> Array:
        found = cv2.goodFeaturesToTrack(gray, CORNERS, 0.01, max(gray.shape) / 80)
        return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)

    def step(self, gray: Image) -> tuple[float, float]:
        """Follow into the next frame: median flow since the keyframe over the width, share left."""
        if self.count < MIN_CORNERS:  # textureless: a keyframe as soon as there is more
            return 0.0, float(len(self.corners(gray)) < MIN_CORNERS)
        ahead, kept = follow_points(self.gray, gray, self.at)
        self.start, self.at, self.gray = self.start[kept], ahead[kept], gray
        flow = np.linalg.norm(self.at - self.start, axis=1)
        return float(np.median(flow)) / gray.shape[1] if kept.any() else 0.0, len(flow) / self.count


MAX_FLOW = 0.12  # new keyframe at this median flow since the last, over the width
MIN_FLOW = 0.015  # share of the width that counts as motion
MIN_RATIO = 0.55  # new keyframe when fewer of the corners than this survive
MAX_INTERVAL = 60  # new keyframe after this many frames if the camera moved at all
SHARP_WINDOW = 0.7  # from this share of max_flow on the sharpest frame is taken


def pick_keyframes(
    works: Iterable[WorkImage], max_keyframes: int, max_flow: float = MAX_FLOW
) -> list[WorkImage]:
    """Choose keyframes by optical flow, the sharpest near the threshold, with the first and last.

    When there are more than `max_keyframes`, every second one is dropped and the spacing doubles:
    one pass, bounded memory, the same choice every time.
    """
    keys: list[WorkImage] = []
    again: deque[WorkImage] = deque()  # frames behind a chosen one, to be looked at again
    window: list[WorkImage] = []
    stream, work, track, wider, flow = iter(works), None, None, 1, 0.0
    while (following := again.popleft() if again else next(stream, None)) is not None:
        work = following
        if track is None:
            keys, track = [work], _FlowSinceKeyframe(work)
            continue
        flow, left = track.step(work.gray)
        if flow >= SHARP_WINDOW * wider * max_flow:
            window.append(work)
        late = work.place - track.place >= wider * MAX_INTERVAL and flow > MIN_FLOW
        if late or flow > wider * max_flow or left < MIN_RATIO**wider:
            best = max(window or [work], key=lambda w: cv2.Laplacian(w.gray, cv2.CV_32F).var())
            again.extendleft(w for w in reversed(window) if w.place > best.place)
            keys.append(best)
            if len(keys) > max_keyframes:
                keys, wider = keys[::2], 2 * wider
            window, track = [], _FlowSinceKeyframe(best)
    moved = flow > MIN_FLOW or len(keys) == 1
    return [*keys, work] if work is not None and work.place > keys[-1].place and moved else keys
