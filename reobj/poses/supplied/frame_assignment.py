"""Assign the poses of a file to the frames of a video: by name, number, time stamp or order.

Where a file allows several assignments, an error names them; the user declares one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reobj.cameras import invert_rigid
from reobj.formats import frames_by_name
from reobj.poses.supplied.pose_formats import PoseFile
from reobj.sources.image_files import TimeUnit, is_date
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
        outside: number of poses without a frame in the source; 0 of times, which may begin earlier.
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


def assign(
    file: PoseFile, stamps_s: Array | None, source: SourceFrames, where: str, frames_by: str = ""
) -> FrameAssignment:
    """Return the only assignment of a file's N poses that it allows, or the declared one.

    Names are unique keys. Without names numbers are used, then times, then the order.

    Args:
        stamps_s: (N,) of the poses, or None. where: the file, for errors.
        frames_by: key of the declared assignment; "": none.
    Raises:
        ReobjError: no pose belongs to a frame, several assignments, or not the declared one.
    """
    count = len(file.cam_from_world)
    if file.names:
        found = _by_names(file.names, source, where)
    elif stamps_s is not None:
        found = _by_stamps(stamps_s, source, file.is_ours)
    else:
        found = _by_rows(count, source, where, frames_by, file.by_text)
    complete = any(not one.outside for one in found if one.key != "time")
    different: dict[bytes, FrameAssignment] = {}
    for one in found:
        if (one.row >= 0).any() and not (one.outside and complete):
            different.setdefault(one.row.tobytes(), one)
    kept = {one.key: one for one in different.values()}
    if not kept:
        first = file.names[:1] or ([] if stamps_s is None else stamps_s[[0, -1]].tolist())
        times = f"times {source.time_s[0]:.3f}-{source.time_s[-1]:.3f} s" * source.timed
        raise ReobjError(f"{where}: none of its {count} poses belongs to a frame ({first}; frames: "
                         f"{source.images[:1] or times}); expected seconds of the same clock, "
                         "names or numbers of frames, or one row for each frame")  # fmt: skip
    if frames_by and frames_by not in kept:
        raise ReobjError(f"--set poses.frames_by={frames_by}: {where} can be read by "
                         f"{', '.join(kept)}")  # fmt: skip
    first = next(iter(kept))
    if len(kept) > 1 and not frames_by:
        choices = "; or ".join(f"{one.key} ({one.rule})" for one in kept.values())
        raise ReobjError(f"{where}: its poses can be assigned to frames in {len(kept)} ways: "
                         f"{choices}; choose with --set poses.frames_by={first}")  # fmt: skip
    return kept[frames_by or first]


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
    images = _numbers_of_images(source.images)  # (F,) or (0,)
    start = min(images.tolist(), default=0)
    least = int(number[known].min())
    base = min(least, 1)
    from_0 = ("number", "", 0, 1) if len(images) else ("number0", ", counted from 0", 0, 1)
    rules = [from_0]
    if start in (0, 1) and base != start:
        rules.append((f"number{base}", f", counted from {base}", base - start, 1))
    for k in [] if len(images) else _steps(number[known], source.count):
        text = f" of one frame in {k}, counted from"
        rules += [(f"every{k}from{n}", f"{text} {n}", n, k) for n in (0, 1) if n <= least]
    frame_of = {n: frame for frame, n in enumerate(images.tolist())}
    found = []
    for key, text, first, step in rules:
        frame = step * (number - first)
        if frame_of:
            frame = np.array([frame_of.get(n, -1) for n in frame.tolist()], np.int64)
        found.append(_assignment(key, noun + text, np.where(known, frame, -1), source))
    if known.all() and len(number) == len(images):
        order = np.argsort(np.argsort(number))
        found.append(_assignment("order", f"order of the {noun}", order, source))
    return found


def _steps(number: IntArray, count: int) -> list[int]:
    """List the k for which every k-th of `count` frames gives these numbers (n,), or few more.

    A tenth of the frames, at the end, may have no pose. If most numbers are missing, the frames
    were not renumbered.
    """
    numbers = int(number.max()) - min(int(number.min()), 1) + 1
    if 2 * len(number) < numbers or numbers < 2:
        return []
    steps = range(2, max(count // (numbers - 1), 1) + 1)
    return [k for k in steps if numbers <= -(-count // k) <= 1.1 * numbers + 1]


def numbers_of_names(names: Sequence[str], where: str) -> IntArray:
    """Read the number of each name (N,): the last one in which all names differ; -1: none.

    Raises:
        ReobjError: no number differs between all names.
    """
    digits = [re.findall(r"\d+", PurePosixPath(name.replace("\\", "/")).stem) for name in names]
    counts = {len(found) for found in digits if found}
    for group in range(1, max(counts) + 1 if len(counts) == 1 else 2):
        number = [int(found[-group][-18:]) if found else -1 for found in digits]  # int64 holds 18
        repeated = [n for n, count in Counter(number).items() if n >= 0 and count > 1]
        if not repeated:
            return np.array(number, np.int64)
    same = [name for name, n in zip(names, number, strict=True) if n == repeated[0]]
    raise ReobjError(
        f"{where}: {same[0]!r} and {same[1]!r} have the same number, and neither is the name of a "
        "frame; give the poses of one camera, or a folder of images with these names"
    )


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
    number = np.arange(len(stamps_s))
    steps = np.diff(stamps_s)
    if len(steps) and stamps_s[0] >= 0:
        multiple = stamps_s / np.median(steps)
        even = np.abs(multiple - multiple.round()).max() < 0.1
        if even and multiple[-1] < 2 * len(number):  # few are missing: they start at 0
            number = multiple.round().astype(np.int64)
    return number


def seconds_of(stamps: Array, unit: str) -> Array:
    """Convert ascending stamps (N,) to s: of a unit; "": the one that gives a date, else s."""
    dated = (one for one in TimeUnit if is_date(float(stamps[0]) / one.value))
    return stamps / (TimeUnit[unit] if unit else next(dated, TimeUnit.s)).value


STAMP_TOLERANCE_S = 0.02  # of a frame and its pose or depth map (default of TUM's associate.py)


def _by_stamps(stamps_s: Array, source: SourceFrames, is_ours: bool) -> list[FrameAssignment]:
    """Assign by stamps (N,), ascending: as times; whole numbers; or the order, if one a frame.

    Whole numbers that are no dates are not in seconds: they are frame numbers, or of another unit.
    """
    found = list[FrameAssignment]()
    first, last = stamps_s[[0, -1]].tolist()
    is_number = (stamps_s == stamps_s.round()).all() and not is_date(first)
    overlap = first <= source.time_s[-1] and last >= source.time_s[0]
    if overlap and (is_ours or (source.timed and not is_number)):
        row = rows_by_time(stamps_s, source.frame, source.time_s)
        found.append(FrameAssignment("time", "time stamps", row, 0))
        if is_ours or (row < 0).all():  # the same clock, none within the tolerance
            return found
    if is_number and first >= 0 and last <= source.count:
        noun = "whole numbers in place of time stamps"
        found += by_numbers(stamps_s.astype(np.int64), source, noun)
    return found + _by_order(len(stamps_s), source)


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
        max_step_s: of poses at 10 Hz, with jitter.
    Returns:
        cam_from_world (n, 3, 4), and the mask (F,) of the times that are interpolated: between two
        such poses and at the time of neither.
    """
    known = np.isfinite(cam_from_world).all((1, 2))
    stamps_s = stamps_s[known]
    if len(stamps_s) < 2:
        return np.empty((0, 3, 4)), np.zeros(len(time_s), bool)
    turn, centre = np.split(invert_rigid(cam_from_world[known]), [3], 2)
    after = np.searchsorted(stamps_s, time_s, side="right").clip(1, len(stamps_s) - 1)  # (F,)
    start, end = stamps_s[after - 1], stamps_s[after]
    same_s = 5e-4  # times in files and containers are rounded to a ms
    use = (time_s - start > same_s) & (end - time_s > same_s) & (end - start <= max_step_s)
    at = time_s[use]
    turns = Slerp(stamps_s, Rotation.from_matrix(turn))(at).as_matrix()
    centres = np.transpose([np.interp(at, stamps_s, axis) for axis in centre[..., 0].T])
    return invert_rigid(np.dstack([turns, centres])), use


