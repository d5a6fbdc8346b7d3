"""Camera poses: keyframes, reconstruction, PnP, readers, the check of direction and axes."""

from __future__ import annotations

import dataclasses
import json
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pose_accuracy
import pytest
from scipy.spatial.transform import Rotation

import reobj_track as rt

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
ROOM = Path(__file__).resolve().parents[1] / "examples" / "room"
SIZE, FOCAL = (640, 480), 500.0
CAMERA = f"{FOCAL},{FOCAL},320,240"
FRAMES = 6


class FakeVideo:
    """Images in memory with the attributes of rt.Video."""

    def __init__(self, images, names=(), fps=30.0):
        self.images, self.names, self.fps = images, list(names), fps
        self.size = (images[0].shape[1], images[0].shape[0]) if len(images) else SIZE
        self.expected = len(images)

    def __iter__(self):
        for i, image in enumerate(self.images):
            yield rt.Frame(i, i / self.fps, image)


def blank(count, names=()):
    return FakeVideo([np.zeros((SIZE[1], SIZE[0], 3), np.uint8)] * count, names)


def config(**changes):
    return dataclasses.replace(rt.PosesConfig(), **changes)


def some_cameras(count=FRAMES):
    """cam_from_world (F, 3, 4) of a camera that walks and turns."""
    turn = Rotation.from_rotvec(np.linspace([0.1, -0.3, 0.05], [0.2, 0.5, -0.1], count)).as_matrix()
    centre = np.linspace([-1, 0.2, 0.1], [1.3, -0.1, 0.4], count)
    return np.concatenate([turn, -turn @ centre[:, :, None]], 2)


# ---- One camera in every format reads back to the same cam_from_world ----------------------------

GL = np.diag([1.0, -1, -1, 1])


def full(matrix):
    return np.concatenate([matrix, np.tile([[[0, 0, 0, 1.0]]], (len(matrix), 1, 1))], 1)


def as_tum(folder, cams):
    w = rt.invert_rigid(cams)
    q = Rotation.from_matrix(w[:, :, :3]).as_quat()
    rows = [[i / 30, *w[i, :, 3], *q[i]] for i in range(len(w))]
    return text(folder / "poses.txt", rows, "# t tx ty tz qx qy qz qw\n")


def as_kitti(folder, cams):
    return text(folder / "poses.txt", rt.invert_rigid(cams).reshape(len(cams), 12))


def as_rows_of_16(folder, cams):
    return text(folder / "poses_c2w.txt", full(rt.invert_rigid(cams)).reshape(len(cams), 16))


def as_arkitscenes(folder, cams):
    turn = Rotation.from_matrix(cams[:, :, :3]).as_rotvec()
    return text(
        folder / "lowres_wide.traj", [[i / 30, *turn[i], *cams[i, :, 3]] for i in range(len(cams))]
    )


def as_record3d(folder, cams):
    w = full(rt.invert_rigid(cams)) @ GL
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
    for i, w in enumerate(full(rt.invert_rigid(cams))):
        text(folder / "pose" / f"{i}.txt", w)
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
        transforms(full(rt.invert_rigid(cams)), names, camera_angle_x=angle),
    )


def as_nerfstudio(folder, cams):
    applied = np.array([[0, 1.0, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.5]])
    turned = full(applied[None]) @ full(rt.invert_rigid(cams))
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


def as_colmap_poses_only(folder, cams):
    model(folder, cams)
    lines = (folder / "images.txt").read_text().splitlines()
    text(folder / "images.txt", "\n".join(line for line in lines if line))
    return folder / "images.txt"


def as_colmap_with_observations(folder, cams):
    model(folder, cams)
    lines = (folder / "images.txt").read_text().splitlines()
    text(
        folder / "images.txt",
        "# comment\n" + "\n".join(line or "1.5 2.5 -1 3.5 4.5 7" for line in lines),
    )
    return folder


def as_colmap_binary(folder, cams):
    pycolmap = pytest.importorskip("pycolmap")
    model(folder / "text", cams)
    pycolmap.Reconstruction(str(folder / "text")).write_binary(str(folder))
    return folder


def model(folder, cams):
    """Write our own COLMAP text model."""
    camera = rt.Camera("PINHOLE", *SIZE, (FOCAL, FOCAL, 320.0, 240.0))
    count = len(cams)
    times, status = np.arange(count) / 30, np.full(count, "supplied")
    poses = rt.Poses(camera, np.arange(count), times, cams, status, "user")
    extra = {"points": np.ones((2, 3)), "colors": np.full((2, 3), 9, np.uint8)}
    poses = dataclasses.replace(poses, **extra)
    rt.write_colmap(folder, poses, [f"{i:04d}.jpg" for i in range(count)])
    return folder


def text(path, rows, head=""):
    if not isinstance(rows, str):
        rows = head + "".join(
            " ".join(repr(float(v)) for v in np.ravel(row)) + "\n" for row in rows
        )
    path.write_text(rows)
    return path


# writer, metric, up in world
FORMATS = [
    (as_tum, True, None), (as_kitti, True, None), (as_rows_of_16, True, None),
    (as_arkitscenes, True, None),
    (as_record3d, True, (0, 1, 0)), (as_scannet, True, (0, 0, 1)), (as_instant_ngp, False, None),
    (as_nerfstudio, False, None), (as_colmap_text, False, None),
    (as_colmap_poses_only, False, None),
    (as_colmap_with_observations, False, None), (as_colmap_binary, False, None),
]  # fmt: skip


