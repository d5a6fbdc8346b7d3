"""Poses made elsewhere: which format a file or folder has, and which frame each pose belongs to.

Each format has a reader that turns its conventions into cam_from_world, OpenCV axes, COLMAP pixels
(`pose_formats`, `colmap_model`); `pose_readings` then finds the frames. Whether the conventions
were those that the file claims is judged later, by `checks`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import WORLD_MAX, Camera, Poses, usable
from reobj.files import load_json, spans
from reobj.poses.intrinsics import CAMERA_FORMS, fitted_camera, parse_camera
from reobj.poses.supplied import pose_formats as formats
from reobj.poses.supplied.colmap_model import find_models, read_colmap
from reobj.poses.supplied.frame_assignment import (
    UNITS,
    Reading,
    Source,
    interpolated,
    readings,
    source_of,
    unit_of_stamps,
)
from reobj.poses.supplied.interpretation import PoseReading, by_images
from reobj.poses.supplied.pose_formats import PoseFile, one_camera
from reobj.types import Array, IntArray, ReobjError


def read_poses(
    path: str | Path,
    video: Any,
    fmt: str = "auto",
    camera: str = "",
    metric: bool = False,
    frames_by: str = "",
) -> Poses:
    """Read the poses of a video's frames from a file or folder of another tool.

    Args:
        path: file or folder. video: the frames they belong to.
        fmt: auto (recognised), or a format of READERS.
        camera: intrinsics in place of the file's, as `--camera` takes them.
        metric: the poses are in metres, also where the format does not say so.
        frames_by: which pose belongs to which frame, where the file leaves it open: `number0`,
            `number1`, `time`, ... as the error of a tie names them.
    Returns:
        poses of the frames that the file knows, NaN for the others (counted in `messages`).
    Raises:
        ReobjError: damaged, unknown, not rigid, without intrinsics, of another video, or with
            several readings between which the images do not decide.
    """
    found = pose_readings(path, video, fmt, camera, metric, frames_by)
    return the_reading(by_images(found, video), Path(path))


def the_reading(found: list[PoseReading], path: Path) -> Poses:
    """Return the poses of the only reading; refuse several that were not decided between."""
    if len(found) > 1:
        what = "; or ".join(f"{reading.key} ({reading.rule})" for reading in found)
        raise ReobjError(
            f"{path}: the frames of its poses can be found in {len(found)} ways, and neither "
            f"images nor tracks show which is right: {what}; choose with --set "
            f"poses.frames_by={found[0].key}"
        )
    return found[0].described_poses


def pose_readings(
    path: str | Path,
    video: Any,
    fmt: str = "auto",
    camera: str = "",
    metric: bool = False,
    frames_by: str = "",
) -> list[PoseReading]:
    """Read poses as `read_poses` does, in all the ways that the file leaves open, one at least."""
    path, size = Path(path), (int(video.size[0]), int(video.size[1]))
    given = read_pose_file(path, fmt, size)
    stated = parse_camera(camera, size)
    if stated is None and not any(given.cameras):
        raise ReobjError(f"{path}: no intrinsics; add --camera {CAMERA_FORMS}")
    times = [(frame.index, frame.time_s) for frame in video]
    if not times:
        raise ReobjError("the video has no frame that can be read: poses belong to nothing")
    frame, time_s = np.array([n for n, _ in times], np.int64), np.array([t for _, t in times])
    source = source_of(video, frame, time_s)
    stamps_s, messages = _in_seconds(given, path, source)
    count = len(given.cam_from_world)
    found = readings(count, given.names, stamps_s, source, str(path), given.own)
    if not found:
        what = _compared(given, stamps_s, source)
        raise ReobjError(f"{path}: none of its {count} poses belongs to a frame ({what})")
    rows = np.unique(np.concatenate([reading.row for reading in found]))
    intrinsics = _intrinsics(given, rows[rows >= 0], size, path) if stated is None else stated
    if not usable(intrinsics):
        raise ReobjError(f"{path}: {intrinsics}: expected finite numbers, focal lengths above 0")
    orders = {"": given.cam_from_world}
    if given.w_first is not None:
        orders = {"w_last": given.cam_from_world, "w_first": given.w_first}
    result = []
    for reading, (order, cam_from_world) in itertools.product(found, orders.items()):
        poses, lost = _of_frames(cam_from_world, stamps_s, reading, source, path)
        status = np.where(np.isfinite(poses).all((1, 2)), "supplied", "none")
        whole = Poses(
            intrinsics, frame, time_s, poses, status, "user",
            metric=given.metric or metric, up_in_world=given.up_in_world, points=given.points,
            colors=given.colors, visibility=_in_frames(given.visibility, reading.row),
            messages=(*given.messages, *messages, *lost),
        )  # fmt: skip
        key = f"{reading.key}.{order}".rstrip(".")
        rule = f"{reading.rule}, quaternions {order}".removesuffix(", quaternions ")
        result.append(PoseReading(key, rule, whole, given.kind))
    keys = ", ".join(reading.key for reading in result)
    if frames_by and not (result := [r for r in result if r.key == frames_by]):
        raise ReobjError(f"--set poses.frames_by={frames_by}: {path} can be read by {keys}")
    return result


def _in_seconds(
    given: PoseFile, path: Path, source: Source
) -> tuple[Array | None, tuple[str, ...]]:
    """Convert the stamps (N,) of a file into seconds; which unit was found, if the file is mute."""
    if given.stamps is None:
        return None, ()
    unit, per_s = given.unit, dict(UNITS).get(given.unit, 1.0)
    if not unit:
        end_s = float(source.time_s[-1]) if source.timed else 0.0
        unit, per_s = unit_of_stamps(given.stamps, end_s)
    said = unit != "s" and not given.unit
    return given.stamps / per_s, (f"{path}: time stamps taken for {unit}",) * said


def _intrinsics(given: PoseFile, rows: IntArray, size: tuple[int, int], path: Path) -> Camera:
    """Return the one camera of the poses in these rows, for frames of (w, h) `size`."""
    each = len(given.cameras) == len(given.cam_from_world)
    camera = one_camera([given.cameras[row] for row in rows] if each else given.cameras, path)
    if camera is None:
        raise ReobjError(f"{path}: no intrinsics; add --camera {CAMERA_FORMS}")
    return fitted_camera(camera, size, str(path))


def _of_frames(
    cam_from_world: Array, stamps_s: Array | None, reading: Reading, source: Source, path: Path
) -> tuple[Array, list[str]]:
    """Return the poses (F, 3, 4) of the frames by one reading, and which frames have none."""
    row, known = reading.row, reading.row >= 0
    poses = np.full((len(row), 3, 4), np.nan)
    poses[known] = cam_from_world[row[known]]
    if reading.key == "time" and stamps_s is not None and len(stamps_s) > 1:
        exact, use = interpolated(cam_from_world, stamps_s, source.time_s)
        poses[use & known] = exact[row[use] >= 0]
    known = np.isfinite(poses).all((1, 2))
    if (np.abs(poses[known]) >= WORLD_MAX).any():
        raise ReobjError(f"{path}: a camera is more than {WORLD_MAX:g} units away from the origin")
    if known.all():
        return poses, []
    step = int(np.median(np.diff(source.frame))) if len(row) > 1 else 1
    lost = spans(source.frame[~known].tolist(), step)
    return poses, [f"{path}: poses for {known.sum()} of {len(row)} frames, none for {lost}"]


def _compared(given: PoseFile, stamps_s: Array | None, source: Source) -> str:
    """Say what was compared in vain."""
    if given.names:
        first = source.images[int(source.frame[0])] if source.images else int(source.frame[0])
        return f"images {given.names[0]!r} ..., frames {first!r} ..."
    if stamps_s is None:
        return "in order"
    start, end = source.time_s[[0, -1]]
    said = f"frames {start:.3f}-{end:.3f} s" if source.timed else "the images have no times"
    return f"{stamps_s[0]:.3f}-{stamps_s[-1]:.3f} s, {said}; another clock: one for each frame"


def _in_frames(visibility: IntArray, row: IntArray) -> IntArray:
    """Replace rows of poses (M, 2) by those of the frames that have them; others fall out."""
    frame_of = np.full(int(max(row.max(initial=-1), visibility[:, 0].max(initial=-1))) + 1, -1)
    frame_of[row[row >= 0]] = np.flatnonzero(row >= 0)
    at = frame_of[visibility[:, 0]]
    return np.column_stack([at, visibility[:, 1]])[at >= 0]


# ---- Formats -------------------------------------------------------------------------------------


READERS: dict[str, Callable[[Path, tuple[int, int]], PoseFile]] = {
    "colmap": read_colmap,
    "tum": formats.read_tum,
    "transforms": formats.read_transforms,
    "scannet": formats.read_scannet,
    "record3d": formats.read_record3d,
    "arkit": formats.read_arkit,
    "matrices": formats.read_matrices,
    "euroc": formats.read_euroc,
    "stray": formats.read_stray,
    "arkitscenes": formats.read_traj,
    "scannetpp": formats.read_scannetpp,
    "llff": formats.read_llff,
    "splatting": formats.read_splatting,
    "rows": formats.read_rows,  # a table: tum, euroc or matrices, by its columns
}
# Files of a folder by which a format is recognised, the first that is there
FILES = {
    "transforms": "transforms.json",
    "stray": "odometry.csv",
    "scannetpp": "pose_intrinsic_imu.json",
    "llff": "poses_bounds.npy",
    "splatting": "cameras.json",
    "record3d": "metadata",
}
TABLES = ("poses.txt", "groundtruth.txt", "traj.txt", "poses_c2w.txt")  # TUM; Replica; ours


def read_pose_file(path: Path, fmt: str, size: tuple[int, int]) -> PoseFile:
    """Read a file or folder of poses in one of the formats of READERS, or the one recognised.

    Args:
        size: (w, h) of the images, for formats that do not state it.
    """
    if not path.exists():
        raise ReobjError(f"{path}: no such file; --poses takes auto, none, or a file of poses")
    kinds = _formats_of(path) if fmt == "auto" else {fmt: path}
    name, own = next(iter(kinds.items()))
    reader = READERS.get(name)
    if reader is None:
        raise ReobjError(f"--pose-format {fmt}: unknown; known are auto, {', '.join(READERS)}")
    given = reader(own, size)
    if len(kinds) > 1:
        others = ", ".join(sorted(set(kinds) - {name}))
        note = f"{path}: read as {name}; --pose-format chooses what else is there: {others}"
        given = given.with_messages(note)
    return given


def _formats_of(path: Path) -> dict[str, Path]:
    """Recognise the formats in a folder from the names in it, or that of a file; at least one.

    Returns:
        what each reader is to be given, the likeliest first.
    """
    if not path.is_dir():
        return {_format_of_file(path): path}
    found = {name: path for name, file in FILES.items() if (path / file).is_file()}
    if path.name == "pose" or (path / "pose").is_dir() or any(path.glob("*.pose.txt")):
        found["scannet"] = path
    if formats.arkit_files(path):
        found["arkit"] = path
    if any(path.glob("*.traj")):
        found["arkitscenes"] = path
    if find_models(path):
        found["colmap"] = path
    if (path / "data.csv").is_file():
        found["euroc"] = path
    tables = [path / name for name in TABLES if (path / name).is_file()]
    if tables:
        found["rows"] = tables[0]
    return found or {"colmap": path}


def _format_of_file(path: Path) -> str:
    """Recognise a format from a file's name, of JSON from its keys too."""
    suffixes = {".r3d": "record3d", ".traj": "arkitscenes", ".npy": "llff"}
    if path.name.startswith("images.") or path.suffix == ".bin":
        return "colmap"
    if path.name == "odometry.csv":
        return "stray"
    if path.name == "transforms.json":
        return "transforms"
    if path.suffix == ".json" or path.name == "metadata":
        content = load_json(path)
        if isinstance(content, list):
            return "splatting"
        if isinstance(content, dict) and "poses" in content:
            return "record3d"
        some = next(iter(content.values()), None) if isinstance(content, dict) else None
        if (
            isinstance(some, dict)
            and "frames" not in content
            and {"pose", "aligned_pose"} & set(some)
        ):
            return "scannetpp"
        return "transforms"
    return suffixes.get(path.suffix.lower(), "rows")
