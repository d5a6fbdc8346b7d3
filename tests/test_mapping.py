"""Reconstruction of keyframes: accuracy, refusals, the child process, interrupted runs."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pose_worlds import DotWorld, ate_percent, textured_room
from test_consistency import fundamental

import reobj_track as rt
from reobj.cameras import read_sparse_model
from reobj.files import Progress, locked
from reobj.poses import child_job, mapping, sfm
from reobj.poses.features import MatchedPairs
from reobj.poses.mapping import FOCAL_GUESS, Focal, MapperSearch
from reobj.poses.sfm import mapping_child, reconstruct
from reobj.poses.verification import Component, FocalSource

pycolmap = pytest.importorskip("pycolmap")


def models_of(folder, images, boxes=None, size=None, camera=None, guess=FOCAL_GUESS, **changes):
    """Reconstruct; messages, and the models of all components."""
    ids = changes.pop("ids", range(1, len(images) + 1))
    options = {"seed": 0, "progress": Progress} | changes
    file = child_job.ImageFile(folder / "keyframes.raw")
    for image in images:
        file.append(image)
    with mapping_child(folder) as child:
        mapped = reconstruct(
            file,
            ids,
            [10 * i for i in ids],
            [f"{i - 1:03d}.jpg" for i in ids],
            [np.empty((0, 4))] * len(images) if boxes is None else boxes,
            size or images[0].shape[1::-1],
            camera=camera,
            focal_guess=guess,
            is_video=True,
            child=child,
            work_dir=folder,
            **options,
        )
    names = ["sparse", *(f"sparse_part{k}" for k in range(1, len(mapped.models)))]
    assert mapped.models == [folder / name for name in names[: len(mapped.models)]]
    assert sorted(folder.glob("sparse*")) == sorted(mapped.models)
    return mapped.messages, [read_sparse_model(model) for model in mapped.models]


def run(*args, **options):
    """Reconstruct; messages, and the largest model or None."""
    messages, models = models_of(*args, **options)
    return messages, models[0] if models else None


def truth_of(model, poses):
    return poses[[int(name[:3]) for name in model.names]]


# ---- Reconstruction ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Eight views of a corner of a room, their true poses, folder, messages, model."""
    images, truth = textured_room(8, 0.45, -3, size=(320, 240))
    folder = tmp_path_factory.mktemp("mapping")
    return images, truth, folder, *run(folder, images)


def test_a_walk_is_reconstructed_with_its_focal_length(walk):
    _, truth, folder, messages, model = walk
    assert messages == [] and model.names == tuple(f"{i:03d}.jpg" for i in range(8))
    assert ate_percent(model.cam_from_world, truth_of(model, truth)) < 1.0
    assert model.cameras[0].K[0, 0] == pytest.approx(0.9 * 320, rel=0.03)
    assert len(model.points) > 300 and (folder / "pycolmap.log").stat().st_size > 0


def test_points_have_the_colour_of_their_pixels(walk):
    images, _, _, _, model = walk
    x, y = np.floor(model.obs_xy).astype(int).T
    pixels = np.array(images)[model.obs_image, y, x, ::-1]
    same = (pixels == model.colors[model.obs_point]).all(1)  # (M,)
    assert set(model.obs_point[same]) == set(range(len(model.points)))


def test_another_seed_gives_other_bytes(walk, tmp_path):
    """The same seed gives the same bytes: `test_a_killed_run_resumes`."""
    images, _, folder, *_ = walk
    run(tmp_path, images, seed=7)
    found = (tmp_path / "sparse" / "points3D.bin").read_bytes()
    assert (folder / "sparse" / "points3D.bin").read_bytes() != found


def test_calibration_starts_from_the_focal_guess_and_leaves_it(walk, tmp_path):
    """Other bits, the same focal length."""
    images, _, _, _, model = walk
    messages, other = run(tmp_path, images, guess=1.1)
    assert messages == [] and (other.cam_from_world != model.cam_from_world).any()
    assert other.cameras[0].K[0, 0] == pytest.approx(model.cameras[0].K[0, 0], rel=0.01)


