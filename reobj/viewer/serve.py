"""`serve OUT`: the viewer on this machine, where saved corrections are applied at once.

The standard library's HTTP server on 127.0.0.1, with a token in every request. It has a fixed list
of addresses: the page, the recording, frames of an image folder, the state of the worker,
corrections, undo. No address is a path of a file. The live view of a running `track` (rerun's
viewer, or a page where rerun is missing) has the same server.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import os
import re
import secrets
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2

from reobj.cameras import Poses
from reobj.export.registry import Viewer, live_labels
from reobj.files import atomic
from reobj.results.changes import EarlierSession
from reobj.results.edits import HEADER, read_edits
from reobj.results.entries import OutputFile
from reobj.results.result import Result, VideoInfo
from reobj.results.workspace import Workspace
from reobj.sources.image_files import read_image
from reobj.sources.video import Video, shrunk, source_fingerprint
from reobj.types import NOTE, Frame, ReobjError, Tracks, log, one_line
from reobj.viewer.overlay import draw_tracks
from reobj.viewer.scene import served_page

HOST = "127.0.0.1"
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
EDITS_MAX = 16 << 20  # bytes of a file of corrections; 10,000 splits take 3 MB
FRAME_PX = 1280  # longer side of the frames of an image folder
CHUNK = 1 << 18  # bytes of the recording that are in memory
STOP_S = 20  # for the map to be put back after the worker was killed
PROGRESS_S = 0.5  # between two lines of progress of the worker
VIDEO_TYPES = {".webm": "video/webm", ".mkv": "video/webm", ".ogv": "video/ogg"}  # else mp4


# ---- A server for the user of this machine -----------------------------------------------------


class LocalHandler(BaseHTTPRequestHandler):
    """Answer requests that name this server and have its token; refuse all others."""

    server: LocalServer
    protocol_version = "HTTP/1.1"
    server_version = "reobj_track"
    sys_version = ""
    timeout = 60  # s, of a connection without a request

    def log_message(self, text: str, *args: Any) -> None:
        """Log requests with --debug, without the token."""
        log.debug("serve: %s", one_line((text % args).replace(self.server.token, "TOKEN")))

    def _may_read(self) -> bool:
        """Check the address, the host, which a page of another server cannot give, the token."""
        token = self.server.token.encode()
        fault = None
        try:
            if self.headers.get("Host", "").lower() not in self.server.hosts:
                fault = (HTTPStatus.FORBIDDEN, "unknown host")
            elif not any(hmac.compare_digest(t, token) for t in self._tokens()):
                why = "no token: open the address that was printed"
                fault = (HTTPStatus.FORBIDDEN, why)
        except ValueError:  # of the address, such as http://[
            fault = (HTTPStatus.BAD_REQUEST, "no address")
        if fault is not None:
            self._refuse(*fault)
        return fault is None

    def _tokens(self) -> list[bytes]:
        """Return the tokens of the address and of the cookie."""
        found = parse_qs(urlsplit(self.path).query).get("token", [])
        # SimpleCookie reads none if another program on 127.0.0.1 has set one that it cannot read
        for cookie in self.headers.get("Cookie", "").split(";"):
            name, _, value = cookie.strip().partition("=")
            if name == self.server.cookie:
                found.append(value)
        return [token.encode("utf-8", "replace") for token in found]

    def _token_moved(self) -> bool:
        """Move the token of the address to a cookie, by another request of the browser."""
        if not urlsplit(self.path).query:
            return False
        cookie = f"{self.server.cookie}={self.server.token}; HttpOnly; SameSite=Lax; Path=/"
        more = {"Location": "/", "Set-Cookie": cookie}
        self._answer(HTTPStatus.SEE_OTHER, b"", "text/plain", more)
        return True

    def _json(self, data: dict[str, Any]) -> None:
        self._answer(HTTPStatus.OK, json.dumps(data).encode(), "application/json")

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._answer(status, f"{one_line(why)}\n".encode(), "text/plain; charset=utf-8")

    def _answer(
        self, status: HTTPStatus, body: bytes, kind: str, more: dict[str, str] | None = None
    ) -> None:
        self._head(status, len(body), kind, more)
        self.wfile.write(body)

    def _head(
        self, status: HTTPStatus, length: int | None, kind: str, more: dict[str, str] | None = None
    ) -> None:
        """Send the head of an answer of `length` bytes; None: until the connection is closed."""
        self.send_response(status)
        end = {"Connection": "close"} if length is None else {"Content-Length": str(length)}
        headers = {"Content-Type": kind} | end
        for name, value in (HEADERS | headers | (more or {})).items():
            self.send_header(name, value)
        self.end_headers()


class LocalServer(ThreadingHTTPServer):
    """A server on 127.0.0.1.

    Attributes:
        token: that every request must have. hosts, origins: names of this server.
    """

    daemon_threads = True
    allow_reuse_address = os.name == "posix"  # elsewhere it lets two programs use one port

    def __init__(self, port: int, handler: type[LocalHandler]) -> None:
        self.token = secrets.token_urlsafe(32)
        try:
            super().__init__((HOST, port), handler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or "0 to 65535 are possible"
            raise ReobjError(f"--port {port}: {why}; give another one, or none") from error
        number = self.server_address[1]
        self.cookie = f"reobj_{number}"  # cookies do not distinguish ports
        self.hosts = {f"{name}:{number}" for name in (HOST, "localhost")}
        self.origins = {f"http://{host}" for host in self.hosts}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log a connection that the browser closed with --debug; print other errors."""
        error = sys.exception()
        if isinstance(error, ConnectionError):
            log.debug("serve: %s", error)
        else:
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        """Address of the page with its token."""
        return f"http://{HOST}:{self.server_address[1]}/?token={self.token}"

    def open_browser(self) -> None:
        """Open the page in the browser; in a thread, as one in the terminal returns at its end."""
        threading.Thread(target=webbrowser.open, args=(self.url,), daemon=True).start()


