"""Align a recording with a map by objects alone, where features match too few points.

The directions of gravity are known, so that yaw, scale and a shift remain. Two correspondences of
objects of one class determine them: all are tried (exhaustive, as at most 40 objects are used). A
hypothesis is rated by the objects that coincide, one to one. It is accepted if neither another
place in the map nor the mirror image of the recording has nearly as many: no map shows a mirror
image of its room, so that this number is what chance gives.

Axes: M objects of the recording, N of the map, H hypotheses, C classes. Lengths are metres, each by
the estimate of the scale of its side, in upright axes (z up).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.appearance.reid import SimilarityCalibration
from reobj.maps.placement import about_origin
from reobj.types import Array, BoolArray, Floats, IntArray


@dataclass(frozen=True, slots=True)
class AlignmentOptions:
    """When a recording is aligned by objects.

    Attributes:
        most: objects of each side, those with the smallest uncertainty; time grows with its square.
        hypotheses: of two correspondences, those whose yaw is most certain (of
            20 objects of eight classes there are 500; some are left out with many of one class).
        common: least number of objects of each side (simulated: of 5 objects, a quarter changed, 4
            to 7 in 100 are wrong).
        least: objects that coincide (of 8, a quarter changed).
        margin: by which they exceed those of any other place, and of the mirror image.
        share: least fraction of the objects of the map in view that coincide.
        elsewhere_m, elsewhere_rad: median distance of the objects, and difference of yaw, of
            another place. An object whose position has a larger sigma is not used.
        gate: largest squared Mahalanobis distance of centre and size (4 degrees of freedom: one in
            100 exceeds it).
        chance: log likelihood ratio over an object anywhere in the room, in nats, above which two
            objects coincide (3: the margin of `CompareOptions`).
        floor_m, extent_share: standard deviation of a centre besides its covariance, and the same
            as a fraction of the mean half axis (as in `CompareOptions`).
        size_floor: standard deviation of the mean log half axis besides its covariance.
        tilt_rad: standard deviation of the angle between the two verticals (2 degrees each).
        scale_floor: standard deviation of the log scale besides its uncertainty.
        overlap: least agreement of the class distributions (as in `CompareOptions`).
        looks: largest weight of appearance in either direction, in nats (as in `CompareOptions`).
    """

    most: int = 40
    hypotheses: int = 20_000
    common: int = 8
    least: int = 6
    margin: int = 2
    share: float = 0.5
    elsewhere_m: float = 0.5
    elsewhere_rad: float = 0.3
    gate: float = 13.3
    chance: float = 3.0
    floor_m: float = 0.02
    extent_share: float = 0.05
    size_floor: float = 0.1
    tilt_rad: float = 0.05
    scale_floor: float = 0.02
    overlap: float = 0.3
    looks: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Objects of the map or of a recording.

    Attributes:
        center: (K, 3). cov: (K, 3, 3). classes: (K, C) shares. log_size: (K,) mean log half axis.
        log_size_var: (K,). looks: (K, E) unit embeddings, NaN: none.
    """

    center: Array
    cov: Array
    classes: Array
    log_size: Array
    log_size_var: Array
    looks: Floats

    def __len__(self) -> int:
        return len(self.center)

    def __getitem__(self, rows: IntArray | BoolArray) -> Landmarks:
        """Select objects."""
        return Landmarks(*(getattr(self, f.name)[rows] for f in dataclasses.fields(self)))

    def mirrored(self) -> Landmarks:
        """Return the mirror image, x -> -x."""
        flip = np.array([-1.0, 1, 1])
        return dataclasses.replace(
            self, center=self.center * flip, cov=self.cov * np.outer(flip, flip)
        )


