"""Exports: each is read back by this package, by the format's own reader, or like it."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from front_door.room import ROOM
from simulated import walk

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.export.registry import EXPORTS, Viewer
from reobj.results.result import VideoInfo

CORNERS = {"xtl", "ytl", "xbr", "ybr"}  # of a box in CVAT's XML


def mot(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def objects(out: Path) -> list[dict[str, object]]:
    return json.loads((out / "objects.json").read_text())["objects"]


# ---- CVAT: manually corrected identities ----


def test_cvat_has_the_attributes_of_its_importer(room: Path, tmp_path: Path) -> None:
    """The attributes that cvat.py's loader reads; only keyframes; visits are closed."""
    path = tmp_path / "a.xml"
    rt.export(room, "cvat", path)
    root, rows = ET.parse(path).getroot(), mot(room / "tracks.txt")
    assert root.findtext("version") == "1.1"
    labels = {e.findtext("name") for e in root.iter("label")}
    inside = []
    for number, track in enumerate(root.iter("track")):
        assert int(track.attrib["id"]) == number and track.attrib["label"] in labels
        shown = []
        for box in track:
            assert box.tag == "box" and box.attrib["keyframe"] == "1"
            assert {"frame", "outside", "occluded", *CORNERS} <= set(box.attrib)
            frame = int(box.attrib["frame"])
            if box.attrib["outside"] == "0":
                inside.append((frame + 1, number + 1))
                assert not shown or shown[-1][1] == "1" or shown[-1][0] == frame - 3
            shown.append((frame, box.attrib["outside"]))
        assert shown[-1][1] == "1" or shown[-1][0] == 117  # gone before the end of the video
        assert [f for f, _ in shown] == sorted({f for f, _ in shown})
    assert sorted(inside) == sorted((int(r[0]), int(r[1])) for r in rows if r[6] > 0)


# ---- CSV ----


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ('=HYPERLINK("http://x")', '\'=HYPERLINK("http://x")'),
        ("\tcup", "'\tcup"),
        ("coat-rack, wide", "coat-rack, wide"),  # harmless
    ],
)
def test_csv_runs_no_formula(tmp_path: Path, chairs: rt.Result, name: str, cell: str) -> None:
    result = dataclasses.replace(chairs)
    found = [dataclasses.replace(chairs.objects[0], class_name=name, reason=name)]
    result = dataclasses.replace(
        result, objects=[dataclasses.replace(o, center=-np.abs(o.center)) for o in found]
    )
    EXPORTS["csv"][1](result, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["class"] == row["reason"] == cell
    assert float(row["center_x"]) <= 0  # a negative number is a number


# ---- nerfstudio ----


# ---- What every export must do ----


# ---- GLB, rerun, COLMAP ----


def located(out: Path) -> tuple[dict[str, object], list[dict[str, object]]]:
    """The world of an output folder, and its located objects."""
    data = json.loads((out / "objects.json").read_text())
    return data["world"], [o for o in data["objects"] if o["status"] != "rejected"]


def nodes_of(path: Path) -> dict[str, tuple[np.ndarray, object]]:
    """Vertices (P, 3) in the file's world and the mesh of every node, read by trimesh."""
    trimesh = pytest.importorskip("trimesh", reason="pip install '.[viewer]'")
    scene, found = trimesh.load(path), {}
    for name in scene.graph.nodes_geometry:
        matrix, key = scene.graph[name]
        mesh = scene.geometry[key]
        found[name] = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], mesh)
    return found


def in_glb(result: rt.Result, path: Path) -> dict[str, tuple[np.ndarray, object]]:
    EXPORTS["glb"][1](result, path)
    return nodes_of(path)


