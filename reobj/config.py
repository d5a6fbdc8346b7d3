"""Options: config dataclasses, set by flags, --set section.field=value, dicts and TOML files."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import textwrap
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from reobj.appearance.embedding import EmbedConfig
from reobj.files import atomic, did_you_mean, read_text
from reobj.maps.stage import MapConfig
from reobj.objects.config import ObjectsConfig
from reobj.poses.estimate import PosesConfig
from reobj.sources.detection_files import DetectConfig
from reobj.sources.video import InputConfig
from reobj.tracking.linking import STD_POSITION, STD_VELOCITY
from reobj.types import NOTE, ReobjError, log, option

C = TypeVar("C")


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Tracking and re-identification."""

    high_score: float = option(
        0.4, "detections of at least this score are matched first", "--high-score"
    )
    low_score: float = option(
        0.1, "second association round: minimum detection score (ByteTrack); raise it for noisy "
        "detectors"
    )  # fmt: skip
    new_score: float = option(0.5, "minimum score of the detection that starts a new track")
    n_init: int = option(
        3, "confirm a track once its scores sum to n_init x 0.5; re-identified tracks need 0.5 "
        "less; raise it for fewer false objects"
    )  # fmt: skip
    coast_frames: int = option(
        30, "frames with detector output that a track survives without a detection", "--coast"
    )
    remember: bool = option(True, "re-identify objects that return, after any time")
    std_position: float = option(
        STD_POSITION, "process noise of the position, over the box size; raise it for jerky cameras"
    )
    std_velocity: float = option(
        STD_VELOCITY, "process noise of the velocity, over the box size; raise it for jerky cameras"
    )
    appearance_weight: float = option(0.7, "weight of appearance in the cost of ambiguous matches")
    foreground_weight: float = option(
        0.5, "weight of the foreground in the appearance; the rest is that of the surroundings"
    )
    embed_every: int = option(10, "frames with detector output between two embeddings of a track")
    return_probability: float = option(
        0.5, "minimum probability of a re-identification; raise it for fewer wrong identities"
    )
    camera_motion: bool = option(True, "compensate the camera's motion (sparse optical flow)")


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """Files written."""

    overlay: bool = option(True, "write the overlay video, overlay.mp4")
    scene: bool = option(True, "write the viewer, scene.html")
    cloud: bool = option(False, "dense coloured points in the viewer, from the maps of --depth")
    doubtful: bool = option(
        False, "include low-confidence objects in tracks.txt, overlay video and viewer"
    )
    fill_gaps: int = option(
        5,
        "interpolate track gaps of up to N frames (0: off); interpolated boxes have score 0. 3D "
        "objects are also projected into frames from nearby viewpoints",
    )


