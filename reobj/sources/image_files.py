"""Image files: selection, order and times of the frames of a folder; reading images.

Start at `list_images`.
"""

from __future__ import annotations

import contextlib
import enum
import glob
import itertools
import math
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage

from reobj.types import Array, ReobjError

IMAGE_FPS = 30.0  # Hz, rate of images without times; chosen: most phones record at 30 Hz
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class ImageList:
    """The frames of an image folder.

    Attributes:
        files: in order. usual: those whose header has the most common (upright) size.
        messages: images that are no frames, for the user.
    """

    files: list[Path]
    usual: list[Path]
    messages: list[str]


def list_images(source: str) -> ImageList:
    """List the images of a folder, glob or single file in the order of their names.

    Left out are images of one channel with more than 8 bits (depth), and images of one channel or
    with a name such as mask or depth beside colour images of the same numbers.

    Returns:
        an empty list for videos and missing files.
    Raises:
        ReobjError: no images; two kinds of images, either of which may be the frames; or too many
            sizes.
    """
    unread = (  # of images that not every build of OpenCV reads
        *(".heic", ".heif", ".avif", ".gif", ".jxl", ".jp2", ".exr", ".hdr", ".ppm", ".pgm"),
        *(".tga", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".raw"),
    )
    path = Path(source)
    if path.is_file():
        suffix = path.suffix.lower()
        if suffix in unread and suffix != ".gif":  # .gif is read as a video
            raise ReobjError(f"{source}: {path.suffix} files are not read; convert it to .jpg")
        return _sized(source, [path] if suffix in IMAGE_SUFFIXES else [], {path: header(path)}, [])
    if not path.is_dir() and not re.search(r"[*?\[]", source):
        return ImageList([], [], [])
    paths = [p for p in _paths(path) if not p.name.startswith(".")]
    files = [p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES]
    others = Counter(p.suffix for p in paths if p.suffix.lower() in unread)
    messages = [
        f"{n} {suffix} files are not read; convert them to .jpg" for suffix, n in others.items()
    ]
    if not files:
        folders = sorted(p.name for p in paths if p.is_dir())[:9]
        more = [f"its folders: {', '.join(folders)}"] if folders and path.is_dir() else []
        fault = f"no images there (looked for {' '.join(IMAGE_SUFFIXES)})"
        raise ReobjError("; ".join([f"{source}: {fault}", *messages, *more]))
    headers = {p: header(p) for p in files}
    files, left_out = _only_pictures(files, headers, source if path.is_dir() else "")
    return _sized(source, files, headers, messages + left_out)


def _paths(path: Path) -> list[Path]:
    """List a folder, or the matches of a glob in a folder whose name may have glob characters."""
    if path.is_dir():
        return list(path.iterdir())
    if path.parent.is_dir():
        return [path.parent / name for name in glob.glob(path.name, root_dir=path.parent)]
    return [Path(name) for name in glob.glob(str(path))]


def _sized(
    source: str, files: list[Path], headers: dict[Path, Header | None], messages: list[str]
) -> ImageList:
    """Sort files, and select those of the most common size."""
    sizes = Counter(head.size for p in files if (head := headers[p]) is not None)
    size, most = max(sizes.items(), key=lambda item: (item[1], math.prod(item[0])),
                     default=((0, 0), 0))  # fmt: skip
    if 2 * most < sizes.total():
        raise ReobjError(
            f"{source}: {sizes.total()} images of {len(sizes)} sizes, at most {most} of the same "
            f"({size[0]}x{size[1]}); expected one size: give a folder or a glob in quotes of those"
        )
    by_name = dict(zip(files, (p.name for p in files), strict=True))
    order = {name: k for k, name in enumerate(sorted_names(by_name.values()))}
    files = sorted(files, key=lambda p: (order[p.name], str(p)))
    usual = [p for p in files if (head := headers[p]) is not None and head.size == size]
    return ImageList(files, usual, messages)


# ---- Which images are frames ---------------------------------------------------------------------


