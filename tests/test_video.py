"""Videos, image folders, cameras and streams, valid and damaged."""

from __future__ import annotations

import contextlib
import functools
import http.server
import itertools
import json
import os
import re
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

import cv2
import numpy as np
import pytest
from PIL import Image

import reobj_track as rt
from reobj.maps.stage import session_key
from reobj.results.names import recording_name
from reobj.sources import video as video_room
from reobj.sources.image_files import Header, exif_orientation, header, times_of_names
from reobj.types import Image as Pixels

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("REOBJ_SHARED", ROOT.parent / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "data").is_dir(), reason="no real recordings: set REOBJ_SHARED"
)

# ---- Files ---------------------------------------------------------------------------------------


def picture(index: int, size: tuple[int, int] = (64, 48)) -> Pixels:
    """A grey image of 12 * its number."""
    return np.full((size[1], size[0], 3), 12 * index % 256, np.uint8)


def number_of(image: Pixels) -> int:
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
        (rt.InputConfig(every=5, stop=16), [0, 5, 10, 15]),
        (rt.InputConfig(every=5, stop=15), [0, 5, 10]),  # not the frame to stop before itself
        (rt.InputConfig(start=9, stop=5), []),
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


def test_images_are_sorted_naturally(tmp_path: Path) -> None:
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
    assert video.skipped == [1, 2, 3]
    assert "2 frames skipped (unreadable): 2.png, 3.png" in video.messages[0]
    assert "1 frames skipped (not 64x48, the size of most): 1.png" in video.messages[1]


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
            "no frame can be decoded",
        ),
        (lambda d: 77, "cannot be opened as a camera"),
        (lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(start=3)), "it has only 3 frames"),
        (
            lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(every=0)),
            "--every must be at lea",
        ),
        (
            lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(start=-1)),
            "--start, .* at least 0",
        ),
        (lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(stop=-1)), "--stop, .* at least 0"),
        (lambda d: (write_video(d / "b.mp4", 3), rt.InputConfig(max_size=-9)), "max-size at least"),
    ],
)
def test_bad_sources_give_one_clear_line(tmp_path: Path, make: Any, expected: str) -> None:
    made = make(tmp_path)
    source, config = made if isinstance(made, tuple) else (made, rt.InputConfig())
    with pytest.raises(rt.ReobjError, match=expected) as caught:
        rt.Video(source, config)
    assert "\n" not in str(caught.value)


class FakeFile:
    """A capture of frames 0, 1, ... of which some are damaged, with or without times."""

    def __init__(
        self, announced: int, frames: int, damaged: set[int], times: bool = True, raw: bool = False
    ) -> None:
        self.announced, self.frames, self.times = announced, frames, times
        self.damaged = set() if raw else damaged  # raw: what is stored, undecoded
        self.n = -1

    def isOpened(self) -> bool:
        return True

    def get(self, what: int) -> float:
        values = {cv2.CAP_PROP_FPS: 10.0, cv2.CAP_PROP_FRAME_COUNT: float(self.announced),
                  cv2.CAP_PROP_POS_MSEC: 100.0 * self.n * self.times}  # fmt: skip
        return values.get(what, 0.0)

    def grab(self) -> bool:
        self.n += 1
        return self.n < self.frames and self.n not in self.damaged

    def retrieve(self) -> tuple[bool, Any]:
        return True, picture(self.n)

    def read(self) -> tuple[bool, Any]:
        return self.retrieve() if self.grab() else (False, None)


def fake_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *args: Any, **options: Any
) -> rt.Video:
    (tmp_path / "a.mp4").touch()
    monkeypatch.setattr(
        cv2, "VideoCapture",
        lambda source, api, params: FakeFile(*args, **options, raw=bool(params)),
    )  # fmt: skip
    return rt.Video(tmp_path / "a.mp4")


@pytest.mark.parametrize(
    ("announced", "frames", "damaged", "read", "message"),
    [
        (100, 98, set(), 98, ""),  # the count is an estimate
        (100, 60, set(), 60, ""),
        (60, 100, set(), 100, ""),
        (0, 8, set(), 8, ""),  # unknown number
        (100, 100, set(range(10, 73)), 37, "63 frames skipped (unreadable): 10, 11"),  # 2 s
        (
            100,
            100,
            set(range(10, 74)),
            10,
            "damaged: 10 frames up to 0.90 s can be read, frames up to 9.90 s are stored",
        ),
        (100, 100, {98, 99}, 98, ""),  # damaged to the end: counted as missing
    ],
)
def test_damaged_and_missing_frames_at_the_end_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, announced: int, frames: int,
    damaged: set[int], read: int, message: str,
) -> None:  # fmt: skip
    video = fake_video(tmp_path, monkeypatch, announced, frames, damaged)
    found = list(video)
    assert [f.index for f in found] == [i for i in range(frames) if i not in damaged][:read]
    assert len(video.messages) == bool(message) and message in "".join(video.messages)


def test_a_file_without_times_uses_its_frame_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = fake_video(tmp_path, monkeypatch, 5, 5, set(), times=False)
    assert [f.time_s for f in video] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert not video.times_are_known and "10 frames a second are assumed" in video.messages[0]


def test_an_unknown_number_of_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = fake_video(tmp_path, monkeypatch, 0, 5, set())
    assert video.expected == 0 and video.frame_count == 5
    limited = rt.Video(tmp_path / "a.mp4", rt.InputConfig(start=1, stop=4, every=2))
    assert limited.expected == 2 and [f.index for f in limited] == [1, 3]


