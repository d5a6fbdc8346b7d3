"""Decide for every object of a map and of a recording: stayed, moved, gone, not seen, or new.

The decision is the most probable explanation of all objects at once. Each map object stayed, moved
or was taken away since it was last seen, with probabilities of its class; it is detected with its
own rate; and new objects of a class arrive as often as its objects are taken away. Axes: N objects
of the map, M of the recording, C classes. Lengths are metres, log probabilities are in nats.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment

from reobj.appearance.reid import SimilarityCalibration
from reobj.maps.fusion import Described, ObjectState, alignment_jacobian
from reobj.maps.visibility import Visibility
from reobj.types import Array, BoolArray, IntArray, unit_rows
from reobj.words import canonical, merged

# ---- Constants ----------------------------------------------------------------------------------
# Probabilities of a change hold for the usual time between two recordings, days to weeks. They are
# estimates, not measurements; an error by a factor of 2 shifts a decision by 0.7 nats.

# Probabilities that an object of a class stayed, moved within the room, was taken away
FATES = {
    (0.94, 0.04, 0.02): (
        "bed", "cabinet", "bookshelf", "sink", "toilet", "bathtub", "refrigerator",
        "oven", "stove", "washing machine", "dishwasher", "couch", "dining table", "desk",
        "counter", "door", "window",
    ),
    (0.65, 0.30, 0.05): ("chair", "stool", "armchair", "garbage bin"),
    (0.40, 0.35, 0.25): (
        "cup", "mug", "wine glass", "bottle", "bowl", "plate", "book", "laptop", "mouse", "remote",
        "cell phone", "backpack", "handbag", "bag", "umbrella", "scissors", "fork", "knife",
        "spoon", "shoe", "clothes", "banana", "apple", "orange",
    ),
}  # fmt: skip
FATE_OF = {name: fate for fate, names in FATES.items() for name in names}
USUAL_FATE = (0.75, 0.15, 0.10)  # of all other classes, also of unknown ones
# Of an object that was gone: it is back in its place, it is elsewhere in the room, it is still gone
ABSENT_FATE = (0.10, 0.20, 0.70)
NEW_OBJECTS = 1.0  # expected number, besides replacements of removed objects
DETECTED = 0.9  # probability that an object in a part of the room that was seen is found
MISSED_FLOOR = 1e-3  # least probability that an object is missed, whatever the number of views
POSITION_FLOOR_M = (
    0.02  # standard deviation of a centre besides its covariance: errors of the detector's boxes
)
# The same, as a fraction of the largest half axis: the centre of an object that is seen from one
# side shifts with its depth
EXTENT_SHARE = 0.05
# Standard deviation of the shorter half of the moves, on each axis; the others end anywhere
NEAR_MOVE_M = 0.5
# Objects with the expected displacement to which those that stayed are added when the variance of
# displacements is measured. (In three rendered pairs it was .04 of the expected one, in simulated
# rooms with known covariances 1.)
USUAL_STAYED = 1.0
VARIANCE_MARGIN = 2.0  # factor of that variance: its error, and tails heavier than normal
LEAST_MOVE_M = 0.1  # a shorter displacement counts as stayed, whatever its covariance
SIZE_FLOOR = 0.1  # standard deviation of a log half axis besides its covariance
# Standard deviation of a log half axis among objects of one class, with correlation 0.5 (as in the
# size priors of chairs and tables)
CLASS_SIZE = 0.25
SIZE_OUTLIERS = 0.02  # share of sizes that are wrong, e.g. of objects cut off by the image border
# Largest squared Mahalanobis distance of the sizes of a moved object (chi2 with 3 degrees of
# freedom, exceeded by one in 1000)
WORST_SIZE = 16.3
CLASS_KEPT = 0.95  # P(class recognised as before)
LEAST_CLASS_OVERLAP = 0.3  # least agreement of the class distributions of a moved object
APPEARANCE_LIMIT = 3.0  # nats, in either direction; the light may differ
# Least appearance log likelihood ratio of a moved object whose own points were not recognised, nats
LEAST_APPEARANCE = 0.0
# Log likelihood ratio per inlier of the object's own points, below and from ENOUGH_INLIERS on,
# which also give the displacement; INLIERS_LIMIT: the largest, nats. (Of pairs of objects of
# different classes, in three pairs of recordings and across them, none had a wrong motion.)
FEW_INLIERS = 0.25
MANY_INLIERS = 0.75
ENOUGH_INLIERS = 6
INLIERS_LIMIT = 15.0
MARGIN = 3.0  # nats (odds of 20), below which two explanations are equally probable
# Of two explanations that only the displacement distinguishes, the shorter one gives a number if
# the other one is longer by this factor
DISPLACEMENT_RATIO = 2.0
GONE_LOG_ODDS = -3.0  # below which an object that was not detected is gone
GIVEN = 1e6  # nats, of pairs that are given: more than all evidence


@dataclass(frozen=True, slots=True, eq=False)
class PointMotion:
    """Displacement of a map object, by its points recognised on an object of the recording.

    Attributes:
        inliers: different points of the map object that follow it. images: that agree on it.
        shift: (3,) of the centre of the map object; zeros: the points are where they were.
        cov: (3, 3) of the shift, without the uncertainty of the alignment of the recording.
    """

    inliers: int
    images: int
    shift: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class FoundObject(Described):
    """An object of the recording, in the world of the map.

    Attributes:
        views: detections. confidence: probability that it exists.
        motion_of: motions of map objects whose points were recognised on this object, by number.
    """

    views: int
    confidence: float
    motion_of: dict[int, PointMotion]

    def proven_motion(self, number: int) -> PointMotion | None:
        """Return the motion of a map object if enough points follow it to measure it."""
        motion = self.motion_of.get(number)
        return motion if motion is not None and motion.inliers >= ENOUGH_INLIERS else None


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What happened to an object of the map, or of the recording.

    Attributes:
        kind: "stayed", "moved", "gone", "not_seen" (objects of the map) or "new".
        map_id: number in the map; 0: new. found_id: identity in the recording; 0: not detected.
        candidates: other numbers of the map that are as probable within the margin.
        evidence: one sentence.
    """

    kind: str
    map_id: int
    found_id: int
    candidates: tuple[int, ...]
    evidence: str


