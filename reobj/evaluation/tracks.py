"""Evaluation against ground truth: HOTA, CLEAR MOT, IDF1, Rank-k of returns (3D: evaluation_3d).

Start at `evaluate`; `score_tracks` compares any two sets of `LabelledBoxes`. Writes no files.
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
from reobj.evaluation.objects import score_objects
from reobj.evaluation.truth import (
    LabelledBoxes,
    Role,
    check_counts,
    read_result,
    read_truth,
    with_common_names,
)
from reobj.files import wrapped
from reobj.formats import AUTO
from reobj.results.entries import OutputFile
from reobj.results.result import Result
from reobj.results.workspace import Workspace
from reobj.sources.video import InputConfig
from reobj.types import (
    COCO_NAMES,
    Array,
    IntArray,
    ReobjError,
    box_iou,
    rows_by,
    unit_rows,
)
from reobj.words import meant

MATCH_IOU = 0.5 - 1e-12  # least IoU of a match, except for HOTA (MOTChallenge: .5, inclusive)

_Step = tuple[IntArray, IntArray, Array]  # of a frame: truth (g,), result (p,), IoU (g, p)


def _frame_steps(truth: LabelledBoxes, predicted: LabelledBoxes) -> list[_Step]:
    """Compute the IoU of truth and result in each frame.

    Returns:
        for every frame with boxes, ascending: rows of the truth (g,) and of the result (p,), and
        their IoU (g, p), 0 for different classes.
    """
    frames = np.union1d(truth.frame, predicted.frame)
    rows = []
    for boxes in (truth, predicted):
        order = np.argsort(boxes.frame, kind="stable")
        rows.append(np.split(order, np.searchsorted(boxes.frame[order], frames[1:])))
    steps = []
    for g, p in zip(*rows, strict=True):
        a = truth.name[g][:, None]
        b = predicted.name[p][None]
        same = (a == b) | (a == "") | (b == "")
        steps.append((g, p, np.where(same, box_iou(truth.xyxy[g], predicted.xyxy[p]), 0.0)))
    return steps


def _best_pairs(score: Array) -> tuple[IntArray, IntArray]:
    """Assign rows to columns with the largest total score, without pairs of score 0."""
    rows, columns = linear_sum_assignment(-score)
    positive = score[rows, columns] > 1e-12
    return rows[positive], columns[positive]


def drop_ignored(truth: LabelledBoxes, predicted: LabelledBoxes) -> LabelledBoxes:
    """Drop results matched to an ignored true box, as MOTChallenge does."""
    keep = np.ones(len(predicted), bool)
    for g, p, iou in _frame_steps(truth, predicted) if (truth.role == Role.IGNORED).any() else ():
        a, b = _best_pairs(np.where(iou >= MATCH_IOU, iou, 0))
        keep[p[b]] &= truth.role[g[a]] != Role.IGNORED
    return predicted[keep]


def _numbered(
    truth: LabelledBoxes, predicted: LabelledBoxes
) -> tuple[IntArray, IntArray, list[_Step], IntArray, IntArray]:
    """Number the identities of truth and result.

    Returns:
        identities of truth (G,) and result (P,), the steps with identity numbers instead of rows,
        and the number of boxes of each identity, (G,) and (P,).
    """
    truth = truth[truth.role == Role.SCORED]
    gt_ids, gt, gt_size = np.unique(truth.identity, return_inverse=True, return_counts=True)
    ids, pr, pr_size = np.unique(predicted.identity, return_inverse=True, return_counts=True)
    steps = [(gt[g], pr[p], iou) for g, p, iou in _frame_steps(truth, predicted)]
    return gt_ids, ids, steps, gt_size, pr_size


def score_tracks(truth: LabelledBoxes, predicted: LabelledBoxes) -> dict[str, float]:
    """Compute HOTA, CLEAR MOT and identity scores as TrackEval does, and further scores.

    Returns:
        rates in [0, 1] and counts by name. Further ones: `ids_per_object`, number of identities
        matched to a true object at IoU .5, mean over the matched objects; `returns`, number of
        returns of true objects (see `visits`); `returns_kept`, rate of returns with an earlier
        identity of the object.
    Ref: Luiten et al., IJCV 2021; Bernardin & Stiefelhagen, 2008; Ristani et al., 2016.
    """
    predicted = drop_ignored(truth, predicted)
    gt_ids, ids, steps, gt, pr = _numbered(truth, predicted)
    result = _hota(steps, gt, pr) | _clear(steps, gt, pr) | _identity(steps, gt, pr)
    result |= _returns(truth, predicted)
    return result | {"gt_objects": len(gt_ids), "identities": len(ids)}


def visits(truth: LabelledBoxes, away: int = 30) -> IntArray:
    """Number the visits of each object: (N,) visit of each box, from 0.

    Args:
        away: a new visit begins after more frames without a box of the object (30: about a second).
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


