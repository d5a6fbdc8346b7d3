"""Assignment of detections to 3D objects: evidence, proposals, association of a whole scene."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import CHAIR, CUP, SIZE, chair_solids, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.cameras import distort_boxes
from reobj.objects import association, likelihood
from reobj.objects.association import MAX_BOX_GAIN, MISSED, Association, Associator
from reobj.objects.component import associate_component, propose
from reobj.objects.config import make_fit
from reobj.objects.description import (
    USUAL_HIT_RATE,
    existence_probability,
    log_best_odds,
    objects_confidence,
)
from reobj.objects.likelihood import EXPECTED, Categories, PosedDetections, Shapes, gather_evidence
from reobj.objects.observations import Scene, gather_views
from reobj.tracking.linking import fill_from_objects
from reobj.types import class_shares


def chairs() -> Shapes:
    return Shapes(chair_solids(), np.full(3, "box"), np.full(3, CHAIR))


def detected_in(table: rt.Tracks, poses: rt.Poses) -> PosedDetections:
    """Rows in no tracklet, of frames that all have a pose."""
    none = np.full(len(table), -1)
    cams = poses.camera.K @ poses.cam_from_world
    no_points = np.full((len(table), 1), np.nan)
    return PosedDetections(
        table.frame, table.xyxy, table.score, table.class_id, none, none, cams, SIZE, no_points
    )


def shifted(table: rt.Tracks, by: np.ndarray) -> rt.Tracks:
    """Boxes moved by so many of their widths and heights."""
    side = np.tile(table.xyxy[:, 2:] - table.xyxy[:, :2], 2)
    return dataclasses.replace(table, xyxy=table.xyxy + by * side)


def odds_of(table: rt.Tracks, poses: rt.Poses, solid: int = 0) -> float:
    """Median log odds that the boxes of the first chair belong to an object; -inf: to none."""
    own = table[table.detection_index == 0]
    found = gather_evidence(chairs(), detected_in(own, poses), association.MIN_LOG_ODDS)
    odds = np.full(len(own), -np.inf)
    pairs = found.obj == solid
    odds[found.row[pairs]] = found.assignment[pairs]
    return float(np.median(odds))


# ---- Evidence ----


def test_a_box_supports_its_object_and_not_the_neighbour() -> None:
    poses = walk(20)
    table = tracks_of(poses)
    assert odds_of(table, poses) > 8
    assert odds_of(table, poses, solid=2) == -np.inf


def test_points_in_a_box_support_the_object_at_their_depth() -> None:
    """Points before the object mean that something else is seen, and so do those behind it."""
    poses = walk(20)
    table = tracks_of(poses)
    own = table[table.detection_index == 0]
    detections = detected_in(own, poses)
    solid = chairs()[[0]]
    view = detections.img_from_world[own.frame]
    depth = view[:, 2, :3] @ solid.ellipsoids.center_in_world[0] + view[:, 2, 3]
    odds = []
    for factor in (1.0, 0.5, 2.0, np.nan):
        depths = np.repeat(factor * depth[:, None], 3, 1)
        found = gather_evidence(solid, dataclasses.replace(detections, depths=depths), -99.0)
        odds.append(np.median(found.assignment))
    on_it, before, behind, no_points = odds
    assert before < no_points < on_it and behind < no_points
    assert abs(no_points - before) < 3.0  # one box never decides


@pytest.mark.parametrize(
    ("inside", "outside"),
    [([0.3, 0, 0, 0], [-0.3, 0, 0, 0]), ([0, 0, 0, -0.4], [0, 0, 0, 0.4])],
)
def test_a_box_may_be_half_occluded_but_not_exceed_the_projection(
    inside: list[float], outside: list[float]
) -> None:
    poses = walk(20)
    table = tracks_of(poses)
    occluded, larger = (odds_of(shifted(table, np.array(by)), poses) for by in (inside, outside))
    assert odds_of(table, poses) >= occluded > larger + 1


def test_scores_and_classes_change_the_odds() -> None:
    poses = walk(20)
    table = tracks_of(poses)
    weak = dataclasses.replace(table, score=np.full(len(table), 0.2))
    assert odds_of(weak, poses) < odds_of(table, poses) - 2
    cups = np.where(table.detection_index == 0, CUP, CHAIR)
    named = dataclasses.replace(table, class_id=cups)
    assert odds_of(table, poses) - 3 < odds_of(named, poses) < odds_of(table, poses)


def test_a_detection_is_expected_if_most_of_the_object_is_in_the_image() -> None:
    poses = walk(40)
    cams = poses.camera.K @ poses.cam_from_world
    whole = quadrics.solid_boxes(chair_solids(), "box", cams)
    cut = quadrics.clip_boxes(whole, SIZE)
    visible = ((cut[..., 2:] - cut[..., :2]) / (whole[..., 2:] - whole[..., :2])).prod(-1)
    found = gather_evidence(chairs(), detected_in(tracks_of(poses), poses), 0.0)
    np.testing.assert_array_equal(found.expected, np.nan_to_num(visible) > EXPECTED)


# ---- Proposals ----


def proposed_for(table: rt.Tracks, poses: rt.Poses, floor: quadrics.Floor | None) -> Shapes:
    group = table.detection_index
    views = gather_views(table, poses, group, 3, 0.0)
    classes = class_shares(table, group, 3).argmax(1)
    fits = make_fit(rt.ObjectsConfig(), poses, rt.COCO_NAMES)(views, classes.tolist(), Scene())
    metres = quadrics.Scale(1.0, 0.0, "poses")
    categories = Categories(quadrics.load_priors(), np.array([*rt.COCO_NAMES, ""]), metres)
    return propose(fits, views, classes, categories, floor)


@pytest.mark.parametrize("floor", [None, quadrics.Floor(np.array([0, 0, 1.0]), 0.0, 0.01)])
def test_a_single_view_proposes_the_true_position(floor: quadrics.Floor | None) -> None:
    """From the backrests alone, in three frames without parallax."""
    poses = walk(120)
    table = tracks_of(poses)
    table = table[(table.frame >= 60) & (table.frame < 63)]
    table.xyxy[:, 3] = table.xyxy[:, 1] + 0.5 * (table.xyxy[:, 3] - table.xyxy[:, 1])
    found = proposed_for(table, poses, floor)
    centre, half = found.ellipsoids.center_in_world, found.ellipsoids.half_axes
    for chair in chair_solids().center_in_world:
        off = np.linalg.norm(centre - chair, axis=1)
        assert off.min() < 0.25
    if floor is not None:
        rays = found.shape == "cylinder"
        np.testing.assert_allclose(centre[rays, 2], half[rays, 2], atol=0.02)  # they stand on it


# ---- The whole association ----


def located(table: rt.Tracks, poses: rt.Poses) -> np.ndarray:
    """The object of each row."""
    fit, priors = make_fit(rt.ObjectsConfig(), poses, rt.COCO_NAMES), quadrics.load_priors()
    return associate_component(table, rt.COCO_NAMES, poses, fit, priors).label


def test_weak_detections_that_agree_belong_to_the_object() -> None:
    """Two of three boxes are in no tracklet and have score .2."""
    poses = walk(120)
    table = tracks_of(poses)
    weak = table.frame % 3 != 0
    score, tracklet = np.where(weak, 0.2, 0.9), np.where(weak, 0, table.tracklet_id)
    found = located(dataclasses.replace(table, score=score, tracklet_id=tracklet), poses)
    assert len(np.unique(found[~weak])) == 3
    assert all(len(np.unique(found[table.detection_index == k])) == 1 for k in range(3))


@pytest.mark.parametrize("score, found_at_all", [(0.42, True), (0.38, False)])
def test_good_detections_in_no_tracklet_make_an_object(score: float, found_at_all: bool) -> None:
    """Photos with wide baselines: only the 3D position connects the boxes of a chair."""
    poses, solids = walk(12), chair_solids()[[0, 2]]
    solids.half_axes[0] = 0.05  # a cup, which the tracker follows
    table = tracks_of(poses, solids=solids)
    last = table.detection_index == 1
    class_id = np.where(last, CHAIR, CUP)
    tracklet, scores = np.where(last, 0, table.tracklet_id), np.where(last, score, 0.9)
    table = dataclasses.replace(table, class_id=class_id)
    found = located(dataclasses.replace(table, score=scores, tracklet_id=tracklet), poses)
    assert (found[~last] >= 0).all() and len(np.unique(found[~last])) == 1
    own = 1 - found[~last][0]  # of two solids
    np.testing.assert_array_equal(found[last], own if found_at_all else -1)


def test_strong_detections_that_do_not_agree_are_clutter() -> None:
    poses = walk(120)
    table = tracks_of(poses)
    rng = np.random.default_rng(0)
    corner = rng.uniform(0, 400, (len(table), 2))
    wild = table.detection_index == 2
    xyxy = np.concatenate([corner, corner + rng.uniform(30, 200, corner.shape)], 1)
    mixed = dataclasses.replace(table, xyxy=np.where(wild[:, None], xyxy, table.xyxy))
    found = located(mixed, poses)
    assert (found[wild] < 0).mean() > 0.8
    assert (found[~wild] >= 0).all() and len(np.unique(found[~wild])) == 2


@pytest.mark.parametrize(("off_px", "name"), [(3.0, "chair"), (0.0, "couch")])
def test_duplicate_detections_give_one_object(off_px: float, name: str) -> None:
    """A second tracklet shows the first chair in every frame: slightly off, or of another class."""
    poses = walk(120)
    table = tracks_of(poses)
    again = table[table.detection_index == 0]
    again.xyxy[:] += np.random.default_rng(3).normal(0, off_px, again.xyxy.shape)
    again = dataclasses.replace(
        again,
        tracklet_id=again.tracklet_id + 9,
        score=again.score - 0.3,
        class_id=np.full(len(again), rt.COCO_NAMES.index(name)),
    )
    found = located(rt.Tracks.joined([table, again]), poses)
    assert np.unique(found).tolist() == [-1, 0, 1, 2]


def test_occluded_chairs_get_the_width_of_their_unoccluded_views() -> None:
    """In three of four frames only the narrow upper half of every chair is visible.

    The floor is known where there are sparse points on it.
    """
    poses = walk(120)
    ground = np.random.default_rng(0).uniform(-2, 2, (600, 3)) * [1, 1, 0.002]
    observed = np.indices((len(poses.frame), len(ground))).reshape(2, -1).T
    table = tracks_of(poses)
    back = table.frame % 4 != 0
    x1, y1, x2, y2 = table.xyxy.T
    half = np.stack([0.75 * x1 + 0.25 * x2, y1, 0.25 * x1 + 0.75 * x2, (y1 + y2) / 2], 1)
    seen = dataclasses.replace(table, xyxy=np.where(back[:, None], half, table.xyxy))
    width = []
    for points, visibility in ((ground, observed), (ground[:0], observed[:0])):
        colors = np.zeros(points.shape, np.uint8)
        world = dataclasses.replace(poses, points=points, colors=colors, visibility=visibility)
        fit, priors = make_fit(rt.ObjectsConfig(), world, rt.COCO_NAMES), quadrics.load_priors()
        found = associate_component(seen, rt.COCO_NAMES, world, fit, priors)
        assert (found.floor is not None) == bool(len(points))
        assert (found.label >= 0).mean() > 0.9 and len(found.confidence) == 3
        width.append(found.ellipsoids.half_axes[:3, :2].mean())
    assert abs(width[0] / 0.29 - 1) < 0.1 and width[1] < 0.85 * width[0]


def test_adjacent_identical_objects_stay_separate() -> None:
    poses = walk(120)
    solids = chair_solids()
    solids.center_in_world[1] = solids.center_in_world[0] + [0.35, 0, 0]
    solids.half_axes[:2] = [0.15, 0.15, 0.41]
    table = tracks_of(poses, solids=solids)
    found = located(dataclasses.replace(table, tracklet_id=np.ones(len(table), np.int64)
                                        + table.detection_index), poses)  # fmt: skip
    assert [len(np.unique(found[table.detection_index == k])) for k in range(3)] == [1, 1, 1]
    assert len(np.unique(found)) == 3


def association_of(solids: Shapes, poses: rt.Poses) -> tuple[Associator, Association]:
    """Association of the chairs' detections with fixed objects."""
    table = tracks_of(poses)
    detected = detected_in(table, poses)
    made = Associator(
        detected,
        lambda rows, label, classes, current: solids[np.unique(label)],
        lambda s: np.zeros(len(s)),
    )
    return made, made.assign(solids, np.full(len(table), -1))


