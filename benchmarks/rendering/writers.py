"""Write a clip: video, detections, MOT truth, object list, poses, camera."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt

from rendering.camera import camera_matrix
from rendering.config import COCO_NAMES, Array, DetectorConfig, Image, RoomConfig
from rendering.detector import FrameDetections, simulate_detections
from rendering.ground_truth import FrameTruth
from rendering.models import rotation_z
from rendering.photograph import Frame, render_clip
from rendering.room import make_room
from rendering.surfaces import Room


def run_lengths(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint32]:
    """COCO-style run lengths, column-major, zeros first; none for an empty array."""
    flat = mask.ravel(order="F")
    if not flat.size:
        return np.zeros(0, np.uint32)
    turns = np.nonzero(flat[1:] != flat[:-1])[0] + 1
    edges = np.concatenate([[0] if not flat[0] else [0, 0], turns, [flat.size]])
    return np.diff(edges).astype(np.uint32)


@dataclass(frozen=True, slots=True)
class PackedDetections:
    """Detections of one frame with their masks as run lengths."""

    xyxy: Array  # (D, 4) px, corner convention
    score: Array  # (D,)
    class_id: npt.NDArray[np.int64]  # (D,)
    runs: tuple[npt.NDArray[np.uint32], ...]  # D times; an empty array where there is no mask


def pack_detections(found: FrameDetections) -> PackedDetections:
    """Replace the masks of a frame by their run lengths, which take far less memory."""
    runs = tuple(run_lengths(mask) for mask in found.masks)
    return PackedDetections(found.xyxy, found.score, found.class_id, runs)


def save_detections(path: Path, frames: Sequence[PackedDetections], size: tuple[int, int]) -> None:
    """Write `detections.npz`: arrays over all frames, masks as concatenated run lengths."""
    runs = [run for frame in frames for run in frame.runs]
    lengths = np.array([len(run) for run in runs], np.int64)
    np.savez_compressed(
        path,
        frame=np.repeat(np.arange(len(frames), dtype=np.int64), [len(f.score) for f in frames]),
        xyxy=np.concatenate([f.xyxy for f in frames]).round(2),
        score=np.concatenate([f.score for f in frames]).round(4),
        class_id=np.concatenate([f.class_id for f in frames]).astype(np.int64),
        class_names=np.array(COCO_NAMES),
        image_size=np.array(size, np.int64),
        mask_counts=np.concatenate(runs) if runs else np.zeros(0, np.uint32),
        mask_offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
    )


def mot_lines(frame: int, truth: FrameTruth, room: Room, size: tuple[int, int]) -> list[str]:
    """MOTChallenge ground truth of one frame: visible boxes of objects seen well enough."""
    lines = []
    for item in room.objects:
        x0, y0, x1, y1 = truth.visible_xyxy[item.index]
        if truth.visibility[item.index] >= 0.1 and min(x1 - x0, y1 - y0) >= 8:
            box_text = f"{x0:.2f},{y0:.2f},{x1 - x0:.2f},{y1 - y0:.2f}"  # pixels as in tracks.txt
            tail = f"1,{item.class_id},{truth.visibility[item.index]:.3f}"
            lines.append(f"{frame + 1},{item.identity},{box_text},{tail}")
    return lines


def quaternion_xyzw(rotation: Array) -> Array:
    """Unit quaternion of a (3, 3) rotation: the eigenvector of its 4x4 form, w >= 0.

    Ref: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000.
    """
    r = rotation
    form = np.zeros((4, 4))
    form[:3, :3] = r + r.T - np.trace(r) * np.eye(3)
    form[:3, 3] = form[3, :3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    form[3, 3] = np.trace(r)
    quaternion = np.linalg.eigh(form)[1][:, -1]
    return np.asarray(quaternion * (1 if quaternion[3] >= 0 else -1))


def tum_line(seconds: float, cam_from_world: Array) -> str:
    """`t tx ty tz qx qy qz qw`, world_from_cam."""
    rotation = cam_from_world[:, :3].T
    center = -rotation @ cam_from_world[:, 3]
    return f"{seconds:.6f} " + " ".join(f"{v:.9f}" for v in (*center, *quaternion_xyzw(rotation)))


def world_of_camera(cam_from_world: Array) -> Array:
    """room_from_world (4, 4) of a world at a camera (3, 4): x is its heading, z is up."""
    forward = cam_from_world[2, :3]
    heading = np.arctan2(forward[1], forward[0])
    world = np.eye(4)
    world[:3, :3] = rotation_z(float(heading))
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
            "support": item.support,
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
    settings = {name: getattr(config, name) for name in config.__slots__}
    if config.plan == "home":
        del settings["plan"]
    head: dict[str, Any] = {
        "format": "reobj-room-truth",
        "version": 1,
        "units": "m",
        "up_axis": "+z",
    }
    head |= {
        "conventions": conventions,
        "config": settings,
        "room_m": [round(v, 6) for v in room.size_m],
    }
    return {**head, "K": camera_matrix(config).tolist(), "objects": objects}


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
            return
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        self._file.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file."""
        if self._stream is None:
            self._file.release()
            return
        self._file.mux(self._stream.encode())
        self._file.close()