@pytest.mark.parametrize("write, metric, up", FORMATS, ids=lambda v: getattr(v, "__name__", None))
def test_every_format_reads_back_the_same(tmp_path, write, metric, up):
    cams = some_cameras()
    video = blank(FRAMES, [f"{i:04d}.jpg" for i in range(FRAMES)])
    camera = "" if write not in (as_tum, as_kitti, as_rows_of_16, as_arkitscenes) else CAMERA
    poses = rt.read_poses(write(tmp_path, cams), video, config(camera=camera))
    np.testing.assert_allclose(poses.cam_from_world, cams, atol=1e-9)
    np.testing.assert_allclose(
        poses.camera.K, [[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]], atol=1e-9
    )
    assert poses.known.all() and poses.metric == metric and set(poses.status) == {"supplied"}
    assert (poses.up_in_world is None) == (up is None) and (
        up is None or np.allclose(poses.up_in_world, up)
    )


def test_own_files_read_back(tmp_path):
    cams = some_cameras()
    cams[2] = np.nan
    camera = rt.Camera("PINHOLE", *SIZE, (FOCAL, FOCAL, 320.0, 240.0))
    poses = rt.Poses(
        camera, np.arange(FRAMES), np.arange(FRAMES) / 30, cams, np.full(FRAMES, "pnp"), "pycolmap"
    )
    rt.write_tum(tmp_path / "poses.txt", poses)
    back = rt.read_poses(tmp_path / "poses.txt", blank(FRAMES), config(camera=CAMERA))
    np.testing.assert_allclose(back.cam_from_world, cams, atol=1e-8)
    assert not back.metric  # our header says that the scale is unknown
    assert "5 of 6" in back.messages[0]


# ---- Negative cases: where, what was found, what was expected, what to do ------------------------


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


def transpose_rows(path):
    text(path, np.loadtxt(path).reshape(-1, 4, 4).transpose(0, 2, 1).reshape(-1, 16))


def keep_three(path):
    path.write_text("\n".join(path.read_text().splitlines()[:3]))


NGP, COLOR = "transforms.json", "intrinsic/intrinsic_color.txt"
# writer, file, how it is damaged, what the message must hold
DAMAGED = [
    (as_tum, "poses.txt", lambda p: edit(p, 2, drop_last), "line 3: 7 numbers"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(7, "0.1")), "line 4: the quaternion"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(2, "nan")), "line 4: a number is not finite"),
    (as_tum, "poses.txt", lambda p: edit(p, 3, word(2, "abc")), "line 4: .*not a row of numbers"),
    (as_tum, "poses.txt", lambda p: p.write_text("# nothing\n"), "no poses in it"),
    (as_tum, "poses.txt", lambda p: p.write_bytes(b"\xff\xfe\x00\x81"), "cannot be read as text"),
    (as_kitti, "poses.txt", lambda p: edit(p, 1, word(0, "3.0")), "line 2: .*no rotation"),
    (as_kitti, "poses.txt", lambda p: edit(p, 1, drop_last), "line 2: 11 numbers"),
    (as_kitti, "poses.txt", keep_three, "3 rows.*one row a frame"),
    (as_rows_of_16, "poses_c2w.txt", transpose_rows, "row-major"),
    (
        as_scannet,
        "pose/2.txt",
        lambda p: edit(p, 1, drop_last),
        "2.txt, line 2: 3 numbers; expected 4 rows",
    ),
    (as_scannet, "pose/2.txt", lambda p: edit(p, 1, word(0, "x")), "2.txt, line 2: .*not a row"),
    (as_scannet, "pose/2.txt", lambda p: text(p, mirror(np.loadtxt(p))), "2.txt: .*mirrored"),
    (as_scannet, COLOR, lambda p: p.unlink(), "--camera"),
    (as_scannet, COLOR, lambda p: edit(p, 0, word(2, "648")), "do not fit"),
    (as_instant_ngp, NGP, lambda p: p.write_text(p.read_text()[:50]), "not valid JSON"),
    (as_instant_ngp, NGP, lambda p: p.write_text("[1]"), "expected an object"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.pop("frames")), "no `frames`"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.pop("camera_angle_x")), "--camera"),
    (as_instant_ngp, NGP, lambda p: edit_frame(p, transform_matrix=[1, 2]), "transform_matrix"),
    (as_instant_ngp, NGP, mirror_frame, r"frames\[1\]: .*mirrored"),
    (as_instant_ngp, NGP, lambda p: edit_frame(p, fl_x=900.0), "several different cameras"),
    (as_instant_ngp, NGP, lambda p: edit_json(p, lambda d: d.update(w=480, h=640)), "rotated"),
    (as_instant_ngp, NGP, rename_frames, "none of its"),
    (as_record3d, "metadata", lambda p: edit_json(p, lambda d: d.pop("K")), "no Record3D metadata"),
    (as_colmap_poses_only, "images.txt", lambda p: edit(p, 1, drop_last), "line 2: expected IMAGE"),
    (as_colmap_poses_only, "images.txt", lambda p: edit(p, 1, word(1, "2.0")), "line 2: the quat"),
    (as_colmap_poses_only, "images.txt", lambda p: edit(p, 1, word(3, "nan")), "line 2: .*finite"),
    (as_colmap_poses_only, "cameras.txt", lambda p: edit(p, 0, drop_last), "line 1: expected CAM"),
    (as_colmap_poses_only, "cameras.txt", lambda p: edit(p, 0, word(2, "x")), "line 1: expected C"),
    (
        as_colmap_poses_only,
        "points3D.txt",
        lambda p: edit(p, 0, drop_last),
        "line 1: expected POINT",
    ),
    (as_colmap_poses_only, "images.txt", lambda p: p.write_text(""), "no images in it"),
    (as_colmap_binary, "images.bin", lambda p: p.write_bytes(p.read_bytes()[:30]), "not a COLMAP"),
    (as_arkitscenes, "lowres_wide.traj", lambda p: edit(p, 1, drop_last), "line 2: 6 numbers"),
]


