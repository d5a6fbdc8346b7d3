"""Options: fields of config dataclasses, set by flags or `--set section.field=value`."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import textwrap
from collections.abc import Iterable
from typing import Any, TypeVar

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


def add_flags(parser: argparse.ArgumentParser, config: Any, sections: Iterable[str]) -> None:
    """Add the flags that the options of some sections declare ("" for those of the top level)."""
    chosen = set(sections)
    for name, f in every_option(config).items():
        section, flag = name.rpartition(".")[0], f.metadata["flag"]
        if flag and section in chosen:
            kind: Any = type(f.default)
            how: dict[str, Any] = {"type": kind, "metavar": kind.__name__.upper()}
            if kind is bool:
                how = {"action": "store_true"}
            default = f" (default: {f.default})" if f.default else ""
            text = f"{f.metadata['help']}{default}".replace("%", "%%")
            parser.add_argument(flag, dest=name, default=None, help=text, **how)


def with_option(config: C, name: str, value: Any) -> C:
    """Return the config with one option changed; a text is converted to the option's type.

    Raises:
        ReobjError: no such option, or the text is none of its type.
    """
    options: Any = every_option(config)
    if name not in options:
        close = difflib.get_close_matches(name, options, 1) or ["tracker.coast_frames"]
        raise ReobjError(f"--set {name}: no such option; did you mean {close[0]}?")
    kind = type(options[name].default)
    try:
        if isinstance(value, str) and kind is bool:
            value = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False,
                     "no": False, "off": False}[value.lower()]  # fmt: skip
        value = kind(value)
    except (KeyError, TypeError, ValueError):
        expected = kind.__name__.upper()
        raise ReobjError(f"--set {name}: expected ={expected}, found {value!r}") from None
    section, _, field_name = name.rpartition(".")
    if section:
        field_name, value = (
            section,
            dataclasses.replace(getattr(config, section), **{field_name: value}),
        )
    changed: Any = dataclasses.replace(config, **{field_name: value})  # type: ignore[type-var]
    return changed  # type: ignore[no-any-return]


def config_from_args(config: C, args: argparse.Namespace) -> C:
    """Apply the flags that were given, then every --set section.field=value."""
    options: Any = every_option(config)
    for name, value in vars(args).items():
        if name in options and value is not None:
            config = with_option(config, name, value)
    for item in args.set or []:
        name, equals, text = item.partition("=")
        config = with_option(config, name, text if equals else None)
    return config


NAME_WIDTH, LINE_WIDTH = 32, 120  # columns of the list of options


def list_options(config: Any) -> str:
    """Return the list of all options, one below the other: name, default and meaning."""
    lines = []
    for name, f in every_option(config).items():
        default = str(f.default) if len(str(f.default)) < 12 else f"{str(f.default)[:9]}..."
        text = textwrap.wrap(f.metadata["help"], LINE_WIDTH - NAME_WIDTH - 1)
        lines.append(f"{f'{name}={default}':<{NAME_WIDTH}} {text[0]}")
        lines += [" " * (NAME_WIDTH + 1) + more for more in text[1:]]
    return "\n".join(lines)
