"""Keyframes: number, selection, sharpness; points that are tracked or dropped."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pose_worlds import FakeVideo, textured_room

from reobj.files import Progress
from reobj.poses.keyframes import (
    MAX_FLOW,
    ImageFile,
    ResizedVideo,
    follow_points,
    pick_keyframes,
)


def rows(images, most=150, max_flow=MAX_FLOW):
    return pick_keyframes(ResizedVideo(FakeVideo(images), 640), most, max_flow)


@pytest.fixture(scope="module")
def walk():
    return textured_room(60, 0.08, size=(320, 240))[0]


def test_keyframes_are_bounded_and_the_same_every_time(walk):
    chosen = rows(walk)
    assert chosen == rows(walk) and chosen[0] == 0 and chosen[-1] == 59 and 5 < len(chosen) < 30
    for most in (3, 5, len(chosen) - 1):
        few = rows(walk, most)
        assert most / 2 <= len(few) <= most and few[0] == 0 and few[-1] == 59
        assert np.diff(few).max() <= 2 * 59 / (len(few) - 1)  # spread over the whole video
    assert rows(walk, len(chosen)) == chosen


def test_the_spacing_follows_the_flow_over_the_width():
    """3 of 240 px a frame: .12 is passed after 9 steps; from .084 on the sharpest is taken."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (480, 600, 3), np.uint8), (0, 0), 2)
    images = [np.ascontiguousarray(wall[:, 3 * i : 3 * i + 240]) for i in range(60)]
    usual, half = np.diff(rows(images))[:-1], np.diff(rows(images, max_flow=0.06))[:-1]
    assert usual.min() >= 7 and usual.max() <= 10 and half.min() >= 4 and half.max() <= 5


def test_sharp_frames_are_preferred():
    images, _ = textured_room(40, 0.08)
    blurred = [cv2.GaussianBlur(im, (0, 0), 1.5) if i % 2 else im for i, im in enumerate(images)]
    inner = rows(blurred)[1:-1]
    assert len(inner) >= 3 and all(row % 2 == 0 for row in inner)


def test_a_still_camera_has_no_more_than_first_and_last():
    assert rows(textured_room(1, 0)[0] * 90) == [0, 89]
    assert rows([]) == []


@pytest.mark.parametrize("level", [0, 255])
def test_a_textureless_image_is_no_keyframe(walk, level):
    """Before, between and after; point tracks continue after it."""
    blank = np.full_like(walk[0], level)
    assert rows([blank] * 30) == []
    assert rows([blank] * 10 + walk[:3])[0] == 10
    images = [*walk[:20], *[blank] * 3, *walk[23:], *[blank] * 4]
    chosen = np.array(rows(images))
    assert not np.isin(chosen, [20, 21, 22]).any() and chosen[-1] == 59
    assert np.diff(chosen).max() <= np.diff(rows(walk)).max() + 3


def test_a_cut_gives_a_keyframe(walk):
    assert 5 in rows([*walk[:5], *walk[40:45]])  # a cut: the corners are lost


def test_slow_motion_gives_a_keyframe_after_two_seconds():
    """7 % of the width in 130 frames: never as much flow as a keyframe needs."""
    images, _ = textured_room(130, 0.0035, size=(240, 180))
    chosen = rows(images, max_flow=0.5)
    assert 60 in chosen and len(chosen) == 4 - (129 not in chosen)


@pytest.mark.parametrize("cache_mb", [1000, 0.1])
def test_images_are_resized_and_read_again_when_memory_is_short(walk, cache_mb):
    video = FakeVideo(walk[:5])
    resized = ResizedVideo(video, 240, cache_mb)
    frames = list(resized.first_pass(Progress("test")))
    assert [f.row for f in frames] == resized.frames == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(resized.times_s, np.arange(5) / 30)
    assert frames[0].bgr.shape == (180, 240, 3) and frames[0].gray.shape == (180, 240)
    again = list(resized.grays())
    np.testing.assert_array_equal(again, [f.gray for f in frames])
    assert (again[0] is frames[0].gray) == (cache_mb == 1000)


def test_points_that_fail_the_backward_check_are_dropped():
    """The left half moves by 3 and -2 px, the right half becomes another image."""
    rng = np.random.default_rng(0)
    old, other = (
        cv2.GaussianBlur(rng.integers(0, 255, (240, 320), np.uint8), (0, 0), 2) for _ in range(2)
    )
    new = np.roll(old, (-2, 3), (0, 1))
    new[:, 160:] = other[:, 160:]
    xy = np.stack(np.meshgrid(np.arange(20, 300, 8.0), np.arange(20, 220, 8.0)), -1).reshape(-1, 2)
    ahead, kept = follow_points(old, new, xy)
    left, right = xy[:, 0] < 130, xy[:, 0] > 190
    assert kept[left].mean() > 0.97 and kept[right].mean() < 0.15
    moved = (ahead - xy)[left & kept]
    np.testing.assert_allclose(moved, np.tile([3, -2], (len(moved), 1)), atol=0.1)
    assert follow_points(old, new, np.empty((0, 2)))[1].shape == (0,)


def test_images_in_a_file_are_read_by_their_numbers(tmp_path):
    images = np.random.default_rng(0).integers(0, 255, (3, 12, 16, 3)).astype(np.uint8)
    file = ImageFile(tmp_path / "new" / "images.raw")
    for number in (5, 2, 9, 2):  # one of them again
        file.add(number, images[number % 3])
    assert file.shape == (12, 16, 3)
    for number in (9, 5, 2):
        np.testing.assert_array_equal(file[number], images[number % 3])
