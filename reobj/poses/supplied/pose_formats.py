"""Pose files of other tools and datasets: one small reader per format, listed in `readers.READERS`.

All convert their conventions to cam_from_world, OpenCV axes, COLMAP pixels.
"""

from __future__ import annotations

import dataclasses
import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.cameras import CV_FROM_GL, WORLD_MAX, Camera, invert_rigid
from reobj.files import MEMORY_MAX, check_unpacked, load_json, read_lines
from reobj.poses.intrinsics import (
    brown_camera,
    camera_from_json,
    camera_from_yaml,
    image_side,
    read_yaml,
)
from reobj.types import Array, IntArray, ReobjError

# ---- Result of a reader, and checks of all readers -----------------------------------------------


@dataclass(frozen=True, slots=True)
class PoseFile:
    """Content of a pose file: N poses in the order of the file, by time where they have one.

    Attributes:
        cam_from_world: (N, 3, 4), NaN where the file marks a missing pose.
        cameras: of each pose (N,), or one of all (1,), or () where the file has none.
        names, stamps: image names or times, by which poses are assigned to frames.
        unit: of the stamps: s, ms, us, ns, or "" if the format does not specify it.
        is_ours: this tool wrote the stamps, for the same video.
        visibility: (M, 2) row of the pose that observed a point, and row of the point.
        w_first: (N, 3, 4), or None: the poses if the quaternions have w first, where the file does
            not specify the order; `cam_from_world` assumes w last.
        kind: name of the format. messages: what was assumed or left out.
    """

    cam_from_world: Array
    cameras: tuple[Camera | None, ...] = ()
    names: tuple[str, ...] = ()
    stamps: Array | None = None
    unit: str = ""
    is_ours: bool = False
    metric: bool = False
    up_in_world: Array | None = None
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    visibility: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))
    w_first: Array | None = None
    kind: str = ""
    messages: tuple[str, ...] = ()

    def with_messages(self, *messages: str) -> PoseFile:
        """Return a copy with more messages."""
        return dataclasses.replace(self, messages=(*self.messages, *messages))


def lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield location (for messages) and words of each line of a text file, without comments."""
    for number, text in enumerate(read_lines(path), 1):
        if not text.lstrip().startswith("#"):
            yield f"{path}, line {number}", text.split()


def numbers(words: Sequence[str], where: str, expected: str, finite: bool = True) -> list[float]:
    """Convert the words of a line; `where` and `expected` are for messages."""
    try:
        row = [float(word) for word in words]
    except ValueError:
        text = " ".join(words)[:60]
        raise ReobjError(
            f"{where}: {text!r} is not a row of numbers; expected {expected}"
        ) from None
    if finite and not np.isfinite(row).all():
        raise ReobjError(f"{where}: a number is not finite; leave out rows of frames without pose")
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
        columns: numbers of columns that are allowed. expected: for messages. finite: refuse inf and
            nan. header: the first line may name the columns.
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
    """True if a word is a number."""
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


POSE_TOLERANCE = 0.005  # of entries of rotations and quaternions (7-Scenes: off by 1e-3)


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
    raise_where(
        last_row.max(1) > POSE_TOLERANCE,
        where,
        "the last row is not 0 0 0 1; expected row-major 4x4 (transpose column-major ones)",
    )
    check_positions(matrix[:, :3, 3], where)
    rotation = matrix[:, :3, :3].clip(-2, 2)  # the squares of 1e300 are too large
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3))  # (N, 3, 3)
    raise_where(
        error.max((1, 2)) > POSE_TOLERANCE,
        where,
        "the 3x3 block is not a rotation (rows not of length 1 and perpendicular); expected a "
        "row-major rigid pose without scale",
    )
    raise_where(
        np.linalg.det(rotation) < 0,
        where,
        "the rotation is mirrored (determinant -1); flip two axes, not one",
    )
    u, _, vt = np.linalg.svd(rotation)
    exact = np.concatenate([u @ vt, matrix[:, :3, 3:]], 2)
    return np.where(lost[:, None, None], np.nan, exact)


def check_positions(translation: Array, where: Sequence[str]) -> None:
    """Refuse translations (N, 3) beyond WORLD_MAX."""
    far = (np.abs(translation) >= WORLD_MAX).any(1)
    raise_where(far, where, f"more than {WORLD_MAX:g} units away from the origin")


def raise_where(bad: Any, where: Sequence[str], problem: str) -> None:
    """Raise the problem with the location of the first bad (N,) input, if any."""
    if np.any(bad):
        raise ReobjError(f"{where[int(np.argmax(bad))]}: {problem}")


def from_quaternions(xyzw: Array, translation: Array, where: Sequence[str]) -> Array:
    """Make rigid transforms (N, 3, 4) of unit quaternions (N, 4) and translations (N, 3)."""
    finite = np.isfinite(np.column_stack([xyzw, translation])).all(1)
    raise_where(~finite, where, "a number is not finite")
    check_positions(translation, where)
    norm = np.linalg.norm(xyzw.clip(-2, 2), axis=1)
    raise_where(
        np.abs(norm - 1) > POSE_TOLERANCE,
        where,
        "the quaternion is not of length 1; expected the columns of the format in its order",
    )
    return np.concatenate([Rotation.from_quat(xyzw).as_matrix(), translation[:, :, None]], 2)


MAX_FOCAL_SPREAD = 0.02  # relative, over the images of one camera: autofocus (chosen)


def one_camera(cameras: Sequence[Camera | None], path: Path) -> Camera | None:
    """Return the single camera of images: the median of slightly different focal lengths.

    Raises:
        ReobjError: they differ by more than MAX_FOCAL_SPREAD, or in model or size.
    """
    found = sorted((c for c in cameras if c is not None), key=lambda c: c.params[0])
    if not found:
        return None
    kinds = sorted({f"{c.model} {c.width}x{c.height}" for c in found})
    least = found[0].params[0]
    most = found[-1].params[0]
    spread = (most - least) / max(abs(least), 1e-9)
    if len(kinds) > 1 or spread > MAX_FOCAL_SPREAD:
        cameras_text = f"focal lengths {least:.4g}-{most:.4g}"
        if len(kinds) > 1:
            cameras_text = ", ".join(kinds[:3])
        raise ReobjError(
            f"{path}: several different cameras took the frames ({cameras_text}); expected one: "
            "give its intrinsics with --camera, or reconstruct with a single camera"
        )
    return found[len(found) // 2]


Y_UP = np.array([0, 1.0, 0])
Z_UP = np.array([0, 0, 1.0])


# ---- Tables: TUM, ORB-SLAM3, EuRoC, rows of matrices ---------------------------------------------


def read_rows(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read a table by its columns: 8 (TUM, ORB-SLAM3, EuRoC), 12 or 16 (matrices), 17 (EuRoC)."""
    expected = "TUM rows t tx ty tz qx qy qz qw, or 12 or 16 numbers (world_from_cam, row by row)"
    rows, where, header = _table(path, (8, 12, 16, 17), expected)
    if rows.shape[1] in (12, 16):
        return read_matrices(path, size)
    named = _named_columns(header, rows.shape[1])
    text = next(line for line in read_lines(path)[::-1] if line.strip())
    in_ns = abs(rows[0, 0]) >= 1e15  # in us this is the year 2001, in ms 33,658
    if rows.shape[1] == 17 or "_RS_" in header or ("," in text and in_ns and named is None):
        return read_euroc(path, size)
    found = read_tum(path, size)
    if "," in text and named is None:  # TUM and ORB-SLAM3 write spaces, EuRoC commas
        kept = _by_time(rows[:, 0], path)[0]
        other = from_quaternions(np.roll(rows[:, 4:], -1, 1), rows[:, 1:4], where)
        return dataclasses.replace(found, w_first=invert_rigid(other)[kept])
    return found


def _table(path: Path, columns: tuple[int, ...], expected: str) -> tuple[Array, list[str], str]:
    """Read a table of numbers with commas or spaces, and its header: comments, column names."""
    rows, where = read_table(path, columns, expected, header=True)
    first = int(where[0].rpartition(" ")[2])  # line of the first row
    return rows, where, "".join(read_lines(path)[: first - 1])


