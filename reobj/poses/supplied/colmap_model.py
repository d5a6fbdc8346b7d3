"""COLMAP models, binary and text, as poses with points.

Start at `read_colmap`.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from reobj.cameras import WORLD_MAX, Camera, import_pycolmap, read_sparse_model
from reobj.poses.intrinsics import colmap_camera
from reobj.poses.supplied.pose_formats import (
    PoseFile,
    checked_rigid,
    from_quaternions,
    lines,
    numbers,
    raise_where,
)
from reobj.types import Array, BoolArray, IntArray, ReobjError


def find_models(path: Path) -> list[Path]:
    """List the image files of the COLMAP models at a path or below it.

    Below a folder without a model: `sparse/N` and `sparse`, else `N`, else `colmap/sparse/N`.
    """
    if path.is_file():
        return [path] if path.name == "images.txt" else _model_in(path.parent)
    models = _model_in(path)
    levels = (("sparse", "sparse/*"), ("*",), ("colmap/sparse", "colmap/sparse/*"))
    for patterns in levels if not models else ():
        folders = [folder for pattern in patterns for folder in sorted(path.glob(pattern))]
        folders = [f for f in folders if f.name.isdecimal() or f.name == "sparse"]
        models = models or [model for folder in folders for model in _model_in(folder)]
    return models


def _model_in(folder: Path) -> list[Path]:
    return [p for p in (folder / "images.bin", folder / "images.txt") if p.is_file()][:1]


def read_colmap(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read a COLMAP model, binary (preferred) or text, with or without rigs; scale unknown.

    Of several models in a folder the one with the most images is read.
    """
    models = find_models(path)
    if not models:
        raise ReobjError(
            f"{path}: no images.bin or .txt; expected a COLMAP model, or transforms.json, "
            "pose/N.txt, *.pose.txt or an ARKit export in the folder; or name a file"
        )
    found = [_read_model(model) for model in models]
    count = np.array([len(one.names) for one in found])
    chosen = int(count.argmax())
    names = [str(model.parent) for model in models]
    largest = [name for name, n in zip(names, count.tolist(), strict=True) if n == count.max()]
    if len(largest) > 1:
        raise ReobjError(
            f"{path}: {' and '.join(largest)} are models of {count.max()} images each; name one of "
            "them with --poses"
        )
    others = [f"{n} ({c})" for n, c in zip(names, count.tolist(), strict=True) if c < count.max()]
    note = f"{names[chosen]} taken, the model with most images ({count.max()}), not "
    messages = (f"{path}: {note}{', '.join(others)}",) if others else ()
    form = "binary" if models[chosen].suffix == ".bin" else "text"
    folder = models[chosen].parent
    kind = f"COLMAP model ({form})" + (f" in {folder}" if folder != path else "")
    return dataclasses.replace(found[chosen], kind=kind, messages=messages)


def _read_model(images: Path) -> PoseFile:
    """Read the COLMAP model that a file of images belongs to."""
    folder = images.parent
    if images.suffix == ".txt":
        return _read_colmap_text(folder)
    try:
        _check_counts(folder)
        model = read_sparse_model(folder)
    except (ValueError, RuntimeError, LookupError, MemoryError, struct.error) as error:
        reason = str(error).splitlines()[0]
        raise ReobjError(f"{folder}: not a COLMAP model ({reason}); write it again") from None
    if not model.names:
        raise ReobjError(f"{folder}: the COLMAP model has no registered image")
    seen = np.column_stack([model.obs_image, model.obs_point])
    last_row = np.tile([0, 0, 0, 1.0], (len(model.names), 1, 1))
    where = [f"{images}, {name}" for name in model.names]
    lost = ~np.isfinite(model.cam_from_world).all((1, 2))
    raise_where(lost, where, "a number of the pose is not finite; leave out images without pose")
    poses = checked_rigid(np.concatenate([model.cam_from_world, last_row], 1), where)
    if _far(model.points).any():
        ids = sorted(import_pycolmap().Reconstruction(str(folder)).points3D)
        _check_points(model.points, ids, folder / "points3D.bin")
    return PoseFile(
        poses, tuple(model.cameras), model.names, points=model.points, colors=model.colors,
        visibility=seen,
    )  # fmt: skip


def _far(points: Array) -> BoolArray:
    """Mark points (P, 3) that are not finite, or beyond WORLD_MAX."""
    return np.asarray(~(np.abs(points) < WORLD_MAX).all(1), bool)


def _check_points(points: Array, ids: Sequence[int], path: Path) -> None:
    """Refuse points (P, 3) that are not finite or too far away; ids: of each, for the message."""
    far = _far(points)
    if far.any():
        point = points[far][0]
        fault = "is not finite"
        if np.isfinite(point).all():
            fault = f"is more than {WORLD_MAX:g} units away from the origin"
        raise ReobjError(f"{path}: point {ids[int(np.argmax(far))]} {fault}; remove it")