@needs_shared
def test_portrait_phone_clip() -> None:
    video = rt.Video(SHARED / "data/orbit_clips/teddybear.mp4")
    assert video.size == (1080, 1920) and len(list(video)) == 9 and video.messages == []


# ---- Sizes and fingerprints ----------------------------------------------------------------------


def test_resizing_averages() -> None:
    """Every pixel of the small image is the mean of the pixels it covers."""
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    small = video_room.resized(image, (20, 15))
    assert small.shape == (15, 20, 3)
    mean = image.reshape(15, 8, 20, 8, 3).mean((1, 3))
    np.testing.assert_allclose(small, mean, atol=1.5)  # rounded at each halving
    assert video_room.resized(image, (320, 240)).shape == (240, 320, 3)


def test_the_longer_side_is_shrunk() -> None:
    assert video_room.shrunk(picture(1, (64, 48)), 32).shape == (24, 32, 3)
    assert video_room.shrunk(picture(1, (48, 64)), 32).shape == (32, 24, 3)
    assert video_room.shrunk(picture(1, (64, 48)), 500).shape == (48, 64, 3)  # never enlarged
    assert video_room.shrunk(picture(1, (300, 2)), 30).shape == (1, 30, 3)


def test_a_changed_source_has_another_fingerprint(movie: Path, tmp_path: Path) -> None:
    fingerprint = video_room.source_fingerprint
    folder = write_images(tmp_path / "im", ["a.png", "b.png"])
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
    fingerprint = video_room.source_fingerprint
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
        return video_room.content_fingerprint(video_room.files_of(source))

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
    first, second = map(video_room.source_fingerprint, urls)
    assert first != second and first.startswith("http://cam/v.mp4 ")
    assert "secret" not in first + second and video_room.source_fingerprint(urls[0]) == first


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
    with pytest.raises(rt.ReobjError, match=f"a.{kind}: 900000000 pixels, at most 268435456"):
        rt.Video(tmp_path / f"a.{kind}")


@pytest.mark.parametrize("size", [(37, 21), (1, 300), (300, 2)])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.png", []),
        ("a.bmp", []),
        ("a.jpg", []),
        ("a.jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ("a.tif", []),
        ("a.webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
        ("a.webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),  # lossless
    ],
)
def test_the_number_of_pixels_is_read_from_headers(
    name: str, options: list[int], size: tuple[int, int], tmp_path: Path
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (*size[::-1], 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / name), noise, options)
    assert header(tmp_path / name) == Header(size)
    data = (tmp_path / name).read_bytes()
    for end in range(0, len(data), 97):  # cut anywhere: no error
        (tmp_path / name).write_bytes(data[:end])
        header(tmp_path / name)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8, 99])
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


def test_a_name_that_is_no_utf8_gives_one_line(tmp_path: Path, movie: Path) -> None:
    path = os.fsencode(tmp_path) + b"/room\xff.mp4"
    Path(os.fsdecode(path)).write_bytes(movie.read_bytes())
    with pytest.raises(rt.ReobjError, match="the name is not UTF-8; rename the file") as caught:
        rt.Video(os.fsdecode(path))
    str(caught.value).encode()  # can be printed


# ---- Cameras -------------------------------------------------------------------------------------

SIZE = (64, 48)


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


QUICK = video_room.LiveTimes(silent_s=1.0)


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


def test_a_driver_that_hangs_ends_the_video(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stalled stream blocks OpenCV for half a minute; earlier frames are used."""
    gate = threading.Event()
    opened(monkeypatch, FakeCamera(5, {3: gate}))
    video = rt.Video(0, live=QUICK)
    began = time.monotonic()
    assert [f.index for f in video] == [0, 1]
    assert time.monotonic() - began < 10 and "no frame came for 1 s" in video.messages[-1]
    gate.set()


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
    live = video_room.LiveTimes(silent_s=0.2, first_wait_s=0.01, longest_wait_s=0.03)
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
    live = video_room.LiveTimes(silent_s=0.1, first_wait_s=1e-9, longest_wait_s=1e-9)
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


# ---- Streams over HTTP ---------------------------------------------------------------------------


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
    with pytest.raises(rt.ReobjError, match=r"cannot be opened as a stream \(is it there"):
        rt.Video(silent, live=video_room.LiveTimes(open_s=0.5))
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
    assert "no frame came for 1 s: taken as its end" in video.messages[-1]


@pytest.mark.parametrize("stream", [(6, 0.02)], indirect=True)
def test_a_stream_is_reconnected(stream: tuple[Stream, str]) -> None:
    """Over real connections: each serves six frames; fourteen frames need three."""
    live = video_room.LiveTimes(silent_s=0.5, first_wait_s=0.05, longest_wait_s=0.1)
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
        with pytest.raises(rt.ReobjError, match=r"none\.mp4: cannot be opened as a stream"):
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


# ---- Times in the names of images ----------------------------------------------------------------

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
        ([f"video_{87551170813262 + 33333333 * i}.jpg" for i in range(3)],
         87551.170813262 + 0.033333333 * np.arange(3)),  # since the device was switched on
        ([f"{1500000000000000 + 33333333 * i}.jpg" for i in range(3)],
         1500000 + 0.033333333 * np.arange(3)),  # ns, switched on 17 days ago
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
