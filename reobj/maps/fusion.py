"""Current state of the map: each object fused from its observations, and the scale of the world."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import quat_wxyz_from_matrix
from reobj.maps.room_map import MapObject, Observation, RoomMap
from reobj.results.result import Object
from reobj.tracking.ellipsoid_map import EllipsoidMap
from reobj.types import Array, BoolArray, Embeddings, Floats, IntArray, ReobjError, unit_rows
from reobj.words import meant

PLACE_SIGMA_M = 0.01  # of a place between sessions: cleaning and leaning shift an object by 1 cm
DETECTED = (8.0, 2.0)  # Beta prior of detections and misses: 80 %, worth ten views
MOST_DETECTED = 0.98  # no detector is certain, and views of one session fail together
CHI2_3 = 14.16  # 3 sigma of a normal variable (99.73 %), for the squared distance in 3 dimensions


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """Classes, shape and looks of an object of a map or of a recording.

    Attributes:
        id: number in the map, or identity in the recording. classes: weight of each class.
        support, center, half_axes, quat_wxyz, cov: shape as in `Observation`.
        foreground, background: mean unit embeddings of one model; empty: none.
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


@dataclass(frozen=True, slots=True, eq=False)
class ObjectState(Described):
    """State of an object of the map after its last session, at the place where it was last seen.

    The covariance includes the uncertainty of the alignment of the sessions.

    Attributes:
        embedder: model of the embeddings. class_name: given by the user, or that of most weight.
        present: False if it was gone in the last session that saw its place.
        deleted: by the user.
        detection_rate: probability of a detection in a view in which it is expected.
        log_odds: that it is a real object.
    """

    embedder: str
    class_name: str
    present: bool
    deleted: bool
    detection_rate: float
    log_odds: float


def object_state(found: MapObject, room: RoomMap) -> ObjectState:
    """Fuse the observations of an object.

    The centre and the orientation come from the observations at its last place (since it was
    "moved" or "new"), the sizes from all observations with the same kind of shape.

    Raises:
        ReobjError: the object was not detected in any session.
    """
    observations = sorted(found.observations, key=lambda o: o.session)
    detected = [o for o in observations if o.detected]
    if not detected:
        raise ReobjError(f"object {found.id} was not detected in any session of the map")
    weight = class_weights(detected)
    classes = dict(sorted(weight.items(), key=lambda entry: (-entry[1], entry[0])))
    expected = sum(o.expected for o in detected)
    hits = DETECTED[0] + expected - sum(o.missed for o in detected)
    support, shape = _fused(detected, room)
    foreground, background, embedder = _embeddings(detected, room)
    return ObjectState(
        found.id,
        classes,
        support,
        shape.center[0],
        np.exp(shape.log_half[0]),
        quat_wxyz_from_matrix(shape.rot)[0],
        shape.cov[0],
        foreground,
        background,
        embedder,
        class_name=found.name or next(iter(classes), "object"),
        present=[o.status for o in observations if o.status != "not_seen"][-1] != "gone",
        deleted=found.deleted,
        detection_rate=min(hits / (sum(DETECTED) + expected), MOST_DETECTED),
        log_odds=float(np.clip(sum(o.log_odds for o in observations), -10.0, 10.0)),
    )


def class_weights(detected: Sequence[Observation]) -> dict[str, float]:
    """Add the weights of each class, by name."""
    names = sorted({name for o in detected for name in o.classes})
    return {name: sum(o.classes.get(name, 0.0) for o in detected) for name in names}


def state_before(found: MapObject, session: int, room: RoomMap) -> ObjectState | None:
    """Return the state of an object before a session; None: it was not known."""
    rows = tuple(o for o in found.observations if o.session < session)
    if not any(o.detected for o in rows):
        return None
    return object_state(dataclasses.replace(found, observations=rows), room)


def _embeddings(detected: Sequence[Observation], room: RoomMap) -> tuple[Floats, Floats, str]:
    """Return the mean unit embeddings of an object by its last embedder, and this model."""
    embedder_of = {s.number: s.embedder for s in room.sessions}
    rows = [o for o in detected if o.embedded > 0 and o.foreground.size]
    means = [np.empty(0, np.float32)] * 2
    if not rows:
        return means[0], means[1], ""
    embedder = embedder_of[rows[-1].session]
    width = rows[-1].foreground.size
    rows = [o for o in rows if embedder_of[o.session] == embedder and o.foreground.size == width]
    for k, name in enumerate(("foreground", "background")):
        if known := [o for o in rows if getattr(o, name).size == width]:
            weight = np.array([o.embedded for o in known], np.float64)
            total = weight @ np.array([getattr(o, name) for o in known], np.float64)  # (E,)
            means[k] = unit_rows(total[None])[0].astype(np.float32)
    return means[0], means[1], embedder


