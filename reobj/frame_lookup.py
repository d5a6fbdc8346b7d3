"""Match image names of pose and detection files to the frames of a source.

Names are compared from the right, folder by folder, because models and datasets store paths
relative to unknown folders.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from reobj.types import IntArray, ReobjError


def _components(name: str | Path, suffix: bool) -> tuple[str, ...]:
    """Split a path, also of Windows, into its components; the last one with or without suffix."""
    path = PurePosixPath(str(name).replace("\\", "/"))
    components = tuple(part for part in path.parts if part not in (".", "/"))
    return components if suffix else (*components[:-1], path.stem)


def frames_by_name(
    given: Sequence[str], images: Sequence[str | Path], where: str = "names"
) -> tuple[IntArray, str]:
    """Match names of images to the images of a source.

    The file names are compared first. Where a file name is not unique, on either side, folders are
    added from the right until it is. Suffixes are ignored if no name matches with its suffix.

    Args:
        given: (N,) distinct names, with or without folders. images: (F,) paths of all images of
            the source, in the order of its frames. where: source of the names, for the error.
    Returns:
        frame (N,) of each name, -1: no image has that name; and the rule that matched, "" if none.
    Raises:
        ReobjError: with any number of folders a name matches several images, or an image several
            names.
    """
    for suffix in (True, False):
        given_paths = [_components(name, suffix) for name in given]
        image_paths = [_components(image, suffix) for image in images]
        deepest = max((len(path) for path in (*given_paths, *image_paths)), default=0)
        clash: list[str] = []
        for depth in range(1, deepest + 1):
            keys = [path[-depth:] for path in given_paths]
            frame_of: dict[tuple[str, ...], list[int]] = {}
            for frame, path in enumerate(image_paths):
                frame_of.setdefault(path[-depth:], []).append(frame)
            matched = [key for key in keys if key in frame_of]
            if not matched:
                break  # longer keys match no better
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
                "rename the images, or give the images of one folder only"
            )
    return np.full(len(given), -1, np.int64), ""
