"""Plausibility of a result as a whole: warnings, each with a remedy to try.

They are logged, and written to objects.json and the viewer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from reobj.results.result import Object, Result
from reobj.types import IntArray, Tracks
from reobj.words import among

OTHER_BOXES = "another detector (--detector, or other boxes with --detections)"


def implausible(
    result: Result, high_score: float, moving: Sequence[str], new_score: float = 0.0
) -> list[str]:
    """Return warnings about implausible results.

    Args:
        high_score: boxes of lower scores are often false positives. moving: classes without 3D
            objects, often many. new_score: least score at which a track starts.
    """
    moves = among([o.class_name for o in result.objects], moving)
    still = [o for o, m in zip(result.objects, moves, strict=True) if o.counted and not m]
    texts = [_few_cameras(result), _nothing_measured(result, still)]
    if not result.identities_given:  # given identities are not questioned
        texts += [_one_class(result, still), _unexplained(result, high_score, new_score)]
    return [text for text in texts if text]


def _few_cameras(result: Result) -> str:
    """Warn if most frames have no camera; messages of the poses explain if none has."""
    if result.poses is None or not 0 < 2 * result.poses.known.sum() < len(result.poses.known):
        return ""
    known = result.poses.known.sum()
    count = len(result.poses.known)
    remedy = "film with slower turns and more overlap, or give --camera (intrinsics) or --poses"
    if result.poses.source == "user":
        remedy = "check that --poses is of this video, and that names or times of its frames agree"
    return (
        f"only {known} of {count} frames have a camera; objects seen only in the others are not "
        f"located: {remedy}"
    )


def _nothing_measured(result: Result, still: Sequence[Object]) -> str:
    """Warn if there are cameras and objects, but no object is measured or has a large parallax."""
    poses = result.poses
    # With 10 deg of parallax an object is seen from around: if its size still rests on the prior,
    # the boxes are inaccurate, and more parallax does not help (redkitchen).
    measured = any(o.status == "ok" or (o.parallax_deg or 0.0) >= 10.0 for o in still)
    if poses is None or not poses.known.any() or measured:
        return ""
    if len(still) < 3:  # one or two objects without parallax are normal
        return ""
    cameras = "" if poses.source == "user" else "--camera (intrinsics), --poses, or "
    return (
        f"none of the {len(still)} listed objects is measured (status ok; see their reasons): walk "
        "sideways around the objects, so that each is completely visible and seen from several "
        f"sides; or try {cameras}{OTHER_BOXES}"
    )


def _one_class(result: Result, still: Sequence[Object]) -> str:
    """Warn if most listed objects are of one class, unless all detections are."""
    name, count = next(iter(Counter(o.class_name for o in still).most_common(1)), ("", 0))
    boxes = np.append(result.tracks.class_id, result.untracked.class_id)
    # Six chairs at a table and seven plants in a living room are normal; partitions taken for
    # refrigerators were 8 of 10 and more (office_loop).
    if count < 8 or 2 * count <= len(still) or len(np.unique(boxes)) == 1:
        return ""
    return (
        f"{count} of {len(still)} listed objects are of the class {name}: check that the room has "
        f"that many; if not, it is confused with other classes: try {OTHER_BOXES}, or leave the "
        "class out (--classes)"
    )


def _unexplained(result: Result, high_score: float, new_score: float) -> str:
    """Warn if most boxes of high score belong to no listed object, with their most common cause."""
    doubtful = [o.id for o in result.objects if o.status == "doubtful"]
    tracks = result.tracks
    weak = result.tracks.score < high_score
    listed = tracks[~weak & ~np.isin(tracks.track_id, doubtful)]
    strong = Tracks.joined([tracks[~weak], result.untracked[result.untracked.score >= high_score]])
    count = len(_distinct(listed))
    total = len(_distinct(strong))
    if total < 50 or 2 * count >= total:  # of fewer boxes the majority is chance
        return ""
    text = f"{total - count} of {total} boxes of score {high_score:g} or more"
    text += " belong to no listed object"
    rest = result.untracked[result.untracked.score >= high_score]
    if 2 * len(rest) > total - count:  # else they belong to low-confidence objects
        if 2 * (rest.score < new_score).sum() > len(rest):
            return (f"{text}: most of them are below the score at which a track starts "
                    f"(tracker.new_score={new_score:g})")  # fmt: skip
        return text
    return (
        f"{text}: look at the objects of low confidence (--set output.doubtful=true), or try "
        f"{OTHER_BOXES}"
    )


def _distinct(rows: Tracks) -> IntArray:
    """Return the distinct (frame, detection index) of rows, (n, 2)."""
    return np.unique(np.stack([rows.frame, rows.detection_index], 1), axis=0)
