"""What a reader of poses returns, and what all of them use: tables, checks of rigid poses.

The formats are the business of `readers`, `colmap_model` and `pose_formats`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.cameras import WORLD_MAX, Camera
from reobj.files import load_json, read_lines
from reobj.types import Array, IntArray, ReobjError


@dataclass(frozen=True, slots=True)
class PoseFile:
    """Hold what a reader returns: N poses in the order of the file, by time where they have one.

    Attributes:
        cam_from_world: (N, 3, 4), NaN where the file says that there is no pose.
        cameras: of each pose (N,), or one of all (1,), or () where the file has none.
        names, stamps: of the images, or their times: how their frames are found.
        unit: of the stamps: s, ms, us, ns, or "" where the format does not say.
        own: the stamps are those that we wrote of the same video.
        visibility: (M, 2) row of the pose that observed a point, and row of the point.
        w_first: (N, 3, 4), or None: the same poses if the quaternions, whose order the file does
            not state, have w first; `cam_from_world` has it last then.
        kind: what the file or folder was taken for. messages: what was assumed or left out.
    """

    cam_from_world: Array
    cameras: tuple[Camera | None, ...] = ()
    names: tuple[str, ...] = ()
    stamps: Array | None = None
    unit: str = ""
    own: bool = False
    metric: bool = False
    up_in_world: Array | None = None
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    visibility: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))
    w_first: Array | None = None
    kind: str = ""
    messages: tuple[str, ...] = ()

    def with_messages(self, *messages: str) -> PoseFile:
        """Return the same with more to say."""
        return dataclasses.replace(self, messages=(*self.messages, *messages))


def lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield where each line of a text file is (for messages) and its words, without comments."""
    for number, text in enumerate(read_lines(path), 1):
        if not text.lstrip().startswith("#"):
            yield f"{path}, line {number}", text.split()


def numbers(words: Sequence[str], at: str, expected: str, finite: bool = True) -> list[float]:
    """Convert the words of a line; `at` and `expected` are for messages."""
    try:
        row = [float(word) for word in words]
    except ValueError:
        what = f"{' '.join(words)[:60]!r} is not a row of numbers"
        raise ReobjError(f"{at}: {what}; expected {expected}") from None
    if finite and not np.isfinite(row).all():
        raise ReobjError(f"{at}: a number is not finite; leave out rows of frames without pose")
    return row


def read_table(
    path: Path,
    columns: tuple[int, ...],
    expected: str,
    finite: bool = True,
    header: bool = False,
) -> tuple[Array, list[str]]:
    """Read a table of numbers.

    Args:
        columns: how many there may be. expected: what a message says. finite: refuse inf and nan.
        header: the first line may name the columns.
    Returns:
        rows: (N, C), C in `columns`. where: file and line of each.
    """
    rows: list[list[float]] = []
    where = []
    for at, words in lines(path):
        if not words:
            continue
        words = " ".join(words).replace(",", " ").split()
        if header and not rows and not is_number(words[0]):
            header = False
            continue
        row = numbers(words, at, expected, finite)
        if len(row) not in columns or (rows and len(row) != len(rows[0])):
            raise ReobjError(f"{at}: {len(row)} numbers; expected {expected}")
        rows.append(row)
        where.append(at)
    if not rows:
        raise ReobjError(f"{path}: no poses in it; expected {expected}")
    return np.array(rows), where


def is_number(word: str) -> bool:
    """Tell whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object."""
    content = load_json(path)
    if not isinstance(content, dict):
        raise ReobjError(f"{path}: expected an object with `frames` (nerfstudio) or `poses`")
    return content


POSE_TOLERANCE = 0.005  # of rotations and quaternions, in their numbers (7-Scenes: off by 1e-3)


def checked_rigid(matrix: Array, where: Sequence[str]) -> Array:
    """Check rigid transforms and orthonormalise their rotations.

    Args:
        matrix: (N, 4, 4), not finite where there is no pose. where: of each, for messages.
    Returns:
        (N, 3, 4), NaN where there is no pose.
    """
    lost = ~np.asarray(np.isfinite(matrix).all((1, 2)), bool)
    matrix = np.where(lost[:, None, None], np.eye(4), matrix)
    last_row = np.abs(matrix[:, 3] - [0, 0, 0, 1])  # (N, 4)
    what = "the last row is not 0 0 0 1; expected row-major 4x4 (transpose column-major ones)"
    raise_where(last_row.max(1) > POSE_TOLERANCE, where, what)
    check_places(matrix[:, :3, 3], where)
    rotation = matrix[:, :3, :3].clip(-2, 2)  # the squares of 1e300 are too large
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3))  # (N, 3, 3)
    what = "the 3x3 part is no rotation (rows not of length 1 and perpendicular)"
    what += "; expected a row-major rigid pose without scale"
    raise_where(error.max((1, 2)) > POSE_TOLERANCE, where, what)
    what = "the rotation is mirrored (determinant -1); turn two axes, not one"
    raise_where(np.linalg.det(rotation) < 0, where, what)
    u, _, vt = np.linalg.svd(rotation)
    exact = np.concatenate([u @ vt, matrix[:, :3, 3:]], 2)
    return np.where(lost[:, None, None], np.nan, exact)


def check_places(translation: Array, where: Sequence[str]) -> None:
    """Refuse translations (N, 3) beyond WORLD_MAX."""
    far = (np.abs(translation) >= WORLD_MAX).any(1)
    raise_where(far, where, f"more than {WORLD_MAX:g} units away from the origin")


def raise_where(bad: Any, where: Sequence[str], problem: str) -> None:
    """Refuse the input if anything in it is bad (N,): the first place and the problem."""
    if np.any(bad):
        raise ReobjError(f"{where[int(np.argmax(bad))]}: {problem}")


def from_quaternions(xyzw: Array, translation: Array, where: Sequence[str]) -> Array:
    """Make rigid transforms (N, 3, 4) of unit quaternions (N, 4) and translations (N, 3)."""
    finite = np.isfinite(np.column_stack([xyzw, translation])).all(1)
    raise_where(~finite, where, "a number is not finite")
    check_places(translation, where)
    norm = np.linalg.norm(xyzw.clip(-2, 2), axis=1)
    what = "the quaternion is not of length 1; expected the columns of the format in its order"
    raise_where(np.abs(norm - 1) > POSE_TOLERANCE, where, what)
    return np.concatenate([Rotation.from_quat(xyzw).as_matrix(), translation[:, :, None]], 2)


MAX_FOCAL_SPREAD = 0.02  # of the images of one camera, a share: autofocus (chosen)


def one_camera(cameras: Sequence[Camera | None], path: Path) -> Camera | None:
    """Return the one camera of images: the median of slightly different focal lengths.

    Raises:
        ReobjError: they differ by more than MAX_FOCAL_SPREAD, or in model or size.
    """
    found = sorted((c for c in cameras if c is not None), key=lambda c: c.params[0])
    if not found:
        return None
    kinds = sorted({f"{c.model} {c.width}x{c.height}" for c in found})
    least, most = found[0].params[0], found[-1].params[0]
    spread = (most - least) / max(abs(least), 1e-9)
    if len(kinds) > 1 or spread > MAX_FOCAL_SPREAD:
        what = ", ".join(kinds[:3]) if len(kinds) > 1 else f"focal lengths {least:.4g}-{most:.4g}"
        raise ReobjError(
            f"{path}: several different cameras took the frames ({what}); expected one: give its "
            "intrinsics with --camera, or reconstruct with a single camera"
        )
    return found[len(found) // 2]
