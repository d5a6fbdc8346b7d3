"""Frames without images (`sources.imageless`), numbered as in the files of poses and detections.

Start at `open_video`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from reobj.formats import frames_by_name
from reobj.poses.estimate import PosesConfig
from reobj.poses.intrinsics import stated_camera
from reobj.poses.supplied.frame_assignment import (
    SourceFrames,
    by_numbers,
    numbers_of_names,
    numbers_of_times,
    seconds_of,
)
from reobj.poses.supplied.pose_formats import PoseFile
from reobj.poses.supplied.readers import read_pose_file
from reobj.sources.detection_files import (
    DetectConfig,
    described_images,
    read_detections,
)
from reobj.sources.image_files import sorted_names
from reobj.sources.imageless import ImagelessVideo
from reobj.sources.video import InputConfig, Video
from reobj.types import NOTE_START, ReobjError


def open_video(
    source: Video | str | Path | int | None,
    config: InputConfig,
    poses: PosesConfig,
    boxes: Any = None,
    detect: DetectConfig | None = None,
) -> Video:
    """Open a video, or without one the frames of the files of detections and poses.

    Args:
        source: a `Video`, or its source; None: there is none.
        poses, boxes: file of poses, and of detections or identities; used without a video.
        detect: how the detections are read.
    Raises:
        ReobjError: no video, and no file of detections, poses or size of the images either;
            options that need a video or camera poses.
    """
    if poses.mode == "none" and (poses.depth or poses.metric):
        raise ReobjError("--depth and --metric need camera poses, but --poses is none")
    if isinstance(source, Video):
        return source
    if source is not None:
        return Video(source, config)
    if poses.depth:
        raise ReobjError(f"--depth {poses.depth}: depth maps are matched to images; name the video")
    if not isinstance(boxes, str | Path) or not boxes or poses.mode in ("auto", "none"):
        raise ReobjError(
            "no video: name one, or use `run` without images: --detections FILE (or --tracks "
            "FILE), --poses FILE and --camera MODEL WIDTH HEIGHT PARAMS, or a file"
        )
    path = Path(boxes)
    unknown = (1, 1)
    if not path.exists():
        raise ReobjError(f"{path} does not exist")
    detect = detect or DetectConfig()
    size = described_images(path, detect)[0]
    stated = stated_camera(poses.camera, size, poses.camera_format)
    size = size or (unknown if stated is None else (stated.width, stated.height))
    pose_file = read_pose_file(Path(poses.mode), poses.fmt, size)
    if size == unknown and (camera := next(filter(None, pose_file.cameras), None)) is not None:
        size = (camera.width, camera.height)
    if size == unknown:
        raise ReobjError(
            f"{poses.mode}: no image size in it; give --camera MODEL WIDTH HEIGHT PARAMS"
        )
    video = _frames_of(pose_file, path, size, poses.mode, config, detect)
    video.messages.append(
        f"{NOTE_START}no images: {video.frame_count} frames of {size[0]}x{size[1]} from "
        f"{poses.mode} and {path}; tracked by motion and cameras alone, without appearance and "
        "overlay video"
    )
    return video


def _frames_of(
    pose_file: PoseFile,
    boxes: Path,
    size: tuple[int, int],
    source: str,
    config: InputConfig,
    detect: DetectConfig,
) -> ImagelessVideo:
    """Number the frames of poses and detections as a folder of their images would be.

    Times in a CSV of detections are those of the frames. Else images of a COCO dataset or of the
    poses are numbered in the order of the numbers in their names; if the detections have more
    frames, by these numbers. Poses without names: evenly spaced times from 0 on are numbers;
    otherwise each row is one frame.
    """
    _, given, times_s = described_images(boxes, detect)
    if times_s is not None:
        return ImagelessVideo(source, size, config, times_s=times_s)
    named = {Path(name.replace("\\", "/")).name for name in given}
    posed = {Path(name).name for name in pose_file.names}
    if named and posed and (frames_by_name(sorted(named), sorted(posed))[0] >= 0).all():
        named = posed  # all of the detections' images and more, with suffixes
    names = sorted_names(named or posed)
    first = ImagelessVideo(source, size, config, names=names if named else ())
    unfiltered = dataclasses.replace(detect, min_score=0.0, classes="", max_detections=0)
    count = int(read_detections(boxes, first, unfiltered).frame.max(initial=-1)) + 1
    if names and count > len(names):
        number = numbers_of_names(names, source)
        frames = SourceFrames(np.arange(count), np.arange(count) / 1.0, count)
        inside = [a for a in by_numbers(number, frames, "numbers") if not a.outside]
        if len(inside) != 1:
            last = int(number.max()) + 1
            return ImagelessVideo(source, size, config, count=count if inside else max(count, last))
        names = [names[row] if row >= 0 else "" for row in inside[0].row]
    if names:
        return ImagelessVideo(source, size, config, names=names)
    rows = len(pose_file.cam_from_world)
    stamps = pose_file.stamps
    if stamps is not None:
        stamps_s = seconds_of(stamps, pose_file.unit)
        number = numbers_of_times(stamps_s)
        times_s = np.interp(np.arange(number[-1] + 1), number, stamps_s)
        rows = len(times_s)
        if count <= rows:
            return ImagelessVideo(source, size, config, times_s=times_s)
    if count > rows:
        raise ReobjError(
            f"{boxes}: frame {count - 1}, but {source} has {rows} poses without names; expected a "
            "pose for each frame, or a CSV with a `timestamp`"
        )
    return ImagelessVideo(source, size, config, count=rows)
