"""Detectors: every ONNX layout on graphs made here, the cache, and sources of detections."""

from __future__ import annotations

import dataclasses
import os
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from small_models import write_model

import reobj_track as rt
from reobj.sources.detectors import (
    DetectionCache,
    DetectionSource,
    as_source,
    open_detections,
    with_detector,
)
from reobj.types import Image, box_iou

SHARED = Path(os.environ.get("REOBJ_SHARED", Path(__file__).resolve().parents[2] / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "models").is_dir(), reason="no weights: set REOBJ_SHARED"
)

# ---- Layouts -------------------------------------------------------------------------------------

model = partial(write_model, names="{0: 'cup', 1: 'bowl', 2: 'tv'}")
IMAGE = np.zeros((160, 320, 3), np.uint8)  # (H, W, 3)
BOX = [80.0, 40.0, 160.0, 120.0]  # what every model below detects in it
# The same in a 64 x 64 input.
STRETCHED, CORNER, CENTRE = [16, 16, 32, 48], [16, 8, 32, 24], [16, 24, 32, 40]
LABEL, SCORE = 2, 0.75


def center(box: list[int]) -> list[float]:
    x1, y1, x2, y2 = box
    return [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1]


def bins(distance: float) -> np.ndarray[Any, Any]:
    """Logits of 8 bins whose expectation is the distance."""
    logits = np.full(8, -50.0)
    low = int(distance)
    logits[low], logits[low + 1] = np.log(1 - distance + low), np.log(max(distance - low, 1e-20))
    return logits


def gfl(cell: float, row: float, box: list[int]) -> np.ndarray[Any, Any]:
    """Distances to the sides in units of stride 8, for a cell at (cell, row) strides."""
    x1, y1, x2, y2 = np.divide(box, 8)
    return np.concatenate([bins(d) for d in (cell - x1, row - y1, x2 - cell, y2 - row)])


def yolox(raw: bool) -> dict[str, Any]:
    rows = np.tile([0.3, 0.4, 0.1, 0.2, 0.01, 0, 0, 0], (1, 84, 1))
    cx, cy, w, h = center(CORNER)
    if raw:  # cell (3, 2) of stride 8
        rows[0, 2 * 8 + 3] = [cx / 8 - 3, cy / 8 - 2, np.log(w / 8), np.log(h / 8), 0.75, 0, 0, 1]
    else:
        rows[..., :2] = 32
        rows[0, 7] = [cx, cy, w, h, 1, 0.1, 0, 0.75]
    return {"output": rows}


def yolov8() -> dict[str, Any]:
    rows = np.zeros((1, 7, 84))
    rows[0, :, 50] = [*center(CENTRE), 0, 0.2, 0.75]
    return {"output0": rows}


def yolo_seg() -> dict[str, Any]:
    rows, proto = np.zeros((1, 7 + 32, 84)), np.zeros((1, 32, 16, 16))
    rows[0, :, 50] = [*center(CENTRE), 0, 0.2, 0.75, 0, 1, *[0] * 30]
    proto[0, 1] = np.where(np.arange(16) < 6, 1, -1)  # left half of the box, up to input x = 24
    return {"output0": rows, "output1": proto}


def nanodet() -> dict[str, Any]:
    rows = np.zeros((1, 85, 3 + 32))
    rows[0, 4 * 8 + 3] = [0, 0, 0.75, *gfl(3, 4, STRETCHED)]  # measured from the cell's corner
    return {"output": rows}


def picodet() -> dict[str, Any]:
    counts = (64, 16, 4, 1)
    scores, sides = [np.zeros((1, n, 3)) for n in counts], [np.zeros((1, n, 32)) for n in counts]
    scores[0][0, 3 * 8 + 2], sides[0][0, 3 * 8 + 2] = [0, 0, 0.75], gfl(2.5, 3.5, STRETCHED)
    return {f"o{i}": value for i, value in enumerate(scores + sides)}


def detr() -> dict[str, Any]:
    return {"labels": np.array([[LABEL, 1]]), "boxes": [[BOX, BOX]], "scores": [[SCORE, 0.01]]}


def ssd() -> dict[str, Any]:
    """ONNX' model zoo: boxes are fractions, label 0 is the background."""
    boxes = np.divide([[STRETCHED, STRETCHED]], 64)
    return {"bboxes": boxes, "labels": np.array([[LABEL + 1, 0]]), "scores": [[SCORE, 0.9]]}


