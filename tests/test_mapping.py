"""Reconstruction of keyframes: accuracy, refusals, zooms, the child process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from point_worlds import PointWorld, wall
from pose_worlds import DotWorld, ate_percent, sideways, textured_room

import reobj_track as rt
from reobj.cameras import read_sparse_model
from reobj.files import Progress
from reobj.poses.features import read_pairs, send_progress
from reobj.poses.keyframes import ImageFile
from reobj.poses.mapping import FOCAL_GUESS, Focal, MapperSearch, map_keyframes
from reobj.poses.sfm import Child, MappingJob, reconstruct
from reobj.poses.verification import FocalSource

pycolmap = pytest.importorskip("pycolmap")


def job_of(folder, images, ids=None, **changes):
    """A job whose frames are numbered by tens."""
    ids = range(1, len(images) + 1) if ids is None else ids
    file = ImageFile(folder / "keyframes.raw")
    for number, image in zip(ids, images, strict=True):
        file.add(number, image)
    return MappingJob(
        **{
            "images": file,
            "frame_of": {i: 10 * i for i in ids},
            "name_of": {i: f"{i - 1:03d}.jpg" for i in ids},
            "boxes_of": dict.fromkeys(ids, np.empty((0, 4))),
            "size": images[0].shape[1::-1],
            "camera": None,
            "focal_guess": FOCAL_GUESS,
            "is_video": True,
            "seed": 0,
            "view_of": {},
        }
        | changes
    )


def run(folder, images, progress=Progress, **changes):
    """Reconstruct; messages, and the models of all components."""
    with Child(folder / "mapping", folder / "pycolmap.log") as child:
        mapped = reconstruct(job_of(folder, images, **changes), child, progress)
    return mapped.messages, [read_sparse_model(model) for model in mapped.models]


def truth_of(model, poses):
    return poses[[int(name[:3]) for name in model.names]]


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Eight views of a corner of a room, their true poses, steps, messages, model."""
    images, truth = textured_room(8, 0.45, -3, size=(320, 240))
    steps = []

    def note(step, total):
        steps.append(step)
        return Progress(step, total)

    messages, (model,) = run(tmp_path_factory.mktemp("mapping"), images, note)
    return images, truth, steps, messages, model


def test_a_walk_is_reconstructed_with_its_focal_length_and_colours(walk):
    images, truth, steps, messages, model = walk
    assert messages == [] and model.names == tuple(f"{i:03d}.jpg" for i in range(8))
    assert ate_percent(model.cam_from_world, truth_of(model, truth)) < 1.0
    assert model.cameras[0].K[0, 0] == pytest.approx(0.9 * 320, rel=0.03)
    x, y = np.floor(model.obs_xy).astype(int).T
    pixels = np.array(images)[model.obs_image, y, x, ::-1]
    same = (pixels == model.colors[model.obs_point]).all(1)  # (M,)
    assert len(model.points) > 300 and set(model.obs_point[same]) == set(range(len(model.points)))
    assert steps[:4] == ["features", "match", "mapping", "adjusting"]


def test_a_given_camera_is_kept_and_boxes_have_no_features(walk, tmp_path):
    """Both in pixels of frames twice as large; the boxes are the left quarter."""
    images, truth, *_ = walk
    camera = rt.Camera("OPENCV", 640, 480, (576.0, 576.0, 320.0, 240.0, 0, 0, 0, 0))
    boxes = dict.fromkeys(range(1, 9), np.array([[0, 0, 160.0, 480]]))
    messages, (model,) = run(tmp_path, images, size=(640, 480), camera=camera, boxes_of=boxes)
    assert messages == [] and model.cameras[0] == camera
    assert ate_percent(model.cam_from_world, truth_of(model, truth)) < 1.0
    assert model.obs_xy.max() > 340 and model.obs_xy[:, 0].min() > 150


