"""What the export formats take from a result: a component, its upright world, frames, images."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import quadrics
from reobj.cameras import Poses, quat_wxyz_from_matrix
from reobj.files import Progress, spans
from reobj.results.origin import centred
from reobj.results.result import Object, Result
from reobj.results.upright import rotation_to_up
from reobj.results.workspace import Workspace
from reobj.sources.image_files import IMAGE_SUFFIXES
from reobj.sources.video import Video
from reobj.types import Array, ReobjError, log


def largest_part(result: Result, path: Path) -> Result:
    """Return the objects and cameras of component 0; warn if there are others."""
    if len(parts := result.world.parts) > 1:
        exported = f"component 0 of {len(parts)} ({parts[0].span_text})"
        log.warning("%s contains %s: the others have other frames and scales", path, exported)
    return result.of_part(0)


def warn_of_components(result: Result, path: Path) -> None:
    """Warn that objects are not joined across components, and list those of each."""
    if len(result.world.parts) > 1:
        ids = [spans(o.id for o in part.objects) or "none" for part in result.parts()]
        lists = [f"{part.span_text}: {i}" for part, i in zip(result.world.parts, ids, strict=True)]
        text = "; ".join(lists)
        log.warning("%s: objects are not joined across components; objects of %s", path, text)


def video_of(result: Result) -> Video | None:
    """Open the video of a result; None if it was moved or deleted: most exports do not need it."""
    if result.out is not None and (result.out / "cache" / "source.json").is_file():
        with contextlib.suppress(ReobjError):
            return Workspace.open(result.out).video()
    return None


def frames_read(result: Result) -> tuple[list[int], list[str]]:
    """List the frames that were read or have a track (interpolated gaps), ascending.

    Returns:
        source frame numbers, and the image names by frame number ([]: a video, or it is missing).
    """
    video = video_of(result)
    names = video.names if video is not None else []
    read = np.empty(0, np.int64)
    if result.poses is not None:
        read = result.poses.frame
    elif video is not None and video.frame_count:
        config = video.config
        count = video.frame_count
        read = np.arange(config.start, min(config.stop or count, count), config.every)
    return np.union1d(read, result.tracks.frame).tolist(), names


def upright(result: Result, path: Path) -> tuple[float, Array]:
    """Compute scale and rotation of the world for a viewer; warn if scale or up is unknown.

    Returns:
        metres per unit (1 if unknown), and the rotation (3, 3) from up to z.
    """
    scale = result.world.scale
    up = result.world.up_in_world
    metres = scale.value if scale is not None and scale.source != "none" else None
    if result.located:
        if not metres:
            log.warning("the scale is unknown: %s is not in metres; give --known-size", path)
        if up is None:
            log.warning("up is unknown: %s keeps the world's axes", path)
    return metres or 1.0, rotation_to_up(up)


def warn_of_origin(origin: Array, path: Path) -> None:
    """Warn if the world was shifted, for formats with float32."""
    if origin.any():
        point = ", ".join(f"{value:.12g}" for value in origin)
        log.warning("%s: its origin is %s of the world: the format has float32", path, point)


@dataclass(frozen=True, slots=True, eq=False)
class UprightWorld:
    """The largest component of a result with z up, in metres if the scale is known.

    Attributes:
        objects: the located ones, by id. ellipsoids: (O,) inscribed in their shapes.
        poses: cameras and points; None without cameras.
        scale: metres per unit of the world of poses.txt, 1 if unknown; metric: it is known.
        rotation: (3, 3) of this world from that of poses.txt.
        origin: (3,) of this world in that of poses.txt.
    """

    objects: list[Object]
    ellipsoids: quadrics.Ellipsoids
    poses: Poses | None
    scale: float
    metric: bool
    rotation: Array
    origin: Array

    @property
    def quat_xyzw(self) -> Array:
        """Rotations (O, 4) of the objects in this world."""
        wxyz = quat_wxyz_from_matrix(self.ellipsoids.world_from_obj)
        return np.roll(wxyz, -1, 1)


def upright_world(result: Result, path: Path, float32: bool = False) -> UprightWorld:
    """Turn and scale the largest component of a result; warn of what is unknown or left out.

    Args:
        path: for messages. float32: the format has float32: a far origin is shifted.
    Raises:
        ReobjError: no objects with a shape and no cameras.
    """
    part = largest_part(result, path)
    origin = np.zeros(3)
    if float32:
        part, origin = centred(part)
        warn_of_origin(origin, path)
    poses = part.poses
    if not part.located and (poses is None or not poses.known.any()):
        raise ReobjError(f"{path}: nothing to export: the result has no solids and no cameras, see "
                         "`run`")  # fmt: skip
    scale, rotation = upright(part, path)
    ellipsoids = part.ellipsoids()
    turned = quadrics.Ellipsoids(
        scale * ellipsoids.center_in_world @ rotation.T,
        scale * ellipsoids.half_axes,
        rotation @ ellipsoids.world_from_obj,
    )
    if poses is not None:
        # x_cam = R x + t; in metres and for x' = scale * rotation x: R rotation' x' + scale * t
        turned_axes = poses.cam_from_world[:, :, :3] @ rotation.T
        moved = scale * poses.cam_from_world[:, :, 3:]
        cams = np.concatenate([turned_axes, moved], 2)
        points = scale * poses.points @ rotation.T
        poses = dataclasses.replace(poses, cam_from_world=cams, points=points)
    metric = part.world.scale is not None and part.world.scale.source != "none"
    return UprightWorld(part.located, turned, poses, scale, metric, rotation, origin)


def label_names(result: Result, video: Video | None, frames: Iterable[int]) -> dict[int, str]:
    """Return the name of the labels of each frame, without suffix: that of its image.

    With the folders below the one that all images have in common. A frame of a video is VIDEO_N, N
    from 1, as ultralytics calls it. Names that were read from a file cannot leave the folder.
    """
    names: Sequence[str] = [] if video is None else video.names
    if video is not None and video.files:
        common = os.path.commonpath([file.parent for file in video.files])
        names = [os.path.relpath(file, common) for file in video.files]
    stem = Path(result.video.path).stem
    found = {}
    for frame in sorted(set(frames)):
        path = Path(names[frame] if frame < len(names) else "")
        path = Path(*(part for part in path.parts if part not in ("..", path.anchor)))
        path = path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path
        found[frame] = path.as_posix() if path.parts else f"{stem}_{frame + 1}"
    return found


def formula_safe(value: Any) -> Any:
    """Protect text from evaluation as a formula (CWE-1236: = + - @, tab, carriage return)."""
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@\t\r") else value


def image_files(video: Video, frames: Iterable[int], target: Path, folder: Path) -> dict[int, str]:
    """Return the image files of frames, relative to `target`; write those of a video.

    Args:
        folder: a new one, whose files are moved to `target`.
    """
    wanted = set(frames)
    if video.files:
        return {
            frame: Path(os.path.relpath(video.files[frame], target)).as_posix()
            for frame in sorted(wanted)
        }
    files = {}
    with Progress("images", len(wanted)) as progress:
        for frame in video:
            if frame.index in wanted:
                name = f"images/frame_{frame.index:06d}.jpg"
                image = cv2.resize(frame.image, video.size) if video.scale != 1 else frame.image
                data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
                (folder / name).parent.mkdir(exist_ok=True)
                (folder / name).write_bytes(data.tobytes())
                files[frame.index] = name
                progress.step()
    return files
