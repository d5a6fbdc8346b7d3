"""Entries of objects.json as data: objects, their world, components of the trajectory, video.

Also the files of an output folder: names, the reader of JSON, how new files replace earlier ones.
"""

from __future__ import annotations

import contextlib
import enum
import json
import math
import os
import re
import shutil
import typing
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj import __version__
from reobj.cameras import Poses, load_poses, write_tum
from reobj.files import (
    atomic,
    check_places,
    component_path,
    component_paths,
    cut,
    load_json,
    numbers,
    rounded,
    shortened,
    staged,
)
from reobj.poses.floor import Floor
from reobj.sources.video import Video
from reobj.types import (
    NUMBER_MAX,
    Array,
    Covariance,
    FiniteFloat,
    IntArray,
    LinkEvent,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Quaternion,
    ReobjError,
    Tracks,
    Vector,
    counted,
    printable,
    visible_name,
    without_secrets,
)

T = TypeVar("T")
# first and last frame of each run of frames
Spans = list[Annotated[list[NonNegativeInt], msgspec.Meta(min_length=2, max_length=2)]]

# Names of fields that differ from the keys of objects.json and changes.json, by the key above
_OF_CHANGE = {"class": "class_name", "from": "before", "to": "after", "from_shape": "before_shape"}
_FIELD_NAMES: dict[str, dict[str, str]] = {
    "objects": {"class": "class_name", "tracks": "tracklet_ids", "frames": "visits"},
    "": {"map": "map_path"},
    "changes": {"map": "map_path"},
    **dict.fromkeys(("stayed", "moved", "gone", "new", "not_seen", "ambiguous"), _OF_CHANGE),
}
_KEYS = {name: key for names in _FIELD_NAMES.values() for key, name in names.items()}
SCALE_KEYS = ("metres_per_unit", "rel_sigma", "source")


@dataclass(frozen=True, slots=True, eq=False)
class Object:
    """One physical object; lengths in world units, None where no shape was fitted.

    Attributes:
        id: identity in the tracks, from 1. class_name: with the largest sum of scores.
        score: mean of the boxes.
        status: "ok", "prior_dominated" (some size depends mainly on the category's prior),
            "implausible" (size more than 4 sigma from the usual ones of its category), "doubtful"
            (of low confidence: probably a false positive), "rejected" (no shape), "tracked" (2D: no
            cameras). reason: for the status.
        confidence: probability that it is a real, separate object; None without cameras.
        classes: probabilities of the two most likely. support: "box", "cylinder" or "ellipsoid".
        center, half_axes: (3,) of the ellipsoid; quat_wxyz: (4,) world_from_obj.
        size: (3,) full extents of the shape along its own axes; size_m: the same in metres, None
            where the scale is unknown; size_rel_sigma: (3,) relative standard deviation.
        cov: (9, 9) of center, log half axes, rotation vector in object axes.
        views: frames with a pose in which it was detected; dropped_boxes: outliers among
            them, extrapolated from the fitted frames if the video has more than 600.
        frames_seen: frames in which it was detected.
        parallax_deg: largest angle between two of its viewing rays.
        reprojection_iou_median: IoU of the projected shape with the boxes.
        tracklet_ids: its unbroken tracks.
        visits: first and last frame of each time in view, by time (`visits_of`).
        part: component of the trajectory (`Poses.part`), whose world and units its lengths are in.
        direction: (3,) unit vector in world from the mean of the cameras that saw it to its centre;
            angular_size_deg: of the longer side of its boxes, median. Both only where the grade of
            the component is "directions".
    """

    id: PositiveInt
    class_name: str
    score: FiniteFloat
    status: Annotated[
        str, msgspec.Meta(pattern="^(ok|prior_dominated|implausible|doubtful|rejected|tracked)$")
    ]
    reason: str
    support: str | None = None
    center: Vector | None = None
    half_axes: Vector | None = None
    quat_wxyz: Quaternion | None = None
    size: Vector | None = None
    size_m: Vector | None = None
    size_rel_sigma: Vector | None = None
    cov: Covariance | None = None
    views: NonNegativeInt = 0
    frames_seen: NonNegativeInt = 0
    parallax_deg: FiniteFloat | None = None
    dropped_boxes: NonNegativeInt = 0
    reprojection_iou_median: FiniteFloat | None = None
    tracklet_ids: list[NonNegativeInt] = field(default_factory=list)
    visits: Spans = field(default_factory=list)
    part: NonNegativeInt = 0
    confidence: FiniteFloat | None = None
    classes: dict[str, FiniteFloat] = field(default_factory=dict)
    direction: Vector | None = None
    angular_size_deg: FiniteFloat | None = None

    def __post_init__(self) -> None:
        """Check the shape."""
        check_shape(self.quat_wxyz, self.half_axes, self.size, self.size_m)

    def __repr__(self) -> str:
        """Describe the object in one line."""
        facts = [f"{self.id} {printable(self.class_name)}", self.status]
        size = self.size if self.size_m is None else self.size_m
        if size is not None:
            sides = " x ".join(f"{side:.3g}" for side in size)
            facts.append(f"{sides} {'units' if self.size_m is None else 'm'}")
        facts.append(counted(self.frames_seen, "frame", "frames"))
        return f"Object({', '.join(facts)})"

    @property
    def counted(self) -> bool:
        """True if it is one of the objects found: neither of low confidence nor implausible."""
        return self.status not in ("doubtful", "implausible")

    @property
    def located(self) -> bool:
        """True if a shape was fitted and the object is `counted`."""
        return self.status in ("ok", "prior_dominated")

    def to_json(self) -> dict[str, Any]:
        """Return the entry of objects.json."""
        values = msgspec.to_builtins(self, enc_hook=_plain)
        return {_KEYS.get(k, k): v for k, v in values.items()}


