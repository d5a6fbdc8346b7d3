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

Size = tuple[int, int]  # width, height of images, px

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


def raise_where(bad: Any, where: Sequence[str], problem: str) -> None:
    """Raise the problem with the location of the first bad (N,) input, if any."""
    if np.any(bad):
        raise ReobjError(f"{where[int(np.argmax(bad))]}: {problem}")


def read_table(path: Path, columns: Sequence[int]) -> tuple[Array, list[str], str]:
    """Read a table of numbers with spaces or commas, after a header.

    Args:
        columns: numbers of columns that are allowed.
    Returns:
        rows (N, C), C in `columns`; file and line of each; the header: comments, column names.
    """
    expected = f"expected rows of {' or '.join(map(str, columns))} numbers"
    rows = list[list[float]]()
    where = list[str]()
    header = ""
    for number, text in enumerate(read_lines(path), 1):
        words = text.replace(",", " ").split()
        if not words or words[0].startswith("#") or (not rows and not is_number(words[0])):
            header += "" if rows else text
            continue
        where.append(f"{path}, line {number}")
        counts = {len(words), *map(len, rows[:1])}
        is_row = all(map(is_number, words)) and len(counts) == 1 and len(words) in columns
        fault = f"{len(words)} words {text.strip()[:60]!r}; {expected}"
        raise_where([not is_row], where[-1:], fault)
        rows.append([float(word) for word in words])
    raise_where([not rows], [str(path)], f"no poses in it; {expected}")
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
        matrix: (N, 3 or 4, 4); no pose: not finite, or a rotation of zeros. where: of each.
    Returns:
        (N, 3, 4), NaN where there is no pose.
    """
    lost = ~np.isfinite(matrix).all((1, 2)) | (matrix[:, :3, :3] == 0).all((1, 2))
    matrix = np.where(lost[:, None, None], np.eye(4)[: matrix.shape[1]], matrix)
    rotation = matrix[:, :3, :3].clip(-2, 2)  # the squares of 1e300 are too large
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max((1, 2))  # (N,)
    below = np.abs(matrix[:, 3:] - [0, 0, 0, 1]).max((1, 2), initial=0)
    for bad, problem in (
        ((np.abs(matrix[:, :3, 3]) >= WORLD_MAX).any(1),
         f"more than {WORLD_MAX:g} units away from the origin"),
        (np.maximum(error, below) > POSE_TOLERANCE,
         "the 3x3 block is not a rotation, or the last row not 0 0 0 1; expected a row-major rigid "
         "pose without scale (transpose column-major ones)"),
        (np.linalg.det(rotation) < 0,
         "the rotation is mirrored (determinant -1); flip two axes, not one"),
    ):  # fmt: skip
        raise_where(bad, where, problem)
    u, _, vt = np.linalg.svd(rotation)
    return np.where(lost[:, None, None], np.nan, np.dstack([u @ vt, matrix[:, :3, 3]]))


def homogeneous(matrix: Array) -> Array:
    """Append the row 0 0 0 1 to transforms (N, 3, 4)."""
    return np.concatenate([matrix, np.tile([[[0, 0, 0, 1.0]]], (len(matrix), 1, 1))], 1)


def from_quaternions(rows: Array, where: Sequence[str]) -> Array:
    """Make rigid transforms (N, 3, 4) of rows (N, 7): x, y, z, qx, qy, qz, qw.

    NaN where a number is not finite or the quaternion is 0: there is no pose.
    """
    lost = ~np.isfinite(rows).all(1) | (rows[:, 3:] == 0).all(1)
    xyzw = np.where(lost[:, None], [0, 0, 0, 1], rows[:, 3:]).clip(-2, 2)
    raise_where(
        np.abs(np.linalg.norm(xyzw, axis=1) - 1) > POSE_TOLERANCE,
        where,
        "the quaternion is not of length 1; expected the columns of the format in its order",
    )
    translation = np.where(lost[:, None], np.nan, rows[:, :3])
    return checked_rigid(np.dstack([Rotation.from_quat(xyzw).as_matrix(), translation]), where)


Y_UP = np.array([0, 1.0, 0])
Z_UP = np.array([0, 0, 1.0])
CV_FROM_LLFF = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])  # LLFF: x down, y right, z backward


def _file(path: Path, *names: str) -> Path:
    """Return a file, or the first one in a folder that has one of the names."""
    return next((path / name for name in names if (path / name).is_file()), path)


# ---- Tables: TUM, ORB-SLAM3, EuRoC, Stray Scanner, rows of matrices, ARKitScenes -----------------

TABLES = ("poses.txt", "groundtruth.txt", "traj.txt", "poses_c2w.txt")  # ours, of TUM, Replica


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


def read_tum(path: Path, size: Size) -> PoseFile:
    """Read TUM rows: time, world_from_cam, w last. Column names in the header override this."""
    path = _file(path, *TABLES)
    rows, where, header = read_table(path, (8,))
    columns = named_columns(header, 8) or range(1, 8)
    return PoseFile(
        invert_rigid(from_quaternions(rows[:, columns], where)), stamps=rows[:, 0],
        is_ours=OUR_HEADER in header, metric=stated_metric(header),
    )  # fmt: skip


def read_ours(path: Path, size: Size) -> PoseFile:
    """Read an output folder of this tool: poses.txt, with the camera of sparse/."""
    cameras = read_sparse_model(path / "sparse").cameras[:1]
    return dataclasses.replace(read_tum(path, size), cameras=tuple(cameras))


def read_euroc(path: Path, size: Size) -> PoseFile:
    """Read EuRoC's CSV of 8 or 17 columns: ns, world_from_body, quaternion w first; metres.

    `T_BS` in the camera's sensor.yaml, beside it or in cam0 beside its folder, is body_from_cam;
    without one the body is taken for the camera, with a message.
    """
    path = _file(path, "data.csv")
    rows, where, header = read_table(path, (8, 17))
    columns = named_columns(header, rows.shape[1]) or [1, 2, 3, 5, 6, 7, 4]
    poses = invert_rigid(from_quaternions(rows[:, columns], where))
    text = (f"{path}: poses of the body, and no sensor.yaml with the camera's T_BS beside it: body "
            "taken for camera")  # fmt: skip
    for folder in (path.parent, path.parent.parent / "cam0", path.parent / "cam0"):
        file = folder / "sensor.yaml"
        sensor = read_yaml(file) if file.is_file() else {}
        if sensor.get("sensor_type", "camera") == "camera" and "T_BS" in sensor:
            matrix = np.array(sensor["T_BS"]["data"], np.float64).reshape(1, 4, 4)
            poses = invert_rigid(checked_rigid(matrix, [str(file)])) @ homogeneous(poses)
            return PoseFile(poses, (camera_of_keys(sensor, size),), stamps=rows[:, 0], unit="ns")
    return PoseFile(poses, stamps=rows[:, 0], unit="ns", messages=(text,))


def read_stray(path: Path, size: Size) -> PoseFile:
    """Read Stray Scanner's folder: odometry.csv, camera_matrix.csv; world_from_cam, y up, metres.

    OpenCV axes, quaternion x first, a row for each frame of rgb.mp4, numbered from 0.
    """
    path = _file(path, "odometry.csv")
    names = read_lines(path)[0].lower().replace(" ", "").strip().split(",")
    rows, where, header = read_table(path, (len(names),))
    numbers = tuple(f"{number:06.0f}" for number in rows[:, names.index("frame")])
    matrix = path.with_name("camera_matrix.csv")
    cameras = (_phone_camera(read_camera(matrix, size, "matrix").K, size),) * matrix.is_file()
    poses = from_quaternions(rows[:, named_columns(header, len(names)) or ()], where)
    return PoseFile(invert_rigid(poses), cameras, numbers, up_in_world=Y_UP)


def _phone_camera(K: Array, size: Size) -> Camera:
    """Return the camera of a matrix K at the size of the frames, or the native one of ARKit.

    The principal point is near the middle of the right one.
    """
    sizes = (size, (1920, 1440))  # in landscape
    right = min(sizes, key=lambda one: np.abs(2 * K[:2, 2] / one - 1).max())
    return brown_camera(right, *K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())


def read_matrices(path: Path, size: Size) -> PoseFile:
    """Read rows of 12 (KITTI) or 16 numbers (Replica, NICE-SLAM): world_from_cam, OpenCV axes."""
    rows, where, header = read_table(_file(path, *TABLES), (12, 16))
    poses = checked_rigid(rows.reshape(len(rows), -1, 4), where)
    return PoseFile(invert_rigid(poses), metric=stated_metric(header))


def read_traj(path: Path, size: Size) -> PoseFile:
    """Read ARKitScenes' .traj: s, axis-angle, translation of cam_from_world; .pincam beside it."""
    path = next(iter(sorted(path.glob("*.traj"))), path) if path.is_dir() else path
    rows, where, _ = read_table(path, (7,))
    files = sorted(path.parent.glob("*_intrinsics/*.pincam")) or path.parent.glob("*.pincam")
    poses = np.dstack([Rotation.from_rotvec(rows[:, 1:4]).as_matrix(), rows[:, 4:]])
    cameras = tuple(read_camera(file, None, "pincam") for file in files)
    return PoseFile(
        checked_rigid(poses, where), cameras, stamps=rows[:, 0], unit="s", up_in_world=Z_UP
    )


