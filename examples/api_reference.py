#!/usr/bin/env python3
"""Write docs/api.md: every public class and function with its signature and docstring.

    python examples/api_reference.py -o docs/api.md

Read from the source, in its order; nothing is imported. `tests/test_docs.py` fails when the page is
older than the docstrings.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("reobj_track", "quadrics")
HEAD = """# API reference

Made from the docstrings by `python examples/api_reference.py -o docs/api.md`; do not edit. Where to
begin: `run` and `track` (the chain), `Tracker.update` (`examples/four_ways.py` shows the ways to
call it), `quadrics.fit_objects` (geometry alone). The fields of the configs are the options of
`--set section.field=value`.

`Array`, `IntArray`, `BoolArray`, `Image` are numpy arrays of float64, int64, bool, uint8; (N, 4) is
a shape; `xyxy` are pixels, the top-left one spans [0, 1]; `b_from_a` maps coordinates in a to b.
"""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def signature(node: Function) -> str:
    """The call as it is written, without `self`."""
    args = ast.unparse(node.args)
    args = re.sub(r"^self(, )?", "", args)
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{node.name}({args}){returns}"


def prose(node: ast.ClassDef | Function) -> str:
    """The docstring: its text as it is, examples and tables of arguments in a block."""
    text = inspect.cleandoc(ast.get_docstring(node) or "")
    head, *rest = re.split(
        r"\n(?=Args:|Returns:|Yields:|Raises:|Attributes:|>>> )", text, maxsplit=1
    )
    block = f"\n\n```text\n{rest[0].strip()}\n```" if rest else ""
    return head.strip() + block


def options(node: ast.ClassDef) -> Iterator[str]:
    """Rows of a table for the fields of a config, which carry their own help."""
    for field in node.body:
        if isinstance(field, ast.AnnAssign) and isinstance(field.value, ast.Call):
            call = field.value
            if ast.unparse(call.func) == "_opt":
                default, text = (ast.unparse(a) for a in call.args[:2])
                name = ast.unparse(field.target)
                text = ast.literal_eval(text).replace("|", "\\|")
                yield f"| `{name}` | `{default}` | {text} |"


def describe(node: ast.ClassDef | Function) -> Iterator[str]:
    """Lines of a class with its public methods, or of a function."""
    if not isinstance(node, ast.ClassDef):
        yield f"### `{signature(node)}`\n\n{prose(node)}\n"
        return
    start = next((m for m in methods(node, True) if m.name == "__init__"), None)
    call = (
        f"{node.name}({signature(start).split('(', 1)[1].rsplit(')', 1)[0]})"
        if start
        else node.name
    )
    yield f"### class `{call}`\n\n{prose(node)}\n"
    if rows := list(options(node)):
        yield "\n".join(("| field | default | |", "|---|---|---|", *rows)) + "\n"
    for method in methods(node, False):
        text = f"- **`{signature(method)}`**: {prose(method)}"
        yield textwrap.indent(text, "  ").removeprefix("  ") + "\n"


def methods(node: ast.ClassDef, private: bool) -> list[Function]:
    """Methods with a docstring; private: all of them."""
    found = [m for m in node.body if isinstance(m, Function)]
    return [m for m in found if private or (m.name[0] != "_" and ast.get_docstring(m))]


def module(name: str) -> Iterator[str]:
    """The page's part on one module: a heading for each of its sections."""
    text = (ROOT / f"{name}.py").read_text()
    banners = {
        n: m[1]
        for n, line in enumerate(text.splitlines(), 1)
        if (m := re.match(r"# -+ (.+?) -+$", line))
    }
    yield f"# {name}\n"
    shown = 0
    for node in ast.parse(text).body:
        if not isinstance(node, ast.ClassDef | Function) or node.name[0] == "_":
            continue
        above = max((n for n in banners if n < node.lineno), default=0)
        if above > shown:
            shown = above
            yield f"## {banners[above]}\n"
        yield from describe(node)


def reference() -> str:
    """The whole page."""
    return "\n".join([HEAD, *(line for name in MODULES for line in module(name))])


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "docs" / "api.md")
    args = parser.parse_args(argv)
    args.out.write_text(reference())
    print(args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
