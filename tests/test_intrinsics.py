"""Inputs of --camera: numbers, COLMAP's lines, matrices, JSON files of many tools."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from pose_worlds import SIZE, some_cameras, supplied

import reobj.poses.stage as stage
import reobj_track as rt
from reobj.poses.intrinsics import camera_line, parse_camera, stated_camera
from reobj.results.workspace import Workspace

PINHOLE = rt.Camera("PINHOLE", *SIZE, (500, 510, 320, 240))
OPENCV = rt.Camera("OPENCV", *SIZE, (500, 510, 320, 240, -0.1, 0.02, 0.001, 0.002))
FR2 = (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172)  # TUM RGB-D
K = [[500, 0, 320], [0, 510, 240], [0, 0, 1]]


def test_numbers_are_parsed():
    assert parse_camera("", SIZE) is None and parse_camera("  ", SIZE) is None
    assert parse_camera("500,510,320,240", SIZE) == PINHOLE
    assert parse_camera("500 510 320 240", SIZE) == PINHOLE
    assert parse_camera("500,510,320,240,0,0,0,0", SIZE) == PINHOLE
    opencv = parse_camera("500,510,320,240,-.1,.02", SIZE)
    assert opencv == rt.Camera("OPENCV", *SIZE, (500, 510, 320, 240, -0.1, 0.02, 0, 0))
    assert parse_camera("500,510,320,240,-.1,.02,.001,.002", SIZE) == OPENCV
    fr2 = parse_camera(",".join(map(str, FR2)), SIZE)
    assert fr2 == rt.Camera("FULL_OPENCV", *SIZE, (*FR2, 0, 0, 0))
    rational = (500, 510, 320, 240, -0.1, 0.02, 1e-3, 2e-3, 0.01, 0.02, 0.03, 0.04)
    found = parse_camera(",".join(map(str, rational)), SIZE)
    assert found == rt.Camera("FULL_OPENCV", *SIZE, rational)


@pytest.mark.parametrize(
    "text, message",
    [
        ("1,2,3", "3 numbers; expected fx,fy,cx,cy"),
        ("500,500,320,240" + ",0" * 9, "13 numbers"),
        ("a,b,c,d", "neither a file nor a camera"),
        ("camera.json", "neither a file nor a camera"),
        ("-5,5,320,240", "not positive"),
        ("500,nan,320,240", "not finite"),
        ("500,500,900,240", "do not fit"),  # centre of another size
        ("50,50,320,240", "do not fit"),  # focal length of no lens
        ("MAGIC 640 480 500 320 240", "no camera model MAGIC"),
        ("OPENCV 640 480 500 500 320 240", "4 parameters of a OPENCV camera; expected fx, fy"),
        ("PINHOLE 640 480 500 500 320 x", "neither a file nor a camera"),
        ("PINHOLE 640 480 500 500 320 nan", "not finite"),
        ("PINHOLE 9" + "0" * 30 + " 480 500 500 320 240", "size not of 1 to"),
        ("EQUIRECTANGULAR 640 480 640 480", "has no focal length"),
        ("PINHOLE 480 640 500 500 240 320", "480x640 images, but the frames are 640x480"),
    ],
)
def test_a_wrong_camera_is_refused_in_one_line(text, message):
    with pytest.raises(rt.ReobjError, match=message) as refused:
        parse_camera(text, SIZE)
    assert str(refused.value).startswith(f"--camera {text}: ") and "\n" not in str(refused.value)


FILES = {
    "cameras.txt": "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    "1 PINHOLE 640 480 500 510 320 240  # of a phone\n",
    "camera.txt": "PINHOLE 640 480 500 510 320 240",
    "K.txt": "5.00e+02 0 3.2e+02\n0 5.1e+02 2.4e+02\n0 0 1\n",
    "intrinsic_color.txt": "500 0 320 0\n0 510 240 0\n0 0 1 0\n0 0 0 1\n",
    "calib.txt": "".join(f"P{i}: 500 0 320 {-9 * i} 0 510 240 0 0 0 1 0\n" for i in range(4))
    + "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
    "calib_cam_to_cam.txt": "calib_time: 09-Jan-2012 13:57:47\nK_00: 900 0 1 0 900 1 0 0 1\n"
    "P_rect_00: 5e2 0 3.2e2 0 0 5.1e2 2.4e2 0 0 0 1 0\n",
    "numbers.txt": "# fx fy cx cy\n500, 510, 320, 240\n",
}
JSON = {
    "ours": {"model": "PINHOLE", "w": 640, "h": 480, "fx": 500, "fy": 510, "cx": 320, "cy": 240},
    "no size": {"fx": 500, "fy": 510, "cx": 320, "cy": 240},
    "no centre": {"fx": 500.0, "fy": 510.0, "width": 640, "height": 480},
    "params": {"model": "PINHOLE", "width": 640, "height": 480, "params": [500, 510, 320, 240]},
    "nerfstudio": {"camera_model": "OPENCV", "fl_x": 500, "fl_y": 510, "cx": 320, "cy": 240,
                   "w": 640.0, "h": 480.0, "k1": 0, "k2": 0, "k3": 0, "k4": 0, "p1": 0, "p2": 0},
    "K nested": {"K": K, "image_width": 640, "image_height": 480},
    "K flat": {"K": np.ravel(K).tolist()},
    "Record3D": {"K": np.ravel(np.transpose(K)).tolist(), "w": 640, "h": 480, "poses": []},
    "Open3D": {"width": 640, "height": 480, "intrinsic_matrix": np.ravel(np.transpose(K)).tolist()},
    "ROS": {"camera_matrix": {"rows": 3, "cols": 3, "data": np.ravel(K).tolist()},
            "distortion_model": "plumb_bob", "distortion_coefficients": {"data": [0] * 5}},
    "nested": {"camera": {"fx": 500, "fy": 510, "cx": 320, "cy": 240, "width": 640, "height": 480}},
    "list": {"intrinsics": np.ravel(K).tolist()},
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_text_files_are_read(tmp_path, name):
    (tmp_path / name).write_text(FILES[name])
    assert parse_camera(str(tmp_path / name), SIZE) == PINHOLE


@pytest.mark.parametrize("name", JSON)
def test_json_files_are_read(tmp_path, name):
    path = tmp_path / "intrinsics.json"
    path.write_text(json.dumps(JSON[name]))
    assert parse_camera(str(path), SIZE) == PINHOLE


LIST = [-0.37, 0.14, -0.0002, -0.0004, -0.024]
OPENCV_YAML = """%YAML:1.0
---
{matrix}: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 510., 240., 0., 0., 1. ]
{key}: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: {values}
"""


@pytest.mark.parametrize("yaml", [False, True])
@pytest.mark.parametrize(
    "key",
    ["Distortion_Coefficients", "dist_coeff", "distcoef", "distortion_coeffs", "dist", "D", "kc"],
)  # fmt: skip
def test_all_spellings_of_distortion_are_read(tmp_path, key, yaml):
    path = tmp_path / ("camera.yaml" if yaml else "camera.json")
    text = OPENCV_YAML.format(matrix="cameraMatrix", key=key, values=LIST)
    path.write_text(text if yaml else json.dumps({"cameraMatrix": K, key: [LIST]}))
    camera = parse_camera(str(path), SIZE)
    assert camera.model == "FULL_OPENCV" and camera.params[4:9] == tuple(LIST)


XML = """<?xml version="1.0"?>
<opencv_storage><image_width>640</image_width><image_height>480</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>500. 0. 320. 0. 510. 240. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>-3.7e-01 0.14 -2e-4 -0.0004 -0.024</data></distortion_coefficients></opencv_storage>
"""
BLOCKS = """camera_matrix:
- - 500.0
  - 0.0
  - 320.0
