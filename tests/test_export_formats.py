"""Exports to USD, MCAP (ROS 2), Boxer and YOLO, opened by their own libraries."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from front_door.room import ROOM
from scipy.spatial.transform import Rotation
from simulated import SIZE, chair_solids, walk

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.export.registry import EXPORTS
from reobj.results.result import write_objects
from reobj.types import object_color

TILT = Rotation.from_euler("xyz", [40, 70, -20], degrees=True).as_matrix()
UNIT = 0.5  # metres per unit of the tilted world
OFF_CENTRE = rt.Camera("PINHOLE", *SIZE, (500.0, 540.0, 300.0, 260.0))


def tilted(chairs: rt.Result, **changes: Any) -> rt.Result:
    """The chairs and their cameras in a world that is tilted and has half a metre as its unit."""
    ellipsoids = chairs.ellipsoids()
    turn6 = np.kron(np.eye(3), np.eye(3))
    turn6[:3, :3] = TILT / UNIT
    objects = [
        dataclasses.replace(
            o, center=TILT @ c / UNIT, half_axes=h / UNIT, size=2 * h / UNIT,
            quat_wxyz=np.roll(Rotation.from_matrix(TILT @ r).as_quat(), 1),
            cov=turn6 @ o.cov @ turn6.T,
        )
        for o, c, h, r in zip(chairs.objects, ellipsoids.center_in_world, ellipsoids.half_axes,
                              ellipsoids.world_from_obj, strict=True)
    ]  # fmt: skip
    cams = chairs.poses.cam_from_world.copy()
    cams[:, :, :3] = cams[:, :, :3] @ TILT.T
    cams[:, :, 3] /= UNIT
    points = chair_solids().center_in_world @ TILT.T / UNIT
    poses = dataclasses.replace(
        chairs.poses, camera=OFF_CENTRE, cam_from_world=cams, metric=False,
        points=points, colors=np.full((3, 3), (255, 0, 0), np.uint8),
    )  # fmt: skip
    scale = chairs.world.scale._replace(value=UNIT)
    facts = {"up_in_world": TILT @ [0, 0, 1], "scale": scale, **changes}
    parts = tuple(dataclasses.replace(part, **facts) for part in chairs.world.parts)
    world = dataclasses.replace(chairs.world, parts=parts, **facts)
    return dataclasses.replace(chairs, objects=objects, world=world, poses=poses, fits=None)


def in_cameras(cams: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (F, N, 3) in the cameras (F, 3, 4)."""
    return np.einsum("fij,nj->fni", cams[:, :, :3], points) + cams[:, None, :, 3]


def seen_chairs(chairs: rt.Result) -> np.ndarray:
    """Centres (F, 3, 3) of the chairs in their cameras, metres."""
    return in_cameras(chairs.poses.cam_from_world, chairs.ellipsoids().center_in_world)


def written(result: rt.Result, to: str, path: Path) -> Path:
    EXPORTS[to][1](result, path)
    return path


# ---- Upright and metric: objects.json, CSV ----


def upright_entries(result: rt.Result, path: Path) -> list[dict[str, Any]]:
    write_objects(result, path)
    return list(json.loads(path.read_text())["objects"])


def test_objects_json_has_upright_metric_poses(chairs: rt.Result, tmp_path: Path) -> None:
    plain = upright_entries(chairs, tmp_path / "plain.json")
    turned = upright_entries(tilted(chairs), tmp_path / "turned.json")
    true = chairs.ellipsoids()
    headings = np.degrees(np.arctan2(true.world_from_obj[:, 1, 0], true.world_from_obj[:, 0, 0]))
    np.testing.assert_allclose([o["yaw_deg"] for o in plain], headings, atol=0.01)
    np.testing.assert_allclose([o["center_m"] for o in plain], true.center_in_world, atol=1e-5)
    found = np.array([o["center_m"] for o in turned])
    np.testing.assert_allclose(found[:, 2], true.center_in_world[:, 2], atol=1e-4)
    # The frames differ by a rotation about z, which is that of the headings too
    about_z = np.array([o["yaw_deg"] for o in turned]) - headings
    turn = Rotation.from_euler("z", about_z[0], degrees=True)
    np.testing.assert_allclose((about_z - about_z[0] + 180) % 360, 180, atol=0.02)
    np.testing.assert_allclose(found, turn.apply(true.center_in_world), atol=1e-3)


