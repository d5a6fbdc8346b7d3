"""Check a reconstruction against its own evidence, and take apart what does not hold together.

A mapper can join two worlds by a few wrong matches, or register a frame metres from where it was:
the reprojection error shows neither. What shows it is how many points tie two groups of images
together, and whether the model explains the matches of pictures that follow each other. Needs no
truth and no threshold of one recording.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from reobj.cameras import import_pycolmap
from reobj.poses.bundle import MIN_RAY_SPREAD, ModelArrays
from reobj.types import Array, BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class MatchedPairs:
    """The verified matches of a database.

    Attributes:
        image_ids: (P, 2) of each pair, the lower first. inliers: of each pair the matching
            keypoints (n, 2). keypoints: (N, 2) pixels by image id.
        fundamental: (P, 3, 3), NaN where the pair has none (planar, or a mere turn).
    """

    image_ids: IntArray
    inliers: list[IntArray]
    keypoints: dict[int, Array]
    fundamental: Array

    @property
    def enough(self) -> BoolArray:
        """Mark the pairs (P,) with as many verified matches as register an image."""
        return np.array([len(found) >= MIN_MATCHES for found in self.inliers], bool)

    def only(self, ids: Sequence[int]) -> MatchedPairs:
        """Return the pairs of some images."""
        rows = np.flatnonzero(np.isin(self.image_ids, ids).all(1))
        inliers, xy = [self.inliers[row] for row in rows], {i: self.keypoints[i] for i in ids}
        return MatchedPairs(self.image_ids[rows], inliers, xy, self.fundamental[rows])


def read_pairs(database: Path) -> MatchedPairs:
    """Read keypoints and verified matches."""
    pc = import_pycolmap()
    general = {int(pc.TwoViewGeometryConfiguration.UNCALIBRATED),
               int(pc.TwoViewGeometryConfiguration.CALIBRATED)}  # fmt: skip
    with contextlib.closing(pc.Database.open(str(database))) as db:
        pair_ids, geometries = db.read_two_view_geometries()
        keypoints = {
            image.image_id: np.asarray(db.read_keypoints(image.image_id), np.float64)[:, :2]
            for image in db.read_all_images()
        }
    none = np.full((3, 3), np.nan)
    fundamental = [
        g.F if int(g.config) in general and g.F is not None else none for g in geometries
    ]
    return MatchedPairs(
        np.array([pc.pair_id_to_image_pair(p) for p in pair_ids], np.int64).reshape(-1, 2),
        [np.asarray(g.inlier_matches, np.int64) for g in geometries],
        keypoints,
        np.array(fundamental).reshape(-1, 3, 3),
    )


FOCAL_STEPS = np.geomspace(0.4, 2.0, 161)  # tried, over the longer side (28-103 deg; 1 % apart)
MIN_FOCAL_PAIRS = 10  # pairs whose epipolar geometry is believed together (chosen)
MIN_FOCAL_MATCHES = 30  # of such a pair (COLMAP's relpose_min_num_inliers)


def focal_from_pairs(pairs: MatchedPairs, size: tuple[int, int]) -> float | None:
    """Estimate the focal length that makes essential matrices of the fundamental ones.

    E = K' F K has two equal singular values for the right K. Of each trial the median over pairs of
    1 - s2 / s1 counts, so that half of the pairs may be wrong; no start value, no local minimum.

    Returns:
        focal length over the longer side; None with too few pairs.
    Ref: Mendonca and Cipolla, CVPR 1999.
    """
    enough = np.array([len(m) >= MIN_FOCAL_MATCHES for m in pairs.inliers], bool)
    F = pairs.fundamental[enough & np.isfinite(pairs.fundamental[:, 0, 0])]  # (P, 3, 3)
    if len(F) < MIN_FOCAL_PAIRS:
        return None
    K = np.zeros((len(FOCAL_STEPS), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = FOCAL_STEPS * max(size)
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = size[0] / 2, size[1] / 2, 1
    E = np.swapaxes(K, 1, 2)[:, None] @ F[None] @ K[:, None]  # (S, P, 3, 3)
    s = np.linalg.svd(E, compute_uv=False)
    cost = np.median(1 - s[..., 1] / s[..., 0], 1)  # (S,)
    best = int(cost.argmin())
    inside = 0 < best < len(cost) - 1
    return float(FOCAL_STEPS[best]) if inside else None


EXPLAINED_PX = 4.0  # largest distance from the epipolar line (COLMAP's filter_max_reproj_error)
MIN_MATCHES = 30  # verified matches that say something (COLMAP registers from 30 on)
MAX_NEIGHBOUR = 4  # keyframes apart, at most, that are looked at (chosen)
MIN_TIED = 0.1  # share of them that are one point of the model (measured: right .38-.98, wrong 0)
MIN_BRIDGE = 30  # points that tie two groups of images (COLMAP registers one image from 30 on)
MIN_GROUP = 3  # images; fewer that hang on few points are left to be located by PnP
WEAKEST_CUTS = 3  # whose missing points are counted (chosen: time)
BORDER_IMAGES = 10  # of each side of a cut, those that share the most points (chosen: time)
NEAR_VIEW_DEG = 30.0  # turn of a view up to which a point is found again (SIFT: Lowe 2004, fig. 9)
NEAR_VIEW_SCALE = 2.0  # change of distance up to which it is (an octave; chosen)
MIN_SEEN = 0.03  # share of such points that must be found again (measured: right .065-.5, wrong
# 0-.007), and how many at least: what only views farther apart share is matched by chance
MIN_FOUND = 10  # (measured: right 31 and more; the last 30 frames of the example mirrored 0)


def consistent_groups(arrays: ModelArrays, pairs: MatchedPairs) -> list[IntArray]:
    """Split the images of a model into groups that hold together.

    Args:
        arrays: ids of its images ascend in time. pairs: verified matches of its database.
    Returns:
        ids of the images of each group, the largest group first; images that hang on by too little
        are in none.
    """
    explained, groups = count_explained(arrays, pairs), []
    todo = _runs_of_tied_neighbours(arrays, pairs, explained)
    while todo:
        rows = todo.pop()
        side = _weak_cut(arrays, rows, pairs, explained)
        if side is None:
            groups.append(arrays.ids[rows])
            continue
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
    rotation, shift = arrays.cam_from_world[:, :, :3], arrays.cam_from_world[:, :, 3]
    turn = rotation[b] @ np.swapaxes(rotation[a], 1, 2)  # (p, 3, 3)
    x, y, z = (shift[b] - np.einsum("pij,pj->pi", turn, shift[a])).T
    none = np.zeros(len(x))
    cross = np.moveaxis(np.array([[none, -z, y], [z, none, -x], [-y, x, none]]), 2, 0)
    E = cross @ turn
    count = np.zeros(len(pairs.inliers), np.int64)
    for k, row in enumerate(inside.tolist()):
        match = pairs.inliers[row]
        one, other = (
            np.insert(ideal[first[image[k]] + match[:, side]], 2, 1, 1)  # (n, 3)
            for side, image in enumerate((a, b))
        )
        line_b, line_a = one @ E[k].T, other @ E[k]
        slope = (line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)
        distance = np.abs((other * line_b).sum(1)) / np.sqrt(slope + 1e-18) * arrays.focal
        count[row] = (distance < EXPLAINED_PX).sum()
    return count


def _runs_of_tied_neighbours(
    arrays: ModelArrays, pairs: MatchedPairs, explained: IntArray
) -> list[IntArray]:
    """Split rows of images where the model does not hold the matches of neighbours in time.

    Images that follow each other show one place (others may be alike by chance), so the model must
    have their verified matches (`_ties`). It does not where the camera was put at a twin of its
    place, at another scale, or nowhere. An image that is tied to neither of its neighbours is left
    out; it splits the rest unless the images before and after it are tied to each other.

    Returns:
        rows (n,) of each run, ascending.
    """
    every = sorted(pairs.keypoints)  # keyframes in the order of time, registered or not
    tied = _ties(arrays, pairs, explained, every)
    links = [tied.get(pair) for pair in itertools.pairwise(every)]
    around = zip([None, *links], [*links, None], strict=True)
    inside = set(arrays.ids.tolist())
    kept = [k for k, sides in enumerate(around) if every[k] in inside and sides != (False, False)]
    starts = [
        n
        for n, (a, b) in enumerate(itertools.pairwise(kept), 1)
        if False in links[a:b] and not (b - a > 1 and tied.get((every[a], every[b])))
    ]
    rows = np.searchsorted(arrays.ids, [every[k] for k in kept])
    return [run for run in np.split(rows, starts) if len(run)]


def _ties(
    arrays: ModelArrays, pairs: MatchedPairs, explained: IntArray, every: list[int]
) -> dict[tuple[int, int], bool]:
    """Tell of each pair of images with enough verified matches whether the model has them.

    A good share must be one point of the model, two observations each; and an essential matrix of
    their own must not explain many more of them than the model's does.

    Args:
        every: ids in the order of time; pairs with up to 3 images between them are looked at.
    """
    at = {number: k for k, number in enumerate(every)}
    point_of, ties = {}, {}
    for row, image_id in enumerate(arrays.ids.tolist()):
        point_of[image_id] = np.full(len(pairs.keypoints[image_id]), -1)
        mine = arrays.image == row
        point_of[image_id][arrays.keypoint[mine]] = arrays.point[mine]
    for row, (a, b) in enumerate(pairs.image_ids.tolist()):
        matches = pairs.inliers[row]
        if len(matches) < MIN_MATCHES or at[b] - at[a] > MAX_NEIGHBOUR:
            continue
        ties[a, b] = False
        if a in point_of and b in point_of:
            one, other = point_of[a][matches[:, 0]], point_of[b][matches[:, 1]]
            shared = np.mean((one == other) & (one >= 0))
            against = _contradicted(arrays, pairs, row, int(explained[row]))
            ties[a, b] = bool(shared >= MIN_TIED and not against)
    return ties


def _contradicted(arrays: ModelArrays, pairs: MatchedPairs, row: int, explained: int) -> bool:
    """Tell whether two images' own essential matrix explains many more matches than the model."""
    matches, (a, b) = pairs.inliers[row], pairs.image_ids[row].tolist()
    if len(matches) - explained < MIN_MATCHES:
        return False
    camera, ransac = arrays.camera, {"max_error": EXPLAINED_PX, "random_seed": 0}
    xy = pairs.keypoints[a][matches[:, 0]], pairs.keypoints[b][matches[:, 1]]
    own = import_pycolmap().estimate_essential_matrix(*xy, camera, camera, ransac)
    return bool(own is not None and own["num_inliers"] - explained >= MIN_MATCHES)


