"""Which detection is of which solid: evidence, proposals, the association of a whole scene."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
from test_linking import CHAIR, CUP, NAMES, SIZE, chair_solids, table_of, walk

import quadrics
import reobj_track as rt
from reobj.objects import association, categories, likelihood
from reobj.objects.association import Association, Associator
from reobj.objects.categories import Categories
from reobj.objects.component import associate_component
from reobj.objects.confidence import USUAL_HIT_RATE, existence_probability, log_best_odds
from reobj.objects.config import make_fit
from reobj.objects.hypotheses import propose
from reobj.objects.likelihood import EXPECTED, PosedDetections, Shapes, gather_evidence
from reobj.objects.observations import Scene, Views, gather_views
from reobj.tracking.interpolation import fill_from_objects
from reobj.types import class_shares


def chairs() -> Shapes:
    return Shapes(chair_solids(), np.full(3, "box"), np.full(3, CHAIR))


def detected_in(table: rt.Tracks, poses: rt.Poses) -> PosedDetections:
    """Rows of frames that all have a pose, in no tracklets."""
    none = np.full(len(table), -1)
    cams = poses.camera.K @ poses.cam_from_world
    return PosedDetections(
        table.frame, table.xyxy, table.score, table.class_id, none, none, cams, SIZE
    )


def shifted(table: rt.Tracks, by: np.ndarray) -> rt.Tracks:
    """Boxes moved by so many of their widths and heights."""
    side = np.tile(table.xyxy[:, 2:] - table.xyxy[:, :2], 2)
    return dataclasses.replace(table, xyxy=table.xyxy + by * side)


def odds_of(table: rt.Tracks, poses: rt.Poses, solid: int = 0) -> float:
    """Median of the log odds that the boxes of the first chair are of a solid; -inf: of none."""
    own = table[table.detection_index == 0]
    found = gather_evidence(chairs(), detected_in(own, poses))
    odds = np.full(len(own), -np.inf)
    pairs = found.obj == solid
    odds[found.row[pairs]] = found.assignment[pairs]
    return float(np.median(odds))


# ---- Evidence ----


def test_a_box_speaks_for_its_solid_and_not_for_the_next_one() -> None:
    poses = walk(20)
    table = table_of(poses)
    assert odds_of(table, poses) > 8
    assert odds_of(table, poses, solid=2) == -np.inf


@pytest.mark.parametrize(
    ("inside", "outside"),
    [([0.3, 0, 0, 0], [-0.3, 0, 0, 0]), ([0, 0, 0, -0.4], [0, 0, 0, 0.4])],
)
def test_a_thing_may_be_half_hidden_but_not_stick_out(
    inside: list[float], outside: list[float]
) -> None:
    poses = walk(20)
    table = table_of(poses)
    hidden, larger = (odds_of(shifted(table, np.array(by)), poses) for by in (inside, outside))
    assert odds_of(table, poses) >= hidden > larger + 1


@pytest.mark.parametrize("shown", [0.5, 0.3, 0.15])
def test_of_a_thing_any_part_may_be_hidden(shown: float) -> None:
    """The upper end of a thing shows: hidden is as likely for each share of its height."""
    projected, size = np.array([[100.0, 100, 180, 300]]), (640, 480)
    part = projected.copy()
    part[0, 3] = 100 + shown * 200
    whole, half, some = (
        likelihood._box_log_odds(projected, box, size)[0]
        for box in (projected, projected - [[0, 0, 0, 100]], part)
    )
    assert whole > half > 2
    # The hidden edge has one density over the projection, boxes anywhere one that goes with 1 / h;
    # the upper edge is known to a share of the mean height.
    expected = np.log(shown / 0.5) - np.log((1 + shown) / 1.5)
    assert some - half == pytest.approx(expected, abs=0.02)
    beyond = projected.copy()
    beyond[0, 3] = 100 - 30  # above its upper edge
    beyond[0, 1] = 50
    assert likelihood._box_log_odds(projected, beyond, size)[0] < 0


def test_scores_and_classes_count() -> None:
    poses = walk(20)
    table = table_of(poses)
    weak = dataclasses.replace(table, score=np.full(len(table), 0.2))
    assert odds_of(weak, poses) < odds_of(table, poses) - 2
    cups = np.where(table.detection_index == 0, CUP, CHAIR)
    named = dataclasses.replace(table, class_id=cups)
    assert odds_of(table, poses) - 3 < odds_of(named, poses) < odds_of(table, poses)


def test_a_solid_is_expected_where_most_of_it_is_in_the_image() -> None:
    poses = walk(40)
    cams = poses.camera.K @ poses.cam_from_world
    whole = quadrics.solid_boxes(chair_solids(), "box", cams)
    cut = quadrics.clip_boxes(whole, SIZE)
    share = ((cut[..., 2:] - cut[..., :2]) / (whole[..., 2:] - whole[..., :2])).prod(-1)
    found = gather_evidence(chairs(), detected_in(table_of(poses), poses))
    np.testing.assert_array_equal(found.expected, np.nan_to_num(share) > EXPECTED)


def test_many_solids_are_looked_at_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    detected = detected_in(table_of(walk(10)), walk(10))
    five = Shapes.concatenate([chairs(), chairs()[[2, 0]]])
    whole = gather_evidence(five, detected)
    monkeypatch.setattr(likelihood, "OBJECTS_AT_ONCE", 2)
    turns = gather_evidence(five, detected)
    for name in ("obj", "row", "existence", "assignment", "expected"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(turns, name))
    assert len(np.unique(whole.obj)) == 5


# ---- Proposals ----


def proposed_for(table: rt.Tracks, poses: rt.Poses, floor: quadrics.Floor | None) -> Shapes:
    group = table.detection_index
    views = gather_views(table, poses, group, 3, 0.0)
    classes = class_shares(table, group, 3).argmax(1)
    fits = make_fit(rt.ObjectsConfig(), poses, NAMES)(views, classes.tolist())
    usual = np.tile([0.56, 0.6, 0.835], (3, 1))
    return propose(fits, views, classes, usual, floor, np.full(3, True))


@pytest.mark.parametrize("floor", [None, quadrics.Floor(np.array([0, 0, 1.0]), 0.0, 0.01)])
def test_one_view_proposes_the_place_among_others(floor: quadrics.Floor | None) -> None:
    """Of the backrests alone, in three frames without parallax."""
    poses = walk(120)
    table = table_of(poses)
    table = table[(table.frame >= 60) & (table.frame < 63)]
    table.xyxy[:, 3] = table.xyxy[:, 1] + 0.5 * (table.xyxy[:, 3] - table.xyxy[:, 1])
    found = proposed_for(table, poses, floor)
    centre, half = found.ellipsoids.center_in_world, found.ellipsoids.half_axes
    for chair in chair_solids().center_in_world:
        off = np.linalg.norm(centre - chair, axis=1)
        assert off.min() < 0.25
    if floor is not None:
        rays = found.support == "cylinder"
        np.testing.assert_allclose(centre[rays, 2], half[rays, 2], atol=0.02)  # they stand on it


# ---- The whole ----


def located(table: rt.Tracks, poses: rt.Poses) -> np.ndarray:
    """The solid of each row."""
    fit, priors = make_fit(rt.ObjectsConfig(), poses, NAMES), quadrics.load_priors()
    return associate_component(table, NAMES, poses, fit, priors).label


def test_weak_detections_that_agree_belong_to_the_object() -> None:
    """Two of three boxes are in no tracklet, of score .2."""
    poses = walk()
    table = table_of(poses)
    weak = table.frame % 3 != 0
    score, tracklet = np.where(weak, 0.2, 0.9), np.where(weak, 0, table.tracklet_id)
    found = located(dataclasses.replace(table, score=score, tracklet_id=tracklet), poses)
    assert len(np.unique(found[~weak])) == 3
    assert all(len(np.unique(found[table.detection_index == k])) == 1 for k in range(3))


@pytest.mark.parametrize("score, found_at_all", [(0.42, True), (0.38, False)])
def test_good_detections_in_no_tracklet_make_an_object(score: float, found_at_all: bool) -> None:
    """Photos with wide steps: nothing connects the boxes of a chair but its place."""
    poses, solids = walk(12), chair_solids()[[0, 2]]
    solids.half_axes[0] = 0.05  # a cup, which the tracker follows
    table = table_of(poses, solids)
    last = table.detection_index == 1
    class_id = np.where(last, CHAIR, CUP)
    tracklet, scores = np.where(last, 0, table.tracklet_id), np.where(last, score, 0.9)
    table = dataclasses.replace(table, class_id=class_id)
    found = located(dataclasses.replace(table, score=scores, tracklet_id=tracklet), poses)
    assert (found[~last] >= 0).all() and len(np.unique(found[~last])) == 1
    own = 1 - found[~last][0]  # of two solids
    np.testing.assert_array_equal(found[last], own if found_at_all else -1)


def test_strong_detections_that_do_not_agree_are_clutter() -> None:
    poses = walk()
    table = table_of(poses)
    rng = np.random.default_rng(0)
    corner = rng.uniform(0, 400, (len(table), 2))
    wild = table.detection_index == 2
    xyxy = np.concatenate([corner, corner + rng.uniform(30, 200, corner.shape)], 1)
    mixed = dataclasses.replace(table, xyxy=np.where(wild[:, None], xyxy, table.xyxy))
    found = located(mixed, poses)
    assert (found[wild] < 0).mean() > 0.8
    assert (found[~wild] >= 0).all() and len(np.unique(found[~wild])) == 2


def test_where_nothing_agrees_nothing_is_located() -> None:
    """Boxes at random, of classes without priors, and a table of priors without rows."""
    poses = walk(30)
    table = table_of(poses)
    corner = np.random.default_rng(1).uniform(0, 300, (len(table), 2))
    side = np.random.default_rng(2).uniform(20, 300, corner.shape)
    wild = dataclasses.replace(table, xyxy=np.concatenate([corner, corner + side], 1))
    fit, priors = make_fit(rt.ObjectsConfig(), poses, NAMES), quadrics.load_priors()
    names = ("about", "names", "aliases")
    empty = {f.name: getattr(priors, f.name)[:0] for f in dataclasses.fields(priors)
             if f.name not in names}  # fmt: skip
    none = dataclasses.replace(priors, names=(), aliases={}, **empty)
    for known in (priors, none):
        assert (associate_component(wild, NAMES, poses, fit, known).label < 0).mean() > 0.7


@pytest.mark.parametrize(("off_px", "name"), [(3.0, "chair"), (0.0, "couch")])
def test_a_thing_that_is_detected_twice_is_one_thing(off_px: float, name: str) -> None:
    """A second tracklet has the first chair too, in every frame: a little off, or misnamed."""
    poses = walk()
    table = table_of(poses)
    again = table[table.detection_index == 0]
    again.xyxy[:] += np.random.default_rng(3).normal(0, off_px, again.xyxy.shape)
    again = dataclasses.replace(
        again,
        tracklet_id=again.tracklet_id + 9,
        score=again.score - 0.3,
        class_id=np.full(len(again), NAMES.index(name)),
    )
    found = located(rt.Tracks.joined([table, again]), poses)
    assert np.unique(found).tolist() == [-1, 0, 1, 2]


@pytest.mark.parametrize("metric", [True, False])
def test_no_detections_are_fitted_twice_and_the_first_scale_holds(metric: bool) -> None:
    """The first fit finds the scale; what follows asks for sets of detections not fitted yet."""
    poses = dataclasses.replace(walk(), metric=metric)
    table = table_of(poses)
    table = dataclasses.replace(table, tracklet_id=1 + table.detection_index)
    fit, asked = make_fit(rt.ObjectsConfig(), poses, NAMES), []
    scales = []

    def noted(views: Views, classes: list[int], scene: Scene) -> quadrics.ObjectFits:
        fits = fit(views, classes, scene)
        asked.extend((views.boxes[:, k].tobytes(), c) for k, c in enumerate(classes))
        scales.append((scene.scale, fits.scale))
        return fits

    found = associate_component(table, NAMES, poses, noted, quadrics.load_priors())
    assert len(scales) > 1 and len(found.confidence) == 3
    later = asked[3:]  # of the refits
    assert len(set(later)) == len(later)
    (none, first), *others = scales
    assert none is None and all(known == (None if metric else first) for known, _ in others)
    assert all(used == first for _, used in others)
    places = found.ellipsoids.center_in_world
    assert len(places) == 4 and np.isnan(places[3]).all()
    order = np.argsort(
        found.label[[np.flatnonzero(table.detection_index == k)[0] for k in range(3)]]
    )
    np.testing.assert_allclose(places[:3], chair_solids().center_in_world[order], atol=0.05)


def test_twins_that_stand_close_stay_two() -> None:
    poses = walk()
    solids = chair_solids()
    solids.center_in_world[1] = solids.center_in_world[0] + [0.35, 0, 0]
    solids.half_axes[:2] = [0.15, 0.15, 0.41]
    table = table_of(poses, solids)
    found = located(dataclasses.replace(table, tracklet_id=np.ones(len(table), np.int64)
                                        + table.detection_index), poses)  # fmt: skip
    assert [len(np.unique(found[table.detection_index == k])) for k in range(3)] == [1, 1, 1]
    assert len(np.unique(found)) == 3


def association_of(solids: Shapes, poses: rt.Poses) -> tuple[Associator, Association]:
    """The chairs' detections with solids that are never refitted."""
    table = table_of(poses)
    detected = detected_in(table, poses)
    made = Associator(
        detected,
        lambda rows, label, classes, current: solids[np.unique(label)],
        lambda s: np.zeros(len(s)),
    )
    return made, made._assign(solids, np.full(len(table), -1))


