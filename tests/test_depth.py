"""Depth maps: assignment to frames, their camera, points, visibility and metric scale."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
from pose_worlds import FakeVideo, motion, supplied

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.files import Progress
from reobj.poses import stage
from reobj.poses.supplied.depth import add_depth, find_depth_maps, smooth_pixels
from reobj.results.workspace import Workspace

SIZE = (320, 240)
CAMERA = rt.Camera("PINHOLE", *SIZE, (250.0, 250.0, 160.0, 120.0))
FRAMES = 12


def depth_of_box(cam_from_world, camera=CAMERA, half=5.0):
    """Depth (h, w) in m inside a room |x|, |y|, |z - 1| < half, seen from within."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    if camera.model != "PINHOLE":
        pixels = camera.undistort(pixels)
    in_cam = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T
    world_from_cam = invert_rigid(cam_from_world)
    ray, centre = in_cam @ world_from_cam[:, :3].T, world_from_cam[:, 3] - [0, 0, 1]
    with np.errstate(divide="ignore"):
        t = ((half * np.sign(ray) - centre) / ray).min(1)  # in units of depth: z of the ray is 1
    return t.reshape(camera.height, camera.width)


def on_walls(points, half=5.0):
    return np.abs(np.abs(points - [0, 0, 1]).max(1) - half)


def write_maps(folder, cams, names, units=1000.0, camera=CAMERA, depth_from_color=None):
    folder.mkdir(parents=True, exist_ok=True)
    for pose, name in zip(cams, names, strict=True):
        seen = pose
        if depth_from_color is not None:
            turn, shift = depth_from_color[:, :3], depth_from_color[:, 3]
            seen = np.column_stack([turn @ pose[:, :3], turn @ pose[:, 3] + shift])
        depth = depth_of_box(seen, camera) * units
        depth[:20, :30] = 0
        depth[-20:, :30] = 65535
        cv2.imwrite(str(folder / name), depth.round().astype(np.uint16))
    return folder


@pytest.fixture
def walk():
    cams = motion("walk", FRAMES)
    return supplied(cams, CAMERA)


def metric(poses):
    return dataclasses.replace(poses, metric=True)


class NamedVideo(FakeVideo):
    def name(self, index):
        return self.names[index] if self.names else ""


def add(poses, text, names=()):
    images = [np.full((*SIZE[::-1], 3), 20 * i, np.uint8) for i in range(FRAMES)]
    return add_depth(poses, str(text), NamedVideo(images, names))


NUMBERS = [f"{i:04d}.png" for i in range(FRAMES)]


# ---- Points --------------------------------------------------------------------------------------


def test_points_lie_on_the_walls_with_colour_and_the_frames_that_see_them(tmp_path, walk):
    walk.cam_from_world[3] = np.nan
    good = np.delete(np.arange(FRAMES), 3)
    folder = write_maps(tmp_path / "d", walk.cam_from_world[good], [NUMBERS[i] for i in good])
    poses = add(metric(walk), folder)
    assert 3000 < len(poses.points) <= 20000 and poses.messages == ()
    assert on_walls(poses.points).max() < 0.01
    row, point = poses.visibility.T
    assert {*row} == {*good} and {*point} == {*range(len(poses.points))}
    pose = poses.cam_from_world[row]
    xy = CAMERA.project((pose[:, :, :3] @ poses.points[point][..., None])[..., 0] + pose[:, :, 3])
    assert (xy > 0).all() and (xy < SIZE).all()
    assert set(np.unique(poses.colors).tolist()) <= {20 * int(i) for i in good}
    assert len(set(np.unique(poses.colors).tolist())) > 5
    voxel = np.floor((poses.points - poses.points.min(0)) / 0.02).astype(int)
    assert len(np.unique(voxel, axis=0)) > 0.7 * len(voxel)  # thinned


