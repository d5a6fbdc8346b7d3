"""Verify reconstructed models without ground truth: consistency, soundness, constant focal length.

The reprojection error shows none of the errors: wrong models had the smallest. A mapper can join
two scenes by a few wrong matches, register a frame metres from its true position, or shift images
of another focal length towards the scene. Three checks find this:

1. consistency: a model is split where few points connect two groups of images, or where it does
   not explain the matches of consecutive images, or, of photos without an order, of those with
   the most matches;
2. soundness: parallax, triangulation angles, the covariance of the camera centres, and a second
   mapper where that is large;
3. zoom: the focal length of each image, by points triangulated from its neighbours on one side.

No threshold is fitted to one recording.
"""

from __future__ import annotations

import enum
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from reobj.cameras import import_pycolmap
from reobj.poses.bundle import (
    FOCAL_RANGE,
    INLIER_PX,
    MIN_TRI_ANGLE_DEG,
    ModelArrays,
    skew,
    triangulates,
    unit_rows,
)
from reobj.poses.features import MIN_MATCHES, MatchedPairs
from reobj.types import Array, BoolArray, IntArray

# ---- Consistency ---------------------------------------------------------------------------------


# Minimum connection between the images of a model. Connections that are weaker, or have fewer
# points or matches of one pair than MIN_MATCHES, are cut.
# Fraction of the matches of two consecutive images that must be one point of the model (measured:
# right .38-.98, wrong 0)
MIN_SUPPORTED = 0.1
# Pairs with the most matches across a cut of photos, which is made if none is supported (measured:
# right models have one among the first three; one of 10 photos with the wrong one of two poses has
# none among the first ten)
STRONGEST = 5
MIN_GROUP = 3  # images; fewer with a weak connection are left to be located by PnP
# Fraction of the points of one group, and number, that near views of the other must observe again
# (measured: right .065-.5, wrong 0-.007; right 31 and more, the last 30 frames of the example
# mirrored 0)
MIN_REOBSERVED = 0.03
MIN_REOBSERVED_COUNT = 10


def consistent_groups(arrays: ModelArrays, pairs: MatchedPairs) -> list[IntArray]:
    """Split the images of a model into consistent groups.

    Args:
        arrays: ids of its images ascend in time. pairs: verified matches of its database.
    Returns:
        ids of the images of each group, the largest group first; images with too weak a connection
        are in none.
    """
    evidence = _Evidence(arrays, pairs)
    groups = list[IntArray]()
    todo = evidence.runs_of_neighbours() if pairs.is_path else [np.arange(len(arrays.ids))]
    while todo:
        rows = todo.pop()
        side = None if pairs.is_path else evidence.unsupported_cut(rows)
        if side is None:
            rows = rows if pairs.is_path else evidence.supported_photos(rows)
            side = evidence.weak_cut(rows)
        if side is None:
            groups.append(arrays.ids[rows])
        else:
            todo += [rows[s] for s in (side, ~side) if s.sum() >= MIN_GROUP]
    return sorted(groups, key=lambda g: (-len(g), int(g[0])))


def count_explained(arrays: ModelArrays, pairs: MatchedPairs) -> IntArray:
    """Count the verified matches (P,) of each pair that lie on the model's epipolar lines.

    The distance is Sampson's, to first order. A pair with an image that is not in the model has
    none.

    Ref: Hartley and Zisserman 2004, eq. 11.9.
    """
    inside = np.flatnonzero(np.isin(pairs.image_ids, arrays.ids).all(1))  # (p,)
    ids = arrays.ids.tolist()
    first = np.cumsum([0, *(len(pairs.keypoints[i]) for i in ids)])  # keypoint of each image
    xy = np.concatenate([np.empty((0, 2)), *(pairs.keypoints[i] for i in ids)])
    ideal = np.reshape(arrays.camera.cam_from_img(xy), (-1, 2))
    a, b = np.searchsorted(arrays.ids, pairs.image_ids[inside]).T  # (p,)
    rotation = arrays.cam_from_world[:, :, :3]
    shift = arrays.cam_from_world[:, :, 3]
    turn = rotation[b] @ np.swapaxes(rotation[a], 1, 2)  # (p, 3, 3)
    x, y, z = (shift[b] - np.einsum("pij,pj->pi", turn, shift[a])).T
    E = skew(x, y, z) @ turn
    count = np.zeros(len(pairs.inliers), np.int64)
    for k, row in enumerate(inside.tolist()):
        match = pairs.inliers[row]
        one, other = (
            np.insert(ideal[first[image[k]] + match[:, side]], 2, 1, 1)  # (n, 3)
            for side, image in enumerate((a, b))
        )
        line_b = one @ E[k].T
        line_a = other @ E[k]
        slope = (line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)
        distance = np.abs((other * line_b).sum(1)) / np.sqrt(slope + 1e-18) * arrays.focal
        count[row] = (distance < INLIER_PX).sum()
    return count


