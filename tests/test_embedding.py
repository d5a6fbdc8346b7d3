"""Embeddings from one feature map per frame: tiny networks and the bundled weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt
from reobj.appearance.embedding import (
    LazyEmbeddings,
    as_embeddings,
    neighbour_embedding,
    trained_head,
)

# of ImageNet's pixels, RGB (torchvision's documentation)
IMAGENET_MEAN = 255 * np.array([0.485, 0.456, 0.406])
IMAGENET_STD = 255 * np.array([0.229, 0.224, 0.225])
BACKBONE_FILES = Path(__file__).resolve().parents[2] / "shared" / "models"


def boxes(*xyxy: tuple[float, ...], masks: np.ndarray | None = None) -> rt.Detections:
    n = len(xyxy)
    return rt.Detections(np.array(xyxy, float), np.full(n, 0.9), np.zeros(n, np.int64), masks)


def scene_with_identical_objects() -> tuple[np.ndarray, rt.Detections]:
    """Two identical patches on different backgrounds."""
    rng = np.random.default_rng(13)
    image = cv2.GaussianBlur(rng.integers(0, 256, (240, 480, 3), dtype=np.uint8), (0, 0), 8)
    image[:, :240] = (0.5 * image[:, :240] + [100, 20, 20]).clip(0, 255).astype(np.uint8)
    image[:, 240:] = (0.5 * image[:, 240:] + [20, 20, 100]).clip(0, 255).astype(np.uint8)
    patch = cv2.GaussianBlur(rng.integers(0, 256, (60, 60, 3), dtype=np.uint8), (0, 0), 3)
    image[90:150, 90:150] = image[90:150, 330:390] = patch
    return image, boxes((90, 90, 150, 150), (330, 90, 390, 150))


def save_onnx(
    path: Path, nodes: list, ends: tuple, weights: dict[str, np.ndarray], **facts
) -> Path:
    """Write a graph; ends: name and shape of inputs, then of outputs."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    inputs, outputs = (
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in some] for some in ends
    )
    start = [onnx.numpy_helper.from_array(w.astype(np.float32), n) for n, w in weights.items()]
    made = [helper.make_node(op, a, b, **how) for op, a, b, how in nodes]
    graph = helper.make_graph(made, "g", inputs, outputs, start)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    if facts:
        helper.set_model_props(model, {"reobj": json.dumps(facts)})
    onnx.save(model, path)
    return path


def mean_backbone(path: Path, channels: int = 4, stride: int = 32) -> Path:
    """A backbone: the mean of its three input channels (then zeros) in squares of `stride`."""
    weight = np.zeros((channels, 3, stride, stride))
    weight[:3] = np.eye(3)[:, :, None, None] / stride**2
    nodes = [("Conv", ["image", "w"], ["map"], {"strides": [stride, stride]})]
    ends = ([("image", ["n", 3, "h", "v"])], [("map", ["n", channels, "a", "b"])])
    return save_onnx(path, nodes, ends, {"w": weight})


def sum_head(path: Path, **facts) -> Path:
    """A head with two outputs per part: weighted sums (1, 2 and 1, 3) of all values of the cells
    (cells * (C + 2) of 4 channels); not normalised.
    """
    nodes, weights = [], {}
    for name, out, cells, second in (("fg", "foreground", 4, 2), ("bg", "background", 16, 3)):
        weights[f"w{name}"] = np.ones((cells * 6, 2)) * [1, second]
        nodes.append(("MatMul", [name, f"w{name}"], [out], {}))
    ends = (
        [("fg", ["n", 24]), ("bg", ["m", 96])],
        [("foreground", ["n", 2]), ("background", ["m", 2])],
    )
    return save_onnx(path, nodes, ends, weights, **facts)


@pytest.fixture
def net(tmp_path: Path) -> str:
    return str(mean_backbone(tmp_path / "net.onnx"))


# ---- Backbones ----


def test_a_foreign_backbone_gets_rgb_normalised_as_imagenet(net: str) -> None:
    """The first channel is red; mean and deviation are those of red."""
    image = np.zeros((1, 64, 96, 3), np.uint8)
    image[..., :48, :] = (10, 20, 250)  # BGR
    maps = rt.Embedder(net, threads=1).backbone.maps(image)
    assert maps.shape == (1, 2, 3, 4)
    expected = (np.array([250, 20, 10]) - IMAGENET_MEAN) / IMAGENET_STD
    np.testing.assert_allclose(maps[0, :, 0, :3], np.tile(expected, (2, 1)), rtol=1e-4)
    black = -IMAGENET_MEAN / IMAGENET_STD
    np.testing.assert_allclose(
        maps[0, :, 1, :3], np.tile((expected + black) / 2, (2, 1)), rtol=1e-4
    )


