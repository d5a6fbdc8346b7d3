"""Videos, image folders and recorded detections, with everything that can be wrong with them."""

from __future__ import annotations

import json
import os
import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt

SHARED = Path(os.environ.get("REOBJ_SHARED", Path(__file__).resolve().parents[1].parent / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "data").is_dir(), reason="no real recordings: set REOBJ_SHARED"
)

# ---- Video ---------------------------------------------------------------------------------------


def picture(index: int, size: tuple[int, int] = (64, 48)) -> rt.Image:
    """A grey image of 12 * its number."""
    return np.full((size[1], size[0], 3), 12 * index % 256, np.uint8)


def number_of(image: rt.Image) -> int:
    return round(float(image.mean()) / 12)


def write_video(
    path: Path, count: int = 20, codec: str = "mp4v", size: tuple[int, int] = (64, 48)
) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25, size)
    assert writer.isOpened()
    for index in range(count):
        writer.write(picture(index, size))
    writer.release()
    return path


def write_images(folder: Path, names: list[str], size: tuple[int, int] = (64, 48)) -> Path:
    folder.mkdir(exist_ok=True)
    for index, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(index, size))
    return folder


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("movie") / "a.mp4")


def test_video_reads_every_frame_with_number_and_time(movie: Path) -> None:
    video = rt.Video(movie)
    assert (video.size, video.working_size, video.scale) == ((64, 48), (64, 48), 1.0)
    assert (video.fps, video.frame_count, video.expected, video.is_live) == (25.0, 20, 20, False)
    frames = list(video)
    assert (
        [frame.index for frame in frames]
        == [number_of(frame.image) for frame in frames]
        == list(range(20))
    )
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(20) / 25, atol=1e-6)
    assert [frame.index for frame in video] == list(range(20))  # a second time
    assert video.skipped == [] and video.messages == [] and video.name(3) == ""


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (rt.InputConfig(every=3), [0, 3, 6, 9, 12, 15, 18]),  # numbers stay those of the source
        (rt.InputConfig(every=4, start=5, stop=15), [5, 9, 13]),
        (rt.InputConfig(start=18), [18, 19]),
        (rt.InputConfig(stop=99), list(range(20))),  # beyond the end
    ],
)
@pytest.mark.parametrize("kind", ["movie", "images"])
def test_frame_choice(
    movie: Path, tmp_path: Path, kind: str, config: rt.InputConfig, expected: list[int]
) -> None:
    source = (
        movie if kind == "movie" else write_images(tmp_path / "im", [f"{i}.png" for i in range(20)])
    )
    video = rt.Video(source, config)
    frames = list(video)
    assert [f.index for f in frames] == [number_of(f.image) for f in frames] == expected
    assert video.expected == len(expected)


def test_max_size_shrinks_the_longer_side(movie: Path) -> None:
    video = rt.Video(movie, rt.InputConfig(max_size=32))
    assert video.size == (64, 48) and video.working_size == (32, 24) and video.scale == 0.5
    assert next(iter(video)).image.shape == (24, 32, 3)
    assert rt.Video(movie, rt.InputConfig(max_size=500)).working_size == (64, 48)  # never enlarged


def box_at(data: bytearray, kind: bytes) -> int:
    """Position of the type of an mp4 box."""
    position = data.rfind(kind)
    assert position > 0
    return position


def test_rotation_metadata_turns_frames_upright(movie: Path, tmp_path: Path) -> None:
    data = bytearray(movie.read_bytes())
    matrix = box_at(data, b"tkhd") + 4 + 40
    data[matrix : matrix + 36] = struct.pack(
        ">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 48 << 16, 0, 1 << 30
    )
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(data)
    video = rt.Video(turned)
    assert video.size == (48, 64)
    assert next(iter(video)).image.shape == (64, 48, 3)


def test_exif_rotation_turns_photos_upright(tmp_path: Path) -> None:
    ok, jpeg = cv2.imencode(".jpg", picture(3))
    tag = struct.pack(
        ">2sHIHHHIHHI", b"MM", 42, 8, 1, 0x0112, 3, 1, 6, 0, 0
    )  # orientation 6: turn clockwise
    segment = b"\xff\xe1" + struct.pack(">H", len(tag) + 8) + b"Exif\0\0" + tag
    (tmp_path / "a.jpg").write_bytes(jpeg.tobytes()[:2] + segment + jpeg.tobytes()[2:])
    assert ok and rt.Video(tmp_path).size == (48, 64)


