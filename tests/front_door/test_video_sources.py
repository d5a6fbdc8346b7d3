"""Videos, images, cameras and streams as users bring them: frames, their order and their times."""

from __future__ import annotations

import contextlib
import dataclasses
import fractions
import functools
import http.server
import itertools
import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
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
from reobj.cameras import Camera
from reobj.maps.stage import session_key
from reobj.poses.keyframes import ResizedVideo
from reobj.poses.sfm import rescale
from reobj.results.names import recording_name
from reobj.results.workspace import Workspace
from reobj.sources import video as sources
from reobj.sources.decoding import settled_times
from reobj.sources.image_files import exif_orientation, header, sorted_names, times_of_names
from reobj.types import Array
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


def test_only_the_requested_range_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --stop 10, not the whole hour of a video."""
    path, grabs = write_video(tmp_path / "a.mkv", UNEVEN, rate=1000), list[Any]()
    whole = rt.Video._decoded
    monkeypatch.setattr(
        rt.Video, "_decoded", lambda self: (grabs.append(f) or f for f in whole(self))
    )
    video = rt.Video(path, rt.InputConfig(stop=10))
    assert video.fps == pytest.approx(9000 / UNEVEN[9], rel=0.01)
    assert video.frame_count == 40 and len(grabs) == 10  # the rest is counted undecoded
    assert len(list(video)) == 10 and video.messages == []


def test_the_overlay_lasts_as_long_as_the_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.webm", UNEVEN, rate=1000, codec="libvpx")
    rows = "".join(f"{i + 1},-1,{5 + i // 4},6,20,20,0.9\n" for i in range(40))
    (tmp_path / "d.txt").write_text(rows)
    args = ["--detections", str(tmp_path / "d.txt"), "--embed", "none"]
    assert rt.main(["track", str(path), "-o", str(tmp_path / "out"), *args]) == 0
    assert len((tmp_path / "out/tracks.txt").read_text().splitlines()) >= 38
    overlay = cv2.VideoCapture(str(next((tmp_path / "out").glob("overlay.*"))))
    last_s = 0.0
    while overlay.grab():
        last_s = overlay.get(cv2.CAP_PROP_POS_MSEC) / 1000
    assert last_s == pytest.approx(UNEVEN[-1] / 1000, abs=0.2)


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
        ([0, 0, 2, 2, 4, 4], [0, 1, 2, 3, 4, 6], 0),  # a coarse clock
        ([0, 1, np.nan, 3, 4], [0, 1, 2, 3, 4], 0),
        ([*range(9), *range(9)], range(18), 1),
        ([*range(9), *range(20), *range(5)], range(34), 2),  # the second passes the first
        ([5, 6, 7, 8, 9, 0, 1, 2, 3, 4], range(5, 15), 1),
    ],
)
def test_times_increase(raw: list[float], settled: list[float], restarts: int) -> None:
    found, count, known = settled_times(np.array(raw, np.float64), 0.5)
    np.testing.assert_allclose(found, settled)
    assert count == restarts and known


@pytest.mark.parametrize("raw", [[0, 0, 0], [np.nan] * 3])
def test_without_times_the_rate_is_assumed(raw: list[float]) -> None:
    found, _, known = settled_times(np.array(raw, np.float64), 0.5)
    np.testing.assert_allclose(found, [0, 0.5, 1])
    assert not known


# ---- Pixels that are not square ------------------------------------------------------------------


def test_pixels_that_are_not_square(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Boxes use stored pixels; cameras are estimated in square ones and get two focal lengths."""
    path = write_video(tmp_path / "a.mp4", EVEN, aspect=fractions.Fraction(4, 3))
    video = rt.Video(path)
    assert video.size == SIZE and video.pixel_aspect == pytest.approx(4 / 3)
    assert "pixels are 4:3, not square" in video.messages[0]
    assert next(iter(ResizedVideo(video, 480))).gray.shape == (48, 85)
    assert next(iter(ResizedVideo(video, 40))).gray.shape == (23, 40)
    args = ["poses", str(path), "-o", str(tmp_path / "out")]
    assert rt.main(args) == 0 and "pixels are 4:3" in capsys.readouterr().err
    square = rt.Video(write_video(tmp_path / "b.mp4", EVEN))
    assert square.pixel_aspect == 1 and square.messages == []


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_a_square_pixel_camera_is_converted_to_stored_pixels(model: str) -> None:
    params = {"SIMPLE_PINHOLE": (500, 320, 240), "SIMPLE_RADIAL": (500, 330, 240, 0.1),
              "RADIAL": (500, 330, 240, 0.1, -0.02),
              "OPENCV": (500, 510, 320, 250, 0.1, 0.02, 0.001, 0.002)}[model]  # fmt: skip
    made = Camera(model, 640, 480, params).to_pycolmap()
    rays = np.array([[0, 0, 1], [0.3, 0.2, 1], [-0.4, 0.1, 1]])
    before: Array = made.img_from_cam(rays)
    rescale(made, (480, 480))
    np.testing.assert_allclose(made.img_from_cam(rays), before * [0.75, 1], atol=1e-9)
    same = Camera(model, 640, 480, params).to_pycolmap()
    rescale(same, (320, 240))
    assert same.model.name == model


