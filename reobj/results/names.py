"""Names of the files of an output folder."""

from __future__ import annotations

import enum


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
    LAST_POSES = "cache/last-poses.npz"
    LAST_TRACKS = "cache/last-tracks.npz"  # before linking