def compare(
    states: Sequence[ObjectState],
    found: Sequence[FoundObject],
    visibility: Visibility,
    alignment_cov: Array,
    metres_per_unit: float,
    same_embedder: bool,
    known: Collection[int] = (),
) -> list[Decision]:
    """Decide what happened to each object, by one assignment over all of them.

    A number is given only if it exceeds every other explanation by a margin. The alignment of the
    recording is refined by the objects that stayed, within its covariance.

    Args:
        states: N objects of the map. found: M objects of the recording.
        alignment_cov: (7, 7) of rotation vector w, translation t and log scale s of the alignment:
            a point q of the recording lies at exp(s) exp([w]) q + t in the map, about its origin.
        metres_per_unit: of the world of the map (its best estimate if the scale is unknown).
        same_embedder: embeddings of map and recording come from one model.
        known: numbers of map objects that are the found objects of the same number.

    Returns:
        One decision per map object, in their order, then one per new object.
    """
    if not states and not found:
        return []
    likelihoods = _Likelihoods(states, found, visibility, known)
    likelihoods.place(alignment_cov, metres_per_unit)
    likelihoods.compare_appearance(same_embedder)
    return _Verdicts(likelihoods).decisions()


# ---- Likelihoods of pairs ------------------------------------------------------------------------


