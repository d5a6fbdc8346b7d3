"""Supplied poses in the formats of users: assignment to frames, refusals and their reasons."""

from __future__ import annotations

import json
import sys
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt
from reobj.cameras import import_pycolmap, invert_rigid, write_colmap

sys.path.append(str(Path(__file__).resolve().parent.parent))
from pose_worlds import look_at

FRAMES, SIZE = 30, (320, 240)
CAMERA = rt.Camera("PINHOLE", *SIZE, (290.0, 290.0, 160.0, 120.0))
LINE = "PINHOLE 320 240 290 290 160 120"
CENTRES = np.array([[-0.6, 0, 0.41], [0.6, 0.3, 0.41], [0.1, 0.9, 0.41], [-0.1, -0.8, 0.41]])
SOLIDS = quadrics.Ellipsoids(
    CENTRES, np.tile([0.25, 0.3, 0.41], (4, 1)), np.eye(3)[None].repeat(4, 0)
)


def path_of(count: int = FRAMES) -> np.ndarray:
    """cam_from_world (F, 3, 4) of a hand-held walk around the origin, z up."""
    angle = np.radians(np.linspace(-60, 60, count))
    at, rng = np.arange(count), np.random.default_rng(1)
    radius, height = 3.4 + 0.3 * np.sin(at / 3), 1.6 + 0.3 * np.sin(at / 2)
    eye = np.stack([radius * np.sin(angle), -radius * np.cos(angle), height], 1)
    target = np.array([0, 0, 0.4]) + rng.normal(0, 0.05, (count, 3))
    return np.array([look_at(e, t) for e, t in zip(eye, target, strict=True)])


