"""Files of a result in its folder: their names, how new ones take the place of old; text files."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from reobj.cameras import Poses, write_tum
from reobj.files import atomic, check_places, part_path, part_paths, staged
from reobj.types import Tracks

LAST_POSES = "cache/last-poses.npz"  # in an output folder
MODEL = "sparse"  # folder of a COLMAP model
STALE = (  # of an earlier run, which another run may not write; cameras.csv: before 0.2
    "poses.txt", "cameras.csv", "objects.ply", "overlay.mp4", "overlay.webm", "scene.html",
    LAST_POSES,
)  # fmt: skip
CONFIG_FILE = "config.toml"  # options of the last run
FILES = (*STALE, "tracks.txt", "objects.json", "edits.json", CONFIG_FILE, f"{MODEL}/cameras.txt")


def check_results(out: Path) -> None:
    """Refuse an output folder in which results cannot be written, before they are computed."""
    check_places(out, FILES)


@contextlib.contextmanager
def replaced(out: Path, stale: Sequence[str] = STALE) -> Iterator[Path]:
    """Yield an empty folder whose files become those of the result in `out`, instead of all old.

    An exception in the block leaves the old ones as they were.

    Args:
        stale: names of what is removed from `out` where the block does not write it.
    """
    with staged(out) as new:
        yield new
        made = {path.relative_to(new) for path in new.rglob("*")}
    remove_stale(out, stale, made)


def remove_stale(
    out: Path, stale: Sequence[str] = STALE, made: Iterable[Path] = frozenset()
) -> None:
    """Remove what an earlier run wrote and another one may not: of further parts too.

    Args:
        made: what stays, relative to `out`; of a folder in it only the files in it.
    """
    kept = {out / path for path in made}
    for name in stale:
        for found in (out / name, *part_paths(out / name)):
            found.with_name(f".part-{found.name}").unlink(missing_ok=True)  # of a killed run
            if name == MODEL and found.is_dir() and not found.is_symlink():
                for old in set(found.iterdir()) - kept:
                    shutil.rmtree(old) if old.is_dir() else old.unlink()
                if found not in kept:
                    found.rmdir()
            elif found not in kept:
                found.unlink(missing_ok=True)


def copy_models(models: Sequence[Path], folder: Path) -> None:
    """Copy COLMAP models, one of each part, to sparse/, sparse_part1/, ...; missing ones not."""
    for k, model in enumerate(models):
        if model.is_dir():
            shutil.copytree(model, part_path(folder / MODEL, k))


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
