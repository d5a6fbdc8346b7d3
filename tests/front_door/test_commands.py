"""Every command, solver, exporter and format of poses, as a user calls them, against the truth."""

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
    assert_right,
    cli,
    film_frames,
    idf1_of_rows,
    info,
    true_boxes,
    true_centres,
    true_objects,
)

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
    assert_right(example, range(240), own_cameras=True, idf1=0.98, centre_m=0.04, share=0.94)
    names = {path.name for path in example.iterdir()}
    assert names - {"overlay.mp4", "overlay.webm", "eval.json"} == FILES
    assert film_frames(example) == 240
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
    assert_right(out, share=0, idf1=0.94)
    assert film_frames(out) == 40
    said = capsys.readouterr()
    assert said.err.strip() == "" and "distinct objects:" in said.out


def test_run_without_images(tmp_path: Path) -> None:
    out, words = tmp_path / "out", ("--camera", (ROOM / "camera.txt").read_text())
    assert cli("run", "-o", out, *DETECTIONS, *POSES[:2], *words, *FEW) == 0
    assert_right(out, idf1=0.94)


def test_poses_of_its_own(tmp_path: Path) -> None:
    assert cli("poses", ROOM / "room.mp4", "-o", tmp_path, "--every", 4, "--stop", 80) == 0
    rows = np.loadtxt(tmp_path / "poses.txt")
    frames = np.round(rows[:, 0] * 12).astype(int)
    assert frames.tolist() == list(range(0, 80, 4))
    true = true_centres()[frames]
    scale, turn, shift = scores.similarity(rows[:, 1:4], true)
    error = np.linalg.norm(scale * rows[:, 1:4] @ turn.T + shift - true, axis=1)
    assert np.median(error) < 0.01 * np.linalg.norm(np.ptp(true, axis=0))


PICTURES = tuple(range(0, 60, 10))  # frames of the clip that are the images 0000.jpg ... 0005.jpg