@pytest.mark.parametrize("write, file, damage, message", DAMAGED)
def test_damaged_files_are_refused_with_a_clear_message(tmp_path, write, file, damage, message):
    path = write(tmp_path, some_cameras())
    damage(tmp_path / file)
    camera = CAMERA if write in (as_tum, as_kitti, as_rows_of_16, as_arkitscenes) else ""
    with pytest.raises(rt.ReobjError, match=f"(?s){message}"):
        rt.read_poses(
            path, blank(FRAMES, [f"{i:04d}.jpg" for i in range(FRAMES)]), config(camera=camera)
        )


def test_missing_unknown_and_without_intrinsics(tmp_path):
    with pytest.raises(rt.ReobjError, match="no such file"):
        rt.read_poses(tmp_path / "no.txt", blank(2), config())
    with pytest.raises(rt.ReobjError, match="--camera"):
        rt.read_poses(as_tum(tmp_path, some_cameras()), blank(FRAMES), config())
    with pytest.raises(rt.ReobjError, match=r"no images\.bin"):
        rt.read_poses(tmp_path, blank(FRAMES), config())
    with pytest.raises(rt.ReobjError, match="unknown"):
        rt.read_poses(tmp_path, blank(FRAMES), config(fmt="xyz"))


@pytest.mark.parametrize(
    "given", ["1,2,3", "a,b,c,d", "-5,5,1,1", "500,500,900,240", "500,nan,320,240"]
)
def test_wrong_camera_is_refused(given):
    with pytest.raises(rt.ReobjError, match="--camera"):
        rt.parse_camera(given, SIZE)


# ---- Which pose belongs to which frame -----------------------------------------------------------


def test_lost_scannet_frames_have_no_pose(tmp_path):
    path = as_scannet(tmp_path, some_cameras())
    text(tmp_path / "pose" / "3.txt", np.full((4, 4), -np.inf))
    poses = rt.read_poses(path, blank(FRAMES), config())
    assert poses.known.tolist() == [True, True, True, False, True, True]
    assert poses.status[3] == "none" and "none for 3" in poses.messages[0]


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
    poses = rt.read_poses(path, blank(FRAMES), config(camera=CAMERA))
    assert np.flatnonzero(poses.known).tolist() == known


def test_time_stamps_of_another_clock_are_refused_when_counts_differ(tmp_path):
    path = as_tum(tmp_path, some_cameras(4))
    for i in range(4):
        edit(path, i + 1, word(0, str(1000.0 + i)))
    with pytest.raises(rt.ReobjError, match="none of its 4 poses belongs to a frame"):
        rt.read_poses(path, blank(FRAMES), config(camera=CAMERA))


def test_numbers_in_names_are_frame_numbers_for_a_video(tmp_path):
    cams = some_cameras(3)
    names = ["f_0001.png", "f_0003.png", "f_0005.png"]
    text(tmp_path / "transforms.json", transforms(full(rt.invert_rigid(cams)), names, fl_x=FOCAL))
    poses = rt.read_poses(tmp_path, blank(FRAMES), config())
    assert np.flatnonzero(poses.known).tolist() == [1, 3, 5]
    text(
        tmp_path / "transforms.json",
        transforms(full(rt.invert_rigid(cams)), ["1.png", "2.png", "6.png"], fl_x=FOCAL),
    )
    poses = rt.read_poses(tmp_path, blank(FRAMES), config())
    assert np.flatnonzero(poses.known).tolist() == [
        0,
        1,
        5,
    ]  # no 0 and one more than frames: counted from 1


def test_intrinsics_follow_the_size_of_the_frames(tmp_path):
    names = [f"{i:04d}.jpg" for i in range(FRAMES)]
    more = {"fl_x": 2 * FOCAL, "cx": 640, "cy": 480, "w": 1280, "h": 960}
    text(
        tmp_path / "transforms.json",
        transforms(full(rt.invert_rigid(some_cameras())), names, **more),
    )
    poses = rt.read_poses(tmp_path, blank(FRAMES, names), config())
    np.testing.assert_allclose(poses.camera.K, [[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]])


# ---- Check of direction and axes -----------------------------------------------------------------


def look_at(centre, target):
    """cam_from_world (3, 4) looking from centre to target, y down."""
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.array([x, np.cross(z, x), z])
    return np.column_stack([rotation, -rotation @ centre])