# ---- Lists of poses with a camera each: apps, datasets, radiance fields --------------------------

# world_from_cam, 12 or 16 numbers row by row; camera; name of the image, or ""
Entry = tuple[Any, Camera | None, str]


def _listed(
    entries: dict[str, Any], read: Callable[[Any], Entry], axes: Array | None = None, **more: Any
) -> PoseFile:
    """Read entries, by their location, whose camera axes are these, by default OpenCV's."""
    found = list[Entry]()
    for where, entry in entries.items():
        try:
            numbers, camera, name = read(entry)
            matrix = np.array(numbers, np.float64).reshape(-1, 4)
            found.append((np.append(matrix, np.eye(4)[len(matrix) :], 0), camera, name))
        except Exception as error:
            text = f"no pose and camera as the format has them ({error!r:.100})"
            text = str(error) if isinstance(error, ReobjError) else text
            raise ReobjError(text if text.startswith(where) else f"{where}: {text}") from None
    matrices, cameras, names = zip(*found, strict=True)
    axes = np.eye(3) if axes is None else axes
    poses = axes @ invert_rigid(checked_rigid(np.array(matrices), list(entries)))
    return PoseFile(poses, cameras, tuple(filter(None, names)), axes=axes, **more)


def read_record3d(path: Path, size: Size) -> PoseFile:
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
    rows = np.roll(np.array(data["poses"], np.float64).reshape(-1, 7), 3, 1)
    where = [f"{path}, poses[{i}]" for i in range(len(rows))]
    camera = camera_of_keys({key: data[key] for key in ("K", "w", "h")}, None)
    poses = CV_FROM_GL @ invert_rigid(from_quaternions(rows, where))
    return PoseFile(poses, (camera,), up_in_world=Y_UP, axes=CV_FROM_GL)