@dataclass(frozen=True, slots=True, eq=False)
class ObjectAlignment:
    """The place of a recording in a map by objects.

    Attributes:
        pairs: (K, 2) rows of the recording and of the map that coincide. rival, mirror: number of
            objects that coincide in the best other place, and in the best one of the mirror image.
        scale, rotation, shift: x_map = scale * rotation @ x + shift, upright axes, metres.
        cov: (7, 7) of (rotation vector, shift, log scale) of a transform applied after it.
        reason: why it is refused; "": it is not.
    """

    pairs: IntArray
    rival: int = 0
    mirror: int = 0
    scale: float = 1.0
    rotation: Array = dataclasses.field(default_factory=lambda: np.eye(3))
    shift: Array = dataclasses.field(default_factory=lambda: np.zeros(3))
    cov: Array = dataclasses.field(default_factory=lambda: np.zeros((7, 7)))
    reason: str = ""


def align(
    of_map: Landmarks,
    found: Landmarks,
    scale_sigma: float,
    options: AlignmentOptions | None = None,
) -> ObjectAlignment:
    """Align a recording with a map.

    Args:
        of_map, found: objects of the map and of the recording.
        scale_sigma: standard deviation of the log of the ratio of both scales; infinite: unknown.
    """
    options = options or AlignmentOptions()
    rows = _certain(found, options)
    map_rows = _certain(of_map, options)
    none = ObjectAlignment(np.empty((0, 2), np.int64))
    if min(len(rows), len(map_rows)) < options.common:
        reason = (
            f"{len(rows)} of the objects of the recording and {len(map_rows)} of those of the map "
            f"are located within {options.elsewhere_m:g} m, {options.common} of each are needed"
        )
        return dataclasses.replace(none, reason=reason)
    scale_sigma = float(np.hypot(scale_sigma, options.scale_floor))
    search = _Search(of_map[map_rows], found[rows], scale_sigma, options)
    best, partner, rival = search.best()
    flipped = _Search(of_map[map_rows], found[rows].mirrored(), scale_sigma, options)
    _, flipped_partner, _ = flipped.best()
    mirror = int((flipped_partner >= 0).sum())
    a = np.flatnonzero(partner >= 0)
    if len(a) < 2:
        return dataclasses.replace(none, reason="no two objects coincide with the map")
    pairs = np.column_stack([rows[a], map_rows[partner[a]]])
    aligned = _least_squares(of_map[pairs[:, 1]], found[pairs[:, 0]], best, scale_sigma, options)
    reason = ""
    needed = max(options.least, max(rival, mirror) + options.margin)
    if len(pairs) < needed:
        reason = (
            f"{len(pairs)} objects coincide with the map, {rival} in another place and {mirror} in "
            f"a mirror image, {needed} are needed"
        )
    return dataclasses.replace(aligned, pairs=pairs, rival=rival, mirror=mirror, reason=reason)


def _certain(objects: Landmarks, options: AlignmentOptions) -> IntArray:
    """Return the rows of the objects whose position is certain enough to distinguish places."""
    sigma = np.sqrt(np.trace(objects.cov, axis1=1, axis2=2) / 3)
    order = np.argsort(sigma, kind="stable")[: options.most]  # NaN: last
    return np.sort(order[sigma[order] < options.elsewhere_m])