def arc(count, half_rad):
    """cam_from_world (F, 3, 4) of a camera that looks inward from an arc."""
    cams = np.zeros((count, 3, 4))
    for i, a in enumerate(np.linspace(-half_rad, half_rad, count)):
        c, s = np.cos(a), np.sin(a)
        cams[i] = [[c, 0, -s, -8 * a], [0, 1, 0, 0.05 * i], [s, 0, c, 0]]
    return cams


GUESS, MATCHES = Focal(0.8, FocalSource.GUESS), Focal(0.8, FocalSource.MATCHES)


@pytest.fixture
def search(monkeypatch):
    """A model search over 30 keyframes with mapper outputs set by the test: `search.made`."""
    pairs = MatchedPairs(
        np.column_stack([np.arange(1, 30), np.arange(2, 31)]),  # a path
        [np.zeros((34, 2))] * 29,
        dict.fromkeys(range(1, 31)),
        np.ones((29, 3, 3)),
    )
    frames = {i: 10 * i for i in range(1, 31)}
    search = MapperSearch(Path("database.db"), frames, pairs, GUESS, 0.8, 0)
    search.made, search.ran = [], []

    def components(mapper, keep_intrinsics):
        search.ran.append((mapper, keep_intrinsics))
        return search.made

    monkeypatch.setattr(mapping, "_set_focal", lambda *_: None)
    monkeypatch.setattr(mapping, "constant_focal", lambda *_: (np.empty(0), []))
    monkeypatch.setattr(search, "_components", components)
    monkeypatch.setattr(mapping, "models_of_one_camera", lambda sound: [c.model for c in sound])
    return search


def component(first=1, last=30, calibrated=True, sigma=0.0005, problem="", focal=0.8):
    camera = SimpleNamespace(width=640, height=480)
    arrays = SimpleNamespace(ids=np.arange(first, last + 1), focal_over_size=focal, camera=camera)
    source = FocalSource.MODEL if calibrated else FocalSource.GUESS
    measures = 2.4, (last - first + 1) / 30, 20.0, sigma, 1000
    return Component("model", arrays, source, *measures, problem, arrays.ids)


def test_an_undetermined_focal_length_is_kept_and_reported(search):
    """No mapper's model determines it: the guess is kept with a warning."""
    search.made = [component(calibrated=False)]
    _, (message,), _ = search.run()
    assert message.startswith("frames 10-300 do not determine the focal length")
    assert "assumed to be 0.8 x" in message and "--camera" in message
    assert search.ran == [("incremental", False), ("incremental", True)]


def test_a_refused_component_is_reported_with_the_reason(search, monkeypatch):
    monkeypatch.setattr(mapping, "confirmed", lambda components, *_: components)
    still = component(16, 27, problem="the camera hardly moved")
    search.made = [component(1, 15), still, component(28, 30)]
    search.focal = MATCHES
    models, _, messages = search.run()
    assert models == ["model"] * 2 and search.ran == [("incremental", True), ("global", True)]
    assert messages == ["frames 160-270 have no poses: the camera hardly moved"]


def test_a_complete_global_model_needs_no_confirmation(search, monkeypatch):
    """As on hololens_kitchen: the incremental mapper gives pieces, the global one all images."""
    pieces = [component(1, 15), component(16, 30, sigma=0.003)]
    made = {"incremental": pieces, "global": [component()]}
    monkeypatch.setattr(search, "_components", lambda mapper, keep_intrinsics: made[mapper])
    matches = sum(c.explained for c in made["global"])
    search.pairs = replace(search.pairs, inliers=[np.zeros((matches, 2), np.int64)])
    search.focal = MATCHES
    best, messages = search._best()
    assert best is made["global"] and messages == []


@pytest.mark.parametrize(
    "focal, sigma, count", [(0.82, 0.0011, 1), (0.9, 0.0011, 2), (0.9, 9e-4, 1)]
)
def test_weak_geometry_needs_matches_or_another_mapper(search, monkeypatch, focal, sigma, count):
    """The matches determine the focal length without any model."""
    monkeypatch.setattr(mapping, "confirmed", lambda components, *_: components)
    search.made = [component(sigma=sigma, focal=focal)]
    search.focal = MATCHES
    search.run()
    assert len(search.ran) == count


