"""Viewer, scene.html: a self-contained page of objects, cameras, points and pictures.

Its sources are in page/, beside this file; page.html includes the other files.

`write_pictures` reads the video once for the overlay video and the pictures of the viewer.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

import quadrics
from reobj.cameras import Camera, Poses, invert_rigid, place_of, undistort_boxes
from reobj.export.source import centred
from reobj.files import Progress, atomic, base64_text, read_text, rounded, significant
from reobj.poses.floor import NOISE
from reobj.results.changes import EarlierSession
from reobj.results.entries import Object, World, recording_name, visit_gap
from reobj.results.result import Result, sides
from reobj.sources.image_files import IMAGE_FPS
from reobj.sources.video import Video, shrunk
from reobj.types import (
    Array,
    BoolArray,
    Floats,
    Frame,
    Image,
    IntArray,
    ReobjError,
    Tracks,
    counted,
    log,
    object_color,
    one_line,
    rows_by,
)
from reobj.viewer.cloud import Cloud, DenseFrames, dense_frames
from reobj.viewer.overlay import Overlay

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
PAGE_VERSION = 1  # of the page's data: `serve` shows them in the page of this version


class Pictures:
    """Collect crops of the objects and whole frames for the viewer while the video is read.

    Their numbers and sizes keep the page of a video of three minutes with 50 objects below 10 MB.

    Attributes:
        wanted: rows of the tracks to crop, ascending. whole: numbers of the frames to keep.
        crops: [frame number, base64] of each object's crops, by identity, in temporal order.
        frames: [frame number, base64] of whole frames, undistorted.
        best: frame number of the best box of each object, by identity.
        time_s: of each frame that was read, by its number.
        dense: frames for dense points; None: without.
    """

    def __init__(self, result: Result, video: Video, dense: DenseFrames | None = None) -> None:
        """Choose the crops, at most 8 of an object and 480 of all, and 60 frames."""
        self.tracks = result.tracks
        self.scale = video.scale
        self.crops: dict[int, list[tuple[int, str]]] = {o.id: [] for o in result.objects}
        self.frames: list[tuple[int, str]] = []
        self.best: dict[int, int] = {}
        self.time_s: dict[int, float] = {}
        self.dense = dense
        poses = [component.poses for component in result.parts()]
        chosen: list[int] = []
        ranked = sorted(result.objects, key=lambda o: -o.frames_seen)
        for doubtful in (False, True):  # low-confidence objects get the remaining crops
            group = [o for o in ranked if (o.status == "doubtful") == doubtful]
            left = 480 - len(chosen)
            count = min(max(left // max(len(group), 1), 1), 8)
            for o in group[:left]:
                rows = diverse_rows(result.tracks, o, poses[o.part], count).tolist()
                if rows:
                    self.best[o.id] = int(result.tracks.frame[rows[0]])
                chosen += rows
        self.wanted = np.sort(np.array(chosen, np.int64))
        shown = scene_steps(result)
        cameras = result.poses
        if cameras is not None and cameras.known.any():
            shown = shown[cameras.known[np.searchsorted(cameras.frame, shown)]]
        self.whole = set(shown[:: math.ceil(len(shown) / 60) or 1].tolist())
        self.camera = None if cameras is None else cameras.camera
        self.grid: Floats | None = None  # (h, w, 2) distorted pixels of a picture

    def take(self, frame: Frame) -> None:
        """Crop the wanted boxes of this frame, and keep the frame if it is one of `whole`."""
        self.time_s[frame.index] = frame.time_s
        rows = self.wanted[self.tracks.frame[self.wanted] == frame.index]
        for obj, box in zip(self.tracks.track_id[rows], self.tracks.xyxy[rows], strict=True):
            if crop := _crop(frame.image, box * self.scale, 112):
                self.crops[int(obj)].append((frame.index, _base64(crop)))
        is_dense = self.dense is not None and frame.index in self.dense.wanted
        if is_dense or frame.index in self.whole:
            image = self._undistorted(shrunk(frame.image, 640))
        if frame.index in self.whole:
            self.frames.append((frame.index, _base64(_jpeg(image))))
        if self.dense is not None and is_dense:
            self.dense.take(frame.index, image)

    def _undistorted(self, image: Image) -> Image:
        """Undistort a small picture, so that projected solids coincide with their objects."""
        if self.camera is None or self.camera.model in PINHOLES:
            return image
        if self.grid is None:  # OpenCV's pixels: the centre of the first one is (0, 0)
            size = image.shape[1::-1]
            xy = np.stack(np.meshgrid(*map(np.arange, size)), -1).astype(np.float64) + 0.5
            self.grid = (_distorted(self.camera.resized(size), xy) - 0.5).astype(np.float32)
        x, y = np.moveaxis(self.grid, -1, 0)
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), np.uint8)


def _distorted(camera: Camera, xy: Array) -> Array:
    """Return the distorted pixels (..., 2) of pixels of the pinhole camera; -.5: none."""
    return np.asarray(np.nan_to_num(camera.distort(xy), nan=-0.5))


def _lens(camera: Camera) -> dict[str, Any] | None:
    """Return where the corners of a grid over the pinhole picture lie in a frame; None: the same.

    Within a cell the viewer neglects that its sides are inclined: a tenth of a pixel of the screen
    at the distortion of a phone.
    """
    if camera.model in PINHOLES:
        return None
    size = np.array([camera.width, camera.height])
    cells = np.array([64, 48])
    columns, rows = cells.tolist()
    corners = np.stack(np.meshgrid(np.arange(columns + 1), np.arange(rows + 1)), -1) / cells * size
    share = _distorted(camera, corners) / size
    return {"columns": columns, "rows": rows, "grid": base64_text(share, "<f4")}


def _crop(image: Image, box: Array, size_px: int) -> bytes:
    """Cut a box (4,), pixels of the image, out of it: a JPEG; b"" if the box is outside.

    Args:
        size_px: longest side.
    """
    margin = 0.1 * (box[2:] - box[:2])  # shows what the object stands on
    x1, y1 = (box[:2] - margin).clip(0).astype(int)
    x2, y2 = (box[2:] + margin + 1).clip(0).astype(int)
    part = image[y1:y2, x1:x2]
    return _jpeg(shrunk(part, size_px)) if part.size else b""


def _jpeg(image: Image) -> bytes:
    """Encode a small picture as JPEG; WebP: half the bytes, eight times the time."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1].tobytes()


