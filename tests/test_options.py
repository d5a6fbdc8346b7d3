"""Options: their list, how they are set, and the effect of each one.

`SHOWN` has one check for each option: it sets the option and sees the effect. A new option without
a check fails here.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from pose_worlds import arc
from scipy.spatial.transform import Rotation

import quadrics
import reobj.objects.confidence
import reobj.poses.estimate as estimate
import reobj.poses.sfm as sfm
import reobj.poses.stage as stage
import reobj.results.scene as scene
import reobj.sources.detectors as detectors
import reobj_track as rt
from reobj.cameras import load_poses, save_poses, write_colmap
from reobj.maps.stage import opened_map
from reobj.options import (
    as_config,
    every_option,
    list_options,
    read_config,
    value_of,
    with_option,
    write_config,
)
from reobj.results.workspace import Workspace
from reobj.sources.imageless import ImagelessVideo
from reobj.sources.video import LiveTimes
from reobj.sources.weights import frames_at_once, own_models

CHAIR = 56
CAMERA_TEXT = "300,300,160,120"
CAMERA = rt.Camera("PINHOLE", 320, 240, (300.0, 300.0, 160.0, 120.0))


# ---- The list of options ----


def test_the_list_of_options_is_complete(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        rt.main(["--options"])
    lines = capsys.readouterr().out.splitlines()
    assert done.value.code == 0
    assert max(map(len, lines)) <= 120
    named = [line.partition("=")[0] for line in lines if not line.startswith(" ")]
    assert named == list(every_option(rt.Config()))


def test_every_option_is_documented() -> None:
    """With text and default; flags are unique."""
    options = every_option(rt.Config())
    assert all(len(f.metadata["help"].split()) >= 2 for f in options.values())
    flags = [f.metadata["flag"] for f in options.values() if f.metadata["flag"]]
    assert len(set(flags)) == len(flags) and all(flag.startswith("--") for flag in flags)
    text = list_options(rt.Config())
    assert "tracker.coast_frames=30 " in text and "detect.model=deimv2-femto " in text


# ---- How they are set ----


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[rt.Config]:
    """The configurations that reach `run`, which does nothing."""
    configs: list[rt.Config] = []

    def noted(source: str, out: str, config: rt.Config, **_: Any) -> Any:
        configs.append(config)
        return SimpleNamespace(summary=lambda: "")

    monkeypatch.setattr(rt, "run", noted)
    return configs


def other_value(default: Any) -> Any:
    """A value that is not the default, of its type."""
    if default == "solids":  # the one text that is checked where it is set
        return "trails"
    if isinstance(default, bool):
        return not default
    return f"{default}x" if isinstance(default, str) else type(default)(default + 3)


@pytest.mark.parametrize("name", every_option(rt.Config()))
def test_set_changes_one_option(name: str, seen: list[rt.Config]) -> None:
    wanted = other_value(value_of(rt.Config(), name))
    assert rt.main(["run", "a.mp4", "-o", "out", "--set", f"{name}={wanted}"]) == 0
    for other in every_option(rt.Config()):
        expected = wanted if other == name else value_of(rt.Config(), other)
        assert value_of(seen[0], other) == expected
        assert type(value_of(seen[0], other)) is type(expected)


def test_flags_set_their_options(seen: list[rt.Config]) -> None:
    """Every flag of `run`, all at once; `track` has no flags of cameras and objects."""
    flags = {n: f for n, f in every_option(rt.Config()).items() if f.metadata["flag"]}
    words, wanted = [], {}
    for name, f in flags.items():
        wanted[name] = other_value(f.default)
        words += [f.metadata["flag"]] + ([] if f.default is False else [str(wanted[name])])
    assert rt.main(["run", "a.mp4", "-o", "out", *words]) == 0
    assert {name: value_of(seen[0], name) for name in flags} == wanted
    assert len(flags) >= 12
    with pytest.raises(SystemExit):
        rt.main(["track", "a.mp4", "-o", "out", "--priors", "p.json"])


@pytest.mark.parametrize(
    ("text", "value"),
    [("true", True), ("On", True), ("1", True), ("no", False), ("off", False), ("FALSE", False)],
)
def test_switches_accept_words(text: str, value: bool, seen: list[rt.Config]) -> None:
    assert rt.main(["run", "a.mp4", "-o", "out", "--set", f"output.scene={text}"]) == 0
    assert seen[0].output.scene is value


@pytest.mark.parametrize(
    ("item", "expected"),
    [
        ("tracker.coast_frame=3", "no such option; did you mean tracker.coast_frames?"),
        ("traker.n_init=3", "no such option; did you mean tracker.n_init?"),
        ("hgh=.3", "did you mean tracker.high_score?"),  # a part of the name is enough
        ("coast=3", "did you mean tracker.coast_frames?"),
        ("fps_max=3", "no such option; did you mean"),
        ("quite.else=3", "no such option; did you mean"),
        ("input=3", "no such option; did you mean"),
        ("tracker.n_init=three", "expected =INT, found 'three'"),
        ("tracker.n_init=2.5", "expected =INT, found '2.5'"),
        ("tracker.high_score=much", "expected =FLOAT, found 'much'"),
        ("output.scene=maybe", "expected =BOOL, found 'maybe'"),
        ("output.overlay=solid", "expected =BOOL, found 'solid'"),
        ("tracker.n_init", "expected =INT, found None"),
    ],
)
def test_an_invalid_set_gives_one_line(
    item: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rt.main(["run", "a.mp4", "-o", "out", "--set", item]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and expected in said and f"--set {item.partition('=')[0]}" in said


# ---- Files of options ----


def test_a_file_keeps_every_option(tmp_path: Path) -> None:
    """All changed at once; then each value is what it was, and of its type."""
    config = rt.Config()
    for name in every_option(config):
        config = with_option(config, name, other_value(value_of(config, name)))
    write_config(config, tmp_path / "a.toml")
    assert read_config(rt.Config(), tmp_path / "a.toml") == config
    assert tomllib.loads((tmp_path / "a.toml").read_text())["tracker"]["n_init"] == 6


def test_a_file_holds_changed_values_only(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    write_config(rt.Config(), path)
    assert tomllib.loads(path.read_text()) == {}
    config = rt.Config(threads=3, tracker=rt.TrackerConfig(n_init=4))
    write_config(config, path)
    assert path.read_text().splitlines()[1:] == ["threads = 3", "", "[tracker]", "n_init = 4"]


@pytest.mark.parametrize(
    "text", ['a "b" c', "back\\slash", "größe \U0001f600", "tab\tline\nend\x7f\x01", "", "#no"]
)
def test_any_text_survives_a_file(tmp_path: Path, text: str) -> None:
    config = with_option(rt.Config(), "objects.priors", text)
    write_config(config, tmp_path / "a.toml")
    assert read_config(rt.Config(), tmp_path / "a.toml") == config


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[tracker]\nn_int = 3", r"tracker\.n_int: no such option; did you mean tracker\.n_init\?"),
        ("[traker]\nn_init = 3", r"did you mean tracker\.n_init\?"),
        ("[tracker]\nn_init = 2.5", r"tracker\.n_init: expected =INT, found 2\.5"),
        ("[tracker]\nn_init = true", r"tracker\.n_init: expected =INT, found True"),
        ("[tracker]\nremember = 'maybe'", "tracker.remember: expected =BOOL"),
        ("tracker = 3", "tracker: no such option"),
        ("[tracker]\nmax_age = " + "9" * 5000, "not valid TOML"),
        ("[tracker", r"not valid TOML \(Expected"),
        ("[output]\noverlay = 'solid'", r"output\.overlay: expected =BOOL"),
    ],
)
def test_an_invalid_file_gives_one_line(
    tmp_path: Path, text: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    out = tmp_path / "out"
    assert rt.main(["run", "a.mp4", "-o", str(out), "--config", str(path)]) == 2
    said = capsys.readouterr().err
    assert re.search(expected, said) and said.count("\n") == 1 and not out.exists()
    assert "a.toml" in said or "output.overlay" in said
    assert rt.main(["run", "a.mp4", "-o", str(out), "--config", str(tmp_path / "no.toml")]) == 2
    assert "no.toml: cannot be read" in capsys.readouterr().err


def test_flags_override_the_file(tmp_path: Path, seen: list[rt.Config]) -> None:
    """And --set overrides flags; --save-config saves the result."""
    path, kept = tmp_path / "a.toml", tmp_path / "b.toml"
    path.write_text("threads = 2\n[input]\nevery = 5\nstart = 7\n[tracker]\nhigh_score = 1\n")
    words = ["--every", "3", "--set", "input.start=8", "--save-config", str(kept)]
    assert rt.main(["run", "a.mp4", "-o", "out", "--config", str(path), *words]) == 0
    (config,) = seen
    assert (config.threads, config.input.every, config.input.start) == (2, 3, 8)
    assert config.tracker.high_score == 1.0 and type(config.tracker.high_score) is float
    assert read_config(rt.Config(), kept) == config


# ---- Options as a dict ----


def test_a_dict_gives_options_by_section_or_name() -> None:
    chosen = {"detect": {"classes": ["chair", "cup"]}, "tracker.n_init": 2, "offline": True}
    config = as_config(rt.Config(threads=3), chosen)
    expected = rt.Config(rt.InputConfig(), rt.DetectConfig(classes="chair,cup"), threads=3,
                         tracker=rt.TrackerConfig(n_init=2), offline=True)  # fmt: skip
    assert config == expected
    assert as_config(config, None) is config and as_config(rt.Config(), config) is config
    assert rt.Tracker({"n_init": 2}).config == rt.TrackerConfig(n_init=2)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"detect": {"clases": "cup"}}, r"config: detect\.clases: no such option; did you mean"),
        ({7: 1}, "config: 7: no such option"),
        ({"detect": {"classes": None}}, r"detect\.classes: expected =STR, found None"),
        ({"detect": {"classes": ["cup", None]}}, "expected =STR"),
        ({"tracker": {"n_init": [1]}}, "expected =INT"),
        ("a.toml", "config is of type str, expected Config or a dict of options"),
        (rt.TrackerConfig(), "config is of type TrackerConfig, expected Config"),
    ],
)
def test_an_invalid_dict_names_the_option(options: Any, expected: str) -> None:
    with pytest.raises(rt.ReobjError, match=expected):
        rt.run("a.mp4", config=options)


# ---- Effect of every option ----


class Lab:
    """Small inputs, and configurations with the option under test changed."""

    def __init__(self, name: str, path: Path, patch: pytest.MonkeyPatch, room: Path) -> None:
        self.name, self.path, self.patch, self.room = name, path, patch, room

    def config(self, value: Any, **others: Any) -> rt.Config:
        """The option set to this value; others as section__field=value."""
        config = with_option(rt.Config(), self.name, value)
        for name, other in others.items():
            config = with_option(config, name.replace("__", "."), other)
        return config

    def tracker(self, value: Any) -> rt.Tracker:
        return rt.Tracker(self.config(value).tracker)

    def frames(self, value: Any) -> list[int]:
        """Numbers of the frames that are read of a folder of six images."""
        folder = images(self.path / "images", 6)
        return [frame.index for frame in rt.Video(folder, self.config(value).input)]

    def refit(self, value: Any, **others: Any) -> rt.Result:
        """Link, fit and write the room's folder again."""
        config = self.config(value, output__overlay=False, output__scene=False)
        for name, other in others.items():
            config = with_option(config, name.replace("__", "."), other)
        out = self.path / f"out-{value}".replace("/", "_")
        shutil.copytree(self.room, out)
        return rt.refit(out, config)

    def caught(self, module: Any, function: str, parameter: str) -> list[Any]:
        """Record the values passed for a parameter of a function, which is still called."""
        real, values = getattr(module, function), []
        signature = inspect.signature(real)

        def noted(*args: Any, **known: Any) -> Any:
            bound = signature.bind(*args, **known)
            bound.apply_defaults()
            values.append(bound.arguments[parameter])
            return real(*args, **known)

        self.patch.setattr(module, function, noted)
        return values


