"""Cameras and streams: the newest frames are seen, nothing piles up, Ctrl-C leaves whole files."""

from __future__ import annotations

import functools
import http.server
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
SIZE = (64, 48)


class FakeCamera:
    """A capture whose frame n is grey with value n; it stands still where a gate is closed."""

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


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rt, "LIVE_SILENCE_S", 1.0)


def opened(monkeypatch: pytest.MonkeyPatch, *cameras: FakeCamera) -> None:
    left = iter(cameras)
    monkeypatch.setattr(rt.cv2, "VideoCapture", lambda source: next(left))


def wait_until(condition: Any) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_slow_consumer_sees_the_newest_frames(
    monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    """While frame 1 is worked on, 2 to 10 come: 9 and 10 are seen next, the others never."""
    gates = {2: threading.Event(), 11: threading.Event()}
    camera = FakeCamera(14, gates)
    opened(monkeypatch, camera)
    video = rt.Video(0)  # takes frame 0 to know the size
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


def test_leaving_early_stops_the_thread_and_frees_the_camera(
    monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    first, second = FakeCamera(10**6), FakeCamera(10**6)
    opened(monkeypatch, first, second)
    video = rt.Video("0")
    before = threading.active_count()
    for frame in video:
        if frame.index >= 5:
            break
    wait_until(lambda: first.released and threading.active_count() == before)
    again = next(iter(video))
    assert again.image[0, 0, 0] == again.index % 250 and second.n > 0  # opened anew


def test_every_start_and_stop_count_frames_of_the_source(
    monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    opened(monkeypatch, FakeCamera(100))
    video = rt.Video(0, rt.InputConfig(start=3, every=4, stop=16))
    assert {f.index for f in video} <= {3, 7, 11, 15} and video.read == 4


def test_a_driver_that_fails_ends_the_video(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not: waits for ever. What came before is kept."""
    camera = FakeCamera(10)
    opened(monkeypatch, camera)
    video, failures = rt.Video(0), []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    camera.read = lambda: next(reads)  # type: ignore[method-assign]
    reads = iter([(True, np.zeros((48, 64, 3), np.uint8))])  # then StopIteration
    assert [f.index for f in video] == [0] and len(failures) == 1


def test_a_camera_that_is_not_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert rt.main(["track", "97", "-o", str(tmp_path / "out")]) == 2
    assert "97: cannot be opened as a camera (is it connected?)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ---- A stream over HTTP ----


class Stream(http.server.ThreadingHTTPServer):
    """MJPEG as IP cameras send it; one client after the other sees all the frames."""

    def __init__(self, count: int, pause_s: float) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.count, self.pause_s, self.sent = count, pause_s, 0


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


@pytest.fixture
def stream(request: pytest.FixtureRequest) -> Iterator[tuple[Stream, str]]:
    server = Stream(*request.param)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server, f"http://me:secret@127.0.0.1:{server.server_port}/camera.mjpg"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("stream", [(40, 0.005)], indirect=True)
def test_a_stream_is_read_to_its_end(stream: tuple[Stream, str], quick: None) -> None:
    url = stream[1]
    video = rt.Video(url)
    assert video.is_live and video.size == (320, 240) and "secret" not in video.source
    seen = []
    for frame in video:
        seen.append((frame.index, round(float(frame.image[5:15, 5:15].mean()))))
        time.sleep(0.02)
    assert video.read == 39 and len(seen) + video.dropped == 39  # one more told the size
    assert seen[-1][0] == 38 and [i for i, _ in seen] == sorted({i for i, _ in seen})
    for index, grey in seen:
        assert abs(grey - index - 1) <= 2  # the number in the picture; JPEG


def test_a_file_behind_a_url_is_read_like_a_file(tmp_path: Path) -> None:
    """Its length is known: no thread, nothing dropped, as often as wanted."""
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25, SIZE)
    for n in range(12):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 20 * n, np.uint8))
    writer.release()
    handler = functools.partial(QuietFiles, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
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
step = rt.Tracker.step
def counted(self, *args, **options):
    if self.frame_number == 40:
        pathlib.Path(sys.argv[1]).touch()
    return step(self, *args, **options)
rt.Tracker.step = counted
sys.exit(rt.main(sys.argv[2:]))
"""


@pytest.mark.parametrize("stream", [(10**6, 0.01)], indirect=True)
def test_ctrl_c_leaves_complete_files(stream: tuple[Stream, str], tmp_path: Path) -> None:
    """A live run ended by SIGINT: exit code 0, all its files whole, and what was lost is said."""
    server, url = stream
    ready = tmp_path / "ready"
    rows = [f"{i},-1,{x},60,40,50,0.9,-1,-1,-1" for i in range(1, 5000) for x in (100, 220)]
    (tmp_path / "det.txt").write_text("\n".join(rows) + "\n")
    out, env = tmp_path / "out", os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", SAYS_WHEN_IT_TRACKS, str(ready), "run", url, "-o", str(out)]
    for _ in range(2):  # again into the same folder: what it shows now, not what is cached
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
        assert rt.validate_objects(out / "objects.json") == []
        data = json.loads((out / "objects.json").read_text())
        assert any(w.startswith("live: ") and "dropped" in w for w in data["warnings"])
        assert "identities only" in errors and "distinct objects: 2" in text
        written = "".join(p.read_text() for p in out.rglob("*.json")) + text + errors
        assert "secret" not in written and str(server.server_port) in written
        assert not list(out.rglob(".part*"))
        (out / "tracks.txt").unlink()
