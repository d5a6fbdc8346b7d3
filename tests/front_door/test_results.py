"""Results of any kind are written, drawn and exported, or refused in one line."""

from __future__ import annotations

import base64
import csv
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from simulated import SIZE, fitted, tracks_of, unlinked, walk, with_fitted_covariance

import reobj_track as rt
from reobj.export.registry import EXPORTS
from reobj.results.result import VideoInfo
from reobj.results.workspace import Workspace
from reobj.viewer import overlay, scene
from reobj.viewer.scene import write_pictures

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


def absurd_covariance(result: rt.Result) -> rt.Result:
    return with_fitted_covariance(result, 1e40)


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
    dataclasses.replace, nothing, cameras_alone, no_cameras, cameras_nan,
    in_an_object, far_away, fisheye, all_rejected,
    absurd_covariance, one_camera,
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


def fails(error: Exception) -> Any:
    def function(*_: Any, **__: Any) -> None:
        raise error

    return function


BROKEN = [
    (overlay.Overlay, "take", ValueError("zip() is longer"), "overlay", ["scene.html"]),
    (scene.Pictures, "take", cv2.error("no image"), "scene", ["overlay"]),
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

# ---- A run without images, and worlds far from their origin ----


def written_walk(folder: Path, away: np.ndarray) -> list[str]:
    """Words of a run of boxes and poses alone; the world is moved."""
    poses = walk(16)
    rows = tracks_of(poses, 0.3)
    lines = ["frame,x1,y1,x2,y2,score,class"]
    for frame, box in zip(rows.frame.tolist(), rows.xyxy, strict=True):
        lines.append(f"{frame},{','.join(f'{v:.3f}' for v in box)},0.9,chair")
    folder.mkdir()
    (folder / "d.csv").write_text("\n".join(lines))
    tum = []
    for t, pose in zip(poses.time_s, poses.cam_from_world, strict=True):
        center = -pose[:, :3].T @ pose[:, 3] + away
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
        middles = np.array([solid.bounds.mean(0) for solid in mesh.split()])
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
    (component,) = data["parts"]
    shown = np.array([o["center"] for o in data["objects"]])
    np.testing.assert_allclose(shown + component["origin"], expected, rtol=0, atol=1e-3)
    cams = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(-1, 3, 4)[:, :, 3]
    np.testing.assert_allclose(cams + component["origin"], eyes + UTM, rtol=0, atol=1e-3)
