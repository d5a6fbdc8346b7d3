"""Output folder: bound to one video; caches the results of the stages by a hash of their inputs.

Also the stages before the objects: detections of all frames, then tracks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from reobj import __version__
from reobj.cameras import Poses, save_poses
from reobj.files import (
    PART_RESULTS,
    LockedError,
    Progress,
    load_cached,
    load_npz,
    locked,
    save_npz,
    writing,
)
from reobj.results.entries import (
    STALE,
    OutputFile,
    check_results,
    load_last_poses,
    read_json,
    remove_stale,
    write_json,
)
from reobj.results.links import Links, load_links
from reobj.results.result import Result, VideoInfo, load_tracked, save_tracked
from reobj.sources.detectors import DetectionCache, DetectionSource
from reobj.sources.video import ImagelessVideo, InputConfig, Video, in_batches, one_ahead
from reobj.types import (
    COORDINATE_MAX,
    Array,
    Detections,
    Embeddings,
    FiniteFloat,
    Frame,
    Int32,
    IntArray,
    ReobjError,
    Tracks,
)

Side = Annotated[int, msgspec.Meta(ge=1, le=int(COORDINATE_MAX))]


@dataclass(frozen=True, slots=True)
class _Frames:
    """Frames of a video without images: the arguments of `ImagelessVideo`."""

    size: tuple[Side, Side]
    times_s: list[FiniteFloat] | None = None
    names: list[str] = field(default_factory=list)
    count: Int32 = 0


@dataclass(frozen=True, slots=True)
class _Binding:
    """Content of cache/source.json that is read back."""

    source: str
    input: InputConfig
    content: str = ""
    frames: _Frames | None = None


class Workspace:
    """Output folder of a video, with a cache of the results of its stages.

    Every stage saves its result in OUT/cache under a hash of its inputs and options: a killed run
    resumes, a changed option recomputes what depends on it. As a context manager it holds a lock,
    which a process needs to write into the folder.

    Attributes:
        out: the folder. cache: OUT/cache, made here; if it is deleted, all is computed again.

    Raises:
        ReobjError: the folder is a file, or holds something else and `overwrite` is False; a
            sparse/ that is not ours is never overwritten.
    """

    def __init__(self, out: str | Path, overwrite: bool = False) -> None:
        self.out = out = Path(out)
        self.cache = out / "cache"
        self._source_file = self.cache / "source.json"
        foreign = out.is_dir() and any(out.iterdir()) and not self.cache.is_dir()
        if out.exists() and not out.is_dir():
            raise ReobjError(f"{out}: is a file; -o wants a folder")
        if foreign and not overwrite:
            what = "is not empty and not made by reobj_track"
            raise ReobjError(f"{out}: {what}; choose another -o, or add --overwrite")
        if foreign and (out / OutputFile.MODEL).exists():
            raise ReobjError(f"{out}: a sparse/ of its own would be lost; choose another -o")
        self._held = contextlib.ExitStack()
        self._is_new = not out.exists()
        with writing(self.cache):
            self.cache.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Workspace:
        check_results(self.out)
        try:
            self._held.enter_context(locked(self.cache / "lock"))
        except LockedError:
            what = "another run is writing into this folder"
            raise ReobjError(f"{self.out}: {what}; wait for it, or choose another -o") from None
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Release the lock; a new folder without any result is removed after an error."""
        self._held.close()
        if kind is None or not self._is_new:
            return
        names = {path.name for path in self.out.rglob("*") if path.is_file()}
        if names <= {"lock", self._source_file.name}:
            shutil.rmtree(self.out, ignore_errors=True)

    @staticmethod
    def open(out: str | Path) -> Workspace:
        """Open the output folder of an earlier run."""
        if not (Path(out) / "cache").is_dir():
            raise ReobjError(
                f"{out}: no output folder of reobj_track; make one with `run` or `track`"
            )
        return Workspace(out)

    def bind(self, video: Video, overwrite: bool = False) -> None:
        """Bind the folder to one video, so that results of two videos never mix.

        Raises:
            ReobjError: it is bound to another video, or to an earlier version of this one, and
                `overwrite` is False; otherwise the earlier results are removed.
        """
        path = self._source_file
        source = Path(str(video.source))
        fingerprint = {
            "source": str(source.absolute()) if source.exists() else str(video.source),
            "content": video.fingerprint,
            "input": dataclasses.asdict(video.config),
            "frames": video.facts() if isinstance(video, ImagelessVideo) else None,
        }
        unknown = _Binding("another video", InputConfig())
        old = load_cached(path, partial(read_json, _Binding)) or unknown if path.exists() else None
        if old is not None and old.content != fingerprint["content"]:
            if not overwrite and self._has_results():
                found = f"{old.source}, not of {video.source}"
                if old.source == fingerprint["source"]:
                    found = f"{video.source} as it was before it changed"
                advice = "choose another -o, or add --overwrite"
                raise ReobjError(f"{self.out}: holds the results of {found}; {advice}")
            others = (OutputFile.TRACKS, OutputFile.OBJECTS, OutputFile.EDITS)
            remove_stale(self.out, (*STALE, *others, OutputFile.LAST_TRACKS))
        write_json(path, fingerprint, indent=None)

    def _has_results(self) -> bool:
        """Check for results of a run; cached stages are keyed by their video and do not count."""
        shown = [p for p in self.out.iterdir() if p != self.cache and p.name != PART_RESULTS]
        last = (OutputFile.LAST_TRACKS, OutputFile.LAST_POSES)
        return bool(shown) or any((self.out / name).exists() for name in last)

    @property
    def source(self) -> tuple[str, InputConfig]:
        """The video that the folder is bound to, and the options that it was read with."""
        binding = self._read_binding()
        return binding.source, binding.input

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the video that the folder is bound to."""
        return self._read_binding().content

    def video(self) -> Video:
        """Open the video that the folder is bound to, with the options of that run."""
        binding = self._read_binding()
        if binding.frames is None:
            return Video(binding.source, binding.input)
        facts = dataclasses.asdict(binding.frames)
        return ImagelessVideo(binding.source, config=binding.input, **facts)

    def video_or_frames(self, result: Result) -> tuple[Video, list[str]]:
        """Open the video, or its frames without images if it was moved or deleted since.

        Args:
            result: of the folder, with its poses.
        Returns:
            the video; warnings.
        """
        try:
            return self.video(), []
        except ReobjError as error:
            if not self._source_file.is_file():
                raise
            source, config = self.source
            frame = result.tracks.frame if result.poses is None else result.poses.frame
            size = (result.video.width, result.video.height)
            count = int(frame.max(initial=-1)) + 1
            video = ImagelessVideo(source, size, config, count=count)
            video.fps = result.video.fps
            return video, [f"no overlay video, and a viewer without pictures: {error}"]

    def _read_binding(self) -> _Binding:
        """Read what `bind` wrote."""
        return read_json(_Binding, self._source_file, own=True)

    def path(self, stage: str, *key: Any) -> Path:
        """Return the cache file of a stage's result.

        Args:
            key: inputs and options of the stage: strings and configs. The file name is their hash,
                with that of the version of this package.
        """
        text = json.dumps([__version__, key], sort_keys=True, default=dataclasses.asdict)
        return self.cache / f"{stage}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.npz"

    def save_last(
        self, tracked: Result, poses: Poses | None, models: Sequence[Path] | None = None
    ) -> list[str]:
        """Save the latest tracks and poses for `objects OUT`, `eval` and `export`.

        Given identities replace earlier corrections, which are removed.

        Args:
            models: folders of COLMAP models in the cache, one a component, for `last_models`.
        Returns:
            warnings.
        """
        warnings = []
        save_tracked(tracked, self.out / OutputFile.LAST_TRACKS)
        edits = self.out / OutputFile.EDITS
        if tracked.identities_given and edits.exists():
            edits.unlink()
            warnings.append(f"{edits} removed: the given identities replace it")
        if poses is None:
            (self.out / OutputFile.LAST_POSES).unlink(missing_ok=True)
        else:
            names = None if models is None else [path.name for path in models]
            save_poses(self.out / OutputFile.LAST_POSES, poses, models=names)
        return warnings

    def last_models(self) -> list[Path] | None:
        """Return the COLMAP models to copy to the folder; None if they were copied already."""
        path = self.out / OutputFile.LAST_POSES
        names = load_npz(path)[1].get("models") if path.is_file() else None
        return None if names is None else [self.cache / Path(name).name for name in names]

    @property
    def last_tracks(self) -> Result | None:
        """The latest tracks of the tracker, before linking; None if there are none."""
        path = self.out / OutputFile.LAST_TRACKS
        return load_tracked(path) if path.exists() else None

    def last_links(self) -> Links | None:
        """Return the links of the last result; None: there are none, or they are damaged."""
        return load_cached(self.out / OutputFile.LAST_LINKS, load_links)

    def load_last(self) -> Result:
        """Return the latest tracks of the tracker, before linking, with the latest poses."""
        tracked = self.last_tracks
        if tracked is None:
            raise ReobjError(f"{self.out}: no tracks here; make them first with `run` or `track`")
        return dataclasses.replace(tracked, poses=load_last_poses(self.out))


# ---- Detections and tracks of all frames --------------------------------------------------------


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
    steps: list[tuple[npt.NDArray[Any], ...]]
    steps = [(np.empty(0), np.empty((0, 4)), np.empty(0), np.empty(0))]
    try:
        with progress("detect", video.expected) as line:
            for batch in one_ahead(in_batches(video, source.batch)):  # a thread decodes the next
                for frame, found in zip(batch, source.detect(batch), strict=True):
                    d = Detections.empty() if found is None else found
                    number = np.full(len(d), frame.index)
                    steps.append((number, d.xyxy / video.scale, d.score, d.class_id))
                    line.step()
    finally:
        cache.flush()
    number, xyxy, score, kind = map(np.concatenate, zip(*steps, strict=True))
    rows = _rows(number.astype(np.int64), xyxy, score, kind.astype(np.int64))
    if source.key:
        save_npz(path, {name: getattr(rows, name) for name in names})
    return source, rows


def _rows(frame: IntArray, xyxy: Array, score: Array, class_id: IntArray) -> Tracks:
    """Make rows of detections without identities."""
    zeros = np.zeros(len(frame), np.int64)
    return Tracks(frame, zeros, zeros, xyxy, score, class_id, zeros - 1)


def _rows_in(tracks: Tracks, frame: IntArray, index: IntArray) -> IntArray:
    """Return the rows (n,) of detections in the tracks, by frame and index (n,); -1: none."""
    keys = zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True)
    row_of = {key: row for row, key in enumerate(keys)}
    wanted = zip(frame.tolist(), index.tolist(), strict=True)
    return np.array([row_of.get(key, -1) for key in wanted], np.int64)


def _untracked(
    tracks: Tracks, frames: list[int], detected: list[Detections], scale: float
) -> Tracks:
    """Make rows, without tracklets, of the detections that are in no row of the tracks."""
    columns = [
        (np.full(len(d), frame), d.xyxy, d.score, d.class_id, np.arange(len(d)))
        for frame, d in zip(frames, detected, strict=True)
    ]
    frame, xyxy, score, class_id, index = map(np.concatenate, zip(*columns, strict=True))
    rows = dataclasses.replace(_rows(frame, xyxy / scale, score, class_id), detection_index=index)
    return rows[_rows_in(tracks, frame, index) < 0]


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
    frame = np.repeat(np.array(frames, np.int64), [len(index) for index, _ in embedded])
    row = _rows_in(tracks, frame, np.concatenate([index for index, _ in embedded]))
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
) -> Result:
    """Run a tracker over a video and collect its tracks, embeddings and warnings.

    Args:
        steps: the running `track(video, source, tracker)`.
        progress: makes the progress line of a step from its name and total.
    """
    frames: list[int] = []
    found: list[Tracks] = []  # also tentative ones
    embedded: list[tuple[IntArray, npt.NDArray[np.float16]]] = []
    detected: list[Detections] = []
    detector_ran: list[bool] = []
    try:
        with progress("track", video.expected) as line:
            for frame, _ in steps:
                index, rows = tracker.latest_embeddings()
                frames.append(frame.index)
                found.append(tracker.latest)
                embedded.append((index, rows.astype(np.float16)))
                detected.append(dataclasses.replace(tracker.detections, masks=None))
                detector_ran.append(tracker.looked)
                line.step()
    except KeyboardInterrupt:  # the way to end a live source
        if not video.is_live:
            raise
    finally:
        if source.cache is not None:
            source.cache.flush()
            if not source.key:  # no later run can use them
                shutil.rmtree(source.cache.folder, ignore_errors=True)
    if not frames:
        why = "--start/--stop/--every leave none, or the file is damaged"
        raise ReobjError(f"{video.source}: no frame could be read ({why})")
    tracks = Tracks.concatenate(frames, found, video.scale)
    untracked = _untracked(tracks, frames, detected, video.scale)
    foreground_width = tracker.state.gallery.foreground_width
    embeddings, embedding_row = tracked_embeddings(tracks, frames, embedded, foreground_width)
    warnings = [*source.messages, *video.messages]
    if video.is_live:
        warnings += [
            f"live: {video.read} frames came, {video.dropped} of them were dropped to keep up",
            "a live source cannot be read twice: identities only; record it for 3D",
        ]
    if not len(tracks):
        best = untracked.score.max(initial=0)
        warnings.append(f"no object was tracked: {len(untracked)} detections in the "
                        f"{sum(detector_ran)} frames that the detector was run on, the best of "
                        f"score {best:.2f} "
                        f"(tracker.new_score={tracker.config.new_score:g}, tracker.n_init)"
                        )  # fmt: skip
    return Result(
        tracks,
        tuple(source.class_names),
        VideoInfo.of(video),
        embeddings=embeddings,
        embedding_row=embedding_row,
        untracked=untracked,
        looked=None if all(detector_ran) else np.array(frames, np.int64)[detector_ran],
        warnings=warnings,
    )
