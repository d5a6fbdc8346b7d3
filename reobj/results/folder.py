"""Files of a result in its folder: their names, how new ones take the place of old; text files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reobj.cameras import Poses, write_tum
from reobj.files import atomic, part_path, part_paths, staged
from reobj.types import Tracks

LAST_POSES = "cache/last-poses.npz"  # in an output folder
STALE = (  # files of an earlier run, which another run may not write; cameras.csv: before 0.2
    "poses.txt", "cameras.csv", "objects.ply", "overlay.mp4", "overlay.webm",
    "scene.html",
)  # fmt: skip


@contextlib.contextmanager
def replaced(out: Path) -> Iterator[Path]:
    """Yield an empty folder whose files become those of the result in `out`, instead of all old.

    An exception in the block leaves the old ones as they were.
    """
    with staged(out) as new:
        yield new
        if not (new / LAST_POSES).exists():
            (out / LAST_POSES).unlink(missing_ok=True)
        remove_stale(out)


def remove_stale(out: Path) -> None:
    """Remove what an earlier run wrote and another one may not: of further parts too."""
    for path in (out / name for name in STALE):
        for file in (path, *part_paths(path)):
            file.unlink(missing_ok=True)


def write_trajectories(out: Path, poses: Poses) -> None:
    """Write poses.txt, and poses_part1.txt, ... of further parts: a TUM file is one world."""
    if not poses.known.any():
        return
    for old in part_paths(out / "poses.txt"):
        old.unlink()
    for k in range(poses.part_count):
        write_tum(part_path(out / "poses.txt", k), poses.of_part(k))


def write_mot(path: Path, tracks: Tracks) -> None:
    """Write MOTChallenge results: frame (from 1), id, left, top, width, height, score, 3 x -1."""
    ltwh = np.column_stack([tracks.xyxy[:, :2], tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]])
    rows = np.column_stack([tracks.frame + 1, tracks.track_id, ltwh, tracks.score])  # (N, 7)
    with atomic(path) as part:
        np.savetxt(part, rows, ("%d", "%d", *["%.2f"] * 4, "%.4f,-1,-1,-1"), ",")