def test_occluded_points_are_not_observed(tmp_path, walk):
    """An object stands in front of the wall in two maps and occludes the points behind it."""
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS)
    for name in NUMBERS[4:6]:
        depth = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        depth[100:140, 140:180] = 1500
        cv2.imwrite(str(folder / name), depth)
    poses = add(metric(walk), folder)
    on_wall = on_walls(poses.points) < 0.05
    for row in (4, 5, 8):
        seen = poses.visibility[poses.visibility[:, 0] == row, 1]
        pose = poses.cam_from_world[row]
        xy = CAMERA.project(poses.points[seen] @ pose[:, :3].T + pose[:, 3])
        occluded = ((xy > (142, 102)) & (xy < (178, 138))).all(1) & on_wall[seen]
        assert occluded.any() if row == 8 else not occluded.any()
        assert row != 8 or on_wall[seen].all()  # others see through the object


def test_maps_of_another_camera_use_its_file(tmp_path, walk):
    """Intrinsics, size and pose differ from the colour camera's."""
    camera = rt.Camera("PINHOLE", 200, 160, (190.0, 180.0, 104.0, 77.0))
    color_from_depth = np.column_stack([np.eye(3), [0.3, -0.1, 0.05]])
    folder = tmp_path / "d"
    write_maps(folder, walk.cam_from_world, NUMBERS, 1000, camera, invert_rigid(color_from_depth))
    own = dict(zip(("fx", "fy", "cx", "cy"), camera.params, strict=True))
    facts = own | {"T_color_from_depth": [0.3, -0.1, 0.05]}
    (folder / "intrinsics.json").write_text(json.dumps(facts))
    assert on_walls(add(metric(walk), folder).points).max() < 0.02
    (folder / "intrinsics.json").write_text(json.dumps(own))  # the way between them left out
    assert np.median(on_walls(add(metric(walk), folder).points)) > 0.02
    (folder / "intrinsics.json").unlink()
    with pytest.raises(rt.ReobjError, match="add the depth camera's intrinsics there"):
        add(metric(walk), folder)
    beside = {"fx": 1, "depth": own, "T_color_from_depth": [0.3, -0.1, 0.05]}
    (tmp_path / "intrinsics.json").write_text(json.dumps(beside))
    assert on_walls(add(metric(walk), folder).points).max() < 0.02


def test_registered_maps_are_undistorted(tmp_path):
    camera = rt.Camera("SIMPLE_RADIAL", *SIZE, (250.0, 160.0, 120.0, 0.25))
    poses = metric(supplied(motion("walk", FRAMES), camera))
    folder = write_maps(tmp_path / "d", poses.cam_from_world, NUMBERS, camera=camera)
    off = on_walls(add(poses, folder).points)
    assert np.percentile(off, 99) < 0.06
    plain = dataclasses.replace(poses, camera=CAMERA)
    assert np.percentile(on_walls(add(plain, folder).points), 99) > 0.06


def test_subsampled_maps_have_no_pixel_offset(tmp_path, walk):
    """Every 3rd pixel of 960: half a pixel off would show."""
    camera = CAMERA.resized((960, 720))
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS, camera=camera)
    depth, K = find_depth_maps(str(folder), walk, NamedVideo([])).read(5)
    assert depth.shape == (240, 320)
    y, x = np.mgrid[30:200:10, 40:300:10].reshape(2, -1)
    in_cam = np.column_stack([x + 0.5, y + 0.5, np.ones(len(x))]) @ np.linalg.inv(K).T
    turn, centre = np.split(invert_rigid(walk.cam_from_world[5]), [3], 1)
    assert on_walls((in_cam * depth[y, x][:, None]) @ turn.T + centre[:, 0]).max() < 0.002


# ---- Scale ---------------------------------------------------------------------------------------


def with_points(poses, unit_m, noise=0.0):
    """The same scene without scale, with sparse points on the walls seen by every second frame."""
    rng = np.random.default_rng(0)
    points = []
    for cam in poses.cam_from_world[::2]:
        x, y = rng.integers(0, [SIZE], (60, 2)).T
        z = depth_of_box(cam)[y, x] * np.exp(noise * rng.normal(size=60))
        in_cam = np.column_stack([x + 0.5, y + 0.5, np.ones(60)]) @ np.linalg.inv(CAMERA.K).T
        turn, centre = np.split(invert_rigid(cam), [3], 1)
        points.append((in_cam * z[:, None]) @ turn.T + centre[:, 0])
    cams = poses.cam_from_world.copy()
    cams[:, :, 3] /= unit_m
    xyz = np.concatenate(points) / unit_m
    seen = np.column_stack([np.repeat(np.arange(0, FRAMES, 2), 60), np.arange(len(xyz))])
    return dataclasses.replace(
        poses, cam_from_world=cams, points=xyz, colors=np.zeros(xyz.shape, np.uint8),
        visibility=seen, source="pycolmap",
    )  # fmt: skip


