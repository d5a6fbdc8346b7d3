"""Which frame of a video a name or a number in a file of detections means: one rule for all files.

Names are compared with the names of the source's images (`frame_lookup`). Where none fits, the
number in a name counts: that of an image, or of a frame, from 0 or from 1 as the numbers
themselves show. What they do not show is refused, or said where the format has a convention.
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

OPTION = "--set detect.first_frame="  # what a user says where a file does not show it


class Frames(Protocol):
    """What is asked of a `Video` here."""

    names: list[str]
    files: list[Path]
    times_s: Any
    source: str

    @property
    def frame_count(self) -> int:
        """Number of frames of the source, 0: unknown."""


ROBOFLOW = re.compile(r"_(jpe?g|png|bmp|webp|tiff?)\.rf\.[^./\\]+", re.IGNORECASE)


def original_name(name: str) -> str:
    """Return the name that an image had before Roboflow exported it, other names as they are.

    >>> original_name("frame_0001_png.rf.3f2a9c.jpg")
    'frame_0001.png'
    """
    found = ROBOFLOW.search(name)
    return f"{name[: found.start()]}.{found[1]}" if found else name


def last_numbers(names: Sequence[str]) -> IntArray:
    """Return the last whole number in each name without its suffix (N,), -1 where there is none.

    Numbers before a letter do not count: in names with a hash in them.
    """
    stems = [re.split(r"[\\/]", name)[-1] for name in names]
    stems = [stem.rpartition(".")[0] or stem for stem in stems]
    digits = [re.findall(r"\d+(?![0-9A-Za-z])", stem) for stem in stems]
    return np.array([int(d[-1][-18:]) if d else -1 for d in digits], np.int64)  # int64 has 18


def first_number(numbers: IntArray, frame_count: int, listed: bool = False) -> int | None:
    """Find out whether distinct frame numbers count from 0 or from 1; None: they do not show it.

    Args:
        numbers: (N,) at least one. frame_count: of the source, 0: unknown.
        listed: also frames without a detection are in it, so that the first number is that of the
            first frame, or one of every N-th.
    """
    low = int(numbers.min())
    high = int(numbers.max())
    if low <= 0:
        return 0
    if frame_count and high == frame_count:  # from 0 there is no such frame
        return 1
    step = int(np.gcd.reduce(np.diff(np.unique(numbers)))) if listed else 0
    if step > 1 and low % step in (0, 1):
        return low % step
    return 1 if step == 1 and low == 1 else None


def frames_of_numbers(
    numbers: IntArray, frame_count: int, first: str, usual: int | None, listed: bool, where: str
) -> tuple[IntArray, str]:
    """Turn frame numbers (N,) of a file into those of the source, from 0.

    Args:
        first: the number of the first frame as the user says it, "" where it is to be found out.
        usual: what the format counts from where the numbers do not show it; None: refused.
    Returns:
        frames (N,) and what was taken, "" where it was the usual.
    Raises:
        ReobjError: the numbers may count from 0 or from 1; both readings are named.
    """
    if not len(numbers):
        return numbers, ""
    start = int(first) if first else first_number(numbers, frame_count, listed)
    if start is None and usual is None:
        low = int(numbers.min())
        high = int(numbers.max())
        raise ReobjError(
            f"{where}: numbers {low} to {high} count frames from 0, or from 1 (then the first of "
            f"them is frame {low - 1}); say which with {OPTION}0 or {OPTION}1"
        )
    begin = start if start is not None else usual or 0
    text = f"frame numbers {int(numbers.min())} to {int(numbers.max())} are taken as "
    text += "0-based" if begin == 0 else "counted from 1"
    unclear = start is None and int(numbers.min()) == 1 and begin == 0
    if unclear:
        text += f", there is no 0; if they count from 1: {OPTION}1"
    return numbers - begin, text if unclear or (begin != usual and not first) else ""


def frames_of_names(
    names: Sequence[str],
    video: Frames,
    where: str,
    first: str = "",
    usual: int | None = None,
    listed: bool = False,
) -> tuple[IntArray, str]:
    """Find the frames that names of images mean, or ids that stand for names.

    Args:
        names: (N,) with folders or without, with a suffix or without.
        where: what they stand in, for messages. first, usual, listed: of `frames_of_numbers`.
    Returns:
        frame (N,) of each, -1: none; and what to say of the rule, "" for file names that all fit.
    Raises:
        ReobjError: no rule fits, or several do.
    """
    distinct, row = np.unique(np.array(names, object), return_inverse=True)
    given = [original_name(name) for name in distinct.tolist()]
    if not given:
        return np.empty(0, np.int64), ""
    if video.names:
        frame, rule = frames_by_name(given, video.files or video.names, where)
        if rule:
            none = [name for name, f in zip(given, frame.tolist(), strict=True) if f < 0]
            text = f"{len(none)} names are of no image of the video: {shortened(none)}"
            return frame[row], text if none else ""
    number = last_numbers(given)
    if number.min() < 0 or len(np.unique(number)) < len(number):
        name = given[int(number.argmin())]
        why = f"{name!r} has no number" if number.min() < 0 else "the last numbers repeat"
        expected = "names of its images" if video.names else "names that end in the frame's number"
        raise ReobjError(f"{where}: names such as {name!r} mean no frame of the video ({why}); "
                         f"expected {expected}")  # fmt: skip
    frame, text = _by_image_number(number, video, given)
    if text and not first:
        return frame[row], text
    frame, text = frames_of_numbers(number, video.frame_count, first, usual, listed, where)
    if video.frame_count and (number.min(), number.max()) == (0, video.frame_count - 1):
        return frame[row], ""  # from the first frame to the last: there is no other reading
    said = "the number in a name is the frame's"
    return frame[row], f"{said}: {text}" if text else f"{said}, from {usual}"


def _by_image_number(number: IntArray, video: Frames, given: Sequence[str]) -> tuple[IntArray, str]:
    """Match numbers (N,) with the last numbers in the names of images; "": they do not fit."""
    own = last_numbers(video.names)
    if not video.names or video.times_s is not None or own.min() < 0:
        return number, ""
    if len(np.unique(own)) < len(own):
        return number, ""
    order = np.argsort(own)
    at = order[np.searchsorted(own[order], number).clip(max=len(own) - 1)]
    fits = own[at] == number
    missing = [name for name, fit in zip(given, fits.tolist(), strict=True) if not fit]
    begin = first_number(number, video.frame_count)
    position = begin is not None and number.max() - begin < video.frame_count
    if not fits.any() or (missing and position):  # they count the frames, not the images' names
        return number, ""
    text = f"the number in a name or id is that of an image ({given[0]}: {video.names[at[0]]})"
    text += f"; {len(missing)} fit none: {shortened(missing)}" if missing else ""
    return np.where(fits, at, -1), text
