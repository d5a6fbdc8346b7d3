"""Plausibility of a result as a whole: warnings, each with a remedy to try.

They are logged, and written to objects.json and the viewer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from reobj.results.result import Object, Result
from reobj.types import Tracks
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
    poses = result.poses
    if poses is None or not 0 < 2 * poses.known.sum() < len(poses.known):
        return ""
    remedy = "film with slower turns and more overlap, or give --camera (intrinsics) or --poses"
    if poses.source == "user":
        remedy = "check that --poses is of this video, and that names or times of its frames agree"
    return (
        f"only {poses.known.sum()} of {len(poses.known)} frames have a camera; objects seen only "
        f"in the others are not located: {remedy}"
    )


def _nothing_measured(result: Result, still: Sequence[Object]) -> str:
    """Warn if there are cameras and objects, but no object is measured or has a large parallax.

    One or two objects without parallax are normal. With 10 deg of parallax an object is seen from
    around: if its size still rests on the prior, the boxes are inaccurate, and more parallax does
    not help (redkitchen).
    """
    poses = result.poses
    measured = any(o.status == "ok" or (o.parallax_deg or 0.0) >= 10.0 for o in still)
    if poses is None or not poses.known.any() or measured or len(still) < 3:
        return ""
    if poses.direction_sigma.all():  # a message of the poses says why
        return ""
    cameras = "" if poses.source == "user" else "--camera (intrinsics), --poses, or "
    return (
        f"none of the {len(still)} listed objects is measured (status ok; see their reasons): walk "
        "sideways around the objects, so that each is completely visible and seen from several "
        f"sides; or try {cameras}{OTHER_BOXES}"
    )


def _one_class(result: Result, still: Sequence[Object]) -> str:
    """Warn if most listed objects are of one class, unless all detections are.

    Six chairs at a table and seven plants in a living room are normal; partitions taken for
    refrigerators were 8 of 10 and more (office_loop).
    """
    ((name, count),) = Counter(o.class_name for o in still).most_common(1) or [("", 0)]
    classes = {*result.tracks.class_id.tolist(), *result.untracked.class_id.tolist()}
    if count < 8 or 2 * count <= len(still) or len(classes) == 1:
        return ""
    return (
        f"{count} of {len(still)} listed objects are of the class {name}: check that the room has "
        f"that many; if not, it is confused with other classes: try {OTHER_BOXES}, or leave the "
        "class out (--classes)"
    )


def _unexplained(result: Result, high_score: float, new_score: float) -> str:
    """Warn if most boxes of high score belong to no listed object, with their most common cause."""
    doubtful = [o.id for o in result.objects if o.status == "doubtful"]
    tracks = result.tracks[result.tracks.score >= high_score]
    rest = result.untracked[result.untracked.score >= high_score]
    count = _distinct(tracks[~np.isin(tracks.track_id, doubtful)])
    total = _distinct(Tracks.joined([tracks, rest]))
    if total < 50 or 2 * count >= total:  # of fewer boxes the majority is chance
        return ""
    text = f"{total - count} of {total} boxes of score {high_score:g} or more"
    text += " belong to no listed object"
    if 2 * len(rest) <= total - count:  # they belong to low-confidence objects
        doubtful_too = "look at the objects of low confidence (--set output.doubtful=true)"
        return f"{text}: {doubtful_too}, or try {OTHER_BOXES}"
    if 2 * (rest.score < new_score).sum() > len(rest):
        text += ": most of them are below the score at which a track starts "
        text += f"(tracker.new_score={new_score:g})"
    return text


def _distinct(rows: Tracks) -> int:
    """Count the distinct detections (frame, index) of rows."""
    return len(set(zip(rows.frame.tolist(), rows.detection_index.tolist(), strict=True)))
