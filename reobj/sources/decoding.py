"""Decode video files, streams, cameras and animated images; make the times of frames increase.

Start at `open_file`. PyAV reads everything but cameras (OpenCV) and animated images (Pillow).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.stream import Disposition
from av.video.reformatter import VideoReformatter
from PIL import Image as PillowImage

from reobj.runtime import quiet_opencv
from reobj.types import Array, Image, ReobjError

Decoded = tuple[float, Any]  # time in s, NaN: none; frame of PyAV, None: undecodable, or none yet
TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}


@dataclass(frozen=True, slots=True)
class Opened:
    """An opened source.

    Attributes:
        frames: in the order of their display. codec: name. pixels: of a frame.
        fps, count: announced rate in Hz and number of frames; 0: unknown.
        pixel_aspect: width over height of a stored pixel.
    """

    frames: Generator[Decoded]
    codec: str = ""
    pixels: int = 0
    fps: float = 0.0
    count: int = 0
    pixel_aspect: Fraction = Fraction(1)
    _reformatter: Any = field(default_factory=VideoReformatter)

    def image(self, frame: Any) -> Image:
        """Convert a frame to BGR, upright by the rotation in its metadata."""
        # Bicubic: the pixels are those of OpenCV's VideoCapture
        bgr = self._reformatter.reformat(frame, format="bgr24", interpolation="BICUBIC")
        image = bgr.to_ndarray()
        turn = TURNS.get(frame.rotation % 360)
        return np.asarray(image if turn is None else cv2.rotate(image, turn), np.uint8)

    def close(self) -> None:
        """Free the camera or close the file."""
        self.frames.close()


def open_camera(number: int) -> Opened | None:
    """Open a camera; None if there is none."""
    with quiet_opencv():
        capture = cv2.VideoCapture(number)
    if not capture.isOpened():
        return None
    return Opened(_camera_frames(capture), fps=capture.get(cv2.CAP_PROP_FPS))


def _camera_frames(capture: Any) -> Generator[Decoded]:
    try:
        while True:
            ok, image = capture.read()
            yield math.nan, av.VideoFrame.from_ndarray(image, "bgr24") if ok else None
    finally:
        capture.release()


def open_animation(path: Path) -> Opened:
    """Open an animated image file."""
    with PillowImage.open(path) as image:
        return Opened(_animation_frames(path), pixels=math.prod(image.size))


def _animation_frames(path: Path) -> Generator[Decoded]:
    milliseconds = 0.0
    with PillowImage.open(path) as image:
        for k in range(getattr(image, "n_frames", 1)):
            try:
                image.seek(k)
                rgb = np.asarray(image.convert("RGB"))
            except (OSError, ValueError, EOFError):
                yield math.nan, None
                continue
            yield milliseconds / 1000, av.VideoFrame.from_ndarray(rgb, "rgb24")
            milliseconds += image.info.get("duration", 0)


def _open_container(address: str, timeout_s: float | None) -> tuple[Any, Any] | None:
    """Open a container and its first video stream that is no cover picture.

    Raises:
        ReobjError: there is no such stream, or no decoder. The source is not named.
    """
    try:  # tags in other encodings than UTF-8 are no error
        options = {"rtsp_flags": "prefer_tcp"}
        file = av.open(address, options=options, timeout=timeout_s, metadata_errors="replace")
    except (av.FFmpegError, OSError, ValueError):
        return None
    streams = [s for s in file.streams.video if not s.disposition & Disposition.attached_pic]
    if streams and streams[0].codec_context is not None:
        return file, streams[0]
    cover = "; its cover picture is none" if file.streams.video else ""
    file.close()
    if streams:
        raise ReobjError("its codec cannot be decoded here; convert it (ffmpeg -i IN OUT.mp4)")
    raise ReobjError(f"no video in it{cover}")


def open_file(address: str, timeout_s: float | None = None) -> Opened | None:
    """Open a video file, or with `timeout_s` the URL of a stream or file; None if it is no video.

    Raises:
        ReobjError: as `_open_container`.
    """
    if (found := _open_container(address, timeout_s)) is None:
        return None
    file, stream = found
    fps = float(stream.guessed_rate or 0)
    duration_s = float((stream.duration or 0) * stream.time_base) or _announced_s(file)
    count = stream.frames or round(duration_s * fps)
    # Several frames at a time delay those of a live stream
    stream.thread_type = "AUTO" if count or timeout_s is None else "SLICE"
    aspect = stream.sample_aspect_ratio or Fraction(1)
    pixels = stream.width * stream.height
    return Opened(_file_frames(file, stream), stream.name, pixels, fps, count, aspect)


def _announced_s(file: Any) -> float:
    return float((file.duration or 0) / av.time_base)


def _packets(file: Any, streams: Any) -> Iterator[Any]:
    """Read the packets of a container, across damaged places."""
    for _ in range(64):  # places; each missing packet at the end of an MP4 file is one
        try:
            yield from file.demux(*streams)
        except av.error.ExitError:  # timeout
            return
        except av.FFmpegError:
            continue
        return


def _stamp(item: Any) -> int | None:
    """Return the time of a packet or frame, in its time base."""
    at: int | None = item.dts if item.pts is None else item.pts
    return at


def _is_cut(packet: Any, file: Any) -> bool:
    """Test whether the file ends within a packet."""
    return bool(packet.is_corrupt and (packet.pos or 0) + packet.size == file.size)


def _file_frames(file: Any, stream: Any) -> Generator[Decoded]:
    start = stream.start_time or 0
    with file:
        for packet in itertools.chain(_packets(file, [stream]), [None]):  # None: no more packets
            if packet is not None and _is_cut(packet, file):
                continue  # after an error PyAV returns no more frames of other threads
            try:
                frames = stream.decode(packet)
            except av.FFmpegError:
                yield math.nan, None
                continue
            for frame in frames:
                at = _stamp(frame)
                yield math.nan if at is None else float((at - start) * frame.time_base), frame


@dataclass(frozen=True, slots=True)
class Stored:
    """What can be read of a file without decoding: number and last time of its frames; a fault."""

    count: int = 0
    last_s: float = 0.0
    fault: str = ""


def stored_in(path: str) -> Stored:
    """Read the packets of a file."""
    found = _open_container(path, None)
    assert found is not None
    file, video = found
    start_s = float((video.start_time or 0) * video.time_base)
    count = size = 0
    last_s = end_s = 0.0
    is_cut = False
    with file:
        total = file.size
        for packet in _packets(file, file.streams):
            if not packet.size:
                continue
            if _is_cut(packet, file):
                is_cut = True
                continue
            size += packet.size
            at_s = float((_stamp(packet) or 0) * packet.time_base)
            end_s = max(end_s, at_s + float((packet.duration or 0) * packet.time_base))
            if packet.stream.index == video.index:
                count += 1
                last_s = max(last_s, at_s - start_s)
        missing_s = _announced_s(file) - end_s
        unread = total - size  # Matroska holds little beside packets: an index, tags
        if file.format.name.startswith("matroska") and unread > max(size, 1 << 14):
            return Stored(count, last_s, f"is damaged, {size} of its {total} bytes are readable")
    # Containers announce the end of the last frame, or its time
    if is_cut or missing_s > max(0.02 * end_s, 2 * end_s / max(count, 1)):
        return Stored(count, last_s, "ends early")
    return Stored(count, last_s)


def settled_times(raw_s: Array, step_s: float) -> tuple[Array, int, bool]:
    """Make the times of frames (F,) strictly increasing.

    Single wrong or equal times are interpolated. Where the clock restarts (concatenated
    recordings), times continue one step after the frame before. Times before the first one that
    does not increase are unchanged.

    Args:
        raw_s: times in the container, NaN: none. step_s: interval of frames without times.
    Returns:
        times (F,) in s, number of restarts of the clock, and whether the container has times.
    """
    # Time from a backward step of the clock until it passes its last value, over what these frames
    # take at the usual rate: 1 after one wrong time stamp, less for repeated ones, near 0 where a
    # second recording begins. Below it the clock has restarted. Chosen: reached by five frames
    restart_share = 0.25
    count = len(raw_s)
    known = np.flatnonzero(np.isfinite(raw_s))
    if len(known) < 2 or np.ptp(raw_s[known]) == 0:
        return np.arange(0.0, count) * step_s, 0, count < 2 and len(known) == count
    time_s: Array = np.interp(np.arange(count), known, raw_s[known])
    steps = np.diff(raw_s[known]) / np.diff(known)
    restarts = 0
    at = 1
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else step_s
    while True:
        highest = np.maximum.accumulate(time_s[at - 1 :])
        back = np.flatnonzero(time_s[at:] <= highest[:-1])
        if not len(back):
            return time_s, restarts, True
        at += int(back[0])
        last = time_s[at - 1]
        later = np.flatnonzero(time_s[at:] > last)
        after = int(later[0]) if len(later) else 0  # number of frames that are not later
        if after and time_s[at + after] - last > restart_share * (after + 1) * step:
            time_s[at : at + after] = np.linspace(last, time_s[at + after], after + 2)[1:-1]
        else:
            time_s[at:] += last + step - time_s[at]
            restarts += after != 0 or count - at > 1 / restart_share
