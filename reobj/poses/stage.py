"""The poses of a run: supplied by the user and checked, from the cache, or reconstructed."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from pathlib import Path

import numpy as np

from reobj.cameras import Poses, load_poses, save_poses, write_colmap
from reobj.files import part_path
from reobj.poses.checks import check_poses
from reobj.poses.estimate import PosesConfig, estimate_poses
from reobj.poses.intrinsics import camera_line, parse_camera
from reobj.poses.readers import read_poses
from reobj.results.workspace import Workspace
from reobj.sources.video import Video, source_fingerprint
from reobj.types import ReobjError, Tracks, rows_by


def supplied_poses(video: Video, config: PosesConfig) -> Poses | None:
    """Read poses given by the user; None if they are to be reconstructed."""
    if config.mode in ("auto", "none"):
        if config.metric:
            raise ReobjError("--metric is said of supplied poses; a reconstruction has no scale")
        return None
    return read_poses(config.mode, video, config.fmt, config.camera, config.metric)


def check_directions(poses: Poses, tracks: Tracks) -> None:
    """Refuse supplied poses whose direction or axes contradict the tracks.

    Raises:
        ReobjError: names the likely mistake.
    """
    centers = (tracks.xyxy[:, :2] + tracks.xyxy[:, 2:]) / 2
    rays = [(tracks.frame[rows], centers[rows]) for rows in rows_by(tracks.tracklet_id)]
    if fault := check_poses(poses, rays):
        raise ReobjError(fault)


def reconstruct_cached(
    video: Video, config: PosesConfig, workspace: Workspace, moving: Tracks | None = None
) -> tuple[Poses, list[Path]]:
    """Reconstruct the cameras of a video, or take them from the output folder's cache.

    Args:
        moving: tracks of things that move; nothing on them is matched.
    Returns:
        poses, and the folder of the COLMAP model of each part (missing if the reconstruction
        failed).
    """
    boxes = np.empty((0, 5))
    if moving is not None and len(moving):
        boxes = np.column_stack([moving.frame, moving.xyxy])
    digest = hashlib.sha256(boxes.round(1).tobytes()).hexdigest()
    if camera := parse_camera(config.camera, video.size):  # the content of a file, not its name
        config = dataclasses.replace(config, camera=camera_line(camera))
    content = source_fingerprint(video.source)
    path = workspace.path("poses", content, video.config, config, digest)
    model = path.with_suffix(".sparse")
    if path.exists():
        poses = load_poses(path)
        return poses, [part_path(model, k) for k in range(poses.part_count)]
    work = workspace.cache / "sfm"
    boxes_of = (lambda frame: boxes[boxes[:, 0] == frame, 1:]) if len(boxes) else None
    poses = estimate_poses(video, config, work, boxes_to_mask=boxes_of)
    if poses.known.any():
        for k in range(poses.part_count):
            shutil.rmtree(part_path(model, k), ignore_errors=True)
            part_path(work / "sparse", k).replace(part_path(model, k))
        save_poses(path, poses)
    return poses, [part_path(model, k) for k in range(poses.part_count)]


def poses_key(poses: Poses | None) -> str:
    """Return what changes with everything that a tracker takes from the poses; "": none."""
    if poses is None:
        return ""
    digest = hashlib.sha256(repr(poses.camera).encode())
    for values in (poses.frame, poses.cam_from_world, poses.part, poses.points, poses.visibility):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def write_supplied_model(poses: Poses, video: Video, out: Path) -> None:
    """Write sparse/ of supplied poses; a reconstruction has its own, with more in it."""
    if poses.source == "user" and poses.known.any():
        for k in range(poses.part_count):
            part = poses.of_part(k)
            names = [video.name(int(f)) or f"{f:06d}" for f in part.frame]
            write_colmap(part_path(out / "sparse", k), part, names)
