"""An interrupted tracking continues, with exactly the result of one that was not interrupted."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reobj.results.checkpoint import Checkpoint, TrackedFrames

import reobj_track as rt
from reobj.files import load_npz
from reobj.poses import stage

ROOM = Path(__file__).resolve().parent.parent / "examples/room"
FRAMES = 40  # of the room: objects appear, leave and return
SAVED_EVERY = 8  # frames, in these tests
OPTIONS = (
    "--detections", ROOM / "detections.npz",
    "--every", 6, "--start", 1, "--stop", 1 + 6 * FRAMES, "--max-size", 320,
    "--set", "output.overlay=none", "--set", "output.scene=0", "--set", "objects.link=0",
)  # fmt: skip
WITHOUT_CAMERAS = ("track", ROOM / "room.mp4")
WITH_CAMERAS = (
    "run", ROOM / "room.mp4", "--poses", ROOM / "poses.txt", "--camera", ROOM / "camera.txt",
)  # fmt: skip


class Interrupter:
    """Interrupts the tracker before an update, or its save; counts the updates."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.before_update = self.before_save = self.updates = -1
        update = rt.Tracker.update
        save = rt.Tracker.save

        def updated(tracker: rt.Tracker, *args: Any, **inputs: Any) -> rt.Tracks:
            if "looked" in inputs:  # not the check of supplied poses, which tracks boxes alone
                self.updates += 1
                self._pass("before_update")
            return update(tracker, *args, **inputs)

        def saved(tracker: rt.Tracker, path: Path) -> None:
            self._pass("before_save")
            save(tracker, path)

        def save_if_due(checkpoint: Checkpoint, tracker: rt.Tracker) -> None:
            if len(checkpoint.collected.frames) % SAVED_EVERY == 0:
                checkpoint._save(tracker)

        monkeypatch.setattr(rt.Tracker, "update", updated)
        monkeypatch.setattr(rt.Tracker, "save", saved)
        monkeypatch.setattr(Checkpoint, "save_if_due", save_if_due)

    def _pass(self, name: str) -> None:
        """Count down, and interrupt at 0; below, do nothing."""
        left = getattr(self, name)
        setattr(self, name, left - 1)
        if left == 0:
            raise KeyboardInterrupt


def cli(command: tuple[object, ...], out: Path) -> int:
    return rt.main([str(word) for word in (*command, *OPTIONS, "-o", out)])


def tracked(out: Path) -> dict[str, Any]:
    """Return the arrays of the cached tracks; there is no checkpoint any more."""
    (path,) = (out / "cache").glob("tracks-*.npz")
    assert not list((out / "cache").glob("tracking-*"))
    return load_npz(path, sealed=True)[0]


def with_points(poses: rt.Poses, *_: object, **__: object) -> rt.Poses:
    """Stand in for the triangulation: random points before the cameras, seen in every frame."""
    rng = np.random.default_rng(0)
    centers = -np.einsum("fji,fj->fi", poses.cam_from_world[..., :3], poses.cam_from_world[..., 3])
    points = centers[rng.integers(0, len(centers), 500)] + rng.normal(0, 2, (500, 3))
    rows = np.repeat(np.arange(len(centers)), 40)
    visibility = np.column_stack([rows, rng.integers(0, 500, len(rows))])
    colors = np.zeros((500, 3), np.uint8)
    return dataclasses.replace(poses, points=points, colors=colors, visibility=visibility)


def test_an_interrupted_tracking_has_the_result_of_an_uninterrupted_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(stage, "triangulate", with_points)
    interrupter = Interrupter(monkeypatch)
    assert cli(WITH_CAMERAS, tmp_path / "whole") == 0
    expected = tracked(tmp_path / "whole")
    assert len(expected["embedding_row"]) and len(np.unique(expected["frame"])) > 30
    at = 19
    out = tmp_path / "out"
    interrupter.before_update = at
    assert cli(WITH_CAMERAS, out) == 130
    kept = at - at % SAVED_EVERY
    said = capsys.readouterr().err
    assert f"stage track, which keeps {kept} tracked frames" in said
    interrupter.updates = 0
    assert cli(WITH_CAMERAS, out) == 0
    assert interrupter.updates == FRAMES - kept  # the others were not tracked again
    found = tracked(out)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].dtype == values.dtype, name
        np.testing.assert_array_equal(found[name], values, name)
    for file in ("tracks.txt", "objects.json"):
        assert (out / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


def test_a_tracking_that_is_interrupted_twice_and_in_a_save_is_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A save writes two files: between them the frames are newer than the tracker."""
    interrupter = Interrupter(monkeypatch)
    assert cli(WITHOUT_CAMERAS, tmp_path / "whole") == 0
    out = tmp_path / "out"
    for save, update in ((0, -1), (2, -1), (-1, 10), (1, -1)):
        interrupter.before_save = save
        interrupter.before_update = update
        assert cli(WITHOUT_CAMERAS, out) == 130
    interrupter.before_save = -1
    assert cli(WITHOUT_CAMERAS, out) == 0
    found = tracked(out)
    for name, values in tracked(tmp_path / "whole").items():
        np.testing.assert_array_equal(found[name], values, name)


@pytest.mark.parametrize("damaged", ["tracker.npz", "frames-0000008-0000016.npz", "missing"])
def test_a_damaged_checkpoint_is_tracked_again_with_a_warning(
    damaged: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    interrupter = Interrupter(monkeypatch)
    interrupter.before_update = 20
    assert cli(WITHOUT_CAMERAS, tmp_path / "out") == 130
    (folder,) = (tmp_path / "out/cache").glob("tracking-*")
    if damaged == "missing":
        (folder / "frames-0000000-0000008.npz").unlink()
    else:
        (folder / damaged).write_bytes(b"no zip")
    capsys.readouterr()
    interrupter.updates = 0
    assert cli(WITHOUT_CAMERAS, tmp_path / "out") == 0
    assert interrupter.updates == FRAMES
    assert "the video is tracked from its start" in capsys.readouterr().err
    assert len(tracked(tmp_path / "out"))


def test_saves_take_at_most_a_fiftieth_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short video is never saved, and a slow disk is written to less often."""
    now = [0.0]
    saves = []
    monkeypatch.setattr("time.monotonic", lambda: now[0])

    def slow(checkpoint: Checkpoint, tracker: object) -> None:
        now[0] += 2
        saves.append(now[0])

    monkeypatch.setattr(Checkpoint, "_save", slow)
    checkpoint = Checkpoint(tmp_path)
    for _ in range(29):
        now[0] += 1
        checkpoint.save_if_due(None)
    assert not saves
    for _ in range(1000):
        now[0] += 1
        checkpoint.save_if_due(None)
    assert saves[0] == 32 and np.diff(saves).min() >= 100


def test_frames_without_detections_and_embeddings_are_kept() -> None:
    tracker = rt.Tracker()
    collected = TrackedFrames()
    rows = [[10, 10, 50, 90, 0.9, 56]]
    for frame, detections in enumerate(([], rows, None, rows, [])):
        tracker.update(detections)
        collected.add(7 + frame, tracker)
    again = TrackedFrames()
    again.extend(collected.arrays(0))
    assert again.frames == [7, 8, 9, 10, 11]
    assert again.looked == collected.looked and not again.looked[2]
    assert [len(found) for found in again.found] == [len(found) for found in collected.found]
    assert [len(found) for found in again.detected] == [0, 1, 0, 1, 0]
    np.testing.assert_array_equal(again.found[3].xyxy, collected.found[3].xyxy)
