#!/usr/bin/env python3
"""Which recordings are placed in the maps of which others: own rooms, and rooms that are refused.

    python benchmarks/map_refusals.py OUT [OUT ...] [--objects]

OUT are output folders of finished runs (with their videos), such as those that
`benchmarks/recordings.py` keeps. The name of a folder, or of its parent where it is called "out",
begins with the name of the room, up to the first "_". Of every ordered pair of recordings, the
first one's points are the map in which the second one is placed. Printed are the pairs of one room
that were placed, and all pairs of different rooms that were not refused.

With `--objects` the map has no points, so that recordings are placed by objects alone (without
embeddings, which an output folder does not have).
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import quadrics
from reobj.cameras import Poses
from reobj.files import Progress
from reobj.maps.object_placement import place_by_objects
from reobj.maps.placement import (
    ComponentPlacement,
    ImageFeatures,
    Placement,
    PlacementOptions,
    keyframe_features,
    place,
    points_with_descriptors,
)
from reobj.maps.room_map import MapPoints, RoomMap
from reobj.maps.update import Recording, add_recording
from reobj.results.result import Result
from reobj.results.saving import load_last_poses
from reobj.results.workspace import Workspace


def recording(out: Path) -> tuple[Poses, list[ImageFeatures], MapPoints] | None:
    """Return cameras, features and described points of a run; None without cameras."""
    poses = load_last_poses(out)
    if poses is None or not poses.known.any():
        return None
    video = Workspace.open(out).video()
    features = keyframe_features(poses, video, PlacementOptions(), Progress("features"))
    return poses, features, points_with_descriptors(poses, features, 1)


def by_points(folders: Sequence[Path]) -> dict[tuple[str, str], Placement]:
    """Place every recording in the map of every other one by points."""
    found = {name_of(out): recording(out) for out in folders}
    known = {name: data for name, data in found.items() if data is not None}
    return {
        (one, other): place(*known[other][:2], known[one][2])
        for one, other in itertools.permutations(known, 2)
    }


def by_objects(folders: Sequence[Path]) -> dict[tuple[str, str], Placement]:
    """Place every recording in the map of every other one by objects."""
    results = {name_of(out): Result.load(out) for out in folders}
    results = {name: r for name, r in results.items() if r.poses is not None and r.located}
    rooms = {name: map_of(result) for name, result in results.items()}
    none = (ComponentPlacement(None, (), 1, "no points", unmatched=True),)
    placements = {}
    for one, other in itertools.permutations(results, 2):
        poses = results[other].poses
        assert poses is not None
        without = Placement(poses, none, "no points")
        placements[one, other] = place_by_objects(rooms[one], results[other], "", without)
    return placements


def map_of(result: Result) -> RoomMap:
    """Make the map of one recording, without points."""
    scale = result.world.scale or quadrics.Scale(1.0, np.inf, "none")
    facts = Recording(Path("room.map"), "", "", "", np.zeros((7, 7)), 1, 1, scale, None)
    return add_recording(RoomMap(), result, facts)[0]


def name_of(out: Path) -> str:
    """Return the name of a recording: of its folder, or of the parent where it is called "out"."""
    return (out.parent if out.name == "out" else out).name


def main() -> int:
    """Place every recording in every map."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("out", type=Path, nargs="+")
    parser.add_argument("--objects", action="store_true", help="by objects, without points")
    args = parser.parse_args()
    placed = {True: 0, False: 0}
    pairs = {True: 0, False: 0}
    method = by_objects if args.objects else by_points
    for (one, other), placement in method(args.out).items():
        same = one.split("_")[0] == other.split("_")[0]
        pairs[same] += 1
        placed[same] += not placement.refused
        if same or not placement.refused:
            counts = [f"{len(c.images)} of {c.tried}" for c in placement.components]
            how = placement.refused or f"placed by {placement.by}"
            print(f"{other} in {one}: {how} ({', '.join(counts)} images)")
    print(f"one room: {placed[True]} of {pairs[True]} pairs are placed")
    print(f"different rooms: {pairs[False] - placed[False]} of {pairs[False]} pairs are refused")
    return int(placed[False] > 0)


if __name__ == "__main__":
    sys.exit(main())