class _Likelihoods:
    """Log likelihoods of the pairs of map objects and found objects.

    Attributes:
        states, found, visibility: as in `compare`. known: (N, M) True for pairs that are given.
        overlap: (N, M) agreement of the class distributions, 0 to 1.
        class_score, size_score, points: (N, M) log likelihood terms of one identity;
            class_ratio: log likelihood ratio of the classes.
        appearance, appearance_there: (N, M) log likelihood ratios of the embeddings, without and
            with those of the background.
        own_recognised: (N, M) points of the map object itself overrule class, size and looks.
        size_square: (N, M) squared Mahalanobis distance of the sizes.
        by_center: (N, M) too few points were recognised to measure the displacement.
        distance, sigmas: (N, M) displacement in metres and in standard deviations, of the points or
            of the centres.
        position: (N, M) log density of the found centre if the object stayed.
        fate: (N, 3) probabilities: stayed, moved, taken away. missed: (N,) probability that an
            object in its place is not among the found ones. seen_there: (N,) log likelihood ratio
            of all detections, of an object in its place over its absence. reach: share of the room
            that was seen. room: its volume in cubic metres.
    """

    def __init__(
        self,
        states: Sequence[ObjectState],
        found: Sequence[FoundObject],
        visibility: Visibility,
        known: Collection[int],
    ) -> None:
        self.states = states
        self.found = found
        self.visibility = visibility
        shape = (len(states), len(found))
        given = [[s.id == f.id and s.id in known for f in found] for s in states]
        self.known = np.array(given, bool).reshape(shape)
        names = sorted({canonical(name) for o in (*states, *found) for name in o.classes} | {""})
        self.of_map = _class_shares(states, names)  # (N, C)
        of_found = _class_shares(found, names)  # (M, C)
        self.fate = self.of_map @ np.array([FATE_OF.get(name, USUAL_FATE) for name in names])
        self.fate[[not s.present for s in states]] = ABSENT_FATE
        expected = visibility.expected
        self.reach = DETECTED * ((expected > 0).sum() + 1) / (len(states) + 2)
        rate = np.array([s.detection_rate for s in states]).clip(0.05, 0.95)
        without = np.maximum(expected - visibility.unlocated, 0.5)  # views near the image border
        self.missed = ((1 - rate) ** without).clip(min=MISSED_FLOOR)
        self.seen_there = visibility.detected * np.log(rate) - visibility.accident
        self.seen_there += (expected - visibility.detected) * np.log(1 - rate)
        counts = self.of_map.sum(0) + of_found.sum(0) + 0.5
        frequency = counts / counts.sum()  # (C,)
        replaced = (self.of_map * self.fate[:, 2:]).sum(0)
        self.arriving = of_found @ (replaced + NEW_OBJECTS * frequency)  # (M,) expected of a class
        self.overlap = self.of_map @ of_found.T
        by_chance = of_found @ frequency
        self.class_score = np.log(CLASS_KEPT * self.overlap + (1 - CLASS_KEPT) * by_chance)
        self.class_ratio = self.class_score - np.log(by_chance)
        self.size_score, self.size_square = _size_agreement(states, found)
        motions = [[f.motion_of.get(s.id) for f in found] for s in states]
        inliers = np.array([[m.inliers if m else 0 for m in row] for row in motions], np.int64)
        inliers = inliers.reshape(shape)
        self.by_center = inliers < ENOUGH_INLIERS
        per_inlier = np.where(self.by_center, FEW_INLIERS, MANY_INLIERS)
        self.points = np.minimum(per_inlier * inliers, INLIERS_LIMIT)
        self.own_recognised = self.points >= MARGIN
        self.appearance = np.zeros(shape)
        self.appearance_there = np.zeros(shape)

    def place(self, alignment_cov: Array, metres_per_unit: float) -> None:
        """Compute displacements and position likelihoods, the alignment refined by what stayed."""
        unit = metres_per_unit
        to_metres = np.array([1.0, 1, 1, unit, unit, unit, 1])
        cov = prior = alignment_cov * np.outer(to_metres, to_metres)
        everything = (*self.states, *self.found)
        center = np.array([o.center for o in everything]) * unit
        center_cov = np.array([o.cov[:3, :3] for o in everything]) * unit**2
        floor = EXTENT_SHARE * np.array([np.max(o.half_axes) * unit for o in everything])
        self.room = float(np.prod(np.ptp(center, axis=0) + 1.0))
        n = len(self.states)
        variance = np.maximum(floor[:n, None], floor[n:]) ** 2 + POSITION_FLOOR_M**2
        own = center_cov[:n, None] + center_cov[None, n:] + variance[..., None, None] * np.eye(3)
        other = center[n:]
        between = other[None] - center[:n, None]  # (N, M, 3)
        for i, j in np.argwhere(~self.by_center).tolist():
            motion = self.found[j].motion_of[self.states[i].id]
            between[i, j] = motion.shift * unit
            own[i, j] = motion.cov * unit**2 + POSITION_FLOOR_M**2 * np.eye(3)
        update = np.zeros(7)
        for _ in range(3):
            jacobian = alignment_jacobian(other)  # (M, 3, 7)
            difference = between + jacobian @ update  # (N, M, 3)
            total = own + jacobian @ cov @ jacobian.swapaxes(1, 2)
            self.position, square = _log_normal(difference, total)
            self.distance = np.linalg.norm(difference, axis=2)
            rows, columns = self.known_stayed()
            # Shapes that one detector measures twice from similar places have errors in common, so
            # that they differ less than their covariances say. The median, as some may have moved;
            # 2.366: that of chi-squared with 3 degrees of freedom.
            stayed = square[rows, columns][self.by_center[rows, columns]]
            median = float(np.median(stayed)) / 2.366 if len(stayed) else 1.0
            measured = (len(stayed) * median + USUAL_STAYED) / (len(stayed) + USUAL_STAYED)
            ratio = np.where(self.by_center, min(VARIANCE_MARGIN * measured, 1.0), 1.0)
            self.position, square = _log_normal(difference, ratio[..., None, None] * total)
            self.sigmas = np.sqrt(square)
            if not len(rows):
                break
            # Kalman update of the alignment error by the displacements of K objects that stayed
            by_row = jacobian[columns].reshape(-1, 7)  # (3 K, 7)
            spread = by_row @ prior @ by_row.T + block_diag(*own[rows, columns])
            gain = np.linalg.solve(spread, by_row @ prior).T  # (7, 3 K)
            update = -gain @ between[rows, columns].ravel()
            cov = prior - gain @ by_row @ prior

    def known_stayed(self) -> tuple[IntArray, IntArray]:
        """Find pairs that stayed by geometry, size and class, without a rival on either side."""
        score = np.maximum(self.gain(self.stayed()), 0.0)
        mask = (score > MARGIN) & (self.overlap > LEAST_CLASS_OVERLAP)
        rival = np.maximum(_best_other(score), _best_other(score.T).T)
        rows, columns = np.nonzero(mask & (score > rival + MARGIN))
        return rows, columns

    def compare_appearance(self, same_embedder: bool) -> None:
        """Score the embeddings, calibrated by pairs of this map and this recording.

        The pairs that stayed by geometry are one object each; a member of one and a member of
        another of the same class are different objects.

        Map objects that look alike then get the recognised points of each other: the points of
        identical instances have the same descriptors, and show which model an object is, not which
        instance. The score of another object's points is reduced by the log probability that both
        are of one model; without embeddings, class and size decide.
        """
        calibration = SimilarityCalibration(weight=3.0)  # as much as three pairs of the recording
        if same_embedder:
            foreground = _cosines(self.states, self.found, "foreground")
            background = _cosines(self.states, self.found, "background")
            rows, columns = self.known_stayed()
            calibration.add(foreground[rows, columns], background[rows, columns], same=True)
            cross = np.ix_(rows, columns)
            other = (self.overlap[cross] > LEAST_CLASS_OVERLAP) & ~np.eye(len(rows), dtype=bool)
            calibration.add(foreground[cross][other], background[cross][other], same=False)
            self.appearance = _bounded(calibration.logit(foreground))
            self.appearance_there = _bounded(calibration.logit(foreground, background))
        logit = calibration.logit(_cosines(self.states, self.states, "foreground"))
        alike = np.where(np.isfinite(logit), -np.logaddexp(0, -logit), 0.0)  # (N, N)
        similar = self.of_map @ self.of_map.T >= LEAST_CLASS_OVERLAP
        similar &= _size_agreement(self.states, self.states)[1] <= WORST_SIZE
        alike[~similar] = -np.inf
        np.fill_diagonal(alike, 0.0)
        self.points = (alike[..., None] + self.points[None]).max(1, initial=-np.inf)

    @property
    def identity(self) -> Array:
        """(N, M) terms that do not depend on the place."""
        return np.asarray(self.class_score + self.size_score + self.points)

    def stayed(self) -> Array:
        """Return (N, M) log likelihoods that the object stayed and is the found one."""
        prior = np.log(self.fate[:, 0] * (1 - self.missed))
        known = self.position + self.identity + self.appearance_there
        return np.asarray(known + prior[:, None])

    def moved(self, near: bool) -> Array:
        """Return (N, M) log likelihoods that the object moved and is the found one.

        near: short moves are more probable; False: all places in the room are equal.
        """
        density = np.full(self.distance.shape, 1 / self.room)
        if near:
            normal = np.exp(-0.5 * (self.distance / NEAR_MOVE_M) ** 2)
            density = (density + normal / (2 * np.pi * NEAR_MOVE_M**2) ** 1.5) / 2
        confidence = np.array([f.confidence for f in self.found]).clip(0.05, 1.0)
        prior = np.log(self.fate[:, 1] * self.reach)
        score = np.log(density) + self.identity + self.appearance + prior[:, None]
        agrees = self.overlap >= LEAST_CLASS_OVERLAP
        agrees &= self.size_square <= WORST_SIZE
        agrees &= self.appearance >= LEAST_APPEARANCE
        agrees |= self.own_recognised | self.known
        return np.where(agrees, score + np.log(confidence), -np.inf)

    def gain(self, score: Array) -> Array:
        """Return (N, M) scores above the explanation that both objects are unmatched."""
        stay, move, away = self.fate.T
        undetected = np.log(stay * self.missed + move * (1 - self.reach) + away)  # (N,)
        new = np.log(self.arriving / self.room)  # (M,) density of new objects
        return np.asarray(score - (undetected[:, None] + new) + GIVEN * self.known)

    def there_log_odds(self) -> Array:
        """Return (N,) log odds that an object that was not found is in its place nonetheless."""
        stay, move, away = self.fate.T
        real = 1 / (1 + np.exp(-np.array([s.log_odds for s in self.states])))
        away = real * (move + away) + 1 - real
        missed = np.maximum(self.seen_there, np.log(MISSED_FLOOR))
        return np.asarray(np.log(real * stay / away) + missed)