SHOWN: dict[str, Callable[[Lab], None]] = {}


def shows(name: str) -> Callable[[Callable[[Lab], None]], Callable[[Lab], None]]:
    def register(check: Callable[[Lab], None]) -> Callable[[Lab], None]:
        SHOWN[name] = check
        return check

    return register


def images(folder: Path, count: int, size: tuple[int, int] = (320, 240)) -> Path:
    """Images with texture, all the same."""
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (size[1] // 8, size[0] // 8, 3), np.uint8)
    picture = cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:04d}.jpg"), picture)
    return folder


def rows(*boxes: tuple[float, ...]) -> rt.Detections:
    """Detections from x1, y1, x2, y2[, score] tuples."""
    table = [(*box[:4], box[4] if len(box) > 4 else 0.9, CHAIR) for box in boxes]
    return rt.Detections.from_array(table)


def test_every_option_has_an_effect_check() -> None:
    assert set(SHOWN) == set(every_option(rt.Config()))


@pytest.mark.parametrize("name", every_option(rt.Config()))
def test_option_has_its_effect(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: Path
) -> None:
    SHOWN[name](Lab(name, tmp_path, monkeypatch, room))


# ---- input ----


@shows("input.every")
def _(lab: Lab) -> None:
    assert lab.frames("4") == [0, 4]


