"""benchmarks/reobj_folds.py: the published map, the folds, and a run on a small recording."""

from __future__ import annotations

import csv
import importlib
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from test_embedding import mean_backbone, save_onnx

import reobj_track as rt


@pytest.fixture(scope="module")
def folds() -> ModuleType:
    pytest.importorskip("torch", reason="needs pip install torch")
    return importlib.import_module("reobj_folds")


def network(path: Path, stride: int, *channels: int) -> Path:
    """Convolutions of a stride, then of 1, ReLU after each; out: the last, and its mean."""
    nodes, weights, last, inner = [], {}, "image", 3
    for k, count in enumerate(channels):
        size = 1 if k else stride
        kernel = np.random.default_rng(k).normal(size=(count, inner, size, size)) / 50
        weights[f"w{k}"] = kernel
        nodes.append(("Conv", [last, f"w{k}"], [f"c{k}"], {"strides": [size, size]}))
        nodes.append(("Relu", [f"c{k}"], [f"r{k}"], {}))
        last, inner = f"r{k}", count
    nodes.append(("GlobalAveragePool", [last], ["mean"], {}))
    out = [(last, ["n", inner, "a", "b"]), ("mean", ["n", inner, 1, 1])]
    ends = ([("image", ["n", 3, "h", "v"])], out)
    return save_onnx(path, nodes, ends, weights)


@pytest.mark.parametrize(
    ("channels", "stride", "taken", "shape", "crop"),
    [  # as ResNet50 is: 512 channels inside its last block, 2048 behind it
        ((512, 512, 2048), 32, "tensor r1, as published", (512, 7, 7), 224),
        ((64, 512), 16, "tensor r1 (published: 7x7)", (512, 7, 7), 112),  # cut short
        ((64, 20), 32, "its own spatial output (published: 7x7x512)", (20, 7, 7), 224),
    ],
)
def test_the_published_map_or_the_closest_one(
    folds, tmp_path, channels, stride, taken, shape, crop
) -> None:
    path = network(tmp_path / "net.onnx", stride, *channels)
    embedder, text = folds.embedder_of(str(path), tmp_path / "out")
    assert text == f"net.onnx: {taken}; maps 7x7x{shape[0]} of crops of {crop} px"
    image = np.random.default_rng(0).integers(0, 255, (1, crop, crop, 3), np.uint8)
    maps = embedder.maps(image)
    assert maps.shape == (1, *shape) and maps.min() == 0  # behind the ReLU


@pytest.mark.parametrize(("side", "sizes"), [(7, [4, 2, 1]), (14, [7, 4, 2, 1]), (1, [1])])
def test_conv_block_pools_any_map_to_one_cell(folds, side: int, sizes: list[int]) -> None:
    """As published: convolution, batch norm and max-pooling; widths double; both maps in one."""
    import torch

    torch.manual_seed(1)  # of a map of one cell all outputs may be 0 behind the ReLU
    block = folds.ConvBlock(6, side, 4)
    seen, maps = [], torch.rand(2, 6, side, side)
    for stage in block.stages:
        maps = stage(maps)
        seen.append(tuple(maps.shape[1:]))
    assert seen == [(4 * 2**k, n, n) for k, n in enumerate(sizes)]
    names = [type(m).__name__ for m in block.stages[0].modules()]
    pool = "MaxPool2d" if side > 1 else "Identity"
    assert [n for n in names if n != "Sequential"] == ["Conv2d", "BatchNorm2d", "ReLU", pool]
    rows = block.eval()(torch.rand(2, 6, side, side))
    np.testing.assert_allclose(rows.detach().norm(dim=1), 1, atol=1e-5)
    assert folds.ConvBlock(1024, 7).stages[0][0][0].out_channels == 1024  # of the published maps


