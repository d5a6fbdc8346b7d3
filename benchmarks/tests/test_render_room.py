"""The rendered room: its ground truth must be exact, as other tests and figures depend on it."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import render_room as rr

ROOT = Path(__file__).resolve().parents[2]


SMALL = rr.RoomConfig(seed=3, width=320, height=240, frames=40, texels_per_m=60, light_rays=1)


@pytest.fixture(scope="module")
def room():
    return rr.make_room(SMALL)


@pytest.fixture(scope="module")
def view(room):
    """One clean frame of the first view (the whole dining set) with its truth."""
    K, pose = rr.camera_matrix(SMALL), rr.camera_path(room, SMALL)[4]
    _, instance, depth = rr.render(room, K, pose, (SMALL.width, SMALL.height))
    return K, pose, instance, depth, rr.ground_truth(room, K, pose, instance)


def sampled_surface(room, index: int) -> np.ndarray:
    """(N, 3) dense points on all patches of one object."""
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61)))
    points = []
    for i in np.nonzero(room.surfaces.owner == index)[0]:
        kind, s, t = int(room.surfaces.kind[i]), u, v
        if kind == rr.DISC:
            inside = (u - 0.5) ** 2 + (v - 0.5) ** 2 <= 0.25
            s, t = u[inside], v[inside]
        frame = room.surfaces.world_from_patch[i]
        points.append(rr.surface_points(kind, frame, room.surfaces.radii[i], s, t)[0])
    return np.concatenate(points)


def test_same_seed_same_bytes(room, view) -> None:
    K, pose, instance, depth, _ = view
    again = rr.make_room(SMALL)
    assert all(np.array_equal(a, b) for a, b in zip(room.atlas, again.atlas, strict=True))
    np.testing.assert_array_equal(room.light, again.light)
    _, instance2, depth2 = rr.render(again, K, pose, (SMALL.width, SMALL.height))
    np.testing.assert_array_equal(instance, instance2)
    np.testing.assert_array_equal(depth, depth2)
    frames = [next(rr.render_clip(r, SMALL)) for r in (room, again)]
    np.testing.assert_array_equal(frames[0].image, frames[1].image)


def test_identical_objects_differ_in_position_only(room) -> None:
    chairs = [o for o in room.objects if o.class_name == "chair"]
    assert len(chairs) >= 4 and len({o.twin_group for o in chairs}) == 1
    rects = [room.surfaces.texture_rect[room.surfaces.owner == o.index] for o in chairs]
    assert all(np.array_equal(rects[0], other) for other in rects[1:])
    centers = np.stack([o.center_in_world for o in chairs])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1) + 10 * np.eye(len(chairs))
    assert apart.min() > 0.5


def test_visible_box_lies_in_amodal_box(room, view) -> None:
    truth = view[4]
    seen = np.nonzero(truth.visible_px > 20)[0]
    assert len(seen) >= 8
    low = truth.visible_xyxy[seen, :2] - truth.amodal_xyxy[seen, :2]
    high = truth.amodal_xyxy[seen, 2:] - truth.visible_xyxy[seen, 2:]
    assert (
        low.min() > -1.0 and high.min() > -1.0
    )  # a pixel belongs to its majority: < 1 px of slack


def test_fully_visible_object_fills_its_amodal_box(room, view) -> None:
    truth = view[4]
    size = np.array([SMALL.width, SMALL.height])
    inside = (truth.amodal_xyxy[:, :2] > 1).all(1) & (truth.amodal_xyxy[:, 2:] < size - 1).all(1)
    clear = np.nonzero((truth.visibility > 0.9) & inside)[0]
    assert len(clear) >= 2
    assert np.abs(truth.visible_xyxy[clear] - truth.amodal_xyxy[clear]).max() < 1.5


def test_amodal_box_is_that_of_the_sampled_surface(room, view) -> None:
    K, pose, _, _, truth = view
    checked = 0
    for index in np.nonzero(np.isfinite(truth.amodal_xyxy[:, 0]))[0]:
        pixels, depth = rr.project_points(sampled_surface(room, index), K, pose)
        if depth.min() < 0.5:
            continue
        expected = np.concatenate([pixels.min(0), pixels.max(0)])
        side = (expected[2:] - expected[:2]).max()
        assert np.abs(truth.amodal_xyxy[index] - expected).max() < 0.01 * side + 0.05
        checked += 1
    assert checked >= 10


def test_the_shape_contains_the_surface(room) -> None:
    for item in room.objects:
        in_obj = (sampled_surface(room, item.index) - item.center_in_world) @ item.world_from_obj
        reach = np.abs(in_obj).max(0) / (item.size_m / 2)
        assert np.all(reach <= 1 + 1e-6) and np.all(reach > 0.98), item.class_name


def test_depth_puts_mask_pixels_on_the_object(room, view) -> None:
    K, pose, instance, depth, _ = view
    rows, cols = np.nonzero(instance >= 0)
    rays = np.stack([cols + 0.5, rows + 0.5, np.ones(len(rows))], -1) @ np.linalg.inv(K).T
    in_world = (rays * depth[rows, cols, None] - pose[:, 3]) @ pose[:, :3]  # R^T (X - t)
    centers = np.stack([o.center_in_world for o in room.objects])[instance[rows, cols]]
    radii = np.array([np.linalg.norm(o.size_m) / 2 for o in room.objects])[instance[rows, cols]]
    assert np.mean(np.linalg.norm(in_world - centers, axis=1) < radii + 0.02) > 0.995


def test_every_pixel_is_covered(view) -> None:
    assert view[3].min() > rr.NEAR_M and view[3].max() < 12  # closed room: no holes


def test_path_is_smooth_translates_and_returns(room) -> None:
    config = rr.RoomConfig(seed=3)
    poses = rr.camera_path(room, config)
    rotation = poses[:, :, :3]
    square = rotation @ rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    centers = -np.einsum("fji,fj->fi", rotation, poses[:, :, 3])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 0.12 and np.median(steps) > 0.01
    cosine = np.einsum("fi,fi->f", rotation[1:, 2], rotation[:-1, 2])
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 8
    assert rotation[0, 2] @ rotation[-1, 2] > 0.9  # looks in the first direction again
    assert (rotation[:, 2] @ rotation[0, 2]).min() < -0.5  # and away from it in between


@pytest.mark.parametrize("kind", ["revisit", "walk", "orbit"])
def test_path_stays_in_the_room(room, kind: str) -> None:
    poses = rr.camera_path(room, rr.RoomConfig(seed=3, path=kind, frames=90))
    centers = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
    assert np.all(np.abs(centers[:, :2]) < np.array(room.size_m[:2]) / 2 - 0.3)


def viewing(room, **changes) -> tuple[np.ndarray, np.ndarray]:
    """Centres (F, 3) and viewing directions (F, 3) of a path."""
    poses = rr.camera_path(room, replace(SMALL, **changes))
    return -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3]), poses[:, 2, :3]


def test_table_is_photographed_once_round_in_steps_of_28_cm(room) -> None:
    centers, forward = viewing(room, path="table", frames=150)
    tables = [o for o in room.objects if o.class_name == "dining table"]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(0.28, abs=0.01) and steps.max() < 0.285
    assert np.all(np.abs(centers[:, :2]) < np.array(room.size_m[:2]) / 2 - 0.3)
    away = centers[:, None] - [t.center_in_world for t in tables]  # (F, T, 3)
    target = np.linalg.norm(away[..., :2], axis=2).std(0).argmin()  # the one it goes around
    turn = np.unwrap(np.arctan2(away[:, target, 1], away[:, target, 0]))
    assert np.degrees(turn[-1] - turn[0]) == pytest.approx(360) and np.all(np.diff(turn) > 0)
    to_table = -away[:, target] / np.linalg.norm(away[:, target], axis=1, keepdims=True)
    assert np.degrees(np.arccos((forward * to_table).sum(1))).max() < 15
    few, _ = viewing(room, path="table", frames=13)  # fewer than 28 cm steps would need
    assert np.ptp(few[:, 2]) < 0.01 and np.ptp(np.linalg.norm(np.diff(few, axis=0), axis=1)) < 1e-3


def test_photos_are_not_blurred_by_their_steps(room) -> None:
    config = replace(SMALL, path="table", frames=40, noise=0.0)
    still, moving = (
        next(rr.render_clip(room, replace(config, shutter=shutter))).image for shutter in (0.0, 0.9)
    )
    np.testing.assert_array_equal(still, moving)


def test_turn_is_a_pure_rotation(room) -> None:
    centers, forward = viewing(room, path="turn", frames=100, shake_m=0.0)
    still = slice(40, 60)
    assert np.ptp(centers[still], axis=0).max() < 1e-6
    assert np.linalg.norm(np.diff(centers[:25], axis=0), axis=1).min() > 1e-3
    assert np.degrees(np.arccos(forward[40] @ forward[60])) > 60


def test_rooms_of_the_corridor_look_identical(room) -> None:
    row, (w, d, h) = rr.rooms_in_a_row(room, 3), room.size_m
    assert row.size_m == (3 * w, d, h) and len(row.objects) == 3 * len(room.objects)
    assert [o.index for o in row.objects] == list(range(len(row.objects)))
    centers, _ = viewing(row, path="corridor", frames=60)
    assert np.all(np.diff(centers[:, 0]) > 0) and np.ptp(centers[:, 0]) > 2.3 * w
    K, views = rr.camera_matrix(SMALL), []
    for x in (-w, 0.0, w):  # looking at one side of each room
        angles = np.array([[1.2], [-0.3], [0.0]])
        pose = rr.look_along(np.array([[x - 1, -0.3, 1.5]]), *angles)[0]
        views.append(rr.render(row, K, pose, (320, 240), 1))
    for image, instance, depth in views[1:]:
        assert (np.abs(image.astype(int) - views[0][0]).max(2) > 8).mean() < 0.02
        np.testing.assert_allclose(depth, views[0][2], atol=0.05)
        both = (instance >= 0) & (views[0][1] >= 0)
        step = (instance - views[0][1])[both] / len(room.objects)
        assert both.any() and set(step.tolist()) <= {1.0, 2.0}
    ahead = rr.look_along(np.array([[-1.5 * w + 1, 0.0, 2.2]]), *np.zeros((3, 1)))[0]
    depth = rr.render(row, K, ahead, (320, 240), 1)[2]
    assert np.quantile(depth, 0.95) > 1.5 * w  # no wall between


def test_unknpath_where_seen_is_refused(room) -> None:
    with pytest.raises(ValueError, match="use revisit, walk"):
        rr.camera_path(room, rr.RoomConfig(path="fly"))


def test_run_lengths_round_trip() -> None:
    rng = np.random.default_rng(0)
    for mask in (rng.random((5, 7)) > 0.5, np.zeros((3, 2), bool), np.ones((3, 2), bool)):
        counts = rr.run_lengths(mask)
        values = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        np.testing.assert_array_equal(values.reshape(mask.shape, order="F"), mask)
    assert len(rr.run_lengths(np.zeros((0, 0), bool))) == 0


def test_quaternion_rebuilds_the_rotation(room) -> None:
    for pose in rr.camera_path(room, SMALL):
        x, y, z, w = rr.quaternion_xyzw(pose[:, :3])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross  # Rodrigues for unit quaternions
        np.testing.assert_allclose(rotation, pose[:, :3], atol=1e-12)


def test_detector_noise_is_as_configured(room, view) -> None:
    _, _, instance, _, truth = view
    perfect = rr.DetectorConfig(0.0, 0.0, -9.0, -99.0, 0.0, 0.0, 0.0, 0.0)
    found = rr.simulate_detections(room, truth, instance, perfect, np.random.default_rng(0))
    np.testing.assert_allclose(found.xyxy, truth.visible_xyxy[found.truth_index])
    assert len(found.score) == (truth.visible_px > 0).sum()
    noisy = rr.DetectorConfig(false_positives=3.0)
    drawn = [
        rr.simulate_detections(room, truth, instance, noisy, np.random.default_rng(1)) for _ in "ab"
    ]
    np.testing.assert_array_equal(drawn[0].xyxy, drawn[1].xyxy)
    assert (drawn[0].truth_index == -1).any()
    real = [k for k, i in enumerate(drawn[0].truth_index) if i >= 0 and truth.visible_px[i] > 200]
    for k in real:
        mask, exact = drawn[0].masks[k], instance == drawn[0].truth_index[k]
        assert (mask & exact).sum() / (mask | exact).sum() > 0.6


def check_detections(path: Path, frames: int, size: tuple[int, int]) -> None:
    """The schema that the reader relies on."""
    data = dict(np.load(path))  # each access to the file itself would unpack the array again
    count = len(data["frame"])
    kinds = {"frame": "int64", "xyxy": "float64", "score": "float64", "class_id": "int64"}
    kinds |= {"image_size": "int64", "mask_counts": "uint32", "mask_offsets": "int64"}
    assert {name: str(data[name].dtype) for name in kinds} == kinds
    assert data["class_names"].dtype.kind == "U" and data["class_names"][56] == "chair"
    assert data["image_size"].tolist() == list(size)
    assert data["xyxy"].shape == (count, 4) and data["mask_offsets"].shape == (count + 1,)
    assert np.all(np.diff(data["frame"]) >= 0) and data["frame"].max() < frames
    assert np.all((data["score"] > 0) & (data["score"] < 1))
    bounds = zip(data["mask_offsets"][:-1], data["mask_offsets"][1:], strict=True)
    sums = {int(data["mask_counts"][a:b].sum()) for a, b in bounds if b > a}
    assert sums == {size[0] * size[1]}


def test_command_line_writes_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = functools.partial(rr.RoomConfig, light_rays=1)  # 10: most of the time is light
    monkeypatch.setattr(rr, "RoomConfig", quick)
    options = ["--size", "160x120", "--frames", "3", "--seed", "3", "--texels", "40"]
    assert rr.main(["-o", str(tmp_path), *options]) == 0
    check_detections(tmp_path / "detections.npz", 3, (160, 120))
    assert (tmp_path / "room.mp4").stat().st_size > 1000
    mot = np.loadtxt(tmp_path / "gt_mot.txt", delimiter=",")
    assert mot.shape[1] == 9 and mot[:, 0].min() == 1 and mot[:, 1].min() >= 1
    assert mot[:, 8].min() >= 0.1 and mot[:, 4:6].min() >= 8
    assert np.loadtxt(tmp_path / "poses.txt").shape == (3, 8)
    truth = json.loads((tmp_path / "gt_objects.json").read_text())
    assert {o["support"] for o in truth["objects"]} == {"box", "cylinder", "ellipsoid"}
    fields = (tmp_path / "camera.txt").read_text().split()
    assert fields[:4] == ["1", "PINHOLE", "160", "120"] and float(fields[6]) == 80.0


@pytest.mark.parametrize("size", ["640", "axb", "4x4"])
def test_bad_size_is_refused(tmp_path: Path, size: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert rr.main(["-o", str(tmp_path), "--size", size]) == 2
    assert "expected e.g. 640x480" in capsys.readouterr().err


def test_shipped_clip_is_complete() -> None:
    folder = ROOT / "examples" / "room"
    poses = np.loadtxt(folder / "poses.txt")
    check_detections(folder / "detections.npz", len(poses), (640, 480))
    names = [
        "room.mp4",
        "detections.npz",
        "gt_mot.txt",
        "gt_objects.json",
        "poses.txt",
        "camera.txt",
    ]
    assert sum((folder / name).stat().st_size for name in names) < 3_000_000
    mot = np.loadtxt(folder / "gt_mot.txt", delimiter=",")
    objects = json.loads((folder / "gt_objects.json").read_text())["objects"]
    away = {
        int(i): int(np.diff(mot[mot[:, 1] == i, 0]).max(initial=0)) - 1
        for i in np.unique(mot[:, 1])
    }
    back = [o for o in objects if away.get(o["id"], 0) >= 60]
    assert sum(o["class"] == "chair" for o in back) >= 2 and len(back) >= 5


# ---- Rooms of every seed ----

VARIED = rr.RoomConfig(
    seed=5, width=160, height=120, frames=48, texels_per_m=40, light_rays=1,
    plan="varied", path="tour",
)  # fmt: skip


@pytest.fixture(scope="module")
def varied():
    return rr.make_room(VARIED)


def test_varied_rooms_differ_and_repeat(varied) -> None:
    again, other = rr.make_room(VARIED), rr.make_room(replace(VARIED, seed=6))
    assert rr.objects_json(again, VARIED) == rr.objects_json(varied, VARIED)
    np.testing.assert_array_equal(again.light, varied.light)
    assert all(np.array_equal(a, b) for a, b in zip(varied.atlas, again.atlas, strict=True))
    assert other.size_m != varied.size_m and len(other.objects) != len(varied.objects)


def test_varied_rooms_contain_identical_objects_inside_their_walls(varied) -> None:
    groups = [o.twin_group for o in varied.objects]
    assert sum(groups.count(g) >= 2 for g in set(groups)) >= 2
    limit = np.array(varied.size_m[:2]) / 2
    for item in varied.objects:
        assert (np.abs(item.center_in_world[:2]) < limit).all(), item.class_name
        rects = varied.surfaces.texture_rect[varied.surfaces.owner == item.index]
        first = varied.surfaces.owner == groups.index(item.twin_group)
        np.testing.assert_array_equal(rects, varied.surfaces.texture_rect[first])


def test_tour_stays_in_the_room_and_revisits_objects(varied) -> None:
    poses = rr.camera_path(varied, VARIED)
    centers = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
    assert (np.abs(centers[:, :2]) < np.array(varied.size_m[:2]) / 2 - 0.2).all()
    K, seen = rr.camera_matrix(VARIED), []
    for pose in poses[::3]:
        _, instance, _ = rr.render(varied, K, pose, (VARIED.width, VARIED.height), 1)
        seen.append(np.bincount(instance.ravel() + 1, minlength=len(varied.objects) + 1)[1:] > 20)
    early, late = np.array(seen[:8]).any(0), np.array(seen[8:]).any(0)
    assert (early & late).sum() >= 0.4 * len(varied.objects)


def test_stretched_model_keeps_unit_normals() -> None:
    model = rr.stretched(rr.office_chair_model(), (0.9, 1.1, 1.2))
    flat = [part for part in model.parts if part.kind in (rr.QUAD, rr.DISC)]
    normals = np.stack([part.obj_from_patch[:, 2] for part in flat])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    for part in flat:
        np.testing.assert_allclose(
            part.obj_from_patch[:, :2].T @ part.obj_from_patch[:, 2], 0, atol=1e-9
        )


def test_the_committed_room_equals_that_of_its_seed() -> None:
    config = rr.RoomConfig(seed=0, frames=240, texels_per_m=40, light_rays=1)
    found = rr.objects_json(rr.make_room(config), config)
    golden = json.loads((ROOT / "examples" / "room" / "gt_objects.json").read_text())
    for name in ("room_m", "K", "objects"):
        assert found[name] == golden[name]
    assert found["config"].keys() == golden["config"].keys()


@pytest.mark.parametrize("change", [{"plan": "castle"}, {"path": "flight"}])
def test_unknown_plan_or_path_is_refused(change: dict[str, str], room) -> None:
    config = replace(SMALL, **change)
    with pytest.raises(ValueError, match="unknown"):
        rr.camera_path(room if "path" in change else rr.make_room(config), config)