def mask_rcnn() -> dict[str, Any]:
    """ONNX' model zoo: 28 x 28 probabilities of each box; its left half is the object."""
    maps = np.zeros((2, 1, 28, 28))
    maps[..., :14] = 1
    return {"6568": [CORNER, CORNER], "6570": np.array([LABEL + 1, 0]), "6572": [SCORE, 0.9],
            "6887": maps}  # fmt: skip


def yolov5(boxes: int, name: str) -> dict[str, Any]:
    """Rows in px with an objectness, for one or three boxes a cell."""
    rows = np.tile([32.0, 32, 1, 1, 0.01, 0, 0, 0], (1, 84 * boxes, 1))
    rows[0, 7] = [*center(CENTRE), 0.8, 0.1, 0, SCORE / 0.8]
    return {name: rows}


LAYOUT_ROWS = [
    ("yolox", yolox(raw=True), {}, 0),
    ("yolox", yolox(raw=False), {}, 0),  # exported with its decoder
    ("yolo", yolov8(), {}, 0),
    ("yolo", yolo_seg(), {}, 120),
    ("yolo-rows", {"o": yolov8()["output0"].swapaxes(1, 2)}, {}, 0),
    ("yolov5", yolov5(3, "output"), {}, 0),
    ("yolov5", yolov5(1, "outputs"), {}, 0),  # YOLOv6
    ("nanodet", nanodet(), {}, 0),
    ("picodet", picodet(), {}, 0),
    ("detr", detr(), {}, 0),
    ("ssd", ssd(), {}, 0),
    ("r-cnn", mask_rcnn(), {"shape": (3, 64, 64)}, 120),
    ("r-cnn", dict(list(mask_rcnn().items())[:3]), {"shape": (3, 64, 64)}, 0),  # Faster R-CNN
]


@pytest.mark.parametrize(
    ("layout", "outputs", "options", "mask_end"), LAYOUT_ROWS, ids=lambda v: str(v)[:20]
)
def test_layouts(
    tmp_path: Path, layout: str, outputs: dict[str, Any], options: dict[str, Any], mask_end: int
) -> None:
    detector = rt.OnnxDetector(model(tmp_path, outputs, **options))
    assert detector.layout == layout
    found = detector(IMAGE)
    np.testing.assert_allclose(found.xyxy, [BOX], atol=1e-3)
    np.testing.assert_allclose(found.score, [SCORE], atol=1e-6)
    assert found.class_id.tolist() == [LABEL] and found.class_id.dtype == np.int64
    assert (found.masks is not None) == bool(mask_end)
    if found.masks is not None:
        expected = np.zeros((160, 320), bool)
        expected[40:120, 80:mask_end] = True
        assert found.masks.shape == (1, 160, 320)
        assert (found.masks[0] != expected).sum() <= 80  # a column at most


# What the projects' own inference code feeds: order of the channels, mean and deviation of 0..255.
TORCHVISION = (np.multiply([0.485, 0.456, 0.406], 255), np.multiply([0.229, 0.224, 0.225], 255))
SEEN_ROWS = [
    ("detr", detr(), ("scores", (0, 0)), {}, "RGB", 0, 255),
    ("picodet", picodet(), ("o0", (0, 26, 2)), {}, "RGB", *TORCHVISION),
    ("nanodet", nanodet(), ("output", (0, 35, 2)), {}, "BGR",
     [103.53, 116.28, 123.675], [57.375, 57.12, 58.395]),
    ("yolox", yolox(raw=False), ("output", (0, 7, 7)), {}, "BGR", 0, 1),
    ("yolo", yolov8(), ("output0", (0, 6, 50)), {}, "RGB", 0, 255),
    ("ssd", ssd(), ("scores", (0, 0)), {}, "RGB", *TORCHVISION),
    ("r-cnn", mask_rcnn(), ("6572", (0,)), {"shape": (3, 64, 64)}, "BGR",
     [102.9801, 115.9465, 122.7717], 1),
]  # fmt: skip


