"""Exports: each is read back by this package, by the format's own reader, or like it."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import subprocess
import sys
import zipfile
from collections import defaultdict
from functools import partial
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from front_door.room import CAMERA, FEW, ROOM
from scipy.spatial.transform import Rotation
from simulated import fitted, tracks_of, walk

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.results.export import EXPORTS, Viewer
from reobj.results.result import VideoInfo
from reobj.results.workspace import Workspace
from reobj.types import object_color

NO_PICTURES = ("--set", "output.overlay=0", "--set", "output.scene=0")
CORNERS = {"xtl", "ytl", "xbr", "ybr"}  # of a box in CVAT's XML


def cli(*args: object) -> int:
    return rt.main([str(a) for a in args])


def mot(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def detected(out: Path) -> np.ndarray:
    """Rows of tracks.txt that have a detection; filled gaps have score 0."""
    rows = mot(out / "tracks.txt")
    return rows[rows[:, 6] > 0]


def objects(out: Path) -> list[dict[str, object]]:
    return json.loads((out / "objects.json").read_text())["objects"]


def groups(rows: np.ndarray) -> set[frozenset[tuple[int, float, float]]]:
    """Identities without their numbers: sets of boxes (frame, left, top)."""
    boxes = defaultdict(set)
    for frame, obj, left, top in rows[:, :4]:
        boxes[obj].add((int(frame), round(left, 1), round(top, 1)))
    return {frozenset(b) for b in boxes.values()}


# ---- COCO-VID ----


def test_coco_vid_holds_every_row(room: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    assert cli("export", room, "--to", "coco-vid", "-o", path) == 0
    data, rows = json.loads(path.read_text()), mot(room / "tracks.txt")
    frame_of = {i["id"]: i["frame_id"] for i in data["images"]}
    assert sorted(frame_of.values()) == list(range(0, 120, 3))  # also those without any object
    assert sorted(frame_of) == list(range(1, 41)) and data["annotations"][0]["id"] == 1
    assert {i["video_id"] for i in data["images"]} == {v["id"] for v in data["videos"]} == {1}
    found = np.array(
        [[frame_of[a["image_id"]] + 1, a["instance_id"], *a["bbox"]] for a in data["annotations"]]
    )
    np.testing.assert_allclose(found, rows[:, :6], atol=0.021)
    name = {c["id"]: c["name"] for c in data["categories"]}
    classes = {a["instance_id"]: name[a["category_id"]] for a in data["annotations"]}
    assert classes == {o["id"]: o["class"] for o in objects(room)}


def test_a_filled_gap_may_lie_in_a_frame_that_was_not_read(
    chairs: rt.Result, tmp_path: Path
) -> None:
    """Poses exist for the decoded frames only; frame 5 was not decoded, but has boxes."""
    poses = chairs.poses
    cut = {k: np.delete(getattr(poses, k), 5, 0) for k in ("frame", "time_s", "cam_from_world",
                                                           "status")}  # fmt: skip
    result = dataclasses.replace(chairs, poses=dataclasses.replace(poses, **cut))
    EXPORTS["coco-vid"][1](result, tmp_path / "a.json")
    data = json.loads((tmp_path / "a.json").read_text())
    assert [i["frame_id"] for i in data["images"]] == list(range(40))
    assert len(data["annotations"]) == 120


def test_coco_vid_in_pycocotools(room: Path, tmp_path: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco", reason="pip install pycocotools")
    path = tmp_path / "a.json"
    rt.export(room, "coco-vid", path)
    data = coco.COCO(str(path))
    assert len(data.getAnnIds()) == len(mot(room / "tracks.txt"))
    some = data.loadAnns(data.getAnnIds(imgIds=[1]))
    assert {a["track_id"] for a in some} == {r[1] for r in mot(room / "tracks.txt") if r[0] == 1}


def test_coco_vid_as_detections_and_as_tracks(room: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    rt.export(room, "coco-vid", path)
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(every=3, stop=120))
    rows = mot(room / "tracks.txt")
    found = rt.read_detections(path, video, rt.DetectConfig(min_score=0))
    assert len(found) == len(rows) and set(found.frame) == set(rows[:, 0].astype(int) - 1)
    tracks, _, messages = rt.read_tracks(path, video)
    assert not messages
    np.testing.assert_array_equal(
        np.column_stack([tracks.frame + 1, tracks.track_id]),
        rows[np.lexsort((rows[:, 1], rows[:, 0])), :2],
    )


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


def test_cvat_unchanged_gives_the_same_objects(room: Path, tmp_path: Path) -> None:
    """Also without any detector: the boxes of the file do."""
    path, again = tmp_path / "a.xml", tmp_path / "again"
    rt.export(room, "cvat", path)
    args = ("--poses", ROOM / "poses.txt", "--camera", CAMERA, "--tracks", path)
    assert cli("run", ROOM / "room.mp4", "-o", again, *args, *FEW, *NO_PICTURES) == 0
    assert groups(detected(again)) == groups(detected(room))
    before, after = ({o["id"]: o for o in objects(out)} for out in (room, again))
    assert {i: o["class"] for i, o in before.items()} == {i: o["class"] for i, o in after.items()}
    kept = [i for i, o in before.items() if o["status"] == after[i]["status"] == "ok"]
    gap = [np.subtract(before[i]["center"], after[i]["center"]) for i in kept]
    gap = np.sort(np.linalg.norm(gap, axis=1))  # m; all scores are 1 here, and a first fit and not
    # the association decides which points lie on which object: they may differ
    assert len(kept) >= 6 and gap[-2] < 0.05 and gap[-1] < 0.2


def edited(room: Path, path: Path) -> tuple[int, int]:
    """Export, give object a all but the first four boxes of b, and save; returns a and b."""
    rt.export(room, "cvat", path)
    tree = ET.parse(path)
    tracks = {int(t.attrib["id"]) + 1: t for t in tree.getroot().iter("track")}
    frames = {i: {b.attrib["frame"] for b in t} for i, t in tracks.items()}
    b = max(frames, key=lambda i: len(frames[i]))
    late = [box for box in tracks[b] if box.attrib["outside"] == "0"][4:]
    a = next(i for i in frames if not frames[i] & {box.attrib["frame"] for box in late})
    for box in late:
        tracks[b].remove(box)
        tracks[a].append(box)
    tracks[a][:] = sorted(tracks[a], key=lambda box: int(box.attrib["frame"]))
    tree.write(path)
    return a, b


def test_corrected_identities_are_used(room: Path, tmp_path: Path) -> None:
    """`objects OUT --tracks`: corrected identities override the linker."""
    out, path = tmp_path / "out", tmp_path / "corrected.xml"
    shutil.copytree(room, out)
    a, b = edited(out, path)
    with zipfile.ZipFile(tmp_path / "task.zip", "w") as archive:  # as downloaded from CVAT
        archive.write(path, "annotations.xml")
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(every=3, stop=120))
    plain, zipped = (rt.read_tracks(p, video)[0] for p in (path, tmp_path / "task.zip"))
    np.testing.assert_array_equal(plain.track_id, zipped.track_id)
    np.testing.assert_array_equal(plain.xyxy, zipped.xyxy)
    path = tmp_path / "task.zip"
    rows = detected(out)
    moved = np.flatnonzero(rows[:, 1] == b)[4:]
    rows[moved, 1] = a
    for _ in range(2):  # and they are kept when the objects are fitted again without --tracks
        assert cli("objects", out, *(("--tracks", path) if path else ()), *NO_PICTURES) == 0
        found = detected(out)
        assert sorted(map(tuple, found[:, :2])) == sorted(map(tuple, rows[:, :2]))
        path = None
    data = json.loads((out / "objects.json").read_text())
    assert data["world"]["links"] == []
    assert {o["id"]: o["frames_seen"] for o in data["objects"]}[b] == 4


def test_corrected_mot_keeps_the_classes(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(room, out)
    rows = mot(out / "tracks.txt")
    rows[:, 1] += 100  # other numbers are kept too
    np.savetxt(tmp_path / "t.txt", rows, delimiter=",", fmt="%g")
    before = objects(out)
    assert cli("objects", out, "--tracks", tmp_path / "t.txt", *NO_PICTURES) == 0
    after = objects(out)
    assert [(o["id"] + 100, o["class"]) for o in before] == [(o["id"], o["class"]) for o in after]
    status = [(o["status"], a["status"]) for o, a in zip(before, after, strict=True)]
    # Some are at a limit: boxes in the file are rounded, and a first fit and not the association
    # decides which edges are occluded, and which points lie on which object.
    changed = [x for x in status if x[0] != x[1]]
    assert len(changed) <= len(before) // 4
    assert all(set(x) == {"ok", "prior_dominated"} for x in changed)


BAD_TRACKS = {
    "no xml": ("a.xml", "<annotations", "no known format of detections"),
    "no track": ("a.xml", "<annotations><image id='0'/></annotations>", "no track with a box"),
    "no number": (
        "a.xml",
        "<annotations><track id='0' label='x'><box frame='0' xtl='a' ytl='1' xbr='2' ybr='3'/>"
        "</track></annotations>",
        "no annotations of CVAT",
    ),
    "detections": ("a.txt", "1,-1,10,10,20,20,.9,-1,-1,-1\n", "no box has an identity"),
    "twice": ("a.txt", "1,4,10,10,20,20\n1,4,99,10,20,20\n", "identity 4 has 2 boxes in frame 0"),
    "missing": ("a.txt", None, "does not exist"),
}


@pytest.mark.parametrize("case", BAD_TRACKS)
def test_bad_tracks(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name, text, expected = BAD_TRACKS[case]
    if text is not None:
        (tmp_path / name).write_text(text)
    args = ("-o", tmp_path / "out", "--tracks", tmp_path / name, "--stop", 3)
    assert cli("track", ROOM / "room.mp4", *args) == 2
    error = capsys.readouterr().err
    assert expected in error and name in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out" / "tracks.txt").exists()


# ---- CSV ----


def test_csv_holds_the_objects(room: Path, tmp_path: Path) -> None:
    path = rt.export(room, "csv", tmp_path / "a.csv")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    entries = objects(room)
    assert [int(r["id"]) for r in rows] == [o["id"] for o in entries] and len(rows) > 5
    for row, entry in zip(rows, entries, strict=True):
        assert (row["class"], row["status"]) == (entry["class"], entry["status"])
        assert int(row["visits"]) == len(entry["frames"]) and int(row["views"]) == entry["views"]
        for name, axes in (("center", "xyz"), ("size_m", "xyz"), ("size_rel_sigma", "xyz")):
            found = [row[f"{name}_{axis}"] for axis in axes]
            assert [float(v) for v in found if v] == (entry[name] or [])
        assert [float(row[k]) for k in ("qw", "qx", "qy", "qz") if row[k]] == (
            entry["quat_wxyz"] or []
        )


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ('=HYPERLINK("http://x")', '\'=HYPERLINK("http://x")'),
        ("+1", "'+1"),
        ("-chair", "'-chair"),
        ("@SUM(A1)", "'@SUM(A1)"),
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


def test_nerfstudio_of_a_video(room: Path, tmp_path: Path) -> None:
    """Cameras and images are read back by this package, which is tested with nerfstudio's files."""
    path = rt.export(room, "nerfstudio", tmp_path / "nerf/transforms.json")
    data = json.loads(path.read_text())
    assert len(data["frames"]) == 40
    video = rt.Video(tmp_path / "nerf/images")
    assert len(video.names) == 40 and video.size == (640, 480)
    assert {f["file_path"] for f in data["frames"]} == {f"images/{n}" for n in video.names}
    poses = rt.read_poses(str(path), video)
    known = rt.Result.load(room).poses
    np.testing.assert_allclose(poses.cam_from_world, known.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(poses.camera.K, known.camera.K, atol=1e-9)
    original = [frame.image for frame in rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=4))]
    second = next(frame.image for frame in video if frame.index == 1).astype(int)
    assert np.abs(second - original[3]).mean() < 3 < np.abs(second - original[0]).mean()