def test_every_detection_goes_to_its_solid_one_to_one() -> None:
    _, found = association_of(chairs(), walk(30))
    np.testing.assert_array_equal(found.label, table_of(walk(30)).detection_index)
    assert (found.gains(detected_in(table_of(walk(30)), walk(30))) > 50).all()


def test_a_detection_without_any_evidence_loses_its_solid() -> None:
    made, found = association_of(chairs(), walk(30))
    away = dataclasses.replace(
        found.shapes.ellipsoids, center_in_world=found.shapes.ellipsoids.center_in_world + 50.0
    )
    gone = dataclasses.replace(found.shapes, ellipsoids=away)
    assert (made._assign(gone, found.label).label == -1).all()
    four = made._assign(Shapes.concatenate([gone[[0]], chairs()]), found.label + 1)
    assert len(made._prune(four).shapes) == 3


def test_a_double_is_dropped_and_its_detections_return() -> None:
    three = chairs()
    four = Shapes.concatenate([three, three[[0]]])
    made, found = association_of(four, walk(30))
    for _ in range(3):
        found = made._prune(found)
    assert len(found.shapes) == 3 and (found.label >= 0).all()


def test_what_another_solid_explains_does_not_tell_where_a_solid_is() -> None:
    made, found = association_of(chairs(), walk(30))
    assert found.unambiguous().all()
    slipped = np.flatnonzero(found.label == 0)[:4]
    found.label[slipped] = 1  # four boxes of a chair are given to the next one
    np.testing.assert_array_equal(np.flatnonzero(~found.unambiguous()), slipped)
    rng = np.random.default_rng(0)
    score, kind = rng.random(len(found.label)), rng.integers(-1, 4, len(found.label))
    made.detections = dataclasses.replace(made.detections, score=score, class_id=kind)
    found.label[found.label == 2] = -1
    made.fit_shapes = Mock(return_value=found.shapes)
    made._refit(found)
    rows, label, classes = made.fit_shapes.call_args.args
    np.testing.assert_array_equal(rows, np.flatnonzero(found.unambiguous()))
    np.testing.assert_array_equal(label, found.label[rows])
    votes = np.array([[score[(found.label == obj) & (kind.clip(0) == k)].sum() for k in range(4)]
                      for obj in range(2)])  # fmt: skip
    assert classes.tolist() == [*votes.argmax(1), CHAIR]  # that without detections keeps its own


