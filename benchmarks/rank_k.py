#!/usr/bin/env python3
"""Measure re-identification: Rank-k and mAP, also of look-alikes, by view angle and time gap.

    python benchmarks/rank_k.py --rooms 900 901 902 903 904 --recording redkitchen_7scenes \\
        --models mobilenetv2_feat --person osnet_x0_25_msmt17 -o OUT

writes OUT/rank_k.csv, by_bin.csv, counts.csv, cost.csv and plots, and prints Markdown tables.

Every labelled detection is a query; its gallery is the labelled detections of *other* frames.
Protocols:
  open    gallery: every scene of the set, every class (the thesis's Rank-k).
  class   gallery: same class, same scene; includes classes with a single instance.
  twins   as `class`, only queries whose gallery contains another instance of the class.
  single  as `twins`, but one random view of each object in the gallery (mean of 10 draws): the
          single-shot protocol of re-identification, as after one short visit.
  same    rendered rooms: as `twins`, but only objects of one model (they look identical).
Gaps: `any` other frame; `away`: more than `--away` frames (default 30, the frames for which a
track survives without detections); a tracker bridges shorter gaps by motion.
Rank-k is the fraction of queries with a correct match among the k nearest; mAP the mean average
precision. The interval is the 95 % bootstrap over identities. By bin: the gallery is all same-class
objects in those frames that show the queried object from that angle, or after that gap.

Setups (thesis): `fg` object only, `bg` surroundings only, `concat` both (mean of the two cosines),
`full` the enlarged crop without mask. "frame" methods pool one feature map a frame (`Embedder`),
"crops" methods run the backbone on two masked crops an object (`CropEmbedder`), "person" methods
run an appearance network of DeepSORT's kind on the plain box.

Scenes (those used for choosing, by splits.json, are left out; --choosing includes them, marked;
--calibrate uses no others):
  --rooms SEED...    rooms of render_room.py (never train on them), rendered once into --cache;
                     one set for each --plan (home: that of examples/room; varied: another room,
                     other look-alikes and another walk for every seed).
  --recording DIR... images/ or a video, with gt_mot.txt or gt.txt (MOT), as written by `run` or
                     annotated; poses_c2w.txt and intrinsics.json give view angles where they exist.
  --depth DIR...     the same folder, identities from depth/ and poses: detections_*.csv back-
                     projected and clustered (the protocol of the frozen-backbone table).
  --scannet DIR...   ScanNet as SensReader exports it, or a house of Matterport3D, with label images
                     (reid_scenes.py says which files). Options of the CLOVER protocol:
                     --views 8 --min-mask 10000 --min-side 100.
With --detect MODEL the boxes and masks are those of a detector, each associated with the labelled
instance of its frame and category that it overlaps (IoU .5). The numbers of views and instances of
each class (the thesis's tables 3.1 and 3.2) are printed and written to OUT/counts.csv.
With --pictures N, OUT/matches_SET_METHOD.jpg shows queries with their best five matches by
foreground, background and both, and marks the correct ones.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, os.environ.get("REOBJ_TRACK", str(Path(__file__).resolve().parent.parent)))
from reid_scenes import (
    Scene,
    depth_scene,
    detected_scene,
    read_image,
    recording_scene,
    room_scene,
    scannet_scene,
    view_counts,
)
from splits import add_choosing, marked, room_of, split_name, usable

import reobj_track as rt
from reobj.appearance.crops import flat_maps
from reobj.appearance.reid import RETURN_ODDS, SimilarityCalibration, match_probability
from reobj.files import atomic
from reobj.sources.recorded import NO_RUNS
from reobj.sources.weights import IMAGENET_MEAN, IMAGENET_STD, onnx_session
from reobj.types import Array, BoolArray, Image, IntArray

Look = Callable[[Image, rt.Detections, IntArray], rt.Embeddings]

ANGLES_DEG = (0, 15, 30, 45, 60, 90, 180)
GAPS = (0, 30, 60, 120, 240, 10**9)  # frames
RANKS = (1, 5, 10, 20, 50)
PARTS = ("fg", "bg")
COLUMNS = (("twins", "any"), ("twins", "away"), ("single", "away"), ("open", "away"))  # printed
DRAWS = 1000  # of the bootstrap
DRAWN_GALLERIES = 10  # of the single-shot protocol
BEST = 5  # matches in a picture, as in the thesis


# ---- Looks ---------------------------------------------------------------------------------------


Memo = dict[int, npt.NDArray[np.float16]]  # map of each crop, by the hash of its pixels


class Crops(rt.CropEmbedder):
    """`CropEmbedder` that shares the maps of a frozen backbone with others, to save time."""

    def __init__(self, model: str, head: str = "", memo: Memo | None = None) -> None:
        super().__init__(model, head, threads=1)
        self.memo = memo if self.frozen else None

    def maps(self, crops: Image) -> npt.NDArray[np.float32]:
        if self.memo is None:
            return super().maps(crops)
        keys = [hash(crop.tobytes()) for crop in crops]
        new = [i for i, key in enumerate(keys) if key not in self.memo]
        if new:
            fresh = super().maps(crops[new]).astype(np.float16)
            self.memo.update(zip([keys[i] for i in new], fresh, strict=True))
        return np.stack([self.memo[key] for key in keys]).astype(np.float32)


class OneCrop(Crops):
    """One crop of each object: "fg", "bg" (the other part masked) or "full" (the grown crop as it
    is), through the backbone and, if `head` names one, a ConvBlock of its own.
    """

    def __init__(self, model: str, part: str, head: str = "none", memo: Memo | None = None) -> None:
        super().__init__(model, head, memo)
        self.part = part

    def __call__(
        self, frame: Image, detections: rt.Detections, rows: IntArray | None = None
    ) -> rt.Embeddings:
        rows = np.arange(len(detections)) if rows is None else rows
        crops, own = self.cut(frame, detections, rows)
        if self.part != "full":
            crops = np.split(self.masked(crops, own), 2)[PARTS.index(self.part)]
        maps = self.maps(crops)
        found = flat_maps(maps) if self.conv_block is None else self.run_conv_block(maps)
        return rt.Embeddings(found, np.empty((len(rows), 0)))


def person_look(name: str, threads: int = 1) -> Look:
    """DeepSORT's way: the plain box, resized, through one network; pooled if it gives a map."""
    session = onnx_session(rt.model_path(name), threads)
    entry = session.get_inputs()[0]
    side = tuple(s if isinstance(s, int) else 128 for s in entry.shape[:1:-1])

    def look(image: Image, found: rt.Detections, rows: IntArray) -> rt.Embeddings:
        crops = []
        for x1, y1, x2, y2 in found.xyxy[rows].round().astype(int):
            part = image[max(y1, 0) : max(y2, y1 + 1, 1), max(x1, 0) : max(x2, x1 + 1, 1)]
            crops.append(cv2.resize(part if part.size else image[-1:, -1:], side)[..., ::-1])
        batch = (np.array(crops, np.float32) - IMAGENET_MEAN) / IMAGENET_STD
        feed = {entry.name: batch.transpose(0, 3, 1, 2).astype(np.float32)}
        out = session.run(None, feed)[0].astype(np.float64)
        out = out.mean((2, 3)) if out.ndim == 4 else out
        unit = out / np.linalg.norm(out, axis=1, keepdims=True)
        return rt.Embeddings(unit, np.empty((len(rows), 0)))

    return look


