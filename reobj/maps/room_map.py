"""The map file: sessions, objects with one observation per session, points with descriptors.

A map is an npz file with JSON in it, written atomically, with a digest and a version. It holds no
pictures. What is known of an object now is computed from its observations (`reobj.maps.fusion`),
so that a session can be forgotten or replaced.
"""

from __future__ import annotations

import contextlib
import dataclasses
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj import __version__
from reobj.cameras import Camera
from reobj.files import LockedError, load_npz, locked, save_npz
from reobj.types import Array, Floats, IntArray, ReobjError

HEADER = {"format": "reobj-map", "version": 1}


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What a session says about an object, in the world of the map.

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
    """

    session: int
    status: str
    support: str = ""
    center: Array = field(default_factory=lambda: np.full(3, np.nan))
    half_axes: Array = field(default_factory=lambda: np.full(3, np.nan))
    quat_wxyz: Array = field(default_factory=lambda: np.full(4, np.nan))
    cov: Array = field(default_factory=lambda: np.full((9, 9), np.nan))
    classes: dict[str, float] = field(default_factory=dict)
    foreground: Floats = field(default_factory=lambda: np.empty(0, np.float32))
    background: Floats = field(default_factory=lambda: np.empty(0, np.float32))
    embedded: int = 0
    views: int = 0
    expected: int = 0
    missed: int = 0
    log_odds: float = 0.0

    ARRAYS = ("center", "half_axes", "quat_wxyz", "cov")
    EMBEDDINGS = ("foreground", "background")

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

    id: int
    observations: tuple[Observation, ...]
    name: str = ""
    deleted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A recording that the map was made or updated with.

    Attributes:
        number: from 1, never used again. name: of the recording. date: ISO 8601, UTC.
        fingerprint: of the video's content. embedder: key of the embedding model.
        camera: intrinsics. cam_from_map: (K, 3, 4) of frames that see the room, spread over it.
        metres_per_unit, scale_rel_sigma, scale_source: the scale of the map's world as this
            session measured it; source "none": it did not.
        alignment_cov: (7, 7) of the rotation vector (rad, world axes), translation (map units) and
            log scale that placed the session in the map; zeros for the first session.
        localised_frames, tried_frames: that agreed with the map, that were compared.
    """

    number: int
    name: str
    date: str
    fingerprint: str
    embedder: str
    camera: Camera
    cam_from_map: Array
    metres_per_unit: float = 1.0
    scale_rel_sigma: float = 0.0
    scale_source: str = "none"
    alignment_cov: Array = field(default_factory=lambda: np.zeros((7, 7)))
    localised_frames: int = 0
    tried_frames: int = 0

    ARRAYS = ("cam_from_map", "alignment_cov")


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
    up: Array | None = None
    next_id: int = 1
    next_session: int = 1
    merged: dict[int, int] = field(default_factory=dict)

    def session(self, number: int) -> Session:
        """Return a session by number."""
        return next(s for s in self.sessions if s.number == number)

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
        """Write the file, atomically."""
        save_map(Path(path), self)

    @staticmethod
    def load(path: str | Path) -> RoomMap:
        """Read a file that `save` wrote.

        Raises:
            ReobjError: missing, damaged, another kind of file, or of a newer version.
        """
        return load_map(Path(path))


# ---- File --------------------------------------------------------------------------------------


def save_map(path: Path, room: RoomMap) -> None:
    """Write a map as npz, atomically; for the content see `RoomMap`."""
    arrays: dict[str, Any] = {}
    for f in dataclasses.fields(MapPoints):
        values = getattr(room.points, f.name)
        small = {"viewing_ray": np.float16, "distance": np.float32, "xyz": np.float32}
        arrays[f"points_{f.name}"] = values.astype(small.get(f.name, values.dtype))
    observations = [o for found in room.objects for o in found.observations]
    for name in Observation.ARRAYS:
        shape = np.shape(getattr(Observation(0, ""), name))
        values = np.array([getattr(o, name) for o in observations]).reshape(-1, *shape)
        arrays[f"observation_{name}"] = values.astype(np.float32 if name == "cov" else np.float64)
    for name in Observation.EMBEDDINGS:
        rows = [np.asarray(getattr(o, name), np.float16) for o in observations]
        arrays[f"observation_{name}"] = np.concatenate([np.empty(0, np.float16), *rows])
        arrays[f"observation_{name}_length"] = np.array([len(r) for r in rows], np.int64)
    for session in room.sessions:
        for name in Session.ARRAYS:
            arrays[f"session{session.number}_{name}"] = getattr(session, name)
    facts = {
        **HEADER,
        "reobj_track": __version__,
        "map_id": room.map_id,
        "metric": room.metric,
        "up": None if room.up is None else room.up.tolist(),
        "next_id": room.next_id,
        "next_session": room.next_session,
        "merged": {str(old): kept for old, kept in room.merged.items()},
        "sessions": [_without_arrays(s, Session.ARRAYS) for s in room.sessions],
        "objects": [
            {
                "id": found.id, "name": found.name, "deleted": found.deleted,
                "observations": [
                    _without_arrays(o, (*Observation.ARRAYS, *Observation.EMBEDDINGS))
                    for o in found.observations
                ],
            }
            for found in room.objects
        ],
    }  # fmt: skip
    save_npz(path, arrays, **facts)


