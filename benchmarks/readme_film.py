#!/usr/bin/env python3
"""Make README's animated overlay, docs/img/room.webp, from the output folder of a run.

    python reobj_track.py run examples/room/room.mp4 -o OUT \
        --detections examples/room/detections.npz
    python benchmarks/readme_film.py OUT -o docs/img/room.webp

Uses every 4th frame of OUT's overlay, 480 pixels wide: below 1 MB for the example clip.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt

MOST_BYTES = 1_000_000  # pages with a heavier picture load slowly


def main(argv: Sequence[str] | None = None) -> int:
    """Write the picture; says its size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("out", type=Path, help="output folder of a run, with its overlay")
    add("-o", "--output", type=Path, default=Path("docs/img/room.webp"))
    add("--every", type=int, default=4, help="take every N-th frame")
    add("--width", type=int, default=480, help="width of the picture, px")
    add("--quality", type=int, default=50, help="WebP quality, 1 to 100")
    args = parser.parse_args(argv)
    (overlay,) = args.out.glob("overlay.*")
    video = rt.Video(overlay, rt.InputConfig(every=args.every, max_size=args.width))
    animation = cv2.Animation()
    animation.frames = [frame.image for frame in video]
    animation.durations = [round(1000 * args.every / video.fps)] * len(animation.frames)
    options = [cv2.IMWRITE_WEBP_QUALITY, args.quality]
    cv2.imwriteanimation(str(args.output), animation, options)
    size = args.output.stat().st_size
    print(f"{args.output}: {len(animation.frames)} frames, {size / 1e6:.2f} MB")
    return 0 if size < MOST_BYTES else 1


if __name__ == "__main__":
    raise SystemExit(main())
