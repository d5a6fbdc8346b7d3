"""`eval`: same scores and same refusals as TrackEval; assumptions are reported."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import reobj_track as rt

ROWS = np.array(
    [(f, o, 30 + f * 20 % 1200, 40 + o * 120, 60, 100) for f in range(1, 31) for o in range(1, 6)],
    float,
)
NAMES = {1: "chair", 2: "cup", 3: "chair", 4: "tv", 5: "potted plant"}
COCO = {name: rt.COCO_NAMES.index(name) for name in NAMES.values()}


def write(path: Path, rows: np.ndarray, tail: str = "", sep: str = ",") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = (sep.join(f"{x:.10g}" for x in row) for row in rows)
    path.write_text("".join(f"{line}{sep if tail else ''}{tail}\n" for line in lines))
    return path


def score(out: Path, gt: Path, *more: str) -> tuple[dict[str, float], list[str]]:
    found = rt.evaluate(out, gt, **({"classes": list(more)} if more else {}))
    return found["tracks"]["all"], found["messages"]


def refused(capsys: pytest.CaptureFixture[str], out: Path, gt: Path) -> str:
    """The one line that the command line prints instead of a table."""
    assert rt.main(["eval", str(out), "--gt", str(gt)]) == 2
    text = capsys.readouterr()
    assert text.out == "" and len(text.err.splitlines()) == 1
    return text.err


@pytest.fixture
def result(tmp_path: Path) -> Path:
    return write(tmp_path / "res.txt", ROWS, "0.9,-1,-1,-1")


def test_identities_twice_in_a_frame_are_refused(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = ROWS.copy()
    rows[rows[:, 1] == 2, 1] = 1
    gt, other = write(tmp_path / "gt.txt", ROWS, "1"), write(tmp_path / "two.txt", rows, "1")
    for out, truth in ((result, other), (other, gt)):
        text = refused(capsys, out, truth)
        assert "two.txt: identity 1 has 2 boxes in frame 1 (from 1; 30 such cases)" in text
    rows = ROWS.copy()
    rows[rows[:, 1] == 2, 1], marked = 1, np.where(rows[:, 1] == 2, 0, 1)
    unmarked = write(tmp_path / "gt0.txt", np.c_[rows, marked])  # what does not count is no rival
    assert score(write(tmp_path / "x.txt", ROWS[ROWS[:, 1] != 2]), unmarked)[0]["HOTA"] == 1


def test_frames_from_0_are_accepted_and_reported(result: Path, tmp_path: Path) -> None:
    rows = ROWS - np.eye(1, 6)
    zero = write(tmp_path / "zero.txt", rows, "1")
    for out, gt in ((result, zero), (zero, write(tmp_path / "gt.txt", ROWS, "1")), (zero, zero)):
        found, said = score(out, gt)
        assert found["HOTA"] == found["IDF1"] == found["MOTA"] == 1
        assert "zero.txt has a frame 0: its frames are taken as 0-based" in said
    assert score(result, write(tmp_path / "gt.txt", ROWS, "1"))[1] == []


@pytest.mark.parametrize(
    ("tail", "keep", "why"),
    [
        ("1", 0, "no boxes in it"),
        ("0", 150, "of 150 rows 150 are marked not to count (column 7 is 0"),
        ("0,-1,-1,-1", 150, "of 150 rows 150 are marked not to count"),
    ],
)
def test_truth_without_scored_boxes(
    result: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    tail: str,
    keep: int,
    why: str,
) -> None:
    gt = write(tmp_path / "gt.txt", ROWS[:keep], tail)
    for out in (result, write(tmp_path / "none.txt", ROWS[:0])):
        text = refused(capsys, out, gt)
        assert f"{gt}: no true box counts: {why}" in text


# ---- Classes ----


def folder(out: Path, names: tuple[str, ...] | None = None) -> Path:
    """An output folder with these boxes, of these class names or of NAMES."""
    classes = names or rt.COCO_NAMES
    ids, n = ROWS[:, 1].astype(int), len(ROWS)
    kind = np.array([0 if names else COCO[NAMES[i]] for i in ids])
    xyxy = np.c_[ROWS[:, 2:4], ROWS[:, 2:4] + ROWS[:, 4:]]
    frame = ROWS[:, 0].astype(int) - 1
    tracks = rt.Tracks(frame, ids, ids, xyxy, np.full(n, 0.9), kind, np.zeros(n, int))
    own = [rt.Object(i, names[0] if names else NAMES[i], 0.9, "tracked", "") for i in NAMES]
    from reobj.results.result import VideoInfo

    rt.Result(tracks, tuple(classes), VideoInfo("v", 1300, 800, 30.0), own).save(out)
    return out


def nine(path: Path, number: dict[str, int], flag: int = 1) -> Path:
    kinds = [number[NAMES[int(i)]] for i in ROWS[:, 1]]
    ones = np.ones(len(ROWS))
    return write(path, np.c_[ROWS, flag * ones, kinds, 0.8 * ones])


def test_labels_of_cvat_name_the_classes(tmp_path: Path) -> None:
    """From 1 by the lines of gt/labels.txt; seqinfo.ini of no MOT sequence changes nothing."""
    out, labels = folder(tmp_path / "out"), ["Potted_Plant", "chair", "cup", "TV"]
    line = {n: 1 + labels.index({"potted plant": labels[0], "tv": "TV"}.get(n, n)) for n in COCO}
    ours = rt.evaluate(out, nine(tmp_path / "ours/gt.txt", COCO))
    for name in ("cvat", "cvat_seq"):
        gt = nine(tmp_path / name / "gt/gt.txt", line)
        (gt.parent / "labels.txt").write_text("\n".join(labels) + "\n")
        if name == "cvat_seq":
            (gt.parent.parent / "seqinfo.ini").write_text("[Sequence]\nname=room\nseqLength=30\n")
        found = rt.evaluate(out, gt)
        assert found["tracks"] == ours["tracks"]
        assert sorted(found["tracks"]) == ["all", "chair", "cup", "potted plant", "tv"]
        assert all(s["HOTA"] == 1 for s in found["tracks"].values())
        assert found["messages"] == ["classes are lines of labels.txt, from 1 (CVAT's MOT 1.1)"]
    (gt.parent / "labels.txt").write_text("chair\n")
    with pytest.raises(rt.ReobjError, match=r"class 4, but .*labels.txt has 1 lines"):
        rt.evaluate(out, gt)


def mot_files(tmp_path: Path, name: str, seqinfo: bool = True) -> tuple[Path, Path]:
    """A person, a static person (7), a vehicle without motor (6), a car (3); all are found."""
    kinds = {1: 1, 2: 7, 3: 6, 4: 3}
    rows = ROWS[ROWS[:, 1] < 5]
    kind = np.array([kinds[int(i)] for i in rows[:, 1]])
    gt = write(tmp_path / name / "gt/gt.txt", np.c_[rows, kind == 1, kind, np.ones(len(rows))])
    if seqinfo:
        text = f"[Sequence]\nname={name}\nseqLength=30\n"
        (gt.parent.parent / "seqinfo.ini").write_text(text)
    return write(tmp_path / "pr.txt", rows, "0.9,-1,-1,-1"), gt


@pytest.mark.parametrize(
    ("name", "benchmark", "precision"),
    [
        ("MOT16-02", "MOT16", 1 / 3),
        ("MOT17-02-FRCNN", "MOT17", 1 / 3),
        ("MOT20-01", "MOT20", 1 / 2),  # class 6 is a distractor there
        ("park", "MOT17", 1 / 3),  # by its rows
    ],
)
@pytest.mark.parametrize("seqinfo", [True, False])
def test_distractors_of_mot(
    tmp_path: Path, name: str, benchmark: str, precision: float, seqinfo: bool
) -> None:
    found, said = score(*mot_files(tmp_path, name, seqinfo))
    assert found["precision"] == pytest.approx(precision) and found["gt_objects"] == 1
    (note,) = said
    why = "its rows" if name == "park" else "seqinfo.ini" if seqinfo else f"the folder {name}"
    assert note.startswith(f"classes are {benchmark}'s, by {why}: pedestrians count")


def test_one_class_without_a_name_is_any_class(tmp_path: Path) -> None:
    """DanceTrack and SportsMOT: nine columns, class 1 throughout, and a seqinfo.ini."""
    out = folder(tmp_path / "out", ("person",))
    gt = nine(tmp_path / "dancetrack0001/gt/gt.txt", dict.fromkeys(COCO, 1))
    (gt.parent.parent / "seqinfo.ini").write_text("[Sequence]\nname=dancetrack0001\n")
    found = rt.evaluate(out, gt)
    assert found["tracks"]["all"]["HOTA"] == 1 and list(found["tracks"]) == ["all"]
    assert "one class without a name" in found["messages"][0]


# ---- Other formats of truth ----


def kitti(path: Path, extra: str = "") -> Path:
    lines = [
        f"{f - 1:.0f} {i:.0f} {NAMES[int(i)].replace(' ', '_')} 0 0 -1.5 {x} {y} {x + w} {y + h} "
        "1 1 1 0 0 9 0"
        for f, i, x, y, w, h in ROWS.tolist()
    ]
    path.write_text("\n".join([*lines, extra]) + "\n")
    return path


def test_kitti_labels(tmp_path: Path) -> None:
    """From frame 0; what lies on DontCare is no error."""
    out = folder(tmp_path / "out")
    found = rt.evaluate(out, kitti(tmp_path / "0000.txt"))
    assert all(s["HOTA"] == 1 for s in found["tracks"].values()) and len(found["tracks"]) == 5
    assert found["messages"][0].startswith("KITTI's labels: frames from 0")
    text = kitti(tmp_path / "0001.txt").read_text()
    anywhere = [line.split() for line in text.splitlines() if " 2 cup " in line]
    for words in anywhere:
        words[1:3] = "-1", "DontCare"
    others = [line for line in text.splitlines() if " 2 cup " not in line]
    ignored = tmp_path / "0002.txt"
    ignored.write_text("\n".join([*others, *map(" ".join, anywhere)]))
    assert score(out, ignored)[0]["precision"] == 1
    ignored.write_text("\n".join(others))
    assert score(out, ignored)[0]["precision"] == 0.8
    with pytest.raises(rt.ReobjError, match="line 151: 3 columns, expected 17"):
        rt.evaluate(out, kitti(tmp_path / "0003.txt", "1 2 chair"))


def test_coco_video(tmp_path: Path) -> None:
    out, frames = folder(tmp_path / "out"), range(30)
    images = [{"id": 100 + f, "frame_id": f, "video_id": 1} for f in frames]
    kinds = [{"id": k, "name": n} for n, k in COCO.items()]
    notes = [
        {"id": k, "image_id": 99 + int(f), "category_id": COCO[NAMES[int(i)]], "instance_id": i,
         "bbox": [x, y, w, h]} for k, (f, i, x, y, w, h) in enumerate(ROWS.tolist())
    ]  # fmt: skip
    data = {"images": images, "categories": kinds, "annotations": notes}
    path = tmp_path / "vid.json"
    path.write_text(json.dumps(data))
    assert all(s["HOTA"] == 1 for s in rt.evaluate(out, path)["tracks"].values())
    images[3]["video_id"] = 2
    path.write_text(json.dumps(data))
    with pytest.raises(rt.ReobjError, match="images of 2 videos"):
        rt.evaluate(out, path)
    path.write_text(json.dumps({"images": [{"id": 1}]}))
    with pytest.raises(rt.ReobjError, match="a dataset without annotations"):
        rt.evaluate(out, path)


def test_synonyms_are_one_class(tmp_path: Path) -> None:
    """In the result, in the truth, and between the two; also for --classes and Rank-k."""
    out = folder(tmp_path / "out", ("sofa",))
    rows = "".join(
        f'<track id="{i}" label="{name}">'
        + "".join(
            f'<box frame="{f - 1:.0f}" xtl="{x}" ytl="{y}" xbr="{x + w}" ybr="{y + h}" '
            'outside="0" occluded="0" keyframe="1"/>'
            for f, _, x, y, w, h in ROWS[ROWS[:, 1] == i].tolist()
        )
        + "</track>"
        for i, name in enumerate(("couch", "Sofa", "sofa", "couch", "cup"), 1)
    )
    truth = tmp_path / "cvat.xml"
    truth.write_text(f"<annotations>{rows}</annotations>")
    found = rt.evaluate(out, truth)["tracks"]
    assert sorted(found) == ["all", "cup", "sofa"]
    assert found["sofa"]["DetA"] == pytest.approx(0.8) and found["cup"]["recall"] == 0
    only = rt.evaluate(out, truth, classes=["couch"])["tracks"]["all"]
    assert only == found["sofa"]
    with pytest.raises(rt.ReobjError, match="--classes: table: neither in the truth nor"):
        rt.evaluate(out, truth, classes=["table"])


# ---- Truth in some frames only ----

LISTED = (1, 6, 11, 16, 21, 26)  # frames from 1, a step of 5


def coco_video(path: Path, rows: np.ndarray, frames: tuple[int, ...]) -> Path:
    """Write COCO-VID whose `images` are these frames."""
    data = {
        "videos": [{"id": 1, "name": "v"}],
        "images": [{"id": f, "video_id": 1, "frame_id": f - 1} for f in frames],
        "categories": [{"id": 1, "name": "cup"}],
        "annotations": [
            {"id": i, "image_id": int(f), "category_id": 1, "instance_id": int(o), "bbox": box}
            for i, (f, o, *box) in enumerate(rows.tolist())
        ],
    }
    path.write_text(json.dumps(data))
    return path


def cvat_task(path: Path, rows: np.ndarray, task: str) -> Path:
    tracks = "".join(
        f'<track id="{o:.0f}" label="cup">'
        + "".join(
            f'<box frame="{f - 1:.0f}" outside="0" xtl="{x}" ytl="{y}" xbr="{x + w}" '
            f'ybr="{y + h}"/>'
            for f, _, x, y, w, h in rows[rows[:, 1] == o].tolist()
        )
        + "</track>"
        for o in np.unique(rows[:, 1])
    )
    path.write_text(f"<annotations><meta><task>{task}</task></meta>{tracks}</annotations>")
    return path


def test_frames_that_the_truth_does_not_list_do_not_count(result: Path, tmp_path: Path) -> None:
    rows = ROWS[np.isin(ROWS[:, 0], LISTED)]
    span = "<start_frame>0</start_frame><stop_frame>29</stop_frame>"
    step = f"{span}<frame_filter>step=5</frame_filter>"
    late = "<start_frame>10</start_frame><stop_frame>19</stop_frame>"
    for gt in (
        coco_video(tmp_path / "a.json", rows, LISTED),
        cvat_task(tmp_path / "a.xml", rows, step),
        cvat_task(tmp_path / "late.xml", ROWS[(ROWS[:, 0] > 10) & (ROWS[:, 0] <= 20)], late),
    ):
        found, said = score(result, gt)
        assert found["HOTA"] == found["IDF1"] == found["MOTA"] == 1
        assert any("of 150 boxes of the result do not count" in text for text in said)
    empty = rows[rows[:, 0] != 6]  # a listed frame without true boxes: boxes in it are false
    for gt in (
        coco_video(tmp_path / "b.json", empty, LISTED),
        cvat_task(tmp_path / "b.xml", empty, step),
    ):
        found, said = score(result, gt)
        assert found["MOTA"] == pytest.approx(1 - 5 / 25)
    every = coco_video(tmp_path / "c.json", ROWS, tuple(range(1, 31)))
    found, said = score(result, every)
    assert found["MOTA"] == 1 and not any("do not count" in text for text in said)


# ---- Formats, and frames of another size ---------------------------------------------------------


def test_the_number_of_the_first_frame_of_the_truth(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The option that the note and the error name was not read."""
    table = tmp_path / "truth.csv"
    rows = [f"{f:.0f},{i:.0f},{x},{y},{x + w},{y + h}" for f, i, x, y, w, h in ROWS.tolist()]
    table.write_text("frame,track_id,x1,y1,x2,y2\n" + "\n".join(rows))
    named = coco_video(tmp_path / "named.json", ROWS[np.isin(ROWS[:, 0], LISTED)], LISTED)
    data = json.loads(named.read_text())
    for image in data["images"]:
        image["file_name"] = f"a_{image.pop('frame_id') + 1}.png"
    named.write_text(json.dumps(data))
    for gt, code in ((table, 0), (named, 2)):
        assert rt.main(["eval", str(result), "--gt", str(gt)]) == code
        assert "--set detect.first_frame" in " ".join("".join(capsys.readouterr()).split())
        words = ["eval", str(result), "--gt", str(gt), "--set", "detect.first_frame=1"]
        assert rt.main(words) == 0
        assert "100.0 100.0 100.0" in capsys.readouterr().out
    words[-1] = "detect.first_frame=order"
    assert rt.main(words) == 2


def test_a_result_of_frames_of_another_size(tmp_path: Path) -> None:
    rows = ROWS * [1, 1, 2, 2, 2, 2]
    gt = write(tmp_path / "gt.txt", ROWS, "1")
    _, said = score(write(tmp_path / "res.txt", rows, "0.9,-1,-1,-1"), gt)
    (note,) = [text for text in said if "frames of another size" in text]
    assert "150 do if the boxes of the result are scaled by 0.5" in note


@pytest.mark.parametrize("wrong", ["truth", "result"])
def test_rows_that_hold_corners_are_refused(
    tmp_path: Path, wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a size of the images too; rows whose sizes exceed their places are no corners."""
    rows = ROWS.copy()
    rows[:, 4:6] += rows[:, 2:4]
    good = {name: write(tmp_path / f"{name}.txt", ROWS, "1") for name in ("truth", "result")}
    files = good | {wrong: write(tmp_path / "corners.txt", rows, "1")}
    text = refused(capsys, files["result"], files["truth"])
    assert "corners.txt: all boxes are x1, y1, x2, y2" in text
    large = ROWS.copy()
    large[:, 4:6] = 1300, 700
    files = good | {wrong: write(tmp_path / "large.txt", large, "1")}
    score(files["result"], files["truth"])