def test_detections_are_assigned_to_their_objects_one_to_one() -> None:
    _, found = association_of(chairs(), walk(30))
    np.testing.assert_array_equal(found.label, tracks_of(walk(30)).detection_index)
    assert (found.gains(detected_in(tracks_of(walk(30)), walk(30))) > 50).all()


def test_ambiguous_detections_are_excluded_from_refits() -> None:
    _, found = association_of(chairs(), walk(30))
    assert found.unambiguous().all()
    slipped = np.flatnonzero(found.label == 0)[:4]
    found.label[slipped] = 1  # four boxes of a chair are given to the next one
    np.testing.assert_array_equal(np.flatnonzero(~found.unambiguous()), slipped)


def test_of_two_duplicates_the_better_fitting_one_stays() -> None:
    """An object 12 cm off has half of the chair's detections and a more probable size."""
    three = chairs()
    off = dataclasses.replace(
        three.ellipsoids, center_in_world=three.ellipsoids.center_in_world + np.array([0.12, 0, 0])
    )
    four = Shapes.concatenate([three, dataclasses.replace(three, ellipsoids=off)[[0]]])
    made, found = association_of(four, walk(30))
    own = np.flatnonzero(tracks_of(walk(30)).detection_index == 0)
    found.label[own[::2]], found.label[own[1::2]] = 3, 0
    likelier = np.array([-1.0, -1, -1, 0])
    pruned = made._prune(dataclasses.replace(found, size_log_odds=likelier))
    np.testing.assert_array_equal(
        pruned.shapes.ellipsoids.center_in_world, three.ellipsoids.center_in_world
    )


