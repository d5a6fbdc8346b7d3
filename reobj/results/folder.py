"""Files of a result in its folder: their names, and how new ones take the place of old."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from reobj.files import part_paths, staged

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
