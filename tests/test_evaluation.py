"""Scores against published ones, against TrackEval, and against cases worked out by hand."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import SPOT, finished, turn, unlinked

import quadrics
import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.evaluation.objects import read_true_objects, score_objects
from reobj.evaluation.tracks import (
    return_ranks,
    score_report,
    score_tracks,
)
from reobj.evaluation.truth import LabelledBoxes, labelled
from reobj.results.result import VideoInfo
from reobj.results.workspace import Workspace
from reobj.types import Embeddings

# TrackEval 1.3.0 on `drifting(seed)` (numbers kept so that something is checked without it)
STORED = {
    0: {
        "HOTA": 0.40494081862197734,
        "DetA": 0.4993655294235794,
        "AssA": 0.3293713465268212,
        "MOTA": 0.5418502202643172,
        "IDSW": 17.0,
        "Frag": 77.0,
        "IDF1": 0.5214521452145214,
        "IDP": 0.5208791208791209,
        "IDR": 0.5220264317180616,
    },
}


def drifting(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """True and found MOTChallenge rows: misses, switches, swaps, false boxes, unmarked truth."""
    rng = np.random.default_rng(seed)
    gt, pr = [], []
    for obj in range(8):
        start, here = rng.integers(0, 20), rng.uniform(0, 500, 2)
        name = 10 + obj
        for frame in range(start, start + 60):
            here = here + rng.normal(0, 2, 2)
            flag = float(not (obj == 7 and frame < 30))  # zero-marked as in MOT15
            gt.append([frame + 1, obj + 1, *here, 60, 90, flag, -1, -1, -1])
            name = name + 20 if rng.random() < 0.03 else name
            if rng.random() < 0.85:
                pr.append([frame + 1, name, *(here + rng.normal(0, 9, 2)), 60, 90, 0.9, -1, -1, -1])
    for k in range(40):
        junk = [rng.integers(1, 80), 900 + k // 5, *rng.uniform(0, 500, 2)]
        pr.append([*junk, 60, 90, 0.5, -1, -1, -1])
    rows = np.array(pr)
    _, first = np.unique(rows[:, :2], axis=0, return_index=True)  # an identity once a frame
    return np.array(gt), rows[first]


def write(path: Path, rows: np.ndarray) -> Path:
    np.savetxt(path, rows, delimiter=",", fmt="%.6f")
    return path


def score(gt: Path, found: Path) -> dict[str, float]:
    return rt.evaluate(found, gt)["tracks"]["all"]


# ---- Against other implementations ----


@pytest.mark.parametrize("seed", STORED)
def test_equals_the_stored_numbers_of_trackeval(tmp_path: Path, seed: int) -> None:
    gt, pr = drifting(seed)
    mine = score(write(tmp_path / "gt.txt", gt), write(tmp_path / "pr.txt", pr))
    assert {k: mine[k] for k in STORED[seed]} == pytest.approx(STORED[seed], abs=1e-9)


@pytest.mark.parametrize(
    ("name", "published"),  # py-motmetrics' README
    [
        ("TUD-Campus", {"IDF1": 55.8, "IDP": 73.0, "IDR": 45.1, "recall": 58.2, "precision": 94.1,
                        "IDSW": 7, "Frag": 7, "MOTA": 52.6}),
        ("TUD-Stadtmitte", {"IDF1": 64.5, "recall": 60.9, "precision": 94.0, "IDSW": 7, "Frag": 6,
                            "MOTA": 56.4}),
    ],
)  # fmt: skip
def test_equals_published_scores(name: str, published: dict[str, float]) -> None:
    data = os.environ.get("REOBJ_DATA", Path(rt.__file__).resolve().parent.parent / "shared/data")
    folder = Path(data) / "mot" / "metrics_check" / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there (py-motmetrics' example, not redistributed)")
    mine = score(folder / "gt.txt", folder / "test.txt")
    for key, value in published.items():
        scale = 1 if key in ("IDSW", "Frag") else 100
        assert round(scale * mine[key], 1) == pytest.approx(value, abs=0.051), key


# ---- By hand ----


def boxes(*rows: tuple[float, ...]) -> LabelledBoxes:
    """Rows frame, id, x; all boxes are 10 x 10."""
    return labelled(np.array([[f, i, x, 0, 10, 10, 1] for f, i, x in rows], float))


@pytest.mark.parametrize(
    ("embedding", "ranks"),
    [
        ([[1, 0], [0, 1], [0.9, 0.1]], [1]),  # like its own first view
        ([[1, 0], [0, 1], [0.1, 0.9]], [2]),  # like the other object
        ([[1, 0], [np.nan, np.nan], [0.1, 0.9]], [1]),  # the other one has no embedding
        ([[np.nan, np.nan], [0, 1], [0.1, 0.9]], []),  # no embedding of its own: no query
    ],
)
def test_rank_of_a_return(embedding: list[list[float]], ranks: list[int]) -> None:
    truth = boxes((0, 1, 0), (0, 2, 50), (50, 1, 90))
    assert return_ranks(truth, truth, np.array(embedding)).tolist() == ranks


def tracked_folder(out: Path, result: rt.Result, config: rt.InputConfig | None = None) -> None:
    """What `track` leaves in an output folder, of a video of one black frame."""
    out.mkdir(parents=True)
    cv2.imwrite(str(out.parent / "0.png"), np.zeros((480, 640, 3), np.uint8))
    space = Workspace(out)
    video = rt.Video(out.parent / "0.png")
    video.config = config or rt.InputConfig()
    space.bind(video)
    space.save_last(result, result.poses)
    result.save(out)


def cups(frame: list[int], obj: list[int]) -> rt.Result:
    """Cups of 10 x 10 pixels, 50 apart, one detection a frame and cup."""
    number, ids = np.array(frame), np.array(obj)
    x = 50.0 * (ids - 1)
    xyxy = np.stack([x, 0 * x, x + 10, 0 * x + 10], 1)
    cup, n = np.full(len(ids), 41), len(ids)
    tracks = rt.Tracks(number, ids, ids, xyxy, np.ones(n), cup, np.zeros(n, np.int64))
    objects = [rt.Object(i, "cup", 1.0, "rejected", "flat") for i in sorted({*obj})]
    return rt.Result(tracks, rt.COCO_NAMES, VideoInfo("a", 640, 480, 30.0), objects)


def truth_of(path: Path, result: rt.Result) -> Path:
    """The tracks as MOTChallenge truth, frames from 1."""
    tracks = result.tracks
    sizes = tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]
    one = np.ones(len(tracks))
    rows = np.c_[tracks.frame + 1, tracks.track_id, tracks.xyxy[:, :2], sizes, one]
    return write(path, rows)


def test_eval_ranks_the_embeddings_of_the_folder(tmp_path: Path) -> None:
    """Two cups, one comes back twice: once like itself, once like the other (Rank-1 .5)."""
    result = cups([0, 0, 40, 80], [1, 2, 1, 1])
    fused = np.array([[1, 1, 0], [1, 0, 1], [1, 0.9, 0.1], [1, 0.1, 0.9]], np.float16)
    result = dataclasses.replace(
        result, embeddings=Embeddings(fused[:, :1], fused[:, 1:]), embedding_row=np.arange(4)
    )
    tracked_folder(tmp_path / "out", result)
    gt = truth_of(tmp_path / "gt.txt", result)
    scores = rt.evaluate(str(tmp_path / "out"), str(gt))
    expected = {"queries": 2, "rank1": 0.5, "rank5": 1.0, "rank20": 1.0, "rank50": 1.0}
    assert scores["ranks"] == expected and scores["tracks"]["all"]["HOTA"] == 1
    assert "2 queries: Rank-1 0.500, Rank-5 1.000" in score_report(scores)


def test_frames_that_were_not_read_do_not_count(tmp_path: Path) -> None:
    """--start 2 --stop 8 --every 2 read frames 2, 4, 6; the truth has 0 to 9, counted from 1."""
    truth = cups(list(range(10)), [1] * 10)
    found = cups([2, 4, 6], [1] * 3)
    gt = truth_of(tmp_path / "gt.txt", truth)
    tracked_folder(tmp_path / "out", found, rt.InputConfig(every=2, start=2, stop=8))
    score = rt.evaluate(tmp_path / "out", gt)["tracks"]["all"]
    assert score["recall"] == score["precision"] == score["HOTA"] == 1
    tracked_folder(tmp_path / "all" / "out", found)
    assert rt.evaluate(tmp_path / "all/out", gt)["tracks"]["all"]["recall"] == 0.3


def test_scores_by_class(tmp_path: Path) -> None:
    """Truth of nine columns: one chair (56) is found as a cup, one cup as a cup."""
    gt = np.array([[1, 1, 0, 0, 10, 10, 1, 56, 1], [1, 2, 50, 0, 10, 10, 1, 41, 1]])
    result = cups([0, 0], [1, 2])
    tracked_folder(tmp_path / "out", result)
    gt_file = write(tmp_path / "gt.txt", gt)
    scores = rt.evaluate(tmp_path / "out", gt_file)["tracks"]
    assert sorted(scores) == ["all", "chair", "cup"]
    assert [scores[k]["recall"] for k in ("all", "chair", "cup")] == [0.5, 0, 1]
    assert [scores[k]["precision"] for k in ("all", "cup")] == [0.5, 0.5]
    one = rt.evaluate(tmp_path / "out", gt_file, classes=["chair"])["tracks"]
    assert list(one) == ["all"] and one["all"]["recall"] == 0
    (tmp_path / "gt_mot_format.json").write_text('{"classes": {"56": "cup", "41": "cup"}}')
    assert rt.evaluate(tmp_path / "out", gt_file)["tracks"]["all"]["recall"] == 1


def test_a_return_is_kept_if_any_earlier_visit_had_its_identity() -> None:
    """Visits of object 1: identities 5, 6, 5 (kept), 7 (lost), 6 (kept)."""
    names, starts = (5, 6, 5, 7, 6), (0, 50, 100, 150, 200)
    frames = [(s + k, n) for s, n in zip(starts, names, strict=True) for k in range(3)]
    truth = boxes(*((f, 1, 0) for f, _ in frames))
    mine = score_tracks(truth, boxes(*((f, n, 0) for f, n in frames)))
    assert mine["returns"] == 4 and mine["returns_kept"] == 0.5


def test_barely_visible_truth_and_that_of_other_classes_are_ignored(tmp_path: Path) -> None:
    """Two chairs, one of them occluded, and a cup, evaluated by a file without classes."""
    truth = (1, 0, 56, 0.9), (2, 50, 56, 0.1), (3, 90, 41, 0.9)  # id, x, class, visibility
    gt = np.array([[1, i, x, 0, 10, 10, 1, kind, seen] for i, x, kind, seen in truth])
    pr = np.array([[1, i, x, 0, 10, 10, 1, -1, -1, -1] for i, x, *_ in truth])
    files = write(tmp_path / "pr.txt", pr), write(tmp_path / "gt.txt", gt)
    chair = {"classes": ["chair"]}
    for options, count in (({}, 3), ({"min_visibility": 0.3}, 2), (chair, 2),
                           (chair | {"min_visibility": 0.3}, 1)):  # fmt: skip
        found = rt.evaluate(*files, **options)["tracks"]["all"]
        assert found["gt_objects"] == count and found["precision"] == 1


# ---- Objects in 3D ----

TURN = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()  # estimated from true world
SHIFT = np.array([1.0, 2.0, 3.0])
TRUE = {"id": 4, "center": [0.5, 0.2, 1.0], "half_axes": [0.2, 0.3, 0.4],
        "world_from_obj": Rotation.from_rotvec([0, 0, 0.7]).as_matrix().tolist()}  # fmt: skip


def half_sized(tmp_path: Path, source: str = "pycolmap") -> tuple[rt.Result, Path, Path]:
    """A result in a world of half the size, turned and shifted; true solids and true poses."""
    centers = np.random.default_rng(3).uniform(-2, 2, (12, 3))  # of the cameras, true world
    ours = 0.5 * centers @ TURN.T + SHIFT
    pose = np.concatenate([np.tile(np.eye(3), (12, 1, 1)), -ours[:, :, None]], 2)
    camera = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    frame = np.arange(12)
    poses = rt.Poses(camera, frame, frame / 10, pose, np.full(12, "pnp"), source)
    c2w = np.tile(np.eye(4), (12, 1, 1))
    c2w[:, :3, 3] = centers
    np.savetxt(tmp_path / "poses_c2w.txt", c2w.reshape(12, 16))
    (tmp_path / "gt_objects.json").write_text(json.dumps({"objects": [TRUE]}))
    xyzw = Rotation.from_matrix(TURN @ np.array(TRUE["world_from_obj"])).as_quat()
    mine = rt.Object(
        9, "chair", 1.0, "ok", "", "ellipsoid", 0.5 * TURN @ np.array(TRUE["center"]) + SHIFT,
        np.array([0.1, 0.15, 0.2]), np.roll(xyzw, 1), np.array([0.2, 0.3, 0.4]),
    )  # fmt: skip
    world = rt.World("arbitrary", source, 12, 0, 12, scale=quadrics.Scale(2.2, 0.1, "priors"))
    tracks, video = rt.Tracks.empty(), VideoInfo("a", 640, 480, 30.0)
    result = rt.Result(tracks, ("chair",), video, [mine], world, poses)
    return result, tmp_path / "gt_objects.json", tmp_path / "poses_c2w.txt"


def test_shapes_are_compared_in_the_true_world(tmp_path: Path) -> None:
    """The estimated world is scaled and rotated: all errors are 0 after alignment by cameras."""
    found = score_objects(*half_sized(tmp_path), {4: 9, 5: 7})
    assert found["o3d_found"] == pytest.approx(1, abs=5e-3)
    assert found["o3d_all"] == pytest.approx(0.5, abs=5e-3)  # the second true object has no shape
    assert found["center_error_median"] == pytest.approx(0, abs=1e-9)
    assert found["size_error_median"] == pytest.approx(0, abs=1e-9)
    assert found["scale_error"] == pytest.approx(0.1)
    assert (found["true"], found["found"]) == (2, 1)
    assert {k: found["objects"][0][k] for k in ("id", "object", "class")} == {
        "id": 4, "object": 9, "class": "chair",
    }  # fmt: skip


def test_sides_within_two_sigma_along_the_true_axes(tmp_path: Path) -> None:
    """The estimated axes have another order; the sigma is that of the log."""
    result, *files = half_sized(tmp_path)
    assert score_objects(result, *files, {4: 9})["sizes_inside"] is None  # no covariance
    (o,) = result.objects
    axes = np.roll(np.eye(3), 1, 0)  # estimated x is the true y ...
    turn = Rotation.from_quat(np.roll(o.quat_wxyz, -1)).as_matrix() @ axes
    cov = np.diag(np.repeat([1.0, 0.1, 1.0], 3) ** 2)
    half = np.roll(o.half_axes, -1) * np.exp([0.19, 0.21, 0.0])
    quat = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
    result = dataclasses.replace(
        result, objects=[dataclasses.replace(o, half_axes=half, quat_wxyz=quat, cov=cov)]
    )
    assert score_objects(result, *files, {4: 9})["sizes_inside"] == pytest.approx(2 / 3)


def test_supplied_cameras_are_in_the_true_world_already(tmp_path: Path) -> None:
    result, solids, _ = half_sized(tmp_path, "user")
    found = score_objects(result, solids, None, {4: 9})
    truth, ours = np.array(TRUE["center"]), result.objects[0].center
    assert found["center_error_median"] == pytest.approx(np.linalg.norm(truth - ours))


def straight(tmp_path: Path, turned: np.ndarray) -> float:
    """Centre error of a chair 3 m beside a straight path of .4 m, estimated centres 4 mm off.

    True poses are TUM rows; turned: (3, 3) true_cam_from_cam of their axes.
    """
    result, solids, path = half_sized(tmp_path)
    centers = np.zeros((12, 3))
    centers[:, 0] = np.linspace(-0.2, 0.2, 12)
    centers[:, 1:] = 0.01 * np.random.default_rng(1).normal(size=(12, 2))
    noise = np.random.default_rng(0).normal(0, 0.004, (12, 3))
    turn = Rotation.from_rotvec(np.linspace(0, 0.3, 12)[:, None] * [0, 1, 0]).as_matrix()
    ours = np.concatenate([TURN @ turn, (0.5 * (centers + noise) @ TURN.T + SHIFT)[..., None]], 2)
    cam_from_world = np.concatenate(
        [ours[:, :, :3].swapaxes(1, 2), -ours[:, :, :3].swapaxes(1, 2) @ ours[:, :, 3:]], 2
    )
    result = dataclasses.replace(
        result, poses=dataclasses.replace(result.poses, cam_from_world=cam_from_world)
    )
    truth = TRUE | {"center": [0.0, 0.2, 3.0]}
    solids.write_text(json.dumps({"objects": [truth]}))
    mine = 0.5 * TURN @ np.array(truth["center"]) + SHIFT
    result = dataclasses.replace(
        result, objects=[dataclasses.replace(result.objects[0], center=mine)]
    )
    xyzw = Rotation.from_matrix(turn @ turned).as_quat()
    np.savetxt(path, np.c_[np.arange(12) / 10, centers, xyzw])
    return float(score_objects(result, solids, path, {4: 9})["center_error_median"])


def test_a_turn_is_aligned_by_its_rotations(tmp_path: Path) -> None:
    poses, tracks = turn()
    result = finished(unlinked(poses, tracks))
    c2w = np.tile(np.eye(4), (len(poses.frame), 1, 1))  # true world: turned, at SPOT
    c2w[:, :3] = invert_rigid(poses.cam_from_world)
    c2w[:, :3, :3] = TURN.T @ c2w[:, :3, :3]
    c2w[:, :3, 3] = TURN.T @ SPOT
    np.savetxt(tmp_path / "poses_c2w.txt", c2w.reshape(-1, 16))
    true = [
        {"id": o.id, "center": (TURN.T @ (SPOT + o.center)).tolist(), "half_axes": [0.3] * 3,
         "world_from_obj": np.eye(3).tolist()} for o in result.objects
    ]  # fmt: skip
    (tmp_path / "gt_objects.json").write_text(json.dumps({"objects": true}))
    files = tmp_path / "gt_objects.json", tmp_path / "poses_c2w.txt"
    found = score_objects(result, *files, {o.id: o.id for o in result.objects})
    assert found["found"] == 3 and found["scale_error"] is None
    assert found["center_error_median"] == pytest.approx(0, abs=1e-5)
    with pytest.raises(rt.ReobjError, match="give --gt-poses"):
        score_objects(result, files[0], None, {1: 1})


def test_3d_needs_cameras(tmp_path: Path) -> None:
    result, solids, path = half_sized(tmp_path)
    with pytest.raises(rt.ReobjError, match="give --gt-poses"):
        score_objects(result, solids, None, {4: 9})
    result = dataclasses.replace(result, poses=None)
    with pytest.raises(rt.ReobjError, match="no cameras, so there is no evaluation"):
        score_objects(result, solids, path, {4: 9})


def test_true_solids_in_both_forms(tmp_path: Path) -> None:
    """Half axes, or extents with axes `R`; the visible part counts; a sheet is 1 cm thick."""
    R = Rotation.from_rotvec([0, 0, 0.5]).as_matrix().tolist()
    box = {"id": 1, "center": [1, 2, 3], "size": [2.0, 4.0, 0.0], "R": R, "visible_part": {
        "center": [1, 2, 4], "size": [2.0, 1.0, 0.0], "R": R}}  # fmt: skip
    (tmp_path / "o.json").write_text(json.dumps({"objects": [box, TRUE]}))
    ids, solids = read_true_objects(tmp_path / "o.json")
    assert ids == [1, 4]
    np.testing.assert_allclose(solids.center_in_world, [[1, 2, 4], TRUE["center"]])
    np.testing.assert_allclose(solids.half_axes, [[1, 0.5, 0.005], [0.2, 0.3, 0.4]])
    np.testing.assert_allclose(solids.world_from_obj, [R, TRUE["world_from_obj"]])
