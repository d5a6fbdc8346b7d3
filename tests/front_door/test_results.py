"""Results of any kind are written, drawn and exported, or refused in one line."""

from __future__ import annotations

import base64
import csv
import dataclasses
import errno
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from simulated import SIZE, fitted, tracks_of, unlinked, walk, with_fitted_covariance

import reobj_track as rt
from front_door.room import ROOM, cli
from reobj.results import overlay, scene
from reobj.results.export import EXPORTS
from reobj.results.result import VideoInfo
from reobj.results.scene import write_pictures
from reobj.results.workspace import Workspace

FRAMES = 6


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> rt.Video:
    """A folder of grey images, of the walk's size."""
    folder = tmp_path_factory.mktemp("source") / "frames"
    folder.mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.full((*SIZE[::-1], 3), 127, np.uint8))
    return rt.Video(folder)


@pytest.fixture(scope="module")
def plain() -> rt.Result:
    """Three chairs in six frames, one box, one cylinder, one ellipsoid; copy before changes."""
    poses = walk(FRAMES)
    result = fitted(tracks_of(poses), poses)
    kinds = zip(result.objects, ("box", "cylinder", "ellipsoid"), strict=True)
    result = dataclasses.replace(
        result, objects=[dataclasses.replace(o, support=kind) for o, kind in kinds]
    )
    return result


def nothing(result: rt.Result) -> rt.Result:
    return rt.Result(rt.Tracks.empty(), (), result.video)


def cameras_alone(result: rt.Result) -> rt.Result:
    world = dataclasses.replace(result.world, links=())
    return rt.Result(rt.Tracks.empty(), (), result.video, poses=result.poses, world=world)


def no_cameras(result: rt.Result) -> rt.Result:
    return fitted(result.tracks, None)


def with_poses(result: rt.Result, cams: np.ndarray, **changes: Any) -> rt.Result:
    assert result.poses is not None
    poses = dataclasses.replace(result.poses, cam_from_world=cams, **changes)
    return dataclasses.replace(result, poses=poses)


def cameras_nan(result: rt.Result) -> rt.Result:
    return with_poses(result, np.full_like(result.poses.cam_from_world, np.nan))


def some_cameras_nan(result: rt.Result) -> rt.Result:
    cams = result.poses.cam_from_world.copy()
    cams[::2] = np.nan
    return with_poses(result, cams)


def behind(result: rt.Result) -> rt.Result:
    return with_poses(result, np.diag([-1.0, 1, -1]) @ result.poses.cam_from_world)


def in_an_object(result: rt.Result) -> rt.Result:
    cams = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    cams[:, :, 3] = -result.objects[0].center
    return with_poses(result, cams)


def far_away(result: rt.Result) -> rt.Result:
    """In the coordinates of a map projection."""
    away = np.array([450000.0, 5400000, 160])
    cams = result.poses.cam_from_world.copy()
    cams[:, :, 3] -= cams[:, :, :3] @ away
    moved = dataclasses.replace(with_poses(result, cams), fits=None)
    moved = dataclasses.replace(
        moved, objects=[dataclasses.replace(o, center=o.center + away) for o in result.objects]
    )
    return moved


def fisheye(result: rt.Result) -> rt.Result:
    camera = rt.Camera("OPENCV_FISHEYE", *SIZE, (300.0, 300, 320, 240, 0.01, 0, 0, 0))
    return dataclasses.replace(result, poses=dataclasses.replace(result.poses, camera=camera))


def with_objects(result: rt.Result, **changes: Any) -> rt.Result:
    objects = [dataclasses.replace(o, **changes) for o in result.objects]
    return dataclasses.replace(result, objects=objects, fits=None)


NO_SOLID = dict.fromkeys(("support", "center", "half_axes", "quat_wxyz", "size", "size_m",
                          "size_rel_sigma", "cov"))  # fmt: skip


