#!/usr/bin/env python3
"""The four ways to call the tracker from Python, each on the example clip.

    python examples/four_ways.py                 # all four; the supervision one if it is installed
    python examples/four_ways.py --frames 240

The first three decide identities online, with the same result. The last one runs the whole
pipeline, which may merge and split tracks after the video, and also returns 3D objects.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt

ROOM = Path(__file__).resolve().parent / "room"
DETECTIONS = ROOM / "detections.npz"  # or a function image -> detections, or an ONNX detector
Identities = list[npt.NDArray[np.int64]]  # of every frame


def loop(video: rt.Video) -> Identities:
    """1. The loop: `rt.track` yields every frame with its tracks."""
    identities = []
    for _frame, tracks in rt.track(video, DETECTIONS):
        identities.append(tracks.track_id)  # also xyxy, score, class_id, detection_index
    return identities


def arrays(video: rt.Video) -> Identities:
    """2. Arrays, frame by frame: in (N, 6) x1 y1 x2 y2 score class, out (M, 8) with identities."""
    source = rt.open_detections(video, rt.DetectConfig(), DETECTIONS)
    tracker = rt.Tracker(embedder=rt.Embedder())
    identities = []
    for frame in video:
        (detections,) = source.detect([frame])
        assert detections is not None  # the detector was run on all frames
        rows = np.column_stack([detections.xyxy, detections.score, detections.class_id])  # (N, 6)
        tracked = tracker.update(rows, frame.image).to_array()  # (M, 8)
        identities.append(tracked[:, 4].astype(np.int64))
    return identities


def supervision(video: rt.Video) -> Identities:
    """3. supervision's Detections in; out the tracked ones with `tracker_id`, masks and data."""
    import supervision as sv

    source = rt.open_detections(video, rt.DetectConfig(), DETECTIONS)
    tracker = rt.Tracker(embedder=rt.Embedder())
    identities = []
    for frame in video:
        (detections,) = source.detect([frame])
        assert detections is not None  # the detector was run on all frames
        given: Any = sv.Detections(
            xyxy=detections.xyxy,
            mask=detections.masks,
            confidence=detections.score,
            class_id=detections.class_id,
        )
        tracked: Any = tracker.update(given, frame.image).to_supervision(given)
        identities.append(np.asarray(tracked.tracker_id, np.int64))
    return identities


def chain(video: rt.Video) -> Identities:
    """4. The whole pipeline: identities, cameras and the shape of each object."""
    config = rt.Config(input=video.config, output=rt.OutputConfig(overlay=False, scene=False))
    with tempfile.TemporaryDirectory() as out:
        result = rt.run(video.source, out, config, detections=DETECTIONS)
    for found in result.objects:
        if found.center is not None and found.size_m is not None and found.status == "ok":
            width, depth, height = found.size_m
            print(f"  {found.class_name} {found.id} at {found.center.round(2)} (world units): "
                  f"{width:.2f} x {depth:.2f} x {height:.2f} m")  # fmt: skip
    tracks = result.tracks
    return [tracks.track_id[tracks.frame == frame] for frame in np.unique(tracks.frame)]


WAYS: tuple[Callable[[rt.Video], Identities], ...] = (loop, arrays, supervision, chain)


def main() -> int:
    """Run the four ways and print their numbers of boxes and identities."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=60, help="frames of the clip (default: 60)")
    args = parser.parse_args()
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=args.frames))
    for way in WAYS:
        try:
            found = np.concatenate(way(video))
        except ModuleNotFoundError as error:
            print(f"{way.__name__}: {error}; pip install supervision")
            continue
        print(f"{way.__name__}: {len(found)} tracked boxes, {len(np.unique(found))} identities")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
