"""What the export formats take from a result: a component, its upright world, frames, images.

Worlds far from their origin (map projections) are shifted, as float32 has seven digits.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import quadrics
from reobj.cameras import Camera, Poses, camera_parameters, invert_rigid, quat_wxyz_from_matrix
from reobj.files import Progress, spans
from reobj.results.entries import rotation_to_up
from reobj.results.result import Object, Result
from reobj.results.workspace import Workspace
from reobj.sources.image_files import IMAGE_SUFFIXES
from reobj.sources.video import Video
from reobj.types import Array, ReobjError, log

# ---- Components and worlds ---------------------------------------------------------------------


def largest_component(result: Result, path: Path) -> Result:
    """Return the objects and cameras of component 0; warn if there are others."""
    if len(components := result.world.parts) > 1:
        exported = f"component 0 of {len(components)} ({components[0].span_text})"
        log.warning("%s contains %s: the others have other frames and scales", path, exported)
    return result.of_part(0)


def warn_of_components(result: Result, path: Path) -> None:
    """Warn that objects are not joined across components, and list those of each."""
    if len(result.world.parts) > 1:
        ids = [spans(o.id for o in component.objects) or "none" for component in result.parts()]
        lists = [
            f"{component.span_text}: {i}"
            for component, i in zip(result.world.parts, ids, strict=True)
        ]
        text = "; ".join(lists)
        log.warning("%s: objects are not joined across components; objects of %s", path, text)


def far_origin(poses: Poses | None, points: Array) -> Array:
    """Return a point (3,) amid the cameras of a world if its origin is far away, else zeros.

    It is rounded to the power of ten below the extent, for short numbers.

    Args:
        points: (N, 3) of objects, included in the extent.
    """
    if poses is None or not poses.known.any():
        return np.zeros(3)
    eye = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]  # (F, 3)
    middle = np.median(eye, 0)
    extent = float(np.linalg.norm(np.concatenate([eye, points]) - middle, axis=1).max())
    # float32 has 24 bits: 2 ** -24 of 100 extents is 6e-6 of one
    if not np.linalg.norm(middle) > 100 * extent > 0:
        return np.zeros(3)
    step = 10.0 ** math.floor(math.log10(extent))
    return np.asarray(np.round(middle / step) * step)


def shifted(poses: Poses, origin: Array) -> Poses:
    """Return the cameras and points of a world after a shift of its origin to `origin` (3,)."""
    cams = poses.cam_from_world.copy()
    cams[:, :, 3] += cams[:, :, :3] @ origin
    return dataclasses.replace(poses, cam_from_world=cams, points=poses.points - origin)


def centred(component: Result) -> tuple[Result, Array]:
    """Shift the world of a component (`Result.of_part`) if its origin is far away.

    Returns:
        the component, then without fits, and the position (3,) of the new origin in the old world.
    """
    centers = np.array([o.center for o in component.located], np.float64).reshape(-1, 3)
    origin = far_origin(component.poses, centers)
    if component.poses is None or not origin.any():
        return component, origin
    floor = component.world.floor
    if floor is not None:
        offset = floor.offset - float(floor.normal @ origin)
        floor = dataclasses.replace(floor, offset=offset, middle=floor.middle - origin)
    objects = [
        o if o.center is None else dataclasses.replace(o, center=o.center - origin)
        for o in component.objects
    ]
    world = dataclasses.replace(component.world, floor=floor)
    poses = shifted(component.poses, origin)
    return dataclasses.replace(
        component, objects=objects, world=world, poses=poses, fits=None
    ), origin


@dataclass(frozen=True, slots=True, eq=False)
class UprightWorld:
    """The largest component of a result with z up, in metres if the scale is known.

    Attributes:
        objects: the located ones, by id. ellipsoids: (O,) inscribed in their shapes.
        poses: cameras and points; None without cameras.
        scale: metres per unit of the world of poses.txt, 1 if unknown; metric: it is known.
        upright: the direction of gravity is known.
        rotation: (3, 3) of this world from that of poses.txt.
        origin: (3,) of this world in that of poses.txt.
    """

    objects: list[Object]
    ellipsoids: quadrics.Ellipsoids
    poses: Poses | None
    scale: float
    metric: bool
    upright: bool
    rotation: Array
    origin: Array

    @property
    def quat_xyzw(self) -> Array:
        """Rotations (O, 4) of the objects in this world."""
        wxyz = quat_wxyz_from_matrix(self.ellipsoids.world_from_obj)
        return np.roll(wxyz, -1, 1)


def upright_world(
    result: Result, path: Path, float32: bool = False, may_be_empty: bool = False
) -> UprightWorld:
    """Turn and scale the largest component of a result; warn of what is unknown or left out.

    Args:
        path: for messages. float32: the format has float32: a far origin is shifted.
    Raises:
        ReobjError: no objects with a shape and no cameras, unless the world `may_be_empty`.
    """
    component = largest_component(result, path)
    origin = np.zeros(3)
    if float32:
        component, origin = centred(component)
    if origin.any():
        point = ", ".join(f"{value:.12g}" for value in origin)
        log.warning("%s: its origin is %s of the world: the format has float32", path, point)
    poses = component.poses
    scale = component.world.scale
    up = component.world.up_in_world
    metric = scale is not None and scale.source != "none"
    metres = scale.value if scale is not None and metric else 1.0
    if component.located:
        if not metric:
            log.warning("the scale is unknown: %s is not in metres; give --known-size", path)
        if up is None:
            log.warning("up is unknown: %s keeps the world's axes", path)
    elif (poses is None or not poses.known.any()) and not may_be_empty:
        raise ReobjError(f"{path}: nothing to export: the result has no solids and no cameras, see "
                         "`run`")  # fmt: skip
    rotation = rotation_to_up(up)
    ellipsoids = component.ellipsoids()
    turned = quadrics.Ellipsoids(
        metres * ellipsoids.center_in_world @ rotation.T,
        metres * ellipsoids.half_axes,
        rotation @ ellipsoids.world_from_obj,
    )
    if poses is not None:
        # x_cam = R x + t; in metres and for x' = scale * rotation x: R rotation' x' + scale * t
        turned_axes = poses.cam_from_world[:, :, :3] @ rotation.T
        moved = metres * poses.cam_from_world[:, :, 3:]
        cams = np.concatenate([turned_axes, moved], 2)
        points = metres * poses.points @ rotation.T
        poses = dataclasses.replace(poses, cam_from_world=cams, points=points)
    return UprightWorld(
        component.located, turned, poses, metres, metric, up is not None, rotation, origin
    )


def distortion(camera: Camera, names: Sequence[str], path: Path, tool: str) -> dict[str, float]:
    """Return the terms of the distortion that a tool knows by name; warn of others.

    Args:
        names: k1, k2, p1, ... path: for the warning.
    """
    values = dict(zip(camera_parameters(camera.model), camera.params, strict=True))
    terms = {"k1": values.pop("k", 0.0)} | {k: float(v) for k, v in values.items()}
    if any(v for k, v in terms.items() if k not in (*names, "f", "fx", "fy", "cx", "cy")):
        log.warning("%s: %s has no %s cameras: the rest of the distortion is left out",
                    path, tool, camera.model)  # fmt: skip
    return {name: terms.get(name, 0.0) for name in names}


# ---- Video and images --------------------------------------------------------------------------


def video_of(result: Result) -> Video | None:
    """Open the video of a result; None if it was moved or deleted: most exports do not need it."""
    if result.out is not None and (result.out / "cache" / "source.json").is_file():
        with contextlib.suppress(ReobjError):
            return Workspace.open(result.out).video()
    return None


def frames_read(result: Result) -> tuple[list[int], Sequence[str]]:
    """List the frames that were read or have a track (interpolated gaps), ascending.

    Returns:
        source frame numbers, and the image names by frame number ([]: a video, or it is missing).
    """
    video = video_of(result)
    read = np.empty(0, np.int64)
    if result.poses is not None:
        read = result.poses.frame
    elif video is not None and video.frame_count:
        config = video.config
        count = video.frame_count
        read = np.arange(config.start, min(config.stop or count, count), config.every)
    return np.union1d(read, result.tracks.frame).tolist(), video.names if video else []


def label_names(result: Result) -> dict[int, str]:
    """Return the name of the labels of each frame with a track: that of its image, without suffix.

    With the folders below the one that all images have in common. A frame of a video is VIDEO_N, N
    from 1, as ultralytics calls it. Names that were read from a file cannot leave the folder.
    """
    video = video_of(result)
    names: Sequence[str] = [] if video is None else video.names
    if video is not None and video.files:
        common = os.path.commonpath([file.parent for file in video.files])
        names = [os.path.relpath(file, common) for file in video.files]
    stem = Path(result.video.path).stem
    found = {}
    for frame in np.unique(result.tracks.frame).tolist():
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
