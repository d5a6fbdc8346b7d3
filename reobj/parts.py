"""Objects of a video: linked and fitted part by part.

Cameras that come in several rigid parts (`Poses.part`) are several worlds, each with a scale of its
own. Every part is treated like a video of its own; afterwards identities are numbered over all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

import quadrics
from reobj.cameras import Poses, place_of
from reobj.files import shortened
from reobj.identity.linking import link
from reobj.objects import Fit, ObjectsConfig, describe_objects, describe_world, fitter
from reobj.results.result import Result
from reobj.types import Embeddings, IntArray, LinkEvent, Tracks, object_classes
from reobj.views import gather_views


def link_and_fit(result: Result, config: ObjectsConfig) -> None:
    """Decide which tracklets are one object and fit its solid: in place.

    Sets tracks (identities), objects, fits and world. An object lies in one part: where the path
    breaks, an identity ends. Only identities that the user gave may span parts; their solid is
    fitted in the part that has most of their boxes.
    """
    poses, tracks = result.poses, result.tracks
    parts = [] if poses is None else [poses.of_part(k) for k in range(poses.part_count)]
    part = np.zeros(len(tracks), np.int64) if poses is None else poses.part_of(tracks.frame)  # (N,)
    fit_in: list[Fit | None] = [None] * max(len(parts), 1)
    if any(p.known.sum() >= config.min_views for p in parts):
        for k, own in enumerate(parts):  # a direction given as up is one of the largest part
            options = dataclasses.replace(config, up="") if k else config
            fit_in[k] = fitter(options, own, result.class_names)
    events: list[LinkEvent] = []
    if not result.identities_given:
        tracks, events = _link_parts(result, parts, part, fit_in, config)
    fits: list[quadrics.ObjectFits | None] = [None] * len(fit_in)
    identity, row_of = np.unique(tracks.track_id, return_inverse=True)
    part_of_object = _part_with_most_boxes(tracks, row_of, len(identity), part, poses, config)
    result.objects = []
    for k, fit in enumerate(fit_in):
        rows, views = tracks[part_of_object[row_of] == k], None
        if len(rows) and fit is not None:
            classes = object_classes(rows)
            group = np.searchsorted(list(classes), rows.track_id)
            views = gather_views(rows, parts[k], group, len(classes), config.min_score)
            fits[k] = fit(views, list(classes.values()))
        found = describe_objects(rows, result.class_names, fits[k], views, config)
        result.objects += [dataclasses.replace(o, part=k) for o in found]
    result.objects.sort(key=lambda o: o.id)
    result.tracks, result.world = tracks, describe_world(poses, fits, events)
    result.fits = fits[0] if poses is None else join_fits(fits, part_of_object, poses)


def _link_parts(
    result: Result,
    parts: Sequence[Poses],
    part: IntArray,
    fit_in: Sequence[Fit | None],
    config: ObjectsConfig,
) -> tuple[Tracks, list[LinkEvent]]:
    """Link each part alone, and number its identities after those of the parts before it.

    Args:
        part: (N,) of each row of the tracks.
    """
    tracks, events, taken = _cut_at_parts(result.tracks, part), list[LinkEvent](), 0
    track_id = tracks.track_id.copy()
    for k, fit in enumerate(fit_in):
        rows = np.flatnonzero(part == k)
        own = tracks[rows]
        if config.link:
            located = fit is not None and parts[k].known.sum() >= config.min_views
            own, found = link(
                own, result.class_names, *_embeddings_of(result, rows),
                parts[k] if located else None, fit if located else None,
                moving=config.moving_classes, min_score=config.min_score,
                min_views=config.min_views,
            )  # fmt: skip
            events += found
        else:
            own = own.with_identities(own.track_id)
        track_id[rows] = own.track_id + taken
        taken += int(own.track_id.max(initial=0))
    return dataclasses.replace(tracks, track_id=track_id), events


def _cut_at_parts(tracks: Tracks, part: IntArray) -> Tracks:
    """Cut tracklets where the part (N,) of their rows changes; later parts get new numbers."""
    tracklet = tracks.tracklet_id.copy()
    for k in range(1, int(part.max(initial=0)) + 1):
        spanning = (part == k) & np.isin(tracklet, tracklet[part < k])
        piece = np.unique(tracklet[spanning], return_inverse=True)[1]
        tracklet[spanning] = tracklet.max() + 1 + piece
    return dataclasses.replace(tracks, tracklet_id=tracklet)


def _embeddings_of(result: Result, rows: IntArray) -> tuple[Embeddings, IntArray]:
    """Select the embeddings of some rows of the tracks, and number them by these rows."""
    number = np.full(len(result.tracks), -1)
    number[rows] = np.arange(len(rows))
    row = number[result.embedding_row]
    foreground, background = result.embeddings.foreground, result.embeddings.background
    return Embeddings(foreground[row >= 0], background[row >= 0]), row[row >= 0]


def _part_with_most_boxes(
    tracks: Tracks,
    row_of: IntArray,
    count: int,
    part: IntArray,
    poses: Poses | None,
    config: ObjectsConfig,
) -> IntArray:
    """Return the part (O,) that has most boxes of each object, those that a fit can use first.

    Args:
        row_of: (N,) object of each row of the tracks. part: (N,) of each row.
    """
    usable = tracks.score >= config.min_score
    if poses is not None:
        usable &= place_of(poses, tracks.frame)[1]
    votes = np.zeros((count, int(part.max(initial=0)) + 1))
    np.add.at(votes, (row_of, part), np.where(usable, 1.0, 1 / (len(tracks) + 1)))
    return np.asarray(votes.argmax(1), np.int64)


OF_THE_WORLD = {"scale", "up", "up_source"}  # columns of ObjectFits; the others are by object


def join_fits(
    fits: Sequence[quadrics.ObjectFits | None], part_of_object: IntArray, poses: Poses
) -> quadrics.ObjectFits | None:
    """Join the fits of all parts into one of all objects; scale and up are those of part 0.

    Args:
        fits: of the objects of each part, in their order; None where a part has no object.
        part_of_object: (O,).
    """
    if len(fits) == 1:
        return fits[0]
    made = [(k, fit) for k, fit in enumerate(fits) if fit is not None]
    if not made:
        return None
    order = np.argsort(np.argsort(part_of_object, kind="stable"))  # (O,) place of each in `made`
    inlier = np.zeros((int(poses.known.sum()), len(order)), bool)
    for k, fit in made:
        inlier[np.ix_(poses.part[poses.known] == k, part_of_object == k)] = fit.inlier
    columns: dict[str, Any] = {"inlier": inlier}
    solids = [fit.ellipsoids for _, fit in made]
    names = [f.name for f in dataclasses.fields(quadrics.Ellipsoids)]
    arrays = (np.concatenate([getattr(solid, name) for solid in solids])[order] for name in names)
    columns["ellipsoids"] = quadrics.Ellipsoids(*arrays)
    reasons = [reason for _, fit in made for reason in fit.reason]
    columns["reason"] = [reasons[i] for i in order]
    for name in {f.name for f in dataclasses.fields(quadrics.ObjectFits)} - {*columns}:
        values = [getattr(fit, name) for _, fit in made]
        columns[name] = values[0] if name in OF_THE_WORLD else np.concatenate(values)[order]
    if fits[0] is None:  # nothing says how large the largest part is
        none = quadrics.Scale(1.0, np.inf, "none")
        columns |= {"scale": none, "up": np.zeros(3), "up_source": "none"}
    return quadrics.ObjectFits(**columns)


def parts_message(poses: Poses) -> list[str]:
    """Say what several parts mean for the user, and what helps; [] if there is one only."""
    if poses.part_count == 1:
        return []
    parts = describe_world(poses, [None] * poses.part_count, []).parts
    where = shortened([f"part {k}: {part.span_text}" for k, part in enumerate(parts)])
    return [
        f"the cameras come in {len(parts)} parts that do not connect ({where}): each has its own "
        "frame and scale, and what is seen in two parts is listed as two objects. A recording that "
        "overlaps more, with slower turns, or --poses gives one part; identities can be joined by "
        "hand (`export OUT --to cvat`, `objects OUT --tracks`)"
    ]
