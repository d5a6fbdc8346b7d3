"""Atomic files, JSON and npz, progress, and text for messages."""

from __future__ import annotations

import base64
import errno
import importlib.util
import io
import json
import math
import os
import re
import struct
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj import files

# ---- Atomic files --------------------------------------------------------------------------------


def test_a_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"  # in a folder that is not there yet
    with files.atomic(path) as part:
        part.write_text("half")
        assert part.parent == path.parent and not path.exists()  # the same disk: a rename is atomic
        part.write_text("whole")
    assert path.read_text() == "whole" and list(path.parent.iterdir()) == [path]
    with files.atomic(path) as part:
        part.write_text("new")
        assert path.read_text() == "whole"
    assert path.read_text() == "new" and list(path.parent.iterdir()) == [path]


def test_a_file_is_synced_before_it_is_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    replace, sync = Path.replace, os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: done.append("sync") or sync(handle))
    monkeypatch.setattr(Path, "replace", lambda *a: done.append("rename") or replace(*a))
    with files.atomic(tmp_path / "a.txt") as part:
        part.write_text("whole")
    assert done == ["sync", "rename"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_error_keeps_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), files.atomic(path) as part:
        part.write_text("new, but only ha")
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_temporary_file_of_a_killed_run_is_replaced(tmp_path: Path) -> None:
    with files.atomic(tmp_path / "a.txt") as part:
        part.touch()
    (tmp_path / "a.txt").rename(part)
    part.write_text("left behind by a kill, and longer")
    with files.atomic(tmp_path / "a.txt") as part:
        part.write_text("new")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["new"]


# ---- Text, JSON, npz -----------------------------------------------------------------------------


def test_text_with_and_without_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for data in ("größer".encode(), b"\xef\xbb\xbf" + "größer".encode()):
        path.write_bytes(data)
        assert files.read_text(path) == "größer"
    path.write_bytes("größer".encode("latin-1"))
    with pytest.raises(rt.ReobjError, match=f"^{tmp_path}: is a folder, expected a text file"):
        files.read_text(tmp_path)
    for bad in (path, tmp_path / "none"):
        with pytest.raises(rt.ReobjError, match=f"^{bad}: cannot be read as text"):
            files.read_text(bad)


def test_json_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, 2.5, null]}')
    assert files.load_json(path) == {"a": [1, 2.5, None]}
    path.write_text('{"a": 1,\n\n"b" 2}')
    with pytest.raises(rt.ReobjError, match=r"a\.json, line 3: not valid JSON"):
        files.load_json(path)


def test_endless_text_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MEMORY_MAX", 24 << 20)
    with pytest.raises(rt.ReobjError, match=r"/dev/zero: more than 3 MB of text"):
        files.read_text(Path("/dev/zero"))
    (tmp_path / "a.txt").write_text("x" * (3 << 20))
    assert len(files.read_text(tmp_path / "a.txt")) == 3 << 20


@pytest.mark.parametrize(
    ("limit", "most", "text", "what"),
    [
        (
            "LINES_MAX",
            3,
            "a\nb\nc\nd\n",
            "a.txt: 4 lines, at most 3 are allowed; cut it into pieces",
        ),
        ("LINES_MAX", 3, "a\x0bb\x1cc\u2028d\x85e", "a.txt: 4 lines, at most 3 are allowed"),
        ("MEMORY_MAX", 8 * 9, "a\n" * 5, "a.txt: more than 0 MB of text"),
    ],
)
def test_tables_have_a_size_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int, text: str, what: str
) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    assert "".join(files.read_lines(path)) == text
    monkeypatch.setattr(files, limit, most)
    with pytest.raises(rt.ReobjError, match=what):
        files.read_lines(path)


def test_a_line_has_a_size_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("ab\n" + "c" * (4194304 - 1) + "\n")
    assert list(map(len, files.read_lines(path))) == [3, 4194304]
    path.write_text("ab\n" + "c" * 4194304 + "\n")
    what = "a.txt: a line of 4194305 characters, at most 4194304 are allowed"
    with pytest.raises(rt.ReobjError, match=what):
        files.read_lines(path)


