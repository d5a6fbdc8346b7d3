"""Pose files of other tools and datasets: one small reader per format, listed in `readers.POSES`.

All convert their conventions to cam_from_world, OpenCV axes, COLMAP pixels.
"""

from __future__ import annotations

import dataclasses
import json
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.cameras import (
    CV_FROM_GL,
    WORLD_MAX,
    Camera,
    checked_points,
    import_pycolmap,
    invert_rigid,
    read_sparse_model,
)
from reobj.files import MEMORY_MAX, check_unpacked, load_json, read_lines
from reobj.poses.intrinsics import (
    brown_camera,
    camera_of_keys,
    colmap_camera,
    image_side,
    read_camera,
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
        axes: (3, 3) OpenCV's camera axes from those of the file, as it was read.
        by_text: without names, poses are in the order of the images' names as text: 1, 10, 2.
        stored_pixels: cameras are those of images as they are stored, without their EXIF turn.
        metric: whether the file states metres (True) or an unknown scale; None: it says nothing.
        kind: name of the format.
        messages: what was assumed or left out.
    """

    cam_from_world: Array
    cameras: tuple[Camera | None, ...] = ()
    names: tuple[str, ...] = ()
    stamps: Array | None = None
    unit: str = ""
    is_ours: bool = False
    metric: bool | None = None
    up_in_world: Array | None = None
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    visibility: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))
    axes: Array = field(default_factory=lambda: np.eye(3))
    by_text: bool = False
    stored_pixels: bool = False
    kind: str = ""
    messages: tuple[str, ...] = ()


def read_table(path: Path, columns: Sequence[int]) -> tuple[Array, list[str], str]:
    """Read a table of numbers with spaces or commas, after a header.

    Args:
        columns: numbers of columns that are allowed.
    Returns:
        rows (N, C), C in `columns`; file and line of each; the header: comments, column names.
    """
    expected = " or ".join(map(str, columns))
    rows: list[list[float]] = []
    where = list[str]()
    header = ""
    for number, text in enumerate(read_lines(path), 1):
        words = text.replace(",", " ").split()
        if not words or words[0].startswith("#") or (not rows and not is_number(words[0])):
            header += text if not rows else ""
            continue
        where.append(f"{path}, line {number}")
        is_row = all(map(is_number, words)) and len(words) in columns
        is_row &= not rows or len(words) == len(rows[0])
        raise_where([not is_row], where[-1:], f"{len(words)} words {text.strip()[:60]!r}; expected "
                    f"{expected} numbers")  # fmt: skip
        rows.append([float(word) for word in words])
    raise_where([not rows], [str(path)], f"no poses in it; expected rows of {expected} numbers")
    return np.array(rows), where, header


def is_number(word: str) -> bool:
    """True if a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


POSE_TOLERANCE = 0.005  # of entries of rotations and quaternions (7-Scenes: off by 1e-3)


def checked_rigid(matrix: Array, where: Sequence[str]) -> Array:
    """Check rigid transforms and orthonormalise their rotations.

    Args:
        matrix: (N, 4, 4); no pose: not finite, or a rotation of zeros. where: of each, for
            messages.
    Returns:
        (N, 3, 4), NaN where there is no pose.
    """
    lost = ~np.isfinite(matrix).all((1, 2)) | (matrix[:, :3, :3] == 0).all((1, 2))
    matrix = np.where(lost[:, None, None], np.eye(4), matrix)
    far = (np.abs(matrix[:, :3, 3]) >= WORLD_MAX).any(1)
    raise_where(far, where, f"more than {WORLD_MAX:g} units away from the origin")
    rotation = matrix[:, :3, :3].clip(-2, 2)  # the squares of 1e300 are too large
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max((1, 2))  # (N,)
    error = np.maximum(error, np.abs(matrix[:, 3] - [0, 0, 0, 1]).max(1))
    raise_where(
        error > POSE_TOLERANCE,
        where,
        "the 3x3 block is not a rotation, or the last row not 0 0 0 1; expected a row-major rigid "
        "pose without scale (transpose column-major ones)",
    )
    raise_where(
        np.linalg.det(rotation) < 0,
        where,
        "the rotation is mirrored (determinant -1); flip two axes, not one",
    )
    u, _, vt = np.linalg.svd(rotation)
    exact = np.concatenate([u @ vt, matrix[:, :3, 3:]], 2)
    return np.where(lost[:, None, None], np.nan, exact)


def raise_where(bad: Any, where: Sequence[str], problem: str) -> None:
    """Raise the problem with the location of the first bad (N,) input, if any."""
    if np.any(bad):
        raise ReobjError(f"{where[int(np.argmax(bad))]}: {problem}")


def homogeneous(matrix: Array) -> Array:
    """Append the row 0 0 0 1 to transforms (N, 3, 4)."""
    return np.concatenate([matrix, np.tile([[[0, 0, 0, 1.0]]], (len(matrix), 1, 1))], 1)


def from_rotations(rotation: Rotation, translation: Array) -> Array:
    """Make transforms (N, 4, 4) of rotations and translations (N, 3)."""
    return homogeneous(np.concatenate([rotation.as_matrix(), translation[:, :, None]], 2))


def from_quaternions(rows: Array, columns: Sequence[int], where: Sequence[str]) -> Array:
    """Make rigid transforms (N, 3, 4) of rows (N, C) with columns x, y, z, qx, qy, qz, qw (7,).

    NaN where a number is not finite or the quaternion is 0: there is no pose.
    """
    translation, xyzw = np.split(rows[:, columns], [3], 1)
    lost = ~np.isfinite(rows[:, columns]).all(1) | (xyzw == 0).all(1)
    xyzw = np.where(lost[:, None], [0, 0, 0, 1], xyzw).clip(-2, 2)
    raise_where(
        np.abs(np.linalg.norm(xyzw, axis=1) - 1) > POSE_TOLERANCE,
        where,
        "the quaternion is not of length 1; expected the columns of the format in its order",
    )
    translation = np.where(lost[:, None], np.nan, translation)
    return checked_rigid(from_rotations(Rotation.from_quat(xyzw), translation), where)


Y_UP = np.array([0, 1.0, 0])
Z_UP = np.array([0, 0, 1.0])
CV_FROM_LLFF = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])  # LLFF: x down, y right, z backward