def test_a_double_is_fitted_to_all_its_detections_as_none_is_clear() -> None:
    four = Shapes.concatenate([chairs(), chairs()[[0]]])
    _, found = association_of(four, walk(30))
    assert found.unambiguous().all() and len(np.unique(found.label)) >= 3
    assert not association_of(chairs()[[]], walk(30))[1].unambiguous().any()


@pytest.mark.parametrize("first", [0, 3])
def test_of_two_that_stand_for_one_thing_the_better_placed_one_stays(first: int) -> None:
    """A solid 12 cm off has half of the chair's detections, and is of a likelier size."""
    three = chairs()
    off = dataclasses.replace(
        three.ellipsoids, center_in_world=three.ellipsoids.center_in_world + np.array([0.12, 0, 0])
    )
    four = Shapes.concatenate([three, dataclasses.replace(three, ellipsoids=off)[[0]]])
    order = np.array([0, 1, 2, 3] if first == 0 else [3, 1, 2, 0])
    made, found = association_of(four[order], walk(30))
    shift = order.tolist().index(3)
    own = np.flatnonzero(table_of(walk(30)).detection_index == 0)
    owner = found.label.copy()
    owner[own[::2]], owner[own[1::2]] = shift, order.tolist().index(0)
    likelier = np.where(np.arange(4) == shift, 0.0, -1.0)
    pruned = made._prune(dataclasses.replace(found, label=owner, size_log_odds=likelier))
    centre = pruned.shapes.ellipsoids.center_in_world
    assert len(centre) == 3
    assert np.abs(centre - three.ellipsoids.center_in_world[0]).max(1).min() < 1e-9