def looks(args: Any, memo: Memo | None = None) -> dict[str, tuple[Look, tuple[str, ...]]]:
    """Every method: how to embed, and the names of its one or two parts."""
    found: dict[str, tuple[Look, tuple[str, ...]]] = {}
    for name in args.models:
        stem, frame = Path(name).stem, rt.Embedder(name, threads=1)
        found[f"{stem}, frame"] = (frame, PARTS)
        if frame.frozen and frame.trained:
            plain = rt.Embedder(name, "none", threads=1)
            found[f"{stem} no-train, frame"] = (plain, PARTS)
        if not args.no_crops:
            found |= crop_looks(name, args.blocks, memo)
    for name in args.person:
        found[f"{Path(name).stem}, person"] = (person_look(name), ("box",))
    return found


def crop_looks(name: str, blocks: Path | None, memo: Memo | None) -> dict[str, Any]:
    """Methods that send crops of each object through a backbone: trained, then not trained."""
    stem, crops = Path(name).stem, Crops(name, memo=memo)
    joint = crops.conv_block is not None
    found: dict[str, Any] = {f"{stem}, crops": (crops, ("concat",) if joint else PARTS)}
    for part in ("fg", "bg", "full") if blocks else ():
        head = Path(str(blocks)) / part / f"crops_{stem}_head.onnx"
        if head.is_file():
            found[f"{stem}, crop {part}"] = (OneCrop(name, part, str(head), memo), (part,))
    if joint:
        found[f"{stem} no-train, crops"] = (Crops(name, "none", memo), PARTS)
    if crops.frozen:
        full = OneCrop(name, "full", memo=memo)
        found[f"{stem}{' no-train' if joint else ''}, crop"] = (full, ("full",))
    return found


def embed(scenes: Sequence[Scene], look: Look) -> list[npt.NDArray[np.float32]]:
    """Unit rows of each part for all scored detections, scene after scene: [(N, E1), (N, E2)]."""
    fore, back = [], []
    for scene in scenes:
        for f in np.unique(scene.row[scene.scored]):
            image, found, rows = scene.at(int(f))
            both = look(image, found, rows)
            fore.append(both.foreground.astype(np.float32))
            back.append(both.background.astype(np.float32))
    parts = [np.concatenate(fore), np.concatenate(back)]
    return parts if parts[1].shape[1] else parts[:1]


def setups(
    parts: Sequence[npt.NDArray[np.float32]], names: Sequence[str], weight: float
) -> dict[str, npt.NDArray[np.float32]]:
    """Cosine matrices (N, N) of each part and of both together; equal to 1e-5 is equal."""
    cosine = [np.round(p @ p.T, 5) for p in parts]
    found = dict(zip(names, cosine, strict=True))
    if len(cosine) == 2:
        found["concat"] = np.round(weight * cosine[0] + (1 - weight) * cosine[1], 5)
    return found


# ---- Rank-k --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Pairs:
    """What decides which pairs of scored detections are compared (N rows, all scenes)."""

    scene: IntArray  # (N,)
    frame: IntArray  # (N,) number in the recording
    name: IntArray  # (N,) class
    model: IntArray  # (N,)
    identity: IntArray  # (N,) unique over all scenes
    sight: Array  # (N, 3)

    def gallery(self, protocol: str, away: int) -> BoolArray:
        """(N, N): does row i compare with row j?"""
        near = self.scene[:, None] == self.scene[None]
        near_time = np.abs(self.frame[:, None] - self.frame[None]) <= away
        allowed = ~(near & near_time)
        if protocol != "open":
            allowed &= near & (self.name[:, None] == self.name[None])
        if protocol == "same":
            allowed &= (self.model[:, None] == self.model[None]) & (self.model >= 0)
        return np.asarray(allowed)

    def same(self) -> BoolArray:
        """(N, N): one object?"""
        return np.asarray(self.identity[:, None] == self.identity[None])

    def angle_deg(self) -> Array:
        """(N, N) angle between the directions of view, NaN if unknown."""
        return np.asarray(np.degrees(np.arccos(np.clip(self.sight @ self.sight.T, -1, 1))))


def pairs_of(scenes: Sequence[Scene]) -> Pairs:
    """Concatenate the scored rows of all scenes; identities made unique."""
    rows = [s.scored for s in scenes]
    scene = np.repeat(np.arange(len(scenes)), [len(r) for r in rows])
    both = list(zip(scenes, rows, strict=True))
    frame = np.concatenate([s.number[s.row[r]] for s, r in both])
    name, model, identity, sight = (
        np.concatenate([getattr(s, k)[r] for s, r in both])
        for k in ("name", "model", "identity", "sight")
    )
    identity = np.unique(np.stack([scene, identity], 1), axis=0, return_inverse=True)[1].ravel()
    classes = np.unique(name, return_inverse=True)[1]
    return Pairs(scene, frame, classes, model, identity, sight)