def check_shape(quat_wxyz: Array | None, *sizes: Array | None) -> None:
    """Refuse a quaternion (4,) that is not of length 1, and sizes (3,) that are not positive.

    Raises:
        ReobjError: names the fault.
    """
    # rounded to six digits its length is off by 1e-6
    if quat_wxyz is not None and abs(np.linalg.norm(quat_wxyz) - 1) > 1e-3:
        raise ReobjError("quat_wxyz is not of length 1")
    if any(size is not None and (size <= 0).any() for size in sizes):
        raise ReobjError("a size or half axis is not positive")


def found_text(objects: Iterable[Object], names: bool = False) -> str:
    """Say how many objects found have a shape, and how many have none.

    Without cameras none can have one: then only their number.

    Args:
        names: add the classes, most frequent first.
    """
    found = [o for o in objects if o.counted]
    shaped = [o for o in found if o.located]
    others = [o for o in found if not o.located]
    if all(o.status == "tracked" for o in found):
        return counted(len(others), "object", "objects") + _classes_text(others) * names
    text = counted(len(shaped), "object with a shape", "objects with a shape")
    text += _classes_text(shaped) * names
    rest = f"{len(others)} without{_classes_text(others) * names}"
    return f"{text}{'; ' if names else ', '}{rest}" if others else text


def _classes_text(objects: Sequence[Object]) -> str:
    """Format the number of objects of each class, most frequent first: ": 2 cup, 1 chair"."""
    counts = Counter(o.class_name for o in objects)
    rows = sorted(counts.items(), key=lambda row: (-row[1], row[0]))
    return ": " + ", ".join(f"{count} {name}" for name, count in rows) if rows else ""


VISIT_GAP_S = 2.0  # between two visits of an object; a detector misses objects for shorter times
VISIT_GAP_SHARE = 1 / 3  # of the recording, at most: 2 s are 60 photos without times


