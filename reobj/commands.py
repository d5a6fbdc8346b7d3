"""The command line: its commands and flags, short help, messages that name the right word.

What a command does is the business of `reobj_track`.
"""

from __future__ import annotations

import argparse
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from reobj import __version__
from reobj.files import did_you_mean, wrapped
from reobj.options import add_flags, list_options
from reobj.types import ReobjError, one_line, printable, without_secrets

Command = Callable[[argparse.Namespace], int]
SHELLS = ("bash", "zsh")  # shtab's script for tcsh knows no flags of commands
TRACKS_HELP = (
    "identities from a file instead of the tracker: CVAT, COCO, MOT, KITTI, CSV, YOLO labels"
)
DETECTIONS_HELP = (
    "recorded detections instead: MOT, KITTI, CSV, COCO JSON, folder of YOLO labels, CVAT, npz"
)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line that names the right word."""

    def error(self, message: str) -> NoReturn:
        """Print one line and stop with exit code 2."""
        if found := re.match(r"unrecognized arguments: .*?(--[\w-]+)", message):
            message += did_you_mean(found[1], self._words("--"))
        elif found := re.search(r"invalid choice: '([^']*)'", message):
            message = re.sub(r"^argument (\S+): ", r"\1: ", message)
            message += did_you_mean(found[1], re.findall(r"'?([\w-]+)'?[,)]", message))
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
    """Write log lines without the secrets of URLs, and control characters of names escaped."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, or lines."""
        return "\n".join(map(printable, without_secrets(super().format(record)).split("\n")))


def with_streams(program: Callable[[], int]) -> int:
    """Run a program whose standard streams may be closed, full, or a pipe that nobody reads.

    Returns:
        the exit code of the program; 0 where the reader of its output (head, less) has seen enough
        before it ended; 2 where the output cannot be written.
    Raises:
        SystemExit: of argparse, after --help and for wrong words.
    """
    _open_streams()
    code = 0
    left = None
    try:
        code = program()
    except BrokenPipeError:
        pass
    except SystemExit as error:
        left = error
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            say(f"error: the output cannot be written ({error.strerror})")
            return 2
    if left is not None:
        raise left
    return code


def _open_streams() -> None:
    """Open the standard streams that are closed; what they cannot encode is escaped."""
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        try:
            os.fstat(number)
        except OSError:  # closed: a file opened next would get its number, and C code's messages
            while os.open(os.devnull, os.O_RDWR) < number:
                pass
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+"))
    for stream in (sys.stdout, sys.stderr):  # no name of a class or file ends a run
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def say(text: str) -> None:
    """Print a line on stderr, if anyone reads it."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        _discard(sys.stderr)


def _discard(stream: Any) -> None:
    """Send what is left in a buffer nowhere, so that the interpreter's own flush succeeds."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class _ListOptions(argparse.Action):
    """--options: print every option with its default and meaning, then stop."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(list_options(self.const))
        parser.exit()


class _Completion(argparse.Action):
    """--completion SHELL: print the script that completes the installed program's words, stop."""

    def __call__(self, parser: argparse.ArgumentParser, _: Any, shell: Any, *__: Any) -> None:
        try:
            print(completion(parser, str(shell)))
        except ReobjError as error:
            parser.exit(2, f"error: {error}\n")
        parser.exit()