def rank_queries(
    cosine: npt.NDArray[Any], same: BoolArray, allowed: BoolArray, need_other: bool = True
) -> tuple[Array, Array]:
    """Rank (from 1) of the first right one and average precision of every query, (N,) each.

    NaN where the gallery holds no right one, or (need_other) no wrong one. Ties are shared: a
    right one counts half of the wrong ones of equal similarity as nearer.
    """
    positive, negative = same & allowed, ~same & allowed
    rank, precision = np.full(len(cosine), np.nan), np.full(len(cosine), np.nan)
    valid = positive.any(1) & (negative.any(1) | (not need_other))
    for i in np.flatnonzero(valid):  # over queries
        right = np.sort(cosine[i, positive[i]])[::-1]  # (P,) best first
        wrong = np.sort(cosine[i, negative[i]])  # (M,)
        nearer = len(wrong) - np.searchsorted(wrong, right, "right")
        equal = len(wrong) - np.searchsorted(wrong, right, "left") - nearer
        before = nearer + 0.5 * equal  # (P,) wrong ones in front of each right one
        position = np.arange(1, len(right) + 1)
        rank[i] = 1 + before[0]
        precision[i] = np.mean(position / (position + before))
    return rank, precision


def one_view(pairs: Pairs, allowed: BoolArray, rng: np.random.Generator) -> BoolArray:
    """(N, N) allowed, thinned at random to one view of each object for every query."""
    order = np.argsort(pairs.identity, kind="stable")
    _, first = np.unique(pairs.identity[order], return_index=True)
    key = np.where(allowed, rng.random(allowed.shape), -1)  # (N, N)
    best = np.maximum.reduceat(key[:, order], first, 1)  # (N, identities)
    return np.asarray(allowed & (key == best[:, np.unique(pairs.identity, return_inverse=True)[1]]))


def rank_pairs(cosine: npt.NDArray[Any], pairs: Pairs, kind: str, away: int) -> tuple[Array, Array]:
    """`rank_queries` of a protocol; (N,) or, where a gallery is drawn, (DRAWN_GALLERIES * N,)."""
    same = pairs.same()
    if kind != "single":
        return rank_queries(cosine, same, pairs.gallery(kind, away), kind != "class")
    allowed, rng = pairs.gallery("twins", away), np.random.default_rng(0)
    drawn = [
        rank_queries(cosine, same, one_view(pairs, allowed, rng)) for _ in range(DRAWN_GALLERIES)
    ]
    return np.concatenate([d[0] for d in drawn]), np.concatenate([d[1] for d in drawn])


def hit(rank: Array, k: int) -> Array:
    """Is the first right one among the k nearest? 1 or 0, half for a tie of two at the border."""
    return np.asarray(np.clip(k + 1 - rank, 0, 1))


def shares(rank: Array, identity: IntArray, draws: npt.NDArray[Any]) -> Array:
    """Rank-1 of bootstrap draws over identities: (B,), from draws (B, identities)."""
    good = np.isfinite(rank)
    count = np.bincount(identity[good], minlength=draws.shape[1])
    hits = np.bincount(identity[good], hit(rank[good], 1), minlength=draws.shape[1])
    return np.asarray((draws @ hits) / np.maximum(draws @ count, 1))


def bootstrap_draws(identity: IntArray, used: BoolArray, seed: int = 0) -> npt.NDArray[Any]:
    """How often each identity is drawn, (B, identities); only those that are used."""
    names = np.unique(identity[used])
    draws = np.zeros((DRAWS, int(identity.max(initial=0)) + 1))
    rng = np.random.default_rng(seed)
    draws[:, names] = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), DRAWS)
    return draws


def summary(rank: Array, precision: Array, pairs: Pairs) -> dict[str, float]:
    """Rank-k, mAP and interval of one row of the table; percent."""
    good = np.isfinite(rank)
    if not good.any():
        return {}
    identity = np.resize(pairs.identity, len(rank))  # drawn galleries follow each other
    boot = shares(rank, identity, bootstrap_draws(identity, good))
    low, high = np.percentile(boot, [2.5, 97.5])
    row: dict[str, float] = {"queries": int(good[: len(pairs.identity)].sum())}
    row["identities"] = len(np.unique(identity[good]))
    row |= {f"rank{k}": 100 * float(hit(rank[good], k).mean()) for k in RANKS}
    return {**row, "low": 100 * low, "high": 100 * high, "mAP": 100 * float(precision[good].mean())}


def by_bin(
    cosine: npt.NDArray[Any], pairs: Pairs, value: Array, edges: Sequence[float]
) -> list[dict[str, float]]:
    """Twin Rank-1 where the right ones have a value (N, N) within each bin."""
    same, allowed = pairs.same(), pairs.gallery("twins", 0)
    moment = np.unique(np.stack([pairs.scene, pairs.frame], 1), axis=0, return_inverse=True)[1]
    at = np.eye(int(moment.max()) + 1, dtype=np.float32)[moment.ravel()]  # (N, moments)
    found = []
    for low, high in itertools.pairwise(edges):
        right = same & allowed & (value > low) & (value <= high)
        frames = (right.astype(np.float32) @ at) > 0  # (N, moments) that show it so
        gallery = allowed & frames[:, moment.ravel()] & (right | ~same)
        rank, precision = rank_queries(cosine, same, gallery)
        found.append({"low_edge": low, "high_edge": high, **summary(rank, precision, pairs)})
    return [row for row in found if "rank1" in row]


