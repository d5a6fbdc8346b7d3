#!/usr/bin/env python3
"""Compare identities on the same detections: ours, DeepSORT and today's trackers.

    python examples/compare_deepsort.py --peers build/peers --rooms examples/room ... \\
        --kitchen redkitchen_7scenes --mot mot -o OUT

Writes OUT/compare.csv, OUT/compare_*.png and prints Markdown tables. The same settings for all
sequences; every tracker's rows are the detections it gave an identity to, never predicted boxes;
identities of `whole chain` are decided over the whole video, all others frame by frame.

Appearance networks (folder REOBJ_MODELS): persons osnet_x0_25_msmt17.onnx, rooms
mobilenetv2_feat.onnx (ImageNet, as DeepSORT's own embedder), one crop a box; "own look" are the
features of our embedder. Without images no tracker has appearance.
DeepSORT is deep-sort-realtime 1.3.2 (PyPI), whose gallery of a lost track fills up with copies of
the last view; `tuned` is max_age 1000, position-only gate, cosine distance .35.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmark import PEERS, Array, IntArray, Stream, run_tracker, table

sys.path.insert(0, os.environ.get("REOBJ_TRACK", str(Path(__file__).resolve().parent.parent)))
import reobj_track as rt

Run = tuple[IntArray, float]  # identity of every detection (N,), 0 for none; CPU seconds
COLUMNS = "HOTA DetA AssA IDF1 MOTA IDSW ids_per_object".split()
KITCHEN = ("chair", "dining table", "cup")  # what redkitchen's truth knows


@dataclass(frozen=True, slots=True)
class Sequence:
    """One video: detections of all frames, truth, and where its images are (None: no images)."""

    name: str
    group: str
    detections: list[rt.Detections]
    truth: rt.LabelledBoxes
    images: Path | None


# ---- Sequences ---------------------------------------------------------------------------------


def split_frames(frame: IntArray, rows: Array, count: int) -> list[rt.Detections]:
    """Rows x1, y1, x2, y2, score, class (N, 6) with 0-based frames (N,) as one set a frame."""
    return [rt.Detections.from_array(rows[frame == f]) for f in range(count)]


def mot_sequence(name: str, det: Path, gt: Path, images: Path | None = None) -> Sequence:
    """A MOTChallenge sequence: pedestrians, class 0."""
    truth = rt.read_truth(gt, rt.COCO_NAMES, 0.0)
    rows = rt.read_mot_rows(det)
    frames = int(max(truth.frame.max(), rows[:, 0].max()))
    boxes = np.c_[rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6], rows[:, 6].clip(0, 1), 0 * rows[:, 0]]
    found = split_frames(rows[:, 0].astype(np.int64) - 1, boxes, frames)
    return Sequence(name, "pedestrians", found, truth, images)


def mot_sequences(folder: Path) -> list[Sequence]:
    """All sequences of the folder that have detections of full length."""
    result = []
    for seq in sorted((folder / "MOT15-train").iterdir()):
        images = folder / seq.name / "img1"
        files = (seq / "det" / "det_sort_frcnn.txt", seq / "gt" / "gt.txt")
        result.append(mot_sequence(seq.name, *files, images if images.is_dir() else None))
    pets, mot17 = folder / "PETS-S3-MF1", folder / "MOT17-train" / "MOT17-02"
    det17 = folder / "MOT17-mini" / "train" / "MOT17-02-FRCNN" / "det" / "det.txt"
    pets_files = (pets / "det" / "det.txt", pets / "gt" / "gt.txt")
    result.append(mot_sequence("PETS-S3-MF1", *pets_files, pets / "img1"))
    return [*result, mot_sequence("MOT17-02", det17, mot17 / "gt" / "gt.txt")]


def kitchen_sequence(folder: Path) -> Sequence:
    """A recording with detections_yolov8s.csv and gt_mot.txt of some classes."""
    truth = rt.read_truth(folder / "gt_mot.txt", rt.COCO_NAMES, 0.0)
    truth = truth[np.isin(truth.name, KITCHEN)]
    rows = np.loadtxt(folder / "detections_yolov8s.csv", delimiter=",")
    rows = rows[np.isin(rows[:, 6], [rt.COCO_NAMES.index(n) for n in KITCHEN])]
    count = len(list((folder / "images").iterdir()))
    found = split_frames(rows[:, 0].astype(np.int64), rows[:, 1:], count)
    return Sequence(folder.name, "rooms", found, truth, folder / "images")


def room_sequence(folder: Path) -> Sequence:
    """A room of render_room.py."""
    video = rt.Video(folder / "room.mp4")
    recorded = rt.read_detections(folder / "detections.npz", video)
    found = [recorded.at(f) for f in range(len(list(video)))]
    truth = rt.read_truth(folder / "gt_mot.txt", recorded.class_names, 0.0)
    return Sequence(folder.name, "rooms", found, truth, folder / "room.mp4")


# ---- Appearance --------------------------------------------------------------------------------


class CropNet:
    """Unit rows from one crop a box, as DeepSORT does: resized, ImageNet mean and deviation."""

    def __init__(self, path: Path) -> None:
        self.session = rt.onnx_session(path, 1)
        entry = self.session.get_inputs()[0]
        self.name, shape = entry.name, entry.shape
        self.size = tuple(s if isinstance(s, int) else 128 for s in shape[:1:-1])  # width, height

    def __call__(self, image: rt.Image, found: rt.Detections) -> Array:
        crops = []
        for x1, y1, x2, y2 in found.xyxy.round().astype(int):
            part = image[max(y1, 0) : max(y2, y1 + 1, 1), max(x1, 0) : max(x2, x1 + 1, 1)]
            part = part if part.size else image[-1:, -1:]
            crops.append(cv2.resize(part, self.size)[..., ::-1] / 255.0)
        if not crops:
            return np.empty((0, 0))
        batch = (np.array(crops) - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        feed = {self.name: batch.transpose(0, 3, 1, 2).astype(np.float32)}
        out = self.session.run(None, feed)[0].astype(np.float64)
        out = out.mean((2, 3)) if out.ndim == 4 else out
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def own_look(image: rt.Image, found: rt.Detections, embedder: rt.Embedder) -> Array:
    """Our embedder's foreground and background side by side."""
    if not len(found):
        return np.empty((0, 0))
    look = embedder(image, found)
    parts = [look.foreground, look.background]
    return np.asarray(np.concatenate(parts, 1) / np.sqrt(2))


