"""Atomic files, locks, text, JSON and npz; progress; text for messages."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import difflib
import errno
import hashlib
import json
import math
import os
import re
import shutil
import sys
import textwrap
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from reobj.types import Array, ReobjError, log

T = TypeVar("T")


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it at the end of the `with` block.

    An exception in the block leaves `path` unchanged and removes the temporary file.

    Raises:
        ReobjError: a disk error: where, why and what to do.
    """
    part = path.with_name(f".part-{path.name}")
    with writing(path), _folder(path.parent):
        try:
            yield part
            _sync(part)
            part.replace(path)
            log.debug("wrote %s", path)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def _folder(path: Path) -> Iterator[None]:
    """Make a folder and its parents; new ones are removed again if the block fails."""
    new = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in new:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()
        raise


@contextlib.contextmanager
def writing(path: Path, named: Path | None = None) -> Iterator[None]:
    """Convert disk errors of the block that writes `path` to errors that say what to do.

    Args:
        named: in the errors, instead of `path`.
    Raises:
        ReobjError: for the errors listed here. Others, and those of files in other folders, pass.
    """
    advice_of = {
        errno.ENOSPC: "make room on this disk",
        errno.EDQUOT: "make room: your quota is used up",
        errno.EFBIG: "choose a folder on a file system that takes larger files",
        errno.EROFS: "choose a folder on a disk that is not read-only",
        errno.EACCES: "choose a folder that you may write into",
        errno.EPERM: "choose a folder that you may write into",
        errno.EEXIST: "a file stands where a folder should be: move it away",
        errno.ENOTDIR: "a file stands where a folder should be: move it away",
        errno.EISDIR: "a folder stands where a file should be: move it away",
        errno.EIO: "disk I/O error: check the disk",
        errno.ENOENT: "this folder takes no files (as /proc): choose another one",
    }
    try:
        yield
    except OSError as error:
        full = re.search(r"\d+ requested and \d+ written", str(error))  # numpy's, without an errno
        number = errno.ENOSPC if full else error.errno
        at = Path(os.fsdecode(error.filename or path.parent / "?"))
        above = path.is_relative_to(at)
        beside = at.is_relative_to(path.parent) and number != errno.ENOENT  # else an input
        if number not in advice_of or not (above or beside):
            raise
        why = os.strerror(number)
        advice = advice_of[number]
        shown = Path(*(name for name in (named or path).parts if name != PART_RESULTS))
        raise ReobjError(f"{shown}: cannot be written ({why}); {advice}, then run again") from error


@contextlib.contextmanager
def locked(path: Path, wait_s: float = 0.0, named: Path | None = None) -> Iterator[None]:
    """Hold the lock of a file; the system releases it when the process ends, even if killed.

    Args:
        wait_s: longest time to wait for another process that holds it. named: by disk errors,
            instead of the lock: the file beside it that will be written.
    Raises:
        LockedError: another process, or this one, still holds it.
    """
    with writing(path, named):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "ab")
    with file:
        until = time.monotonic() + wait_s
        while not _lock(file.fileno()):
            if time.monotonic() >= until:
                raise LockedError(f"{path}: locked by another process")
            time.sleep(0.05)  # a person does not notice the delay
        yield


class LockedError(ReobjError):
    """A lock is held by another process."""


def _lock(handle: int) -> bool:
    """Take the lock of an open file; False if it is held; True where the system has no locks."""
    try:
        _take_lock(handle)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)  # held
    return True


if sys.platform == "win32":
    import msvcrt

    def _take_lock(handle: int) -> None:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # the first byte, also of an empty file
else:
    import fcntl

    def _take_lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


PART_RESULTS = ".part-results"  # folder of unfinished results, in the output folder


