#!/usr/bin/env python3
"""Identities and cameras of recordings from one spot, through the command line.

    python benchmarks/from_one_spot.py -o OUT [--rooms 7201 ... 7208] [--data DATA] [--jobs 1]

Rendered rooms (render_room.py --plan varied --path spot) in which the camera turns twice round with
and without sway of the hand, with their recorded boxes; and tum_fr1_rpy of DATA with the default
detector. Clips and results that lie in OUT already (SEED-SWAY/, SEED-SWAY/out/) are used again.

    IDF1, switches   of `eval`
    ceiling   IDF1 of the recorded boxes that overlap a true one (IoU .5, one to one in each frame)
              with perfect identities. Projected objects, which `run` adds where a box is missing,
              can exceed it
    returns   visits of a true object after 12 or more frames out of view; kept: most of the boxes
              have the identity of most of its first visit; unlisted: one of the two has none.
              Visits without a recorded box are left out
    positions, directions   frames of the two grades with a camera, of `frames`
    rotation, max   error of the orientations after the best common rotation, median and maximum,
              deg; as ATE that of the worst component
    ATE       root mean square error of the centres after a similarity, cm; a component whose
              cameras have one position is moved only
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import numpy as np
import render_room
from map_sessions import read_mot
from recordings import ROOT
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation, Slerp
from tables import table
from truth import Array, IntArray, Output, rotation_errors, similarity

import reobj_track as rt
from reobj.results.entries import visits_of
from reobj.types import box_iou

SWAYS = (".025", "0")  # m
OUT_OF_VIEW = 12  # frames
Row = dict[str, Any]


def matches(truth: Array, found: Array) -> IntArray:
    """Pair boxes (N, 6) and (M, 6) of `read_mot` by frame, one to one, IoU >= .5: (2, P) rows."""
    pairs = [np.empty((2, 0), np.int64)]
    for frame in np.intersect1d(truth[:, 0], found[:, 0]):
        t, f = (np.flatnonzero(rows[:, 0] == frame) for rows in (truth, found))
        iou = box_iou(truth[t, 2:], found[f, 2:])
        a, b = linear_sum_assignment(-np.where(iou >= 0.5, iou, 0))
        keep = iou[a, b] >= 0.5
        pairs.append(np.stack([t[a[keep]], f[b[keep]]]))
    return np.concatenate(pairs, 1)


def score_identities(truth: Array, boxes: Array, tracks: Array) -> Row:
    """Compute the ceiling of IDF1 and the returns; boxes: recorded, all as of `matches`."""
    detected = matches(truth, boxes)[0]
    row, found = matches(truth, tracks)
    returns = kept = unlisted = 0
    for identity in np.unique(truth[:, 1]):
        own = truth[:, 1] == identity
        mains = list[int]()  # main identity of each visit, -1 without
        for start, end in visits_of(truth[own, 0].astype(np.int64), OUT_OF_VIEW):
            visit = own & (truth[:, 0] >= start) & (truth[:, 0] <= end)
            if not visit[detected].any():
                continue
            ids = tracks[found[visit[row]], 1].astype(np.int64)
            mains.append(int(np.bincount(ids).argmax()) if len(ids) else -1)
        returns += max(len(mains) - 1, 0)
        kept += sum(main == mains[0] >= 0 for main in mains[1:])
        unlisted += sum(min(main, mains[0]) < 0 for main in mains[1:])
    ceiling = 2 * len(detected) / (len(truth) + len(detected))
    return {"ceiling": ceiling, "returns": returns, "kept": kept, "unlisted": unlisted}


def parts(poses: rt.Poses, times: Array, truth: Array) -> Iterator[Row]:
    """Compare each component with TUM rows (T, 8) at the times (F,) of the source's frames."""
    turn = Slerp(truth[:, 0], Rotation.from_quat(truth[:, 4:]))
    for k in range(poses.part_count):
        known = poses.known & (poses.part == k)
        t = times[poses.frame[known]].clip(truth[0, 0], truth[-1, 0])
        if not len(t):
            continue
        cams = poses.cam_from_world[known]
        ours = -np.einsum("fji,fj->fi", cams[:, :, :3], cams[:, :, 3])
        true = np.column_stack([np.interp(t, truth[:, 0], truth[:, i]) for i in (1, 2, 3)])
        aligned = np.broadcast_to(true.mean(0), true.shape)  # of one position
        if np.ptp(ours, axis=0).any():
            scale, rotation, shift = similarity(ours, true)
            aligned = scale * ours @ rotation.T + shift
        off = rotation_errors(cams, turn(t).inv().as_matrix())
        grade = "directions" if poses.direction_sigma[k] else "positions"
        ate = 100 * np.sqrt(((aligned - true) ** 2).sum(1).mean())
        yield {"grade": grade, "frames": len(t), "rotation": np.median(off), "max": off.max(),
               "ATE": ate}  # fmt: skip


