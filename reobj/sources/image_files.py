"""Image files and decoding: frames of a folder, of video files, streams, cameras and animations.

Start at `list_images` and `open_file`. PyAV reads everything but images (OpenCV, their headers
Pillow), cameras (OpenCV) and animated images (Pillow).
"""

from __future__ import annotations

import contextlib
import enum
import glob
import itertools
import math
import re
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage
from PIL import ImageSequence

from reobj.files import quiet_opencv, shortened
from reobj.types import Array, Image, ReobjError

IMAGE_FPS = 30.0  # Hz, rate of images without times, at which most phones record
IMAGE_SUFFIXES = tuple(".jpg .jpeg .jpe .jfif .mpo .png .bmp .webp .tif .tiff".split())
UNREAD_SUFFIXES = tuple(".heic .heif .avif .jxl .jp2 .exr .hdr .dng .cr2 .cr3 .nef".split())


ImageList = tuple[list[Path], list[Path], list[str]]  # files, those of the usual size, messages


def list_images(source: str) -> ImageList:
    """List the images of a folder, glob or single file in the order of their names.

    Left out are kinds of images that are no pictures, beside those that are (`_only_pictures`).

    Returns:
        the files, empty for videos and missing files; those of the most common size by their
        headers, upright; and messages for the user.
    Raises:
        ReobjError: no images; two kinds of images, either of which may be the frames; or too many
            sizes.
    """
    path = Path(source)
    suffix = path.suffix.lower()
    if path.is_file():
        if suffix in UNREAD_SUFFIXES:
            raise ReobjError(f"{source}: {path.suffix} files are not read; convert it to .jpg")
        head = header(path) if suffix in IMAGE_SUFFIXES else None
        is_video = suffix not in IMAGE_SUFFIXES or (head is not None and head.frames > 1)
        return ([], [], []) if is_video else ([path], [path], [])
    if not path.is_dir() and not re.search(r"[*?\[]", source):
        return [], [], []
    # A glob may be in a folder whose name has such characters
    root, pattern = (path.parent, path.name) if path.parent.is_dir() else (Path(), source)
    root, pattern = (path, "*") if path.is_dir() else (root, pattern)
    paths = [root / name for name in glob.glob(pattern, root_dir=root)]
    headers = {p: header(p) for p in paths if p.suffix.lower() in IMAGE_SUFFIXES}
    unread = Counter(p.suffix for p in paths if p.suffix.lower() in (*UNREAD_SUFFIXES, ".gif"))
    messages = [f"{n} {suffix} files are not read; convert them to .jpg"
                for suffix, n in unread.items()]  # fmt: skip
    if not headers:
        folders = shortened(sorted(p.name for p in paths if p.is_dir()))
        fault = f"no images there (looked for {' '.join(IMAGE_SUFFIXES)})"
        more = [f"its folders: {folders}"] if folders else []
        raise ReobjError("; ".join([f"{source}: {fault}", *messages, *more]))
    if animated := [p.name for p, head in headers.items() if head and head.frames > 1]:
        messages.append(f"of {len(animated)} animated files only the first frame is read: "
                        f"{shortened(animated)}")  # fmt: skip
    files, left_out = _only_pictures(headers, source if path.is_dir() else "")
    files.sort(key=lambda p: (by_number(p.name), str(p)))
    return files, _usual(source, files, headers), messages + left_out


def _usual(source: str, files: list[Path], headers: dict[Path, Header | None]) -> list[Path]:
    """Return the images of the most common size; refuse too many sizes."""
    sizes = Counter(head.size for p in files if (head := headers[p]))
    size, most = max(sizes.items(), key=lambda item: item[::-1], default=((0, 0), 0))
    if 2 * most < sizes.total():
        raise ReobjError(
            f"{source}: {sizes.total()} images of {len(sizes)} sizes, at most {most} of the same "
            f"({size[0]}x{size[1]}); expected one size: give a folder or a glob in quotes of those"
        )
    return [p for p in files if getattr(headers[p], "size", None) == size]


# Of names of images that are no pictures: 7-Scenes, ScanNet, 3D Scanner App, NeRFCapture, DAVIS,
# Replica, Hypersim, Record3D
OTHER_WORDS = frozenset(
    "depth disp disparity conf confidence mask masks matte alpha seg segmentation semantic label "
    "labels instance normal normals thumb thumbnail preview infrared flow albedo".split()
)


