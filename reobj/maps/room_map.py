"""The map file: sessions, objects with one observation per session, points with descriptors.

A map is an npz file with JSON in it, written atomically, with a digest and a version. It holds no
pictures unless they were asked for. What is known of an object now is computed from its
observations (`reobj.maps.fusion`), so that a session can be forgotten or replaced.
"""

from __future__ import annotations

import contextlib
import dataclasses
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
from reobj.cameras import Camera
from reobj.files import LockedError, columns_of, load_npz, locked, save_npz
from reobj.results.entries import decode
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

HEADER = {"format": "reobj-map", "version": 1}
# Dtypes in the file, and shapes of a row. float16 of a direction: 3e-4 rad; of a covariance it
# would lose sigmas below 2e-4 and, by rounded correlations, the small variances.
POINTS: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
    "xyz": (np.dtype(np.float32), (3,)),
    "descriptor": (np.dtype(np.uint8), (128,)),
    "session": (np.dtype(np.int32), ()),
    "object_id": (np.dtype(np.int32), ()),
    "viewing_ray": (np.dtype(np.float16), (3,)),
    "distance": (np.dtype(np.float32), ()),
}
OBSERVATIONS: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
    "center": (np.dtype(np.float64), (3,)),
    "half_axes": (np.dtype(np.float32), (3,)),
    "quat_wxyz": (np.dtype(np.float32), (4,)),
    "cov": (np.dtype(np.float32), (9, 9)),
}
CONCATENATED: dict[str, np.dtype[Any]] = {
    "foreground": np.dtype(np.float16), "background": np.dtype(np.float16),
    "picture": np.dtype(np.uint8),
}  # fmt: skip
LOWER = np.tril_indices(9)  # entries of a covariance in the file
UNIT = 1.001  # largest component of a unit vector, rounded to float16
JPEG_START = b"\xff\xd8\xff"
PICTURE_MAX = 1 << 16  # bytes; a JPEG of 160 px has 13 kB even if it is noise
Number = Annotated[int, msgspec.Meta(ge=1, lt=2**31)]  # of an object or a session


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
        picture: JPEG; empty unless pictures were asked for.
    """

    session: Number
    status: Annotated[str, msgspec.Meta(pattern="^(new|stayed|moved|gone|not_seen)$")]
    support: str = ""
    center: Array = field(default_factory=lambda: np.full(3, np.nan))
    half_axes: Array = field(default_factory=lambda: np.full(3, np.nan))
    quat_wxyz: Array = field(default_factory=lambda: np.full(4, np.nan))
    cov: Array = field(default_factory=lambda: np.full((9, 9), np.nan))
    classes: dict[str, NonNegativeFloat] = field(default_factory=dict)
    foreground: Floats = field(default_factory=lambda: np.empty(0, np.float32))
    background: Floats = field(default_factory=lambda: np.empty(0, np.float32))
    embedded: Int32 = 0
    views: Int32 = 0
    expected: Int32 = 0
    missed: Int32 = 0
    log_odds: FiniteFloat = 0.0
    picture: bytes = b""

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
        camera: intrinsics. cam_from_map: (K, 3, 4) of frames that see the room, spread over it.
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
    camera: Camera
    cam_from_map: Array
    metres_per_unit: PositiveFloat = 1.0
    scale_rel_sigma: NonNegativeFloat = 0.0
    scale_source: Annotated[str, msgspec.Meta(pattern="^(poses|priors|known_size|none)$")] = "none"
    alignment_cov: Array = field(default_factory=lambda: np.zeros((7, 7)))
    localised_frames: Int32 = 0
    tried_frames: Int32 = 0

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
    up: Vector | None = None
    next_id: Number = 1
    next_session: Number = 1
    merged: dict[Number, Number] = field(default_factory=dict)

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


# ---- Checks ------------------------------------------------------------------------------------


def check_map(room: RoomMap) -> None:
    """Refuse a map whose content is inconsistent or not finite; `_decoded` checks types.

    Raises:
        ValueError: names the fault.
    """
    _expect(room.up is None or _unit(room.up), f"up {room.up}")
    for session in room.sessions:
        _check_session(session, room.next_session)
    numbers = [session.number for session in room.sessions]
    _expect(len(set(numbers)) == len(numbers), f"two sessions of one number: {numbers}")
    for found in room.objects:
        _check_object(found, set(numbers), room.next_id)
    ids = [found.id for found in room.objects]
    _expect(len(set(ids)) == len(ids), "two objects of one number")
    for old, kept in room.merged.items():
        known = old < room.next_id and old not in ids and kept in ids
        _expect(known, f"object {old} merged into {kept}")
    _check_points(room.points, numbers, ids)


def _expect(valid: bool, fault: str) -> None:
    if not valid:
        raise ValueError(fault)


def _unit(vector: Array) -> bool:
    """Test for a vector of length 1, up to the rounding of float32."""
    return bool(abs(np.linalg.norm(vector) - 1) < 1e-5)


def _bounded(values: npt.NDArray[Any], most: float = 1e30) -> bool:
    """Test for finite numbers of at most `most`; default: float32 holds them."""
    return bool((np.abs(values) <= most).all())  # False for NaN


def _is_cov(cov: Array, size: int) -> bool:
    """Test for a finite square matrix whose diagonal is not negative."""
    right = np.shape(cov) == (size, size) and _bounded(cov)
    return right and bool((np.diag(cov) >= 0).all())


def _check_session(session: Session, next_session: int) -> None:
    """Refuse an invalid session."""
    where = f"session {session.number}: "
    _expect(session.number < next_session, f"{where}next is {next_session}")
    camera = session.camera
    right = min(camera.width, camera.height) > 0 and _bounded(np.array(camera.params))
    _expect(right, f"{where}camera {camera}")
    cameras = session.cam_from_map
    right = cameras.ndim == 3 and cameras.shape[1:] == (3, 4) and _bounded(cameras)
    _expect(right, f"{where}cam_from_map {cameras.shape}")
    _expect(_is_cov(session.alignment_cov, 7), f"{where}alignment_cov")


def _check_object(found: MapObject, sessions: set[int], next_id: int) -> None:
    """Refuse an invalid object."""
    where = f"object {found.id}: "
    _expect(found.id < next_id, f"{where}next_id is {next_id}")
    _expect(found.name.isprintable(), f"{where}name")
    _expect(any(o.detected for o in found.observations), f"{where}never detected")
    seen = [o.session for o in found.observations]
    _expect(len(set(seen)) == len(seen), f"{where}two observations in a session")
    for o in found.observations:
        _expect(o.session in sessions, f"{where}no session {o.session}")
        _check_observation(o, f"{where}session {o.session}: ")


def _check_observation(o: Observation, where: str) -> None:
    """Refuse an invalid observation."""
    kinds = quadrics.SUPPORTS if o.status in ("new", "stayed", "moved") else ("",)
    _expect(o.support in kinds, f"{where}{o.status}, shape {o.support!r}")
    if o.detected:
        _expect(_bounded(o.center), f"{where}center")
        _expect(_bounded(o.half_axes) and bool((o.half_axes > 0).all()), f"{where}half_axes")
        _expect(_unit(o.quat_wxyz), f"{where}quat_wxyz")
        _expect(_is_cov(o.cov, 9), f"{where}cov")
    _expect("".join(o.classes).isprintable(), f"{where}classes")
    _expect(o.missed <= o.expected, f"{where}missed {o.missed} of {o.expected}")
    jpeg = o.picture.startswith(JPEG_START) and len(o.picture) <= PICTURE_MAX
    _expect(not o.picture or (o.detected and jpeg), f"{where}picture")
    for name in Observation.EMBEDDINGS:
        _expect(_bounded(getattr(o, name), UNIT), f"{where}{name}")


def _check_points(points: MapPoints, sessions: Sequence[int], ids: Sequence[int]) -> None:
    """Refuse invalid points."""
    for name, (kind, _) in POINTS.items():
        values = getattr(points, name)
        _expect(len(values) == len(points), f"points: {name} is an array {values.shape}")
        most = UNIT if name == "viewing_ray" else 1e30
        _expect(kind.kind != "f" or _bounded(values, most), f"points: {name} out of range")
    _expect(bool(np.isin(points.session, sessions).all()), "points of unknown sessions")
    _expect(bool(np.isin(points.object_id, [0, *ids]).all()), "points of unknown objects")


# ---- File --------------------------------------------------------------------------------------


def save_map(path: Path, room: RoomMap) -> None:
    """Write a map as npz, atomically; for the content see `RoomMap`. Same map, same bytes.

    Raises:
        ValueError: the file could not be read again.
    """
    origin = _origin(room.points.xyz)
    columns = columns_of(room.points)
    columns["xyz"] = columns["xyz"] - origin
    arrays: dict[str, Any] = {"points_origin": origin}
    arrays |= {f"points_{name}": columns[name].astype(POINTS[name][0]) for name in POINTS}
    objects = sorted(room.objects, key=lambda found: found.id)
    rows = [o for found in objects for o in sorted(found.observations, key=lambda o: o.session)]
    for name, (kind, shape) in OBSERVATIONS.items():
        values = np.array([getattr(o, name) for o in rows], np.float64).reshape(-1, *shape)
        values = values[:, LOWER[0], LOWER[1]] if name == "cov" else values
        arrays[f"observation_{name}"] = values.astype(kind)
    for name, kind in CONCATENATED.items():
        parts = [np.array(list(getattr(o, name)), kind) for o in rows]
        if name in Observation.EMBEDDINGS or any(map(len, parts)):
            arrays[f"observation_{name}"] = np.concatenate([np.empty(0, kind), *parts])
            arrays[f"observation_{name}_length"] = np.array([*map(len, parts)], np.int32)
    sessions = sorted(room.sessions, key=lambda session: session.number)
    for session in sessions:
        for name in Session.ARRAYS:
            arrays[f"session{session.number}_{name}"] = np.asarray(
                getattr(session, name), np.float64
            )
    facts = {
        **HEADER,
        "reobj_track": __version__,
        "map_id": room.map_id,
        "metric": room.metric,
        "up": None if room.up is None else room.up.tolist(),
        "next_id": room.next_id,
        "next_session": room.next_session,
        "merged": {str(old): room.merged[old] for old in sorted(room.merged)},
        "sessions": [_without_arrays(s, Session.ARRAYS) for s in sessions],
        "objects": [
            {
                "id": found.id, "name": found.name, "deleted": found.deleted,
                "observations": len(found.observations),
            }
            for found in objects
        ],
        "observations": [
            _without_arrays(o, (*Observation.ARRAYS, *Observation.EMBEDDINGS, "picture"))
            for o in rows
        ],
    }  # fmt: skip
    check_map(_decoded(arrays, facts))
    save_npz(path, arrays, **facts)


def _origin(xyz: Array) -> Array:
    """Return the point (3,) to which the stored points are relative: a multiple of 1024.

    In float32 coordinates of a map projection have a resolution of .5 m. The origin of a room near
    that of its world is 0.
    """
    middle = np.median(xyz, 0) if len(xyz) else np.zeros(3)
    return np.asarray(np.round(middle / 1024) * 1024 + 0.0)  # + 0: no -0


def _without_arrays(record: Any, arrays: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a dataclass that are not stored as arrays."""
    kept = {k: v for k, v in columns_of(record).items() if k not in arrays}
    if "classes" in kept:
        kept["classes"] = dict(sorted(kept["classes"].items()))
    return {k: dataclasses.asdict(v) if isinstance(v, Camera) else v for k, v in kept.items()}


