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
    of_tracks,
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
from reobj.types import COCO_NAMES, Array, IntArray, ReobjError, box_iou, rows_by, unit_rows
from reobj.words import meant

MATCH_IOU = 0.5 - 1e-12  # least IoU of a match, except for HOTA (MOTChallenge: .5, inclusive)

_Step = tuple[IntArray, IntArray, Array]  # of a frame: truth (g,), result (p,), IoU (g, p)


def _frame_steps(truth: LabelledBoxes, predicted: LabelledBoxes) -> list[_Step]:
    """Compute the IoU of truth and result in each frame.

    Returns:
        for every frame with boxes, ascending: rows of the truth (g,) and of the result (p,), and
        their IoU (g, p), 0 for different classes.
    """
    steps = []
    for rows in rows_by(np.append(truth.frame, predicted.frame)):
        g = rows[rows < len(truth)]
        p = rows[len(g) :] - len(truth)
        a = truth.name[g][:, None]
        b = predicted.name[p]
        same = (a == b) | (a == "") | (b == "")
        steps.append((g, p, np.where(same, box_iou(truth.xyxy[g], predicted.xyxy[p]), 0.0)))
    return steps


def _best_pairs(score: Array) -> tuple[IntArray, IntArray]:
    """Assign rows to columns with the largest total score, without pairs of score 0."""
    rows, columns = linear_sum_assignment(-score)
    positive = score[rows, columns] > 1e-12
    return rows[positive], columns[positive]


def _matched_rows(truth: LabelledBoxes, predicted: LabelledBoxes) -> IntArray:
    """Match truth and result frame by frame at IoU >= .5, with the largest total IoU.

    Returns:
        (2, M) rows of the truth, of any role, and of the result.
    """
    pairs = [np.empty((2, 0), np.int64)]
    for g, p, iou in _frame_steps(truth, predicted):
        a, b = _best_pairs(np.where(iou >= MATCH_IOU, iou, 0))
        pairs.append(np.stack([g[a], p[b]]))
    return np.concatenate(pairs, 1)