def _only_pictures(headers: dict[Path, Header | None], folder: str) -> tuple[list[Path], list[str]]:
    """Separate pictures from depth maps and masks.

    Kinds are images whose names differ in numbers only. Left out are those of one channel with more
    than 8 bits, of one channel, or with a name such as mask, if there are others.

    Args:
        folder: the source if it is a folder, "" for a glob, which selects a kind by itself.
    Returns:
        the pictures, and messages.
    """
    messages = []
    kinds: dict[str, list[Path]] = {}
    for path in headers:
        stem = re.sub(r"\s*\(\d+\)$", "", path.stem.casefold())  # a(1).jpg, a copy
        kinds.setdefault(re.sub(r"\d+", "#", stem) + path.suffix.lower(), []).append(path)
    deep, gray = (
        [name for name in kinds if all(getattr(headers[p], key, False) for p in kinds[name])]
        for key in ("is_deep", "is_gray")
    )
    named = [name for name in kinds if OTHER_WORDS.intersection(re.split(r"[^a-z]+", name))]
    for names, why in ((deep, "one channel with more than 8 bits, as depth maps have"),
                       (gray, "one channel, beside images in colour"),
                       (named, "by their name")):  # fmt: skip
        for name in names if not kinds.keys() <= {*names} else ():
            if left := sorted((p.name for p in kinds.pop(name, ())), key=by_number):
                more = " ..." * (len(left) > 1)
                messages.append(f"{len(left)} images are no frames ({why}): {left[0]}{more}")
    if kinds.keys() <= {*deep}:
        messages.append("images of one channel with more than 8 bits are taken as pictures; are "
                        "they depth maps? Then give those in colour")  # fmt: skip
    for one, two in itertools.combinations(kinds.values() if folder else (), 2):
        numbers = [{(*re.findall(r"\d+", p.stem),) for p in kind} for kind in (one, two)]
        least = min(len(one), len(two))
        # The numbers of fewer than three images may agree by chance
        if least >= 3 and 2 * len(set.intersection(*numbers)) > least:
            names = [min((p.name for p in kind), key=by_number) for kind in (one, two)]
            chosen = re.sub(r"\d+", "*", glob.escape(names[0]))
            raise ReobjError(
                f"{folder}: two kinds of images, {' and '.join(names)}; which are the frames? "
                f"Give a glob in quotes, such as '{Path(folder) / chosen}'"
            )
    return [p for kind in kinds.values() for p in kind], messages


# ---- Order and times of names --------------------------------------------------------------------


def by_number(name: str) -> tuple[Any, ...]:
    """Return a key that sorts names by the numbers in them, image2 before image10.

    Copies follow the original: a.jpg, a(1).jpg. Case is ignored.
    """
    path = PurePath(name.casefold())
    parts = re.split(r"(\d+)", path.stem)  # text and numbers in turn
    return ([int(part) if k % 2 else part for k, part in enumerate(parts)], path.suffix, name)


def sorted_names(names: Iterable[str]) -> list[str]:
    """Sort names by the numbers in them."""
    return sorted(names, key=by_number)


class TimeUnit(enum.Enum):
    """Units of time stamps; the value is the number of units in a second."""

    s = 1.0
    ms = 1e3
    us = 1e6
    ns = 1e9


def is_date(time_s: float) -> bool:
    """Test whether a time in s since 1970 is a plausible date: from 2000 to 2100."""
    return 946684800 < time_s < 4102444800


def times_of_names(names: Sequence[str]) -> Array | None:
    """Read the times of images (F,) in s from names that are time stamps; None for other names.

    The time stamp is the last number of a name: with a decimal point in s (TUM's
    1305031102.175304.png), else a date as s, ms, us or ns since 1970 (10, 13, 16, 19 digits).
    """
    words = [re.findall(r"\d+(?:\.\d+)?", Path(name).stem)[-1:] for name in names]
    if not words or not all(words):
        return None
    numbers = np.array([float(word) for (word,) in words])
    steps = np.diff(numbers)
    if (steps <= 0).any():
        return None
    if all("." in word for (word,) in words):  # in s, unless closer than on the fastest phones
        return numbers if not len(steps) or np.median(steps) >= 1 / 240 else None
    units = [unit.value for unit in TimeUnit if all(map(is_date, numbers / unit.value))]
    return numbers / units[0] if units else None


# ---- Reading -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Header:
    """Header of an image file.

    Attributes:
        size: (w, h) in px, upright. frames: of an animated file, else 1.
        is_gray: one channel; also with a palette: masks use palettes, photos do not.
        is_deep: one channel of more than 8 bits. orientation: EXIF's, 1 (upright) to 8.
    """

    size: tuple[int, int]
    is_gray: bool = False
    is_deep: bool = False
    frames: int = 1
    orientation: int = 1


def exif_orientation(path: Path) -> int:
    """Return the EXIF orientation of a photo, 1 to 8; 1 (upright) where there is none.

    `read_image` returns images upright: 2 to 4 are mirrored or turned by 180 deg, 5 to 8 have width
    and height exchanged. 6 turns the stored pixels clockwise, 8 anticlockwise.
    """
    return getattr(header(path), "orientation", 1)


def header(path: Path) -> Header | None:
    """Read the header of an image file; None if Pillow cannot."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # many pixels, as photos of phones have
            with PillowImage.open(path) as image:
                exif = PillowImage.Exif()
                with contextlib.suppress(Exception):  # damaged: upright
                    # Not getexif(): of a PNG it decodes the pixels, and it reads XMP, which OpenCV
                    # does not
                    exif.load(image.info.get("exif", b""))
                exif = image.getexif() if image.format == "TIFF" else exif
                stated: Any = exif.get(274)
                turn = int(stated) if stated in range(1, 9) else 1
                turned = image.format != "TIFF" and turn >= 5  # Pillow turns TIFF itself
                return Header(
                    image.size[::-1] if turned else image.size,
                    image.mode[0] in "1LPIF" and image.mode != "LAB",
                    image.mode[0] in "IF",
                    # The second picture of a JPEG (MPO) is a preview or a gain map
                    1 if image.format == "MPO" else getattr(image, "n_frames", 1),
                    turn,
                )
    except Exception:  # Pillow raises ten types of errors for damaged files
        return None


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> npt.NDArray[Any] | None:
    """Read an image file with OpenCV's `flags`, faster than Pillow; None if it is no image."""
    try:
        data = np.fromfile(path, np.uint8)
        return cv2.imdecode(data, flags) if len(data) else None
    except (OSError, cv2.error):
        return None


# ---- Decoding ------------------------------------------------------------------------------------


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


def animation_frames(path: Path) -> Generator[Decoded]:
    """Decode an animated image file, whose header can be read."""
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