@pytest.mark.parametrize(
    ("up", "height", "aside", "one"),
    [
        (0.0, 1.0, 0.0, True),  # the same object again
        (-0.4, 0.5, 0.0, True),  # its lower half
        (0.4, 0.5, 0.3, True),  # its upper half, a little aside
        (0.0, 1.0, 1.2, False),  # a neighbour that touches it
        (1.6, 0.6, 0.0, False),  # something on top of it
    ],
)
def test_a_part_of_an_object_is_no_separate_object(
    up: float, height: float, aside: float, one: bool
) -> None:
    """Offsets in half extents; independent of the order."""
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


def test_a_size_is_compared_with_the_prior_per_axis() -> None:
    """A chair rotated by 90 deg, a flat one of the usual mean size; without a known scale."""
    priors, names = quadrics.load_priors(), np.array([*rt.COCO_NAMES, ""])
    metres = Categories(priors, names, quadrics.Scale(1.0, 0.0, "poses"))
    usual = metres.usual_size(np.array([CHAIR]))[0] / 2
    half = np.stack([usual, usual[[1, 0, 2]], usual * [2, 2, 0.25], usual * 5])
    solids = Shapes(
        quadrics.Ellipsoids(np.zeros((4, 3)), half, np.tile(np.eye(3), (4, 1, 1))),
        np.full(4, "box"),
        np.full(4, CHAIR),
    )
    fits, turned, pancake, giant = metres.size_log_odds(solids)
    assert fits == turned == 0 and pancake < -10 and giant == -0.5 * likelihood.SIZE_SIGMAS**2
    unknown = Categories(priors, names, quadrics.Scale(1.0, 0.0, "none")).size_log_odds(solids)
    assert unknown[3] > -0.5 and unknown[2] < -10