def _named_columns(header: str, count: int) -> list[int] | None:
    """Find x, y, z and the quaternion x, y, z, w among `count` columns by their names.

    Returns:
        indices (7,); None where no line of the header names them all.
    """
    for line in header.lower().splitlines()[::-1]:
        words = re.sub(r"\[.*?\]|\(.*?\)", "", line).replace(",", " ").lstrip("# ").split()
        column_of: dict[str, int] = {}
        for i, word in enumerate(words):
            found = re.fullmatch(
                r"(q|rot|orient|p|t|pos|trans|)[a-z]*?[._]?(?:rs_)?(?:r_)?([xyzw])", word
            )
            if found:
                turn = "q" if found[1] in ("q", "rot", "orient") else ""
                column_of.setdefault(turn + found[2], i)
        wanted = ("x", "y", "z", "qx", "qy", "qz", "qw")
        if len(words) == count and all(name in column_of for name in wanted):
            return [column_of[name] for name in wanted]
    return None


def read_tum(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read TUM rows: time, world_from_cam, w last; metres unless our own header says arbitrary.

    Column names in the header override this order.
    """
    rows, where, header = _table(path, (8,), "TUM rows: t tx ty tz qx qy qz qw")
    columns = _named_columns(header, 8) or list(range(1, 8))
    world_from_cam = from_quaternions(rows[:, columns[3:]], rows[:, columns[:3]], where)
    kept, messages = _by_time(rows[:, 0], path)
    is_ours = "(world_from_cam, seconds, units: " in header  # of `cameras.write_tum`
    return PoseFile(
        invert_rigid(world_from_cam)[kept], stamps=rows[kept, 0], is_ours=is_ours,
        metric=not re.search("#.*units: arbitrary", header), kind="TUM rows", messages=messages,
    )  # fmt: skip


def _by_time(stamps: Array, path: Path) -> tuple[IntArray, tuple[str, ...]]:
    """Return the rows (n,) by ascending stamp, without repeated ones, and a message about these."""
    kept = np.unique(stamps, return_index=True)[1]
    repeated = len(stamps) - len(kept)
    if not repeated:
        return kept, ()
    return kept, (f"{path}: {repeated} rows repeat a time stamp and are left out",)


def read_euroc(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read EuRoC's CSV of 8 or 17 columns: ns, world_from_body, quaternion w first; metres.

    `T_BS` in the camera's sensor.yaml, beside it or in cam0 beside its folder, is body_from_cam;
    without one the body is taken for the camera, with a message.
    """
    path = path / "data.csv" if path.is_dir() else path
    rows, where, header = _table(path, (8, 17), "EuRoC rows: ns, x, y, z, qw, qx, qy, qz[, 9 more]")
    columns = _named_columns(header, rows.shape[1]) or [1, 2, 3, 5, 6, 7, 4]
    world_from_cam = from_quaternions(rows[:, columns[3:]], rows[:, columns[:3]], where)
    kept, messages = _by_time(rows[:, 0], path)
    camera = None
    sensor = _sensor_of(path)
    if sensor is None:
        messages += (
            f"{path}: poses of the body, and no sensor.yaml with the camera's T_BS beside it: body "
            "taken for camera",
        )
    else:
        data = read_yaml(sensor)
        try:
            matrix = np.array(data["T_BS"]["data"], np.float64).reshape(1, 4, 4)
        except (KeyError, TypeError, ValueError):
            raise ReobjError(f"{sensor}: expected T_BS with data of 16 numbers") from None
        body_from_cam = checked_rigid(matrix, [f"{sensor}, T_BS"])[0]
        turn = world_from_cam[:, :, :3]
        centre = turn @ body_from_cam[:, 3:] + world_from_cam[:, :, 3:]
        world_from_cam = np.concatenate([turn @ body_from_cam[:, :3], centre], 2)
        camera = camera_from_yaml(data, size)
    return PoseFile(
        invert_rigid(world_from_cam)[kept], () if camera is None else (camera,),
        stamps=rows[kept, 0], unit="ns", metric=True, kind="EuRoC rows", messages=messages,
    )  # fmt: skip


def _sensor_of(path: Path) -> Path | None:
    """Find the sensor.yaml of a camera: in the folder of the poses, or in cam0 near it."""
    near = (path.parent, *(folder / "cam0" for folder in (path.parent.parent, path.parent)))
    for sensor in (folder / "sensor.yaml" for folder in near):
        if sensor.is_file() and read_yaml(sensor).get("sensor_type", "camera") == "camera":
            return sensor
    return None


def read_matrices(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read rows of 12 (KITTI) or 16 numbers (Replica, NICE-SLAM): world_from_cam, OpenCV axes."""
    rows, where = matrix_rows(path)
    return PoseFile(invert_rigid(checked_rigid(rows, where)), metric=True, kind="rows of matrices")


def matrix_rows(path: Path) -> tuple[Array, list[str]]:
    """Read rows of 12 or 16 numbers: matrices (N, 4, 4), not finite where lost, and locations."""
    rows, where = read_table(path, (12, 16), "12 or 16 numbers a row", finite=False)
    whole = np.tile(np.eye(4), (len(rows), 1, 1))
    whole.reshape(-1, 16)[:, : rows.shape[1]] = rows
    return whole, where


def read_traj(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ARKitScenes' .traj: s, axis-angle, translation of cam_from_world; .pincam beside it."""
    path = next(iter(sorted(path.glob("*.traj"))), path) if path.is_dir() else path
    rows, where = read_table(path, (7,), "ARKitScenes rows: t rx ry rz tx ty tz")
    kept, messages = _by_time(rows[:, 0], path)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rows[:, 1:4]).as_matrix()
    poses[:, :3, 3] = rows[:, 4:]
    files = sorted(path.parent.glob("*_intrinsics/*.pincam")) or sorted(
        path.parent.glob("*.pincam")
    )
    cameras = []
    for file in files:
        (width, height, *params), *_ = read_table(file, (6,), "w h fx fy cx cy")[0].tolist()
        cameras.append(Camera("PINHOLE", image_side(width), image_side(height), tuple(params)))
    return PoseFile(
        checked_rigid(poses, where)[kept], tuple(cameras), stamps=rows[kept, 0], unit="s",
        metric=True, up_in_world=Z_UP, kind="ARKitScenes poses", messages=messages,
    )  # fmt: skip


# ---- Phones --------------------------------------------------------------------------------------


def read_stray(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read Stray Scanner's folder: odometry.csv, camera_matrix.csv; world_from_cam, y up, metres.

    OpenCV axes, quaternion x first, a row for each frame of rgb.mp4, numbered from 0.
    """
    path = path / "odometry.csv" if path.is_dir() else path
    head, *records = [line for line in read_lines(path) if line.strip()]
    columns = [word.strip().lower() for word in head.split(",")]
    wanted = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")
    if missing := [name for name in wanted if name not in columns]:
        raise ReobjError(f"{path}: no column {', '.join(missing)}; expected {', '.join(wanted)}")
    indices = [columns.index(name) for name in wanted]
    where = [f"{path}, line {i}" for i in range(2, len(records) + 2)]
    table = []
    for text, line in zip(records, where, strict=True):
        words = text.split(",")
        if len(words) <= max(indices):
            raise ReobjError(f"{line}: {len(words)} columns; expected {len(columns)}")
        table.append(numbers([words[i] for i in indices], line, ", ".join(wanted)))
    rows = np.array(table).reshape(-1, 8)
    world_from_cam = from_quaternions(rows[:, 4:], rows[:, 1:4], where)
    names = tuple(f"{number:06d}" for number in rows[:, 0].astype(int).tolist())
    matrix = path.with_name("camera_matrix.csv")
    cameras = list[Camera]()
    if matrix.is_file():
        K = read_table(matrix, (3,), "3 rows of 3 numbers")[0]
        raise_where([K.shape != (3, 3)], [str(matrix)], "expected 3 rows of 3 numbers")
        cameras.append(brown_camera(_size_of(K, size), K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return PoseFile(
        invert_rigid(world_from_cam), tuple(cameras), names, metric=True, up_in_world=Y_UP,
        kind="Stray Scanner folder",
    )  # fmt: skip


def _size_of(K: Array, size: tuple[int, int]) -> tuple[int, int]:
    """Return the size of the images of a matrix K: that of the frames, or the native one of ARKit.

    The principal point is near the middle of the right one.
    """
    native = (1920, 1440)  # in landscape
    offset = [np.abs(2 * K[:2, 2] / some - 1).max() for some in (size, native)]
    return size if offset[0] <= offset[1] else native


def read_record3d(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read Record3D's metadata: `poses` qx qy qz qw tx ty tz, world_from_cam, OpenGL axes, y up.

    The file `metadata`, its folder, or an .r3d, which is a zip of the folder.
    """
    path = path / "metadata" if path.is_dir() else path
    data = _metadata_of_r3d(path) if path.suffix.lower() == ".r3d" else json_object(path)
    try:
        rows = np.array(data["poses"], np.float64).reshape(-1, 7)
        fx, fy, cx, cy = (float(data["K"][i]) for i in (0, 4, 6, 7))
        camera = Camera("PINHOLE", image_side(data["w"]), image_side(data["h"]), (fx, fy, cx, cy))
    except (KeyError, TypeError, ValueError, IndexError):
        raise ReobjError(
            f"{path}: no Record3D metadata; expected numbers poses (N x 7), K (9), w and h"
        ) from None
    where = [f"{path}, poses[{i}]" for i in range(len(rows))]
    world_from_gl = from_quaternions(rows[:, :4], rows[:, 4:], where)
    poses = CV_FROM_GL @ invert_rigid(world_from_gl)
    return PoseFile(poses, (camera,), metric=True, up_in_world=Y_UP, kind="Record3D metadata")


def _metadata_of_r3d(path: Path) -> dict[str, Any]:
    """Read the metadata in an .r3d file."""
    try:
        with zipfile.ZipFile(path) as file:
            name = next(n for n in file.namelist() if n.rpartition("/")[2] == "metadata")
            check_unpacked(file.getinfo(name).file_size, MEMORY_MAX // 8)
            data = json.loads(file.read(name))
    except (zipfile.BadZipFile, StopIteration, OSError, ValueError, RecursionError) as error:
        raise ReobjError(f"{path}: not an .r3d of Record3D: no JSON `metadata` in it") from error
    if not isinstance(data, dict):
        raise ReobjError(f"{path}: `metadata` is not a JSON object")
    return data


def read_scannet(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ScanNet's `pose/<frame>.txt` (z up) or 7-Scenes' `*.pose.txt`: 4x4 world_from_cam.

    Metres; inf: no pose. ScanNet's intrinsics have the centre of the first pixel at (0, 0).
    """
    path = path.parent if path.name == "pose" else path
    folder = path / "pose" if (path / "pose").is_dir() else path
    files = sorted(f for f in folder.glob("*.txt") if re.search(r"(\d|\.pose)$", f.stem))
    if not files:
        raise ReobjError(f"{folder}: no <frame number>.txt in it; expected a ScanNet pose folder")
    where = [str(file) for file in files]
    expected = "4 rows of 4 numbers"
    tables = [read_table(file, (4,), expected, finite=False)[0] for file in files]
    raise_where([len(table) != 4 for table in tables], where, f"expected {expected}")
    world_from_cam = checked_rigid(np.array(tables), where)
    intrinsic = path / "intrinsic" / "intrinsic_color.txt"
    camera = None
    if intrinsic.exists():
        K, where_K = read_table(intrinsic, (3, 4), "a 3x3 or 4x4 matrix")
        raise_where([len(K) != K.shape[1]], where_K, f"{len(K)} rows, expected 3x3 or 4x4")
        camera = Camera("PINHOLE", *size, (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    up = Z_UP if folder.name == "pose" else None
    names = tuple(file.stem for file in files)
    kind = "ScanNet poses" if folder.name == "pose" else "7-Scenes poses"
    poses = invert_rigid(world_from_cam)
    cameras = () if camera is None else (camera,)
    return PoseFile(poses, cameras, names, metric=True, up_in_world=up, kind=kind)


def arkit_files(path: Path) -> list[Path]:
    """List the camera files, one per image, of a raw export of an app that uses ARKit."""
    polycam = [path / "keyframes" / name for name in ("corrected_cameras", "cameras")]
    found = [sorted(path.glob("frame_*.json")), *(sorted(p.glob("*.json")) for p in polycam)]
    return next((files for files in found if files), [])


def read_arkit(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read a raw export of Polycam or of 3D Scanner App: a JSON file for each image.

    world_from_cam row by row, `t_00` to `t_23` or `cameraPoseARFrame`; ARKit's axes (those of
    OpenGL), metres, y up.
    """
    files = arkit_files(path)
    if not files:
        raise ReobjError(f"{path}: no frame_*.json, nor keyframes/cameras/*.json in it")
    data = [json_object(file) for file in files]
    where = [str(file) for file in files]
    matrices = []
    cameras = []
    for file, entry in zip(where, data, strict=True):
        try:
            rows = entry.get("cameraPoseARFrame") or [
                entry[f"t_{i}{j}"] for i in range(3) for j in range(4)
            ]
            matrices.append(np.array([*rows, 0, 0, 0, 1][:16], np.float64).reshape(4, 4))
            cameras.append(camera_from_json(entry, size))
        except (KeyError, TypeError, ValueError):
            raise ReobjError(
                f"{file}: no camera; expected numbers 4x4 cameraPoseARFrame or t_00 to t_23, and "
                "intrinsics"
            ) from None
    poses = CV_FROM_GL @ invert_rigid(checked_rigid(np.array(matrices), where))
    names = tuple(path.stem for path in files)
    kind = "raw ARKit export"
    return PoseFile(poses, tuple(cameras), names, metric=True, up_in_world=Y_UP, kind=kind)


def read_transforms(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read nerfstudio's or instant-ngp's transforms.json: world_from_cam, OpenGL axes; no scale.

    nerfstudio transformed the world by `applied_transform` A; this is undone:
    world_from_cv = inv(A) world_from_gl diag(1, -1, -1, 1).
    """
    path = path / "transforms.json" if path.is_dir() else path
    data = json_object(path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ReobjError(f"{path}: no `frames`; expected nerfstudio's or ngp's transforms.json")
    where = [f"{path}, frames[{i}]" for i in range(len(frames))]
    matrices = list[Array]()
    names = list[str]()
    cameras = list[Camera | None]()
    for key, frame in zip(where, frames, strict=True):
        try:
            matrices.append(np.array(frame["transform_matrix"], np.float64).reshape(4, 4))
            names.append(str(frame["file_path"]))
            cameras.append(camera_from_json({**data, **frame}, size))
        except ReobjError as error:
            raise ReobjError(f"{key}: {error}") from None
        except (KeyError, TypeError, ValueError, IndexError):
            expected = "a 4x4 transform_matrix, file_path, and intrinsics that are numbers"
            raise ReobjError(f"{key}: expected {expected}") from None
    applied = np.eye(4)
    try:
        applied[:3] = np.array(data.get("applied_transform", applied), np.float64)[:3]
    except (TypeError, ValueError, IndexError):
        applied[:] = np.nan
    if not np.isfinite(applied).all():
        raise ReobjError(f"{path}: applied_transform: expected 3x4 or 4x4 finite numbers")
    applied[:3] = checked_rigid(applied[None], [f"{path}, applied_transform"])[0]
    world_from_gl = checked_rigid(np.array(matrices), where)
    poses = CV_FROM_GL @ invert_rigid(world_from_gl) @ applied  # (N, 3, 4)
    return PoseFile(poses, tuple(cameras), tuple(names), kind="transforms")


# ---- Datasets and radiance fields ----------------------------------------------------------------


def read_scannetpp(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ScanNet++'s pose_intrinsic_imu.json of an iPhone: per frame world_from_cam, z up.

    `aligned_pose` (of the laser scan) or else `pose`, and `intrinsic`; OpenCV axes, metres.
    """
    path = path / "pose_intrinsic_imu.json" if path.is_dir() else path
    data = json_object(path)
    names = tuple(data)
    where = [f"{path}, {name}" for name in data]
    matrices = []
    cameras = []
    for name, key in zip(names, where, strict=True):
        try:
            matrix = data[name].get("aligned_pose", data[name].get("pose"))
            matrices.append(np.array(matrix, np.float64).reshape(4, 4))
            K = np.array(data[name]["intrinsic"], np.float64).reshape(3, 3)
            cameras.append(brown_camera(_size_of(K, size), *K[[0, 1, 0, 1], [0, 1, 2, 2]]))
        except (KeyError, TypeError, ValueError, AttributeError):
            expected = "4x4 aligned_pose or pose, and 3x3 intrinsic"
            raise ReobjError(f"{key}: expected {expected}, numbers") from None
    raise_where([not names], [str(path)], "no frames in it")
    poses = invert_rigid(checked_rigid(np.array(matrices), where))
    is_aligned = all("aligned_pose" in data[name] for name in names)
    up = Z_UP if is_aligned else None
    kind = "ScanNet++ iPhone poses"
    return PoseFile(poses, tuple(cameras), names, metric=True, up_in_world=up, kind=kind)


def read_llff(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read LLFF's poses_bounds.npy: (N, 17), 3x5 [R | t | h, w, f] and two depths; no scale.

    world_from_cam with the axes down, right, backwards. One row per image, by name.
    """
    path = path / "poses_bounds.npy" if path.is_dir() else path
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ReobjError(f"{path}: not a .npy file of numbers ({error})") from None
    if rows.ndim != 2 or rows.shape[1] not in (15, 17) or rows.dtype.kind not in "fiu":
        raise ReobjError(f"{path}: an array of shape {rows.shape}; expected (N, 17), LLFF's")
    table = rows[:, :15].astype(np.float64).reshape(-1, 3, 5)
    where = [f"{path}, row {i}" for i in range(len(rows))]
    world_from_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    down, right, back = (table[:, :, k] for k in range(3))
    world_from_cam[:, :3, :3] = np.stack([right, down, -back], 2)
    world_from_cam[:, :3, 3] = table[:, :, 3]
    raise_where(~np.isfinite(table).all((1, 2)), where, "a number is not finite")
    cameras = [
        Camera("SIMPLE_PINHOLE", image_side(w), image_side(h), (f, w / 2, h / 2))
        for h, w, f in table[:, :, 4].tolist()
    ]
    poses = invert_rigid(checked_rigid(world_from_cam, where))
    return PoseFile(poses, tuple(cameras), kind="LLFF poses")


def read_splatting(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read cameras.json of 3D Gaussian splatting: position and rotation of world_from_cam.

    OpenCV axes, no scale; the principal point is the middle of the image.
    """
    path = path / "cameras.json" if path.is_dir() else path
    data = load_json(path)
    matrices = list[Array]()
    names = list[str]()
    cameras = list[Camera | None]()
    where = list[str]()
    for i, entry in enumerate(data if isinstance(data, list) else []):
        where.append(f"{path}, entry {i}")
        try:
            matrix = np.eye(4)
            matrix[:3, :3] = entry["rotation"]
            matrix[:3, 3] = entry["position"]
            width = image_side(entry["width"])
            height = image_side(entry["height"])
            focal = float(entry["fx"]), float(entry["fy"])
            names.append(str(entry["img_name"]))
        except (KeyError, TypeError, ValueError):
            expected = "img_name, width, height, position, rotation, fx, fy"
            raise ReobjError(f"{where[-1]}: expected {expected}") from None
        matrices.append(matrix)
        cameras.append(Camera("PINHOLE", width, height, (*focal, width / 2, height / 2)))
    if not matrices:
        raise ReobjError(f"{path}: expected a list of cameras, as Gaussian splatting writes it")
    poses = invert_rigid(checked_rigid(np.array(matrices), where))
    return PoseFile(poses, tuple(cameras), tuple(names), kind="Gaussian splatting cameras")
