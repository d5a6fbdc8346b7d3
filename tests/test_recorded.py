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
    found = recorded.read_npz(path, SIZE, SIZE)
    assert found.class_names == ("cup", "box") and len(found) == 7
    assert found.frame.tolist() == [3, 3, 3, 6, 8, 8, 8]
    assert found.detector_ran is not None
    assert found.detector_ran.tolist() == [3, 5, 6, 8]  # also the one without a box
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


def test_boxes_and_masks_follow_the_working_size(tmp_path: Path) -> None:
    """Half the width, a third of the height; a pixel stays if at least half of it is covered."""
    masks = np.zeros((1, 48, 64), bool)
    masks[0, 6:20, 10:41] = True
    path = write(tmp_path / "a.npz", (0, rt.Detections(BOXES[:1], np.ones(1), np.zeros(1), masks)))
    found = recorded.read_npz(path, SIZE, (32, 16)).at(0)
    np.testing.assert_allclose(found.xyxy, [[0.625, 2 / 3, 15, 40 / 3]])
    covered = masks[0].reshape(16, 3, 32, 2).mean((1, 3))
    assert 0.5 in covered and found.masks is not None
    np.testing.assert_array_equal(found.masks[0], covered >= 0.5)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"image_size": [320, 240]}, r"made for images of \(320, 240\) px, but the video is"),
        ({"image_size": [640.0, np.inf]}, "image_size"),
        ({"xyxy": np.zeros((2, 4))}, r"array xyxy is .* \(2, 4\), expected .* \(3, 4\)"),
        ({"xyxy": np.full((3, 4), "a")}, "array xyxy is <U1 .* expected float64"),
        ({"frame": np.full(3, 0.5)}, "array frame is float64 .* expected int64"),
        ({"mask_offsets": [0, 9, 9, 9]}, "mask_counts and mask_offsets are inconsistent"),
        ({"class_names": None}, "array class_names is missing"),
    ],
)
def test_wrong_arrays_are_named(tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    path = write(tmp_path / "a.npz", (0, three()))
    arrays = dict(np.load(path)) | change
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(rt.ReobjError, match=expected):
        recorded.read_npz(path, SIZE, SIZE)
    optional = ("mask_counts", "mask_offsets", "done")  # other tools do not write them
    arrays = {key: value for key, value in np.load(write(path, (0, three()))).items()}
    np.savez(path, **{key: value for key, value in arrays.items() if key not in optional})
    found = recorded.read_npz(path, SIZE, SIZE)
    assert found.at(0).masks is None and found.at(0).xyxy.tolist() == BOXES.tolist()
    assert found.detector_ran is None


# ---- Masks ---------------------------------------------------------------------------------------


def reference_runs(mask: BoolArray) -> list[int]:
    """Run lengths down the columns, zeros first, the slow way."""
    runs, value = [0], False
    for pixel in mask.T.ravel():
        if pixel != value:
            runs.append(0)
            value = not value
        runs[-1] += 1
    return runs


def test_run_lengths() -> None:
    rng = np.random.default_rng(0)
    made = np.stack([rng.random((7, 5)) < density for density in (0, 0.1, 0.5, 0.9, 1)])
    made[2, 0, 0], made[3, 0, 0] = True, False  # starts with a one, with a zero
    assert recorded.rle_encode(made[0]).tolist() == []  # a mask without a pixel has no runs
    wide = np.zeros((3, 4), bool)
    wide[1, 2] = True  # two columns of three, and one more row above it
    assert recorded.rle_encode(wide).tolist() == [7, 1, 4]
    for mask in made[1:]:
        assert recorded.rle_encode(mask).tolist() == reference_runs(mask)
    for mask in made:
        np.testing.assert_array_equal(recorded.rle_decode(recorded.rle_encode(mask), (5, 7)), mask)


def coco_string(runs: list[int]) -> str:
    """Compress run lengths as in maskApi.c of pycocotools."""
    text = ""
    for i, run in enumerate(runs):
        value = run - runs[i - 2] if i > 2 else run
        more = True
        while more:
            low, value = value & 0x1F, value >> 5
            more = value != (-1 if low & 0x10 else 0)
            text += chr((low | (0x20 if more else 0)) + 48)
    return text


def test_coco_strings() -> None:
    rng = np.random.default_rng(1)
    for scale in (3, 40, 5000, 2_000_000):
        runs = rng.integers(0, scale, 50).tolist()
        assert recorded.coco_runs(coco_string(runs)).tolist() == runs
    assert recorded.coco_runs("52203").tolist() == [5, 2, 2, 2, 5]  # 0 is a difference of 0, 3 of 3


def test_polygons_have_no_pixel_offset() -> None:
    """Centre and area of an ellipse; half a pixel of shift would be three times the tolerance."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = np.stack([60.3 + 30 * np.cos(angle), 50.7 + 25 * np.sin(angle)], 1)
    mask = recorded.rle_decode(recorded.polygon_runs([ring], (128, 96)), (128, 96))
    y, x = np.nonzero(mask)
    assert (x.mean() + 0.5, y.mean() + 0.5) == pytest.approx((60.3, 50.7), abs=0.15)
    assert len(x) == pytest.approx(np.pi * 30 * 25, rel=0.05)  # OpenCV fills half a pixel around


@pytest.mark.parametrize(
    ("corner", "size"),
    [((3, 2), (12, 9)), ((0, 0), (5, 7)), ((7, 2), (12, 9)), ((-2, -3), (12, 9)), ((9, 5), (12, 9)),
     ((20, 20), (12, 9)), ((-9, 0), (12, 9))],
)  # fmt: skip
def test_part_of_an_image(corner: tuple[int, int], size: tuple[int, int]) -> None:
    """Runs of a part are those of the whole mask, wherever the part lies."""
    rng = np.random.default_rng(3)
    for density in (0.0, 0.3, 1.0):
        part = rng.random((7, 5)) <= density
        whole = np.zeros((60, 60), bool)
        whole[20 + corner[1] : 27 + corner[1], 20 + corner[0] : 25 + corner[0]] = part
        expected = whole[20 : 20 + size[1], 20 : 20 + size[0]]
        assert recorded.rle_encode(part, corner, size).tolist() == (
            recorded.rle_encode(expected.copy()).tolist()
        )