def embed_all(seq: Sequence, net: Any) -> tuple[list[Array], float]:
    """Embeddings of every frame's detections, and CPU seconds."""
    assert seq.images is not None
    looks, seconds = [], 0.0
    for frame in rt.Video(seq.images):
        started = time.process_time()
        looks.append(net(frame.image, seq.detections[frame.index]))
        seconds += time.process_time() - started
    width = max((x.shape[1] for x in looks if x.ndim == 2), default=0)
    return [x if len(x) else np.empty((0, width)) for x in looks], seconds


# ---- Running and scoring -----------------------------------------------------------------------


def stream_of(seq: Sequence, looks: list[Array] | None) -> Stream:
    """The same detections in the benchmark's form."""
    count = [len(d) for d in seq.detections]
    frame = np.repeat(np.arange(len(count)), count)
    fields = ("xyxy", "score", "class_id")
    box, score, cls = (np.concatenate([getattr(d, k) for d in seq.detections]) for k in fields)
    look = np.empty((len(frame), 0)) if looks is None else np.concatenate(looks)
    none = np.zeros(len(frame), np.int64)
    return Stream(len(count), frame, box, score, cls, look, none, none, np.empty((0, 9)))


def per_class(name: str, stream: Stream, venvs: Path) -> tuple[IntArray, float]:
    """Run a peer once for every class, as its users do: identities (N,) and CPU seconds."""
    identity, seconds = np.zeros(len(stream.frame), np.int64), 0.0
    for cls in np.unique(stream.class_id):
        rows = np.flatnonzero(stream.class_id == cls)
        fields = ("frame", "xyxy", "score", "class_id", "embedding", "owner", "visit")
        part = replace(stream, **{k: getattr(stream, k)[rows] for k in fields})
        found, spent = run_tracker(name, part, venvs)
        identity[rows] = np.where(found > 0, found + identity.max(), 0)
        seconds += float(np.nansum(spent))
    return identity, seconds