def visit_gap(frame: IntArray, fps: float) -> float:
    """Return the longest gap within a visit, in frames of the source.

    VISIT_GAP_S, of a short recording VISIT_GAP_SHARE of its frames, or the usual distance of two
    frames with detections if that is longer.

    Args:
        frame: (N,) of all detections. fps: of the source, Hz.
    """
    frames = np.unique(frame)
    usual = float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0
    most = VISIT_GAP_SHARE * float(np.ptp(frames) + 1) if len(frames) else 1.0
    return max(min(VISIT_GAP_S * fps, most), usual)


def visits_of(frame: IntArray, gap: float) -> list[list[int]]:
    """Join the frames (N,) of an object to visits: times in view with gaps of at most `gap` frames.

    >>> visits_of(np.array([0, 1, 5, 30, 31]), 10.0)
    [[0, 5], [30, 31]]
    """
    frames = np.unique(frame)
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > gap) + 1)
    return [[int(run[0]), int(run[-1])] for run in runs if len(run)]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A connected component of the trajectory, with a world and a scale of its own.

    Attributes:
        spans: first and last frame of each unbroken run of its frames; frames: their number.
        registered_frames, interpolated_frames: frames with an estimated, an interpolated pose.
        up_in_world, up_source, scale, floor, floor_reason: as in `World`.
        grade: of the cameras: "positions", or "directions": only directions of objects are known,
            with direction_sigma_deg; sizes and distances rest on the category.
    """

    spans: Spans
    frames: NonNegativeInt
    registered_frames: NonNegativeInt
    interpolated_frames: NonNegativeInt = 0
    up_in_world: Vector | None = None
    up_source: str = "none"
    scale: quadrics.Scale | None = None
    floor: Floor | None = None
    floor_reason: str = ""
    grade: Annotated[str, msgspec.Meta(pattern="^(positions|directions)$")] = "positions"
    direction_sigma_deg: FiniteFloat = 0.0

    @property
    def span_text(self) -> str:
        """Frames of the component, for messages: "frames 0-99, 130"."""
        return "frames " + shortened([str(a) if a == b else f"{a}-{b}" for a, b in self.spans])


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Units, gravity and scale of the objects' world, and how their tracklets were linked.

    If the trajectory has several components, this is the world of the largest one.

    Attributes:
        units: "m", "arbitrary", or None without cameras. source: of the poses.
        reading: format of supplied poses, and the rule that found their frames.
        registered_frames, interpolated_frames: frames with an estimated, an interpolated pose;
            frames: all frames of all components.
        up_in_world: (3,) unit vector against gravity; up_source: how it was determined.
        scale: metres per unit, its relative sigma and source; None without a fit.
        links: joins and splits of tracklets with their evidence.
        parts: components of the trajectory, the largest first; () without cameras.
        floor: the plane of the floor; None if it was not found, then floor_reason says why.
    """

    units: str | None = None
    source: str = "none"
    registered_frames: NonNegativeInt = 0
    interpolated_frames: NonNegativeInt = 0
    frames: NonNegativeInt = 0
    up_in_world: Vector | None = None
    up_source: str = "none"
    scale: quadrics.Scale | None = None
    links: tuple[LinkEvent, ...] = ()
    parts: tuple[Part, ...] = ()
    floor: Floor | None = None
    floor_reason: str = ""
    reading: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the `world` of objects.json."""
        values: dict[str, Any] = msgspec.to_builtins(self, enc_hook=_plain)
        worlds: list[World | Part] = [self, *self.parts]
        for world, entry in zip(worlds, (values, *values["parts"]), strict=True):
            if world.scale is not None:
                entry["scale"] = dict(zip(SCALE_KEYS, world.scale, strict=True))
        for link in values["links"]:
            for key in ("place_iou", "appearance_log_odds"):
                link[key] = rounded(link[key], 4)  # a box is measured to 1 in 100
        return values


def _plain(value: Any) -> Any:
    """Convert an array to nested lists, a number of a subclass of float to a float."""
    return value.tolist() if isinstance(value, np.ndarray) else float(value)


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """Path of a result's video, without password; native size in pixels; frame rate in Hz."""

    path: str
    width: PositiveInt
    height: PositiveInt
    fps: PositiveFloat

    @staticmethod
    def of(video: Video) -> VideoInfo:
        """Describe an opened video."""
        return VideoInfo(str(video.source), *video.size, video.fps)


