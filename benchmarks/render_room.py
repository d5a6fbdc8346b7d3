#!/usr/bin/env python3
"""Render hand-held videos of furnished rooms with exact ground truth, on the CPU.

    python benchmarks/render_room.py -o DIR --seed 0 --frames 240

writes `room.mp4`, `detections.npz` (detector-like boxes with masks), `gt_mot.txt`,
`gt_objects.json`, `poses.txt` (TUM) and `camera.txt` (COLMAP). Needs numpy and OpenCV only; same
seed, same bytes (the video file itself depends on the codec of the OpenCV build). The clip in
`examples/room` was made with `--seed 0 --frames 240 --crf 21`, that in `examples/room_later` with
`--seed 0 --plan later --path orbit --frames 60 --crf 26 --own-world`.

How it works:
  1. `make_room`: a seeded floor plan (`--plan varied --path tour`: another room, other sets of
     identical instances, another look and walk for every seed, for training); furniture made of
     textured parallelograms, discs, spheres and frustums ("patches"); procedural textures in one
     atlas; light baked by ray marching through voxels.
  2. `camera_path`: a smooth walk with hand shake that leaves its first view and returns.
  3. `render`: per patch, 1/z, s/z, t/z are linear in the pixel (quads) or follow from the
     intersection of ray and quadric (round patches); z-buffer at twice the resolution, then one
     texture and one light look-up.
  4. `photograph`: motion blur along the true image flow, exposure drift, vignette, sensor noise.
  5. `ground_truth`, `simulate_detections`, writers.

Conventions: metres, world z up; camera x right, y down, z forward; `b_from_a` maps a to b; pixels
as in COLMAP, the centre of the top-left pixel is (0.5, 0.5), pixel i spans [i, i + 1]; frames
0-based (1-based in MOT files); object frame: origin in the centre, x width, y depth (front is -y),
z height.
Axes: S patches, O objects, F frames, N samples.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rendering.config import PATHS, PLANS, RoomConfig
from rendering.writers import write_clip


def build_parser(description: str) -> argparse.ArgumentParser:
    """Options that single rooms and rooms of several sessions share."""
    base = RoomConfig()
    parser = argparse.ArgumentParser(description=description)
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder to write to")
    add("--seed", type=int, default=base.seed, help="random seed")
    add("--frames", type=int, default=base.frames, help="of each recording (default %(default)s)")
    size = f"{base.width}x{base.height}"
    add("--size", default=size, help="WIDTHxHEIGHT in pixels (default %(default)s)")
    add("--fps", type=float, default=base.fps)
    add("--crf", type=int, help="write H.264 of this quality with PyAV, e.g. 26")
    add("--png", action="store_true", help="also write every frame as PNG")
    return parser


def room_config(args: argparse.Namespace, **more: Any) -> RoomConfig:
    """Read the options of `build_parser`.

    Raises: ValueError for a size or number of frames that cannot be.
    """
    width, _, height = args.size.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and min(int(width), int(height)) >= 16) or (
        args.frames < 1
    ):
        raise ValueError(
            f"--size {args.size} --frames {args.frames}: expected e.g. 640x480, at least 16x16, "
            "and at least one frame"
        )
    return RoomConfig(args.seed, int(width), int(height), frames=args.frames, fps=args.fps, **more)


def report(make: Callable[[], Any]) -> int:
    """Print what was rendered; 0 on success, 2 on bad input."""
    try:
        print(json.dumps(make()))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    parser = build_parser("Render a hand-held video of a furnished room with ground truth.")
    add: Callable[..., Any] = parser.add_argument
    for name, choices in (("path", PATHS), ("plan", PLANS)):
        text = "; ".join(f"{choice}: {about}" for choice, about in choices.items())
        add(f"--{name}", choices=choices, default=getattr(RoomConfig(), name), help=text)
    sway = "amplitude of the translation of the hand, m (default %(default)s; 0: only rotation)"
    add("--sway", type=float, default=RoomConfig().shake_m, help=sway)
    add("--own-world", action="store_true", help="poses in a world that begins at the first camera")
    args = parser.parse_args(argv)
    return report(
        lambda: write_clip(
            args.out,
            room_config(args, path=args.path, plan=args.plan, shake_m=args.sway),
            args.png,
            args.crf,
            args.own_world,
        )
    )


if __name__ == "__main__":
    raise SystemExit(main())
