"""scene.html: one self-contained page of objects, cameras, points and pictures.

The page's sources are in page/, beside this file: page.html names the others, they are put in here.

`write_pictures` is the one loop over the video that makes the overlay and the pictures of the page.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Camera, Poses, invert_rigid, place_of, undistort_boxes
from reobj.files import Progress, atomic, base64_text, rounded
from reobj.poses.floor import NOISE
from reobj.results.origin import centred
from reobj.results.overlay import Overlay, film_layers
from reobj.results.result import Object, Result, World, sides, significant
from reobj.sources.image_files import IMAGE_FPS
from reobj.sources.video import Video, shrunk
from reobj.types import (
    Array,
    Frame,
    Image,
    IntArray,
    ReobjError,
    Tracks,
    log,
    object_color,
    one_line,
    rows_by,
)

# Chosen so that the page of a video of three minutes with 50 objects stays below 10 MB.
SCENE_CROPS = 8  # pictures of each object in scene.html
SCENE_MAX_CROPS = 480  # and of all objects together
SCENE_CROP_PX = 112  # longer side of these pictures
SCENE_FRAMES = 60  # video frames in scene.html, behind the solids and beside the time slider
SCENE_FRAME_PX = 640  # longer side of these frames
JPEG_QUALITY = 60  # WebP takes half the bytes, and eight times the time (chosen)
CROP_MARGIN = 0.1  # of the box's sides, on every side: shows what the object stands on


class Pictures:
    """Cut small pictures for the scene page while the video is read: objects and whole frames.

    Attributes:
        wanted: rows of the tracks to cut, in their order. whole: numbers of the frames to keep.
        crops: [frame number, base64] of each object's pictures, by identity, by time.
        frames: [frame number, base64] of whole frames, without the distortion of the lens.
    """

    def __init__(self, result: Result, video: Video) -> None:
        self.tracks = result.tracks
        self.scale = video.scale
        self.crops: dict[int, list[tuple[int, str]]] = {o.id: [] for o in result.objects}
        self.frames: list[tuple[int, str]] = []
        poses = [part.poses for part in result.parts()]
        chosen = [np.empty(0, np.int64)]
        left = SCENE_MAX_CROPS
        ranked = sorted(result.objects, key=lambda o: -o.frames_seen)
        for doubtful in (False, True):  # what is left of the pictures is for these
            group = [o for o in ranked if (o.status == "doubtful") == doubtful]
            count = min(max(left // max(len(group), 1), 1), SCENE_CROPS)
            rows = [diverse_rows(result.tracks, o, poses[o.part], count) for o in group[:left]]
            chosen = chosen + rows
            left = left - sum(map(len, rows))
        self.wanted = np.sort(np.concatenate(chosen))
        shown = scene_steps(result)
        cameras = result.poses
        if cameras is not None and cameras.known.any():
            shown = shown[cameras.known[np.searchsorted(cameras.frame, shown)]]
        self.whole = set(shown[:: math.ceil(len(shown) / SCENE_FRAMES) or 1].tolist())
        self.camera = None if cameras is None else cameras.camera
        self.grid: npt.NDArray[np.float32] | None = None  # of undistorted pixels, made once

    def take(self, frame: Frame) -> None:
        """Cut the wanted boxes from this frame, and keep it if it is wanted as a whole."""
        rows = self.wanted[self.tracks.frame[self.wanted] == frame.index]
        height, width = frame.image.shape[:2]
        for obj, box in zip(self.tracks.track_id[rows], self.tracks.xyxy[rows], strict=True):
            margin = CROP_MARGIN * (box[2:] - box[:2])
            x1, y1 = ((box[:2] - margin) * self.scale).clip(0).astype(int)
            x2, y2 = np.minimum((box[2:] + margin) * self.scale + 1, (width, height)).astype(int)
            if x1 < x2 and y1 < y2:
                crop = _jpeg(frame.image[y1:y2, x1:x2], SCENE_CROP_PX)
                self.crops[int(obj)].append((frame.index, crop))
        if frame.index in self.whole:
            image = self._undistorted(shrunk(frame.image, SCENE_FRAME_PX))
            self.frames.append((frame.index, _jpeg(image, SCENE_FRAME_PX)))

    def _undistorted(self, image: Image) -> Image:
        """Remove the lens's distortion from a small picture, so that solids lie where they are."""
        camera = self.camera
        if camera is None or camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
            return image
        if self.grid is None:
            self.grid = _distorted_grid(camera, image.shape[1], image.shape[0])
        x, y = np.moveaxis(self.grid, -1, 0)
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), np.uint8)


