"""Runs from detections and poses alone: frames without images, and refused options."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from pose_worlds import arc
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt
from reobj.cameras import invert_rigid, write_colmap

SIZE, FRAMES = (320, 240), 24
CAMERA = rt.Camera("PINHOLE", *SIZE, (300.0, 300.0, 160.0, 120.0))
LINE = "PINHOLE 320 240 300 300 160 120"
CENTRES = np.array([[-0.5, 0, 0.41], [0.6, 0.3, 0.41]])
SOLIDS = quadrics.Ellipsoids(
    CENTRES, np.tile([0.28, 0.3, 0.41], (2, 1)), np.eye(3)[None].repeat(2, 0)
)
OPTIONS = rt.Config(embed=rt.EmbedConfig(model="none"))


def boxes() -> list[tuple[int, int, list[float]]]:
    """Frame, object and xyxy of the boxes of both chairs in every frame."""
    found = quadrics.solid_boxes(SOLIDS, "box", CAMERA.K @ arc(FRAMES))  # (F, 2, 4)
    return [(f, k, found[f, k].tolist()) for f, k in np.ndindex(FRAMES, 2)]


def as_csv(folder: Path, when: str = "frame", of: object = None) -> Path:
    """CSV of the boxes; `of`: what the first column holds for each frame."""
    rows = [f"{of[f] if of else f},{','.join(map(str, box))},.9,chair" for f, _, box in boxes()]
    path = folder / "det.csv"
    path.write_text(f"{when},x1,y1,x2,y2,score,class\n" + "\n".join(rows) + "\n")
    return path


def as_npz(folder: Path) -> Path:
    frames = [
        (f, rt.Detections.from_array([[*box, 0.9, 56] for g, _, box in boxes() if g == f]))
        for f in range(FRAMES)
    ]
    rt.write_detections_npz(folder / "det.npz", frames, rt.COCO_NAMES, SIZE)
    return folder / "det.npz"


def as_tum(folder: Path, times: object = None) -> Path:
    world_from_cam = invert_rigid(arc(FRAMES))
    quaternion = Rotation.from_matrix(world_from_cam[:, :, :3]).as_quat()
    times = np.arange(FRAMES) / 30 if times is None else times
    np.savetxt(folder / "groundtruth.txt", np.c_[times, world_from_cam[:, :, 3], quaternion],
               "%.9f")  # fmt: skip
    return folder / "groundtruth.txt"


def as_colmap(folder: Path, names: list[str]) -> Path:
    count = len(names)
    at, status = np.arange(count), np.full(count, "pnp")
    poses = rt.Poses(CAMERA, at, at / 30, arc(FRAMES), status, "pycolmap")
    write_colmap(folder / "model", poses, names)
    return folder / "model"


def run(folder: Path, detections: Path, poses: Path, camera: str = "", **known: object):
    section = rt.PosesConfig(mode=str(poses), camera=camera, **known)
    config = rt.Config(embed=OPTIONS.embed, poses=section)
    return rt.run(None, folder / "out", config, detections=detections)


def assert_both_chairs(result: rt.Result) -> None:
    assert [o.class_name for o in result.objects] == ["chair", "chair"]
    found = np.array([o.center for o in result.objects])
    found = found[np.argsort(found[:, 0])]
    np.testing.assert_allclose(found, CENTRES, atol=0.02)
    assert [o.frames_seen for o in result.objects] == [FRAMES, FRAMES]


def assert_chairs_in_place(result: rt.Result) -> None:
    """Without images and poses the camera rotation is unknown, and tracks may break."""
    found = np.array([o.center for o in result.located])
    distance = np.linalg.norm(found[:, None] - CENTRES, axis=2).min(0)
    assert distance.max() < 0.02


def test_all_files_without_images_are_written(tmp_path: Path) -> None:
    """They can be fitted again and exported."""
    result = run(tmp_path, as_csv(tmp_path), as_colmap(tmp_path, [f"{i}.jpg" for i in range(24)]))
    assert_both_chairs(result)
    assert "no images: 24 frames of 320x240" in result.warnings[0]
    out = tmp_path / "out"
    names = {path.name for path in out.iterdir()}
    assert {*"tracks.txt objects.json objects.ply poses.txt sparse scene.html".split()} <= names
    assert "overlay.mp4" not in names
    assert len((out / "tracks.txt").read_text().splitlines()) == 2 * FRAMES
    page = (out / "scene.html").read_text()
    assert '"thumbs":[]' in page and '"crops":[]' in page
    assert_both_chairs(rt.refit(out))
    rt.export(out, "coco-vid")
    images = json.loads((out / "coco_vid.json").read_text())["images"]
    assert [image["file_name"] for image in images] == [f"{i}.jpg" for i in range(FRAMES)]
    assert (out / "sparse" / "images.txt").read_text().count(".jpg") == FRAMES


@pytest.mark.parametrize(
    "names",
    [
        [f"{i:05d}.jpg" for i in range(FRAMES)],
        [f"{i}.png" for i in range(FRAMES)],  # 2.png comes before 10.png
        [f"{3 + i + i // 5:05d}.jpg" for i in range(FRAMES)],  # numbers with gaps
        [f"{1305031102 + i / 30:.6f}.png" for i in range(FRAMES)],
    ],
)
def test_names_of_the_poses_number_the_frames_as_their_folder_would(
    tmp_path: Path, names: list[str]
) -> None:
    assert_both_chairs(run(tmp_path, as_csv(tmp_path), as_colmap(tmp_path, names)))
    stamps = np.loadtxt(tmp_path / "out" / "poses.txt")[:, 0]
    start = 1305031102 if names[0][:2] == "13" else 0
    np.testing.assert_allclose(stamps, start + np.arange(FRAMES) / 30, atol=1e-5)


def test_poses_of_some_images_keep_the_numbers_in_their_names(tmp_path: Path) -> None:
    model = as_colmap(tmp_path, [f"{i:04d}.jpg" for i in range(FRAMES)])
    images = (model / "images.txt").read_text().splitlines()
    kept = [line for line in images if line and int(line[-8:-4]) not in (3, 4, 9)]
    (model / "images.txt").write_text("\n\n".join(kept) + "\n\n")
    result = run(tmp_path, as_csv(tmp_path), model)
    assert_chairs_in_place(result)
    assert result.poses.frame[~result.poses.known].tolist() == [3, 4, 9]
    assert any("none for 3-4, 9" in warning for warning in result.warnings)


def test_a_column_of_times_meets_poses_of_a_higher_rate(tmp_path: Path) -> None:
    """As in TUM's recordings: detections at 30 Hz, motion capture at another rate."""
    times = 1341847980.722988 + np.arange(FRAMES) / 30
    mocap = as_tum(tmp_path, times)
    rows = np.loadtxt(mocap)
    between = (rows[1:] + rows[:-1]) / 2  # near enough
    between[:, 4:] /= np.linalg.norm(between[:, 4:], axis=1, keepdims=True)
    rows = np.concatenate([rows, between])
    np.savetxt(mocap, rows[np.argsort(rows[:, 0])], "%.9f")
    path = as_csv(tmp_path, "timestamp", [f"{t:.6f}" for t in times])
    result = run(tmp_path, path, mocap, LINE)
    assert_both_chairs(result)
    np.testing.assert_allclose(result.poses.time_s, times, atol=1e-6)