def scannet_files(path: Path) -> list[Path]:
    """List the poses of ScanNet's folder, `pose/<frame>.txt`, or of 7-Scenes', `*.pose.txt`."""
    folder = path / "pose" if (path / "pose").is_dir() else path
    form = r"\d+\.txt" if folder.name == "pose" else r".*\.pose\.txt"
    return sorted(f for f in folder.glob("*.txt") if re.fullmatch(form, f.name))


def read_scannet(path: Path, size: Size) -> PoseFile:
    """Read ScanNet's `pose/<frame>.txt` (z up) or 7-Scenes' `*.pose.txt`: 4x4 world_from_cam.

    Metres; inf: no pose. ScanNet's intrinsics have the centre of the first pixel at (0, 0).
    """
    path = path.parent if path.name == "pose" else path
    files = scannet_files(path)
    matrix = path / "intrinsic" / "intrinsic_color.txt"
    camera = scannet_camera(matrix, size) if matrix.exists() else None
    up = Z_UP if files[0].parent.name == "pose" else None

    def read(file: Path) -> Entry:
        return read_table(file, (4,))[0], camera, file.stem

    return _listed({str(file): file for file in files}, read, up_in_world=up)


def scannet_camera(path: Path, size: Size) -> Camera:
    """Read a matrix of ScanNet, whose first pixel has its centre at (0, 0)."""
    fx, fy, cx, cy = read_camera(path, size, "matrix").params
    return Camera("PINHOLE", *size, (fx, fy, cx + 0.5, cy + 0.5))


