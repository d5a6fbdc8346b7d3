"""Files for other tools: COCO-VID, CVAT, GLB, rerun."""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from reobj import __version__
from reobj.cameras import Poses, invert_rigid, load_poses
from reobj.files import atomic
from reobj.results.evaluation import labelled
from reobj.sources.detection_files import CVAT_BOX, read_mot_rows
from reobj.sources.video import IMAGE_FPS, InputConfig, Video
from reobj.types import Array, ReobjError, Tracks, log, object_classes, object_color


@dataclass(frozen=True, slots=True)
class Saved:
    """What an output folder of `run` holds, read back for the exports.

    Attributes:
        data: objects.json; its `objects` and `world` as documented.
        table: the final identities in native pixels (tracks.txt); class_id counts in class_names.
        poses: cameras and sparse points, None if there are none. video: the source, None if gone.
    """

    out: Path
    data: dict[str, Any]
    table: Tracks
    class_names: tuple[str, ...]
    poses: Poses | None
    video: Video | None

    @staticmethod
    def load(out: str | Path) -> Saved:
        """Read an output folder; ReobjError when `run` or `track` did not finish there."""
        out = Path(out)
        if not (out / "objects.json").is_file() or not (out / "tracks.txt").is_file():
            raise ReobjError(f"{out}: no objects.json and tracks.txt; make them first with `run`")
        data = json.loads((out / "objects.json").read_text())
        names = tuple(dict.fromkeys(o["class"] for o in data["objects"]))
        class_of = {o["id"]: names.index(o["class"]) for o in data["objects"]}
        tracks = out / "tracks.txt"
        rows = read_mot_rows(tracks)
        found = labelled(rows)
        classes = np.array([class_of[i] for i in found.identity.tolist()], np.int64)
        unknown = np.full(len(found), -1, np.int64)
        ids, score = found.identity, rows[:, 6]
        table = Tracks(found.frame - 1, ids, ids, found.xyxy, score, classes, unknown)
        poses, source = (out / "cache" / n for n in ("last-poses.npz", "source.json"))
        video = None
        if source.is_file():
            with contextlib.suppress(ReobjError):  # moved or deleted since: most exports need none
                facts = json.loads(source.read_text())
                video = Video(facts["source"], InputConfig(**facts["input"]))
        read = load_poses(poses) if poses.is_file() else None
        return Saved(out, data, table, names, read, video)

    def frames(self) -> list[int]:
        """Numbers of the frames that were read; without the video those with a track."""
        if self.poses is not None:
            return [int(f) for f in self.poses.frame]
        seen = np.unique(self.table.frame).tolist()
        if self.video is None or not self.video.frame_count:
            return [int(f) for f in seen]
        config, count = self.video.config, self.video.frame_count
        return list(range(config.start, min(config.stop or count, count), config.every))


def export_coco_vid(saved: Saved, path: Path) -> None:
    """Write COCO-VID (MMTracking's): videos, images with frame_id, annotations with instance_id
    and track_id; bbox is x, y, w, h from the image's corner.
    """
    video, table = saved.data["video"], saved.table
    names = saved.video.names if saved.video is not None else []
    size = {"width": video["width"], "height": video["height"]}
    frames = saved.frames()
    image_id = {frame: i for i, frame in enumerate(frames, 1)}
    images = [
        {"id": image_id[f], "file_name": names[f] if names else f"{f:06d}.jpg", **size,
         "video_id": 1, "frame_id": f}
        for f in frames
    ]  # fmt: skip
    corners = table.xyxy.round(2)
    boxes = np.hstack([corners[:, :2], corners[:, 2:] - corners[:, :2]]).round(2).tolist()
    annotations = [
        {"id": i + 1, "image_id": image_id[int(table.frame[i])], "video_id": 1,
         "category_id": int(table.class_id[i]) + 1, "instance_id": int(table.track_id[i]),
         "track_id": int(table.track_id[i]), "bbox": box, "area": round(box[2] * box[3], 2),
         "iscrowd": 0, "score": float(table.score[i])}
        for i, box in enumerate(boxes)
    ]  # fmt: skip
    data = {
        "info": {"description": f"reobj_track {__version__}"},
        "videos": [{"id": 1, "name": Path(video["path"]).name, "fps": video["fps"], **size}],
        "categories": [{"id": i, "name": name} for i, name in enumerate(saved.class_names, 1)],
        "images": images,
        "annotations": annotations,
    }
    with atomic(path) as part:
        part.write_text(json.dumps(data) + "\n")


