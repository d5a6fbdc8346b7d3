"""benchmarks/real_solids.py: matching, a simulated room, and a folder in ScanNet's layout."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import real_solids as rs
from simulated import CAMERA, CUP, SIZE, chair_solids, walk

import quadrics
import reobj_track as rt
from reobj.results.truth import LabelledBoxes, Role

FRAMES = 16
CHAIR = rt.COCO_NAMES.index("chair")


def solids() -> quadrics.Ellipsoids:
    """Four chairs and a cup of .1 m beside them."""
    chairs, more = chair_solids(), np.array([[0.2, 1.2, 0.41], [0.4, -0.8, 0.05]])
    half = np.array([[0.28, 0.3, 0.41], [0.05, 0.05, 0.05]])
    return quadrics.Ellipsoids(
        np.append(chairs.center_in_world, more, 0), np.append(chairs.half_axes, half, 0),
        np.append(chairs.world_from_obj, np.tile(np.eye(3), (2, 1, 1)), 0),
    )  # fmt: skip


NAMES = ["chair"] * 4 + ["cup"]


def cameras() -> rt.Poses:
    return walk(FRAMES, 150.0)


def true_boxes() -> np.ndarray:
    """Boxes (F, 5, 4) of the chairs and of the cup."""
    img_from_world = CAMERA.K @ cameras().cam_from_world
    return quadrics.solid_boxes(solids(), "box", img_from_world)


def write_images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for f, name in enumerate(names):
        image = np.random.default_rng(f).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
        cv2.imwrite(str(folder / name), image)


def world_from_cam() -> np.ndarray:
    bottom = [0, 0, 0, 1]
    return np.array([np.linalg.inv(np.vstack([c, bottom])) for c in cameras().cam_from_world])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as of redkitchen; detections also show a book that is not annotated."""
    folder = tmp_path_factory.mktemp("data") / "room"
    write_images(folder / "images", [f"{f:04d}.jpg" for f in range(FRAMES)])
    np.savetxt(folder / "poses_c2w.txt", world_from_cam().reshape(FRAMES, 16))
    fx, fy, cx, cy = CAMERA.params
    k = {"model": "PINHOLE", "w": SIZE[0], "h": SIZE[1], "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    (folder / "intrinsics.json").write_text(json.dumps(k))
    rows, truth = ["frame,x1,y1,x2,y2,score,class"], []
    xyxy = true_boxes()
    for f, i in np.ndindex(FRAMES, 5):
        x1, y1, x2, y2 = xyxy[f, i].round(3)
        rows.append(f"{f},{x1},{y1},{x2},{y2},0.9,{NAMES[i]}")
        truth.append(f"{f + 1},{i + 1},{x1},{y1},{x2 - x1},{y2 - y1},1,{(CHAIR, CUP)[i == 4]},1")
    rows.append("0,5,5,50,50,0.9,book")
    (folder / "detections_yolov8s.csv").write_text("\n".join(rows))
    (folder / "gt_mot.txt").write_text("\n".join(truth))
    s = solids()
    each = zip(s.center_in_world.tolist(), s.world_from_obj.tolist(), (2 * s.half_axes).tolist(),
               strict=True)  # fmt: skip
    objects = [{"id": i + 1, "center": c, "R": r, "size": z} for i, (c, r, z) in enumerate(each)]
    objects.append({"id": 9, "center": [0, 0, 0], "R": np.eye(3).tolist(), "size": [1, 1, 1]})
    (folder / "objects_gt.json").write_text(json.dumps({"objects": objects}))  # 9: without boxes
    return folder


def test_a_folder_is_a_recording(room: Path, tmp_path: Path) -> None:
    rec = rs.recording(room, tmp_path)
    assert rec.ids.tolist() == [1, 2, 3, 4, 5] and rec.category == NAMES
    boxes = rec.boxes()
    assert len(boxes.frame) == 5 * FRAMES and set(boxes.name) == {"chair", "cup"}  # no book
    assert set(boxes.score) == {0.9} and set(
        rs.recording(room, tmp_path, "true").boxes().score
    ) == {1}
    with pytest.raises(rt.ReobjError, match=r"expected none\.csv"):
        rs.recording(room, tmp_path, "none.csv")
    with pytest.raises(rt.ReobjError, match=r"gt_mot\.txt or gt_amodal\.txt"):
        rs.recording(tmp_path, tmp_path)


def labelled(*rows: tuple) -> LabelledBoxes:
    """Rows of frame, identity, left and class: boxes of 10 x 10 px."""
    frame, identity, left, name = (np.array(c) for c in zip(*rows, strict=True))
    xyxy = np.stack([left, 0 * left, left + 10, 0 * left + 10], 1).astype(float)
    return LabelledBoxes(frame, identity, xyxy, name.astype(str), np.full(len(rows), Role.SCORED))


@pytest.mark.parametrize(
    ("left", "name", "identity"),
    [
        ([1, 21], ["chair", "cup"], [7, 8]),
        ([1, 21], ["cup", "cup"], [0, 8]),  # of another class
        ([6, 21], ["chair", "cup"], [0, 8]),  # IoU .25
        ([1, 2], ["chair", "chair"], [7, 0]),  # one to one: the nearer one
    ],
)
def test_boxes_get_the_identity_of_their_object(left, name, identity) -> None:
    truth = labelled((1, 7, 0, "chair"), (1, 8, 20, "cup"), (3, 9, 0, "chair"))
    left = np.array(left, float)
    xyxy = np.stack([left, 0 * left, left + 10, 0 * left + 10], 1)
    boxes = rs.Boxes(np.zeros(2, np.int64), xyxy, np.ones(2), np.array(name))
    assert rs.true_identities(boxes, truth, 0.5).tolist() == identity


def halves(boxes: rs.Boxes, identity: np.ndarray) -> np.ndarray:
    """Each identity changes after six frames."""
    return np.where(boxes.frame < 6, identity, identity + 10)


@pytest.fixture(scope="module")
def compared(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`identities` with a tracker that loses all tracks once, instead of SORT."""
    work, name = tmp_path_factory.mktemp("out"), "SORT"

    def cut(peer, options, seq, venvs, embedded):
        assert (peer, options, embedded) == ("rf-sort", {}, None) and venvs == Path("peers")
        rec = rs.recording(room, work)
        boxes = rec.boxes()
        assert sum(map(len, seq.detections)) == len(boxes.frame)
        return halves(boxes, rs.true_identities(boxes, rec.truth, 0.5))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rs.cd, "peer_run", cut)
        patch.setattr(rs, "TRACKERS", {name: "rf-sort"})
        words = ["--choosing", "--peers", "peers"]
        assert rs.main(["identities", str(room), "-o", str(work), *words]) == 0
    return work


def table_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_duplicates_count_against_a_tracker_without_reid(compared: Path) -> None:
    rows = {r["by"]: r for r in table_of(compared / "identities.csv")}
    assert list(rows) == ["SORT", rs.PLAIN, rs.ONLINE, rs.CHAIN, rs.TRUTH]
    cut, truth = rows["SORT"], rows[rs.TRUTH]
    assert float(truth["idf1"]) > 0.99 > 0.8 > float(cut["idf1"])
    for r, twice in ((cut, "5"), (truth, "0")):
        assert (r["true"], r["found"], r["duplicates"]) == ("5", "5", twice)
    assert float(cut["o3d"]) == pytest.approx(float(cut["o3d_1to1"]) / 2)
    assert truth["o3d"] == truth["o3d_1to1"] and float(truth["o3d"]) > 0.8
    assert float(truth["centre_m"]) < 0.03
    text = (compared / "identities.md").read_text()
    assert "| room (choosing) | true | SORT |" in text and "| 5 of 5 | 5 |" in text


def test_pictures_before_and_after(compared: Path, room: Path, tmp_path: Path) -> None:
    assert cv2.imread(str(compared / "identities_room.png")).std() > 5
    rec = rs.recording(room, tmp_path)
    scored = rs.score(compared / "room-chain-SORT", rec)
    rs.draw_frame(rec, {"SORT": scored, "again": scored}, tmp_path / "a.jpg")
    picture = cv2.imread(str(tmp_path / "a.jpg"))
    assert picture.shape == (SIZE[1], 2 * SIZE[0], 3)
    height = slice(40, None)
    images = [cv2.imread(str(p)) for p in sorted((room / "images").iterdir())]
    last = min(
        images, key=lambda im: np.abs(picture[height, : SIZE[0]].astype(int) - im[height]).mean()
    )
    assert 2 < np.abs(picture[height, : SIZE[0]].astype(int) - last[height]).mean()  # drawn over


def test_missing_objects_count_as_0(compared: Path, room: Path, tmp_path: Path) -> None:
    """Of two chairs no identity is given: three found of five, by the same shapes as before."""
    rec = rs.recording(room, tmp_path)
    boxes = rec.boxes()
    identity = rs.true_identities(boxes, rec.truth, 0.5)
    path = boxes.write(tmp_path / "some.csv", np.where(identity > 2, identity, 0))
    folder = rs.fitted(compared / "room-chain", tmp_path / "some", path, rs.configured(rec))
    some, all_of = rs.score(folder, rec), rs.score(compared / "room-chain-true_identities", rec)
    own = some.figures()
    assert (own["found"], own["true"], own["duplicates"]) == (3, 5, 0)
    assert some.o3d[:2].tolist() == [0, 0] and np.isnan(some.error[:2]).all()
    np.testing.assert_allclose(some.o3d[2:], all_of.o3d[2:], atol=0.1)
    assert own["o3d"] == pytest.approx(some.o3d.sum() / 5)


def test_solvers_by_category(room: Path, tmp_path: Path, capsys) -> None:
    """Exact boxes of cuboids: the default solver models them, a closed-form ellipsoid does not."""
    words = ["--choosing", "--boxes", "true"]
    assert rs.main(["solvers", str(room), "-o", str(tmp_path), *words]) == 0
    rows = {r["category"]: r for r in table_of(tmp_path / "solvers.csv")}
    assert list(rows) == ["chair", "cup", "all"]
    assert [rows[c]["true"] for c in rows] == ["4", "1", "5"]
    chair = {s: float(rows["chair"][f"{s}_o3d"]) for s in rs.SOLVERS}
    assert chair["solids"] > 0.85 > 0.75 > chair["lfd"] > 0.3  # LfD: tangent to the boxes, larger
    assert float(rows["all"]["solids_o3d"]) == pytest.approx(
        (4 * chair["solids"] + float(rows["cup"]["solids_o3d"])) / 5
    )
    assert rows["all"]["solids_found"] == "5" and float(rows["all"]["solids_centre_m"]) < 0.02
    assert cv2.imread(str(tmp_path / "solvers.png")).std() > 5
    assert "| room (choosing), true boxes | chair | 4 |" in capsys.readouterr().out


# ---- ScanNet ------

SCENE = "scene0000_00"


@pytest.fixture
def scannet(tmp_path: Path) -> Path:
    """The chairs in ScanNet's layout, names as in its releases; the mesh: points on the boxes."""
    trimesh = pytest.importorskip("trimesh")
    folder = tmp_path / SCENE
    write_images(folder / "color", [f"{10 * f}.jpg" for f in range(FRAMES)])
    for name in ("pose", "intrinsic", "instance-filt"):
        (folder / name).mkdir()
    fx, fy, cx, cy = CAMERA.params
    K = np.array([[fx, 0, cx - 0.5, 0], [0, fy, cy - 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    chairs = solids()[:4]
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), -1).reshape(-1, 3)
    local = grid[(np.abs(grid) == 1).any(1)]  # on the faces
    points = [c + (local * h) @ r.T for c, h, r in zip(
        chairs.center_in_world, chairs.half_axes, chairs.world_from_obj, strict=True)]  # fmt: skip
    for f, pose in enumerate(world_from_cam()):
        np.savetxt(folder / "pose" / f"{10 * f}.txt", pose)
        cam = cameras().cam_from_world[f]
        label = np.zeros(SIZE[::-1], np.uint8)
        depth = [(c @ cam[:, :3].T + cam[:, 3])[2] for c in chairs.center_in_world]
        for k in np.argsort(depth)[::-1]:  # far ones first
            seen = (points[k] @ cam[:, :3].T + cam[:, 3]) @ CAMERA.K.T
            hull = cv2.convexHull((seen[:, :2] / seen[:, 2:] - 0.5).round().astype(np.int32))
            cv2.fillConvexPoly(label, hull, int(k) + 1)
        cv2.imwrite(str(folder / "instance-filt" / f"{10 * f}.png"), label)
    floor = np.array([[x, y, 0.0] for x in (-3, 3) for y in (-3, 3)])
    mesh = trimesh.PointCloud(np.concatenate([*points, floor]))
    mesh.export(folder / f"{SCENE}_vh_clean_2.ply")
    count = len(local)
    segments = [2 * k + (i % 2) for k in range(4) for i in range(count)] + [90] * 4
    write_json(folder / f"{SCENE}_vh_clean_2.0.010000.segs.json", {"segIndices": segments})
    groups = [{"objectId": k, "label": "office chair", "segments": [2 * k, 2 * k + 1]}
              for k in range(4)]  # fmt: skip
    groups.append({"objectId": 4, "label": "floor", "segments": [90]})
    write_json(folder / f"{SCENE}.aggregation.json", {"segGroups": groups})
    write_json(folder / f"{SCENE}_vh_clean.aggregation.json", {"segGroups": []})  # of another mesh
    return folder


def write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content))


def test_solvers_on_a_scene_of_scannet(scannet: Path, tmp_path: Path) -> None:
    rec = rs.recording(scannet, tmp_path)
    assert rec.ids.tolist() == [1, 2, 3, 4] and set(rec.category) == {"office chair"}
    found = quadrics.volume_overlap(rec.solids, solids()[:4])
    assert found.min() > 0.98  # of its mesh, whichever way the sides are named
    out = tmp_path / "out"
    assert rs.main(["solvers", str(scannet), "-o", str(out)]) == 0
    row = table_of(out / "solvers.csv")[-1]
    assert (row["recording"], row["true"], row["solids_found"]) == (SCENE, "4", "4")
    assert float(row["solids_o3d"]) > 0.6 and float(row["lfd_o3d"]) < float(row["solids_o3d"])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("_vh_clean_2.0.010000.segs.json", {"segIndices": [1, 2]}, "vertices, .* has 2"),
        ("_vh_clean_2.0.010000.segs.json", {}, "expected segIndices"),
        ("_vh_clean_2.ply", None, "expected SCENE_vh_clean_2.ply"),
        (".aggregation.json", {"segGroups": [{"label": "chair"}]}, "segGroups"),
    ],
)
def test_an_incomplete_scene(scannet: Path, tmp_path, name, content, message, capsys) -> None:
    path = scannet / f"{SCENE}{name}"
    if content is None:
        path.unlink()
    else:
        write_json(path, content)
    assert rs.main(["solvers", str(scannet), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert re.search(message, error)
