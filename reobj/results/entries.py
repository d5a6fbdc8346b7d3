"""Entries of objects.json as data: objects, their world, components of the trajectory, video."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import quadrics
from reobj.files import rounded, shortened
from reobj.poses.floor import Floor
from reobj.sources.video import Video
from reobj.types import (
    Array,
    IntArray,
    LinkEvent,
    ReobjError,
    counted,
    printable,
    visible_name,
)

# keys of objects.json and changes.json that differ from the names of our fields
_JSON_KEYS = {
    "class_name": "class", "tracklet_ids": "tracks", "visits": "frames",
    "map_path": "map", "before": "from", "after": "to", "before_shape": "from_shape",
}  # fmt: skip


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

    def __post_init__(self) -> None:
        """Remove a covariance that no 32-bit number can hold, as earlier versions wrote them."""
        if self.cov is not None and not np.abs(self.cov).max() <= NUMBER_MAX**2:
            object.__setattr__(self, "cov", None)

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
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {_JSON_KEYS.get(k, k): _plain(v) for k, v in values.items()}


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
VISIT_GAP_SHARE = 1 / 3  # of the recording, at most: 2 s are 60 photos without times (chosen)


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
            for key in ("place_iou", "appearance_log_odds"):
                link[key] = rounded(link[key], 4)  # a box is measured to 1 in 100
        return values | {"links": links}

    @staticmethod
    def from_json(entry: dict[str, Any]) -> World:
        """Read the `world` of objects.json."""
        world: World = decode(World, entry, "$.world")
        return world


def _world_json(world: World | Part) -> dict[str, Any]:
    """Convert the fields of a world for JSON, except its links and components."""
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


def _plain(value: Any) -> Any:
    """Convert an array to nested lists; return any other value unchanged."""
    return value.tolist() if isinstance(value, np.ndarray) else value


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


# ---- From JSON ---------------------------------------------------------------------------------

# fields whose numbers are above 0
POSITIVE = ("id", "width", "height", "fps", "metres_per_unit", "half_axes", "size", "size_m")
NUMBER_MAX = 1e12  # of lengths; products of a few stay within the range of doubles


def decode(kind: Any, value: Any, at: str = "$", name: str = "") -> Any:
    """Convert a JSON value to a type: a dataclass, or the type of a field of our dataclasses.

    Missing fields get their default; unknown keys are ignored.

    Args:
        at: JSON path of the value, for messages. name: of the field that it belongs to.
    Raises:
        ReobjError: the value has another type or shape, or a number is out of range.
    """
    if isinstance(kind, types.UnionType):  # T | None
        kind, _ = typing.get_args(kind)
        return None if value is None else decode(kind, value, at, name)
    if kind == Array:
        return _decode_array(value, at, name)
    if dataclasses.is_dataclass(kind):
        return _decode_record(kind, value, at)
    if kind is quadrics.Scale:
        names = {"metres_per_unit": float, "rel_sigma": float | None, "source": str}
        entry = _checked(value, dict, at)
        return quadrics.Scale(*(decode(k, entry.get(n), f"{at}.{n}", n) for n, k in names.items()))
    origin = typing.get_origin(kind)
    if origin in (list, tuple, Sequence):
        item = typing.get_args(kind)[0]
        values = [decode(item, v, f"{at}[{k}]") for k, v in enumerate(_checked(value, list, at))]
        if name in ("visits", "spans") and any(len(pair) != 2 for pair in values):
            raise ReobjError(f"{at}: expected pairs of frames")
        return values if origin is list else tuple(values)
    if origin is dict:
        item = typing.get_args(kind)[1]
        pairs = _checked(value, dict, at).items()
        return {k: decode(item, v, f"{at}.{k[:60]}") for k, v in pairs}
    if kind in (int, float):
        return _decode_number(kind, value, at, name)
    return _checked(value, kind, at)


def _decode_record(kind: Any, value: Any, at: str) -> Any:
    """Convert a JSON object to a dataclass."""
    entry = _checked(value, dict, at)
    hints = typing.get_type_hints(kind)
    if kind is LinkEvent:
        hints["appearance_log_odds"] = float | None  # infinity is written as null
    values: dict[str, Any] = {}
    for f in dataclasses.fields(kind):
        key = _JSON_KEYS.get(f.name, f.name)
        if key == "appearance_log_odds" and key not in entry:
            key = "look"  # its name in version 0.1
        if key in entry:
            values[f.name] = decode(hints[f.name], entry[key], f"{at}.{key}", f.name)
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise ReobjError(f"{at}: {key!r} is missing")
    if "class_name" in values:
        values["class_name"] = visible_name(values["class_name"])
    return kind(**values)


def _decode_array(value: Any, at: str, name: str) -> Array:
    """Convert nested lists of numbers to the array of a field."""
    shape = {"quat_wxyz": (4,), "cov": (9, 9)}.get(name, (3,))
    try:
        array = np.array(_checked(value, list, at))
    except ValueError:  # lists of different lengths
        array = np.empty(0)
    if array.shape != shape or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise ReobjError(f"{at}: expected {' x '.join(map(str, shape))} finite numbers")
    if name != "cov" and np.abs(array).max() > NUMBER_MAX:
        raise ReobjError(f"{at}: expected numbers of at most {NUMBER_MAX:g}")
    if name in POSITIVE and array.min() <= 0:
        raise ReobjError(f"{at}: expected positive numbers")
    return array.astype(np.float64)


def _decode_number(kind: type, value: Any, at: str, name: str) -> int | float:
    """Check an integer, which is never negative, or a finite number."""
    if kind is int:
        # up to 2**53 JSON parsers that use doubles are exact
        valid = isinstance(value, int) and 0 <= value <= 2**53
        expected = "an integer >= 0"
    else:
        valid = isinstance(value, int | float) and abs(value) <= NUMBER_MAX
        expected = "a number"
    if name in POSITIVE:
        valid = valid and value > 0
        expected = "an integer > 0" if kind is int else "a number > 0"
    if not valid or isinstance(value, bool):
        raise ReobjError(f"{at}: {_shown(value)}, expected {expected}")
    return typing.cast(float, value)


def _checked(value: Any, kind: type, at: str) -> Any:
    """Return a value of the Python type, or raise."""
    if not isinstance(value, kind):
        names = {list: "a list", dict: "an object", str: "a text", bool: "true or false"}
        raise ReobjError(f"{at}: {_shown(value)}, expected {names[kind]}")
    return value


def _shown(value: Any) -> str:
    """Format a value for a message, however large it is."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "an object"
    return repr(value[:60] if isinstance(value, str) else value)
