"""Re-identification measures against hand-made and brute-force references; readers of scenes."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rank_k as rk
import reid_scenes as rs

import reobj_track as rt
from reobj.appearance.reid import SimilarityCalibration

ROOT = Path(__file__).resolve().parents[2]

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


def test_ties_count_half() -> None:
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


def test_the_single_protocol_draws_one_view_of_each_object() -> None:
    """The gallery of every query is drawn at random: one view of each allowed object, including its
    own; all views occur.
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
    """Every query has one similar view of its own object (cosine 1), dissimilar others (0) and an
    identical instance at .5 in every view: the whole gallery always ranks it first, one random
    view of five only if the similar one is drawn.
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


def test_single_instances_count_in_the_class_protocol_only() -> None:
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
    """A tiny scene with ScanNet's names: two chairs and a lamp that is not in the aggregation."""
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
    groups.append({"id": 2, "objectId": 2, "segments": [], "label": "wall"})
    text = json.dumps({"sceneId": "scannet.scene0000_00", "segGroups": groups})
    (folder / "scene0000_00.aggregation.json").write_text(text)
    (folder / "scene0000_00_vh_clean.aggregation.json").write_text(text)
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


def relabel(scannet: Path, boxes: dict[int, tuple[int, int, int, int]]) -> rk.Scene:
    """The scene with other label images: value -> x1, y1, x2, y2."""
    label = np.zeros((60, 80), np.uint8)
    for value, (x1, y1, x2, y2) in boxes.items():
        label[y1:y2, x1:x2] = value
    for path in (scannet / "instance-filt").glob("*.png"):
        cv2.imwrite(str(path), label)
    return rk.scannet_scene(scannet)


@pytest.mark.parametrize(
    ("box", "scored"),
    [
        ((20, 20, 40, 40), True),
        ((0, 20, 40, 40), True),  # one border
        ((20, 20, 80, 40), True),
        ((0, 0, 40, 40), False),  # two: a corner
        ((40, 30, 80, 60), False),
        ((0, 20, 80, 40), False),  # two that face each other
        ((0, 0, 80, 40), False),  # three
    ],
)
def test_two_borders_are_too_many(scannet: Path, box: tuple, scored: bool) -> None:
    assert (relabel(scannet, {1: box}).identity > 0).all() == scored


def test_walls_are_no_objects(scannet: Path) -> None:
    scene = relabel(scannet, {3: (20, 20, 40, 40), 1: (50, 20, 60, 40)})
    assert set(scene.name[scene.identity > 0]) == {"chair"} and "wall" in scene.name


def test_a_lost_pose_has_no_view_direction(scannet: Path) -> None:
    np.savetxt(scannet / "pose" / "5.txt", np.full((4, 4), -np.inf))  # as ScanNet has it
    scene = rk.scannet_scene(scannet)
    assert np.isnan(scene.sight[scene.row == 1]).all()
    assert np.isfinite(scene.sight[scene.row != 1]).all()


def test_labels_of_another_size_are_stretched(scannet: Path) -> None:
    for path in (scannet / "color").glob("*.jpg"):
        cv2.imwrite(str(path), np.full((120, 160, 3), 90, np.uint8))
    scene = rk.scannet_scene(scannet)
    assert scene.size == (160, 120) and scene.xyxy[0].tolist() == [0, 20, 60, 80]


PANORAMAS = ("5b9b2794954e4694a45fc424a8643081", "8c7e2b3d0f1a4c5e9d6b7a8f90123456")
HOUSE = "17DRP5sb8fy"