def test_nerfstudio_of_a_folder_copies_nothing(tmp_path: Path) -> None:
    """Images are not copied; sparse points are exported, frames without a pose are not."""
    (tmp_path / "frames").mkdir()
    for i in range(40):
        cv2.imwrite(str(tmp_path / f"frames/{i:03d}.png"), np.zeros((480, 640, 3), np.uint8))
    poses = walk(40)
    poses.cam_from_world[7] = np.nan
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    poses = dataclasses.replace(poses, points=points, colors=np.full((50, 3), 9, np.uint8))
    out = tmp_path / "out"
    Workspace(out).bind(rt.Video(tmp_path / "frames"))
    result = fitted(tracks_of(walk(40)), poses)
    result.save(out)
    data = json.loads(rt.export(out, "nerfstudio").read_text())
    files = [f["file_path"] for f in data["frames"]]
    assert files[:2] == ["../../frames/000.png", "../../frames/001.png"]
    assert len(files) == 39 and "../../frames/007.png" not in files
    assert sorted(p.name for p in (out / "nerfstudio").iterdir()) == [
        "sparse_pc.ply", "transforms.json",
    ]  # fmt: skip
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    cloud = trimesh.load(out / "nerfstudio" / data["ply_file_path"])
    np.testing.assert_allclose(cloud.vertices, points, atol=1e-6)
    assert (np.asarray(cloud.colors)[:, :3] == 9).all()


