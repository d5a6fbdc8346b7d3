"""Objects of a part of the path by their place: the association, from tables and back.

`locate` takes all detections, those in tracklets and those in none, and says which are of one
solid. What moves, and what no solid explains, is left to appearance (`reobj.tracking.linking`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, undistort_boxes
from reobj.objects.association import Association, Associator, Refit
from reobj.objects.hypotheses import propose, propose_along_rays
from reobj.objects.likelihood import NO_SOLIDS, Detected, Solids, logit
from reobj.objects.observations import Fit, Scene, Views, gather_views
from reobj.objects.occlusion import edges_above_floor, seen_through
from reobj.poses.floor import floor_of
from reobj.tracking.linking import cut_at_gaps
from reobj.types import Array, BoolArray, IntArray, Tracks, box_iou, class_shares, rows_by

# Log odds that an object is there: constant, by the log odds of its best scores, by the share of
# the frames that should show it and do, by how much is seen behind it through its middle
# (`occlusion.seen_through`). Fitted to 1,202 solids of 48 runs of 10 rooms (docs/tracking.md)
CONFIDENCE = (-1.0, 1.5, 1.8, -1.5)
USUAL_SHARE = 0.75  # where no frame should show it: a table that is always cut (their mean)
NO_SOLID = -1.9  # instead of the constant where no solid explains it (8 of 89 were real)
# The detections that tell whether an object is there, and the least share of all: most views of a
# half-hidden thing are poor (20 to 40 are alike; all of them, or ten, are worse: docs/trials.md)
BEST_DETECTIONS, BEST_SHARE = 30, 0.25
# Of a detection in no tracklet that proposes solids (.3 finds 73.5 objects instead of 72, in 1.2
# times the time: docs/trials.md)
PROPOSING_SCORE = 0.4
DOUBLE_IOU = 0.6  # boxes of a class that overlap more are of one thing (NMS: .5 to .7)
UNKNOWN_LOG = 3.0  # sigma of log sizes of which nothing is known (chosen: a factor of 20)
SIZE_SIGMAS = 6.0  # a size farther off counts as so many (chosen: a class may be wrong)


@dataclass(frozen=True, slots=True)
class Located:
    """What the association of a part found: S solids and their rows.

    Attributes:
        solid: (N,) solid that each row shows, or -1. overlap: (N,) IoU of its projection with the
            box, NaN where there is none. confidence: (S,) probability that it is there.
        floor: of the part, or None. ellipsoids: (S,) of the solids, and NaN at the end.
    """

    solid: IntArray
    overlap: Array
    confidence: Array
    floor: quadrics.Floor | None
    ellipsoids: quadrics.Ellipsoids


_UNKNOWN = quadrics.Ellipsoids(*(np.full(s, np.nan) for s in ((1, 3), (1, 3), (1, 3, 3))))
_NO_SOLID = Solids(_UNKNOWN, np.array([""]), np.array([-1]))


def locate(
    rows: Tracks,
    class_names: Sequence[str],
    poses: Poses,
    fit: Fit,
    priors: quadrics.Priors,
    moving: Collection[str] = (),
    looked: IntArray | None = None,
) -> Located:
    """Associate the detections of a part with solids.

    Args:
        rows: all detections by frame, tracklet 0: in none. moving: names of classes that move.
        looked: frames that the detector was run on, the only ones in which a detection can be
            missed; None: all.
    """
    names = np.array([*class_names, ""])
    moves = np.isin(names, list(moving))  # (C + 1,), -1: unknown
    fixed = ~moves[rows.class_id.clip(-1, len(class_names))] & np.isin(
        rows.frame, poses.frame[poses.known]
    )
    own = np.flatnonzero(fixed & ~_doubles(rows))
    table, solid, overlap = rows[own], np.full(len(rows), -1), np.full(len(rows), np.nan)
    tracked = table[table.tracklet_id > 0]
    if not len(tracked):
        return Located(solid, overlap, np.empty(0), None, _UNKNOWN)
    fragment = cut_at_gaps(tracked, looked)
    count = int(fragment.max()) + 1
    seen = poses
    if looked is not None:
        unseen = ~np.isin(poses.frame, looked)[:, None, None]
        seen = dataclasses.replace(
            poses, cam_from_world=np.where(unseen, np.nan, poses.cam_from_world)
        )
    views = gather_views(tracked, seen, fragment, count, 0.0)
    classes = class_shares(tracked, fragment, count).argmax(1)
    fits = fit(views, classes.tolist(), Scene(trusts_classes=True))
    kinds = Categories(priors, names, fits.scale)
    floor = floor_under(poses, fits)
    usual, stands = kinds.usual_size(classes), kinds.on_floor(classes)
    proposed = propose(fits, views, classes, usual, floor, stands)
    more = _from_untracked(table, seen, kinds, fits.up, floor)
    proposed = Solids.concatenate([proposed, more])
    detected = _detected(table, poses, views)
    scene = Scene(floor, None, None if poses.metric else fits.scale, trusts_classes=True)
    refit = _refit(detected, views, kinds, scene, fit)
    found = Associator(detected, refit, kinds.size_log_odds).run(proposed, floor is not None)
    solid[own] = found.owner
    owned = np.flatnonzero(found.owner >= 0)
    boxes = _projected(found.solids, views)[detected.view[owned], found.owner[owned]]
    overlap[own[owned]] = quadrics.box_iou(boxes, detected.box[owned])
    solids = Solids.concatenate([found.solids, _NO_SOLID])
    through = seen_through(found.solids.ellipsoids, found.evidence.expected, poses, views.frame)
    sure = _confidence(found, detected, through)
    return Located(solid, overlap, sure, floor, solids.ellipsoids)


def _from_untracked(
    table: Tracks, poses: Poses, kinds: Categories, up: Array, floor: quadrics.Floor | None
) -> Solids:
    """Propose solids along the rays of good detections in no tracklet: photos have many."""
    table = table[(table.tracklet_id == 0) & (table.score >= PROPOSING_SCORE)]
    views = gather_views(table, poses, np.arange(len(table)), len(table), 0.0)
    classes = table.class_id
    usual, stands = kinds.usual_size(classes), kinds.on_floor(classes)
    return propose_along_rays(views, classes, usual, up, floor, stands)


def _doubles(rows: Tracks) -> BoolArray:
    """Mark detections in no tracklet that a better one of their class overlaps: doubles."""
    found = np.zeros(len(rows), bool)
    for own in rows_by(rows.frame):
        own = own[np.lexsort((-rows.score[own], rows.tracklet_id[own] == 0))]  # the best first
        alike = box_iou(rows.xyxy[own], rows.xyxy[own]) > DOUBLE_IOU
        alike &= rows.class_id[own][:, None] == rows.class_id[own]
        for i in range(len(own)):
            if not found[own[i]]:
                found[own[i + 1 :]] |= alike[i, i + 1 :] & (rows.tracklet_id[own[i + 1 :]] == 0)
    return found


def floor_under(poses: Poses, fits: quadrics.ObjectFits) -> quadrics.Floor | None:
    """Find the floor of a part whose scale and gravity the fits tell; None: it is unknown."""
    if fits.scale.source == "none" or not fits.up.any():
        return None
    plane, _ = floor_of(poses, fits.up, fits.scale.value)
    return None if plane is None else quadrics.Floor(plane.normal, plane.offset, plane.sigma)


def confidence(score: Array, share: Array, through: Array | float = 0.0) -> Array:
    """Return the probability that objects are there, each a thing of its own.

    Args:
        score: `log_best_odds` of its detections.
        share: of the frames that should show it and do; NaN where no solid tells which should.
        through: `occlusion.seen_through`.
    """
    constant, of_score, of_share, of_through = CONFIDENCE
    place = constant + of_share * share + of_through * through
    place = np.where(np.isnan(share), NO_SOLID, place)
    return np.asarray(1 / (1 + np.exp(-place - of_score * score)))


def log_best_odds(score: Array, group: IntArray, count: int) -> Array:
    """Return the log of the mean odds (count,) of the best scores (N,) of each group, -inf: none.

    These are its best 30, or best quarter if that is more.
    """
    order = np.lexsort((-score, group))
    size = np.bincount(group, minlength=count)
    rank = np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)
    taken = np.maximum(BEST_DETECTIONS, np.ceil(BEST_SHARE * size)).clip(max=size)
    best = order[rank < np.repeat(taken, size)]
    odds = np.bincount(group[best], np.exp(logit(score[best])), count)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(odds / taken.clip(1)))


def _confidence(found: Association, detected: Detected, through: Array) -> Array:
    """Return the `confidence` (S,) of solids."""
    owned = np.flatnonzero(found.owner >= 0)
    solid, view = found.owner[owned], detected.view[owned]
    expected = found.evidence.expected
    score = log_best_odds(detected.score[owned], solid, len(found.solids))
    shown = np.bincount(solid, expected[view, solid], len(found.solids))
    share = np.where(expected.any(0), shown / expected.sum(0).clip(1), USUAL_SHARE)
    return confidence(score, share, through)


@dataclass(frozen=True, slots=True)
class Categories:
    """What categories say of sizes, in units of the world.

    Attributes:
        names: of the classes, and "" at the end. scale: metres per unit.
    """

    priors: quadrics.Priors
    names: npt.NDArray[np.str_]
    scale: quadrics.Scale

    def rows(self, classes: IntArray) -> IntArray:
        """Return the rows (G,) of classes in the priors, -1 unknown."""
        return self.priors.index(self.names[classes.clip(-1, len(self.names) - 1)].tolist())

    def usual_size(self, classes: IntArray) -> Array:
        """Return width, depth and height (G, 3)."""
        unknown = np.log(quadrics.UNKNOWN_SIZE_M)
        log_size = _or_unknown(self.priors.log_mean, unknown)[self.rows(classes)]
        return np.asarray(np.exp(log_size) / self.scale.value)

    def on_floor(self, classes: IntArray) -> BoolArray:
        """Mark the classes (G,) that stand on the floor."""
        return on_floor(self.priors, self.names[classes.clip(-1, len(self.names) - 1)].tolist())

    def size_log_odds(self, solids: Solids) -> Array:
        """Return the log odds (S,) of the sizes, 0 at the usual size, turned by 90 deg or not."""
        rows = self.rows(solids.class_id)
        sigma = UNKNOWN_LOG if self.scale.source == "none" else self.scale.rel_sigma
        cov = _or_unknown(self.priors.log_cov, UNKNOWN_LOG**2 * np.eye(3))[rows] + sigma**2
        size = np.log(2 * solids.ellipsoids.half_axes)
        off = size[:, [[0, 1, 2], [1, 0, 2]]] - np.log(self.usual_size(solids.class_id))[:, None]
        square = np.einsum("ski,sij,skj->sk", off, np.linalg.inv(cov), off).min(1)  # (S,)
        return np.asarray(-0.5 * np.nan_to_num(square, nan=np.inf).clip(max=SIZE_SIGMAS**2))


def on_floor(priors: quadrics.Priors, names: list[str]) -> BoolArray:
    """Mark the categories (G,) that stand on the floor."""
    return np.asarray(_or_unknown(priors.on_floor, False)[priors.index(names)], bool)


def _or_unknown(column: npt.NDArray[Any], unknown: Any) -> npt.NDArray[Any]:
    """Append a row to a column of the priors: that of categories that are not in them."""
    return np.concatenate([column, np.broadcast_to(unknown, (1, *column.shape[1:]))])


def _detected(table: Tracks, poses: Poses, views: Views) -> Detected:
    """Arrange rows of frames with a pose, by frame."""
    before, after = np.full((2, len(table)), -1)
    order = np.lexsort((table.frame, table.tracklet_id))
    tracklet = table.tracklet_id[order]
    follows = (np.diff(tracklet) == 0) & (tracklet[1:] > 0)
    after[order[:-1][follows]] = order[1:][follows]
    before[order[1:][follows]] = order[:-1][follows]
    return Detected(
        np.searchsorted(views.frame, table.frame),
        undistort_boxes(table.xyxy, poses.camera),
        table.score,
        table.class_id,
        before,
        after,
        views.img_from_world,
        views.image_size,
    )


def _projected(solids: Solids, views: Views) -> Array:
    """Return the boxes (V, S, 4) of solids in the images, NaN where they are not in view."""
    boxes = quadrics.solid_boxes(solids.ellipsoids, list(solids.support), views.img_from_world)
    return quadrics.clip_boxes(boxes, views.image_size)


def _refit(detected: Detected, views: Views, kinds: Categories, scene: Scene, fit: Fit) -> Refit:
    """Make the function that fits solids to some of the detections, each set of them once."""
    found: dict[tuple[bytes, int], Solids] = {}

    def refit(rows: IntArray, solid: IntArray, classes: IntArray, before: Solids | None) -> Solids:
        order = np.lexsort((rows, solid))
        rows, solid = rows[order], solid[order]
        hidden = np.zeros((len(rows), 4), bool)
        if before is not None and scene.floor is not None:
            projected = _projected(before, views)[detected.view[rows], solid]
            hidden = edges_above_floor(detected.box[rows], projected)
            hidden &= kinds.on_floor(classes)[solid, None]
        start = np.searchsorted(solid, np.arange(len(classes) + 1))
        sets = [rows[a:b].tobytes() + hidden[a:b].tobytes() for a, b in itertools.pairwise(start)]
        keys = list(zip(sets, classes.tolist(), strict=True))
        new = [k for k, key in enumerate(keys) if key not in found]
        if new:
            boxes = np.full((len(views.frame), len(new), 4), np.nan)
            score, behind = np.zeros(boxes.shape[:2]), np.zeros(boxes.shape, bool)
            for column, k in enumerate(new):
                part = slice(start[k], start[k + 1])
                at = detected.view[rows[part]], column
                boxes[at], score[at] = detected.box[rows[part]], detected.score[rows[part]]
                behind[at] = hidden[part]
            seen = Views(views.frame, boxes, score, views.img_from_world, views.image_size, behind)
            fits = fit(seen, classes[new].tolist(), scene)
            made = Solids(fits.ellipsoids, fits.support, classes[new])
            found.update((keys[k], made[[column]]) for column, k in enumerate(new))
        return Solids.concatenate([NO_SOLIDS, *(found[key] for key in keys)])

    return refit