def _class_shares(objects: Sequence[Described], names: list[str]) -> Array:
    """Return the class distributions (K, C); an object without classes has the class "".

    Args:
        names: (C,) canonical; the first one is "".
    """
    of_objects = [merged(o.classes) for o in objects]
    weights = np.array([[classes.get(n, 0.0) for n in names] for classes in of_objects])
    weights = weights.reshape(len(objects), len(names))
    weights[weights.sum(1) <= 0, 0] = 1.0
    return np.asarray(weights / weights.sum(1, keepdims=True))


def _sorted_sizes(objects: Sequence[Described]) -> tuple[Array, Array]:
    """Return log half axes (K, 3), ascending, and their covariances (K, 3, 3)."""
    log_half = np.log([o.half_axes for o in objects]).reshape(-1, 3)
    cov = np.array([o.cov[3:6, 3:6] for o in objects]).reshape(-1, 3, 3)
    order = np.argsort(log_half, axis=1)
    rows = np.arange(len(order))[:, None]
    return log_half[rows, order], cov[rows[..., None], order[:, :, None], order[:, None]]


def _size_agreement(
    states: Sequence[ObjectState], found: Sequence[Described]
) -> tuple[Array, Array]:
    """Compare sorted half axes.

    Returns:
        Log likelihood ratio (N, M) of one object over two objects of a class, and the squared
        Mahalanobis distance (N, M) of one object.
    """
    size, size_cov = _sorted_sizes(states)
    other, other_cov = _sorted_sizes(found)
    difference = other[None] - size[:, None]  # (N, M, 3)
    same = size_cov[:, None] + other_cov[None] + SIZE_FLOOR**2 * np.eye(3)
    two = same + CLASS_SIZE**2 * (np.eye(3) + 1)  # variance of a difference: twice
    same_log, square = _log_normal(difference, same)
    ratio = same_log - _log_normal(difference, two)[0]
    return np.log((1 - SIZE_OUTLIERS) * np.exp(ratio) + SIZE_OUTLIERS), square


