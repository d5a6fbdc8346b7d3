"""The trained two-part embedding: sampling of the map, the weights that come along, training."""

from __future__ import annotations

import csv
import importlib
import json
import math
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from test_rank_k import backbone
from test_tracker import scene_with_twins

import reobj_track as rt

ROOT = Path(__file__).resolve().parents[1]
LAYOUT = rt.EmbedConfig(context=0.5, samples=4, foreground_cells=3, background_cells=4)


def boxes(*xyxy: tuple[float, float, float, float], masks: np.ndarray | None = None):
    n = len(xyxy)
    return rt.Detections(np.array(xyxy, float), np.full(n, 0.9), np.zeros(n, np.int64), masks)


def samples(detections: rt.Detections, layout: rt.EmbedConfig = LAYOUT) -> list[SimpleNamespace]:
    """Of foreground, grown and wider boxes: index, weight (N, k, k, S), share, others (N, k, k)."""
    rows = np.arange(len(detections))
    objects = rt.object_map(detections, (200, 400), (50, 100))
    both = rt.part_samples(detections, [rows, rows], (200, 400), objects, layout)
    values = {"index": both.index, "weight": both.weight}
    values |= {"share": both.share[:, 0], "others": both.share[:, 1]}
    near, parts = layout.background_cells**2, []
    for part, some in ((0, slice(None)), (1, slice(near)), (1, slice(near, None))):
        cut = {name: both.split(value)[part][:, some] for name, value in values.items()}
        side = math.isqrt(cut["share"].shape[1])
        cut = {n: v.reshape(len(rows), side, side, *v.shape[2:]) for n, v in cut.items()}
        parts.append(SimpleNamespace(**cut))
    return parts[: 2 + (layout.wide > 0)]


# ---- Sampling ----


def test_foreground_is_the_inscribed_ellipse_and_background_the_rest() -> None:
    fore, back = samples(boxes((100, 50, 200, 150)))
    assert fore.weight.mean() == pytest.approx(np.pi / 4, abs=0.03)
    assert back.weight.mean() == pytest.approx(1 - np.pi / 16, abs=0.03)
    row, column = np.divmod(back.index[0][back.weight[0]], 100)
    assert column.min() * 4 >= 48 and column.max() * 4 <= 250  # grown by half a box on every side
    assert row.min() <= 2 and row.max() >= 47  # rows 0..200
    assert fore.share.shape == (1, 3, 3) and back.share.shape == (1, 4, 4)
    assert back.others.mean() < 0.02  # the rim of its own outline, drawn on the coarse map


def test_masks_of_all_objects_are_no_background() -> None:
    masks = np.zeros((2, 200, 400), bool)
    masks[0, 50:150, 100:150] = masks[1, :, 200:] = True
    fore, back = samples(boxes((100, 50, 200, 150), (200, 0, 400, 200), masks=masks))
    left = fore.index[0] % 100 < 37  # the mask is the left half of the box
    np.testing.assert_array_equal(fore.weight[0], left)
    right = back.index[0] % 100 >= 50
    assert (
        not (back.weight[0] & right).any() and not (back.weight[0] & masks_at(masks[0], back)).any()
    )
    np.testing.assert_allclose(back.others[0][:, 3], 1.0)


def masks_at(mask: np.ndarray, part: SimpleNamespace) -> np.ndarray:
    row, column = np.divmod(part.index[0], 100)
    return np.asarray(mask[row * 4 + 2, column * 4 + 2])


def test_small_boxes_reach_further() -> None:
    wide = rt.EmbedConfig(context=0.5, reach=0.1, samples=4)
    _, near = samples(boxes((100, 100, 110, 110)))
    _, far = samples(boxes((100, 100, 110, 110)), wide)
    assert np.ptp(near.index % 100) * 4 <= 20 and np.ptp(far.index % 100) * 4 >= 76


def test_surroundings_hold_other_objects_but_not_the_own() -> None:
    masks = np.zeros((2, 200, 400), bool)
    masks[0, 80:120, 180:220] = masks[1, :, 240:] = True
    found = boxes((180, 80, 220, 120), (240, 0, 400, 200), masks=masks)
    layout = rt.EmbedConfig(context=0.5, samples=4, wide=1.5, wide_reach=0.2, wide_cells=5)
    _, _, wide = samples(found, layout)
    column = wide.index[0] % 100
    assert (column.min() * 4, column.max() * 4) == (104, 292)  # 200 -+ (20 + .2 * 400), 4 px a cell
    assert (
        wide.weight[0][column > 60].all() and not (wide.weight[0] & masks_at(masks[0], wide)).any()
    )
    assert wide.share.shape == (1 + 1, 5, 5) and wide.share[0, 2, 2] == 0
    np.testing.assert_allclose(wide.others[0][:, 4], 1.0)


