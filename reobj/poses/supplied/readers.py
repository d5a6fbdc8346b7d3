"""Read the poses of a video's frames from files of other tools.

The reader of each format converts its conventions to cam_from_world, OpenCV axes, COLMAP pixels
(`pose_formats`, `colmap_model`); poses are then assigned to frames (`frame_assignment`). Whether
the file follows its conventions is checked later, against the tracks (`interpretation`).
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
    FrameAssignment,
    SourceFrames,
    assignments,
    interpolated,
    source_of,
    unit_of_stamps,
)
from reobj.poses.supplied.interpretation import PoseReading, by_images
from reobj.poses.supplied.pose_formats import PoseFile, one_camera
from reobj.sources.image_files import TimeUnit
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
        camera: intrinsics in place of the file's, in the forms of `--camera`.
        metric: the poses are in metres, whatever the format.
        frames_by: the assignment to frames, where the file is ambiguous: `number0`, `number1`,
            `time`, ... as listed in the error.
    Returns:
        poses of all frames, NaN where the file has none (counted in `messages`).
    Raises:
        ReobjError: damaged, unknown, not rigid, without intrinsics, of another video, or with
            several readings between which the images do not decide.
    """
    readings = pose_readings(path, video, fmt, camera, metric, frames_by)
    return the_reading(by_images(readings, video), Path(path))


def the_reading(readings: list[PoseReading], path: Path) -> Poses:
    """Return the poses of the only reading; refuse several."""
    if len(readings) > 1:
        choices = "; or ".join(f"{reading.key} ({reading.rule})" for reading in readings)
        raise ReobjError(
            f"{path}: its poses can be assigned to frames in {len(readings)} ways, and neither "
            f"images nor tracks show which is right: {choices}; choose with --set "
            f"poses.frames_by={readings[0].key}"
        )
    return readings[0].described_poses


def pose_readings(
    path: str | Path,
    video: Any,
    fmt: str = "auto",
    camera: str = "",
    metric: bool = False,
    frames_by: str = "",
) -> list[PoseReading]:
    """Read poses as `read_poses` does; all readings that the file allows, at least one."""
    path = Path(path)
    size = (int(video.size[0]), int(video.size[1]))
    pose_file = read_pose_file(path, fmt, size)
    stated = parse_camera(camera, size)
    if stated is None and not any(pose_file.cameras):
        raise ReobjError(f"{path}: no intrinsics; add --camera {CAMERA_FORMS}")
    times = [(frame.index, frame.time_s) for frame in video]
    if not times:
        raise ReobjError("no readable frame in the video, so no pose can be matched")
    frame = np.array([n for n, _ in times], np.int64)
    time_s = np.array([t for _, t in times])
    source = source_of(video, frame, time_s)
    stamps_s, messages = _in_seconds(pose_file, path, source)
    count = len(pose_file.cam_from_world)
    candidates = assignments(count, pose_file.names, stamps_s, source, str(path), pose_file.is_ours)
    if not candidates:
        compared = _compared(pose_file, stamps_s, source)
        raise ReobjError(f"{path}: none of its {count} poses belongs to a frame ({compared})")
    rows = np.unique(np.concatenate([candidate.row for candidate in candidates]))
    intrinsics = stated
    if intrinsics is None:
        intrinsics = _intrinsics(pose_file, rows[rows >= 0], size, path)
    if not usable(intrinsics):
        raise ReobjError(f"{path}: {intrinsics}: expected finite numbers, focal lengths above 0")
    orders = {"": pose_file.cam_from_world}
    if pose_file.w_first is not None:
        orders = {"w_last": pose_file.cam_from_world, "w_first": pose_file.w_first}
    readings = []
    for candidate, (order, by_order) in itertools.product(candidates, orders.items()):
        cam_from_world, lost = _of_frames(by_order, stamps_s, candidate, source, path)
        status = np.where(np.isfinite(cam_from_world).all((1, 2)), "supplied", "none")
        poses = Poses(
            intrinsics, frame, time_s, cam_from_world, status, "user",
            metric=pose_file.metric or metric, up_in_world=pose_file.up_in_world,
            points=pose_file.points, colors=pose_file.colors,
            visibility=_in_frames(pose_file.visibility, candidate.row),
            messages=(*pose_file.messages, *messages, *lost),
        )  # fmt: skip
        key = f"{candidate.key}.{order}".rstrip(".")
        rule = f"{candidate.rule}, quaternions {order}".removesuffix(", quaternions ")
        readings.append(PoseReading(key, rule, poses, pose_file.kind))
    keys = ", ".join(reading.key for reading in readings)
    if frames_by and not (readings := [r for r in readings if r.key == frames_by]):
        raise ReobjError(f"--set poses.frames_by={frames_by}: {path} can be read by {keys}")
    return readings