@shows("input.start")
def _(lab: Lab) -> None:
    assert lab.frames("4") == [4, 5]


@shows("input.stop")
def _(lab: Lab) -> None:
    assert lab.frames("2") == [0, 1]


@shows("input.max_size")
def _(lab: Lab) -> None:
    video = rt.Video(images(lab.path / "images", 1), lab.config("80").input)
    assert [frame.image.shape for frame in video] == [(60, 80, 3)]


@shows("input.reconnect")
def _(lab: Lab) -> None:
    """A camera of one frame is opened once, then as often as the option says."""
    opened = []

    class Camera:
        def __init__(self, *_: Any) -> None:
            opened.append(self)
            self.left = 1

        def read(self) -> tuple[bool, Any]:
            self.left -= 1
            return self.left >= 0, np.zeros((48, 64, 3), np.uint8)

        def isOpened(self) -> bool:
            return len(opened) == 1

        def get(self, _: int) -> float:
            return 0.0

        def release(self) -> None:
            pass

    lab.patch.setattr(cv2, "VideoCapture", Camera)
    list(rt.Video(0, lab.config("4").input, LiveTimes(silent_s=0.05, first_wait_s=0.0)))
    assert len(opened) == 1 + 4


# ---- detect ----


class Session:
    """An onnxruntime session of the YOLOv8 layout for images of 64 px; it always sees these."""

    SIDE = 64
    BOXES = ((32, 32, 20, 20, 0.9, 1), (35, 32, 20, 20, 0.5, 1), (10, 10, 8, 8, 0.05, 0))

    def __init__(self, *_: Any) -> None:
        cells = sum((self.SIDE // stride) ** 2 for stride in (8, 16, 32))
        self.table = np.zeros((1, 4 + 3, cells), np.float32)
        for i, (*box, score, kind) in enumerate(self.BOXES):
            self.table[0, :4, i], self.table[0, 4 + kind, i] = box, score

    def get_inputs(self) -> list[Any]:
        return [
            SimpleNamespace(name="images", shape=[1, 3, self.SIDE, self.SIDE], type="tensor(float)")
        ]

    def get_outputs(self) -> list[Any]:
        return [SimpleNamespace(name="out")]

    def get_modelmeta(self) -> Any:
        names = "{0: 'mouse', 1: 'chair', 2: 'dog'}"
        return SimpleNamespace(custom_metadata_map={"names": names})

    def run(self, *_: Any) -> list[np.ndarray]:
        return [self.table]


def by_network(lab: Lab, value: Any) -> tuple[rt.Detections, tuple[str, ...]]:
    """Detections of an ONNX detector with the option set, in a grey image of 64 px."""
    lab.patch.setattr(detectors, "onnx_session", Session)
    model = lab.path / "model.onnx"
    model.touch()
    detector = rt.OnnxDetector(model, lab.config(value).detect)
    return detector(np.full((64, 64, 3), 128, np.uint8)), detector.class_names


def by_file(lab: Lab, value: Any) -> tuple[rt.Detections, tuple[str, ...]]:
    """Recorded detections of frame 0 with the option set: two chairs and a mouse."""
    table = lab.path / "det.csv"
    table.write_text("frame,x1,y1,x2,y2,score,class\n" + "".join(
        f"0,{x - w / 2},{y - h / 2},{x + w / 2},{y + h / 2},{score},{('mouse', 'chair')[kind]}\n"
        for x, y, w, h, score, kind in Session.BOXES
    ))  # fmt: skip
    folder = lab.path / "images"
    video = rt.Video(folder if folder.exists() else images(folder, 1))
    recorded = rt.read_detections(table, video, lab.config(value).detect)
    return recorded.at(0), recorded.class_names


@shows("detect.model")
def _(lab: Lab) -> None:
    with pytest.raises(rt.ReobjError, match="no-such-model"):
        rt.OnnxDetector("", lab.config("no-such-model").detect)
    video = rt.Video(images(lab.path / "images", 1))
    with pytest.raises(rt.ReobjError, match="no-such-model"):
        rt.open_detections(video, lab.config("no-such-model").detect)


@shows("detect.words")
def _(lab: Lab) -> None:
    video = rt.Video(images(lab.path / "images", 1))
    with pytest.raises(rt.ReobjError, match="--words: deimv2-femto has fixed classes"):
        rt.open_detections(video, lab.config("red toolbox").detect)


@shows("detect.min_score")
def _(lab: Lab) -> None:
    for find in (by_network, by_file):
        for value, scores in ((0.01, [0.9, 0.5, 0.05]), (0.1, [0.9, 0.5]), (0.6, [0.9])):
            expected = [s for s in scores if find is by_file or s != 0.5]  # NMS drops that one
            assert find(lab, value)[0].score.tolist() == pytest.approx(expected)


@shows("detect.classes")
def _(lab: Lab) -> None:
    assert len(by_file(lab, "chair")[0]) == 2
    assert len(by_network(lab, "chair")[0]) == 1
    for find in (by_network, by_file):
        assert len(find(lab, "mouse")[0]) == 0  # it is below min_score
    assert len(by_network(lab, "dog")[0]) == 0


@shows("detect.class_names")
def _(lab: Lab) -> None:
    names = lab.path / "names.txt"
    names.write_text("mouse\nstool\nchair\n")
    found, known = by_network(lab, str(names))
    assert known == ("mouse", "stool", "chair") and found.class_id.tolist() == [1]
    found, known = by_file(lab, str(names))
    assert known == ("mouse", "stool", "chair") and found.class_id.tolist() == [2, 2]
    source = rt.open_detections(
        rt.Video(lab.path / "images"), lab.config(str(names)).detect, lambda image: []
    )
    assert source.class_names == ("mouse", "stool", "chair")


@shows("detect.format")
def _(lab: Lab) -> None:
    with pytest.raises(rt.ReobjError, match=r"det\.csv, line 1: 7 columns, expected 17"):
        by_file(lab, "kitti")


@shows("detect.image_size")
def _(lab: Lab) -> None:
    before, after = by_file(lab, "64x64")[0], by_file(lab, "32x128")[0]
    assert (before.xyxy * [2, 0.5, 2, 0.5]).tolist() == after.xyxy.tolist()
    for value in ("64", "0x64"):
        with pytest.raises(rt.ReobjError, match=r"detect\.image_size .*expected WIDTHxHEIGHT"):
            by_file(lab, value)


@shows("detect.score_max")
def _(lab: Lab) -> None:
    assert by_file(lab, 9.0)[0].score.tolist() == [0.1]
    for value in (0.5, 0.0):
        with pytest.raises(rt.ReobjError, match=r"detect\.score_max"):
            by_file(lab, value)


@shows("detect.first_frame")
def _(lab: Lab) -> None:
    """Frame 1 of two is the second one in CSV by default, the first with the option."""
    (lab.path / "det.csv").write_text("frame,x1,y1,x2,y2\n1,1,2,30,40\n")
    video = rt.Video(images(lab.path / "images", 3))
    for value, frame in (("", 1), ("0", 1), ("1", 0)):
        config = lab.config(value).detect
        assert rt.read_detections(lab.path / "det.csv", video, config).frame.tolist() == [frame]
    with pytest.raises(rt.ReobjError, match=r"detect\.first_frame 2: expected 0, 1 or order"):
        rt.read_detections(lab.path / "det.csv", video, lab.config("2").detect)


@shows("detect.max_detections")
def _(lab: Lab) -> None:
    assert by_file(lab, 1)[0].score.tolist() == [0.9]
    many = tuple((5 + 10 * (i % 12), 9 + 10 * (i // 12), 8, 8, 0.9, 1) for i in range(140))
    lab.patch.setattr(Session, "BOXES", many)
    lab.patch.setattr(Session, "SIDE", 128)
    assert [len(by_network(lab, value)[0]) for value in (3, 120, 0)] == [3, 120, 100]
    assert [len(by_file(lab, value)[0]) for value in (3, 120, 0)] == [3, 120, 140]  # 0: all


@shows("detect.layout")
def _(lab: Lab) -> None:
    """With a class less and an angle, of 0, in place of its score."""
    names = lab.path / "names.txt"
    names.write_text("mouse\nchair\n")
    config = dataclasses.replace(lab.config("yolo-obb").detect, class_names=str(names))
    lab.patch.setattr(detectors, "onnx_session", Session)
    detector = rt.OnnxDetector(lab.path / "names.txt", config)
    found = detector(np.full((64, 64, 3), 128, np.uint8))
    assert detector.layout == "yolo-obb" and found.xyxy.tolist() == [[22, 22, 42, 42]]
    with pytest.raises(rt.ReobjError, match=r"--detector-layout yoloo: .* did you mean yolo"):
        rt.OnnxDetector(lab.path / "names.txt", lab.config("yoloo").detect)


@shows("detect.batch")
def _(lab: Lab) -> None:
    """The most images of a run of the network; 0: by the device."""
    sizes: list[int] = []

    class Batched(Session):
        def get_inputs(self) -> list[Any]:
            (image,) = super().get_inputs()
            image.shape[0] = "n"
            return [image]

        def run(self, _: Any, feeds: dict[str, Any]) -> list[np.ndarray]:
            sizes.append(len(feeds["images"]))
            return [np.repeat(self.table, sizes[-1], 0)]

    lab.patch.setattr(detectors, "onnx_session", Batched)
    model = lab.path / "model.onnx"
    model.touch()
    for device, value, batch in (
        ("cpu", 0, 1), ("cpu", 4, 4), ("cuda", 0, 8), ("cuda", 2, 2), ("tensorrt", 0, 8),
        ("coreml", 0, 1),
    ):  # fmt: skip
        detector = rt.OnnxDetector(model, lab.config(value).detect, device=device)
        sizes.clear()
        found = list(detector.detect([np.full((64, 64, 3), 128, np.uint8)] * 9))
        assert len(found) == 9 and max(sizes) == batch and sum(sizes) == 9
    assert [frames_at_once(0, device) for device in ("cpu", "mps", "cuda:1")] == [1, 1, 8]


# ---- embed, threads, device, offline: settings of the networks of a run ----


def run_on_nothing(lab: Lab, value: Any) -> None:
    """Track six images without detections."""
    folder, out = lab.path / "images", lab.path / "out"
    config = lab.config(value, output__overlay=False, output__scene=False)
    rt.run(images(folder, 6), out, config, detections=lambda image: [], in_3d=False)


@shows("embed.model")
def _(lab: Lab) -> None:
    models = lab.caught(rt, "make_embedder", "model")
    embedders = lab.caught(rt, "Tracker", "embedder")
    run_on_nothing(lab, "none")
    assert models == ["none"] and embedders == [None]


@shows("embed.head")
def _(lab: Lab) -> None:
    """Another head of the network; a missing one is refused by its name."""
    heads = lab.caught(rt, "make_embedder", "head")
    with pytest.raises(rt.ReobjError, match=r"no-such-head\.onnx"):
        run_on_nothing_with_backbone(lab)
    assert heads == ["no-such-head.onnx"]


def run_on_nothing_with_backbone(lab: Lab) -> None:
    """The bundled network by its file, without the metadata that names its head."""
    lab.patch.setattr("reobj.appearance.embedding.onnx_metadata", lambda session: {})
    config = lab.config("no-such-head.onnx", embed__model=str(own_models() / "reobj.onnx"))
    rt.run(images(lab.path / "images", 2), lab.path / "out", config, detections=lambda image: [],
           in_3d=False)  # fmt: skip


@shows("threads")
def _(lab: Lab) -> None:
    """Those of OpenCV, of the detector and of the embedder."""
    counts: list[int] = []
    lab.patch.setattr(cv2, "setNumThreads", counts.append)
    detector = lab.caught(rt, "open_detections", "threads")
    embedder = lab.caught(rt, "make_embedder", "threads")
    run_on_nothing(lab, 3)
    assert counts[:1] == [3] and detector[:1] == [3] and embedder == [3]


@shows("device")
def _(lab: Lab) -> None:
    """The device of detector and embedder; an unavailable one is refused."""
    detector = lab.caught(rt, "open_detections", "device")
    embedder = lab.caught(rt, "make_embedder", "device")
    with pytest.raises(rt.ReobjError, match="--device no-such-device: this onnxruntime"):
        run_on_nothing(lab, "no-such-device")
    assert detector[:1] == embedder == ["no-such-device"]
    asked: list[Any] = []
    lab.patch.setattr(detectors, "onnx_session", lambda *given: asked.append(given) or Session())
    (lab.path / "model.onnx").touch()
    video, config = rt.Video(lab.path / "images"), rt.DetectConfig(str(lab.path / "model.onnx"))
    keys = [rt.open_detections(video, config, device=d).key for d in ("cuda", "cpu")]
    assert [device for _, _, device in asked] == ["cuda", "cpu"] and keys[0] != keys[1]


@shows("offline")
def _(lab: Lab) -> None:
    detector = lab.caught(rt, "open_detections", "offline")
    embedder = lab.caught(rt, "make_embedder", "offline")
    run_on_nothing(lab, True)
    assert detector[:1] == [True] and embedder == [True]
    lab.patch.setenv("REOBJ_MODELS", str(lab.path / "nowhere"))
    lab.patch.setenv("XDG_CACHE_HOME", str(lab.path / "nowhere"))
    lab.patch.setenv("HOME", str(lab.path))
    with pytest.raises(rt.ReobjError, match="offline forbids the download"):
        rt.run(lab.path / "images", lab.path / "other", lab.config(True), in_3d=False)


# ---- tracker ----


def track(tracker: rt.Tracker, *frames: rt.Detections, **known: Any) -> rt.Tracks:
    """Track frame after frame: those of the last one, with the tentative tracks."""
    for found in frames:
        tracker.update(found, **known)
    return tracker.latest


BOX, ASIDE, FAR = (100, 100, 200, 200), (115, 100, 215, 200), (400, 100, 500, 200)
NOTHING = rt.Detections.empty()


@shows("tracker.high_score")
def _(lab: Lab) -> None:
    """Of a medium box on the track and a strong one beside it, the one matched first is used."""
    fair, clear = (*BOX, 0.5), (*ASIDE, 0.9)
    found = {v: track(lab.tracker(v), *[rows(BOX)] * 4, rows(fair, clear)) for v in (0.4, 0.6)}
    index = {v: t.detection_index[t.track_id == 1].tolist() for v, t in found.items()}
    assert index == {0.4: [0], 0.6: [1]}


@shows("tracker.low_score")
def _(lab: Lab) -> None:
    for value, count in ((0.2, 1), (0.3, 0)):
        found = track(lab.tracker(value), *[rows(BOX)] * 4, rows((*BOX, 0.25)))
        assert len(found) == count


@shows("tracker.new_score")
def _(lab: Lab) -> None:
    for value, count in ((0.6, 1), (0.8, 0)):
        assert len(track(lab.tracker(value), rows((*BOX, 0.7)))) == count


@shows("tracker.n_init")
def _(lab: Lab) -> None:
    for value in (2, 5):
        tracker = lab.tracker(value)
        track(tracker, rows(BOX))
        new = (*FAR, 0.5)
        ids = [track(tracker, rows(BOX, new)).track_id[1] for _ in range(6)]
        assert ids == [0] * (value - 1) + [2] * (7 - value)


@shows("tracker.coast_frames")
def _(lab: Lab) -> None:
    for value in (4, 9):
        tracker = lab.tracker(value)
        track(tracker, *[rows(BOX)] * 4)
        alive = [len(track(tracker, NOTHING)) or len(tracker.state.tracks.mean) for _ in range(12)]
        assert alive == [1] * value + [0] * (12 - value)


@shows("tracker.remember")
def _(lab: Lab) -> None:
    for value, identity in ((True, 1), (False, 2)):
        tracker, view = lab.tracker(value), np.eye(1, 8)
        track(tracker, *[rows(BOX)] * 12, embeddings=view)
        track(tracker, *[NOTHING] * 40)
        assert track(tracker, *[rows(FAR)] * 4, embeddings=view).track_id.tolist() == [identity]


def spread(tracker: rt.Tracker) -> np.ndarray:
    """Variances of position and velocity after a second without a detection."""
    track(tracker, *[rows(BOX)] * 4, *[NOTHING] * 25)
    return np.asarray(tracker.state.tracks.cov[0, 0])


@shows("tracker.std_position")
def _(lab: Lab) -> None:
    small, large = spread(lab.tracker(0.02)), spread(lab.tracker(0.2))
    assert large[0] > 4 * small[0]


@shows("tracker.std_velocity")
def _(lab: Lab) -> None:
    small, large = spread(lab.tracker(0.001)), spread(lab.tracker(0.1))
    assert large[2] > 10 * small[2]


@shows("tracker.appearance_weight")
def _(lab: Lab) -> None:
    """Two objects swap positions according to their appearance, unnoticed by motion alone."""
    views = np.eye(2, 8)
    for value, ids in ((0.0, [1, 2]), (0.8, [2, 1])):
        tracker = lab.tracker(value)
        track(tracker, *[rows(BOX, (108, 100, 208, 200))] * 5, embeddings=views)
        both = rows((101, 100, 201, 200), (107, 100, 207, 200))
        assert track(tracker, both, embeddings=views[::-1]).track_id.tolist() == ids


@shows("tracker.foreground_weight")
def _(lab: Lab) -> None:
    """Weight of the foreground in a fused row, and in the cosine of two rows."""
    for value in (0.2, 0.9):
        tracker = lab.tracker(value)
        both = rt.Embeddings(np.eye(2, 3), np.ones((2, 1)))
        tracker.update(rows(BOX, FAR), embeddings=both)
        _, fused = tracker.latest_embeddings()
        assert fused[0] @ fused[1] == pytest.approx(1 - value, abs=1e-6)


@shows("tracker.embed_every")
def _(lab: Lab) -> None:
    for value in (3, 7):
        asked = []

        def embedder(frame: Any, detections: Any, index: np.ndarray) -> rt.Embeddings:
            asked.append(tracker.state.frame_number)  # noqa: B023
            return rt.Embeddings(np.eye(1, 8), np.empty((1, 0)))

        tracker = rt.Tracker(lab.config(value).tracker, embedder)  # type: ignore[arg-type]
        track(tracker, *[rows(BOX)] * 22, frame=np.zeros((300, 600, 3), np.uint8))
        assert asked == list(range(0, 22, value))


@shows("tracker.return_probability")
def _(lab: Lab) -> None:
    """A return with a medium similarity: enough for a low threshold."""
    for value, identity in ((0.05, 1), (0.95, 2)):
        tracker = lab.tracker(value)
        track(tracker, *[rows(BOX)] * 12, embeddings=np.eye(1, 8))
        track(tracker, *[NOTHING] * 40)
        view = np.array([[0.8, 0.6, 0, 0, 0, 0, 0, 0]])
        assert track(tracker, *[rows(FAR)] * 4, embeddings=view).track_id.tolist() == [identity]


@shows("tracker.camera_motion")
def _(lab: Lab) -> None:
    """The image moves 40 px to the right; the track follows it, or stays."""
    image = cv2.imread(str(images(lab.path / "images", 1) / "0000.jpg"))
    for value, shift in ((True, 40), (False, 0)):
        tracker = lab.tracker(value)
        track(tracker, *[rows(BOX)] * 4, frame=image)
        track(tracker, NOTHING, frame=np.roll(image, 40, 1))
        assert tracker.state.tracks.mean[0, 0, 0] == pytest.approx(150 + shift, abs=2)


# ---- poses ----


def tum_file(path: Path, poses: np.ndarray) -> str:
    """Write cam_from_world (F, 3, 4) as TUM rows at 30 Hz."""
    turn = Rotation.from_matrix(poses[:, :, :3]).inv()
    centre = -np.einsum("fij,fj->fi", turn.as_matrix(), poses[:, :, 3])
    np.savetxt(path, np.c_[np.arange(len(poses)) / 30, centre, turn.as_quat()])
    return str(path)


@shows("poses.mode")
def _(lab: Lab) -> None:
    """none: no cameras; auto: reconstructed; else a file."""
    video = rt.Video(images(lab.path / "images", 4))
    path = tum_file(lab.path / "cams.txt", arc(4))
    config = lab.config(path, poses__camera=CAMERA_TEXT)
    found = stage.supplied_poses(video, config.poses)
    assert found.poses.known.all() and found.poses.source == "user"
    for mode in ("auto", "none"):
        assert stage.supplied_poses(video, lab.config(mode).poses) is None
    asked = lab.caught(rt, "reconstruct_cached", "video")
    for mode, count in (("none", 0), ("auto", 1)):
        config = lab.config(mode, embed__model="none", output__overlay=False, output__scene=False)
        rt.run(video.source, lab.path / mode, config, detections=lambda image: [])
        assert len(asked) == count


@shows("poses.fmt")
def _(lab: Lab) -> None:
    video = rt.Video(images(lab.path / "images", 4))
    path = tum_file(lab.path / "cams.dat", arc(4))
    options = {"poses__mode": path, "poses__camera": CAMERA_TEXT}
    assert stage.supplied_poses(video, lab.config("tum", **options).poses) is not None
    for fmt in ("transforms", "nonsense"):
        with pytest.raises(rt.ReobjError, match=r"JSON|format nonsense"):
            stage.supplied_poses(video, lab.config(fmt, **options).poses)


@shows("poses.camera")
def _(lab: Lab) -> None:
    """Of supplied poses and of a reconstruction."""
    video = rt.Video(images(lab.path / "images", 4))
    path = tum_file(lab.path / "cams.txt", arc(4))
    found = stage.supplied_poses(video, lab.config(CAMERA_TEXT, poses__mode=path).poses)
    assert found.poses.camera == CAMERA
    with pytest.raises(rt.ReobjError, match="no intrinsics"):
        stage.supplied_poses(video, lab.config("", poses__mode=path).poses)
    poses = rt.estimate_poses(video, lab.config(CAMERA_TEXT).poses, lab.path / "work")
    assert poses.camera == CAMERA


@shows("poses.camera_format")
def _(lab: Lab) -> None:
    """A matrix in a file whose name says something else."""
    video = rt.Video(images(lab.path / "images", 4))
    path = tum_file(lab.path / "cams.txt", arc(4))
    camera = lab.path / "camera.pincam"
    np.savetxt(camera, CAMERA.K)
    options = {"poses__mode": path, "poses__camera": str(camera)}
    found = stage.supplied_poses(video, lab.config("matrix", **options).poses)
    assert found.poses.camera == CAMERA
    with pytest.raises(rt.ReobjError, match="images of 0 pixels"):
        stage.supplied_poses(video, lab.config("auto", **options).poses)
    with pytest.raises(rt.ReobjError, match="--camera-format nonsense"):
        stage.supplied_poses(video, lab.config("nonsense", **options).poses)


@shows("poses.size_px")
def _(lab: Lab) -> None:
    sizes: list[tuple[int, ...]] = []

    def noted(works: Any, *args: Any) -> Any:
        sizes.extend(work.gray.shape for work in works)
        raise KeyboardInterrupt

    lab.patch.setattr(estimate, "pick_keyframes", noted)
    video = rt.Video(images(lab.path / "images", 2))
    with pytest.raises(KeyboardInterrupt):
        rt.estimate_poses(video, lab.config(160).poses, lab.path / "work")
    assert sizes == [(120, 160)] * 2


@shows("poses.depth")
def _(lab: Lab) -> None:
    """Maps of supplied and of reconstructed poses; nothing is triangulated then."""
    given: list[str] = []

    def noted(poses: rt.Poses, depth: str, video: Any) -> rt.Poses:
        given.append(depth)
        return poses

    lab.patch.setattr(stage, "add_depth", noted)
    lab.patch.setattr(stage, "triangulate", lambda poses, *_, **__: poses)
    video, workspace = rt.Video(images(lab.path / "images", 4)), Workspace(lab.path / "out")
    path = tum_file(lab.path / "cams.txt", arc(4))
    options = {"poses__mode": path, "poses__camera": CAMERA_TEXT}
    for depth in ("", "maps:5000"):
        own = lab.config(depth, **options).poses
        found = stage.supplied_poses(video, own)
        stage.checked_poses(found, rt.Tracks.empty(), video, own, workspace)
        known = rt.Poses(CAMERA, np.arange(4), np.arange(4) / 30, arc(4), np.full(4, "pnp"), "x")
        lab.patch.setattr(stage, "estimate_poses", lambda *_, p=known, **__: write_model(p, lab))
        stage.reconstruct_cached(video, lab.config(depth).poses, workspace)
    assert given == ["maps:5000"] * 2


def write_model(poses: rt.Poses, lab: Lab) -> rt.Poses:
    """Replaces a reconstruction, with its COLMAP model."""
    write_colmap(lab.path / "out" / "cache" / "sfm" / "sparse", poses, [str(i) for i in range(4)])
    return poses


def reconstructed(lab: Lab, value: Any) -> rt.Poses:
    """Poses of 9 frames; the model contains frames 0, 4 and 8, the others have no points."""
    folder = lab.path / "images"
    video = rt.Video(folder if folder.exists() else images(folder, 9))
    keys = np.array([0, 4, 8])

    def made(*args: Any, **known: Any) -> sfm.Mapped:
        bound = signature.bind(*args, **known).arguments
        seeds.append(bound["seed"])
        found = rt.Poses(CAMERA, keys, keys / 30, arc(9)[keys], np.full(3, "keyframe"), "user")
        work = Path(bound["work_dir"])
        (work / "mapping").mkdir(parents=True, exist_ok=True)
        write_colmap(work / "sparse", found, [video.names[k] for k in keys])
        return sfm.Mapped([work / "sparse"], [])

    signature, seeds = inspect.signature(estimate.reconstruct), []
    lab.patch.setattr(estimate, "reconstruct", made)
    between = lab.caught(estimate, "locate_between", "seed")
    poses = rt.estimate_poses(video, lab.config(value).poses, lab.path / f"work{value}")
    lab.patch.undo()
    lab.seeds = seeds + between  # type: ignore[attr-defined]
    return poses


@shows("poses.frames_by")
def _(lab: Lab) -> None:
    """Numbers in names of a video's frames, none 0 and none the last: from 0, or from 1."""
    cams = rt.Poses(CAMERA, np.arange(4), np.arange(4) / 30, arc(4), np.full(4, "pnp"), "pycolmap")
    write_colmap(lab.path / "model", cams, [f"{i}.png" for i in range(1, 5)])
    video = ImagelessVideo(lab.path / "model", (CAMERA.width, CAMERA.height), count=6)
    for value, first in (("number0", 1), ("number1", 0)):
        config = lab.config(value, poses__mode=str(lab.path / "model"))
        found = stage.supplied_poses(video, config.poses)
        assert np.flatnonzero(found.poses.known).tolist() == list(range(first, first + 4))
    with pytest.raises(rt.ReobjError, match="frames_by=number0"):
        stage.supplied_poses(video, lab.config("", poses__mode=str(lab.path / "model")).poses)


@shows("poses.metric")
def _(lab: Lab) -> None:
    """Of a model without scale; a reconstruction cannot be declared metric."""
    video = rt.Video(images(lab.path / "images", 4))
    cams = rt.Poses(CAMERA, np.arange(4), np.arange(4) / 30, arc(4), np.full(4, "pnp"), "pycolmap")
    write_colmap(lab.path / "model", cams, video.names)
    for value in (False, True):
        config = lab.config(value, poses__mode=str(lab.path / "model"))
        found = stage.supplied_poses(video, config.poses)
        assert found.poses.known.all() and found.poses.metric is value
    with pytest.raises(rt.ReobjError, match="--metric"):
        stage.supplied_poses(video, lab.config(True).poses)


@shows("poses.seed")
def _(lab: Lab) -> None:
    """It reaches the mapper and PnP."""
    reconstructed(lab, 11)
    assert lab.seeds == [11, 11]  # type: ignore[attr-defined]


# ---- objects ----


SOLIDS = quadrics.Ellipsoids(
    np.array([[-0.5, 0, 0.41], [0.6, 0.3, 0.41]]),
    np.tile([0.28, 0.3, 0.41], (2, 1)),
    np.eye(3)[None].repeat(2, 0),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a run: two chairs in 24 frames with poses.

    The first is missed in frames 9 to 11; the second is away in frames 12 to 17, and comes back
    under another identity with low scores.
    """
    base = tmp_path_factory.mktemp("room")
    poses = arc(24)
    boxes = quadrics.solid_boxes(SOLIDS, "box", CAMERA.K @ poses)  # (F, 2, 4)
    lines = ["frame,x1,y1,x2,y2,score,class"]
    for f, k in np.ndindex(24, 2):
        if not (9 <= f <= 11 if k == 0 else 12 <= f <= 17):
            score = 0.5 if k and f > 17 else 0.9
            lines.append(f"{f},{','.join(map(str, boxes[f, k]))},{score},chair")
    (base / "det.csv").write_text("\n".join(lines) + "\n")
    path = tum_file(base / "cams.txt", poses)
    config = rt.Config(
        embed=rt.EmbedConfig(model="none"),
        tracker=rt.TrackerConfig(coast_frames=4, remember=False),
        poses=rt.PosesConfig(mode=path, camera=CAMERA_TEXT),
        output=rt.OutputConfig(overlay="none", scene=False),
    )
    source = images(base / "images", 24)
    with pytest.MonkeyPatch.context() as patch:  # no child process
        patch.setattr(stage, "triangulate", lambda poses, *_, **__: poses)
        rt.run(source, base / "out", config, detections=base / "det.csv")
    return base / "out"


@shows("objects.priors")
def _(lab: Lab) -> None:
    """Chairs of twice the size make the scale of a world without one twice as large."""
    last = shutil.copytree(lab.room, lab.path / "room") / "cache" / "last-poses.npz"
    save_poses(last, dataclasses.replace(load_poses(last), metric=False))
    lab.room = lab.path / "room"
    table = json.loads((Path(quadrics.__file__).with_name("priors.json")).read_text())
    entry = {"chair": table["chair"]}
    typical = entry["chair"]["size_m"]
    key = next(k for k, v in typical.items() if k not in ("log_std", "corr") and len(v) == 3)
    scales = []
    for factor in (1, 2):
        typical[key] = [factor * side for side in typical[key]]
        path = lab.path / f"priors{factor}.json"
        path.write_text(json.dumps(entry))
        scale = lab.refit(str(path)).world.scale
        assert scale is not None and scale.source == "priors"
        scales.append(scale.value)
    assert scales[1] / scales[0] == pytest.approx(2, rel=0.02)


@shows("objects.prior")
def _(lab: Lab) -> None:
    """The scale of a world without one follows the size that the user gives to chairs."""
    last = shutil.copytree(lab.room, lab.path / "room") / "cache" / "last-poses.npz"
    save_poses(last, dataclasses.replace(load_poses(last), metric=False))
    lab.room = lab.path / "room"
    scales = []
    for value in ("chair=.5x.5x.8m", "armchair=2x2x2m;chair=100x100x160cm"):
        scale = lab.refit(value).world.scale
        assert scale is not None and scale.source == "priors"
        scales.append(scale.value)
    assert scales[1] / scales[0] == pytest.approx(2, rel=0.02)


@shows("objects.known_size")
def _(lab: Lab) -> None:
    scale = lab.refit("chair=1.64m").world.scale
    assert scale is not None and scale.source == "known_size"
    assert scale.value == pytest.approx(2, rel=0.05)  # the true chairs are .82 units high


@shows("objects.support")
def _(lab: Lab) -> None:
    for value in ("cylinder", "ellipsoid"):
        assert {found.support for found in lab.refit(value).objects} == {value}


@shows("objects.solver")
def _(lab: Lab) -> None:
    for value in ("lfd", "psfmo"):
        found = [o for o in lab.refit(value).objects if o.status == "ok"]
        assert found and all(o.support == "ellipsoid" and o.cov is None for o in found)


@shows("objects.up")
def _(lab: Lab) -> None:
    up = lab.refit("0,0.6,0.8").world.up_in_world
    assert up is not None
    np.testing.assert_allclose(up, [0, 0.6, 0.8], atol=1e-6)


@shows("objects.link")
def _(lab: Lab) -> None:
    assert [len(lab.refit(value).objects) for value in (True, False)] == [2, 3]


@shows("objects.min_views")
def _(lab: Lab) -> None:
    """One chair is seen in 21 frames, the other in 18."""
    for value, located in ((18, 2), (19, 1), (21, 1), (22, 0)):
        assert sum(found.located for found in lab.refit(value).objects) == located


@shows("objects.moving")
def _(lab: Lab) -> None:
    for value, reason in (("person,chair", "objects of this class move"), ("person", "")):
        found = lab.refit(value).objects
        assert {o.reason == "objects of this class move" for o in found} == {bool(reason)}


# ---- output ----


@shows("output.overlay")
def _(lab: Lab) -> None:
    for value in (True, False):
        config = lab.config(value, output__scene=False)
        out = shutil.copytree(lab.room, lab.path / f"out{value}")
        rt.refit(out, config)
        assert (out / "overlay.mp4").exists() == value


@shows("output.scene")
def _(lab: Lab) -> None:
    for value in (True, False):
        config = lab.config(value, output__overlay=False)
        out = shutil.copytree(lab.room, lab.path / f"out{value}")
        rt.refit(out, config)
        assert (out / "scene.html").exists() == value


@shows("output.cloud")
def _(lab: Lab) -> None:
    """Dense points: tests/test_cloud.py checks that the viewer has them."""
    for value in (False, True):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rt, "write_pictures", shown := Mock(return_value=[]))
            lab.refit(value, poses__depth="maps:5000")
        assert shown.call_args[1]["cloud"] == value
        assert shown.call_args[1]["depth"] == str(Path("maps:5000").absolute())


@shows("output.doubtful")
def _(lab: Lab) -> None:
    """All are below a confidence of 1.1: in the file and the viewer; in the overlay on request."""
    for value, count in ((False, 0), (True, 2)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(reobj.objects.confidence, "LOW_CONFIDENCE", 1.1)
            shown = Mock(return_value=[])
            patch.setattr(rt, "write_pictures", shown)
            assert {found.status for found in lab.refit(value).objects} == {"doubtful"}
        result, out, video, *_, doubtful, _ = shown.call_args[0]
        assert len(result.objects) == 2 and doubtful == value
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(scene, "Overlay", drawn := Mock())
            patch.setattr(scene, "write_scene", page := Mock())
            scene.write_pictures(result, out, video, doubtful=doubtful)
        assert len(drawn.call_args[0][0].objects) == count and page.call_args[0][-1] == value


@shows("output.fill_gaps")
def _(lab: Lab) -> None:
    """The first chair is missed in three frames; the second is absent in six, of which four are
    near viewpoints that observed it: both are located.
    """
    for value, count in ((0, 0), (1, 7)):
        result = lab.refit(value)
        assert (result.tracks.score == 0).sum() == count
        assert [found.views for found in result.objects] == [21, 18]


@shows("map.path")
def _(lab: Lab) -> None:
    """The cameras of the folder were not placed in the map: it is named in the changes."""
    path = lab.path / "flat.map"
    rt.RoomMap().save(path)
    for value in ("", str(path)):
        changes = lab.refit(value).changes
        assert ("" if changes is None else changes.map_path) == value


@shows("map.frozen")
def _(lab: Lab) -> None:
    """A map that is only read is not locked."""
    path = lab.path / "flat.map"
    rt.RoomMap().save(path)
    for value in (True, False):
        with opened_map(lab.config(value, map__path=str(path)).map) as opened:
            assert opened is not None and opened.frozen == value
            assert (lab.path / ".flat.map.lock").exists() != value


@shows("map.pictures")
def _(lab: Lab) -> None:
    for value in (True, False):
        with opened_map(lab.config(value, map__path=str(lab.path / "new.map")).map) as opened:
            assert opened is not None and opened.pictures == value
