"""A film that browsers play: H.264 in MP4 where PyAV is installed, else VP8 in WebM by OpenCV.

OpenCV's wheel has no H.264 encoder, and no browser plays the MPEG-4 that it writes into .mp4. What
it has is VP8, of which it takes three times the bytes for a picture (so the film is smaller, with
fewer frames a second), and VP9, which is slow.
PyAV and not imageio-ffmpeg: frames are handed over in memory, errors come as exceptions instead of
a child process' log, and `supervision` brings it along. Its wheels hold x264, which is GPL: an
extra that the user installs, never a dependency.
"""

from __future__ import annotations

import contextlib
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

from reobj.types import Image

H264_SIZE_PX = 1280  # longer side; larger videos are shrunk (chosen: HD, so that it plays)
# The same, and most frames a second, for OpenCV's encoder, which takes 1.5 bits a pixel whatever
# the picture: 30 MB a minute (chosen: labels can still be read)
VP8_SIZE_PX = 480
VP8_FPS = 15.0
# x264's own quality; "superfast" takes half the time of "veryfast" for 1.3 times the bytes. Without
# lookahead: with it, the same pictures give other bytes every few runs (seen with PyAV 18.1, one
# thread and no B-frames too).
H264 = {
    "preset": "superfast",
    "crf": "23",
    "x264-params": "bframes=0:threads=1:rc-lookahead=0:mbtree=0",
}
LEAST_FPS = 1.0  # slower frames are repeated: VP8's are at most 4 s long in WebM, as it is written
LEAST_PX = 16  # of a side: a block of the codecs, OpenCV's VP8 fails below
KEYFRAME_S = 2  # between frames that a player can jump to (chosen)
WEBM_HEAD = 1 << 16  # bytes that hold all before the first frame (FFmpeg: under 1000)
MAX_DENOMINATOR = 1001  # of frame rates: 30000/1001


def import_av() -> Any:
    """Import PyAV; None where it is missing or has no H.264 encoder."""
    try:
        import av

        av.codec.Codec("h264", "w")
    except (ImportError, ValueError):  # PyAV's UnknownCodecError is a ValueError
        return None
    return av


class FilmWriter:
    """Write a film that appears under its name only when it is complete.

    Attributes:
        path: of the file, with the suffix of its format. part: of what is written of it.
        size: (w, h) of the frames, even: codecs want that. count: frames so far.
        every: every n-th frame is in the film. repeat: number of pictures of each.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        """Open a film of frames that are shrunk from (w, h) `size`; the suffix is replaced."""
        av = import_av()
        self.path = path.with_suffix(".webm" if av is None else ".mp4")
        self.part = self.path.with_name(f".part-{self.path.name}").absolute()  # 12:30/ is a folder
        shrink = min(1.0, (VP8_SIZE_PX if av is None else H264_SIZE_PX) / max(size))
        self.every = 1 if av else max(math.ceil(fps / VP8_FPS - 1e-3), 1)  # 30.0001 fps is 30
        self.repeat = math.ceil(LEAST_FPS / fps)
        width, height = (max(int(side * shrink) // 2 * 2, LEAST_PX) for side in size)
        self.size = (width, height)
        self.count = 0
        try:
            os.fsencode(self.path).decode()
        except UnicodeDecodeError:  # OpenCV 5.0 ends the process
            where = ascii(str(self.path))
            raise OSError(f"{where}: a film needs a folder whose name is UTF-8") from None
        with self._named(), contextlib.ExitStack() as stack:
            stack.callback(self.part.unlink, missing_ok=True)
            self.part.touch()  # PyAV finds out at the first frame only
            made = (self.part, fps / self.every * self.repeat, self.size)
            self.sink = _VP8(*made) if av is None else _H264(av, *made)
            stack.pop_all()
        self.encoder = ThreadPoolExecutor(1)  # encodes a frame while the next one is drawn
        self.pending: Future[None] | None = None

    def write(self, image: Image) -> None:
        """Append one frame of (w, h) `size`, BGR, which must not change afterwards."""
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
                raise OSError(f"{self.path}: not all frames could be written; is the disk full?")
            if complete:
                self.part.replace(self.path)
        finally:
            self.part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """Name the film in errors of the encoder, which name the part or nothing."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or error
            raise OSError(f"{self.path}: the film cannot be written ({reason})") from error

    def _frames_on_disk(self) -> int:
        capture = cv2.VideoCapture(str(self.part))
        return int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0


class _H264:
    """H.264 in MP4 by PyAV."""

    def __init__(self, av: Any, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.av = av
        rate = Fraction(fps).limit_denominator(MAX_DENOMINATOR)
        # faststart: the index comes first, so that a page plays what it has loaded
        self.file = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        self.stream = self.file.add_stream("h264", rate=rate, options=H264)
        self.stream.width, self.stream.height = size
        self.stream.pix_fmt = "yuv420p"  # the one that all browsers decode
        self.stream.gop_size = max(1, round(KEYFRAME_S * fps))

    def write(self, image: Image) -> None:
        # OpenCV converts: FFmpeg's result depends on where in memory the picture happens to lie
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

    OpenCV hands on no option of the encoder, and libvpx takes its fast mode (7 ms for a frame of
    480 x 360 instead of 40, .4 dB less) only for frames that are shown for a second or more
    (pick_quickcompress_mode in vp8_cx_iface.c). So it is told that they are; the right clock is set
    in the finished file.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.path = path
        self.fps = fps
        self.count = 0
        with _quiet():
            self.writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), 1.0, size)
        if not self.writer.isOpened():
            raise OSError("OpenCV does not open it")

    def write(self, image: Image) -> None:
        self.writer.write(image)
        self.count += 1

    def close(self) -> None:
        self.writer.release()
        with contextlib.suppress(FileNotFoundError), self.path.open("r+b") as file:
            head = file.read(WEBM_HEAD)
            file.seek(0)
            file.write(_with_clock(_with_fixed_uid(head), self.fps, self.count))


def _with_fixed_uid(webm: bytes) -> bytes:
    """Replace the random number that FFmpeg gives the track (TrackUID, and its tags' TagTrackUID).

    Ref: RFC 9559, 5.1.4.1.2: element 0x73C5, here of 8 bytes (size 0x88).
    """
    found = re.search(rb"\x73\xc5\x88(.{8})", webm, re.DOTALL)
    return webm if found is None else webm.replace(found[1], b"\0\0\0\0\0\0\0\1")


def _with_clock(webm: bytes, fps: float, count: int) -> bytes:
    """Make a film of one frame a second one of `fps`: by the unit of all its times.

    Ref: RFC 9559: TimestampScale 0x2AD7B1 (ns of a unit), DefaultDuration 0x23E383 (ns of a frame);
    the tag DURATION is FFmpeg's, text.
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
    """Keep FFmpeg's remark on the four letters of the codec, printed by C code, off stderr."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
