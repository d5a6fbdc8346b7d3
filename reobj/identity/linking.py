"""From tracklets to objects over the whole video: by embeddings, and by place in 3D."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import Poses, angle_deg, place_of, undistort_boxes, viewing_rays
from reobj.identity.reid import SimilarityCalibration, paired_cosine, quick_fit
from reobj.sources.detection_files import TrackResult
from reobj.types import (
    Array,
    BoolArray,
    IntArray,
    Tracks,
    box_iou,
    class_shares,
    rows_by,
    unit_rows,
)
from reobj.views import Views, gather_views


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """A join or a split of tracklets and its evidence.

    Attributes:
        place_iou: IoU of cross-projection, None where only looks decided.
        look: log odds of the looks that it is one object (`SimilarityCalibration`).
    """

    kind: str
    tracklets: tuple[int, ...]
    place_iou: float | None
    look: float
    kept: bool


LINK_PROBABILITY = 0.5  # join by looks from this on, rivals and others considered
VIEW_GAP = 30  # views of a tracklet this many frames apart show how looks vary
LINK_PRIOR_PAIRS = 10.0  # pairs that the usual looks of one and two are worth
DUPLICATE_IOU = 0.5  # boxes that overlap more may be two boxes on one object (IoU)
MIN_LINK_LOG_ODDS = -4.0  # never join by place what looks less alike (log odds)
LINK_CLASS = 0.1  # join by place only where the classes agree in this share
# one place from this overlap cross-projected on (IoU): may be joined, is not split
LINK_PLACE = 0.25
KEEP_IOU = 0.4  # a join is kept if the joint solid overlaps the boxes so (IoU)
KEEP_SHARE = 0.6  # in this share of the frames of either part (OA-SLAM: half)
CUT_GAP = 5  # tracklets may be split where this many frames pass without a detection
SPLIT_DROP = 0.7  # a return is doubted if its joint solid overlaps less, a share


class Linker:
    """Decide over the whole video which tracklets are one object.

    Two tracklets seen in one frame are never the same object, and classes that move stay as the
    tracker has them: neither their place nor what surrounds them lasts.
    First by looks: tracklets are joined as long as their most alike views show one object more
    likely than any rival (seen beside one of the two) or another object, the most alike first. This
    replaces what the tracker decided at first sight.
    Then, with poses, by place: tracklets are cut at gaps (where a tracker slips to a twin) and
    where two solids explain boxes that one does not (where it slips to a neighbour); a join is
    undone where two well-measured places differ; groups that explain each other's boxes are joined,
    refitted and kept only if the joint solid overlaps the boxes of both in most frames (merge,
    re-project, undo: the idea of OA-SLAM).

    Args:
        track: rows with the tracker's identities, and their looks.
        poses, fit: None for looks alone.
    """

    def __init__(
        self,
        track: TrackResult,
        poses: Poses | None,
        fit: Callable[[Views, list[int]], Any] | None,
        moving: Collection[str],
        min_score: float,
        min_views: int,
    ) -> None:
        table = track.table
        self.table, self.poses, self.fit = table, poses, fit
        self.moving_classes, self.min_score, self.min_views = moving, min_score, min_views
        self.located = np.empty(0) if poses is None else poses.frame[poses.known]  # (V,)
        self.atom = _segments_of(table, CUT_GAP)  # (N,)
        self._describe(track.class_names)
        if poses is not None:
            self._cut()
            self._describe(track.class_names)
        self.together, self.apart = self._seen_together()
        self.near = self._nearness(*self._most_alike(track))
        self.group = np.unique(self.identity, return_inverse=True)[1]  # (L,)
        self.events: list[LinkEvent] = []

    def run(self) -> IntArray:
        """Return the object of every row of the table, (N,), any numbering."""
        if np.isfinite(self.near).any():
            self._join_looks()
        if self.poses is not None:
            self._split()
            rejected: set[tuple[int, ...]] = set()
            while self._join_round(rejected):
                pass
        return np.asarray(self.group[self.atom], np.int64)

    def _describe(self, class_names: Sequence[str]) -> None:
        """What the atoms are: tracklet, identity, class, whether that moves, (L,) each."""
        first = np.unique(self.atom, return_index=True)[1]  # (L,)
        self.tracklets = self.table.tracklet_id[first]
        self.identity = self.table.track_id[first]
        self.classes = class_shares(self.table, self.atom, len(first)).argmax(1)
        names = np.array([*class_names, ""])[self.classes.clip(max=len(class_names))]
        self.moving = np.isin(names, list(self.moving_classes))  # as the tracker has them

    def _seen_together(self) -> tuple[BoolArray, BoolArray]:
        """(L, L): atoms seen in the same frame; those of them that are never so close that they
        could be two boxes on one object.
        """
        count = len(self.tracklets)
        together, double = np.zeros((count, count), bool), np.zeros((count, count), bool)
        for rows in rows_by(self.table.frame):
            here, box = self.atom[rows], self.table.xyxy[rows]
            together[here[:, None], here[None]] = True
            double[here[:, None], here[None]] |= box_iou(box, box) > DUPLICATE_IOU
        return together, together & ~double

    def _most_alike(self, track: TrackResult) -> Array:
        """(3, L, L) cosines of foreground and background of the most alike views of two atoms, and
        the degrees between their directions; NaN where unknown. Diagonal: of views of one atom at
        least look_gap frames apart.
        """
        parts = np.full((3, len(self.tracklets), len(self.tracklets)), np.nan)
        if not track.look.size:
            return parts
        order = np.argsort(self.atom[track.look_row], kind="stable")
        rows, unit = track.look_row[order], unit_rows(track.look[order])
        atoms, starts, block = np.unique(self.atom[rows], return_index=True, return_inverse=True)
        split, sight = track.split or unit.shape[1], self._sight(rows)
        for atom, mine in zip(atoms, np.split(np.arange(len(rows)), starts[1:]), strict=True):
            cosine = unit[mine] @ unit.T  # (k, n)
            frame = self.table.frame[rows[mine]]
            soon = np.abs(frame[:, None] - frame) < VIEW_GAP
            cosine[:, mine] = np.where(soon, -np.inf, cosine[:, mine])
            view = np.lexsort((-cosine.max(0), block))[starts]  # (atoms,) the best of each
            own = mine[cosine[:, view].argmax(0)]
            paired = [paired_cosine(x[own], x[view]) for x in np.split(unit, [split], 1)]
            paired.append(angle_deg(sight[own], sight[view]))
            parts[:, atom, atoms] = np.where(np.isinf(cosine[:, view].max(0)), np.nan, paired)
        return parts

    def _sight(self, rows: IntArray) -> Array:
        """Directions (n, 3) in which rows of the table were seen, NaN without a pose."""
        if self.poses is None:
            return np.full((len(rows), 3), np.nan)
        place, known = place_of(self.poses, self.table.frame[rows])
        camera = self.poses.camera
        cams = np.where(known[:, None, None], self.poses.cam_from_world[place], np.nan)
        return viewing_rays(undistort_boxes(self.table.xyxy[rows], camera), camera.K @ cams)

    def _nearness(self, foreground: Array, background: Array, angle: Array) -> Array:
        """(L, L) log odds that atoms look like one object, NaN: unknown.

        What that means in this video is known without labels: atoms of a class seen side by side
        are different, views of one atom some time apart the same.
        """
        same = SimilarityCalibration(LINK_PRIOR_PAIRS)
        pairs = np.triu(self.apart & (self.classes[:, None] == self.classes), 1)
        for rows, one in ((pairs, False), (np.eye(len(pairs), dtype=bool), True)):
            same.add(foreground[rows], background[rows], one)
        return np.where(np.isnan(foreground), np.nan, same.logit(foreground, background, angle))

    def _join_looks(self) -> None:
        """Group the tracklets anew by their looks and list what differs from the tracker."""
        keep = np.where(self.moving, -self.identity, self.tracklets)
        whole = np.unique(keep, return_inverse=True)[1]  # (L,) tracklet of each atom
        kind = class_shares(self.table, whole[self.atom], int(whole.max()) + 1).argmax(1)  # (T,)
        kind[whole[self.moving]] = -1 - whole[self.moving]  # a kind of its own
        near = _grouped_max(np.nan_to_num(self.near, nan=-np.inf), whole)  # (T, T)
        banned, apart = (_grouped_max(x, whole) for x in (self.together, self.apart))
        banned |= kind[:, None] != kind
        found = _most_alike_first(near, banned, apart, LINK_PROBABILITY)
        before, self.group = self.group, found[whole]
        self._list_changes(before, self.group, "join")
        self._list_changes(self.group, before, "split")

    def _list_changes(self, parts: IntArray, whole: IntArray, kind: str) -> None:
        """Events for the groups of `whole` that hold several groups of `parts`."""
        for g in np.unique(whole):
            atoms = np.flatnonzero(whole == g)
            pieces = [atoms[parts[atoms] == part] for part in np.unique(parts[atoms])]
            for piece in pieces[1:]:
                rest = np.setdiff1d(atoms, piece)
                look = np.nan_to_num(self.near[np.ix_(rest, piece)], nan=-np.inf).max()
                ids = tuple(np.unique(self.tracklets[atoms if kind == "join" else piece]).tolist())
                self.events.append(LinkEvent(kind, ids, None, float(max(look, -9.0)), True))

    def _cut(self) -> None:
        """Cut atoms where the tracker slipped to another thing without missing a frame, until no
        cut helps. `_split` takes back those with both sides in one place.
        """
        todo = np.flatnonzero(~self.moving)
        while len(todo):
            cuts = self._cuts(todo)
            fresh = self.atom.max() + 1 + np.arange(len(cuts))
            for name, (atom, frame) in zip(fresh, cuts, strict=True):
                self.atom[(self.atom == atom) & (self.table.frame >= frame)] = name
            todo = np.concatenate([[atom for atom, _ in cuts], fresh]).astype(np.int64)

    def _cuts(self, atoms: IntArray) -> list[tuple[int, int]]:
        """Atoms to cut, and the frame from which on: the best of 8 cuts, if the solid of a half
        explains its boxes much better than that of the whole does, as in `_split`.
        """
        least, drop, frame = 2 * self.min_views, SPLIT_DROP, self.table.frame
        usable = np.isin(frame, self.located) & (self.table.score >= self.min_score)
        rows = [np.flatnonzero(usable & (self.atom == atom)) for atom in atoms]
        tries: list[tuple[int, int, Array]] = []
        for i, joint in enumerate(self._own_iou(rows)):
            span = np.linspace(least, len(joint) - least, 8 * (len(joint) >= 2 * least))
            for at in np.unique(span.round().astype(np.int64)):
                together = np.array([np.median(joint[:at]), np.median(joint[at:])])
                if together.min() < drop:  # no overlap is above 1
                    tries.append((i, int(at), together))
        halves = [half for i, at, _ in tries for half in (rows[i][:at], rows[i][at:])]
        alone = self._own_iou(halves)
        best: dict[int, tuple[float, int]] = {}
        for (i, at, together), a, b in zip(tries, alone[::2], alone[1::2], strict=True):
            total = float(a.sum() + b.sum())
            worse = together < drop * np.array([np.median(a), np.median(b)])
            if worse.any() and total > best.get(i, (0.0, 0))[0]:
                best[i] = total, at
        return [(int(atoms[i]), int(frame[rows[i][at]])) for i, (_, at) in best.items()]

    def _own_iou(self, groups: Sequence[IntArray]) -> list[Array]:
        """How well one ellipsoid of any size explains the boxes of each group of rows (IoU)."""
        if not groups:
            return []
        assert self.poses is not None
        size = [len(rows) for rows in groups]
        rows, label = np.concatenate(groups), np.repeat(np.arange(len(groups)), size)
        views = gather_views(self.table[rows], self.poses, label, len(size), self.min_score)
        ellipsoids = quick_fit(views.boxes, views.img_from_world, views.image_size).ellipsoids
        solids = quadrics.solid_boxes(ellipsoids, "ellipsoid", views.img_from_world)
        solids = quadrics.clip_boxes(solids, views.image_size)  # (V, G, 4)
        at = np.searchsorted(self.located, self.table.frame[rows])
        return np.split(
            quadrics.box_iou(solids[at, label], views.boxes[at, label]), np.cumsum(size)[:-1]
        )

    def _cross_iou(self, labels: IntArray, count: int) -> tuple[Array, Array]:
        """Fit all groups of atoms; how well does each solid explain the boxes of each other group?

        Returns:
            place: (G, G) median IoU of solid g in the frames of group h.
            own: (V, G) IoU of each solid with its own boxes.
        """
        assert self.poses is not None and self.fit is not None
        rows = labels[self.atom]  # (N,)
        views = gather_views(self.table, self.poses, rows, count, self.min_score)
        classes = class_shares(self.table, rows, count).argmax(1)
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
        """Undo returns whose places differ: tracklets that their identity's solid does not explain.

        Nothing is split on a poor fit alone: the tracklet's own solid must explain its boxes much
        better, and its place must not overlap those that the joint solid does explain.
        """
        count, groups = len(self.tracklets), int(self.group.max()) + 1
        if groups == count:
            return
        place, own = self._cross_iou(np.arange(count), count)
        _, joint = self._cross_iou(self.group, groups)
        alone, together = (
            np.array([self._median_iou(iou[:, g], self.atom == a) for a, g in enumerate(column)])
            for iou, column in ((own, np.arange(count)), (joint, self.group))
        )  # (L,) each
        worse = together < SPLIT_DROP * alone
        length = np.bincount(self.atom, minlength=count)
        for g in np.flatnonzero(np.bincount(self.group) > 1):
            members = np.flatnonzero(self.group == g)
            anchors = members[~worse[members]]
            anchors = anchors if len(anchors) else members[[np.argmax(length[members])]]
            for atom in np.setdiff1d(members[~self.moving[members]], anchors):
                iou = float(max(place[anchors, atom].max(), place[atom, anchors].max()))
                look = float(np.nan_to_num(self.near[anchors, atom], nan=-np.inf).max(initial=-9))
                if iou < LINK_PLACE:
                    self.group[atom] = self.group.max() + 1
                    ids = (int(self.tracklets[anchors[0]]), int(self.tracklets[atom]))
                    self.events.append(LinkEvent("split", ids, iou, look, True))

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
        for a, b, iou, look in pairs:
            kept = self._verify(own[:, column[a]], a, b)
            ids = tuple(sorted(self.tracklets[(self.group == a) | (self.group == b)].tolist()))
            self.events.append(LinkEvent("join", ids, iou, look, kept))
            rejected.add(ids)
            if kept:
                self.group[self.group == b] = a
        return True

    def _candidates(
        self, place: Array, count: int, rejected: set[tuple[int, ...]]
    ) -> list[tuple[int, int, float, float]]:
        """Disjoint pairs of groups worth a joint fit: (a, b, cross IoU, look), best first."""
        apart = _grouped_max(self.together, self.group)  # (G, G) cannot be one
        share = class_shares(self.table, self.group[self.atom], count)  # (G, C)
        confused = np.minimum(share[:, None], share).sum(-1) >= LINK_CLASS  # (G, G)
        look = _grouped_max(np.nan_to_num(self.near, nan=-np.inf), self.group)  # (G, G)
        look = np.where(np.isfinite(look), look, 0.0)  # nothing known speaks for nothing
        score = np.maximum(place, place.T)
        good = ~apart & confused & (score >= LINK_PLACE)
        good &= look >= MIN_LINK_LOG_ODDS
        still = ~np.isin(np.arange(count), self.group[self.moving])
        good &= still[:, None] & still
        a, b = np.nonzero(np.triu(good, 1))
        pairs: list[tuple[int, int, float, float]] = []
        used: set[int] = set()
        likely = 0.4 / (1 + np.exp(-look))
        for i in np.argsort(-(score + likely)[a, b], kind="stable"):
            pair = (int(a[i]), int(b[i]))
            ids = tuple(sorted(self.tracklets[np.isin(self.group, pair)].tolist()))
            if ids not in rejected and not used & set(pair):
                used |= set(pair)
                pairs.append((*pair, float(score[pair]), float(look[pair])))
        return pairs

    def _verify(self, own_iou: Array, a: int, b: int) -> bool:
        """Does the joint solid explain the boxes of both parts?"""
        part = self.group[self.atom]
        return self._explains(own_iou, part == a) and self._explains(own_iou, part == b)

    def _explains(self, own_iou: Array, rows: BoolArray) -> bool:
        """Does a solid overlap the boxes of these rows in most of their frames? own_iou: (V,)."""
        iou = own_iou[self._views_of(rows)]
        return bool(len(iou) and np.mean(iou >= KEEP_IOU) >= KEEP_SHARE)

    def _median_iou(self, own_iou: Array, rows: BoolArray) -> float:
        """Median overlap of a solid with the boxes of these rows; 0 if none has a pose."""
        iou = own_iou[self._views_of(rows)]
        return float(np.median(iou)) if len(iou) else 0.0

    def _views_of(self, rows: BoolArray) -> BoolArray:
        """(V,) frames with a pose in which one of the rows is seen."""
        seen = self.table.frame[rows & (self.table.score >= self.min_score)]
        return np.isin(self.located, seen)


def _grouped_max(matrix: npt.NDArray[Any], group: IntArray) -> npt.NDArray[Any]:
    """(G, G) largest entry of a matrix (L, L) between the members of two groups, (L,) from 0."""
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(group.max(initial=-1) + 1))
    by_row = np.maximum.reduceat(matrix[np.ix_(order, order)], starts, axis=0)
    return np.asarray(np.maximum.reduceat(by_row, starts, axis=1))


def _most_alike_first(
    near: Array, banned: BoolArray, apart: BoolArray, probability: float
) -> IntArray:
    """Join G things as long as two are probably one, rivals considered, the most alike first.

    Args:
        near: (G, G) log odds; banned: which must never be joined; apart: which are surely
            different, so that one rivals the other. Between groups the most alike members count.
    Returns:
        group of each, (G,).
    """
    odds, banned, apart = np.where(banned, 0, np.exp(near)), banned.copy(), apart.copy()
    np.fill_diagonal(odds, 0)
    np.fill_diagonal(apart, False)
    least = probability / (1 - probability)  # odds against all rivals and another object
    i, j = np.nonzero(np.triu(odds >= least, 1))
    pairs = np.column_stack([i, j])[np.argsort(-odds[i, j], kind="stable")]
    group, joined = np.arange(len(odds)), True
    while joined:
        joined = False
        for a, b in group[pairs]:
            a, b = group[a], group[b]
            rival = max(odds[a, apart[b]].max(initial=0), odds[b, apart[a]].max(initial=0))
            if odds[a, b] < least * (1 + rival):
                continue
            odds[a] = odds[:, a] = np.maximum(odds[a], odds[b])
            banned[a] = banned[:, a] = banned[a] | banned[b]
            apart[a] = apart[:, a] = apart[a] | apart[b]
            odds[b] = odds[:, b] = odds[a, a] = odds[a, banned[a]] = odds[banned[a], a] = 0
            apart[b] = apart[:, b] = apart[a, a] = False
            group[group == b], joined = a, True
    return np.unique(group, return_inverse=True)[1]


def _segments_of(table: Tracks, cut_gap: int) -> IntArray:
    """Cut tracklets where more than cut_gap frames pass without a detection.

    Returns:
        segment of each row (N,), numbered from 0.
    """
    order = np.lexsort((table.frame, table.tracklet_id))
    tracklet, frame = table.tracklet_id[order], table.frame[order]
    begins = np.append(True, (np.diff(tracklet) != 0) | (np.diff(frame) > cut_gap))[: len(order)]
    segment = np.empty(len(order), np.int64)
    segment[order] = np.cumsum(begins) - 1
    return segment