def test_a_model_without_a_map_is_refused(tmp_path: Path) -> None:
    nodes = [("GlobalAveragePool", ["image"], ["p"], {}), ("Flatten", ["p"], ["row"], {})]
    ends = ([("image", ["n", 3, "h", "v"])], [("row", ["n", 3])])
    path = save_onnx(tmp_path / "flat.onnx", nodes, ends, {})
    with pytest.raises(rt.ReobjError, match="spatial output"):
        rt.Embedder(str(path))


def test_real_backbones_are_found_by_their_file_names(monkeypatch: pytest.MonkeyPatch) -> None:
    if not BACKBONE_FILES.is_dir():
        pytest.skip("no frozen backbones here")
    monkeypatch.setenv("REOBJ_MODELS", str(BACKBONE_FILES))
    image, found = scene_with_identical_objects()
    for name, widths in (("mobilenetv2_feat", (128, 256)), ("squeezenet1.1", None)):
        embedder = rt.Embedder(name, threads=1, offline=True)
        assert embedder.trained == (widths is not None)
        look = embedder(image, found)
        again = embedder((0.95 * image).astype(np.uint8), found)
        assert (look.foreground * again.foreground).sum(1).min() > 0.9
        assert (look.background * again.background).sum(1).min() > 0.9
        assert widths is None or (look.foreground.shape[1], look.background.shape[1]) == widths


# ---- Heads ----


def test_a_head_is_found_beside_its_backbone_or_given(net: str, tmp_path: Path) -> None:
    assert trained_head(net) is None and not rt.Embedder(net, threads=1).trained
    other = sum_head(tmp_path / "other.onnx", layout={"neighbours": 0.0})
    assert trained_head(net, str(other)) == other
    with pytest.raises(rt.ReobjError, match="nowhere"):
        trained_head(net, str(tmp_path / "nowhere.onnx"))
    beside = sum_head(tmp_path / "net_head.onnx", layout={"size_px": 64, "neighbours": 0.0})
    assert trained_head(net) == beside
    found = rt.Embedder(net, threads=1)
    assert found.trained and found.layout == rt.SamplingLayout(size_px=64, neighbours=0.0)
    assert not rt.Embedder(net, "none", threads=1).trained
    assert rt.Embedder(net, str(other), threads=1).layout.size_px == 480


# ---- Embedder ----


def test_foreground_shows_the_object_and_background_the_rest(net: str) -> None:
    """A red object on blue; without a head, rows are the signed square roots of the cells."""
    image = np.full((512, 512, 3), (250, 0, 0), np.uint8)
    image[128:384, 128:384] = (0, 0, 250)
    mask = np.zeros((1, 512, 512), bool)
    mask[0, 128:384, 128:384] = True
    embedder = rt.Embedder(net, layout=rt.SamplingLayout(size_px=512), threads=1)
    found = boxes((128, 128, 384, 384), masks=mask)
    fore, back = embedder.cells(image, found, np.arange(1))
    red, blue = (np.array(rgb) - IMAGENET_MEAN for rgb in ((250, 0, 0), (0, 0, 250)))
    np.testing.assert_allclose(fore[0, :, :3], np.tile(red / IMAGENET_STD, (4, 1)), rtol=1e-4)
    np.testing.assert_allclose(fore[0, :, 4], 1)
    outer = [0, 1, 2, 3, 4, 7, 8, 11, 12, 13, 14, 15]  # the middle cells are of the object
    np.testing.assert_allclose(back[0, outer, :3], np.tile(blue / IMAGENET_STD, (12, 1)), rtol=1e-4)
    np.testing.assert_allclose(back[0, [5, 6, 9, 10], 4], 0)
    look = embedder(image, found)
    roots = np.sign(fore[0, :, :4]) * np.sqrt(np.abs(fore[0, :, :4]))
    expected = roots.ravel() / np.linalg.norm(roots)
    np.testing.assert_allclose(look.foreground[0], expected, atol=1e-6)
    assert look.background.shape == (1, 64)


def test_a_mask_decides_what_is_foreground(net: str) -> None:
    """With a mask of the left half, changing the right half of the box has no effect."""
    image, plain = scene_with_identical_objects()
    masks = np.zeros((2, *image.shape[:2]), bool)
    masks[0, 90:150, 90:120] = masks[1, 90:150, 330:360] = True
    masked = boxes(*plain.xyxy, masks=masks)
    changed = image.copy()
    changed[95:145, 135:150] = 255  # in the box, outside the mask
    embedder = rt.Embedder("reobj", threads=1)
    before, after, other, whole = (
        embedder(picture, found).foreground[0]
        for picture, found in ((image, masked), (changed, masked), (changed, plain), (image, plain))
    )
    assert before @ after > 0.97 > other @ whole


