"""benchmarks/real_rooms.py: scores of constructed results, and a whole run of a simulated walk."""

from __future__ import annotations

import dataclasses
import json
import pkgutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import real_rooms as rr
from simulated import CAMERA, SIZE, chair_solids, walk

import quadrics
import reobj_track as rt
from reobj.objects import association
from reobj.results.evaluation import score_tracks
from reobj.results.result import VideoInfo
from reobj.results.truth import LabelledBoxes, Role

FRAMES = 20


def boxes(*rows: tuple) -> LabelledBoxes:
    """Rows of frame, identity, left, class and maybe role: boxes of 10 x 10 px."""
    frame, identity, left, name = (
        np.array(column) for column in zip(*(r[:4] for r in rows), strict=True)
    )
    xyxy = np.stack([left, 0 * left, left + 10, 0 * left + 10], 1).astype(float)
    role = np.array([r[4] if len(r) > 4 else Role.SCORED for r in rows])
    return LabelledBoxes(frame, identity, xyxy, name.astype(str), role)


def listed(identity: int, name: str = "chair", **more) -> rt.Object:
    return rt.Object(identity, name, 0.9, more.pop("status", "rejected"), "", **more)


# ---- Identities -----


def test_identity_f1_of_hand_made_boxes() -> None:
    truth = boxes(
        *((f, 1, 0, "chair") for f in range(1, 11)), *((f, 2, 50, "cup") for f in range(1, 6))
    )
    split = ((f, 7 if f < 8 else 8, 2, "chair") for f in range(1, 11))  # 7 of 10 are right
    wrong = ((f, 9, 50, "bottle") for f in range(1, 6))  # another class
    found = boxes(*split, *wrong)
    assert rr.identity_f1(truth, found, 0.3) == pytest.approx(2 * 7 / (15 + 15))
    assert rr.identity_f1(truth, found, 0.7) == 0  # two pixels aside: IoU 2 / 3


def test_boxes_on_occluded_truth_only_are_ignored() -> None:
    seen = [(f, 1, 0, "chair") for f in range(1, 6)]
    occluded = [(f, 2, 30, "chair", Role.IGNORED) for f in range(1, 6)]
    found = [(f, 1, 0, "chair") for f in range(1, 6)]
    on_hidden = [(f, 2, 31, "chair") for f in range(1, 6)]
    of_other_class = [(f, 3, 31, "cup") for f in range(1, 6)]
    assert rr.identity_f1(boxes(*seen, *occluded), boxes(*found, *on_hidden), 0.3) == 1
    score = rr.identity_f1(boxes(*seen, *occluded), boxes(*found, *of_other_class), 0.3)
    assert score == pytest.approx(2 * 5 / (5 + 10))
    near = [(f, 2, 2, "chair", Role.IGNORED) for f in range(1, 6)]  # a visible chair is there too
    assert rr.identity_f1(boxes(*seen, *near), boxes(*found), 0.3) == 1


def test_identity_f1_is_that_of_eval() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        left = 6 * np.arange(4) + rng.integers(0, 5, (8, 4))  # (F, 4)
        given = [rng.permutation(4) if rng.random() < 0.4 else np.arange(4) for _ in left]
        moved = left + rng.integers(-3, 4, left.shape)
        each = list(np.ndindex(left.shape))
        truth = boxes(*((f + 1, k, left[f, k], "chair") for f, k in each))
        found = boxes(*((f + 1, given[f][k], moved[f, k], "chair") for f, k in each))
        idf1 = score_tracks(truth, found)["IDF1"]
        assert rr.identity_f1(truth, found, 0.5) == pytest.approx(idf1)


# ---- Lists of objects ------

KINDS = {
    1: rr.Kind(frozenset({"chair", "bench"})),
    2: rr.Kind(frozenset({"cup"}), needed=False),
    3: rr.Kind(frozenset({"book"}), ignore=True),
}


def judged(objects: list[rt.Object], *rows: tuple) -> rr.Verdicts:
    truth = [(f, i, 20 * i, "") for f in range(1, 11) for i in (1, 2, 3)]
    return rr.judge(boxes(*truth), KINDS, boxes(*rows), objects)


@pytest.mark.parametrize(
    ("name", "left", "shows", "unjudged"),
    [
        ("chair", 21, 1, False),
        ("bench", 21, 1, False),  # accepted confusion
        ("cup", 21, -1, False),  # of another class
        ("chair", 26, -1, False),  # overlaps too little: IoU .25
        ("book", 62, -1, True),  # in an area that is not annotated
        ("chair", 62, -1, False),  # in the area, but chairs are annotated
        ("chair", 0, -1, False),
    ],
)
def test_verdict_of_an_object(name: str, left: int, shows: int, unjudged: bool) -> None:
    verdicts = judged([listed(5, name)], *((f, 5, left, name) for f in range(1, 11)))
    assert (verdicts.shows[0], verdicts.unjudged[0]) == (shows, unjudged)