@pytest.mark.parametrize(
    ("up", "height", "aside", "one"),
    [
        (0.0, 1.0, 0.0, True),  # the same again
        (-0.4, 0.5, 0.0, True),  # its lower half
        (0.4, 0.5, 0.3, True),  # its upper half, a little aside
        (0.0, 1.0, 1.2, False),  # a neighbour that touches it
        (1.6, 0.6, 0.0, False),  # something on top of it
    ],
)
def test_a_part_of_a_thing_is_no_other_thing(
    up: float, height: float, aside: float, one: bool
) -> None:
    """Offsets in half extents; whichever is listed first."""
    solid = chairs()[[0]]
    half, axes = solid.ellipsoids.half_axes[0], solid.ellipsoids.world_from_obj[0]
    moved = quadrics.Ellipsoids(
        solid.ellipsoids.center_in_world + axes @ (np.array([aside, 0, up]) * half),
        solid.ellipsoids.half_axes * [1, 1, height],
        solid.ellipsoids.world_from_obj,
    )
    other = dataclasses.replace(solid, ellipsoids=moved)
    for pair in ([solid, other], [other, solid]):
        found = association._coincide(Shapes.concatenate(pair))
        assert found[0, 1] == found[1, 0] == one


@pytest.mark.parametrize("second", [0.1, 0.5, 0.9])
def test_two_boxes_of_a_thing_in_every_frame_make_one_solid(second: float) -> None:
    """Its upper half is boxed too, as often and as surely."""
    poses = walk(40)
    table = table_of(poses)
    half = table[table.detection_index == 0]
    box = half.xyxy.copy()
    box[:, 3] -= 0.5 * (box[:, 3] - box[:, 1])
    half = dataclasses.replace(half, xyxy=box, score=np.full(len(half), second))
    both = rt.Tracks.joined([table, half])
    both = both[np.argsort(both.frame, kind="stable")]
    three = chairs()
    top = dataclasses.replace(
        three.ellipsoids,
        center_in_world=three.ellipsoids.center_in_world
        + three.ellipsoids.world_from_obj[:, :, 2] * three.ellipsoids.half_axes[:, [2]] / 2,
        half_axes=three.ellipsoids.half_axes * [1, 1, 0.5],
    )
    many = Shapes.concatenate([three, dataclasses.replace(three, ellipsoids=top)])
    made = Associator(detected_in(both, poses), Mock(), lambda s: np.zeros(len(s)))
    assert sorted(made._select_greedily(made._unassigned(many, 0.0)).tolist()) == [0, 1, 2]


