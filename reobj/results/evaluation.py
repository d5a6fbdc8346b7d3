"""Evaluation against ground truth: HOTA, CLEAR MOT, IDF1, Rank-k of returns; in 3D: solids.py.

Start at `evaluate`; `score_tracks` scores any two sets of `LabelledBoxes`. Writes nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from reobj import __version__
from reobj.files import wrapped
from reobj.results.result import Result
from reobj.results.solids import score_objects
from reobj.results.truth import (
    IGNORED,
    SCORED,
    LabelledBoxes,
    check_counts,
    read_result,
    read_truth,
    with_common_names,
)
from reobj.results.workspace import LAST_TRACKS, Workspace
from reobj.sources.video import InputConfig
from reobj.types import (
    COCO_NAMES,
    Array,
    BoolArray,
    IntArray,
    ReobjError,
    box_iou,
    rows_by,
    unit_rows,
)

MATCH_IOU = 0.5 - 1e-12  # of a box and its truth, but for HOTA (MOTChallenge); .5 itself is enough
TINY = 1e-12  # of scores and unions: not zero

_Step = tuple[IntArray, IntArray, Array]  # of a frame: truth (g,), result (p,), IoU (g, p)


def _frame_steps(truth: LabelledBoxes, found: LabelledBoxes) -> list[_Step]:
    """Pair truth and result frame by frame.

    Returns:
        for every frame with either, by number: rows of the truth (g,) and of the result (p,), and
        their IoU (g, p), 0 between different classes.
    """
    frames = np.union1d(truth.frame, found.frame)
    rows = []
    for boxes in (truth, found):
        order = np.argsort(boxes.frame, kind="stable")
        rows.append(np.split(order, np.searchsorted(boxes.frame[order], frames[1:])))
    steps = []
    for g, p in zip(*rows, strict=True):
        a = truth.name[g][:, None]
        b = found.name[p][None]
        same = (a == b) | (a == "") | (b == "")
        steps.append((g, p, np.where(same, box_iou(truth.xyxy[g], found.xyxy[p]), 0.0)))
    return steps


def _best_pairs(score: Array) -> tuple[IntArray, IntArray]:
    """Assign rows to columns of the largest total score, without pairs of score 0."""
    rows, columns = linear_sum_assignment(-score)
    good = score[rows, columns] > TINY
    return rows[good], columns[good]


def drop_ignored(truth: LabelledBoxes, found: LabelledBoxes) -> LabelledBoxes:
    """Drop results that are matched to an ignored row of the truth, as MOTChallenge does."""
    keep = np.ones(len(found), bool)
    for g, p, iou in _frame_steps(truth, found) if (truth.role == IGNORED).any() else ():
        a, b = _best_pairs(np.where(iou >= MATCH_IOU, iou, 0))
        keep[p[b]] &= truth.role[g[a]] != IGNORED
    return found[keep]


def _numbered(
    truth: LabelledBoxes, found: LabelledBoxes
) -> tuple[IntArray, IntArray, list[_Step], IntArray, IntArray]:
    """Number the identities of truth and result.

    Returns:
        true identities (G,) and found ones (P,), the steps with their numbers in place of rows, and
        how many boxes each has, (G,) and (P,).
    """
    truth = truth[truth.role == SCORED]
    gt_ids, gt, gt_size = np.unique(truth.identity, return_inverse=True, return_counts=True)
    ids, pr, pr_size = np.unique(found.identity, return_inverse=True, return_counts=True)
    steps = [(gt[g], pr[p], iou) for g, p, iou in _frame_steps(truth, found)]
    return gt_ids, ids, steps, gt_size, pr_size


def score_tracks(truth: LabelledBoxes, found: LabelledBoxes) -> dict[str, float]:
    """Compute HOTA, CLEAR MOT and identity scores as TrackEval does, and scores of our own.

    Returns:
        shares in [0, 1] and counts by name. Ours: `ids_per_object`, identities matched at IoU .5 to
        a true object, mean over the objects that were matched at all; `returns`, true objects that
        came back (see `visits`), and `returns_kept`, the share of them that kept an identity.
    Ref: Luiten et al., IJCV 2021; Bernardin & Stiefelhagen, 2008; Ristani et al., 2016.
    """
    found = drop_ignored(truth, found)
    gt_ids, ids, steps, gt, pr = _numbered(truth, found)
    result = _hota(steps, gt, pr) | _clear(steps, gt, pr) | _identity(steps, gt, pr)
    result |= _returns(truth, found)
    return result | {"gt_objects": len(gt_ids), "identities": len(ids)}


AWAY_FRAMES = 30  # without a box, after which an object has left; chosen: about a second


def visits(truth: LabelledBoxes, away: int = AWAY_FRAMES) -> IntArray:
    """Number the visits of each object: (N,) visit of each box, from 0.

    A new one begins where the next box of an object is more than `away` frames later.
    """
    order = np.lexsort((truth.frame, truth.identity))
    new = np.append(True, np.diff(truth.identity[order]) != 0)[: len(order)]
    late = np.append(False, np.diff(truth.frame[order]) > away)[: len(order)] & ~new
    count = np.cumsum(late)
    visit = np.empty(len(order), np.int64)
    visit[order] = count - np.maximum.accumulate(np.where(new, count, 0))
    return visit


def _visit_of_object(truth: LabelledBoxes, visit: IntArray) -> IntArray:
    """Number the visits (N,) of all objects, by object and then by time."""
    number = np.unique(truth.identity, return_inverse=True)[1]
    return np.asarray(visit + (visit.max(initial=0) + 1) * number, np.int64)


def matched_rows(truth: LabelledBoxes, found: LabelledBoxes) -> tuple[IntArray, IntArray]:
    """Match truth and result frame by frame, at IoU >= .5 and of the largest total IoU.

    Returns:
        rows of the truth that count and of the result, (M,) each, pair by pair.
    """
    pairs = [np.empty((2, 0), np.int64)]
    for g, p, iou in _frame_steps(truth, found):
        a, b = _best_pairs(np.where(iou >= MATCH_IOU, iou, 0))
        pairs.append(np.stack([g[a], p[b]]))
    rows = np.concatenate(pairs, 1)
    scored = truth.role[rows[0]] == SCORED
    return rows[0][scored], rows[1][scored]


def _returns(truth: LabelledBoxes, found: LabelledBoxes) -> dict[str, float]:
    """Count returns of true objects, and the share whose main identity they had on a visit before.

    Visits without any match are left out.
    """
    visit = visits(truth)
    g, p = matched_rows(truth, found)
    known: dict[int, set[int]] = {}
    kept = []
    for rows in rows_by(_visit_of_object(truth, visit)[g]):
        ids, votes = np.unique(found.identity[p[rows]], return_counts=True)
        before = known.setdefault(int(truth.identity[g[rows[0]]]), set())
        kept += [int(ids[votes.argmax()]) in before] if before else []
        before.add(int(ids[votes.argmax()]))
    return {"returns": len(kept), "returns_kept": sum(kept) / max(len(kept), 1)}


QUERY_FRAMES = 10  # first ones of a return, whose boxes are queries; chosen: .3 s of video


def return_ranks(
    truth: LabelledBoxes, found: LabelledBoxes, embedding: npt.NDArray[Any]
) -> IntArray:
    """Rank the right object by cosine similarity alone, for the first views of every return.

    A query is a box of the first frames of a return (see `visits`); its gallery are all boxes of
    earlier frames whose objects have its class; of each object the most similar box counts.
    Rank-k is the share of ranks <= k.

    Args:
        embedding: (N, E) unit rows, one for each row of `found`; NaN where there is none.
    Returns:
        (Q,) ranks from 1.
    """
    visit = visits(truth)
    g, p = matched_rows(truth, found)
    use = np.isfinite(embedding[p]).all(1)
    g = g[use]
    p = p[use]
    ranks = []
    for rows in rows_by(_visit_of_object(truth, visit)[g]):
        start = truth.frame[g[rows]].min()
        own = int(truth.identity[g[rows[0]]])
        known = np.flatnonzero(truth.frame[g] < start)
        known = known[truth.name[g[known]] == truth.name[g[rows[0]]]]
        ids, of = np.unique(truth.identity[g[known]], return_inverse=True)
        if own in ids:
            first = rows[truth.frame[g[rows]] < start + QUERY_FRAMES]
            best = np.full((len(ids), len(first)), -np.inf)
            np.maximum.at(best, of, embedding[p[known]] @ embedding[p[first]].T)
            ranks.append(1 + (best > best[ids == own]).sum(0))
    return np.concatenate(ranks) if ranks else np.empty(0, np.int64)


def _hota(steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray) -> dict[str, float]:
    """Compute HOTA, detection and association accuracy, each the mean over IoU .05 to .95."""
    align = np.zeros((len(gt_size), len(pr_size)))  # (G, P) soft number of common frames
    for g, p, iou in steps:
        union = iou.sum(0)[None] + iou.sum(1)[:, None] - iou
        align[g[:, None], p[None]] += iou / np.maximum(union, TINY)
    align /= np.maximum(gt_size[:, None] + pr_size[None] - align, TINY)  # soft Jaccard index
    pairs = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    for g, p, iou in steps:
        a, b = _best_pairs(align[g[:, None], p[None]] * iou)
        pairs.append((g[a], p[b], iou[a, b]))
    g_all, p_all, iou_all = (np.concatenate(x) for x in zip(*pairs, strict=True))
    parts = []
    for alpha in np.arange(0.05, 0.99, 0.05):
        hit = iou_all >= alpha - 1e-12
        common = np.zeros_like(align)  # (G, P) TPA
        np.add.at(common, (g_all[hit], p_all[hit]), 1)
        jaccard = common / np.maximum(gt_size[:, None] + pr_size[None] - common, 1)
        # AssA = sum over TP of TPA / (TPA + FPA + FNA), over |TP|; DetA = |TP| / (|TP| + FP + FN)
        ass = (common * jaccard).sum() / max(hit.sum(), 1)
        det = hit.sum() / max(gt_size.sum() + pr_size.sum() - hit.sum(), 1)
        parts.append((math.sqrt(ass * det), det, ass))
    return dict(zip(("HOTA", "DetA", "AssA"), np.mean(parts, 0).tolist(), strict=True))


def _clear(steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray) -> dict[str, float]:
    """Compute CLEAR MOT at IoU .5; a match of the frame before is kept while it overlaps."""
    last = np.full(len(gt_size), -1)  # identity of the last match ever
    before = last.copy()  # and of the match in the last frame with truth
    switches = hits = 0
    starts = np.zeros(len(gt_size), np.int64)
    met = np.zeros((len(gt_size), len(pr_size)), bool)
    for g, p, iou in steps:
        if not len(g) or not len(p):
            continue  # as TrackEval: a frame without either does not end a match
        kept = 1000.0 * (before[g][:, None] == p[None])  # outweighs any sum of IoU
        a, b = _best_pairs(np.where(iou >= MATCH_IOU, kept + iou, 0))
        g = g[a]
        p = p[b]
        switches += int(((last[g] >= 0) & (last[g] != p)).sum())
        hits += len(g)
        met[g, p] = True
        starts[g] += before[g] < 0
        last[g] = p
        before[:] = -1
        before[g] = p
    gt = int(gt_size.sum())
    pr = int(pr_size.sum())
    return {
        "MOTA": 1 - (gt + pr - 2 * hits + switches) / gt if gt else 0.0,
        "IDSW": switches,
        "Frag": int((starts - 1).clip(0).sum()),
        "recall": hits / max(gt, 1),
        "precision": hits / max(pr, 1),
        "ids_per_object": float(met.sum() / max(met.any(1).sum(), 1)),
    }


def _identity_pairs(steps: Sequence[_Step], shape: tuple[int, ...]) -> tuple[Any, Any, Array]:
    """Map true to found identities one to one, for the most frames in common.

    Returns:
        numbers of true and of found identities and their frames in common, (K,) each.
    """
    common = np.zeros(shape)
    for g, p, iou in steps:
        common[g[:, None], p[None]] += iou >= MATCH_IOU
    a, b = _best_pairs(common)
    return a, b, common[a, b]


def _identity(steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray) -> dict[str, float]:
    """Compute F1, precision and recall of identities under the best one-to-one map."""
    right = float(_identity_pairs(steps, (len(gt_size), len(pr_size)))[2].sum())
    gt = int(gt_size.sum())
    pr = int(pr_size.sum())
    shares = (2 * right / max(gt + pr, 1), right / max(pr, 1), right / max(gt, 1))
    return dict(zip(("IDF1", "IDP", "IDR"), shares, strict=True))


def identity_map(truth: LabelledBoxes, found: LabelledBoxes) -> dict[int, int | None]:
    """Map every true identity to the found one of the most common frames, one to one, or None."""
    gt_ids, ids, steps, *_ = _numbered(truth, found)
    a, b, _ = _identity_pairs(steps, (len(gt_ids), len(ids)))
    pairs: dict[int, int | None] = dict.fromkeys(gt_ids.tolist())
    return pairs | dict(zip(gt_ids[a].tolist(), ids[b].tolist(), strict=True))


_COLUMNS = "HOTA DetA AssA IDF1 IDP IDR MOTA IDSW Frag ids_per_object".split()
_COUNTS = ("IDSW", "Frag", "ids_per_object")  # the others are shares


def score_table(scores: dict[str, dict[str, float]]) -> str:
    """Format one line for each name, shares in per cent."""
    lines = [f"{'':<14}" + "".join(f"{c[:7]:>8}" for c in _COLUMNS)]
    for name, score in scores.items():
        cells = [score[c] * (1 if c in _COUNTS else 100) for c in _COLUMNS]
        lines.append(f"{name[:14]:<14}" + "".join(f"{cell:8.2f}" for cell in cells))
    return "\n".join(lines)


def score_report(scores: dict[str, Any]) -> str:
    """Format what `evaluate` returns for the terminal."""
    tracks: dict[str, dict[str, float]] = scores["tracks"]
    found = {n: s for n, s in tracks.items() if n == "all" or s["IDF1"] or s["HOTA"] or s["IDP"]}
    lines = [score_table(found)]
    ranks = scores["ranks"]
    if missed := [name for name in tracks if name not in found]:
        lines += wrapped(f"nothing found of: {', '.join(missed)}")
    shares = [f"{k.replace('rank', 'Rank-')} {v:.3f}" for k, v in ranks.items() if k != "queries"]
    if ranks:
        lines.append(f"returns by appearance alone, {ranks['queries']:.0f} queries: "
                     + (", ".join(shares) or "no returns"))  # fmt: skip
    else:
        lines.append("Rank-k: no embeddings here (an output folder of `run` or `track` keeps them)")
    if "objects" in scores:
        numbers = {k: v for k, v in scores["objects"].items() if isinstance(v, int | float)}
        lines.append("3D: " + ", ".join(f"{k} {v:.3g}" for k, v in numbers.items()))
    for text in scores.get("messages", ()):
        lines += wrapped(f"note: {text}")
    return "\n".join(lines)


def evaluate(
    out: str | Path,
    gt: str | Path,
    solids: str | Path | None = None,
    truth_poses: str | Path | None = None,
    classes: Sequence[str] = (),
    min_visibility: float = 0.0,
) -> dict[str, Any]:
    """Score an output folder of `run`, or a tracks.txt, against ground truth.

    Truth of frames that --start, --stop and --every left out, or that the detector was not run on,
    does not count; nor do boxes in the latter.

    Args:
        out: folder; or MOT rows. The tracks.txt in an output folder means the folder.
        gt: MOTChallenge gt.txt, KITTI tracking labels, CVAT for video, COCO-VID.
        solids: gt_objects.json; truth_poses: TUM, or a 4x4 world_from_cam a line. classes: only
            these. min_visibility: truth that is less visible is ignored.
    Returns:
        {"tracks": scores by class, "ranks": Rank-k of the returns, "objects": scores in 3D,
        "messages": what was assumed}.
    Raises:
        ReobjError: a file is missing or of another form, no true box counts, an identity has two
            boxes in a frame, or a class is in none of them.
    """
    out = Path(out)
    names = COCO_NAMES
    tracked = None
    if out.name == TRACKS_FILE and (out.parent / LAST_TRACKS).exists():
        out = out.parent
    said: list[str] = []
    found = read_result(out, said)
    if (out / LAST_TRACKS).exists():
        workspace = Workspace.open(out)
        tracked = workspace.load_last()
        names = tracked.class_names
    size = (0, 0) if tracked is None else (tracked.video.width, tracked.video.height)
    truth = read_truth(Path(gt), names, min_visibility, said, size)
    check_counts(truth, Path(gt))
    if tracked is not None:
        read = truth[_was_read(truth.frame - 1, workspace.source[1])]
        check_counts(
            read, Path(gt), "none lies in a frame that was read (--start, --stop, --every)"
        )
        truth, found = _looked_at(read, found, tracked.looked, said)
        check_counts(truth, Path(gt), "none lies in a frame that the detector was run on")
    truth, found, named = with_common_names(truth, found, said)
    unknown = set(classes) - set(truth.name) - set(found.name)
    if unknown:
        raise ReobjError(f"--classes: {', '.join(sorted(unknown))}: neither in the truth nor found")
    wanted = list(classes) or sorted(set(truth.name[truth.role == SCORED]) - {""})
    if classes:
        truth, found = _of_classes(truth, found, classes, named)
        check_counts(truth, Path(gt), f"none is of {', '.join(classes)}")
    scores = {"all": score_tracks(truth, found)}
    if named and len(wanted) > 1:
        for name in wanted:
            scores[name] = score_tracks(*_of_classes(truth, found, [name], named))
    result: dict[str, Any] = {"version": __version__, "gt": str(gt), "tracks": scores}
    result["ranks"] = score_appearance(tracked, truth) if tracked is not None else {}
    result["messages"] = said
    if solids is not None:
        pairs = identity_map(truth, found)
        poses = Path(truth_poses) if truth_poses else None
        result["objects"] = score_objects(Result.load(out), Path(solids), poses, pairs)
    return result


TRACKS_FILE = "tracks.txt"  # of an output folder


def _of_classes(
    truth: LabelledBoxes, found: LabelledBoxes, classes: Sequence[str], named: bool
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Keep the rows of some classes.

    Where the result has no classes (not `named`), boxes on other truth are dropped with it.
    """
    mine, theirs = (np.isin(x.name, [*classes, ""]) for x in (truth, found))
    if named:
        return truth[mine], found[theirs]
    role = np.where(mine | (truth.role != SCORED), truth.role, IGNORED)
    return dataclasses.replace(truth, role=role), found