# ---- Corrections -------------------------------------------------------------------------------


class Corrections:
    """Corrections of an output folder: one at a time in a child process, and what undoes them.

    Before corrections replace those of the folder, these are stored in OUT/cache/undo: 1.json, and
    so on, with the map that the folder belongs to, 1.map. Undo restores the last map, applies the
    last file, and then removes both: if it is interrupted, it can be repeated.

    Args:
        command: program and first arguments that run the tool. find_map: returns the map of the
            folder, a `reobj.maps.contents.FolderMap`; None: it has none.
    """

    def __init__(self, out: Path, command: Sequence[str], find_map: Callable[[], Any]) -> None:
        self.out = out
        self.folder = out / "cache" / "undo"
        self._command = command
        self._find_map = find_map
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[str] | None = None
        self._text = ""  # progress of the worker, or its error
        self._is_running = False
        self._is_ending = False
        self._failed = False

    def state(self) -> dict[str, Any]:
        """Return what the page shows: progress or error, and how much can be undone."""
        with self._lock:
            state = {"running": self._is_running, "failed": self._failed, "text": self._text}
        return state | {"undo": len(self._stack()), "version": self.version}

    @property
    def version(self) -> str:
        """Version of the result, which the page sends with its corrections."""
        try:
            return str((self.out / OutputFile.OBJECTS).stat().st_mtime_ns)
        except OSError:
            return ""

    def _stack(self) -> list[Path]:
        """List the stored corrections, the latest last."""
        files = [p for p in self.folder.glob("*.json") if p.stem.isdecimal()]
        return sorted(files, key=lambda path: int(path.stem))

    def save(self, text: bytes) -> None:
        """Start to apply corrections.

        Args:
            text: of a file of edits.
        Raises:
            ReobjError: they are invalid, or others are being applied.
        """
        with self._starting():
            new = self._temporary(text)
            edits = read_edits(new)
            before = self.out / OutputFile.EDITS
            no_edits = json.dumps(HEADER | {"edits": []}).encode()
            old = before.read_bytes() if before.is_file() else no_edits
            stack = self._stack()
            entry = self.folder / f"{1 + int(stack[-1].stem) if stack else 1}.json"
            _remove(entry)
            room = self._changed_map()
            copy = entry.with_suffix(".map")
            if room is not None:
                room.keep(copy, edits)
            with atomic(entry) as part:
                part.write_bytes(old)
            done = None if room is None else partial(room.applied, copy)
            self._run(new, done, partial(self._drop, entry, room))

    def undo(self) -> None:
        """Start to restore the map and the corrections before the last ones.

        Raises:
            ReobjError: there are none, others are being applied, or the map has changed since.
        """
        with self._starting():
            stack = self._stack()
            if not stack:
                raise ReobjError("nothing to undo")
            entry = stack[-1]
            copy = entry.with_suffix(".map")
            edits = self._temporary(entry.read_bytes())
            room = self._changed_map()
            put_back = None if room is None or not copy.is_file() else room.restore(copy)
            self._run(edits, partial(_remove, entry), put_back)

    def stop(self) -> None:
        """End the worker; the result and the map stay as they were."""
        with self._lock:
            self._is_ending = True
            if self._process is not None:
                self._process.kill()
        if self._thread is not None:
            self._thread.join(STOP_S)

    @contextlib.contextmanager
    def _starting(self) -> Iterator[None]:
        """Begin a job; an error of the block ends it."""
        with self._lock:
            if self._is_running:
                raise ReobjError("corrections are being applied; wait for them")
            self._is_running = True
            self._failed = False
            self._text = "starting"
        try:
            yield
        except (ReobjError, OSError) as error:
            fault = one_line(str(error))
            self._end(fault)
            raise ReobjError(fault) from error

    def _end(self, fault: str) -> None:
        with self._lock:
            self._is_running = False
            self._failed = bool(fault)
            self._text = fault

    def _changed_map(self) -> Any:
        """Return the map that corrections of the folder change; None: they change none."""
        room = self._find_map()
        return None if room is None or room.frozen else room

    def _temporary(self, text: bytes) -> Path:
        """Write the file that the worker reads, and `_work` removes."""
        path = self.out / "cache" / "new-edits.json"
        with atomic(path) as part:
            part.write_bytes(text)
        return path

    def _drop(self, entry: Path, room: Any) -> None:
        """Restore the map after corrections that failed, and remove what would undo them."""
        try:
            if room is not None:
                room.restore(entry.with_suffix(".map"))
        finally:
            _remove(entry)

    def _run(
        self, edits: Path, done: Callable[[], None] | None, failed: Callable[[], None] | None
    ) -> None:
        """Apply a file of edits in a thread; then call `done`, or after an error `failed`."""

        def work() -> None:
            fault = self._applied(edits)
            try:
                if (after := failed if fault else done) is not None:
                    after()
            except (OSError, ReobjError) as error:
                fault = fault or one_line(str(error))
            finally:
                edits.unlink(missing_ok=True)
                self._end(fault)

        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def _applied(self, edits: Path) -> str:
        """Apply edits in a child process, as the command line does, and show its progress.

        Returns:
            its error, "" after a success.
        """
        command = [*self._command, "objects", str(self.out), "--edits", str(edits)]
        line = ""
        try:
            with subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                env=os.environ | {"REOBJ_PROGRESS_S": str(PROGRESS_S)},
                start_new_session=True,  # Ctrl-C ends the server, which ends the worker
            ) as process:
                with self._lock:
                    self._process = process
                    if self._is_ending:
                        process.kill()
                for text in process.stderr or ():
                    line = text.strip().replace(str(edits), OutputFile.EDITS) or line
                    if not line.startswith(("warning:", "note:")):
                        with self._lock:
                            self._text = line
        except OSError as error:
            return f"the worker could not be started: {one_line(str(error))}"
        ended = f"the worker ended with {process.returncode}"
        return (line.removeprefix("error: ") or ended) if process.returncode else ""


