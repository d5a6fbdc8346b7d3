"""Live view of a running `track`: rerun's viewer, or a page on 127.0.0.1 where rerun is missing."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

import cv2

from reobj.cameras import Poses
from reobj.export.registry import Viewer, live_labels
from reobj.results.result import Result, VideoInfo
from reobj.sources.video import Video, shrunk
from reobj.types import NOTE, Frame, ReobjError, Tracks, log
from reobj.viewer.overlay import draw_tracks
from reobj.viewer.serve import LocalHandler, LocalServer

EVERY_S = 0.1  # least time between two pictures of the page
PICTURE_PX = 1280  # longer side
PAGE = b"""<!doctype html><meta charset="utf-8"><title>reobj_track</title>
<meta name="viewport" content="width=device-width">
<style>body{margin:0;background:#111}img{display:block;margin:auto;max-width:100%;max-height:100vh}
</style><img src="/pictures" alt="the latest frame with identities">"""


def open_viewer(video: VideoInfo, stack: contextlib.ExitStack) -> Viewer | LivePage:
    """Open the live view of `--show`; the end of the stack closes it."""
    viewer: Viewer | LivePage
    try:
        viewer = Viewer(video)
    except ReobjError:  # rerun is missing
        viewer = LivePage()
    stack.callback(viewer.close)
    return viewer


class LivePage:
    """A page with the latest frame and its identities, while a video is tracked.

    Attributes:
        followed: the frames were shown while the video was tracked.
    """

    def __init__(self) -> None:
        self.followed = False
        self._server = _Server(0, _Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        url = self._server.url
        log.log(NOTE, "live view: %s (in 3D with rerun: pip install rerun-sdk)", url)
        self._server.open_browser()

    def follow(
        self, steps: Iterable[tuple[Frame, Tracks]], names: Sequence[str], video: Video,
        poses: Poses | None,
    ) -> Iterator[tuple[Frame, Tracks]]:  # fmt: skip
        """Show and yield each frame of a running `track`; `poses` are not shown."""
        self.followed = True
        positions: dict[int, int] = {}
        shown_s = -EVERY_S
        for frame, tracks in steps:
            if time.monotonic() - shown_s > EVERY_S:
                shown_s = time.monotonic()
                texts = live_labels(tracks, names)
                labels = dict(zip(tracks.track_id.tolist(), texts, strict=True))
                image = shrunk(frame.image, PICTURE_PX).copy()
                scale = image.shape[1] / frame.image.shape[1]
                draw_tracks(image, tracks, labels, scale, positions)
                self._server.put(cv2.imencode(".jpg", image)[1].tobytes())
            yield frame, tracks

    def show(self, result: Result, path: Path, images: bool) -> None:
        """Show nothing more: scene.html has the result."""

    def close(self) -> None:
        """End the pictures and the server."""
        self._server.put(b"")
        self._server.shutdown()
        self._server.server_close()


class _Server(LocalServer):
    """The server of the page.

    Attributes:
        picture: the latest one, a JPEG; None: not yet; b"": there are no more.
        changed: notified of each picture.
    """

    picture: bytes | None = None

    def __init__(self, port: int, handler: type[LocalHandler]) -> None:
        super().__init__(port, handler)
        self.changed = threading.Condition()

    def put(self, picture: bytes) -> None:
        """Replace the picture."""
        with self.changed:
            self.picture = picture
            self.changed.notify_all()


class _Handler(LocalHandler):
    """Send the page, and the pictures as one endless answer (multipart/x-mixed-replace)."""

    server: _Server

    def do_GET(self) -> None:
        if not self._may_read():
            return
        path = urlsplit(self.path).path
        if path == "/pictures":
            with contextlib.suppress(OSError):  # the browser was closed
                self._pictures()
            self.close_connection = True
        elif path != "/":
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")
        elif not self._token_moved():
            self._answer(HTTPStatus.OK, PAGE, "text/html; charset=utf-8")

    def _pictures(self) -> None:
        self._head(HTTPStatus.OK, None, "multipart/x-mixed-replace; boundary=frame")
        picture: bytes | None = None
        while picture != b"":
            with self.server.changed:
                while self.server.picture is picture:
                    self.server.changed.wait()
                picture = self.server.picture
            if picture:
                head = f"Content-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
                self.wfile.write(b"--frame\r\n" + head.encode() + picture + b"\r\n")