def _log_normal(difference: Array, cov: Array) -> tuple[Array, Array]:
    """Return log densities and squared Mahalanobis distances (...) of differences (..., 3)."""
    solved = np.linalg.solve(cov, difference[..., None])[..., 0]
    square = (difference * solved).sum(-1)
    return -0.5 * (square + np.linalg.slogdet(cov)[1] + 3 * np.log(2 * np.pi)), square


def _bounded(logit: Array) -> Array:
    """Limit log odds of one object; 0 where an embedding is missing (-inf)."""
    limited = logit.clip(-APPEARANCE_LIMIT, APPEARANCE_LIMIT)
    return np.where(np.isfinite(logit), limited, 0.0)


def _cosines(states: Sequence[ObjectState], found: Sequence[Described], name: str) -> Array:
    """Return cosines (N, M) of unit embeddings; NaN where one is missing or of another width.

    Args:
        name: of the embeddings.
    """
    sides = [[getattr(o, name) for o in side] for side in (states, found)]
    width = max((len(x) for side in sides for x in side), default=0) or 1
    missing = np.full(width, np.nan, np.float32)
    rows = [np.array([x if len(x) == width else missing for x in side]) for side in sides]
    a, b = (unit_rows(side.reshape(-1, width)) for side in rows)
    return np.asarray(a @ b.T)


