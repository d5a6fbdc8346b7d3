"""Video files and image folders as users bring them: frames, their order and their times."""

from __future__ import annotations

import fractions
import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt
from reobj import runtime
from reobj.cameras import Camera
from reobj.poses.keyframes import ResizedVideo
from reobj.poses.sfm import rescale
from reobj.sources.container_files import settled_times
from reobj.sources.image_files import sorted_names, times_of_names
from reobj.types import Array, Image

ROOT = Path(rt.__file__).resolve().parent
SIZE = (64, 48)


def picture(index: int, size: tuple[int, int] = SIZE) -> Image:
    return np.full((size[1], size[0], 3), 3 * index % 256, np.uint8)


# ---- Video files ---------------------------------------------------------------------------------


def write_video(
    path: Path, times_ms: Any, rate: int = 30, codec: str = "libx264", sound_s: float = 0,
    aspect: fractions.Fraction | None = None, noise: bool = False, **options: str,
) -> Path:  # fmt: skip
    """Write frames at times, in a container that announces a rate."""
    av = pytest.importorskip("av")
    file = av.open(
        str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}
    )
    stream = file.add_stream(codec, rate=rate, options=options)
    stream.width, stream.height = SIZE
    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    stream.codec_context.time_base = fractions.Fraction(1, 1000)
    if aspect:
        stream.sample_aspect_ratio = aspect
    sound = file.add_stream("aac", rate=48000) if sound_s else None
    for index, at in enumerate(times_ms):
        image = np.random.default_rng(index).integers(0, 256, (*SIZE[::-1], 3), np.uint8)
        frame = av.VideoFrame.from_ndarray(image if noise else picture(index), "bgr24")
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
    if times_ms is None:  # OpenCV 4 announces 1000 frames a second, OpenCV 5 25
        times_ms = np.arange(40) * (40 if cv2.__version__ >= "5" else 1000 / 30)
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
        video_module_cache_cleared()
    late = rt.Video(path, rt.InputConfig(start=count - 2))
    assert [f.index for f in late] == [count - 2, count - 1]
    np.testing.assert_allclose([f.time_s for f in late], times_ms[-2:] / 1000, atol=2e-3)
    with pytest.raises(rt.ReobjError, match=f"--start {count}, but it has only {count} frames"):
        rt.Video(path, rt.InputConfig(start=count))


def video_module_cache_cleared() -> None:
    from reobj.sources import video

    video._measured_clocks.clear()


def test_only_the_requested_range_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --stop 10, not the whole hour of a video."""
    path, grabs = write_video(tmp_path / "a.mkv", UNEVEN, rate=1000), list[float]()
    whole = rt.Video._grabbed
    monkeypatch.setattr(
        rt.Video, "_grabbed", lambda self, c: (grabs.append(t) or t for t in whole(self, c))
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


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_a_truncated_file_is_reported(name: str, tmp_path: Path) -> None:
    codec = "mjpeg" if name == "a.avi" else "libx264"
    data = write_video(tmp_path / name, EVEN, codec=codec, noise=True).read_bytes()
    (tmp_path / name).write_bytes(data[: 2 * len(data) // 3])
    video = rt.Video(tmp_path / name)
    count = len(list(video))
    assert 5 < count < 38 and video.frame_count == count + len(video.skipped)
    message = next(text for text in video.messages if "ends early" in text)
    assert f"ends early: {len(data) - 2 * len(data) // 3} bytes are missing" in message
    assert f"{video.frame_count} frames up to" in message
    assert len(list(rt.Video(tmp_path / name, rt.InputConfig(stop=5)))) == 5


def test_a_file_that_stops_decoding_is_reported(tmp_path: Path) -> None:
    """The file has its full length, but a damaged section after which nothing can be decoded."""
    path = write_video(tmp_path / "a.mkv", EVEN, codec="mjpeg", noise=True)
    data = bytearray(path.read_bytes())
    data[len(data) // 4 : 3 * len(data) // 4] = bytes(3 * len(data) // 4 - len(data) // 4)
    path.write_bytes(data)
    video = rt.Video(path)
    assert len(list(video)) < 20 and "damaged" in str(video.messages)
    assert "ends early" not in str(video.messages)


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
     "file:a.mp4", "#1&2.mp4", "A.MP4", "no_suffix", "*.mp4", "zwölf.mp4"],
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
    read(few, 20, "2 images are no frames (by its name; others have the same numbers): 0004_mask")

    named = write(tmp_path / "named", numbered("rgb_%d.png"))
    write(named, numbered("edges_%d.png"))
    assert read(named, 6, "by its name").names == numbered("rgb_%d.png")


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


# ---- Processes and packages ----------------------------------------------------------------------


FORKED = """
import multiprocessing, sys
import cv2, numpy as np
import reobj_track
from reobj.poses.keyframes import follow_points
from reobj.runtime import guard_forks
guard_forks()  # as `Video` does
def use(threads):
    image = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    for n in threads:
        cv2.setNumThreads(n)
        for _ in range(3):
            follow_points(image, image, np.random.default_rng(1).uniform(50, 400, (500, 2)))
            cv2.GaussianBlur(image, (0, 0), 5)
    return cv2.getNumThreads()
use([4])
context = multiprocessing.get_context("fork")
with context.Pool(2) as pool:
    print(pool.map_async(use, [[1, 3], [0], [2, 1]]).get(60), cv2.getNumThreads())
    use([4])
    print(pool.map_async(use, [[2]]).get(60), cv2.getNumThreads())
"""


def test_threads_of_opencv_in_a_forked_process() -> None:
    """OpenCV would wait forever for the threads of the parent process."""
    done = subprocess.run([sys.executable, "-c", FORKED], cwd=ROOT, timeout=100, text=True,
                          capture_output=True, check=True)  # fmt: skip
    assert done.stdout.splitlines() == ["[3, 1, 1] 4", "[2] 4"]


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


@pytest.mark.parametrize("file", ["pyproject.toml", "requirements.txt", ".ci/lowest.txt"])
def test_lower_bounds_are_the_same_everywhere(file: str) -> None:
    text = (ROOT / file).read_text()
    for package, least in runtime.LEAST_VERSIONS.items():
        assert re.search(rf'^ *"?{package}[=>]={re.escape(least)}', text, re.MULTILINE), package


@pytest.mark.parametrize(
    ("package", "version", "said"),
    [
        ("cv2", "4.9.0", "OpenCV 4.9.0 is installed, 4.10 or later is needed: pip install"),
        ("cv2", "3.4.18-dev", "OpenCV 3.4.18-dev is installed"),
        ("numpy", "1.24.4", "numpy 1.24.4 is installed, 1.26.4 or later is needed"),
        ("cv2", "4.10.0", ""),
        ("cv2", "6.0.0-pre", ""),
    ],
)
def test_a_package_that_is_too_old_is_one_line(
    package: str, version: str, said: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    installed = runtime.importlib.metadata.version
    if package == "cv2":
        monkeypatch.setattr(cv2, "__version__", version)
    monkeypatch.setattr(runtime.importlib.metadata, "version",
                        lambda name: version if name == package else installed(name))  # fmt: skip
    runtime.check_versions.cache_clear()
    code = rt.main(["track", str(tmp_path / "none.mp4"), "-o", str(tmp_path / "out")])
    runtime.check_versions.cache_clear()
    text = capsys.readouterr().err
    assert code == 2 and text.count("\n") == 1 and (said or "no such file") in text
