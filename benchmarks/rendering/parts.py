"""Render a walk in parts, in as many processes, and join the parts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from rendering.camera import camera_matrix
from rendering.config import Array, DetectorConfig, RoomConfig
from rendering.detector import simulate_detections
from rendering.flat import Flat, make_flat, plan_flat, visible_part
from rendering.photograph import Frame, render_frame
from rendering.walk import walk_path
from rendering.writers import (
    PackedDetections,
    VideoSink,
    camera_line,
    mot_lines,
    objects_json,
    pack_detections,
    save_detections,
    show_progress,
    tum_line,
)

VIDEO = "room.mp4"  # names as those of render_room.py
DETECTIONS = "detections.npz"
MOT = "gt_mot.txt"
POSES = "poses.txt"


@dataclass(frozen=True, slots=True)
class Clip:
    """A walk and which of its frames are rendered."""

    config: RoomConfig  # of all frames of the path
    rooms: int
    stride: int = 1

    def numbers(self, part: int = 1, parts: int = 1) -> list[int]:
        """Frames of the path that the part-th (from 1) of equal parts renders."""
        whole = np.arange(0, self.config.frames, self.stride)
        return [int(n) for n in np.array_split(whole, parts)[part - 1]]

    def settings(self) -> dict[str, Any]:
        """What must be the same in all parts."""
        found = {**asdict(self.config), "rooms": self.rooms, "stride": self.stride}
        return dict(json.loads(json.dumps(found)))  # tuples become lists, as in a file


def flat_frame(flat: Flat, config: RoomConfig, poses: Array, number: int) -> Frame:
    """One frame of the path; it depends on the config and its number only."""
    K = camera_matrix(config)
    n = config.supersample
    size = (n * config.width, n * config.height)
    drawn = visible_part(flat, np.diag([n, n, 1.0]) @ K, poses[number], size)
    return render_frame(flat.room, config, number, poses, drawn)


def file_name(part: int | None, name: str) -> str:
    """`name`, or that of a part's file."""
    return name if part is None else f"part-{part}.{name}"


def flat_truth(flat: Flat, clip: Clip) -> dict[str, Any]:
    """For `gt_objects.json`: as of one room, with the room of every object, rooms and doors."""
    frames = len(clip.numbers())
    rate = clip.config.fps / clip.stride
    truth = objects_json(flat.room, replace(clip.config, frames=frames, fps=rate))
    for item, room in zip(truth["objects"], flat.room_of_object, strict=True):
        item["room"] = room + 1
    truth["rooms"] = [
        {"center": offset.round(6).tolist(), "size_m": size.round(6).tolist()}
        for offset, size in zip(flat.offsets, flat.sizes, strict=True)
    ]
    truth["doors"] = flat.doors.round(6).tolist()
    truth["path"] = {"frames": clip.config.frames, "fps": clip.config.fps, "stride": clip.stride}
    return truth


def write_part(
    out: Path, clip: Clip, part: int | None = None, parts: int = 1, crf: int | None = None
) -> dict[str, int]:
    """Render one part of a walk, or the whole walk without a part, into a folder.

    Raises: ValueError if the clip is too short for the walk.
    """
    config = clip.config
    poses = walk_path(config, *plan_flat(config, clip.rooms))
    out.mkdir(parents=True, exist_ok=True)
    marker = out / file_name(part, "done.json")
    marker.unlink(missing_ok=True)
    flat = make_flat(config, clip.rooms)
    numbers = clip.numbers(1 if part is None else part, parts)
    first = 0 if part is None else sum(len(clip.numbers(i, parts)) for i in range(1, part))
    size = (config.width, config.height)
    counts = {"frames": len(numbers), "objects": len(flat.room.objects), "boxes": 0}
    found: list[PackedDetections] = []
    video_config = replace(config, fps=config.fps / clip.stride)
    writer = VideoSink(out / file_name(part, VIDEO), video_config, crf)
    with (
        (out / file_name(part, MOT)).open("w") as mot,
        (out / file_name(part, POSES)).open("w") as tum,
    ):
        for done, number in enumerate(numbers):
            frame = flat_frame(flat, config, poses, number)
            writer.write(frame.image)
            rng = np.random.default_rng([config.seed, 5, number])
            detector = DetectorConfig()
            seen = simulate_detections(flat.room, frame.truth, frame.instance, detector, rng)
            found.append(pack_detections(seen))
            lines = mot_lines(first + done, frame.truth, flat.room, size)
            mot.writelines(f"{line}\n" for line in lines)
            tum.write(tum_line(number / config.fps, frame.cam_from_world) + "\n")
            counts["boxes"] += len(lines)
            show_progress(done + 1, len(numbers))
    writer.close()
    save_detections(out / file_name(part, DETECTIONS), found, size)
    counts["detections"] = sum(len(f.score) for f in found)
    if part in (None, 1):  # the same for all parts
        (out / "camera.txt").write_text(camera_line(config) + "\n")
        (out / "gt_objects.json").write_text(json.dumps(flat_truth(flat, clip), indent=1) + "\n")
    if part is not None:
        head = {"parts": parts, "crf": crf, **clip.settings()}
        marker.write_text(json.dumps({**counts, "settings": head}) + "\n")
    return counts