@pytest.fixture
def matterport(tmp_path: Path) -> Path:
    """A tiny house with Matterport3D's names: two panoramas, two yaws each, a chair and a wall."""
    folder = tmp_path / HOUSE
    names = ("undistorted_color_images", "undistorted_camera_parameters", "instance",
             "house_segmentations", "region_segmentations")  # fmt: skip
    for name in names:
        (folder / name).mkdir(parents=True)
    text = ["dataset matterport", "n_images 4", "depth_directory undistorted_depth_images",
            "color_directory undistorted_color_images", ""]  # fmt: skip
    text.append("intrinsics_matrix 100 0 40  0 100 20  0 0 1")  # cy from below: 60 - 20 from above
    for p, panorama in enumerate(PANORAMAS):
        for yaw in (0, 1):
            color = f"{panorama}_i1_{yaw}.jpg"
            label = np.zeros((60, 80), np.uint16)
            label[35:45, 35:45], label[:5] = 301, 1
            cv2.imwrite(str(folder / names[0] / color), np.full((60, 80, 3), 90, np.uint8))
            cv2.imwrite(str(folder / "instance" / f"{panorama}_i1_{yaw}.png"), label)
            turn, _ = cv2.Rodrigues(np.array([0, np.radians(60.0 * yaw), 0]))
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, (p, 0, 0)
            numbers = " ".join(map(str, pose.ravel()))
            text.append(f"scan {panorama}_d1_{yaw}.png {color} {numbers}")
    (folder / names[1] / f"{HOUSE}.conf").write_text("\n".join(text) + "\n")
    groups = [{"id": k, "objectId": k, "segments": [], "label": label}
              for k, label in ((0, "wall"), (300, "dining chair"))]  # fmt: skip
    path = folder / "house_segmentations" / f"{HOUSE}.semseg.json"
    path.write_text(json.dumps({"sceneId": f"mp3d.{HOUSE}", "segGroups": groups}))
    region = [{"id": 300, "objectId": 300, "segments": [], "label": "of a region only"}]
    path = folder / "region_segmentations" / "region0.semseg.json"
    path.write_text(json.dumps({"segGroups": region}))
    return folder


def test_matterport_layout(matterport: Path) -> None:
    """Its hexadecimal names, its house file, its camera axes; panoramas are "away"."""
    scene = rk.scannet_scene(matterport)
    assert scene.number.tolist() == [6, 7, 1006, 1007]
    assert scene.identity[scene.name == "dining chair"].tolist() == [301] * 4
    assert scene.name[scene.identity > 0].tolist() == ["dining chair"] * 4
    chairs = np.flatnonzero(scene.identity > 0)
    # at the optical centre: the camera looks along its -z
    np.testing.assert_allclose(scene.sight[chairs[0]], [0, 0, -1], atol=1e-9)
    pairs = rk.pairs_of([scene])
    assert pairs.angle_deg()[0, 1] == pytest.approx(60)
    assert pairs.gallery("open", 30)[0].tolist() == [False, False, True, True]


def test_objects_of_a_region_are_not_those_of_the_house(matterport: Path) -> None:
    (matterport / "house_segmentations" / f"{HOUSE}.semseg.json").unlink()
    with pytest.raises(rt.ReobjError, match=r"house_segmentations/HOUSE\.semseg\.json"):
        rk.scannet_scene(matterport)


def test_matterport_without_label_images(matterport: Path) -> None:
    (matterport / "instance" / f"{PANORAMAS[0]}_i1_0.png").unlink()
    with pytest.raises(rt.ReobjError, match="Matterport3D has no label images; render them"):
        rk.scannet_scene(matterport)
    path = matterport / "undistorted_camera_parameters" / f"{HOUSE}.conf"
    path.write_text(path.read_text() + "scan a.png b.jpg 1 2 3\n")
    with pytest.raises(rt.ReobjError, match=r"\.conf, line 11: expected"):
        rs.posed_images(matterport, [Path("b.jpg")], 60)


def test_unexported_scans_are_refused_with_instructions(tmp_path: Path) -> None:
    (tmp_path / "scene0000_00.sens").touch()
    (tmp_path / "scene0000_00.aggregation.json").write_text('{"segGroups": []}')
    with pytest.raises(rt.ReobjError, match=r"reader\.py --filename .*--export_color_images"):
        rk.scannet_scene(tmp_path)