def test_the_majority_of_frames_outside_areas_decides() -> None:
    def mixed(on_it: int, on_area: int, name: str = "chair") -> rr.Verdicts:
        left = [21] * on_it + [62] * on_area + [0] * (10 - on_it - on_area)
        return judged([listed(5, name)], *((f, 5, x, name) for f, x in enumerate(left, 1)))

    assert mixed(5, 0).shows[0] == 1
    assert mixed(4, 0).shows[0] == -1
    truth = [(f, i, 20 * i, "") for f in range(1, 11) for i in (1, 3)]
    any_class = {1: KINDS[1], 3: rr.Kind(frozenset(), ignore=True)}
    rows = [(f, 5, 21 if f < 4 else 62 if f < 8 else 0, "chair") for f in range(1, 11)]
    verdicts = rr.judge(boxes(*truth), any_class, boxes(*rows), [listed(5)])
    assert verdicts.shows[0] == 1  # 3 of the 6 frames outside the area
    rows = [(f, 5, 21 if f < 6 else 62, "chair") for f in range(1, 11)]
    verdicts = rr.judge(boxes(*truth), any_class, boxes(*rows), [listed(5)])
    assert (verdicts.shows[0], verdicts.unjudged[0], verdicts.boxes[0]) == (1, False, 5)
    beside = [*truth, *((f, 3, 20, "") for f in range(1, 11))]  # the area lies around the chair
    verdicts = rr.judge(boxes(*beside), any_class, boxes(*rows), [listed(5)])
    assert verdicts.boxes[0] == 5


def test_the_object_with_the_most_frames_is_best() -> None:
    rows = [(f, 5 if f < 5 else 6, 21, "chair") for f in range(1, 11)] + [(1, 7, 0, "chair")]
    verdicts = judged([listed(5), listed(6), listed(7)], *rows)
    assert verdicts.best().tolist() == [False, True, False]
    assert verdicts.best(np.array([True, False, True])).tolist() == [True, False, False]


def test_score_of_a_list_without_doubtful_objects(tmp_path: Path) -> None:
    entries = [
        {"id": 1, "class": "chair", "also_ok": [], "recall": True},
        {"id": 2, "class": "cup", "also_ok": [], "recall": True},  # too few frames to be needed
        {"id": 3, "class": "tv", "also_ok": [], "recall": True},
        {"id": 4, "class": "ignore", "also_ok": [], "recall": False},
    ]
    (tmp_path / "objects_2d.json").write_text(json.dumps(entries))
    seen = [(f, i, 20 * i) for f in range(1, 13) for i in (1, 3, 4)] + [(1, 2, 40)]
    lines = [f"{f},{i},{x},0,10,10,1,{56 if i == 1 else 62},1" for f, i, x in seen]
    (tmp_path / "gt_mot.txt").write_text("\n".join(lines))
    objects = [
        listed(1, confidence=0.9), listed(2, confidence=0.6), listed(3, "tv", confidence=0.8),
        listed(4, confidence=0.7), listed(5, "tv", status="doubtful", confidence=0.3),
    ]  # fmt: skip
    # 1 and 2: both the chair; 3: a tv where none is; 4: in the area; 5: the true tv, doubtful
    seen_at = {1: (20, range(7)), 2: (20, range(7, 12)), 3: (0, range(9)), 4: (80, range(4))}
    seen_at[5] = (60, range(12))
    rows = sorted((f, i, x) for i, (x, frames) in seen_at.items() for f in frames)
    frame, identity, left = np.array(rows).T
    xyxy = np.stack([left, 0 * left, left + 10, 0 * left + 10], 1).astype(float)
    n = len(rows)
    columns = (xyxy, np.full(n, 0.9), np.zeros(n, int), np.arange(n))
    tracks = rt.Tracks(frame, identity, identity, *columns)
    result = rt.Result(tracks, rt.COCO_NAMES, VideoInfo("a", 640, 480, 30.0), objects)
    result.save(tmp_path)
    result.save(tmp_path / rr.WITH_DOUBTFUL, doubtful=True)
    score = rr.score_lists(tmp_path, tmp_path)
    counts = {k: score[k] for k in ("true", "found", "doubles", "elsewhere")}
    assert counts == {"true": 2, "found": 1, "doubles": 1, "elsewhere": 1}
    assert score["precision"] == pytest.approx(2 / 3) and score["recall"] == 0.5
    # true: 12 + 1 + 12 boxes; listed: 21, but for the 4 in the area; right: 7 of the chair
    assert score["idf1"] == pytest.approx(2 * 7 / (25 + 21))
    real = {(c, r) for c, r, _ in score["sure"]}
    assert real == {(0.9, True), (0.6, False), (0.8, False), (0.3, True)}


