"""Result of a run, typed: objects, their world, tracks and cameras; writes and reads its files.

Start at `Result`. Nothing is computed here; the pictures (the film, scene.html) need the video
and have rooms of their own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj import __version__
from reobj.cameras import Poses, load_poses, save_poses
from reobj.files import (
    atomic,
    cut,
    load_json,
    load_npz,
    numbers,
    part_path,
    rounded,
    save_npz,
    shortened,
    texts_with_sigma,
    wrapped,
)
from reobj.poses.floor import Floor
from reobj.results.edits import EDITS, Edits, write_edits
from reobj.results.folder import LAST_POSES, STALE, replaced, write_mot, write_trajectories
from reobj.results.ply import write_ply
from reobj.schema import faults, objects_schema
from reobj.sources.tables import read_mot_rows
from reobj.sources.video import Video
from reobj.types import (
    Array,
    Embeddings,
    Floats,
    IntArray,
    LinkEvent,
    ReobjError,
    Tracks,
    visible_name,
    without_secrets,
)

FORMAT = "reobj-objects"
FORMAT_VERSION = 1  # of objects.json
CONVENTIONS = {
    "pose": "cam_from_world",
    "camera_axes": "x right, y down, z forward",
    "quaternion": "wxyz, world_from_obj",
    "pixels": "centre of the top-left pixel at (0.5, 0.5) (COLMAP)",
    "frames": "0-based",
    "size": "full extents of the solid along its own axes",
    "ellipsoid": "inscribed in a box or cylinder",
    "cov": "9x9: center, log half axes, rotation vector in object axes",
}
CLASS_MAX = 40  # characters of a class name in the table (chosen: a line of 120)
EVIDENCE_DIGITS = 4  # of overlaps and log odds in the links; chosen: a box is measured to 1 in 100
_JSON_KEYS = {"class_name": "class", "tracklet_ids": "tracks", "visits": "frames"}


@dataclass(frozen=True, slots=True, eq=False)
class Object:
    """One physical object; lengths in world units, None where no solid was fitted.

    Attributes:
        id: identity in the tracks, from 1. class_name: of the largest sum of scores; score: mean.
        status: "ok", "prior_dominated" (some size rests on the category's prior), "doubtful" (less
            likely there than not), "rejected" (no solid), "tracked" (2D: no cameras). reason: why.
        confidence: probability that it is there, a thing of its own; None without cameras.
        classes: probabilities of the likeliest two. support: "box", "cylinder" or "ellipsoid".
        center, half_axes: (3,) of the ellipsoid; quat_wxyz: (4,) world_from_obj.
        size: (3,) full extents of the solid along its own axes; size_m: the same in metres, None
            where the scale is unknown; size_rel_sigma: (3,) relative standard deviation.
        cov: (9, 9) of center, log half axes, rotation vector in object axes.
        views: frames with a pose that show it; dropped_boxes: of them, outliers.
        frames_seen: frames that show it. parallax_deg: widest angle between two viewing rays.
        reprojection_iou_median: overlap of the projected solid with the boxes.
        tracklet_ids: its unbroken tracks; visits: first and last frame of each, by time.
        part: of the cameras' path, whose world and units its lengths are in (`Poses.part`).
    """

    id: int
    class_name: str
    score: float
    status: str
    reason: str
    support: str | None = None
    center: Array | None = None
    half_axes: Array | None = None
    quat_wxyz: Array | None = None
    size: Array | None = None
    size_m: Array | None = None
    size_rel_sigma: Array | None = None
    cov: Array | None = None
    views: int = 0
    frames_seen: int = 0
    parallax_deg: float | None = None
    dropped_boxes: int = 0
    reprojection_iou_median: float | None = None
    tracklet_ids: list[int] = field(default_factory=list)
    visits: list[list[int]] = field(default_factory=list)
    part: int = 0
    confidence: float | None = None
    classes: dict[str, float] = field(default_factory=dict)

    @property
    def located(self) -> bool:
        """True where a solid was fitted, and is not doubtful."""
        return self.status in ("ok", "prior_dominated")

    def to_json(self) -> dict[str, Any]:
        """Return the entry of objects.json."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {_JSON_KEYS.get(k, k): _plain(v) for k, v in values.items()}

    @staticmethod
    def from_json(entry: dict[str, Any]) -> Object:
        """Read an entry of objects.json; unknown keys are ignored."""
        entry = {"part": 0, "confidence": None, "classes": {}, **entry}  # older files lack these
        values = {f.name: entry[_JSON_KEYS.get(f.name, f.name)] for f in dataclasses.fields(Object)}
        for name in ("center", "half_axes", "quat_wxyz", "size", "size_m", "size_rel_sigma", "cov"):
            values[name] = None if values[name] is None else np.array(values[name], np.float64)
        return Object(**values | {"class_name": visible_name(values["class_name"])})


