#!/usr/bin/env python3
"""The four ways to call the tracker from Python, each on the example clip.

    python examples/four_ways.py                 # all four; the supervision one if it is installed
    python examples/four_ways.py --frames 240

Every way gives the same identities: the last line of each says how many.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt

ROOM = Path(__file__).resolve().parent / "room"
Identities = list[npt.NDArray[np.int64]]  # of every frame


def update(video: rt.Video, recorded: rt.RecordedDetections) -> Identities:
    """1. Our own types: `Tracker.update(detections, frame)`, once a frame."""
    tracker = rt.Tracker(embedder=rt.Embedder())
    found = []
    for frame in video:
        detections: rt.Detections = recorded.at(frame.index)
        tracks: rt.Tracks = tracker.update(detections, frame.image)
        found.append(tracks.track_id)  # beside it: xyxy, score, class_id, detection_index
    return found


def arrays(video: rt.Video, recorded: rt.RecordedDetections) -> Identities:
    """2. Arrays, as boxmot: (N, 6) x1 y1 x2 y2 score class in; (M, 8) with id and row out."""
    tracker = rt.Tracker(embedder=rt.Embedder())
    found = []
    for frame in video:
        known = recorded.at(frame.index)
        rows = np.column_stack([known.xyxy, known.score, known.class_id])  # (N, 6)
        out = tracker.update(rows, frame.image).to_array()  # (M, 8)
        found.append(out[:, 4].astype(np.int64))
    return found


def supervision(video: rt.Video, recorded: rt.RecordedDetections) -> Identities:
    """3. supervision's Detections in, the tracked ones out with `tracker_id`, masks and data."""
    import supervision as sv

    tracker = rt.Tracker(embedder=rt.Embedder())
    found = []
    for frame in video:
        known = recorded.at(frame.index)
        given: Any = sv.Detections(
            xyxy=known.xyxy, mask=known.masks, confidence=known.score, class_id=known.class_id
        )
        tracked: Any = tracker.update(given, frame.image).to_supervision(given)
        found.append(np.asarray(tracked.tracker_id, np.int64))
    return found


def generator(video: rt.Video, recorded: rt.RecordedDetections) -> Identities:
    """4. A generator over a video; a detector of yours takes the place of the file."""
    found = []
    for frame, tracks in rt.track(video, detections=ROOM / "detections.npz"):
        assert frame.image.shape[:2] == (video.working_size[1], video.working_size[0])
        found.append(tracks.track_id)
    return found


WAYS: tuple[Callable[[rt.Video, rt.RecordedDetections], Identities], ...] = (
    update,
    arrays,
    supervision,
    generator,
)


def main() -> int:
    """Run every way and print what it found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=60, help="frames of the clip (default: 60)")
    args = parser.parse_args()
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=args.frames))
    recorded = rt.read_detections(ROOM / "detections.npz", video)
    for way in WAYS:
        try:
            found = np.concatenate(way(video, recorded))
        except ModuleNotFoundError as error:
            print(f"{way.__name__}: {error}; pip install supervision")
            continue
        print(f"{way.__name__}: {len(found)} tracked boxes, {len(np.unique(found))} identities")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