# ---- USD ----


def stage_of(path: Path) -> Any:
    usd = pytest.importorskip("pxr.Usd", reason="pip install usd-core (dev extra)")
    return usd.Stage.Open(str(path))


def test_usd_in_its_library(chairs: rt.Result, tmp_path: Path) -> None:
    """z up and metres; each prim has its extent, name, class, number and colour."""
    stage = stage_of(written(tilted(chairs), "usd", tmp_path / "a.usda"))
    from pxr import Usd, UsdGeom, UsdSemantics

    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetRootLayer().customLayerData["units"] == "m"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 39)
    assert stage.GetTimeCodesPerSecond() == 30
    prims = stage.GetPrimAtPath("/World/objects").GetChildren()
    assert [p.GetName() for p in prims] == ["chair_1", "chair_2", "chair_3"]
    assert [p.GetDisplayName() for p in prims] == ["chair 1", "chair 2", "chair 3"]
    boxes = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
    axes = np.abs(chairs.ellipsoids().world_from_obj)
    for prim, found, turn in zip(prims, chairs.objects, axes, strict=True):
        assert prim.GetTypeName() == "Cube" and found.support == "box"
        assert prim.GetAttribute("userProperties:id").Get() == found.id
        labels = UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()
        assert list(labels) == ["chair"]
        bound = boxes.ComputeWorldBound(prim)
        assert bound.GetVolume() == pytest.approx(8 * found.half_axes.prod(), rel=1e-4)
        height = bound.ComputeAlignedRange().GetSize()[2]
        assert height == pytest.approx(2 * turn[2] @ found.half_axes, rel=1e-4)
        (color,) = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()
        shown = 255 * np.array(color) ** (1 / 2.2)  # USD's colours are linear
        np.testing.assert_allclose(shown, object_color(found.id)[::-1], atol=0.6)
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/points"))
    np.testing.assert_allclose(np.array(points.GetPointsAttr().Get())[:, 2], 0.41, atol=1e-5)
    np.testing.assert_allclose(points.GetDisplayColorAttr().Get(), [[1, 0, 0]] * 3)


def test_the_camera_of_usd_projects_as_that_of_the_result(
    chairs: rt.Result, tmp_path: Path
) -> None:
    stage = stage_of(written(tilted(chairs), "usd", tmp_path / "a.usda"))
    from pxr import Gf, UsdGeom

    prims = stage.GetPrimAtPath("/World/objects").GetChildren()
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera"))
    pixels = seen_chairs(chairs) @ OFF_CENTRE.K.T
    pixels = pixels[..., :2] / pixels[..., 2:]  # (F, 3, 2)
    for frame in (0, 17, 39):
        frustum = camera.GetCamera(frame).frustum
        to_clip = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        for prim, expected in zip(prims, pixels[frame], strict=True):
            center = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(frame)
            x, y, _ = to_clip.Transform(center.Transform(Gf.Vec3d(0)))  # of [-1, 1], y up
            found = (np.array([x, -y]) + 1) / 2 * SIZE
            np.testing.assert_allclose(found, expected, atol=0.01)


# ---- ROS 2 ----