def all_rejected(result: rt.Result) -> rt.Result:
    return with_objects(result, status="rejected", reason="no", **NO_SOLID)


def all_doubtful(result: rt.Result) -> rt.Result:
    return with_objects(result, status="doubtful")


def no_support(result: rt.Result) -> rt.Result:
    return with_objects(result, support=None, cov=None, size_rel_sigma=None, size_m=None)


def ellipsoids(result: rt.Result) -> rt.Result:
    return with_objects(result, support="ellipsoid")


def huge(result: rt.Result) -> rt.Result:
    return with_objects(result, half_axes=np.full(3, 1e6), size=np.full(3, 2e6))


def tiny(result: rt.Result) -> rt.Result:
    return with_objects(result, half_axes=np.full(3, 1e-9), size=np.full(3, 2e-9))


def absurd_covariance(result: rt.Result) -> rt.Result:
    return with_fitted_covariance(result, 1e40)


def absurd_covariance_of_a_file(result: rt.Result) -> rt.Result:
    """As earlier versions wrote them."""
    return with_objects(result, cov=1e40 * np.eye(9), size_rel_sigma=None)


def one_object(result: rt.Result) -> rt.Result:
    rows = result.tracks[result.tracks.track_id == 2]
    return dataclasses.replace(result, objects=result.objects[1:2], tracks=rows, fits=None)


def one_frame(result: rt.Result) -> rt.Result:
    rows = result.tracks[result.tracks.frame == 3]
    return dataclasses.replace(result, tracks=rows, poses=result.poses.of_part(0))


def one_camera(result: rt.Result) -> rt.Result:
    cams = result.poses.cam_from_world.copy()
    cams[1:] = np.nan
    return with_poses(result, cams)


def boxes_outside(result: rt.Result) -> rt.Result:
    boxes = result.tracks.xyxy.copy()
    boxes[::3] += 1e6
    boxes[1::3, 2:] = boxes[1::3, :2]  # without area
    boxes[2::3] -= 1e6
    return dataclasses.replace(result, tracks=dataclasses.replace(result.tracks, xyxy=boxes))


def odd_names(result: rt.Result) -> rt.Result:
    names = ("</script>&\"'=1+1", "stůl 桌子", "x" * 500)
    objects = [
        dataclasses.replace(o, class_name=name)
        for o, name in zip(result.objects, names, strict=True)
    ]
    rows = dataclasses.replace(result.tracks, class_id=result.tracks.track_id - 1)
    return dataclasses.replace(result, objects=objects, class_names=names, tracks=rows)


def objects_without_boxes(result: rt.Result) -> rt.Result:
    return dataclasses.replace(result, tracks=rt.Tracks.empty())


