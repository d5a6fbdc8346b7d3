"""Write a clip: video, detections, MOT truth, object list, poses, camera."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from rendering.camera import camera_matrix
from rendering.config import COCO_NAMES, Array, Image, RoomConfig
from rendering.detector import FrameDetections, simulate_detections
from rendering.ground_truth import FrameTruth
from rendering.models import rotation_z
from rendering.photograph import Frame, render_clip
from rendering.room import make_room
from rendering.surfaces import Room


def save_detections(path: Path, frames: Sequence[FrameDetections], size: tuple[int, int]) -> None:
    """Write `detections.npz`: arrays over all frames, masks as concatenated run lengths."""
    runs = [np.zeros(0, np.uint32), *(run for frame in frames for run in frame["runs"])]
    table = {
        key: np.concatenate([frame[key] for frame in frames])
        for key in ("xyxy", "score", "class_id")
    }
    np.savez_compressed(
        path,
        frame=np.repeat(np.arange(len(frames), dtype=np.int64), [len(f["score"]) for f in frames]),
        xyxy=table["xyxy"].round(2),
        score=table["score"].round(4),
        class_id=table["class_id"],
        class_names=np.array(COCO_NAMES),
        image_size=np.array(size, np.int64),
        mask_counts=np.concatenate(runs),
        mask_offsets=np.cumsum([len(run) for run in runs], dtype=np.int64),
    )


def mot_lines(frame: int, truth: FrameTruth, room: Room) -> list[str]:
    """MOTChallenge ground truth of one frame: visible boxes of objects seen well enough."""
    lines = []
    for item in room.objects:
        x0, y0, x1, y1 = truth.visible_xyxy[item.index]
        if truth.visibility[item.index] >= 0.1 and min(x1 - x0, y1 - y0) >= 8:
            box_text = f"{x0:.2f},{y0:.2f},{x1 - x0:.2f},{y1 - y0:.2f}"  # pixels as in tracks.txt
            tail = f"1,{item.class_id},{truth.visibility[item.index]:.3f}"
            lines.append(f"{frame + 1},{item.identity},{box_text},{tail}")
    return lines


def tum_line(seconds: float, cam_from_world: Array) -> str:
    """`t tx ty tz qx qy qz qw`, world_from_cam."""
    rotation = cam_from_world[:, :3].T
    center = -rotation @ cam_from_world[:, 3]
    xyzw = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return f"{seconds:.6f} " + " ".join(f"{v:.9f}" for v in (*center, *xyzw))


def world_of_camera(cam_from_world: Array) -> Array:
    """room_from_world (4, 4) of a world at a camera (3, 4): x is its heading, z is up."""
    forward = cam_from_world[2, :3]
    world = np.eye(4)
    world[:3, :3] = rotation_z(np.arctan2(forward[1], forward[0]))
    world[:3, 3] = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    return world


def objects_json(room: Room, config: RoomConfig) -> dict[str, Any]:
    """The truth about all objects, for `gt_objects.json`."""
    objects = [
        {
            "id": item.identity,
            "class": item.class_name,
            "class_id": item.class_id,
            "twin_group": item.twin_group,
            "support": item.shape,
            "center": item.center_in_world.round(6).tolist(),
            "size_m": item.size_m.round(6).tolist(),
            "half_axes": (item.size_m / 2).round(6).tolist(),
            "yaw_rad": round(item.yaw_rad, 6),
            "world_from_obj": item.world_from_obj.round(9).tolist(),
        }
        for item in room.objects
    ]
    conventions = {
        "pose": "cam_from_world",
        "camera_axes": "x right, y down, z forward",
        "pixels": "corner (COLMAP)",
    }
    return {
        "format": "reobj-room-truth",
        "version": 1,
        "units": "m",
        "up_axis": "+z",
        "conventions": conventions,
        "config": asdict(config),
        "room_m": [round(v, 6) for v in room.size_m],
        "K": camera_matrix(config).tolist(),
        "objects": objects,
    }


def camera_line(config: RoomConfig) -> str:
    """One line of a COLMAP cameras.txt."""
    K = camera_matrix(config)
    focal = f"{K[0, 0]:.9f} {K[1, 1]:.9f}"
    return f"1 PINHOLE {config.width} {config.height} {focal} {K[0, 2]:.1f} {K[1, 2]:.1f}"


class VideoSink:
    """A video file to write BGR frames to.

    OpenCV's wheels write MPEG-4 part 2 at a rate of their own; `crf` asks PyAV for H.264 instead,
    which is sharper at the same size and plays in browsers.
    """

    def __init__(self, path: Path, config: RoomConfig, crf: int | None = None) -> None:
        self._stream: Any = None
        if crf is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            size = (config.width, config.height)
            self._file: Any = cv2.VideoWriter(str(path), code, config.fps, size)
            if not self._file.isOpened():
                raise OSError(f"{path}: this OpenCV cannot write MPEG-4 video")
            return
        self._file = av.open(str(path), "w", options={"movflags": "+faststart"})
        options = {"crf": str(crf), "preset": "veryslow", "threads": "1"}
        rate = Fraction(config.fps).limit_denominator(1000)
        self._stream = self._file.add_stream("libx264", rate=rate, options=options)
        self._stream.width = config.width
        self._stream.height = config.height
        self._stream.pix_fmt = "yuv420p"

    def write(self, image: Image) -> None:
        """Append a frame."""
        if self._stream is None:
            self._file.write(image)
        else:
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            self._file.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file."""
        if self._stream is None:
            self._file.release()
        else:
            self._file.mux(self._stream.encode())
            self._file.close()


def write_clip(
    out: Path,
    config: RoomConfig,
    png: bool = False,
    crf: int | None = None,
    own_world: bool = False,
    room: Room | None = None,
    cameras: Array | None = None,
    watch: Callable[[Frame], None] | None = None,
) -> dict[str, int]:
    """Render a clip into a folder, with all truth files.

    Args:
        own_world: write poses in a world with its origin at the first camera, which looks along x.
        room, cameras: with the path cam_from_world (F, 3, 4); those of the config by default.
        watch: called with every frame.
    """
    room = room or make_room(config)
    world = np.eye(4)  # room_from_world
    out.mkdir(parents=True, exist_ok=True)
    mot: list[str] = []
    tum: list[str] = []
    found: list[FrameDetections] = []
    writer = VideoSink(out / "room.mp4", config, crf)
    clip = render_clip(room, config, cameras)
    for frame in tqdm(clip, "render", config.frames, disable=None):
        if watch:
            watch(frame)
        writer.write(frame.image)
        if png:
            cv2.imwrite(str(out / f"frame_{frame.index:05d}.png"), frame.image)
        rng = np.random.default_rng([config.seed, 5, frame.index])
        found.append(simulate_detections(room, frame.truth, frame.instance, rng))
        mot += mot_lines(frame.index, frame.truth, room)
        if own_world and not tum:
            world = world_of_camera(frame.cam_from_world)
        tum.append(tum_line(frame.index / config.fps, frame.cam_from_world @ world))
    writer.close()
    save_detections(out / "detections.npz", found, (config.width, config.height))
    (out / "gt_mot.txt").write_text("\n".join(mot) + "\n")
    (out / "poses.txt").write_text("\n".join(tum) + "\n")
    (out / "camera.txt").write_text(camera_line(config) + "\n")
    (out / "gt_objects.json").write_text(json.dumps(objects_json(room, config), indent=1) + "\n")
    return {
        "frames": config.frames,
        "objects": len(room.objects),
        "boxes": len(mot),
        "detections": sum(len(f["score"]) for f in found),
    }
