"""Inputs of --camera: numbers, COLMAP's lines, matrices, JSON files of many tools."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pose_worlds import SIZE

import reobj_track as rt
from reobj.poses.intrinsics import camera_line, parse_camera, stated_camera

PINHOLE = rt.Camera("PINHOLE", *SIZE, (500, 510, 320, 240))
OPENCV = rt.Camera("OPENCV", *SIZE, (500, 510, 320, 240, -0.1, 0.02, 0.001, 0.002))
TERMS = (-0.1, 0.02, 0.001, 0.002)
LIST = [-0.37, 0.14, -0.0002, -0.0004, -0.024]
K = [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
FLAT = [v for row in K for v in row]
TURNED = np.transpose(K).ravel().tolist()
FX = {"fx": 500, "fy": 510, "cx": 320, "cy": 240, "w": 640, "h": 480}
NAMED = dict(zip(("k1", "k2", "p1", "p2"), TERMS, strict=True))


def full(*terms):
    """Camera of up to eight terms in OpenCV's order."""
    terms = (*terms, *[0] * (8 - len(terms)))
    return rt.Camera("FULL_OPENCV", *SIZE, (500, 510, 320, 240, *terms))


def fisheye(*terms):
    return rt.Camera("OPENCV_FISHEYE", *SIZE, (500, 510, 320, 240, *terms))


FULL = full(*LIST)


@pytest.mark.parametrize(
    "text, camera",
    [
        ("  ", None),
        ("500,510,320,240", PINHOLE),
        ("500 510 320 240", PINHOLE),
        ("500,510,320,240,0,0,0,0", PINHOLE),
        ("500,510,320,240,-.1,.02,.001,.002", OPENCV),
        ("500,510,320,240,.2,-.7,-.003,-.0001,.9", full(0.2, -0.7, -0.003, -0.0001, 0.9)),
        ("500,510,320,240,.1,.2,.3,.4,.5,.6,.7,.8", full(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)),
        ("OPENCV 1280 960 1000 1020 640 480 -.1 .02 .001 .002", OPENCV),  # resized
    ],
)
def test_numbers_are_parsed(text, camera):
    found = stated_camera(text, SIZE)
    found = found and found.resized(SIZE)
    assert found == camera
    if camera:
        assert stated_camera(camera_line(camera), None) == camera


@pytest.mark.filterwarnings("error::RuntimeWarning")
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
        ("OPENCV 640 480 500 500 320 240 0 0 2 0", "distortion is invertible for only"),
        ("OPENCV 640 480 500 500 320 240 1e20 0 0 0", "distortion is invertible for only"),
        ("PINHOLE 480 640 500 500 240 320", "480x640 images, but the frames are 640x480"),
    ],
)
def test_a_wrong_camera_is_refused_in_one_line(text, message):
    with pytest.raises(rt.ReobjError, match=message) as refused:
        parse_camera(text, SIZE)
    assert str(refused.value).startswith(f"--camera {text}: ") and "\n" not in str(refused.value)