def _shared_points(seen: Any) -> Array:
    """Count the points (R, R) that two images share, 0 on the diagonal."""
    shared = np.asarray((seen @ seen.T).todense(), np.float64)
    np.fill_diagonal(shared, 0)
    return shared


def _weak_cut(
    arrays: ModelArrays, rows: IntArray, pairs: MatchedPairs, explained: IntArray
) -> BoolArray | None:
    """Find two groups of images that too little ties together.

    Candidates are the cuts of the spanning tree of most shared points. A point ties two groups,
    and their scales, if one of them sees it from directions that tell its depth, and the other sees
    it too. Too few are few points, or few of those that should be found again: near views of a
    place that share nothing are two places, and what far views share is chance. Points without two
    images that have as many matches are few too: chance matches of a symmetric thing add up over
    images.

    Args:
        explained: (P,) matches of each pair.
    Returns:
        (n,) True on one side of `rows`, None if all holds together.
    """
    seen = arrays.seen()[rows]
    shared = _shared_points(seen)
    tree = minimum_spanning_tree(sparse.csr_matrix(np.where(shared > 0, 1 / (shared + 1), 0)))
    order, parent = breadth_first_order(tree, 0, directed=False)
    if len(order) < len(rows):  # not even connected
        return np.isin(np.arange(len(rows)), order)
    below = np.eye(len(rows), dtype=bool)  # (R, R) the subtree of each image
    for child in order[:0:-1]:
        below[parent[child]] |= below[child]
    cuts = below[order[1:]]  # (R - 1, R) one for each edge of the tree
    inside = np.flatnonzero(np.isin(pairs.image_ids, arrays.ids[rows]).all(1) & (explained > 0))
    one, other = np.searchsorted(arrays.ids[rows], pairs.image_ids[inside]).T
    across = np.where(cuts[:, one] != cuts[:, other], explained[inside], 0)  # (R - 1, p)
    bridge = np.minimum(_bridges(arrays, rows, cuts), across.max(1, initial=0))
    for cut in np.argsort(bridge, kind="stable"):
        if bridge[cut] < MIN_BRIDGE:
            return np.asarray(cuts[cut])
    smaller = np.minimum(cuts.sum(1), (~cuts).sum(1))
    groups = np.flatnonzero(smaller >= MIN_GROUP)
    for cut in groups[np.argsort(bridge[groups], kind="stable")[:WEAKEST_CUTS]]:
        expected, found = _found_again(arrays, rows, np.asarray(cuts[cut]))
        if found < max(MIN_SEEN * expected, MIN_FOUND):
            return np.asarray(cuts[cut])
    return None