# ---- Upright metric frame ----------------------------------------------------------------------

# z up, metres, the origin of the world: robots plan in such a frame (ROS REP 103)


def rotation_to_up(up: Array | None) -> Array:
    """Return the smallest rotation (3, 3) that maps `up` (3,) to z; identity for None."""
    z = np.array([0.0, 0, 1])
    return np.asarray(Rotation.align_vectors([z], [z if up is None else up])[0].as_matrix())


def upright_pose(found: Object, world: World | Part) -> dict[str, Any]:
    """Return the position and heading of an object in the upright metric frame of its world.

    Args:
        world: of the object's component.
    Returns:
        "center_m": [x, y, z] in metres, z up, None where scale or up is unknown. "yaw_deg": angle
        of the object's x axis about z from the frame's x axis, in (-180, 180], None where up is
        unknown. Both are None without a shape.
    """
    entry: dict[str, Any] = {"center_m": None, "yaw_deg": None}
    up = world.up_in_world
    scale = world.scale
    if found.center is None or found.quat_wxyz is None or up is None:
        return entry
    rotation = rotation_to_up(up)
    turn = Rotation.from_quat(found.quat_wxyz[[1, 2, 3, 0]])
    x, y, _ = rotation @ turn.as_matrix()[:, 0]
    entry["yaw_deg"] = rounded(math.degrees(math.atan2(y, x)), 2)
    if scale is not None and scale.source != "none":
        center = scale.value * rotation @ found.center
        extent = 1.0 if found.half_axes is None else scale.value * float(found.half_axes.max())
        entry["center_m"] = numbers(center, extent)
    return entry


def component_of(found: Object, world: World) -> World | Part:
    """Return the world of the component that an object lies in."""
    return world.parts[found.part] if len(world.parts) > 1 else world


# ---- Files of an output folder -----------------------------------------------------------------


class OutputFile(enum.StrEnum):
    """Paths in an output folder of what is read back or removed."""

    TRACKS = "tracks.txt"
    OBJECTS = "objects.json"
    POSES = "poses.txt"
    MESH = "objects.ply"
    CHANGES = "changes.json"
    EDITS = "edits.json"
    CONFIG = "config.toml"  # options of the last run
    MODEL = "sparse"  # folder of a COLMAP model
    EARLIER = "cache/earlier.json"  # other recordings of the map
    LAST_POSES = "cache/last-poses.npz"
    LAST_TRACKS = "cache/last-tracks.npz"  # before linking
    LAST_LINKS = "cache/last-links.npz"  # identities of the result, for refits


GENERIC = frozenset({"color", "frames", "image", "images", "img", "rgb"})  # folders of recordings


def recording_name(source: str) -> str:
    """Return the name of a recording for titles: of its file or folder.

    For a folder with a generic name, that of its parent; for a glob, that of its folder.

    >>> recording_name("data/kitchen/images")
    'kitchen'
    >>> recording_name("data/kitchen/rgb/*.png")
    'kitchen'
    """
    source = without_secrets(source)
    path = Path(source) if "://" in source else Path(os.path.abspath(source))
    is_glob = not os.path.exists(path)
    names = [name for name in path.parts if not (is_glob and set(name) & set("*?["))]
    specific = [name for name in names if name.lower() not in GENERIC]
    if names and names[-1].lower() in GENERIC and specific:
        return specific[-1]
    return names[-1] if names else source


