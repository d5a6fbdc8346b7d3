"""Poses of other tools: round trip of every format, refusal of damaged files, frame lookup."""

from __future__ import annotations

import dataclasses
import json
import struct
import zipfile

import cv2
import numpy as np
import pytest
from pose_worlds import FOCAL, FRAMES, PINHOLE, SIZE, FakeVideo, blank, some_cameras, supplied
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import import_pycolmap, invert_rigid, write_colmap, write_tum
from reobj.poses.supplied import pose_formats as colmap_model

CAMERA = f"{FOCAL},{FOCAL},320,240"
K = [[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]]
NAMES = [f"{i:04d}.jpg" for i in range(FRAMES)]
EVERY_SECOND = rt.InputConfig(every=2)


GL = np.diag([1.0, -1, -1, 1])


def full(matrix):
    return np.concatenate([matrix, np.tile([[[0, 0, 0, 1.0]]], (len(matrix), 1, 1))], 1)


def as_tum(folder, cams):
    w = invert_rigid(cams)
    q = Rotation.from_matrix(w[:, :, :3]).as_quat()
    rows = [[i / 30, *w[i, :, 3], *q[i]] for i in range(len(w))]
    return text(folder / "poses.txt", rows, "# t tx ty tz qx qy qz qw\n")


def as_record3d(folder, cams):
    w = full(invert_rigid(cams)) @ GL
    q = Rotation.from_matrix(w[:, :3, :3]).as_quat()
    data = {"w": 640, "h": 480, "K": [FOCAL, 0, 0, 0, FOCAL, 0, 320, 240, 1],
            "poses": [[*q[i], *w[i, :3, 3]] for i in range(len(w))]}  # fmt: skip
    return text(folder / "metadata", json.dumps(data))


def as_scannet(folder, cams):
    (folder / "pose").mkdir()
    (folder / "intrinsic").mkdir()
    text(
        folder / "intrinsic" / "intrinsic_color.txt",
        [[FOCAL, 0, 319.5], [0, FOCAL, 239.5], [0, 0, 1]],
    )
    for i, w in enumerate(full(invert_rigid(cams))):
        text(folder / "pose" / f"{i}.txt", w)
    return folder


def as_seven_scenes(folder, cams):
    for i, w in enumerate(full(invert_rigid(cams))):
        text(folder / f"frame-{i:06d}.pose.txt", w)
    return folder


def as_polycam(folder, cams):
    (folder / "keyframes" / "corrected_cameras").mkdir(parents=True)
    for i, w in enumerate(full(invert_rigid(cams)) @ GL):
        numbers = {f"t_{r}{c}": w[r, c] for r in range(3) for c in range(4)}
        own = {"fx": FOCAL, "fy": FOCAL, "cx": 320, "cy": 240, "width": 640, "height": 480}
        path = folder / "keyframes" / "corrected_cameras" / f"{i:04d}.json"
        text(path, json.dumps(numbers | own | {"blur_score": 80.0}))
    return folder


def as_3d_scanner_app(folder, cams):
    text(folder / "info.json", json.dumps({"device": "a phone"}))
    for i, w in enumerate(full(invert_rigid(cams)) @ GL):
        data = {"cameraPoseARFrame": w.ravel().tolist(), "intrinsics": np.ravel(K).tolist()}
        text(folder / f"frame_{i:05d}.json", json.dumps(data | {"time": i / 30}))
    return folder


def transforms(cams, names, **more):
    frames = [
        {"file_path": n, "transform_matrix": (w @ GL).tolist()}
        for n, w in zip(names, cams, strict=True)
    ]
    return json.dumps({"frames": frames, "w": 640, "h": 480, **more})


def as_instant_ngp(folder, cams):
    angle = 2 * np.arctan(320 / FOCAL)
    names = [f"images/{i:04d}.jpg" for i in range(len(cams))]
    return text(
        folder / "transforms.json",
        transforms(full(invert_rigid(cams)), names, camera_angle_x=angle),
    )


def as_nerfstudio(folder, cams):
    applied = np.array([[0, 1.0, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.5]])
    turned = full(applied[None]) @ full(invert_rigid(cams))
    names = [f"./images/{i:04d}.jpg" for i in range(len(cams))]
    more = {
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": 320.0,
        "cy": 240.0,
        "applied_transform": applied.tolist(),
    }
    return text(folder / "transforms.json", transforms(turned, names, **more)).parent


def as_colmap_text(folder, cams):
    return model(folder / "sparse" / "0", cams).parents[1]


def image_rows(folder):
    return [line for line in (folder / "images.txt").read_text().splitlines() if line]


def as_colmap_poses_only(folder, cams):
    """Without the blank lines of observations."""
    model(folder, cams)
    text(folder / "images.txt", "\n".join(image_rows(folder)))
    return folder / "images.txt"


def as_colmap_without_points(folder, cams):
    """Without the blank lines and without points3D.txt."""
    as_colmap_poses_only(folder, cams)
    (folder / "points3D.txt").unlink()
    return folder


def as_colmap_with_observations(folder, cams):
    """With observations, of points that points3D.txt does not hold."""
    model(folder, cams)
    rows = [f"{row}\n1.5 2.5 -1 3.5 4.5 7" for row in image_rows(folder)]
    text(folder / "images.txt", "# comment\n" + "\n".join(rows))
    return folder


def as_colmap_binary(folder, cams):
    pycolmap = pytest.importorskip("pycolmap")
    model(folder / "text", cams)
    pycolmap.Reconstruction(str(folder / "text")).write_binary(str(folder))
    return folder