# ---- Hypotheses --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """H hypotheses; horizontal coordinates x + iy are complex: xy_map = turn * xy + shift.

    Attributes:
        turn: (H,) scale * exp(i yaw). shift: (H,). lift: (H,) z_map = |turn| * z + lift.
    """

    turn: Array
    shift: Array
    lift: Array

    def __len__(self) -> int:
        return len(self.turn)

    def __getitem__(self, rows: IntArray | BoolArray | slice) -> _Places:
        """Select hypotheses."""
        return _Places(self.turn[rows], self.shift[rows], self.lift[rows])


class _Search:
    """The hypotheses for two sets of objects, and the objects that coincide in each.

    Args:
        scale_sigma: of the log of the ratio of the two scales; infinite: unknown.
    """

    FIRST_VAR = 0.05  # m^2: of a coordinate in a place by two objects, before it is fitted

    def __init__(
        self, of_map: Landmarks, found: Landmarks, scale_sigma: float, options: AlignmentOptions
    ) -> None:
        self.options = options
        self.scale_sigma = scale_sigma
        self.xy = found.center[:, 0] + 1j * found.center[:, 1]  # (M,)
        self.z = found.center[:, 2]
        self.map_xy = of_map.center[:, 0] + 1j * of_map.center[:, 1]  # (N,)
        self.map_z = of_map.center[:, 2]
        var = _variances(found, options)[:, None] + _variances(of_map, options)  # (M, N, 2)
        self.across = var[..., 0]  # of a horizontal coordinate
        self.high = var[..., 1]
        self.alike = found.classes @ of_map.classes.T >= options.overlap  # (M, N)
        self.size = of_map.log_size - found.log_size[:, None]
        self.size_var = of_map.log_size_var + found.log_size_var[:, None] + options.size_floor**2
        self.looks = np.zeros(self.alike.shape)  # log likelihood ratio
        if found.looks.shape[1]:
            cosine = np.asarray(found.looks @ of_map.looks.T, np.float64)
            logit = SimilarityCalibration(weight=3.0).logit(cosine)
            known = np.isfinite(logit)
            self.looks[known] = logit[known].clip(-options.looks, options.looks)
        self.room = float((np.ptp(of_map.center, axis=0) + 1.0).prod())  # m^3

    def best(self) -> tuple[_Places, IntArray, int]:
        """Return the best place, the object of the map that each object coincides with, a rival.

        Returns:
            one place; (M,) rows of the map or -1; the number in the best other place.
        """
        places, score = self._of_pairs()
        if not len(places):
            return places, np.full(len(self.xy), -1), 0
        order = np.argsort(-score, kind="stable")
        tops, gain, partner = self._refined(places[order[:100]])
        count = (partner >= 0).sum(1)
        first = np.lexsort((-gain, -count))[:1]
        best = tops[first]
        others = order[self._elsewhere(places[order], best)][:300]
        rivals, _, rival_partner = self._refined(places[others])
        rival_count = (rival_partner >= 0).sum(1)[self._elsewhere(rivals, best)]
        return best, partner[first[0]], int(rival_count.max(initial=0))

    def _of_pairs(self) -> tuple[_Places, Array]:
        """Return the places in which two objects coincide, and the score of each (H,)."""
        i, k = np.nonzero(self.alike)
        one, other = np.nonzero(np.triu((i[:, None] != i) & (k[:, None] != k)))
        a = self.xy[i[other]] - self.xy[i[one]]
        b = self.map_xy[k[other]] - self.map_xy[k[one]]
        rise = self.z[i[other]] - self.z[i[one]]
        map_rise = self.map_z[k[other]] - self.map_z[k[one]]
        across = self.across[i, k]
        high = self.high[i, k]
        var = across[one] + across[other]  # of a coordinate of b - turn * a
        length = np.minimum(abs(a), abs(b))
        usable = var < (self.options.elsewhere_rad * length) ** 2  # the yaw is known
        one = one[usable]
        other = other[usable]
        a = a[usable]
        b = b[usable]
        rise = rise[usable]
        map_rise = map_rise[usable]
        var = var[usable]
        length = length[usable]
        turn = b / a
        scale = abs(turn)
        off_scale = np.log(scale) ** 2 / (self.scale_sigma**2 + var / length**2)
        off_high = (map_rise - scale * rise) ** 2
        off_high /= high[one] + high[other] + (self.options.tilt_rad * abs(b)) ** 2
        good = np.flatnonzero((off_scale < 9) & (off_high < 9))  # 3 sigma
        certain = np.argsort(var[good] / length[good] ** 2, kind="stable")
        good = good[certain[: self.options.hypotheses]]
        one = one[good]
        other = other[good]
        turn = turn[good]
        shift = self.map_xy[k[one]] - turn * self.xy[i[one]]
        lift = self.map_z[k[one]] + self.map_z[k[other]]
        lift = (lift - abs(turn) * (self.z[i[one]] + self.z[i[other]])) / 2
        places = _Places(turn, shift, lift)
        score = np.zeros(len(places))
        step = max(1, 1_000_000 // self.alike.size)  # memory
        for start in range(0, len(places), step):
            rows = slice(start, start + step)
            first = self.xy[i[one[rows]], None]
            along = (self.xy - first) / (self.xy[i[other[rows]], None] - first)  # (h, M) complex
            own = abs(1 - along) ** 2 * across[one[rows], None]
            own += abs(along) ** 2 * across[other[rows], None]
            score[rows] = self._rated(places[rows], own)[0]
        return places, score

    def _rated(self, places: _Places, own: Array) -> tuple[Array, IntArray]:
        """Rate H places by the objects that coincide.

        Args:
            own: (H, M) variance of a coordinate of the objects by the error of the place.
        Returns:
            (H,) sum of log likelihood ratios over objects anywhere in the room, each less `chance`.
            (H, M) row of the map that coincides, or -1; one to one.
        """
        scale = abs(places.turn)[:, None]
        xy = places.turn[:, None] * self.xy + places.shift[:, None]  # (H, M)
        z = scale * self.z + places.lift[:, None]
        tilt = (self.options.tilt_rad * scale * abs(self.xy - self.xy.mean())) ** 2
        across = self.across + own[:, :, None]  # (H, M, N)
        high = self.high + (own + tilt)[:, :, None]
        off = abs(xy[:, :, None] - self.map_xy) ** 2 / across
        off += (z[:, :, None] - self.map_z) ** 2 / high
        gain = np.log(self.room) - 0.5 * off - np.log(across) - 0.5 * np.log(high)
        gain += self.looks - 1.5 * np.log(2 * np.pi) - self.options.chance
        off += (self.size - np.log(scale)[:, :, None]) ** 2 / self.size_var
        gain = np.where(self.alike & (off < self.options.gate), gain, 0.0).clip(min=0)
        partner = gain.argmax(2)  # (H, M)
        mutual = np.take_along_axis(gain.argmax(1), partner, 1) == np.arange(len(self.xy))
        value = np.take_along_axis(gain, partner[:, :, None], 2)[:, :, 0]
        mutual &= value > 0
        return (value * mutual).sum(1), np.where(mutual, partner, -1)

    def _refined(self, places: _Places, rounds: int = 3) -> tuple[_Places, Array, IntArray]:
        """Fit each place to the objects that coincide; return it with its rating."""
        own = np.full((len(places), len(self.xy)), self.FIRST_VAR)
        score, partner = self._rated(places, own)
        for _ in range(rounds):
            places, own = self._fitted(places, partner)
            score, partner = self._rated(places, own)
        return places, score, partner

    def _fitted(self, places: _Places, partner: IntArray) -> tuple[_Places, Array]:
        """Fit each place to pairs of objects by weighted least squares (with the prior of scale).

        Returns:
            the places; (H, M) the variance of a coordinate that results. A place with fewer than
            two pairs remains as it is.
        """
        column = np.arange(len(self.xy))
        paired = partner >= 0
        weight = np.where(paired, 1 / self.across[column, partner], 0.0)  # (H, M)
        total = weight.sum(1).clip(1e-9)
        middle = (weight * self.xy).sum(1) / total
        map_middle = (weight * self.map_xy[partner]).sum(1) / total
        a = self.xy - middle[:, None]
        b = self.map_xy[partner] - map_middle[:, None]
        spread = (weight * abs(a) ** 2).sum(1).clip(1e-9)
        turn = (weight * a.conj() * b).sum(1) / spread
        usable = (paired.sum(1) >= 2) & (abs(turn) > 1e-6)
        turn = np.where(usable, turn, places.turn)
        by_objects = abs(turn) ** 2 * spread  # 1 / variance of the log scale
        share = by_objects / (by_objects + self.scale_sigma**-2)
        turn = np.where(usable, turn * abs(turn) ** (share - 1), turn)
        shift = np.where(usable, map_middle - turn * middle, places.shift)
        weight = np.where(paired, 1 / self.high[column, partner], 0.0)
        lift = weight * (self.map_z[partner] - abs(turn)[:, None] * self.z)
        lift = np.where(usable, lift.sum(1) / weight.sum(1).clip(1e-9), places.lift)
        own = 1 / total[:, None] + abs(a) ** 2 / spread[:, None]
        own = np.where(usable[:, None], own, self.FIRST_VAR)
        return _Places(turn, shift, lift), own

    def _elsewhere(self, places: _Places, best: _Places) -> BoolArray:
        """Mark the places (H,) that are not the best one, by its objects' median distance."""
        off = (places.turn - best.turn)[:, None] * self.xy + (places.shift - best.shift)[:, None]
        far = np.median(abs(off), axis=1) > self.options.elsewhere_m
        turned = abs(np.angle(places.turn / best.turn)) > self.options.elsewhere_rad
        return np.asarray(far | turned)