def _scored_rows(truth: LabelledBoxes, predicted: LabelledBoxes) -> IntArray:
    """Return the matches (2, M) of the true boxes that count, as `_matched_rows` does."""
    rows = _matched_rows(truth, predicted)
    return rows[:, truth.role[rows[0]] == Role.SCORED]


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

    As in MOTChallenge, results matched to an ignored true box are dropped first.

    Returns:
        rates in [0, 1] and counts by name. Further ones: `ids_per_object`, number of identities
        matched to a true object at IoU .5, mean over the matched objects; `returns`, number of
        returns of true objects (see `visits`); `returns_kept`, rate of returns with an earlier
        identity of the object.
    Ref: Luiten et al., IJCV 2021; Bernardin & Stiefelhagen, 2008; Ristani et al., 2016.
    """
    true_row, row = _matched_rows(truth, predicted)
    ignored = row[truth.role[true_row] == Role.IGNORED]
    predicted = predicted[np.delete(np.arange(len(predicted)), ignored)]
    gt_ids, ids, steps, gt, pr = _numbered(truth, predicted)
    hits = float(_identity_pairs(steps, gt, pr)[2].sum())
    identity = {
        "IDF1": 2 * hits / max(int(gt.sum() + pr.sum()), 1),
        "IDP": hits / max(int(pr.sum()), 1),
        "IDR": hits / max(int(gt.sum()), 1),
    }
    counts = {"gt_objects": len(gt_ids), "identities": len(ids)}
    scores = _hota(steps, gt, pr) | _clear(steps, gt, pr) | identity
    return scores | _returns(truth, predicted) | counts


def visits(truth: LabelledBoxes) -> IntArray:
    """Number the visits of all objects, by object and then by time: (N,) visit of each box.

    A new visit begins after more than 30 frames, about a second, without a box of the object.
    """
    order = np.lexsort((truth.frame, truth.identity))
    late = np.diff(truth.frame[order]) > 30
    visit = np.zeros(len(order), np.int64)
    visit[order[1:]] = np.cumsum(late | (np.diff(truth.identity[order]) != 0))
    return visit


def _returns(truth: LabelledBoxes, predicted: LabelledBoxes) -> dict[str, float]:
    """Count returns of true objects, and the rate whose main identity is that of an earlier visit.

    Visits without a match are left out.
    """
    g, p = _scored_rows(truth, predicted)
    known: dict[int, set[int]] = {}
    kept = []
    for rows in rows_by(visits(truth)[g]):
        ids, votes = np.unique(predicted.identity[p[rows]], return_counts=True)
        before = known.setdefault(int(truth.identity[g[rows[0]]]), set())
        kept += [int(ids[votes.argmax()]) in before] if before else []
        before.add(int(ids[votes.argmax()]))
    return {"returns": len(kept), "returns_kept": sum(kept) / max(len(kept), 1)}


def return_ranks(
    truth: LabelledBoxes, predicted: LabelledBoxes, embedding: npt.NDArray[Any]
) -> IntArray:
    """Rank the correct object by cosine similarity for the first views of every return.

    A query is a box of the first 10 frames (.3 s) of a return (see `visits`). Its gallery consists
    of all boxes of earlier frames with the same class; each object has the similarity of its most
    similar box. Rank-k is the rate of ranks <= k.

    Args:
        embedding: (N, E) unit rows for the rows of `predicted`, NaN: not embedded.
    Returns:
        (Q,) ranks from 1.
    """
    pairs = _scored_rows(truth, predicted)
    g, p = pairs[:, np.isfinite(embedding[pairs[1]]).all(1)]
    matched = truth[g]
    ranks = [np.empty(0, np.int64)]
    for rows in rows_by(visits(truth)[g]):
        start = matched.frame[rows].min()
        first = rows[0]
        earlier = (matched.frame < start) & (matched.name == matched.name[first])
        ids, of = np.unique(matched.identity[earlier], return_inverse=True)
        own = ids == matched.identity[first]
        if own.any():
            queries = rows[matched.frame[rows] < start + 10]
            best = np.full((len(ids), len(queries)), -np.inf)
            np.maximum.at(best, of, embedding[p[earlier]] @ embedding[p[queries]].T)
            ranks.append(1 + (best > best[own]).sum(0))
    return np.concatenate(ranks)


def _hota(steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray) -> dict[str, float]:
    """Compute HOTA, DetA and AssA, each the mean over the IoU thresholds .05 to .95."""
    align = np.zeros((len(gt_size), len(pr_size)))  # (G, P) soft number of common frames
    for g, p, iou in steps:
        union = iou.sum(0) + iou.sum(1)[:, None] - iou
        align[g[:, None], p] += iou / np.maximum(union, 1e-12)
    boxes = gt_size[:, None] + pr_size  # (G, P)
    align /= np.maximum(boxes - align, 1e-12)  # soft Jaccard index
    pairs = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    for g, p, iou in steps:
        a, b = _best_pairs(align[g[:, None], p] * iou)
        pairs.append((g[a], p[b], iou[a, b]))
    g_all, p_all, iou_all = (np.concatenate(x) for x in zip(*pairs, strict=True))
    parts = []
    for alpha in np.arange(0.05, 0.99, 0.05):
        hit = iou_all >= alpha - 1e-12
        common = np.zeros_like(align)  # (G, P) TPA
        np.add.at(common, (g_all[hit], p_all[hit]), 1)
        jaccard = common / np.maximum(boxes - common, 1)
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
        kept = 1000.0 * (before[g][:, None] == p)  # larger than any sum of IoU
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


def _identity_pairs(
    steps: Sequence[_Step], gt_size: IntArray, pr_size: IntArray
) -> tuple[Any, Any, Array]:
    """Map identities of truth and result one to one, with the most common frames.

    Returns:
        numbers of the identities of truth and result, and their common frames, (K,) each.
    """
    common = np.zeros((len(gt_size), len(pr_size)))
    for g, p, iou in steps:
        common[g[:, None], p] += iou >= MATCH_IOU
    a, b = _best_pairs(common)
    return a, b, common[a, b]


def identity_map(truth: LabelledBoxes, predicted: LabelledBoxes) -> dict[int, int | None]:
    """Map every true identity to one of the result, one to one by common frames, or to None."""
    gt_ids, ids, steps, gt, pr = _numbered(truth, predicted)
    a, b, _ = _identity_pairs(steps, gt, pr)
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


def score_report(scores: dict[str, Any]) -> str:
    """Format the result of `evaluate` for the terminal: one line a class, rates in per cent."""
    lines = [f"{'':<14}" + "".join(f"{c:>6}" for c in COLUMNS)]
    for name, score in scores["tracks"].items():
        if name == "all" or score["IDF1"] or score["HOTA"] or score["IDP"]:
            counts = {key: f"{score[key]:.0f}" for key in ("IDSW", "Frag")}
            counts["IDs"] = f"{score['ids_per_object']:.4g}"
            cells = [counts.get(c) or f"{100 * score[c]:.1f}" for c in COLUMNS]
            lines.append(f"{name[:14]:<14}" + "".join(f" {cell:>5}" for cell in cells))
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
    for text in scores["messages"]:
        lines += wrapped(f"note: {text}")
    return "\n".join([*lines, *(f"{column:<5}{meaning}" for column, meaning in COLUMNS.items())])


def _missed(truth: LabelledBoxes, pairs: dict[int, int | None]) -> dict[str, list[int]]:
    """List the true identities without a match among `pairs` (`identity_map`), by class."""
    scored = truth[truth.role == Role.SCORED]
    name_of = dict(zip(scored.identity.tolist(), scored.name.tolist(), strict=True))
    missed: dict[str, list[int]] = {}
    for identity, match in pairs.items():
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
    gt = Path(gt)
    if out.name == OutputFile.TRACKS and (out.parent / OutputFile.LAST_TRACKS).exists():
        out = out.parent
    notes: list[str] = []
    predicted = read_result(out, notes)
    workspace = Workspace.open(out) if (out / OutputFile.LAST_TRACKS).exists() else None
    tracked = None if workspace is None else workspace.load_last()
    names: Sequence[str] = COCO_NAMES if tracked is None else tracked.class_names
    size = (0, 0) if tracked is None else (tracked.video.width, tracked.video.height)
    truth = read_truth(gt, names, min_visibility, notes, size, gt_format, first_frame)
    check_counts(truth, gt)
    if workspace is not None and tracked is not None:
        config = workspace.source[1]
        truth, predicted = _in_frames_of_run(truth, predicted, config, tracked.looked, notes)
        why = "none lies in a frame that was read, and that the detector was run on"
        check_counts(truth, gt, f"{why} (--start, --stop, --every)")
    predicted = _in_true_frames(truth, predicted, notes)
    truth, predicted, named = with_common_names(truth, predicted, notes)
    known = sorted({*truth.name.tolist(), *predicted.name.tolist()} - {""})
    if unknown := sorted(word for word in classes if not meant(word, known)):
        raise ReobjError(f"--classes: {', '.join(unknown)}: neither in the truth nor in the result")
    chosen = list(dict.fromkeys(known[k] for word in classes for k in meant(word, known)))
    if chosen:
        truth, predicted = _of_classes(truth, predicted, chosen, named)
        check_counts(truth, gt, f"none is of {', '.join(chosen)}")
    scores = {"all": score_tracks(truth, predicted)}
    of_truth = chosen or sorted(set(truth.name[truth.role == Role.SCORED].tolist()) - {""})
    for name in of_truth if named and len(of_truth) > 1 else ():
        scores[name] = score_tracks(*_of_classes(truth, predicted, [name], named))
    pairs = identity_map(truth, predicted)
    result: dict[str, Any] = {"version": __version__, "gt": str(gt), "tracks": scores}
    result["ranks"] = {} if tracked is None else score_appearance(tracked, truth)
    result["missed"] = _missed(truth, pairs)
    result["messages"] = notes
    if solids is not None:
        poses = Path(truth_poses) if truth_poses else None
        result["objects"] = score_objects(Result.load(out), Path(solids), poses, pairs)
    return result


def _of_classes(
    truth: LabelledBoxes, predicted: LabelledBoxes, classes: Sequence[str], named: bool
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Select the boxes of some classes.

    If the result has no classes (not `named`), true boxes of other classes become Role.IGNORED.
    """
    of_truth, of_result = (np.isin(boxes.name, [*classes, ""]) for boxes in (truth, predicted))
    if named:
        return truth[of_truth], predicted[of_result]
    role = np.where(of_truth, truth.role, np.maximum(truth.role, Role.IGNORED))
    return dataclasses.replace(truth, role=role), predicted