def _distorted_grid(camera: Camera, width: int, height: int) -> npt.NDArray[np.float32]:
    """Find where the pixels of a pinhole picture lie in the lens's, (height, width, 2) float32.

    In pixels of OpenCV: the first one's centre is (0, 0).
    """
    small = camera.resized((width, height))
    xy = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2) + 0.5
    rays = np.hstack([xy, np.ones((len(xy), 1))]) @ np.linalg.inv(small.K).T  # (N, 3)
    found = np.asarray(small.to_pycolmap().img_from_cam(rays), np.float64) - 0.5
    return np.nan_to_num(found, nan=-1.0).reshape(height, width, 2).astype(np.float32)


def _jpeg(image: Image, size_px: int) -> str:
    """Encode a small JPEG picture as base64."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    data = cv2.imencode(".jpg", shrunk(image, size_px), quality)[1]
    return base64.b64encode(data.tobytes()).decode()


def diverse_rows(tracks: Tracks, found: Object, poses: Poses | None, count: int) -> IntArray:
    """Choose the most different views of one object, (n,) rows of the tracks, n <= count.

    The best box comes first (large, of good score), then whatever is farthest from the chosen ones
    in time and, where there are cameras, in viewing direction.

    Args:
        poses: of the object's part.
    """
    rows = np.flatnonzero(tracks.track_id == found.id)
    if not len(rows):
        return rows
    frame = tracks.frame[rows]
    box = tracks.xyxy[rows]
    quality = tracks.score[rows] * (box[:, 2:] - box[:, :2]).clip(0).prod(1) ** 0.5  # (N,)
    place = 2 * (frame / max(int(tracks.frame.max(initial=0)), 1))[:, None]  # (N, 1)
    if poses is not None and found.center is not None:
        at, known = place_of(poses, frame)
        eye = invert_rigid(poses.cam_from_world[at])[:, :, 3]  # (N, 3)
        ray = np.where(known[:, None], eye - found.center, np.nan)
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), np.finfo(float).tiny)
        place = np.hstack([place, np.nan_to_num(ray)])  # (N, 4)
        quality = np.where(np.isfinite(ray[:, 0]), quality, 0.01 * quality)  # no pose: last
    chosen = [int(quality.argmax())]
    while len(chosen) < min(count, len(rows)):
        gap = np.linalg.norm(place[:, None] - place[chosen], axis=2).min(1)  # (N,)
        best = int((gap * quality**0.5).argmax())
        if gap[best] == 0:
            break
        chosen.append(best)
    return np.asarray(rows[chosen], np.int64)


SCENE_STEPS = 1500  # positions of the time slider; of longer videos every n-th frame (chosen)


def scene_steps(result: Result) -> IntArray:
    """List the frames that the time slider of the page goes through, (S,)."""
    frames = np.unique(result.tracks.frame) if result.poses is None else result.poses.frame
    return frames[:: math.ceil(len(frames) / SCENE_STEPS) or 1]


def page_text() -> str:
    """Return the page without its data: page.html, with `@{file}` replaced by these files."""
    folder = Path(__file__).with_name("page")
    text = (folder / "page.html").read_text(encoding="utf-8")

    def text_of(found: re.Match[str]) -> str:
        return (folder / found[1]).read_text(encoding="utf-8").strip()

    return re.sub(r"@\{([\w.]+)\}", text_of, text)


def write_scene(
    result: Result, pictures: Pictures, path: Path, video: Video, doubtful: bool = False
) -> None:
    """Write scene.html: solids, cameras, points and pictures in one page that needs no network.

    Its data are objects.json's entries, and base64 of little-endian float32 / uint8 arrays. A world
    far from its origin is moved: `origin` of its part says where that is now.

    Args:
        doubtful: show the doubtful objects at first; a switch of the page shows and hides them.
    """
    steps = scene_steps(result)  # (S,)
    poses = result.poses
    count = len(np.unique(result.tracks.frame) if poses is None else poses.frame)
    seconds = video.config.every / (video.fps or IMAGE_FPS) * count / max(1, len(steps))
    of_part = np.zeros(len(steps), int) if poses is None else poses.part_of(steps)  # (S,)
    thin = math.ceil(0 if poses is None else len(poses.points) / SCENE_POINTS) or 1
    parts, origins = zip(*(centred(part) for part in result.parts()), strict=True)
    data = {
        "title": Path(str(video.source)).name,
        "warnings": result.warnings,
        "links": [
            link | {key: rounded(link[key], 2) for key in ("place_iou", "appearance_log_odds")}
            for link in result.world.to_json()["links"]
        ],
        "objects": [
            _scene_object(o, origins[o.part], result.tracks, steps, pictures)
            for o in result.objects
        ],
        "thumbs": [[frame, data, _boxes_in(result, frame)] for frame, data in pictures.frames],
        "doubtful": doubtful,
        "size": {"width": result.video.width, "height": result.video.height},
        "edits": [] if result.edits is None else result.edits.entries,
        "why_flat": _why_flat(result),
        "steps": {"frame": steps.tolist(), "seconds": seconds, "part": of_part.tolist()},
        **_scene_cameras(result, steps, np.array(origins)),
        "parts": [
            _scene_part(k, part, thin) | {"origin": origin.tolist()}
            for k, (part, origin) in enumerate(zip(parts, origins, strict=True))
        ],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    head, tail = page_text().split("@DATA@")
    with atomic(path) as part:  # no name can end the script
        part.write_text(head + text.replace("<", "\\u003c") + tail, encoding="utf-8")


def _boxes_in(result: Result, frame: int) -> list[list[float]]:
    """List the detections of a frame: identity, x1, y1, x2, y2, undistorted, native pixels."""
    rows = result.tracks[(result.tracks.frame == frame) & (result.tracks.score > 0)]
    box = rows.xyxy if result.poses is None else undistort_boxes(rows.xyxy, result.poses.camera)
    good = np.isfinite(box).all(1)
    return [
        [i, *b]
        for i, b in zip(rows.track_id[good].tolist(), box[good].round(1).tolist(), strict=True)
    ]


SCENE_POINTS = 20000  # sparse points shown; of more every n-th (chosen: .4 MB of the page)


def _scene_cameras(result: Result, steps: IntArray, origins: Array) -> dict[str, Any]:
    """Collect the intrinsics and the cameras of the steps, each in the world of its part.

    Args:
        origins: (P, 3) of the parts.
    """
    poses = result.poses
    if poses is None or not poses.known.any():
        return {"camera": None, "poses": ""}
    size = {"width": poses.camera.width, "height": poses.camera.height}
    K = poses.camera.K
    rows = np.isin(poses.frame, steps)
    shown = invert_rigid(poses.cam_from_world[rows])
    shown[:, :, 3] -= origins[poses.part[rows]]
    inside = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return {"camera": size | inside, "poses": base64_text(shown, "<f4")}


def _scene_part(number: int, part: Result, thin: int) -> dict[str, Any]:
    """Collect every `thin`-th point, scale, floor, up and sigma of points of a part; its name."""
    poses = part.poses
    up = part.world.up_in_world
    count = len(part.objects)
    spans = ", ".join(p.span_text for p in part.world.parts)
    facts = {
        "name": f"part {number}: {spans}; {count} object{'s' * (count != 1)}",
        "facts": _scene_facts(part.world),
        "scale": part.world.to_json()["scale"],
    }
    if poses is None or not poses.known.any():
        return facts | {"points": "", "colors": "", "up": [0, 0, 1]}
    if up is None:
        up = quadrics.camera_up(poses.camera.K @ poses.cam_from_world[poses.known])[0]
    if (floor := part.world.floor) is not None:
        facts["floor"] = {"normal": floor.normal.tolist(), "offset": floor.offset}
    eye = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]
    some = (poses.points[:: len(poses.points) // 500 + 1], eye[:: len(eye) // 50 + 1])
    if len(some[0]):  # as for the floor: a share of the distance
        distance = np.linalg.norm(some[0][:, None] - some[1], axis=2).min(1)
        facts["point_sigma"] = NOISE * float(np.median(distance))
    return facts | {
        "points": base64_text(poses.points[::thin], "<f4"),
        "colors": base64_text(poses.colors[::thin], "u1"),
        "up": significant(up).tolist(),
    }


def _scene_object(
    found: Object, origin: Array, tracks: Tracks, steps: IntArray, pictures: Pictures
) -> dict[str, Any]:
    """Describe an object for the page.

    Its entry of objects.json, its colour, its pictures, its size as text, the steps in which it is
    seen (first, last, first, last ...), and its visits, each with its best box, by which an edit
    names it (first, last, frame, x1, y1, x2, y2).
    """
    own = tracks[tracks.track_id == found.id]
    seen = np.isin(steps, own.frame)
    runs = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]])))
    runs[1::2] -= 1
    detected = own[own.score > 0] if own.score.any() else own  # without filled gaps
    visits = []
    for rows in rows_by(detected.tracklet_id):
        best = rows[detected.score[rows].argmax()]
        box = detected.xyxy[best].round(1).tolist()
        visits.append([*detected.frame[rows[[0, -1]]].tolist(), int(detected.frame[best]), *box])
    return found.to_json() | {
        "center": None if found.center is None else (found.center - origin).tolist(),
        "cov": "" if found.cov is None else base64_text(found.cov, "<f4"),
        "color": object_color(found.id)[::-1],
        "sides": sides(found),
        "seen": runs.tolist(),
        "visits": sorted(visits),
        "crops": pictures.crops[found.id],
    }


def _why_flat(result: Result) -> str:
    """Say why the page has nothing to show in 3D; "" if it has."""
    if result.poses is not None and result.poses.known.any():
        return ""
    reasons = [w for w in result.warnings if "pose" in w or "identities only" in w]
    return reasons[0] if reasons else "no camera poses (`track`, or --poses none)"


def _scene_facts(world: World) -> str:
    """Summarise cameras and scale in one line, for the head of the page."""
    if not world.registered_frames:
        return ""
    facts = [f"cameras of {world.registered_frames} of {world.frames} frames"]
    if world.scale is not None and world.scale.source != "none":
        sigma = 100 * (world.scale.rel_sigma or 0)
        facts.append(f"scale from {world.scale.source}, ± {sigma:.0f} %")
    else:
        facts.append(f"units: {world.units}")
    facts += ["up is guessed from the cameras"] if world.up_in_world is None else []
    return " · ".join(facts)


def write_pictures(
    result: Result,
    out: Path,
    video: Video,
    overlay: str = "solids",
    scene: bool = True,
    doubtful: bool = False,
) -> list[str]:
    """Write the film and scene.html in one pass over the video.

    Each file appears only when it is complete. A live source cannot be read again, and frames may
    have no images: no overlay then, and a page without pictures.

    Args:
        overlay: what the film shows (`film_layers`); "none": no film.
        doubtful: show doubtful objects in the film, and at first on the page, which holds them.
    Returns:
        what could not be made, why, and the option that leaves it out. With the environment
        variable REOBJ_RAISE, as in our tests, faults of the program are raised instead.
    """
    visible = video.has_images and not video.is_live
    shown = result if doubtful else result.without_doubtful()
    faults = _Faults()
    film = pictures = None
    if film_layers(overlay) and visible:
        with faults.of("overlay"):
            film = Overlay(shown, out / "overlay.mp4", video, overlay)
    if scene:
        with faults.of("scene"):
            pictures = Pictures(result, video)
    sinks = [(n, sink) for n, sink in (("overlay", film), ("scene", pictures)) if sink and visible]
    progress = Progress("write", video.expected)
    complete = False
    try:
        with faults.of("video"):
            for frame in video if sinks else ():
                for name, sink in sinks:
                    if name not in faults.found:
                        with faults.of(name):
                            sink.take(frame)
                progress.step()
        complete = "video" not in faults.found
    finally:
        progress.close(complete)
        if film is not None:
            with faults.of("overlay"):
                film.close(complete and "overlay" not in faults.found)
    if pictures is not None and "scene" not in faults.found:
        with faults.of("scene"):
            page = dataclasses.replace(result, warnings=[*result.warnings, *faults.messages()])
            write_scene(page, pictures, out / "scene.html", video, doubtful)
    return faults.messages()


class _Faults:
    """What went wrong with the pictures of a result, each once.

    Attributes:
        found: the first error of each: "video", and the options of the section `output`.
    """

    def __init__(self) -> None:
        self.found: dict[str, Exception] = {}

    @contextlib.contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Keep an exception of the block."""
        try:
            yield
        except Exception as error:
            if not isinstance(error, ReobjError | OSError) and os.environ.get("REOBJ_RAISE"):
                raise
            log.debug("pictures: fault in %s", name, exc_info=True)
            self.found.setdefault(name, error)

    def messages(self) -> list[str]:
        """Name what is missing, the reason, and the option to leave it out."""
        texts = {
            "video": "no film, and a page without the pictures from there on: reading the video "
            "again failed with {} (--set output.overlay=none leaves the film out)",
            "overlay": "no film: {} (--set output.overlay=none leaves it out)",
            "scene": "no scene.html: {} (--set output.scene=false leaves it out)",
        }
        return [
            one_line(texts[name].format(f"{type(error).__name__}: {error}"))
            for name, error in self.found.items()
        ]
