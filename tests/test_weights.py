"""Weights: lookup, verification, atomic download; onnxruntime sessions."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import http.server
import os
import re
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
import urllib.response
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import reobj_track as rt
from reobj.sources import weights
from reobj.sources.onnx_layouts import LAYOUTS
from reobj.types import NOTE

SHARED = Path(os.environ.get("REOBJ_SHARED", Path(__file__).resolve().parents[2] / "shared"))
needs_shared = pytest.mark.skipif(
    not (SHARED / "models").is_dir(), reason="no weights: set REOBJ_SHARED"
)
BLOB = np.random.default_rng(0).integers(0, 256, 300_000, dtype=np.uint8).tobytes()
SHA256 = hashlib.sha256(BLOB).hexdigest()
GIT_BLOB = hashlib.sha1(b"blob 300000\0" + BLOB).hexdigest()  # as `git hash-object` has it


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves BLOB; `server.mode` selects a failure."""

    server: Any

    def do_GET(self) -> None:
        mode = self.server.mode
        self.server.asked.append((self.path, self.headers.get("Range")))
        if mode == "portal":
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(b"<html>Welcome to our hotel</html>")
            return
        if mode == "moved" and self.path != "/there":
            self.send_response(302)
            self.send_header("Location", "/there")
            self.end_headers()
            return
        if mode == "slow":
            time.sleep(1.0)
        if mode == "404":
            self.send_error(404)
            return
        body = BLOB[::-1] if mode == "wrong" else BLOB + b"more" * (mode == "long")
        self.send_response(200)
        if not mode.endswith("without a length"):
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        with contextlib.suppress(OSError):  # a client that stops reading
            self.wfile.write(body[: 100_000 if mode.startswith("cut") else None])

    def log_message(self, *args: Any) -> None:
        pass


