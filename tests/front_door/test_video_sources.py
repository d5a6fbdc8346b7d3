"""Videos, images, cameras and streams as users bring them: frames, their order and their times."""

from __future__ import annotations

import dataclasses
import fractions
import functools
import http.server
import itertools
import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from simulated import tracks_of, unlinked, walk

import reobj_track as rt
from reobj.poses.keyframes import ResizedVideo
from reobj.results.workspace import Workspace
from reobj.sources import video as sources
from reobj.sources.image_files import (
    exif_orientation,
    settled_times,
    sorted_names,
    times_of_names,
)
from reobj.types import Image as Pixels

ROOT = Path(rt.__file__).resolve().parent
SIZE = (64, 48)


def picture(index: int, size: tuple[int, int] = SIZE) -> Pixels:
    return np.full((size[1], size[0], 3), 3 * index % 256, np.uint8)


# ---- Video files ---------------------------------------------------------------------------------


def write_video(
    path: Path, times_ms: Any, rate: int = 30, codec: str = "libx264", sound_s: float = 0,
    aspect: fractions.Fraction | None = None, noise: bool = False,
    size: tuple[int, int] = SIZE, step: int = 1, **options: str,
) -> Path:  # fmt: skip
    """Write frames at times, in a container that announces a rate."""
    file = av.open(
        str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}
    )
    stream = file.add_stream(codec, rate=rate, options=options)
    stream.width, stream.height = size
    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    stream.codec_context.time_base = fractions.Fraction(1, 1000)
    if aspect:
        stream.sample_aspect_ratio = aspect
    sound = file.add_stream("aac", rate=48000) if sound_s else None
    for index, at in enumerate(times_ms):
        image = np.random.default_rng(index).integers(0, 256, (*size[::-1], 3), np.uint8)
        image = image if noise else picture(step * index, size)
        frame = av.VideoFrame.from_ndarray(image, "bgr24")
        frame.pts, frame.time_base = int(at), fractions.Fraction(1, 1000)
        file.mux(stream.encode(frame))
    file.mux(stream.encode())
    for k in range(int(48000 * sound_s / 1024)):
        heard = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
        heard.sample_rate, heard.pts = 48000, 1024 * k
        heard.time_base = fractions.Fraction(1, 48000)
        file.mux(sound.encode(heard))
    if sound:
        file.mux(sound.encode())
    file.close()
    return path


EVEN = np.arange(40) * 33
UNEVEN = np.cumsum([0, *np.random.default_rng(0).integers(16, 200, 39)])
BFRAMES = {"bf": "3", "b_strategy": "0"}


def twice(path: Path) -> Path:
    """A stream appended to itself: its clock begins again."""
    data = write_video(path, EVEN[:20], **BFRAMES).read_bytes()
    path.write_bytes(data + data)
    return path


FILES = {  # wrong metadata: how to write it, and the true times in ms
    "rate of 10 where frames are 17 ms apart": (
        lambda d: write_video(d / "a.mkv", np.arange(40) * 17, rate=10), np.arange(40) * 17),
    "uneven times": (lambda d: write_video(d / "a.mkv", UNEVEN), UNEVEN),
    "1000 Hz, as browsers record": (
        lambda d: write_video(d / "a.webm", UNEVEN, rate=1000, codec="libvpx"), UNEVEN),
    "the clock begins again": (lambda d: twice(d / "a.ts"), EVEN),
    "frames out of order": (lambda d: write_video(d / "a.mp4", EVEN, **BFRAMES), EVEN),
    "pictures of a webcam": (
        lambda d: write_video(d / "a.avi", EVEN, rate=1000, codec="mjpeg"), EVEN),
    "begins at 5 s": (lambda d: write_video(d / "a.mkv", 5000 + EVEN), EVEN),
    "sound goes on for 3 s": (lambda d: write_video(d / "a.mkv", EVEN, sound_s=4), EVEN),
    "bare H.264": (lambda d: write_video(d / "a.h264", EVEN), None),
}  # fmt: skip


