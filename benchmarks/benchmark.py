#!/usr/bin/env python3
"""Time the update of our tracker and of others, and measure re-identification after long absences.

    python benchmarks/benchmark.py                      # our tracker only
    python benchmarks/benchmark.py --peers build/peers  # also others, in venvs made there

The streams are synthetic, seeded and the same for every tracker: 500 frames of 1920x1080 with boxes
and precomputed embeddings. Camera motion compensation is off; only the tracker's update is timed.
  steady    objects cross the picture and are replaced; misses, occlusions, low scores, clutter
  revisit   every object vanishes for 200-260 frames and returns at least 400 px away
  hard      revisit with look-alikes, noisier embeddings and an appearance shifted at the return
  shape     revisit with width and height each scaled by .5-2 at the return
Times are CPU ms of one process with one thread; the better of two runs.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from tables import table

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Options = dict[str, Any]

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
SIZE = np.array([1920.0, 1080.0])
# cosine within a visit, between objects, across visits, as trackers measure them
COSINES = {"hard": (0.82, 0.44, 0.72)}
STEADY = {10: 300, 50: 300, 200: 100, 1000: 30}  # frames by number of objects
LIMIT_S = 10.0  # CPU seconds after which a tracker is stopped (marked * in the tables)
PACKAGES = {
    "peers": ["deep-sort-realtime==1.3.2", "trackers==2.6.1"],
    "norfair": ["norfair==2.3.0"],  # pins numpy<2
}
PEERS = {
    "deepsort": "peers", "rf-sort": "peers", "rf-bytetrack": "peers", "rf-ocsort": "peers",
    "rf-botsort": "peers", "norfair-reid": "norfair",
}  # fmt: skip
# best settings of a sweep over the rooms for choosing, by peer
TUNED: dict[str, Options] = json.loads((Path(__file__).resolve().parent / "tuned.json").read_text())
ROWS: dict[str, tuple[str, Options]] = {  # of the tables: tracker and options
    "ours": ("ours", {}),
    **{peer: (peer, {}) for peer in PEERS},
    "deepsort (100 samples)": ("deepsort", {"nn_budget": 100}),
    "deepsort (1000 frames)": ("deepsort", {
        "max_age": 1000, "gating_only_position": True, "max_cosine_distance": 0.35}),
    "norfair-reid (1000 frames)": ("norfair-reid", {"reid_hit_counter_max": 1000}),
}  # fmt: skip


# ---- Streams -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Stream:
    """Detections (N rows, by frame) with the true object of each (-1: clutter), and the truth."""

    frames: int
    frame: IntArray  # (N,)
    xyxy: Array  # (N, 4)
    score: Array  # (N,)
    class_id: IntArray  # (N,)
    embedding: Array  # (N, E), E may be 0
    owner: IntArray  # (N,)
    visit: IntArray  # (N,)
    truth: Array  # (M, 9) MOTChallenge rows: objects in view, detected or not
    images: str = ""  # video or folder, for a tracker that looks at them; "": none
    every: int = 1  # n-th image that counts

    def save(self, path: Path) -> None:
        np.savez(path, **{k: getattr(self, k) for k in self.__slots__})

    @staticmethod
    def load(path: Path) -> Stream:
        with np.load(path) as data:
            return Stream(**{k: data[k] if data[k].ndim else data[k].item() for k in data})


@dataclass(frozen=True, slots=True)
class Paths:
    """Where objects truly are: boxes (F, O, 4) cx, cy, w, h; in view (F, O); visit (F, O)."""

    box: Array
    seen: npt.NDArray[np.bool_]
    visit: IntArray


def crossing_paths(rng: np.random.Generator, slots: int, frames: int) -> Paths:
    """Objects of 1-5 px/frame cross the picture; one that leaves is replaced at a border."""
    boxes, seen = [], []
    for _ in range(slots):
        start, center = 0, rng.uniform(0.05, 0.95, 2) * SIZE
        while start < frames:
            goal = rng.uniform(0.2, 0.8, 2) * SIZE
            step = (goal - center) / np.linalg.norm(goal - center) * rng.uniform(1, 5)
            xy = center + step * (np.arange(frames) - start)[:, None]  # (F, 2)
            inside = ((xy > 0) & (xy < SIZE)).all(1) & (np.arange(frames) >= start)
            boxes.append(np.c_[xy, np.broadcast_to(rng.uniform(40, 160, 2), (frames, 2))])
            seen.append(inside)
            start = frames if inside[-1] else int(np.flatnonzero(inside)[-1]) + 1
            center = rng.uniform(0.01, 0.99, 2) * SIZE
            side = rng.integers(2)
            center[side] = (0.01, 0.99)[rng.integers(2)] * SIZE[side]
    return Paths(np.stack(boxes, 1), np.stack(seen, 1), np.zeros((frames, len(seen)), np.int64))


def revisit_paths(rng: np.random.Generator, objects: int, frames: int, shape: bool) -> Paths:
    """Objects leave for 200-260 frames and come back at least 400 px away."""
    t = np.arange(frames)[:, None]  # (F, 1)
    leave = rng.integers(100, 141, objects)
    back = leave + rng.integers(200, 261, objects)
    visit = (t >= back).astype(np.int64)
    here = rng.uniform(0.1, 0.9, (objects, 2)) * SIZE
    there = rng.uniform(0.1, 0.9, (objects, 2)) * SIZE
    near = np.linalg.norm(there - here, axis=1) < 450
    while near.any():
        there[near] = rng.uniform(0.1, 0.9, (int(near.sum()), 2)) * SIZE
        near = np.linalg.norm(there - here, axis=1) < 450
    drift = rng.normal(0, 0.3, (objects, 2))  # px/frame
    center = np.where(visit[..., None] == 1, there, here) + drift * t[..., None]
    size = np.broadcast_to(rng.uniform(40, 160, (objects, 2)), center.shape)
    if shape:
        size = size * np.where(visit[..., None] == 1, 2 ** rng.uniform(-1, 1, (objects, 2)), 1)
    return Paths(np.concatenate([center, size], -1), (t < leave) | (t >= back), visit)


def make_stream(kind: str, objects: int, frames: int = 500, dim: int = 128) -> Stream:
    """Generate one of the streams: steady, revisit, hard, shape."""
    rng = np.random.default_rng([objects, frames])
    if kind == "steady":
        paths = crossing_paths(rng, objects, frames)
    else:
        paths = revisit_paths(rng, objects, frames, kind == "shape")
    shake = rng.normal(0, 2, (frames, 2))
    for i in range(1, frames):
        shake[i] += 0.9 * shake[i - 1]
    box = paths.box + np.c_[shake, 0 * shake][:, None]  # (F, O, 4)
    found = paths.seen & (rng.random(paths.seen.shape) > 0.05) & ~occlusions(rng, paths.seen.shape)
    f, o = (np.asarray(x, np.int64) for x in np.nonzero(found))  # (n,)
    noise = np.repeat([[0.02, 0.02, 0.03, 0.03]], len(f), 0) * np.tile(box[f, o, 2:], 2)
    measured = box[f, o] + rng.normal(0, 1, (len(f), 4)) * noise
    low = rng.random(len(f)) < 0.08
    score = np.where(low, rng.uniform(0.15, 0.45, len(f)), rng.uniform(0.6, 0.95, len(f)))
    clutter = rng.integers(0, frames, round(0.02 * len(f)))
    corners, sizes = rng.uniform(0, 1, (2, len(clutter), 2))
    frame = np.r_[f, clutter]
    order = np.argsort(frame, kind="stable")
    visit = paths.visit[f, o]
    embedding = embeddings(rng, o, visit, dim, *COSINES.get(kind, (0.88, 0.31, 0.88)))
    embedding = np.r_[embedding, unit(rng.normal(size=(len(clutter), dim)))]
    all_box = np.r_[measured, np.c_[corners * SIZE, 40 + 120 * sizes]]
    xyxy = np.c_[all_box[:, :2] - all_box[:, 2:] / 2, all_box[:, :2] + all_box[:, 2:] / 2]
    g, k = np.nonzero(paths.seen)
    corner = np.c_[box[g, k, :2] - box[g, k, 2:] / 2, box[g, k, 2:]]
    truth = np.c_[g + 1, k + 1, corner, np.ones((len(g), 2)), np.ones(len(g))]
    pad = -np.ones(len(clutter), np.int64)
    return Stream(
        frames, frame[order], xyxy[order], np.r_[score, rng.uniform(0.3, 0.7, len(clutter))][order],
        np.zeros(len(frame), np.int64), embedding[order],
        np.r_[o, pad][order], np.r_[visit, pad][order], truth,
    )  # fmt: skip


def occlusions(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """(F, O): occluded for 4-15 frames from time to time (3 % of the time)."""
    occluded = np.zeros(shape, bool)
    for f, o in zip(*np.nonzero(rng.random(shape) < 0.003), strict=True):
        occluded[f : f + rng.integers(4, 16), o] = True
    return occluded


def unit(rows: Array) -> Array:
    """Scale rows to unit length."""
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True))


def embeddings(
    rng: np.random.Generator, owner: IntArray, visit: IntArray, dim: int,
    within: float, between: float, across: float,
) -> Array:  # fmt: skip
    """Unit rows (N, dim) with these mean cosines within a visit, between objects, across visits."""
    objects = int(owner.max(initial=0)) + 1
    noise = 1 / within - 1  # squared length of the noise on an embedding of length 1
    shift = max(1 / across**2 / (1 + noise) - 1 - noise, 0.0)
    common = between * (1 + noise)
    own, moved = (unit(rng.normal(size=(objects, dim))) for _ in range(2))
    embedding = np.sqrt(common) * unit(rng.normal(size=dim)) + np.sqrt(1 - common) * own  # (O, dim)
    rows = embedding[owner] + np.sqrt(shift) * moved[owner] * (visit == 1)[:, None]
    return unit(rows + np.sqrt(noise / dim) * rng.normal(size=rows.shape))


# ---- Trackers: one plain function each ---------------------------------------------------------


class Shown(NamedTuple):
    """What a tracker gets of a frame with D detections."""

    xyxy: Array  # (D, 4)
    score: Array  # (D,)
    class_id: IntArray  # (D,)
    embedding: Array  # (D, E), E may be 0
    motion: Any  # of the camera, for BoT-SORT


Step = Callable[[Shown], tuple[Any, Any]]  # rows of detections, their identities


def _ours(**options: Any) -> Step:
    import reobj_track as rt

    tracker = rt.Tracker(rt.TrackerConfig(**options))

    def step(shown: Shown) -> tuple[Any, Any]:
        found = rt.Detections(*shown[:3])
        embeddings = shown.embedding if shown.embedding.shape[1] else None
        tracks = tracker.update(found, embeddings=embeddings)
        return tracks.detection_index, tracks.track_id

    return step


def _deepsort(**options: Any) -> Step:
    """deep-sort-realtime; detections below .3 are left out, as DeepSORT's own evaluation does."""
    from deep_sort_realtime.deepsort_tracker import DeepSort

    tracker = DeepSort(embedder=None, **options)

    def step(shown: Shown) -> tuple[Any, Any]:
        rows = np.flatnonzero(shown.score >= 0.3)
        ltwh = np.c_[shown.xyxy[:, :2], shown.xyxy[:, 2:] - shown.xyxy[:, :2]]
        raw = [(ltwh[i].tolist(), float(shown.score[i]), int(shown.class_id[i])) for i in rows]
        embeds = shown.embedding if shown.embedding.shape[1] else np.ones((len(shown.score), 1))
        tracks = tracker.update_tracks(raw, embeds=list(embeds[rows]), others=rows.tolist())
        # only detections of this frame: predicted boxes of the frame after are not counted
        good = [t for t in tracks if t.is_confirmed() and t.time_since_update == 0]
        return [t.get_det_supplementary() for t in good], [int(t.track_id) for t in good]

    return step


