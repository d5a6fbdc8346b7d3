"""Describe fitted objects and their world: the entries of objects.json.

The confidence of an object is the probability that it exists and is not a duplicate.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import quadrics
from reobj.cameras import (
    Poses,
    invert_rigid,
    place_of,
    quat_wxyz_from_matrix,
    undistort_boxes,
)
from reobj.files import numbers, rounded, shortened, significant
from reobj.objects.association import Association
from reobj.objects.likelihood import CLASS_KEPT, PosedDetections, logit, name_of
from reobj.objects.observations import Views
from reobj.poses.floor import floor_of
from reobj.results.entries import visit_gap, visits_of
from reobj.results.result import Object, Part, Result, World
from reobj.sources.image_files import IMAGE_FPS
from reobj.types import (
    Array,
    BoolArray,
    Existence,
    IntArray,
    LinkEvent,
    Tracks,
    object_classes,
    rows_by,
)
from reobj.words import among


def describe_objects(
    tracks: Tracks,
    class_names: Sequence[str],
    fits: quadrics.ObjectFits | None,
    views: Views | None,
    min_views: int = 3,
    moving: Sequence[str] = (),
    confidence: Mapping[int, float] | None = None,
    component: int = 0,
    view_count: IntArray | None = None,
    fps: float = IMAGE_FPS,
) -> list[Object]:
    """Describe every identity of the tracks: class, visits, and its shape or why it has none.

    Without cameras the status of all is "tracked".

    Args:
        fits, views: of the identities in ascending order; None without cameras.
        min_views: an object with fewer gets no shape. moving: names of classes that move.
        confidence: of identities, where it is known. component: of the trajectory.
        view_count: (O,) views of the identities if `views` has some of the frames; None: all.
        fps: frame rate of the source, Hz.
    Returns:
        one `Object` per identity, by id.
    """
    objects = []
    iou = np.empty(0)
    if fits is not None and views is not None:
        cameras = (views.img_from_world, views.image_size)
        iou = quadrics.reprojection_iou(fits, views.boxes, *cameras)  # (V, O)
    class_count = len(np.unique(tracks.class_id))
    gap = visit_gap(tracks.frame, fps)
    for i, (identity, class_id) in enumerate(object_classes(tracks).items()):
        rows = tracks[tracks.track_id == identity]
        class_name = name_of(class_names, class_id)
        moves = bool(among([class_name], moving)[0])
        fields: dict[str, Any] = {"status": "tracked", "reason": ""}
        if fits is not None and views is not None:
            count = None if view_count is None else int(view_count[i])
            fields = _fit_fields(fits, i, views, iou[:, i], moves, min_views, count)
        if confidence and identity in confidence and not moves:
            value = confidence[identity]
            status, reason = with_low_confidence(fields["status"], fields["reason"], value)
            fields |= {"status": status, "reason": reason, "confidence": round(value, 3)}
        objects.append(
            Object(
                id=identity,
                class_name=class_name,
                score=round(float(rows.score.mean()), 4),
                frames_seen=len(np.unique(rows.frame)),
                tracklet_ids=np.unique(rows.tracklet_id).tolist(),
                visits=visits_of(rows.frame, gap),
                classes=_likeliest_classes(rows, class_names, class_count),
                part=component,
                **fields,
            )
        )
    return objects


BORDER_PX = 2  # a box this near to the border is truncated
NOT_MEASURED = "distance not measured: the cameras have directions only"


def with_directions(objects: Sequence[Object], tracks: Tracks, poses: Poses) -> list[Object]:
    """Add direction and angular size to objects of a component whose cameras have directions only.

    None of them is measured: "ok" becomes "prior_dominated", and the reason names the distance.

    Args:
        tracks: without interpolated boxes. poses: of the component.
    Returns:
        the objects; of another component as they are.
    """
    if not poses.direction_sigma.any():
        return list(objects)
    return [
        dataclasses.replace(o, **_direction_fields(o, tracks[tracks.track_id == o.id], poses))
        for o in objects
    ]


def _direction_fields(found: Object, tracks: Tracks, poses: Poses) -> dict[str, Any]:
    """Return the fields of an object that directions determine, from its own rows of the tracks."""
    fields: dict[str, Any] = {}
    if found.located and "distance guessed" not in found.reason:
        size = "size and " if found.status == "ok" else ""
        reason = "; ".join(filter(None, [found.reason, size + NOT_MEASURED]))
        fields = {"status": "prior_dominated", "reason": reason}
    row, known = place_of(poses, tracks.frame)
    if not known.any():
        return fields
    if found.center is not None:
        eye = invert_rigid(poses.cam_from_world[row[known]])[:, :, 3].mean(0)
        away = found.center - eye
        fields["direction"] = significant(away / np.linalg.norm(away))
    xyxy = tracks.xyxy[known]
    far_border = np.array([poses.camera.width, poses.camera.height]) - BORDER_PX
    whole = (xyxy[:, :2] > BORDER_PX).all(1) & (xyxy[:, 2:] < far_border).all(1)
    box = undistort_boxes(xyxy[whole] if whole.any() else xyxy, poses.camera)
    x1, y1, x2, y2 = box.T
    x = (x1 + x2) / 2
    y = (y1 + y2) / 2
    one = np.ones_like(x)
    ends = np.array([[x1, y, one], [x, y1, one], [x2, y, one], [x, y2, one]]).swapaxes(1, 2)
    ray = ends @ np.linalg.inv(poses.camera.K).T  # (4, n, 3) to the middle of the edges
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    chord = np.linalg.norm(ray[:2] - ray[2:], axis=2).max(0)
    fields["angular_size_deg"] = rounded(np.degrees(2 * np.arcsin(np.median(chord) / 2)), 2)
    return fields


def _likeliest_classes(
    rows: Tracks, class_names: Sequence[str], class_count: int
) -> dict[str, float]:
    """Return the probabilities of the likeliest two classes of an object, from all its detections.

    Class confusion model: correct with CLASS_KEPT, else uniform over the other classes.

    Args:
        class_count: number of classes that any object of the video may have.
    """
    classes, column = np.unique(rows.class_id, return_inverse=True)
    votes = np.bincount(column, rows.score) / 10  # errors of ten consecutive frames count as one
    log_odds = votes * np.log(CLASS_KEPT / (1 - CLASS_KEPT) * max(class_count - 1, 1))
    probability = np.exp(log_odds - log_odds.max())
    probability /= probability.sum() + (class_count - len(classes)) * np.exp(-log_odds.max())
    best = np.argsort(-probability, kind="stable")[:2]
    return {name_of(class_names, int(classes[k])): round(float(probability[k]), 3) for k in best}


def _fit_fields(
    fits: quadrics.ObjectFits,
    i: int,
    views: Views,
    iou: Array,
    moves: bool,
    min_views: int,
    view_count: int | None,
) -> dict[str, Any]:
    """Return the fields of object i that its fit determines.

    Args:
        view_count: in all frames; the outliers of the other frames are extrapolated. None: `views`
            has all frames.
    """
    seen = np.isfinite(views.boxes[:, i, 0])
    dropped = int((seen & ~fits.inlier[:, i]).sum())
    if view_count is None:
        view_count = int(seen.sum())
    elif seen.any():
        dropped = round(dropped * view_count / int(seen.sum()))
    status, reason, shape = _verdict(fits, i, moves, view_count, min_views)
    fields = {
        "status": status,
        "reason": reason,
        "support": shape,
        "views": view_count,
        "dropped_boxes": dropped,
        "parallax_deg": rounded(fits.parallax_deg[i], 2),
        "reprojection_iou_median": rounded(np.median(iou[seen]), 3) if seen.any() else None,
    }
    if status == "rejected":
        return fields
    distance = _median_distance(views.img_from_world, fits.ellipsoids.center_in_world[i])
    cov, why = usable_covariance(fits.cov[i], distance)
    fields["reason"] = "; ".join(filter(None, [reason, why]))
    return fields | _shape_fields(fits, i, cov)


def _verdict(
    fits: quadrics.ObjectFits, i: int, moves: bool, view_count: int, min_views: int
) -> tuple[str, str, str | None]:
    """Return the status of object i, its reason, and the kind of shape."""
    if moves:
        return "rejected", "objects of this class move", None
    if view_count < min_views:
        seen_in = f"seen in {view_count} frame{'s' * (view_count != 1)} with a camera pose"
        return "rejected", f"{seen_in} ({min_views} are needed)", None
    return str(fits.status[i]), str(fits.reason[i]), str(fits.support[i])


MOST_DISTANCES = 10.0  # sigma of a centre, in distances of the object: beyond it none is known
# sigma of a rotation about an axis: uniform over the full turn
MOST_TURN = np.pi / np.sqrt(3)
MOST_LOG_SIZE = quadrics.UNKNOWN_SCALE_LOG


def usable_covariance(cov: Array, distance: float) -> tuple[Array, str]:
    """Limit a covariance (9, 9) of an object to sigmas that have a meaning.

    A direction that the boxes hardly determine has a variance up to 1e40. Larger sigmas than the
    limits are reduced to them, with their correlations. A matrix that is no covariance is replaced
    by the limits.

    Args:
        distance: of the object from the cameras.
    Returns:
        the covariance (all NaN: as it is), and what the boxes hardly determine, "" if nothing. An
        unknown rotation is not mentioned: that of a round object is never known.
    """
    if np.isnan(cov).all():
        return cov, ""
    most = np.repeat([MOST_DISTANCES * distance, MOST_LOG_SIZE, MOST_TURN], 3)
    sigma = np.sqrt(np.diag(cov).clip(0))
    bound = 1.000001 * np.maximum(sigma, 1e-9)  # correlations are at most 1
    if not np.isfinite(cov).all() or (np.abs(cov) > bound * bound[:, None]).any():
        return np.diag(most**2), "its uncertainty is not known"
    ratio = most / np.maximum(sigma, most)
    parts = {"place": ratio[:3], "size": ratio[3:6]}
    vague = " and ".join(part for part, of_part in parts.items() if (of_part < 1).any())
    why = f"the boxes hardly determine its {vague}" if vague else ""
    return cov * ratio * ratio[:, None], why


def _median_distance(img_from_world: Array, center: Array) -> float:
    """Return the median distance of a place (3,) from cameras (n, 3, 4)."""
    shift = img_from_world[:, :, :3] @ center + img_from_world[:, :, 3]
    from_camera = np.linalg.solve(img_from_world[:, :, :3], shift[..., None])  # (n, 3, 1)
    return float(np.median(np.linalg.norm(from_camera, axis=(1, 2))))


def _shape_fields(fits: quadrics.ObjectFits, i: int, cov: Array) -> dict[str, Any]:
    """Return ellipsoid, size and covariance (9, 9) of object i, None where unknown."""
    scale = fits.scale
    variance = np.diag(cov)[3:6] + scale.rel_sigma**2  # of log sizes in metres: both
    rotation = fits.ellipsoids.world_from_obj[i : i + 1]
    values = {
        "center": fits.ellipsoids.center_in_world[i],
        "half_axes": fits.ellipsoids.half_axes[i],
        "quat_wxyz": quat_wxyz_from_matrix(rotation)[0],
        "size": fits.size[i],
        "size_m": fits.size[i] * scale.value if scale.source != "none" else None,
        "size_rel_sigma": np.sqrt(variance),
        "cov": cov,
    }
    unknown = {k for k, v in values.items() if v is None or not np.isfinite(v).all()}
    fields = {k: None if k in unknown else significant(v) for k, v in values.items()}
    if fields["center"] is not None:
        size = float(np.max(values["half_axes"]))
        fields["center"] = significant(values["center"], size)
    return fields


def describe_world(
    poses: Poses | None,
    fits: Sequence[quadrics.ObjectFits | None],
    events: Sequence[LinkEvent],
) -> World:
    """Describe the world of the poses: units, gravity, scale, floor, frames, joins and splits.

    Args:
        fits: of each component, None where nothing was fitted.
    """
    if poses is None:
        return World(links=tuple(events))
    components = tuple(_describe_component(poses, k, fit) for k, fit in enumerate(fits))
    of_largest = (
        "registered_frames", "interpolated_frames", "up_in_world", "up_source", "scale", "floor",
        "floor_reason",
    )  # fmt: skip
    largest: dict[str, Any] = {name: getattr(components[0], name) for name in of_largest}
    return World(
        units="m" if poses.metric else "arbitrary",
        source=poses.source,
        frames=len(poses.frame),
        links=tuple(events),
        parts=components,
        reading=poses.reading,
        **largest,
    )


def _describe_component(poses: Poses, component: int, fits: quadrics.ObjectFits | None) -> Part:
    """Describe one component of the trajectory from its frames and its fits."""
    row = np.flatnonzero(poses.part == component)
    poses = poses.of_part(component)
    runs = np.split(poses.frame, np.flatnonzero(np.diff(row) > 1) + 1)
    scale = None
    up = poses.up_in_world
    up_source = "none" if up is None else "poses"
    if fits is not None:
        (value,) = numbers(np.array([fits.scale.value]), 1.0)
        scale = quadrics.Scale(value, round(fits.scale.rel_sigma, 4), fits.scale.source)
        if fits.up.any():
            up = fits.up
            up_source = fits.up_source
    up = None if up is None else significant(up)
    known_scale = None if scale is None or scale.source == "none" else scale.value
    floor, reason = floor_of(poses, up, 1.0 if poses.metric else known_scale)
    return Part(
        spans=[[int(run[0]), int(run[-1])] for run in runs if len(run)],
        frames=len(poses.frame),
        registered_frames=int(poses.known.sum()),
        interpolated_frames=int((poses.status == "interpolated").sum()),
        up_in_world=up,
        up_source=up_source,
        scale=scale,
        floor=floor,
        floor_reason=reason,
        grade="directions" if poses.direction_sigma.any() else "positions",
        direction_sigma_deg=round(float(np.degrees(poses.direction_sigma[0])), 3),
    )


def components_message(poses: Poses) -> list[str]:
    """Return a warning if the trajectory has several components: consequences, and what helps."""
    if poses.part_count == 1:
        return []
    components = describe_world(poses, [None] * poses.part_count, []).parts
    where = shortened([f"component {k}: {part.span_text}" for k, part in enumerate(components)])
    return [
        f"the trajectory has {len(components)} components that do not connect ({where}): each has "
        "its own frame and scale, and an object seen in two of them is listed twice. To get one "
        "component, record with more overlap and slower turns, or give --poses; identities can be "
        "joined by hand (in scene.html, then `objects OUT --edits`)"
    ]


# ---- Confidence ----

# Logistic regression of existence: intercept, log odds of the best scores, hit rate over the frames
# where the object should be visible, see-through ratio (`see_through_ratio`). Fitted to
# 1,202 objects of 48 runs of 10 rooms (benchmarks/RESULTS.md)
CONFIDENCE = (-1.0, 1.5, 1.8, -1.5)
FITTED_TO = "YOLOv8s, deimv2-femto, rendered rooms"
FITTED_SCORES = (0.13, 0.87)  # lowest and highest median score of the recordings it was fitted to
FAR_OFF = 1.0  # in log odds, beyond the fitted range at which a median is reported
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
        score: `log_best_odds` of the detections. see_through: `see_through_ratio`.
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
    """Return a warning if the scores are far from the ones that the confidence was fitted to."""
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


def objects_confidence(
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


def identities_confidence(
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
        why += f": {_strongest_doubt(confidence)}"
    if status == "rejected":
        why += f"; {reason}"
    return "doubtful", why


def _strongest_doubt(found: Existence) -> str:
    """Name the evidence that lowers a confidence most, compared with objects that exist."""
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