def test_the_association_ends_where_it_was_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two states that follow each other for ever are looked at once each."""
    made, found = association_of(chairs(), walk(10))
    states = [np.where(found.label == k, -1, found.label) for k in (0, 1)]
    rounds: list[int] = []

    def turned(now: Association) -> Association:
        rounds.append(1)
        return dataclasses.replace(now, label=states[len(rounds) % 2])

    for step in ("_refit", "_prune", "_merge"):
        monkeypatch.setattr(made, step, turned if step == "_merge" else lambda now: now)
    made.run(chairs())
    assert len(rounds) == 3


def test_pursuit_takes_in_turn_what_adds_most() -> None:
    """As when every solid is looked at again in every turn; of equal ones the first.

    By their sizes some are just worth it though they explain nothing, some just not.
    """
    three = chairs()
    rng = np.random.default_rng(0)
    near = three[np.tile(np.arange(3), 8)]
    off = rng.normal(0, 0.15, near.ellipsoids.center_in_world.shape)
    moved = dataclasses.replace(
        near.ellipsoids, center_in_world=near.ellipsoids.center_in_world + off
    )
    many = Shapes.concatenate([dataclasses.replace(near, ellipsoids=moved), three[[0]], three[[0]]])
    made, _ = association_of(three, walk(30))
    made.size_log_odds = lambda s: 1.25 + np.arange(len(s))
    of = made._unassigned(many)
    seen, cost, view = of.evidence, of.costs(), made.detections.view
    value = np.minimum(seen.assignment, seen.existence + association.MAX_BOX_GAIN)
    explained, expected = np.zeros(len(view)), list[int]()
    while True:
        gain, tops = -cost, np.zeros((len(many), len(seen.expected)))
        np.maximum.at(tops, (seen.obj, view[seen.row]), value - explained[seen.row])
        gain += (tops + association.MISSED * (seen.expected.T & (tops > 0))).sum(1)
        gain[expected] = -np.inf
        if gain.max() <= 0:
            break
        expected.append(int(gain.argmax()))
        own = (seen.obj == expected[-1]) & (value > 0)
        np.maximum.at(explained, seen.row[own], value[own])
    assert len(expected) > 1 and made._select_greedily(of).tolist() == expected
    few = made._unassigned(many, 0.0)  # pairs that speak for none add nothing
    assert len(few.evidence.row) < len(seen.row) and made._select_greedily(few).tolist() == expected


def test_the_gain_of_a_merge_is_that_of_all_rows_of_both() -> None:
    """By loops: of each object its rows' log odds, and in every frame one hit at its best row."""
    three = chairs()
    made, found = association_of(three, walk(12))
    rng = np.random.default_rng(1)
    label = found.label.copy()
    label[rng.random(len(label)) < 0.3] = 0  # several rows of an object in one frame
    strong, weak = np.array([0, 1]), np.array([2, 0])
    fitted = three[[0, 1]]
    seen = made._unassigned(fitted).evidence
    view = made.detections.view
    expected = -made._unassigned(fitted).costs()
    for k in range(2):
        best: dict[int, tuple[float, int]] = {}
        rows = [n for n in range(len(seen.row)) if seen.obj[n] == k]
        rows = [n for n in rows if label[seen.row[n]] in (strong[k], weak[k])]
        for n in rows:
            frame = int(view[seen.row[n]])
            best[frame] = max(best.get(frame, (-np.inf, -n)), (float(seen.existence[n]), -n))
        for n in rows:
            frame = int(view[seen.row[n]])
            hit = association.MISSED * seen.expected[frame, k] * (best[frame][1] == -n)
            expected[k] += max(seen.existence[n] + hit, 0.0)
    assert any(np.bincount(view[label == 0]) > 1)
    np.testing.assert_allclose(made._joint_gains(label, strong, weak, fitted), expected)