def _variances(objects: Landmarks, options: AlignmentOptions) -> Array:
    """Return (K, 2) variances of a horizontal coordinate and of the height."""
    floor = options.floor_m**2 + (options.extent_share * np.exp(objects.log_size)) ** 2
    var = np.diagonal(objects.cov, axis1=1, axis2=2)
    return np.stack([(var[:, 0] + var[:, 1]) / 2, var[:, 2]], 1) + floor[:, None]


# ---- Refinement --------------------------------------------------------------------------------


def _least_squares(
    of_map: Landmarks,
    found: Landmarks,
    place: _Places,
    scale_sigma: float,
    options: AlignmentOptions,
) -> ObjectAlignment:
    """Fit a similarity to K pairs of objects by Gauss-Newton, with covariances and priors.

    Priors are those of the scale and of the tilt. The covariance is enlarged where the distances
    exceed the expected ones.
    """
    turn = complex(place.turn[0])
    rotation = Rotation.from_euler("z", float(np.angle(turn))).as_matrix()
    scale = abs(turn)
    shift = np.array([place.shift[0].real, place.shift[0].imag, place.lift[0]])
    origin = (scale * found.center @ rotation.T + shift).mean(0)
    precision = np.zeros(7)  # of the priors, about the origin
    precision[:2] = options.tilt_rad**-2
    precision[6] = scale_sigma**-2
    for _ in range(5):
        moved = scale * found.center @ rotation.T + shift
        arm = moved - origin
        J = np.zeros((len(arm), 3, 7))
        x, y, z = arm.T
        J[:, 0, 1] = z
        J[:, 0, 2] = -y
        J[:, 1, 0] = -z
        J[:, 1, 2] = x
        J[:, 2, 0] = y
        J[:, 2, 1] = -x
        J[:, :, 3:6] = np.eye(3)
        J[:, :, 6] = arm
        cov = of_map.cov + scale**2 * rotation @ found.cov @ rotation.T
        floor = 2 * options.floor_m**2 + (options.extent_share * np.exp(of_map.log_size)) ** 2
        weight = np.linalg.inv(cov + floor[:, None, None] * np.eye(3))
        tilt = _tilt_of(rotation)
        off = np.array([tilt[0], tilt[1], 0, 0, 0, 0, np.log(scale)])
        H = np.einsum("kai,kab,kbj->ij", J, weight, J) + np.diag(precision)
        g = np.einsum("kai,kab,kb->i", J, weight, of_map.center - moved) - precision * off
        step = np.linalg.solve(H, g)
        grow = float(np.exp(step[6]))
        bend = Rotation.from_rotvec(step[:3]).as_matrix()
        shift = grow * bend @ (shift - origin) + origin + step[3:6]
        rotation = bend @ rotation
        scale *= grow
    left = of_map.center - (scale * found.center @ rotation.T + shift)
    square = float(np.einsum("ka,kab,kb->", left, weight, left))
    cov = np.linalg.inv(H) * max(1.0, square / max(3 * len(left) - 5, 1))
    return ObjectAlignment(
        np.empty((0, 2), np.int64), 0, 0, scale, rotation, shift, about_origin(cov, origin)
    )


def _tilt_of(rotation: Array) -> Array:
    """Return the rotation vector (3,) by which a rotation turns the vertical."""
    axis = np.cross([0.0, 0, 1], rotation[:, 2])
    sine = float(np.linalg.norm(axis))
    return np.asarray(axis / max(sine, 1e-12) * np.arctan2(sine, rotation[2, 2]))