@contextlib.contextmanager
def staged(folder: Path, name: str = PART_RESULTS) -> Iterator[Path]:
    """Yield an empty folder whose files replace those of `folder` at the end of the block.

    All new files are complete before the first one is replaced: an exception in the block leaves
    `folder` unchanged, and so does a folder in the place of a file. Other files stay.

    Args:
        name: of the empty folder, in `folder`.
    Raises:
        ReobjError: as `check_places`, or a disk error.
    """
    part = folder / name
    with writing(folder), _folder(folder):
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            yield part
            files = [p.relative_to(part) for p in sorted(part.rglob("*")) if p.is_file()]
            check_places(folder, files)
            for file in files:
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (part / file).replace(folder / file)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def check_places(folder: Path, names: Iterable[str | Path]) -> None:
    """Refuse files (paths within a folder) that cannot be written or replaced.

    Raises:
        ReobjError: the path of a file is a folder, that of a folder is none, or a folder is not
            writable.
    """
    for name in map(Path, names):
        for path in (folder / parent for parent in name.parents):
            if os.path.lexists(path) and not path.is_dir():
                raise ReobjError(f"{path}: is no folder, but one is written here; move it away")
            if path.is_dir() and not os.access(path, os.W_OK | os.X_OK):
                fault = "is not writable, but results are written here; allow it (chmod u+w)"
                raise ReobjError(f"{path}: {fault}")
        if (path := folder / name).is_dir() and not path.is_symlink():
            raise ReobjError(f"{path}: is a folder, but a file is written here; move it away")


def _sync(path: Path) -> None:
    """Flush a file to the disk: a power cut after a rename could otherwise leave it empty."""
    with contextlib.suppress(OSError):  # a folder, or a file system without fsync
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def part_path(path: Path, part: int) -> Path:
    """Name the file or folder of one component of the trajectory; that of component 0 is `path`.

    >>> part_path(Path("poses.txt"), 2).name
    'poses_part2.txt'
    """
    return path.with_name(f"{path.stem}_part{part}{path.suffix}") if part else path


def part_paths(path: Path) -> list[Path]:
    """List the existing files or folders of `part_path`, without that of component 0."""
    return sorted(path.parent.glob(f"{path.stem}_part[0-9]*{path.suffix}"))


# Bytes of memory that one input file may take; chosen: two million detections with masks in JSON,
# or those of more than an hour of video in npz
MEMORY_MAX = 1 << 31
LINES_MAX = 2_000_000  # of a table; chosen: an hour at 30 Hz with 18 boxes a frame


