"""Every command, solver, exporter and format of poses, as a user calls them, against the truth.

Shell completion is tested in tests/test_run.py.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import truth as scores
from scipy.spatial.transform import Rotation
from test_readers import FORMATS

import reobj_track as rt
from front_door.room import (
    CAMERA,
    DETECTIONS,
    FEW,
    POSES,
    ROOM,
    ROOT,
    assert_example_right,
    assert_right,
    cli,
    idf1_of_rows,
    info,
    overlay_frames,
    true_boxes,
    true_cameras,
    true_centres,
    true_objects,
)
from reobj.commands import apply_command

SHORT = range(0, 120, 3)  # frames of the `room` fixture
FILES = {
    "cache", "config.toml", "objects.json", "objects.ply", "poses.txt", "scene.html", "sparse",
    "tracks.txt",
}  # fmt: skip


@pytest.fixture
def out(room: Path, tmp_path: Path) -> Path:
    """A copy of the output folder of the clip's first half, with true cameras."""
    shutil.copytree(room, tmp_path / "out")
    return tmp_path / "out"


# ---- run, track, poses ----


def test_readmes_first_command(example: Path) -> None:
    assert_example_right(example)
    names = {path.name for path in example.iterdir()}
    assert names - {"overlay.mp4", "eval.json"} == FILES
    scale = info(example)["world"]["scale"]
    ours = scores.Output.read(example).centres
    points = np.array([ours[f] for f in range(240)])
    true, *_ = scores.similarity(points, true_centres())
    assert abs(np.log(scale["metres_per_unit"] / true)) < 2 * scale["rel_sigma"]


def test_run_with_supplied_cameras(room: Path) -> None:
    assert_right(room)


