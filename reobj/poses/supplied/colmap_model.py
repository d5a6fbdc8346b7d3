"""COLMAP models, binary and text, as poses with points. pycolmap reads them.

Start at `read_colmap`.
"""

from __future__ import annotations

import dataclasses
import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np

from reobj.cameras import WORLD_MAX, import_pycolmap, read_sparse_model
from reobj.files import read_lines
from reobj.poses.supplied.pose_formats import (
    POSE_TOLERANCE,
    PoseFile,
    checked_rigid,
    homogeneous,
    raise_where,
)
from reobj.types import ReobjError

UPRIGHT = "upright.txt"  # file in our models: their cameras are those of upright photos


def find_models(path: Path) -> list[Path]:
    """List the image files of the COLMAP models at a path or below it.

    Below a folder without a model: `sparse/N` and `sparse`, else `N`, else `colmap/sparse/N`.
    """
    if path.is_file():
        return [path] if path.stem == "images" else _model_in(path.parent)
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

    Raises:
        ReobjError: none, several, or one of which a file is missing.
    """
    models = find_models(path)
    if len(models) > 1:
        names = " and ".join(str(model.parent) for model in models)
        raise ReobjError(f"{path}: several COLMAP models: {names}; name one of them with --poses")
    lacking = [models[0].with_stem("cameras").name] if models else ["images.bin"]
    if not models or not models[0].with_name(lacking[0]).is_file():
        raise ReobjError(f"{path}: no {lacking[0]} beside it; a COLMAP model is a folder with "
                         "cameras, images and points3D: give that folder")  # fmt: skip
    found = _read_model(models[0])
    form = "binary" if models[0].suffix == ".bin" else "text"
    folder = models[0].parent
    kind = f"({form})" + (f" in {folder}" if folder not in (path, path.parent) else "")
    stored = not (folder / UPRIGHT).exists()
    return dataclasses.replace(found, kind=kind, stored_pixels=stored)


def _read_model(images: Path) -> PoseFile:
    """Read the COLMAP model that a file of images belongs to."""
    folder = images.parent
    with tempfile.TemporaryDirectory() as copy:
        try:
            if images.suffix == ".bin":
                _check_counts(folder)
                names = dict[str, str]()
            else:
                names = _copy_text(folder, Path(copy))
                folder = Path(copy)
            model = read_sparse_model(folder)
            far = ~(np.abs(model.points) < WORLD_MAX).all(1)  # (P,) also NaN
            ids = import_pycolmap().Reconstruction(str(folder)).points3D if far.any() else ()
        except ReobjError:
            raise
        except (ValueError, RuntimeError, LookupError, MemoryError, struct.error) as error:
            reason = str(error).splitlines()[0].rpartition("] ")[2]
            reason = "a record is damaged" if reason.startswith("Check failed") else reason
            raise ReobjError(
                f"{images.parent}: not a COLMAP model ({reason}); write it again"
            ) from None
    if not model.names:
        raise ReobjError(f"{images.parent}: the COLMAP model has no registered image")
    names_of = tuple(names.get(name, name) for name in model.names)
    where = [f"{images}, {name}" for name in names_of]
    lost = ~np.isfinite(model.cam_from_world).all((1, 2))
    raise_where(lost, where, "a number of the pose is not finite; leave out images without pose")
    if far.any():
        number = sorted(ids)[int(np.argmax(far))]
        fault = f"not finite, or more than {WORLD_MAX:g} units away from the origin"
        raise ReobjError(f"{images.with_stem('points3D')}: point {number} is {fault}; remove it")
    return PoseFile(
        checked_rigid(homogeneous(model.cam_from_world), where), tuple(model.cameras), names_of,
        points=model.points, colors=model.colors,
        visibility=np.column_stack([model.obs_image, model.obs_point]),
    )  # fmt: skip


def _copy_text(folder: Path, copy: Path) -> dict[str, str]:
    """Copy a text model, completed: pycolmap refuses or misreads what other tools leave out.

    These are points3D.txt, and the line of observations after each image. Observations of missing
    points are left out, and names replaced by ids: pycolmap ends a name at its first space.

    Returns:
        the name of each image by its id.
    """
    for file in folder.glob("*.txt"):
        shutil.copy(file, copy)
    points = copy / "points3D.txt"
    points.touch()
    known = {"-1", *(line.split(maxsplit=1)[0] for line in read_lines(points) if line.strip())}
    names = dict[str, str]()
    lines = list[str]()
    observations_next = False
    for number, line in enumerate(read_lines(folder / "images.txt"), 1):
        words = line.split()
        triples = len(words) % 3 == 0 and all(w.lstrip("-").isdigit() for w in words[2::3])
        if line.startswith("#") or not words or (observations_next and triples):
            if observations_next and words and known.issuperset(words[2::3]):
                lines[-1] = line
            observations_next &= line.startswith("#")
            continue
        where = f"{folder / 'images.txt'}, line {number}"
        try:
            norm = np.linalg.norm([float(word) for word in words[1:5]])
            names[words[0]] = line.split(maxsplit=9)[9].strip()
        except (ValueError, IndexError):
            expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise ReobjError(f"{where}: expected {expected}") from None
        raise_where([not abs(norm - 1) <= POSE_TOLERANCE], [where], "quaternion not of length 1")
        lines += [" ".join([*words[:9], words[0]]) + "\n", "\n"]
        observations_next = True
    (copy / "images.txt").write_text("".join(lines))
    return names


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
    """Refuse a binary model that claims more than it contains: pycolmap reads without end."""
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