ANOTHER_FILE = "not a map of reobj_track; another file was given"


def load_map(path: Path) -> RoomMap:
    """Read a map; for the errors see `RoomMap.load`."""
    if path.is_dir():
        raise ReobjError(f"{path}: is a folder, but a map is a file")
    if not path.is_file():
        raise ReobjError(f"{path}: no such map; `run VIDEO -o OUT --map {path}` makes it")
    _check_kind(path)
    try:
        arrays, facts = load_npz(path, sealed=True)
    except ReobjError:
        _, facts = load_npz(path)
        _check_header(path, facts)
        raise
    _check_header(path, facts)
    try:
        room = _decoded(arrays, facts)
        check_map(room)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        missing = "no " if isinstance(error, KeyError) else ""
        fault = one_line(f"{missing}{error}")
        raise ReobjError(f"{path}: damaged ({fault}); use a copy of it") from error
    return room


def _check_kind(path: Path) -> None:
    """Refuse what is no zip file by its first bytes; npz files are."""
    with path.open("rb") as file:
        if file.read(2) != b"PK":
            raise ReobjError(f"{path}: {ANOTHER_FILE}")


def _check_header(path: Path, facts: dict[str, Any]) -> None:
    """Refuse other files and other versions."""
    if facts.get("format") != HEADER["format"]:
        raise ReobjError(f"{path}: {ANOTHER_FILE}")
    if facts.get("version") != HEADER["version"]:
        raise ReobjError(
            f"{path}: a map of format {facts.get('version')}, this version reads "
            f"{HEADER['version']}; it was written by reobj_track {facts.get('reobj_track')}: "
            "update the tool"
        )


