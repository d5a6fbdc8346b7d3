#!/usr/bin/env python3
"""Run the whole chain on recordings and print one table row each (a table of docs/tracking.md).

    python examples/real_data.py FOLDER... -o OUT [--detector NAME]

A FOLDER holds `images/` (or is a video file) and, optionally, `detections_yolov8s.csv` (used unless
--detector is given), `gt_mot.txt` (identities, MOTChallenge), `poses_c2w.txt` (4x4 world_from_cam a
line) with which the reconstructed cameras are compared after a similarity alignment. Nothing is
tuned to a recording: all run with the defaults.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt
from reobj.results.evaluation import read_result, read_truth, score_tracks
from reobj.results.workspace import Workspace

ANNOTATED = ("chair", "dining table", "cup")
HEADER = (
    "| recording | frames | with pose | camera error | tracker ids | objects | ellipsoids | IDF1 | "
    "track s | poses s | objects s |\n|---|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> int:
    """Run every recording and print its row."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument(
        "--detector", default="", help="ONNX detector instead of recorded detections"
    )
    args = parser.parse_args()
    print(HEADER)
    for recording in args.recordings:
        print(
            row(recording, args.out / (recording.stem + args.detector), args.detector), flush=True
        )
    return 0


def row(recording: Path, out: Path, detector: str) -> str:
    """Run one recording and format its row."""
    source = recording / "images" if recording.is_dir() else recording
    recorded = recording / "detections_yolov8s.csv"
    detections = None if detector or not recorded.exists() else recorded
    config = rt.Config(detect=rt.DetectConfig(model=detector or rt.DetectConfig().model))
    result = rt.run(source, out, config, detections=detections)
    tracker_ids = len(np.unique(Workspace.open(out).load_last().tracks.track_id))
    poses = result.poses
    located = f"{poses.known.sum()} of {len(poses.frame)}" if poses is not None else "-"
    ellipsoids = sum(o.located for o in result.objects)
    seconds = [f"{result.seconds.get(k, float('nan')):.0f}" for k in ("track", "poses", "objects")]
    cells = [
        recording.name,
        str(len(poses.frame) if poses is not None else 0),
        located,
        camera_error(recording, poses),
        str(tracker_ids),
        str(len(result.objects)),
        str(ellipsoids),
        identity_score(recording, result),
        *seconds,
    ]
    return "| " + " | ".join(cells) + " |"


def camera_error(recording: Path, poses: rt.Poses | None) -> str:
    """Median distance of camera centres from `poses_c2w.txt` after a similarity alignment."""
    path = recording / "poses_c2w.txt"
    if poses is None or not path.exists() or poses.known.sum() < 3:
        return "-"
    truth = np.loadtxt(path).reshape(-1, 4, 4)[poses.frame[poses.known], :3, 3]  # (F, 3)
    pose = poses.cam_from_world[poses.known]
    centers = -np.einsum("fji,fj->fi", pose[:, :, :3], pose[:, :, 3])  # (F, 3)
    error = np.linalg.norm(align(centers, truth) - truth, axis=1)
    extent = np.linalg.norm(np.ptp(truth, axis=0))
    return f"{np.median(error):.3f} ({100 * np.median(error) / extent:.1f} % of the path's extent)"


def align(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Points (N, 3) after the similarity transform closest to target (Umeyama, PAMI 1991)."""
    a, b = points - points.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u @ flip @ vt, (s * np.diag(flip)).sum() / (a**2).sum()
    return np.asarray(scale * a @ rotation.T + target.mean(0))


def identity_score(recording: Path, result: rt.Result) -> str:
    """IDF1 against `gt_mot.txt`, over the classes that redkitchen annotates (Ristani et al., 2016).

    Boxes are compared within a class, at IoU .5.
    """
    path = recording / "gt_mot.txt"
    if not path.exists() or result.out is None:
        return "-"
    truth, found = read_truth(path, rt.COCO_NAMES, 0.0), read_result(result.out)
    truth, found = (boxes[np.isin(boxes.name, ANNOTATED)] for boxes in (truth, found))
    return f"{score_tracks(truth, found)['IDF1']:.3f}"


if __name__ == "__main__":
    sys.exit(main())
