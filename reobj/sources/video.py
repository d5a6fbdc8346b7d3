"""Frames of a video file, an image folder, a camera or a stream; or frames without images.

Start at `Video`; `ImagelessVideo` replaces it where only detections and poses are given. `resized`
and `shrunk` scale images.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import filecmp
import functools
import glob
import hashlib
import itertools
import json
import math
import os
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from reobj.files import quiet_opencv, shortened
from reobj.sources.image_files import (
    IMAGE_FPS,
    IMAGE_SUFFIXES,
    Decoded,
    Opened,
    animation_frames,
    list_images,
    open_camera,
    open_file,
    packet_count,
    read_image,
    settled_times,
    times_of_names,
)
from reobj.types import Array, Frame, Image, ReobjError, log, option, without_secrets


@dataclass(frozen=True, slots=True)
class InputConfig:
    """Frames to read; they keep their numbers in the source."""

    every: int = option(1, "read every N-th frame", "--every")
    start: int = option(0, "first frame to read (0-based)", "--start")
    stop: int = option(0, "frame before which to stop (0-based; 0: read to the end)", "--stop")
    max_size: int = option(
        0, "downscale frames to this longer side, px (0: off); saves time on large videos",
        "--max-size",
    )  # fmt: skip
    reconnect: int = option(
        0, "reconnection attempts after a live source ends, after 1, 2, 4, ... 30 s"
    )

    def __post_init__(self) -> None:
        if self.every < 1 or min(dataclasses.astuple(self)) < 0:
            raise ReobjError("--every must be at least 1; --start, --stop, --max-size at least 0")

    def selects(self, frame: Any) -> Any:
        """Test whether frame numbers of the source, one or (N,), are to be read."""
        within = (frame >= self.start) & (frame < (self.stop or sys.maxsize))
        return within & ((frame - self.start) % self.every == 0)


MAX_UNREADABLE = 64  # frames at the beginning, 2 s at 30 Hz, before a video is refused


@dataclass(frozen=True, slots=True)
class LiveTimes:
    """Times of a live source: when it has ended, and when it is opened again.

    Attributes:
        silent_s: s without a frame after which it has ended. Lower: a short break of the network
            ends the run; higher: a run waits longer for a camera that was switched off.
        open_s: s to open a stream. Cameras answer within 2 s.
        first_wait_s, longest_wait_s: s before the first attempt to reconnect, doubled for each next
            one, and its maximum. Lower: more load on a server that is down; higher: more frames are
            lost after a short break.
    """

    silent_s: float = 2.0
    open_s: float = 5.0
    first_wait_s: float = 1.0
    longest_wait_s: float = 30.0


class Video:
    """Iterate over the frames of a video file, image folder, glob, camera index or stream URL.

    Iteration yields `Frame`s and may be repeated unless the source is live. Frame numbers count the
    frames of the source from 0, including unreadable ones: images in the order of the numbers in
    their names, frames of a file as stored. Frames that a live source delivers while the caller is
    busy are counted and dropped, except for the two newest ones.

    Args:
        live: when a live source has ended; default: `reobj.sources.video.LiveTimes`.
    Attributes:
        source: as given; of a URL only scheme, host and path.
        fingerprint: hash of the source or its files, without the secrets of a URL.
        files, names: paths and file names of images by frame number, [] for videos.
        times_s: (F,) of images whose names are time stamps, else None (assumed: 30 Hz).
        times_are_known: the times of the frames are measured; False: a constant rate is assumed.
        has_images: False for frames without images (`ImagelessVideo`).
        is_live: a camera or stream, which cannot be read twice.
        read, dropped: requested frames of a live source so far, and those never yielded.
        size: (w, h) of the source in px, after rotation by its metadata.
        working_size: (w, h) of the yielded frames, px; scale: working px per native px.
        fps: mean frame rate, Hz. frame_count: frames that can be decoded (0: unknown, of a live
            source). Both are measured on first access by decoding a file once, up to
            `config.stop`, unless it was read before.
        pixel_aspect: width over height of a pixel; 1: square.
        skipped: numbers of the frames of the last iteration that were unreadable or of another
            size. messages: warnings for the user, without repetition.
    """

    has_images = True
    is_live = False
    pixel_aspect = scale = 1.0
    read = dropped = _seen = _taken = 0
    _after = -1  # frames up to this one are decoded and checked, but not yielded
    _declared_s = 0.0
    _opened: Opened | None = None  # a live source, until it is iterated
    _clock: tuple[Array, bool] | None = None  # times (F,) in s; the file has them

    def __init__(
        self,
        source: str | Path | int,
        config: InputConfig | None = None,
        live: LiveTimes | None = None,
    ) -> None:
        self._address = str(source)
        self.config = config or InputConfig()
        self._live = live or LiveTimes()
        self.source = without_secrets(self._address)
        self.skipped: list[int] = []
        self.messages: list[str] = []
        self._is_url = _is_stream_url(self._address)
        self.fingerprint = source_fingerprint(source)
        self.files, usual, said = ([], [], []) if self._is_url else list_images(self.source)
        for text in said:
            self._warn(text)
        self.names = [path.name for path in self.files]
        self.times_s = times_of_names(self.names)
        self.is_live = self._is_url or (self.source.isdecimal() and not Path(self.source).exists())
        self.size, self._announced_fps, self._announced = self._probe(usual)
        start = self.config.start
        if start and not self.is_live and not start < self.frame_count:
            raise ReobjError(f"{self.source}: --start {start}, but it has only "
                             f"{self.frame_count} frames")  # fmt: skip
        ratio = min(1.0, self.config.max_size / max(self.size)) if self.config.max_size else 1.0
        width, height = (max(round(side * ratio), 1) for side in self.size)
        self.working_size = (width, height)
        self.scale = width / self.size[0]

    def after(self, index: int) -> Video:
        """Return this video without the frames up to `index`, to continue with the next one.

        They are decoded all the same: seeking is not exact in all files, and the messages are those
        of the whole video.
        """
        rest = copy.copy(self)
        rest._after = index
        return rest

    def name(self, index: int) -> str:
        """Return the file name of a frame, "" for videos."""
        return self.names[index] if self.names else ""

    @property
    def expected(self) -> int:
        """Approximate number of frames of an iteration; as announced until it is measured."""
        measured = self._clock is not None and not self.config.stop
        count = self.frame_count if measured else self._announced
        stop = min(self.config.stop or count, count or self.config.stop)
        return len(range(self.config.start, stop, self.config.every))

    @functools.cached_property
    def copies(self) -> dict[int, int]:
        """Frame numbers of images with the same bytes as an earlier one, and of that one."""
        first = dict[str, int]()
        copies = {}
        for k, path in enumerate(self.files):
            number = first.setdefault(content_fingerprint([path]), k)
            if number != k and filecmp.cmp(path, self.files[number], shallow=False):
                copies[k] = number
        return copies

    @functools.cached_property
    def frame_count(self) -> int:
        if self.files or self.is_live:
            return len(self.files)
        if self.config.stop and not self._is_animation:
            return packet_count(self._path)
        return len(self._measured()[0])

    @property
    def _known_times_s(self) -> Array | None:
        """Times (F,) of images, or of the frames of a file; None: unknown."""
        if self.files or self.is_live:
            return self.times_s
        times_s, known = self._measured()
        return times_s if known else None

    @functools.cached_property
    def fps(self) -> float:
        announced = self._announced_fps
        times_s = self._known_times_s
        if times_s is None or len(times_s) < 2:
            return announced
        steps = len(times_s) - 1
        seconds = float(np.ptp(times_s))
        same = abs(steps / announced - seconds) <= 1e-3  # s, resolution of times in containers
        return announced if same else steps / seconds

    @functools.cached_property
    def times_are_known(self) -> bool:
        return self.is_live or self._known_times_s is not None

    def __iter__(self) -> Iterator[Frame]:
        self.skipped.clear()
        others = "most" if self.files else "the first"
        size = f"not {self.size[0]}x{self.size[1]}, the size of {others}"
        left_out: dict[str, list[int]] = {"unreadable": [], size: []}
        decoded = self._from_images() if self.files else self._from_file()
        for index, time_s, image in self._from_live() if self.is_live else one_ahead(decoded):
            if image is None or image.shape[1::-1] != self.size:
                left_out["unreadable" if image is None else size].append(index)
                self.skipped.append(index)
            elif index > self._after:
                if self.working_size != self.size:
                    small = cv2.resize(image, self.working_size, interpolation=cv2.INTER_AREA)
                    image = np.asarray(small, np.uint8)
                yield Frame(index, time_s, image)
        for why, skipped in left_out.items():
            if skipped:
                which = shortened([self.name(index) or index for index in skipped])
                self._warn(f"{len(skipped)} frames skipped ({why}): {which}")

    def _warn(self, text: str) -> None:
        if (text := f"{self.source}: {text}") not in self.messages:
            self.messages.append(text)

    def _from_images(self) -> Iterator[tuple[int, float, Image | None]]:
        stop = min(self.config.stop or self.frame_count, self.frame_count)
        times_s = np.arange(stop) / IMAGE_FPS if self.times_s is None else self.times_s
        for index in range(self.config.start, stop, self.config.every):
            yield index, float(times_s[index]), read_image(self.files[index])

    def _from_file(self) -> Iterator[tuple[int, float, Image | None]]:
        """Decode a file: yield number, time in s and image (None: undecodable) of its frames."""
        raw_s = list[float]()
        for index, (seconds, image, _) in enumerate(self._decoded()):
            if not seconds > max(raw_s[-1:], default=-math.inf):
                self._measured()  # correcting this time needs all later ones
            raw_s.append(seconds)
            if self.config.selects(index):
                time_s = seconds if self._clock is None else float(self._clock[0][index])
                yield index, time_s, None if image is None else image()
        if self._clock is None:
            self._keep(raw_s)

    def _decoded(self) -> Iterator[Decoded]:
        """Decode the frames before `config.stop` one by one."""
        return itertools.islice(self._open().frames, self.config.stop or None)

    def _measured(self) -> tuple[Array, bool]:
        """Return the times of the frames before `config.stop`; a file is decoded once."""
        return self._clock or self._keep([frame.time_s for frame in self._decoded()])

    def _keep(self, raw_s: Sequence[float]) -> tuple[Array, bool]:
        """Correct the times of the container, with warnings, and store them."""
        fps = self._announced_fps
        times_s, restarts, known = settled_times(np.array(raw_s), 1 / fps)
        if restarts:
            self._warn(f"its clock restarts {restarts} time(s): times are continued from there")
        if not known:
            self._warn(f"it has no times: {fps:g} frames a second are assumed")
        last_s = times_s.max(initial=0.0)
        lost_s = self._declared_s - last_s
        stopped = 0 < self.config.stop <= len(raw_s)
        if known and not stopped and lost_s > max(2 / fps, 0.02 * self._declared_s):
            read = f"{len(times_s)} frames up to {last_s:.2f} s can be read"
            self._warn(f"it ends early or is damaged: {read}, {self._declared_s:.2f} s declared")
        self._clock = (times_s, known)
        return self._clock

    def _from_live(self) -> Iterator[tuple[int, float, Image | None]]:
        """Yield number, time in s since the start and image of the newest frames of a live source.

        When it ends, reconnect up to `config.reconnect` times; frame numbers continue.
        """
        opened: Opened | None = self._opened or self._open()
        self._opened = None
        self.read = self.dropped = self._seen = self._taken = attempts = 0
        began_s = time.monotonic()
        while True:
            before = self._seen
            if opened is not None:
                yield from self._from_connection(opened, began_s)
            attempts = attempts + 1 if self._seen == before else 1  # consecutive, without a frame
            if attempts > self.config.reconnect or self._at_stop:
                return
            wait_s = self._live.first_wait_s * 2.0 ** min(attempts - 1, 9)
            wait_s = min(wait_s, self._live.longest_wait_s)
            log.warning("%s: ended; reconnecting in %g s", self.source, wait_s)
            time.sleep(wait_s)
            opened = None
            with contextlib.suppress(ReobjError):
                opened = self._open()

    @property
    def _at_stop(self) -> bool:
        """Whether `config.stop` frames of a live source have come."""
        return 0 < self.config.stop <= self._seen

    def _from_connection(
        self, opened: Opened, began_s: float
    ) -> Iterator[tuple[int, float, Image | None]]:
        """Yield the newest frames until a connection ends.

        A thread reads all frames, so that the driver's queue does not fill with old ones.
        """
        # Two frames wait: the next one for the tracker, and the newest one
        waiting: deque[tuple[int, int, float, Image]] = deque(maxlen=2)
        stopped = threading.Event()

        def read() -> None:
            with contextlib.closing(opened.frames):
                for frame in opened.frames:
                    if stopped.is_set() or self._at_stop:
                        return
                    if frame.image is None:
                        continue
                    if self.config.selects(self._seen):
                        time_s = time.monotonic() - began_s
                        waiting.append((self.read, self._seen, time_s, frame.image()))
                        self.read += 1
                    self._seen += 1

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        try:
            while thread.is_alive() or waiting:
                if not waiting:
                    time.sleep(0.005)
                    continue
                number, at, time_s, image = waiting.popleft()
                self.dropped = number - self._taken
                self._taken += 1
                yield at, time_s, image
        finally:
            stopped.set()
            thread.join(self._live.silent_s)

    def _open(self) -> Opened:
        """Open the source.

        Raises:
            ReobjError: it is missing, unreadable or no video.
        """
        path = Path(self.source)
        is_camera = self.is_live and not self._is_url
        if not (is_camera or self._is_url or path.is_file()):
            raise ReobjError(f"{self.source}: no such file or folder")
        try:
            if is_camera:
                return open_camera(int(self._address), self._live.silent_s)
            if self._is_animation:
                return Opened(animation_frames(path), path.suffix)
            limits = (self._live.open_s, self._live.silent_s) if self._is_url else ()
            return open_file(self._path, *limits)
        except ReobjError as error:
            raise ReobjError(f"{self.source}: {error}") from None

    @property
    def _path(self) -> str:
        """Absolute path, as FFmpeg reads the name 12:30.mp4 as a protocol; or the URL."""
        return self._address if self._is_url else os.path.abspath(self._address)

    @property
    def _is_animation(self) -> bool:
        return not self._is_url and Path(self.source).suffix.lower() in IMAGE_SUFFIXES

    def _probe(self, usual: Sequence[Path]) -> tuple[tuple[int, int], float, int]:
        """Read the first readable frame; of images: the first of the `usual` ones.

        Returns:
            (w, h) in px, announced frame rate in Hz and number of frames (0: unknown).
        """
        if self.files:
            images = (read_image(path) for path in [*usual, *self.files])
            with quiet_opencv():
                image = next((image for image in images if image is not None), None)
            if image is None:
                raise ReobjError(f"{self.source}: no frame can be decoded: damaged, or not images "
                                 "of 8 or 16 bits a channel")  # fmt: skip
            return (image.shape[1], image.shape[0]), IMAGE_FPS, len(self.files)
        opened = self._open()
        first = itertools.islice(opened.frames, MAX_UNREADABLE)
        frame = next((frame for frame in first if frame.image), Decoded())
        if frame.image is None:
            raise ReobjError(f"{self.source}: no frame can be decoded (codec {opened.codec})")
        self.is_live = self.is_live and not opened.count  # the URL of a file is not live
        self._opened = opened if self.is_live else None
        self._declared_s = opened.duration_s
        aspect = 1 / opened.pixel_aspect if frame.turned % 180 == 90 else opened.pixel_aspect
        if abs(aspect - 1) > 0.01 and not self.is_live:  # less is not visible
            self.pixel_aspect = float(aspect)
            self._warn(f"its pixels are {aspect.numerator}:{aspect.denominator}, not square, by "
                       "its metadata: boxes are in stored pixels, cameras have two focal lengths; "
                       "if that is wrong, correct its sample aspect ratio (ffmpeg -i IN -vf "
                       "setsar=1 OUT)")  # fmt: skip
        height, width = frame.image().shape[:2]
        fps = opened.fps if 0 < opened.fps < math.inf else IMAGE_FPS
        return (width, height), fps, opened.count


class ImagelessVideo(Video):
    """Iterate over frames with a number, a time and perhaps a name, but without an image.

    Supports tracking by motion and given cameras, 3D objects and all files; not detectors,
    appearance, reconstruction, overlay video and pictures in the viewer.

    Args:
        source: file or folder of poses that defines the frames.
        size: (w, h) of the images of the detections, px.
        times_s: (F,) of the frames by number. None: from their names, else 30 Hz.
        names: (F,) of the images by number, "" where unknown, or [].
        count: F, if there are neither times nor names.
    """

    has_images = False

    def __init__(
        self,
        source: str | Path,
        size: Sequence[int],
        config: InputConfig | None = None,
        *,
        times_s: npt.ArrayLike | None = None,
        names: Sequence[str] = (),
        count: int = 0,
    ) -> None:
        self.source = str(source)
        self.config = config or InputConfig()
        self.fingerprint = source_fingerprint(source)
        self.size = self.working_size = (int(size[0]), int(size[1]))
        self.names = list(names)
        self.files = []
        given = times_of_names(self.names) if times_s is None else np.asarray(times_s, np.float64)
        self.times_s = given
        self.times_are_known = given is not None
        self.frame_count = max(len(self.names), count, 0 if given is None else len(given))
        self._announced = self.frame_count
        self.fps = IMAGE_FPS
        if given is not None and len(given) > 1:
            self.fps = 1 / max(float(np.median(np.diff(given))), 1e-3)
        self.skipped = []
        self.messages = []

    def facts(self) -> dict[str, Any]:
        """Return the arguments to make the same frames again, as JSON values."""
        times_s = None if self.times_s is None else self.times_s.tolist()
        return {"size": self.size, "times_s": times_s, "names": self.names,
                "count": self.frame_count}  # fmt: skip

    def __iter__(self) -> Iterator[Frame]:
        stop = min(self.config.stop or self.frame_count, self.frame_count)
        times_s = self.times_s
        no_image: Any = None
        for index in range(self.config.start, stop, self.config.every):
            time_s = index / IMAGE_FPS if times_s is None else float(times_s[index])
            if index > self._after:
                yield Frame(index, time_s, no_image)


def resized(image: Image, size: Sequence[int]) -> Image:
    """Resize to (w, h) by area averaging; halving first is 4 times as fast on large frames."""
    while image.shape[1] >= 2 * size[0] and image.shape[0] >= 2 * size[1]:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def shrunk(image: Image, size_px: int) -> Image:
    """Shrink an image so that its longer side has at most `size_px`; never enlarge."""
    ratio = min(1.0, size_px / max(image.shape[:2]))
    return resized(image, [max(1, round(side * ratio)) for side in image.shape[1::-1]])


def _is_stream_url(address: str) -> bool:
    """Test whether an address begins with rtsp://, http:// or the like."""
    return re.match(r"[a-z][a-z0-9+.-]+://", address, re.IGNORECASE) is not None


