"""Cameras: intrinsics against pycolmap, rigid transforms, rays, files that pycolmap reads."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pose_worlds import PINHOLE, SIZE, some_cameras, supplied
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import (
    distort_boxes,
    import_pycolmap,
    load_poses,
    place_of,
    read_sparse_model,
    save_poses,
    triangulate_rays,
    undistort_boxes,
    write_colmap,
    write_tum,
)

DISTORTED = {
    "SIMPLE_PINHOLE": (500.0, 320.0, 240.0),
    "PINHOLE": (500.0, 480.0, 330.0, 250.0),
    "SIMPLE_RADIAL": (500.0, 320.0, 240.0, -0.05),
    "RADIAL": (500.0, 325.0, 245.0, -0.1, 0.02),
    "OPENCV": (500.0, 480.0, 330.0, 250.0, -0.1, 0.02, 0.001, -0.002),
    "OPENCV_FISHEYE": (400.0, 390.0, 330.0, 250.0, 0.01, 0.002, 0.0, 0.0),
    "FULL_OPENCV": (500.0, 480.0, 330.0, 250.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.02, 0.01, 1e-3),
    "FOV": (400.0, 390.0, 330.0, 250.0, 0.9),
    "THIN_PRISM_FISHEYE": (400.0, 390.0, 330.0, 250.0, *[0.002] * 8),
    "DIVISION": (500.0, 480.0, 330.0, 250.0, -0.1),
    "SIMPLE_FISHEYE": (400.0, 330.0, 250.0),
    "EUCM": (400.0, 390.0, 330.0, 250.0, 0.5, 1.1),
}


# ---- Intrinsics ----------------------------------------------------------------------------------


@pytest.mark.parametrize("model", DISTORTED)
def test_undistorted_pixels_are_those_of_a_pinhole_with_the_same_k(model):
    """Rays -> pixels by pycolmap's own camera -> undistorted -> K^-1: the rays again."""
    pycolmap = import_pycolmap()
    params = DISTORTED[model]
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=list(params))
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 20, 2))
    rays[..., 1] *= 0.7
    pixels = np.array(theirs.img_from_cam(np.insert(rays.reshape(-1, 2), 2, 1, 1)))
    camera = rt.Camera(model, *SIZE, params)
    np.testing.assert_allclose(camera.K, theirs.calibration_matrix())
    xy = pixels.reshape(2, 20, 2)
    xy[1, 3] = np.nan
    ideal = camera.undistort(xy)
    back = np.insert(ideal, 2, 1, 2) @ np.linalg.inv(camera.K).T
    np.testing.assert_allclose(np.delete(back[..., :2].reshape(-1, 2), 23, 0),
                               np.delete(rays.reshape(-1, 2), 23, 0), atol=1e-6)  # fmt: skip
    assert np.isnan(ideal[1, 3]).all()
    small = camera.resized((320, 240))
    assert (small.width, small.height, small.model) == (320, 240, model)
    half = np.insert(rays[0], 2, 1, 1)
    np.testing.assert_allclose(small.project(half), pixels[:20] / 2, atol=1e-9)
    assert camera.resized(SIZE) == camera


def test_boxes_are_undistorted_by_the_middles_of_their_edges():
    camera = rt.Camera("OPENCV", *SIZE, DISTORTED["OPENCV"])
    boxes = np.array([[100, 80, 200, 300.0], [0, 50, 640, 480]])
    found = undistort_boxes(boxes, camera)
    x1, y1, x2, y2 = boxes[0]
    middles = [(x1, (y1 + y2) / 2), ((x1 + x2) / 2, y1), (x2, (y1 + y2) / 2), ((x1 + x2) / 2, y2)]
    ideal = camera.undistort(np.array(middles))
    np.testing.assert_allclose(found[0], [ideal[0, 0], ideal[1, 1], ideal[2, 0], ideal[3, 1]])
    np.testing.assert_array_equal(found[1, [0, 2, 3]], [0, 640, 480])  # at the image border
    assert abs(found[0] - boxes[0]).min() > 0.1 and found[1, 1] != 50
    fisheye = rt.Camera("SIMPLE_FISHEYE", *SIZE, (200.0, 320.0, 240.0))
    rows = np.array([[2, 200, 90, 300.0], [200, 150, 400, 300]])  # the first reaches beyond 90 deg
    assert np.isnan(undistort_boxes(rows, fisheye)).all(1).tolist() == [True, False]


# ---- The fold of strong distortion ----


FOLDED = {  # inside these images, or near their border, the distortion turns back
    "SIMPLE_RADIAL": (400.0, 320.0, 240.0, -0.3),
    "OPENCV": (400.0, 390.0, 320.0, 240.0, -0.47, 0.1, 0.003, -0.012),
    "FULL_OPENCV": (400.0, 400.0, 320.0, 240.0, -0.07, -0.1, 4e-3, 5e-3, 0.05, -0.4, -0.47, -0.24),
    "OPENCV_FISHEYE": (400.0, 400.0, 320.0, 240.0, -0.62, -0.1, 0.22, -0.01),
}


