"""Exports: each is read back, by our reader, by the format's own, or as its reader does it."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import zipfile
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reobj_track as rt

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
CAMERA = "492.756788421,492.756788421,320,240"


def cli(*args: object) -> int:
    return rt.main([str(a) for a in args])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every third frame of the first half of the example room, with its true cameras."""
    out = tmp_path_factory.mktemp("room") / "out"
    args = ("--detections", ROOM / "detections.npz", "--poses", ROOM / "poses.txt")
    few = ("--every", 3, "--stop", 120, "--set", "output.overlay=false")
    assert cli("run", ROOM / "room.mp4", "-o", out, *args, "--camera", CAMERA, *few) == 0
    return out


def mot(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


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
    assert {i["video_id"] for i in data["images"]} == {v["id"] for v in data["videos"]} == {1}
    found = np.array(
        [[frame_of[a["image_id"]] + 1, a["instance_id"], *a["bbox"]] for a in data["annotations"]]
    )
    np.testing.assert_allclose(found, rows[:, :6], atol=0.021)
    name = {c["id"]: c["name"] for c in data["categories"]}
    classes = {a["instance_id"]: name[a["category_id"]] for a in data["annotations"]}
    assert classes == {o["id"]: o["class"] for o in objects(room)}


def test_coco_vid_in_pycocotools(room: Path, tmp_path: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco")
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
    track = rt.read_tracks(path, video)
    assert track.fixed and not track.messages
    np.testing.assert_array_equal(
        np.column_stack([track.table.frame + 1, track.table.object_id]),
        rows[np.lexsort((rows[:, 1], rows[:, 0])), :2],
    )


# ---- CVAT: identities corrected by hand ----


def test_cvat_has_what_its_importer_reads(room: Path, tmp_path: Path) -> None:
    """The attributes that cvat.py's loader asks for; only keyframes count; visits are closed."""
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
            assert {"frame", "outside", "occluded", *rt.CVAT_BOX} <= set(box.attrib)
            frame = int(box.attrib["frame"])
            if box.attrib["outside"] == "0":
                inside.append((frame + 1, number + 1))
                assert not shown or shown[-1][1] == "1" or shown[-1][0] == frame - 3
            shown.append((frame, box.attrib["outside"]))
        assert shown[-1][1] == "1" or shown[-1][0] == 117  # gone before the end of the video
        assert [f for f, _ in shown] == sorted({f for f, _ in shown})
    assert sorted(inside) == sorted((int(r[0]), int(r[1])) for r in rows)


def test_cvat_unchanged_gives_the_same_objects(room: Path, tmp_path: Path) -> None:
    """Also without any detector: the boxes of the file do."""
    path, again = tmp_path / "a.xml", tmp_path / "again"
    rt.export(room, "cvat", path)
    args = ("--poses", ROOM / "poses.txt", "--camera", CAMERA, "--tracks", path)
    few = ("--every", 3, "--stop", 120, "--set", "output.overlay=false")
    assert cli("run", ROOM / "room.mp4", "-o", again, *args, *few) == 0
    assert groups(mot(again / "tracks.txt")) == groups(mot(room / "tracks.txt"))
    before, after = ({o["id"]: o for o in objects(out)} for out in (room, again))
    assert {i: o["class"] for i, o in before.items()} == {i: o["class"] for i, o in after.items()}
    kept = [i for i, o in before.items() if o["status"] == after[i]["status"] == "ok"]
    gap = [np.subtract(before[i]["center"], after[i]["center"]) for i in kept]
    assert len(kept) >= 3 and np.linalg.norm(gap, axis=1).max() < 0.05  # m; all scores are 1 here


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


@pytest.mark.parametrize("kind", ["xml", "zip"])
def test_corrected_identities_are_taken(room: Path, tmp_path: Path, kind: str) -> None:
    """`objects OUT --tracks`: what the user says stands, whatever the linker would think."""
    import shutil

    out, path = tmp_path / "out", tmp_path / "corrected.xml"
    shutil.copytree(room, out)
    a, b = edited(out, path)
    if kind == "zip":  # what CVAT's download is
        with zipfile.ZipFile(tmp_path / "task.zip", "w") as archive:
            archive.write(path, "annotations.xml")
        path = tmp_path / "task.zip"
    rows = mot(out / "tracks.txt")
    moved = np.flatnonzero(rows[:, 1] == b)[4:]
    rows[moved, 1] = a
    for _ in range(2):  # and it stands when the objects are fitted again without --tracks
        assert cli("objects", out, *(("--tracks", path) if path else ())) == 0
        found = mot(out / "tracks.txt")
        assert sorted(map(tuple, found[:, :2])) == sorted(map(tuple, rows[:, :2]))
        path = None
    data = json.loads((out / "objects.json").read_text())
    assert data["world"]["links"] == []
    assert {o["id"]: o["frames_seen"] for o in data["objects"]}[b] == 4


def test_corrected_mot_keeps_the_classes(room: Path, tmp_path: Path) -> None:
    import shutil

    out = tmp_path / "out"
    shutil.copytree(room, out)
    rows = mot(out / "tracks.txt")
    rows[:, 1] += 100  # other numbers are kept too
    np.savetxt(tmp_path / "t.txt", rows, delimiter=",", fmt="%g")
    before = objects(out)
    assert cli("objects", out, "--tracks", tmp_path / "t.txt") == 0
    after = objects(out)
    assert [(o["id"] + 100, o["class"]) for o in before] == [(o["id"], o["class"]) for o in after]
    status = [(o["status"], a["status"]) for o, a in zip(before, after, strict=True)]
    assert [x for x in status if x[0] != x[1]] == []


BAD_TRACKS = {
    "no xml": ("a.xml", "<annotations", "no annotations of CVAT"),
    "no track": ("a.xml", "<annotations><image id='0'/></annotations>", "no track with a box"),
    "no number": (
        "a.xml",
        "<annotations><track id='0' label='x'><box frame='0' xtl='a' ytl='1' xbr='2' ybr='3'/>"
        "</track></annotations>",
        "no annotations of CVAT",
    ),
    "detections": ("a.txt", "1,-1,10,10,20,20,.9,-1,-1,-1\n", "not every box has an identity"),
    "twice": ("a.txt", "1,4,10,10,20,20\n1,4,99,10,20,20\n", "identity 4 has 2 boxes in frame 0"),
    "missing": ("a.txt", None, "no such file"),
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


# ---- Boxer CSV ----


def read_boxer(path: Path) -> dict[int, list[dict[str, object]]]:
    """As Boxer's read_obb_csv: split at commas, fixed columns, wxyz, full extents, by time."""
    lines = path.read_text().split("\n")
    assert lines[0] == rt.BOXER_COLUMNS
    timed = defaultdict(list)
    for line in filter(None, lines[1:]):
        e = line.split(",")
        assert len(e) == 15
        numbers = np.array([float(x) for x in e[1:11]])
        turn = Rotation.from_quat(np.roll(numbers[3:7], -1)).as_matrix()
        half = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8) * numbers[7:, None] / 2
        corners = (turn @ half).T + numbers[:3]
        timed[int(e[0])].append({"name": e[11], "id": int(e[12]), "corners": corners})
        assert int(e[13]) >= 0 and 0 <= float(e[14]) <= 1
    return timed


def test_boxer_csv_is_the_same_solid_with_z_up(room: Path, tmp_path: Path) -> None:
    """Corners as Boxer makes them, in metres, lie where objects.json has them, turned upright."""
    path = tmp_path / "b.csv"
    assert cli("export", room, "--to", "boxer", "-o", path) == 0
    (boxes,) = read_boxer(path).values()
    data = json.loads((room / "objects.json").read_text())
    kept = [o for o in data["objects"] if o["status"] != "rejected"]
    assert [b["id"] for b in boxes] == [o["id"] for o in kept]
    up, scale = np.array(data["world"]["up_in_world"]), data["world"]["scale"]["metres_per_unit"]
    for box, o in zip(boxes, kept, strict=True):
        own = Rotation.from_quat(np.roll(o["quat_wxyz"], -1)).as_matrix()
        half = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8) * np.array(o["size"])[:, None]
        corners = scale * ((own @ half / 2).T + o["center"])
        np.testing.assert_allclose(box["corners"][:, 2], corners @ up, atol=1e-4)  # z is up
        spread = [np.linalg.norm(c[:, None] - c, axis=-1) for c in (box["corners"], corners)]
        np.testing.assert_allclose(*spread, atol=1e-4)  # the same solid
        assert box["name"] == o["class"]


def test_boxer_without_scale_or_up_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    entry = {"id": 1, "class": "a,b", "status": "ok", "score": 0.5, "center": [1, 2, 3],
             "quat_wxyz": [1, 0, 0, 0], "size": [1, 1, 2]}  # fmt: skip
    world = {"up_in_world": None, "scale": {"metres_per_unit": None, "source": "none"}}
    data = {"world": world, "objects": [entry, {"status": "rejected"}]}
    table = rt.TrackTable.from_steps([], [], 1.0)
    rt.export_boxer(rt.Saved(tmp_path, data, table, ("a,b",), None, None), tmp_path / "b.csv")
    assert "scale is unknown" in caplog.text and "up is unknown" in caplog.text
    ((box,),) = read_boxer(tmp_path / "b.csv").values()
    np.testing.assert_allclose(box["corners"].mean(0), [1, 2, 3])
    assert box["name"] == "a b"


@pytest.mark.parametrize("a", [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0.6, 0, 0.8], [-3, 2, 1]])
def test_turn_onto(a: list[float]) -> None:
    turn = rt.turn_onto(np.array(a, float), np.array([0.0, 0, 1]))
    np.testing.assert_allclose(turn @ a, [0, 0, np.linalg.norm(a)], atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) > 0


