"""The walk through a flat: limits of the path, parts that fit, identities of the whole flat."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import render_walk
from rendering import parts
from rendering.camera import camera_matrix
from rendering.config import RoomConfig
from rendering.flat import make_flat, plan_flat, visible_part
from rendering.ground_truth import ground_truth, project_points
from rendering.raster import render
from rendering.walk import clearance_m, walk_path

SMALL = RoomConfig(
    seed=3, width=160, height=120, frames=3000, fps=30.0, texels_per_m=30, light_rays=1,
    plan="flat", path="flat",
)  # fmt: skip


@pytest.fixture(scope="module")
def flat():
    return make_flat(SMALL, 2)


@pytest.fixture(scope="module")
def poses():
    return walk_path(SMALL, *plan_flat(SMALL, 2))


def centers_of(poses: np.ndarray) -> np.ndarray:
    return -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])


def test_path_is_slow_smooth_and_clear_of_everything(flat, poses) -> None:
    centers = centers_of(poses)
    assert len(poses) == SMALL.frames
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1).max() * SMALL.fps < 0.8
    rotation = poses[:, :, :3]
    trace = np.einsum("fij,fij->f", rotation[1:], rotation[:-1])
    turn = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))) * SMALL.fps
    assert turn.max() < 45
    assert clearance_m(flat, centers).min() > 0.2
    for item in flat.room.objects:  # another way than the rectangles of the plan
        in_obj = (centers - item.center_in_world) @ item.world_from_obj
        assert np.linalg.norm(np.maximum(np.abs(in_obj) - item.size_m / 2, 0), axis=1).min() > 0.1


def test_walk_goes_through_the_door_and_returns_to_its_first_view(flat, poses) -> None:
    centers = centers_of(poses)
    x, y = flat.doors[0]
    crossings = np.nonzero(np.diff(np.sign(centers[:, 0] - x)))[0]
    assert len(crossings) == 2 and np.abs(centers[crossings, 1] - y).max() < 0.2
    assert np.linalg.norm(centers[0] - centers[-1]) < 0.1
    assert poses[0, 2, :3] @ poses[-1, 2, :3] > 0.99


def test_clip_too_short_for_the_walk_is_refused() -> None:
    with pytest.raises(ValueError, match="use at least"):
        walk_path(replace(SMALL, frames=100), *plan_flat(SMALL, 2))


def test_identities_are_unique_and_some_models_are_in_both_rooms(flat) -> None:
    objects = flat.room.objects
    assert [o.index for o in objects] == list(range(len(objects)))
    rooms = np.array(flat.room_of_object)
    groups = np.array([o.twin_group for o in objects])
    shared = set(groups[rooms == 0]) & set(groups[rooms == 1])
    assert "chair" in {objects[int(np.argmax(groups == g))].class_name for g in shared}
    for group in shared:
        rects = [
            flat.room.surfaces.texture_rect[flat.room.surfaces.owner == i]
            for i in np.nonzero(groups == group)[0]
        ]
        assert all(np.array_equal(rects[0], other) for other in rects[1:])


def test_patches_left_out_are_not_visible_and_rooms_have_no_holes(flat, poses) -> None:
    K = camera_matrix(SMALL)
    size = (SMALL.width, SMALL.height)
    x = centers_of(poses)[:, 0] - flat.doors[0, 0]
    crossing = int(np.nonzero(np.diff(np.sign(x)))[0][0])
    for number in (0, crossing - 60, crossing - 15, crossing, crossing + 15, crossing + 60, 1500):
        whole = render(flat.room, K, poses[number], size, 1)
        drawn = visible_part(flat, K, poses[number], size)
        assert len(drawn.surfaces.kind) < len(flat.room.surfaces.kind)
        part = render(drawn, K, poses[number], size, 1)
        assert (whole[0] != part[0]).mean() < 1e-3  # equal depths may be ordered otherwise
        np.testing.assert_allclose(whole[2], part[2], atol=1e-4)
        assert part[2].max() < 20  # nothing behind a hole is infinitely far


def test_objects_are_where_the_truth_says(flat, poses) -> None:
    K = camera_matrix(SMALL)
    size = (SMALL.width, SMALL.height)
    checked = 0
    for number in range(0, SMALL.frames, 500):
        _, instance, _ = render(flat.room, K, poses[number], size, 1)
        truth = ground_truth(flat.room, K, poses[number], instance)
        for item in flat.room.objects:
            inside = (truth.solid_xyxy[item.index] > 0).all() and (
                truth.solid_xyxy[item.index, 2:] < size
            ).all()
            if truth.visibility[item.index] > 0.95 and inside:
                pixel, _ = project_points(item.center_in_world, K, poses[number])
                box = truth.visible_xyxy[item.index]
                assert (pixel > box[:2] - 1).all() and (pixel < box[2:] + 1).all()
                checked += 1
    assert checked > 3


def test_parts_join_to_what_is_rendered_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flat
) -> None:
    monkeypatch.setattr(parts, "make_flat", lambda config, count: flat)
    monkeypatch.setattr(render_walk, "RoomConfig", lambda **kw: replace(SMALL, **kw))
    options = ["--seed", "3", "--frames", "3000", "--rooms", "2", "--size", "160x120"]
    options += ["--texels", "30", "--stride", "600"]
    whole = ["-o", str(tmp_path / "whole"), *options]
    parted = ["-o", str(tmp_path / "parts"), *options]
    assert render_walk.main(whole) == 0
    assert render_walk.main([*parted, "--part", "2/2"]) == 0
    assert render_walk.main([*parted, "--join", "2"]) == 2  # the first part is missing
    assert render_walk.main([*parted, "--part", "1/2"]) == 0
    assert render_walk.main([*parted, "--join", "2"]) == 0
    assert render_walk.main([*parted, "--part", "3/2"]) == 2
    for name in ("gt_mot.txt", "poses.txt", "camera.txt", "gt_objects.json"):
        texts = [(tmp_path / folder / name).read_bytes() for folder in ("whole", "parts")]
        assert texts[0] == texts[1], name
    found = [dict(np.load(tmp_path / f / "detections.npz")) for f in ("whole", "parts")]
    assert found[0].keys() == found[1].keys()
    for name, values in found[0].items():
        np.testing.assert_array_equal(values, found[1][name])
        assert values.dtype == found[1][name].dtype
    frames = []
    for folder in ("whole", "parts"):
        capture = cv2.VideoCapture(str(tmp_path / folder / "room.mp4"))
        assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30 / 600, rel=0.01)
        frames.append([capture.read()[1] for _ in range(5)])
        assert not capture.grab()
    for one, other in zip(*frames, strict=True):  # another key frame: other rounding
        assert np.abs(one.astype(int) - other).mean() < 4
    assert np.loadtxt(tmp_path / "parts" / "poses.txt")[:, 0].tolist() == [0, 20, 40, 60, 80]
    rooms = {
        o["room"] for o in json.loads((tmp_path / "parts/gt_objects.json").read_text())["objects"]
    }
    assert rooms == {1, 2}


def test_a_frame_depends_on_its_number_only(flat, poses) -> None:
    first = parts.flat_frame(flat, SMALL, poses, 1200).image
    parts.flat_frame(flat, SMALL, poses, 7)
    np.testing.assert_array_equal(first, parts.flat_frame(flat, SMALL, poses, 1200).image)