def test_variable_frame_rate_has_the_true_times(movie: Path, tmp_path: Path) -> None:
    data = bytearray(movie.read_bytes())
    stts = box_at(data, b"stts")
    count, delta = struct.unpack(">II", data[stts + 12 : stts + 20])
    entries = struct.pack(">III", 0, 2, 10) + struct.pack(
        ">III", delta, count - 10, delta // 2
    )  # then twice as fast
    data[stts + 4 : stts + 20] = entries
    for kind in (b"stts", b"stbl", b"minf", b"mdia", b"trak", b"moov"):  # 8 bytes more in each
        at = box_at(data, kind) - 4
        data[at : at + 4] = struct.pack(">I", struct.unpack(">I", data[at : at + 4])[0] + 8)
    (tmp_path / "vfr.mp4").write_bytes(data)
    times = [frame.time_s for frame in rt.Video(tmp_path / "vfr.mp4")]
    np.testing.assert_allclose(np.diff(times), [0.04] * 10 + [0.02] * 9, atol=1e-6)


def test_corrupt_frame_is_skipped_counted_and_reported(
    tmp_path: Path,
) -> None:
    path = write_video(tmp_path / "a.avi", codec="MJPG")
    data = bytearray(path.read_bytes())
    for number in (7, 8):
        at = data.index(b"movi")
        for _ in range(number + 1):
            at = data.index(b"00dc", at + 1)
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        data[at + 8 : at + 8 + length] = bytes(length)
    path.write_bytes(data)
    video = rt.Video(path)
    frames = list(video)
    assert [f.index for f in frames] == [i for i in range(20) if i not in (7, 8)]
    assert all(abs(number_of(f.image) - f.index) <= 1 for f in frames)
    assert (
        video.skipped == [7, 8]
        and "2 frames skipped" in video.messages[0]
        and ": 7, 8" in video.messages[0]
    )
    list(video)
    assert len(video.messages) == 1  # said once


def test_cut_video_is_reported(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", codec="MJPG", count=40)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    video = rt.Video(path)
    count = len(list(video))
    assert 5 < count < 35
    assert not video.frame_count or video.frame_count == count or "ends early" in video.messages[0]


def test_images_are_sorted_as_people_count(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "im", ["f1.png", "f2.png", "f10.png"])
    (folder / "notes.txt").write_text("no image")
    video = rt.Video(folder)
    assert video.names == ["f1.png", "f2.png", "f10.png"] and video.name(2) == "f10.png"
    assert [f.time_s for f in video] == [0, 1 / 30, 2 / 30]
    assert len(list(rt.Video(str(folder / "f1*.png")))) == 2  # glob
    assert len(list(rt.Video(folder / "f2.png"))) == 1  # one image is a video of one frame


def test_bad_images_are_skipped(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "im", [f"{i}.png" for i in range(5)])
    cv2.imwrite(str(folder / "1.png"), picture(1, (32, 32)))  # another size
    (folder / "2.png").write_bytes(b"")
    (folder / "3.png").write_bytes(b"no image")
    video = rt.Video(folder)
    assert [f.index for f in video] == [0, 4]
    assert video.skipped == [1, 2, 3] and "3 frames skipped" in video.messages[0]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda d: d / "none.mp4", "no such file or folder"),
        (lambda d: d, "no images there"),  # empty folder
        (lambda d: f"{d}/*.png", "no images there"),  # glob without a match
        (lambda d: (d / "empty.mp4", (d / "empty.mp4").write_bytes(b""))[0], "cannot be opened"),
        (
            lambda d: (d / "text.mp4", (d / "text.mp4").write_bytes(b"hello" * 99))[0],
            "cannot be opened",
        ),
        (
            lambda d: (d / "a.png", (d / "a.png").write_bytes(b"x"))[0],
            "not one frame can be decoded",
        ),
        (lambda d: 77, "cannot be opened as a camera"),
        (lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(start=3)), "it has only 3 frames"),
        (lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(every=0)), "--every"),
    ],
)
def test_bad_sources_give_one_clear_line(tmp_path: Path, make: Any, expected: str) -> None:
    made = make(tmp_path)
    source, config = made if isinstance(made, tuple) else (made, rt.InputConfig())
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        rt.Video(source, config)
    assert "\n" not in str(caught.value)


