#!/usr/bin/env python3
"""Compare the masks of a segmenter with its boxes, on recordings with annotated objects.

    python benchmarks/masks.py DATA MODEL.onnx -o OUT --choosing [--only NAME...] [--noises 3]

Every frame is segmented once. `run` then gets the same detections twice, with masks and with boxes
alone. Scores, --choosing, --noises and the use of OUT are those of real_rooms.py; the cameras of
office_loop and livingroom13 are estimated, those of the others supplied. Writes OUT/masks.md and
masks.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import real_rooms
from splits import add_choosing, usable

import reobj_track as rt
from reobj.sources.detectors import open_detections

CASES = [
    real_rooms.Case("kitchen", "hololens_kitchen", supplied=True),
    real_rooms.Case("redkitchen", "redkitchen_7scenes", supplied=True),
    real_rooms.Case("office", "office_loop"),
    real_rooms.Case("livingroom", "livingroom13"),
    real_rooms.Case("studio", "studio_room", supplied=True),
]


def segment(images: Path, model: str, with_masks: Path, boxes_alone: Path) -> None:
    """Segment all images of a folder; write the detections with and without masks.

    Args:
        model: as of --detector.
    """
    video = rt.Video(images)
    source = open_detections(video, dataclasses.replace(real_rooms.DETECTOR, model=model))
    steps = ((frame.index, next(source.detect([frame]))) for frame in video)
    found = [(index, d) for index, d in steps if d is not None]
    if not any(d.masks is not None for _, d in found):
        raise SystemExit(f"error: {model} found no masks in {images}; expected a segmenter")
    alone = [(index, dataclasses.replace(d, masks=None)) for index, d in found]
    rt.write_detections_npz(boxes_alone, alone, source.class_names, video.size)
    rt.write_detections_npz(with_masks, found, source.class_names, video.size)


def main(argv: Sequence[str] | None = None) -> int:
    """Segment, run, score, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add("data", type=Path, help="folder of the recordings")
    add("model", help="segmenter, as of --detector")
    add("-o", "--out", type=Path, required=True, help="folder for the runs and the table")
    add("--only", nargs="+", default=[], metavar="NAME",
        help=f"prefixes of {', '.join(c.name for c in CASES)}")  # fmt: skip
    text = "estimate the objects N times with box noise of half a pixel, print means"
    add("--noises", type=int, default=0, metavar="N", help=text)
    add("--jobs", type=int, default=1, help="processes at once")
    add_choosing(parser)
    args = parser.parse_args(argv)
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    cases = [
        case for case in real_rooms.chosen(CASES, args.only) if usable(*case.split, args.choosing)
    ]
    compared = list[real_rooms.Case]()
    for case in cases:
        folder = args.data / case.data
        files = {kind: out / f"{case.data}-{kind}.npz" for kind in ("masks", "boxes")}
        if not files["masks"].exists():
            segment(folder / "images", args.model, files["masks"], files["boxes"])
        if case.supplied and not (out / f"poses-{case.data}").exists():
            real_rooms.write_poses(folder, out / f"poses-{case.data}")
        for kind, file in files.items():
            name = f"{case.name}-{kind}"
            compared.append(dataclasses.replace(case, name=name, boxes=str(file)))
    with real_rooms.fresh_processes(args.jobs) as pool:
        made = real_rooms.scores(pool, compared, args.data, out)
        if args.noises:
            seeds = range(1, args.noises + 1)
            made = real_rooms.scores(pool, compared, args.data, out, "", seeds)
    rows = [
        ([case.data, "supplied" if case.supplied else "own", case.name.rpartition("-")[2]], figures)
        for case, figures in zip(compared, made, strict=True)
    ]
    page = real_rooms.figures_table(["recording", "cameras", "detections"], rows) + "\n"
    print(page, end="")
    (out / "masks.md").write_text(page)
    figures_of = dict(zip((c.name for c in compared), made, strict=True))
    (out / "masks.json").write_text(json.dumps(figures_of, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