KINDS = [
    objects_without_boxes,
    dataclasses.replace, nothing, cameras_alone, no_cameras, cameras_nan, some_cameras_nan, behind,
    in_an_object, far_away, fisheye, all_rejected, all_doubtful, no_support, ellipsoids, huge, tiny,
    absurd_covariance, absurd_covariance_of_a_file, one_object, one_frame, one_camera,
    boxes_outside, odd_names,
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_result_is_written_drawn_and_exported(
    plain: rt.Result, source: rt.Video, tmp_path: Path, kind: Any
) -> None:
    result, out = kind(plain), tmp_path / "out"
    result = dataclasses.replace(result, video=VideoInfo(str(source.source), *SIZE, 30.0))
    result.save(out)
    for doubtful in (False, True):
        assert write_pictures(result, out, source, True, True, doubtful) == []
    shown = cv2.VideoCapture(str(next(out.glob("overlay.*"))))
    assert shown.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    json.loads((out / "objects.json").read_text(), parse_constant=pytest.fail)
    (out / "cache").mkdir(exist_ok=True)
    facts = {"source": str(source.source), "input": dataclasses.asdict(source.config)}
    (out / "cache/source.json").write_text(json.dumps(facts))
    assert "objects" in rt.Result.load(out).summary()
    saved = rt.Result.load(out)
    for default, write in EXPORTS.values():
        refused = ""
        try:
            write(saved, out / default)
        except rt.ReobjError as error:
            refused = str(error)
        assert (out / default).exists() == (not refused), refused
        if refused:
            assert "\n" not in refused
            assert Path(default).parent == Path() or not (out / default).parent.exists()
    assert not list(out.rglob(".part*"))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_no_absurd_covariance_reaches_a_file(
    plain: rt.Result, source: rt.Video, tmp_path: Path
) -> None:
    """Place and size have bounded sigmas, and the reason says so."""
    result = dataclasses.replace(
        absurd_covariance(plain), video=VideoInfo(str(source.source), *SIZE, 30.0)
    )
    result = result.save(tmp_path)
    assert write_pictures(result, tmp_path, source, False) == []
    assert "the boxes hardly determine its place and size: objects 1, 2, 3" in " ".join(
        result.summary().split()
    )
    page = (tmp_path / "scene.html").read_text().split('id="data">')[1].split("</script>")[0]
    data = json.loads((tmp_path / "objects.json").read_text())["objects"]
    for entry, shown in zip(data, json.loads(page)["objects"], strict=True):
        cov = np.frombuffer(base64.b64decode(shown["cov"]), "<f4").reshape(9, 9)
        np.testing.assert_allclose(cov, entry["cov"], rtol=1e-5)
        assert np.linalg.eigvalsh(cov)[[0, -1]].tolist() == pytest.approx([np.pi**2 / 3, 4000], 3)
        assert max(entry["size_rel_sigma"]) == pytest.approx(3, rel=0.01)
    (tmp_path / "cache").mkdir(exist_ok=True)
    default, write = EXPORTS["ros"]
    write(rt.Result.load(tmp_path), tmp_path / default)
    (detection, *_) = json.loads((tmp_path / default).read_text())["detections"]
    assert 1 < max(detection["results"][0]["pose"]["covariance"]) < 1e5


# ---- A failure while drawing ----


@pytest.fixture(scope="module")
def made(source: rt.Video, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of the walk with all its files, as `objects` writes them; copy it."""
    out, poses = tmp_path_factory.mktemp("made") / "out", walk(FRAMES)
    workspace = Workspace(out)
    workspace.bind(source)
    workspace.save_last(unlinked(poses, tracks_of(poses)), poses, [])
    assert rt.main(["objects", str(out)]) == 0
    assert (out / "sparse/cameras.txt").exists()  # of a run that came no further, too
    return out


def copied(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "out"))


def contents(out: Path) -> dict[str, bytes]:
    files = [p for p in out.rglob("*") if p.is_file() and p.name != "lock"]
    return {str(p.relative_to(out)): p.read_bytes() for p in files}


@pytest.mark.parametrize("solver", ["lfd", "psfmo"])
def test_solids_without_edges_are_drawn(made: Path, tmp_path: Path, solver: str) -> None:
    out = copied(made, tmp_path)
    assert rt.main(["objects", str(out), "--solver", solver]) == 0
    assert list(out.glob("overlay.*"))
    data = json.loads((out / "objects.json").read_text())
    assert {o["support"] for o in data["objects"] if o["center"]} == {"ellipsoid"}


def fails(error: Exception) -> Any:
    def function(*_: Any, **__: Any) -> None:
        raise error

    return function


BROKEN = [
    (overlay.Overlay, "__init__", ValueError("zip() is longer"), "overlay", ["scene.html"]),
    (overlay.Overlay, "take", ValueError("zip() is longer"), "overlay", ["scene.html"]),
    (overlay.FilmWriter, "write", OSError(errno.ENOSPC, "full"), "overlay", ["scene.html"]),
    (scene.Pictures, "__init__", KeyError(7), "scene", ["overlay"]),
    (scene.Pictures, "take", cv2.error("no image"), "scene", ["overlay"]),
    (scene, "write_scene", OSError(errno.ENOSPC, "full"), "scene", ["overlay"]),
    (rt.Video, "__iter__", rt.ReobjError("cannot be read"), "overlay", ["scene.html"]),
]


@pytest.mark.parametrize(("owner", "name", "error", "option", "left"), BROKEN)
def test_a_failure_while_drawing_is_a_warning(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    owner: Any, name: str, error: Exception, option: str, left: list[str],
) -> None:  # fmt: skip
    """Results and the other visualisation are written; an old file of the failed one is deleted."""
    out, before = copied(made, tmp_path), contents(made)
    monkeypatch.delenv("REOBJ_RAISE")
    monkeypatch.setattr(owner, name, fails(error))
    assert rt.main(["objects", str(out), "--known-size", "chair=2m"]) == 0
    err, after = capsys.readouterr().err, contents(out)
    warnings = [line for line in err.splitlines() if line.startswith("warning: no ")]
    assert len(warnings) == 1 and f"--set output.{option}=" in warnings[0], err
    assert type(error).__name__ in warnings[0] and "Traceback" not in err
    assert warnings[0].removeprefix("warning: ") in json.loads(after["objects.json"])["warnings"]
    assert after["objects.ply"] != before["objects.ply"]
    assert b"chair" in after["config.toml"] and set(before) - set(after) < {
        "scene.html", "overlay.mp4"
    }  # fmt: skip
    pictures = sorted(n for n in after if n.startswith(("scene", "overlay")))
    assert len(pictures) == 1 and pictures[0].startswith(left[0])
    assert not list(out.rglob(".part*"))


def test_debug_prints_the_traceback_of_a_drawing_failure(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copied(made, tmp_path)
    monkeypatch.setattr(overlay.Overlay, "take", fails(ValueError("in the film")))
    assert rt.main(["objects", str(out)]) == 1  # raised in the tests
    monkeypatch.delenv("REOBJ_RAISE")
    capsys.readouterr()
    assert rt.main(["objects", str(out), "--debug"]) == 0
    assert "Traceback" in capsys.readouterr().err


def test_ctrl_c_while_pictures_are_drawn_keeps_the_results(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = copied(made, tmp_path)
    monkeypatch.setattr(overlay.Overlay, "take", fails(KeyboardInterrupt()))  # type: ignore[arg-type]
    assert rt.main(["objects", str(out), "--known-size", "chair=2m"]) == 130
    after = contents(out)
    assert (
        b"chair" in after["config.toml"] and after["objects.ply"] != contents(made)["objects.ply"]
    )
    assert not list(out.glob("scene.html")) and not list(out.glob("*overlay*"))
    assert not list(out.rglob(".part*"))


def test_a_deleted_video_affects_visualisations_only(
    made: Path, source: rt.Video, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, gone = copied(made, tmp_path), tmp_path / "gone"
    facts = json.loads((out / "cache/source.json").read_text())
    (out / "cache/source.json").write_text(json.dumps(facts | {"source": str(gone)}))
    assert rt.main(["objects", str(out), "--known-size", "chair=2m"]) == 0
    (warning,) = [w for w in capsys.readouterr().err.splitlines() if str(gone) in w]
    assert warning.startswith("warning: no overlay video, and a viewer without pictures: ")
    assert (out / "scene.html").exists() and not list(out.glob("overlay.*"))
    assert (out / "sparse/images.txt").read_bytes() == (made / "sparse/images.txt").read_bytes()
    assert rt.main(["objects", str(out), "--tracks", str(out / "tracks.txt")]) == 2


# ---- All results or none ----

OUTPUTS = ["config.toml", "objects.json", "tracks.txt", "edits.json", "scene.html", "overlay.mp4",
          "objects.ply", "sparse", "cache/last-poses.npz"]  # fmt: skip


@pytest.mark.parametrize("name", OUTPUTS)
def test_nothing_is_replaced_if_one_output_is_blocked(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """A folder at the path of a file, or a file at the path of a folder."""
    out = copied(made, tmp_path)
    path = out / name
    if name == "sparse":
        shutil.rmtree(path)
        path.write_text("mine")
    else:
        path.unlink(missing_ok=True)
        path.mkdir()
        (path / "mine").write_text("mine")
    before = contents(out)
    assert rt.main(["objects", str(out), "--known-size", "chair=2m"]) == 2
    error = capsys.readouterr().err
    assert str(path) in error and "move it away" in error and error.count("\n") == 1
    assert contents(out) == before


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_refused_before_the_run(made: Path, tmp_path: Path) -> None:
    out = copied(made, tmp_path)
    (out / "sparse").chmod(0o555)
    before = contents(out)
    try:
        assert rt.main(["objects", str(out), "--known-size", "chair=2m"]) == 2
    finally:
        (out / "sparse").chmod(0o755)
    assert contents(out) == before


def test_a_failed_export_leaves_no_files(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copied(made, tmp_path)
    for name, (default, _) in EXPORTS.items():
        path = out / "new" / name / Path(default).name
        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", fails(OSError(errno.ENOSPC, "full")))
            assert rt.main(["export", str(out), "--to", name, "-o", str(path)]) == 2
        assert not (out / "new").exists(), name
        folder = out / "folder"
        folder.mkdir()
        assert rt.main(["export", str(out), "--to", name, "-o", str(folder)]) == 2
        folder.rmdir()  # it is empty
    assert "Traceback" not in capsys.readouterr().err


# ---- A run without images, and worlds far from their origin ----


def written_walk(folder: Path, away: np.ndarray, scale: float = 1.0) -> list[str]:
    """Words of a run of boxes and poses alone; the world is moved, and enlarged."""
    poses = walk(16)
    rows = tracks_of(poses, 0.3)
    lines = ["frame,x1,y1,x2,y2,score,class"]
    for frame, box in zip(rows.frame.tolist(), rows.xyxy, strict=True):
        lines.append(f"{frame},{','.join(f'{v:.3f}' for v in box)},0.9,chair")
    folder.mkdir()
    (folder / "d.csv").write_text("\n".join(lines))
    tum = ["# units: arbitrary"] if scale != 1 else []  # as our own files say it
    for t, pose in zip(poses.time_s, poses.cam_from_world, strict=True):
        center = -scale * pose[:, :3].T @ pose[:, 3] + away
        turn = Rotation.from_matrix(pose[:, :3].T).as_quat()
        tum.append(" ".join(map(repr, [float(t), *center.tolist(), *turn.tolist()])))
    (folder / "poses.txt").write_text("\n".join(tum))
    camera = "PINHOLE {} {} 520 520 320 240".format(*SIZE)
    where = ["-o", str(folder / "out"), "--detections", str(folder / "d.csv")]
    return ["run", *where, "--poses", str(folder / "poses.txt"), "--camera", camera]


UTM = np.array([450000.0, 5400000.0, 160.0])


def centers_in(out: Path) -> np.ndarray:
    data = json.loads((out / "objects.json").read_text())
    return np.array([o["center"] for o in data["objects"]])


def test_coordinates_of_a_map_projection_keep_their_millimetres(tmp_path: Path) -> None:
    near, far = tmp_path / "near", tmp_path / "far"
    assert rt.main(written_walk(near, np.zeros(3))) == 0
    assert rt.main(written_walk(far, UTM)) == 0
    near, far = near / "out", far / "out"
    expected = centers_in(near) + UTM
    np.testing.assert_allclose(centers_in(far), expected, rtol=0, atol=1e-3)
    assert len(expected) == 3
    for name in ("csv", "ply", "glb", "rrd"):
        assert rt.main(["export", str(far), "--to", name]) == 0
    with (far / "objects.csv").open() as file:
        table = [[float(r[f"center_{a}"]) for a in "xyz"] for r in csv.DictReader(file)]
    np.testing.assert_allclose(table, expected, rtol=0, atol=1e-3)
    for name in ("objects.ply", "solids.ply"):
        mesh = trimesh.load(far / name)
        middles = np.array([part.bounds.mean(0) for part in mesh.split()])
        gap = np.linalg.norm(middles[:, None] - expected, axis=2).min(0)
        assert gap.max() < 2e-3, name
    scene_glb = trimesh.load(far / "objects.glb")
    origin = np.array(scene_glb.metadata["origin_in_world"])
    center = scene_glb.graph["chair 1"][0][:3, 3][[0, 2, 1]] * [1, -1, 1]  # y is up there
    assert np.abs(center).max() < 10 and np.abs(origin - UTM).max() < 10
    poses = np.loadtxt(far / "poses.txt")
    eyes = -np.einsum("fji,fj->fi", walk(16).cam_from_world[:, :, :3],
                      walk(16).cam_from_world[:, :, 3])  # fmt: skip
    np.testing.assert_allclose(poses[:, 1:4], eyes + UTM, rtol=0, atol=1e-4)
    page = (far / "scene.html").read_text()
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    (part,) = data["parts"]
    shown = np.array([o["center"] for o in data["objects"]])
    np.testing.assert_allclose(shown + part["origin"], expected, rtol=0, atol=1e-3)
    cams = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(-1, 3, 4)[:, :, 3]
    np.testing.assert_allclose(cams + part["origin"], eyes + UTM, rtol=0, atol=1e-3)


def test_small_worlds_keep_their_digits(tmp_path: Path) -> None:
    assert rt.main(written_walk(tmp_path / "a", np.zeros(3))) == 0
    assert rt.main(written_walk(tmp_path / "b", np.zeros(3), 1e-4)) == 0
    large, small = (centers_in(tmp_path / name / "out") for name in "ab")
    assert small.shape == large.shape and np.abs(small).max() < 1e-3
    np.testing.assert_allclose(1e4 * small, large, atol=0.02)
    poses = np.loadtxt(tmp_path / "b/out/poses.txt")[:, 1:4]
    given = np.loadtxt(tmp_path / "b/poses.txt")[:, 1:4]
    np.testing.assert_allclose(poses, given, rtol=1e-9)


def test_nerfstudio_and_labelme_need_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rt.main(written_walk(tmp_path / "a", np.zeros(3))) == 0
    out = tmp_path / "a/out"
    before = contents(out)
    for name in ("labelme", "nerfstudio"):
        for target in ([], ["-o", str(tmp_path / "new/t.json")]):
            capsys.readouterr()
            assert rt.main(["export", str(out), "--to", name, *target]) == 2
            error = capsys.readouterr().err
            assert "had no images" in error and error.count("\n") == 1
        assert contents(out) == before and not (tmp_path / "new").exists()
        assert not (out / name).exists()


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux")
def test_paths_that_are_no_utf8(tmp_path: Path) -> None:
    """config.toml holds them, and is read again; rerun's recording is written elsewhere."""
    folder = tmp_path / os.fsdecode(b"\xff")
    assert rt.main(written_walk(folder, np.zeros(3))) == 0
    out = folder / "out"
    assert r"\\udcff/poses.txt" in (out / "config.toml").read_text()
    assert rt.main(["objects", str(out)]) == 0
    again = ["run", "-o", str(folder / "again"), "--detections", str(folder / "d.csv")]
    assert rt.main([*again, "--config", str(out / "config.toml")]) == 0
    assert len(centers_in(folder / "again")) == 3
    for name, (default, _) in EXPORTS.items():
        if name not in ("labelme", "nerfstudio"):  # they need images
            assert rt.main(["export", str(out), "--to", name]) == 0
            assert (out / default).stat().st_size > (40 if name == "yolo" else 100)


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux")
def test_an_overlay_video_in_a_folder_that_is_no_utf8(
    made: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also if OUT is relative to the current folder."""
    folder = tmp_path / os.fsdecode(b"\xff")
    shutil.copytree(made, folder / "out")
    monkeypatch.chdir(folder)
    for out in (folder / "out", Path("out")):
        for name in ("overlay.mp4", "scene.html"):
            (out / name).unlink(missing_ok=True)
        assert rt.main(["objects", str(out)]) == 0
        assert "no overlay" not in capsys.readouterr().err
        assert (out / "scene.html").exists() and (out / "overlay.mp4").exists()
        assert not list(out.glob(".part*"))


# ---- Standard streams ----


@pytest.mark.skipif(os.name == "nt", reason="a POSIX shell")
@pytest.mark.parametrize(
    ("line", "codes"),
    [
        ("--options | head -1", "0 0"),
        ("run --help | true", "0 0"),
        ("models | true", "0 0"),
        ("run nothing -o OUT 2>&1 | true", "2 0"),
        ("objects MADE >&- 2>&-", "0"),
        ("models >/dev/full", "2"),
    ],
)
def test_closed_pipes_and_closed_standard_streams(
    made: Path, tmp_path: Path, line: str, codes: str
) -> None:
    out = copied(made, tmp_path)
    words = line.replace("MADE", str(out)).replace("OUT", str(tmp_path / "new"))
    script = f'"{sys.executable}" "{rt.__file__}" {words}; echo codes ${{PIPESTATUS[*]}} >"$SAID"'
    env = os.environ | {"SAID": str(tmp_path / "said")}
    done = subprocess.run(["bash", "-c", script], env=env, capture_output=True, text=True)
    assert (tmp_path / "said").read_text() == f"codes {codes}\n"
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    assert done.stderr.count("\n") <= 1


def test_names_that_the_terminal_cannot_show(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a Windows pipe in cp1252: the name is escaped."""
    out, stream = copied(made, tmp_path), io.TextIOWrapper(io.BytesIO(), "cp1252")
    data = json.loads((out / "objects.json").read_text())
    monkeypatch.setattr("sys.stdout", stream)
    names = (*rt.COCO_NAMES[:56], "桌子", *rt.COCO_NAMES[57:])
    workspace = Workspace(out)
    tracked = workspace.load_last()
    tracked = dataclasses.replace(tracked, class_names=names)
    workspace.save_last(tracked, tracked.poses)
    assert rt.main(["objects", str(out)]) == 0
    stream.flush()
    assert rb"\u684c\u5b50" in stream.buffer.getvalue()  # type: ignore[attr-defined]
    assert len(data["objects"]) == 3


def test_control_characters_in_warnings_are_escaped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "\x1b[31mred"
    folder.mkdir()
    (folder / "det.txt").write_text("")
    given = ("--detections", folder / "det.txt", "--poses", ROOM / "poses.txt")
    size = "PINHOLE 640 480 492 492 320 240"
    assert cli("run", "-o", tmp_path / "out", *given, "--camera", size) == 0
    said = capsys.readouterr().err
    assert "\\x1b[31mred" in said and "\x1b" not in said


@pytest.mark.parametrize("key", ["fl_x", "transform_matrix"])
def test_a_number_beyond_the_float_range_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    data: dict[str, Any] = {
        "fl_x": 500,
        "cx": 320,
        "cy": 240,
        "w": 640,
        "h": 480,
        "frames": [frame],
    }
    if key == "fl_x":
        data["fl_x"] = 10**400
    else:
        frame["transform_matrix"][0][3] = 10**400
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    (tmp_path / "det.txt").write_text("1,-1,10,10,50,50,0.9,-1,-1,-1\n")
    given = ("--detections", tmp_path / "det.txt", "--poses", tmp_path / "transforms.json")
    assert cli("run", "-o", tmp_path / "out", *given) == 2
    said = capsys.readouterr().err
    assert "transforms.json, line 1: a number of more than 308 digits" in said