@needs_shared
def test_portrait_phone_clip() -> None:
    video = rt.Video(SHARED / "data/orbit_clips/teddybear.mp4")
    assert video.size == (1080, 1920) and len(list(video)) == 9 and video.messages == []


# ---- Masks ---------------------------------------------------------------------------------------


def reference_runs(mask: rt.BoolArray) -> list[int]:
    """Run lengths down the columns, zeros first, the slow way."""
    runs, value = [0], False
    for pixel in mask.T.ravel():
        if pixel != value:
            runs.append(0)
            value = not value
        runs[-1] += 1
    return runs


def test_rle_round_trip() -> None:
    rng = np.random.default_rng(0)
    masks = np.stack([rng.random((7, 5)) < share for share in (0, 0.1, 0.5, 0.9, 1)])
    masks[2, 0, 0], masks[3, 0, 0] = True, False  # starts with a one, with a zero
    assert rt.rle_encode(masks[0]).tolist() == []  # a mask without a pixel has no runs
    for mask in masks[1:]:
        assert rt.rle_encode(mask).tolist() == reference_runs(mask)
    for mask in masks:
        np.testing.assert_array_equal(rt.rle_decode(rt.rle_encode(mask), (5, 7)), mask)


def coco_string(runs: list[int]) -> str:
    """Compress run lengths as in maskApi.c of pycocotools."""
    text = ""
    for i, run in enumerate(runs):
        value = run - runs[i - 2] if i > 2 else run
        more = True
        while more:
            low, value = value & 0x1F, value >> 5
            more = value != (-1 if low & 0x10 else 0)
            text += chr((low | (0x20 if more else 0)) + 48)
    return text


def test_coco_strings() -> None:
    rng = np.random.default_rng(1)
    for scale in (3, 40, 5000, 2_000_000):
        runs = rng.integers(0, scale, 50).tolist()
        assert rt.coco_runs(coco_string(runs)).tolist() == runs
    assert rt.coco_runs("52203").tolist() == [5, 2, 2, 2, 5]  # 0 is a difference of 0, 3 of 3


# ---- Recorded detections -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> rt.Video:
    """20 images of 640 x 480."""
    return rt.Video(
        write_images(
            tmp_path_factory.mktemp("v") / "im", [f"im{i}.png" for i in range(20)], (640, 480)
        )
    )


def read(
    tmp_path: Path, name: str, text: str, video: rt.Video, **config: Any
) -> rt.RecordedDetections:
    (tmp_path / name).write_text(text)
    return rt.read_detections(tmp_path / name, video, rt.DetectConfig(**config))


MOT = "1,-1,10,20,30,40,.9,-1,-1,-1\n3,-1,50,60,30,40,.5,-1,-1,-1\n1,-1,100,20,30,40,.95,-1,-1,-1\n"
CSV = "frame,x1,y1,x2,y2,score,class\n0,10,20,40,60,.9,56\n2,50,60,80,100,.5,41\n"


def test_mot(tmp_path: Path, video: rt.Video) -> None:
    found = read(tmp_path, "det.txt", MOT, video)
    assert found.frame.tolist() == [0, 0, 2] and found.class_names == ("object",)
    assert len(found) == 3
    first = found.at(0)
    assert first.xyxy.tolist() == [[100, 20, 130, 60], [10, 20, 40, 60]]  # best first, corners
    assert (
        first.score.tolist() == [0.95, 0.9]
        and first.class_id.tolist() == [0, 0]
        and first.masks is None
    )
    assert len(found.at(1)) == 0 and found.at(1).xyxy.shape == (0, 4)
    assert found.messages == []


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("1,-1,10,20,30,40,.9\n", ("object",)),  # 7 columns (MOT17)
        ("1,-1,10,20,30,40\n", ("object",)),  # no score
        (
            "\n1,7,10,20,30,40,1,2,.7\n",
            ("class 1", "class 2"),
        ),  # ground truth: class and visibility
        ("0,-1,10,20,30,40,.9\n", ("object",)),  # 0-based frames
    ],
)
def test_mot_variants(tmp_path: Path, video: rt.Video, text: str, names: tuple[str, ...]) -> None:
    found = read(tmp_path, "det.txt", text, video)
    assert found.at(0).xyxy.tolist() == [[10, 20, 40, 60]] and found.class_names == names


