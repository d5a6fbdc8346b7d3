"""Files of an output folder: tracks, poses, models; how new files replace earlier ones."""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Poses, load_poses, write_tum
from reobj.files import (
    atomic,
    check_places,
    cut,
    load_json,
    part_path,
    part_paths,
    staged,
)
from reobj.results.entries import RUN_AGAIN, OutputFile
from reobj.types import ReobjError, Tracks, printable

HEADER = {"format": "reobj-objects", "version": 1}  # of objects.json
STALE = (  # files that not every run writes
    OutputFile.POSES, OutputFile.MESH, OutputFile.LAST_POSES, OutputFile.CHANGES,
    OutputFile.EARLIER, OutputFile.LAST_LINKS,
    "overlay.mp4", "scene.html",
)  # fmt: skip


def check_results(out: Path) -> None:
    """Check that results can be written into an output folder, before they are computed."""
    others = (OutputFile.TRACKS, OutputFile.OBJECTS, OutputFile.EDITS, OutputFile.CONFIG)
    check_places(out, (*STALE, *others, f"{OutputFile.MODEL}/cameras.txt"))


@contextlib.contextmanager
def replaced(out: Path, stale: Sequence[str] = STALE) -> Iterator[Path]:
    """Yield an empty folder whose files replace those of `out` at the end of the block.

    An exception in the block leaves `out` unchanged.

    Args:
        stale: files that are removed from `out` if the block does not write them.
    """
    with staged(out) as new:
        yield new
        made = {path.relative_to(new) for path in new.rglob("*")}
    remove_stale(out, stale, made)


def remove_stale(
    out: Path, stale: Sequence[str] = STALE, made: Iterable[Path] = frozenset()
) -> None:
    """Remove files of an earlier run, also those of further components.

    Args:
        made: paths that are kept, relative to `out`; of a folder only the listed files.
    """
    kept = {out / path for path in made}
    for name in stale:
        for found in (out / name, *part_paths(out / name)):
            found.with_name(f".part-{found.name}").unlink(missing_ok=True)  # of a killed run
            if name == OutputFile.MODEL and found.is_dir() and not found.is_symlink():
                for old in set(found.iterdir()) - kept:
                    shutil.rmtree(old) if old.is_dir() else old.unlink()
                if found not in kept:
                    found.rmdir()
            elif found not in kept:
                found.unlink(missing_ok=True)


def copy_models(models: Sequence[Path], folder: Path) -> None:
    """Copy the existing COLMAP models, one a component, to sparse/, sparse_part1/, ..."""
    for k, model in enumerate(models):
        if model.is_dir():
            shutil.copytree(model, part_path(folder / OutputFile.MODEL, k))


def write_trajectories(out: Path, poses: Poses) -> None:
    """Write poses.txt, and poses_part1.txt, ... of further components: a TUM file has one world."""
    if not poses.known.any():
        return
    for old in part_paths(out / OutputFile.POSES):
        old.unlink()
    for k in range(poses.part_count):
        write_tum(part_path(out / OutputFile.POSES, k), poses.of_part(k))


def write_mot(path: Path, tracks: Tracks) -> None:
    """Write MOTChallenge results: frame (from 1), id, left, top, width, height, score, 3 x -1."""
    ltwh = np.column_stack([tracks.xyxy[:, :2], tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]])
    rows = np.column_stack([tracks.frame + 1, tracks.track_id, ltwh, tracks.score])  # (N, 7)
    with atomic(path) as part:
        np.savetxt(part, rows, ("%d", "%d", *["%.2f"] * 4, "%.4f,-1,-1,-1"), ",")


def load_last_poses(out: Path) -> Poses | None:
    """Read the latest poses of an output folder, None if it has none."""
    path = out / OutputFile.LAST_POSES
    if not path.is_file():
        return None
    try:
        return load_poses(path)
    except (KeyError, TypeError, ReobjError) as error:
        raise ReobjError(f"{path}: {RUN_AGAIN}") from error


def validate_objects(path: Path) -> list[str]:
    """Check an objects.json, or that of a folder, against its JSON schema.

    Returns:
        one line for each error: file, JSON path, and what was expected.
    """
    try:
        from jsonschema import Draft202012Validator, validators
    except ImportError as error:
        advice = "jsonschema is not installed: pip install jsonschema"
        raise ReobjError(advice) from error
    path = path / OutputFile.OBJECTS if path.is_dir() else path
    schema = load_json(Path(__file__).with_name("objects.schema.json"))
    types = Draft202012Validator.TYPE_CHECKER.redefine("number", _is_finite)
    validator = validators.extend(Draft202012Validator, type_checker=types)(schema)
    lines = []
    for found in validator.iter_errors(load_json(path)):
        fault = cut(f"{found.json_path}: {found.message}", 200)  # it quotes the value
        lines.append(printable(f"{path}: {fault}"))
    return sorted(lines)


def _is_finite(_: Any, value: Any) -> bool:
    """Check for a number; NaN, which Python's parser accepts, is none in JSON."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
