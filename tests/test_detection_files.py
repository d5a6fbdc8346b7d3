"""Recorded detections in MOT, CSV, COCO and npz files, valid and damaged."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import chair_solids, walk
from test_recorded import coco_string

import reobj_track as rt
from reobj.export.labels import BOXER_HEADER
from reobj.sources.recorded import RecordedDetections


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> rt.Video:
    """20 images of 640 x 480."""
    folder = tmp_path_factory.mktemp("v") / "im"
    folder.mkdir()
    for index in range(20):
        cv2.imwrite(str(folder / f"im{index}.png"), np.zeros((480, 640, 3), np.uint8))
    return rt.Video(folder)


def read(
    tmp_path: Path, name: str, text: str, video: rt.Video, **config: Any
) -> RecordedDetections:
    (tmp_path / name).write_text(text)
    return rt.read_detections(tmp_path / name, video, rt.DetectConfig(**config))


MOT = "1,-1,10,20,30,40,.9,-1,-1,-1\n3,-1,50,60,30,40,.5,-1,-1,-1\n1,-1,100,20,30,40,.95,-1,-1,-1\n"
CSV = "frame,x1,y1,x2,y2,score,class\n0,10,20,40,60,.9,56\n2,50,60,80,100,.5,41\n"


def test_options_apply_to_recorded_detections(tmp_path: Path, video: rt.Video) -> None:
    for min_score, kept in ((0.5, [0, 2]), (0.51, [0]), (0.91, [])):
        assert read(tmp_path, "a.csv", CSV, video, min_score=min_score).frame.tolist() == kept
    assert read(tmp_path, "a.csv", CSV, video, classes="Cup, tv").frame.tolist() == [2]
    percent = CSV.replace(".9", "90").replace(".5", "50")
    assert read(tmp_path, "a.csv", percent, video, score_max=100).score.tolist() == [0.9, 0.5]
    assert read(tmp_path, "a.txt", MOT, video, max_detections=1).at(0).score.tolist() == [0.95]
    table = CSV.replace("41", "60")
    assert read(tmp_path, "a.csv", table, video, classes="dining_table").frame.tolist() == [2]
    (tmp_path / "names.txt").write_text("Sofa\n\nlamp\n")
    options = {"class_names": str(tmp_path / "names.txt")}
    own = CSV.replace("56", "0").replace("41", "1")
    named = read(tmp_path, "a.csv", own, video, **options)
    assert named.class_names == ("Sofa", "lamp") and named.at(2).class_id.tolist() == [1]
    assert read(tmp_path, "a.csv", own, video, classes="sofa", **options).frame.tolist() == [0]


def coco_entries(**changes: Any) -> list[dict[str, Any]]:
    return [{"image_id": 4, "category_id": 62, "bbox": [10, 20, 30, 40], "score": 0.9} | changes]


def test_datasets_with_their_own_annotations(tmp_path: Path) -> None:
    """COCO-VID of a video without file names: the frame is `frame_id`, else the order."""
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25, (64, 48))
    for _ in range(9):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    video = rt.Video(tmp_path / "a.mp4")
    images = [{"id": 70 + i, "file_name": f"{i}.jpg", "frame_id": 8 - i} for i in range(9)]
    entries = coco_entries(image_id=72, category_id=5, score=0.5, track_id=3)
    data = {"images": images, "categories": [{"id": 5, "name": "wok"}], "annotations": entries}
    few = data | {"images": images[1:4]}  # nothing shows that 5 to 7 count from 0
    both = data | {
        "videos": [{"id": 1, "name": "a.mp4"}, {"id": 2, "name": "b.mp4"}],
        "images": [
            i | {"id": i["id"] + 9 * (v - 1), "video_id": v} for v in (1, 2) for i in images
        ],
        "annotations": entries + coco_entries(image_id=83, category_id=5),
    }
    for whole in (few, both, data):
        found = read(tmp_path, "vid.json", json.dumps(whole), video)
        assert found.frame.tolist() == [6] and found.identity.tolist() == [3]
        assert any("9 images of other" in m for m in found.messages) == (whole is both)
    assert found.class_names == ("wok",) and found.score.tolist() == [0.5]
    for image in images:
        del image["frame_id"]
    assert read(tmp_path, "vid.json", json.dumps(data), video).frame.tolist() == [2]


def test_coco_masks(tmp_path: Path, video: rt.Video) -> None:
    mask = np.zeros((480, 640), bool)
    mask[20:60, 10:40] = True
    runs = [10 * 480 + 20, *[40, 440] * 29, 40, 600 * 480 + 420]  # down the columns
    text = coco_string(runs)
    kinds = [
        {"size": [480, 640], "counts": runs},
        {"size": [480, 640], "counts": text},
        [[10, 20, 40, 20, 40, 60, 10, 60]],
        None,
        [],
    ]
    entries = [coco_entries(image_id=i, segmentation=kind)[0] for i, kind in enumerate(kinds)]
    found = read(tmp_path, "res.json", json.dumps(entries), video)
    for frame in (0, 1, 2):
        masks = found.at(frame).masks
        assert masks is not None and masks.shape == (1, 480, 640)
        if frame < 2:
            np.testing.assert_array_equal(masks[0], mask)
        assert (masks[0] & mask).sum() / (
            masks[0] | mask
        ).sum() > 0.94  # polygons: half a pixel around
    assert found.at(3).masks is None and found.at(4).masks is None


TRIANGLE = [(100.0, 60.0), (180.0, 60.0), (100.0, 100.0)]  # in 640x480, right angle at (100, 60)


def yolo_triangle(folder: Path) -> Path:
    (folder / "labels").mkdir()
    corners = " ".join(f"{x / 640:.9f} {y / 480:.9f}" for x, y in TRIANGLE)
    (folder / "labels/im0.txt").write_text(f"56 {corners} 0.9\n0 .5 .5 .1 .1 0.8\n")
    return folder / "labels"


def cvat_triangle(folder: Path, shape: str, size: tuple[int, int] = (640, 480)) -> Path:
    """A triangle and a box in the first frame, drawn on images of this size."""
    side = "<width>{}</width><height>{}</height>".format(*size)
    box = '<box frame="0" outside="0" xtl="32" ytl="24" xbr="64" ybr="48"/>'
    (folder / "task.xml").write_text(
        f"<annotations><meta><task><original_size>{side}</original_size></task></meta>"
        f'<track id="0" label="chair">{shape}</track><track id="1" label="person">{box}</track>'
        "</annotations>"
    )
    return folder / "task.xml"


def cvat_polygon(folder: Path) -> Path:
    points = ";".join(f"{x},{y}" for x, y in TRIANGLE)
    return cvat_triangle(folder, f'<polygon frame="0" outside="0" points="{points}"/>')


def cvat_runs(step: int) -> str:
    """Rows of the triangle, each shorter by two pixels, in images `step` times as small."""
    side = 80 // step
    rows = range(0, side, 2)
    runs = "0," + ",".join(f"{side - row},{row}" for row in rows)  # zeros first: none
    place = f'left="{100 // step}" top="{60 // step}" width="{side}" height="{side // 2}"'
    return f'<mask frame="0" outside="0" rle="{runs}" {place}/>'


@pytest.mark.parametrize(
    "make",
    [
        yolo_triangle,
        cvat_polygon,
        lambda folder: cvat_triangle(folder, cvat_runs(1)),
        lambda folder: cvat_triangle(folder, cvat_runs(2), (320, 240)),
    ],
    ids=["YOLO", "CVAT polygon", "CVAT mask", "CVAT mask at half the size"],
)
def test_outlines_of_label_tools_are_masks(
    tmp_path: Path, video: rt.Video, make: Callable[[Path], Path]
) -> None:
    found = rt.read_detections(make(tmp_path), video).at(0)
    row = int((found.xyxy[:, 2] - found.xyxy[:, 0]).argmax())  # the other is a box
    assert found.xyxy[row] == pytest.approx([100, 60, 180, 100], abs=0.01)
    y, x = np.mgrid[:480, :640] + 0.5
    true = (x > 100) & (y > 60) & (x + 2 * y < 300)
    assert found.masks is not None
    mask = found.masks[row]
    assert (mask & true).sum() / (mask | true).sum() > 0.92
    y, x = np.nonzero(mask)
    assert (x.mean() + 0.5, y.mean() + 0.5) == pytest.approx((100 + 80 / 3, 60 + 40 / 3), abs=1.2)
    assert not found.masks[1 - row].any()  # a plain box has none


LINE = "1,-1,10,20,30,40,.9\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("d.txt", LINE + "2,-1,10,20\n", "line 2: 4 columns, expected 7"),  # one line differs
        ("d.txt", LINE + "2,-1,10,2O,30,40,.9\n", "line 2: y1 '2O', expected a finite number"),
        ("d.txt", "0,10.5,20.5,40,60,.9,56\n", "line 1: id '10.5', expected a whole"),
        ("d.txt", "99,-1,10,20,30,40,.9\n",
         "frames that the video lacks .0-based: 98; it has 20.: detections of another video"),
        ("d.txt", "1,-1,.1,.2,.3,.4,.9\n", "no coordinate above 1.5: normalised"),
        ("d.txt", LINE.replace(".9", "87.5"), "detect.score_max"),
        ("d.csv", "frame,x1,y1,x2,y2,class\n0,1,2,30,40," + "b" * 131000,
         "a class name of 131000 characters, at most 200"),
        ("d.csv", "frame,x1,y1,x2,y2\n0,1,2,nan,40\n", "x2 'nan', expected"),
        ("d.txt", LINE + "1,-1,9000,20,30,40,.9\n" * 2,
         r"0 of 3 boxes have no area and 2 lie outside the image of \(640, 480\)"),
        ("d.txt", "1,-1,9000,20,30,40,.9\n", "another video"),  # all outside
        ("d.csv", CSV + "3,1,2,4,5,.9,80\n", "line 4: class 80, but there are only 80 class names"),
        ("d.csv", "frame,x1,y1,score\n0,1,2,.9\n", "line 1: no column x2, y2 in the header"),
        ("d.csv", "x1,y1,x2,y2\n1,2,3,4\n", "no column frame"),
        ("d.csv", f"{BOXER_HEADER}\n", "these are 3D boxes in the world"),
        ("d.csv", "frame,x1,y1,x2,y2\n0,100,90,30,40\n", "have x2 < x1 .*all fit it as x, y, w, h"),
        ("d.json", "{", "line 1: not valid JSON"),
        ("d.json", '{"images": []}', "a dataset without annotations"),
        ("d.json", json.dumps([{"image_id": 1, "bbox": [1, 2, 3, 4]}]),
         r"missing required field `category_id` - at `\$\[0\]`"),
        ("d.json", json.dumps(coco_entries(category_id=500)), "category_id 500 is unknown"),
        ("d.json", json.dumps(coco_entries(segmentation={"size": [48, 64], "counts": [48 * 64]})),
         r"mask of .h, w. \(48, 64\) in a video of \(480, 640\)"),
        ("d.json", json.dumps(coco_entries(segmentation={"size": [480, 640], "counts": [8, 9]})),
         r"entry 0: mask of 17 pixels in a video of \(640, 480\)"),
        ("d.json", json.dumps(coco_entries(attributes={"track_id": 1.5})), "track_id 1.5"),
        ("d.txt", LINE + "1,-1,10,20,1e8,40,.9\n", "line 2: .*beyond 1e7 pixels"),
        ("d.txt", LINE.strip() + "," + "9" * 30, r"d\.txt[:,] "),
        ("d.json", json.dumps(coco_entries(image_id="x")), "names such as 'x' match no frame"),
        ("d.json", "[1, 2]", "no known format of detections"),
        ("d.npz", "no zip", "d.npz: damaged"),
    ],
)  # fmt: skip
def test_bad_files_give_one_clear_line(
    tmp_path: Path, video: rt.Video, name: str, text: str, expected: str
) -> None:
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        read(tmp_path, name, text, video)
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"mask_offsets": [0, 1], "mask_counts": np.uint32([99])}, "row 0: mask of 99 pixels"),
        ({"class_id": [7]}, "row 0: class 7, but there are only 1 class names"),
        ({"class_id": [-1]}, "row 0: class -1"),
        ({"score": [np.nan]}, "row 0: .*NaN, infinite or beyond"),
    ],
)
def test_bad_npz(tmp_path: Path, video: rt.Video, change: dict[str, Any], expected: str) -> None:
    one = rt.Detections(np.array([[1.0, 2, 30, 40]]), np.array([0.9]), np.array([0]))
    rt.write_detections_npz(tmp_path / "a.npz", [(0, one)], ["x"], (640, 480))
    np.savez(tmp_path / "a.npz", **(dict(np.load(tmp_path / "a.npz")) | change))
    with pytest.raises(rt.ReobjError, match=rf"a\.npz, {expected}"):
        rt.read_detections(tmp_path / "a.npz", video)


@pytest.mark.parametrize(
    ("name", "text", "expected", "kept"),
    [
        ("d.txt", LINE * 3 + "1,-1,10,20,0,40,.9\n2,-1,1,2,-3,4,1\n",
         "2 boxes without area dropped, the first at line 4", 3),
        ("d.txt", LINE * 3 + "1,-1,700,20,30,40,.9\n", "1 boxes wholly outside the image", 3),
        # partly outside: kept; an edge on the border of the image has no pixel in it
        ("d.txt", LINE + "1,-1,-20,20,30,40,.9\n1,-1,630,20,30,40,.9\n", "", 3),
        ("d.txt", LINE + "1,-1,640,20,30,40,.9\n", "1 boxes wholly outside .* at line 2", 1),
        ("d.csv", CSV + "-1,10,20,30,40,.9,56\n", "1 boxes of frames .* -1; it has 20. dropped", 2),
        ("d.txt", LINE + "21,-1,10,20,30,40,.9\n50,-1,1,2,3,4,.9\n",
         "2 boxes of frames that the video lacks .0-based: 20, 49; it has 20. dropped", 1),
        ("d.txt", LINE.replace(".9", "-1") * 2, "scores are all -1: taken as 1", 2),
        ("d.txt", LINE + LINE.replace(".9", "-.2"), r"1 scores below 0, from -0.2, count as 0", 1),
        ("d.txt", "1,-1,1,2,30,40,.05\n" + LINE, "1 of 2 boxes have a score below 0.1", 1),
        ("d.txt", "1,1,1,2,30,40,.9,-1\n" + LINE[:-1] + ",3\n", "1 boxes without a class are", 2),
        ("d.txt", "1,1,1,2,30,40,1,4,0,1\n2,0,1,2,40,40,0,0,0,0\n", "1 ignored regions", 1),
        ("d.txt", "1,1,1,2,30,40,.9,1.25,-7,0\n", "x, y, z in the world", 1),
        ("d.csv", CSV + "3,,,,,,\n", "1 rows without a box left out", 2),
        ("d.csv", CSV.replace("0,10,", "1,10,").replace("2,50", "20,50"), "as counted from 1", 2),
        ("d.txt", "", "no detections in this file", 0),
        ("d.json", "[]", "no detections in this file", 0),
        ("d.json", json.dumps(coco_entries()), "the number in a name or id is that of an image", 1),
        ("d.csv", CSV.replace("56", "espresso machine").replace("41", "cup"), "", 2),
    ],
)  # fmt: skip
def test_single_bad_rows_are_counted(
    tmp_path: Path, video: rt.Video, name: str, text: str, expected: str, kept: int
) -> None:
    found = read(tmp_path, name, text, video)
    assert len(found) == kept
    hits = [message for message in found.messages if not expected or re.search(expected, message)]
    assert len(hits) == (1 if expected else 0), found.messages
    assert len(set(found.messages)) == len(found.messages)  # each said once
    assert ((found.score >= 0) & (found.score <= 1)).all()


# ---- Boxes in 3D ----


def boxer_rows(poses: rt.Poses, late_s: float = 0.0) -> str:
    """The chairs of `chair_solids` in each frame, as Boxer writes them."""
    lines = [BOXER_HEADER]
    solids = chair_solids()
    xyzw = Rotation.from_matrix(solids.world_from_obj).as_quat()
    for time_s in poses.time_s:
        for center, half, quat in zip(
            solids.center_in_world, solids.half_axes, np.roll(xyzw, 1, 1), strict=True
        ):
            numbers = ",".join(f"{v:.9g}" for v in (*center, *quat, *(2 * half)))
            lines.append(f"{round((time_s + late_s) * 1e9)},{numbers},chair,-1,0,0.8")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL"])
def test_boxes_in_3d_are_projected_through_the_lens(tmp_path: Path, model: str) -> None:
    """The images have half the camera's size."""
    parameters = {"PINHOLE": (520.0, 520, 320, 240), "SIMPLE_RADIAL": (520.0, 320, 240, -0.15)}
    camera = rt.Camera(model, 640, 480, parameters[model])
    poses = walk(5, camera=camera)
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((240, 320, 3), np.uint8))
    video = rt.Video(tmp_path)
    (tmp_path / "b.csv").write_text(boxer_rows(poses))
    found = rt.read_detections(tmp_path / "b.csv", video, poses=poses)
    assert found.frame.tolist() == np.repeat(range(5), 3).tolist()
    solids = chair_solids()
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
    corners = np.einsum("oij,pj->opi", solids.world_from_obj * solids.half_axes[:, None], signs)
    corners = corners + solids.center_in_world[:, None]  # (O, 8, 3)
    pose = poses.cam_from_world[found.frame]
    in_cam = np.einsum("nij,npj->npi", pose[:, :, :3], np.tile(corners, (5, 1, 1)))
    in_cam = in_cam + pose[:, None, :, 3]
    xy = np.asarray(camera.to_pycolmap().img_from_cam(in_cam.reshape(-1, 3))).reshape(15, 8, 2) / 2
    true = np.hstack([xy.min(1), xy.max(1)]).clip(0, [320, 240, 320, 240])
    assert np.abs(found.xyxy - true).max() < (0.01 if model == "PINHOLE" else 3)


def test_boxes_in_3d_belong_to_the_nearest_frame(tmp_path: Path) -> None:
    """Within half the usual distance of two frames, 33 ms."""
    poses = walk(5)
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((480, 640, 3), np.uint8))
    for late_s, frames in ((0.015, [0, 1, 2, 3, 4]), (0.018, [1, 2, 3, 4])):
        (tmp_path / "b.csv").write_text(boxer_rows(poses, late_s))
        found = rt.read_detections(tmp_path / "b.csv", rt.Video(tmp_path), poses=poses)
        assert np.unique(found.frame).tolist() == frames
        left_out = [f"b.csv: {3 * (5 - len(frames))} boxes at times without a frame with a pose"]
        assert [text.partition(" left out")[0] for text in found.messages] == left_out[
            : 5 - len(frames)
        ]
