"""Export of results to the formats of other tools.

Start at `export`. EXPORTS lists the writers.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reobj.cameras import Poses
from reobj.export.labels import (
    export_boxer,
    export_coco_vid,
    export_csv,
    export_cvat,
    export_yolo,
)
from reobj.export.mcap import export_mcap
from reobj.export.scenes import export_glb, export_nerfstudio, export_ply, export_usd
from reobj.export.source import (
    far_origin,
    frames_read,
    shifted,
    upright_world,
    video_of,
)
from reobj.files import atomic
from reobj.results.result import Result, VideoInfo
from reobj.sources.image_files import IMAGE_FPS
from reobj.sources.video import Video
from reobj.types import (
    Array,
    Frame,
    Image,
    ReobjError,
    Tracks,
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
            poses = shifted(poses, far_origin(poses, np.empty((0, 3))))
        pose_of = self._log_points(poses)
        for frame, tracks in steps:
            labels = live_labels(tracks, names)
            native = dataclasses.replace(tracks, xyxy=tracks.xyxy / video.scale)
            self._frame(frame.index, poses, pose_of.get(frame.index), native, labels)
            self._image(frame.image)
            yield frame, tracks

    def show(self, result: Result, path: Path, images: bool) -> None:
        """Log a result: solids and points (of the largest component), and all frames.

        Args:
            path: for warnings. images: read the video again and log its images.
        """
        world = upright_world(result, path, float32=True, may_be_empty=True)
        names = {o.id: f"{o.id} {o.class_name}" for o in result.objects}
        solids = world.ellipsoids
        xyzw = world.quat_xyzw
        for i, o in enumerate(world.objects):
            solid = self.rr.Ellipsoids3D(
                half_sizes=solids.half_axes[i : i + 1], labels=[names[o.id]],
                centers=solids.center_in_world[i : i + 1],
                quaternions=xyzw[i : i + 1], fill_mode="solid",
                colors=[object_color(o.id)[::-1]],
            )  # fmt: skip
            self.rec.log(["world", "objects", o.class_name, str(o.id)], solid, static=True)
        pose_of = self._log_points(world.poses)
        frames, _ = frames_read(result)
        video = video_of(result) if images else None
        shown = iter(video if video is not None and video.has_images else ())
        ahead = next(shown, None)
        for frame in frames:
            rows = result.tracks[result.tracks.frame == frame]
            labels = [names[i] for i in rows.track_id.tolist()]
            self._frame(frame, world.poses, pose_of.get(frame), rows, labels)
            while ahead is not None and ahead.index <= frame:
                if ahead.index == frame:
                    self._image(ahead.image)
                ahead = next(shown, None)

    def _log_points(self, poses: Poses | None) -> dict[int, Array]:
        """Log the sparse points; return the poses by frame."""
        if poses is None:
            return {}
        cloud = self.rr.Points3D(poses.points, colors=poses.colors)
        self.rec.log("world/points", cloud, static=True)
        return dict(zip(poses.frame.tolist(), poses.cam_from_world, strict=True))

    def _frame(
        self, frame: int, poses: Poses | None, pose: Array | None, rows: Tracks,
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
            move = rr.Transform3D(translation=pose[:, 3], mat3x3=pose[:, :3], **to_child)
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
    "mcap": ("objects.mcap", export_mcap),
    "nerfstudio": ("nerfstudio/transforms.json", export_nerfstudio),
    "ply": ("solids.ply", export_ply),
    "rrd": ("scene.rrd", export_rrd),
    "usd": ("scene.usda", export_usd),
    "yolo": ("yolo/data.yaml", export_yolo),
}