def motion(kind, count=60):
    s = np.linspace(0, 1, count)
    if kind == "orbit":
        centres = np.column_stack([3 * np.cos(2.5 * s), 3 * np.sin(2.5 * s), 1.5 + 0 * s])
        targets = np.zeros((count, 3))
    elif kind == "walk":
        centres = np.column_stack([4 * s - 2, -4 + 0 * s, 1.5 + 0 * s])
        targets = centres + np.array([0, 4, -0.8])
    elif kind == "pan":
        centres = np.column_stack([0.6 * s, -0.5 + 0.3 * s, 1.5 + 0.1 * np.sin(9 * s)])
        targets = centres + np.column_stack([3 * np.cos(4 * s), 3 * np.sin(4 * s), -0.8 + 0 * s])
    elif kind == "forward":
        centres = np.column_stack([0.1 * np.sin(9 * s), -4 + 3 * s, 1.5 + 0 * s])
        targets = centres + np.array([0, 4, -0.5])
    else:  # nearly still
        centres = np.column_stack([0.01 * s, -4 + 0 * s, 1.5 + 0 * s])
        targets = centres + np.array([0, 4, -0.8])
    wobble = 0.3 * np.column_stack([np.sin(11 * s), np.cos(7 * s), np.sin(5 * s)])  # hand-held
    return np.array(
        [look_at(c, t) for c, t in zip(centres, targets + wobble * (kind != "still"), strict=True)]
    )


