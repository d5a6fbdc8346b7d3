"""The rooms and their floors: imports run downwards only; what is heavy is loaded when needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PATHS = [
    ROOT / "reobj_track.py",
    ROOT / "quadrics.py",
    *sorted((ROOT / "reobj").rglob("*.py")),
]
# A room imports only from rooms of a lower floor.
FLOORS = {
    0: "reobj quadrics",
    1: "reobj.types",
    2: "reobj.files reobj.frame_lookup reobj.identity.assignment reobj.identity.evidence "
    "reobj.identity.sampling reobj.sources.masks reobj.sources.tiles "
    "reobj.poses.arrays",
    3: "reobj.cameras reobj.options reobj.schema reobj.sources.video "
    "reobj.sources.weights "
    "reobj.sources.recorded reobj.sources.class_names reobj.sources.image_frames "
    "reobj.poses.child reobj.poses.uncertainty "
    "reobj.results.edits",
    4: "reobj.views reobj.commands reobj.sources.imageless reobj.sources.tables "
    "reobj.sources.coco reobj.sources.cvat reobj.sources.label_folders "
    "reobj.identity.camera_motion reobj.identity.embedding reobj.identity.reid "
    "reobj.identity.places reobj.identity.gaps reobj.poses.keyframes reobj.poses.features "
    "reobj.poses.soundness "
    "reobj.poses.adjustment "
    "reobj.poses.consistency reobj.poses.zoom reobj.poses.intrinsics reobj.poses.matching "
    "reobj.poses.checks reobj.poses.floor reobj.results.ply reobj.results.film "
    "reobj.results.folder",
    5: "reobj.sources.detection_files reobj.sources.onnx_layouts reobj.identity.crops "
    "reobj.identity.linking reobj.identity.association reobj.identity.proposals "
    "reobj.identity.occlusion "
    "reobj.poses.mapping reobj.poses.localize reobj.poses.readers reobj.poses.points "
    "reobj.poses.depth reobj.results.result",
    6: "reobj.identity.locate reobj.sources.detectors reobj.poses.estimate reobj.objects "
    "reobj.results.workspace "
    "reobj.results.overlay reobj.results.solids reobj.results.plausibility",
    7: "reobj.parts reobj.solvers reobj.poses.stage reobj.poses.imageless "
    "reobj.results.evaluation "
    "reobj.results.stages reobj.results.export reobj.results.scene",
    8: "reobj_track",
}
FLOOR = {room: floor for floor, rooms in FLOORS.items() for room in rooms.split()}
LAZY = {  # optional, or slow to load
    "pycolmap", "onnxruntime", "filterpy", "jsonschema", "trimesh", "rerun", "supervision", "av",
    "shtab",
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
            found |= {f"{part.module}.{a.name}" for a in part.names} & set(ROOMS)
    return found


ROOMS = {name_of(path): path for path in PATHS}
EMPTY = {"reobj.sources", "reobj.identity", "reobj.poses", "reobj.results"}  # packages


def arrows() -> dict[str, set[str]]:
    """The rooms that each room imports."""
    return {name: imported(tree_of(path)) & set(ROOMS) for name, path in ROOMS.items()}


def test_every_room_has_a_floor() -> None:
    assert set(ROOMS) - EMPTY == set(FLOOR)
    for name in EMPTY:
        assert len(tree_of(ROOMS[name]).body) <= 1, f"{name}: only a docstring"


@pytest.mark.parametrize("room", sorted(FLOOR))
def test_imports_run_downwards(room: str) -> None:
    """Strictly: so that there is no circle, and nothing in reobj/ imports the tool."""
    uphill = {other for other in arrows()[room] - EMPTY if FLOOR[other] >= FLOOR[room]}
    assert uphill == set()


def test_there_is_no_circle() -> None:
    """Found by taking away rooms that import none of those left, floors aside."""
    left = arrows()
    while free := {name for name, used in left.items() if not used & set(left) - {name}}:
        left = {name: used for name, used in left.items() if name not in free}
    assert left == {}


def test_an_arrow_that_runs_up_would_be_found(tmp_path: Path) -> None:
    code = "from reobj.results import scene\nimport reobj_track\ndef f():\n    import reobj.files"
    found = imported(ast.parse(code)) & set(ROOMS)
    assert found == {"reobj.results", "reobj.results.scene", "reobj_track", "reobj.files"}


def test_imports_stand_at_the_top() -> None:
    """But for packages that are optional, or slow to load."""
    inner = {
        f"{name}.{function.name}": others
        for name, path in ROOMS.items()
        for function in ast.walk(tree_of(path))
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        and (others := {m.partition(".")[0] for m in imported(function)} - LAZY)
    }
    assert inner == {}


def test_private_names_stay_in_their_room() -> None:
    crossing = {
        f"{name}: {alias.name}"
        for name, path in ROOMS.items()
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