def _decoded(arrays: dict[str, Any], facts: dict[str, Any]) -> RoomMap:
    """Build a map from the content of its file."""
    columns = {}
    for name, (stored, shape) in POINTS.items():
        kind = {"f": np.float64, "i": np.int64, "u": np.uint8}[stored.kind]
        columns[name] = _column(arrays, f"points_{name}", stored, shape).astype(kind)
    columns["xyz"] += _column(arrays, "points_origin", np.dtype(np.float64), ())
    sessions = [
        _known(Session, entry)
        | {name: arrays[f"session{entry['number']}_{name}"] for name in Session.ARRAYS}
        for entry in facts["sessions"]
    ]
    objects = _decoded_objects(facts["objects"], _decoded_observations(arrays, facts))
    content = facts | {"sessions": sessions, "objects": objects, "points": columns}
    room: RoomMap = decode(RoomMap, content)
    return room


def _known(kind: type, entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry that has no other keys than the fields of a dataclass."""
    unknown = set(entry) - {f.name for f in dataclasses.fields(kind)}
    _expect(not unknown, f"unknown field {sorted(unknown)}")
    return entry


def _column(
    arrays: dict[str, Any], name: str, kind: np.dtype[Any], shape: tuple[int, ...]
) -> npt.NDArray[Any]:
    """Return an array of the file (N, *shape), of the dtype it is written with."""
    values = arrays[name]
    if values.dtype != kind or values.shape[1:] != shape or values.ndim != 1 + len(shape):
        raise ValueError(f"{name} is an array {values.shape} of {values.dtype}")
    return np.asarray(values)


def _split_column(arrays: dict[str, Any], name: str) -> list[npt.NDArray[Any]]:
    """Return a value (n,) of each observation; in the file they are concatenated."""
    column = _column(arrays, f"observation_{name}", CONCATENATED[name], ())
    length = _column(arrays, f"observation_{name}_length", np.dtype(np.int32), ())
    right = not (length < 0).any() and length.sum() == len(column)
    _expect(right, f"{len(column)} values of {name}, {length.sum()} expected")
    return np.split(column, np.cumsum(length))[:-1]


def _decoded_observations(arrays: dict[str, Any], facts: dict[str, Any]) -> list[dict[str, Any]]:
    """Build the observations of all objects, in the order of the file."""
    values: dict[str, Any] = {}
    for name, (kind, shape) in OBSERVATIONS.items():
        stored = (len(LOWER[0]),) if name == "cov" else shape
        values[name] = _column(arrays, f"observation_{name}", kind, stored).astype(np.float64)
    cov = np.empty((len(values["cov"]), 9, 9))
    cov[:, LOWER[0], LOWER[1]] = values["cov"]
    cov[:, LOWER[1], LOWER[0]] = values["cov"]
    values["cov"] = cov
    for name in Observation.EMBEDDINGS:
        values[name] = [mean.astype(np.float32) for mean in _split_column(arrays, name)]
    if "observation_picture" in arrays:
        values["picture"] = [picture.tobytes() for picture in _split_column(arrays, "picture")]
    count = len(facts["observations"])
    right = all(len(column) == count for column in values.values())
    _expect(right, f"arrays of other lengths than {count} observations")
    rows = (dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True))
    return [_known(Observation, f) | r for f, r in zip(facts["observations"], rows, strict=True)]


def _decoded_objects(
    entries: list[dict[str, Any]], observations: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Distribute the observations to the objects."""
    ends = np.cumsum([entry["observations"] for entry in entries]).tolist()
    count = ends[-1] if ends else 0
    _expect(count == len(observations), f"{len(observations)} observations, {count} expected")
    return [
        _known(MapObject, entry)
        | {"observations": tuple(observations[end - entry["observations"] : end])}
        for entry, end in zip(entries, ends, strict=True)
    ]


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
