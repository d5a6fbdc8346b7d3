"""Files for other tools, from an output folder: COCO-VID, CVAT, GLB, rerun.

Start at `export`. A writer takes a `Result` and a path; `EXPORTS` lists them.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from reobj import __version__
from reobj.cameras import Poses, invert_rigid, quat_wxyz_from_matrix
from reobj.files import atomic, spans
from reobj.results.result import Result
from reobj.results.workspace import Workspace
from reobj.sources.detection_files import CVAT_BOX
from reobj.sources.video import IMAGE_FPS
from reobj.types import Array, ReobjError, Tracks, log, object_classes, object_color


def export(out: str | Path, to: str, path: str | Path | None = None) -> Path:
    """Write what an output folder holds in another tool's format.

    Args:
        out: output folder of `run`. to: coco-vid, cvat, glb or rrd.
        path: default: OUT/ and the format's own name.
    Returns:
        The file written.
    Raises:
        ReobjError: no such format, no output folder, one of another version, or the format's
            package is missing.
    """
    if to not in EXPORTS:
        raise ReobjError(f"no export called {to!r}; there are {', '.join(EXPORTS)}")
    name, write = EXPORTS[to]
    path = Path(path) if path else Path(out) / name
    write(Result.load(out), path)
    return path


def _largest_part(result: Result, path: Path) -> Result:
    """Return the objects and cameras that fit into one world; warns of those that do not."""
    if len(parts := result.world.parts) > 1:
        held = f"part 0 of {len(parts)} ({parts[0].span_text})"
        log.warning("%s holds %s: the others have a frame and scale of their own", path, held)
    return result.of_part(0)


def _say_parts(result: Result, path: Path) -> None:
    """Say which objects are of which part: an object that two parts show is two of them."""
    if len(result.world.parts) > 1:
        ids = [spans(o.id for o in part.objects) or "none" for part in result.parts()]
        of = [f"{part.span_text}: {i}" for part, i in zip(result.world.parts, ids, strict=True)]
        log.warning("%s: no object is joined over the parts; objects of %s", path, "; ".join(of))


def _frames_read(result: Result) -> tuple[list[int], list[str]]:
    """List the frames that were read or have a track (filled gaps), ascending.

    Returns:
        source frame numbers, and the image names by frame number ([]: a video, or it is gone).
    """
    video = None
    if result.out is not None and (result.out / "cache" / "source.json").is_file():
        with contextlib.suppress(ReobjError):  # moved or deleted since: most exports need none
            video = Workspace.open(result.out).video()
    names = video.names if video is not None else []
    read = np.empty(0, np.int64)
    if result.poses is not None:
        read = result.poses.frame
    elif video is not None and video.frame_count:
        config, count = video.config, video.frame_count
        read = np.arange(config.start, min(config.stop or count, count), config.every)
    return np.union1d(read, result.tracks.frame).tolist(), names


def export_coco_vid(result: Result, path: Path) -> None:
    """Write COCO-VID as MMTracking reads it: images with frame_id, annotations with instance_id.

    bbox is x, y, w, h from the image's corner.
    """
    video, tracks = result.video, result.tracks
    frames, names = _frames_read(result)
    size = {"width": video.width, "height": video.height}
    image_id = {frame: i for i, frame in enumerate(frames, 1)}
    images = [
        {"id": image_id[f], "file_name": names[f] if names else f"{f:06d}.jpg", **size,
         "video_id": 1, "frame_id": f}
        for f in frames
    ]  # fmt: skip
    _say_parts(result, path)
    part_of: dict[int, dict[str, int]] = {}
    if len(result.world.parts) > 1:
        part_of = {o.id: {"part": o.part} for o in result.objects}
    corners = tracks.xyxy.round(2)
    boxes = np.hstack([corners[:, :2], corners[:, 2:] - corners[:, :2]]).round(2).tolist()
    annotations = [
        {"id": i + 1, "image_id": image_id[int(tracks.frame[i])], "video_id": 1,
         "category_id": int(tracks.class_id[i]) + 1, "instance_id": int(tracks.track_id[i]),
         "track_id": int(tracks.track_id[i]), "bbox": box, "area": round(box[2] * box[3], 2),
         "iscrowd": 0, "score": float(tracks.score[i]),
         **part_of.get(int(tracks.track_id[i]), {})}
        for i, box in enumerate(boxes)
    ]  # fmt: skip
    data = {
        "info": {"description": f"reobj_track {__version__}"},
        "videos": [{"id": 1, "name": Path(video.path).name, "fps": video.fps, **size}],
        "categories": [{"id": i, "name": name} for i, name in enumerate(result.class_names, 1)],
        "images": images,
        "annotations": annotations,
    }
    with atomic(path) as part:
        part.write_text(json.dumps(data) + "\n")


def export_cvat(result: Result, path: Path) -> None:
    """Write "CVAT for video 1.1": one track an object, every box a keyframe.

    `outside` marks the frame after each visit. CVAT numbers tracks from 0 in the order of the file:
    track 0 is object 1. Filled gaps are left out: corrected by hand they would count as detections.

    Source: cvat/apps/dataset_manager/formats/cvat.py; only keyframes are imported.
    """
    tracks, video = result.tracks, result.video
    frames, _ = _frames_read(result)
    _say_parts(result, path)
    root = ET.Element("annotations")
    ET.SubElement(root, "version").text = "1.1"
    task = ET.SubElement(ET.SubElement(root, "meta"), "task")
    for key, value in (("name", Path(video.path).name), ("mode", "interpolation"),
                       ("start_frame", 0), ("stop_frame", max(frames, default=0))):  # fmt: skip
        ET.SubElement(task, key).text = str(value)
    labels, size = ET.SubElement(task, "labels"), ET.SubElement(task, "original_size")
    for name in result.class_names:
        ET.SubElement(ET.SubElement(labels, "label"), "name").text = name
    for key in ("width", "height"):
        ET.SubElement(size, key).text = str(getattr(video, key))
    following = dict(itertools.pairwise(frames))
    for identity, class_id in object_classes(tracks).items():
        facts = {"id": str(identity - 1), "label": result.class_names[class_id], "source": "auto"}
        rows = tracks[(tracks.track_id == identity) & (tracks.score > 0)]
        _cvat_boxes(ET.SubElement(root, "track", facts), rows, following)
    ET.indent(root)
    with atomic(path) as part:
        ET.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)


def _cvat_boxes(track: ET.Element, rows: Tracks, following: dict[int, int]) -> None:
    """Add the boxes of a track, and one `outside` in the frame that follows the end of a visit."""
    seen = set(rows.frame.tolist())
    for frame, box in zip(rows.frame.tolist(), rows.xyxy, strict=True):
        corners = {k: f"{v:.2f}" for k, v in zip(CVAT_BOX, box, strict=True)}
        ends = following.get(frame, frame) not in seen
        for at, outside in ((frame, "0"), (following.get(frame), "1"))[: 1 + ends]:
            facts = {"frame": str(at), "outside": outside, "occluded": "0", "keyframe": "1"}
            ET.SubElement(track, "box", facts | corners | {"z_order": "0"})


def _upright(result: Result, path: Path, up_axis: Sequence[float]) -> tuple[float, Array]:
    """Measure the world for a viewer; warns of what is unknown.

    Returns:
        metres per unit (1 if unknown), and the rotation (3, 3) that brings up onto `up_axis`.
    """
    scale, up = result.world.scale, result.world.up_in_world
    metres = scale.value if scale is not None and scale.source != "none" else None
    if result.located:
        if not metres:
            log.warning("the scale is unknown: %s is not in metres; give --known-size", path)
        if up is None:
            log.warning("up is unknown: %s keeps the world's axes", path)
    turn = Rotation.align_vectors([up_axis], [up_axis if up is None else up])[0].as_matrix()
    return metres or 1.0, np.asarray(turn)


def export_glb(result: Result, path: Path) -> None:
    """Write binary glTF 2.0 with trimesh: a mesh an object, the sparse points, the camera path.

    The nodes are called "CLASS ID", each mesh has facts of its object in `extras`. y is up, units
    are metres if the scale is known.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ReobjError("trimesh is not installed: pip install 'reobj-track[viewer]'") from error
    result = _largest_part(result, path)
    scale, turn = _upright(result, path, [0.0, 1, 0])
    world, poses = np.eye(4), result.poses
    world[:3, :3] = scale * turn
    scene: Any = trimesh.Scene()
    ellipsoids = result.ellipsoids()
    columns = ellipsoids.world_from_obj * ellipsoids.half_axes[:, None]  # (O, 3, 3)
    for o, axes, center in zip(result.located, columns, ellipsoids.center_in_world, strict=True):
        mesh, name = trimesh.creation.icosphere(subdivisions=3), f"{o.class_name} {o.id}"
        mesh.visual.face_colors = [*object_color(o.id)[::-1], 255]
        entry = o.to_json()
        mesh.metadata = {k: entry[k] for k in ("id", "class", "status", "support", "size_m")}
        world_from_sphere = np.eye(4)
        world_from_sphere[:3, :3], world_from_sphere[:3, 3] = axes, center
        scene.add_geometry(mesh, name, name, transform=world @ world_from_sphere)
    if poses is not None and len(poses.points):
        make_cloud: Any = trimesh.PointCloud
        cloud = make_cloud(poses.points, colors=poses.colors)
        scene.add_geometry(cloud, "points", "points", transform=world)
    if poses is not None and poses.known.sum() > 1:
        centers = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]
        scene.add_geometry(trimesh.load_path(centers), "cameras", "cameras", transform=world)
    if not scene.geometry:
        raise ReobjError(f"{path}: nothing to show in 3D: no solids and no cameras here, see `run`")
    with atomic(path) as part:
        part.write_bytes(scene.export(file_type="glb"))


