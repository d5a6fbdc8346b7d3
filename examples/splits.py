"""What may be reported and what was chosen on: `splits.json`, read by the scripts that report."""

from __future__ import annotations

import json
from pathlib import Path

SPLITS = json.loads((Path(__file__).resolve().parent / "splits.json").read_text())


def held_out(kind: str, name: str) -> bool:
    """Tell whether a sequence is for reporting: nothing was chosen on it.

    Args:
        kind: rooms, recordings or pedestrians.
        name: of the recording or sequence; of a room `room_name`.
    """
    return name in SPLITS["reporting"][kind]


def room_name(folder: Path) -> str:
    """Name a room of render_room.py by what it was made of: its seed, v before it if varied."""
    config = json.loads((folder / "gt_objects.json").read_text())["config"]
    return ("v" if config.get("plan") == "varied" else "") + str(config["seed"])
