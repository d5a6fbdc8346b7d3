"""Result of a run: tracks, cameras and objects of a video; its files, its table and its report.

`Result` holds data, which it saves to and loads from an output folder; the functions below it make
tables and the report.
"""

from __future__ import annotations

import contextlib
import dataclasses
import html
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj import __version__
from reobj.cameras import Poses, save_poses
from reobj.files import (
    columns_of,
    component_path,
    cut,
    from_columns,
    load_npz,
    save_npz,
    texts_with_sigma,
    wrapped,
)
from reobj.results.changes import (
    Changes,
    EarlierSession,
    read_changes,
    read_earlier,
    write_changes,
    write_earlier,
)
from reobj.results.edits import Edits, write_edits
from reobj.results.entries import (
    HEADER,
    RUN_AGAIN,
    STALE,
    Object,
    OutputFile,
    Part,
    VideoInfo,
    World,
    component_of,
    found_text,
    load_last_poses,
    read_json,
    replaced,
    upright_pose,
    write_json,
    write_mot,
    write_trajectories,
)
from reobj.results.links import Links, save_links
from reobj.results.ply import write_ply
from reobj.sources.recorded import SIZES, corners
from reobj.sources.tables import Boxes3D, read_mot_rows
from reobj.types import (
    Array,
    Embeddings,
    IntArray,
    ReobjError,
    Tracks,
    counted,
    log,
    without_secrets,
)

__all__ = ["Object", "Part", "Result", "VideoInfo", "World"]


VIEWER_PX = 600  # height of the viewer in a notebook: one on a laptop shows it whole


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
        name = repr(Path(self.video.path).name)
        cameras = "" if self.poses is None else self.poses.cameras_text
        out = "" if self.out is None else f"out={str(self.out)!r}"
        boxes = counted(len(self.tracks), "box", "boxes")
        facts = filter(None, (name, found_text(self.objects), boxes, cameras, out))
        return f"Result({', '.join(facts)})"

    def _repr_html_(self) -> str:
        """Return the report, and the scene.html of the folder in an iframe, for a notebook.

        The page is part of the HTML (.7 MB, with pictures up to 10 MB), so that it works where the
        notebook's server does not serve the folder. Its scripts cannot reach the notebook.
        """
        text = f"<pre>{html.escape(self.summary())}</pre>"
        if self.out is not None and (path := self.out / "scene.html").is_file():
            page = html.escape(path.read_text(encoding="utf-8"))
            text += f'<iframe sandbox="allow-scripts allow-downloads" srcdoc="{page}" '
            text += f'style="width:100%;height:{VIEWER_PX}px;border:0"></iframe>'
        return text

    def object(self, number: int) -> Object:
        """Return the object of a number.

        Raises:
            ReobjError: there is none; the message names the nearest numbers.
        """
        near = sorted(self.objects, key=lambda o: abs(o.id - number))[:4]
        if near and near[0].id == number:
            return near[0]
        numbers = ", ".join(str(i) for i in sorted(o.id for o in near))
        known = f"the nearest numbers are {numbers}" if near else "the result has no objects"
        raise ReobjError(f"no object {number}; {known}")

    def to_pandas(self) -> Any:
        """Return the objects as a pandas DataFrame, one row each, indexed by `id` (needs pandas).

        The columns are those of `export --to csv`: lengths in world units, `_m` in metres.
        """
        try:
            import pandas
        except ImportError as error:
            raise ReobjError("to_pandas needs pandas: pip install pandas") from error
        head, rows = object_table(self)
        return pandas.DataFrame(rows, columns=head).set_index("id")

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
        own = {"spans", "grade", "direction_sigma_deg"}
        shared = {f.name for f in dataclasses.fields(Part)} - own
        component = {name: getattr(facts, name) for name in shared}
        return dataclasses.replace(
            self,
            objects=[o for o in self.objects if o.part == part],
            world=dataclasses.replace(self.world, **component, parts=(facts,)),
            poses=self.poses.of_part(part),
            fits=None,
        )

    def without_doubtful(self) -> Result:
        """Return the result without objects of low confidence, their tracks and the fits."""
        kept = [o for o in self.objects if o.status != "doubtful"]
        doubtful = {o.id for o in self.objects} - {o.id for o in kept}
        tracks = self.tracks[~np.isin(self.tracks.track_id, list(doubtful))]
        return dataclasses.replace(self, objects=kept, tracks=tracks, fits=None)

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
        return summary(self)

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
        out = Path(out)
        edited = () if self.edits is None else (OutputFile.EDITS,)
        with replaced(out, (*STALE, *edited, *stale)) as new:
            shown = self if doubtful else self.without_doubtful()
            write_mot(new / OutputFile.TRACKS, shown.tracks)
            write_objects(self, new / OutputFile.OBJECTS)
            write_edits(new, self.edits)
            if self.links is not None:
                save_links(self.links, new / OutputFile.LAST_LINKS)
            if self.changes is not None:
                write_changes(new / OutputFile.CHANGES, self.changes)
            if self.earlier:
                write_earlier(new / OutputFile.EARLIER, self.earlier)
            if self.poses is not None:
                save_poses(new / OutputFile.LAST_POSES, self.poses)
                write_trajectories(new, self.poses)
            if self.fits is not None or self.located:
                for k, component in enumerate(self.parts()):
                    ids = [o.id for o in component.located]
                    write_ply(component_path(new / OutputFile.MESH, k), component.ellipsoids(), ids)
            if more is not None:
                more(new)
        return dataclasses.replace(self, out=out)

    @classmethod
    def load(cls, out: str | Path) -> Result:
        """Read what `save` wrote; without the fits and the embeddings.

        Boxes have the precision of tracks.txt, .01 px, and the class of their object (-1 if the
        object does not exist, as in a file that was edited by hand).

        Raises:
            ReobjError: no `run` or `track` finished there, or another version wrote the folder.
        """
        out = Path(out)
        path = out / OutputFile.OBJECTS
        if not path.is_file() or not (out / OutputFile.TRACKS).is_file():
            raise ReobjError(f"{out}: no objects.json and tracks.txt; make them first with `run`")
        poses = load_last_poses(out)
        entries = read_json(ObjectsFile, path, HEADER, own=True)
        if fault := _contradiction(entries, poses):
            raise ReobjError(f"{path}: {fault}; {RUN_AGAIN}")
        class_names = tuple(dict.fromkeys(o.class_name for o in entries.objects))
        class_of = {o.id: class_names.index(o.class_name) for o in entries.objects}
        rows = read_mot_rows(out / OutputFile.TRACKS)
        frame, ids = rows[:, :2].T.astype(np.int64)
        classes = np.array([class_of.get(i, -1) for i in ids.tolist()], np.int64)
        boxes = corners(rows[:, 2:6], SIZES)  # (N, 4)
        unknown = np.full(len(rows), -1, np.int64)
        changes = out / OutputFile.CHANGES
        earlier: Sequence[EarlierSession] = ()
        if (others := out / OutputFile.EARLIER).is_file():
            try:
                earlier = read_earlier(others)
            except ReobjError as error:
                log.warning("%s; the result is read without the other recordings of its map", error)
        return Result(
            Tracks(frame - 1, ids, ids, boxes, rows[:, 6], classes, unknown),
            class_names,
            entries.video,
            entries.objects,
            entries.world,
            poses,
            warnings=entries.warnings,
            changes=read_changes(changes) if changes.is_file() else None,
            earlier=earlier,
            out=out,
        )