def _roboflow(name: str, **options: Any) -> Step:
    import supervision as sv
    import trackers

    tracker = getattr(trackers, name)(**options)
    botsort = name == "BoTSORTTracker"
    if botsort:
        tracker.cmc.estimate = lambda motion, boxes: motion  # of `camera_motions`

    def step(shown: Shown) -> tuple[Any, Any]:
        rows = {"row": np.arange(len(shown.xyxy))}
        motion = (shown.motion,) if botsort else ()
        found = sv.Detections(shown.xyxy, None, shown.score, shown.class_id, data=rows)
        found = tracker.update(found, *motion)
        if not len(found):
            return [], []
        good = found.tracker_id >= 0
        return found.data["row"][good], found.tracker_id[good]

    return step


def camera_motions(stream: Stream) -> Iterator[Any]:
    """BoT-SORT's camera motion (2, 3) in every frame, once for the trackers of all classes."""
    import cv2
    import trackers

    folder, motion = Path(stream.images), trackers.CMC()
    files = sorted(folder.iterdir()) if folder.is_dir() else None
    video = cv2.VideoCapture(stream.images)
    for i in range(stream.frames * stream.every):
        image = cv2.imread(str(files[i])) if files else video.read()[1]
        if i % stream.every == 0:
            yield motion.estimate(image, None)


