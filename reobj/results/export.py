"""Export of results to the formats of other tools.

Start at `export`. EXPORTS lists the writers.
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import cv2
import numpy as np

from reobj import __version__
from reobj.cameras import (
    CV_FROM_GL,
    Camera,
    Poses,
    camera_parameters,
    invert_rigid,
    quat_wxyz_from_matrix,
)
from reobj.files import atomic, staged
from reobj.results.export_labels import (
    export_boxer,
    export_kitti,
    export_labelme,
    export_yolo,
)
from reobj.results.export_ros import export_mcap, export_ros
from reobj.results.export_source import (
    formula_safe,
    frames_read,
    image_files,
    largest_part,
    upright,
    video_of,
    warn_of_components,
    warn_of_origin,
)
from reobj.results.export_usd import export_usd
from reobj.results.origin import centred, far_origin, shifted
from reobj.results.ply import write_ply, write_point_ply
from reobj.results.result import Result, VideoInfo
from reobj.results.table import object_table
from reobj.sources.image_files import IMAGE_FPS
from reobj.sources.video import Video
from reobj.types import (
    Array,
    Frame,
    Image,
    ReobjError,
    Tracks,
    log,
    object_classes,
    object_color,
    visible_name,
)


def export(out: str | Path, to: str, path: str | Path | None = None) -> Path:
    """Convert the results of an output folder to the format of another tool.

    Args:
        out: output folder of `run`. to: a name in EXPORTS.
        path: file to write; default: in OUT, with the format's default name.
    Returns:
        path of the written file.
    Raises:
        ReobjError: no such format, no output folder or one of another version, or a missing
            package.
    """
    if to not in EXPORTS:
        raise ReobjError(f"no export called {to!r}; there are {', '.join(EXPORTS)}")
    name, write = EXPORTS[to]
    path = Path(path) if path else Path(out) / name
    result = Result.load(out)
    for identity in result.tracks.track_id[result.tracks.class_id < 0][:1]:
        where = f"{Path(out) / 'tracks.txt'}: object {identity} is not in objects.json"
        raise ReobjError(f"{where}: run the video again, or correct it by edits.json")
    write(result, path)
    return path


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
        part.write_text(json.dumps(data) + "\n", encoding="utf-8")


def export_cvat(result: Result, path: Path) -> None:
    """Write "CVAT for video 1.1": one track an object, every box a keyframe.

    `outside` marks the frame after each visit. CVAT numbers tracks from 0 in the order of the file:
    track 0 is object 1. Interpolated boxes are left out: reimported, they would be detections.

    Ref: cvat/apps/dataset_manager/formats/cvat.py; only keyframes are imported.
    """
    tracks = result.tracks
    video = result.video
    frames, _ = frames_read(result)
    warn_of_components(result, path)
    root = ET.Element("annotations")
    ET.SubElement(root, "version").text = "1.1"
    task = ET.SubElement(ET.SubElement(root, "meta"), "task")
    for key, value in (("name", visible_name(Path(video.path).name)), ("mode", "interpolation"),
                       ("start_frame", 0), ("stop_frame", max(frames, default=0))):  # fmt: skip
        ET.SubElement(task, key).text = str(value)
    labels = ET.SubElement(task, "labels")
    size = ET.SubElement(task, "original_size")
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
    """Add the boxes of a track, and an `outside` box in the frame after each visit."""
    seen = set(rows.frame.tolist())
    for frame, box in zip(rows.frame.tolist(), rows.xyxy, strict=True):
        corners = {k: f"{v:.2f}" for k, v in zip(("xtl", "ytl", "xbr", "ybr"), box, strict=True)}
        ends = following.get(frame, frame) not in seen
        for at, outside in ((frame, "0"), (following.get(frame), "1"))[: 1 + ends]:
            facts = {"frame": str(at), "outside": outside, "occluded": "0", "keyframe": "1"}
            ET.SubElement(track, "box", facts | corners | {"z_order": "0"})


def export_glb(result: Result, path: Path) -> None:
    """Write binary glTF 2.0 with trimesh: a mesh per object, the sparse points, the camera path.

    The nodes are named "CLASS ID"; `extras` of a mesh has data of its object. (x, z, -y) of the
    upright frame of the other exports, as y is up in glTF; metres if the scale is known.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ReobjError("trimesh is not installed: pip install trimesh") from error
    result, origin = centred(largest_part(result, path))
    scale, rotation = upright(result, path)
    warn_of_origin(origin, path)
    world = np.eye(4)
    poses = result.poses
    if result.world.up_in_world is not None:
        rotation = rotation[[0, 2, 1]] * [[1], [1], [-1]]  # (3, 3) z up to y up: x, z, -y
    world[:3, :3] = scale * rotation
    scene: Any = trimesh.Scene(metadata={"origin_in_world": origin.tolist()})
    ellipsoids = result.ellipsoids()
    columns = ellipsoids.world_from_obj * ellipsoids.half_axes[:, None]  # (O, 3, 3)
    for o, axes, center in zip(result.located, columns, ellipsoids.center_in_world, strict=True):
        mesh = trimesh.creation.icosphere(subdivisions=3)
        name = f"{o.class_name} {o.id}"
        mesh.visual.face_colors = [*object_color(o.id)[::-1], 255]
        entry = o.to_json()
        mesh.metadata = {k: entry[k] for k in ("id", "class", "status", "support", "size_m")}
        world_from_sphere = np.eye(4)
        world_from_sphere[:3, :3] = axes
        world_from_sphere[:3, 3] = center
        scene.add_geometry(mesh, name, name, transform=world @ world_from_sphere)
    if poses is not None and len(poses.points):
        make_cloud: Any = trimesh.PointCloud
        cloud = make_cloud(poses.points, colors=poses.colors)
        scene.add_geometry(cloud, "points", "points", transform=world)
    if poses is not None and poses.known.sum() > 1:
        centers = invert_rigid(poses.cam_from_world[poses.known])[:, :, 3]
        scene.add_geometry(trimesh.load_path(centers), "cameras", "cameras", transform=world)
    if not scene.geometry:
        raise ReobjError(f"{path}: nothing to export: the result has no solids and no cameras, see "
                         "`run`")  # fmt: skip
    with atomic(path) as part:
        part.write_bytes(scene.export(file_type="glb"))