def join_parts(out: Path, clip: Clip, parts: int, crf: int | None = None) -> dict[str, int]:
    """Join the files of all parts to those of the whole walk; the parts stay.

    Raises: FileNotFoundError for a missing part, ValueError for one of another clip.
    """
    expected = {"parts": parts, "crf": crf, **clip.settings()}
    counts = {"frames": 0, "objects": 0, "boxes": 0, "detections": 0}
    for part in range(1, parts + 1):
        marker = out / file_name(part, "done.json")
        if not marker.exists():
            raise FileNotFoundError(f"{marker}: part {part} of {parts} is missing or unfinished")
        found = json.loads(marker.read_text())
        if found["settings"] != expected:
            raise ValueError(f"{marker}: rendered with other options than these")
        for name in counts:
            counts[name] = found[name] + (counts[name] if name != "objects" else 0)
    for name in (MOT, POSES):
        with (out / name).open("w") as whole:
            for part in range(1, parts + 1):
                whole.write((out / file_name(part, name)).read_text())
    firsts = [0]
    for part in range(1, parts + 1):
        firsts.append(firsts[-1] + len(clip.numbers(part, parts)))
    join_detections([out / file_name(i, DETECTIONS) for i in range(1, parts + 1)], firsts, out)
    videos = [out / file_name(i, VIDEO) for i in range(1, parts + 1)]
    join_videos(
        videos, out / VIDEO, replace(clip.config, fps=clip.config.fps / clip.stride), firsts
    )
    return counts


def join_detections(paths: Sequence[Path], firsts: Sequence[int], out: Path) -> None:
    """Write `detections.npz` from those of the parts.

    Args:
        firsts: frame of the whole clip at which each part starts.
    """
    loaded = [dict(np.load(path)) for path in paths]
    runs = np.cumsum([0] + [len(data["mask_counts"]) for data in loaded])
    whole = {
        name: np.concatenate([data[name] for data in loaded])
        for name in ("xyxy", "score", "class_id", "mask_counts")
    }
    frames = [data["frame"] + first for data, first in zip(loaded, firsts, strict=False)]
    offsets = [data["mask_offsets"][1:] + n for data, n in zip(loaded, runs, strict=False)]
    whole["frame"] = np.concatenate(frames)
    whole["mask_offsets"] = np.concatenate([[0], *offsets]).astype(np.int64)
    order = ("frame", "xyxy", "score", "class_id", "class_names", "image_size", "mask_counts",
             "mask_offsets")  # fmt: skip
    whole |= {name: loaded[0][name] for name in ("class_names", "image_size")}
    arrays: dict[str, Any] = {name: whole[name] for name in order}
    np.savez_compressed(out / DETECTIONS, **arrays)


def join_videos(
    paths: Sequence[Path], target: Path, config: RoomConfig, firsts: Sequence[int]
) -> None:
    """Copy the packets of all videos to one.

    Raises: ValueError if the joined video lacks frames.
    """
    copy_packets(paths, target, config, firsts)
    capture = cv2.VideoCapture(str(target))
    count = 0
    while capture.grab():
        count += 1
    capture.release()
    if count != firsts[-1]:
        raise ValueError(f"{target}: {count} frames instead of {firsts[-1]}")


def copy_packets(
    paths: Sequence[Path], target: Path, config: RoomConfig, firsts: Sequence[int]
) -> None:
    """Write the packets of all videos, which have the same codec and settings, to one video."""
    with av.open(str(target), "w", options={"movflags": "+faststart"}) as joined:
        stream: Any = None
        for path, first in zip(paths, firsts, strict=False):
            with av.open(str(path)) as part:
                source = part.streams.video[0]
                if stream is None:
                    stream = joined.add_stream_from_template(source)
                    stream.time_base = source.time_base
                shift = round(first / config.fps / source.time_base)
                for packet in part.demux(source):
                    if packet.dts is None:  # the end of the file
                        continue
                    packet.pts += shift
                    packet.dts += shift
                    packet.stream = stream
                    joined.mux(packet)
