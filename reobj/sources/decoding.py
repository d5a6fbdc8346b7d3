"""Decode video files, streams, cameras and animated images; make the times of frames increase.

Start at `open_file`. PyAV reads everything but cameras (OpenCV) and animated images (Pillow).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from PIL import Image as PillowImage
from PIL import ImageSequence

from reobj.files import quiet_opencv
from reobj.types import Array, Image, ReobjError


class Decoded(NamedTuple):
    """A frame: time in s (NaN: none), its image in BGR (None: undecodable, or not yet there).

    turned: rotation by metadata of the upright image against the stored one, deg anticlockwise.
    """

    time_s: float = math.nan
    image: Callable[[], Image] | None = None
    turned: int = 0


@dataclass(frozen=True, slots=True)
class Opened:
    """An opened source.

    Attributes:
        frames: in the order of their display. codec: name.
        fps, count, duration_s: declared rate in Hz, number of frames and length in s; 0: unknown.
        pixel_aspect: width over height of a stored pixel.
    """

    frames: Generator[Decoded]
    codec: str = ""
    fps: float = 0.0
    count: int = 0
    duration_s: float = 0.0
    pixel_aspect: Fraction = Fraction(1)


def open_camera(number: int, silent_s: float) -> Opened:
    """Open a camera, which ends after `silent_s` without a frame."""
    with quiet_opencv():
        capture = cv2.VideoCapture(number)
    if not capture.isOpened():
        raise ReobjError("cannot be opened as a camera (is it connected?)")
    return Opened(_camera_frames(capture, silent_s), fps=capture.get(cv2.CAP_PROP_FPS))


def _camera_frames(capture: Any, silent_s: float) -> Generator[Decoded]:
    last_s = time.monotonic()
    try:
        while time.monotonic() - last_s < silent_s:
            ok, image = capture.read()
            if not ok:
                time.sleep(0.01)
                continue
            last_s = time.monotonic()
            yield Decoded(image=partial(np.asarray, image))
    finally:
        capture.release()


def open_animation(path: Path) -> Opened:
    """Open an animated image file, whose header can be read."""
    return Opened(_animation_frames(path), path.suffix)


def _animation_frames(path: Path) -> Generator[Decoded]:
    milliseconds = 0.0
    with PillowImage.open(path) as image:
        for frame in ImageSequence.Iterator(image):
            try:
                bgr = np.asarray(frame.convert("RGB"))[..., ::-1]
            except (OSError, ValueError):
                yield Decoded()
                continue
            yield Decoded(milliseconds / 1000, partial(np.ascontiguousarray, bgr))
            milliseconds += frame.info.get("duration", 0)


def open_file(address: str, open_s: float | None = None, read_s: float | None = None) -> Opened:
    """Open a video file, or with time limits the URL of a stream or file.

    Raises:
        ReobjError: no container, no video stream in it, or no decoder. The source is not named.
    """
    import av

    try:  # tags in other encodings than UTF-8 are no error
        options = {"rtsp_flags": "prefer_tcp"}
        timeout = (open_s, read_s) if open_s else None
        file = av.open(address, options=options, timeout=timeout, metadata_errors="replace")
    except (av.FFmpegError, OSError, ValueError) as error:
        late = isinstance(error, av.error.ExitError)
        reason = "no answer in time" if late else getattr(error, "strerror", "") or error
        raise ReobjError(f"cannot be opened as a video ({reason})") from None
    cover = av.stream.Disposition.attached_pic
    stream = next((s for s in file.streams.video if not s.disposition & cover), None)
    if stream is None or stream.codec_context is None:
        file.close()
        codec = "its codec cannot be decoded here; convert it (ffmpeg -i IN OUT.mp4)"
        raise ReobjError("no video in it" if stream is None else codec)
    fps = float(stream.guessed_rate or 0)
    duration_s = float((stream.duration or 0) * stream.time_base)
    if not duration_s and len(file.streams) == 1:  # else it may be that of the sound
        duration_s = (file.duration or 0) / 1e6 - (file.start_time or 0) / 1e6
    count = stream.frames or round((duration_s or (file.duration or 0) / 1e6) * fps)
    # Several frames at a time delay those of a live stream
    stream.thread_type = "AUTO" if count or not open_s else "SLICE"
    aspect = stream.sample_aspect_ratio or Fraction(1)
    return Opened(_file_frames(file, stream), stream.name, fps, count, duration_s, aspect)


def _packets(file: Any, stream: Any) -> Iterator[Any]:
    """Read the packets of a stream up to its end or a time limit, across damaged places."""
    import av

    for _ in range(64):  # places
        try:
            yield from file.demux(stream)
        except av.error.ExitError:  # time limit
            break
        except av.FFmpegError:
            continue
        break
    yield None  # returns the frames that the decoder holds


def packet_count(path: str) -> int:
    """Count the packets of the video stream of a file: its frames."""
    import av

    with av.open(path, metadata_errors="replace") as file:
        return sum(1 for packet in _packets(file, file.streams.video[0]) if packet and packet.size)


def _file_frames(file: Any, stream: Any) -> Generator[Decoded]:
    import av

    reformatter = av.video.reformatter.VideoReformatter()
    start_s = float((stream.start_time or 0) * stream.time_base)
    with file:
        for packet in _packets(file, stream):
            try:
                frames = stream.decode(packet)
            except av.EOFError:  # the decoder has returned all frames
                return
            except av.FFmpegError:
                yield Decoded()
                continue
            for frame in frames:
                at = frame.dts if frame.pts is None else frame.pts
                time_s = math.nan if at is None else float(at * stream.time_base) - start_s
                yield Decoded(time_s, partial(_bgr, reformatter, frame), frame.rotation)


def _bgr(reformatter: Any, frame: Any) -> Image:
    """Convert a frame to BGR, upright by the rotation in its metadata."""
    # Bicubic: the pixels are those of OpenCV's VideoCapture
    image = reformatter.reformat(frame, format="bgr24", interpolation="BICUBIC").to_ndarray()
    quarters = round(frame.rotation / 90) % 4  # anticlockwise; OpenCV's codes count clockwise
    return np.asarray(cv2.rotate(image, 3 - quarters) if quarters else image, np.uint8)


def settled_times(raw_s: Array, step_s: float) -> tuple[Array, int, bool]:
    """Make the times of frames (F,) strictly increasing.

    Where the clock restarts (concatenated recordings), times continue one step after the frame
    before. Other times that do not increase are interpolated. Times before the first one that does
    not increase are unchanged.

    Args:
        raw_s: times in the container, NaN: none. step_s: interval of frames without times.
    Returns:
        times (F,) in s, number of restarts of the clock, and whether the container has times.
    """
    restart_steps = 3.0  # backward, in usual steps; less is a wrong or coarse time stamp
    count = len(raw_s)
    known = np.flatnonzero(np.isfinite(raw_s))
    if len(known) < 2 or np.ptp(raw_s[known]) == 0:
        return np.arange(0.0, count) * step_s, 0, count < 2 and len(known) == count
    time_s: Array = np.interp(np.arange(count), known, raw_s[known])  # (F,)
    steps = np.diff(time_s)  # (F - 1,)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else step_s
    restarts = steps < -restart_steps * step
    time_s[1:] += np.cumsum(np.where(restarts, step - steps, 0))
    highest = np.maximum.accumulate(time_s)
    rising = np.flatnonzero(np.r_[True, time_s[1:] > highest[:-1]])
    if len(rising) < count:
        end_s = time_s[rising[-1]] + step * (count - rising[-1])
        time_s = np.interp(np.arange(count), [*rising, count], [*time_s[rising], end_s])
    return time_s, int(restarts.sum()), True