@pytest.mark.parametrize(
    ("camera", "terms", "said"),
    [
        (("PINHOLE", 500.0, 510.0, 320.0, 240.0), {"k1": 0.0}, False),
        (("SIMPLE_RADIAL", 500.0, 320.0, 240.0, 0.1), {"k1": 0.1, "k2": 0.0}, False),
        (("RADIAL", 500.0, 320.0, 240.0, 0.1, 0.2), {"k1": 0.1, "k2": 0.2}, False),
        (("OPENCV", 500.0, 510.0, 320.0, 240.0, 0.1, 0.2, 0.03, 0.04),
         {"k1": 0.1, "k2": 0.2, "p1": 0.03, "p2": 0.04}, False),
        (("OPENCV_FISHEYE", 500.0, 510.0, 320.0, 240.0, 0.1, 0.2, 0.3, 0.4),
         {"k3": 0.3, "k4": 0.4}, False),
        (("FULL_OPENCV", 500.0, 510.0, 320.0, 240.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0),
         {"k1": 0.1, "p2": 0.4}, True),
    ],
)  # fmt: skip
def test_nerfstudio_has_the_distortion(
    tmp_path: Path, camera: tuple, terms: dict, said: bool, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "f").mkdir()
    for i in range(40):
        cv2.imwrite(str(tmp_path / f"f/{i:03d}.png"), np.zeros((480, 640, 3), np.uint8))
    lens = rt.Camera(camera[0], 640, 480, camera[1:])
    poses = dataclasses.replace(walk(40), camera=lens)
    Workspace(tmp_path / "out").bind(rt.Video(tmp_path / "f"))
    empty = rt.Result(rt.Tracks.empty(), (), VideoInfo("f", 640, 480, 30.0), poses=poses)
    empty.save(tmp_path / "out")
    path = rt.export(tmp_path / "out", "nerfstudio")
    data = json.loads(path.read_text())
    assert {k: data[k] for k in terms} == terms and (data["w"], data["h"]) == (640, 480)
    assert (data["fl_x"], data["cx"]) == (lens.K[0, 0], lens.K[0, 2])
    assert ("distortion is left out" in caplog.text) == said
    if not said:
        again = rt.read_poses(str(path), rt.Video(tmp_path / "f")).camera
        pixels = np.array([[10.0, 20], [600, 400]])
        np.testing.assert_allclose(again.undistort(pixels), lens.undistort(pixels), atol=1e-6)