def true_cameras(frames: tuple[int, ...] = PICTURES) -> np.ndarray:
    """(F, 3, 4) cam_from_world."""
    rows = np.loadtxt(ROOM / "poses.txt")[list(frames)]
    turn = Rotation.from_quat(rows[:, 4:]).inv().as_matrix()
    return np.concatenate([turn, -turn @ rows[:, 1:4, None]], 2)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images of the clip, a quarter of its size."""
    folder = tmp_path_factory.mktemp("pictures")
    film = rt.Video(ROOM / "room.mp4", rt.InputConfig(every=10, stop=60))
    for i, frame in enumerate(film):
        cv2.imwrite(str(folder / f"{i:04d}.jpg"), cv2.resize(frame.image, (160, 120)))
    return folder


@pytest.mark.parametrize("write", [row[0] for row in FORMATS], ids=lambda w: w.__name__)
def test_poses_in_every_format(
    pictures: Path, tmp_path: Path, write: Callable[[Path, np.ndarray], Path]
) -> None:
    """The cameras of every image come out where the file has them."""
    path, out = write(tmp_path, true_cameras()), tmp_path / "out"
    camera = ",".join(str(float(v) / 4) for v in CAMERA.split(","))
    assert cli("poses", pictures, "-o", out, "--poses", path, "--camera", camera) == 0
    rows = np.loadtxt(out / "poses.txt")
    np.testing.assert_allclose(rows[:, 0], np.arange(6) / 30, atol=1e-6)
    np.testing.assert_allclose(rows[:, 1:4], true_centres()[list(PICTURES)], atol=1e-5)
    turn = Rotation.from_quat(rows[:, 4:]).inv().as_matrix()
    np.testing.assert_allclose(turn, true_cameras()[:, :, :3], atol=1e-5)


# ---- objects ----


@pytest.mark.parametrize(
    ("solver", "centre_m", "size", "share"),
    [("solids", 0.03, 0.1, 0.9), ("lfd", 0.1, 0.4, 0.7), ("sfmo", 0.3, 0.7, 0.2),
     ("psfmo", 0.3, 0.7, 0.2)],
)  # fmt: skip
def test_every_solver(out: Path, solver: str, centre_m: float, size: float, share: float) -> None:
    pictures = ("--set", "output.overlay=solids", "--set", "output.scene=1")
    assert cli("objects", out, "--solver", solver, *pictures) == 0
    assert_right(out, centre_m=centre_m, size=size, share=share)
    assert film_frames(out) == 40 and (out / "scene.html").stat().st_size > 1e6
    assert (out / "objects.ply").stat().st_size > 1e4


@pytest.mark.parametrize("support", ["box", "cylinder", "ellipsoid"])
def test_every_support(out: Path, support: str) -> None:
    assert cli("objects", out, "--support", support) == 0
    kinds = {o["support"] for o in info(out)["objects"] if o["center"]}
    assert kinds == {support}
    assert_right(out, centre_m=0.06, size=0.2)


def test_objects_with_a_known_size(example: Path, tmp_path: Path) -> None:
    """The chairs of the clip are .85 to .89 m high; the scale follows."""
    out = tmp_path / "out"
    shutil.copytree(example, out)
    true = [o["size_m"][2] for o in true_objects() if o["class"] == "chair"]
    off = ("--set", "output.overlay=none", "--set", "output.scene=0")
    assert cli("objects", out, "--known-size", f"chair={np.mean(true):.3f}m", *off) == 0
    scale = info(out)["world"]["scale"]
    ours = scores.Output.read(out).centres
    goal, *_ = scores.similarity(np.array([ours[f] for f in range(240)]), true_centres())
    assert scale["source"] == "known_size"
    assert abs(scale["metres_per_unit"] / goal - 1) < 0.03


def test_objects_obeys_edits_and_validates(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = np.loadtxt(out / "tracks.txt", delimiter=",")
    frame, number, left, top, width, height = rows[0, :6].tolist()
    name = {"id": int(number), "frame": int(frame) - 1}
    name["box"] = [left, top, left + width, top + height]
    edits = [{"do": "rename", "object": name, "class": "armchair"}]
    path = tmp_path / "edits.json"
    path.write_text(json.dumps({"format": "reobj-edits", "version": 1, "edits": edits}))
    assert cli("objects", out, "--edits", path) == 0
    classes = {o["id"]: o["class"] for o in info(out)["objects"]}
    assert [i for i, c in classes.items() if c == "armchair"] == [int(number)]
    capsys.readouterr()
    assert cli("objects", out, "--validate") == 0
    assert capsys.readouterr().out == "valid\n"


# ---- eval ----


def evaluated(out: Path, *args: object) -> dict[str, Any]:
    path = out if out.is_dir() else out.parent
    assert cli("eval", out, "--gt", ROOM / "gt_mot.txt", *args) == 0
    found: dict[str, Any] = json.loads((path / "eval.json").read_text())
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


def test_eval_sees_what_is_wrong(out: Path) -> None:
    """Two chairs that change their numbers half way; boxes one frame late."""
    whole = evaluated(out)["tracks"]["all"]
    path = out / "tracks.txt"
    lines = path.read_text().splitlines()
    rows = np.loadtxt(lines, delimiter=",")
    chairs = [o["id"] for o in info(out)["objects"] if o["class"] == "chair"][:2]
    late = rows[:, 0] > 60
    swapped = [
        re.sub(r"^(\d+),\d+", rf"\1,{chairs[1 - chairs.index(int(r[1]))]}", line)
        if is_late and int(r[1]) in chairs
        else line
        for line, r, is_late in zip(lines, rows, late, strict=True)
    ]
    path.write_text("\n".join(swapped) + "\n")
    names = {o["id"]: o["class"] for o in info(out)["objects"]}
    xyxy = np.hstack([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]])
    own = np.column_stack([rows[:, 0] - 1, [float(s.split(",")[1]) for s in swapped], xyxy])
    expected = idf1_of_rows(own, names, SHORT)
    found = evaluated(path)["tracks"]["all"]
    assert found["IDSW"] == 2 and whole["IDSW"] == 0
    assert found["IDF1"] < whole["IDF1"] - 0.02
    assert found["IDF1"] == pytest.approx(expected, abs=1e-6)


def test_eval_of_some_classes(out: Path) -> None:
    found = evaluated(out, "--classes", "chair,cup", "--min-visibility", 0.5)["tracks"]
    assert set(found) - {"all"} == {"chair", "cup"}
    assert found["all"]["IDF1"] > 0.97


# ---- export ----


def boxes_of_cvat(path: Path) -> tuple[list[list[float]], dict[int, str]]:
    rows, names = [], {}
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
        assert idf1_of_rows(np.array(rows), names, SHORT) > 0.97

    return check


def near_true(names: list[str], centres: np.ndarray, limit_m: float = 0.15) -> None:
    """Nearly all solids lie at a true object of their class; the median is near."""
    true = true_objects()
    goal = np.array([o["center"] for o in true])
    same = np.array([o["class"] for o in true])[:, None] == np.array(names)
    nearest = np.where(same, np.linalg.norm(goal[:, None] - centres, axis=2), np.inf).min(0)
    assert len(names) >= 22 and np.median(nearest) < 0.05
    assert (nearest < limit_m).mean() > 0.85, nearest


def check_csv(path: Path) -> None:
    with path.open() as file:
        rows = [r for r in csv.DictReader(file) if r["status"] in ("ok", "prior_dominated")]
    column = [k for k in rows[0] if re.search("center|centre", k)]
    near_true([r["class"] for r in rows], np.array([[float(r[k]) for k in column] for r in rows]))


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


def check_nerfstudio(path: Path) -> None:
    data = json.loads(path.read_text())
    assert len(data["frames"]) == 40 and data["fl_x"] == pytest.approx(492.7568, abs=1e-3)
    poses = np.array([f["transform_matrix"] for f in data["frames"]])
    if "applied_transform" in data:
        applied = np.vstack([data["applied_transform"], [0, 0, 0, 1]])
        poses = np.linalg.inv(applied) @ poses
    np.testing.assert_allclose(poses[:, :3, 3], true_centres()[list(SHORT)], atol=1e-5)
    cams = np.linalg.inv(poses @ np.diag([1, -1, -1, 1]))[:, :3]
    np.testing.assert_allclose(cams, true_cameras(tuple(SHORT)), atol=1e-5)
    image = cv2.imread(str(path.parent / data["frames"][7]["file_path"]))
    film = cv2.VideoCapture(str(ROOM / "room.mp4"))
    true = [film.read()[1] for _ in range(22)][21]
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
    "coco-vid": check_tracks(boxes_of_coco),
    "csv": check_csv,
    "cvat": check_tracks(boxes_of_cvat),
    "glb": check_glb,
    "nerfstudio": check_nerfstudio,
    "ply": check_ply,
    "rrd": check_rrd,
}


@pytest.mark.parametrize("to", rt.EXPORTS)
def test_every_export(out: Path, to: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A new format needs an entry in EXPORTED."""
    if to in ("glb", "rrd"):
        pytest.importorskip({"glb": "trimesh", "rrd": "rerun"}[to])
    assert cli("export", out, "--to", to) == 0
    path = Path(re.findall(rf"{re.escape(str(out))}\S+", capsys.readouterr().out)[-1])
    EXPORTED[to](path)