def _norfair(**options: Any) -> Step:
    import norfair

    def unlike(new: Any, old: Any) -> float:
        past = [d.embedding for d in old.past_detections if d.embedding is not None]
        return min((1 - float(new.last_detection.embedding @ p) for p in past), default=1.0)

    tracker = norfair.Tracker(
        "iou", 0.7, reid_distance_function=unlike, reid_distance_threshold=0.35,
        initialization_delay=3, **{"reid_hit_counter_max": 30, **options},
    )  # fmt: skip

    def step(shown: Shown) -> tuple[Any, Any]:
        corners = zip(shown.xyxy.reshape(-1, 2, 2), shown.embedding, strict=True)
        found = [norfair.Detection(b, data=i, embedding=e) for i, (b, e) in enumerate(corners)]
        good = [t for t in tracker.update(found) if t.last_detection in found]
        return [t.last_detection.data for t in good], [t.id for t in good]

    return step


MAKERS: dict[str, Callable[..., Step]] = {
    "ours": _ours,
    "deepsort": _deepsort,
    "rf-sort": functools.partial(_roboflow, "SORTTracker"),
    "rf-bytetrack": functools.partial(_roboflow, "ByteTrackTracker"),
    "rf-ocsort": functools.partial(_roboflow, "OCSORTTracker"),
    "rf-botsort": functools.partial(_roboflow, "BoTSORTTracker"),
    "norfair-reid": _norfair,
}


