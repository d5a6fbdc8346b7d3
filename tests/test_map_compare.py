"""Decisions about the objects of a map: stayed, moved, gone, not seen, new, and identical ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import quadrics
from reobj.maps.compare import Decision, FoundObject, PointMotion, compare
from reobj.maps.fusion import ObjectState
from reobj.maps.visibility import Visibility, _points_around

SIZES = {
    "chair": (0.25, 0.25, 0.45),
    "cup": (0.04, 0.04, 0.05),
    "bed": (0.8, 1.0, 0.25),
    "plant": (0.15, 0.15, 0.3),
    "tv": (0.5, 0.05, 0.3),
    "bottle": (0.04, 0.04, 0.13),
}
SIGMA_M = 0.03


def unit(row: np.ndarray) -> np.ndarray:
    return (row / np.linalg.norm(row)).astype(np.float32)


def looks(seed: int) -> np.ndarray:
    """Embedding of a model of an object: cosine about .5 to those of other models."""
    common = np.eye(64)[0]
    return unit(common + unit(np.random.default_rng(seed).normal(size=64) * (1 - common)))


def shape_cov(sigma: float = SIGMA_M) -> np.ndarray:
    return np.diag([sigma**2] * 3 + [0.08**2] * 3 + [0.1] * 3)


def state(number: int, name: str, center: Sequence[float], **facts: Any) -> ObjectState:
    """A map object; every number has its own looks."""
    usual: dict[str, Any] = {
        "classes": {name: 10.0}, "support": "box", "half_axes": np.array(SIZES[name]),
        "quat_wxyz": np.array([1.0, 0, 0, 0]), "cov": shape_cov(), "foreground": looks(number),
        "background": np.empty(0, np.float32), "embedder": "m", "class_name": name,
        "present": True, "deleted": False, "detection_rate": 0.85, "log_odds": 4.0,
    }  # fmt: skip
    return ObjectState(number, center=np.array(center, float), **usual | facts)


def found(
    source: ObjectState, center: Sequence[float] | None = None, identity: int = 0, **facts: Any
) -> FoundObject:
    """A detection of a map object, by default in its place, with its number + 100."""
    place = source.center if center is None else np.array(center, float)
    seen = FoundObject(
        identity or 100 + source.id, source.classes, "box", place, source.half_axes,
        source.quat_wxyz, shape_cov(), source.foreground, source.background, 10, 0.95, {},
    )  # fmt: skip
    return dataclasses.replace(seen, **facts)


def motions(
    states: Sequence[ObjectState], center: Sequence[float], inliers: dict[int, int]
) -> dict[int, PointMotion]:
    """Motions onto a found object, with the number of inliers of each map object."""
    return {
        s.id: PointMotion(inliers[s.id], 3, np.array(center) - s.center, 1e-4 * np.eye(3))
        for s in states
        if s.id in inliers
    }


def room() -> list[ObjectState]:
    """Six different objects."""
    places = [(1, 1, 0.4), (2, 1, 0.8), (4, 3, 0.3), (0.5, 3.5, 0.4), (3, 0.3, 1), (2.4, 1.2, 0.8)]
    return [state(k, n, p) for k, (n, p) in enumerate(zip(SIZES, places, strict=True), 1)]


def chairs(*places: Sequence[float]) -> list[ObjectState]:
    """Identical chairs, numbers 11, 12, ..."""
    return [state(11 + k, "chair", place, foreground=looks(99)) for k, place in enumerate(places)]


def seen(count: int, views: Any = 6.0, through: Any = 0.0) -> Visibility:
    """What each of `count` places was seen in: views, those through it; nothing was detected."""
    none = np.zeros(count)
    return Visibility(none + views, none + through, none.astype(bool), none, none, none)


def decide(
    states: Sequence[ObjectState],
    detected: Sequence[FoundObject],
    visibility: Visibility | None = None,
    cov: np.ndarray | None = None,
    unit_m: float = 1.0,
    **options: Any,
) -> list[Decision]:
    visibility = visibility or seen(len(states))
    cov = np.zeros((7, 7)) if cov is None else cov
    options = {"same_embedder": True} | options
    return compare(states, detected, visibility, cov, unit_m, **options)


def summary(decisions: Sequence[Decision]) -> list[tuple[str, int, int]]:
    return [(d.kind, d.map_id, d.found_id) for d in decisions]


def facts(decisions: Sequence[Decision]) -> list[tuple[Any, ...]]:
    """With the evidence."""
    return [dataclasses.astuple(d) for d in decisions]


def all_found(states: Sequence[ObjectState]) -> list[FoundObject]:
    return [found(s) for s in states]


def test_objects_in_their_places_keep_their_numbers_whatever_the_order() -> None:
    """And a new object is new, also in an empty map."""
    states = room()
    new = found(state(50, "bottle", (4, 1, 0.8)))
    decisions = decide(states, [new, *all_found(states)[::-1]])
    stayed = [("stayed", s.id, 100 + s.id) for s in states]
    assert summary(decisions) == [*stayed, ("new", 0, 150)]
    assert all(d.candidates == () for d in decisions)
    assert summary(decide([], [new])) == [("new", 0, 150)]
    assert decide([], []) == []


def test_a_moved_object_keeps_its_number_if_its_points_are_recognised() -> None:
    """With looks and size alone it is a candidate for the number only."""
    states = room()
    detected = all_found(states)
    place = (1.3, 3.1, 0.4)
    visibility = seen(6, 6, [0, 0, 0, 4, 0, 0])
    detected[3] = found(states[3], place)
    decisions = decide(states, detected, visibility)
    assert summary(decisions)[3:][::3] == [("gone", 4, 0), ("new", 0, 104)]
    assert decisions[-1].candidates == (4,)
    detected[3] = found(states[3], place, motion_of=motions(states, place, {4: 14}))
    decisions = decide(states, detected, visibility)
    assert summary(decisions)[3] == ("moved", 4, 104)
    assert decisions[3].evidence.startswith("0.89 m from its place")
    assert [d.kind for d in decisions].count("stayed") == 5


@pytest.mark.parametrize(
    ("views", "through", "rate", "kind", "why"),
    [
        (6, 3, 0.85, "gone", "through its place"),
        (6, 0, 0.85, "not_seen", "behind"),
        (1, 1, 0.85, "not_seen", "too few"),
        (0, 0, 0.85, "not_seen", "no view"),
        (6, 5, 0.2, "not_seen", "too few"),  # often missed
    ],
)
def test_gone_needs_views_and_something_seen_behind_the_place(
    views: int, through: int, rate: float, kind: str, why: str
) -> None:
    first, *others = room()
    first = dataclasses.replace(first, detection_rate=rate)
    visibility = seen(6, [views, *[6] * 5], [through, *[0] * 5])
    decision = decide([first, *others], all_found(others), visibility)[0]
    assert decision.kind == kind and why in decision.evidence


def test_an_uncertain_alignment_moves_no_object() -> None:
    """All found objects are 25 cm beside their places; the alignment has a sigma of 20 cm."""
    states = room()
    detected = [found(s, s.center + np.array([0.2, -0.15, 0])) for s in states]
    cov = np.diag([0, 0, 0, 0.04, 0.04, 0.04, 0.0])
    assert [d.kind for d in decide(states, detected, cov=cov)] == ["stayed"] * 6
    lone = decide([states[1]], [detected[1]], cov=cov)
    assert summary(lone) == [("stayed", 2, 102)]
    assert decide([states[1]], [detected[1]])[0].kind != "stayed"
    exact = [d.kind for d in decide(states, detected)]
    assert exact.count("stayed") <= 1  # the centre of a bed is uncertain by its size


def test_the_alignment_turns_about_the_origin_of_the_map() -> None:
    """A session turned by 6 degrees about the middle of the room: rotation and shift correlate."""
    angle = np.radians(6)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    middle = np.array([2.5, 2, 0.5])
    states = room()
    detected = [found(s, middle + turn @ (s.center - middle)) for s in states]
    error = np.array([0, 0, angle, *(angle * np.array([middle[1], -middle[0], 0])), 0])
    decisions = decide(states, detected, cov=np.outer(error, error))
    assert [d.kind for d in decisions] == ["stayed"] * 6
    left = [float(d.evidence.split(" m ")[0]) for d in decisions]
    assert max(left) < 0.03 < 0.15 < np.linalg.norm(detected[2].center - states[2].center)


def test_decisions_do_not_depend_on_the_unit() -> None:
    """A world in units of 25 cm."""
    unit_m = 0.25
    states = room()
    detected = all_found(states)
    detected[3] = found(states[3], (1.3, 3.1, 0.4))
    lengths = np.array([1 / unit_m] * 3 + [1.0] * 6)

    def scaled(objects: Sequence[Any]) -> list[Any]:
        return [
            dataclasses.replace(
                o, center=o.center / unit_m, half_axes=o.half_axes / unit_m,
                cov=o.cov * np.outer(lengths, lengths),
            )
            for o in objects
        ]  # fmt: skip

    cov = np.diag([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1e-4])
    to_units = np.array([1, 1, 1, 1 / unit_m, 1 / unit_m, 1 / unit_m, 1])
    in_units = cov * np.outer(to_units, to_units)
    other = decide(scaled(states), scaled(detected), cov=in_units, unit_m=unit_m)
    assert facts(other) == facts(decide(states, detected, cov=cov))


def test_an_object_that_was_gone_gets_its_number_back() -> None:
    states = room()
    states[3] = dataclasses.replace(states[3], present=False)
    assert summary(decide(states, all_found(states)))[3] == ("stayed", 4, 104)
    elsewhere = all_found(states)
    place = (3, 2, 0.4)
    elsewhere[3] = found(states[3], place, motion_of=motions(states, place, {4: 20}))
    assert summary(decide(states, elsewhere))[3] == ("moved", 4, 104)
    missing = [f for f in elsewhere if f.id != 104]
    assert decide(states, missing, seen(6, 1, 1))[3].kind == "gone"  # it was gone before
    assert decide(room(), missing, seen(6, 1, 1))[3].kind == "not_seen"


def test_an_identical_chair_that_left_the_row_is_the_one_that_is_missing() -> None:
    """Its points are those of all four chairs."""
    states = [*room(), *chairs((1, 2, 0.4), (1.7, 2, 0.4), (2.4, 2, 0.4), (3.1, 2, 0.4))]
    points = {11: 20, 12: 25, 13: 20, 14: 25}
    detected = all_found(states)
    place = (2.0, 3.2, 0.4)
    detected[7] = found(states[7], place, motion_of=motions(states, place, points))
    views = seen(10, 6, [0] * 7 + [5] + [0] * 2)
    assert summary(decide(states, detected, views))[7] == ("moved", 12, 112)


@pytest.mark.parametrize(
    ("before", "now", "numbers"),
    [
        (((1, 2), (3, 2)), ((2, 3.2), (2, 2.6)), False),  # each may be either
        (((1, 2), (2.05, 2)), ((1, 2.62), (2.05, 2.62)), False),  # 62 cm against 122: not half
        (((1, 2), (3, 2)), ((1, 2.5), (3, 2.5)), True),  # 50 cm against 2 m
    ],
)
def test_a_much_shorter_way_decides_between_identical_chairs(
    before: Any, now: Any, numbers: bool
) -> None:
    """Both left their places; otherwise they get candidates, and no stolen number."""
    states = [*room(), *chairs(*((*place, 0.4) for place in before))]
    detected = all_found(states)[:6]
    for identity, place in zip((111, 112), now, strict=True):
        recognised = motions(states, (*place, 0.4), {11: 20, 12: 20})
        detected.append(found(states[6], (*place, 0.4), identity, motion_of=recognised))
    decisions = decide(states, detected, seen(8, 6, [0] * 6 + [5] * 2))
    if numbers:
        assert summary(decisions)[6:] == [("moved", 11, 111), ("moved", 12, 112)]
    else:
        assert summary(decisions)[-2:] == [("new", 0, 111), ("new", 0, 112)]
        assert 11 in decisions[-2].candidates and 12 in decisions[-1].candidates


def test_chairs_between_two_places_are_ambiguous_and_the_shorter_way_wins() -> None:
    """A blurred pair of chairs 20 cm apart: both numbers remain, with candidates."""
    states = [*room(), *chairs((1, 2, 0.4), (1.2, 2, 0.4))]
    detected = all_found(states)[:6]
    for identity, x in ((112, 1.13), (111, 1.07)):
        detected.append(found(states[6], (x, 2, 0.4), identity, cov=shape_cov(0.15)))
    decisions = decide(states, detected)
    assert summary(decisions)[6:] == [("stayed", 11, 111), ("stayed", 12, 112)]
    assert (decisions[6].candidates, decisions[7].candidates) == ((12,), (11,))


@pytest.mark.parametrize(
    ("inliers", "known", "expected"),
    [(0, (), ("new", 0, 104)), (5, (), ("new", 0, 104)), (7, (), ("moved", 4, 104)),
     (0, (104,), ("moved", 104, 104))],
)  # fmt: skip
def test_own_points_and_given_numbers_prove_a_move_that_looks_contradict(
    inliers: int, known: tuple[int, ...], expected: tuple[str, int, int]
) -> None:
    """Another light changed the embedding; nobody looked at the old place."""
    states = room()
    detected = all_found(states)
    visibility = seen(6, [6, 6, 6, 0, 6, 6])
    place = (3, 2, 0.4)
    recognised = motions(states, place, {4: inliers} if inliers else {})
    detected[3] = found(states[3], place, foreground=looks(500), motion_of=recognised)
    if known:  # in a refit
        states[3] = dataclasses.replace(states[3], id=104)
    assert expected in summary(decide(states, detected, visibility, known=known))


def test_another_bottle_beside_the_place_of_one_that_is_gone_does_not_get_its_number() -> None:
    """It stands 9 cm from there. Other objects show how exact positions are: millimetres here."""
    rng = np.random.default_rng(4)
    states = [*room(), *(state(k, "plant", (k - 7, 5, 0.4)) for k in range(7, 17))]
    views = seen(16, 6, np.eye(16)[5] * 4)
    for error_m, expected in ((0.002, ("new", 0, 106)), (0.04, ("stayed", 6, 106))):
        detected = [found(s, s.center + rng.normal(0, error_m, 3)) for s in states]
        place = states[5].center + np.array([0.065, -0.065, 0.02])
        strange = unit(states[5].foreground + 0.12 * np.random.default_rng(2).normal(size=64))
        detected[5] = found(states[5], place, foreground=strange)
        assert expected in summary(decide(states, detected, views))


def test_a_class_that_changed_in_place_is_one_object_only_if_all_else_agrees() -> None:
    states = room()
    detected = all_found(states)
    detected[1] = dataclasses.replace(detected[1], classes={"bottle": 10.0})
    assert summary(decide(states, detected))[1] == ("stayed", 2, 102)
    detected[1] = found(states[1], (2.6, 0.6, 0.8), classes={"bottle": 10.0})
    assert summary(decide(states, detected))[-1] == ("new", 0, 102)


def test_another_embedding_model_is_not_compared() -> None:
    states = room()
    detected = [dataclasses.replace(f, foreground=looks(700 + f.id)) for f in all_found(states)]
    plain = facts(decide(states, all_found(states), same_embedder=False))
    assert facts(decide(states, detected, same_embedder=False)) == plain
    assert facts(decide(states, detected)) != plain
    bare = [dataclasses.replace(f, foreground=np.empty(0, np.float32)) for f in detected]
    assert facts(decide(states, bare)) == plain


def test_random_rooms_steal_no_number() -> None:
    """Thirty rooms, a third of 12 objects changed; 3 cm of noise; some of the room not seen."""
    rng = np.random.default_rng(11)
    kept, stayed = 0, 0
    for _ in range(30):
        names = rng.choice(list(SIZES), 12)
        grid = rng.permutation([(x, y, 0.5) for x in range(5) for y in range(4)])[:12]
        states = [state(k + 1, n, p) for k, (n, p) in enumerate(zip(names, grid, strict=True))]
        hidden = grid[:, 0] > 3.5
        fate = np.array(["stayed"] * 8 + ["moved"] * 2 + ["gone"] * 2)
        views = np.where(hidden, 0.0, 6)
        through = np.where(hidden | (fate == "stayed"), 0.0, 4)
        detected = []
        for k in np.flatnonzero(~hidden & (fate != "gone")):
            moved = np.array([0.5, 0.4, 0]) * (fate[k] == "moved")
            place = states[k].center + moved + rng.normal(0, SIGMA_M, 3)
            looked = unit(states[k].foreground + 0.09 * rng.normal(size=64))
            detected.append(found(states[k], place, foreground=looked))
        decisions = decide(states, detected, seen(12, views, through))
        assert all(d.found_id in (0, 100 + d.map_id) for d in decisions if d.map_id)
        assert not any(d.kind == "gone" for d in decisions if d.map_id and hidden[d.map_id - 1])
        assert all(fate[d.map_id - 1] != "stayed" for d in decisions if d.kind == "gone")
        stayed += int((~hidden & (fate == "stayed")).sum())
        kept += sum(d.kind == "stayed" and fate[d.map_id - 1] == "stayed" for d in decisions)
    assert kept >= 0.98 * stayed


@pytest.mark.parametrize(
    ("depths", "is_occluded", "behind"),
    [
        ([8] * 6, False, True),  # seen through
        ([3] * 6, True, False),  # hidden
        ([4.5] * 3 + [8] * 3, False, False),  # as many on its front
        ([8] * 4 + [3] * 2, False, True),
        ([8] * 2 + [3] * 4, False, False),  # fewer than five points
    ],
)
def test_points_on_rays_through_a_ball_say_what_is_seen(
    depths: list[float], is_occluded: bool, behind: bool
) -> None:
    """A ball of radius .5 at depth 5, and points on rays close to its middle."""
    ball = quadrics.Ellipsoids(np.array([[0.0, 0, 5]]), np.full((1, 3), 0.5), np.eye(3)[None])
    xy = np.random.default_rng(0).uniform(-0.02, 0.02, (len(depths), 2))
    points = np.column_stack([xy, np.ones(len(depths))]) * np.array(depths)[:, None]
    box = np.array([[-0.1, -0.1, 0.1, 0.1]])
    occluded, _, beyond = _points_around(ball, box, points, np.eye(3, 4), np.zeros(3))
    assert occluded.tolist() == [is_occluded]
    assert beyond[0].tolist() == [behind and depth > 5.5 for depth in depths]
