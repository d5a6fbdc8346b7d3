"""Runs the documented commands and Python code of README and docs/, or lists them as not run.

tests/test_docs.py runs the `sh` and `python` blocks of the tutorials. All other commands are run
here as written, in a folder with the files they name, plus options (`more`) that make them fast.
Commands of benchmarks/ take long or need data: their options are compared with --help. A new
command in the docs fails until it is listed here.
"""

from __future__ import annotations

import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import truth as scores
from test_readers import as_3d_scanner_app, as_polycam, as_record3d

import reobj_track as rt
from front_door.room import (
    CAMERA,
    FEW,
    ROOM,
    ROOT,
    SHORTEST,
    SHORTEST_FRAMES,
    SMALL,
    assert_right,
    cli,
    info,
    true_boxes,
    true_cameras,
    true_centres,
    true_objects,
)

PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "benchmarks" / "README.md",
]
PROGRAMS = r"(?:[A-Z_]+=\S+ )?(?:python |reobj-track |pip |mkdocs |git clone|curl |wget )"


def page_name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def commands_of(path: Path) -> list[str]:
    """Commands in blocks that are indented or fenced (not `sh`), and in code within lines."""
    text = path.read_text().replace("\\\n", " ")
    text = re.sub(r"^```(sh|python|py)\n.*?^```$", "", text, flags=re.M | re.S)
    blocks = re.findall(rf"^(?:    )?({PROGRAMS}.*)$", text, re.M)
    inline = re.findall(rf"`({PROGRAMS}[^`]*)`", text)
    return [" ".join(re.sub(r"\s{2,}#.*", "", c).split()) for c in blocks + inline]


DOCUMENTED = {c: page_name(p) for p in reversed(PAGES) for c in reversed(commands_of(p))}

# ---- Not run here, and why ----

ELSEWHERE = {
    "pip install -r requirements.txt -e . && python reobj_track.py run examples/room/room.mp4 "
    "--detections examples/room/detections.npz -o out": "test_commands.py, .ci/run",
    'pip install -e ".[dev]" && python -m pytest': ".ci/run",
    'pip install -e ".[docs]" && mkdocs serve': ".ci/run builds the site",
    "pip install -r requirements.txt -e .": ".ci/run",
    "pip install torch matplotlib onnx": ".ci/run installs them with the extras",
    'pip install -e ".[detectors]"': ".ci/run, on a CPU build of PyTorch",
    "pip install trimesh rerun-sdk": "in the extra dev, which .ci/run installs",
    "pip install jsonschema": "in the extra dev, which .ci/run installs",
    "python -m pytest benchmarks/tests": "it takes minutes",
    "python reobj_track.py --options": "test_commands.py",
    "python reobj_track.py models": "test_commands.py",
    "python reobj_track.py objects out --solver lfd": "test_commands.py, with all solvers",
    "python reobj_track.py objects out --edits edits.json": "below, of OUT",
    "python reobj_track.py serve out": "test_serve.py; it runs until Ctrl-C",
    "python reobj_track.py serve OUT --open": "test_serve.py; it opens a browser",
    "python reobj_track.py run phone.mp4 -o out --map flat.map": "test_map.py",
    "python reobj_track.py run monday.mp4 -o monday --map flat.map": "test_map.py",
    "python reobj_track.py run tuesday.mp4 -o tuesday --map flat.map": "test_map.py",
    "python reobj_track.py run friday.mp4 -o friday --map flat.map --map-frozen": "test_map.py",
    "python reobj_track.py map flat.map": "test_map_command.py",
    "python reobj_track.py map flat.map --forget tuesday.mp4": "test_map_command.py",
    "python reobj_track.py map flat.map --merge 3 12": "test_map_command.py",
    "python reobj_track.py map flat.map --rename 3 armchair": "test_map_command.py",
    "python reobj_track.py map flat.map --delete 7": "test_map_command.py",
    "python reobj_track.py map flat.map --export csv -o flat.csv": "test_map_command.py",
}  # fmt: skip
FIRST_HOUR = ROOT / "docs" / "tutorials" / "first_hour.md"
ELSEWHERE |= {
    c: "below: parsed, or repeated as a mistake; the recordings are those of others"
    for c in commands_of(FIRST_HOUR)
    if c.startswith("python reobj_track.py ") and DOCUMENTED[c] == page_name(FIRST_HOUR)
}


def benchmark_of(command: str) -> str | None:
    """Name the script of benchmarks/ that a command calls."""
    found = re.search(r"python benchmarks/(\w+)\.py", command)
    return found[1] if found else None


