"""From tracks and cameras to objects: link the tracks, fit one shape to every identity.

Each connected component of the trajectory (`Poses.part`) has a world and a scale of its own and is
processed like a video of its own. Identities are numbered over all components. Every step takes
values and returns values; `link_and_fit` loops over the components.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import quadrics
from reobj.cameras import Poses, place_of
from reobj.objects.component import associate_component, find_floor
from reobj.objects.config import ObjectsConfig, make_fit, with_given_boxes
from reobj.objects.description import (
    describe_objects,
    describe_world,
    identities_confidence,
    with_directions,
)
from reobj.objects.likelihood import name_of, on_floor
from reobj.objects.observations import (
    MIN_SCORE,
    Fit,
    Scene,
    gather_views,
    informative_frames,
    occluded_edges,
    only_frames,
    points_on,
)
from reobj.results.edits import Edits, apply_edits
from reobj.results.links import ComponentShapes, Links, tracked_key
from reobj.results.result import Object, Result
from reobj.sources.tables import Boxes3D
from reobj.tracking.linking import FRAGMENT_GAP, fill_from_objects, fill_gaps, link
from reobj.types import (
    BoolArray,
    Embeddings,
    IntArray,
    LinkEvent,
    ReobjError,
    Tracks,
    detector_run_numbers,
    nearest_of,
    object_classes,
    rows_by,
)


def link_and_fit(result: Result, config: ObjectsConfig, last: Links | None = None) -> Result:
    """Decide which detections belong to one object, and fit a shape to each object.

    An object lies in one component: an identity ends at a break of the trajectory. Only identities
    given by the user may span components; their shape is fitted in the component with most of
    their boxes. The result's edits are applied after linking. Edits of an earlier fit that no
    longer find their objects are skipped with a warning.

    Args:
        last: links of the last result of the folder. Its identities are used again if its tracks,
            its cameras and the options of linking are the same, and keep their numbers else.
    Returns:
        the result with its tracks (identities; untracked detections may join them), objects, fits,
        world and links.
    Raises:
        ReobjError: an edit made now does not find its object.
    """
    priors = config.size_priors()
    poses = result.poses
    components = _split_trajectory(poses, config, result.class_names)

    links = _link(result, config, last)
    keeps_shapes = _options_unchanged(links, config, OPTIONS_OF_SHAPES)
    linked = links if keeps_shapes else _without_shapes(links)
    edited = _Edited(linked, result.class_names, [], None)
    if result.edits is not None:
        edited = _edit(linked, result, result.edits, priors, _last_numbers(links, last))
        components = _split_trajectory(poses, config, edited.class_names)
    linked = edited.linked
    number = links.tracks.track_id if edited.number is None else edited.number
    links = dataclasses.replace(
        links, number=number, highest=max(links.highest, int(number.max(initial=0)))
    )
    identity, object_of_row = np.unique(linked.tracks.track_id, return_inverse=True)
    component_of_object = _component_with_most_boxes(
        linked.tracks, object_of_row, len(identity), poses
    )
    objects = list[Object]()
    fits = list[quadrics.ObjectFits | None]()
    for component in components:
        rows = np.flatnonzero(component_of_object[object_of_row] == component.number)
        described, fit = _fit_component(
            component,
            rows,
            linked,
            result.boxes_3d,
            edited.class_names,
            priors,
            config,
            result.video.fps,
        )
        objects += described
        fits.append(fit)
    embeddings, embedding_row = _select_embeddings(result, linked.source)
    return dataclasses.replace(
        result,
        tracks=linked.tracks,
        class_names=edited.class_names,
        objects=sorted(objects, key=lambda o: o.id),
        world=describe_world(poses, fits, linked.events),
        fits=fits[0] if poses is None else join_fits(fits, component_of_object, poses),
        embeddings=embeddings,
        embedding_row=embedding_row,
        warnings=[*result.warnings, *edited.warnings],
        edits=edited.edits,
        links=links,
    )


class _Component(NamedTuple):
    """A connected component of the trajectory: its poses, and how its objects are fitted.

    Attributes:
        number: 0 the largest. poses: None without cameras. fit: None if no component has enough
            poses.
    """

    number: int
    poses: Poses | None
    fit: Fit | None


def _split_trajectory(
    poses: Poses | None, config: ObjectsConfig, class_names: Sequence[str]
) -> list[_Component]:
    """Split the trajectory into its components.

    An upward direction given by the user is that of the largest, component 0.
    """
    if poses is None:
        return [_Component(0, None, None)]
    poses_of = [poses.of_part(k) for k in range(poses.part_count)]
    if not any(p.known.sum() >= config.min_views for p in poses_of):
        return [_Component(k, p, None) for k, p in enumerate(poses_of)]
    others = dataclasses.replace(config, up="")
    return [
        _Component(k, p, make_fit(config if k == 0 else others, p, class_names))
        for k, p in enumerate(poses_of)
    ]


# ---- Linking -----------------------------------------------------------------------------------


OPTIONS_OF_LINKS = ("link", "moving")
# These change floor and ellipsoids with which the fit begins: then it finds them anew
OPTIONS_OF_SHAPES = (*OPTIONS_OF_LINKS, "priors", "prior", "known_size", "up")


def _options_unchanged(links: Links, config: ObjectsConfig, names: Sequence[str]) -> bool:
    """Test whether some options have the values that the links were made with."""
    options = dataclasses.asdict(config)
    return all(links.options.get(name) == options[name] for name in names)


def _link(result: Result, config: ObjectsConfig, last: Links | None) -> Links:
    """Return the identities of all components: from the last result, or linked again.

    Without a change of the options of linking, detections are linked as in the last run: known
    sizes and priors given now concern the fit only.
    """
    key = tracked_key((result.tracks, result.untracked), result.poses)
    linking = config
    if last is not None and _options_unchanged(last, config, OPTIONS_OF_LINKS):
        if last.key == key:
            return last
        known = {f.name for f in dataclasses.fields(ObjectsConfig)}
        linking = ObjectsConfig(**{k: v for k, v in last.options.items() if k in known})
    components = _split_trajectory(result.poses, linking, result.class_names)
    if result.identities_given:
        links = _unlinked(result.tracks, len(components))
    else:
        priors = linking.size_priors()
        links = _joined(
            _link_component(component, *table, result, priors, linking)
            for component, table in zip(components, _split_table(result), strict=True)
        )
        links = links if last is None else links.keep_numbers_of(last)
    options = dataclasses.asdict(linking)
    highest = max(links.highest, int(links.tracks.track_id.max(initial=0)))
    return dataclasses.replace(
        links,
        options=options,
        key=key,
        highest=highest,
        before=frozenset() if last is None or result.identities_given else last.before,
    )


def _without_shapes(links: Links) -> Links:
    """Return links without the shapes of the association."""
    return dataclasses.replace(links, shapes=[None] * len(links.shapes))


def _last_numbers(links: Links, last: Links | None) -> IntArray | None:
    """Return the number (N,) of each row in the last result, 0: none; None: no last result."""
    if last is None or links is last:
        return None if last is None else last.number
    row = last.rows_of(links.tracks)
    return np.where(row >= 0, np.append(last.number, 0)[row], 0)


def _unlinked(tracks: Tracks, count: int) -> Links:
    """Keep the identities of the tracks as they are, for `count` components."""
    return Links(tracks, np.arange(len(tracks)), tracks.class_id, shapes=[None] * count)


def _split_table(result: Result) -> list[tuple[Tracks, IntArray]]:
    """Split all detections by component, and cut tracklets at the breaks.

    Returns:
        for each component the table and (N,) row of the result's tracks, or -1.
    """
    table, source = _with_untracked(result.tracks, result.untracked)
    if result.poses is None:
        return [(table, source)]
    component = _component_of_rows(table, result.poses)
    table = _cut_at_breaks(table, component)
    rows_of = [np.flatnonzero(component == k) for k in range(result.poses.part_count)]
    return [(table[rows], source[rows]) for rows in rows_of]


def _link_component(
    component: _Component,
    table: Tracks,
    source: IntArray,
    result: Result,
    priors: quadrics.Priors,
    config: ObjectsConfig,
) -> Links:
    """Link the tracks of a component; identities are numbered from 1.

    Args:
        table: detections of the component. source: (N,) their rows in the result's tracks, or -1.
    """
    _, poses, fit = component
    objects = None
    if config.link and fit and poses is not None and poses.known.sum() >= config.min_views:
        moving = config.moving_classes
        objects = associate_component(
            table, result.class_names, poses, fit, priors, moving, result.looked
        )
    label = np.full(len(table), -1) if objects is None else objects.label
    keep = (source >= 0) | (label >= 0)
    table = table[keep]
    source = source[keep]
    label = label[keep]
    tracks = _with_tracklets(table, label, result.looked)
    events = list[LinkEvent]()
    if config.link:
        tracks, events = link(
            tracks, result.class_names, *_select_embeddings(result, source),
            None if objects is None else poses, moving=config.moving_classes,
            label=None if objects is None else label,
            iou=None if objects is None else objects.iou[keep], detector_ran=result.looked,
        )  # fmt: skip
    else:
        tracks = tracks.with_identities(tracks.track_id)
    certainty: dict[int, float] = {}
    label_of: dict[int, int] = {}
    if objects is not None and poses is not None:
        posed = np.isin(tracks.frame, poses.frame[poses.known])
        certainty = identities_confidence(tracks, label, posed, objects.confidence)
        shown = label >= 0
        label_of = dict(zip(tracks.track_id[shown].tolist(), label[shown].tolist(), strict=True))
    shapes = None if objects is None else ComponentShapes(objects.floor, objects.ellipsoids)
    return Links(tracks, source, tracks.class_id, events, certainty, [shapes], label_of)


def _joined(components: Iterable[Links]) -> Links:
    """Join the linked components; identities continue the numbers of the component before."""
    linked = list(components)
    highest = [int(c.tracks.track_id.max(initial=0)) for c in linked]
    pairs = list(zip(linked, itertools.accumulate([0, *highest[:-1]]), strict=True))
    joined = [dataclasses.replace(c.tracks, track_id=c.tracks.track_id + o) for c, o in pairs]
    order = np.argsort(np.concatenate([tracks.frame for tracks in joined]), kind="stable")
    tracks = Tracks.joined(joined)
    return Links(
        tracks,
        np.concatenate([c.source for c in linked])[order],
        tracks.class_id,
        [event for c in linked for event in c.events],
        {identity + o: value for c, o in pairs for identity, value in c.confidence.items()},
        [shapes for c in linked for shapes in c.shapes],
        {identity + o: label for c, o in pairs for identity, label in c.label_of.items()},
    )


def _with_untracked(tracks: Tracks, untracked: Tracks) -> tuple[Tracks, IntArray]:
    """Insert the untracked detections among the rows of the tracks, by frame.

    Returns:
        the table; (N,) row of the tracks of each of its rows, or -1.
    """
    source = np.append(np.arange(len(tracks)), np.full(len(untracked), -1))
    order = np.argsort(np.append(tracks.frame, untracked.frame), kind="stable")
    return Tracks.joined([tracks, untracked]), source[order]


def _with_tracklets(table: Tracks, label: IntArray, detector_ran: IntArray | None = None) -> Tracks:
    """Give untracked rows the tracklet of the previous row of their object, or a new one.

    A tracklet ends at a gap of more than FRAGMENT_GAP frames in which the detector was run.
    """
    tracklet = table.tracklet_id.copy()
    unused = int(tracklet.max(initial=0)) + 1
    number, unit = detector_run_numbers(table, detector_ran)
    taken = set(zip(table.frame.tolist(), tracklet.tolist(), strict=True))
    for rows in rows_by(label):
        if label[rows[0]] < 0:
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
                tracklet[row] = unused
                unused += 1
    return dataclasses.replace(table, tracklet_id=tracklet)


def _component_of_rows(tracks: Tracks, poses: Poses) -> IntArray:
    """Return the component (N,) of rows: of their frame, or without a pose of their tracklet.

    At a break, an unposed detection joins the component of the nearest posed detection of its
    tracklet.
    """
    component = poses.part_of(tracks.frame)
    _, posed = place_of(poses, tracks.frame)
    for rows in rows_by(tracks.tracklet_id) if poses.part_count > 1 else ():
        unposed_rows = rows[~posed[rows]]
        posed_rows = rows[posed[rows]]
        if tracks.tracklet_id[rows[0]] and len(unposed_rows) and len(posed_rows):
            near = nearest_of(tracks.frame[unposed_rows], tracks.frame[posed_rows])
            component[unposed_rows] = component[posed_rows[near]]
    return component


def _cut_at_breaks(tracks: Tracks, component: IntArray) -> Tracks:
    """Cut tracklets where the component (N,) of their rows changes; later pieces are renumbered."""
    tracklet = tracks.tracklet_id.copy()
    for k in range(1, int(component.max(initial=0)) + 1):
        in_earlier = np.isin(tracklet, tracklet[component < k])
        spanning = (component == k) & (tracklet > 0) & in_earlier
        piece = np.unique(tracklet[spanning], return_inverse=True)[1]
        tracklet[spanning] = tracklet.max() + 1 + piece
    return dataclasses.replace(tracks, tracklet_id=tracklet)


def _select_embeddings(result: Result, source: IntArray) -> tuple[Embeddings, IntArray]:
    """Select the embeddings of a table whose rows are rows (N,) of the result's tracks, or -1.

    Returns:
        n embeddings, and their rows (n,) in the table.
    """
    row_in_table = np.full(len(result.tracks), -1)
    row_in_table[source[source >= 0]] = np.flatnonzero(source >= 0)
    row = row_in_table[result.embedding_row]
    foreground = result.embeddings.foreground
    background = result.embeddings.background
    return Embeddings(foreground[row >= 0], background[row >= 0]), row[row >= 0]


# ---- Edits -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Edited:
    """Linked tracks after the user's edits, the class names, warnings, and the applied edits.

    `number`: (N,) identity of each row of the tracks before the edits, 0: deleted; None: no edits.
    """

    linked: Links
    class_names: tuple[str, ...]
    warnings: list[str]
    edits: Edits | None
    number: IntArray | None = None


def _edit(
    linked: Links,
    result: Result,
    edits: Edits,
    priors: quadrics.Priors,
    last: IntArray | None,
) -> _Edited:
    """Correct identities and classes by hand; an object that the user names certainly exists.

    A new name that the priors know is a new category. Any other is a label: the size prior stays
    that of the detector's class.

    Args:
        last: (N,) number of each row in the last result of the folder, 0: none.
    """
    before = linked.tracks
    try:
        applied = apply_edits(before, result.class_names, edits, last, linked.highest)
    except ReobjError as error:
        if not edits.kept:
            raise
        warning = f"{error}; no correction of this file was applied"
        return _Edited(linked, result.class_names, [warning], None)
    certainty: dict[int, float] = {}
    previous: dict[int, set[int]] = {}
    pairs = zip(applied.tracks.track_id.tolist(), before.track_id.tolist(), strict=True)
    for new, old in set(pairs):
        previous.setdefault(new, set()).add(old)
        if old in linked.confidence:
            value = 1.0 if new in applied.confirmed else linked.confidence[old]
            certainty[new] = max(value, certainty.get(new, 0.0))
    names = [name_of(applied.class_names, c) for c in range(len(applied.class_names))]
    has_prior = np.append(priors.index(names) >= 0, False)[applied.tracks.class_id]  # (N,)
    category = np.where(has_prior, applied.tracks.class_id, before.class_id)
    edited = dataclasses.replace(
        linked,
        tracks=applied.tracks[applied.keep],
        source=linked.source[applied.keep],
        category=category[applied.keep],
        confidence=certainty,
        label_of={i: label for i, label in linked.label_of.items() if previous.get(i) == {i}},
    )
    number = np.where(applied.keep, applied.tracks.track_id, 0)
    return _Edited(edited, applied.class_names, applied.messages, edits, number)


# ---- Fitting -----------------------------------------------------------------------------------


def _component_with_most_boxes(
    tracks: Tracks, object_of_row: IntArray, count: int, poses: Poses | None
) -> IntArray:
    """Return the component (O,) with most boxes of each object; boxes that a fit can use first.

    Args:
        object_of_row: (N,) object of each row of the tracks, of `count`.
    """
    component = np.zeros(len(tracks), np.int64)
    usable = tracks.score >= MIN_SCORE
    if poses is not None:
        component = poses.part_of(tracks.frame)
        usable &= place_of(poses, tracks.frame)[1]
    votes = np.zeros((count, int(component.max(initial=0)) + 1))
    weight = np.where(usable, 1.0, 1 / (len(tracks) + 1))
    np.add.at(votes, (object_of_row, component), weight)
    return np.asarray(votes.argmax(1), np.int64)


def _fit_component(
    component: _Component,
    rows: IntArray,
    linked: Links,
    boxes_3d: Boxes3D | None,
    class_names: Sequence[str],
    priors: quadrics.Priors,
    config: ObjectsConfig,
    fps: float,
) -> tuple[list[Object], quadrics.ObjectFits | None]:
    """Fit and describe the objects of a component.

    Args:
        rows: of its objects in the linked tracks. boxes_3d: of the detections.
        fps: frame rate of the source, Hz.
    """
    number, poses, fit = component
    tracks = linked.tracks[rows]
    fits = views = view_count = None
    if len(tracks) and fit is not None and poses is not None:
        classes = object_classes(dataclasses.replace(tracks, class_id=linked.category[rows]))
        categories = list(classes.values())
        group = np.searchsorted(list(classes), tracks.track_id)
        usable = tracks.score >= MIN_SCORE
        usable &= np.isin(tracks.frame, poses.frame[poses.measured])
        view_count = np.bincount(group[usable], minlength=len(classes))
        frames, informative = _frames_of_fit(tracks[usable], poses)
        views = gather_views(tracks, only_frames(poses, frames), group, len(classes), MIN_SCORE)
        shapes = linked.shapes[number]
        if shapes is None:
            first = fit(views, categories, Scene())
            floor = find_floor(poses, first)
            ellipsoids = first.ellipsoids
        else:
            label = np.array([linked.label_of.get(identity, -1) for identity in classes])
            floor = shapes.floor
            ellipsoids = shapes.ellipsoids[label]
        standing = on_floor(priors, [name_of(class_names, c) for c in categories])
        views = dataclasses.replace(
            views,
            occluded=occluded_edges(views, ellipsoids, standing, floor is not None),
            points=points_on(views, poses, ellipsoids),
        )
        # repeated views outnumber views of other sides: the fit takes new ones only
        new = np.zeros(views.boxes.shape[:2], bool)
        rows = np.flatnonzero(usable)[informative]
        new[np.searchsorted(views.frame, tracks.frame[rows]), group[rows]] = True
        views = dataclasses.replace(views, boxes=np.where(new[..., None], views.boxes, np.nan))
        fits = fit(views, categories, Scene(floor, None if floor is None else floor.normal))
        fits = with_given_boxes(fits, boxes_3d, tracks, group)
    described = describe_objects(
        tracks, class_names, fits, views, config.min_views, config.moving_classes,
        linked.confidence, number, view_count, fps,
    )  # fmt: skip
    if poses is not None:
        described = with_directions(described, tracks, poses)
    if fits is not None and views is not None and poses is not None:
        inlier = np.zeros((int(poses.known.sum()), fits.inlier.shape[1]), bool)
        inlier[np.isin(poses.frame[poses.known], views.frame)] = fits.inlier
        fits = dataclasses.replace(fits, inlier=inlier)
    return described, fits


def _frames_of_fit(tracks: Tracks, poses: Poses) -> tuple[IntArray, BoolArray]:
    """Choose the frames of a fit: informative ones, and frames that observe points.

    Returns:
        (K,) frames; (N,) informative rows.
    """
    frames, informative = informative_frames(tracks, poses, poses.frame[poses.known])
    observing = poses.frame[np.unique(poses.visibility[:, 0])]
    observing = observing[np.isin(observing, poses.frame[poses.known])]
    return np.union1d(frames, observing), informative


def join_fits(
    fits: Sequence[quadrics.ObjectFits | None], component_of_object: IntArray, poses: Poses
) -> quadrics.ObjectFits | None:
    """Join the fits of all components; scale and up are from component 0.

    Args:
        fits: of the objects of each component, in their order; None for one without objects.
        component_of_object: (O,).
    """
    if len(fits) == 1 or not any(fits):
        return fits[0]
    shape = (int(poses.known.sum()), len(component_of_object))
    joined = quadrics.ObjectFits.unfitted(shape, "")
    for k, fit in enumerate(fits):
        if fit is not None:
            objects = np.flatnonzero(component_of_object == k)
            joined.put(objects, fit)
            joined.inlier[np.ix_(poses.part[poses.known] == k, objects)] = fit.inlier
    first = fits[0] or joined
    return dataclasses.replace(joined, scale=first.scale, up=first.up, up_source=first.up_source)


# ---- Interpolation -----------------------------------------------------------------------------


def fill(result: Result, image_size: tuple[int, int], max_gap: int) -> Tracks:
    """Interpolate gaps between detections of an identity: by its shape if it has one.

    Args:
        image_size: (w, h). max_gap: as of `fill_gaps`.
    Returns:
        the tracks; frames that the detector was not run on are not filled.
    """
    tracks = result.tracks
    for component in result.parts() if max_gap else ():
        if component.poses is not None and (located := component.located):
            identity = np.array([o.id for o in located])
            shapes = [str(o.support) for o in located]
            poses = component.poses
            frames, _ = informative_frames(result.tracks, poses, poses.frame[poses.known])
            tracks = fill_from_objects(
                tracks, poses, identity, component.ellipsoids(), shapes, sources=frames
            )
    if result.looked is not None:
        tracks = tracks[np.isin(tracks.frame, result.looked)]
    return fill_gaps(tracks, image_size, max_gap, result.looked)
