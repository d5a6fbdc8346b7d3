"""Detections of a segmenter with and without masks."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import masks as benchmark
import numpy as np
import pytest

import reobj_track as rt

MODULE = """
import numpy as np
import reobj_track as rt

def find(image):
    masks = np.zeros((1, *image.shape[:2]), bool)
    masks[0, 20:40, 10:30] = True
    return rt.Detections(np.array([[10.0, 20, 30, 40]]), np.ones(1), np.array([56]), masks)

def boxes(image):
    return [[10, 20, 30, 40, 0.9, 56]]
"""


@pytest.fixture
def images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "a_segmenter.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "a_segmenter", raising=False)
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((48, 64, 3), np.uint8))
    return folder


def test_the_same_boxes_with_and_without_masks(images: Path, tmp_path: Path) -> None:
    files = tmp_path / "masks.npz", tmp_path / "boxes.npz"
    benchmark.segment(images, "a_segmenter:find", *files)
    video = rt.Video(images)
    with_masks, alone = (rt.read_detections(file, video) for file in files)
    np.testing.assert_array_equal(with_masks.xyxy, alone.xyxy)
    assert with_masks.frame.tolist() == alone.frame.tolist() == [0, 1, 2]
    assert alone.at(1).masks is None
    found = with_masks.at(1).masks
    assert found is not None and found[0, 20:40, 10:30].all() and found.sum() == 400


def test_a_detector_without_masks_is_refused(images: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="a_segmenter:boxes found no masks"):
        benchmark.segment(images, "a_segmenter:boxes", tmp_path / "m.npz", tmp_path / "b.npz")
    assert not list(tmp_path.glob("*.npz"))
