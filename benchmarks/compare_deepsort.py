#!/usr/bin/env python3
"""Compare the identities of our tracker, DeepSORT and current trackers on the same detections.

    python benchmarks/compare_deepsort.py --peers build/peers --rooms reporting --mot mot -o OUT

Prints Markdown tables; writes OUT/compare.csv.
All sequences use the same settings. A tracker's rows are the detections that it assigned an
identity to, never predicted boxes. `whole chain` decides identities over the whole video, all
others frame by frame. Results are kept in OUT/runs: an interrupted comparison resumes; after a
change of the code or of --every give another OUT.

splits.json lists the rooms, recordings and pedestrians for reporting. All others are left out;
--choosing includes them, marked. The rows `tuned` have the best settings of a sweep over one option
of a peer after the other, on the rooms for choosing (tuned.json).

Rank-1: fraction of the returns (a true object in view again after >= 30 frames) whose first
detection is nearest, by the tracker's appearance alone, to an earlier view of the same object among
those of its class. Returns: fraction of these returns to which the tracker itself assigned the
earlier identity.

Appearance networks (folder REOBJ_MODELS): osnet_x0_25_msmt17.onnx for persons and
mobilenetv2_feat.onnx (ImageNet, as DeepSORT's own embedder) for rooms, one crop a box; "own
embedding" uses our embedder. Without images no tracker has appearance and BoT-SORT has no camera
motion. DeepSORT is deep-sort-realtime 1.3.2 (PyPI), whose gallery of a lost track fills up with
copies of the last view. Pedestrians without recorded detections get the truth with noise
(`simulated`).
"""

from __future__ import annotations

import argparse
import csv
import functools
import os
import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import render_room
from benchmark import TUNED, Array, IntArray, Options, Stream, run_tracker
from splits import MARK, SPLITS, add_choosing, held_out, room_name, usable
from tables import table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt
from reobj.evaluation.tracks import return_ranks, score_tracks
from reobj.evaluation.truth import LabelledBoxes, labelled, read_truth
from reobj.files import atomic
from reobj.sources.tables import read_mot_rows
from reobj.sources.weights import IMAGENET_MEAN, IMAGENET_STD, onnx_session
from reobj.types import Image

Embedded = list[Array]  # embeddings of every frame's detections
KITCHEN = ("chair", "dining table", "cup")  # what redkitchen's truth knows


@dataclass(frozen=True, slots=True)
class Sequence:
    """One video: detections of all frames, truth, and where its images are (None: no images);
    of the images only every n-th counts.
    """

    name: str
    group: str
    detections: list[rt.Detections]
    truth: LabelledBoxes
    images: Path | None
    every: int = 1
    held_out: bool = False  # for reporting

    def video(self) -> rt.Video:
        """The images that count."""
        assert self.images is not None
        return rt.Video(self.images, rt.InputConfig(every=self.every))


# ---- Sequences ---------------------------------------------------------------------------------


def split_frames(frame: IntArray, rows: Array, count: int) -> list[rt.Detections]:
    """Rows x1, y1, x2, y2, score, class (N, 6) with 0-based frames (N,) as one set a frame."""
    return [rt.Detections.from_array(rows[frame == f]) for f in range(count)]


def mot_sequence(name: str, det: Path, gt: Path, images: Path | None = None) -> Sequence:
    """A MOTChallenge sequence: pedestrians, class 0."""
    truth = read_truth(gt, rt.COCO_NAMES, 0.0)
    out = held_out("pedestrians", name)
    if not det.exists():
        return Sequence(name, "pedestrians", simulated(gt), truth, None, held_out=out)
    rows = read_mot_rows(det)
    frames = int(max(truth.frame.max(), rows[:, 0].max()))
    boxes = np.c_[rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6], rows[:, 6].clip(0, 1), 0 * rows[:, 0]]
    found = split_frames(rows[:, 0].astype(np.int64) - 1, boxes, frames)
    return Sequence(name, "pedestrians", found, truth, images, held_out=out)


