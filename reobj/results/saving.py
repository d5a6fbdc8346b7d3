"""Files of a result: objects.json, changes.json, tracks.txt, poses, meshes; how new replace old.

An output folder: `save`, `load`. The tracks in its cache: `save_tracked`, `load_tracked`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reobj import __version__
from reobj.cameras import Poses, load_poses, save_poses, write_tum
from reobj.files import (
    atomic,
    check_places,
    columns_of,
    cut,
    from_columns,
    load_json,
    load_npz,
    part_path,
    part_paths,
    save_npz,
    staged,
)
from reobj.results.changes import (
    EarlierSession,
    read_changes,
    read_earlier,
    write_changes,
    write_earlier,
)
from reobj.results.edits import write_edits
from reobj.results.entries import Object, VideoInfo, World, read_json, written_by
from reobj.results.links import save_links
from reobj.results.names import OutputFile
from reobj.results.ply import write_ply
from reobj.results.upright import component_of, upright_pose
from reobj.sources.tables import Boxes3D, read_mot_rows
from reobj.types import Embeddings, ReobjError, Tracks, log, printable, without_secrets

if TYPE_CHECKING:
    from reobj.results.result import Result

HEADER = {"format": "reobj-objects", "version": 1}  # of objects.json
STALE = (  # files that not every run writes; cameras.csv: before 0.2
    OutputFile.POSES, OutputFile.MESH, OutputFile.LAST_POSES, OutputFile.CHANGES,
    OutputFile.EARLIER, OutputFile.LAST_LINKS,
    "cameras.csv", "overlay.mp4", "overlay.webm", "scene.html",
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


# ---- A result in an output folder --------------------------------------------------------------


def save(
    result: Result,
    out: Path,
    doubtful: bool,
    write_more: Callable[[Path], None] | None,
    stale: Sequence[str],
) -> None:
    """Write the files of a result; for the arguments see `Result.save`."""
    edited = () if result.edits is None else (OutputFile.EDITS,)
    with replaced(out, (*STALE, *edited, *stale)) as new:
        shown = result if doubtful else result.without_doubtful()
        write_mot(new / OutputFile.TRACKS, shown.tracks)
        write_objects(result, new / OutputFile.OBJECTS)
        write_edits(new, result.edits)
        if result.links is not None:
            save_links(result.links, new / OutputFile.LAST_LINKS)
        if result.changes is not None:
            write_changes(new / OutputFile.CHANGES, result.changes)
        if result.earlier:
            write_earlier(new / OutputFile.EARLIER, result.earlier)
        if result.poses is not None:
            save_poses(new / OutputFile.LAST_POSES, result.poses)
            write_trajectories(new, result.poses)
        if result.fits is not None or result.located:
            for k, component in enumerate(result.parts()):
                ids = [o.id for o in component.located]
                write_ply(part_path(new / OutputFile.MESH, k), component.ellipsoids(), ids)
        if write_more is not None:
            write_more(new)


def load(kind: type[Result], out: Path) -> Result:
    """Read what `save` wrote; for the errors see `Result.load`.

    Args:
        kind: `Result`, whose module imports this one.
    """
    path = out / OutputFile.OBJECTS
    if not path.is_file() or not (out / OutputFile.TRACKS).is_file():
        raise ReobjError(f"{out}: no objects.json and tracks.txt; make them first with `run`")
    poses = load_last_poses(out)
    entries = read_json(ObjectsFile, path, HEADER, out)
    if fault := _contradiction(entries, poses):
        raise ReobjError(f"{path}: {fault}; {written_by(out)}")
    class_names = tuple(dict.fromkeys(o.class_name for o in entries.objects))
    class_of = {o.id: class_names.index(o.class_name) for o in entries.objects}
    rows = read_mot_rows(out / OutputFile.TRACKS)
    frame = rows[:, 0].astype(np.int64) - 1
    ids = rows[:, 1].astype(np.int64)
    corners = np.concatenate([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]], 1)  # (N, 4)
    classes = np.array([class_of.get(i, -1) for i in ids.tolist()], np.int64)
    unknown = np.full(len(rows), -1, np.int64)
    changes = out / OutputFile.CHANGES
    return kind(
        Tracks(frame, ids, ids, corners, rows[:, 6], classes, unknown),
        class_names,
        entries.video,
        entries.objects,
        entries.world,
        poses,
        warnings=entries.warnings,
        changes=read_changes(changes) if changes.is_file() else None,
        earlier=_load_earlier(out / OutputFile.EARLIER),
        out=out,
    )


def _load_earlier(path: Path) -> Sequence[EarlierSession]:
    """Read the other recordings of the map; () if there are none, or with a warning if damaged."""
    try:
        return read_earlier(path) if path.is_file() else ()
    except ReobjError as error:
        log.warning("%s; the result is read without the other recordings of its map", error)
        return ()


def load_last_poses(out: Path) -> Poses | None:
    """Read the latest poses of an output folder, None if it has none."""
    path = out / OutputFile.LAST_POSES
    if not path.is_file():
        return None
    try:
        return load_poses(path)
    except (KeyError, TypeError, ReobjError) as error:
        raise ReobjError(f"{path}: {written_by(out)}") from error


# ---- objects.json ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ObjectsFile:
    """Content of objects.json that is read back."""

    video: VideoInfo
    world: World
    objects: list[Object]
    warnings: list[str] = field(default_factory=list)


def write_objects(result: Result, path: Path) -> None:
    """Write objects.json."""
    versions = {}
    for name in ("numpy", "scipy", "opencv-python-headless", "pycolmap", "onnxruntime"):
        with contextlib.suppress(PackageNotFoundError):  # installed under another name
            versions[name] = version(name)
    tracked = {"tracked_frames": len(np.unique(result.tracks.frame))}
    data = {
        **HEADER,
        "command": " ".join(map(without_secrets, sys.argv)),
        "reobj_track": __version__,
        "versions": versions,
        "conventions": {
            "pose": "cam_from_world",
            "camera_axes": "x right, y down, z forward",
            "quaternion": "wxyz, world_from_obj",
            "pixels": "centre of the top-left pixel at (0.5, 0.5) (COLMAP)",
            "frames": "0-based",
            "size": "full extents of the solid along its own axes",
            "ellipsoid": "inscribed in a box or cylinder",
            "cov": "9x9: center, log half axes, rotation vector in object axes",
            "center_m": "metres, z up, from the origin of the world",
            "yaw_deg": "of the x axis of the object about z",
        },
        "video": dataclasses.asdict(result.video) | tracked,
        "world": result.world.to_json(),
        "objects": [
            o.to_json() | upright_pose(o, component_of(o, result.world)) for o in result.objects
        ],
        "warnings": result.warnings,
    }
    with atomic(path) as part:
        part.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _contradiction(entries: ObjectsFile, poses: Poses | None) -> str:
    """Describe a contradiction between entries of objects.json, or to the poses; "" if none."""
    ids = [o.id for o in entries.objects]
    if len(set(ids)) != len(ids):
        return "two objects of one id"
    component_count = 1 if poses is None else poses.part_count
    described = len(entries.world.parts)
    if component_count not in (1, described):
        return f"{described} components of a trajectory that has {component_count}"
    for o in entries.objects:
        shape = (o.center, o.half_axes, o.size, o.quat_wxyz)
        if (o.located or o.status == "implausible") and any(value is None for value in shape):
            return f"object {o.id} is {o.status} without a shape"
        if o.part >= max(component_count, described):
            return f"object {o.id} is in component {o.part}, which does not exist"
    return ""


def objects_schema() -> Any:
    """Read the JSON schema of objects.json."""
    return json.loads(Path(__file__).with_name("objects.schema.json").read_text(encoding="utf-8"))


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
    types = Draft202012Validator.TYPE_CHECKER.redefine("number", _is_finite)
    validator = validators.extend(Draft202012Validator, type_checker=types)(objects_schema())
    lines = []
    for found in validator.iter_errors(load_json(path)):
        fault = cut(f"{found.json_path}: {found.message}", 200)  # it quotes the value
        lines.append(printable(f"{path}: {fault}"))
    return sorted(lines)


def _is_finite(_: Any, value: Any) -> bool:
    """Check for a number; NaN, which Python's parser accepts, is none in JSON."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