def test_cells_are_means_of_the_samples_that_count() -> None:
    """On a map that holds its own columns and rows; the foreground reads only the first channel."""
    layout = rt.EmbedConfig(context=0.5, samples=4, wide=1.0, wide_cells=5, foreground_channels=1)
    found = boxes((100, 50, 200, 150), (120, 60, 150, 90))
    rows, objects = [np.array([1]), np.array([0, 1])], np.zeros((50, 100), bool)
    both = rt.part_samples(found, rows, (200, 400), objects, layout)
    y, x = np.mgrid[:50, :100].astype(np.float32)
    fore, back = rt.part_cells(np.stack([x, y], -1), both, layout)
    assert fore.shape == (1, 4, 3) and back.shape == (2, 16 + 25, 4)
    np.testing.assert_allclose(fore[0, :, 0].reshape(2, 2).mean(0), [32, 35.5], atol=0.6)
    first = np.where(both.weight[4], np.divmod(both.index[4], 100), np.nan)  # of the grown box
    np.testing.assert_allclose(back[0, 0, 1::-1], np.nanmean(first, 1), rtol=1e-5)
    assert (
        fore[0, 0, 1] == both.weight[0].mean() and back[1, 20, 2] == both.weight[4 + 41 + 20].mean()
    )


@pytest.mark.parametrize("box", [(-50, -50, 20, 20), (395, 190, 600, 400), (900, 900, 950, 950)])
def test_samples_out_of_the_image_do_not_count(box: tuple[float, ...]) -> None:
    for part in samples(boxes(box)):
        assert part.index.min() >= 0 and part.index.max() < 5000
        assert part.share.max() <= 1
    assert box[0] != 900 or not samples(boxes(box))[0].weight.any()


# ---- The weights that come along ----


