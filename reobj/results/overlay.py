"""overlay.mp4: boxes, identities and back-projected ellipsoids drawn over every frame.

`Overlay` is a sink under the one loop over the video (`write_pictures` in scene.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

import quadrics
from reobj.results.result import Result
from reobj.sources.video import IMAGE_FPS, Video
from reobj.types import Array, BoolArray, Frame, Image, Tracks, object_color


def draw_tracks(image: Image, tracks: Tracks, labels: dict[int, str], scale: float) -> None:
    """Draw the boxes and identities of one frame's rows, in place.

    Args:
        labels: text of each identity; scale: image pixels per pixel of the tracks.
    """
    for obj, box in zip(tracks.track_id.tolist(), tracks.xyxy * scale, strict=True):
        x1, y1, x2, y2 = box.round().astype(int).tolist()
        color = object_color(obj)
        cv2.rectangle(image, (x1, y1), (x2, y2), color, 2, cv2.LINE_AA)
        _draw_label(image, labels.get(obj, str(obj)), x1, y1, color)


def _draw_label(image: Image, text: str, x: int, y: int, color: tuple[int, int, int]) -> None:
    """Draw text on a filled tag above (x, y), kept inside the image."""
    (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    x = max(0, min(x, image.shape[1] - width - 4))
    y = max(height + base + 2, y)
    cv2.rectangle(image, (x, y - height - base - 2), (x + width + 4, y), color, -1)
    dark = sum(color) > 380
    ink, at = (0,) * 3 if dark else (255,) * 3, (x + 2, y - base)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, ink, 1, cv2.LINE_AA)


MAX_AXIS = 4  # image sides; longer ellipses are of objects beside the camera and only confuse


def draw_ellipses(
    image: Image, dual_c: Array, drawn: BoolArray, object_id: Sequence[int], seen: set[int]
) -> None:
    """Draw the outlines of projected ellipsoids, in place.

    Args:
        dual_c: (O, 3, 3) dual conics in pixels of `image`. drawn: (O,) which ones to draw.
        object_id: (O,). seen: identities with a box in this frame; the others are drawn thin.
    """
    for conic, wanted, obj in zip(dual_c, drawn, object_id, strict=True):
        shape = ellipse_of_dual_conic(conic) if wanted else None
        if shape is not None and max(shape[1]) < MAX_AXIS * max(image.shape):
            cv2.ellipse(image, shape, object_color(obj), 2 if obj in seen else 1, cv2.LINE_AA)


def ellipse_of_dual_conic(
    dual_c: Array,
) -> tuple[tuple[float, float], tuple[float, float], float] | None:
    """Convert a dual conic C* (3, 3) to the ellipse that cv2.ellipse draws, None if it is none.

    C* = [S - m m', -m; -m', -1] up to scale: m is the centre, the eigenvalues of S are the squared
    half axes.

    Returns:
        centre in OpenCV's pixels, full axes, angle of the first axis from x towards y in degrees.
    """
    conic = dual_c / -dual_c[2, 2]
    center = -conic[:2, 2]
    values, vectors = np.linalg.eigh(conic[:2, :2] + np.outer(center, center))
    if not (np.isfinite(values).all() and values.min() > 0):
        return None
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    minor, major = 2 * np.sqrt(values)
    x, y = (center - 0.5).tolist()  # OpenCV draws with the pixel's centre at 0
    return (x, y), (float(major), float(minor)), angle


class VideoWriter:
    """Write an MP4 file that appears under its name only when it is complete.

    Attributes:
        path: of the file. part: of what is written of it. count: frames so far.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self.path, self.part = path, path.with_name(f".part-{path.name}")
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")  # the one H.264-free codec in the wheel
        self.writer = cv2.VideoWriter(str(self.part), fourcc, fps, size)
        if not self.writer.isOpened():
            raise OSError(f"{path}: OpenCV cannot write this video")
        self.count = 0

    def write(self, image: Image) -> None:
        """Append one frame."""
        self.writer.write(image)
        self.count += 1

    def close(self, complete: bool) -> None:
        """Finish the file; keep it only if complete (OpenCV is silent when the disk is full)."""
        self.writer.release()
        try:
            if complete and self._frames_on_disk() != self.count:
                raise OSError(f"{self.path}: not all frames could be written; is the disk full?")
            if complete:
                self.part.replace(self.path)
        finally:
            self.part.unlink(missing_ok=True)

    def _frames_on_disk(self) -> int:
        capture = cv2.VideoCapture(str(self.part))
        return int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0


OVERLAY_SIZE_PX = 1280  # longer side; larger videos are shrunk (chosen: HD, so that it plays)


class Overlay:
    """Write overlay.mp4 frame by frame.

    Ellipsoids that rest on a prior are drawn only while their object is detected.

    Attributes:
        size: (w, h) of the pictures, even. scale: of their pixels per native pixel.
    """

    def __init__(self, result: Result, path: Path, video: Video) -> None:
        width, height = video.size
        shrink = min(1.0, OVERLAY_SIZE_PX / max(width, height))
        # codecs want even sides
        self.size = (int(width * shrink) // 2 * 2, int(height * shrink) // 2 * 2)
        self.scale, self.tracks = self.size[0] / width, result.tracks
        self.sure = {o.id for o in result.located if o.status == "ok"}
        self.labels = {o.id: f"{o.id} {o.class_name}" for o in result.objects}
        self.outlines = _project_all(result, self.scale)
        fps = max(1.0, (video.fps or IMAGE_FPS) / video.config.every)
        self.writer = VideoWriter(path, fps, self.size)

    def take(self, frame: Frame) -> None:
        """Draw and append one frame."""
        low, high = np.searchsorted(self.tracks.frame, [frame.index, frame.index + 1])
        rows = self.tracks[slice(low, high)]
        small = cv2.resize(frame.image, self.size, interpolation=cv2.INTER_AREA)
        image = np.asarray(small, np.uint8)
        if frame.index in self.outlines:
            ids, dual_c, visible = self.outlines[frame.index]
            seen = set(rows.track_id.tolist())
            drawn = visible & np.array([i in seen or i in self.sure for i in ids], bool)
            draw_ellipses(image, dual_c, drawn, ids, seen)
        draw_tracks(image, rows, self.labels, self.scale)
        self.writer.write(image)

    def close(self, complete: bool) -> None:
        """Finish the file; it appears only if it is complete."""
        self.writer.close(complete)


def _project_all(result: Result, scale: float) -> dict[int, tuple[list[int], Array, BoolArray]]:
    """Project the ellipsoids of the located objects into the frames with a pose of their part.

    Returns:
        by frame number: identities (O), dual conics (O, 3, 3) in scaled pixels, and visible (O,).
    """
    outlines: dict[int, tuple[list[int], Array, BoolArray]] = {}
    scaled = np.diag([scale, scale, 1.0])
    for part in result.parts():
        ids, poses = [o.id for o in part.located], part.poses
        if poses is None or not ids or not poses.known.any():
            continue
        img_from_world = scaled @ poses.camera.K @ poses.cam_from_world[poses.known]  # (F, 3, 4)
        projected = quadrics.project(part.ellipsoids().dual_quadrics(), img_from_world)
        for frame, dual_c, visible in zip(
            poses.frame[poses.known].tolist(), *projected, strict=True
        ):
            outlines[frame] = (ids, dual_c, visible)
    return outlines