def test_track(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli("track", ROOM / "room.mp4", "-o", out, *DETECTIONS, *FEW) == 0
    assert_right(out, hit_rate=0, idf1=0.94)
    assert overlay_frames(out) == 40
    printed_by = capsys.readouterr()
    assert "warning" not in printed_by.err and " objects: " in printed_by.out


def test_run_without_images(tmp_path: Path) -> None:
    out, words = tmp_path / "out", ("--camera", (ROOM / "camera.txt").read_text())
    assert cli("run", "-o", out, *DETECTIONS, *POSES[:2], *words, *FEW) == 0
    assert_right(out, idf1=0.94, warning="note: no images")


PICTURES = range(0, 60, 10)  # frames of the clip that are the images 0000.jpg ... 0005.jpg


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images of the clip, a quarter of its size."""
    folder = tmp_path_factory.mktemp("pictures")
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(every=10, stop=60))
    for i, frame in enumerate(video):
        cv2.imwrite(str(folder / f"{i:04d}.jpg"), cv2.resize(frame.image, (160, 120)))
    return folder


@pytest.mark.usefixtures("no_points")
@pytest.mark.parametrize("write", [row[0] for row in FORMATS], ids=lambda w: w.__name__)
def test_poses_in_every_format(
    pictures: Path, tmp_path: Path, write: Callable[[Path, np.ndarray], Path]
) -> None:
    """Camera centres equal those of the file."""
    path, out = write(tmp_path, true_cameras(PICTURES)), tmp_path / "out"
    camera = ",".join(str(float(v) / 4) for v in CAMERA.split(","))
    assert cli("poses", pictures, "-o", out, "--poses", path, "--camera", camera) == 0
    rows = np.loadtxt(out / "poses.txt")
    np.testing.assert_allclose(rows[:, 0], np.arange(6) / 30, atol=1e-6)
    np.testing.assert_allclose(rows[:, 1:4], true_centres()[list(PICTURES)], atol=1e-5)
    turn = Rotation.from_quat(rows[:, 4:]).inv().as_matrix()
    np.testing.assert_allclose(turn, true_cameras(PICTURES)[:, :, :3], atol=1e-5)


# ---- objects ----


@pytest.mark.parametrize(
    ("solver", "centre_m", "size", "rate"),
    [("solids", 0.03, 0.1, 0.9), ("lfd", 0.05, 0.25, 0.5), ("sfmo", 0, 0, 0),
     ("psfmo", 0.06, 0.2, 0.9)],
)  # fmt: skip
def test_every_solver(out: Path, solver: str, centre_m: float, size: float, rate: float) -> None:
    """SfMO assumes affine cameras, so its sizes are not checked here: files and overlay only."""
    pictures = ("--set", "output.overlay=1", "--set", "output.scene=1")
    assert cli("objects", out, "--solver", solver, *pictures) == 0
    warning = "" if solver == "solids" else f"objects.solver={solver}: "
    assert_right(out, centre_m=centre_m, size=size, hit_rate=rate, warning=warning)
    assert sum(o["status"] == "ok" for o in info(out)["objects"]) >= 3
    assert overlay_frames(out) == 40 and (out / "scene.html").stat().st_size > 1e6
    assert (out / "objects.ply").stat().st_size > 1e3


@pytest.mark.parametrize("support", ["box", "cylinder", "ellipsoid"])
def test_every_support(out: Path, support: str) -> None:
    assert cli("objects", out, "--support", support) == 0
    kinds = {o["support"] for o in info(out)["objects"] if o["center"]}
    assert kinds == {support}
    assert_right(out, centre_m=0.06, size=0.2)


def test_objects_are_valid(example: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("objects", example, "--validate") == 0
    assert capsys.readouterr().out == "valid\n"


# ---- eval ----


def evaluated(out: Path, *args: object) -> dict[str, Any]:
    assert cli("eval", out, "--gt", ROOM / "gt_mot.txt", *args) == 0
    found: dict[str, Any] = json.loads((out / "eval.json").read_text())
    return found


def test_eval_agrees_with_the_public_files(example: Path, tmp_path: Path) -> None:
    """IDF1, objects and errors, computed from tracks.txt, objects.json and poses.txt alone."""
    out = tmp_path / "out"
    shutil.copytree(example, out)
    found = evaluated(out, "--gt-objects", ROOM / "gt_objects.json")
    output = scores.Output.read(out)
    own = scores.score_2d(true_boxes(), output)
    assert found["tracks"]["all"]["IDF1"] == pytest.approx(own.idf1, abs=1e-6)
    assert found["tracks"]["all"]["identities"] == len({i for i in output.rows[:, 1]})
    cameras = scores.score_cameras(output, dict(enumerate(true_centres())), own=True)
    assert cameras is not None
    solids = scores.score_solids(true_objects(), output, cameras.truth_from_ours)
    assert found["objects"]["found"] == solids.found and found["objects"]["true"] == 35
    # eval also turns the world by the directions of the cameras: millimetres
    assert found["objects"]["center_error_median"] == pytest.approx(solids.centre_m, abs=0.006)


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    """The first row of the table that `eval` prints, as fractions."""
    names, numbers = capsys.readouterr().out.splitlines()[:2]
    return dict(zip(names.split(), map(float, numbers.split()[1:]), strict=True))


def test_eval_scores_drop_after_an_identity_swap(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tracks.txt, and one in which the identities of two chairs are swapped half way."""
    lines = (out / "tracks.txt").read_text().splitlines()
    rows = np.loadtxt(lines, delimiter=",")
    late = rows[:, 0] > 60
    chairs = [o["id"] for o in info(out)["objects"] if o["class"] == "chair"]
    chairs = [i for i in chairs if {*late[rows[:, 1] == i]} == {False, True}][:2]
    number = rows[:, 1].copy()
    for old, new in (chairs, chairs[::-1]):
        number[late & (rows[:, 1] == old)] = new
    names = {o["id"]: o["class"] for o in info(out)["objects"]}
    xyxy = np.hstack([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]])
    found = []
    for ids in (rows[:, 1], number):
        pieces = [line.split(",", 2) for line in lines]
        path = tmp_path / "tracks.txt"
        path.write_text(
            "".join(f"{p[0]},{i:.0f},{p[2]}\n" for p, i in zip(pieces, ids, strict=True))
        )
        few = tmp_path / "gt.txt"  # of the frames that were read
        truth = (ROOM / "gt_mot.txt").read_text().splitlines()
        few.write_text("\n".join(t for t in truth if int(t.split(",")[0]) - 1 in SHORT) + "\n")
        capsys.readouterr()
        assert cli("eval", path, "--gt", few) == 0
        found.append(printed(capsys))
        own = idf1_of_rows(np.column_stack([rows[:, 0] - 1, ids, xyxy]), names, SHORT)
        assert found[-1]["IDF1"] == pytest.approx(100 * own, abs=0.1)
    assert [f["IDSW"] for f in found] == [0, 2]
    assert found[1]["IDF1"] < found[0]["IDF1"] - 1