def messages_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Times in ns and messages of each topic, read by mcap with the decoder of ROS 2."""
    reader = pytest.importorskip("mcap.reader", reason="pip install '.[mcap]'")
    decoder = pytest.importorskip("mcap_ros2.decoder", reason="pip install '.[mcap]'")
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        decoded = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        assert decoded.get_header().profile == "ros2"
        for _, channel, message, data in decoded.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, data))
    return found


def vector(message: Any, names: str = "xyz") -> list[float]:
    return [getattr(message, name) for name in names]


def test_mcap_in_its_library(chairs: rt.Result, tmp_path: Path) -> None:
    """The cameras of /tf see the objects of /objects where the result's see them."""
    result = tilted(chairs)
    cams = result.poses.cam_from_world.copy()
    cams[7] = np.nan
    result = dataclasses.replace(
        result, poses=dataclasses.replace(result.poses, cam_from_world=cams)
    )
    found = messages_of(written(result, "mcap", tmp_path / "a.mcap"))
    expected = [round(1e9 * t) for i, t in enumerate(chairs.poses.time_s.tolist()) if i != 7]
    for topic in ("/tf", "/camera_info", "/detections"):
        assert [time for time, _ in found[topic]] == expected
    _, objects = found["/objects"][0]
    _, markers = found["/markers"][0]
    centers = np.array([vector(d.bbox.center.position) for d in objects.detections])
    links = [data.transforms[0] for _, data in found["/tf"]]
    assert {(x.header.frame_id, x.child_frame_id) for x in links} == {
        ("map", "camera_optical_frame")
    }
    rotations = Rotation.from_quat([vector(x.transform.rotation, "xyzw") for x in links])
    moves = np.array([vector(x.transform.translation) for x in links])
    poses = invert_rigid(np.concatenate([rotations.as_matrix(), moves[:, :, None]], 2))
    seen = np.delete(seen_chairs(chairs), 7, 0)
    np.testing.assert_allclose(in_cameras(poses, centers), seen, atol=1e-3)
    shapes = [m for m in markers.markers if m.type == 1]  # CUBE
    texts = [m.text for m in markers.markers if m.type == 9]
    np.testing.assert_allclose([vector(m.pose.position) for m in shapes], centers)
    assert [m.id for m in shapes] == [1, 2, 3] and texts == ["chair 1", "chair 2", "chair 3"]
    np.testing.assert_allclose(
        [vector(m.scale) for m in shapes], 2 * chairs.ellipsoids().half_axes, rtol=1e-5
    )
    for k, (found_3d, entry) in enumerate(zip(objects.detections, chairs.objects, strict=True)):
        (guess,) = found_3d.results
        assert guess.hypothesis.class_id == "chair"
        assert guess.hypothesis.score == pytest.approx(entry.confidence or 1.0)
        cov = np.reshape(guess.pose.covariance, (6, 6))
        # z is up in the world of the chairs too: variances along it, and about it
        assert cov[2, 2] == pytest.approx(entry.cov[2, 2], rel=1e-3)
        axes = chairs.ellipsoids().world_from_obj[k]
        assert cov[5, 5] == pytest.approx((axes @ entry.cov[6:, 6:] @ axes.T)[2, 2], rel=1e-3)
        assert np.trace(cov[:3, :3]) == pytest.approx(np.trace(entry.cov[:3, :3]), rel=1e-3)
    boxes = found["/detections"][20][1].detections
    rows = chairs.tracks[chairs.tracks.frame == 21]
    assert [b.id for b in boxes] == [str(i) for i in rows.track_id]
    middle = (rows.xyxy[:, :2] + rows.xyxy[:, 2:]) / 2 - 0.5  # OpenCV's pixels
    np.testing.assert_allclose([vector(b.bbox.center.position, "xy") for b in boxes], middle)
    assert {b.results[0].hypothesis.class_id for b in boxes} == {"chair"}