def test_confidence_rises_with_score_and_hit_rate() -> None:
    score = np.array([-2.0, 0.0, 2.0])
    hit_rate = np.array([0.0, 0.5, 1.0])
    table = existence_probability(score[:, None], hit_rate)
    assert (np.diff(table, axis=0) > 0).all() and (np.diff(table, axis=1) > 0).all()
    assert table[0, 0] < 0.1 and table[2, 2] > 0.9
    background_seen = existence_probability(score, hit_rate, 0.5)
    assert (background_seen < table.diagonal()).all()
    assert existence_probability(np.zeros(1), np.array([np.nan]))[0] < 0.2  # no object explains it


def test_the_score_of_an_object_comes_from_its_best_views() -> None:
    """Low scores of occluded views: 70 of 100, 100 of 200, 9 of 10; in any order."""
    score = np.r_[np.full(70, 0.2), np.full(30, 0.9), np.full(100, 0.3), np.full(100, 0.8)]
    score = np.r_[score, np.full(9, 0.2), 0.9]
    group = np.repeat([0, 1, 3], [100, 200, 10])
    found = log_best_odds(score, group, 4)
    np.testing.assert_array_equal(found, log_best_odds(score[::-1], group[::-1], 4))
    few = (9 * 0.25 + 9) / 10  # odds of .2 and .9: 1 to 4 and 9 to 1
    np.testing.assert_allclose(np.exp(found), [9, 4, 0, few])
    mixed = log_best_odds(np.r_[np.full(160, 0.2), np.full(40, 0.9)], np.zeros(200, int), 1)
    np.testing.assert_allclose(np.exp(mixed), (40 * 9 + 10 * 0.25) / 50)  # its best quarter


def test_without_frames_that_should_show_it_the_hit_rate_is_the_usual_one() -> None:
    """A large table is truncated in every view: the absence of expected frames is no evidence."""
    made, found = association_of(chairs(), walk(10))
    nowhere = dataclasses.replace(found.evidence, expected=found.evidence.expected & False)
    found = dataclasses.replace(found, evidence=nowhere)
    score = log_best_odds(made.detections.score, found.label, 3)
    certain = objects_confidence(found, made.detections, np.zeros(3))
    np.testing.assert_allclose(certain, existence_probability(score, np.full(3, USUAL_HIT_RATE)))


