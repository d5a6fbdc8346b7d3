"""Map names and numbers in files of detections to the frames of a video: one rule for all formats.

Names are matched to those of the source's images (`frame_lookup`). If none matches, the number in a
name is that of an image, or of a frame, counted from 0 or 1 as inferred from the numbers. Ambiguous
numbers are an error, or a message if the format has a convention.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from reobj.files import shortened
from reobj.frame_lookup import frames_by_name
from reobj.types import IntArray, ReobjError


class Frames(Protocol):
    """Attributes of a `Video` that are used here."""

    names: list[str]
    files: list[Path]
    times_s: Any
    source: str

    @property
    def frame_count(self) -> int:
        """Number of frames of the source, 0: unknown."""


def original_name(name: str) -> str:
    """Return the name that an image had before its export by Roboflow; other names unchanged.

    >>> original_name("frame_0001_png.rf.3f2a9c.jpg")
    'frame_0001.png'
    """
    match = re.search(r"_(jpe?g|png|bmp|webp|tiff?)\.rf\.[^./\\]+", name, re.IGNORECASE)
    return f"{name[: match.start()]}.{match[1]}" if match else name


def last_numbers(names: Sequence[str]) -> IntArray:
    """Return the last whole number (N,) in each name without its suffix, -1 where there is none.

    Numbers before a letter do not count: they may be part of a hash.
    """
    stems = [re.split(r"[\\/]", name)[-1] for name in names]
    stems = [stem.rpartition(".")[0] or stem for stem in stems]
    digits = [re.findall(r"\d+(?![0-9A-Za-z])", stem) for stem in stems]
    return np.array([int(d[-1][-18:]) if d else -1 for d in digits], np.int64)  # 18 digits fit


def first_number(numbers: IntArray, frame_count: int, listed: bool = False) -> int | None:
    """Infer whether distinct frame numbers count from 0 or from 1; None: ambiguous.

    Args:
        numbers: (N,) at least one. frame_count: of the source, 0: unknown.
        listed: numbers include frames without detections: all frames, or every N-th.
    """
    low = int(numbers.min())
    high = int(numbers.max())
    if low <= 0:
        return 0
    if frame_count and high == frame_count:  # counted from 0 it is beyond the last frame
        return 1
    step = int(np.gcd.reduce(np.diff(np.unique(numbers)))) if listed else 0
    if step > 1 and low % step in (0, 1):
        return low % step
    return 1 if step == 1 and low == 1 else None


def frames_of_numbers(
    numbers: IntArray, frame_count: int, first: str, usual: int | None, listed: bool, where: str
) -> tuple[IntArray, str]:
    """Convert frame numbers (N,) of a file to those of the source, from 0.

    Args:
        first: number of the first frame, "": inferred.
        usual: convention of the format, used for ambiguous numbers; None: they are an error.
    Returns:
        frames (N,), and a message about the assumption, "" if it is the usual one.
    Raises:
        ReobjError: ambiguous numbers.
    """
    if not len(numbers):
        return numbers, ""
    option = "--set detect.first_frame="
    start = int(first) if first else first_number(numbers, frame_count, listed)
    if start is None and usual is None:
        low = int(numbers.min())
        high = int(numbers.max())
        raise ReobjError(
            f"{where}: numbers {low} to {high} count frames from 0, or from 1 (then the first of "
            f"them is frame {low - 1}); say which with {option}0 or {option}1"
        )
    begin = start if start is not None else usual or 0
    text = f"frame numbers {int(numbers.min())} to {int(numbers.max())} are taken as "
    text += "0-based" if begin == 0 else "counted from 1"
    unclear = start is None and int(numbers.min()) == 1 and begin == 0
    if unclear:
        text += f", there is no 0; if they count from 1: {option}1"
    return numbers - begin, text if unclear or (begin != usual and not first) else ""


def frames_of_names(
    names: Sequence[str],
    video: Frames,
    where: str,
    first: str = "",
    usual: int | None = None,
    listed: bool = False,
) -> tuple[IntArray, str]:
    """Find the frames of image names, or of ids used as names.

    Args:
        names: (N,) with or without folders and suffix.
        where: source of the names, for messages. first, usual, listed: as in `frames_of_numbers`.
    Returns:
        frame (N,) of each, -1: none; and a message about the rule, "" if all file names match.
    Raises:
        ReobjError: no rule matches, or several do.
    """
    distinct, row = np.unique(np.array(names, object), return_inverse=True)
    given = [original_name(name) for name in distinct.tolist()]
    if not given:
        return np.empty(0, np.int64), ""
    if video.names:
        frame, rule = frames_by_name(given, video.files or video.names, where)
        if rule:
            unmatched = [name for name, f in zip(given, frame.tolist(), strict=True) if f < 0]
            text = f"{len(unmatched)} names match no image of the video: {shortened(unmatched)}"
            return frame[row], text if unmatched else ""
    number = last_numbers(given)
    if number.min() < 0 or len(np.unique(number)) < len(number):
        name = given[int(number.argmin())]
        why = f"{name!r} has no number" if number.min() < 0 else "the last numbers repeat"
        expected = "names of its images" if video.names else "names that end in the frame's number"
        raise ReobjError(f"{where}: names such as {name!r} match no frame of the video ({why}); "
                         f"expected {expected}")  # fmt: skip
    frame, text = _by_image_number(number, video, given)
    if text and not first:
        return frame[row], text
    frame, text = frames_of_numbers(number, video.frame_count, first, usual, listed, where)
    if video.frame_count and (number.min(), number.max()) == (0, video.frame_count - 1):
        return frame[row], ""  # they cover the first to the last frame: unambiguous
    rule = "the number in a name is the frame's"
    return frame[row], f"{rule}: {text}" if text else f"{rule}, from {usual}"


def _by_image_number(number: IntArray, video: Frames, given: Sequence[str]) -> tuple[IntArray, str]:
    """Match numbers (N,) to the last numbers in the names of images.

    Returns:
        frames (N,), -1: none, and a message; or `number` and "" if they do not match.
    """
    image_number = last_numbers(video.names)
    if not video.names or video.times_s is not None or image_number.min() < 0:
        return number, ""
    if len(np.unique(image_number)) < len(image_number):
        return number, ""
    order = np.argsort(image_number)
    at = order[np.searchsorted(image_number[order], number).clip(max=len(image_number) - 1)]
    matched = image_number[at] == number
    missing = [name for name, match in zip(given, matched.tolist(), strict=True) if not match]
    begin = first_number(number, video.frame_count)
    position = begin is not None and number.max() - begin < video.frame_count
    if not matched.any() or (missing and position):  # numbers of frames, not of images
        return number, ""
    text = f"the number in a name or id is that of an image ({given[0]}: {video.names[at[0]]})"
    text += f"; {len(missing)} match none: {shortened(missing)}" if missing else ""
    return np.where(matched, at, -1), text
