"""Imports: optional or heavy packages are loaded only when they are needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PATHS = [
    ROOT / "reobj_track.py",
    ROOT / "quadrics.py",
    *sorted((ROOT / "reobj").rglob("*.py")),
]
LAZY = {  # optional, or slow to load
    "pycolmap", "onnxruntime", "filterpy", "jsonschema", "trimesh", "rerun", "supervision", "av",
    "shtab", "pandas", "mcap_ros2", "torch", "torchvision", "transformers", "ultralytics", "rfdetr",
}  # fmt: skip


def name_of(path: Path) -> str:
    """The module that a file is, e.g. `reobj.poses.stage`."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imported(node: ast.AST) -> set[str]:
    """Modules that a piece of code imports; of `from reobj import files` too the module files."""
    found = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Import):
            found |= {alias.name for alias in part.names}
        elif isinstance(part, ast.ImportFrom):
            assert part.level == 0, f"line {part.lineno}: relative import"
            found |= {str(part.module)}
            found |= {f"{part.module}.{a.name}" for a in part.names} & set(MODULES)
    return found


MODULES = {name_of(path): path for path in PATHS}


def test_every_kind_of_import_is_seen() -> None:
    code = "from reobj.results import scene\nimport reobj_track\ndef f():\n    import reobj.files"
    found = imported(ast.parse(code)) & set(MODULES)
    assert found == {"reobj.results", "reobj.results.scene", "reobj_track", "reobj.files"}


def test_imports_stand_at_the_top() -> None:
    """But for packages that are optional, or slow to load."""
    inner = {
        f"{name}.{function.name}": others
        for name, path in MODULES.items()
        for function in ast.walk(tree_of(path))
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        and (others := {m.partition(".")[0] for m in imported(function)} - LAZY)
    }
    assert inner == {}


def test_private_names_stay_in_their_module() -> None:
    crossing = {
        f"{name}: {alias.name}"
        for name, path in MODULES.items()
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name.startswith("_") and not alias.name.startswith("__")
    }
    assert crossing == set()


def loaded_by(code: str) -> set[str]:
    """Top-level packages in memory after some code in a fresh interpreter."""
    code += "\nimport sys; print(*{name.partition('.')[0] for name in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    return set(done.stdout.split())


def test_the_tool_loads_nothing_heavy_or_optional() -> None:
    heavy = LAZY | {"torch", "matplotlib", "onnx", "supervision", "ray", "pandas"}
    loaded = loaded_by("import reobj_track")
    assert {"numpy", "scipy", "cv2", "reobj", "quadrics"} <= loaded
    assert loaded & heavy == set()


def test_quadrics_stands_alone() -> None:
    """It needs numpy and nothing else that is installed."""
    own = loaded_by("import quadrics") - set(sys.stdlib_module_names) - {"__main__"}
    plain = loaded_by("") - set(sys.stdlib_module_names)
    assert {name for name in own - plain if not name.startswith("_")} == {"numpy", "quadrics"}