def shapes_of(objects: Sequence[Described] | Sequence[Object]) -> quadrics.Ellipsoids:
    """Return the ellipsoids of objects, in the world of the map, inscribed in their shapes."""
    return quadrics.Ellipsoids(
        np.array([o.center for o in objects]).reshape(-1, 3),
        np.array([o.half_axes for o in objects]).reshape(-1, 3),
        _axes(np.array([o.quat_wxyz for o in objects]).reshape(-1, 4)),
    )


def _axes(quat_wxyz: Array) -> Array:
    """Return world_from_obj (K, 3, 3) of quaternions (K, 4)."""
    xyzw = quat_wxyz[:, [1, 2, 3, 0]]  # before scipy 1.16 not of no rows
    return Rotation.from_quat(xyzw).as_matrix() if len(xyzw) else np.empty((0, 3, 3))


def scaled_radius(xyz: Array, shapes: quadrics.Ellipsoids, k: int) -> Array:
    """Return squared distances (N,) of points (N, 3) from the centre of shape k, in half axes."""
    scaled = (xyz - shapes.center_in_world[k]) @ shapes.world_from_obj[k] / shapes.half_axes[k]
    return np.asarray((scaled**2).sum(1))


# ---- Shape -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Shapes of K observations in the world of the map; half axes as in `Observation`.

    Attributes:
        center: (K, 3). log_half: (K, 3). rot: (K, 3, 3) world_from_obj.
        cov: (K, 9, 9) as in `Observation`, with the alignment of the sessions.
    """

    center: Array
    log_half: Array
    rot: Array
    cov: Array


def observed_shapes(detected: Sequence[Observation], room: RoomMap) -> Shapes:
    """Stack the shapes of K observations and add the uncertainty of their alignment.

    A similarity x -> exp(scale) exp([rotation]) x + translation about the origin of the world acts
    on the centre, its scale on the sizes, its rotation on the orientation. Added to the centre is
    the sigma of a place between sessions.

    Args:
        detected: observations with a shape.
    """
    center = np.array([o.center for o in detected])
    log_half = np.log(np.array([o.half_axes for o in detected]))
    rot = _axes(np.array([o.quat_wxyz for o in detected]))
    alignment = {s.number: s.alignment_cov for s in room.sessions}
    sigma = np.array([alignment[o.session] for o in detected])  # (K, 7, 7)
    jacobian = np.zeros((len(center), 9, 7))
    jacobian[:, :3] = alignment_jacobian(center)
    jacobian[:, 3:6, 6] = 1.0
    jacobian[:, 6:, :3] = rot.swapaxes(1, 2)
    cov = _valid(np.array([o.cov for o in detected]))
    cov = cov + jacobian @ sigma @ jacobian.swapaxes(1, 2)
    cov[:, [0, 1, 2], [0, 1, 2]] += (PLACE_SIGMA_M / scale_of(room).value) ** 2
    return Shapes(center, log_half, rot, cov)


def alignment_jacobian(point: Array) -> Array:
    """Return (M, 3, 7) derivatives of points by rotation vector, translation and log scale."""
    x, y, z = point.T
    zero = np.zeros_like(x)
    rotation = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)
    translation = np.broadcast_to(np.eye(3), (len(point), 3, 3))
    return np.concatenate([rotation, translation, point[:, :, None]], axis=2)


def _valid(cov: Array) -> Array:
    """Return covariances (K, 9, 9) whose correlations have eigenvalues of at least 1e-6.

    The file stores float32: rounding changes the eigenvalues of a correlation matrix by up to
    9 x 6e-8. A sigma is at least 1e-6 (rad, log).
    """
    sigma = np.sqrt(np.maximum(np.einsum("kii->ki", cov), 1e-12))
    outer = sigma[:, :, None] * sigma[:, None]
    value, vector = np.linalg.eigh((cov + cov.swapaxes(1, 2)) / (2 * outer))
    value = np.maximum(value, 1e-6)
    return np.asarray(np.einsum("kij,kj,klj->kil", vector, value, vector) * outer)


def _fused(detected: Sequence[Observation], room: RoomMap) -> tuple[str, Shapes]:
    """Fuse the shapes of an object's observations, by session, by their information.

    Orientations that differ by more than 3 sigma or 30 degrees are not averaged: that of the
    smallest variance counts. Kinds of shape differ in what their half axes mean: only the centre of
    observations of another kind than that of the most views counts.

    Returns:
        the kind, and one shape.
    """
    starts = [k for k, o in enumerate(detected) if o.status in ("new", "moved")] or [0]
    here = np.arange(len(detected)) >= starts[-1]
    kind = max(detected[starts[-1] :], key=lambda o: o.views).support
    same = np.array([o.support == kind for o in detected])
    is_round = kind == "cylinder"
    upright = room.up is not None or is_round  # the third axis stays the third one
    shapes = observed_shapes(detected, room)
    turning = np.einsum("kii->k", shapes.cov[:, 6:, 6:])
    ref = int(np.where(here & same, turning, np.inf).argmin())
    delta, cov, agree = _nearest_orientation(shapes, ref, upright, is_round)
    by_size, cov_by_size, alike = _nearest_sizes(shapes, ref, upright, is_round)
    oriented = here & same & agree
    delta = np.where(oriented[:, None], delta, by_size)
    cov = np.where(oriented[:, None, None], cov, cov_by_size)
    used = np.repeat(np.stack([here, same & (oriented | alike), oriented], 1), 3, axis=1)  # (K, 9)
    both = used[:, :, None] & used[:, None]
    info = np.where(both, np.linalg.inv(np.where(both, cov, np.eye(9))), 0.0)
    fused_cov = np.linalg.inv(info.sum(0))
    step = fused_cov @ np.einsum("kij,kj->i", info, delta)
    return kind, Shapes(
        shapes.center[[ref]] + step[:3],
        shapes.log_half[[ref]] + step[3:6],
        shapes.rot[[ref]] @ Rotation.from_rotvec(step[6:]).as_matrix(),
        (fused_cov + fused_cov.T)[None] / 2,
    )


def _nearest_orientation(
    shapes: Shapes, ref: int, upright: bool, is_round: bool
) -> tuple[Array, Array, BoolArray]:
    """Express every shape in the equivalent axes whose directions are nearest to the reference.

    Args:
        is_round: the yaw about the third axis is arbitrary.
    Returns:
        increments (K, 9) from the reference, their covariances (K, 9, 9), and whether the
        orientations agree (K,).
    """
    target = np.broadcast_to(shapes.rot[ref], shapes.rot.shape)
    turn = quadrics.nearest_axes(shapes.rot, target, upright)
    relative = shapes.rot[ref].T @ shapes.rot  # (K, 3, 3)
    rotation = turn
    if is_round:
        rotvec = quadrics.rotation_vectors(relative @ turn)
        # the yaw that leaves the smallest rotation: the twist of the relative quaternion
        half = np.linalg.norm(rotvec, axis=1) / 2
        twist = 2 * np.arctan2(rotvec[:, 2] * np.sinc(half / np.pi) / 2, np.cos(half))
        rotation = turn @ quadrics.rotations(-twist[:, None] * [0, 0, 1])
    rotvec = quadrics.rotation_vectors(relative @ rotation)
    order = np.abs(turn).swapaxes(1, 2)
    log_half = (order @ shapes.log_half[..., None])[..., 0]
    change = np.tile(np.eye(9), (len(turn), 1, 1))
    change[:, 3:6, 3:6] = order
    change[:, 6:, 6:] = rotation.swapaxes(1, 2)
    cov = change @ shapes.cov @ change.swapaxes(1, 2)
    both = np.linalg.inv(cov[:, 6:, 6:] + cov[ref, 6:, 6:])
    agree = np.einsum("ki,kij,kj->k", rotvec, both, rotvec) < CHI2_3
    agree &= np.linalg.norm(rotvec, axis=1) < np.deg2rad(30)
    shift = [shapes.center - shapes.center[ref], log_half - shapes.log_half[ref], rotvec]
    return np.concatenate(shift, 1), cov, agree


def _nearest_sizes(
    shapes: Shapes, ref: int, upright: bool, third_is_axis: bool
) -> tuple[Array, Array, BoolArray]:
    """Order the axes of every shape so that its sizes are nearest to the reference.

    For shapes at another place or in another orientation. An upright object may have been laid on
    its side: its third axis changes if the sizes agree by 3 sigma better so.

    Returns:
        increments (K, 9) from the reference without rotation, their covariances (K, 9, 9), and
        whether the sizes agree (K,).
    """
    orders = quadrics.AXIS_ORDERS  # (6, 3)
    size_cov = shapes.cov[:, 3:6, 3:6][:, orders[:, :, None], orders[:, None]]  # (K, 6, 3, 3)
    error = shapes.log_half[:, orders] - shapes.log_half[ref]  # (K, 6, 3)
    inverse = np.linalg.inv(size_cov + shapes.cov[ref, 3:6, 3:6])
    distance = np.einsum("kgi,kgij,kgj->kg", error, inverse, error)
    keeps_third = (orders[:, 2] == 2) | (not upright)
    penalty = np.where(keeps_third, 0.0, np.inf if third_is_axis else CHI2_3)
    best = (distance + penalty).argmin(1)
    rows = np.arange(len(best))
    index = np.tile(np.arange(9), (len(best), 1))
    index[:, 3:6] = 3 + orders[best]
    cov = shapes.cov[rows[:, None, None], index[:, :, None], index[:, None]]
    shift = [shapes.center - shapes.center[ref], error[rows, best], np.zeros((len(best), 3))]
    return np.concatenate(shift, 1), cov, distance[rows, best] < CHI2_3


# ---- Scale -------------------------------------------------------------------------------------


def scale_of(room: RoomMap) -> quadrics.Scale:
    """Return metres per unit of the map's world, from all sessions that measured it.

    Measurements with metric poses or known sizes are independent: they are averaged by inverse
    variance, and those from size priors are then ignored. The errors of size priors are common to
    all sessions, which see the same categories: the value is the mean, weighted likewise, its sigma
    the smallest of a session (covariance intersection, Julier and Uhlmann 1997).

    Returns:
        value 1 and source "none" if no session measured it.
    """
    if room.metric:
        return quadrics.Scale(1.0, 0.0, "poses")
    metric = [s for s in room.sessions if s.scale_source in ("poses", "known_size")]
    sessions = metric or [s for s in room.sessions if s.scale_source == "priors"]
    if not sessions:
        return quadrics.Scale(1.0, 0.0, "none")
    value = np.log([s.metres_per_unit for s in sessions])
    # exact poses have sigma 0: at least 1e-6
    variance = [max(s.scale_rel_sigma**2 + s.alignment_cov[6, 6], 1e-12) for s in sessions]
    weight = 1 / np.array(variance)
    mean = float(np.exp(np.average(value, weights=weight)))
    pooled = 1 / weight.sum() if metric else min(variance)
    return quadrics.Scale(mean, float(np.sqrt(pooled)), sessions[weight.argmax()].scale_source)


# ---- For a tracker that starts from a map -------------------------------------------------------


def class_ids(states: Sequence[ObjectState], class_names: Sequence[str]) -> IntArray:
    """Return the class id (N,) of each object: of its likeliest class in the names, -1: none."""
    found = [[k for word in (s.class_name, *s.classes) for k in meant(word, class_names)[:1]]
             for s in states]  # fmt: skip
    return np.array([ids[0] if ids else -1 for ids in found], np.int64)


def ellipsoid_map_of(states: Sequence[ObjectState]) -> EllipsoidMap:
    """Return the ellipsoids of objects, inscribed in their shapes; unknown of objects now gone."""
    made = EllipsoidMap()
    if states:
        shapes = shapes_of(states)
        present = np.array([s.present for s in states])
        center = np.where(present[:, None], shapes.center_in_world, np.nan)
        ellipsoids = quadrics.Ellipsoids(center, shapes.half_axes, shapes.world_from_obj)
        made.give(ellipsoids, np.array([s.cov[:3, :3] for s in states]))
    return made


def embeddings_of(states: Sequence[ObjectState], embedder: str) -> tuple[IntArray, Embeddings]:
    """Return the mean embeddings of the objects that have some of an embedder.

    Args:
        embedder: key of the model. "": none.
    Returns:
        rows (n,) of the objects, and their embeddings; zeros for a background that is missing.
    """
    rows = [k for k, s in enumerate(states) if embedder and s.embedder == embedder]
    if not rows:
        return np.empty(0, np.int64), Embeddings.empty()
    fore = [states[k].foreground for k in rows]
    back = np.zeros((len(rows), max(states[k].background.size for k in rows)), np.float32)
    for row, k in enumerate(rows):
        back[row, : states[k].background.size] = states[k].background
    return np.array(rows, np.int64), Embeddings(np.array(fore, np.float32), back)