def test_own_weights_are_found_without_a_download(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("REOBJ_MODELS", str(tmp_path))
    path = rt.model_path("reobj", offline=True)
    assert path.parent == rt.own_models()
    assert sum(f.stat().st_size for f in path.parent.iterdir()) < 5e6
    state = {row.weights.name: row.state for row in rt.list_models()}
    assert state["reobj"] == "verified"


def test_own_weights_tell_twins_apart_and_know_an_object_again() -> None:
    image, detections = scene_with_twins()
    moved = np.roll(image, (5, 9), (0, 1)).astype(int) + 12
    later = boxes((99, 95, 159, 155), (339, 95, 399, 155))
    embedder, looks = rt.Embedder("reobj", threads=1), []
    for picture, found in ((image, detections), (moved.clip(0, 255).astype(np.uint8), later)):
        look = embedder(picture, found)
        assert look.foreground.shape == (2, 128) and look.background.shape == (2, 256)
        np.testing.assert_allclose(np.linalg.norm(look.foreground, axis=1), 1, atol=1e-5)
        looks.append(np.concatenate([look.foreground, look.background], 1))
    cosine = looks[0] @ looks[1].T / 2  # rows: before, columns: after
    assert cosine.diagonal().min() > cosine[~np.eye(2, dtype=bool)].max() + 0.2


def test_own_foreground_sees_no_context() -> None:
    """Everything from 10 pixels (of 320) around the object on is changed: its background alone
    notices.
    """
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    image, mask = cv2.GaussianBlur(noise, (0, 0), 3), np.zeros((1, 240, 320), bool)
    mask[0, 100:150, 120:180] = True
    other, around = 255 - image, (slice(90, 160), slice(110, 190))
    other[around] = image[around]
    embedder = rt.Embedder("reobj", threads=1)
    one, two = (
        embedder(picture, boxes((120, 100, 180, 150), masks=mask)) for picture in (image, other)
    )
    np.testing.assert_allclose(one.foreground, two.foreground, atol=1e-4)
    assert (one.background * two.background).sum() < 0.95


def test_what_stands_around_is_the_look_of_near_neighbours() -> None:
    """The near one of two others counts more, unsure ones and oneself do not; alone: nothing."""
    xyxy = np.array([(0, 0, 40, 40), (50, 0, 90, 40), (300, 0, 340, 40), (0, 0, 40, 40)], float)
    sure, look = np.array([True, True, True, False]), np.eye(4)
    around = rt.look_around(xyxy, look, sure, np.arange(4))
    np.testing.assert_allclose(np.linalg.norm(around, axis=1), 1)
    assert around[0, 1] > 0.99 > around[2, 1] > around[2, 0] > 0 and not around[:, 3].any()
    assert not around.diagonal().any() and around[3, 0] > around[3, 1]  # the unsure one has some
    np.testing.assert_allclose(around, rt.look_around(3 * xyxy + 7, look, sure, np.arange(4)))
    assert not rt.look_around(xyxy[:1], look[:1], sure[:1], np.arange(1)).any()
    np.testing.assert_allclose(around[2:], rt.look_around(xyxy, look, sure, np.array([2, 3])))


def test_neighbours_tell_places_apart_that_look_the_same() -> None:
    """Twins on a plain wall; a red and a green thing stand near, but out of their background."""
    image, grey = np.full((480, 640, 3), 160, np.uint8), (40, 40, 40)
    things = {20: grey, 440: grey, 200: (0, 0, 220), 620: (0, 220, 0)}
    for x, colour in things.items():
        image[220:260, x - 20 : x + 20] = colour
    found = boxes(*[(x - 20, 220, x + 20, 260) for x in things])
    plain, told = (
        rt.Embedder("reobj", rt.EmbedConfig(neighbours=share), threads=1)(image, found).background
        for share in (0.0, 0.2)
    )
    assert (plain.shape[1], told.shape[1]) == (128, 256)
    np.testing.assert_allclose(np.linalg.norm(told, axis=1), 1, atol=1e-5)
    assert told[0] @ told[1] < plain[0] @ plain[1] - 0.02
    alone = rt.Embedder("reobj", threads=1)(image, found[:1]).background
    assert not alone[:, 128:].any() and np.linalg.norm(alone) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("model", ["reobj", "colour"])
def test_some_rows_are_embedded_as_all_rows(model: str) -> None:
    """In whatever order they are asked for, also by and by: then the map is made once."""
    image, detections = scene_with_twins()
    embedder = rt.Embedder(model, threads=1)
    whole, part = embedder(image, detections), embedder(image, detections, np.array([1]))
    np.testing.assert_allclose(whole.foreground[1:], part.foreground, atol=1e-5)
    np.testing.assert_allclose(whole.background[1:], part.background, atol=1e-5)
    later = rt.Embedder(model, threads=1)
    later(image, detections, np.array([1]))
    later._features = None  # type: ignore[assignment]
    later(image, detections, np.array([1]))
    turned = later(image, detections, np.array([1, 0]))
    np.testing.assert_allclose(whole.foreground[::-1], turned.foreground, atol=1e-5)
    np.testing.assert_allclose(whole.background[::-1], turned.background, atol=1e-5)
    assert len(embedder(image, detections, np.zeros(0, np.int64)).background) == 0


def test_a_map_serves_the_next_frame() -> None:
    """The look of boxes that moved with the image: nearly that of a map of their own, far from that
    of another place; no map is computed.
    """
    rng = np.random.default_rng(5)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (520, 700, 3), dtype=np.uint8), (0, 0), 6)
    old, new = wide[:480, :640], wide[3:483, 6:646]  # things move by (-6, -3)
    there = boxes((100, 100, 180, 220), (300, 200, 380, 300))
    here = boxes((94, 97, 174, 217), (294, 197, 374, 297))
    embedder, computed = rt.Embedder(threads=1), []
    own = rt.Embedder(threads=1)(new, here)
    plain = embedder._features
    embedder._features = lambda frame: (computed.append(1), plain(frame))[1]
    embedder(old, there)
    assert not embedder.keep_map(new, here, there.xyxy, new)  # another video came between
    assert embedder.keep_map(new, here, there.xyxy, old)
    kept = embedder(new, here)
    assert len(computed) == 1
    for mine, theirs in ((kept.foreground, own.foreground), (kept.background, own.background)):
        cosine = mine @ theirs.T
        assert cosine.diagonal().min() > 0.95 > cosine[0, 1]
    embedder(new, there)  # other detections: a map of its own again
    assert len(computed) == 2


