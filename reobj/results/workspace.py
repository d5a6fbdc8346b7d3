"""The output folder: which video it belongs to, and the stages' results under a hash of inputs."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from reobj import __version__
from reobj.cameras import Poses, load_poses, save_poses
from reobj.files import atomic, load_json
from reobj.results.result import LAST_POSES, Result
from reobj.sources.video import InputConfig, Video, source_fingerprint
from reobj.types import ReobjError

LAST_TRACKS = "cache/last-tracks.npz"


class Workspace:
    """The output folder: what belongs to which inputs and options.

    Every stage keeps its result in OUT/cache under a hash of its inputs and options: a killed run
    resumes, a changed option recomputes what depends on it.

    Raises:
        ReobjError: the folder is a file, or holds something else and `overwrite` is False.
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
        self.cache.mkdir(parents=True, exist_ok=True)

    @staticmethod
    def open(out: str | Path) -> Workspace:
        """Open a folder that an earlier run made."""
        if not (Path(out) / "cache").is_dir():
            raise ReobjError(
                f"{out}: no output folder of reobj_track; make one with `run` or `track`"
            )
        return Workspace(out)

    def bind(self, video: Video, overwrite: bool = False) -> None:
        """Bind the folder to one video, so that results of two videos never mix."""
        path, source = self.cache / "source.json", Path(str(video.source))
        fingerprint = {
            "source": str(source.absolute()) if source.exists() else str(video.source),
            "content": source_fingerprint(video.source),
            "input": dataclasses.asdict(video.config),
        }
        if path.exists() and not overwrite:
            old = load_json(path)
            if old["content"] != fingerprint["content"]:
                raise ReobjError(
                    f"{self.out}: holds the results of {old['source']}, not of {video.source}; "
                    "choose another -o, or say --overwrite"
                )
        with atomic(path) as part:
            part.write_text(json.dumps(fingerprint))

    @property
    def source(self) -> tuple[str, InputConfig]:
        """The video that the folder is bound to, and the options that it was read with."""
        facts = load_json(self.cache / "source.json")
        return str(facts["source"]), InputConfig(**facts["input"])

    def path(self, stage: str, *key: Any) -> Path:
        """Return the file of a stage's result for this key (configs and strings)."""
        text = json.dumps([__version__, key], sort_keys=True, default=dataclasses.asdict)
        return self.cache / f"{stage}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.npz"

    def save_last(self, tracked: Result, poses: Poses | None) -> None:
        """Keep the latest tracks and poses for `objects OUT`, `eval` and `export`."""
        tracked.save_tracked(self.out / LAST_TRACKS)
        if poses is None:
            (self.out / LAST_POSES).unlink(missing_ok=True)
        else:
            save_poses(self.out / LAST_POSES, poses)

    @property
    def last_tracks(self) -> Result | None:
        """The latest tracks as the tracker had them, None if there are none."""
        path = self.out / LAST_TRACKS
        return Result.load_tracked(path) if path.exists() else None

    def load_last(self) -> Result:
        """Return the latest tracks as the tracker had them, with the poses."""
        tracked, poses = self.last_tracks, self.out / LAST_POSES
        if tracked is None:
            raise ReobjError(f"{self.out}: no tracks here; make them first with `run` or `track`")
        tracked.poses = load_poses(poses) if poses.exists() else None
        return tracked

    def publish_model(self, model: Path | None) -> None:
        """Make OUT/sparse a copy of a COLMAP model; None: remove that of an earlier run."""
        shutil.rmtree(self.out / "sparse", ignore_errors=True)
        if model is not None and model.is_dir():
            shutil.copytree(model, self.out / "sparse")