class _Evidence:
    """A model and the verified matches of its images.

    Attributes:
        explained: (P,) matches of each pair that the model explains.
        point_of: point of the model of each keypoint by image id, -1: none.
    """

    def __init__(self, arrays: ModelArrays, pairs: MatchedPairs) -> None:
        self.arrays = arrays
        self.pairs = pairs
        self.explained = count_explained(arrays, pairs)
        self.point_of = arrays.point_of_keypoints(pairs.keypoints)

    def runs_of_neighbours(self) -> list[IntArray]:
        """Split rows of images where matches of neighbours in time are not supported.

        Consecutive images show the same scene (others may only look alike), so their verified
        matches must be points of the model. They are not where an image was registered at a
        look-alike position, at another scale, or not at all. An image without support by either
        neighbour is left out; it splits the rest unless the images before and after it support each
        other.

        Returns:
            rows (n,) of each run, ascending.
        """
        pairs = self.pairs
        ids = self.arrays.ids
        every = sorted(pairs.keypoints)  # keyframes in the order of time, registered or not
        order = np.searchsorted(every, pairs.image_ids)
        near = np.flatnonzero(pairs.enough & (order[:, 1] - order[:, 0] <= 4))
        ends = map(tuple, pairs.image_ids[near].tolist())
        supported = dict(zip(ends, self.supported(near).tolist(), strict=True))
        links = [supported.get(pair) for pair in itertools.pairwise(every)]
        around = zip([None, *links], [*links, None], strict=True)
        inside = set(ids.tolist())
        kept = [
            k for k, sides in enumerate(around) if every[k] in inside and sides != (False, False)
        ]
        starts = [
            n
            for n, (a, b) in enumerate(itertools.pairwise(kept), 1)
            if False in links[a:b] and not (b - a > 1 and supported.get((every[a], every[b])))
        ]
        rows = np.searchsorted(ids, [every[k] for k in kept])
        return [run for run in np.split(rows, starts) if len(run)]

    def _pairs_among(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Find the pairs of images `rows` (R,) with enough matches.

        Returns:
            their rows in `pairs` (E,), and the two images of each, numbers in `rows` (E, 2).
        """
        ids = self.arrays.ids[rows]
        inside = np.flatnonzero(self.pairs.enough & np.isin(self.pairs.image_ids, ids).all(1))
        return inside, np.searchsorted(ids, self.pairs.image_ids[inside])

    def unsupported_cut(self, rows: IntArray) -> BoolArray | None:
        """Find a cut of photos across which the pairs with the most matches are not in the model.

        Candidates are the edges of the spanning tree of most matches, which takes the place of the
        path of a video: each is the pair with the most matches across its cut. A photo that sees
        the others by points on one plane alone has two possible poses (Necker reversal); where the
        mapper takes the wrong one, the next photos are added to it, and their matches with all
        others contradict it.

        Args:
            rows: (R,) of the photos, ascending.
        Returns:
            (R,) True on one side of `rows`, None if there is no such cut.
        """
        inside, ends = self._pairs_among(rows)
        matches = self.pairs.matches[inside]
        shape = (len(rows), len(rows))
        tree = minimum_spanning_tree(sparse.csr_matrix((1 / matches, ends.T), shape)).tocsr()
        edges = np.flatnonzero(np.asarray(tree[ends[:, 0], ends[:, 1]]).ravel())
        for edge in edges[~self.supported(inside[edges])]:
            rest = tree.copy()
            rest[ends[edge, 0], ends[edge, 1]] = 0
            rest.eliminate_zeros()
            component = connected_components(rest, directed=False)[1]
            side = component == component[ends[edge, 0]]
            if min(side.sum(), (~side).sum()) < MIN_GROUP:
                continue
            across = np.flatnonzero(side[ends[:, 0]] != side[ends[:, 1]])
            strongest = across[np.argsort(-matches[across], kind="stable")[:STRONGEST]]
            if not self.supported(inside[strongest]).any():
                return np.asarray(side)
        return None

    def supported_photos(self, rows: IntArray) -> IntArray:
        """Leave out photos whose matches with the most similar photos are not in the model.

        Of photos without an order the two with which one has the most matches take the place of the
        image before and after it. A photo without support by either is left out. The others stay
        together: of the pairs in a right model up to a tenth are wrong (measured), some with many
        matches.

        Args:
            rows: (R,) of the photos, ascending.
        Returns:
            those of `rows` that stay, (n,).
        """
        inside, ends = self._pairs_among(rows)
        pair = np.repeat(inside, 2)  # (2 E,) each pair belongs to two images
        image = ends.ravel()
        order = np.lexsort((-self.pairs.matches[pair], image))
        rank = np.arange(len(order)) - np.searchsorted(image[order], image[order])
        nearest = order[rank < 2]
        judged = np.unique(pair[nearest])
        supported = np.isin(pair[nearest], judged[self.supported(judged)])
        return np.delete(rows, np.setdiff1d(image[nearest], image[nearest[supported]]))

    def supported(self, rows: IntArray) -> BoolArray:
        """Mark the pairs (n,) whose matches are triangulated in the model.

        A fraction MIN_SUPPORTED of the matches must be one point of the model; and an essential
        matrix of the pair alone must not explain many more of them than the model does.

        Args:
            rows: (n,) of the pairs.
        """
        supported = np.zeros(len(rows), bool)
        for k, row in enumerate(rows.tolist()):
            a, b = self.pairs.image_ids[row].tolist()
            if a in self.point_of and b in self.point_of:
                one, other = self.pairs.inliers[row].T
                points = self.point_of[a][one]
                same = (points == self.point_of[b][other]) & (points >= 0)
                supported[k] = np.mean(same) >= MIN_SUPPORTED and not self._contradicted(row)
        return supported

    def _contradicted(self, row: int) -> bool:
        """True if an essential matrix of a pair explains many more matches than the model."""
        matches = self.pairs.inliers[row]
        explained = int(self.explained[row])
        if len(matches) - explained < MIN_MATCHES:
            return False
        ends = zip(self.pairs.image_ids[row].tolist(), matches.T, strict=True)
        xy = [self.pairs.keypoints[i][side] for i, side in ends]
        camera = self.arrays.camera
        ransac = {"max_error": INLIER_PX, "random_seed": 0}
        estimate = import_pycolmap().estimate_essential_matrix(*xy, camera, camera, ransac)
        return bool(estimate is not None and estimate["num_inliers"] - explained >= MIN_MATCHES)

    def weak_cut(self, rows: IntArray) -> BoolArray | None:
        """Find a cut of the images into two groups whose connection is too weak.

        Candidates are the cuts of the spanning tree of most shared points. A point connects two
        groups, including their relative scale, if one group triangulates it and the other observes
        it. A cut is weak if it has too few such points, or if no pair of images across it has as
        many matches: false matches on symmetric objects add up over images. It is also weak if
        nearby views across it re-observe too few points: what only distant views share is matched
        by chance.

        Returns:
            (n,) True on one side of `rows`, None if there is no weak cut.
        """
        arrays = self.arrays
        covisibility = arrays.covisibility()[rows]
        shared = np.asarray((covisibility @ covisibility.T).todense(), np.float64)  # (R, R)
        np.fill_diagonal(shared, 0)
        tree = minimum_spanning_tree(sparse.csr_matrix(np.where(shared > 0, 1 / (shared + 1), 0)))
        order, parent = breadth_first_order(tree, 0, directed=False)
        if len(order) < len(rows):  # not even connected
            return np.isin(np.arange(len(rows)), order)
        below = np.eye(len(rows), dtype=bool)  # (R, R) the subtree of each image
        for child in order[:0:-1]:
            below[parent[child]] |= below[child]
        cuts = below[order[1:]]  # (R - 1, R) one for each edge of the tree
        ids = self.pairs.image_ids
        inside = np.isin(ids, arrays.ids[rows]).all(1) & (self.explained > 0)
        one, other = np.searchsorted(arrays.ids[rows], ids[inside]).T
        explained = self.explained[inside]
        most = [explained[cut[one] != cut[other]].max(initial=0) for cut in cuts]  # of one pair
        bridge = np.minimum(_bridges(arrays, rows, cuts), np.array(most, np.int64))
        weakest = np.argsort(bridge, kind="stable")
        if len(cuts) and bridge[weakest[0]] < MIN_MATCHES:
            return np.asarray(cuts[weakest[0]])
        smaller = np.minimum(cuts.sum(1), (~cuts).sum(1))
        for cut in weakest[smaller[weakest] >= MIN_GROUP][:3]:  # all would take long
            expected, reobserved = _count_reobserved(arrays, rows, np.asarray(cuts[cut]))
            if reobserved < max(MIN_REOBSERVED * expected, MIN_REOBSERVED_COUNT):
                return np.asarray(cuts[cut])
        return None


def _bridges(arrays: ModelArrays, rows: IntArray, cuts: BoolArray) -> IntArray:
    """Count the points (C,) that connect the two sides of each cut (C, R) of `rows`.

    One side must triangulate the point, by `triangulates`, and the other observe it.
    """
    covisibility = arrays.covisibility()[rows].tocsc()
    entries = covisibility.tocoo()
    ray = unit_rows(arrays.xyz[entries.col] - arrays.centre[rows][entries.row])  # (m, 3)
    rays = [sparse.csc_matrix((u, (entries.row, entries.col)), covisibility.shape) for u in ray.T]
    count = np.zeros(len(cuts), np.int64)
    step = 50  # cuts counted together: memory
    for start in range(0, len(cuts), step):
        chunk = cuts[start : start + step].astype(float)
        sides = []
        for side in (chunk, 1 - chunk):
            n = np.asarray(side @ covisibility)  # (c, N)
            squared_sum = np.asarray(sum(np.asarray(side @ u) ** 2 for u in rays))
            sides.append((n > 0, triangulates(n, squared_sum)))
        (one, one_deep), (two, two_deep) = sides
        count[start : start + step] = ((one & two_deep) | (two & one_deep)).sum(1)
    return count


def _count_reobserved(arrays: ModelArrays, rows: IntArray, side: BoolArray) -> tuple[int, int]:
    """Count the observations that each side of a cut should have of the other side's points.

    Expected is a point that two images of its side see, in an image of the other side that it
    projects into, from a direction and a distance near those of one of the two: SIFT bridges 30 deg
    (Lowe 2004, fig. 9) and an octave. Of each side the 10 images are counted that share the most
    points with the other.

    Args:
        side: (R,) of `rows`.
    Returns:
        how many are expected, and how many of these were made; sums of both directions.
    """
    pose = arrays.cam_from_world[rows]
    centre = arrays.centre[rows]
    camera = arrays.camera
    covisibility = arrays.covisibility()[rows]
    size = (camera.width, camera.height)
    img_from_cam = np.array(camera.calibration_matrix())
    expected = reobserved = 0
    for own in (side, ~side):
        seen = covisibility[own]
        points = np.flatnonzero(np.asarray(seen.sum(0)).ravel() >= 2)  # (n,)
        xyz = arrays.xyz[points]
        seen = seen[:, points].tocoo()
        there = covisibility[~own][:, points].tocsr()
        border = np.argsort(-np.asarray(there.sum(1)).ravel(), kind="stable")[:10]
        ray = centre[own][seen.row] - xyz[seen.col]  # (m, 3) from a point to a camera that sees it
        length = np.linalg.norm(ray, axis=1)
        for image in border:
            there_from_world = pose[~own][image]
            projected = xyz @ there_from_world[:, :3].T + there_from_world[:, 3]  # (n, 3)
            projected = projected @ img_from_cam.T
            inside = projected[:, 2] > 0
            xy = projected[:, :2] / np.where(inside, projected[:, 2], 1)[:, None]
            inside &= ((xy > 0) & (xy < size)).all(1)
            other_ray = centre[~own][image] - xyz  # (n, 3)
            other_length = np.linalg.norm(other_ray, axis=1)[seen.col]
            cosine = (ray * other_ray[seen.col]).sum(1) / (length * other_length)
            is_near = cosine > np.cos(np.radians(30))
            is_near &= np.abs(np.log(length / other_length)) < np.log(2)
            inside &= np.bincount(seen.col[is_near], minlength=len(points)) > 0
            expected += int(inside.sum())
            reobserved += int(inside[there[image].indices].sum())
    return expected, reobserved


# ---- Soundness -----------------------------------------------------------------------------------


class FocalSource(enum.Enum):
    """How a focal length is known."""

    GIVEN = enum.auto()  # by the user
    MATCHES = enum.auto()  # estimated from the epipolar geometry of the matches
    MODEL = enum.auto()  # calibrated by the bundle adjustment of the model
    GUESS = enum.auto()  # EXIF, or a usual one


# Minimum requirements for accepting a model
MIN_IMAGES = 10  # (COLMAP's min_model_size), or MIN_REGISTERED
MIN_REGISTERED = 0.5  # fraction of the keyframes of a short video
MIN_POINTS = 100  # of a model; a higher limit refuses short walks
# Parallax that rotations of the camera alone cannot explain; walks have more than 4. A lower limit
# accepts a rotation alone with a wrong focal length
MIN_PARALLAX_PX = 3.0

# `Component.centre_sigma` up to which all centres are certain. Above, the model may be one of many
# nearly equal solutions, and another mapper must find the same (measured: right models of 40
# keyframes and more .0001 to .0025, wrong ones of short stretches from .0011 on)
SURE_SIGMA = 0.001
# The largest that a second mapper can confirm where the focal length was guessed before mapping:
# where the camera zoomed, both came to the same wrong scale (measured: one of .0045). Another focal
# length is evidence of its own: no limit
GUESS_SIGMA = 0.004
# Two mappers agree if no centre differs by more, over the extent, and no camera by more in
# orientation: half of what the benchmark of broken trajectories calls wrong
SAME_CENTRE = 0.05
SAME_TURN_DEG = 5.0
# Largest difference of two mappers in the orientation of a camera whose directions are used
DIRECTION_DEG = 3.0
# Fraction of the component that the other mapper must have: a lower limit keeps components
# of which most images are not confirmed
CONFIRMED = 0.75
# Points that each of two pieces triangulates and that prove how they are joined: they fix rotation,
# shift and scale (measured: right joins 191 to 386, a mirrored stretch 24, a free scale 0 to 3)
JOINT_POINTS = 100


@dataclass(frozen=True, slots=True)
class Component:
    """A consistent model of one component of the trajectory, and the measures of its soundness."""

    model: Any
    arrays: ModelArrays
    focal_source: FocalSource
    tri_angle_deg: float  # median over points of the widest angle between two rays
    registered: float  # fraction of the keyframes
    parallax_px: float  # that rotations of the camera alone cannot explain
    centre_sigma: float  # largest of a camera centre, over the extent of the trajectory
    explained: int  # verified matches
    problem: str  # "" if it is sound
    kept: IntArray  # ids of the images with certain poses
    advice: str = ""  # for the user, where the cause is established
    is_weak: bool = False  # the problem is too little parallax: rotations may be right
    direction_sigma: float = 0.0  # rad, of the rotations, where another mapper has the same

    @property
    def focal(self) -> float:
        """Focal length over the longer side."""
        return self.arrays.focal_over_size


def measured(
    model: Any,
    arrays: ModelArrays,
    centre_sigma: float,
    *,
    count: int,
    explained: int,
    focal_source: FocalSource,
) -> Component:
    """Measure an adjusted model of some of `count` keyframes and name its first problem.

    Args:
        arrays: of the model. explained: verified matches that it explains.
    """
    images = len(arrays.ids)
    points = len(arrays.xyz)
    seen = np.median(np.bincount(arrays.image, minlength=max(images, 1)))
    angle_deg = _median_tri_angle_deg(arrays)
    parallax_px = _parallax_px(arrays)
    focal = arrays.focal_over_size
    # at a wrong focal length a translation along a wall looks like a rotation
    calibrated = focal_source is FocalSource.MODEL
    advice = ""
    no_depth = f"if the focal length is {focal:.2f} x the longer side"
    if calibrated:
        advice = "move the camera sideways around the objects (turning on the spot gives no depth)"
        no_depth = "so depth cannot be estimated"
    lens = "give measured intrinsics (--camera); pixels must be square"
    checks = (
        (images < min(MIN_REGISTERED * count, MIN_IMAGES),
         f"only {images} of {count} keyframes connect", ""),
        (points < MIN_POINTS, f"only {points} points could be triangulated", ""),
        (seen < MIN_MATCHES,
         f"half of the keyframes see {seen:.0f} points or fewer", ""),
        (parallax_px < MIN_PARALLAX_PX,
         f"the camera only rotates (to {parallax_px:.1f} px), {no_depth}", advice),
        (angle_deg < MIN_TRI_ANGLE_DEG,
         f"half of the points are seen from directions within {angle_deg:.1f} deg", advice),
        (arrays.camera.has_bogus_params(*FOCAL_RANGE, 1.0),
         f"the estimated focal length is {focal:.2f} x the longer side", lens),
    )  # fmt: skip
    problem, advice = next(((text, advice) for bad, text, advice in checks if bad), ("", ""))
    others = (*checks[:3], *checks[5:])  # than those of parallax
    is_weak = any(check[0] for check in checks[3:5]) and not any(check[0] for check in others)
    return Component(
        model, arrays, focal_source, angle_deg, images / count, parallax_px, centre_sigma,
        explained, problem, arrays.ids, advice, is_weak,
    )  # fmt: skip


def confirmed(
    components: list[Component],
    others: list[Component],
    focal_source: FocalSource,
) -> list[Component]:
    """Reject components of uncertain cameras unless a second mapper reproduces them.

    Images whose poses differ, or which it lacks, are not kept. Where only the rotations agree,
    `direction_sigma` is set, and those images are kept.

    Args:
        focal_source: of the focal length before mapping.
    """
    checked = list[Component]()
    for component in components:
        if not component.problem and component.centre_sigma > SURE_SIGMA:
            is_guess = focal_source is FocalSource.GUESS
            can_confirm = not is_guess or component.centre_sigma <= GUESS_SIGMA
            found = [other.arrays for other in others if can_confirm]
            rows = _reproduced_by(component.arrays, found)
            component = replace(component, kept=component.arrays.ids[rows])
            if len(rows) < CONFIRMED * len(component.arrays.ids):
                problem = (
                    "the camera positions are uncertain, and no second mapper confirms them "
                    f"(largest sigma {100 * component.centre_sigma:.2g} % of the trajectory, "
                    f"parallax {component.parallax_px:.0f} px, rays meet at "
                    f"{component.tri_angle_deg:.1f} deg)"
                )
                component = replace(component, problem=problem, is_weak=True)
        if component.is_weak:
            rows, sigma = _same_rotations(component.arrays, [other.arrays for other in others])
            if len(rows) >= CONFIRMED * len(component.arrays.ids):
                kept = component.arrays.ids[rows]
                component = replace(component, kept=kept, direction_sigma=sigma)
        checked.append(component)
    return sorted(checked, key=lambda c: (bool(c.problem), -c.registered))


def _same_rotations(one: ModelArrays, others: Sequence[ModelArrays]) -> tuple[IntArray, float]:
    """Return the images (rows of one) that another model turned alike, and the difference, rad."""
    best = np.empty(0, np.int64)
    sigma = 0.0
    for other in others:
        _, rows, other_rows = np.intersect1d(one.ids, other.ids, return_indices=True)
        if len(rows) < 3:
            continue
        a = one.cam_from_world[rows][:, :, :3]
        b = other.cam_from_world[other_rows][:, :, :3]
        relative = Rotation.from_matrix(np.swapaxes(b, 1, 2) @ a)
        off = (relative.mean().inv() * relative).magnitude()
        same = off <= np.radians(DIRECTION_DEG)
        if same.sum() > len(best):
            best = rows[same]
            sigma = max(float(np.sqrt((off[same] ** 2).mean())), np.radians(0.1))
    return best, sigma


def _reproduced_by(one: ModelArrays, others: Sequence[ModelArrays]) -> IntArray:
    """Return the images (rows of one) with the same poses in another mapper's models.

    Those may be pieces. A piece only proves the relative poses of its own cameras. What joins it to
    the others are points that both triangulate: of two scenes that look alike there are few, and
    none where a single image, or a pair without a third, connects two scales.
    """
    pieces = sorted((_same(one, other) for other in others), key=len, reverse=True)
    rows = pieces[0] if pieces else np.empty(0, np.int64)
    todo = pieces[1:]
    while joined := [
        piece
        for piece in todo
        if (one.triangulated_by(rows) & one.triangulated_by(piece)).sum() >= JOINT_POINTS
    ]:
        rows = np.union1d(rows, joined[0])
        todo = [piece for piece in todo if piece is not joined[0]]
    return np.sort(rows)


def _same(one: ModelArrays, other: ModelArrays) -> IntArray:
    """Return the images that another model has, rows (n,) of one; none unless all poses agree.

    One is aligned to the other by the mean of the relative orientations, then scale and shift.
    """
    ids = np.intersect1d(one.ids, other.ids)
    if len(ids) < 3:  # arbitrary poses
        return np.empty(0, np.int64)
    rows = np.searchsorted(one.ids, ids)
    other_rows = np.searchsorted(other.ids, ids)
    a = one.cam_from_world[rows][:, :, :3]
    b = other.cam_from_world[other_rows][:, :, :3]
    relative = Rotation.from_matrix(np.swapaxes(b, 1, 2) @ a)
    mean = relative.mean()
    turn_deg = np.degrees((mean.inv() * relative).magnitude())
    start = one.centre[rows]
    end = other.centre[other_rows]
    moved = mean.apply(start - start.mean(0))
    end = end - end.mean(0)
    moved *= (moved * end).sum() / max((moved**2).sum(), 1e-12)
    offset = np.linalg.norm(moved - end, axis=1).max() / np.linalg.norm(np.ptp(end, axis=0))
    agrees = offset <= SAME_CENTRE and turn_deg.max() <= SAME_TURN_DEG
    return rows[: len(ids) if agrees else 0]


def _median_tri_angle_deg(arrays: ModelArrays) -> float:
    """Return the median over points of the widest angle between two rays."""
    if not len(arrays.xyz):
        return 0.0
    step = max(1, len(arrays.xyz) // 2000)  # a sample: all points take long
    sample = np.flatnonzero(arrays.point % step == 0)
    sample = sample[np.argsort(arrays.point[sample], kind="stable")]
    ray = unit_rows(arrays.xyz[arrays.point[sample]] - arrays.centre[arrays.image[sample]])
    starts = np.flatnonzero(np.diff(arrays.point[sample], prepend=-1))
    cosine = [(u @ u.T).min() for u in np.split(ray, starts[1:])]  # of each point
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))


def _parallax_px(arrays: ModelArrays) -> float:
    """Return the parallax that rotations of the camera cannot explain, px.

    Of each pair of images the rays of the shared points are aligned by a rotation; the median
    residual is the pair's parallax. Returned is the 95th percentile over pairs. A camera that only
    rotated looks sound otherwise: a wrong focal length produces triangulation angles.
    """
    unit = unit_rows(np.insert(arrays.ideal, 2, 1, 1))  # (M, 3)
    ends = np.searchsorted(arrays.image, np.arange(len(arrays.ids) + 1))
    residuals = []
    for a, b in itertools.combinations(range(len(arrays.ids)), 2):
        if (b - a) & (b - a - 1) == 0:  # 1, 2, 4, 8 ... keyframes apart
            p, q = (arrays.point[ends[i] : ends[i + 1]] for i in (a, b))
            both, one, other = np.intersect1d(p, q, return_indices=True)
            if len(both) >= 15:  # fewer have no stable median
                u = unit[ends[a] + one]  # (n, 3)
                v = unit[ends[b] + other]
                turned = Rotation.align_vectors(v, u)[0].apply(u)
                residuals.append(np.median(np.linalg.norm(turned - v, axis=1)))
    return float(np.percentile(residuals, 95)) * arrays.focal if residuals else 0.0


# ---- Zoom ----------------------------------------------------------------------------------------


# When the focal length changes between two consecutive images
ZOOM_WINDOW = 10  # images on one side whose points are used: a zoom bends the path of more
RESECTED = 2  # images next to a gap whose focal length is measured, on each side
# Least log of the change (measured, mean of both sides: zoomed by 1.25 to 1.5 .15-.30, right models
# below .03)
ZOOM_LOG = 0.12
# The same where only one side can be measured: the noise of its depths biases it (measured: zooms
# .34-.39, right models up to .12)
ZOOM_LOG_ONE_SIDE = 0.24
ZOOM_SIGMAS = 5.0  # of that change; with a lower limit noise of few points counts as a zoom


def constant_focal(
    models: list[ModelArrays], window: int = ZOOM_WINDOW
) -> tuple[IntArray, list[tuple[int, int, float]]]:
    """Find the images that were not taken at the most frequent focal length.

    A mapper assumes one focal length: it shifts images of a zoomed stretch towards the scene.

    Args:
        models: ids of images ascend in time. window: images, as ZOOM_WINDOW.
    Returns:
        ids of the images of other focal lengths, or of one that cannot be compared; of each change
        the ids of the images before and after it and the ratio of their focal lengths.
    """
    changes = sorted(change for arrays in models for change in _changes(arrays, window))
    changes = [c for c in changes if not any(_is_side_effect(c, other) for other in changes)]
    ids = np.array(sorted({int(i) for arrays in models for i in arrays.ids}), np.int64)
    starts = np.searchsorted(ids, [after for _, after, _ in changes])
    log = np.zeros(len(ids))
    for k, (start, (_, _, ratio)) in enumerate(zip(starts, changes, strict=True)):
        # else each bends the other's images
        is_measured = not k or start - starts[k - 1] >= window
        log[start:] += np.log(ratio) if is_measured else 10  # as of another camera
    same = np.abs(log[:, None] - log) < ZOOM_LOG  # (R, R)
    return ids[~same[same.sum(1).argmax()]] if len(ids) else ids, changes


def _is_side_effect(one: tuple[int, int, float], other: tuple[int, int, float]) -> bool:
    """True if an adjacent larger zoom in the same direction explains this one.

    Images next to a zoom are bent by it.
    """
    adjacent = one is not other and (one[0] == other[1] or one[1] == other[0])
    log = np.log(one[2])
    other_log = np.log(other[2])
    return bool(adjacent and log * other_log > 0 and abs(log) < abs(other_log))


def _changes(arrays: ModelArrays, window: int) -> list[tuple[int, int, float]]:
    """List the changes of the focal length between consecutive images.

    The images next to each gap are resected from points of the other side.
    """
    count = len(arrays.ids)
    changes = list[tuple[int, int, float]]()
    ray = np.insert(arrays.ideal, 2, 1, 1)[:, None] @ arrays.cam_from_world[arrays.image][:, :, :3]
    ray = unit_rows(ray[:, 0])  # (M, 3) in world
    across = np.eye(3) - ray[:, :, None] * ray[:, None]  # (M, 3, 3)
    start = (across @ arrays.centre[arrays.image][:, :, None])[:, :, 0]
    terms = np.hstack([across.reshape(-1, 9), start, ray, np.ones((len(ray), 1))])  # (M, 16)
    for k in range(1, count):
        before = range(max(0, k - window), k)
        after = range(k, min(k + window, count))
        sides = list[list[list[float]]]()
        for side, images, sign in ((before, after[:RESECTED], 1), (after, before[-RESECTED:], -1)):
            points = _triangulate(arrays, terms, side)
            values = np.array([_log_focal(arrays, image, points) for image in images])
            values = values * [sign, 1]
            sides.append(values[np.isfinite(values[:, 0])].tolist())
        if any(sides):
            log, sigma = np.median(list(itertools.chain(*sides)), axis=0)
            least = ZOOM_LOG if all(sides) else ZOOM_LOG_ONE_SIDE
            if abs(log) > max(least, ZOOM_SIGMAS * sigma):
                ids = int(arrays.ids[k - 1]), int(arrays.ids[k])
                changes.append((*ids, float(np.exp(log))))
    return changes


def _triangulate(arrays: ModelArrays, terms: Array, side: range) -> Array:
    """Triangulate points from some consecutive images: the nearest to all their rays.

    Args:
        terms: (M, 16) of each observation with unit ray u from centre c, in world: I - u u' (9),
            (I - u u') c, u, 1.
    Returns:
        (N, 3) points, NaN where the rays do not determine the depth.
    """
    first, last = np.searchsorted(arrays.image, (side.start, side.stop))
    points, row = np.unique(arrays.point[first:last], return_inverse=True)
    entries = (np.ones(len(row)), (row, np.arange(len(row))))
    sums = sparse.csr_matrix(entries, (len(points), len(row))) @ terms[first:last]
    good = triangulates(sums[:, 15], (sums[:, 12:15] ** 2).sum(1))
    xyz = np.full((len(arrays.xyz), 3), np.nan)
    A = sums[good, :9].reshape(-1, 3, 3)
    b = sums[good, 9:12, None]
    xyz[points[good]] = np.linalg.solve(A, b)[:, :, 0]
    return xyz


def _log_focal(arrays: ModelArrays, image: int, points: Array) -> tuple[float, float]:
    """Estimate an image's focal length from points (N, 3), NaN where there are none.

    Returns:
        log of its ratio to that of the model, and its sigma; NaN with too few points.
    """
    first, last = np.searchsorted(arrays.image, (image, image + 1))
    pose = arrays.cam_from_world[image]
    ideal = arrays.ideal[first:last]
    xyz_in_cam = points[arrays.point[first:last]] @ pose[:, :3].T + pose[:, 3]
    in_front = xyz_in_cam[:, 2] > 0  # no NaN
    if in_front.sum() < 20:  # for 7 unknowns and the variance of the noise
        return np.nan, np.nan
    return _resect(xyz_in_cam[in_front], ideal[in_front] * arrays.focal, arrays.focal)


def _resect(xyz_in_cam: Array, xy: Array, focal: float) -> tuple[float, float]:
    """Fit a small motion and the focal length of a camera to points, with a Cauchy loss of 1 px.

    Args:
        xyz_in_cam: (n, 3) points, nearly in the camera's frame. xy: (n, 2) pixels from the centre.
    Returns:
        log of the focal length over `focal`, and its sigma; NaN if the fit fails.
    """
    turn = np.eye(3)
    shift = np.zeros(3)
    log = 0.0
    for _ in range(8):  # focal lengths of a third more need 5
        moved = xyz_in_cam @ turn.T + shift
        if (moved[:, 2] <= 0).any():
            return np.nan, np.nan
        f = focal * np.exp(log)
        zero = np.zeros(len(moved))
        inverse = 1 / moved[:, 2]
        x = moved[:, 0] * inverse
        y = moved[:, 1] * inverse
        residual = xy - f * np.column_stack([x, y])  # (n, 2)
        weight = 1 / (1 + (residual**2).sum(1))
        J = f * np.array([  # (2, 7, n) by rotation, translation and log focal length
            [-x * y, 1 + x * x, -y, inverse, zero, -x * inverse, x],
            [-1 - y * y, x * y, x, zero, inverse, -y * inverse, y],
        ])  # fmt: skip
        normal = np.einsum("ain,ajn,n->ij", J, J, weight)
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e14:
            return np.nan, np.nan
        step = np.linalg.solve(normal, np.einsum("ain,na,n->i", J, residual, weight))
        rotation = Rotation.from_rotvec(step[:3]).as_matrix()
        turn = rotation @ turn
        shift = rotation @ shift + step[3:6]
        log = float(np.clip(log + step[6], -1, 1))
    variance = np.average((residual**2).sum(1), weights=weight) / 2
    return log, float(np.sqrt(np.linalg.inv(normal)[6, 6] * variance))
