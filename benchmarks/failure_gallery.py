#!/usr/bin/env python3
"""Draw the worst identity errors of runs beside the ground truth, each with its likely cause.

    python benchmarks/failure_gallery.py OUT... --gt gt.txt... -o gallery.jpg [--classes chair,cup]

An error is a true object that has, for some frames, an identity that is not assigned to it
(`identity_map`): either a second identity (split), or the identity of another object (confusion).
The errors with the most frames come first. Each row shows the object with its correct identity, the
first frame of the error, and the object to which the identity is assigned. Thick boxes: the object
in question, in the colour of its identity; white boxes: the ground truth. Prints a Markdown table
with the causes that follow from boxes, scores and classes.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt
from reobj.results.evaluation import identity_map, matched_rows
from reobj.results.truth import LabelledBoxes, read_result, read_truth
from reobj.results.workspace import Workspace
from reobj.sources.tables import read_mot_rows
from reobj.types import Array, Image, IntArray, box_iou

WIDTH_PX, CAPTION_PX = 300, 22


@dataclass(frozen=True, slots=True)
class Case:
    """Everything about one run: truth, result, which rows of both show one object, scores."""

    truth: LabelledBoxes
    found: LabelledBoxes
    truth_row: IntArray  # (M,) matched rows
    found_row: IntArray  # (M,)
    visibility: Array  # (N,) of the truth, NaN if not in the file
    score: Array  # of the result's rows
    seen_as: npt.NDArray[np.str_]  # class of each detection, "" where unknown


@dataclass(frozen=True, slots=True)
class Error:
    """A true object with an identity that is not assigned to it.

    Attributes:
        right: identity assigned to it (None: no identity); wrong: the one it has here.
        owner: true object that `wrong` is assigned to, or None.
        pairs: rows of `Case.truth_row` (and `found_row`) where that is so, by frame.
    """

    true: int
    right: int | None
    wrong: int
    owner: int | None
    pairs: IntArray


def read_case(out: Path, gt: Path, classes: list[str]) -> Case:
    """Read an output folder of `run` or `track` and its truth."""
    tracked = Workspace.open(out).load_last()  # before linking: with the class of each detection
    truth, rows = read_truth(gt, tracked.class_names, 0.0), read_mot_rows(gt)
    visibility = rows[:, 8] if rows.shape[1] == 9 else np.full(len(rows), np.nan)
    found, score = read_result(out), rt.Result.load(out).tracks.score
    seen_as = detected_classes(found, tracked)
    if classes:
        use, keep = np.isin(truth.name, [*classes, ""]), np.isin(found.name, [*classes, ""])
        truth, visibility = truth[use], visibility[use]
        found, score, seen_as = found[keep], score[keep], seen_as[keep]
    return Case(truth, found, *matched_rows(truth, found), visibility, score, seen_as)


def detected_classes(found: LabelledBoxes, tracked: rt.Result) -> npt.NDArray[np.str_]:
    """Class of the detection of each row, "" where a gap was filled without one."""
    names, tracks = np.array([*tracked.class_names, ""]), tracked.tracks
    class_id = np.full(len(found), -1)
    for frame in np.unique(found.frame):
        rows, there = (
            np.flatnonzero(found.frame == frame),
            np.flatnonzero(tracks.frame + 1 == frame),
        )
        if len(there):
            iou = box_iou(found.xyxy[rows], tracks.xyxy[there])
            good = iou.max(1) > 0.98  # tracks.txt rounds boxes
            class_id[rows[good]] = tracks.class_id[there[iou[good].argmax(1)]]
    return np.asarray(names[class_id], np.str_)


def find_errors(case: Case) -> list[Error]:
    """All errors, those with the most frames first."""
    stands = identity_map(case.truth, case.found)
    owner = {v: k for k, v in stands.items() if v is not None}
    true, wrong = case.truth.identity[case.truth_row], case.found.identity[case.found_row]
    errors = []
    for t, w in sorted(set(zip(true.tolist(), wrong.tolist(), strict=True))):
        if stands[t] != w:
            rows = np.flatnonzero((true == t) & (wrong == w))
            order = np.argsort(case.truth.frame[case.truth_row[rows]], kind="stable")
            errors.append(Error(t, stands[t], w, owner.get(w), rows[order]))
    return sorted(errors, key=lambda e: -len(e.pairs))


def absence(case: Case, true: int, start: int) -> str:
    """How long the object had been unmatched before frame `start`, and why."""
    mine = case.truth.frame[case.truth.identity == true]
    visible = case.visibility[case.truth.identity == true]
    matched = case.truth.frame[case.truth_row][case.truth.identity[case.truth_row] == true]
    last = matched[matched < start].max(initial=-1)
    if last < 0:
        return "at first sight"
    if last == start - 1:
        return "switched while in view"
    gap = (mine > last) & (mine < start)
    away = start - last - 1 - gap.sum()
    occluded = int((visible[gap] < 0.5).sum())
    parts = [f"out of view for {away} frames"] if away else []
    if gap.any():
        parts.append(f"not detected for {gap.sum()} frames ({occluded} of them half hidden)")
    return "; ".join(parts)


def causes(case: Case, error: Error, size: tuple[int, int]) -> str:
    """Causes of the error according to boxes, scores and classes; size: of the image."""
    g, p = (int(rows[error.pairs[0]]) for rows in (case.truth_row, case.found_row))
    start, box, name = int(case.truth.frame[g]), case.truth.xyxy[g], case.truth.name[g]
    same = (case.truth.frame == start) & (case.truth.name == name)
    identical = case.truth.xyxy[same & (case.truth.identity != error.true)]
    facts = {
        absence(case, error.true, start): True,
        "cut by the border": (box[:2] < 3).any() or (box[2:] > np.array(size) - 3).any(),
        "the right identity has another box (two boxes on one object, or a swap)": error.right
        in case.found.identity[case.found.frame == start],
        f"{100 * case.visibility[g]:.0f} % visible": case.visibility[g] < 0.6,
        "low scores": np.median(case.score[case.found_row[error.pairs[:5]]]) < 0.5,
        f"seen as {case.seen_as[p]}": bool(name) and case.seen_as[p] != name,
        "overlaps its twin": len(identical) and box_iou(box[None], identical).max() > 0.2,
    }
    return "; ".join(text for text, true in facts.items() if true)


def title(case: Case, error: Error) -> str:
    """Describe the error in one line."""
    frames = case.truth.frame[case.truth_row[error.pairs]]
    name = case.truth.name[case.truth_row[error.pairs[0]]] or "object"
    what = "a second identity" if error.owner is None else f"taken for {name} {error.owner}"
    span = f"{len(frames)} frames from {frames[0]}"
    return f"{name} {error.true}: {what} (id {error.wrong}, right {error.right}), {span}"


# ---- Stills ------------------------------------------------------------------------------------


def panels(case: Case, error: Error) -> list[tuple[int, int, str]]:
    """(frame, true object, caption): right, wrong, object of the identity."""
    true, ids = case.truth.identity[case.truth_row], case.found.identity[case.found_row]
    frame = case.truth.frame[case.truth_row]
    start = int(frame[error.pairs[0]])
    result = [(start, error.true, "the error")]
    for who, identity, text in (
        (error.true, error.right, "right"),
        (error.owner, error.wrong, f"what id {error.wrong} stands for"),
    ):
        at = frame[(true == who) & (ids == identity)]
        if len(at):
            nearest = int(at[np.argmin(np.abs(at - start))])
            result.append((nearest, int(who or 0), text))
    return result


def colour(identity: int) -> tuple[int, int, int]:
    """A bright colour of an identity, BGR."""
    hsv = np.array([[[identity * 47 % 180, 200, 255]]], np.uint8)
    b, g, r = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return b, g, r


def still(case: Case, image: Image, frame: int, true: int, caption: str) -> Image:
    """One frame, all identities thin, the object in question thick, the truth white."""
    scale = WIDTH_PX / image.shape[1]
    canvas = np.asarray(cv2.resize(image, None, fx=scale, fy=scale), np.uint8)
    matched = {int(p): int(case.truth.identity[g])
               for g, p in zip(case.truth_row, case.found_row, strict=True)}  # fmt: skip
    for p in np.flatnonzero(case.found.frame == frame):
        identity, thick = int(case.found.identity[p]), 1 + 2 * (matched.get(int(p)) == true)
        x1, y1, x2, y2 = (case.found.xyxy[p] * scale).round().astype(int).tolist()
        cv2.rectangle(canvas, (x1, y1), (x2, y2), colour(identity), thick)
        put(canvas, f"id {identity}", (x1 + 2, min(y2 - 3, canvas.shape[0] - 3)), colour(identity))
    for g in np.flatnonzero((case.truth.frame == frame) & (case.truth.identity == true)):
        x1, y1, x2, y2 = (case.truth.xyxy[g] * scale).round().astype(int).tolist()
        cv2.rectangle(canvas, (x1, y1), (x2, y2), (255, 255, 255), 1)
        put(canvas, f"true {true}", (x1 + 2, max(y1 + 11, 11)), (255, 255, 255))
    put(canvas, f"frame {frame}: {caption}", (4, 12), (255, 255, 255))
    return canvas


def put(image: Image, text: str, at: tuple[int, int], bgr: tuple[int, int, int]) -> None:
    """Small text on a dark plate."""
    font = cv2.FONT_HERSHEY_SIMPLEX
    (width, height), low = cv2.getTextSize(text, font, 0.38, 1)
    x, y = at
    cv2.rectangle(image, (x - 1, y - height - 1), (x + width + 1, y + low), (30, 30, 30), -1)
    cv2.putText(image, text, at, font, 0.38, bgr, 1, cv2.LINE_AA)


def strip(name: str, case: Case, error: Error, video: rt.Video) -> tuple[Image, str]:
    """A row of stills, and the line of the table; name: of the run."""
    plan = panels(case, error)
    wanted = {f for f, _, _ in plan}
    images = {f.index + 1: f.image for f in video if f.index + 1 in wanted}
    stills = [still(case, images[f], f, true, text) for f, true, text in plan if f in images]
    height, width = images[plan[0][0]].shape[:2]
    why = causes(case, error, (width, height))
    blank = np.full_like(stills[0], 40)
    row = np.hstack([*stills, *[blank] * (3 - len(stills))])
    caption = np.full((CAPTION_PX, row.shape[1], 3), 40, np.uint8)
    put(caption, f"{name}, {title(case, error)}: {why}", (4, 15), (255, 255, 255))
    return np.vstack([caption, row]), f"| {name} | {title(case, error)} | {why} |"


def main() -> int:
    """Write the picture and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, nargs="+", help="output folders of run or track")
    parser.add_argument("--gt", type=Path, nargs="+", required=True, help="their truth (MOT)")
    parser.add_argument("-o", "--image", type=Path, required=True, help="picture to write")
    parser.add_argument("--classes", default="", help="comma-separated class names (default: all)")
    parser.add_argument("--limit", type=int, default=8, help="errors shown")
    args = parser.parse_args()
    if len(args.gt) != len(args.out):
        parser.error(f"{len(args.out)} runs, {len(args.gt)} truths: give one --gt file for each")
    classes, found = [c for c in args.classes.split(",") if c], []
    try:
        for out, gt in zip(args.out, args.gt, strict=True):
            case = read_case(out, gt, classes)
            video = rt.Video(*Workspace.open(out).source)
            found += [(out.name, case, error, video) for error in find_errors(case)]
        found.sort(key=lambda item: -len(item[2].pairs))
        strips = [strip(*item) for item in found[: args.limit]]
    except rt.ReobjError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if not strips:
        print("no identity errors")
        return 0
    width = max(picture.shape[1] for picture, _ in strips)
    wide = [
        cv2.copyMakeBorder(p, 0, 0, 0, width - p.shape[1], cv2.BORDER_CONSTANT) for p, _ in strips
    ]
    cv2.imwrite(str(args.image), np.vstack(wide), [cv2.IMWRITE_JPEG_QUALITY, 60])
    print("\n".join(["| video | error | cause |", "|---|---|---|", *(line for _, line in strips)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
