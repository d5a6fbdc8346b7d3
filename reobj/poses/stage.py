"""Poses of a run: supplied by the user and checked, reconstructed, or from the cache."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Poses, import_pycolmap, load_poses, save_poses, write_colmap
from reobj.files import Progress, component_path, load_cached, load_npz
from reobj.poses.estimate import PosesConfig, estimate_poses
from reobj.poses.intrinsics import camera_line, parse_camera
from reobj.poses.sfm import CheckMatches, MakeProgress, triangulate
from reobj.poses.supplied.check import Supplied, check_boxes, check_matches, without_frozen
from reobj.poses.supplied.depth import add_depth
from reobj.poses.supplied.pose_formats import UPRIGHT
from reobj.poses.supplied.readers import read_supplied
from reobj.sources.video import Video, source_fingerprint
from reobj.types import ReobjError, Tracks


def supplied_poses(video: Video, config: PosesConfig) -> Supplied | None:
    """Read poses supplied by the user; None: poses are reconstructed, or not wanted."""
    if config.mode in ("auto", "none"):
        if config.metric:
            raise ReobjError(
                "--metric applies to supplied poses only; a reconstruction has unknown scale"
            )
        return None
    return read_supplied(video, config)


def checked_poses(
    supplied: Supplied,
    tracks: Tracks,
    video: Video,
    config: PosesConfig,
    workspace: Any,
    progress: MakeProgress = Progress,
) -> Poses:
    """Check supplied poses against images or, without matches in them, tracks; add points.

    Args:
        tracks: of the video's detections; may be empty.
        workspace: a `Workspace` (`results.workspace`): where stages keep their results.
    Raises:
        ReobjError: images or tracks contradict the poses.
    """
    poses = without_frozen(supplied.poses, tracks)
    supplied = dataclasses.replace(supplied, poses=poses)
    confirmed = check_boxes(supplied, tracks, refuse=False)
    check = functools.partial(check_matches, supplied, confirmed)
    found = with_points(poses, video, config, workspace, progress, check)
    if len(poses.visibility) or config.depth or not len(found.visibility):  # not by images
        check_boxes(supplied, tracks)
    return found


def with_points(
    poses: Poses,
    video: Video,
    config: PosesConfig,
    workspace: Any,
    progress: MakeProgress,
    check: CheckMatches = lambda *_: np.nan,
) -> Poses:
    """Add points to poses: triangulated where they have none, from depth maps, or cached.

    Args:
        check: refuses poses that contradict matched features.
    """
    has_points = len(poses.visibility) > 0
    if not video.has_images or not poses.known.any() or (has_points and not config.depth):
        return poses
    path = _points_path(poses, video, config, workspace)
    if (cached := load_cached(path, load_poses)) is not None:
        return cached
    depth_first = bool(config.depth) and poses.metric  # else the scale is estimated from points
    if depth_first:
        poses = add_depth(poses, config.depth, video)
    if not len(poses.visibility):
        poses = triangulate(
            poses,
            video,
            size_px=config.size_px,
            seed=config.seed,
            work_dir=workspace.cache / "sfm",
            progress=progress,
            check=check,
        )
    if config.depth and not depth_first:
        poses = add_depth(poses, config.depth, video)
    if len(poses.points):
        save_poses(path, poses)
    return poses


def _points_path(poses: Poses, video: Video, config: PosesConfig, workspace: Any) -> Path:
    """Return the cache file of poses with points."""
    maps = source_fingerprint(config.depth.partition(":")[0]) if config.depth else ""
    arrays = (poses.cam_from_world, poses.points, poses.visibility, poses.part)
    digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    key = (poses.camera, poses.metric, poses.messages, config, maps, digest)
    path: Path = workspace.path("points", video.fingerprint, video.config, *key)
    return path


def reconstruct_cached(
    video: Video,
    config: PosesConfig,
    workspace: Any,
    moving: Tracks | None = None,
    progress: MakeProgress = Progress,
) -> tuple[Poses, list[Path]]:
    """Reconstruct the cameras of a video, or take them from the output folder's cache.

    Args:
        workspace: as of `checked_poses`.
        moving: tracks of moving objects, where no features are used.
        progress: makes the progress line of a step from its name and total.
    Returns:
        poses, and the folder of the COLMAP model of each component of the trajectory (missing if
        the reconstruction failed).
    Raises:
        ReobjError: `--poses none`.
    """
    if config.mode == "none":
        raise ReobjError("--poses none leaves nothing to do: leave it out, or use `track`")
    moving = Tracks.empty() if moving is None else moving
    boxes = np.column_stack([moving.frame, moving.xyxy])  # (N, 5)
    digest = hashlib.sha256(boxes.round(1).tobytes()).hexdigest()
    camera = parse_camera(config.camera, video.size, config.camera_format)
    if camera is not None:  # a file's content, not its name
        config = dataclasses.replace(config, camera=camera_line(camera))
    without_depth = dataclasses.replace(config, depth="")
    path = workspace.path("poses", video.fingerprint, video.config, without_depth, digest)
    model = path.with_suffix(".sparse")
    poses = load_cached(path, _load_reconstruction)
    if poses is None:
        work_dir = workspace.cache / "sfm"
        boxes_of = (lambda frame: boxes[boxes[:, 0] == frame, 1:]) if len(boxes) else None
        poses = estimate_poses(video, config, work_dir, progress=progress, boxes_to_mask=boxes_of)
        for k in range(poses.part_count if poses.known.any() else 0):
            shutil.rmtree(component_path(model, k), ignore_errors=True)
            component_path(work_dir / "sparse", k).replace(component_path(model, k))
        if poses.known.any():
            save_poses(path, poses, models=_digest_of(model, poses.part_count))
    models = [component_path(model, k) for k in range(poses.part_count)]
    return _with_depth(poses, models, video, config, workspace, progress)


def _load_reconstruction(path: Path) -> Poses:
    """Read cached poses; the models beside them must have been written with them."""
    poses = load_poses(path)
    model = path.with_suffix(".sparse")
    if load_npz(path)[1].get("models") != _digest_of(model, poses.part_count):
        raise ReobjError(f"{model}: damaged or missing")
    return poses


def _digest_of(model: Path, components: int) -> str:
    """Hash the files of the COLMAP models of all components."""
    digest = hashlib.sha256()
    for folder in (component_path(model, k) for k in range(components)):
        for file in sorted(folder.glob("*")):
            digest.update(f"{folder.name}/{file.name} {file.stat().st_size} ".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def poses_key(poses: Poses | None) -> str:
    """Hash everything that a tracker uses of the poses; "" of None."""
    if poses is None:
        return ""
    digest = hashlib.sha256(repr(poses.camera).encode())
    for values in (poses.frame, poses.cam_from_world, poses.part, poses.points, poses.visibility):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _with_depth(
    poses: Poses,
    models: list[Path],
    video: Video,
    config: PosesConfig,
    workspace: Any,
    progress: MakeProgress,
) -> tuple[Poses, list[Path]]:
    """Scale a reconstruction by depth maps, with its COLMAP models, and add their points."""
    if not config.depth or not poses.known.any():
        return poses, models
    scaled = with_points(poses, video, config, workspace, progress)
    if not scaled.metric:
        return scaled, models
    pc = import_pycolmap()
    path = _points_path(poses, video, config, workspace).with_suffix(".sparse")
    folders = [component_path(path, k) for k in range(len(models))]
    for k, (model, folder) in enumerate(zip(models, folders, strict=True)):
        rows = poses.known & (poses.part == k)
        lengths = [np.linalg.norm(p.cam_from_world[rows, :, 3]) for p in (scaled, poses)]
        reconstruction = pc.Reconstruction(str(model))
        similarity = pc.Sim3d(lengths[0] / lengths[1], pc.Rotation3d(), np.zeros(3))
        reconstruction.transform(similarity)
        folder.mkdir(exist_ok=True)
        reconstruction.write(str(folder))
    return scaled, folders


def write_supplied_model(poses: Poses | None, video: Video, out: Path) -> None:
    """Write sparse/ of supplied poses, and mark it, or a reconstruction's, as of upright photos."""
    for k in range(0 if poses is None else poses.part_count):
        folder = component_path(out / "sparse", k)
        if poses is not None and poses.source == "user" and poses.known.any():
            component = poses.of_part(k)
            names = [video.name(int(f)) or f"{f:06d}" for f in component.frame]
            write_colmap(folder, component, names)
        if folder.is_dir():
            (folder / UPRIGHT).write_text("cameras of upright photos: EXIF orientations applied\n")
