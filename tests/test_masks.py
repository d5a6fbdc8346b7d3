"""Masks as run lengths, COCO's strings and polygons."""

from __future__ import annotations

import numpy as np
import pytest

from reobj.sources import recorded as masks
from reobj.types import BoolArray


def reference_runs(mask: BoolArray) -> list[int]:
    """Run lengths down the columns, zeros first, the slow way."""
    runs, value = [0], False
    for pixel in mask.T.ravel():
        if pixel != value:
            runs.append(0)
            value = not value
        runs[-1] += 1
    return runs


def test_runs_go_down_the_columns() -> None:
    mask = np.zeros((3, 4), bool)  # (H, W)
    mask[1, 2] = True  # two columns of three, and one more row above it
    assert masks.rle_encode(mask).tolist() == [7, 1, 4]
    assert masks.rle_encode(~mask).tolist() == [0, 7, 1, 4]  # zeros first, even if there are none
    np.testing.assert_array_equal(masks.rle_decode(np.uint32([7, 1, 4]), (4, 3)), mask)


def test_round_trip() -> None:
    rng = np.random.default_rng(0)
    made = np.stack([rng.random((7, 5)) < density for density in (0, 0.1, 0.5, 0.9, 1)])
    made[2, 0, 0], made[3, 0, 0] = True, False  # starts with a one, with a zero
    assert masks.rle_encode(made[0]).tolist() == []  # a mask without a pixel has no runs
    for mask in made[1:]:
        assert masks.rle_encode(mask).tolist() == reference_runs(mask)
    for mask in made:
        np.testing.assert_array_equal(masks.rle_decode(masks.rle_encode(mask), (5, 7)), mask)


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
        assert masks.coco_runs(coco_string(runs)).tolist() == runs
    assert masks.coco_runs("52203").tolist() == [5, 2, 2, 2, 5]  # 0 is a difference of 0, 3 of 3


def test_endless_run_lengths_are_refused() -> None:
    """They never end, and every character would take longer than the one before."""
    assert masks.coco_runs(coco_string([2**32 - 1, 5])).tolist() == [2**32 - 1, 5]
    with pytest.raises(ValueError, match="a run length of more than 35 bits"):
        masks.coco_runs("o" * 1_000_000)


@pytest.mark.parametrize("x", [float("nan"), float("inf"), 1e300, -1.1e7])
def test_polygons_beyond_any_image_are_refused(x: float) -> None:
    with pytest.raises(ValueError, match="corners that are not finite, or beyond"):
        masks.polygon_runs([[1, 2, 3, 4, 5, 6], [x, 2, 3, 4, 5, 6]], (20, 10))


def test_polygons_have_no_pixel_offset() -> None:
    """Centre and area of an ellipse; half a pixel of shift would be three times the tolerance."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = np.stack([60.3 + 30 * np.cos(angle), 50.7 + 25 * np.sin(angle)], 1)
    mask = masks.rle_decode(masks.polygon_runs([ring.ravel().tolist()], (128, 96)), (128, 96))
    y, x = np.nonzero(mask)
    assert (x.mean() + 0.5, y.mean() + 0.5) == pytest.approx((60.3, 50.7), abs=0.15)
    assert len(x) == pytest.approx(np.pi * 30 * 25, rel=0.05)  # OpenCV fills half a pixel around


def test_several_polygons_are_one_mask() -> None:
    rings = [[2, 2, 6, 2, 6, 6, 2, 6], [12, 3, 15, 3, 15, 6, 12, 6]]
    runs = [masks.polygon_runs(part, (20, 10)) for part in (rings, rings[:1], rings[1:])]
    both, first, second = (masks.rle_decode(run, (20, 10)) for run in runs)
    np.testing.assert_array_equal(both, first | second)
    assert first.any() and second.any() and not (first & second).any()


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
        assert masks.crop_runs(part, corner, size).tolist() == (
            masks.rle_encode(expected.copy()).tolist()
        )
