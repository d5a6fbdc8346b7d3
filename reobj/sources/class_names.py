"""Class names by number: text files, JSON, data.yaml, metadata of models, labels of detectors."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from reobj.files import load_json, read_lines, read_text
from reobj.types import CLASS_MAX, CLASS_NAME_MAX, ReobjError, visible_name

YAML_MAX = 1 << 22  # characters; CLASS_MAX names take less


def load_class_names(path: str | Path) -> tuple[str, ...]:
    """Read class names in the order of their numbers.

    Args:
        path: text file with one name, or `NUMBER: NAME` or `NUMBER NAME`, a line (empty lines are
            skipped); or data.yaml, whose `names` are a list or a map from numbers; or JSON with
            the same content, or with `categories` (Label Studio's notes.json).
    Raises:
        ReobjError: as `names_by_number`, or a damaged file.
    """
    path = Path(path)
    where = str(path)
    if not is_yaml(path) and path.suffix.lower() != ".json":
        return names_by_number(_of_lines(path), where)
    data = parse_yaml(read_text(path, YAML_MAX), where) if is_yaml(path) else load_json(path)
    if is_yaml(path) and not (isinstance(data, dict) and "names" in data):
        raise ReobjError(f"{path}: no `names:` in it; expected YOLO's data.yaml, or a text file "
                         "with one class name a line")  # fmt: skip
    if not isinstance(data, dict):
        return names_by_number(data, where)
    if isinstance(entries := data.get("categories"), list):
        named = [entry for entry in entries if isinstance(entry, dict)]
        data = {"names": {entry.get("id"): entry.get("name") for entry in named}}
    names = names_by_number(given := data.get("names", data), where)
    if "nc" in data and str(data["nc"]) not in (str(len(names)), str(len(given))):
        raise ReobjError(f"{path}: nc is {data['nc']}, but there are {len(names)} names")
    return names


def _of_lines(path: Path) -> list[str] | dict[str, str]:
    """Read a name a line, or a number and a name: all lines have one, or none has."""
    lines = [line.strip() for line in read_lines(path) if line.strip()]
    numbered = [match for line in lines if (match := re.fullmatch(r"(\d+)[\s:,]+(\S.*)", line))]
    named = {match[1]: match[2] for match in numbered}
    if numbered and len(named) < len(lines):
        raise ReobjError(f"{path}: {len(numbered)} of {len(lines)} lines are a number and a name "
                         f"({numbered[0][0]!r:.40}); expected different numbers in all, or in none"
                         )  # fmt: skip
    return named or lines


def is_yaml(path: Path) -> bool:
    """Test whether the suffix of a file is that of YAML."""
    return path.suffix.lower() in (".yaml", ".yml")


def parse_yaml(text: str, where: str) -> Any:
    """Parse YAML; scalars stay text, as a class may be called `no` or `1.0`."""
    try:
        return yaml.load(text, yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        reason = getattr(error, "problem", None) or error
        raise ReobjError(f"{where}{line}: invalid YAML ({reason})") from error


def names_by_number(names: Any, where: str = "class names of the detector") -> tuple[str, ...]:
    """Return the names of the classes 0, 1, ...; one without a name is `class N`.

    Args:
        names: a list, or a map from numbers. where: begins an error.
    Raises:
        ReobjError: neither, no names, more than CLASS_MAX, or one of more than CLASS_NAME_MAX
            characters.
    """
    if not isinstance(names, Mapping):
        names = dict(enumerate(names)) if isinstance(names, list | tuple) else {}
    if not names or not all(isinstance(name, str | int | float) for name in names.values()):
        raise ReobjError(f"{where}: expected class names, a list or a map from numbers")
    named = dict[int, str]()
    for number, name in names.items():
        if not re.fullmatch(r"\d{1,5}", str(number)) or int(number) > CLASS_MAX:
            expected = f"expected a whole number from 0 to {CLASS_MAX}"
            raise ReobjError(f"{where}: class number {number!r}, {expected}")
        check_length(str(name), where)
        named[int(number)] = str(name)
    return tuple(named.get(i, f"class {i}") for i in range(max(named) + 1))


def check_length(name: str, where: str) -> None:
    """Refuse a class name of more than CLASS_NAME_MAX characters."""
    if len(name) > CLASS_NAME_MAX:
        text = f"a class name of {len(name)} characters, at most {CLASS_NAME_MAX} are allowed"
        raise ReobjError(f"{where}: {text} ({name[:20]}...)")


class Vocabulary(list[str]):
    """Class names by number; new labels get the next numbers.

    Shared by all users of the class names of a detector with text labels. Equal to a tuple of the
    same names.
    """

    def numbers(self, labels: Sequence[str]) -> list[int]:
        """Return the numbers of labels; new labels are added."""
        names = [visible_name(label) for label in labels]
        for name in names:
            if name not in self:
                check_length(name, "labels of the detector")
                self.append(name)
        if len(self) > CLASS_MAX:
            raise ReobjError(f"more than {CLASS_MAX} different labels; expected fewer classes")
        return [self.index(name) for name in names]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)