@pytest.mark.parametrize("what", FILES)
def test_frame_count_and_times_are_those_of_the_decoded_frames(what: str, tmp_path: Path) -> None:
    make, times_ms = FILES[what]
    path, count = make(tmp_path), 40
    if times_ms is None:  # FFmpeg assumes 25 frames a second
        times_ms = np.arange(40) * 40
    shown = np.arange(count) % (20 if path.suffix == ".ts" else count)
    (tmp_path / "d.txt").write_text("".join(f"{i + 1},-1,5,6,20,20,0.9\n" for i in range(count)))
    for asked_first in (True, False):  # before it is read, and after
        video = rt.Video(path)
        if asked_first:
            assert video.frame_count == count
        frames = list(video)
        assert [f.index for f in frames] == list(range(count)) and video.frame_count == count
        assert all(abs(f.image.mean() - 3 * shown[f.index]) < 9 for f in frames)
        np.testing.assert_allclose([f.time_s for f in frames], times_ms / 1000, atol=2e-3)
        assert video.fps == pytest.approx(1000 * (count - 1) / np.ptp(times_ms), rel=0.01)
        assert video.times_are_known == (what != "bare H.264")
        kept = rt.read_detections(tmp_path / "d.txt", video)
        assert len(kept) == count and kept.messages == []
        said = {"the clock begins again": "clock restarts 1 time", "bare H.264": "no times"}
        assert len(video.messages) == (what in said) and said.get(what, "") in str(video.messages)
    late = rt.Video(path, rt.InputConfig(start=count - 2))
    assert [f.index for f in late] == [count - 2, count - 1]
    np.testing.assert_allclose([f.time_s for f in late], times_ms[-2:] / 1000, atol=2e-3)
    with pytest.raises(rt.ReobjError, match=f"--start {count}, but it has only {count} frames"):
        rt.Video(path, rt.InputConfig(start=count))


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_truncated_file_is_reported(name: str, tmp_path: Path) -> None:
    data = write_video(tmp_path / name, EVEN, noise=True).read_bytes()
    (tmp_path / name).write_bytes(data[: 2 * len(data) // 3])
    video = rt.Video(tmp_path / name)
    count = len(list(video))
    assert 5 < count < 38 and video.frame_count == count + len(video.skipped)
    message = next(text for text in video.messages if "ends early" in text)
    assert f"{video.frame_count} frames up to" in message and "1.32 s declared" in message
    assert len(list(rt.Video(tmp_path / name, rt.InputConfig(stop=5)))) == 5


@pytest.mark.parametrize(
    ("raw", "settled", "restarts"),
    [
        ([0, 1, 2, 3], [0, 1, 2, 3], 0),
        ([0, 1, 2, 2, 4, 5], [0, 1, 2, 3, 4, 5], 0),  # one stamp written twice
        ([0, 1, 2, 1.5, 4, 5], [0, 1, 2, 3, 4, 5], 0),  # a wrong one
        ([0, 1, np.nan, 3, 4], [0, 1, 2, 3, 4], 0),
        ([*range(9), *range(9)], range(18), 1),
        ([*range(9), *range(20), *range(5)], range(34), 2),  # the second passes the first
    ],
)
def test_times_increase(raw: list[float], settled: list[float], restarts: int) -> None:
    found, count, known = settled_times(np.array(raw, np.float64), 0.5)
    np.testing.assert_allclose(found, settled)
    assert count == restarts and known


# ---- Pixels that are not square ------------------------------------------------------------------


def test_pixels_that_are_not_square(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Boxes use stored pixels; cameras are estimated in square ones and get two focal lengths."""
    path = write_video(tmp_path / "a.mp4", EVEN, aspect=fractions.Fraction(4, 3))
    video = rt.Video(path)
    assert video.size == SIZE and video.pixel_aspect == pytest.approx(4 / 3)
    assert "pixels are 4:3, not square" in video.messages[0]
    assert next(iter(ResizedVideo(video, 480))).gray.shape == (48, 85)
    args = ["poses", str(path), "-o", str(tmp_path / "out")]
    assert rt.main(args) == 0 and "pixels are 4:3" in capsys.readouterr().err
    square = rt.Video(write_video(tmp_path / "b.mp4", EVEN))
    assert square.pixel_aspect == 1 and square.messages == []


# ---- Names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["12:30.mp4", "a%03d.mp4", "a[1].mp4", "file:a.mp4", "no_suffix", "caf\udce9.mp4"],
)  # fmt: skip
def test_files_with_unusual_names_open(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_video(tmp_path / "x.mp4", EVEN[:5]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    video = rt.Video(name)
    assert len(list(video)) == video.frame_count == 5


# ---- Files with faults and other formats ---------------------------------------------------------


def number_of(image: Pixels) -> int:
    return round(float(image.mean()) / 3)


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("movie") / "a.mp4", EVEN[:20], step=4)


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (rt.InputConfig(every=4, start=5, stop=15), [5, 9, 13]),
        (rt.InputConfig(start=18), [18, 19]),
        (rt.InputConfig(stop=99), list(range(20))),  # beyond the end
        (rt.InputConfig(every=5, stop=15), [0, 5, 10]),  # not the frame to stop before itself
        (rt.InputConfig(start=9, stop=5), []),
    ],
)
@pytest.mark.parametrize("kind", ["movie", "images"])
def test_frame_choice(
    movie: Path, tmp_path: Path, kind: str, config: rt.InputConfig, expected: list[int]
) -> None:
    for i in range(20):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture(4 * i))
    source = movie if kind == "movie" else tmp_path
    video = rt.Video(source, config)
    frames = list(video)
    assert [f.index for f in frames] == expected
    assert [round(number_of(f.image) / 4) for f in frames] == expected
    assert video.expected == len(expected)


def test_max_size_shrinks_the_longer_side(movie: Path) -> None:
    video = rt.Video(movie, rt.InputConfig(max_size=32))
    assert video.size == (64, 48) and video.working_size == (32, 24) and video.scale == 0.5
    assert next(iter(video)).image.shape == (24, 32, 3)


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


def test_corrupt_frame_is_skipped_counted_and_reported(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", EVEN[:20], codec="mjpeg")
    data = bytearray(path.read_bytes())
    found = re.finditer(b"00dc", data)
    chunks = (m.start() for m in found if data[m.end() : m.end() + 4] != bytes(4))
    at = next(itertools.islice(chunks, 7, None))  # chunks without bytes fill the time
    length = int.from_bytes(data[at + 4 : at + 8], "little")
    data[at + 8 : at + 8 + length] = bytes(length)
    path.write_bytes(data)
    video = rt.Video(path)
    for _ in range(2):
        frames = list(video)
        assert [f.index for f in frames] == [i for i in range(20) if i != 7]
        assert video.skipped == [7]
        assert all(abs(number_of(f.image) - f.index) <= 1 for f in frames)
    (said,) = video.messages  # once
    assert "1 frames skipped (unreadable): 7" in said


@pytest.mark.parametrize("sizes", [[(64, 48), (128, 96), (64, 48)], [(64, 48), (48, 64)]])
def test_frames_of_another_size_are_left_out_and_said(
    sizes: list[tuple[int, int]], tmp_path: Path
) -> None:
    """A stream whose frames change their size."""
    data = b""
    for size in sizes:
        data += write_video(tmp_path / "part.ts", EVEN[:10], size=size).read_bytes()
    (tmp_path / "a.ts").write_bytes(data)
    video = rt.Video(tmp_path / "a.ts")
    left = [i for i in range(10 * len(sizes)) if sizes[i // 10] == SIZE]
    assert [f.index for f in video] == left and video.frame_count == 10 * len(sizes)
    said = [text for text in video.messages if "10 frames skipped (not 64x48" in text]
    assert len(said) == 1 and ": 10, 11, 12" in said[0]


@pytest.mark.parametrize("name", ["a.webp", "a.gif", "a.png", "a.tif"])
def test_an_animated_image_is_a_video_of_its_frames(name: str, tmp_path: Path) -> None:
    first, *others = [Image.fromarray(picture(8 * i)) for i in range(6)]
    times_ms = {} if name == "a.tif" else {"duration": [100, 300, 100, 100, 100, 100]}
    first.save(tmp_path / name, save_all=True, append_images=others, **times_ms)
    frames = list(rt.Video(tmp_path / name))
    assert [round(number_of(f.image) / 8) for f in frames] == list(range(6))
    times_s = np.arange(6) / 30 if name == "a.tif" else [0, 0.1, 0.4, 0.5, 0.6, 0.7]
    np.testing.assert_allclose([f.time_s for f in frames], times_s, atol=1e-6)


def test_bad_images_are_skipped(tmp_path: Path) -> None:
    folder = write(tmp_path / "im", [f"{i}.png" for i in range(5)])
    cv2.imwrite(str(folder / "1.png"), picture(1, (32, 32)))  # another size
    (folder / "2.png").write_bytes(b"")
    (folder / "3.png").write_bytes(b"no image")
    video = rt.Video(folder)
    assert [f.index for f in video] == [0, 4]
    assert video.skipped == [1, 2, 3]
    assert "2 frames skipped (unreadable): 2.png, 3.png" in video.messages[0]
    assert "1 frames skipped (not 64x48, the size of most): 1.png" in video.messages[1]


def short(folder: Path) -> Path:
    return write_video(folder / "b.mp4", EVEN[:3])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda d: d / "none.mp4", "no such file or folder"),
        (lambda d: d, "no images there"),  # empty folder
        (lambda d: f"{d}/*.png", "no images there"),  # glob without a match
        (lambda d: (d / "empty.mp4", (d / "empty.mp4").write_bytes(b""))[0], "cannot be opened"),
        (
            lambda d: (d / "a.png", (d / "a.png").write_bytes(b"x"))[0],
            "no frame can be decoded: damaged, or",
        ),
        (lambda d: 77, "cannot be opened as a camera"),
        (lambda d: write(d / "f", numbered("%d.tif"), kind="float"), "not images of 8 or 16 bits"),
        (
            lambda d: (short(d), rt.InputConfig(start=3)),
            "it has only 3 frames",
        ),
    ],
)
def test_bad_sources_give_one_clear_line(tmp_path: Path, make: Any, expected: str) -> None:
    made = make(tmp_path)
    source, config = made if isinstance(made, tuple) else (made, rt.InputConfig())
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        rt.Video(source, config)
    assert "\n" not in str(caught.value)


def test_ranges_of_frames_are_checked() -> None:
    with pytest.raises(rt.ReobjError, match="--every must be at least 1"):
        rt.InputConfig(every=0)
    with pytest.raises(rt.ReobjError, match="--start, --stop, --max-size at least 0"):
        rt.InputConfig(start=-1)


# ---- Image folders -------------------------------------------------------------------------------


def write(folder: Path, names: Any, size: tuple[int, int] = SIZE, kind: str = "color") -> Path:
    folder.mkdir(exist_ok=True, parents=True)
    w, h = size
    image = {"color": picture(1, size), "gray": np.full((h, w), 2, np.uint8),
             "depth": np.full((h, w), 1500, np.uint16),
             "float": np.full((h, w), 1.5, np.float32)}[kind]  # fmt: skip
    for name in names:
        assert cv2.imwrite(str(folder / name), image)
    return folder


def numbered(pattern: str, count: int = 6, first: int = 0) -> list[str]:
    return [pattern % i for i in range(first, first + count)]


def read(folder: Path | str, left: int, *said: str) -> rt.Video:
    """Open a folder; check the number of frames and the warnings."""
    video = rt.Video(folder)
    assert len(list(video)) == left, video.messages
    assert len(video.messages) == len(said)
    for message, text in zip(video.messages, said, strict=True):
        assert text in message
    return video


def test_depth_maps_and_masks_beside_images_are_no_frames(tmp_path: Path) -> None:
    scenes = write(tmp_path / "7scenes", numbered("frame-%06d.color.png"))
    write(scenes, numbered("frame-%06d.depth.png"), kind="depth")
    video = read(scenes, 6, "6 images are no frames (one channel with more than 8 bits")
    assert video.names == numbered("frame-%06d.color.png")

    app = write(tmp_path / "app", numbered("frame_%05d.jpg"), (60, 80))
    write(app, numbered("depth_%05d.png"), (25, 19), "depth")
    write(app, numbered("conf_%05d.png"), (25, 19), "gray")
    video = read(app, 6, "6 images are no frames (one", "6 images are no frames (one channel, be")
    assert video.size == (60, 80) and video.names[0] == "frame_00000.jpg"

    masks = write(tmp_path / "masks", numbered("%04d.jpg"))
    write(masks, numbered("%04d.png"), kind="gray")  # of the same numbers
    read(masks, 6, "6 images are no frames (one channel, beside images in colour): 0000.png ...")

    few = write(tmp_path / "few", numbered("%04d.jpg", 20))
    write(few, ["0004_mask.png", "0010_mask.png"])  # in colour, of some
    read(few, 20, "2 images are no frames (by their name): 0004_mask")

    nerf = write(tmp_path / "synthetic", numbered("r_%d.png"))
    for name in ("r_%d_depth_0000.png", "r_%d_normal_0000.png"):  # in colour
        write(nerf, numbered(name))
    read(nerf, 6, "6 images are no frames (by their name", "6 images are no frames (by their name")


def test_two_kinds_of_images_need_a_glob(tmp_path: Path) -> None:
    stereo = write(tmp_path / "ste[re]o", [*numbered("left_%03d.png"), *numbered("right_%03d.png")])
    with pytest.raises(rt.ReobjError, match=r"left_000\.png and right_000\.png; which") as caught:
        rt.Video(stereo)
    chosen = str(caught.value).partition("such as '")[2].rstrip("'")
    assert read(chosen, 6).names == numbered("left_%03d.png")
    read(f"{stereo}/*.png", 12)
    both = write(tmp_path / "both", [*numbered("%d.jpg"), *numbered("%d.png")])
    with pytest.raises(rt.ReobjError, match=r"0\.jpg and 0\.png|0\.png and 0\.jpg"):
        rt.Video(both)


def test_the_size_is_that_of_most_images(tmp_path: Path) -> None:
    mixed = write(tmp_path / "mixed", numbered("%03d.png", 9, 1))
    write(mixed, ["000.png"], (32, 24))
    video = read(mixed, 9, "1 frames skipped (not 64x48, the size of most): 000.png")
    assert video.size == SIZE and [f.index for f in video] == list(range(1, 10))
    turned = write(tmp_path / "turned", numbered("%03d.jpg", 7))
    for name in ("000.jpg", "003.jpg"):  # EXIF, orientation 6: turn clockwise
        data = (turned / name).read_bytes()
        tag = struct.pack(">2sHIHHHIHHI", b"MM", 42, 8, 1, 0x0112, 3, 1, 6, 0, 0)
        segment = b"\xff\xe1" + struct.pack(">H", len(tag) + 8) + b"Exif\0\0" + tag
        (turned / name).write_bytes(data[:2] + segment + data[2:])
    video = read(turned, 5, "2 frames skipped (not 64x48, the size of most): 000.jpg, 003.jpg")
    assert video.size == SIZE
    every = tmp_path / "every"
    for k in range(6):
        write(every, [f"{k}.png"], (64, 40 + k // 2))
    with pytest.raises(rt.ReobjError, match="6 images of 3 sizes, at most 2 of the same"):
        rt.Video(every)


def test_unread_images_are_counted(tmp_path: Path) -> None:
    phone = write(tmp_path / "phone", ["IMG_0003.JPG", "IMG_0004.jpg"])
    for k in range(8):
        (phone / f"IMG_{k + 10:04d}.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    (phone / "._IMG_0003.JPG").write_bytes(b"")  # macOS
    (phone / "IMG_0003.AAE").write_text("")
    read(phone, 2, "8 .HEIC files are not read; convert them to .jpg")
    for name in ("IMG_0003.JPG", "IMG_0004.jpg"):
        (phone / name).unlink()
    with pytest.raises(rt.ReobjError, match=r"no images there .*; 8 \.HEIC files are not read"):
        rt.Video(phone)
    with pytest.raises(rt.ReobjError, match=r"\.HEIC files are not read; convert it"):
        rt.Video(phone / "IMG_0010.HEIC")
    with pytest.raises(rt.ReobjError, match=r"no images there .* its folders: phone"):
        rt.Video(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        ["v1.8.png", "v1.9.png", "v1.10.png", "v1.11.png"],  # two counters
        ["f-1.png", "f-2.png", "f-10.png"],  # a hyphen
        ["IMG_0001.jpg", "IMG_0001(1).jpg", "IMG_0001(2).jpg", "IMG_0002.jpg"],
        ["a 1.jpg", "a 1 (1).jpg", "a 2.jpg"],
        ["IMG_0001.JPG", "img_0002.jpg", "IMG_0003.JPG"],
        ["1.png", "02.png", "003.png", "10.png"],
        ["999999999.png", "1000000000.png"],
        [f"{'9' * 24}.png", f"1{'0' * 24}.png"],
        ["frame-2.color.png", "frame-10.color.png"],
    ],
)
def test_names_are_sorted_by_their_numbers(names: list[str]) -> None:
    for order in (names[::-1], sorted(names), names):
        assert sorted_names(order) == names


def test_copies_of_a_photo_are_one_view(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = walk(12)
    size = (poses.camera.width, poses.camera.height)
    row = np.arange(24) % 12
    (tmp_path / "twice").mkdir()
    for k in range(24):
        noise = np.random.default_rng(k % 12).integers(0, 256, (*size[::-1], 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"twice/{k:02d}.jpg"), noise)
    poses = dataclasses.replace(
        poses, frame=np.arange(24), time_s=np.arange(24) / 30, part=row * 0,
        cam_from_world=poses.cam_from_world[row], status=poses.status[row],
    )  # fmt: skip
    workspace = Workspace(tmp_path / "out")
    workspace.bind(rt.Video(tmp_path / "twice"))
    workspace.save_last(unlinked(poses, tracks_of(poses, noise_px=0)), poses, [])
    assert rt.main(["objects", str(workspace.out), "--set", "output.overlay=none"]) == 0
    assert "12 images are copies of others" in capsys.readouterr().err
    objects = json.loads((workspace.out / "objects.json").read_text())["objects"]
    assert [o["views"] for o in objects] == [12] * 3


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@pytest.mark.parametrize("orientation", [3, 6, 8, 99])
def test_exif_orientation(kind: str, orientation: int, tmp_path: Path) -> None:
    """Frames are upright, as Pillow shows them."""
    path = tmp_path / f"a.{kind.lower()}"
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:24, :32] = 200
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(pixels).save(path, kind, exif=exif, lossless=True)
    turned = orientation if orientation < 9 else 1
    assert exif_orientation(path) == turned
    expected = pixels if turned == 1 else np.rot90(pixels, {3: 2, 6: 3, 8: 1}[turned])
    (frame,) = rt.Video(path)
    np.testing.assert_allclose(frame.image, expected, atol=9)


START = 1305031102.175304


@pytest.mark.parametrize(
    "names, times_s",
    [
        ([f"{START + i / 30:.6f}.png" for i in range(9)], START + np.arange(9) / 30),  # TUM
        ([f"{1305031102175 + 33 * i}.jpg" for i in range(3)],
         1305031102.175 + 0.033 * np.arange(3)),
        ([f"{1305031102175304000 + 33333000 * i}.jpg" for i in range(3)],
         START + 0.033333 * np.arange(3)),  # EuRoC, ROS
        ([f"video_{87551170813262 + 33333333 * i}.jpg" for i in range(3)], None),  # not a date
        ([f"{i / 30:.6f}.png" for i in range(4)], np.arange(4) / 30),
        ([f"{1305031102 + 5 * i}.jpg" for i in range(3)], 1305031102 + 5.0 * np.arange(3)),
        (["1305031102.175304.png"], [START]),
        ([f"{i:010d}.png" for i in range(9)], None),  # KITTI
        ([f"v1.{i:04d}.png" for i in range(9)], None),  # of a renderer
        ([f"PXL_20230524_{142233123 + 90000 * i}.jpg" for i in range(9)], None),  # hhmmssmmm
        (["b.png", "a.png"], None),
        ([], None),
    ],
)  # fmt: skip
def test_times_are_read_from_names_that_are_time_stamps(names, times_s):
    found = times_of_names(names)
    assert (found is None) == (times_s is None)
    if times_s is not None:
        np.testing.assert_allclose(found, times_s, atol=1e-6)


def test_frames_have_the_times_of_their_names(tmp_path):
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{START + i / 10:.6f}.png"), np.zeros((48, 64, 3), np.uint8))
    video = rt.Video(tmp_path, rt.InputConfig(start=1, every=2))
    found = [(frame.index, frame.time_s) for frame in video]
    np.testing.assert_allclose(found, [(1, START + 0.1), (3, START + 0.3)], atol=1e-6)
    assert video.fps == pytest.approx(10)


# ---- Sizes and fingerprints ----------------------------------------------------------------------


def test_fingerprints_of_urls_are_unique_without_secrets() -> None:
    urls = [f"http://me:secret@cam/v.mp4?id={i}&pwd=secret" for i in range(2)]
    first, second = map(sources.source_fingerprint, urls)
    assert first != second and first.startswith("http://cam/v.mp4 ")
    assert "secret" not in first + second and sources.source_fingerprint(urls[0]) == first


# ---- Cameras and streams -------------------------------------------------------------------------


class FakeCamera:
    """A capture whose frame n is grey with value n; it blocks at a closed gate."""

    def __init__(self, count: int, gates: dict[int, threading.Event] | None = None) -> None:
        self.count, self.gates, self.n, self.released = count, gates or {}, 0, False

    def isOpened(self) -> bool:
        return True

    def get(self, _: int) -> float:
        return -1.0

    def release(self) -> None:
        self.released = True

    def read(self) -> tuple[bool, Any]:
        if self.n in self.gates:
            assert self.gates[self.n].wait(20)
        if self.n >= self.count:
            return False, None
        self.n += 1
        if self.n > 200:
            time.sleep(0.001)
        return True, np.full((SIZE[1], SIZE[0], 3), (self.n - 1) % 250, np.uint8)


QUICK = sources.LiveTimes(silent_s=1.0)


def opened(monkeypatch: pytest.MonkeyPatch, *cameras: FakeCamera) -> None:
    left = iter(cameras)
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: next(left))


def wait_until(condition: Any) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_slow_consumer_sees_the_newest_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """While frame 1 is processed, 2 to 10 arrive: 9 and 10 are next, the others are dropped."""
    gates = {2: threading.Event(), 11: threading.Event()}
    camera = FakeCamera(14, gates)
    opened(monkeypatch, camera)
    video = rt.Video(0, live=QUICK)  # takes frame 0 to know the size
    assert video.is_live and video.size == SIZE and video.frame_count == 0
    frames = iter(video)
    seen = [next(frames)]
    gates[2].set()
    wait_until(lambda: camera.n == 11 and video.read == 10)
    seen += [next(frames), next(frames)]
    assert video.dropped == 7
    gates[11].set()
    wait_until(lambda: camera.n == 14 and video.read == 13)
    seen += frames
    assert [int(f.image[0, 0, 0]) for f in seen] == [1, 9, 10, 12, 13]
    assert [f.index for f in seen] == [0, 8, 9, 11, 12]  # dropped frames are counted
    assert (video.read, video.dropped) == (13, 8) and camera.released
    assert all(a.time_s <= b.time_s for a, b in itertools.pairwise(seen))


def test_every_start_and_stop_count_frames_of_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    opened(monkeypatch, FakeCamera(100))
    video = rt.Video(0, rt.InputConfig(start=3, every=4, stop=15), live=QUICK)
    assert {f.index for f in video} <= {3, 7, 11} and video.read == 3


class Stream(http.server.ThreadingHTTPServer):
    """MJPEG stream of an IP camera; each client gets all frames."""

    def __init__(self, count: int, pause_s: float, stalls_s: float = 0.0) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.count, self.pause_s, self.sent = count, pause_s, 0
        self.stalls_s, self.over = stalls_s, threading.Event()


class Handler(http.server.BaseHTTPRequestHandler):
    server: Stream

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        noise = np.random.default_rng(0).integers(0, 256, (240, 400, 3), dtype=np.uint8)
        still = cv2.GaussianBlur(noise, (0, 0), 2)[:, :320]
        for n in range(self.server.count):
            cv2.rectangle(still, (0, 0), (19, 19), (n % 250,) * 3, -1)
            jpeg = cv2.imencode(".jpg", still)[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + jpeg + b"\r\n")
            except OSError:  # the reader has gone
                return
            self.server.sent += 1
            time.sleep(self.server.pause_s)
        self.server.over.wait(self.server.stalls_s)


@pytest.fixture
def stream(request: pytest.FixtureRequest) -> Iterator[tuple[Stream, str]]:
    server = Stream(*request.param)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server, f"http://me:secret@127.0.0.1:{server.server_port}/camera.mjpg?pwd=secret"
    server.over.set()
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("stream", [(40, 0.005)], indirect=True)
def test_a_stream_is_read_to_its_end(stream: tuple[Stream, str]) -> None:
    url = stream[1]
    video = rt.Video(url, live=QUICK)
    assert video.is_live and video.size == (320, 240) and "secret" not in video.source
    seen = []
    for frame in video:
        seen.append((frame.index, round(float(frame.image[5:15, 5:15].mean()))))
        time.sleep(0.02)
    assert video.read == 39 and len(seen) + video.dropped == 39  # one more gave the size
    assert seen[-1][0] == 38 and [i for i, _ in seen] == sorted({i for i, _ in seen})
    for index, grey in seen:
        assert abs(grey - index - 1) <= 2  # the number in the picture; JPEG


@pytest.mark.parametrize("stream", [(6, 0.02)], indirect=True)
def test_a_stream_is_reconnected(stream: tuple[Stream, str]) -> None:
    """Over real connections: each serves six frames; fourteen frames need three."""
    live = sources.LiveTimes(silent_s=0.5, first_wait_s=0.05, longest_wait_s=0.1)
    video = rt.Video(stream[1], rt.InputConfig(reconnect=2, stop=14), live)
    seen = [frame.index for frame in video]
    assert video.read == 14 and seen == sorted(set(seen))


def test_a_file_behind_a_url_is_read_like_a_file(tmp_path: Path) -> None:
    """Its length is known: no thread, no dropped frames, repeatable."""
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25, SIZE)
    for n in range(12):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 20 * n, np.uint8))
    writer.release()
    files = http.server.SimpleHTTPRequestHandler
    handler = functools.partial(
        type("Quiet", (files,), {"log_message": Handler.log_message}), directory=str(tmp_path)
    )
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/"
        video = rt.Video(url + "a.mp4", rt.InputConfig(every=3))
        assert not video.is_live and video.frame_count == 12
        for _ in range(2):
            assert [f.index for f in video] == [0, 3, 6, 9]
        with pytest.raises(rt.ReobjError, match=r"none\.mp4: cannot be opened"):
            rt.Video(url + "none.mp4")
        server.shutdown()


SAYS_WHEN_IT_TRACKS = """
import pathlib, sys, reobj_track as rt
frames = rt.Video.__iter__
def counted(self):
    for number, frame in enumerate(frames(self)):
        if number == 40:
            pathlib.Path(sys.argv[1]).touch()
        yield frame
rt.Video.__iter__ = counted
sys.exit(rt.main(sys.argv[2:]))
"""


@pytest.mark.parametrize("stream", [(10**6, 0.01)], indirect=True)
def test_ctrl_c_leaves_complete_files(stream: tuple[Stream, str], tmp_path: Path) -> None:
    """A live run ended by SIGINT: exit code 0, complete files, and losses are reported."""
    server, url = stream
    ready = tmp_path / "ready"
    rows = [f"{i},-1,{x},60,40,50,0.9,-1,-1,-1" for i in range(1, 5000) for x in (100, 220)]
    (tmp_path / "det.txt").write_text("\n".join(rows) + "\n")
    out, env = tmp_path / "out", os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", SAYS_WHEN_IT_TRACKS, str(ready), "run", url, "-o", str(out)]
    process = subprocess.Popen(
        [*command, "--detections", str(tmp_path / "det.txt"), "--embed", "none"],
        env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        # a job in the background is started with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    wait_until(lambda: ready.exists() or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    mot = np.loadtxt(out / "tracks.txt", delimiter=",")
    assert set(mot[:, 1]) == {1, 2} and len(mot) > 20
    data = json.loads((out / "objects.json").read_text())
    assert {entry["id"] for entry in data["objects"]} == {1, 2}
    assert any(w.startswith("live: ") and "dropped" in w for w in data["warnings"])
    assert "identities only" in errors and "2 objects: " in text
    files = [p for p in out.rglob("*") if p.suffix in (".json", ".html", ".txt")]
    written = "".join(p.read_text() for p in files) + text + errors
    assert "secret" not in written and str(server.server_port) in written
    assert not list(out.rglob(".part*"))
