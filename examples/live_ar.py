#!/usr/bin/env python3
"""Live identities for an AR device: poses arrive with the frames, ellipsoids improve over time.

    python examples/live_ar.py -o OUT                       # the example clip
    python examples/live_ar.py VIDEO --poses POSES --camera fx,fy,cx,cy --detections DET -o OUT
    python examples/live_ar.py ... --state room.npz         # resume the last session

The device is simulated from a recording (video file or folder, poses in any format that `run`
takes, detections from a file or an ONNX detector); no frame is read ahead. Printed: the time per
frame (median and 95th percentile) of the tracker, embedding and fits included, and with detector.
Written: OUT/tracks.txt (MOTChallenge) and OUT/live_objects.json (ellipsoids).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import quadrics
import reobj_track as rt

ROOM = Path(__file__).resolve().parent / "room"


def live(
    args: argparse.Namespace, video: rt.Video, source: rt.DetectionSource
) -> tuple[rt.Tracker, rt.Tracks, list[tuple[float, float]]]:
    """Track frame by frame; also return the seconds of each frame in detector and tracker."""
    poses = rt.read_poses(args.poses, video, camera=args.camera)
    pose_of = dict(zip(poses.frame.tolist(), poses.cam_from_world, strict=True))
    embedder = None if args.embed == "none" else rt.Embedder(args.embed)
    resume = args.state is not None and args.state.exists()
    tracker = rt.Tracker.load(args.state, embedder) if resume else rt.Tracker(embedder=embedder)
    if args.map is not None and not resume:
        tracker.start_from(rt.RoomMap.load(args.map), source.class_names)
    frames: list[int] = []
    steps: list[rt.Tracks] = []
    seconds: list[tuple[float, float]] = []
    for frame in video:
        if args.frames and len(frames) == args.frames:
            break
        started = time.perf_counter()
        (detections,) = source.detect([frame])
        detected = time.perf_counter()
        tracker.update(
            detections,
            frame.image,
            cam_from_world=pose_of.get(frame.index),  # None: the device lost tracking
            camera=poses.camera,
        )
        seconds.append((detected - started, time.perf_counter() - detected))
        frames.append(frame.index)
        steps.append(tracker.latest)
        if len(frames) % 50 == 0:
            print(f"frame {frame.index}: {facts(tracker, seconds[-50:])}", flush=True)
    if args.state is not None:
        tracker.save(args.state)
    return tracker, rt.Tracks.concatenate(frames, steps), seconds


def facts(tracker: rt.Tracker, seconds: list[tuple[float, float]]) -> str:
    """Format the numbers of objects and the time per frame."""
    ms = 1e3 * np.array(seconds)  # (F, 2)
    (track, track95), (both, both95) = (np.percentile(x, (50, 95)) for x in (ms[:, 1], ms.sum(1)))
    located = tracker.ellipsoid_map.known.sum()
    return (
        f"{len(tracker.state.last_seen)} objects, {located} with an ellipsoid; "
        f"tracker {track:.1f} ms (95 %: {track95:.1f}), with detector {both:.1f} ({both95:.1f})"
    )


def objects_of(tracker: rt.Tracker, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Make the JSON entries of the objects whose ellipsoid is known."""
    known = np.flatnonzero(tracker.ellipsoid_map.known[: len(tracker.state.last_seen)])
    solids, _ = quadrics.Ellipsoids.from_dual_quadrics(tracker.ellipsoid_map.dual_q[known])
    return [
        {
            "id": int(tracker.state.numbers[i]),
            "category": names[tracker.state.identity_class[i]],
            "last_frame": int(tracker.state.last_seen[i]),
            "views": int((tracker.ellipsoid_map.frame[i] >= 0).sum()),
            "center_in_world": solids.center_in_world[k].round(4).tolist(),
            "half_axes": solids.half_axes[k].round(4).tolist(),
            "world_from_obj": solids.world_from_obj[k].round(6).tolist(),
        }
        for k, i in enumerate(known)
    ]


def write_mot(path: Path, tracks: rt.Tracks) -> None:
    """Write MOTChallenge rows: frame (from 1), id, left, top, width, height, score, -1, -1, -1."""
    size = tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]
    rows = np.column_stack(
        [tracks.frame + 1, tracks.track_id, tracks.xyxy[:, :2], size, tracks.score]
    )
    np.savetxt(path, rows, ("%d", "%d", *["%.2f"] * 4, "%.4f,-1,-1,-1"), ",")


def main(argv: list[str] | None = None) -> int:
    """Track the recording as a device would and write the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", nargs="?", type=Path, default=ROOM / "room.mp4")
    parser.add_argument("--poses", type=Path, default=ROOM / "poses.txt")
    parser.add_argument("--camera", default="492.7568,492.7568,320,240", help="as for run")
    parser.add_argument("--detections", type=Path, default=ROOM / "detections.npz")
    parser.add_argument("--detector", help="ONNX detector instead of recorded detections")
    parser.add_argument(
        "--embed", default="reobj", help="appearance model, as for run; none: 3D positions only"
    )
    parser.add_argument("--frames", type=int, default=0, help="stop after N frames (0: all)")
    parser.add_argument(
        "--state",
        type=Path,
        help="file of the tracker state: read if it exists, then written",
    )
    parser.add_argument("--map", type=Path, help="map of the room, in whose frame the poses are")
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args(argv)
    try:
        video = rt.Video(args.video)
        recorded = None if args.detector else args.detections
        source = rt.open_detections(video, rt.DetectConfig(model=args.detector or ""), recorded)
        tracker, tracks, seconds = live(args, video, source)
    except rt.ReobjError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    objects = objects_of(tracker, tuple(source.class_names))
    args.out.mkdir(parents=True, exist_ok=True)
    write_mot(args.out / "tracks.txt", tracks)
    (args.out / "live_objects.json").write_text(json.dumps(objects, indent=1))
    print(f"{len(seconds)} frames: {facts(tracker, seconds)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