def _in_frames_of_run(
    truth: LabelledBoxes,
    predicted: LabelledBoxes,
    config: InputConfig,
    detector_ran: IntArray | None,
    notes: list[str],
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Select the frames that were read, and on which the detector was run (None: on all)."""
    after = truth.frame - 1 - config.start
    truth = truth[(after >= 0) & (after % config.every == 0)]
    truth = truth[truth.frame <= (config.stop or np.inf)]
    if detector_ran is None:
        return truth, predicted
    kept, found = (b[np.isin(b.frame - 1, detector_ran)] for b in (truth, predicted))
    notes.append(
        f"{len(truth) - len(kept)} of {len(truth)} true boxes do not count: they lie in frames "
        f"on which the detector was not run (it was run on {len(detector_ran)})"
    )
    return kept, found


SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2, 3, 4)  # of images resized for a detector


def _in_true_frames(
    truth: LabelledBoxes, predicted: LabelledBoxes, notes: list[str]
) -> LabelledBoxes:
    """Select the boxes of the result in the frames that the truth lists.

    Notes say that frames have no truth, and that boxes match nowhere, or only after scaling.
    """

    def best_iou(scale: float) -> Array:
        xyxy = predicted.xyxy * scale
        scaled = dataclasses.replace(predicted, xyxy=xyxy, name=np.full(len(predicted), ""))
        return np.concatenate([iou.max(1, initial=0) for *_, iou in _frame_steps(truth, scaled)])

    iou = best_iou(1)  # (N,) of the true boxes
    if len(predicted) and not iou.any():
        true, found = (f"{boxes.frame.min()}-{boxes.frame.max()}" for boxes in (truth, predicted))
        notes.append(f"no true box overlaps a box of the result (frames from 1: truth {true}, "
                     f"result {found}): truth of another video?")  # fmt: skip
    plain = (iou >= MATCH_IOU).sum()
    few = 0.3 * len(truth)
    if plain <= few:
        best, scale = max(((best_iou(s) >= MATCH_IOU).sum(), s) for s in SCALES)
        if best > max(3 * plain, few):
            notes.append(f"{plain} of {len(truth)} true boxes match a box of the result, but "
                         f"{best} do if the boxes of the result are scaled by {scale:.3g}: boxes "
                         "of frames of another size?")  # fmt: skip
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


def score_appearance(tracked: Result, truth: LabelledBoxes) -> dict[str, float]:
    """Compute Rank-k of the returns by appearance alone (`return_ranks`), k = 1, 5, 20, 50.

    Returns:
        number of queries and rates; {} without embeddings (--embed none).
    """
    embeddings = tracked.embeddings
    tracks = tracked.tracks[tracked.embedding_row]
    if not embeddings.foreground.size:
        return {}
    predicted = of_tracks(tracks, tracked.class_names)
    truth, predicted, _ = with_common_names(truth, predicted, [])
    fused = np.concatenate([embeddings.foreground, embeddings.background], 1)
    rank = return_ranks(truth, predicted, unit_rows(fused))
    shares = {f"rank{k}": float((rank <= k).mean()) for k in (1, 5, 20, 50)} if len(rank) else {}
    return {"queries": len(rank), **shares}