CUTS_AT_ONCE = 50  # whose bridges are counted together (chosen: memory)


def _bridges(arrays: ModelArrays, rows: IntArray, cuts: BoolArray) -> IntArray:
    """Count the points (C,) that tie the two sides of each cut (C, R) of `rows`.

    The depth of a point is told by n rays whose directions u spread: n - |sum of u|^2 / n, which is
    1 - cos(angle) for two.
    """
    centre, seen = arrays.centre[rows], arrays.seen()[rows].tocsc()
    at = seen.tocoo()
    ray = arrays.xyz[at.col] - centre[at.row]  # (m, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    rays = [sparse.csc_matrix((u, (at.row, at.col)), seen.shape) for u in ray.T]
    count = np.zeros(len(cuts), np.int64)
    for start in range(0, len(cuts), CUTS_AT_ONCE):
        chunk = cuts[start : start + CUTS_AT_ONCE].astype(float)
        sides = []
        for side in (chunk, 1 - chunk):
            n = np.asarray(side @ seen)  # (c, N)
            length2 = sum(np.asarray(side @ u) ** 2 for u in rays)
            sides.append((n > 0, n - length2 / np.maximum(n, 1) >= MIN_RAY_SPREAD))
        (one, one_deep), (two, two_deep) = sides
        count[start : start + CUTS_AT_ONCE] = ((one & two_deep) | (two & one_deep)).sum(1)
    return count


