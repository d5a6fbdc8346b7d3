"""Scores of the benchmarks for hand-made results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import truth as scores
from from_one_spot import score_identities
from pose_breaks import judge
from scipy.spatial.transform import Rotation

import reobj_track as rt


def output(rows: list[list[float]], names: dict[int, str]) -> scores.Output:
    objects = [{"id": i, "class": name} for i, name in names.items()]
    return scores.Output({}, np.array(rows, float).reshape(-1, 6), objects, {})


def test_identities_and_lists_by_hand(tmp_path: Path) -> None:
    """Ten frames of a chair and a cup; the chair breaks in two, a bottle is seen on the cup."""
    path = tmp_path / "gt.txt"
    true = [f"{f + 1},{i},{50 * i},0,20,20,1,{i},1" for f in range(10) for i in (1, 2)]
    path.write_text("\n".join(true))
    truth = scores.read_mot_truth(path, {1: "chair", 2: "cup"})
    chair = [[f, 5 if f < 7 else 6, 51, 0, 71, 20] for f in range(10)]
    found = scores.score_2d(truth, output(chair, {5: "chair", 6: "chair"}))
    assert found == scores.Found(2 * 7 / 30, 1, 2, 1)
    bottle = [[f, 7, 100, 0, 120, 20] for f in range(10)]
    found = scores.score_2d(truth, output(bottle, {7: "bottle"}))
    assert found == scores.Found(0, 0, 2, 1)
    moved = [[f, 5, 60, 0, 80, 20] for f in range(10)]  # IoU 1 / 3
    assert scores.score_2d(truth, output(moved, {5: "chair"})).found == 0
    assert scores.score_2d(truth, output([], {})) == scores.Found(0, 0, 2, 0)


def test_cameras_and_solids_by_hand() -> None:
    rng = np.random.default_rng(0)
    true = rng.normal(size=(9, 3))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    ours = dict(enumerate((true - 3) @ turn * 0.5))  # true = 2 turn ours + 3
    objects = [
        {"id": 1, "class": "chair", "center": turn.T @ [-1.0, -1, -1.25], "size": [0.2, 0.1, 0.4],
         "quat_wxyz": [1, 0, 0, 0]},
    ]  # fmt: skip
    output = scores.Output({}, np.empty((0, 6)), objects, ours)
    cameras = scores.score_cameras(output, dict(enumerate(true)), own=True)
    assert cameras is not None and cameras.median == pytest.approx(0, abs=1e-9)
    chair = {"class": "chair", "center": [1, 1, 0.4], "size_m": [0.2, 0.4, 0.8],
             "world_from_obj": np.eye(3)}  # fmt: skip
    solids = scores.score_solids([chair], output, cameras.truth_from_ours)
    assert (solids.found, solids.true) == (1, 1)
    assert solids.centre_m == pytest.approx(0.1) and solids.size == pytest.approx(0, abs=1e-9)
    far = chair | {"center": [2, 1, 0.4]}
    assert scores.score_solids([far], output, cameras.truth_from_ours).found == 0
    late = scores.score_cameras(output, {k + 1: v for k, v in enumerate(true)}, own=True)
    assert late is not None and late.median > 0.3


def test_returns_and_the_ceiling_of_idf1_by_hand() -> None:
    """An object has four visits: found as 7, as 8 and as 7 again; the last has no recorded box."""
    frames = [0, 1, 2, 15, 16, 17, 30, 31, 43, 44, 45]  # 12 frames between 17 and 30, not 31 and 43
    ids = [7, 7, 8, 8, 8, 7, 7, 7, 7, 7, 7]
    box = [10.0, 10, 30, 30]
    truth = np.array([[f, 1, *box] for f in [*frames, 60]], float)
    tracks = np.array([[f, i, *box] for f, i in zip(frames, ids, strict=True)], float)
    boxes = np.array([[f, 0, *box] for f in frames] + [[0, 0, 90, 10, 110, 30]], float)
    found = score_identities(truth, boxes, tracks)
    counts = {"returns": 2, "kept": 1, "unlisted": 0}
    assert found == {"ceiling": 2 * 11 / (12 + 11)} | counts
    late = score_identities(truth, boxes, tracks[tracks[:, 0] > 2])
    assert (late["returns"], late["kept"], late["unlisted"]) == (2, 0, 2)


def test_rotations_of_a_component_of_directions_are_judged_apart_from_positions() -> None:
    """Eight frames have sound positions; of twelve with directions only, four are 20 deg off."""
    rng = np.random.default_rng(0)
    truth = np.zeros((20, 3, 4))
    truth[:, :, :3] = Rotation.random(20, random_state=1).as_matrix()
    truth[:, :, 3] = rng.normal(size=(20, 3))
    cams = truth.copy()
    cams[8:, :, :3] = truth[8:, :, :3] @ Rotation.random(random_state=2).as_matrix()
    cams[8:, :, 3] = 0
    cams[16:, :, :3] = Rotation.from_euler("z", 20, degrees=True).as_matrix() @ cams[16:, :, :3]
    camera = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    part = np.repeat([0, 1], [8, 12])
    poses = rt.Poses(camera, np.arange(20), np.arange(20.0), cams, np.full(20, "registered"),
                     "pycolmap", part=part, direction_sigma=np.array([0, 0.01]))  # fmt: skip
    found = judge(poses, truth, np.zeros(20, np.int64))
    assert (found.outcome, found.right, found.wrong, found.components) == ("partly", 8, (), 1)
    assert (found.directions, found.directions_off, found.directions_deg) == (12, 4, 0)
