"""`--show` without rerun: a page with the latest frame while a video is tracked."""

from __future__ import annotations

import http.cookiejar
import re
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

import reobj_track as rt

COUNT = 12


@pytest.fixture
def video(tmp_path: Path) -> rt.Video:
    """Grey photos, 320 x 240."""
    for i in range(COUNT):
        cv2.imwrite(str(tmp_path / f"{i:02d}.png"), np.full((240, 320, 3), 127, np.uint8))
    return rt.Video(tmp_path)


def browser() -> urllib.request.OpenerDirector:
    """A client that keeps cookies and follows redirections."""
    jar = urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar())
    return urllib.request.build_opener(jar)


def test_the_page_shows_frames_with_identities(
    video: rt.Video, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through `run(show=True)`: the browser gets JPEGs with the box, until the end."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    got: list[bytes] = []
    headers: dict[str, str] = {}
    threads: list[threading.Thread] = []
    watching = threading.Event()

    def watch(url: str) -> None:
        client = browser()
        page = client.open(url, timeout=20).read()
        assert b'src="/pictures"' in page
        stream = client.open(url.split("?")[0] + "pictures", timeout=20)
        headers.update(stream.headers)
        watching.set()
        got.append(stream.read())

    def open_browser(url: str) -> bool:
        threads.append(threading.Thread(target=watch, args=(url,)))
        threads[0].start()
        return True

    def detect(image: np.ndarray) -> np.ndarray:
        watching.wait(20)
        return np.array([[60.0, 60, 200, 180, 0.9, 0]])

    monkeypatch.setattr("webbrowser.open", open_browser)
    rt.run(video, tmp_path / "out", in_3d=False, detector=detect, show=True)
    threads[0].join(20)
    parts = re.findall(rb"Content-Length: (\d+)\r\n\r\n", got[0])
    assert 1 <= len(parts) <= COUNT
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"  # no other page shows them
    assert headers["Connection"] == "close" and "Content-Length" not in headers
    last = got[0].rsplit(b"\r\n\r\n", 1)[1][: int(parts[-1])]
    image = cv2.imdecode(np.frombuffer(last, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (240, 320, 3)
    drawn = np.abs(image.astype(int) - 127).max(2) > 60
    y, x = np.nonzero(drawn)
    np.testing.assert_allclose([x.min(), x.max(), y.max()], [60, 200, 180], atol=4)
