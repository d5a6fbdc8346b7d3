"""Implausible results: one warning in one line with a remedy; none for plausible results."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import SIZE, walk

import reobj_track as rt
from reobj.results.plausibility import implausible
from reobj.results.result import VideoInfo

MOVING = rt.ObjectsConfig().moving_classes
HIGH = 0.4
FRIDGE, CHAIR, PERSON = (rt.COCO_NAMES.index(n) for n in ("refrigerator", "chair", "person"))


def rows(count: int, track_id: int, class_id: int = CHAIR, score: float = 0.9) -> rt.Tracks:
    """Boxes of one object in the first frames."""
    n = np.arange(count)
    columns = (np.zeros((count, 4)), np.full(count, score), np.full(count, class_id))
    return rt.Tracks(n, 0 * n + track_id, 0 * n + track_id, *columns, 0 * n + track_id)


def result(
    classes: dict[int, int],
    status: str = "ok",
    poses: rt.Poses | None = None,
    boxes: int = 10,
) -> rt.Result:
    """Objects of each class with this count, all of one status."""
    kinds = np.repeat(list(classes), list(classes.values())).tolist()
    tracks = [rows(boxes, i, kind) for i, kind in enumerate(kinds, 1)]
    objects = [
        rt.Object(i, rt.COCO_NAMES[kind], 0.9, status, "") for i, kind in enumerate(kinds, 1)
    ]
    table = rt.Tracks.joined([rt.Tracks.empty(), *tracks])
    return rt.Result(table, rt.COCO_NAMES, VideoInfo("v", *SIZE, 30.0), objects, poses=poses)


def said(found: rt.Result, **change: object) -> list[str]:
    lines = implausible(dataclasses.replace(found, **change), HIGH, MOVING)
    assert all("\n" not in line for line in lines)
    return lines


def lost(fraction: float, **change: object) -> rt.Poses:
    """A walk of 40 frames of which this fraction has no pose."""
    poses = walk()
    poses.cam_from_world[: round(40 * fraction)] = np.nan
    return dataclasses.replace(poses, **change)


@pytest.mark.parametrize(
    ("classes", "warned"),
    [
        ({FRIDGE: 9, CHAIR: 5}, True),  # office_loop with a small detector
        ({FRIDGE: 8, CHAIR: 8}, False),  # half is not more than half
        ({FRIDGE: 7, CHAIR: 1}, False),  # few
        ({PERSON: 20, FRIDGE: 4}, False),  # people come in crowds
        ({CHAIR: 20}, False),  # the only class of the detector
    ],
)
def test_most_objects_of_one_class(classes: dict[int, int], warned: bool) -> None:
    lines = said(result(classes))
    assert len(lines) == warned
    if warned:
        n = classes[FRIDGE]
        expected = f"{n} of {sum(classes.values())} listed objects are of the class refrigerator"
        assert lines[0].startswith(expected) and "check that" in lines[0]
        assert "--detector" in lines[0] and "--detections" in lines[0]
    assert said(result(classes), identities_given=True) == []


@pytest.mark.parametrize(
    ("status", "count", "warned"),
    [("prior_dominated", 3, True), ("rejected", 5, True), ("prior_dominated", 2, False),
     ("ok", 5, False), ("doubtful", 9, False)],
)  # fmt: skip
def test_nothing_measured(status: str, count: int, warned: bool) -> None:
    found = result({CHAIR: count}, status, walk(), boxes=1)
    assert len(said(found)) == warned
    if warned:
        (line,) = said(found)
        assert f"none of the {count} listed objects is measured" in line and "sideways" in line
        assert "--camera" not in line  # these cameras were supplied
        found = dataclasses.replace(found, poses=dataclasses.replace(walk(), source="pycolmap"))
        assert "--camera" in said(found)[0] and "--poses" in said(found)[0]
        found.objects[1] = dataclasses.replace(found.objects[1], parallax_deg=9.9)
        assert len(said(found)) == 1
        seen = dataclasses.replace(found.objects[1], parallax_deg=10.0)  # from all around
        for enough in (seen, dataclasses.replace(found.objects[1], status="ok")):
            found.objects[1] = enough
            assert said(found) == []
    assert said(found) == []
    assert said(found, poses=lost(1)) == said(found, poses=None) == []  # nothing could be


@pytest.mark.parametrize(("fraction", "warned"), [(0, 0), (0.5, 0), (0.55, 1), (0.9, 1), (1, 0)])
def test_most_frames_without_a_camera(fraction: float, warned: bool) -> None:
    """Where none has one, the poses say why."""
    for source, remedy in (("user", "--poses is of this video"), ("pycolmap", "slower turns")):
        lines = said(result({CHAIR: 3}, poses=lost(fraction, source=source)))
        assert len(lines) == warned
        if warned:
            assert f"only {40 - round(40 * fraction)} of 40 frames have a camera" in lines[0]
            assert remedy in lines[0] and ("--camera" in lines[0]) == (source == "pycolmap")


@pytest.mark.parametrize(
    ("untracked", "score", "warned"),
    [(60, 0.9, False), (61, 0.4, True), (61, 0.39, False), (500, 0.1, False)],
)
def test_most_strong_boxes_unexplained(untracked: int, score: float, warned: bool) -> None:
    found = result({CHAIR: 3, FRIDGE: 3}, status="tracked")  # 60 boxes of objects
    lines = said(found, untracked=rows(untracked, 0, CHAIR, score))
    assert len(lines) == warned
    if warned:
        assert lines[0].startswith(f"{untracked} of {60 + untracked} boxes of score 0.4 or more")
        assert "low confidence" not in lines[0]