@pytest.mark.parametrize(
    "text",
    [
        CSV,
        CSV.replace("frame,", "# frame(0-based row),").replace(
            "class\n", "class(COCO-80) ; some tool, 640\n"
        ),
        "class_id,confidence,frame,x,y,width,height\n56,.9,0,10,20,30,40\n41,.5,2,50,60,30,40\n",
        "Frame,X1,Y1,X2,Y2,Conf,class_name\n0,10,20,40,60,.9,chair\n2,50,60,80,100,.5,cup\n",
    ],
)
def test_csv_variants(tmp_path: Path, video: rt.Video, text: str) -> None:
    found = read(tmp_path, "det.csv", text, video)
    assert found.at(0).xyxy.tolist() == [[10, 20, 40, 60]] and found.at(2).score.tolist() == [0.5]
    assert [found.class_names[found.at(f).class_id[0]] for f in (0, 2)] == ["chair", "cup"]


def test_options_apply_to_recorded_detections(tmp_path: Path, video: rt.Video) -> None:
    assert read(tmp_path, "a.csv", CSV, video, min_score=0.6).frame.tolist() == [0]
    assert read(tmp_path, "a.csv", CSV, video, classes="Cup, tv").frame.tolist() == [2]
    assert read(tmp_path, "a.txt", MOT, video, max_detections=1).at(0).score.tolist() == [0.95]
    (tmp_path / "names.txt").write_text("sofa\nlamp\n")
    named = read(tmp_path, "a.csv", CSV.replace("56", "0").replace("41", "1"), video,
                 class_names=str(tmp_path / "names.txt"))  # fmt: skip
    assert named.class_names == ("sofa", "lamp") and named.at(2).class_id.tolist() == [1]


def test_boxes_and_masks_follow_the_working_size(tmp_path: Path, video: rt.Video) -> None:
    masks = np.zeros((1, 480, 640), bool)
    masks[0, 20:60, 10:40] = True
    one = rt.Detections(np.array([[10.0, 20, 40, 60]]), np.array([0.9]), np.array([0]), masks)
    rt.write_detections_npz(tmp_path / "a.npz", [(0, one)], ["x"], (640, 480))
    half = rt.Video(Path(video.source), rt.InputConfig(max_size=320))
    found = rt.read_detections(tmp_path / "a.npz", half).at(0)
    assert found.xyxy.tolist() == [[5, 10, 20, 30]]
    assert found.masks is not None and found.masks.shape == (1, 240, 320)
    np.testing.assert_array_equal(found.masks, masks[:, ::2, ::2])


def coco_entries(**changes: Any) -> list[dict[str, Any]]:
    return [{"image_id": 4, "category_id": 62, "bbox": [10, 20, 30, 40], "score": 0.9} | changes]


def test_coco(tmp_path: Path, video: rt.Video) -> None:
    found = read(tmp_path, "res.json", json.dumps(coco_entries()), video)
    assert found.frame.tolist() == [4] and found.at(4).xyxy.tolist() == [[10, 20, 40, 60]]
    assert found.class_names[found.at(4).class_id[0]] == "chair"  # COCO's category 62
    (tmp_path / "names.txt").write_text("sofa\nlamp\n")
    named = read(tmp_path, "res.json", json.dumps(coco_entries(category_id=1)), video,
                 class_names=str(tmp_path / "names.txt"))  # fmt: skip
    assert named.class_names == ("sofa", "lamp") and named.class_id.tolist() == [1]


def test_coco_ids_are_those_of_the_dataset_beside(tmp_path: Path, video: rt.Video) -> None:
    """An image_id is no frame number (trap 7 of the formats): the dataset JSON says which it is."""
    images = [{"id": 900 + i, "file_name": f"some/im{19 - i}.png"} for i in range(20)]
    dataset = {"images": images, "categories": [{"id": 7, "name": "wok"}, {"id": 9, "name": "cup"}]}
    (tmp_path / "instances.json").write_text(json.dumps(dataset))
    (tmp_path / "broken.json").write_text("{")
    found = read(tmp_path, "res.json", json.dumps(coco_entries(image_id=903, category_id=9)), video)
    assert found.frame.tolist() == [16] and not found.messages
    assert found.class_names[found.class_id[0]] == "cup"
    with pytest.raises(rt.ReobjError, match="image_id 4 is not in the dataset"):
        read(tmp_path, "res.json", json.dumps(coco_entries(category_id=9)), video)


