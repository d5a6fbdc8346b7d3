"""benchmarks/failure_gallery.py: an identity error is listed with its cause and drawn."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import failure_gallery
import numpy as np

import reobj_track as rt


def write(path: Path, rows: list[list[float]]) -> Path:
    np.savetxt(path, np.array(rows), delimiter=",", fmt="%.6f")
    return path


def test_failure_gallery_names_the_error_and_its_cause(tmp_path: Path) -> None:
    """One object, away for 5 frames, comes back at the border under a second identity."""
    frames = [*range(10), *range(15, 19)]
    (tmp_path / "images").mkdir()
    for i in range(20):
        cv2.imwrite(str(tmp_path / "images" / f"{i:04d}.png"), np.full((48, 64, 3), 90, np.uint8))
    x = np.where(np.array(frames) < 15, 20.0, 0.0)
    gt = [[f + 1, 1, a, 9, 20, 30, 1] for f, a in zip(frames, x, strict=True)]
    det = [[f + 1, -1, a, 9, 20, 30, 0.9] for f, a in zip(frames, x, strict=True)]
    gt_file = write(tmp_path / "gt.txt", gt)
    out = tmp_path / "out"
    images = str(tmp_path / "images")
    boxes_file = str(write(tmp_path / "det.txt", det))
    assert rt.main(["track", images, "--detections", boxes_file, "-o", str(out)]) == 0
    text = (out / "tracks.txt").read_text().splitlines()
    text[10:] = [",".join([line.split(",")[0], "2", *line.split(",")[2:]]) for line in text[10:]]
    (out / "tracks.txt").write_text("\n".join(text))
    command = [sys.executable, failure_gallery.__file__, out, "--gt", gt_file]
    command += ["-o", tmp_path / "gallery.png"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True)
    error = "object 1: a second identity (id 2, right 1), 4 frames from 16"
    assert f"| {error} | out of view for 5 frames; cut by the border |" in done.stdout
    picture = cv2.imread(str(tmp_path / "gallery.png"))
    assert picture is not None and picture.shape[1] == 900
