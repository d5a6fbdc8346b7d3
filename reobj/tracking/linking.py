"""Link tracklets to identities over the whole video: by 3D object if known, else by appearance."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.appearance.reid import SimilarityCalibration, paired_cosine
from reobj.cameras import Poses, angle_deg, place_of, undistort_boxes, viewing_rays
from reobj.types import (
    Array,
    BoolArray,
    Embeddings,
    IntArray,
    LinkEvent,
    Tracks,
    box_iou,
    class_shares,
    looks,
    nearest_of,
    rows_by,
    unit_rows,
)
from reobj.words import among

# Chosen on examples/room and redkitchen (benchmarks/RESULTS.md).
# frames between views of a fragment that show how the appearance of one object varies (lower:
# nearly equal views, which are more alike than those of an object that was out of view)
VIEW_GAP = 30
AT_ONCE = 256  # fragments, and views of a fragment, that are compared together: bounds the memory


class FragmentAppearance:
    """Embeddings of the L fragments of a video, and the log odds that two look like one object.

    The similarity is calibrated on this video without labels: fragments of a class seen side by
    side are different objects, views of one fragment some time apart are the same.

    Args:
        tracks: N rows. fragment: (N,) of each row, 0 .. L - 1.
        embeddings, embedding_row: fused embeddings of n rows, and the numbers (n,) of those rows.
        poses: cameras, or None.
    """

    def __init__(
        self,
        tracks: Tracks,
        fragment: IntArray,
        embeddings: Embeddings,
        embedding_row: IntArray,
        poses: Poses | None,
    ) -> None:
        order = np.argsort(fragment[embedding_row], kind="stable")
        rows = embedding_row[order]
        fused = np.concatenate([embeddings.foreground, embeddings.background], 1)
        self._unit = unit_rows(fused[order])  # (n, E)
        self._width = embeddings.foreground.shape[1]
        self._frame = tracks.frame[rows]
        self._ray = _viewing_rays(tracks[rows], poses)
        count = int(fragment.max(initial=-1)) + 1
        self._start = np.searchsorted(fragment[rows], np.arange(count + 1))  # (L + 1,)
        self._calibration = SimilarityCalibration()

    @property
    def comparable(self) -> bool:
        """Whether two fragments or more have a foreground embedding."""
        seen = np.flatnonzero((self._unit[:, : self._width] != 0).any(1))
        return len(np.unique(np.searchsorted(self._start, seen, "right"))) > 1

    def calibrate(self, classes: IntArray, distinct: BoolArray) -> None:
        """Calibrate by pairs of fragments of one class.

        Args:
            classes: (L,). distinct: (L, L) those that are certainly different objects.
        """
        own = np.full((2, len(classes)), np.nan)  # foreground, background
        numbers = [np.empty((2, 0), np.int64)]
        cosines = [np.empty((2, 0))]
        for members in rows_by(classes):
            for part in np.array_split(members, len(members) // AT_ONCE + 1):
                similarity = self._best_views(part, members)
                same = part[:, None] == members
                own[:, part] = similarity[:2, same]
                i, j = np.nonzero(distinct[np.ix_(part, members)] & (part[:, None] < members))
                numbers.append(np.stack([part[i], members[j]]))
                cosines.append(similarity[:2, i, j])
        order = np.lexsort(np.concatenate(numbers, 1)[::-1])
        foreground, background = np.concatenate(cosines, 1)[:, order]
        self._calibration.add(foreground, background, False)
        self._calibration.add(own[0], own[1], True)

    def log_odds(self, a: IntArray, b: IntArray) -> Array:
        """Return the log odds (A, B) that fragments look like one object, -inf: unknown."""
        odds = np.empty((len(a), len(b)))
        for part in np.array_split(np.arange(len(a)), len(a) // AT_ONCE + 1):
            odds[part] = self._calibration.logit(*self._best_views(a[part], b))
        return odds

    def _best_views(self, a: IntArray, b: IntArray) -> Array:
        """Compare the most similar views of every two fragments of a and b.

        Returns:
            (3, A, B) cosines of foreground and of background, and degrees between the viewing
            rays; NaN where unknown. Of one fragment with itself: of views at least VIEW_GAP frames
            apart.
        """
        similarity = np.full((3, len(a), len(b)), np.nan)
        size = np.diff(self._start)
        columns = np.flatnonzero(size[b] > 0)  # numbers in b
        if not len(columns):
            return similarity
        views = np.concatenate([np.arange(*self._start[k : k + 2]) for k in b[columns]])  # (m,)
        block = np.repeat(np.arange(len(columns)), size[b[columns]])  # (m,)
        starts = np.searchsorted(block, np.arange(len(columns)))
        unit = self._unit[views]
        for k in np.flatnonzero(size[a] > 0):
            members = np.arange(*self._start[a[k] : a[k] + 2])
            cosine, member = self._most_similar(members, views, unit)
            best = np.maximum.reduceat(cosine, starts)  # of each fragment of b
            equal = np.flatnonzero(cosine == best[block])
            column = equal[np.searchsorted(block[equal], np.arange(len(starts)))]
            member = member[column]
            view = views[column]
            halves = ((x[member], x[view]) for x in np.split(self._unit, [self._width], 1))
            paired = [paired_cosine(*half) for half in halves]
            paired.append(angle_deg(self._ray[member], self._ray[view]))
            similarity[:, k, columns] = np.where(np.isinf(best), np.nan, paired)
        return similarity

    def _most_similar(
        self, members: IntArray, views: IntArray, unit: Array
    ) -> tuple[Array, IntArray]:
        """Find the most similar view of a fragment for each of m views.

        Args:
            members: (k,) of the fragment, which are not compared with each other if they are fewer
                than VIEW_GAP frames apart. unit: (m, E) embeddings of the views.
        Returns:
            cosines (m,), -inf: none can be compared; members (m,).
        """
        best = np.full(len(views), -np.inf)
        found = np.full(len(views), members[0])
        own = np.flatnonzero((views >= members[0]) & (views <= members[-1]))
        for part in np.array_split(members, len(members) // AT_ONCE + 1):
            cosine = self._unit[part] @ unit.T
            soon = np.abs(self._frame[part, None] - self._frame[views[own]]) < VIEW_GAP
            cosine[:, own] = np.where(soon, -np.inf, cosine[:, own])
            row = cosine.argmax(0)
            highest = cosine[row, np.arange(len(views))]
            found = np.where(highest > best, part[row], found)
            best = np.maximum(best, highest)
        return best, found


def _viewing_rays(tracks: Tracks, poses: Poses | None) -> Array:
    """Return viewing directions (n, 3) of rows, unit vectors in world, NaN without a pose."""
    if poses is None:
        return np.full((len(tracks), 3), np.nan)
    pose_row, known = place_of(poses, tracks.frame)
    cams = np.where(known[:, None, None], poses.cam_from_world[pose_row], np.nan)
    return viewing_rays(undistort_boxes(tracks.xyxy, poses.camera), poses.camera.K @ cams)


# ---- Linking -------------------------------------------------------------------------------------


# Chosen on examples/room and redkitchen (benchmarks/RESULTS.md) unless a source is given.
DUPLICATE_IOU = 0.6  # boxes that overlap more may be two boxes of one object (NMS: .5 to .7)
FRAGMENT_GAP = 5  # frames without a detection after which a tracklet may be another object


def link(
    tracks: Tracks,
    class_names: Sequence[str],
    embeddings: Embeddings,
    embedding_row: IntArray,
    poses: Poses | None = None,
    *,
    moving: Collection[str] = (),
    label: IntArray | None = None,
    iou: Array | None = None,
    looked: IntArray | None = None,
) -> tuple[Tracks, list[LinkEvent]]:
    """Decide over the whole video which tracklets belong to one object.

    Args:
        tracks: rows with the tracker's identities.
        embeddings, embedding_row: fused embeddings of n rows, and the numbers (n,) of those rows.
        poses: cameras; the angle between two views weighs their similarity.
        moving: names of the classes that move; they keep the tracker's identities.
        label, iou: (N,) 3D object that each row is assigned to, or -1 (`associate_component`), and
            the IoU of its projection with the box. None: appearance decides.
        looked: frames that the detector was run on; None: all that were read.
    Returns:
        the rows with the objects' identities, and every join and split with its evidence.
    """
    if not len(tracks):
        return tracks, []
    linker = Linker(tracks, class_names, poses, moving, looked)
    linker.measure_appearance(embeddings, embedding_row)
    identity = linker.by_appearance()
    if label is not None:
        label = propagate_labels(tracks, label, linker.fragment)
        identity = np.where(label >= 0, label, identity + label.max(initial=-1) + 1)
    return tracks.with_identities(identity), linker.changes(identity, iou)


def propagate_labels(tracks: Tracks, label: IntArray, fragment: IntArray) -> IntArray:
    """Propagate object labels (N,) to unlabelled rows (-1) of the same fragment (N,).

    The label is that of the nearest row in time, unless that frame already has this object.
    """
    label = label.copy()
    taken = set(zip(tracks.frame[label >= 0].tolist(), label[label >= 0].tolist(), strict=True))
    for rows in rows_by(fragment):
        labelled = rows[label[rows] >= 0]
        unlabelled = rows[label[rows] < 0]
        if len(labelled) and len(unlabelled):
            near = nearest_of(tracks.frame[unlabelled], tracks.frame[labelled])
            nearest = label[labelled[near]]
            for row, name in zip(unlabelled.tolist(), nearest.tolist(), strict=True):
                if (key := (int(tracks.frame[row]), name)) not in taken:
                    label[row] = name
                    taken.add(key)
    return label


class Linker:
    """Join and split the fragments of a video's tracklets by appearance.

    Two fragments seen in one frame are never the same object. Classes that move keep the tracker's
    identities: their background changes. Fragments are joined, the most similar first, while their
    most similar views are more probably one object than any rival (seen beside one of the two) or
    another object. This replaces the tracker's online decisions.

    Attributes:
        fragment: (N,) fragment of each row, 0 .. L - 1: a tracklet, or a piece of one.
        appearance: of the fragments, None: unknown.
        co_occur: (L, L) seen in one frame. distinct: (L, L) those that cannot be duplicates.
    """

    def __init__(
        self,
        tracks: Tracks,
        class_names: Sequence[str],
        poses: Poses | None,
        moving: Collection[str],
        looked: IntArray | None = None,
    ) -> None:
        self.tracks = tracks
        self.poses = poses
        self.fragment = cut_at_gaps(tracks, looked)  # (N,)
        self._describe_fragments(class_names, moving)
        self.co_occur, self.distinct = self._co_occurrence()
        self.appearance: FragmentAppearance | None = None

    def _describe_fragments(self, class_names: Sequence[str], moving: Collection[str]) -> None:
        """Set tracklet, identity and class of every fragment, and whether it moves, (L,) each."""
        first = np.unique(self.fragment, return_index=True)[1]  # (L,)
        self.tracklets = self.tracks.tracklet_id[first]
        self.identity = self.tracks.track_id[first]
        self.classes = class_shares(self.tracks, self.fragment, len(first)).argmax(1)
        moves = among([*class_names, ""], moving)  # (C + 1,), the last: unknown
        self.moving = moves[self.classes.clip(max=len(class_names))]

    def _co_occurrence(self) -> tuple[BoolArray, BoolArray]:
        """Find fragments that are seen in the same frame.

        Returns:
            co_occur: (L, L) seen together. distinct: (L, L) those of them whose boxes never overlap
            enough to be duplicates on one object.
        """
        count = len(self.tracklets)
        co_occur = np.zeros((count, count), bool)
        overlapping = np.zeros((count, count), bool)
        for rows in rows_by(self.tracks.frame):
            here = self.fragment[rows]
            box = self.tracks.xyxy[rows]
            co_occur[here[:, None], here[None]] = True
            overlapping[here[:, None], here[None]] |= box_iou(box, box) > DUPLICATE_IOU
        return co_occur, co_occur & ~overlapping

    def measure_appearance(self, embeddings: Embeddings, embedding_row: IntArray) -> None:
        """Compare fragments by embeddings of n rows, whose numbers are (n,)."""
        if embeddings.foreground.size:
            fragments = (self.tracks, self.fragment)
            found = FragmentAppearance(*fragments, embeddings, embedding_row, self.poses)
            if found.comparable:
                found.calibrate(self.classes, self.distinct)
                self.appearance = found

    def by_appearance(self, probability: float = 0.5) -> IntArray:
        """Return the identity (N,) of every row of the tracks, in any numbering.

        Args:
            probability: least probability, given the rivals, to join two fragments: even odds.
        """
        group = np.unique(self.identity, return_inverse=True)[1]  # (L,)
        if self.appearance is not None:
            keep = np.where(self.moving, -self.identity, self.tracklets)
            whole = np.unique(keep, return_inverse=True)[1]  # (L,) tracklet of each fragment
            shares = class_shares(self.tracks, whole[self.fragment], int(whole.max()) + 1)
            kind = shares.argmax(1)  # (T,)
            kind[whole[self.moving]] = -1 - whole[self.moving]  # unique: never joined
            joined = np.zeros(len(kind), np.int64)  # (T,)
            for tracklets in rows_by(kind):  # others are never joined
                members = np.flatnonzero(np.isin(whole, tracklets))
                of_kind = np.searchsorted(tracklets, whole[members])
                square = np.ix_(members, members)
                log_odds = self.appearance.log_odds(members, members)
                log_odds, banned, distinct = (
                    _max_between_groups(matrix, of_kind)
                    for matrix in (log_odds, self.co_occur[square], self.distinct[square])
                )
                found = _agglomerate(log_odds, banned, distinct, probability)
                joined[tracklets] = joined.max() + 1 + found
            group = joined[whole]
        return np.asarray(group[self.fragment], np.int64)

    def changes(self, identity: IntArray, iou: Array | None) -> list[LinkEvent]:
        """List the differences from the tracker's identities, with the evidence.

        Args:
            identity: (N,) of each row. iou: (N,) of its box with its projected object, NaN: none.
        """
        before = self.tracks.track_id
        iou = np.full(len(identity), np.nan) if iou is None else iou
        joins = self._changes(before, identity, "join", iou)
        return joins + self._changes(identity, before, "split", iou)

    def _changes(self, pieces: IntArray, whole: IntArray, kind: str, iou: Array) -> list[LinkEvent]:
        """List an event for each piece (N,) but the first of the groups of `whole` (N,).

        Changes of fewer than three detections are not reported: they are noise. Log odds are at
        least -9, also where appearance is unknown or excludes one object.
        """
        events = []
        for rows in rows_by(whole):
            long = [rows[piece] for piece in rows_by(pieces[rows]) if len(piece) >= 3]
            for piece in long[1:]:
                rest = np.unique(self.fragment[np.setdiff1d(rows, piece)])
                fragment = np.unique(self.fragment[piece])
                log_odds = -9.0
                if self.appearance is not None:
                    log_odds = float(self.appearance.log_odds(rest, fragment).max(initial=-9.0))
                ids = np.unique(self.tracks.tracklet_id[rows if kind == "join" else piece]).tolist()
                finite = iou[piece][np.isfinite(iou[piece])]
                median_iou = float(np.median(finite)) if len(finite) else None
                events.append(LinkEvent(kind, tuple(ids), median_iou, log_odds, True))
        return events


def _max_between_groups(matrix: npt.NDArray[Any], group: IntArray) -> npt.NDArray[Any]:
    """Reduce a matrix (L, L) to the largest entries (G, G) between members of groups (L,)."""
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(group.max(initial=-1) + 1))
    by_row = np.maximum.reduceat(matrix[np.ix_(order, order)], starts, axis=0)
    return np.asarray(np.maximum.reduceat(by_row, starts, axis=1))


def _agglomerate(
    log_odds: Array, banned: BoolArray, distinct: BoolArray, probability: float
) -> IntArray:
    """Join G groups, the most similar first, while two are probably one given their rivals.

    Args:
        log_odds: (G, G) that two are one; between joined groups the most similar members count.
        banned: (G, G) that must never be joined. distinct: (G, G) that are certainly different, so
            that one rivals the other.
    Returns:
        joined group of each, (G,).
    """
    odds = np.where(banned, 0, np.exp(log_odds))
    banned = banned.copy()
    distinct = distinct.copy()
    np.fill_diagonal(odds, 0)
    np.fill_diagonal(distinct, False)
    least = probability / (1 - probability)  # odds against all rivals and another object
    i, j = np.nonzero(np.triu(odds >= least, 1))
    pairs = np.column_stack([i, j])[np.argsort(-odds[i, j], kind="stable")]
    group = np.arange(len(odds))
    joined = True
    while joined:
        joined = False
        for a, b in group[pairs]:
            a = group[a]
            b = group[b]
            rival = max(odds[a, distinct[b]].max(initial=0), odds[b, distinct[a]].max(initial=0))
            if odds[a, b] < least * (1 + rival):
                continue
            odds[a] = odds[:, a] = np.maximum(odds[a], odds[b])
            banned[a] = banned[:, a] = banned[a] | banned[b]
            distinct[a] = distinct[:, a] = distinct[a] | distinct[b]
            odds[b] = odds[:, b] = odds[a, a] = odds[a, banned[a]] = odds[banned[a], a] = 0
            distinct[b] = distinct[:, b] = distinct[a, a] = False
            group[group == b] = a
            joined = True
    return np.unique(group, return_inverse=True)[1]


def cut_at_gaps(tracks: Tracks, looked: IntArray | None = None) -> IntArray:
    """Cut tracklets at gaps of more than FRAGMENT_GAP frames in which the detector was run.

    Args:
        looked: frames that the detector was run on; None: all that were read.
    Returns:
        fragment of each row (N,), numbered from 0.
    """
    order = np.lexsort((tracks.frame, tracks.tracklet_id))
    number, unit = looks(tracks, looked)
    tracklet = tracks.tracklet_id[order]
    number = number[order]
    gone = np.diff(number) > FRAGMENT_GAP * unit
    begins = np.append(True, (np.diff(tracklet) != 0) | gone)[: len(order)]
    fragment = np.empty(len(order), np.int64)
    fragment[order] = np.cumsum(begins) - 1
    return fragment