def test_coco_masks(tmp_path: Path, video: rt.Video) -> None:
    mask = np.zeros((480, 640), bool)
    mask[20:60, 10:40] = True
    runs = reference_runs(mask)
    kinds = [
        {"size": [480, 640], "counts": runs},
        {"size": [480, 640], "counts": coco_string(runs)},
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


def test_npz_round_trip(tmp_path: Path, video: rt.Video) -> None:
    rng = np.random.default_rng(2)
    masks = rng.random((3, 480, 640)) < 0.5
    masks[1] = False  # no mask
    xyxy = np.array([[1.25, 2, 30, 40], [5, 6, 70, 80], [9, 10, 110, 120]])
    made = rt.Detections(xyxy, np.array([0.9, 0.8, 0.7]), np.array([1, 0, 1]), masks)
    frames = [
        (3, made),
        (5, rt.Detections.empty()),
        (6, made[[0]]),
        (8, rt.Detections(xyxy, made.score, made.class_id)),
    ]
    rt.write_detections_npz(tmp_path / "d.npz", frames, ("cup", "box"), (640, 480))
    found = rt.read_detections(tmp_path / "d.npz", video)
    assert found.class_names == ("cup", "box") and np.unique(found.frame).tolist() == [3, 6, 8]
    for index, expected in frames:
        got = found.at(index)
        np.testing.assert_array_equal(got.xyxy, expected.xyxy)
        np.testing.assert_array_equal(got.class_id, expected.class_id)
        assert (got.masks is None) == (expected.masks is None)
        if got.masks is not None:
            np.testing.assert_array_equal(got.masks, expected.masks)
    again = tmp_path / "again.npz"
    rt.write_detections_npz(again, frames, ("cup", "box"), (640, 480))
    assert again.read_bytes() == (tmp_path / "d.npz").read_bytes()  # same input, same bytes
    assert not list(tmp_path.glob("*.tmp"))


LINE = "1,-1,10,20,30,40,.9\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("d.txt", LINE + "2,-1,10,20\n", "line 2: 4 columns, expected 7"),  # one line differs
        ("d.txt", "1,10,20\n", "line 1: 3 columns, expected 6 to 10"),
        ("d.txt", LINE + "2,-1,10,nan,30,40,.9\n", "line 2: 'nan' is no finite number"),
        ("d.txt", LINE + "2,-1,10,inf,30,40,.9\n", "line 2: 'inf' is no finite"),
        ("d.txt", LINE + "2,-1,10,2O,30,40,.9\n", "line 2: '2O' is no finite number"),
        ("d.txt", "1,-1,10,ten,30,40,.9\n", "line 1: 'ten' is no finite number"),
        ("d.txt", "0,10.5,20.5,40,60,.9,56\n", "needs a header"),  # CSV without a header is no MOT
        ("d.txt", "99,-1,10,20,30,40,.9\n",
         "frames that the video has not .0-based: 98; it has 20.: detections of another video"),
        ("d.txt", "1,-1,.1,.2,.3,.4,.9\n", "normalised"),
        ("d.txt", "1,-1,9000,20,30,40,.9\n", "another video"),  # all outside
        ("d.csv", CSV + "3,1,2\n", "line 4: 3 columns, expected 7"),
        ("d.csv", CSV + "3,1,2,nan,5,.9,56\n", "line 4: 'nan'"),
        ("d.csv", CSV + "3,1,2,4,5,.9,80\n", "line 4: class 80, but there are only 80 class names"),
        ("d.csv", "frame,x1,y1,score\n0,1,2,.9\n", "line 1: no column x2, y2 in the header"),
        ("d.csv", "x1,y1,x2,y2\n1,2,3,4\n", "no column frame"),
        ("d.csv", "frame,x1,y1,x2,y2\n0,100,90,30,40\n", "x, y, w, h where x1, y1, x2, y2"),
        ("d.json", "{", "line 1: not valid JSON"),
        ("d.json", '{"images": []}', "expected COCO results"),
        ("d.json", json.dumps([{"image_id": 1, "bbox": [1, 2, 3, 4]}]),
         "entry 0: .*'category_id': None.*expected two ids"),
        ("d.json", json.dumps(coco_entries(bbox=[1, 2, 3])),
         r"entry 0: .*'bbox': \[1, 2, 3\]}, expected .* a bbox of 4"),
        ("d.json", json.dumps(coco_entries(category_id=500)), "category_id 500 is unknown"),
        ("d.json", json.dumps(coco_entries(segmentation={"size": [48, 64], "counts": [48 * 64]})),
         r"entry 0: mask of .h, w. \[48, 64\] in a video of \(480, 640\)"),
        ("d.json", json.dumps(coco_entries(segmentation={"size": [480, 640], "counts": [8, 9]})),
         r"entry 0: mask of 17 pixels in a video of \(640, 480\)"),
        ("d.json", json.dumps(coco_entries(score=float("nan"))), "entry 0: NaN"),
        ("d.json", json.dumps(coco_entries(image_id="x")), "not as expected"),
        ("d.json", "[1, 2]", "not as expected"),
        ("d.npz", "no zip", "d.npz: damaged"),
    ],
)  # fmt: skip
def test_bad_files_give_one_clear_line(
    tmp_path: Path, video: rt.Video, name: str, text: str, expected: str
) -> None:
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        read(tmp_path, name, text, video)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_missing_file_and_unknown_class(tmp_path: Path, video: rt.Video) -> None:
    with pytest.raises(rt.ReobjError, match="no such file of detections"):
        rt.read_detections(tmp_path / "none.txt", video)
    with pytest.raises(rt.ReobjError, match="--classes: no class chaise among person"):
        read(tmp_path, "a.csv", CSV, video, classes="chaise")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"image_size": np.array([320, 240])},
            r"made for images of \(320, 240\) px, but the video is",
        ),
        ({"xyxy": np.zeros((2, 4))}, r"array xyxy is \(2, 4\), expected shape \(1, 4\)"),
        ({"mask_offsets": np.array([0, 9, 9])}, r"mask_offsets is \(3,\), expected shape \(2,\)"),
        ({"mask_offsets": np.array([0, 1]), "mask_counts": np.uint32([99])}, "mask of 99 pixels"),
        ({"class_id": np.array([7])}, "row 0: class 7, but there are only 1 class names"),
        ({"frame": None}, "array frame is missing"),
    ],
)
def test_bad_npz(tmp_path: Path, video: rt.Video, change: dict[str, Any], expected: str) -> None:
    one = rt.Detections(np.array([[1.0, 2, 3, 4]]), np.array([0.9]), np.array([0]))
    rt.write_detections_npz(tmp_path / "a.npz", [(0, one)], ["x"], (640, 480))
    arrays = {
        key: value
        for key, value in (dict(np.load(tmp_path / "a.npz")) | change).items()
        if value is not None
    }
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(rt.ReobjError, match=expected):
        rt.read_detections(tmp_path / "a.npz", video)


