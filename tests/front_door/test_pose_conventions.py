"""Poses in another convention than they are read with, of lost frames, and of turned photos."""

from __future__ import annotations

import json
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


@pytest.mark.parametrize(("orientation", "is_upright"), [(2, False), (3, False), (6, False),
                                                         (6, True)])  # fmt: skip
def test_cameras_of_stored_pixels_are_refused(
    tmp_path: Path, orientation: int, is_upright: bool
) -> None:
    """Photos with an EXIF orientation; cameras of their upright pixels, and our own, are right."""
    (tmp_path / "img").mkdir()
    exif = Image.Exif()
    exif[0x0112] = orientation
    for i, image in enumerate(images()):
        stored = np.ascontiguousarray(np.rot90(image)) if orientation == 6 else image
        Image.fromarray(stored).save(tmp_path / "img" / f"{i:04d}.jpg", exif=exif)
    write_colmap(tmp_path / "model", as_poses(path_of()), [f"{i:04d}.jpg" for i in ALL])
    if orientation == 6 and not is_upright:
        line = "1 PINHOLE 240 320 290 290 120 160\n"
        (tmp_path / "model" / "cameras.txt").write_text(line)
    source = rt.Video(tmp_path / "img")
    if is_upright:
        assert_right(rt.read_poses(tmp_path / "model", source), ALL)
        return
    with pytest.raises(rt.ReobjError, match=r"0000.jpg: has an EXIF orientation.*auto-orient"):
        rt.read_poses(tmp_path / "model", source)
    write_colmap(tmp_path / "model", as_poses(path_of()), [f"{i:04d}.jpg" for i in ALL])
    (tmp_path / "model" / "upright.txt").touch()  # in models that we wrote
    assert_right(rt.read_poses(tmp_path / "model", source), ALL)


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
