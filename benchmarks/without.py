#!/usr/bin/env python3
"""Run the command line without one mechanism of the object stage.

    python benchmarks/without.py NAME run video.mp4 -o OUT ...

`recordings.py --without NAME` runs all recordings so; RESULTS.md says what each mechanism is worth.
"""

from __future__ import annotations

import pkgutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import quadrics
import reobj_track as rt


def nothing(*_: Any) -> None:
    """Replace a function whose result is not used."""


LIKELIHOOD = "reobj.objects.likelihood"
ASSOCIATION = "reobj.objects.association"
COMPONENT = "reobj.objects.component"
# By name: replacements of values and functions of modules.
WITHOUT: dict[str, dict[str, Any]] = {
    "occluded edges": {f"{LIKELIHOOD}.OCCLUDED_EDGES": 0.0},
    "occluded edges in the fit": {
        "quadrics.CAUCHY_OCCLUDED": quadrics.CAUCHY,
        "quadrics.HUBER_OCCLUDED": quadrics.HUBER,
        "quadrics.OCCLUDED_CAP": quadrics.OUTLIER_CAP,
    },
    "edges above the floor": {"reobj.objects.observations.ABOVE_FLOOR": np.inf},
    "widening": {f"{ASSOCIATION}.WIDENING_ROUNDS": 0},
    "limit of a box": {f"{LIKELIHOOD}.MAX_BOX_EXISTENCE": 8.0},
    "classes": {f"{LIKELIHOOD}.CLASS_KEPT": 0.0},
    "missed frames": {f"{ASSOCIATION}.MISSED": 0.0},
    "tracklets": {f"{ASSOCIATION}.SAME_TRACKLET": 0.0},
    "clear detections in refits": {f"{ASSOCIATION}.UNAMBIGUOUS_MARGIN": -1e3},
    "alternation": {f"{ASSOCIATION}.MAX_ROUNDS": 0},
    "merging": {f"{ASSOCIATION}.MERGE_DISTANCE": 0.0},
    "distances along rays": {"reobj.objects.component.DEPTHS": np.empty(0)},
    "points in the fit": {"reobj.objects.fit.points_on": nothing},
    "duplicate boxes": {f"{COMPONENT}.DUPLICATE_IOU": 2.0},
    "same position": {f"{ASSOCIATION}.SAME_POSITION": 0.0},
    "quartic size prior": {"quadrics.SIZE_WALL": 1e3},
    "tie of round objects": {"quadrics.ROUND_LOG": 1e3},
    "pooled noise": {"quadrics.OBJECT_NOISE_DOF": 1e-3},
}


def leave_out(name: str) -> None:
    """Switch a mechanism off, in this process."""
    for path, value in WITHOUT[name].items():
        owner, _, attribute = path.rpartition(".")
        values: dict[str, Any] = vars(pkgutil.resolve_name(owner))
        if attribute not in values:
            raise SystemExit(f"error: {name}: {path} is no longer there")
        values[attribute] = value


if __name__ == "__main__":
    leave_out(sys.argv[1])
    raise SystemExit(rt.main(sys.argv[2:]))
