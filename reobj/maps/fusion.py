"""Current state of the map: each object fused from its observations, and the scale of the world."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import quat_wxyz_from_matrix
from reobj.maps.room_map import MapObject, Observation, RoomMap, Session
from reobj.results.result import Object
from reobj.tracking.ellipsoid_map import EllipsoidMap
from reobj.types import Array, BoolArray, Embeddings, Floats, IntArray, ReobjError, unit_rows
from reobj.words import meant

PLACE_SIGMA_M = 0.01  # of a place between sessions: cleaning and leaning shift an object by 1 cm
CHI2_3 = 14.16  # 3 sigma of a normal variable (99.73 %), for the squared distance in 3 dimensions


@dataclass(frozen=True, slots=True, eq=False)
class ObjectState:
    """What the map knows of an object after its last session.

    Attributes:
        id: number. class_name: given by the user, or the one with the largest weight.
        classes: weight of each class, over all sessions.
        present: False if it was gone in the last session that saw its place.
        deleted: by the user.
        support, center, half_axes, quat_wxyz, cov: shape as in `Observation`, with the uncertainty
            of the alignment of the sessions; the place where it was last seen.
        foreground, background: mean unit embeddings of one model (`embedder`); empty: none.
        detection_rate: probability of a detection in a view in which it is expected.
        log_odds: that it is a real object.
    """

    id: int
    class_name: str
    classes: dict[str, float]
    present: bool
    deleted: bool
    support: str
    center: Array
    half_axes: Array
    quat_wxyz: Array
    cov: Array
    foreground: Floats
    background: Floats
    embedder: str
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
    weight: dict[str, float] = {}
    for o in detected:
        for name, more in o.classes.items():
            weight[name] = weight.get(name, 0.0) + more
    classes = dict(sorted(weight.items(), key=lambda entry: (-entry[1], entry[0])))
    looked = [o.status for o in observations if o.status != "not_seen"]
    expected = sum(o.expected for o in detected)
    missed = sum(o.missed for o in detected)
    support, shape = _fused(detected, room)
    embedder, foreground, background = _embeddings(detected, room)
    return ObjectState(
        id=found.id,
        class_name=found.name or next(iter(classes), "object"),
        classes=classes,
        present=looked[-1] != "gone",
        deleted=found.deleted,
        support=support,
        center=shape.center[0],
        half_axes=np.exp(shape.log_half[0]),
        quat_wxyz=quat_wxyz_from_matrix(shape.rot)[0],
        cov=shape.cov[0],
        foreground=foreground,
        background=background,
        embedder=embedder,
        detection_rate=_detection_rate(expected, missed),
        log_odds=float(np.clip(sum(o.log_odds for o in observations), -10.0, 10.0)),
    )


def state_before(found: MapObject, session: int, room: RoomMap) -> ObjectState | None:
    """Return the state of an object before a session; None: it was not known."""
    rows = tuple(o for o in found.observations if o.session < session)
    if not any(o.detected for o in rows):
        return None
    return object_state(dataclasses.replace(found, observations=rows), room)


def _detection_rate(
    expected: int, missed: int, prior: tuple[float, float] = (8.0, 2.0), most: float = 0.98
) -> float:
    """Return the posterior mean of a detection rate.

    Args:
        prior: Beta distribution of detections and misses: 80 %, worth ten views. most: upper bound:
            no detector is certain, and views of one session fail together.
    """
    hits = prior[0] + expected - missed
    return min(hits / (sum(prior) + expected), most)


def _embeddings(detected: Sequence[Observation], room: RoomMap) -> tuple[str, Floats, Floats]:
    """Return the last embedder of an object, and its mean unit embeddings by this model."""
    embedder_of = {s.number: s.embedder for s in room.sessions}
    rows = [o for o in detected if o.embedded > 0 and o.foreground.size]
    none = np.empty(0, np.float32)
    if not rows:
        return "", none, none
    embedder = embedder_of[rows[-1].session]
    width = rows[-1].foreground.shape
    rows = [o for o in rows if embedder_of[o.session] == embedder and o.foreground.shape == width]

    def mean(name: str) -> Floats:
        known = [o for o in rows if getattr(o, name).shape == width]
        if not known:
            return none
        weight = np.array([o.embedded for o in known], np.float64)
        total = weight @ np.array([getattr(o, name) for o in known], np.float64)  # (E,)
        return np.asarray(unit_rows(total[None])[0], np.float32)

    return embedder, mean("foreground"), mean("background")


def shapes_of(objects: Sequence[ObjectState] | Sequence[Object]) -> quadrics.Ellipsoids:
    """Return the ellipsoids of objects, in the world of the map, inscribed in their shapes."""
    wxyz = np.array([o.quat_wxyz for o in objects]).reshape(-1, 4)
    axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() if len(objects) else wxyz
    return quadrics.Ellipsoids(
        np.array([o.center for o in objects]).reshape(-1, 3),
        np.array([o.half_axes for o in objects]).reshape(-1, 3),
        axes.reshape(-1, 3, 3),
    )


def scaled_radius(xyz: Array, shapes: quadrics.Ellipsoids, k: int | IntArray) -> Array:
    """Return squared distances (N,) of points (N, 3) from the centre of a shape, in half axes.

    Args:
        k: row of the shape, or (N,) that of each point.
    """
    turn = np.broadcast_to(shapes.world_from_obj[k], (len(xyz), 3, 3))
    offset = xyz - shapes.center_in_world[k]
    scaled = np.einsum("ni,nij->nj", offset, turn) / shapes.half_axes[k]
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
    quat = np.array([o.quat_wxyz for o in detected])
    rot = Rotation.from_quat(quat[:, [1, 2, 3, 0]]).as_matrix()
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


def _axis_rotations() -> Array:
    """Return the rotations (24, 3, 3) that map the axes onto themselves."""
    signs = np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, 8).T
    both = np.array([np.eye(3)[:, order] * s for order in quadrics.AXIS_ORDERS for s in signs])
    return np.asarray(both[np.linalg.det(both) > 0])


TURNS = _axis_rotations()
KEEPS_THIRD: BoolArray = np.abs(TURNS[:, 2, 2]) > 0.5  # (24,)


def _fused(detected: Sequence[Observation], room: RoomMap) -> tuple[str, Shapes]:
    """Fuse the shapes of an object's observations, by session, by their information.

    Orientations that differ by more than 3 sigma or 30 degrees are not averaged: that of the
    smallest variance counts. Kinds of shape differ in what their half axes mean: only the centre of
    observations of another kind than that of the most views counts.

    Returns:
        the kind, and one shape.
    """
    starts = [k for k, o in enumerate(detected) if o.status in ("new", "moved")]
    here = np.arange(len(detected)) >= (starts[-1] if starts else 0)
    last = [o for o, at_place in zip(detected, here, strict=True) if at_place]
    support = max(last, key=lambda o: o.views).support
    same = np.array([o.support == support for o in detected])
    shapes = observed_shapes(detected, room)
    turning = np.einsum("kii->k", shapes.cov[:, 6:, 6:])
    ref = int(np.where(here & same, turning, np.inf).argmin())
    upright = room.up is not None or support == "cylinder"
    nearest, agree = _nearest_orientation(shapes, ref, upright, support == "cylinder")
    by_size, alike = _nearest_sizes(shapes, ref, upright, support == "cylinder")
    oriented = here & same & agree
    delta = np.where(oriented[:, None], nearest.delta, by_size.delta)
    cov = np.where(oriented[:, None, None], nearest.cov, by_size.cov)
    used = np.repeat(np.stack([here, same & (oriented | alike), oriented], 1), 3, axis=1)  # (K, 9)
    both = used[:, :, None] & used[:, None]
    info = np.where(both, np.linalg.inv(np.where(both, cov, np.eye(9))), 0.0)
    fused_cov = np.linalg.inv(info.sum(0))
    step = fused_cov @ np.einsum("kij,kj->i", info, delta)
    turn = Rotation.from_rotvec(step[6:]).as_matrix()
    return support, Shapes(
        shapes.center[ref : ref + 1] + step[:3],
        shapes.log_half[ref : ref + 1] + step[3:6],
        shapes.rot[ref : ref + 1] @ turn,
        (fused_cov + fused_cov.T)[None] / 2,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Turned:
    """Increments (K, 9) from the reference to shapes in axes of their symmetry; cov (K, 9, 9)."""

    delta: Array
    cov: Array


def _turned(shapes: Shapes, ref: int, turn: Array, rotvec: Array, rotation: Array) -> _Turned:
    """Express shapes in other axes.

    Args:
        turn: (K, 3, 3) of TURNS. rotvec: (K, 3) from the reference to the turned shapes.
        rotation: (K, 3, 3) the turn, and the yaw of a cylinder: shape.rot @ rotation are the axes.
    """
    order = np.abs(turn).swapaxes(1, 2)
    log_half = (order @ shapes.log_half[..., None])[..., 0]
    change = np.zeros((len(turn), 9, 9))
    change[:, :3, :3] = np.eye(3)
    change[:, 3:6, 3:6] = order
    change[:, 6:, 6:] = rotation.swapaxes(1, 2)
    shift = [shapes.center - shapes.center[ref], log_half - shapes.log_half[ref], rotvec]
    return _Turned(np.concatenate(shift, 1), change @ shapes.cov @ change.swapaxes(1, 2))


def _nearest_orientation(
    shapes: Shapes, ref: int, upright: bool, round_about_third: bool
) -> tuple[_Turned, BoolArray]:
    """Choose for every shape the equivalent axes whose directions are nearest to the reference.

    Args:
        upright: the third axis stays the third one. round_about_third: the yaw is arbitrary.
    Returns:
        the turned shapes, and whether their orientation agrees with the reference (K,).
    """
    relative = shapes.rot[ref].T @ shapes.rot  # (K, 3, 3)
    trace = np.einsum("kij,gji->kg", relative, TURNS)
    if upright:
        trace = np.where(KEEPS_THIRD, trace, -np.inf)
    turn = TURNS[trace.argmax(1)]
    rotation = turn
    if round_about_third:
        rotvec = quadrics.rotation_vectors(relative @ turn)
        # the yaw that leaves the smallest rotation: the twist of the relative quaternion
        half = np.linalg.norm(rotvec, axis=1) / 2
        twist = 2 * np.arctan2(rotvec[:, 2] * np.sinc(half / np.pi) / 2, np.cos(half))
        yaw = np.zeros((len(turn), 3))
        yaw[:, 2] = -twist
        rotation = turn @ quadrics.rotations(yaw)
    rotvec = quadrics.rotation_vectors(relative @ rotation)
    turned = _turned(shapes, ref, turn, rotvec, rotation)
    cov = turned.cov[:, 6:, 6:] + turned.cov[ref, 6:, 6:]
    distance = np.einsum("ki,kij,kj->k", rotvec, np.linalg.inv(cov), rotvec)
    agree = (distance < CHI2_3) & (np.linalg.norm(rotvec, axis=1) < np.deg2rad(30))
    agree[ref] = True  # its covariance is twice its own: the distance is 0
    return turned, agree


def _nearest_sizes(
    shapes: Shapes, ref: int, upright: bool, third_is_axis: bool
) -> tuple[_Turned, BoolArray]:
    """Choose for every shape the order of its axes whose sizes are nearest to the reference.

    For shapes at another place or in another orientation. An upright object may have been laid on
    its side: its third axis changes if the sizes agree by 3 sigma better so.

    Returns:
        the turned shapes, and whether their sizes agree with the reference (K,).
    """
    log_half = np.einsum("gji,kj->kgi", np.abs(TURNS), shapes.log_half)  # (K, 24, 3)
    cov = np.einsum("gji,kjl,glm->kgim", np.abs(TURNS), shapes.cov[:, 3:6, 3:6], np.abs(TURNS))
    error = log_half - shapes.log_half[ref]
    inverse = np.linalg.inv(cov + shapes.cov[ref, 3:6, 3:6])
    distance = np.einsum("kgi,kgij,kgj->kg", error, inverse, error)
    penalty = np.where(KEEPS_THIRD | (not upright), 0.0, np.inf if third_is_axis else CHI2_3)
    best = (distance + penalty).argmin(1)
    turn = TURNS[best]
    turned = _turned(shapes, ref, turn, np.zeros((len(turn), 3)), turn)
    return turned, distance[np.arange(len(best)), best] < CHI2_3


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
    variance = np.array([_scale_variance(s) for s in sessions])
    mean = float(np.exp(np.average(value, weights=1 / variance)))
    least = variance.min()
    pooled = 1 / (1 / variance).sum() if metric else least
    return quadrics.Scale(mean, float(np.sqrt(pooled)), sessions[variance.argmin()].scale_source)


def _scale_variance(session: Session) -> float:
    """Return the variance of the log scale of the map as a session measured it.

    At least (1e-6)^2: exact poses have sigma 0.
    """
    return max(session.scale_rel_sigma**2 + float(session.alignment_cov[6, 6]), 1e-12)


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
    rows = [k for k in rows if states[k].foreground.size]
    fore = [states[k].foreground for k in rows]
    if not rows:
        return np.empty(0, np.int64), Embeddings.empty()
    width = max(states[k].background.size for k in rows)
    back = np.zeros((len(rows), width), np.float32)
    for row, k in enumerate(rows):
        back[row, : states[k].background.size] = states[k].background
    return np.array(rows, np.int64), Embeddings(np.array(fore, np.float32), back)
