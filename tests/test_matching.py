"""Assignment of supplied poses to frames: by number, by time, by interpolation."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reobj.cameras import invert_rigid
from reobj.poses.supplied.frame_assignment import (
    FrameAssignment,
    SourceFrames,
    by_numbers,
    interpolated,
    rows_by_time,
    source_of,
)
from reobj.sources.video import InputConfig


def rows_of(found: list[FrameAssignment]) -> dict[str, tuple[list[int], int]]:
    return {a.key: (a.row.tolist(), a.outside) for a in found}


def test_poses_between_two_times_are_interpolated() -> None:
    """Constant angular and linear velocity: a quarter of the time is a quarter of both."""
    angle = np.array([0.0, 0.4, 0.8, 1.2])
    world_from_cam = np.concatenate(
        [
            Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix(),
            np.outer(angle, [10.0, 20.0, -30.0])[:, :, None],
        ],
        2,
    )
    stamps = np.array([5.0, 5.1, 5.2, 5.4])  # the last step is too long
    times = np.array([5.025, 5.1, 5.1004, 5.15, 5.3, 4.9, 5.5]) + 1.3e9
    stamps += 1.3e9  # of Unix: a tenth of a second is no exact number
    found, at = interpolated(invert_rigid(world_from_cam), stamps, times)
    assert np.flatnonzero(at).tolist() == [0, 3]
    back = invert_rigid(found)
    np.testing.assert_allclose(back[:, :, 3], np.outer([0.1, 0.6], [10, 20, -30]), atol=1e-4)
    turn = Rotation.from_matrix(back[:, :, :3]).as_rotvec()
    np.testing.assert_allclose(turn, np.outer([0.1, 0.6], [0, 0, 1]), atol=1e-5)


def test_unknown_poses_are_not_interpolated() -> None:
    poses = np.tile(np.eye(3, 4), (3, 1, 1))
    poses[1, 0, 3] = np.nan
    _, at = interpolated(poses, np.array([0.0, 0.1, 0.2]), np.array([0.05, 0.15]))
    assert not at.any()


@pytest.mark.parametrize(
    ("stamps", "rows"),
    [
        ([0.0, 0.1, 0.2], [0, 1, 2]),
        ([0.018, 0.119, 0.219], [0, 1, 2]),  # within 20 ms
        ([0.022, 0.122, 0.222], [-1, -1, -1]),
        ([0.1], [-1, 0, -1]),
        ([0.19, 0.205], [-1, -1, 1]),  # the nearest
    ],
)
def test_times_are_matched_within_20_ms(stamps: list[float], rows: list[int]) -> None:
    found = rows_by_time(np.array(stamps), np.arange(3), np.array([0.0, 0.1, 0.2]))
    assert found.tolist() == rows


def test_of_fast_frames_a_time_matches_within_half_a_frame() -> None:
    """Every third frame of 100 a second: a neighbour that was not read is another frame."""
    frame = np.array([0, 3, 6])
    assert rows_by_time(np.array([0.004, 0.036, 0.06]), frame, frame / 100).tolist() == [0, -1, 2]


class Frames(SimpleNamespace):
    def __iter__(self):
        return (SimpleNamespace(index=i, time_s=i / 10) for i in range(9))


def test_a_fully_decoded_video_has_its_decoded_frame_count() -> None:
    for config, names, count in (
        (InputConfig(), (), 9), (InputConfig(every=2), (), 30),
        (InputConfig(stop=9), (), 30), (InputConfig(), ("a.png",) * 30, 30),
    ):  # fmt: skip
        assert (
            source_of(Frames(config=config, names=names, files=(), frame_count=30)).count == count
        )


def test_numbers_with_an_offset_from_the_images() -> None:
    from_0, from_1 = (
        SourceFrames(
            np.arange(3), np.arange(3) / 10, 3, tuple(f"{i + first}.png" for i in range(3))
        )
        for first in (0, 1)
    )
    found = rows_of(by_numbers(np.array([1, 2, 3]), from_0, "numbers"))
    assert found["number1"] == ([0, 1, 2], 0) and found["number"] == ([-1, 0, 1], 1)
    found = rows_of(by_numbers(np.array([0, 1, 2]), from_1, "numbers"))
    assert found["number0"] == ([0, 1, 2], 0) and found["number"] == ([1, 2, -1], 1)
    found = rows_of(by_numbers(np.array([1, 2, 3]), from_1, "numbers"))
    assert set(found) <= {"number", "order"} and found["number"] == ([0, 1, 2], 0)