def matched_rows(truth: LabelledBoxes, predicted: LabelledBoxes) -> tuple[IntArray, IntArray]:
    """Match truth and result frame by frame at IoU >= .5, with the largest total IoU.

    Returns:
        rows (M,) of the Role.SCORED true boxes and of the result.
    """
    pairs = [np.empty((2, 0), np.int64)]
    for g, p, iou in _frame_steps(truth, predicted):
        a, b = _best_pairs(np.where(iou >= MATCH_IOU, iou, 0))
        pairs.append(np.stack([g[a], p[b]]))
    rows = np.concatenate(pairs, 1)
    scored = truth.role[rows[0]] == Role.SCORED
    return rows[0][scored], rows[1][scored]


def _returns(truth: LabelledBoxes, predicted: LabelledBoxes) -> dict[str, float]:
    """Count returns of true objects, and the rate whose main identity is that of an earlier visit.

    Visits without a match are left out.
    """
    visit = visits(truth)
    g, p = matched_rows(truth, predicted)
    known: dict[int, set[int]] = {}
    kept = []
    for rows in rows_by(_visit_of_object(truth, visit)[g]):
        ids, votes = np.unique(predicted.identity[p[rows]], return_counts=True)
        before = known.setdefault(int(truth.identity[g[rows[0]]]), set())
        kept += [int(ids[votes.argmax()]) in before] if before else []
        before.add(int(ids[votes.argmax()]))
    return {"returns": len(kept), "returns_kept": sum(kept) / max(len(kept), 1)}


def return_ranks(
    truth: LabelledBoxes,
    predicted: LabelledBoxes,
    embedding: npt.NDArray[Any],
    query_frames: int = 10,
) -> IntArray:
    """Rank the correct object by cosine similarity for the first views of every return.

    A query is a box of the first frames of a return (see `visits`). Its gallery consists of all
    boxes of earlier frames with the same class; each object has the similarity of its most similar
    box. Rank-k is the rate of ranks <= k.

    Args:
        embedding: (N, E) unit rows for the rows of `predicted`, NaN: not embedded.
        query_frames: first frames of a return, whose boxes are queries (10: .3 s).
    Returns:
        (Q,) ranks from 1.
    """
    visit = visits(truth)
    g, p = matched_rows(truth, predicted)
    use = np.isfinite(embedding[p]).all(1)
    g = g[use]
    p = p[use]
    ranks = []
    for rows in rows_by(_visit_of_object(truth, visit)[g]):
        start = truth.frame[g[rows]].min()
        identity = int(truth.identity[g[rows[0]]])
        gallery = np.flatnonzero(truth.frame[g] < start)
        gallery = gallery[truth.name[g[gallery]] == truth.name[g[rows[0]]]]
        ids, of = np.unique(truth.identity[g[gallery]], return_inverse=True)
        if identity in ids:
            queries = rows[truth.frame[g[rows]] < start + query_frames]
            best = np.full((len(ids), len(queries)), -np.inf)
            np.maximum.at(best, of, embedding[p[gallery]] @ embedding[p[queries]].T)
            ranks.append(1 + (best > best[ids == identity]).sum(0))
    return np.concatenate(ranks) if ranks else np.empty(0, np.int64)


def _hota(steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray) -> dict[str, float]:
    """Compute HOTA, DetA and AssA, each the mean over the IoU thresholds .05 to .95."""
    align = np.zeros((len(gt_size), len(pr_size)))  # (G, P) soft number of common frames
    for g, p, iou in steps:
        union = iou.sum(0)[None] + iou.sum(1)[:, None] - iou
        align[g[:, None], p[None]] += iou / np.maximum(union, 1e-12)
    align /= np.maximum(gt_size[:, None] + pr_size[None] - align, 1e-12)  # soft Jaccard index
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
    """Compute CLEAR MOT at IoU .5; a match of the previous frame is kept while it is valid."""
    last = np.full(len(gt_size), -1)  # identity of the last match in any frame
    before = last.copy()  # same in the last frame with boxes of truth and result
    switches = hits = 0
    starts = np.zeros(len(gt_size), np.int64)
    met = np.zeros((len(gt_size), len(pr_size)), bool)
    for g, p, iou in steps:
        if not len(g) or not len(p):
            continue  # as in TrackEval: such a frame does not end a match
        kept = 1000.0 * (before[g][:, None] == p[None])  # larger than any sum of IoU
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
    """Map identities of truth and result one to one, with the most common frames.

    Returns:
        numbers of the identities of truth and result, and their common frames, (K,) each.
    """
    common = np.zeros(shape)
    for g, p, iou in steps:
        common[g[:, None], p[None]] += iou >= MATCH_IOU
    a, b = _best_pairs(common)
    return a, b, common[a, b]