def sides(found: Object) -> list[tuple[str, ...]]:
    """Write width, depth, height (own axes x, y, z; m or units) and any sigmas; [] if unknown."""
    size, rel = found.size if found.size_m is None else found.size_m, found.size_rel_sigma
    return [] if size is None else texts_with_sigma(size, None if rel is None else size * rel)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A rigid part of the cameras' path, which is a world of its own.

    Attributes:
        spans: first and last frame of each unbroken run of its frames; frames: their number.
        registered_frames, interpolated_frames: of them with a pose, and between two.
        up_in_world, up_source, scale, floor, floor_reason: as in `World`.
    """

    spans: list[list[int]]
    frames: int
    registered_frames: int
    interpolated_frames: int = 0
    up_in_world: Array | None = None
    up_source: str = "none"
    scale: quadrics.Scale | None = None
    floor: Floor | None = None
    floor_reason: str = ""

    @property
    def span_text(self) -> str:
        """Frames of the part, for messages: "frames 0-99, 130"."""
        return "frames " + shortened([str(a) if a == b else f"{a}-{b}" for a, b in self.spans])


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Units, gravity and scale of the world that the objects stand in, and how they were linked.

    Where the cameras come in several parts, this is the world of the largest one.

    Attributes:
        units: "m", "arbitrary", or None without cameras. source: of the poses.
        reading: format of supplied poses, and the rule that found their frames.
        registered_frames, interpolated_frames: with a pose, between two; frames: in all parts.
        up_in_world: (3,) unit vector against gravity; up_source: where it comes from.
        scale: metres per unit, its relative sigma and source; None without a fit.
        links: joins and splits of tracklets with their evidence.
        parts: of the cameras' path, the largest first; () without cameras.
        floor: the plane of the floor; None where none can be told, and floor_reason says why.
    """

    units: str | None = None
    source: str = "none"
    registered_frames: int = 0
    interpolated_frames: int = 0
    frames: int = 0
    up_in_world: Array | None = None
    up_source: str = "none"
    scale: quadrics.Scale | None = None
    links: tuple[LinkEvent, ...] = ()
    parts: tuple[Part, ...] = ()
    floor: Floor | None = None
    floor_reason: str = ""
    reading: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the `world` of objects.json."""
        values = _world_json(self) | {"parts": [_world_json(part) for part in self.parts]}
        links = [dataclasses.asdict(event) for event in self.links]
        for link in links:
            link["place_iou"] = rounded(link["place_iou"], EVIDENCE_DIGITS)
            link["appearance_log_odds"] = rounded(link["appearance_log_odds"], EVIDENCE_DIGITS)
        return values | {"links": links}

    @staticmethod
    def from_json(entry: dict[str, Any]) -> World:
        """Read the `world` of objects.json."""
        values = _world_values(World, entry)
        values["links"] = tuple(LinkEvent.from_json(link) for link in values.get("links", ()))
        values["parts"] = tuple(Part(**_world_values(Part, e)) for e in values.get("parts", ()))
        return World(**values)


def _world_json(world: World | Part) -> dict[str, Any]:
    """Convert a world's fields for JSON, but for its links and parts."""
    values = {f.name: _plain(getattr(world, f.name)) for f in dataclasses.fields(world)}
    if world.scale is not None:
        values["scale"] = {
            "metres_per_unit": world.scale.value,
            "rel_sigma": world.scale.rel_sigma,
            "source": world.scale.source,
        }
    if world.floor is not None:
        values["floor"] = {k: _plain(v) for k, v in dataclasses.asdict(world.floor).items()}
    return values


