"""scene.html: one self-contained page of objects, cameras, points and pictures.

`write_pictures` is the one loop over the video that makes the overlay and the pictures of the page.
"""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import quadrics
from reobj.cameras import Poses, invert_rigid, place_of
from reobj.files import Progress, atomic, base64_text, rounded
from reobj.results.overlay import Overlay, draw_tracks, film_layers
from reobj.results.result import Object, Result, World, significant
from reobj.sources.video import IMAGE_FPS, Video, shrunk
from reobj.types import Frame, Image, IntArray, Tracks, object_color

# Chosen so that the page of a video of three minutes with 50 objects stays below 10 MB.
SCENE_CROPS = 8  # pictures of each object in scene.html
SCENE_MAX_CROPS = 480  # and of all objects together
SCENE_CROP_PX = 112  # longer side of these pictures
SCENE_FRAMES = 60  # video frames in scene.html, shown beside the time slider
SCENE_FRAME_PX = 320  # longer side of these frames
JPEG_QUALITY = 80
CROP_MARGIN = 0.1  # of the box's sides, on every side: shows what the object stands on


class Pictures:
    """Cut small JPEGs for the scene page while the video is read: objects and whole frames.

    Attributes:
        wanted: rows of the tracks to cut, in their order. whole: numbers of the frames to keep.
        crops: [frame number, base64] of each object's pictures, by identity, by time.
        frames: [frame number, base64] of whole frames with their boxes.
    """

    def __init__(self, result: Result, video: Video) -> None:
        self.tracks, self.scale = result.tracks, video.scale
        self.crops: dict[int, list[tuple[int, str]]] = {o.id: [] for o in result.objects}
        self.frames: list[tuple[int, str]] = []
        count = SCENE_MAX_CROPS // max(len(result.objects), 1)
        count = min(max(count, 1), SCENE_CROPS)
        ranked = sorted(result.objects, key=lambda o: -o.frames_seen)
        poses = [part.poses for part in result.parts()]
        chosen = {
            o.id: diverse_rows(result.tracks, o, poses[o.part], count)
            for o in ranked[:SCENE_MAX_CROPS]
        }
        self.wanted = np.sort(np.concatenate([*chosen.values(), np.empty(0, np.int64)]))
        shown = scene_frames(result)
        self.whole = set(shown[:: math.ceil(len(shown) / SCENE_FRAMES) or 1].tolist())

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
            image = shrunk(frame.image, SCENE_FRAME_PX)
            low, high = np.searchsorted(self.tracks.frame, [frame.index, frame.index + 1])
            scale = self.scale * image.shape[1] / width
            draw_tracks(image, self.tracks[slice(low, high)], {}, scale)
            self.frames.append((frame.index, _jpeg(image, SCENE_FRAME_PX)))