def test_a_second_mapper_with_a_fixed_focal_length_does_not_confirm_it(search, monkeypatch):
    """The first model and the matches give different focal lengths: one is wrong."""
    first, second = component(sigma=0.0011, focal=0.9), component(sigma=0.00102)
    made = {"incremental": [first], "global": [second]}
    asked = []
    monkeypatch.setattr(search, "_components", lambda mapper, keep_intrinsics: made[mapper])
    monkeypatch.setattr(mapping, "confirmed", lambda made, *_: asked.append(made) or made)
    search.focal = MATCHES
    search._best()
    assert asked == [made["incremental"], made["global"]]


def test_a_zoom_in_a_refused_component_removes_no_images(search, monkeypatch):
    """Its points have too little parallax; it is checked only if no other component is sound."""
    asked = []
    monkeypatch.setattr(mapping, "confirmed", lambda components, *_: components)
    monkeypatch.setattr(
        mapping, "constant_focal", lambda a, _: (asked.append(a) or np.empty(0), [])
    )
    good, bad = component(1, 15), component(16, 30, problem="the camera hardly moved")
    search.focal = MATCHES
    for made in ([good, bad], [bad]):
        search.made = made
        search.run()
    assert asked == [[good.arrays], [bad.arrays]]


def test_a_focal_length_that_keeps_changing_is_refused(search, monkeypatch):
    found = iter([[1], [2], [3], [4]])
    changes = [(4, 5, 1.3)]
    monkeypatch.setattr(mapping, "constant_focal", lambda *_: (np.array(next(found)), changes))
    search.made = [component()]
    search.focal = MATCHES
    models, _, (message,) = search.run()
    assert models == [] and "the focal length keeps changing" in message
    assert len(search.ran) == 3


def test_photos_without_an_order_have_no_zoom(search, monkeypatch):
    """The photo before one in the list does not show the same points: their errors are no zoom."""
    asked = []
    monkeypatch.setattr(
        mapping, "constant_focal", lambda a, _: (asked.append(a) or np.array([1]), [(1, 2, 1.4)])
    )
    ids = np.column_stack([np.arange(1, 21), np.arange(10, 30)])  # photos 9 apart match
    matches = [np.zeros((50, 2), np.int64)] * 20
    keypoints = dict.fromkeys(range(1, 31))
    search.pairs = MatchedPairs(ids, matches, keypoints, fundamental(0.9, 20), False)
    search.focal = MATCHES
    search.made = [component(1, 30)]
    models, messages, _ = search.run()
    assert asked == [] and messages == [] and len(models) == 1


def test_after_a_zoom_the_kept_images_determine_the_focal_length(search, monkeypatch):
    """Matches between images of two focal lengths give an intermediate one."""
    ids = np.column_stack([np.arange(1, 21), np.arange(2, 22)])[np.arange(40) % 20]
    matches = [np.zeros((50, 2), np.int64)] * 40
    keypoints = dict.fromkeys(range(1, 31))
    search.pairs = MatchedPairs(ids, matches, keypoints, fundamental(1.1, 40))
    found = iter([(np.array([22, 23]), [(21, 22, 1.4)]), (np.empty(0), [])])
    monkeypatch.setattr(mapping, "constant_focal", lambda *_: next(found))
    search.made = [component(1, 21)]
    search.focal = Focal(0.9, FocalSource.MATCHES)
    search.run()
    assert search.focal.value == pytest.approx(1.1, rel=0.02)
    assert search.focal.source is FocalSource.MATCHES


