"""Output folder: bound to one video; caches the results of the stages by a hash of their inputs."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec

from reobj import __version__
from reobj.cameras import Poses, save_poses
from reobj.files import (
    PART_RESULTS,
    LockedError,
    atomic,
    load_cached,
    load_npz,
    locked,
    writing,
)
from reobj.results.entries import OutputFile, read_json
from reobj.results.links import Links, load_links
from reobj.results.result import Result, load_tracked, save_tracked
from reobj.results.saving import (
    check_results,
    load_last_poses,
    remove_stale,
)
from reobj.sources.video import ImagelessVideo, InputConfig, Video
from reobj.types import COORDINATE_MAX, FiniteFloat, Int32, ReobjError

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
        if path.exists():
            old = load_cached(path, partial(read_json, _Binding)) or _Binding(
                "another video", InputConfig()
            )
            if old.content != fingerprint["content"]:
                if not overwrite and self._has_results():
                    found = f"{old.source}, not of {video.source}"
                    if old.source == fingerprint["source"]:
                        found = f"{video.source} as it was before it changed"
                    advice = "choose another -o, or add --overwrite"
                    raise ReobjError(f"{self.out}: holds the results of {found}; {advice}")
                remove_stale(self.out)
                others = (OutputFile.TRACKS, OutputFile.OBJECTS, OutputFile.EDITS)
                for name in (*others, OutputFile.LAST_TRACKS, OutputFile.LAST_POSES):
                    (self.out / name).unlink(missing_ok=True)
        with atomic(path) as part:
            part.write_text(json.dumps(fingerprint), encoding="utf-8")

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