def _jpeg(image: Image, size_px: int) -> str:
    """Encode a small JPEG as base64."""
    data = cv2.imencode(".jpg", shrunk(image, size_px), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return base64.b64encode(data.tobytes()).decode()


def diverse_rows(tracks: Tracks, found: Object, poses: Poses | None, count: int) -> IntArray:
    """Choose the most different views of one object, (n,) rows of the tracks, n <= count.

    The best box comes first (large, of good score), then whatever is farthest from the chosen ones
    in time and, where there are cameras, in viewing direction.

    Args:
        poses: of the object's part.
    """
    rows = np.flatnonzero(tracks.track_id == found.id)
    frame, box = tracks.frame[rows], tracks.xyxy[rows]
    quality = tracks.score[rows] * (box[:, 2:] - box[:, :2]).clip(0).prod(1) ** 0.5  # (N,)
    place = 2 * (frame / max(int(tracks.frame.max(initial=0)), 1))[:, None]  # (N, 1)
    if poses is not None and found.center is not None:
        at, known = place_of(poses, frame)
        eye = invert_rigid(poses.cam_from_world[at])[:, :, 3]  # (N, 3)
        ray = np.where(known[:, None], eye - found.center, np.nan)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
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


def scene_frames(result: Result) -> IntArray:
    """List the frames that the time slider of the page goes through, before thinning."""
    return np.unique(result.tracks.frame) if result.poses is None else result.poses.frame


SCENE_STEPS = 1500  # positions of the time slider; of longer videos every n-th frame (chosen)


def write_scene(result: Result, pictures: Pictures, path: Path, video: Video) -> None:
    """Write scene.html: ellipsoids, cameras, points and pictures in one page that needs no network.

    The page is `scene.html` beside this file; its data are objects.json's entries without
    covariance, and base64 of little-endian float32 / uint8 arrays.
    """
    frames = scene_frames(result)
    steps = frames[:: math.ceil(len(frames) / SCENE_STEPS) or 1]  # (S,)
    seconds = video.config.every / (video.fps or IMAGE_FPS) * len(frames) / max(1, len(steps))
    poses = result.poses
    of_part = np.zeros(len(steps), int) if poses is None else poses.part_of(steps)  # (S,)
    thin = math.ceil(0 if poses is None else len(poses.points) / SCENE_POINTS) or 1
    data = {
        "title": Path(str(video.source)).name,
        "warnings": result.warnings,
        "links": [
            link | {key: rounded(link[key], 2) for key in ("place_iou", "appearance_log_odds")}
            for link in result.world.to_json()["links"]
        ],
        "objects": [_scene_object(o, result.tracks, steps, pictures) for o in result.objects],
        "thumbs": pictures.frames,
        "why_flat": _why_flat(result),
        "steps": {"frame": steps.tolist(), "seconds": seconds, "part": of_part.tolist()},
        **_scene_cameras(result, steps),
        "parts": [_scene_part(k, part, thin) for k, part in enumerate(result.parts())],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    head, tail = Path(__file__).with_name("scene.html").read_text().split("@DATA@")
    with atomic(path) as part:
        part.write_text(head + text.replace("<", "\\u003c") + tail)  # no name can end the script


SCENE_POINTS = 20000  # sparse points shown; of more every n-th (chosen: .4 MB of the page)


def _scene_cameras(result: Result, steps: IntArray) -> dict[str, Any]:
    """Collect the intrinsics and the cameras of the steps, each in the world of its part."""
    poses = result.poses
    if poses is None or not poses.known.any():
        return {"camera": None, "poses": ""}
    size, K = {"width": poses.camera.width, "height": poses.camera.height}, poses.camera.K
    shown = invert_rigid(poses.cam_from_world[np.isin(poses.frame, steps)])
    return {"camera": size | {"fx": K[0, 0], "fy": K[1, 1]}, "poses": base64_text(shown, "<f4")}


def _scene_part(number: int, part: Result, thin: int) -> dict[str, Any]:
    """Collect every `thin`-th point, scale and upward direction of one part, and its name."""
    poses, up = part.poses, part.world.up_in_world
    count, spans = len(part.objects), ", ".join(p.span_text for p in part.world.parts)
    facts = {
        "name": f"part {number}: {spans}; {count} object{'s' * (count != 1)}",
        "facts": _scene_facts(part.world),
        "scale": part.world.to_json()["scale"],
    }
    if poses is None or not poses.known.any():
        return facts | {"points": "", "colors": "", "up": [0, 0, 1]}
    if up is None:
        up = quadrics.camera_up(poses.camera.K @ poses.cam_from_world[poses.known])[0]
    return facts | {
        "points": base64_text(poses.points[::thin], "<f4"),
        "colors": base64_text(poses.colors[::thin], "u1"),
        "up": significant(up).tolist(),
    }


def _scene_object(
    found: Object, tracks: Tracks, steps: IntArray, pictures: Pictures
) -> dict[str, Any]:
    """Describe an object for the page.

    Its entry of objects.json without covariance, its colour, its pictures, and the steps in which
    it is seen (first, last, first, last ...).
    """
    seen = np.isin(steps, tracks.frame[tracks.track_id == found.id])
    runs = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]])))
    runs[1::2] -= 1
    return {k: v for k, v in found.to_json().items() if k != "cov"} | {
        "color": object_color(found.id)[::-1],
        "seen": runs.tolist(),
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
    result: Result, out: Path, video: Video, overlay: str = "solids", scene: bool = True
) -> None:
    """Write the film and scene.html in one pass over the video.

    Args:
        overlay: what the film shows (`film_layers`); "none": no film.

    Each file appears only when it is complete. A live source cannot be read again, and frames may
    have no images: no overlay then, and a page without pictures.
    """
    visible = video.has_images and not video.is_live
    drawn = film_layers(overlay) and visible
    film = Overlay(result, out / "overlay.mp4", video, overlay) if drawn else None
    pictures = Pictures(result, video) if scene else None
    sinks = [sink for sink in (film, pictures) if sink is not None and visible]
    progress, complete = Progress("write", video.expected), False
    try:
        for frame in video if sinks else ():
            for sink in sinks:
                sink.take(frame)
            progress.step()
        complete = True
    finally:
        progress.close(complete)
        if film is not None:
            film.close(complete)
    if pictures is not None:
        write_scene(result, pictures, out / "scene.html", video)