@dataclass(frozen=True, slots=True)
class Config:
    """All options; sections are set by `--set section.field=value` on the command line."""

    input: InputConfig = field(default_factory=InputConfig)
    detect: DetectConfig = field(default_factory=DetectConfig)
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    poses: PosesConfig = field(default_factory=PosesConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    map: MapConfig = field(default_factory=MapConfig)
    threads: int = option(0, "threads of onnxruntime and OpenCV (0: all cores)", "--threads")
    device: str = option(
        "cpu", "device of the networks: cpu, cuda, coreml, ... (onnxruntime)", "--device"
    )
    offline: bool = option(False, "never download weights", "--offline")

    def __repr__(self) -> str:
        """List the options that differ from the defaults, in one line."""
        return f"Config({', '.join(f'{k}={v!r}' for k, v in changed_options(self).items())})"


# Options of 0.2.0 and what is done instead; they are accepted and have no effect
GONE = {
    "detect.nms_iou": "models suppress overlapping boxes as their layout demands",
    "objects.min_score": "the confidence of an object decides",
    "poses.max_gap": "a frame is interpolated where its error is small",
    "poses.max_keyframes": "long videos are reconstructed in windows",
}

LAYERS = frozenset({"solids", "ellipses", "trails", "boxes"})  # of the overlay video of 0.2.0

# What the value of a flag is, in --help; the flags of other options of type str take a NAME
VALUES = {
    "input.max_size": "PIXELS", "detect.model": "MODEL", "detect.words": "WORDS",
    "detect.classes": "NAMES", "detect.format": "FORMAT", "detect.layout": "LAYOUT",
    "embed.model": "MODEL", "tracker.high_score": "SCORE", "poses.mode": "FILE",
    "poses.fmt": "FORMAT", "poses.camera": "CAMERA", "poses.camera_format": "FORMAT",
    "poses.depth": "FOLDER", "objects.priors": "FILE", "objects.prior": "WORD=SIZE",
    "objects.known_size": "NAME=HEIGHT", "objects.support": "SHAPE", "map.path": "FILE",
}  # fmt: skip

EXPECTED = {
    bool: "true or false", int: "a whole number, 0 or more", float: "a number, 0 or more",
    str: "a text",
}  # fmt: skip


def every_option(config: Any) -> dict[str, dataclasses.Field[Any]]:
    """List the options of a config by their name for --set: `section.field`, or `field`."""
    options: dict[str, dataclasses.Field[Any]] = {}
    for f in dataclasses.fields(config):
        section = getattr(config, f.name)
        if dataclasses.is_dataclass(section):
            options |= {f"{f.name}.{g.name}": g for g in dataclasses.fields(section)}
        else:
            options[f.name] = f
    return options


def with_option(config: C, name: str, value: Any, where: str = "--set ") -> C:
    """Return the config with one option changed; a string is converted to the option's type.

    For an option of type str, a list of strings is joined by commas, a dict as key=value.

    Args:
        where: source of the option; begins the message of an error.
    Raises:
        ReobjError: no such option, or a value of another type.
    """
    if name in GONE:
        log.log(NOTE, "%s%s is no option any more and has no effect: %s", where, name, GONE[name])
        return config
    if name == "output.overlay" and LAYERS.issuperset(str(value).replace(" ", "").split(",")):
        value = True  # of 0.2.0; the video has one form
    options: Any = every_option(config)
    if name not in options:
        fields = {known.rpartition(".")[2]: known for known in options}
        similar = did_you_mean(name, options) or did_you_mean(fields.get(name, ""), options)
        raise ReobjError(f"{where}{name}: no such option{similar}; --options lists all")
    kind = type(options[name].default)
    try:
        value = _converted(value, kind)
    except (OverflowError, TypeError, ValueError):
        raise ReobjError(f"{where}{name}: expected {EXPECTED[kind]}, found {value!r}") from None
    section, _, field_name = name.rpartition(".")
    if section:
        value = dataclasses.replace(getattr(config, section), **{field_name: value})
    changed: Any = dataclasses.replace(config, **{section or field_name: value})  # type: ignore[type-var]
    return changed  # type: ignore[no-any-return]


def _converted(value: Any, kind: type) -> Any:
    """Convert the value of an option to its type; ValueError or TypeError if that is impossible."""
    if kind is str:
        return _text(value)
    if kind is bool and isinstance(value, str):
        value = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False,
                 "no": False, "off": False, "none": False}.get(value.lower())  # fmt: skip
    if kind is bool or isinstance(value, bool):
        if type(value) is not kind:
            raise TypeError
        return value
    if kind is int and isinstance(value, float):
        raise TypeError
    value = kind(value)
    if not 0 <= value < (2**31 if kind is int else math.inf):
        raise ValueError
    return value


def _text(value: Any) -> str:
    """Convert the value of an option of type str: a string, path, number, list or dict of them."""
    if isinstance(value, Mapping):
        value = [f"{key}={_text(item)}" for key, item in value.items()]
    if isinstance(value, list | tuple):
        return ",".join(map(_text, value))
    if not isinstance(value, str | Path | float | int):
        raise TypeError
    return str(value)


# ---- Dicts and files of options ----


def as_config(config: C, options: C | Mapping[str, Any] | None) -> C:
    """Return a config, or the default one with the options of a dict.

    Args:
        config: the default, for None and for options that the dict does not have.
        options: a config of the same type; or a dict of options by section,
            {"detect": {"classes": "chair"}}, or by name, {"detect.classes": "chair"}.
    Raises:
        ReobjError: another type, no such option, or a value of another type.
    """
    if isinstance(options, Mapping):
        return _with_table(config, options, "config: ")
    if options is not None and not isinstance(options, type(config)):
        expected = f"expected {type(config).__name__} or a dict of options"
        raise ReobjError(f"config is of type {type(options).__name__}, {expected}")
    return config if options is None else options