def box_tracks(cams, noise_px, seed, objects=12):
    """Noisy centres of points in view, as tracks."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, 0], [3, 3, 1.2], (objects, 3))
    K = np.array([[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]])
    in_cam = np.einsum("fij,oj->ofi", cams[:, :, :3], points) + cams[None, :, :, 3]
    xy = np.einsum("ij,ofj->ofi", K, in_cam)
    xy = xy[..., :2] / xy[..., 2:]
    seen = (in_cam[..., 2] > 0.3) & (xy > 0).all(2) & (xy < SIZE).all(2)
    bias = rng.normal(0, noise_px, (objects, 1, 2))  # boxes are not centred on one point
    xy = (
        xy + rng.normal(0, noise_px, xy.shape) + bias * np.linspace(-1, 1, len(cams))[None, :, None]
    )
    return [(np.flatnonzero(s), xy[o][s]) for o, s in enumerate(seen) if s.any()]


def given(cams):
    camera = rt.Camera("PINHOLE", *SIZE, (FOCAL, FOCAL, 320.0, 240.0))
    count = len(cams)
    return rt.Poses(
        camera, np.arange(count), np.arange(count) / 30, cams, np.full(count, "supplied"), "user"
    )


GL3 = np.diag([1.0, -1, -1])
MISTAKES = {
    "direction": lambda c: rt.invert_rigid(c),
    "axes": lambda c: GL3 @ c,
    "both": lambda c: rt.invert_rigid(GL3 @ c),
}


@pytest.mark.parametrize("noise_px", [1, 8, 20])
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan", "forward", "still"])
def test_right_poses_raise_no_alarm(kind, noise_px):
    cams = motion(kind)
    for seed in range(20):
        tracks = box_tracks(cams, noise_px, seed)
        assert rt.check_poses(given(cams), tracks) is None
        assert rt.check_poses(given(cams), tracks[:4]) is None


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("kind", ["orbit", "walk", "pan"])
def test_wrong_poses_are_named(kind, mistake):
    cams = motion(kind)
    for seed in range(5):
        message = rt.check_poses(given(MISTAKES[mistake](cams)), box_tracks(cams, 4, seed))
        assert message is not None
        named = {
            "direction": "world_from_cam given",
            "axes": "OpenGL axes (y up",
            "both": "inverted and with OpenGL",
        }
        assert named[mistake] in message


def test_check_needs_tracks():
    assert rt.check_poses(given(motion("orbit")), []) is None
    assert rt.check_poses(given(motion("orbit")), [(np.array([1, 2]), np.ones((2, 2)))]) is None


# ---- Gaps ----------------------------------------------------------------------------------------


def test_gaps_are_filled_on_a_line_and_never_beyond():
    centres = np.linspace([0, 0, 0], [1, 0.2, 0.1], 11)
    cams = np.array([look_at(c, c + np.array([0.1, 4, -1])) for c in centres])
    lost = cams.copy()
    lost[[0, 1, 4, 5, 6]] = np.nan
    status = np.where(np.isnan(lost[:, 0, 0]), "none", "pnp").astype("<U12")
    filled, new = rt.fill_gaps(np.arange(11), lost, status, 3)
    np.testing.assert_allclose(filled[2:], cams[2:], atol=1e-9)  # straight and without turning
    assert (
        np.isnan(filled[:2]).all()
        and new.tolist() == ["none"] * 2 + ["pnp"] * 2 + ["interpolated"] * 3 + ["pnp"] * 4
    )
    untouched, _ = rt.fill_gaps(np.arange(11), lost, status, 2)
    assert np.isnan(untouched[4:7]).all()
    sparse, _ = rt.fill_gaps(
        10 * np.arange(11), lost, status, 3
    )  # every 10th frame: the gap is 39 frames long
    assert np.isnan(sparse[4:7]).all()


# ---- Reconstruction ------------------------------------------------------------------------------


def textured_room(count, step, turn_deg=0.0, seed=0, size=(480, 360)):
    """Images of a textured corner (two planes) from a walk or a turn on the spot; true poses."""
    rng = np.random.default_rng(seed)
    walls = [
        cv2.GaussianBlur(rng.integers(0, 255, (700, 1400, 3), np.uint8), (0, 0), 2)
        for _ in range(2)
    ]
    walls = [cv2.normalize(w, None, 0, 255, cv2.NORM_MINMAX) for w in walls]
    focal = 0.9 * size[0]
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    texel = 0.01  # metres; wall 0: z = 6, wall 1: a slanted floor
    planes = [
        np.array([[texel, 0, -7], [0, texel, -3.5], [0, 0, 6]]),
        np.array([[texel, 0, -7], [0, 0, 1.2], [0, -texel, 7.5]]),
    ]
    images, poses = [], []
    for i in range(count):
        rotation = Rotation.from_euler("y", turn_deg * i, degrees=True).as_matrix()
        centre = np.array([step * (i - count / 2), 0.1 * np.sin(i), 0])
        image = np.zeros((size[1], size[0], 3), np.uint8)
        for wall, plane in zip(walls, planes, strict=True):
            homography = K @ rotation @ (plane - np.outer(centre, [0, 0, 1]))
            warped = cv2.warpPerspective(wall, homography, size, flags=cv2.INTER_AREA)
            hit = (
                cv2.warpPerspective(np.full(wall.shape[:2], 255, np.uint8), homography, size) == 255
            )
            image[hit] = warped[hit]
        images.append(image)
        poses.append(np.column_stack([rotation, -rotation @ centre]))
    return images, np.array(poses)


def ate_percent(found, truth):
    """RMSE of aligned camera centres over the extent of the path (Umeyama, PAMI 1991)."""
    a, b = rt.invert_rigid(found)[:, :, 3], rt.invert_rigid(truth)[:, :, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ flip) / (a0**2).sum()
    error = b0 - scale * a0 @ (u @ flip @ vt).T
    return 100 * np.sqrt((error**2).sum(1).mean()) / np.linalg.norm(np.ptp(b, axis=0))


FEW = {"sift_features": 800}  # the rendered walls are full of texture


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    images, truth = textured_room(40, 0.06)
    folder = tmp_path_factory.mktemp("walk")
    return (
        FakeVideo(images),
        truth,
        folder,
        rt.estimate_poses(FakeVideo(images), config(**FEW), folder),
    )


def test_walk_is_reconstructed(walk):
    video, truth, folder, poses = walk
    assert poses.known.all() and poses.source == "pycolmap" and not poses.metric
    assert set(poses.status) == {"keyframe", "pnp"}
    assert ate_percent(poses.cam_from_world, truth) < 1.0
    assert len(poses.points) > 300 and poses.colors.any() and len(poses.colors) == len(poses.points)
    assert poses.camera.width == video.size[0] and (folder / "pycolmap.log").stat().st_size > 0
    assert sorted(p.name for p in folder.iterdir()) == ["pycolmap.log", "sparse"]


def test_sparse_model_has_native_pixels_and_names(walk):
    _, _, folder, poses = walk
    back = rt.read_poses(folder / "sparse", walk[0], rt.PosesConfig())
    keys = poses.status == "keyframe"
    np.testing.assert_allclose(back.cam_from_world[keys], poses.cam_from_world[keys], atol=1e-9)
    np.testing.assert_allclose(back.camera.params, poses.camera.params)
    rt.write_colmap(folder / "sparse", poses, [""] * 40)  # the binary model with observations stays
    assert not (folder / "sparse" / "images.txt").exists()


def test_given_camera_is_kept_and_frames_are_read_again_when_memory_is_short(walk, tmp_path):
    video, truth, _, _ = walk
    poses = rt.estimate_poses(video, config(camera="432,432,240,180", cache_mb=1, **FEW), tmp_path)
    assert poses.camera == rt.Camera("PINHOLE", 480, 360, (432.0, 432.0, 240.0, 180.0))
    assert poses.known.all() and ate_percent(poses.cam_from_world, truth) < 1.0


def test_reconstruction_is_reproducible(walk, tmp_path):
    again = rt.estimate_poses(walk[0], config(**FEW), tmp_path)
    # bit for bit nearly always; once under load pycolmap's result differed by 1e-4 of the path
    np.testing.assert_array_equal(again.status, walk[3].status)
    np.testing.assert_allclose(again.cam_from_world, walk[3].cam_from_world, atol=0.05)
    assert abs(len(again.points) - len(walk[3].points)) <= 0.03 * len(walk[3].points)


def test_masked_boxes_hold_no_points(walk, tmp_path):
    """With the left half masked out in every keyframe all points lie in the right half."""
    rt.estimate_poses(
        walk[0],
        config(**FEW),
        tmp_path,
        boxes_to_mask=lambda frame: np.array([[0, 0, 240, 360.0]]),
    )
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    xy = np.array([p.xy for image in model.images.values() for p in image.points2D])
    assert len(xy) > 300 and xy[:, 0].min() > 235


# name, images, word of the message
FAILURES = [
    ("one frame", lambda: textured_room(1, 0)[0], "only 1 different view"),
    ("two frames", lambda: textured_room(2, 0.5)[0], "only 2 different views"),
    ("black", lambda: [np.zeros((240, 320, 3), np.uint8)] * 30, "only 2 different views"),
    ("still", lambda: textured_room(1, 0)[0] * 30, "only 2 different views"),
    (
        "noise",
        lambda: list(np.random.default_rng(0).integers(0, 255, (12, 240, 320, 3), np.uint8)),
        "sideways",
    ),
    ("turn on the spot", lambda: textured_room(12, 0, 4, size=(320, 240))[0], "mere turn"),
    (
        "turn with little motion",
        lambda: textured_room(12, 0.005, 4, size=(320, 240))[0],
        "mere turn",
    ),
]


@pytest.mark.parametrize("name, images, message", FAILURES, ids=[f[0] for f in FAILURES])
def test_failures_are_no_crash_and_say_what_helps(tmp_path, name, images, message):
    pictures = images()
    poses = rt.estimate_poses(FakeVideo(pictures), config(**FEW), tmp_path)
    assert not poses.known.any() and poses.source == "none" and set(poses.status) == {"none"}
    assert (
        len(poses.frame) == len(pictures)
        and message in poses.messages[0]
        and "--poses" in poses.messages[0]
    )


def test_empty_video_and_live_camera_are_refused(tmp_path):
    with pytest.raises(rt.ReobjError, match="no frame"):
        rt.estimate_poses(FakeVideo([]), rt.PosesConfig(), tmp_path)
    video = blank(3)
    video.is_live = True
    with pytest.raises(rt.ReobjError, match="live"):
        rt.estimate_poses(video, rt.PosesConfig(), tmp_path)


def test_lost_middle_is_reported(walk, tmp_path):
    images = list(walk[0].images)
    images[12:28] = [np.zeros_like(images[0])] * 16
    poses = rt.estimate_poses(FakeVideo(images), config(max_gap=5, **FEW), tmp_path)
    lost = np.flatnonzero(~poses.known)
    if len(lost) < 40:  # the larger half may be too small a share of the keyframes
        assert set(range(12, 28)) <= set(lost.tolist())
    assert "frames" in " ".join(poses.messages)


def test_aborted_child_is_reported(walk, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(abort_script(tmp_path)))
    poses = rt.estimate_poses(walk[0], rt.PosesConfig(), tmp_path)
    assert (
        not poses.known.any()
        and "signal 6" in poses.messages[0]
        and "pycolmap.log" in poses.messages[0]
    )


def abort_script(folder):
    script = folder / "abort.sh"
    script.write_text("#!/bin/sh\nkill -ABRT $$\n")
    script.chmod(0o755)
    return script


def test_keyframes_are_bounded_and_reproducible():
    images, _ = textured_room(60, 0.08)
    chosen = [
        [k.place for k in rt.pick_keyframes(rt._WorkVideo(FakeVideo(images), c), c)]
        for c in (rt.PosesConfig(), rt.PosesConfig(), config(max_keyframes=5))
    ]
    assert chosen[0] == chosen[1] and chosen[0][0] == 0 and chosen[0][-1] == 59
    assert 5 < len(chosen[0]) < 30 and 3 <= len(chosen[2]) <= 6


def test_sharp_frames_are_preferred():
    images, _ = textured_room(40, 0.08)
    blurred = [cv2.GaussianBlur(im, (0, 0), 1.5) if i % 2 else im for i, im in enumerate(images)]
    keys = rt.pick_keyframes(rt._WorkVideo(FakeVideo(blurred), rt.PosesConfig()), rt.PosesConfig())
    inner = [k.place for k in keys[1:-1]]
    assert len(inner) >= 3 and all(place % 2 == 0 for place in inner)


def test_mapper_on_a_synthetic_dataset(tmp_path):
    """The ladder finds pycolmap's own synthetic scene, and counts frames that are not in it."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 12, 300
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        truth = pycolmap.synthesize_dataset(options, database)
    (model,), messages, trusted = rt._sfm_ladder(
        tmp_path / "database.db", 12, True, rt.PosesConfig()
    )
    assert trusted and not messages and model.num_reg_images() == 12
    names = [image.name for image in truth.images.values()]
    stack = [
        np.array([m.find_image_with_name(n).cam_from_world().matrix() for n in names])
        for m in (model, truth)
    ]
    assert ate_percent(*stack) < 0.1
    none, messages, _ = rt._sfm_ladder(tmp_path / "database.db", 30, True, rt.PosesConfig())
    assert none == [] and "only 12 of 30 keyframes connect" in messages[0]


