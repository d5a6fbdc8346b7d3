"""Command line: commands and flags, short help, error messages with suggestions.

The functions of the commands are in `reobj_track`.
"""

from __future__ import annotations

import argparse
import io
import logging
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from reobj import __version__
from reobj.files import did_you_mean, wrapped
from reobj.options import add_flags, list_options
from reobj.types import ReobjError, one_line, printable, without_secrets

Command = Callable[[argparse.Namespace], int]


def program() -> str:
    """Return the command that this program was started with, for messages."""
    path = Path(sys.argv[0])
    if path.stem == "reobj-track":
        return path.stem
    return f"python {path}" if path.name == "reobj_track.py" else "python -m reobj_track"


def apply_command(out: Path) -> str:
    """Return the command that fits the objects of a folder again, from any working folder."""
    path = Path(sys.argv[0])
    words = ["python", str(path.absolute())] if path.name == "reobj_track.py" else program().split()
    words += ["objects", str(out.absolute())]
    if sys.platform == "win32":  # cmd.exe takes double quotes only
        return subprocess.list2cmdline(words)
    return shlex.join(words)


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line with a suggestion."""

    def error(self, message: str) -> NoReturn:
        """Print one line and stop with exit code 2."""
        if flag := re.match(r"unrecognized arguments: .*?(--[\w-]+)", message):
            message += did_you_mean(flag[1], self._words("--"))
        elif choice := re.search(r"invalid choice: '([^']*)'", message):
            message = re.sub(r"^argument (\S+): ", r"\1: ", message)
            message += did_you_mean(choice[1], re.findall(r"'?([\w-]+)'?[,)]", message))
        self.exit(2, f"error: {one_line(message)} (see {self.prog} --help)\n")

    def _words(self, start: str) -> list[str]:
        """List the flags of this parser and of its commands."""
        words: dict[str, None] = dict.fromkeys(self._option_string_actions)
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                for command in action.choices.values():
                    words |= dict.fromkeys(command._option_string_actions)
        return [word for word in words if word.startswith(start)]


class SafeFormatter(logging.Formatter):
    """Format log lines without the secrets of URLs and with control characters escaped."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record."""
        return "\n".join(map(printable, without_secrets(super().format(record)).split("\n")))


def with_streams(program: Callable[[], int]) -> int:
    """Run a program whose standard streams may be closed, full, or a pipe without a reader.

    Returns:
        the exit code of the program; 0 if the reader of its output (head, less) ended first; 2 if
        the output cannot be written.
    Raises:
        SystemExit: of argparse, after --help and for invalid arguments.
    """
    _open_streams()
    code = 0
    system_exit = None
    try:
        code = program()
    except BrokenPipeError:
        pass
    except SystemExit as error:
        system_exit = error
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            say(f"error: the output cannot be written ({error.strerror})")
            return 2
    if system_exit is not None:
        raise system_exit
    return code


def _open_streams() -> None:
    """Open closed standard streams; let all of them escape what they cannot encode."""
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        try:
            os.fstat(number)
        except (
            OSError
        ):  # the next file that is opened would get its number: C code would print there
            while os.open(os.devnull, os.O_RDWR) < number:
                pass
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):  # an unusual name of a class or file must not end a run
        if not isinstance(stream, io.TextIOWrapper):
            continue
        if sys.getfilesystemencoding() == "ascii":  # LC_ALL=C: names of files are passed as bytes
            stream.reconfigure(encoding="utf-8", errors="surrogateescape")
        elif stream.errors in ("strict", "surrogateescape"):  # the latter in the locale C.UTF-8
            stream.reconfigure(errors="backslashreplace")


def say(text: str) -> None:
    """Print a line on stderr; ignore a closed stderr."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        _discard(sys.stderr)


def _discard(stream: Any) -> None:
    """Redirect a stream to the null device, so that the interpreter's last flush succeeds."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