def read_json(
    kind: type[T], path: Path, header: dict[str, Any] | None = None, own: bool = False
) -> T:
    """Read a JSON file of ours.

    Args:
        kind: type of the content, as in `decode`. header: keys with their values: format, version.
        own: a file of an output folder, which only the tool writes.
    Raises:
        ReobjError: damaged, another kind of file, or of another version.
    """
    try:
        data = load_json(path)
        if header and not (isinstance(data, dict) and header.items() <= data.items()):
            raise ReobjError(f"expected {json.dumps(header)}")
        content: T = decode(kind, data)
    except ReobjError as error:
        fault = f"{path}: {str(error).removeprefix(f'{path}: ')}"
        raise ReobjError(f"{fault}; {RUN_AGAIN}" if own else fault) from error
    return content


def write_json(path: Path, data: Any, indent: int | None = 1) -> None:
    """Write a JSON file of ours; it appears only when it is complete."""
    with atomic(path) as part:
        part.write_text(json.dumps(data, indent=indent) + "\n", encoding="utf-8")


RUN_AGAIN = f"damaged, or not written by reobj_track {__version__}: run the video again"


def decode(kind: Any, value: Any) -> Any:
    """Convert a JSON value to a type made of our dataclasses.

    Missing fields get their default; unknown keys are ignored.

    Raises:
        ReobjError: the value has another type or shape, or a number is out of range.
    """
    try:
        return msgspec.convert(_with_field_names(value), kind, dec_hook=_array, str_keys=True)
    except (msgspec.ValidationError, UnicodeError, RecursionError) as error:
        text = re.sub(r"[.`]\w+", lambda m: m[0][0] + _KEYS.get(m[0][1:], m[0][1:]), str(error))
        fault, _, path = text.replace("`", "").rpartition(" - at ")
        raise ReobjError(f"{path}: {fault}" if fault else f"$: {path}") from error


def _with_field_names(value: Any, key: str = "") -> Any:
    """Return the JSON value of a key with the names of our fields as keys of objects."""
    if isinstance(value, list):
        return [_with_field_names(item, key) for item in value]
    if key == "class_name" and isinstance(value, str):
        return visible_name(value)
    if not isinstance(value, dict):
        return value
    if key == "scale":
        return [value.get(name) for name in SCALE_KEYS]
    names = _FIELD_NAMES.get(key, {})
    renamed = {str(names.get(k, k)): item for k, item in value.items()}
    return {name: _with_field_names(item, name) for name, item in renamed.items()}


def _array(kind: Any, value: Any) -> Array:
    """Convert nested lists of finite numbers to an array type, which has the shape."""
    if isinstance(value, np.ndarray):  # of a map
        return value
    shape = tuple(typing.get_args(size)[0] for size in typing.get_args(typing.get_args(kind)[0]))
    with contextlib.suppress(ValueError):  # lists of different lengths
        array = np.array(value)
        most = NUMBER_MAX if len(shape) == 1 else np.finfo(float).max
        if array.shape == shape and array.dtype.kind in "iuf" and (np.abs(array) <= most).all():
            return array.astype(np.float64)
    raise ValueError(f"Expected {' x '.join(map(str, shape))} finite numbers")


# ---- How new files replace earlier ones ---------------------------------------------------------

HEADER = {"format": "reobj-objects", "version": 1}  # of objects.json
STALE = (  # files that not every run writes
    OutputFile.POSES, OutputFile.MESH, OutputFile.LAST_POSES, OutputFile.CHANGES,
    OutputFile.EARLIER, OutputFile.LAST_LINKS,
    "overlay.mp4", "scene.html",
)  # fmt: skip


def check_results(out: Path) -> None:
    """Check that results can be written into an output folder, before they are computed."""
    others = (OutputFile.TRACKS, OutputFile.OBJECTS, OutputFile.EDITS, OutputFile.CONFIG)
    check_places(out, (*STALE, *others, f"{OutputFile.MODEL}/cameras.txt"))