@pytest.mark.parametrize(
    ("layout", "outputs", "at", "options", "order", "mean", "std"),
    SEEN_ROWS,
    ids=lambda v: str(v)[:12],
)
def test_channels_and_scaling(
    tmp_path: Path, layout: str, outputs: dict[str, Any], at: Any, options: dict[str, Any],
    order: str, mean: Any, std: Any,
) -> None:  # fmt: skip
    """A model whose score depends on the channel order: its base + (x + 2 y + 4 z) / 3."""
    weights = np.reshape([1, 2, 4], (3, 1, 1))
    path = model(tmp_path, outputs, seen=(*at, weights), **options)
    detector = rt.OnnxDetector(path)
    assert detector.layout.startswith(layout)
    blue, green, red = 220, 150, 130
    image = np.full((640, 640, 3), (blue, green, red), np.uint8)
    channels = (red, green, blue) if order == "RGB" else (blue, green, red)
    expected = SCORE + np.dot((np.array(channels) - mean) / std, [1, 2, 4]) / 3
    assert detector(image).score[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("outputs", "at", "unit", "where"),
    [
        (yolov8(), ("output0", (0, 6, 50)), 1 / 255, slice(16, 48)),  # in the middle
        (yolox(raw=False), ("output", (0, 7, 7)), 1, slice(0, 32)),  # in the corner
    ],
)
def test_the_letterbox_border_is_grey(
    tmp_path: Path, outputs: dict[str, Any], at: Any, unit: float, where: slice
) -> None:
    """The position of the image matches the mapping of boxes; the border is grey, 114."""
    inside = np.zeros((3, 64, 64))
    inside[:, where] = 1
    image = np.full_like(IMAGE, 200)
    for fraction, value in ((inside, 200), (1 - inside, 114)):
        path = model(tmp_path, outputs, seen=(*at, fraction))
        expected = SCORE + value * unit / 2  # half of the input
        assert rt.OnnxDetector(path)(image).score[0] == pytest.approx(expected, rel=1e-3)


def test_detections_are_selected(tmp_path: Path) -> None:
    rows = np.zeros((1, 7, 84))
    wide, near, far = [16, 24, 32, 40], [17, 24, 33, 40], [40, 24, 60, 40]
    for column, (box, scores) in enumerate(
        [
            (wide, [0.9, 0, 0]),
            (near, [0.8, 0, 0]),
            (near, [0, 0.7, 0]),
            (far, [0.6, 0, 0]),
            (far, [0, 0, 0.0625]),
        ]
    ):
        rows[0, :, 30 - column] = [*center(box), *scores]
    rows[0, :, 9] = [60, 32, 20, 20, 0, 0, 0.5]  # reaches beyond the image: clipped
    rows[0, :, 5] = [30, 8, 10, 10, 0, 0, 0.8]  # in the border above the image: nothing is left
    path = model(tmp_path, {"o": rows})
    found = rt.OnnxDetector(path)(IMAGE)
    # NMS within a class only; min_score; best first
    assert found.score.tolist() == pytest.approx([0.9, 0.7, 0.6, 0.5])
    assert found.class_id.tolist() == [0, 1, 0, 2]
    assert found.xyxy[3].tolist() == pytest.approx([250, 30, 320, 130])
    only = rt.OnnxDetector(path, rt.DetectConfig(classes="TV, bowl"))
    assert only.class_names == ("cup", "bowl", "tv") and only(IMAGE).class_id.tolist() == [1, 2]
    two = rt.OnnxDetector(path, rt.DetectConfig(max_detections=2))(IMAGE)
    assert two.score.tolist() == pytest.approx([0.9, 0.7])
    for min_score, count in ((0.0625, 5), (0.063, 4)):  # at least, not above
        assert len(rt.OnnxDetector(path, rt.DetectConfig(min_score=min_score))(IMAGE)) == count
    with pytest.raises(rt.ReobjError, match="no class sofa among cup, bowl, tv"):
        rt.OnnxDetector(path, rt.DetectConfig(classes="sofa"))


@pytest.mark.parametrize(
    ("outputs", "shape", "expected"),
    [
        ({"logits": np.zeros((1, 1000))}, (1, 3, 64, 64), r"logits \(1, 1000\); .* yolox.*layout"),
        ({"o": np.zeros((1, 5))}, (1, 10), r"input is tensor.float. \[1, 10\]"),
        ({"o": np.zeros((1, 84, 8))}, (1, 1, 64, 64), "expected an image .1, 3, H, W."),  # grey
    ],
)
def test_other_networks_are_refused(
    tmp_path: Path, outputs: dict[str, Any], shape: Any, expected: str
) -> None:
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        rt.OnnxDetector(model(tmp_path, outputs, shape))
    assert "m.onnx" in str(caught.value) and "\n" not in str(caught.value)


