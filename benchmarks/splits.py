"""Data splits: `splits.json` lists data for reporting and data used for choosing.

Scripts that report leave out all data not listed for reporting, with a line on stderr; --choosing
includes it, marked.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

SPLITS = json.loads((Path(__file__).resolve().parent / "splits.json").read_text())
MARK = " (choosing)"  # of what is not held out


def held_out(kind: str, name: str) -> bool:
    """Return whether a sequence is for reporting: nothing was tuned on it.

    Args:
        kind: rooms, recordings or pedestrians.
        name: of the recording or sequence; of a room `room_name`.
    """
    return name in SPLITS["reporting"][kind]


def usable(kind: str, name: str, choosing: bool) -> bool:
    """Return whether a sequence may be used; if not, print the reason on stderr.

    Args:
        choosing: include sequences that are not held out.
    """
    if held_out(kind, name) or choosing:
        return True
    why = "is not for reporting; --choosing includes it, marked"
    print(f"left out (benchmarks/splits.json): {name} {why}", file=sys.stderr)
    return False


def marked(kind: str, name: str, title: str = "") -> str:
    """Return the title of a sequence (its name), marked where it is not held out."""
    return (title or name) + ("" if held_out(kind, name) else MARK)


def add_choosing(parser: argparse.ArgumentParser) -> None:
    """Add the option --choosing."""
    text = "include data used for choosing (splits.json), marked"
    parser.add_argument("--choosing", action="store_true", help=text)


def split_name(folder: Path) -> tuple[str, str]:
    """Return the kind and the name of a folder's video: a rendered room or a recording."""
    truth = folder / "gt_objects.json"
    if truth.exists() and "config" in json.loads(truth.read_text()):
        return "rooms", room_name(folder)
    return "recordings", folder.name


def room_name(folder: Path) -> str:
    """Name a room of render_room.py by what it was made of: its seed, v before it if varied."""
    config = json.loads((folder / "gt_objects.json").read_text())["config"]
    return room_of(config["seed"], config.get("plan", ""))


def room_of(seed: int, plan: str) -> str:
    """Name a room of render_room.py by its seed and plan."""
    return ("v" if plan == "varied" else "") + str(seed)