def recording(folder: Path) -> Path:
    """Six grey objects in front of six coloured walls, each seen in eight frames 40 apart."""
    (folder / "images").mkdir(parents=True)
    rng, lines = np.random.default_rng(0), []
    walls = np.array([[40, 40, 220], [220, 60, 40], [40, 200, 60],
                      [200, 200, 40], [200, 40, 200], [20, 200, 220]])  # fmt: skip
    for f in range(8):
        image = np.repeat(np.repeat(walls, 80, 0)[None], 160, 0).astype(float)  # (160, 480, 3)
        for k in range(6):
            x, y = 80 * k + 25 + rng.integers(-5, 6), 60 + rng.integers(-9, 10)
            image[y - 8 : y + 48, x - 8 : x + 38] = 128  # its box is of the middle
            lines.append(f"{f + 1},{k + 1},{x},{y},30,40,1,{56 + k % 2},1")
        image += rng.normal(0, 6, image.shape)
        cv2.imwrite(str(folder / "images" / f"{f:04d}.png"), image.clip(0, 255).astype(np.uint8))
    (folder / "gt_mot.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_objects_are_dealt_into_folds_class_by_class(folds, tmp_path) -> None:
    pairs = folds.pairs_of([folds.recording_scene(recording(tmp_path / "r"))])
    fold = folds.folds_of(pairs, 3)
    for name in (0, 1):
        assert set(fold[pairs.name == name]) == {0, 1, 2}  # three objects of each class
    assert all(len(set(fold[pairs.identity == k])) == 1 for k in np.unique(pairs.identity))


def test_four_setups_are_trained_equally_on_a_recording(folds, tmp_path, capsys) -> None:
    """Identical objects in front of different walls: the surroundings distinguish them."""
    mean_backbone(tmp_path / "net.onnx", channels=8)
    command = [str(recording(tmp_path / "r")), "-o", str(tmp_path / "out"), "--width", "4"]
    command += ["--backbone", str(tmp_path / "net.onnx"), "--every", "1", "--away", "0"]
    command += ["--repeats", "2"]
    assert folds.main([*command, "--steps", "3"]) == 2
    assert "r is not for reporting" in capsys.readouterr().err
    assert folds.main([*command, "--steps", "3", "--choosing"]) == 0
    with (tmp_path / "out" / "reobj_folds.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["setup"], r["trained"]) for r in rows] == [
        (s, t) for s in ("concat", "fg", "bg", "full") for t in ("no", "yes")
    ]
    assert all(int(r["queries"]) == 48 for r in rows)  # each view once, by a block of its fold
    first = {(r["setup"], r["trained"]): float(r["rank1"]) for r in rows}
    assert first["bg", "no"] > 95 > 60 > first["fg", "no"]
    assert all(float(r["rank20"]) >= float(r["rank1"]) for r in rows)
    assert "r (choosing): net.onnx: its own spatial output" in capsys.readouterr().out


def test_queries_are_objects_not_used_in_training(folds, tmp_path, monkeypatch) -> None:
    mean_backbone(tmp_path / "net.onnx", channels=8)
    scene = folds.recording_scene(recording(tmp_path / "r"))
    pairs, trained = folds.pairs_of([scene]), []
    fold = folds.folds_of(pairs, 3)

    def rows_of(maps, pairs, rows, args, seed):
        trained.append(set(pairs.identity[rows]))
        mark = np.eye(len(np.unique(pairs.identity)))[
            np.unique(pairs.identity, return_inverse=True)[1]
        ]
        return np.where(np.isin(np.arange(len(maps)), rows)[:, None], 0.0, mark)

    monkeypatch.setattr(folds, "trained_rows", rows_of)
    args = folds.build_parser().parse_args(["r", "-o", "x", "--away", "0", "--repeats", "1"])
    maps = dict.fromkeys(("fg", "bg", "full"), np.ones((48, 2, 7, 7), np.float32))
    found = folds.measure(scene, maps, args)
    for k in range(3):
        assert trained[k] == set(pairs.identity[fold != k])
    assert all(r["rank1"] == 100 for r in found if r["trained"] == "yes")  # held-out rows alone


def test_too_few_objects_for_the_folds(folds, tmp_path, capsys) -> None:
    folder = recording(tmp_path / "r")
    words = ["-o", str(tmp_path / "out"), "--folds", "4", "--choosing"]
    assert folds.main([str(folder), *words]) == 2
    assert "6 annotated objects; 8 or more are needed for 4 folds" in capsys.readouterr().err
    with pytest.raises(rt.ReobjError):
        folds.recording_scene(tmp_path / "none")
