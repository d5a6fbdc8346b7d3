"""Check what a JSON file holds against a schema: the one place that says what is wrong where.

Of JSON Schema (draft 2020-12) the keywords in KEYWORDS, which is what our schemas use. Stricter in
two things: NaN and infinity are no numbers, and 1.0 is no integer. By hand: the packages that do it
are none that a run needs, and this is less than any glue to them; a test compares it with
`jsonschema`.
"""

from __future__ import annotations

import json
import operator
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from reobj.files import load_json

Schema = Mapping[str, Any]
KEYWORDS = frozenset(
    "$ref additionalProperties allOf const enum exclusiveMinimum if items maxItems maxProperties "
    "maximum minItems minimum properties required then type".split()
)
NO_CHECKS = frozenset(("$defs", "$schema", "title", "description"))


def faults(
    value: Any, schema: Schema, at: str = "$", defs: Mapping[str, Schema] | None = None
) -> Iterator[str]:
    """Yield what is not as a schema says: "where: what was found, expected what".

    Args:
        at: path of the value, as JSONPath writes it. defs: what `$ref` may name; default: $defs.
    """
    defs = schema.get("$defs", {}) if defs is None else defs
    if "$ref" in schema:
        schema = defs[schema["$ref"].rpartition("/")[2]]
    if expected := _mismatch(value, schema):
        yield f"{at}: {_shown(value)}, expected {expected}"
        return
    if isinstance(value, dict):
        yield from (f"{at}: no {key!r}" for key in schema.get("required", ()) if key not in value)
        known, other = schema.get("properties", {}), schema.get("additionalProperties", {})
        for key, item in value.items():
            yield from faults(item, known.get(key, other), f"{at}.{key[:KEY_SHOWN]}", defs)
    elif isinstance(value, list) and "items" in schema:
        for number, item in enumerate(value):
            yield from faults(item, schema["items"], f"{at}[{number}]", defs)
    for more in schema.get("allOf", ()):
        if next(faults(value, more["if"], at, defs), None) is None:
            yield from faults(value, more["then"], at, defs)


KEY_SHOWN, TEXT_SHOWN = 40, 60  # characters of the file's own words in messages (chosen)
_TYPES = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}


def _is(value: Any, kind: str) -> bool:
    if kind in _TYPES:
        return isinstance(value, _TYPES[kind])
    number = isinstance(value, int if kind == "integer" else int | float)
    return number and not isinstance(value, bool) and abs(value) <= sys.float_info.max  # no NaN


def _mismatch(value: Any, schema: Schema) -> str:
    """Say what is expected instead of a value, its items aside; "" if it is right."""
    kinds = schema.get("type", ())
    kinds = (kinds,) if isinstance(kinds, str) else kinds
    if kinds and not any(_is(value, kind) for kind in kinds):
        return " or ".join(kinds)
    words = schema.get("enum", [schema["const"]] if "const" in schema else None)
    if words is not None and not any(type(value) is type(w) and value == w for w in words):
        return "one of " + ", ".join(map(str, words))
    if isinstance(value, list):
        few, many = schema.get("minItems", 0), schema.get("maxItems", sys.maxsize)
        if not few <= len(value) <= many:
            return f"{few} of them" if few == many else f"{few} to {many} of them"
    if isinstance(value, dict) and len(value) > (most := schema.get("maxProperties", sys.maxsize)):
        return f"at most {most} of them"
    if _is(value, "number") and not all(
        fits(value, schema[key]) for key, (_, fits) in BOUNDS.items() if key in schema
    ):
        return " and ".join(f"{word} {schema[k]}" for k, (word, _) in BOUNDS.items() if k in schema)
    return ""


BOUNDS = {
    "minimum": ("at least", operator.ge),
    "exclusiveMinimum": ("more than", operator.gt),
    "maximum": ("at most", operator.le),
}


def _shown(value: Any) -> str:
    """Write a value for a message, however large it is."""
    if isinstance(value, list | dict):
        return f"{'a list' if isinstance(value, list) else 'an object'} of {len(value)}"
    return repr(value[:TEXT_SHOWN] if isinstance(value, str) else value)


def objects_schema() -> Any:
    """Read the schema of objects.json."""
    path = Path(__file__).with_name("results") / "objects.schema.json"
    return json.loads(path.read_text())


def validate_objects(path: Path) -> list[str]:
    """Check an objects.json, or that of a folder, against its schema.

    Returns:
        one line for each fault.
    """
    path = path / "objects.json" if path.is_dir() else path
    return sorted(f"{path}: {fault}" for fault in faults(load_json(path), objects_schema()))