@pytest.mark.parametrize(
    ("name", "text", "expected", "kept"),
    [
        ("d.txt", LINE * 3 + "1,-1,10,20,0,40,.9\n2,-1,1,2,-3,4,1\n",
         "2 boxes without area dropped, the first at line 4", 3),
        ("d.txt", LINE * 3 + "1,-1,700,20,30,40,.9\n", "1 boxes wholly outside the image", 3),
        # partly outside: kept
        ("d.txt", LINE + "1,-1,-20,20,30,40,.9\n1,-1,630,20,30,40,.9\n", "", 3),
        ("d.txt", LINE + "21,-1,10,20,30,40,.9\n50,-1,1,2,3,4,.9\n",
         "2 boxes of frames that the video has not .0-based: 20, 49; it has 20. dropped", 1),
        ("d.txt", LINE.replace(".9", "-1") * 2, "scores are all -1: taken as 1", 2),
        ("d.txt", LINE + LINE.replace(".9", "1.7"), r"scores from 0.9 to 1.7 clipped", 2),
        ("d.txt", "", "no detections in this file", 0),
        ("d.json", "[]", "no detections in this file", 0),
        ("d.json", json.dumps(coco_entries()), "image_id is taken as the 0-based frame", 1),
        ("d.csv", CSV.replace("56", "wok").replace("41", "cup"),
         "1 class names not in the list: wok", 2),
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


@needs_shared
@pytest.mark.parametrize(
    "name", ["redkitchen_7scenes", "office_loop", "studio_room", "livingroom13"]
)
def test_real_detections(name: str) -> None:
    video = rt.Video(SHARED / "data" / name / "images")
    found = rt.read_detections(SHARED / "data" / name / "detections_yolov8s.csv", video)
    assert found.messages == [] and len(found) > 200 and found.class_names == rt.COCO_NAMES
    assert found.frame.max() < video.frame_count


@needs_shared
def test_real_mot_files() -> None:
    folder = SHARED / "data/redkitchen_7scenes"
    found = rt.read_detections(folder / "gt_mot.txt", rt.Video(folder / "images"))
    assert len(found) == 3106 and found.class_names == tuple(f"class {i}" for i in range(1, 6))


# ---- Cache ---------------------------------------------------------------------------------------


def some(index: int, masks: bool = False) -> rt.Detections:
    count = index % 4  # also none at all
    rng = np.random.default_rng(index)
    corner = rng.random((count, 2)) * 20
    found = rng.random((count, 24, 32)) < 0.5 if masks else None
    return rt.Detections(
        np.hstack([corner, corner + 5]), rng.random(count), rng.integers(0, 9, count), found
    )


def assert_same(a: rt.Detections | None, b: rt.Detections) -> None:
    assert a is not None
    for key in ("xyxy", "score", "class_id"):
        np.testing.assert_array_equal(getattr(a, key), getattr(b, key))
    if b.masks is not None and len(b):
        np.testing.assert_array_equal(a.masks, b.masks)


@pytest.mark.parametrize("masks", [False, True])
def test_cache_survives_a_kill_between_flushes(tmp_path: Path, masks: bool) -> None:
    cache = rt.DetectionCache(tmp_path / "c", (32, 24))
    for index in range(0, 300, 2):
        cache.put(index, some(index, masks))
        assert_same(cache.get(index), some(index, masks))
    stored = 150 // rt.CACHE_FRAMES * rt.CACHE_FRAMES
    (tmp_path / "c" / "chunk_000009.npz.tmp").write_bytes(b"half")  # a kill while writing
    reopened = rt.DetectionCache(tmp_path / "c", (32, 24))
    assert reopened.get(2 * stored - 2) is not None and reopened.get(2 * stored) is None
    assert reopened.get(299) is None and reopened.get(298) is None
    for index in range(0, 2 * stored, 2):
        assert_same(reopened.get(index), some(index, masks))
    reopened.put(298, some(298, masks))
    reopened.flush()
    assert_same(rt.DetectionCache(tmp_path / "c", (32, 24)).get(298), some(298, masks))


def test_damaged_cache_files_are_detected_again(tmp_path: Path, caplog: Any) -> None:
    cache = rt.DetectionCache(tmp_path, (32, 24))
    cache.put(1, some(1))
    cache.flush()
    cache.put(2, some(2))
    cache.flush()
    first = tmp_path / "chunk_000000.npz"
    first.write_bytes(first.read_bytes()[:-40])
    reopened = rt.DetectionCache(tmp_path, (32, 24))
    assert reopened.get(1) is None and reopened.get(2) is not None
    assert "detected again" in caplog.text
    assert rt.DetectionCache(tmp_path, (64, 48)).get(2) is None  # made at another working size


def test_masks_of_the_wrong_size_are_refused(tmp_path: Path) -> None:
    cache = rt.DetectionCache(tmp_path, (64, 48))
    cache.put(1, some(1, masks=True))
    with pytest.raises(rt.ReobjError, match=r"masks are \(1, 24, 32\), expected .* \(1, 48, 64\)"):
        cache.flush()


def test_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(rt.ReobjError, match=r"cannot be written .No space left on device"):
        rt.write_detections_npz(tmp_path / "a.npz", [], [], (4, 4))
    assert not list(tmp_path.iterdir())