- [0.0, 510.0, 240.0]
- [0, 0, 1]
dist_coeff:
- - -3.7e-1
  - 0.14
  - -2e-4
  - -0.0004
  - -0.024
"""
VINS = """%YAML:1.0
---
model_type: PINHOLE
image_width: 640
image_height: 480
distortion_parameters:
   k1: -0.1
   k2: 0.02
   p1: 0.001
   p2: 0.002
projection_parameters:
   fx: 500.
   fy: 510.
   cx: 320.
   cy: 240.
"""
FLAT = [v for row in K for v in row]
REALSENSE = {"fx": 500, "fy": 510, "ppx": 320, "ppy": 240, "width": 640, "height": 480}
FULL = rt.Camera("FULL_OPENCV", *SIZE, (500, 510, 320, 240, *LIST, 0, 0, 0))


@pytest.mark.parametrize(
    ("name", "content", "camera"),
    [
        ("out_camera_data.xml", XML, FULL),  # OpenCV's calibration sample
        ("blocks.yml", BLOCKS, FULL),  # PyYAML's default
        ("vins.yaml", VINS, OPENCV),
        ("mtx.json", json.dumps({"mtx": K, "dist": [LIST]}), FULL),
        ("res.json", json.dumps({"cameraRes": [640, 480], "cameraMatrix": K, "dist": LIST}), FULL),
        ("half.json", json.dumps({"cameraRes": [1280, 960], "K": (2 * np.array(K)).tolist()}),
         PINHOLE),
        ("fisheye.yaml", "%YAML:1.0\nCamera.type: KannalaBrandt8\nCamera.fx: 500\nCamera.fy: 510\n"
         "Camera.cx: 320\nCamera.cy: 240\nCamera.k1: 0.1\nCamera.k4: 0.4\n",
         rt.Camera("OPENCV_FISHEYE", *SIZE, (500, 510, 320, 240, 0.1, 0, 0, 0.4))),
        ("sample.xml", XML.replace("<image_width>", "<fisheye_model>1</fisheye_model><image_width>")
         .replace(" -0.024", ""), rt.Camera("OPENCV_FISHEYE", *SIZE, FULL.params[:8])),
        ("ros2.yaml", f"d: {LIST}\nk: {FLAT}\nheight: 480\nwidth: 640\n---\n", FULL),
        ("niceslam.yaml", "cam: {H: 480, W: 640, fx: 500, fy: 510, cx: 320, cy: 240}\n", PINHOLE),
        ("rectified.yaml", "%YAML:1.0\nCamera.type: Rectified\nCamera1.fx: 500\nCamera1.fy: 510\n"
         "Camera1.cx: 320\nCamera1.cy: 240\n", PINHOLE),
        ("realsense.json", json.dumps(REALSENSE | {"model": "Brown Conrady", "coeffs": LIST}),
         FULL),
        ("realsense.json", json.dumps(REALSENSE | {"coeffs": [0] * 5,
         "model": "distortion.inverse_brown_conrady"}), PINHOLE),
    ],
)  # fmt: skip
def test_camera_files_of_other_programs(tmp_path, name, content, camera):
    path = tmp_path / name
    path.write_text(content)
    assert parse_camera(str(path), SIZE) == camera


def test_arrays_of_a_calibration_are_read(tmp_path):
    """As OpenCV's tutorial saves them; the matrix of undistorted images beside them is not."""
    arrays = {"mtx": np.array(K, float), "dist": np.array([LIST]), "rvecs": np.ones((4, 3, 1))}
    np.savez(tmp_path / "calib.npz", **arrays)
    assert parse_camera(str(tmp_path / "calib.npz"), SIZE) == FULL
    np.save(tmp_path / "K.npy", arrays["mtx"])
    assert parse_camera(str(tmp_path / "K.npy"), SIZE) == PINHOLE
    np.savez(tmp_path / "calib.npz", **arrays, newcameramtx=2 * np.eye(3))
    with pytest.raises(rt.ReobjError, match="'newcameramtx' is not read"):
        parse_camera(str(tmp_path / "calib.npz"), SIZE)


