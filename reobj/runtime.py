"""Packages that are used here: their versions; OpenCV's log, and its threads in a fork."""

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

# The lower bounds of pyproject.toml; the tests run with them too (.ci/lowest.txt).
LEAST_VERSIONS = {
    "opencv-python-headless": "4.10",
    "numpy": "1.26.4",
    "scipy": "1.13.1",
    "onnxruntime": "1.19.2",
    "pycolmap": "4.2.1",
    "filterpy": "2.0.0",
}


def _numbers(version: str) -> tuple[int, ...]:
    """Read 4.10.0 of "4.10.0-dev" as (4, 10, 0)."""
    found = re.match(r"\d+(\.\d+)*", version)
    return tuple(map(int, found[0].split("."))) if found else ()


@functools.cache
def check_versions() -> None:
    """Check the versions of what is installed.

    OpenCV says its own: other packages of it (opencv-python) write into the same folder, and pip
    does not know which one came last. What has no entry of the package manager is not checked.

    Raises:
        ReobjError: the first that is too old.
    """
    for package, least in LEAST_VERSIONS.items():
        found = cv2.__version__
        if package != "opencv-python-headless":
            try:
                found = importlib.metadata.version(package)
            except importlib.metadata.PackageNotFoundError:
                continue
        if _numbers(found) < _numbers(least):
            name = "OpenCV" if package.startswith("opencv") else package
            force = " --force-reinstall" if name == "OpenCV" else ""
            raise ReobjError(f"{name} {found} is installed, {least} or later is needed: "
                             f'pip install{force} "{package}>={least}"')  # fmt: skip


@contextlib.contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV's remarks off stderr: they name no file, our errors do."""
    log: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5 and 4
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

    The pool of threads does not exist in the forked process, and OpenCV waits for it there, also
    when the number of threads is changed: it must end before the fork.
    """
    if hasattr(os, "register_at_fork"):  # not on Windows
        os.register_at_fork(
            before=_end_threads, after_in_parent=_allow_threads, after_in_child=_allow_threads
        )
