"""Atomic files, locks, text, JSON, npz and saved states; progress; text for messages."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import difflib
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

import cv2
import filelock
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

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
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            with contextlib.suppress(OSError), part.open("rb") as file:  # perhaps a folder
                os.fsync(file)  # a power cut after the renaming could otherwise leave it empty
            part.replace(path)
            log.debug("wrote %s", path)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def writing(path: Path, named: Path | None = None) -> Iterator[None]:
    """Convert disk errors of the block that writes `path` to a ReobjError; others pass.

    Args:
        named: in the error, instead of `path`.
    """
    try:
        yield
    except OSError as error:
        at = Path(os.fsdecode(error.filename or path))
        if not (path.is_relative_to(at) or at.is_relative_to(path) or ".part-" in str(at)):
            raise  # of an input
        why = f"cannot be written ({error.strerror or error})"
        raise ReobjError(
            f"{named or path}: {why}; make room, or choose a folder that takes files"
        ) from error


class LockedError(ReobjError):
    """A lock is held by another process."""


@contextlib.contextmanager
def locked(path: Path, wait_s: float = 0.0, named: Path | None = None) -> Iterator[None]:
    """Hold the lock of a file; the system releases it when the process ends, even if killed.

    Args:
        wait_s: longest time to wait for another process that holds it. named: in disk errors,
            instead of the lock: the file beside it that will be written.
    Raises:
        LockedError: another process, or this one, still holds it.
    """
    lock = filelock.FileLock(path, timeout=wait_s)
    with writing(path, named):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()  # where that is impossible, filelock would wait
        try:
            held = lock.acquire()
        except filelock.Timeout:
            raise LockedError(f"{path}: locked by another process") from None
    with held:
        yield


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
    with writing(folder):
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
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
        ReobjError: the path of a file is a folder, that of a folder is a file, or a folder is not
            writable.
    """
    for path in (folder / name for name in names):
        above = [
            p for p in (folder, *path.parents) if os.path.lexists(p) and p.is_relative_to(folder)
        ]
        blocked = [p for p in above if not (p.is_dir() and os.access(p, os.W_OK))]
        if blocked or (path.is_dir() and not path.is_symlink()):
            what = "it is not writable, or a file in the place of a folder, or the reverse"
            raise ReobjError(f"{(*blocked, path)[0]}: results go here, but {what}; move it away")


def component_path(path: Path, component: int) -> Path:
    """Name the file or folder of one component of the trajectory; that of component 0 is `path`.

    >>> component_path(Path("poses.txt"), 2).name
    'poses_part2.txt'
    """
    return path.with_name(f"{path.stem}_part{component}{path.suffix}") if component else path


def component_paths(path: Path) -> list[Path]:
    """List the existing files or folders of `component_path`, without that of component 0."""
    return sorted(path.parent.glob(f"{path.stem}_part[0-9]*{path.suffix}"))


MEMORY_MAX = 1 << 31  # bytes that one input file may take; detections of an hour of video in npz
LINES_MAX = 2_000_000  # of a table: an hour at 30 Hz with 18 boxes a frame


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
    """Read the lines of a UTF-8 file, with their ends."""
    return read_text(path).splitlines(keepends=True)


def load_json(path: Path) -> Any:
    """Read a JSON file; an error names the line."""
    text = read_text(path)
    if re.search(r"\d{309}", text):  # no float
        raise ReobjError(f"{path}: a number of more than 308 digits")
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


def _leaves(owner: Any, name: str = "state") -> Iterator[tuple[Any, str, str]]:
    """Yield the owner, attribute and dotted name of every array and number of a state.

    The state is a dataclass, or has the names of its attributes in `ARRAYS`; so do its parts.
    """
    for key in getattr(owner, "ARRAYS", ()) or [f.name for f in dataclasses.fields(owner)]:
        value = getattr(owner, key)
        parts = value if isinstance(value, list) else [value]
        for k, part in enumerate(parts):
            if dataclasses.is_dataclass(part) or hasattr(part, "ARRAYS"):
                yield from _leaves(part, f"{name}.{key}.{k}")
            else:
                yield owner, key, f"{name}.{key}"


def state_arrays(state: Any) -> dict[str, Any]:
    """Flatten a state to arrays by dotted names; None is left out."""
    values = {name: getattr(owner, key) for owner, key, name in _leaves(state)}
    return {name: value for name, value in values.items() if value is not None}


def restore_state(state: Any, arrays: Mapping[str, Any]) -> None:
    """Fill a state whose lists have the saved lengths from `state_arrays`.

    Raises:
        KeyError: an array is missing.
    """
    for owner, key, name in _leaves(state):
        fresh = getattr(owner, key)
        found = arrays.get(name) if fresh is None else arrays[name]
        setattr(owner, key, int(arrays[name]) if isinstance(fresh, int) else found)


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
        shutil.rmtree(path, ignore_errors=True)  # a folder
        path.unlink(missing_ok=True)
        return None


class Progress:
    """Show the progress of a stage on stderr in the form of tqdm: done, time left, rate.

    On a terminal it is one line that is drawn again. Elsewhere (a log file) a long stage leaves a
    line every 10 s (environment variable REOBJ_PROGRESS_S), and one at its end. In a `with` block
    the stage is complete if the block ends without an exception, whatever the expected total was.

    Attributes:
        done, total: steps so far and in all (0: unknown). seconds: duration, 0 until it is closed.
        complete: set it to False where the block ends early without an exception.
    """

    def __init__(self, stage: str, total: int = 0) -> None:
        self.stage = stage
        self.total = total
        self.done = 0
        self.seconds = 0.0
        self.complete = True
        self._started = self._shown = time.monotonic()
        self._is_terminal = sys.stderr is not None and sys.stderr.isatty()
        every_s = float(os.environ.get("REOBJ_PROGRESS_S", "10"))
        self._every_s = 0.1 if self._is_terminal else every_s

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(self.complete and kind is None)

    def step(self, n: int = 1) -> None:
        """Count n more steps; 0: none yet, the stage continues."""
        self.done += n
        if time.monotonic() - self._shown > self._every_s:
            self._show()

    def _show(self, end: str = "") -> None:
        self._shown = time.monotonic()
        meter = (self.done, self.total or None, self._shown - self._started)
        text = tqdm.format_meter(*meter, ncols=0, prefix=f"{self.stage:<9}", unit="")
        # on a terminal the rest of a longer line is erased
        line = f"\r{text}\x1b[K{end}" if self._is_terminal else f"{text}\n"
        if sys.stderr is not None:
            print(line, end="", file=sys.stderr, flush=True)

    def close(self, complete: bool = True) -> float:
        """Finish the line, at 100 % if the stage is complete; returns seconds since the start."""
        self.seconds = time.monotonic() - self._started
        if complete:
            self.total = self.done
        if self._is_terminal or self.seconds > 1:
            self._show("\n")
        return self.seconds


@contextlib.contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log on stderr: unlike our errors it names no file."""
    opencv: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5, 4
    before = opencv.setLogLevel(0)
    try:
        yield
    finally:
        opencv.setLogLevel(before)


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
