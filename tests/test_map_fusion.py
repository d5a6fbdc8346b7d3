"""Fusion of an object's observations and of the scale, against the truth of simulated maps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from map_worlds import (
    SIGMA,
    a_map,
    a_session,
    observed,
    rotation,
    true_shape,
    turned,
)  # fmt: skip
from scipy.spatial.transform import Rotation

from reobj.maps.fusion import ObjectState, object_state, scale_of
from reobj.maps.room_map import Observation, RoomMap

TURNS = Rotation.create_group("O").as_matrix()  # (24, 3, 3) of the axes onto themselves
QUARTERS = TURNS[np.abs(TURNS[:, 2, 2]) > 0.5]  # (8, 3, 3)


def state_of(*observations: Observation, **fields: object) -> ObjectState:
    room = a_map([observations], **fields)
    return object_state(room.objects[0], room)


def error_of(state: ObjectState, true: dict) -> np.ndarray:
    """The increment (9,) from the true solid to the state, over the symmetries of a box."""
    rot = rotation(state)
    trace = np.einsum("ij,gji->g", rot.T @ rotation(true), TURNS)
    true = turned(true, TURNS[trace.argmax()])
    rotvec = Rotation.from_matrix(rotation(true).T @ rot).as_rotvec()
    log_half = np.log(state.half_axes / true["half_axes"])
    return np.concatenate([state.center - true["center"], log_half, rotvec])


@pytest.mark.parametrize("up", [np.array([0.0, 0.0, 1.0]), None])
def test_errors_agree_with_the_covariance(up: np.ndarray | None) -> None:
    """Ten sessions in which the axes are named differently each time."""
    rng = np.random.default_rng(1)
    turns = TURNS if up is None else QUARTERS
    errors = []
    for _ in range(60):
        true = true_shape(rng)
        turned_at_random = [turned(true, turns[rng.integers(len(turns))]) for _ in range(10)]
        state = state_of(
            observed(1, "new", turned_at_random[0], rng),
            *(observed(k, "stayed", s, rng) for k, s in enumerate(turned_at_random[1:], 2)),
            up=up,
        )
        errors.append(error_of(state, true) / np.sqrt(np.diag(state.cov)))
    assert 0.8 < np.mean(np.square(errors)) < 1.25  # 540 values: 1 +- .06
    place = np.hypot(SIGMA[:3], 0.01)
    sigma = np.concatenate([place, SIGMA[3:]]) / np.sqrt(10)
    np.testing.assert_allclose(np.sqrt(np.diag(state.cov)), sigma, rtol=1e-6)


def test_moved_object_is_at_its_last_place_with_sizes_of_all_sessions() -> None:
    rng = np.random.default_rng(3)
    before = true_shape()
    after = true_shape(center=(-1, 0, 0.5), yaw_deg=130)
    state = state_of(
        *(observed(k, "new" if k == 1 else "stayed", before, rng) for k in range(1, 9)),
        observed(9, "moved", turned(after, QUARTERS[1]), rng),
    )
    error = error_of(state, after)
    sigma = np.sqrt(np.diag(state.cov))
    assert (np.abs(error) < 4 * sigma).all()
    np.testing.assert_allclose(sigma[:3], np.hypot(0.03, 0.01))
    np.testing.assert_allclose(sigma[3:6], 0.05 / 3, rtol=1e-6)
    np.testing.assert_allclose(sigma[6:], 0.04)


def test_orientations_that_disagree_are_not_averaged() -> None:
    sure = np.where(np.arange(9) > 5, 0.02, SIGMA)
    a = true_shape(yaw_deg=0)
    loose = np.where(np.arange(9) > 5, 0.9, SIGMA)
    for yaw_deg, other in ((20, SIGMA), (40, loose)):  # more than 3 sigma; than 30 degrees
        b = true_shape(yaw_deg=yaw_deg)
        state = state_of(observed(1, "new", b, sigma=other), observed(2, "stayed", a, sigma=sure))
        np.testing.assert_allclose(rotation(state), rotation(a), atol=1e-12)
        sigma = np.sqrt(np.diag(state.cov))
        np.testing.assert_allclose(sigma[6:], 0.02, rtol=1e-6)
        np.testing.assert_allclose(sigma[3:6], 0.05 / np.sqrt(2), rtol=1e-6)


def test_yaw_of_a_cylinder_is_arbitrary() -> None:
    """Its axis lies; the two observations differ by the turn about it and by its direction."""
    lying = Rotation.from_euler("yx", [3, 90], degrees=True)
    shapes = []
    for tilt_deg, roll_deg, flip in ((0, 0, 0), (4, 77, 180)):
        turn = Rotation.from_euler("z", tilt_deg, degrees=True) * lying
        turn = turn * Rotation.from_euler("zx", [roll_deg, flip], degrees=True)
        x, y, z, w = turn.as_quat()
        shape = true_shape(half_axes=(0.1, 0.1, 0.4), support="cylinder")
        shapes.append(shape | {"quat_wxyz": np.array([w, x, y, z])})
    state = state_of(observed(1, "new", shapes[0]), observed(2, "stayed", shapes[1]))
    axis = rotation(state)[:, 2]
    angles = [np.rad2deg(np.arccos(abs(axis @ rotation(s)[:, 2]))) for s in shapes]
    np.testing.assert_allclose(angles, 2, atol=1e-3)
    np.testing.assert_allclose(state.half_axes, (0.1, 0.1, 0.4))


def test_kind_of_shape_is_that_of_most_views() -> None:
    """Half axes of an ellipsoid and of a box are other quantities: only the centre is shared."""
    box = true_shape()
    ellipsoid = true_shape(half_axes=(0.21, 0.31, 0.46), support="ellipsoid")
    shifted = ellipsoid | {"center": box["center"] + 0.02}
    few = observed(1, "new", shifted, views=3)
    state = state_of(few, observed(2, "stayed", box, views=9))
    assert state.support == "box"
    np.testing.assert_allclose(state.half_axes, box["half_axes"])
    np.testing.assert_allclose(state.center, box["center"] + 0.01)
    more = dataclasses.replace(few, views=30)
    assert state_of(more, observed(2, "stayed", box, views=9)).support == "ellipsoid"


def test_alignment_widens_centre_sizes_and_orientation() -> None:
    """Against the spread of the shape under random similarities about the origin."""
    rng = np.random.default_rng(4)
    sigma = np.array([0.01, 0.02, 0.015, 0.05, 0.03, 0.04, 0.02])
    true = true_shape(center=(3, -2, 1))
    exact = np.full(9, 1e-6)
    session = a_session(1, alignment_cov=np.diag(sigma**2))
    state = state_of(observed(1, "new", true, sigma=exact), sessions=(session,))
    drawn = []
    for draw in rng.normal(0, sigma, (4000, 7)):
        turn = Rotation.from_rotvec(draw[:3]).as_matrix()
        center = np.exp(draw[6]) * turn @ true["center"] + draw[3:6]
        rotvec = Rotation.from_matrix(rotation(true).T @ turn @ rotation(true)).as_rotvec()
        drawn.append(np.concatenate([center, np.full(3, draw[6]), rotvec]))
    spread = np.cov(np.array(drawn).T) + np.diag([1e-4] * 3 + [0.0] * 6)
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    np.testing.assert_allclose(state.cov / scale, spread / scale, atol=0.06)


# ---- Presence, class, appearance, rates ----


def test_presence_follows_the_last_session_that_saw_the_place() -> None:
    new = observed(1, "new", true_shape())
    unseen = Observation(3, "not_seen")
    assert state_of(new, Observation(2, "not_seen")).present
    assert not state_of(new, Observation(2, "gone", log_odds=-1), unseen).present
    back = observed(3, "stayed", true_shape())
    assert state_of(new, Observation(2, "gone"), back).present


@pytest.mark.parametrize(
    ("counts", "rate"),
    [([(0, 0)], 0.8), ([(10, 0)], 0.9), ([(10, 10), (0, 0)], 0.4), ([(500, 0)] * 3, 0.98)],
)
def test_detection_rate(counts: list[tuple[int, int]], rate: float) -> None:
    """Views of sessions in which it was not detected say nothing of the detector."""
    rows = [
        observed(k, "stayed" if k > 1 else "new", true_shape(), expected=n, missed=m)
        for k, (n, m) in enumerate(counts, 1)
    ]
    rows.append(Observation(len(rows) + 1, "gone", expected=50, missed=50))
    assert state_of(*rows).detection_rate == pytest.approx(rate)


def test_embeddings_are_those_of_the_last_model() -> None:
    def row(number: int, vector: tuple[float, ...], count: int) -> Observation:
        mean = np.array(vector, np.float32)
        fields = {"foreground": mean, "background": -mean, "embedded": count}
        return observed(number, "new" if number == 1 else "stayed", true_shape(), **fields)

    rows = [
        row(1, (0, 1), 90),
        row(2, (1, 0), 3),
        row(3, (0.6, 0.8), 1),
        row(4, (0, -1), 0),
    ]
    names = ("old", "net", "net", "newest")
    sessions = tuple(a_session(k, embedder=name) for k, name in enumerate(names, 1))
    state = state_of(*rows, sessions=sessions)
    mean = np.array([3.6, 0.8]) / np.hypot(3.6, 0.8)
    np.testing.assert_allclose(state.foreground, mean, rtol=1e-6)
    np.testing.assert_allclose(state.background, -mean, rtol=1e-6)
    assert state.embedder == "net" and state.foreground.dtype == np.float32
    assert state_of(rows[3]).embedder == "" and state_of(rows[3]).foreground.size == 0


# ---- Scale ----


def scale(*measured: tuple[float, float, str], **fields: object) -> tuple[float, float, str]:
    sessions = tuple(
        a_session(k, metres_per_unit=v, scale_rel_sigma=s, scale_source=kind)
        for k, (v, s, kind) in enumerate(measured, 1)
    )
    return tuple(scale_of(RoomMap(sessions=sessions, **fields)))  # type: ignore[arg-type]


def test_metric_scale_comes_before_that_of_size_priors() -> None:
    measured = [(1.0, 0.001, "priors"), (2.0, 0.02, "known_size"), (2.2, 0.02, "poses")]
    value, sigma, source = scale(*measured)
    assert value == pytest.approx(np.sqrt(4.4)) and sigma == pytest.approx(0.02 / np.sqrt(2))
    assert source == "known_size"
    value, sigma, source = scale(*measured, (2.5, 0.0, "poses"))  # exact
    assert value == pytest.approx(2.5) and sigma < 1e-5 and source == "poses"
    assert scale((3.0, 0.1, "priors"), metric=True) == (1.0, 0.0, "poses")
    assert scale((3.0, 0.1, "none")) == (1.0, 0.0, "none")