def tool(*words: object) -> None:
    """Run the command line. Raises: SystemExit with its last line if it fails."""
    command = [sys.executable, str(ROOT / "reobj_track.py"), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr.strip().splitlines()[-1:]}")


def run(source: Path, out: Path, *options: object) -> rt.Poses:
    """Run a recording unless it has a result; return its cameras."""
    if not (out / "objects.json").exists():
        tool("run", source, "-o", out, "--set", "output.overlay=none", *options)
    return cast(rt.Poses, rt.Result.load(out).poses)


def room(folder: Path) -> Row:
    """Render OUT/SEED-SWAY, run it, score it."""
    seed, _, sway = folder.name.partition("-")
    if not (folder / "gt_objects.json").exists():  # written after the video
        words = f"--seed {seed} --sway {sway} --frames 240 --plan varied --path spot --crf 22"
        render_room.main([*words.split(), "-o", str(folder)])
    out = folder / "out"
    poses = run(folder / "room.mp4", out, "--detections", folder / "detections.npz")
    tool("eval", out, "--gt", folder / "gt_mot.txt")
    scores = json.loads((out / "eval.json").read_text())["tracks"]["all"]
    recorded = np.load(folder / "detections.npz")
    boxes = np.column_stack([recorded["frame"] + 1, recorded["frame"], recorded["xyxy"]])
    truth, tracks = (read_mot(path) for path in (folder / "gt_mot.txt", out / "tracks.txt"))
    true_poses = np.loadtxt(folder / "poses.txt")
    found = list(parts(poses, true_poses[:, 0], true_poses))
    print(folder.name, file=sys.stderr, flush=True)
    worst = {key: max((part[key] for part in found), default=np.nan)
             for key in ("rotation", "max", "ATE")}  # fmt: skip
    frames = {grade: sum(part["frames"] for part in found if part["grade"] == grade)
              for grade in ("positions", "directions")}  # fmt: skip
    return {
        "room": seed, "sway": sway, "IDF1": scores["IDF1"], "switches": scores["IDSW"],
        **score_identities(truth, boxes, tracks), **frames, "frames": len(true_poses), **worst,
    }  # fmt: skip


MEANS = {"IDF1": ".3f", "ceiling": ".3f", "rotation": ".2f", "ATE": ".1f"}
FORMATS = MEANS | {"max": ".2f"}


def show(rows: Sequence[Row]) -> str:
    """Format rows of the same keys as a table."""
    cells = ([format(row[key], FORMATS.get(key, "")) for key in row] for row in rows)
    return table(list(rows[0]) if rows else [], cells)


def with_means(rows: Sequence[Row]) -> list[Row]:
    """Add for each sway the means, sums of counts and the largest maximum."""
    lines = list[Row]()
    for sway in dict.fromkeys(row["sway"] for row in rows):
        own = [row for row in rows if row["sway"] == sway]
        how = dict.fromkeys(MEANS, np.nanmean) | {"max": np.nanmax}
        values = {k: how.get(k, np.sum)([row[k] for row in own]) for k in [*own[0]][2:]}
        lines += [*own, {"room": "**all**", "sway": sway} | values]
    return lines


def tum(data: Path, out: Path) -> str:
    """Run tum_fr1_rpy and format its components."""
    folder = data / "tum_fr1_rpy"
    if not folder.exists():
        return f"tum_fr1_rpy: skipped, {folder} does not exist"
    poses = run(folder / "images", out)
    times = np.array(sorted(float(path.stem) for path in (folder / "images").iterdir()))
    found = parts(poses, times, np.loadtxt(folder / "groundtruth.txt"))
    listed = len(Output.read(out).objects)
    return f"\ntum_fr1_rpy: {listed} listed identities for about 15 objects\n\n{show(list(found))}"


def main() -> None:
    """Print the tables."""
    style = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--rooms", type=int, nargs="*", default=list(range(7201, 7209)))
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--jobs", type=int, default=1, help="rooms at once (default 1)")
    args = parser.parse_args()
    folders = [args.out / f"{seed}-{sway}" for seed in args.rooms for sway in SWAYS]
    with ThreadPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(room, folders))
    print(show(with_means(rows)))
    print(tum(args.data, args.out / "tum_fr1_rpy"))


if __name__ == "__main__":
    main()