def test_pursuit_chooses_what_is_there() -> None:
    three = chairs()
    away = dataclasses.replace(
        three.ellipsoids,
        center_in_world=three.ellipsoids.center_in_world + np.array([0.3, 0.2, 0.1]),
    )
    made, _ = association_of(three, walk(30))
    many = Shapes.concatenate([dataclasses.replace(three, ellipsoids=away), three])
    assert sorted(made._select_greedily(made._unassigned(many)).tolist()) == [3, 4, 5]


def test_missed_frames_speak_against_a_solid(monkeypatch: pytest.MonkeyPatch) -> None:
    made, found = association_of(chairs(), walk(30))
    gain = found.gains(made.detections)
    monkeypatch.setattr(association, "MISSED", association.MISSED + 1)
    np.testing.assert_allclose(found.gains(made.detections), gain)  # none was missed
    found.label[made.detections.view < 10] = -1
    lost = gain - found.gains(made.detections)
    assert (lost > 10 * (association.MISSED - 1e-9)).all()


def test_a_size_is_held_against_its_category_axis_by_axis() -> None:
    """A chair turned by 90 deg, a pancake of the usual mean size; where no scale is known."""
    priors, names = quadrics.load_priors(), np.array([*NAMES, ""])
    metres = Categories(priors, names, quadrics.Scale(1.0, 0.0, "poses"))
    usual = metres.usual_size(np.array([CHAIR]))[0] / 2
    half = np.stack([usual, usual[[1, 0, 2]], usual * [2, 2, 0.25], usual * 5])
    solids = Shapes(
        quadrics.Ellipsoids(np.zeros((4, 3)), half, np.tile(np.eye(3), (4, 1, 1))),
        np.full(4, "box"),
        np.full(4, CHAIR),
    )
    fits, turned, pancake, giant = metres.size_log_odds(solids)
    assert fits == turned == 0 and pancake < -10 and giant == -0.5 * categories.SIZE_SIGMAS**2
    unknown = Categories(priors, names, quadrics.Scale(1.0, 0.0, "none")).size_log_odds(solids)
    assert unknown[3] > -0.5 and unknown[2] < -10