@cache
def images() -> tuple[np.ndarray, ...]:
    """Pictures of a textured floor along the path."""
    rng = np.random.default_rng(0)
    scales = [rng.normal(0, 1, (side, side)).astype(np.float32) for side in (20, 60, 180, 540)]
    floor = sum(cv2.resize(noise, (1600, 1600), interpolation=cv2.INTER_CUBIC) for noise in scales)
    floor = cv2.normalize(floor, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    world_from_texel = np.array([[0.005, 0, -4], [0, 0.005, -4], [0, 0, 1]])  # 8 x 8 m
    pictures = []
    for pose in path_of():
        homography = CAMERA.K @ pose[:, [0, 1, 3]] @ world_from_texel
        gray = cv2.warpPerspective(floor, homography, SIZE, flags=cv2.INTER_AREA)
        pictures.append(np.repeat(gray[:, :, None], 3, 2))
    return tuple(pictures)


def write_clip(folder: Path, blank: bool = False) -> Path:
    path = folder / "v.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, SIZE)
    for image in images():
        video.write(np.full_like(image, 90) if blank else image)
    video.release()
    return path


def folder_of(folder: Path, name: str = "{:04d}.jpg", first: int = 0, blank: bool = True) -> Path:
    (folder / "images").mkdir()
    for i, image in enumerate(images()):
        picture = np.full_like(image, 90) if blank else image
        cv2.imwrite(str(folder / "images" / name.format(i + first)), picture)
    return folder / "images"


def as_poses(cams: np.ndarray) -> rt.Poses:
    at = np.arange(len(cams))
    return rt.Poses(CAMERA, at, at / 30, cams, np.full(len(cams), "supplied"), "user")


def model(folder: Path, frames: list[int], names: list[str], camera: str = "") -> Path:
    """COLMAP text model of some frames under the names given."""
    write_colmap(folder, as_poses(path_of()[frames]), names)
    if camera:
        (folder / "cameras.txt").write_text(camera)
    return folder


def transforms(path: Path, names: list[str]) -> Path:
    """Poses of the first frames under these names."""
    whole = np.tile(np.eye(4), (len(names), 1, 1))
    whole[:, :3] = invert_rigid(path_of()[: len(names)])
    rows = [
        {"file_path": name, "transform_matrix": pose.tolist()}
        for name, pose in zip(names, whole @ np.diag([1.0, -1, -1, 1]), strict=True)
    ]
    facts = {"fl_x": 290, "cx": 160, "cy": 120, "w": 320, "h": 240}
    path.write_text(json.dumps(facts | {"frames": rows}))
    return path


def quaternions(frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
    world_from_cam = invert_rigid(path_of()[frames])
    return world_from_cam[:, :, 3], Rotation.from_matrix(world_from_cam[:, :, :3]).as_quat()


def tum(path: Path, stamps: list[str], frames: list[int], head: str = "", sep: str = " ") -> Path:
    centre, xyzw = quaternions(frames)
    rows = [
        sep.join([stamp, *map(repr, [*p.tolist(), *q.tolist()])])
        for stamp, p, q in zip(stamps, centre, xyzw, strict=True)
    ]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def detections(folder: Path) -> Path:
    """Boxes of four chairs in all frames, .3 px off."""
    boxes = quadrics.solid_boxes(SOLIDS, "box", CAMERA.K @ path_of())  # (F, 4, 4)
    boxes = boxes + np.random.default_rng(2).normal(0, 0.3, boxes.shape)
    rows = [
        f"{f},{','.join(f'{v:.2f}' for v in boxes[f, k])},.9,chair"
        for f, k in np.ndindex(*boxes.shape[:2])
    ]
    path = folder / "d.csv"
    path.write_text("frame,x1,y1,x2,y2,score,class\n" + "\n".join(rows) + "\n")
    return path


def assert_right(poses: rt.Poses, frames: list[int]) -> None:
    """Exactly these frames have a pose, and it is the true one."""
    assert poses.frame[poses.known].tolist() == frames
    np.testing.assert_allclose(poses.cam_from_world[poses.known], path_of()[frames], atol=1e-6)


def run(folder: Path, source: Path | None, poses: Path, *more: str) -> int:
    words = ["run", *([str(source)] if source else []), "-o", str(folder / "out"), "--detections",
             str(detections(folder)), "--poses", str(poses), "--embed", "none",
             "--set", "output.overlay=none", "--set", "output.scene=false",
             "--set", "poses.size_px=160"]  # fmt: skip
    return rt.main([*words, *more])


def assert_chairs_in_place(out: Path, atol: float = 0.02) -> None:
    objects = json.loads((out / "objects.json").read_text())["objects"]
    found = np.array([o["center"] for o in objects if o["center"]])
    assert len(found) == 4
    assert np.linalg.norm(found[:, None] - CENTRES, axis=2).min(0).max() < atol


ALL = list(range(FRAMES))
KEPT = {"all": ALL, "first missing": ALL[1:], "last missing": ALL[:-1]}


# ---- Numbers in names ----------------------------------------------------------------------------


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("kept", KEPT)
def test_numbers_of_a_video_that_count_from_0_and_from_1_are_asked(
    tmp_path: Path, kept: str, first: int
) -> None:
    """A 0, or the number of frames, leaves one reading; else the error names both, and the flag."""
    frames = KEPT[kept]
    path = model(tmp_path / "m", frames, [f"{i + first:05d}.png" for i in frames])
    video = rt.Video(write_clip(tmp_path))
    chosen = ""
    if frames[0] + first > 0 and frames[-1] + first < FRAMES:
        with pytest.raises(rt.ReobjError, match=r"2 ways: number0.*number1.*poses.frames_by="):
            rt.read_poses(path, video)
        with pytest.raises(rt.ReobjError, match="can be read by number0, number1"):
            rt.read_poses(path, video, frames_by="time")
        chosen = f"number{first}"
    poses = rt.read_poses(path, video, frames_by=chosen)
    assert_right(poses, frames)
    assert f"counted from {first}" in poses.reading


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("every", [2, 4])
def test_every_kth_frame_renumbered(tmp_path: Path, every: int, first: int) -> None:
    frames = ALL[::every]
    names = [f"frame_{i + first:05d}.png" for i in range(len(frames))]
    video = rt.Video(write_clip(tmp_path))
    unnamed = tmp_path / "kitti.txt"
    np.savetxt(unnamed, invert_rigid(path_of()[frames]).reshape(-1, 12))
    path = model(tmp_path / "m", frames, names)
    key = f"every{every}from"
    for file, start in ((path, first), (unnamed, 0)):
        with pytest.raises(rt.ReobjError, match=f"{key}{start}"):
            rt.read_poses(file, video, camera=LINE)
        poses = rt.read_poses(file, video, camera=LINE, frames_by=f"{key}{start}")
        assert_right(poses, frames)
        assert f"one frame in {every}" in poses.reading


def test_photos_from_0_beside_names_from_1(tmp_path: Path) -> None:
    source = rt.Video(folder_of(tmp_path))
    names = [f"images/frame_{i + 1:05d}.png" for i in ALL[:-1]]
    path = transforms(tmp_path / "t.json", names)
    with pytest.raises(rt.ReobjError, match=r"number .*number1 .*poses.frames_by"):
        rt.read_poses(path, source)
    assert_right(rt.read_poses(path, source, frames_by="number1"), ALL[:-1])


def test_equal_file_names_in_two_folders_of_a_model(tmp_path: Path) -> None:
    source = folder_of(tmp_path).rename(tmp_path / "left")
    frames = [*ALL[::-1], *ALL]
    names = [f"right/{i:04d}.jpg" for i in ALL] + [f"left/{i:04d}.jpg" for i in ALL]
    path = model(tmp_path / "m", frames, names)
    assert_right(rt.read_poses(path, rt.Video(source)), ALL)
    with pytest.raises(rt.ReobjError, match="several images in different folders"):
        rt.read_poses(path, rt.Video(source.rename(tmp_path / "other")))
    with pytest.raises(rt.ReobjError, match="have the same number"):
        rt.read_poses(path, rt.Video(write_clip(tmp_path)))


# ---- Time stamps ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "step", "said"),
    [(0, 1, "whole numbers"), (1700000000, 1, "order"), (0, 0.1, "order")],
)
def test_as_many_rows_as_images_without_times(
    tmp_path: Path, first: int, step: float, said: str
) -> None:
    """Images without time stamps have no times: none is assumed."""
    path = tum(tmp_path / "t.txt", [str(first + step * i) for i in ALL], ALL)
    poses = rt.read_poses(path, rt.Video(folder_of(tmp_path)), camera=LINE)
    assert_right(poses, ALL)
    assert said in poses.reading


@pytest.mark.parametrize("first", [0, 1])
def test_frame_numbers_in_the_column_of_times(tmp_path: Path, first: int) -> None:
    path = tum(tmp_path / "t.txt", [f"{i + first}.0" for i in ALL], ALL)
    assert_right(rt.read_poses(path, rt.Video(write_clip(tmp_path)), camera=LINE), ALL)


@pytest.mark.parametrize("per_s", [1e3, 1e6, 1e9])
def test_stamps_in_ms_us_and_ns(tmp_path: Path, per_s: float) -> None:
    """Dates are read in any unit. Times since the start of a video have to be in seconds."""
    frames = ALL[::4]
    path = tum(tmp_path / "t.txt", [f"{round(i / 30 * per_s)}" for i in frames], frames)
    with pytest.raises(rt.ReobjError, match=r"none of its 8 poses .*expected seconds"):
        rt.read_poses(path, rt.Video(write_clip(tmp_path)), camera=LINE)
    start = 1_700_000_000_000_000_000
    source = tmp_path / "ns"
    source.mkdir()
    for i, image in enumerate(images()):
        cv2.imwrite(str(source / f"{start + 50_000_000 * i}.png"), image)
    dates = [f"{(start + 50_000_000 * i) // round(1e9 / per_s)}.000000" for i in frames]
    poses = rt.read_poses(tum(tmp_path / "d.txt", dates, frames), rt.Video(source), camera=LINE)
    assert_right(poses, frames)


# ---- Order of quaternions ------------------------------------------------------------------------


@pytest.mark.parametrize("head", [True, False])
@pytest.mark.parametrize("clock", ["ns", "s"])
def test_csv_with_w_first(
    tmp_path: Path, head: bool, clock: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A header names the columns. Without one ns leave two formats, and s are TUM's: w last."""
    centre, xyzw = quaternions(ALL)
    names = "#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n"
    rows = [
        ",".join(map(str, [stamp, *p, *q[[3, 0, 1, 2]]]))
        for stamp, p, q in zip(
            [1_700_000_000_000_000_000 + 50_000_000 * i if clock == "ns" else i / 20 for i in ALL],
            centre, xyzw, strict=True,
        )
    ]  # fmt: skip
    path = tmp_path / "gt.csv"
    path.write_text(names * head + "\n".join(rows) + "\n")
    code = run(tmp_path, None, path, "--camera", LINE)
    if not head:
        assert code == 2
        error = capsys.readouterr().err
        assert "--pose-format" in error
        named = "tum, euroc" if clock == "ns" else "quaternions with w first given as w last"
        assert named in error
        code = run(tmp_path, None, path, "--camera", LINE, "--pose-format", "euroc")
    if clock == "s" and not head:  # EuRoC's stamps are ns
        return
    assert code == 0
    assert_chairs_in_place(tmp_path / "out")


# ---- Models and cameras --------------------------------------------------------------------------


NAMES = [f"{i:04d}.jpg" for i in ALL]


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_a_model_is_found_or_has_to_be_named(tmp_path: Path, suffix: str) -> None:
    source = rt.Video(folder_of(tmp_path))
    small = model(tmp_path / "w" / "sparse" / "0", ALL[:6], NAMES[:6])
    large = model(tmp_path / "w" / "sparse" / "1", ALL[4:], NAMES[4:])
    for folder in (small, large) if suffix == ".bin" else ():
        import_pycolmap().Reconstruction(str(folder)).write_binary(str(folder))
    with pytest.raises(rt.ReobjError, match=r"sparse/0 and .*sparse/1; name one"):
        rt.read_poses(tmp_path / "w", source)
    small.rename(large / "0")
    assert_right(rt.read_poses(large, source), ALL[4:])  # named, though another one is below it
    for name in ("cameras", "images"):
        file = large / f"{name}{suffix}"
        assert_right(rt.read_poses(file, source), ALL[4:])
        (tmp_path / file.name).write_bytes(file.read_bytes())
        with pytest.raises(rt.ReobjError, match=f"{name}{suffix}: no .*give that folder"):
            rt.read_poses(tmp_path / file.name, source)
        (tmp_path / file.name).unlink()


def test_a_folder_of_two_formats_is_asked(tmp_path: Path) -> None:
    """nerfstudio's own folder is not: its transforms.json was made from the model in colmap/."""
    video = rt.Video(folder_of(tmp_path))
    transforms(tmp_path / "transforms.json", NAMES)
    model(tmp_path / "colmap" / "sparse" / "0", ALL, NAMES)
    assert rt.read_poses(tmp_path, video).reading == "transforms, frames by file names"
    (tmp_path / "colmap" / "sparse").rename(tmp_path / "sparse")
    (tmp_path / "colmap").rmdir()
    with pytest.raises(rt.ReobjError, match=r"2 formats of poses: colmap, transforms"):
        rt.read_poses(tmp_path, video)
    assert_right(rt.read_poses(tmp_path, video, fmt="colmap"), ALL)


@pytest.mark.parametrize("kind", ["one", "each", "two"])
def test_only_cameras_of_images_that_are_frames_count(tmp_path: Path, kind: str) -> None:
    source = rt.Video(folder_of(tmp_path))
    path = model(tmp_path / "m", [*ALL, 0], [*NAMES, "cam1/9999.jpg"])
    focal = {"one": [290.0], "each": [290 + 0.1 * (i % 5) for i in ALL], "two": [290, 400]}[kind]
    cameras = [f"{i} PINHOLE 320 240 {f} {f} 160 120\n" for i, f in enumerate(focal, 1)]
    other = "99 OPENCV 1000 700 900 900 500 350 0 0 0 0\n"
    (path / "cameras.txt").write_text("".join(cameras) + other)
    lines = (path / "images.txt").read_text().splitlines()[::2]
    rows = [[*line.split()[:8], str(i % len(focal) + 1), line.split()[9]]
            for i, line in enumerate(lines)]  # fmt: skip
    rows[-1][8] = "99"
    (path / "images.txt").write_text("".join(f"{' '.join(row)}\n\n" for row in rows))
    if kind == "two":
        with pytest.raises(rt.ReobjError, match=r"several different cameras .*290-400.*--camera"):
            rt.read_poses(path, source)
        assert rt.read_poses(path, source, camera=LINE).camera == CAMERA
    else:
        poses = rt.read_poses(path, source)
        assert_right(poses, ALL)
        assert poses.camera.params[0] == pytest.approx(290 if kind == "one" else 290.2)


@pytest.mark.parametrize(("number", "binary"), [("nan", True), ("1e300", False)])
def test_points_that_are_not_finite_are_refused(
    tmp_path: Path, number: str, binary: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = model(tmp_path / "m", ALL, NAMES)
    x = "5" if binary else number
    (path / "points3D.txt").write_text(f"3 0 0 1 9 9 9 0\n7 {x} 0 1 9 9 9 0\n")
    if binary:
        whole = import_pycolmap().Reconstruction(str(path))
        whole.points3D[7].xyz = [float(number), 0, 1]
        whole.write_binary(str(path))
    assert run(tmp_path, None, path) == 2
    assert "point 7 is not finite, or more than" in capsys.readouterr().err
    assert not (tmp_path / "out" / "objects.json").exists()
