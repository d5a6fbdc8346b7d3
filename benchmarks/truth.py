"""Compare an output folder with ground truth. It reads OUT's public files and nothing of the tool.

Boxes are xyxy in pixels, frames are 0-based. `eval` computes the same figures with the tool's own
code; a fault in that code does not affect these.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

REACH_M, REACH_OF_SIDE = 0.35, 1 / 3  # of a true object: its truth is good to 5 to 20 cm


@dataclass(frozen=True)
class Kind:
    """A true object in 2D.

    Attributes:
        names: classes that it may have. ignore: an area where nothing is annotated, for objects of
            `names`, or for all if there are none. needed: False: it may be found.
    """

    names: frozenset[str]
    ignore: bool = False
    needed: bool = True


@dataclass(frozen=True)
class Truth:
    """Boxes with identities: frame (N,), identity (N,), xyxy (N, 4), clear (N,).

    Attributes:
        clear: False: so occluded that the box need not be found. kinds: by identity. complete:
            the classes of which all objects are annotated; empty: all classes.
    """

    frame: IntArray
    identity: IntArray
    xyxy: Array
    clear: BoolArray
    kinds: Mapping[int, Kind]
    complete: frozenset[str] = field(default_factory=frozenset)

    def of_frames(self, frames: Collection[int]) -> Truth:
        """Return the boxes of some frames, with the objects that these show."""
        keep = np.isin(self.frame, list(frames))
        shown = set(self.identity[keep].tolist())
        kinds = {k: kind for k, kind in self.kinds.items() if k in shown}
        frame, identity, xyxy = self.frame[keep], self.identity[keep], self.xyxy[keep]
        return Truth(frame, identity, xyxy, self.clear[keep], kinds, self.complete)


def read_mot_truth(
    path: Path,
    names: Mapping[int, str] | str,
    objects_2d: Path | None = None,
    complete: Collection[str] = (),
    min_visible: float = 0.0,
) -> Truth:
    """Read rows `frame (1-based), id, left, top, width, height, flag, class, visibility`.

    Args:
        names: of class numbers; one name: that of all objects, and whatever stands in the columns
            of class and visibility is not read. objects_2d: JSON of the objects, whose classes
            count instead.
    """
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    if isinstance(names, str):
        rows, names = np.column_stack([rows[:, :7], np.ones((len(rows), 2))]), {1: names}
    identity = rows[:, 1].astype(np.int64)
    if objects_2d:
        kinds = {int(o["id"]): _kind(o) for o in json.loads(objects_2d.read_text())}
    else:
        pairs = np.unique(rows[:, [1, 7]].astype(np.int64), axis=0).tolist()
        kinds = {i: Kind(frozenset([names[c]])) for i, c in pairs}
    if complete:
        kinds = {i: kind for i, kind in kinds.items() if kind.names & set(complete)}
    keep = np.isin(identity, list(kinds))
    xyxy = np.hstack([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]])[keep]
    clear = rows[keep, 8] >= min_visible
    frame = rows[keep, 0].astype(np.int64) - 1
    return Truth(frame, identity[keep], xyxy, clear, kinds, frozenset(complete))


def _kind(entry: Mapping[str, Any]) -> Kind:
    if entry["class"] == "ignore":
        return Kind(frozenset(entry.get("ignore_classes", ())), ignore=True, needed=False)
    return Kind(frozenset([entry["class"], *entry["also_ok"]]), needed=entry.get("recall", True))


@dataclass(frozen=True)
class Output:
    """What a user finds in an output folder.

    Attributes:
        rows: (N, 6) of tracks.txt: frame, identity, x1, y1, x2, y2.
        objects: of objects.json, without doubtful ones. centres: of the cameras, by frame.
    """

    data: dict[str, Any]
    rows: Array
    objects: list[dict[str, Any]]
    centres: dict[int, Array]

    @staticmethod
    def read(out: Path, times: Sequence[float] = ()) -> Output:
        """Read OUT; times (F,) s: of all frames of the source, else they are frame / fps."""
        data = json.loads((out / "objects.json").read_text())
        rows = np.empty((0, 10))
        if (out / "tracks.txt").read_text().strip():
            rows = np.loadtxt(out / "tracks.txt", delimiter=",", ndmin=2)
        boxes = np.column_stack([rows[:, 0] - 1, rows[:, 1:4], rows[:, 2:4] + rows[:, 4:6]])
        listed = [o for o in data["objects"] if o["status"] not in ("doubtful", "implausible")]
        centres = {}
        if (out / "poses.txt").exists():
            for t, *centre in np.loadtxt(out / "poses.txt", ndmin=2)[:, :4].tolist():
                frame = round(t * data["video"]["fps"])
                if len(times):
                    frame = int(np.abs(np.asarray(times) - t).argmin())
                centres[frame] = np.array(centre)
        return Output(data, boxes, listed, centres)


def _iou(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the IoU (A, B) of boxes, and the fraction of each box b inside each box a."""
    low, high = np.maximum(a[:, None, :2], b[:, :2]), np.minimum(a[:, None, 2:], b[:, 2:])
    inter = (high - low).clip(0).prod(-1)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(1), (b[:, 2:] - b[:, :2]).prod(1)
    union = area_a[:, None] + area_b - inter
    return inter / np.maximum(union, 1e-9), inter / np.maximum(area_b, 1e-9)


