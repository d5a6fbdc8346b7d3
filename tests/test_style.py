"""Style checks of all modules: docstrings, imports, comments."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = [
    "reobj_track.py",
    "quadrics.py",
    *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "reobj").rglob("*.py"))),
]


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse((ROOT / module).read_text())


def documented(module: str) -> dict[str, str | None]:
    """Docstrings of the module, its classes, functions and methods."""
    found: dict[str, str | None] = {"module": ast.get_docstring(tree_of(module))}
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[f"{node.name}:{node.lineno}"] = ast.get_docstring(node)
    return found


@pytest.mark.parametrize("module", MODULES)
def test_public_names_have_docstrings(module: str) -> None:
    tree = tree_of(module)
    named = [n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    public = [n for n in named if not n.name.startswith("_")]
    assert [n.name for n in public if not ast.get_docstring(n)] == []
    assert ast.get_docstring(tree)


@pytest.mark.parametrize("module", MODULES)
def test_docstrings_begin_with_a_line_that_is_a_sentence(module: str) -> None:
    first = {name: text.splitlines()[0] for name, text in documented(module).items() if text}
    assert {name: line for name, line in first.items() if not line.endswith((".", ".)"))} == {}


@pytest.mark.parametrize("module", MODULES)
def test_nothing_runs_at_import(module: str) -> None:
    """Only imports, definitions, constants and the __main__ guard stand at module level.

    An import may depend on the platform, or be for type checkers only.
    """
    allowed = (
        ast.Import,
        ast.ImportFrom,
        ast.FunctionDef,
        ast.ClassDef,
        ast.Assign,
        ast.AnnAssign,
    )
    nodes = list[ast.stmt]()
    for node in tree_of(module).body[1:]:
        condition = ast.unparse(node.test) if isinstance(node, ast.If) else ""
        conditional = "sys.platform" in condition or condition == "TYPE_CHECKING"
        nodes += [*node.body, *node.orelse] if isinstance(node, ast.If) and conditional else [node]
    others = [
        ast.unparse(node)[:60]
        for node in nodes
        if not isinstance(node, allowed)
        and not (isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'")
    ]
    assert others == []


@pytest.mark.parametrize("module", MODULES)
def test_no_task_is_left_in_a_comment(module: str) -> None:
    assert not re.search(r"\b(TODO|FIXME|XXX|HACK)\b", (ROOT / module).read_text())
