"""The state of an object as arrays for a file, and back."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any


def saved_fields(owner: Any) -> Sequence[str]:
    """Return the names of the attributes that are the state of a dataclass or of another class."""
    if dataclasses.is_dataclass(owner):
        return [one.name for one in dataclasses.fields(owner)]
    return getattr(owner, "ARRAYS", ())


def state_arrays(value: Any, name: str) -> dict[str, Any]:
    """Flatten a state to arrays by dotted names; None is left out."""
    if value is None:
        return {}
    if isinstance(value, list):
        items = {f"{name}.{k}": item for k, item in enumerate(value)}
    else:
        items = {f"{name}.{key}": getattr(value, key) for key in saved_fields(value)}
    if not items:
        return {name: value}
    return {key: x for path, item in items.items() for key, x in state_arrays(item, path).items()}


def restore_state(value: Any, name: str, arrays: dict[str, Any]) -> Any:
    """Fill a fresh state from `state_arrays`; returns it, or the array that takes its place.

    Raises:
        KeyError: an array is missing.
    """
    if isinstance(value, list):
        prefix = re.compile(re.escape(name) + r"\.(\d+)\.")
        count = len({found[1] for key in arrays if (found := prefix.match(key))})
        return [restore_state(type(value[0])(), f"{name}.{k}", arrays) for k in range(count)]
    if keys := saved_fields(value):
        for key in keys:
            setattr(value, key, restore_state(getattr(value, key), f"{name}.{key}", arrays))
        return value
    if value is None:
        return arrays.get(name)
    return int(arrays[name]) if isinstance(value, int) else arrays[name]
