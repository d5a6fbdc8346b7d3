"""Frames without images: numbered as poses and detections of a video speak of them.

Start at `open_video`. What such frames are is said in `sources.imageless`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from reobj.frame_lookup import frames_by_name
from reobj.poses.estimate import PosesConfig
from reobj.poses.intrinsics import stated_camera
from reobj.poses.supplied.frame_assignment import (
    UNITS,
    Source,
    by_numbers,
    numbers_of_names,
    numbers_of_times,
    unit_of_stamps,
)
from reobj.poses.supplied.pose_formats import PoseFile
from reobj.poses.supplied.readers import read_pose_file
from reobj.sources.detection_files import (
    DetectConfig,
    image_names,
    image_size,
    read_detections,
    recorded_times,
)
from reobj.sources.image_files import sorted_names
from reobj.sources.imageless import ImagelessVideo
from reobj.sources.video import InputConfig, Video
from reobj.types import ReobjError


def open_video(
    source: str | Path | int | None,
    config: InputConfig,
    poses: PosesConfig,
    boxes: Any = None,
    detect: DetectConfig | None = None,
) -> Video:
    """Open a video, or without one the frames that detections and poses speak of.

    Args:
        source: as `Video` takes it; None: there is none.
        poses, boxes: file of poses, and of detections or identities; of use without a video.
        detect: how the detections are read.
    Raises:
        ReobjError: no video, and no file of detections, poses or size of the images either;
            options that ask for what is not there.
    """
    if poses.mode == "none" and (poses.depth or poses.metric):
        raise ReobjError("--depth and --metric are said of cameras, and --poses none has none")
    if source is not None:
        return Video(source, config)
    if poses.depth:
        raise ReobjError(f"--depth {poses.depth}: its maps are found by the images; name the video")
    if not isinstance(boxes, str | Path) or not boxes or poses.mode in ("auto", "none"):
        raise ReobjError(
            "no video: name one, or give `run` what needs no images: --detections FILE (or "
            "--tracks FILE), --poses FILE and --camera MODEL WIDTH HEIGHT PARAMS, or a file"
        )
    path, posed, unknown = Path(boxes), poses.mode, (1, 1)
    if not path.exists():
        raise ReobjError(f"{path}: no such file of detections")
    size = image_size(path)
    stated = stated_camera(poses.camera, size)
    size = size or (unknown if stated is None else (stated.width, stated.height))
    given = read_pose_file(Path(posed), poses.fmt, size)
    if size == unknown and (own := next(filter(None, given.cameras), None)) is not None:
        size = (own.width, own.height)
    if size == unknown:
        raise ReobjError(f"{posed}: no image size in it; give --camera MODEL WIDTH HEIGHT PARAMS")
    video = _frames_of(given, path, size, posed, config, detect or DetectConfig())
    video.messages.append(
        f"no images: {video.frame_count} frames of {size[0]}x{size[1]} as {posed} and {path} "
        "have them; tracked by motion and cameras alone, no appearance, no pictures"
    )
    return video


def _frames_of(
    given: PoseFile,
    boxes: Path,
    size: tuple[int, int],
    source: str,
    config: InputConfig,
    detect: DetectConfig,
) -> ImagelessVideo:
    """Number the frames of poses and detections as a folder of their images would be.

    Times in a CSV of detections are those of the frames. Else images of a COCO dataset or of the
    poses, sorted by the numbers in their names, are numbered; if the detections have more frames
    than that, the numbers in the names count. Poses without names: even times from 0 on are
    numbers, anything else is one row a frame.
    """
    if (times_s := recorded_times(boxes)) is not None:
        return ImagelessVideo(source, size, config, times_s=times_s)
    named = {Path(name.replace("\\", "/")).name for name in image_names(boxes)}
    posed = {Path(name).name for name in given.names}
    if named and posed and (frames_by_name(sorted(named), sorted(posed))[0] >= 0).all():
        named = posed  # those of the boxes and more, with their suffixes
    names = sorted_names(named or posed)
    first = ImagelessVideo(source, size, config, names=names if named else ())
    every = dataclasses.replace(detect, min_score=0.0, classes="", max_detections=0)
    found = read_detections(boxes, first, every).frame
    count = int(found.max(initial=-1)) + 1
    if names and count > len(names):
        number = numbers_of_names(names, source)
        frames = Source(np.arange(count), np.arange(count) / 1.0, count)
        ways = [r for r in by_numbers(number, frames, "numbers") if not r.outside]
        if len(ways) != 1:
            last = int(number.max()) + 1
            return ImagelessVideo(source, size, config, count=count if ways else max(count, last))
        names = [names[r] if r >= 0 else "" for r in ways[0].row]
    if names:
        return ImagelessVideo(source, size, config, names=names)
    rows, stamps_s = len(given.cam_from_world), given.stamps
    if stamps_s is not None:
        stamps_s = stamps_s / (
            dict(UNITS)[given.unit] if given.unit else unit_of_stamps(stamps_s)[1]
        )
        number = numbers_of_times(stamps_s)
        times_s = np.interp(np.arange(number[-1] + 1), number, stamps_s)
        rows = len(times_s)
        if count <= rows:
            return ImagelessVideo(source, size, config, times_s=times_s)
    if count > rows:
        what = f"{boxes}: frame {count - 1}, but {source} has {rows} poses without names"
        raise ReobjError(f"{what}; expected a pose for each frame, or a CSV with a `timestamp`")
    return ImagelessVideo(source, size, config, count=rows)