def test_living_room(tmp_path):
    folder = SHARED / "livingroom13" / "images"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    files = sorted(folder.glob("*.jpg"))
    video = FakeVideo([cv2.imread(str(f)) for f in files], [f.name for f in files])
    poses = rt.estimate_poses(video, rt.PosesConfig(), tmp_path)
    assert poses.known.all() and 0.4 < poses.camera.params[0] / 1920 < 0.6


def test_rendered_room_against_its_truth(tmp_path):
    if not (ROOM / "room.mp4").exists() or not (ROOM / "camera.txt").exists():
        pytest.skip("examples/room/room.mp4 is not here")
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig())
    poses = rt.estimate_poses(video, rt.PosesConfig(), tmp_path)
    camera = ",".join((ROOM / "camera.txt").read_text().split()[4:])
    truth = rt.read_poses(ROOM / "poses.txt", video, config(camera=camera))
    both = poses.known & truth.known
    assert (
        both.mean() > 0.95
        and ate_percent(poses.cam_from_world[both], truth.cam_from_world[both]) < 0.6
    )
    assert poses.camera.K[0, 0] == pytest.approx(truth.camera.K[0, 0], rel=0.02)


# ---- Uncertainty, smoothing, EXIF, a killed run --------------------------------------------------


@pytest.mark.parametrize("params", [(500.0, 500.0, 320.0, 240.0), (500.0, 320.0, 240.0, -0.05)])
def test_covariance_of_a_pose_agrees_with_monte_carlo(params):
    """Errors of repeated PnP, seen from the camera, spread as the covariance says (6 numbers)."""
    model = "PINHOLE" if params[1] > 400 else "SIMPLE_RADIAL"
    camera, rng = rt.Camera(model, *SIZE, params), np.random.default_rng(0)
    pose = some_cameras()[4]
    in_cam = np.column_stack([rng.uniform(-1.2, 1.2, (80, 2)), rng.uniform(2, 6, 80)])
    points = (in_cam - pose[:, 3]) @ pose[:, :3]
    exact = np.array(rt._pycolmap_camera(camera, SIZE).img_from_cam(in_cam))
    errors, covs = [], []
    for _ in range(300):
        xy = exact + rng.normal(0, 0.7, exact.shape)
        found, cov = rt._absolute_pose(xy, points, camera, 640, rt.PosesConfig())
        turn = Rotation.from_matrix(found[:, :3] @ pose[:, :3].T).as_rotvec()
        shift = pose[:, :3] @ (rt.invert_rigid(found) - rt.invert_rigid(pose))[:, 3]
        errors.append(np.r_[turn, shift])
        covs.append(cov)
    errors = np.array(errors)
    spread, said = np.cov(errors.T), np.median(covs, axis=0)
    ratio = np.sqrt(np.diag(spread) / np.diag(said))
    assert (ratio > 0.85).all() and (ratio < 1.2).all()
    distance = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(said), errors)
    assert 5.0 < distance.mean() < 7.5  # chi-square with 6 degrees of freedom: the signs fit too