def worker(name: str, options: Options, job: Path, result: Path) -> None:
    """Run a tracker for each class, as its users do; write identities (N,) and CPU seconds (F,)."""
    stream = Stream.load(job)
    steps = {c: MAKERS[name](**options) for c in np.unique(stream.class_id)}
    identity = np.zeros(len(stream.frame), np.int64)
    seconds = np.full(stream.frames, np.nan)
    cuts = np.searchsorted(stream.frame, np.arange(stream.frames + 1))
    motions = camera_motions(stream) if stream.images and name == "rf-botsort" else None
    for f, (a, b) in enumerate(itertools.pairwise(cuts)):
        seen, seconds[f] = None if motions is None else next(motions), 0.0
        for k, (c, step) in enumerate(steps.items()):
            own = a + np.flatnonzero(stream.class_id[a:b] == c)
            boxes = (stream.xyxy[own], stream.score[own], stream.class_id[own])
            shown = Shown(*boxes, stream.embedding[own], seen)
            started = time.process_time()
            rows, ids = step(shown)
            seconds[f] += time.process_time() - started
            identity[own[np.asarray(rows, np.int64)]] = (
                1 + k + len(steps) * np.asarray(ids, np.int64)
            )
        if np.nansum(seconds) > LIMIT_S * len(steps):
            break  # the rest stays without identity and time
    np.savez(result, identity=identity, seconds=seconds)


def run_tracker(
    name: str, stream: Stream, venvs: Path | None, options: Options | None = None
) -> tuple[IntArray, Array]:
    """Run a tracker in a process of its own: identities (N,), 0 for none; CPU seconds (F,)."""
    python = sys.executable
    if name != "ours" and venvs is not None:
        python = str(python_of(venvs, PEERS[name]))
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder) / "job.npz", Path(folder) / "result.npz"
        stream.save(job)
        facts = (name, json.dumps(options or {}), str(job), str(result))
        command = [python, __file__, "--worker", *facts]
        subprocess.run(command, check=True, env=os.environ | threads, stderr=subprocess.PIPE)
        with np.load(result) as data:
            return data["identity"], data["seconds"]


def python_of(venvs: Path, group: str) -> Path:
    """Interpreter of a venv with the peers of a group, made at first use."""
    folder = venvs.resolve() / group
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    if not (folder / "installed").exists():
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *PACKAGES[group]], check=True)
        (folder / "installed").touch()
    return python


# ---- Scores and tables -------------------------------------------------------------------------