def test_confidence_rises_with_score_and_share() -> None:
    score, share = np.array([-2.0, 0.0, 2.0]), np.array([0.0, 0.5, 1.0])
    table = existence_probability(score[:, None], share)
    assert (np.diff(table, axis=0) > 0).all() and (np.diff(table, axis=1) > 0).all()
    assert table[0, 0] < 0.1 and table[2, 2] > 0.9
    background_seen = existence_probability(score, share, 0.5)
    assert (background_seen < table.diagonal()).all()
    assert existence_probability(np.zeros(1), np.array([np.nan]))[0] < 0.2  # no solid explains it


def test_the_best_views_tell_what_a_thing_scores() -> None:
    """Of 100 views seventy are half hidden, of 200 half; one of ten; the order does not matter."""
    score = np.r_[np.full(70, 0.2), np.full(30, 0.9), np.full(100, 0.3), np.full(100, 0.8)]
    score = np.r_[score, np.full(9, 0.2), 0.9]
    group = np.repeat([0, 1, 3], [100, 200, 10])
    found = log_best_odds(score, group, 4)
    np.testing.assert_array_equal(found, log_best_odds(score[::-1], group[::-1], 4))
    few = (9 * 0.25 + 9) / 10  # odds of .2 and .9: 1 to 4 and 9 to 1
    np.testing.assert_allclose(np.exp(found), [9, 4, 0, few])
    mixed = log_best_odds(np.r_[np.full(160, 0.2), np.full(40, 0.9)], np.zeros(200, int), 1)
    np.testing.assert_allclose(np.exp(mixed), (40 * 9 + 10 * 0.25) / 50)  # its best quarter