@pytest.mark.parametrize(("unit_m", "noise"), [(0.07, 0.0), (23.0, 0.05)])
def test_a_reconstruction_becomes_metric(tmp_path, walk, unit_m, noise):
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS)
    poses = add(with_points(walk, unit_m, noise), folder)
    assert poses.metric and poses.messages == ()  # the summary says it
    assert poses.scale is not None and poses.scale[0] == 1 and 0.02 <= poses.scale[1] < 0.05
    scale = poses.cam_from_world[:, :, 3] / walk.cam_from_world[:, :, 3]
    np.testing.assert_allclose(scale, 1, rtol=0.02)
    np.testing.assert_allclose(poses.cam_from_world[:, :, :3], walk.cam_from_world[:, :, :3])
    assert np.median(on_walls(poses.points)) < 0.1 and len(poses.points) > 1000


def test_every_component_has_its_own_scale(tmp_path, walk):
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS)
    one, other = with_points(walk, 0.5), with_points(walk, 4.0)
    component = (np.arange(FRAMES) >= 6).astype(int)
    of_second = np.zeros((len(one.points), 1), bool)
    of_second[one.visibility[one.visibility[:, 0] >= 6, 1]] = True
    given = dataclasses.replace(
        one, part=component, points=np.where(of_second, other.points, one.points),
        cam_from_world=np.where(component[:, None, None], other.cam_from_world, one.cam_from_world),
    )  # fmt: skip
    poses = add(given, folder)
    assert poses.metric
    np.testing.assert_allclose(poses.cam_from_world, walk.cam_from_world, rtol=0.02, atol=1e-9)
    assert np.percentile(on_walls(poses.points), 90) < 0.1
    for name in NUMBERS[5:]:
        (folder / name).unlink()
    lacking = add(given, folder)
    assert not lacking.metric and "the scale of component 1" in lacking.messages[0]
    np.testing.assert_array_equal(lacking.cam_from_world, given.cam_from_world)


@pytest.mark.parametrize("mistake", ["units", "poses", "two units"])
def test_maps_that_contradict_the_poses_or_each_other(tmp_path, walk, mistake):
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS)
    if mistake == "two units":
        write_maps(folder, walk.cam_from_world[1::2], NUMBERS[1::2], units=3000)
        poses = add(with_points(walk, 0.5), folder)
        assert not poses.metric and "varies by" in poses.messages[0]
        return
    if mistake == "poses":
        walk = dataclasses.replace(walk, cam_from_world=invert_rigid(walk.cam_from_world))
    poses = add(metric(walk), f"{folder}:300" if mistake == "units" else folder)
    assert len(poses.points) == 0 and "no points from depth" in poses.messages[0]


# ---- Assignment of maps to frames ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("maps", "names", "expected"),
    [
        (["a.png", "c.png"], ["c.jpg", "b.jpg", "a.jpg"], [0, 2]),  # by name
        (["frame-02.depth.png"], ["frame-01.color.png", "frame-02.color.png"], [1]),  # 7-Scenes
        (["0002_depth.png"], ["0001_rgb.png", "0002_rgb.png"], [1]),
        (["1305031102.160407.png"], ["1305031102.175304.png", "1305031102.211214.png"], [0]),  # TUM
        (["d7.png", "d8.png"], ["img008.jpg", "img009.jpg"], [0]),  # by the last number
        (["7.png", "3.png"], [], [3, 7]),  # of a video: frame numbers
    ],
)
def test_maps_are_assigned_to_frames(tmp_path, maps, names, expected):
    count = len(names) or 9
    poses = supplied(motion("walk", count), CAMERA)
    write_maps(tmp_path / "d", poses.cam_from_world[: len(maps)], maps)
    found = find_depth_maps(str(tmp_path / "d"), poses, NamedVideo([], names))
    assert sorted(found.files) == expected