def read_text(path: Path, most: int | None = None, errors: str = "strict") -> str:
    """Read a UTF-8 file, with or without a byte order mark.

    most: largest number of characters; default: as MEMORY_MAX allows. errors: as in `open`.
    """
    if path.is_dir():
        raise ReobjError(f"{path}: is a folder, expected a text file")
    most = most or MEMORY_MAX // 8  # of up to 4 bytes each, held twice while they are split
    try:
        with path.open(encoding="utf-8-sig", errors=errors) as file:
            text = file.read(most + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise ReobjError(f"{path}: cannot be read as text ({error})") from error
    if len(text) > most:
        raise ReobjError(f"{path}: more than {most >> 20} MB of text; cut it into pieces")
    return text


def read_lines(path: Path) -> list[str]:
    """Read a UTF-8 file of at most LINES_MAX lines, with their ends."""
    text = read_text(path)
    breaks = "\n\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029"  # as of str.splitlines
    count = sum(map(text.count, breaks))
    if count > LINES_MAX:
        raise ReobjError(
            f"{path}: {count} lines, at most {LINES_MAX} are allowed; cut it into pieces"
        )
    lines = text.splitlines(keepends=True)
    most = 1 << 22  # characters of a line: the observations of 100,000 points in COLMAP's text
    if lines and (longest := max(map(len, lines))) > most:
        raise ReobjError(f"{path}: a line of {longest} characters, at most {most} are allowed")
    return lines


def json_memory(text: str) -> int:
    """Estimate the bytes of memory that a JSON text takes once it is read (sys.getsizeof)."""
    return 200 * text.count("{") + 64 * (text.count("[") + text.count(","))


def load_json(path: Path) -> Any:
    """Read a JSON file of at most MEMORY_MAX bytes in memory; an error names the line."""
    text = read_text(path)
    if (size := json_memory(text)) > MEMORY_MAX:
        memory = f"would take {size >> 20} MB of memory, at most {MEMORY_MAX >> 20} MB are allowed"
        raise ReobjError(f"{path}: {memory}; cut it into pieces")
    if digits := re.search(r"\d{309}", text):
        line = text.count("\n", 0, digits.start()) + 1
        raise ReobjError(f"{path}, line {line}: a number of more than 308 digits")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ReobjError(f"{path}, line {error.lineno}: not valid JSON ({error.msg})") from error
    except (RecursionError, ValueError) as error:  # nested too deep
        raise ReobjError(f"{path}: invalid JSON ({error})") from error


def check_unpacked(size: int, most: int) -> None:
    """Refuse archives by their unpacked size, before they take memory: zip bombs."""
    if size > most:
        raise ReobjError(f"unpacks to {size >> 20} MB, at most {most >> 20} MB are allowed")


def save_npz(path: Path, arrays: Mapping[str, Any], **metadata: Any) -> None:
    """Write arrays, and metadata as JSON, to a compressed npz file; same input, same bytes."""
    content: dict[str, Any] = {name: np.asarray(values) for name, values in arrays.items()}
    metadata = metadata | {"digest": _digest(content, metadata)}
    with atomic(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **content, metadata=np.array(json.dumps(metadata)))


def columns_of(record: Any, form: str = "{}") -> dict[str, Any]:
    """Return the arrays of a dataclass by names, for `save_npz`; form: of a name."""
    return {form.format(f.name): getattr(record, f.name) for f in dataclasses.fields(record)}


def from_columns(kind: Callable[..., T], arrays: Mapping[str, Any], form: str = "{}") -> T:
    """Make a dataclass of its arrays; the inverse of `columns_of`."""
    names = [f.name for f in dataclasses.fields(cast(Any, kind))]
    return kind(*(arrays[form.format(name)] for name in names))


def _digest(arrays: Mapping[str, Any], metadata: Mapping[str, Any]) -> str:
    """Hash the content of an npz file."""
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {values.dtype.str} {np.shape(arrays[name])}".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def load_npz(path: Path, sealed: bool = False) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a file that `save_npz` wrote, or any npz file without pickled objects.

    Args:
        sealed: refuse a file whose digest differs from that of `save_npz`; callers then need no
            checks of the content.
    Returns:
        the arrays, and the metadata ({} if the file has none).
    Raises:
        ReobjError: damaged, no npz file, or larger than MEMORY_MAX bytes: arrays are held twice
            where callers convert them.
    """
    try:
        with zipfile.ZipFile(path) as file:
            size = sum(member.file_size for member in file.infolist())
            check_unpacked(size, MEMORY_MAX // 2)
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = dict(file)
        text = arrays.pop("metadata", arrays.pop("facts", "{}"))  # facts: before 0.2
        metadata: dict[str, Any] = dict(json.loads(str(text)))
        digest = metadata.pop("digest", "")
        if sealed and digest != _digest(arrays, metadata):
            raise ValueError("the content does not match its digest")
    except Exception as error:  # zip, zlib and numpy have their own exceptions for damaged files
        raise ReobjError(f"{path}: damaged, or no npz file ({error})") from error
    return arrays, metadata


def load_cached(path: Path, read: Callable[[Path], T]) -> T | None:
    """Read a file of the cache; None where it is missing or damaged (then it is removed)."""
    if not path.exists():
        return None
    try:
        content = read(path)
        log.debug("read %s from the cache", path)
        return content
    except (ReobjError, OSError) as error:
        log.warning("%s; it is removed and computed again", error)
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        return None


class Progress:
    """Show the progress of a stage on stderr: how much is done, the time left, the rate.

    On a terminal it is one line that is drawn again. Elsewhere (a log file) a long stage leaves a
    plain line every 10 s, and each stage of at least a second one at its end. Used in a `with`
    block: the stage is complete if the block ends without an exception, whatever the expected total
    was.

    Args:
        counted: the steps have a meaning for the user, such as frames; False: they are fractions
            of the work, and only their percentage is shown.
    Attributes:
        done, total: steps so far and in all (0: unknown). seconds: duration, 0 until it is closed.
        complete: set it to False where the block ends early without an exception.
    """

    def __init__(self, stage: str, total: int = 0, counted: bool = True) -> None:
        self.stage = stage
        self.total = total
        self.counted = counted
        self.done = 0
        self.seconds = 0.0
        self.complete = True
        self.started = self.shown = time.monotonic()
        self._resumed = 0  # steps of an earlier run
        self._measured = 0  # steps that are in the rate
        self._recent_steps = 0.0  # weighted, as the next
        self._recent_s = 0.0
        self._is_terminal = sys.stderr is not None and sys.stderr.isatty()
        log_every_s = float(os.environ.get("REOBJ_PROGRESS_S", LOG_EVERY_S))  # of `serve`
        self._every_s = (
            0.1 if self._is_terminal else math.inf if sys.stderr is None else log_every_s
        )

    def __enter__(self) -> Progress:
        if self._is_terminal:
            self._write("...")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(self.complete and kind is None)

    def resume(self, done: int) -> None:
        """Continue after `done` steps of an earlier run, which are not in the rate."""
        self.done = self._resumed = self._measured = done
        if self._is_terminal and done:
            self._write(f"{self._count()}, continued")

    def step(self, n: int = 1) -> None:
        """Count n more steps; 0: none yet, the stage continues."""
        self.done += n
        now = time.monotonic()
        if now - self.shown > self._every_s:  # readable, and costs no time
            self._show(now)

    def _show(self, now: float) -> None:
        """Show the steps, and the time left at the rate of the latest third of the stage.

        Steps of uneven cost change the rate little, and a stage that becomes slower (its first
        frames were in the cache) is noticed.
        """
        since = now - self.shown
        self.shown = now
        kept = math.exp(-since / max(10.0, (now - self.started) / 3))
        self._recent_s = self._recent_s * kept + since
        self._recent_steps = self._recent_steps * kept + self.done - self._measured
        self._measured = self.done
        rate = self._recent_steps / self._recent_s if self._recent_s > 0 else 0.0
        texts = [self._count()] if self.done or self.total else []
        if self.total > self.done and rate:
            texts.append(f"{duration((self.total - self.done) / rate)} left")
        elif not self.done or self.total:  # what is left is not known
            texts.append(f"{duration(now - self.started)} so far")
        if self.counted and rate:
            texts.append(f"{rate:.1f}/s")
        self._write(", ".join(texts))

    def _count(self) -> str:
        """Format the steps so far; 100 % is left to `close`."""
        if not self.total:
            return str(self.done)
        percent = f"{min(100 * self.done / self.total, 99):3.0f} %"
        return f"{self.done}/{self.total} {percent}" if self.counted else percent.strip()

    def _write(self, text: str) -> None:
        line = f"{self.stage:<9} {text}"
        # erases the rest of a longer line
        sys.stderr.write(f"\r{line}\x1b[K" if self._is_terminal else f"{line}\n")
        sys.stderr.flush()

    def close(self, complete: bool = True) -> float:
        """Finish the line, at 100 % if the stage is complete, with the mean rate of the stage.

        Returns:
            seconds since the start.
        """
        self.seconds = time.monotonic() - self.started
        texts = [f"{self.seconds:.1f} s"]
        if self.done and not self.counted:
            texts.insert(0, "100 %" if complete else self._count())
        elif self.done:
            total = f"/{self.done} 100 %" if complete else f"/{self.total}" * (self.total > 0)
            texts.insert(0, f"{self.done}{total}")
        if not complete:
            texts.append("not finished")
        now_done = self.done - self._resumed
        if now_done and self.counted and self.seconds > 0.1:  # that of a cached stage: no meaning
            texts.append(f"{now_done / self.seconds:.1f}/s")
        if self._is_terminal or (sys.stderr is not None and self.seconds > LOG_LEAST_S):
            self._write(", ".join(texts))
        if self._is_terminal:
            sys.stderr.write("\n")
        return self.seconds


# Where stderr is no terminal: s between lines of a stage, and its least duration for a line at its
# end
LOG_EVERY_S = 10.0
LOG_LEAST_S = 1.0


def duration(seconds: float) -> str:
    """Format a duration, above a minute to 10 s.

    >>> duration(36.4), duration(131), duration(3900)
    ('36 s', '2 min 10 s', '1 h 5 min')
    """
    if round(seconds) < 60:
        return f"{seconds:.0f} s"
    if seconds < 3595:
        minutes, tens = divmod(round(seconds / 10), 6)
        return f"{minutes} min {10 * tens} s" if tens else f"{minutes} min"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if minutes else f"{hours} h"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Suggest the known word most similar to a wrong one, for messages; "" if none is similar.

    >>> did_you_mean("chiar", ["cup", "chair"])
    '; did you mean chair?'
    """
    close = difflib.get_close_matches(word, list(known), 1)
    return f"; did you mean {close[0]}?" if close else ""


def shortened(items: Sequence[Any]) -> str:
    """Format the first five items, for messages.

    >>> shortened([1, 2, 3, 4, 5, 6])
    '1, 2, 3, 4, 5, ...'
    """
    return ", ".join(map(str, items[:5])) + (", ..." if len(items) > 5 else "")


def last_name(path: Path) -> str:
    """Return the name of a file or folder for messages, also of "." and "..".

    >>> last_name(Path("boxes.csv")), last_name(Path("data/labels/."))
    ('boxes.csv', 'labels')
    """
    return os.path.basename(os.path.abspath(path))


def cut(text: str, most: int) -> str:
    """Shorten a text to at most `most` characters.

    >>> cut("refrigerator", 8)
    'refri...'
    """
    return text if len(text) <= most else f"{text[: most - 3]}..."


def wrapped(text: str, columns: int = 100) -> list[str]:
    """Wrap a line for the terminal; continuation lines are indented."""
    return textwrap.wrap(text, columns, subsequent_indent="  ", break_long_words=False)


def spans(numbers: Iterable[int], step: int = 1) -> str:
    """Format ascending numbers as ranges of numbers at most `step` apart, for messages.

    >>> spans([3, 4, 5, 9])
    '3-5, 9'
    """
    ranges: list[list[int]] = []
    for n in numbers:
        if ranges and n - ranges[-1][1] <= step:
            ranges[-1][1] = n
        else:
            ranges.append([n, n])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in ranges)