@pytest.mark.parametrize("up", [(0.01, -1, 0), (0, -1, 0.01), (0, 0, 1), (0.3, 0.4, -0.6)])
def test_glb_has_the_frame_of_the_other_exports(
    chairs: rt.Result, tmp_path: Path, up: tuple[float, ...]
) -> None:
    """(x, z, -y) of `center_m` (the centres in the CSV), objects and cameras alike."""
    up_in_world = np.array(up) / np.linalg.norm(up)
    world = dataclasses.replace(chairs.world, up_in_world=up_in_world)
    parts = tuple(dataclasses.replace(p, up_in_world=up_in_world) for p in world.parts)
    result = dataclasses.replace(chairs, world=dataclasses.replace(world, parts=parts))
    nodes = in_glb(result, tmp_path / "a.glb")
    EXPORTS["csv"][1](result, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = np.array([[float(row[f"center_m_{axis}"]) for axis in "xyz"] for row in rows])
    found = np.array([nodes[f"chair {row['id']}"][0].mean(0) for row in rows])
    np.testing.assert_allclose(found, expected[:, [0, 2, 1]] * [1, 1, -1], atol=2e-3)
    # the frame of the objects is that of the cameras: their distances are those of the world
    eyes = invert_rigid(chairs.poses.cam_from_world)[:, :, 3]
    path = nodes["cameras"][0][[0, *range(1, 2 * len(eyes) - 2, 2)]]  # both ends of each segment
    in_file = np.linalg.norm(path[:, None] - found, axis=2)
    in_world = np.linalg.norm(eyes[:, None] - [o.center for o in chairs.objects], axis=2)
    np.testing.assert_allclose(in_file, in_world, rtol=0, atol=2e-3)


def test_rrd_in_rerun(room: Path, tmp_path: Path) -> None:
    """Read back by rerun itself: every ellipsoid, camera and box."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    found = in_rrd(rt.export(room, "rrd", tmp_path / "a.rrd"))
    world, kept = located(room)
    scale = world["scale"]["metres_per_unit"]
    for o in kept:
        (row,) = found[f"/world/objects/{str(o['class']).replace(' ', chr(92) + ' ')}/{o['id']}"]
        half = scale * np.array([o["half_axes"]])
        np.testing.assert_allclose(row["Ellipsoids3D:half_sizes"], half, rtol=1e-5)
        np.testing.assert_allclose(row["Ellipsoids3D:centers"], [o["center_m"]], atol=1e-4)
    frames = sorted(row["frame"] for row in found["/world/camera"])
    assert frames == list(range(0, 120, 3))
    boxes = [len(row["Boxes2D:centers"]) for row in found["/world/camera/boxes"]]
    assert sum(boxes) == len(mot(room / "tracks.txt"))
    shown = {row["frame"]: row["EncodedImage:blob"][0] for row in found["/world/camera/image"]}
    assert sorted(shown) == frames
    image = cv2.imdecode(np.array(shown[3], np.uint8), cv2.IMREAD_COLOR)
    fourth = [f.image for f in rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=4))][3]
    assert image.shape == (480, 640, 3) and np.abs(image.astype(int) - fourth).mean() < 4
    (points,) = found["/world/points"] or [{"Points3D:positions": []}]
    assert isinstance(points["Points3D:positions"], list)


def test_the_live_viewer_follows_the_tracking(tmp_path: Path) -> None:
    """Frame by frame, as they are tracked: image, boxes with names, and a known camera."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    config = rt.InputConfig(stop=4, max_size=320)
    video, path = rt.Video(ROOM / "room.mp4", config), tmp_path / "live.rrd"
    viewer = Viewer(VideoInfo.of(video), lambda rec: rec.save(path))
    steps = rt.track(video, lambda image: [[10, 20, 50, 80, 0.9, 56]], rt.Tracker())
    poses, seen = walk(40), []
    for frame, tracks in viewer.follow(steps, rt.COCO_NAMES, video, poses):
        seen.append((frame.index, len(tracks)))
        assert tracks.xyxy.max(initial=0) < 200  # passed on unchanged
    viewer.close()
    found = in_rrd(path)
    assert (
        [f for f, _ in seen] == [0, 1, 2, 3] == [r["frame"] for r in found["/world/camera/image"]]
    )
    boxes = found["/world/camera/boxes"]
    assert [len(row["Boxes2D:centers"] or []) for row in boxes] == [n for _, n in seen]
    assert boxes[-1]["Boxes2D:labels"] == ["1 chair"]
    np.testing.assert_allclose(boxes[-1]["Boxes2D:centers"], [[60, 100]], atol=2)  # native px
    assert len(found["/world/camera"]) == 4


def in_rrd(path: Path) -> dict[str, list[dict]]:
    """Rows of a recording by entity, read by rerun."""
    from rerun.chunk import RrdReader

    found = defaultdict(list)
    for chunk in RrdReader(path).stream().to_chunks():
        table = chunk.to_record_batch()
        kept = [name for name in table.schema.names if name != "time"]  # whole frames are enough
        found[chunk.entity_path] += table.select(kept).to_pylist()
    return found