@contextlib.contextmanager
def replaced(out: Path, stale: Sequence[str] = STALE) -> Iterator[Path]:
    """Yield an empty folder whose files replace those of `out` at the end of the block.

    An exception in the block leaves `out` unchanged.

    Args:
        stale: files that are removed from `out` if the block does not write them.
    """
    with staged(out) as new:
        yield new
        made = {path.relative_to(new) for path in new.rglob("*")}
    remove_stale(out, stale, made)


def remove_stale(
    out: Path, stale: Sequence[str] = STALE, made: Iterable[Path] = frozenset()
) -> None:
    """Remove files of an earlier run, also those of further components.

    Args:
        made: paths that are kept, relative to `out`; of a folder only the listed files.
    """
    kept = {out / path for path in made}
    for name in stale:
        for found in (out / name, *component_paths(out / name)):
            found.with_name(f".part-{found.name}").unlink(missing_ok=True)  # of a killed run
            if name == OutputFile.MODEL and found.is_dir() and not found.is_symlink():
                for old in set(found.iterdir()) - kept:
                    shutil.rmtree(old) if old.is_dir() else old.unlink()
                if found not in kept:
                    found.rmdir()
            elif found not in kept:
                found.unlink(missing_ok=True)


def copy_models(models: Sequence[Path], folder: Path) -> None:
    """Copy the existing COLMAP models, one a component, to sparse/, sparse_part1/, ..."""
    for k, model in enumerate(models):
        if model.is_dir():
            shutil.copytree(model, component_path(folder / OutputFile.MODEL, k))


def write_trajectories(out: Path, poses: Poses) -> None:
    """Write poses.txt, and poses_part1.txt, ... of further components: a TUM file has one world."""
    if not poses.known.any():
        return
    for old in component_paths(out / OutputFile.POSES):
        old.unlink()
    for k in range(poses.part_count):
        write_tum(component_path(out / OutputFile.POSES, k), poses.of_part(k))


def write_mot(path: Path, tracks: Tracks) -> None:
    """Write MOTChallenge results: frame (from 1), id, left, top, width, height, score, 3 x -1."""
    ltwh = np.column_stack([tracks.xyxy[:, :2], tracks.xyxy[:, 2:] - tracks.xyxy[:, :2]])
    rows = np.column_stack([tracks.frame + 1, tracks.track_id, ltwh, tracks.score])  # (N, 7)
    with atomic(path) as part:
        np.savetxt(part, rows, ("%d", "%d", *["%.2f"] * 4, "%.4f,-1,-1,-1"), ",")


def load_last_poses(out: Path) -> Poses | None:
    """Read the latest poses of an output folder, None if it has none."""
    path = out / OutputFile.LAST_POSES
    if not path.is_file():
        return None
    try:
        return load_poses(path)
    except (KeyError, TypeError, ReobjError) as error:
        raise ReobjError(f"{path}: {RUN_AGAIN}") from error


def validate_objects(path: Path) -> list[str]:
    """Check an objects.json, or that of a folder, against its JSON schema.

    Returns:
        one line for each error: file, JSON path, and what was expected.
    """
    try:
        from jsonschema import Draft202012Validator, validators
    except ImportError as error:
        advice = "jsonschema is not installed: pip install jsonschema"
        raise ReobjError(advice) from error
    path = path / OutputFile.OBJECTS if path.is_dir() else path
    schema = load_json(Path(__file__).with_name("objects.schema.json"))
    types = Draft202012Validator.TYPE_CHECKER.redefine("number", _is_finite)
    validator = validators.extend(Draft202012Validator, type_checker=types)(schema)
    lines = []
    for found in validator.iter_errors(load_json(path)):
        fault = cut(f"{found.json_path}: {found.message}", 200)  # it quotes the value
        lines.append(printable(f"{path}: {fault}"))
    return sorted(lines)


def _is_finite(_: Any, value: Any) -> bool:
    """Check for a number; NaN, which Python's parser accepts, is none in JSON."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