# ---- models, --options, --version, --completion, --help ----


def said(*words: str) -> str:
    done = subprocess.run(
        [sys.executable, ROOT / "reobj_track.py", *words], capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stderr == ""
    return done.stdout


def test_there_are_no_other_commands() -> None:
    """A new one needs tests here."""
    commands = re.findall(r"^    (\w+) ", said("--help"), re.M)
    assert commands == ["run", "track", "poses", "objects", "eval", "export", "models"]


def test_version_is_that_of_the_package() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert said("--version") == f"reobj_track {version}\n"


def test_models_lists_and_verifies(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("models") == 0
    listed = capsys.readouterr().out
    assert re.search(r"^deimv2-n +detector .*default", listed, re.M)
    assert cli("models", "reobj") == 0
    assert "verified" in capsys.readouterr().out


def test_every_listed_option_can_be_set(room: Path) -> None:
    """`--options` as it is printed, into `--set` as it is read: the defaults change nothing."""
    options = re.findall(r"^(\w+\.\w+)\s*=\s*(.*?)(?:\s+#.*|\s{2,}.*)?$", said("--options"), re.M)
    assert len(options) > 60
    words = [f"{name}={value.strip()}" for name, value in options]
    own = [w for w in words if w.startswith(("objects.", "output."))]
    assert own
    parsed = [word for w in own for word in ("--set", w)]
    assert cli("objects", room, "--validate", *parsed) == 0


def test_a_reader_that_stops_early_is_no_fault() -> None:
    """`--options | head -1`"""
    command = f"{sys.executable} {ROOT / 'reobj_track.py'} --options | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.stderr == "" and done.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_is_a_script_of_that_shell(shell: str) -> None:
    pytest.importorskip("shtab")
    script = said("--completion", shell)
    if path := shutil.which(shell):
        subprocess.run([path, "-n"], input=script, text=True, check=True)
    assert "--detections" in script and "reobj-track" in script
