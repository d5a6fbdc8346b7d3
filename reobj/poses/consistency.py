"""Check a reconstruction against its own evidence, and take apart what does not hold together.

A mapper can join two worlds by a few wrong matches, or register a frame metres from where it was:
the reprojection error shows neither. What shows it is how many points tie two groups of images
together, and whether the model explains the matches of pictures that follow each other. Needs no
truth and no threshold of one recording.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from reobj.cameras import import_pycolmap
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
MIN_MATCHES = 30  # verified matches of neighbours that say something (COLMAP registers from 30 on)
MIN_TIED = 0.1  # share of them that are one point of the model (measured: right .38-.98, wrong 0)
MIN_BRIDGE = 30  # points that tie two groups of images (COLMAP registers one image from 30 on)
MIN_GROUP = 3  # images; fewer that hang on few points are left to be located by PnP
WEAKEST_CUTS = 3  # whose missing points are counted (chosen: time)
BORDER_IMAGES = 10  # of each side of a cut, those that share the most points (chosen: time)
NEAR_VIEW_DEG = 30.0  # turn of a view up to which a point is found again (SIFT: Lowe 2004, fig. 9)
NEAR_VIEW_SCALE = 2.0  # change of distance up to which it is (an octave; chosen)
MIN_SEEN = 0.03  # share of such points that must be found again (measured: right .065-.5, wrong
# 0-.007); and how many must be expected so that none says something:
MIN_EXPECTED = 100


def consistent_groups(model: Any, pairs: MatchedPairs) -> list[IntArray]:
    """Split the images of a model into groups that hold together.

    Args:
        model: a `pycolmap.Reconstruction` with one camera; ids ascend in time.
        pairs: verified matches of its database.
    Returns:
        ids of the images of each group, the largest group first; images that hang on by too little
        are in none.
    """
    views = _read_views(model)
    todo, groups = _runs_of_tied_neighbours(model, pairs, views.ids), []
    while todo:
        rows = todo.pop()
        side = _weak_cut(views, rows)
        if side is None:
            groups.append(views.ids[rows])
            continue
        todo += [rows[s] for s in (side, ~side) if s.sum() >= MIN_GROUP]
    return sorted(groups, key=lambda g: (-len(g), int(g[0])))


@dataclass(frozen=True, slots=True)
class _Views:
    """A model as arrays: R images, N points.

    Attributes:
        ids: (R,) of the images, ascending. cam_from_world: (R, 3, 4).
        img_from_cam: (3, 3), without distortion. size: (w, h).
        xyz: (N, 3) points. seen: (R, N) sparse, 1 where an image observes a point.
    """

    ids: IntArray
    cam_from_world: Array
    img_from_cam: Array
    size: tuple[int, int]
    xyz: Array
    seen: Any


def _read_views(model: Any) -> _Views:
    ids = np.array(sorted(model.reg_image_ids()), np.int64)
    row = {int(i): r for r, i in enumerate(ids)}
    points = [model.point3D(i) for i in sorted(model.point3D_ids())]
    observed = {
        (row[element.image_id], column)
        for column, point in enumerate(points)
        for element in point.track.elements
    }
    at = np.array(sorted(observed), np.int64).reshape(-1, 2)
    camera = model.camera(next(iter(model.cameras)))
    return _Views(
        ids,
        np.array([model.image(int(i)).cam_from_world().matrix() for i in ids]).reshape(-1, 3, 4),
        np.array(camera.calibration_matrix()),
        (camera.width, camera.height),
        np.array([point.xyz for point in points]).reshape(-1, 3),
        sparse.csr_matrix((np.ones(len(at)), at.T), (len(ids), len(points))),
    )


def explained_share(model: Any, pairs: MatchedPairs, rows: IntArray) -> Array:
    """Compute the share of the verified matches of pairs that lie on the model's epipolar lines.

    Args:
        rows: (n,) of `pairs`; both images are in the model.
    Returns:
        (n,) shares; the distance is Sampson's, to first order.
    Ref: Hartley and Zisserman 2004, eq. 11.9.
    """
    camera = model.camera(next(iter(model.cameras)))
    focal, shares = camera.mean_focal_length(), np.ones(len(rows))
    for k, pair in enumerate(rows):
        rays, poses = [], []
        for side, image_id in enumerate(pairs.image_ids[pair].tolist()):
            xy = pairs.keypoints[image_id][pairs.inliers[pair][:, side]]
            ideal = np.reshape(camera.cam_from_img(xy), (-1, 2))
            rays.append(np.column_stack([ideal, np.ones(len(xy))]))  # (m, 3)
            poses.append(model.image(image_id).cam_from_world().matrix())
        rotation = poses[1][:, :3] @ poses[0][:, :3].T
        x, y, z = poses[1][:, 3] - rotation @ poses[0][:, 3]
        E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
        line_b, line_a = rays[0] @ E.T, rays[1] @ E  # (m, 3)
        slope = (line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)
        distance = np.abs((rays[1] * line_b).sum(1)) / np.sqrt(slope + 1e-18) * focal
        shares[k] = np.mean(distance < EXPLAINED_PX)
    return shares


def count_explained(model: Any, pairs: MatchedPairs) -> float:
    """Count the verified matches between the images of a model that the model explains."""
    inside = np.isin(pairs.image_ids, model.reg_image_ids()).all(1)
    rows = np.flatnonzero(inside & np.array([len(m) > 0 for m in pairs.inliers], bool))
    counts = np.array([len(pairs.inliers[row]) for row in rows])
    return float((explained_share(model, pairs, rows) * counts).sum())


def _runs_of_tied_neighbours(model: Any, pairs: MatchedPairs, ids: IntArray) -> list[IntArray]:
    """Split rows of `ids` where the model does not hold the matches of neighbours in time together.

    Images of the model that follow each other show one place (others may be alike by chance): a
    good share of their verified matches must be one point of the model, two observations each. They
    are not where the camera was put at a twin of its place, or at another scale. An image that is
    tied to neither of its neighbours is left out, so that it does not split the rest.

    Returns:
        rows (n,) of each run, ascending.
    """
    point_of = {
        i: np.array([p.point3D_id if p.has_point3D() else -1 for p in model.image(i).points2D])
        for i in ids.tolist()
    }
    row = {int(i): r for r, i in enumerate(ids)}
    untied = np.zeros(len(ids) + 1, bool)  # of each row and the one before it
    for (a, b), matches in zip(pairs.image_ids.tolist(), pairs.inliers, strict=True):
        if a in row and b in row and abs(row[a] - row[b]) == 1 and len(matches) >= MIN_MATCHES:
            one, other = point_of[a][matches[:, 0]], point_of[b][matches[:, 1]]
            tied = np.mean((one == other) & (one >= 0))
            untied[max(row[a], row[b])] = tied < MIN_TIED
    loose = untied[:-1] & untied[1:]
    starts = np.flatnonzero(untied[:-1] & ~loose & ~np.append(False, loose[:-1]))
    runs = np.split(np.arange(len(ids)), starts)
    return [kept for run in runs if len(kept := run[~loose[run]])]


def _shared_points(seen: Any) -> Array:
    """Count the points (R, R) that two images share, 0 on the diagonal."""
    shared = np.asarray((seen @ seen.T).todense(), np.float64)
    np.fill_diagonal(shared, 0)
    return shared


def _weak_cut(views: _Views, rows: IntArray) -> BoolArray | None:
    """Find two groups of images that too little ties together.

    Candidates are the cuts of the spanning tree of most shared points. A point ties two groups,
    and their scales, if it is seen in both and twice in one. Too few are few points, or few of
    those that should be found again: near views of a place that share nothing are two places.

    Returns:
        (R,) True on one side, None if all holds together.
    """
    seen = views.seen[rows]
    shared = _shared_points(seen)
    tree = minimum_spanning_tree(sparse.csr_matrix(np.where(shared > 0, 1 / (shared + 1), 0)))
    order, parent = breadth_first_order(tree, 0, directed=False)
    if len(order) < len(rows):  # not even connected
        return np.isin(np.arange(len(rows)), order)
    below = np.eye(len(rows), dtype=bool)  # (R, R) the subtree of each image
    for child in order[:0:-1]:
        below[parent[child]] |= below[child]
    cuts = below[order[1:]]  # (R - 1, R) one for each edge of the tree
    inside, total = sparse.csr_matrix(cuts.astype(float)) @ seen, np.asarray(seen.sum(0)).ravel()
    one = np.asarray(inside.todense())  # (R - 1, N)
    bridge = ((one > 0) & (one < total) & (total > 2)).sum(1)
    for cut in np.argsort(bridge, kind="stable"):
        if bridge[cut] < MIN_BRIDGE:
            return np.asarray(cuts[cut])
    smaller = np.minimum(cuts.sum(1), (~cuts).sum(1))
    groups = np.flatnonzero(smaller >= MIN_GROUP)
    for cut in groups[np.argsort(bridge[groups], kind="stable")[:WEAKEST_CUTS]]:
        expected, found = _found_again(views, rows, np.asarray(cuts[cut]))
        if expected >= MIN_EXPECTED and found < MIN_SEEN * expected:
            return np.asarray(cuts[cut])
    return None


def _found_again(views: _Views, rows: IntArray, side: BoolArray) -> tuple[int, int]:
    """Count the observations that the images of one side should have of the other side's points.

    Expected is a point that two images of its side see, in an image of the other side that it lies
    in, from a direction and a distance near those of one of the two.

    Args:
        side: (R,) of `rows`.
    Returns:
        how many are expected, and how many of these were made; of both directions together.
    """
    pose, size = views.cam_from_world[rows], np.array(views.size)
    centre = -np.einsum("nij,ni->nj", pose[:, :, :3], pose[:, :, 3])  # (R, 3)
    expected = found = 0
    for own in (side, ~side):
        seen = views.seen[rows[own]]
        points = np.flatnonzero(np.asarray(seen.sum(0)).ravel() >= 2)  # (n,)
        xyz, seen = views.xyz[points], seen[:, points].tocoo()
        there = views.seen[rows[~own]][:, points].tocsr()
        border = np.argsort(-np.asarray(there.sum(1)).ravel(), kind="stable")[:BORDER_IMAGES]
        ray = centre[own][seen.row] - xyz[seen.col]  # (m, 3) from the point to a camera that has it
        length = np.linalg.norm(ray, axis=1)
        for image in border:
            camera = pose[~own][image]
            at = (xyz @ camera[:, :3].T + camera[:, 3]) @ views.img_from_cam.T  # (n, 3)
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
