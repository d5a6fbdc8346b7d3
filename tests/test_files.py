"""Files: complete or not at all, locks, text, JSON, npz; progress; text for messages."""

from __future__ import annotations

import errno
import io
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj import files

# ---- Files that appear when they are complete ----


def test_a_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"  # in a folder that is not there yet
    for text in ("whole", "new"):
        before = path.read_text() if path.exists() else None
        with files.atomic(path) as part:
            part.write_text(text)
            assert part.parent == path.parent  # the same disk: a rename is atomic
            assert before == (path.read_text() if path.exists() else None)
        assert path.read_text() == text and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_keeps_the_old_files(tmp_path: Path, error: type[BaseException]) -> None:
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text("old")
    with pytest.raises(error), files.atomic(tmp_path / "a.txt") as part:
        part.write_text("new, but only ha")
        raise error
    with pytest.raises(error), files.staged(tmp_path) as folder:
        (folder / "b.txt").write_text("new")
        raise error
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"a.txt": "old", "b.txt": "old"}


def test_staged_files_appear_together(tmp_path: Path) -> None:
    """A folder in the place of a file is refused before any is replaced; other files stay."""
    for name in ("a.txt", "other.txt"):
        (tmp_path / name).write_text("old")
    with files.staged(tmp_path) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "b.txt").write_text("new")
        (folder / "a.txt").write_text("new")
        assert (tmp_path / "a.txt").read_text() == "old"
    found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert (
        found == {"a.txt", "other.txt", "sub/b.txt"} and (tmp_path / "a.txt").read_text() == "new"
    )
    (tmp_path / "c.txt").mkdir()
    with pytest.raises(rt.ReobjError, match=r"c\.txt: .*move it away"), files.staged(tmp_path) as f:
        for name in ("a.txt", "c.txt"):
            (f / name).write_text("newer")
    assert (tmp_path / "a.txt").read_text() == "new"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS])
def test_a_disk_error_is_one_line_that_names_the_file(tmp_path: Path, number: int) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(rt.ReobjError, match=rf"{path}: cannot be written \(") as caught:
        with files.atomic(path) as part:
            raise OSError(number, "text", str(part))
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
    with pytest.raises(OSError, match=r"video\.mp4") as other, files.atomic(path):
        raise OSError(number, "text", "/data/video.mp4")  # an input
    assert not isinstance(other.value, rt.ReobjError)


def test_a_lock_has_one_holder(tmp_path: Path) -> None:
    """Another process is refused, or waits; the lock of a killed one is free."""
    path = tmp_path / "new" / "lock"
    code = "import sys; from pathlib import Path; from reobj.files import locked\n"
    code += "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=Path(rt.__file__).parent
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(files.LockedError, match="lock: locked"), files.locked(path):
            pass
        other.kill()
    with files.locked(path, wait_s=5):
        with pytest.raises(files.LockedError), files.locked(path):
            pass


# ---- Text, JSON, npz ----


def test_text_with_and_without_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for data in ("größer".encode(), b"\xef\xbb\xbf" + "größer".encode()):
        path.write_bytes(data)
        assert files.read_text(path) == "größer"
    path.write_bytes("größer".encode("latin-1"))
    for bad in (path, tmp_path / "none", tmp_path):
        with pytest.raises(rt.ReobjError, match=f"^{bad}: "):
            files.read_text(bad)
    path.write_text("x" * 9)
    with pytest.raises(rt.ReobjError, match="cut it into pieces"):
        files.read_text(path, most=8)


def test_json_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, 2.5, null]}')
    assert files.load_json(path) == {"a": [1, 2.5, None]}
    for text, said in (
        ('{"a": 1,\n\n"b" 2}', r"a\.json, line 3: not valid JSON"),
        ("[" * 100_000, r"a\.json: invalid JSON"),
        ("[\n" + "9" * 309, r"a\.json: a number of more than 308 digits"),
    ):
        path.write_text(text)
        with pytest.raises(rt.ReobjError, match=said):
            files.load_json(path)


def test_npz_round_trip_and_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same input gives the same bytes; damage and changed content are noticed."""
    path = tmp_path / "a.npz"
    arrays = {"x": np.arange(6.0).reshape(2, 3), "names": np.array(["a", "größer"])}
    files.save_npz(path, arrays, frames=[1, 2])
    data = path.read_bytes()
    files.save_npz(path, arrays, frames=[1, 2])
    assert path.read_bytes() == data
    found, facts = files.load_npz(path, sealed=True)
    assert facts == {"frames": [1, 2]} and found.keys() == arrays.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(found[name], values)
    np.savez(path, **(dict(np.load(path)) | {"x": np.zeros(3)}))
    assert files.load_npz(path)[0]["x"].shape == (3,)
    for bad in (path.read_bytes(), data[:-9], b"", b"hello"):
        path.write_bytes(bad)
        with pytest.raises(rt.ReobjError, match=r"a\.npz: damaged, or no npz file"):
            files.load_npz(path, sealed=True)
    path.write_bytes(data)
    monkeypatch.setattr(files, "MEMORY_MAX", 100)  # a zip bomb
    with pytest.raises(rt.ReobjError, match="at most"):
        files.load_npz(path)


def test_a_damaged_cache_file_is_reported_and_removed(tmp_path: Path, caplog: Any) -> None:
    path = tmp_path / "a.npz"
    assert files.load_cached(path, files.load_npz) is None and not caplog.records
    path.write_text("hello")
    assert files.load_cached(path, files.load_npz) is None and not path.exists()
    assert "computed again" in caplog.text


# ---- Progress ----


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("total", "steps"), [(4, 4), (9, 4), (0, 4), (4, 9)])
def test_a_stage_ends_at_its_steps(total: int, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal one line, at 100 % whatever was expected, unless it ends with an error."""
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with files.Progress("detect", total) as line:
        for _ in range(steps):
            line.step()
    assert line.done == steps and line.seconds > 0
    last = screen.getvalue().split("\r")[-1]
    assert last.endswith("\n") and f"{steps}/{steps}" in last and "100%" in last
    with pytest.raises(ValueError, match="x"), files.Progress("detect", 9):
        raise ValueError("x")
    assert "100%" not in screen.getvalue().split("\n")[-2]


def test_a_log_file_gets_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    with files.Progress("quick", 3) as line:
        line.step(3)
    assert screen.getvalue() == ""
    monkeypatch.setenv("REOBJ_PROGRESS_S", "0")
    with files.Progress("objects", 1000) as line:
        time.sleep(0.01)
        line.step(250)
    (text,) = screen.getvalue().splitlines()
    assert text.startswith("objects") and "25%" in text and "250/1000" in text


# ---- Text for messages, numbers for JSON ----


def test_texts_for_messages() -> None:
    assert files.did_you_mean("zzz", ["cup"]) == ""
    assert files.spans([0, 2, 4, 9], 2) == "0-4, 9"
    assert files.texts_with_sigma(np.array([0.44444]), None) == [("0.444",)]
    assert files.rounded(float("nan"), 2) is files.rounded(None, 2) is None
    assert files.rounded(1.23456, 2) == 1.23


def test_numbers_of_large_coordinates_keep_the_size_of_the_object() -> None:
    """To a millionth of it, as in a map projection; six digits otherwise."""
    values = np.array([5400000.1234567, 0.00012345678, -12.3456789])
    assert files.numbers(values) == [5400000.0, 0.000123457, -12.3457]
    np.testing.assert_allclose(files.significant(values, 0.9), values, atol=1e-6)
