"""Assign the poses of a file to the frames of a video: by name, number, time stamp or order.

Where a file is ambiguous, all assignments that it allows are returned; the user chooses.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reobj.cameras import invert_rigid
from reobj.frame_lookup import frames_by_name
from reobj.sources.image_files import LEAST_STAMP, TimeUnit, is_date
from reobj.types import Array, BoolArray, IntArray, ReobjError, nearest_of


@dataclass(frozen=True, slots=True)
class SourceFrames:
    """Frames of a video or image folder.

    Attributes:
        frame: (F,) numbers in the source of the frames that are read, ascending.
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
class FrameAssignment:
    """One assignment of N poses to frames.

    Attributes:
        key: its name in `--set poses.frames_by=`. rule: the same in words.
        row: (F,) pose of each frame that is read, -1: none.
        outside: number of poses without a frame in the source.
    """

    key: str
    rule: str
    row: IntArray
    outside: int


def _assignment(key: str, rule: str, frame: IntArray, source: SourceFrames) -> FrameAssignment:
    """Make an assignment from the frame (N,) in the source of each pose, negative: none."""
    row_of = {n: row for row, n in enumerate(frame.tolist()) if n >= 0}
    row = np.array([row_of.get(n, -1) for n in source.frame.tolist()], np.int64)
    end = source.count or np.iinfo(np.int64).max
    return FrameAssignment(key, rule, row, int(((frame < 0) | (frame >= end)).sum()))


def assignments(
    count: int,
    names: Sequence[str],
    stamps_s: Array | None,
    source: SourceFrames,
    where: str,
    is_ours: bool = False,
    by_text: bool = False,
) -> list[FrameAssignment]:
    """List the assignments of `count` poses that the file and the source allow.

    Names are unique keys. Without names numbers are used, then times, then the order.

    Args:
        names, stamps_s: of the poses, or () and None. where: the file, for errors.
        is_ours: this tool wrote the stamps, for the same source.
        by_text: the order of rows is that of the images' names as text.
    Returns:
        assignments that differ for the frames that are read; [] if no pose belongs to a frame.
    Raises:
        ReobjError: a key is not unique, or the number of rows is not that of the frames.
    """
    if names:
        found = _by_names(names, source, where)
    elif stamps_s is not None:
        found = _by_stamps(stamps_s, source, is_ours)
    else:
        found = by_order(count, source, by_text) or _by_counts(count, source, where)
    some_fit = any(a.key != "time" and not a.outside for a in found)
    kept: list[FrameAssignment] = []
    for candidate in found:
        # a clock may start before the video and end after it
        limit = count / 2 if candidate.key == "time" else 0
        excluded = candidate.outside > limit and some_fit
        same = any(np.array_equal(candidate.row, other.row) for other in kept)
        if not excluded and not same and (candidate.row >= 0).any():
            kept.append(candidate)
    return kept


# ---- Names and numbers ---------------------------------------------------------------------------


def _by_names(names: Sequence[str], source: SourceFrames, where: str) -> list[FrameAssignment]:
    """Assign by image names, or else by the numbers in them."""
    if source.images:
        frame, rule = frames_by_name(names, source.images, where)
        if (frame >= 0).any():
            return [_assignment("name", rule, frame, source)]
    return by_numbers(numbers_of_names(names, where), source, "numbers in the image names")


def by_numbers(number: IntArray, source: SourceFrames, noun: str) -> list[FrameAssignment]:
    """List the assignments by numbers (N,) of poses; negative: none. `noun`: for the rules.

    Images, whose names have numbers too: the same; or one side counts from 0, the other from 1.
    Video: frames counted from 0 or from 1, or every k-th frame, renumbered.
    """
    known = number >= 0
    if not known.any():
        return []
    images = _numbers_of_images(source.images)
    if len(images):
        return _by_image_numbers(number, images, source, noun)
    least = int(number[known].min())
    most = int(number[known].max())
    rules = [(f"number{first}", 1, first) for first in (0, 1)]
    for step in _steps(most - min(least, 1) + 1, int(known.sum()), source.count):
        rules += [(f"every{step}from{first}", step, first) for first in (0, 1)]
    found = []
    for key, step, first in rules:
        frame = np.where(known, step * (number - first), -1)
        if least >= first and (step == 1 or frame.max() < source.count):
            of = f" of one frame in {step}" if step > 1 else ""
            found.append(_assignment(key, f"{noun}{of}, counted from {first}", frame, source))
    return found


