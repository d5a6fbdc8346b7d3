"""ONNX models as users bring them: layouts of the outputs, class names; names in any language."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import small_models

import reobj_track as rt

ROOT = Path(rt.__file__).resolve().parent
SIDE = 128  # px of the networks' input; 1.25 px of the video each
CELLS = 16 * 16 + 8 * 8 + 4 * 4  # of 8, 16, 32 px
NAMES = "{0: 'mug', 1: 'lamp', 2: 'box'}"
QUICK = ("--embed", "none", "--set", "output.overlay=none", "--set", "output.scene=false")
UPRIGHT = (55, 47.5, 105, 72.5)  # of (64, 64, 40, 20) in the network


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Six images of 160 x 120."""
    (tmp_path / "images").mkdir()
    for index in range(6):
        cv2.imwrite(str(tmp_path / f"images/{index}.png"), np.zeros((120, 160, 3), np.uint8))
    return tmp_path / "images"


def values(count: int, box: tuple[int, ...] = (64, 64, 40, 20), at: int = 5) -> Any:
    """Columns of all cells, (1, count, cells): a box in one of them, whose value `at` is .9."""
    made = np.zeros((1, count, CELLS), np.float32)
    made[0, :2] = np.linspace(0, SIDE, CELLS)
    made[0, 2:4] = 8
    made[0, :4, 50] = box
    made[0, at, 50] = 0.9
    return made


def write_model(path: Path, output: Any, name: str = "o", **metadata: str) -> Path:
    return small_models.write_model(path, {name: output}, (1, 3, SIDE, SIDE), **metadata)


@pytest.fixture
def detect(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[list[Any], str]]:
    """Track with a model; the first box with its class ([]: exit code 2), and what was said."""

    def run(model: Path, *more: str) -> tuple[list[Any], str]:
        out = tmp_path / "out"
        words = ["track", str(clip), "-o", str(out), "--overwrite", "--detector", str(model)]
        code = rt.main([*words, *QUICK, *more])
        said = capsys.readouterr().err
        if code:
            assert code == 2 and said.count("\n") == 1, said
            return [], said
        x, y, w, h = np.loadtxt(out / "tracks.txt", delimiter=",")[0, 2:6]
        (found,) = json.loads((out / "objects.json").read_text(encoding="utf-8"))["objects"]
        return [found["class"], *np.round([x, y, x + w, y + h], 1).tolist()], said

    return run


def rotated(degrees: float) -> Any:
    """A box of 80 x 20; other cells have any angle, as those of a real model."""
    made = values(4 + 3 + 1, (64, 64, 80, 20))
    made[0, 7] = np.linspace(-0.78, 2.3, CELLS)
    made[0, 7, 50] = np.deg2rad(degrees)
    return made


def pose(points: int, dimensions: int) -> Any:
    made = values(5 + points * dimensions, at=4)
    made[0, 5:] = np.linspace(0, SIDE, CELLS)
    return made


def yolov5() -> Any:
    made = np.concatenate([values(4, at=3), np.ones((1, 1, CELLS)), values(7)[:, 4:]], 1)
    made[0, 3, 50] = 20
    return np.ascontiguousarray(made.swapaxes(1, 2), np.float32)


MODELS = {  # output, its name, metadata; layout, class and box
    "rotated": (rotated(45), "o", {"names": NAMES, "task": "obb"}, "yolo-obb", "lamp",
                (35.8, 15.8, 124.2, 104.2)),
    "rotated by 120 degrees": (rotated(120), "o", {"names": NAMES, "task": "obb"}, "yolo-obb",
                               "lamp", (44.2, 10.4, 115.8, 109.6)),
    "pose": (pose(17, 3), "o", {"names": "{0: 'person'}", "task": "pose", "kpt_shape": "[17, 3]"},
             "yolo-pose", "person", UPRIGHT),
    "pose in 2D": (pose(21, 2), "o", {"names": "['hand']", "task": "pose", "kpt_shape": "[21, 2]"},
                   "yolo-pose", "hand", UPRIGHT),
    "YOLOX, decoded": (yolov5(), "output", {"names": NAMES}, "yolox", "lamp",
                       (55, 67.5, 105, 92.5)),  # the image is at the top
}  # fmt: skip