def arkit_files(path: Path) -> list[Path]:
    """List the camera files, one per image, of a raw export of an app that uses ARKit."""
    forms = ("frame_*.json", "keyframes/corrected_cameras/*.json", "keyframes/cameras/*.json")
    return next(filter(None, (sorted(path.glob(form)) for form in forms)), [])


def read_arkit(path: Path, size: Size) -> PoseFile:
    """Read a raw export of Polycam or of 3D Scanner App: a JSON file for each image.

    world_from_cam row by row, `t_00` to `t_23` or `cameraPoseARFrame`; ARKit's axes (those of
    OpenGL), metres, y up.
    """

    def read(file: Path) -> Entry:
        keys = load_json(file)
        rows = keys.get("cameraPoseARFrame") or [keys[f"t_{k // 4}{k % 4}"] for k in range(12)]
        return rows, camera_of_keys(keys, size), file.stem

    files = {str(file): file for file in arkit_files(path)}
    return _listed(files, read, CV_FROM_GL, up_in_world=Y_UP)


def read_transforms(path: Path, size: Size) -> PoseFile:
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
    applied = np.array(data.get("applied_transform", np.eye(4)), np.float64)[None, :3]
    where = [f"{path}, applied_transform"]
    raise_where([not np.isfinite(applied).all()], where, "expected 3x4 or 4x4 finite numbers")
    turn = homogeneous(checked_rigid(applied, where))
    return dataclasses.replace(found, cam_from_world=found.cam_from_world @ turn)


def read_scannetpp(path: Path, size: Size) -> PoseFile:
    """Read ScanNet++'s pose_intrinsic_imu.json of an iPhone: per frame world_from_cam, z up.

    `aligned_pose` (of the laser scan) or else `pose`, and `intrinsic`; OpenCV axes, metres.
    """
    path = _file(path, "pose_intrinsic_imu.json")
    data = load_json(path)
    is_aligned = all("aligned_pose" in entry for entry in data.values())

    def read(name: str) -> Entry:
        K = np.array(data[name]["intrinsic"], np.float64).reshape(3, 3)
        pose = data[name]["aligned_pose" if is_aligned else "pose"]
        return pose, _phone_camera(K, size), name

    named = {f"{path}, {name}": name for name in data}
    return _listed(named, read, up_in_world=Z_UP if is_aligned else None)


def read_llff(path: Path, size: Size) -> PoseFile:
    """Read LLFF's poses_bounds.npy: (N, 17), 3x5 [R | t | h, w, f] and two depths; no scale.

    world_from_cam with the axes down, right, backwards. One row per image, in the order of the
    names as text.
    """
    path = _file(path, "poses_bounds.npy")
    rows = np.load(path, allow_pickle=False)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise ReobjError(f"{path}: an array of shape {rows.shape}; expected LLFF's (N, 17); write "
                         "matrices as text: np.savetxt(FILE, m.reshape(N, 16))")  # fmt: skip

    def read(table: Array) -> Entry:
        h, w, f = table[:, 4].tolist()
        camera = Camera("SIMPLE_PINHOLE", image_side(w), image_side(h), (f, w / 2, h / 2))
        return table[:, :4], camera, ""

    tables = rows[:, :15].astype(np.float64).reshape(-1, 3, 5)
    where = [f"{path}, row {i}" for i in range(len(rows))]
    raise_where(~np.isfinite(tables).all((1, 2)), where, "a number is not finite")
    return _listed(dict(zip(where, tables, strict=True)), read, CV_FROM_LLFF, by_text=True)


def read_splatting(path: Path, size: Size) -> PoseFile:
    """Read cameras.json of 3D Gaussian splatting: position and rotation of world_from_cam.

    OpenCV axes, no scale; the principal point is the middle of the image.
    """

    def read(entry: Any) -> Entry:
        numbers = np.column_stack([entry["rotation"], entry["position"]])
        return numbers, camera_of_keys(entry, None), str(entry["img_name"])

    path = _file(path, "cameras.json")
    return _listed({f"{path}, entry {i}": one for i, one in enumerate(load_json(path))}, read)


# ---- COLMAP models -------------------------------------------------------------------------------

