"""The map file: sessions, objects with one observation per session, points with descriptors.

A map is an npz file with JSON in it, written atomically, with a digest and a version. It holds no
pictures unless they were asked for. What is known of an object now is computed from its
observations (`reobj.maps.fusion`), so that a session can be forgotten or replaced.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

import quadrics
from reobj import __version__
from reobj.files import LockedError, columns_of, load_npz, locked, save_npz
from reobj.types import (
    Array,
    FiniteFloat,
    Floats,
    Int32,
    IntArray,
    NonNegativeFloat,
    PositiveFloat,
    ReobjError,
    Vector,
    one_line,
)

FORMAT = "reobj-map"
VERSION = 2  # 1 (of 0.2.0) has cameras of the sessions too
# Dtypes in the file (and shapes of a row). float16 of a direction: 3e-4 rad; of a covariance it
# would lose sigmas below 2e-4 and, by rounded correlations, the small variances.
POINTS: dict[str, type[Any]] = {
    "xyz": np.float32,
    "descriptor": np.uint8,
    "session": np.int32,
    "object_id": np.int32,
    "viewing_ray": np.float16,
    "distance": np.float32,
}
IN_MEMORY = {"f": np.float64, "i": np.int64, "u": np.uint8}
OBSERVATIONS: dict[str, tuple[type[Any], tuple[int, ...]]] = {
    "center": (np.float64, (3,)),
    "half_axes": (np.float32, (3,)),
    "quat_wxyz": (np.float32, (4,)),
    "cov": (np.float32, (9, 9)),
}
CONCATENATED: dict[str, type[Any]] = {
    "foreground": np.float16, "background": np.float16, "picture": np.uint8,
}  # fmt: skip
LOWER = np.tril_indices(9)  # entries of a covariance in the file
Number = Annotated[int, msgspec.Meta(ge=1, lt=2**31)]  # of an object or a session


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observation of an object in one session, in the world of the map.

    Attributes:
        session: number of the session. status: "new" (first seen), "stayed", "moved", "gone" or
            "not_seen".
        support: kind of shape; "" where it was not detected. center, half_axes: (3,); quat_wxyz:
            (4,) world_from_obj; cov: (9, 9) of centre, log half axes and rotation vector in object
            axes, without the uncertainty of the alignment of the session; NaN if not detected.
        classes: weight (sum of detection scores) of each class.
        foreground, background: mean unit embeddings of the session's model; empty: none.
        embedded: number of embedded detections.
        views: detections. expected: independent views in which it should have been detected.
        missed: of those, views without a detection.
        log_odds: that the object existed, from this session.
        picture: JPEG; empty unless pictures were asked for.
    """

    session: Number
    status: Annotated[str, msgspec.Meta(pattern="^(new|stayed|moved|gone|not_seen)$")]
    support: str = ""
    center: Array = field(default_factory=np.full(3, np.nan).copy)
    half_axes: Array = field(default_factory=np.full(3, np.nan).copy)
    quat_wxyz: Array = field(default_factory=np.full(4, np.nan).copy)
    cov: Array = field(default_factory=np.full((9, 9), np.nan).copy)
    classes: dict[str, NonNegativeFloat] = field(default_factory=dict)
    foreground: Floats = field(default_factory=np.empty(0, np.float32).copy)
    background: Floats = field(default_factory=np.empty(0, np.float32).copy)
    embedded: Int32 = 0
    views: Int32 = 0
    expected: Int32 = 0
    missed: Int32 = 0
    log_odds: FiniteFloat = 0.0
    picture: bytes = b""

    @property
    def detected(self) -> bool:
        """True if the object was found in this session."""
        return self.support != ""


