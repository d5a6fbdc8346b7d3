"""docs/: tutorials run, the site builds, the reference is complete, links and tables are sound."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs"))

import make_api  # noqa: E402
import make_formats  # noqa: E402

TUTORIALS = ROOT / "docs" / "tutorials"
ROOM = ROOT / "examples" / "room"
FOCAL, CENTRE = 492.756788421, (320.0, 240.0)  # COLMAP's: the first pixel's centre is (.5, .5)


def true_poses() -> np.ndarray:
    """(240, 4, 4) world_from_cam of the example clip."""
    rows = np.loadtxt(ROOM / "poses.txt")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return poses


# ---- The files of a reader of the tutorials ----


def nothing(_: Path) -> None:
    pass


def scannet(folder: Path) -> None:
    """A scene as SensReader writes it, 24 frames; one is lost."""
    scene = folder / "scene0000_00"
    for name in ("color", "pose", "intrinsic"):
        (scene / name).mkdir(parents=True)
    K = np.eye(4)
    K[[0, 1], [0, 1]], K[:2, 2] = FOCAL, np.subtract(CENTRE, 0.5)
    np.savetxt(scene / "intrinsic/intrinsic_color.txt", K)
    poses = true_poses()
    for i, frame in enumerate(rt.Video(ROOM / "room.mp4", rt.InputConfig(every=4, stop=96))):
        cv2.imwrite(str(scene / f"color/{i}.jpg"), frame.image)
        pose = poses[frame.index] if i != 7 else np.full((4, 4), np.inf)
        np.savetxt(scene / f"pose/{i}.txt", pose)


AR_FRAMES = 36


def arkit(folder: Path) -> None:
    """A recording, boxes for it, and the log of an app: world_from_camera in OpenGL axes."""
    video = cv2.VideoWriter(
        str(folder / "recording.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 12, (640, 480)
    )
    for frame in rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=AR_FRAMES)):
        video.write(frame.image)
    video.release()
    with np.load(ROOM / "detections.npz") as file:
        rows = file["frame"] < AR_FRAMES
        given = {k: file[k][rows] for k in ("frame", "xyxy", "score", "class_id")}
        whole = {k: file[k] for k in ("image_size", "class_names")}
        np.savez(folder / "recording.npz", **whole, **given)
    K = np.array([[FOCAL, 0, CENTRE[0] - 0.5], [0, FOCAL, CENTRE[1] - 0.5], [0, 0, 1]])
    lines = [
        json.dumps({"t": i / 12, "transform": (pose @ np.diag([1, -1, -1, 1])).T.ravel().tolist(),
                    "intrinsics": K.T.ravel().tolist()})
        for i, pose in enumerate(true_poses()[:AR_FRAMES])
    ]  # fmt: skip
    (folder / "arkit.jsonl").write_text("\n".join(lines) + "\n")


def objects(out: Path) -> list[dict[str, object]]:
    return json.loads((out / "objects.json").read_text())["objects"]


def located(out: Path) -> list[dict[str, object]]:
    return [o for o in objects(out) if o["status"] in ("ok", "prior_dominated")]


def check_phone(folder: Path) -> None:
    assert len(located(folder / "out")) >= 8
    assert json.loads((folder / "out/objects.json").read_text())["world"]["links"] == []


def check_scannet(folder: Path) -> None:
    data = json.loads((folder / "out/objects.json").read_text())
    assert data["world"]["units"] == "m" and data["world"]["registered_frames"] == 12
    rows = (folder / "boxes.csv").read_text().splitlines()
    assert rows[0].startswith("id,class,") and len(rows) == 1 + len(located(folder / "out"))


def check_ar(folder: Path) -> None:
    """The poses are converted from the phone's axes: the trajectory is the true one."""
    rows, true = np.loadtxt(folder / "poses.txt"), true_poses()[:AR_FRAMES]
    np.testing.assert_allclose(rows[:, 1:4], true[:, :3, 3], atol=1e-6)
    again = np.loadtxt(folder / "out/poses.txt")
    np.testing.assert_allclose(again[:, 1:4], true[::3, :3, 3], atol=1e-6)
    assert sum(o["status"] == "ok" for o in objects(folder / "out")) >= 5
    first, second = (
        set(np.loadtxt(folder / out / "tracks.txt", delimiter=",")[:, 1])
        for out in ("live", "again")
    )
    assert len(first) > 10 and second <= first  # nothing new: the identities were kept


def check_detector(folder: Path) -> None:
    (chair,) = objects(folder / "out_file")
    assert chair["class"] == "chair" and chair["frames_seen"] == 4


def check_training(folder: Path) -> None:
    assert (folder / "trained/reobj.onnx").is_file() and objects(folder / "out")