@dataclass(frozen=True)
class Found:
    """Identities and the list of objects beside 2D truth.

    Attributes:
        found: true objects that a listed one shows, of `true` that should be. false: listed
            objects that show none, or one that another listed object shows in more frames.
    """

    idf1: float
    found: int
    true: int
    false: int


# Frames of a true object that a list must hold: as many, or this fraction of those annotated
NEEDED_FRAMES, NEEDED_SHARE = 10, 0.25


def score_2d(
    truth: Truth, output: Output, min_iou: float = 0.5, min_iou_list: float = 0.4
) -> Found:
    """Score boxes and the list of objects.

    IDF1 (Ristani et al., 2016): the fraction of boxes that agree, true and found identities matched
    one to one over the video; a pair agrees in a frame if it overlaps by `min_iou` and the class
    fits. An object shows a true one if it does in half of its frames (`min_iou_list`). What lies
    on areas without annotation, or on objects that need not be found, does not count.
    """
    objects = [o for o in output.objects if not truth.complete or o["class"] in truth.complete]
    column = {o["id"]: k for k, o in enumerate(objects)}
    ids = list(truth.kinds)
    row_of = {identity: k for k, identity in enumerate(ids)}
    area = np.array([truth.kinds[i].ignore for i in ids], bool)
    fits = np.array(
        [
            [
                o["class"] in truth.kinds[i].names or (a and not truth.kinds[i].names)
                for o in objects
            ]
            for i, a in zip(ids, area.tolist(), strict=True)
        ],
        bool,
    ).reshape(len(ids), len(objects))
    pairs, listed = np.zeros(fits.shape), np.zeros(fits.shape)
    boxes, outside = np.zeros(len(objects)), np.zeros((2, len(objects)))
    for frame in np.unique(output.rows[:, 0]):
        rows = output.rows[output.rows[:, 0] == frame]
        rows = rows[np.isin(rows[:, 1], list(column))]
        o = np.array([column[int(i)] for i in rows[:, 1]], np.int64)
        here = truth.frame == frame
        g = np.array([row_of[i] for i in truth.identity[here].tolist()], np.int64)
        iou, inside = _iou(truth.xyxy[here], rows[:, 2:])
        able, spare = fits[np.ix_(g, o)], area[g] | ~truth.clear[here]
        np.add.at(boxes, o, 1)
        for table, overlap, off in (
            (pairs, min_iou, outside[0]),
            (listed, min_iou_list, outside[1]),
        ):
            hit = able & (iou >= overlap)
            a, b = np.nonzero(hit & ~spare[:, None])
            np.add.at(table, (g[a], o[b]), 1)
            left = (able & spare[:, None] & ((inside >= 0.5) | hit)).any(0)
            off[o[left & ~(hit & ~spare[:, None]).any(0)]] += 1
    count = np.array([((truth.identity == i) & truth.clear).sum() for i in ids])
    needed = np.array([truth.kinds[i].needed for i in ids], bool) & ~area
    g, o = linear_sum_assignment(-pairs)
    right = pairs[g, o]
    total = count[needed].sum() + right[~needed[g]].sum() + (boxes - outside[0]).sum()
    best = listed.max(0, initial=0)
    shows = (best > 0) & (best >= 0.5 * (boxes - outside[1]))
    judged = shows | (outside[1] < 0.5 * boxes)
    shown = set(listed.argmax(0)[shows].tolist()) if len(ids) else set()
    enough = min(NEEDED_FRAMES, NEEDED_SHARE * len(np.unique(truth.frame)))
    must = set(np.flatnonzero(needed & (count >= enough)).tolist())
    false = int(judged.sum()) - len(shown)
    return Found(float(2 * right.sum() / max(total, 1)), len(must & shown), len(must), false)


def counted(output: Output, kinds: Mapping[str, int]) -> Found:
    """Score a recording of which only is known how many objects of some classes there are."""
    names = [o["class"] for o in output.objects]
    listed = {name: names.count(name) for name in kinds}
    found = sum(min(listed[name], number) for name, number in kinds.items())
    false = sum(max(listed[name] - number, 0) for name, number in kinds.items())
    return Found(float("nan"), found, sum(kinds.values()), false)


