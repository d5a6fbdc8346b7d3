"""ROS 2 messages of a result: a recording (MCAP) of cameras and objects.

Frames follow REP 103 and 105: `map` is upright and in metres, `camera_optical_frame` looks along z.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, invert_rigid, quat_wxyz_from_matrix
from reobj.export.source import UprightWorld, distortion, upright_world
from reobj.files import atomic
from reobj.results.result import Object, Result
from reobj.types import Array, ReobjError, Tracks, object_color, visible_name

Message = dict[str, Any]
MAP = "map"
CAMERA = "camera_optical_frame"


def export_mcap(result: Result, path: Path) -> None:
    """Write an MCAP recording of ROS 2 messages in CDR, which Foxglove and rosbag2 open.

    /objects (vision_msgs/Detection3DArray) and /markers (visualization_msgs/MarkerArray) once;
    /tf, /camera_info and /detections (vision_msgs/Detection2DArray) of each frame with a pose.

    Ref: mcap.dev; the message definitions of ROS 2 Humble.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        advice = "mcap-ros2-support is not installed: pip install mcap-ros2-support"
        raise ReobjError(advice) from error
    world = upright_world(result, path)
    with atomic(path) as part, part.open("wb") as file, Writer(file) as writer:
        schemas = {k: writer.register_msgdef(k, text) for k, text in _definitions().items()}
        for topic, kind, time_ns, message in _recording(world, result, path):
            writer.write_message(topic, schemas[kind], message, time_ns, time_ns)


def _recording(
    world: UprightWorld, result: Result, path: Path
) -> Iterator[tuple[str, str, int, Message]]:
    """Yield topic, type, time in ns and message, by time."""
    poses = world.poses
    known = [] if poses is None else np.flatnonzero(poses.known).tolist()
    times = [] if poses is None else (1e9 * poses.time_s.clip(0)).round().astype(np.int64).tolist()
    start = times[known[0]] if known else 0
    yield "/objects", "vision_msgs/msg/Detection3DArray", start, _detections_3d(world, start)
    yield "/markers", "visualization_msgs/msg/MarkerArray", start, _markers(world, start)
    if poses is None or not known:
        return
    world_from_cam = invert_rigid(poses.cam_from_world[known])
    quat = np.roll(quat_wxyz_from_matrix(world_from_cam[:, :, :3]), -1, 1)
    info = _camera_info(poses.camera, path)
    names = {found.id: visible_name(found.class_name) for found in result.objects}
    tracks = result.tracks[result.tracks.score > 0]
    for k, row in enumerate(known):
        time_ns = times[row]
        pose = _pose(world_from_cam[k, :, 3], quat[k])
        transform = {"translation": pose["position"], "rotation": pose["orientation"]}
        link = {"header": _header(time_ns, MAP), "child_frame_id": CAMERA, "transform": transform}
        yield "/tf", "tf2_msgs/msg/TFMessage", time_ns, {"transforms": [link]}
        header = {"header": _header(time_ns, CAMERA)}
        yield "/camera_info", "sensor_msgs/msg/CameraInfo", time_ns, header | info
        rows = tracks[tracks.frame == poses.frame[row]]
        boxes = _detections_2d(rows, names, time_ns)
        yield "/detections", "vision_msgs/msg/Detection2DArray", time_ns, boxes


# ---- Messages ----------------------------------------------------------------------------------


def _header(time_ns: int, frame_id: str) -> Message:
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def _named(values: Array, names: str = "xyz") -> Message:
    return dict(zip(names, values.tolist(), strict=True))


def _pose(position: Array, quat_xyzw: Array) -> Message:
    return {"position": _named(position), "orientation": _named(quat_xyzw, "xyzw")}


def _detections_3d(world: UprightWorld, time_ns: int) -> Message:
    """Describe the objects as a Detection3DArray."""
    header = _header(time_ns, MAP)
    detections = []
    quat = world.quat_xyzw
    for i, found in enumerate(world.objects):
        pose = _pose(world.ellipsoids.center_in_world[i], quat[i])
        covariance = {
            "pose": pose,
            "covariance": _pose_covariance(found, world, i).ravel().tolist(),
        }
        exists = 1.0 if found.confidence is None else found.confidence
        results = [
            {
                "hypothesis": {"class_id": visible_name(name), "score": exists * probability},
                "pose": covariance,
            }
            for name, probability in (found.classes or {found.class_name: 1.0}).items()
        ]
        box = {"center": pose, "size": _named(2 * world.ellipsoids.half_axes[i])}
        detections.append({"header": header, "results": results, "bbox": box, "id": str(found.id)})
    return {"header": header, "detections": detections}