# ---- Calibration ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Cases:
    """Pairs as a tracker meets them: a detection and what is remembered of one object of its class.

    Of the remembered views the most similar counts, as in the tracker's gallery; objects that are
    in sight beside the detection are no candidates.

    Attributes:
        cosine: (M, 2) of foreground and background. angle: (M,) between the views, deg.
        gap: (M,) frames since the object was seen. same: (M,). query: (M,) the detection.
        newcomer: (M,) was the detection's object out of sight for 30 frames, or never seen?
        shown: cosines (n, 2) that the video shows without labels: of detections and the first views
            of others in their frame, and of their own track, if that began 30 frames ago.
    """

    cosine: Array
    angle: Array
    gap: Array
    same: BoolArray
    query: IntArray
    newcomer: BoolArray
    shown: tuple[Array, Array]

    def decider(self) -> SimilarityCalibration:
        """`SimilarityCalibration` that has seen what the video shows."""
        found = SimilarityCalibration()
        for same, cosine in enumerate(self.shown):
            found.add(cosine[:, 0], cosine[:, 1], bool(same))
        return found

    def balance(self, angle: bool = True) -> Array:
        """Weights (M,) under which both answers are equally likely, at every angle where that is
        known: how often an object is seen again from near is no look, but the camera's path.
        """
        cell = np.digitize(self.angle, ANGLES_DEG[1:-1]) * angle
        both = np.stack([np.bincount(cell, self.same == s) for s in (False, True)])  # (2, cells)
        weight = np.where(both.min(0) >= 3, both.sum(0) / np.maximum(2 * both, 1), 0)
        return np.asarray(weight[self.same.astype(int), cell])

    def decisions(self, odds: float, angle: bool = False) -> tuple[Array, BoolArray]:
        """For every newcomer: probability of the likeliest candidate, and is it the right one?"""
        fore, back = self.cosine.T
        logit = self.decider().logit(fore, back, self.angle if angle else np.nan)
        found = []
        for q in np.unique(self.query[self.newcomer]):
            rows = self.query == q
            chance = match_probability(logit[None, rows], odds)[0]
            found.append((chance.max(), self.same[rows][chance.argmax()]))
        table = np.array(found, np.float64).reshape(-1, 2)
        return table[:, 0], table[:, 1] > 0


def cases_of(scene: Scene, parts: Sequence[npt.NDArray[Any]], weight: float, seed: int) -> Cases:
    """Every detection of a scene against every object of its class seen before: some random 1-12
    of its views, at least some random time ago.
    """
    pairs, rng, away = pairs_of([scene]), np.random.default_rng(seed), 30
    cosine = np.stack([p @ p.T for p in parts], -1)  # (N, N, 2)
    fused, angle = cosine @ [weight, 1 - weight], pairs.angle_deg()
    same_class = pairs.name[:, None] == pairs.name[None]
    same = pairs.same()
    gap = (pairs.frame[:, None] - pairs.frame[None]).astype(np.int64)  # (N, N) frames since row j
    begun = np.array([began(pairs.frame[same[q] & (gap[q] >= 0)], away) for q in range(len(gap))])
    rows, shown = [], ([], [])  # type: ignore[var-annotated]
    for q in range(len(gap)):  # over queries
        here = np.flatnonzero(same_class[q] & (gap[q] == 0))
        for k in here:
            first = np.flatnonzero(same[k] & (pairs.frame == begun[k]))[0]
            if begun[k] <= pairs.frame[q] - away:
                shown[int(k == q)].append(cosine[q, first])
        least, views = rng.choice((15, 30, 60, 120)), rng.choice((1, 2, 4, 8, 12))
        known = (
            same_class[q]
            & (gap[q] > least)
            & ~np.isin(pairs.identity, pairs.identity[here[here != q]])
        )
        for i in np.unique(pairs.identity[known]):
            own = np.flatnonzero(known & (pairs.identity == i))
            own = rng.choice(own, min(views, len(own)), replace=False)
            j = own[fused[q, own].argmax()]
            if not same[q, j] or pairs.frame[own].min() < begun[q]:  # not of the same track
                rows.append((*cosine[q, j], angle[q, j], gap[q, own].min(), same[q, j], q,
                             begun[q] == pairs.frame[q]))  # fmt: skip
    table = np.array(rows, np.float64).reshape(-1, 7)
    flags, query = table[:, [4, 6]] > 0, table[:, 5].astype(np.int64)
    both = tuple(np.array(x, np.float64).reshape(-1, 2) for x in shown)
    return Cases(table[:, :2], table[:, 2], table[:, 3], flags[:, 0], query, flags[:, 1],
                 (both[0], both[1]))  # fmt: skip


def began(frame: IntArray, away: int) -> int:
    """First frame of the latest stretch of frames, with no gap longer than `away`."""
    frame = np.sort(frame)
    return int(frame[np.flatnonzero(np.append(True, np.diff(frame) > away))[-1]])


def fit_logistic(terms: Array, same: BoolArray, weight: Array) -> Array:
    """Coefficients (T,) of a logistic regression without intercept, by Newton's method."""
    coefficients = np.zeros(terms.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-(terms @ coefficients).clip(-30, 30)))
        curvature = (terms.T * (weight * p * (1 - p))) @ terms
        step = np.linalg.solve(curvature, terms.T @ (weight * (same - p)))
        coefficients += step
        if np.abs(step).max() < 1e-6:
            break
    return coefficients


def calibrate(cases: Sequence[Cases]) -> tuple[Array, float]:
    """`SimilarityCalibration.WEIGHTS` and `RETURN_ODDS`: the likeliest ones."""
    fitted: list[tuple[Array, BoolArray, Array]] = []
    for c in cases:
        for angle in (c.angle, np.full(len(c.same), np.nan)):
            fore, back = c.cosine.T
            weight = c.balance(bool(np.isfinite(angle).any())) / max(len(c.same), 1)
            terms = np.nan_to_num(np.stack(c.decider().part_scores(fore, back, angle), -1))
            fitted.append((terms, c.same, weight))
    terms, same, weight = (np.concatenate(x) for x in zip(*fitted, strict=True))
    weights = fit_logistic(terms, same, weight)
    odds = np.exp(np.linspace(-2, 3, 26))
    loss = [sum(log_loss(*c.decisions(o)).sum() for c in cases) for o in odds]
    return weights, float(odds[int(np.argmin(loss))])