# ---- PLY ----


def test_ply_has_the_3d_shapes(room: Path, tmp_path: Path) -> None:
    """Closed meshes with outward normals; volume and corners are those of the shape."""
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    mesh = trimesh.load(rt.export(room, "ply", tmp_path / "a.ply"))
    assert mesh.is_watertight and mesh.is_winding_consistent
    result = rt.Result.load(room)
    parts = {tuple(p.visual.vertex_colors[0][:3]): p for p in mesh.split(only_watertight=True)}
    unit_volume = {"box": 8.0, "cylinder": 2 * np.pi, "ellipsoid": 4 / 3 * np.pi}
    assert {o.support for o in result.located} >= {"box", "cylinder"}
    assert len(parts) == len(result.located) > 5
    for o in result.located:
        part = parts[object_color(o.id)[::-1]]
        volume = unit_volume[o.support] * o.half_axes.prod()
        assert part.volume == pytest.approx(volume, rel=0.03)  # a polyhedron inside the surface
        np.testing.assert_allclose(part.bounds.mean(0), o.center, atol=1e-4)
        w, x, y, z = o.quat_wxyz
        own = (part.vertices - o.center) @ Rotation.from_quat([x, y, z, w]).as_matrix()
        np.testing.assert_allclose(np.abs(own).max(0), o.half_axes, rtol=0.01)