def model(folder, cams, camera=PINHOLE):
    """Write our own COLMAP text model, with two points that no image observes."""
    points = np.arange(6.0).reshape(2, 3)
    extra = {"points": points, "colors": np.array([[9, 8, 7], [255, 0, 1]], np.uint8)}
    extra["camera"] = camera
    write_colmap(folder, dataclasses.replace(supplied(cams), **extra), NAMES[: len(cams)])
    return folder


def text(path, rows, head=""):
    if not isinstance(rows, str):
        rows = head + "".join(
            " ".join(repr(float(v)) for v in np.ravel(row)) + "\n" for row in rows
        )
    path.write_text(rows)
    return path


def as_kitti(folder, cams):
    return text(folder / "00.txt", [w.ravel() for w in invert_rigid(cams)])


def as_replica(folder, cams):
    return text(folder / "traj.txt", [w.ravel() for w in full(invert_rigid(cams))]).parent


def table(path, head, rows):
    path.write_text(f"{head}\n" + "".join(", ".join(map(str, row)) + "\n" for row in rows))
    return path


BODY_FROM_CAM = np.array([[0, 0, 1.0, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]])
SENSOR = """#Default
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{},
         {}]
resolution: [640, 480]
distortion_model: radial-tangential
distortion_coefficients: [0, 0, 0, 0]
intrinsics: [500.0, 500.0, 320, 240] #fu, fv, cu, cv
"""


