"""Output folder: bound to one video, with the stages' results kept under a hash of their inputs.

What the files of a result hold is the business of result.py; what a stage computes, of its room.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reobj import __version__
from reobj.cameras import Poses, save_poses
from reobj.files import (
    PART_RESULTS,
    LockedError,
    atomic,
    load_cached,
    load_json,
    load_npz,
    locked,
    writing,
)
from reobj.results.edits import EDITS
from reobj.results.folder import LAST_POSES, check_results, remove_stale
from reobj.results.result import Result, load_last_poses, written_by
from reobj.schema import faults
from reobj.sources.imageless import ImagelessVideo
from reobj.sources.video import InputConfig, Video
from reobj.types import COORDINATE_MAX, ReobjError

LAST_TRACKS = "cache/last-tracks.npz"  # in an output folder
SOURCE = "cache/source.json"
LOCK = "cache/lock"


_COUNT = {"type": "integer", "minimum": 0, "maximum": 2**31 - 1}
SOURCE_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["source", "input"],
    "properties": {
        "source": {"type": "string"},
        "input": {"type": "object", "additionalProperties": _COUNT},
        "frames": {
            "type": ["object", "null"],
            "required": ["size"],
            "properties": {
                "size": {
                    "type": "array",
                    "items": {"type": "integer", "minimum": 1, "maximum": COORDINATE_MAX},
                    "minItems": 2,
                    "maxItems": 2,
                },
                "times_s": {"type": ["array", "null"], "items": {"type": "number"}},
                "names": {"type": "array", "items": {"type": "string"}},
                "count": _COUNT,
            },
        },
    },
}  # of SOURCE


class Workspace:
    """Keep the results of a video's stages in an output folder.

    Every stage keeps its result in OUT/cache under a hash of its inputs and options: a killed run
    resumes, a changed option recomputes what depends on it. A context: whoever writes into the
    folder enters it, and is the only one to do so until it leaves or its process ends.

    Attributes:
        out: the folder. cache: OUT/cache, made here; it may be deleted, then all is computed again.

    Raises:
        ReobjError: the folder is a file, or holds something else and `overwrite` is False; a
            sparse/ that is not ours is never overwritten.
    """

    def __init__(self, out: str | Path, overwrite: bool = False) -> None:
        self.out = out = Path(out)
        self.cache = out / "cache"
        foreign = out.is_dir() and any(out.iterdir()) and not self.cache.is_dir()
        if out.exists() and not out.is_dir():
            raise ReobjError(f"{out}: is a file; -o wants a folder")
        if foreign and not overwrite:
            what = "is not empty and not made by reobj_track"
            raise ReobjError(f"{out}: {what}; choose another -o, or say --overwrite")
        if foreign and (out / "sparse").exists():
            raise ReobjError(f"{out}: a sparse/ of its own would be lost; choose another -o")
        self._held = contextlib.ExitStack()
        with writing(self.cache):
            self.cache.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Workspace:
        check_results(self.out)
        try:
            self._held.enter_context(locked(self.out / LOCK))
        except LockedError:
            what = "another run is writing into this folder"
            raise ReobjError(f"{self.out}: {what}; wait for it, or choose another -o") from None
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    @staticmethod
    def open(out: str | Path) -> Workspace:
        """Open a folder that an earlier run made."""
        if not (Path(out) / "cache").is_dir():
            raise ReobjError(
                f"{out}: no output folder of reobj_track; make one with `run` or `track`"
            )
        return Workspace(out)

    def bind(self, video: Video, overwrite: bool = False) -> None:
        """Bind the folder to one video, so that results of two videos never mix.

        Raises:
            ReobjError: it is bound to another video, or that one was changed since, and `overwrite`
                is False; with it the other's results are removed.
        """
        path, source = self.out / SOURCE, Path(str(video.source))
        fingerprint = {
            "source": str(source.absolute()) if source.exists() else str(video.source),
            "content": video.fingerprint,
            "input": dataclasses.asdict(video.config),
            "frames": video.facts() if isinstance(video, ImagelessVideo) else None,
        }
        if path.exists():
            old = load_cached(path, load_json)
            old = old if isinstance(old, dict) else {}
            if old.get("content") != fingerprint["content"]:
                if not overwrite and self._has_results():
                    what = f"holds the results of {old.get('source', 'another video')}"
                    what += f", not of {video.source}"
                    if old.get("source") == fingerprint["source"]:
                        what = f"holds the results of {video.source} as it was before it changed"
                    raise ReobjError(f"{self.out}: {what}; choose another -o, or say --overwrite")
                remove_stale(self.out)
                for name in ("tracks.txt", "objects.json", EDITS, LAST_TRACKS, LAST_POSES):
                    (self.out / name).unlink(missing_ok=True)
        with atomic(path) as part:
            part.write_text(json.dumps(fingerprint))

    def _has_results(self) -> bool:
        """True unless no run came so far as to write one: what is in the cache does not mix."""
        shown = [p for p in self.out.iterdir() if p != self.cache and p.name != PART_RESULTS]
        return bool(shown) or any((self.out / name).exists() for name in (LAST_TRACKS, LAST_POSES))

    @property
    def source(self) -> tuple[str, InputConfig]:
        """The video that the folder is bound to, and the options that it was read with."""
        facts = self._binding()
        try:
            return str(facts["source"]), InputConfig(**facts["input"])
        except TypeError as error:  # an option of another version
            raise ReobjError(f"{self.out / SOURCE}: {written_by(self.out)} ({error})") from error

    def video(self) -> Video:
        """Open the video that the folder is bound to, read as it was."""
        source, config = self.source
        if not (frames := self._binding().get("frames")):
            return Video(source, config)
        more = {k: frames[k] for k in ("times_s", "names", "count") if k in frames}
        return ImagelessVideo(source, frames["size"], config, **more)

    def video_or_facts(self, result: Result) -> Video:
        """Open the video; where it was moved or deleted since, its frames without images.

        Args:
            result: of the folder, with its poses; takes the warning.
        """
        try:
            return self.video()
        except ReobjError as error:
            if not (self.out / SOURCE).is_file():
                raise
            source, config = self.source
            info, poses = result.video, result.poses
            last = result.tracks.frame if poses is None else poses.frame
            count = int(last.max(initial=-1)) + 1
            video = ImagelessVideo(source, (info.width, info.height), config, count=count)
            video.fps = info.fps
            result.warnings.append(f"no film, and a page without pictures: {error}")
            return video

    def _binding(self) -> dict[str, Any]:
        """Read what `bind` wrote."""
        path = self.out / SOURCE
        facts: dict[str, Any] = load_json(path)
        for fault in faults(facts, SOURCE_SCHEMA):
            raise ReobjError(f"{path}: {fault}; {written_by(self.out)}")
        return facts

    def path(self, stage: str, *key: Any) -> Path:
        """Return the file for a stage's result under a key: its inputs and options.

        Args:
            key: strings and configs; with the version of this package they make the name.
        """
        text = json.dumps([__version__, key], sort_keys=True, default=dataclasses.asdict)
        return self.cache / f"{stage}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.npz"

    def save_last(
        self, tracked: Result, poses: Poses | None, models: Sequence[Path] | None = None
    ) -> None:
        """Keep the latest tracks and poses for `objects OUT`, `eval` and `export`.

        Given identities take the place of earlier corrections, which are removed.

        Args:
            models: folders of COLMAP models in the cache, one of each part, for `last_models`.
        """
        tracked.save_tracked(self.out / LAST_TRACKS)
        if tracked.identities_given and (self.out / EDITS).exists():
            (self.out / EDITS).unlink()
            tracked.warnings.append(f"{self.out / EDITS} removed: the given identities replace it")
        if poses is None:
            (self.out / LAST_POSES).unlink(missing_ok=True)
        else:
            names = None if models is None else [path.name for path in models]
            save_poses(self.out / LAST_POSES, poses, models=names)

    def last_models(self) -> list[Path] | None:
        """Return the COLMAP models that belong in the folder; None if they are there already."""
        path = self.out / LAST_POSES
        names = load_npz(path)[1].get("models") if path.is_file() else None
        return None if names is None else [self.cache / Path(name).name for name in names]

    @property
    def last_tracks(self) -> Result | None:
        """The latest tracks as the tracker had them, before linking; None if there are none."""
        path = self.out / LAST_TRACKS
        return Result.load_tracked(path) if path.exists() else None

    def load_last(self) -> Result:
        """Return the latest tracks as the tracker had them, before linking, with the poses."""
        tracked = self.last_tracks
        if tracked is None:
            raise ReobjError(f"{self.out}: no tracks here; make them first with `run` or `track`")
        tracked.poses = load_last_poses(self.out)
        return tracked
