"""Detectors of other libraries against the documented call of each library.

Weights are random and written to a file that both sides load: with `--detector LIBRARY:FILE` the
detections of a frame (BGR) must be those that the library itself gives for the picture (RGB).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small_models import small_rt_detr
from torchvision_operators import declare_nms

import reobj_track as rt
from reobj.sources.detectors import open_detections
from reobj.types import Detections

pytestmark = pytest.mark.filterwarnings("ignore:.*pretrain_weights=None")  # of rfdetr
SIZE = (320, 240)  # px
INSTALL = "pip install -e '.[detectors]'"
Rows = tuple[Any, Any, Any]  # boxes (N, 4), scores (N,), names of the classes (N,)


@pytest.fixture(scope="module", autouse=True)
def torchvision_can_be_imported() -> None:
    declare_nms()


@pytest.fixture
def picture(tmp_path: Path) -> Any:
    """A picture of PIL with large coloured patches, which is also `tmp_path/photos/0.png`."""
    images = pytest.importorskip("PIL.Image", reason="pip install pillow")
    patches = np.random.default_rng(3).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    patches[..., 0] //= 4  # little red: another order of the channels is another picture
    picture = images.fromarray(cv2.resize(patches, SIZE, interpolation=cv2.INTER_CUBIC))
    (tmp_path / "photos").mkdir()
    picture.save(tmp_path / "photos" / "0.png")
    return picture


def assert_same(found: Detections, names: list[str], rows: Rows) -> None:
    """The library's boxes are clipped to the image, without empty ones, best first."""
    boxes, scores = (np.asarray(column, np.float64) for column in rows[:2])
    boxes = np.clip(boxes, 0, np.tile(SIZE, 2))
    use = np.flatnonzero((boxes[:, 2:] > boxes[:, :2]).all(1))
    order = use[np.argsort(-scores[use], kind="stable")][: len(found)]
    assert names == [rows[2][k] for k in order]
    np.testing.assert_allclose(found.score, scores[order], atol=1e-5)
    np.testing.assert_allclose(found.xyxy, boxes[order], atol=1)  # px


def responsive(model: Any) -> Any:
    """Give a network random weights with which its outputs depend on the picture."""
    import torch

    torch.manual_seed(0)
    for parameter in model.parameters():
        if parameter.dim() > 1:
            torch.nn.init.kaiming_normal_(parameter.data)
    return model


def blue_as_red(picture: Any) -> Any:
    from PIL import Image

    return Image.fromarray(np.asarray(picture)[..., ::-1])


def check(
    folder: Path, picture: Any, detector: str, documented: Callable[[Any], Rows], min_score: float
) -> None:
    """The tool detects what the library detects, and not what it detects with blue as red."""
    video = rt.Video(folder / "photos")
    (frame,) = list(video)
    source = open_detections(video, rt.DetectConfig(model=detector, min_score=min_score))
    (found,) = source.detect([frame])
    pair = [one for one in source.detect([frame, frame]) if one is not None]  # in one batch
    for one in pair:
        np.testing.assert_allclose(one.score, found.score, atol=1e-4)
    assert len(pair) == 2
    names = [source.class_names[k] for k in found.class_id]
    assert len(found) >= 5
    assert_same(found, names, documented(picture))
    with pytest.raises(AssertionError):
        assert_same(found, names, documented(blue_as_red(picture)))


def test_ultralytics(picture: Any, tmp_path: Path) -> None:
    ultralytics = pytest.importorskip("ultralytics", reason=INSTALL)
    file = tmp_path / "mine.pt"
    made = ultralytics.YOLO("yolo11n.yaml")
    responsive(made.model)
    made.save(file)
    model = ultralytics.YOLO(file)

    def documented(image: Any) -> Rows:
        found = model.predict(image, conf=1e-6, device="cpu", verbose=False)[0].boxes
        return found.xyxy, found.conf, [model.names[int(k)] for k in found.cls]

    check(tmp_path, picture, str(file), documented, 1e-6)


def test_rfdetr(picture: Any, tmp_path: Path) -> None:
    rfdetr = pytest.importorskip("rfdetr", reason=INSTALL)
    import torch

    file = tmp_path / "mine.pth"
    made = rfdetr.RFDETRNano(pretrain_weights=None, device="cpu").model.model
    torch.save({"model": responsive(made).state_dict()}, file)
    model = rfdetr.RFDETRNano(pretrain_weights=str(file), device="cpu")

    def documented(image: Any) -> Rows:
        found = model.predict(image, threshold=0.01)
        found = found[found.data["class_name"] != ""]  # without unused numbers of COCO
        return found.xyxy, found.confidence, found.data["class_name"]

    check(tmp_path, picture, f"rfdetr:nano={file}", documented, 0.01)
    with pytest.raises(rt.ReobjError, match=r"rfdetr:huge: no such model; there are base, .*nano"):
        open_detections(rt.Video(tmp_path / "photos"), rt.DetectConfig(model="rfdetr:huge"))


def test_torchvision(picture: Any, tmp_path: Path) -> None:
    pytest.importorskip("torchvision", reason=INSTALL)
    import torch
    from torchvision.models import get_model, get_model_weights

    name = "ssdlite320_mobilenet_v3_large"
    model = responsive(get_model(name, weights=None, weights_backbone=None)).eval()
    file = tmp_path / "mine.pth"
    torch.save(model.state_dict(), file)
    trained = get_model_weights(name).DEFAULT
    transforms = trained.transforms()

    def documented(image: Any) -> Rows:
        with torch.inference_mode():
            (found,) = model([transforms(image)])
        found = {key: value[found["labels"] > 0] for key, value in found.items()}  # 0: background
        names = [trained.meta["categories"][k] for k in found["labels"]]
        return found["boxes"], found["scores"], names

    check(tmp_path, picture, f"torchvision:{name}={file}", documented, 0.001)


def test_transformers(picture: Any, tmp_path: Path) -> None:
    tf = pytest.importorskip("transformers", reason=INSTALL)
    pytest.importorskip("torch", reason=INSTALL)
    folder = str(tmp_path / "model")
    responsive(small_rt_detr()).save_pretrained(folder)
    tf.RTDetrImageProcessor().save_pretrained(folder)
    pipeline = tf.pipeline("object-detection", model=folder)

    def documented(image: Any) -> Rows:
        found = pipeline(image, threshold=0.001)
        sides = ("xmin", "ymin", "xmax", "ymax")  # whole pixels
        boxes = [[row["box"][side] for side in sides] for row in found]
        return boxes, [row["score"] for row in found], [row["label"] for row in found]

    check(tmp_path, picture, f"hf:{folder}", documented, 0.001)
