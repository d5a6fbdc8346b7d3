"""Keyframes of a video by optical flow, and the points that are followed from frame to frame.

A keyframe is taken where the picture has moved far enough from the last one that a reconstruction
learns from it. `follow_points` (Lucas-Kanade) is shared with `localize`. Nothing here knows of
cameras in 3D.
"""

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

CACHE_MB = 1000.0  # of gray images kept in memory: 3200 of 640x480 (chosen)


@dataclass(frozen=True, slots=True)
class ResizedFrame:
    """One frame, resized for the pose step.

    Attributes:
        row: 0, 1, ... in the order of reading: its row in `Poses`. frame: number in the source.
        bgr: (h, w, 3). gray: (h, w).
    """

    row: int
    frame: int
    time_s: float
    bgr: Image
    gray: Image

    @property
    def has_texture(self) -> bool:
        """False for a picture in which nothing can be followed, such as a black one."""
        return len(_corners(self.gray)) >= MIN_CORNERS


def _square(image: Image, aspect: float) -> Image:
    """Widen an image, or heighten it, so that pixels of this width over height become square."""
    if aspect == 1:
        return image
    height, width = image.shape[:2]
    size = (round(width * max(aspect, 1)), round(height / min(aspect, 1)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)


class ResizedVideo:
    """A video whose frames have square pixels and a longer side of at most `size_px`.

    Attributes:
        frames, times_s: numbers and times of the frames, known after `first_pass`.
    """

    def __init__(self, video: Any, size_px: int, cache_mb: float = CACHE_MB) -> None:
        self.video, self.size_px, self.cache_mb = video, size_px, cache_mb
        self.aspect = float(getattr(video, "pixel_aspect", 1.0))
        self.frames: list[int] = []
        self.times_s: list[float] = []
        self.cache: list[Image] = []
        self.used_mb = 0.0

    def __iter__(self) -> Iterator[ResizedFrame]:
        for row, frame in enumerate(self.video):
            bgr = shrunk(_square(frame.image, self.aspect), self.size_px)
            gray = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
            yield ResizedFrame(row, frame.index, frame.time_s, bgr, gray)

    def first_pass(self, line: Progress) -> Iterator[ResizedFrame]:
        """Iterate, and keep numbers, times and (as far as they fit) the gray images."""
        for frame in self:
            self.frames.append(frame.frame)
            self.times_s.append(frame.time_s)
            self.used_mb += frame.gray.nbytes / 1e6
            self.cache = [] if self.used_mb > self.cache_mb else self.cache
            self.cache.append(frame.gray)
            line.step()
            yield frame
        line.close()

    def grays(self) -> Iterator[Image]:
        """Iterate over the gray images once more: from memory, or reading the video again."""
        kept = self.used_mb <= self.cache_mb
        return iter(self.cache) if kept else (frame.gray for frame in self)


KLT_WINDOW_PX = 15  # side of the Lucas-Kanade window (chosen; OpenCV's default: 21)
KLT_ERROR_PX = 1.0  # largest forward-backward error (Kalal et al., ICPR 2010; chosen)


def follow_points(
    old: Image, new: Image, xy: Array, and_back: bool = True
) -> tuple[Array, BoolArray]:
    """Follow points into the next image by Lucas-Kanade.

    Args:
        old, new: (h, w) gray. xy: (N, 2) in `old`, OpenCV pixels (centre of the first: 0, 0).
        and_back: keep only points that come back to where they started.
    Returns:
        xy: (N, 2) in `new`. kept: (N,) True for points that were followed.
    """
    if not len(xy):
        return xy, np.zeros(0, bool)
    start, window = xy.astype(np.float32).reshape(-1, 1, 2), (KLT_WINDOW_PX,) * 2
    flow: Any = cv2.calcOpticalFlowPyrLK
    ahead, found, _ = flow(old, new, start, None, winSize=window)
    kept = found[:, 0] > 0
    if and_back:
        back, found_back, _ = flow(new, old, ahead, None, winSize=window)
        error = np.linalg.norm(back - start, axis=2)[:, 0]  # (N,)
        kept &= (found_back[:, 0] > 0) & (error < KLT_ERROR_PX)
    return ahead[:, 0].astype(np.float64), kept


CORNERS = 150  # followed from a keyframe (chosen: 300 were slower and no better)
CORNER_QUALITY = 0.01  # of the best corner's (OpenCV's usual value)
CORNER_SPACING = 1 / 80  # between two corners, over the longer side (chosen)
MIN_CORNERS = 20  # with fewer an image counts as textureless (chosen)


def _corners(gray: Image) -> Array:
    """Find the corners (N, 2) of an image that can be followed."""
    spacing = max(gray.shape) * CORNER_SPACING
    found = cv2.goodFeaturesToTrack(gray, CORNERS, CORNER_QUALITY, spacing)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


class _KeyframeFlow:
    """Optical flow since a keyframe: its corners, followed from frame to frame."""

    def __init__(self, key: ResizedFrame) -> None:
        self.row, self.gray = key.row, key.gray
        self.start = self.at = _corners(key.gray)  # (N, 2) there and in the last frame
        self.count = max(len(self.start), 1)

    def update(self, frame: ResizedFrame) -> tuple[float, float] | None:
        """Follow the corners into the next frame.

        Returns:
            the median flow since the keyframe over the image's width, and the share of the corners
            that is left. None for a frame without texture: the next one is compared with the last
            that had some.
        """
        ahead, kept = follow_points(self.gray, frame.gray, self.at)
        if kept.sum() < MIN_CORNERS_LEFT * self.count and not frame.has_texture:
            return None
        self.start, self.at, self.gray = self.start[kept], ahead[kept], frame.gray
        flow = np.linalg.norm(self.at - self.start, axis=1)
        share = len(flow) / self.count
        return float(np.median(flow)) / frame.gray.shape[1] if kept.any() else 0.0, share


MAX_FLOW = 0.12  # median flow that makes a keyframe, over the width (chosen)
MIN_FLOW = 0.015  # flow that counts as motion, over the width (chosen: 10 px of 640)
MIN_CORNERS_LEFT = 0.55  # share of the corners below which a new keyframe is due (chosen)
MAX_INTERVAL = 60  # frames after which any motion makes a keyframe (chosen: 2 s)
SHARP_WINDOW = 0.7  # share of the flow threshold from which on frames compete in sharpness (chosen)


def pick_keyframes(
    frames: Iterable[ResizedFrame], max_keyframes: int, max_flow: float = MAX_FLOW
) -> list[ResizedFrame]:
    """Choose keyframes by optical flow, the sharpest near the threshold, with the first and last.

    When there are more than `max_keyframes`, every second one is dropped and the thresholds double:
    one pass, bounded memory, the same choice every time. A picture without texture (black, white)
    is none: the reconstruction can do nothing with it, and it hides no motion.

    Args:
        max_flow: median flow since the last keyframe, over the width, that makes the next one.
    """
    keys: list[ResizedFrame] = []
    replay: deque[ResizedFrame] = deque()  # frames after a chosen one that were followed already
    window: list[ResizedFrame] = []  # frames near the threshold
    stream, last, track, wider, flow = iter(frames), None, None, 1, 0.0
    while (frame := replay.popleft() if replay else next(stream, None)) is not None:
        if track is None:
            if frame.has_texture:
                keys, track, last = [frame], _KeyframeFlow(frame), frame
            continue
        if (update := track.update(frame)) is None:
            continue
        last, (flow, left) = frame, update
        if flow >= SHARP_WINDOW * wider * max_flow:
            window.append(frame)
        late = frame.row - track.row >= wider * MAX_INTERVAL and flow > MIN_FLOW
        if late or flow > wider * max_flow or left < MIN_CORNERS_LEFT**wider:
            best = max(window or [frame], key=lambda f: cv2.Laplacian(f.gray, cv2.CV_32F).var())
            replay.extendleft(f for f in reversed(window) if f.row > best.row)
            keys.append(best)
            if len(keys) > max_keyframes:
                keys, wider = keys[::2], 2 * wider
            window, track = [], _KeyframeFlow(best)
    moved = flow > MIN_FLOW or len(keys) == 1
    if last is None or last.row == keys[-1].row or not moved:
        return keys
    return [*keys[: max(max_keyframes - 1, 1)], last]