@pytest.fixture()
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A server on 127.0.0.1 with the weights "toy", and an empty cache folder."""
    made: Any = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    made.mode, made.asked = "good", []
    threading.Thread(target=made.serve_forever, args=(0.01,), daemon=True).start()
    url = f"http://127.0.0.1:{made.server_port}/toy.onnx"
    toy = weights.Weights("toy", "detector", "toy_416.onnx", url, SHA256, len(BLOB), "MIT")
    monkeypatch.setattr(weights, "WEIGHTS", (toy,))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("REOBJ_MODELS", raising=False)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    made.folder = tmp_path / "reobj_track"
    made.target = made.folder / "toy_416.onnx"
    yield made
    made.shutdown()
    made.server_close()


def here(server: Any) -> list[Path]:
    """Files in the folder of weights, but for its lock."""
    return sorted(p for p in server.folder.iterdir() if p.name != ".lock")


# ---- Download ------------------------------------------------------------------------------------


def test_a_download_is_announced_verified_and_done_once(
    server: Any, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(NOTE, "reobj_track")
    assert rt.model_path("toy") == server.target and server.target.read_bytes() == BLOB
    for shown in ("0.3 MB", "licence MIT", "http://127.0.0.1", "sha256 " + SHA256):
        assert shown in caplog.text
    by_name, by_file = rt.model_path("toy"), rt.model_path("toy_416.onnx", offline=True)
    assert by_name == by_file == server.target
    assert server.asked == [("/toy.onnx", None)]
    assert here(server) == [server.target]


def test_an_unexpected_file_is_not_kept(server: Any) -> None:
    page = b"<html>Welcome to our hotel</html>"
    for server.mode, body in (
        ("wrong", BLOB[::-1]), ("long", BLOB + b"more"), ("portal", page)
    ):  # fmt: skip
        found = hashlib.sha256(body).hexdigest()
        with pytest.raises(rt.ReobjError, match=f"sha256 is {found}, not kept.*{SHA256}"):
            rt.model_path("toy")
        assert here(server) == []


def test_a_git_blob_id_equals_that_of_git(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(BLOB)
    done = subprocess.run(
        ["git", "hash-object", tmp_path / "a"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == GIT_BLOB
    row = dataclasses.replace(weights.WEIGHTS[0], digest=GIT_BLOB)
    assert row.digest_of(tmp_path / "a") == GIT_BLOB


def test_a_download_ends_at_a_limit(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "FILE_MAX", 100_000)
    written: list[int] = []
    monkeypatch.setattr(weights.Progress, "step", lambda self, n: written.append(n))
    with pytest.raises(rt.ReobjError, match="not kept"):
        rt.model_path("toy")
    assert sum(written) < 200  # of 300 kB


def test_another_detector_is_suggested_but_not_used(
    server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The default is unavailable, the small one is installed: one line and exit code 2."""
    small = dataclasses.replace(weights.WEIGHTS[0], name="small", file="small.onnx", alias="fast")
    default = dataclasses.replace(weights.WEIGHTS[0], name="deimv2-femto", file="n.onnx")
    monkeypatch.setattr(weights, "WEIGHTS", (default, small))
    server.folder.mkdir()
    (server.folder / "small.onnx").write_bytes(BLOB)
    assert rt.model_path("fast") == rt.model_path("small") == server.folder / "small.onnx"
    (tmp_path / "im").mkdir()
    cv2.imwrite(str(tmp_path / "im/0.png"), np.zeros((48, 64, 3), np.uint8))
    server.mode = "404"
    command = ["run", str(tmp_path / "im"), "-o", str(tmp_path / "out")]
    for offline, asked in (["--offline"], 0), ([], 1):
        assert rt.main([*command, *offline]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        for part in ("model deimv2-femto", str(server.folder), default.url, "--detector fast"):
            assert part in error
        assert len(server.asked) == asked and not (tmp_path / "out/tracks.txt").exists()
    monkeypatch.setattr(weights, "WEIGHTS", (dataclasses.replace(default, alias="fast"),))
    with pytest.raises(rt.ReobjError) as caught:
        rt.model_path("fast")  # nothing smaller to suggest
    assert "--detector" not in str(caught.value)


@pytest.mark.parametrize("mode", ["cut", "cut without a length"])
def test_a_truncated_download_leaves_nothing_and_restarts(server: Any, mode: str) -> None:
    server.mode = mode
    with pytest.raises(rt.ReobjError, match=r"download failed .*: run again") as caught:
        rt.model_path("toy")
    assert "\n" not in str(caught.value) and here(server) == []
    server.mode = "good"
    assert rt.model_path("toy").read_bytes() == BLOB
    assert server.asked == [("/toy.onnx", None)] * 2  # the whole file, not a range of it


def test_ctrl_c_leaves_nothing(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(self: Any, n: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(weights.Progress, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rt.model_path("toy")
    assert here(server) == []


def test_404_names_url_and_hash(server: Any) -> None:
    server.mode = "404"
    expected = r"toy: download failed .HTTP Error 404.*sha256.*toy.onnx.*put it at"
    with pytest.raises(rt.ReobjError, match=expected):
        rt.model_path("toy")
    assert here(server) == []


def test_without_network_the_message_has_a_remedy(server: Any) -> None:
    server.shutdown()
    server.server_close()
    with pytest.raises(rt.ReobjError) as caught:
        rt.model_path("toy")
    url = weights.WEIGHTS[0].url
    for part in ("download failed", "refused", url, SHA256, str(server.target), "REOBJ_MODELS"):
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_offline_forbids_the_download(server: Any) -> None:
    expected = f"model toy is not in {server.folder}, and --offline forbids the.*REOBJ_MODELS"
    with pytest.raises(rt.ReobjError, match=expected):
        rt.model_path("toy", offline=True)
    assert server.asked == [] and not server.folder.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = Path.open

    def on_a_full_disk(path: Path, mode: str = "r", **options: Any) -> Any:
        return opened(Path("/dev/full") if mode == "wb" else path, mode, **options)

    monkeypatch.setattr(Path, "open", on_a_full_disk)
    why = r"toy.*\.onnx: cannot be written \(No space left on device\); make room"
    with pytest.raises(rt.ReobjError, match=why):
        rt.model_path("toy")
    assert here(server) == []


FETCHES = """
import dataclasses, logging, sys, reobj_track as rt
logging.basicConfig(level=20)
from reobj.sources import weights
weights.WEIGHTS = (weights.Weights(*eval(sys.argv[1])),)
print(rt.model_path("toy"))
"""


def test_simultaneous_downloads_are_one(server: Any) -> None:
    """One of two processes downloads, the other waits and uses the same file."""
    server.mode = "slow"
    row = repr(dataclasses.astuple(weights.WEIGHTS[0]))
    command = [sys.executable, "-c", FETCHES, row]
    pipe, root = subprocess.PIPE, str(Path(rt.__file__).parent)
    env = os.environ | {"PYTHONPATH": root}
    pair = [
        subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=env) for _ in range(2)
    ]
    said = [process.communicate(timeout=60) for process in pair]
    assert [out.strip() for out, _ in said] == [str(server.target)] * 2, said
    assert server.asked == [("/toy.onnx", None)] and server.target.read_bytes() == BLOB
    assert here(server) == [server.target]


# ---- Folders and states --------------------------------------------------------------------------


def test_the_users_folder_comes_first(
    server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own"
    own.mkdir()
    (own / "toy_416.onnx").write_bytes(BLOB)
    (own / "mine.onnx").write_bytes(b"anything")
    monkeypatch.setenv("REOBJ_MODELS", str(own))
    assert rt.model_path("toy") == own / "toy_416.onnx"
    for name in ("mine", "mine.onnx"):  # unknown to the table: not verified
        assert rt.model_path(name) == own / "mine.onnx"
    assert server.asked == []
    (own / "toy_416.onnx").unlink()
    assert rt.model_path("toy") == own / "toy_416.onnx"  # downloads go there too


@pytest.mark.parametrize(("variable", "expected"), [("", "home/.cache"), ("local", "local")])
def test_the_cache_of_the_user(
    server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, expected: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / variable) if variable else "")
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    assert rt.model_path("toy") == tmp_path / expected / "reobj_track" / "toy_416.onnx"


def test_a_changed_file_is_refused_but_not_deleted(server: Any) -> None:
    rt.model_path("toy")
    server.target.write_bytes(b"changed")
    for name in ("toy", "toy_416.onnx"):
        with pytest.raises(rt.ReobjError, match="delete the file to fetch it again"):
            rt.model_path(name)
    assert rt.model_path(server.target) == server.target  # by its path: not verified
    assert [row.state for row in rt.list_models()] == ["changed"]
    assert server.target.read_bytes() == b"changed"


def test_a_file_given_by_path_is_not_verified(
    server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "toy").write_bytes(b"mine")
    assert rt.model_path("toy") == Path("toy") and server.asked == []


def test_states_and_unknown_names(server: Any) -> None:
    (row,) = rt.list_models()
    assert (row.weights.name, row.state, row.path) == ("toy", "missing", None)
    assert server.asked == []  # listing does not download
    rt.model_path("toy")
    (row,) = rt.list_models()
    assert (row.state, row.path) == ("verified", server.target)
    expected = r"detector yolo99: no such file, nor one of the known names \(toy\)"
    with pytest.raises(rt.ReobjError, match=expected):
        rt.model_path("yolo99")


# ---- The table -----------------------------------------------------------------------------------


def test_table_of_weights() -> None:
    names = [row.name for row in weights.WEIGHTS]
    assert len(set(names)) == len(names) and rt.DetectConfig().model == "deimv2-femto" == names[0]
    fast = weights.known_weights("fast")
    assert fast is not None and fast.name == "deimv2-atto" and weights.known_weights("") is None
    not_run = {row.name for row in weights.WEIGHTS if "not run here" in row.note}
    assert not_run == {"deimv2-n", "deimv2-pico"}
    for row in weights.WEIGHTS:
        assert re.fullmatch("[0-9a-f]{64}|[0-9a-f]{40}", row.digest)
        assert row.role in ("detector", "backbone") and (row.size > 0 or len(row.digest) == 40)
        names = {layout.name for layout in LAYOUTS.formats}
        assert row.layout in names if row.role == "detector" else row.layout == ""
        if row.url:
            assert "AGPL" not in row.licence
            assert urllib.parse.urlparse(row.url).scheme == "https"
            assert len(row.url.split("/raw/")[1].split("/")[0]) == 40  # pinned at a commit
        else:
            assert (weights.own_models() / row.file).stat().st_size == row.size


def test_bundled_weights_need_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("REOBJ_MODELS", raising=False)
    assert rt.model_path("reobj", offline=True).parent == weights.own_models()


@needs_shared
def test_table_agrees_with_the_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REOBJ_MODELS", str(SHARED / "models"))
    here = [row for row in rt.list_models() if row.state != "missing"]
    assert {"deimv2-femto", "deimv2-atto", "reobj"} <= {row.weights.name for row in here}
    for row in here:
        assert row.state == "verified" and row.path, row
        assert row.path.stat().st_size == row.weights.size or not row.weights.size


# ---- Sessions ------------------------------------------------------------------------------------


def test_a_model_is_loaded_with_its_metadata() -> None:
    session = weights.onnx_session(weights.own_models() / "reobj.onnx", threads=1)
    assert session.get_session_options().intra_op_num_threads == 1
    metadata = weights.onnx_metadata(session)
    assert isinstance(metadata, dict) and metadata


def test_an_invalid_onnx_file_gives_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"no model")
    with pytest.raises(rt.ReobjError, match=r"a.onnx: onnxruntime cannot load it") as caught:
        weights.onnx_session(tmp_path / "a.onnx")
    assert "\n" not in str(caught.value)


def test_a_missing_onnxruntime_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(rt.ReobjError, match="pip install onnxruntime"):
        weights.onnx_session(Path("any.onnx"))


REOBJ = weights.own_models() / "reobj.onnx"


def test_an_unknown_device_is_named() -> None:
    assert weights.onnx_session(REOBJ, 1, "cpu").get_providers() == ["CPUExecutionProvider"]
    with pytest.raises(rt.ReobjError, match=r"--device gpu: this onnxruntime has .*cpu.* only$"):
        weights.onnx_session(REOBJ, 1, "gpu")


@pytest.mark.parametrize(
    ("device", "provider"),
    [("cuda", "CUDA"), ("tensorrt", "Tensorrt"), ("coreml", "CoreML"), ("directml", "Dml"),
     ("openvino", "OpenVINO"), ("migraphx", "MIGraphX")],
)  # fmt: skip
def test_a_missing_device_is_one_line(
    device: str, provider: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """From the command line: what this onnxruntime has."""
    import onnxruntime

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((48, 64, 3), np.uint8))
    words = ["track", str(tmp_path), "-o", str(tmp_path / "out"), "--device", device]
    assert rt.main([*words, "--detector", str(REOBJ)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"error: --device {device}: this onnxruntime has cpu only; ")
    assert f"{provider}ExecutionProvider needs another package" in line
    assert not (tmp_path / "out" / "tracks.txt").exists()


@pytest.mark.parametrize("starts", [True, False])
def test_a_device_selects_its_provider(monkeypatch: pytest.MonkeyPatch, starts: bool) -> None:
    """onnxruntime falls back to the CPU if a provider fails: that must be reported."""
    import onnxruntime

    own = "CoreMLExecutionProvider"
    asked = []

    class Session:
        def __init__(self, path: str, options: Any, providers: list[str]) -> None:
            asked.append(providers)

        def get_providers(self) -> list[str]:
            return asked[-1] if starts else asked[-1][1:]

    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [own])
    if starts:
        weights.onnx_session(REOBJ, 1, "coreml")
    else:
        with pytest.raises(rt.ReobjError, match=f"--device coreml: {own} did not start"):
            weights.onnx_session(REOBJ, 1, "coreml")
    assert asked == [[own, "CPUExecutionProvider"]]


def test_imagenet_constants_are_those_of_torchvision() -> None:
    np.testing.assert_allclose(np.divide(weights.IMAGENET_MEAN, 255), [0.485, 0.456, 0.406])
    np.testing.assert_allclose(np.divide(weights.IMAGENET_STD, 255), [0.229, 0.224, 0.225])
