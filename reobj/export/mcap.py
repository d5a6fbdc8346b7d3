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
        schemas = {kind: writer.register_msgdef(kind, _definition(kind)) for kind in MESSAGES}
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
        covariance = _pose_covariance(found, world, i).ravel().tolist()
        results = [
            {
                "hypothesis": {"class_id": visible_name(name), "score": score},
                "pose": {"pose": pose, "covariance": covariance},
            }
            for name, score in _hypotheses(found).items()
        ]
        size = _named(2 * world.ellipsoids.half_axes[i])
        box = {"center": pose, "size": size}
        detections.append({"header": header, "results": results, "bbox": box, "id": str(found.id)})
    return {"header": header, "detections": detections}


def _hypotheses(found: Object) -> dict[str, float]:
    """Return the probabilities that the object exists and has a class, by class name."""
    exists = 1.0 if found.confidence is None else found.confidence
    classes = found.classes or {found.class_name: 1.0}
    return {name: exists * probability for name, probability in classes.items()}


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
    text_kind = 9  # Marker.TEXT_VIEW_FACING
    markers = []
    quat = world.quat_xyzw
    upright = np.array([0.0, 0, 0, 1])
    for i, found in enumerate(world.objects):
        class_name = visible_name(found.class_name)
        red_green_blue = np.array(object_color(found.id)[::-1]) / 255.0
        center = world.ellipsoids.center_in_world[i]
        half_axes = world.ellipsoids.half_axes[i]
        common = {"header": _header(time_ns, MAP), "id": found.id % 2**31, "action": 0}
        color = _named(np.append(red_green_blue, 0.7), "rgba")
        shape = {"ns": class_name, "type": kinds[found.support or "ellipsoid"], "color": color}
        markers.append(
            common | shape | {"pose": _pose(center, quat[i]), "scale": _named(2 * half_axes)}
        )
        height = float(np.abs(world.ellipsoids.world_from_obj[i, 2]) @ half_axes)
        letter = max(0.3 * height, 1e-3)
        above = center + np.array([0, 0, height + letter])
        text = {"ns": "labels", "type": text_kind, "text": f"{class_name} {found.id}"}
        white = _named(np.ones(4), "rgba")
        size = _named(np.full(3, letter))
        markers.append(
            common | text | {"color": white, "pose": _pose(above, upright), "scale": size}
        )
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


# ---- Definitions of ROS 2 Humble, in their order of fields ---------------------------------------

MESSAGES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n"
        "uint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    ),
    "vision_msgs/msg/Detection3DArray": (
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections"
    ),
    "vision_msgs/msg/Detection2DArray": (
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections"
    ),
    "visualization_msgs/msg/MarkerArray": "visualization_msgs/Marker[] markers",
}
_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/Point2D": "float64 x\nfloat64 y",
    "vision_msgs/Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "vision_msgs/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id"
    ),
    "vision_msgs/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data",
    "visualization_msgs/Marker": (
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
        "std_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\n"
        "string text\nstring mesh_resource\nvisualization_msgs/MeshFile mesh_file\n"
        "bool mesh_use_embedded_materials"
    ),
}


def _definition(kind: str) -> str:
    """Return the definition of a message type followed by those of the types in messages."""
    rule = "=" * 80
    parts = [f"{rule}\nMSG: {name}\n{text}" for name, text in _PARTS.items()]
    return "\n".join([MESSAGES[kind], *parts])
