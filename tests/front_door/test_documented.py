"""Commands and Python code of README and docs/ work as they are written.

Commands are run in a folder with the files that they name, plus options (`more`) that make them
fast.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import truth as scores

import reobj_track as rt
from front_door.room import (
    CAMERA,
    ROOM,
    ROOT,
    SHORTEST,
    SHORTEST_FRAMES,
    assert_right,
    cli,
    info,
    true_cameras,
    true_centres,
    true_objects,
)
from reobj.cli import make_parser

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
    """An output folder of the whole clip with reconstructed cameras."""
    recording(desk)


# ---- Expected results ----

SUPPLIED = f"--poses poses.txt --camera {CAMERA}"
PLAIN = "--set output.overlay=none --set output.scene=0"
SHORT = f"{' '.join(map(str, SHORTEST))} {PLAIN}"


def right(desk: Path, warning: str = "") -> None:
    assert_right(desk / "out", SHORTEST_FRAMES, warning=warning)


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


@dataclass(frozen=True)
class Shown:
    """How a documented command is run.

    Attributes:
        desk: creates its input files. check: checks its results. more: makes it fast.
        swap: for values of placeholders. folder: name of the copy of the example's output
            folder that it needs. code: exit code; says: text printed in that case.
    """

    desk: Callable[[Path], None]
    check: Callable[..., None] = lambda _: None
    more: str = ""
    swap: dict[str, str] = field(default_factory=dict)
    folder: str = ""
    code: int = 0
    says: str = ""
    warning: str = ""


TOOL = "python reobj_track.py "
NAMED = {"OUT": "out"}
SHOWN = {
    TOOL + "run phone.mp4 -o out": Shown(
        recording, more="--offline", code=2, says="set REOBJ_MODELS"
    ),
    TOOL + "run phone.mp4 -o out --detections det.json": Shown(
        recording, right, f"{SHORT} {SUPPLIED}", warning="det.json: images and classes of instan"
    ),
    TOOL + "run phone.mp4 -o out --poses colmap_model/": Shown(
        colmap_model, right, f"--detections det.npz {SHORT} --metric"
    ),
    TOOL + "objects out --known-size chair=0.82m": Shown(output, scaled, PLAIN, folder="out"),
    TOOL + "eval out --gt gt.txt": Shown(output, evaluated, folder="out"),
    TOOL + "export out --to coco-vid": Shown(output, exported, folder="out"),
    TOOL + "eval OUT --gt gt.txt [--gt-objects gt_objects.json] [--classes chair,cup]": Shown(
        output, evaluated_in_3d, "", {"[": "", "]": "", "OUT": "out"}, "out"
    ),
    "python examples/live_ar.py -o OUT": Shown(recording, more="--frames 20", swap=NAMED),
}  # fmt: skip


def test_documented_commands_and_flags_exist() -> None:
    """Commands with placeholders apart."""
    plain = [c for c in DOCUMENTED if c.startswith(TOOL) and not re.search(r"\[|\.\.\.", c)]
    parser = make_parser(rt.run, rt.refit)
    for command in plain:
        words = shlex.split(command)[2:]
        try:
            assert parser.parse_args(words).func is not None
        except SystemExit as ended:
            assert ended.code == 0 or page_of_mistakes(command), command
    assert len(plain) > 30 and set(SHOWN) <= set(DOCUMENTED)


def page_of_mistakes(command: str) -> bool:
    """The first hour shows mistakes and their messages."""
    return DOCUMENTED[command].endswith("first_hour.md")


@pytest.mark.parametrize("command", SHOWN)
def test_documented_command(
    command: str,
    desk: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shown = SHOWN[command]
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
    shown.check(desk, *[shown.warning] * bool(shown.warning))


# ---- Python ----

QUICK = rt.Config(
    input=rt.InputConfig(every=4, stop=64),
    poses=rt.PosesConfig(mode="poses.txt", camera=CAMERA, size_px=160),
    output=rt.OutputConfig(overlay=False, scene=False),
)


def python_of(page: str) -> list[str]:
    """Fenced Python, and indented Python that begins with an import."""
    text = (ROOT / page).read_text()
    fenced = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    indented = re.findall(r"(?:^    import .*\n)(?:^    .*\n)+", text, re.M)
    return fenced + [re.sub(r"^    ", "", block, flags=re.M) for block in indented]


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
