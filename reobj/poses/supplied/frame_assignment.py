"""Which pose of a file belongs to which frame of a video: by name, number, time stamp or order.

A reading is one rule by which all poses of a file find their frames. Where several rules can be
meant, all of them are returned: images or tracks decide (`evidence`), or the user does. The files
are the business of `readers`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.frame_lookup import frames_by_name
from reobj.types import Array, BoolArray, IntArray, ReobjError


@dataclass(frozen=True, slots=True)
class Source:
    """Describe the frames that poses are looked for.

    Attributes:
        frame: (F,) numbers of the frames that are read, in the source, ascending.
        time_s: (F,) seconds. timed: these are measured, not assumed.
        count: frames of the source (0: unknown).
        images: paths of all its images by frame number, () for videos.
    """

    frame: IntArray
    time_s: Array
    count: int
    images: tuple[str, ...] = ()
    timed: bool = True


@dataclass(frozen=True, slots=True)
class Reading:
    """Hold one way to find the frames of N poses.

    Attributes:
        key: what `--set poses.frames_by=` calls it. rule: the same in words.
        row: (F,) pose of each frame that is read, -1: none.
        outside: poses that it puts on no frame of the source.
    """

    key: str
    rule: str
    row: IntArray
    outside: int


def _reading(key: str, rule: str, frame: IntArray, source: Source) -> Reading:
    """Make a reading of the frame (N,) in the source of each pose, negative: none."""
    row_of = {n: row for row, n in enumerate(frame.tolist()) if n >= 0}
    row = np.array([row_of.get(n, -1) for n in source.frame.tolist()], np.int64)
    end = source.count or np.iinfo(np.int64).max
    return Reading(key, rule, row, int(((frame < 0) | (frame >= end)).sum()))


def readings(
    count: int,
    names: Sequence[str],
    stamps_s: Array | None,
    source: Source,
    where: str,
    own: bool = False,
) -> list[Reading]:
    """List the readings of `count` poses that the file and the source leave open.

    Names are unique keys. Without them numbers count, then times, then the order.

    Args:
        names, stamps_s: of the poses, or () and None. where: the file, for errors.
        own: the stamps are those that we wrote of the same source.
    Returns:
        readings that give different poses to the frames that are read, the likeliest first; [] if
        no pose belongs to a frame.
    Raises:
        ReobjError: a key is not unique, or there are other numbers of rows than frames.
    """
    if names:
        found = _by_names(names, source, where)
    elif stamps_s is not None:
        found = _by_stamps(stamps_s, source, own)
    else:
        found = _by_order(count, source, where)
    inside = {reading.key == "time": True for reading in found if not reading.outside}
    kept: list[Reading] = []
    for reading in found:
        if reading.key == "time":
            excluded = 2 * reading.outside > count and False in inside
        else:
            excluded = reading.outside > 0 and False in inside
        same = any(np.array_equal(reading.row, other.row) for other in kept)
        if not excluded and not same and (reading.row >= 0).any():
            kept.append(reading)
    return kept


# ---- Names and numbers ---------------------------------------------------------------------------


def _by_names(names: Sequence[str], source: Source, where: str) -> list[Reading]:
    """Read names as those of images, or else the numbers in them."""
    if source.images:
        frame, rule = frames_by_name(names, source.images, where)
        if (frame >= 0).any():
            return [_reading("name", rule, frame, source)]
    return by_numbers(numbers_of_names(names, where), source, "numbers in the image names")


def by_numbers(number: IntArray, source: Source, noun: str) -> list[Reading]:
    """List what numbers (N,) of poses may mean; negative: none. `noun` names them in the rules.

    Of images, whose names have numbers too: the same; or one side counts from 0, the other from 1.
    Of a video: frames counted from 0 or from 1, or every k-th frame, numbered anew.
    """
    known = number >= 0
    if not known.any():
        return []
    images = _numbers_of_images(source.images)
    if len(images):
        return _by_image_numbers(number, images, source, noun)
    least, most = int(number[known].min()), int(number[known].max())
    ways = [(f"number{first}", 1, first) for first in (0, 1)]
    for step in _steps(most - min(least, 1) + 1, int(known.sum()), source.count):
        ways += [(f"every{step}from{first}", step, first) for first in (0, 1)]
    found = []
    for key, step, first in ways:
        frame = np.where(known, step * (number - first), -1)
        if least >= first and (step == 1 or frame.max() < source.count):
            of = f" of one frame in {step}" if step > 1 else ""
            found.append(_reading(key, f"{noun}{of}, counted from {first}", frame, source))
    return found


def _by_image_numbers(
    number: IntArray, images: IntArray, source: Source, noun: str
) -> list[Reading]:
    """List what numbers (N,) of poses may mean beside those of images (F,)."""
    known = number >= 0
    frame_of = {n: frame for frame, n in enumerate(images.tolist())}
    ways = [("number", noun, 0)]
    if number[known].min() >= 1 and images.min() == 0:
        ways.append(("number1", f"{noun}, counted from 1, those of the images from 0", -1))
    if number[known].min() == 0 and images.min() == 1:
        ways.append(("number0", f"{noun}, counted from 0, those of the images from 1", 1))
    found = []
    for key, rule, offset in ways:
        frame = np.array([frame_of.get(n + offset, -1) for n in number.tolist()], np.int64)
        found.append(_reading(key, rule, np.where(known, frame, -1), source))
    if found[0].outside and not np.isin(images, number[known]).all():  # some of both fit none
        for first in (0, 1):
            rule = f"{noun} as places in the order of the images, counted from {first}"
            found.append(
                _reading(f"place{first}", rule, np.where(known, number - first, -1), source)
            )
    if known.all() and len(number) == len(images):
        order = np.argsort(np.argsort(number))
        found.append(_reading("order", f"order of the {noun}", order, source))
    return found


# Of every k-th frame, numbered anew, some at the end may have no pose (chosen: a tenth)
LOST_SHARE = 0.1


def _steps(numbers: int, known: int, count: int) -> list[int]:
    """List the k for which every k-th of `count` frames, numbered anew, are `numbers` or few more.

    known: how many of the numbers are there; if most are missing, they are not numbered anew.
    """
    if 2 * known < numbers or numbers < 2:
        return []
    steps = range(2, max(count // (numbers - 1), 1) + 1)
    most = numbers + LOST_SHARE * numbers + 1
    return [k for k in steps if numbers <= -(-count // k) <= most]


def numbers_of_names(names: Sequence[str], where: str) -> IntArray:
    """Read the number of each name (N,): the last one by which the names differ; -1: none.

    Raises:
        ReobjError: whichever is taken, two names have the same.
    """
    digits = [re.findall(r"\d+", PurePosixPath(name.replace("\\", "/")).stem) for name in names]
    having = [found for found in digits if found]
    groups = 1 if len({len(found) for found in having}) > 1 else max(map(len, having), default=0)
    for group in range(1, groups + 1):
        number = [int(found[-group][-18:]) if found else -1 for found in digits]  # int64 holds 18
        if len({n for n in number if n >= 0}) == len(having):
            return np.array(number, np.int64)
    if not having:
        return np.full(len(names), -1)
    number = [int(found[-1][-18:]) if found else -1 for found in digits]
    first: dict[int, str] = {}
    for name, n in zip(names, number, strict=True):
        if n >= 0 and first.setdefault(n, name) != name:
            raise ReobjError(
                f"{where}: {first[n]!r} and {name!r} have the same number, and neither is the name "
                "of a frame; give the poses of one camera, or a folder of images with these names"
            )
    raise ReobjError(f"{where}: {names[0]!r} is there twice; expected each image once")


def _numbers_of_images(images: Sequence[str]) -> IntArray:
    """Return the numbers (F,) in the names of images; (0,) where they are no unique keys."""
    try:
        number = numbers_of_names(images, "")
    except ReobjError:
        return np.arange(0)
    return number if (number >= 0).all() else number[:0]


# ---- Time stamps ---------------------------------------------------------------------------------


EVEN_TIMES = 0.1  # of a step: how far times of numbered frames may be from even ones (chosen)


def numbers_of_times(stamps_s: Array) -> IntArray:
    """Number times (N,), ascending: multiples of their step from 0 on, else one after the other."""
    number = _even_numbers(stamps_s)
    return np.arange(len(stamps_s)) if number is None else number


def _even_numbers(stamps_s: Array) -> IntArray | None:
    """Return times (N,) as multiples of their step, None where they are not even or far from 0."""
    steps = np.diff(stamps_s)
    if len(steps) and stamps_s[0] >= 0:
        number = stamps_s / np.median(steps)
        even = np.abs(number - number.round()).max() < EVEN_TIMES
        if even and number[-1] < 2 * len(number):  # few are missing: they do count from 0
            return np.asarray(number.round(), np.int64)
    return None


EPOCH_S = (946684800.0, 4102444800.0)  # 2000 to 2100, in s since 1970
UNITS = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
STEP_MIN_S = 1e-3  # between poses (chosen: motion capture at 1 kHz)
STEP_MAX_S = 10.0  # (chosen: photos taken one by one)
LEAST_STAMP = 1e9  # whole numbers below are counters (chosen: s since 1970 have ten digits)


def unit_of_stamps(stamps: Array, end_s: float = 0.0) -> tuple[str, float]:
    """Tell the unit of ascending stamps (N,), and how many of it are a second.

    It is the one that gives a date after 2000. Else it is s, unless most stamps in s lie after the
    end of the video and another unit ends with it, or ones of ten digits have a plausible step.

    Args:
        end_s: of the video; 0: unknown.
    """
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    for unit in UNITS:
        if EPOCH_S[0] < stamps[0] / unit[1] < EPOCH_S[1]:
            return unit
    if end_s > 0 and np.median(stamps) > end_s:
        for unit in UNITS:
            ends = 0.5 < stamps[-1] / unit[1] / end_s < 2
            if ends and STEP_MIN_S <= step / unit[1] <= STEP_MAX_S:
                return unit
    if is_whole(stamps) and stamps[-1] >= LEAST_STAMP:
        return next((unit for unit in UNITS if step / unit[1] <= STEP_MAX_S), UNITS[0])
    return UNITS[0]


def is_whole(stamps: Array) -> bool:
    """Tell whether all stamps (N,) are whole numbers."""
    return bool((stamps == np.round(stamps)).all())


LONE_FRAME_S = 1 / 60  # half a frame interval where there is only one frame (chosen: 30 Hz)
STAMP_TOLERANCE_S = 0.02  # between a frame and its pose (default of TUM's associate.py)
SAME_TIME_S = 5e-4  # times in files and containers are rounded to a ms
STAMP_STEP_S = 0.11  # between poses, up to which one between them is interpolated: 10 Hz, jitter


def _by_stamps(stamps_s: Array, source: Source, own: bool) -> list[Reading]:
    """Read stamps (N,), ascending, as times; whole ones as numbers; one a frame as their order."""
    found, time_s, count = list[Reading](), source.time_s, len(stamps_s)
    if (source.timed or own) and stamps_s[0] <= time_s[-1] and stamps_s[-1] >= time_s[0]:
        row = rows_by_time(stamps_s, source.frame, time_s)
        step = float(np.median(np.diff(time_s) / np.diff(source.frame))) if len(time_s) > 1 else 0.0
        end = time_s[-1] + step * max(source.count - 1 - int(source.frame[-1]), 0)
        start = time_s[0] - step * int(source.frame[0])
        tolerance = max(step / 2, STAMP_TOLERANCE_S)
        outside = (stamps_s < start - tolerance) | (stamps_s > end + tolerance)
        found.append(Reading("time", "time stamps", row, int(outside.sum())))
    if found and (own or (found[0].row < 0).all()):  # the same clock, none within the tolerance
        return found
    clock = (
        ""
        if found or not source.timed
        else ", the time stamps are of another clock than the frames"
    )
    if is_whole(stamps_s) and 0 <= stamps_s[0] and stamps_s[-1] < LEAST_STAMP:
        noun = "whole numbers in place of time stamps"
        found += by_numbers(stamps_s.astype(np.int64), source, noun)
    elif not source.timed and count != source.count:
        number = _even_numbers(stamps_s)
        if number is not None:
            noun = f"time stamps as multiples of {float(np.median(np.diff(stamps_s))):.4g} s"
            found.append(_reading("number0", f"{noun}, from 0", number, source))
            found.append(_reading("first0", f"{noun}, from the first", number - number[0], source))
    if count == source.count:
        rule = f"order, one row for each frame of the source{clock}"
        found.append(_reading("order", rule, np.arange(count), source))
    elif count == len(source.frame) and not found:
        rule = f"order, one row for each frame that is read{clock}"
        found.append(Reading("order", rule, np.arange(count), 0))
    return found


def rows_by_time(stamps_s: Array, frame: IntArray, time_s: Array) -> IntArray:
    """Match the nearest stamp within half a frame interval and `STAMP_TOLERANCE_S`.

    Args:
        stamps_s: (N,) ascending. time_s: (F,) of the frames.
    Returns:
        row (F,) of each frame, -1: none.
    """
    steps = np.diff(time_s) / np.maximum(np.diff(frame), 1)
    half = 0.5 * float(np.median(steps)) if len(steps) else LONE_FRAME_S
    after = np.searchsorted(stamps_s, time_s).clip(1, max(len(stamps_s) - 1, 1))  # (F,)
    pair = np.stack([after - 1, after], 1).clip(max=len(stamps_s) - 1)  # (F, 2)
    offset = np.abs(stamps_s[pair] - time_s[:, None])
    nearest = np.take_along_axis(pair, offset.argmin(1)[:, None], 1)[:, 0]
    tolerance = min(half, STAMP_TOLERANCE_S) * (1 + 1e-6)
    return np.where(offset.min(1) <= tolerance, nearest, -1)


def interpolated(cam_from_world: Array, stamps_s: Array, time_s: Array) -> tuple[Array, BoolArray]:
    """Interpolate poses at times (F,) between those at most `STAMP_STEP_S` apart.

    Rotations by slerp, centres along a line.

    Returns:
        cam_from_world (n, 3, 4), and at which times (F,): where two such poses are, neither of
        them at that very time.
    """
    after = np.searchsorted(stamps_s, time_s, side="right").clip(1, len(stamps_s) - 1)
    a, b = after - 1, after
    use = (time_s - stamps_s[a] > SAME_TIME_S) & (stamps_s[b] - time_s > SAME_TIME_S)
    use &= stamps_s[b] - stamps_s[a] <= STAMP_STEP_S
    use &= np.isfinite(cam_from_world[a] + cam_from_world[b]).all((1, 2))
    a, b = a[use], b[use]
    share = ((time_s[use] - stamps_s[a]) / (stamps_s[b] - stamps_s[a]))[:, None]  # (n, 1)
    start, end = invert_rigid(cam_from_world[a]), invert_rigid(cam_from_world[b])
    turn = Rotation.from_matrix(start[:, :, :3])
    step = (turn.inv() * Rotation.from_matrix(end[:, :, :3])).as_rotvec()
    turned = (turn * Rotation.from_rotvec(share * step)).as_matrix()
    centre = start[:, :, 3] + share * (end[:, :, 3] - start[:, :, 3])
    return invert_rigid(np.concatenate([turned, centre[:, :, None]], 2)), use


# ---- Order ---------------------------------------------------------------------------------------


def _by_order(count: int, source: Source, where: str) -> list[Reading]:
    """Read `count` rows without names or times: one a frame, or rows numbered as the images are."""
    if picked := _by_picked_images(count, source):
        return picked
    rows, last = np.arange(count), int(source.frame[-1])
    if count == source.count:
        return [_reading("order", "order, one row for each frame of the source", rows, source)]
    if count == len(source.frame):
        return [Reading("order", "order, one row for each frame that is read", rows, 0)]
    if last < count:
        rule = f"order, row n for frame n of {source.count or 'an unknown number of'}"
        return [Reading("order", rule, source.frame.copy(), 0)]
    steps = range(2, source.count // max(count - 1, 1) + 1)
    found = [
        _reading(f"every{k}", f"order, a row for one frame in {k}", k * rows, source)
        for k in steps
        if -(-source.count // k) == count
    ]
    if not found:
        what = f"{count} rows, frame numbers up to {last}"
        raise ReobjError(f"{where}: {what}; expected one row a frame")
    return found


def _by_picked_images(count: int, source: Source) -> list[Reading]:
    """Read rows by the numbers in the names of images that were picked out of `count`."""
    number = _numbers_of_images(source.images if len(source.images) != count else ())
    found = []
    for first in (0, 1) if len(number) else ():
        if first <= number.min() and number.max() < count + first:
            frame_of = {n - first: frame for frame, n in enumerate(number.tolist())}
            frame = np.array([frame_of.get(n, -1) for n in range(count)], np.int64)
            rule = f"numbers in the image names, rows counted from {first}"
            found.append(Reading(f"number{first}", rule, _reading("", "", frame, source).row, 0))
    return found


def source_of(video: Any, frame: IntArray, time_s: Array) -> Source:
    """Describe a `Video` whose frames (F,) were read at times (F,) in s."""
    paths = [str(Path(file).absolute()) for file in getattr(video, "files", ())]
    images = tuple(paths or video.names)
    config, count = getattr(video, "config", None), int(video.frame_count)
    if not images and (config is None or (not config.stop and config.every == 1)):
        count = int(frame[-1]) + 1  # what was decoded, not what the container claims
    return Source(
        frame, time_s, count, images, not images or getattr(video, "times_s", None) is not None
    )