@dataclass(slots=True)
class _Kind:
    """Images whose names differ only in their numbers."""

    files: list[Path]
    words: set[str]
    numbers: set[tuple[int, ...]]
    color: bool

    def shares(self, other: _Kind, least: Callable[[int, int], int]) -> bool:
        """Test whether more than half of the smaller (min) or larger (max) kind shares numbers."""
        count = least(len(self.numbers), len(other.numbers))
        return () not in self.numbers and 2 * len(self.numbers & other.numbers) > count

    @property
    def is_named_otherwise(self) -> bool:
        """Test for a word for images that are no pictures.

        Those of 7-Scenes, ScanNet, 3D Scanner App, NeRFCapture, DAVIS, Replica, Hypersim, Record3D.
        """
        words = (
            "depth depthmap disp disparity conf confidence mask masks matte alpha seg segm "
            "segmentation semantic semantics label labels instance instances panoptic normal "
            "normals thumb thumbs thumbnail preview ir infrared flow albedo uncertainty"
        )
        return not self.words.isdisjoint(words.split())

    def is_named_picture(self, other: _Kind) -> bool:
        """Test whether these names have a word for pictures that the other names lack."""
        pictures = {"color", "colour", "rgb", "image", "img", "frame", "photo"}
        return bool((self.words - other.words) & pictures)


def _only_pictures(
    files: list[Path], headers: dict[Path, Header | None], folder: str
) -> tuple[list[Path], list[str]]:
    """Separate pictures from depth maps, masks etc.

    Args:
        folder: the source if it is a folder, "" for a glob, which selects a kind by itself.
    Returns:
        the pictures, and messages.
    """
    messages = []
    deep = [p for p in files if (h := headers[p]) is not None and h.channels == 1 and h.bits > 8]
    if len(deep) == len(files):
        messages.append("images of one channel with more than 8 bits are taken as pictures; are "
                        "they depth maps? Then give those in colour")  # fmt: skip
    elif deep:
        files = [p for p in files if p not in set(deep)]
        messages.append(_left_out(deep, "one channel with more than 8 bits, as depth maps have"))
    kinds = _kinds(files, headers)
    any_color = any(kind.color for kind in kinds)
    for kind in list(kinds):
        others = [k for k in kinds if k is not kind]
        gray = any_color and not kind.color
        named = kind.is_named_otherwise
        beside = [k for k in others if kind.shares(k, min)]
        if gray and (named or any(k.color for k in beside)):
            messages.append(_left_out(kind.files, "one channel, beside images in colour"))
            kinds.remove(kind)
        elif named and any(not k.is_named_otherwise for k in beside):
            messages.append(_left_out(kind.files, "by its name; others have the same numbers"))
            kinds.remove(kind)
    least = 3  # images of each of two kinds: the numbers of fewer may agree by chance
    for kind in list(kinds) if folder else ():
        rivals = [k for k in kinds if k is not kind and kind.shares(k, max)]
        rivals = [k for k in rivals if min(len(k.files), len(kind.files)) >= least]
        if any(k.is_named_picture(kind) and not kind.is_named_picture(k) for k in rivals):
            messages.append(_left_out(kind.files, "by its name; others have the same numbers"))
            kinds.remove(kind)
    for kind, other in itertools.combinations(kinds if folder else (), 2):
        if kind.shares(other, max) and min(len(kind.files), len(other.files)) >= least:
            names = [min((p.name for p in k.files), key=by_number) for k in (kind, other)]
            raise ReobjError(
                f"{folder}: two kinds of images, {' and '.join(names)}; which are the frames? "
                f"Give a glob in quotes, such as '{Path(folder) / _glob_of(names[0])}'"
            )
    return [p for kind in kinds for p in kind.files], messages


def _left_out(files: Sequence[Path], why: str) -> str:
    first = min((p.name for p in files), key=by_number)
    return f"{len(files)} images are no frames ({why}): {first}" + " ..." * (len(files) > 1)


def _kinds(files: Sequence[Path], headers: dict[Path, Header | None]) -> list[_Kind]:
    """Group images by their names without numbers; copies, a(1).jpg, belong to the original."""
    groups: dict[str, list[tuple[Path, str]]] = {}
    for path in files:
        stem = re.sub(r"\s*\(\d+\)$", "", path.stem.casefold())
        groups.setdefault(re.sub(r"\d+", "#", stem) + path.suffix.lower(), []).append((path, stem))
    kinds = []
    for text, members in groups.items():
        numbers = {tuple(map(int, re.findall(r"\d+", stem))) for _, stem in members}
        known = [h for path, _ in members if (h := headers[path]) is not None]
        color = 2 * sum(h.channels == 1 for h in known) <= len(known)
        words = set(re.split(r"[^a-z]+", text.rpartition(".")[0]))
        kinds.append(_Kind([path for path, _ in members], words, numbers, color))
    return kinds