# ---- Tracks before linking ---------------------------------------------------------------------


def save_tracked(result: Result, path: Path) -> None:
    """Write tracks and embeddings, before they are linked and fitted, as npz."""
    columns = columns_of(result.tracks) | columns_of(result.untracked, "untracked_{}")
    columns |= columns_of(result.embeddings) | {"embedding_row": result.embedding_row}
    if result.boxes_3d is not None:
        columns |= columns_of(result.boxes_3d, "boxes_3d_{}")
    if result.looked is not None:
        columns["looked"] = result.looked
    facts = {"class_names": result.class_names, "warnings": result.warnings,
             "identities_given": result.identities_given,
             "video": dataclasses.asdict(result.video), "version": __version__}  # fmt: skip
    save_npz(path, columns, **facts)


def load_tracked(kind: type[Result], path: Path) -> Result:
    """Read what `save_tracked` wrote.

    Args:
        kind: `Result`, whose module imports this one.
    """
    try:
        data, facts = load_npz(path, sealed=True)
        boxes = "boxes_3d_frame" in data
        return kind(
            from_columns(Tracks, data),
            tuple(facts["class_names"]),
            VideoInfo(**facts["video"]),
            embeddings=from_columns(Embeddings, data),
            embedding_row=data["embedding_row"],
            untracked=from_columns(Tracks, data, "untracked_{}"),
            looked=data.get("looked"),
            boxes_3d=from_columns(Boxes3D, data, "boxes_3d_{}") if boxes else None,
            identities_given=bool(facts["identities_given"]),
            warnings=list(facts["warnings"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ReobjError(f"{path}: {written_by(path.parent.parent)}") from error
