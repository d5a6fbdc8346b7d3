"""Re-identification measures against hand-made and brute-force references; readers of scenes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rank_k as rk

import reobj_track as rt
from reobj.identity.reid import SimilarityCalibration

ROOT = Path(__file__).resolve().parent.parent

RNG = np.random.default_rng(0)


def brute_rank(cosine: np.ndarray, right: np.ndarray, allowed: np.ndarray) -> tuple[float, float]:
    """Rank of the first right one and average precision by sorting, of one query."""
    order = [j for j in np.argsort(-cosine) if allowed[j]]
    hits = [i + 1 for i, j in enumerate(order) if right[j]]
    return hits[0], float(np.mean([(k + 1) / h for k, h in enumerate(hits)]))


def test_rank_and_map_equal_brute_force() -> None:
    identity = RNG.integers(0, 6, 40)
    cosine = RNG.random((40, 40))
    same, allowed = identity[:, None] == identity, RNG.random((40, 40)) < 0.7
    rank, precision = rk.rank_queries(cosine, same, allowed)
    for i in np.flatnonzero(np.isfinite(rank)):
        assert (rank[i], precision[i]) == pytest.approx(brute_rank(cosine[i], same[i], allowed[i]))
    lonely = ~(same & allowed).any(1) | ~(~same & allowed).any(1)
    assert (np.isnan(rank) == lonely).all()


def test_ties_are_shared_not_won() -> None:
    """A constant similarity must not look perfect."""
    identity = np.repeat([0, 1], 5)
    same = identity[:, None] == identity
    rank, _ = rk.rank_queries(np.ones((10, 10)), same, ~np.eye(10, dtype=bool))
    assert (rank == 1 + 0.5 * 5).all()
    assert rk.hit(np.array([1, 1.5, 2, 3.5]), 1).tolist() == [1, 0.5, 0, 0]
    assert rk.hit(np.array([5, 6.0]), 5).tolist() == [1, 0]


def pairs(**changes: object) -> rk.Pairs:
    """Two scenes, two classes: rows (scene, frame, class, model, identity)."""
    rows = np.array([
        [0, 0, 0, 0, 0], [0, 10, 0, 0, 0], [0, 50, 0, 0, 0], [0, 0, 0, 0, 1], [0, 50, 0, 1, 2],
        [0, 50, 1, 2, 3], [1, 0, 0, 0, 4], [1, 50, 0, 0, 4],
    ])  # fmt: skip
    return rk.Pairs(*rows.T, np.tile([0.0, 0.0, 1.0], (len(rows), 1)))


@pytest.mark.parametrize(
    ("protocol", "away", "gallery_of_first"),
    [
        ("open", 0, [1, 2, 4, 5, 6, 7]),  # other frames of the scene, all of other scenes
        ("class", 0, [1, 2, 4]),
        ("twins", 0, [1, 2, 4]),
        ("twins", 30, [2, 4]),
        ("same", 0, [1, 2]),  # row 4 is another model of the class
    ],
)
def test_galleries(protocol: str, away: int, gallery_of_first: list[int]) -> None:
    assert np.flatnonzero(pairs().gallery(protocol, away)[0]).tolist() == gallery_of_first


def single(identity: np.ndarray, frame: np.ndarray) -> rk.Pairs:
    """One scene, one class."""
    zero = np.zeros(len(identity), np.int64)
    return rk.Pairs(zero, frame, zero, zero, identity, np.tile([0.0, 0, 1], (len(zero), 1)))


def test_the_single_protocol_has_one_view_of_each_object() -> None:
    """The gallery of every query is drawn: one view of each object that it may be compared with, of
    its own object too, and every view has its turn.
    """
    own = single(np.repeat([0, 1, 2], 6), np.tile(10 * np.arange(6), 3))
    allowed, drawn = own.gallery("twins", 0), np.zeros((18, 18))
    for seed in range(40):
        chosen = rk.one_view(own, allowed, np.random.default_rng(seed))
        assert not (chosen & ~allowed).any()
        per_object = np.add.reduceat(chosen, [0, 6, 12], 1)
        np.testing.assert_array_equal(per_object, np.ones((18, 3)))
        drawn += chosen
    assert (drawn[allowed] > 0).all()


def test_single_view_ranks_are_lower_than_those_of_the_whole_gallery() -> None:
    """Every query has one view of its own object that is alike (1), others that are not (0) and a
    twin half alike in every view (.5): the whole gallery finds it always, one random view of five
    only where that is drawn.
    """
    views = 6
    own = single(np.repeat([0, 1], views), np.tile(10 * np.arange(views), 2))
    same, position = own.same(), np.tile(np.arange(views), 2)
    following = (position[:, None] + 1) % views == position[None]
    cosine = np.where(same, np.where(following, 1.0, 0.0), 0.5)
    whole, precision = rk.rank_pairs(cosine, own, "twins", 0)
    assert (whole == 1).all() and (precision < 1).all()
    ranks, _ = rk.rank_pairs(cosine, own, "single", 0)
    assert len(ranks) == 10 * len(same) and set(ranks) == {1.0, 2.0}
    assert (ranks == 1).mean() == pytest.approx(1 / (views - 1), abs=0.1)
    row = rk.summary(*rk.rank_pairs(cosine, own, "single", 0), own)
    assert row["queries"] == len(same) and row["rank1"] == pytest.approx(20, abs=10)


def test_one_instance_of_a_class_counts_only_in_the_class_protocol() -> None:
    one = rk.Pairs(*np.array([[0, 0, 0, 0, 0], [0, 50, 0, 0, 0]]).T, np.zeros((2, 3)))
    allowed = one.gallery("class", 0)
    assert np.isnan(rk.rank_queries(np.ones((2, 2)), one.same(), allowed)[0]).all()
    assert (rk.rank_queries(np.ones((2, 2)), one.same(), allowed, need_other=False)[0] == 1).all()


def test_bins_hold_only_their_frames() -> None:
    """Perfect where the gap is short, always wrong where it is long."""
    frame, identity = np.tile([0, 10, 100], 2), np.repeat([0, 1], 3)
    zero = np.zeros(6, np.int64)
    own = rk.Pairs(zero, frame, zero, zero, identity, np.tile([0.0, 0.0, 1.0], (6, 1)))
    gap = np.abs(frame[:, None] - frame[None]).astype(float)
    cosine = np.where((identity[:, None] == identity) == (gap < 30), 1.0, 0.0)
    near, far = rk.by_bin(cosine, own, gap, (0, 30, 1000))
    assert (near["rank1"], far["rank1"]) == (100, 0)
    assert (near["queries"], far["queries"]) == (4, 6)


def test_interval_holds_the_mean_and_shrinks_with_identities() -> None:
    width = {}
    for count in (5, 200):
        identity = np.repeat(np.arange(count), 4)
        rank = np.where(RNG.random(len(identity)) < 0.7, 1.0, 2.0)
        own = SimpleNamespace(identity=identity)
        row = rk.summary(rank, rank, own)
        assert row["low"] <= row["rank1"] <= row["high"]
        width[count] = row["high"] - row["low"]
    assert width[200] < width[5]


@pytest.fixture
def scannet(tmp_path: Path) -> Path:
    """A tiny scene in ScanNet's layout: two chairs and a lamp that is not in the aggregation."""
    folder = tmp_path / "scene0000_00"
    for name in ("color", "instance-filt", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    K = np.array([[100, 0, 40, 0], [0, 100, 25, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    for f in (0, 5, 10):
        label = np.zeros((60, 80), np.uint8)
        label[10:40, 0:30], label[10:40, 40:70], label[50:55, 5:9] = 1, 2, 9
        cv2.imwrite(str(folder / "color" / f"{f}.jpg"), np.full((60, 80, 3), 90, np.uint8))
        cv2.imwrite(str(folder / "instance-filt" / f"{f}.png"), label)
        turn, _ = cv2.Rodrigues(np.array([0, np.radians(6.0 * f), 0]))
        pose = np.eye(4)
        pose[:3, :3] = turn
        np.savetxt(folder / "pose" / f"{f}.txt", pose)
    groups = [{"id": k, "objectId": k, "segments": [], "label": "chair"} for k in (0, 1)]
    (folder / "scene0000_00.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    return folder


def test_scannet_layout(scannet: Path) -> None:
    scene = rk.scannet_scene(scannet)
    assert scene.number.tolist() == [0, 5, 10]  # natural order, not "0, 10, 5"
    assert np.bincount(scene.identity).tolist() == [3, 3, 3]  # the lamp is known, not scored
    image, found, rows = scene.at(1)
    assert image.shape == (60, 80, 3) and found.xyxy[0].tolist() == [0, 10, 30, 40]
    assert rows.tolist() == [0, 1] and int(found.masks[0].sum()) == 900
    angle = rk.pairs_of([scene]).angle_deg()
    assert angle[0, 2] == pytest.approx(30, abs=1e-6)  # the camera turned by 30 degrees


@pytest.mark.parametrize(
    ("options", "scored"),
    [
        ({"min_mask": 901}, 0),
        ({"min_side": 31}, 0),
        ({"views": 2}, 4),
        ({"every": 2}, 4),
        ({"min_mask": 900, "min_side": 30}, 6),  # one border is allowed
    ],
)
def test_scannet_options(scannet: Path, options: dict, scored: int) -> None:
    assert int((rk.scannet_scene(scannet, **options).identity > 0).sum()) == scored


def test_scannet_faults(scannet: Path) -> None:
    (scannet / "instance-filt" / "5.png").unlink()
    with pytest.raises(rt.ReobjError, match=r"instance-filt/5\.png"):
        rk.scannet_scene(scannet)
    next(scannet.glob("*.aggregation.json")).write_text("[]")
    with pytest.raises(rt.ReobjError, match="segGroups"):
        rk.scannet_scene(scannet)


def recording(folder: Path, textured: bool) -> Path:
    """Eight frames, two equal objects in fixed places on a wall, far from the borders."""
    (folder / "images").mkdir(parents=True)
    grid = RNG.integers(0, 255, (12, 16, 3), np.uint8)
    wall = cv2.resize(grid, (640, 480)) if textured else np.full((480, 640, 3), 90, np.uint8)
    lines = []
    for f in range(8):
        image, colour = wall.copy(), RNG.integers(0, 255, 3).tolist()
        for k, x in ((1, 200), (2, 400)):
            cv2.rectangle(image, (x, 220), (x + 30, 260), colour, -1)
            lines.append(f"{f + 1},{k},{x + 1},221,30,40,1,56,1.0")
        cv2.imwrite(str(folder / "images" / f"{f:04d}.png"), image)
    (folder / "gt_mot.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("textured", [True, False])
def test_twins_are_told_apart_by_the_background(textured: bool, tmp_path: Path) -> None:
    out, clip = tmp_path / "out", recording(tmp_path / "clip", textured)
    assert rk.main(["--recording", str(clip), "--every", "1", "--no-crops", "-o", str(out)]) == 0
    with (out / "rank_k.csv").open() as file:
        table = [r for r in csv.DictReader(file) if (r["protocol"], r["gap"]) == ("twins", "any")]
    rank1 = {r["setup"]: float(r["rank1"]) for r in table}
    assert set(rank1) == {"fg", "bg", "concat"}
    assert (rank1["bg"] == 100) == textured
    assert (rank1["concat"] == 100) == textured
    assert (out / "rank_k_clip.png").stat().st_size > 0


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rk.main(["--recording", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def normal_cases(n: int = 2400, objects: int = 3) -> rk.Cases:
    """Newcomers against some objects of which at most one is right; both parts are normal."""
    close = {True: (2.0, 1.9), False: (1.2, 1.4)}

    def cosine(same: rk.BoolArray) -> rk.Array:
        mean = np.where(same[:, None], close[True], close[False])
        return np.asarray(1.03 - np.exp(-np.minimum(RNG.normal(mean, 0.4), 3.4)))

    query = np.repeat(np.arange(n // objects), objects)
    right = RNG.integers(0, objects + 1, n // objects)  # `objects`: a new one
    same = np.tile(np.arange(objects), n // objects) == right[query]
    shown = (cosine(np.zeros(500, bool)), cosine(np.ones(500, bool)))
    angle, yes = np.full(len(same), np.nan), np.ones(len(same), bool)
    return rk.Cases(cosine(same), angle, 40 + 0 * angle, same, query, yes, shown)


def test_calibration_finds_the_true_odds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the constants fitted to them, normal pairs and decisions come out calibrated."""
    cases = normal_cases()
    weights, odds = rk.calibrate([cases])
    monkeypatch.setattr(SimilarityCalibration, "WEIGHTS", tuple(weights))
    p = cases.decider().probability(*cases.cosine.T)
    bins = rk.reliability(p, cases.same, cases.balance(False))
    assert rk.expected_error(bins) < 0.03
    said, right = cases.decisions(odds)
    bins = rk.reliability(said, right, np.ones(len(said)))
    assert rk.expected_error(bins) < 0.05 and right.mean() > 0.5
    always_sure = rk.reliability(np.where(p > 0.5, 0.999, 0.001), cases.same, cases.balance(False))
    assert rk.expected_error(always_sure) > 0.05


def test_constants_are_those_of_normal_pairs() -> None:
    """Not fitted to them, the constants still say about the right probability."""
    cases = normal_cases()
    rows = {r["known"]: r for r in rk.reliabilities([cases])}
    assert set(rows) == {"f", "fb", "decision"}
    assert rows["fb"]["ece"] < 0.1 and rows["fb"]["right"] > rows["f"]["right"] > 0.7
    assert rows["decision"]["log_loss"] < np.log(2)  # of guessing
