"""Poses of other tools: round trip of every format, refusal of damaged files, frame lookup."""

from __future__ import annotations

import dataclasses
import json
import struct
import zipfile

import cv2
import numpy as np
import pytest
from pose_worlds import FOCAL, FRAMES, PINHOLE, blank, some_cameras, supplied
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import import_pycolmap, invert_rigid, write_colmap

CAMERA = f"{FOCAL},{FOCAL},320,240"
K = [[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]]
OWN = {"fx": FOCAL, "fy": FOCAL, "cx": 320, "cy": 240, "width": 640, "height": 480}
NAMES = [f"{i:04d}.jpg" for i in range(FRAMES)]
GL = np.diag([1.0, -1, -1, 1])


def full(matrix):
    return np.concatenate([matrix, np.tile([[[0, 0, 0, 1.0]]], (len(matrix), 1, 1))], 1)


def text(path, rows, head="", sep=" "):
    """Write rows of numbers or words, or JSON of a dict."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(rows, dict):
        path.write_text(json.dumps(rows))
        return path
    lines = [sep.join(str(v) for v in np.ravel(row).tolist()) for row in rows]
    path.write_text(head + "".join(f"{line}\n" for line in lines))
    return path


def world(cams):
    """world_from_cam (F, 4, 4)."""
    return full(invert_rigid(cams))


def gl(cams):
    return world(cams) @ GL


def rows_of(world_from_cam, first, order=(0, 1, 2, 3)):
    """Rows of something, the centre and the quaternion x, y, z, w in some order."""
    xyzw = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()[:, order]
    pairs = zip(first, world_from_cam[:, :3, 3].tolist(), xyzw.tolist(), strict=True)
    return [[when, *centre, *turn] for when, centre, turn in pairs]


def seconds(cams):
    return [i / 30 for i in range(len(cams))]


def as_tum(folder, cams):
    rows = rows_of(invert_rigid(cams), seconds(cams))
    return text(folder / "poses.txt", rows, "# t tx ty tz qx qy qz qw\n")


def as_orbslam3(folder, cams):
    """ns since 1970, x first, spaces."""
    stamps = [1.7e18 + i * 1e9 / 30 for i in range(len(cams))]
    return text(folder / "KeyFrameTrajectory.txt", rows_of(invert_rigid(cams), stamps))


BODY_FROM_CAM = np.array([[0, 0, 1.0, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]])


def as_euroc(folder, cams):
    """Poses of the body, ns, w first, 17 columns; sensor.yaml of the camera in cam0 beside."""
    text(folder / "gt" / "sensor.yaml", [], "sensor_type: visual-inertial\n")
    text(folder / "cam0" / "sensor.yaml", [], "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
         f"  data: {BODY_FROM_CAM.ravel().tolist()}\nresolution: [640, 480]\n"
         "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
         "intrinsics: [500.0, 500.0, 320, 240] #fu, fv, cu, cv\n")  # fmt: skip
    body = world(cams) @ np.linalg.inv(BODY_FROM_CAM)
    rows = rows_of(body, [i * 33333333 for i in range(len(cams))], (3, 0, 1, 2))
    names = [f"p_RS_R_{a} [m]" for a in "xyz"] + [f"q_RS_{a} []" for a in "wxyz"]
    head = ", ".join(["#timestamp", *names, *"abcdefghi"])
    return text(folder / "gt" / "data.csv", [[*r, *[0] * 9] for r in rows], head + "\n", ",").parent


def as_kitti(folder, cams):
    return text(folder / "00.txt", invert_rigid(cams))


def as_replica(folder, cams):
    return text(folder / "traj.txt", world(cams)).parent


def as_stray(folder, cams):
    rows = rows_of(invert_rigid(cams), [f"{100 + i / 60}, {i:06d}" for i in range(len(cams))])
    text(folder / "odometry.csv", rows, "timestamp, frame, x, y, z, qx, qy, qz, qw\n", ", ")
    return text(folder / "camera_matrix.csv", K, sep=", ").parent


def as_arkitscenes(folder, cams):
    turn = Rotation.from_matrix(cams[:, :, :3]).as_rotvec()
    text(
        folder / "lowres_wide_intrinsics" / "41048190_0.033.pincam",
        [[640, 480, 500, 500, 320, 240]],
    )
    rows = np.column_stack([seconds(cams), turn, cams[:, :, 3]])
    return text(folder / "lowres_wide.traj", rows).parent


def as_scannet(folder, cams):
    text(folder / "intrinsic" / "intrinsic_color.txt", K - np.array([[0, 0, 0.5]] * 2 + [[0] * 3]))
    for i, w in enumerate(world(cams)):
        text(folder / "pose" / f"{i}.txt", w)
    return folder


def as_seven_scenes(folder, cams):
    for i, w in enumerate(world(cams)):
        text(folder / f"frame-{i:06d}.pose.txt", w)
    return folder


def as_record3d(folder, cams):
    poses = [[*row[4:], *row[1:4]] for row in rows_of(gl(cams), [0] * len(cams))]
    return text(folder / "metadata", {"w": 640, "h": 480, "K": np.transpose(K).ravel().tolist(),
                                      "poses": poses})  # fmt: skip


def as_r3d(folder, cams):
    with zipfile.ZipFile(folder / "scan.r3d", "w") as file:
        file.writestr("metadata", as_record3d(folder, cams).read_text())
    return folder / "scan.r3d"


def as_polycam(folder, cams):
    for i, w in enumerate(gl(cams)):
        numbers = {f"t_{r}{c}": w[r, c] for r in range(3) for c in range(4)}
        path = folder / "keyframes" / "corrected_cameras" / f"{i:04d}.json"
        text(path, numbers | OWN | {"blur_score": 80.0})
    return folder


def as_3d_scanner_app(folder, cams):
    for i, w in enumerate(gl(cams)):
        data = {"cameraPoseARFrame": w.ravel().tolist(), "intrinsics": np.ravel(K).tolist()}
        text(folder / f"frame_{i:05d}.json", data | {"time": i / 30})
    return folder


def as_transforms(folder, world_from_gl, **more):
    frames = [{"file_path": f"./images/{i:04d}.jpg", "transform_matrix": w.tolist()}
              for i, w in enumerate(world_from_gl)]  # fmt: skip
    return text(folder / "transforms.json", {"frames": frames, "w": 640, "h": 480, **more})


def as_instant_ngp(folder, cams):
    return as_transforms(folder, gl(cams), camera_angle_x=2 * np.arctan(320 / FOCAL))


def as_nerfstudio(folder, cams):
    applied = np.array([[0, 1.0, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.5]])
    more = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 320.0, "cy": 240.0}
    turned = full(applied[None]) @ gl(cams)
    return as_transforms(folder, turned, applied_transform=applied.tolist(), **more).parent


def as_scannetpp(folder, cams):
    entries = {
        f"frame_{i:06d}": {"aligned_pose": w.tolist(), "pose": np.eye(4).tolist(), "intrinsic": K}
        for i, w in enumerate(world(cams))
    }
    return text(folder / "pose_intrinsic_imu.json", entries)


def as_llff(folder, cams):
    w = invert_rigid(cams)
    hwf = np.tile([480, 640, FOCAL], (len(w), 1))
    rows = np.stack([w[:, :, 1], w[:, :, 0], -w[:, :, 2], w[:, :, 3], hwf], 2).reshape(-1, 15)
    np.save(folder / "poses_bounds.npy", np.column_stack([rows, np.ones((len(w), 2))]))
    return folder


def as_splatting(folder, cams):
    entries = [
        {"id": i, "img_name": f"{i:04d}", "position": w[:, 3].tolist(),
         "rotation": w[:, :3].tolist()} | OWN for i, w in enumerate(invert_rigid(cams))
    ]  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps(entries))
    return folder


def model(folder, cams, camera=PINHOLE):
    """Write our own COLMAP text model, with two points that no image observes."""
    points = np.arange(6.0).reshape(2, 3)
    colors = np.array([[9, 8, 7], [255, 0, 1]], np.uint8)
    poses = dataclasses.replace(supplied(cams), points=points, colors=colors, camera=camera)
    write_colmap(folder, poses, NAMES[: len(cams)])
    return folder


def binary(folder):
    pycolmap = import_pycolmap()
    found = pycolmap.Reconstruction(str(folder))
    (folder / "binary").mkdir()
    found.write_binary(str(folder / "binary"))
    return folder / "binary"


def image_rows(folder):
    return [line for line in (folder / "images.txt").read_text().splitlines() if line]


def as_colmap_text(folder, cams):
    return model(folder / "sparse" / "0", cams).parents[1]


def as_colmap_poses_only(folder, cams):
    """Without the blank lines of observations, and without points3D.txt."""
    model(folder, cams)
    (folder / "points3D.txt").unlink()
    (folder / "images.txt").write_text("\n".join(image_rows(folder)))
    return folder / "images.txt"


def as_colmap_with_observations(folder, cams):
    """With observations, of points that points3D.txt does not hold."""
    model(folder, cams)
    rows = [f"{row}\n1.5 2.5 -1 3.5 4.5 7" for row in image_rows(folder)]
    (folder / "images.txt").write_text("# comment\n" + "\n".join(rows))
    return folder


def as_colmap_binary(folder, cams):
    return binary(model(folder, cams))


# writer, metric, up in world
FORMATS = [
    (as_tum, True, None), (as_record3d, True, (0, 1, 0)), (as_scannet, True, (0, 0, 1)),
    (as_instant_ngp, False, None), (as_nerfstudio, False, None), (as_colmap_text, False, None),
    (as_colmap_poses_only, False, None), (as_colmap_with_observations, False, None),
    (as_colmap_binary, False, None), (as_seven_scenes, True, None), (as_polycam, True, (0, 1, 0)),
    (as_3d_scanner_app, True, (0, 1, 0)), (as_kitti, True, None), (as_replica, True, None),
    (as_euroc, True, None), (as_orbslam3, True, None), (as_stray, True, (0, 1, 0)),
    (as_arkitscenes, True, (0, 0, 1)), (as_scannetpp, True, (0, 0, 1)), (as_llff, False, None),
    (as_splatting, False, None), (as_r3d, True, (0, 1, 0)),
]  # fmt: skip
BY_ORDER = (as_record3d, as_kitti, as_replica, as_llff, as_r3d)
BY_TIME = (as_tum, as_euroc, as_orbslam3, as_arkitscenes)
WITHOUT_CAMERA = (as_tum, as_seven_scenes, as_kitti, as_replica, as_orbslam3)
every_format = pytest.mark.parametrize(
    "write, metric, up", FORMATS, ids=lambda v: getattr(v, "__name__", None)
)


def read(path, video=None, **options):
    return rt.read_poses(path, video or blank(FRAMES, NAMES), **options)


@every_format
def test_every_format_is_read_back_unchanged(tmp_path, write, metric, up):
    camera = CAMERA if write in WITHOUT_CAMERA else ""
    path = write(tmp_path, some_cameras())
    poses = read(path, camera=camera)
    np.testing.assert_allclose(poses.cam_from_world, some_cameras(), atol=1e-9)
    np.testing.assert_allclose(poses.camera.K, K, atol=1e-9)
    assert poses.known.all() and poses.metric == metric and set(poses.status) == {"supplied"}
    np.testing.assert_array_equal(poses.up_in_world, up)
    assert read(path, camera=camera, metric=True).metric


@every_format
def test_frames_without_a_pose_and_a_subset_of_the_images(tmp_path, write, metric, up):
    """Six poses for eight frames, or three images of six, under their original names."""
    path, cams = write(tmp_path, some_cameras()), some_cameras()
    camera = CAMERA if write in WITHOUT_CAMERA else ""
    more = blank(FRAMES + 2, [f"{i:04d}.jpg" for i in range(FRAMES + 2)])
    if write in BY_ORDER + BY_TIME:
        message = "expected seconds" if write in BY_TIME else "6 rows, .*frames_by=number"
        with pytest.raises(rt.ReobjError, match=message):
            read(path, more, camera=camera)
        return
    for video in (more, blank(FRAMES + 2)):
        poses = read(path, video, camera=camera)
        assert poses.known.tolist() == [True] * 6 + [False] * 2
        np.testing.assert_allclose(poses.cam_from_world[:6], cams, atol=1e-9)
        assert any("6 of 8 frames, none for 6-7" in message for message in poses.messages)
    name = {as_seven_scenes: "frame-{:06d}.color.png", as_3d_scanner_app: "frame_{:05d}.jpg"}
    names = [name.get(write, "{:04d}.jpg").format(i) for i in (0, 2, 4)]
    poses = read(path, blank(3, names), camera=camera)
    np.testing.assert_allclose(poses.cam_from_world, cams[::2], atol=1e-9)


@pytest.mark.parametrize("write", [as_tum, as_kitti])
def test_a_unit_that_the_format_does_not_state_is_declared_or_assumed_once(tmp_path, write):
    path = write(tmp_path, some_cameras())
    poses = read(path, camera=CAMERA)
    assert poses.metric and "metres assumed" in poses.reading
    assert "assumed" not in read(path, camera=CAMERA, metric=True).reading
    content = path.read_text()
    for unit in ("arbitrary", "metres"):
        path.write_text(f"# units: {unit}\n{content}")
        poses = read(path, camera=CAMERA)
        assert poses.metric == (unit == "metres") and "assumed" not in poses.reading


@pytest.mark.parametrize("form", ["text", "binary"])
def test_colmap_observations_become_rows_of_frames_and_points(tmp_path, form):
    """Ids count from 1 here; images 1 and 6 of the model are no frames of the video."""
    folder = model(tmp_path, some_cameras())
    observed = ([1, 2], [2], [1], [], [1, 2], [1])  # points of each image
    rows = [f"{row}\n{' '.join(f'9.5 {k}.5 {point}' for k, point in enumerate(points))}\n"
            for row, points in zip(image_rows(folder), observed, strict=True)]  # fmt: skip
    (folder / "images.txt").write_text("".join(rows))
    lines = (folder / "points3D.txt").read_text().splitlines()
    for p, line in enumerate(lines, 1):
        track = [f"{i} {points.index(p)}" for i, points in enumerate(observed, 1) if p in points]
        lines[p - 1] = " ".join([line, *track])
    (folder / "points3D.txt").write_text("\n".join(lines[::-1]))
    poses = read(folder if form == "text" else binary(folder), blank(4, NAMES[1:5]))
    assert poses.reading.startswith(f"colmap ({form})")
    assert sorted(map(tuple, poses.visibility.tolist())) == [(0, 1), (1, 0), (3, 0), (3, 1)]
    np.testing.assert_array_equal(poses.points, np.arange(6).reshape(2, 3))  # sorted by id
    np.testing.assert_array_equal(poses.colors, [[9, 8, 7], [255, 0, 1]])


def test_rows_of_images_are_no_observations(tmp_path):
    """Without rows of observations: names of three words, and poses in whole numbers."""
    path = as_colmap_poses_only(tmp_path, some_cameras())
    names = ["in a folder/0000.jpg", "0001.jpg", "in a folder/0002.jpg", "0003.jpg"]
    path.write_text("".join(f"{i} 1 0 0 0 {i} 0 0 1 {name}\n" for i, name in enumerate(names)))
    assert np.flatnonzero(read(path).known).tolist() == [0, 1, 2, 3]


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


def edit_frame(path, **changes):
    edit_json(path, lambda data: data["frames"][1].update(changes))


def mirror(path):
    text(path, np.loadtxt(path) * [-1, 1, 1, 1])


def put(path, offset, value):
    """Overwrite a double of a binary file."""
    data = bytearray(path.read_bytes())
    data[offset : offset + 8] = np.float64(value).tobytes()
    path.write_bytes(data)


def shorten(path):
    path.write_bytes(path.read_bytes()[:30])


NGP, COLOR = "transforms.json", "intrinsic/intrinsic_color.txt"
ONLY, IMAGES, CAMERAS = as_colmap_poses_only, "images.txt", "cameras.txt"
DAMAGE = "damaged, or no file of format"
# writer, file, how it is damaged, what the message must hold
DAMAGED = [
    (as_tum, "poses.txt", lambda p: edit(p, 2, drop_last), "line 3: 7 words"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(7, "0.1")), "line 4: the quaternion"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(2, "1e300")), r"line 4: more than 1e\+09 unit"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(0, "inf")), "a time stamp is not finite"),
    (as_scannet, "pose/1.txt", lambda p: edit(p, 1, word(0, "3.0")), "1.txt: .*not a rotation"),
    (as_scannet, "pose/2.txt", lambda p: edit(p, 1, drop_last), "2.txt, line 2: 3 words .*4 numb"),
    (as_scannet, "pose/2.txt", mirror, "2.txt: .*mirrored"),
    (as_scannet, COLOR, lambda p: p.unlink(), "--camera"),
    (as_instant_ngp, NGP, lambda p: p.write_text(p.read_text()[:50]), "not valid JSON"),
    (as_instant_ngp, NGP, lambda p: edit_frame(p, transform_matrix=[1, 2]), r"frames\[1\]: no pos"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.update(applied_transform="no")),
     f"{DAMAGE} transforms"),
    (as_instant_ngp, NGP, lambda p: edit_frame(p, fl_x=900.0), "several different cameras"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: [f.update(file_path="a.png")
                                                            for f in d["frames"]]), "none of its"),
    (ONLY, IMAGES, lambda p: edit(p, 1, drop_last), "images.txt, line 2: expected IMAGE_ID"),
    (ONLY, IMAGES, lambda p: edit(p, 1, word(1, "2.0")), "images.txt, line 2: the quaternion"),
    (ONLY, IMAGES, lambda p: p.write_bytes(bytes(range(256))), "cannot be read as text"),
    (ONLY, CAMERAS, lambda p: edit(p, 0, drop_last), "3 parameters of a PINHOLE camera"),
    (ONLY, CAMERAS, lambda p: p.unlink(), "no cameras.txt beside it"),
    (as_colmap_with_observations, "points3D.txt", lambda p: edit(p, 0, word(2, "x")), DAMAGE),
    (as_colmap_binary, "binary/images.bin", shorten, DAMAGE),
    (as_colmap_binary, "binary/frames.bin", shorten, DAMAGE),  # pycolmap would read without end
    (as_colmap_binary, "binary/frames.bin", lambda p: put(p, 16, 2.0), "images.bin, 0000.jpg: the"),
    (as_colmap_binary, "binary/cameras.bin", lambda p: put(p, 32, np.inf), "expected a size, fin"),
]  # fmt: skip


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("write, file, damage, message", DAMAGED)
def test_damaged_files_are_refused_in_one_clear_line(tmp_path, write, file, damage, message):
    path = write(tmp_path, some_cameras())
    damage(tmp_path / file)
    with pytest.raises(rt.ReobjError, match=message) as refused:
        read(path, camera=CAMERA if write is as_tum else "")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name, at", [("images.bin", 0), ("points3D.bin", 51), ("frames.bin", 72)])
def test_a_binary_model_that_claims_more_than_it_holds(tmp_path, name, at):
    """A claim of 2^31 points would take 85 GB before the first is read."""
    pc = import_pycolmap()
    pc.synthesize_dataset(pc.SyntheticDatasetOptions()).write_binary(str(tmp_path))
    data = bytearray((tmp_path / name).read_bytes())
    data[at : at + 4] = struct.pack("<I", 2**31)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(rt.ReobjError, match=f"{name} claims [0-9]+ (records|entries) in"):
        rt.read_poses(tmp_path, blank(9))


def test_missing_files_unknown_formats_and_missing_intrinsics(tmp_path):
    path = as_tum(tmp_path, some_cameras())
    (tmp_path / "other").mkdir()
    for file, options, message in (
        ("no.txt", {}, r"no\.txt does not exist$"), (path, {}, "--camera"),
        ("other", {}, "no known format of poses; expected one of colmap"),
        (path, {"fmt": "xyz"}, "no such format; expected auto, colmap"),
        (path, {"fmt": "transforms"}, "not valid JSON"),
        (path, {"video": blank(0), "camera": CAMERA}, "no readable frame"),
    ):  # fmt: skip
        with pytest.raises(rt.ReobjError, match=message):
            read(tmp_path / file, **options)


# ---- Assignment of poses to frames ---------------------------------------------------------------


def test_lost_scannet_frames_have_no_pose(tmp_path):
    """`pose` may be given directly; a camera that stays at the identity has poses."""
    as_scannet(tmp_path, some_cameras())
    text(tmp_path / "pose" / "3.txt", np.full((4, 4), -np.inf))
    poses = read(tmp_path / "pose", blank(FRAMES))
    assert poses.known.tolist() == [True, True, True, False, True, True]
    assert poses.status[3] == "none" and "none for 3; 1 poses of lost" in poses.messages[0]
    as_scannet(tmp_path, np.tile(np.eye(3, 4), (6, 1, 1)))
    assert read(tmp_path, blank(FRAMES)).known.all()


def test_times_in_image_names_match_poses_of_a_higher_rate(tmp_path):
    """TUM: 1305031102.175304.png; the pose is that of its time, between two of the file."""
    start = 1305031102.175304
    times = start + np.arange(FRAMES) / 30
    for time in times:
        cv2.imwrite(str(tmp_path / f"{time:.6f}.png"), np.zeros((48, 64, 3), np.uint8))
    stamps = np.arange(0, 0.3, 0.01)  # motion capture, 100 Hz
    cams = some_cameras(len(stamps))
    path = as_tum(tmp_path, cams)
    rows = np.loadtxt(path)
    rows[:, 0] = start + stamps + 0.004
    np.savetxt(path, rows, "%.6f " + " %.9f" * 7)
    poses = read(path, rt.Video(tmp_path), camera="50,50,32,24")
    assert poses.known.all() and poses.metric
    np.testing.assert_allclose(poses.time_s, times, atol=1e-6)
    centre = invert_rigid(cams)[:, :, 3]
    wanted = [np.interp(times - start - 0.004, stamps, axis) for axis in centre.T]
    found = invert_rigid(poses.cam_from_world)[:, :, 3]
    np.testing.assert_allclose(found, np.transpose(wanted), atol=1e-5)  # times have 6 digits
    rows[:, 0] += 0.025  # later than the first image by more than TUM's 20 ms
    np.savetxt(path, rows, "%.6f " + " %.9f" * 7)
    poses = read(path, rt.Video(tmp_path), camera="50,50,32,24")
    assert poses.known.tolist() == [False] + [True] * 5
