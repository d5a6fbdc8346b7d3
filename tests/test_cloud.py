"""Dense points of the viewer, from depth maps."""

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

import reobj.viewer.cloud as cloud
import reobj_track as rt
from reobj.viewer.scene import write_pictures

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
    component = json.loads(text)["parts"][0]
    dense = component["dense"]
    n = dense["count"]
    data = base64.b64decode(dense["data"])
    place = np.frombuffer(data[: 6 * n], "<u2").reshape(-1, 3) * dense["step"] + dense["low"]
    return place + component["origin"], np.frombuffer(data[6 * n : 9 * n], np.uint8).reshape(-1, 3)


def with_depth(folder: Path, out: Path, depth: Path | str, poses: rt.Poses) -> Path:
    """Write the page with dense points of depth maps."""
    out.mkdir()
    assert write_pictures(
        result_of(poses), out, rt.Video(folder), overlay=False, cloud=True, depth=str(depth)
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


@pytest.mark.parametrize("fault", ["no folder", "no scale", "not a map", "no depth"])
def test_without_usable_depth_maps_there_are_no_points(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, fault: str
) -> None:
    """One line says why."""
    poses = poses_along_the_wall()
    depth = write_depth(tmp_path / "depth")
    if fault == "no scale":
        poses = dataclasses.replace(poses, metric=False)
    if fault == "not a map":
        cv2.imwrite(str(depth / "2.depth.png"), np.zeros((120, 160), np.uint8))
    given = {"no folder": tmp_path / "none", "no depth": ""}.get(fault, depth)
    with caplog.at_level(logging.WARNING):
        page = with_depth(folder, tmp_path / "out", given, poses)
    (message,) = [r.getMessage() for r in caplog.records]
    said = {
        "no folder": "no such folder",
        "no scale": "scale of the cameras is unknown",
        "not a map": "2.depth.png: not a depth map",
        "no depth": "give these with --depth",
    }
    assert message.startswith("no dense points: ") and said[fault] in message
    assert '"dense":{' not in page.read_text()


def test_the_most_observed_points_come_first_up_to_a_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wall, of which the right half was observed five times as often; larger voxels, no cut."""
    y, z = np.meshgrid(np.linspace(-2, 2, 400), np.linspace(0, 2, 200))
    wall = np.stack([np.zeros_like(y), y, z], -1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    xyz = np.concatenate([wall, *[wall[wall[:, 1] > 0]] * 4])
    xyz += rng.normal(0, 0.002, xyz.shape)
    towards = np.tile([1.0, 0, 0], (len(xyz), 1))
    rgb = np.full((len(xyz), 3), 99, np.uint8)
    whole = cloud._voxels(xyz, rgb, towards, 0.0)
    assert (whole.xyz[: len(whole.xyz) // 3, 1] > 0).mean() > 0.95
    assert (whole.xyz[:, 1] > 0).mean() < 0.8
    monkeypatch.setattr(cloud, "MOST", 3000)
    few = cloud._voxels(xyz, rgb, towards, 0.0)
    assert 2000 < len(few.xyz) <= 3000 < len(whole.xyz) and few.voxel > whole.voxel
    assert (few.xyz[:, 1] > 0).mean() == pytest.approx(0.5, abs=0.05)