# ---- The files of the reader ----


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a reader, in a checkout."""
    for path in (*ROOT.glob("*.*"), *(ROOT / n for n in ("benchmarks", "examples", "reobj"))):
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def recording(desk: Path) -> None:
    """A video, recorded boxes, cameras and the truth."""
    (desk / "phone.mp4").symlink_to(ROOM / "room.mp4")
    (desk / "det.npz").symlink_to(ROOM / "detections.npz")
    with np.load(ROOM / "detections.npz") as file:
        kept = {k: file[k] for k in ("frame", "xyxy", "score", "class_id", "class_names")}
    names = [str(n) for n in kept["class_names"]]
    number = {name: i + 1 for i, name in enumerate(names)}
    boxes = [
        {"image_id": int(f), "category_id": number[names[c]], "score": float(s),
         "bbox": [float(b[0]), float(b[1]), float(b[2] - b[0]), float(b[3] - b[1])]}
        for f, b, s, c in zip(kept["frame"], kept["xyxy"], kept["score"], kept["class_id"],
                              strict=True)
    ]  # fmt: skip
    images = [
        {"id": i, "file_name": f"{i:06d}.jpg", "width": 640, "height": 480} for i in range(240)
    ]
    categories = [{"id": i, "name": name} for name, i in number.items()]
    (desk / "det.json").write_text(json.dumps(boxes))
    (desk / "instances.json").write_text(json.dumps({"images": images, "categories": categories}))
    (desk / "poses.txt").symlink_to(ROOM / "poses.txt")
    (desk / "gt.txt").symlink_to(ROOM / "gt_mot.txt")
    (desk / "gt_objects.json").symlink_to(ROOM / "gt_objects.json")


def colmap_model(desk: Path) -> None:
    """The true cameras of all frames as COLMAP's text model, named as ffmpeg does it, from 0."""
    recording(desk)
    folder = desk / "colmap_model" / "sparse" / "0"
    folder.mkdir(parents=True)
    shutil.copy(ROOM / "camera.txt", folder / "cameras.txt")
    lines = []
    for i, pose in enumerate(true_cameras(range(240))):
        w, x, y, z = quadrics_quaternion(pose[:, :3])
        at = " ".join(repr(float(v)) for v in (w, x, y, z, *pose[:, 3]))
        lines.append(f"{i + 1} {at} 1 {i:06d}.jpg\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


def quadrics_quaternion(turn: np.ndarray) -> np.ndarray:
    """w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(turn).as_quat(), 1)


def output(desk: Path) -> None:
    """An output folder of the whole clip with reconstructed cameras; edits for it."""
    recording(desk)
    rows = np.loadtxt(desk / "out" / "tracks.txt", delimiter=",")
    frame, number, left, top, width, height = rows[0, :6].tolist()
    box = [left, top, left + width, top + height]
    renamed = {"id": int(number), "frame": int(frame) - 1, "box": box}
    edits = [{"do": "rename", "object": renamed, "class": "armchair"}]
    data = {"format": "reobj-edits", "version": 1, "edits": edits}
    (desk / "edits.json").write_text(json.dumps(data))


SIX = range(0, 60, 10)  # frames of the clip that are the pictures of an app's export


def pictures(folder: Path, names: str) -> None:
    """Six frames of the clip as images, boxes for them beside the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(rt.Video(ROOM / "room.mp4", rt.InputConfig(every=10, stop=60))):
        cv2.imwrite(str(folder / names.format(i)), frame.image)
    with np.load(ROOM / "detections.npz") as file:
        rows = np.isin(file["frame"], list(SIX))
        lines = ["frame,x1,y1,x2,y2,score,class"]
        for f, b, s, c in zip(*(file[k][rows] for k in ("frame", "xyxy", "score", "class_id")),
                              strict=True):  # fmt: skip
            box = ",".join(map(str, b.tolist()))
            lines.append(f"{f // 10},{box},{s},{file['class_names'][c]}")
    Path("six.csv").write_text("\n".join(lines) + "\n")


def record3d(desk: Path) -> None:
    pictures(desk / "recording" / "rgbd", "{}.jpg")
    as_record3d(desk / "recording", true_cameras(SIX))


def polycam(desk: Path) -> None:
    pictures(desk / "export" / "keyframes" / "corrected_images", "{:04d}.jpg")
    (desk / "export").mkdir(exist_ok=True)
    shutil.rmtree(desk / "export/keyframes/corrected_cameras", ignore_errors=True)
    aside = desk / "aside"
    aside.mkdir()
    as_polycam(aside, true_cameras(SIX))
    shutil.move(aside / "keyframes/corrected_cameras", desk / "export/keyframes")


def scanner_app(desk: Path) -> None:
    pictures(desk / "export", "frame_{:05d}.jpg")
    as_3d_scanner_app(desk / "export", true_cameras(SIX))


def mine(desk: Path) -> None:
    """A custom detector with its class names."""
    recording(desk)
    (desk / "mine.onnx").symlink_to(weights("deimv2-femto"))
    (desk / "names.txt").write_text("\n".join(rt.COCO_NAMES) + "\n")


def weights(name: str) -> Path:
    try:
        return Path(rt.model_path(name, offline=True))
    except rt.ReobjError as error:
        pytest.skip(f"no weights here: {error}")


# ---- Expected results ----

SUPPLIED = f"--poses poses.txt --camera {CAMERA}"
QUICKLY = " ".join(SMALL)
PLAIN = "--set output.overlay=none --set output.scene=0"
LONG = f"{' '.join(map(str, FEW))} {PLAIN}"
SHORT = f"{' '.join(map(str, SHORTEST))} {PLAIN}"


def right(desk: Path) -> None:
    assert_right(desk / "out", SHORTEST_FRAMES)


def right_with_dataset(desk: Path) -> None:
    used = "det.json: images and classes of instances.json"
    assert_right(desk / "out", SHORTEST_FRAMES, warning=used)


def right_identities(desk: Path) -> None:
    assert_right(desk / "out", hit_rate=0, idf1=0.94)


def right_without_images(desk: Path) -> None:
    assert_right(desk / "out", idf1=0.94, warning="note: no images")


def detected(desk: Path, idf1: float = 0.45, share: float = 0.4) -> None:
    """The default detector finds half of the rendered furniture."""
    found = scores.Output.read(desk / "out")
    score = scores.score_2d(true_boxes().of_frames(range(0, 120, 6)), found)
    assert score.idf1 > idf1 and score.found >= share * score.true, score


def detected_fast(desk: Path) -> None:
    """The smallest detector finds a third of it."""
    detected(desk, 0.4, 0.3)


def scaled(desk: Path) -> None:
    """The scale follows the chairs, whose heights come out 2 to 10 % too small."""
    scale = info(desk / "out")["world"]["scale"]
    ours = scores.Output.read(desk / "out").centres
    points = np.array([ours[f] for f in range(240)])
    goal, *_ = scores.similarity(points, true_centres())
    height = np.mean([o["size_m"][2] for o in true_objects() if o["class"] == "chair"])
    assert scale["source"] == "known_size"
    error = abs(np.log(scale["metres_per_unit"] / goal * height / 0.82))
    assert error < min(0.08, 3 * scale["rel_sigma"]) and scale["rel_sigma"] < 0.06


def evaluated(desk: Path) -> None:
    found = json.loads((desk / "out/eval.json").read_text())
    assert found["tracks"]["all"]["IDF1"] > 0.97


def evaluated_in_3d(desk: Path) -> None:
    found = json.loads((desk / "out/eval.json").read_text())
    assert set(found["tracks"]) - {"all"} == {"chair", "cup"}
    assert found["tracks"]["all"]["IDF1"] > 0.97 and found["objects"]["found"] >= 9


def exported(desk: Path) -> None:
    data = json.loads((desk / "out/coco_vid.json").read_text())
    assert len(data["annotations"]) == len((desk / "out/tracks.txt").read_text().splitlines())


def located(desk: Path) -> None:
    """Reconstructed cameras are right up to a similarity."""
    rows = np.loadtxt(desk / "out/poses.txt")
    true = true_centres()[np.round(rows[:, 0] * 12).astype(int)]
    scale, turn, shift = scores.similarity(rows[:, 1:4], true)
    error = np.linalg.norm(scale * rows[:, 1:4] @ turn.T + shift - true, axis=1)
    assert len(rows) >= 20 and np.median(error) < 0.01 * np.linalg.norm(np.ptp(true, axis=0))


def posed(desk: Path) -> None:
    """Every image has its camera, and the objects have the right identities."""
    rows = np.loadtxt(desk / "out/poses.txt")
    np.testing.assert_allclose(rows[:, 1:4], true_centres()[list(SIX)], atol=1e-5)
    truth = true_boxes().of_frames(SIX)
    frame = truth.frame // 10
    found = scores.Output.read(desk / "out")
    moved = scores.Truth(frame, truth.identity, truth.xyxy, truth.clear, truth.kinds)
    assert scores.score_2d(moved, found).idf1 > 0.8
    assert info(desk / "out")["world"]["units"] == "m"


def renamed(desk: Path) -> None:
    classes = [o["class"] for o in info(desk / "out")["objects"]]
    assert classes.count("armchair") == 1


def nothing(_: Path) -> None:
    """Only the exit code is checked: the example has no errors to draw."""


@dataclass(frozen=True)
class Shown:
    """How a documented command is run.

    Attributes:
        desk: creates its input files. check: checks its results. more: arguments that make it fast.
        swap: for values of placeholders. folder: name of the copy of the example's output
            folder that it needs. code: exit code; says: text printed in that case.
    """

    desk: Callable[[Path], None]
    check: Callable[[Path], None]
    more: str = ""
    swap: dict[str, str] = field(default_factory=dict)
    folder: str = ""
    code: int = 0
    says: str = ""


TOOL = "python reobj_track.py "
NAMED = {"VIDEO": "phone.mp4", "OUT": "out"}
FIRST = f"--every 4 --stop 80 {QUICKLY}"
SHOWN = {
    TOOL + "run phone.mp4 -o out": Shown(
        recording, nothing, "--offline", code=2, says="--detector fast"
    ),
    TOOL + "run phone.mp4 -o out --detector fast": Shown(
        recording, detected_fast, f"--every 6 --stop 120 {SUPPLIED} {QUICKLY} {PLAIN}"
    ),
    TOOL + "run phone.mp4 -o out --detections det.json": Shown(
        recording, right_with_dataset, f"{SHORT} {SUPPLIED}"
    ),
    TOOL + "run phone.mp4 -o out --poses colmap_model/": Shown(
        colmap_model, right, f"--detections det.npz {SHORT} --metric"
    ),
    TOOL + "track phone.mp4 -o out": Shown(
        recording, right_identities, f"--detections det.npz {LONG}"
    ),
    TOOL + "objects out --known-size chair=0.82m": Shown(output, scaled, PLAIN, folder="out"),
    TOOL + "eval out --gt gt.txt": Shown(output, evaluated, folder="out"),
    TOOL + "export out --to coco-vid": Shown(output, exported, folder="out"),
    TOOL + "poses VIDEO -o OUT": Shown(recording, located, FIRST, NAMED),
    TOOL + "poses VIDEO -o OUT --camera fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]": Shown(
        recording, located, f"--every 3 --stop 60 {QUICKLY}",
        NAMED | {"fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]": CAMERA},
    ),
    TOOL + "run VIDEO -o OUT --poses PATH": Shown(
        recording, right, f"--detections det.npz {SHORT} --camera {CAMERA}",
        NAMED | {"PATH": "poses.txt"},
    ),
    TOOL + 'run -o OUT --detections FILE --poses FILE --camera "MODEL WIDTH HEIGHT PARAMS"': Shown(
        recording, right_without_images, LONG,
        {"OUT": "out", "--detections FILE": "--detections det.npz",
         "--poses FILE": "--poses poses.txt",
         "MODEL WIDTH HEIGHT PARAMS": "PINHOLE 640 480 " + CAMERA.replace(",", " ")},
    ),
    TOOL + "objects OUT --edits edits.json": Shown(output, renamed, PLAIN, NAMED, "out"),
    TOOL + "eval OUT --gt gt.txt [--gt-objects gt_objects.json] [--classes chair,cup]": Shown(
        output, evaluated_in_3d, "", {"[": "", "]": "", "OUT": "out"}, "out"
    ),
    TOOL + "run recording/rgbd --poses recording/metadata -o out": Shown(
        record3d, posed, f"--detections six.csv {QUICKLY} {PLAIN}"
    ),
    TOOL + "run export/keyframes/corrected_images --poses export -o out": Shown(
        polycam, posed, f"--detections six.csv {QUICKLY} {PLAIN}"
    ),
    TOOL + 'run "export/frame_*.jpg" --poses export -o out': Shown(
        scanner_app, posed, f"--detections six.csv {QUICKLY} {PLAIN}"
    ),
    TOOL + "run phone.mp4 -o out --detector mine.onnx --set detect.class_names=names.txt": Shown(
        mine, detected, f"--every 6 --stop 120 {SUPPLIED} {QUICKLY} {PLAIN}"
    ),
    "python benchmarks/failure_gallery.py OUT... --gt gt.txt... -o gallery.jpg": Shown(
        output, nothing, "", {"OUT...": "out", "gt.txt...": "gt.txt"}, "out"
    ),
    "python examples/live_ar.py -o OUT": Shown(recording, nothing, "--frames 20", NAMED),
}  # fmt: skip


def test_every_command_in_the_docs_is_run_or_has_a_reason() -> None:
    """Fails for a new command and for an entry without a command."""
    known = {*ELSEWHERE, *SHOWN}
    unknown = {c: p for c, p in DOCUMENTED.items() if c not in known and not benchmark_of(c)}
    assert unknown == {}, "run them in SHOWN, or list them in ELSEWHERE"
    assert known - set(DOCUMENTED) == set()
    assert {b for c in DOCUMENTED if (b := benchmark_of(c))} <= set(SCRIPTS)


def test_the_list_of_benchmarks_is_complete() -> None:
    listed = {benchmark_of(c) for c in commands_of(ROOT / "benchmarks" / "README.md")}
    assert listed - {None} == {n for n, p in SCRIPTS.items() if p.parent.name == "benchmarks"}


def all_documented() -> list[tuple[str, str]]:
    results = [p for p in [ROOT / "benchmarks" / "RESULTS.md"] if p.exists()]
    return [(c, page_name(p)) for p in [*PAGES, *results] for c in commands_of(p)]


SCRIPTS = {
    path.stem: path
    for folder in ("examples", "benchmarks")
    for path in sorted((ROOT / folder).glob("*.py"))
    if "__main__" in path.read_text()
}


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_prints_its_usage(
    script: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its help lists the flags that the docs use."""
    path = SCRIPTS[script]
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    monkeypatch.syspath_prepend(path.parent)
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    if "needs PyTorch" in str(ended.value.code) and find_spec("torch") is None:
        pytest.skip("PyTorch is not installed")
    assert ended.value.code in (0, None)
    said = capsys.readouterr().out
    assert said.startswith("usage:") and f"{script}.py" in said
    listed = set(re.findall(r"--[\w-]+", said))
    for command, page in all_documented():
        if benchmark_of(command) == script:
            flags = set(re.findall(r"(?<=\s)\[?(--[\w-]+)", command))
            assert flags <= listed, f"{page}: {command}"


def test_extras_that_the_docs_name_exist() -> None:
    text = "\n".join(p.read_text() for p in PAGES)
    extras = set(re.findall(r"(?:reobj-track|\")\.?\[([\w,]+)\]", text))
    section = (ROOT / "pyproject.toml").read_text().split("[project.optional-dependencies]")[1]
    known = set(re.findall(r"^(\w+) = \[", section.split("\n[")[0], re.M))
    assert extras and {e for names in extras for e in names.split(",")} <= known


@pytest.mark.parametrize("command", SHOWN)
def test_documented_command(
    command: str,
    desk: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shown = SHOWN[command]
    if "--detector fast" in command:
        weights("fast")
    if shown.code:
        monkeypatch.setenv("REOBJ_MODELS", str(desk / "nowhere"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(desk / "nowhere"))
    if shown.folder:
        shutil.copytree(request.getfixturevalue("example"), desk / shown.folder)
    shown.desk(desk)
    words = command
    for old, new in shown.swap.items():
        words = words.replace(old, new)
    python, script, *args = shlex.split(f"{words} {shown.more}")
    assert python == "python"
    if script == "reobj_track.py":
        assert cli(*args) == shown.code
    else:
        subprocess.run([sys.executable, script, *args], check=True, capture_output=True)
    said = capsys.readouterr()
    if shown.says:
        assert shown.says in said.err and len(said.err.strip().splitlines()) == 1
    shown.check(desk)


# ---- A first hour: recordings of others ----


def said_in_the_first_hour() -> list[tuple[str, str]]:
    """Commands of the page, with the error below each; "": it has results."""
    lines = FIRST_HOUR.read_text().splitlines()
    pairs = zip(lines, [*lines[1:], ""], strict=True)
    return [(a, b * b.startswith("error: ")) for a, b in pairs if a.startswith(TOOL)]


def test_commands_of_the_first_hour_are_valid() -> None:
    commands = [c for c, error in said_in_the_first_hour() if not error]
    assert len(commands) >= 10
    for command in commands:
        assert rt._parser().parse_args(shlex.split(command)[2:]).func is not None, command


def run_in_process(words: list[str]) -> object:
    """The exit code, also of invalid arguments."""
    try:
        return cli(*words)
    except SystemExit as ended:
        return ended.code


def test_mistakes_of_the_first_hour(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each has the message that the page shows, and leaves nothing behind."""
    weights("deimv2-femto")
    recording(desk)
    for name in ("apple.mp4", "monday.mp4"):
        (desk / name).symlink_to(ROOM / "room.mp4")
    shutil.copy(ROOM / "gt_mot.txt", desk / "livingroom_gt.txt")
    matrices = np.tile(np.eye(4).ravel(), (240, 1))
    matrices[:, 3] = 0.01 * np.arange(240)
    np.savetxt(desk / "monday_poses.txt", matrices)
    (desk / "poses.txt").unlink()
    (desk / "livingroom").mkdir()
    before = sorted(desk.iterdir())
    mistakes = [(c, error) for c, error in said_in_the_first_hour() if error]
    assert len(mistakes) >= 10
    for command, error in mistakes:
        capsys.readouterr()
        done = run_in_process(shlex.split(command)[2:])
        said = capsys.readouterr()
        program = re.sub(
            r"\(see .*?(?= run --help| --help)", "(see python reobj_track.py", said.err
        )
        assert (done, said.out, program) == (2, "", f"{error}\n"), command
        assert sorted(desk.iterdir()) == before, command


# ---- Python outside the tutorials ----

QUICK = rt.Config(
    input=rt.InputConfig(every=4, stop=64),
    poses=rt.PosesConfig(mode="poses.txt", camera=CAMERA, size_px=160),
    output=rt.OutputConfig(overlay="none", scene=False),
)


def python_of(page: str) -> list[str]:
    """Fenced Python, and indented Python that begins with an import."""
    text = (ROOT / page).read_text()
    fenced = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    indented = re.findall(r"(?:^    import .*\n)(?:^    .*\n)+", text, re.M)
    return fenced + [re.sub(r"^    ", "", block, flags=re.M) for block in indented]


def test_python_code_is_in_the_listed_documents() -> None:
    pages = {page_name(p) for p in PAGES if p.parent.name != "tutorials"}
    assert {p for p in pages if python_of(p)} == {"README.md", "docs/quadrics.md"}
    assert [len(python_of(p)) for p in ("README.md", "docs/quadrics.md")] == [1, 1]


def test_python_in_readme(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording(desk)
    (code,) = python_of("README.md")
    for old, new in (
        ('rt.track("phone.mp4", detector)', 'rt.track(rt.Video("phone.mp4", FEW), detector)'),
        ('rt.run("phone.mp4", "out")', 'rt.run("phone.mp4", "out", QUICK, detections="det.npz")'),
    ):
        assert old in code
        code = code.replace(old, new)
    scope: dict[str, Any] = {"FEW": QUICK.input, "QUICK": QUICK, "detector": "det.npz"}
    exec(compile(code, "README.md", "exec"), scope)
    assert_right(desk / "out", SHORTEST_FRAMES)
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.split()[0].isdigit() for line in lines) >= 16 + 14
    assert len(scope["result"].objects) == len(info(desk / "out")["objects"])


def test_python_in_quadrics(desk: Path) -> None:
    """Fits a chair and a cup of the clip to unoccluded true boxes with true cameras."""
    (code,) = python_of("docs/quadrics.md")
    truth, frames = true_boxes(min_visible=0.95), range(0, 240, 2)
    views = {o["id"]: (truth.clear & (truth.identity == o["id"])).sum() for o in true_objects()}
    chosen = [
        max((o for o in true_objects() if o["class"] == c), key=lambda o: int(views[o["id"]]))
        for c in ("chair", "cup")
    ]
    boxes = np.full((len(frames), 2, 4), np.nan)
    for k, o in enumerate(chosen):
        rows = truth.clear & (truth.identity == o["id"]) & np.isin(truth.frame, list(frames))
        boxes[truth.frame[rows] // 2, k] = truth.xyxy[rows]
    fx, fy, cx, cy = map(float, CAMERA.split(","))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    scope: dict[str, Any] = {
        "boxes_xyxy": boxes, "img_from_world": K @ true_cameras(frames), "width": 640,
        "height": 480,
    }  # fmt: skip
    exec(compile(code, "quadrics.md", "exec"), scope)
    fits = scope["fits"]
    goal = np.array([o["center"] for o in chosen])
    assert np.linalg.norm(fits.ellipsoids.center_in_world - goal, axis=1).max() < 0.06
    assert list(fits.status) == ["ok", "ok"]
