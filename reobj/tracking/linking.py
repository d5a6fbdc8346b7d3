"""From tracklets to objects over the whole video: by place where known, else by appearance."""

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

# Chosen on examples/room and redkitchen (docs/tracking.md), but for those with a source.
LINK_PROBABILITY = 0.5  # join by appearance from this probability on, rivals considered: even odds
# frames; views of a fragment this far apart show how the appearance of one object varies
VIEW_GAP = 30
DUPLICATE_IOU = 0.5  # boxes that overlap more may be two boxes on one object
FRAGMENT_GAP = 5  # frames read without a detection, after which a tracklet may be another object
MIN_CHANGED = 3  # rows of another identity that are said (chosen: fewer are slips of a frame)
LEAST_LOG_ODDS = -9.0  # said in the evidence where nothing speaks for one object


def link(
    tracks: Tracks,
    class_names: Sequence[str],
    embeddings: Embeddings,
    embedding_row: IntArray,
    poses: Poses | None = None,
    *,
    moving: Collection[str] = (),
    solid: IntArray | None = None,
    overlap: Array | None = None,
    looked: IntArray | None = None,
) -> tuple[Tracks, list[LinkEvent]]:
    """Decide over the whole video which tracklets are one object.

    Args:
        tracks: rows with the tracker's identities.
        embeddings, embedding_row: fused embeddings of n rows, and which rows (n,) these are.
        poses: known cameras; views from another side say less.
        moving: names of the classes that move; they stay as the tracker has them.
        solid, overlap: (N,) the solid that shows in each row, or -1 (`locate`), and the IoU of its
            projection with the box; rows of one solid are one object. None: appearance decides.
        looked: frames that the detector was run on; None: all that were read.
    Returns:
        the rows with the objects' identities, and every join and split with its evidence.
    """
    if not len(tracks):
        return tracks, []
    linker = Linker(tracks, class_names, poses, moving, looked)
    linker.measure_appearance(embeddings, embedding_row)
    identity = linker.by_appearance()
    if solid is not None:
        solid = with_neighbours(tracks, solid, linker.fragment)
        identity = np.where(solid >= 0, solid, identity + solid.max(initial=-1) + 1)
    return tracks.with_identities(identity), linker.changes(identity, overlap)


def with_neighbours(tracks: Tracks, solid: IntArray, fragment: IntArray) -> IntArray:
    """Give rows (N,) without a solid (-1) that of the nearest row of their fragment (N,).

    Not where another row of the frame shows that solid.
    """
    solid = solid.copy()
    shown = set(zip(tracks.frame[solid >= 0].tolist(), solid[solid >= 0].tolist(), strict=True))
    for rows in rows_by(fragment):
        known, open_ = rows[solid[rows] >= 0], rows[solid[rows] < 0]
        if len(known) and len(open_):
            gap = np.abs(tracks.frame[open_][:, None] - tracks.frame[known])
            wanted = solid[known[gap.argmin(1)]]
            for row, name in zip(open_.tolist(), wanted.tolist(), strict=True):
                if (key := (int(tracks.frame[row]), name)) not in shown:
                    solid[row] = name
                    shown.add(key)
    return solid


