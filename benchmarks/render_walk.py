#!/usr/bin/env python3
"""Render a hand-held walk through a flat of several furnished rooms and back, with ground truth.

    python benchmarks/render_walk.py -o DIR --seed 0

writes the files of render_room.py: `room.mp4`, `detections.npz`, `gt_mot.txt`, `gt_objects.json`
(also with rooms and doors), `poses.txt` and `camera.txt`; by default 18,000 frames at 30 fps. The
rooms stand in a row along x and are joined by door openings; the world frame is that of the first
room. Identities are unique over the flat; chairs, screens, cups, plants and some more look the same
in all rooms. The camera looks around in each room, goes to the last one and returns through all of
them to its first view.

On a machine with N cores, N processes (I = 1 .. N) and then one more:

    python benchmarks/render_walk.py -o DIR --part I/N
    python benchmarks/render_walk.py -o DIR --join N

Frames depend on the options of the clip and their number only, so the parts fit; give all commands
the same options. Each process builds the flat first (a minute, 1.1 GB) and then needs about a
second per frame. `--stride 10` renders each tenth frame of the same path: a preview, whose video
has a tenth of the frame rate. Conventions are those of render_room.py.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rendering.config import RoomConfig
from rendering.parts import Clip, join_parts, write_part


def build_parser() -> argparse.ArgumentParser:
    """The options; defaults are those of a walk of ten minutes."""
    base = RoomConfig()
    parser = argparse.ArgumentParser(
        description="Render a hand-held walk through a flat and back, with ground truth."
    )
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder to write to")
    add("--seed", type=int, default=base.seed, help="random seed")
    add("--frames", type=int, default=18000, help="length of the path (default %(default)s)")
    add("--fps", type=float, default=30.0, help="frames per second (default %(default)s)")
    add("--rooms", type=int, default=4, help="rooms in a row, at least 2 (default %(default)s)")
    add("--stride", type=int, default=1, metavar="K", help="render each K-th frame of the path")
    add(
        "--size",
        default=f"{base.width}x{base.height}",
        help="WIDTHxHEIGHT in pixels (default %(default)s)",
    )
    add("--texels", type=float, default=base.texels_per_m, help="texture resolution per metre")
    add("--crf", type=int, help="write H.264 of this quality with PyAV, e.g. 26")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--part", metavar="I/N", help="render the I-th of N equal parts only")
    either.add_argument("--join", type=int, metavar="N", help="join N rendered parts")
    return parser


def part_of(text: str) -> tuple[int, int]:
    """`3/16` as numbers. Raises: ValueError for anything else, or a part that does not exist."""
    numbers = [int(n) if n.isdecimal() else 0 for n in text.split("/")]
    if len(numbers) != 2 or not 1 <= numbers[0] <= numbers[1]:
        raise ValueError(f"--part {text}: expected 1/N to N/N")
    return numbers[0], numbers[1]


def clip_of(args: argparse.Namespace) -> Clip:
    """The clip that the options ask for. Raises: ValueError for impossible numbers."""
    width, height = (int(side) for side in args.size.lower().split("x"))
    if min(width, height) < 16 or min(args.frames, args.stride) < 1 or args.fps <= 0:
        raise ValueError("expected e.g. --size 640x480, --frames and --stride of at least 1")
    config = RoomConfig(
        seed=args.seed,
        width=width,
        height=height,
        frames=args.frames,
        fps=args.fps,
        plan="flat",
        path="flat",
        texels_per_m=args.texels,
    )
    return Clip(config, args.rooms, args.stride)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    args = build_parser().parse_args(argv)
    try:
        clip = clip_of(args)
        if args.join:
            counts = join_parts(args.out, clip, args.join, args.crf)
        elif args.part:
            part, parts = part_of(args.part)
            counts = write_part(args.out, clip, part, parts, args.crf)
        else:
            counts = write_part(args.out, clip, crf=args.crf)
    except (ValueError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(counts))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