def folded(model: str) -> rt.Camera:
    return rt.Camera(model, *SIZE, FOLDED[model])


def rays_to(radius: np.ndarray, directions: int = 24) -> np.ndarray:
    """Points (R, D, 3) at depth 2 in some directions from the optical axis."""
    turn = np.linspace(0, 2 * np.pi, directions, endpoint=False)
    xy = 2 * radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    return np.concatenate([xy, np.full((*xy.shape[:2], 1), 2.0)], 2)


@pytest.mark.parametrize("model", FOLDED)
def test_points_beyond_the_fold_are_in_no_image(model):
    """Within it pixels equal pycolmap's, move outwards and have an inverse; beyond it are none."""
    camera = folded(model)
    fold = camera.fold_radius
    points = rays_to(np.linspace(0.01, 0.99, 30) * fold)
    pixels = camera.project(points)
    theirs = np.asarray(camera.to_pycolmap().img_from_cam(points.reshape(-1, 3)))
    np.testing.assert_allclose(pixels.reshape(-1, 2), theirs, rtol=0, atol=1e-9)
    offset = np.linalg.norm((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2], axis=2)
    assert (np.diff(offset, axis=0) > 0).all()
    ideal = points[..., :2] / 2 @ camera.K[:2, :2].T + camera.K[:2, 2]
    np.testing.assert_allclose(camera.distort(ideal), pixels, rtol=0, atol=1e-6)
    shown = ((pixels > 0) & (pixels < SIZE)).all(2)
    np.testing.assert_allclose(camera.undistort(pixels[shown]), ideal[shown], rtol=0, atol=0.2)
    assert np.isnan(camera.project(rays_to(np.geomspace(1.01, 50, 30) * fold))).all()
    assert np.isnan(camera.project(np.array([[0, 0, -1.0], [0.1, 0, 0]]))).all()
    grid = np.stack(np.meshgrid(np.linspace(0, 640, 33), np.linspace(0, 480, 25)), -1)
    ideal = camera.undistort(grid)  # corners that no point within the fold reaches have none
    radius = np.linalg.norm((ideal - camera.K[:2, 2]) / np.diag(camera.K)[:2], axis=2)
    assert np.nanmax(radius) <= fold and np.isfinite(radius).mean() > 0.3


def test_the_fold_of_one_radial_term_is_known():
    """r (1 + k r^2) turns back at r^2 = -1 / (3 k); without a fold the radius has no limit."""
    assert folded("SIMPLE_RADIAL").fold_radius == pytest.approx(np.sqrt(1 / 0.9), rel=0.005)
    assert rt.Camera("RADIAL", *SIZE, (500.0, 320.0, 240.0, 0.1, 0.0)).fold_radius == np.inf
    assert PINHOLE.fold_radius == np.inf


@pytest.mark.parametrize("model", FOLDED)
def test_boxes_beyond_the_fold_keep_the_part_in_the_image(model):
    """The bounds, in the image, of all points of the box within the fold."""
    camera = folded(model)
    fold_px = min(camera.fold_radius, 4) * camera.K[0, 0]
    x, y = camera.K[:2, 2]
    boxes = np.array([
        [x - 90, y - 60, x + 80, y + 120],  # within
        [x + 0.5 * fold_px, y - 100, x + 40 * fold_px, y + 150],  # partly beyond
        [x - 0.4 * fold_px, y - 0.3 * fold_px, x + 2 * fold_px, y + 3 * fold_px],
        [x - 9e4, y - 9e4, x + 9e4, y + 9e4],  # all of the image
        [x + 1.1 * fold_px, y - 100, x + 3 * fold_px, y + 150],  # beyond
        [np.nan] * 4,
    ])  # fmt: skip
    assert distort_boxes(boxes, PINHOLE) is boxes
    assert distort_boxes(boxes[None, :0], camera).shape == (1, 0, 4)
    found = distort_boxes(boxes, camera)
    assert camera.fold_radius >= 4 or np.isnan(found[4:]).all()
    limit = np.array([*SIZE, *SIZE])
    side = np.tan(np.linspace(-1.5, 1.5, 601)) * camera.K[0, 0]
    for box, bounds in zip(boxes[:4], found, strict=False):
        axes = [np.append(middle + side, box[k::2]).clip(*box[k::2])
                for k, middle in enumerate((x, y))]  # fmt: skip
        pixels = camera.distort(np.stack(np.meshgrid(*axes), -1).reshape(-1, 2))
        true = np.append(np.nanmin(pixels, 0), np.nanmax(pixels, 0))
        np.testing.assert_allclose(bounds.clip(0, limit), true.clip(0, limit), atol=2)