def log_loss(probability: Array, same: BoolArray) -> Array:
    """-log of the probability of what is true."""
    return np.asarray(-np.log(np.where(same, probability, 1 - probability).clip(1e-3)))


def reliability(
    probability: Array, same: BoolArray, weight: Array, bins: int = 10
) -> list[dict[str, float]]:
    """Weighted mean probability and fraction of right ones in equal bins of probability."""
    row = np.minimum((probability * bins).astype(int), bins - 1)
    total = np.bincount(row, weight, bins)
    said = np.bincount(row, weight * probability, bins) / np.maximum(total, 1e-12)
    right = np.bincount(row, weight * same, bins) / np.maximum(total, 1e-12)
    return [
        {"said": said[i], "right": right[i], "share": total[i] / total.sum()}
        for i in range(bins) if total[i] > 0
    ]  # fmt: skip


def expected_error(rows: Sequence[dict[str, float]]) -> float:
    """Expected calibration error of `reliability`'s rows."""
    return float(sum(r["share"] * abs(r["said"] - r["right"]) for r in rows))


def unmasked(scene: Scene) -> Scene:
    """The scene as a detector without masks sees it."""
    return dataclasses.replace(scene, runs=[NO_RUNS] * len(scene.runs))


def scene_cases(
    scenes: Sequence[Scene], parts: Sequence[npt.NDArray[Any]], weight: float, draws: int = 3
) -> list[Cases]:
    """Cases of each scene, from the rows of all scenes; some random draws."""
    ends = np.cumsum([len(s.scored) for s in scenes])[:-1]
    own = zip(*(np.split(p, ends) for p in parts), strict=True)
    return [
        cases_of(s, rows, weight, seed)
        for s, rows in zip(scenes, own, strict=True) for seed in range(draws)
    ]  # fmt: skip


def print_calibration(args: Any) -> None:
    """Fit and print the constants of `reobj.appearance.reid`, on rooms with and without masks."""
    plans = [(plan, seed) for plan in args.plan for seed in args.calibrate]
    rooms = [
        room_scene(seed, args.cache, args.every, plan)
        for plan, seed in plans
        if usable("rooms", room_of(seed, plan), False, tune=True)
    ]
    if not rooms:
        raise rt.ReobjError("--calibrate: no room is left")
    rooms += [unmasked(scene) for scene in rooms]
    cases: list[Cases] = []
    for model in args.models:
        own = scene_cases(rooms, embed(rooms, rt.Embedder(model, threads=1)), args.weight)
        weights, odds = calibrate(own)
        print(f"{model}: SimilarityCalibration.WEIGHTS {weights.round(2)}, RETURN_ODDS {odds:.2f}")
        shown = [[c.shown[k] for c in own if len(c.shown[k])] for k in (0, 1)]
        usual = [
            np.mean([SimilarityCalibration.log_similarity(x).mean(0) for x in kind], 0)
            for kind in shown
        ]
        print(f"  SimilarityCalibration.USUAL {np.array(usual).round(2).tolist()}")
        cases += own
    weights, odds = calibrate(cases)
    print(f"together: SimilarityCalibration.WEIGHTS {weights.round(2)}, RETURN_ODDS {odds:.2f}")


def reliabilities(cases: Sequence[Cases]) -> list[dict[str, Any]]:
    """Calibration error, log loss and the bins of the reliability diagram, by known inputs."""
    rows: list[dict[str, Any]] = []
    for known in ("f", "fb", "fba", "decision", "decision, a"):
        angle = known.endswith("a")
        own = [c for c in cases if len(c.same) and not (angle and np.isnan(c.angle).any())]
        if not own:
            continue
        if known.startswith("decision"):
            odds = RETURN_ODDS
            both = zip(*(c.decisions(odds, angle) for c in own), strict=True)
            p, same = (np.concatenate(x) for x in both)
            weight = np.ones(len(p))
        else:
            mask = np.where([True, known != "f"], 1, np.nan)
            p = np.concatenate([
                c.decider().probability(*(c.cosine * mask).T, c.angle if angle else np.nan)
                for c in own
            ])  # fmt: skip
            same = np.concatenate([c.same for c in own])
            weight = np.concatenate([c.balance() for c in own])
        if not weight.sum():
            continue
        bins = reliability(p, same, weight)
        loss = (weight * log_loss(p, same)).sum() / weight.sum()
        right = (weight * ((p > 0.5) == same)).sum() / weight.sum()
        rows.append({"known": known, "cases": len(p), "same": float(same.mean()), "right": right,
                     "ece": expected_error(bins), "log_loss": loss, "bins": bins})  # fmt: skip
    return rows


def plot_reliability(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """Said against true probability, one panel a method; solid: a pair, dashed: a decision."""
    plt = pyplot()
    methods = list(dict.fromkeys(r["method"] for r in rows))
    figure, axes = plt.subplots(1, len(methods), figsize=(4.5 * len(methods), 5.2), squeeze=False)
    for ax, method in zip(axes[0], methods, strict=True):
        ax.plot([0, 1], [0, 1], color="gray", lw=0.8)
        own = [r for r in rows if r["method"] == method and r["known"] in ("fb", "decision")]
        titles = list(dict.fromkeys(r["set"] for r in own))
        for r in own:
            said, right = ([b[k] for b in r["bins"]] for k in ("said", "right"))
            kind = "pair" if r["known"] == "fb" else "decision"
            ax.plot(said, right, "-o" if kind == "pair" else "--s", ms=3,
                    color=f"C{titles.index(r['set'])}",
                    label=f"{r['set']}, {kind}: ECE {r['ece']:.3f}")  # fmt: skip
        ax.set(title=method, xlabel="probability said", ylabel="share that is the same object")
        ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15))
        ax.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(out / "calibration.png", dpi=80)
    plt.close(figure)


# ---- Cost ----------------------------------------------------------------------------------------


