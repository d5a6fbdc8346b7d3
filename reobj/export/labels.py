"""Labels and tables of a result: COCO-VID, CVAT, YOLO, CSV, and 3D boxes as CSV of Boxer."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from reobj import __version__
from reobj.cameras import place_of
from reobj.export.source import (
    formula_safe,
    frames_read,
    label_names,
    upright_world,
    warn_of_components,
)
from reobj.files import atomic, staged
from reobj.results.entries import write_json
from reobj.results.result import Object, Result, object_table
from reobj.sources.image_files import IMAGE_FPS
from reobj.types import Tracks, object_classes, rows_by, visible_name


def export_coco_vid(result: Result, path: Path) -> None:
    """Write COCO-VID for MMTracking: images with frame_id, annotations with instance_id.

    bbox is x, y, w, h in the corner convention.
    """
    video = result.video
    tracks = result.tracks
    frames, names = frames_read(result)
    size = {"width": video.width, "height": video.height}
    image_id = {frame: i for i, frame in enumerate(frames, 1)}
    images = [
        {"id": image_id[f], "file_name": names[f] if names else f"{f:06d}.jpg", **size,
         "video_id": 1, "frame_id": f}
        for f in frames
    ]  # fmt: skip
    warn_of_components(result, path)
    several = len(result.world.parts) > 1
    component_of = {o.id: {"part": o.part} for o in result.objects if several}
    low, high = np.hsplit(tracks.xyxy.round(2), 2)  # (N, 2) each
    boxes = np.hstack([low, high - low]).round(2).tolist()
    columns = (tracks.frame, tracks.track_id, tracks.class_id, tracks.score)
    rows = zip(boxes, *(column.tolist() for column in columns), strict=True)
    annotations = [
        {"id": i, "image_id": image_id[frame], "video_id": 1, "category_id": kind + 1,
         "instance_id": identity, "track_id": identity, "bbox": box,
         "area": round(box[2] * box[3], 2), "iscrowd": 0, "score": score,
         **component_of.get(identity, {})}
        for i, (box, frame, identity, kind, score) in enumerate(rows, 1)
    ]  # fmt: skip
    data = {
        "info": {"description": f"reobj_track {__version__}"},
        "videos": [{"id": 1, "name": Path(video.path).name, "fps": video.fps, **size}],
        "categories": [{"id": i, "name": name} for i, name in enumerate(result.class_names, 1)],
        "images": images,
        "annotations": annotations,
    }
    write_json(path, data, indent=None)


def export_cvat(result: Result, path: Path) -> None:
    """Write "CVAT for video 1.1": one track an object, every box a keyframe.

    `outside` marks the frame after each visit. CVAT numbers tracks from 0 in the order of the file:
    track 0 is object 1. Interpolated boxes are left out: reimported, they would be detections.

    Ref: cvat/apps/dataset_manager/formats/cvat.py; only keyframes are imported.
    """
    tracks = result.tracks
    frames, _ = frames_read(result)
    warn_of_components(result, path)
    root = ET.Element("annotations")
    ET.SubElement(root, "version").text = "1.1"
    task = ET.SubElement(ET.SubElement(root, "meta"), "task")
    name = visible_name(Path(result.video.path).name)
    facts = {"name": name, "mode": "interpolation", "start_frame": 0}
    for key, value in (facts | {"stop_frame": max(frames, default=0)}).items():
        ET.SubElement(task, key).text = str(value)
    labels = ET.SubElement(task, "labels")
    for name in result.class_names:
        ET.SubElement(ET.SubElement(labels, "label"), "name").text = name
    size = ET.SubElement(task, "original_size")
    for key in ("width", "height"):
        ET.SubElement(size, key).text = str(getattr(result.video, key))
    following = dict(itertools.pairwise(frames))
    for identity, class_id in object_classes(tracks).items():
        about = {"id": str(identity - 1), "label": result.class_names[class_id], "source": "auto"}
        rows = tracks[(tracks.track_id == identity) & (tracks.score > 0)]
        _cvat_boxes(ET.SubElement(root, "track", about), rows, following)
    ET.indent(root)
    with atomic(path) as part:
        ET.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)


def _cvat_boxes(track: ET.Element, rows: Tracks, following: dict[int, int]) -> None:
    """Add the boxes of a track, and an `outside` box in the frame after each visit."""
    seen = set(rows.frame.tolist())
    for frame, box in zip(rows.frame.tolist(), rows.xyxy, strict=True):
        corners = {k: f"{v:.2f}" for k, v in zip(("xtl", "ytl", "xbr", "ybr"), box, strict=True)}
        ends = following.get(frame, frame) not in seen
        for at, outside in ((frame, "0"), (following.get(frame), "1"))[: 1 + ends]:
            facts = {"frame": str(at), "outside": outside, "occluded": "0", "keyframe": "1"}
            ET.SubElement(track, "box", facts | corners | {"z_order": "0"})


def export_yolo(result: Result, path: Path) -> None:
    """Write data.yaml with the class names, and labels/NAME.txt beside it for frames with boxes.

    Rows are `class cx cy w h score id` as of ultralytics' tracker, relative to the image size;
    boxes are cut at the borders of the image. Filled gaps have score 0.
    """
    warn_of_components(result, path)
    labels = label_names(result)
    size = np.array([result.video.width, result.video.height], np.float64)
    tracks = result.tracks
    low, high = ((corner / size).clip(0, 1) for corner in np.hsplit(tracks.xyxy, 2))  # (M, 2) each
    columns = (tracks.class_id, (low + high) / 2, high - low, tracks.score, tracks.track_id)
    table = np.column_stack(columns)  # (M, 7)
    with staged(path.parent, ".part-yolo") as folder:
        for rows in rows_by(tracks.frame):
            label = folder / "labels" / f"{labels[int(tracks.frame[rows[0]])]}.txt"
            label.parent.mkdir(parents=True, exist_ok=True)
            kept = rows[(high > low)[rows].all(1)]
            np.savetxt(label, table[kept], ["%d", *["%.6f"] * 4, "%.6g", "%d"])
        names = [json.dumps(visible_name(name)) for name in result.class_names]
        entries = "".join(f"  {i}: {name}\n" for i, name in enumerate(names))
        head = "path: .\ntrain: images\nval: images\n"
        (folder / path.name).write_text(f"{head}names:\n{entries}", encoding="utf-8")


def export_csv(result: Result, path: Path) -> None:
    """Write the table of the objects, one a line, for spreadsheets.

    Text that a spreadsheet would read as a formula gets an apostrophe.
    """
    head, rows = object_table(result)
    with atomic(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        table.writerows([formula_safe(value) for value in row] for row in rows)


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
    quat = np.roll(world.quat_xyzw, 1, 1)
    size = 2 * world.ellipsoids.half_axes
    box = np.hstack([world.ellipsoids.center_in_world, quat, size])  # (O, 10)
    texts = {
        found.id: ",".join([*(f"{value:.9g}" for value in box[i]), _boxer_tail(found, numbers)])
        for i, found in enumerate(world.objects)
    }
    tracks = result.tracks[np.isin(result.tracks.track_id, list(texts))]
    tracks = tracks[tracks.score > 0]
    rows = zip(_times_ns(result, tracks), tracks.track_id.tolist(), strict=True)
    lines = [BOXER_HEADER, *(f"{time},{texts[i]}" for time, i in rows)]
    with atomic(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _boxer_tail(found: Object, numbers: dict[str, int]) -> str:
    """Return the columns name (lower case, without commas), instance, sem_id and prob."""
    name = formula_safe(visible_name(found.class_name).replace(",", " ").lower())
    prob = found.score if found.confidence is None else found.confidence
    return f"{name},{found.id},{numbers.get(found.class_name, -1)},{prob:.6g}"


def _times_ns(result: Result, tracks: Tracks) -> list[int]:
    """Return the times of rows in ns: of the poses, else by the frame rate."""
    times: Any = tracks.frame / (result.video.fps or IMAGE_FPS)
    if result.poses is not None and len(result.poses.frame):
        place, _ = place_of(result.poses, tracks.frame)
        read = result.poses.frame[place] == tracks.frame
        times = np.where(read, result.poses.time_s[place], times)
    return list((1e9 * times).round().astype(np.int64).tolist())