# ---- What every export must do ----


@pytest.mark.parametrize("to", EXPORTS)
def test_same_folder_same_bytes(room: Path, tmp_path: Path, to: str) -> None:
    if to in ("glb", "mcap", "rrd"):
        package = {"glb": "trimesh", "mcap": "mcap_ros2", "rrd": "rerun"}[to]
        pytest.importorskip(package, reason="pip install '.[viewer,mcap]'")
    if to == "labelme":
        pytest.skip("its file lists the classes; the labels are compared in test_export_formats.py")
    if to == "rrd":
        pytest.skip("rerun numbers the chunks of a file at random")
    paths = [tmp_path / "1", tmp_path / "2"]
    assert [rt.export(room, to, path) for path in paths] == paths
    assert paths[0].read_bytes() == paths[1].read_bytes() != b""


def test_track_only_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without cameras: the 2D formats work, the 3D ones report the missing cameras."""
    args = ("--detections", ROOM / "detections.npz", "--stop", 20, "-o", tmp_path / "out")
    assert cli("track", ROOM / "room.mp4", *args, *NO_PICTURES) == 0
    for to in ("coco-vid", "cvat"):
        assert cli("export", tmp_path / "out", "--to", to) == 0
    assert len(json.loads((tmp_path / "out/coco_vid.json").read_text())["images"]) == 20
    capsys.readouterr()
    pytest.importorskip("trimesh", reason="pip install '.[viewer]'")
    assert cli("export", tmp_path / "out", "--to", "glb") == 2
    error = capsys.readouterr().err
    assert "nothing to export" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out/objects.glb").exists()


def test_a_video_without_objects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    """Empty valid files, and no warning."""
    (tmp_path / "det.csv").write_text("frame,x1,y1,x2,y2,score,class\n")
    out = tmp_path / "out"
    args = ("--detections", tmp_path / "det.csv", "-o", out, "--stop", 3)
    assert cli("track", ROOM / "room.mp4", *args, *NO_PICTURES) == 0
    capsys.readouterr()
    for to in ("coco-vid", "cvat"):
        assert cli("export", out, "--to", to) == 0
    assert capsys.readouterr().err == "" and not list(recwarn)
    data = json.loads((out / "coco_vid.json").read_text())
    assert len(data["images"]) == 3 and data["annotations"] == []
    assert not list(ET.parse(out / "cvat.xml").getroot().iter("track"))


def test_the_video_may_be_deleted(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(room, out)
    source = json.loads((out / "cache/source.json").read_text())
    (out / "cache/source.json").write_text(json.dumps(source | {"source": "/nowhere.mp4"}))
    rt.export(out, "coco-vid")
    shutil.rmtree(out / "cache")  # "may be deleted"
    rt.export(out, "cvat")
    assert groups(mot(out / "tracks.txt")) == groups(mot(room / "tracks.txt"))


def test_export_of_no_output_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("export", tmp_path, "--to", "cvat") == 2
    assert "make them first with `run`" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


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


def test_glb_stands_upright_in_metres(chairs: rt.Result, tmp_path: Path) -> None:
    """The world is tilted and its unit is half a metre: in the file y is up, chairs .82 m high."""
    tilt = Rotation.from_euler("xyz", [40, 70, -20], degrees=True).as_matrix()
    ellipsoids = chairs.ellipsoids()
    objects = [
        dataclasses.replace(
            o, center=tilt @ c / 0.5, half_axes=h / 0.5,
            quat_wxyz=np.roll(Rotation.from_matrix(tilt @ r).as_quat(), 1),
        )
        for o, c, h, r in zip(chairs.objects, ellipsoids.center_in_world, ellipsoids.half_axes,
                              ellipsoids.world_from_obj, strict=True)
    ]  # fmt: skip
    scale = chairs.world.scale._replace(value=0.5)
    world = dataclasses.replace(chairs.world, up_in_world=tilt @ [0, 0, 1], scale=scale)
    result = dataclasses.replace(chairs, objects=objects, world=world, fits=None, poses=None)
    nodes = in_glb(result, tmp_path / "a.glb")
    assert sorted(nodes) == ["chair 1", "chair 2", "chair 3"]
    for vertices, _ in nodes.values():
        low, high = vertices.min(0), vertices.max(0)
        assert high[1] - low[1] == pytest.approx(0.82, rel=0.08)  # y is up
        assert low[1] == pytest.approx(0, abs=0.06) and (high - low)[[0, 2]].max() < 0.75
    middle = np.array([nodes[f"chair {i}"][0].mean(0) for i in (1, 2, 3)])
    apart = np.linalg.norm(np.diff(middle, axis=0), axis=1)
    np.testing.assert_allclose(apart, np.hypot(1.1, 0.1), atol=0.05)


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


def test_glb_in_trimesh(room: Path, tmp_path: Path) -> None:
    """Every ellipsoid is a named node with its position, colour and metadata."""
    nodes = nodes_of(rt.export(room, "glb", tmp_path / "a.glb"))
    world, kept = located(room)
    up, scale = np.array(world["up_in_world"]), world["scale"]["metres_per_unit"]
    names = {f"{o['class']} {o['id']}" for o in kept}
    assert {n for n in nodes if n not in ("points", "cameras")} == names and len(names) > 5
    centers = {}
    for o in kept:
        vertices, mesh = nodes[f"{o['class']} {o['id']}"]
        own = Rotation.from_quat(np.roll(o["quat_wxyz"], -1)).as_matrix()
        bound = scale * np.linalg.norm((own * o["half_axes"]).T @ up)  # half height along up
        assert np.ptp(vertices[:, 1]) / 2 == pytest.approx(bound, rel=0.02)
        spread = np.linalg.eigvalsh(np.cov((vertices - vertices.mean(0)).T))
        np.testing.assert_allclose(np.sqrt(3 * spread), scale * np.sort(o["half_axes"]), rtol=0.03)
        centers[o["id"]] = vertices.mean(0)
        facts = mesh.metadata.get("extras", mesh.metadata)
        assert {k: facts[k] for k in ("id", "class", "status", "support", "size_m")} == {
            k: o[k] for k in ("id", "class", "status", "support", "size_m")
        }
        color = mesh.visual.to_color().vertex_colors if hasattr(mesh.visual, "to_color") else None
        color = mesh.visual.vertex_colors if color is None else color
        np.testing.assert_allclose(color[0, :3], object_color(o["id"])[::-1], atol=3)
    found = np.array([centers[o["id"]] for o in kept])
    truth = scale * np.array([o["center"] for o in kept])
    spread = [np.linalg.norm(c[:, None] - c, axis=-1) for c in (found, truth)]
    np.testing.assert_allclose(*spread, atol=1e-3)  # the same arrangement
    np.testing.assert_allclose(found[:, 1], truth @ up, atol=1e-3)  # not mirrored in height


def test_glb_shows_points_and_the_path_of_the_cameras(chairs: rt.Result, tmp_path: Path) -> None:
    """z is up in the walk: the file has x, z, -y, or that rotated about y."""
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    colors = np.tile(np.array([[200, 30, 10]], np.uint8), (50, 1))
    poses = dataclasses.replace(chairs.poses, points=points, colors=colors)
    nodes = in_glb(dataclasses.replace(chairs, poses=poses), tmp_path / "a.glb")
    np.testing.assert_allclose(np.sort(nodes["points"][0][:, 1]), np.sort(points[:, 2]), atol=1e-4)
    assert tuple(nodes["points"][1].colors[0][:3]) == (200, 30, 10)
    path = nodes["cameras"][0]
    np.testing.assert_allclose(path[:, 1], 1.6, atol=1e-4)  # the walk's height
    np.testing.assert_allclose(np.linalg.norm(path[:, [0, 2]], axis=1), 3.5, atol=1e-4)


def test_glb_reports_a_missing_scale_or_up(
    chairs: rt.Result, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scale = chairs.world.scale._replace(value=7.0, source="none")
    world = dataclasses.replace(chairs.world, up_in_world=None, scale=scale)
    nodes = in_glb(dataclasses.replace(chairs, world=world), tmp_path / "a.glb")
    assert "scale is unknown" in caplog.text and "up is unknown" in caplog.text
    np.testing.assert_allclose(nodes["chair 1"][0].mean(0), [-1.1, 0, 0.41], atol=0.04)


@pytest.mark.parametrize(("to", "package"), [("glb", "trimesh"), ("rrd", "rerun")])
def test_a_missing_package_is_named(
    room: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    to: str,
    package: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert cli("export", room, "--to", to) == 2
    error = capsys.readouterr().err
    assert "pip install" in error and package in error and len(error.splitlines()) == 1
    assert not list(room.glob("*.glb")) and not list(room.glob("*.rrd"))


def test_rrd_in_rerun(room: Path, tmp_path: Path) -> None:
    """Read back by rerun itself: every ellipsoid, camera and box."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    found = in_rrd(rt.export(room, "rrd", tmp_path / "a.rrd"))
    world, kept = located(room)
    scale = world["scale"]["metres_per_unit"]
    for o in kept:
        (row,) = found[f"/world/objects/{str(o['class']).replace(' ', chr(92) + ' ')}/{o['id']}"]
        half, center = scale * np.array([o["half_axes"]]), scale * np.array([o["center"]])
        np.testing.assert_allclose(row["Ellipsoids3D:half_sizes"], half, rtol=1e-5)
        np.testing.assert_allclose(row["Ellipsoids3D:centers"], center, rtol=1e-5, atol=1e-6)
        quat = np.roll(o["quat_wxyz"], -1)
        np.testing.assert_allclose(row["Ellipsoids3D:quaternions"], [quat], atol=1e-5)
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