def write_clip(
    out: Path,
    config: RoomConfig,
    detector: DetectorConfig,
    png: bool = False,
    crf: int | None = None,
    own_world: bool = False,
) -> dict[str, int]:
    """Render a clip into a folder, with all truth files.

    Args:
        own_world: write poses in a world with its origin at the first camera, which looks along x.
    """
    room = make_room(config)
    return write_room(out, room, config, detector, png=png, crf=crf, own_world=own_world)


def write_room(
    out: Path,
    room: Room,
    config: RoomConfig,
    detector: DetectorConfig,
    cameras: Array | None = None,
    watch: Callable[[Frame], None] | None = None,
    png: bool = False,
    crf: int | None = None,
    own_world: bool = False,
) -> dict[str, int]:
    """Render a clip of a room that exists into a folder, with all truth files.

    Args:
        cameras: cam_from_world (F, 3, 4); the path of the config by default.
        watch: called with every frame.
        own_world: write poses in a world with its origin at the first camera, which looks along x.
    """
    world = np.eye(4)  # room_from_world
    out.mkdir(parents=True, exist_ok=True)
    size = (config.width, config.height)
    mot: list[str] = []
    tum: list[str] = []
    found: list[PackedDetections] = []
    writer = VideoSink(out / "room.mp4", config, crf)
    for frame in render_clip(room, config, cameras):
        if watch:
            watch(frame)
        writer.write(frame.image)
        if png:
            cv2.imwrite(str(out / f"frame_{frame.index:05d}.png"), frame.image)
        rng = np.random.default_rng([config.seed, 5, frame.index])
        found.append(
            pack_detections(simulate_detections(room, frame.truth, frame.instance, detector, rng))
        )
        mot += mot_lines(frame.index, frame.truth, room, size)
        if own_world and not tum:
            world = world_of_camera(frame.cam_from_world)
        tum.append(tum_line(frame.index / config.fps, frame.cam_from_world @ world))
        show_progress(frame.index + 1, config.frames)
    writer.close()
    save_detections(out / "detections.npz", found, size)
    (out / "gt_mot.txt").write_text("\n".join(mot) + "\n")
    (out / "poses.txt").write_text("\n".join(tum) + "\n")
    (out / "camera.txt").write_text(camera_line(config) + "\n")
    (out / "gt_objects.json").write_text(json.dumps(objects_json(room, config), indent=1) + "\n")
    return {
        "frames": config.frames,
        "objects": len(room.objects),
        "boxes": len(mot),
        "detections": sum(len(f.score) for f in found),
    }


def show_progress(done: int, total: int) -> None:
    """A counter on stderr, only on a terminal."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\rrender {done}/{total}" + ("\n" if done == total else ""))
        sys.stderr.flush()