def ours(
    seq: Sequence, looks: list[Array] | None, config: rt.TrackerConfig | None = None
) -> tuple[IntArray, float]:
    """Our tracker alone, frame by frame, its own embedder unless looks are given."""
    embedder = rt.Embedder() if seq.images is not None and looks is None else None
    tracker = rt.Tracker(config, embedder)
    identity, seconds = [], 0.0
    frames = iter(rt.Video(seq.images)) if seq.images is not None else None
    for f, found in enumerate(seq.detections):
        image = None if frames is None else next(frames).image
        started = time.process_time()
        tracks = tracker.update(found, image, embeddings=None if looks is None else looks[f])
        seconds += time.process_time() - started
        ids = np.zeros(len(found), np.int64)
        ids[tracks.detection_index] = tracks.track_id
        identity.append(ids)
    return np.concatenate(identity), seconds


def whole_chain(seq: Sequence, out: Path) -> tuple[IntArray, float]:
    """`run` with reconstructed cameras and linker; the identities of all detections."""
    assert seq.images is not None
    at = iter(seq.detections)
    started = time.process_time()
    result = rt.run(seq.images, out / seq.name, detections=lambda image: next(at), overwrite=True)
    seconds, table_ = time.process_time() - started, result.table
    first = np.cumsum([0, *(len(d) for d in seq.detections)])
    identity = np.zeros(first[-1], np.int64)
    identity[first[table_.frame] + table_.detection_index] = table_.object_id
    return identity, seconds


def result_boxes(seq: Sequence, identity: IntArray) -> rt.LabelledBoxes:
    """Detections with an identity; the class of an identity is the one with the most score."""
    stream = stream_of(seq, None)
    kept = np.flatnonzero(identity > 0)
    ids, row = np.unique(identity[kept], return_inverse=True)
    votes = np.zeros((len(ids), len(rt.COCO_NAMES)))
    np.add.at(votes, (row, stream.class_id[kept]), stream.score[kept])
    names = "" if seq.group == "pedestrians" else np.array(rt.COCO_NAMES)[votes.argmax(1)][row]
    xyxy = stream.xyxy[kept]
    rows = np.c_[stream.frame[kept] + 1, identity[kept], xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]]
    return rt.labelled(rows, names)


def joined(parts: list[rt.LabelledBoxes]) -> rt.LabelledBoxes:
    """Several sequences as one: frames and identities shifted apart."""
    shifted = [replace(p, frame=p.frame + 10**6 * i, identity=p.identity + 10**6 * i)
               for i, p in enumerate(parts)]  # fmt: skip
    names = ("frame", "identity", "xyxy", "name", "role")
    return rt.LabelledBoxes(*(np.concatenate([getattr(p, k) for p in shifted]) for k in names))


def variants(seq: Sequence, args: Any) -> dict[str, Run]:
    """Identities and CPU seconds of every tracker on one sequence."""
    nets: dict[str, Any] = {}
    models = Path(os.environ.get("REOBJ_MODELS", "models"))
    if seq.images is not None:
        person = seq.group == "pedestrians"
        net = "osnet_x0_25_msmt17.onnx" if person else "mobilenetv2_feat.onnx"
        if (models / net).exists():
            nets["osnet" if person else "mobilenetv2"] = CropNet(models / net)
        embedder = rt.Embedder()
        nets["own look"] = lambda image, found: own_look(image, found, embedder)
    looks: dict[str, tuple[list[Array] | None, float]] = {"no look": (None, 0.0)}
    if nets:
        looks = {name: embed_all(seq, net) for name, net in nets.items()}
    result = {"ours": ours(seq, None)}
    for name, (look, spent) in looks.items():
        stream = stream_of(seq, look)
        if name not in ("own look", "no look"):
            identity, seconds = ours(seq, look)
            result[f"ours, {name}"] = identity, seconds + spent
        for peer in ("deepsort", "deepsort-tuned") if args.peers else ():
            identity, seconds = per_class(peer, stream, args.peers)
            result[f"{peer}, {name}"] = identity, seconds + spent
    for peer in PEERS if args.peers else ():
        if peer.startswith("rf-"):
            result[peer] = per_class(peer, stream_of(seq, None), args.peers)
    if seq.images is not None and seq.group == "rooms":
        result["ours, whole chain"] = whole_chain(seq, args.out / "chain")
    return result