def test_own_weights_say_how_they_were_trained() -> None:
    session = rt.onnx_session(rt.model_path("reobj"), 1)
    facts = json.loads(session.get_modelmeta().custom_metadata_map["reobj"])
    assert {"layout", "multiple", "head", "trained"} <= set(facts)
    assert {"steps", "seed", "minutes", "rooms"} <= set(facts["trained"])


@pytest.mark.parametrize("name", ["mobilenetv2", "crops:mobilenetv2"])
def test_heads_of_mobilenetv2_come_along(name: str) -> None:
    path = rt.trained_head(name, rt.EmbedConfig())
    assert path is not None and path.parent == rt.own_models()
    facts = rt._facts(rt.onnx_session(path, 1))
    assert facts["trained"]["rooms"] > 10 and {"layout", "trained"} <= set(facts)
    assert rt.trained_head(name, rt.EmbedConfig(head="none")) is None


# ---- Training ----


@pytest.fixture(scope="module")
def te() -> ModuleType:
    pytest.importorskip("torch", reason="needs pip install torch")
    return importlib.import_module("train_embedding")


@pytest.fixture(scope="module")
def th(te) -> ModuleType:
    return importlib.import_module("train_head")


@pytest.fixture(scope="module")
def trained(te, tmp_path_factory) -> Path:
    """Two steps on one small room, then two more from the checkpoint."""
    folder = tmp_path_factory.mktemp("train")
    command = ["-o", str(folder), "--rooms", "3:4", "--cache", str(folder / "rooms")]
    command += [
        "--frames",
        "6",
        "--val-rooms",
        "3",
        "--scenes",
        "2",
        "--views",
        "4",
        "--every",
        "1",
    ]
    command += ["--average", "0.5"]
    assert te.main([*command, "--steps", "2"]) == 0
    assert te.main([*command, "--steps", "3", "--resume"]) == 0
    return folder


def test_training_logs_resumes_and_draws_curves(trained) -> None:
    with (trained / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [1, 2, 3]
    assert all(np.isfinite(float(row["loss"])) for row in rows)
    assert cv2.imread(str(trained / "curves.png")) is not None


def test_exported_model_equals_the_trained_network(te, trained) -> None:
    """Pooling in numpy and the ONNX graphs give what the network gives in PyTorch."""
    import torch

    clip = te.room_clip(3, trained / "rooms")
    net = te.Net()
    state = torch.load(trained / "best.pt", weights_only=True)
    mean = {k[7:]: v for k, v in state["mean"].items() if k.startswith("module.")}
    assert any((mean[k] != v).any() for k, v in state["net"].items())
    net.load_state_dict(mean)
    net.eval()
    frame, rng = int(np.argmax([len(i) for i in clip.identity])), np.random.default_rng(0)
    view = te.make_view(clip, frame, rng, None, False, clip.identity[frame])
    with torch.no_grad():
        expected = net([view], "cpu")
    masks = clip.labels[frame][None] == (clip.identity[frame] + 1)[:, None, None]
    n = len(masks)
    detections = rt.Detections(clip.xyxy[frame], np.ones(n), np.zeros(n, np.int64), masks)
    found = rt.Embedder(str(trained / "reobj.onnx"), rt.EmbedConfig(neighbours=0), threads=1)(
        view.picture, detections
    )
    assert n == len(view.identity) >= 3
    for mine, theirs in zip((found.foreground, found.background), expected, strict=True):
        np.testing.assert_allclose(mine, theirs.numpy(), atol=2e-4)


def test_colour_channels_are_those_of_the_training_free_descriptor(te) -> None:
    import torch

    image, _ = scene_with_twins()
    image = cv2.GaussianBlur(image, (0, 0), 2)[:, :320]
    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].float()
    own = te.ColourMap()(planes)[0].numpy().transpose(1, 2, 0)  # (60, 80, 17)
    other = cv2.resize(rt._colour_features(image), (80, 60), interpolation=cv2.INTER_AREA)
    assert np.corrcoef(own[..., :11].ravel(), other[..., :11].ravel())[0, 1] > 0.98