def _looked_at(
    truth: LabelledBoxes, found: LabelledBoxes, looked: IntArray | None, said: list[str]
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Keep the frames that the detector was run on (None: all)."""
    if looked is None:
        return truth, found
    kept = truth[np.isin(truth.frame - 1, looked)]
    said.append(
        f"{len(truth) - len(kept)} of {len(truth)} true boxes do not count: they lie in frames "
        f"that the detector was not run on (it was on {len(looked)})"
    )
    return kept, found[np.isin(found.frame - 1, looked)]


def score_appearance(tracked: Result, truth: LabelledBoxes) -> dict[str, float]:
    """Compute Rank-k of the returns by appearance alone (`return_ranks`), k = 1, 5, 20, 50.

    Returns:
        number of queries and shares; {} where nothing was embedded (--embed none).
    """
    embeddings = tracked.embeddings
    tracks = tracked.tracks[tracked.embedding_row]
    if not embeddings.foreground.size:
        return {}
    identity = np.arange(len(tracks))
    names = np.array([*tracked.class_names, ""])[tracks.class_id]  # -1: unknown
    role = np.full(len(tracks), SCORED)
    found = LabelledBoxes(tracks.frame + 1, identity, tracks.xyxy, names, role)
    fused = np.concatenate([embeddings.foreground, embeddings.background], 1)
    rank = return_ranks(truth, found, unit_rows(fused))
    shares = {f"rank{k}": float((rank <= k).mean()) for k in (1, 5, 20, 50)} if len(rank) else {}
    return {"queries": len(rank), **shares}


def _was_read(frame: IntArray, config: InputConfig) -> BoolArray:
    """Mark the source frames (N,) that lie within --start, --stop, --every."""
    after = frame - config.start
    inside = (after >= 0) & (after % config.every == 0)
    return np.asarray(inside & (frame < (config.stop or np.inf)), bool)