@dataclass(frozen=True, slots=True, eq=False)
class MapObject:
    """An object of the map.

    Attributes:
        id: number, never given to another object. observations: by session.
        name: class given by the user; "": that of the detections.
        deleted: by the user: no object; it is matched, and then left out of results.
    """

    id: Number
    observations: tuple[Observation, ...]
    name: str = ""
    deleted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A recording that the map was made or updated with.

    Attributes:
        number: from 1, never used again. name: of the recording. date: ISO 8601, UTC.
        fingerprint: of the video's content. embedder: key of the embedding model.
        metres_per_unit, scale_rel_sigma, scale_source: the scale of the map's world as this
            session measured it; source "none": it did not.
        alignment_cov: (7, 7) of the alignment of the session with the map: of the rotation vector
            (rad), translation (map units) and log scale of a small similarity about the origin of
            the map's world, applied after the alignment; zeros for the first session.
        localised_frames, tried_frames: that agreed with the map, that were compared.
    """

    number: Number
    name: str
    date: str
    fingerprint: str
    embedder: str
    metres_per_unit: PositiveFloat = 1.0
    scale_rel_sigma: NonNegativeFloat = 0.0
    scale_source: Annotated[str, msgspec.Meta(pattern="^(poses|priors|known_size|none)$")] = "none"
    alignment_cov: Array = field(default_factory=np.zeros((7, 7)).copy)
    localised_frames: Int32 = 0
    tried_frames: Int32 = 0

    @property
    def scale(self) -> quadrics.Scale:
        """Metres per unit of the map as this session measured it."""
        return quadrics.Scale(self.metres_per_unit, self.scale_rel_sigma, self.scale_source)


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Sparse points of the map.

    Attributes:
        xyz: (N, 3) in the world of the map. descriptor: (N, 128) uint8, mean RootSIFT x 512.
        session: (N,) number of the session. object_id: (N,) object that it lies on, or 0.
        viewing_ray: (N, 3) mean unit direction from the cameras to the point.
        distance: (N,) median distance from the cameras.
    """

    xyz: Array
    descriptor: npt.NDArray[np.uint8]
    session: IntArray
    object_id: IntArray
    viewing_ray: Array
    distance: Array

    @staticmethod
    def empty() -> MapPoints:
        """Return no points."""
        return MapPoints(
            np.empty((0, 3)), np.empty((0, 128), np.uint8), np.empty(0, np.int64),
            np.empty(0, np.int64), np.empty((0, 3)), np.empty(0),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.xyz)

    def __getitem__(self, rows: Any) -> MapPoints:
        """Select points by slice, mask or index array."""
        return MapPoints(*(getattr(self, f.name)[rows] for f in dataclasses.fields(self)))

    @staticmethod
    def joined(tables: Sequence[MapPoints]) -> MapPoints:
        """Concatenate tables."""
        columns = [f.name for f in dataclasses.fields(MapPoints)]
        return MapPoints(*(np.concatenate([getattr(t, c) for t in tables]) for c in columns))


@dataclass(frozen=True, slots=True, eq=False)
class RoomMap:
    """Map of a room: its objects keep their numbers over any number of recordings.

    The world is that of the largest component of the first recording; its unit is a metre if that
    recording's poses were metric.

    Attributes:
        map_id: random identifier. sessions: by number. objects: by id. points: for localisation.
        metric: world units are metres. up: (3,) unit vector against gravity, or None.
        next_id: least number that no object of any session was given.
        next_session: least number that no session had.
        merged: numbers that were merged into another object: {old: kept}.
    """

    map_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    sessions: tuple[Session, ...] = ()
    objects: tuple[MapObject, ...] = ()
    points: MapPoints = field(default_factory=MapPoints.empty)
    metric: bool = False
    up: Vector | None = None
    next_id: Number = 1
    next_session: Number = 1
    merged: dict[Number, Number] = field(default_factory=dict)

    def session_of(self, fingerprint: str) -> Session | None:
        """Return the session of a video, if it is in the map."""
        return next((s for s in self.sessions if s.fingerprint == fingerprint), None)

    def object(self, number: int) -> MapObject:
        """Return an object by its number, or by one that was merged into it.

        Raises:
            ReobjError: no such object.
        """
        number = self.merged.get(number, number)
        for found in self.objects:
            if found.id == number:
                return found
        known = ", ".join(str(o.id) for o in self.objects[:40])
        raise ReobjError(f"no object {number} in the map; it has {known or 'none'}")

    def save(self, path: str | Path) -> None:
        """Write the file, atomically; the same map gives the same bytes."""
        arrays, facts = encoded(self)
        _decoded(arrays, facts)  # refuses a map that could not be read again
        save_npz(Path(path), arrays, **facts)

    @staticmethod
    def load(path: str | Path) -> RoomMap:
        """Read a file that `save` wrote.

        Raises:
            ReobjError: missing, damaged, another kind of file, or of a newer version.
        """
        path = Path(path)
        if path.is_dir():
            raise ReobjError(f"{path}: is a folder, but a map is a file")
        if not path.is_file():
            raise ReobjError(f"{path}: no such map; `run VIDEO -o OUT --map {path}` makes it")
        _check_kind(path)
        facts = load_npz(path)[1]
        if facts.get("format") != FORMAT:
            raise ReobjError(f"{path}: {ANOTHER_FILE}")
        if facts.get("version") not in (1, VERSION):
            raise ReobjError(
                f"{path}: a map of format {facts.get('version')}, this version reads up to "
                f"{VERSION}; it was written by reobj_track {facts.get('reobj_track')}: "
                "update the tool"
            )
        arrays, facts = load_npz(path, sealed=True)
        try:
            return _decoded(arrays, facts)
        except (LookupError, TypeError, ValueError, msgspec.ValidationError) as error:
            raise ReobjError(
                f"{path}: damaged ({one_line(str(error))}); use a copy of it"
            ) from error


# ---- File --------------------------------------------------------------------------------------

ANOTHER_FILE = "not a map of reobj_track; another file was given"