def test_eval_of_some_classes(out: Path) -> None:
    found = evaluated(out, "--classes", "chair,cup", "--min-visibility", 0.5)["tracks"]
    assert set(found) - {"all"} == {"chair", "cup"}
    assert found["all"]["IDF1"] > 0.97


# ---- export ----


def boxes_of_cvat(path: Path) -> tuple[list[list[float]], dict[int, str]]:
    rows = []
    names = {}
    for track in ET.parse(path).getroot().iter("track"):
        number = int(track.attrib["id"])
        names[number] = track.attrib["label"]
        for box in track.iter("box"):
            if box.attrib["outside"] == "0":
                corners = [float(box.attrib[k]) for k in ("xtl", "ytl", "xbr", "ybr")]
                rows.append([float(box.attrib["frame"]), number, *corners])
    return rows, names


def boxes_of_coco(path: Path) -> tuple[list[list[float]], dict[int, str]]:
    data = json.loads(path.read_text())
    frame = {i["id"]: i["frame_id"] for i in data["images"]}
    name = {c["id"]: c["name"] for c in data["categories"]}
    rows = []
    for a in data["annotations"]:
        left, top, width, height = a["bbox"]
        box = [left, top, left + width, top + height]
        rows.append([frame[a["image_id"]], a["instance_id"], *box])
    return rows, {a["instance_id"]: name[a["category_id"]] for a in data["annotations"]}


def check_tracks(read: Callable[[Path], tuple[list[list[float]], dict[int, str]]]) -> Any:
    def check(path: Path) -> None:
        rows, names = read(path)
        assert idf1_of_rows(np.array(rows), names, SHORT) > 0.94  # cvat: without filled gaps

    return check


def near_true(names: list[str], centres: np.ndarray, limit_m: float = 0.15) -> None:
    """Nearly all ellipsoids are near a true object of their class; so is their median."""
    true = true_objects()
    goal = np.array([o["center"] for o in true])
    same = np.array([o["class"] for o in true])[:, None] == np.array(names)
    nearest = np.where(same, np.linalg.norm(goal[:, None] - centres, axis=2), np.inf).min(0)
    assert len(names) >= 22 and np.median(nearest) < 0.05
    assert (nearest < limit_m).mean() > 0.85, nearest


def check_csv(path: Path) -> None:
    with path.open() as file:
        rows = [r for r in csv.DictReader(file) if r["status"] in ("ok", "prior_dominated")]
    for name in ("center", "center_m"):  # the clip is in metres, z up
        centres = np.array([[float(r[f"{name}_{axis}"]) for axis in "xyz"] for r in rows])
        near_true([r["class"] for r in rows], centres)