# ---- Rigid transforms and rays -------------------------------------------------------------------


def test_triangulated_rays_meet_in_the_point():
    """Two skew rays: halfway between them."""
    cams, point = some_cameras(), np.array([0.4, 0.1, 3.0])
    in_cam = cams[:, :, :3] @ point + cams[:, :, 3]
    rays = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)
    ray, centre, found = triangulate_rays(cams, rays)
    np.testing.assert_allclose(found, point, atol=1e-9)
    np.testing.assert_allclose(centre, [-c[:, :3].T @ c[:, 3] for c in cams], atol=1e-12)
    np.testing.assert_allclose(np.cross(ray, point - centre), 0, atol=1e-9)
    cams = np.tile(np.eye(4)[:3], (2, 1, 1))
    cams[1, :, 3] = [0, -1, -5]  # centre (0, 1, 5)
    _, _, point = triangulate_rays(cams, np.array([[0, 0, 1.0], [1, 0, 0]]))
    np.testing.assert_allclose(point, [0, 0.5, 5], atol=1e-9)


# ---- Poses and their files -----------------------------------------------------------------------


def lossy(**changes):
    cams = some_cameras()
    cams[2] = np.nan
    frame = np.array([3, 4, 5, 8, 9, 10])
    return dataclasses.replace(supplied(cams), frame=frame, **changes)


def test_frames_are_looked_up_in_the_poses():
    row, known = place_of(lossy(), np.array([8, 5, 6, 3, 99, 0]))
    assert known.tolist() == [True, False, False, True, False, False]
    assert row[known].tolist() == [3, 0]


@pytest.mark.parametrize("up", [None, np.array([0, 0.6, 0.8])])
def test_poses_are_kept_as_npz(tmp_path, up):
    status = np.array(["keyframe", "pnp", "none", "interpolated", "pnp", "keyframe"])
    poses = lossy(up_in_world=up, metric=True, status=status, points=np.ones((2, 3)),
                  colors=np.ones((2, 3), np.uint8), messages=("one", "two"))  # fmt: skip
    save_poses(tmp_path / "poses.npz", poses)
    back = load_poses(tmp_path / "poses.npz")
    for field in dataclasses.fields(rt.Poses):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(poses, field.name))
    assert back.camera == poses.camera and back.known.tolist() == [1, 1, 0, 1, 1, 1]


def test_tum_rows_are_seconds_centre_and_quaternion_xyzw(tmp_path):
    poses = lossy(metric=True)
    write_tum(tmp_path / "poses.txt", poses)
    rows = np.loadtxt(tmp_path / "poses.txt")
    known = poses.cam_from_world[poses.known]
    np.testing.assert_allclose(rows[:, 0], poses.time_s[poses.known], atol=1e-9)
    centre = [-cam[:, :3].T @ cam[:, 3] for cam in known]
    np.testing.assert_allclose(rows[:, 1:4], centre, atol=1e-8)
    turn = Rotation.from_quat(rows[:, 4:]).as_matrix()  # world_from_cam
    np.testing.assert_allclose(turn, known[:, :, :3].swapaxes(1, 2), atol=1e-8)
    assert "units: metres" in (tmp_path / "poses.txt").read_text()


def test_pycolmap_reads_our_text_model(tmp_path):
    points, colors = np.arange(6.0).reshape(2, 3), np.array([[1, 2, 3], [4, 5, 250]], np.uint8)
    poses = lossy(points=points, colors=colors)
    (tmp_path / "images.bin").write_bytes(b"of an older run")
    write_colmap(tmp_path, poses, [f"{i:04d}.jpg" for i in range(6)])
    model = read_sparse_model(tmp_path)
    (tmp_path / "images.bin").write_bytes(b"with observations")
    write_colmap(tmp_path, lossy(source="pycolmap"), [""] * 6)  # of pycolmap: kept
    assert (tmp_path / "images.bin").exists()
    assert model.names == ("0000.jpg", "0001.jpg", "0003.jpg", "0004.jpg", "0005.jpg")
    np.testing.assert_allclose(model.cam_from_world, poses.cam_from_world[poses.known], atol=1e-12)
    assert set(model.cameras) == {PINHOLE}
    np.testing.assert_array_equal(model.points, points)
    np.testing.assert_array_equal(model.colors, colors)


@pytest.mark.parametrize(
    "code",
    ["import sys, reobj_track; sys.exit('pycolmap' in sys.modules)",
     "import os, signal; from reobj.cameras import import_pycolmap; import_pycolmap();"
     "os.kill(os.getpid(), signal.SIGTERM)"],
)  # fmt: skip
def test_pycolmap_is_loaded_on_demand_and_keeps_the_termination_signal(code):
    folder = Path(rt.__file__).parent
    found = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True)
    assert found.returncode in (0, -15) and found.stderr == b""
