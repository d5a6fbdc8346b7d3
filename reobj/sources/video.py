"""Frames of a video file, an image folder, a camera or a stream, with what can be wrong with them.

What is in the frames is not asked here. Start at `Video`; `resized` and `shrunk` scale images.
"""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import hashlib
import json
import math
import os
import queue
import re
import struct
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from reobj.files import shortened
from reobj.types import Array, Frame, Image, ReobjError, log, option, without_secrets

IMAGE_FPS = 30.0  # chosen: image folders have no times; most phones film at 30 Hz


@dataclass(frozen=True, slots=True)
class InputConfig:
    """Choose the frames to read, which keep their numbers in the source whatever is left out."""

    every: int = option(1, "read every N-th frame", "--every")
    start: int = option(0, "number of the first frame to read (0-based)", "--start")
    stop: int = option(0, "number of the frame to stop before (0: read to the end)", "--stop")
    max_size: int = option(
        0, "shrink frames whose longer side has more pixels to this (0: never)", "--max-size"
    )
    reconnect: int = option(
        0, "times to connect again to a live source that ended, after 1, 2, 4, ... 30 s"
    )


STREAM_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)  # rtsp, http, ... addresses
MAX_UNREADABLE = 64  # frames in a row; chosen: 2 s without a picture, then the video has ended
MISSING_SHARE = 0.02  # of the announced frames; chosen: containers often announce a few too many
LIVE_QUEUE = 2  # frames that wait for the tracker; chosen: one to work on next and the newest one
LIVE_POLL_S = 0.5  # chosen: longer than the reading thread takes to say that it ends
LIVE_TIMEOUT_S = 2.0  # chosen: no frame for so long, and a live source has ended
OPEN_TIMEOUT_S = 5.0  # chosen: cameras answer within 2 s; OpenCV's own is 30 s
RECONNECT_S = (1.0, 30.0)  # chosen: before the first attempt, twice as long before each, at most


# Image names that are time stamps (TUM: 1305031102.175304.png)
STAMPS_PER_S = (1.0, 1e3, 1e6, 1e9)  # s, ms, us, ns
EPOCH_S = (946684800.0, 4102444800.0)  # 2000 to 2100, in s since 1970
FRAME_STEPS_S = (1 / 240, 10.0)  # between two images: the fastest phones; photos one by one
LEAST_STAMP = 1e9  # whole numbers below are counters (chosen: s since 1970 have ten digits)


def times_of_names(names: Sequence[str]) -> Array | None:
    """Read the times of images (F,) in s from names that are time stamps; None if they are none.

    The last number of every name counts if it has a decimal point, or at least ten digits. Its
    unit, s, ms, us or ns, is the one in which the images have a plausible rate, a plausible date
    since 1970 first.
    """
    words = [re.findall(r"\d+(?:\.\d+)?", Path(name).stem)[-1:] for name in names]
    if not words or not all(words):
        return None
    numbers = np.array([float(word) for (word,) in words])
    if not (all("." in word for (word,) in words) or numbers.min() >= LEAST_STAMP):
        return None
    steps = np.diff(numbers)
    if (steps <= 0).any():
        return None
    found = []
    for per_s in STAMPS_PER_S:
        step_s = float(np.median(steps)) / per_s if len(steps) else 1 / IMAGE_FPS
        first_s = float(numbers[0]) / per_s
        dated = EPOCH_S[0] < first_s < EPOCH_S[1]
        clock = dated or (first_s < EPOCH_S[0] and len(steps) > 0)  # or since it was switched on
        if clock and FRAME_STEPS_S[0] <= step_s <= FRAME_STEPS_S[1]:
            found.append((not dated, abs(math.log(step_s * IMAGE_FPS)), per_s))
    return numbers / min(found)[2] if found else None