def export_cvat(saved: Saved, path: Path) -> None:
    """Write "CVAT for video 1.1": a track an object, every box a keyframe, `outside` where a visit
    ends. CVAT numbers tracks from 0 in the order of the file: track 0 is object 1.

    Source: cvat/apps/dataset_manager/formats/cvat.py; only keyframes are imported.
    """
    table, video = saved.table, saved.data["video"]
    frames = saved.frames()
    root = ET.Element("annotations")
    ET.SubElement(root, "version").text = "1.1"
    task = ET.SubElement(ET.SubElement(root, "meta"), "task")
    for key, value in (("name", Path(video["path"]).name), ("mode", "interpolation"),
                       ("start_frame", 0), ("stop_frame", max(frames, default=0))):  # fmt: skip
        ET.SubElement(task, key).text = str(value)
    labels, size = ET.SubElement(task, "labels"), ET.SubElement(task, "original_size")
    for name in saved.class_names:
        ET.SubElement(ET.SubElement(labels, "label"), "name").text = name
    for key in ("width", "height"):
        ET.SubElement(size, key).text = str(video[key])
    following = dict(itertools.pairwise(frames))
    for obj, cls in object_classes(table).items():
        track = {"id": str(obj - 1), "label": saved.class_names[cls], "source": "auto"}
        _cvat_boxes(ET.SubElement(root, "track", track), table[table.track_id == obj], following)
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


def _upright(saved: Saved, path: Path, up_axis: Sequence[float]) -> tuple[float, Array]:
    """Metres per unit (1 if unknown) and the rotation (3, 3) that brings the world's up onto this
    axis; what is unknown is said.
    """
    world = saved.data["world"]
    scale, up = world.get("scale") or {}, world.get("up_in_world")
    metres = scale.get("metres_per_unit") if scale.get("source") != "none" else None
    if any(o["center"] for o in saved.data["objects"]):
        if not metres:
            log.warning("the scale is unknown: %s is not in metres; give --known-size", path)
        if up is None:
            log.warning("up is unknown: %s keeps the world's axes", path)
    turn = Rotation.align_vectors([up_axis], [up or up_axis])[0].as_matrix()
    return metres or 1.0, np.asarray(turn)


