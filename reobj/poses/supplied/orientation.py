"""EXIF orientations: cameras of the stored pixels are turned with the photos, which are upright."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reobj.cameras import Camera, camera_parameters
from reobj.poses.supplied.frame_assignment import SourceFrames
from reobj.sources.image_files import exif_orientation
from reobj.types import Array, IntArray, ReobjError

# upright_from_stored (2, 2): of offsets from the middle of the image
TURNS = {3: -np.eye(2), 6: np.array([[0.0, -1], [1, 0]]), 8: np.array([[0.0, 1], [-1, 0]])}


def turns_of(
    source: SourceFrames, size: tuple[int, int], cameras: Sequence[Camera | None], row: IntArray
) -> dict[int, Array]:
    """Return the turns (2, 2) of the photos with an EXIF orientation, by frame row.

    A camera of the shape of the upright photos, where a turn by 90 deg changes it, is not turned.

    Args:
        size: (w, h) of the upright photos.
        cameras: of the stored pixels, of each pose. row: (F,) pose of each frame, -1: none.
    """
    turns: dict[int, Array] = {}
    for f in np.flatnonzero(row >= 0).tolist() if source.images else ():
        path = Path(source.images[int(source.frame[f])])
        orientation = exif_orientation(path)
        camera = cameras[row[f]]
        if orientation == 1 or camera is None:
            continue
        if orientation not in TURNS:
            raise ReobjError(
                f"{path}: a mirrored EXIF orientation ({orientation}), which COLMAP ignores; store "
                "the photos upright, without EXIF orientation, and reconstruct them again"
            )
        is_upright = size[0] != size[1] and (camera.width > camera.height) == (size[0] > size[1])
        if orientation == 3 or not is_upright:
            turns[f] = TURNS[orientation]
    return turns


def turned(camera: Camera | None, turn: Array | None) -> Camera | None:
    """Return the camera of the turned images; turn: (2, 2) of TURNS, or None."""
    if camera is None or turn is None:
        return camera
    names = camera_parameters(camera.model)
    if unknown := [n for n in names if not re.fullmatch(r"[fc][xy]?|k\d?|p[12]|s[xy]1|omega", n)]:
        raise ReobjError(
            f"a {camera.model} camera is not turned with the EXIF orientation of its photos "
            f"({', '.join(unknown)}); store them upright and reconstruct them again"
        )
    values = dict(zip(names, camera.params, strict=True))
    stored = np.array([camera.width, camera.height])
    size = np.abs(turn @ stored).astype(int)
    # distortion (p2, p1) r^2 + 2 ((p2, p1) x) x and (sx1, sy1) r^2: vectors of the image
    for x, y in (("p2", "p1"), ("sx1", "sy1")):
        if x in values:
            values[x], values[y] = turn @ [values[x], values[y]]
    if "fx" in values:
        values["fx"], values["fy"] = np.abs(turn @ [values["fx"], values["fy"]])
    centre = turn @ (np.array([values["cx"], values["cy"]]) - stored / 2) + size / 2
    values["cx"], values["cy"] = centre
    width, height = size.tolist()
    return Camera(camera.model, width, height, tuple(float(values[name]) for name in names))