# ---- After the association ----


def test_floor_standing_objects_extend_to_the_floor() -> None:
    """Only the backrests are visible: with a floor the shapes are complete, without it not."""
    poses = walk(120)
    table = tracks_of(poses)
    table.xyxy[:, 3] = table.xyxy[:, 1] + 0.5 * (table.xyxy[:, 3] - table.xyxy[:, 1])
    views = gather_views(table, poses, table.detection_index, 3, 0.0)
    fit = make_fit(rt.ObjectsConfig(), poses, rt.COCO_NAMES)
    floor = quadrics.Floor(np.array([0, 0, 1.0]), 0.0, 0.001)
    low, high = (
        fits.ellipsoids.center_in_world[:, 2] - fits.ellipsoids.half_axes[:, 2]
        for fits in (fit(views, [CHAIR] * 3, Scene(floor)), fit(views, [CHAIR] * 3, Scene()))
    )
    assert (np.abs(low) < 0.06).all() and (high > 0.15).all()
    cups = fit(views, [CUP] * 3, Scene(floor)).ellipsoids
    assert (cups.center_in_world[:, 2] - cups.half_axes[:, 2] > 0.15).all()  # they may stand high


def test_filled_boxes_have_the_distortion_of_the_lens() -> None:
    """They are pixels of the image, as detections are; beyond the lens's fold there are none."""
    poses = walk(60)
    camera = rt.Camera("OPENCV", *SIZE, (520.0, 520.0, 320.0, 240.0, -0.3, 0.0, 0.0, 0.0))
    bent = dataclasses.replace(poses, camera=camera)
    table = tracks_of(poses)
    table = dataclasses.replace(table, xyxy=distort_boxes(table.xyxy, camera))
    table = table[np.isfinite(table.xyxy).all(1)]
    seen = (table.detection_index != 0) | (table.frame < 28) | (table.frame >= 33)
    filled = fill_from_objects(table[seen], bent, np.array([1, 2, 3]), chair_solids(), ["box"] * 3)
    made = filled[filled.score == 0]
    true = table[~seen].xyxy.clip(0, np.tile(SIZE, 2))
    np.testing.assert_allclose(made.xyxy, true, atol=4)
    straight = tracks_of(poses)[~seen].xyxy.clip(0, np.tile(SIZE, 2))
    assert np.abs(made.xyxy - straight).max() > 10


def test_frames_are_filled_only_near_observed_viewpoints() -> None:
    """Detected in one frame: filled if the camera is within 10 deg and 1.25 times the distance."""
    poses = walk(60)
    table = tracks_of(poses)
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
    never = table[seen & (table.detection_index != 0)]  # no detection, nothing to fill from
    assert len(fill_from_objects(never, poses, np.array([1]), solids[:1], ["box"])) == len(never)


def test_greedy_selection_adds_the_largest_marginal_gain() -> None:
    """Equals re-evaluating every object in every round; ties go to the first."""
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
    seen = of.evidence
    cost = of.costs()
    view = made.detections.view
    value = np.minimum(seen.assignment, seen.existence + MAX_BOX_GAIN)
    explained = np.zeros(len(view))
    expected = list[int]()
    while True:
        gain = -cost
        tops = np.zeros((len(many), len(seen.expected)))
        np.maximum.at(tops, (seen.obj, view[seen.row]), value - explained[seen.row])
        gain += (tops + MISSED * (seen.expected.T & (tops > 0))).sum(1)
        gain[expected] = -np.inf
        if gain.max() <= 0:
            break
        expected.append(int(gain.argmax()))
        own = (seen.obj == expected[-1]) & (value > 0)
        np.maximum.at(explained, seen.row[own], value[own])
    assert len(expected) > 1 and made._select_greedily(of).tolist() == expected


def test_the_gain_of_a_merge_uses_all_rows_of_both() -> None:
    """Computed by loops: each object's summed log odds, with one hit per frame at its best row."""
    three = chairs()
    made, found = association_of(three, walk(12))
    rng = np.random.default_rng(1)
    label = found.label.copy()
    label[rng.random(len(label)) < 0.3] = 0  # several rows of an object in one frame
    strong = np.array([0, 1])
    weak = np.array([2, 0])
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
            hit = MISSED * seen.expected[frame, k] * (best[frame][1] == -n)
            expected[k] += max(seen.existence[n] + hit, 0.0)
    assert any(np.bincount(view[label == 0]) > 1)
    np.testing.assert_allclose(made._joint_gains(label, strong, weak, fitted), expected)
