"""Dense points of the viewer: flow between frames of known cameras, triangulated."""

from __future__ import annotations

import base64
import dataclasses
import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from simulated import fitted

import reobj.results.cloud as cloud
import reobj.results.scene as scene
import reobj_track as rt
from reobj.results.cloud import Cloud, FlowFrames
from reobj.results.scene import Pictures, write_pictures, write_scene

WIDTH = 320
HEIGHT = 240
FOCAL = 250.0  # px
FRAMES = 8
DEPTH = 3.0  # of a wall, whose texture has 100 pixels a metre


def wall() -> np.ndarray:
    """The texture of the wall z = 3, from (-4, -4): left half reddish, right half bluish."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (800, 800, 3)), (0, 0), 2)
    image = 60 + (image - image.mean()) * 5
    image[:, :400, 2] += 90
    image[:, 400:, 0] += 90
    return image.clip(0, 255).astype(np.uint8)


def poses_along_the_wall() -> rt.Poses:
    """Cameras that look at the wall and walk along it, 8 cm a frame."""
    cam_from_world = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    cam_from_world[:, 0, 3] = -0.08 * (np.arange(FRAMES) - FRAMES / 2)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-2, 2, (400, 2)), np.full(400, DEPTH)])
    return rt.Poses(
        camera=rt.Camera("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)),
        frame=np.arange(FRAMES),
        time_s=np.arange(FRAMES) / 25,
        cam_from_world=cam_from_world,
        status=np.full(FRAMES, "supplied"),
        source="user",
        metric=True,
        up_in_world=np.array([0, -1.0, 0]),
        points=points,
        colors=np.zeros((400, 3), np.uint8),
    )


def frames_of(poses: rt.Poses) -> list[np.ndarray]:
    """The wall in each camera."""
    plane = np.array([[0.01, 0, -4], [0, 0.01, -4], [0, 0, DEPTH], [0, 0, 1]])  # of its pixels
    texture = wall()
    frames = []
    for pose in poses.cam_from_world:
        img_from_wall = poses.camera.K @ pose @ plane
        frames.append(cv2.warpPerspective(texture, img_from_wall, (WIDTH, HEIGHT)))
    return frames


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the frames."""
    top = tmp_path_factory.mktemp("wall")
    for i, image in enumerate(frames_of(poses_along_the_wall())):
        cv2.imwrite(str(top / f"{i}.png"), image)
    return top


def result_of(poses: rt.Poses) -> rt.Result:
    """A result with these cameras; its object does not matter."""
    n = np.arange(FRAMES)
    box = np.tile([100.0, 100, 150, 150], (FRAMES, 1))
    tracks = rt.Tracks(n, n * 0 + 1, n * 0 + 1, box, n * 0 + 0.9, n * 0, n)
    return dataclasses.replace(fitted(tracks, None, names=("chair",)), poses=poses)


def test_points_lie_on_the_wall_in_its_colours() -> None:
    poses = poses_along_the_wall()
    frames = FlowFrames(poses)
    for number, image in enumerate(frames_of(poses)):
        if number in frames.wanted:
            frames.take(number, image)
    found = frames.cloud(0)
    assert found is not None and len(found) > 20_000
    assert np.percentile(np.abs(found.xyz[:, 2] - DEPTH), 95) < 0.03
    np.testing.assert_allclose(np.linalg.norm(found.seen_from, axis=1), 1, atol=1e-4)
    assert (found.seen_from[:, 2] < -0.7).all()  # towards the cameras
    at = np.round((found.xyz[:, :2] + 4) * 100 - 0.5).astype(int)
    true = cv2.GaussianBlur(wall(), (0, 0), 1)[at[:, 1], at[:, 0], ::-1].astype(float)
    assert np.abs(found.rgb - true).mean() < 15
    gap = np.abs(found.xyz - found.xyz.mean(0))
    assert (gap < 4 * np.percentile(gap, 90)).all()


def two_components() -> rt.Poses:
    """The walk along the wall twice; the second component has a world of ten times the size."""
    one = poses_along_the_wall()
    large = one.cam_from_world.copy()
    large[:, :, 3] *= 10
    frame, point = np.indices((FRAMES, 400)).reshape(2, -1)
    seen = np.column_stack([frame, point])
    return dataclasses.replace(
        one,
        frame=np.arange(2 * FRAMES),
        time_s=np.arange(2 * FRAMES) / 25,
        cam_from_world=np.concatenate([one.cam_from_world, large]),
        status=np.tile(one.status, 2),
        points=np.concatenate([one.points, one.points * 10]),
        colors=np.tile(one.colors, (2, 1)),
        visibility=np.concatenate([seen, np.add(seen, (FRAMES, 400))]),
        part=np.repeat([0, 1], FRAMES),
    )


def test_each_component_has_its_depths() -> None:
    """The baseline is compared with the depth of the points of the same component."""
    poses = two_components()
    frames = FlowFrames(poses)
    images = frames_of(poses_along_the_wall())
    for number, image in enumerate([*images, *images]):
        if number in frames.wanted:
            frames.take(number, image)
    for part, scale in enumerate((1, 10)):
        cloud = frames.cloud(part)
        assert cloud is not None and len(cloud) > 20_000
        assert np.percentile(np.abs(cloud.xyz[:, 2] / scale - DEPTH), 95) < 0.03