def test_where_no_frame_should_show_a_thing_the_share_is_the_usual_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every view cuts a large table: that it is never missed does not speak against it."""
    monkeypatch.setattr("reobj.objects.likelihood.EXPECTED", 2.0)
    poses, priors = walk(), quadrics.load_priors()
    table = table_of(poses)
    found = associate_component(
        table, NAMES, poses, make_fit(rt.ObjectsConfig(), poses, NAMES), priors
    )
    shown = found.label >= 0
    score = log_best_odds(table.score[shown], found.label[shown], len(found.confidence))
    np.testing.assert_allclose(
        found.confidence, existence_probability(score, np.full(3, USUAL_HIT_RATE))
    )


# ---- What follows ----


def test_things_on_the_floor_reach_down_to_it() -> None:
    """Only the backrests are seen: with a floor their solids are whole, without they are not."""
    poses = walk()
    table = table_of(poses)
    table.xyxy[:, 3] = table.xyxy[:, 1] + 0.5 * (table.xyxy[:, 3] - table.xyxy[:, 1])
    views = gather_views(table, poses, table.detection_index, 3, 0.0)
    fit = make_fit(rt.ObjectsConfig(), poses, NAMES)
    floor = quadrics.Floor(np.array([0, 0, 1.0]), 0.0, 0.001)
    low, high = (
        fits.ellipsoids.center_in_world[:, 2] - fits.ellipsoids.half_axes[:, 2]
        for fits in (fit(views, [CHAIR] * 3, Scene(floor)), fit(views, [CHAIR] * 3, Scene()))
    )
    assert (np.abs(low) < 0.06).all() and (high > 0.15).all()
    cups = fit(views, [CUP] * 3, Scene(floor)).ellipsoids
    assert (cups.center_in_world[:, 2] - cups.half_axes[:, 2] > 0.15).all()  # they may stand high


def test_frames_are_filled_by_the_solid() -> None:
    """While the first chair is missed the view turns: its boxes are those of its projection."""
    poses = walk(60)
    table = table_of(poses)
    seen = (table.detection_index != 0) | (table.frame < 28) | (table.frame >= 33)
    filled = fill_from_objects(table[seen], poses, np.array([1, 2, 3]), chair_solids(), ["box"] * 3)
    made = filled[filled.score == 0]
    true = table[~seen]
    np.testing.assert_array_equal(made.frame, true.frame)
    np.testing.assert_allclose(made.xyxy, true.xyxy.clip(0, np.tile(SIZE, 2)), atol=6)
    assert set(made.track_id) == {1} and (made.detection_index == -1).all()


def test_frames_are_filled_only_from_where_it_was_seen() -> None:
    """Seen in one frame: filled where the camera is within 10 deg and 1.25 times the distance."""
    poses = walk(60)
    table = table_of(poses)
    seen = (table.detection_index != 0) | (table.frame == 30)
    solids = chair_solids()
    center = np.array([-m[:, :3].T @ m[:, 3] for m in poses.cam_from_world])
    ray = center - solids.center_in_world[0]
    length = np.linalg.norm(ray, axis=1)
    angle = np.degrees(np.arccos((ray @ ray[30] / length / length[30]).clip(-1, 1)))
    near = (angle < 10) & (np.abs(np.log(length / length[30])) < np.log(1.25))
    assert 5 < near.sum() < 40  # the walk sees it from farther aside too
    filled = fill_from_objects(table[seen], poses, np.array([1, 2, 3]), solids, ["box"] * 3)
    assert filled.frame[filled.score == 0].tolist() == [f for f in np.flatnonzero(near) if f != 30]
    own = table.detection_index[seen] == 0
    for shift, explained in (([0, 0, 0, -0.4], True), ([0.3, 0, 0.3, 0], False)):  # hidden; beside
        moved = shifted(table[seen], np.where(own[:, None], shift, 0.0))
        again = fill_from_objects(moved, poses, np.array([1, 2, 3]), solids, ["box"] * 3)
        assert ((again.score == 0).sum() == (filled.score == 0).sum()) == explained
        assert explained or len(again) == len(moved)
    never = table[seen & (table.detection_index != 0)]  # no detection, nothing to fill from
    assert len(fill_from_objects(never, poses, np.array([1]), solids[:1], ["box"])) == len(never)