@pytest.mark.parametrize("trained", [True, False])
def test_some_rows_are_embedded_as_all_rows(trained: bool, net: str) -> None:
    """In any order of requests."""
    model = "reobj" if trained else net
    image, detections = scene_with_identical_objects()
    whole = rt.Embedder(model, threads=1)(image, detections)
    later = rt.Embedder(model, threads=1)
    for rows in (np.array([1]), np.array([1, 0])):
        part = later(image, detections, rows)
        np.testing.assert_allclose(whole.foreground[rows], part.foreground, atol=1e-5)
        np.testing.assert_allclose(whole.background[rows], part.background, atol=1e-5)
    other = later(255 - image, detections, np.array([1]))  # another frame
    assert np.abs(other.foreground - whole.foreground[1:]).max() > 1e-3
    assert len(later(image, detections, np.zeros(0, np.int64)).background) == 0


def test_weak_detections_mask_no_background_and_are_no_neighbours() -> None:
    image, _ = scene_with_identical_objects()
    two = boxes((90, 90, 150, 150), (155, 90, 215, 150))
    weak = rt.Detections(two.xyxy, np.array([0.9, 0.29]), two.class_id)
    alone, with_weak, both = (
        rt.Embedder("reobj", threads=1)(image, found, np.array([0])).background
        for found in (two[:1], weak, two)
    )
    np.testing.assert_allclose(with_weak, alone, atol=1e-6)
    assert not alone[:, 128:].any() and both[:, 128:].any()
    assert np.abs(both[:, :128] / 0.8**0.5 - alone[:, :128]).max() > 0.01  # masked background


# ---- Neighbours ----


def test_neighbour_embedding_averages_near_confident_objects() -> None:
    """The nearer of two weighs more; unconfident ones and the object itself are excluded."""
    xyxy = np.array([(0, 0, 40, 40), (50, 0, 90, 40), (300, 0, 340, 40), (0, 0, 40, 40)], float)
    confident, look = np.array([True, True, True, False]), np.eye(4)
    around = neighbour_embedding(xyxy, look, confident, np.arange(4))
    weights = np.exp(-np.array([50, 300]) / 40)  # distances of the centres over the size
    np.testing.assert_allclose(around[0, 1:3], weights / np.linalg.norm(weights))
    np.testing.assert_allclose(np.linalg.norm(around, axis=1), 1)
    assert around[0, 1] > 0.99 > around[2, 1] > around[2, 0] > 0 and not around[:, 3].any()
    assert not around.diagonal().any() and around[3, 0] > around[3, 1]  # not confident
    some = neighbour_embedding(xyxy, look, confident, np.array([2, 3]))
    np.testing.assert_allclose(around[2:], some)


# ---- The bundled weights ----


def test_bundled_weights_reidentify_identical_objects() -> None:
    image, detections = scene_with_identical_objects()
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


# ---- Embeddings on request ----


def test_cosines_of_fused_rows_are_weighted_means() -> None:
    rng = np.random.default_rng(2)
    given = rt.Embeddings(rng.normal(size=(4, 6)), rng.normal(size=(4, 3)))
    lazy = LazyEmbeddings(given, None, None, boxes(*[(0, 0, 9, 9)] * 4), 0.7)
    assert lazy.available and lazy.rows is None and not lazy.done.any()
    some = lazy.get(np.array([2, 0]))
    assert lazy.done.tolist() == [True, False, True, False] and lazy.foreground_width == 6
    assert lazy.rows is not None and not lazy.rows[1].any()
    np.testing.assert_array_equal(lazy.rows[[2, 0]], some)
    rows = lazy.get(np.arange(4))
    cosine = [
        a / np.linalg.norm(a, axis=1, keepdims=True) for a in (given.foreground, given.background)
    ]
    fore, back = (a @ a.T for a in cosine)
    np.testing.assert_allclose(rows @ rows.T, 0.7 * fore + 0.3 * back, atol=1e-6)
    assert rows.dtype == np.float32


@pytest.mark.parametrize(
    ("given", "width", "message"),
    [
        (rt.Embeddings(np.ones((3, 4)), np.ones((3, 1))), 0, r"\(3, 4\), expected \(2, E\)"),
        (np.ones(8), 0, r"\(8,\), expected \(2, E\)"),  # not two rows of four
        (np.ones((2, 4)), 5, "width 4, expected 5, as in earlier frames"),
        (np.array([[1, np.nan], [0, 1]]), 0, "not finite"),
        (np.array([[1, 1e39], [0, 1]]), 0, "not finite as float32"),
        ([["a"], ["b"]], 0, "no array of numbers"),
    ],
)
def test_invalid_embeddings_are_refused(given: Any, width: int, message: str) -> None:
    with pytest.raises(rt.ReobjError, match=message):
        as_embeddings(given, 2, width)