# ---- Names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["12:30.mp4", "50%.mp4", "a%03d.mp4", "a[1].mp4", "what?.mp4", "-x.mp4", "a b.mp4", 
     "file:a.mp4", "#1&2.mp4", "A.MP4", "no_suffix", "*.mp4", "zwölf.mp4", "caf\udce9.mp4"],
)  # fmt: skip
def test_files_with_unusual_names_open(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_video(tmp_path / "x.mp4", EVEN[:5]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    video = rt.Video(name)
    assert len(list(video)) == video.frame_count == 5


def test_a_video_with_time_of_day_stamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "x.mp4", EVEN[:9]).rename(tmp_path / "12:30.mp4")
    (tmp_path / "d.txt").write_text("".join(f"{i + 1},-1,5,6,20,20,0.9\n" for i in range(9)))
    monkeypatch.chdir(tmp_path)
    args = ["--detections", "d.txt", "--embed", "none", "-o", "12:31"]
    assert rt.main(["track", "12:30.mp4", *args]) == 0
    assert list(tmp_path.glob("12:31/overlay.*"))


# ---- Files with faults and other formats ---------------------------------------------------------


SHARED = Path(os.environ.get("REOBJ_SHARED", ROOT.parent / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "data").is_dir(), reason="no real recordings: set REOBJ_SHARED"
)


def number_of(image: Pixels) -> int:
    return round(float(image.mean()) / 3)


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("movie") / "a.mp4", EVEN[:20], step=4)


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (rt.InputConfig(every=3), [0, 3, 6, 9, 12, 15, 18]),  # numbers stay those of the source
        (rt.InputConfig(every=4, start=5, stop=15), [5, 9, 13]),
        (rt.InputConfig(start=18), [18, 19]),
        (rt.InputConfig(stop=99), list(range(20))),  # beyond the end
        (rt.InputConfig(every=5, stop=16), [0, 5, 10, 15]),
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


def test_corrupt_frame_is_skipped_counted_and_reported(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE)
    for index in range(20):
        writer.write(picture(index))
    writer.release()
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


