#!/usr/bin/env python3
"""Numbers over the parts of one recording, in which nothing moved, with one map.

    python benchmarks/map_halves.py DATA -o OUT [--only NAME ...]

The parts are run one after the other through the command line, each as a recording of its own:

    redkitchen_7scenes   two halves, own cameras
    hololens_kitchen     two halves with the cameras of the headset; the world of the second one is
                         moved by a random similarity
    hololens own         the same with own cameras in the second half
    office_loop          two parts that overlap by 20 images, own cameras
    bonsai_mip360        the three rounds, own cameras, small detector
    desk_orbit           every second image, then the others, own cameras, small detector
    sun3d                two fragments from opposite sides, supplied cameras, small detector
    mirrored             redkitchen, with the images of the second half flipped: must be refused

Printed for each part after the first: kept, stolen as in map_sessions.py (annotated objects), the
shared numbers, the number of false changes (moved or gone; nothing moved), of objects not seen and
new, and why the part was refused.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from map_sessions import read_mot, true_objects
from recordings import ROOT, image_names
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Part:
    """Images `start` to `stop` of a folder, every n-th.

    Attributes:
        images: folder in DATA. boxes: file beside the folder; "": the small detector.
        poses: cameras of the recording's file are supplied. moved: by a random similarity first.
        flipped: the images are mirrored.
    """

    images: str
    start: int = 0
    stop: int = 0
    every: int = 1
    boxes: str = "detections_yolov8s.csv"
    poses: bool = False
    moved: bool = False
    flipped: bool = False


RED = "redkitchen_7scenes/images"
HOLO = "hololens_kitchen/images"
OFFICE = "office_loop/images"
BONSAI = "bonsai_mip360/images"
SUN = "sun3d_studyroom_fragments"
CASES = {  # truth (MOTChallenge, in DATA), overlap of a true box, parts
    "redkitchen": ("redkitchen_7scenes/gt_mot.txt", 0.5, [
        Part(RED, 0, 250, 2), Part(RED, 250, 0, 2)]),
    "hololens": ("hololens_kitchen/gt_amodal.txt", 0.3, [
        Part(HOLO, 0, 190, poses=True), Part(HOLO, 190, poses=True, moved=True)]),
    "hololens own": ("hololens_kitchen/gt_amodal.txt", 0.3, [
        Part(HOLO, 0, 190, poses=True), Part(HOLO, 190)]),
    "office": ("office_loop/gt_mot.txt", 0.4, [Part(OFFICE, 0, 120), Part(OFFICE, 100)]),
    "bonsai": ("", 0.5, [Part(BONSAI, a, b, boxes="") for a, b in ((0, 98), (98, 196), (196, 0))]),
    "desk": ("", 0.5, [Part("desk_orbit/images", k, every=2, boxes="") for k in (0, 1)]),
    "sun3d": ("", 0.5, [Part(f"{SUN}/{s}/images", boxes="", poses=True) for s in ("s1", "s2")]),
    "mirrored": ("", 0.5, [Part(RED, 0, 250, 2), Part(RED, 250, 0, 2, flipped=True)]),
}  # fmt: skip


def write_poses(folder: Path, out: Path, moved: bool) -> None:
    """Write poses_c2w.txt as one NAME.pose.txt an image; `moved` by a random similarity."""
    poses = np.loadtxt(folder / "poses_c2w.txt").reshape(-1, 4, 4)
    if moved:
        rng = np.random.default_rng(1)
        turn = Rotation.random(random_state=1).as_matrix()
        scale = float(rng.uniform(0.5, 2))
        poses[:, :3, 3] = scale * poses[:, :3, 3] @ turn.T + rng.normal(0, 5, 3)
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
    out.mkdir(exist_ok=True)
    for name, pose in zip(image_names(folder), poses, strict=True):
        np.savetxt(out / f"{name}.pose.txt", pose)


def flip(folder: Path, boxes: Path, work: Path) -> tuple[Path, Path]:
    """Write mirrored images and boxes (frame, x1, y1, x2, y2, score, class); return both paths."""
    out = work / "images"
    out.mkdir(exist_ok=True)
    width = 0
    for path in sorted(folder.iterdir()):
        image = np.asarray(cv2.imread(str(path)))
        width = image.shape[1]
        cv2.imwrite(str(out / path.name), image[:, ::-1])
    header, *lines = boxes.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    flipped = [[r[0], str(width - float(r[3])), r[2], str(width - float(r[1])), *r[4:]]
               for r in rows]  # fmt: skip
    target = work / "boxes.csv"
    target.write_text("\n".join([header, *map(",".join, flipped)]) + "\n")
    return out, target


def command(part: Part, data: Path, work: Path) -> list[str]:
    """Return the words of a part's command, without output and map."""
    source = data / part.images
    boxes = source.parent / part.boxes
    if part.flipped:
        source, boxes = flip(source, boxes, work)
    words = ["run", str(source), "--every", str(part.every), "--start", str(part.start)]
    words += ["--stop", str(part.stop)] if part.stop else []
    words += ["--detections", str(boxes)] if part.boxes else ["--detector", "deimv2-femto"]
    if part.poses:
        folder = (data / part.images).parent
        write_poses(folder, work / "poses", part.moved)
        words += ["--poses", str(work / "poses"), "--camera", str(folder / "intrinsics.json")]
    return words


