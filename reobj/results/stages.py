"""The first stages of a run in its output folder: all detections, then the tracks of the video."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from reobj.files import Progress, load_cached, load_npz, save_npz
from reobj.results.result import Result, VideoInfo
from reobj.results.workspace import Workspace
from reobj.sources.detectors import DetectionCache, DetectionSource
from reobj.sources.video import Video
from reobj.types import Array, Detections, Floats, Frame, IntArray, ReobjError, Tracks


def detections_key(source: DetectionSource, video: Video) -> tuple[Any, ...]:
    """Return what the detections of a video depend on."""
    return (video.fingerprint, video.config, source.key)


def keep_detections(source: DetectionSource, video: Video, workspace: Workspace) -> DetectionSource:
    """Return a source that keeps what is slow to detect in the output folder, for later runs."""
    if video.is_live:
        return source
    folder = workspace.path("detections", *detections_key(source, video)).with_suffix("")
    return source.cached(folder, video.working_size)


def detect_all(
    source: DetectionSource, video: Video, workspace: Workspace
) -> tuple[DetectionSource, Tracks]:
    """Find the objects of all frames of a video, before anything is known of its cameras.

    Returns:
        the source, which answers from what was found: nothing is detected twice, whatever the
        detector; and all detections as rows without identities, in native pixels.
    """
    if source.recorded is not None:
        own = source.recorded
        return source, _rows(own.frame, own.xyxy, own.score, own.class_id)
    path = workspace.path("boxes", *detections_key(source, video))
    if source.key and (cached := load_cached(path, lambda p: load_npz(p, sealed=True))):
        found, _ = cached
        return source, _rows(*(found[n] for n in ("frame", "xyxy", "score", "class_id")))
    if source.cache is None:  # it cannot be known again: for this run only
        folder = workspace.cache / "detections-once"
        shutil.rmtree(folder, ignore_errors=True)
        source = dataclasses.replace(source, cache=DetectionCache(folder, video.working_size))
    frames: list[int] = []
    steps = []
    try:
        with Progress("detect", video.expected) as progress:
            for frame in video:
                found_now = source(frame)
                frames += [frame.index] * len(found_now)
                steps.append((found_now.xyxy / video.scale, found_now.score, found_now.class_id))
                progress.step()
    finally:
        source.flush()
    columns = [np.concatenate(column) for column in zip(*steps, strict=True)] if steps else []
    rows = _rows(np.array(frames, np.int64), *columns) if steps else Tracks.empty()
    if source.key:
        save_npz(path, {n: getattr(rows, n) for n in ("frame", "xyxy", "score", "class_id")})
    return source, rows


def _rows(frame: IntArray, xyxy: Array, score: Array, class_id: IntArray) -> Tracks:
    """Make rows of detections, of no identity."""
    none = np.zeros(len(frame), np.int64)
    return Tracks(frame, none, none, xyxy, score, class_id, none - 1)


def _untracked(
    tracks: Tracks, frames: list[int], detected: list[Detections], scale: float
) -> Tracks:
    """Make rows, of no tracklet, of the detections (of each frame) that no row of the tracks is."""
    index = np.concatenate([np.arange(len(found)) for found in detected])
    frame = np.repeat(np.asarray(frames, np.int64), [len(found) for found in detected])
    columns = [
        np.concatenate([getattr(d, n) for d in detected]) for n in ("xyxy", "score", "class_id")
    ]
    columns[0] = columns[0] / scale
    known = set(zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True))
    free = [key not in known for key in zip(frame.tolist(), index.tolist(), strict=True)]
    rows = _rows(frame, *columns)
    return dataclasses.replace(rows, detection_index=index)[np.array(free, bool)]


def collect_tracks(
    steps: Iterator[tuple[Frame, Tracks]], tracker: Any, video: Video, source: DetectionSource
) -> Result:
    """Collect what a tracker decides in a video, with its embeddings and what the user should know.

    Args:
        steps: the running `track(video, source, tracker)`.
    """
    frames: list[int] = []
    found: list[Tracks] = []
    embedded: list[tuple[IntArray, Floats]] = []
    detected: list[Detections] = []
    looked: list[bool] = []
    try:
        with Progress("track", video.expected) as progress:
            for frame, _ in steps:
                frames.append(frame.index)
                found.append(tracker.latest)
                embedded.append(tracker.latest_embeddings())
                looked.append(tracker.looked)
                detected.append(dataclasses.replace(tracker.detections, masks=None))  # memory
                progress.step()
    except KeyboardInterrupt:  # the way to end a live source
        if not video.is_live:
            raise
    finally:
        source.flush()
        if source.cache is not None and not source.key:
            shutil.rmtree(Path(source.cache.folder), ignore_errors=True)
    if not frames:
        why = "--start/--stop/--every leave none, or the file is damaged"
        raise ReobjError(f"{video.source}: no frame could be read ({why})")
    tracks = Tracks.concatenate(frames, found, video.scale)
    result = Result(tracks, tuple(source.class_names), VideoInfo.of(video))
    result.untracked = _untracked(tracks, frames, detected, video.scale)
    if not all(looked):
        result.looked = np.array(frames, np.int64)[np.array(looked, bool)]
    result.keep_embeddings(frames, embedded, tracker.state.gallery.foreground_width)
    result.warnings += [*source.messages, *video.messages]
    if video.is_live:
        result.warnings += [
            f"live: {video.read} frames came, {video.dropped} of them were dropped to keep up",
            "a live source cannot be read twice: identities only; record it for 3D",
        ]
    if not len(result.tracks):
        score = result.untracked.score
        result.warnings.append(f"no object was tracked: {_why_none(score, sum(looked), tracker)}")
    return result


def _why_none(score: Array, looked: int, tracker: Any) -> str:
    """Say why nothing was tracked.

    Args:
        score: of all detections. looked: frames that the detector was run on.
    """
    least = tracker.config.new_score
    if not looked:
        return "the detector was run on no frame (it gave None each time)"
    if not len(score):
        return f"no detections in the {looked} frames that the detector was run on"
    if score.max() < least:
        return f"all {len(score)} detections are below tracker.new_score={least:g}"
    return f"none of the {len(score)} detections was followed by enough others (tracker.n_init)"
