"""Compare the appearance of tracklet fragments by the most similar views of every two."""

from __future__ import annotations

import numpy as np

from reobj.appearance.reid import SimilarityCalibration, paired_cosine
from reobj.cameras import Poses, angle_deg, place_of, undistort_boxes, viewing_rays
from reobj.types import Array, BoolArray, Embeddings, IntArray, Tracks, rows_by, unit_rows

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
