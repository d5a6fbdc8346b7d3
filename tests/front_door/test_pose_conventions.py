"""Poses in another convention than they are read with, of lost frames, and of turned photos."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import invert_rigid, write_colmap

from .test_pose_files import (
    ALL,
    FRAMES,
    LINE,
    as_poses,
    assert_chairs_in_place,
    assert_right,
    folder_of,
    images,
    path_of,
    run,
    write_clip,
)

Capture = pytest.CaptureFixture[str]


def world_from_cam() -> np.ndarray:
    whole = np.tile(np.eye(4), (FRAMES, 1, 1))
    whole[:, :3] = invert_rigid(path_of())
    return whole


def flip(x: float, y: float, z: float) -> np.ndarray:
    return np.diag([x, y, z, 1.0])


def parts(rotation: np.ndarray, translation: np.ndarray, scale: float = 1) -> np.ndarray:
    """Matrices (F, 4, 4) of the rotations and the scaled translations of others."""
    whole = rotation.copy()
    whole[:, :3, 3] = scale * translation[:, :3, 3]
    return whole


def tum_of(path: Path, matrices: np.ndarray) -> Path:
    xyzw = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([np.arange(len(xyzw)) / 30, matrices[:, :3, 3], xyzw]))
    return path


CONVENTIONS = {
    "right": (lambda m: m, ""),
    "Unity": (lambda m: np.eye(4)[[0, 2, 1, 3]] @ m @ flip(1, -1, 1), "(Unity)"),
    "mirrored x": (lambda m: flip(-1, 1, 1) @ m @ flip(-1, 1, 1), "x left, y down, z forward"),
    "turned": (lambda m: m @ flip(-1, -1, 1), "turned by 180 deg"),
    "OpenGL": (lambda m: m @ flip(1, -1, -1), "(OpenGL)"),
    "inverse": (np.linalg.inv, "the inverse direction"),
    "inverse rotations": (lambda m: parts(np.linalg.inv(m), m), "inverse rotations beside"),
    "inverse translations": (
        lambda m: parts(m, np.linalg.inv(m)),
        "translations of cam_from_world",
    ),
    "reversed": (lambda m: m[::-1], "the order reversed"),
    "late": (lambda m: np.concatenate([m[:1], m[:1], m[:1], m[:-3]]), "3 frames earlier"),
    "early": (lambda m: np.concatenate([m[3:], m[-3:]]), "3 frames later"),
    "as text": (lambda m: m[np.argsort([str(n) for n in ALL])], "as text (1, 10, 2)"),
    "mm": (lambda m: parts(m, m, 1000), "expected metres (mm"),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_a_convention_is_named_by_boxes_alone(tmp_path: Path, name: str, capsys: Capture) -> None:
    convert, named = CONVENTIONS[name]
    path = tum_of(tmp_path / "poses.txt", convert(world_from_cam()))
    code = run(tmp_path, None, path, "--camera", LINE)
    error = capsys.readouterr().err
    if name == "right":
        assert code == 0
        assert_chairs_in_place(tmp_path / "out")
        return
    assert code == 2 and named in error and error.count("\n") == 1
    assert "the poses look like ones with" in error or "metres" in error
    assert not (tmp_path / "out" / "objects.json").exists()


@pytest.mark.parametrize(
    ("convert", "named"),
    [
        (lambda m: m @ flip(1, -1, -1), ""),  # as the format has it
        (lambda m: m, "x right, y down, z forward (OpenCV)"),
        (lambda m: flip(1, 1, -1) @ m @ flip(1, -1, 1), "(Unity)"),
    ],
)
def test_a_convention_is_named_by_images_alone(
    tmp_path: Path, convert: object, named: str, capsys: Capture
) -> None:
    source = folder_of(tmp_path, blank=False)
    frames = [
        {"file_path": f"images/{i:04d}.jpg", "transform_matrix": matrix.tolist()}
        for i, matrix in enumerate(convert(world_from_cam()))  # type: ignore[operator]
    ]
    facts = {"fl_x": 290, "cx": 160, "cy": 120, "w": 320, "h": 240, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(facts))
    words = ["poses", str(source), "-o", str(tmp_path / "out"), "--set", "poses.size_px=160",
             "--poses", str(tmp_path / "transforms.json")]  # fmt: skip
    assert rt.main(words) == (2 if named else 0)
    error = capsys.readouterr().err
    assert named in error
    assert ("read with camera axes x right, y up, z backward (OpenGL)" in error) == bool(named)


# ---- Order ---------------------------------------------------------------------------------------


def test_rows_of_llff_are_in_the_order_of_the_names_as_text(tmp_path: Path) -> None:
    source = rt.Video(folder_of(tmp_path, "{}.jpg", first=1))
    order = np.argsort([str(i + 1) for i in ALL])
    w = invert_rigid(path_of()[order])
    hwf = np.tile([240, 320, 290], (FRAMES, 1))
    rows = np.stack([w[:, :, 1], w[:, :, 0], -w[:, :, 2], w[:, :, 3], hwf], 2)
    np.save(tmp_path / "poses_bounds.npy", np.column_stack([rows.reshape(-1, 15), hwf[:, :2]]))
    poses = rt.read_poses(tmp_path / "poses_bounds.npy", source)
    assert_right(poses, ALL)
    assert "as text" in poses.reading


# ---- Lost frames ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["identity", "zeros", "nan", "repeated"])
def test_poses_of_lost_frames_are_no_poses(tmp_path: Path, kind: str) -> None:
    """A path that begins at the identity keeps it."""
    from_first = np.linalg.inv(world_from_cam()[0]) @ world_from_cam()
    path = tum_of(tmp_path / "poses.txt", from_first)
    assert rt.read_poses(path, rt.Video(folder_of(tmp_path)), camera=LINE).known.all()
    tum_of(path, world_from_cam())
    rows = np.loadtxt(path)
    lost = list(range(12, 20))
    rows[lost, 1:] = {"identity": [0, 0, 0, 0, 0, 0, 1], "zeros": 0, "nan": np.nan,
                      "repeated": rows[11, 1:]}[kind]  # fmt: skip
    np.savetxt(path, rows)
    assert run(tmp_path, None, path, "--camera", LINE) == 0
    assert_chairs_in_place(tmp_path / "out")
    lines = (tmp_path / "out" / "poses.txt").read_text().splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == FRAMES - len(lost)
    warnings = json.loads((tmp_path / "out" / "objects.json").read_text())["warnings"]
    assert sum("8 poses" in text for text in warnings) == 1


# ---- EXIF orientations ---------------------------------------------------------------------------

# EXIF orientation: from the upright image to the stored one; rotation stored_from_upright
STORED = {
    1: (lambda image: image, np.eye(3)),
    3: (lambda image: image[::-1, ::-1], np.diag([-1.0, -1, 1])),
    6: (lambda image: np.rot90(image, 1), np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]])),
    8: (lambda image: np.rot90(image, -1), np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])),
}


def turned_photos(folder: Path, orientations: list[int]) -> tuple[Path, Path]:
    """Write photos and COLMAP's model of the stored pixels, with an off-centre lens."""
    (folder / "img").mkdir()
    poses = path_of().copy()
    for i, (image, orientation) in enumerate(zip(images(), orientations, strict=True)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        turn, stored_from_upright = STORED[orientation]
        stored = np.ascontiguousarray(turn(image))
        Image.fromarray(stored).save(folder / "img" / f"{i:04d}.jpg", quality=95, exif=exif)
        poses[i] = stored_from_upright @ poses[i]
    path = folder / "model"
    write_colmap(path, as_poses(poses), [f"{i:04d}.jpg" for i in ALL])
    return folder / "img", path


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_cameras_of_stored_pixels_turn_with_the_photos(tmp_path: Path, orientation: int) -> None:
    source, path = turned_photos(tmp_path, [orientation] * FRAMES)
    _, turn = STORED[orientation]
    size = (240, 320) if orientation > 4 else (320, 240)
    fx, fy = (291, 290) if orientation > 4 else (290, 291)
    offset = turn[:2, :2] @ [3.0, -2.0]
    p2, p1 = turn[:2, :2] @ [-0.002, 0.003]
    params = (fx, fy, size[0] / 2 + offset[0], size[1] / 2 + offset[1], 0.02, 0.01, p1, p2)
    line = " ".join(map(str, ("1 OPENCV", *size, *params)))
    (path / "cameras.txt").write_text(f"{line}\n")
    poses = rt.read_poses(path, rt.Video(source))
    assert_right(poses, ALL)
    upright = (290, 291, 163.0, 118.0, 0.02, 0.01, 0.003, -0.002)
    np.testing.assert_allclose(poses.camera.params, upright, atol=1e-12)
    assert any("EXIF orientation" in text for text in poses.messages) == (orientation > 1)


def test_photos_of_several_orientations_and_mirrored_ones(tmp_path: Path) -> None:
    source, path = turned_photos(tmp_path, [(1, 3)[i % 2] for i in ALL])
    assert_right(rt.read_poses(path, rt.Video(source)), ALL)
    exif = Image.Exif()
    exif[0x0112] = 2
    Image.fromarray(images()[0]).save(source / "0000.jpg", exif=exif)
    with pytest.raises(rt.ReobjError, match="mirrored EXIF orientation"):
        rt.read_poses(path, rt.Video(source))


@pytest.mark.parametrize("orientation", [3, 6])
def test_our_own_output_is_read_back(tmp_path: Path, orientation: int) -> None:
    """Photos turned by EXIF: our model has upright cameras, which are not turned again."""
    source, path = turned_photos(tmp_path, [orientation] * FRAMES)
    size = (240, 320) if orientation > 4 else (320, 240)
    line = f"1 PINHOLE {size[0]} {size[1]} 290 290 {size[0] / 2} {size[1] / 2}"
    (path / "cameras.txt").write_text(f"{line}\n")
    words = ["poses", str(source), "-o", str(tmp_path / "out"), "--poses", str(path)]
    assert rt.main([*words, "--set", "poses.size_px=160"]) == 0
    shutil.copytree(tmp_path / "out" / "sparse", tmp_path / "copy")
    for given in ("out", "copy"):
        poses = rt.read_poses(tmp_path / given, rt.Video(source))
        assert_right(poses, ALL)
        assert (poses.camera.width, poses.camera.params) == (320, (290, 290, 160, 120))
        assert not poses.metric


# ---- Other tools ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("reconstruction.json", '[{"cameras": {}, "shots": {"a.jpg": {}}}]', "shots.*COLMAP"),
        ("cameras.xml", "<?xml version='1.0'?>\n<document version='1.5.0'></document>",
         "document.*COLMAP"),
        ("cameras.sfm", '{"version": ["1"], "views": [], "poses": []}', "views.*COLMAP"),
    ],
)  # fmt: skip
def test_poses_of_other_tools_are_named(
    tmp_path: Path, name: str, content: str, named: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(rt.ReobjError, match=named):
        rt.read_poses(tmp_path / name, rt.Video(folder_of(tmp_path)))


def test_a_header_with_w_first_and_seconds_is_read(tmp_path: Path) -> None:
    path = tum_of(tmp_path / "poses.txt", world_from_cam())
    rows = np.loadtxt(path)[:, [0, 1, 2, 3, 7, 4, 5, 6]]
    np.savetxt(path, rows, header="timestamp tx ty tz qw qx qy qz")
    assert_right(rt.read_poses(path, rt.Video(write_clip(tmp_path)), camera=LINE), ALL)


def test_matrices_in_an_npy_file_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "poses.npy", world_from_cam())
    with pytest.raises(rt.ReobjError, match=r"shape \(30, 4, 4\).*savetxt"):
        rt.read_poses(tmp_path / "poses.npy", rt.Video(folder_of(tmp_path)))