# ---- What every export must do ----


@pytest.mark.parametrize("to", rt.EXPORTS)
def test_same_folder_same_bytes(room: Path, tmp_path: Path, to: str) -> None:
    if to in ("glb", "rrd"):
        pytest.importorskip({"glb": "trimesh", "rrd": "rerun"}[to])
        pytest.skip("other packages' writers: tested with them")
    paths = [tmp_path / "1", tmp_path / "2"]
    assert [rt.export(room, to, path) for path in paths] == paths
    assert paths[0].read_bytes() == paths[1].read_bytes() != b""


def test_track_only_folder(room: Path, tmp_path: Path) -> None:
    """Without cameras: the 2D formats work, the 3D ones are empty, nothing fails."""
    args = ("--detections", ROOM / "detections.npz", "--stop", 20, "-o", tmp_path / "out")
    assert cli("track", ROOM / "room.mp4", *args, "--set", "output.overlay=false") == 0
    for to in ("coco-vid", "cvat", "boxer"):
        assert cli("export", tmp_path / "out", "--to", to) == 0
    assert len(json.loads((tmp_path / "out/coco_vid.json").read_text())["images"]) == 20
    with (tmp_path / "out/boxer_3dbbs.csv").open() as file:
        assert len(list(csv.reader(file))) == 1


