"""Scores against published ones, against TrackEval, and against cases worked out by hand."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import cv2
import numpy as np
import pytest

import reobj_track as rt

ROOT = Path(rt.__file__).resolve().parent
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
    1: {
        "HOTA": 0.3811787079108761,
        "DetA": 0.5044888330442157,
        "AssA": 0.28848344082415034,
        "MOTA": 0.5310492505353319,
        "IDSW": 20.0,
        "Frag": 80.0,
        "IDF1": 0.4755700325732899,
        "IDP": 0.48237885462555063,
        "IDR": 0.4689507494646681,
    },
}
TRACKEVAL = """
import contextlib, io, json, sys
import numpy as np
from trackeval.metrics import CLEAR, HOTA, Identity

def overlap(a, b):
    a, b = (np.c_[x[:, 2:4], x[:, 2:4] + x[:, 4:6]] for x in (a, b))
    side = np.minimum(a[:, None, 2:], b[None, :, 2:]) - np.maximum(a[:, None, :2], b[None, :, :2])
    inter = side.clip(0).prod(-1)
    area = [(x[:, 2:] - x[:, :2]).prod(1) for x in (a, b)]
    return inter / np.maximum(area[0][:, None] + area[1][None] - inter, 1e-12)

gt, pr = (np.loadtxt(p, delimiter=",", ndmin=2) for p in sys.argv[1:])
gt = gt[gt[:, 6] != 0]
frames = np.union1d(gt[:, 0], pr[:, 0])
ids = [{k: i for i, k in enumerate(np.unique(x[:, 1]))} for x in (gt, pr)]
steps = [(gt[gt[:, 0] == f], pr[pr[:, 0] == f]) for f in frames]
data = {
    "num_gt_dets": len(gt), "num_tracker_dets": len(pr), "num_gt_ids": len(ids[0]),
    "num_tracker_ids": len(ids[1]), "num_timesteps": len(frames),
    "gt_ids": [np.array([ids[0][i] for i in g[:, 1]], int) for g, _ in steps],
    "tracker_ids": [np.array([ids[1][i] for i in p[:, 1]], int) for _, p in steps],
    "similarity_scores": [overlap(g, p) for g, p in steps],
}
with contextlib.redirect_stdout(io.StringIO()):
    h, c, i = (m.eval_sequence(data) for m in (HOTA(), CLEAR(), Identity()))