def check_map(folder: Path) -> None:
    """The page says what the commands say, and what the room's truth is."""
    changes = json.loads((folder / "tuesday/changes.json").read_text())
    (moved,) = changes["moved"]
    before, after = (
        {o["id"]: np.array(o["center"]) for o in json.loads(path.read_text())["objects"]}
        for path in (ROOM / "gt_objects.json", ROOM.with_name("room_later") / "gt_objects.json")
    )
    true = np.linalg.norm(after[6] - before[6])
    assert moved["class"] == "bowl" and abs(moved["distance_m"] - true) < 0.03
    assert f"{true:.3f}"[1:] in (TUTORIALS / "same_room.md").read_text()
    said = rt.Result.load(folder / "tuesday").changes
    page = (TUTORIALS / "same_room.md").read_text()
    shown = re.search(r"^    map flat.map: .*\n(?:      .*\n)*", page, re.M)
    assert said and shown
    assert re.sub(r"[\d.]", "", said.summary()).split() == re.sub(r"[\d.]", "", shown[0]).split()
    assert "fruit bowl" in (folder / "flat.csv").read_text()


Step = Callable[[Path], None]
PAGES: dict[str, tuple[Step, Step]] = {
    "phone_video": (nothing, check_phone),
    "scannet_scene": (scannet, check_scannet),
    "ar_poses": (arkit, check_ar),
    "same_room": (nothing, check_map),
    "own_detector": (nothing, check_detector),
    "training": (nothing, check_training),
}


def blocks(page: Path) -> list[tuple[str, str]]:
    """Fenced blocks of `sh` and `python`, in order."""
    return re.findall(r"^```(sh|python)\n(.*?)^```$", page.read_text(), re.M | re.S)


def need(page: str) -> None:
    """Skip if a requirement of the page is not installed."""
    if page == "scannet_scene":
        try:
            rt.model_path("fast", offline=True)
        except rt.ReobjError as error:
            pytest.skip(f"no weights here: {error}")
    if page == "training":
        pytest.importorskip("torch")
        pytest.importorskip("onnx")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_tutorial(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a reader does: in a checkout, one block after the other; `run` with less input."""
    need(page)
    prepare, check = PAGES[page]
    for path in (*ROOT.glob("*.*"), *(ROOT / n for n in ("benchmarks", "examples", "reobj"))):
        (tmp_path / path.name).symlink_to(path)
    prepare(tmp_path)
    env = os.environ | {"STEPS": "3", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    monkeypatch.chdir(tmp_path)
    for kind, text in blocks(TUTORIALS / f"{page}.md"):
        text = text.replace("\\\n", " ")
        if kind == "sh":
            less = "--set poses.size_px=320" + " --every 2" * ("--every" not in text)
            text = re.sub(r"(reobj_track\.py run .*)", rf"\1 {less}", text)
        lines = text.splitlines()
        commands = [shlex.split(line, comments=True) for line in lines]
        ours = all(c[:2] == ["python", "reobj_track.py"] for c in commands)
        if kind == "sh" and ours and "$(" not in text:
            for command in commands:  # in this process: quicker
                assert rt.main(command[2:]) == 0, command
            continue
        shell = ["bash", "-euo", "pipefail", "-c"] if kind == "sh" else [sys.executable, "-c"]
        done = subprocess.run([*shell, text], cwd=tmp_path, env=env, capture_output=True, text=True)
        said = done.stdout[-2000:] + done.stderr[-3000:]
        assert done.returncode == 0, f"{page}:\n{text}\n{said}"
    check(tmp_path)


# ---- Packaging: neither file is built by the tests ----


PAGES_OF_TEXT = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "benchmarks").glob("*.md")),
]


@pytest.mark.parametrize("page", PAGES_OF_TEXT, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_have_targets(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    local = [t for t in targets if "://" not in t]
    assert [t for t in local if not (page.parent / t).exists()] == []


def test_the_reference_has_all_public_names_and_is_up_to_date() -> None:
    """If this fails: python docs/make_api.py"""
    explained = {"Array", "IntArray", "BoolArray", "__version__"}
    for module in (rt, quadrics):
        names = [n for m, _, group in make_api.groups() if m == module.__name__ for n in group]
        assert sorted(names) == sorted(set(module.__all__) - explained)
    assert make_api.PAGE.read_text() == make_api.repository_page()


def test_the_tables_of_formats_are_those_of_the_registries() -> None:
    """If this fails: python docs/make_formats.py"""
    text = make_formats.PAGE.read_text()
    assert make_formats.filled(text) == text
    assert all(table in text for table in make_formats.TABLES.values())


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Links and anchors lead somewhere, every name of the reference is found.

    Without -q: it hides warnings from --strict too.
    """
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "api/index.html").read_text()
    for text in ('id="reobj_track.Tracker.update"', "Returns:", "Raises:", "BGR image"):
        assert text in page
    assert 'id="reobj_track.Tracker._predict"' not in page