@pytest.mark.parametrize(
    ("hard", "soft", "expected"), [(True, False, 0.9), (False, False, 0.5), (False, True, 0.9018)]
)
def test_triplet_loss_picks_the_negative(te, hard: bool, soft: bool, expected: float) -> None:
    """Anchor 0, positive 1 at cosine .6, negatives at .9 (hardest) and .5 (semi-hard); their soft
    maximum is .1 log(e^9 + e^5).
    """
    import torch

    cosines = (1.0, 0.6, 0.9, 0.5)
    rows = torch.tensor([[c, (1 - c * c) ** 0.5] for c in cosines])
    same, different = torch.zeros(4, 4, dtype=torch.bool), torch.zeros(4, 4, dtype=torch.bool)
    same[0, 1] = different[0, 2] = different[0, 3] = True
    loss = float(te.triplet_loss(rows, same, different, hard, soft))
    assert loss == pytest.approx(0.1 * np.log1p(np.exp((expected - 0.6) / 0.1)), abs=1e-4)


def test_windows_of_large_pictures_are_narrower(te) -> None:
    """Sizes differ by up to 1 : 3 where the picture holds the detail."""
    rng = np.random.default_rng(0)
    number = np.arange(1)
    widths = []
    for scale in (1, 2):
        image = np.zeros((240 * scale, 320 * scale, 3), np.uint8)
        box = np.array([[150.0, 110, 170, 130]]) * scale
        clip = te.Clip("x", [image], None, [box], [number], [number], True)
        found = [te.augmented(clip, 0, rng, lambda image: image, False, number) for _ in range(200)]
        boxes = np.concatenate([d.xyxy[rows] for _, d, rows in found])
        widths.append(boxes[:, 2] - boxes[:, 0])
    assert widths[0].max() < 45 < 55 < widths[1].max() and widths[1].min() < 24


def test_overlapping_pseudo_objects_are_dropped(te) -> None:
    center = np.array([[0.0, 0, 0], [0.1, 0, 0], [2.0, 0, 0], [5.0, 0, 0]])
    assert te.apart(center, np.array([1.0, 1.0, 1.0, 0.0])).tolist() == [0, 2]


def test_mot_tracks_become_a_clip(te, tmp_path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(2):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((480, 640, 3), 90 * i, np.uint8))
    (tmp_path / "tracks.txt").write_text(
        "1,7,100,100,200,200,.9,-1,-1,-1\n2,7,90,90,200,200,.9,-1,-1,-1\n"
    )
    clip = te.tracks_clip(tmp_path / "images", tmp_path / "tracks.txt")
    assert [i.tolist() for i in clip.identity] == [[0], [0]] and clip.labels is None
    np.testing.assert_allclose(clip.xyxy[0], [[100, 100, 300, 300]])  # 640 px on the longer side


def test_tracks_take_the_masks_of_the_detections(te, tmp_path) -> None:
    """Of those beside tracks.txt and of the cache of `run`; by box, whatever their order."""
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.zeros((240, 320, 3), np.uint8))
    rows = ["1,7,100,100,80,100,.9,-1,-1,-1", "1,9,10,10,40,40,.9,-1,-1,-1"]
    (tmp_path / "tracks.txt").write_text("\n".join(rows))
    masks = np.zeros((3, 240, 320), bool)
    masks[0, 10:50, 10:50] = masks[1, 150:200, 100:180] = masks[2, 210:, 200:] = True
    found = boxes((10, 10, 50, 50), (100, 100, 180, 200), (200, 210, 320, 240), masks=masks)
    rt.write_detections_npz(tmp_path / "cache/d/chunk_000000.npz", [(0, found)], [], (320, 240))
    clip = te.tracks_clip(tmp_path / "images", tmp_path / "tracks.txt")
    expected = masks[1] * 1 + masks[0] * 2
    np.testing.assert_array_equal(clip.labels[0], expected)
    np.testing.assert_array_equal(np.sort(clip.identity[0]), [0, 1])


