#!/usr/bin/env python3
"""Compare identities on the same detections: ours, DeepSORT and today's trackers.

    python examples/compare_deepsort.py --peers build/peers --rooms examples/room \\
        --render 1,2,v900,v901 --kitchen redkitchen_7scenes --mot mot -o OUT

Writes OUT/compare.html (all of it on one page), compare.csv, compare_*.png; prints Markdown tables.
The same settings for all sequences; every tracker's rows are the detections it gave an identity to,
never predicted boxes; identities of `whole chain` are decided over the whole video, all others
frame by frame. Every result is kept in OUT/runs: an interrupted comparison goes on where it
stopped, and a changed reobj_track.py runs only our own rows again.

Rank-1: share of the returns (a true object in view again after >= 30 frames) whose first detection
is, by the tracker's appearance alone, most like an earlier view of the same object (of its class).
Returns: share of these returns that the tracker itself gave the identity of the visits before.

Appearance networks (folder REOBJ_MODELS): persons osnet_x0_25_msmt17.onnx, rooms
mobilenetv2_feat.onnx (ImageNet, as DeepSORT's own embedder), one crop a box; "own embedding" is our
embedder's. Without images no tracker has appearance.
DeepSORT is deep-sort-realtime 1.3.2 (PyPI), whose gallery of a lost track fills up with copies of
the last view; `tuned` is max_age 1000, position-only gate, cosine distance .35.
"""

from __future__ import annotations

import argparse
import base64
import csv
import functools
import hashlib
import html
import os
import re
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import render_room
from benchmark import PEERS, TUNED, Array, IntArray, Stream, run_tracker, table

sys.path.insert(0, os.environ.get("REOBJ_TRACK", str(Path(__file__).resolve().parent.parent)))
import reobj_track as rt
from reobj.files import atomic
from reobj.results.evaluation import (
    LabelledBoxes,
    labelled,
    read_truth,
    return_ranks,
    score_tracks,
)
from reobj.sources.detection_files import read_mot_rows
from reobj.sources.weights import IMAGENET_MEAN, IMAGENET_STD, onnx_session, own_models
from reobj.types import Image

Run = tuple[IntArray, float]  # identity of every detection (N,), 0 for none; CPU seconds
Embedded = tuple[list[Array], float]  # embeddings of every frame's detections; CPU seconds
KITCHEN = ("chair", "dining table", "cup")  # what redkitchen's truth knows


def digest(*parts: Any) -> str:
    """Twelve hex digits of bytes, arrays, the contents of files (paths) or anything that prints."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            total.update(part.tobytes())
        else:
            total.update(part.read_bytes() if isinstance(part, Path) else str(part).encode())
    return total.hexdigest()[:12]


CODE = Path(rt.__file__).parent
SOURCE = digest(
    *(CODE / f"{m}.py" for m in ("reobj_track", "quadrics")), *sorted(CODE.glob("reobj/**/*.py"))
)  # what our own rows depend on
EMBEDDER = digest(  # what our own embedding depends on
    *(CODE / f"reobj/identity/{m}.py" for m in ("embedding", "sampling")),
    *sorted(own_models().glob("*.onnx")),
)


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
    rows = read_mot_rows(det)
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
    truth = read_truth(folder / "gt_mot.txt", rt.COCO_NAMES, 0.0)
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
    truth = read_truth(folder / "gt_mot.txt", recorded.class_names, 0.0)
    return Sequence(folder.name, "rooms", found, truth, folder / "room.mp4")


def thinned(seq: Sequence, every: int) -> Sequence:
    """Only every n-th frame: wide steps."""
    if every == 1:
        return seq
    truth = seq.truth[(seq.truth.frame - 1) % every == 0]
    truth = replace(truth, frame=(truth.frame - 1) // every + 1)
    name, group = (f"{x}, every {every}th frame" for x in (seq.name, seq.group))
    return Sequence(name, group, seq.detections[::every], truth, seq.images, every)


def disturbed(seq: Sequence, seed: int) -> Sequence:
    """The same video with other detections: 3 % left out, corners off by 1 % of the size. Where
    two trackers differ by one event, many such copies tell luck from merit.
    """
    rng, found = np.random.default_rng([seed, len(seq.detections)]), []
    for d in seq.detections:
        size = np.tile(d.xyxy[:, 2:] - d.xyxy[:, :2], 2)
        moved = replace(d, xyxy=d.xyxy + 0.01 * size * rng.normal(size=size.shape))
        found.append(moved[rng.random(len(d)) > 0.03])
    return Sequence(f"{seq.name}-{seed}", f"{seq.group}, disturbed", found, seq.truth, seq.images)


# ---- Appearance --------------------------------------------------------------------------------


class CropNet:
    """Unit rows from one crop a box, as DeepSORT does: resized, ImageNet mean and deviation."""

    def __init__(self, path: Path) -> None:
        self.path = path
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


def embed_all(seq: Sequence, net: Any) -> tuple[list[Array], float]:
    """Embeddings of every frame's detections, and CPU seconds."""
    embedded, seconds = [], 0.0
    for frame, found in zip(seq.video(), seq.detections, strict=True):
        started = time.process_time()
        embedded.append(net(frame.image, found))
        seconds += time.process_time() - started
    width = max((x.shape[1] for x in embedded if x.ndim == 2), default=0)
    return [x if len(x) else np.empty((0, width)) for x in embedded], seconds


