"""Several frames at once for a network: the detections of each are those of one frame at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_models import write_model

import reobj_track as rt
from reobj.sources.detectors import as_source
from reobj.types import Image

GREYS = (40, 80, 120, 160, 200, 240)  # of the frames; the score of the only box depends on it


def grey_model(folder: Path, shape: Sequence[Any] = ("n", 3, 64, 64), each: bool = True) -> Path:
    """Write a YOLOv8 model whose box has the score .5 + .4 of the mean of the image (0 to 1)."""
    side = shape[3] if isinstance(shape[3], int) else 640
    rows = np.zeros((1, 7, sum((side // stride) ** 2 for stride in (8, 16, 32))))
    rows[0, :, 50] = [side / 2, side / 2, side / 4, side / 4, 0, 0, 0.5]
    seen = ("output0", (0, 6, 50), 0.4)
    return write_model(folder, {"output0": rows}, shape, seen, each, names="['cup', 'bowl', 'tv']")


def plain(grey: int, size: tuple[int, int] = (96, 64)) -> Image:
    return np.full((size[1], size[0], 3), grey, np.uint8)


def same(a: rt.Detections, b: rt.Detections) -> bool:
    """Test for equality to the bit."""
    return all(np.array_equal(getattr(a, c), getattr(b, c)) for c in ("xyxy", "score", "class_id"))


@pytest.mark.parametrize(
    ("shape", "batch"),
    [(("n", 3, 64, 64), 4), ((3, 3, 64, 64), 3), ((1, 3, 64, 64), 1), (("n", 3, "h", "w"), 4)],
    ids=["any number", "three, filled up", "one", "any size"],
)
def test_each_image_of_a_batch_gets_its_detections(
    tmp_path: Path, shape: Sequence[Any], batch: int
) -> None:
    """Also of images of several sizes, in the order of the images."""
    images = [plain(grey) for grey in GREYS]
    images[3] = plain(160, (160, 320))
    one = rt.OnnxDetector(grey_model(tmp_path))
    if "h" in shape:
        one = rt.OnnxDetector(grey_model(tmp_path, shape))
    alone = [one(image) for image in images]
    many = rt.OnnxDetector(grey_model(tmp_path, shape), rt.DetectConfig(batch=4))
    together = list(many.detect(images))
    assert many.batch == batch and as_source(many).batch == batch
    assert len({found.score[0] for found in together}) == 6
    assert all(map(same, together, alone)) and same(many(images[2]), alone[2])
    assert list(many.detect([])) == []


def test_a_model_whose_outputs_have_no_batch_axis_is_refused(tmp_path: Path) -> None:
    detector = rt.OnnxDetector(grey_model(tmp_path, each=False), rt.DetectConfig(batch=4))
    with pytest.raises(rt.ReobjError, match=r"2 images at once .detect.batch.: its outputs have"):
        list(detector.detect([plain(40), plain(200)]))
