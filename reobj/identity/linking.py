"""From tracklets to objects over the whole video: by appearance, and by place in 3D."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, angle_deg, place_of, undistort_boxes, viewing_rays
from reobj.identity.places import quick_fit, rough_sizes, usual_size
from reobj.identity.reid import SimilarityCalibration, paired_cosine
from reobj.types import (
    Array,
    BoolArray,
    Embeddings,
    IntArray,
    LinkEvent,
    Tracks,
    box_iou,
    class_shares,
    rows_by,
    unit_rows,
)
from reobj.views import Views, gather_views

# Chosen on examples/room and redkitchen (docs/tracking.md), but for those with a source.
LINK_PROBABILITY = 0.5  # join by appearance from this probability on, rivals considered: even odds
VIEW_GAP = (
    30  # frames; views of a fragment this far apart show how the appearance of one object varies
)
DUPLICATE_IOU = 0.5  # boxes that overlap more may be two boxes on one object
MIN_LINK_LOG_ODDS = -4.0  # never join by place what is less alike: 1 in 55
MIN_CLASS_AGREEMENT = 0.1  # join by place only where the class shares agree in so much
SAME_PLACE_IOU = 0.25  # cross-projected overlap from which two places may be one, and are not split
KEEP_IOU = 0.4  # a join is kept if the joint solid overlaps the boxes by this
KEEP_SHARE = 0.6  # in this share of the frames of either part (OA-SLAM: half)
CUT_GAP = 5  # frames without a detection, after which a tracklet may be another object
SPLIT_DROP = (
    0.7  # a return is doubted where the joint solid overlaps less, a share of its own solid
)
LEAST_LOG_ODDS = -9.0  # said in the evidence where nothing speaks for one object
APPEARANCE_SHARE = 0.4  # what certain appearance adds to the overlap (IoU) in the order of joins


def link(
    tracks: Tracks,
    class_names: Sequence[str],
    embeddings: Embeddings,
    embedding_row: IntArray,
    poses: Poses | None = None,
    fit: Callable[[Views, list[int]], quadrics.ObjectFits] | None = None,
    *,
    moving: Collection[str] = (),
    min_score: float = 0.3,
    min_views: int = 3,
) -> tuple[Tracks, list[LinkEvent]]:
    """Decide over the whole video which tracklets are one object.

    Args:
        tracks: rows with the tracker's identities.
        embeddings, embedding_row: fused embeddings of n rows, and which rows (n,) these are.
        poses, fit: None to decide by appearance alone.
        moving: names of the classes that move; they stay as the tracker has them.
        min_score, min_views: boxes and objects below them say nothing about a place.
    Returns:
        the rows with the objects' identities, and every join and split with its evidence.
    """
    if not len(tracks):
        return tracks, []
    linker = Linker(tracks, class_names, poses, fit, moving, min_score, min_views)
    linker.measure_appearance(embeddings, embedding_row)
    return tracks.with_identities(linker.run()), linker.events


class Linker:
    """Join and split the fragments of a video's tracklets.

    Two fragments seen in one frame are never the same object, and classes that move stay as the
    tracker has them: neither their place nor what surrounds them lasts.
    First by appearance: fragments are joined as long as their most similar views show one object
    more likely than any rival (seen beside one of the two) or another object, the most similar
    first. This replaces what the tracker decided when it first saw them.
    Then, with poses, by place: tracklets are cut at gaps (where a tracker slips to a twin) and
    where two solids explain boxes that one does not (where it slips to a neighbour); a join is
    undone where two well-measured places differ; groups that explain each other's boxes are joined,
    refitted and kept only if the joint solid overlaps the boxes of both in most frames (merge,
    re-project, undo: the idea of OA-SLAM).

    Attributes:
        fragment: (N,) fragment of each row, 0 .. L - 1: a tracklet, or a piece of one.
        group: (L,) object of each fragment. log_odds: (L, L) that two look like one object.
        co_occur: (L, L) seen in one frame; distinct: those of them that cannot be duplicates.
        events: joins and splits so far.
    """

    def __init__(
        self,
        tracks: Tracks,
        class_names: Sequence[str],
        poses: Poses | None,
        fit: Callable[[Views, list[int]], quadrics.ObjectFits] | None,
        moving: Collection[str],
        min_score: float,
        min_views: int,
    ) -> None:
        self.tracks, self.poses, self.fit = tracks, poses, fit
        self.min_score, self.min_views = min_score, min_views
        self.located = np.empty(0) if poses is None else poses.frame[poses.known]  # (V,)
        self.fragment = _cut_at_gaps(tracks, CUT_GAP)  # (N,)
        self._describe_fragments(class_names, moving)
        if poses is not None:
            count = len(self.tracklets)
            views = gather_views(tracks, poses, self.fragment, count, min_score)
            self.usual_size = usual_size(rough_sizes(views.boxes, views.img_from_world))
            self._cut()
            self._describe_fragments(class_names, moving)
        self.co_occur, self.distinct = self._co_occurrence()
        self.log_odds = np.full(self.co_occur.shape, -np.inf)
        self.group = np.unique(self.identity, return_inverse=True)[1]  # (L,)
        self.events: list[LinkEvent] = []

    def run(self) -> IntArray:
        """Return the object of every row of the tracks, (N,), any numbering."""
        if np.isfinite(self.log_odds).any():
            self._join_by_appearance()
        if self.poses is not None:
            self._split()
            rejected: set[tuple[int, ...]] = set()
            while self._join_round(rejected):
                pass
        return np.asarray(self.group[self.fragment], np.int64)

    def _describe_fragments(self, class_names: Sequence[str], moving: Collection[str]) -> None:
        """Note tracklet, identity and class of every fragment and whether it moves, (L,) each."""
        first = np.unique(self.fragment, return_index=True)[1]  # (L,)
        self.tracklets = self.tracks.tracklet_id[first]
        self.identity = self.tracks.track_id[first]
        self.classes = class_shares(self.tracks, self.fragment, len(first)).argmax(1)
        names = np.array([*class_names, ""])[self.classes.clip(max=len(class_names))]
        self.moving = np.isin(names, list(moving))

    def _co_occurrence(self) -> tuple[BoolArray, BoolArray]:
        """Find fragments that are seen in the same frame.

        Returns:
            co_occur: (L, L) seen together; distinct: (L, L) those of them whose boxes never overlap
            so much that they could be two boxes on one object.
        """
        count = len(self.tracklets)
        co_occur, overlapping = np.zeros((count, count), bool), np.zeros((count, count), bool)
        for rows in rows_by(self.tracks.frame):
            here, box = self.fragment[rows], self.tracks.xyxy[rows]
            co_occur[here[:, None], here[None]] = True
            overlapping[here[:, None], here[None]] |= box_iou(box, box) > DUPLICATE_IOU
        return co_occur, co_occur & ~overlapping

    def measure_appearance(self, embeddings: Embeddings, embedding_row: IntArray) -> None:
        """Set the log odds that fragments look like one object, -inf: unknown.

        What a similarity means in this video is known without labels: fragments of a class seen
        side by side are different, views of one fragment some time apart the same.
        """
        if not embeddings.foreground.size:
            return
        foreground, background, angle = self._best_views(embeddings, embedding_row)
        calibration = SimilarityCalibration()
        pairs = np.triu(self.distinct & (self.classes[:, None] == self.classes), 1)
        for rows, same in ((pairs, False), (np.eye(len(pairs), dtype=bool), True)):
            calibration.add(foreground[rows], background[rows], same)
        self.log_odds = calibration.logit(foreground, background, angle)

    def _best_views(
        self, embeddings: Embeddings, embedding_row: IntArray
    ) -> tuple[Array, Array, Array]:
        """Compare the most similar views of every two fragments.

        Returns:
            (L, L) cosines of foreground and of background, and degrees between the viewing rays;
            NaN where unknown. Diagonal: of views of one fragment at least VIEW_GAP frames apart.
        """
        parts = np.full((3, len(self.tracklets), len(self.tracklets)), np.nan)
        order = np.argsort(self.fragment[embedding_row], kind="stable")
        rows, width = embedding_row[order], embeddings.foreground.shape[1]
        fused = np.concatenate([embeddings.foreground, embeddings.background], 1)
        unit = unit_rows(fused[order])  # (n, E)
        fragments, starts, block = np.unique(
            self.fragment[rows], return_index=True, return_inverse=True
        )
        ray = self._viewing_rays(rows)
        for fragment, mine in zip(
            fragments, np.split(np.arange(len(rows)), starts[1:]), strict=True
        ):
            cosine = unit[mine] @ unit.T  # (k, n)
            frame = self.tracks.frame[rows[mine]]
            soon = np.abs(frame[:, None] - frame) < VIEW_GAP
            cosine[:, mine] = np.where(soon, -np.inf, cosine[:, mine])
            view = np.lexsort((-cosine.max(0), block))[starts]  # the best of each fragment
            own = mine[cosine[:, view].argmax(0)]
            paired = [paired_cosine(x[own], x[view]) for x in np.split(unit, [width], 1)]
            paired.append(angle_deg(ray[own], ray[view]))
            parts[:, fragment, fragments] = np.where(
                np.isinf(cosine[:, view].max(0)), np.nan, paired
            )
        return parts[0], parts[1], parts[2]

    def _viewing_rays(self, rows: IntArray) -> Array:
        """Return unit vectors (n, 3) in world in which rows were seen, NaN without a pose."""
        if self.poses is None:
            return np.full((len(rows), 3), np.nan)
        place, known = place_of(self.poses, self.tracks.frame[rows])
        camera = self.poses.camera
        cams = np.where(known[:, None, None], self.poses.cam_from_world[place], np.nan)
        return viewing_rays(undistort_boxes(self.tracks.xyxy[rows], camera), camera.K @ cams)

    def _join_by_appearance(self) -> None:
        """Group the tracklets anew by appearance and list what differs from the tracker."""
        keep = np.where(self.moving, -self.identity, self.tracklets)
        whole = np.unique(keep, return_inverse=True)[1]  # (L,) tracklet of each fragment
        shares = class_shares(self.tracks, whole[self.fragment], int(whole.max()) + 1)
        kind = shares.argmax(1)  # (T,)
        kind[whole[self.moving]] = -1 - whole[self.moving]  # a kind of its own
        log_odds = _max_between_groups(self.log_odds, whole)  # (T, T)
        banned = _max_between_groups(self.co_occur, whole) | (kind[:, None] != kind)
        distinct = _max_between_groups(self.distinct, whole)
        found = _agglomerate(log_odds, banned, distinct, LINK_PROBABILITY)
        before, self.group = self.group, found[whole]
        self._list_changes(before, self.group, "join")
        self._list_changes(self.group, before, "split")

    def _list_changes(self, parts: IntArray, whole: IntArray, kind: str) -> None:
        """List an event for each part but the first of the groups of `whole` that hold several."""
        for g in np.unique(whole):
            members = np.flatnonzero(whole == g)
            pieces = [members[parts[members] == part] for part in np.unique(parts[members])]
            for piece in pieces[1:]:
                rest = np.setdiff1d(members, piece)
                log_odds = max(float(self.log_odds[np.ix_(rest, piece)].max()), LEAST_LOG_ODDS)
                ids = np.unique(self.tracklets[members if kind == "join" else piece]).tolist()
                self.events.append(LinkEvent(kind, tuple(ids), None, log_odds, True))

    def _cut(self) -> None:
        """Cut fragments where the tracker slipped to another thing without missing a frame.

        Repeated until no cut helps; `_split` takes back those with both sides in one place.
        """
        todo = np.flatnonzero(~self.moving)
        while len(todo):
            cuts = self._find_cuts(todo)
            fresh = self.fragment.max() + 1 + np.arange(len(cuts))
            for name, (fragment, frame) in zip(fresh, cuts, strict=True):
                self.fragment[(self.fragment == fragment) & (self.tracks.frame >= frame)] = name
            todo = np.concatenate([[fragment for fragment, _ in cuts], fresh]).astype(np.int64)

    def _find_cuts(self, fragments: IntArray) -> list[tuple[int, int]]:
        """Find fragments to cut, and the frame from which on.

        Of 8 cuts the best one counts, if the solid of a half explains its boxes much better than
        that of the whole does, as in `_split`.
        """
        least, frame = 2 * self.min_views, self.tracks.frame
        usable = np.isin(frame, self.located) & (self.tracks.score >= self.min_score)
        rows = [np.flatnonzero(usable & (self.fragment == fragment)) for fragment in fragments]
        tries: list[tuple[int, int, Array]] = []
        for i, joint in enumerate(self._own_iou(rows)):
            span = np.linspace(least, len(joint) - least, 8 * (len(joint) >= 2 * least))
            for at in np.unique(span.round().astype(np.int64)):
                together = np.array([np.median(joint[:at]), np.median(joint[at:])])
                if together.min() < SPLIT_DROP:  # no overlap is above 1
                    tries.append((i, int(at), together))
        halves = [half for i, at, _ in tries for half in (rows[i][:at], rows[i][at:])]
        alone = self._own_iou(halves)
        best: dict[int, tuple[float, int]] = {}
        for (i, at, together), a, b in zip(tries, alone[::2], alone[1::2], strict=True):
            total = float(a.sum() + b.sum())
            worse = together < SPLIT_DROP * np.array([np.median(a), np.median(b)])
            if worse.any() and total > best.get(i, (0.0, 0))[0]:
                best[i] = total, at
        return [(int(fragments[i]), int(frame[rows[i][at]])) for i, (_, at) in best.items()]

    def _own_iou(self, groups: Sequence[IntArray]) -> list[Array]:
        """Fit an ellipsoid of any size to each group of rows: its IoU with each of their boxes."""
        if not groups:
            return []
        assert self.poses is not None
        size = [len(rows) for rows in groups]
        rows, label = np.concatenate(groups), np.repeat(np.arange(len(groups)), size)
        views = gather_views(self.tracks[rows], self.poses, label, len(size), self.min_score)
        seen = (views.boxes, views.img_from_world, views.image_size)
        ellipsoids = quick_fit(*seen, self.usual_size).ellipsoids
        solids = quadrics.solid_boxes(ellipsoids, "ellipsoid", views.img_from_world)
        solids = quadrics.clip_boxes(solids, views.image_size)  # (V, G, 4)
        at = np.searchsorted(self.located, self.tracks.frame[rows])
        return np.split(
            quadrics.box_iou(solids[at, label], views.boxes[at, label]), np.cumsum(size)[:-1]
        )

    def _cross_iou(self, labels: IntArray, count: int) -> tuple[Array, Array]:
        """Fit all groups of fragments and compare each solid with the boxes of every group.

        Args:
            labels: (L,) group of each fragment, 0 .. count - 1.
        Returns:
            place: (G, G) median IoU of solid g in the frames of group h.
            own: (V, G) IoU of each solid with its own boxes.
        """
        assert self.poses is not None and self.fit is not None
        rows = labels[self.fragment]  # (N,)
        views = gather_views(self.tracks, self.poses, rows, count, self.min_score)
        classes = class_shares(self.tracks, rows, count).argmax(1)
        fits = self.fit(views, classes.tolist())
        solids = quadrics.solid_boxes(fits.ellipsoids, list(fits.support), views.img_from_world)
        solids = quadrics.clip_boxes(solids, views.image_size)  # (V, G, 4)
        place = np.zeros((count, count))
        for h in range(count):  # over groups: each is one vectorised comparison
            seen = np.flatnonzero(np.isfinite(views.boxes[:, h, 0]))
            if len(seen):
                iou = quadrics.box_iou(solids[seen], views.boxes[seen, h][:, None])  # (n, G)
                place[:, h] = np.median(iou, 0)
        return place, quadrics.box_iou(solids, views.boxes)

    def _split(self) -> None:
        """Undo returns whose places differ: fragments that their identity's solid does not explain.

        Nothing is split on a poor fit alone: the fragment's own solid must explain its boxes much
        better, and its place must not overlap those that the joint solid does explain.
        """
        count, groups = len(self.tracklets), int(self.group.max()) + 1
        if groups == count:
            return
        place, own = self._cross_iou(np.arange(count), count)
        _, joint = self._cross_iou(self.group, groups)
        alone, together = (
            np.array([self._median_iou(iou[:, g], self.fragment == a) for a, g in enumerate(of)])
            for iou, of in ((own, np.arange(count)), (joint, self.group))
        )  # (L,) each
        worse = together < SPLIT_DROP * alone
        length = np.bincount(self.fragment, minlength=count)
        for g in np.flatnonzero(np.bincount(self.group) > 1):
            members = np.flatnonzero(self.group == g)
            anchors = members[~worse[members]]
            anchors = anchors if len(anchors) else members[[np.argmax(length[members])]]
            for fragment in np.setdiff1d(members[~self.moving[members]], anchors):
                iou = float(max(place[anchors, fragment].max(), place[fragment, anchors].max()))
                if iou < SAME_PLACE_IOU:
                    log_odds = float(self.log_odds[anchors, fragment].max(initial=LEAST_LOG_ODDS))
                    self.group[fragment] = self.group.max() + 1
                    ids = (int(self.tracklets[anchors[0]]), int(self.tracklets[fragment]))
                    self.events.append(LinkEvent("split", ids, iou, log_odds, True))

    def _join_round(self, rejected: set[tuple[int, ...]]) -> bool:
        """Join the best disjoint pairs of groups; returns whether another round could find more."""
        labels, self.group = np.unique(self.group, return_inverse=True)
        count = len(labels)
        place, _ = self._cross_iou(self.group, count)
        pairs = self._candidates(place, count, rejected)
        if not pairs:
            return False
        proposal = np.arange(count)
        for a, b, _, _ in pairs:
            proposal[b] = a
        kept_labels, column = np.unique(proposal, return_inverse=True)
        _, own = self._cross_iou(column[self.group], len(kept_labels))
        for a, b, iou, log_odds in pairs:
            part = self.group[self.fragment]
            kept = all(self._explains(own[:, column[a]], part == side) for side in (a, b))
            ids = tuple(sorted(self.tracklets[(self.group == a) | (self.group == b)].tolist()))
            self.events.append(LinkEvent("join", ids, iou, log_odds, kept))
            rejected.add(ids)
            if kept:
                self.group[self.group == b] = a
        return True

    def _candidates(
        self, place: Array, count: int, rejected: set[tuple[int, ...]]
    ) -> list[tuple[int, int, float, float]]:
        """List disjoint pairs of groups worth a joint fit, best first.

        Returns:
            (a, b, IoU of cross-projection, log odds of their appearance) each.
        """
        share = class_shares(self.tracks, self.group[self.fragment], count)  # (G, C)
        confused = np.minimum(share[:, None], share).sum(-1) >= MIN_CLASS_AGREEMENT  # (G, G)
        log_odds = _max_between_groups(self.log_odds, self.group)  # (G, G)
        log_odds = np.where(np.isfinite(log_odds), log_odds, 0.0)  # unknown: even odds
        score = np.maximum(place, place.T)
        good = confused & (score >= SAME_PLACE_IOU) & (log_odds >= MIN_LINK_LOG_ODDS)
        good &= ~_max_between_groups(self.co_occur, self.group)
        still = ~np.isin(np.arange(count), self.group[self.moving])
        good &= still[:, None] & still
        a, b = np.nonzero(np.triu(good, 1))
        rank = score + APPEARANCE_SHARE / (1 + np.exp(-log_odds))
        pairs: list[tuple[int, int, float, float]] = []
        used: set[int] = set()
        for i in np.argsort(-rank[a, b], kind="stable"):
            pair = (int(a[i]), int(b[i]))
            ids = tuple(sorted(self.tracklets[np.isin(self.group, pair)].tolist()))
            if ids not in rejected and not used & set(pair):
                used |= set(pair)
                pairs.append((*pair, float(score[pair]), float(log_odds[pair])))
        return pairs

    def _explains(self, own_iou: Array, rows: BoolArray) -> bool:
        """Test whether a solid of IoU (V,) with its boxes overlaps those of rows in most frames."""
        iou = own_iou[self._views_of(rows)]
        return bool(len(iou) and np.mean(iou >= KEEP_IOU) >= KEEP_SHARE)

    def _median_iou(self, own_iou: Array, rows: BoolArray) -> float:
        """Return the median IoU of a solid with the boxes of rows; 0 if none has a pose."""
        iou = own_iou[self._views_of(rows)]
        return float(np.median(iou)) if len(iou) else 0.0

    def _views_of(self, rows: BoolArray) -> BoolArray:
        """Mark the frames with a pose (V,) in which one of the rows (N,) is seen."""
        seen = self.tracks.frame[rows & (self.tracks.score >= self.min_score)]
        return np.isin(self.located, seen)


def _max_between_groups(matrix: npt.NDArray[Any], group: IntArray) -> npt.NDArray[Any]:
    """Reduce a matrix (L, L) to the largest entries (G, G) between members of groups (L,)."""
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(group.max(initial=-1) + 1))
    by_row = np.maximum.reduceat(matrix[np.ix_(order, order)], starts, axis=0)
    return np.asarray(np.maximum.reduceat(by_row, starts, axis=1))


def _agglomerate(
    log_odds: Array, banned: BoolArray, distinct: BoolArray, probability: float
) -> IntArray:
    """Join G things while two are probably one, rivals considered, the most similar first.

    Args:
        log_odds: (G, G) that two are one; between groups those of the most similar members count.
        banned: (G, G) which must never be joined. distinct: (G, G) which are surely different, so
            that one rivals the other.
    Returns:
        group of each, (G,).
    """
    odds, banned = np.where(banned, 0, np.exp(log_odds)), banned.copy()
    distinct = distinct.copy()
    np.fill_diagonal(odds, 0)
    np.fill_diagonal(distinct, False)
    least = probability / (1 - probability)  # odds against all rivals and another object
    i, j = np.nonzero(np.triu(odds >= least, 1))
    pairs = np.column_stack([i, j])[np.argsort(-odds[i, j], kind="stable")]
    group, joined = np.arange(len(odds)), True
    while joined:
        joined = False
        for a, b in group[pairs]:
            a, b = group[a], group[b]
            rival = max(odds[a, distinct[b]].max(initial=0), odds[b, distinct[a]].max(initial=0))
            if odds[a, b] < least * (1 + rival):
                continue
            odds[a] = odds[:, a] = np.maximum(odds[a], odds[b])
            banned[a] = banned[:, a] = banned[a] | banned[b]
            distinct[a] = distinct[:, a] = distinct[a] | distinct[b]
            odds[b] = odds[:, b] = odds[a, a] = odds[a, banned[a]] = odds[banned[a], a] = 0
            distinct[b] = distinct[:, b] = distinct[a, a] = False
            group[group == b], joined = a, True
    return np.unique(group, return_inverse=True)[1]


def _cut_at_gaps(tracks: Tracks, most: int) -> IntArray:
    """Cut tracklets where more than `most` frames pass without a detection.

    Returns:
        fragment of each row (N,), numbered from 0.
    """
    order = np.lexsort((tracks.frame, tracks.tracklet_id))
    tracklet, frame = tracks.tracklet_id[order], tracks.frame[order]
    begins = np.append(True, (np.diff(tracklet) != 0) | (np.diff(frame) > most))[: len(order)]
    fragment = np.empty(len(order), np.int64)
    fragment[order] = np.cumsum(begins) - 1
    return fragment
