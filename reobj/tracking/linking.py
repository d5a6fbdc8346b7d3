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
    rows_by,
    unit_rows,
)

# Chosen on examples/room and redkitchen (benchmarks/RESULTS.md) unless a source is given.
# frames between views of a fragment that show how the appearance of one object varies (lower:
# nearly equal views, which are more alike than those of an object that was out of view)
VIEW_GAP = 30
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
            gap = np.abs(tracks.frame[unlabelled][:, None] - tracks.frame[labelled])
            nearest = label[labelled[gap.argmin(1)]]
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
        log_odds: (L, L) that two look like one object, -inf: unknown.
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
        self.log_odds = np.full(self.co_occur.shape, -np.inf)

    def _describe_fragments(self, class_names: Sequence[str], moving: Collection[str]) -> None:
        """Set tracklet, identity and class of every fragment, and whether it moves, (L,) each."""
        first = np.unique(self.fragment, return_index=True)[1]  # (L,)
        self.tracklets = self.tracks.tracklet_id[first]
        self.identity = self.tracks.track_id[first]
        self.classes = class_shares(self.tracks, self.fragment, len(first)).argmax(1)
        moves = np.isin([*class_names, ""], list(moving))  # (C + 1,), the last: unknown
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
        """Set the log odds that fragments look like one object, -inf: unknown.

        The similarity is calibrated on this video without labels: fragments of a class seen side by
        side are different objects, views of one fragment some time apart are the same.
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
        similarity = np.full((3, len(self.tracklets), len(self.tracklets)), np.nan)
        order = np.argsort(self.fragment[embedding_row], kind="stable")
        rows = embedding_row[order]
        width = embeddings.foreground.shape[1]
        fused = np.concatenate([embeddings.foreground, embeddings.background], 1)
        unit = unit_rows(fused[order])  # (n, E)
        fragments, starts, block = np.unique(
            self.fragment[rows], return_index=True, return_inverse=True
        )
        ray = self._viewing_rays(rows)
        for fragment, members in zip(
            fragments, np.split(np.arange(len(rows)), starts[1:]), strict=True
        ):
            cosine = unit[members] @ unit.T  # (k, n)
            frame = self.tracks.frame[rows[members]]
            soon = np.abs(frame[:, None] - frame) < VIEW_GAP
            cosine[:, members] = np.where(soon, -np.inf, cosine[:, members])
            view = np.lexsort((-cosine.max(0), block))[starts]  # the best of each fragment
            member = members[cosine[:, view].argmax(0)]
            paired = [paired_cosine(x[member], x[view]) for x in np.split(unit, [width], 1)]
            paired.append(angle_deg(ray[member], ray[view]))
            similarity[:, fragment, fragments] = np.where(
                np.isinf(cosine[:, view].max(0)), np.nan, paired
            )
        return similarity[0], similarity[1], similarity[2]

    def _viewing_rays(self, rows: IntArray) -> Array:
        """Return viewing directions (n, 3) of rows, unit vectors in world, NaN without a pose."""
        if self.poses is None:
            return np.full((len(rows), 3), np.nan)
        pose_row, known = place_of(self.poses, self.tracks.frame[rows])
        camera = self.poses.camera
        cams = np.where(known[:, None, None], self.poses.cam_from_world[pose_row], np.nan)
        return viewing_rays(undistort_boxes(self.tracks.xyxy[rows], camera), camera.K @ cams)

    def by_appearance(self, probability: float = 0.5) -> IntArray:
        """Return the identity (N,) of every row of the tracks, in any numbering.

        Args:
            probability: least probability, given the rivals, to join two fragments: even odds.
        """
        group = np.unique(self.identity, return_inverse=True)[1]  # (L,)
        if np.isfinite(self.log_odds).any():
            keep = np.where(self.moving, -self.identity, self.tracklets)
            whole = np.unique(keep, return_inverse=True)[1]  # (L,) tracklet of each fragment
            shares = class_shares(self.tracks, whole[self.fragment], int(whole.max()) + 1)
            kind = shares.argmax(1)  # (T,)
            kind[whole[self.moving]] = -1 - whole[self.moving]  # unique: never joined
            log_odds = _max_between_groups(self.log_odds, whole)  # (T, T)
            banned = _max_between_groups(self.co_occur, whole) | (kind[:, None] != kind)
            distinct = _max_between_groups(self.distinct, whole)
            group = _agglomerate(log_odds, banned, distinct, probability)[whole]
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
                log_odds = max(float(self.log_odds[np.ix_(rest, fragment)].max()), -9.0)
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
