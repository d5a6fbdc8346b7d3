"""Overlay video for browsers: H.264 in MP4 where PyAV is installed, else VP8 in WebM by OpenCV.

OpenCV's wheel has no H.264 encoder, and browsers do not play the MPEG-4 that it writes into .mp4.
It has VP8, which needs three times the bytes per frame (so the video has a lower resolution and
frame rate), and VP9, which is slow.
PyAV rather than imageio-ffmpeg: frames are passed in memory, errors are exceptions instead of the
log of a child process, and `supervision` depends on it. Its wheels contain x264, which is GPL:
therefore an extra that the user installs, not a dependency.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2

from reobj.types import NOTE, Image, log


def import_av() -> Any:
    """Import PyAV; None if it is missing or has no H.264 encoder."""
    try:
        import av

        av.codec.Codec("h264", "w")
    except (ImportError, ValueError):  # PyAV's UnknownCodecError is a ValueError
        return None
    return av


class FilmWriter:
    """Write a video atomically: the file appears only when it is complete.

    Attributes:
        path: of the file, with the suffix of its format. part: of the incomplete file.
        size: (w, h) of the frames, even, as codecs require. count: frames so far.
        every: every n-th frame is written. repeat: number of copies of each.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        """Open a video of frames downscaled from (w, h) `size`; the suffix is replaced."""
        av = import_av()
        self.path = path.with_suffix(".webm" if av is None else ".mp4")
        # absolute: FFmpeg reads a folder 12:30/ as a protocol
        self.part = self.path.with_name(f".part-{self.path.name}").absolute()
        # Longest side, px: HD plays everywhere. OpenCV's encoder needs 1.5 bits a pixel: at 720 px
        # and 15 Hz 60 MB a minute.
        shrink = min(1.0, (720 if av is None else 1280) / max(size))
        self.every = 1 if av else max(math.ceil(fps / 15 - 1e-3), 1)  # 30.0001 fps is 30
        self.repeat = math.ceil(1 / fps)  # at least 1 Hz: a frame in WebM lasts at most 4 s
        # 16 px are a block of the codecs; OpenCV's VP8 fails below
        width, height = (max(int(side * shrink) // 2 * 2, 16) for side in size)
        self.size = (width, height)
        self.count = 0
        try:
            str(self.part).encode()
        except UnicodeEncodeError:  # OpenCV 5.0 would end the process
            where = ascii(str(self.part.parent))
            raise OSError(f"{where}: the overlay needs a folder whose name is UTF-8") from None
        with self._named(), contextlib.ExitStack() as stack:
            stack.callback(self.part.unlink, missing_ok=True)
            self.part.touch()  # PyAV would fail only at the first frame
            settings = (self.part, fps / self.every * self.repeat, self.size)
            self.sink = _VP8(*settings) if av is None else _H264(av, *settings)
            stack.pop_all()
        self.encoder = ThreadPoolExecutor(1)  # encodes a frame while the next one is drawn
        self.pending: Future[None] | None = None

    def write(self, image: Image) -> None:
        """Append one BGR frame of (w, h) `size`; the caller must not change it afterwards."""
        if self.count % self.every == 0:
            self._wait()
            self.pending = self.encoder.submit(self._encode, image)
        self.count += 1

    def _encode(self, image: Image) -> None:
        for _ in range(self.repeat):
            self.sink.write(image)

    def _wait(self) -> None:
        """Wait for the frame that is being encoded."""
        pending = self.pending
        self.pending = None
        if pending is not None:
            with self._named():
                pending.result()

    def close(self, complete: bool) -> None:
        """Finish the file; keep it only if complete (OpenCV is silent when the disk is full)."""
        try:
            with self._named() if complete else contextlib.suppress(OSError):
                try:
                    self._wait()
                finally:
                    self.encoder.shutdown()
                    self.sink.close()
            if complete and self._frames_on_disk() != self.repeat * -(-self.count // self.every):
                raise OSError(f"{self.path}: some frames could not be written; is the disk full?")
            if complete:
                self.part.replace(self.path)
                self._describe()
        finally:
            self.part.unlink(missing_ok=True)

    def _describe(self) -> None:
        """Log the size of the video, and what PyAV would improve."""
        width, height = self.size
        text = f"{self.path.name}: {width} x {height} px"
        if self.every > 1:
            text += f", 1 frame in {self.every}"
        if isinstance(self.sink, _VP8):
            text += "; with PyAV (pip install av): up to 1280 px, all frames, a third of the bytes"
        log.log(NOTE if isinstance(self.sink, _VP8) else logging.INFO, text)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """Add the path to errors of the encoder, which do not name it."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or error
            raise OSError(f"{self.path}: the overlay cannot be written ({reason})") from error

    def _frames_on_disk(self) -> int:
        capture = cv2.VideoCapture(str(self.part))
        return int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0


class _H264:
    """H.264 in MP4 by PyAV."""

    def __init__(self, av: Any, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.av = av
        rate = Fraction(fps).limit_denominator(1001)  # such as 30000/1001
        # faststart: the index comes first, so that a browser plays the file while loading it
        self.file = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        # x264's default quality; "superfast" needs half the time of "veryfast" and 1.3 times the
        # bytes. Without lookahead: with it, the same frames give different bytes every few runs
        # (PyAV 18.1, one thread, no B-frames).
        options = {
            "preset": "superfast",
            "crf": "23",
            "x264-params": "bframes=0:threads=1:rc-lookahead=0:mbtree=0",
        }
        self.stream = self.file.add_stream("h264", rate=rate, options=options)
        self.stream.width, self.stream.height = size
        self.stream.pix_fmt = "yuv420p"  # the only format that all browsers decode
        self.stream.gop_size = max(1, round(2 * fps))  # a player can seek every 2 s

    def write(self, image: Image) -> None:
        # Converted by OpenCV: FFmpeg's result depends on the memory alignment of the image
        planes = cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420)
        frame = self.av.VideoFrame.from_ndarray(planes, format="yuv420p")
        self.file.mux(self.stream.encode(frame))

    def close(self) -> None:
        try:
            self.file.mux(self.stream.encode())
        finally:
            self.file.close()


class _VP8:
    """VP8 in WebM by OpenCV; same input, same bytes.

    OpenCV passes no options to the encoder, and libvpx uses its fast mode (7 ms for a frame of
    480 x 360 instead of 40, .4 dB less) only for frames shown for a second or more
    (pick_quickcompress_mode in vp8_cx_iface.c). Frames are therefore written at 1 Hz, and the
    finished file gets the right clock.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.path = path
        self.fps = fps
        self.count = 0
        with _quiet():
            self.writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), 1.0, size)
        if not self.writer.isOpened():
            raise OSError("OpenCV cannot open it")

    def write(self, image: Image) -> None:
        self.writer.write(image)
        self.count += 1

    def close(self) -> None:
        self.writer.release()
        with contextlib.suppress(FileNotFoundError), self.path.open("r+b") as file:
            head = file.read(1 << 16)  # all before the first frame; FFmpeg writes under 1000 bytes
            file.seek(0)
            file.write(_with_clock(_with_fixed_uid(head), self.fps, self.count))


def _with_fixed_uid(webm: bytes) -> bytes:
    """Replace FFmpeg's random number of the track (TrackUID, and TagTrackUID in its tags).

    Ref: RFC 9559, 5.1.4.1.2: element 0x73C5, here of 8 bytes (size 0x88).
    """
    uid = re.search(rb"\x73\xc5\x88(.{8})", webm, re.DOTALL)
    return webm if uid is None else webm.replace(uid[1], b"\0\0\0\0\0\0\0\1")


def _with_clock(webm: bytes, fps: float, count: int) -> bytes:
    """Change the frame rate of a video from 1 Hz to `fps` by changing its time unit.

    Ref: RFC 9559: TimestampScale 0x2AD7B1 (ns of a unit), DefaultDuration 0x23E383 (ns of a frame);
    the text tag DURATION is FFmpeg's.
    """
    unit = round(1e6 / fps).to_bytes(3, "big")
    frame = round(1e9 / fps).to_bytes(4, "big")
    webm = webm.replace(b"\x2a\xd7\xb1\x83\x0f\x42\x40", b"\x2a\xd7\xb1\x83" + unit, 1)
    webm = webm.replace(b"\x23\xe3\x83\x84\x3b\x9a\xca\x00", b"\x23\xe3\x83\x84" + frame, 1)
    s = count / fps
    length = b"%02d:%02d:%012.9f" % (s // 3600, s // 60 % 60, s % 60)
    tag = rb"(DURATION\x44\x87.)\d\d:\d\d:\d\d\.\d{9}"
    return re.sub(tag, rb"\g<1>" + length, webm, count=1, flags=re.DOTALL)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Discard FFmpeg's remark on the codec's tag, which C code prints on stderr."""
    sys.stderr.flush()
    stderr_copy = os.dup(2)
    with open(os.devnull, "w", encoding="utf-8") as null:
        os.dup2(null.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(stderr_copy, 2)
        os.close(stderr_copy)