def _glob_of(name: str) -> str:
    """Return a glob of all names that differ from this one only in their numbers."""
    return re.sub(r"\d+", "*", glob.escape(name))


# ---- Order and times of names --------------------------------------------------------------------


def by_number(name: str) -> tuple[Any, ...]:
    """Return a key that sorts names by the numbers in them, image2 before image10.

    Copies follow the original: a.jpg, a(1).jpg. Case is ignored.
    """
    stem, dot, suffix = name.rpartition(".")
    stem, suffix = (stem, suffix) if dot else (name, "")
    parts = re.split(r"(\d+)", stem.casefold())
    key = [(bool(k % 2), int(part) if k % 2 else part) for k, part in enumerate(parts) if part]
    return (key, suffix.casefold(), name)


def sorted_names(names: Iterable[str]) -> list[str]:
    """Sort names by the numbers in them, decimal numbers by their value."""
    names = list(names)
    if (values := _decimals(names)) is None:
        return sorted(names, key=by_number)
    order = sorted(range(len(names)), key=lambda k: (values[k], by_number(names[k])))
    return [names[k] for k in order]


def _decimals(names: Sequence[str]) -> list[float] | None:
    """Read the numbers at the end of otherwise equal names; None if the names differ elsewhere."""
    decimal = re.compile(r"(.*?)((?:(?<![^_= ])-)?\d+(?:\.(\d+))?)")  # no hyphen after a word
    matches = [decimal.fullmatch(Path(name).stem.casefold()) for name in names]
    known = [match for match in matches if match is not None]
    if not known or len(known) < len(names) or len({match[1] for match in known}) > 1:
        return None
    digits = [match[3] for match in known if match[3]]
    # 1.8, 1.9, 1.10 are two counters: decimals of unequal length do not end in 0 (except 10.0)
    if len(set(map(len, digits))) > 1 and any(len(d) > 1 and d.endswith("0") for d in digits):
        return None
    return [float(match[2]) for match in known]


class TimeUnit(enum.Enum):
    """Units of time stamps; the value is the number of units in a second."""

    s = 1.0
    ms = 1e3
    us = 1e6
    ns = 1e9


LEAST_STAMP = 1e9  # lower whole numbers are counters; chosen: s since 1970 have ten digits


def is_date(time_s: float) -> bool:
    """Test whether a time in s since 1970 is a plausible date: from 2000 to 2100."""
    return 946684800 < time_s < 4102444800


def times_of_names(names: Sequence[str]) -> Array | None:
    """Read the times of images (F,) in s from names that are time stamps; None for other names.

    Such as TUM's 1305031102.175304.png.

    The time stamp is the last number of a name and has a decimal point or at least ten digits. Its
    unit, s, ms, us or ns, is the one that gives a plausible frame rate, if possible with a
    plausible date.
    """
    words = [re.findall(r"\d+(?:\.\d+)?", Path(name).stem)[-1:] for name in names]
    if not words or not all(words):
        return None
    decimals = _decimals(names)
    points = ["." in word for (word,) in words]
    numbers = np.array(decimals or [float(word) for (word,) in words])
    if not (all(points) or (decimals and any(points)) or numbers.min() >= LEAST_STAMP):
        return None
    steps = np.diff(numbers)
    if (steps <= 0).any():
        return None
    units = []  # plausible ones: (no date, |log| of the rate over the usual one, units per s)
    for unit in TimeUnit:
        step_s = float(np.median(steps)) / unit.value if len(steps) else 1 / IMAGE_FPS
        first_s = float(numbers[0]) / unit.value
        dated = is_date(first_s)
        clock = dated or (first_s < 1e9 and len(steps) > 0)  # or since power-on
        if clock and 1 / 240 <= step_s <= 10:  # s: from the fastest phones to single photos
            units.append((not dated, abs(math.log(step_s * IMAGE_FPS)), unit.value))
    return numbers / min(units)[2] if units else None


# ---- Reading -------------------------------------------------------------------------------------