class Video:
    """Iterate over the frames of a video file, image folder, glob, camera index or stream URL.

    Iterating yields `Frame`s, and may be done again unless the source is live. Frame numbers count
    the frames of the source from 0: images in the order of the numbers in their names, frames of a
    file as they are stored; those that cannot be read are counted. A live source is read as fast
    as it delivers: frames that come while the caller works are counted and dropped, except for the
    `LIVE_QUEUE` newest ones.

    Attributes:
        source: what was given, of a URL only scheme, host and path.
        fingerprint: changes with the source or its files; does not tell what a URL hides.
        files, names: paths and file names of images by frame number, [] for videos.
        times_s: (F,) of images whose names are time stamps, else None: they come at 30 Hz.
        times_are_known: the times of the frames are measured; False: only their order is known,
            and `IMAGE_FPS` is assumed.
        has_images: False where frames have none (`ImagelessVideo`).
        is_live: a camera or stream, which cannot be read twice.
        read, dropped: wanted frames of a live source so far, and those of them never yielded.
        size: (w, h) of the source in px, after rotation by its metadata.
        working_size: (w, h) of the frames that are yielded, px; scale: working px per native px.
        fps: mean frame rate, Hz. frame_count: of the source (0: unknown).
        skipped: numbers of the frames, in the last iteration, that could not be read or had
            another size. messages: warnings for the user, each once.
    """

    has_images = True

    def __init__(self, source: str | Path | int, config: InputConfig | None = None) -> None:
        self._address, self.config = str(source), config or InputConfig()
        self.source = without_secrets(self._address)
        if self.config.every < 1 or min(dataclasses.astuple(self.config)) < 0:
            raise ReobjError("--every must be at least 1; --start, --stop, --max-size at least 0")
        self.skipped: list[int] = []
        self.messages: list[str] = []
        self.read = self.dropped = self._seen = 0
        self._opened: Any = None  # capture of a live source, until it is iterated
        self._is_url = bool(STREAM_URL.match(self._address))
        self.fingerprint = source_fingerprint(source)
        self.files = [] if self._is_url else _image_files(self.source)
        self.names = [path.name for path in self.files]
        self.times_s = times_of_names(self.names)
        self.times_are_known = not self.files or self.times_s is not None
        self.is_live = self._is_url or (self.source.isdecimal() and not Path(self.source).exists())
        self.size, self.fps, self.frame_count = self._probe()
        if 0 < self.frame_count <= self.config.start:
            raise ReobjError(f"{self.source}: --start {self.config.start}, but it has only "
                             f"{self.frame_count} frames")  # fmt: skip
        ratio = min(1.0, self.config.max_size / max(self.size)) if self.config.max_size else 1.0
        width, height = (max(round(side * ratio), 1) for side in self.size)
        self.working_size = (width, height)
        self.scale = width / self.size[0]

    def name(self, index: int) -> str:
        """Return the file name of a frame, "" for videos."""
        return self.names[index] if self.names else ""

    @property
    def expected(self) -> int:
        """Count the frames that an iteration yields at most (0: unknown)."""
        stop = min(self.config.stop or self.frame_count, self.frame_count or self.config.stop)
        return max(math.ceil((stop - self.config.start) / self.config.every), 0)

    def __iter__(self) -> Iterator[Frame]:
        self.skipped.clear()
        decoded = self._from_live() if self.is_live else self._from_capture()
        if self.files:
            stop = min(self.config.stop or self.frame_count, self.frame_count)
            numbers = range(self.config.start, stop, self.config.every)
            times_s = np.arange(stop) / IMAGE_FPS if self.times_s is None else self.times_s
            decoded = ((i, float(times_s[i]), read_image(self.files[i])) for i in numbers)
        for index, time_s, image in decoded if self.is_live else one_ahead(decoded):
            if image is None or (image.shape[1], image.shape[0]) != self.size:
                self.skipped.append(index)
                continue
            if self.working_size != self.size:
                small = cv2.resize(image, self.working_size, interpolation=cv2.INTER_AREA)
                image = np.asarray(small, np.uint8)
            yield Frame(index, time_s, image)
        if self.skipped:
            self._warn(f"{len(self.skipped)} frames skipped (unreadable or of another size): "
                       f"{shortened(self.skipped)}")  # fmt: skip

    def _warn(self, text: str) -> None:
        if (text := f"{self.source}: {text}") not in self.messages:
            self.messages.append(text)

    def _from_capture(self) -> Iterator[tuple[int, float, Image | None]]:
        """Decode a file: yield number, time in s and image of the wanted frames.

        The image is None if it cannot be read. Frames that cannot be grabbed are held back until a
        later one can: at the end of the file they do not exist.
        """
        capture, start, every = self._open(), self.config.start, self.config.every
        previous_s, unreadable, index = -1.0, 0, -1
        pending: list[tuple[int, float, Image | None]] = []  # unreadable, or after the end
        for index in range(self.config.stop or sys.maxsize):
            wanted = index >= start and (index - start) % every == 0
            grabbed = capture.grab()
            # Right after the grab this is the frame's true time, also at a variable rate.
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if time_s <= previous_s:  # some containers hold no times
                time_s = previous_s + 1 / self.fps
            ok, image = capture.retrieve() if grabbed and wanted else (grabbed, None)
            if not ok:
                unreadable += 1
                pending += [(index, time_s, None)] if wanted else []
                if unreadable >= MAX_UNREADABLE:
                    break
                continue
            yield from pending
            pending, unreadable, previous_s = [], 0, time_s
            if wanted:
                yield index, time_s, image
        read, stop = index + 1 - unreadable, self.config.stop or self.frame_count
        if min(stop, self.frame_count) - read > max(1.0, MISSING_SHARE * self.frame_count):
            self._warn(f"the file ends early: {read} of {self.frame_count} frames can be read")

    def _from_live(self) -> Iterator[tuple[int, float, Image | None]]:
        """Yield number, time in s since the start and image of the newest frames of a live source.

        Where it ends, connect again as often as the config says; the frames are counted on.
        """
        capture, self._opened = self._opened or self._open(), None
        self.read = self.dropped = self._seen = attempts = 0
        began = time.monotonic()
        while capture is not None:
            before = self._seen
            yield from self._from_connection(capture, began)
            attempts = attempts if self._seen == before else 0  # in a row without a frame
            capture = None
            while capture is None and attempts < self.config.reconnect:
                if 0 < self.config.stop <= self._seen:
                    break
                wait_s = min(RECONNECT_S[0] * 2.0 ** min(attempts, 9), RECONNECT_S[1])
                attempts += 1
                log.warning("%s: ended; connecting again in %g s", self.source, wait_s)
                time.sleep(wait_s)
                with contextlib.suppress(ReobjError):
                    capture = self._open()

    def _from_connection(
        self, capture: Any, began: float
    ) -> Iterator[tuple[int, float, Image | None]]:
        """Yield the newest frames until a connection ends.

        A thread reads all frames, so that the driver's own queue never fills with old ones.
        """
        frames: queue.Queue[tuple[int, float, Image] | None] = queue.Queue(LIVE_QUEUE)
        stopped, self._came = threading.Event(), time.monotonic()
        thread = threading.Thread(
            target=self._read_live, args=(capture, frames, stopped, began), daemon=True
        )
        thread.start()
        try:
            while (item := self._next_live(frames)) is not None:
                yield item
        finally:
            stopped.set()
            hangs = time.monotonic() - self._came > LIVE_TIMEOUT_S
            thread.join(0.0 if hangs else LIVE_TIMEOUT_S / 2)
            if not thread.is_alive():  # else it hangs in the driver; the process may still end
                capture.release()

    def _next_live(
        self, frames: queue.Queue[tuple[int, float, Image] | None]
    ) -> tuple[int, float, Image] | None:
        """Wait for a frame of a live source; None at its end, or where the driver hangs."""
        while time.monotonic() - self._came < LIVE_TIMEOUT_S + LIVE_POLL_S or not frames.empty():
            with contextlib.suppress(queue.Empty):
                return frames.get(timeout=LIVE_POLL_S)
        self._warn(f"no frame came for {LIVE_TIMEOUT_S:g} s: taken as its end")
        return None

    def _read_live(
        self,
        capture: Any,
        frames: queue.Queue[tuple[int, float, Image] | None],
        stopped: threading.Event,
        began: float,
    ) -> None:
        """Read a live source until it ends or `stopped`; drop the oldest frame of a full queue."""
        last = time.monotonic()
        try:
            while not stopped.is_set() and time.monotonic() - last < LIVE_TIMEOUT_S:
                if 0 < self.config.stop <= self._seen:
                    break
                ok, image = capture.read()
                if not ok:
                    time.sleep(0.01)
                    continue
                if stopped.is_set():  # the driver hung; another connection counts now
                    break
                self._came = last = time.monotonic()
                at, self._seen = self._seen, self._seen + 1
                if at < self.config.start or (at - self.config.start) % self.config.every:
                    continue
                self.read += 1
                if frames.full():
                    with contextlib.suppress(queue.Empty):  # the tracker was faster
                        frames.get_nowait()
                        self.dropped += 1
                frames.put((at, last - began, image))  # this thread alone puts: there is room
        finally:
            while not stopped.is_set():  # None ends the iteration, after the frames that wait
                with contextlib.suppress(queue.Full):
                    frames.put(None, timeout=0.1)
                    break

    def _open(self) -> Any:
        """Open the source with OpenCV, which turns frames upright by the file's rotation tag."""
        if any("\ud800" <= letter <= "\udfff" for letter in self._address):  # OpenCV crashes
            raise ReobjError(f"{self.source!r}: this name is no UTF-8; rename the file")
        if not self.is_live and not self._is_url and not Path(self.source).is_file():
            raise ReobjError(f"{self.source}: no such file or folder")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its messages name no file, ours do
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        is_camera = self.is_live and self._address.isdecimal()
        timeout_ms = round(1000 * OPEN_TIMEOUT_S)
        timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, timeout_ms]
        timeouts += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, timeout_ms]
        if self._is_url:
            capture = cv2.VideoCapture(self._address, cv2.CAP_ANY, timeouts)
        else:
            capture = cv2.VideoCapture(int(self._address) if is_camera else self._address)
        cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            what = "video (damaged, or no video)"
            if self.is_live:
                what = "camera (is it connected?)" if is_camera else "stream (is it there?)"
            raise ReobjError(f"{self.source}: cannot be opened as a {what}")
        return capture

    def _probe(self) -> tuple[tuple[int, int], float, int]:
        """Read the first readable frame.

        Returns:
            (w, h) in px, frame rate in Hz, and number of frames (0: unknown).
        """
        images: Iterator[Image | None] = map(read_image, self.files)
        fps, count = IMAGE_FPS, len(self.files)
        if self.times_s is not None and count > 1:
            fps = float((count - 1) / np.ptp(self.times_s))
        if not self.files:
            capture = self._open()
            images = (capture.read()[1] for _ in range(MAX_UNREADABLE))
            fps = float(capture.get(cv2.CAP_PROP_FPS))
            pixels = capture.get(cv2.CAP_PROP_FRAME_WIDTH) * capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
            if pixels > PIXELS_MAX:
                raise ReobjError(f"{self.source}: frames of {pixels:.0f} pixels, at most "
                                 f"{PIXELS_MAX} are taken")  # fmt: skip
            if not self._address.isdecimal():
                count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
            self.is_live = self.is_live and not count  # a URL may be that of a file
            self._opened = capture if self.is_live else None
        image = next((image for image in images if image is not None), None)
        if image is None:
            raise ReobjError(f"{self.source}: not one frame can be decoded")
        return (image.shape[1], image.shape[0]), fps if 0 < fps < math.inf else IMAGE_FPS, count


IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")


def _image_files(source: str) -> list[Path]:
    """List the images of a folder, glob or single file, image2 before image10; [] for videos."""
    path = Path(source)
    if path.is_file():
        return [path] if path.suffix.lower() in IMAGE_SUFFIXES else []
    if not path.is_dir() and not re.search(r"[*?\[]", source):
        return []
    found = path.iterdir() if path.is_dir() else map(Path, glob.glob(source))
    files = [p for p in found if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    if not files:
        raise ReobjError(f"{source}: no images there (looked for {' '.join(IMAGE_SUFFIXES)})")
    return sorted(files, key=lambda p: by_number(p.name))


def by_number(name: str) -> str:
    """Return a key that sorts names by the numbers in them."""
    return re.sub(r"\d+", lambda n: n[0].zfill(20), name)


PIXELS_MAX = 1 << 28  # of an image; chosen: above the 200 megapixels of phones; 800 MB as BGR


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> npt.NDArray[Any] | None:
    """Read an image file as OpenCV's `flags` say; None if it is no image.

    Raises:
        ReobjError: it claims more than PIXELS_MAX pixels: a small file may hold gigabytes.
    """
    try:
        data = np.fromfile(path, np.uint8)
        if (pixels := claimed_pixels(data.tobytes())) > PIXELS_MAX:
            raise ReobjError(f"{path}: {pixels} pixels, at most {PIXELS_MAX} are taken")
        image = cv2.imdecode(data, flags) if len(data) else None
    except (OSError, cv2.error):
        return None
    return None if image is None else np.asarray(image)


def claimed_pixels(data: bytes) -> int:
    """Read from its header how many pixels an image of IMAGE_SUFFIXES has; 0: not to be told."""
    width = height = 0
    with contextlib.suppress(struct.error, IndexError):
        if data.startswith(b"\x89PNG"):
            width, height = struct.unpack_from(">II", data, 16)
        elif data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
        elif data.startswith(b"\xff\xd8"):
            width, height = _jpeg_size(data)
        elif data[:4] in (b"II*\0", b"MM\0*"):
            width, height = _tiff_size(data)
        elif data[8:15] == b"WEBPVP8":
            width, height = _webp_size(data)
    return abs(width * height)


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Return (w, h) from the first start of frame, which follows other segments."""
    at = 2
    while data[at] == 0xFF and not (
        0xC0 <= data[at + 1] <= 0xCF and data[at + 1] not in JPEG_OTHER
    ):
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    height, width = struct.unpack_from(">HH", data, at + 5)
    return width, height


JPEG_OTHER = (0xC4, 0xC8, 0xCC)  # tables among the markers of frames


def _tiff_size(data: bytes) -> tuple[int, int]:
    """Return (w, h) from the tags 256 and 257 of the first directory."""
    order = "<" if data[:1] == b"I" else ">"
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    tags = (struct.unpack_from(order + "HHII", data, start + 2 + 12 * i) for i in range(count))
    sides = {tag: value >> 16 * (kind == 3 and order == ">") for tag, kind, _, value in tags}
    return sides.get(256, 0), sides.get(257, 0)


def _webp_size(data: bytes) -> tuple[int, int]:
    """Return (w, h): of the canvas, of a lossless or of a lossy picture."""
    if data[15:16] == b"X":
        width, height = (int.from_bytes(data[i : i + 3], "little") + 1 for i in (24, 27))
    elif data[15:16] == b"L":
        (bits,) = struct.unpack_from("<I", data, 21)
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    return width, height


def resized(image: Image, size: Sequence[int]) -> Image:
    """Resize to (w, h) by averaging pixels; by halves first: 4 times as fast on large frames."""
    while image.shape[1] >= 2 * size[0] and image.shape[0] >= 2 * size[1]:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def shrunk(image: Image, size_px: int) -> Image:
    """Shrink an image so that its longer side has at most `size_px`; never enlarge."""
    ratio = min(1.0, size_px / max(image.shape[:2]))
    return resized(image, [max(1, round(side * ratio)) for side in image.shape[1::-1]])


HASH_ROUNDS = 100_000  # chosen: .05 s, once a run, and for every guess at a password


def source_fingerprint(source: Any) -> str:
    """Hash names, sizes and times of a file, a folder's files or a glob's matches.

    Returns:
        16 hex digits; of a camera its number; of a URL what may be shown of it, and a slow hash of
        the rest: two queries of a server are two sources.
    """
    text, path = str(source), Path(str(source))
    if STREAM_URL.match(text):
        shown = without_secrets(text)
        rest = hashlib.pbkdf2_hmac("sha256", text.encode(), shown.encode(), HASH_ROUNDS)
        return shown if shown == text else f"{shown} {rest.hex()[:16]}"
    if path.is_file():  # also one whose name looks like a glob: det[1].txt
        files = [path]
    else:
        found = path.iterdir() if path.is_dir() else map(Path, glob.glob(text))
        files = sorted(p for p in found if p.is_file())
    if not files:
        return text
    facts = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


Item = TypeVar("Item")


def one_ahead(items: Iterator[Item]) -> Iterator[Item]:
    """Make the next item, which is never None, in a thread while the last one is used."""
    with ThreadPoolExecutor(1) as pool:
        ahead = pool.submit(next, items, None)
        while (item := ahead.result()) is not None:
            ahead = pool.submit(next, items, None)
            yield item
