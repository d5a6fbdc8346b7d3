"""The poses of a run: supplied by the user and checked, from the cache, or reconstructed."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from pathlib import Path

import numpy as np

from reobj.cameras import Poses, import_pycolmap, load_poses, save_poses, write_colmap
from reobj.files import load_cached, load_npz, part_path
from reobj.poses.depth import add_depth
from reobj.poses.estimate import PosesConfig, estimate_poses
from reobj.poses.intrinsics import camera_line, parse_camera
from reobj.poses.sfm import triangulate
from reobj.poses.supplied.interpretation import PoseReading, by_images, by_tracks, check_poses
from reobj.poses.supplied.readers import pose_readings, the_reading
from reobj.results.workspace import Workspace
from reobj.sources.video import Video, source_fingerprint
from reobj.types import ReobjError, Tracks, rows_by


def supplied_poses(video: Video, config: PosesConfig) -> list[PoseReading]:
    """Read poses given by the user, in all the ways that file and images leave open.

    Returns:
        [] if poses are to be reconstructed.
    """
    if config.mode in ("auto", "none"):
        if config.metric:
            raise ReobjError("--metric is said of supplied poses; a reconstruction has no scale")
        return []
    found = pose_readings(
        config.mode, video, config.fmt, config.camera, config.metric, config.frames_by
    )
    return by_images(found, video)


def settled_poses(
    found: list[PoseReading],
    tracks: Tracks,
    video: Video,
    config: PosesConfig,
    workspace: Workspace,
) -> Poses:
    """Decide between readings of supplied poses by tracks, check them, and add points.

    Args:
        tracks: of the video's detections, none where there are none.
    Raises:
        ReobjError: the tracks do not decide, or contradict the poses' direction or axes.
    """
    poses = the_reading(by_tracks(found, tracks), Path(config.mode))
    check_directions(poses, tracks)
    return with_points(poses, video, config, workspace)


def with_points(poses: Poses, video: Video, config: PosesConfig, workspace: Workspace) -> Poses:
    """Add points: from depth maps, where these have none triangulated; or from the cache."""
    if (
        not video.has_images
        or not poses.known.any()
        or (len(poses.visibility) and not config.depth)
    ):
        return poses
    path = _points_path(poses, video, config, workspace)
    if (known := load_cached(path, load_poses)) is not None:
        return known
    size_px, seed = config.size_px, config.seed
    depth_first = bool(config.depth) and poses.metric  # else the maps need points to tell the scale
    if depth_first:
        poses = add_depth(poses, config.depth, video)
    if not len(poses.visibility):
        work = workspace.cache / "sfm"
        poses = triangulate(poses, video, size_px=size_px, seed=seed, work_dir=work)
    if config.depth and not depth_first:
        poses = add_depth(poses, config.depth, video)
    if len(poses.points):
        save_poses(path, poses)
    return poses


def _points_path(poses: Poses, video: Video, config: PosesConfig, workspace: Workspace) -> Path:
    """Return the cached file of poses with their points."""
    maps = source_fingerprint(config.depth.partition(":")[0]) if config.depth else ""
    arrays = (poses.cam_from_world, poses.points, poses.visibility, poses.part)
    digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    facts = (poses.camera, poses.metric, poses.messages)
    content = video.fingerprint
    return workspace.path("points", content, video.config, *facts, config, maps, digest)


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
    Raises:
        ReobjError: no cameras are wanted.
    """
    if config.mode == "none":
        raise ReobjError("--poses none leaves nothing to do: leave it out, or use `track`")
    boxes = np.empty((0, 5))
    if moving is not None and len(moving):
        boxes = np.column_stack([moving.frame, moving.xyxy])
    digest = hashlib.sha256(boxes.round(1).tobytes()).hexdigest()
    if camera := parse_camera(config.camera, video.size):  # the content of a file, not its name
        config = dataclasses.replace(config, camera=camera_line(camera))
    content = video.fingerprint
    own = dataclasses.replace(config, depth="")
    path = workspace.path("poses", content, video.config, own, digest)
    model = path.with_suffix(".sparse")
    if (known := load_cached(path, _load_reconstruction)) is not None:
        models = [part_path(model, k) for k in range(known.part_count)]
        return _with_depth(known, models, video, config, workspace)
    work = workspace.cache / "sfm"
    boxes_of = (lambda frame: boxes[boxes[:, 0] == frame, 1:]) if len(boxes) else None
    poses = estimate_poses(video, config, work, boxes_to_mask=boxes_of)
    if poses.known.any():
        for k in range(poses.part_count):
            shutil.rmtree(part_path(model, k), ignore_errors=True)
            part_path(work / "sparse", k).replace(part_path(model, k))
        save_poses(path, poses, models=_digest_of(model, poses.part_count))
    models = [part_path(model, k) for k in range(poses.part_count)]
    return _with_depth(poses, models, video, config, workspace)


def _load_reconstruction(path: Path) -> Poses:
    """Read cached poses; the models beside them must be those that were written with them."""
    poses, model = load_poses(path), path.with_suffix(".sparse")
    if load_npz(path)[1].get("models") != _digest_of(model, poses.part_count):
        raise ReobjError(f"{model}: damaged, or not there")
    return poses


def _digest_of(model: Path, parts: int) -> str:
    """Hash the files of the COLMAP models of all parts."""
    digest = hashlib.sha256()
    for folder in (part_path(model, k) for k in range(parts)):
        for file in sorted(folder.glob("*")):
            digest.update(f"{folder.name}/{file.name} {file.stat().st_size} ".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def poses_key(poses: Poses | None) -> str:
    """Return what changes with everything that a tracker takes from the poses; "": none."""
    if poses is None:
        return ""
    digest = hashlib.sha256(repr(poses.camera).encode())
    for values in (poses.frame, poses.cam_from_world, poses.part, poses.points, poses.visibility):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _with_depth(
    poses: Poses, models: list[Path], video: Video, config: PosesConfig, workspace: Workspace
) -> tuple[Poses, list[Path]]:
    """Scale a reconstruction by depth maps, with its COLMAP models, and add their points."""
    if not config.depth or not poses.known.any():
        return poses, models
    found = with_points(poses, video, config, workspace)
    if not found.metric:
        return found, models
    pc, scaled = import_pycolmap(), _points_path(poses, video, config, workspace)
    for k, model in enumerate(models):
        of_part = poses.known & (poses.part == k)
        length = [np.linalg.norm(p.cam_from_world[of_part, :, 3]) for p in (found, poses)]
        whole = pc.Reconstruction(str(model))
        whole.transform(pc.Sim3d(length[0] / length[1], pc.Rotation3d(), np.zeros(3)))
        part_path(scaled.with_suffix(".sparse"), k).mkdir(exist_ok=True)
        whole.write(str(part_path(scaled.with_suffix(".sparse"), k)))
    return found, [part_path(scaled.with_suffix(".sparse"), k) for k in range(len(models))]


def write_supplied_model(poses: Poses | None, video: Video, out: Path) -> None:
    """Write sparse/ of supplied poses; a reconstruction has its own, with more in it."""
    if poses is not None and poses.source == "user" and poses.known.any():
        for k in range(poses.part_count):
            part = poses.of_part(k)
            names = [video.name(int(f)) or f"{f:06d}" for f in part.frame]
            write_colmap(part_path(out / "sparse", k), part, names)