PIXELS_MAX = 1 << 28  # pixels of an image; chosen: above the 200 megapixels of phones; 800 MB (BGR)


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> npt.NDArray[Any] | None:
    """Read an image file with OpenCV's `flags`; None if it is no image.

    Raises:
        ReobjError: the header declares more than PIXELS_MAX pixels (decompression bomb).
    """
    try:
        data = np.fromfile(path, np.uint8)
        declared = header_of(data.tobytes())
        if declared is not None and (pixels := math.prod(declared.size)) > PIXELS_MAX:
            raise ReobjError(f"{path}: {pixels} pixels, at most {PIXELS_MAX} are allowed")
        image = cv2.imdecode(data, flags) if len(data) else None
    except (OSError, cv2.error):
        return None
    return None if image is None else np.asarray(image)


@dataclass(frozen=True, slots=True)
class Header:
    """Header of an image file: (w, h) in px, upright; channels without alpha; bits of each.

    Images with a palette have one channel: masks use palettes, photos do not.
    """

    size: tuple[int, int]
    channels: int = 3
    bits: int = 8


def exif_orientation(path: Path) -> int:
    """Return the EXIF orientation of a photo, 1 to 8; 1 (upright) where there is none."""
    with contextlib.suppress(Exception), PillowImage.open(path) as image:
        return int(image.getexif().get(274, 1))
    return 1


def header(path: Path) -> Header | None:
    """Read the header of an image file; None for unknown formats."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        data = b""
        # Bytes of headers without, and of those with a photo's thumbnail; the whole file
        for count in (1 << 12, 1 << 17, -1):
            data += file.read(count)
            head = header_of(data)
            if head is not None and min(head.size) > 0:
                return head
    return None


def header_of(data: bytes) -> Header | None:
    """Read the header of an image of IMAGE_SUFFIXES; None if truncated or of another format."""
    with contextlib.suppress(struct.error, IndexError):
        if data.startswith(b"\x89PNG"):
            width, height, bits, kind = struct.unpack_from(">IIBB", data, 16)
            return Header((width, height), 3 if kind in (2, 6) else 1, bits)
        if data.startswith(b"BM"):
            width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
            return Header((abs(width), abs(height)), 3 if bits > 8 else 1)
        if data.startswith(b"\xff\xd8"):
            return _jpeg_header(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            tags = _tiff_tags(data)
            channels = tags.get(277, 1)
            bits = tags.get(258, 1)
            bits = bits if channels == 1 else 8
            return Header(_upright((tags.get(256, 0), tags.get(257, 0)), tags), channels, bits)
        if data[8:15] == b"WEBPVP8":
            return Header(_webp_size(data))
    return None


def _upright(size: tuple[int, int], tags: dict[int, int]) -> tuple[int, int]:
    """Rotate (w, h) by EXIF's orientation, tag 274: 5 to 8 are quarter turns."""
    return size[::-1] if 5 <= tags.get(274, 1) <= 8 else size


def _jpeg_header(data: bytes) -> Header:
    """Read the first start-of-frame segment, and the EXIF segment before it."""
    at = 2
    tags = dict[int, int]()
    others = (0xC4, 0xC8, 0xCC)  # within the range of start-of-frame markers: tables
    while data[at] == 0xFF and not (0xC0 <= data[at + 1] <= 0xCF and data[at + 1] not in others):
        length = struct.unpack_from(">H", data, at + 2)[0]
        if data[at + 4 : at + 10] == b"Exif\0\0":
            with contextlib.suppress(struct.error, IndexError):  # EXIF is optional
                tags = _tiff_tags(data[at + 10 : at + 2 + length])
        at += 2 + length
    bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
    return Header(_upright((width, height), tags), channels, bits)


def _tiff_tags(data: bytes) -> dict[int, int]:
    """Read the tags of the first directory whose value is a single number."""
    order = "<" if data[:1] == b"I" else ">"
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    tags = [struct.unpack_from(order + "HHII", data, start + 2 + 12 * i) for i in range(count)]
    return {
        tag: value >> 16 * (kind == 3 and order == ">") for tag, kind, n, value in tags if n == 1
    }


def _webp_size(data: bytes) -> tuple[int, int]:
    """Return (w, h) of an extended, lossless or lossy WebP image."""
    if data[15:16] == b"X":
        width, height = (int.from_bytes(data[i : i + 3], "little") + 1 for i in (24, 27))
    elif data[15:16] == b"L":
        (bits,) = struct.unpack_from("<I", data, 21)
        width = (bits & 0x3FFF) + 1
        height = (bits >> 14 & 0x3FFF) + 1
    else:
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    return width, height
