"""Detections and tracks of other tools, imported through the command line.

The ground truth, a chair that moves through a small video, is written in every format and variant;
the resulting tracks are compared with it. Invalid input is refused in one line with the cause.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt

SIZE, FRAMES = (320, 240), 8
CHAIR = 56  # of COCO's 80, from 0
QUICK = ("--embed", "none", "--set", "output.overlay=none", "--set", "output.scene=false")


def box(frame: int) -> tuple[int, int, int, int]:
    """Corners of the chair in a frame."""
    return 10 + 4 * frame, 20, 50 + 4 * frame, 60


def write_clip(path: Path, frames: int = FRAMES) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, SIZE)
    for _ in range(frames):
        writer.write(np.zeros((*SIZE[::-1], 3), np.uint8))
    writer.release()
    return path


def images(folder: Path, names: Sequence[str]) -> Path:
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((*SIZE[::-1], 3), np.uint8))
    return folder


@dataclasses.dataclass
class Tracked:
    """Output and messages of a run."""

    code: int
    frames: list[int]  # from 0
    boxes: list[tuple[float, ...]]
    classes: list[str]
    said: str


@pytest.fixture
def tracked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Tracked]:
    def run(source: Path, *arguments: Any) -> Tracked:
        caplog.clear()
        caplog.set_level(logging.WARNING)
        out = tmp_path / "out"
        code = rt.main(["track", str(source), "-o", str(out), *map(str, arguments), *QUICK])
        said = caplog.text + capsys.readouterr().err
        if code:
            assert not (out / "tracks.txt").exists()
            return Tracked(code, [], [], [], said)
        rows = np.loadtxt(out / "tracks.txt", delimiter=",", ndmin=2).reshape(-1, 10)
        classes = json.loads((out / "objects.json").read_text())["objects"]
        corners = np.hstack([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]])
        return Tracked(
            code, (rows[:, 0] - 1).astype(int).tolist(), [tuple(b) for b in corners.tolist()],
            sorted(entry["class"] for entry in classes), said,
        )  # fmt: skip

    return run


def is_truth(made: Tracked, name: str = "chair", frames: Sequence[int] = range(FRAMES)) -> bool:
    """Whether the tracks are exactly the true boxes of the chair in these frames."""
    same = np.allclose(made.boxes, [box(f) for f in made.frames], atol=0.05)
    return made.frames == list(frames) and same and made.classes == [name]


# ---- The ground truth in every format -----------------------------------------------------------


def lines(row: Callable[[int, tuple[int, int, int, int]], str], header: str = "") -> str:
    return header + "".join(row(f, box(f)) + "\n" for f in range(FRAMES))


def mot(separator: str = ",", tail: str = "1,57", first: int = 1, identity: int = 1) -> str:
    def row(f: int, b: tuple[int, int, int, int]) -> str:
        cells = [f + first, identity, b[0], b[1], b[2] - b[0], b[3] - b[1], *tail.split(",")]
        return separator.join(map(str, cells))

    return lines(row)


def csv(header: str, cells: str) -> str:
    """CSV with cells such as "{f},{x1}"."""
    return lines(
        lambda f, b: cells.format(
            f=f, n=f + 1, x1=b[0], y1=b[1], x2=b[2], y2=b[3], w=b[2] - b[0], h=b[3] - b[1],
            cx=(b[0] + b[2]) / 2, cy=(b[1] + b[3]) / 2,
        ),
        header + "\n",
    )  # fmt: skip


def kitti(score: str = "") -> str:
    row = "{f} 1 chair 0 0 -1.5 {x1}.00 {y1}.00 {x2}.00 {y2}.00 1 1 1 1 1 5 0.1" + score
    ignored = "3 -1 DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10" + score
    return csv("", row).lstrip() + ignored + "\n"


def coco_box(frame: int) -> list[int]:
    x, y, x2, y2 = box(frame)
    return [x, y, x2 - x, y2 - y]


def sink() -> str:
    """What supervision's JSONSink writes: numbers as text too, empty where there is none."""
    keys = ("x_min", "y_min", "x_max", "y_max")
    rows = [
        dict(zip(keys, box(f), strict=True))
        | {"class_id": 0, "confidence": ".9", "tracker_id": "", "class_name": "chair",
           "frame_index": f} for f in range(FRAMES)
    ]  # fmt: skip
    return json.dumps(rows)