def _check_kind(path: Path) -> None:
    """Refuse a file whose first bytes show that it is no zip file, as npz files are."""
    with path.open("rb") as file:
        if file.read(2) != b"PK":
            raise ReobjError(f"{path}: {ANOTHER_FILE}")


def encoded(room: RoomMap) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arrays of a map's file, and its JSON."""
    # In float32 coordinates of a map projection have a resolution of .5 m: points are relative to a
    # multiple of 1024, which is 0 for a room near the origin of its world
    xyz = room.points.xyz
    origin = 1024 * np.round((np.median(xyz, 0) if len(xyz) else np.zeros(3)) / 1024)
    origin += 0.0  # no -0
    columns = columns_of(room.points) | {"xyz": xyz - origin}
    arrays: dict[str, Any] = {"points_origin": origin}
    arrays |= {f"points_{name}": columns[name].astype(kind) for name, kind in POINTS.items()}
    objects = sorted(room.objects, key=lambda found: found.id)
    rows = [o for found in objects for o in sorted(found.observations, key=lambda o: o.session)]
    for name, (kind, shape) in OBSERVATIONS.items():
        values = np.array([getattr(o, name) for o in rows], np.float64).reshape(-1, *shape)
        values = values[:, LOWER[0], LOWER[1]] if name == "cov" else values
        arrays[f"observation_{name}"] = values.astype(kind)
    for name, kind in CONCATENATED.items():
        parts = [np.array(list(getattr(o, name)), kind) for o in rows]
        if name != "picture" or any(map(len, parts)):
            arrays[f"observation_{name}"] = np.concatenate([np.empty(0, kind), *parts])
            arrays[f"observation_{name}_length"] = np.array([*map(len, parts)], np.int32)
    sessions = []
    for s in sorted(room.sessions, key=lambda session: session.number):
        fields = columns_of(s)
        arrays[f"session{s.number}_alignment_cov"] = fields.pop("alignment_cov")
        sessions.append(fields)
    omitted = {*OBSERVATIONS, *CONCATENATED}
    return arrays, {
        "format": FORMAT,
        "version": VERSION,
        "reobj_track": __version__,
        "map_id": room.map_id,
        "metric": room.metric,
        "up": None if room.up is None else room.up.tolist(),
        "next_id": room.next_id,
        "next_session": room.next_session,
        "merged": {str(old): room.merged[old] for old in sorted(room.merged)},
        "sessions": sessions,
        "objects": [columns_of(o) | {"observations": len(o.observations)} for o in objects],
        "observations": [
            {name: value for name, value in columns_of(o).items() if name not in omitted}
            | {"classes": dict(sorted(o.classes.items()))}
            for o in rows
        ],
    }


def _decoded(arrays: dict[str, Any], facts: dict[str, Any]) -> RoomMap:
    """Build a map from the content of its file."""
    points = {
        name: (column := arrays[f"points_{name}"]).astype(IN_MEMORY[column.dtype.kind])
        for name in POINTS
    }
    points["xyz"] += arrays["points_origin"]
    columns: dict[str, Any] = {
        name: arrays[f"observation_{name}"].astype(np.float64) for name in OBSERVATIONS
    }
    lower = columns["cov"]
    cov = columns["cov"] = np.empty((len(lower), 9, 9))
    cov[:, LOWER[0], LOWER[1]] = lower
    cov[:, LOWER[1], LOWER[0]] = lower
    for name in CONCATENATED:
        if f"observation_{name}" in arrays:
            ends = np.cumsum(arrays[f"observation_{name}_length"])
            parts = np.split(arrays[f"observation_{name}"], ends)[:-1]
            is_picture = name == "picture"
            columns[name] = [p.tobytes() if is_picture else p.astype(np.float32) for p in parts]
    of_file = zip(facts["observations"], *columns.values(), strict=True)
    rows = iter([row | dict(zip(columns, values, strict=True)) for row, *values in of_file])
    content = facts | {
        "points": points,
        "sessions": [
            s | {"alignment_cov": arrays[f"session{s['number']}_alignment_cov"]}
            for s in facts["sessions"]
        ],
        "objects": [
            o | {"observations": list(itertools.islice(rows, o["observations"]))}
            for o in facts["objects"]
        ],
    }
    return msgspec.convert(content, RoomMap, dec_hook=_array, str_keys=True)


def _array(_: Any, value: Any) -> Any:
    """Convert a list to an array."""
    return np.array(value) if isinstance(value, list) else value


@contextlib.contextmanager
def map_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a map that is going to be written.

    Raises:
        ReobjError: another run holds it; or the file is no map, then no lock is made.
    """
    if path.is_file():
        _check_kind(path)
    try:
        with locked(path.with_name(f".{path.name}.lock"), named=path):
            yield
    except LockedError:
        what = "another run is updating this map"
        advice = "wait for it, or compare only with --map-frozen"
        raise ReobjError(f"{path}: {what}; {advice}") from None