# ---- Solids ------


TURN = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # its inverse differs


def row_of_chairs(count: int) -> list[dict]:
    """Chairs of .5 x .9 x .6 m along the axes of the world, which are not in this order theirs."""
    size = (TURN.T @ [0.5, 0.9, 0.6]).tolist()
    return [
        {"coco": "chair", "center": [2.0 * i, 0, 0], "R": TURN.tolist(), "size": size}
        for i in range(count)
    ]


def placed(*solids: tuple[str, tuple[float, float, float]], turn: np.ndarray) -> rr.Placed:
    """Solids of .55 x .9 x .6 m along the axes of the world."""
    objects = [listed(i, name, center=np.array(at)) for i, (name, at) in enumerate(solids)]
    centers = np.array([at for _, at in solids], float).reshape(-1, 3)
    size = np.abs(turn.T @ [0.55, 0.9, 0.6])
    n = len(solids)
    return rr.Placed(objects, centers, np.tile(turn, (n, 1, 1)), np.tile(size, (n, 1)))


def test_shapes_are_found_duplicated_or_elsewhere() -> None:
    solids = placed(
        ("chair", (0.1, 0, 0)), ("chair", (0.2, 0, 0)),  # the second is a duplicate
        ("chair", (2.0, 1.0, 0)),  # too high, which is ignored
        ("chair", (3.6, 0, 0)),  # .4 m from the third
        ("cup", (4.0, 0, 0)), turn=np.eye(3),
    )  # fmt: skip
    found = rr.match_solids(row_of_chairs(3), solids)
    assert found.true.tolist() == [0, 1] and found.solid.tolist() == [0, 2]
    assert found.center_error == pytest.approx([0.1, 1.0])
    assert found.size_error == pytest.approx(np.tile(TURN.T @ [0.1, 0, 0], (2, 1)))
    assert (found.doubles, found.elsewhere) == (1, 1)


def test_matching_is_one_to_one_and_the_radius_grows_with_size() -> None:
    sofa = [
        {"coco": "couch", "center": [0, 0, 0], "R": np.eye(3).tolist(), "size": [2.1, 0.7, 0.9]}
    ]
    solids = placed(("couch", (0.6, 0, 0)), ("couch", (0.3, 0, 0)), turn=np.eye(3))
    found = rr.match_solids(sofa, solids)
    assert found.solid.tolist() == [1] and (found.doubles, found.elsewhere) == (1, 0)
    none = rr.match_solids(sofa, solids[np.zeros(2, bool)])
    assert len(none.true) == none.doubles == none.elsewhere == 0


def test_the_most_confident_shape_is_the_real_one() -> None:
    """A low-confidence part of a chair is nearer to the true centre than the listed chair."""
    solids = placed(
        ("chair", (0.05, 0, 0)), ("chair", (0.2, 0, 0)), ("chair", (2.1, 0, 0)),
        ("chair", (5.0, 0, 0)), turn=np.eye(3),
    )  # fmt: skip
    rated = (0.1, 0.9, 0.2, 0.8)
    objects = [
        dataclasses.replace(o, confidence=c) for o, c in zip(solids.objects, rated, strict=True)
    ]
    solids = dataclasses.replace(solids, objects=objects)
    chairs = [chair | {"id": k} for k, chair in enumerate(row_of_chairs(3))]
    # no boxes: objects without a shape are not scored
    one = boxes((0, 9, 0, "cup"))
    judged = rr.rated_shapes(chairs, solids, one, one, objects)
    assert [real for _, real, _ in judged] == [False, True, True, False]


# ---- Tables ------


def test_reliability_has_wilsons_interval() -> None:
    rated = [(0.85, k < 8, True) for k in range(10)] + [(0.1, False, False), (0.2, True, True)]
    bins = rr.reliability(rated)
    assert bins[4] == pytest.approx((10, 0.85, 0.8, 0.4902, 0.9433), abs=1e-4)
    assert [b[0] for b in bins] == [1, 1, 0, 0, 10]
    assert rr.reliability([(0.0, False, True), (1.0, True, True)])[4][0] == 1
    lines = rr.reliability_table({"all": rated, "bare": rated[10:11]}).splitlines()
    assert lines[0].endswith("| real: all | real: bare |")
    assert lines[2] == "| 0 to 0.2 | .100 | .000 (.000 to .793) | 0 of 1 | 0 of 1 |"
    assert lines[-1].endswith("| 8 of 10 | - |")


