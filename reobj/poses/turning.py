"""Orientations of a camera that only turns: rotation averaging over all verified matches.

Without parallax no mapper finds a model, yet the matches determine all rotations, and by them the
focal length. Here every match is a direction that two images share. The rotations of all images,
the focal length and the distortion are adjusted together, so that a full turn closes.

A hand never turns on one point: what its motion adds to the directions of near objects is measured
as `spread_rad`. A walk is refused: along a wall a translation looks like a rotation, but leaves
more of the motion in the image unexplained than the sway of a hand.

Axes: K images, P pairs, M matches.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from reobj.cameras import import_pycolmap
from reobj.poses.bundle import FOCAL_RANGE, refine, unit_rows
from reobj.poses.features import MatchedPairs
from reobj.poses.mapping import posed
from reobj.poses.verification import MIN_PARALLAX_PX
from reobj.types import Array, IntArray, rows_by

PAIR_MATCHES = 60  # of a pair that are used; more change no rotation by .01 deg
SCALE_PX = 1.5  # of the Cauchy loss
ROUNDS = 12  # of reweighted least squares
# Distance of the points from the spot, world units: a usual one of objects in m; not measured
RADIUS = 2.5
# Fraction of the motion in the image that rotations may leave unexplained (measured: turns
# with 5 cm of sway .016, a turn with 20 cm .037; walks .064 to .8)
MAX_UNEXPLAINED = 0.04
MAX_SPREAD_DEG = 3.0  # of directions, and error of the rotations between the images of a pair
WIDEST = (0.2, 10.0)  # of a focal length over the longer side, beyond which it diverges
FOCAL_SIGMA = 0.3  # of the log of a guessed focal length
RADIAL_SIGMA = 0.1  # of the first coefficient of distortion


@dataclass(frozen=True, slots=True)
class Turn:
    """Rotations of images of one camera at one place.

    Attributes:
        camera: `pycolmap.Camera`, with the adjusted focal length and distortion.
        ids: (K,) of the images, ascending. cam_from_world: (K, 3, 3).
        image, keypoint, point: (M,) observations of points: row of the image, row of the keypoint,
            row of the point. direction: (N, 3) unit vectors of the points in world.
        spread_rad: robust sigma of the directions of one point in different images.
        unexplained: fraction of the motion in the image. closing_deg: error of the rotations
            between two images whose matches were not used for the start, 95th percentile.
        focal_sigma: of the log focal length.
    """

    camera: Any
    ids: IntArray
    cam_from_world: Array
    image: IntArray
    keypoint: IntArray
    point: IntArray
    direction: Array
    spread_rad: float
    unexplained: float
    closing_deg: float
    focal_sigma: float

    @property
    def quality(self) -> str:
        """Say how well the rotations close, for a message."""
        spread = np.degrees(self.spread_rad)
        return (
            f"rotations of {len(self.ids)} keyframes agree within {self.closing_deg:.2g} deg, "
            f"directions within {spread:.2g} deg"
        )

    @property
    def problem(self) -> str:
        """Name what contradicts a camera that turns on one spot; "": nothing."""
        longer = max(self.camera.width, self.camera.height)
        focal = self.camera.mean_focal_length() / longer
        found = (
            (self.unexplained > MAX_UNEXPLAINED,
             f"rotations leave {100 * self.unexplained:.0f} % of the motion unexplained"),
            (np.degrees(self.spread_rad) > MAX_SPREAD_DEG,
             f"directions of one point differ by {np.degrees(self.spread_rad):.1f} deg"),
            (self.closing_deg > MAX_SPREAD_DEG,
             f"the rotations contradict each other by {self.closing_deg:.1f} deg"),
            (not FOCAL_RANGE[0] < focal < FOCAL_RANGE[1] or self.focal_sigma > 0.1,
             f"the focal length of {focal:.2f} x the longer side is not determined"),
        )  # fmt: skip
        return next((text for bad, text in found if bad), "")


def estimate_turn(pairs: MatchedPairs, camera: Any, is_given: bool) -> Turn | None:
    """Estimate the rotations of the images of verified pairs, the largest connected set of them.

    Args:
        camera: `pycolmap.Camera` of all images; its focal length is a guess unless `is_given`.
    Returns:
        None where fewer than three images connect.
    """
    matches = _Matches.of(pairs)
    if matches is None:
        return None
    free = [] if is_given else [*camera.focal_length_idxs(), *camera.extra_params_idxs()][:2]
    camera = copy.copy(camera)
    rays = matches.rays(camera)
    turn, error = _pair_rotations(matches, rays)
    tree, order, parent = matches.spanning_tree(error)
    if len(order) < 3:
        return None
    rotation = _chained(matches, turn, tree, order, parent)
    inside = np.isin(matches.ends, order).all(1)  # (P,)
    matches = matches.of_pairs(np.flatnonzero(inside))
    found = _adjust(matches, rotation, order, camera, free)
    if found is None:
        return None
    rotation, focal_sigma = found
    return _measure(pairs, matches, rotation, np.sort(order), camera, focal_sigma)


def turning_model(turn: Turn, database: Path) -> tuple[Any, bool]:
    """Make a `pycolmap.Reconstruction` of a turn.

    A bundle adjustment finds the sway of the hand and the depths if it starts at equal depths, with
    the rotations of the turn. Ref: Yu and Gallup, CVPR 2014.

    Returns:
        the model; False: without parallax, all cameras are at 0, and points at RADIUS.
    """
    model = _at_one_place(turn, database)
    moves = bool(turn.spread_rad * turn.camera.mean_focal_length() >= MIN_PARALLAX_PX)
    if moves:
        refine(model)
    return model, moves


def _at_one_place(turn: Turn, database: Path) -> Any:
    """Make a model of a turn with all cameras at 0, and points at RADIUS."""
    pc = import_pycolmap()
    pose = np.concatenate([turn.cam_from_world, np.zeros((len(turn.ids), 3, 1))], 2)
    ids = turn.ids.tolist()
    poses = dict(zip(ids, pose, strict=True))
    model = posed(poses, turn.camera, database, database.with_name("turn.db"))
    for rows in rows_by(turn.point):
        track = pc.Track()
        for row in rows.tolist():
            track.add_element(ids[turn.image[row]], int(turn.keypoint[row]))
        model.add_point3D(RADIUS * turn.direction[turn.point[rows[0]]], track)
    return model


def pin(model: Any) -> None:
    """Move all cameras of a model to 0: only their rotations are known."""
    pc = import_pycolmap()
    for number in model.reg_image_ids():
        image = model.image(number)
        rotation = image.cam_from_world().rotation
        model.frame(image.frame_id).rig_from_world = pc.Rigid3d(rotation, np.zeros(3))


@dataclass(frozen=True, slots=True)
class _Matches:
    """Some matches of all pairs: ids (K,), ends (P, 2) rows of the images, pair (M,), xy (2, M, 2).

    start: (P,) first match of each pair.
    """

    ids: IntArray
    ends: IntArray
    pair: IntArray
    xy: Array
    start: IntArray

    @classmethod
    def of(cls, pairs: MatchedPairs) -> _Matches | None:
        """Take up to PAIR_MATCHES of each pair with enough, evenly."""
        rows = np.flatnonzero(pairs.enough)
        if not len(rows):
            return None
        ids, ends = np.unique(pairs.image_ids[rows], return_inverse=True)
        xy = list[Array]()
        for row in rows.tolist():
            found = pairs.inliers[row]
            few = np.linspace(0, len(found) - 1, min(len(found), PAIR_MATCHES)).astype(int)
            both = zip(pairs.image_ids[row].tolist(), found[few].T, strict=True)
            xy.append(np.stack([pairs.keypoints[i][side] for i, side in both]))
        count = [found.shape[1] for found in xy]
        pair = np.repeat(np.arange(len(rows)), count)
        start = np.cumsum([0, *count[:-1]])
        return cls(ids, ends.reshape(-1, 2), pair, np.concatenate(xy, 1), start)

    def rays(self, camera: Any) -> Array:
        """Return the unit rays (2, M, 3) in the frames of both images."""
        flat = self.xy.reshape(-1, 2)
        ideal = np.reshape(camera.cam_from_img(flat), (-1, 2))
        return unit_rows(np.insert(ideal, 2, 1, 1)).reshape(2, -1, 3)

    def spanning_tree(self, error: Array) -> tuple[Any, IntArray, IntArray]:
        """Connect the images by the pairs that rotations explain best; error: (P,) rad.

        Returns:
            sparse (K, K) with the number of the pair + 1; images of the largest component in the
            order of the tree; parent (K,) of each.
        """
        count = len(self.ids)
        shape = (count, count)
        graph = sparse.csr_matrix((error + 1e-4, self.ends.T), shape)
        label = connected_components(graph, directed=False)[1]
        first = int(np.flatnonzero(label == np.bincount(label).argmax())[0])
        tree = minimum_spanning_tree(graph)
        order, parent = breadth_first_order(tree, first, directed=False)
        number = sparse.csr_matrix((np.arange(len(error)) + 1, self.ends.T), shape)
        return number, order, parent

    def of_pairs(self, rows: IntArray) -> _Matches:
        """Return the matches of some pairs (ascending)."""
        keep = np.isin(self.pair, rows)
        pair = np.searchsorted(rows, self.pair[keep])
        start = np.searchsorted(pair, np.arange(len(rows)))
        return _Matches(self.ids, self.ends[rows], pair, self.xy[:, keep], start)

    def medians(self, values: Array) -> Array:
        """Return the median (P,) of values (M,) of each pair."""
        order = np.lexsort((values, self.pair))
        end = np.append(self.start[1:], len(values))
        return np.asarray(values[order[(self.start + end - 1) // 2]])


def _pair_rotations(matches: _Matches, rays: Array) -> tuple[Array, Array]:
    """Return the robust rotation (P, 3, 3) of each pair, other from one, and its median error, rad.

    Ref: Kabsch 1976; weights of the L1 norm.
    """
    weight = np.ones(rays.shape[1])
    for _ in range(ROUNDS):
        product = (weight[:, None] * rays[1])[:, :, None] * rays[0][:, None]  # (M, 3, 3)
        u, _, vt = np.linalg.svd(np.add.reduceat(product, matches.start))
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]  # no reflection
        turn = u @ vt
        moved = np.einsum("mij,mj->mi", turn[matches.pair], rays[0])
        off = np.linalg.norm(moved - rays[1], axis=1)
        weight = 1 / np.maximum(off, 1e-4)
    return turn, matches.medians(off)


def _chained(
    matches: _Matches, turn: Array, number: Any, order: IntArray, parent: IntArray
) -> Array:
    """Chain the rotations of pairs along the tree: cam_from_world (K, 3, 3)."""
    rotation = np.tile(np.eye(3), (len(matches.ids), 1, 1))
    for child in order[1:].tolist():
        above = int(parent[child])
        forward = int(number[above, child])
        k = (forward or int(number[child, above])) - 1
        step = turn[k] if forward else turn[k].T
        rotation[child] = step @ rotation[above]
    return rotation


def _adjust(
    matches: _Matches, rotation: Array, order: IntArray, camera: Any, free: list[int]
) -> tuple[Array, float] | None:
    """Adjust rotations, and `free` parameters of the camera, to all matches (Gauss-Newton).

    The camera is changed in place. Residuals are the differences of the directions in world of the
    two ends of each match, in px.

    Returns:
        cam_from_world (K, 3, 3); sigma of the log focal length. None: it diverges.
    """
    count = len(matches.ids)
    a, b = matches.ends[matches.pair].T
    focal = camera.mean_focal_length()
    start = np.array(camera.params)
    prior = np.array([FOCAL_SIGMA * focal, RADIAL_SIGMA])[: len(free)]
    size = 3 * count + len(free)
    fixed = np.isin(np.arange(size) // 3, np.setdiff1d(np.arange(count), order[1:]))
    fixed[3 * count :] = False
    row = np.arange(3 * len(a)).reshape(-1, 3)

    def world_rays(params: Array) -> tuple[Array, Array]:
        camera.params = params
        rays = matches.rays(camera)
        f = camera.mean_focal_length()  # in pixels: in rad a longer focal length would fit better
        one, other = (
            f * np.einsum("mji,mj->mi", rotation[end], ray)
            for end, ray in zip((a, b), rays, strict=True)
        )
        return one, other

    sigma = 0.0
    for _ in range(ROUNDS):
        params = np.array(camera.params)
        one, other = world_rays(params)
        off = one - other  # (M, 3)
        weight = 1 / (1 + (off**2).sum(1) / SCALE_PX**2)
        columns = [_cross_matrix(one), _cross_matrix(-other)]
        entries = np.concatenate([block.reshape(-1) for block in columns])
        rows = np.tile(np.repeat(row.ravel(), 3), 2)
        column = 3 * np.stack([a, b])[..., None] + np.arange(3)  # (2, M, 3)
        cols = np.repeat(column[:, :, None], 3, 2).ravel()
        J = sparse.csr_matrix((entries, (rows, cols)), (off.size, 3 * count))
        for k in free:
            step = 1e-4 * (params[k] if k == free[0] else 1.0)
            moved = params.copy()
            moved[k] += step
            p, q = world_rays(moved)
            J = sparse.hstack([J, sparse.csr_matrix(((p - q - off) / step).reshape(-1, 1))])
        camera.params = params
        J = J.tocsr()
        W = sparse.diags(np.repeat(weight, 3))
        normal = (J.T @ W @ J).tolil()
        gradient = J.T @ (np.repeat(weight, 3) * off.ravel())
        variance = max(float(np.average((off**2).sum(1), weights=weight) / 2), 1e-4)
        for n, k in enumerate(free):
            normal[3 * count + n, 3 * count + n] += variance / prior[n] ** 2
            gradient[3 * count + n] += variance * (params[k] - start[k]) / prior[n] ** 2
        keep = np.flatnonzero(~fixed)
        system = normal.tocsc()[keep][:, keep]
        delta = np.zeros(size)
        ridge = 1e-6 * sparse.diags(system.diagonal() + 1.0)
        delta[keep] = -spsolve(system + ridge, gradient[keep])
        delta[3 * count :] = delta[3 * count :].clip(-0.2 * focal, 0.2 * focal)
        turned = Rotation.from_rotvec(delta[: 3 * count].reshape(-1, 3)).as_matrix()
        rotation = rotation @ np.swapaxes(turned, 1, 2)
        for n, k in enumerate(free):
            params[k] += delta[3 * count + n]
        camera.params = params
        if free:
            last = np.zeros(len(keep))
            last[-len(free)] = 1.0
            inverse = spsolve(system, last)[-len(free)]
            # matches of a pair err alike: each pair counts once
            per_pair = len(a) / len(matches.ends)
            sigma = float(np.sqrt(inverse * variance * per_pair) / params[free[0]])
        if not np.isfinite(delta).all() or camera.has_bogus_params(*WIDEST, 1.0):
            return None
        if np.abs(delta[: 3 * count]).max() < 1e-5:
            break
    return rotation, sigma


def _cross_matrix(v: Array) -> Array:
    """Return the matrices (M, 3, 3) of d/dw (w x v) = -[v]x, at v (M, 3)."""
    x, y, z = v.T
    zero = np.zeros(len(v))
    return -np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), 2, 0)


def _measure(
    pairs: MatchedPairs, matches: _Matches, rotation: Array, rows: IntArray, camera: Any,
    focal_sigma: float,
) -> Turn:  # fmt: skip
    """Measure how well rotations explain all matches, and collect points."""
    a, b = matches.ends.T
    between = rotation[b] @ np.swapaxes(rotation[a], 1, 2)
    rays = matches.rays(camera)
    pair_turn, _ = _pair_rotations(matches, rays)
    relative = Rotation.from_matrix(between @ np.swapaxes(pair_turn, 1, 2))
    closing = np.degrees(relative.magnitude())
    moved = np.einsum("mij,mj->mi", between[matches.pair], rays[0])
    off = np.linalg.norm(moved - rays[1], axis=1)
    flow = np.linalg.norm(rays[0] - rays[1], axis=1)
    residual = matches.medians(off)
    share = residual.sum() / max(matches.medians(flow).sum(), 1e-9)
    spread = float(np.percentile(residual, 95)) / 1.18  # of a 2D normal: the median is 1.18 sigma
    image, keypoint, point, direction = _points(pairs, matches.ids[rows], rotation[rows], camera)
    return Turn(
        camera, matches.ids[rows], rotation[rows], image, keypoint, point, direction,
        spread, float(share), float(np.percentile(closing, 95)), focal_sigma,
    )  # fmt: skip


def _points(
    pairs: MatchedPairs, ids: IntArray, rotation: Array, camera: Any
) -> tuple[IntArray, IntArray, IntArray, Array]:
    """Join the matches of images ids (K,) to points: observations as of `Turn`, and directions."""
    used = np.flatnonzero(pairs.enough & np.isin(pairs.image_ids, ids).all(1))
    first = np.cumsum([0, *(len(pairs.keypoints[i]) for i in ids.tolist())])
    ends = np.searchsorted(ids, pairs.image_ids[used])
    joined = [first[end] + pairs.inliers[row] for end, row in zip(ends, used.tolist(), strict=True)]
    one, other = np.concatenate(joined).T
    total = int(first[-1])
    graph = sparse.csr_matrix((np.ones(len(one)), (one, other)), (total, total))
    label = connected_components(graph, directed=False)[1]
    count = np.bincount(label)
    seen = np.flatnonzero(count[label] > 1)  # keypoints
    image = np.searchsorted(first, seen, "right") - 1
    xy = np.concatenate([pairs.keypoints[i] for i in ids.tolist()])[seen]
    ideal = np.reshape(camera.cam_from_img(xy), (-1, 2))
    ray = unit_rows(np.insert(ideal, 2, 1, 1))
    world = np.einsum("mji,mj->mi", rotation[image], ray)
    _, point = np.unique(label[seen], return_inverse=True)
    mean = np.zeros((point.max(initial=-1) + 1, 3))
    np.add.at(mean, point, world)
    mean = unit_rows(mean)
    agrees = np.linalg.norm(world - mean[point], axis=1) < np.radians(MAX_SPREAD_DEG)
    many = np.bincount(point[agrees], minlength=len(mean))[point] > 1
    keep = agrees & many
    kept, point = np.unique(point[keep], return_inverse=True)
    return image[keep], seen[keep] - first[image[keep]], point, mean[kept]
