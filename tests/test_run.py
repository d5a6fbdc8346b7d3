"""The command line: complete runs, resuming, invalid input."""

from __future__ import annotations

import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt
from reobj.config import read_config
from reobj.export.labels import BOXER_HEADER
from reobj.results.entries import validate_objects

ROOT = Path(__file__).resolve().parent.parent
FRAMES = 12
NO_PAGE = ("--set", "output.scene=0")
QUICK = ("--embed", "none", "--set", "output.overlay=none", *NO_PAGE)


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (240, 400, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """A folder of frames that pan over a texture."""
    folder = tmp_path / "frames"
    folder.mkdir()
    image = texture()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:03d}.png"), image[:, 4 * i : 4 * i + 320])
    return folder


def mot_rows(frames: int = FRAMES) -> str:
    """Two objects that stay on the texture while the camera pans."""
    lines = [
        f"{i + 1},-1,{x - 4 * i},{y},40,50,0.9,-1,-1,-1"
        for i in range(frames)
        for x, y in ((100, 60), (220, 80))
    ]
    return "\n".join(lines) + "\n"


@pytest.fixture
def detections(tmp_path: Path) -> Path:
    path = tmp_path / "det.txt"
    path.write_text(mot_rows())
    return path


def cli(*args: object) -> int:
    return rt.main([str(a) for a in args])


def overlay_in(out: Path) -> str:
    """The only overlay video in an output folder."""
    (name,) = (path.name for path in out.glob("overlay.*"))
    return name


# ---- Complete runs ----