def _world_values(kind: type[World | Part], entry: dict[str, Any]) -> dict[str, Any]:
    """Read what `_world_json` wrote; what an older file lacks is left out."""
    values = {f.name: entry[f.name] for f in dataclasses.fields(kind) if f.name in entry}
    if (up := values.get("up_in_world")) is not None:
        values["up_in_world"] = np.array(up, np.float64)
    if (scale := values.get("scale")) is not None:
        facts = (scale["metres_per_unit"], scale["rel_sigma"], scale["source"])
        values["scale"] = quadrics.Scale(*facts)
    if (floor := values.get("floor")) is not None:
        vectors = {name: np.array(floor[name], np.float64) for name in ("normal", "middle")}
        values["floor"] = Floor(**floor | vectors)
    return values


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """Path of a result's video, without password; native size in pixels; frame rate in Hz."""

    path: str
    width: int
    height: int
    fps: float

    @staticmethod
    def of(video: Video) -> VideoInfo:
        """Describe an opened video."""
        return VideoInfo(str(video.source), *video.size, video.fps)


@dataclass(slots=True, eq=False)
class Result:
    """Tracks, cameras and objects of a video.

    Attributes:
        tracks: all rows of the video in native pixels, with the objects' identities.
        untracked: detections that the tracker left out, as rows of no tracklet; places in 3D may
            tell later what they are of.
        class_names: names of the tracks' `class_id`.
        objects: one for each identity, by id. world: units, gravity, scale, joins and splits.
        poses: cameras, or None. fits: of the objects, in their order; None if nothing was fitted
            here (no cameras, or read from a folder).
        embeddings: (n, E1) and (n, E2), fused: foreground and background of the rows
            `embedding_row` (n,) of the tracks that the tracker embedded.
        looked: (F,) frames that the detector was run on, ascending; None: all that were read.
        identities_given: the user gave the identities; nothing may join, split or renumber them.
        seconds: wall time by stage. warnings: what the user should know. edits: made by hand.
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
    looked: IntArray | None = None
    identities_given: bool = False
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    edits: Edits | None = None
    out: Path | None = None

    @property
    def located(self) -> list[Object]:
        """Objects that have a solid, by id."""
        return [o for o in self.objects if o.located]

    def of_part(self, part: int) -> Result:
        """Return the objects, cameras and world of one part alone, without the fits.

        The tracks stay those of the whole video. With one part only: this result itself.
        """
        if self.poses is None or self.poses.part_count == 1:
            return self
        facts, names = self.world.parts[part], {f.name for f in dataclasses.fields(Part)}
        own = {name: getattr(facts, name) for name in names - {"spans"}}
        return dataclasses.replace(
            self,
            objects=[o for o in self.objects if o.part == part],
            world=dataclasses.replace(self.world, **own, parts=(facts,)),
            poses=self.poses.of_part(part),
            fits=None,
        )

    def without_doubtful(self) -> Result:
        """Return the objects that are likelier there than not, with their tracks; no fits."""
        doubtful = [o.id for o in self.objects if o.status == "doubtful"]
        return dataclasses.replace(
            self,
            objects=[o for o in self.objects if o.status != "doubtful"],
            tracks=self.tracks[~np.isin(self.tracks.track_id, doubtful)],
            fits=None,
        )

    def parts(self) -> list[Result]:
        """Return `of_part` of all parts, the largest first: this result alone if it has one."""
        count = 1 if self.poses is None else self.poses.part_count
        return [self.of_part(part) for part in range(count)]

    def ellipsoids(self) -> quadrics.Ellipsoids:
        """Return the ellipsoids of the `located` objects, in their order: each in its own part."""
        found = self.located
        if self.fits is not None:  # with all digits
            return self.fits.ellipsoids[np.array([o.located for o in self.objects], bool)]
        center, half_axes = (
            np.array([getattr(o, name) for o in found], np.float64).reshape(-1, 3)
            for name in ("center", "half_axes")
        )
        wxyz = np.array([o.quat_wxyz for o in found], np.float64).reshape(-1, 4)
        axes = (
            Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() if found else np.empty((0, 3, 3))
        )
        return quadrics.Ellipsoids(center, half_axes, axes)

    def save(
        self,
        out: str | Path,
        doubtful: bool = False,
        more: Callable[[Path], None] | None = None,
        stale: Sequence[str] = (),
    ) -> None:
        """Write tracks.txt, objects.json, and where there are cameras poses.txt and objects.ply.

        Doubtful objects are in objects.json, in tracks.txt only if `doubtful`. Of several parts
        each has its own poses and objects: poses_part1.txt, objects_part1.ply, ... All of them
        appear together, when all are complete, instead of those of an earlier run, whose film and
        page are removed.

        Args:
            more: writes more files into the folder that it is given; they appear with the others.
            stale: names that are removed where `more` does not write them.
        """
        edited = () if self.edits is None else (EDITS,)
        with replaced(Path(out), (*STALE, *edited, *stale)) as new:
            write_mot(new / "tracks.txt", (self if doubtful else self.without_doubtful()).tracks)
            self.write_objects(new / "objects.json")
            write_edits(new, self.edits)
            if self.poses is not None:
                save_poses(new / LAST_POSES, self.poses)
                write_trajectories(new, self.poses)
            if self.fits is not None or self.located:
                for k, part in enumerate(self.parts()):
                    ids = [o.id for o in part.located]
                    write_ply(part_path(new / "objects.ply", k), part.ellipsoids(), ids)
            if more is not None:
                more(new)
        self.out = Path(out)

    @staticmethod
    def load(out: str | Path) -> Result:
        """Read what `save` wrote; without the fits and the embeddings.

        Boxes come as tracks.txt has them, to .01 px, with the class of their object (-1: there is
        no such object, as in a file that was edited by hand).

        Raises:
            ReobjError: no `run` or `track` finished there, or another version wrote the folder.
        """
        out = Path(out)
        if not (out / "objects.json").is_file() or not (out / "tracks.txt").is_file():
            raise ReobjError(f"{out}: no objects.json and tracks.txt; make them first with `run`")
        path, poses = out / "objects.json", load_last_poses(out)
        data = load_json(path)
        for fault in faults(data, objects_schema()):
            raise ReobjError(f"{path}: {fault}; {written_by(out)}")
        objects = [Object.from_json(entry) for entry in data["objects"]]
        world = World.from_json(data["world"])
        facts = {f.name: data["video"][f.name] for f in dataclasses.fields(VideoInfo)}
        names = tuple(dict.fromkeys(o.class_name for o in objects))
        class_of = {o.id: names.index(o.class_name) for o in objects}
        rows = read_mot_rows(out / "tracks.txt")
        ids = rows[:, 1].astype(np.int64)
        _check_together(objects, world, poses, out)
        unknown = np.full(len(rows), -1, np.int64)
        classes = np.array([class_of.get(i, -1) for i in ids.tolist()], np.int64)
        corners = np.concatenate([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]], 1)  # (N, 4)
        frame = rows[:, 0].astype(np.int64) - 1
        tracks = Tracks(frame, ids, ids, corners, rows[:, 6], classes, unknown)
        info, warnings = VideoInfo(**facts), data.get("warnings", [])
        return Result(tracks, names, info, objects, world, poses, warnings=warnings, out=out)

    def keep_embeddings(
        self,
        frames: Sequence[int],
        embedded: Sequence[tuple[IntArray, Floats]],
        foreground_width: int,
    ) -> None:
        """Take over a tracker's embeddings, for the rows of the tracks that have one.

        Args:
            frames: source frame numbers. embedded: of each, detection indices (n,) and their fused
                rows (n, E). foreground_width: columns of the foreground (0: all).
        """
        tracks = self.tracks
        keys = zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True)
        row_of = {key: row for row, key in enumerate(keys)}
        found = zip(frames, embedded, strict=True)
        rows = [row_of.get((f, d), -1) for f, (index, _) in found for d in index.tolist()]
        row = np.array(rows, np.int64)
        parts = [part for _, part in embedded if part.size] or [np.empty((0, 0), np.float32)]
        fused = np.concatenate(parts)[row >= 0].astype(np.float16)
        width = foreground_width or fused.shape[1]
        self.embeddings = Embeddings(fused[:, :width], fused[:, width:])
        self.embedding_row = row[row >= 0]

    def save_tracked(self, path: Path) -> None:
        """Write tracks and embeddings, before anything is linked or fitted, as npz."""
        looked = {} if self.looked is None else {"looked": self.looked}
        columns = {f.name: getattr(self.tracks, f.name) for f in dataclasses.fields(Tracks)}
        columns |= {f"untracked_{n}": getattr(self.untracked, n) for n in columns}
        columns |= {name: getattr(self.embeddings, name) for name in ("foreground", "background")}
        facts = {"class_names": self.class_names, "warnings": self.warnings,
                 "identities_given": self.identities_given,
                 "video": dataclasses.asdict(self.video), "version": __version__}  # fmt: skip
        save_npz(path, columns | looked | {"embedding_row": self.embedding_row}, **facts)

    @staticmethod
    def load_tracked(path: Path) -> Result:
        """Read what `save_tracked` wrote."""
        try:
            data, facts = load_npz(path, sealed=True)
            return Result(
                Tracks(*(data[f.name] for f in dataclasses.fields(Tracks))),
                tuple(facts["class_names"]),
                VideoInfo(**facts["video"]),
                embeddings=Embeddings(data["foreground"], data["background"]),
                embedding_row=data["embedding_row"],
                untracked=Tracks(
                    *(data[f"untracked_{f.name}"] for f in dataclasses.fields(Tracks))
                ),
                looked=data.get("looked"),
                identities_given=bool(facts["identities_given"]),
                warnings=list(facts["warnings"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ReobjError(f"{path}: {written_by(path.parent.parent)}") from error

    def summary(self) -> str:
        """Return the table that `run` prints: object, class, frames, any size and sigma, status."""
        counted = [o for o in self.objects if o.status != "doubtful"]
        scaled = any(o.size_m is not None for o in self.objects)
        sized = any(o.size is not None for o in counted)
        sizes = f"{'width x depth x height, ' + ('m' if scaled else 'units'):<26} {'sigma':>6}  "
        lines = [f"{'object':>6}  {'class':<14} {'frames':>6} {'visits':>6}  {sizes * sized}status"]
        for o in counted:
            text = " x ".join(side for side, *_ in sides(o)) or "-"
            text += " units" if scaled and o.size is not None and o.size_m is None else ""
            sigma = "-" if o.size_rel_sigma is None else f"{100 * o.size_rel_sigma.max():.0f} %"
            sizes = f"{text:<26} {sigma:>6}  "
            part = f", part {o.part}" if len(self.world.parts) > 1 else ""
            name = cut(o.class_name, CLASS_MAX)
            lines.append(
                f"{o.id:>6}  {name:<14} {o.frames_seen:>6} {len(o.visits):>6}  "
                f"{sizes * sized}{o.status}{part}"
            )
        reasons: dict[str, list[int]] = {}  # each once, with the objects that it holds for
        for o in counted:
            reasons.setdefault(f"{o.status}: {o.reason}" * bool(o.reason), []).append(o.id)
        for reason, ids in reasons.items():
            lines += wrapped(f"{reason}: {', '.join(map(str, ids))}") if reason else []
        counts = sorted(Counter(o.class_name for o in counted).items())
        each = " (each part counted by itself)" if len(self.world.parts) > 1 else ""
        names = ", ".join(f"{n} {c}" for c, n in counts) or "none"
        lines += wrapped(f"distinct objects: {names}{each}")
        if (doubtful := len(self.objects) - len(counted)) > 0:
            lines.append(f"doubtful: {doubtful} more, less likely there than not (objects.json)")
        lines += self._camera_lines()
        lines.append("seconds: " + ", ".join(f"{k} {v:.1f}" for k, v in self.seconds.items()))
        if self.out is not None:
            shown = ("scene.html", "overlay.mp4", "overlay.webm", "objects.json")
            files = [self.out / name for name in shown]
            lines.append("look at: " + ", ".join(str(file) for file in files if file.exists()))
        return "\n".join(lines)

    def _camera_lines(self) -> list[str]:
        """Say how many frames have a camera and what the scale is; of several parts, of each."""
        world = self.world
        if self.poses is None:
            return []
        if len(world.parts) < 2:
            scale = [f"scale: {_scale_text(world.scale)}"] if world.scale else []
            return [self.poses.cameras_text, *scale]
        lines = [
            f"{self.poses.cameras_text} in {len(world.parts)} parts, each in a frame and scale of "
            "its own"
        ]
        for k, part in enumerate(world.parts):
            count = sum(o.part == k for o in self.objects)
            scale = [f"scale {_scale_text(part.scale)}"] if part.scale else []
            cameras = f"{part.registered_frames} of {part.frames} frames"
            facts = [part.span_text, cameras, f"{count} object{'s' * (count != 1)}", *scale]
            lines += wrapped(f"part {k}: " + "; ".join(facts))
        return lines

    def write_objects(self, path: Path) -> None:
        """Write objects.json."""
        versions = {}
        for name in ("numpy", "scipy", "opencv-python-headless", "pycolmap", "onnxruntime"):
            with contextlib.suppress(PackageNotFoundError):  # installed under another name
                versions[name] = version(name)
        tracked = {"tracked_frames": len(np.unique(self.tracks.frame))}
        data = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "command": " ".join(map(without_secrets, sys.argv)),
            "reobj_track": __version__,
            "versions": versions,
            "conventions": CONVENTIONS,
            "video": dataclasses.asdict(self.video) | tracked,
            "world": self.world.to_json(),
            "objects": [o.to_json() for o in self.objects],
            "warnings": self.warnings,
        }
        with atomic(path) as part:
            part.write_text(json.dumps(data, indent=1) + "\n")


def _scale_text(scale: quadrics.Scale) -> str:
    sigma = f"{100 * (scale.rel_sigma or 0):.0f} %"
    return f"{scale.value} m per unit, sigma {sigma} (from {scale.source})"


def significant(values: Array, size: float = math.inf) -> Array:
    """Round an array to six significant digits, as its text in objects.json has them.

    size: of what lies at these coordinates, as in `numbers`.
    """
    return np.array(numbers(values, size), np.float64).reshape(np.shape(values))


def _plain(value: Any) -> Any:
    """Convert an array to nested lists; anything else stays as it is."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def written_by(out: Path) -> str:
    """Say why a file in an output folder cannot be read, by the version that objects.json names."""
    data: dict[str, Any] = {}
    with contextlib.suppress(ReobjError):
        data = load_json(out / "objects.json")
    wrote = data.get("reobj_track") if isinstance(data, dict) else None
    if wrote == __version__:
        return "is damaged: run the video again"
    by = f"written by reobj_track {wrote or 'before 0.2'}, this is {__version__}"
    return f"{by}: run the video again"