def test_covariance_is_unknown_when_points_do_not_fix_the_pose():
    camera = rt.Camera("PINHOLE", *SIZE, (FOCAL, FOCAL, 320.0, 240.0))
    line = np.column_stack([np.zeros((9, 2)), np.linspace(2, 4, 9)])
    assert np.isnan(rt.pose_cov(np.full((9, 2), 5.0), line, np.eye(4)[:3], camera)).all()
    assert np.isnan(rt.pose_cov(np.zeros((2, 2)), line[:2], np.eye(4)[:3], camera)).all()


def test_frames_have_a_sigma_that_is_kept_and_written(walk, tmp_path):
    _, truth, _, poses = walk
    sigma = np.sqrt(np.diagonal(poses.cov, axis1=1, axis2=2))
    assert sigma.shape == (40, 6) and np.isfinite(sigma).all()
    assert np.degrees(sigma[:, :3]).max() < 1
    rt.save_poses(tmp_path / "poses.npz", poses)
    np.testing.assert_array_equal(rt.load_poses(tmp_path / "poses.npz").cov, poses.cov)
    unknown = np.arange(40)[:, None, None] == 3
    lost = dataclasses.replace(poses, cov=np.where(unknown, np.nan, poses.cov))
    rt.write_camera_table(tmp_path / "cameras.csv", lost)
    rows = (tmp_path / "cameras.csv").read_text().splitlines()
    assert rows[0] == "frame,time_s,status,position_sigma,rotation_sigma_deg" and len(rows) == 41
    assert rows[4].endswith(",,") and float(rows[5].split(",")[3]) > 0
    rt.write_camera_table(tmp_path / "given.csv", given(truth))
    assert (tmp_path / "given.csv").read_text().splitlines()[1] == "0,0.000000,supplied,,"


def test_smoothing_is_off_by_default_and_keeps_a_parabola():
    s = np.linspace(-1, 1, 21)
    centres = np.column_stack([s, s**2, 0 * s])
    cams = np.array([look_at(c, c + np.array([0.1, 4, -1])) for c in centres])
    cams[10] = np.nan
    cams[4, :, 3] += 0.05
    smoothed = rt.smooth_path(cams, 7)
    assert rt.PosesConfig().smooth == 0 and np.isnan(smoothed[10]).all()
    np.testing.assert_allclose(smoothed[11:], cams[11:], atol=1e-9)
    centre = rt.invert_rigid(smoothed[4])[:, 3]
    moved = np.linalg.norm(rt.invert_rigid(cams[4])[:, 3] - centres[4])
    assert np.linalg.norm(centre - centres[4]) < 0.5 * moved
    np.testing.assert_array_equal(rt.smooth_path(cams[:3], 7), cams[:3])  # shorter than the window


def photo_with_exif(path, image, focal_35mm):
    """Write a JPEG whose EXIF says FocalLengthIn35mmFilm."""
    number = struct.pack("<H", 1)
    tiff = b"II*\0\x08\0\0\0" + number + struct.pack("<HHII", 0x8769, 4, 1, 26) + bytes(4)
    tiff += number + struct.pack("<HHIHH", 0xA405, 3, 1, focal_35mm, 0) + bytes(4)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    head = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(head) + 2) + head + data[2:])


def test_exif_focal_length_is_a_start_not_the_answer(tmp_path):
    """True: .9 of the width. A wrong one, with which no model can be trusted, is left for the
    usual guess.
    """
    for i, image in enumerate(textured_room(16, 0.25, -2)[0]):
        photo_with_exif(tmp_path / f"{i:03d}.jpg", image, 48)
    video = rt.Video(tmp_path)
    assert rt._exif_focal(video) == pytest.approx(1.387, abs=0.01)
    poses = rt.estimate_poses(video, config(**FEW), tmp_path / "work")
    assert poses.camera.K[0, 0] / 480 == pytest.approx(0.9, rel=0.03) and not poses.messages
    assert rt._exif_focal(blank(1)) == 0