def test_track_writes_identities(
    clip: Path, detections: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli("track", clip, "-o", tmp_path / "out", "--detections", detections) == 0
    assert (tmp_path / "out/scene.html").exists()
    mot = np.loadtxt(tmp_path / "out/tracks.txt", delimiter=",")
    assert (
        sorted(set(mot[:, 1])) == [1, 2] and len(mot) == 2 * FRAMES
    )  # tentative frames are back-filled
    assert validate_objects(tmp_path / "out/objects.json") == []
    out = capsys.readouterr().out
    assert "2 objects: 2 object" in out and re.search(r"^look at: .*overlay\.mp4,", out, re.M)
    assert "reject" not in out and "sigma" not in out
    objects = json.loads((tmp_path / "out/objects.json").read_text())["objects"]
    assert [(o["status"], o["reason"], o["size"]) for o in objects] == [("tracked", "", None)] * 2
    assert len(re.findall(r"^ +\d+  object +12$", out, re.M)) == 2


def test_same_input_same_bytes(clip: Path, detections: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert cli("track", clip, "-o", tmp_path / name, "--detections", detections) == 0
    for file in ("tracks.txt", "scene.html", overlay_in(tmp_path / "a"), "cache/last-tracks.npz"):
        same = content(tmp_path / "a", file) == content(tmp_path / "b", file)
        assert same, file
    objects = [
        json.loads((tmp_path / n / "objects.json").read_text())["objects"] for n in ("a", "b")
    ]
    assert objects[0] == objects[1]


def test_zero_detections(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "none.txt").write_text("")
    code = cli("track", clip, "-o", tmp_path / "out", "--detections", tmp_path / "none.txt", *QUICK)
    captured = capsys.readouterr()
    assert code == 0
    assert "no object was tracked" in captured.err and "objects: none" in captured.out
    assert (tmp_path / "out/tracks.txt").read_text() == ""


def test_corrupt_frame_in_the_middle_is_skipped_and_counted(
    clip: Path, detections: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (clip / "005.png").write_bytes(b"not an image")
    assert cli("track", clip, "-o", tmp_path / "out", "--detections", detections) == 0
    assert "1 frames skipped" in capsys.readouterr().err
    mot = np.loadtxt(tmp_path / "out/tracks.txt", delimiter=",")
    assert (mot[mot[:, 0] == 6, 6] == 0).all()  # nothing was detected there
    assert all((mot[:, 0] == f).sum() == 2 for f in (5, 7))
    assert cli("export", tmp_path / "out", "--to", "coco-vid") == 0


def test_python_callable_as_detector(clip: Path, tmp_path: Path) -> None:
    calls = []

    def detector(image: np.ndarray) -> list[list[float]]:
        calls.append(image.shape)
        x = 100 - 4 * (len(calls) - 1)
        return [[x, 60, x + 40, 110, 0.9, 56]]

    result = rt.run(clip, tmp_path / "out", detections=detector, in_3d=False)
    assert calls == [(240, 320, 3)] * FRAMES
    assert [o.class_name for o in result.objects] == ["chair"]
    again = rt.Result.load(tmp_path / "out")
    assert [o.to_json() for o in again.objects] == [o.to_json() for o in result.objects]
    np.testing.assert_allclose(again.tracks.xyxy, result.tracks.xyxy, atol=0.011)
    rt.refit(tmp_path / "out", {"objects": {"min_views": 5}})
    rt.refit(tmp_path / "out", {"threads": 3})  # a dict changes the options of the last run
    kept = read_config(rt.Config(), tmp_path / "out/config.toml")
    assert (kept.objects.min_views, kept.threads) == (5, 3)


# ---- Resume and output folder ----


class CountingDetector:
    """Stands in for OnnxDetector; counts frames and can be interrupted."""

    calls = 0
    stop_at = -1
    class_names = rt.COCO_NAMES
    batch = 1
    path = Path("fake.onnx")
    messages = ()

    def __init__(self, *args: object) -> None: ...

    def __call__(self, image: np.ndarray) -> rt.Detections:
        return next(self.detect([image]))

    def detect(self, images: list[np.ndarray]) -> Iterator[rt.Detections]:
        cls = type(self)
        for _ in images:
            if cls.calls == cls.stop_at:
                cls.stop_at = -1
                raise KeyboardInterrupt
            cls.calls += 1
            yield rt.Detections.from_array([[100, 60, 140, 110, 0.9, 56]])


@pytest.fixture
def counting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> type[CountingDetector]:
    weights = tmp_path / "fake.onnx"
    weights.write_bytes(b"weights")
    monkeypatch.setattr("reobj.sources.detectors.OnnxDetector", CountingDetector)
    CountingDetector.calls, CountingDetector.stop_at = 0, -1
    return CountingDetector


def test_ctrl_c_keeps_computed_stages(
    clip: Path, tmp_path: Path, counting: type[CountingDetector], capsys: pytest.CaptureFixture[str]
) -> None:
    counting.stop_at = 7
    args = ("track", clip, "-o", tmp_path / "out", "--detector", tmp_path / "fake.onnx", *QUICK)
    assert cli(*args) == 130
    assert "run the same command again" in capsys.readouterr().err
    assert counting.calls == 7
    assert cli(*args) == 0
    assert counting.calls == FRAMES  # the first 7 were not detected again
    assert len(np.loadtxt(tmp_path / "out/tracks.txt", delimiter=",")) == FRAMES


def test_a_changed_option_recomputes_only_what_depends_on_it(
    clip: Path, tmp_path: Path, counting: type[CountingDetector]
) -> None:
    args = ("track", clip, "-o", tmp_path / "out", "--detector", tmp_path / "fake.onnx", *QUICK)
    assert cli(*args) == 0 and counting.calls == FRAMES
    cache = tmp_path / "out/cache"
    tracks = {p: p.stat().st_mtime_ns for p in cache.glob("tracks-*.npz")}
    assert cli(*args) == 0 and len(tracks) == 1
    assert {p: p.stat().st_mtime_ns for p in cache.glob("tracks-*.npz")} == tracks  # unchanged
    assert cli(*args, "--set", "tracker.n_init=2") == 0
    assert counting.calls == FRAMES  # detections are kept,
    assert len(list(cache.glob("tracks-*.npz"))) == 2  # tracks are not
    assert cli(*args, "--set", "objects.min_views=4") == 0
    assert len(list(cache.glob("tracks-*.npz"))) == 2  # the tracker does not depend on it
    assert cli(*args, "--set", "detect.min_score=0.3") == 0 and counting.calls == 2 * FRAMES


def content(out: Path, file: str) -> bytes:
    """A file of an output folder without the path of the folder, which the page shows."""
    return (out / file).read_bytes().replace(str(out).encode(), b"OUT")


def test_a_killed_run_leaves_nothing_broken(clip: Path, detections: Path, tmp_path: Path) -> None:
    """SIGKILL during tracking: the next run gives the result of an uninterrupted one."""
    args = ["track", str(clip), "--detections", str(detections), "--embed", "none"]
    assert cli(*args, "-o", tmp_path / "good") == 0
    code = (
        "import os, signal, sys, reobj_track as rt\n"
        "calls, own = [], rt.Tracker.update\n"
        "def killing(*args, **more):\n"
        "    calls.append(1)\n"
        "    if len(calls) == 7: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return own(*args, **more)\n"
        "rt.Tracker.update = killing\n"
        "sys.exit(rt.main(sys.argv[1:]))"
    )
    out = tmp_path / "out"
    command = [sys.executable, "-c", code, *args, "-o", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True)
    assert done.returncode == -signal.SIGKILL
    assert not (out / "scene.html").exists() and not list(out.glob("overlay.*"))
    assert cli(*args, "-o", out) == 0
    for file in ("tracks.txt", "scene.html", overlay_in(out), "cache/last-tracks.npz"):
        assert content(out, file) == content(tmp_path / "good", file), file
    assert not [p for p in out.rglob(".part-*")]


# ---- Invalid input and failures ----


def assert_one_clear_line(capsys: pytest.CaptureFixture[str], message: str) -> None:
    shown = capsys.readouterr().err.splitlines()  # progress, and the error
    errors = [line for line in shown if line.startswith("error: ")]
    assert len(errors) == 1 and errors[0] == shown[-1] and re.search(message, errors[0]), shown
    assert all("%" in line for line in shown[:-1]), shown


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("missing.mp4",), "missing.mp4"),  # no such video
        (("empty",), "empty"),  # folder without images
        (("broken.mp4",), "broken.mp4"),  # not a video
        (("frames", "--detections", "missing.txt"), "missing.txt"),
        (("frames", "--detections", "det.txt", "--poses", "missing"), "missing"),
        (("frames", "--detections", "det.txt", "--start", "99"), "--start"),
        (("frames", "--detector", "text.onnx"), "text.onnx"),  # no ONNX file at all
        (("frames", "--detector", "no-such-model", "--offline"), "no-such-model"),
        (("frames", "--detections", "det.txt", "--embed", "text.onnx"), "text.onnx"),
    ],
)
def test_bad_input(
    clip: Path,
    detections: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    args: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.mp4").write_bytes(b"\0" * 1000)
    (tmp_path / "text.onnx").write_text("hello")
    command = "run" if "--poses" in args else "track"
    assert cli(command, *args, "-o", "out") == 2
    assert_one_clear_line(capsys, message)


CENTERS = np.array(
    [[-1.2, 0, 3.0], [-0.5, 0.5, 3.2], [0, -0.4, 3.5], [0.6, 0.2, 3.8], [1.2, -0.2, 4.0]]
)


def rendered_tracks(folder: Path, poses: str) -> tuple[Path, Path, Path]:
    """Frames, detections and TUM poses of a sideways walk past five balls; `poses`: right or
    inverse.
    """
    solids = quadrics.Ellipsoids(CENTERS, np.full((5, 3), 0.25), np.tile(np.eye(3), (5, 1, 1)))
    frames = folder / "frames"
    frames.mkdir()
    lines, tum = [], []
    K = np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]])
    for i in range(30):
        turn = np.radians(-15 + i)
        rotation = np.array(
            [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
        )
        center = np.array([-1.0 + i / 15, 0.02 * np.sin(i), 0.3 * np.sin(i / 5)])
        cam_from_world = np.c_[rotation, -rotation @ center]
        boxes = quadrics.solid_boxes(solids, "ellipsoid", (K @ cam_from_world)[None])[0]
        lines += [f"{i + 1},-1,{x1},{y1},{x2 - x1},{y2 - y1},0.9" for x1, y1, x2, y2 in boxes]
        world_from_cam = np.vstack([cam_from_world, [0, 0, 0, 1]])
        world_from_cam = np.linalg.inv(world_from_cam) if poses == "right" else world_from_cam
        xyzw = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
        tum.append(" ".join(f"{v:.17g}" for v in (i / 30, *world_from_cam[:3, 3], *xyzw)))
        cv2.imwrite(str(frames / f"{i:03d}.png"), np.full((240, 320, 3), 127, np.uint8))
    (folder / "det.txt").write_text("\n".join(lines))
    (folder / "poses.txt").write_text("\n".join(tum))
    return frames, folder / "det.txt", folder / "poses.txt"


def posed_run(tmp_path: Path, poses: str) -> tuple[object, ...]:
    """Arguments of a run with supplied TUM poses, right or inverse."""
    frames, det, path = rendered_tracks(tmp_path, poses)
    files = ("--detections", det, "--poses", path, "--camera", "300,300,160,120")
    return ("run", frames, "-o", tmp_path / "out", *files, *QUICK)


def test_overlay_cut_by_a_full_disk_is_not_kept(
    clip: Path, detections: Path, tmp_path: Path
) -> None:
    """A real limit on file sizes (RLIMIT_FSIZE) replaces the full disk; the rest is written."""
    code = (
        "import resource, sys, reobj_track as rt; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10000, 10000)); "
        "sys.exit(rt.main(sys.argv[1:]))"
    )
    args = ("track", clip, "-o", tmp_path / "out", "--detections", detections, *NO_PAGE)
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, args)],
        capture_output=True,
        text=True,
        cwd=Path(rt.__file__).parent,
    )
    assert done.returncode == 0, done.stderr
    assert "overlay.mp4" in done.stderr and done.stderr.count("\n") == 1
    assert (
        "warning: no overlay video: OSError" in done.stderr and "output.overlay=none" in done.stderr
    )
    assert not list((tmp_path / "out").glob("*overlay*"))
    assert (tmp_path / "out/tracks.txt").exists() and (tmp_path / "out/config.toml").exists()


