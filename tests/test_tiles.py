"""Detection in tiles: tiling and merging."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj.sources.tiles import (
    detect_in_tiles,
    parse_tiles,
    tile_boxes,
)
from reobj.types import Image

SIZE = (640, 480)  # (w, h)


@pytest.mark.parametrize("text", ["2", "2x", "x2", "0x2", "9x1", "2x2x2", "-1x2", "two"])
def test_invalid_grids(text: str) -> None:
    with pytest.raises(rt.ReobjError, match="expected COLUMNSxROWS of 1 to 8, such as 2x2"):
        parse_tiles(text)


def test_no_tiles_by_default() -> None:
    assert parse_tiles(rt.DetectConfig().tiles) == (1, 1)


@pytest.mark.parametrize("grid", [(1, 1), (2, 2), (3, 2), (1, 4), (8, 8)])
def test_tiles_cover_the_image_and_overlap(grid: tuple[int, int]) -> None:
    """For odd sizes; in row order."""
    w, h = 641, 479
    tiles = tile_boxes((w, h), grid)
    assert len(tiles) == grid[0] * grid[1]
    seen = np.zeros((h, w), int)
    for x1, y1, x2, y2 in tiles.tolist():
        seen[y1:y2, x1:x2] += 1
    assert seen.min() == 1
    (across, down), side = grid, tiles[0, 2:] - tiles[0, :2]
    assert tiles[0, :2].tolist() == [0, 0] and tiles[-1, 2:].tolist() == [w, h]
    if across > 1:
        assert tiles[0, 2] - tiles[1, 0] == pytest.approx(0.25 * side[0], abs=2)
    if down > 1:
        assert tiles[0, 3] - tiles[across, 1] == pytest.approx(0.25 * side[1], abs=2)


def painter(min_px: float = 0.0, masks: bool = False) -> tuple[list[tuple[int, ...]], object]:
    """A detector of bright rectangles, which misses those below `min_px` of the image's width."""
    sizes: list[tuple[int, ...]] = []

    def detect(image: Image) -> rt.Detections:
        sizes.append(image.shape[:2])
        rows, found = [], []
        for label in np.unique(image[..., 0])[1:]:
            mask = image[..., 0] == label
            y, x = np.nonzero(mask)
            box = [x.min(), y.min(), x.max() + 1, y.max() + 1]
            if box[2] - box[0] >= min_px * image.shape[1]:
                rows.append([*box, 0.5 + label / 1000, label])
                found.append(mask)
        made = rt.Detections.from_array(rows)
        some = np.array(found, bool).reshape(-1, *image.shape[:2])
        return rt.Detections(made.xyxy, made.score, made.class_id, some if masks else None)

    return sizes, detect


def picture(*boxes: tuple[int, int, int, int]) -> Image:
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for label, (x1, y1, x2, y2) in enumerate(boxes, 1):
        image[y1:y2, x1:x2] = label
    return image


def in_tiles(detect: Any, image: Image) -> rt.Detections:
    return detect_in_tiles(lambda images: map(detect, images), image, (2, 2))


WHERE = (
    (20, 20, 60, 60),  # in one tile
    (300, 220, 340, 260),  # in the middle: in all four
    (200, 40, 500, 100),  # cut by two tiles, whole in the image only
    (0, 300, 50, 480),  # at the edge of the image: nothing cuts it
)


@pytest.mark.parametrize("masks", [False, True])
def test_every_object_is_detected_once_and_complete(masks: bool) -> None:
    sizes, detect = painter(masks=masks)
    image = picture(*WHERE)
    found = in_tiles(detect, image)
    order = np.argsort(found.class_id)
    np.testing.assert_allclose(found.xyxy[order], WHERE)
    assert found.class_id[order].tolist() == [1, 2, 3, 4]
    assert (np.diff(found.score) <= 0).all()
    assert sizes[0] == (480, 640) and len(sizes) == 5 and set(sizes[1:]) == {(275, 366)}
    assert (found.masks is not None) == masks
    if found.masks is not None:
        for mask, label in zip(found.masks, found.class_id, strict=True):
            np.testing.assert_array_equal(mask, image[..., 0] == label)


def test_small_objects_are_detected_in_tiles_only() -> None:
    """40 px of 640 are below a tenth of the width, and above it in a tile of 366."""
    _, detect = painter(min_px=0.1)
    image = picture(*WHERE)
    assert sorted(detect(image).class_id.tolist()) == [3]
    found = in_tiles(detect, image)
    assert sorted(found.class_id.tolist()) == [1, 2, 3, 4]


def test_no_detections() -> None:
    for masks in (False, True):
        found = in_tiles(painter(masks=masks)[1], picture())
        assert len(found) == 0 and found.xyxy.shape == (0, 4)
