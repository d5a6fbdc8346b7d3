"""Keyframes of a video: by optical flow, or along supplied poses; their images in a file.

`follow_points` (Lucas-Kanade) is shared with `localize`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reobj.cameras import Poses, invert_rigid
from reobj.files import Progress, writing
from reobj.sources.video import shrunk
from reobj.types import Array, BoolArray, Image, IntArray


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
        """False for an image without points to track, such as a black one."""
        return len(_corners(self.gray)) >= 20


class ImageFile:
    """Images (h, w, 3) of one size in a file, by number; one at a time is in memory.

    Attributes:
        path: of the file, which holds the pixels of one image after the other.
        shape: (h, w, 3); () before the first image. slots: place in the file by number.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.shape: tuple[int, ...] = ()
        self.slots: dict[int, int] = {}

    def __getitem__(self, number: int) -> Image:
        size = math.prod(self.shape)
        pixels = np.fromfile(self.path, np.uint8, size, offset=self.slots[number] * size)
        return pixels.reshape(self.shape)

    def add(self, number: int, image: Image) -> None:
        """Write an image at the end of the file, unless it is in it."""
        if number in self.slots:
            return
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "ab" if self.slots else "wb") as file:
                file.write(np.ascontiguousarray(image).data)
        self.shape = image.shape
        self.slots[number] = len(self.slots)


