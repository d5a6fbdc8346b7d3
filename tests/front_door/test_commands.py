"""Every command, solver, exporter and format of poses, as a user calls them, against the truth.

Shell completion is tested in tests/test_run.py.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import truth as scores

from front_door.room import (
    DETECTIONS,
    FEW,
    POSES,
    ROOM,
    ROOT,
    assert_example_right,
    assert_right,
    cli,
    info,
    overlay_frames,
    true_boxes,
    true_centres,
    true_objects,
)

FILES = {
    "cache", "config.toml", "objects.json", "objects.ply", "poses.txt", "scene.html", "sparse",
    "tracks.txt",
}  # fmt: skip


# ---- run, track, poses ----


def test_readmes_first_command(example: Path) -> None:
    assert_example_right(example)
    names = {path.name for path in example.iterdir()}
    assert names - {"overlay.mp4", "eval.json"} == FILES
    scale = info(example)["world"]["scale"]
    ours = scores.Output.read(example).centres
    points = np.array([ours[f] for f in range(240)])
    true, *_ = scores.similarity(points, true_centres())
    assert abs(np.log(scale["metres_per_unit"] / true)) < 2 * scale["rel_sigma"]


def test_run_with_supplied_cameras(room: Path) -> None:
    assert_right(room)


def test_track(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli("track", ROOM / "room.mp4", "-o", out, *DETECTIONS, *FEW) == 0
    assert_right(out, hit_rate=0, idf1=0.94)
    assert overlay_frames(out) == 40
    printed_by = capsys.readouterr()
    assert "warning" not in printed_by.err and " objects: " in printed_by.out


def test_run_without_images(tmp_path: Path) -> None:
    out, words = tmp_path / "out", ("--camera", (ROOM / "camera.txt").read_text())
    assert cli("run", "-o", out, *DETECTIONS, *POSES[:2], *words, *FEW) == 0
    assert_right(out, idf1=0.94, warning="note: no images")


# ---- objects ----


def test_objects_are_valid(example: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("objects", example, "--validate") == 0
    assert capsys.readouterr().out == "valid\n"


# ---- eval ----


def evaluated(out: Path, *args: object) -> dict[str, Any]:
    assert cli("eval", out, "--gt", ROOM / "gt_mot.txt", *args) == 0
    found: dict[str, Any] = json.loads((out / "eval.json").read_text())
    return found


def test_eval_agrees_with_the_public_files(example: Path, tmp_path: Path) -> None:
    """IDF1, objects and errors, computed from tracks.txt, objects.json and poses.txt alone."""
    out = tmp_path / "out"
    shutil.copytree(example, out)
    found = evaluated(out, "--gt-objects", ROOM / "gt_objects.json")
    output = scores.Output.read(out)
    own = scores.score_2d(true_boxes(), output)
    assert found["tracks"]["all"]["IDF1"] == pytest.approx(own.idf1, abs=1e-6)
    assert found["tracks"]["all"]["identities"] == len({i for i in output.rows[:, 1]})
    cameras = scores.score_cameras(output, dict(enumerate(true_centres())), own=True)
    assert cameras is not None
    solids = scores.score_solids(true_objects(), output, cameras.truth_from_ours)
    assert found["objects"]["found"] == solids.found and found["objects"]["true"] == 35
    # eval also turns the world by the directions of the cameras: millimetres
    assert found["objects"]["center_error_median"] == pytest.approx(solids.centre_m, abs=0.006)


# ---- models, --options, --version, --help ----


def printed_by(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Text printed by an information-only command."""
    with pytest.raises(SystemExit) as ended:
        cli(*words)
    found = capsys.readouterr()
    assert not ended.value.code and found.err == ""
    return found.out


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert printed_by(capsys, "--version") == f"reobj_track {version}\n"


def test_models_lists_and_verifies(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("models") == 0
    listed = capsys.readouterr().out
    assert re.search(r"^deimv2-femto +detector .*default", listed, re.M)
    assert "not run here; the layout of its family is verified" in " ".join(listed.split())
    assert re.search(r"^reobj +backbone .*verified", listed, re.M)
    assert cli("models", "reobj") == 0
    assert Path(capsys.readouterr().out.strip()).name == "reobj.onnx"


def test_a_reader_that_stops_early_is_no_error() -> None:
    """`--options | head -1`"""
    command = f"{sys.executable} {ROOT / 'reobj_track.py'} --options | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.stderr == "" and done.stdout