# ---- objects.json ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ObjectsFile:
    """Content of objects.json that is read back."""

    video: VideoInfo
    world: World
    objects: list[Object]
    warnings: list[str] = field(default_factory=list)


def write_objects(result: Result, path: Path) -> None:
    """Write objects.json."""
    versions = {}
    for name in ("numpy", "scipy", "opencv-python-headless", "pycolmap", "onnxruntime"):
        with contextlib.suppress(PackageNotFoundError):  # installed under another name
            versions[name] = version(name)
    tracked = {"tracked_frames": len(np.unique(result.tracks.frame))}
    data = {
        **HEADER,
        "command": " ".join(map(without_secrets, sys.argv)),
        "reobj_track": __version__,
        "versions": versions,
        "conventions": {
            "pose": "cam_from_world",
            "camera_axes": "x right, y down, z forward",
            "quaternion": "wxyz, world_from_obj",
            "pixels": "centre of the top-left pixel at (0.5, 0.5) (COLMAP)",
            "frames": "0-based",
            "size": "full extents of the solid along its own axes",
            "ellipsoid": "inscribed in a box or cylinder",
            "cov": "9x9: center, log half axes, rotation vector in object axes",
            "center_m": "metres, z up, from the origin of the world",
            "yaw_deg": "of the x axis of the object about z",
        },
        "video": dataclasses.asdict(result.video) | tracked,
        "world": result.world.to_json(),
        "objects": [
            o.to_json() | upright_pose(o, component_of(o, result.world)) for o in result.objects
        ],
        "warnings": result.warnings,
    }
    write_json(path, data)


def _contradiction(entries: ObjectsFile, poses: Poses | None) -> str:
    """Describe a contradiction between entries of objects.json, or to the poses; "" if none."""
    if len({o.id for o in entries.objects}) != len(entries.objects):
        return "two objects of one id"
    count = 1 if poses is None else poses.part_count
    described = len(entries.world.parts)
    if count not in (1, described):
        return f"{described} components of a trajectory that has {count}"
    for o in entries.objects:
        shape = (o.center, o.half_axes, o.size, o.quat_wxyz)
        if (o.located or o.status == "implausible") and any(value is None for value in shape):
            return f"object {o.id} is {o.status} without a shape"
        if o.part >= max(count, described):
            return f"object {o.id} is in component {o.part}, which does not exist"
    return ""