def _identity(steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray) -> dict[str, float]:
    """Compute F1, precision and recall of identities under the best one-to-one map."""
    hits = float(_identity_pairs(steps, (len(gt_size), len(pr_size)))[2].sum())
    gt = int(gt_size.sum())
    pr = int(pr_size.sum())
    return {
        "IDF1": 2 * hits / max(gt + pr, 1),
        "IDP": hits / max(pr, 1),
        "IDR": hits / max(gt, 1),
    }


def identity_map(truth: LabelledBoxes, predicted: LabelledBoxes) -> dict[int, int | None]:
    """Map every true identity to one of the result, one to one by common frames, or to None."""
    gt_ids, ids, steps, *_ = _numbered(truth, predicted)
    a, b, _ = _identity_pairs(steps, (len(gt_ids), len(ids)))
    pairs: dict[int, int | None] = dict.fromkeys(gt_ids.tolist())
    return pairs | dict(zip(gt_ids[a].tolist(), ids[b].tolist(), strict=True))


COLUMNS = {
    "HOTA": "higher-order tracking accuracy, %",
    "DetA": "its part for detection, %",
    "AssA": "its part for association, %",
    "IDF1": "boxes with the right identity, %: harmonic mean of IDP and IDR",
    "IDP": "of the boxes of the result, %",
    "IDR": "of the true boxes, %",
    "MOTA": "1 - (missed + false boxes + IDSW) / true boxes, %",
    "IDSW": "identity switches",
    "Frag": "interruptions of a tracked object",
    "IDs": "identities of the result per true object",
}


def score_table(scores: dict[str, dict[str, float]]) -> str:
    """Format one line for each name, rates in per cent."""
    lines = [f"{'':<14}" + "".join(f"{c:>6}" for c in COLUMNS)]
    for name, score in scores.items():
        counts = {key: f"{score[key]:.0f}" for key in ("IDSW", "Frag")}
        counts["IDs"] = f"{score['ids_per_object']:.4g}"
        cells = [counts.get(c) or f"{100 * score[c]:.1f}" for c in COLUMNS]
        lines.append(f"{name[:14]:<14}" + "".join(f" {cell:>5}" for cell in cells))
    return "\n".join(lines)


def score_report(scores: dict[str, Any]) -> str:
    """Format the result of `evaluate` for the terminal."""
    tracks: dict[str, dict[str, float]] = scores["tracks"]
    matched = {n: s for n, s in tracks.items() if n == "all" or s["IDF1"] or s["HOTA"] or s["IDP"]}
    lines = [score_table(matched)]
    if missed := scores["missed"]:
        names = [f"{name} {', '.join(map(str, ids))}".strip() for name, ids in missed.items()]
        count = sum(map(len, missed.values()))
        lines += wrapped(f"not found: {count} true objects ({'; '.join(names)})")
    ranks = scores["ranks"]
    rates = [f"{k.replace('rank', 'Rank-')} {v:.3f}" for k, v in ranks.items() if k != "queries"]
    if rates:
        queries = f"{ranks['queries']:.0f} queries"
        lines.append(f"returns by appearance alone, {queries}: {', '.join(rates)}")
    elif not ranks:
        lines.append("Rank-k: no embeddings (an output folder of `run` or `track` has them)")
    if "objects" in scores:
        numbers = {k: v for k, v in scores["objects"].items() if isinstance(v, int | float)}
        lines += wrapped("3D: " + ", ".join(f"{k} {v:.3g}" for k, v in numbers.items()))
    for text in scores.get("messages", ()):
        lines += wrapped(f"note: {text}")
    lines += [f"{column:<5}{meaning}" for column, meaning in COLUMNS.items()]
    return "\n".join(lines)


