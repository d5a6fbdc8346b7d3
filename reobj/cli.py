"""Command line: commands with their flags, messages and exit codes."""

from __future__ import annotations

import argparse
import io
import itertools
import json
import logging
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import quadrics
from reobj import __version__
from reobj.config import Config, add_flags, config_from_args, list_options
from reobj.evaluation.tracks import evaluate, score_report
from reobj.export.registry import EXPORTS, export
from reobj.files import atomic, did_you_mean, wrapped
from reobj.maps.contents import MAP_EXPORTS, FolderMap, corrected, listing
from reobj.maps.room_map import RoomMap, map_lock
from reobj.maps.stage import session_key
from reobj.objects.description import components_message
from reobj.pipeline import last_config, program
from reobj.poses.stage import (
    checked_poses,
    reconstruct_cached,
    supplied_poses,
    write_supplied_model,
)
from reobj.results.entries import (
    OutputFile,
    copy_models,
    replaced,
    validate_objects,
    write_trajectories,
)
from reobj.results.workspace import Workspace
from reobj.sources.video import Video
from reobj.sources.weights import list_models, model_path
from reobj.types import (
    NOTE,
    ReobjError,
    Tracks,
    log,
    log_message,
    one_line,
    printable,
    without_secrets,
)
from reobj.viewer.serve import Server

Arguments = argparse.Namespace


def main(words: Sequence[str], run: Callable[..., Any], refit: Callable[..., Any]) -> int:
    """Run the command line; returns the exit code (`reobj_track.main`).

    Args:
        run, refit: of `reobj_track`.
    Raises:
        SystemExit: of argparse, after --help and for invalid arguments.
    """
    for stream in (sys.stdout, sys.stderr):  # an unusual name of a class or file must not end a run
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            return _command(words, make_parser(run, refit))
        finally:
            sys.stdout.flush()
    except OSError as error:  # of the output: its reader (head) has ended, or a full disk
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 0
        print(f"error: the output cannot be written ({error.strerror})", file=sys.stderr)
        return 2