def test_a_video_without_objects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    """Empty files of the right form, and no complaint."""
    (tmp_path / "det.csv").write_text("frame,x1,y1,x2,y2,score,class\n")
    out, few = tmp_path / "out", ("--stop", 3, "--set", "output.overlay=false")
    args = ("--detections", tmp_path / "det.csv", "-o", out)
    assert cli("track", ROOM / "room.mp4", *args, *few) == 0
    capsys.readouterr()
    for to in ("coco-vid", "cvat", "boxer"):
        assert cli("export", out, "--to", to) == 0
    assert capsys.readouterr().err == "" and not list(recwarn)
    data = json.loads((out / "coco_vid.json").read_text())
    assert len(data["images"]) == 3 and data["annotations"] == []
    assert not list(ET.parse(out / "cvat.xml").getroot().iter("track"))


def test_the_video_may_be_gone(room: Path, tmp_path: Path) -> None:
    import shutil

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


def upright(out: Path, axis: list[float]) -> tuple[np.ndarray, float, list[dict[str, object]]]:
    """Rotation of the world's up onto an axis, metres per unit, and the objects with a solid."""
    data = json.loads((out / "objects.json").read_text())
    turn = rt.turn_onto(np.array(data["world"]["up_in_world"]), np.array(axis))
    kept = [o for o in data["objects"] if o["status"] != "rejected"]
    return turn, data["world"]["scale"]["metres_per_unit"], kept


