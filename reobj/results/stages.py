"""Stages of a run before the objects: detections of all frames, then tracks; both are cached."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.files import Progress, load_cached, load_npz, save_npz
from reobj.results.checkpoint import Checkpoint, TrackedFrames
from reobj.results.result import Result, VideoInfo
from reobj.results.workspace import Workspace
from reobj.sources.detectors import DetectionCache, DetectionSource
from reobj.sources.video import Video, in_batches, one_ahead
from reobj.types import Array, Detections, Embeddings, Frame, IntArray, ReobjError, Tracks


def detections_key(source: DetectionSource, video: Video) -> tuple[Any, ...]:
    """Return the cache key of the detections of a video."""
    return (video.fingerprint, video.config, source.key)


def keep_detections(source: DetectionSource, video: Video, workspace: Workspace) -> DetectionSource:
    """Return a source that caches the detections of a slow detector in the output folder."""
    if video.is_live or not source.slow or not source.key:
        return source
    folder = workspace.path("detections", *detections_key(source, video)).with_suffix("")
    return dataclasses.replace(source, cache=DetectionCache(folder, video.working_size))


def detect_all(
    source: DetectionSource,
    video: Video,
    workspace: Workspace,
    progress: Callable[[str, int], Progress] = Progress,
) -> tuple[DetectionSource, Tracks]:
    """Detect objects in all frames of a video; the cameras are not needed.

    Args:
        progress: makes the progress line of a step from its name and total.
    Returns:
        the source, which returns these detections from now on, so that no frame is detected twice;
        all detections as rows without identities, in native pixels.
    """
    if source.recorded is not None:
        recorded = source.recorded
        return source, _rows(recorded.frame, recorded.xyxy, recorded.score, recorded.class_id)
    names = ("frame", "xyxy", "score", "class_id")
    path = workspace.path("boxes", *detections_key(source, video))
    if source.key and (cached := load_cached(path, lambda p: load_npz(p, sealed=True))):
        columns, _ = cached
        return source, _rows(*(columns[name] for name in names))
    cache = source.cache
    if cache is None:  # without a key it is not recognised in a later run
        folder = workspace.cache / "detections-once"
        shutil.rmtree(folder, ignore_errors=True)
        cache = DetectionCache(folder, video.working_size)
        source = dataclasses.replace(source, cache=cache)
    frames: list[int] = []
    steps = []
    try:
        with progress("detect", video.expected) as line:
            for batch in one_ahead(in_batches(video, source.batch)):  # a thread decodes the next
                for frame, found in zip(batch, source.detect(batch), strict=True):
                    detected = Detections.empty() if found is None else found
                    frames += [frame.index] * len(detected)
                    steps.append((detected.xyxy / video.scale, detected.score, detected.class_id))
                    line.step()
    finally:
        cache.flush()
    rows = Tracks.empty()
    if steps:
        xyxy, score, class_id = (np.concatenate(column) for column in zip(*steps, strict=True))
        rows = _rows(np.array(frames, np.int64), xyxy, score, class_id)
    if source.key:
        save_npz(path, {name: getattr(rows, name) for name in names})
    return source, rows


def _finish_cache(source: DetectionSource) -> None:
    """Write the pending detections; remove those that no later run can use."""
    if source.cache is not None:
        source.cache.flush()
        if not source.key:
            shutil.rmtree(source.cache.folder, ignore_errors=True)


def _rows(frame: IntArray, xyxy: Array, score: Array, class_id: IntArray) -> Tracks:
    """Make rows of detections without identities."""
    zeros = np.zeros(len(frame), np.int64)
    return Tracks(frame, zeros, zeros, xyxy, score, class_id, zeros - 1)


def _untracked(
    tracks: Tracks, frames: list[int], detected: list[Detections], scale: float
) -> Tracks:
    """Make rows, without tracklets, of the detections that are in no row of the tracks."""
    index = np.concatenate([np.arange(len(detections)) for detections in detected])
    frame = np.repeat(np.asarray(frames, np.int64), [len(detections) for detections in detected])
    xyxy = np.concatenate([detections.xyxy for detections in detected]) / scale
    score = np.concatenate([detections.score for detections in detected])
    class_id = np.concatenate([detections.class_id for detections in detected])
    tracked = set(zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True))
    free = [key not in tracked for key in zip(frame.tolist(), index.tolist(), strict=True)]
    rows = dataclasses.replace(_rows(frame, xyxy, score, class_id), detection_index=index)
    return rows[np.array(free, bool)]


def tracked_embeddings(
    tracks: Tracks,
    frames: Sequence[int],
    embedded: Sequence[tuple[IntArray, npt.NDArray[Any]]],
    foreground_width: int,
) -> tuple[Embeddings, IntArray]:
    """Select the tracker's embeddings of detections that are in the tracks.

    Args:
        frames: source frame numbers. embedded: for each, detection indices (n,) and their fused
            rows (n, E). foreground_width: columns of the foreground (0: all).
    Returns:
        n embeddings, and their rows (n,) in the tracks.
    """
    keys = zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True)
    row_of = {key: row for row, key in enumerate(keys)}
    row = np.array([
        row_of.get((frame, detection), -1)
        for frame, (index, _) in zip(frames, embedded, strict=True)
        for detection in index.tolist()
    ], np.int64)  # fmt: skip
    blocks = [block for _, block in embedded if block.size] or [np.empty((0, 0), np.float16)]
    fused = np.concatenate(blocks)[row >= 0].astype(np.float16)
    width = foreground_width or fused.shape[1]
    return Embeddings(fused[:, :width], fused[:, width:]), row[row >= 0]


def collect_tracks(
    steps: Iterator[tuple[Frame, Tracks]],
    tracker: Any,
    video: Video,
    source: DetectionSource,
    progress: Callable[[str, int], Progress] = Progress,
    checkpoint: Checkpoint | None = None,
) -> Result:
    """Run a tracker over a video and collect its tracks, embeddings and warnings.

    Args:
        steps: the running `track(video, source, tracker)`.
        progress: makes the progress line of a step from its name and total.
        checkpoint: keeps the tracker and what was collected; after an interruption `steps` begins
            after its frames.
    """
    collected = TrackedFrames() if checkpoint is None else checkpoint.collected
    try:
        with progress("track", video.expected) as line:
            for frame, _ in steps:
                collected.add(frame.index, tracker)
                if checkpoint is not None:
                    checkpoint.save_if_due(tracker)
                line.step()
    except KeyboardInterrupt as interruption:  # the way to end a live source
        if not video.is_live:
            if checkpoint is not None:
                interruption.add_note(f"{checkpoint.kept} tracked frames")
            raise
    finally:
        _finish_cache(source)
    frames = collected.frames
    if not frames:
        why = "--start/--stop/--every leave none, or the file is damaged"
        raise ReobjError(f"{video.source}: no frame could be read ({why})")
    tracks = Tracks.concatenate(frames, collected.found, video.scale)
    untracked = _untracked(tracks, frames, collected.detected, video.scale)
    foreground_width = tracker.state.gallery.foreground_width
    embeddings, embedding_row = tracked_embeddings(
        tracks, frames, collected.embedded, foreground_width
    )
    warnings = [*source.messages, *video.messages]
    if video.is_live:
        warnings += [
            f"live: {video.read} frames came, {video.dropped} of them were dropped to keep up",
            "a live source cannot be read twice: identities only; record it for 3D",
        ]
    looked = collected.looked
    if not len(tracks):
        reason = _why_none(untracked.score, sum(looked), tracker)
        warnings.append(f"no object was tracked: {reason}")
    return Result(
        tracks,
        tuple(source.class_names),
        VideoInfo.of(video),
        embeddings=embeddings,
        embedding_row=embedding_row,
        untracked=untracked,
        looked=None if all(looked) else np.array(frames, np.int64)[np.array(looked, bool)],
        warnings=warnings,
    )


def _why_none(score: Array, looked: int, tracker: Any) -> str:
    """Explain why nothing was tracked.

    Args:
        score: of all detections. looked: number of frames that the detector was run on.
    """
    least = tracker.config.new_score
    if not looked:
        return "the detector was run on no frame (it returned None each time)"
    if not len(score):
        return f"no detections in the {looked} frames that the detector was run on"
    if score.max() < least:
        return f"all {len(score)} detections are below tracker.new_score={least:g}"
    return f"none of the {len(score)} detections was followed by enough others (tracker.n_init)"