def rounded(value: float | None, digits: int) -> float | None:
    """Round for JSON; NaN and infinity, which JSON lacks, become None."""
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


def decimals(sigma: float) -> int:
    """Return the number of decimals to print of a value of standard deviation `sigma`.

    The step of the last decimal lies between a tenth of sigma and sigma: rounding increases the
    sigma by at most 4 % (1 / 12 in variance). The viewer's `decimals` (data.js) is the same.

    >>> decimals(0.2), decimals(0.046), decimals(0.009), decimals(30)
    (1, 2, 3, 0)
    """
    return max(0, math.ceil(-math.log10(sigma))) if 0 < sigma < math.inf else 2


def texts_with_sigma(values: Array, sigma: Array | None) -> list[tuple[str, ...]]:
    """Format values (N,) and their sigmas with the decimals of the smallest sigma.

    Without sigmas: the values in three digits.

    >>> texts_with_sigma(np.array([0.444, 0.5]), np.array([0.05, 0.2]))
    [('0.44', '0.05'), ('0.50', '0.20')]
    """
    if sigma is None:
        return [(f"{value:.3g}",) for value in values]
    digits = decimals(float(np.min(sigma)))
    return [(f"{a:.{digits}f}", f"{b:.{digits}f}") for a, b in zip(values, sigma, strict=True)]