def _command(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Parse the words and run the command; an exception becomes a message and an exit code."""
    if not words:
        parser.print_help(sys.stderr)
        return 2
    args = parser.parse_args(words)
    log.setLevel(logging.DEBUG if args.debug else logging.INFO if args.verbose else NOTE)
    logging.addLevelName(NOTE, "note")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(SafeFormatter())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    try:
        return int(args.func(args))
    except KeyboardInterrupt:
        text = "interrupted; what was computed is kept: run the same command again to go on"
        print(f"\n{text}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except Exception as error:
        expected = isinstance(error, ReobjError | quadrics.QuadricsError | OSError)
        text = f"error: {one_line(str(error))}"
        if not expected or args.debug:
            text = without_secrets(traceback.format_exc())
        print(text, file=sys.stderr)
        return 2 if expected else 1


class SafeFormatter(logging.Formatter):
    """Format log lines without the secrets of URLs and with control characters escaped."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record."""
        text = without_secrets(f"{record.levelname.lower()}: {super().format(record)}")
        return "\n".join(map(printable, text.split("\n")))


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line with a suggestion."""

    def error(self, message: str) -> NoReturn:
        """Print one line and stop with exit code 2."""
        if flag := re.match(r"unrecognized arguments: .*?(--[\w-]+)", message):
            message += did_you_mean(flag[1], self._known_flags())
        elif choice := re.search(r"invalid choice: '([^']*)'", message):
            message += did_you_mean(choice[1], re.findall(r"'?([\w-]+)'?[,)]", message))
        self.exit(2, f"error: {one_line(message)} (see {self.prog} --help)\n")

    def _known_flags(self) -> list[str]:
        """List the flags of this parser and of its commands."""
        commands = [a.choices for a in self._actions if isinstance(a, argparse._SubParsersAction)]
        parsers = [self, *itertools.chain(*(choices.values() for choices in commands))]
        return [flag for parser in parsers for flag in parser._option_string_actions]


class _ListOptions(argparse.Action):
    """--options: print every option with its default and meaning, then stop."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(list_options(Config()))
        parser.exit()


# ---- Commands and their flags ----


def make_parser(run: Callable[..., Any], refit: Callable[..., Any]) -> argparse.ArgumentParser:
    """Make the parser of all commands."""
    parser = Parser(
        prog=program(),
        description="Re-identify object instances in a hand-held video of a static scene and "
        "localise them in 3D.",
        epilog=f"Example: {program()} run room.mp4 -o out; then open out/scene.html.",
    )
    parser.add_argument("--version", action="version", version=f"reobj_track {__version__}")
    parser.add_argument(
        "--options",
        action=_ListOptions,
        nargs=0,
        help="list all options of --set section.field=value, and stop",
    )
    try:
        import shtab

        shtab.add_argument_to(
            parser,
            "--completion",
            help="print a shell completion script for `reobj-track`, and stop",
        )
    except ImportError:
        pass
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(
        name: str, func: Callable[[Arguments], int], text: str, example: str, *sections: str
    ) -> Any:
        """Add a command with the flags of sections of the options, --set and the log options."""
        own = sub.add_parser(
            name,
            help=text,
            description=f"{text[0].upper()}{text[1:]}.",
            epilog=f"Example: {program()} {name} {example}",
        )
        add_flags(own, Config(), sections)
        add = own.add_argument
        if any(sections):
            add("--config", metavar="FILE", help="options from a TOML file; flags override it")
            add("--save-config", metavar="FILE", help="write the options, for --config")
        add(
            "--set",
            action="append",
            metavar="SECTION.FIELD=VALUE",
            help="set any option, e.g. tracker.coast_frames=60; --options lists them",
        )
        add("--options", action=_ListOptions, nargs=0, help="list all options of --set, and stop")
        add("-v", "--verbose", action="store_true", help="log each step")
        add("--debug", action="store_true", help="log details, and tracebacks of errors")
        own.set_defaults(func=func, config=None, save_config=None)
        return add

    _add_run(command, run)
    _add_output_commands(command, refit)
    _add_map(command)
    add = command("models", _cmd_models, "list, download and verify weights", "fast", "")
    add(
        "names", nargs="*", metavar="NAME", help="weights to download or verify (default: list all)"
    )
    return parser


def _add_run(command: Any, run: Callable[..., Any]) -> None:
    def run_it(args: Arguments) -> int:
        names = ("detections", "tracks", "overwrite", "show")
        given = {name: getattr(args, name) for name in names}
        config = config_from_args(Config(), args)
        print(run(args.video, args.out, config, in_3d=args.command == "run", **given).summary())
        return 0

    tracked = ("input", "detect", "embed", "tracker", "")
    for name, func, text, sections in (
        ("run", run_it, "identities, cameras and 3D objects of a video, with files to view",
         (*tracked[:-1], "poses", "objects", "map", "")),
        ("track", run_it, "identities only (2D)", tracked),
        ("poses", _cmd_poses, "cameras only (pycolmap)", ("input", "poses", "")),
    ):  # fmt: skip
        add = command(name, func, text, "room.mp4 -o out", *sections)
        text = "video file, folder of images, quoted glob, camera index or stream URL"
        if name == "run":
            text += "; none: no images, only --detections and --poses"
        add("video", nargs="?" if name == "run" else None, metavar="VIDEO", help=text)
        add("-o", "--out", required=True, metavar="FOLDER", help="output folder")
        add(
            "--overwrite",
            action="store_true",
            help="use a folder that holds other files or results of another video",
        )
        if name != "poses":
            add(
                "--detections",
                metavar="FILE",
                help="file of detections, used instead of the detector: MOT, KITTI, CSV, COCO "
                "JSON, folder of YOLO labels, CVAT, npz",
            )
            _add_tracks(add)
            add(
                "--show",
                action="store_true",
                help="show frames and identities live: in rerun's viewer, without rerun on a page",
            )


def _add_tracks(add: Any) -> None:
    add(
        "--tracks",
        metavar="FILE",
        help="file of identities, used instead of the tracker: CVAT, COCO, MOT, KITTI, CSV, "
        "YOLO labels",
    )


def _add_output_commands(command: Any, refit: Callable[..., Any]) -> None:
    """Add the commands on an output folder."""

    def fit_again(args: Arguments) -> int:
        if args.validate:
            faults = validate_objects(args.out)
            print("\n".join(faults) or "valid")
            return 2 if faults else 0
        config = config_from_args(last_config(args.out), args)
        print(refit(args.out, config, args.tracks, args.edits).summary())
        return 0

    def add_out(add: Any, more: str = "") -> None:
        text = f"output folder of an earlier `run`{more}"
        add("out", type=Path, metavar="OUT", help=text)

    add = command(
        "objects",
        fit_again,
        "fit the objects of an output folder again, by default with its last options",
        "out --known-size chair=0.82m",
        "objects",
        "output",
    )
    add_out(add)
    add("--validate", action="store_true", help="only validate objects.json against its schema")
    _add_tracks(add)
    add(
        "--edits",
        metavar="FILE",
        help="file of corrections, saved by scene.html; later fits apply it too",
    )
    add = command(
        "serve",
        _cmd_serve,
        "show the viewer on this machine; saved corrections are applied at once",
        "out --open",
    )
    add_out(add)
    add("--port", type=int, default=0, metavar="N", help="port of 127.0.0.1 (default: a free one)")
    add("--open", action="store_true", help="open the page in the browser")
    add = command(
        "eval", _cmd_eval, "compare with ground truth: HOTA, IDF1, MOTA, O3D", "out --gt gt.txt"
    )
    add_out(add, ", or a tracks.txt")
    add(
        "--gt",
        type=Path,
        required=True,
        metavar="FILE",
        help="true tracks: MOTChallenge gt.txt, KITTI, CVAT or COCO-VID",
    )
    add(
        "--gt-format",
        default="auto",
        metavar="FORMAT",
        help="format of --gt (docs/input_formats.md)",
    )
    add("--gt-objects", type=Path, metavar="FILE", help="true 3D objects, e.g. gt_objects.json")
    add(
        "--gt-poses",
        type=Path,
        metavar="FILE",
        help="true cameras, TUM or 4x4 world_from_cam a line (default: poses.txt or poses_c2w.txt "
        "beside --gt-objects)",
    )
    add(
        "--classes",
        default="",
        metavar="NAMES",
        help="evaluate these classes only, comma-separated",
    )
    add(
        "--min-visibility",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="ignore true boxes of lower visibility (0 to 1)",
    )
    add = command(
        "export",
        _cmd_export,
        "convert the results of an output folder to the format of another tool",
        "out --to glb",
    )
    add_out(add)
    add("--to", required=True, choices=tuple(EXPORTS), help="format to write")
    add("-o", "--output", metavar="FILE", help="file to write (default: in the output folder)")


def _add_map(command: Any) -> None:
    add = command(
        "map",
        _cmd_map,
        "list what a map of a room holds, correct or export it",
        "flat.map --merge 3 12 --rename 3 armchair",
    )
    add("map", type=Path, metavar="MAP", help="file of a map")
    many: dict[str, Any] = {"action": "append", "default": []}
    add(
        "--forget",
        **many,
        metavar="SESSION",
        help="remove what a session added; its number, or the name of its recording",
    )
    add(
        "--merge",
        **many,
        nargs=2,
        type=int,
        metavar=("KEEP", "DROP"),
        help="join two objects that are one; the number DROP then means KEEP",
    )
    add(
        "--rename",
        **many,
        nargs=2,
        metavar=("ID", "NAME"),
        help="give an object a class that later detections do not change",
    )
    add(
        "--delete",
        **many,
        type=int,
        metavar="ID",
        help="mark an object as none: it is left out of results",
    )
    add("--undelete", **many, type=int, metavar="ID", help="undo --delete")
    add("--export", choices=tuple(MAP_EXPORTS), help="format to write the objects in")
    add("-o", "--output", type=Path, metavar="FILE", help="file to write (default: beside the map)")


# ---- What the commands do ----


def _cmd_poses(args: Arguments) -> int:
    config = config_from_args(Config(), args)
    video = Video(args.video, config.input)
    with Workspace(args.out, args.overwrite) as workspace:
        workspace.bind(video, args.overwrite)
        model: Sequence[Path] = ()
        if supplied := supplied_poses(video, config.poses):
            poses = checked_poses(supplied, Tracks.empty(), video, config.poses, workspace)
        else:
            poses, model = reconstruct_cached(video, config.poses, workspace)
        with replaced(workspace.out, (OutputFile.POSES, OutputFile.MODEL)) as new:
            copy_models(model, new)
            write_trajectories(new, poses)
            write_supplied_model(poses, video, new)
    where = f"{workspace.out / 'poses.txt'}, {workspace.out / 'sparse'}"
    print(f"{poses.cameras_text}, {len(poses.points)} points; look at: {where}")
    for message in (*video.messages, *poses.messages, *components_message(poses)):
        log_message(message)
    return 0


def _cmd_serve(args: Arguments) -> int:
    def folder_map() -> FolderMap | None:
        """Return the map of the output folder; None: there is none."""
        config = last_config(args.out).map
        if not config.path:
            return None
        workspace = Workspace.open(args.out)
        video, _ = workspace.video_or_frames(workspace.load_last())
        return FolderMap(Path(config.path), session_key(video), config.frozen)

    command = [sys.executable, str(Path(quadrics.__file__).with_name("reobj_track.py"))]
    with Server(args.out, args.port, command, folder_map) as server:
        print(f"viewer of {args.out}: {server.url}\nCtrl-C ends it", flush=True)
        if args.open:
            server.open_browser()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            server.corrections.stop()
    return 0


def _cmd_eval(args: Arguments) -> int:
    poses: Path | None = args.gt_poses
    if poses is None and args.gt_objects:
        beside = [args.gt_objects.with_name(n) for n in ("poses_c2w.txt", "poses.txt")]
        poses = next((p for p in beside if p.exists()), None)
    classes = [c.strip() for c in args.classes.split(",") if c.strip()]
    first = config_from_args(Config(), args).detect.first_frame
    more = (args.min_visibility, args.gt_format, first)
    scores = evaluate(args.out, args.gt, args.gt_objects, poses, classes, *more)
    try:
        if args.out.is_dir():
            with atomic(args.out / "eval.json") as part:
                part.write_text(json.dumps(scores, indent=1), encoding="utf-8")
    finally:
        print(score_report(scores))
    return 0


def _cmd_export(args: Arguments) -> int:
    print(export(args.out, args.to, args.output))
    return 0


def _cmd_map(args: Arguments) -> int:
    path: Path = args.map
    output: Path | None = args.output
    if output is not None and args.export is None:
        raise ReobjError(f"-o {output}: give --export too, one of {', '.join(MAP_EXPORTS)}")
    if args.export is not None:
        output = output or path.with_suffix(f".{args.export}")
        if output.resolve() == path.resolve():
            raise ReobjError(f"{output}: is the map; give another file with -o")
    if unusable := [number for number, _ in args.rename if not number.isdecimal()]:
        raise ReobjError(f"--rename {unusable[0]}: expected the number of an object")
    renamed = [(int(number), name) for number, name in args.rename]
    corrections = [args.forget, args.merge, renamed, args.delete, args.undelete]
    room = RoomMap.load(path)
    if any(corrections):
        with map_lock(path):
            room, lines = corrected(RoomMap.load(path), *corrections)
            room.save(path)
        print("\n".join(lines))
    if output is not None:
        MAP_EXPORTS[args.export](room, output)
        print(output)
    elif not any(corrections):
        print(listing(room, path))
    return 0


def _cmd_models(args: Arguments) -> int:
    for name in args.names:
        print(model_path(name, offline=bool(args.offline)))
    for row in () if args.names else list_models():
        w = row.weights
        size = f"{w.size / 1e6:.1f}" if w.size else "?"
        facts = f"{w.name:<15} {w.role:<9} {size:>5} MB  {w.licence:<11}"
        print("\n".join(wrapped(f"{facts} {row.state:<9} {w.note}")))
    return 0
