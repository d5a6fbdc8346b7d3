"""Options: fields of the config dataclasses; set by flags, --set section.field=value and TOML."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import json
import math
import re
import textwrap
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import quadrics
from reobj.files import atomic, did_you_mean, load_json, read_text, shortened
from reobj.types import NOTE_START, Array, ReobjError
from reobj.words import canonical, synonyms

C = TypeVar("C")


def every_option(config: Any) -> dict[str, dataclasses.Field[Any]]:
    """List the options of a config by their name for --set: `section.field`, or `field`."""
    options: dict[str, dataclasses.Field[Any]] = {}
    for f in dataclasses.fields(config):
        section = getattr(config, f.name)
        if dataclasses.is_dataclass(section):
            options |= {f"{f.name}.{g.name}": g for g in dataclasses.fields(section)}
        else:
            options[f.name] = f
    return options


def value_of(config: Any, name: str) -> Any:
    """Return the value of an option by its name for --set."""
    section, _, field_name = name.rpartition(".")
    return getattr(getattr(config, section) if section else config, field_name)


def with_option(config: C, name: str, value: Any, where: str = "--set ") -> C:
    """Return the config with one option changed; a string is converted to the option's type.

    For an option of type str, a list of strings is joined by commas, a dict as key=value.

    Args:
        where: source of the option; begins the message of an error.
    Raises:
        ReobjError: no such option, or a value of another type.
    """
    options: Any = every_option(config)
    if name not in options:
        similar = _most_similar(name, options)
        raise ReobjError(f"{where}{name}: no such option; did you mean {similar}?")
    kind = type(options[name].default)
    in_range = ""
    try:
        if isinstance(value, str) and kind is bool:
            value = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False,
                     "no": False, "off": False, "none": False}[value.lower()]  # fmt: skip
        elif isinstance(value, (bool, float)) and kind is int:
            raise TypeError
        value = _text(value) if kind is str else kind(value)
        if kind in (int, float) and not 0 <= value < (2**31 if kind is int else math.inf):
            in_range = ", finite, 0 or more"
            raise ValueError
    except (KeyError, OverflowError, TypeError, ValueError):
        expected = kind.__name__.upper() + in_range
        raise ReobjError(f"{where}{name}: expected ={expected}, found {value!r}") from None
    section, _, field_name = name.rpartition(".")
    if section:
        field_name, value = (
            section,
            dataclasses.replace(getattr(config, section), **{field_name: value}),
        )
    changed: Any = dataclasses.replace(config, **{field_name: value})  # type: ignore[type-var]
    return changed  # type: ignore[no-any-return]


def _text(value: Any) -> str:
    """Convert the value of an option of type str: a string, path, number, list or dict of them."""
    if isinstance(value, Mapping):
        value = [f"{key}={_text(item)}" for key, item in value.items()]
    if isinstance(value, list | tuple):
        return ",".join(map(_text, value))
    if not isinstance(value, str | Path | float | int):
        raise TypeError
    return str(value)


def _most_similar(name: str, options: Iterable[str]) -> str:
    """Find the option most similar to a wrong name: as a whole, by its field or a word of it."""
    name = name[:100]  # longer than our names; the comparison takes quadratic time

    def similarity(option: str) -> float:
        field_name = option.rpartition(".")[2]
        words = (option, field_name, *field_name.split("_"))
        return max(difflib.SequenceMatcher(None, name, word).ratio() for word in words)

    return max(options, key=similarity)


# ---- Dicts and files of options ----


def as_config(config: C, options: C | Mapping[str, Any] | None) -> C:
    """Return a config, or the default one with the options of a dict.

    Args:
        config: the default, for None and for options that the dict does not have.
        options: a config of the same type; or a dict of options by section,
            {"detect": {"classes": "chair"}}, or by name, {"detect.classes": "chair"}.
    Raises:
        ReobjError: another type, no such option, or a value of another type.
    """
    if options is None:
        return config
    if isinstance(options, Mapping):
        for name, value in _settings(options).items():
            config = with_option(config, name, value, "config: ")
        return config
    if not isinstance(options, type(config)):
        expected = f"expected {type(config).__name__} or a dict of options"
        raise ReobjError(f"config is of type {type(options).__name__}, {expected}")
    return options


def _settings(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a table of sections by the names of the options for --set."""
    settings: dict[str, Any] = {}
    for key, value in table.items():
        inner = isinstance(value, Mapping)
        settings |= {f"{key}.{k}": v for k, v in value.items()} if inner else {str(key): value}
    return settings


def read_config(config: C, path: str | Path) -> C:
    """Apply a TOML file of options, by section; its paths are relative to the working folder.

    Raises:
        ReobjError: invalid TOML, no such option, or a value of another type.
    """
    path = Path(path)
    try:
        # At most a thousand times the length of all options
        table = tomllib.loads(read_text(path, 1 << 20, "surrogateescape"))
    except (ValueError, RecursionError) as error:  # also a number of 5,000 digits
        raise ReobjError(f"{path}: not valid TOML ({error})") from None
    for name, value in _settings(table).items():
        value = _with_bytes(value) if isinstance(value, str) else value
        config = with_option(config, name, value, f"{path}: ")
    return config


