"""Objects of a video: linked and fitted part by part.

Cameras that come in several rigid parts (`Poses.part`) are several worlds, each with a scale of its
own. Every part is treated like a video of its own; afterwards identities are numbered over all.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import quadrics
from reobj.cameras import Poses, place_of
from reobj.files import shortened
from reobj.objects.component import (
    Located,
    confidence,
    floor_under,
    locate,
    log_best_odds,
    on_floor,
)
from reobj.objects.description import (
    MIN_SCORE,
    ObjectsConfig,
    describe_objects,
    describe_world,
    fitter,
    name_of,
)
from reobj.objects.observations import NOTHING_KNOWN, Fit, Scene, gather_views, points_on
from reobj.objects.occlusion import hidden_edges
from reobj.results.edits import Edits, apply_edits
from reobj.results.result import Result
from reobj.tracking.interpolation import fill_by_place, fill_gaps
from reobj.tracking.linking import FRAGMENT_GAP, link
from reobj.types import (
    BoolArray,
    Embeddings,
    IntArray,
    LinkEvent,
    ReobjError,
    Tracks,
    looks,
    object_classes,
    rows_by,
)


def link_and_fit(result: Result, config: ObjectsConfig) -> None:
    """Decide which detections are one object and fit its solid: in place.

    Sets tracks (identities; detections that the tracker left out join them), objects, fits and
    world. An object lies in one part: where the path breaks, an identity ends. Only identities that
    the user gave may span parts; their solid is fitted in the part that has most of their boxes.
    The result's edits come after the linker; those of an earlier fit that do not find their objects
    any more are left out, with a warning.

    Raises:
        ReobjError: an edit made now does not find its object.
    """
    poses = result.poses
    parts = [] if poses is None else [poses.of_part(k) for k in range(poses.part_count)]
    fit_in: list[Fit | None] = [None] * max(len(parts), 1)
    priors = quadrics.load_priors(config.priors or None)
    if any(p.known.sum() >= config.min_views for p in parts):
        for k, own in enumerate(parts):
            fit_in[k] = fitter(_options(config, k), own, result.class_names)
    linked = _Linked(result.tracks, located=[None] * len(fit_in))
    if not result.identities_given:
        linked = _link_parts(result, parts, fit_in, priors, config)
    if result.edits is not None:
        linked = _edited(linked, result, result.edits, priors)
        fit_in = [
            None if fit is None else fitter(_options(config, k), parts[k], result.class_names)
            for k, fit in enumerate(fit_in)
        ]
    tracks = linked.tracks
    category = tracks.class_id if linked.category is None else linked.category  # (N,)
    part = np.zeros(len(tracks), np.int64) if poses is None else poses.part_of(tracks.frame)  # (N,)
    fits: list[quadrics.ObjectFits | None] = [None] * len(fit_in)
    identity, row_of = np.unique(tracks.track_id, return_inverse=True)
    part_of_object = _part_with_most_boxes(tracks, row_of, len(identity), part, poses, config)
    result.objects = []
    for k, fit in enumerate(fit_in):
        own_rows, views = part_of_object[row_of] == k, None
        rows = tracks[own_rows]
        if len(rows) and fit is not None:
            classes = object_classes(dataclasses.replace(rows, class_id=category[own_rows]))
            group = np.searchsorted(list(classes), rows.track_id)
            views = gather_views(rows, parts[k], group, len(classes), MIN_SCORE)
            located = linked.located[k]
            if located is None:
                first = fit(views, list(classes.values()), NOTHING_KNOWN)
                floor, ellipsoids = floor_under(parts[k], first), first.ellipsoids
            else:
                solid = np.array([linked.solid_of.get(identity, -1) for identity in classes])
                floor, ellipsoids = located.floor, located.ellipsoids[solid]
            stands = on_floor(priors, [name_of(result.class_names, c) for c in classes.values()])
            hidden = hidden_edges(views, ellipsoids, stands & (floor is not None))
            points = points_on(views, parts[k], ellipsoids)
            views = dataclasses.replace(views, hidden=hidden, points=points)
            up = None if floor is None else floor.normal
            fits[k] = fit(views, list(classes.values()), Scene(floor, up))
        found = describe_objects(
            rows, result.class_names, fits[k], views, config, linked.confidence
        )
        result.objects += [dataclasses.replace(o, part=k) for o in found]
    result.objects.sort(key=lambda o: o.id)
    row = linked.rows_now(result.embedding_row)
    foreground, background = result.embeddings.foreground, result.embeddings.background
    result.embeddings = Embeddings(foreground[row >= 0], background[row >= 0])
    result.tracks, result.embedding_row = tracks, row[row >= 0]
    result.world = describe_world(poses, fits, linked.events)
    result.fits = fits[0] if poses is None else join_fits(fits, part_of_object, poses)


@dataclass(slots=True)
class _Linked:
    """Tracks with the identities of objects.

    Attributes:
        tracks: N rows. source: (N,) their rows before, -1: left out by the tracker; None: the same.
        events: joins and splits. confidence: of identities that have solids in a part.
        located: of each part, None where nothing was associated. solid_of: number of the solid that
            an identity has there.
    """

    tracks: Tracks
    source: IntArray | None = None
    events: list[LinkEvent] = field(default_factory=list)
    confidence: dict[int, float] = field(default_factory=dict)
    located: list[Located | None] = field(default_factory=list)
    solid_of: dict[int, int] = field(default_factory=dict)
    category: IntArray | None = None  # (N,) class whose size prior counts; None: that of the row

    def rows_now(self, before: IntArray) -> IntArray:
        """Return where rows of the table before linking are now, -1: deleted."""
        if self.source is None:
            return before
        now = np.full(max(self.source.max(initial=-1), before.max(initial=-1)) + 1, -1)
        now[self.source[self.source >= 0]] = np.flatnonzero(self.source >= 0)
        return np.asarray(now[before], np.int64)


def _options(config: ObjectsConfig, part: int) -> ObjectsConfig:
    """Return the options of a part: a direction given as up is one of the largest, part 0."""
    return dataclasses.replace(config, up="") if part else config


def _edited(linked: _Linked, result: Result, edits: Edits, priors: quadrics.Priors) -> _Linked:
    """Correct identities and classes by hand; an object that the user names is surely there.

    A new name that the priors know is a new category. Any other is a label: the size prior stays
    that of the class which the detector gave.
    """
    before = linked.tracks
    try:
        made = apply_edits(before, result.class_names, edits)
    except ReobjError as error:
        if not edits.kept:
            raise
        result.warnings.append(f"{error}; no correction of this file was applied")
        result.edits = None
        return linked
    result.class_names = made.class_names
    result.warnings += made.messages
    confidence, origin = dict[int, float](), dict[int, set[int]]()
    for now, then in set(zip(made.tracks.track_id.tolist(), before.track_id.tolist(), strict=True)):
        origin.setdefault(now, set()).add(then)
        if then in linked.confidence:
            sure = 1.0 if now in made.confirmed else linked.confidence[then]
            confidence[now] = max(sure, confidence.get(now, 0.0))
    source = np.arange(len(before)) if linked.source is None else linked.source
    rows = (made.tracks[made.keep], source[made.keep])
    solid_of = {i: solid for i, solid in linked.solid_of.items() if origin.get(i) == {i}}
    names = [name_of(made.class_names, c) for c in range(len(made.class_names))]
    known = np.append(priors.index(names) >= 0, False)[made.tracks.class_id]  # (N,)
    category = np.where(known, made.tracks.class_id, before.class_id)[made.keep]
    return _Linked(*rows, linked.events, confidence, linked.located, solid_of, category)


def _link_parts(
    result: Result,
    parts: Sequence[Poses],
    fit_in: Sequence[Fit | None],
    priors: quadrics.Priors,
    config: ObjectsConfig,
) -> _Linked:
    """Link each part alone, and number its identities after those of the parts before it."""
    made, steps, sources, taken = _Linked(result.tracks), list[Tracks](), list[IntArray](), 0
    table, source = _with_untracked(result.tracks, result.untracked)
    part = np.zeros(len(table), np.int64)
    if result.poses is not None:
        part = _part_of_rows(table, result.poses)
    table = _cut_at_parts(table, part)
    for k, fit in enumerate(fit_in):
        rows = np.flatnonzero(part == k)
        located = None
        if config.link and fit is not None and parts[k].known.sum() >= config.min_views:
            names, moving = result.class_names, config.moving_classes
            located = locate(table[rows], names, parts[k], fit, priors, moving, result.looked)
        solid = np.full(len(rows), -1) if located is None else located.solid
        keep = (source[rows] >= 0) | (solid >= 0)
        rows, solid = rows[keep], solid[keep]
        own = _with_tracklets(table[rows], solid, result.looked)
        if config.link:
            own, found = link(
                own, result.class_names, *_embeddings_of(result, source[rows]),
                None if located is None else parts[k], moving=config.moving_classes,
                solid=None if located is None else solid,
                overlap=None if located is None else located.overlap[keep], looked=result.looked,
            )  # fmt: skip
            made.events += found
        else:
            own = own.with_identities(own.track_id)
        own = dataclasses.replace(own, track_id=own.track_id + taken)
        taken = int(own.track_id.max(initial=taken))
        if located is not None:
            posed = np.isin(own.frame, parts[k].frame[parts[k].known])
            made.confidence |= _confidences(own, solid, posed, located)
            shown = solid >= 0
            ids = own.track_id[shown].tolist()
            made.solid_of |= dict(zip(ids, solid[shown].tolist(), strict=True))
        made.located.append(located)
        steps.append(own)
        sources.append(source[rows])
    order = np.argsort(np.concatenate([own.frame for own in steps]), kind="stable")
    made.tracks, made.source = Tracks.joined(steps), np.concatenate(sources)[order]
    return made


def _confidences(
    tracks: Tracks, solid: IntArray, posed: BoolArray, located: Located
) -> dict[int, float]:
    """Return the confidence of identities: of its solid, or of its scores if it has none.

    Nothing speaks for or against what was seen only in frames without a pose.

    Args:
        solid: (N,) of each row, or -1. posed: (N,) its frame has a pose.
    """
    found = {}
    for rows in rows_by(tracks.track_id):
        if not posed[rows].any():
            continue
        own = solid[rows][solid[rows] >= 0]
        sure = located.confidence[own[:1]]
        if not len(own):
            score = log_best_odds(tracks.score[rows], np.zeros(len(rows), np.int64), 1)
            sure = confidence(score, np.array([np.nan]))
        found[int(tracks.track_id[rows[0]])] = float(sure[0])
    return found


def _with_untracked(tracks: Tracks, untracked: Tracks) -> tuple[Tracks, IntArray]:
    """Put the detections that the tracker left out among its rows, by frame.

    Returns:
        the table; (N,) the row of the tracks that each of its rows is, or -1.
    """
    source = np.append(np.arange(len(tracks)), np.full(len(untracked), -1))
    order = np.argsort(np.append(tracks.frame, untracked.frame), kind="stable")
    return Tracks.joined([tracks, untracked]), source[order]


def _with_tracklets(table: Tracks, solid: IntArray, looked: IntArray | None = None) -> Tracks:
    """Give rows in no tracklet that of the row before of their solid, or one of their own.

    A tracklet ends where more than FRAGMENT_GAP frames looked at lie between two rows.
    """
    tracklet = table.tracklet_id.copy()
    fresh = int(tracklet.max(initial=0)) + 1
    number, unit = looks(table, looked)
    taken = set(zip(table.frame.tolist(), tracklet.tolist(), strict=True))
    for rows in rows_by(solid):
        if solid[rows[0]] < 0:
            continue
        for before, row in itertools.pairwise([-1, *rows.tolist()]):
            if tracklet[row]:
                continue
            continues = before >= 0 and number[row] - number[before] <= FRAGMENT_GAP * unit
            key = int(table.frame[row]), int(tracklet[before])
            if continues and key not in taken:
                tracklet[row] = tracklet[before]
                taken.add(key)
            else:
                tracklet[row], fresh = fresh, fresh + 1
    return dataclasses.replace(table, tracklet_id=tracklet)


def _part_of_rows(tracks: Tracks, poses: Poses) -> IntArray:
    """Return the part (N,) of rows: of their frame, or without a pose that of their tracklet.

    Where the path breaks, a thing that comes into view before the next part begins is of that part.
    """
    part = poses.part_of(tracks.frame)
    posed = place_of(poses, tracks.frame)[1]
    for rows in rows_by(tracks.tracklet_id) if poses.part_count > 1 else ():
        lost, own = rows[~posed[rows]], rows[posed[rows]]
        if tracks.tracklet_id[rows[0]] and len(lost) and len(own):
            away = np.abs(tracks.frame[lost, None] - tracks.frame[own])
            part[lost] = part[own[away.argmin(1)]]
    return part


def _cut_at_parts(tracks: Tracks, part: IntArray) -> Tracks:
    """Cut tracklets where the part (N,) of their rows changes; later parts get new numbers."""
    tracklet = tracks.tracklet_id.copy()
    for k in range(1, int(part.max(initial=0)) + 1):
        spanning = (part == k) & (tracklet > 0) & np.isin(tracklet, tracklet[part < k])
        piece = np.unique(tracklet[spanning], return_inverse=True)[1]
        tracklet[spanning] = tracklet.max() + 1 + piece
    return dataclasses.replace(tracks, tracklet_id=tracklet)


def _embeddings_of(result: Result, source: IntArray) -> tuple[Embeddings, IntArray]:
    """Select the embeddings of some rows of the tracks (-1: none), and number them by these."""
    number = np.full(len(result.tracks), -1)
    number[source[source >= 0]] = np.flatnonzero(source >= 0)
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
    usable = tracks.score >= MIN_SCORE
    if poses is not None:
        usable &= place_of(poses, tracks.frame)[1]
    votes = np.zeros((count, int(part.max(initial=0)) + 1))
    np.add.at(votes, (row_of, part), np.where(usable, 1.0, 1 / (len(tracks) + 1)))
    return np.asarray(votes.argmax(1), np.int64)


def fill(result: Result, image_size: tuple[int, int], max_gap: int) -> Tracks:
    """Fill gaps between detections of an identity: by its solid where it has one.

    Args:
        image_size: (w, h). max_gap: as of `fill_gaps`.
    Returns:
        the tracks; frames that the detector was not run on are not filled.
    """
    tracks = result.tracks
    for part in result.parts() if max_gap else ():
        if part.poses is not None and (own := part.located):
            identity, support = np.array([o.id for o in own]), [str(o.support) for o in own]
            tracks = fill_by_place(tracks, part.poses, identity, part.ellipsoids(), support)
    if result.looked is not None:
        tracks = tracks[np.isin(tracks.frame, result.looked)]
    return fill_gaps(tracks, image_size, max_gap, result.looked)


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
        "hand (in scene.html, then `objects OUT --edits`)"
    ]