def load_last_poses(out: Path) -> Poses | None:
    """Read the latest poses of an output folder, None if it has none."""
    path = out / LAST_POSES
    if not path.is_file():
        return None
    try:
        return load_poses(path)
    except (KeyError, TypeError, ReobjError) as error:
        raise ReobjError(f"{path}: {written_by(out)}") from error


def _check_together(
    objects: Sequence[Object], world: World, poses: Poses | None, out: Path
) -> None:
    """Refuse what no schema can tell: the parts of a result that do not fit each other."""
    own = [o.id for o in objects]
    parts = 1 if poses is None else poses.part_count
    fault = ""
    if len(set(own)) != len(own):
        fault = "two objects of one id"
    for o in objects:
        if o.quat_wxyz is not None and abs(np.linalg.norm(o.quat_wxyz) - 1) > UNIT_TOLERANCE:
            fault = f"quat_wxyz of object {o.id} is not of length 1"
        if o.part >= max(parts, len(world.parts)):
            fault = f"object {o.id} is of part {o.part}, which is not there"
    if parts not in (1, len(world.parts)):
        fault = f"{len(world.parts)} parts of a path that has {parts}"
    if fault:
        raise ReobjError(f"{out / 'objects.json'}: {fault}; {written_by(out)}")


UNIT_TOLERANCE = 1e-3  # of a quaternion's length; chosen: rounded to six digits it is off by 1e-6