def numbers(values: Array, size: float = math.inf) -> list[float]:
    """Round to six significant digits, for JSON: below any accuracy, and reproducible text.

    Args:
        size: of the object at these coordinates; they are rounded to a millionth of it where that
            is finer (map projections have seven digits before the point).

    >>> numbers(np.array([5400000.1234567, 0.00012345678]), 0.9)
    [5400000.123457, 0.000123457]
    """
    digits = [float(f"{v:.6g}") for v in np.asarray(values).ravel()]
    if not 0 < size < math.inf:
        return digits
    fine = [round(float(v), 6 - math.ceil(math.log10(size))) for v in np.asarray(values).ravel()]
    pairs = zip(np.asarray(values).ravel(), digits, fine, strict=True)
    return [min(a, b, key=lambda text: abs(text - v)) for v, a, b in pairs]


def significant(values: Array, size: float = math.inf) -> Array:
    """Round an array to six significant digits, as in objects.json.

    Args:
        size: of the object at these coordinates, as in `numbers`.
    """
    return np.array(numbers(values, size), np.float64).reshape(np.shape(values))


def base64_text(values: npt.NDArray[Any], kind: str) -> str:
    """Encode an array's bytes, C order, as the dtype `kind` ("<f4"), in base64 for HTML pages."""
    return base64.b64encode(np.asarray(values, kind).tobytes()).decode()
