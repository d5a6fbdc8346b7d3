"""Training of the embedding and of heads for frozen backbones (needs PyTorch)."""

from __future__ import annotations

import csv
import dataclasses
import importlib
import json
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from test_embedding import boxes, mean_backbone, scene_with_identical_objects

import reobj_track as rt
from reobj.appearance.embedding import trained_head
from reobj.sources.weights import onnx_metadata, onnx_session


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
    command += ["--frames", "6", "--val-rooms", "3", "--scenes", "2", "--views", "4"]
    command += ["--every", "1", "--average", "0.5"]
    plain = te.room_config

    def coarse(*args, **options):  # quickly rendered
        return dataclasses.replace(plain(*args, **options), texels_per_m=60.0, light_rays=1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(te, "room_config", coarse)
        assert te.main([*command, "--steps", "2"]) == 0
        assert te.main([*command, "--steps", "3", "--resume"]) == 0
    return folder


def test_training_logs_resumes_and_draws_curves(trained) -> None:
    with (trained / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [1, 2, 3]
    assert all(np.isfinite(float(row["loss"])) for row in rows)
    assert cv2.imread(str(trained / "curves.png")) is not None


def test_exported_models_state_their_layout_with_current_names(te, trained) -> None:
    facts = onnx_metadata(onnx_session(trained / "reobj.onnx", 1))
    assert set(facts["layout"]) <= set(rt.SamplingLayout.__dataclass_fields__)
    assert {"min_margin", "surround_scale", "surround_cells"} <= set(facts["layout"])
    assert rt.Embedder(str(trained / "reobj.onnx"), threads=1).layout == te.layout()


def test_exported_model_equals_the_trained_network(te, trained) -> None:
    """Pooling in numpy and the ONNX graphs give the outputs of the PyTorch network."""
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
    alone = rt.SamplingLayout(neighbours=0)
    embedder = rt.Embedder(str(trained / "reobj.onnx"), layout=alone, threads=1)
    found = embedder(view.picture, detections)
    assert n == len(view.identity) >= 3
    for mine, theirs in zip((found.foreground, found.background), expected, strict=True):
        np.testing.assert_allclose(mine, theirs.numpy(), atol=2e-4)


def colours(image: np.ndarray) -> np.ndarray:
    """Soft histogram of OpenCV's Lab colours (h, w, 11): six directions of chroma, five levels."""
    lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_BGR2Lab)
    levels = (1 - np.abs(lab[..., :1] / 25 - np.arange(5))).clip(0) * 0.5
    chroma, turn = lab[..., 1:] / 40, np.arange(6) * np.pi / 3
    length = np.linalg.norm(chroma, axis=-1, keepdims=True)
    aligned = (chroma / (length + 1e-6)) @ np.stack([np.cos(turn), np.sin(turn)])
    directions = aligned.clip(0) ** 4 * np.minimum(length, 1)
    both = np.concatenate([directions, levels], -1).astype(np.float32)
    return np.asarray(cv2.blur(both, (5, 5)))


def test_colour_channels_are_a_soft_histogram_of_lab(te) -> None:
    import torch

    image, _ = scene_with_identical_objects()
    image = cv2.GaussianBlur(image, (0, 0), 2)[:, :320]
    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].float()
    own = te.ColourMap()(planes)[0].numpy().transpose(1, 2, 0)  # (60, 80, 17)
    other = cv2.resize(colours(image), (80, 60), interpolation=cv2.INTER_AREA)
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


@pytest.mark.parametrize(
    ("kind", "late", "expected"),
    [
        ("hardest", False, 0.8),  # of another scene
        ("hardest", True, 0.7),  # of the same scene
        ("triplet", False, 0.5),  # semi-hard: the nearest of those further than the positive
        ("triplet", True, 0.7),
    ],
)
def test_the_hardest_negative_is_the_nearest_of_the_batch(
    te, kind: str, late: bool, expected: float
) -> None:
    """Two rows of one object at cosine .6; to both, others are at .8 (another scene), .7 and .5."""
    import torch

    rows = np.zeros((5, 5))
    rows[:2, 0], rows[0, 1], rows[1, 1] = 0.8**0.5, 0.2**0.5, -(0.2**0.5)
    for k, cosine in ((2, 0.8), (3, 0.7), (4, 0.5)):  # (5, 5) each with an axis of its own
        rows[k, 0] = cosine / 0.8**0.5
        rows[k, k] = (1 - rows[k, 0] ** 2) ** 0.5
    of = (np.array([0, 0, 1, 0, 0]), np.array([1, 1, 1, 2, 3]), np.arange(5))
    loss = float(te.parts_loss([torch.tensor(rows)], of, late, kind))
    assert loss == pytest.approx(0.1 * np.log1p(np.exp((expected - 0.6) / 0.1)), abs=1e-6)


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


@pytest.mark.parametrize("merge", ["", "maps", "rows"])  # "": not of crops
def test_head_of_a_frozen_backbone_is_found_beside_it(th, trained, tmp_path, merge: str) -> None:
    """A step of training; the exported head gives the same output in the tool as in PyTorch."""
    crops = bool(merge)
    options = ["--crops", "--merge", merge, "--width", "8"] if crops else []
    mean_backbone(tmp_path / "net.onnx", channels=8)
    command = ["-o", str(tmp_path), "--backbone", str(tmp_path / "net.onnx"), "--rooms", "3"]
    command += ["--cache", str(trained / "rooms"), "--val-rooms", "3", "--frames", "6"]
    assert th.main([*command, *options, "--steps", "2", "--every", "1"]) == 0
    out = tmp_path / "concat" if crops else tmp_path
    name = "crops_net_head.onnx" if crops else "net_head.onnx"
    assert cv2.imread(str(out / "curves.png")) is not None
    (out / name).replace(tmp_path / name)
    image, detections = scene_with_identical_objects()
    kind = rt.CropEmbedder if crops else rt.Embedder
    net, alone = str(tmp_path / "net.onnx"), rt.SamplingLayout(neighbours=0)
    assert trained_head(f"crops:{net}" if crops else net) == tmp_path / name
    look = kind(net, layout=alone, threads=1)(image, detections)
    frozen = kind(net, "none", threads=1)(image, detections)
    assert look.foreground.shape != frozen.foreground.shape  # "none": no training
    assert look.background.shape == ((2, 0) if crops else (2, 128))
    np.testing.assert_allclose(np.linalg.norm(look.foreground, axis=1), 1, atol=1e-3)
    args = th.build_parser().parse_args([*command, *options])
    see = th.Frozen(args).see(image, detections, np.arange(2))
    assert_same_as_in_torch(th, args, see, out / "best.pt", look)


def test_fine_rooms_have_separate_images_and_cache(th, te, tmp_path) -> None:
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
        expected = [np.concatenate(expected, 1) / len(expected) ** 0.5]
    for mine, theirs in zip((look.foreground, look.background), expected, strict=False):
        np.testing.assert_allclose(mine, theirs, atol=5e-3)  # weights kept as float16


@pytest.mark.parametrize("command", [["-o", "x"], ["-o", "x", "--sparse", "no=where"]])
def test_bad_input_is_refused(te, command: list[str], tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        te.main(command)