@pytest.mark.parametrize(
    "focal, calibrated, kept", [(0.8, True, True), (1.1, True, False), (0.8, False, False)]
)
def test_a_zoom_with_a_given_camera_keeps_its_focal_length(
    search, monkeypatch, focal, calibrated, kept
):
    """Images of one focal length are dropped; the kept ones may be the zoomed ones."""
    found = iter([(np.array([22, 23]), [(21, 22, 1.4)]), (np.empty(0), [])])
    arrays = SimpleNamespace(focal_over_size=focal)
    freed = SimpleNamespace(arrays=arrays, calibrated=calibrated)
    monkeypatch.setattr(mapping, "constant_focal", lambda *_: next(found))
    monkeypatch.setattr(mapping, "adjusted", lambda model, calibrate: freed)
    search.focal, search.made = Focal(0.8, FocalSource.GIVEN), [component(1, 21)]
    models, *messages = search.run()
    assert (len(models) == 1) == kept
    what = "between frames 210 and 220" if kept else "another focal length than that of the given"
    assert any(what in message for message in itertools.chain(*messages))


def test_a_given_camera_is_kept(walk, tmp_path):
    images, truth, *_ = walk
    camera = rt.Camera("OPENCV", 640, 480, (576.0, 576.0, 320.0, 240.0, 0, 0, 0, 0))
    messages, model = run(tmp_path, images, size=(640, 480), camera=camera)
    assert messages == [] and model.cameras[0] == camera
    assert ate_percent(model.cam_from_world, truth_of(model, truth)) < 1.0
    assert model.obs_xy.max() > 340  # native pixels


def test_boxes_of_moving_objects_have_no_features(walk, tmp_path):
    """The left quarter, given in pixels of frames twice as large."""
    images = walk[0]
    boxes = [np.array([[0, 0, 160.0, 480]])] * len(images)
    _, model = run(tmp_path, images, boxes, size=(640, 480))
    assert len(model.obs_xy) > 300 and model.obs_xy[:, 0].min() > 150


def test_features_lie_on_the_dots(tmp_path):
    """Dots at known positions. OpenCV's SIFT is off by a quarter of a pixel (it halves the
    coordinates of an upsampled image); COLMAP's half pixel is a separate convention.
    """
    world = DotWorld(count=700)
    cams = arc(8, 0.1)
    _, model = run(tmp_path, [world.image(c) for c in cams], camera=world.camera)
    off = []
    for image, name in enumerate(model.names):
        xy, _ = world.project(cams[int(name[:3])])
        for seen in model.obs_xy[model.obs_image == image]:
            nearest = np.linalg.norm(xy - seen, axis=1).argmin()
            off.append(seen - xy[nearest])
    assert len(off) > 100
    np.testing.assert_allclose(np.median(off, axis=0), 0.25, atol=0.1)


# ---- Refusals ------------------------------------------------------------------------------------

TURNED = "camera only rotates|initialises a model|keyframes connect"
# images, words of the message
REFUSED = {
    "two images": (lambda: textured_room(2, 0.5)[0], "only 2 different views"),
    "noise": (
        lambda: list(np.random.default_rng(0).integers(0, 255, (6, 240, 320, 3), np.uint8)),
        "no pair of keyframes|keyframes connect",
    ),
    "turn with little motion": (
        lambda: textured_room(8, 0.005, 4, size=(320, 240))[0],
        TURNED,
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_scenes_without_depth_are_refused_with_a_remedy(tmp_path, name):
    images, message = REFUSED[name]
    messages, model = run(tmp_path, images())
    assert model is None and len(messages) == 1 and "--poses" in messages[0]
    assert any(part in messages[0] for part in message.split("|")), messages


def test_images_that_do_not_connect_are_refused(walk, tmp_path):
    rng = np.random.default_rng(0)
    noise = list(rng.integers(0, 255, (10, 240, 320, 3), np.uint8))
    messages, model = run(tmp_path, walk[0] + noise)
    assert model is None and "of 18 keyframes connect" in messages[0]


# ---- The child process ---------------------------------------------------------------------------


def test_the_child_starts_from_any_folder(walk, tmp_path, monkeypatch):
    """From a working directory with modules of the same names, and with a user's PYTHONPATH."""
    for name in ("reobj", "numpy", "pycolmap"):
        (tmp_path / "here" / name).mkdir(parents=True)
        (tmp_path / "here" / name / "__init__.py").write_text("raise SystemExit(3)")
    (tmp_path / "theirs" / "reobj").mkdir(parents=True)
    (tmp_path / "theirs" / "reobj" / "__init__.py").write_text("raise SystemExit(4)")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "theirs"))
    messages, _ = run(Path("out"), walk[0][:3])  # a relative folder
    assert not [text for text in messages if "stopped" in text]
    assert Path("out/mapping/messages.json").exists()  # the job was done


