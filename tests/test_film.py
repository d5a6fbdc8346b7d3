"""The overlay video: browser playback; complete or absent."""

from __future__ import annotations

import http.server
import os
import queue
import shutil
import subprocess
import sys
import threading
import urllib.parse
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

import reobj_track as rt
from reobj.results.film import FilmWriter
from reobj.results.overlay import film_fps

ROOT = Path(__file__).resolve().parent.parent
SIZE = (320, 240)
FRAMES = 30
FPS = 10.0
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync "
    "--disable-background-networking --disable-component-update "
    "--autoplay-policy=no-user-gesture-required"
).split()
PAGE = """<video src="%s" muted></video><script>
const v = document.querySelector("video")
const say = text => { new Image().src = "http://127.0.0.1:%d/" + text }
v.onerror = () => say(`error ${v.error.code}`)
v.ontimeupdate = () => {
  if (v.currentTime < 0.5) return
  const c = new OffscreenCanvas(v.videoWidth, v.videoHeight).getContext("2d")
  c.drawImage(v, 0, 0)
  say(`${v.readyState} ${v.duration} ${c.getImageData(9, 9, 1, 1).data.join(" ")}`)
}
v.play().catch(error => say(error))
</script>"""


def pictures(count: int = FRAMES) -> list[np.ndarray]:
    """A square moving on a red background."""
    made = [np.full((SIZE[1], SIZE[0], 3), (20, 20, 200), np.uint8) for _ in range(count)]
    for i, image in enumerate(made):
        image[100:140, 8 * i : 8 * i + 40] = (200, 200, 20)
    return made


def written(path: Path, images: list[np.ndarray]) -> Path:
    writer = FilmWriter(path, FPS, SIZE)
    for image in images:
        writer.write(image)
    writer.close(True)
    return writer.path


def test_every_browser_can_play_it(tmp_path: Path) -> None:
    """Also while it loads: the index comes first."""
    path = written(tmp_path / "overlay.mp4", pictures(3))
    assert list(tmp_path.iterdir()) == [path]
    with av.open(str(path)) as file:
        (stream,) = file.streams
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


class Listener(http.server.BaseHTTPRequestHandler):
    """Collects the messages of a page, sent as requested paths."""

    said: queue.Queue[str]

    def do_GET(self) -> None:
        self.said.put(urllib.parse.unquote(self.path[1:]))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None: ...


def test_a_browser_plays_it(tmp_path: Path) -> None:
    """Opened from disk: it is decoded, has the right length and plays."""
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    path = written(tmp_path / "overlay.mp4", pictures())
    listener = type("One", (Listener,), {"said": queue.Queue()})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), listener)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = tmp_path / "page.html"
    page.write_text(PAGE % (path.name, server.server_port))
    command = [CHROMIUM, *FLAGS, "--allow-file-access-from-files",
               f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()]  # fmt: skip
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, **quiet)
    try:
        said = listener.said.get(timeout=60)
    finally:
        process.terminate()
        process.wait(20)
        server.shutdown()
        server.server_close()
    ready, seconds, *rgba = [float(word) for word in said.split()]
    assert ready >= 2 and seconds == pytest.approx(FRAMES / FPS, abs=0.1)
    np.testing.assert_allclose(rgba[:3], [200, 20, 20], atol=12)


def test_frames_are_decoded_in_order(tmp_path: Path) -> None:
    images = pictures()
    capture = cv2.VideoCapture(str(written(tmp_path / "a.mp4", images)))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(FPS)
    for image in images:
        assert np.abs(capture.read()[1].astype(int) - image).mean() < 8
    assert not capture.read()[0]


def test_same_images_give_the_same_bytes(tmp_path: Path) -> None:
    """Independent of memory layout and repetition: moving noise, for which x264 failed."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (SIZE[1], 400, 3), np.uint8), (0, 0), 2)
    made = set()
    for _ in range(8):
        junk = [bytearray(int(n)) for n in rng.integers(1, 90_000, 20)]
        images = [wide[:, 4 * i : 4 * i + SIZE[0]].copy() for i in range(12)]
        made.add(written(tmp_path / "a.mp4", images).read_bytes())
        del junk
    assert len(made) == 1


@pytest.mark.parametrize("fps", [58.8, 30000 / 1001, 12.0, 1.0, 0.05])
def test_frame_rates_are_kept(tmp_path: Path, fps: float) -> None:
    writer = FilmWriter(tmp_path / "a.mp4", fps, SIZE)
    for image in pictures(6):
        writer.write(image)
    writer.close(True)
    found = cv2.VideoCapture(str(writer.path))
    assert found.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    assert found.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-6)
    while found.grab():
        last_s = found.get(cv2.CAP_PROP_POS_MSEC) / 1000
    assert last_s == pytest.approx(5 / fps, rel=1e-6)


@pytest.mark.parametrize(("count", "fps"), [(3, 2.0), (60, 3.0), (400, 10.0)])
def test_photos_play_at_2_to_10_a_second(tmp_path: Path, count: int, fps: float) -> None:
    for i in range(count):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), np.zeros((16, 16, 3), np.uint8))
    assert film_fps(rt.Video(tmp_path)) == fps


@pytest.mark.parametrize("size", [(321, 241), (1601, 901), (3840, 2160), (5, 3), (1, 1), (900, 1)])
def test_the_video_has_the_full_size(tmp_path: Path, size: tuple[int, int]) -> None:
    """But for the odd pixel that the codec does not take."""
    writer = FilmWriter(tmp_path / "a.mp4", FPS, size)
    writer.write(np.full((*writer.size[::-1], 3), 99, np.uint8))
    writer.close(True)
    image = cv2.VideoCapture(str(writer.path)).read()[1]
    assert image.shape == (max(size[1] // 2 * 2, 2), max(size[0] // 2 * 2, 2), 3)
    assert abs(image.mean() - 99) < 3


def test_an_incomplete_video_is_not_kept(tmp_path: Path) -> None:
    writer = FilmWriter(tmp_path / "o.mp4", FPS, SIZE)
    writer.path.write_text("of an earlier run")
    writer.write(pictures(1)[0])
    assert writer.path.read_text() == "of an earlier run"  # until the new one is complete
    writer.close(False)
    assert writer.path.read_text() == "of an earlier run"
    assert list(tmp_path.iterdir()) == [writer.path]


def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    """A real limit on the file size."""
    code = (
        "import resource, sys; import numpy as np; from pathlib import Path\n"
        "from reobj.results.film import FilmWriter\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
        "writer, rng = FilmWriter(Path('o.mp4'), 15, (320, 240)), np.random.default_rng(0)\n"
        "try:\n"
        "    for _ in range(40): writer.write(rng.integers(0, 255, (240, 320, 3), np.uint8))\n"
        "    writer.close(True)\n"
        "except OSError as error:\n"
        "    writer.close(False)\n"
        "    print(error)\n"
    )
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("o.mp4: the overlay cannot be written (")
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"overlay.*: the overlay cannot be written"):
        FilmWriter(tmp_path / "nowhere" / "overlay.mp4", FPS, SIZE)


def test_the_encoder_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "a.mp4", pictures(3))
    print("still there", file=sys.stderr)
    assert capfd.readouterr() == ("", "still there\n")