# ---- Cache ---------------------------------------------------------------------------------------


def some(index: int, masks: bool) -> rt.Detections:
    """Three random boxes, or none at all of every fourth frame."""
    count = 3 * (index % 4 > 0)
    rng = np.random.default_rng(index)
    corner = rng.random((count, 2)) * 20
    found = rng.random((count, 24, 32)) < 0.5 if masks and count else None
    xyxy = np.hstack([corner, corner + 5])
    return rt.Detections(xyxy, rng.random(count), rng.integers(0, 9, count), found)


@pytest.mark.parametrize(("masks", "stored"), [(False, 64), (True, 96)])
def test_a_cache_survives_a_kill_and_a_damaged_file(
    tmp_path: Path, caplog: Any, masks: bool, stored: int
) -> None:
    """Files of 64 frames, of 8 with masks; frames without detections are kept too."""
    cache = DetectionCache(tmp_path, (32, 24))
    for index in range(100):
        cache.put(index, some(index, masks))
    (tmp_path / ".part-chunk_000009.npz").write_bytes(b"half")  # a kill while writing
    reopened = DetectionCache(tmp_path, (32, 24))
    assert [k for k in range(120) if k in reopened] == list(range(stored))
    reopened.put(99, some(99, masks))
    reopened.flush()
    first = tmp_path / "chunk_000000.npz"
    first.write_bytes(first.read_bytes()[:-40])
    for _ in range(2):
        again = DetectionCache(tmp_path, (32, 24))
    assert caplog.text.count("removed and computed again") == 1 and first.name in caplog.text
    assert again.get(0) is None and again.get(98) is None
    for index in (*range(64, stored), 99):
        found = again.get(index)
        true = some(index, masks)
        assert found is not None
        for key in ("xyxy", "score", "class_id", "masks"):
            np.testing.assert_array_equal(getattr(found, key), getattr(true, key))


# ---- Sources of detections -----------------------------------------------------------------------


def frame(index: int = 0, image: Image = IMAGE) -> rt.Frame:
    return rt.Frame(index, 0.0, image)


def at(source: DetectionSource, frame: rt.Frame) -> rt.Detections:
    """Detections of one frame."""
    (found,) = source.detect([frame])
    assert found is not None
    return found


@pytest.mark.parametrize(
    "found",
    [
        rt.Detections(np.array([BOX]), np.array([0.5]), np.array([3])),
        [[*BOX, 0.5, 3]],
        SimpleNamespace(
            xyxy=np.array([BOX], np.float32),
            confidence=np.array([0.5]),
            class_id=np.array([3]),
            mask=None,
        ),
    ],
)
def test_a_function_is_a_source_of_detections(found: Any) -> None:
    images = []
    source = as_source(lambda image: images.append(image) or found)
    made = at(source, frame(4))
    assert made.xyxy.tolist() == [BOX] and made.score.tolist() == [0.5]
    assert made.class_id.tolist() == [3] and images[0] is IMAGE
    assert source.key == "" and source.class_names == rt.COCO_NAMES and source.messages == ()
    assert as_source(source) is source
    assert len(at(as_source(lambda image: []), frame())) == 0
    named = as_source(lambda image: found, ["a", "b", "c"])
    with pytest.raises(rt.ReobjError, match="frame 9: class 3, but there are only 3 class names"):
        at(named, frame(9))
    with pytest.raises(rt.ReobjError, match=r"frame 7: detections are an array of shape \(1, 5\)"):
        at(as_source(lambda image: [[*BOX, 0.5]]), frame(7))


@pytest.fixture
def clip(tmp_path: Path) -> rt.Video:
    """Six black images of 64 x 48, read at half their size."""
    (tmp_path / "im").mkdir()
    for index in range(6):
        cv2.imwrite(str(tmp_path / "im" / f"{index}.png"), np.zeros((48, 64, 3), np.uint8))
    return rt.Video(tmp_path / "im", rt.InputConfig(every=2, max_size=32))


