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
from scipy.optimize import linear_sum_assignment

from reobj.appearance.reid import SimilarityCalibration
from reobj.maps.fusion import ObjectState
from reobj.types import Array, BoolArray, Floats, IntArray, unit_rows
from reobj.words import canonical, merged

IMPOSSIBLE = -1e9  # nats; finite, for the solver
GIVEN = 1e6  # nats, of pairs that are given: more than all evidence


@dataclass(frozen=True, slots=True, eq=False)
class PointMotion:
    """Rigid motion of a map object, by its points recognised on an object of the recording.

    Attributes:
        inliers: different points of the map object that follow it. images: that agree on it; 0:
            the last run found it, and the images are not read again.
        new_from_old: (3, 4), in the world of the map; the identity: the points are where they were.
        shift: (3,) of the centre of the map object. cov: (3, 3) of the shift, without the
            uncertainty of the alignment of the recording.
    """

    inliers: int
    images: int
    new_from_old: Array
    shift: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class FoundObject:
    """An object of the recording, in the world of the map.

    Attributes:
        id: identity in the recording. classes: weight of each class (sum of detection scores).
        support, center, half_axes, quat_wxyz, cov: shape as in `reobj.maps.room_map.Observation`.
        foreground, background: mean unit embeddings; empty: none.
        views: detections. confidence: probability that it exists.
        motion_of: motions of map objects whose points were recognised on this object, by number.
    """

    id: int
    classes: dict[str, float]
    support: str
    center: Array
    half_axes: Array
    quat_wxyz: Array
    cov: Array
    foreground: Floats
    background: Floats
    views: int
    confidence: float
    motion_of: dict[int, PointMotion]


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """How the cameras of the recording saw the places of the N objects of the map.

    Views less than 10 degrees apart fail together and count once.

    Attributes:
        expected: (N,) independent views in which the object would be in the image and unoccluded.
        seen_through: (N,) of those, views that show what is behind the object (sparse points on
            rays through its middle), or views besides a first one that show its surroundings.
        vague: (N,) the position in the map is too uncertain to know what a view shows; None: of
            no object.
        detected: (N,) of the expected ones, views in which a detection may show the object; a
            fraction if some of the views that count as one have one. None: none.
        accident: (N,) log probability that these detections lie there by accident; None: 0.
        unlocated: (N,) as `detected`, by detections that belong to no object of the recording.
    """

    expected: Array
    seen_through: Array
    vague: BoolArray | None = None
    detected: Array | None = None
    accident: Array | None = None
    unlocated: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What happened to an object of the map, or of the recording.

    Attributes:
        kind: "stayed", "moved", "gone", "not_seen" (objects of the map) or "new".
        map_id: number in the map; 0: new. found_id: identity in the recording; 0: not detected.
        log_odds: of this decision over the best other one, in nats.
        candidates: numbers of the map that are as probable within the margin.
        evidence: one sentence.
    """

    kind: str
    map_id: int
    found_id: int
    log_odds: float
    candidates: tuple[int, ...]
    evidence: str


@dataclass(frozen=True, slots=True)
class CompareOptions:
    """Numbers of the decision.

    Probabilities of a change hold for the usual time between two recordings, days to weeks. They
    were chosen, not measured; an error by a factor of 2 shifts a decision by 0.7 nats.

    Attributes:
        fixed, movable, carried: classes, lower case. All others, also unknown ones, are between
            fixed and movable.
        fixed_fate, usual_fate, movable_fate, carried_fate: probabilities that an object of the
            class stayed, moved within the room, was taken away.
        absent_fate: the same for an object that was gone: it is back in its place, it is elsewhere
            in the room, it is still gone.
        new_objects: expected new objects, besides those that replace what was taken away.
        detected: probability that an object in a part of the room that was seen is found.
        missed_floor: least probability that an object is missed, whatever the number of views.
        position_floor_m: standard deviation of a centre besides its covariance (2 cm: design).
        extent_share: the same, as a fraction of the largest half axis: the centre of an object
            that is seen from one side shifts with its depth.
        near_move_m: standard deviation of the shorter half of the moves, on each axis; the other
            half ends anywhere in the room.
        usual_stayed: number of objects with the expected displacement to which those that stayed
            are added when the variance of displacements is measured. (In three rendered pairs it
            was .04 of the expected one, in simulated rooms with known covariances 1.)
        variance_margin: factor of the measured variance: its error, and tails heavier than normal.
        least_move_m: a shorter displacement counts as stayed, whatever its covariance.
        size_floor: standard deviation of a log half axis besides its covariance.
        class_size: standard deviation of a log half axis among objects of one class, with
            correlation 0.5 (as in the size priors of chairs and tables).
        size_outliers: share of sizes that are wrong, e.g. of objects cut off by the image border.
        worst_size: largest squared Mahalanobis distance of the sizes of a moved object (3 degrees
            of freedom: 16.3 is exceeded by one in 1000).
        class_kept: probability that the class of an object is recognised as before.
        least_class_overlap: least agreement of the class distributions of a moved object.
        appearance_limit: largest weight of appearance in either direction, in nats; the light may
            differ.
        least_appearance: least appearance log likelihood ratio of a moved object whose own points
            were not recognised, in nats.
        few_inliers, many_inliers: log likelihood ratio per inlier of the object's own points, below
            and from `enough_inliers` on, which also give the displacement; `inliers_limit`: the
            largest, in nats. (Of pairs of objects of different classes, in three
            pairs of recordings and across them, none had a wrong motion.)
        margin: in nats, below which two explanations are equally probable (3: design).
        displacement_ratio: of two explanations that only the displacement distinguishes, the
            shorter one gives a number if the other one is longer by this factor.
        gone_log_odds: below which an object that was not detected is gone.
    """

    fixed: tuple[str, ...] = (
        "bed", "cabinet", "bookshelf", "sink", "toilet", "bathtub", "refrigerator",
        "oven", "stove", "washing machine", "dishwasher", "couch", "dining table", "desk",
        "counter", "door", "window",
    )  # fmt: skip
    movable: tuple[str, ...] = ("chair", "stool", "armchair", "garbage bin")
    carried: tuple[str, ...] = (
        "cup", "mug", "wine glass", "bottle", "bowl", "plate", "book", "laptop", "mouse", "remote",
        "cell phone", "backpack", "handbag", "bag", "umbrella", "scissors", "fork", "knife",
        "spoon", "shoe", "clothes", "banana", "apple", "orange",
    )  # fmt: skip
    fixed_fate: tuple[float, float, float] = (0.94, 0.04, 0.02)
    usual_fate: tuple[float, float, float] = (0.75, 0.15, 0.10)
    movable_fate: tuple[float, float, float] = (0.65, 0.30, 0.05)
    carried_fate: tuple[float, float, float] = (0.40, 0.35, 0.25)
    absent_fate: tuple[float, float, float] = (0.10, 0.20, 0.70)
    new_objects: float = 1.0
    detected: float = 0.9
    missed_floor: float = 1e-3
    position_floor_m: float = 0.02
    extent_share: float = 0.05
    near_move_m: float = 0.5
    usual_stayed: float = 1.0
    variance_margin: float = 2.0
    least_move_m: float = 0.1
    size_floor: float = 0.1
    class_size: float = 0.25
    size_outliers: float = 0.02
    worst_size: float = 16.3
    class_kept: float = 0.95
    least_class_overlap: float = 0.3
    appearance_limit: float = 3.0
    least_appearance: float = 0.0
    few_inliers: float = 0.25
    many_inliers: float = 0.75
    enough_inliers: int = 6
    inliers_limit: float = 15.0
    margin: float = 3.0
    displacement_ratio: float = 2.0
    gone_log_odds: float = -3.0

    def fate(self, class_name: str) -> tuple[float, float, float]:
        """Return the probabilities that an object of a class stayed, moved, was taken away."""
        name = canonical(class_name)
        if name in self.fixed:
            return self.fixed_fate
        if name in self.movable:
            return self.movable_fate
        return self.carried_fate if name in self.carried else self.usual_fate


def compare(
    states: Sequence[ObjectState],
    found: Sequence[FoundObject],
    visibility: Visibility,
    alignment_cov: Array,
    metres_per_unit: float,
    same_embedder: bool,
    options: CompareOptions | None = None,
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
    options = options or CompareOptions()
    pairs = _Pairs(states, found, visibility, options, known)
    pairs.place(alignment_cov, metres_per_unit)
    pairs.compare_appearance(same_embedder)
    return _Verdicts(pairs).decisions()


def no_visibility(count: int) -> Visibility:
    """Return the visibility of N objects that no view passed."""
    return Visibility(np.zeros(count), np.zeros(count))


# ---- Likelihoods of pairs ------------------------------------------------------------------------


class _Pairs:
    """Log likelihoods of the pairs of map objects and found objects.

    Attributes:
        states, found, visibility, options: as in `compare`.
        overlap: (N, M) agreement of the class distributions, 0 to 1.
        class_score, size_score, points: (N, M) log likelihood terms of one identity.
        appearance, appearance_there: (N, M) log likelihood ratios of the embeddings, without and
            with those of the background.
        inliers: (N, M) of the motion of the map object's own points on the found object.
        own_recognised: (N, M) they are enough to overrule class, size and looks.
        size_square: (N, M) squared Mahalanobis distance of the sizes.
        distance, sigmas: (N, M) displacement in metres and in standard deviations, of the points if
            enough were recognised, otherwise of the centres.
        position: (N, M) log density of the found centre if the object stayed.
        fate: (N, 3) probabilities: stayed, moved, taken away. missed: (N,) probability that an
            object in its place is not among the found ones. seen_there: (N,) log likelihood ratio
            of all detections, of an object in its place over its absence. reach: share of the room
            that was seen.
        room: volume of the room in cubic metres. known: (N, M) True for pairs that are given.
    """

    def __init__(
        self,
        states: Sequence[ObjectState],
        found: Sequence[FoundObject],
        visibility: Visibility,
        options: CompareOptions,
        known: Collection[int] = (),
    ) -> None:
        self.states = states
        self.found = found
        numbers = np.array([s.id if s.id in known else -1 for s in states], np.int64)
        self.known = numbers[:, None] == np.array([f.id for f in found], np.int64)
        self.visibility = visibility
        self.options = options
        self.names = class_names_of([*states, *found])
        self.of_map = class_shares(states, self.names)  # (N, C)
        self.of_found = class_shares(found, self.names)  # (M, C)
        fates = np.array([options.fate(name) for name in self.names])  # (C, 3)
        self.fate = self.of_map @ fates
        self.fate[[not s.present for s in states]] = options.absent_fate
        seen = visibility.expected > 0
        self.reach = options.detected * (seen.sum() + 1) / (len(states) + 2)
        rate = np.array([s.detection_rate for s in states]).clip(0.05, 0.95)
        none = np.zeros(len(states))
        unlocated = none if visibility.unlocated is None else visibility.unlocated
        without = np.maximum(visibility.expected - unlocated, 0.5)  # views near the image border
        self.missed = ((1 - rate) ** without).clip(min=options.missed_floor)
        detected = none if visibility.detected is None else visibility.detected
        accident = none if visibility.accident is None else visibility.accident
        self.seen_there = detected * np.log(rate) - accident
        self.seen_there += (visibility.expected - detected) * np.log(1 - rate)
        counts = self.of_map.sum(0) + self.of_found.sum(0) + 0.5
        self.frequency = counts / counts.sum()  # (C,)
        replaced = (self.of_map * self.fate[:, 2:]).sum(0)
        self.arrivals = replaced + options.new_objects * self.frequency  # (C,) expected
        self.overlap = self.of_map @ self.of_found.T
        confused = self.of_found @ self.frequency
        self.class_score = np.log(
            options.class_kept * self.overlap + (1 - options.class_kept) * confused
        )
        self.size_score, self.size_square = _size_agreement(states, found, options)
        self.inliers = np.zeros(self.overlap.shape, np.int64)
        for i, j in np.ndindex(self.inliers.shape):
            motion = found[j].motion_of.get(states[i].id)
            self.inliers[i, j] = 0 if motion is None else motion.inliers
        enough = self.inliers >= options.enough_inliers
        per_inlier = np.where(enough, options.many_inliers, options.few_inliers)
        self.points = np.minimum(per_inlier * self.inliers, options.inliers_limit)
        self.own_recognised = self.points >= options.margin
        self.appearance = np.zeros(self.overlap.shape)
        self.appearance_there = np.zeros(self.overlap.shape)

    def place(self, alignment_cov: Array, metres_per_unit: float) -> None:
        """Compute displacements and position likelihoods, the alignment refined by what stayed."""
        unit = metres_per_unit
        to_metres = np.array([1.0, 1, 1, unit, unit, unit, 1])
        cov = alignment_cov * np.outer(to_metres, to_metres)
        center, center_cov = _centers(self.states, unit)
        other, other_cov = _centers(self.found, unit)
        half_axes = [o.half_axes for o in self.states] + [o.half_axes for o in self.found]
        extents = [np.max(half) * unit for half in half_axes]
        floor = self.options.extent_share * np.array(extents)
        n = len(center)
        options = self.options
        variance = np.maximum(floor[:n, None], floor[None, n:]) ** 2 + options.position_floor_m**2
        own = center_cov[:, None] + other_cov[None] + variance[..., None, None] * np.eye(3)
        between = other[None] - center[:, None]  # (N, M, 3)
        for i, j in np.argwhere(self.inliers >= options.enough_inliers).tolist():
            motion = self.found[j].motion_of[self.states[i].id]
            between[i, j] = motion.shift * unit
            own[i, j] = motion.cov * unit**2 + options.position_floor_m**2 * np.eye(3)
        everything = np.concatenate([center, other])
        self.room = float(np.prod(np.ptp(everything, axis=0) + 1.0)) if len(everything) else 1.0
        update = np.zeros(7)
        for _ in range(3):
            jacobian = alignment_jacobian(other)  # (M, 3, 7)
            difference = between + jacobian @ update  # (N, M, 3)
            total = own + jacobian @ cov @ jacobian.swapaxes(1, 2)
            self.position, square = _log_normal(difference, total)
            self.distance = np.linalg.norm(difference, axis=2)
            rows, columns = self.known_stayed()
            by_center = self.inliers < options.enough_inliers
            ratio = self._variance_ratio(square[rows, columns][by_center[rows, columns]])
            total = np.where(by_center[..., None, None], ratio, 1.0) * total
            self.position, square = _log_normal(difference, total)
            self.sigmas = np.sqrt(square)
            if not len(rows):
                break
            update, cov = _refined_alignment(
                jacobian[columns], between[rows, columns], own[rows, columns],
                alignment_cov * np.outer(to_metres, to_metres),
            )  # fmt: skip

    def _variance_ratio(self, square: Array) -> float:
        """Return the variance of displacements of objects that stayed over the expected one.

        Shapes that one detector measures twice from similar places have errors in common, so that
        they differ less than their covariances say. The median, as some of them may have moved; at
        most 1.

        Args:
            square: (K,) squared Mahalanobis distances of objects that stayed, 3 coordinates each,
                by their centres.
        """
        prior = self.options.usual_stayed
        median = float(np.median(square)) / 2.366 if len(square) else 1.0  # of chi-squared with 3
        measured = (len(square) * median + prior) / (len(square) + prior)
        return min(self.options.variance_margin * measured, 1.0)

    def known_stayed(self) -> tuple[IntArray, IntArray]:
        """Find pairs that stayed by geometry, size and class, without a rival on either side."""
        score = np.maximum(self.gain(self.stayed()), 0.0)
        mask = (score > self.options.margin) & (self.overlap > self.options.least_class_overlap)
        rival = np.maximum(_best_other(score), _best_other(score.T).T)
        rows, columns = np.nonzero(mask & (score > rival + self.options.margin))
        return rows, columns

    def compare_appearance(self, same_embedder: bool) -> None:
        """Score the embeddings, calibrated by pairs of this map and this recording.

        The pairs that stayed by geometry are one object each; a member of one and a member of
        another of the same class are different objects.
        """
        calibration = SimilarityCalibration(weight=3.0)  # as much as three pairs of the recording
        if same_embedder:
            foreground = _cosines(
                [s.foreground for s in self.states], [f.foreground for f in self.found]
            )
            background = _cosines(
                [s.background for s in self.states], [f.background for f in self.found]
            )
            rows, columns = self.known_stayed()
            calibration.add(foreground[rows, columns], background[rows, columns], same=True)
            other = self.overlap[np.ix_(rows, columns)] > self.options.least_class_overlap
            other &= ~np.eye(len(rows), dtype=bool)
            cross = np.ix_(rows, columns)
            calibration.add(foreground[cross][other], background[cross][other], same=False)
            self.appearance = self._bounded(calibration.logit(foreground))
            self.appearance_there = self._bounded(calibration.logit(foreground, background))
        self._share_points(calibration)

    def _bounded(self, logit: Array) -> Array:
        """Limit log odds of one object; 0 where an embedding is missing (-inf)."""
        limit = self.options.appearance_limit
        return np.where(np.isfinite(logit), logit.clip(-limit, limit), 0.0)

    def _share_points(self, calibration: SimilarityCalibration) -> None:
        """Give map objects that look alike the recognised points of each other.

        The points of identical instances have the same descriptors: they show which model an object
        is, not which instance. The score of another object's points is reduced by the log
        probability that both are of one model; without embeddings, class and size decide.
        """
        options = self.options
        looks = [s.foreground for s in self.states]
        logit = calibration.logit(_cosines(looks, looks))
        alike = np.where(np.isfinite(logit), -np.logaddexp(0, -logit), 0.0)  # (N, N)
        similar = self.of_map @ self.of_map.T >= options.least_class_overlap
        similar &= _size_agreement(self.states, self.states, options)[1] <= options.worst_size
        alike[~similar] = -np.inf
        np.fill_diagonal(alike, 0.0)
        if len(alike):
            self.points = (alike[..., None] + self.points[None]).max(1)

    def identity(self) -> Array:
        """Return (N, M) the terms that do not depend on the place."""
        return np.asarray(self.class_score + self.size_score + self.points)

    def stayed(self) -> Array:
        """Return (N, M) log likelihoods that the object stayed and is the found one."""
        prior = np.log(self.fate[:, 0] * (1 - self.missed))
        known = self.position + self.identity() + self.appearance_there
        return np.asarray(known + prior[:, None])

    def moved(self, near: bool) -> Array:
        """Return (N, M) log likelihoods that the object moved and is the found one.

        near: short moves are more probable; False: all places in the room are equal.
        """
        options = self.options
        density = np.full(self.distance.shape, 1 / self.room)
        if near:
            sigma = options.near_move_m
            normal = np.exp(-0.5 * (self.distance / sigma) ** 2) / (2 * np.pi * sigma**2) ** 1.5
            density = (density + normal) / 2
        confidence = np.array([f.confidence for f in self.found]).clip(0.05, 1.0)
        prior = np.log(self.fate[:, 1] * self.reach)
        score = np.log(density) + self.identity() + self.appearance + prior[:, None]
        agrees = self.overlap >= options.least_class_overlap
        agrees &= self.size_square <= options.worst_size
        agrees &= self.appearance >= options.least_appearance
        return np.where(agrees | self.own_recognised, score + np.log(confidence), -np.inf)

    def recognised(self) -> BoolArray:
        """Mark the pairs (N, M) with own points, or points of an object that looks alike.

        (`few_inliers` give less than the margin.)
        """
        return np.asarray(self.points >= self.options.margin)

    def undetected(self) -> Array:
        """Return (N,) log probabilities that the object is not among the found ones."""
        stay, move, away = self.fate.T
        return np.asarray(np.log(stay * self.missed + move * (1 - self.reach) + away))

    def new(self) -> Array:
        """Return (M,) log densities of new objects of the class."""
        return np.asarray(np.log(self.of_found @ self.arrivals / self.room))

    def gain(self, score: Array) -> Array:
        """Return (N, M) scores above the explanation that both objects are unmatched."""
        unmatched = self.undetected()[:, None] + self.new()
        return np.asarray(score - unmatched + GIVEN * self.known)

    def there_log_odds(self) -> Array:
        """Return (N,) log odds that an object that was not found is in its place nonetheless."""
        stay, move, away = self.fate.T
        real = 1 / (1 + np.exp(-np.array([s.log_odds for s in self.states])))
        away = real * (move + away) + 1 - real
        missed = np.maximum(self.seen_there, np.log(self.options.missed_floor))
        return np.asarray(np.log(real * stay / away) + missed)


def class_names_of(objects: Sequence[ObjectState | FoundObject]) -> list[str]:
    """Return the canonical names (C) of the classes of objects, and "" first."""
    return sorted({canonical(name) for o in objects for name in o.classes} | {""})


def class_shares(objects: Sequence[ObjectState | FoundObject], names: list[str]) -> Array:
    """Return the class distributions (K, C); an object without classes has the class "".

    Args:
        names: of `class_names_of`.
    """
    of_objects = [merged(o.classes) for o in objects]
    weights = np.array([[classes.get(n, 0.0) for n in names] for classes in of_objects])
    weights = weights.reshape(len(objects), len(names))
    weights[weights.sum(1) <= 0, 0] = 1.0  # the first name is ""
    return np.asarray(weights / weights.sum(1, keepdims=True))


def _sorted_sizes(objects: Sequence[ObjectState | FoundObject]) -> tuple[Array, Array]:
    """Return log half axes (K, 3), ascending, and their covariances (K, 3, 3)."""
    log_half = np.log([o.half_axes for o in objects]).reshape(-1, 3)
    cov = np.array([o.cov[3:6, 3:6] for o in objects]).reshape(-1, 3, 3)
    order = np.argsort(log_half, axis=1)
    rows = np.arange(len(order))[:, None]
    return log_half[rows, order], cov[rows[..., None], order[:, :, None], order[:, None]]


def _size_agreement(
    states: Sequence[ObjectState],
    found: Sequence[ObjectState | FoundObject],
    options: CompareOptions,
) -> tuple[Array, Array]:
    """Compare sorted half axes.

    Returns:
        Log likelihood ratio (N, M) of one object over two objects of a class, and the squared
        Mahalanobis distance (N, M) of one object.
    """
    size, size_cov = _sorted_sizes(states)
    other, other_cov = _sorted_sizes(found)
    difference = other[None] - size[:, None]  # (N, M, 3)
    same = size_cov[:, None] + other_cov[None] + options.size_floor**2 * np.eye(3)
    two = same + options.class_size**2 * (np.eye(3) + 1)  # variance of a difference: twice
    same_log, square = _log_normal(difference, same)
    ratio = same_log - _log_normal(difference, two)[0]
    share = options.size_outliers
    return np.log((1 - share) * np.exp(ratio) + share), square


def _centers(objects: Sequence[ObjectState | FoundObject], unit: float) -> tuple[Array, Array]:
    """Return centres (K, 3) in metres and their covariances (K, 3, 3)."""
    center = np.array([o.center for o in objects]).reshape(-1, 3) * unit
    cov = np.array([o.cov[:3, :3] for o in objects]).reshape(-1, 3, 3) * unit**2
    return center, cov


def _log_normal(difference: Array, cov: Array) -> tuple[Array, Array]:
    """Return log densities and squared Mahalanobis distances (...) of differences (..., 3)."""
    solved = np.linalg.solve(cov, difference[..., None])[..., 0]
    square = (difference * solved).sum(-1)
    return -0.5 * (square + np.linalg.slogdet(cov)[1] + 3 * np.log(2 * np.pi)), square


def alignment_jacobian(point: Array) -> Array:
    """Return (M, 3, 7) derivatives of points by rotation vector, translation and log scale."""
    x, y, z = point.T
    zero = np.zeros_like(x)
    rotation = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)
    translation = np.broadcast_to(np.eye(3), (len(point), 3, 3))
    return np.concatenate([rotation, translation, point[:, :, None]], axis=2)


def _refined_alignment(
    jacobian: Array, difference: Array, noise: Array, prior: Array
) -> tuple[Array, Array]:
    """Fit the alignment error (7,) to K displacements of objects that stayed (Kalman update).

    Args:
        jacobian: (K, 3, 7). difference: (K, 3) found minus map. noise: (K, 3, 3). prior: (7, 7).

    Returns:
        Correction of the found centres, and its covariance (7, 7).
    """
    rows = jacobian.reshape(-1, 7)
    total = rows @ prior @ rows.T
    for k, block in enumerate(noise):
        total[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
    weight = np.linalg.solve(total, rows @ prior).T  # (7, 3 K)
    return -weight @ difference.ravel(), prior - weight @ rows @ prior


def _cosines(a: Sequence[Floats], b: Sequence[Floats]) -> Array:
    """Return cosines (N, M) of unit embeddings; NaN where one is missing or of another width."""
    width = max((len(x) for x in (*a, *b)), default=0)
    known = [np.array([len(x) == width and width > 0 for x in side], bool) for side in (a, b)]
    rows = [
        unit_rows(np.array([x if len(x) == width else np.zeros(width) for x in side]))
        for side in (a, b)
    ]
    cosine = rows[0].reshape(len(a), width) @ rows[1].reshape(len(b), width).T
    return np.where(known[0][:, None] & known[1], cosine, np.nan)


# ---- Assignment ----------------------------------------------------------------------------------


def _assigned(gain: Array) -> BoolArray:
    """Return (N, M) bool: the pairs of the best assignment; pairs without gain are left out."""
    mask = np.zeros(gain.shape, bool)
    mask[linear_sum_assignment(np.maximum(gain, 0), maximize=True)] = True
    return np.asarray(mask & (gain > 0))


def _losses(gain: Array, pairs: BoolArray) -> Array:
    """Return (N + 1, M + 1) what the best assignment with each pair is worse by than `pairs`.

    The last row and column stand for "unmatched". A forced pair displaces others along a cycle of
    the residual graph: the shortest paths of all pairs give the cheapest cycle of each.
    """
    n, m = gain.shape
    score = np.zeros((n + m, n + m))
    score[:n, :m] = np.maximum(gain, IMPOSSIBLE)
    column = np.full(n + m, -1)
    column[:n] = m + np.arange(n)
    rows, columns = np.nonzero(pairs)
    column[rows] = columns
    free = np.flatnonzero(~pairs.any(0))
    column[n + free] = free
    column[column < 0] = np.setdiff1d(np.arange(n + m), column)
    edge = score[np.arange(n + m), column][:, None] - score[:, column]
    path = edge.copy()
    for k in range(n + m):
        path = np.minimum(path, path[:, k, None] + path[k])
    loss = np.empty_like(edge)
    loss[:, column] = edge + path.T
    result = np.zeros((n + 1, m + 1))
    result[:n, :m] = loss[:n, :m]
    result[:n, m] = loss[:n, m:].min(1, initial=np.inf)
    result[n, :m] = loss[n:, :m].min(0, initial=np.inf)
    return result


def _best_other(score: Array) -> Array:
    """Return (N, M) the largest of the other entries of the row, 0 if there are none."""
    top = np.sort(np.pad(score, ((0, 0), (2, 0))), 1)[:, -2:]
    return np.where(score == top[:, 1:], top[:, :1], top[:, 1:])


class _Verdicts:
    """The best assignment, its rivals, and a decision for each object.

    Attributes:
        stayed, moved: (N, M) gains. near: (N, M) the larger one. far: the same if all moves were
            equally probable: only the identity counts.
        loss: (N + 1, M + 1) see `_losses`. matched: (N, M) bool: pairs of the best assignment.
    """

    def __init__(self, pairs: _Pairs) -> None:
        self.pairs = pairs
        self.options = pairs.options
        self.stayed = pairs.gain(pairs.stayed())
        self.moved = pairs.gain(pairs.moved(near=True))
        self.near = np.maximum(self.stayed, self.moved)
        self.far = np.maximum(self.stayed, pairs.gain(pairs.moved(near=False)))
        best = _assigned(self.near)
        self.loss = _losses(self.near, best)
        self.matched = best

    def decisions(self) -> list[Decision]:
        """Return one decision per map object, then one per new object."""
        accepted = [self._matched(i, j) for i, j in np.argwhere(self.matched).tolist()]
        by_state = {d.map_id: d for d in accepted if d is not None}
        known = {d.found_id for d in by_state.values()}
        of_map = [
            by_state.get(s.id) or self._undetected(i) for i, s in enumerate(self.pairs.states)
        ]
        new = [self._new(j) for j, f in enumerate(self.pairs.found) if f.id not in known]
        return [*of_map, *new]

    def _lead(self, i: int, j: int) -> float:
        """Return how much a pair is better than all others of the map object, in nats."""
        return float(np.delete(self.loss[i], j).min() - self.loss[i, j])

    def _matched(self, i: int, j: int) -> Decision | None:
        """Decide about a pair of the best assignment; None: the evidence is too weak."""
        state = self.pairs.states[i]
        found = self.pairs.found[j]
        lead = self._lead(i, j)
        there = bool(
            self.stayed[i, j] >= self.moved[i, j]
            or self.pairs.distance[i, j] < self.options.least_move_m
        )
        if there:
            # rivals among map objects only: the displacement decided
            accepted = self.loss[-1, j] - self.loss[i, j] >= self.options.margin
        else:  # looks and size alone gave three wrong numbers in eleven rendered pairs
            proven = bool(self.pairs.recognised()[i, j])
            accepted = proven and lead >= self.options.margin and self._distinguished(i, j)
        if not (accepted or self.pairs.known[i, j]):
            return None
        odds = min(lead, abs(float(self.stayed[i, j] - self.moved[i, j])))
        kind = "stayed" if there else "moved"
        rivals = self._candidates(j, besides=i)
        return Decision(kind, state.id, found.id, odds, rivals, self._evidence(i, j, there))

    def _distinguished(self, i: int, j: int) -> bool:
        """Return whether identity, or a much shorter displacement, excludes the best rival."""
        rival = _without(self.far, i, j)
        if self.far[self.matched].sum() - self.far[rival].sum() >= self.options.margin:
            return True
        both = self.matched.any(0) & rival.any(0)
        changed = both & (self.matched != rival).any(0)
        length = [(self.pairs.distance * mask)[:, changed].sum() for mask in (self.matched, rival)]
        return bool(length[1] >= self.options.displacement_ratio * length[0])

    def _candidates(self, j: int, besides: int = -1) -> tuple[int, ...]:
        """Return the numbers that a found object may have, within the margin of the best one."""
        rows = np.flatnonzero(self.loss[:-1, j] < self.options.margin).tolist()
        return tuple(self.pairs.states[i].id for i in rows if i != besides)

    def _undetected(self, i: int) -> Decision:
        """Decide about a map object that was given no found object."""
        state = self.pairs.states[i]
        view = self.pairs.visibility
        expected, through = (int(v[i]) for v in (view.expected, view.seen_through))
        detected = 0 if view.detected is None else round(view.detected[i])
        missed = expected - detected
        there = float(self.pairs.there_log_odds()[i])
        similar = np.flatnonzero(
            (self.loss[i, :-1] < self.options.margin) & (self.stayed[i] >= self.moved[i])
        )
        gone = there < self.options.gone_log_odds and through > 0 and not len(similar)
        if view.vague is not None and view.vague[i]:
            evidence = "its position in the map is too uncertain"
        elif expected == 0:
            evidence = "no view passed its place"
        elif len(similar):
            found = self.pairs.found[int(similar[0])]
            evidence = f"object {found.id} near its place may be this one"
        elif detected and not gone:
            evidence = (
                f"detected on its place in {detected} of {expected} views, "
                "but none of the objects found is clearly this one"
            )
        elif through == 0:
            evidence = f"not detected in {missed} views, but none shows what is behind it"
        else:
            result = "" if gone else ", which is too few to call it gone"
            evidence = (
                f"not detected in {missed} views, {through} of them through its place{result}"
            )
        kind = "gone" if gone else "not_seen"
        return Decision(kind, state.id, 0, -there if gone else there, (), evidence)

    def _new(self, j: int) -> Decision:
        """Decide about a found object that was given no number."""
        candidates = self._candidates(j)
        found = self.pairs.found[j]
        if candidates:
            names = ", ".join(map(str, candidates))
            evidence = f"may be object {names} of the map; the evidence is too weak for a number"
        else:
            evidence = "no object of the map explains it"
        lead = float(np.min(self.loss[:-1, j], initial=99.0))
        return Decision("new", 0, found.id, lead, candidates, evidence)

    def _evidence(self, i: int, j: int, there: bool) -> str:
        """Describe why a pair is one object."""
        pairs = self.pairs
        appearance = (pairs.appearance_there if there else pairs.appearance)[i, j]
        terms = {
            "class": pairs.class_score[i, j] - np.log(pairs.of_found[j] @ pairs.frequency),
            "size": pairs.size_score[i, j],
            "appearance": appearance,
        }
        text = ", ".join(f"{name} {value:+.1f}" for name, value in terms.items())
        motion = pairs.found[j].motion_of.get(pairs.states[i].id)
        own = ""
        if motion is not None:
            own = f", {motion.inliers} of its points recognised in {motion.images} images"
            if not motion.images:
                own = ", its points were recognised in the last run"
            if motion.inliers >= self.options.enough_inliers:
                own += ", which give the displacement"
        place = f"{pairs.distance[i, j]:.2f} m from its place ({pairs.sigmas[i, j]:.1f} sigma)"
        return f"{place}; log likelihood ratios: {text}{own}"


def _without(gain: Array, i: int, j: int) -> BoolArray:
    """Return the best assignment without the pair i, j."""
    gain = gain.copy()
    gain[i, j] = -np.inf
    return _assigned(gain)