class _ListOptions(argparse.Action):
    """--options: print every option with its default and meaning, then stop."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(list_options(self.const))
        parser.exit()


class _Completion(argparse.Action):
    """--completion SHELL: print the completion script of the installed program, then stop."""

    def __call__(self, parser: argparse.ArgumentParser, _: Any, shell: Any, *__: Any) -> None:
        try:
            print(completion(parser, str(shell)))
        except ReobjError as error:
            parser.exit(2, f"error: {error}\n")
        parser.exit()


def make_parser(
    config: Any,
    commands: Mapping[str, Command],
    exports: Sequence[str],
    map_exports: Sequence[str],
) -> argparse.ArgumentParser:
    """Make the parser of the tool.

    Args:
        config: default options. commands: function of each command.
        exports, map_exports: formats of `export`, and of `map --export`.
    """

    def command(name: str, text: str, example: str, *sections: str) -> Any:
        func = commands[name]
        return add_command(sub, name, text, func, example, config, *sections).add_argument

    parser = Parser(
        prog=program(),
        description="Re-identify object instances in a hand-held video of a static scene and "
        "localise them in 3D.",
        epilog=f"Example: {program()} run room.mp4 -o out; then open out/scene.html.",
    )
    parser.add_argument("--version", action="version", version=f"reobj_track {__version__}")
    text = "list all options of --set section.field=value, and stop"
    parser.add_argument("--options", action=_ListOptions, nargs=0, const=config, help=text)
    text = "print a shell completion script for `reobj-track` (needs shtab)"
    shells = ("bash", "zsh")  # shtab's script for tcsh does not complete the flags of commands
    parser.add_argument("--completion", action=_Completion, choices=shells, help=text)
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(command, "run", "identities, cameras and 3D objects of a video, with files to view")
    _add_run(command, "track", "identities only (2D)")
    _add_run(command, "poses", "cameras only (pycolmap)")
    text = "fit the objects of an output folder again, by default with its last options"
    add = command("objects", text, "out --known-size chair=0.82m", "objects", "output")
    add("out", help="output folder of an earlier `run`")
    text = "only validate objects.json against its schema"
    add("--validate", action="store_true", help=text)
    _add_tracks(add)
    add("--edits", help="file of corrections, saved by scene.html; later fits apply it too")
    text = "show the viewer on this machine; saved corrections are applied at once"
    add = command("serve", text, "out --open")
    add("out", type=Path, help="output folder of an earlier `run`")
    add("--port", type=int, default=0, help="port of 127.0.0.1 (default: a free one)")
    add("--open", action="store_true", help="open the page in the browser")
    text = "compare with ground truth: HOTA, IDF1, MOTA, O3D"
    add = command("eval", text, "out --gt gt.txt")
    add("out", type=Path, help="output folder of an earlier `run`, or a tracks.txt")
    add("--gt", type=Path, required=True,
        help="true tracks: MOTChallenge gt.txt, KITTI, CVAT or COCO-VID")  # fmt: skip
    add("--gt-format", default="auto", help="format of --gt (docs/input_formats.md)")
    add("--gt-objects", type=Path, help="true 3D objects, e.g. gt_objects.json")
    add("--gt-poses", type=Path, help="true cameras, TUM or 4x4 world_from_cam a line (default: "
        "poses.txt or poses_c2w.txt beside --gt-objects)")  # fmt: skip
    add("--classes", default="", help="evaluate these classes only, comma-separated")
    add("--min-visibility", type=float, default=0.0,
        help="ignore true boxes of lower visibility (0 to 1)")  # fmt: skip
    text = "convert the results of an output folder to the format of another tool"
    add = command("export", text, "out --to glb")
    add("out", help="output folder of an earlier `run`")
    text = "format to write; of label tools: coco-vid, cvat, yolo; tables: boxer, "
    text += "csv; of 3D viewers: glb, ply, rrd, usd; of robots (ROS 2): mcap; nerfstudio"
    add("--to", required=True, choices=exports, help=text)
    add("-o", "--output", help="file to write (default: in the output folder)")
    _add_map(command, map_exports)
    text = "list, download and verify weights"
    add = command("models", text, "fast", "")
    add(
        "names", nargs="*", metavar="NAME", help="weights to download or verify (default: list all)"
    )
    return parser


def _add_run(command: Any, name: str, text: str) -> None:
    sections = {
        "run": ("input", "detect", "embed", "tracker", "poses", "objects", "map", ""),
        "track": ("input", "detect", "embed", "tracker", ""),
        "poses": ("input", "poses", ""),
    }[name]
    add = command(name, text, "room.mp4 -o out", *sections)
    text = "video file, folder of images, quoted glob, camera index or stream URL"
    if name == "run":
        text += "; none: no images, only --detections and --poses"
    add("video", nargs="?" if name == "run" else None, help=text)
    add("-o", "--out", required=True, help="output folder")
    add(
        "--overwrite",
        action="store_true",
        help="use a folder that holds other files or results of another video",
    )
    if name != "poses":
        text = "file of detections, used instead of the detector: MOT, KITTI, CSV, COCO JSON, "
        add("--detections", help=text + "folder of YOLO labels, CVAT, npz")
        _add_tracks(add)
        text = "show frames and identities live: in rerun's viewer, without rerun on a page"
        add("--show", action="store_true", help=text)


def _add_map(command: Any, exports: Sequence[str]) -> None:
    text = "list what a map of a room holds, correct or export it"
    add = command("map", text, "flat.map --merge 3 12 --rename 3 armchair")
    add("map", type=Path, help="file of a map")
    text = "remove what a session added; its number, or the name of its recording"
    add("--forget", action="append", default=[], metavar="SESSION", help=text)
    text = "join two objects that are one; the number DROP then means KEEP"
    add("--merge", action="append", default=[], nargs=2, type=int, metavar=("KEEP", "DROP"),
        help=text)  # fmt: skip
    text = "give an object a class that later detections do not change"
    add("--rename", action="append", default=[], nargs=2, metavar=("ID", "NAME"), help=text)
    text = "mark an object as none: it is left out of results"
    add("--delete", action="append", default=[], type=int, metavar="ID", help=text)
    text = "undo --delete"
    add("--undelete", action="append", default=[], type=int, metavar="ID", help=text)
    add("--export", choices=exports, help="format to write the objects in")
    add("-o", "--output", type=Path, help="file to write (default: beside the map)")


def _add_tracks(add: Any) -> None:
    formats = "CVAT, COCO, MOT, KITTI, CSV, YOLO labels"
    add("--tracks", help=f"file of identities, used instead of the tracker: {formats}")


def add_command(
    sub: Any,
    name: str,
    text: str,
    func: Command,
    example: str,
    config: Any,
    *sections: str,
) -> argparse.ArgumentParser:
    """Add a command with the flags of sections of a config, --set, and the log options.

    Args:
        example: arguments of a typical call.
    """
    parser: argparse.ArgumentParser = sub.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=f"Example: {program()} {name} {example}",
    )
    add_flags(parser, config, sections)
    add = parser.add_argument
    if any(sections):
        add("--config", metavar="FILE", help="options from a TOML file; flags override it")
        add("--save-config", metavar="FILE", help="write the options of this run, for --config")
    text = "set any option, e.g. tracker.coast_frames=60; --options lists them"
    add("--set", action="append", metavar="SECTION.FIELD=VALUE", help=text)
    text = "list all options of --set, and stop"
    add("--options", action=_ListOptions, nargs=0, const=config, help=text)
    add("-v", "--verbose", action="store_true", help="log each step")
    add("--debug", action="store_true", help="log details, and tracebacks of errors")
    parser.set_defaults(func=func, config=None, save_config=None)
    return parser


def short_help(parser: argparse.ArgumentParser, words: Sequence[str]) -> str | None:
    """Return short help for a call without arguments that needs some, else None."""
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    if not words:
        names = [f"  {a.dest:<10}{a.help}" for a in commands._choices_actions]
        lines = [str(parser.description), "", *names, "", str(parser.epilog)]
    elif len(words) == 1 and words[0] in commands.choices:
        command = commands.choices[words[0]]
        if not any(a.required and a.nargs != "*" for a in command._actions):
            return None
        lines = [str(command.description), str(command.epilog)]
        lines.append(f"All flags: {command.prog} --help")
    else:
        return None
    return "\n".join(piece for line in lines for piece in wrapped(line) or [""])


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return a completion script of shtab.

    Not of argcomplete: shtab's script is static, so completion does not start Python and import
    OpenCV.
    """
    try:
        import shtab
    except ImportError as error:
        raise ReobjError("shtab is not installed: pip install shtab") from error
    parser.prog = "reobj-track"  # the program that pip installs
    return str(shtab.complete(parser, shell))