def test_lines_equal_those_of_the_whole_text(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n\nd")
    assert files.read_lines(path) == ["a\n", "b\n", "c\n", "\n", "d"]
    path.write_bytes(b"")
    assert files.read_lines(path) == []


@pytest.mark.parametrize("text", ["[" + "[]," * 9 + "0]", "[" + "{}," * 9 + "0]", "[1,2,3,4]"])
def test_json_is_refused_before_it_takes_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """The memory used is less than the estimate, and the estimate is what is limited."""
    path, taken = tmp_path / "a.json", 64 * (text.count(",") + text.count("["))
    taken += 200 * text.count("{")
    path.write_text(text)
    monkeypatch.setattr(files, "MEMORY_MAX", taken)
    files.load_json(path)
    monkeypatch.setattr(files, "MEMORY_MAX", taken - 1)
    with pytest.raises(rt.ReobjError, match=r"a.json: would take 0 MB of memory, at most 0 MB"):
        files.load_json(path)


@pytest.mark.parametrize("item", ["[],", "{},", '{"a":1},', "1.5,", '"ab",', "[1.5,2.5,3.5],"])
def test_json_uses_no_more_memory_than_estimated(tmp_path: Path, item: str) -> None:
    """Measured by Python's allocations; 2 MB of worst-case text."""
    path, text = tmp_path / "a.json", "[" + item * (2_000_000 // len(item)) + "0]"
    path.write_text(text)
    reckoned = files.json_memory(text)
    tracemalloc.start()
    try:
        data = files.load_json(path)
        taken = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert len(data) > 1000 and taken < 1.3 * reckoned


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' * 100_000])
def test_unusual_json(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(rt.ReobjError, match=r"a\.json: invalid JSON"):
        files.load_json(tmp_path / "a.json")


def test_npz_round_trip(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "names": np.array(["x", "yy"])}
    files.save_npz(tmp_path / "a.npz", arrays, version=2, of={"up": None})
    found, metadata = files.load_npz(tmp_path / "a.npz")
    assert found.keys() == arrays.keys() and metadata == {"version": 2, "of": {"up": None}}
    for key, value in arrays.items():
        np.testing.assert_array_equal(found[key], value)
    files.save_npz(tmp_path / "b.npz", arrays, version=2, of={"up": None})
    assert (tmp_path / "b.npz").read_bytes() == (tmp_path / "a.npz").read_bytes()
    np.savez(tmp_path / "c.npz", a=1)  # of other tools: no metadata
    assert files.load_npz(tmp_path / "c.npz") == ({"a": 1}, {})


def test_damaged_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    files.save_npz(path, {"a": np.random.default_rng(0).random(999)})
    whole = path.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 1  # one bit
    objects = io.BytesIO()
    np.savez(objects, a=np.array([{"code": 1}], object))  # pickled: could run anything
    for data in (whole[:-40], bytes(changed), b"", b"no zip", objects.getvalue()):
        path.write_bytes(data)
        with pytest.raises(rt.ReobjError, match=r"a\.npz: damaged, or no npz file"):
            files.load_npz(path)


def test_an_npz_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused by its directory: nothing is decompressed."""
    files.save_npz(tmp_path / "a.npz", {"a": np.zeros(3 << 20, np.uint8)})
    assert (tmp_path / "a.npz").stat().st_size < 9000
    monkeypatch.setattr(files, "MEMORY_MAX", 4 << 20)
    monkeypatch.setattr(np, "load", None)
    with pytest.raises(rt.ReobjError, match=r"a\.npz: .*unpacks to 3 MB, at most 2 MB are allowed"):
        files.load_npz(tmp_path / "a.npz")


def test_a_checksummed_npz_is_verified(tmp_path: Path) -> None:
    path, arrays = tmp_path / "a.npz", {"a": np.arange(6), "b": np.float32([[1, 2]])}
    files.save_npz(path, arrays, version=2)
    found, metadata = files.load_npz(path, sealed=True)
    assert metadata == {"version": 2} and found["a"].tolist() == [0, 1, 2, 3, 4, 5]
    stored = dict(np.load(path))
    for name, other in {
        "a": np.arange(6)[::-1],
        "b": np.float32([[1], [2]]),  # the same bytes in another shape, or another type
        "c": np.arange(2),
        "metadata": np.array(str(stored["metadata"]).replace('"version": 2', '"version": 3')),
    }.items():
        np.savez(path, **(stored | {name: other}))
        files.load_npz(path)  # of other tools: no checksum
        with pytest.raises(rt.ReobjError, match="the content does not match its digest"):
            files.load_npz(path, sealed=True)
    np.savez(path, **arrays)
    with pytest.raises(rt.ReobjError, match="the content does not match its digest"):
        files.load_npz(path, sealed=True)


def test_a_damaged_cache_file_is_reported_and_removed(tmp_path: Path, caplog: Any) -> None:
    path = tmp_path / "a.json"
    assert files.load_cached(path, files.load_json) is None and not caplog.records
    path.write_text("[1]")
    assert files.load_cached(path, files.load_json) == [1]
    path.write_text("[1")
    assert files.load_cached(path, files.load_json) is None and not path.exists()
    (record,) = caplog.records
    assert "a.json, line 1: not valid JSON" in record.message
    assert record.message.endswith("; it is removed and computed again")


def test_a_full_disk_gives_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(rt.ReobjError, match=r"a\.npz: cannot be written .No space left on device"):
        files.save_npz(tmp_path / "a.npz", {})
    assert not list(tmp_path.iterdir())


def test_other_errors_are_not_caught(tmp_path: Path) -> None:
    """Such as an error of another file read within the block."""
    elsewhere = OSError(errno.EACCES, "Permission denied", "/elsewhere/input.txt")
    for error in (elsewhere, OSError(errno.ENOENT, "No such file"), OSError("unknown")):
        with pytest.raises(OSError) as raised, files.atomic(tmp_path / "a.txt"):
            raise error
        assert raised.value is error


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(errno.ENOSPC, "full"), r"a\.txt: .*No space left.*make room on this disk"),
        (OSError(errno.EROFS, "read-only"), "not read-only"),
        (OSError("1024 requested and 16 written"), "make room on this disk"),  # NumPy
    ],
)
def test_disk_errors_name_the_path_and_a_remedy(tmp_path: Path, error: OSError, text: str) -> None:
    with pytest.raises(rt.ReobjError, match=text), files.atomic(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise error
    assert not list(tmp_path.iterdir())


# ---- Several files together, locks ---------------------------------------------------------------


def test_staged_files_appear_together(tmp_path: Path) -> None:
    """Also in folders; other files are kept, leftovers of a killed run are deleted."""
    (tmp_path / "a.txt").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / files.PART_RESULTS).mkdir()
    (tmp_path / files.PART_RESULTS / "left.txt").write_text("of a killed run")
    with files.staged(tmp_path) as new:
        (new / "a.txt").write_text("new")
        (new / "cache").mkdir()
        (new / "cache/b.txt").write_text("new")
        assert (tmp_path / "a.txt").read_text() == "old"
    found = {str(p.relative_to(tmp_path)): p.read_text() for p in tmp_path.rglob("*.txt")}
    assert found == {"a.txt": "new", "cache/b.txt": "new", "notes.txt": "mine"}


def test_a_full_disk_keeps_all_old_files(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    where = rf"{tmp_path.name}/b\.txt: cannot be written"  # not the folder that is deleted again
    with pytest.raises(rt.ReobjError, match=where), files.staged(tmp_path) as new:
        (new / "a.txt").write_text("new")
        with files.atomic(new / "b.txt"):
            raise OSError(errno.ENOSPC, "full")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"]


def test_a_lock_has_one_holder(tmp_path: Path) -> None:
    with files.locked(tmp_path / "lock"):
        began = time.monotonic()
        with pytest.raises(files.LockedError), files.locked(tmp_path / "lock", 0.2):
            pass
        assert time.monotonic() - began >= 0.2
    with files.locked(tmp_path / "lock"):
        pass


class Windows:
    """Emulates msvcrt: a byte locked by one open file is refused to others."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        self.held: dict[int, int] = {}  # by the file: the handle

    def locking(self, handle: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1) and os.lseek(handle, 0, os.SEEK_CUR) == 0
        file = os.fstat(handle).st_ino
        if file in self.held:
            raise OSError(errno.EACCES, "Permission denied")
        self.held[file] = handle


def test_a_lock_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same module without fcntl, with msvcrt."""
    windows = Windows()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "msvcrt", windows)
    monkeypatch.setitem(sys.modules, "fcntl", None)  # an import fails
    spec = importlib.util.spec_from_file_location("files_on_windows", files.__file__)
    assert spec is not None and spec.loader is not None
    there = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(there)
    with there.locked(tmp_path / "lock"):
        with pytest.raises(there.LockedError), there.locked(tmp_path / "lock", 0.1):
            pass
        with there.locked(tmp_path / "other"):
            pass
    windows.held.clear()  # the system does so when the file is closed
    with there.locked(tmp_path / "lock"):
        pass


def test_missing_locks_are_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as some network drives: two concurrent runs are better than none."""

    def no_locks(_: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(files, "_take_lock", no_locks)
    with files.locked(tmp_path / "lock"), files.locked(tmp_path / "lock"):
        pass


# ---- Progress ------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that `time.monotonic` shows: set item 0."""
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def last_line(screen: Terminal) -> str:
    return screen.getvalue().split("\r")[-1]


def test_progress_shows_percentage_rate_and_remaining_time(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    progress = files.Progress("track", 200)
    clock[0] += 4
    progress.step(20)  # 5 a second, 180 left: 36 s
    clock[0] += 0.01
    progress.step()  # too soon to be visible
    assert screen.getvalue() == "\rtrack     20/200  10 %, 36 s left, 5.0/s\x1b[K"
    clock[0] += 5.99
    progress.step(9)  # slower: 10 steps in 6 s, the 20 in 4 s before count exp(-6 / 10) of that
    assert last_line(screen) == "track     30/200  15 %, 1 min 10 s left, 2.6/s\x1b[K"
    assert progress.close() == pytest.approx(10)
    assert last_line(screen) == "track     30/30 100 %, 10.0 s, 3.0/s\x1b[K\n"


def test_the_first_step_has_no_rate_of_millions(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Instantly cached results: the line shows the count and no rate."""
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    with files.Progress("track", 240) as progress:
        for _ in range(240):
            clock[0] += 1e-7
            progress.step()
    assert screen.getvalue() == "\rtrack     ...\x1b[K\rtrack     240/240 100 %, 0.0 s\x1b[K\n"


@pytest.mark.parametrize("total", [90, 100, 110])
def test_a_stage_ends_at_100_percent_only_when_it_is_complete(
    clock: list[float], monkeypatch: pytest.MonkeyPatch, total: int
) -> None:
    """Videos may announce a wrong length; 100 % is never shown before the end."""
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    with files.Progress("track", total) as progress:
        for _ in range(100):
            clock[0] += 1
            progress.step()
            assert "100 %" not in screen.getvalue()
    assert last_line(screen) == "track     100/100 100 %, 100.0 s, 1.0/s\x1b[K\n"
    with pytest.raises(KeyboardInterrupt), files.Progress("track", total) as progress:
        clock[0] += 4
        progress.step(8)
        raise KeyboardInterrupt
    assert last_line(screen) == f"track     8/{total}, 4.0 s, not finished, 2.0/s\x1b[K\n"


def test_a_stage_without_steps_is_shown_while_it_runs(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    with files.Progress("objects"):
        assert screen.getvalue() == "\robjects   ...\x1b[K"
        clock[0] += 4
    assert last_line(screen) == "objects   4.0 s\x1b[K\n"


def test_progress_without_a_total(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    progress = files.Progress("live")
    clock[0] += 2
    progress.step(3)
    assert screen.getvalue() == "\rlive      3, 1.5/s\x1b[K"


def test_a_short_stage_is_silent_without_a_terminal(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with files.Progress("track", 200) as progress:
        clock[0] += 0.5
        progress.step(20)
    assert progress.close() == 0.5 and capsys.readouterr().err == ""


def test_a_long_stage_leaves_plain_lines_in_a_log(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    """One every 10 s and one at the end, without control characters."""
    with files.Progress("track", 100) as progress:
        for _ in range(25):
            clock[0] += 1
            progress.step(4)
    assert capsys.readouterr().err.splitlines() == [
        "track     44/100  44 %, 14 s left, 4.0/s",
        "track     88/100  88 %, 3 s left, 4.0/s",
        "track     100/100 100 %, 25.0 s, 4.0/s",
    ]


def test_serve_gets_a_line_each_half_second(
    clock: list[float], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a variable of the environment of its worker."""
    monkeypatch.setenv("REOBJ_PROGRESS_S", "0.5")
    with files.Progress("objects", 100) as progress:
        for _ in range(20):
            clock[0] += 0.25
            progress.step(5)
    assert len(capsys.readouterr().err.splitlines()) >= 5  # of a stage of 5 s


def test_without_stderr_progress_is_only_measured(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As under pythonw."""
    monkeypatch.setattr("sys.stderr", None)
    with files.Progress("track", 600) as progress:
        clock[0] += 100
        progress.step(4)
    assert progress.seconds == 100


def test_the_time_left_follows_a_stage_that_becomes_slower(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first half was in the cache: 300 frames a second, then 10."""
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    progress = files.Progress("detect", 18_000)
    for rate, seconds in ((300, 30), (10, 90)):
        for _ in range(10 * seconds):
            clock[0] += 0.1001
            progress.step(rate // 10)
    left = re.search(r"(\d+) min", last_line(screen))
    assert left is not None and 10 <= int(left[1]) <= 14  # 8100 / 10 s = 13.5 min


def test_uneven_steps_change_the_time_left_little(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every tenth step takes 5 s, the others .5 s: the true rate is 10 in 9.5 s."""
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    progress = files.Progress("match", 200)
    for k in range(100):
        clock[0] += 5 if k % 10 == 9 else 0.5
        progress.step()
        found = re.search(r"(?:(\d+) min )?(?:(\d+) s )?left", last_line(screen))
        if k >= 30 and found:
            left = 60 * int(found[1] or 0) + int(found[2] or 0)
            assert 0.7 < left / (0.95 * (199 - k)) < 1.5


def test_steps_of_an_earlier_run_are_not_in_the_rate(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    with files.Progress("track", 200) as progress:
        progress.resume(100)
        assert last_line(screen) == "track     100/200  50 %, continued\x1b[K"
        clock[0] += 5
        progress.step(50)
        assert last_line(screen) == "track     150/200  75 %, 5 s left, 10.0/s\x1b[K"
    assert last_line(screen) == "track     150/150 100 %, 5.0 s, 10.0/s\x1b[K\n"


def test_shares_of_the_work_are_shown_as_percent_only(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    with files.Progress("objects", 1000, counted=False) as progress:
        clock[0] += 4
        progress.step(250)
        assert last_line(screen) == "objects   25 %, 12 s left\x1b[K"
    assert last_line(screen) == "objects   100 %, 4.0 s\x1b[K\n"


def test_durations_are_readable() -> None:
    found = [files.duration(s) for s in (0.4, 59.4, 59.6, 64, 130, 3594, 3596, 3660, 9000)]
    assert found == ["0 s", "59 s", "1 min", "1 min", "2 min 10 s", "59 min 50 s", "1 h",
                     "1 h 1 min", "2 h 30 min"]  # fmt: skip


# ---- Text for messages ---------------------------------------------------------------------------


def test_lists_are_shortened() -> None:
    assert files.shortened([]) == "" and files.shortened([1, 2, 3, 4, 5]) == "1, 2, 3, 4, 5"
    assert files.shortened("abcdef") == "a, b, c, d, e, ..."


def test_long_lines_are_wrapped() -> None:
    lines = files.wrapped("distinct objects: " + ", ".join(f"{i} chairs" for i in range(40)))
    assert len(lines) > 1 and max(map(len, lines)) <= 100
    assert all(line.startswith("  ") for line in lines[1:])
    assert files.wrapped("/a/path/" + "x" * 200) == ["/a/path/" + "x" * 200]  # can be copied


@pytest.mark.parametrize(
    ("word", "expected"),
    [("chiar", "; did you mean chair?"), ("zebra", ""), ("chair", "; did you mean chair?")],
)
def test_a_misspelt_word_gets_the_closest_suggestion(word: str, expected: str) -> None:
    assert files.did_you_mean(word, ("cup", "chair", "bowl")) == expected


@pytest.mark.parametrize(
    ("numbers", "step", "expected"),
    [
        ([], 1, ""),
        ([7], 1, "7"),
        ([3, 4, 5, 9], 1, "3-5, 9"),
        ([0, 10, 20, 40], 10, "0-20, 40"),  # every tenth frame
    ],
)
def test_spans(numbers: list[int], step: int, expected: str) -> None:
    assert files.spans(numbers, step) == expected


def test_numbers_for_json() -> None:
    assert files.rounded(1.23456, 2) == 1.23 and files.rounded(None, 2) is None
    assert [files.rounded(v, 2) for v in (math.nan, math.inf)] == [None, None]
    text = json.dumps(files.numbers(np.array([[1 / 3, 2e-9 / 3], [123456.789, 0]])))
    assert text == "[0.333333, 6.66667e-10, 123457.0, 0.0]"


def test_arrays_as_text() -> None:
    array = np.array([[1.5, 2], [3, 4]]).T  # not in C order
    assert base64.b64decode(files.base64_text(array, "<f4")) == struct.pack("<4f", 1.5, 3, 2, 4)