def cost_ms(scene: Scene, methods: dict[str, Any], objects: int = 10) -> dict[str, float]:
    """Median wall ms to embed so many objects of one frame, all methods in turn (one thread)."""
    counts = np.bincount(scene.row, minlength=len(scene.images))
    image, found, _ = scene.at(int(counts.argmax()))
    rows = np.resize(np.arange(len(found)), objects)
    spent: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(7):
        for name, (look, _) in methods.items():
            started = time.perf_counter()
            look(image.copy(), found, rows)  # a new frame: the cache is cleared
            spent[name].append(1e3 * (time.perf_counter() - started))
    return {name: float(np.median(values[1:])) for name, values in spent.items()}


# ---- Output --------------------------------------------------------------------------------------


def evaluate(
    title: str, scenes: Sequence[Scene], args: Any
) -> tuple[list[Any], list[Any], list[Any]]:
    """Rows of the table, of the bins and of the calibration for a set of scenes, all methods."""
    pairs = pairs_of(scenes)
    angle = pairs.angle_deg()
    gap = np.abs(pairs.frame[:, None] - pairs.frame[None]).astype(float)
    kinds = ["open", "class", "twins", "single", *(["same"] if (pairs.model >= 0).any() else [])]
    rows, bins, trust = [], [], []
    for method, (look, names) in looks(args, {}).items():
        started = time.time()
        parts = embed(scenes, look)
        if len(parts) == 2 and method.endswith("frame"):
            found = reliabilities(scene_cases(scenes, parts, args.weight))
            trust += [{"set": title, "method": method, **r} for r in found]
        cosines = setups(parts, names, args.weight)
        if args.pictures:
            path = args.out / f"matches_{file_name(title)}_{file_name(method)}.jpg"
            draw_matches(path, scenes, pairs, cosines, args.away, args.pictures)
        for setup, cosine in cosines.items():
            head = {"set": title, "method": method, "setup": setup}
            for kind in kinds:
                for label, away in (("any", 0), ("away", args.away)):
                    ranks = rank_pairs(cosine, pairs, kind, away)
                    row = summary(*ranks, pairs)
                    rows.append({**head, "protocol": kind, "gap": label, **row, "ranks": ranks[0]})
            for label, value, edges in (("angle", angle, ANGLES_DEG), ("gap", gap, GAPS)):
                bins += [{**head, "by": label, **r} for r in by_bin(cosine, pairs, value, edges)]
        print(f"{title}: {method} {time.time() - started:.0f} s", file=sys.stderr)
    return [{**r, "identity": pairs.identity} for r in rows if "rank1" in r], bins, trust


