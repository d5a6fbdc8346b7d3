"""From tracks and cameras to objects: linking, fitting, files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import quadrics
import reobj_track as rt

SIZE = (640, 480)
CAMERA = rt.Camera("PINHOLE", *SIZE, (520.0, 520.0, 320.0, 240.0))
NAMES = rt.COCO_NAMES
CHAIR, CUP = 56, 41


def looking_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """cam_from_world (3, 4) of a camera at `eye` in a world with z up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.c_[rotation, -rotation @ eye]


def walk(frames: int = 120, arc_deg: float = 120.0) -> rt.Poses:
    """An arc around the origin at 3.5 m, z up, metres."""
    angles = np.radians(np.linspace(-arc_deg / 2, arc_deg / 2, frames))
    eyes = np.stack([3.5 * np.sin(angles), -3.5 * np.cos(angles), np.full(frames, 1.6)], 1)
    poses = np.stack([looking_at(eye, np.array([0, 0, 0.4])) for eye in eyes])
    status = np.array(["supplied"] * frames)
    return rt.Poses(
        CAMERA,
        np.arange(frames),
        np.arange(frames) / 30,
        poses,
        status,
        "user",
        True,
        np.array([0, 0, 1.0]),
    )


def chair_solids() -> quadrics.Ellipsoids:
    """Three equal chairs in a row and nothing else."""
    centers = np.array([[-1.1, 0, 0.41], [0, 0.1, 0.41], [1.1, 0, 0.41]])
    turn = np.array(
        [
            [[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
            for a in (0.2, 1.1, -0.5)
        ]
    )
    return quadrics.Ellipsoids(centers, np.tile([0.28, 0.3, 0.41], (3, 1)), turn)


def table_of(poses: rt.Poses, seed: int = 0) -> rt.TrackTable:
    """Noisy boxes of the chairs, one tracklet a chair; rows ordered by frame."""
    boxes = quadrics.solid_boxes(
        chair_solids(), "box", poses.camera.K @ poses.cam_from_world
    )  # (F, 3, 4)
    boxes = boxes + np.random.default_rng(seed).normal(0, 1.0, boxes.shape)
    frame, obj = np.divmod(np.arange(boxes.shape[0] * 3), 3)
    n = len(frame)
    return rt.TrackTable(
        frame, obj + 1, obj + 1, boxes.reshape(-1, 4), np.full(n, 0.9), np.full(n, CHAIR), obj
    )


def linked(
    table: rt.TrackTable, poses: rt.Poses | None, look: np.ndarray | None = None
) -> rt.RunResult:
    """`make_objects`; look: (N, E) of the rows, default none."""
    seen = {} if look is None else {"look": look, "look_row": np.arange(len(table))}
    track = rt.TrackResult(table, NAMES, **seen)  # type: ignore[arg-type]
    return rt.make_objects(track, poses, rt.Config(), Path("unused"), {})


# ---- Linking ----


def test_a_chair_that_came_back_under_a_new_identity_is_joined() -> None:
    """Each chair's track is cut in two with a gap; the halves are found again, the twins stay
    apart.
    """
    poses = walk()
    table = table_of(poses)
    table = table[(table.frame < 40) | (table.frame >= 80)]
    late = table.frame >= 80
    table = rt.TrackTable(
        table.frame,
        table.object_id + 3 * late,
        table.tracklet_id + 3 * late,
        *(getattr(table, name) for name in ("xyxy", "score", "class_id", "detection_index")),
    )
    result = linked(table, poses)
    truth = table.detection_index  # the true chair
    pairs = {(t, o) for t, o in zip(truth.tolist(), result.table.object_id.tolist(), strict=True)}
    assert len(pairs) == 3 and len(result.objects) == 3
    assert {e["kind"] for e in result.world["links"]} == {"join"}


def test_a_wrong_return_is_split_by_its_place() -> None:
    """The tracker took the third chair for the first one that came back: two places."""
    poses = walk()
    table = table_of(poses)
    table = table[
        ((table.detection_index == 0) & (table.frame < 50))
        | ((table.detection_index == 2) & (table.frame > 70))
    ]
    one = np.ones(len(table), np.int64)
    table = rt.TrackTable(
        table.frame,
        one,
        table.tracklet_id,
        table.xyxy,
        table.score,
        table.class_id,
        table.detection_index,
    )
    result = linked(table, poses)
    assert len(result.objects) == 2
    assert [e["kind"] for e in result.world["links"]] == ["split"]


@pytest.mark.parametrize("slips", [[60], [40, 80], []])
def test_a_tracklet_that_slipped_is_cut_by_place(slips: list[int]) -> None:
    """The tracker goes on with another chair without missing a frame; else nothing is cut."""
    poses = walk()
    table = table_of(poses)
    chair = np.array([0, 1, 2])[np.searchsorted(slips, table.frame, "right")]
    table = table[table.detection_index == chair]
    one = np.ones(len(table), np.int64)
    result = linked(dataclasses.replace(table, object_id=one, tracklet_id=one), poses)
    assert len(result.objects) == len(slips) + 1
    truth = np.searchsorted(slips, table.frame, "right") + 1
    assert (result.table.object_id == truth).mean() > 0.9
    assert ("split" in {e["kind"] for e in result.world["links"]}) == bool(slips)


def test_objects_seen_together_are_never_joined() -> None:
    """Two tracks of one chair in the same frames (a double detection) stay two: the evidence says
    so.
    """
    poses = walk()
    table = table_of(poses)
    first = table[table.detection_index == 0]
    double = rt.TrackTable(
        *(
            np.concatenate([getattr(first, f), getattr(first, f)])
            for f in (
                "frame",
                "object_id",
                "tracklet_id",
                "xyxy",
                "score",
                "class_id",
                "detection_index",
            )
        )
    )
    half = len(first)
    ids = np.repeat([1, 2], half)
    order = np.argsort(double.frame, kind="stable")
    double = rt.TrackTable(
        double.frame, ids, ids, double.xyxy, double.score, double.class_id, double.detection_index
    )[order]
    assert len(linked(double, poses).objects) == 2


@pytest.mark.parametrize(
    ("every", "classes"),  # every n-th late box is still called a chair, the others a cup
    [(10**6, ["chair", "cup"]), (3, ["chair"])],
)
def test_only_classes_that_the_detector_confuses_are_joined(every: int, classes: list[str]) -> None:
    poses = walk()
    table = table_of(poses)
    table = table[(table.detection_index == 0) & ((table.frame < 50) | (table.frame > 70))]
    late = (table.frame > 70).astype(np.int64)
    cup = (late == 1) & (table.frame % every != 0)
    class_id = np.where(cup, CUP, CHAIR)
    table = dataclasses.replace(table, object_id=1 + late, tracklet_id=1 + late, class_id=class_id)
    assert [o["class"] for o in linked(table, poses).objects] == classes


@pytest.mark.parametrize(
    ("near", "banned", "apart", "group"),
    [
        ([(0, 1, 3.0)], [], [], [0, 0, 1]),  # alike
        ([(0, 1, 0.9)], [], [], [0, 1, 2]),  # rather another object
        ([(0, 1, 3.0)], [(0, 1)], [(0, 1)], [0, 1, 2]),  # seen together
        ([(0, 1, 3.0), (1, 2, 3.0)], [], [], [0, 0, 0]),  # through a third
        ([(0, 1, 4.0), (1, 2, 2.0)], [(0, 2)], [(0, 2)], [0, 0, 1]),  # the better one of two twins
        ([(0, 1, 3.0), (1, 2, 2.9)], [(0, 2)], [(0, 2)], [0, 1, 2]),  # twins about as near: apart
        ([(0, 1, 3.0), (1, 2, 2.9)], [(0, 2)], [], [0, 0, 1]),  # two boxes on one are no rivals
    ],
)
def test_most_alike_are_joined_first(
    near: list[tuple[int, int, float]],
    banned: list[tuple[int, int]],
    apart: list[tuple[int, int]],
    group: list[int],
) -> None:
    matrix, no = np.full((3, 3), -np.inf), np.zeros((2, 3, 3), bool)
    for i, j, ratio in near:
        matrix[i, j] = matrix[j, i] = np.log(ratio)
    for k, pairs in enumerate((banned, apart)):
        for i, j in pairs:
            no[k, i, j] = no[k, j, i] = True
    assert rt._most_alike_first(matrix, no[0], no[1], 0.5).tolist() == group


def looks_of(table: rt.TrackTable, chair: np.ndarray, twins: float) -> np.ndarray:
    """Noisy looks (N, 12) of the true chairs (N,), with this cosine between chairs 0 and 1."""
    own = np.eye(3, 12)
    own[1] = twins * own[0] + np.sqrt(1 - twins**2) * own[1]
    rows = own[chair] + np.random.default_rng(1).normal(0, 0.03, (len(table), 12))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


@pytest.mark.parametrize(
    ("tracker", "twins", "objects", "kinds"),
    [
        ([1, 2, 3, 4, 5, 6], 0.5, 3, {"join"}),  # all came back under new identities
        ([1, 2, 3, 2, 1, 3], 0.5, 3, {"join", "split"}),  # two were taken for each other
        ([1, 2, 3, 1, 2, 3], 0.5, 3, set()),  # right already
        ([1, 2, 3, 4, 5, 3], 0.999, 5, set()),  # twins that nothing tells apart stay apart
    ],
)
def test_looks_alone_decide_without_poses(
    tracker: list[int], twins: float, objects: int, kinds: set[str]
) -> None:
    """Three chairs, each seen before frame 40 and after frame 80; what the tracker made of them."""
    table = table_of(walk())
    table = table[(table.frame < 40) | (table.frame >= 80)]
    chair, visit = table.detection_index, (table.frame >= 80).astype(np.int64)
    piece = chair + 3 * visit
    ids = np.array(tracker)[piece]
    table = dataclasses.replace(table, object_id=ids, tracklet_id=piece + 1)
    result = linked(table, None, looks_of(table, chair, twins))
    assert len(result.objects) == objects
    assert {e["kind"] for e in result.world["links"]} == kinds
    assert all(e["place_iou"] is None and e["kept"] for e in result.world["links"])
    found = result.table.object_id
    assert all(len({*chair[found == o].tolist()}) == 1 for o in np.unique(found))


def test_looks_from_another_side_say_less() -> None:
    """The first and the last views of the chairs, on an arc of 120 degrees around them."""
    poses = walk()
    table = table_of(poses)
    table = table[(table.frame < 15) | (table.frame >= 105)]
    table = dataclasses.replace(table, tracklet_id=table.tracklet_id + 3 * (table.frame > 60))
    look = looks_of(table, table.detection_index, 0.3)
    track = rt.TrackResult(table, NAMES, look=look, look_row=np.arange(len(table)))
    near, posed = (rt.Linker(track, p, None, rt.ObjectsConfig()).near for p in (None, poses))
    assert (np.abs(posed)[:3, 3:] < np.abs(near)[:3, 3:]).all()
    assert (np.diag(posed[:3, 3:]) < 0.7 * np.diag(near[:3, 3:])).all()


def test_a_misnamed_piece_does_not_ban_the_return_of_its_tracklet() -> None:
    """A gap within the second tracklet of a chair, before it the detector says cup."""
    table = table_of(walk())
    table = table[(table.detection_index == 0) & ((table.frame < 40) | (table.frame >= 80))]
    late = (table.frame >= 80).astype(np.int64)
    class_id = np.where((late == 1) & (table.frame < 84), CUP, CHAIR)
    table = dataclasses.replace(table, object_id=1 + late, tracklet_id=1 + late, class_id=class_id)[
        (table.frame < 84) | (table.frame > 93)
    ]
    result = linked(table, None, looks_of(table, table.detection_index, 0.5))
    assert [o["class"] for o in result.objects] == ["chair"]


# ---- Fitting ----


def test_objects_come_out_where_they_are() -> None:
    poses = walk()
    result = linked(table_of(poses), poses)
    truth = chair_solids()
    for entry, center in zip(result.objects, truth.center_in_world, strict=True):
        assert entry["status"] == "ok"
        np.testing.assert_allclose(entry["center"], center, atol=0.03)
        np.testing.assert_allclose(sorted(entry["size"]), sorted([0.56, 0.6, 0.82]), rtol=0.08)
        assert entry["support"] == "box"
        assert entry["reprojection_iou_median"] > 0.9


def test_without_poses_objects_are_the_tracks() -> None:
    result = linked(table_of(walk()), walk())
    flat = rt.make_objects(
        rt.TrackResult(table_of(walk()), NAMES),
        None,
        rt.Config(),
        Path("x"),
        {},
    )
    assert [o["id"] for o in flat.objects] == [o["id"] for o in result.objects] == [1, 2, 3]
    assert all(o["center"] is None and o["reason"] == "no camera poses" for o in flat.objects)


def test_frames_without_pose_are_left_out() -> None:
    poses = walk()
    poses.cam_from_world[10:50] = np.nan
    result = linked(table_of(poses), poses)
    assert [o["views"] for o in result.objects] == [80, 80, 80]
    assert result.world["registered_frames"] == 80


def test_moving_classes_get_no_ellipsoid() -> None:
    poses = walk()
    table = table_of(poses)
    table = rt.TrackTable(
        table.frame,
        table.object_id,
        table.tracklet_id,
        table.xyxy,
        table.score,
        np.zeros(len(table), np.int64),
        table.detection_index,
    )
    assert {o["reason"] for o in linked(table, poses).objects} == {"objects of this class move"}


def test_too_few_views_are_rejected_with_the_reason() -> None:
    poses = walk()
    table = table_of(poses)
    result = linked(table[table.frame < 2], poses)
    assert {o["status"] for o in result.objects} == {"rejected"}
    assert "seen in 2 frames" in result.objects[0]["reason"]


def test_boxes_are_undistorted_but_border_edges_stay() -> None:
    camera = rt.Camera("SIMPLE_RADIAL", 640, 480, (520.0, 320.0, 240.0, 0.2))
    boxes = np.array([[400.0, 300, 600, 450], [0, 100, 200, 480]])
    ideal = rt._undistort_boxes(boxes, camera)
    assert (
        ideal[0, 2:] < boxes[0, 2:]
    ).all()  # positive k pushes points outwards: the ideal ones lie inwards
    assert ideal[1, 0] == 0 and ideal[1, 3] == 480


# ---- Files ----


def written(tmp_path: Path) -> rt.RunResult:
    for i in range(120):
        cv2.imwrite(str(tmp_path / f"{i:04d}.jpg"), np.full((480, 640, 3), 90, np.uint8))
    poses = walk()
    result = linked(table_of(poses), poses)
    result.out, result.poses = tmp_path / "out", poses
    (tmp_path / "out").mkdir()
    rt.write_results(result, rt.Video(tmp_path), rt.Config())
    return result


def test_written_files(tmp_path: Path) -> None:
    result = written(tmp_path)
    out = tmp_path / "out"
    assert rt.validate_objects(out / "objects.json") == []
    mot = np.loadtxt(out / "tracks.txt", delimiter=",")
    np.testing.assert_array_equal(mot[:, 0], result.table.frame + 1)
    np.testing.assert_allclose(mot[:, 2:4] + mot[:, 4:6], result.table.xyxy[:, 2:], atol=0.02)
    capture = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 120
    ok, frame = capture.read()
    assert ok and frame.shape == (480, 640, 3)
    assert frame.std() > 5  # something was drawn on the grey frames
    assert not [p for p in out.rglob("*") if p.name.startswith(".part-")]


def test_projected_ellipse_lies_in_the_box(tmp_path: Path) -> None:
    """The drawn ellipse of an inscribed ellipsoid stays within the box of the solid."""
    poses = walk()
    solids = chair_solids()
    img_from_world = poses.camera.K @ poses.cam_from_world[:1]
    dual_c, visible = quadrics.project(solids.dual_quadrics(), img_from_world)
    boxes = quadrics.solid_boxes(solids, "box", img_from_world)[0]
    for conic, box in zip(dual_c[0], boxes, strict=True):
        (x, y), (major, minor), angle = rt._ellipse_of_dual_conic(conic)  # type: ignore[misc]
        turn, phase = np.radians(angle), np.linspace(0, 2 * np.pi, 100)
        edge = np.stack([major / 2 * np.cos(phase), minor / 2 * np.sin(phase)])
        outline = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ edge + [
            [x + 0.5],
            [y + 0.5],
        ]
        assert (outline[0] >= box[0] - 0.5).all() and (outline[0] <= box[2] + 0.5).all()
        assert (outline[1] >= box[1] - 0.5).all() and (outline[1] <= box[3] + 0.5).all()
    assert visible.all()


def test_ply_is_a_closed_mesh_at_the_right_place(tmp_path: Path) -> None:
    solids = chair_solids()
    rt.write_ply(tmp_path / "o.ply", solids, [1, 2, 3], 2)
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh (dev extra)")
    mesh = trimesh.load(tmp_path / "o.ply")
    assert mesh.is_watertight and mesh.is_winding_consistent
    volume = 4 / 3 * np.pi * solids.half_axes.prod(1).sum()
    assert mesh.volume == pytest.approx(volume, rel=0.05)
    np.testing.assert_allclose(mesh.bounds[:, 2], [0, 0.82], atol=0.01)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"status": "fine"}, "status: expected one of"),  # unknown status
        ({"center": [1, 2]}, "center: expected 3 entries"),  # wrong length
        ({"id": "one"}, "id: expected int, found str"),  # wrong type
        ({"id": 2}, "id 2 occurs twice"),
        ({"half_axes": None, "center": None}, "center: missing although"),
    ],
)
def test_validate_finds_faults(tmp_path: Path, change: dict[str, object], fault: str) -> None:
    poses = walk()
    result = linked(table_of(poses), poses)
    result.objects[0] |= change
    data = {
        "format": "reobj-objects",
        "version": 1,
        "video": {},
        "world": {},
        "conventions": {},
        "objects": result.objects,
    }
    (tmp_path / "objects.json").write_text(json.dumps(data))
    faults = rt.validate_objects(tmp_path / "objects.json")
    assert any(fault in line for line in faults), faults


def test_validate_refuses_what_is_no_json(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(rt.ReobjError, match="not valid JSON"):
        rt.validate_objects(tmp_path / "x.json")


def test_quaternions_rotate_like_their_matrices() -> None:
    rotation = chair_solids().world_from_obj
    w, x, y, z = rt.quat_wxyz_from_matrix(rotation).T
    first_column = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    np.testing.assert_allclose(first_column, rotation[:, :, 0], atol=1e-12)


@pytest.mark.parametrize("text", ["door", "door=tall", "door=2furlongs", "=2m"])
def test_known_size_that_cannot_be_read(text: str) -> None:
    with pytest.raises(rt.ReobjError, match="--known-size"):
        rt.parse_known_size(text)