def test_detections_get_the_identity_of_their_object(scannet: Path) -> None:
    """By category and overlap, one to one; others are known, and not scored."""
    for path in scannet.glob("*.aggregation.json"):
        path.write_text(path.read_text().replace('"chair"', '"office chair"'))
    boxes = np.array([
        [2, 10, 30, 40],  # chair 1: "office chair" is a chair
        [4, 10, 30, 40],  # duplicate: assigned to the better one
        [40, 10, 70, 40],  # chair 2, but with class table
        [42, 10, 74, 42],  # chair 2
        [40, 10, 55, 20],  # a chair that overlaps too little
    ], float)  # fmt: skip
    classes = np.array([0, 0, 1, 0, 0])
    seen: list[tuple[int, ...]] = []

    def detect(image: np.ndarray) -> rt.Detections:
        seen.append(image.shape)
        return rt.Detections(boxes, np.ones(5), classes)

    truth = rk.scannet_scene(scannet)
    scene = rs.detected_scene(truth, detect, ("chair", "dining table"))
    assert len(seen) == 3 and scene.identity.tolist() == [1, 0, 0, 2, 0] * 3
    assert scene.name.tolist() == ["chair", "chair", "dining table", "chair", "chair"] * 3
    np.testing.assert_array_equal(scene.sight[3], truth.sight[1])
    _, found, rows = scene.at(1)
    assert rows.tolist() == [0, 3] and found.masks is None and len(found) == 5


def test_views_and_instances_are_counted_by_class(scannet: Path) -> None:
    scene = rk.scannet_scene(scannet)
    lamp = dataclasses.replace(scene, name=np.where(scene.identity == 2, "lamp", scene.name))
    counts = rs.view_counts("both", [scene, lamp])
    assert counts == [
        {"set": "both", "class": "chair", "views": 9, "instances": 3},
        {"set": "both", "class": "lamp", "views": 3, "instances": 1},
    ]
    assert "| both | *all* | 12 | 4 |" in rk.markdown_counts(counts)


def test_scannet_faults(scannet: Path) -> None:
    (scannet / "instance-filt" / "5.png").unlink()
    with pytest.raises(rt.ReobjError, match=r"instance-filt/5\.png"):
        rk.scannet_scene(scannet)
    (scannet / "scene0000_00.aggregation.json").write_text("[]")
    with pytest.raises(rt.ReobjError, match="segGroups"):
        rk.scannet_scene(scannet)


def recording(folder: Path, textured: bool) -> Path:
    """Eight frames, two identical objects at fixed positions on a wall, far from the borders."""
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
def test_backgrounds_distinguish_identical_objects(textured: bool, tmp_path: Path) -> None:
    out, clip = tmp_path / "out", recording(tmp_path / "clip", textured)
    words = ["--every", "1", "--no-crops", "--choosing", "-o", str(out)]
    assert rk.main(["--recording", str(clip), *words]) == 0
    with (out / "rank_k.csv").open() as file:
        table = [r for r in csv.DictReader(file) if (r["protocol"], r["gap"]) == ("twins", "any")]
    rank1 = {r["setup"]: float(r["rank1"]) for r in table}
    assert set(rank1) == {"fg", "bg", "concat"}
    assert (rank1["bg"] == 100) == textured
    assert (rank1["concat"] == 100) == textured
    assert (out / "rank_k_clip_choosing.png").stat().st_size > 0