def ratio(rows: Sequence[dict[str, Any]], ours: str, protocol: str, gap: str) -> str:
    """Rank-1 of a method's concat over the best of its own fg, full crops and person networks."""
    part = [r for r in rows if r["protocol"] == protocol and r["gap"] == gap]
    best = [r for r in part if r["method"] == ours and r["setup"] == "concat"]
    others = [r for r in part if r["setup"] in ("full", "box") or
              (r["method"] == ours and r["setup"] == "fg")]  # fmt: skip
    if not best or not others:
        return ""
    rival = max(others, key=lambda r: r["rank1"])
    identity = np.resize(rival["identity"], len(rival["ranks"]))
    draws = bootstrap_draws(identity, np.isfinite(rival["ranks"]))
    drawn = [shares(r["ranks"], identity, draws) for r in (best[0], rival)]
    low, high = np.percentile(drawn[0] / np.maximum(drawn[1], 1e-9), [2.5, 97.5])
    return (
        f"{ours} concat {best[0]['rank1']:.1f} / {rival['method']} {rival['setup']} "
        f"{rival['rank1']:.1f} = {best[0]['rank1'] / max(rival['rank1'], 1e-9):.2f} "
        f"[{low:.2f}, {high:.2f}] ({protocol}, {gap})"
    )


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows, lists left out."""
    omitted = ("ranks", "identity", "bins")
    with atomic(path) as part, part.open("w", newline="") as file:
        names = list(dict.fromkeys(k for r in rows for k in r if k not in omitted))
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Rank-1 of every method and set under the protocols of COLUMNS, as one table."""
    own = {(r["set"], r["protocol"], r["gap"], r["method"], r["setup"]): r for r in rows}
    sets = list(dict.fromkeys(r["set"] for r in rows))
    lines = [f"Rank-1, percent: {' / '.join(f'{k}, {gap}' for k, gap in COLUMNS)}", ""]
    lines += [f"| method | setup | {' | '.join(sets)} |", "|---" * (len(sets) + 2) + "|"]
    cells = []
    for title in sets:
        counts = [next((r for k, r in own.items() if k[:3] == (title, *c)), {}) for c in COLUMNS]
        cells.append(" / ".join(f"{r.get('queries', 0)}" for r in counts))
    lines.append(f"| *queries* | | {' | '.join(cells)} |")
    for method, setup in dict.fromkeys(k[3:] for k in own):
        found = [[own.get((title, *c, method, setup), {}) for c in COLUMNS] for title in sets]
        cells = [" / ".join(f"{r.get('rank1', np.nan):.1f}" for r in one) for one in found]
        lines.append(f"| {method} | {setup} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def markdown_ranks(rows: Sequence[dict[str, Any]]) -> str:
    """Rank-1, -5, -10 and -20 with all scenes and classes in the gallery, as in the thesis."""
    lines = ["Rank-1 / 5 / 10 / 20, percent (open, away)", ""]
    lines += ["| set | method | setup | Rank-1 | Rank-5 | Rank-10 | Rank-20 |", "|---" * 7 + "|"]
    for r in rows:
        if (r["protocol"], r["gap"]) == ("open", "away"):
            cells = " | ".join(f"{r[f'rank{k}']:.1f}" for k in (1, 5, 10, 20))
            lines.append(f"| {r['set']} | {r['method']} | {r['setup']} | {cells} |")
    return "\n".join(lines) + "\n"


def markdown_counts(counts: Sequence[dict[str, Any]]) -> str:
    """Views and instances of each class, and their sums, one table for all sets."""
    lines = ["| set | class | views | instances |", "|---|---|---|---|"]
    for title in dict.fromkeys(r["set"] for r in counts):
        own = [r for r in counts if r["set"] == title]
        total = {k: sum(r[k] for r in own) for k in ("views", "instances")}
        for r in [*own, {"set": title, "class": "*all*", **total}]:
            lines.append(f"| {r['set']} | {r['class']} | {r['views']} | {r['instances']} |")
    return "\n".join(lines) + "\n"


def file_name(text: str) -> str:
    """A text without what file names should not have."""
    return re.sub(r"[ ,/()]+", "_", text).strip("_")


# ---- Pictures of matches -------------------------------------------------------------------------

CELL = 120  # px of a picture of one match
CAPTION = 16  # px of the line below it
RIGHT, WRONG, QUERY = (60, 170, 40), (40, 40, 220), (90, 90, 90)  # BGR


def draw_matches(
    path: Path,
    scenes: Sequence[Scene],
    pairs: Pairs,
    cosines: dict[str, npt.NDArray[Any]],
    away: int,
    count: int,
) -> None:
    """Draw some queries and their BEST matches, right or wrong, a row for each setup.

    The gallery is that of the protocol `open`, more than `away` frames from the query, or any other
    frame where that holds no right one.
    """
    allowed, same = pairs.gallery("open", away), pairs.same()
    near = ~(same & allowed).any(1)
    allowed[near] = pairs.gallery("open", 0)[near]
    queries = chosen_queries(same & allowed, ~same & allowed, pairs.identity, count)
    detection = [(s, int(r)) for s in scenes for r in s.scored]  # of the rows of the pairs
    lines = []
    for q in queries:
        for setup, cosine in cosines.items():
            best = best_matches(cosine[q], allowed[q])
            cells = [match_cell(*detection[int(q)], QUERY, f"query: {setup}")]
            for rank, j in enumerate(best, 1):
                text = "right" if same[q, j] else "wrong"
                color = RIGHT if same[q, j] else WRONG
                cells.append(
                    match_cell(*detection[int(j)], color, f"{rank} {text} {cosine[q, j]:.2f}")
                )
            blank = np.full_like(cells[0], 255)
            lines.append(np.hstack(cells + [blank] * (BEST + 1 - len(cells))))
    if not lines:
        print(f"no {path.name}: no object is seen twice beside another", file=sys.stderr)
        return
    with atomic(path) as part:
        part.write_bytes(cv2.imencode(".jpg", np.vstack(lines))[1].tobytes())


def chosen_queries(
    right: BoolArray, wrong: BoolArray, identity: IntArray, count: int, seed: int = 0
) -> IntArray:
    """Random queries whose gallery holds a right and a wrong one, first one of each identity."""
    valid = np.random.default_rng(seed).permutation(np.flatnonzero(right.any(1) & wrong.any(1)))
    first = np.sort(np.unique(identity[valid], return_index=True)[1])
    order = np.concatenate([valid[first], np.delete(valid, first)])
    return np.asarray(order[:count])


def best_matches(cosine: npt.NDArray[Any], allowed: BoolArray, count: int = BEST) -> IntArray:
    """The most similar rows of the gallery of one query, best first: at most `count`."""
    order = np.argsort(-np.where(allowed, cosine, -np.inf), kind="stable")
    return np.asarray(order[: min(count, int(allowed.sum()))])


def match_cell(scene: Scene, row: int, color: tuple[int, int, int], text: str) -> Image:
    """One object with its surroundings (twice its box) in a frame of a colour, and a caption."""
    image, box = read_image(scene.images[scene.row[row]]), scene.xyxy[row]
    middle, half = (box[:2] + box[2:]) / 2, float((box[2:] - box[:2]).max())
    scale = (CELL - 8) / (2 * half)
    affine = np.column_stack([np.eye(2) * scale, (CELL - 8) / 2 - scale * middle])  # (2, 3)
    inner = cv2.warpAffine(image, affine, (CELL - 8, CELL - 8), borderValue=(200, 200, 200))
    x1, y1, x2, y2 = (box * scale + np.tile(affine[:, 2], 2)).astype(int)
    cv2.rectangle(inner, (x1, y1), (x2, y2), (255, 255, 255), 1)
    cell = np.full((CELL + CAPTION, CELL, 3), 255, np.uint8)
    cell[:CELL] = color
    cell[4 : CELL - 4, 4 : CELL - 4] = inner
    cv2.putText(cell, text, (3, CELL + 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 1)
    return cell


# ---- Plots ---------------------------------------------------------------------------------------


def plot_bins(bins: Sequence[dict[str, Any]], out: Path) -> None:
    """Twin Rank-1 against view angle and time gap, one picture a set."""
    plt = pyplot()
    for title in dict.fromkeys(r["set"] for r in bins):
        figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True)
        for ax, by in zip(axes, ("angle", "gap"), strict=True):
            part = [r for r in bins if (r["set"], r["by"]) == (title, by)]
            part = [r for r in part if r["setup"] not in ("fg", "bg") and r["queries"] >= 20]
            for key in dict.fromkeys((r["method"], r["setup"]) for r in part):
                own = [r for r in part if (r["method"], r["setup"]) == key]
                texts = [f"{r['low_edge']}-{r['high_edge'] if r['high_edge'] < 1e8 else ''}"
                         for r in own]  # fmt: skip
                ax.plot(texts, [r["rank1"] for r in own], marker=".", label=" ".join(key))
            ax.set_xlabel("view angle, deg" if by == "angle" else "time gap, frames")
            ax.grid(alpha=0.3)
        axes[0].set_ylabel("twin Rank-1, %")
        if axes[1].lines:
            axes[1].legend(fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
        figure.suptitle(title, fontsize=10)
        figure.tight_layout()
        figure.savefig(out / f"rank_k_{file_name(title)}.png", dpi=80)
        plt.close(figure)


def pyplot() -> Any:
    """matplotlib without a display."""
    try:
        import matplotlib
    except ImportError as error:
        raise rt.ReobjError("plots need matplotlib: pip install matplotlib") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def usable_scenes(args: Any) -> Iterator[tuple[str, Scene]]:
    """The scenes that may be measured, with the title of their set."""
    for plan, seed in itertools.product(args.plan, args.rooms):
        room = ("rooms", room_of(seed, plan))
        if usable(*room, args.choosing):
            yield marked(*room, f"rooms, {plan}"), room_scene(seed, args.cache, args.every, plan)
    for folder in (f for f in args.recording if usable(*split_name(f), args.choosing)):
        yield marked(*split_name(folder)), recording_scene(folder, args.every)
    for folder in (f for f in args.depth if usable(*split_name(f), args.choosing)):
        yield marked(*split_name(folder), f"{folder.name} (depth)"), depth_scene(folder)
    for folder in args.scannet:
        chosen = (args.every, args.min_mask, args.min_side, args.views)
        yield "scannet", scannet_scene(folder, *chosen)


def scene_sets(args: Any) -> dict[str, list[Scene]]:
    """The scenes to measure, by title."""
    sets: dict[str, list[Scene]] = {}
    for title, scene in usable_scenes(args):
        sets.setdefault(title, []).append(scene)
    if args.detect:
        detect = rt.OnnxDetector(args.detect, threads=1)
        for title, scenes in sets.items():
            sets[title] = [detected_scene(s, detect, detect.class_names) for s in scenes]
    for title, scenes in sets.items():
        if not any(len(s.scored) for s in scenes):
            raise rt.ReobjError(f"{title}: no view is scored: too small, or labels without names")
    return sets


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("-o", "--out", type=Path, required=True)
    add("--rooms", type=int, nargs="*", default=[], metavar="SEED")
    add("--plan", nargs="*", default=["home", "varied"], help="floor plans (default %(default)s)")
    add("--recording", type=Path, nargs="*", default=[], metavar="DIR")
    add("--depth", type=Path, nargs="*", default=[], metavar="DIR")
    add("--scannet", type=Path, nargs="*", default=[], metavar="DIR")
    add("--detect", default="", metavar="MODEL",
        help="use a detector's boxes, associated with the labelled ones")  # fmt: skip
    add("--pictures", type=int, default=0, metavar="N",
        help="draw N queries of each set with their best five matches")  # fmt: skip
    add("--cache", type=Path, default=Path("build/rank_k"), help="folder for rendered rooms")
    add("--every", type=int, default=6, help="use every n-th frame (default %(default)s)")
    add("--away", type=int, default=30, help="frames that count as away (default %(default)s)")
    add("--models", nargs="*", default=["reobj"], help="appearance models (default %(default)s)")
    add("--person", nargs="*", default=[], help="networks for the plain box, as in DeepSORT")
    add("--calibrate", type=int, nargs="*", default=[], metavar="SEED",
        help="fit the constants of the match probability to these rooms, print them")  # fmt: skip
    add("--blocks", type=Path, metavar="DIR",
        help="ConvBlocks of single crops: DIR of train_head.py --crops --setups")  # fmt: skip
    add_choosing(parser)
    add("--no-crops", action="store_true", help="leave out the slow crop references")
    add("--weight", type=float, default=rt.TrackerConfig().foreground_weight,
        help="weight of the foreground in concat (default %(default)s)")  # fmt: skip
    add("--views", type=int, default=0, help="ScanNet: images of each instance (0: all)")
    add("--min-mask", type=int, default=0, help="ScanNet: minimum pixels of a mask")
    add("--min-side", type=float, default=0, help="ScanNet: minimum side of a box, px")
    return parser


def check_words(args: Any) -> None:
    """Refuse numbers and folders that cannot be meant."""
    for name in ("every", "pictures", "away", "views"):
        least = int(name == "every")
        if getattr(args, name) < least:
            raise rt.ReobjError(f"--{name} {getattr(args, name)}: expected {least} or more")
    for folder in (*args.recording, *args.depth, *args.scannet):
        if not folder.is_dir():
            raise rt.ReobjError(f"{folder}: no such folder")


def measure(args: Any) -> None:
    """Measure all sets, write the files, print the tables."""
    check_words(args)
    if args.calibrate:
        print_calibration(args)
    sets = scene_sets(args)
    if not sets:
        raise rt.ReobjError("nothing to measure: give --rooms, --recording, --depth or --scannet "
                            "with some that may be shown")  # fmt: skip
    args.out.mkdir(parents=True, exist_ok=True)
    counts = [r for title, scenes in sets.items() for r in view_counts(title, scenes)]
    print(markdown_counts(counts))
    found = [evaluate(title, scenes, args) for title, scenes in sets.items()]
    rows, bins, trust = ([r for part in found for r in part[i]] for i in range(3))
    if not rows:
        raise rt.ReobjError("nothing to compare: no object is seen in two frames; a smaller "
                            "--every takes more of them")  # fmt: skip
    write_csv(args.out / "counts.csv", counts)
    write_csv(args.out / "rank_k.csv", rows)
    write_csv(args.out / "by_bin.csv", bins)
    plot_bins(bins, args.out)
    if trust:
        write_csv(args.out / "calibration.csv", trust)
        plot_reliability(trust, args.out)
    print(markdown(rows))
    print(markdown_ranks(rows))
    methods = looks(args)
    for title in sets:
        own = [r for r in rows if r["set"] == title]
        for method in methods:
            print(*filter(None, [ratio(own, method, p, g) for p in ("twins", "single", "same")
                                 for g in ("any", "away")]), sep="\n")  # fmt: skip
    spent = cost_ms(next(iter(sets.values()))[0], methods)
    write_csv(args.out / "cost.csv", [{"method": k, "ms_of_10": v} for k, v in spent.items()])
    print("\n".join(f"{k}: {v:.1f} ms for 10 objects" for k, v in spent.items()))


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    args = build_parser().parse_args(argv)
    try:
        measure(args)
    except rt.ReobjError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