@pytest.mark.parametrize(
    ("model", "params", "ros", "said"),
    [
        ("PINHOLE", (500.0, 510, 320, 240), ("plumb_bob", [0, 0, 0, 0, 0]), False),
        ("OPENCV", (500.0, 510, 320, 240, 0.1, 0.2, 0.3, 0.4),
         ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0]), False),
        ("FULL_OPENCV", (500.0, 510, 320, 240, 1, 2, 3, 4, 5, 6, 7, 8),
         ("rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8]), False),
        ("RADIAL_FISHEYE", (500.0, 320, 240, 0.1, 0.2), ("equidistant", [0.1, 0.2, 0, 0]), False),
        ("THIN_PRISM_FISHEYE", (500.0, 510, 320, 240, 1, 2, 3, 4, 5, 6, 7, 8),
         ("equidistant", [1, 2, 5, 6]), True),
    ],
)  # fmt: skip
def test_camera_info(
    chairs: rt.Result, tmp_path: Path, model: str, params: tuple[float, ...],
    ros: tuple[str, list[float]], said: bool, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    camera = rt.Camera(model, *SIZE, params)
    poses = dataclasses.replace(walk(2), camera=camera)
    result = dataclasses.replace(chairs, poses=poses, fits=None)
    info = messages_of(written(result, "mcap", tmp_path / "a.mcap"))["/camera_info"][0][1]
    assert (info.width, info.height) == SIZE
    assert (info.distortion_model, list(info.d)) == (ros[0], pytest.approx(ros[1]))
    K = np.reshape(info.k, (3, 3))
    np.testing.assert_allclose(K[:2, 2], [319.5, 239.5])  # first pixel at (0, 0)
    assert K[0, 0] == 500 and list(info.p)[:3] == list(info.k)[:3]
    assert ("distortion is left out" in caplog.text) == said


# ---- Boxer ----


def test_boxer_columns(chairs: rt.Result, tmp_path: Path) -> None:
    """The columns as Boxer's reader converts them, split at commas."""
    result = tilted(chairs)
    objects = [dataclasses.replace(o, class_name="Arm, chair") for o in result.objects]
    result = dataclasses.replace(result, objects=objects)
    head, *lines = written(result, "boxer", tmp_path / "a.csv").read_text().splitlines()
    assert head.split(",")[1:12] == [
        "tx_world_object", "ty_world_object", "tz_world_object", "qw_world_object",
        "qx_world_object", "qy_world_object", "qz_world_object", "scale_x", "scale_y", "scale_z",
        "name",
    ]  # fmt: skip
    rows = [line.split(",") for line in lines]
    assert {len(row) for row in rows} == {15} and len(rows) == len(chairs.tracks)
    times = [round(frame / 30 * 1e9) for frame in chairs.tracks.frame.tolist()]
    assert [int(row[0]) for row in rows] == times
    assert [int(row[12]) for row in rows] == chairs.tracks.track_id.tolist()
    assert {row[11] for row in rows} == {"arm  chair"}
    values = np.array([[float(v) for v in row[1:11]] for row in rows[:3]])
    plain = [entry["center_m"] for entry in upright_entries(result, tmp_path / "a.json")]
    np.testing.assert_allclose(values[:, :3], plain, atol=1e-5)
    true = chairs.ellipsoids()
    np.testing.assert_allclose(values[:, 7:], 2 * true.half_axes, rtol=1e-6)  # full extents
    axes = Rotation.from_quat(np.roll(values[:, 3:7], -1, 1)).as_matrix()
    relative = np.swapaxes(axes[:1], 1, 2) @ axes
    expected = np.swapaxes(true.world_from_obj[:1], 1, 2) @ true.world_from_obj
    np.testing.assert_allclose(relative, expected, atol=1e-4)


def same_tracks(found: rt.Tracks, names: Any, room: Path, atol: float) -> None:
    """The identities, boxes and classes of the detections in an output folder."""
    result = rt.Result.load(room)
    expected = result.tracks[result.tracks.score > 0]
    found = found[np.lexsort((found.track_id, found.frame))]
    expected = expected[np.lexsort((expected.track_id, expected.frame))]
    np.testing.assert_array_equal(found.frame, expected.frame)
    np.testing.assert_array_equal(found.track_id, expected.track_id)
    np.testing.assert_allclose(found.xyxy, expected.xyxy, atol=atol)
    assert [names[i] for i in found.class_id] == [result.class_names[i] for i in expected.class_id]


def test_identities_are_read_back(room: Path, tmp_path: Path) -> None:
    path = rt.export(room, "yolo", tmp_path / "new" / "data.yaml")
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(every=3, stop=120))
    tracks, names, _ = rt.read_tracks(path.parent, video)
    same_tracks(tracks[tracks.score > 0], names, room, 0.011)


# ---- YOLO ----


# ---- Message types of ROS ----
