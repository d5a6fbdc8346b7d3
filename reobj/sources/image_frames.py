"""Map names and numbers in files of detections to the frames of a video: one rule for all formats.

Names are matched to those of the source's images (`frames_by_name`). If none matches, the number in
a name is that of an image, or of a frame. A number 0, or one that only counting from 1 places in
the video, decides where frames begin; else the convention of the format; else it is an error.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from reobj.files import shortened
from reobj.formats import frames_by_name
from reobj.sources.recorded import Source
from reobj.types import IntArray, ReobjError


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


def first_number(numbers: IntArray, frame_count: int) -> int | None:
    """Return the number of the first frame if only 0 or only 1 is possible; else None.

    Args:
        numbers: (N,) at least one. frame_count: of the source, 0: unknown.
    """
    if numbers.min() <= 0:
        return 0
    return 1 if numbers.max() == frame_count else None  # from 0 it is beyond the last frame


def frames_of_numbers(numbers: IntArray, source: Source, usual: int | None) -> IntArray:
    """Convert frame numbers (N,) of a file to those of the source, from 0.

    Args:
        usual: number of the first frame by the convention of the format; None: it has none, and
            numbers that leave it open are an error.
    """
    if not len(numbers):
        return numbers
    low, high = int(numbers.min()), int(numbers.max())
    known = first_number(numbers, source.video.frame_count)
    begin = int(source.first) if source.first in ("0", "1") else usual if known is None else known
    if begin is None:
        raise ReobjError(
            f"{source.path}: numbers {low} to {high} count frames from 0, or from 1 (then the "
            f"first of them is frame {low - 1}); say which with --set detect.first_frame=0 or "
            "detect.first_frame=1"
        )
    unclear = not begin and low == 1 and not source.first
    if unclear or (begin != usual and not source.first):
        text = f"frame numbers {low} to {high} are taken as "
        text += "counted from 1" if begin else "0-based"
        unclear_text = ", there is no 0; if they count from 1: --set detect.first_frame=1"
        source.say(text + unclear_text * unclear)
    return numbers - begin


def frames_of_names(names: Sequence[str], source: Source, usual: int | None = None) -> IntArray:
    """Find the frames (N,) of image names, or of ids used as names; -1: none.

    Args:
        names: (N,) with or without folders and suffix. usual: as in `frames_of_numbers`.
    Raises:
        ReobjError: no rule matches, or several do.
    """
    video = source.video
    distinct, row = np.unique(np.array(names, object), return_inverse=True)
    given = [original_name(name) for name in distinct.tolist()]
    if source.describes and not all(name.isdecimal() for name in given):
        source.image_names += given
    if source.describes or not given:
        return np.zeros(len(names), np.int64)
    frame, rule = frames_by_name(given, video.files or video.names, str(source.path))
    if rule:
        unmatched = [name for name, f in zip(given, frame.tolist(), strict=True) if f < 0]
        text = f"{len(unmatched)} names match no image of the video: {shortened(unmatched)}"
        source.say(text * bool(unmatched))
        return np.asarray(frame[row], np.int64)
    number = last_numbers(given)
    if number.min() < 0 or len(np.unique(number)) < len(number):
        name = given[int(number.argmin())]
        why = f"{name!r} has no number" if number.min() < 0 else "their last numbers repeat"
        of = f"is named {video.names[0]!r}" if video.names else "has a number only"
        raise ReobjError(
            f"{source.path}: names such as {name!r} match no frame of the video, whose first frame "
            f"{of}, and {why}; rename them, or list the images of all frames in order "
            "(--set detect.first_frame=order, of a dataset)"
        )
    numbered = _by_image_number(number, source, given)
    if numbered is not None:
        frame = numbered
    else:
        frame = number
        if (number.min(), number.max()) != (0, video.frame_count - 1):  # else it is unambiguous
            source.say("the number in a name is the frame's")
            frame = frames_of_numbers(number, source, usual)
    return np.asarray(frame[row], np.int64)


def _by_image_number(number: IntArray, source: Source, given: Sequence[str]) -> IntArray | None:
    """Match numbers (N,) to the last numbers in the names of images: frames (N,), -1: none.

    None: the images have no such numbers, or the numbers are those of frames.
    """
    video = source.video
    image = last_numbers(video.names)
    unusable = not len(image) or video.times_s is not None or image.min() < 0
    if source.first or unusable or len(np.unique(image)) < len(image):
        return None
    frame_of = {n: frame for frame, n in enumerate(image.tolist())}
    frame = np.array([frame_of.get(n, -1) for n in number.tolist()])
    matched = frame >= 0
    begin = first_number(number, video.frame_count)
    position = begin is not None and number.max() - begin < video.frame_count
    if not matched.any() or (position and not matched.all()):
        return None
    missing = [name for name, match in zip(given, matched.tolist(), strict=True) if not match]
    first = int(matched.argmax())
    example = f"{given[first]}: {video.names[frame[first]]}"
    text = f"the number in a name or id is that of an image ({example})"
    source.say(text + f"; {len(missing)} match none: {shortened(missing)}" * bool(missing))
    return frame
