"""The overlay video file: browser playback; complete or absent."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from browser import Browser

import reobj_track as rt
from reobj.viewer.overlay import FilmWriter, film_fps

SIZE = (320, 240)
FRAMES = 30
FPS = 10.0


def pictures(count: int = FRAMES) -> list[np.ndarray]:
    """A square moving on a red background."""
    made = [np.full((SIZE[1], SIZE[0], 3), (20, 20, 200), np.uint8) for _ in range(count)]
    for i, image in enumerate(made):
        image[100:140, 8 * i : 8 * i + 40] = (200, 200, 20)
    return made


def written(path: Path, images: list[np.ndarray], fps: float = FPS) -> Path:
    writer = FilmWriter(path, fps, SIZE)
    for image in images:
        writer.write(image)
    writer.close(True)
    return writer.path


def test_a_browser_plays_it(tmp_path: Path, browser: Browser) -> None:
    """Opened from disk, also while it loads: the index comes first."""
    path = written(tmp_path / "overlay.mp4", pictures())
    assert list(tmp_path.iterdir()) == [path]
    with av.open(str(path)) as file:
        (stream,) = file.streams
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    (tmp_path / "page.html").write_text(f"<video src={path.name} muted></video>")
    browser.open(tmp_path / "page.html")
    browser.eval("window.v = document.querySelector('video'); v.play()")
    browser.wait("v.currentTime > 0.5")
    assert browser.eval("v.duration") == pytest.approx(FRAMES / FPS, abs=0.1)
    assert browser.eval("[v.videoWidth, v.videoHeight]") == list(SIZE)


def test_same_images_give_the_same_bytes(tmp_path: Path) -> None:
    """Independent of memory layout and repetition: moving noise, for which x264 failed."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (SIZE[1], 400, 3), np.uint8), (0, 0), 2)
    made = set()
    for _ in range(6):
        junk = [bytearray(int(n)) for n in rng.integers(1, 90_000, 20)]
        images = [wide[:, 4 * i : 4 * i + SIZE[0]].copy() for i in range(12)]
        made.add(written(tmp_path / "a.mp4", images).read_bytes())
        del junk
    assert len(made) == 1


@pytest.mark.parametrize("fps", [58.8, 30000 / 1001, 1.0, 0.05])
def test_frame_rates_are_kept(tmp_path: Path, fps: float) -> None:
    found = cv2.VideoCapture(str(written(tmp_path / "a.mp4", pictures(6), fps)))
    assert found.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    assert found.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-6)


@pytest.mark.parametrize(("count", "fps"), [(3, 2.0), (60, 3.0), (300, 10.0)])
def test_photos_play_at_2_to_10_a_second(tmp_path: Path, count: int, fps: float) -> None:
    for i in range(count):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), np.zeros((16, 16, 3), np.uint8))
    assert film_fps(rt.Video(tmp_path)) == fps


@pytest.mark.parametrize("size", [(321, 241), (3840, 2160), (5, 3), (1, 1)])
def test_the_video_has_the_full_size(tmp_path: Path, size: tuple[int, int]) -> None:
    """But for the odd pixel that the codec does not take."""
    writer = FilmWriter(tmp_path / "a.mp4", FPS, size)
    writer.write(np.full((*writer.size[::-1], 3), 99, np.uint8))
    writer.close(True)
    image = cv2.VideoCapture(str(writer.path)).read()[1]
    assert image.shape == (max(size[1] // 2 * 2, 2), max(size[0] // 2 * 2, 2), 3)
    assert abs(image.mean() - 99) < 3
