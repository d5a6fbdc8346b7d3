"""Overlay video for browsers: H.264 in MP4, by PyAV."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2

from reobj.types import Image


class FilmWriter:
    """Write a video atomically: the file appears only when it is complete.

    Attributes:
        path: of the file. part: of the incomplete file. count: frames so far.
        size: (w, h) of the frames, even, as the codec requires.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        """Open a video of frames of (w, h) `size`, of which odd sides lose a pixel."""
        import av

        self.path = path
        # absolute: FFmpeg reads a folder 12:30/ as a protocol
        self.part = path.with_name(f".part-{path.name}").absolute()
        width, height = (max(side // 2 * 2, 2) for side in size)
        self.size = (width, height)
        self.count = 0
        self._av: Any = av
        with self._named(), contextlib.ExitStack() as stack:
            stack.callback(self.part.unlink, missing_ok=True)
            self.part.touch()  # PyAV would fail only at the first frame
            # faststart: the index comes first, so that a browser plays the file while loading it
            options = {"movflags": "+faststart"}
            self.file = av.open(str(self.part), "w", format="mp4", options=options)
            self.stream = self._stream(fps)
            stack.pop_all()
        self.encoder = ThreadPoolExecutor(1)  # encodes a frame while the next one is drawn
        self.pending: Future[None] | None = None

    def _stream(self, fps: float) -> Any:
        # x264's default quality; "superfast" needs half the time of "veryfast" and 1.3 times the
        # bytes. Without lookahead: with it, the same frames give different bytes every few runs
        # (PyAV 18.1, one thread, no B-frames). Other encoders of H.264 ignore these options.
        options = {
            "preset": "superfast",
            "crf": "23",
            "x264-params": "bframes=0:threads=1:rc-lookahead=0:mbtree=0",
        }
        rate = Fraction(fps).limit_denominator(1001)  # such as 30000/1001
        stream = self.file.add_stream("h264", rate=rate, options=options)
        stream.width, stream.height = self.size
        stream.pix_fmt = "yuv420p"  # the only format that all browsers decode
        stream.gop_size = max(1, round(2 * fps))  # a player can seek every 2 s
        return stream

    def write(self, image: Image) -> None:
        """Append one BGR frame of (w, h) `size`; the caller must not change it afterwards."""
        self._wait()
        self.pending = self.encoder.submit(self._encode, image)
        self.count += 1

    def _encode(self, image: Image) -> None:
        # Converted by OpenCV: FFmpeg's result depends on the memory alignment of the image
        planes = cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420)
        frame = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        self.file.mux(self.stream.encode(frame))

    def _wait(self) -> None:
        """Wait for the frame that is being encoded."""
        pending = self.pending
        self.pending = None
        if pending is not None:
            with self._named():
                pending.result()

    def close(self, complete: bool) -> None:
        """Finish the file; keep it only if complete."""
        try:
            with self._named() if complete else contextlib.suppress(OSError, self._av.FFmpegError):
                try:
                    self._wait()
                    self.file.mux(self.stream.encode())
                finally:
                    self.encoder.shutdown()
                    self.file.close()
            if complete:
                self.part.replace(self.path)
        finally:
            self.part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """Add the path to errors of the encoder, which do not name it."""
        try:
            yield
        except (OSError, ValueError, self._av.FFmpegError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OSError(f"{self.path}: the overlay cannot be written ({reason})") from error