def test_unrelated_frames_give_no_points() -> None:
    poses = poses_along_the_wall()
    frames = FlowFrames(poses)
    rng = np.random.default_rng(2)
    for number in frames.wanted:
        noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        frames.take(number, cv2.GaussianBlur(noise, (0, 0), 3))
    found = frames.cloud(0)
    assert found is None or len(found) < 500


def test_the_page_has_the_points(folder: Path, tmp_path: Path) -> None:
    poses = poses_along_the_wall()
    result = result_of(poses)
    video = rt.Video(folder)
    for dense in (False, True):
        out = tmp_path / str(dense)
        out.mkdir()
        assert write_pictures(result, out, video, overlay="none", cloud=dense) == []
    text = [(tmp_path / name / "scene.html").read_text() for name in ("False", "True")]
    parts = [json.loads(t.split('id="data">')[1].split("</script>")[0])["parts"] for t in text]
    assert "dense" not in parts[0][0]
    dense = parts[1][0]["dense"]
    data = base64.b64decode(dense["data"])
    n = dense["count"]
    assert len(data) == 12 * n > 200_000
    place = np.frombuffer(data[: 6 * n], "<u2").reshape(-1, 3) * dense["step"] + dense["low"]
    place += parts[1][0]["origin"]
    assert np.percentile(np.abs(place[:, 2] - DEPTH), 95) < 0.03
    rgb = np.frombuffer(data[6 * n : 9 * n], np.uint8).reshape(-1, 3).astype(int)
    left = place[:, 0] < 0
    assert rgb[left, 0].mean() > rgb[left, 2].mean() + 40  # red
    assert rgb[~left, 2].mean() > rgb[~left, 0].mean() + 40
    assert (np.frombuffer(data[9 * n :], np.int8).reshape(-1, 3)[:, 2] < -80).all()