def test_images_in_rerun_are_small_and_boxes_fit_them(chairs: rt.Result, tmp_path: Path) -> None:
    """A video of 1920 px: image, camera and boxes are all scaled to a third."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    large = rt.Camera("PINHOLE", 1920, 1440, tuple(3 * p for p in chairs.poses.camera.params))
    tracks = dataclasses.replace(chairs.tracks, xyxy=3 * chairs.tracks.xyxy)
    (tmp_path / "f").mkdir()
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"f/{i}.jpg"), np.zeros((1440, 1920, 3), np.uint8))
    Workspace(tmp_path / "out").bind(rt.Video(tmp_path / "f"))
    poses = dataclasses.replace(chairs.poses, camera=large)
    video = VideoInfo("f", 1920, 1440, 30.0)
    result = dataclasses.replace(chairs, tracks=tracks, poses=poses, video=video)
    result.save(tmp_path / "out")
    found = in_rrd(rt.export(tmp_path / "out", "rrd"))
    assert len(found["/world/camera/image"]) == 2
    picture = np.array(found["/world/camera/image"][0]["EncodedImage:blob"][0], np.uint8)
    assert cv2.imdecode(picture, cv2.IMREAD_COLOR).shape == (480, 640, 3)
    lens = found["/world/camera"][0]
    assert lens["Pinhole:resolution"] == [[640, 480]]
    assert lens["Pinhole:image_from_camera"][0][0] == pytest.approx(520)
    first = found["/world/camera/boxes"][0]
    centers = chairs.tracks.xyxy[:3].reshape(3, 2, 2).mean(1)
    np.testing.assert_allclose(first["Boxes2D:centers"], centers, atol=0.01)


def test_missing_images_are_missing_in_rerun(chairs: rt.Result, tmp_path: Path) -> None:
    """Frame 1 cannot be read, frame 3 was never read: each image stands at its own frame."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    (tmp_path / "f").mkdir()
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"f/{i}.png"), np.full((480, 640, 3), 40 * i, np.uint8))
    (tmp_path / "f/1.png").write_bytes(b"no image")
    Workspace(tmp_path / "out").bind(rt.Video(tmp_path / "f"))
    read = np.isin(chairs.tracks.frame, [0, 1, 2, 4])
    rows = np.flatnonzero(np.isin(chairs.poses.frame, [0, 1, 2, 4]))
    own = {k: getattr(chairs.poses, k)[rows] for k in ("frame", "time_s", "cam_from_world",
                                                       "status", "part")}  # fmt: skip
    poses = dataclasses.replace(chairs.poses, **own)
    dataclasses.replace(chairs, tracks=chairs.tracks[read], poses=poses).save(tmp_path / "out")
    found = in_rrd(rt.export(tmp_path / "out", "rrd"))
    assert sorted(row["frame"] for row in found["/world/camera"]) == [0, 1, 2, 4]
    shown = {}
    for row in found["/world/camera/image"]:
        picture = np.array(row["EncodedImage:blob"][0], np.uint8)
        shown[row["frame"]] = round(float(cv2.imdecode(picture, cv2.IMREAD_COLOR).mean()))
    assert shown == {0: 0, 2: 80, 4: 160} and len(found["/world/camera/image"]) == 3