CSV_ROW = "{f},{x1},{y1},{x2},{y2},.9,chair"
TABLES = {
    "mot": mot(),
    "mot with spaces": mot(" "),
    "mot with tabs": mot("\t"),
    "mot with semicolons": mot(";"),
    "mot with decimal commas": mot(";", "0,9").replace("0;9", "0,9").replace(";20;", ";20,0;"),
    "mot with spaces and decimal commas": csv("", "{n} 1 {x1},0 {y1},0 {w},0 {h},0 0,9").lstrip(),
    "mot with floats as numpy writes them": mot(tail="9.0e-01,57.0"),
    "mot with CRLF and a byte order mark": "\ufeff" + mot().replace("\n", "\r\n"),
    "mot from 0": mot(first=0),
    "mot in columns": mot("   ").replace("1 ", " 1 "),
    "mot after a remark": "# made by some tool, 1 line\n" + mot(),
    "mot with a comma at the end": mot().replace("\n", ",\n"),
    "a header of words": csv("# frame x1 y1 x2 y2 score class", "{f} {x1} {y1} {x2} {y2} .9 chair"),
    "boxmot: 1, class from 0, score": mot(tail=f"1,{CHAIR},0.873000"),
    "boxmot's detections, no identity": mot(tail=f"1,{CHAIR},.87", identity=-1),
    "csv": csv("frame,x1,y1,x2,y2,score,class", CSV_ROW),
    "csv in capitals, with units": csv(
        "Frame number, X1 [px], Y1 [px], X2 [px], Y2 [px], Score, Class", CSV_ROW),
    "csv of a spreadsheet": csv("frame;x1;y1;x2;y2;score;class",
                                "{f};{x1},0;{y1},0;{x2},0;{y2},0;0,9;chair"),
    "Boxer's 2D boxes": csv(
        "time_ns,frame_id,sensor,device,img_width,img_height,x1,y1,x2,y2,name,instance,sem_id,prob",
        "-1,{f},rgb,iPad,320,240,{x1},{y1},{x2},{y2},chair,-1,56,0.9"),
    "Roboflow's inference: centres": csv("frame,x,y,width,height,confidence,class,detection_id",
                                         "{f},{cx},{cy},{w},{h},.9,chair,a{f}"),
    "pandas' index": csv(",frame,x1,y1,x2,y2,score,class", "{n}," + CSV_ROW),
    "pandas' floats": csv("frame,x1,y1,x2,y2,score,class", "{f}.0,{x1}.0,{y1},{x2},{y2},.9,56.0"),
    "supervision's sink": csv(
        "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,class_name,frame_index",
        "{x1},{y1},{x2},{y2},0,.9,,chair,{f}"),
    "xmin, prob, label": csv("frame_id,xmin,ymin,xmax,ymax,prob,label", CSV_ROW),
    "left to bottom": csv("frame_number,left,top,right,bottom,conf,category", CSV_ROW),
    "numbers from 1": csv("frame,x1,y1,x2,y2,score,class", CSV_ROW.replace("{f}", "{n}")),
    "mot's own header": csv("frame,id,bb_left,bb_top,bb_width,bb_height,conf,class,x,y,z",
                            "{n},1,{x1},{y1},{w},{h},.9,chair,-1,-1,-1"),
    "centres": csv("frame,cx,cy,w,h,score,class", "{f},{cx},{cy},{w},{h},.9,chair"),
    "image sizes beside corners": csv("filename,width,height,class,xmin,ymin,xmax,ymax",
                                      "f_{f}.jpg,320,240,chair,{x1},{y1},{x2},{y2}"),
    "frames without boxes": csv("frame,x1,y1,x2,y2,score,class", CSV_ROW) + "3,,,,,,\n",
    "kitti": kitti(),
    "kitti with scores": kitti(" 0.9"),
}  # fmt: skip


@pytest.mark.parametrize("what", TABLES)
def test_tables(tmp_path: Path, tracked: Callable[..., Tracked], what: str) -> None:
    path = tmp_path / ("det.csv" if what.startswith("csv") else "det.txt")
    path.write_text(TABLES[what], newline="")
    (tmp_path / "coco.txt").write_text("\n".join(rt.COCO_NAMES))
    names = ("--set", f"detect.class_names={tmp_path / 'coco.txt'}")
    named = (
        what[:3] in ("mot", "box") and "commas" not in what and "own" not in what
    ) or "floats" in what
    more = ("--detections-format", "boxmot") if what.startswith("boxmot: 1") else ()
    more += names if named else ()
    made = tracked(write_clip(tmp_path / "v.avi"), "--detections", path, *more)
    assert is_truth(made, "object" if "commas" in what else "chair"), made


JSONS: dict[str, Callable[[], Any]] = {
    "ultralytics' predictions, names": lambda: [
        {"image_id": f"frame_{f:05d}", "file_name": f"frame_{f:05d}.png", "category_id": 62,
         "bbox": coco_box(f), "score": 0.9} for f in range(FRAMES)],
    "corners of detectron2": lambda: [
        {"image_id": f, "category_id": 62, "bbox": box(f), "bbox_mode": 0,
         "file_name": f"frame_{f:05d}.png"} for f in range(FRAMES)],
    "string ids alone": lambda: [
        {"image_id": f"frame_{f:05d}", "category_id": 62, "bbox": coco_box(f), "score": 0.9}
        for f in range(FRAMES)],
    "numbers in the names": lambda: [
        {"image_id": f, "category_id": 62, "bbox": coco_box(f), "score": 0.9}
        for f in range(FRAMES)],
    "dataset with folders of Windows": lambda: {
        "images": [{"id": 90 + f, "file_name": f"im\\frame_{f:05d}.png", "width": 320,
                    "height": 240} for f in range(FRAMES)],
        "categories": [{"id": 3, "name": "chair"}],
        "annotations": [{"image_id": 90 + f, "category_id": 3, "bbox": coco_box(f)}
                        for f in range(FRAMES)]},
    "dataset of images of twice the size": lambda: {
        "images": [{"id": f, "file_name": f"frame_{f:05d}.png", "width": 640, "height": 480}
                   for f in range(FRAMES)],
        "categories": [{"id": 3, "name": "chair"}],
        "annotations": [{"image_id": f, "category_id": 3, "bbox": [2 * v for v in coco_box(f)]}
                        for f in range(FRAMES)]},
    "supervision's sink": lambda: json.loads(sink()),
    "oa-slam": lambda: [
        {"file_name": f"rgb/frame_{f:05d}.png", "detections": [
            {"category_id": CHAIR, "detection_score": 0.9, "bbox": list(box(f))}]}
        for f in range(FRAMES)],
}  # fmt: skip