def test_the_format_of_a_camera_file_may_be_named(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("500 510 320 240\n")
    assert parse_camera(str(path), SIZE, "numbers") == PINHOLE
    with pytest.raises(rt.ReobjError, match=r"camera.yaml: expected one document of `key: value`"):
        parse_camera(str(path), SIZE)
    with pytest.raises(rt.ReobjError, match="--camera-format nonsense: no such format"):
        parse_camera(str(path), SIZE, "nonsense")


@pytest.mark.parametrize(
    "more, key",
    [
        ({"lensDistortion": LIST}, "lensDistortion"),
        ({"radial": [0.1, 0.2]}, "radial"),
        ({"Camera2.fx": 501}, "Camera2.fx"),
        ({"dist_coeffs": LIST, "k7": 0.1}, "k7"),
        ({"is_fisheye": True, "k1": 0.1, "p1": 0.1}, "p1"),
        ({"model": "PINHOLE", "params": [500, 510, 320, 240], "k1": 0.1}, "k1"),
        ({"model": "FOV", "omega": 0.9, "dist_coeffs": LIST}, "dist_coeffs"),
    ],
)
def test_distortion_that_is_not_read_is_refused(tmp_path, more, key):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(FX | more))
    with pytest.raises(rt.ReobjError, match=f"'{key}' is not read"):
        parse_camera(str(path), SIZE)
    zeros = {k: np.zeros_like(v).tolist() if k == key else v for k, v in more.items()}
    path.write_text(json.dumps({**FX, **zeros, "distortion_model": "", "is_undistorted": 1}))
    assert parse_camera(str(path), SIZE) is not None  # nothing is lost


