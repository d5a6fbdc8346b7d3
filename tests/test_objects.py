"""Object fitting and description: simulated chairs, and fits with values set by hand."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import (
    SIZE,
    SPOT,
    chair_solids,
    finished,
    fitted,
    tracks_of,
    turn,
    two_components,
    unlinked,
    walk,
    with_columns,
)

import quadrics
import reobj_track as rt
from reobj.objects.config import make_fit, mean_box, solve_again
from reobj.objects.description import describe_objects, describe_world, scores_far_off
from reobj.objects.fit import link_and_fit
from reobj.objects.observations import Scene, Views, gather_views
from reobj.results.entries import validate_objects
from reobj.types import Existence
from reobj.words import parse_known_size, parse_up


def options(**changes: object) -> rt.ObjectsConfig:
    return dataclasses.replace(rt.ObjectsConfig(), **changes)  # type: ignore[arg-type]


# ---- Positions, against ground truth ----


def test_objects_have_their_true_positions(chairs: rt.Result) -> None:
    for found, center in zip(chairs.objects, chair_solids().center_in_world, strict=True):
        assert (found.status, found.class_name, found.support) == ("ok", "chair", "box")
        np.testing.assert_allclose(found.center, center, atol=0.03)
        np.testing.assert_allclose(np.sort(found.size), [0.56, 0.6, 0.82], rtol=0.08)
        np.testing.assert_allclose(found.size_m, found.size)  # the world is in metres
        assert found.reprojection_iou_median > 0.9 and found.views == found.frames_seen == 40
        angle = np.radians(found.parallax_deg)
        assert np.radians(90) < angle < np.radians(150)  # an arc of 120 degrees around the middle


def test_without_poses_objects_equal_the_tracks() -> None:
    tracks = tracks_of(walk(8))
    tracks = with_columns(tracks, tracklet_id=tracks.track_id + 10 * (tracks.frame > 4))
    result = fitted(tracks, None)
    assert [o.id for o in result.objects] == [1, 2, 3]
    for found in result.objects:
        assert (found.status, found.reason) == ("tracked", "") and not found.located
        assert found.center is None and found.size_m is None and found.views == 0
        assert found.tracklet_ids == [found.id, found.id + 10] and found.frames_seen == 8
        assert found.visits == [[0, 7]] and found.score == 0.9
    assert result.world.units is None and result.world.to_json()["registered_frames"] == 0


@pytest.mark.parametrize(
    ("every", "gap", "visits"),
    [
        (1, 60, [[0, 199]]),  # 2 s at 30 Hz
        (1, 61, [[0, 50], [111, 199]]),
        (90, 180, [[0, 4500], [4680, 17910]]),  # detections every 3 s
    ],
)
def test_visits_are_times_in_view_with_short_gaps(
    every: int, gap: int, visits: list[list[int]]
) -> None:
    """Of object 1, whatever its tracklets are; the others are seen in all frames."""
    tracks = tracks_of(walk(200))
    tracks = with_columns(tracks, frame=every * tracks.frame, tracklet_id=tracks.frame % 19)
    inside = (tracks.frame > 50 * every) & (tracks.frame < 50 * every + gap)
    found = fitted(tracks[(tracks.track_id > 1) | ~inside], None).objects
    assert found[0].visits == visits and len(found[0].tracklet_ids) == 19
    assert found[1].visits == [[0, 199 * every]]


def test_views_are_frames_with_a_pose() -> None:
    poses = walk()
    poses.cam_from_world[10:20] = np.nan
    result = fitted(tracks_of(poses), poses)
    assert [(o.views, o.frames_seen) for o in result.objects] == [(30, 40)] * 3
    assert (result.world.registered_frames, result.world.frames) == (30, 40)


# ---- Options ----


@pytest.mark.parametrize(
    ("moving", "status"),
    [("person, Office-Chair", "rejected"), ("", "ok")],
)
def test_classes_that_move_get_no_ellipsoid(moving: str, status: str) -> None:
    poses = walk(20)
    result = fitted(tracks_of(poses), poses, options(moving=moving))
    assert {o.status for o in result.objects} == {status}
    if status == "rejected":
        found = result.objects[0]
        assert found.reason == "objects of this class move"
        assert found.center is None and found.size is None and found.support is None


@pytest.mark.parametrize(("min_views", "rejected"), [(4, False), (5, True)])
def test_min_views_is_the_number_required(min_views: int, rejected: bool) -> None:
    poses = walk(40)
    tracks = tracks_of(poses)
    tracks = tracks[np.isin(tracks.frame, [0, 13, 26, 39])]
    found = fitted(tracks, poses, options(min_views=min_views)).objects[0]
    assert (found.status == "rejected") == rejected
    assert ("seen in 4 frames with a camera pose (5 are needed)" in found.reason) == rejected


@pytest.mark.parametrize(("score", "views"), [(0.0, 10), (0.25, 40)])
def test_filled_gaps_do_not_shape_the_ellipsoid(score: float, views: int) -> None:
    """Three of four boxes are twice as high: with score 0 they are filled gaps and no views."""
    poses = walk(40)
    tracks = tracks_of(poses)
    weak = tracks.frame % 4 != 0
    tracks.xyxy[weak, 1] -= np.diff(tracks.xyxy[weak][:, [1, 3]])[:, 0]
    result = fitted(with_columns(tracks, score=np.where(weak, score, 0.9)), poses, options())
    height = np.median([o.size.max() for o in result.objects if o.located])
    assert {o.views for o in result.objects} == {views}
    assert (abs(height - 0.82) < 0.08) == (views == 10)


def classes_of(labels: list[int], score: float = 0.8, others: int = 0) -> dict[str, float]:
    """Classes of one object with these labels, beside one of `others` more classes."""
    label = np.array([*labels, *range(60, 60 + others)])
    n, one = len(label), np.ones(len(label), np.int64)
    identity = np.where(np.arange(n) < len(labels), 1, 2)
    box = np.tile([10.0, 10, 50, 50], (n, 1))
    tracks = rt.Tracks(np.arange(n), identity, one, box, np.full(n, score), label, one)
    return describe_objects(tracks, rt.COCO_NAMES, None, None)[0].classes


def test_an_object_lists_its_two_most_probable_classes() -> None:
    chair, couch, bench = 56, 57, 13
    torn = classes_of([chair] * 11 + [couch] * 9 + [bench])
    assert list(torn) == ["chair", "couch"] and 0.5 < torn["chair"] < 0.75
    assert sum(torn.values()) < 1  # the bench has a small probability
    clear = classes_of([chair] * 60 + [couch] * 20)
    assert clear["chair"] > 0.95 > torn["chair"]
    weak = classes_of([chair] * 60 + [couch] * 20, score=0.1)
    assert clear["chair"] > weak["chair"] > weak["couch"]
    assert classes_of([chair]) == {"chair": 1.0}  # no other class in the video
    once = classes_of([chair], others=9)
    assert list(once) == ["chair"] and 0.1 < once["chair"] < 0.3  # one box is weak evidence


def test_shape_and_up_reach_the_fit() -> None:
    poses = dataclasses.replace(walk(20), up_in_world=None)
    tracks = tracks_of(poses)
    tilted = np.array([0, 0.1, 1]) / np.hypot(0.1, 1)
    given = options(support="cylinder", up=",".join(map(str, 3 * tilted)))
    result = fitted(tracks, poses, given)
    assert {o.support for o in result.objects} == {"cylinder"}
    assert result.world.up_source == "given"
    np.testing.assert_allclose(result.world.up_in_world, tilted, atol=1e-5)


@pytest.mark.parametrize("text", ["north", "0,0,0", "1,2,nan"])
def test_up_that_is_no_direction(text: str) -> None:
    with pytest.raises(rt.ReobjError, match="expected a direction"):
        parse_up(text)


@pytest.mark.parametrize("text", ["door", "door=2furlongs", "=2m", "door=1.2.3m", "door=0m"])
def test_invalid_known_sizes(text: str) -> None:
    with pytest.raises(rt.ReobjError, match="--known-size"):
        parse_known_size(text)


def test_the_fitter_accepts_classes_without_a_name() -> None:
    """A class without a name has no category and raises no error."""
    poses = walk(10)
    tracks = with_columns(tracks_of(poses), class_id=7)
    views = gather_views(tracks, poses, tracks.track_id - 1, 3, 0.3)
    assert len(make_fit(rt.ObjectsConfig(), poses, ("cup",))(views, [7, 7, 7], Scene())) == 3
    assert {o.class_name for o in describe_objects(tracks, (), None, None)} == {"object"}


# ---- Description of a fit set by hand ----

TURN = Rotation.from_euler("zyx", [70, 20, -40], degrees=True)


def a_fit(count: int = 4, **changes: object) -> tuple[quadrics.ObjectFits, Views]:
    """One object fitted in `count` frames of a static camera, and its exact boxes."""
    half = np.array([[0.2, 0.3, 0.4]])
    solids = quadrics.Ellipsoids(np.array([[0.1, -0.2, 5.0]]), half, TURN.as_matrix()[None])
    img_from_world = np.tile(walk(1).camera.K @ np.eye(3, 4), (count, 1, 1))
    boxes = quadrics.solid_boxes(solids, "box", img_from_world)
    cov = np.diag([1, 1, 1, 0.01, 0.04, 0.09, 1, 1, 1.0])[None]
    facts: dict[str, object] = {
        "ellipsoids": solids, "size": 2 * half, "cov": cov, "support": np.array(["box"]),
        "inlier": np.ones((count, 1), bool), "rms_px": np.ones(1), "status": np.array(["ok"]),
        "reason": [""], "parallax_deg": np.array([31.23456]), "prior_share": np.ones((1, 3)),
        "scale": quadrics.Scale(2.5, 0.2, "priors"), "up": np.array([0, 0, 1.0]),
        "up_source": "objects",
    }  # fmt: skip
    views = Views(np.arange(count), boxes, np.ones((count, 1)), img_from_world, SIZE)
    return quadrics.ObjectFits(**facts | changes), views  # type: ignore[arg-type]


def described(
    count: int = 4, confidence: dict[int, float] | None = None, **changes: object
) -> rt.Object:
    fits, views = a_fit(count, **changes)
    one, zero = np.ones(count, np.int64), np.zeros(count, np.int64)
    score = np.linspace(0.4, 0.8, count)
    tracks = rt.Tracks(np.arange(count), one, one, views.boxes[:, 0], score, zero, zero)
    (found,) = describe_objects(tracks, ("lamp",), fits, views, confidence=confidence)
    return found


def test_sizes_are_in_metres_and_include_the_sigma_of_the_scale() -> None:
    found = described()
    np.testing.assert_allclose(found.size, [0.4, 0.6, 0.8])
    np.testing.assert_allclose(found.size_m, [1.0, 1.5, 2.0])  # 2.5 m a unit
    expected = np.sqrt([0.01 + 0.04, 0.04 + 0.04, 0.09 + 0.04])  # of the size, of the scale
    np.testing.assert_allclose(found.size_rel_sigma, expected, rtol=1e-5)
    np.testing.assert_allclose(found.center, [0.1, -0.2, 5.0])
    np.testing.assert_allclose(found.half_axes, [0.2, 0.3, 0.4])
    assert np.shape(found.cov) == (9, 9) and found.cov[4, 4] == 0.04


@pytest.mark.parametrize(
    ("row", "value", "named"),
    [(2, 1e40, "place"), (4, 1e40, "size"), (8, 1e40, ""), (3, np.nan, "uncertainty")],
)
def test_a_sigma_without_a_meaning_is_bounded(row: int, value: float, named: str) -> None:
    """A variance of 1e40 with a correlation of .9; numbers that are no variances."""
    cov = np.diag([1, 1, 1, 0.01, 0.04, 0.09, 1, 1, 1.0])
    other = (row + 1) % 9
    cov[row, other] = cov[other, row] = 0.9 * np.sqrt(value * cov[other, other])
    cov[row, row] = value
    found = described(cov=cov[None])
    assert named in found.reason and bool(found.reason) == bool(named)
    most = np.repeat([50, 3, np.pi / 3**0.5], 3)  # 10 distances of 5; log; a full turn
    sigma = np.sqrt(np.diag(found.cov))
    assert (sigma <= 1.01 * most).all() and np.linalg.eigvalsh(found.cov).min() > 0
    if np.isfinite(value):  # the others keep theirs, and the correlation
        kept = np.delete(np.arange(9), row)
        np.testing.assert_allclose(sigma[kept] ** 2, np.diag(cov)[kept])
        assert found.cov[row, other] == pytest.approx(0.9 * most[row] * sigma[other], rel=0.01)


def test_without_a_scale_there_are_no_metres() -> None:
    found = described(scale=quadrics.Scale(1.0, 0.0, "none"))
    assert found.size_m is None and found.size is not None


def test_quaternion_is_world_from_object_w_first() -> None:
    w, x, y, z = described().quat_wxyz
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), TURN.as_matrix(),
                               atol=1e-5)  # fmt: skip


def test_evidence_of_a_fit() -> None:
    inlier = np.array([[True], [False], [True], [True]])
    found = described(inlier=inlier)
    assert (found.views, found.frames_seen, found.dropped_boxes) == (4, 4, 1)
    assert found.parallax_deg == 31.23 and found.reprojection_iou_median == 1.0
    assert found.score == 0.6 and found.class_name == "lamp" and found.reason == ""


def test_unseen_frames_do_not_count_as_views() -> None:
    """In five of eight frames the object has no box: no view, no outlier, no overlap of 0."""
    fits, views = a_fit(8, inlier=np.arange(8)[:, None] < 3)
    views.boxes[3:] = np.nan
    three = np.arange(3)
    tracks = rt.Tracks(three, three * 0 + 1, three * 0 + 1, views.boxes[:3, 0], np.ones(3),
                       three * 0, three)  # fmt: skip
    (found,) = describe_objects(tracks, ("lamp",), fits, views)
    assert (found.views, found.dropped_boxes, found.reprojection_iou_median) == (3, 0, 1.0)


def test_world_of_a_fit() -> None:
    poses = walk(6)
    poses.cam_from_world[1] = np.nan
    status = np.array(["supplied", "none", "interpolated", *["supplied"] * 3])
    poses = dataclasses.replace(poses, metric=False, status=status)
    fits, _ = a_fit(scale=quadrics.Scale(2.123456789, 0.123456789, "priors"))
    event = rt.LinkEvent("join", (1, 2), 0.5, 1.0, True)
    world = describe_world(poses, [fits], [event])
    assert (world.units, world.source) == ("arbitrary", "user")
    assert (world.registered_frames, world.interpolated_frames, world.frames) == (5, 1, 6)
    assert world.scale == (2.123457, 0.1235, "priors") and world.links == (event,)
    assert world.up_source == "objects" and world.up_in_world.tolist() == [0, 0, 1]


def test_a_size_of_four_sigma_is_reported_and_not_set_aside() -> None:
    """A chair that the detector calls a couch."""
    poses = walk()
    couch = rt.COCO_NAMES.index("couch")
    tracks = tracks_of(poses)
    tracks = with_columns(tracks, class_id=np.where(tracks.track_id == 2, couch, tracks.class_id))
    found = fitted(tracks, poses).objects
    assert found[1].status == "ok" and "sigma from the usual one" in found[1].reason
    assert all(o.counted and o.located for o in found)


@pytest.mark.parametrize(("confidence", "status"), [(0.9, "ok"), (0.4, "doubtful")])
def test_low_confidence_is_a_status_of_its_own(confidence: float, status: str) -> None:
    """The object keeps its shape, but is not located; a rejection keeps its reason."""
    found = described(confidence={1: confidence})
    assert (found.status, found.located) == (status, status == "ok")
    assert found.center is not None and found.confidence == confidence
    rejected = {"status": np.array(["rejected"]), "reason": ["too few"]}
    found = described(confidence={1: confidence}, **rejected)
    assert found.status == ("rejected" if status == "ok" else "doubtful")
    assert "too few" in found.reason


@pytest.mark.parametrize(
    ("evidence", "named", "figure"),
    [
        ((-1.4, 1.0, 0.0), "scores", "0.20"),  # log odds, hit rate, log ratio of see-through
        ((1.0, 0.12, 0.0), "detected in", "12 %"),
        ((0.5, 0.7, 1.386), "background points", "4.0 times"),
        ((0.5, np.nan, 0.0), "no object in 3D", ""),
    ],
)
def test_the_reason_of_a_low_confidence_is_its_weightiest_evidence(
    evidence: tuple[float, ...], named: str, figure: str
) -> None:
    causes = ("scores", "detected in", "background points", "no object in 3D")
    reason = described(confidence={1: Existence(0.45, *evidence)}).reason
    assert reason.startswith("45 % likely to exist: ") and figure in reason
    assert [cause for cause in causes if cause in reason] == [named]


@pytest.mark.parametrize(
    ("score", "said"), [(0.5, False), (0.9, False), (0.99, True), (0.03, True)]
)
def test_scores_unlike_those_of_the_confidence_are_reported(
    chairs: rt.Result, score: float, said: bool
) -> None:
    """Interpolated rows, two of three here, have no score."""
    index = np.arange(len(chairs.tracks)) % 3 // 2 - 1  # -1: interpolated
    scores = np.where(index < 0, 0.0, score)
    tracks = with_columns(chairs.tracks, score=scores, detection_index=index)
    sure = [dataclasses.replace(o, confidence=0.9) for o in chairs.objects]
    result = dataclasses.replace(chairs, tracks=tracks, objects=sure, untracked=rt.Tracks.empty())
    texts = scores_far_off(result)
    assert len(texts) == said and all(f"is {score:.2g}, that of" in text for text in texts)
    unsure = [dataclasses.replace(o, confidence=None) for o in chairs.objects]
    assert scores_far_off(dataclasses.replace(result, objects=unsure)) == []


# ---- Cameras with directions only ----


@pytest.mark.parametrize("solver", ["solids", "lfd"])
def test_directions_measure_no_object(tmp_path: Path, solver: str) -> None:
    poses, tracks = turn()
    config = rt.ObjectsConfig(solver=solver)
    result = solve_again(link_and_fit(unlinked(poses, tracks), config), config)
    (part,) = result.world.parts
    assert part.grade == "directions" and part.direction_sigma_deg == pytest.approx(0.573)
    assert "40 of 40 frames (pycolmap; directions only)" in result.summary()
    assert not any(o.status == "ok" for o in result.objects) and len(result.objects) == 3
    for o, true in zip(result.objects, chair_solids().center_in_world, strict=True):
        box = tracks.xyxy[tracks.track_id == o.id]
        longer_px = np.median((box[:, 2:] - box[:, :2]).max(1))
        assert o.angular_size_deg == pytest.approx(np.degrees(longer_px / 520), rel=0.1)
        if solver == "solids":
            away = (true - SPOT) / np.linalg.norm(true - SPOT)
            assert "distance guessed" in o.reason and o.direction @ away > np.cos(np.radians(1.5))
        elif o.located:
            assert o.reason == "size and distance not measured: the cameras have directions only"
    result.save(tmp_path)
    assert validate_objects(tmp_path) == []
    read = rt.Result.load(tmp_path)
    assert [o.to_json() for o in read.objects] == [o.to_json() for o in result.objects]
    assert read.world.to_json() == result.world.to_json()


def test_files_without_grades_are_read(tmp_path: Path) -> None:
    finished(unlinked()).save(tmp_path)
    path = tmp_path / "objects.json"
    data = json.loads(path.read_text())
    assert all(o.pop("direction") is o.pop("angular_size_deg") is None for o in data["objects"])
    for part in data["world"]["parts"]:
        assert (part.pop("grade"), part.pop("direction_sigma_deg")) == ("positions", 0)
    path.write_text(json.dumps(data))
    assert [part.grade for part in rt.Result.load(tmp_path).world.parts] == ["positions"] * 2


def test_each_component_has_a_grade() -> None:
    poses = dataclasses.replace(two_components(), direction_sigma=np.array([0, 0.02]))
    result = finished(unlinked(poses))
    assert [part.grade for part in result.world.parts] == ["positions", "directions"]
    assert {(o.part, o.direction is None, o.status) for o in result.objects} == {
        (0, True, "ok"), (1, False, "prior_dominated"),
    }  # fmt: skip
    assert "(pycolmap; 23 with directions only) in 2 components" in result.summary()
    assert result.summary().count("frames; directions only") == 1


# ---- Boxes in 3D of a detector ----


def boxes_of(center: Any, size: Any, yaw_deg: Any, count: int = 40) -> np.ndarray:
    """Boxes (n, 15) of one object, turned about z."""
    yaw = np.broadcast_to(np.radians(yaw_deg), count)
    turn = Rotation.from_rotvec(yaw[:, None] * [0, 0, 1]).as_matrix().reshape(-1, 9)
    columns = [np.broadcast_to(v, (count, 3)) for v in (center, np.array(size) / 2)]
    return np.hstack([*columns, turn])


def test_the_mean_box_ignores_outliers_and_the_order_of_axes() -> None:
    rng = np.random.default_rng(0)
    truth = np.array([1.0, 0.4, 0.8])
    turns = rng.integers(0, 4, 40)
    size = np.where(turns[:, None] % 2 == 1, truth[[1, 0, 2]], truth)
    size = size * np.exp(0.02 * rng.normal(size=(40, 3)))
    center = np.array([2.0, 3.0, 0.4]) + 0.01 * rng.normal(size=(40, 3))
    box = boxes_of(center, size, 20 + 90 * turns + rng.normal(size=40))
    box[:4, :3] += 2.0  # in another place
    box[4:8, 3:6] *= 3.0  # of another size
    mean, half, turn, cov = mean_box(box, np.full(40, 0.8), np.array([0, 0, 1.0]))
    assert np.abs(mean - [2, 3, 0.4]).max() < 0.01
    order = [0, 1, 2] if half[0] > half[1] else [1, 0, 2]
    assert np.abs(2 * half[order] / truth - 1).max() < 0.02
    assert turn[2, 2] > 0.999 and np.linalg.det(turn) == pytest.approx(1)
    degrees = np.degrees(np.arctan2(turn[1, order[0]], turn[0, order[0]])) % 180
    assert degrees == pytest.approx(20, abs=1)
    assert (np.sqrt(np.diag(cov)) >= 0.05 * 0.2).all() and (np.linalg.eigvalsh(cov) > 0).all()