class Linker:
    """Join and split the fragments of a video's tracklets by appearance.

    Two fragments seen in one frame are never the same object, and classes that move stay as the
    tracker has them: what surrounds them does not last. Fragments are joined as long as their most
    similar views show one object more likely than any rival (seen beside one of the two) or another
    object, the most similar first. This replaces what the tracker decided when it first saw them.

    Attributes:
        fragment: (N,) fragment of each row, 0 .. L - 1: a tracklet, or a piece of one.
        log_odds: (L, L) that two look like one object, -inf: unknown.
        co_occur: (L, L) seen in one frame; distinct: those of them that cannot be duplicates.
    """

    def __init__(
        self,
        tracks: Tracks,
        class_names: Sequence[str],
        poses: Poses | None,
        moving: Collection[str],
        looked: IntArray | None = None,
    ) -> None:
        self.tracks, self.poses = tracks, poses
        self.fragment = cut_at_gaps(tracks, looked)  # (N,)
        self._describe_fragments(class_names, moving)
        self.co_occur, self.distinct = self._co_occurrence()
        self.log_odds = np.full(self.co_occur.shape, -np.inf)

    def _describe_fragments(self, class_names: Sequence[str], moving: Collection[str]) -> None:
        """Note tracklet, identity and class of every fragment and whether it moves, (L,) each."""
        first = np.unique(self.fragment, return_index=True)[1]  # (L,)
        self.tracklets = self.tracks.tracklet_id[first]
        self.identity = self.tracks.track_id[first]
        self.classes = class_shares(self.tracks, self.fragment, len(first)).argmax(1)
        moves = np.isin([*class_names, ""], list(moving))  # (C + 1,), the last: unknown
        self.moving = moves[self.classes.clip(max=len(class_names))]

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

    def by_appearance(self) -> IntArray:
        """Return the object of every row of the tracks, (N,), any numbering."""
        group = np.unique(self.identity, return_inverse=True)[1]  # (L,)
        if np.isfinite(self.log_odds).any():
            keep = np.where(self.moving, -self.identity, self.tracklets)
            whole = np.unique(keep, return_inverse=True)[1]  # (L,) tracklet of each fragment
            shares = class_shares(self.tracks, whole[self.fragment], int(whole.max()) + 1)
            kind = shares.argmax(1)  # (T,)
            kind[whole[self.moving]] = -1 - whole[self.moving]  # a kind of its own
            log_odds = _max_between_groups(self.log_odds, whole)  # (T, T)
            banned = _max_between_groups(self.co_occur, whole) | (kind[:, None] != kind)
            distinct = _max_between_groups(self.distinct, whole)
            group = _agglomerate(log_odds, banned, distinct, LINK_PROBABILITY)[whole]
        return np.asarray(group[self.fragment], np.int64)

    def changes(self, identity: IntArray, overlap: Array | None) -> list[LinkEvent]:
        """List what differs from the tracker, with the evidence.

        Args:
            identity: (N,) of each row now. overlap: (N,) of its box with its solid, NaN: none.
        """
        before = self.tracks.track_id
        known = np.full(len(identity), np.nan) if overlap is None else overlap
        joins = self._changes(before, identity, "join", known)
        return joins + self._changes(identity, before, "split", known)

    def _changes(
        self, parts: IntArray, whole: IntArray, kind: str, overlap: Array
    ) -> list[LinkEvent]:
        """List an event for each part (N,) but the first of the groups of `whole` (N,).

        Of rows alone nothing is said.
        """
        found = []
        for rows in rows_by(whole):
            pieces = [rows[own] for own in rows_by(parts[rows]) if len(own) >= MIN_CHANGED]
            for piece in pieces[1:]:
                rest = np.unique(self.fragment[np.setdiff1d(rows, piece)])
                own = np.unique(self.fragment[piece])
                log_odds = max(float(self.log_odds[np.ix_(rest, own)].max()), LEAST_LOG_ODDS)
                ids = np.unique(self.tracks.tracklet_id[rows if kind == "join" else piece]).tolist()
                known = overlap[piece][np.isfinite(overlap[piece])]
                iou = float(np.median(known)) if len(known) else None
                found.append(LinkEvent(kind, tuple(ids), iou, log_odds, True))
        return found


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


def cut_at_gaps(tracks: Tracks, looked: IntArray | None = None) -> IntArray:
    """Cut tracklets where more than FRAGMENT_GAP frames looked at pass without a detection.

    Args:
        looked: frames that the detector was run on; None: all that were read.
    Returns:
        fragment of each row (N,), numbered from 0.
    """
    order = np.lexsort((tracks.frame, tracks.tracklet_id))
    number, unit = looks(tracks, looked)
    tracklet, number = tracks.tracklet_id[order], number[order]
    gone = np.diff(number) > FRAGMENT_GAP * unit
    begins = np.append(True, (np.diff(tracklet) != 0) | gone)[: len(order)]
    fragment = np.empty(len(order), np.int64)
    fragment[order] = np.cumsum(begins) - 1
    return fragment
