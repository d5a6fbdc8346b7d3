"""Estimated image motion of the camera, against known motions of synthetic images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reobj.tracking.camera_motion import CameraMotion


def textured(rng: np.random.Generator, size_hw: tuple[int, int] = (480, 640)) -> np.ndarray:
    return cv2.GaussianBlur(rng.integers(0, 256, (*size_hw, 3), dtype=np.uint8), (0, 0), 3)


def similarity(scale: float, turn_deg: float, shift: tuple[float, float]) -> np.ndarray:
    """(2, 3): x' = scale * R x + shift."""
    a = np.radians(turn_deg)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return np.c_[scale * turn, shift]


@pytest.mark.parametrize(
    ("size_hw", "truth"),
    [
        ((480, 640), similarity(1, 0, (9, -6))),
        ((480, 640), similarity(1.04, 3, (-4, 7))),  # zoom and roll
        ((220, 300), similarity(1, 0, (5, 8))),  # smaller than what is followed: not scaled
    ],
)
def test_a_known_motion_is_recovered(size_hw: tuple[int, int], truth: np.ndarray) -> None:
    image = textured(np.random.default_rng(1), size_hw)
    motion = CameraMotion()
    np.testing.assert_array_equal(motion(image), np.eye(3))
    size_wh = size_hw[::-1]
    moved = cv2.warpAffine(image, truth, size_wh, borderMode=cv2.BORDER_REFLECT)
    new_from_old = motion(moved)
    assert new_from_old.shape == (3, 3)
    corners = np.array([(x, y, 1.0) for x in (50, 250) for y in (50, 170)])
    np.testing.assert_allclose(corners @ new_from_old[:2].T, corners @ truth.T, atol=0.7)
    np.testing.assert_array_equal(motion.parallax(corners[:, :2]), np.zeros((4, 2)))  # not deep


def test_a_step_over_half_the_image() -> None:
    """Too far for optical flow: 300 by 150 px."""
    rng = np.random.default_rng(8)
    image = np.full((720, 960, 3), 128, np.uint8)
    for x, y in rng.integers(0, (960, 720), (300, 2)).tolist():
        w, h, *colour = rng.integers(10, (90, 90, 256, 256, 256)).tolist()
        cv2.rectangle(image, (x, y), (x + w, y + h), colour, -1)
    motion = CameraMotion()
    motion(image[:480, :640])
    new_from_old = motion(image[150:630, 300:940])
    np.testing.assert_allclose((new_from_old @ [400, 300, 1])[:2], [100, 150], atol=3)


@pytest.mark.parametrize(
    ("shifts", "expected"),
    [((4, 22, 10, 16), 16), ((10, 10, 10, 22), 10)],
    ids=["a deep scene: as the corners near by", "a moving object: as the background"],
)
def test_parallax_of_a_scene_with_depth(shifts: tuple[int, ...], expected: int) -> None:
    """Four bands of the image move sideways; the motion of a point in the last band."""
    image = textured(np.random.default_rng(6))
    motion = CameraMotion()
    motion(image)
    bands = zip(np.split(image, 4), shifts, strict=True)
    new_from_old = motion(np.concatenate([np.roll(band, shift, 1) for band, shift in bands]))
    at = np.array([[320.0, 440.0]])
    moved = (np.c_[at, 1] @ new_from_old.T)[:, :2] + motion.parallax(at)
    np.testing.assert_allclose(moved - at, [[expected, 0]], atol=1)
    assert motion.parallax(np.empty((0, 2))).shape == (0, 2)


def test_frames_without_texture_and_of_another_size() -> None:
    rng, motion = np.random.default_rng(3), CameraMotion()
    blank = np.full((100, 100, 3), 128, np.uint8)
    for image in (blank, blank, textured(rng, (100, 100)), textured(rng, (120, 100)), blank):
        np.testing.assert_array_equal(motion(image), np.eye(3))