def _without_arrays(record: Any, arrays: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a dataclass that are not stored as arrays."""
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    kept = {k: v for k, v in values.items() if k not in arrays}
    return {k: dataclasses.asdict(v) if isinstance(v, Camera) else v for k, v in kept.items()}


def load_map(path: Path) -> RoomMap:
    """Read a map; for the errors see `RoomMap.load`."""
    if not path.is_file():
        raise ReobjError(f"{path}: no such map; `run VIDEO -o OUT --map {path}` makes it")
    arrays, facts = load_npz(path)
    if facts.get("format") != HEADER["format"]:
        raise ReobjError(f"{path}: not a map of reobj_track; another file was given")
    if facts.get("version") != HEADER["version"]:
        raise ReobjError(
            f"{path}: a map of format {facts.get('version')}, this version reads "
            f"{HEADER['version']}; it was written by reobj_track {facts.get('reobj_track')}: "
            "update the tool"
        )
    arrays, facts = load_npz(path, sealed=True)
    try:
        return _decoded(arrays, facts)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ReobjError(f"{path}: damaged ({error}); use a copy of it") from error


def _decoded(arrays: dict[str, Any], facts: dict[str, Any]) -> RoomMap:
    """Build a map from the content of its file."""
    columns = {f.name: arrays[f"points_{f.name}"] for f in dataclasses.fields(MapPoints)}
    for name in ("xyz", "viewing_ray", "distance"):
        columns[name] = columns[name].astype(np.float64)
    sessions = tuple(
        Session(
            **entry
            | {"camera": _camera(entry["camera"])}
            | {name: arrays[f"session{entry['number']}_{name}"] for name in Session.ARRAYS}
        )
        for entry in facts["sessions"]
    )
    ends = {
        name: np.cumsum(arrays[f"observation_{name}_length"]) for name in Observation.EMBEDDINGS
    }
    objects = []
    row = 0
    for entry in facts["objects"]:
        observations = []
        for fields in entry["observations"]:
            values = {n: arrays[f"observation_{n}"][row].astype(np.float64)
                      for n in Observation.ARRAYS}  # fmt: skip
            for name, end in ends.items():
                start = end[row] - arrays[f"observation_{name}_length"][row]
                values[name] = arrays[f"observation_{name}"][start : end[row]].astype(np.float32)
            observations.append(Observation(**fields, **values))
            row += 1
        objects.append(MapObject(entry["id"], tuple(observations), entry["name"], entry["deleted"]))
    return RoomMap(
        map_id=facts["map_id"],
        sessions=sessions,
        objects=tuple(objects),
        points=MapPoints(**columns),
        metric=facts["metric"],
        up=None if facts["up"] is None else np.array(facts["up"], np.float64),
        next_id=facts["next_id"],
        next_session=facts["next_session"],
        merged={int(old): kept for old, kept in facts["merged"].items()},
    )


def _camera(entry: dict[str, Any]) -> Camera:
    """Read a camera."""
    return Camera(entry["model"], entry["width"], entry["height"], tuple(entry["params"]))


@contextlib.contextmanager
def map_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a map that is going to be written.

    Raises:
        ReobjError: another run holds it.
    """
    try:
        with locked(path.with_name(f".{path.name}.lock")):
            yield
    except LockedError:
        what = "another run is updating this map"
        advice = "wait for it, or compare only with --map-frozen"
        raise ReobjError(f"{path}: {what}; {advice}") from None
