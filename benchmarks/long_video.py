#!/usr/bin/env python3
"""Time and peak memory of `run` over the length of a video, and ratios between two lengths.

    python benchmarks/long_video.py -o OUT [--frames 600 2400 4800]

The clip of examples/room (240 frames, about 10 boxes in each) is played forwards and backwards
until it has the wanted number of frames; the boxes are given, the cameras are reconstructed. Each
length is one command in a process of its own. A clip keeps its file names and is reused.

    whole    wall time of the command, s
    poses, track, objects, write     wall times that it reports, s
    MB       largest resident size of one process, and of all together at one time
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from recordings import ROOT

ROOM = ROOT / "examples" / "room"
STAGES = ("poses", "track", "objects", "write")


def source_frames(count: int, of: int) -> Iterator[int]:
    """Yield the frame of the clip for each frame of a video that plays it back and forth."""
    there_and_back = [*range(of), *range(of - 2, 0, -1)]
    return itertools.islice(itertools.cycle(there_and_back), count)


def write_clip(folder: Path, count: int) -> None:
    """Write clip.mp4 and boxes.csv with `count` frames into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    capture = cv2.VideoCapture(str(ROOM / "room.mp4"))
    images = []
    while (read := capture.read())[0]:
        images.append(read[1])
    height, width = images[0].shape[:2]
    boxes = np.load(ROOM / "detections.npz")
    names = boxes["class_names"]
    start = np.searchsorted(boxes["frame"], np.arange(len(images) + 1))
    writer = cv2.VideoWriter(
        str(folder / "part.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height)
    )
    with open(folder / "boxes.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame", "x1", "y1", "x2", "y2", "score", "class"])
        for frame, source in enumerate(source_frames(count, len(images))):
            writer.write(images[source])
            for k in range(start[source], start[source + 1]):
                box = boxes["xyxy"][k].round(2).tolist()
                rows.writerow([frame, *box, boxes["score"][k], names[boxes["class_id"][k]]])
    writer.release()
    (folder / "part.mp4").rename(folder / "clip.mp4")


def resident_mb(root: int) -> list[float]:
    """Return the resident size of a process and of each of its descendants, MB."""
    parent = {}
    size = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        parent[int(folder.name)] = int(fields[1])
        size[int(folder.name)] = int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    family = {root}
    while more := {pid for pid, above in parent.items() if above in family} - family:
        family |= more
    return [size[pid] for pid in family if pid in size]


def measure(out: Path, count: int, options: Sequence[str]) -> dict[str, float]:
    """Run the command on a clip of `count` frames."""
    folder = out / str(count)
    if not (folder / "clip.mp4").exists():
        write_clip(folder, count)
    words = [sys.executable, str(ROOT / "reobj_track.py"), "run", "clip.mp4", "--detections"]
    words += ["boxes.csv", "-o", "out", "--overwrite", *options]
    shutil.rmtree(folder / "out", ignore_errors=True)
    samples: list[tuple[float, float]] = []  # MB of the largest process, of all
    began = time.monotonic()
    with open(folder / "log.txt", "w") as log, open(folder / "progress.txt", "w") as progress:
        process = subprocess.Popen(words, stdout=log, stderr=progress, cwd=folder)
        while process.poll() is None:
            sizes = resident_mb(process.pid) or [0.0]
            samples.append((max(sizes), sum(sizes)))
            time.sleep(0.2)
    whole = time.monotonic() - began
    if process.returncode:
        last = (folder / "progress.txt").read_text().strip().splitlines()[-1]
        raise SystemExit(f"{count} frames: exit code {process.returncode}: {last}")
    text = (folder / "log.txt").read_text()
    line = re.findall(r"^seconds: (.*)$", text, re.MULTILINE)[-1]
    seconds = dict(re.findall(r"(\w+) ([\d.]+)", re.sub(r"\([^)]*\)", "", line)))
    stages = {stage: float(seconds.get(stage, 0)) for stage in STAGES}
    largest, together = np.max(samples, axis=0)
    return {"whole": whole, **stages, "MB": largest, "MB_all": together}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure all lengths and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs="+", default=[600, 2400, 4800])
    parser.add_argument("options", nargs="*", help="further options of `run`, after --")
    args = parser.parse_args(argv)
    names = ("whole", *STAGES, "MB", "MB_all")
    found: dict[int, dict[str, float]] = {}
    titles = [*names[:-2], "MB, largest process", "MB, together"]
    print("| frames | " + " | ".join(titles) + " |\n" + "|---" * (len(names) + 1) + "|")
    for count in args.frames:
        found[count] = measure(args.out, count, args.options)
        cells = [f"{found[count][name]:.{0 if name.startswith('MB') else 1}f}" for name in names]
        print(f"| {count} | " + " | ".join(cells) + " |", flush=True)
    if {600, 2400} <= found.keys():
        ratios = [found[2400][n] / max(found[600][n], 1e-9) for n in names]
        print("| 2400 / 600 | " + " | ".join(f"{r:.1f}" for r in ratios) + " |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