# ---- Assignment ----------------------------------------------------------------------------------


def _assigned(gain: Array) -> BoolArray:
    """Return (N, M) bool: the pairs of the best assignment; pairs without gain are left out."""
    mask = np.zeros(gain.shape, bool)
    mask[linear_sum_assignment(np.maximum(gain, 0), maximize=True)] = True
    return np.asarray(mask & (gain > 0))


def _regret(gain: Array) -> Array:
    """Return (N + 1, M + 1) the regret of forcing each pair, relative to the best assignment.

    The last row and column are "unmatched". Of pairs with a loss above the margin it is infinite.
    """

    def total(left: Array) -> float:
        return float(left[_assigned(left)].sum())

    best = total(gain)
    loss = np.full(np.add(gain.shape, 1), np.inf)
    for i, j in np.argwhere(gain > -MARGIN).tolist():
        loss[i, j] = best - gain[i, j] - total(np.delete(np.delete(gain, i, 0), j, 1))
    for axis, edge in enumerate((loss[:-1, -1], loss[-1, :-1])):
        edge[:] = [best - total(np.delete(gain, k, axis)) for k in range(len(edge))]
    return loss


def _best_other(score: Array) -> Array:
    """Return (N, M) the largest of the other entries of the row, 0 if there are none."""
    top = np.sort(np.pad(score, ((0, 0), (2, 0))), 1)[:, -2:]
    return np.where(score == top[:, 1:], top[:, :1], top[:, 1:])


