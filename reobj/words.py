"""Words of users and detectors: class names that mean the same, usual and known sizes of classes.

The synonyms are those of the bundled priors.json, one table for all uses; case, "_" and "-" do not
count.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

import quadrics
from reobj.files import did_you_mean, shortened
from reobj.types import NOTE_START, Array, BoolArray, ReobjError

# ---- Class names ----


@functools.cache
def _table() -> quadrics.Priors:
    return quadrics.load_priors()


@functools.lru_cache(4096)
def canonical(name: str) -> str:
    """Return the one name of all class names that mean the same, in lower case.

    >>> canonical("Sofa"), canonical("mobile_phone"), canonical("Espresso-Machine")
    ('couch', 'cell phone', 'espresso machine')
    """
    return _table().canonical([name])[0]


def meant(word: str, names: Sequence[str]) -> list[int]:
    """List the rows of the class names that a word means: of that name, else of its synonyms.

    >>> meant("sofa", ["chair", "couch"]), meant("sofa", ["couch", "sofa"])
    ([1], [1])
    """
    return _table().meant(word, names)


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


# ---- Lengths and directions ----

PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "ft": 1 / 0.3048, "in": 1 / 0.0254}
LENGTHS_M = (0.001, 1000.0)  # m, of the objects of a room or a street
NUMBER = r"\s*([0-9]*\.?[0-9]+|[0-9]+\.)\s*"
UNIT = f"({'|'.join(PER_METRE)})"
LIMITS = f"in {', '.join(PER_METRE)}, {LENGTHS_M[0]:g} to {LENGTHS_M[1]:g} m"


def _lengths_m(form: str, text: str) -> tuple[float, ...]:
    """Parse lengths and their unit, the groups of a regular expression; () if they are invalid."""
    found = re.fullmatch(form, text)
    *values, unit = found.groups() if found else ("m",)
    lengths = tuple(float(value) / PER_METRE[unit] for value in values)
    return lengths if all(LENGTHS_M[0] <= x <= LENGTHS_M[1] for x in lengths) else ()


def parse_up(text: str) -> Array:
    """Parse a direction x,y,z into a unit vector (3,)."""
    try:
        up = np.array([float(x) for x in text.split(",")])
    except ValueError:
        up = np.empty(0)
    if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
        raise ReobjError(f"--set objects.up={text}: expected a direction x,y,z, such as 0,0,1")
    up /= np.abs(up).max()  # the squares of 1e300 overflow
    return np.asarray(up / np.linalg.norm(up))


# ---- Usual sizes: --priors, --prior ----

USUAL_LOG_STD = 0.25  # of each side of a size that the user gives: median of the bundled priors


def load_size_priors(path: str, given: str = "") -> quadrics.Priors:
    """Load size priors with the bundled synonyms, and those that the user gives by word.

    Args:
        path: JSON, "": the bundled priors. given: as of `parse_priors`.
    Raises:
        ReobjError, QuadricsError: an unreadable file, or an invalid word, size or category.
    """
    plain = quadrics.load_priors(path or None)
    plain = dataclasses.replace(plain, aliases=_with_synonyms(plain))
    entries = dict[str, dict[str, Any] | str]()
    for word, prior in parse_priors(given).items():
        name = _category(plain, word) or canonical(word)
        if name in entries:
            raise ReobjError(f"--prior {word}: means the same as another --prior, {name}")
        entries[name] = _like(plain, word, prior) if isinstance(prior, str) else _entry(prior)
    if not entries:
        return plain
    return dataclasses.replace(quadrics.load_priors(path or None, entries), aliases=plain.aliases)


def _category(priors: quadrics.Priors, word: str) -> str:
    """Return the category of priors that a word means; "": none."""
    row = priors.index([word])[0]
    return priors.names[row] if row >= 0 else ""


def _like(priors: quadrics.Priors, word: str, category: str) -> str:
    """Return the category that a word is like, as the priors name it."""
    like = _category(priors, category)
    if not like:
        close = did_you_mean(category, priors.names) or ", expected a size, such as .35x.30x.40m"
        raise ReobjError(f"--prior {word}={category}: no size prior of {category}{close}")
    return like


def _entry(size_m: tuple[float, ...]) -> dict[str, Any]:
    """Return an entry of priors.json for a size (3,) in metres; model selection finds its shape."""
    spread = {"log_std": [USUAL_LOG_STD] * 3, "corr": [0.3] * 3}
    return {"size_m": {"mean": list(size_m), **spread}, "support": "auto"}


def _with_synonyms(priors: quadrics.Priors) -> dict[str, str]:
    """Return the synonyms of priors and the bundled ones, which lead to a category of the priors.

    A file of the user may name its category "sofa": "couch" leads there.
    """
    named = {" ".join(re.split(r"[\s_-]+", name.lower())) for name in priors.names}
    led = {canonical(name): name for name in priors.names if canonical(name) not in named}
    bundled = _table().aliases.items()
    kept = {word: name for word, name in bundled if word != led.get(canonical(word))}
    return kept | led | dict(priors.aliases)


def parse_priors(text: str) -> dict[str, tuple[float, ...] | str]:
    """Parse sizes (width, depth, height in metres) of words, or the category that a word is like.

    >>> parse_priors("espresso machine=.35x.30x.40m; red toolbox=suitcase")
    {'espresso machine': (0.35, 0.3, 0.4), 'red toolbox': 'suitcase'}
    """
    found: dict[str, tuple[float, ...] | str] = {}
    for item in filter(None, (entry.strip() for entry in re.split("[,;]", text))):
        word, _, value = (part.strip() for part in item.partition("="))
        sides = _lengths_m(f"{NUMBER}x{NUMBER}x{NUMBER}{UNIT}", value)
        if not word or word in found or not (sides or value[:1].isalpha()):
            expected = f"once for each word WORD=WIDTHxDEPTHxHEIGHT {LIMITS}, or WORD=CATEGORY"
            raise ReobjError(f"--prior {item!r}: expected {expected}, such as mixer=.2x.3x.4m")
        found[word] = sides or value
    return found


def priors_used(path: str, given: str, names: Sequence[str]) -> list[str]:
    """Describe the priors of words that the file of priors does not have, and unused ones.

    Args:
        path, given: as of `load_size_priors`. names: of the classes of the objects.
    """
    of_words = parse_priors(given)
    priors = load_size_priors(path, given)
    word_of = dict(zip(priors.index(list(of_words)).tolist(), of_words, strict=True))
    texts = []
    unused = dict.fromkeys(of_words)
    for name in dict.fromkeys(names):
        row = int(priors.index([name])[0])
        if word := word_of.get(row):
            unused.pop(word, None)
            prior = of_words[word]
            size = (
                f"of {prior}" if isinstance(prior, str) else "{:g} x {:g} x {:g} m".format(*prior)
            )
            texts.append(f"{name}: size prior {size} (--prior)")
        elif row < 0 and name != "object":
            texts.append(f"{name}: no size prior")
    shown = [NOTE_START + "; ".join(texts)] if texts else []
    return shown + [f"--prior {word}: no object of this class has a shape" for word in unused]


# ---- Known sizes: --known-size ----


def parse_known_size(text: str) -> dict[str | int, tuple[str, float]]:
    """Parse 'chair=0.82m,door=2.0m' into heights in metres by category.

    >>> parse_known_size("door=2.0m, chair=82cm")
    {'door': ('h', 2.0), 'chair': ('h', 0.82)}
    """
    sizes: dict[str | int, tuple[str, float]] = {}
    for item in filter(None, (entry.strip() for entry in text.split(","))):
        category, _, value = (part.strip() for part in item.rpartition("="))
        height_m = _lengths_m(NUMBER + UNIT, value)
        if not category or not height_m:
            expected = f"CATEGORY=HEIGHT {LIMITS}, such as door=2.0m"
            raise ReobjError(f"--known-size {item!r}: expected {expected}")
        sizes[category] = ("h", height_m[0])
    return sizes


def check_known_size(text: str, priors: quadrics.Priors, class_names: Sequence[str]) -> None:
    """Raise ReobjError for a known size of a category that the detector does not have."""
    for name in map(str, parse_known_size(text)):
        if class_names and not priors.meant(name, class_names):
            close = did_you_mean(name, class_names) or f"; there are {shortened(class_names)}"
            raise ReobjError(f"--known-size {name}: no such class{close}")


def unused_sizes(text: str, priors: quadrics.Priors, located: Sequence[str]) -> list[str]:
    """Return warnings of known sizes that set no scale: no object of their category has a shape.

    Args:
        located: class names of the objects that have a shape.
    """
    return [
        f"--known-size {name}: no {name} was located, so this sets no scale"
        for name in map(str, parse_known_size(text))
        if not priors.meant(name, located)
    ]