def changed_options(config: Any) -> dict[str, Any]:
    """Return the options that differ from the defaults, by their name for --set."""
    default = type(config)()
    values = {name: value_of(config, name) for name in every_option(config)}
    return {name: value for name, value in values.items() if value != value_of(default, name)}


def write_config(config: Any, path: str | Path) -> None:
    """Write the options that differ from the defaults as TOML, for `read_config`.

    Written by hand: Python has no TOML writer, and flat sections of plain values need no package.
    """
    lines = []
    sections = ""
    changed = changed_options(config)
    for name in sorted(changed, key=lambda name: "." in name):  # options without a section first
        section, _, field_name = name.rpartition(".")
        lines += [f"\n[{section}]"] if section != sections else []
        lines.append(f"{field_name} = {_toml(changed[name])}")
        sections = section
    head = "# Options of reobj_track that differ from the defaults; --options lists all.\n"
    with atomic(Path(path)) as part:
        part.write_text(head + "\n".join(lines) + "\n" * bool(lines), encoding="utf-8")


def _toml(value: str | float) -> str:
    """Format a value: strings as in JSON, with DEL escaped too; numbers as in Python.

    Bytes of paths that are not UTF-8 are written as \\udc80 to \\udcff, Python's surrogate escapes.
    """
    if isinstance(value, str):
        value = re.sub("[\udc80-\udcff]", lambda byte: f"\\udc{ord(byte[0]) & 255:02x}", value)
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower()


def _with_bytes(text: str) -> str:
    """Convert the escaped bytes of `_toml` back."""
    return re.sub(r"\\udc([89a-f][0-9a-f])", lambda byte: chr(0xDC00 + int(byte[1], 16)), text)


# ---- Flags ----


def add_flags(parser: argparse.ArgumentParser, config: Any, sections: Iterable[str]) -> None:
    """Add the flags of the options in the given sections ("": top level) to a parser."""
    chosen = set(sections)
    for name, f in every_option(config).items():
        section = name.rpartition(".")[0]
        flag = f.metadata["flag"]
        if flag and section in chosen:
            kind: Any = type(f.default)
            settings: dict[str, Any] = {"type": kind, "metavar": kind.__name__.upper()}
            if kind is bool:
                settings = {"action": "store_true"}
            elif f.metadata["repeated"]:
                settings["action"] = "append"
            default = f" (default: {f.default})" if f.default else ""
            text = f"{f.metadata['help']}{default}".replace("%", "%%")
            flags = filter(None, (flag, f.metadata["old_flag"]))
            parser.add_argument(*flags, dest=name, default=None, help=text, **settings)


def config_from_args(config: C, args: argparse.Namespace) -> C:
    """Apply --config FILE, then the flags, then every --set section.field=value.

    The result is written to --save-config FILE, if given.
    """
    options: Any = every_option(config)
    if args.config:
        config = read_config(config, args.config)
    for name, value in vars(args).items():
        if name in options and value is not None:
            config = with_option(config, name, value)
    for item in args.set or []:
        name, equals, text = item.partition("=")
        config = with_option(config, name, text if equals else None)
    if args.save_config:
        write_config(config, args.save_config)
    return config


def list_options(config: Any, width: int = 120, name_width: int = 32) -> str:
    """Return the list of all options, one a line: name, default and meaning.

    Args:
        width, name_width: columns of the list, and of the names in it.
    """
    lines = []
    for name, f in every_option(config).items():
        default = str(f.default) if len(str(f.default)) <= 12 else f"{str(f.default)[:9]}..."
        text = textwrap.wrap(f.metadata["help"], width - name_width - 1)
        lines.append(f"{f'{name}={default}':<{name_width}} {text[0]}")
        lines += [" " * (name_width + 1) + more for more in text[1:]]
    return "\n".join(lines)


# ---- Values of the object stage ----


PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "ft": 1 / 0.3048, "in": 1 / 0.0254}
LENGTHS_M = (0.001, 1000.0)  # m, of the objects of a room or a street
PRIORS_SHOWN = 8  # words in a message
USUAL_LOG_STD = 0.25  # of each side of a size that the user gives: median of the bundled priors


def load_size_priors(path: str, given: str = "") -> quadrics.Priors:
    """Load size priors with the bundled synonyms, and those that the user gives by word.

    Args:
        path: JSON, "": the bundled priors. given: as of `parse_priors`.
    Raises:
        ReobjError, QuadricsError: no JSON, too large, or no priors; an invalid word, size or
            category.
    """
    if path:
        load_json(Path(path))  # checks the size of the file
    plain = quadrics.load_priors(path or None)
    plain = dataclasses.replace(plain, aliases=_with_synonyms(plain))
    entries = dict[str, dict[str, Any] | str]()
    word_of = dict[str, str]()
    for word, prior in parse_priors(given).items():
        name = _category(plain, word) or canonical(word)
        if name in entries:
            same = f"means the same as {word_of[name]}, give one of them"
            raise ReobjError(f"--prior {word}: {same}")
        word_of[name] = word
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
    kept = {word: name for word, name in synonyms().items() if word != led.get(canonical(word))}
    return kept | led | dict(priors.aliases)