def test_a_file_is_indexed_by_frame_number(clip: rt.Video, tmp_path: Path) -> None:
    path = tmp_path / "det.txt"
    path.write_text("".join(f"{i + 1},-1,{10 + i},20,30,10,.9\n" for i in range(7)))
    source = open_detections(clip, rt.DetectConfig(), path)
    assert [f.index for f in clip] == [0, 2, 4]
    assert [at(source, f).xyxy[0, 0] for f in clip] == [5, 6, 7]  # half of 10, 12, 14
    assert source.class_names == ("object",)
    assert any("frames that the video lacks" in text for text in source.messages)
    recorded = as_source(rt.read_detections(path, clip))
    assert at(recorded, frame(4)).xyxy[0, 0] == 7 and recorded.messages == source.messages
    assert recorded.class_names == ("object",)
    path.write_text("1,-1,10,20,30,10,.9\n")
    assert source.key != open_detections(clip, rt.DetectConfig(), str(path)).key != ""


def test_a_changed_option_or_file_changes_the_key(clip: rt.Video, tmp_path: Path) -> None:
    """Also of recorded detections: tracks made of them are cached under it."""
    path, names = tmp_path / "det.csv", tmp_path / "names.txt"
    path.write_text("frame,x1,y1,x2,y2,score,class\n0,10,20,30,40,.9,0\n")
    names.write_text("cup\n")
    config = rt.DetectConfig(class_names=str(names))
    keys = {open_detections(clip, config, path).key, open_detections(clip, config, path).key}
    assert len(keys) == 1
    for change in ({"min_score": 0.2}, {"classes": "cup"}, {"max_detections": 3}):
        changed = dataclasses.replace(config, **change)
        keys.add(open_detections(clip, changed, path).key)
    names.write_text("wok, bowl\n")
    keys.add(open_detections(clip, config, path).key)
    assert len(keys) == 5


def test_a_detector_is_named_where_detections_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a known name, unless a file or folder has it, or as a .onnx file."""
    monkeypatch.chdir(tmp_path)
    config = rt.DetectConfig(min_score=0.2)
    for name in ("fast", "yolox-nano", "a/b.ONNX", Path("c.onnx")):
        expected = rt.DetectConfig(model=str(name), min_score=0.2)
        assert with_detector(config, name) == (expected, None)
    (tmp_path / "fast").mkdir()
    for other in ("fast", "reobj", "det.txt", Path("det.npz"), "", None, len):
        assert with_detector(config, other) == (config, other)
    with pytest.raises(rt.ReobjError, match=r"fsat: no such file .*; did you mean fast"):
        rt.run("a.mp4", detector="fsat")
    with pytest.raises(rt.ReobjError, match="the same argument"):
        rt.run("a.mp4", detector="fast", detections="det.txt")


# ---- Real weights --------------------------------------------------------------------------------


@needs_shared
@pytest.mark.parametrize(
    ("name", "recall", "iou"),
    # Confident YOLOv8s boxes found again on 10 frames of redkitchen, and how tightly: a wrong
    # channel order, a wrong mean or half a cell of shift lose more than the margin.
    [
        ("deimv2-femto", 0.85, 0.9),
        ("picodet-s-416", 0.85, 0.89),
        ("yolo11n-seg_dyn", 0.8, 0.92),
    ],
)
def test_real_weights_agree_with_yolov8s(
    name: str, recall: float, iou: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("REOBJ_MODELS", str(SHARED / "models"))
    folder = SHARED / "data/redkitchen_7scenes"
    video = rt.Video(folder / "images", rt.InputConfig(every=50))
    reference = rt.read_detections(
        folder / "detections_yolov8s.csv", video, rt.DetectConfig(min_score=0.6)
    )
    detector = rt.OnnxDetector(name, rt.DetectConfig(min_score=0.3), threads=1)
    best = []
    for frame in video:
        a, b = reference.at(frame.index), detector(frame.image)
        overlap = box_iou(a.xyxy, b.xyxy) * (a.class_id[:, None] == b.class_id)
        best += overlap.max(1, initial=0).tolist()
        assert (b.masks is not None) == ("seg" in name)
    hit = [value for value in best if value > 0.5]
    assert len(best) > 30 and len(hit) / len(best) >= recall, (len(hit), len(best))
    assert np.mean(hit) >= iou
