"""After the video: link tracklets to identities, and fill gaps of their tracks.

Tracklets are linked by 3D object if known, else by appearance. Gaps are filled by projected
objects, else by smoothing (filterpy).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.appearance.reid import SimilarityCalibration, paired_cosine
from reobj.cameras import (
    Poses,
    angle_deg,
    distort_boxes,
    place_of,
    undistort_boxes,
    viewing_rays,
)
from reobj.tracking.ellipsoid_map import EXPECTED_IN_VIEW
from reobj.types import (
    Array,
    BoolArray,
    Embeddings,
    IntArray,
    LinkEvent,
    Tracks,
    box_area,
    box_iou,
    class_shares,
    cxcywh_from_xyxy,
    detector_run_numbers,
    frame_step,
    nearest_of,
    rows_by,
    unit_rows,
    xyxy_from_cxcywh,
)
from reobj.words import among

# Noise of the constant-velocity model of boxes, in the online filter and in the smoother: standard
# deviations, relative to the size of the box, as in DeepSORT's filter.
# of a measured box (of score .8, in the online filter), and process noise of a position, per frame
# (DeepSORT: one weight for both, 1/20)
STD_POSITION = 0.05
# process noise of a velocity, per frame (DeepSORT: 1/160; without images and poses the camera's
# motion is in it too)
STD_VELOCITY = 1 / 80
# of a new track's velocity (DeepSORT: 1/16; SORT: nearly unknown); higher: the second box of an
# object may be farther from the first, and then also be a neighbour's
STD_START = 0.2

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
            cosine = self._unit[members] @ unit.T  # (k, m)
            own = np.flatnonzero((views >= members[0]) & (views <= members[-1]))
            soon = np.abs(self._frame[members, None] - self._frame[views[own]]) < VIEW_GAP
            cosine[:, own] = np.where(soon, -np.inf, cosine[:, own])
            highest = cosine.max(0)  # (m,)
            best = np.maximum.reduceat(highest, starts)  # of each fragment of b
            equal = np.flatnonzero(highest == best[block])
            column = equal[np.searchsorted(block[equal], np.arange(len(starts)))]
            member = members[cosine.argmax(0)[column]]
            view = views[column]
            halves = ((x[member], x[view]) for x in np.split(self._unit, [self._width], 1))
            paired = [paired_cosine(*half) for half in halves]
            paired.append(angle_deg(self._ray[member], self._ray[view]))
            similarity[:, k, columns] = np.where(np.isinf(best), np.nan, paired)
        return similarity


def _viewing_rays(tracks: Tracks, poses: Poses | None) -> Array:
    """Return viewing directions (n, 3) of rows, unit vectors in world, NaN without a pose."""
    if poses is None:
        return np.full((len(tracks), 3), np.nan)
    pose_row, known = place_of(poses, tracks.frame)
    cams = np.where(known[:, None, None], poses.cam_from_world[pose_row], np.nan)
    return viewing_rays(undistort_boxes(tracks.xyxy, poses.camera), poses.camera.K @ cams)


# ---- Linking -------------------------------------------------------------------------------------


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
    detector_ran: IntArray | None = None,
) -> tuple[Tracks, list[LinkEvent]]:
    """Decide over the whole video which tracklets belong to one object.

    Args:
        tracks: rows with the tracker's identities.
        embeddings, embedding_row: fused embeddings of n rows, and the numbers (n,) of those rows.
        poses: cameras; the angle between two views weighs their similarity.
        moving: names of the classes that move; they keep the tracker's identities.
        label, iou: (N,) 3D object that each row is assigned to, or -1 (`associate_component`), and
            the IoU of its projection with the box. None: appearance decides.
        detector_ran: frames that the detector was run on; None: all that were read.
    Returns:
        the rows with the objects' identities, and every join and split with its evidence.
    """
    if not len(tracks):
        return tracks, []
    linker = Linker(tracks, class_names, embeddings, embedding_row, poses, moving, detector_ran)
    identity = linker.by_appearance()
    if label is not None:
        label = propagate_labels(tracks, label, linker.fragment)
        identity = np.where(label >= 0, label, identity + label.max(initial=-1) + 1)
    iou = np.full(len(tracks), np.nan) if iou is None else iou
    joins = linker.changes(tracks.track_id, identity, "join", iou)
    splits = linker.changes(identity, tracks.track_id, "split", iou)
    return tracks.with_identities(identity), joins + splits


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
        classes, moving: (L,) class of a fragment, and whether it moves.
        co_occur: (L, L) seen in one frame. distinct: (L, L) those whose boxes never overlap enough
            to be duplicates on one object.
    """

    def __init__(
        self,
        tracks: Tracks,
        class_names: Sequence[str],
        embeddings: Embeddings,
        embedding_row: IntArray,
        poses: Poses | None,
        moving: Collection[str],
        detector_ran: IntArray | None,
    ) -> None:
        self.tracks = tracks
        self.fragment = cut_at_gaps(tracks, detector_ran)
        count = int(self.fragment.max()) + 1
        self.classes = class_shares(tracks, self.fragment, count).argmax(1)
        moves = among([*class_names, ""], moving)  # (C + 1,), the last: unknown
        self.moving = moves[self.classes.clip(max=len(class_names))]
        self.co_occur = np.zeros((count, count), bool)
        overlapping = np.zeros((count, count), bool)
        for rows in rows_by(tracks.frame):
            here = self.fragment[rows]
            box = tracks.xyxy[rows]
            self.co_occur[here[:, None], here] = True
            overlapping[here[:, None], here] |= box_iou(box, box) > DUPLICATE_IOU
        self.distinct = self.co_occur & ~overlapping
        self.appearance: FragmentAppearance | None = None
        if embeddings.foreground.any():
            fragments = (tracks, self.fragment)
            self.appearance = FragmentAppearance(*fragments, embeddings, embedding_row, poses)
            self.appearance.calibrate(self.classes, self.distinct)

    def by_appearance(self) -> IntArray:
        """Return the identity (N,) of every row of the tracks, in any numbering."""
        tracks = self.tracks
        if self.appearance is None:
            return tracks.track_id
        moving = self.moving[self.fragment]  # (N,)
        keep = np.where(moving, -tracks.track_id, tracks.tracklet_id)
        _, first, tracklet = np.unique(keep, return_index=True, return_inverse=True)  # (T,), (N,)
        kind = class_shares(tracks, tracklet, len(first)).argmax(1)  # (T,)
        kind = np.where(moving[first], -1 - np.arange(len(first)), kind)  # unique: never joined
        whole = tracklet[np.unique(self.fragment, return_index=True)[1]]  # (L,) of each fragment
        joined = np.zeros(len(first), np.int64)  # (T,)
        for tracklets in rows_by(kind):  # others are never joined
            if kind[tracklets[0]] < 0:
                joined[tracklets] = joined.max() + 1
                continue
            members = np.flatnonzero(np.isin(whole, tracklets))
            of_kind = np.searchsorted(tracklets, whole[members])
            square = np.ix_(members, members)
            pairs = (self.co_occur[square], self.distinct[square])
            log_odds = self.appearance.log_odds(members, members)
            matrices = (_max_between_groups(x, of_kind) for x in (log_odds, *pairs))
            joined[tracklets] = joined.max() + 1 + _agglomerate(*matrices)
        return joined[tracklet]

    def changes(self, pieces: IntArray, whole: IntArray, kind: str, iou: Array) -> list[LinkEvent]:
        """List an event for each piece (N,) but the first of the groups of `whole` (N,).

        Changes of fewer than three detections are not reported: they are noise. Log odds are at
        least -9, also where appearance is unknown or excludes one object.

        Args:
            iou: (N,) of the box of each row with its projected object, NaN: none.
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


def _agglomerate(log_odds: Array, banned: BoolArray, distinct: BoolArray) -> IntArray:
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
    i, j = np.nonzero(np.triu(odds >= 1, 1))
    pairs = np.column_stack([i, j])[np.argsort(-odds[i, j], kind="stable")]
    group = np.arange(len(odds))
    joined = True
    while joined:
        joined = False
        for a, b in group[pairs]:
            a = group[a]
            b = group[b]
            rival = max(odds[a, distinct[b]].max(initial=0), odds[b, distinct[a]].max(initial=0))
            if odds[a, b] < 1 + rival:  # the odds of another object are even
                continue
            odds[a] = odds[:, a] = np.maximum(odds[a], odds[b])
            banned[a] = banned[:, a] = banned[a] | banned[b]
            distinct[a] = distinct[:, a] = distinct[a] | distinct[b]
            odds[b] = odds[:, b] = odds[a, a] = odds[a, banned[a]] = odds[banned[a], a] = 0
            distinct[b] = distinct[:, b] = distinct[a, a] = False
            group[group == b] = a
            joined = True
    return np.unique(group, return_inverse=True)[1]


def cut_at_gaps(tracks: Tracks, detector_ran: IntArray | None = None) -> IntArray:
    """Cut tracklets at gaps of more than FRAGMENT_GAP frames in which the detector was run.

    Args:
        detector_ran: frames that the detector was run on; None: all that were read.
    Returns:
        fragment of each row (N,), numbered from 0.
    """
    order = np.lexsort((tracks.frame, tracks.tracklet_id))
    number, unit = detector_run_numbers(tracks, detector_ran)
    tracklet = tracks.tracklet_id[order]
    number = number[order]
    gone = np.diff(number) > FRAGMENT_GAP * unit
    begins = np.append(True, (np.diff(tracklet) != 0) | gone)[: len(order)]
    fragment = np.empty(len(order), np.int64)
    fragment[order] = np.cumsum(begins) - 1
    return fragment


# ---- Gaps ----------------------------------------------------------------------------------------

# Filled boxes are not detections: their score is 0, and neither the fit nor the linker uses them.

MIN_GAP_IOU = 0.3  # of the boxes at both ends; less: too much motion to interpolate (not measured)
# A camera nearer than both limits to another has the same view of an object: angle at the object
# and ratio of the distances. Up to 25 deg and 2 times the distance are as good where no walls
# occlude; without limits the IDF1 of office_loop falls from .420 to .318 (benchmarks/RESULTS.md)
NEAR_DEG = 10.0
NEAR_RATIO = 1.25
# least fraction of a detection inside the projected object: it may be half occluded, but not extend
# beyond the projection
MIN_INSIDE = 0.8


def fill_gaps(
    tracks: Tracks, image_size: tuple[int, int], max_gap: int, detector_ran: IntArray | None = None
) -> Tracks:
    """Interpolate gaps of at most `max_gap` frames between two detections of an identity.

    Args:
        tracks: of a video, in frames that were all read. image_size: (w, h) that boxes stay in.
        detector_ran: frames that the detector was run on, the only ones that count and are filled;
            None: all that were read.
    Returns:
        the tracks with rows of score 0 and detection index -1 in the gaps, ordered by frame.
    """
    tables = [tracks]
    step = frame_step(tracks.frame if detector_ran is None else detector_ran)
    number, unit = detector_run_numbers(tracks, detector_ran)
    for of_identity in rows_by(tracks.track_id):
        rows = tracks[of_identity]
        between = np.diff(rows.frame) // step - 1  # (n - 1,) frames after each row
        missed = np.diff(number[of_identity]) // unit - 1  # of them the detector was run on
        for i in np.flatnonzero((missed > 0) & (missed <= max_gap)):
            if box_iou(rows.xyxy[[i]], rows.xyxy[[i + 1]]) < MIN_GAP_IOU:
                continue
            # 10 frames on either side; with 40 boxes move by 1.3 px at most
            window = rows[np.abs(rows.frame - rows.frame[i]) <= (10 + between[i]) * step]
            at = (window.frame - window.frame[0]) // step
            box = smooth_boxes(at, window.xyxy)  # (F, 4) of every frame of the window
            frame = rows.frame[i] + step * np.arange(1, between[i] + 1)
            frame = frame if detector_ran is None else np.intersect1d(frame, detector_ran)
            filled = box[(frame - window.frame[0]) // step].clip(0, np.tile(image_size, 2))
            tables.append(_filled(rows[np.full(len(frame), i)], frame, filled))
    return Tracks.joined(tables)


def _filled(source: Tracks, frame: IntArray, xyxy: Array) -> Tracks:
    """Return rows like those of `source` in other frames, of score 0 and without a detection."""
    none = np.full(len(frame), -1)
    return dataclasses.replace(
        source, frame=frame, xyxy=xyxy, score=np.zeros(len(frame)), detection_index=none
    )


def fill_from_objects(
    tracks: Tracks,
    poses: Poses,
    identity: IntArray,
    ellipsoids: quadrics.Ellipsoids,
    shapes: list[str],
    sources: IntArray | None = None,
) -> Tracks:
    """Add projected boxes in frames without a detection if a nearby view has one.

    The scene is static: an object visible from a nearby viewpoint is visible here as well. Only
    detections that agree with the projection count.

    Args:
        poses: of one component. identity: (O,) of the objects, which lie in that component.
        shapes: (O,) their kinds.
        sources: (K,) frames whose detections are tried; None: all.
    Returns:
        the tracks with rows of score 0 and detection index -1, ordered by frame.
    """
    frame = poses.frame[poses.known]  # (V,)
    size = (poses.camera.width, poses.camera.height)
    cam_from_world = poses.cam_from_world[poses.known]
    cams = poses.camera.K @ cam_from_world
    center = -np.einsum("vij,vi->vj", cam_from_world[:, :, :3], cam_from_world[:, :, 3])
    tables = [tracks]
    for o, track_id in enumerate(identity.tolist()):
        whole = quadrics.solid_boxes(ellipsoids[[o]], [shapes[o]], cams)[:, 0]
        inside = box_area(quadrics.clip_boxes(whole, size))
        box = np.full_like(whole, np.nan)  # (V, 4)
        shown = inside > 0
        box[shown] = quadrics.clip_boxes(distort_boxes(whole[shown], poses.camera), size)
        visible = (inside > EXPECTED_IN_VIEW * box_area(whole)) & np.isfinite(box[:, 0])
        rows = tracks[(tracks.track_id == track_id) & np.isin(tracks.frame, frame)]  # (n,)
        empty = np.setdiff1d(np.flatnonzero(visible), np.searchsorted(frame, rows.frame))  # (T,)
        rows = rows if sources is None else rows[np.isin(rows.frame, sources)]
        low, high = np.split(box[np.searchsorted(frame, rows.frame)], 2, axis=1)
        common = (np.minimum(rows.xyxy[:, 2:], high) - np.maximum(rows.xyxy[:, :2], low)).clip(0)
        rows = rows[common.prod(1) > MIN_INSIDE * box_area(rows.xyxy)]
        if not (len(rows) and len(empty)):
            continue
        view = np.searchsorted(frame, rows.frame)
        ray = center - ellipsoids.center_in_world[o]  # (V, 3)
        distance = np.linalg.norm(ray, axis=1)
        direction = ray / distance[:, None]
        for block in np.array_split(empty, len(empty) // 1024 + 1):  # bounds the memory
            angle = np.arccos((direction[block] @ direction[view].T).clip(-1, 1))  # (t, n)
            log_ratio = np.abs(np.log(distance[block, None] / distance[view]))
            change = np.maximum(angle / np.radians(NEAR_DEG), log_ratio / np.log(NEAR_RATIO))
            near = change.min(1) < 1
            source = rows[change.argmin(1)[near]]
            tables.append(_filled(source, frame[block[near]], box[block[near]]))
    return Tracks.joined(tables)


def smooth_boxes(at: npt.NDArray[np.int64], xyxy: Array) -> Array:
    """Smooth boxes (n, 4) of frames (n,), ascending from 0, with a constant-velocity model.

    Returns:
        (F, 4) boxes of all frames from the first to the last.
    Ref: Rauch, Tung and Striebel, AIAA Journal 1965.
    """
    from filterpy.kalman import KalmanFilter  # brings scipy.stats: .4 s

    box = cxcywh_from_xyxy(xyxy)
    side = float(np.median(np.sqrt(box[:, 2] * box[:, 3])))
    measured: list[Array | None] = [None] * (int(at[-1]) + 1)
    for frame, z in zip(at.tolist(), box, strict=True):
        measured[frame] = z[:, None]
    kalman = KalmanFilter(dim_x=8, dim_z=4)  # cx, cy, w, h and their velocities
    kalman.F = np.eye(8) + np.eye(8, k=4)
    kalman.H = np.eye(4, 8)
    kalman.R = np.eye(4) * (STD_POSITION * side) ** 2
    kalman.Q = np.diag(np.repeat([STD_POSITION * side, STD_VELOCITY * side], 4) ** 2)
    kalman.P = np.diag(np.repeat([STD_POSITION * side, STD_START * side], 4) ** 2)
    kalman.x = np.concatenate([box[0], np.zeros(4)])[:, None]
    mean, cov, _, _ = kalman.batch_filter(measured)
    smoothed = kalman.rts_smoother(mean, cov)[0]  # (F, 8, 1)
    return xyxy_from_cxcywh(np.asarray(smoothed[:, :4, 0], np.float64))