FX = {"fx": 500, "fy": 510, "cx": 320, "cy": 240, "w": 640, "h": 480}
TERMS = (-0.1, 0.02, 0.001, 0.002)
NAMED = dict(zip(("k1", "k2", "p1", "p2"), TERMS, strict=True))


@pytest.mark.parametrize(
    "more, model, distortion",
    [
        (NAMED, "OPENCV", TERMS),
        ({**NAMED, "k3": 0.3}, "FULL_OPENCV", (*TERMS, 0.3, 0, 0, 0)),
        ({"dist_coeffs": [*TERMS, 0.3]}, "FULL_OPENCV", (*TERMS, 0.3, 0, 0, 0)),
        ({"distortion": NAMED}, "OPENCV", TERMS),
        ({"is_fisheye": True, "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.4)),
        ({"camera_model": "OPENCV_FISHEYE", "D": [0.1, 0.2, 0.3, 0.4]}, "OPENCV_FISHEYE",
         (0.1, 0.2, 0.3, 0.4)),
        ({"model": "SIMPLE_RADIAL", "k": -0.2}, "OPENCV", (-0.2, 0, 0, 0)),
        ({"model": "FOV", "omega": 0.9}, "FOV", (0.9,)),
        ({"model": "EUCM", "alpha": 0.5, "beta": 1.1}, "EUCM", (0.5, 1.1)),
    ],
)  # fmt: skip
def test_distortion_in_json_is_read(tmp_path, more, model, distortion):
    path = tmp_path / "intrinsics.json"
    path.write_text(json.dumps(FX | more))
    assert parse_camera(str(path), SIZE) == rt.Camera(
        model, *SIZE, (500, 510, 320, 240, *distortion)
    )


def test_a_camera_of_another_size_is_resized_and_of_another_shape_refused(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text("7 OPENCV 1280 960 1000 1020 640 480 -0.1 0.02 0.001 0.002\n")
    assert parse_camera(str(path), SIZE) == OPENCV
    with pytest.raises(rt.ReobjError, match="1280x960 images, but the frames are 480x640"):
        parse_camera(str(path), (480, 640))


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.json", "{", "line 1: not valid JSON"),
        ("a.json", "[1, 2]", "no known format of cameras"),
        ("a.json", '{"w": 640, "h": 480}', "no known focal length"),
        ("a.json", '{"fx": 500, "cx": 320}', "not a camera file"),
        ("a.json", '{"fx": 500, "w": Infinity, "h": 480}', "images of inf pixels"),
        ("a.json", '{"fx": 500, "w": 640, "h": 0}', "images of 0 pixels"),
        ("a.json", '{"K": [1, 2]}', "intrinsics of 2 numbers"),
        ("a.json", '{"K": [500, 3, 320, 0, 500, 240, 0, 0, 1]}', "a skew of 3"),
        (
            "a.json",
            '{"fc": [500, 510], "cc": [320, 240]}',
            "no known focal length among cc, fc",
        ),
        ("a.json", '{"fx": 500, "cx": 320, "cy": 240, "k1": 0.1, "k4": 0.01}', "k4 without k5"),
        (
            "a.json",
            '{"fx": 500, "coeffs": [1], "model": "distortion.inverse_brown_conrady"}',
            "INVERSE_BROWN_CONRADY",
        ),
        ("mei.yaml", "model_type: MEI\nprojection_parameters: {gamma1: 500}\n", "model MEI"),
        ("omni.yaml", "cam0: {camera_model: omni, intrinsics: [1, 500, 510, 320, 240]}", "OMNI"),
        ("a.json", '{"fx": 500, "model": "FOV"}', "no omega of a FOV camera"),
        ("cameras.txt", "1 PINHOLE 640 480 500 510 320 240\n" * 2, "2 cameras; expected one"),
        ("K.txt", "1 2\n3 4\n", "no known format"),
        ("calib.txt", "P0: 1 0 1 0 0 1 1 0 0 0 1 0\nP2: 2 0 1 0 0 1 1 0 0 0 1 0\n", "different"),
        ("camera.txt", "Pinhole .5 .6 .5 .5 0\n640 480\ncrop\n640 480\n", "no known format"),
        ("mirror.yaml", "fx: 500\ncx: 320\ncy: 240\nmirror_parameters: {xi: 1.2}\n", "not read"),
        ("rig.yaml", "cam0: {intrinsics: [1]}\ncam1: {intrinsics: [1]}\n", "cameras cam0, cam1"),
        ("a.yaml", "fx: [\n", "not valid YAML"),
        ("empty.txt", "", "no known format"),
        ("picture.txt", bytes(range(256)), "no known format"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(rt.ReobjError, match=message) as refused:
        parse_camera(str(path), SIZE)
    assert str(refused.value).startswith(f"--camera {path}: ") and "\n" not in str(refused.value)


def test_a_camera_file_defines_the_size_if_nothing_else_does():
    assert stated_camera("PINHOLE 640 480 500 510 320 240", None) == PINHOLE
    with pytest.raises(rt.ReobjError, match="no image size"):
        stated_camera("500,510,320,240", None)


def test_a_line_is_read_back_with_all_digits():
    camera = rt.Camera("OPENCV", *SIZE, (500.123456789012, 510, 320, 240, 1e-17, 0, 0, 0.1 + 0.2))
    assert parse_camera(camera_line(camera), SIZE) == camera


def test_a_changed_camera_file_gives_another_reconstruction(tmp_path, monkeypatch):
    """The cache key contains the camera in the file, not the file's name."""
    path, cameras = tmp_path / "camera.txt", []

    def found(video, config, work, **_):
        camera = parse_camera(config.camera, video.size)
        cameras.append(camera)
        (work / "sparse").mkdir(parents=True)
        return dataclasses.replace(supplied(some_cameras(2)), camera=camera, source="pycolmap")

    monkeypatch.setattr(stage, "estimate_poses", found)
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((480, 640, 3), np.uint8))
    video, workspace = rt.Video(tmp_path / "*.png"), Workspace(tmp_path / "out")
    config = rt.PosesConfig(camera=str(path))
    for content in ("500,510,320,240", "PINHOLE 640 480 500 510 320 240", "600,610,320,240"):
        path.write_text(content)
        poses, _ = stage.reconstruct_cached(video, config, workspace)
        assert poses.camera == parse_camera(content, SIZE)
    assert len(cameras) == 2  # the first two are the same camera
