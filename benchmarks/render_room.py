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

from rendering.camera import TURNS_FROM_TO, camera_matrix, camera_path, look_along
from rendering.config import COCO_NAMES, NEAR_M, PATHS, PLANS, DetectorConfig, RoomConfig
from rendering.detector import simulate_detections
from rendering.ground_truth import ground_truth, project_points
from rendering.models import (
    DISC,
    FRUSTUM,
    QUAD,
    SPHERE,
    furniture_models,
    office_chair_model,
    stretched,
)
from rendering.photograph import render_clip
from rendering.plans import room_shell, varied_models, varied_plan
from rendering.raster import rasterize, render
from rendering.room import make_room, rooms_in_a_row
from rendering.surfaces import Room, Surfaces, build_surfaces, place_object, surface_points
from rendering.writers import objects_json, quaternion_xyzw, run_lengths, write_clip

__all__ = [
    "COCO_NAMES",
    "DISC",
    "FRUSTUM",
    "NEAR_M",
    "PATHS",
    "PLANS",
    "QUAD",
    "SPHERE",
    "TURNS_FROM_TO",
    "DetectorConfig",
    "Room",
    "RoomConfig",
    "Surfaces",
    "build_surfaces",
    "camera_matrix",
    "camera_path",
    "furniture_models",
    "ground_truth",
    "look_along",
    "make_room",
    "objects_json",
    "office_chair_model",
    "place_object",
    "project_points",
    "quaternion_xyzw",
    "rasterize",
    "render",
    "render_clip",
    "room_shell",
    "rooms_in_a_row",
    "run_lengths",
    "simulate_detections",
    "stretched",
    "surface_points",
    "varied_models",
    "varied_plan",
    "write_clip",
]


def build_parser() -> argparse.ArgumentParser:
    """Options come from the config's defaults."""
    base = RoomConfig()
    parser = argparse.ArgumentParser(
        description="Render a hand-held video of a furnished room with ground truth."
    )
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder to write to")
    add("--seed", type=int, default=base.seed, help="random seed")
    add("--frames", type=int, default=base.frames)
    add(
        "--size",
        default=f"{base.width}x{base.height}",
        help="WIDTHxHEIGHT in pixels (default %(default)s)",
    )
    add("--fps", type=float, default=base.fps)
    add(
        "--path",
        choices=PATHS,
        default=base.path,
        help="camera path: " + "; ".join(f"{k}: {v}" for k, v in PATHS.items()),
    )
    add(
        "--plan",
        choices=PLANS,
        default=base.plan,
        help="; ".join(f"{k}: {v}" for k, v in PLANS.items()),
    )
    add("--chairs", type=int, default=base.chairs, help="identical chairs, up to 6")
    add("--monitors", type=int, default=base.monitors)
    add("--noise", type=float, default=base.noise, help="sensor noise in grey levels")
    add(
        "--shutter",
        type=float,
        default=base.shutter,
        help="motion blur as a fraction of the frame interval",
    )
    add("--texels", type=float, default=base.texels_per_m, help="texture resolution per metre")
    add("--crf", type=int, help="write H.264 of this quality with PyAV, e.g. 26")
    add("--own-world", action="store_true", help="poses in a world that begins at the first camera")
    add("--png", action="store_true", help="also write every frame as PNG")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    args = build_parser().parse_args(argv)
    try:
        width, height = (int(side) for side in args.size.lower().split("x"))
        if width < 16 or height < 16 or args.frames < 1:
            raise ValueError
    except ValueError:
        print(
            f"error: --size {args.size} --frames {args.frames}: expected e.g. 640x480 and >= 1",
            file=sys.stderr,
        )
        return 2
    config = RoomConfig(
        seed=args.seed,
        width=width,
        height=height,
        frames=args.frames,
        fps=args.fps,
        path=args.path,
        plan=args.plan,
        chairs=args.chairs,
        monitors=args.monitors,
        noise=args.noise,
        shutter=args.shutter,
        texels_per_m=args.texels,
    )
    counts = write_clip(
        args.out, config, DetectorConfig(), args.png, args.crf, own_world=args.own_world
    )
    print(json.dumps(counts))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