def _in_seconds(
    pose_file: PoseFile, path: Path, source: SourceFrames
) -> tuple[Array | None, tuple[str, ...]]:
    """Convert the stamps (N,) of a file to seconds; report the unit if it was inferred."""
    if pose_file.stamps is None:
        return None, ()
    if pose_file.unit:
        return pose_file.stamps / TimeUnit[pose_file.unit].value, ()
    end_s = float(source.time_s[-1]) if source.timed else 0.0
    unit = unit_of_stamps(pose_file.stamps, end_s)
    messages = () if unit is TimeUnit.s else (f"{path}: time stamps taken for {unit.name}",)
    return pose_file.stamps / unit.value, messages


def _intrinsics(pose_file: PoseFile, rows: IntArray, size: tuple[int, int], path: Path) -> Camera:
    """Return the one camera of the poses in these rows, for frames of (w, h) `size`."""
    cameras = pose_file.cameras
    if len(cameras) == len(pose_file.cam_from_world):
        cameras = tuple(cameras[row] for row in rows)
    camera = one_camera(cameras, path)
    if camera is None:
        raise ReobjError(f"{path}: no intrinsics; add --camera {CAMERA_FORMS}")
    return fitted_camera(camera, size, str(path))


def _of_frames(
    cam_from_world: Array,
    stamps_s: Array | None,
    assignment: FrameAssignment,
    source: SourceFrames,
    path: Path,
) -> tuple[Array, list[str]]:
    """Return the poses (F, 3, 4) of the frames by one assignment, and report frames without one."""
    row = assignment.row
    known = row >= 0
    poses = np.full((len(row), 3, 4), np.nan)
    poses[known] = cam_from_world[row[known]]
    if assignment.key == "time" and stamps_s is not None and len(stamps_s) > 1:
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


def _compared(pose_file: PoseFile, stamps_s: Array | None, source: SourceFrames) -> str:
    """Describe what was compared without a match, for a message."""
    if pose_file.names:
        first = source.images[int(source.frame[0])] if source.images else int(source.frame[0])
        return f"images {pose_file.names[0]!r} ..., frames {first!r} ..."
    if stamps_s is None:
        return "in order"
    start, end = source.time_s[[0, -1]]
    frames = f"frames {start:.3f}-{end:.3f} s" if source.timed else "the images have no times"
    return (
        f"{stamps_s[0]:.3f}-{stamps_s[-1]:.3f} s, {frames}; stamps of another clock need one row "
        "for each frame"
    )


def _in_frames(visibility: IntArray, row: IntArray) -> IntArray:
    """Replace rows of poses (M, 2) by those of their frames; poses without a frame are dropped."""
    frame_of = np.full(int(max(row.max(initial=-1), visibility[:, 0].max(initial=-1))) + 1, -1)
    frame_of[row[row >= 0]] = np.flatnonzero(row >= 0)
    frame = frame_of[visibility[:, 0]]
    return np.column_stack([frame, visibility[:, 1]])[frame >= 0]


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


def read_pose_file(path: Path, fmt: str, size: tuple[int, int]) -> PoseFile:
    """Read a file or folder of poses in a format of READERS, or recognise it.

    Args:
        size: (w, h) of the images, for formats that do not state it.
    """
    if not path.exists():
        raise ReobjError(f"{path}: no such file; --poses takes auto, none, or a file of poses")
    formats_of = _recognise(path) if fmt == "auto" else {fmt: path}
    name, file = next(iter(formats_of.items()))
    reader = READERS.get(name)
    if reader is None:
        raise ReobjError(f"--pose-format {fmt}: unknown; expected auto, {', '.join(READERS)}")
    pose_file = reader(file, size)
    if len(formats_of) > 1:
        others = ", ".join(sorted(set(formats_of) - {name}))
        note = f"{path}: read as {name}; it also has {others}: choose with --pose-format"
        pose_file = pose_file.with_messages(note)
    return pose_file


def _recognise(path: Path) -> dict[str, Path]:
    """Recognise the formats in a folder by its file names, or that of a file; at least one.

    Returns:
        the path for the reader of each format, the likeliest first.
    """
    if not path.is_dir():
        return {_format_of_file(path): path}
    file_of = {
        "transforms": "transforms.json",
        "stray": "odometry.csv",
        "scannetpp": "pose_intrinsic_imu.json",
        "llff": "poses_bounds.npy",
        "splatting": "cameras.json",
        "record3d": "metadata",
    }
    found = {name: path for name, file in file_of.items() if (path / file).is_file()}
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
    names = ("poses.txt", "groundtruth.txt", "traj.txt", "poses_c2w.txt")  # TUM; Replica; ours
    tables = [path / name for name in names if (path / name).is_file()]
    if tables:
        found["rows"] = tables[0]
    return found or {"colmap": path}


def _format_of_file(path: Path) -> str:
    """Recognise the format of a file by its name; of JSON also by its keys."""
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
        first = next(iter(content.values()), None) if isinstance(content, dict) else None
        if (
            isinstance(first, dict)
            and "frames" not in content
            and {"pose", "aligned_pose"} & set(first)
        ):
            return "scannetpp"
        return "transforms"
    return suffixes.get(path.suffix.lower(), "rows")
