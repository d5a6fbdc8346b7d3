"""Registries of file formats, and the frames that the names of images in files belong to.

An entry is a format, recognised by structure alone or named by a flag.

There is one registry each for detections, poses, cameras and ground truth. Nothing is scored or
guessed: a file that fits no entry, or several, is refused with their names and the flag.
"""

from __future__ import annotations

import codecs
import contextlib
import functools
import xml.etree.ElementTree as ElementTree
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar

import numpy as np

from reobj.files import did_you_mean, load_json, shortened
from reobj.types import IntArray, ReobjError

R = TypeVar("R", bound=Callable[..., Any])
AUTO = "auto"
HEAD_BYTES = 65536


class Probe:
    """What `recognise` looks at: names, the first lines, and top-level keys of a file or folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.suffix = path.suffix.lower()
        self.is_dir = path.is_dir()

    @functools.cached_property
    def names(self) -> frozenset[str]:
        """Names in the folder, or in the zip archive; empty of another file."""
        if self.is_dir:
            return frozenset(entry.name for entry in self.path.iterdir())
        if not zipfile.is_zipfile(self.path):
            return frozenset()
        with zipfile.ZipFile(self.path) as archive:
            return frozenset(archive.namelist())

    @functools.cached_property
    def lines(self) -> list[str]:
        """Non-empty lines at the start of a text file; [] of a folder or a binary file."""
        if self.is_dir:
            return []
        with self.path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        is_utf16 = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        if b"\0" in head and not is_utf16:
            return []
        lines = head.decode("utf-16" if is_utf16 else "utf-8-sig", "replace").splitlines()
        cut = len(head) == HEAD_BYTES and len(lines) > 1  # within the last line
        return list(filter(None, map(str.strip, lines[: -1 if cut else None])))

    @property
    def json_lines(self) -> bool:
        """Whether the file is JSON Lines: an object or list a line."""
        pairs = [line[0] + line[-1] for line in self.lines[:2]]
        return self.suffix in (".jsonl", ".ndjson") or (len(pairs) > 1 and {*pairs} <= {"{}", "[]"})

    @functools.cached_property
    def kind(self) -> str:
        """Kind of file: "folder", "XML", "JSON" or "text"; "" of a binary one."""
        if self.is_dir or not self.lines:
            return "folder" * self.is_dir
        return {"<": "XML", "[": "JSON", "{": "JSON"}.get(self.lines[0][0], "text")

    @functools.cached_property
    def json(self) -> Any:
        """Content of a JSON file; None of another file. Reads it once.

        Raises:
            ReobjError: the name ends with .json, and the content is damaged.
        """
        is_json = self.suffix == ".json" or self.kind == "JSON"
        return load_json(self.path) if is_json and not self.json_lines else None

    @functools.cached_property
    def root(self) -> ElementTree.Element | None:
        """Root element of an XML file, without its children; None of another file."""
        if self.kind == "XML":
            with contextlib.suppress(ElementTree.ParseError, StopIteration):
                element: ElementTree.Element = next(ElementTree.iterparse(self.path, ("start",)))[1]
                return element
        return None

    def keys(self) -> frozenset[str]:
        """Keys of a JSON object, or of the first object of a JSON list; else empty."""
        data = self.json[0] if isinstance(self.json, list) and self.json else self.json
        return frozenset(data) if isinstance(data, dict) else frozenset()

    @functools.cached_property
    def found(self) -> str:
        """What the file holds, for the error of one that fits no format."""
        if self.json_lines:
            return " (JSON Lines, one object a line); write one JSON list of these objects"
        if self.root is not None:
            return f" (XML <{self.root.tag}>)"
        return f" (JSON with {shortened(sorted(self.keys()))})" if self.keys() else ""


@dataclass(frozen=True, slots=True)
class Format(Generic[R]):
    """One file format.

    Attributes:
        name: value of the flag. title: the tools and datasets that write it.
        recognise: tests structure alone (names, suffix, header, keys).
        frames, units, unread: numbering of frames, units, and what is not read (for the table).
        kind: of file, as of a Probe; "": any.
    """

    name: str
    title: str
    recognise: Callable[[Any], bool]
    read: R
    frames: str = ""
    units: str = ""
    unread: str = ""
    kind: str = ""


@dataclass(frozen=True, slots=True)
class Registry(Generic[R]):
    """All formats of one kind of content.

    Attributes:
        what: the content, in messages. flag: names an entry. advice: for files of other formats.
    """

    what: str
    flag: str
    formats: Sequence[Format[R]]
    advice: str = ""

    def find(self, path: Path, name: str = AUTO) -> Format[R]:
        """Return the format of a file: the one that the user names, or that it fits.

        Raises:
            ReobjError: no such file or format; a file that fits none or several.
        """
        if not path.exists():
            raise ReobjError(f"{path} does not exist")
        return self.choose(Probe(path), name)

    def choose(self, probe: Any, name: str = AUTO) -> Format[R]:
        """Return the format that the user names, or that a probe fits, as `find` does."""
        known = {entry.name: entry for entry in self.formats}
        if name not in ("", AUTO):
            if name not in known:
                close = did_you_mean(name, known) or f"; expected {AUTO}, {', '.join(known)}"
                raise ReobjError(f"{self.flag} {name}: no such format{close}")
            return known[name]
        fits = [entry for entry in self.formats if entry.recognise(probe)]
        if len(fits) > 1:
            names = ", ".join(entry.name for entry in fits)
            raise ReobjError(f"{probe.path}: fits {len(fits)} formats of {self.what}: {names}; "
                             f"name one with {self.flag}")  # fmt: skip
        if not fits:
            near = [name for name, entry in known.items() if entry.kind == probe.kind] or known
            raise ReobjError(f"{probe.path}: no known format of {self.what}{probe.found}; expected "
                             f"one of {', '.join(near)} ({self.flag}; docs/input_formats.md)"
                             f"{self.advice}")  # fmt: skip
        return fits[0]


# ---- Names of images -----------------------------------------------------------------------------


def _components(name: str | Path, suffix: bool) -> tuple[str, ...]:
    """Split a path, also of Windows, into its components; the last one with or without suffix."""
    path = PurePosixPath(str(name).replace("\\", "/"))
    components = tuple(part for part in path.parts if part not in (".", "/"))
    return components if suffix else (*components[:-1], path.stem)


def frames_by_name(
    given: Sequence[str], images: Sequence[str | Path], where: str = "names"
) -> tuple[IntArray, str]:
    """Match names of images to the images of a source.

    The file names are compared first. Where a file name is not unique, on either side, folders are
    added from the right until it is. Suffixes are ignored if no name matches with its suffix.

    Args:
        given: (N,) distinct names, with or without folders. images: (F,) paths of all images of
            the source, in the order of its frames. where: source of the names, for the error.
    Returns:
        frame (N,) of each name, -1: no image has that name; and the rule that matched, "" if none.
    Raises:
        ReobjError: with any number of folders a name matches several images, or an image several
            names.
    """
    for suffix in (True, False):
        given_paths, image_paths = (
            [_components(name, suffix) for name in names] for names in (given, images)
        )
        clash: list[tuple[str, ...]] = []
        for depth in range(1, max(map(len, given_paths + image_paths), default=0) + 1):
            keys, of_images = ([p[-depth:] for p in paths] for paths in (given_paths, image_paths))
            counts = Counter(keys), Counter(of_images)
            matched = counts[0].keys() & counts[1].keys()
            if not matched:
                break  # longer keys match no better
            clash = sorted(key for key in matched if counts[0][key] > 1 or counts[1][key] > 1)
            if not clash:
                frame_of = {key: frame for frame, key in enumerate(of_images)}
                rule = "file names" + f" with {depth - 1} folders" * (depth > 1)
                frames = [frame_of.get(key, -1) for key in keys]
                return np.array(frames, np.int64), rule + ", without suffixes" * (not suffix)
        if clash:
            raise ReobjError(
                f"{where}: {'/'.join(clash[0])} is the name of several images in different "
                "folders; rename the images, or give the images of one folder only"
            )
    return np.full(len(given), -1, np.int64), ""
