"""Labels of a result with identities: YOLO, labelme, KITTI tracking; 3D boxes as CSV of Boxer."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import place_of
from reobj.files import atomic, staged
from reobj.results.entries import Object
from reobj.results.export_source import (
    formula_safe,
    image_files,
    label_names,
    upright_world,
    video_of,
    warn_of_components,
)
from reobj.results.result import Result
from reobj.results.upright import component_of
from reobj.sources.image_files import IMAGE_FPS
from reobj.types import Array, ReobjError, Tracks, rows_by, visible_name


def export_yolo(result: Result, path: Path) -> None:
    """Write data.yaml with the class names, and labels/NAME.txt beside it for frames with boxes.

    Rows are `class cx cy w h score id` as of ultralytics' tracker, relative to the image size;
    boxes are cut at the borders of the image. Filled gaps have score 0.
    """
    warn_of_components(result, path)
    labels = label_names(result, video_of(result), result.tracks.frame.tolist())
    size = np.array([result.video.width, result.video.height], np.float64)
    names = [visible_name(name) for name in result.class_names]
    with staged(path.parent, ".part-yolo") as folder:
        for frame, rows in _by_frame(result.tracks):
            low = (rows.xyxy[:, :2] / size).clip(0, 1)
            high = (rows.xyxy[:, 2:] / size).clip(0, 1)
            box = np.hstack([(low + high) / 2, high - low])
            lines = [
                f"{kind} {' '.join(f'{v:.6f}' for v in values)} {score:.6g} {identity}\n"
                for kind, values, score, identity in zip(
                    rows.class_id.tolist(), box.tolist(), rows.score.tolist(),
                    rows.track_id.tolist(), strict=True,
                )
                if values[2] > 0 and values[3] > 0
            ]  # fmt: skip
            label = folder / "labels" / f"{labels[frame]}.txt"
            label.parent.mkdir(parents=True, exist_ok=True)
            label.write_text("".join(lines), encoding="utf-8")
        entries = "".join(f"  {i}: {json.dumps(name)}\n" for i, name in enumerate(names))
        head = "path: .\ntrain: images\nval: images\n"
        (folder / path.name).write_text(f"{head}names:\n{entries}", encoding="utf-8")


def export_labelme(result: Result, path: Path) -> None:
    """Write labelme's label files: the list of classes, and NAME.json for each frame with boxes.

    A rectangle has its class as `label` and its identity as `group_id`. Images of a folder are
    referenced; frames of a video are written to images/, their labels beside them. Without filled
    gaps, as they are no detections.

    Ref: github.com/wkentaro/labelme, labelme/_label_file.py.
    """
    warn_of_components(result, path)
    video = video_of(result)
    if video is None:
        raise ReobjError(f"{path}: labelme needs the images, but the video was moved or deleted")
    if not video.has_images:
        raise ReobjError(f"{path}: this run had no images, and labelme needs them; try --to yolo")
    names = [visible_name(name) for name in result.class_names]
    tracks = result.tracks[result.tracks.score > 0]
    with staged(path.parent, ".part-labelme") as folder:
        files = image_files(video, tracks.frame.tolist(), path.parent, folder)
        labels = {frame: Path(file).with_suffix("").as_posix() for frame, file in files.items()}
        if video.files:
            labels = label_names(result, video, files)
        for frame, rows in _by_frame(tracks):
            if frame not in files:
                continue
            shapes = [
                {"label": names[kind], "points": [box[:2], box[2:]], "group_id": identity,
                 "shape_type": "rectangle", "flags": {}}
                for kind, box, identity in zip(
                    rows.class_id.tolist(), rows.xyxy.tolist(), rows.track_id.tolist(), strict=True
                )
            ]  # fmt: skip
            label = folder / f"{labels[frame]}.json"
            image = os.path.relpath(files[frame], label.parent.relative_to(folder))
            data: dict[str, Any] = {
                "version": "5.5.0", "flags": {}, "shapes": shapes, "imageData": None,
                "imagePath": Path(image).as_posix(), "imageHeight": result.video.height,
                "imageWidth": result.video.width,
            }  # fmt: skip
            label.parent.mkdir(parents=True, exist_ok=True)
            label.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        classes = "".join(f"{name}\n" for name in names)
        (folder / path.name).write_text(classes, encoding="utf-8")


def _by_frame(tracks: Tracks) -> Iterator[tuple[int, Tracks]]:
    """Yield the rows of each frame with rows."""
    for rows in rows_by(tracks.frame):
        yield int(tracks.frame[rows[0]]), tracks[rows]


# ---- KITTI -------------------------------------------------------------------------------------


def export_kitti(result: Result, path: Path) -> None:
    """Write results of KITTI tracking: 18 columns, frames from 0, metres if the scale is known.

    Location and `rotation_y` are in the camera of the frame: bottom centre, and the heading of the
    object's x axis in the camera's x-z plane; `l`, `w`, `h` are the extents along the object's x, y
    and z axes. Without a shape, or in a frame without a pose: -1, -1000 and -10 as in KITTI.
    Unknown are `truncated` and `occluded` (-1). Filled gaps have score 0.

    Ref: KITTI tracking development kit, readme.txt.
    """
    warn_of_components(result, path)
    tracks = result.tracks
    names = [visible_name(name).replace(" ", "_") for name in result.class_names]
    facts = _kitti_facts(result)  # (M, 8)
    lines = []
    for i, (frame, identity, kind) in enumerate(
        zip(tracks.frame.tolist(), tracks.track_id.tolist(), tracks.class_id.tolist(), strict=True)
    ):
        alpha, *shape = facts[i].tolist()
        box = " ".join(f"{v:.2f}" for v in tracks.xyxy[i])
        solid = " ".join(f"{v:.4f}" for v in shape)
        score = f"{tracks.score[i]:.6g}"
        lines.append(f"{frame} {identity} {names[kind]} -1 -1 {alpha:.4f} {box} {solid} {score}\n")
    with atomic(path) as part:
        part.write_text("".join(lines), encoding="utf-8")


def _kitti_facts(result: Result) -> Array:
    """Return alpha, h, w, l, x, y, z, rotation_y (M, 8) of the rows of the tracks."""
    tracks = result.tracks
    facts = np.tile([-10.0, -1, -1, -1, -1000, -1000, -1000, -10], (len(tracks), 1))
    poses = result.poses
    if poses is None or not poses.known.any():
        return facts
    place, known = place_of(poses, tracks.frame)
    for found in result.located:
        rows = np.flatnonzero(known & (tracks.track_id == found.id))
        rows = rows[poses.part[place[rows]] == found.part]
        cams = poses.cam_from_world[place[rows]]  # (R, 3, 4)
        scale = component_of(found, result.world).scale
        metres = scale.value if scale is not None and scale.source != "none" else 1.0
        xyzw = np.roll(np.asarray(found.quat_wxyz, np.float64), -1)
        axes = Rotation.from_quat(xyzw).as_matrix()
        size = np.asarray(found.size, np.float64)
        bottom = np.asarray(found.center, np.float64) - axes[:, 2] * size[2] / 2
        location = cams[:, :, :3] @ bottom + cams[:, :, 3]
        heading = cams[:, :, :3] @ axes[:, 0]
        turn = np.arctan2(-heading[:, 2], heading[:, 0])
        alpha = turn - np.arctan2(location[:, 0], location[:, 2])
        facts[rows, 0] = (alpha + np.pi) % (2 * np.pi) - np.pi
        facts[rows, 1:4] = metres * size[::-1]
        facts[rows, 4:7] = metres * location
        facts[rows, 7] = turn
    return facts


# ---- Boxer -------------------------------------------------------------------------------------

BOXER_HEADER = (
    "time_ns,tx_world_object,ty_world_object,tz_world_object,qw_world_object,qx_world_object,"
    "qy_world_object,qz_world_object,scale_x,scale_y,scale_z,name,instance,sem_id,prob"
)


def export_boxer(result: Result, path: Path) -> None:
    """Write the 3D boxes of each frame as CSV of Boxer, WildDet3D and ATEK: 15 columns.

    World z up, full extents; `instance` is the object, `sem_id` the number of its class. A row for
    each frame with a detection of the object; the box is the same in all.

    Ref: github.com/facebookresearch/boxer, utils/file_io.py (`ObbCsvWriter2`).
    """
    world = upright_world(result, path)
    numbers = {name: i for i, name in enumerate(result.class_names)}
    tails = {found.id: _boxer_tail(found, numbers) for found in world.objects}
    quat = np.roll(world.quat_xyzw, 1, 1)
    size = 2 * world.ellipsoids.half_axes
    box = np.hstack([world.ellipsoids.center_in_world, quat, size])  # (O, 10)
    texts = {
        found.id: ",".join(f"{value:.9g}" for value in box[i])
        for i, found in enumerate(world.objects)
    }
    tracks = result.tracks[np.isin(result.tracks.track_id, list(texts))]
    tracks = tracks[tracks.score > 0]
    times = _times_ns(result, tracks)
    lines = [BOXER_HEADER, *(
        f"{time},{texts[i]},{tails[i]}"
        for time, i in zip(times, tracks.track_id.tolist(), strict=True)
    )]  # fmt: skip
    with atomic(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _boxer_tail(found: Object, numbers: dict[str, int]) -> str:
    """Return the columns name (lower case, without commas), instance, sem_id and prob."""
    name = formula_safe(visible_name(found.class_name).replace(",", " ").lower())
    prob = found.score if found.confidence is None else found.confidence
    return f"{name},{found.id},{numbers.get(found.class_name, -1)},{prob:.6g}"


def _times_ns(result: Result, tracks: Tracks) -> list[int]:
    """Return the times of rows in ns: of the poses, else by the frame rate."""
    fps = result.video.fps or IMAGE_FPS
    times: Any = tracks.frame / fps
    if result.poses is not None and len(result.poses.frame):
        place, _ = place_of(result.poses, tracks.frame)
        read = result.poses.frame[place] == tracks.frame
        times = np.where(read, result.poses.time_s[place], times)
    return list((1e9 * times).round().astype(np.int64).tolist())