def test_tracks_of_no_object_are_not_exported(chairs: rt.Result, tmp_path: Path) -> None:
    """Rows added to tracks.txt by hand have no class."""
    chairs.save(tmp_path)
    with (tmp_path / "tracks.txt").open("a") as file:
        file.write("1,9,10,10,20,20,0.9,-1,-1,-1\n")
    with pytest.raises(rt.ReobjError, match=r"tracks\.txt: object 9 is not in objects\.json"):
        rt.export(tmp_path, "cvat")
    assert not (tmp_path / "cvat.xml").exists()


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


@pytest.mark.usefixtures("no_points")
def test_show_reaches_the_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flag --show: live while tracking, then the result; cached tracks are read."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    path = tmp_path / "live.rrd"
    viewer = partial(Viewer, start=lambda rec: rec.save(path))
    monkeypatch.setattr("reobj.results.live.Viewer", viewer)
    args = ("--detections", ROOM / "detections.npz", "--poses", ROOM / "poses.txt", "--camera",
            CAMERA, "--every", 5, "--stop", 30, "--show", *NO_PICTURES)  # fmt: skip
    for _ in range(2):
        assert cli("run", ROOM / "room.mp4", "-o", tmp_path / "out", *args) == 0
        found = in_rrd(path)
        assert len({row["frame"] for row in found["/world/camera/image"]}) == 6
        assert any(name.startswith("/world/objects/chair/") for name in found)


def in_rrd(path: Path) -> dict[str, list[dict]]:
    """Rows of a recording by entity, read by rerun."""
    from rerun.chunk import RrdReader

    found = defaultdict(list)
    for chunk in RrdReader(path).stream().to_chunks():
        table = chunk.to_record_batch()
        kept = [name for name in table.schema.names if name != "time"]  # whole frames are enough
        found[chunk.entity_path] += table.select(kept).to_pylist()
    return found


def test_colmap_opens_sparse(room: Path) -> None:
    """pycolmap, and COLMAP itself where it is installed, read OUT/sparse."""
    import pycolmap

    model = pycolmap.Reconstruction(str(room / "sparse"))
    assert model.num_reg_images() == 40 and model.num_cameras() == 1
    if (colmap := shutil.which("colmap")) is None:
        pytest.skip("pycolmap reads it; no colmap here to ask too: apt-get install colmap")
    command = [colmap, "model_analyzer", "--path", str(room / "sparse")]
    answer = subprocess.run(command, capture_output=True, text=True)
    assert "Registered images: 40" in answer.stdout + answer.stderr