def _with_table(config: C, table: Mapping[str, Any], where: str) -> C:
    """Apply a table of options, by section or by name."""
    for key, value in table.items():
        inner = value if isinstance(value, Mapping) else {"": value}
        for name, item in inner.items():
            config = with_option(config, f"{key}.{name}" if name else str(key), item, where)
    return config


def read_config(config: C, path: str | Path) -> C:
    """Apply a TOML file of options, by section; its paths are relative to the working folder.

    Raises:
        ReobjError: invalid TOML, no such option, or a value of another type.
    """
    try:
        table = tomllib.loads(read_text(Path(path), 1 << 20, "surrogateescape"))
    except (ValueError, RecursionError) as error:  # also a number of 5,000 digits
        raise ReobjError(f"{path}: not valid TOML ({error})") from None
    return _with_table(config, table, f"{path}: ")


def changed_options(config: Any) -> dict[str, Any]:
    """Return the options that differ from the defaults, by their name for --set."""
    values = {name: attrgetter(name) for name in every_option(config)}
    default = type(config)()
    return {name: of(config) for name, of in values.items() if of(config) != of(default)}


def write_config(config: Any, path: str | Path) -> None:
    """Write the options that differ from the defaults as TOML, for `read_config`.

    Written by hand: Python has no TOML writer, and flat sections of plain values need no package.
    """
    lines = ["# Options of reobj_track that differ from the defaults; --options lists all."]
    section = ""
    changed = changed_options(config)
    for name in sorted(changed, key=lambda name: "." in name):  # options without a section first
        before = section
        section, _, field_name = name.rpartition(".")
        lines += [f"\n[{section}]"] if section != before else []
        lines.append(f"{field_name} = {_toml(changed[name])}")
    with atomic(Path(path)) as part:
        part.write_text("\n".join(lines) + "\n", "utf-8", "surrogateescape")


def _toml(value: str | float) -> str:
    """Format a value: strings as in JSON, with DEL escaped too; numbers as in Python.

    Bytes of paths that are not UTF-8 are written as they are.
    """
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower()


# ---- Flags ----


def add_flags(parser: argparse.ArgumentParser, config: Any, sections: Iterable[str]) -> None:
    """Add the flags of the options in the given sections ("": top level) to a parser."""
    for name, f in every_option(config).items():
        flags = f.metadata["flags"]
        if flags and name.rpartition(".")[0] in sections:
            kind = type(f.default)
            named = VALUES.get(name, "NAME" if kind is str else "N")
            action = "append" if f.metadata["repeated"] else "store"
            settings: dict[str, Any] = {"type": kind, "metavar": named, "action": action}
            if kind is bool:
                settings = {"action": "store_true"}
            default = f" (default: {f.default})" if f.default else ""
            text = f"{f.metadata['help']}{default}".replace("%", "%%")
            parser.add_argument(*flags, dest=name, default=None, help=text, **settings)


def config_from_args(config: C, args: argparse.Namespace) -> C:
    """Apply --config FILE, then the flags, then every --set section.field=value.

    The result is written to --save-config FILE, if given.
    """
    options: Any = every_option(config)
    if args.config:
        config = read_config(config, args.config)
    for name, value in vars(args).items():
        if name in options and value is not None:
            config = with_option(config, name, value)
    for item in args.set or []:
        name, equals, text = item.partition("=")
        config = with_option(config, name, text if equals else None)
    if args.save_config:
        write_config(config, args.save_config)
    return config


def list_options(config: Any) -> str:
    """Return the list of all options, one a line: name, default and meaning."""
    lines = []
    for name, f in every_option(config).items():
        default = str(f.default) if len(str(f.default)) <= 12 else f"{str(f.default)[:9]}..."
        first, *rest = textwrap.wrap(f.metadata["help"], 87)
        lines += [f"{f'{name}={default}':<32} {first}", *(" " * 33 + more for more in rest)]
    return "\n".join(lines)
