#!/usr/bin/env python3
"""Which recordings are placed in the maps of which others: own rooms, and rooms that are refused.

    python benchmarks/map_refusals.py OUT [OUT ...]

OUT are output folders of finished runs (with their videos), such as those that
`benchmarks/recordings.py` keeps. The name of a folder, or of its parent where it is called "out",
begins with the name of the room, up to the first "_". Of every ordered pair of recordings, the
first one's points are the map in which the second one is placed. Printed are the pairs of one room
that were placed, and all pairs of different rooms that were not refused.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from reobj.cameras import Poses
from reobj.files import Progress
from reobj.maps.placement import (
    ImageFeatures,
    Placement,
    image_features,
    keyframe_rows,
    place,
    points_with_descriptors,
)
from reobj.maps.room_map import MapPoints
from reobj.results.saving import load_last_poses
from reobj.results.workspace import Workspace


def recording(out: Path) -> tuple[Poses, list[ImageFeatures], MapPoints] | None:
    """Return cameras, features and described points of a run; None without cameras."""
    poses = load_last_poses(out)
    if poses is None or not poses.known.any():
        return None
    video = Workspace.open(out).video()
    with Progress("features") as line:
        features = image_features(poses, video, keyframe_rows(poses), 640, line)
    return poses, features, points_with_descriptors(poses, features)


def by_points(folders: Sequence[Path]) -> dict[tuple[str, str], Placement]:
    """Place every recording in the map of every other one by points."""
    found = {name_of(out): recording(out) for out in folders}
    known = {name: data for name, data in found.items() if data is not None}
    return {
        (one, other): place(*known[other][:2], known[one][2])
        for one, other in itertools.permutations(known, 2)
    }


def name_of(out: Path) -> str:
    """Return the name of a recording: of its folder, or of the parent where it is called "out"."""
    return (out.parent if out.name == "out" else out).name


def main() -> int:
    """Place every recording in every map."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("out", type=Path, nargs="+")
    args = parser.parse_args()
    placed = {True: 0, False: 0}
    pairs = {True: 0, False: 0}
    for (one, other), placement in by_points(args.out).items():
        same = one.split("_")[0] == other.split("_")[0]
        pairs[same] += 1
        placed[same] += not placement.refused
        if same or not placement.refused:
            counts = [f"{len(c.images)} of {c.tried}" for c in placement.components]
            how = placement.refused or "placed"
            print(f"{other} in {one}: {how} ({', '.join(counts)} images)")
    print(f"one room: {placed[True]} of {pairs[True]} pairs are placed")
    print(f"different rooms: {pairs[False] - placed[False]} of {pairs[False]} pairs are refused")
    return int(placed[False] > 0)


if __name__ == "__main__":
    sys.exit(main())