def as_euroc(folder, cams, sensor=True):
    """Poses of the body, ns, w first, 17 columns; sensor.yaml of the camera in cam0 beside."""
    w = full(invert_rigid(cams)) @ np.linalg.inv(BODY_FROM_CAM if sensor else np.eye(4))
    q = Rotation.from_matrix(w[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    (folder / "gt").mkdir()
    (folder / "cam0").mkdir()
    if sensor:
        numbers = [repr(v) for v in BODY_FROM_CAM.ravel().tolist()]
        text_ = SENSOR.format(", ".join(numbers[:7]), ", ".join(numbers[7:]))
        (folder / "cam0" / "sensor.yaml").write_text(text_)
        (folder / "gt" / "sensor.yaml").write_text("sensor_type: visual-inertial\n")
    head = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    head += "q_RS_z [], " + ", ".join(f"v_RS_R_{a} [m s^-1]" for a in "xyz")
    head += "".join(f", b_{s}_RS_S_{a} []" for s in "wa" for a in "xyz")
    rows = [[i * 33333333, *w[i, :3, 3], *q[i], *[0.0] * 9] for i in range(len(w))]
    return table(folder / "gt" / "data.csv", head, rows).parent


def as_orbslam3(folder, cams):
    """ns since 1970, x first, spaces."""
    w = invert_rigid(cams)
    q = Rotation.from_matrix(w[:, :, :3]).as_quat()
    rows = [[1.7e18 + i * 1e9 / 30, *w[i, :, 3], *q[i]] for i in range(len(w))]
    return text(folder / "KeyFrameTrajectory.txt", rows)


def as_stray(folder, cams):
    w = invert_rigid(cams)
    q = Rotation.from_matrix(w[:, :, :3]).as_quat()
    rows = [[100 + i / 60, f"{i:06d}", *w[i, :, 3], *q[i]] for i in range(len(w))]
    table(folder / "odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw", rows)
    return table(folder / "camera_matrix.csv", "500.0, 0.0, 320.0", K[1:]).parent


def as_arkitscenes(folder, cams):
    turn = Rotation.from_matrix(cams[:, :, :3]).as_rotvec()
    rows = [[i / 30, *turn[i], *cams[i, :, 3]] for i in range(len(cams))]
    (folder / "lowres_wide_intrinsics").mkdir()
    for i in range(len(cams)):
        path = folder / "lowres_wide_intrinsics" / f"41048190_{i / 30:.3f}.pincam"
        text(path, [[640, 480, FOCAL, FOCAL, 320, 240]])
    return text(folder / "lowres_wide.traj", rows).parent


def as_scannetpp(folder, cams):
    entries = {
        f"frame_{i:06d}": {"aligned_pose": w.tolist(), "pose": np.eye(4).tolist(), "intrinsic": K}
        for i, w in enumerate(full(invert_rigid(cams)))
    }
    return text(folder / "pose_intrinsic_imu.json", json.dumps(entries))


def as_llff(folder, cams):
    w = invert_rigid(cams)
    right, down, forward = (w[:, :, k] for k in range(3))
    hwf = np.tile([480, 640, FOCAL], (len(w), 1))
    rows = np.stack([down, right, -forward, w[:, :, 3], hwf], 2).reshape(-1, 15)
    np.save(folder / "poses_bounds.npy", np.column_stack([rows, np.ones((len(w), 2))]))
    return folder


def as_splatting(folder, cams):
    w = invert_rigid(cams)
    entries = [
        {"id": i, "img_name": f"{i:04d}", "width": 640, "height": 480, "fx": FOCAL, "fy": FOCAL,
         "position": w[i, :, 3].tolist(), "rotation": w[i, :, :3].tolist()} for i in range(len(w))
    ]  # fmt: skip
    return text(folder / "cameras.json", json.dumps(entries))


def as_r3d(folder, cams):
    with zipfile.ZipFile(folder / "scan.r3d", "w") as file:
        file.writestr("metadata", as_record3d(folder, cams).read_text())
    return folder / "scan.r3d"


def as_r3d_folder(folder, cams):
    return as_record3d(folder, cams).parent


# writer, metric, up in world
FORMATS = [
    (as_tum, True, None), (as_record3d, True, (0, 1, 0)), (as_scannet, True, (0, 0, 1)),
    (as_instant_ngp, False, None), (as_nerfstudio, False, None), (as_colmap_text, False, None),
    (as_colmap_poses_only, False, None), (as_colmap_without_points, False, None),
    (as_colmap_with_observations, False, None), (as_colmap_binary, False, None),
    (as_seven_scenes, True, None), (as_polycam, True, (0, 1, 0)),
    (as_3d_scanner_app, True, (0, 1, 0)),
    (as_kitti, True, None), (as_replica, True, None), (as_euroc, True, None),
    (as_orbslam3, True, None), (as_stray, True, (0, 1, 0)), (as_arkitscenes, True, (0, 0, 1)),
    (as_scannetpp, True, (0, 0, 1)), (as_llff, False, None), (as_splatting, False, None),
    (as_r3d, True, (0, 1, 0)), (as_r3d_folder, True, (0, 1, 0)),
]  # fmt: skip
BY_ORDER = (as_record3d, as_kitti, as_replica, as_llff, as_r3d, as_r3d_folder)
BY_TIME = (as_tum, as_euroc, as_orbslam3, as_arkitscenes)


WITHOUT_CAMERA = (as_tum, as_seven_scenes, as_kitti, as_replica, as_orbslam3)


@pytest.mark.parametrize("options", [{}, {"fmt": "splatting"}])
def test_a_folder_with_cameras_json_is_read(tmp_path, options):
    assert as_splatting(tmp_path, some_cameras()).is_file()
    poses = read(tmp_path, **options)
    np.testing.assert_allclose(poses.cam_from_world, some_cameras(), atol=1e-9)


@pytest.mark.parametrize("write, metric, up", FORMATS, ids=lambda v: getattr(v, "__name__", None))
def test_any_format_can_be_declared_metric(tmp_path, write, metric, up):
    path, camera = write(tmp_path, some_cameras()), CAMERA if write in WITHOUT_CAMERA else ""
    assert read(path, camera=camera, metric=True).metric
    assert read(path, camera=camera).metric == metric


@pytest.mark.parametrize("write", [as_tum, as_kitti, as_orbslam3, as_replica])
def test_a_unit_that_the_format_does_not_state_is_declared_or_assumed_once(tmp_path, write):
    path = write(tmp_path, some_cameras())
    path = path / "traj.txt" if path.is_dir() else path
    poses = read(path, camera=CAMERA)
    assert poses.metric and "metres assumed" in poses.reading
    assert "assumed" not in read(path, camera=CAMERA, metric=True).reading
    content = path.read_text()
    for unit in ("arbitrary", "metres"):
        path.write_text(f"# units: {unit}\n{content}")
        poses = read(path, camera=CAMERA)
        assert poses.metric == (unit == "metres") and "assumed" not in poses.reading


@pytest.mark.parametrize("write, metric, up", FORMATS, ids=lambda v: getattr(v, "__name__", None))
@pytest.mark.parametrize("named", [True, False])
def test_frames_without_a_pose_are_known(tmp_path, write, metric, up, named):
    """Six poses for eight frames: all formats but the one that has neither names nor times."""
    path, cams = write(tmp_path, some_cameras()), some_cameras()
    names = [f"{i:04d}.jpg" for i in range(FRAMES + 2)] if named else ()
    video, camera = blank(FRAMES + 2, names), CAMERA if write in WITHOUT_CAMERA else ""
    clocks = write in BY_TIME and (named or write is as_orbslam3)  # images without times
    if write in BY_ORDER or clocks:
        message = (
            "expected seconds" if clocks else "6 rows, frame numbers up to 7; .*frames_by=number"
        )
        with pytest.raises(rt.ReobjError, match=message):
            read(path, video, camera=camera)
        return
    poses = read(path, video, camera=camera)
    assert poses.known.tolist() == [True] * 6 + [False] * 2
    np.testing.assert_allclose(poses.cam_from_world[:6], cams, atol=1e-9)
    assert any("6 of 8 frames, none for 6-7" in message for message in poses.messages)


@pytest.mark.parametrize("write, metric, up", FORMATS, ids=lambda v: getattr(v, "__name__", None))
def test_a_subset_of_the_images_gets_its_poses(tmp_path, write, metric, up):
    """Every second image under its original name, as in subsampled 7-Scenes and Record3D data."""
    path, cams = write(tmp_path, some_cameras()), some_cameras()
    name = {as_seven_scenes: "frame-{:06d}.color.png", as_3d_scanner_app: "frame_{:05d}.jpg"}
    names = [name.get(write, "{:04d}.jpg").format(i) for i in (0, 2, 4)]
    if write in BY_TIME:
        return
    poses = read(path, blank(3, names), camera=CAMERA if write in WITHOUT_CAMERA else "")
    np.testing.assert_allclose(poses.cam_from_world, cams[::2], atol=1e-9)


def test_mismatched_numbers_of_names_are_not_used(tmp_path):
    """Images counted from 1, poses from 0: both in order, as the frames' own numbers say."""
    path, cams = as_seven_scenes(tmp_path, some_cameras()), some_cameras()
    names = [f"IMG_{i:04d}.jpg" for i in range(1, FRAMES + 1)]
    poses = read(path, blank(FRAMES, names), camera=CAMERA)
    np.testing.assert_allclose(poses.cam_from_world, cams, atol=1e-9)


@pytest.mark.parametrize("write", [as_seven_scenes, as_record3d])
def test_every_second_image_counted_from_1_keeps_its_pose(tmp_path, write):
    """With --every 2 all their numbers have a pose, the wrong one."""
    for i in range(1, FRAMES + 1):
        cv2.imwrite(str(tmp_path / f"IMG_{i:04d}.png"), np.zeros((480, 640, 3), np.uint8))
    (tmp_path / "poses").mkdir()
    path, video = write(tmp_path / "poses", some_cameras()), rt.Video(tmp_path, EVERY_SECOND)
    poses = rt.read_poses(path, video, camera=CAMERA)
    np.testing.assert_allclose(poses.cam_from_world, some_cameras()[::2], atol=1e-9)


@pytest.mark.parametrize("write", [as_colmap_text, as_colmap_binary, as_nerfstudio])
def test_distorted_cameras_of_files_are_read(tmp_path, write):
    """FULL_OPENCV of a COLMAP model, k3 of a transforms.json."""
    terms = (-0.1, 0.02, 0.001, 0.002, 0.3, 0.0, 0.0, 0.0)
    camera = rt.Camera("FULL_OPENCV", *SIZE, (FOCAL, FOCAL, 320.0, 240.0, *terms))
    if write is as_nerfstudio:
        path = write(tmp_path, some_cameras())
        named = zip(("k1", "k2", "p1", "p2", "k3"), terms[:5], strict=True)
        edit_json(tmp_path / NGP, lambda data: data.update(dict(named)))
    else:
        path = model(tmp_path, some_cameras(), camera)
        if write is as_colmap_binary:
            pycolmap = pytest.importorskip("pycolmap")
            pycolmap.Reconstruction(str(path)).write_binary(str(path))
    assert read(path).camera == camera


@pytest.mark.parametrize("binary", [False, True])
def test_observations_of_the_points_of_a_model_are_read(tmp_path, binary):
    """As rows of frames, of which the first has no pose."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 20
    truth = pycolmap.synthesize_dataset(options)
    (truth.write_binary if binary else truth.write_text)(str(tmp_path))
    size = (truth.camera(1).width, truth.camera(1).height)
    names = ["0.png", *sorted(image.name for image in truth.images.values())]
    video = FakeVideo([np.zeros((size[1], size[0], 3), np.uint8)] * 5, names)
    poses = read(tmp_path, video)
    assert poses.known.tolist() == [False] + [True] * 4 and len(poses.points) == 20
    ids = sorted(truth.points3D)
    seen = {(names.index(truth.image(e.image_id).name), row)
            for row, i in enumerate(ids) for e in truth.point3D(i).track.elements}  # fmt: skip
    assert set(map(tuple, poses.visibility.tolist())) == seen and len(poses.visibility) > 40


def read(path, video=None, **options):
    return rt.read_poses(path, video or blank(FRAMES, NAMES), **options)


@pytest.mark.parametrize("write, metric, up", FORMATS, ids=lambda v: getattr(v, "__name__", None))
def test_every_format_is_read_back_unchanged(tmp_path, write, metric, up):
    cams = some_cameras()
    poses = read(write(tmp_path, cams), camera=CAMERA if write in WITHOUT_CAMERA else "")
    np.testing.assert_allclose(poses.cam_from_world, cams, atol=1e-9)
    np.testing.assert_allclose(poses.camera.K, K, atol=1e-9)
    assert poses.known.all() and poses.metric == metric and set(poses.status) == {"supplied"}
    np.testing.assert_array_equal(poses.up_in_world, up)


@pytest.mark.parametrize("fmt", ["tum", "transforms", "scannet", "record3d", "colmap"])
def test_the_format_option_is_used(tmp_path, fmt):
    """A file with an unknown name is read as TUM unless another format is given."""
    write = {"tum": as_tum, "transforms": as_instant_ngp, "scannet": as_scannet,
             "record3d": as_record3d, "colmap": as_colmap_text}[fmt]  # fmt: skip
    path = write(tmp_path, some_cameras())
    if path.is_file():
        path = path.rename(tmp_path / "cameras.dat")
    np.testing.assert_allclose(read(path, fmt=fmt, camera=CAMERA).cam_from_world, some_cameras())
    other = "record3d" if fmt == "transforms" else "transforms"
    with pytest.raises(rt.ReobjError):
        read(path, fmt=other, camera=CAMERA)


def test_the_given_camera_replaces_the_files(tmp_path):
    poses = read(as_record3d(tmp_path, some_cameras()), camera="510,505,322,238,.1,0,0,0")
    assert poses.camera == rt.Camera("OPENCV", *SIZE, (510, 505, 322, 238, 0.1, 0, 0, 0))


@pytest.mark.parametrize("write", [as_colmap_text, as_colmap_binary])
def test_colmap_points_are_sorted_by_id(tmp_path, write):
    path = write(tmp_path, some_cameras())
    if write is as_colmap_text:
        points = path / "sparse" / "0" / "points3D.txt"
        points.write_text("\n".join(reversed(points.read_text().splitlines())) + "\n")
    poses = read(path)
    form = "text" if write is as_colmap_text else "binary"
    assert poses.reading.startswith(f"colmap ({form})")
    np.testing.assert_array_equal(poses.points, np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(poses.colors, [[9, 8, 7], [255, 0, 1]])


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_observations_become_rows_of_frames_and_points(tmp_path, binary):
    """Ids count from 1 here; images 1 and 6 of the model are no frames of the video."""
    folder = model(tmp_path / "text", some_cameras())
    observed = {1: [1, 2], 2: [2], 3: [1], 4: [], 5: [1, 2], 6: [1]}  # points of each image
    rows = [
        f"{row}\n" + " ".join(f"{9 * k + 1}.5 2.5 {point}" for k, point in enumerate(points))
        for row, points in zip(image_rows(folder), observed.values(), strict=True)
    ]
    text(folder / "images.txt", "\n".join(rows) + "\n")
    lines = (folder / "points3D.txt").read_text().splitlines()
    tracks = [
        [f"{image} {points.index(p)}" for image, points in observed.items() if p in points]
        for p in (1, 2)
    ]
    pairs = zip(lines, tracks, strict=True)
    text(folder / "points3D.txt", "".join(f"{row} {' '.join(seen)}\n" for row, seen in pairs))
    if binary:
        found = pytest.importorskip("pycolmap").Reconstruction(str(folder))
        folder = tmp_path / "binary"
        folder.mkdir()
        found.write_binary(str(folder))
    poses = read(folder, blank(4, NAMES[1:5]))
    assert sorted(map(tuple, poses.visibility.tolist())) == [(0, 1), (1, 0), (3, 0), (3, 1)]
    assert len(poses.points) == 2


def test_own_files_are_read_back(tmp_path):
    cams = some_cameras()
    cams[2] = np.nan
    poses = dataclasses.replace(supplied(cams), source="pycolmap")
    write_tum(tmp_path / "poses.txt", poses)
    back = read(tmp_path / "poses.txt", camera=CAMERA)
    np.testing.assert_allclose(back.cam_from_world, cams, atol=1e-8)
    assert not back.metric  # the header states that the scale is unknown
    assert "5 of 6" in back.messages[0]


# ---- Damaged files: location, found and expected content, remedy ---------------------------------


def edit(path, line, change):
    lines = path.read_text().splitlines()
    lines[line] = change(lines[line])
    path.write_text("\n".join(lines) + "\n")


def word(index, value):
    return lambda line: " ".join(value if i == index else w for i, w in enumerate(line.split()))


def drop_last(line):
    return " ".join(line.split()[:-1])


def edit_json(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def mirror(numbers):
    m = np.array(numbers, float).reshape(4, 4)
    m[:3, 0] *= -1
    return m.tolist()


def edit_frame(path, **changes):
    edit_json(path, lambda data: data["frames"][1].update(changes))


def mirror_frame(path):
    edit_json(
        path,
        lambda d: d["frames"][1].update(
            transform_matrix=mirror(d["frames"][1]["transform_matrix"])
        ),
    )


def rename_frames(path):
    edit_json(path, lambda data: [frame.update(file_path="a.png") for frame in data["frames"]])


def transpose(path):
    text(path, np.loadtxt(path).T)


NGP, COLOR = "transforms.json", "intrinsic/intrinsic_color.txt"
ONLY, IMAGES, CAMERAS = as_colmap_poses_only, "images.txt", "cameras.txt"


def put(path, offset, value):
    """Overwrite a double of a binary file."""
    data = bytearray(path.read_bytes())
    data[offset : offset + 8] = np.float64(value).tobytes()
    path.write_bytes(data)


# writer, file, how it is damaged, what the message must hold
DAMAGED = [
    (as_tum, "poses.txt", lambda p: edit(p, 2, drop_last), "line 3: 7 words"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(7, "0.1")), "line 4: the quaternion"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(2, "abc")), "line 4: .*expected 8 numbers"),
    (as_tum, "poses.txt", lambda p: p.write_text("# nothing\n"), "no known format"),
    (as_tum, "poses.txt", lambda p: p.write_bytes(b"\xff\xfe\x00\x81"), "no known format"),
    (as_scannet, "pose/1.txt", lambda p: edit(p, 1, word(0, "3.0")), "1.txt: .*not a rotation"),
    (as_scannet, "pose/1.txt", transpose, "1.txt: .*row-major"),
    (
        as_scannet,
        "pose/2.txt",
        lambda p: edit(p, 1, drop_last),
        "2.txt, line 2: 3 words .*; expected 4 numbers",
    ),
    (
        as_scannet,
        "pose/2.txt",
        lambda p: edit(p, 1, word(0, "x")),
        "line 2: .*expected 4 numbers",
    ),
    (as_scannet, "pose/2.txt", lambda p: text(p, mirror(np.loadtxt(p))), "2.txt: .*mirrored"),
    (as_scannet, COLOR, lambda p: p.unlink(), "--camera"),
    (as_scannet, COLOR, lambda p: edit(p, 0, word(2, "648")), "do not fit"),
    (as_instant_ngp, NGP, lambda p: p.write_text(p.read_text()[:50]), "not valid JSON"),
    (as_instant_ngp, NGP, lambda p: p.write_text("[1]"), "no known format"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.pop("frames")), "no known format"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.pop("camera_angle_x")), "--camera"),
    (
        as_instant_ngp,
        NGP,
        lambda p: edit_frame(p, transform_matrix=[1, 2]),
        r"frames\[1\]: no pose and camera",
    ),
    (as_instant_ngp, NGP, lambda p: edit_frame(p, fl_x="wide"), r"frames\[1\]: no pose and camera"),
    (
        as_instant_ngp,
        NGP,
        lambda p: edit_json(p, lambda d: d.update(applied_transform="no")),
        "damaged, or no file of format transforms",
    ),
    (as_instant_ngp, NGP, mirror_frame, r"frames\[1\]: .*mirrored"),
    (as_instant_ngp, NGP, lambda p: edit_frame(p, fl_x=900.0), "several different cameras"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.update(w=480, h=640)), "rotated"),
    (as_instant_ngp, NGP, rename_frames, "none of its"),
    (
        as_record3d,
        "metadata",
        lambda p: edit_json(p, lambda d: d.pop("K")),
        "no known format",
    ),
    (ONLY, IMAGES, lambda p: edit(p, 1, drop_last), "images.txt, line 2: expected IMAGE_ID"),
    (ONLY, IMAGES, lambda p: edit(p, 1, word(1, "2.0")), "images.txt, line 2: quaternion not"),
    (ONLY, IMAGES, lambda p: edit(p, 1, word(3, "nan")), "images.txt, line 2: quaternion not"),
    (ONLY, IMAGES, lambda p: edit(p, 1, word(3, "x")), "images.txt, line 2: expected IMAGE_ID"),
    (ONLY, IMAGES, lambda p: edit(p, 1, word(8, "7")), "not a COLMAP model .*7 does not exist"),
    (ONLY, IMAGES, lambda p: p.write_text(""), "no registered image"),
    (ONLY, IMAGES, lambda p: p.write_bytes(bytes(range(256))), "cannot be read as text"),
    (ONLY, CAMERAS, lambda p: edit(p, 0, drop_last), "not a COLMAP model"),
    (ONLY, CAMERAS, lambda p: edit(p, 0, word(2, "x")), "not a COLMAP model"),
    (ONLY, CAMERAS, lambda p: edit(p, 0, word(1, "MAGIC")), "Camera model does not"),
    (ONLY, CAMERAS, lambda p: edit(p, 0, word(5, "nan")), "not a COLMAP model"),
    (ONLY, CAMERAS, lambda p: p.write_text("# x\n\nwhat is this\n"), "not a COLMAP model"),
    (ONLY, CAMERAS, lambda p: p.write_bytes(bytes(range(256))), "not a COLMAP model"),
    (ONLY, CAMERAS, lambda p: p.unlink(), "no cameras.txt beside it"),
    (ONLY, "points3D.txt", lambda p: edit(p, 0, drop_last), "not a COLMAP model"),
    (as_colmap_binary, "images.bin", lambda p: p.write_bytes(p.read_bytes()[:30]), "not a COLMAP"),
    (as_colmap_binary, "cameras.bin", lambda p: put(p, 32, np.inf), "expected a size, finite numb"),
]


@pytest.mark.parametrize("write, file, damage, message", DAMAGED)
def test_damaged_files_are_refused_in_one_clear_line(tmp_path, write, file, damage, message):
    path = write(tmp_path, some_cameras())
    damage(tmp_path / file)
    with pytest.raises(rt.ReobjError, match=message) as refused:
        read(path, camera=CAMERA if write is as_tum else "")
    assert "\n" not in str(refused.value)


def test_a_folder_in_no_known_format_is_refused_with_the_formats(tmp_path):
    with pytest.raises(rt.ReobjError, match="no known format of poses; expected one of colmap"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "frames.bin"])
@pytest.mark.parametrize("what", ["records", "entries"])
def test_a_binary_model_that_claims_more_than_it_holds(tmp_path, name, what):
    """A claim of 2^40 points would take 40 TB before the first is read."""
    pc = import_pycolmap()
    truth = pc.synthesize_dataset(pc.SyntheticDatasetOptions())
    truth.write_binary(str(tmp_path))
    colmap_model._check_counts(tmp_path)
    data, at = bytearray((tmp_path / name).read_bytes()), 0
    if what == "entries":
        head, number, size = colmap_model.RECORDS[name]
        if not size:
            pytest.skip("records of one size")
        at = 8 + head
        at = data.index(b"\0", at) + 1 if name == "images.bin" else at
        data[at : at + struct.calcsize(number)] = struct.pack(number, 2**31)
    else:
        data[:8] = struct.pack("<Q", 2**40)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(rt.ReobjError, match=f"not a COLMAP model .{name} claims [0-9]+ {what} in"):
        rt.read_poses(tmp_path, blank(9))


def test_a_binary_model_of_zero_images_is_refused(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    pycolmap.Reconstruction().write_binary(str(tmp_path))
    with pytest.raises(rt.ReobjError, match="no registered image"):
        read(tmp_path)


def test_missing_files_unknown_formats_and_missing_intrinsics(tmp_path):
    with pytest.raises(rt.ReobjError, match=r"no\.txt does not exist$"):
        read(tmp_path / "no.txt")
    with pytest.raises(rt.ReobjError, match="--camera"):
        read(as_tum(tmp_path, some_cameras()))
    (tmp_path / "empty").mkdir()
    with pytest.raises(rt.ReobjError, match="no known format"):
        read(tmp_path / "empty")
    with pytest.raises(rt.ReobjError, match="no such format; expected auto, colmap"):
        read(tmp_path, fmt="xyz")
    with pytest.raises(rt.ReobjError, match="no readable frame"):
        read(as_record3d(tmp_path, some_cameras()), blank(0))


# ---- Assignment of poses to frames ---------------------------------------------------------------


def test_scannets_pose_folder_may_be_given_directly(tmp_path):
    path = as_scannet(tmp_path, some_cameras())
    poses, whole = read(path / "pose", blank(FRAMES)), read(path, blank(FRAMES))
    assert poses.camera == whole.camera and poses.known.all()
    np.testing.assert_array_equal(poses.up_in_world, whole.up_in_world)
    np.testing.assert_array_equal(poses.cam_from_world, whole.cam_from_world)


@pytest.mark.parametrize("start, every, count, known", [(1, 2, 6, True), (0, 1, 7, False)])
def test_stamps_of_another_clock_match_in_order(tmp_path, start, every, count, known):
    """For a subset of frames; with more stamps than frames the assignment is undetermined."""
    for i in range(FRAMES):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((480, 640, 3), np.uint8))
    video = rt.Video(tmp_path, rt.InputConfig(start=start, every=every))
    cams = some_cameras(count)
    path = as_tum(tmp_path, cams)
    for i in range(count):
        edit(path, i + 1, word(0, repr(100 + i / 30)))
    if not known:
        with pytest.raises(rt.ReobjError, match="expected seconds of the same clock, frame"):
            read(path, video, camera=CAMERA)
        return
    poses = read(path, video, camera=CAMERA)
    np.testing.assert_allclose(poses.cam_from_world, cams[[1, 3, 5]], atol=1e-9)
    assert "order, one row for each frame of the source" in poses.reading


def test_a_camera_that_stays_at_the_identity_has_poses(tmp_path):
    poses = read(as_scannet(tmp_path, np.tile(np.eye(3, 4), (6, 1, 1))), blank(FRAMES))
    assert poses.known.all()


def test_lost_scannet_frames_have_no_pose(tmp_path):
    path = as_scannet(tmp_path, some_cameras())
    text(tmp_path / "pose" / "3.txt", np.full((4, 4), -np.inf))
    poses = read(path, blank(FRAMES))
    assert poses.known.tolist() == [True, True, True, False, True, True]
    assert poses.status[3] == "none" and "none for 3; 1 poses of lost" in poses.messages[0]


@pytest.mark.parametrize(
    "stamps, known",
    [
        ([0, 1 / 30, 2 / 30, 3 / 30, 4 / 30, 5 / 30], [0, 1, 2, 3, 4, 5]),
        ([0.010, 0.045, 0.2], [0, 1]),  # within half a frame; the last is beyond the video's end
        ([0.0, 0.0167, 0.0333, 0.05, 0.0667], [0, 1, 2]),  # twice the rate
        (
            [100 + i / 30 for i in range(6)],
            [0, 1, 2, 3, 4, 5],
        ),  # another clock, one a frame: in order
    ],
)
def test_time_stamps_are_matched_within_half_a_frame(tmp_path, stamps, known):
    cams = some_cameras(len(stamps))
    path = as_tum(tmp_path, cams)
    for i, stamp in enumerate(stamps):
        edit(path, i + 1, word(0, repr(stamp)))
    poses = read(path, blank(FRAMES), camera=CAMERA)
    assert np.flatnonzero(poses.known).tolist() == known


@pytest.mark.parametrize(
    "step, stamps, offset, known",
    [
        (1 / 30, np.arange(0, 0.3, 0.01), 0.004, [0, 1, 2, 3, 4, 5]),  # motion capture, 100 Hz
        (1.0, np.arange(0, 6, 0.01), 0.0, [0, 1, 2, 3, 4, 5]),  # images of every second
        (1.0, np.arange(0, 6, 1.0), 0.03, []),  # half a frame is far more than TUM's 20 ms
        (1.0, np.arange(0, 4, 0.01), 0.067, [1, 2, 3, 4]),  # begins 67 ms after the first image
    ],
)
def test_times_in_image_names_match_poses_of_a_higher_rate(tmp_path, step, stamps, offset, known):
    """TUM: 1305031102.175304.png; the pose is that of its time, between two of the file."""
    start = 1305031102.175304
    times = start + step * np.arange(FRAMES)
    for time in times:
        cv2.imwrite(str(tmp_path / f"{time:.6f}.png"), np.zeros((48, 64, 3), np.uint8))
    cams = some_cameras(len(stamps))
    path = as_tum(tmp_path, cams)
    rows = np.loadtxt(path)
    rows[:, 0] = start + stamps + offset
    np.savetxt(path, rows, "%.6f " + " %.9f" * 7)
    video = rt.Video(tmp_path)
    np.testing.assert_allclose(video.times_s, times, atol=1e-6)
    camera = "50,50,32,24"
    if not known:
        with pytest.raises(rt.ReobjError, match="none of its 6 poses"):
            rt.read_poses(path, video, camera=camera)
        return
    poses = rt.read_poses(path, video, camera=camera)
    assert np.flatnonzero(poses.known).tolist() == known and poses.metric
    centre = invert_rigid(cams)[:, :, 3]
    wanted = [np.interp(times[known] - start - offset, stamps, axis) for axis in centre.T]
    found = invert_rigid(poses.cam_from_world[known])[:, :, 3]
    np.testing.assert_allclose(found, np.transpose(wanted), atol=1e-5)  # times have 6 digits
    write_tum(tmp_path / "out.txt", poses)  # carries the times, so that evo can compare
    np.testing.assert_allclose(np.loadtxt(tmp_path / "out.txt", ndmin=2)[:, 0], times[known],
                               atol=1e-6)  # fmt: skip


def test_a_rotation_between_two_stamps_is_interpolated(tmp_path):
    turn = Rotation.from_rotvec([[0, 0, 0], [0, 0.2, 0], [0, 0.4, 0]]).as_matrix()
    cams = np.concatenate([turn, np.zeros((3, 3, 1))], 2)
    path = as_tum(tmp_path, cams)
    for i in range(3):
        edit(path, i + 1, word(0, str((i - 0.25) / 30)))
    poses = read(path, blank(3), camera=CAMERA)
    found = Rotation.from_matrix(poses.cam_from_world[:2, :, :3]).as_rotvec()
    np.testing.assert_allclose(found[:, 1], [0.05, 0.25], atol=1e-9)
    np.testing.assert_allclose(poses.cam_from_world[2], cams[2], atol=1e-9)  # the last one: nearest


def test_poses_at_the_times_of_the_frames_are_not_interpolated(tmp_path):
    """Times rounded to a millisecond are the same times: nothing is interpolated."""
    path = as_tum(tmp_path, some_cameras())
    exact = read(path, camera=CAMERA).cam_from_world
    for i in range(FRAMES):
        edit(path, i + 1, word(0, f"{i / 30:.3f}"))
    np.testing.assert_array_equal(read(path, camera=CAMERA).cam_from_world, exact)


def test_time_stamps_of_another_clock_are_refused_when_counts_differ(tmp_path):
    path = as_tum(tmp_path, some_cameras(4))
    for i in range(4):
        edit(path, i + 1, word(0, str(1000.0 + i)))
    with pytest.raises(rt.ReobjError, match="none of its 4 poses belongs to a frame"):
        read(path, blank(FRAMES), camera=CAMERA)


@pytest.mark.parametrize(
    ("numbers", "frames_by", "known"),
    [
        ((0, 3, 5), "", [0, 3, 5]),  # a 0: counted from 0
        ((1, 2, 6), "", [0, 1, 5]),  # a 6 of six frames: from 1
        ((1, 3, 5), "number0", [1, 3, 5]),
        ((1, 3, 5), "number1", [0, 2, 4]),
        ((1, 3, 5), "", None),  # undetermined, and the images are blank
    ],
)
def test_numbers_in_names_are_frame_numbers_for_a_video(tmp_path, numbers, frames_by, known):
    names = [f"f_{n:04d}.png" for n in numbers]
    matrices = full(invert_rigid(some_cameras(3)))
    text(tmp_path / "transforms.json", transforms(matrices, names, fl_x=FOCAL))
    if known is None:
        with pytest.raises(rt.ReobjError, match=r"2 ways.*number0.*counted from 0.*number1"):
            read(tmp_path, blank(FRAMES))
        return
    poses = read(tmp_path, blank(FRAMES), frames_by=frames_by)
    assert np.flatnonzero(poses.known).tolist() == known


def test_intrinsics_follow_the_size_of_the_frames(tmp_path):
    names = [f"{i:04d}.jpg" for i in range(FRAMES)]
    more = {"fl_x": 2 * FOCAL, "cx": 640, "cy": 480, "w": 1280, "h": 960}
    text(
        tmp_path / "transforms.json",
        transforms(full(invert_rigid(some_cameras())), names, **more),
    )
    poses = read(tmp_path, blank(FRAMES, names))
    np.testing.assert_allclose(poses.camera.K, [[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]])


def test_slightly_different_focal_lengths_are_one_camera(tmp_path):
    """Autofocus: the median if all are within two percent; else there are several cameras."""
    path = as_instant_ngp(tmp_path, some_cameras())
    for i, focal in enumerate([500, 508, 501, 502, 503, 504]):
        edit_json(path, lambda d, i=i, focal=focal: d["frames"][i].update(fl_x=focal))
    assert read(path).camera.K[0, 0] == 503
    edit_json(path, lambda d: d["frames"][1].update(fl_x=511))
    with pytest.raises(rt.ReobjError, match="several different cameras"):
        read(path)


def test_rotations_of_binary_models_are_checked(tmp_path, monkeypatch):
    """pycolmap accepts quaternions of any length; nearly normalised ones are normalised."""
    path = as_colmap_binary(tmp_path, some_cameras())
    model = colmap_model.read_sparse_model(path)

    def scaled(factor):
        wrong = model.cam_from_world.copy()
        wrong[3, :, :3] *= factor
        monkeypatch.setattr(
            colmap_model,
            "read_sparse_model",
            lambda _: dataclasses.replace(model, cam_from_world=wrong),
        )

    scaled(1.1)
    message = f"images.bin, {NAMES[3]}: the 3x3 block is not a rotation"
    with pytest.raises(rt.ReobjError, match=message):
        read(path)
    scaled(1.001)
    turned = read(path).cam_from_world[:, :, :3]
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1) - np.eye(3), 0, atol=1e-12)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("number", [1e300, -1.7e308, 1e12])
def test_huge_numbers_are_refused_without_overflow(tmp_path, number):
    """In one line, without a NumPy warning."""
    cams, names = some_cameras(), NAMES[:FRAMES]
    path = as_tum(tmp_path, cams)
    rows = [line.split() for line in path.read_text().splitlines()[1:]]
    rows[2][1:4] = [repr(number)] * 3
    path.write_text("\n".join(" ".join(row) for row in rows))
    with pytest.raises(rt.ReobjError, match=r"line 3: more than 1e\+09 units away"):
        read(path, camera=CAMERA)
    for row, what in ((0, "the 3x3 block is not a rotation"), (3, "more than 1e")):
        matrix = full(invert_rigid(cams))
        matrix[2, 0, row] = number
        text(tmp_path / "transforms.json", transforms(matrix, names))
        with pytest.raises(rt.ReobjError, match=rf"frames\[2\]: {what}"):
            read(tmp_path / "transforms.json", blank(FRAMES, names))


def test_focal_lengths_of_zero_are_refused(tmp_path):
    path = as_colmap_text(tmp_path, some_cameras())
    (path / "sparse/0/cameras.txt").write_text("1 PINHOLE 640 480 0 0 320 240\n")
    with pytest.raises(rt.ReobjError, match="focal length"):
        read(path)


def test_rows_of_images_are_no_observations(tmp_path):
    """Without rows of observations: names of three words, and poses in whole numbers."""
    path = as_colmap_poses_only(tmp_path, some_cameras())
    names = ["in a folder/0000.jpg", "0001.jpg", "in a folder/0002.jpg", "0003.jpg"]
    path.write_text("".join(f"{i} 1 0 0 0 {i} 0 0 1 {name}\n" for i, name in enumerate(names)))
    assert np.flatnonzero(read(path).known).tolist() == [0, 1, 2, 3]