def _by_image_numbers(
    number: IntArray, images: IntArray, source: SourceFrames, noun: str
) -> list[FrameAssignment]:
    """List the assignments of numbers (N,) of poses to numbers of images (F,)."""
    known = number >= 0
    frame_of = {n: frame for frame, n in enumerate(images.tolist())}
    rules = [("number", noun, 0)]
    if number[known].min() >= 1 and images.min() == 0:
        rules.append(("number1", f"{noun}, counted from 1, those of the images from 0", -1))
    if number[known].min() == 0 and images.min() == 1:
        rules.append(("number0", f"{noun}, counted from 0, those of the images from 1", 1))
    found = []
    for key, rule, offset in rules:
        frame = np.array([frame_of.get(n + offset, -1) for n in number.tolist()], np.int64)
        found.append(_assignment(key, rule, np.where(known, frame, -1), source))
    if known.all() and len(number) == len(images):
        order = np.argsort(np.argsort(number))
        found.append(_assignment("order", f"order of the {noun}", order, source))
    return found


def _steps(numbers: int, known: int, count: int) -> list[int]:
    """List the k for which every k-th of `count` frames gives `numbers` frames or few more.

    A tenth of the frames, at the end, may have no pose.

    known: how many of the numbers exist; if most are missing, the frames were not renumbered.
    """
    if 2 * known < numbers or numbers < 2:
        return []
    steps = range(2, max(count // (numbers - 1), 1) + 1)
    most = numbers + 0.1 * numbers + 1
    return [k for k in steps if numbers <= -(-count // k) <= most]


def numbers_of_names(names: Sequence[str], where: str) -> IntArray:
    """Read the number of each name (N,): the last one in which all names differ; -1: none.

    Raises:
        ReobjError: no number differs between all names.
    """
    digits = [re.findall(r"\d+", PurePosixPath(name.replace("\\", "/")).stem) for name in names]
    numbered = [found for found in digits if found]
    counts = {len(found) for found in numbered}
    groups = 1 if len(counts) > 1 else max(counts, default=0)
    for group in range(1, groups + 1):
        number = [int(found[-group][-18:]) if found else -1 for found in digits]  # int64 holds 18
        if len({n for n in number if n >= 0}) == len(numbered):
            return np.array(number, np.int64)
    if not numbered:
        return np.full(len(names), -1)
    first: dict[str, str] = {}
    for name, found in zip(names, digits, strict=True):
        if found and first.setdefault(found[-1].lstrip("0"), name) != name:
            raise ReobjError(
                f"{where}: {first[found[-1].lstrip('0')]!r} and {name!r} have the same number, and "
                "neither is the name of a frame; give the poses of one camera, or a folder of "
                "images with these names"
            )
    raise ReobjError(f"{where}: {names[0]!r} appears twice; expected each image once")


def _numbers_of_images(images: Sequence[str]) -> IntArray:
    """Return the numbers (F,) in the names of images; (0,) where they are no unique keys."""
    try:
        number = numbers_of_names(images, "")
    except ReobjError:
        return np.arange(0)
    return number if (number >= 0).all() else number[:0]


# ---- Time stamps ---------------------------------------------------------------------------------


def numbers_of_times(stamps_s: Array) -> IntArray:
    """Number times (N,), ascending: as multiples of their step from 0 on, else consecutively."""
    number = _even_numbers(stamps_s)
    return np.arange(len(stamps_s)) if number is None else number


def _even_numbers(stamps_s: Array) -> IntArray | None:
    """Return times (N,) as multiples of their step; None if they are uneven or start late."""
    steps = np.diff(stamps_s)
    if len(steps) and stamps_s[0] >= 0:
        number = stamps_s / np.median(steps)
        even = np.abs(number - number.round()).max() < 0.1
        if even and number[-1] < 2 * len(number):  # few are missing: they start at 0
            return np.asarray(number.round(), np.int64)
    return None


def unit_of_stamps(stamps: Array, end_s: float = 0.0) -> TimeUnit:
    """Infer the unit of ascending stamps (N,).

    It is the unit that gives a date after 2000. Else it is s, unless most stamps in s lie after the
    end of the video and those in another unit end with it, or stamps of ten digits have a plausible
    step in it.

    Args:
        end_s: of the video; 0: unknown.
    """
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    least_s = 1e-3  # motion capture at 1 kHz
    most_s = 10.0  # photos taken one by one
    for unit in TimeUnit:
        if is_date(float(stamps[0]) / unit.value):
            return unit
    if end_s > 0 and np.median(stamps) > end_s:
        for unit in TimeUnit:
            ends = 0.5 < stamps[-1] / unit.value / end_s < 2
            if ends and least_s <= step / unit.value <= most_s:
                return unit
    if is_whole(stamps) and stamps[-1] >= LEAST_STAMP:
        return next((unit for unit in TimeUnit if step / unit.value <= most_s), TimeUnit.s)
    return TimeUnit.s


def is_whole(stamps: Array) -> bool:
    """True if all stamps (N,) are whole numbers."""
    return bool((stamps == np.round(stamps)).all())


STAMP_TOLERANCE_S = 0.02  # of a frame and its pose or depth map (default of TUM's associate.py)


def _by_stamps(stamps_s: Array, source: SourceFrames, is_ours: bool) -> list[FrameAssignment]:
    """Assign by stamps (N,), ascending: as times; whole numbers; or the order, if one a frame."""
    found = list[FrameAssignment]()
    time_s = source.time_s
    count = len(stamps_s)
    if (source.timed or is_ours) and stamps_s[0] <= time_s[-1] and stamps_s[-1] >= time_s[0]:
        row = rows_by_time(stamps_s, source.frame, time_s)
        step = float(np.median(np.diff(time_s) / np.diff(source.frame))) if len(time_s) > 1 else 0.0
        end = time_s[-1] + step * max(source.count - 1 - int(source.frame[-1]), 0)
        start = time_s[0] - step * int(source.frame[0])
        tolerance = max(step / 2, STAMP_TOLERANCE_S)
        outside = (stamps_s < start - tolerance) | (stamps_s > end + tolerance)
        found.append(FrameAssignment("time", "time stamps", row, int(outside.sum())))
    if found and (is_ours or (found[0].row < 0).all()):  # the same clock, none within the tolerance
        return found
    other_clock = not found and source.timed
    clock = ", the time stamps are of another clock than the frames" * other_clock
    if is_whole(stamps_s) and 0 <= stamps_s[0] and stamps_s[-1] < LEAST_STAMP:
        noun = "whole numbers in place of time stamps"
        found += by_numbers(stamps_s.astype(np.int64), source, noun)
    elif not source.timed and count != source.count:
        if (number := _even_numbers(stamps_s)) is not None:
            noun = f"time stamps as multiples of {float(np.median(np.diff(stamps_s))):.4g} s"
            found += [
                _assignment("number0", f"{noun}, from 0", number, source),
                _assignment("first0", f"{noun}, from the first", number - number[0], source),
            ]
    if count == source.count:
        rule = f"order, one row for each frame of the source{clock}"
        found.append(_assignment("order", rule, np.arange(count), source))
    elif count == len(source.frame) and not found:
        rule = f"order, one row for each frame that is read{clock}"
        found.append(FrameAssignment("order", rule, np.arange(count), 0))
    return found


def rows_by_time(stamps_s: Array, frame: IntArray, time_s: Array) -> IntArray:
    """Find the nearest stamp of each frame, within half an interval and `STAMP_TOLERANCE_S`.

    Args:
        stamps_s: (N,) ascending. time_s: (F,) of the frames.
    Returns:
        row (F,) of each frame, -1: none.
    """
    steps = np.diff(time_s) / np.maximum(np.diff(frame), 1)
    half = 0.5 * float(np.median(steps)) if len(steps) else 1 / 60  # 30 Hz
    nearest = nearest_of(time_s, stamps_s)  # (F,)
    tolerance = min(half, STAMP_TOLERANCE_S) * (1 + 1e-6)
    return np.where(np.abs(stamps_s[nearest] - time_s) <= tolerance, nearest, -1)


def interpolated(
    cam_from_world: Array, stamps_s: Array, time_s: Array, max_step_s: float = 0.11
) -> tuple[Array, BoolArray]:
    """Interpolate poses at times (F,) between those at most `max_step_s` apart.

    Rotations by slerp, centres linearly.

    Args:
        max_step_s: chosen: poses at 10 Hz, with jitter.
    Returns:
        cam_from_world (n, 3, 4), and the mask (F,) of the times that are interpolated: between two
        such poses and at the time of neither.
    """
    known = np.isfinite(cam_from_world).all((1, 2))
    stamps_s = stamps_s[known]
    world_from_cam = invert_rigid(cam_from_world[known])
    if len(stamps_s) < 2:
        return np.empty((0, 3, 4)), np.zeros(len(time_s), bool)
    after = np.searchsorted(stamps_s, time_s, side="right").clip(1, len(stamps_s) - 1)  # (F,)
    start, end = stamps_s[after - 1], stamps_s[after]
    same_s = 5e-4  # times in files and containers are rounded to a ms
    use = (time_s - start > same_s) & (end - time_s > same_s) & (end - start <= max_step_s)
    at = time_s[use]
    turn = Slerp(stamps_s, Rotation.from_matrix(world_from_cam[:, :, :3]))(at).as_matrix()
    centre = [np.interp(at, stamps_s, axis) for axis in world_from_cam[:, :, 3].T]
    return invert_rigid(np.concatenate([turn, np.transpose([centre], (2, 1, 0))], 2)), use


# ---- Order ---------------------------------------------------------------------------------------


def by_order(count: int, source: SourceFrames, by_text: bool = False) -> list[FrameAssignment]:
    """Assign rows without names or times, one for each frame of the source; [] for other counts.

    Args:
        by_text: in the order of the images' names as text (1, 10, 2), not of their numbers.
    """
    if count != source.count or _by_picked_images(count, source):
        return []
    if not by_text or not source.images:
        rule = "order, one row for each frame of the source"
        return [_assignment("order", rule, np.arange(count), source)]
    frame = sorted(range(count), key=lambda n: PurePosixPath(source.images[n]).name)
    rule = "order of the image names as text (1, 10, 2)"
    return [_assignment("text", rule, np.array(frame, np.int64), source)]


def _by_counts(count: int, source: SourceFrames, where: str) -> list[FrameAssignment]:
    """Assign `count` rows by the numbers of selected images, or one for each frame in k."""
    if picked := _by_picked_images(count, source):
        return picked
    rows = np.arange(count)
    last = int(source.frame[-1])
    if count == len(source.frame):
        return [FrameAssignment("order", "order, one row for each frame that is read", rows, 0)]
    if last < count:
        rule = f"order, row n for frame n of {source.count or 'an unknown number of'}"
        return [FrameAssignment("order", rule, source.frame.copy(), 0)]
    found = [
        _assignment(f"every{k}", f"order, a row for one frame in {k}", k * rows, source)
        for k in range(2, source.count // max(count - 1, 1) + 1)
        if -(-source.count // k) == count
    ]
    if not found:
        raise ReobjError(
            f"{where}: {count} rows, frame numbers up to {last}; expected one row a frame"
        )
    return found


def _by_picked_images(count: int, source: SourceFrames) -> list[FrameAssignment]:
    """Assign by the numbers in the names of images that were selected from `count`."""
    number = _numbers_of_images(source.images if len(source.images) != count else ())
    found = []
    for first in (0, 1) if len(number) else ():
        if first <= number.min() and number.max() < count + first:
            frame_of = {n - first: frame for frame, n in enumerate(number.tolist())}
            frame = np.array([frame_of.get(n, -1) for n in range(count)], np.int64)
            rule = f"numbers in the image names, rows counted from {first}"
            one = _assignment(f"number{first}", rule, frame, source)
            found.append(replace(one, outside=0))
    return found


def source_of(video: Any, frame: IntArray, time_s: Array) -> SourceFrames:
    """Describe a `Video` whose frames (F,) were read at times (F,) in s."""
    paths = [str(Path(file).absolute()) for file in getattr(video, "files", ())]
    images = tuple(paths or video.names)
    config = getattr(video, "config", None)
    count = int(video.frame_count)
    if not images and (config is None or (not config.stop and config.every == 1)):
        count = int(frame[-1]) + 1  # what was decoded, not what the container claims
    return SourceFrames(
        frame, time_s, count, images, not images or getattr(video, "times_s", None) is not None
    )