def test_scannet_folders_become_a_clip(te, tmp_path) -> None:
    for name in ("color", "instance-filt"):
        (tmp_path / name).mkdir()
    label = np.zeros((240, 320), np.uint8)
    label[20:120, 30:100], label[50:200, 150:250] = 3, 5  # objects 2 and 4
    for i in range(2):
        cv2.imwrite(str(tmp_path / "color" / f"{i}.jpg"), np.full((480, 640, 3), 90, np.uint8))
        cv2.imwrite(str(tmp_path / "instance-filt" / f"{i}.png"), label)
    groups = [{"objectId": 2, "label": "chair"}, {"objectId": 4, "label": "chair"}]
    (tmp_path / "x.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    clip = te.scannet_clip(tmp_path)
    assert len(clip.images) == 2 and clip.images[0].shape == (480, 640, 3)
    np.testing.assert_allclose(clip.xyxy[1][0], [60, 40, 200, 240])
    assert len(set(clip.identity[0].tolist())) == 2 and len(set(clip.look[0].tolist())) == 1
    for box, identity in zip(clip.xyxy[0].astype(int), clip.identity[0], strict=True):
        inner = clip.labels[0][box[1] + 2 : box[3] - 2, box[0] + 2 : box[2] - 2]
        assert (inner == identity + 1).all()


@pytest.mark.parametrize("crops", [False, True])
def test_head_of_a_frozen_backbone_is_found_beside_it(th, trained, tmp_path, crops: bool) -> None:
    """A step of training; the exported head gives through the tool what it gives in PyTorch."""
    backbone(tmp_path / "net.onnx", tmp_path / "block.onnx", channels=8)
    command = ["-o", str(tmp_path), "--backbone", str(tmp_path / "net.onnx"), "--rooms", "3"]
    command += ["--cache", str(trained / "rooms"), "--val-rooms", "3", "--frames", "6"]
    assert th.main([*command, *["--crops"] * crops, "--steps", "2", "--every", "1"]) == 0
    out = tmp_path / "concat" if crops else tmp_path
    name = "crops_net_head.onnx" if crops else "net_head.onnx"
    assert cv2.imread(str(out / "curves.png")) is not None
    (out / name).replace(tmp_path / name)
    image, detections = scene_with_twins()
    kind = rt.CropEmbedder if crops else rt.Embedder
    alone = rt.EmbedConfig(neighbours=0)
    look = kind(str(tmp_path / "net.onnx"), alone, threads=1)(image, detections)
    plain = rt.EmbedConfig(head="none")
    frozen = kind(str(tmp_path / "net.onnx"), plain, threads=1)(image, detections)
    assert look.foreground.shape != frozen.foreground.shape  # "none": no training
    assert look.background.shape == ((2, 0) if crops else (2, 128))
    np.testing.assert_allclose(np.linalg.norm(look.foreground, axis=1), 1, atol=1e-3)
    args = th.build_parser().parse_args([*command, *["--crops"] * crops])
    see = th.Frozen(args).see(image, detections, np.arange(2))
    assert_same_as_in_torch(th, args, see, out / "best.pt", look)


def test_fine_rooms_have_pictures_and_a_cache_of_their_own(th, te, tmp_path) -> None:
    for name in ("fine_7.npz", "room_8.npz"):
        (tmp_path / name).touch()
    command = ["-o", "x", "--backbone", "x", "--cache", str(tmp_path), "--no-render"]
    args = th.build_parser().parse_args([*command, "--rooms", "7:9", "--fine-rooms", "7:9"])
    assert [name for name, _ in th.sources(args)] == ["room 8", "fine 7"]
    small, fine = te.room_config(7), te.room_config(7, fine=True)
    assert fine.width == 2 * small.width and fine.hfov_deg == small.hfov_deg


def assert_same_as_in_torch(th, args, see, checkpoint: Path, look: rt.Embeddings) -> None:
    import torch

    names = ["fg", "bg"]
    trainer = th.HeadTrainer(args, th.Frozen(args), names)
    trainer.net.load_state_dict(torch.load(checkpoint, weights_only=True)["net"])
    trainer.net.eval()
    seen = th.Seen(see, np.arange(2), np.arange(2), np.zeros(2))
    with torch.no_grad():
        expected = [part.numpy() for part in trainer.embed(trainer.net, [seen])]
    if args.crops:  # one row of both
        expected = [np.concatenate(expected, 1) / 2**0.5]
    for mine, theirs in zip((look.foreground, look.background), expected, strict=False):
        np.testing.assert_allclose(mine, theirs, atol=5e-3)  # weights kept as float16


@pytest.mark.parametrize("command", [["-o", "x"], ["-o", "x", "--sparse", "no=where"]])
def test_bad_input_is_refused(te, command: list[str], tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        te.main(command)
