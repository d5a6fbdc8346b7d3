"""Names of the files of an output folder."""

from __future__ import annotations

import enum
import os
from pathlib import Path

from reobj.types import without_secrets

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
