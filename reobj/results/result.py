"""Result of a run: tracks, cameras and objects of a video; its files and report are methods.

`Result` and `reobj.results.entries` hold data only; `saving` and `report` do the work.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Poses
from reobj.results import report, saving, scene, table
from reobj.results.changes import Changes, EarlierSession
from reobj.results.edits import Edits
from reobj.results.entries import Object, Part, VideoInfo, World, found_text
from reobj.results.links import Links
from reobj.sources.boxes_3d import Boxes3D
from reobj.types import Embeddings, IntArray, ReobjError, Tracks, counted

__all__ = ["Object", "Part", "Result", "VideoInfo", "World"]


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Tracks, cameras and objects of a video.

    Attributes:
        tracks: all rows of the video in native pixels, with the objects' identities.
        untracked: detections that the tracker did not use, as rows without a tracklet; they may be
            assigned to objects by their 3D position.
        class_names: names of the tracks' `class_id`.
        objects: one for each identity, by id. world: units, gravity, scale, joins and splits.
        poses: cameras, or None. fits: of the objects, in their order; None without cameras, and for
            a result read from a folder. Frames that are not fitted (of more than 600) have no
            inliers.
        embeddings: (n, E1) and (n, E2), fused: foreground and background of the rows
            `embedding_row` (n,) of the tracks that the tracker embedded.
        boxes_3d: of the detections, if the detector gives some.
        looked: (F,) frames that the detector was run on, ascending; None: all that were read.
        identities_given: by the user; they are not joined, split or renumbered.
        seconds: wall time by stage. step_seconds: of the steps of a stage; {} if its result was
            taken from the cache.
        warnings: for the user. edits: manual corrections.
        changes: since the map that the recording was placed in; None: run without a map.
        earlier: the other recordings in that map, in their order; for the viewer.
        links: how detections were linked to identities, for refits; None for a result read from a
            folder.
        out: the folder that it was saved to or loaded from.
    """

    tracks: Tracks
    class_names: tuple[str, ...]
    video: VideoInfo
    objects: list[Object] = field(default_factory=list)
    world: World = field(default_factory=World)
    poses: Poses | None = None
    fits: quadrics.ObjectFits | None = None
    embeddings: Embeddings = field(default_factory=Embeddings.empty)
    embedding_row: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    untracked: Tracks = field(default_factory=Tracks.empty)
    boxes_3d: Boxes3D | None = None
    looked: IntArray | None = None
    identities_given: bool = False
    seconds: dict[str, float] = field(default_factory=dict)
    step_seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    edits: Edits | None = None
    changes: Changes | None = None
    earlier: Sequence[EarlierSession] = ()
    links: Links | None = None
    out: Path | None = None

    def __repr__(self) -> str:
        """Describe the result in one line."""
        facts = [repr(Path(self.video.path).name)]
        facts.append(found_text(self.objects))
        facts.append(counted(len(self.tracks), "box", "boxes"))
        facts += [] if self.poses is None else [self.poses.cameras_text]
        facts += [] if self.out is None else [f"out={str(self.out)!r}"]
        return f"Result({', '.join(facts)})"

    def _repr_html_(self) -> str:
        """Show the objects and the viewer in a notebook."""
        return scene.to_html(self)

    def object(self, number: int) -> Object:
        """Return the object of a number.

        Raises:
            ReobjError: there is none; the message names the nearest numbers.
        """
        for found in self.objects:
            if found.id == number:
                return found
        near = sorted((o.id for o in self.objects), key=lambda i: abs(i - number))[:4]
        numbers = f"the nearest numbers are {', '.join(map(str, sorted(near)))}"
        raise ReobjError(f"no object {number}; {numbers if near else 'the result has no objects'}")

    def to_pandas(self) -> Any:
        """Return the objects as a pandas DataFrame, one row each, indexed by `id` (needs pandas).

        The columns are those of `export --to csv`: lengths in world units, `_m` in metres.
        """
        return table.to_pandas(self)

    @property
    def located(self) -> list[Object]:
        """Objects that have a shape and are neither of low confidence nor implausible, by id."""
        return [o for o in self.objects if o.located]

    def of_part(self, part: int) -> Result:
        """Return the objects, cameras and world of one component of the trajectory, without fits.

        The tracks stay those of the whole video. With one component only: this result itself.
        """
        if self.poses is None or self.poses.part_count == 1:
            return self
        facts = self.world.parts[part]
        names = {f.name for f in dataclasses.fields(Part)} - {"spans"}
        component_world = {name: getattr(facts, name) for name in names}
        return dataclasses.replace(
            self,
            objects=[o for o in self.objects if o.part == part],
            world=dataclasses.replace(self.world, **component_world, parts=(facts,)),
            poses=self.poses.of_part(part),
            fits=None,
        )

    def without_doubtful(self) -> Result:
        """Return the result without objects of low confidence, their tracks and the fits."""
        doubtful = [o.id for o in self.objects if o.status == "doubtful"]
        return dataclasses.replace(
            self,
            objects=[o for o in self.objects if o.status != "doubtful"],
            tracks=self.tracks[~np.isin(self.tracks.track_id, doubtful)],
            fits=None,
        )

    def parts(self) -> list[Result]:
        """Return `of_part` of all components, the largest first."""
        count = 1 if self.poses is None else self.poses.part_count
        return [self.of_part(part) for part in range(count)]

    def ellipsoids(self) -> quadrics.Ellipsoids:
        """Return the ellipsoids of the `located` objects, each in the world of its component."""
        located = self.located
        if self.fits is not None:  # unrounded
            return self.fits.ellipsoids[np.array([o.located for o in self.objects], bool)]
        center = np.array([o.center for o in located], np.float64).reshape(-1, 3)
        half_axes = np.array([o.half_axes for o in located], np.float64).reshape(-1, 3)
        wxyz = np.array([o.quat_wxyz for o in located], np.float64).reshape(-1, 4)
        axes = np.empty((0, 3, 3))
        if located:
            axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix()
        return quadrics.Ellipsoids(center, half_axes, axes)

    def summary(self) -> str:
        """Return the report that `run` prints: objects with their sizes, cameras, times, files."""
        return report.summary(self)

    def save(
        self,
        out: str | Path,
        doubtful: bool = False,
        more: Callable[[Path], None] | None = None,
        stale: Sequence[str] = (),
    ) -> Result:
        """Write tracks.txt, objects.json, and where there are cameras poses.txt and objects.ply.

        changes.json is written after a run with a map, and removed after one without.

        objects.json includes objects of low confidence, tracks.txt only if `doubtful`. Each further
        component of the trajectory has its own poses and objects: poses_part1.txt,
        objects_part1.ply, ... All files are complete before they replace those of an earlier run,
        whose overlay video and viewer are removed.

        Args:
            more: writes further files into a given folder; they appear with the others.
            stale: files that are removed if `more` does not write them.

        Returns:
            The same result with `out`, which `summary` and the evaluation name.
        """
        saving.save(self, Path(out), doubtful, more, stale)
        return dataclasses.replace(self, out=Path(out))

    @classmethod
    def load(cls, out: str | Path) -> Result:
        """Read what `save` wrote; without the fits and the embeddings.

        Boxes have the precision of tracks.txt, .01 px, and the class of their object (-1 if the
        object does not exist, as in a file that was edited by hand).

        Raises:
            ReobjError: no `run` or `track` finished there, or another version wrote the folder.
        """
        return saving.load(cls, Path(out))

    def save_tracked(self, path: Path) -> None:
        """Write tracks and embeddings, before they are linked and fitted, as npz."""
        saving.save_tracked(self, path)

    @classmethod
    def load_tracked(cls, path: Path) -> Result:
        """Read what `save_tracked` wrote."""
        return saving.load_tracked(cls, path)

    def write_objects(self, path: Path) -> None:
        """Write objects.json."""
        saving.write_objects(self, path)
