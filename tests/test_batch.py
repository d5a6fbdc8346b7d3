"""examples/batch.py: the manifest, what counts as finished, and a worker killed in the middle."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import batch
import pytest

import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
ROOM = ROOT / "examples" / "room"


def manifest(folder: Path, *options: str) -> Path:
    """A manifest of the example clip, tracked with different options as a, b, c ..."""
    lines = ["path,out,command,detections,options"]
    common = "--set output.overlay=false"
    for name, text in zip("abcdef", options, strict=False):
        lines.append(f"{ROOM / 'room.mp4'},{name},track,{ROOM / 'detections.npz'},{text} {common}")
    (folder / "m.csv").write_text("\n".join(lines) + "\n")
    return folder / "m.csv"


def test_manifests_in_csv_and_jsonl_are_equal(tmp_path: Path) -> None:
    rows = [
        {"path": "a.mp4", "poses": "sparse", "options": "--classes 'tv,dining table'"},
        {"path": "sub/b.mp4", "out": "x", "poses": "none", "command": "track"},
    ]
    for row in rows:
        (tmp_path / row["path"]).parent.mkdir(exist_ok=True)
        (tmp_path / row["path"]).write_text("x")
    (tmp_path / "m.jsonl").write_text("\n".join(map(json.dumps, rows)) + "\n\n")
    with (tmp_path / "m.csv").open("w") as file:
        writer = csv.DictWriter(file, ["path", "out", "poses", "options", "command"])
        writer.writeheader()
        writer.writerows(rows)
    found = batch.read_manifest(tmp_path / "m.csv", tmp_path / "out")
    assert found == batch.read_manifest(tmp_path / "m.jsonl", tmp_path / "out")
    assert [i.name for i in found] == ["a", "x"]
    poses, classes = ("--poses", f"{tmp_path}/sparse"), ("--classes", "tv,dining table")
    assert found[0].argv == (
        "run",
        f"{tmp_path}/a.mp4",
        "-o",
        f"{tmp_path}/out/a",
        *poses,
        *classes,
    )
    assert found[1].argv[-2:] == ("--poses", "none") and found[1].argv[0] == "track"


BAD = {
    "no header": ("/a.mp4\n", "no videos"),
    "unknown column": ("path,detection\na.mp4,b\n", "line 2: expected a path, and no columns but"),
    "no path": ("path,out\n,b\n", "line 2: expected a path"),
    "short row": ("path,out\na.mp4\n", "cannot be read"),
    "twice": ("path\na.mp4\n\nsub/a.mp4\n", "line 4: the folder a is taken"),
    "empty": ("", "cannot be read|no videos"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_manifest(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, expected = BAD[case]
    (tmp_path / "m.csv").write_text(text)
    assert batch.main([str(tmp_path / "m.csv"), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert re.search(expected, error) and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_finished_means_same_files_and_options(tmp_path: Path) -> None:
    """Run in this process, as a worker does; any change of input or options undoes it."""
    det = tmp_path / "det.npz"
    det.write_bytes((ROOM / "detections.npz").read_bytes())

    def item(options: str) -> object:
        row = {"path": str(ROOM / "room.mp4"), "out": "a", "command": "track", "options": options}
        return batch.make_item(row | {"detections": str(det)}, tmp_path, tmp_path)

    options = "--stop 5 --set output.overlay=false"
    first = item(options)
    assert batch.finished(first) is None
    result = batch.run_item(first, str(ROOT))
    assert result["status"] == "done" and result["frames"] == 5 and result["objects"] > 0
    assert batch.finished(item(options)) == result
    written = (tmp_path / "a/tracks.txt").stat().st_mtime_ns
    assert batch.run_item(item(options), str(ROOT)) == result  # a second worker finds it finished
    assert (tmp_path / "a/tracks.txt").stat().st_mtime_ns == written
    assert batch.finished(item("--stop 6 --set output.overlay=false")) is None
    os.utime(det, (1, 1))
    assert batch.finished(item(options)) is None
    os.utime(det, (2, 2))
    changed = batch.run_item(item("--no-such-option"), str(ROOT))
    assert changed["status"] == "failed" and "--no-such-option" in changed["error"]
    assert batch.finished(first) is None and not (tmp_path / "a" / batch.MARKER).exists()


def wait_for(path: Path, process: subprocess.Popen[str]) -> str:
    while not path.exists() or not path.read_text():
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)
    return path.read_text()


@pytest.mark.slow
def test_a_killed_worker_loses_and_repeats_no_videos(tmp_path: Path) -> None:
    """Two workers, three videos; the worker of b is killed; then the batch is run again."""
    pytest.importorskip("ray")
    path, results = manifest(tmp_path, *(f"--stop {n}" for n in (4, 25, 3))), tmp_path / "out"
    command = [sys.executable, ROOT / "examples/batch.py", path, "-o", results, "--workers", "2"]
    process = subprocess.Popen(list(map(str, command)), text=True, stderr=subprocess.PIPE)
    pid = int(wait_for(results / "b/cache/worker.pid", process))
    os.kill(pid, signal.SIGKILL)
    assert not (results / "b/tracks.txt").exists()  # it was in the middle
    log = process.communicate(timeout=240)[1]
    assert process.returncode == 0, log
    rows = list(csv.DictReader((results / "summary.csv").open()))
    assert [(r["name"], r["status"], r["attempts"], r["frames"]) for r in rows] == [
        ("a", "done", "1", "4"), ("b", "done", "2", "25"), ("c", "done", "1", "3"),
    ]  # fmt: skip
    assert sorted(re.findall(r"done +(\w)", log)) == list("abc")
    assert re.findall(r"again +(\w) attempt (\d)", log) == [("b", "2")]
    alone = batch.read_manifest(path, tmp_path / "alone")[1]  # what one run by itself gives
    assert rt.main(list(alone.argv)) == 0
    assert (Path(alone.out) / "tracks.txt").read_bytes() == (results / "b/tracks.txt").read_bytes()
    times = [(results / n / "tracks.txt").stat().st_mtime_ns for n in "abc"]
    done = subprocess.run(list(map(str, command)), text=True, capture_output=True)
    assert done.returncode == 0 and "3 videos, 3 finished before" in done.stderr
    assert [(results / n / "tracks.txt").stat().st_mtime_ns for n in "abc"] == times
    rows = list(csv.DictReader((results / "summary.csv").open()))
    assert [(r["status"], r["attempts"]) for r in rows] == [("skipped", "0")] * 3
