"""Re-identification by appearance: a gallery of each identity, and calibrated similarities.

`Gallery` keeps a few views of every identity, `SimilarityCalibration` turns cosines into log odds,
and `match_probability` compares these with the best rival.

Axes: I identities, K views of an identity in the gallery, E width of an embedding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.cameras import angle_deg
from reobj.types import Array, Floats, IntArray, unit_rows

# ---- Gallery -----------------------------------------------------------------------------------


NOVELTY = 0.95  # largest cosine to all kept views of a view that is kept as a new one
BLEND = 0.9  # weight of the kept view where a view that is not new is blended into it


class Gallery:
    """A few diverse views of the appearance of every identity of a video; none expires.

    Memory grows with the number of identities, not with time: `views` per identity at most.

    Args:
        views: K, views kept of every identity.

    Attributes:
        rows: (I, K, E) unit rows. viewing_ray: (I, K, 3) viewing directions, NaN unknown.
        count: (I,) views held. foreground_width: width of the foreground in the rows.
    """

    ARRAYS = ("rows", "viewing_ray", "count", "foreground_width")  # the whole state

    def __init__(self, views: int = 12) -> None:
        self.views = views
        self.rows = np.zeros((0, views, 0), np.float32)
        self.viewing_ray = np.zeros((0, views, 3))
        self.count = np.zeros(0, np.int64)
        self.foreground_width = 0

    def add(self, identity: IntArray, rows: Floats, viewing_ray: Array) -> None:
        """Add one view to each of N different identities.

        A novel view is kept; if all K slots are used, it replaces the one most similar to another.
        A view that is not novel is blended into the most similar one.

        Args:
            identity: (N,). rows: (N, E) unit rows.
            viewing_ray: (N, 3) viewing direction in the world, NaN: unknown.
        """
        self.reserve(int(identity.max(initial=-1)) + 1, rows.shape[1])
        views = self.rows[identity]  # (N, K, E)
        similarity = np.einsum("nke,ne->nk", views, rows)  # (N, K)
        similarity[np.arange(self.views) >= self.count[identity][:, None]] = -np.inf
        nearest = similarity.argmax(1)  # (N,)
        novel = similarity.max(1) < NOVELTY  # (N,)
        has_slot = self.count[identity] < self.views
        target = np.where(novel & has_slot, self.count[identity], nearest)  # (N,) slot to write
        target[novel & ~has_slot] = _most_redundant(views[novel & ~has_slot])
        blend = np.where(novel, 0.0, BLEND)[:, None]
        picked = views[np.arange(len(identity)), target]  # (N, E)
        self.rows[identity, target] = unit_rows(blend * picked + (1 - blend) * rows)
        self.viewing_ray[identity[novel], target[novel]] = viewing_ray[novel]
        self.count[identity] += novel & has_slot

    def parts(
        self, rows: Floats, identity: IntArray, viewing_ray: Array
    ) -> tuple[Array, Array, Array]:
        """Compare rows (N, E) with the most similar view of each identity (I,).

        Args:
            viewing_ray: (N, 3) of the rows, NaN: unknown.
        Returns:
            foreground, background: (N, I) cosines. angle: (N, I) degrees between the viewing rays.
            NaN where unknown.
        """
        shape = (len(rows), len(identity), self.views)
        if not rows.size or not len(identity) or self.rows.shape[2] != rows.shape[1]:
            unknown = np.full(shape[:2], np.nan)
            return unknown, unknown, unknown
        self.reserve(int(identity.max()) + 1, rows.shape[1])  # some may have no view at all
        views = self.rows[identity].reshape(-1, rows.shape[1])  # (I * K, E)
        empty = np.arange(self.views) >= self.count[identity][:, None]  # (I, K)
        fused = np.where(empty, -np.inf, (rows @ views.T).reshape(shape))  # (N, I, K)
        best = fused.argmax(2)[..., None]
        angle = angle_deg(viewing_ray[:, None], self.viewing_ray[identity].reshape(-1, 3))
        fore, back, angle = (
            np.take_along_axis(np.where(empty, np.nan, part.reshape(shape)), best, 2)[..., 0]
            for part in (*part_cosines(rows, views, self.foreground_width), angle)
        )
        return fore, back, angle

    def reserve(self, identities: int, width: int) -> None:
        """Allocate this many identities, and rows of this width if there are none yet."""
        if self.rows.shape[2] == 0:
            self.rows = np.zeros((len(self.count), self.views, width), np.float32)
        if identities > len(self.count):
            extra = max(identities - len(self.count), len(self.count), 16)  # amortised O(1)
            self.rows, self.viewing_ray, self.count = (
                np.concatenate([old, np.zeros((extra, *old.shape[1:]), old.dtype)])
                for old in (self.rows, self.viewing_ray, self.count)
            )


def _most_redundant(full: Floats) -> IntArray:
    """Find in each full set of views (N, K, E) the one most similar to another of its set, (N,)."""
    pairs = np.einsum("nke,nle->nkl", full, full)
    pairs[:, np.arange(full.shape[1]), np.arange(full.shape[1])] = -np.inf
    return np.asarray(pairs.max(2).argmax(1), np.int64)


def part_cosines(
    a: npt.NDArray[Any], b: npt.NDArray[Any], foreground_width: int
) -> tuple[Array, Array]:
    """Compute the cosines of foregrounds and backgrounds of fused rows (N, E) and (M, E).

    Returns:
        foreground, background: (N, M) cosines, NaN where a row lacks it.
    """
    parts = (slice(foreground_width), slice(foreground_width, None))
    foreground, background = (_cosine(a[:, part], b[:, part]) for part in parts)
    return foreground, background


def paired_cosine(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Array:
    """Compute the cosines (N,) of rows (N, E) with their partners (N, E), NaN for rows of zeros."""
    length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray(np.where(length > 1e-9, (a * b).sum(1) / np.maximum(length, 1e-9), np.nan))


def _cosine(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Array:
    """Compute the cosines (N, M) of all pairs of rows (N, E) and (M, E), NaN for rows of zeros."""
    if not a.shape[1]:
        return np.full((len(a), len(b)), np.nan)
    lengths = (np.sqrt((x * x).sum(1, keepdims=True)) for x in (a, b))
    a, b = (x / np.where(n > 1e-9, n, np.nan) for x, n in zip((a, b), lengths, strict=True))
    return np.asarray(a @ b.T)


# ---- Calibrated similarity ---------------------------------------------------------------------

# fraction of pairs of either kind that look like the other kind: no appearance counts more than log
# odds of 7, which position and overlap can contradict
OUTLIERS = 1e-3


class SimilarityCalibration:
    """Calibrate cosines of foreground and background to log odds of being one object.

    No threshold on a cosine transfers between videos, but every video contains unlabelled pairs of
    known kind: objects of a class side by side in a frame are different, views of a track belong to
    one object. The log similarity of foreground and background is measured from the midpoint of the
    means of the two kinds, in standard deviations, times 1 + the distance of the means: the
    evidence is stronger if they are far apart. The constants hold for every appearance model.

    Args:
        weight: pseudo-count of the usual mean and spread.
    Attributes:
        moments: (2, 3, 2) count, sum and sum of squares of the log similarity of foreground and
            background (last axis), of different and of same objects (first axis).
    """

    # fitted to 12 rendered rooms, with and without masks; the
    # weights lie between the fits of several embeddings (benchmarks/RESULTS.md)
    WEIGHTS = (0.55, 0.5)  # of foreground and background
    # mean log similarity of foreground and background: of different, of same objects
    USUAL = ((1.3, 0.65), (1.8, 1.2))
    USUAL_STD = 0.45  # of the log similarity within a kind
    ARRAYS = ("moments",)

    def __init__(self, weight: float = 10.0) -> None:
        mean = np.array(self.USUAL)  # (2, 2)
        self.moments = weight * np.stack([mean**0, mean, mean**2 + self.USUAL_STD**2], 1)

    @staticmethod
    def log_similarity(cosine: npt.ArrayLike) -> Array:
        """Compute -log(1.03 - cosine): monotone, steep for nearly equal views, at most 3.5."""
        return np.asarray(-np.log(1.03 - np.minimum(cosine, 1.0)))

    def add(self, foreground: Array, background: Array, same: bool) -> None:
        """Add the cosines of pairs (N,) of one kind; NaN: unknown."""
        value = self.log_similarity(np.stack([foreground.ravel(), background.ravel()]))  # (2, N)
        known = np.isfinite(value)
        value = np.where(known, value, 0.0)
        self.moments[int(same)] += [known.sum(1), value.sum(1), (value * value).sum(1)]

    def add_frame(self, foreground: Array, background: Array, class_id: IntArray) -> None:
        """Add all pairs of one class in a frame, cosines (n, n): the diagonal is one object."""
        same = np.eye(len(class_id), dtype=bool)
        other = (class_id[:, None] == class_id) & ~same
        self.add(foreground[same], background[same], True)
        self.add(foreground[other], background[other], False)

    def logit(
        self,
        foreground: npt.ArrayLike,
        background: npt.ArrayLike = np.nan,
        view_angle_deg: npt.ArrayLike = np.nan,
    ) -> Array:
        """Compute the log odds of being one object, for equal prior probabilities.

        They lie within about +-7, because a fraction OUTLIERS of the pairs may be outliers.

        Args:
            foreground, background: cosines; any shapes that broadcast. Without a background (NaN)
                the foreground decides; without a foreground the log odds are -inf.
            view_angle_deg: between the viewing rays. The weight of the foreground decreases with
                it; from 90 degrees on the background has no weight. NaN: as 45 degrees.
        """
        cosines = np.asarray(foreground), np.asarray(background)
        kind = np.result_type(*cosines)
        count, total, squares = self.moments.swapaxes(0, 1)  # (2, 2) each: kinds, parts
        mean = total / count
        std = np.sqrt((squares / count - mean**2).mean(0).clip(1e-3))  # (2,)
        middle = mean.mean(0)
        separation = 1 + ((mean[1] - mean[0]) / std).clip(0)
        usual_deg = 45.0  # between two views of unknown directions
        angle = np.radians(np.where(np.isnan(view_angle_deg), usual_deg, view_angle_deg))
        facing = ((1 + np.cos(angle)) / 2, np.cos(angle).clip(0))
        logit: Any = 0.0
        for k, cosine in enumerate(cosines):
            standard = (self.log_similarity(cosine.astype(kind)) - middle[k]) / std[k]
            score = facing[k] * standard * separation[k]
            logit = logit + self.WEIGHTS[k] * np.where(np.isnan(score), 0, score)
        logit = np.where(np.isnan(foreground), -np.inf, logit)
        # of a mixture of both kinds, in which OUTLIERS of either is like the other
        odds = np.exp(np.minimum(logit, 50))
        bounded = (odds + OUTLIERS) / (1 + OUTLIERS * odds)
        return np.asarray(np.where(odds > 0, np.log(bounded), -np.inf))


# prior odds that a new track is one given known object rather than a new one: fitted with WEIGHTS
# (with other embeddings 1.0 to 1.5: benchmarks/RESULTS.md)
RETURN_ODDS = 1.8


def match_probability(logit: Array, prior_odds: float = RETURN_ODDS) -> Array:
    """Compute the probability (N, M) that row and column are one object: o / (1 + o + o').

    o are the odds of the pair, o' those of the likeliest other pair of its row or column (a ratio
    test among look-alikes), and 1 is for no pair at all.

    Args:
        logit: (N, M) log odds of the pairs.
        prior_odds: of a given pair against none.
    """
    odds = prior_odds * np.exp(logit)
    rival = np.maximum(_best_other(odds), _best_other(odds.T).T)
    return np.asarray(odds / (odds + 1 + rival))


def _best_other(odds: Array) -> Array:
    """Return (N, M) the largest of the other entries of the row, 0 if there are none."""
    top = np.sort(np.pad(odds, ((0, 0), (2, 0))), 1)[:, -2:]  # (N, 2) second, best
    return np.where(odds == top[:, 1:], top[:, :1], top[:, 1:])