# ---- Order ---------------------------------------------------------------------------------------


def _by_order(count: int, source: SourceFrames, by_text: bool = False) -> list[FrameAssignment]:
    """Assign a row to each frame of the source, or that is read; [] for other counts.

    Args:
        by_text: in the order of the images' names as text (1, 10, 2), not of their numbers.
    """
    rule = "order, one row for each frame of the source"
    if count == source.count:
        frame = np.arange(count)
        if by_text and source.images:
            names = [PurePosixPath(image).name for image in source.images]
            frame = np.array(sorted(range(count), key=names.__getitem__), np.int64)
            rule = "order of the image names as text (1, 10, 2)"
        return [_assignment("order", rule, frame, source)]
    rule = "order, one row for each frame that is read"
    known = [FrameAssignment("order", rule, np.arange(count), 0)]
    return known if count == len(source.frame) else []


def _by_rows(
    count: int, source: SourceFrames, where: str, frames_by: str, by_text: bool
) -> list[FrameAssignment]:
    """Assign rows without names or times by their order, or by the numbers of selected images."""
    if found := _by_order(count, source, by_text):
        return found
    last = int(source.frame[-1])
    found = by_numbers(np.arange(count), source, "rows")
    if frames_by or (source.images and count > source.count):
        return found
    if last < count:
        rule = f"order, row n for frame n of {source.count or 'an unknown number of'}"
        return [FrameAssignment("order", rule, source.frame.copy(), 0)]
    keys = " or ".join(f"{one.key} ({one.rule})" for one in found)
    raise ReobjError(f"{where}: {count} rows, frame numbers up to {last}; expected one row a frame,"
                     f" or --set poses.frames_by={keys}")  # fmt: skip


def source_of(video: Any) -> SourceFrames:
    """Describe the frames of a `Video`, which is decoded for it."""
    times = [(frame.index, frame.time_s) for frame in video]
    if not times:
        raise ReobjError("no readable frame in the video, so no pose can be matched")
    frame = np.array([n for n, _ in times], np.int64)
    time_s = np.array([t for _, t in times])
    paths = [str(Path(file).absolute()) for file in video.files]
    images = tuple(paths or video.names)
    count = int(video.frame_count)
    if not images and not video.config.stop and video.config.every == 1:
        count = int(frame[-1]) + 1  # what was decoded, not what the container claims
    timed = not images or getattr(video, "times_s", None) is not None
    return SourceFrames(frame, time_s, count, images, timed)
