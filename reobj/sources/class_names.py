"""Class names by number: text files, JSON, data.yaml of YOLO datasets, text labels of detectors."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from reobj.files import load_json, read_lines
from reobj.types import CLASS_MAX, CLASS_NAME_MAX, ReobjError, visible_name


def load_class_names(path: str | Path) -> tuple[str, ...]:
    """Read class names in the order of their numbers.

    Args:
        path: text file with one name a line (empty lines are skipped); or data.yaml whose `names`
            are a list or a map from numbers, in block or flow style; or JSON with the same content.
    Raises:
        ReobjError: no names, more than CLASS_MAX, or one of more than CLASS_NAME_MAX characters.
    """
    path = Path(path)
    if is_yaml(path):
        names = _yaml_names(path)
    elif path.suffix.lower() == ".json":
        names = _json_names(path)
    else:
        names = [(i, line.strip()) for i, line in enumerate(read_lines(path), 1) if line.strip()]
    if len(names) > CLASS_MAX:
        raise ReobjError(f"{path}: {len(names)} class names, at most {CLASS_MAX} are allowed")
    for line, name in names:
        check_length(name, f"{path}, line {line}" if line else str(path))
    return tuple(name for _, name in names)


def is_yaml(path: Path) -> bool:
    """Test whether the suffix of a file is that of YAML."""
    return path.suffix.lower() in (".yaml", ".yml")


def check_length(name: str, where: str) -> None:
    """Refuse a class name of more than CLASS_NAME_MAX characters."""
    if len(name) > CLASS_NAME_MAX:
        text = f"a class name of {len(name)} characters, at most {CLASS_NAME_MAX} are allowed"
        raise ReobjError(f"{where}: {text} ({name[:20]}...)")


def _numbered(entries: Iterable[tuple[str, str, int]], where: str) -> list[tuple[int, str]]:
    """Sort (number, name, line) by number; missing numbers get the name `class N`.

    Returns:
        (line, name) of each number, from 0.
    """
    named: dict[int, tuple[int, str]] = {}
    for number, name, line in entries:
        if not number.isdecimal() or int(number) > CLASS_MAX:
            expected = f"expected a whole number from 0 to {CLASS_MAX}"
            raise ReobjError(f"{where}, line {line}: class number {number!r}, {expected}")
        named[int(number)] = (line, name)
    count = max(named, default=-1) + 1
    return [named.get(i, (0, f"class {i}")) for i in range(count)]


def _json_names(path: Path) -> list[tuple[int, str]]:
    """Read (line, name) of a JSON list of names, a map from numbers, or either under `names`."""
    data = load_json(path)
    data = data.get("names", data) if isinstance(data, dict) else data
    if isinstance(data, list) and all(isinstance(name, str) for name in data):
        return [(0, name) for name in data]
    if isinstance(data, dict) and all(isinstance(name, str) for name in data.values()):
        return _numbered(((str(i), name, 0) for i, name in data.items()), str(path))
    raise ReobjError(f"{path}: expected a list of class names, or a map from numbers to names")


def _yaml_names(path: Path) -> list[tuple[int, str]]:
    """Read (line, name) of the key `names` of a YAML file; other YAML is not parsed."""
    lines = [_without_comment(line) for line in read_lines(path)]
    at = next((i for i, line in enumerate(lines) if re.match(r"names\s*:", line)), None)
    if at is None:
        raise ReobjError(f"{path}: no `names:` in it; expected YOLO's data.yaml, or a text file "
                         "with one class name a line")  # fmt: skip
    text = lines[at].partition(":")[2].strip()
    entries = _flow_entries(lines, at, text, path) if text else _block_entries(lines, at)
    if not entries:
        raise ReobjError(f"{path}, line {at + 1}: `names:` lists no names")
    numbers = [number for number, _, _ in entries]
    if all(numbers):
        return _numbered(entries, str(path))
    return [(line, name) for _, name, line in entries]


def _flow_entries(
    lines: Sequence[str], at: int, text: str, path: Path
) -> list[tuple[str, str, int]]:
    """Read [a, b] or {0: a, 1: b}, begun by `text` in line `at` and continued in the next lines.

    Returns:
        (number or "", name, line) of each entry.
    """
    closing = {"[": "]", "{": "}"}.get(text[0])
    for line in lines[at + 1 :]:
        if closing is None or text.endswith(closing):
            break
        text += " " + line.strip()
    if closing is None or not text.endswith(closing):
        raise ReobjError(f"{path}, line {at + 1}: `names: {text[:40]}`, expected [a, b], "
                         "{0: a, 1: b}, or a line for each name")  # fmt: skip
    item = re.compile(  # a; 'b c'; 0: a; 1: "b"
        r"""\s*(?:['"]?(?P<number>\d+)['"]?\s*:\s+)?(?:'(?P<one>(?:[^']|'')*)'|"(?P<two>[^"]*)"|"""
        r"""(?P<plain>[^,'"\[\]{}][^,\[\]{}]*))\s*(?:,|$)"""
    )
    content = text[1:-1].strip()
    entries = list[tuple[str, str, int]]()
    position = 0
    while position < len(content):
        entry = item.match(content, position)
        if entry is None:
            raise ReobjError(f"{path}, line {at + 1}: {content[position : position + 40]!r} in "
                             "`names` cannot be read")  # fmt: skip
        one = entry["one"]
        name = one.replace("''", "'") if one is not None else entry["two"] or entry["plain"] or ""
        entries.append((entry["number"] or "", name.strip(), at + 1))
        position = entry.end()
    return entries


def _block_entries(lines: Sequence[str], at: int) -> list[tuple[str, str, int]]:
    """Read the lines `- a` or `0: a` after line `at`: (number or "", name, line) of each."""
    entries = []
    for i, line in enumerate(lines[at + 1 :], at + 2):
        if not line.strip():
            continue
        entry = re.fullmatch(r"\s*-\s+(.*)|\s+['\"]?(\d+)['\"]?\s*:\s+(.*)", line)
        if entry is None:
            break  # the next key
        name = (entry[1] if entry[1] is not None else entry[3]).strip()
        quoted = len(name) > 1 and name[0] == name[-1] and name[0] in "'\""
        entries.append((entry[2] or "", name[1:-1] if quoted else name, i))
    return entries


def _without_comment(line: str) -> str:
    """Remove the comment of a line of YAML."""
    return re.sub(r"(^|\s)#.*", "", line.rstrip())


class Vocabulary(Sequence[str]):
    """Class names by number; new labels get the next numbers.

    Shared by all users of the class names of a detector with text labels.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = [visible_name(name) for name in names]
        self._number = {name: i for i, name in reversed(list(enumerate(self._names)))}

    def numbers(self, labels: Sequence[str]) -> list[int]:
        """Return the numbers of labels; new labels are added."""
        return [self._number_of(visible_name(label)) for label in labels]

    def _number_of(self, label: str) -> int:
        if label not in self._number:
            check_length(label, "labels of the detector")
            if len(self._names) > CLASS_MAX:
                raise ReobjError(f"more than {CLASS_MAX} different labels; expected fewer classes")
            self._number[label] = len(self._names)
            self._names.append(label)
        return self._number[label]

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return tuple(self._names)[index]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]