def test_tables_and_pictures_of_matches(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Counts, Rank-1/5/10/20, and a row of six cells for each setup of each query."""
    out, clip = tmp_path / "out", recording(tmp_path / "clip", True)
    words = ["--every", "1", "--no-crops", "--pictures", "2", "--away", "3", "--choosing"]
    assert rk.main(["--recording", str(clip), *words, "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "| clip (choosing) | chair | 16 | 2 |" in printed
    head = "| clip (choosing) | reobj, frame"
    table = next(line for line in printed.splitlines() if line.startswith(head))
    with (out / "rank_k.csv").open() as file:
        row = next(r for r in csv.DictReader(file) if (r["protocol"], r["gap"]) == ("open", "away"))
    assert table.split("|")[4:-1] == [f" {float(row[f'rank{k}']):.1f} " for k in (1, 5, 10, 20)]
    picture = cv2.imread(str(out / "matches_clip_choosing_reobj_frame.jpg"))
    assert picture.shape == (2 * 3 * (rk.CELL + rk.CAPTION), 6 * rk.CELL, 3)


def test_the_border_of_a_match_shows_whether_it_is_right(tmp_path: Path) -> None:
    """Best first; right ones of one colour, wrong ones of another, the query of a third."""
    scene = rk.recording_scene(recording(tmp_path / "clip", True))
    pairs = rk.pairs_of([scene])
    same = pairs.same()
    cosine = np.where(same, 0.5, 0.0) + np.linspace(0, 0.01, 16)[None]
    cosine[0, np.flatnonzero(~same[0])[-1]] = 1.0  # the best match of row 0 is wrong
    allowed = pairs.gallery("open", 0)
    assert rk.best_matches(cosine[0], allowed[0]).tolist() == [15, 14, 12, 10, 8]
    assert len(rk.best_matches(cosine[0], allowed[0] & (np.arange(16) > 13))) == 2
    rk.draw_matches(tmp_path / "a.jpg", [scene], pairs, {"fg": cosine}, 0, 16)
    picture = cv2.imread(str(tmp_path / "a.jpg")).astype(int)
    queries = rk.chosen_queries(same & allowed, ~same & allowed, pairs.identity, 16)
    assert sorted(queries) == list(range(16)) and len(set(pairs.identity[queries[:2]])) == 2
    line = queries.tolist().index(0) * (rk.CELL + rk.CAPTION) + rk.CELL // 2
    colors = [rk.QUERY, rk.WRONG, *[rk.RIGHT] * 4]
    for k, color in enumerate(colors):
        np.testing.assert_allclose(picture[line, k * rk.CELL + 1], color, atol=25)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--choosing", "--recording", "."], "expected identities in gt_mot.txt"),
        (["--choosing", "--recording", "nowhere"], "nowhere: no such folder"),
        (["--scannet", "nowhere"], "nowhere: no such folder"),
        (["--scannet", "."], "expected SCENE.aggregation.json"),
        (["--scannet", "scene0000_00", "--every", "0"], "--every 0: expected 1 or more"),
        (["--scannet", "scene0000_00", "--pictures", "-1"], "--pictures -1: expected 0 or more"),
        (["--scannet", "scene0000_00", "--min-side", "999"], "no view is scored"),
        (["--scannet", "scene0000_00", "--every", "6"], "no object is seen in two frames"),
        (["--scannet", "scene0000_00", "--models", "nothing"], "model nothing: no such file"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], said: str, scannet: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert rk.main([*words, "--no-crops", "-o", "out"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ") and said in last
    assert not list(tmp_path.glob("out/*"))


def test_without_a_query_there_is_no_picture(scannet, tmp_path, capsys) -> None:
    """One chair is removed: no other object is left to confuse it with."""
    (scannet / "scene0000_00.aggregation.json").write_text(
        json.dumps({"segGroups": [{"objectId": 0, "label": "chair"}]})
    )
    out = tmp_path / "out"
    words = ["--every", "1", "--away", "0", "--pictures", "1", "--no-crops", "-o", str(out)]
    assert rk.main(["--scannet", str(scannet), *words]) == 0
    assert "no matches_scannet_reobj_frame.jpg: no object" in capsys.readouterr().err
    assert (out / "rank_k.csv").exists() and not list(out.glob("*.jpg"))


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
    """Without a fit to these pairs, the constants still give about the right probability."""
    cases = normal_cases()
    rows = {r["known"]: r for r in rk.reliabilities([cases])}
    assert set(rows) == {"f", "fb", "decision"}
    assert rows["fb"]["ece"] < 0.1 and rows["fb"]["right"] > rows["f"]["right"] > 0.7
    assert rows["decision"]["log_loss"] < np.log(2)  # of guessing
