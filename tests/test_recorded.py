"""Detections of a video as arrays, and the npz format that holds them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj.sources import recorded
from reobj.types import BoolArray

SIZE = (64, 48)
BOXES = np.array([[1.25, 2, 30, 40], [5, 6, 50, 40], [9, 10, 60, 45]])


def three(masks: BoolArray | None = None) -> rt.Detections:
    return rt.Detections(BOXES, np.array([0.9, 0.8, 0.7]), np.array([1, 0, 1]), masks)


def write(path: Path, *frames: tuple[int, rt.Detections]) -> Path:
    rt.write_detections_npz(path, frames, ("cup", "box"), SIZE)
    return path


def test_round_trip(tmp_path: Path) -> None:
    made = np.random.default_rng(2).random((3, 48, 64)) < 0.5
    made[1] = False  # no mask
    frames = [(3, three(made)), (5, rt.Detections.empty()), (6, three(made)[[0]]), (8, three())]
    path = write(tmp_path / "d.npz", *frames)
    found, done = recorded.read_npz(path, SIZE, SIZE)
    assert found.class_names == ("cup", "box") and len(found) == 7
    assert found.frame.tolist() == [3, 3, 3, 6, 8, 8, 8]
    assert done.tolist() == [3, 5, 6, 8] == found.looked.tolist()  # also the one without a box
    for index, expected in frames:
        got = found.at(index)
        np.testing.assert_array_equal(got.xyxy, expected.xyxy)
        np.testing.assert_array_equal(got.score, expected.score)
        np.testing.assert_array_equal(got.class_id, expected.class_id)
        assert (got.masks is None) == (expected.masks is None)
        if got.masks is not None:
            np.testing.assert_array_equal(got.masks, expected.masks)
    for index in (2, 4, 9):  # not in the file
        assert len(found.at(index)) == 0 and found.at(index).xyxy.shape == (0, 4)
    assert write(tmp_path / "again.npz", *frames).read_bytes() == path.read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_may_list_the_processed_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "a.npz", (3, three()))
    arrays = dict(np.load(path))
    np.savez(path, **arrays | {"done": [4, 3, 2]})
    found, done = recorded.read_npz(path, SIZE, SIZE)
    assert done.tolist() == found.looked.tolist() == [2, 3, 4]
    del arrays["done"]  # files of version 0.2 have no such list
    np.savez(path, **arrays)
    found, done = recorded.read_npz(path, SIZE, SIZE)
    assert found.looked is None and done.tolist() == [3, 3, 3]
    np.savez(path, **arrays | {"done": [[2.5]]})
    with pytest.raises(rt.ReobjError, match=r"array done is \(1, 1\)"):
        recorded.read_npz(path, SIZE, SIZE)


def test_boxes_and_masks_follow_the_working_size(tmp_path: Path) -> None:
    """Half the width, a third of the height; a pixel stays if at least half of it is covered."""
    masks = np.zeros((1, 48, 64), bool)
    masks[0, 6:20, 10:41] = True
    path = write(tmp_path / "a.npz", (0, rt.Detections(BOXES[:1], np.ones(1), np.zeros(1), masks)))
    found = recorded.read_npz(path, SIZE, (32, 16))[0].at(0)
    np.testing.assert_allclose(found.xyxy, [[0.625, 2 / 3, 15, 40 / 3]])
    covered = masks[0].reshape(16, 3, 32, 2).mean((1, 3))
    assert 0.5 in covered and found.masks is not None
    np.testing.assert_array_equal(found.masks[0], covered >= 0.5)


def test_masks_of_the_wrong_size_are_refused(tmp_path: Path) -> None:
    masks = np.ones((3, 24, 32), bool)
    with pytest.raises(rt.ReobjError, match=r"masks are \(3, 24, 32\), expected .* \(3, 48, 64\)"):
        write(tmp_path / "a.npz", (0, three(masks)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"image_size": [320, 240]}, r"made for images of \(320, 240\) px, but the video is"),
        ({"image_size": [48, 64]}, r"made for images of \(48, 64\) px, but the video is"),
        ({"xyxy": np.zeros((2, 4))}, r"array xyxy is \(2, 4\), expected shape \(3, 4\)"),
        ({"score": np.zeros(4)}, r"array score is \(4,\), expected shape \(3,\)"),
        ({"mask_offsets": [0, 9, 9]}, r"mask_offsets is \(3,\), expected shape \(4,\)"),
        ({"frame": None}, "array frame is missing"),
        ({"class_names": None}, "array class_names is missing"),
    ],
)
def test_wrong_arrays_are_named(tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    path = write(tmp_path / "a.npz", (0, three()))
    arrays = {key: value for key, value in (dict(np.load(path)) | change).items()}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(rt.ReobjError, match=expected):
        recorded.read_npz(path, SIZE, SIZE)


def test_masks_are_optional(tmp_path: Path) -> None:
    """As other tools write the format: without mask_counts and mask_offsets."""
    path = write(tmp_path / "a.npz", (0, three()))
    arrays = {k: v for k, v in np.load(path).items() if not k.startswith("mask_")}
    np.savez(path, **arrays)
    found, _ = recorded.read_npz(path, SIZE, SIZE)
    assert found.at(0).masks is None and found.at(0).xyxy.tolist() == BOXES.tolist()