def _base64(data: bytes) -> str:
    """Encode bytes for the page."""
    return base64.b64encode(data).decode()


def best_pictures(result: Result, video: Video, line: Progress) -> dict[int, bytes]:
    """Return a JPEG of the best box of each object with a shape in the first component.

    Args:
        line: of the progress; its steps are frames.
    Returns:
        pictures by identity, 1.7 kB each in rendered rooms.
    """
    poses = result.of_part(0).poses
    objects = [o for o in result.located if o.part == 0]
    rows = [row for o in objects for row in diverse_rows(result.tracks, o, poses, 1).tolist()]
    best = result.tracks[np.array(rows, np.int64)]
    pictures = {}
    for frame in video if rows else ():
        here = best[best.frame == frame.index]
        for identity, box in zip(here.track_id.tolist(), here.xyxy, strict=True):
            if crop := _crop(frame.image, box * video.scale, 160):
                pictures[identity] = crop
        line.step()
    line.close()
    return pictures


def diverse_rows(tracks: Tracks, obj: Object, poses: Poses | None, count: int) -> IntArray:
    """Choose diverse views of one object: (n,) rows of the tracks, n <= count.

    First the best box (large, high score), then repeatedly the box farthest from the ones taken in
    time and, where there are cameras, in viewing direction.

    Args:
        poses: of the object's component.
    """
    rows = np.flatnonzero(tracks.track_id == obj.id)
    if not len(rows):
        return rows
    frame = tracks.frame[rows]
    box = tracks.xyxy[rows]
    quality = tracks.score[rows] * (box[:, 2:] - box[:, :2]).clip(0).prod(1) ** 0.5  # (N,)
    feature = 2 * (frame / max(int(tracks.frame.max(initial=0)), 1))[:, None]  # (N, 1)
    if poses is not None and obj.center is not None:
        at, known = place_of(poses, frame)
        eye = invert_rigid(poses.cam_from_world[at])[:, :, 3]  # (N, 3)
        ray = np.where(known[:, None], eye - obj.center, np.nan)
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), np.finfo(float).tiny)
        feature = np.hstack([feature, np.nan_to_num(ray)])  # (N, 4)
        quality = np.where(np.isfinite(ray[:, 0]), quality, 0.01 * quality)  # without a pose: last
    chosen = [int(quality.argmax())]
    while len(chosen) < min(count, len(rows)):
        gap = np.linalg.norm(feature[:, None] - feature[chosen], axis=2).min(1)  # (N,)
        best = int((gap * quality**0.5).argmax())
        if gap[best] == 0:
            break
        chosen.append(best)
    return np.asarray(rows[chosen], np.int64)