# Records of COLMAP's binary files: bytes before a name, or before the number of entries; the format
# of that number; bytes of an entry
RECORDS = {
    "cameras.bin": (24, "", 0),
    "images.bin": (64, "<Q", 24),  # with a name
    "points3D.bin": (43, "<Q", 8),
    "frames.bin": (64, "<I", 16),
    "rigs.bin": (8, "", 0),
}


def _check_counts(folder: Path) -> None:
    """Refuse a binary model that claims more than it contains: pycolmap allocates for the claim."""
    for name, (head, number, size) in RECORDS.items():
        if not (folder / name).exists():
            continue
        data = (folder / name).read_bytes()
        (count,) = struct.unpack_from("<Q", data)
        offset = 8
        if offset + count * head > len(data):
            raise ValueError(f"{name} claims {count} records in {len(data)} bytes")
        for _ in range(count if number else 0):
            offset += head
            if name == "images.bin":
                offset = data.index(b"\0", offset) + 1
            (n,) = struct.unpack_from(number, data, offset)
            offset += struct.calcsize(number) + n * size
            if offset > len(data):
                raise ValueError(f"{name} claims {n} entries in {len(data)} bytes")


def _read_colmap_text(folder: Path) -> PoseFile:
    """Read a COLMAP text model, also one without points or observations.

    Many tools leave out points3D.txt, which pycolmap refuses, or the line of observations after
    each image, where pycolmap takes every other image for observations.
    """
    cameras = _colmap_text_cameras(folder / "cameras.txt")
    names = []
    used = []
    where = []
    rows: list[list[float]] = []
    row_of: dict[str, int] = {}
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    observations_next = False
    for at, words in lines(folder / "images.txt"):
        triples = len(words) % 3 == 0 and all(w.lstrip("-").isdigit() for w in words[2::3])
        if not words or (observations_next and triples):
            observations_next = False
            continue
        if len(words) < 10:
            raise ReobjError(f"{at}: expected {expected}")
        if words[8] not in cameras:
            raise ReobjError(f"{at}: no camera {words[8]} in cameras.txt")
        row_of[words[0]] = len(rows)
        rows.append(numbers(words[1:8], at, expected))
        names.append(" ".join(words[9:]))
        used.append(cameras[words[8]])
        where.append(at)
        observations_next = True
    if not rows:
        raise ReobjError(f"{folder / 'images.txt'}: no images in it")
    quaternion_wxyz, translation = np.split(np.array(rows), [4], axis=1)  # (N, 4), (N, 3)
    poses = from_quaternions(np.roll(quaternion_wxyz, -1, 1), translation, where)
    xyz, colors, seen = _colmap_text_points(folder / "points3D.txt", row_of)
    return PoseFile(poses, tuple(used), tuple(names), points=xyz, colors=colors, visibility=seen)


def _colmap_text_cameras(path: Path) -> dict[str, Camera]:
    """Read cameras.txt: camera of each id."""
    cameras = {}
    for at, words in lines(path):
        try:
            if words:
                cameras[words[0]] = colmap_camera(words[1:])
        except (ValueError, TypeError) as error:
            reason = f" ({error})" if isinstance(error, ReobjError) else ""
            expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], with COLMAP's models"
            raise ReobjError(f"{at}: expected {expected}{reason}") from None
    return cameras


def _colmap_text_points(
    path: Path, row_of: dict[str, int]
) -> tuple[Array, npt.NDArray[np.uint8], IntArray]:
    """Read a points3D.txt, if it exists, by ascending id.

    Args:
        row_of: row of each image id.
    Returns:
        points (P, 3), their colours (P, 3), and (M, 2) rows of images and of points they observed.
    """
    rows: list[list[float]] = []
    tracks = list[list[int]]()
    expected = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    for at, words in lines(path) if path.exists() else ():
        if words and len(words) < 8:
            raise ReobjError(f"{at}: expected {expected}")
        if words:
            rows.append(numbers(words[:7], at, expected, finite=False))
            if not np.isfinite(rows[-1][:1] + rows[-1][4:]).all():
                raise ReobjError(f"{at}: a number is not finite; expected {expected}")
            tracks.append([row_of[i] for i in words[8::2] if i in row_of])
    table = np.array(rows).reshape(-1, 7)
    order = np.argsort(table[:, 0], kind="stable")
    seen = [(image, point) for point, row in enumerate(order) for image in tracks[row]]
    table = table[order]
    _check_points(table[:, 1:4], table[:, 0].astype(np.int64).tolist(), path)
    colors = table[:, 4:].clip(0, 255).astype(np.uint8)
    return table[:, 1:4], colors, np.array(seen, np.int64).reshape(-1, 2)
