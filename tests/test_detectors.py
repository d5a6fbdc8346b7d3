"""Detectors: every ONNX layout on graphs made here, the cache, and sources of detections."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt
from reobj.sources import detectors
from reobj.sources.detectors import DetectionCache, DetectionSource, as_source, open_detections
from reobj.sources.recorded import RecordedDetections
from reobj.types import Image

SHARED = Path(os.environ.get("REOBJ_SHARED", Path(__file__).resolve().parents[2] / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "models").is_dir(), reason="no weights: set REOBJ_SHARED"
)

# ---- Layouts -------------------------------------------------------------------------------------

onnx = pytest.importorskip("onnx", reason="pip install onnx (extra `dev`)")
IMAGE = np.zeros((160, 320, 3), np.uint8)  # (H, W, 3)
BOX = [80.0, 40.0, 160.0, 120.0]  # what every model below finds in it
STRETCHED, CORNER, CENTRE = (
    [16, 16, 32, 48],
    [16, 8, 32, 24],
    [16, 24, 32, 40],
)  # the same in a 64 x 64 input
LABEL, SCORE = 2, 0.75


def model(
    folder: Path,
    outputs: dict[str, Any],
    shape: tuple[Any, ...] = (1, 3, 64, 64),
    kind: int = 1,
    sizes: bool = False,
    names: str = "",
) -> Path:
    """Write a model that answers the same to every image."""
    helper, proto = onnx.helper, onnx.TensorProto
    arrays = {name: np.asarray(value) for name, value in outputs.items()}
    arrays = {
        name: a.astype(np.float32) if a.dtype == np.float64 else a for name, a in arrays.items()
    }
    nodes = [
        helper.make_node("Constant", [], [name], value=onnx.numpy_helper.from_array(a))
        for name, a in arrays.items()
    ]
    inputs = [helper.make_tensor_value_info("images", kind, shape)]
    if sizes:
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", proto.INT64, ["n", 2]))
    made = [
        helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(a.dtype), a.shape)
        for name, a in arrays.items()
    ]
    graph = onnx.helper.make_model(
        helper.make_graph(nodes, "g", inputs, made),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )
    if names:
        onnx.helper.set_model_props(graph, {"names": names})
    onnx.save(graph, folder / "m.onnx")
    return folder / "m.onnx"


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
    box = np.divide(STRETCHED, 64)
    return {"bboxes": [[box, box]], "labels": np.array([[LABEL + 1, 1]]), "scores": [[SCORE, 0.01]]}


def rcnn() -> dict[str, Any]:
    """Boxes in the 640 x 320 input that the image is enlarged to; the left half is masked."""
    mask = np.zeros((1, 1, 28, 28))
    mask[..., :14] = 1
    return {
        "boxes": np.multiply([BOX], 2),
        "labels": np.array([LABEL + 1]),
        "scores": [SCORE],
        "masks": mask,
    }


LAYOUT_ROWS = [
    ("YOLOX", yolox(raw=True), {}, 0),
    ("YOLOX", yolox(raw=False), {}, 0),  # exported with its decoder
    ("YOLOv8, YOLO11 (and -seg)", yolov8(), {}, 0),
    ("YOLOv8, YOLO11 (and -seg)", yolo_seg(), {}, 120),
    ("NanoDet-Plus", nanodet(), {}, 0),
    ("PicoDet", picodet(), {}, 0),
    ("DEIM, D-FINE, RT-DETR (labels, boxes, scores)", detr(), {"sizes": True}, 0),
    ("SSD with built-in NMS", ssd(), {}, 0),
    ("Mask R-CNN", rcnn(), {"shape": (3, "h", "w")}, 120),
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


def test_dynamic_input_takes_the_image_shape(tmp_path: Path) -> None:
    rows = np.zeros((1, 84, 8400))  # 640 x 640
    detector = rt.OnnxDetector(model(tmp_path, {"o": rows}, shape=(1, 3, "h", "w")))
    assert detector._input_size(1920, 1080) == (640, 384) and detector._input_size(480, 640) == (
        480,
        640,
    )
    assert detector.class_names == rt.COCO_NAMES


def seeing(folder: Path, weight: list[float], kind: str) -> Path:
    """Write a model whose score is the weighted mean of the channels that it is fed."""
    helper, numpy_helper = onnx.helper, onnx.numpy_helper
    constants = {"w": np.float32(weight).reshape(1, 3, 1, 1), "zero": np.int64([0])}
    if kind == "detr":
        constants |= {
            "labels": np.int64([[0]]),
            "boxes": np.float32([[BOX]]),
            "shape": np.int64([1, 1]),
        }
        names = {"labels": (7, [1, 1]), "boxes": (1, [1, 1, 4]), "scores": (1, [1, 1])}
        tail = [helper.make_node("Reshape", ["mean", "shape"], ["scores"])]
    else:
        base = np.float32(yolox(raw=False)["output"])
        base[0, 7, 4:] = 0
        at = np.zeros_like(base)
        at[0, 7, 4], base[0, 7, 5] = 1, 1
        constants |= {"base": base, "at": at, "shape": np.int64([1, 1, 1])}
        names = {"output": (1, [1, 84, 8])}
        tail = [helper.make_node("Reshape", ["mean", "shape"], ["m"]),
                helper.make_node("Mul", ["m", "at"], ["ma"]),
                helper.make_node("Add", ["base", "ma"], ["output"])]  # fmt: skip
    nodes = [helper.make_node("Mul", ["images", "w"], ["x"]),
             helper.make_node("ReduceMean", ["x"], ["mean"], keepdims=1), *tail]  # fmt: skip
    inputs = [helper.make_tensor_value_info("images", 1, [1, 3, 64, 64])]
    if kind == "detr":
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", 7, [1, 2]))
    made = [helper.make_tensor_value_info(name, *value) for name, value in names.items()]
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "g", inputs, made, tensors)
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8),
        folder / "s.onnx",
    )
    return folder / "s.onnx"


def test_channel_order_and_scaling(tmp_path: Path) -> None:
    red = np.zeros((64, 64, 3), np.uint8)
    red[..., 2] = 204  # BGR
    # DEIM wants RGB / 255: the first channel is red, .8; YOLOX wants BGR 0..255: the third is.
    assert rt.OnnxDetector(seeing(tmp_path, [3, 0, 0], "detr"))(red).score == pytest.approx(
        204 / 255
    )
    found = rt.OnnxDetector(seeing(tmp_path, [0, 0, 3 / 255], "yolox"))(red)
    assert found.score == pytest.approx(204 / 255, abs=1e-4)


def test_detections_are_selected(tmp_path: Path) -> None:
    rows = np.zeros((1, 7, 84))
    wide, near, far = [16, 24, 32, 40], [17, 24, 33, 40], [40, 24, 60, 40]
    for column, (box, scores) in enumerate(
        [
            (wide, [0.9, 0, 0]),
            (near, [0.8, 0, 0]),
            (near, [0, 0.7, 0]),
            (far, [0.6, 0, 0]),
            (far, [0, 0, 0.05]),
        ]
    ):
        rows[0, :, column] = [*center(box), *scores]
    rows[0, :, 9] = [60, 32, 20, 20, 0, 0, 0.5]  # reaches beyond the image: clipped
    path = model(tmp_path, {"o": rows}, names="{0: 'cup', 1: 'bowl', 2: 'tv'}")
    found = rt.OnnxDetector(path)(IMAGE)
    assert found.score.tolist() == pytest.approx(
        [0.9, 0.7, 0.6, 0.5]
    )  # NMS within a class, min_score
    assert found.xyxy[3].tolist() == pytest.approx([250, 30, 320, 130])
    only = rt.OnnxDetector(path, rt.DetectConfig(classes="TV, bowl"))
    assert only.class_names == ("cup", "bowl", "tv") and only(IMAGE).class_id.tolist() == [1, 2]
    assert len(rt.OnnxDetector(path, rt.DetectConfig(max_detections=2))(IMAGE)) == 2
    assert len(rt.OnnxDetector(path, rt.DetectConfig(nms_iou=0.99))(IMAGE)) == 5
    with pytest.raises(rt.ReobjError, match="no class sofa among cup, bowl, tv"):
        rt.OnnxDetector(path, rt.DetectConfig(classes="sofa"))


def test_class_names_come_from_the_user_first(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = model(tmp_path, yolov8())
    assert rt.OnnxDetector(path).class_names == ("class 0", "class 1", "class 2")
    assert "3 classes without names" in caplog.text
    (tmp_path / "names.txt").write_text("a\nb\nc\n")
    config = rt.DetectConfig(class_names=str(tmp_path / "names.txt"))
    assert rt.OnnxDetector(path, config).class_names == ("a", "b", "c")
    (tmp_path / "names.txt").write_text("a\n")
    with pytest.raises(rt.ReobjError, match="class 2, but there are only 1 class names"):
        rt.OnnxDetector(path, config)(IMAGE)


@pytest.mark.parametrize(
    ("outputs", "shape", "expected"),
    [
        (
            {"logits": np.zeros((1, 1000))},
            (1, 3, 64, 64),
            r"outputs logits \(1, 1000\); known layouts: DEIM.*YOLOX",
        ),
        (
            {"features": np.zeros((1, 320, 7, 7))},
            (1, 3, 224, 224),
            "no known object detector: outputs features",
        ),
        (
            {"o": np.zeros((1, 5))},
            (1, 10),
            r"no known object detector: input is tensor.float. \[1, 10\]",
        ),
        ({"o": np.zeros((1, 84, 8))}, (1, 1, 64, 64), "expected an image .1, 3, H, W."),  # grey
    ],
)
def test_other_networks_are_refused(
    tmp_path: Path, outputs: dict[str, Any], shape: Any, expected: str
) -> None:
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        rt.OnnxDetector(model(tmp_path, outputs, shape))
    assert "m.onnx" in str(caught.value) and "\n" not in str(caught.value)


def test_no_onnx_file(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"no model")
    with pytest.raises(rt.ReobjError, match=r"a.onnx: onnxruntime cannot load it"):
        rt.OnnxDetector(tmp_path / "a.onnx")


def reference_nms(xyxy: Any, label: Any, max_iou: float) -> list[int]:
    kept: list[int] = []
    for i in range(len(xyxy)):
        ok = True
        for j in kept:
            low, high = np.maximum(xyxy[i, :2], xyxy[j, :2]), np.minimum(xyxy[i, 2:], xyxy[j, 2:])
            inter = np.clip(high - low, 0, None).prod()
            area = (xyxy[i, 2:] - xyxy[i, :2]).prod() + (xyxy[j, 2:] - xyxy[j, :2]).prod() - inter
            ok &= label[i] != label[j] or inter <= max_iou * area
        if ok:
            kept.append(i)
    return kept


def test_nms_against_the_slow_way() -> None:
    rng = np.random.default_rng(3)
    corner = rng.random((200, 2)) * 60
    xyxy, label = (
        np.hstack([corner, corner + 10 + rng.random((200, 2)) * 30]),
        rng.integers(0, 3, 200),
    )
    for limit in (0.3, 0.6):
        assert rt.nms(xyxy, label, limit).tolist() == reference_nms(xyxy, label, limit)
    assert rt.nms(np.empty((0, 4)), np.empty(0, np.int64), 0.5).tolist() == []


# ---- Cache ---------------------------------------------------------------------------------------


def some(index: int, masks: bool = False) -> rt.Detections:
    count = index % 4  # also none at all
    rng = np.random.default_rng(index)
    corner = rng.random((count, 2)) * 20
    found = rng.random((count, 24, 32)) < 0.5 if masks else None
    return rt.Detections(
        np.hstack([corner, corner + 5]), rng.random(count), rng.integers(0, 9, count), found
    )


def assert_same(a: rt.Detections | None, b: rt.Detections) -> None:
    assert a is not None
    for key in ("xyxy", "score", "class_id"):
        np.testing.assert_array_equal(getattr(a, key), getattr(b, key))
    if b.masks is not None and len(b):
        np.testing.assert_array_equal(a.masks, b.masks)


@pytest.mark.parametrize("masks", [False, True])
def test_cache_survives_a_kill_between_flushes(tmp_path: Path, masks: bool) -> None:
    cache = rt.DetectionCache(tmp_path / "c", (32, 24))
    for index in range(0, 300, 2):
        cache.put(index, some(index, masks))
        assert_same(cache.get(index), some(index, masks))
    stored = 150 // rt.CACHE_FRAMES * rt.CACHE_FRAMES
    (tmp_path / "c" / "chunk_000009.npz.tmp").write_bytes(b"half")  # a kill while writing
    reopened = rt.DetectionCache(tmp_path / "c", (32, 24))
    assert reopened.get(2 * stored - 2) is not None and reopened.get(2 * stored) is None
    assert reopened.get(299) is None and reopened.get(298) is None
    for index in range(0, 2 * stored, 2):
        assert_same(reopened.get(index), some(index, masks))
    reopened.put(298, some(298, masks))
    reopened.flush()
    assert_same(rt.DetectionCache(tmp_path / "c", (32, 24)).get(298), some(298, masks))


def test_damaged_cache_files_are_detected_again(tmp_path: Path, caplog: Any) -> None:
    cache = rt.DetectionCache(tmp_path, (32, 24))
    cache.put(1, some(1))
    cache.flush()
    cache.put(2, some(2))
    cache.flush()
    first = tmp_path / "chunk_000000.npz"
    first.write_bytes(first.read_bytes()[:-40])
    reopened = rt.DetectionCache(tmp_path, (32, 24))
    assert reopened.get(1) is None and reopened.get(2) is not None
    assert "detected again" in caplog.text
    assert rt.DetectionCache(tmp_path, (64, 48)).get(2) is None  # made at another working size


# ---- Real weights --------------------------------------------------------------------------------


@needs_shared
@pytest.mark.parametrize(
    ("name", "recall", "iou"),
    # Confident YOLOv8s boxes found again on 10 frames of redkitchen, and how tightly: a wrong
    # channel order, a wrong mean or half a cell of shift lose more than the margin.
    [
        ("deimv2-femto", 0.85, 0.9),
        ("deimv2-atto", 0.75, 0.88),
        ("yolox-nano", 0.6, 0.88),
        ("picodet-s-416", 0.85, 0.89),
        ("nanodet-plus-m-512", 0.88, 0.87),
        ("yolo11n-seg", 0.8, 0.92),
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
        low = np.maximum(a.xyxy[:, None, :2], b.xyxy[None, :, :2])
        high = np.minimum(a.xyxy[:, None, 2:], b.xyxy[None, :, 2:])
        inter = np.clip(high - low, 0, None).prod(2)
        areas = [(d.xyxy[:, 2:] - d.xyxy[:, :2]).prod(1) for d in (a, b)]
        overlap = (
            inter
            / (areas[0][:, None] + areas[1][None] - inter)
            * (a.class_id[:, None] == b.class_id[None])
        )
        best += overlap.max(1, initial=0).tolist()
        assert b.masks is None or b.masks.shape == (len(b), 480, 640)
    hit = [value for value in best if value > 0.5]
    assert len(best) > 30 and len(hit) / len(best) >= recall, (len(hit), len(best))
    assert np.mean(hit) >= iou


@needs_shared
@pytest.mark.parametrize("name", ["mobilenetv2", "squeezenet1.1", "osnet_x0_25_msmt17"])
def test_real_networks_that_are_no_detectors(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REOBJ_MODELS", str(SHARED / "models"))
    with pytest.raises(rt.ReobjError, match="no known object detector"):
        rt.OnnxDetector(name)