def test_objects_are_grouped_by_detector() -> None:
    strong, weak = (next(c for c in rr.CASES if c.boxes == b) for b in (rr.YOLO, rr.FEMTO))
    figures = [{"sure": [(0.9, True, True)]}, {"sure": [(0.3, False, False), (0.5, True, True)]}]
    groups = rr.rated_by_group([strong, weak], figures)
    sizes = {name: len(rated) for name, rated in groups.items()}
    assert sizes == {"all": 3, "other boxes": 1, "deimv2-femto": 2, "without a solid": 1}


def test_figures_of_several_noises_are_means() -> None:
    rated = [(0.9, True, True)], [(0.6, True, True), (0.7, False, True)]
    runs = [{"found": 3, "o3d": None, "sure": rated[0]}, {"found": 4, "o3d": 0.5, "sure": rated[1]}]
    same = {"idf1": 0.5, "centre_m": 0.1, "size_error": 0.2}
    mean = rr.mean_of([run | same | {"counts": {"chair": 1}} for run in runs])
    assert mean == same | {"found": 3.5, "o3d": 0.5, "runs": 2, "sure": rated[0] + rated[1]}
    line = rr.left_out_table({"": [mean], "merging": [mean]}).splitlines()[-1]
    assert "| merging | .500 | +0.000 to +0.000 | 3.5 |" in line and "| 1 of 1.5 |" in line


def test_table_has_no_empty_columns() -> None:
    rows = [(["a"], {"idf1": 0.5, "found": 1, "true": 2}), (["b"], {"found": 0, "true": 3})]
    lines = rr.figures_table(["recording"], rows).splitlines()
    assert lines[0] == "| recording | IDF1 | found |"
    assert lines[2:] == ["| a | .500 | 1 of 2 |", "| b | - | 0 of 3 |"]


def test_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    rr.draw_reliability({"all": [(0.9, True, True), (0.1, False, True)]}, tmp_path / "a.png")
    assert cv2.imread(str(tmp_path / "a.png")).std() > 5


# ---- What is left out, and runs ------


