#!/usr/bin/env python3
"""Make the pictures of docs/gallery.md: one frame of the overlay video of five real recordings.

    python benchmarks/gallery.py DATA -o docs/img    # 5 minutes

Each recording is run as recordings.py does it, with recorded boxes of YOLOv8s or the small
detector. The frame with the largest number of listed objects in view is taken. The scores are
printed. The licences of these recordings allow their pictures here (SOURCE.txt of each).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from recordings import CASES, Case, run

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt
from reobj.types import Image

SHOWN = {  # name of the case: name of the picture
    "hololens_kitchen yolov8s supplied": "gallery_kitchen.jpg",
    "studio_room yolov8s supplied": "gallery_studio.jpg",
    "office_loop yolov8s own": "gallery_office.jpg",
    "cubeslam_cabinet fast supplied": "gallery_cabinet.jpg",
    "tum_fr3 fast supplied": "gallery_desks.jpg",
}
WIDTH = 800  # px of a picture


def best_frame(result: rt.Result) -> int:
    """Return the position of the frame in the video that shows most listed objects."""
    listed = [o.id for o in result.objects if o.counted]
    rows = np.isin(result.tracks.track_id, listed)
    frames = np.unique(result.tracks.frame)
    shown = np.searchsorted(frames, result.tracks.frame[rows])
    return int(frames[np.bincount(shown, minlength=len(frames)).argmax()])


def picture(out: Path, case: Case) -> Image:
    """Read the best frame of an overlay video."""
    frame = best_frame(rt.Result.load(out))
    capture = cv2.VideoCapture(str(out / "overlay.mp4"))
    capture.set(cv2.CAP_PROP_POS_FRAMES, frame // case.every)
    known, image = capture.read()
    if not known:
        raise SystemExit(f"{out}/overlay.mp4 has no frame {frame}")
    scale = WIDTH / image.shape[1]
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=method), np.uint8)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 1 if a run fails."""
    parser = argparse.ArgumentParser(description="Make the pictures of docs/gallery.md.")
    parser.add_argument("data", type=Path, help="folder of recordings")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder to write to")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        for case in (case for case in CASES if case.name in SHOWN):
            figures = run(case, args.data.resolve(), Path(work))
            if figures["exit"]:
                print(f"{case.name}: {figures['said']}", file=sys.stderr)
                return 1
            image = picture(Path(work) / case.name.replace(" ", "_") / "out", case)
            cv2.imwrite(str(args.out / SHOWN[case.name]), image, [cv2.IMWRITE_JPEG_QUALITY, 85])
            print(case.name, {k: v for k, v in figures.items() if k not in ("exit", "said")})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