class _Verdicts:
    """The best assignment, its rivals, and a decision for each object.

    Attributes:
        of: likelihoods. stayed, moved: (N, M) gains.
        far: (N, M) the larger one if all moves were equally probable: only the identity counts.
        loss: (N + 1, M + 1) see `_regret`. matched: (N, M) bool: pairs of the best assignment.
    """

    def __init__(self, likelihoods: _Likelihoods) -> None:
        self.of = likelihoods
        self.stayed = likelihoods.gain(likelihoods.stayed())
        self.moved = likelihoods.gain(likelihoods.moved(near=True))
        self.far = np.maximum(self.stayed, likelihoods.gain(likelihoods.moved(near=False)))
        best = np.maximum(self.stayed, self.moved)
        self.matched = _assigned(best)
        self.loss = _regret(best)

    def decisions(self) -> list[Decision]:
        """Return one decision per map object, then one per new object."""
        accepted = [self._matched(i, j) for i, j in np.argwhere(self.matched).tolist()]
        by_number = {d.map_id: d for d in accepted if d is not None}
        known = {d.found_id for d in by_number.values()}
        return [
            *(by_number.get(s.id) or self._undetected(i) for i, s in enumerate(self.of.states)),
            *(self._new(j) for j, f in enumerate(self.of.found) if f.id not in known),
        ]

    def _matched(self, i: int, j: int) -> Decision | None:
        """Decide about a pair of the best assignment; None: the evidence is too weak."""
        of = self.of
        there = bool(self.stayed[i, j] >= self.moved[i, j] or of.distance[i, j] < LEAST_MOVE_M)
        if there:  # rivals among map objects only: the displacement decided
            accepted = self.loss[-1, j] - self.loss[i, j] >= MARGIN
        else:  # looks and size alone gave three wrong numbers in eleven rendered pairs
            lead = np.delete(self.loss[i], j).min() - self.loss[i, j]  # over all found objects
            accepted = of.points[i, j] >= MARGIN and lead >= MARGIN and self._distinguished(i, j)
        if not (accepted or of.known[i, j]):
            return None
        number = of.states[i].id
        rivals = tuple(other for other in self._candidates(j) if other != number)
        kind = "stayed" if there else "moved"
        return Decision(kind, number, of.found[j].id, rivals, self._evidence(i, j, there))

    def _distinguished(self, i: int, j: int) -> bool:
        """Return whether identity, or a much shorter displacement, excludes the best rival."""
        without = self.far.copy()
        without[i, j] = -np.inf
        rival = _assigned(without)
        if self.far[self.matched].sum() - self.far[rival].sum() >= MARGIN:
            return True
        changed = self.matched.any(0) & rival.any(0) & (self.matched != rival).any(0)
        length = [(self.of.distance * mask)[:, changed].sum() for mask in (self.matched, rival)]
        return bool(length[1] >= DISPLACEMENT_RATIO * length[0])

    def _candidates(self, j: int) -> tuple[int, ...]:
        """Return the numbers that a found object may have, within the margin of the best one."""
        states = zip(self.of.states, self.loss[:-1, j], strict=True)
        return tuple(s.id for s, loss in states if loss < MARGIN)

    def _undetected(self, i: int) -> Decision:
        """Decide about a map object that was given no found object."""
        view = self.of.visibility
        expected = int(view.expected[i])
        through = int(view.seen_through[i])
        detected = round(view.detected[i])
        similar = np.flatnonzero((self.loss[i, :-1] < MARGIN) & (self.stayed[i] >= self.moved[i]))
        improbable = self.of.there_log_odds()[i] < GONE_LOG_ODDS
        gone = improbable and through > 0 and not len(similar)
        missed = f"not detected in {expected - detected} views"
        if view.vague[i]:
            evidence = "its position in the map is too uncertain"
        elif expected == 0:
            evidence = "no view passed its place"
        elif len(similar):
            evidence = f"object {self.of.found[similar[0]].id} near its place may be this one"
        elif detected and not gone:
            evidence = (
                f"detected on its place in {detected} of {expected} views, "
                "but none of the objects found is clearly this one"
            )
        elif through == 0:
            evidence = f"{missed}, but none shows what is behind it"
        else:
            result = "" if gone else ", which is too few to call it gone"
            evidence = f"{missed}, {through} of them through its place{result}"
        kind = "gone" if gone else "not_seen"
        return Decision(kind, self.of.states[i].id, 0, (), evidence)

    def _new(self, j: int) -> Decision:
        """Decide about a found object that was given no number."""
        evidence = "no object of the map explains it"
        if candidates := self._candidates(j):
            names = ", ".join(map(str, candidates))
            evidence = f"may be object {names} of the map; the evidence is too weak for a number"
        return Decision("new", 0, self.of.found[j].id, candidates, evidence)

    def _evidence(self, i: int, j: int, there: bool) -> str:
        """Describe why a pair is one object."""
        of = self.of
        terms = {
            "class": of.class_ratio,
            "size": of.size_score,
            "appearance": of.appearance_there if there else of.appearance,
        }
        text = ", ".join(f"{name} {value[i, j]:+.1f}" for name, value in terms.items())
        if motion := of.found[j].motion_of.get(of.states[i].id):
            text += f", {motion.inliers} of its points recognised in {motion.images} images"
            text += "" if of.by_center[i, j] else ", which give the displacement"
        place = f"{of.distance[i, j]:.2f} m from its place ({of.sigmas[i, j]:.1f} sigma)"
        return f"{place}; log likelihood ratios: {text}"