def _found_again(arrays: ModelArrays, rows: IntArray, side: BoolArray) -> tuple[int, int]:
    """Count the observations that the images of one side should have of the other side's points.

    Expected is a point that two images of its side see, in an image of the other side that it lies
    in, from a direction and a distance near those of one of the two.

    Args:
        side: (R,) of `rows`.
    Returns:
        how many are expected, and how many of these were made; of both directions together.
    """
    pose, centre, camera = arrays.cam_from_world[rows], arrays.centre[rows], arrays.camera
    every, size = arrays.seen()[rows], (camera.width, camera.height)
    img_from_cam = np.array(camera.calibration_matrix())
    expected = found = 0
    for own in (side, ~side):
        seen = every[own]
        points = np.flatnonzero(np.asarray(seen.sum(0)).ravel() >= 2)  # (n,)
        xyz, seen = arrays.xyz[points], seen[:, points].tocoo()
        there = every[~own][:, points].tocsr()
        border = np.argsort(-np.asarray(there.sum(1)).ravel(), kind="stable")[:BORDER_IMAGES]
        ray = centre[own][seen.row] - xyz[seen.col]  # (m, 3) from the point to a camera that has it
        length = np.linalg.norm(ray, axis=1)
        for image in border:
            there_from_world = pose[~own][image]
            at = xyz @ there_from_world[:, :3].T + there_from_world[:, 3]  # (n, 3)
            at = at @ img_from_cam.T
            inside = at[:, 2] > 0
            xy = at[:, :2] / np.where(inside, at[:, 2], 1)[:, None]
            inside &= ((xy > 0) & (xy < size)).all(1)
            here = centre[~own][image] - xyz  # (n, 3)
            away = np.linalg.norm(here, axis=1)[seen.col]
            cosine = (ray * here[seen.col]).sum(1) / (length * away)
            alike = cosine > np.cos(np.radians(NEAR_VIEW_DEG))
            alike &= np.abs(np.log(length / away)) < np.log(NEAR_VIEW_SCALE)
            inside &= np.bincount(seen.col[alike], minlength=len(points)) > 0
            expected += int(inside.sum())
            found += int(inside[there[image].indices].sum())
    return expected, found