UPRIGHT = "upright.txt"  # file in our models: their cameras describe upright photos
MODEL_FOLDERS = ([""], ["sparse/", "sparse/[0-9]*/"], ["[0-9]*/"],
                 ["colmap/sparse/", "colmap/sparse/[0-9]*/"])  # fmt: skip


def find_models(path: Path) -> list[Path]:
    """List the image files of the COLMAP models at a path or below it.

    Below a folder without a model: `sparse/N` and `sparse`, else `N`, else `colmap/sparse/N`.
    """
    if path.is_file():
        return [path] if path.stem == "images" else find_models(path.parent)[:1]
    for folders in MODEL_FOLDERS:
        names = [f"{folder}images.{suffix}" for folder in folders for suffix in ("txt", "bin")]
        files = [file for name in names for file in path.glob(name)]
        if files:
            return sorted({file.parent: file for file in files}.values())  # binary ones first
    return []


def read_colmap(path: Path, size: Size) -> PoseFile:
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
    kind += f" in {folder}" * (folder not in (path, path.parent))
    return dataclasses.replace(found, kind=kind, stored_pixels=not (folder / UPRIGHT).exists())


def _read_binary_model(folder: Path) -> PoseFile:
    """Read a binary COLMAP model."""
    _check_counts(folder)
    model = read_sparse_model(folder)
    raise_where([not model.names], [f"{folder / 'images.bin'}"], "no registered image")
    where = [f"{folder / 'images.bin'}, {name}" for name in model.names]
    return PoseFile(
        checked_rigid(model.cam_from_world, where), tuple(model.cameras), model.names,
        points=model.points, colors=model.colors,
        visibility=np.column_stack([model.obs_image, model.obs_point]),
    )  # fmt: skip


def _read_text_model(folder: Path) -> PoseFile:
    """Read a COLMAP model of text: pycolmap refuses or misreads what other tools leave out.

    These are points3D.txt, and the line of observations after each image. Names may have spaces.
    Observations are those of the points.
    """
    cameras = {w[0]: colmap_camera(w[1:]) for w in _records(folder / "cameras.txt").values()}
    path = folder / "images.txt"
    images = {at: words for at, words in _records(path).items() if not _observes(words)}
    where = sorted(images, key=lambda at: images[at][0].zfill(20))
    rows = [images[at] for at in where]
    raise_where([not rows], [str(path)], "no registered image")
    faults = [len(words) < 10 or not all(map(is_number, words[:8])) for words in rows]
    raise_where(faults, where, "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
    numbers = np.array([words[1:8] for words in rows], np.float64)
    length = np.linalg.norm(numbers[:, :4], axis=1)
    fault = "the quaternion is not of length 1"
    raise_where(~(np.abs(length - 1) <= POSE_TOLERANCE), where, fault)  # also NaN
    turn_of = import_pycolmap().Rotation3d  # with its rounding
    turns = [turn_of(xyzw).matrix() for xyzw in numbers[:, [1, 2, 3, 0]]]
    row_of = {words[0]: row for row, words in enumerate(rows)}
    path = folder / "points3D.txt"
    points = sorted(_records(path).values() if path.is_file() else [], key=lambda w: int(w[0]))
    seen = [(row_of[i], p) for p, words in enumerate(points) for i in words[8::2] if i in row_of]
    return PoseFile(
        checked_rigid(np.dstack([turns, numbers[:, 4:]]), where),
        tuple(cameras[words[8]] for words in rows),
        tuple(" ".join(words[9:]) for words in rows),
        points=checked_points([w[1:4] for w in points], [w[0] for w in points], path),
        colors=np.array([w[4:7] for w in points], np.uint8).reshape(-1, 3),
        visibility=np.array(sorted(seen), np.int64).reshape(-1, 2),
    )


def _observes(words: list[str]) -> bool:
    """Test for a line of observations: x, y, number of the point."""
    return len(words) % 3 == 0 and all(word.lstrip("-").isdigit() for word in words[2::3])


def _records(path: Path) -> dict[str, list[str]]:
    """Return the words, by location, of the lines of a text file that are no comments."""
    lines = {f"{path}, line {n}": line.split() for n, line in enumerate(read_lines(path), 1)}
    return {where: words for where, words in lines.items() if words and words[0][0] != "#"}


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
        data = (folder / name).read_bytes() if (folder / name).exists() else bytes(8)
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