def _remove(entry: Path) -> None:
    """Remove stored corrections with their map: what is left without the first one is unused."""
    for suffix in (".json", ".map", ".digests"):
        entry.with_suffix(suffix).unlink(missing_ok=True)


# ---- The pages ---------------------------------------------------------------------------------


class _Handler(LocalHandler):
    """Answer a request of the page; every other one is refused."""

    server: Server

    def do_GET(self) -> None:
        if not self._may_read():
            return
        path = urlsplit(self.path).path
        frame = re.fullmatch(r"/frame/(\d{1,9})", path)
        if path == "/":
            self._page()
        elif path == "/state":
            self._json(self.server.corrections.state())
        elif path == "/recording" and self.server.recording is not None:
            self._recording(self.server.recording)
        elif frame and (picture := self.server.frame(int(frame[1]))):
            self._answer(HTTPStatus.OK, picture, "image/jpeg")
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")

    def do_POST(self) -> None:
        self.close_connection = True  # an unread body is no next request
        if not self._may_read():
            return
        parts = urlsplit(self.path)
        length = self.headers.get("Content-Length", "")
        corrections = self.server.corrections
        fault = None
        if self.headers.get("Origin") not in self.server.origins:
            fault = (HTTPStatus.FORBIDDEN, "from another page")
        elif not re.fullmatch(r"\d{1,9}", length) or int(length) > EDITS_MAX:
            fault = (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {EDITS_MAX >> 20} MB")
        elif parts.path not in ("/edits", "/undo"):
            fault = (HTTPStatus.NOT_FOUND, "no such page")
        elif parse_qs(parts.query).get("version", [""])[0] != corrections.version:
            fault = (HTTPStatus.CONFLICT, "the result has changed: reload this page")
        try:
            if fault is None and parts.path == "/edits":
                corrections.save(self.rfile.read(int(length)))
            elif fault is None:
                corrections.undo()
        except ReobjError as error:
            fault = (HTTPStatus.CONFLICT, str(error))
        if fault is None:
            self._json(corrections.state())
        else:
            self._refuse(*fault)

    def _page(self) -> None:
        """Send the page; the token of the address moves to a cookie."""
        if not self._token_moved():
            try:
                page = self.server.page().encode()
            except ReobjError as error:
                self._refuse(HTTPStatus.CONFLICT, str(error))
            else:
                self._answer(HTTPStatus.OK, page, "text/html; charset=utf-8")

    def _recording(self, path: Path) -> None:
        """Send the video file, or the range of it that is requested."""
        try:
            file = path.open("rb")
        except OSError:
            self._refuse(HTTPStatus.NOT_FOUND, "the recording cannot be read")
            return
        with file:
            size = os.fstat(file.fileno()).st_size
            span = _range(self.headers.get("Range", ""), size)
            more = {"Accept-Ranges": "bytes"}
            if span is None:
                more["Content-Range"] = f"bytes */{size}"
                self._head(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, 0, "text/plain", more)
                return
            first, last = span
            status = HTTPStatus.OK
            if "Range" in self.headers:
                status = HTTPStatus.PARTIAL_CONTENT
                more["Content-Range"] = f"bytes {first}-{last}/{size}"
            kind = VIDEO_TYPES.get(path.suffix.lower(), "video/mp4")
            self._head(status, last + 1 - first, kind, more)
            file.seek(first)
            left = last + 1 - first
            with contextlib.suppress(OSError):  # the browser has enough
                while left > 0 and (data := file.read(min(CHUNK, left))):
                    self.wfile.write(data)
                    left -= len(data)
            self.close_connection = left > 0


def _range(text: str, size: int) -> tuple[int, int] | None:
    """Return first and last byte of a Range header; None if no byte is in the file.

    >>> _range("bytes=2-", 10), _range("bytes=2-5", 10), _range("", 10), _range("bytes=10-", 10)
    ((2, 9), (2, 5), (0, 9), None)
    """
    found = re.fullmatch(r"bytes=(\d{1,18})-(\d{0,18})", text)
    if found is None:  # browsers ask for no other ones: the whole file
        return 0, size - 1
    first = int(found[1])
    last = min(int(found[2] or size), size - 1)
    return (first, last) if first <= last else None


class Server(LocalServer):
    """The server of one output folder; for the arguments see `Corrections`.

    Attributes:
        recording: the video file, as far as it is unchanged; None. images: files of an image folder
            by frame number.
    """

    def __init__(
        self, out: Path, port: int, command: Sequence[str], find_map: Callable[[], Any]
    ) -> None:
        self.viewer = out / "scene.html"
        self._find_map = find_map
        self.recording: Path | None = None
        self.images: list[Path] = []
        with Workspace.open(out) as workspace:
            source, config = workspace.source
            # the fingerprint holds the time of the file: who made up this folder cannot know it
            if workspace.fingerprint == source_fingerprint(source):
                with contextlib.suppress(ReobjError):
                    video = Video(source, config)
                    self.images = video.files
                    if not video.files and not video.is_live and Path(source).is_file():
                        self.recording = Path(source)
        self.corrections = Corrections(out, command, find_map)
        self.page()
        super().__init__(port, _Handler)

    def frame(self, number: int) -> bytes:
        """Return a frame of an image folder as JPEG; b"": there is none."""
        image = read_image(self.images[number]) if number < len(self.images) else None
        if image is None:
            return b""
        return cv2.imencode(".jpg", shrunk(image, FRAME_PX))[1].tobytes()

    def page(self) -> str:
        """Return the page.

        Raises:
            ReobjError: there is none of this version in the folder.
        """
        path = self.viewer
        if not path.is_file():
            raise ReobjError(f"{path}: no such file; make it with `objects {path.parent}`")
        if path.resolve().parent != path.parent.resolve():
            raise ReobjError(f"{path}: is a link out of the folder")
        served = {
            "recording": "recording" if self.recording else "",
            "frames": bool(self.images),
            "state": self.corrections.state(),
        }
        return served_page(path, served, self._others())

    def _others(self) -> Sequence[EarlierSession] | None:
        """Return the other recordings of the folder's map; None: those of the page are shown."""
        try:
            room = self._find_map()
            return None if room is None else room.others()
        except ReobjError as error:
            log.warning("%s; the page has the recordings of its last fit", error)
            return None


# ---- Live view of a running `track` -------------------------------------------------------------

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
        self._server = _PictureServer(0, _PictureHandler)
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


class _PictureServer(LocalServer):
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


class _PictureHandler(LocalHandler):
    """Send the page, and the pictures as one endless answer (multipart/x-mixed-replace)."""

    server: _PictureServer

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
