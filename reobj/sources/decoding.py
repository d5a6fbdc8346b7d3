"""Decode video files, streams, cameras and animated images; make the times of frames increase.

Start at `open_file`. PyAV reads everything but cameras (OpenCV) and animated images (Pillow).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from PIL import Image as PillowImage

from reobj.runtime import quiet_opencv
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


def open_camera(number: int) -> Opened:
    """Open a camera."""
    with quiet_opencv():
        capture = cv2.VideoCapture(number)
    if not capture.isOpened():
        raise ReobjError("cannot be opened as a camera (is it connected?)")
    return Opened(_camera_frames(capture), fps=capture.get(cv2.CAP_PROP_FPS))


def _camera_frames(capture: Any) -> Generator[Decoded]:
    try:
        while True:
            ok, image = capture.read()
            yield Decoded(image=partial(np.asarray, image)) if ok else Decoded()
    finally:
        capture.release()


def open_animation(path: Path) -> Opened:
    """Open an animated image file, whose header can be read."""
    return Opened(_animation_frames(path), path.suffix)


def _animation_frames(path: Path) -> Generator[Decoded]:
    milliseconds = 0.0
    with PillowImage.open(path) as image:
        for k in range(getattr(image, "n_frames", 1)):
            try:
                image.seek(k)
                bgr = np.asarray(image.convert("RGB"))[..., ::-1]
            except (OSError, ValueError, EOFError):
                yield Decoded()
                continue
            yield Decoded(milliseconds / 1000, partial(np.ascontiguousarray, bgr))
            milliseconds += image.info.get("duration", 0)


def _open_container(address: str, timeout_s: float | None) -> tuple[Any, Any]:
    """Open a container and its first video stream that is no cover picture.

    Raises:
        ReobjError: no container, no such stream, or no decoder. The source is not named.
    """
    import av

    try:  # tags in other encodings than UTF-8 are no error
        options = {"rtsp_flags": "prefer_tcp"}
        file = av.open(address, options=options, timeout=timeout_s, metadata_errors="replace")
    except (av.FFmpegError, OSError, ValueError) as error:
        late = isinstance(error, av.error.ExitError)
        reason = "no answer in time" if late else getattr(error, "strerror", "") or error
        raise ReobjError(f"cannot be opened as a video ({reason})") from None
    cover = av.stream.Disposition.attached_pic
    streams = [stream for stream in file.streams.video if not stream.disposition & cover]
    if streams and streams[0].codec_context is not None:
        return file, streams[0]
    fault = "no video in it" + "; its cover picture is none" * bool(file.streams.video)
    file.close()
    decoder = "its codec cannot be decoded here; convert it (ffmpeg -i IN OUT.mp4)"
    raise ReobjError(decoder if streams else fault)


def open_file(address: str, timeout_s: float | None = None) -> Opened:
    """Open a video file, or with `timeout_s` the URL of a stream or file.

    Raises:
        ReobjError: as `_open_container` does.
    """
    file, stream = _open_container(address, timeout_s)
    fps = float(stream.guessed_rate or 0)
    duration_s = float((stream.duration or 0) * stream.time_base) or (file.duration or 0) / 1e6
    count = stream.frames or round(duration_s * fps)
    # Several frames at a time delay those of a live stream
    stream.thread_type = "AUTO" if count or timeout_s is None else "SLICE"
    aspect = stream.sample_aspect_ratio or Fraction(1)
    pixels = stream.width * stream.height
    return Opened(_file_frames(file, stream), stream.name, pixels, fps, count, aspect)


def _packets(file: Any, streams: Any) -> Iterator[Any]:
    """Read the packets of a container, across damaged places."""
    import av

    for _ in range(64):  # places; each missing packet at the end of an MP4 file is one
        try:
            yield from file.demux(*streams)
        except av.error.ExitError:  # timeout
            return
        except av.FFmpegError:
            continue
        return


def _stamp_s(item: Any) -> float:
    """Return the time of a packet or frame in s, NaN: none."""
    at = item.dts if item.pts is None else item.pts
    return math.nan if at is None else float(at * item.time_base)


def _is_cut(packet: Any, file: Any) -> bool:
    """Test whether the file ends within a packet."""
    return bool(packet.is_corrupt and (packet.pos or 0) + packet.size == file.size)


def _file_frames(file: Any, stream: Any) -> Generator[Decoded]:
    import av

    reformatter = av.video.reformatter.VideoReformatter()
    start_s = float((stream.start_time or 0) * stream.time_base)
    with file:
        for packet in itertools.chain(_packets(file, [stream]), [None]):  # None: no more packets
            if packet is not None and _is_cut(packet, file):
                continue  # after an error PyAV returns no more frames of other threads
            try:
                frames = stream.decode(packet)
            except av.FFmpegError:
                yield Decoded()
                continue
            for frame in frames:
                image = partial(_bgr, reformatter, frame)
                yield Decoded(_stamp_s(frame) - start_s, image, frame.rotation)


def _bgr(reformatter: Any, frame: Any) -> Image:
    """Convert a frame to BGR, upright by the rotation in its metadata."""
    # Bicubic: the pixels are those of OpenCV's VideoCapture
    image = reformatter.reformat(frame, format="bgr24", interpolation="BICUBIC").to_ndarray()
    turns = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}
    turn = turns.get(frame.rotation % 360)
    return np.asarray(image if turn is None else cv2.rotate(image, turn), np.uint8)


@dataclass(frozen=True, slots=True)
class Stored:
    """What can be read of a file without decoding: number and last time of its frames; a fault."""

    count: int = 0
    last_s: float = 0.0
    fault: str = ""


def stored_in(path: str) -> Stored:
    """Read the packets of a file."""
    file, video = _open_container(path, None)
    start_s = float((video.start_time or 0) * video.time_base)
    count = size = 0
    last_s = end_s = 0.0
    is_cut = False
    with file:
        for packet in _packets(file, file.streams):
            is_cut = is_cut or _is_cut(packet, file)
            if not packet.size or is_cut:
                continue
            size += packet.size
            at_s = _stamp_s(packet)
            duration_s = float((packet.duration or 0) * packet.time_base)
            end_s = max(end_s, at_s + duration_s)
            if packet.stream.index == video.index:
                count += 1
                last_s = max(last_s, at_s - start_s)
        announced_s = (file.duration or 0) / 1e6
        unread = file.size - size  # Matroska holds little beside packets: an index, tags
        if file.format.name.startswith("matroska") and unread > max(size, 1 << 14):
            fault = f"is damaged, {size} of its {file.size} bytes are readable"
            return Stored(count, last_s, fault)
    # Containers announce the end of the last frame, or its time
    if is_cut or announced_s - end_s > max(0.02 * end_s, 2 * end_s / max(count, 1)):
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
