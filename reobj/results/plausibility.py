"""Plausibility of a result: what looks wrong as a whole, and what to try.

Every line is a warning like any other: logged, in objects.json, on the page.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from reobj.results.result import Object, Result
from reobj.types import IntArray, Tracks

OTHER_BOXES = "another detector (--detector, or other boxes with --detections)"
# Fewer of a class are normal, even if little else is listed: six chairs at a table, seven plants in
# a living room. Partitions taken for refrigerators were 8 of 10 and more (office_loop).
SAME_CLASS_MIN = 8
# Parallax of a thing that was walked around: a size that rests on its category all the same tells
# of rough boxes, and walking on does not help (redkitchen)
AROUND_DEG = 10.0
MEASURABLE_MIN = 3  # objects; chosen: one or two that nobody walked around say nothing of a run
BOXES_MIN = 50  # chosen: of fewer strong boxes a few more or less make the majority


def implausible(result: Result, high_score: float, moving: Sequence[str]) -> list[str]:
    """Say what looks wrong in a finished result, one line each.

    Args:
        high_score: boxes of less are weak, and often of nothing. moving: classes that get no
            solid; they come in crowds.
    """
    still = [o for o in result.objects if o.status != "doubtful" and o.class_name not in moving]
    found = [_few_cameras(result), _nothing_measured(result, still)]
    if not result.identities_given:  # else the user said which boxes are which objects
        found += [_one_class(result, still), _unexplained(result, high_score)]
    return [text for text in found if text]


def _few_cameras(result: Result) -> str:
    """Warn where most frames have no camera; where none has, the poses say why."""
    if result.poses is None or not 0 < 2 * result.poses.known.sum() < len(result.poses.known):
        return ""
    known, count = result.poses.known.sum(), len(result.poses.known)
    remedy = "film with slower turns and more overlap, or give --camera (intrinsics) or --poses"
    if result.poses.source == "user":
        remedy = "check that --poses is of this video, and that names or times of its frames agree"
    return (
        f"only {known} of {count} frames have a camera: what the others show has no place and no "
        f"size: {remedy}"
    )


def _nothing_measured(result: Result, still: Sequence[Object]) -> str:
    """Warn where there are cameras and objects, but none was measured or seen from all around."""
    poses = result.poses
    measured = any(o.status == "ok" or (o.parallax_deg or 0.0) >= AROUND_DEG for o in still)
    if poses is None or not poses.known.any() or measured or len(still) < MEASURABLE_MIN:
        return ""
    cameras = "" if poses.source == "user" else "--camera (intrinsics), --poses, or "
    return (
        f"none of the {len(still)} listed objects is measured (status ok; the reasons stand beside "
        "them): walk sideways around the objects, so that each is seen whole and from several "
        f"sides; or try {cameras}{OTHER_BOXES}"
    )


def _one_class(result: Result, still: Sequence[Object]) -> str:
    """Warn where most listed objects are of one class, unless no other was looked for."""
    name, count = next(iter(Counter(o.class_name for o in still).most_common(1)), ("", 0))
    boxes = np.append(result.tracks.class_id, result.untracked.class_id)
    if count < SAME_CLASS_MIN or 2 * count <= len(still) or len(np.unique(boxes)) == 1:
        return ""
    return (
        f"{count} of {len(still)} listed objects are of the class {name}: check that there are so "
        f"many; if not, other things are taken for it: try {OTHER_BOXES}, or leave the class out "
        "(--classes)"
    )


def _unexplained(result: Result, high_score: float) -> str:
    """Warn where most strong boxes are of no listed object."""
    doubtful = [o.id for o in result.objects if o.status == "doubtful"]
    tracks, weak = result.tracks, result.tracks.score < high_score
    listed = tracks[~weak & ~np.isin(tracks.track_id, doubtful)]
    strong = Tracks.joined([tracks[~weak], result.untracked[result.untracked.score >= high_score]])
    count, total = len(_distinct(listed)), len(_distinct(strong))
    if total < BOXES_MIN or 2 * count >= total:
        return ""
    shown = "look at the doubtful objects (--set output.doubtful=true), or " if doubtful else ""
    return (
        f"{total - count} of {total} boxes of score {high_score:g} or more belong to no listed "
        f"object: {shown}try {OTHER_BOXES}"
    )


def _distinct(rows: Tracks) -> IntArray:
    """Return frame and detection index (n, 2) of rows, each once: a row may be listed twice."""
    return np.unique(np.stack([rows.frame, rows.detection_index], 1), axis=0)