# ---- Tracks before linking ---------------------------------------------------------------------


def save_tracked(result: Result, path: Path) -> None:
    """Write tracks and embeddings, before they are linked and fitted, as npz."""
    columns = columns_of(result.tracks) | columns_of(result.untracked, "untracked_{}")
    columns |= columns_of(result.embeddings) | {"embedding_row": result.embedding_row}
    if result.boxes_3d is not None:
        columns |= columns_of(result.boxes_3d, "boxes_3d_{}")
    if result.looked is not None:
        columns["looked"] = result.looked
    facts = {"class_names": result.class_names, "warnings": result.warnings,
             "identities_given": result.identities_given,
             "video": dataclasses.asdict(result.video), "version": __version__}  # fmt: skip
    save_npz(path, columns, **facts)


def load_tracked(path: Path) -> Result:
    """Read what `save_tracked` wrote."""
    try:
        data, facts = load_npz(path, sealed=True)
        boxes = "boxes_3d_frame" in data
        return Result(
            from_columns(Tracks, data),
            tuple(facts["class_names"]),
            VideoInfo(**facts["video"]),
            embeddings=from_columns(Embeddings, data),
            embedding_row=data["embedding_row"],
            untracked=from_columns(Tracks, data, "untracked_{}"),
            looked=data.get("looked"),
            boxes_3d=from_columns(Boxes3D, data, "boxes_3d_{}") if boxes else None,
            identities_given=bool(facts["identities_given"]),
            warnings=list(facts["warnings"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ReobjError(f"{path}: {RUN_AGAIN}") from error


# ---- Table and report --------------------------------------------------------------------------


def object_table(result: Result) -> tuple[list[str], list[list[Any]]]:
    """Return the names of the columns, and a row for each object.

    Lengths are in world units, `_m` in metres; None where unknown. `center_m` and `yaw_deg` are in
    an upright frame (`upright_pose`).
    """
    head = ["id", "class", "status", "reason", "score", "confidence", "support"]
    vectors = ("center", "size", "size_m", "size_rel_sigma")
    head += [f"{name}_{axis}" for name in vectors for axis in "xyz"]
    head += ["qw", "qx", "qy", "qz", "views", "frames_seen", "visits", "part"]
    head += ["center_m_x", "center_m_y", "center_m_z", "yaw_deg"]
    rows = list[list[Any]]()
    for o in result.objects:
        lengths = [value for name in vectors for value in _numbers(getattr(o, name), 3)]
        pose = upright_pose(o, component_of(o, result.world))
        rows.append([
            o.id, o.class_name, o.status, o.reason, o.score, o.confidence, o.support, *lengths,
            *_numbers(o.quat_wxyz, 4), o.views, o.frames_seen, len(o.visits), o.part,
            *(pose["center_m"] or [None] * 3), pose["yaw_deg"],
        ])  # fmt: skip
    return head, rows


def _numbers(values: Array | None, count: int) -> list[float | None]:
    return [None] * count if values is None else values.tolist()


LEAST_NAME = 14  # characters of a class
MOST_NAME = 20
SIZE_WORDS = {"ok": "measured", "prior_dominated": "guessed", "rejected": "none"}


def summary(result: Result) -> str:
    """Write the report that `run` prints: what was found, where to look, and the table."""
    shown = [o for o in result.objects if o.counted]
    texts = [_counts(result, shown)]
    odd = [o for o in result.objects if o.status == "implausible"]
    if names := ", ".join(f"{o.class_name} {o.id} ({o.reason})" for o in odd):
        texts.append(f"implausible, not counted: {names}")
    if result.links is not None and (changed := result.links.changed):
        total = len(result.links.before)
        texts.append(f"linked again: {changed} of {total} identities have other boxes than before")
    if result.changes is not None:
        texts.append(result.changes.summary())
    lines = _lines(texts)
    if result.out is not None:
        files = [result.out / name for name in ("scene.html", "overlay.mp4", "objects.json")]
        lines.append("look at: " + ", ".join(str(file) for file in files if file.exists()))
    if shown:
        lines += ["", *_table(result, shown), *_lines(_reasons(shown))]
    if any(o.size_rel_sigma is not None for o in shown):
        lines.append("sigma: standard deviation of the least certain side")
    lines += ["", *_cameras(result)]
    lines.append("seconds: " + ", ".join(_stage_time(result, s) for s in result.seconds))
    return "\n".join(lines)


def _lines(texts: Iterable[str]) -> list[str]:
    """Wrap lines for a terminal of 80 columns."""
    return [line for text in texts for line in wrapped(text, 80)]


def _stage_time(result: Result, stage: str) -> str:
    """Format the seconds of a stage: of its steps, or that it was taken from the cache."""
    text = f"{stage} {result.seconds[stage]:.1f}"
    steps = result.step_seconds.get(stage, {stage: 0})
    if list(steps) == [stage]:
        return text
    times = ", ".join(f"{step} {seconds:.1f}" for step, seconds in steps.items())
    return f"{text} ({times or 'from the cache'})"


def sides(found: Object) -> list[tuple[str, ...]]:
    """Format width, depth, height (own axes x, y, z; m or units) with sigmas, if they are known.

    Returns:
        three (value, sigma) or (value,); [] without a size.
    """
    size = found.size if found.size_m is None else found.size_m
    if size is None:
        return []
    sigma = None if found.size_rel_sigma is None else size * found.size_rel_sigma
    return texts_with_sigma(size, sigma)


def _table(result: Result, shown: Sequence[Object]) -> list[str]:
    """Format a header and a line for each object; sizes only if there are any.

    The header states metres if any size is known in them; a size in world units then names its
    unit. The sigma is the largest relative one of the sides. Objects of several components are
    grouped by component, each below a line with its name. Those without a shape come last.
    """
    in_metres = any(o.size_m is not None for o in result.objects)
    has_sizes = any(o.size is not None for o in shown)
    unit = "m" if in_metres else "units"
    width = max(LEAST_NAME, *(min(len(o.class_name), MOST_NAME) for o in shown))
    header = f"{'object':>6}  {'class':<{width}} {'frames':>6}"
    if has_sizes:
        header += f"  {f'width x depth x height, {unit}':<26} {'sigma':>6}  size"
    lines = [header]
    component = None if len(result.world.parts) > 1 else 0
    for o in sorted(shown, key=lambda o: (o.part, not o.located)):
        if o.part != component and len(result.world.parts) > 1:
            component = o.part
            lines.append(f"component {component}")
        line = f"{o.id:>6}  {cut(o.class_name, MOST_NAME):<{width}} {o.frames_seen:>6}"
        if has_sizes:
            size = " x ".join(side for side, *_ in sides(o)) or "-"
            size += " units" * (in_metres and o.size is not None and o.size_m is None)
            share = o.size_rel_sigma
            sigma = "-" if share is None else f"{100 * share.max():.0f} %"
            line += f"  {size:<26} {sigma:>6}  {SIZE_WORDS.get(o.status, o.status)}"
        lines.append(line)
    return lines


def _reasons(shown: Sequence[Object]) -> list[str]:
    """Format each reason once, with the objects that have it."""
    objects_of: dict[str, list[int]] = {}
    for o in shown:
        for reason in filter(None, o.reason.split("; ")):
            objects_of.setdefault(reason, []).append(o.id)
    return [f"{reason}: object{'s' * (len(ids) > 1)} {', '.join(map(str, ids))}"
            for reason, ids in objects_of.items()]  # fmt: skip


def _counts(result: Result, shown: Sequence[Object]) -> str:
    """Format the number of objects with and without a shape, in all and of each class."""
    text = found_text(result.objects, names=True) if shown else "objects: none"
    text += " (each component counted separately)" * (len(result.world.parts) > 1)
    if doubtful := sum(o.status == "doubtful" for o in result.objects):
        text += f"; {doubtful} more of low confidence, probably false positives (objects.json)"
    return text


def _cameras(result: Result) -> list[str]:
    """Format the number of frames with a pose, and the scale, of each component."""
    world = result.world
    if result.poses is None:
        return []
    if len(world.parts) < 2:
        scale = [f"scale: {_scale_text(world.scale)}"] if world.scale else []
        return [result.poses.cameras_text, *scale]
    count = f"{len(world.parts)} components, each with its own frame and scale"
    texts = []
    for k, component in enumerate(world.parts):
        found = found_text(o for o in result.objects if o.part == k)
        frames = f"{component.registered_frames} of {component.frames} frames"
        scale_text = f"; scale {_scale_text(component.scale)}" if component.scale else ""
        grade = "; directions only" * (component.grade == "directions")
        texts.append(f"component {k}: {component.span_text}; {frames}{grade}; {found}{scale_text}")
    return [f"{result.poses.cameras_text} in {count}", *_lines(texts)]


def _scale_text(scale: quadrics.Scale) -> str:
    sigma = scale.rel_sigma or 0.0
    ((value, *_),) = texts_with_sigma(np.array([scale.value]), np.array([sigma * scale.value]))
    return f"{value} m per unit, sigma {100 * sigma:.0f} % (from {scale.source.replace('_', ' ')})"