def test_glb_in_trimesh(room: Path, tmp_path: Path) -> None:
    """Every ellipsoid is a named node in its place and colour, y up, in metres."""
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(rt.export(room, "glb", tmp_path / "a.glb"))
    turn, scale, kept = upright(room, [0.0, 1, 0])
    names = {f"{o['class']} {o['id']}" for o in kept}
    assert names <= set(scene.graph.nodes_geometry) and len(names) == len(kept) > 5
    for o in kept:
        matrix, mesh = scene.graph[f"{o['class']} {o['id']}"]
        points = scene.geometry[mesh].vertices @ matrix[:3, :3].T + matrix[:3, 3]  # (P, 3)
        own = Rotation.from_quat(np.roll(o["quat_wxyz"], -1)).as_matrix()
        inside = ((points / scale @ turn - o["center"]) @ own) / o["half_axes"]
        np.testing.assert_allclose(np.linalg.norm(inside, axis=1), 1, atol=1e-3)
        red, green, blue = rt.object_color(int(o["id"]))[::-1]
        color = scene.geometry[mesh].visual.material.baseColorFactor[:3]
        np.testing.assert_allclose(
            (color / 255) ** (1 / 2.2), np.divide((red, green, blue), 255), atol=0.03
        )


def test_glb_follows_the_specification(room: Path, tmp_path: Path) -> None:
    """Sizes, alignment, and cameras that look along -z from where poses.txt has them."""
    raw = rt.export(room, "glb", tmp_path / "a.glb").read_bytes()
    assert raw[:4] == b"glTF" and np.frombuffer(raw[4:12], "<u4").tolist() == [2, len(raw)]
    length = int(np.frombuffer(raw[12:16], "<u4")[0])
    gltf = json.loads(raw[20 : 20 + length])
    assert length % 4 == 0 and gltf["buffers"][0]["byteLength"] == len(raw) - 28 - length
    assert all(v["byteOffset"] % 4 == 0 for v in gltf["bufferViews"])
    cameras = [n for n in gltf["nodes"] if n["name"].startswith("camera ")]
    tum = np.loadtxt(room / "poses.txt")
    np.testing.assert_allclose([n["translation"] for n in cameras], tum[:, 1:4], atol=1e-5)
    forward = Rotation.from_quat([n["rotation"] for n in cameras]).apply([0, 0, -1])
    np.testing.assert_allclose(forward, Rotation.from_quat(tum[:, 4:]).apply([0, 0, 1]), atol=1e-5)


def test_glb_without_cameras_or_objects(tmp_path: Path) -> None:
    """Identities only: a file that opens, with nothing in it."""
    out = tmp_path / "out"
    args = ("--detections", ROOM / "detections.npz", "--stop", 3, "--set", "output.overlay=false")
    assert cli("track", ROOM / "room.mp4", "-o", out, *args) == 0
    raw = rt.export(out, "glb").read_bytes()
    gltf = json.loads(raw[20 : 20 + int(np.frombuffer(raw[12:16], "<u4")[0])])
    assert [n["name"] for n in gltf["nodes"]] == ["world"] and "meshes" not in gltf


def test_rrd_in_rerun(room: Path, tmp_path: Path) -> None:
    """Read back by rerun itself: every ellipsoid, camera and box."""
    pytest.importorskip("rerun", reason="pip install .[viewer]")
    from rerun.chunk import RrdReader

    found = defaultdict(list)
    for chunk in RrdReader(rt.export(room, "rrd", tmp_path / "a.rrd")).stream().to_chunks():
        found[chunk.entity_path] += chunk.to_record_batch().to_pylist()
    _, scale, kept = upright(room, [0.0, 0, 1])
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
    (points,) = found["/world/points"] or [{"Points3D:positions": []}]
    assert isinstance(points["Points3D:positions"], list)


def test_rrd_without_rerun_says_what_to_install(
    room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli("export", room, "--to", "rrd") == 2
    assert "pip install" in capsys.readouterr().err and not (room / "scene.rrd").exists()


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
