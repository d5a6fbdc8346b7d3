"""Registries of file formats, and the frames that the names of images in files belong to.

An entry is a format, recognised by structure alone or named by a flag.

There is one registry each for detections, poses, cameras and ground truth. Nothing is scored or
guessed: a file that fits no entry, or several, is refused with their names and the flag.
"""

from __future__ import annotations

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
        if zipfile.is_zipfile(self.path):
            with zipfile.ZipFile(self.path) as archive:
                return frozenset(archive.namelist())
        return frozenset()

    @functools.cached_property
    def lines(self) -> list[str]:
        """Non-empty lines at the start of a text file; [] of a folder or a binary file."""
        if self.is_dir:
            return []
        with self.path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
            return []
        coding = "utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
        lines = [line.strip() for line in head.decode(coding, "replace").splitlines()]
        cut = len(head) == HEAD_BYTES and len(lines) > 1  # within the last line
        return [line for line in lines[: -1 if cut else None] if line]

    @property
    def json_lines(self) -> bool:
        """Whether the file is JSON Lines: an object or list a line."""
        pairs = [line[0] + line[-1] for line in self.lines[:2]]
        return self.suffix in (".jsonl", ".ndjson") or (len(pairs) > 1 and {*pairs} <= {"{}", "[]"})

    @functools.cached_property
    def kind(self) -> str:
        """Kind of file: "folder", "XML", "JSON" or "text"; "" of a binary one."""
        begin = self.lines[0][0] if self.lines else ""
        text = {"<": "XML", "[": "JSON", "{": "JSON", "": ""}.get(begin, "text")
        return "folder" if self.is_dir else text

    @functools.cached_property
    def json(self) -> Any:
        """Content of a JSON file; None of another file. Reads it once.

        Raises:
            ReobjError: the name ends with .json, and the content is damaged.
        """
        if (self.suffix != ".json" and self.kind != "JSON") or self.json_lines:
            return None
        return load_json(self.path)

    @functools.cached_property
    def root(self) -> ElementTree.Element | None:
        """Root element of an XML file, without its children; None of another file."""
        if self.kind != "XML":
            return None
        try:
            element: ElementTree.Element = next(ElementTree.iterparse(self.path, ("start",)))[1]
        except (ElementTree.ParseError, StopIteration):
            return None
        return element

    def keys(self) -> frozenset[str]:
        """Keys of a JSON object, or of the first object of a JSON list; else empty."""
        data = self.json
        data = data[0] if isinstance(data, list) and data else data
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
        read: the reader; None: a format that is only named, with `advice` on the export to use.
        frames, units, unread: numbering of frames, units, and what is not read (for the table).
        kind: of file, as of a Probe; "": any.
    """

    name: str
    title: str
    recognise: Callable[[Any], bool]
    read: R | None
    frames: str = ""
    units: str = ""
    unread: str = ""
    advice: str = ""
    kind: str = ""


@dataclass(frozen=True, slots=True)
class Registry(Generic[R]):
    """All formats of one kind of content. `flag` names an entry; `what`: in messages."""

    what: str
    flag: str
    formats: Sequence[Format[R]]

    @property
    def readable(self) -> list[Format[R]]:
        """The formats with a reader."""
        return [entry for entry in self.formats if entry.read is not None]

    def reader(self, path: Path, name: str = AUTO) -> R:
        """Return the reader of a file: of the format that the user names, or that it fits.

        Raises:
            ReobjError: no such file or format; a file that fits none, several, or one that is
                only named.
        """
        entry = self.find(path, name)
        if entry.read is None:
            raise ReobjError(f"{path}: {entry.title}, not read; {entry.advice}")
        return entry.read

    def find(self, path: Path, name: str = AUTO) -> Format[R]:
        """Return the format of a file, as `reader` does."""
        if not path.exists():
            raise ReobjError(f"{path} does not exist")
        return self.choose(Probe(path), name)

    def choose(self, probe: Any, name: str = AUTO) -> Format[R]:
        """Return the format that the user names, or that a probe fits, as `reader` does."""
        known = {entry.name: entry for entry in self.readable}
        if name not in ("", AUTO):
            if name not in known:
                close = did_you_mean(name, known) or f"; expected {AUTO}, {', '.join(known)}"
                raise ReobjError(f"{self.flag} {name}: no such format{close}")
            return known[name]
        fits = [entry for entry in self.formats if entry.recognise(probe)]
        if len(fits) == 1:
            return fits[0]
        names = [entry.name for entry in fits if entry.read is not None]
        if fits:
            raise ReobjError(f"{probe.path}: fits {len(fits)} formats of {self.what}: "
                             f"{', '.join(names)}; name one with {self.flag}")  # fmt: skip
        near = [name for name, entry in known.items() if entry.kind == probe.kind] or known
        raise ReobjError(f"{probe.path}: no known format of {self.what}{probe.found}; expected one "
                         f"of {', '.join(near)} ({self.flag}; docs/input_formats.md)")  # fmt: skip


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
        given_paths = [_components(name, suffix) for name in given]
        image_paths = [_components(image, suffix) for image in images]
        clash: list[tuple[str, ...]] = []
        for depth in range(1, max(map(len, given_paths + image_paths), default=0) + 1):
            of_given = Counter(path[-depth:] for path in given_paths)
            of_images = Counter(path[-depth:] for path in image_paths)
            matched = [key for key in of_given if key in of_images]
            if not matched:
                break  # longer keys match no better
            clash = [key for key in matched if of_given[key] > 1 or of_images[key] > 1]
            if not clash:
                frame_of = {path[-depth:]: frame for frame, path in enumerate(image_paths)}
                rule = "file names" if depth == 1 else f"file names with {depth - 1} folders"
                rule += "" if suffix else ", without suffixes"
                frames = [frame_of.get(path[-depth:], -1) for path in given_paths]
                return np.array(frames, np.int64), rule
        if clash:
            raise ReobjError(
                f"{where}: {'/'.join(clash[0])} is the name of several images in different "
                "folders; rename the images, or give the images of one folder only"
            )
    return np.full(len(given), -1, np.int64), ""