@pytest.mark.parametrize("what", JSONS)
@pytest.mark.parametrize("begin", [0, 1])
def test_json(tmp_path: Path, tracked: Callable[..., Tracked], what: str, begin: int) -> None:
    """Of images whose names count from 0 or from 1; ids are those of the names."""
    data = json.dumps(JSONS[what]())
    if begin:  # every name, and the ids that are numbers of names, one later
        for f in reversed(range(FRAMES)):
            data = data.replace(f"frame_{f:05d}", f"frame_{f + 1:05d}")
        if what == "numbers in the names":
            entries = json.loads(data)
            data = json.dumps([entry | {"image_id": entry["image_id"] + 1} for entry in entries])
    (tmp_path / "pred").mkdir()
    (tmp_path / "pred" / "predictions.json").write_text(data)
    names = [f"frame_{f + begin:05d}.png" for f in range(FRAMES)]
    source = images(tmp_path / "images", names)
    made = tracked(source, "--detections", tmp_path / "pred" / "predictions.json")
    assert is_truth(made), made
    assert ("scaled" in made.said) == ("size" in what)


def test_ids_from_0_of_images_whose_names_count_from_1(
    tmp_path: Path, tracked: Callable[..., Tracked]
) -> None:
    """There is no image 0: the ids are positions."""
    (tmp_path / "res.json").write_text(json.dumps(JSONS["numbers in the names"]()))
    source = images(tmp_path / "images", [f"frame_{f + 1:05d}.png" for f in range(FRAMES)])
    assert is_truth(tracked(source, "--detections", tmp_path / "res.json"))


def test_frame_numbers_in_the_image_names_of_cvat(
    tmp_path: Path, tracked: Callable[..., Tracked]
) -> None:
    """CVAT's names of a video's frames: the number is the frame; of every 3rd, from 0 or from 1."""
    source = write_clip(tmp_path / "v.avi", 16)
    for begin in (0, 1):
        data = {
            "images": [{"id": i, "file_name": f"frame_{begin + 3 * i:06d}.PNG"} for i in range(5)],
            "categories": [{"id": 1, "name": "chair"}],
            "annotations": [{"image_id": i, "category_id": 1, "bbox": coco_box(3 * i),
                             "attributes": {"track_id": 0}} for i in range(5)],
        }  # fmt: skip
        (tmp_path / "instances.json").write_text(json.dumps(data))
        for option in ("--detections", "--tracks"):
            command = (source, option, tmp_path / "instances.json", "--overwrite")
            if begin:  # without a 0 the names leave it open
                with pytest.raises(rt.ReobjError, match=r"detect\.first_frame"):
                    rt.read_detections(tmp_path / "instances.json", rt.Video(source))
                command += ("--set", "detect.first_frame=1")
            made = tracked(*command)
            assert is_truth(made, frames=range(0, 15, 3)), (option, begin, made)


# ---- YOLO labels ---------------------------------------------------------------------------------


def yolo(frame: int, kind: int = CHAIR, tail: str = "") -> str:
    x, y, x2, y2 = box(frame)
    shares = ((x + x2) / 640, (y + y2) / 480, (x2 - x) / 320, (y2 - y) / 240)
    return f"{kind} " + " ".join(f"{v:.6f}" for v in shares) + f"{tail}\n"


def polygon(frame: int, tail: str = "") -> str:
    x, y, x2, y2 = box(frame)
    corners = ((x, y), (x2, y), (x2, y2), ((x + x2) / 2, y2), (x, y2))
    return "0 " + " ".join(f"{a / 320:.6f} {b / 240:.6f}" for a, b in corners) + f"{tail}\n"


def yolo_folder(folder: Path, row: Callable[[int], str], name: str, begin: int) -> Path:
    folder.mkdir(parents=True)
    for f in range(FRAMES):
        (folder / name.format(f + begin)).write_text(row(f))
    return folder


NAMES = {
    "notes.json": '{"categories": [{"id": 1, "name": "lamp"}, {"id": 0, "name": "chair"}]}',
    "classes.txt": "1: lamp\n0: chair\n",
    "data.yaml": "path: ../room\ntrain: images\nnames: [chair, 'desk lamp'] # two\nnc: 2\n",
    "dataset.yaml": "nc: 2\nnames:\n  0: chair\n  1: lamp\nkpt: 3\n",
    "my.yml": "names:\n- chair\n- \"lamp\"\n",
    "obj.names": "0, chair\n1, lamp\n",
    "room.names": "chair\nlamp\n",
    "_darknet.labels": "chair\nlamp\n",
    "labels.txt": "chair\nlamp\n",
}  # fmt: skip


@pytest.mark.parametrize("names", NAMES)
def test_yolo_dataset_with_its_names(
    tmp_path: Path, tracked: Callable[..., Tracked], names: str
) -> None:
    """Images and labels of the same names, as datasets have them."""
    stem = "room-{:03d}"
    source = images(tmp_path / "set/images/val", [stem.format(f) + ".jpg" for f in range(FRAMES)])
    yolo_folder(tmp_path / "set/labels/val", lambda f: yolo(f, 0), stem + ".txt", 0)
    (tmp_path / "set" / names).write_text(NAMES[names])
    (tmp_path / "set/train.txt").write_text("images/val/room-000.jpg\n")
    folder = "set" if names != "my.yml" else "set/labels/val"
    made = tracked(source, "--detections", tmp_path / folder)
    assert is_truth(made), made
    assert f"{FRAMES} files" in made.said and names in made.said