# ---- Running and scoring -----------------------------------------------------------------------


def stream_of(seq: Sequence, embedded: list[Array] | None) -> Stream:
    """The same detections in the benchmark's form."""
    count = [len(d) for d in seq.detections]
    frame = np.repeat(np.arange(len(count)), count)
    fields = ("xyxy", "score", "class_id")
    box, score, cls = (np.concatenate([getattr(d, k) for d in seq.detections]) for k in fields)
    rows = np.empty((len(frame), 0)) if embedded is None else np.concatenate(embedded)
    none = np.zeros(len(frame), np.int64)
    return Stream(len(count), frame, box, score, cls, rows, none, none, np.empty((0, 9)))


def peer_run(name: str, seq: Sequence, venvs: Path, embedded: list[Array] | None) -> Run:
    """Run a peer once for every class, as its users do: identities (N,) and CPU seconds."""
    stream = stream_of(seq, embedded)
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
    seq: Sequence, embedded: list[Array] | None, config: rt.TrackerConfig | None = None
) -> tuple[IntArray, float]:
    """Our tracker alone, frame by frame, its own embedder unless embeddings are given."""
    embedder = rt.Embedder() if seq.images is not None and embedded is None else None
    tracker = rt.Tracker(config, embedder)
    identity, seconds = [], 0.0
    frames = iter(seq.video()) if seq.images is not None else None
    for f, found in enumerate(seq.detections):
        image = None if frames is None else next(frames).image
        started = time.process_time()
        tracks = tracker.update(found, image, embeddings=None if embedded is None else embedded[f])
        seconds += time.process_time() - started
        ids = np.zeros(len(found), np.int64)
        ids[tracks.detection_index] = tracks.track_id
        identity.append(ids)
    return np.concatenate(identity), seconds


