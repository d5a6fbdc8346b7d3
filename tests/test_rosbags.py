"""The MCAP export, opened by rosbags, which reads recordings of rosbag2 without ROS.

rosbags has the message types of ROS 2 Humble and of later distributions, but not vision_msgs.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from front_door.room import cli

rosbags = pytest.importorskip("rosbags.highlevel", reason="pip install rosbags (extra `dev`)")
pytest.importorskip("mcap_ros2", reason="pip install '.[mcap]'")


@pytest.fixture(scope="module")
def bag(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export of the example room by the command line: 40 frames."""
    path = tmp_path_factory.mktemp("bag") / "objects.mcap"
    assert cli("export", room, "--to", "mcap", "-o", path) == 0
    return path


def test_every_message_is_read(bag: Path) -> None:
    read: Counter[tuple[str, str]] = Counter()
    times = []
    positions = []
    ids = []
    with rosbags.AnyReader([bag]) as reader:
        for connection, time_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            read[connection.topic, connection.msgtype] += 1
            times.append(time_ns)
            if connection.topic == "/tf":
                (link,) = message.transforms
                assert (link.header.frame_id, link.child_frame_id) == (
                    "map", "camera_optical_frame",
                )  # fmt: skip
                assert link.header.stamp.sec * 10**9 + link.header.stamp.nanosec == time_ns
                at = link.transform.translation
                positions.append([at.x, at.y, at.z])
            elif connection.topic == "/objects":
                ids = [detection.id for detection in message.detections]
    assert read == {
        ("/objects", "vision_msgs/msg/Detection3DArray"): 1,
        ("/markers", "visualization_msgs/msg/MarkerArray"): 1,
        ("/tf", "tf2_msgs/msg/TFMessage"): 40,
        ("/camera_info", "sensor_msgs/msg/CameraInfo"): 40,
        ("/detections", "vision_msgs/msg/Detection2DArray"): 40,
    }
    assert times == sorted(times) and times[0] == 0
    assert len(ids) == len(set(ids)) >= 22
    assert 1 < np.linalg.norm(np.ptp(positions, 0)) < 10  # m, of a camera in a room


@pytest.mark.parametrize("distribution", ["ROS2_HUMBLE", "ROS2_JAZZY", "LATEST"])
def test_message_types_are_those_of_ros(bag: Path, distribution: str) -> None:
    """By their hash (RIHS01), which ROS 2 compares before it connects two programs."""
    typesys = pytest.importorskip("rosbags.typesys")
    ros = typesys.get_typestore(typesys.Stores[distribution])
    with rosbags.AnyReader([bag]) as reader:
        ours = reader.typestore
        common = sorted(ours.fielddefs.keys() & ros.fielddefs.keys())
        assert {"tf2_msgs/msg/TFMessage", "sensor_msgs/msg/CameraInfo",
                "visualization_msgs/msg/MarkerArray"} < set(common)  # fmt: skip
        hashes = {kind: (ours.hash_rihs01(kind), ros.hash_rihs01(kind)) for kind in common}
    assert [kind for kind, (our, their) in hashes.items() if our != their] == []
