"""Occluded edges: at nearer objects, and at boxes that end above the floor; effect on the fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import CHAIR, SIZE, chair_solids, tracks_of, walk

import quadrics
import reobj_track as rt
from reobj.objects.config import make_fit
from reobj.objects.observations import (
    Scene,
    Views,
    gather_views,
    occluded_edges,
    see_through_ratio,
)

LEFT, UPPER, RIGHT, LOWER = range(4)
ELSEWHERE = np.array([False, False])  # neither stands on the floor


def scene(counter: np.ndarray) -> tuple[quadrics.Ellipsoids, Views]:
    """A chair at the origin and a counter before it, (3,) half sizes, seen from -y; whole boxes."""
    poses = walk(5, arc_deg=8.0)
    centre = np.array([[0, 0, 0.41], [0, -1.0, counter[2]]])
    solids = quadrics.Ellipsoids(
        centre, np.array([[0.28, 0.3, 0.41], counter]), np.tile(np.eye(3), (2, 1, 1))
    )
    cams = poses.camera.K @ poses.cam_from_world
    boxes = quadrics.solid_boxes(solids, "box", cams)
    return solids, Views(poses.frame, boxes, np.ones(boxes.shape[:2]), cams, SIZE)


def cut_below(views: Views) -> None:
    """Truncate the boxes of the first object at those of the second."""
    views.boxes[:, 0, 3] = views.boxes[:, 1, 1]


def test_only_the_edge_at_the_counter_is_occluded() -> None:
    solids, views = scene(np.array([1.5, 0.1, 0.3]))
    cut_below(views)
    found = occluded_edges(views, solids, ELSEWHERE)
    expected = np.zeros((5, 2, 4), bool)
    expected[:, 0, LOWER] = True
    np.testing.assert_array_equal(found, expected)


def test_farther_objects_occlude_nothing() -> None:
    solids, views = scene(np.array([1.5, 0.1, 0.15]))
    solids.center_in_world[1, 1] = 0.4
    views.boxes[:] = quadrics.solid_boxes(solids, "box", views.img_from_world)
    cut_below(views)
    assert not occluded_edges(views, solids, ELSEWHERE)[:, 0].any()
    solids.center_in_world[0, 1] = 1.0
    assert occluded_edges(views, solids, ELSEWHERE)[:, 0, LOWER].all()


def test_a_table_hides_what_is_behind_it_and_not_what_stands_on_it() -> None:
    table = np.array([1.0, 0.6, 0.15])
    solids, views = scene(table)
    for y, hidden in ((-1.0, False), (1.0, True)):
        height = 2 * table[2] if not hidden else 0.0
        solids.center_in_world[0] = 0, y, height + 0.2
        solids.half_axes[0] = 0.06, 0.06, 0.2
        views.boxes[:] = quadrics.solid_boxes(solids, "box", views.img_from_world)
        if hidden:
            cut_below(views)
        assert (occluded_edges(views, solids, ELSEWHERE)[:, 0, LOWER] == hidden).all()


def test_an_object_covering_the_whole_box_occludes_no_edge() -> None:
    """The chair is detected although an object covers it: that object is not opaque."""
    solids, views = scene(np.array([1.5, 0.1, 0.9]))
    assert not occluded_edges(views, solids, ELSEWHERE).any()


def test_an_unknown_object_occludes_nothing() -> None:
    solids, views = scene(np.array([1.5, 0.1, 0.3]))
    cut_below(views)
    solids.center_in_world[1] = solids.half_axes[1] = np.nan
    assert not occluded_edges(views, solids, ELSEWHERE).any()


def test_boxes_that_end_above_the_floor_give_a_one_sided_bound() -> None:
    """Of the two objects on the floor one is unoccluded in the first frame, half occluded later."""
    solids, views = scene(np.array([0.2, 0.2, 0.4]))
    solids.center_in_world[1, :2] = [1.5, 0]
    views.boxes[:] = quadrics.solid_boxes(solids, "box", views.img_from_world)
    lower, height = views.boxes[..., 3], np.diff(views.boxes[..., [1, 3]])[..., 0]
    lower[0] -= 0.05 * height[0]
    lower[1:] -= 0.3 * height[1:]
    expected = np.zeros((5, 2, 4), bool)
    expected[1:, 0] = [True, False, True, True]
    found = occluded_edges(views, solids, np.array([True, False]))
    np.testing.assert_array_equal(found, expected)
    assert not occluded_edges(views, solids, ELSEWHERE).any()


def test_no_edge_is_occluded_below_the_image() -> None:
    """The box ends at the image border, and so does the projection."""
    solids, views = scene(np.array([0.2, 0.2, 0.4]))
    solids.center_in_world[1, :2] = [1.5, 0]
    whole = quadrics.solid_boxes(solids, "box", views.img_from_world)
    size = (SIZE[0], float(whole[..., 3].min()) - 20.0)
    views = dataclasses.replace(views, boxes=quadrics.clip_boxes(whole, size), image_size=size)
    assert not occluded_edges(views, solids, ~ELSEWHERE).any()


@pytest.mark.parametrize("edge", [UPPER, LOWER])
def test_the_fit_extends_behind_an_occluded_edge(edge: int) -> None:
    """A third of each box is occluded; the size prior of chairs gives the rest."""
    poses = walk(120)
    table = tracks_of(poses)
    side = 0.35 * (table.xyxy[:, 3] - table.xyxy[:, 1])
    table.xyxy[:, edge] += side if edge == UPPER else -side
    views = gather_views(table, poses, table.detection_index, 3, 0.0)
    occluded = np.zeros(views.boxes.shape, bool)
    occluded[..., edge] = True
    fit = make_fit(rt.ObjectsConfig(), poses, rt.COCO_NAMES)
    cut, whole = (
        fit(dataclasses.replace(views, occluded=mask), [CHAIR] * 3, Scene())
        for mask in (None, occluded)
    )
    true = 2 * chair_solids().half_axes[:, 2]
    assert (cut.size[:, 2] < 0.8 * true).all()
    np.testing.assert_allclose(whole.size[:, 2], true, rtol=0.15)
    assert (whole.cov[:, 5, 5] > 1.5 * cut.cov[:, 5, 5]).all()  # and it is reported


def seen_along(distance: float, beside: float = 0.0, count: int = 40) -> np.ndarray:
    """Points (N, 3) around the ray of the middle camera through a chair, of distance 1 there."""
    poses, centre = walk(5, arc_deg=8.0), np.array([0, 0, 0.41])
    camera = -poses.cam_from_world[2, :, :3].T @ poses.cam_from_world[2, :, 3]
    noise = np.random.default_rng(0).normal(0, 0.01, (count, 3))
    return np.asarray(camera + distance * (centre - camera) + noise + np.array([beside, 0, 0]))


def through(points: np.ndarray) -> float:
    """See-through ratio of a chair for five cameras, all of which observe all points."""
    solids, _ = scene(np.array([0.2, 0.2, 0.4]))
    every = np.indices((5, len(points))).reshape(2, -1).T
    poses = dataclasses.replace(walk(5, arc_deg=8.0), points=points, visibility=every)
    (found,) = see_through_ratio(solids[[0]], np.ones((5, 1), bool), poses, poses.frame)
    return float(found)


@pytest.mark.parametrize("distance, seen", [(1.4, True), (1.0, False), (0.9, False), (0.6, False)])
def test_points_behind_an_object_are_evidence_against_it(distance: float, seen: bool) -> None:
    """Points on it and in front of it are not."""
    assert through(seen_along(distance)) == pytest.approx(np.log(210 / 10) if seen else 0)


def test_points_on_or_beside_an_object_support_it() -> None:
    """Objects have holes: twice as many points may be seen through them."""
    behind, on_it = seen_along(1.4), seen_along(1.0)
    assert through(np.concatenate([behind, on_it[:10]])) == pytest.approx(np.log(210 / 110))
    assert through(np.concatenate([behind, on_it[:20]])) == 0
    assert through(seen_along(1.4, beside=0.4)) == 0
    assert through(np.empty((0, 3))) == 0


def test_many_points_are_subsampled() -> None:
    assert np.log(5 * 200 / 10) < through(seen_along(1.4, count=5000)) < np.log(5 * 501 / 10)
