"""Files and text: whole or not at all, JSON and npz, progress on stderr."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import re
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.types import Array, ReobjError


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Write a file under a temporary name beside it; it gets its own when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".part-{path.name}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ReobjError(f"{path}: cannot be read as text ({error})") from error


def load_json(path: Path) -> Any:
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise ReobjError(f"{path}, line {error.lineno}: not valid JSON ({error.msg})") from error


def save_npz(path: Path, arrays: Mapping[str, Any], **facts: Any) -> None:
    """Write arrays, and facts as JSON, to an npz file that is there whole or not at all."""
    with atomic(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays, facts=np.array(json.dumps(facts)))


def load_npz(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the arrays and the facts that `save_npz` wrote.

    Raises:
        ReobjError: damaged, or no npz file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = dict(file)
        facts: dict[str, Any] = json.loads(str(arrays.pop("facts", "{}")))
    except Exception as error:  # zip, zlib and numpy each have their own for damaged files
        raise ReobjError(f"{path}: damaged, or no npz file ({error})") from error
    return arrays, facts


class Progress:
    """One line a stage on stderr with rate and time left; silent when stderr is no terminal."""

    def __init__(self, stage: str, total: int = 0) -> None:
        self.stage, self.total, self.done = stage, total, 0
        self.started, self.shown = time.monotonic(), 0.0
        self.enabled = sys.stderr.isatty()

    def step(self, n: int = 1) -> None:
        """Count n more; redraw at most ten times a second."""
        self.done += n
        if self.enabled and time.monotonic() - self.shown > 0.1:
            self._draw()

    def _draw(self) -> None:
        self.shown = time.monotonic()
        rate = self.done / max(self.shown - self.started, 1e-6)
        text = f"{self.stage:<10}{self.done}"
        if self.total:
            left = max(self.total - self.done, 0) / rate if rate else math.inf
            text += f"/{self.total} {100 * self.done / self.total:3.0f} %"
            text += f", {left:.0f} s left" if math.isfinite(left) else ""
        sys.stderr.write(f"\r{text}, {rate:.1f}/s\x1b[K")  # erase what a longer line left behind

    def close(self) -> float:
        """Finish the line and return the seconds since the start."""
        if self.enabled and self.done:
            self._draw()
            sys.stderr.write("\n")
        return time.monotonic() - self.started


def without_password(text: str) -> str:
    """Return a text whose URLs have lost user and password: what may be shown and written.

    >>> without_password("rtsp://me:secret@10.0.0.7/stream")
    'rtsp://10.0.0.7/stream'
    """
    return re.sub(r"(?<=://)[^/@\s]*@", "", text)


def shortened(items: Sequence[Any]) -> str:
    """Return the first five of a list, for messages."""
    return ", ".join(map(str, items[:5])) + (", ..." if len(items) > 5 else "")


def spans(numbers: Iterable[int], step: int = 1) -> str:
    """Write ascending numbers as spans.

    >>> spans([3, 4, 5, 9])
    '3-5, 9'
    """
    spans: list[list[int]] = []
    for n in numbers:
        if spans and n - spans[-1][1] <= step:
            spans[-1][1] = n
        else:
            spans.append([n, n])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in spans)


def rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


def numbers(values: Array) -> list[float]:
    """Six significant digits: far below any accuracy, and stable text."""
    return [float(f"{v:.6g}") for v in np.asarray(values).ravel()]


def base64_text(values: npt.NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()
