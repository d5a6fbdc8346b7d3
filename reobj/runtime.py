"""Versions of the required packages; OpenCV's log, and its threads in forked processes."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import os
import re
from collections.abc import Iterator
from typing import Any

import cv2

from reobj.types import ReobjError

# Lower bounds, as in pyproject.toml; the tests also run with them (.ci/lowest.txt).
LEAST_VERSIONS = {
    "opencv-python-headless": "4.10",
    "numpy": "1.26.4",
    "scipy": "1.13.1",
    "onnxruntime": "1.19.2",
    "pycolmap": "4.2.1",
    "filterpy": "2.0.0",
    "av": "15",
    "pillow": "11",
    "pyyaml": "6.0.2",
    "msgspec": "0.19",
}


def _numbers(version: str) -> tuple[int, ...]:
    """Parse the leading numbers of a version: "4.10.0-dev" is (4, 10, 0)."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(map(int, match[0].split("."))) if match else ()


@functools.cache
def check_versions() -> None:
    """Check the versions of the installed packages.

    OpenCV's version is that of the module: its other distributions (opencv-python) write into the
    same folder, and pip's metadata do not show which was installed last. Packages without metadata
    are not checked.

    Raises:
        ReobjError: a package is too old.
    """
    for package, least in LEAST_VERSIONS.items():
        installed = cv2.__version__
        if package != "opencv-python-headless":
            try:
                installed = importlib.metadata.version(package)
            except importlib.metadata.PackageNotFoundError:
                continue
        if _numbers(installed) < _numbers(least):
            name = "OpenCV" if package.startswith("opencv") else package
            force = " --force-reinstall" if name == "OpenCV" else ""
            raise ReobjError(f"{name} {installed} is installed, {least} or later is needed: "
                             f'pip install{force} "{package}>={least}"')  # fmt: skip


@contextlib.contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log on stderr: unlike our errors it names no file."""
    log: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5, 4
    before = log.setLogLevel(0)
    try:
        yield
    finally:
        log.setLogLevel(before)


_threads_before: list[int] = []


def _end_threads() -> None:
    _threads_before.append(cv2.getNumThreads())
    cv2.setNumThreads(1)


def _allow_threads() -> None:
    cv2.setNumThreads(_threads_before.pop())


@functools.cache
def guard_forks() -> None:
    """End OpenCV's threads before this process is forked; they start again when needed.

    A forked process does not have the thread pool, but OpenCV waits for it there, also when the
    number of threads is changed.
    """
    if hasattr(os, "register_at_fork"):  # not on Windows
        os.register_at_fork(
            before=_end_threads, after_in_parent=_allow_threads, after_in_child=_allow_threads
        )
