"""Weights: lookup, verification, atomic download; onnxruntime sessions."""

from __future__ import annotations

import contextlib
import hashlib
import http.server
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj.sources import weights
from reobj.sources.onnx_layouts import LAYOUTS
from reobj.types import NOTE

BLOB = np.random.default_rng(0).integers(0, 256, 300_000, dtype=np.uint8).tobytes()
SHA256 = hashlib.sha256(BLOB).hexdigest()


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves BLOB; `server.mode` selects a failure."""

    server: Any

    def do_GET(self) -> None:
        mode = self.server.mode
        self.server.asked.append((self.path, self.headers.get("Range")))
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
    for server.mode, body in (("wrong", BLOB[::-1]), ("long", BLOB + b"more")):
        found = hashlib.sha256(body).hexdigest()
        with pytest.raises(rt.ReobjError, match=f"sha256 is {found}, not kept.*{SHA256}"):
            rt.model_path("toy")
        assert here(server) == []


@pytest.mark.parametrize("mode", ["cut", "cut without a length"])
def test_a_truncated_download_leaves_nothing_and_restarts(server: Any, mode: str) -> None:
    server.mode = mode
    with pytest.raises(rt.ReobjError, match=r"download failed .*: run again") as caught:
        rt.model_path("toy")
    assert "\n" not in str(caught.value) and here(server) == []
    server.mode = "good"
    assert rt.model_path("toy").read_bytes() == BLOB
    assert server.asked == [("/toy.onnx", None)] * 2  # the whole file, not a range of it


def test_without_network_the_message_has_a_remedy(server: Any) -> None:
    server.shutdown()
    server.server_close()
    with pytest.raises(rt.ReobjError, match=r"download failed .*refused") as caught:
        rt.model_path("toy")
    for part in (weights.WEIGHTS[0].url, SHA256, str(server.target), "REOBJ_MODELS"):
        assert part in str(caught.value)


def test_offline_forbids_the_download(server: Any) -> None:
    expected = f"model toy is not in {server.folder}, and --offline forbids the.*REOBJ_MODELS"
    with pytest.raises(rt.ReobjError, match=expected):
        rt.model_path("toy", offline=True)
    assert server.asked == [] and not server.folder.exists()


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


def test_a_changed_file_is_refused_but_not_deleted(server: Any) -> None:
    rt.model_path("toy")
    server.target.write_bytes(b"changed")
    with pytest.raises(rt.ReobjError, match="delete the file to fetch it again"):
        rt.model_path("toy")
    assert rt.model_path(server.target) == server.target  # by its path: not verified
    assert [row.state for row in rt.list_models()] == ["changed"]
    assert server.target.read_bytes() == b"changed"


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
    assert len(set(names)) == len(names) and rt.DetectConfig().model == names[0]
    fast = weights.known_weights("fast")
    assert fast is not None and fast.name == "deimv2-atto" and weights.known_weights("") is None
    layouts = {layout.name for layout in LAYOUTS.formats}
    for row in weights.WEIGHTS:
        assert re.fullmatch("[0-9a-f]{64}|[0-9a-f]{40}", row.digest)
        assert row.role == "backbone" or row.layout in layouts
        if row.url:
            assert "AGPL" not in row.licence and row.url.startswith("https://")
            assert len(row.url.split("/raw/")[1].split("/")[0]) == 40  # pinned at a commit
        else:
            assert (weights.own_models() / row.file).stat().st_size == row.size


# ---- Sessions ------------------------------------------------------------------------------------


def test_an_invalid_onnx_file_gives_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"no model")
    with pytest.raises(rt.ReobjError, match=r"a.onnx: onnxruntime cannot load it") as caught:
        weights.onnx_session(tmp_path / "a.onnx")
    assert "\n" not in str(caught.value)


REOBJ = weights.own_models() / "reobj.onnx"


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