@pytest.mark.parametrize(
    ("row", "option"),
    [
        (lambda f: yolo(f, 0, " 0.9"), "--detections"),
        (lambda f: yolo(f, 0, " 0.9 1"), "--tracks"),
        (lambda f: yolo(f, 0, " 7"), "--tracks"),  # no save_conf
        (lambda f: polygon(f, " 0.9"), "--detections"),
        (lambda f: polygon(f, " 0.9 12"), "--tracks"),
        (lambda f: polygon(f, " 12"), "--tracks"),
    ],
)
def test_yolo_labels_of_a_video(
    tmp_path: Path, tracked: Callable[..., Tracked], row: Callable[[int], str], option: str
) -> None:
    """Ultralytics' NAME_N.txt counts from 1."""
    labels = yolo_folder(tmp_path / "predict/labels", row, "v_{}.txt", 1)
    (labels.parent / "classes.txt").write_text("chair\nlamp\n")
    made = tracked(write_clip(tmp_path / "v.avi"), option, labels)
    assert is_truth(made), made


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("56 100 80 40 40\n", "is no fraction of the image size"),
        ("56 .5 .5 .2\n", "expected class cx cy w h"),
        ("chair .5 .5 .2 .2\n", "all numbers"),
        ("56 .5 .5 .2 nan\n", "expected class cx cy w h"),
        ("99 .5 .5 .2 .2\n", "class 99, but there are only 80 class names"),
    ],
)
def test_invalid_label_files_are_refused(
    tmp_path: Path, tracked: Callable[..., Tracked], text: str, expected: str
) -> None:
    labels = yolo_folder(tmp_path / "labels", lambda f: text, "v_{}.txt", 1)
    made = tracked(write_clip(tmp_path / "v.avi"), "--detections", labels)
    assert made.code == 2 and expected in made.said and "v_1.txt" in made.said
    (tmp_path / "empty").mkdir()
    made = tracked(tmp_path / "v.avi", "--detections", tmp_path / "empty")
    assert made.code == 2 and "without label files" in made.said


# ---- Times and classes --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "per_s"),
    [("timestamp", 1), ("time_ns", 1e9), ("Timestamp [ms]", 1e3), ("timestamp", 1e9)],
)  # fmt: skip
def test_times_in_every_unit(
    tmp_path: Path, tracked: Callable[..., Tracked], name: str, per_s: float
) -> None:
    """Of images named by times since 1970: in the unit of the column, else in s."""
    start = 1341847980
    source = images(tmp_path / "im", [f"{start + f / 25:.6f}.png" for f in range(FRAMES)])
    row = "{f},{x1},{y1},{x2},{y2},.9,chair"
    text = csv(f"{name},x1,y1,x2,y2,score,class", row).splitlines(keepends=True)
    times = [
        f"{round((start + f / 25) * per_s, 6 if per_s == 1 else 0):.6f}" for f in range(FRAMES)
    ]
    rows = [t + line[line.index(",") :] for t, line in zip(times, text[1:], strict=True)]
    (tmp_path / "det.csv").write_text(text[0] + "".join(rows))
    made = tracked(source, "--detections", tmp_path / "det.csv")
    if (name, per_s) == ("timestamp", 1e9):
        assert made.code == 2 and "another video" in made.said
        return
    assert is_truth(made), made


@pytest.mark.parametrize(("count", "names"), [(57, {"chair", "object"}), (58, {"couch", "person"})])
def test_a_class_0_counts_from_0_where_that_fits_the_names(
    tmp_path: Path, count: int, names: set[str]
) -> None:
    """57 names and a class 57: they count from 1, and 0 is no class."""
    (tmp_path / "names.txt").write_text("\n".join(rt.COCO_NAMES[:count]))
    (tmp_path / "det.txt").write_text(mot(tail=".9,57") + "2,1,200,100,40,40,.9,0\n")
    config = rt.DetectConfig(class_names=str(tmp_path / "names.txt"))
    video = rt.Video(write_clip(tmp_path / "v.avi"))
    found = rt.read_detections(tmp_path / "det.txt", video, config)
    assert {found.class_names[c] for c in found.class_id} == names
    assert len(found) == 9 and "class numbers" in found.messages[0]


def test_boxes_of_frames_before_rotation(tmp_path: Path, tracked: Callable[..., Tracked]) -> None:
    """Boxes of 320 x 240 on an upright video of 240 x 320, in a table and in COCO."""
    folder = tmp_path / "upright"
    folder.mkdir()
    for f in range(FRAMES):
        cv2.imwrite(str(folder / f"{f}.png"), np.zeros((320, 240, 3), np.uint8))
    rows = [f"{f + 1},-1,{x},50,60,80,.9\n" for f in range(FRAMES) for x in (20, 120, 260)]
    (tmp_path / "det.txt").write_text("".join(rows))
    made = tracked(folder, "--detections", tmp_path / "det.txt")
    assert made.code == 2 and "turned by 90 deg" in made.said
    (tmp_path / "det.txt").write_text("1,-1,200,50,60,80,.9\n1,-1,20,250,60,69,.9\n")
    assert tracked(folder, "--detections", tmp_path / "det.txt").code == 0  # over the edge only


# ---- COCO: types, datasets beside it -------------------------------------------------------------