def scores(stream: Stream, identity: IntArray, until: int) -> dict[str, float]:
    """Identity scores of the first frames (objects count while in view, detected or not)."""
    from reobj.evaluation.tracks import score_tracks
    from reobj.evaluation.truth import labelled

    kept = identity > 0
    truth = stream.truth[stream.truth[:, 0] <= until]
    xyxy = stream.xyxy[kept]
    rows = np.c_[stream.frame[kept] + 1, identity[kept], xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]]
    return score_tracks(labelled(truth), labelled(rows))


def recovery(stream: Stream, identity: IntArray) -> tuple[float, float]:
    """Shares of objects whose main identity of visit 2 is their own of visit 1, or another's."""
    main: dict[tuple[int, int], int] = {}
    for o, v in itertools.product(range(int(stream.owner.max()) + 1), (0, 1)):
        ids = identity[(stream.owner == o) & (stream.visit == v) & (identity > 0)]
        if len(ids):
            main[o, v] = int(np.bincount(ids).argmax())
    first = {identity: o for (o, v), identity in main.items() if v == 0}
    owners = [(o, first.get(identity)) for (o, v), identity in main.items() if v == 1]
    own = sum(owner == o for o, owner in owners)
    other = sum(owner not in (o, None) for o, owner in owners)
    return own / max(len(owners), 1), other / max(len(owners), 1)


def best_of(row: str, stream: Stream, venvs: Path | None, runs: int) -> tuple[IntArray, Array]:
    """Identities and the CPU seconds of the fastest run."""
    name, options = ROWS[row]
    results = [run_tracker(name, stream, venvs, options) for _ in range(runs)]
    return min(results, key=lambda r: float(np.nanmean(r[1])))


def steady_rows(names: list[str], venvs: Path | None, runs: int) -> list[list[str]]:
    """Time and identities of each tracker: one after the other at every number of objects."""
    cells: dict[str, list[str]] = {name: [name] for name in names}
    idf1: dict[str, list[str]] = {name: [] for name in names}
    for objects, frames in STEADY.items():
        stream = make_stream("steady", objects, frames=frames)
        for name in names:
            identity, seconds = best_of(name, stream, venvs, runs)
            done, ms = int(np.isfinite(seconds).sum()), 1e3 * seconds[np.isfinite(seconds)]
            score, star = scores(stream, identity, done), "*" if done < stream.frames else ""
            cells[name].append(f"{np.median(ms):.2f} / {np.percentile(ms, 95):.2f}{star}")
            idf1[name].append(f"{score['IDF1']:.3f}")
    return [[*cells[name], " / ".join(idf1[name])] for name in names]


def revisit_row(row: str, venvs: Path | None, objects: int) -> list[str]:
    """Returns recognised, identities given to another object, and IDF1 of each kind."""
    cells, (name, options) = [row], ROWS[row]
    for kind in ("revisit", "hard", "shape"):
        stream = make_stream(kind, objects)
        identity, _ = run_tracker(name, stream, venvs, options)
        own, other = recovery(stream, identity)
        idf1 = scores(stream, identity, stream.frames)["IDF1"]
        cells.append(f"{100 * own:.0f} %, {100 * other:.0f} %, {idf1:.3f}")
    return cells


def main() -> int:
    """Run the benchmark and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--peers", type=Path, help="folder for the peers' virtual environments")
    parser.add_argument("--only", default="", help="names of trackers, comma-separated")
    parser.add_argument("--runs", type=int, default=2, help="timed runs; the fastest counts")
    parser.add_argument("--revisit", default="50", help="numbers of objects, e.g. 10,50,200, or ''")
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        name, options, job, result = args.worker
        worker(name, json.loads(options), Path(job), Path(result))
        return 0
    names = [n for n, (tracker, _) in ROWS.items() if args.peers or tracker == "ours"]
    names = [n for n in names if n in (args.only or n).split(",")]
    head = ["tracker", *(f"{n} objects" for n in STEADY), "IDF1 of each"]
    steady = steady_rows(names, args.peers, args.runs)
    title = f"Steady, ms a frame, median / p95; load of the machine {os.getloadavg()[0]:.1f}"
    print(table(head, steady, title), flush=True)
    head = ["tracker", "revisit: recovered, stolen, IDF1", "hard", "shape"]
    for objects in (int(n) for n in args.revisit.split(",") if n):
        revisit = [revisit_row(n, args.peers, objects) for n in names]
        print(table(head, revisit, f"Revisit, {objects} objects"), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