found = {k: float(np.mean(h[k])) for k in ("HOTA", "DetA", "AssA")}
found |= {k: float(c[k]) for k in ("MOTA", "IDSW", "Frag")}
print(json.dumps(found | {k: float(i[k]) for k in ("IDF1", "IDP", "IDR")}))
"""


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


# ---- Against others ----


@pytest.mark.parametrize("seed", STORED)
def test_equals_the_stored_numbers_of_trackeval(tmp_path: Path, seed: int) -> None:
    gt, pr = drifting(seed)
    mine = score(write(tmp_path / "gt.txt", gt), write(tmp_path / "pr.txt", pr))
    assert {k: mine[k] for k in STORED[seed]} == pytest.approx(STORED[seed], abs=1e-9)


def trackeval_python(folder: Path) -> str:
    """Interpreter with TrackEval 1.3.0, in a venv of its own (it pulls opencv-python)."""
    given = os.environ.get("REOBJ_TRACKEVAL_PYTHON")
    if given:
        return given
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    command = [python, "-m", "pip", "install", "-q", "trackeval==1.3.0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if done.returncode:
        pytest.skip(f"TrackEval cannot be installed here: {done.stderr.strip()[-200:]}")
    return str(python)


@pytest.mark.skipif(
    not (os.environ.get("REOBJ_TRACKEVAL_PYTHON") or os.environ.get("REOBJ_SLOW")),
    reason="makes a venv with TrackEval: set REOBJ_SLOW=1, or REOBJ_TRACKEVAL_PYTHON to its python",
)
def test_equals_trackeval(tmp_path: Path) -> None:
    python = trackeval_python(tmp_path / "venv")
    for seed in range(5):
        gt, pr = drifting(seed)
        files = write(tmp_path / "gt.txt", gt), write(tmp_path / "pr.txt", pr)
        command = [python, "-c", TRACKEVAL, *map(str, files)]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        theirs = json.loads(text.splitlines()[-1])
        mine = score(*files)
        assert {k: mine[k] for k in theirs} == pytest.approx(theirs, abs=1e-9)


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
        share = 1 if key in ("IDSW", "Frag") else 100
        assert round(share * mine[key], 1) == pytest.approx(value, abs=0.051), key


# ---- By hand ----


def boxes(*rows: tuple[float, ...]) -> rt.LabelledBoxes:
    """Rows frame, id, x; all boxes are 10 x 10."""
    return rt.labelled(np.array([[f, i, x, 0, 10, 10, 1] for f, i, x in rows], float))


def test_a_switch_halves_the_identity() -> None:
    truth = boxes(*((f, 1, 0) for f in range(4)))
    found = boxes((0, 5, 0), (1, 5, 0), (2, 6, 0), (3, 6, 0))
    mine = rt.score_tracks(truth, found)
    assert mine["IDSW"] == 1 and mine["MOTA"] == 0.75 and mine["IDF1"] == 0.5
    assert mine["DetA"] == 1 and mine["AssA"] == 0.5 and mine["ids_per_object"] == 2


def test_returns_keep_their_identity_or_not() -> None:
    """Object 1 is away for 40 frames twice: first recognised, then taken for a newcomer."""
    truth = boxes(*((f, 1, 0) for f in (0, 1, 42, 43, 84, 85)), (0, 2, 50))
    found = boxes(*((f, 5 if f < 84 else 6, 0) for f in (0, 1, 42, 43, 84, 85)), (0, 7, 50))
    assert rt.visits(truth).tolist() == [0, 0, 1, 1, 2, 2, 0]
    mine = rt.score_tracks(truth, found)
    assert mine["returns"] == 2 and mine["returns_kept"] == 0.5


@pytest.mark.parametrize(
    ("look", "ranks"),
    [
        ([[1, 0], [0, 1], [0.9, 0.1]], [1]),  # like its own first view
        ([[1, 0], [0, 1], [0.1, 0.9]], [2]),  # like the other object
        ([[1, 0], [np.nan, np.nan], [0.1, 0.9]], [1]),  # the other one has no look
        ([[np.nan, np.nan], [0, 1], [0.1, 0.9]], []),  # its own first view has none: no query
    ],
)
def test_rank_of_a_return(look: list[list[float]], ranks: list[int]) -> None:
    truth = boxes((0, 1, 0), (0, 2, 50), (50, 1, 90))
    assert rt.return_ranks(truth, truth, np.array(look)).tolist() == ranks


def test_eval_ranks_the_looks_that_the_folder_holds(tmp_path: Path) -> None:
    """Two cups, one comes back twice: once like itself, once like the other (Rank-1 .5)."""
    frame, obj = np.array([0, 0, 40, 80]), np.array([1, 2, 1, 1])
    xyxy = np.array([[x, 0, x + 10, 10] for x in (0, 50, 0, 0)], float)
    cup = np.full(4, 41)
    table = rt.TrackTable(frame, obj, obj, xyxy, np.ones(4), cup, np.zeros(4, np.int64))
    look = np.array([[1, 0], [0, 1], [0.9, 0.1], [0.1, 0.9]], np.float16)
    track = rt.TrackResult(table, rt.COCO_NAMES, look=look, look_row=np.arange(4))
    track.save(tmp_path / "cache" / "last-tracks.npz")
    rt.write_mot(tmp_path / "tracks.txt", table)
    true = np.c_[frame + 1, obj, xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2], np.ones(4)]
    gt = write(tmp_path / "gt.txt", true)
    ranks = rt.evaluate(tmp_path, gt)["ranks"]
    assert ranks == {"queries": 2, "rank1": 0.5, "rank5": 1.0, "rank20": 1.0, "rank50": 1.0}


def test_nothing_found_and_nothing_true() -> None:
    some, none = boxes((0, 1, 0), (1, 1, 0)), rt.labelled(np.empty((0, 7)))
    assert rt.score_tracks(some, none)["HOTA"] == 0
    assert rt.score_tracks(none, some)["precision"] == 0
    assert rt.score_tracks(none, none)["IDF1"] == 0
    assert rt.score_tracks(some, some)["HOTA"] == 1


def test_classes_never_match_each_other() -> None:
    rows = np.array([[1, 1, 0, 0, 10, 10, 1]], float)
    chair, cup, any_class = (rt.labelled(rows, n) for n in ("chair", "cup", ""))
    assert rt.score_tracks(chair, cup)["recall"] == 0
    assert rt.score_tracks(chair, any_class)["recall"] == 1


def test_mot17_distractors_swallow_what_they_match(tmp_path: Path) -> None:
    """Class 8 is a distractor, class 3 (car) is not: a box on the car is false."""
    (tmp_path / "seqinfo.ini").touch()
    (tmp_path / "gt").mkdir()
    person, distractor, car = (1, 0, 1, 1), (2, 50, 0, 8), (3, 90, 0, 3)  # id, x, flag, class
    gt = [[1, i, x, 0, 10, 10, f, c, 1] for i, x, f, c in (person, distractor, car)]
    pr = [[1, i, x, 0, 10, 10, 1, -1, -1, -1] for i, x in ((1, 0), (2, 50), (3, 90))]
    truth = write(tmp_path / "gt" / "gt.txt", np.array(gt))
    files = truth, write(tmp_path / "pr.txt", np.array(pr))
    mine = score(*files)
    assert mine["gt_objects"] == 1 and mine["identities"] == 2 and mine["precision"] == 0.5


def test_barely_visible_truth_is_ignored(tmp_path: Path) -> None:
    gt = np.array([[1, 1, 0, 0, 10, 10, 1, 56, 0.9], [1, 2, 50, 0, 10, 10, 1, 56, 0.1]])
    pr = np.array([[1, i, x, 0, 10, 10, 1, -1, -1, -1] for i, x in ((1, 0), (2, 50))])
    files = write(tmp_path / "pr.txt", pr), write(tmp_path / "gt.txt", gt)
    assert rt.evaluate(*files)["tracks"]["all"]["gt_objects"] == 2
    strict = rt.evaluate(*files, min_visibility=0.3)["tracks"]["all"]
    assert strict["gt_objects"] == 1 and strict["precision"] == 1


def test_unknown_class_is_refused(tmp_path: Path) -> None:
    gt, pr = drifting(0)
    files = write(tmp_path / "pr.txt", pr), write(tmp_path / "gt.txt", gt)
    with pytest.raises(rt.ReobjError, match="chiar"):
        rt.evaluate(*files, classes=["chiar"])


def test_command_line_prints_a_table_and_refuses_other_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gt, pr = drifting(0)
    files = write(tmp_path / "pr.txt", pr), write(tmp_path / "gt.txt", gt)
    assert rt.main(["eval", str(files[0]), "--gt", str(files[1])]) == 0
    text = capsys.readouterr().out
    assert "IDF1" in text and "Rank-k: no embeddings here" in text
    (tmp_path / "bad.txt").write_text("not a table\n")
    assert rt.main(["eval", str(files[0]), "--gt", str(tmp_path / "bad.txt")]) == 2
    assert "no MOTChallenge file" in capsys.readouterr().err


def test_failure_gallery_names_the_error_and_its_cause(tmp_path: Path) -> None:
    """One object, away for 5 frames, comes back at the border under a second identity."""
    frames = [*range(10), *range(15, 19)]
    (tmp_path / "images").mkdir()
    for i in range(20):
        cv2.imwrite(str(tmp_path / "images" / f"{i:04d}.png"), np.full((48, 64, 3), 90, np.uint8))
    x = np.where(np.array(frames) < 15, 20.0, 0.0)
    gt = [[f + 1, 1, a, 9, 20, 30, 1] for f, a in zip(frames, x, strict=True)]
    det = [[f + 1, -1, a, 9, 20, 30, 0.9] for f, a in zip(frames, x, strict=True)]
    gt_file, out = write(tmp_path / "gt.txt", np.array(gt)), tmp_path / "out"
    images, boxes_file = str(tmp_path / "images"), str(write(tmp_path / "det.txt", np.array(det)))
    assert rt.main(["track", images, "--detections", boxes_file, "-o", str(out)]) == 0
    text = (out / "tracks.txt").read_text().splitlines()
    text[10:] = [",".join([line.split(",")[0], "2", *line.split(",")[2:]]) for line in text[10:]]
    (out / "tracks.txt").write_text("\n".join(text))
    command = [sys.executable, ROOT / "examples" / "failure_gallery.py", out, "--gt", gt_file]
    command += ["-o", tmp_path / "gallery.png"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True)
    error = "object 1: a second identity (id 2, right 1), 4 frames from 16"
    assert f"| {error} | out of view for 5 frames; cut by the border |" in done.stdout
    picture = cv2.imread(str(tmp_path / "gallery.png"))
    assert picture is not None and picture.shape[1] == 900


# ---- Objects in 3D ----


def test_solids_are_compared_in_the_true_world(tmp_path: Path) -> None:
    """Our world is half as large and turned: after the alignment by cameras nothing is wrong."""
    rng = np.random.default_rng(3)
    centers = rng.uniform(-2, 2, (12, 3))  # of the cameras, true world
    turn = rt.Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    ours = 0.5 * centers @ turn.T + [1, 2, 3]
    pose = np.concatenate([np.tile(np.eye(3), (12, 1, 1)), -ours[:, :, None]], 2)
    camera = rt.Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    frame = np.arange(12)
    poses = rt.Poses(camera, frame, frame / 10, pose, np.full(12, "pnp"), "pycolmap")
    c2w = np.tile(np.eye(4), (12, 1, 1))
    c2w[:, :3, 3] = centers
    np.savetxt(tmp_path / "poses_c2w.txt", c2w.reshape(12, 16))
    (tmp_path / "cache").mkdir()
    rt.save_poses(tmp_path / "cache" / "last-poses.npz", poses)
    table = rt.TrackTable(*(np.empty(0, np.int64) for _ in range(3)), np.empty((0, 4)),
                          np.empty(0), np.empty(0, np.int64), np.empty(0, np.int64))  # fmt: skip
    rt.TrackResult(table, ("chair",)).save(tmp_path / "cache/last-tracks.npz")
    true = {"id": 4, "center": [0.5, 0.2, 1.0], "half_axes": [0.2, 0.3, 0.4],
            "world_from_obj": np.eye(3).tolist()}  # fmt: skip
    (tmp_path / "gt_objects.json").write_text(json.dumps({"objects": [true]}))
    quat = rt.quat_wxyz_from_matrix(turn[None])[0].tolist()
    center = (0.5 * turn @ np.array(true["center"]) + [1, 2, 3]).tolist()
    mine = {"id": 9, "class": "chair", "status": "ok", "center": center, "quat_wxyz": quat,
            "half_axes": [0.1, 0.15, 0.2]}  # fmt: skip
    world = {"scale": {"metres_per_unit": 2.2}}
    (tmp_path / "objects.json").write_text(json.dumps({"objects": [mine], "world": world}))
    files = tmp_path, tmp_path / "gt_objects.json", tmp_path / "poses_c2w.txt"
    found = rt.score_objects(*files, {4: 9, 5: 7})
    assert found["o3d_found"] == pytest.approx(1, abs=5e-3)
    assert found["o3d_all"] == pytest.approx(0.5, abs=5e-3)  # the second true object has no solid
    assert found["center_error_median"] == pytest.approx(0, abs=1e-9)
    assert found["scale_error"] == pytest.approx(0.1)