def export_ply(result: Result, path: Path) -> None:
    """Write the solids as one coloured, closed triangle mesh (trimesh, Open3D, MeshLab).

    In the world and units of poses.txt: the fitted boxes, cylinders and ellipsoids.
    """
    result = largest_part(result, path)
    if not result.located:
        raise ReobjError(f"{path}: nothing to export: the result has no solids, see `run`")
    located = result.located
    write_ply(path, result.ellipsoids(), [o.id for o in located], [o.support for o in located])


def export_csv(result: Result, path: Path) -> None:
    """Write the table of the objects, one a line, for spreadsheets.

    Text that a spreadsheet would read as a formula gets an apostrophe.
    """
    head, rows = object_table(result)
    with atomic(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        table.writerows([formula_safe(value) for value in row] for row in rows)


def export_nerfstudio(result: Result, path: Path) -> None:
    """Write transforms.json for nerfstudio, with initial points and the images of a video.

    The world is that of poses.txt. Images of a folder are referenced; frames of a video are written
    to images/ beside the file.

    Ref: docs.nerf.studio, "Data conventions": camera axes of OpenGL, world_from_cam.
    """
    result, origin = centred(largest_part(result, path))
    poses = result.poses
    video = video_of(result)
    if poses is None or not poses.known.any():
        raise ReobjError(f"{path}: the result has no cameras, see `run`")
    if video is None:
        raise ReobjError(f"{path}: nerfstudio needs the images, but the video was moved or deleted")
    if not video.has_images:
        raise ReobjError(f"{path}: this run had no images, and nerfstudio needs them; try --to rrd")
    with staged(path.parent, ".part-nerfstudio") as folder:
        _write_nerfstudio(poses, origin, video, path, folder)


def _write_nerfstudio(poses: Poses, origin: Array, video: Video, path: Path, folder: Path) -> None:
    """Write `path`, its points and images into a new folder.

    Args:
        origin: (3,) of the written world, in the world of poses.txt.
    """
    world_from_cam = np.tile(np.eye(4), (len(poses.frame), 1, 1))
    world_from_cam[:, :3] = invert_rigid(poses.cam_from_world)
    world_from_cam[:, :3, :3] = world_from_cam[:, :3, :3] @ CV_FROM_GL
    files = image_files(video, poses.frame[poses.known].tolist(), path.parent, folder)
    frames = [
        {"file_path": files[frame], "transform_matrix": pose.tolist()}
        for frame, pose in zip(poses.frame.tolist(), world_from_cam, strict=True)
        if frame in files and np.isfinite(pose).all()
    ]
    data = _nerf_camera(poses.camera, path) | {"frames": frames}
    if origin.any():  # nerfstudio has float32
        data["applied_transform"] = np.column_stack([np.eye(3), -origin]).tolist()
    if len(poses.points):
        write_point_ply(folder / "sparse_pc.ply", poses.points, poses.colors)
        data["ply_file_path"] = "sparse_pc.ply"
    (folder / path.name).write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _nerf_camera(camera: Camera, path: Path) -> dict[str, Any]:
    """Convert the intrinsics to nerfstudio's; warn about distortion that it does not support."""
    values = dict(zip(camera_parameters(camera.model), camera.params, strict=True))
    fisheye = camera.model == "OPENCV_FISHEYE"
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")  # nerfstudio's
    terms = {"k1": values.pop("k", 0.0)} | {k: v for k, v in values.items() if k[0] in "kp"}
    known = {k: terms.get(k, 0.0) for k in order}
    pinhole = {"f", "fx", "fy", "cx", "cy", "k"}
    if any(v for k, v in values.items() if k not in known and k not in pinhole):
        log.warning("%s: nerfstudio has no %s cameras: the rest of the distortion is left out",
                    path, camera.model)  # fmt: skip
    K = camera.K
    facts = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    size = {"w": camera.width, "h": camera.height}
    return {"camera_model": model, **{k: float(v) for k, v in facts.items()}, **size, **known}


# ---- rerun -------------------------------------------------------------------------------------


def live_labels(tracks: Tracks, names: Sequence[str]) -> list[str]:
    """Return identity and class of each row, as text."""
    return [
        f"{i} {names[c] if 0 <= c < len(names) else 'object'}"
        for i, c in zip(tracks.track_id.tolist(), tracks.class_id.tolist(), strict=True)
    ]


class Viewer:
    """A rerun recording: to a file, or live to its viewer while a video is tracked.

    Contains ellipsoids, points and, on the timelines `frame` and `time`, the camera, its image and
    the boxes in it; z is up, units are metres if the scale is known.

    Attributes:
        followed: the images of the video were logged while it was tracked.
    """

    def __init__(self, video: VideoInfo, start: Callable[[Any], Any] | None = None) -> None:
        """Open a recording of a video; `start` connects its output (default: rerun's viewer)."""
        try:
            import rerun as rr
        except ImportError as error:
            raise ReobjError("rerun is not installed: pip install rerun-sdk") from error
        self.rr = rr
        self.video = video
        self.followed = False
        # 640 px, longer side of the images: 40 kB a frame
        self.shrink = min(1.0, 640 / max(video.width, video.height, 1))
        name = visible_name(Path(video.path).name)
        self.rec = rr.RecordingStream("reobj_track", recording_id=name)
        self.rec.set_log_time_enabled(False)  # same result, same timelines
        if start is None:
            self.rec.spawn()
        else:
            start(self.rec)
        views = rr.blueprint.Spatial3DView(), rr.blueprint.Spatial2DView(origin="world/camera")
        self.rec.send_blueprint(rr.blueprint.Blueprint(rr.blueprint.Horizontal(*views)))
        self.rec.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def follow(
        self, steps: Iterable[tuple[Frame, Tracks]], names: Sequence[str], video: Video,
        poses: Poses | None,
    ) -> Iterator[tuple[Frame, Tracks]]:  # fmt: skip
        """Log and yield each frame of a running `track`."""
        self.followed = True
        if poses is not None:
            poses = shifted(poses, far_origin(poses))
        pose_of = _pose_by_frame(poses)
        if poses is not None:
            cloud = self.rr.Points3D(poses.points, colors=poses.colors)
            self.rec.log("world/points", cloud, static=True)
        for frame, tracks in steps:
            labels = live_labels(tracks, names)
            native = dataclasses.replace(tracks, xyxy=tracks.xyxy / video.scale)
            self._frame(frame.index, poses, pose_of.get(frame.index), 1.0, native, labels)
            self._image(frame.image)
            yield frame, tracks

    def show(self, result: Result, path: Path, images: bool) -> None:
        """Log a result: solids and points (of the largest component), and all frames.

        Args:
            path: for warnings. images: read the video again and log its images.
        """
        rr = self.rr
        rec = self.rec
        largest, origin = centred(largest_part(result, path))
        scale, turn = upright(largest, path)
        warn_of_origin(origin, path)
        names = {o.id: f"{o.id} {o.class_name}" for o in result.objects}
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
        pose_of = _pose_by_frame(poses)
        tracks = result.tracks
        frames, _ = frames_read(result)
        video = video_of(result) if images else None
        shown = iter(video if video is not None and video.has_images else ())
        ahead = next(shown, None)
        for frame in frames:
            rows = tracks[tracks.frame == frame]
            labels = [names[i] for i in rows.track_id.tolist()]
            self._frame(frame, poses, pose_of.get(frame), scale, rows, labels)
            while ahead is not None and ahead.index <= frame:
                if ahead.index == frame:
                    self._image(ahead.image)
                ahead = next(shown, None)

    def _frame(
        self, frame: int, poses: Poses | None, pose: Array | None, scale: float, rows: Tracks,
        labels: list[str],
    ) -> None:  # fmt: skip
        """Set the time; log the camera, if the frame has a pose, and boxes in native pixels."""
        rr = self.rr
        rec = self.rec
        shrink = self.shrink
        rec.set_time("frame", sequence=frame)
        rec.set_time("time", duration=frame / (self.video.fps or IMAGE_FPS))
        if poses is None or pose is None or not np.isfinite(pose).all():
            rec.log("world/camera", rr.Clear(recursive=False))
        else:
            K = np.diag([shrink, shrink, 1.0]) @ poses.camera.K
            size = [round(shrink * poses.camera.width), round(shrink * poses.camera.height)]
            lens = {"image_from_camera": K, "camera_xyz": rr.ViewCoordinates.RDF}
            to_child = {"relation": rr.TransformRelation.ChildFromParent}
            move = rr.Transform3D(translation=scale * pose[:, 3], mat3x3=pose[:, :3], **to_child)
            rec.log("world/camera", rr.Pinhole(**lens, resolution=size), move)
        boxes = rr.Boxes2D(
            array=shrink * rows.xyxy, array_format=rr.Box2DFormat.XYXY, labels=labels,
            colors=[object_color(i)[::-1] for i in rows.track_id.tolist()],
        )  # fmt: skip
        rec.log("world/camera/boxes", boxes)

    def _image(self, image: Image) -> None:
        """Log the frame's image at the time that is set."""
        size = (round(self.shrink * self.video.width), round(self.shrink * self.video.height))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        encoded = self.rr.EncodedImage(contents=data, media_type="image/jpeg")
        self.rec.log("world/camera/image", encoded)

    def close(self) -> None:
        """Send or write the remaining data."""
        self.rec.disconnect()


def _pose_by_frame(poses: Poses | None) -> dict[int, Array]:
    if poses is None:
        return {}
    return dict(zip(poses.frame.tolist(), poses.cam_from_world, strict=True))


def export_rrd(result: Result, path: Path) -> None:
    """Write a recording of `Viewer`, with images, for the rerun viewer (needs rerun-sdk)."""
    with atomic(path) as part, tempfile.TemporaryDirectory() as folder:
        try:
            file = os.fsencode(part).decode()
        except UnicodeDecodeError:  # rerun requires UTF-8 names
            file = f"{folder}/scene.rrd"
        viewer = Viewer(result.video, lambda rec: rec.save(file))
        viewer.show(result, path, images=True)
        viewer.close()
        if not part.exists():
            shutil.move(file, part)


EXPORTS: dict[str, tuple[str, Callable[[Result, Path], None]]] = {  # name: file in OUT, writer
    "boxer": ("boxer_3dbbs.csv", export_boxer),
    "coco-vid": ("coco_vid.json", export_coco_vid),
    "csv": ("objects.csv", export_csv),
    "cvat": ("cvat.xml", export_cvat),
    "glb": ("objects.glb", export_glb),
    "kitti": ("kitti_tracking.txt", export_kitti),
    "labelme": ("labelme/labels.txt", export_labelme),
    "mcap": ("objects.mcap", export_mcap),
    "nerfstudio": ("nerfstudio/transforms.json", export_nerfstudio),
    "ply": ("solids.ply", export_ply),
    "ros": ("detection3d_array.json", export_ros),
    "rrd": ("scene.rrd", export_rrd),
    "usd": ("scene.usda", export_usd),
    "yolo": ("yolo/data.yaml", export_yolo),
}
