"""The part of YAML that files of cameras are written in: mappings, lists of numbers, no more.

OpenCV's FileStorage, ROS's camera_info, Kalibr's camchain, EuRoC's sensor.yaml.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from reobj.files import read_text
from reobj.types import ReobjError

TEXT_MAX = 1 << 20  # characters; chosen: a thousand times what a camera takes


def read_yaml(path: Path) -> dict[str, Any]:
    """Read nested mappings with values that are words, numbers or lists of them.

    Indentation nests; `[1, 2]` may go on over lines; lines `- 1` and `- [1, 2]` are lists. Tags,
    comments and document marks are skipped.

    Raises:
        ReobjError: a line is none of these.
    """
    text = re.sub(r"(^|\s)#.*", r"\1", read_text(path, TEXT_MAX), flags=re.MULTILINE)
    text = re.sub(r"\[[^\[\]]*\]", lambda m: " ".join(m[0].split()), text)  # lists to one line
    whole: dict[str, Any] = {}
    stack: list[tuple[int, Any]] = [(-1, whole)]  # indentation and content of what is open
    key, key_indent = "", -1
    for line in text.splitlines():
        if not line.strip() or line.startswith(("%", "---", "...")):
            continue
        indent, word = len(line) - len(line.lstrip()), line.strip()
        item = word.startswith("- ")
        while not item and stack[-1][0] >= indent and len(stack) > 1:
            stack.pop()
        parent = stack[-1][1]
        if item:
            rows = parent.get(key) if isinstance(parent.get(key), list) else []
            parent[key] = [*rows, _value(word[2:])]
            continue
        if key and indent > key_indent and parent.get(key, "") is None:
            parent[key] = {}
            stack.append((key_indent, parent[key]))
            parent = parent[key]
        name, colon, value = word.partition(":")
        if not colon:
            raise ReobjError(f"{path}: {word[:60]!r} is not understood; expected `key: value`")
        key, key_indent = name.strip(" \"'"), indent
        value = re.sub(r"^!\S+", "", value.strip()).strip()
        parent[key] = _value(value) if value else None
    return whole


def _value(text: str) -> Any:
    """Convert a word, a number or a list of them."""
    text = text.strip()
    if text.startswith("["):
        return [_value(part) for part in text.strip("[]").split(",") if part.strip()]
    try:
        return float(text)
    except ValueError:
        return text.strip("\"'")
