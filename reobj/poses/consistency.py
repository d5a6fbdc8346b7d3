"""Check a reconstruction against its own evidence, and take apart what does not hold together.

A mapper can join two worlds by a few wrong matches, or register a frame metres from where it was:
the reprojection error shows neither. What shows it is how many points tie two groups of images
together, and whether the model explains the matches of pictures that follow each other. Needs no
truth and no threshold of one recording.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, maximum_flow, minimum_spanning_tree

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

    def among(self, ids: Sequence[int]) -> MatchedPairs:
        """Return the pairs of some images alone."""
        rows = np.flatnonzero(np.isin(self.image_ids, list(ids)).all(1))
        chosen = [self.inliers[row] for row in rows]
        return MatchedPairs(self.image_ids[rows], chosen, self.keypoints, self.fundamental[rows])


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
MIN_MATCHES = 30  # verified matches of neighbours that can contradict (COLMAP registers from 30)
MIN_EXPLAINED = 0.5  # share of them that the model must explain (measured: right .64-1, wrong 0-.4)
MIN_BRIDGE = 30  # points that tie two groups of images (COLMAP registers one image from 30 on)
MIN_BRIDGE_SHARE = 0.2  # of the points that neighbours usually share (measured: right .5-3, wrong
# .05-.15)
MIN_GROUP = 3  # images; fewer that hang on few points are left to be located by PnP


def consistent_groups(model: Any, pairs: MatchedPairs, order: Sequence[int]) -> list[IntArray]:
    """Split the images of a model into groups that hold together.

    Args:
        model: a `pycolmap.Reconstruction` with one camera.
        pairs: verified matches of its database.
        order: ids of all keyframes in the order of time.
    Returns:
        ids of the images of each group, the largest group first; images that hang on by too little
        are in none.
    """
    ids, seen = _visibility(model)
    shared = np.asarray((seen @ seen.T).todense(), np.float64)  # (R, R) points of two images
    np.fill_diagonal(shared, 0)
    contradicted = _contradicted_neighbours(model, pairs, ids, order)
    todo, groups = [np.arange(len(ids))], []
    while todo:
        rows = todo.pop()
        side = _contradiction_cut(shared, rows, contradicted)
        if side is None:
            side = _weakest_cut(shared, seen, rows)
        if side is None:
            groups.append(ids[rows])
            continue
        todo += [rows[s] for s in (side, ~side) if s.sum() >= MIN_GROUP]
    return sorted(groups, key=lambda g: (-len(g), int(g[0])))


def _visibility(model: Any) -> tuple[IntArray, Any]:
    """Return the image ids (R,) of a model, ascending, and who sees which point: (R, N) sparse."""
    ids = np.array(sorted(model.reg_image_ids()), np.int64)
    row = {int(i): r for r, i in enumerate(ids)}
    points = sorted(model.point3D_ids())
    observed = [
        (row[element.image_id], column)
        for column, p in enumerate(points)
        for element in model.point3D(p).track.elements
    ]
    at = np.array(sorted(set(observed)), np.int64).reshape(-1, 2)
    shape = (len(ids), len(points))
    return ids, sparse.csr_matrix((np.ones(len(at)), (at[:, 0], at[:, 1])), shape)


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


def _contradicted_neighbours(
    model: Any, pairs: MatchedPairs, ids: IntArray, order: Sequence[int]
) -> IntArray:
    """Find pairs (n, 2) of rows of `ids` that follow each other in time and contradict the model.

    Pictures that follow each other show one place; other pairs may look alike by chance.
    """
    place, row = {image: k for k, image in enumerate(order)}, {int(i): r for r, i in enumerate(ids)}
    near = [
        k
        for k, (a, b) in enumerate(pairs.image_ids.tolist())
        if a in row and b in row and abs(place[a] - place[b]) == 1
        and len(pairs.inliers[k]) >= MIN_MATCHES
    ]  # fmt: skip
    share = explained_share(model, pairs, np.array(near, np.int64))
    wrong = pairs.image_ids[np.array(near, np.int64)[share < MIN_EXPLAINED]]
    return np.array([[row[a], row[b]] for a, b in wrong.tolist()], np.int64).reshape(-1, 2)


def _contradiction_cut(shared: Array, rows: IntArray, contradicted: IntArray) -> BoolArray | None:
    """Separate the first two contradicting images among `rows` where the fewest points are shared.

    Returns:
        (R,) True on one side, None if no pair of rows contradicts.
    """
    where = {int(r): k for k, r in enumerate(rows)}
    for a, b in contradicted.tolist():
        if a in where and b in where:
            capacity = sparse.csr_matrix(shared[np.ix_(rows, rows)].astype(np.int32))
            flow = maximum_flow(capacity, where[a], where[b]).flow
            left = capacity - flow
            left.eliminate_zeros()
            label = _reachable(left, where[a])
            return label
    return None


def _reachable(graph: Any, start: int) -> BoolArray:
    """Mark the nodes (R,) that are reached from `start` along positive edges."""
    order = sparse.csgraph.breadth_first_order(graph.maximum(0), start, return_predecessors=False)
    found = np.zeros(graph.shape[0], bool)
    found[order] = True
    return found


def _weakest_cut(shared: Array, seen: Any, rows: IntArray) -> BoolArray | None:
    """Find the two groups of images that the fewest points tie together, if these are too few.

    Candidates are the cuts of the spanning tree of most shared points. A point ties two groups in
    scale too if it is seen twice in one of them.

    Returns:
        (R,) True on one side, None if all holds together.
    """
    own = shared[np.ix_(rows, rows)]
    loose = np.flatnonzero(own.max(1, initial=0) <= 0)
    if len(loose):
        return np.asarray(np.isin(np.arange(len(rows)), loose[:1]))
    tree = minimum_spanning_tree(sparse.csr_matrix(np.where(own > 0, 1 / np.maximum(own, 1), 0)))
    count, label = connected_components(tree, directed=False)
    if count > 1:
        return np.asarray(label == 0)
    edges = tree.tocoo()
    usual = float(np.median(own[edges.row, edges.col])) if edges.nnz else 0.0
    needed = max(MIN_BRIDGE, MIN_BRIDGE_SHARE * usual)
    visible, dense = seen[rows], tree.toarray()
    weakest, cut = needed, None
    for a, b in zip(edges.row, edges.col, strict=True):
        weight, dense[a, b] = dense[a, b], 0
        side = connected_components(sparse.csr_matrix(dense), directed=False)[1]
        dense[a, b] = weight
        side = np.asarray(side == side[a])
        one, other = (np.asarray(visible[s].sum(0)).ravel() for s in (side, ~side))  # (N,)
        bridge = ((one > 0) & (other > 0) & (one + other > 2)).sum()
        least = needed if min(side.sum(), (~side).sum()) >= MIN_GROUP else MIN_BRIDGE
        if bridge < min(weakest, least):
            weakest, cut = float(bridge), side
    return cut