def parse_priors(text: str) -> dict[str, tuple[float, ...] | str]:
    """Parse sizes (width, depth, height in metres) of words, or the category that a word is like.

    >>> parse_priors("espresso machine=.35x.30x.40m; red toolbox=suitcase")
    {'espresso machine': (0.35, 0.3, 0.4), 'red toolbox': 'suitcase'}
    """
    found: dict[str, tuple[float, ...] | str] = {}
    number = r"\s*([0-9]*\.?[0-9]+|[0-9]+\.)\s*"
    for item in filter(None, (entry.strip() for entry in re.split("[,;]", text))):
        word, _, value = (part.strip() for part in item.partition("="))
        size = re.fullmatch(rf"{number}x{number}x{number}({'|'.join(PER_METRE)})", value)
        sides = tuple(float(size[k]) / PER_METRE[size[4]] for k in (1, 2, 3)) if size else ()
        in_range = all(LENGTHS_M[0] <= side <= LENGTHS_M[1] for side in sides)
        if not word or not (size or value[:1].isalpha()) or not in_range:
            raise _no_prior(item)
        if word in found:
            raise ReobjError(f"--prior {word}: is given twice")
        found[word] = sides or value
    return found


def _no_prior(item: str) -> ReobjError:
    units = ", ".join(PER_METRE)
    expected = f"WORD=WIDTHxDEPTHxHEIGHT in {units}, or WORD=CATEGORY, such as mixer=.2x.3x.4m"
    limits = "each from {:g} to {:g} m".format(*LENGTHS_M)
    return ReobjError(f"--prior {item!r}: expected {expected}; {limits}")


def priors_used(path: str, given: str, names: Sequence[str]) -> list[str]:
    """Describe the priors of words that the file of priors does not have, and unused ones.

    Args:
        path, given: as of `load_size_priors`. names: of the classes of the objects.
    """
    of_words = parse_priors(given)
    plain = load_size_priors(path)
    priors = load_size_priors(path, given)
    word_of = dict(zip(priors.index(list(of_words)).tolist(), of_words, strict=True))
    texts = []
    used = set[str]()
    for name in dict.fromkeys(names):
        word = word_of.get(int(priors.index([name])[0]))
        if word is not None:
            used.add(word)
            texts.append(f"{name}: size prior {_prior_text(of_words[word])} (--prior)")
        elif not _category(plain, name) and name != "object":
            texts.append(f"{name}: no size prior")
    unused = [f"--prior {word}: no object of this class has a shape" for word in of_words
              if word not in used]  # fmt: skip
    more = f"; and {len(texts) - PRIORS_SHOWN} more" * (len(texts) > PRIORS_SHOWN)
    shown = NOTE_START + "; ".join(texts[:PRIORS_SHOWN]) + more
    return [shown, *unused] if texts else unused


def _prior_text(prior: tuple[float, ...] | str) -> str:
    if isinstance(prior, str):
        return f"of {prior}"
    return " x ".join(f"{side:.3g}".removeprefix("0") for side in prior) + " m"


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


def check_shape(name: str) -> None:
    """Raise ReobjError for a kind of shape that the fit does not have."""
    if name not in (kinds := ("auto", *quadrics.SUPPORTS)):
        raise ReobjError(f"--shape {name}: expected one of {', '.join(kinds)}")


def parse_known_size(text: str) -> dict[str | int, tuple[str | int, float]]:
    """Parse 'chair=0.82m,door=2.0m' into heights in metres by category.

    >>> parse_known_size("door=2.0m, chair=82cm")
    {'door': ('h', 2.0), 'chair': ('h', 0.82)}
    """
    sizes: dict[str | int, tuple[str | int, float]] = {}
    value = rf"([0-9]*\.?[0-9]+|[0-9]+\.)\s*({'|'.join(PER_METRE)})"
    for item in filter(None, (entry.strip() for entry in text.split(","))):
        found = re.fullmatch(rf"(.+?)\s*=\s*{value}", item)
        height_m = float(found[2]) / PER_METRE[found[3]] if found else 0.0
        if found is None or not LENGTHS_M[0] <= height_m <= LENGTHS_M[1]:
            expected = f"CATEGORY=HEIGHT in {', '.join(PER_METRE)}, from "
            expected += "{:g} to {:g} m, such as door=2.0m".format(*LENGTHS_M)
            raise ReobjError(f"--known-size {item!r}: expected {expected}")
        sizes[found[1]] = ("h", height_m)
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