def scene_steps(result: Result) -> IntArray:
    """List the frames (S,) of the time slider of the viewer: at most 1500, else every n-th."""
    frames = np.unique(result.tracks.frame) if result.poses is None else result.poses.frame
    return frames[:: math.ceil(len(frames) / 1500) or 1]


# What the page may load, besides its styles and scripts: of a file the recording beside it
OF_A_FILE = "img-src data:; media-src 'self' file:"
OF_A_SERVER = "img-src data: 'self'; media-src 'self'; connect-src 'self'"


def page_text(served: dict[str, Any] | None = None) -> str:
    """Return the page without its data: page.html, with each `@{file}` replaced by the file.

    Args:
        served: what the server of `serve` offers to the page; None: the page is a file.
    """
    folder = Path(__file__).with_name("page")

    def text_of(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8").strip()

    text = re.sub(r"@\{([\w.]+)\}", lambda match: text_of(match[1]), text_of("page.html"))
    text = text.replace("@ALLOWED@", OF_A_FILE if served is None else OF_A_SERVER)
    return text.replace("@SERVED@", json.dumps(served).replace("<", "\\u003c"))


def write_scene(
    result: Result,
    pictures: Pictures,
    path: Path,
    video: Video,
    doubtful: bool = False,
    command: str = "",
) -> None:
    """Write scene.html: solids, cameras, points and pictures in one page that needs no network.

    Its data are the entries of objects.json and changes.json, and base64 of little-endian float32 /
    uint8 arrays. A world far from its origin is shifted, by `origin` of its component; centres in
    entries of changes.json are not.

    Args:
        doubtful: show low-confidence objects initially; a switch shows and hides them.
        command: fits the objects again; the viewer shows it with the file of corrections.
    """
    steps = scene_steps(result)  # (S,)
    poses = result.poses
    count = len(np.unique(result.tracks.frame) if poses is None else poses.frame)
    seconds = video.config.every / (video.fps or IMAGE_FPS) * count / max(1, len(steps))
    is_file = video.has_images and not video.is_live and not video.files  # it can be played
    fps = result.video.fps or IMAGE_FPS  # for frames that were not read
    component = np.zeros(len(steps), int) if poses is None else poses.part_of(steps)  # (S,)
    # every n-th point: 20,000 are .4 MB of the page
    thin = math.ceil(0 if poses is None else len(poses.points) / 20_000) or 1
    components, origins = zip(*(centred(own) for own in result.parts()), strict=True)
    data = {
        "version": PAGE_VERSION,
        "title": recording_name(str(video.source)),
        "command": command,
        "warnings": result.warnings,
        "links": [
            link | {key: rounded(link[key], 2) for key in ("place_iou", "appearance_log_odds")}
            for link in result.world.to_json()["links"]
        ],
        "objects": [
            _scene_object(o, origins[o.part], result, steps, pictures) for o in result.objects
        ],
        "thumbs": pictures.frames,
        "film": Path(str(video.source)).name if is_file else "",
        "doubtful": doubtful,
        "size": {"width": result.video.width, "height": result.video.height},
        "visit_gap": visit_gap(result.tracks.frame, result.video.fps),
        "edits": [] if result.edits is None else result.edits.to_json(),
        "map": "" if result.poses is None else result.poses.map_id,
        "why_flat": _why_flat(result),
        "steps": {
            "frame": steps.tolist(),
            "time": [round(pictures.time_s.get(at, at / fps), 4) for at in steps.tolist()],
            "frame_s": 1 / (video.fps or IMAGE_FPS),
            "seconds": seconds,
            "part": component.tolist(),
        },
        **_scene_cameras(result, steps, np.array(origins)),
        "parts": [
            _scene_component(k, own, thin) | {"origin": origin.tolist()}
            for k, (own, origin) in enumerate(zip(components, origins, strict=True))
        ],
    }
    if (changes := result.changes) is not None:
        marked = dataclasses.replace(changes, new=()) if changes.made_the_map else changes
        data["changes"] = marked.to_json() | {"summary": changes.summary()}
    if pictures.dense is not None:
        clouds = [pictures.dense.cloud(k) for k in range(len(components))]
        for entry, origin, cloud in zip(data["parts"], origins, clouds, strict=True):
            entry |= {} if cloud is None else {"dense": _dense_points(cloud, origin)}
        if not any(clouds):
            log.warning("no dense points: the depth maps contradict each other; are units, "
                        "intrinsics and poses right?")  # fmt: skip
    if result.earlier:
        data["earlier"] = _earlier_sessions(result.earlier)
        for entry in data["objects"]:
            entry["best"] = pictures.best.get(entry["id"])
    with atomic(path) as part:
        part.write_text(_page_of(data, None), encoding="utf-8")


def _dense_points(cloud: Cloud, origin: Array) -> dict[str, Any]:
    """Return dense points for the page.

    Positions are 16-bit integers from `low` in steps of `step` world units, then colours are three
    bytes, then directions towards the cameras three signed bytes.
    """
    xyz = cloud.xyz - origin
    low = xyz.min(0)
    step = max(float(np.ptp(xyz, axis=0).max()) / 65535, np.finfo(float).tiny)
    data = ((xyz - low) / step).round().clip(0, 65535).astype("<u2").tobytes()
    data += cloud.rgb.tobytes() + (cloud.seen_from * 127).round().astype(np.int8).tobytes()
    facts = {"count": len(xyz), "low": low.tolist(), "step": step, "voxel": cloud.voxel}
    return facts | {"data": _base64(data)}


def _page_of(data: dict[str, Any], served: dict[str, Any] | None) -> str:
    """Return the page with its data; "<" is escaped: no name can end the script element."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    head, tail = page_text(served).split("@DATA@")
    return head + text.replace("<", "\\u003c") + tail


def served_page(
    path: Path, served: dict[str, Any], others: Sequence[EarlierSession] | None = None
) -> str:
    """Return the page of a scene.html for `serve`: its data, in the page of this version.

    No script of the file is used.

    Args:
        served: what the server offers to the page. others: recordings that the map has now, shown
            instead of those of the file if its recording was placed in the map; None: no map.
    Raises:
        ReobjError: the file is not a viewer of this version.
    """
    _, _, rest = read_text(path).partition('<script type="application/json" id="data">')
    try:
        data = msgspec.json.decode(rest.partition("</script>")[0])  # refuses NaN
    except (RecursionError, ValueError):
        data = None
    if not isinstance(data, dict) or data.get("version") != PAGE_VERSION:
        advice = "`objects OUT` makes it again"
        raise ReobjError(f"{path}: not a viewer that this version wrote; {advice}")
    changes = data.get("changes")
    if others is not None and isinstance(changes, dict) and not changes.get("refused"):
        data["earlier"] = _earlier_sessions(others)
    return _page_of(data, served)


def _scene_cameras(result: Result, steps: IntArray, origins: Array) -> dict[str, Any]:
    """Collect the intrinsics and the cameras of the steps, each in the world of its component.

    Args:
        origins: (P, 3) of the components.
    """
    poses = result.poses
    if poses is None or not poses.known.any():
        return {"camera": None, "poses": ""}
    camera = poses.camera
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    rows = np.isin(poses.frame, steps)
    shown = invert_rigid(poses.cam_from_world[rows])
    shown[:, :, 3] -= origins[poses.part[rows]]
    pinhole = {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx}
    return {
        "camera": pinhole | {"cy": cy, "lens": _lens(camera)},
        "poses": base64_text(shown, "<f4"),
    }


def _scene_component(number: int, component: Result, thin: int) -> dict[str, Any]:
    """Collect name, scale, floor, up, every `thin`-th point and their sigma of a component."""
    poses = component.poses
    up = component.world.up_in_world
    count = counted(len(component.objects), "object", "objects")
    spans = ", ".join(p.span_text for p in component.world.parts)
    facts = {
        "name": f"component {number}: {spans}; {count}",
        "facts": _scene_facts(component.world),
        "scale": component.world.to_json()["scale"],
        "directions_only": any(p.grade == "directions" for p in component.world.parts),
    }
    if poses is None or not poses.known.any():
        return facts | {"points": "", "colors": "", "up": [0, 0, 1]}
    if up is None:
        up = quadrics.camera_up(poses.camera.K @ poses.cam_from_world[poses.known])[0]
    if (floor := component.world.floor) is not None:
        facts["floor"] = {"normal": floor.normal.tolist(), "offset": floor.offset}
    eye = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]
    points = poses.points[:: len(poses.points) // 500 + 1]
    eyes = eye[:: len(eye) // 50 + 1]
    if len(points):  # sigma as for the floor: proportional to the distance
        distance = np.linalg.norm(points[:, None] - eyes, axis=2).min(1)
        facts["point_sigma"] = NOISE * float(np.median(distance))
    return facts | {
        "points": base64_text(poses.points[::thin], "<f4"),
        "colors": base64_text(poses.colors[::thin], "u1"),
        "up": significant(up).tolist(),
    }


def _scene_object(
    obj: Object, origin: Array, result: Result, steps: IntArray, pictures: Pictures
) -> dict[str, Any]:
    """Collect the data of an object for the viewer.

    Its entry of objects.json, colour, crops, size as text, the steps in which it is seen (first,
    last, first, last ...), its boxes in these steps, the steps in which they fill a gap, its
    tracklets (number, first, last frame), and boxes by which edits refer to it (frame, tracklet,
    x1, y1, x2, y2).
    """
    rows_of_object = result.tracks[result.tracks.track_id == obj.id]
    frames, first = np.unique(rows_of_object.frame, return_index=True)
    shown = rows_of_object[first[np.isin(frames, steps)]]
    box = shown.xyxy
    if result.poses is not None:
        box = undistort_boxes(box, result.poses.camera)
    detected = rows_of_object
    if detected.score.any():  # without interpolated boxes
        detected = detected[detected.score > 0]
    tracklets = [
        [int(detected.tracklet_id[rows[0]]), *detected.frame[rows[[0, -1]]].tolist()]
        for rows in rows_by(detected.tracklet_id)
    ]
    return obj.to_json() | {
        "center": None if obj.center is None else (obj.center - origin).tolist(),
        "cov": "" if obj.cov is None else base64_text(obj.cov, "<f4"),
        "color": object_color(obj.id)[::-1],
        "sides": sides(obj),
        "seen": _runs(np.isin(steps, shown.frame)),
        "filled": _runs(np.isin(steps, shown.frame[shown.score == 0])),
        "boxes": base64_text(box, "<f4"),
        "visits": obj.visits,
        "tracklets": sorted(tracklets, key=lambda tracklet: tracklet[1:]),
        "refs": _references(detected),
        "crops": pictures.crops[obj.id],
    }


def _runs(mask: BoolArray) -> list[int]:
    """Return first and last index of each run of True in a mask (S,)."""
    runs = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    runs[1::2] -= 1
    return [int(at) for at in runs]


def _references(detected: Tracks) -> list[list[float]]:
    """Choose boxes of an object, by time: the best one of each tracklet, and 100 spread evenly.

    100 boxes of 50 objects are .2 MB of the page.

    Returns:
        frame, tracklet, x1, y1, x2, y2 of each, native pixels.
    """
    best = [rows[detected.score[rows].argmax()] for rows in rows_by(detected.tracklet_id)]
    even = np.linspace(0, len(detected) - 1, min(100, len(detected))).round().astype(np.int64)
    row = np.union1d(np.array(best, np.int64), even)
    chosen = detected[row[np.argsort(detected.frame[row], kind="stable")]]
    columns = (chosen.frame.tolist(), chosen.tracklet_id.tolist(), chosen.xyxy.round(1).tolist())
    return [[frame, tracklet, *box] for frame, tracklet, box in zip(*columns, strict=True)]


def _earlier_sessions(sessions: Sequence[EarlierSession]) -> list[dict[str, Any]]:
    """Collect the earlier recordings for the viewer: objects, changes, the latest pictures."""
    entries: list[dict[str, Any]] = []
    left = 240  # pictures of all, .5 MB of the page
    for session in reversed(sessions):
        changes = session.changes
        count = counted(len(session.objects), "object", "objects")
        first = f"First recording of the map: {count}"
        chosen = sorted(session.pictures)[:left]
        left -= len(chosen)
        entries.append({
            "name": session.name,
            "date": session.date,
            "summary": first if changes is None else changes.summary(),
            "changes": None if changes is None else changes.to_json(),
            "objects": [_earlier_object(o) for o in session.objects],
            "pictures": {str(i): _base64(session.pictures[i]) for i in chosen},
        })  # fmt: skip
    return entries[::-1]


def _earlier_object(obj: Object) -> dict[str, Any]:
    """Collect what the viewer shows of an object in an earlier recording."""
    keys = ("id", "class", "support", "center", "half_axes", "quat_wxyz", "size", "size_m",
            "size_rel_sigma")  # fmt: skip
    entry = obj.to_json()
    cov = "" if obj.cov is None else base64_text(obj.cov, "<f4")
    return {key: entry[key] for key in keys} | {"cov": cov, "sides": sides(obj)}


def _why_flat(result: Result) -> str:
    """Return the reason why the viewer has nothing to show in 3D; "" if it has."""
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
        facts.append(f"scale from {world.scale.source.replace('_', ' ')}, ± {sigma:.0f} %")
    else:
        facts.append(f"units: {world.units}")
    facts += ["up is guessed from the cameras"] if world.up_in_world is None else []
    return " · ".join(facts)


def write_pictures(
    result: Result,
    out: Path,
    video: Video,
    overlay: bool = True,
    scene: bool = True,
    doubtful: bool = False,
    progress: Progress | None = None,
    command: str = "",
    cloud: bool = False,
    depth: str = "",
) -> list[str]:
    """Write the overlay video and scene.html in one pass over the video.

    Each file appears only when it is complete. A live source cannot be read again, and frames may
    have no images: then there is no overlay video, and the viewer has no pictures.

    Args:
        doubtful: include low-confidence objects in the overlay video; in the viewer, which always
            contains them, show them initially.
        progress: the line of the stage, whose steps are the frames.
        command: fits the objects again; the viewer shows it with the file of corrections.
        cloud: dense points in the viewer. depth: folder of the depth maps that they are made from.
    Returns:
        messages about files that could not be written, with the option to omit them. With the
        environment variable REOBJ_RAISE, as in our tests, bugs are raised instead.
    """
    visible = video.has_images and not video.is_live
    faults = _Faults()
    film = pictures = None
    with progress or Progress("write", video.expected) as line:
        if overlay and visible:
            with faults.of("overlay"):
                shown = result if doubtful else result.without_doubtful()
                film = Overlay(shown, out / "overlay.mp4", video)
        if scene:
            with faults.of("scene"):
                dense = dense_frames(result.poses, video, depth) if cloud and visible else None
                pictures = Pictures(result, video, dense)
        sinks = {"overlay": film, "scene": pictures}
        line.complete = False
        try:
            with faults.of("video"):
                for frame in video if any(sinks.values()) and visible else ():
                    for name, sink in sinks.items():
                        if sink is not None and name not in faults:
                            with faults.of(name):
                                sink.take(frame)
                    line.step()
                line.complete = True
        finally:
            if film is not None:
                with faults.of("overlay"):
                    film.close(line.complete and "overlay" not in faults)
        if pictures is not None and "scene" not in faults:
            with faults.of("scene"):
                page = dataclasses.replace(result, warnings=[*result.warnings, *faults.messages()])
                write_scene(page, pictures, out / "scene.html", video, doubtful, command)
    return faults.messages()


FAULTS = {
    "video": "no overlay video, and a viewer without later pictures: reading the video again "
    "failed with {} (--set output.overlay=none omits the overlay)",
    "overlay": "no overlay video: {} (--set output.overlay=none omits it)",
    "scene": "no scene.html: {} (--set output.scene=false omits it)",
}


class _Faults(dict[str, Exception]):
    """The first error of each key of FAULTS while the pictures of a result are written."""

    @contextlib.contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Store an exception of the block."""
        try:
            yield
        except Exception as error:
            if not isinstance(error, ReobjError | OSError) and os.environ.get("REOBJ_RAISE"):
                raise
            log.debug("pictures: fault in %s", name, exc_info=True)
            self.setdefault(name, error)

    def messages(self) -> list[str]:
        """Return what is missing, the reason, and the option to omit it."""
        return [
            one_line(FAULTS[name].format(f"{type(error).__name__}: {error}"))
            for name, error in self.items()
        ]
