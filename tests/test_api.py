"""The four ways to call the tracker from Python, their types, and the examples in docstrings."""

from __future__ import annotations

import doctest
import importlib.util
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import four_ways
import numpy as np
import pytest

import quadrics
import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
ROOM = ROOT / "examples" / "room"


@dataclass
class Duck:
    """What counts of supervision's Detections: these arrays, rows by index, a tracker_id."""

    xyxy: np.ndarray
    confidence: np.ndarray | None = None
    class_id: np.ndarray | None = None
    mask: np.ndarray | None = None
    tracker_id: np.ndarray | None = None
    data: str = ""

    def __getitem__(self, rows: Any) -> Duck:
        parts = {n: getattr(self, n) for n in ("xyxy", "confidence", "class_id", "mask")}
        return replace(self, **{n: p if p is None else p[rows] for n, p in parts.items()})


@pytest.fixture(scope="module")
def short() -> tuple[rt.Video, rt.RecordedDetections]:
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=12))
    return video, rt.read_detections(ROOM / "detections.npz", video)


def test_all_ways_give_the_same_identities(
    short: tuple[rt.Video, rt.RecordedDetections], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Masks steer the appearance, so arrays, which have none, may differ in detail elsewhere."""
    if importlib.util.find_spec("supervision") is None:
        stand_in = ModuleType("supervision")
        stand_in.Detections = Duck  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "supervision", stand_in)
    results = [way(*short) for way in four_ways.WAYS]
    assert len(results) == 4 and sum(map(len, results[0])) > 30
    for found in results[1:]:
        assert [list(f) for f in found] == [list(f) for f in results[0]]


@pytest.mark.parametrize("real", [False, True])
def test_supervision_in_and_out(real: bool) -> None:
    made: Any = Duck
    if real:
        made = pytest.importorskip("supervision").Detections
    given = made(
        xyxy=np.array([[0, 0, 9, 9], [10, 10, 50, 90], [60, 10, 90, 90]], float),
        confidence=np.array([0.05, 0.9, 0.8]),  # the first is too weak for any track
        class_id=np.array([1, 2, 3]),
        mask=np.zeros((3, 100, 100), bool),
    )
    given.mask[2, 20:80, 65:85] = True
    tracker = rt.Tracker(rt.TrackerConfig(n_init=1))
    tracks = tracker.update(given)
    out = tracks.to_supervision(given)
    assert out.tracker_id.tolist() == tracks.track_id.tolist() == [1, 2]
    assert out.class_id.tolist() == [2, 3] and given.tracker_id is None
    assert out.mask.shape == (2, 100, 100) and out.mask[1].sum() == 1200
    own = rt.Detections.from_supervision(given)
    assert own.masks is not None and own.masks.dtype == bool and own.class_id.dtype == np.int64
    empty = tracker.update(given[np.zeros(3, bool)])
    assert len(empty) == 0 and len(empty.to_supervision(given[np.zeros(3, bool)]).xyxy) == 0


def test_supervision_without_scores_classes_and_masks() -> None:
    own = rt.Detections.from_supervision(Duck(np.array([[0, 0, 9, 9.0]])))
    assert (own.score.tolist(), own.class_id.tolist(), own.masks) == ([1.0], [0], None)


def test_arrays_in_and_out() -> None:
    """Rows keep the number of their detection, also when the rows before are not tracked."""
    tracker = rt.Tracker(rt.TrackerConfig(n_init=1))
    rows = np.array([[0, 0, 9, 9, 0.05, 1], [10, 10, 50, 90, 0.9, 2]])
    out = tracker.update(rows).to_array()
    assert out.shape == (1, 8) and out.dtype == np.float64
    np.testing.assert_allclose(out, [[10, 10, 50, 90, 1, 0.9, 2, 1]])
    assert tracker.update(np.empty((0, 6))).to_array().shape == (0, 8)
    with pytest.raises(ValueError):
        tracker.update(np.zeros((2, 5)))


def test_generator_over_a_video(short: tuple[rt.Video, rt.RecordedDetections]) -> None:
    video, recorded = short
    seen = []
    numbers = iter(range(12))

    def detector(image: rt.Image) -> rt.Detections:
        assert image.shape == (480, 640, 3)
        return recorded.at(next(numbers))

    for frame, tracks in rt.track(video, detections=detector):
        seen.append((frame.index, len(tracks)))
        if frame.index == 7:
            break  # as lazy as a generator should be
    assert [i for i, _ in seen] == list(range(8)) and seen[-1][1] > 5
    assert next(numbers) == 8


def test_generator_takes_paths_and_options() -> None:
    config = rt.Config(input=rt.InputConfig(every=2, stop=8), embed=rt.EmbedConfig(model="none"))
    found = [
        f.index for f, _ in rt.track(ROOM / "room.mp4", config, detections=ROOM / "detections.npz")
    ]
    assert found == [0, 2, 4, 6]


# ---- Types ----

GOOD = """
from collections.abc import Iterator
import numpy as np
import reobj_track as rt
tracker: rt.Tracker = rt.Tracker(rt.TrackerConfig(n_init=1), embedder=None)
tracks: rt.Tracks = tracker.update(np.zeros((0, 6)), None)
rows: rt.Array = tracks.to_array()
ids: rt.IntArray = tracks.track_id
pairs: Iterator[tuple[rt.Frame, rt.Tracks]] = rt.track("a.mp4", detections="det.txt")
result: rt.RunResult = rt.run("a.mp4", "out", rt.Config(), tracks="corrected.xml")
own: rt.Detections = rt.Detections.from_array([[0, 0, 1, 1, 0.5, 0]])
"""
BAD = {
    "ids: list[str] = rt.Tracker().update([]).track_id": "Incompatible types",
    "for frame in rt.track('a.mp4'): frame.image": 'no attribute "image"',
    "rt.TrackerConfig(n_int=1)": "Unexpected keyword argument",
    "rt.Tracker().update()": "Missing positional argument",
}


def test_types(tmp_path: Path) -> None:
    """mypy --strict accepts the documented calls and finds the mistake in each wrong one."""
    pytest.importorskip("mypy")
    (tmp_path / "good.py").write_text(GOOD)
    (tmp_path / "bad.py").write_text("import reobj_track as rt\n" + "\n".join(BAD) + "\n")
    command = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml"]
    files = [tmp_path / "good.py", tmp_path / "bad.py"]
    done = subprocess.run([*command, *files], capture_output=True, text=True, cwd=ROOT)
    lines = [line for line in done.stdout.splitlines() if "error:" in line]
    assert len(lines) == len(BAD), done.stdout + done.stderr
    for line, expected in zip(lines, BAD.values(), strict=True):
        assert "bad.py" in line and expected in line


# ---- Docstrings ----

WITH_EXAMPLE = ("Detections.from_array", "Tracker", "Tracks.to_array", "track")


def test_docstring_examples_run_and_are_where_users_look() -> None:
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner()
    examples = {t.name: t for m in (rt, quadrics) for t in finder.find(m) if t.examples}
    for test in examples.values():
        runner.run(test)
    assert runner.failures == 0 and runner.tries >= 4
    assert {f"reobj_track.{name}" for name in WITH_EXAMPLE} <= set(examples)
