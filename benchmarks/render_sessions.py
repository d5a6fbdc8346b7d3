#!/usr/bin/env python3
"""Render several recordings of one furnished room, between which objects move, go and come.

    python benchmarks/render_sessions.py -o DIR --seed 7 --sessions 3 --frames 240

writes DIR/session1, DIR/session2, ..., each with the files of render_room.py, and
DIR/changes.json: the difference of each session to the first and to the one before. All sessions
share one room frame, in which `poses.txt` and `gt_objects.json` are given. An object has the same
number in all sessions, and identical objects have different numbers.

Between two sessions, about a third of the objects change: half of the changes are moves (0.3 to
2 m on the floor, or elsewhere on a table or on another table; at least one move is that of one of
several identical objects if there are any), a quarter are removals and a quarter additions, some
of them objects that were taken away before. Tables and couches stay. Lamps, daylight, exposure and
white balance change too, the camera takes another path at another height, and every second session
has 1.2 times the focal length.

changes.json: `state` is stayed, moved, gone, new (not present in the session compared with, nor
earlier) or returned (not present in it, but earlier). `frames_seen` counts the frames that show at
least 20 % of the object's silhouette, `frames_seen_before` those of the session compared with, and
`frames_old_place_seen` the frames of this session that would show it if it were still at its
earlier place; where it is 0, `gone` cannot be observed.

`--foreign SEED` renders another room, that of SEED, with the same kinds of objects; `--mirror` the
room with x -> -x, with its textures; with `--light-only` no object changes. Conventions are those
of render_room.py.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rendering.config import DetectorConfig, RoomConfig
from rendering.sessions import SessionOptions, write_sessions

EXACT = DetectorConfig(
    box_sigma=0.0, miss_rate=0.0, false_positives=0.0, mask_erosion_px=0.0, score_sigma=0.0
)


def build_parser() -> argparse.ArgumentParser:
    """Options come from the config's defaults."""
    base = RoomConfig()
    parser = argparse.ArgumentParser(
        description="Render several recordings of one room, with the truth about what changed."
    )
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder to write to")
    add("--seed", type=int, default=base.seed, help="random seed")
    add("--sessions", type=int, default=2, help="recordings (default %(default)s)")
    add("--frames", type=int, default=base.frames, help="of each (default %(default)s)")
    add(
        "--size",
        default=f"{base.width}x{base.height}",
        help="WIDTHxHEIGHT in pixels (default %(default)s)",
    )
    add("--fps", type=float, default=base.fps)
    add("--zoom", type=float, default=SessionOptions().zoom,
        help="relative focal length of sessions 2, 4, ... (default %(default)s)")  # fmt: skip
    add("--foreign", type=int, metavar="SEED", help="the room of this seed, with the same objects")
    add("--mirror", action="store_true", help="mirror the room: x -> -x, textures too")
    add("--light-only", action="store_true", help="light, path and camera change, objects stay")
    add("--boxes", choices=("noisy", "exact"), default="noisy",
        help="exact: boxes and scores without noise, no false positives; strongly occluded "
        "objects are still missed")  # fmt: skip
    add("--texels", type=float, default=base.texels_per_m, help="texture resolution per metre")
    add("--crf", type=int, help="write H.264 of this quality with PyAV, e.g. 26")
    add("--png", action="store_true", help="also write every frame as PNG")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    args = build_parser().parse_args(argv)
    try:
        width, height = (int(side) for side in args.size.lower().split("x"))
        if min(width, height) < 16 or min(args.frames, args.sessions) < 1 or args.zoom <= 0:
            raise ValueError("expected e.g. --size 640x480, --frames and --sessions of at least 1")
        config = RoomConfig(
            seed=args.seed,
            width=width,
            height=height,
            frames=args.frames,
            fps=args.fps,
            plan="session",
            path="session",
            texels_per_m=args.texels,
        )
        options = SessionOptions(
            args.sessions, args.foreign, args.mirror, args.light_only, args.zoom
        )
        detector = EXACT if args.boxes == "exact" else DetectorConfig()
        counts = write_sessions(args.out, config, options, detector, args.png, args.crf)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(counts))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
