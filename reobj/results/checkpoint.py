"""What was tracked so far, on disk: an interrupted tracking continues from there.

The files lie in a folder of their own: the tracker's state, which each save replaces, and one file
for the frames between two saves, so that the time of a save does not grow with the video.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.files import load_npz, save_npz
from reobj.types import Detections, IntArray, ReobjError, Tracks, log

TRACK_COLUMNS = tuple(f.name for f in dataclasses.fields(Tracks))
DETECTION_COLUMNS = ("xyxy", "score", "class_id")


@dataclass(slots=True)
class TrackedFrames:
    """What a run needs of each tracked frame.

    Attributes:
        frames: source numbers. found: tracks, also tentative ones.
        embedded: indices (n,) of the embedded detections and their embeddings (n, E) float16.
        detected: detections without masks, which would need too much memory.
        looked: whether the detector was run.
    """

    frames: list[int] = field(default_factory=list)
    found: list[Tracks] = field(default_factory=list)
    embedded: list[tuple[IntArray, npt.NDArray[np.float16]]] = field(default_factory=list)
    detected: list[Detections] = field(default_factory=list)
    looked: list[bool] = field(default_factory=list)

    def add(self, frame: int, tracker: Any) -> None:
        """Add the latest frame of a tracker."""
        index, rows = tracker.latest_embeddings()
        self.frames.append(frame)
        self.found.append(tracker.latest)
        self.embedded.append((index, rows.astype(np.float16)))
        self.detected.append(dataclasses.replace(tracker.detections, masks=None))
        self.looked.append(tracker.looked)

    def arrays(self, first: int) -> dict[str, Any]:
        """Return the frames from the `first` on (at least one) as arrays; see `extend`."""
        found = self.found[first:]
        detected = self.detected[first:]
        index = [index for index, _ in self.embedded[first:]]
        rows = [rows for _, rows in self.embedded[first:] if rows.size]
        arrays: dict[str, Any] = {
            "frames": np.array(self.frames[first:], np.int64),
            "looked": np.array(self.looked[first:], bool),
            "found": np.array([len(tracks) for tracks in found]),
            "detected": np.array([len(detections) for detections in detected]),
            "embedded": np.array([len(one) for one in index]),
            "embedded.index": np.concatenate(index),
            "embedded.rows": np.concatenate(rows or [np.empty((0, 0), np.float16)]),
        }
        for name in TRACK_COLUMNS:
            arrays[f"found.{name}"] = np.concatenate([getattr(one, name) for one in found])
        for name in DETECTION_COLUMNS:
            arrays[f"detected.{name}"] = np.concatenate([getattr(one, name) for one in detected])
        return arrays

    def extend(self, arrays: dict[str, Any]) -> None:
        """Add frames from their arrays: numbers of rows of each frame, and the rows of all."""

        def split(group: str, *columns: str) -> list[tuple[Any, ...]]:
            ends = np.cumsum(arrays[group])[:-1]
            parts = [np.split(arrays[f"{group}.{name}"], ends) for name in columns]
            return list(zip(*parts, strict=True))

        self.frames += arrays["frames"].tolist()
        self.looked += arrays["looked"].tolist()
        self.found += [Tracks(*rows) for rows in split("found", *TRACK_COLUMNS)]
        self.detected += [Detections(*rows) for rows in split("detected", *DETECTION_COLUMNS)]
        self.embedded += [(index, rows) for index, rows in split("embedded", "index", "rows")]


class Checkpoint:
    """Save a tracker and what it tracked from time to time; load them after an interruption.

    Args:
        folder: for this checkpoint alone, named by the inputs and options of the tracking.
        every_s: seconds between two saves. They are more if a save takes long: at most 2 % of the
            time is spent on saves.
    Attributes:
        collected: the frames tracked so far. kept: number of them on disk.
    """

    def __init__(self, folder: Path, every_s: float = 30.0) -> None:
        self.folder = folder
        self.collected = TrackedFrames()
        self.kept = 0
        self._every_s = every_s
        self._wait_s = every_s
        self._saved = time.monotonic()

    @property
    def last(self) -> int:
        """Source number of the last tracked frame, -1 before the first."""
        return self.collected.frames[-1] if self.collected.frames else -1

    def load(self, read_tracker: Callable[[Path], Any]) -> Any:
        """Load what an interrupted run left; None if there is nothing, or if it is damaged.

        Args:
            read_tracker: reads the file of `Tracker.save`.
        """
        path = self.folder / "tracker.npz"
        if not path.is_file():
            self.remove()  # frames of a run that was killed in its first save
            return None
        try:
            tracker = read_tracker(path)
            self._load_frames(tracker.state.frame_number + 1)
        except (ReobjError, OSError) as error:
            log.warning("%s; the video is tracked from its start", error)
            self.remove()
            return None
        return tracker

    def _load_frames(self, count: int) -> None:
        """Load the first `count` frames, which are those before the tracker's state.

        A kill between the two files of a save leaves frames after it, which are removed.
        """
        collected = TrackedFrames()
        for path in sorted(self.folder.glob("frames-*.npz")):
            if int(path.stem.rpartition("-")[2]) > count:
                path.unlink()
            else:
                collected.extend(load_npz(path, sealed=True)[0])
        if len(collected.frames) != count:
            raise ReobjError(f"{self.folder}: {len(collected.frames)} of {count} frames are there")
        self.collected = collected
        self.kept = count

    def save_if_due(self, tracker: Any) -> None:
        """Save after a frame, if the last save is long enough ago; a failure is a warning."""
        began = time.monotonic()
        if began - self._saved < self._wait_s:
            return
        try:
            self._save(tracker)
        except (ReobjError, OSError) as error:
            log.warning("%s: an interrupted tracking would begin again", error)
        self._saved = time.monotonic()
        self._wait_s = max(self._every_s, 50 * (self._saved - began))

    def _save(self, tracker: Any) -> None:
        """Save the frames since the last save, then the tracker's state: each file at once."""
        count = len(self.collected.frames)
        path = self.folder / f"frames-{self.kept:07d}-{count:07d}.npz"
        save_npz(path, self.collected.arrays(self.kept))
        tracker.save(self.folder / "tracker.npz")
        self.kept = count

    def remove(self) -> None:
        """Remove the files: they are damaged, or the result is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.collected = TrackedFrames()
        self.kept = 0
