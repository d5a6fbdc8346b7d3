"""Poses of all frames of a video: keyframes, their reconstruction, the frames between them.

The chain alone; its links are `keyframes`, `mapping` and `localize`. Poses made elsewhere are read
by `readers`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, import_pycolmap, parse_camera, read_sparse_model
from reobj.files import Progress, spans
from reobj.poses.keyframes import MAX_FLOW, MIN_FLOW, ResizedFrame, ResizedVideo, pick_keyframes
from reobj.poses.localize import fill_gaps, locate_between
from reobj.poses.mapping import FOCAL_GUESS, reconstruct
from reobj.types import Array, BoolArray, IntArray, ReobjError, option


@dataclass(frozen=True, slots=True)
class PosesConfig:
    """Camera poses: where they come from, and how much is spent on a reconstruction."""

    mode: str = option(
        "auto",
        "auto: reconstruct them; none: identities in 2D only; or a file or folder of poses",
        "--poses",
    )
    fmt: str = option(
        "auto",
        "format of supplied poses: auto, colmap, tum, transforms, scannet, record3d",
        "--pose-format",
    )
    camera: str = option(
        "",
        "intrinsics: fx,fy,cx,cy[,k1,k2,p1,p2] in native pixels (COLMAP: centre + .5)",
        "--camera",
    )
    depth: str = option(
        "",
        "folder of depth maps, 16-bit PNG in mm, or FOLDER:UNITS per metre: points, metric scale",
        "--depth",
    )
    size_px: int = option(640, "longer side to which frames are shrunk for the reconstruction, px")
    max_gap: int = option(
        15, "most lost frames in a row that are interpolated (and marked `interpolated`)"
    )
    seed: int = option(0, "random seed of the reconstruction")


def estimate_poses(
    video: Any,
    config: PosesConfig,
    work_dir: Path,
    progress: Callable[[str, int], Progress] = Progress,
    boxes_to_mask: Callable[[int], Array] | None = None,
) -> Poses:
    """Reconstruct the cameras of a video of a static scene.

    Args:
        video: a `Video`, iterated several times.
        work_dir: receives `sparse/` (COLMAP model of the keyframes, native pixels) and
            `pycolmap.log`.
        progress: makes the progress line of a stage from its name and total.
        boxes_to_mask: frame number -> (N, 4) xyxy boxes of moving things in native pixels, left out
            of the features.
    Returns:
        a pose for every frame that could be located, in the reconstruction's own world and scale. A
        failed reconstruction is no exception: all poses are NaN and `messages` say why and what
        helps.
    """
    if getattr(video, "is_live", False):
        raise ReobjError("a live camera gives no poses: record a video first, or --poses none")
    size = (int(video.size[0]), int(video.size[1]))
    camera, resized = parse_camera(config.camera, size), ResizedVideo(video, config.size_px)
    line = progress("keyframes", video.expected)
    keys = _enough_keyframes(resized, MAX_KEYFRAMES, line)
    images, names = [key.bgr for key in keys], [_frame_name(video, key.frame) for key in keys]
    boxes = [
        np.empty((0, 4)) if boxes_to_mask is None else np.reshape(boxes_to_mask(k.frame), (-1, 4))
        for k in keys
    ]
    messages = reconstruct(
        images,
        names,
        boxes,
        size,
        camera=camera,
        focal_guesses=[] if camera else [*filter(None, [_exif_focal(video)]), FOCAL_GUESS],
        seed=config.seed,
        work_dir=work_dir,
        progress=progress,
    )
    frame, time_s = np.array(resized.frames, np.int64), np.array(resized.times_s, np.float64)
    if not (work_dir / "sparse").exists():
        shutil.rmtree(work_dir / "mapping", ignore_errors=True)
        guess = (FOCAL_GUESS * max(size), size[0] / 2, size[1] / 2)
        camera = camera or Camera("SIMPLE_PINHOLE", *size, guess)
        nothing, none = np.full((len(frame), 3, 4), np.nan), np.full(len(frame), "none")
        return Poses(camera, frame, time_s, nothing, none, "none", messages=tuple(messages))
    model = read_sparse_model(work_dir / "sparse")
    row_of = {_frame_name(video, number): row for row, number in enumerate(resized.frames)}
    key_rows = np.array([row_of[name] for name in model.names])
    line = progress("pnp", len(frame))
    cam_from_world, status = locate_between(model, key_rows, resized, config.seed, line)
    cam_from_world, status = fill_gaps(frame, cam_from_world, status, config.max_gap)
    shutil.rmtree(work_dir / "mapping")
    found = (model.cameras[0], frame, time_s, cam_from_world, status, "pycolmap")
    seen = np.column_stack([key_rows[model.obs_image], model.obs_point])
    poses = Poses(*found, points=model.points, colors=model.colors, visibility=seen)
    messages += _lost_frames(frame, poses.known)
    return dataclasses.replace(poses, messages=tuple(messages))


MAX_KEYFRAMES = 150  # a longer way takes wider steps (chosen: time)
MIN_KEYFRAMES = 40  # below, the spacing is halved as long as there is motion (chosen)


def _enough_keyframes(video: ResizedVideo, most: int, line: Progress) -> list[ResizedFrame]:
    """Pick keyframes, at half the flow for as long as they are fewer than MIN_KEYFRAMES."""
    keys, max_flow = pick_keyframes(video.first_pass(line), most), MAX_FLOW
    wanted = min(MIN_KEYFRAMES, len(video.frames), most // 2)  # thinning leaves half of them
    while len(keys) < wanted and max_flow > 2 * MIN_FLOW:
        max_flow /= 2
        keys = pick_keyframes(video, most, max_flow)
    if not keys:
        raise ReobjError("the video has no frame that can be read: nothing to reconstruct")
    return keys


def _frame_name(video: Any, number: int) -> str:
    return str(video.names[number]) if video.names else f"frame_{number:06d}.jpg"


def _exif_focal(video: Any) -> float:
    """Read the focal length over the longer side from the first photo's EXIF; 0: there is none."""
    for path in video.files[:1]:
        with contextlib.suppress(ValueError, RuntimeError):  # formats that pycolmap cannot read
            camera = import_pycolmap().infer_camera_from_image(str(path))
            if camera.has_prior_focal_length:
                return float(camera.mean_focal_length() / max(camera.width, camera.height))
    return 0.0


def _lost_frames(frame: IntArray, known: BoolArray) -> list[str]:
    """Say which frames have no pose and what helps; [] if all have one."""
    if known.all():
        return []
    step = int(np.median(np.diff(frame))) if len(frame) > 1 else 1
    return [
        f"{(~known).sum()} of {len(frame)} frames have no pose (frames "
        f"{spans(frame[~known].tolist(), step)}): these parts do not connect to the rest; slower "
        "turns, fewer blurred frames and more texture help, or give --poses"
    ]
