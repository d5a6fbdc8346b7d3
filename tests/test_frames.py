"""Choice of the frames of a long video that show something new; objects of long videos."""

from __future__ import annotations

import dataclasses

import numpy as np
from simulated import CAMERA, chair_solids, looking_at, tracks_of, unlinked

import reobj_track as rt
from reobj.objects.fit import fill, link_and_fit
from reobj.objects.observations import FrameOptions, informative_frames

STEP = 30
FEW = FrameOptions(all_of=20, longest_step=STEP)  # so that short videos count as long


def circle(angle_deg: np.ndarray) -> rt.Poses:
    """A camera at these angles of a circle of 3.5 m around the chairs, which it looks at."""
    angle = np.radians(angle_deg)
    eyes = np.stack([3.5 * np.sin(angle), -3.5 * np.cos(angle), np.full(len(angle), 1.6)], 1)
    cams = np.stack([looking_at(eye, np.array([0, 0, 0.4])) for eye in eyes])
    number = np.arange(len(angle))
    status = np.full(len(angle), "supplied")
    up = np.array([0, 0, 1.0])
    return rt.Poses(CAMERA, number, number / 30, cams, status, "user", True, up)


def chosen(
    angle_deg: np.ndarray, options: FrameOptions = FEW, chairs: tuple[int, ...] = (2,)
) -> tuple[np.ndarray, np.ndarray]:
    """Chosen frames, and rows with something new, of a circle; chair 2 is in its middle."""
    poses = circle(angle_deg)
    tracks = tracks_of(poses, 0.0)
    tracks = tracks[np.isin(tracks.track_id, chairs)]
    return informative_frames(tracks, poses, poses.frame, options)


def test_a_camera_that_circles_adds_a_frame_per_degree() -> None:
    frames, new = chosen(np.arange(0, 90, 0.1))
    assert 80 <= len(frames) <= 100
    assert set(np.diff(frames[FEW.identity_frames :]).tolist()) <= {8, 9, 10, 11, 12}
    assert new.sum() == len(frames)


def test_the_way_back_adds_nothing_but_the_longest_step() -> None:
    there = np.arange(0, 60, 0.1)
    frames, new = chosen(np.concatenate([there, there[::-1], there]), chairs=(1, 2, 3))
    back = frames[frames >= 600]
    assert len(back) <= 1200 / STEP + 1 < (frames < 600).sum()
    assert new[3 * 660 :].mean() < 0.01


def test_a_new_identity_is_chosen_until_it_has_enough_frames() -> None:
    poses = circle(np.zeros(300))
    tracks = tracks_of(poses, 0.0)
    tracks = tracks[(tracks.track_id == 1) | (tracks.frame >= 200) & (tracks.track_id == 2)]
    frames, new = informative_frames(tracks, poses, poses.frame, FEW)
    assert set(range(200, 200 + FEW.identity_frames)) <= set(frames.tolist())
    late = new & (tracks.frame >= 200)
    assert (tracks.track_id[late] == 2).all() and late.sum() == FEW.identity_frames


# ---- Objects of a long video ----


def there_and_back(times: int) -> rt.Result:
    """A clip of 300 frames that is played this often, each second time backwards.

    The tracker gives the chairs new tracklets, and the middle chair a new identity, each time.
    """
    there = np.linspace(-60, 60, 300)
    turns = [there if k % 2 == 0 else there[::-1] for k in range(times)]
    poses = circle(np.concatenate(turns))
    tracks = tracks_of(poses)
    turn = tracks.frame // 300
    tracks = dataclasses.replace(
        tracks,
        tracklet_id=tracks.tracklet_id + 3 * turn,
        track_id=np.where(tracks.track_id == 2, 4 + turn, tracks.track_id),
    )
    return unlinked(poses, tracks)


def test_a_long_video_gives_the_objects_of_a_short_one() -> None:
    short, long = (link_and_fit(there_and_back(k), rt.ObjectsConfig()) for k in (2, 6))
    assert len(long.tracks) == 3 * len(short.tracks) == 3 * 1800
    for result in (short, long):
        assert [o.class_name for o in result.objects] == ["chair"] * 3
        assert [o.status for o in result.objects] == ["ok"] * 3
        frames = len(result.tracks) // 3
        assert [o.views for o in result.objects] == [frames] * 3
        assert [o.frames_seen for o in result.objects] == [frames] * 3
        assert max(o.dropped_boxes for o in result.objects) <= 0.05 * frames
        for o, true in zip(result.objects, chair_solids().center_in_world, strict=True):
            assert o.center is not None and np.linalg.norm(o.center - true) < 0.03
        of_row = result.tracks.track_id.reshape(-1, 3)
        assert (of_row == of_row[0]).all() and len(set(of_row[0])) == 3
    assert long.fits is not None and long.fits.inlier.shape == (1800, 3)


def test_gaps_of_a_long_video_are_filled_by_projection() -> None:
    result = there_and_back(6)
    kept = (result.tracks.frame % 300 < 140) | (result.tracks.frame % 300 > 149)
    result = dataclasses.replace(result, tracks=result.tracks[kept])
    filled = fill(link_and_fit(result, rt.ObjectsConfig()), (CAMERA.width, CAMERA.height), 15)
    assert len(filled) == 3 * 1800 and (filled.score == 0).sum() == 3 * 60