def source_fingerprint(source: Any) -> str:
    """Hash names, sizes and times of a file, a folder's files or a glob's matches.

    Returns:
        16 hex digits; of a camera its number; of a URL its public part and a slow hash of it all:
        two queries of a server are two sources.
    """
    text = str(source)
    if _is_stream_url(text):
        public = without_secrets(text)
        rounds = 100_000  # .05 s, once per run and per guess of a password
        digest = hashlib.pbkdf2_hmac("sha256", text.encode(), public.encode(), rounds)
        return public if public == text else f"{public} {digest.hex()[:16]}"
    files = files_of(source)
    if not files:
        return text
    facts = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


def content_fingerprint(files: Sequence[Path]) -> str:
    """Hash sizes and some content of files.

    Copies have the same one, whatever their names, folders and times.

    At most 16 pieces are read, spread over at most 8 files, with the first and the last bytes of
    each.

    Returns:
        16 hex digits; "" without files.
    """
    if not files:
        return ""
    most = 16  # pieces
    piece = 4096  # bytes
    digest = hashlib.sha256(json.dumps([p.stat().st_size for p in files]).encode())
    read = files[:: -(-len(files) // (most // 2))]
    for path in read:
        last = max(path.stat().st_size - piece, 0)
        count = most // len(read)
        with open(path, "rb") as file:
            for k in range(count):
                file.seek(last * k // (count - 1))
                digest.update(file.read(piece))
    return digest.hexdigest()[:16]


def files_of(source: Any) -> list[Path]:
    """List a file, a folder's files or a glob's matches, sorted; [] of a camera or URL."""
    path = Path(str(source))
    if path.is_file():  # first: the name may contain glob characters, det[1].txt
        return [path]
    matches = path.iterdir() if path.is_dir() else map(Path, glob.glob(str(source)))
    return sorted(p for p in matches if p.is_file())


Item = TypeVar("Item")


def in_batches(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    """Group items into lists of `size`; the last one may be shorter."""
    left = iter(items)
    while batch := list(itertools.islice(left, size)):
        yield batch


def one_ahead(items: Iterator[Item]) -> Iterator[Item]:
    """Compute the next item (not None) in a thread while the caller uses the last one."""
    with ThreadPoolExecutor(1) as pool:
        ahead = pool.submit(next, items, None)
        while (item := ahead.result()) is not None:
            ahead = pool.submit(next, items, None)
            yield item
