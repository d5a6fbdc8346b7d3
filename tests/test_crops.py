"""re-OBJ's two masked crops of every object, and the factory of embedders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_embedding import (
    IMAGENET_MEAN,
    boxes,
    mean_backbone,
    save_onnx,
    sum_head,
)

import reobj_track as rt
from reobj.appearance.crops import make_embedder

GREY = IMAGENET_MEAN[::-1].round()  # BGR


def conv_block(path: Path, channels: int = 4, side: int = 7, **facts) -> Path:
    """A ConvBlock: the mean of both stacked maps."""
    nodes = [("GlobalAveragePool", ["maps"], ["row"], {})]
    ends = (
        [("maps", ["n", 2 * channels, side, side])],
        [("row", ["n", 2 * channels, 1, 1])],
    )
    return save_onnx(path, nodes, ends, {}, **facts)


@pytest.fixture
def net(tmp_path: Path) -> str:
    return str(mean_backbone(tmp_path / "net.onnx"))


def red_on_green() -> tuple[np.ndarray, rt.Detections]:
    """A red box, 40 x 40, on green, with its mask."""
    image = np.full((120, 160, 3), (0, 200, 0), np.uint8)
    image[40:80, 60:100] = (0, 0, 200)
    mask = np.zeros((1, 120, 160), bool)
    mask[0, 40:80, 60:100] = True
    return image, boxes((60, 40, 100, 80), masks=mask)


# ---- The factory ----


def test_the_configured_embedder_is_built(net: str, tmp_path: Path) -> None:
    assert make_embedder("none") is None
    assert type(make_embedder("reobj", threads=1)) is rt.Embedder
    frame, crops = make_embedder(net, threads=1), make_embedder(f"crops:{net}", threads=1)
    assert type(frame) is rt.Embedder and frame.model == net and not frame.trained
    assert type(crops) is rt.CropEmbedder and crops.model == f"crops:{net}"
    assert crops.conv_block is None
    config = rt.EmbedConfig(model=f"crops:{net}", head=str(conv_block(tmp_path / "b.onnx")))
    made = make_embedder(config.model, config.head, threads=1)
    assert isinstance(made, rt.CropEmbedder) and made.conv_block is not None
    head = str(sum_head(tmp_path / "h.onnx", layout={}))
    with_head = make_embedder(net, head, threads=1)
    assert with_head is not None and with_head.trained
    with pytest.raises(rt.ReobjError, match="crops:reobj: is a model of whole frames"):
        make_embedder("crops:reobj", threads=1)


# ---- Crops ----


def test_crops_contain_object_or_surroundings(net: str) -> None:
    image, found = red_on_green()
    crops = rt.CropEmbedder(net, threads=1)
    pixels, own = crops.cut(image, found, np.arange(1))
    assert pixels.shape == (1, 224, 224, 3)
    assert own.mean() == pytest.approx(0.25, abs=0.01)  # grown by half on every side
    assert (pixels[own] == (0, 0, 200)).mean() > 0.97
    (fore,), (back,) = np.split(crops.masked(pixels, own).astype(int), 2)  # (S, S, 3) each
    assert (fore[:20, :20] == GREY).all() and (back[102:122, 102:122] == GREY).all()
    np.testing.assert_allclose(fore + back, pixels[0] + GREY, atol=2)  # also along the soft edge
    assert (fore[102:122, 102:122] == (0, 0, 200)).all() and (back[:20, :20] == (0, 200, 0)).all()
    plain = crops.masked(np.full_like(pixels, 220), own).astype(int)
    assert 0 < np.abs(np.diff(plain, axis=2)).max() < 8  # of 100 grey values: no hard edge


@pytest.mark.parametrize(
    ("layout", "side"),
    [
        (rt.SamplingLayout(context=1.0), 3 * 40),
        (rt.SamplingLayout(context=0.1, min_margin=0.25), 40 + 2 * 40),  # a quarter of 160
        (rt.SamplingLayout(context=0.0), 40 + 2 * 1),  # at least a pixel
    ],
)
def test_the_window_is_the_largest_box_of_the_layout(net: str, layout, side: int) -> None:
    """The object fraction of the layout determines the size of the window."""
    image, found = red_on_green()
    _, own = rt.CropEmbedder(net, layout=layout, threads=1).cut(image, found, np.arange(1))
    assert own.mean() == pytest.approx((40 / side) ** 2, rel=0.03)


def test_crops_beyond_the_frame_are_black_there(net: str) -> None:
    image = np.full((120, 160, 3), 200, np.uint8)
    found = boxes((-20, 20, 20, 60), (150, 100, 170, 130))
    (left, corner), _ = rt.CropEmbedder(net, threads=1).cut(image, found, np.arange(2))
    assert not left[:, :110].any() and (left[:, 114:] == 200).all()  # 40 of 80 columns
    assert not corner[:, 113:].any() and (corner[:80, :80] == 200).all()


def test_embeddings_of_both_crops_separate_or_joined(net: str, tmp_path: Path) -> None:
    """Foreground red, background green; the ConvBlock gets the foreground's channels first."""
    image, found = red_on_green()
    crops = rt.CropEmbedder(net, threads=1)
    look = crops(image, found)
    assert look.foreground.shape == look.background.shape == (1, 4 * 49)
    fore, back = (part.reshape(4, 7, 7) for part in (look.foreground[0], look.background[0]))
    assert fore[0, 3, 3] > 0 > fore[1, 3, 3] and back[1, 0, 0] > 0 > back[0, 0, 0]
    maps = crops.maps(crops.masked(*crops.cut(image, found, np.arange(1))))  # (2, 4, 7, 7)
    roots = np.sign(maps[0]) * np.sqrt(np.abs(maps[0]))
    np.testing.assert_allclose(fore, roots / np.linalg.norm(roots), atol=1e-5)
    block = conv_block(tmp_path / "block.onnx")
    joint = rt.CropEmbedder(net, str(block), threads=1)(image, found)
    assert joint.background.shape == (1, 0)
    expected = np.concatenate(maps.mean((2, 3)))
    np.testing.assert_allclose(joint.foreground[0], expected / np.linalg.norm(expected), atol=1e-5)


def test_a_conv_block_defines_the_layout_and_must_match(net: str, tmp_path: Path) -> None:
    image, found = red_on_green()
    conv_block(tmp_path / "crops_net_head.onnx", side=3, layout={"crop_px": 96, "reach": 0.1})
    beside = rt.CropEmbedder(net, threads=1)
    assert (beside.layout.crop_px, beside.layout.min_margin) == (96, 0.1)
    assert beside(image, found).foreground.shape == (1, 8)
    assert rt.CropEmbedder(net, "none", threads=1).conv_block is None
    wrong = rt.CropEmbedder(net, str(conv_block(tmp_path / "wrong.onnx", channels=5)), threads=1)
    with pytest.raises(rt.ReobjError, match="ConvBlock trained with this backbone"):
        wrong(image, found)
    row = str(sum_head(tmp_path / "rows.onnx"))
    with pytest.raises(rt.ReobjError, match="ConvBlock trained with this backbone"):
        rt.CropEmbedder(net, row, threads=1)(image, found)