# ---- The module and its help ----


def test_import_loads_no_heavy_package() -> None:
    code = (
        "import sys, reobj_track, quadrics; "
        "bad = {'pycolmap', 'onnxruntime', 'matplotlib', 'torch', 'trimesh', "
        "'jsonschema', 'rerun'} & set(sys.modules); sys.exit(','.join(sorted(bad)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(rt.__file__).parent
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        ("rnu a.mp4", "did you mean run?"),
        ("run a.mp4 -o out --evry 3", "--evry 3; did you mean --every?"),
        ("run a.mp4 -o out --detectons d.txt", "did you mean --detections?"),
        ("export out --to gbl", "did you mean glb?"),
        ("run a.mp4 -o out --every three", "--every: invalid int value: 'three'"),
        ("run a.mp4", "required: -o/--out"),
        ("run a.mp4 -o out --config", "--config: expected one argument"),
        ("track a.mp4 -o out --known-size chair=.8m", "unrecognized arguments: --known-size"),
    ],
)
def test_a_misspelt_argument_gives_one_line_with_a_suggestion(
    args: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        cli(*args.split())
    said = capsys.readouterr().err
    assert stop.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1
    assert expected in said and "--help)" in said


@pytest.mark.usefixtures("no_points")
def test_options_are_stored_in_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`objects OUT` takes the options of the last run there; a flag replaces one."""
    frames, det, path = rendered_tracks(tmp_path, "right")
    rows = det.read_text().splitlines()
    table = [row.split(",") for row in rows]
    det = tmp_path / "det.csv"
    det.write_text("frame,x1,y1,x2,y2,score,class\n" + "".join(
        f"{int(f) - 1},{x},{y},{float(x) + float(w)},{float(y) + float(h)},{s},sports ball\n"
        for f, _, x, y, w, h, s in table
    ))  # fmt: skip
    out = tmp_path / "out"
    args = ("--detections", det, "--poses", path, "--camera", "300,300,160,120", *QUICK)
    known = ("--known-size", "sports ball=22cm", "--support", "ellipsoid")
    assert cli("run", frames, "-o", out, *args, *known) == 0

    def scale() -> tuple[float, str]:
        data = json.loads((out / "objects.json").read_text())
        assert {o["support"] for o in data["objects"]} == {"ellipsoid"}
        return data["world"]["scale"]["metres_per_unit"], data["world"]["scale"]["source"]

    known_scale = (pytest.approx(0.44, rel=0.1), "known_size")  # the balls are half a unit high
    assert scale() == known_scale
    assert cli("objects", out) == 0 and scale() == known_scale
    assert cli("export", out, "--to", "cvat", "-o", tmp_path / "a.xml") == 0
    assert cli("objects", out, "--tracks", tmp_path / "a.xml") == 0 and scale() == known_scale
    assert rt.refit(out).world.scale.source == "known_size"
    assert not list(out.glob("overlay.*"))  # options that need not be written are kept as well
    assert cli("objects", out, "--known-size", "Sports_Ball=11cm") == 0
    assert scale() == (pytest.approx(0.22, rel=0.1), "known_size")
    assert cli("objects", out, "--known-size", "") == 0 and scale()[1] == "poses"
    capsys.readouterr()
    assert cli("objects", out, "--known-size", "sports bal=1m") == 2
    assert_one_clear_line(capsys, "sports bal: no such class; did you mean sports ball")


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (("--known-size", "chair=nan"), "--known-size 'chair=nan': expected CATEGORY=HEIGHT in m"),
        (("--known-size", "chair=9999m"), "0.001 to 1000 m, such as door=2.0m"),
        (("--priors", ROOT / "README.md"), "README.md"),
        (("--priors", "missing.json"), "missing.json"),
        (("--support", "cube"), "--shape cube: expected one of auto, ellipsoid"),
        (("--set", "objects.up=1,2"), "objects.up=1,2: expected a direction"),
        (("--set", "objects.up=0,0,0"), "expected a direction"),
        (("--prior", "mixer=.2x.3m"), "'mixer=.2x.3m': expected once for each word WORD=WIDTHxDE"),
        (("--prior", "mixer=suitcse"), "no size prior of suitcse; did you mean suitcase?"),
        (("--prior", "sofa=1x1x1m,couch=bed"), "--prior couch: means the same as another"),
        (("--detector", "no-such-model", "--offline"), "no-such-model"),
        (("--start", "999"), "--start"),
        (("--map-frozen",), "--map-frozen without --map"),
    ],
)
def test_unusable_options_are_refused_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: tuple[object, ...], said: str
) -> None:
    """Before the stages run, and without an output folder."""
    out = tmp_path / "out"
    assert cli("run", ROOT / "examples/room/room.mp4", "-o", out, *option) == 2
    assert_one_clear_line(capsys, re.escape(said))
    assert not out.exists()


def boxer_file(folder: Path, rng: np.random.Generator, sigma: float = 0.0) -> Path:
    """Boxes in 3D of the five balls of `rendered_tracks` in each frame, as Boxer writes them."""
    lines = [BOXER_HEADER]
    for i, k in np.ndindex(30, 5):
        center = CENTERS[k] + sigma * rng.normal(size=3)
        size = 0.5 * np.exp(sigma * rng.normal(size=3))
        numbers = ",".join(f"{v:.9g}" for v in (*center, 1, 0, 0, 0, *size))
        lines.append(f"{round(i / 30 * 1e9)},{numbers},hassock,-1,0,0.8")
    path = folder / "boxer_3dbbs.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.usefixtures("no_points")
def test_boxes_in_3d_of_another_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Identities are ours, boxes those of the file; `objects` and `export` know them too."""
    frames, _, path = rendered_tracks(tmp_path, "right")
    out = tmp_path / "out"
    files = ("--detections", boxer_file(tmp_path, np.random.default_rng(0), 0.01))
    cameras = ("--poses", path, "--camera", "300,300,160,120")
    assert cli("run", frames, "-o", out, *files, *cameras, *QUICK) == 0
    result = rt.Result.load(out)
    assert len(result.located) == 5 and {o.class_name for o in result.located} == {"hassock"}
    refit = rt.refit(out, {"objects": {"up": "0,-1,0"}})
    for found in (result, refit):
        for o in found.located:
            off = np.linalg.norm(CENTERS - np.array(o.center), axis=1)
            assert off.min() < 0.02 and o.support == "box" and o.status == "ok"
            assert np.array(o.size) == pytest.approx(0.5, rel=0.03)
            assert np.isfinite(o.cov).all() and max(o.size_rel_sigma) < 0.07
    assert not refit.fits.prior_share.any()  # the usual size of the class is not used
    assert cli("export", out, "--to", "boxer", "-o", tmp_path / "again.csv") == 0
    assert len((tmp_path / "again.csv").read_text().splitlines()) > 1
    (tmp_path / "a.csv").write_text(re.sub("(?m),[^,]*$", "", files[1].read_text()))
    call = ("run", frames, "-o", tmp_path / "x", "--detections", tmp_path / "a.csv")
    capsys.readouterr()
    assert cli(*call, *cameras, *QUICK) == 2
    assert_one_clear_line(capsys, "3D boxes without the columns prob")


@pytest.mark.usefixtures("no_points")
def test_words_of_the_user_get_size_priors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By size, by a category, or none; the run says once which word got which."""
    frames, _, path = rendered_tracks(tmp_path, "right")
    word = ("espresso machine", "red toolbox", "extension lead", "extension lead", "chair")
    lines = (tmp_path / "det.txt").read_text().splitlines()  # five balls in each frame
    boxes = [line.split(",") for line in lines]
    rows = [[b[0], *b[2:6], "0.9", word[k % 5]] for k, b in enumerate(boxes)]
    text = "frame,left,top,width,height,score,class\n" + "\n".join(map(",".join, rows))
    (tmp_path / "det.csv").write_text(text + "\n")
    out = tmp_path / "out"
    args = ("--detections", tmp_path / "det.csv", "--poses", path, "--camera", "300,300,160,120")
    words = ("--prior", "Espresso_Machine=35x30x40 cm", "--prior", "red toolbox=luggage;vcr=tv")
    assert cli("run", frames, "-o", out, *args, *QUICK, *words) == 0
    err = capsys.readouterr().err
    assert {o.class_name for o in rt.Result.load(out).located} == set(word)
    for said in (
        "espresso machine: size prior 0.35 x 0.3 x 0.4 m (--prior)",
        "red toolbox: size prior of luggage (--prior)",
        "extension lead: no size prior",
    ):
        assert err.count(said) == 1
    assert "chair: " not in err
    assert "--prior vcr: no object of this class has a shape" in err


def test_completion(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the program that pip installs; bash itself completes a flag with it."""
    monkeypatch.setattr(sys, "argv", ["reobj-track"])
    pytest.importorskip("shtab", reason="pip install '.[completion]'")
    with pytest.raises(SystemExit):
        cli("--completion", "bash")
    ask = (
        'COMP_WORDS=(reobj-track run --kno); COMP_CWORD=2; COMP_LINE="reobj-track run --kno"; '
        "COMP_POINT=21; $(complete -p reobj-track | sed 's/.*-F \\([^ ]*\\).*/\\1/') "
        'reobj-track --kno run; echo "${COMPREPLY[@]}"'
    )
    script = f"{capsys.readouterr().out}\n{ask}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["--known-size"], done.stderr


def test_a_damaged_cache_is_computed_again(
    clip: Path, detections: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Truncated, or valid with other content: one line, and the same result."""
    out = tmp_path / "out"
    args = ("track", clip, "-o", out, "--detections", detections, "--embed", "none")
    assert cli(*args) == 0
    expected, files = (out / "tracks.txt").read_bytes(), list((out / "cache").glob("tracks-*.npz"))
    assert len(files) == 1
    whole = files[0].read_bytes()
    stored = dict(np.load(files[0]))
    other = io.BytesIO()
    np.savez(other, **(stored | {"xyxy": stored["xyxy"][:2] * np.nan}))
    for bad in (whole[:-9], b"", other.getvalue()):
        files[0].write_bytes(bad)
        capsys.readouterr()
        assert cli(*args) == 0
        warnings = capsys.readouterr().err.strip().splitlines()
        assert sum("computed again" in line for line in warnings) == 1
        assert (out / "tracks.txt").read_bytes() == expected and files[0].read_bytes() == whole
    (out / "cache/source.json").write_text("{")
    assert cli(*args, "--overwrite") == 0


def test_a_foreign_sparse_model_is_never_lost(
    clip: Path, detections: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A COLMAP workspace as output folder: --overwrite must not cost its model."""
    model = tmp_path / "out/sparse/0/cameras.bin"
    model.parent.mkdir(parents=True)
    model.write_bytes(b"precious")
    args = ("track", clip, "-o", tmp_path / "out", "--detections", detections)
    assert cli(*args, "--overwrite") == 2
    assert_one_clear_line(capsys, "sparse/ of its own")
    assert model.read_bytes() == b"precious"


@pytest.mark.usefixtures("no_points")
def test_stale_3d_files_are_deleted_when_the_options_change(tmp_path: Path) -> None:
    """A second run in 2D keeps no cameras or ellipsoids of the first."""
    args = posed_run(tmp_path, "right")
    made = ("poses.txt", "objects.ply", "sparse")
    assert cli(*args) == 0 and all((tmp_path / "out" / name).exists() for name in made)
    assert cli(*args, "--poses", "none") == 0
    assert not any((tmp_path / "out" / name).exists() for name in made)


URL = "rtsp://me:w0rd@127.0.0.1:9/cam?pwd=w0rd"


@pytest.mark.parametrize(
    "words",
    [
        ["run", URL, "-o", "out", "--offline"],
        ["run", "a.mp4", "-o", "out", f"--{URL}"],  # argparse quotes unknown arguments
        [URL],
        ["run", "a.mp4", "-o", "out", "--set", URL],
        ["objects", URL, "--debug"],
        ["eval", URL, "--gt", URL],
        ["map", "a.map", "--rename", URL, URL],
    ],
)
def test_passwords_reach_no_message(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    words: list[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    try:
        assert rt.main(words) == 2
    except SystemExit as end:
        assert end.code == 2
    said = capfd.readouterr()
    assert "error" in said.err.lower() and "w0rd" not in said.out + said.err
    assert not [p for p in tmp_path.rglob("*") if p.is_file() and b"w0rd" in p.read_bytes()]