def test_the_users_pythonpath_reaches_the_child(walk, tmp_path, monkeypatch):
    """It may contain pycolmap."""
    note = tmp_path / "note"
    (tmp_path / "sitecustomize.py").write_text(f"open({str(note)!r}, 'w').write('was here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    run(tmp_path / "out", walk[0][:3])
    assert note.read_text() == "was here"


def test_packages_are_imported_while_the_child_maps(tmp_path, monkeypatch):
    """Not earlier: before mapping the child uses all cores. Missing packages are skipped."""
    stages, imported = [], []

    def import_module(name):
        imported.append((name, list(stages)))
        raise ImportError(name)

    def run(progress):
        for stage in ("features", "match", "mapping", "adjusting", "mapping"):
            stages.append(stage)
            progress(stage, 5).close()
        return "stopped"

    monkeypatch.setattr(sfm.importlib, "import_module", import_module)
    monkeypatch.setattr(child_job.Child, "run", lambda _, progress: run(progress))
    messages, _ = models_of(tmp_path, [np.zeros((48, 64, 3), np.uint8)] * 3)
    assert "stopped" in messages[0]
    assert [name for name, _ in imported] == ["onnxruntime", "filterpy.kalman", "av"]
    assert imported[0][1][:3] == ["features", "match", "mapping"]


def test_an_aborted_child_is_reported(walk, tmp_path, monkeypatch):
    script = tmp_path / "abort.sh"
    script.write_text("#!/bin/sh\nkill -ABRT $$\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    messages, model = run(tmp_path, walk[0])
    assert model is None and "signal 6" in messages[0] and "pycolmap.log" in messages[0]


def test_a_killed_run_resumes(walk, tmp_path):
    """The second run reuses features and matches of the first and gives the same bytes."""
    images, _, folder, *_ = walk
    started: list[str] = []
    again = ["features", "match", "mapping", "mapping", "features"]

    def note(stage, total):
        if stage in ("adjusting", "mapping again", "second mapper"):  # of the same search
            return Progress(stage, total)
        started.append(stage)
        if started in (["features", "match", "mapping"], again):
            raise KeyboardInterrupt
        return Progress(stage, total)

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, images, progress=note)
    assert started == ["features", "match", "mapping"]
    run(tmp_path, images, progress=note)
    assert started[3:] == ["mapping"]
    sparse = [f / "sparse" / "points3D.bin" for f in (tmp_path, folder)]
    assert sparse[0].read_bytes() == sparse[1].read_bytes()
    with pytest.raises(KeyboardInterrupt):  # other input: from the start
        run(tmp_path, images, seed=1, progress=note)


def test_with_more_keyframes_only_new_work_is_done(walk, tmp_path):
    """Every second view first, then all: 4 more images, and 28 pairs minus the 6 cached ones."""
    totals: list[tuple[str, int]] = []

    def note(stage, total):
        totals.append((stage, total))
        return Progress(stage, total)

    def until_mapping(stage, total):
        if stage.startswith("mapping"):
            raise KeyboardInterrupt
        return note(stage, total)

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, walk[0][::2], ids=range(1, 9, 2), progress=until_mapping)
    messages, model = run(tmp_path, walk[0], progress=note)
    found = [entry for entry in totals if entry[0] in ("features", "match")]
    assert found == [("features", 4), ("match", 6), ("features", 4), ("match", 22)]
    assert messages == [] and ate_percent(model.cam_from_world, truth_of(model, walk[1])) < 1.0
    with pytest.raises(KeyboardInterrupt):  # other images under the same ids
        run(tmp_path, walk[0][::-1], progress=until_mapping)
    again = [entry for entry in totals if entry[0] in ("features", "match")]
    assert again[4:] == [("features", 8), ("match", 28)]