def test_features_lie_on_the_dots(tmp_path):
    """Dots at known positions. OpenCV's SIFT is off by a quarter of a pixel (it halves the
    coordinates of an upsampled image); COLMAP's half pixel is a separate convention.
    """
    world = DotWorld(count=700)
    angles = np.linspace(-0.1, 0.1, 8)
    cams = np.array([
        [[np.cos(a), 0, -np.sin(a), -8 * a], [0, 1, 0, 0.05 * i], [np.sin(a), 0, np.cos(a), 0]]
        for i, a in enumerate(angles)
    ])  # fmt: skip
    _, (model,) = run(tmp_path, [world.image(c) for c in cams], camera=world.camera)
    off = []
    for image, name in enumerate(model.names):
        xy, _ = world.project(cams[int(name[:3])])
        for seen in model.obs_xy[model.obs_image == image]:
            off.append(seen - xy[np.linalg.norm(xy - seen, axis=1).argmin()])
    assert len(off) > 100
    np.testing.assert_allclose(np.median(off, axis=0), 0.25, atol=0.1)


@pytest.mark.slow
def test_two_rooms_come_as_two_components(tmp_path):
    """The larger one comes first; the better of two cameras is used for both."""
    one, truth = textured_room(12, 0.45, -3, size=(320, 240))
    other, _ = textured_room(10, 0.45, -3, seed=5, size=(320, 240))
    messages, (first, second) = run(tmp_path, other + one)
    assert messages == [] and len(first.names) == 12
    assert set(second.names) == {f"{i:03d}.jpg" for i in range(10)}
    assert ate_percent(first.cam_from_world, truth_of(first, np.r_[truth[:10], truth])) < 1.0
    assert len({*first.cameras, *second.cameras}) == 1


def noise(count):
    return list(np.random.default_rng(0).integers(0, 255, (count, 240, 320, 3), np.uint8))


@pytest.mark.parametrize(
    "images, message",
    [
        (lambda walk: walk[:2], "only 2 different views"),
        (lambda walk: noise(6), "no pair of keyframes|keyframes connect"),
        (lambda walk: walk + noise(10), "of 18 keyframes connect"),
    ],
)
def test_scenes_without_depth_are_refused_with_a_remedy(walk, tmp_path, images, message):
    messages, models = run(tmp_path, images(walk[0]))
    assert models == [] and len(messages) == 1 and "--poses" in messages[0]
    assert any(part in messages[0] for part in message.split("|")), messages


def test_with_more_keyframes_only_new_work_is_done(walk, tmp_path):
    """Every second view first, then all: 4 more images, and 28 pairs minus the 6 matched ones."""
    totals = []

    def note(stage, total):
        totals.append((stage, total))
        return Progress(stage, total)

    with Child(tmp_path / "mapping", tmp_path / "log") as child:
        every = job_of(tmp_path, walk[0])
        first = replace(every, frame_of={i: 10 * i for i in range(1, 9, 2)})
        view_of = reconstruct(first, child, note).view_of
        mapped = reconstruct(replace(every, view_of=view_of), child, note)
    found = [entry for entry in totals if entry[0] in ("features", "match")]
    assert found == [("features", 4), ("match", 6), ("features", 4), ("match", 22)]
    model = read_sparse_model(mapped.models[0])
    assert ate_percent(model.cam_from_world, truth_of(model, walk[1])) < 1.0


# ---- Focal lengths, on points with known poses ---------------------------------------------------


def search_of(folder, world, focal, guess=0.9):
    """A search for models of all images of a world of points; frames are numbered by tens."""
    database = folder / "database.db"
    ids = range(1, len(world.cams) + 1)
    world.write(database, ids, world.pairs())
    return MapperSearch(database, {i: 10 * i for i in ids}, read_pairs(database), focal, guess, 0)


def zoomed_walk(first, last, ratio=1.4, count=40):
    """Views of a wall; those of some images are magnified about the principal point."""
    world = PointWorld(sideways(count, 0.35), wall(0.35 * count, per_metre=100))
    centre = np.array(world.size) / 2
    for k in range(first - 1, last):
        xy = centre + ratio * (world.xy[k] - centre)
        inside = ((xy > 0) & (xy < world.size)).all(1)
        world.xy[k] = xy[inside]
        world.observed[k] = world.observed[k][inside]
    return world


@pytest.mark.slow
def test_a_zoom_leaves_the_images_of_one_focal_length_and_is_reported(tmp_path):
    focal = Focal(430 / 480, FocalSource.MATCHES)
    models, messages, *_ = map_keyframes(search_of(tmp_path, zoomed_walk(29, 40), focal))
    assert models and max(i for model in models for i in model.reg_image_ids()) <= 29
    assert any("the focal length changed between frames" in text for text in messages)
    assert models[0].camera(1).mean_focal_length() == pytest.approx(430, rel=0.03)