def whole_chain(seq: Sequence, out: Path, poses: str) -> Run:
    """`run`, identities decided over the whole video; seconds of tracking and linking, no poses."""
    assert seq.images is not None
    at = iter(seq.detections)
    config = rt.Config(
        input=rt.InputConfig(every=seq.every),
        poses=rt.PosesConfig(mode=poses),
        output=rt.OutputConfig(overlay="none", scene=False, fill_gaps=0),  # detections only
    )
    result = rt.run(
        seq.images, out / seq.name, config, detections=lambda image: next(at), overwrite=True
    )
    first = np.cumsum([0, *(len(d) for d in seq.detections)])
    identity = np.zeros(first[-1], np.int64)
    row = first[result.tracks.frame // seq.every] + result.tracks.detection_index
    identity[row] = result.tracks.track_id
    return identity, result.seconds["track"] + result.seconds["objects"]


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


def cached(path: Path, make: Callable[[], Run]) -> Run:
    """The result in the file, or made and written there."""
    if path.exists():
        with np.load(path) as data:
            return data["identity"], float(data["seconds"])
    identity, seconds = make()
    with atomic(path) as part, part.open("wb") as file:
        np.savez_compressed(file, identity=identity, seconds=seconds)
    return identity, seconds


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


def appearance_ranks(seq: Sequence, embedded: Callable[[], Embedded]) -> Run:
    """Ranks of the right object by appearance alone (`return_ranks`); seconds of embedding."""
    stream = stream_of(seq, embedded()[0])
    found = result_boxes(seq, 1 + np.arange(len(stream.frame)), stream)
    return return_ranks(seq.truth, found, stream.embedding), embedded()[1]


def with_embeddings(make: Callable[[list[Array]], Run], embedded: Callable[[], Embedded]) -> Run:
    """A tracker's run on embeddings that are only computed now."""
    return make(embedded()[0])


def jobs(seq: Sequence, args: Any) -> dict[str, tuple[str, Callable[[], Run]]]:
    """For every tracker: what its result depends on, and how to make it.

    `appearance NAME` gives the ranks of the returns in place of identities, and the time of
    embedding.
    """
    part, source = functools.partial, SOURCE + EMBEDDER
    result: dict[str, tuple[str, Callable[[], Run]]] = {"ours": (source, part(ours, seq, None))}
    deepsorts = ["deepsort", "deepsort-tuned"] if args.peers else []
    nets = networks(seq)
    for name, net in nets.items():
        embedded = functools.cache(part(embed_all, seq, net))
        key = str(net.path) if name != "own embedding" else EMBEDDER
        result[f"appearance {name}"] = (key, part(appearance_ranks, seq, embedded))
        if name != "own embedding":
            result[f"ours, {name}"] = (
                source + key,
                part(with_embeddings, part(ours, seq), embedded),
            )
        for peer in deepsorts:
            run = part(peer_run, peer, seq, args.peers)
            result[f"{peer}, {name}"] = (key + str(TUNED), part(with_embeddings, run, embedded))
    for peer in PEERS if args.peers else ():
        if peer.startswith("rf-") or (peer in deepsorts and not nets):
            label = f"{peer}, no appearance" if peer in deepsorts else peer
            result[label] = (str(TUNED), part(peer_run, peer, seq, args.peers, None))
    if seq.images is not None and seq.group.startswith("rooms"):
        chain = args.out / "chain"
        result["ours, whole video, no poses"] = (source, part(whole_chain, seq, chain, "none"))
        result["ours, whole chain"] = (source, part(whole_chain, seq, chain, "auto"))
    return result


def variants(seq: Sequence, args: Any) -> dict[str, Run]:
    """Identities and CPU seconds of every tracker on one sequence, from OUT/runs where known."""
    stream = stream_of(seq, None)
    boxes = digest(stream.frame, stream.xyxy, stream.score, stream.class_id)
    result = {}
    for tracker, (key, make) in jobs(seq, args).items():
        name = f"{seq.name}-{tracker}-{digest(boxes, key)}.npz".replace(", ", "-").replace(" ", "_")
        path = args.out / "runs" / name
        if not path.exists():
            print(f"{time.strftime('%H:%M:%S')} {seq.name}: {tracker}", file=sys.stderr, flush=True)
        result[tracker] = cached(path, make)
    return result


# ---- Output ------------------------------------------------------------------------------------


def sets_of(seqs: list[Sequence]) -> dict[str, list[Sequence]]:
    """Every sequence alone, and the sequences of a kind together."""
    sets = {s.name: [s] for s in seqs if "disturbed" not in s.group}
    for group in sorted({s.group for s in seqs}):
        for images in (True, False):
            members = [s for s in seqs if s.group == group and (s.images is not None) == images]
            if len(members) > 1:
                sets[f"all {group} {'with' if images else 'without'} images"] = members
    return sets


def report(found: dict[str, dict[str, Run]], seqs: list[Sequence]) -> list[dict[str, Any]]:
    """One row for each tracker and sequence, and for each group of sequences together."""
    rows = []
    for label, members in sets_of(seqs).items():
        for tracker in [t for t in found[members[0].name] if not t.startswith("appearance ")]:
            runs = [found[s.name] for s in members]
            boxes = [result_boxes(s, r[tracker][0]) for s, r in zip(members, runs, strict=True)]
            score = score_tracks(joined([s.truth for s in members]), joined(boxes))
            name = tracker.partition(", ")[2]
            by = (
                "appearance own embedding"
                if tracker == "ours" or "whole" in name
                else f"appearance {name}"
            )
            ranks = [r[by] for r in runs if by in r]
            seconds = sum(r[tracker][1] for r in runs)
            seconds += 0 if tracker == "ours" or "whole" in name else sum(s for _, s in ranks)
            first = np.concatenate([k for k, _ in ranks]) == 1 if ranks else np.empty(0)
            ms = 1e3 * seconds / sum(len(s.detections) for s in members)
            rows.append({"sequence": label, "tracker": tracker, **score, "ms_per_frame": ms,
                         "rank1": float(first.mean()) if len(first) else float("nan")})  # fmt: skip
    return rows


def cells(row: dict[str, Any]) -> list[str]:
    """One line of a table."""
    share = [f"{100 * row[c]:.1f}" for c in "HOTA DetA AssA IDF1 MOTA".split()]
    kept = f"{round(row['returns'] * row['returns_kept'])} of {row['returns']}"
    rank1 = "-" if np.isnan(row["rank1"]) else f"{100 * row['rank1']:.0f}"
    ids = [f"{row['ids_per_object']:.2f}", f"{row['identities']} / {row['gt_objects']}"]
    speed = f"{row['ms_per_frame']:.1f} ({1e3 / row['ms_per_frame']:.0f})"
    return [row["tracker"], *share, str(row["IDSW"]), *ids, kept, rank1, speed]


HEADER = (
    "tracker | HOTA | DetA | AssA | IDF1 | MOTA | IDSW | ids per object | ids / objects | "
    "returns kept | Rank-1 | CPU ms a frame (fps)"
)


def markdown(rows: list[dict[str, Any]]) -> str:
    """One table for each sequence."""
    names = dict.fromkeys(r["sequence"] for r in rows)
    body = {n: [cells(r) for r in rows if r["sequence"] == n] for n in names}
    return "\n".join(table(f"**{n}**", HEADER, lines) for n, lines in body.items())


def verdicts(rows: list[dict[str, Any]]) -> list[str]:
    """For every sequence: ours online against the best peer, and identities against DeepSORT."""
    lines = []
    for name in dict.fromkeys(r["sequence"] for r in rows):
        part = {r["tracker"]: r for r in rows if r["sequence"] == name}
        peers = [r for t, r in part.items() if not t.startswith("ours")]
        if not peers:
            continue
        text = ", ".join(
            f"{100 * (part['ours'][c] - max(p[c] for p in peers)):+.1f} {c}"
            for c in ("IDF1", "AssA", "HOTA")
        )
        other = next(p["ids_per_object"] for p in peers if p["tracker"].startswith("deepsort"))
        mine = [r["ids_per_object"] for t, r in part.items() if t.startswith("ours")]
        online, last = (f"{100 * (ids / other - 1):+.0f} %" for ids in (mine[0], mine[-1]))
        lines.append(
            f"{name}: ours {text} against the best peer; identities per real object against "
            f"DeepSORT {online} online, {last} in our last row"
        )
    return lines


def write_page(rows: list[dict[str, Any]], out: Path) -> None:
    """compare.html: the plots and all tables on one page that needs nothing else."""
    parts = ["<!doctype html><meta charset=utf-8><title>Identities compared</title><style>"
             "body{font:14px sans-serif;margin:2em}td,th{padding:2px 9px;text-align:right}"
             "td:first-child{text-align:left}tr.ours{background:#e3f4e3}img{max-width:100%}"
             "</style><h1>Identities on the same detections</h1><pre>",
             html.escape(__doc__), "</pre><ul>", *(f"<li>{html.escape(v)}" for v in verdicts(rows)),
             "</ul>"]  # fmt: skip
    for name in list(dict.fromkeys(r["sequence"] for r in rows))[::-1]:
        parts.append(f"<h2>{html.escape(name)}</h2>")
        picture = out / f"compare_{name[4:].replace(' ', '_')}.png"
        if name.startswith("all ") and picture.exists():
            code = base64.b64encode(picture.read_bytes()).decode()
            parts.append(f'<img src="data:image/png;base64,{code}">')
        head = "".join(f"<th>{h.strip()}</th>" for h in HEADER.split("|"))
        parts.append(f"<table><tr>{head}</tr>")
        for row in (r for r in rows if r["sequence"] == name):
            line = "".join(f"<td>{html.escape(c)}</td>" for c in cells(row))
            parts.append(f"<tr class={row['tracker'][:4]}>{line}</tr>")
        parts.append("</table>")
    with atomic(out / "compare.html") as part:
        part.write_text("\n".join(parts))


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


def rendered(seeds: str, folder: Path) -> list[Path]:
    """Rooms of render_room.py with these seeds, made where missing; v7: of its own plan."""
    rooms = [folder / f"room_{seed}" for seed in seeds.split(",") if seed]
    for room in rooms:
        seed, own = room.name[5:].lstrip("v"), ["--plan", "varied", "--path", "tour"]
        if not (room / "gt_mot.txt").exists() or not (room / "detections.npz").exists():
            render_room.main(["-o", str(room), "--seed", seed, *own * ("v" in room.name)])
    return rooms


def fill_in(document: Path, rows: list[dict[str, Any]], pictures: Path) -> None:
    """Renew the tables of a Markdown file that follow <!-- compare: SEQUENCE -->, and its plots."""
    for picture in pictures.glob("compare_*.png"):
        if (document.parent / "img" / picture.name).exists():
            shutil.copy(picture, document.parent / "img")
    for name in dict.fromkeys(r["sequence"] for r in rows):
        body = table("", HEADER, [cells(r) for r in rows if r["sequence"] == name]).strip()
        mark = re.escape(f"<!-- compare: {name} -->") + r"\n+(\|.*\n)*\n*"
        text = document.read_text()
        document.write_text(re.sub(mark, f"<!-- compare: {name} -->\n\n{body}\n\n", text))


def main() -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", type=Path, help="folder for the peers' virtual environments")
    parser.add_argument("--rooms", type=Path, nargs="*", default=[], help="of render_room.py")
    parser.add_argument("--render", default="", metavar="SEEDS", help="more rooms: 1,2,v900")
    parser.add_argument("--kitchen", type=Path, nargs="*", default=[], help="recordings")
    parser.add_argument("--mot", type=Path, help="folder with MOT15-train, MOT17-train ...")
    parser.add_argument("--every", type=int, default=1, help="use every n-th frame: wide steps")
    parser.add_argument("--copies", type=int, default=0, help="disturbed ones of --mot with images")
    parser.add_argument("--fill", type=Path, help="Markdown file whose marked tables to renew")
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rooms = [*args.rooms, *rendered(args.render, args.out / "rooms")]
    seqs = [room_sequence(p) for p in rooms] + [kitchen_sequence(p) for p in args.kitchen]
    seqs += mot_sequences(args.mot) if args.mot else []
    pictured = [s for s in seqs if s.group == "pedestrians" and s.images is not None]
    seqs += [disturbed(s, seed) for seed in range(args.copies) for s in pictured]
    seqs = [thinned(seq, args.every) for seq in seqs]
    found = {s.name: variants(s, args) for s in seqs}
    rows = report(found, seqs)
    with atomic(args.out / "compare.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    plots(rows, args.out)
    write_page(rows, args.out)
    if args.fill:
        fill_in(args.fill, rows, args.out)
    print(markdown(rows), *verdicts(rows), sep="\n- ")
    return 0


if __name__ == "__main__":
    sys.exit(main())