def dataset(**changes: Any) -> dict[str, Any]:
    names = [f"{f}.png" for f in range(FRAMES)]
    return {
        "images": [{"id": f, "file_name": name} for f, name in enumerate(names)],
        "categories": [{"id": 1, "name": "chair"}],
        "annotations": [{"image_id": f, "category_id": 1, "bbox": coco_box(f), "track_id": 4}
                        for f in range(FRAMES)],
    } | changes  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"images": 5}, "`$.images`"),
        ({"images": [{"id": 0, "file_name": 7}]}, "`$.images[0].file_name`"),
        ({"categories": [{"id": 1, "name": "c" * 300}]}, "a class name of 300 characters"),
        ({"annotations": [{"image_id": 0, "category_id": 1, "bbox": "1234"}]}, "[0].bbox`"),
    ],
)  # fmt: skip
def test_coco_of_wrong_types(
    tmp_path: Path, changes: dict[str, Any], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a run without images, which reads names and sizes first."""
    path = tmp_path / "d.json"
    path.write_text(json.dumps(dataset(**changes)))
    (tmp_path / "poses.txt").write_text("".join(f"{i} 0 0 {i} 0 0 0 1\n" for i in range(4)))
    camera = ("--camera", "PINHOLE 320 240 300 300 160 120")
    code = rt.main(["run", "-o", str(tmp_path / "out2"), "--tracks", str(path), "--poses",
                    str(tmp_path / "poses.txt"), *camera])  # fmt: skip
    said = capsys.readouterr().err
    assert code == 2 and expected in said and "d.json" in said


def test_two_datasets_beside_a_result_file(tmp_path: Path, tracked: Callable[..., Tracked]) -> None:
    """The dataset with the ids of the results is used; two that have them are refused."""
    source = images(tmp_path / "im", [f"{f}.png" for f in range(FRAMES)])
    rows = [{"image_id": f, "category_id": 1, "bbox": coco_box(f), "score": 0.9}
            for f in range(FRAMES)]  # fmt: skip
    (tmp_path / "res").mkdir()
    (tmp_path / "res/results.json").write_text(json.dumps(rows))
    (tmp_path / "res/instances.json").write_text(json.dumps(dataset()))
    command = (source, "--detections", tmp_path / "res/results.json", "--overwrite")
    for changes in ({"images": [{"id": 70, "file_name": "0.png"}]},
                    {"categories": [{"id": 9, "name": "sofa"}]}):  # fmt: skip
        (tmp_path / "res/zzz.json").write_text(json.dumps(dataset(**changes)))
        assert is_truth(tracked(*command))
    (tmp_path / "res/zzz.json").write_text(json.dumps(dataset()))
    with pytest.raises(rt.ReobjError, match=r"instances\.json and zzz\.json beside it all"):
        rt.read_detections(tmp_path / "res/results.json", rt.Video(source))


# ---- CVAT and identities -------------------------------------------------------------------------


def cvat(shape: Callable[[int], str], meta: str = "") -> str:
    shapes = "".join(shape(f) for f in range(FRAMES))
    tracks = f'<track id="0" label="chair">{shapes}</track>'
    return f"<annotations>{meta}{tracks}</annotations>"


def cvat_box(f: int, extra: str = "") -> str:
    x, y, x2, y2 = box(f)
    return f'<box frame="{f}" outside="0" xtl="{x}" ytl="{y}" xbr="{x2}" ybr="{y2}" {extra}/>'


def cvat_points(tag: str) -> Callable[[int], str]:
    def shape(f: int) -> str:
        x, y, x2, y2 = box(f)
        return f'<{tag} frame="{f}" outside="0" points="{x},{y + 9};{x + 9},{y};{x2},{y2}"/>'

    return shape


def cvat_mask(f: int) -> str:
    """The triangle below the diagonal of the box, run lengths along its rows."""
    x, y, *_ = box(f)
    rle = ",".join(f"{39 - row},{1 + row}" for row in range(40))
    sides = f'left="{x:g}" top="{y:g}" width="40" height="40"'
    return f'<mask frame="{f}" outside="0" rle="{rle}" {sides}/>'


def cvat_ellipse(f: int) -> str:
    return f'<ellipse frame="{f}" outside="0" cx="{30 + 4 * f}" cy="40" rx="20" ry="20"/>'


def cvat_turned(f: int) -> str:
    """A square of side 40 / sqrt(2) that is turned by 45 deg."""
    x, y, half = 30 + 4 * f, 40, 20 / np.sqrt(2)
    return (f'<box frame="{f}" outside="0" xtl="{x - half}" ytl="{y - half}" xbr="{x + half}" '
            f'ybr="{y + half}" rotation="45.00"/>')  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        (cvat_box, ""),
        (cvat_points("polygon"), ""),
        (cvat_mask, ""),
        (cvat_points("polyline"), "8 polylines taken as"),
        (cvat_points("points"), "8 points taken as"),
        (cvat_ellipse, "8 ellipses taken as"),
        (cvat_turned, "8 turned boxes taken as"),
    ],
)
def test_shapes_of_cvat(
    tmp_path: Path, tracked: Callable[..., Tracked], shape: Callable[[int], str], said: str
) -> None:
    with zipfile.ZipFile(tmp_path / "task.zip", "w") as packed:
        packed.writestr("annotations.xml", cvat(shape))
    made = tracked(write_clip(tmp_path / "v.avi"), "--tracks", tmp_path / "task.zip")
    assert is_truth(made) and said in made.said and ("taken as" in made.said) == bool(said)


def test_cvat_of_images_and_of_another_size(
    tmp_path: Path, tracked: Callable[..., Tracked]
) -> None:
    label = 'label="chair"'
    shapes = "".join(
        f'<image id="{f}" name="frame_{f:06d}">{cvat_box(f, label)}</image>' for f in range(FRAMES)
    )
    (tmp_path / "images.xml").write_text(f"<annotations>{shapes}</annotations>")
    source = write_clip(tmp_path / "v.avi")
    assert is_truth(tracked(source, "--detections", tmp_path / "images.xml"))
    size = "<original_size><width>240</width><height>320</height></original_size>"
    (tmp_path / "t.xml").write_text(cvat(cvat_box, f"<meta><task>{size}</task></meta>"))
    with pytest.raises(rt.ReobjError, match="made for images of 240x320, but the video is 320x240"):
        rt.read_tracks(tmp_path / "t.xml", rt.Video(source))


@pytest.mark.parametrize(
    "text",
    [
        kitti(),
        csv("x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,class_name,frame_index",
            "{x1},{y1},{x2},{y2},0,.9,1,chair,{f}"),
        csv("frame,track_id,left,top,right,bottom,label", "{f},0,{x1},{y1},{x2},{y2},chair"),
        csv("frame,trackid,x1,y1,x2,y2,label", "{f},4,{x1},{y1},{x2},{y2},chair")
        + "2,-1,200,100,240,130,lamp\n",
    ],
)  # fmt: skip
def test_identities_of_tables(tmp_path: Path, tracked: Callable[..., Tracked], text: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    made = tracked(write_clip(tmp_path / "v.avi"), "--tracks", tmp_path / "t.txt")
    assert is_truth(made), made
    assert ("1 is added" in made.said) == (",0,10,20," in text)
    assert ("1 of 9 boxes without an identity left out" in made.said) == ("lamp" in text)


def test_classes_of_identities_come_from_overlapping_detections(tmp_path: Path) -> None:
    """Identities without classes: by overlap over all frames; no class without overlap."""
    source = write_clip(tmp_path / "v.avi")
    (tmp_path / "det.csv").write_text(TABLES["csv"])
    out = tmp_path / "out"
    assert rt.main(["track", str(source), "-o", str(out), "--detections",
                    str(tmp_path / "det.csv"), *QUICK]) == 0  # fmt: skip
    far = "".join(f"{f + 1},2,200,150,60,50\n" for f in range(FRAMES))
    off = mot().replace(",57", "").splitlines()
    off[3] = "4,1,60,20,40,40,1"  # one box was drawn beside the old one
    (tmp_path / "ids.txt").write_text(
        "\n".join(f"{row}".rsplit(",", 1)[0] for row in off) + "\n" + far
    )
    assert rt.main(["objects", str(out), "--tracks", str(tmp_path / "ids.txt")]) == 0
    objects = json.loads((out / "objects.json").read_text())
    assert [(o["id"], o["class"]) for o in objects["objects"]] == [(1, "chair"), (2, "object")]
    assert any("8 are `object`" in text for text in objects["warnings"])


# ---- Detectors whose labels are text -------------------------------------------------------------


class Results:
    """As of ultralytics: a model with classes of its own."""

    def __init__(self, xyxy: Any) -> None:
        self.orig_shape = (240, 320)
        self.names = {0: "red mug"}
        cells = {"xyxy": [xyxy], "conf": [0.9], "cls": [0]}
        self.boxes = SimpleNamespace(**{key: np.array(v, float) for key, v in cells.items()})


@pytest.mark.parametrize(
    "made",
    [
        lambda b: {"boxes": [b], "scores": [0.9], "labels": ["red mug"]},
        lambda b: [{"boxes": np.array([b]), "scores": [0.9], "labels": [0],
                    "text_labels": ["red mug"]}],
        Results,
    ],
)  # fmt: skip
def test_labels_that_are_text(tmp_path: Path, made: Callable[[Any], Any]) -> None:
    """Open vocabulary: the label is the class, regardless of its number in the detector."""
    frames = iter([*range(FRAMES)] * 2)
    config = {"embed": {"model": "none"}, "output": {"overlay": "none", "scene": False}}
    result = rt.run(write_clip(tmp_path / "v.avi"), tmp_path / "out", config,
                    detections=lambda image: made(box(next(frames))), in_3d=False)  # fmt: skip
    assert [o.class_name for o in result.objects] == ["red mug"]
    assert result.tracks.frame.tolist() == list(range(FRAMES))


# ---- Formats that are declared -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "classes", "score"), [("mot", {"cake"}, 1.0), ("boxmot", {"chair"}, 0.87)]
)
def test_nine_columns_of_which_the_seventh_is_1(
    tmp_path: Path, tracked: Callable[..., Tracked], name: str, classes: set[str], score: float
) -> None:
    """Truth with visibilities or results of boxmot: the user says which."""
    (tmp_path / "det.txt").write_text(mot(tail=f"1,{CHAIR},.87"))
    (tmp_path / "names.txt").write_text("\n".join(rt.COCO_NAMES))
    source = write_clip(tmp_path / "v.avi")
    made = tracked(source, "--detections", tmp_path / "det.txt")
    assert made.code == 2 and "mot, boxmot; name one with --detections-format" in made.said
    config = rt.DetectConfig(format=name, class_names=str(tmp_path / "names.txt"))
    found = rt.read_detections(tmp_path / "det.txt", rt.Video(source), config)
    assert {found.class_names[k] for k in found.class_id} == classes
    assert set(found.score.tolist()) == {score}
    wrong = rt.DetectConfig(format="botmox")
    with pytest.raises(rt.ReobjError, match=r"--detections-format botmox: .*did you mean boxmot"):
        rt.read_detections(tmp_path / "det.txt", rt.Video(source), wrong)


def test_labels_beside_a_mot_file_name_its_classes(
    tmp_path: Path, tracked: Callable[..., Tracked]
) -> None:
    """As CVAT writes it; the file that decides is named."""
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt/gt.txt").write_text(mot(tail="1,2,.87"))
    (tmp_path / "gt/labels.txt").write_text("lamp\nchair\n")
    source = write_clip(tmp_path / "v.avi")
    made = tracked(source, "--tracks", tmp_path / "gt/gt.txt")
    assert is_truth(made) and "labels.txt" in made.said


# ---- Names of images decide, never the order of a list -------------------------------------------


def in_list_order(name: str, frames: Sequence[int]) -> dict[str, Any]:
    """A dataset whose list has another order than the names; images without boxes too."""
    images = [{"id": i, "file_name": name.format(f)} for i, f in enumerate(frames)]
    boxes = [{"image_id": i, "category_id": 1, "bbox": coco_box(f)} for i, f in enumerate(frames)]
    return {"images": images, "categories": [{"id": 1, "name": "chair"}], "annotations": boxes}


@pytest.mark.parametrize(
    "name", ["desk_{:04d}_png.rf.5b3c8f01d97e42a6f8c5b09e1d74a3f6.jpg", "desk_{:04d}.png"]
)
def test_datasets_in_another_order_than_the_frames(
    tmp_path: Path, tracked: Callable[..., Tracked], name: str
) -> None:
    frames = [3, 1, 0, 5]
    source = images(tmp_path / "im", [f"desk_{f:04d}.png" for f in range(FRAMES)])
    (tmp_path / "d.json").write_text(json.dumps(in_list_order(name, frames)))
    made = tracked(source, "--detections", tmp_path / "d.json")
    assert is_truth(made, frames=sorted(frames)), made


def test_names_that_fit_no_image(tmp_path: Path, tracked: Callable[..., Tracked]) -> None:
    """As many images as frames: still refused, unless the user says that the order counts."""
    data = in_list_order("desk_{:04d}.png", range(4))
    for image, name in zip(data["images"], ("hall", "door", "sofa", "left"), strict=True):
        image["file_name"] = f"{name}.jpg"
    (tmp_path / "d.json").write_text(json.dumps(data))
    source = images(tmp_path / "im", [f"{f:06d}.png" for f in range(4)])
    made = tracked(source, "--detections", tmp_path / "d.json")
    assert made.code == 2 and "door.jpg" in made.said and "000000.png" in made.said
    made = tracked(source, "--detections", tmp_path / "d.json", "--set", "detect.first_frame=order")
    assert is_truth(made, frames=range(4)), made


# ---- Sizes, classes and identities that a file states --------------------------------------------


@pytest.mark.parametrize(
    ("header", "cells"),
    [
        ("filename,width,height,class,xmin,ymin,xmax,ymax",
         "f_{f}.jpg,640,480,chair,{x1},{y1},{x2},{y2}"),
        ("frame,x1,y1,x2,y2,class,image_width,image_height",
         "{f},{x1},{y1},{x2},{y2},chair,640,480"),
        ("frame,x,y,w,h,width,height,class", "{f},{x1},{y1},{w},{h},640,480,chair"),
    ],
)  # fmt: skip
def test_image_sizes_in_a_csv(
    tmp_path: Path, tracked: Callable[..., Tracked], header: str, cells: str
) -> None:
    """Boxes for images of twice the size are scaled; another shape is refused."""
    (tmp_path / "det.csv").write_text(csv(header, cells))
    source = write_clip(tmp_path / "v.avi")
    made = tracked(source, "--detections", tmp_path / "det.csv")
    assert made.boxes[0] == (5, 10, 25, 30) and "640x480" in made.said
    (tmp_path / "det.csv").write_text(csv(header, cells.replace("480", "640")))
    with pytest.raises(rt.ReobjError, match="made for images of 640x640"):
        rt.read_detections(tmp_path / "det.csv", rt.Video(source))


@pytest.mark.parametrize(
    ("points", "form"),
    [
        (" .1 .2 .9 .3 .4 .8 .5 .6 .7 .95", "yolo-pose"),
        (" .12 .1 .15 .2 .14 .24 .95", "yolo-pose-2d"),
        (" .12 .1 .15 .2 0 0", "yolo-pose-2d"),
    ],
)
def test_labels_with_keypoints_and_confidences(
    tmp_path: Path, tracked: Callable[..., Tracked], points: str, form: str
) -> None:
    """Polygons have the same form, also without visibilities: the user says which."""
    labels = yolo_folder(tmp_path / "labels", lambda f: yolo(f, 0, points), "v_{}.txt", 1)
    (labels / "classes.txt").write_text("chair\n")
    source = write_clip(tmp_path / "v.avi")
    made = tracked(source, "--detections", labels)
    assert made.code == 2 and f"yolo, {form}; name one with" in made.said
    made = tracked(source, "--detections", labels, "--detections-format", form)
    assert is_truth(made) and "keypoints" in made.said
    found = rt.read_detections(labels, rt.Video(source), rt.DetectConfig(format=form))
    assert set(found.score.tolist()) == {0.95 if points.endswith(".95") else 1.0}


# ---- Frames of another size ----------------------------------------------------------------------


def crowd(scale: float, frames: int = FRAMES, clipped: bool = True) -> str:
    """Boxes that move through the borders of 320 x 240, times a factor."""
    rng = np.random.default_rng(0)
    centre = rng.uniform(0, SIZE, (frames, 12, 2))
    half = rng.uniform(15, 40, (frames, 12, 2))
    xyxy = np.concatenate([centre - half, centre + half], 2)
    if clipped:
        xyxy = xyxy.clip(0, np.tile(SIZE, 2))
    rows = [
        f"{f}," + ",".join(f"{v:.2f}" for v in b) + ",.9,chair\n"
        for f in range(frames)
        for b in (xyxy[f] * scale).tolist()
    ]
    return "frame,x1,y1,x2,y2,score,class\n" + "".join(rows)


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.5])
def test_boxes_of_resized_frames(
    tmp_path: Path, tracked: Callable[..., Tracked], scale: float
) -> None:
    """They are refused, and scaled if the user says for which size they were made."""
    (tmp_path / "det.csv").write_text(crowd(scale))
    source = write_clip(tmp_path / "v.avi")
    made = tracked(source, "--detections", tmp_path / "det.csv")
    assert made.code == (2 if scale != 1 else 0), made.said
    assert ("detect.image_size" in made.said) == (scale != 1)
    (tmp_path / "true.csv").write_text(crowd(1))
    stated = rt.DetectConfig(image_size=f"{320 * scale:.0f}x{240 * scale:.0f}")
    found = rt.read_detections(tmp_path / "det.csv", rt.Video(source), stated)
    true = rt.read_detections(tmp_path / "true.csv", rt.Video(source))
    assert np.abs(found.xyxy - true.xyxy).max() < 0.05


# ---- Boxes in another form than declared, class names, unclear files -----------------------------


def forms_of_boxes() -> dict[str, list[list[float]]]:
    """The boxes of `crowd` as frame and four numbers, in each form."""
    rows = np.loadtxt(crowd(1).splitlines()[1:], delimiter=",", usecols=range(5))  # (N, 5)
    frame, low, high = rows[:, :1], rows[:, 1:3], rows[:, 3:5]
    return {
        "x1, y1, x2, y2": rows.tolist(),
        "x, y, w, h": np.hstack([frame, low, high - low]).tolist(),
        "cx, cy, w, h": np.hstack([frame, (low + high) / 2, high - low]).tolist(),
    }


def write_boxes(folder: Path, kind: str, form: str) -> Path:
    """A file of a kind whose numbers have a form, right or wrong."""
    rows = forms_of_boxes()[form]
    path = folder / f"det.{kind}"
    if kind == "yolo":
        path.mkdir()
        for f, a, b, c, d in rows:
            with (path / f"v_{f + 1:.0f}.txt").open("a") as file:
                file.write(f"0 {a / 320:.6f} {b / 240:.6f} {c / 320:.6f} {d / 240:.6f} .9\n")
    elif kind == "json":
        entries = [{"image_id": int(f), "category_id": 1, "bbox": box, "score": 0.9}
                   for f, *box in rows]  # fmt: skip
        path.write_text(json.dumps(entries))
    elif kind == "txt":
        path.write_text("".join(f"{f + 1:.0f},-1,{a},{b},{c},{d},.9\n" for f, a, b, c, d in rows))
    else:
        lines = [f"{f:.0f},{a},{b},{c},{d}\n" for f, a, b, c, d in rows]
        path.write_text("frame,x,y,width,height\n" + "".join(lines))
    return path


DECLARED = {"txt": "x, y, w, h", "csv": "x, y, w, h", "json": "x, y, w, h", "yolo": "cx, cy, w, h"}


@pytest.mark.parametrize("form", ["x1, y1, x2, y2", "x, y, w, h", "cx, cy, w, h"])
@pytest.mark.parametrize("kind", DECLARED)
def test_boxes_in_another_form(
    tmp_path: Path, tracked: Callable[..., Tracked], kind: str, form: str
) -> None:
    """Boxes that leave the image and all fit in another form: one line that names it."""
    path = write_boxes(tmp_path, kind, form)
    made = tracked(write_clip(tmp_path / "v.avi"), "--detections", path)
    if form == DECLARED[kind]:
        assert made.code == 0, made.said
        return
    assert made.code == 2 and made.said.count("\n") == 1, made.said
    if (kind, form) != ("yolo", "x, y, w, h"):  # these fit as centres or not at all
        assert f"all fit it as {form}" in made.said, made.said


def test_confidences_before_the_boxes_of_yolo_labels(
    tmp_path: Path, tracked: Callable[..., Tracked]
) -> None:
    path = write_boxes(tmp_path, "yolo", DECLARED["yolo"])
    for file in path.iterdir():
        rows = [line.split() for line in file.read_text().splitlines()]
        file.write_text("".join(f"{row[0]} {row[5]} {' '.join(row[1:5])}\n" for row in rows))
    made = tracked(write_clip(tmp_path / "v.avi"), "--detections", path)
    assert made.code == 2 and "fit it as class conf cx cy w h" in made.said, made.said


@pytest.mark.parametrize("option", ["--detections", "--tracks"])
def test_corners_that_stay_in_the_image(
    tmp_path: Path, tracked: Callable[..., Tracked], option: str
) -> None:
    """Of an identity, the third and fourth number move with the first and second."""
    rows = [f"{f + 1},1,{box(f)[0]},20,{box(f)[2]},60,.9\n" for f in range(FRAMES)]
    (tmp_path / "det.txt").write_text("".join(rows))
    made = tracked(write_clip(tmp_path / "v.avi"), option, tmp_path / "det.txt")
    assert made.code == 2 and "all boxes are x1, y1, x2, y2" in made.said, made


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("d.jsonl", '{"frame": 0, "x1": 1}\n{"frame": 1, "x1": 2}\n', "JSON Lines"),
        ("d.json", '{"frame": 0, "x1": 1}\n{"frame": 1, "x1": 2}\n', "JSON Lines"),
        ("d.json", '[{"data": {}, "annotations": []}]', "(JSON with annotations, data)"),
        ("d.json", '{"a": 1}', "(JSON with a); expected one of records, coco-results, "),
        ("d.xml", "<annotation/>", "(XML <annotation>); expected one of cvat ("),
        ("d.json", json.dumps(dataset(categories=[{"id": "1", "name": "chair"}])),
         "category_id 1 is unknown, expected one of '1'"),
    ],
)  # fmt: skip
def test_unclear_files_are_named(
    tmp_path: Path, tracked: Callable[..., Tracked], name: str, text: str, expected: str
) -> None:
    (tmp_path / name).write_text(text)
    source = images(tmp_path / "im", [f"{f}.png" for f in range(FRAMES)])
    made = tracked(source, "--detections", tmp_path / name)
    assert made.code == 2 and expected in made.said and made.said.count("\n") == 1, made.said
