"""Confidence of an object: the probability that it exists and is not a duplicate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reobj.objects.association import Association
from reobj.objects.likelihood import PosedDetections, logit
from reobj.results.result import Result
from reobj.types import Array, BoolArray, Existence, IntArray, Tracks, rows_by

# Logistic regression of existence: intercept, log odds of the best scores, hit rate over the frames
# where the object should be visible, see-through ratio (`occlusion.see_through_ratio`). Fitted to
# 1,202 objects of 48 runs of 10 rooms (benchmarks/RESULTS.md)
CONFIDENCE = (-1.0, 1.5, 1.8, -1.5)
FITTED_TO = "YOLOv8s, deimv2-femto, rendered rooms"
FITTED_SCORES = (0.13, 0.87)  # lowest and highest median score of the recordings it was fitted to
FAR_OFF = 1.0  # in log odds, beyond which a median is reported (chosen)
USUAL_HIT_RATE = 0.75  # if it should be visible in no frame, as an always truncated table (mean)
NO_SHAPE = -1.9  # instead of the intercept for identities without a 3D object (8 of 89 were real)
# Number and least fraction of an object's detections that its score is taken from: most views of a
# half-occluded object are poor (20 to 40 are alike; all, or ten, are worse: benchmarks/LOG.md)
BEST_DETECTIONS = 30
BEST_FRACTION = 0.25
LOW_CONFIDENCE = 0.5  # below it an object is more likely absent than present


def existence_probability(score: Array, hit_rate: Array, see_through: Array | float = 0.0) -> Array:
    """Return the probability that objects exist.

    Args:
        score: `log_best_odds` of the detections. see_through: `occlusion.see_through_ratio`.
        hit_rate: over the frames where the object should be visible; NaN: it has no shape.
    """
    intercept, of_score, of_hit_rate, of_see_through = CONFIDENCE
    geometry = intercept + of_hit_rate * hit_rate + of_see_through * see_through
    geometry = np.where(np.isnan(hit_rate), NO_SHAPE, geometry)
    return np.asarray(1 / (1 + np.exp(-geometry - of_score * score)))


def log_best_odds(score: Array, group: IntArray, count: int) -> Array:
    """Return the log of the mean odds (count,) of the best scores (N,) of each group, -inf: none.

    These are its best BEST_DETECTIONS, or its best BEST_FRACTION if that is more.
    """
    order = np.lexsort((-score, group))
    size = np.bincount(group, minlength=count)
    rank = np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)
    used = np.maximum(BEST_DETECTIONS, np.ceil(BEST_FRACTION * size)).clip(max=size)
    best = order[rank < np.repeat(used, size)]
    odds = np.bincount(group[best], np.exp(logit(score[best])), count)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(odds / used.clip(1)))


def scores_far_off(result: Result) -> list[str]:
    """Return a warning if the scores are far from those that the confidence was fitted to."""
    tracks = result.tracks
    score = np.append(tracks.score[tracks.detection_index >= 0], result.untracked.score)
    if not len(score) or all(o.confidence is None for o in result.objects):
        return []
    median = float(np.median(score))
    low, log_odds, high = logit(np.array([FITTED_SCORES[0], median, FITTED_SCORES[1]]))
    if low - FAR_OFF <= log_odds <= high + FAR_OFF:
        return []
    fitted = "{:g} to {:g}".format(*FITTED_SCORES)
    return [f"the median score of the detections is {median:.2g}, that of the recordings that the "
            f"confidence of objects was fitted to {fitted} ({FITTED_TO}): it may order objects, "
            "but is no probability here"]  # fmt: skip


def of_objects(
    found: Association, detections: PosedDetections, see_through: Array
) -> list[Existence]:
    """Return the confidence of the O associated objects."""
    assigned = np.flatnonzero(found.label >= 0)
    label = found.label[assigned]
    view = detections.view[assigned]
    expected = found.evidence.expected
    score = log_best_odds(detections.score[assigned], label, len(found.shapes))
    hits = np.bincount(label, expected[view, label], len(found.shapes))
    hit_rate = np.where(expected.any(0), hits / expected.sum(0).clip(1), USUAL_HIT_RATE)
    probability = existence_probability(score, hit_rate, see_through)
    columns = np.column_stack([probability, score, hit_rate, see_through])
    return [Existence(*row) for row in columns.tolist()]


def of_identities(
    tracks: Tracks, label: IntArray, posed: BoolArray, of_object: Sequence[Existence]
) -> dict[int, float]:
    """Return the confidence of identities: of the 3D object, or from the scores without one.

    Identities seen only in frames without a pose get no confidence.

    Args:
        label: (N,) 3D object of each row, or -1. posed: (N,) the frame has a pose.
        of_object: confidence of the 3D objects.
    """
    found: dict[int, float] = {}
    for rows in rows_by(tracks.track_id):
        if not posed[rows].any():
            continue
        labels = label[rows][label[rows] >= 0]
        identity = int(tracks.track_id[rows[0]])
        if len(labels):
            found[identity] = of_object[labels[0]]
        else:
            score = log_best_odds(tracks.score[rows], np.zeros(len(rows), np.int64), 1)
            (value,) = existence_probability(score, np.array([np.nan]))
            found[identity] = Existence(float(value), float(score[0]), np.nan, 0.0)
    return found


# Log odds of the best scores (median of 130 objects above LOW_CONFIDENCE, 21 real recordings)
USUAL_SCORE = 0.6


def with_low_confidence(status: str, reason: str, confidence: float) -> tuple[str, str]:
    """Return status and reason of an object; below LOW_CONFIDENCE its status is "doubtful"."""
    if confidence >= LOW_CONFIDENCE:
        return status, reason
    why = f"{100 * confidence:.0f} % likely to exist"
    if isinstance(confidence, Existence):
        why += f": {_weightiest(confidence)}"
    if status == "rejected":
        why += f"; {reason}"
    return "doubtful", why


def _weightiest(found: Existence) -> str:
    """Say which evidence lowers a confidence most, compared with objects that exist."""
    if np.isnan(found.hit_rate):
        return "its detections agree with no object in 3D"
    _, of_score, of_hit_rate, of_see_through = CONFIDENCE
    hits = f"{100 * found.hit_rate:.0f} % of the frames where it should be visible"
    times = f"{np.exp(found.see_through):.1f} times as many as a real object lets through"
    texts = {
        f"its best detections have low scores (about {1 / (1 + np.exp(-found.score)):.2f})":
            of_score * (USUAL_SCORE - found.score),
        f"it is detected in only {hits}": of_hit_rate * (USUAL_HIT_RATE - found.hit_rate),
        f"background points are visible through it ({times})": -of_see_through * found.see_through,
    }  # fmt: skip
    return max(texts, key=lambda text: texts[text])