def _missed(truth: LabelledBoxes, predicted: LabelledBoxes) -> dict[str, list[int]]:
    """List the true identities that no identity of the result matches, by class."""
    scored = truth[truth.role == Role.SCORED]
    name_of = dict(zip(scored.identity.tolist(), scored.name.tolist(), strict=True))
    missed: dict[str, list[int]] = {}
    for identity, match in identity_map(truth, predicted).items():
        if match is None:
            missed.setdefault(name_of[identity], []).append(identity)
    return dict(sorted(missed.items()))


def evaluate(
    out: str | Path,
    gt: str | Path,
    solids: str | Path | None = None,
    truth_poses: str | Path | None = None,
    classes: Sequence[str] = (),
    min_visibility: float = 0.0,
    gt_format: str = AUTO,
    first_frame: str = "",
) -> dict[str, Any]:
    """Evaluate an output folder of `run`, or a tracks.txt, against ground truth.

    Boxes of truth and result do not count in frames on which the detector was not run, nor true
    boxes in frames excluded by --start, --stop and --every, nor boxes of the result in frames that
    a truth with a list of its frames (COCO-VID, CVAT with a frame step) does not have.

    Args:
        out: output folder, or MOT rows; tracks.txt of an output folder means the folder.
        gt: a file with identities in one of the formats `truth.TRUTH`; gt_format: its name, or
            auto.
        solids: gt_objects.json; truth_poses: TUM, or a 4x4 world_from_cam a line. classes: to
            evaluate, (): all. min_visibility: true boxes of lower visibility are ignored.
        first_frame: number of the first frame in `gt`, 0 or 1; "": as its format says.
    Returns:
        {"tracks": scores by class, "ranks": Rank-k of the returns, "objects": scores in 3D,
        "missed": true identities without a match by class, "messages": assumptions about the
        files}.
    Raises:
        ReobjError: a file is missing or of another format, no true box counts, an identity has two
            boxes in a frame, or a class does not occur.
    """
    out = Path(out)
    names = COCO_NAMES
    tracked = None
    if out.name == OutputFile.TRACKS and (out.parent / OutputFile.LAST_TRACKS).exists():
        out = out.parent
    notes: list[str] = []
    predicted = read_result(out, notes)
    if (out / OutputFile.LAST_TRACKS).exists():
        workspace = Workspace.open(out)
        tracked = workspace.load_last()
        names = tracked.class_names
    size = (0, 0) if tracked is None else (tracked.video.width, tracked.video.height)
    truth = read_truth(Path(gt), names, min_visibility, notes, size, gt_format, first_frame)
    check_counts(truth, Path(gt))
    if tracked is not None:
        config = workspace.source[1]
        truth, predicted = _in_frames_of_run(truth, predicted, config, tracked.looked, notes)
        why = "none lies in a frame that was read, and that the detector was run on"
        check_counts(truth, Path(gt), f"{why} (--start, --stop, --every)")
    predicted = _in_true_frames(truth, predicted, notes)
    truth, predicted, named = with_common_names(truth, predicted, notes)
    known = sorted({*truth.name.tolist(), *predicted.name.tolist()} - {""})
    if unknown := [word for word in classes if not meant(word, known)]:
        raise ReobjError(
            f"--classes: {', '.join(sorted(unknown))}: neither in the truth nor in the result"
        )
    classes = list(dict.fromkeys(known[k] for word in classes for k in meant(word, known)))
    names_scored = list(classes) or sorted(set(truth.name[truth.role == Role.SCORED]) - {""})
    if classes:
        truth, predicted = _of_classes(truth, predicted, classes, named)
        check_counts(truth, Path(gt), f"none is of {', '.join(classes)}")
    scores = {"all": score_tracks(truth, predicted)}
    if named and len(names_scored) > 1:
        for name in names_scored:
            scores[name] = score_tracks(*_of_classes(truth, predicted, [name], named))
    result: dict[str, Any] = {"version": __version__, "gt": str(gt), "tracks": scores}
    result["ranks"] = score_appearance(tracked, truth) if tracked is not None else {}
    result["missed"] = _missed(truth, predicted)
    result["messages"] = notes
    if solids is not None:
        pairs = identity_map(truth, predicted)
        poses = Path(truth_poses) if truth_poses else None
        result["objects"] = score_objects(Result.load(out), Path(solids), poses, pairs)
    return result