def test_our_own_poses_with_a_gap_keep_their_frames(tmp_path: Path) -> None:
    """Even times from 0 on are frame numbers: rows of lost frames may be missing."""
    path = as_tum(tmp_path)
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:5] + rows[8:]) + "\n")
    result = run(tmp_path, as_csv(tmp_path), path, LINE)
    assert_chairs_in_place(result)
    assert result.poses.frame[~result.poses.known].tolist() == [5, 6, 7]


def test_the_image_size_comes_from_the_detections(tmp_path: Path) -> None:
    assert_both_chairs(run(tmp_path, as_npz(tmp_path), as_tum(tmp_path), "300,300,160,120"))


@pytest.mark.parametrize(
    "detections, poses, camera, message",
    [
        (None, "tum", LINE, "no video: name one, or use"),
        ("csv", "none", LINE, "no video: name one, or use"),
        ("csv", "tum", "300,300,160,120", "no image size"),
        ("no.csv", "tum", LINE, "no.csv does not exist"),
        ("csv", "no.txt", LINE, "no.txt does not exist"),
        ("late", "tum", LINE, "frame 99, but .*groundtruth.txt has 24 poses"),
    ],
)
def test_impossible_combinations_give_one_line(
    tmp_path: Path, detections: object, poses: str, camera: str, message: str
) -> None:
    if detections in ("csv", "late"):
        path = as_csv(tmp_path)
        if detections == "late":
            path.write_text(path.read_text() + "99,10,10,90,90,.9,chair\n")
        detections = path
    mode = str(as_tum(tmp_path)) if poses == "tum" else poses
    config = rt.Config(poses=rt.PosesConfig(mode=mode, camera=camera))
    with pytest.raises(rt.ReobjError, match=message) as refused:
        rt.run(None, tmp_path / "out", config, detections=detections)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("video", "options", "message"),
    [
        (False, {"depth": "maps"}, "--depth maps: .*name the video"),
        (True, {"mode": "none", "depth": "maps"}, "--poses is none"),
        (True, {"mode": "none", "metric": True}, "--poses is none"),
    ],
)
def test_options_of_missing_cameras_or_images_are_refused(
    tmp_path: Path, video: bool, options: dict[str, object], message: str
) -> None:
    given = {"mode": str(as_tum(tmp_path)), "camera": LINE} | options
    config = rt.Config(poses=dataclasses.replace(rt.PosesConfig(), **given))
    source = "a.mp4" if video else None
    with pytest.raises(rt.ReobjError, match=message):
        rt.run(source, tmp_path / "out", config, detections=as_csv(tmp_path))
    assert not (tmp_path / "out").exists()


def test_tracks_need_no_images_either(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    rows = [f"{f},{k + 1},{','.join(map(str, box))},chair" for f, k, box in boxes()]
    path.write_text("frame,id,x1,y1,x2,y2,class\n" + "\n".join(rows) + "\n")
    config = rt.Config(poses=rt.PosesConfig(mode=str(as_tum(tmp_path)), camera=LINE))
    assert_both_chairs(rt.run(None, tmp_path / "out", config, tracks=path))