def test_an_undetermined_focal_length_is_kept_and_reported(tmp_path):
    """A dolly along a wall of constant depth fits any focal length by scaling the depths."""
    cams = np.tile(np.eye(3, 4), (12, 1, 1))
    cams[:, 0, 3] = -0.35 * np.arange(12)
    world = PointWorld(cams, wall(4.2, per_metre=60))
    search = search_of(tmp_path, world, Focal(0.8, FocalSource.GUESS))
    _, messages, *_ = map_keyframes(search)
    assert any("do not determine the focal length" in text and "--camera" in text
               for text in messages)  # fmt: skip


# ---- The child process ---------------------------------------------------------------------------


def test_the_child_starts_from_any_folder(walk, tmp_path, monkeypatch):
    """From a working directory with modules of the same names, and with a user's PYTHONPATH."""
    for name in ("reobj", "numpy", "pycolmap"):
        (tmp_path / "here" / name).mkdir(parents=True)
        (tmp_path / "here" / name / "__init__.py").write_text("raise SystemExit(3)")
    (tmp_path / "theirs" / "reobj").mkdir(parents=True)
    (tmp_path / "theirs" / "reobj" / "__init__.py").write_text("raise SystemExit(4)")
    code = f"open({str(tmp_path / 'note')!r}, 'w').write('was here')"  # it may contain pycolmap
    (tmp_path / "theirs" / "sitecustomize.py").write_text(code)
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "theirs"))
    messages, _ = run(Path("out"), walk[0][:3])  # a relative folder
    assert not [text for text in messages if "stopped" in text]
    assert (tmp_path / "note").read_text() == "was here"


@dataclass
class Abort:
    """A job whose process is ended by a signal, as an abort of COLMAP does it."""

    def work(self, folder):
        os.kill(os.getpid(), signal.SIGABRT)


@dataclass
class Sleep:
    """A job that shows a step, notes its process and says nothing for some seconds."""

    seconds: float

    def work(self, folder):
        send_progress("second mapper", 0, 0)
        (folder.parent / "pid").write_text(str(os.getpid()))
        time.sleep(self.seconds)
        return "done"


@pytest.fixture
def importable(monkeypatch):
    """The child can import the jobs of this file."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))


def test_an_aborted_child_is_reported(importable, tmp_path):
    with Child(tmp_path / "mapping", tmp_path / "log") as child:
        found = child.run(Abort(), Progress)
    assert found.startswith("stopped (signal 6)") and str(tmp_path / "log") in found


def test_a_silent_child_is_shown_to_work(importable, tmp_path, monkeypatch, capsys):
    """One call of COLMAP takes minutes, after the last image is mapped."""
    monkeypatch.setenv("REOBJ_PROGRESS_S", "0.2")
    with Child(tmp_path / "mapping", tmp_path / "log") as child:
        assert child.run(Sleep(1.2), Progress) == "done"
    lines = capsys.readouterr().err.splitlines()
    assert any(line.startswith("second mapper:") and "[00:0" in line for line in lines)


PARENT = """
from pathlib import Path
from reobj.files import Progress
from reobj.poses.sfm import Child
from test_mapping import Sleep
with Child(Path("work/mapping"), Path("work/log")) as child:
    child.run(Sleep(60), Progress)
"""


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM])
def test_the_child_ends_with_its_parent(tmp_path, ending):
    """Also during a job."""
    folders = (str(Path(__file__).parent), str(Path(rt.__file__).parent))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(folders)}
    (tmp_path / "work").mkdir()
    parent = subprocess.Popen([sys.executable, "-c", PARENT], cwd=tmp_path, env=environment)
    noted, deadline = tmp_path / "work/pid", time.monotonic() + 60
    while not noted.exists() or not noted.read_text():
        assert time.monotonic() < deadline and parent.poll() is None
        time.sleep(0.01)
    parent.send_signal(ending)
    parent.wait()
    child = Path("/proc") / noted.read_text()
    while child.exists() and "\tZ" not in (child / "status").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.01)
