"""Video files as they are stored: times of their frames, and whether their end is missing."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np

from reobj.types import Array

# Of the time that frames take at the usual rate, that goes by from before a step back of the clock
# until it is past that time again: after a wrong stamp all of it, of equal stamps an equal part;
# where a recording begins again, and another follows it, one step of many. Chosen: five frames
RESTART_SHARE = 0.25


def settled_times(raw_s: Array, step_s: float) -> tuple[Array, int, bool]:
    """Make times of frames (F,) increase.

    Single wrong or equal ones are interpolated. Where the clock begins again (recordings that were
    appended to each other), it goes on one step after the frame before. Times up to the first
    that is not later than all before it stay as they are.

    Args:
        raw_s: as the container gives them, NaN: none. step_s: between frames where it gives none.
    Returns:
        times (F,) in s, how often the clock began again, and whether there were times.
    """
    count = len(raw_s)
    known = np.flatnonzero(np.isfinite(raw_s))
    if len(known) < 2 or np.ptp(raw_s[known]) == 0:
        return np.arange(0.0, count) * step_s, 0, count < 2 and len(known) == count
    time_s: Array = np.interp(np.arange(count), known, raw_s[known])
    steps = np.diff(raw_s[known]) / np.diff(known)
    restarts = 0
    at = 1
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else step_s
    while True:
        highest = np.maximum.accumulate(time_s[at - 1 :])
        back = np.flatnonzero(time_s[at:] <= highest[:-1])
        if not len(back):
            return time_s, restarts, True
        at += int(back[0])
        last = time_s[at - 1]
        later = np.flatnonzero(time_s[at:] > last)
        after = int(later[0]) if len(later) else 0  # frames that are not later than the last
        if after and time_s[at + after] - last > RESTART_SHARE * (after + 1) * step:
            time_s[at : at + after] = np.linspace(last, time_s[at + after], after + 2)[1:-1]
        else:
            time_s[at:] += last + step - time_s[at]
            restarts += after != 0 or count - at > 1 / RESTART_SHARE


EBML = b"\x1a\x45\xdf\xa3"  # first two elements of Matroska and WebM
SEGMENT = b"\x18\x53\x80\x67"


def missing_bytes(path: Path) -> int:
    """Count the bytes that the boxes of MP4, Matroska, WebM or AVI announce beyond the file's end.

    Returns:
        0 where nothing is missing, and for containers that announce no lengths (MPEG-TS, live
        recordings).
    """
    with contextlib.suppress(OSError, IndexError, struct.error), path.open("rb") as file:
        size = path.stat().st_size
        head = file.read(64)
        if head.startswith(EBML):
            return max(0, _matroska_end(head) - size)
        if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
            end = 0
            while end + 8 <= size:
                file.seek(end)
                data = file.read(16)
                (length,) = struct.unpack_from(">I", data)
                if length == 1:  # a long one
                    (length,) = struct.unpack_from(">Q", data, 8)
                if length < 8:  # 0: to the end of the file
                    return 0
                end += length
            return max(0, end - size)
        if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
            end = padded = 0
            while end + 8 <= size:
                file.seek(end)
                kind, length = struct.unpack("<4sI", file.read(8))
                if kind != b"RIFF" or length in (0, 0xFFFFFFFF):  # other data, or never finished
                    return 0
                padded = int(length) % 2
                end += 8 + int(length) + padded
            return max(0, end - padded - size)
    return 0


HEAD_BYTES = 1 << 16  # chosen: the tracks are described before the first frame


def holds_pictures_only(path: Path) -> bool:
    """Tell whether a file is Matroska or WebM without a track of sound; other containers: False."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        # TrackType (RFC 9559, 5.1.4.1.3): 2 is audio
        return head.startswith(EBML) and b"\x83\x81\x02" not in head
    return False


def _matroska_end(head: bytes) -> int:
    """Return where the segment, which holds all but the header, ends; 0: not announced."""
    at, length = _vint(head, len(EBML))
    at += length
    if head[at : at + 4] != SEGMENT:
        return 0
    start, length = _vint(head, at + 4)
    return start + length if length else 0


def _vint(data: bytes, at: int) -> tuple[int, int]:
    """Read a number of variable length (RFC 8794): where it ends, and its value; 0: unknown."""
    count = 9 - int(data[at]).bit_length()
    if count > 8 or at + count > len(data):
        raise struct.error("no length")
    unknown: int = (1 << 7 * count) - 1
    value = int.from_bytes(data[at : at + count], "big") & unknown
    return at + count, 0 if value == unknown else value