def test_frames_that_cannot_be_decoded_to_the_end_are_reported(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", EVEN, noise=True, g="1", bf="0")
    data = bytearray(path.read_bytes())
    data[2 * len(data) // 3 :] = bytes(len(data) - 2 * len(data) // 3)
    path.write_bytes(data)
    video = rt.Video(path)
    assert 20 < len(list(video)) < 30
    assert "is damaged" in str(video.messages) and "1.32 s declared" in str(video.messages)


def test_a_recorded_stream_is_read_across_a_damaged_place(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.ts", EVEN, noise=True)
    data = bytearray(path.read_bytes())
    third = len(data) // 3
    data[third : third + len(data) // 6] = bytes(len(data) // 6)
    path.write_bytes(data)
    frames = list(rt.Video(path))
    assert 25 < len(frames) < 40 and frames[-1].time_s > 1.2


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


def test_a_codec_that_opencv_does_not_have(tmp_path: Path) -> None:
    try:
        path = write_video(tmp_path / "a.mp4", EVEN[:8], codec="libsvtav1", step=4)
    except ValueError:
        pytest.skip("no encoder of AV1 here")
    assert [round(number_of(f.image) / 4) for f in rt.Video(path)] == list(range(8))


def test_a_cover_picture_is_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp3"), "w") as file:
        sound = file.add_stream("mp3", rate=44100)
        cover = file.add_stream("mjpeg")
        cover.width, cover.height, cover.pix_fmt = *SIZE, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic.value
        frame = av.VideoFrame.from_ndarray(picture(9), "bgr24")
        frame.pts = 0
        file.mux([*cover.encode(frame), *cover.encode()])
        heard = av.AudioFrame.from_ndarray(np.zeros((2, 1152), np.float32), "fltp", "stereo")
        heard.sample_rate = 44100
        file.mux([*sound.encode(heard), *sound.encode()])
    with pytest.raises(rt.ReobjError, match="no video in it"):
        rt.Video(tmp_path / "a.mp3")


@pytest.mark.parametrize("name", ["a.webp", "a.gif", "a.png", "a.tif"])
def test_an_animated_image_is_a_video_of_its_frames(name: str, tmp_path: Path) -> None:
    first, *others = [Image.fromarray(picture(8 * i)) for i in range(6)]
    times_ms = {} if name == "a.tif" else {"duration": [100, 300, 100, 100, 100, 100]}
    first.save(tmp_path / name, save_all=True, append_images=others, **times_ms)
    frames = list(rt.Video(tmp_path / name))
    assert [round(number_of(f.image) / 8) for f in frames] == list(range(6))
    times_s = np.arange(6) / 30 if name == "a.tif" else [0, 0.1, 0.4, 0.5, 0.6, 0.7]
    np.testing.assert_allclose([f.time_s for f in frames], times_s, atol=1e-6)


def test_an_animated_image_of_a_folder_is_one_frame(tmp_path: Path) -> None:
    for k in range(3):
        first, second = (Image.fromarray(picture(20 * k + i)) for i in (0, 9))
        first.save(tmp_path / f"{k}.webp", save_all=True, append_images=[second])
    read(tmp_path, 3, "of 3 animated files only the first frame is read: 0.webp")


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
            lambda d: (d / "text.mp4", (d / "text.mp4").write_bytes(b"hello" * 99))[0],
            "cannot be opened",
        ),
        (
            lambda d: (d / "a.png", (d / "a.png").write_bytes(b"x"))[0],
            r"no frame can be decoded \(damaged, or no image",
        ),
        (lambda d: 77, "cannot be opened as a camera"),
        (
            lambda d: (short(d), rt.InputConfig(start=3)),
            "it has only 3 frames",
        ),
        (
            lambda d: (short(d), rt.InputConfig(every=0)),
            "--every must be at lea",
        ),
        (
            lambda d: (short(d), rt.InputConfig(start=-1)),
            "--start, .* at least 0",
        ),
        (
            lambda d: (short(d), rt.InputConfig(stop=-1)),
            "--stop, .* at least 0",
        ),
        (
            lambda d: (short(d), rt.InputConfig(max_size=-9)),
            "max-size at least",
        ),
    ],
)
def test_bad_sources_give_one_clear_line(tmp_path: Path, make: Any, expected: str) -> None:
    made = make(tmp_path)
    source, config = made if isinstance(made, tuple) else (made, rt.InputConfig())
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        rt.Video(source, config)
    assert "\n" not in str(caught.value)


def test_images_of_numbers_that_are_no_colours_have_their_reason(tmp_path: Path) -> None:
    write(tmp_path, numbered("%d.tif"), kind="float")
    with pytest.raises(rt.ReobjError, match=r"no frame can be decoded \(pixels of type float32"):
        rt.Video(tmp_path)


@needs_shared
def test_portrait_phone_clip() -> None:
    video = rt.Video(SHARED / "data/orbit_clips/teddybear.mp4")
    assert video.size == (1080, 1920) and len(list(video)) == 9 and video.messages == []


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

    nerf = write(tmp_path / "nerf", numbered("%d.png", 12))
    write(nerf, numbered("%d.depth.png", 12), kind="depth")
    assert read(nerf, 12, "12 images").names == numbered("%d.png", 12)

    tiff = write(tmp_path / "tiff", numbered("%d.jpg"))
    write(tiff, numbered("%d.tiff"), kind="float")
    read(tiff, 6, "6 images are no frames (one channel with more than 8 bits")

    masks = write(tmp_path / "masks", numbered("%04d.jpg"))
    write(masks, numbered("%04d.png"), kind="gray")  # of the same numbers
    read(masks, 6, "6 images are no frames (one channel, beside images in colour): 0000.png ...")

    few = write(tmp_path / "few", numbered("%04d.jpg", 20))
    write(few, ["0004_mask.png", "0010_mask.png"])  # in colour, of some
    read(few, 20, "2 images are no frames (by their name): 0004_mask")

    named = write(tmp_path / "named", numbered("rgb_%d.png"))
    write(named, numbered("edges_%d.png"))
    with pytest.raises(rt.ReobjError, match=r"two kinds of images, .*edges_0\.png"):
        rt.Video(named)

    nerf = write(tmp_path / "synthetic", numbered("r_%d.png"))
    for name in ("r_%d_depth_0000.png", "r_%d_normal_0000.png"):  # in colour
        write(nerf, numbered(name))
    read(nerf, 6, "6 images are no frames (by their name", "6 images are no frames (by their name")


def test_images_of_a_single_kind_are_frames(tmp_path: Path) -> None:
    read(write(tmp_path / "gray", numbered("%d.png"), kind="gray"), 6)  # EuRoC
    read(write(tmp_path / "masks", numbered("mask_%d.png"), kind="gray"), 6)
    deep = write(tmp_path / "deep", numbered("%d.png"), kind="depth")  # TUM-VI has 16 bits
    read(deep, 6, "taken as pictures; are they depth maps?")
    photos = write(tmp_path / "photos", numbered("IMG_%04d.JPG") + numbered("DSC%05d.jpg", 6, 90))
    write(photos, ["IMG_0007.jpg"], kind="gray")  # in black and white
    read(photos, 13)
    rooms = write(tmp_path / "rooms", ["hall1.jpg", "hall2.jpg", "kitchen1.jpg", "kitchen2.jpg"])
    read(rooms, 4)


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


def test_other_suffixes_of_jpeg(tmp_path: Path) -> None:
    """They were passed over in silence, beside .jpg too."""
    names = ["a1.jpg", "a2.jfif", "a3.jpe", "a4.MPO"]
    write(tmp_path / "im", ["a1.jpg"])
    for name in names[1:]:
        shutil.copy(tmp_path / "im/a1.jpg", tmp_path / "im" / name)
    assert [Path(name).name for name in rt.Video(tmp_path / "im").names] == names


@pytest.mark.parametrize(
    "names",
    [
        ["9.5.png", "10.25.png", "10.5.png", "11.png"],
        ["1.25.png", "1.5.png", "1.75.png", "2.0.png"],
        ["rgb_9.75.png", "rgb_10.0.png", "rgb_10.125.png"],
        ["-0.5.png", "-0.25.png", "0.0.png", "0.25.png"],
        ["-10.png", "-2.png", "3.png"],
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


def test_time_stamps_of_unequal_length_are_times(tmp_path: Path) -> None:
    names = ["9.5.png", "9.75.png", "10.png", "10.25.png"]
    np.testing.assert_allclose(times_of_names(names), [9.5, 9.75, 10, 10.25])
    video = read(write(tmp_path, names), 4)
    assert video.names == names and video.times_are_known and video.fps == pytest.approx(4)
    counted = read(write(tmp_path / "counted", numbered("%d.png")), 6)
    assert not counted.times_are_known


def test_copies_of_a_photo_are_one_view(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Objects have as many views and the same sizes as without them."""
    poses, found = walk(12), []
    size = (poses.camera.width, poses.camera.height)
    for name, count in (("once", 12), ("twice", 24)):
        video = tmp_path / name
        video.mkdir()
        for k in range(count):
            noise = np.random.default_rng(k % 12).integers(0, 256, (*size[::-1], 3), np.uint8)
            cv2.imwrite(str(video / f"{k:02d}.jpg"), noise)
        row = np.arange(count) % 12
        all_poses = dataclasses.replace(
            poses, frame=np.arange(count), time_s=np.arange(count) / 30, part=row * 0,
            cam_from_world=poses.cam_from_world[row], status=poses.status[row],
        )  # fmt: skip
        workspace = Workspace(tmp_path / f"out_{name}")
        workspace.bind(rt.Video(video))
        tracks = tracks_of(all_poses, noise_px=0)
        workspace.save_last(unlinked(all_poses, tracks), all_poses, [])
        assert rt.main(["objects", str(workspace.out), "--set", "output.overlay=none"]) == 0
        said = capsys.readouterr().err
        assert ("12 images are copies of others" in said) == (name == "twice"), said
        data = json.loads((workspace.out / "objects.json").read_text())["objects"]
        found.append([(o["id"], o["views"], *np.round(o["size"], 3)) for o in data])
        assert len((workspace.out / "poses.txt").read_text().splitlines()) >= count
    assert found[0] == found[1] and len(found[0]) == 3


def claiming(kind: str, width: int, height: int, folder: Path) -> bytes:
    """A small image whose header says another size."""
    path = folder / f"small.{kind}"
    cv2.imwrite(str(path), np.zeros((7, 5, 3), np.uint8))
    data = bytearray(path.read_bytes())
    if kind == "jpg":
        at = data.index(b"\xff\xc0")
        data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    else:
        at, form = {"png": (16, ">II"), "bmp": (18, "<ii")}[kind]
        data[at : at + 8] = struct.pack(form, width, height)
        if kind == "png":
            data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    return bytes(data)


@pytest.mark.parametrize("kind", ["png", "jpg", "bmp"])
def test_an_image_of_gigabytes_is_refused_by_its_header(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"a.{kind}").write_bytes(claiming(kind, 30_000, 30_000, tmp_path))
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(rt.ReobjError, match=f"a.{kind}: .*900000000 pixels.* exceeds"):
        rt.Video(tmp_path / f"a.{kind}")


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.jpg", "a.tif", "a.webp"])
def test_headers_cut_anywhere_are_no_error(name: str, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (21, 37, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / name), noise)
    data = (tmp_path / name).read_bytes()
    for end in range(0, len(data), 97):
        (tmp_path / name).write_bytes(data[:end])
        header(tmp_path / name)
        assert exif_orientation(tmp_path / name) == 1


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8, 99])
def test_exif_orientation(kind: str, orientation: int, tmp_path: Path) -> None:
    """Frames are upright, as Pillow shows them."""
    if kind == "WEBP" and cv2.__version__ < "5":
        pytest.skip("OpenCV 4 does not read EXIF of WebP")
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


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "CMYK", "I;16", "1", "L"])
def test_modes_of_pixels(mode: str, tmp_path: Path) -> None:
    """Alpha is dropped, palettes and CMYK are converted, 16 bits become 8."""
    shade = Image.linear_gradient("L")
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    if mode == "I;16":
        cv2.imwrite(str(path), 257 * np.asarray(shade).astype(np.uint16))
    else:
        shade.convert("RGB" if mode == "CMYK" else "L").convert(mode).save(path)
    (frame,) = rt.Video(path)
    if mode != "1":
        expected = np.repeat(np.asarray(shade)[..., None], 3, 2)
        np.testing.assert_allclose(frame.image, expected, atol=6)


START = 1305031102.175304


@pytest.mark.parametrize(
    "names, times_s",
    [
        ([f"{START + i / 30:.6f}.png" for i in range(9)], START + np.arange(9) / 30),  # TUM
        ([f"rgb_{START + i:.3f}.png" for i in range(3)], START + np.arange(3)),
        ([f"{1305031102175 + 33 * i}.jpg" for i in range(3)],
         1305031102.175 + 0.033 * np.arange(3)),
        ([f"{1305031102175304 + 33333 * i}.jpg" for i in range(3)],
         START + 0.033333 * np.arange(3)),
        ([f"{1305031102175304000 + 33333000 * i}.jpg" for i in range(3)],
         START + 0.033333 * np.arange(3)),  # EuRoC, ROS
        ([f"video_{87551170813262 + 33333333 * i}.jpg" for i in range(3)], None),  # not a date
        ([f"{i / 30:.6f}.png" for i in range(4)], np.arange(4) / 30),
        ([f"{1305031102 + 5 * i}.jpg" for i in range(3)], 1305031102 + 5.0 * np.arange(3)),
        (["1305031102.175304.png"], [START]),
        ([f"{i:06d}.png" for i in range(9)], None),  # counters
        ([f"{i:010d}.png" for i in range(9)], None),  # KITTI
        ([f"frame-{i:06d}.color.png" for i in range(9)], None),  # 7-Scenes
        ([f"v1.{i:04d}.png" for i in range(9)], None),  # of a renderer
        ([f"PXL_20230524_{142233123 + 90000 * i}.jpg" for i in range(9)], None),  # hhmmssmmm
        ([f"IMG_20230524{142233 + i}.jpg" for i in range(3)], None),  # YYYYMMDDhhmmss
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


def test_a_recording_is_named_by_its_file_or_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Brackets are part of a name where the file exists, else of a glob."""
    kitchen = tmp_path / "kitchen [1]"
    (kitchen / "rgb").mkdir(parents=True)
    (kitchen / "clip [a].mp4").touch()
    monkeypatch.chdir(kitchen / "rgb")
    for source, name in (
        (kitchen / "clip [a].mp4", "clip [a].mp4"), (kitchen, "kitchen [1]"),
        (kitchen / "rgb", "kitchen [1]"), ("..", "kitchen [1]"), (".", "kitchen [1]"),
        (tmp_path / "rgb" / "*.png", tmp_path.name), (0, "0"), ("http://u:p@host/a.mp4", "a.mp4"),
        ("http://host/" + 300 * "x", 300 * "x"),
    ):  # fmt: skip
        assert recording_name(str(source)) == name


# ---- Sizes and fingerprints ----------------------------------------------------------------------


def test_resizing_averages() -> None:
    """Every pixel of the small image is the mean of the pixels it covers."""
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    small = sources.resized(image, (20, 15))
    assert small.shape == (15, 20, 3)
    mean = image.reshape(15, 8, 20, 8, 3).mean((1, 3))
    np.testing.assert_allclose(small, mean, atol=1.5)  # rounded at each halving
    assert sources.resized(image, (320, 240)).shape == (240, 320, 3)


def test_the_longer_side_is_shrunk() -> None:
    assert sources.shrunk(picture(1, (64, 48)), 32).shape == (24, 32, 3)
    assert sources.shrunk(picture(1, (48, 64)), 32).shape == (32, 24, 3)
    assert sources.shrunk(picture(1, (64, 48)), 500).shape == (48, 64, 3)  # never enlarged
    assert sources.shrunk(picture(1, (300, 2)), 30).shape == (1, 30, 3)


def test_a_changed_source_has_another_fingerprint(movie: Path, tmp_path: Path) -> None:
    fingerprint = sources.source_fingerprint
    folder = write(tmp_path / "im", ["a.png", "b.png"])
    seen = {fingerprint(movie), fingerprint(folder), fingerprint(f"{folder}/a*.png")}
    assert len(seen) == 3 and fingerprint(folder) in seen  # the same again
    os.utime(folder / "a.png", ns=(0, 123))
    seen.add(fingerprint(folder))  # time
    (folder / "a.png").rename(folder / "aa.png")
    seen.add(fingerprint(folder))  # name
    (folder / "aa.png").write_bytes(b"shorter")
    os.utime(folder / "aa.png", ns=(0, 123))
    seen.add(fingerprint(folder))  # size
    assert len(seen) == 6 and {len(f) for f in seen} == {16}
    assert fingerprint("rtsp://camera/1") == "rtsp://camera/1" and fingerprint(0) == "0"


def test_a_file_with_glob_characters_in_its_name(tmp_path: Path) -> None:
    fingerprint = sources.source_fingerprint
    for name in ("det[1].txt", "det1.txt"):
        (tmp_path / name).write_text("1")
    before = fingerprint(tmp_path / "det[1].txt")
    (tmp_path / "det1.txt").write_text("changed")
    assert fingerprint(tmp_path / "det[1].txt") == before
    (tmp_path / "det[1].txt").write_text("changed")
    assert fingerprint(tmp_path / "det[1].txt") != before


def test_copies_have_the_same_content_fingerprint(movie: Path, tmp_path: Path) -> None:
    """Whatever their names, folder and times; of another content of the same size it differs."""

    def fingerprint(source: Path | str | int) -> str:
        return sources.content_fingerprint(sources.files_of(source))

    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        for k in range(20):
            (tmp_path / name / f"{name}_{k:02d}.png").write_bytes(bytes([k]) * 10_000)
        os.utime(tmp_path / name / f"{name}_03.png", (len(name), 0))
    first = fingerprint(tmp_path / "one")
    assert fingerprint(tmp_path / "other") == first != fingerprint(movie)
    (tmp_path / "other" / "other_03.png").write_bytes(bytes([3]) * 9_999 + b"x")
    assert fingerprint(tmp_path / "other") != first
    (tmp_path / "a.mp4").write_bytes(bytes(50_000) + b"x" * 100_000 + bytes(50_000))
    (tmp_path / "b.mp4").write_bytes(bytes(200_000))
    assert fingerprint(tmp_path / "a.mp4") != fingerprint(tmp_path / "b.mp4")
    assert fingerprint("rtsp://camera/1") == fingerprint(0) == ""


def test_a_map_knows_a_recording_by_its_images(tmp_path: Path) -> None:
    """Not by other files of their folder, such as .DS_Store and poses."""
    keys = set()
    for name in ("scan[1]", "copy"):
        (tmp_path / name).mkdir()
        for k in range(3):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), np.full((48, 64, 3), k, np.uint8))
        keys.add(session_key(rt.Video(tmp_path / name)))
        keys.add(session_key(rt.Video(tmp_path / name / "*.png")))
    (tmp_path / "copy" / ".DS_Store").write_text("x")
    (tmp_path / "copy" / "poses.txt").write_text("0 0 0 0 0 0 0 1")
    keys.add(session_key(rt.Video(tmp_path / "copy")))
    assert len(keys) == 1
    cv2.imwrite(str(tmp_path / "copy" / "3.png"), np.full((48, 64, 3), 3, np.uint8))
    assert session_key(rt.Video(tmp_path / "copy")) not in keys


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


class Flaky:
    """cv2.VideoCapture of a source available on some attempts only, with three frames each."""

    def __init__(self, there: str) -> None:
        self.there, self.cameras = there, list[FakeCamera]()

    def __call__(self, *_: Any) -> FakeCamera:
        attempt = len(self.cameras)
        camera = FakeCamera(3)
        if self.there[attempt : attempt + 1] != "x":
            camera.isOpened = lambda: False  # type: ignore[method-assign]
        self.cameras.append(camera)
        return camera


@pytest.mark.parametrize(
    ("reconnect", "there", "frames", "attempts", "waits"),
    [
        (0, "xxx", 2, 1, []),  # no reconnection: the first end is final
        (1, "xxx-", 8, 4, ["0.01", "0.01", "0.01"]),  # every frame resets the attempts
        (3, "x--x---", 5, 7, ["0.01", "0.02", "0.03"] * 2),  # twice as long each time, at most .03
        (2, "x-----", 2, 3, ["0.01", "0.02"]),
    ],
)
def test_a_lost_source_is_reconnected(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
    reconnect: int, there: str, frames: int, attempts: int, waits: list[str],
) -> None:  # fmt: skip
    live = sources.LiveTimes(silent_s=0.2, first_wait_s=0.01, longest_wait_s=0.03)
    flaky = Flaky(there)
    monkeypatch.setattr(cv2, "VideoCapture", flaky)
    video = rt.Video(0, rt.InputConfig(reconnect=reconnect), live)
    seen = [(frame.index, frame.time_s) for frame in video]
    assert video.read == frames and seen[-1][0] == frames - 1  # counted on, whatever was dropped
    assert seen == sorted(seen) and len({index for index, _ in seen}) == len(seen)
    assert len(flaky.cameras) == attempts
    assert re.findall(r"0: ended; reconnecting in ([\d.]+) s", caplog.text) == waits
    assert all(camera.released for camera in flaky.cameras if camera.n)


def test_the_reconnection_delay_does_not_overflow(monkeypatch: pytest.MonkeyPatch) -> None:
    """1,100 attempts: doubling the delay each time would overflow."""
    live = sources.LiveTimes(silent_s=0.1, first_wait_s=1e-9, longest_wait_s=1e-9)
    flaky = Flaky("x")
    monkeypatch.setattr(cv2, "VideoCapture", flaky)
    list(rt.Video(0, rt.InputConfig(reconnect=1100), live))
    assert len(flaky.cameras) == 1101


def test_a_source_at_its_stop_is_not_reconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    flaky = Flaky("xxx")
    monkeypatch.setattr(cv2, "VideoCapture", flaky)
    video = rt.Video(0, rt.InputConfig(stop=2, reconnect=5), live=QUICK)
    assert [frame.index for frame in video] == [0, 1] and len(flaky.cameras) == 1


def test_leaving_early_stops_the_thread_and_frees_the_camera(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = FakeCamera(10**6), FakeCamera(10**6)
    opened(monkeypatch, first, second)
    video = rt.Video("0", live=QUICK)
    before = threading.active_count()
    for frame in video:
        if frame.index >= 5:
            break
    wait_until(lambda: first.released and threading.active_count() <= before)
    again = next(iter(video))
    assert again.image[0, 0, 0] == again.index % 250 and second.n > 0  # opened anew


def test_every_start_and_stop_count_frames_of_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    opened(monkeypatch, FakeCamera(100))
    video = rt.Video(0, rt.InputConfig(start=3, every=4, stop=15), live=QUICK)
    assert {f.index for f in video} <= {3, 7, 11} and video.read == 3


def test_a_driver_that_fails_ends_the_video(monkeypatch: pytest.MonkeyPatch) -> None:
    """Instead of waiting forever. Earlier frames are kept."""
    camera = FakeCamera(10)
    opened(monkeypatch, camera)
    video, failures = rt.Video(0), []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    camera.read = lambda: next(reads)  # type: ignore[method-assign]
    reads = iter([(True, np.zeros((48, 64, 3), np.uint8))])  # then StopIteration
    assert [f.index for f in video] == [0] and len(failures) == 1


def test_a_missing_camera(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert rt.main(["track", "97", "-o", str(tmp_path / "out")]) == 2
    assert "97: cannot be opened as a camera (is it connected?)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


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


@pytest.fixture
def silent(request: pytest.FixtureRequest) -> Iterator[str]:
    """URL of a camera that sends `request.param` only, and keeps the connection open."""
    done, held = threading.Event(), list[socket.socket]()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(0.05)

        def serve() -> None:
            while not done.is_set():
                with contextlib.suppress(OSError):
                    client = listening.accept()[0]
                    held.append(client)
                    client.sendall(request.param)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listening.getsockname()[1]}/camera.mjpg"
        done.set()
        thread.join()
        for client in held:
            client.close()


HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"


@pytest.mark.parametrize("silent", [b"", HEAD, HEAD + b"--frame\r\n"], indirect=True)
def test_an_unresponsive_camera_times_out(silent: str) -> None:
    """OpenCV itself waits for half a minute."""
    began = time.monotonic()
    with pytest.raises(rt.ReobjError, match="cannot be opened"):
        rt.Video(silent, live=sources.LiveTimes(open_s=0.5))
    assert 0.4 < time.monotonic() - began < 5


@pytest.mark.parametrize("stream", [(10, 0.01, 20.0)], indirect=True)
def test_a_stream_that_stalls_ends_soon(stream: tuple[Stream, str]) -> None:
    """Within the documented time plus half a second."""
    url = stream[1]
    video = rt.Video(url, live=QUICK)
    last = began = time.monotonic()
    for _ in video:
        last = time.monotonic()
    assert video.read == 9 and last - began < 5
    assert 0.9 < time.monotonic() - last < 2.0


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
    handler = functools.partial(QuietFiles, directory=str(tmp_path))
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


class QuietFiles(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, without a log."""

    def log_message(self, *_: object) -> None:
        pass


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
    for _ in range(2):  # again into the same folder: current frames, not cached ones
        process = subprocess.Popen(
            [*command, "--detections", str(tmp_path / "det.txt"), "--embed", "none"],
            env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            # a job in the background is started with SIGINT ignored
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        wait_until(lambda p=process: ready.exists() or p.poll() is not None)
        ready.unlink()
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
        (out / "tracks.txt").unlink()


# ---- Processes and packages ----------------------------------------------------------------------


TERMINATED = """
import faulthandler, multiprocessing, signal, sys, threading, time
faulthandler.enable()
from reobj.cameras import import_pycolmap
def job(_):
    import_pycolmap()
    print("up", flush=True)
    time.sleep(60)
thread = threading.Thread(target=import_pycolmap)  # as during a reconstruction
thread.start()
thread.join()
pool = multiprocessing.get_context("fork").Pool(1)
pool.map_async(job, [0])
time.sleep(1)
pool.terminate()
signal.raise_signal(signal.SIGTERM)
"""


def test_a_terminated_process_prints_no_traceback() -> None:
    done = subprocess.run([sys.executable, "-c", TERMINATED], cwd=ROOT, timeout=100, text=True,
                          capture_output=True, check=False)  # fmt: skip
    assert (done.returncode, done.stderr) == (-15, "")