def test_the_most_observed_points_come_first() -> None:
    """A wall, of which the right half was observed five times as often as the left one."""
    y, z = np.meshgrid(np.linspace(-2, 2, 400), np.linspace(0, 2, 200))
    wall = np.stack([np.zeros_like(y), y, z], -1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    xyz = np.concatenate([wall, *[wall[wall[:, 1] > 0]] * 4])
    xyz += rng.normal(0, 0.002, xyz.shape)
    towards = np.tile([1.0, 0, 0], (len(xyz), 1))
    made = cloud._voxels(xyz, np.full((len(xyz), 3), 99, np.uint8), towards)
    first = made.of_rows(np.arange(len(made) // 3))
    assert (first.xyz[:, 1] > 0).mean() > 0.95
    assert (made.xyz[:, 1] > 0).mean() < 0.8


def write_depth(folder: Path, spoiled: int = -1) -> Path:
    """Depth maps in mm, 160 x 120, of every second frame: of the wall.

    Args:
        spoiled: map with a patch at 1 m, where the others see through. The left half of the wall
            is then at 2 m.
    """
    folder.mkdir()
    width = WIDTH // 2
    for i in range(0, FRAMES, 2):
        depth = np.full((HEIGHT // 2, width), 1000 * DEPTH)
        if spoiled >= 0:
            center = 0.08 * (i - FRAMES / 2)
            depth[:, (np.arange(width) + 0.5 - width / 2) / (FOCAL / 2) * 2 + center < 0] = 2000
        if i == spoiled:
            depth[60:90, 60:100] = 1000
        depth[:10] = 0
        cv2.imwrite(str(folder / f"{i}.depth.png"), depth.astype(np.uint16))
    return folder


def dense_of(page: Path) -> tuple[np.ndarray, np.ndarray]:
    """The dense points of a page in world, and their colours."""
    text = page.read_text().split('id="data">')[1].split("</script>")[0]
    part = json.loads(text)["parts"][0]
    dense = part["dense"]
    n = dense["count"]
    data = base64.b64decode(dense["data"])
    place = np.frombuffer(data[: 6 * n], "<u2").reshape(-1, 3) * dense["step"] + dense["low"]
    return place + part["origin"], np.frombuffer(data[6 * n : 9 * n], np.uint8).reshape(-1, 3)


def with_depth(folder: Path, out: Path, depth: Path | str, poses: rt.Poses) -> Path:
    """Write the page with dense points of depth maps."""
    out.mkdir()
    assert write_pictures(
        result_of(poses), out, rt.Video(folder), overlay="none", cloud=True, depth=str(depth)
    ) == []  # fmt: skip
    return out / "scene.html"


@pytest.mark.parametrize("metric", [True, False])
def test_points_of_depth_maps(folder: Path, tmp_path: Path, metric: bool) -> None:
    """Exactly on the wall, in its colours; also where a map gives the scale, .5 m a unit."""
    poses = poses_along_the_wall()
    metres = 1.0
    if not metric:
        metres = 0.5
        cam_from_world = poses.cam_from_world.copy()
        cam_from_world[:, :, 3] /= metres
        poses = dataclasses.replace(
            poses,
            metric=False,
            scale=(metres, 0.0),
            cam_from_world=cam_from_world,
            points=poses.points / metres,
        )
    page = with_depth(folder, tmp_path / "out", write_depth(tmp_path / "depth"), poses)
    place, rgb = dense_of(page)
    place *= metres
    assert len(place) > 10_000 and np.abs(place[:, 2] - DEPTH).max() < 0.002
    at = np.round((place[:, :2] + 4) * 100 - 0.5).astype(int)
    true = cv2.GaussianBlur(wall(), (0, 0), 1)[at[:, 1], at[:, 0], ::-1].astype(float)
    assert np.abs(rgb.astype(float) - true).mean() < 15
    top = (10 / (HEIGHT / 2) - 0.5) * HEIGHT / FOCAL * DEPTH  # above it the maps are empty
    assert place[:, 1].min() > top


def test_what_other_maps_see_through_is_left_out(folder: Path, tmp_path: Path) -> None:
    depth = write_depth(tmp_path / "depth", spoiled=4)
    place, _ = dense_of(with_depth(folder, tmp_path / "out", depth, poses_along_the_wall()))
    assert {2.0, 3.0} == set(place[:, 2].round(1)) and len(place) > 5000
    assert np.abs(place[:, 2] - place[:, 2].round()).max() < 0.01  # nor between, at the edge


def test_a_cloud_has_a_limit_that_larger_voxels_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everywhere fewer points, none cut off."""
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 4, (200_000, 2)), np.zeros(200_000)])
    rgb = np.zeros((len(xyz), 3), np.uint8)
    whole = cloud._voxels(xyz, rgb, xyz)
    monkeypatch.setattr(cloud, "MOST", 3000)
    few = cloud._voxels(xyz, rgb, xyz)
    assert 2000 < len(few) <= 3000 < len(whole) and few.voxel > whole.voxel
    for quarter in ((few.xyz[:, :2] < 2) == [a, b] for a in (True, False) for b in (True, False)):
        assert quarter.all(1).mean() == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("fault", ["no folder", "no scale", "not a map"])
def test_without_usable_depth_maps_flow_makes_the_points(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, fault: str
) -> None:
    """One line says why."""
    poses = poses_along_the_wall()
    depth = write_depth(tmp_path / "depth")
    if fault == "no scale":
        poses = dataclasses.replace(poses, metric=False)
    if fault == "not a map":
        cv2.imwrite(str(depth / "2.depth.png"), np.zeros((120, 160), np.uint8))
    given = tmp_path / "none" if fault == "no folder" else depth
    with caplog.at_level(logging.WARNING):
        place, _ = dense_of(with_depth(folder, tmp_path / "out", given, poses))
    (message,) = [r.getMessage() for r in caplog.records]
    said = {"no folder": "no such folder", "no scale": "scale of the cameras is unknown",
            "not a map": "2.depth.png: not a depth map"}  # fmt: skip
    assert said[fault] in message and "from optical flow, not from depth maps" in message
    assert len(place) > 20_000


def test_points_leave_the_page_below_its_limit(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Fewer points; without room for any, the message gives the size of the page."""
    result = result_of(poses_along_the_wall())
    video = rt.Video(folder)
    pictures = Pictures(result, video, dense=FlowFrames(result.poses))
    for frame in video:
        pictures.take(frame)
    monkeypatch.setattr(scene, "PAGE_MAX", 1_000_000)
    write_scene(result, pictures, tmp_path / "scene.html", video)
    assert 900_000 < (tmp_path / "scene.html").stat().st_size <= 1_000_000
    assert caplog.text == ""
    monkeypatch.setattr(scene, "PAGE_MAX", 1000)
    write_scene(result, pictures, tmp_path / "scene.html", video)
    assert "no dense points: the page has 0." in caplog.text and "baseline" not in caplog.text


def test_without_a_baseline_there_is_a_message(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    poses = poses_along_the_wall()
    still = dataclasses.replace(poses, cam_from_world=np.tile(np.eye(3, 4), (FRAMES, 1, 1)))
    with caplog.at_level(logging.WARNING):
        write_pictures(result_of(still), tmp_path, rt.Video(folder), overlay="none", cloud=True)
    assert "no dense points" in caplog.text
    assert '"dense":{' not in (tmp_path / "scene.html").read_text()


def test_points_are_quantised_within_their_step() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-3, 5, (50, 3))
    towards = np.tile([0, 0, 1.0], (50, 1))
    points = Cloud(xyz, rng.integers(0, 255, (50, 3)).astype(np.uint8), towards, 0.01)
    dense = scene._dense_points(points, np.array([1.0, 2, 3]), 40)
    data = base64.b64decode(dense["data"])
    found = np.frombuffer(data[: 6 * 40], "<u2").reshape(-1, 3) * dense["step"] + dense["low"]
    np.testing.assert_allclose(found, xyz[:40] - [1, 2, 3], atol=dense["step"])
    assert dense["step"] < 8 / 60_000