def _file(path: Path, name: str) -> Path:
    """Return a file, or that of this name in a folder."""
    return path / name if path.is_dir() else path


# ---- Tables: TUM, ORB-SLAM3, EuRoC, rows of matrices ---------------------------------------------


def table_file(path: Path) -> Path:
    """Return a table, or that in a folder: of TUM, Replica, or ours."""
    names = ("poses.txt", "groundtruth.txt", "traj.txt", "poses_c2w.txt")
    return next(filter(Path.is_file, (path / name for name in names)), path)


def named_columns(header: str, count: int) -> list[int] | None:
    """Find x, y, z and the quaternion x, y, z, w among `count` columns by their names.

    Returns:
        indices (7,); None where no line of the header names them all.
    """
    form = r"(q|rot|orient)?[a-z]*?[._]?(?:rs_)?(?:r_)?([xyzw])"
    wanted = ("x", "y", "z", "qx", "qy", "qz", "qw")
    for line in header.lower().splitlines()[::-1]:
        words = re.sub(r"\[.*?\]|\(.*?\)", "", line).replace(",", " ").lstrip("# ").split()
        found = [re.fullmatch(form, word) for word in words]
        names = ["q" * bool(name[1]) + name[2] if name else "" for name in found]
        if len(words) == count and {*wanted} <= {*names}:
            return [names.index(name) for name in wanted]
    return None


OUR_HEADER = "(world_from_cam, seconds, units: "  # of `cameras.write_tum`


def stated_metric(header: str) -> bool | None:
    """Return whether a header states metres, as ours does; None: it states no unit."""
    unit = re.search("#.*units: (metres|arbitrary)", header)
    return unit[1] == "metres" if unit else None


