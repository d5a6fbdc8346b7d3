"""The public names, the ways to call the tracker from Python, and the examples in docstrings."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import four_ways
import numpy as np
import pytest

import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
ROOM = ROOT / "examples" / "room"
# ---- Ways to call the tracker ----


@dataclass
class Duck:
    """The used subset of supervision's Detections: arrays, indexing of rows, a tracker_id."""

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
def short() -> rt.Video:
    return rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=12))


def test_all_online_ways_give_the_same_identities(
    short: rt.Video, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On other data, arrays may differ in detail: they carry no masks, which change embeddings."""
    if importlib.util.find_spec("supervision") is None:
        stand_in = ModuleType("supervision")
        stand_in.Detections = Duck  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "supervision", stand_in)
    *online, _chain = four_ways.WAYS  # the last one decides after the video
    results = [way(short) for way in online]
    assert len(results) == 3 and sum(map(len, results[0])) > 30
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


def test_track_is_lazy_and_numbers_frames_as_the_source() -> None:
    """Any function of an image serves as detector; `latest` has the tentative tracks too."""
    read: list[int] = []

    class Noting(rt.Video):
        def __iter__(self) -> Iterator[rt.Frame]:
            for frame in super().__iter__():
                read.append(frame.index)
                yield frame

    video = Noting(ROOM / "room.mp4", rt.InputConfig(start=3, every=2))
    asked, tracker = [], rt.Tracker()

    def detector(image: np.ndarray) -> list[list[float]]:
        asked.append(image.shape)
        return [[0, 0, 50, 50, 0.6, 1], [100, 0, 150, 50, 0.6, 1]][: len(asked)]

    seen = []
    for frame, tracks in rt.track(video, detector, tracker):
        assert frame.image.shape == (480, 640, 3)
        assert set(tracks.frame.tolist()) == {frame.index}
        seen.append((frame.index, len(tracks), len(tracker.latest)))
        if len(seen) == 4:
            break
    assert seen == [(3, 1, 1), (5, 1, 2), (7, 1, 2), (9, 2, 2)]
    assert asked == [(480, 640, 3)] * 4
    assert read in ([3, 5, 7, 9], [3, 5, 7, 9, 11])  # a thread is one frame ahead


# ---- Docstrings ----

WITH_EXAMPLE = ("Detections.from_array", "Tracker", "track")  # where users look


def test_docstring_examples_of_all_modules_run() -> None:
    paths = [ROOT / "reobj_track.py", ROOT / "quadrics.py", *(ROOT / "reobj").rglob("*.py")]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sorted(paths)]
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner()
    examples = {}
    for name in names:
        module = importlib.import_module(name.removesuffix(".__init__"))
        examples |= {t.name: t for t in finder.find(module) if t.examples}
    for test in examples.values():
        runner.run(test)
    assert runner.failures == 0 and runner.tries >= 6
    found = {name.rpartition("reobj_track.")[2].rpartition("types.")[2] for name in examples}
    assert set(WITH_EXAMPLE) <= found
