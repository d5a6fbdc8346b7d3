"""Which frame of a source an image name refers to: one rule for poses and for detections.

Names are compared from the right, folder by folder, because models and datasets store paths
relative to folders that are not known here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from reobj.types import IntArray, ReobjError


def _components(name: str | Path, suffix: bool) -> tuple[str, ...]:
    """Split a path into its components; Windows' separators count, the suffix on request."""
    path = PurePosixPath(str(name).replace("\\", "/"))
    parts = tuple(part for part in path.parts if part not in (".", "/"))
    return parts if suffix else (*parts[:-1], path.stem)


def frames_by_name(
    given: Sequence[str], images: Sequence[str | Path], where: str = "names"
) -> tuple[IntArray, str]:
    """Match names of images with the images of a source.

    The file names are compared first. Where a file name is not unique, on either side, folders are
    added from the right until it is. Suffixes are ignored only where nothing matches with them.

    Args:
        given: (N,) distinct names, with folders or without. images: (F,) paths of all images of
            the source, in the order of its frames. where: what the names belong to, for the error.
    Returns:
        frame (N,) of each name, -1: no image has that name; and the rule that matched, "" if none.
    Raises:
        ReobjError: a name fits several images, or an image several names, whatever the folders.
    """
    for suffix in (True, False):
        mine = [_components(name, suffix) for name in given]
        theirs = [_components(image, suffix) for image in images]
        deepest = max((len(parts) for parts in (*mine, *theirs)), default=0)
        clash: list[str] = []
        for depth in range(1, deepest + 1):
            keys = [parts[-depth:] for parts in mine]
            frame_of: dict[tuple[str, ...], list[int]] = {}
            for frame, parts in enumerate(theirs):
                frame_of.setdefault(parts[-depth:], []).append(frame)
            matched = [key for key in keys if key in frame_of]
            if not matched:
                break  # deeper keys match even less
            repeated = Counter(matched)
            clash = [
                "/".join(key) for key in repeated if repeated[key] > 1 or len(frame_of[key]) > 1
            ]
            if not clash:
                rule = "file names" if depth == 1 else f"file names with {depth - 1} folders"
                rule += "" if suffix else ", without suffixes"
                return np.array([frame_of.get(key, [-1])[0] for key in keys], np.int64), rule
        if clash:
            raise ReobjError(
                f"{where}: {clash[0]} is the name of several images in different folders; "
                "rename the images, or give those of one folder"
            )
    return np.full(len(given), -1, np.int64), ""