def _pose_covariance(found: Object, world: UprightWorld, i: int) -> Array:
    """Return the covariance (6, 6) of position and rotation about the axes of the map.

    Without the uncertainty of the scale, which all objects have in common. 0 if it is unknown.
    """
    if found.cov is None:
        return np.zeros((6, 6))
    rows = [0, 1, 2, 6, 7, 8]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = world.scale * world.rotation
    jacobian[3:, 3:] = world.ellipsoids.world_from_obj[i]  # from a rotation vector in object axes
    return np.asarray(jacobian @ found.cov[np.ix_(rows, rows)] @ jacobian.T)


def _markers(world: UprightWorld, time_ns: int) -> Message:
    """Describe the objects as a MarkerArray: the shape, and a text above it."""
    kinds = {"box": 1, "ellipsoid": 2, "cylinder": 3}  # Marker.CUBE, SPHERE, CYLINDER
    header = _header(time_ns, MAP)
    markers = []
    rows = zip(world.objects, world.ellipsoids.center_in_world, world.ellipsoids.half_axes,
               world.ellipsoids.world_from_obj, world.quat_xyzw, strict=True)  # fmt: skip
    for found, center, half_axes, axes, quat in rows:
        name = visible_name(found.class_name)
        color = np.array([*object_color(found.id)[::-1], 0.7 * 255]) / 255.0
        height = float(np.abs(axes[2]) @ half_axes)
        letter = max(0.3 * height, 1e-3)
        above = center + np.array([0, 0, height + letter])
        shape = {"ns": name, "type": kinds[found.support or "ellipsoid"]}
        text = {"ns": "labels", "type": 9, "text": f"{name} {found.id}"}  # TEXT_VIEW_FACING
        for facts, rgba, pose, size in (
            (shape, color, _pose(center, quat), 2 * half_axes),
            (text, np.ones(4), _pose(above, np.array([0.0, 0, 0, 1])), np.full(3, letter)),
        ):
            common = {"header": header, "id": found.id % 2**31, "action": 0, "pose": pose}
            markers.append(common | facts | {"color": _named(rgba, "rgba"), "scale": _named(size)})
    return {"markers": markers}


def _detections_2d(rows: Tracks, names: dict[int, str], time_ns: int) -> Message:
    """Describe the boxes of a frame as a Detection2DArray, in pixels of OpenCV."""
    header = _header(time_ns, CAMERA)
    center = (rows.xyxy[:, :2] + rows.xyxy[:, 2:]) / 2 - 0.5
    size = rows.xyxy[:, 2:] - rows.xyxy[:, :2]
    detections = []
    for i, identity in enumerate(rows.track_id.tolist()):
        hypothesis = {"class_id": names[identity], "score": float(rows.score[i])}
        position = {"position": _named(center[i], "xy"), "theta": 0.0}
        box = {"center": position, "size_x": float(size[i, 0]), "size_y": float(size[i, 1])}
        results = [{"hypothesis": hypothesis}]
        detections.append({"header": header, "results": results, "bbox": box, "id": str(identity)})
    return {"header": header, "detections": detections}


def _camera_info(camera: Camera, path: Path) -> Message:
    """Convert intrinsics to those of ROS, whose first pixel has its centre at (0, 0)."""
    K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    model = "plumb_bob"
    names = "k1 k2 p1 p2 k3"
    if "FISHEYE" in camera.model:
        model = "equidistant"
        names = "k1 k2 k3 k4"
    elif camera.model == "FULL_OPENCV":
        model = "rational_polynomial"
        names += " k4 k5 k6"
    return {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": model,
        "d": list(distortion(camera, names.split(), path, "ROS").values()),
        "k": K.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    }


# ---- Definitions of ROS 2 Humble ---------------------------------------------------------------


def _definitions() -> dict[str, str]:
    """Return the definition of each message type, followed by those of the types in messages."""
    text = Path(__file__).with_name("ros2_humble.msg").read_text(encoding="utf-8")
    types = dict(entry.strip().split("\n", 1) for entry in text.split("MSG: ")[1:])
    parts = [f"{'=' * 80}\nMSG: {name}\n{fields}" for name, fields in types.items()
             if "/msg/" not in name]  # fmt: skip
    return {k: "\n".join([fields, *parts]) for k, fields in types.items() if "/msg/" in k}
