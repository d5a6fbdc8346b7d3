"""Schemas: faults of JSON values, found where jsonschema finds them."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

import reobj_track as rt
from reobj import schema as room
from reobj.schema import faults, objects_schema, validate_objects

SCHEMA = {
    "type": "object",
    "required": ["a"],
    "properties": {
        "a": {"$ref": "#/$defs/pair"},
        "b": {"type": ["number", "null"], "minimum": 0, "maximum": 1},
        "c": {"enum": ["x", 1, None]},
        "d": {"const": 2},
        "e": {"type": "object", "maxProperties": 1, "additionalProperties": {"type": "integer"}},
        "f": {"type": "number", "exclusiveMinimum": 0},
        "g": {"type": ["boolean", "string"]},
    },
    "allOf": [
        {
            "if": {"required": ["d"], "properties": {"d": {"const": 2}}},
            "then": {"properties": {"b": {"type": "number"}}},
        }
    ],
    "$defs": {
        "pair": {"type": "array", "items": {"type": "integer"}, "minItems": 1, "maxItems": 2}
    },
}


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ({"a": [1], "b": 0.5, "c": None, "d": 2, "e": {"k": 1}, "f": 1e-9, "g": True}, ""),
        ({"a": [1, 2], "b": 1, "c": "x", "g": "word", "more": [{}]}, ""),  # others are not asked
        ([], "$: a list of 0, expected object"),
        ({}, "$: no 'a'"),
        ({"a": []}, "$.a: a list of 0, expected 1 to 2 of them"),
        ({"a": [1, 2, 3]}, "$.a: a list of 3, expected 1 to 2 of them"),
        ({"a": [1, "x"]}, "$.a[1]: 'x', expected integer"),
        ({"a": [True]}, "$.a[0]: True, expected integer"),  # which Python thinks
        ({"a": [1.0]}, "$.a[0]: 1.0, expected integer"),
        ({"a": [1], "b": -1}, "$.b: -1, expected at least 0 and at most 1"),
        ({"a": [1], "b": float("nan")}, "$.b: nan, expected number or null"),
        ({"a": [1], "b": 10**400}, f"$.b: 1{'0' * 400}, expected number or null"),
        ({"a": [1], "c": True}, "$.c: True, expected one of x, 1, None"),
        ({"a": [1], "d": 3}, "$.d: 3, expected one of 2"),
        ({"a": [1], "e": {"k": 1, "l": 2}}, "$.e: an object of 2, expected at most 1 of them"),
        ({"a": [1], "e": {"k" * 99: ""}}, f"$.e.{'k' * 40}: '', expected integer"),
        ({"a": [1], "f": 0}, "$.f: 0, expected more than 0"),
        ({"a": [1], "g": 5}, "$.g: 5, expected boolean or string"),
        ({"a": [1], "b": None, "d": 2}, "$.b: None, expected number"),
        ({"a": "y" * 99}, f"$.a: {'y' * 60!r}, expected array"),
    ],
)
def test_faults_are_named(value: Any, fault: str) -> None:
    assert list(faults(value, SCHEMA)) == [fault] * bool(fault)


def test_all_faults_are_found() -> None:
    assert len(list(faults({"a": ["x", 1, None], "b": 2, "f": -1}, SCHEMA))) == 3


def words_of(schema: Any) -> set[str]:
    """Keywords of a schema and of those in it."""
    own = set(schema)
    for key in ("properties", "$defs"):
        for inner in schema.get(key, {}).values():
            own |= words_of(inner)
    for inner in [
        schema[k] for k in ("items", "additionalProperties", "if", "then") if k in schema
    ]:
        own |= words_of(inner)
    return own.union(*(words_of(inner) for inner in schema.get("allOf", ())))


def test_every_word_of_our_schema_is_understood() -> None:
    assert words_of(objects_schema()) <= room.KEYWORDS | room.NO_CHECKS


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The objects.json of a fit of three chairs."""
    from simulated import fitted, tracks_of, walk

    out = tmp_path_factory.mktemp("schema")
    poses = walk(40)
    fitted(tracks_of(poses), poses).save(out)
    data = json.loads((out / "objects.json").read_text())
    data["objects"][2]["cov"] = None
    return data


NASTY = [None, "x", -1, 1.5, True, [], {"a": 1}, [1, 2, 3], [[]]]


def test_faults_are_those_that_jsonschema_finds(example: Any) -> None:
    """Every place of an objects.json, with every nasty value: the same places are at fault."""
    jsonschema = pytest.importorskip("jsonschema", reason="pip install jsonschema (dev extra)")
    schema = objects_schema()
    validator = jsonschema.Draft202012Validator(schema)
    assert validator.is_valid(example) and not list(faults(example, schema))
    for path in list(places(example)):
        for value in [*NASTY, "gone"]:
            data = changed(example, path, value)
            theirs = {fault.json_path for fault in validator.iter_errors(data)}
            ours = {fault.split(": ")[0] for fault in faults(data, schema)}
            assert bool(ours) == bool(theirs), (path, value)
            assert all(place.startswith(tuple(theirs)) for place in ours), (path, value)
            top = {a for a in theirs if not any(a != b and a.startswith(b) for b in theirs)}
            assert top <= ours, (path, value)  # we do not look into what is wrong itself


def places(data: Any, path: tuple[Any, ...] = ()) -> Any:
    """Paths of all values in a JSON value; of lists the first item."""
    yield path
    items = data.items() if isinstance(data, dict) else enumerate(data[:1])
    for key, value in items if isinstance(data, dict | list) else ():
        yield from places(value, (*path, key)) if isinstance(value, dict | list) else [(*path, key)]


def changed(data: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value, or without it ("gone"), at a path."""
    if not path:
        return value
    data = copy.copy(data)
    if len(path) > 1:
        data[path[0]] = changed(data[path[0]], path[1:], value)
    elif value == "gone":
        del data[path[0]]
    else:
        data[path[0]] = value
    return data


def test_validate_names_the_file_in_every_line(example: Any, tmp_path: Path) -> None:
    bad = changed(changed(example, ("objects", 0, "id"), "one"), ("objects", 1, "views"), -1)
    (tmp_path / "objects.json").write_text(json.dumps(bad))
    for path in (tmp_path, tmp_path / "objects.json"):
        first, second = validate_objects(path)
        assert first.startswith(f"{tmp_path / 'objects.json'}: $.objects[0].id: 'one', expected")
        assert "$.objects[1].views: -1, expected at least 0" in second
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(rt.ReobjError, match="not valid JSON"):
        validate_objects(tmp_path / "x.json")