LIST = [-0.37, 0.14, -0.0002, -0.0004, -0.024]
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
REALSENSE = {"fx": 500, "fy": 510, "ppx": 320, "ppy": 240, "width": 640, "height": 480}
FILES = [  # name, content or JSON of it, camera
    ("cameras.txt", "# Camera list\n1 PINHOLE 640 480 500 510 320 240  # of a phone\n", PINHOLE),
    ("camera.txt", "PINHOLE 640 480 500 510 320 240", PINHOLE),
    ("K.txt", "5.00e+02 0 3.2e+02\n0 5.1e+02 2.4e+02\n0 0 1\n", PINHOLE),
    ("intrinsic_color.txt", "500 0 320 0\n0 510 240 0\n0 0 1 0\n0 0 0 1\n", PINHOLE),
    ("calib.txt", "P0: 500 0 320 0 0 510 240 0 0 0 1 0\nP1: 500 0 320 -9 0 510 240 0 0 0 1 0\n"
     "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n", PINHOLE),
    ("calib_cam_to_cam.txt", "calib_time: 09-Jan-2012 13:57:47\nK_00: 900 0 1 0 900 1 0 0 1\n"
     "P_rect_00: 5e2 0 3.2e2 0 0 5.1e2 2.4e2 0 0 0 1 0\n", PINHOLE),
    ("numbers.txt", "# fx fy cx cy\n500, 510, 320, 240\n", PINHOLE),
    ("ours.json", FX | {"model": "PINHOLE"}, PINHOLE),
    ("no_size.json", {"fx": 500, "fy": 510, "cx": 320, "cy": 240}, PINHOLE),
    ("no_centre.json", {"fx": 500.0, "fy": 510.0, "width": 640, "height": 480}, PINHOLE),
    ("params.json", {"model": "PINHOLE", "width": 640, "height": 480,
                     "params": [500, 510, 320, 240]}, PINHOLE),
    ("nerfstudio.json", {"camera_model": "OPENCV", "fl_x": 500, "fl_y": 510, "cx": 320, "cy": 240,
                         "w": 640.0, "h": 480.0, "k4": 0} | NAMED, OPENCV),
    ("K.json", {"K": K, "image_width": 640, "image_height": 480}, PINHOLE),
    ("record3d.json", {"K": TURNED, "w": 640, "h": 480, "poses": []}, PINHOLE),
    ("open3d.json", {"width": 640, "height": 480, "intrinsic_matrix": TURNED}, PINHOLE),
    ("ros.json", {"camera_matrix": {"rows": 3, "cols": 3, "data": FLAT}, "distortion_model":
                  "plumb_bob", "distortion_coefficients": {"data": LIST}}, FULL),
    ("nested.json", {"camera": FX}, PINHOLE),
    ("list.json", {"intrinsics": FLAT}, PINHOLE),
    ("half.json", {"cameraRes": [1280, 960], "K": (2 * np.array(K)).tolist()}, PINHOLE),
    ("named.json", FX | NAMED | {"k3": 0.3}, full(*TERMS, 0.3)),
    ("group.json", FX | {"distortion": NAMED}, OPENCV),
    ("flag.json", FX | {"is_fisheye": True, "k1": 0.1, "k4": 0.4}, fisheye(0.1, 0, 0, 0.4)),
    ("fisheye.json", FX | {"camera_model": "OPENCV_FISHEYE", "D": LIST[:4]}, fisheye(*LIST[:4])),
    ("realsense.json", REALSENSE | {"model": "Brown Conrady", "coeffs": LIST}, FULL),
    ("realsense.json", REALSENSE | {"coeffs": [0] * 5,
                                    "model": "distortion.inverse_brown_conrady"}, PINHOLE),
    *((f"{key}.json", {"cameraMatrix": K, key: [LIST]}, FULL) for key in (
        "Distortion_Coefficients", "dist_coeff", "distcoef", "distortion_coeffs", "dist", "kc")),
    ("out_camera_data.xml", XML, FULL),  # OpenCV's calibration sample
    ("fisheye.xml", XML.replace("<image_width>", "<fisheye_model>1</fisheye_model><image_width>")
     .replace(" -0.024", ""), fisheye(*LIST[:4])),
    ("opencv.yaml", f"%YAML:1.0\n---\nmtx: !!opencv-matrix\n   rows: 3\n   data: {FLAT}\n"
     f"D: !!opencv-matrix\n   rows: 1\n   data: {LIST}\n", FULL),
    ("blocks.yml", BLOCKS, FULL),  # PyYAML's default
    ("vins.yaml", VINS, OPENCV),
    ("orb.yaml", "%YAML:1.0\nCamera.type: KannalaBrandt8\nCamera.fx: 500\nCamera.fy: 510\n"
     "Camera.cx: 320\nCamera.cy: 240\nCamera.k1: 0.1\nCamera.k4: 0.4\n", fisheye(0.1, 0, 0, 0.4)),
    ("rectified.yaml", "%YAML:1.0\nCamera.type: Rectified\nCamera1.fx: 500\nCamera1.fy: 510\n"
     "Camera1.cx: 320\nCamera1.cy: 240\n", PINHOLE),
    ("ros2.yaml", f"d: {LIST}\nk: {FLAT}\nheight: 480\nwidth: 640\n---\n", FULL),
    ("niceslam.yaml", "cam: {H: 480, W: 640, fx: 500, fy: 510, cx: 320, cy: 240}\n", PINHOLE),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "camera"), FILES)
def test_camera_files_of_other_programs(tmp_path, name, content, camera):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
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
        ("a.json", '{"fx": 500, "model": "FOV", "cx": 1, "cy": 1}', "a FOV camera without"),
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