def _square(image: Image, aspect: float) -> Image:
    """Stretch an image so that pixels of this aspect ratio (width over height) become square."""
    if aspect == 1:
        return image
    height, width = image.shape[:2]
    size = (round(width * max(aspect, 1)), round(height / min(aspect, 1)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)


class ResizedVideo:
    """A video whose frames have square pixels and a longer side of at most `size_px`.

    Args:
        cache_mb: of gray images kept in memory: 650 of 640x480.
    Attributes:
        frames, times_s: numbers and times of the frames, known after `first_pass`.
    """

    def __init__(self, video: Any, size_px: int, cache_mb: float = 200) -> None:
        self.video = video
        self.size_px = size_px
        self.cache_mb = cache_mb
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

    def shown(self, line: Progress) -> Iterator[ResizedFrame]:
        """Iterate with a line of progress."""
        for frame in self:
            line.step()
            yield frame
        line.close()

    def first_pass(self, line: Progress) -> Iterator[ResizedFrame]:
        """Iterate, and keep numbers, times and (if they fit) the gray images."""
        for frame in self.shown(line):
            self.frames.append(frame.frame)
            self.times_s.append(frame.time_s)
            self.used_mb += frame.gray.nbytes / 1e6
            self.cache = [] if self.used_mb > self.cache_mb else self.cache
            self.cache.append(frame.gray)
            yield frame

    def grays(self) -> Iterator[Image]:
        """Iterate over the gray images again: from memory, or by reading the video again."""
        kept = len(self.cache) == len(self.frames)
        return iter(self.cache) if kept else (frame.gray for frame in self)


def follow_points(
    old: Image, new: Image, xy: Array, and_back: bool = True
) -> tuple[Array, BoolArray]:
    """Track points into the next image by Lucas-Kanade.

    Args:
        old, new: (h, w) gray. xy: (N, 2) in `old`, OpenCV pixels (centre of the first: 0, 0).
        and_back: require a forward-backward error below 1 px (Kalal et al., ICPR 2010).
    Returns:
        xy: (N, 2) in `new`. kept: (N,) True for points that were tracked.
    """
    if not len(xy):
        return xy, np.zeros(0, bool)
    start = xy.astype(np.float32).reshape(-1, 1, 2)
    window = (15, 15)  # px; OpenCV's default: 21
    flow: Any = cv2.calcOpticalFlowPyrLK
    ahead, found, _ = flow(old, new, start, None, winSize=window)
    kept = found[:, 0] > 0
    if and_back:
        back, found_back, _ = flow(new, old, ahead, None, winSize=window)
        error = np.linalg.norm(back - start, axis=2)[:, 0]  # (N,)
        kept &= (found_back[:, 0] > 0) & (error < 1)
    return ahead[:, 0].astype(np.float64), kept


def _sharpness(gray: Image) -> float:
    """Return the variance of the Laplacian of a gray image."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def _corners(gray: Image) -> Array:
    """Find the corners (N, 2) of an image that can be tracked: 150, as 300 were no better."""
    found = cv2.goodFeaturesToTrack(gray, 150, qualityLevel=0.01, minDistance=max(gray.shape) / 80)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


class _KeyframeFlow:
    """Optical flow since a keyframe: its corners, tracked from frame to frame."""

    def __init__(self, key: ResizedFrame) -> None:
        self.row = key.row
        self.gray = key.gray
        self.start = self.corners = _corners(key.gray)  # (N, 2) in the keyframe, the last frame
        self.count = max(len(self.start), 1)

    def update(self, frame: ResizedFrame) -> tuple[float, float] | None:
        """Track the corners into the next frame.

        Returns:
            the median flow since the keyframe over the image's width, and the fraction of the
            corners that is left. None for a frame without texture: the next one is compared with
            the last that had some.
        """
        ahead, kept = follow_points(self.gray, frame.gray, self.corners)
        if kept.sum() < MIN_LEFT * self.count and not frame.has_texture:
            return None
        self.start = self.start[kept]
        self.corners = ahead[kept]
        self.gray = frame.gray
        flow = np.linalg.norm(self.corners - self.start, axis=1)
        left = len(flow) / self.count
        return float(np.median(flow)) / frame.gray.shape[1] if kept.any() else 0.0, left


MIN_KEYFRAMES = 40  # with fewer the steps are halved: wider ones may not be matched
# Median flow since the last keyframe, over the width; a lower limit gives more keyframes
MAX_FLOW = 0.12
MIN_FLOW = 0.015  # that counts as motion, over the width: 10 px of 640
# Fraction of the last keyframe's corners that can still be tracked: a higher limit gives more
# keyframes where the scene changes quickly
MIN_LEFT = 0.55
MAX_INTERVAL = 60  # frames after which any motion makes a keyframe: 2 s at 30 Hz


def pick_keyframes(
    frames: Iterable[ResizedFrame],
    max_keyframes: int,
    max_flow: float = MAX_FLOW,
    keep: Callable[[ResizedFrame], None] = lambda frame: None,
) -> list[int]:
    """Choose keyframes by optical flow, the sharpest near the threshold, with the first and last.

    When there are more than `max_keyframes`, every second one is dropped and the thresholds double:
    one pass, bounded memory, reproducible. An image without texture (black, white) is no keyframe:
    nothing in it can be matched.

    Args:
        max_flow: threshold, as MAX_FLOW. keep: stores the image of each selected frame.
    Returns:
        rows of the keyframes, ascending.
    """
    keys: list[int] = []
    replay: deque[ResizedFrame] = deque()  # frames after a keyframe that were read already
    window: list[ResizedFrame] = []  # frames near the threshold
    stream = iter(frames)
    last: ResizedFrame | None = None
    track: _KeyframeFlow | None = None
    wider = 1
    flow = 0.0
    while (frame := replay.popleft() if replay else next(stream, None)) is not None:
        if track is None:
            if frame.has_texture:
                keep(frame)
                keys = [frame.row]
                track = _KeyframeFlow(frame)
                last = frame
            continue
        if (update := track.update(frame)) is None:
            continue
        last = frame
        flow, left = update
        if flow >= 0.7 * wider * max_flow:  # near the threshold: the sharpest is kept
            window.append(frame)
        late = frame.row - track.row >= wider * MAX_INTERVAL and flow > MIN_FLOW
        if late or flow > wider * max_flow or left < MIN_LEFT**wider:
            best = max(window or [frame], key=lambda f: _sharpness(f.gray))
            replay.extendleft(f for f in reversed(window) if f.row > best.row)
            keep(best)
            keys.append(best.row)
            if len(keys) > max_keyframes:
                keys = keys[::2]
                wider *= 2
            window = []
            track = _KeyframeFlow(best)
    moved = flow > MIN_FLOW or len(keys) == 1
    if last is None or last.row == keys[-1] or not moved:
        return keys
    keep(last)
    return [*keys[: max(max_keyframes - 1, 1)], last.row]


# ---- Keyframes of supplied poses -----------------------------------------------------------------


TURN_DEG = 8.0  # rotation between keyframes: an eighth of a usual field of view
SPREAD_STEP = 1 / 8  # translation between them, over the spread: 7 deg of an orbit


def path_steps(poses: Poses) -> Array:
    """Express poses as coordinates (F, 6) in which keyframes are 1 apart; NaN: no pose.

    The first three are the viewing direction, the others the camera's centre. Translations are
    relative to the path's rms spread, whatever the scale.
    """
    world_from_cam = invert_rigid(poses.cam_from_world)  # (F, 3, 4)
    centre = world_from_cam[:, :, 3]
    spread = np.sqrt(np.nanvar(centre, axis=0).sum()) if poses.known.any() else 0.0
    # for small angles the distance on the unit sphere is the angle
    turn = world_from_cam[:, :, 2] / np.radians(TURN_DEG)
    return np.column_stack([turn, centre / max(SPREAD_STEP * spread, 1e-12)])


def choose_posed_keyframes(steps: Array) -> IntArray:
    """Choose keyframes along supplied poses: each one step (or a multiple of it) from the last.

    Args:
        steps: (F, 6) of `path_steps`.
    Returns:
        rows, ascending; MIN_KEYFRAMES to 150 of them (more take long), or all frames if fewer.
    """
    rows = np.flatnonzero(np.isfinite(steps).all(1))
    length = 1.0
    while len(chosen := _rows_apart(steps, rows, length)) < min(MIN_KEYFRAMES, len(rows)):
        if length <= 1e-6:
            break
        length /= 2
    while len(chosen) > 150:
        length *= 1.1
        chosen = _rows_apart(steps, rows, length)
    return chosen


def _rows_apart(steps: Array, rows: IntArray, length: float) -> IntArray:
    """Choose rows at least `length` from the last one selected."""
    chosen = rows[:1].tolist()
    for row in rows[1:].tolist():
        if np.linalg.norm(steps[row] - steps[chosen[-1]]) >= length:
            chosen.append(row)
    return np.array(chosen, np.int64)


def sharpest_images(
    poses: Poses, video: Any, keys: IntArray, size_px: int, line: Progress
) -> dict[int, Image]:
    """Read the sharpest image near each keyframe, within a quarter of the way to its neighbours.

    Returns:
        image by row of the poses, shrunk; none where there are no images.
    """
    nearest: dict[int, int] = {}  # keyframe of each row that may replace it
    for before, key, after in zip([-1, *keys], keys, [*keys[1:], len(poses.frame)], strict=False):
        for row in range(key - (key - before) // 4, key + (after - key) // 4 + 1):
            if poses.known[row]:
                nearest[row] = int(key)
    row_of = {frame: row for row, frame in enumerate(poses.frame.tolist())}
    best: dict[int, tuple[float, int, Image]] = {}
    for frame in video if len(keys) else ():
        line.step()
        key = nearest.get(row_of.get(frame.index, -1), -1)
        if key < 0 or frame.image is None:
            continue
        image = shrunk(frame.image, size_px)
        sharpness = _sharpness(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
        if key not in best or sharpness > best[key][0]:
            best[key] = (sharpness, row_of[frame.index], image)
    line.close()
    return {row: image for _, row, image in best.values()}
