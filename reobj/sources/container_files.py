"""Video containers: monotonic frame times, and truncated files."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np

from reobj.types import Array


def settled_times(raw_s: Array, step_s: float) -> tuple[Array, int, bool]:
    """Make the times of frames (F,) strictly increasing.

    Single wrong or equal times are interpolated. Where the clock restarts (concatenated
    recordings), times continue one step after the frame before. Times before the first one that
    does not increase are unchanged.

    Args:
        raw_s: times in the container, NaN: none. step_s: interval of frames without times.
    Returns:
        times (F,) in s, number of restarts of the clock, and whether the container has times.
    """
    # Time from a backward step of the clock until it passes its last value, over what these frames
    # take at the usual rate: 1 after one wrong time stamp, less for repeated ones, near 0 where a
    # second recording begins. Below it the clock has restarted. Chosen: reached by five frames
    restart_share = 0.25
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
        after = int(later[0]) if len(later) else 0  # number of frames that are not later
        if after and time_s[at + after] - last > restart_share * (after + 1) * step:
            time_s[at : at + after] = np.linspace(last, time_s[at + after], after + 2)[1:-1]
        else:
            time_s[at:] += last + step - time_s[at]
            restarts += after != 0 or count - at > 1 / restart_share


def missing_bytes(path: Path) -> int:
    """Count the bytes of MP4, Matroska, WebM or AVI boxes that lie beyond the end of the file.

    Returns:
        0 for complete files, and for containers without lengths (MPEG-TS, live recordings).
    """
    with contextlib.suppress(OSError, IndexError, struct.error), path.open("rb") as file:
        size = path.stat().st_size
        head = file.read(64)
        if _is_matroska(head):
            return max(0, _matroska_end(head) - size)
        if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
            end = 0
            while end + 8 <= size:
                file.seek(end)
                data = file.read(16)
                (length,) = struct.unpack_from(">I", data)
                if length == 1:  # 64-bit length
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
                if kind != b"RIFF" or length in (0, 0xFFFFFFFF):  # other data, or not finalised
                    return 0
                padded = int(length) % 2
                end += 8 + int(length) + padded
            return max(0, end - padded - size)
    return 0


def holds_pictures_only(path: Path) -> bool:
    """Test whether a file is Matroska or WebM without an audio track; other containers: False."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        head = file.read(1 << 16)  # contains the track headers, which precede the first frame
        # TrackType (RFC 9559, 5.1.4.1.3): 2 is audio
        return _is_matroska(head) and b"\x83\x81\x02" not in head
    return False


def _is_matroska(head: bytes) -> bool:
    """Test whether a file begins with the id of the element EBML (RFC 9559), also WebM."""
    return head.startswith(b"\x1a\x45\xdf\xa3")


def _matroska_end(head: bytes) -> int:
    """Return the end of the segment (all but the header), in bytes; 0: unknown."""
    at, length = _vint(head, 4)  # of the element EBML
    at += length
    if head[at : at + 4] != b"\x18\x53\x80\x67":  # id of the segment
        return 0
    start, length = _vint(head, at + 4)
    return start + length if length else 0


def _vint(data: bytes, at: int) -> tuple[int, int]:
    """Read an integer of variable length (RFC 8794): its end, and its value; 0: unknown."""
    count = 9 - int(data[at]).bit_length()
    if count > 8 or at + count > len(data):
        raise struct.error("no length")
    unknown: int = (1 << 7 * count) - 1
    value = int.from_bytes(data[at : at + count], "big") & unknown
    return at + count, 0 if value == unknown else value