def export_rrd(result: Result, path: Path) -> None:
    """Write a recording for the rerun viewer with rerun-sdk.

    Ellipsoids, points and, on the timeline `frame`, the camera and the boxes it sees; z is up,
    units are metres if the scale is known.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise ReobjError("rerun is not installed: pip install 'reobj-track[viewer]'") from error
    largest = _largest_part(result, path)
    scale, turn = _upright(largest, path, [0.0, 0, 1])
    names = {o.id: f"{o.id} {o.class_name}" for o in result.objects}
    rec = rr.RecordingStream("reobj_track", recording_id=Path(result.video.path).name)
    rec.set_log_time_enabled(False)  # when the export was made is of no interest
    with atomic(path) as part:
        rec.save(part)
        views = rr.blueprint.Spatial3DView(), rr.blueprint.Spatial2DView(origin="world/camera")
        rec.send_blueprint(rr.blueprint.Blueprint(rr.blueprint.Horizontal(*views)))
        rec.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        rec.log("world", rr.Transform3D(mat3x3=turn), static=True)  # a scale: no pinholes
        ellipsoids = largest.ellipsoids()
        xyzw = np.roll(quat_wxyz_from_matrix(ellipsoids.world_from_obj), -1, 1)  # (O, 4)
        for i, o in enumerate(largest.located):
            solid = rr.Ellipsoids3D(
                half_sizes=scale * ellipsoids.half_axes[i : i + 1], labels=[names[o.id]],
                centers=scale * ellipsoids.center_in_world[i : i + 1],
                quaternions=xyzw[i : i + 1], fill_mode="solid",
                colors=[object_color(o.id)[::-1]],
            )  # fmt: skip
            rec.log(["world", "objects", o.class_name, str(o.id)], solid, static=True)
        if (poses := largest.poses) is not None:
            cloud = rr.Points3D(scale * poses.points, colors=poses.colors)
            rec.log("world/points", cloud, static=True)
        _rrd_frames(rr, rec, result, poses, names, scale)
        rec.disconnect()  # writes what is left


def _rrd_frames(
    rr: Any, rec: Any, result: Result, poses: Poses | None, names: dict[int, str], scale: float
) -> None:
    """Log each frame's camera, if `poses` have one, and boxes."""
    tracks, (frames, _) = result.tracks, _frames_read(result)
    pose_of = dict(zip(poses.frame.tolist(), poses.cam_from_world, strict=True)) if poses else {}
    fps = result.video.fps or IMAGE_FPS
    for frame in frames:
        rec.set_time("frame", sequence=frame)
        rec.set_time("time", duration=frame / fps)
        pose = pose_of.get(frame)
        if poses is None or pose is None or not np.isfinite(pose).all():
            rec.log("world/camera", rr.Clear(recursive=False))
        else:
            lens = {"image_from_camera": poses.camera.K, "camera_xyz": rr.ViewCoordinates.RDF}
            size = [poses.camera.width, poses.camera.height]
            to_child = {"relation": rr.TransformRelation.ChildFromParent}
            move = rr.Transform3D(translation=scale * pose[:, 3], mat3x3=pose[:, :3], **to_child)
            rec.log("world/camera", rr.Pinhole(**lens, resolution=size), move)
        rows = tracks[tracks.frame == frame]
        boxes = rr.Boxes2D(
            array=rows.xyxy, array_format=rr.Box2DFormat.XYXY,
            labels=[names[i] for i in rows.track_id.tolist()],
            colors=[object_color(i)[::-1] for i in rows.track_id.tolist()],
        )  # fmt: skip
        rec.log("world/camera/boxes", boxes)


EXPORTS: dict[str, tuple[str, Callable[[Result, Path], None]]] = {  # name: file in OUT, writer
    "coco-vid": ("coco_vid.json", export_coco_vid),
    "cvat": ("cvat.xml", export_cvat),
    "glb": ("objects.glb", export_glb),
    "rrd": ("scene.rrd", export_rrd),
}