def export_glb(saved: Saved, path: Path) -> None:
    """Write binary glTF 2.0: y up, in metres if the scale is known; a named mesh an object, its
    facts in `extras`; the sparse points and the camera's path. Needs trimesh.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ReobjError("trimesh is not installed: pip install 'reobj-track[viewer]'") from error
    scale, turn = _upright(saved, path, [0.0, 1, 0])
    world = np.eye(4)
    world[:3, :3] = scale * turn
    scene: Any = trimesh.Scene()
    for o in saved.data["objects"]:
        if o["status"] == "rejected":
            continue
        mesh, name = trimesh.creation.icosphere(subdivisions=3), f"{o['class']} {o['id']}"
        mesh.visual.face_colors = [*object_color(o["id"])[::-1], 255]
        mesh.metadata = {k: o[k] for k in ("id", "class", "status", "support", "size_m")}
        world_from_obj = np.eye(4)
        own = Rotation.from_quat(np.roll(o["quat_wxyz"], -1)).as_matrix()
        world_from_obj[:3, :3] = own * o["half_axes"]
        world_from_obj[:3, 3] = o["center"]
        scene.add_geometry(mesh, name, name, transform=world @ world_from_obj)
    if saved.poses is not None and len(saved.poses.points):
        make_cloud: Any = trimesh.PointCloud
        cloud = make_cloud(saved.poses.points, colors=saved.poses.colors)
        scene.add_geometry(cloud, "points", "points", transform=world)
    if saved.poses is not None and saved.poses.known.sum() > 1:
        path_of = invert_rigid(saved.poses.cam_from_world[saved.poses.known])[:, :, 3]
        scene.add_geometry(trimesh.load_path(path_of), "cameras", "cameras", transform=world)
    with atomic(path) as part:
        part.write_bytes(scene.export(file_type="glb"))


def export_rrd(saved: Saved, path: Path) -> None:
    """Write a recording for the rerun viewer: z up, in metres if the scale is known; ellipsoids,
    points, and on the timeline `frame` the camera and the boxes it sees. Needs rerun-sdk.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise ReobjError("rerun is not installed: pip install 'reobj-track[viewer]'") from error
    scale, turn = _upright(saved, path, [0.0, 0, 1])
    names = {o["id"]: f"{o['id']} {o['class']}" for o in saved.data["objects"]}
    rec = rr.RecordingStream("reobj_track", recording_id=Path(saved.data["video"]["path"]).name)
    rec.set_log_time_enabled(False)  # when the export was made is of no interest
    with atomic(path) as part:
        rec.save(part)
        views = rr.blueprint.Spatial3DView(), rr.blueprint.Spatial2DView(origin="world/camera")
        rec.send_blueprint(rr.blueprint.Blueprint(rr.blueprint.Horizontal(*views)))
        rec.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        rec.log("world", rr.Transform3D(mat3x3=turn), static=True)  # a scale: no pinholes
        for o in saved.data["objects"]:
            if o["status"] != "rejected":
                solid = rr.Ellipsoids3D(
                    half_sizes=scale * np.array([o["half_axes"]]), labels=[names[o["id"]]],
                    centers=scale * np.array([o["center"]]),
                    quaternions=[np.roll(o["quat_wxyz"], -1)], fill_mode="solid",
                    colors=[object_color(o["id"])[::-1]],
                )  # fmt: skip
                rec.log(["world", "objects", o["class"], str(o["id"])], solid, static=True)
        if saved.poses is not None:
            cloud = rr.Points3D(scale * saved.poses.points, colors=saved.poses.colors)
            rec.log("world/points", cloud, static=True)
        _rrd_frames(rr, rec, saved, names, scale)
        rec.disconnect()  # writes what is left


def _rrd_frames(rr: Any, rec: Any, saved: Saved, names: dict[int, str], scale: float) -> None:
    """Log each frame's camera, if it has one, and boxes."""
    poses, table, frames = saved.poses, saved.table, saved.frames()
    pose_of = dict(zip(poses.frame.tolist(), poses.cam_from_world, strict=True)) if poses else {}
    fps = saved.data["video"]["fps"] or IMAGE_FPS
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
        rows = table[table.frame == frame]
        boxes = rr.Boxes2D(
            array=rows.xyxy, array_format=rr.Box2DFormat.XYXY,
            labels=[names[i] for i in rows.track_id.tolist()],
            colors=[object_color(i)[::-1] for i in rows.track_id.tolist()],
        )  # fmt: skip
        rec.log("world/camera/boxes", boxes)


EXPORTS: dict[str, tuple[str, Callable[[Saved, Path], None]]] = {  # name: file in OUT, writer
    "coco-vid": ("coco_vid.json", export_coco_vid),
    "cvat": ("cvat.xml", export_cvat),
    "glb": ("objects.glb", export_glb),
    "rrd": ("scene.rrd", export_rrd),
}


def export(out: str | Path, to: str, path: str | Path | None = None) -> Path:
    """Write what an output folder holds in another tool's format.

    Args:
        out: output folder of `run`. to: a name of EXPORTS. path: default: OUT/ and its own name.
    Returns:
        The file written.
    """
    if to not in EXPORTS:
        raise ReobjError(f"no export called {to!r}; there are {', '.join(EXPORTS)}")
    name, write = EXPORTS[to]
    path = Path(path) if path else Path(out) / name
    write(Saved.load(out), path)
    return path
