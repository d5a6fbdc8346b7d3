"""Plausibility of a result: what looks wrong as a whole, and what to try.

Every line is a warning like any other: logged, in objects.json, on the page.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from reobj.results.result import Object, Result
from reobj.types import BoolArray, IntArray, Tracks, box_iou, rows_by

OTHER_BOXES = "another detector (--detector, or other boxes with --detections)"
# Fewer of a class are normal, even if little else is listed: six chairs at a table, seven plants in
# a living room. Partitions taken for refrigerators were 8 of 10 and more (office_loop).
SAME_CLASS_MIN = 8
# Parallax of a thing that was walked around: a size that rests on its category all the same tells
# of rough boxes, and walking on does not help (redkitchen)
AROUND_DEG = 10.0
MEASURABLE_MIN = 3  # objects; chosen: one or two that nobody walked around say nothing of a run
BOXES_MIN = 50  # chosen: of fewer strong boxes a few more or less make the majority


def implausible(
    result: Result, high_score: float, moving: Sequence[str], new_score: float = 0.0
) -> list[str]:
    """Say what looks wrong in a finished result, one line each.

    Args:
        high_score: boxes of less are weak, and often of nothing. moving: classes that get no
            solid; they come in crowds. new_score: no track starts at boxes of less.
    """
    still = [o for o in result.objects if o.status != "doubtful" and o.class_name not in moving]
    found = [_few_cameras(result), _nothing_measured(result, still)]
    if not result.identities_given:  # else the user said which boxes are which objects
        found += [_one_class(result, still), _unexplained(result, high_score, new_score)]
    return [text for text in found if text]


def _few_cameras(result: Result) -> str:
    """Warn where most frames have no camera; where none has, the poses say why."""
    if result.poses is None or not 0 < 2 * result.poses.known.sum() < len(result.poses.known):
        return ""
    known = result.poses.known.sum()
    count = len(result.poses.known)
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


def _unexplained(result: Result, high_score: float, new_score: float) -> str:
    """Warn where most strong boxes are of no listed object, with the cause that most of them have.

    Another detector is advised only where boxes come and go, or where objects are doubtful.
    """
    doubtful = [o.id for o in result.objects if o.status == "doubtful"]
    tracks = result.tracks
    weak = result.tracks.score < high_score
    listed = tracks[~weak & ~np.isin(tracks.track_id, doubtful)]
    strong = Tracks.joined([tracks[~weak], result.untracked[result.untracked.score >= high_score]])
    count = len(_distinct(listed))
    total = len(_distinct(strong))
    if total < BOXES_MIN or 2 * count >= total:
        return ""
    text = f"{total - count} of {total} boxes of score {high_score:g} or more"
    text += " belong to no listed object"
    rest = result.untracked[result.untracked.score >= high_score]
    if 2 * len(rest) > total - count:  # else they are of doubtful objects
        if 2 * (rest.score < new_score).sum() > len(rest):
            return (f"{text}: most of them are below the score at which a track starts "
                    f"(tracker.new_score={new_score:g})")  # fmt: skip
        doubled = _doubled(rest, strong)
        alone = _alone(rest, strong)
        if 2 * doubled.sum() > len(rest):
            return (f"{text}: most of them lie on another box of their class in the same frame "
                    "(boxes without non-maximum suppression)")  # fmt: skip
        if 2 * alone.sum() <= len(rest):
            return text
        text += ": most of them have no other near them in the frames before and after"
        return f"{text}: boxes of other frames, photos far apart, or try {OTHER_BOXES}"
    return (
        f"{text}: look at the doubtful objects (--set output.doubtful=true), or try {OTHER_BOXES}"
    )


DOUBLED_IOU = 0.6  # of two boxes on one object: in a frame (NMS: .5 to .7), and in
SAME_IOU = 0.3
# successive ones (as tracks are matched, reobj_track.LOW_IOU)


def _doubled(rows: Tracks, others: Tracks) -> BoolArray:
    """Mark rows on which a better box of their class lies in the same frame."""
    found = np.zeros(len(rows), bool)
    for own in rows_by(rows.frame):
        there = others[others.frame == rows.frame[own[0]]]
        same = box_iou(rows.xyxy[own], there.xyxy) > DOUBLED_IOU
        same &= rows.class_id[own][:, None] == there.class_id
        found[own] = (same & (there.score > rows.score[own][:, None])).any(1)
    return found


def _alone(rows: Tracks, others: Tracks) -> BoolArray:
    """Mark rows without a box of their class near them in the frames with boxes beside theirs."""
    frames = np.unique(others.frame)
    found = np.ones(len(rows), bool)
    for own in rows_by(rows.frame):
        at = np.searchsorted(frames, rows.frame[own[0]])
        beside = frames[[k for k in (at - 1, at + 1) if 0 <= k < len(frames)]]
        there = others[np.isin(others.frame, beside)]
        near = box_iou(rows.xyxy[own], there.xyxy) > SAME_IOU
        found[own] = ~(near & (rows.class_id[own][:, None] == there.class_id)).any(1)
    return found


def _distinct(rows: Tracks) -> IntArray:
    """Return frame and detection index (n, 2) of rows, each once: a row may be listed twice."""
    return np.unique(np.stack([rows.frame, rows.detection_index], 1), axis=0)