# ---- Cameras and solids ------------------------------------------------------------------------


def similarity(points: Array, target: Array) -> tuple[float, Array, Array]:
    """Return s, R, t with target (N, 3) = s R points (N, 3) + t (Umeyama, PAMI 1991)."""
    p, q = points - points.mean(0), target - target.mean(0)
    u, d, vt = np.linalg.svd(q.T @ p)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u * sign @ vt
    scale = float((d * sign).sum() / (p**2).sum())
    return scale, turn, target.mean(0) - scale * turn @ points.mean(0)


def rotation_errors(found: Array, truth: Array) -> Array:
    """Return the errors (n,) of orientations, degrees, after the common rotation of most of them.

    Args:
        found, truth: cam_from_world (n, 3, 3) or (n, 3, 4), n >= 1.
    """
    relative = Rotation.from_matrix(truth[:, :, :3].swapaxes(1, 2) @ found[:, :, :3])
    turn = relative.as_matrix().reshape(-1, 9)
    apart = np.arccos(((turn @ turn.T - 1) / 2).clip(-1, 1))  # (n, n) rad
    middle = apart[np.median(apart, axis=1).argmin()]
    common = relative[middle <= 2 * np.median(middle) + 1e-6].mean()
    return np.asarray(np.degrees((common.inv() * relative).magnitude()))


@dataclass(frozen=True)
class Cameras:
    """Camera centres beside the truth: errors in its units, and the similarity to its world."""

    located: int
    median: float
    worst: float
    extent: float  # of the true path
    truth_from_ours: tuple[float, Array, Array]


def score_cameras(output: Output, true_centres: Mapping[int, Array], own: bool) -> Cameras | None:
    """Compare camera centres, after a similarity where the tool made the cameras (`own`)."""
    frames = sorted(set(output.centres) & set(true_centres))
    if len(frames) < 3:
        return None
    ours = np.array([output.centres[f] for f in frames])
    true = np.array([true_centres[f] for f in frames])
    scale, turn, shift = similarity(ours, true) if own else (1.0, np.eye(3), np.zeros(3))
    error = np.linalg.norm(scale * ours @ turn.T + shift - true, axis=1)
    extent = float(np.linalg.norm(np.ptp(true, axis=0)))
    figures = float(np.median(error)), float(error.max()), extent
    return Cameras(len(frames), *figures, (scale, turn, shift))


@dataclass(frozen=True)
class Solids:
    """Solids beside true ones: found one to one, of `true`; errors of those found, medians."""

    found: int
    true: int
    centre_m: float
    size: float  # relative, over all three sides


def score_solids(
    true: Sequence[Mapping[str, Any]],
    output: Output,
    truth_from_ours: tuple[float, Array, Array],
) -> Solids:
    """Match solids (of the largest component) with true boxes of their class, in reach, one to one.

    Args:
        true: each `class`, `center` (3,) m, `size_m` (3,), `world_from_obj` (3, 3).
    """
    scale, turn, shift = truth_from_ours
    own = [o for o in output.objects if o["center"] is not None and not o.get("part")]
    center = scale * np.reshape([o["center"] for o in own], (-1, 3)) @ turn.T + shift
    goal = np.reshape([t["center"] for t in true], (-1, 3))
    distance = np.linalg.norm(goal[:, None] - center, axis=2)
    reach = np.maximum(
        REACH_M, REACH_OF_SIDE * np.reshape([t["size_m"] for t in true], (-1, 3)).max(1)
    )
    same = np.array([[t["class"] == o["class"] for o in own] for t in true], bool)
    able = same.reshape(distance.shape) & (distance <= reach[:, None])
    a, b = linear_sum_assignment(np.where(able, distance, 1e3))
    keep = able[a, b]
    sizes = []
    for i, j in zip(a[keep].tolist(), b[keep].tolist(), strict=True):
        quat = np.roll(own[j]["quat_wxyz"], -1)
        axes = turn @ Rotation.from_quat(quat).as_matrix()
        _, order = linear_sum_assignment(-np.abs(np.transpose(true[i]["world_from_obj"]) @ axes))
        sizes.append(np.abs(scale * np.array(own[j]["size"])[order] / true[i]["size_m"] - 1))
    if not sizes:
        return Solids(0, len(true), float("nan"), float("nan"))
    return Solids(
        len(sizes), len(true), float(np.median(distance[a, b][keep])), float(np.median(sizes))
    )


def read_centres(path: Path) -> Array:
    """Read camera centres (F, 3) of TUM rows, or of a 4x4 or 3x4 world_from_cam a line."""
    rows = np.loadtxt(path, ndmin=2)
    if rows.shape[1] == 8:
        return np.asarray(rows[:, 1:4])
    return np.asarray(rows.reshape(len(rows), -1, 4)[:, :3, 3])