def read_tum(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read TUM rows: time, world_from_cam, w last. Column names in the header override this."""
    path = table_file(path)
    rows, where, header = read_table(path, (8,))
    columns = named_columns(header, 8)
    is_open = columns is None and "," in read_lines(path)[-1]  # TUM has spaces
    text = f"{path}: no header names its columns: read as TUM's, quaternion w last"
    world_from_cam = from_quaternions(rows, columns or [1, 2, 3, 4, 5, 6, 7], where)
    return PoseFile(
        invert_rigid(world_from_cam), stamps=rows[:, 0], is_ours=OUR_HEADER in header,
        metric=stated_metric(header), messages=(text,) * is_open,
    )  # fmt: skip


def read_ours(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read an output folder of this tool: poses.txt, with the camera of sparse/."""
    cameras = read_sparse_model(path / "sparse").cameras[:1]
    return dataclasses.replace(read_tum(path, size), cameras=tuple(cameras))


def read_euroc(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read EuRoC's CSV of 8 or 17 columns: ns, world_from_body, quaternion w first; metres.

    `T_BS` in the camera's sensor.yaml, beside it or in cam0 beside its folder, is body_from_cam;
    without one the body is taken for the camera, with a message.
    """
    path = _file(path, "data.csv")
    rows, where, header = read_table(path, (8, 17))
    columns = named_columns(header, rows.shape[1]) or [1, 2, 3, 5, 6, 7, 4]
    body_from_world = invert_rigid(from_quaternions(rows, columns, where))
    near = (path.parent, path.parent.parent / "cam0", path.parent / "cam0")
    sensors = [read_yaml(s) for s in (f / "sensor.yaml" for f in near) if s.is_file()]
    sensors = [sensor for sensor in sensors if sensor.get("sensor_type", "camera") == "camera"]
    if not sensors:
        text = (
            f"{path}: poses of the body, and no sensor.yaml with the camera's T_BS beside it: body "
            "taken for camera"
        )
        return PoseFile(body_from_world, stamps=rows[:, 0], unit="ns", messages=(text,))
    matrix = np.array(sensors[0]["T_BS"]["data"], np.float64).reshape(1, 4, 4)
    cam_from_body = invert_rigid(checked_rigid(matrix, ["T_BS of sensor.yaml"]))
    return PoseFile(
        cam_from_body @ homogeneous(body_from_world), (camera_of_keys(sensors[0], size),),
        stamps=rows[:, 0], unit="ns",
    )  # fmt: skip


def read_matrices(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read rows of 12 (KITTI) or 16 numbers (Replica, NICE-SLAM): world_from_cam, OpenCV axes."""
    matrices, where, header = matrix_rows(table_file(path))
    return PoseFile(invert_rigid(checked_rigid(matrices, where)), metric=stated_metric(header))


def matrix_rows(path: Path) -> tuple[Array, list[str], str]:
    """Read rows of 12 or 16 numbers: matrices (N, 4, 4), locations, header; not finite: lost."""
    rows, where, header = read_table(path, (12, 16))
    whole = np.tile(np.eye(4), (len(rows), 1, 1))
    whole.reshape(-1, 16)[:, : rows.shape[1]] = rows
    return whole, where, header


def read_traj(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ARKitScenes' .traj: s, axis-angle, translation of cam_from_world; .pincam beside it."""
    path = next(iter(sorted(path.glob("*.traj"))), path) if path.is_dir() else path
    rows, where, _ = read_table(path, (7,))
    files = sorted(path.parent.glob("*_intrinsics/*.pincam")) or path.parent.glob("*.pincam")
    poses = from_rotations(Rotation.from_rotvec(rows[:, 1:4]), rows[:, 4:])
    cameras = tuple(read_camera(file, None, "pincam") for file in files)
    return PoseFile(
        checked_rigid(poses, where), cameras, stamps=rows[:, 0], unit="s", up_in_world=Z_UP
    )


# ---- Phones --------------------------------------------------------------------------------------


def read_stray(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read Stray Scanner's folder: odometry.csv, camera_matrix.csv; world_from_cam, y up, metres.

    OpenCV axes, quaternion x first, a row for each frame of rgb.mp4, numbered from 0.
    """
    path = _file(path, "odometry.csv")
    names = [word.strip().lower() for word in read_lines(path)[0].split(",")]
    rows, where, header = read_table(path, (len(names),))
    columns = named_columns(header, len(names))
    if columns is None or "frame" not in names:
        raise ReobjError(f"{path}: expected columns frame, x, y, z, qx, qy, qz, qw")
    numbers = tuple(f"{number:06.0f}" for number in rows[:, names.index("frame")])
    matrix = path.with_name("camera_matrix.csv")
    cameras = (_phone_camera(read_camera(matrix, size, "matrix").K, size),) * matrix.is_file()
    return PoseFile(
        invert_rigid(from_quaternions(rows, columns, where)), cameras, numbers, up_in_world=Y_UP
    )


def _phone_camera(K: Array, size: tuple[int, int]) -> Camera:
    """Return the camera of a matrix K at the size of the frames, or the native one of ARKit.

    The principal point is near the middle of the right one.
    """
    sizes = (size, (1920, 1440))  # in landscape
    right = min(sizes, key=lambda one: np.abs(2 * K[:2, 2] / one - 1).max())
    return brown_camera(right, *K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())


def read_record3d(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read Record3D's metadata: `poses` qx qy qz qw tx ty tz, world_from_cam, OpenGL axes, y up.

    The file `metadata`, its folder, or an .r3d, which is a zip of the folder.
    """
    path = _file(path, "metadata")
    if path.suffix.lower() == ".r3d":
        with zipfile.ZipFile(path) as file:
            name = next(n for n in file.namelist() if n.rpartition("/")[2] == "metadata")
            check_unpacked(file.getinfo(name).file_size, MEMORY_MAX // 8)
            data = json.loads(file.read(name))
    else:
        data = load_json(path)
    rows = np.array(data["poses"], np.float64).reshape(-1, 7)
    where = [f"{path}, poses[{i}]" for i in range(len(rows))]
    poses = CV_FROM_GL @ invert_rigid(from_quaternions(rows, [4, 5, 6, 0, 1, 2, 3], where))
    camera = camera_of_keys({key: data[key] for key in ("K", "w", "h")}, None)
    return PoseFile(poses, (camera,), up_in_world=Y_UP, axes=CV_FROM_GL)


def scannet_files(path: Path) -> list[Path]:
    """List the poses of ScanNet's folder, `pose/<frame>.txt`, or of 7-Scenes', `*.pose.txt`."""
    folder = path / "pose" if (path / "pose").is_dir() else path
    form = r"\d+\.txt" if folder.name == "pose" else r".*\.pose\.txt"
    return sorted(f for f in folder.glob("*.txt") if re.fullmatch(form, f.name))


def read_scannet(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ScanNet's `pose/<frame>.txt` (z up) or 7-Scenes' `*.pose.txt`: 4x4 world_from_cam.

    Metres; inf: no pose. ScanNet's intrinsics have the centre of the first pixel at (0, 0).
    """
    path = path.parent if path.name == "pose" else path
    files = scannet_files(path)
    where = [str(file) for file in files]
    tables = [read_table(file, (4,))[0] for file in files]
    raise_where([len(table) != 4 for table in tables], where, "expected 4 rows of 4 numbers")
    matrix = path / "intrinsic" / "intrinsic_color.txt"
    return PoseFile(
        invert_rigid(checked_rigid(np.array(tables), where)),
        (scannet_camera(matrix, size),) if matrix.exists() else (),
        tuple(file.stem for file in files),
        up_in_world=Z_UP if files[0].parent.name == "pose" else None,
    )


def scannet_camera(path: Path, size: tuple[int, int]) -> Camera:
    """Read a matrix of ScanNet, whose first pixel has its centre at (0, 0)."""
    fx, fy, cx, cy = read_camera(path, size, "matrix").params
    return Camera("PINHOLE", *size, (fx, fy, cx + 0.5, cy + 0.5))


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

    def read(entry: Any) -> Entry:
        path, keys = entry
        rows = keys.get("cameraPoseARFrame") or [keys[f"t_{k // 4}{k % 4}"] for k in range(12)]
        return rows, camera_of_keys(keys, size), path.stem

    files = {str(file): (file, load_json(file)) for file in arkit_files(path)}
    return _listed(files, read, CV_FROM_GL, up_in_world=Y_UP)


# world_from_cam, 12 or 16 numbers row by row; camera; name of the image, or ""
Entry = tuple[Any, Camera | None, str]


def _listed(
    entries: dict[str, Any], read: Callable[[Any], Entry], axes: Array, **more: Any
) -> PoseFile:
    """Read entries, by their location, whose camera axes are these."""
    matrices = np.tile(np.eye(4).ravel(), (len(entries), 1))  # (N, 16)
    cameras = list[Camera | None]()
    names = list[str]()
    for row, (where, entry) in enumerate(entries.items()):
        try:
            numbers, camera, name = read(entry)
            numbers = np.array(numbers, np.float64).ravel()
            matrices[row, : 12 if numbers.size == 12 else 16] = numbers
            cameras.append(camera)
            names += [name] * bool(name)
        except ReobjError as error:
            raise ReobjError(f"{where}: {error}") from None
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
            raise ReobjError(f"{where}: no pose and camera as the format has them "
                             f"({error!r:.100})") from None  # fmt: skip
    poses = axes @ invert_rigid(checked_rigid(matrices.reshape(-1, 4, 4), list(entries)))
    return PoseFile(poses, tuple(cameras), tuple(names), axes=axes, **more)


def read_transforms(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read nerfstudio's or instant-ngp's transforms.json: world_from_cam, OpenGL axes; no scale.

    nerfstudio transformed the world by `applied_transform` A; this is undone:
    world_from_cv = inv(A) world_from_gl diag(1, -1, -1, 1).
    """
    path = _file(path, "transforms.json")
    data = load_json(path)
    frames = data.pop("frames")

    def read(frame: Any) -> Entry:
        camera = camera_of_keys({**data, **frame}, size)
        return frame["transform_matrix"], camera, str(frame["file_path"])

    named = {f"{path}, frames[{i}]": frame for i, frame in enumerate(frames)}
    found = _listed(named, read, CV_FROM_GL)
    applied = np.eye(4)
    applied[:3] = np.array(data.get("applied_transform", applied), np.float64)[:3]
    where = [f"{path}, applied_transform"]
    raise_where([not np.isfinite(applied).all()], where, "expected 3x4 or 4x4 finite numbers")
    turn = homogeneous(checked_rigid(applied[None], where))
    return dataclasses.replace(found, cam_from_world=found.cam_from_world @ turn)


# ---- Datasets and radiance fields ----------------------------------------------------------------


def read_scannetpp(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ScanNet++'s pose_intrinsic_imu.json of an iPhone: per frame world_from_cam, z up.

    `aligned_pose` (of the laser scan) or else `pose`, and `intrinsic`; OpenCV axes, metres.
    """
    path = _file(path, "pose_intrinsic_imu.json")
    data = load_json(path)
    is_aligned = all("aligned_pose" in entry for entry in data.values())

    def read(entry: Any) -> Entry:
        name, keys = entry
        K = np.array(keys["intrinsic"], np.float64).reshape(3, 3)
        return keys["aligned_pose" if is_aligned else "pose"], _phone_camera(K, size), name

    named = {f"{path}, {item[0]}": item for item in data.items()}
    return _listed(named, read, np.eye(3), up_in_world=Z_UP if is_aligned else None)


def read_llff(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read LLFF's poses_bounds.npy: (N, 17), 3x5 [R | t | h, w, f] and two depths; no scale.

    world_from_cam with the axes down, right, backwards. One row per image, in the order of the
    names as text.
    """
    path = _file(path, "poses_bounds.npy")
    rows = np.load(path, allow_pickle=False)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise ReobjError(f"{path}: an array of shape {rows.shape}; expected LLFF's (N, 17); write "
                         "matrices as text: np.savetxt(FILE, m.reshape(N, 16))")  # fmt: skip

    def read(row: Array) -> Entry:
        table = row[:15].astype(np.float64).reshape(3, 5)
        raise_where([not np.isfinite(table).all()], ["LLFF"], "a number is not finite")
        h, w, f = table[:, 4].tolist()
        camera = Camera("SIMPLE_PINHOLE", image_side(w), image_side(h), (f, w / 2, h / 2))
        return table[:, :4], camera, ""

    named = {f"{path}, row {i}": row for i, row in enumerate(rows)}
    return _listed(named, read, CV_FROM_LLFF, by_text=True)


def read_splatting(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read cameras.json of 3D Gaussian splatting: position and rotation of world_from_cam.

    OpenCV axes, no scale; the principal point is the middle of the image.
    """

    def read(entry: Any) -> Entry:
        numbers = np.column_stack([entry["rotation"], entry["position"]])
        return numbers, camera_of_keys(entry, None), str(entry["img_name"])

    path = _file(path, "cameras.json")
    named = {f"{path}, entry {i}": entry for i, entry in enumerate(load_json(path))}
    return _listed(named, read, np.eye(3))


# ---- COLMAP models -------------------------------------------------------------------------------

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
    lacking = models[0].with_stem("cameras").name if models else "images.bin"
    if not models or not models[0].with_name(lacking).is_file():
        raise ReobjError(f"{path}: no {lacking} beside it; a COLMAP model is a folder with "
                         "cameras, images and points3D: give that folder")  # fmt: skip
    folder = models[0].parent
    is_binary = models[0].suffix == ".bin"
    found = _read_binary_model(folder) if is_binary else _read_text_model(folder)
    kind = "(binary)" if is_binary else "(text)"
    kind += f" in {folder}" if folder not in (path, path.parent) else ""
    return dataclasses.replace(found, kind=kind, stored_pixels=not (folder / UPRIGHT).exists())


def _read_binary_model(folder: Path) -> PoseFile:
    """Read a binary COLMAP model."""
    _check_counts(folder)
    model = read_sparse_model(folder)
    raise_where([not model.names], [f"{folder / 'images.bin'}"], "no registered image")
    where = [f"{folder / 'images.bin'}, {name}" for name in model.names]
    return PoseFile(
        checked_rigid(homogeneous(model.cam_from_world), where), tuple(model.cameras), model.names,
        points=model.points, colors=model.colors,
        visibility=np.column_stack([model.obs_image, model.obs_point]),
    )  # fmt: skip


def _read_text_model(folder: Path) -> PoseFile:
    """Read a COLMAP model of text: pycolmap refuses or misreads what other tools leave out.

    These are points3D.txt, and the line of observations after each image. Names may have spaces.
    Observations are those of the points.
    """
    camera_rows, _ = _lines_of(folder / "cameras.txt")
    cameras = {words[0]: colmap_camera(words[1:]) for words in camera_rows}
    images, where = _image_rows(folder / "images.txt")
    numbers = np.array([words[1:8] for words in images], np.float64)
    length = np.linalg.norm(numbers[:, :4], axis=1)
    fault = "the quaternion is not of length 1"
    raise_where(~(np.abs(length - 1) <= POSE_TOLERANCE), where, fault)  # also NaN
    turn_of = import_pycolmap().Rotation3d  # with its rounding
    turns = [turn_of(xyzw).matrix() for xyzw in numbers[:, [1, 2, 3, 0]]]
    cam_from_world = np.concatenate([turns, numbers[:, 4:, None]], 2)
    row_of = {words[0]: row for row, words in enumerate(images)}
    path = folder / "points3D.txt"
    rows, _ = _lines_of(path) if path.is_file() else ([], [])
    rows.sort(key=lambda words: int(words[0]))
    seen = [(row_of[i], p) for p, words in enumerate(rows) for i in words[8::2] if i in row_of]
    return PoseFile(
        checked_rigid(homogeneous(cam_from_world), where),
        tuple(cameras[words[8]] for words in images),
        tuple(words[9].strip() for words in images),
        points=checked_points([w[1:4] for w in rows], [w[0] for w in rows], path),
        colors=np.array([words[4:7] for words in rows], np.uint8).reshape(-1, 3),
        visibility=np.array(sorted(seen), np.int64).reshape(-1, 2),
    )


def _lines_of(path: Path) -> tuple[list[list[str]], list[str]]:
    """Return the words of the lines of a text file that are no comments, and their locations."""
    lines = [(line.split(), f"{path}, line {n}") for n, line in enumerate(read_lines(path), 1)]
    kept = [(words, where) for words, where in lines if words and not words[0].startswith("#")]
    return [words for words, _ in kept], [where for _, where in kept]


def _image_rows(path: Path) -> tuple[list[list[str]], list[str]]:
    """Return ID, QW QX QY QZ, TX TY TZ, CAMERA_ID, NAME of images by ascending id; locations."""
    rows: list[tuple[list[str], str]] = []
    observations_next = False
    for number, line in enumerate(read_lines(path), 1):
        words = line.split()
        if line.startswith("#"):
            continue
        triples = len(words) % 3 == 0 and all(w.lstrip("-").isdigit() for w in words[2::3])
        if (observations_next and triples) or not words:
            observations_next = False
            continue
        observations_next = True
        where = f"{path}, line {number}"
        is_row = len(words) >= 10 and all(map(is_number, words[:8]))
        raise_where([not is_row], [where], "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        rows.append((line.split(maxsplit=9), where))
    raise_where([not rows], [str(path)], "no registered image")
    rows.sort(key=lambda row: int(row[0][0]))
    return [words for words, _ in rows], [where for _, where in rows]


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