def _of_classes(
    truth: LabelledBoxes, predicted: LabelledBoxes, classes: Sequence[str], named: bool
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Select the boxes of some classes.

    If the result has no classes (not `named`), true boxes of other classes become Role.IGNORED.
    """
    true_rows, predicted_rows = (
        np.isin(boxes.name, [*classes, ""]) for boxes in (truth, predicted)
    )
    if named:
        return truth[true_rows], predicted[predicted_rows]
    role = np.where(true_rows | (truth.role != Role.SCORED), truth.role, Role.IGNORED)
    return dataclasses.replace(truth, role=role), predicted


def _in_frames_of_run(
    truth: LabelledBoxes,
    predicted: LabelledBoxes,
    config: InputConfig,
    looked: IntArray | None,
    notes: list[str],
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Select the frames that were read, and on which the detector was run (None: on all)."""
    frame = truth.frame - 1
    read = (frame >= config.start) & ((frame - config.start) % config.every == 0)
    truth = truth[read & (frame < (config.stop or np.inf))]
    if looked is None:
        return truth, predicted
    kept = truth[np.isin(truth.frame - 1, looked)]
    notes.append(
        f"{len(truth) - len(kept)} of {len(truth)} true boxes do not count: they lie in frames "
        f"on which the detector was not run (it was run on {len(looked)})"
    )
    return kept, predicted[np.isin(predicted.frame - 1, looked)]


def _in_true_frames(
    truth: LabelledBoxes, predicted: LabelledBoxes, notes: list[str]
) -> LabelledBoxes:
    """Select the boxes of the result in the frames that the truth lists; note those without it."""
    unnamed = dataclasses.replace(predicted, name=np.full(len(predicted), ""))
    if len(predicted) and not any((iou > 0).any() for *_, iou in _frame_steps(truth, unnamed)):
        true, found = (f"{boxes.frame.min()}-{boxes.frame.max()}" for boxes in (truth, predicted))
        notes.append(f"no true box overlaps a box of the result (frames from 1: truth {true}, "
                     f"result {found}): truth of another video?")  # fmt: skip
    notes += _scale_note(truth, unnamed)
    if truth.listed is not None:
        kept = predicted[np.isin(predicted.frame, truth.listed)]
        if left := len(predicted) - len(kept):
            notes.append(f"{left} of {len(predicted)} boxes of the result do not count: they lie "
                         f"in frames that the truth does not list (it lists {len(truth.listed)})"
                         )  # fmt: skip
        return kept
    frames = np.unique(predicted.frame)
    without = np.setdiff1d(frames, truth.frame)
    if len(without):
        notes.append(f"{len(without)} of {len(frames)} frames with boxes of the result have no "
                     "ground truth: boxes in them count as false")  # fmt: skip
    return predicted


def _scale_note(truth: LabelledBoxes, predicted: LabelledBoxes) -> list[str]:
    """Note that most true boxes match only after all boxes of the result are scaled."""

    def matches(scale: float) -> int:
        scaled = dataclasses.replace(predicted, xyxy=predicted.xyxy * scale)
        steps = _frame_steps(truth, scaled)
        return sum(int((iou >= MATCH_IOU).any(1).sum()) for *_, iou in steps)

    few = 0.3 * len(truth)
    if (plain := matches(1)) > few:
        return []
    best, scale = max((matches(s), s) for s in (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2, 3, 4))
    if best <= max(3 * plain, few):
        return []
    return [f"{plain} of {len(truth)} true boxes match a box of the result, but {best} do if the "
            f"boxes of the result are scaled by {scale:.3g}: boxes of frames of another size?"
            ]  # fmt: skip


def score_appearance(tracked: Result, truth: LabelledBoxes) -> dict[str, float]:
    """Compute Rank-k of the returns by appearance alone (`return_ranks`), k = 1, 5, 20, 50.

    Returns:
        number of queries and rates; {} without embeddings (--embed none).
    """
    embeddings = tracked.embeddings
    tracks = tracked.tracks[tracked.embedding_row]
    if not embeddings.foreground.size:
        return {}
    identity = np.arange(len(tracks))
    names = np.array([*tracked.class_names, ""])[tracks.class_id]  # -1: unknown
    role = np.full(len(tracks), Role.SCORED)
    predicted = LabelledBoxes(tracks.frame + 1, identity, tracks.xyxy, names, role)
    truth, predicted, _ = with_common_names(truth, predicted, [])
    fused = np.concatenate([embeddings.foreground, embeddings.background], 1)
    rank = return_ranks(truth, predicted, unit_rows(fused))
    shares = {f"rank{k}": float((rank <= k).mean()) for k in (1, 5, 20, 50)} if len(rank) else {}
    return {"queries": len(rank), **shares}
