"""Options: fields of config dataclasses, set by flags, --set section.field=value, TOML files."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import json
import math
import re
import textwrap
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from reobj.files import WORD_MAX, atomic, read_text
from reobj.types import ReobjError

C = TypeVar("C")


def every_option(config: Any) -> dict[str, dataclasses.Field[Any]]:
    """List the options of a config by their name for --set: `section.field`, or `field`."""
    options: dict[str, dataclasses.Field[Any]] = {}
    for f in dataclasses.fields(config):
        own = getattr(config, f.name)
        if dataclasses.is_dataclass(own):
            options |= {f"{f.name}.{g.name}": g for g in dataclasses.fields(own)}
        else:
            options[f.name] = f
    return options


def value_of(config: Any, name: str) -> Any:
    """Return the value of an option by its name for --set."""
    section, _, field_name = name.rpartition(".")
    return getattr(getattr(config, section) if section else config, field_name)


def with_option(config: C, name: str, value: Any, where: str = "--set ") -> C:
    """Return the config with one option changed; a text is converted to the option's type.

    Args:
        where: begins the message of an error.
    Raises:
        ReobjError: no such option, or the value is none of its type.
    """
    options: Any = every_option(config)
    if name not in options:
        raise ReobjError(f"{where}{name}: no such option; did you mean {_likest(name, options)}?")
    kind = type(options[name].default)
    in_range = ""
    try:
        if isinstance(value, str) and kind is bool:
            value = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False,
                     "no": False, "off": False}[value.lower()]  # fmt: skip
        elif isinstance(value, (bool, float)) and kind is int:
            raise TypeError
        value = kind(value)
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


def _likest(name: str, options: Iterable[str]) -> str:
    """Name the option most like a wrong one: as a whole, or its field, or a word of its field."""
    name = name[:WORD_MAX]

    def likeness(option: str) -> float:
        field_name = option.rpartition(".")[2]
        words = (option, field_name, *field_name.split("_"))
        return max(difflib.SequenceMatcher(None, name, word).ratio() for word in words)

    return max(options, key=likeness)


# ---- Files of options ----


CONFIG_MAX = 1 << 20  # characters; chosen: a thousand times what all options take


def read_config(config: C, path: str | Path) -> C:
    """Apply a TOML file of options, by section; paths in it are those of the working folder.

    Raises:
        ReobjError: no TOML, no such option, or a value that is none of its type.
    """
    path = Path(path)
    try:
        table = tomllib.loads(read_text(path, CONFIG_MAX, "surrogateescape"))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ReobjError(f"{path}: not valid TOML ({error})") from None
    for key, value in table.items():
        inner = {f"{key}.{k}": v for k, v in value.items()} if isinstance(value, dict) else None
        for name, own in (inner if inner is not None else {key: value}).items():
            own = _with_bytes(own) if isinstance(own, str) else own
            config = with_option(config, name, own, f"{path}: ")
    return config


def write_config(config: Any, path: str | Path) -> None:
    """Write the options that differ from the defaults as TOML, for `read_config`.

    By hand: a table of plain values in flat sections needs no package, and Python has no writer.
    """
    default = type(config)()
    lines = []
    sections = ""
    changed = {
        name: value
        for name in every_option(config)
        if (value := value_of(config, name)) != value_of(default, name)
    }
    for name in sorted(changed, key=lambda name: "." in name):  # those of no section come first
        section, _, field_name = name.rpartition(".")
        lines += [f"\n[{section}]"] if section != sections else []
        lines.append(f"{field_name} = {_toml(changed[name])}")
        sections = section
    head = "# Options of reobj_track that differ from the defaults; --options lists all.\n"
    with atomic(Path(path)) as part:
        part.write_text(head + "\n".join(lines) + "\n" * bool(lines), encoding="utf-8")


def _toml(value: str | float) -> str:
    """Write a value: a text as JSON has it, but DEL escaped too; numbers as Python has them.

    Paths are bytes: one that is no UTF-8 stands as \\udc80 to \\udcff, as Python names it.
    """
    if isinstance(value, str):
        value = re.sub("[\udc80-\udcff]", lambda byte: f"\\udc{ord(byte[0]) & 255:02x}", value)
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower()


def _with_bytes(text: str) -> str:
    """Put the bytes that `_toml` names back into a text."""
    return re.sub(r"\\udc([89a-f][0-9a-f])", lambda byte: chr(0xDC00 + int(byte[1], 16)), text)


# ---- Flags ----


def add_flags(parser: argparse.ArgumentParser, config: Any, sections: Iterable[str]) -> None:
    """Add the flags that the options of some sections declare ("" for those of the top level)."""
    chosen = set(sections)
    for name, f in every_option(config).items():
        section = name.rpartition(".")[0]
        flag = f.metadata["flag"]
        if flag and section in chosen:
            kind: Any = type(f.default)
            how: dict[str, Any] = {"type": kind, "metavar": kind.__name__.upper()}
            if kind is bool:
                how = {"action": "store_true"}
            default = f" (default: {f.default})" if f.default else ""
            text = f"{f.metadata['help']}{default}".replace("%", "%%")
            parser.add_argument(flag, dest=name, default=None, help=text, **how)


def config_from_args(config: C, args: argparse.Namespace) -> C:
    """Apply --config FILE, then the flags that were given, then every --set section.field=value.

    The result is written to --save-config FILE.
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


NAME_WIDTH = 32  # columns of the list of options
LINE_WIDTH = 120


def list_options(config: Any) -> str:
    """Return the list of all options, one below the other: name, default and meaning."""
    lines = []
    for name, f in every_option(config).items():
        default = str(f.default) if len(str(f.default)) < 12 else f"{str(f.default)[:9]}..."
        text = textwrap.wrap(f.metadata["help"], LINE_WIDTH - NAME_WIDTH - 1)
        lines.append(f"{f'{name}={default}':<{NAME_WIDTH}} {text[0]}")
        lines += [" " * (NAME_WIDTH + 1) + more for more in text[1:]]
    return "\n".join(lines)