def test_killed_while_mapping_goes_on_where_it_stopped(walk, tmp_path, monkeypatch):
    """The second run takes features and matches from the first and ends with the same cameras."""
    stages, started = [], []

    def note(stage, total):
        started.append(stage)
        if stage == "mapping" and stages == []:
            stages.extend(started)
            raise KeyboardInterrupt
        return rt.Progress(stage, total)

    with pytest.raises(KeyboardInterrupt):
        rt.estimate_poses(walk[0], config(**FEW), tmp_path, note)
    assert "features" in started and (tmp_path / "mapping" / "database.db").exists()
    started.clear()
    poses = rt.estimate_poses(walk[0], config(**FEW), tmp_path, note)
    assert "features" not in started and "mapping" in started
    np.testing.assert_allclose(poses.cam_from_world, walk[3].cam_from_world, atol=0.05)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pycolmap.log", "sparse"]


# ---- Separate reconstructions --------------------------------------------------------------------


def split(cams, tracks, noise, rng):
    """The first half as `whole`, the second in a world of its own; boxes of identities around the
    track's centres.
    """
    half = np.arange(len(cams)) < len(cams) // 2
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    scale, shift = 0.37, np.array([2.0, -1, 0.5])  # whole = scale * turn @ part + shift
    other = cams.copy()
    other[:, :, :3] = cams[:, :, :3] @ turn
    other[:, :, 3] = (cams[:, :, 3] + cams[:, :, :3] @ shift) / scale
    boxes = []
    for frame, xy in tracks:
        size = np.array([60, 50]) * rng.uniform(0.8, 1.5)
        boxes.append((frame, np.column_stack([xy - size / 2, xy + size / 2])))
    cov = np.tile(np.eye(6), (len(cams), 1, 1))
    whole, part = (
        dataclasses.replace(
            given(np.where(use[:, None, None], c, np.nan)), source="pycolmap", cov=cov
        )
        for use, c in ((half, cams), (~half, other))
    )
    message = "frames 30-59: a separate reconstruction, left out as it does not connect"
    return dataclasses.replace(whole, parts=(part,), messages=(message,)), boxes


def swapped(boxes, rng):
    """Identities of the second half given to other objects: what a twin does."""
    order = rng.permutation(len(boxes))
    mixed = []
    for a, b in enumerate(order):
        first, second = boxes[a][0] < 30, boxes[b][0] >= 30
        rows = [np.concatenate([boxes[a][i][first], boxes[b][i][second]]) for i in (0, 1)]
        mixed.append(tuple(rows))
    return mixed


@pytest.mark.parametrize("noise_px, most_percent", [(1, 1.0), (4, 3.0)])
def test_parts_are_joined_by_objects_seen_in_both(noise_px, most_percent):
    cams = motion("orbit")
    for seed in range(5):
        rng = np.random.default_rng(seed)
        whole, boxes = split(cams, box_tracks(cams, noise_px, seed), noise_px, rng)
        joined = rt.join_parts(whole, boxes)
        assert joined.known.all() and not joined.parts
        assert "joined to the rest" in joined.messages[0]
        centre = rt.invert_rigid(joined.cam_from_world)[:, :, 3]
        error = np.linalg.norm(centre - rt.invert_rigid(cams)[:, :, 3], axis=1)
        assert 100 * error.max() / 7 < most_percent  # of the path's extent
        assert joined.cov[40, 5, 5] == pytest.approx(0.37**2, rel=0.1)


def test_parts_stay_apart_when_identities_are_wrong_or_few():
    cams = motion("orbit")
    for seed in range(5):
        rng = np.random.default_rng(seed)
        whole, boxes = split(cams, box_tracks(cams, 2, seed), 2, rng)
        for wrong in (swapped(boxes, rng), boxes[:3], []):
            apart = rt.join_parts(whole, wrong)
            assert len(apart.parts) == 1 and not apart.known[30:].any()
            assert apart.messages == whole.messages


def test_parts_are_kept_with_the_poses(tmp_path):
    cams = motion("orbit")
    whole, _ = split(cams, box_tracks(cams, 2, 0), 2, np.random.default_rng(0))
    rt.save_poses(tmp_path / "poses.npz", whole)
    back = rt.load_poses(tmp_path / "poses.npz").parts[0]
    np.testing.assert_array_equal(back.cam_from_world, whole.parts[0].cam_from_world)


@pytest.mark.parametrize("noise_px, used", [(0, 4), (150, 0)])
def test_objects_as_landmarks_never_worsen_the_points(walk, noise_px, used):
    pycolmap, rng = pytest.importorskip("pycolmap"), np.random.default_rng(0)
    model = pycolmap.Reconstruction(str(walk[2] / "sparse"))
    longest = sorted(model.points3D.values(), key=lambda p: -p.track.length())[:4]
    objects = [
        {
            model.image(e.image_id).name: np.tile(
                model.image(e.image_id).point2D(e.point2D_idx).xy + rng.normal(0, noise_px, 2), 2
            )
            + np.array([-20, -15, 20, 15])
            for e in point.track.elements
        }
        for point in longest
    ]
    adjusted, alone, together, count = pose_accuracy.refine_together(model, objects)
    assert count == used and (adjusted is model) == (used == 0)
    if used:
        assert together <= 1.001 * alone and adjusted.num_points3D() == model.num_points3D()
    assert pose_accuracy.refine_together(model, [])[0] is model


def test_import_loads_no_pycolmap():
    code = "import sys, reobj_track; sys.exit('pycolmap' in sys.modules)"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], cwd=Path(rt.__file__).parent, check=False
        ).returncode
        == 0
    )