def make_parser(
    config: Any, commands: Mapping[str, Command], exports: Sequence[str]
) -> argparse.ArgumentParser:
    """Make the parser of the tool.

    Args:
        config: with the default options. commands: function of each command. exports: formats.
    """

    def command(name: str, text: str, example: str, *sections: str) -> Any:
        func = commands[name]
        return add_command(sub, name, text, func, example, config, *sections).add_argument

    parser = Parser(
        prog="reobj_track.py",
        description="Objects of a hand-held video of a static scene: which detections are the same "
        "physical object, and where each one is in 3D.",
        epilog="Example: reobj_track.py run room.mp4 -o out; then open out/scene.html.",
    )
    parser.add_argument("--version", action="version", version=f"reobj_track {__version__}")
    text = "list what --set section.field=value can set"
    parser.add_argument("--options", action=_ListOptions, nargs=0, const=config, help=text)
    text = "print a script that completes the words of `reobj-track` (needs shtab)"
    parser.add_argument("--completion", action=_Completion, choices=SHELLS, help=text)
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(command, "run", "video -> identities -> cameras -> ellipsoids -> files to look at")
    _add_run(command, "track", "identities only (2D)")
    _add_run(command, "poses", "cameras only (pycolmap)")
    text = "(re)fit the ellipsoids from what an output folder already holds, with its last options"
    add = command("objects", text, "out --known-size chair=0.82m", "objects", "output")
    add("out", help="output folder of an earlier `run`")
    text = "only check objects.json against its schema"
    add("--validate", action="store_true", help=text)
    add("--tracks", help=TRACKS_HELP)
    add("--edits", help="corrections by hand, saved by scene.html; later fits keep them")
    text = "compare with ground truth: HOTA, IDF1, MOTA, O3D ..."
    add = command("eval", text, "out --gt gt.txt")
    add("out", type=Path, help="output folder of an earlier `run`, or a tracks.txt")
    add("--gt", type=Path, required=True, help="true tracks, MOTChallenge gt.txt")
    add("--gt-objects", type=Path, help="true solids, e.g. a gt_objects.json")
    add("--gt-poses", type=Path, help="true cameras, TUM or 4x4 world_from_cam a line (default: "
        "poses.txt or poses_c2w.txt beside --gt-objects)")  # fmt: skip
    add("--classes", default="", help="score these classes only, comma-separated")
    add("--min-visibility", type=float, default=0.0, help="ignore truth that is less visible")
    text = "write what an output folder holds in another tool's format"
    add = command("export", text, "out --to glb")
    add("out", help="output folder of an earlier `run`")
    add("--to", required=True, choices=exports, help="the format")
    add("-o", "--output", help="file to write (default: in the output folder)")
    text = "list, download and verify weights"
    add = command("models", text, "fast", "")
    add("names", nargs="*", metavar="NAME", help="weights to download or verify; none: list all")
    return parser


def _add_run(command: Any, name: str, text: str) -> None:
    sections = {
        "run": ("input", "detect", "embed", "tracker", "poses", "objects", ""),
        "track": ("input", "detect", "embed", "tracker", ""),
        "poses": ("input", "poses", ""),
    }[name]
    add = command(name, text, "room.mp4 -o out", *sections)
    text = "video file, folder of images, glob in quotes, camera index, stream URL (`run`: or none)"
    add("video", nargs="?" if name == "run" else None, help=text)
    add("-o", "--out", required=True, help="output folder")
    add("--overwrite", action="store_true", help="write into a folder that holds something else")
    if name != "poses":
        add("--detections", help=DETECTIONS_HELP)
        add("--tracks", help=TRACKS_HELP)
        add("--show", action="store_true", help="follow it live in rerun's viewer (needs rerun)")


def add_command(
    sub: Any,
    name: str,
    text: str,
    func: Command,
    example: str,
    config: Any,
    *sections: str,
) -> argparse.ArgumentParser:
    """Add a command with the flags of some sections of a config, --set, and the log options.

    Args:
        example: of its use, without the program's name.
    """
    parser: argparse.ArgumentParser = sub.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=f"Example: reobj_track.py {name} {example}",
    )
    add_flags(parser, config, sections)
    add = parser.add_argument
    if any(sections):
        add("--config", metavar="FILE", help="options from a TOML file; flags override it")
        add("--save-config", metavar="FILE", help="write the options of this run, for --config")
    more = "any other option, e.g. tracker.coast_frames=60; --options lists them"
    add("--set", action="append", metavar="SECTION.FIELD=VALUE", help=more)
    add("-v", "--verbose", action="store_true", help="say what is being done")
    add("--debug", action="store_true", help="say more, and show tracebacks")
    parser.set_defaults(func=func, config=None, save_config=None)
    return parser


def short_help(parser: argparse.ArgumentParser, words: Sequence[str]) -> str | None:
    """Return a few lines for a bare program or a bare command that needs arguments, else None."""
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    if not words:
        names = [f"  {a.dest:<10}{a.help}" for a in commands._choices_actions]
        lines = [str(parser.description), "", *names, "", str(parser.epilog)]
    elif len(words) == 1 and words[0] in commands.choices:
        own = commands.choices[words[0]]
        if not any(a.required and a.nargs != "*" for a in own._actions):
            return None
        lines = [str(own.description), str(own.epilog), f"All flags: {own.prog} --help"]
    else:
        return None
    return "\n".join(piece for line in lines for piece in wrapped(line) or [""])


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return a completion script, made by shtab.

    shtab and not argcomplete: its script is static, so that a Tab does not start Python and import
    OpenCV.
    """
    try:
        import shtab
    except ImportError as error:
        raise ReobjError("shtab is not installed: pip install 'reobj-track[completion]'") from error
    parser.prog = "reobj-track"  # the program that pip installs
    return str(shtab.complete(parser, shell))