def simulated(gt: Path) -> list[rt.Detections]:
    """Boxes of pedestrians as a detector might find them, from MOT17's truth.

    Found with the probability of what is visible of them, at most .95; corners off by 4 % of the
    size; score .3 to .9 by visibility; one box in twenty is a false positive.
    """
    rows = np.loadtxt(gt, delimiter=",")
    rows, rng = rows[(rows[:, 7] == 1) & (rows[:, 6] == 1)], np.random.default_rng(len(rows))
    frames, visible = int(rows[:, 0].max()), rows[:, 8]
    rows = rows[rng.random(len(rows)) < visible.clip(max=0.95)]
    size = np.tile(rows[:, 4:6], 2)
    boxes = np.c_[rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]]
    boxes = boxes + 0.04 * size * rng.normal(size=boxes.shape)
    score = (0.3 + 0.6 * rows[:, 8] + 0.05 * rng.normal(size=len(rows))).clip(0.05, 0.99)
    frame = rows[:, 0].astype(np.int64) - 1
    wrong = rng.choice(len(rows), len(rows) // 20)  # a box of another frame and a low score
    frame = np.r_[frame, rng.permutation(frame[wrong])]
    boxes, score = np.r_[boxes, boxes[wrong]], np.r_[score, rng.uniform(0.2, 0.5, len(wrong))]
    return split_frames(frame, np.c_[boxes, score, 0 * score], frames)


def mot_sequences(folder: Path) -> list[Sequence]:
    """All sequences of the folder; of MOT17 those that are no videos of MOT15 as well."""
    result = []
    for seq in sorted((folder / "MOT15-train").iterdir()):
        images = folder / seq.name / "img1"
        files = (seq / "det" / "det_sort_frcnn.txt", seq / "gt" / "gt.txt")
        result.append(mot_sequence(seq.name, *files, images if images.is_dir() else None))
    pets = folder / "PETS-S3-MF1"
    pets_files = (pets / "det" / "det.txt", pets / "gt" / "gt.txt")
    result.append(mot_sequence("PETS-S3-MF1", *pets_files, pets / "img1"))
    for name in ("MOT17-11", "MOT17-13"):  # 02, 05, 09, 10: Venice-2, ETH-Pedcross2, ADL-Rundle
        seq = folder / "MOT17-train" / name
        result.append(mot_sequence(name, seq / "det" / "det.txt", seq / "gt" / "gt.txt"))
    return result


def kitchen_sequence(folder: Path) -> Sequence:
    """A recording with detections_yolov8s.csv and gt_mot.txt of some classes."""
    truth = read_truth(folder / "gt_mot.txt", rt.COCO_NAMES, 0.0)
    rows = np.loadtxt(folder / "detections_yolov8s.csv", delimiter=",")
    rows = rows[np.isin(rows[:, 6], [rt.COCO_NAMES.index(n) for n in KITCHEN])]
    count = len(list((folder / "images").iterdir()))
    found = split_frames(rows[:, 0].astype(np.int64), rows[:, 1:], count)
    out = held_out("recordings", folder.name)
    truth = truth[np.isin(truth.name, KITCHEN)]
    return Sequence(folder.name, "rooms", found, truth, folder / "images", held_out=out)


def room_sequence(folder: Path) -> Sequence:
    """A room of render_room.py."""
    video = rt.Video(folder / "room.mp4")
    recorded = rt.read_detections(folder / "detections.npz", video)
    found = [recorded.at(f) for f in range(len(list(video)))]
    truth = read_truth(folder / "gt_mot.txt", recorded.class_names, 0.0)
    name, images = room_name(folder), folder / "room.mp4"
    return Sequence(f"room {name}", "rooms", found, truth, images, held_out=held_out("rooms", name))


def thinned(seq: Sequence, every: int) -> Sequence:
    """Only every n-th frame: wide steps."""
    if every == 1:
        return seq
    truth = seq.truth[(seq.truth.frame - 1) % every == 0]
    truth = replace(truth, frame=(truth.frame - 1) // every + 1)
    name, group = (f"{x}, every {every}th frame" for x in (seq.name, seq.group))
    found = seq.detections[::every]
    return replace(seq, name=name, group=group, detections=found, truth=truth, every=every)


def marked(seq: Sequence) -> Sequence:
    """Mark a sequence that is not held out, and its group."""
    if seq.held_out:
        return seq
    return replace(seq, name=seq.name + MARK, group=seq.group + MARK)


# ---- Appearance --------------------------------------------------------------------------------


class CropNet:
    """Unit rows from one crop a box, as DeepSORT does: resized, ImageNet mean and deviation."""

    def __init__(self, path: Path) -> None:
        self.session = onnx_session(path, 1)
        entry = self.session.get_inputs()[0]
        self.name, shape = entry.name, entry.shape
        self.size = tuple(s if isinstance(s, int) else 128 for s in shape[:1:-1])  # width, height

    def __call__(self, image: Image, found: rt.Detections) -> Array:
        crops = []
        for x1, y1, x2, y2 in found.xyxy.round().astype(int):
            part = image[max(y1, 0) : max(y2, y1 + 1, 1), max(x1, 0) : max(x2, x1 + 1, 1)]
            part = part if part.size else image[-1:, -1:]
            crops.append(cv2.resize(part, self.size)[..., ::-1])
        if not crops:
            return np.empty((0, 0))
        batch = (np.array(crops, np.float64) - IMAGENET_MEAN) / IMAGENET_STD
        feed = {self.name: batch.transpose(0, 3, 1, 2).astype(np.float32)}
        out = self.session.run(None, feed)[0].astype(np.float64)
        out = out.mean((2, 3)) if out.ndim == 4 else out
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def own_embedding(image: Image, found: rt.Detections, embedder: rt.Embedder) -> Array:
    """Our embedder's foreground and background side by side."""
    if not len(found):
        return np.empty((0, 0))
    both = embedder(image, found)
    parts = [both.foreground, both.background]
    return np.asarray(np.concatenate(parts, 1) / np.sqrt(2))


def embed_all(seq: Sequence, net: Any) -> Embedded:
    """Embeddings of every frame's detections."""
    frames = zip(seq.video(), seq.detections, strict=True)
    embedded = [net(frame.image, found) for frame, found in frames]
    width = max((x.shape[1] for x in embedded if x.ndim == 2), default=0)
    return [x if len(x) else np.empty((0, width)) for x in embedded]


# ---- Running and scoring -----------------------------------------------------------------------


def stream_of(seq: Sequence, embedded: list[Array] | None) -> Stream:
    """The same detections in the benchmark's form."""
    count = [len(d) for d in seq.detections]
    frame = np.repeat(np.arange(len(count)), count)
    fields = ("xyxy", "score", "class_id")
    box, score, cls = (np.concatenate([getattr(d, k) for d in seq.detections]) for k in fields)
    rows = np.empty((len(frame), 0)) if embedded is None else np.concatenate(embedded)
    none, images = np.zeros(len(frame), np.int64), str(seq.images.resolve()) if seq.images else ""
    facts = (rows, none, none, np.empty((0, 9)), images, seq.every)
    return Stream(len(count), frame, box, score, cls, *facts)


def ours(seq: Sequence) -> IntArray:
    """Our tracker alone, frame by frame, with its own embedder where there are images."""
    tracker = rt.Tracker(None, rt.Embedder() if seq.images is not None else None)
    identity = []
    frames = iter(seq.video()) if seq.images is not None else None
    for found in seq.detections:
        tracks = tracker.update(found, None if frames is None else next(frames).image)
        ids = np.zeros(len(found), np.int64)
        ids[tracks.detection_index] = tracks.track_id
        identity.append(ids)
    return np.concatenate(identity)


def whole_chain(seq: Sequence, out: Path, poses: str) -> IntArray:
    """`run`, identities decided over the whole video."""
    assert seq.images is not None
    at = iter(seq.detections)
    config = rt.Config(
        input=rt.InputConfig(every=seq.every),
        poses=rt.PosesConfig(mode=poses),
        output=rt.OutputConfig(overlay=False, scene=False, fill_gaps=0),  # detections only
    )
    result = rt.run(
        seq.images, out / seq.name, config, detections=lambda image: next(at), overwrite=True
    )
    first = np.cumsum([0, *(len(d) for d in seq.detections)])
    identity = np.zeros(first[-1], np.int64)
    row = first[result.tracks.frame // seq.every] + result.tracks.detection_index
    identity[row] = result.tracks.track_id
    return identity


def result_boxes(seq: Sequence, identity: IntArray, stream: Stream | None = None) -> LabelledBoxes:
    """Detections with an identity; the class of an identity is the one with the most score."""
    stream = stream or stream_of(seq, None)
    kept = np.flatnonzero(identity > 0)
    ids, row = np.unique(identity[kept], return_inverse=True)
    votes = np.zeros((len(ids), len(rt.COCO_NAMES)), np.float32)
    np.add.at(votes, (row, stream.class_id[kept]), stream.score[kept])
    names = (
        "" if seq.group.startswith("pedestrians") else np.array(rt.COCO_NAMES)[votes.argmax(1)][row]
    )
    xyxy = stream.xyxy[kept]
    rows = np.c_[stream.frame[kept] + 1, identity[kept], xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]]
    return labelled(rows, names)


def joined(parts: list[LabelledBoxes]) -> LabelledBoxes:
    """Several sequences as one: frames and identities shifted apart."""
    shifted = [replace(p, frame=p.frame + 10**6 * i, identity=p.identity + 10**6 * i)
               for i, p in enumerate(parts)]  # fmt: skip
    names = ("frame", "identity", "xyxy", "name", "role")
    return LabelledBoxes(*(np.concatenate([getattr(p, k) for p in shifted]) for k in names))


def networks(seq: Sequence) -> dict[str, Any]:
    """Appearance by name for a sequence: (image, detections) -> rows."""
    if seq.images is None:
        return {}
    person = seq.group.startswith("pedestrians")
    file = "osnet_x0_25_msmt17.onnx" if person else "mobilenetv2_feat.onnx"
    path = Path(os.environ.get("REOBJ_MODELS", "models")) / file
    own = functools.partial(own_embedding, embedder=rt.Embedder())
    nets = {file.split("_")[0]: CropNet(path)} if path.exists() else {}
    return nets | {"own embedding": own}


def appearance_ranks(seq: Sequence, embedded: Callable[[], Embedded]) -> IntArray:
    """Ranks of the right object by appearance alone (`return_ranks`)."""
    stream = stream_of(seq, embedded())
    found = result_boxes(seq, 1 + np.arange(len(stream.frame)), stream)
    return return_ranks(seq.truth, found, stream.embedding)


def jobs(seq: Sequence, args: Any) -> dict[str, Callable[[], IntArray]]:
    """How to make the result of every tracker: identities (N,), 0 for none.

    `appearance NAME` gives the ranks of the returns instead.
    """
    part = functools.partial
    result: dict[str, Callable[[], IntArray]] = {"ours": part(ours, seq)}
    settings: dict[str, tuple[str, Options]] = {peer: (peer, {}) for peer in TUNED}
    settings |= {f"{peer} tuned": (peer, TUNED[peer]) for peer in TUNED if TUNED[peer]}

    def peer_run(peer: str, options: Options, embedded: Callable[[], Embedded | None]) -> IntArray:
        return run_tracker(peer, stream_of(seq, embedded()), args.peers, options)[0]

    looks: dict[str, Callable[[], Embedded | None]] = {}  # what DeepSORT sees
    for name, net in networks(seq).items():
        embedded = functools.cache(part(embed_all, seq, net))
        result[f"appearance {name}"] = part(appearance_ranks, seq, embedded)
        looks[f", {name}"] = embedded
    for label, (peer, options) in settings.items() if args.peers else ():
        if peer != "deepsort":
            result[label] = part(peer_run, peer, options, lambda: None)
        else:
            for name, embeddings in (looks or {", no appearance": lambda: None}).items():
                result[label + name] = part(peer_run, peer, options, embeddings)
    if seq.images is not None and seq.group.startswith("rooms"):
        chain = args.out / "chain"
        result["ours, whole video, no poses"] = part(whole_chain, seq, chain, "none")
        result["ours, whole chain"] = part(whole_chain, seq, chain, "auto")
    return result


def variants(seq: Sequence, args: Any) -> dict[str, IntArray]:
    """Result of every tracker on one sequence, from OUT/runs where it is there."""
    found: dict[str, IntArray] = {}
    for tracker, make in jobs(seq, args).items():
        name = re.sub(r"[^\w.()-]+", "_", f"{seq.name}-{tracker}")
        path = args.out / "runs" / f"{name}.npy"
        if not path.exists():
            print(f"{time.strftime('%H:%M:%S')} {seq.name}: {tracker}", file=sys.stderr, flush=True)
            identity = make()
            with atomic(path) as file:
                np.save(file, identity)
        found[tracker] = np.load(path)
    return found


# ---- Output ------------------------------------------------------------------------------------


def sets_of(seqs: list[Sequence]) -> dict[str, list[Sequence]]:
    """Every sequence alone, and the sequences of a kind together."""
    sets = {s.name: [s] for s in seqs}
    for group in sorted({s.group for s in seqs}):
        for images in (True, False):
            members = [s for s in seqs if s.group == group and (s.images is not None) == images]
            if len(members) > 1:
                sets[f"all {group} {'with' if images else 'without'} images"] = members
    return sets


def report(found: dict[str, dict[str, IntArray]], seqs: list[Sequence]) -> list[dict[str, Any]]:
    """One row for each tracker and sequence, and for each group of sequences together.

    A group has the scores of its sequences as one long sequence, and their least and largest.
    """
    rows: list[dict[str, Any]] = []
    for label, members in sets_of(seqs).items():
        for tracker in [t for t in found[members[0].name] if not t.startswith("appearance ")]:
            runs = [found[s.name] for s in members]
            boxes = [result_boxes(s, r[tracker]) for s, r in zip(members, runs, strict=True)]
            score = score_tracks(joined([s.truth for s in members]), joined(boxes))
            name = tracker.partition(", ")[2]
            by = f"appearance {'own embedding' if tracker.startswith('ours') else name}"
            ranks = [r[by] for r in runs if by in r]
            first = np.concatenate(ranks) == 1 if ranks else np.empty(0)
            names = {s.name for s in members}
            single = [r for r in rows if r["sequence"] in names and r["tracker"] == tracker]
            spread = {
                f"{c}_{end.__name__}": end([r[c] for r in single] or [score[c]])
                for c in SPREAD for end in (min, max)
            }  # fmt: skip
            rows.append({"sequence": label, "tracker": tracker, **score, **spread,
                         "rank1": float(first.mean()) if len(first) else float("nan")})  # fmt: skip
    return rows


SPREAD = ("HOTA", "IDF1")  # scores with the least and largest of the sequences
SCORES = ("HOTA", "DetA", "AssA", "IDF1", "MOTA")
HEAD = ("tracker", *SCORES, "IDSW", "ids per object", "ids / objects", "returns kept", "Rank-1")


def cells(row: dict[str, Any]) -> list[str]:
    """One line of a table."""
    found = {c: f"{100 * row[c]:.1f}" for c in SCORES}
    for c in SPREAD:
        if row[f"{c}_min"] < row[f"{c}_max"]:
            found[c] += f" ({100 * row[f'{c}_min']:.0f}-{100 * row[f'{c}_max']:.0f})"
    kept = f"{round(row['returns'] * row['returns_kept'])} of {row['returns']}"
    rank1 = "-" if np.isnan(row["rank1"]) else f"{100 * row['rank1']:.0f}"
    ids = [f"{row['ids_per_object']:.2f}", f"{row['identities']} / {row['gt_objects']}"]
    return [row["tracker"], *found.values(), str(row["IDSW"]), *ids, kept, rank1]


def markdown(rows: list[dict[str, Any]]) -> str:
    """One table for each sequence."""
    names = dict.fromkeys(r["sequence"] for r in rows)
    body = {n: [cells(r) for r in rows if r["sequence"] == n] for n in names}
    return "\n".join(table(HEAD, lines, f"**{n}**") for n, lines in body.items())


def rendered(names: list[str], folder: Path) -> list[Path]:
    """Rooms of render_room.py by seed, made where missing; v7: of its own plan."""
    rooms = [folder / f"room_{name}" for name in names]
    for room in rooms:
        seed, own = room.name[5:].lstrip("v"), ["--plan", "varied", "--path", "tour"]
        if not (room / "gt_mot.txt").exists() or not (room / "detections.npz").exists():
            render_room.main(["-o", str(room), "--seed", seed, *own * ("v" in room.name)])
    return rooms


def wanted(args: argparse.Namespace) -> list[Sequence]:
    """The sequences asked for that may be used, and a line for each of the others."""

    def allowed(kind: str, name: str) -> bool:
        return usable(kind, name, args.choosing)

    split = args.rooms in ("reporting", "choosing")
    names = SPLITS[args.rooms]["rooms"] if split else args.rooms.split(",")
    rooms = [name for name in names if name and allowed("rooms", name)]
    seqs = [room_sequence(p) for p in rendered(rooms, args.out / "rooms")]
    seqs += [kitchen_sequence(p) for p in args.recordings if allowed("recordings", p.name)]
    if args.mot:
        seqs += [s for s in mot_sequences(args.mot) if allowed("pedestrians", s.name)]
    return [marked(s) for s in seqs]


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", type=Path, help="folder for the peers' virtual environments")
    parser.add_argument(
        "--rooms",
        default="",
        metavar="SEEDS",
        help="seeds, e.g. 1,v900; or `reporting`, `choosing`",
    )
    parser.add_argument(
        "--recordings", type=Path, nargs="*", default=[], help="folders of recordings"
    )
    parser.add_argument("--mot", type=Path, help="folder with MOT15-train, MOT17-train ...")
    parser.add_argument("--every", type=int, default=1, help="use every n-th frame")
    add_choosing(parser)
    parser.add_argument("-o", "--out", type=Path, required=True)
    return parser


def main() -> int:
    """Run the comparison."""
    parser = make_parser()
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    seqs = wanted(args)
    if not seqs:
        parser.error("no sequences: give --rooms, --recordings or --mot with some that may be used")
    seqs = [thinned(seq, args.every) for seq in seqs]
    found = {s.name: variants(s, args) for s in seqs}
    rows = report(found, seqs)
    with atomic(args.out / "compare.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
