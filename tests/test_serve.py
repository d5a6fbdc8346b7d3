"""`serve OUT`: the viewer of a folder, saved corrections, undo, the recording; what it refuses."""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import Browser
from front_door.room import ROOM, SMALL
from simulated import SIZE, tracks_of, unlinked, walk

import reobj_track as rt
from reobj.results.workspace import Workspace

TOOL = Path(rt.__file__)
PATIENCE_S = 300  # for one answer of a server; a busy machine takes long
WITHOUT_FILM = ("--set", "output.overlay=none")
FILM = 12  # frames of the video
LENS = rt.Camera("SIMPLE_RADIAL", *SIZE, (300.0, SIZE[0] / 2, SIZE[1] / 2, -0.1))


class Client:
    """Requests to a running `serve` with, and without, what a browser sends."""

    def __init__(self, process: subprocess.Popen[str], url: str) -> None:
        self.process = process
        self.url = url
        self.port = int(url.split(":")[2].split("/")[0])
        self.token = url.split("token=")[1]
        self.origin = f"http://127.0.0.1:{self.port}"

    def ask(
        self, path: str, method: str = "GET", body: bytes | None = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Send a request with exactly these headers; return status, headers and body."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        names = {} if body is None else {"Content-Length": str(len(body))}
        names |= {name.replace("_", "-"): value for name, value in headers.items()}
        for name, value in ({"Host": f"127.0.0.1:{self.port}"} | names).items():
            connection.putheader(name, value)
        connection.endheaders(body)
        answer = connection.getresponse()
        found = answer.status, dict(answer.getheaders()), answer.read()
        connection.close()
        return found

    def get(self, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Send a request with the token in the cookie."""
        return self.ask(path, Cookie=f"reobj_{self.port}={self.token}", **headers)

    def post(self, path: str, body: bytes = b"", **headers: str) -> tuple[int, str]:
        """Send corrections as the page does; return the status and the text."""
        headers = {"Origin": self.origin, "Cookie": f"reobj_{self.port}={self.token}"} | headers
        status, _, text = self.ask(path, "POST", body, **headers)
        return status, text.decode().strip()

    def state(self) -> Any:
        return json.loads(self.get("/state")[2])

    def finished(self) -> Any:
        """Wait for the worker; return the state with all texts before it as `texts`.

        Its end is all that is waited for: a busy machine takes minutes.
        """
        texts = []
        while (state := self.state())["running"]:
            texts.append(state["text"])
            time.sleep(0.1)
        return state | {"texts": texts}


def workers_of(client: Client) -> list[int]:
    """Processes that a server has started and that run."""
    threads = Path(f"/proc/{client.process.pid}/task").glob("*/children")
    return [int(pid) for children in threads for pid in children.read_text().split()]


def _heed_ctrl_c() -> None:
    """Undo that jobs in the background of a shell ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def serving(out: Path, *words: str, **environment: str) -> Iterator[Client]:
    """Run `serve OUT` as a user does, and end it with Ctrl-C."""
    command = [sys.executable, str(TOOL), "serve", str(out), *words]
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, preexec_fn=_heed_ctrl_c,
        env=os.environ | environment,
    )  # fmt: skip
    assert process.stdout is not None
    line = process.stdout.readline()
    assert f"viewer of {out}: http://127.0.0.1:" in line, process.communicate()
    try:
        yield Client(process, line.split()[-1])
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0 and "Traceback" not in errors


@pytest.fixture
def out(broken_walk_folder: Path, tmp_path: Path) -> Path:
    """An output folder of an image folder, with six objects in two components."""
    return shutil.copytree(broken_walk_folder, tmp_path / "out")


@pytest.fixture(scope="module")
def film_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An output folder of a video file, whose frames have different colours; a bent lens."""
    top = tmp_path_factory.mktemp("film")
    path = top / "walk #1.webm"
    code = cv2.VideoWriter.fourcc(*"VP80")
    writer = cv2.VideoWriter(str(path), code, 10.0, SIZE)
    for i in range(FILM):
        image = np.full((SIZE[1], SIZE[0], 3), (40, 20 * i, 220 - 20 * i), np.uint8)
        image[:, : SIZE[0] // 8] = 255  # a white stripe at the left
        writer.write(image)
    writer.release()
    poses = walk(FILM, camera=LENS)
    workspace = Workspace(top / "out")
    given = unlinked(poses, tracks_of(poses))
    workspace.bind(rt.Video(path))
    workspace.save_last(given, given.poses)
    assert rt.main(["objects", str(workspace.out), *WITHOUT_FILM]) == 0
    return workspace.out


def edits_of(out: Path, *edits: dict[str, Any]) -> bytes:
    return json.dumps({"format": "reobj-edits", "version": 1, "edits": edits}).encode()


def delete(out: Path, number: int) -> dict[str, Any]:
    rows = np.loadtxt(out / "tracks.txt", delimiter=",")
    frame, _, x, y, w, h = rows[(rows[:, 1] == number) & (rows[:, 6] > 0)][0, :6]
    box = {"id": number, "frame": int(frame) - 1, "box": [x, y, x + w, y + h]}
    return {"do": "delete", "object": box}


def ids(out: Path) -> list[int]:
    return [o.id for o in rt.Result.load(out).objects]


# ---- Corrections ----


def test_saved_corrections_are_applied_and_undone(out: Path) -> None:
    """After the undo the files of a result are those from before, byte for byte."""
    names = ("tracks.txt", "poses.txt", "objects.ply")
    before = [(out / name).read_bytes() for name in names]
    with serving(out) as client:
        save(client, edits_of(out, delete(out, 6)))
        assert ids(out) == [1, 2, 3, 4, 5] and client.state()["undo"] == 1
        status, _ = undo(client)
        assert status == 200 and not client.finished()["failed"]
        assert undo(client) == (409, "nothing to undo")
    assert [(out / name).read_bytes() for name in names] == before
    assert not (out / "edits.json").exists() and not (out / "cache/new-edits.json").exists()


def test_corrections_that_fail_change_nothing(out: Path) -> None:
    """One line, without a path of the worker; the next save works."""
    gone = delete(out, 6)
    gone["object"]["box"] = [1, 2, 3, 4]
    with serving(out) as client:
        version = client.state()["version"]
        status, answer = client.post(f"/edits?version={version}", edits_of(out, gone))
        assert status == 200
        state = client.finished()
        assert state["failed"] and state["undo"] == 0 and "\n" not in state["text"]
        assert "no object has the box 1.0, 2.0, 3.0, 4.0" in state["text"]
        for text in (b"{", b'{"format": 3}', edits_of(out, {"do": "paint"})):
            status, answer = client.post(f"/edits?version={version}", text)
            assert status == 409 and "new-edits.json" in answer and "\n" not in answer
        status, answer = client.post("/edits?version=1", edits_of(out, delete(out, 6)))
        assert (status, answer) == (409, "the result has changed: reload this page")
        assert ids(out) == [1, 2, 3, 4, 5, 6]
        assert client.post(f"/edits?version={version}", edits_of(out, delete(out, 6)))[0] == 200
        status, answer = client.post(f"/undo?version={version}")
        assert (status, answer) == (409, "corrections are being applied; wait for them")
        assert not client.finished()["failed"] and ids(out) == [1, 2, 3, 4, 5]


@pytest.mark.slow
def test_ctrl_c_ends_the_worker_too(out: Path) -> None:
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    with serving(out) as client:
        client.post(f"/edits?version={client.state()['version']}", edits_of(out, delete(out, 6)))
        while not workers_of(client):
            time.sleep(0.02)
    after = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    assert after == before
    with Workspace.open(out):  # no process holds its lock
        pass


# ---- Corrections of a recording with a map ----


@pytest.fixture(scope="module")
def two_sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with flat.map and the output folders of its two recordings, a and b."""
    top = tmp_path_factory.mktemp("flat")
    for name, start in (("a", 0), ("b", 4)):
        words = [str(ROOM / "room.mp4"), "-o", str(top / name), "--map", str(top / "flat.map")]
        words += ["--start", str(start), "--stop", str(start + 80), "--every", "8"]
        words += ["--detections", str(ROOM / "detections.npz"), "--poses", str(ROOM / "poses.txt")]
        words += ["--camera", "492.7568,492.7568,320,240"]
        assert rt.main(["run", *words, "--set", "embed.model=none", *SMALL, *WITHOUT_FILM]) == 0
    return top


@pytest.fixture
def flat(two_sessions: Path, tmp_path: Path) -> Path:
    """A copy of it; the options of the output folders name the copy of the map."""
    top = shutil.copytree(two_sessions, tmp_path / "flat")
    for config in top.glob("*/config.toml"):
        config.write_text(config.read_text().replace(str(two_sessions), str(top)))
    return top


def in_map(top: Path) -> Any:
    """What a map says of its objects, without the free numbers, which grow with each fit."""
    room = rt.RoomMap.load(top / "flat.map")
    seen = {
        o.id: [(x.session, x.status, x.center.round(6).tolist()) for x in o.observations
               if x.detected] for o in room.objects
    }  # fmt: skip
    return seen, {o.id: (o.name, o.deleted) for o in room.objects}, room.merged


def map_edits(top: Path) -> bytes:
    """A rename, a merge and a deletion of objects that both recordings have."""
    out = top / "b"
    shared = [o for o in rt.Result.load(out).located if len(in_map(top)[0].get(o.id, [])) == 2]
    refs = [delete(out, o.id)["object"] for o in shared[:4]]
    edits = [
        {"do": "rename", "object": refs[0], "class": "throne"},
        {"do": "delete", "object": refs[1]},
        {"do": "merge", "object": refs[2], "with": refs[3]},
    ]
    data = json.loads(edits_of(out, *edits))
    return json.dumps(data | {"map": rt.RoomMap.load(top / "flat.map").map_id}).encode()


def save(client: Client, text: bytes) -> None:
    """Save corrections as the page does, and wait until they are applied."""
    status, answer = client.post(f"/edits?version={client.state()['version']}", text)
    assert status == 200, answer
    state = client.finished()
    assert not state["failed"], state


def undo(client: Client) -> tuple[int, str]:
    return client.post(f"/undo?version={client.state()['version']}")


@pytest.mark.slow
def test_undo_restores_the_map(flat: Path) -> None:
    """Names, merged and deleted objects, and what both recordings saw."""
    before = in_map(flat)
    shown = [(o.id, o.class_name) for o in rt.Result.load(flat / "b").located]
    with serving(flat / "b") as client:
        save(client, map_edits(flat))
        _, names, merged = in_map(flat)
        assert ("throne", False) in names.values() and ("", True) in names.values()
        assert len(merged) == 1
        assert undo(client)[0] == 200 and not client.finished()["failed"]
    assert in_map(flat) == before
    assert [(o.id, o.class_name) for o in rt.Result.load(flat / "b").located] == shown
    assert not list((flat / "b/cache/undo").iterdir())


# ---- What is refused ----


def test_requests_without_the_token_are_refused(out: Path) -> None:
    with serving(out) as client:
        for path in ("/", "/state", "/recording", "/frame/0", "/objects.json", "/?token=", "/?x=1"):
            status, headers, text = client.ask(path)
            assert status == 403 and b"no token" in text and "Set-Cookie" not in headers
        wrong = client.token[:-1] + ("A" if client.token[-1] != "A" else "B")
        assert client.ask(f"/?token={wrong}")[0] == 403
        assert client.ask("/", Cookie=f"reobj_{client.port}=\u00e9")[0] == 403
        assert client.ask("/", Cookie=f"reobj_1={client.token}")[0] == 403  # of another port
        mine = f"reobj_{client.port}={client.token}"
        for other in ('layout={"a": [1, 2]}', "flag", "x=\u00e9"):  # cookies of other programs
            assert client.ask("/state", Cookie=f"{other}; {mine}")[0] == 200, other
        status, headers, _ = client.ask(f"/?token={client.token}")
        assert (status, headers["Location"]) == (303, "/")
        assert re.fullmatch(rf"reobj_{client.port}={client.token}; HttpOnly; .*Path=/",
                            headers["Set-Cookie"])  # fmt: skip
        status, headers, page = client.ask("/", Cookie=headers["Set-Cookie"].split(";")[0])
        assert status == 200 and b'id="served">{"recording"' in page
        assert client.token.encode() not in page
        for path in ("/", "/state", "/frame/1", "/none"):
            headers = client.get(path)[1]
            assert headers["Cache-Control"] == "no-store"
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert headers["Referrer-Policy"] == "no-referrer"
            assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"


def test_other_hosts_and_origins_are_refused(out: Path) -> None:
    """A name that an attacker's DNS sends here, and a page of another server."""
    with serving(out) as client:
        for host in (
            "evil.example",
            f"evil.example:{client.port}",
            "127.0.0.1",
            f"127.0.0.1:{client.port + 1}",
            "",
        ):
            assert client.get("/", Host=host)[0] == 403
            assert client.get(f"/?token={client.token}", Host=host)[0] == 403
        assert client.get("/", Host=f"localhost:{client.port}")[0] == 200
        path = f"/edits?version={client.state()['version']}"
        body = edits_of(out, delete(out, 6))
        for origin in ("http://evil.example", "null", f"https://127.0.0.1:{client.port}", ""):
            assert client.post(path, body, Origin=origin) == (403, "from another page")
        cookie = f"reobj_{client.port}={client.token}"
        assert client.ask(path, "POST", body, Cookie=cookie)[0] == 403  # without an origin
        assert client.ask(path, "POST", body, Origin=client.origin)[0] == 403  # without the token
        assert client.post("/", body)[0] == 404
        for length in (str(1 << 40), "9" * 5000, "-1", "1e3", ""):
            assert client.post(path, b"", Content_Length=length)[0] == 413
        assert client.ask(path, "PUT", body, Cookie=cookie)[0] == 501
        assert ids(out) == [1, 2, 3, 4, 5, 6] and not client.state()["running"]


def test_no_address_is_a_path(out: Path) -> None:
    """Nothing but the page, the state and frames: no other file, in the folder or outside."""
    (out / "secret.txt").write_text("secret")
    (out / "frame").mkdir()
    (out / "frame/1").symlink_to("/etc/passwd")
    with serving(out) as client:
        for path in (
            "/secret.txt", "/objects.json", "/cache/source.json", "/../out/secret.txt",
            "//etc/passwd", "/etc/passwd", "/frame/../secret.txt", "/frame/%2e%2e/secret.txt",
            "/%2e%2e/%2e%2e/etc/passwd", "/..%2f..%2fetc/passwd", "/frame/1/../../secret.txt",
            "/frame/-1", "/frame/64", "/frame/99999999999", "/frame/0x1", "/recording",
            "/recording/../secret.txt", "/./", "/scene.html", "C:\\secret.txt",
        ):  # fmt: skip
            status, _, text = client.get(path)
            assert (status, text) == (404, b"no such page\n"), path
        status, headers, picture = client.get("/frame/1")
        assert (status, headers["Content-Type"]) == (200, "image/jpeg")
        image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape[:2] == SIZE[::-1] and abs(int(image[9, 9, 1]) - 62) < 4


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("no folder", "no output folder of reobj_track"),
        ("no page", "make it with `objects"),
        ("link", "is a link out of the folder"),
        ("old page", "`objects OUT` makes it again"),
        ("foreign", "not a viewer that this version wrote"),
        ("not a number", "not a viewer"),
        ("port", "in use"),
        ("range", "0 to 65535 are possible"),
    ],
)
def test_bad_input_is_one_line(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str, said: str
) -> None:
    page = out / "scene.html"
    words = ["serve", str(tmp_path / "none" if fault == "no folder" else out)]
    text = {
        "old page": page.read_text().replace('"version":1,', "", 1),
        "not a number": page.read_text().replace('"version":1,', '"version":1,"x":NaN,', 1),
        "foreign": "<script>alert(1)</script>",
    }.get(fault, page.read_text())
    page.unlink()
    if fault == "link":
        page.symlink_to(tmp_path / "elsewhere.html")
    if fault != "no page":
        page.write_text(text)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = {"port": taken.getsockname()[1], "range": 70000}.get(fault, 0)
        assert rt.main([*words, "--port", str(port)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and error[:7] == "error: "
    assert not (tmp_path / "none").exists()


# ---- The recording ----


def test_the_recording_is_sent_in_ranges(film_folder: Path) -> None:
    data = (film_folder.parent / "walk #1.webm").read_bytes()
    size = len(data)
    with serving(film_folder) as client:
        status, headers, text = client.get("/recording")
        assert (status, text, headers["Accept-Ranges"]) == (200, data, "bytes")
        assert headers["Content-Type"] == "video/webm"
        for asked, first, last in (
            ("bytes=0-", 0, size - 1), ("bytes=5-9", 5, 9), (f"bytes=3-{size + 99}", 3, size - 1),
        ):  # fmt: skip
            status, headers, text = client.get("/recording", Range=asked)
            assert (status, text) == (206, data[first : last + 1])
            assert headers["Content-Range"] == f"bytes {first}-{last}/{size}"
        for asked in (f"bytes={size}-", "bytes=9-5"):
            status, headers, text = client.get("/recording", Range=asked)
            assert (status, text, headers["Content-Range"]) == (416, b"", f"bytes */{size}")
        assert client.ask("/recording")[0] == 403


# ---- In the browser ----


@pytest.mark.slow
def test_save_and_undo_in_the_browser(browser: Browser, out: Path) -> None:
    """A visit is split at the slider and saved; the page shows the new result, then the old one.

    The page is made of the data of scene.html: a script that somebody added to it does not run.
    """
    page = out / "scene.html"
    page.write_text(page.read_text().replace("</body>", "<script>hacked = 1</script></body>"))
    with serving(out) as client:
        browser.open(client.url, 1440, 900)
        here = "[location.href, $('edits').hidden, typeof hacked]"
        assert browser.eval(here) == [f"{client.origin}/", True, "undefined"]
        browser.eval("select(here[1]); goTo(13)")
        browser.eval("$('cut').querySelector('button').click()")
        browser.eval("window.old = 1; $('save').click()")
        browser.wait("!window.old && !job.running && S.edits.length === 1")
        assert ids(out) == [1, 2, 3, 4, 5, 6, 7]
        assert browser.eval("objects.map(o => [o.id, o.visits])")[-1] == [7, [[13, 39]]]
        browser.eval("window.old = 1; $('undo-saved').click()")
        browser.wait("!window.old && !job.running && S.edits.length === 0")
        assert browser.eval("objects.map(o => o.id)") == ids(out) == [1, 2, 3, 4, 5, 6]
        browser.eval("edit({do: 'delete', object: {id: 6, frame: 0, box: [1, 2, 3, 4]}})")
        browser.eval("$('save').click()")
        browser.wait("job.failed")
        fault = browser.eval("[$('job').textContent, $('job').className, $('save').disabled]")
        assert "no object has the box" in fault[0] and fault[1:] == ["fault", False]
        assert browser.errors == []