def check_glb(path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(path)
    names, centres = [], []
    for node in scene.graph.nodes_geometry:
        if found := re.fullmatch(r"(.+) \d+", node):
            matrix, mesh = scene.graph[node]
            corners = trimesh.transform_points(scene.geometry[mesh].bounds, matrix)
            x, y, z = corners.mean(0)
            names.append(found[1])
            centres.append([x, -z, y])  # y up -> z up
    near_true(names, np.array(centres))


def check_boxer(path: Path) -> None:
    with path.open() as file:
        rows = {r["instance"]: r for r in csv.DictReader(file)}.values()
    column = [f"{axis}_world_object" for axis in ("tx", "ty", "tz")]
    near_true([r["name"] for r in rows], np.array([[float(r[k]) for k in column] for r in rows]))


def boxes_of_kitti(path: Path) -> tuple[list[list[float]], dict[int, str]]:
    cells = [line.split() for line in path.read_text().splitlines()]
    rows = [[float(v) for v in (*row[:2], *row[6:10])] for row in cells]
    return rows, {int(row[1]): row[2].replace("_", " ") for row in cells}


def boxes_of_labelme(path: Path) -> tuple[list[list[float]], dict[int, str]]:
    rows = []
    names = {}
    for file in path.parent.glob("images/*.json"):
        for shape in json.loads(file.read_text())["shapes"]:
            corners = [v for point in shape["points"] for v in point]
            rows.append([float(file.stem.removeprefix("frame_")), shape["group_id"], *corners])
            names[shape["group_id"]] = shape["label"]
    return rows, names


def boxes_of_yolo(path: Path) -> tuple[list[list[float]], dict[int, str]]:
    kinds = [json.loads(k) for k in re.findall(r"^  \d+: (.+)$", path.read_text(), re.M)]
    rows = []
    names = {}
    for file in (path.parent / "labels").glob("room_*.txt"):
        frame = int(file.stem.removeprefix("room_")) - 1
        for kind, *box, _, identity in np.loadtxt(file, ndmin=2).tolist():
            x, y, w, h = np.array(box) * [640, 480, 640, 480]
            rows.append([frame, identity, x - w / 2, y - h / 2, x + w / 2, y + h / 2])
            names[int(identity)] = kinds[int(kind)]
    return rows, names


def ros_objects(detections: list[Any]) -> tuple[list[str], np.ndarray]:
    names = [d["results"][0]["hypothesis"]["class_id"] for d in detections]
    places = [d["bbox"]["center"]["position"] for d in detections]
    return names, np.array([[place[axis] for axis in "xyz"] for place in places])


def check_ros(path: Path) -> None:
    near_true(*ros_objects(json.loads(path.read_text())["detections"]))


def check_mcap(path: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="pip install '.[mcap]'")
    with path.open("rb") as file:
        summary = reader.make_reader(file).get_summary()
    counts = {c.topic: summary.statistics.channel_message_counts[i]
              for i, c in summary.channels.items()}  # fmt: skip
    every = {"/tf": 40, "/camera_info": 40, "/detections": 40}
    assert counts == every | {"/objects": 1, "/markers": 1}


def check_usd(path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="pip install usd-core (dev extra)")
    stage = usd.Stage.Open(str(path))
    prims = stage.GetPrimAtPath("/World/objects").GetChildren()
    names = [prim.GetAttribute("userProperties:class").Get() for prim in prims]
    near_true(names, np.array([prim.GetAttribute("xformOp:translate").Get() for prim in prims]))


def check_nerfstudio(path: Path) -> None:
    data = json.loads(path.read_text())
    assert len(data["frames"]) == 40 and data["fl_x"] == pytest.approx(492.7568, abs=1e-3)
    poses = np.array([f["transform_matrix"] for f in data["frames"]])
    if "applied_transform" in data:
        applied = np.vstack([data["applied_transform"], [0, 0, 0, 1]])
        poses = np.linalg.inv(applied) @ poses
    np.testing.assert_allclose(poses[:, :3, 3], true_centres()[list(SHORT)], atol=1e-5)
    cams = np.linalg.inv(poses @ np.diag([1, -1, -1, 1]))[:, :3]
    np.testing.assert_allclose(cams, true_cameras(SHORT), atol=1e-5)
    image = cv2.imread(str(path.parent / data["frames"][7]["file_path"]))
    video = cv2.VideoCapture(str(ROOM / "room.mp4"))
    true = [video.read()[1] for _ in range(22)][21]
    assert np.abs(image.astype(int) - true).mean() < 6  # JPEG of frame 21, of no neighbour


def check_ply(path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    pieces = trimesh.load(path).split(only_watertight=False)
    goal = np.array([o["center"] for o in true_objects()])
    centres = np.array([piece.bounds.mean(0) for piece in pieces])
    nearest = np.linalg.norm(goal[:, None] - centres, axis=2).min(0)
    assert len(pieces) >= 22 and np.median(nearest) < 0.05


def check_rrd(path: Path) -> None:
    assert path.read_bytes()[:4] in (b"RRF2", b"RRF3") and path.stat().st_size > 1e5


EXPORTED: dict[str, Callable[[Path], None]] = {
    "boxer": check_boxer,
    "coco-vid": check_tracks(boxes_of_coco),
    "csv": check_csv,
    "cvat": check_tracks(boxes_of_cvat),
    "glb": check_glb,
    "kitti": check_tracks(boxes_of_kitti),
    "labelme": check_tracks(boxes_of_labelme),
    "mcap": check_mcap,
    "nerfstudio": check_nerfstudio,
    "ply": check_ply,
    "ros": check_ros,
    "rrd": check_rrd,
    "usd": check_usd,
    "yolo": check_tracks(boxes_of_yolo),
}


@pytest.mark.parametrize("to", rt.EXPORTS)
def test_every_export(out: Path, to: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A new format needs an entry in EXPORTED."""
    if to in ("glb", "mcap", "rrd"):
        pytest.importorskip({"glb": "trimesh", "mcap": "mcap_ros2", "rrd": "rerun"}[to])
    assert cli("export", out, "--to", to) == 0
    path = Path(re.findall(rf"{re.escape(str(out))}\S+", capsys.readouterr().out)[-1])
    EXPORTED[to](path)


# ---- models, --options, --version, --help ----


def printed_by(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Text printed by an information-only command."""
    with pytest.raises(SystemExit) as ended:
        cli(*words)
    found = capsys.readouterr()
    assert not ended.value.code and found.err == ""
    return found.out


def test_all_commands_are_tested_here(capsys: pytest.CaptureFixture[str]) -> None:
    """A new command needs tests here."""
    commands = re.findall(r"^    (\w+) ", printed_by(capsys, "--help"), re.M)
    assert commands == [
        "run", "track", "poses", "objects", "serve", "eval", "export", "map", "models",
    ]  # fmt: skip


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert printed_by(capsys, "--version") == f"reobj_track {version}\n"


def test_models_lists_and_verifies(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("models") == 0
    listed = capsys.readouterr().out
    assert re.search(r"^deimv2-femto +detector .*default", listed, re.M)
    assert "not run here; the layout of its family is verified" in " ".join(listed.split())
    assert re.search(r"^reobj +backbone .*verified", listed, re.M)
    assert cli("models", "reobj") == 0
    assert Path(capsys.readouterr().out.strip()).name == "reobj.onnx"


def test_every_listed_option_can_be_set(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--options` as it is printed, into `--set` as it is read."""
    options = re.findall(r"^(\w+\.\w+=\S*)(?:  |$)", printed_by(capsys, "--options"), re.M)
    assert len(options) > 40 and len({o.split(".")[0] for o in options}) >= 7
    assert cli("objects", room, "--validate", *(w for o in options for w in ("--set", o))) == 0


def test_a_reader_that_stops_early_is_no_error() -> None:
    """`--options | head -1`"""
    command = f"{sys.executable} {ROOT / 'reobj_track.py'} --options | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.stderr == "" and done.stdout


@pytest.mark.parametrize(("platform", "quote"), [("linux", "'"), ("darwin", "'"), ("win32", '"')])
def test_the_command_for_corrections_is_quoted_as_the_shell_wants(
    monkeypatch: pytest.MonkeyPatch, platform: str, quote: str
) -> None:
    """PowerShell and cmd.exe on Windows: only double quotes are quotes in both."""
    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.setattr("sys.argv", ["/my tools/reobj_track.py"])
    expected = f"python {quote}/my tools/reobj_track.py{quote} objects {quote}/a b/out{quote}"
    assert apply_command(Path("/a b/out")) == expected
    monkeypatch.setattr("sys.argv", ["/bin/reobj-track"])
    assert apply_command(Path("/out")) == "reobj-track objects /out"
