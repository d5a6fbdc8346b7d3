"""Which pose of a file belongs to which frame of a video: by name, time stamp or order.

The files are the business of `readers`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.types import Array, BoolArray, IntArray, ReobjError


def rows_by_order(
    count: int, frame: IntArray, names: Sequence[str], images: Sequence[str]
) -> IntArray:
    """Match `count` poses without names or times to frames (F,): one each, or by number.

    Numbers are those in the names of the frames, where they are images that were picked out of
    `count`, else the frames' own.

    Args:
        names: (F,) of the frames read, or (). images: of all frames of the source, or ().
    Returns:
        row (F,) of each frame.
    Raises:
        ReobjError: a number without a row.
    """
    if count == len(frame):
        return np.arange(count)
    if len(names) and len(images) != count:
        row = rows_by_number([str(i) for i in range(count)], frame, names)
        if (row >= 0).all():
            return row
    if frame.max() >= count:
        what = f"{count} rows, frame numbers up to {frame.max()}"
        raise ReobjError(f"{what}; expected one row a frame")
    return frame.copy()


def rows_by_name(
    given: Sequence[str], frame: IntArray, names: Sequence[str], images: Sequence[str]
) -> IntArray:
    """Match by path, else file name, else stem, else the last number in the names.

    Where there is a pose for every image, but under other numbers, the frames' own numbers count.

    Args:
        given: (N,) of the poses. names: (F,) of the frames read, or (). images: of all frames of
            the source, or ().
    Returns:
        row (F,) of each frame, -1: none.
    """
    for key in (str, lambda n: Path(n).name, lambda n: Path(n).stem):
        rows = {key(name): r for r, name in enumerate(given)}
        found = np.array([rows.get(key(name), -1) for name in names], np.int64)
        if (found >= 0).any():
            return found
    by_name, by_frame = rows_by_number(given, frame, names), rows_by_number(given, frame, ())
    other = len(images) == len(given) and set(_last_numbers(images)) != set(_last_numbers(given))
    more = (by_name >= 0).sum() >= max(1, (by_frame >= 0).sum())
    return by_name if more and not other else by_frame


def rows_by_number(given: Sequence[str], frame: IntArray, names: Sequence[str]) -> IntArray:
    """Match the last numbers in the names of the poses' images and of the frames.

    Frames without names have their frame numbers; what is given then counts from 1 where there is
    a 1, no 0, and one too many.
    """
    numbers, wanted = _last_numbers(given), frame
    if len(names):
        wanted = _last_numbers(names)
    elif 0 not in numbers and 1 in numbers and numbers.max() > frame.max():
        numbers = numbers - 1
    row_of = dict(zip(numbers.tolist(), range(len(given)), strict=True))
    return np.array([row_of.get(n, -1) if n >= 0 else -1 for n in wanted.tolist()], np.int64)


def _last_numbers(names: Sequence[str]) -> IntArray:
    """Read the last whole number in each name without suffix, -1 where there is none."""
    digits = [re.findall(r"\d+", Path(name).stem) for name in names]
    return np.array([int(d[-1][-18:]) if d else -1 for d in digits], np.int64)  # of int64: 18


EVEN_TIMES = 0.1  # of a step: how far times of numbered frames may be from even ones (chosen)


def numbers_of_times(stamps_s: Array) -> IntArray:
    """Number times (N,), ascending: multiples of their step from 0 on, else one after the other."""
    steps = np.diff(stamps_s)
    if len(steps) and stamps_s[0] >= 0:
        number = stamps_s / np.median(steps)
        even = np.abs(number - number.round()).max() < EVEN_TIMES
        if even and number[-1] < 2 * len(number):  # few are missing: they do count from 0
            return np.asarray(number.round(), np.int64)
    return np.arange(len(stamps_s))


LONE_FRAME_S = 1 / 60  # half a frame interval where there is only one frame (chosen: 30 Hz)
STAMP_TOLERANCE_S = 0.02  # between a frame and its pose (default of TUM's associate.py)
SAME_TIME_S = 5e-4  # times in files and containers are rounded to a ms
STAMP_STEP_S = 0.1  # between poses, up to which one between them is interpolated (chosen: 10 Hz)


def rows_by_time(
    stamps_s: Array, frame: IntArray, time_s: Array, count: int
) -> tuple[IntArray, list[str]]:
    """Match the nearest stamp within half a frame interval and `STAMP_TOLERANCE_S`.

    Stamps of another clock (no overlap in time) are matched in order if there is one for each
    frame that is read, or for each of the source.

    Args:
        stamps_s: (N,) ascending. time_s: (F,) of the frames. count: frames of the source.
    Returns:
        row (F,) of each frame, -1: none; messages.
    """
    if stamps_s[0] > time_s[-1] or stamps_s[-1] < time_s[0]:
        messages = ["time stamps are of another clock than the frames: matched in order"]
        if len(stamps_s) == len(frame):
            return np.arange(len(frame)), messages
        if len(stamps_s) == count > frame.max():
            return frame.copy(), messages
    steps = np.diff(time_s) / np.maximum(np.diff(frame), 1)
    half = 0.5 * float(np.median(steps)) if len(steps) else LONE_FRAME_S
    after = np.searchsorted(stamps_s, time_s).clip(1, max(len(stamps_s) - 1, 1))  # (F,)
    pair = np.stack([after - 1, after], 1).clip(max=len(stamps_s) - 1)  # (F, 2)
    offset = np.abs(stamps_s[pair] - time_s[:, None])
    nearest = np.take_along_axis(pair, offset.argmin(1)[:, None], 1)[:, 0]
    tolerance = min(half, STAMP_TOLERANCE_S) * (1 + 1e-6)
    return np.where(offset.min(1) <= tolerance, nearest, -1), []


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