@pytest.mark.parametrize("kind", MODELS)
def test_the_layout_of_a_model(kind: str, tmp_path: Path, detect: Any) -> None:
    """It agrees with the number of names and the task; one line says which it is."""
    output, name, metadata, layout, class_name, box = MODELS[kind]
    found, said = detect(write_model(tmp_path / "m.onnx", output, name, **metadata))
    assert found == [class_name, *box]
    assert said.count(f"m.onnx: read as {layout} (") == 1


OPEN = {  # a model that is refused, what its line names, and its layouts with class names and box
    "rotated, no metadata": (
        rotated(45), {}, ("yolo with 4 classes", "yolo-obb with 3 classes", "detect.class_names"),
        {"yolo-obb": (35.8, 15.8, 124.2, 104.2)},
    ),
    "pose, no metadata": (
        pose(17, 3), {}, ("yolo with 52 classes", "yolo-pose with 1 classes"),
        {"yolo-pose": UPRIGHT},
    ),
    "YOLOX or YOLOv6": (
        yolov5(), {"names": NAMES}, ("2 formats", "yolov5, yolox"),
        {"yolov5": UPRIGHT, "yolox": (55, 67.5, 105, 92.5)},
    ),
    "rotated, but the task says plain": (
        rotated(45), {"names": NAMES, "task": "detect"}, ("3 class names", "task detect"), {},
    ),
    "plain, but the task says rotated": (
        values(7), {"names": NAMES, "task": "obb"}, ("yolo with 3 classes", "task obb"), {},
    ),
    "names of another model": (
        values(7), {"names": "['mug']"}, ("1 class names (of its metadata)", "yolo with 3"), {},
    ),
    "rows of rotated boxes": (
        np.ascontiguousarray(rotated(9).swapaxes(1, 2)), {"names": NAMES, "task": "obb"},
        ("3 class names", "yolo-rows with 4 classes"), {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", OPEN)
def test_a_layout_that_is_left_open_is_declared(kind: str, tmp_path: Path, detect: Any) -> None:
    output, metadata, parts, layouts = OPEN[kind]
    path = write_model(tmp_path / "m.onnx", output, **metadata)
    found, said = detect(path)
    assert not found and all(part in said for part in (*parts, "--detector-layout")), said
    for layout, box in layouts.items():
        for words in (["--detector-layout", layout], ["--set", f"detect.layout={layout}"]):
            found, said = detect(path, *words)
            assert found[1:] == [*box] and "read as" not in said


@pytest.mark.parametrize("count", [7, 84])
def test_boxes_that_are_fractions_are_refused(count: int, tmp_path: Path, detect: Any) -> None:
    """They were read as px: no object was found."""
    output = values(count)
    output[0, :4] /= SIDE
    metadata = {"names": NAMES} if count == 7 else {}
    found, said = detect(write_model(tmp_path / "m.onnx", output, **metadata))
    assert not found and "its boxes are fractions" in said


def test_a_declared_layout_must_fit(tmp_path: Path, detect: Any) -> None:
    path = write_model(tmp_path / "m.onnx", values(7), names=NAMES)
    assert "o (1, 7, 336): not the outputs" in detect(path, "--detector-layout", "picodet")[1]
    said = detect(path, "--detector-layout", "yolo-obb")[1]
    assert "3 class names (of its metadata)" in said and "yolo-obb has 2 classes" in said
    assert "did you mean yolox" in detect(path, "--detector-layout", "yolo-x")[1]


def test_a_file_of_names_has_as_many_as_the_model(tmp_path: Path, detect: Any) -> None:
    path = write_model(tmp_path / "m.onnx", values(7), names=NAMES, task="detect")
    (tmp_path / "data.yaml").write_text("names: [a, b, c, d]")
    words = ("--set", f"detect.class_names={tmp_path / 'data.yaml'}")
    said = detect(path, *words)[1]
    assert f"4 class names ({tmp_path / 'data.yaml'})" in said and "yolo with 3 classes" in said
    (tmp_path / "data.yaml").write_text("names: [a, b, c]")
    assert detect(path, *words)[0][0] == "b"
    (tmp_path / "names.txt").write_text("0: a\n2: c\n1: b\n")
    words = ("--set", f"detect.class_names={tmp_path / 'names.txt'}")
    assert detect(path, *words)[0][0] == "b"


@pytest.mark.parametrize(
    ("names", "expected"),  # of class 2 of 4
    [
        ("{1: 'mug', 2: 'lamp', 3: 'box'}", "lamp"),
        ("{0: 'mug', 2: 'lamp', 3: 'box'}", "lamp"),
        ('{"10": "x", "2": "lamp", "3": "box", "0": "mug"}', ""),  # eleven
        ("{0: mug, 1: lamp, 2: box, 3: cup}", "box"),
        ("['mug', 'lamp', 'box', 'cup']", "box"),
        ("0: mug\n1: lamp\n2: no\n3: cup\n", "no"),
    ],
)
def test_names_in_a_model_go_by_number(
    names: str, expected: str, tmp_path: Path, detect: Any
) -> None:
    found, said = detect(write_model(tmp_path / "m.onnx", values(8, at=6), names=names))
    assert found[0] == expected if expected else "11 class names" in said


# ---- Names in any language -----------------------------------------------------------------------

YAML = {  # as yaml.dump writes it, and by hand; the names of classes 0 and 1
    'names:\n- "\\u6905\\u5B50"\n- "Stuhl gr\\xFCn"\n': ("椅子", "Stuhl grün"),
    "names:\n  0: '32\" tv'\n  1: it's\n": ('32" tv', "it's"),
    'names: ["32\\" tv", "a\\\\b"]\n': ('32" tv', "a\\b"),
    "names: {1: 'a: b', 0: no}\n": ("no", "a: b"),
    "path: x\nnames:\n  0: &n chair  # the first\n  1: >-\n    dining\n    table\n": (
        "chair", "dining table"),
    "names: !!omap_is_not_known [1.0, 2024-01-01]\n": ("1.0", "2024-01-01"),
    "nc: 2\nnames: [\n  chair,\n  'tv''s stand',\n]\nval: x\n": ("chair", "tv's stand"),
    "names: {1: table}\n": ("class 0", "table"),
}  # fmt: skip


@pytest.mark.parametrize("text", YAML)
def test_names_of_a_yaml_file(text: str, tmp_path: Path, detect: Any) -> None:
    path = write_model(tmp_path / "m.onnx", values(6))
    (tmp_path / "data.yaml").write_text(text, encoding="utf-8")
    for at in (0, 1):
        write_model(path, values(6, at=4 + at))
        words = ("--set", f"detect.class_names={tmp_path / 'data.yaml'}")
        assert detect(path, *words)[0][0] == YAML[text][at]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("names: [a, b\n", "line 2: invalid YAML"),
        ("- a\n", "no `names:`"),
        ("names: chair\n", "expected class names"),
        ("names:\n  99999: chair\n", "class number '99999'"),
    ],
)
def test_a_damaged_yaml_file_is_one_line(text: str, part: str, tmp_path: Path, detect: Any) -> None:
    (tmp_path / "data.yaml").write_text(text)
    path = write_model(tmp_path / "m.onnx", values(6))
    said = detect(path, "--set", f"detect.class_names={tmp_path / 'data.yaml'}")[1]
    assert "data.yaml" in said and part in said


def test_names_in_a_locale_without_utf8(tmp_path: Path) -> None:
    """LC_ALL=C, and Python's UTF-8 mode and coercion of the locale are off."""
    folder = tmp_path / "Stühle"
    folder.mkdir()
    rows = ["frame,x1,y1,x2,y2,score,class"]
    for index in range(6):
        cv2.imwrite(str(folder / f"{index}.png"), np.zeros((120, 160, 3), np.uint8))
        rows.append(f"{index},20,30,60,70,.9,椅子")
    (tmp_path / "det.csv").write_text("\n".join(rows), encoding="utf-8")
    off = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = ["track", "Stühle", "--detections", "det.csv", *QUICK, "-o", "out ü"]
    command = [sys.executable, str(ROOT / "reobj_track.py"), *words]
    shown = subprocess.check_output(command, cwd=tmp_path, env=os.environ | off)
    assert b"1 object" in shown
    data = json.loads((tmp_path / "out ü/objects.json").read_text(encoding="utf-8"))
    assert {entry["class"] for entry in data["objects"]} == {"椅子"}