def test_two_rooms_come_as_two_components(tmp_path):
    """The larger one comes first; the better of two cameras is used for both."""
    one, truth = textured_room(12, 0.45, -3, size=(320, 240))
    other, _ = textured_room(10, 0.45, -3, seed=5, size=(320, 240))
    messages, models = models_of(tmp_path, other + one)
    assert messages == [] and [len(model.names) for model in models] == [12, 10]
    first, second = models
    assert set(second.names) == {f"{i:03d}.jpg" for i in range(10)}
    assert ate_percent(first.cam_from_world, truth_of(first, np.r_[truth[:10], truth])) < 1.0
    assert len({*first.cameras, *second.cameras}) == 1


SLEEPER = """
import sys, time
from pathlib import Path
from reobj.poses.child_job import Child, serve
def job(folder):
    Path(sys.argv[1]).with_name("pid").write_text(str(__import__("os").getpid()))
    time.sleep(60)
if __name__ == "__main__":
    serve(job)
"""
PARENT = """
from pathlib import Path
from reobj.files import Progress
from reobj.poses.child_job import Child
with Child("sleeper", Path("work/mapping"), Path("work/log")) as child:
    child.run(Progress)
"""


SILENT = """
import time
from reobj.poses.child_job import send_progress, serve
def job(folder):
    send_progress("mapping", 3, 3)
    send_progress("second mapper", 0, 0)
    time.sleep(3)
if __name__ == "__main__":
    serve(job)
"""


def test_a_silent_child_is_shown_to_work(tmp_path, monkeypatch, capsys):
    """One call of COLMAP takes minutes, after the last image is mapped."""
    (tmp_path / "silent.py").write_text(SILENT)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("REOBJ_PROGRESS_S", "0.4")
    with child_job.Child("silent", tmp_path / "work/mapping", tmp_path / "work/log") as child:
        assert child.run(Progress) == ""
    lines = capsys.readouterr().err.splitlines()
    assert sum("so far" in line for line in lines) >= 3
    assert all(line.startswith("second mapper ") for line in lines) and "3.0 s" in lines[-1]


def test_what_follows_the_last_image_has_its_own_step(walk, tmp_path):
    steps: list[str] = []

    def note(step, total):
        steps.append(step)
        return Progress(step, total)

    run(tmp_path, walk[0], progress=note)
    assert steps[:4] == ["features", "match", "mapping", "adjusting"]
    assert set(steps[4:]) <= {"mapping again", "second mapper", "adjusting"}


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("platform", ["linux", "other"])
def test_the_child_ends_with_its_parent(tmp_path, ending, platform):
    """Also during a job; the next process waits until the folder is unlocked."""
    code = SLEEPER.replace("import sys, time", f"import sys, time; sys.platform = {platform!r}")
    (tmp_path / "sleeper.py").write_text(code)
    root = str(Path(rt.__file__).parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), root])}
    parent = subprocess.Popen([sys.executable, "-c", PARENT], cwd=tmp_path, env=environment)
    noted, deadline = tmp_path / "work/pid", time.monotonic() + 60
    while not noted.exists() or not noted.read_text():
        assert time.monotonic() < deadline and parent.poll() is None
        time.sleep(0.01)
    with pytest.raises(
        rt.ReobjError, match=r"work: a reconstruction is still running in this folder"
    ):
        child_job.Child("sleeper", tmp_path / "work/mapping", tmp_path / "work/log2", wait_s=0.1)
    parent.send_signal(ending)
    parent.wait()
    with locked(tmp_path / "work/mapping.lock", 10.0):  # held as long as the child lives
        pass


def test_a_damaged_job_file_restarts_the_job(walk, tmp_path, caplog):
    shutil.copytree(walk[2], tmp_path / "out")
    (tmp_path / "out/mapping/job.json").write_text('{"camera"')
    again = run(tmp_path / "out", walk[0])
    assert again[0] == [] and again[1] is not None
    assert "job.json" in caplog.text and "computed again" in caplog.text
