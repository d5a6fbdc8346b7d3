"""Class names that mean the same: the synonyms of the bundled priors.json, one table for all uses.

Case, "_" and "-" do not count.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

import quadrics
from reobj.types import BoolArray


@functools.cache
def _table() -> quadrics.Priors:
    return quadrics.load_priors()


@functools.lru_cache(4096)
def canonical(name: str) -> str:
    """Return the one name of all class names that mean the same, in lower case.

    >>> canonical("Sofa"), canonical("mobile_phone"), canonical("Espresso-Machine")
    ('couch', 'cell phone', 'espresso machine')
    """
    return _table().canonical([typed(name)])[0]


def meant(word: str, names: Sequence[str]) -> list[int]:
    """List the rows of the class names that a word means: of that name, else of its synonyms.

    >>> meant("sofa", ["chair", "couch"]), meant("sofa", ["couch", "sofa"])
    ([1], [1])
    """
    return _table().meant(typed(word), names)


def typed(word: str) -> str:
    """Decode a word of the command line in a locale without UTF-8 (LC_ALL=C)."""
    try:
        return word.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    except UnicodeEncodeError:  # other surrogates, as in JSON
        return word.encode("utf-8", "replace").decode()


def among(names: Iterable[str], words: Iterable[str]) -> BoolArray:
    """Mark the class names (C,) that mean the same as one of the words."""
    wanted = {canonical(word) for word in words}
    return np.array([canonical(name) in wanted for name in names], bool)


def merged(weights: Mapping[str, float]) -> dict[str, float]:
    """Add the weights of class names that mean the same, by their canonical name."""
    sums: dict[str, float] = {}
    for name, weight in weights.items():
        sums[canonical(name)] = sums.get(canonical(name), 0.0) + weight
    return sums


def synonyms() -> dict[str, str]:
    """Return the category of each synonym."""
    return dict(_table().aliases)