# ---- Output ------------------------------------------------------------------------------------


def report(found: dict[str, dict[str, Run]], seqs: list[Sequence]) -> list[dict[str, Any]]:
    """One row for each tracker and sequence, and for each group of sequences together."""
    rows = []
    sets = [(s.name, [s]) for s in seqs]
    for group in sorted({s.group for s in seqs}):
        for images in (True, False):
            members = [s for s in seqs if s.group == group and (s.images is not None) == images]
            label = f"all {group} {'with' if images else 'without'} images"
            sets += [(label, members)] if len(members) > 1 else []
    for label, members in sets:
        for tracker in found[members[0].name]:
            boxes = joined([result_boxes(s, found[s.name][tracker][0]) for s in members])
            score = rt.score_tracks(joined([s.truth for s in members]), boxes)
            seconds = sum(found[s.name][tracker][1] for s in members)
            ms = 1e3 * seconds / sum(len(s.detections) for s in members)
            rows.append({"sequence": label, "tracker": tracker, **score, "ms_per_frame": ms})
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """One table for each sequence."""
    parts = []
    for name in dict.fromkeys(r["sequence"] for r in rows):
        body = [
            [r["tracker"], *(f"{100 * r[c]:.1f}" for c in COLUMNS[:5]), str(r["IDSW"]),
             f"{r['ids_per_object']:.2f}", f"{r['identities']} / {r['gt_objects']}",
             f"{r['ms_per_frame']:.1f}"]
            for r in rows if r["sequence"] == name
        ]  # fmt: skip
        header = "tracker | HOTA | DetA | AssA | IDF1 | MOTA | IDSW | ids per object"
        parts.append(table(f"**{name}**", f"{header} | ids / objects | CPU ms a frame", body))
    return "\n".join(parts)


def plots(rows: list[dict[str, Any]], out: Path) -> None:
    """Bars of IDF1, AssA and identities per object for each group of sequences."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for name in dict.fromkeys(r["sequence"] for r in rows if r["sequence"].startswith("all")):
        part = [r for r in rows if r["sequence"] == name][::-1]
        figure, axes = plt.subplots(1, 4, figsize=(13, 0.32 * len(part) + 1.2), sharey=True)
        for ax, column in zip(axes, ("HOTA", "AssA", "IDF1", "ids_per_object"), strict=True):
            colour = ["tab:green" if r["tracker"].startswith("ours") else "tab:gray" for r in part]
            bars = ax.barh([r["tracker"] for r in part], [r[column] for r in part], color=colour)
            ax.bar_label(bars, fmt="%.2f", fontsize=7)
            ax.set_title(column.replace("_", " "), fontsize=9)
            ax.margins(x=0.15)
        figure.suptitle(name, fontsize=10)
        figure.tight_layout()
        figure.savefig(out / f"compare_{name[4:].replace(' ', '_')}.png", dpi=80)
        plt.close(figure)


def main() -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--peers", type=Path, help="folder for the peers' virtual environments")
    parser.add_argument("--rooms", type=Path, nargs="*", default=[], help="of render_room.py")
    parser.add_argument("--kitchen", type=Path, nargs="*", default=[], help="recordings")
    parser.add_argument("--mot", type=Path, help="folder with MOT15-train, MOT17-train ...")
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    seqs = [room_sequence(p) for p in args.rooms] + [kitchen_sequence(p) for p in args.kitchen]
    seqs += mot_sequences(args.mot) if args.mot else []
    found = {s.name: variants(s, args) for s in seqs}
    rows = report(found, seqs)
    with (args.out / "compare.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    plots(rows, args.out)
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
