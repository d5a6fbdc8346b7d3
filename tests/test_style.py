"""House style that a machine can check: short functions, docstrings on what is public, nothing at
import.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import statistics
from pathlib import Path

import pytest

import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("reobj_track.py", "quadrics.py", "examples/render_room.py")


def code_lines(function: ast.FunctionDef) -> int:
    """Length of a function without its docstring."""
    doc = function.body[0]
    has_doc = ast.get_docstring(function) is not None
    return (
        function.end_lineno
        - function.lineno
        + 1
        - (doc.end_lineno - doc.lineno + 1 if has_doc else 0)
    )  # type: ignore[operator]


def functions(module: str) -> list[ast.FunctionDef]:
    tree = ast.parse((ROOT / module).read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


@pytest.mark.parametrize("module", MODULES)
def test_functions_are_short(module: str) -> None:
    lengths = {f.name: code_lines(f) for f in functions(module)}
    assert {name: n for name, n in lengths.items() if n > 50} == {}
    assert statistics.median(lengths.values()) <= 14


@pytest.mark.parametrize("module", MODULES[:2])
def test_public_names_have_docstrings(module: str) -> None:
    tree = ast.parse((ROOT / module).read_text())
    named = [n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    assert [n.name for n in named if not n.name.startswith("_") and not ast.get_docstring(n)] == []


@pytest.mark.parametrize("module", MODULES[:2])
def test_nothing_runs_at_import(module: str) -> None:
    """Only imports, definitions, constants and the __main__ guard stand at module level."""
    allowed = (
        ast.Import,
        ast.ImportFrom,
        ast.FunctionDef,
        ast.ClassDef,
        ast.Assign,
        ast.AnnAssign,
        ast.If,
    )
    tree = ast.parse((ROOT / module).read_text())
    others = [ast.unparse(n)[:60] for n in tree.body[1:] if not isinstance(n, allowed)]
    assert others == []


def test_every_option_is_used() -> None:
    """What a user can set must be read somewhere."""
    source = (ROOT / "reobj_track.py").read_text()
    sections = [s for s in vars(rt).values() if dataclasses.is_dataclass(s)]
    names = {
        f.name for s in sections if s.__name__.endswith("Config") for f in dataclasses.fields(s)
    }
    assert {name for name in names if not re.search(rf"\.{name}\b", source)} == set()
