"""Mistakes of a first hour, and their messages; what a newcomer's recordings showed."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import reobj_track as rt
from front_door.room import ROOM, cli, refusal

CLIP = ROOM / "room.mp4"


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is a folder of Linux")
def test_folders_that_take_no_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    boxes = ("--detections", ROOM / "detections.npz")
    text = refusal(capsys, "run", CLIP, "-o", "/proc/out", *boxes)
    assert text.startswith("error: /proc/out/cache: cannot be written (No such file")
    assert "choose a folder that takes files" in text
    text = refusal(capsys, "run", CLIP, "-o", tmp_path / "out", *boxes, "--map", "/proc/flat.map")
    assert text.startswith("error: /proc/flat.map: cannot be written (No such file")


def test_a_refused_run_leaves_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """But what was in the folder stays."""
    for option in ("--detector=fsat", "--detections=none.json", f"--map={CLIP}", "--poses=a.txt"):
        refusal(capsys, "run", CLIP, "-o", tmp_path / "out", option)
        assert not (tmp_path / "out").exists(), option
    (tmp_path / "out" / "cache").mkdir(parents=True)
    refusal(capsys, "run", CLIP, "-o", tmp_path / "out", "--detector", "fsat")
    assert (tmp_path / "out" / "cache").is_dir()


def photos(folder: Path, count: int) -> Path:
    """Photos of a wall without texture: their cameras cannot be reconstructed."""
    folder.mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:03d}.jpg"), np.full((240, 320, 3), 90 + i, np.uint8))
    return folder


def test_photos_have_visits(tmp_path: Path) -> None:
    """13 photos without times count as 30 a second, and 2 s would be all of them."""
    folder = photos(tmp_path / "flat" / "images", 13)
    rows = [f"{i + 1},1,{100 + i},50,60,90,.9,56" for i in (0, 1, 2, 9, 10, 11, 12)]
    rows += [f"{i + 1},2,{20 + i},150,40,60,.9,58" for i in range(13)]
    (tmp_path / "gt.txt").write_text("\n".join(rows) + "\n")
    assert cli("track", folder, "-o", tmp_path / "out", "--tracks", tmp_path / "gt.txt") == 0
    first, second = rt.Result.load(tmp_path / "out").objects
    assert first.visits == [[0, 2], [9, 12]] and second.visits == [[0, 12]]


def test_a_recording_in_a_map_has_the_name_of_its_viewer(tmp_path: Path) -> None:
    folder = photos(tmp_path / "flat" / "images", 8)
    (tmp_path / "gt.txt").write_text("".join(f"{i},1,99,50,60,90,.9,56\n" for i in range(1, 9)))
    more = ("--tracks", tmp_path / "gt.txt", "--map", tmp_path / "a.map")
    assert cli("run", folder, "-o", tmp_path / "out", *more) == 0
    changes = rt.Result.load(tmp_path / "out").changes
    assert changes is not None and changes.session == "flat"
