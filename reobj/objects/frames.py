"""Choose the frames of a long video whose detections carry new evidence about its objects.

Detections of nearly equal views repeat their errors: an object is detected, missed or occluded in
the same way. Objects of a long video are therefore associated on frames that differ in their view
of the objects; the detections of the other frames are assigned to the objects found.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from reobj.cameras import Poses, place_of, undistort_boxes, viewing_rays
from reobj.types import BoolArray, IntArray, Tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOptions:
    """How many frames of a video are informative.

    Attributes:
        all_of: videos of at most this number of frames are used whole; of longer ones at least it.
        same_direction_deg: viewing rays of an object within this angle see it from one side.
        identity_frames: least number of chosen frames of each identity of the tracker, so that an
            object that is seen briefly has enough views.
        longest_step: frames from one chosen frame to the next: where nothing is detected, missing
            detections are evidence too.
    """

    all_of: int = 600
    same_direction_deg: float = 1.0
    identity_frames: int = 10
    longest_step: int = 30


def informative_frames(
    tracks: Tracks, poses: Poses, frames: IntArray, options: FrameOptions | None = None
) -> tuple[IntArray, BoolArray]:
    """Choose frames with new viewing directions and new identities, in the order of time.

    A frame is chosen if at least half of the identities detected in it were not seen from their
    direction in any frame chosen before, or if one of them has too few chosen frames. If these are
    few, further frames are chosen at even steps.

    Args:
        tracks: N rows with identities of the tracker, by frame. poses: of one component.
        frames: (F,) numbers to choose from, ascending, with a pose and a detector output.
    Returns:
        (K,) the chosen numbers, ascending; (N,) rows in them that show an identity from a new
        direction, or one that has too few chosen frames. If all frames are chosen, these are all
        rows of the frames.
    """
    options = options or FrameOptions()
    in_frames = np.flatnonzero(np.isin(tracks.frame, frames))
    informative = np.zeros(len(tracks), bool)
    if len(frames) <= options.all_of:
        informative[in_frames] = True
        return frames, informative
    tracks = tracks[in_frames]
    row, _ = place_of(poses, tracks.frame)
    img_from_world = (poses.camera.K @ poses.cam_from_world)[row]
    ray = viewing_rays(undistort_boxes(tracks.xyxy, poses.camera), img_from_world)
    identity = np.unique(tracks.track_id, return_inverse=True)[1]
    start = np.searchsorted(tracks.frame, frames)
    end = np.searchsorted(tracks.frame, frames, side="right")
    same = np.cos(np.radians(options.same_direction_deg))
    seen = np.full((int(identity.max(initial=-1)) + 1, 16, 3), np.nan)  # chosen rays of identities
    count = np.zeros(len(seen), np.int64)
    chosen = np.zeros(len(frames), bool)
    last = -options.longest_step
    for k in range(len(frames)):
        rows = slice(start[k], end[k])
        ids = identity[rows]
        new = ~(np.einsum("nkj,nj->nk", seen[ids], ray[rows]) > same).any(1)
        few = count[ids] < options.identity_frames
        if 2 * new.sum() <= len(ids) and not few.any() and k - last < options.longest_step:
            continue
        chosen[k] = True
        last = k
        if count[ids].max(initial=0) == seen.shape[1]:
            seen = np.concatenate([seen, np.full_like(seen, np.nan)], 1)
        seen[ids, count[ids]] = ray[rows]
        count[ids] += 1
        informative[in_frames[rows]] = new | few
    others = np.flatnonzero(~chosen)
    missing = max(options.all_of - int(chosen.sum()), 0)
    chosen[others[np.linspace(0, len(others) - 1, missing).round().astype(np.int64)]] = True
    return frames[chosen], informative


def only_frames(poses: Poses, frames: IntArray) -> Poses:
    """Remove the poses of all other frames."""
    other = ~np.isin(poses.frame, frames)[:, None, None]
    return dataclasses.replace(poses, cam_from_world=np.where(other, np.nan, poses.cam_from_world))