def image(shape, kind=np.uint16):
    return cv2.imencode(".png", np.ones(shape, kind))[1].tobytes()


MAP = {"0000.png": image(SIZE[::-1])}


@pytest.mark.parametrize(
    ("files", "text", "expected"),
    [
        (None, "d", "no such folder"), ({}, "d:much", "no such folder"),
        ({}, "d:0", "no such folder"), ({}, "d", "no .png in it"),
        ({"0001.png": b"no image"}, "d", "not a depth map"),
        ({"0001.png": image((240, 320, 3), np.uint8)}, "d", "not a depth map"),
        ({"99.png": image((24, 32))}, "d", "none of its 1 depth maps"),
        (MAP | {"0001.png": image((24, 32))}, "d", "32x24 pixels"),
        (MAP | {"intrinsics.json": b'{"f": {}}'}, "d", "intrinsics.json: expected fx"),
        (MAP | {"intrinsic_depth.txt": b"1 2 3"}, "d", "intrinsic_depth.txt: 3 numbers"),
    ],
)  # fmt: skip
def test_bad_input_gives_one_line(tmp_path, walk, files, text, expected):
    for name, content in (files or {}).items():
        (tmp_path / "d").mkdir(exist_ok=True)
        (tmp_path / "d" / name).write_bytes(content)
    if files == {}:
        (tmp_path / "d").mkdir()
    with pytest.raises(rt.ReobjError, match=expected) as refused:
        add(metric(walk), f"{tmp_path}/{text}")
    assert "\n" not in str(refused.value)


def test_edges_of_depth_are_not_used_and_own_points_keep_their_rows(tmp_path, walk):
    """A sensor mixes both depths at an edge; in units of .2 mm, with points of the user."""
    depth = np.full((9, 30), 2, np.float32)
    depth[:, 10:20] = 3
    depth[:, 20:] = 3 * 1.04 ** np.arange(10)  # a slope of 4 % a pixel is a surface
    depth[4, 15] = 0  # a hole is none
    ok = smooth_pixels(depth)
    assert not ok[:, 9:11].any() and not ok[3:6, 14:17].any()
    assert ok[:, :9].all() and ok[:, 18:].all() and ok[:3, 12:].all()
    own = np.array([[9.0, 9, 9], [8, 8, 8]])
    given = dataclasses.replace(
        metric(walk), points=own, colors=np.array([[1, 2, 3]] * 2, np.uint8),
        visibility=np.array([[0, 1], [1, 0]]),
    )  # fmt: skip
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS, units=5000)
    poses = add(given, f"{folder}:5000")
    np.testing.assert_array_equal(poses.points[:2], own)
    np.testing.assert_array_equal(poses.visibility[:2], [[0, 1], [1, 0]])
    assert poses.visibility[2:, 1].min() == 2 and len(poses.colors) == len(poses.points)
    assert on_walls(poses.points[2:]).max() < 0.01


@pytest.mark.parametrize("supplied_poses", [True, False])
def test_depth_in_a_run_and_its_cache(tmp_path, walk, supplied_poses):
    """Poses in metres get points; a second call takes them from the cache."""
    (tmp_path / "images").mkdir()
    for i in range(FRAMES):
        picture = np.full((*SIZE[::-1], 3), 20 * i, np.uint8)
        cv2.imwrite(str(tmp_path / "images" / NUMBERS[i]), picture)
    video, workspace = rt.Video(tmp_path / "images"), Workspace(tmp_path / "out")
    folder = write_maps(tmp_path / "d", walk.cam_from_world, NUMBERS)
    config = rt.PosesConfig(depth=str(folder))
    given = metric(walk) if supplied_poses else with_points(walk, 0.5)
    found = [stage.with_points(given, video, config, workspace, Progress) for _ in range(2)]
    assert found[0].metric and len(found[0].points) > 3000
    np.testing.assert_array_equal(found[0].points, found[1].points)
    np.testing.assert_allclose(found[0].cam_from_world, walk.cam_from_world, rtol=0.02, atol=1e-9)
    if not supplied_poses:
        assert stage.with_points(given, video, rt.PosesConfig(), workspace, Progress) is given
