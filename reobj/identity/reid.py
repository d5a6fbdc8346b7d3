"""Re-identification: gallery of views, calibrated similarity, places in 3D."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

import quadrics
from reobj.cameras import angle_deg
from reobj.types import Array, BoolArray, Floats, IntArray, cxcywh_from_xyxy, unit_rows

GALLERY_VIEWS = 12  # views kept of every identity
GALLERY_NOVELTY = 0.95  # a view less similar than this to all kept ones is a new view (cosine)


class Gallery:
    """What every identity of the video looked like: a few diverse views each, never forgotten.

    Arrays grow with the number of identities, not with time: `views` per identity at most.
    """

    def __init__(self) -> None:
        self.rows = np.zeros((0, GALLERY_VIEWS, 0), np.float32)  # (I, K, E)
        self.viewing_ray = np.zeros((0, GALLERY_VIEWS, 3))  # (I, K, 3) directions they were seen in
        self.count = np.zeros(0, np.int64)  # (I,) views held
        self.foreground_width = 0  # width of the foreground in the rows

    def add(self, identity: IntArray, rows: Floats, viewing_ray: Array) -> None:
        """Store one new view (E,) for each of N different identities, seen in a direction (N, 3)
        of the world, NaN: unknown. A new one if it is novel, else blended.
        """
        self._grow(int(identity.max(initial=-1)) + 1, rows.shape[1])
        own = self.rows[identity]  # (N, K, E)
        slot = np.arange(own.shape[1])
        similarity = np.einsum("nke,ne->nk", own, rows)  # (N, K)
        similarity[slot >= self.count[identity][:, None]] = -2.0
        nearest = similarity.argmax(1)  # (N,)
        novel = similarity.max(1) < GALLERY_NOVELTY  # (N,)
        room = self.count[identity] < GALLERY_VIEWS
        crowded = self._most_redundant(own[novel & ~room])
        target = np.where(novel & room, self.count[identity], nearest)  # (N,)
        target[novel & ~room] = crowded
        blend = np.where(novel, 0.0, 0.9)[:, None]
        picked = own[np.arange(len(identity)), target]  # (N, E)
        self.rows[identity, target] = unit_rows(blend * picked + (1 - blend) * rows)
        self.viewing_ray[identity[novel], target[novel]] = viewing_ray[novel]
        self.count[identity] += novel & room

    @staticmethod
    def _most_redundant(full: Floats) -> IntArray:
        """For full sets of views (N, K, E): the view that is most like another one, (N,)."""
        pairs = np.einsum("nke,nle->nkl", full, full)
        pairs[:, np.arange(full.shape[1]), np.arange(full.shape[1])] = -2.0
        return np.asarray(pairs.max(2).argmax(1), np.int64)

    def parts(
        self, rows: Floats, identity: IntArray, viewing_ray: Array
    ) -> tuple[Array, Array, Array]:
        """Cosines of foreground and background (N, I) between each row (N, E) and the most
        similar view of each identity (I,), and the degrees between the directions in which both
        were seen, (N, 3) of the rows; NaN where unknown.
        """
        shape = (len(rows), len(identity), GALLERY_VIEWS)
        if not rows.size or not len(identity) or self.rows.shape[2] != rows.shape[1]:
            unknown = np.full(shape[:2], np.nan)
            return unknown, unknown, unknown
        views = self.rows[identity].reshape(-1, rows.shape[1])  # (I * K, E)
        empty = np.arange(GALLERY_VIEWS) >= self.count[identity][:, None]  # (I, K)
        fused = np.where(empty, -2.0, (rows @ views.T).reshape(shape))  # (N, I, K)
        best = fused.argmax(2)[..., None]
        angle = angle_deg(viewing_ray[:, None], self.viewing_ray[identity].reshape(-1, 3))
        fore, back, angle = (
            np.take_along_axis(np.where(empty, np.nan, part.reshape(shape)), best, 2)[..., 0]
            for part in (*part_cosines(rows, views, self.foreground_width), angle)
        )
        return fore, back, angle

    def _grow(self, identities: int, width: int) -> None:
        if self.rows.shape[2] == 0:
            self.rows = np.zeros((len(self.count), GALLERY_VIEWS, width), np.float32)
        if identities > len(self.count):
            extra = max(
                identities - len(self.count), len(self.count), 16
            )  # doubling: amortised O(1)
            self.rows, self.viewing_ray, self.count = (
                np.concatenate([old, np.zeros((extra, *old.shape[1:]), old.dtype)])
                for old in (self.rows, self.viewing_ray, self.count)
            )


def part_cosines(
    a: npt.NDArray[Any], b: npt.NDArray[Any], foreground_width: int
) -> tuple[Array, Array]:
    """Cosines (N, M) of the foregrounds and of the backgrounds of fused rows (N, E) and (M, E);
    foreground_width: width of the foreground part. NaN where a row has no such part.
    """
    return _cosine(a[:, :foreground_width], b[:, :foreground_width]), _cosine(
        a[:, foreground_width:], b[:, foreground_width:]
    )


def paired_cosine(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Array:
    """Cosines (N,) of rows (N, E) with rows (N, E), NaN where one is of zeros."""
    length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray(np.where(length > 1e-9, (a * b).sum(1) / np.maximum(length, 1e-9), np.nan))


def _cosine(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Array:
    """Cosines (N, M) of rows (N, E) and (M, E), NaN for rows of zeros."""
    if not a.shape[1]:
        return np.full((len(a), len(b)), np.nan)
    lengths = (np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    a, b = (x / np.where(n > 1e-9, n, np.nan) for x, n in zip((a, b), lengths, strict=True))
    return np.asarray(a @ b.T)


class SimilarityCalibration:
    """Is it the same object? From the cosines of foreground and background to a probability.

    No threshold on a cosine serves two videos: the pairs that a video shows without labels say what
    its cosines mean. Objects of a class side by side in a frame are different, views of a track are
    of one object. The log_similarity of both parts is counted from the middle between the two, in
    standard deviations, and weighs the more the further the two are apart. The weights are near
    the fit of examples/rank_k.py --calibrate (docs/reid.md) and serve every appearance model.

    Args:
        weight: number of pairs that the usual mean and spread are worth.
    Attributes:
        sums: (2, 3, 2) count, sum and sum of squares of the log similarity of the foreground and of
            background, of different and of same objects.
    """

    WEIGHTS = (0.55, 0.5)  # of foreground and background
    USUAL = ((1.3, 0.65), (1.8, 1.2))  # mean log_similarity of both parts: different, same
    USUAL_STD = 0.45
    USUAL_ANGLE_DEG = 45.0  # between two views of unknown directions

    def __init__(self, weight: float) -> None:
        mean = np.array(self.USUAL)  # (2, 2)
        self.sums = weight * np.stack([mean**0, mean, mean**2 + self.USUAL_STD**2], 1)

    @staticmethod
    def log_similarity(cosine: npt.ArrayLike) -> Array:
        """Monotone in the cosine, steep where two views are nearly equal."""
        return np.asarray(-np.log(1.03 - np.minimum(cosine, 1.0)))

    def add(self, foreground: Array, background: Array, same: bool) -> None:
        """Add cosines of pairs (N,) that the video showed; NaN: unknown."""
        close = self.log_similarity(np.stack([foreground.ravel(), background.ravel()]))  # (2, N)
        known = np.isfinite(close)
        close = np.where(known, close, 0.0)
        self.sums[int(same)] += [known.sum(1), close.sum(1), (close * close).sum(1)]

    def logit(
        self,
        foreground: npt.ArrayLike,
        background: npt.ArrayLike = np.nan,
        view_angle_deg: npt.ArrayLike = np.nan,
    ) -> Array:
        """Log of the odds that it is the same object, where both are equally likely beforehand;
        within about +-7: one case in a thousand is like nothing that was seen.

        Args:
            foreground, background: cosines; any shapes that broadcast. Without a background the
                foreground decides; without a foreground nothing speaks for it: -inf.
            view_angle_deg: between the directions of view. From another side, an object looks less
                like itself, and what surrounds it soon not at all. NaN: as 45 degrees.
        """
        parts = np.stack(np.broadcast_arrays(foreground, background), -1)  # (..., 2)
        evidence = self.WEIGHTS * self.scores(parts, view_angle_deg)
        logit = np.where(np.isnan(evidence), 0, evidence).sum(-1)
        return _with_outliers(np.where(np.isnan(parts[..., 0]), -np.inf, logit))

    def scores(self, cosine: Array, view_angle_deg: npt.ArrayLike = np.nan) -> Array:
        """What each part (..., 2) says for one object, before it is weighted."""
        count, total, squares = np.moveaxis(self.sums, 1, 0)  # (2, 2) each: kinds, parts
        mean = total / count
        std = np.sqrt((squares / count - mean**2).mean(0).clip(1e-3))  # (2,)
        apart = ((mean[1] - mean[0]) / std).clip(0)
        angle = np.radians(np.where(np.isnan(view_angle_deg), self.USUAL_ANGLE_DEG, view_angle_deg))
        facing = np.stack([(1 + np.cos(angle)) / 2, np.cos(angle).clip(0)], -1)  # (..., 2)
        return np.asarray(facing * (self.log_similarity(cosine) - mean.mean(0)) / std * (1 + apart))

    def probability(self, *known: npt.ArrayLike, prior: float = 0.5) -> Array:
        """Probability of the same object, given how likely it was beforehand; see `logit`."""
        return np.asarray(1 / (1 + np.exp(-self.logit(*known) - math.log(prior / (1 - prior)))))


def match_probability(logit: Array, prior_odds: float = 1.0) -> Array:
    """Probability (N, M) that row and column are one object, of log odds of the pairs (N, M).

    Against the likeliest other pair of its row or column (the ratio test among look-alikes) and
    against no pair at all, which beforehand is `prior_odds` times less likely.
    """
    odds = prior_odds * np.exp(logit)
    rival = np.maximum(_best_other(odds), _best_other(odds.T).T)
    return np.asarray(odds / (odds + 1 + rival))


def _best_other(odds: Array) -> Array:
    """(N, M) largest of the other entries of the row, 0 if there are none."""
    top = np.sort(np.pad(odds, ((0, 0), (2, 0))), 1)[:, -2:]  # (N, 2) second, best
    return np.where(odds == top[:, 1:], top[:, :1], top[:, 1:])


def _with_outliers(logit: Array, share: float = 1e-3) -> Array:
    """Bound log odds as if this share of either kind were like the other; -inf stays."""
    odds = np.exp(logit.clip(None, 50))
    return np.asarray(np.where(odds > 0, np.log((odds + share) / (1 + share * odds)), -np.inf))


def quick_fit(boxes: Array, img_from_world: Array, image_size: tuple[int, int]) -> Any:
    """Ellipsoids of any size from boxes (V, G, 4), in a few steps (`quadrics.fit_objects`)."""
    config = quadrics.FitConfig(iterations=10, start_views=4, start_iterations=4)
    return quadrics.fit_objects(
        boxes, img_from_world, image_size, support="ellipsoid", config=config
    )


PLACE_VIEWS = 16  # with poses: views kept of every object to tell its place in 3D
PLACE_EVERY = 5  # frames between them; when they are full every other one goes and this doubles
PLACE_PARALLAX_DEG = 2.0  # a place counts from this angle between its views on
# and where the longest axis is at most this many middle ones: half-seen things give needles (95 %
# of priors.json: 5.8)
PLACE_SHAPE = 6.0


class EllipsoidMap:
    """Where every identity is in 3D, for a tracker that is told the camera's poses.

    Of every identity a few views are kept, evenly over its life, and an ellipsoid is fitted to
    them now and then. Rows grow with the number of identities, not with time.
    """

    ARRAYS = ("frame", "boxes", "img_from_world", "every", "fresh", "dual_q")

    def __init__(self) -> None:
        views = PLACE_VIEWS
        self.frame = np.zeros((0, views), np.int64)  # (I, V), < 0: free
        self.boxes = np.zeros((0, views, 4))  # (I, V, 4)
        self.img_from_world = np.zeros((0, views, 3, 4))  # (I, V, 3, 4)
        self.every = np.zeros(0, np.int64)  # (I,) frames between views
        self.fresh = np.zeros(0, np.int64)  # (I,) views since the last fit
        self.dual_q = np.zeros((0, 4, 4))  # (I, 4, 4), NaN: unknown

    def add(self, frame: int, identity: IntArray, xyxy: Array, img_from_world: Array) -> None:
        """Keep boxes (N, 4) of N different identities in this frame as views, where one is due."""
        self._grow(int(identity.max(initial=-1)) + 1)
        due = frame - self.frame[identity].max(1) >= self.every[identity]
        for i, box in zip(identity[due], xyxy[due], strict=True):
            if (self.frame[i] >= 0).all():
                self.frame[i, self.frame[i].argsort()[1::2]] = -1000
                self.every[i] *= 2
            slot = self.frame[i].argmin()
            self.frame[i, slot], self.boxes[i, slot] = frame, box
            self.img_from_world[i, slot] = img_from_world
            self.fresh[i] += 1

    def refit(self, image_size: tuple[int, int]) -> bool:
        """Fit the ellipsoids of all identities with enough new views, all at once; any?"""
        seen = self.frame >= 0
        due = np.flatnonzero((seen.sum(1) >= 3) & (self.fresh > seen.sum(1) // 4))
        if not len(due):
            return False
        at, slot = np.nonzero(seen[due])
        frames, first, row = np.unique(
            self.frame[due][at, slot], return_index=True, return_inverse=True
        )
        boxes = np.full((len(frames), len(due), 4), np.nan)
        boxes[row, at] = self.boxes[due][at, slot]
        cameras = self.img_from_world[due][at, slot][first]  # (F, 3, 4)
        fits = quick_fit(boxes, cameras, image_size)
        good = (fits.status != "rejected") & (fits.parallax_deg >= PLACE_PARALLAX_DEG)
        axes = np.sort(fits.ellipsoids.half_axes, 1)  # (O, 3)
        good &= axes[:, 2] <= PLACE_SHAPE * axes[:, 1]
        self.dual_q[due] = np.where(good[:, None, None], fits.ellipsoids.dual_quadrics(), np.nan)
        self.fresh[due] = 0
        return True

    @property
    def known(self) -> BoolArray:
        """(I,): is the place of the identity known?"""
        return np.asarray(np.isfinite(self.dual_q[:, 0, 0]), bool)

    def project(self, img_from_world: Array, image_size: tuple[int, int], share: float) -> Array:
        """Boxes cx, cy, w, h (I, 4) of the ellipsoids' parts in an image; NaN where the place is
        unknown, or no more than this share of the box lies in the image.
        """
        dual_c, before_camera = quadrics.project(self.dual_q, img_from_world[None])
        boxes = quadrics.boxes_from_dual_conics(dual_c[0])  # (I, 4)
        cut = quadrics.clip_boxes(boxes, image_size)
        area, whole = ((b[:, 2:] - b[:, :2]).prod(1) for b in (cut, boxes))
        seen = before_camera[0] & (area > share * whole)
        return np.where(seen[:, None], cxcywh_from_xyxy(cut), np.nan)

    def _grow(self, identities: int) -> None:
        extra = identities - len(self.frame)
        if extra > 0:
            extra = max(extra, len(self.frame), 16)  # doubling: amortised O(1)
            fills = {"frame": -1000, "dual_q": np.nan, "every": PLACE_EVERY}
            for name in self.ARRAYS:
                old = getattr(self, name)
                new = np.full((extra, *old.shape[1:]), fills.get(name, 0), old.dtype)
                setattr(self, name, np.concatenate([old, new]))