def score(
    result: Path, truth: Path | None, overlap: float, number_of: dict[int, int], owner: set[int]
) -> dict[str, Any]:
    """Score a part; adds its objects to `number_of` (true object -> number) and `owner`."""
    objects = json.loads((result / "objects.json").read_text())["objects"]
    located = {o["id"] for o in objects if o["status"] in ("ok", "prior_dominated")}
    row: dict[str, Any] = {"objects": len(located)}
    changes = json.loads((result / "changes.json").read_text())
    if changes["refused"]:
        return row | {"refused": changes["refused"]}
    if owner:
        row["shared"] = len(located & owner)
        row["false changes"] = len(changes["moved"]) + len(changes["gone"])
        row |= {kind: len(changes[kind]) for kind in ("new", "not_seen")}
    if truth is not None:
        found = true_objects(read_mot(result / "tracks.txt"), read_mot(truth), overlap)
        found = {track: true for track, true in found.items() if track in located}
        again = {track: true for track, true in found.items() if true in number_of}
        known = {number: true for true, number in number_of.items()}
        if owner:
            row["kept"] = (sum(number_of[true] == n for n, true in again.items()), len(again))
            row["stolen"] = [n for n, true in found.items() if known.get(n, true) != true]
        for track, true in found.items():
            number_of.setdefault(true, track)
    owner |= located
    return row


def main() -> None:
    """Run and score; print one line a part."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    args = parser.parse_args()
    data = args.data.resolve()
    for name in args.only:
        truth, overlap, parts = CASES[name]
        folder = args.out.resolve() / name.replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "room.map").unlink(missing_ok=True)
        number_of: dict[int, int] = {}
        owner: set[int] = set()
        for k, part in enumerate(parts, 1):
            work = folder / f"part{k}"
            work.mkdir(exist_ok=True)
            words = [sys.executable, str(ROOT / "reobj_track.py"), *command(part, data, work)]
            words += ["-o", str(work / "out"), "--overwrite", "--map", str(folder / "room.map"),
                      "--set", "output.overlay=none"]  # fmt: skip
            with open(work / "log.txt", "w") as log:
                subprocess.run(words, stdout=log, stderr=subprocess.STDOUT, check=True)
            row = score(work / "out", data / truth if truth else None, overlap, number_of, owner)
            print(json.dumps({"part": f"{name} {k}"} | row), flush=True)


if __name__ == "__main__":
    main()
