#!/usr/bin/env python3
"""Compare the output files of `run` from two checkouts of reobj_track, byte for byte.

    python benchmarks/same_results.py OLD_CHECKOUT NEW_CHECKOUT -o OUT [--data FOLDER...]

Runs both checkouts with their defaults on examples/room and on every FOLDER (with `images/` and
`detections_yolov8s.csv`), and compares every file of the output folders except `cache/` and
pycolmap's log. Only the command line in objects.json may differ. Exit code 1 if another byte
differs. Use it for refactorings that must not change a result.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

LINES_THAT_MAY_DIFFER = re.compile(rb'"command": "[^\n]*')  # in objects.json


def main() -> int:
    """Run both checkouts on every recording and print what differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--data", nargs="*", type=Path, default=[])
    args = parser.parse_args()
    room = args.new / "examples" / "room"
    recordings = [("room", room / "room.mp4", room / "detections.npz")]
    recordings += [(d.name, d / "images", d / "detections_yolov8s.csv") for d in args.data]
    differ = 0
    for name, video, detections in recordings:
        out = [args.out / f"{side}-{name}" for side in ("old", "new")]
        for checkout, folder in zip((args.old, args.new), out, strict=True):
            if not (folder / "objects.json").exists():
                run(checkout, video, detections, folder)
        faults = differences(*out)
        differ += len(faults)
        count = len(files(out[1]))
        print(f"{name}: {count} files, " + ("; ".join(faults) or "all the same"), flush=True)
    return 1 if differ else 0


def run(checkout: Path, video: Path, detections: Path, out: Path) -> None:
    """Run the command line of a checkout, from its own folder."""
    command = [sys.executable, "reobj_track.py", "run", str(video.resolve()), "-o",
               str(out.resolve()), "--detections", str(detections.resolve())]  # fmt: skip
    environment = os.environ | {"PYTHONPATH": ""}
    subprocess.run(command, cwd=checkout, env=environment, check=True, stdout=subprocess.DEVNULL)


def files(out: Path) -> dict[str, Path]:
    """Files of an output folder by their path in it, without the cache."""
    found = (path for path in sorted(out.rglob("*")) if path.is_file())
    named = {str(path.relative_to(out)): path for path in found}
    return {name: path for name, path in named.items() if not name.startswith("cache")}


def differences(old: Path, new: Path) -> list[str]:
    """Name the files that differ or stand on one side only."""
    a, b = files(old), files(new)
    faults = [f"{name}: only in {'old' if name in a else 'new'}" for name in sorted(a.keys() ^ b)]
    for name in sorted(a.keys() & b):
        one, other = (LINES_THAT_MAY_DIFFER.sub(b"", side[name].read_bytes()) for side in (a, b))
        if one != other:
            faults.append(f"{name} differs")
    return faults


if __name__ == "__main__":
    sys.exit(main())