@pytest.mark.parametrize("name", rr.WITHOUT)
def test_ablated_functions_exist(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A renamed or removed function must not be measured as an ablation."""
    before = []
    for path in rr.WITHOUT[name]:
        owner, _, attribute = path.rpartition(".")
        values = rr.values_of(pkgutil.resolve_name(owner))
        before.append((values, attribute, values[attribute]))
        monkeypatch.setitem(values, attribute, values[attribute])  # put back afterwards
    rr.leave_out(name)
    assert all(values[attribute] is not old for values, attribute, old in before)


def test_an_ablation_changes_a_constant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(association, "SAME_TRACKLET", association.SAME_TRACKLET)
    rr.leave_out("tracklets")
    assert association.SAME_TRACKLET == 0.0 < association.MISSED


def test_an_ablation_of_a_missing_name_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(rr.WITHOUT, "gone", {"quadrics.GONE": 0})
    with pytest.raises(SystemExit, match="no longer there"):
        rr.measure(rr.CASES[0], Path(), Path(), "gone")


def test_names_are_checked() -> None:
    assert [c.name for c in rr.chosen(rr.CASES, ["studio"])] == ["studio-yolo", "studio-femto"]
    assert rr.every_without(["all"]) == list(rr.WITHOUT)
    with pytest.raises(SystemExit, match="--only"):
        rr.chosen(rr.CASES, ["attic"])
    with pytest.raises(SystemExit, match="attic"):
        rr.every_without(["attic"])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hololens_kitchen of three simulated chairs."""
    folder = tmp_path_factory.mktemp("data") / "hololens_kitchen"
    (folder / "images").mkdir(parents=True)
    poses, solids = walk(FRAMES), chair_solids()
    xyxy = quadrics.solid_boxes(solids, "box", CAMERA.K @ poses.cam_from_world)  # (F, 3, 4)
    for f in range(FRAMES):
        image = np.random.default_rng(f).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
        cv2.imwrite(str(folder / f"images/{f + 10:05d}.jpg"), image)
    bottom = [0, 0, 0, 1]
    world_from_cam = [np.linalg.inv(np.vstack([c, bottom])) for c in poses.cam_from_world]
    np.savetxt(folder / "poses_c2w.txt", np.reshape(world_from_cam, (FRAMES, 16)))
    fx, fy, cx, cy = CAMERA.params
    k = {"model": "PINHOLE", "w": SIZE[0], "h": SIZE[1], "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    (folder / "intrinsics.json").write_text(json.dumps(k))
    (folder / "gt_amodal_format.json").write_text(json.dumps({"classes": {"1": "chair"}}))
    rows, truth = ["frame,x1,y1,x2,y2,score,class"], []
    for f, i in np.ndindex(FRAMES, 3):
        x1, y1, x2, y2 = xyxy[f, i]
        rows.append(f"{f},{x1},{y1},{x2},{y2},0.9,chair")
        truth.append(f"{f + 1},{i + 1},{x1},{y1},{x2 - x1},{y2 - y1},1,1,1")
    (folder / "true_boxes.csv").write_text("\n".join(rows))
    (folder / "gt_amodal.txt").write_text("\n".join(truth))
    true = [
        {"id": i + 1, "coco": "chair", "center": center.tolist(), "R": turn.tolist(), "size": size}
        for i, (center, turn, size) in enumerate(
            zip(
                solids.center_in_world,
                solids.world_from_obj,
                (2 * solids.half_axes).tolist(),
                strict=True,
            )
        )
    ]
    (folder / "objects_gt.json").write_text(json.dumps({"objects": true}))
    return folder.parent


@pytest.mark.parametrize("noises", [0, 2])
def test_whole_table_of_a_simulated_walk(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], noises: int
) -> None:
    (tmp_path / "RESULTS.md").write_text("<!-- table left out -->\n<!-- end left out -->\n")
    args = [str(data), "-o", str(tmp_path), "--only", "kitchen-true", "--results", str(tmp_path)]
    shaken = ["--noises", str(noises)]
    assert rr.main([*args, "--choosing", "--without", "alternation", *shaken]) == 0
    made = json.loads((tmp_path / "left_out.json").read_text())
    whole, without = (made[k]["kitchen-true"] for k in ("", "alternation"))
    for score in (whole, without):
        assert (score["true"], score["found"], score["doubles"], score["elsewhere"]) == (3, 3, 0, 0)
        assert score["idf1"] > 0.95 and score["centre_m"] < 0.05 and score["size_error"] < 0.1
        assert score["objects_s"] > 0 and score["peak_mb"] > 50
    assert (whole["centre_m"] > 1e-4) == bool(noises)  # exact boxes, or half a pixel off
    assert all(real and solid for _, real, solid in whole["sure"])
    assert len(whole["sure"]) == 3 * max(noises, 1)
    text = (tmp_path / "left_out.md").read_text()
    assert capsys.readouterr().out.endswith(text)
    for name, score in (("nothing", whole), ("alternation", without)):
        (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
        assert rr.short(score["idf1"]) in line and "| 3 | 0 | 0 | 3 of 3 |" in line
    assert text in (tmp_path / "RESULTS.md").read_text()
    assert len(list((tmp_path / "poses-hololens_kitchen").glob("*.pose.txt"))) == FRAMES


def test_tables_of_recordings_are_as_recorded(tmp_path: Path) -> None:
    args = [str(tmp_path), "-o", str(tmp_path / "out"), "--choosing", "--noises", "2"]
    with pytest.raises(SystemExit) as stop:
        rr.main([*args, "--results", str(tmp_path)])
    assert stop.value.code == 2 and not (tmp_path / "out").exists()


def test_each_component_is_aligned_with_the_true_world(parted: rt.Result, tmp_path: Path) -> None:
    """Two components with other units and orientations, both of the same three chairs."""
    true = walk(len(parted.poses.frame), 200.0).cam_from_world
    bottom = [0, 0, 0, 1]
    poses = [np.linalg.inv(np.vstack([c, bottom])).ravel() for c in true]
    np.savetxt(tmp_path / "poses_c2w.txt", poses)
    solids, truth = rr.Placed.of(parted, tmp_path / "poses_c2w.txt"), chair_solids()
    assert len(solids.objects) == 6
    apart = np.linalg.norm(solids.center[:, None] - truth.center_in_world, axis=2)
    assert np.abs(solids.rotation[:, 2]).max(1).min() > 0.99  # one axis of each is vertical
    assert sorted(apart.argmin(1)) == [0, 0, 1, 1, 2, 2] and apart.min(1).max() < 0.05
    sizes = np.sort(solids.size, axis=1), np.sort(2 * truth.half_axes[0])
    assert np.abs(np.log(sizes[0] / sizes[1])).max() < 0.15
