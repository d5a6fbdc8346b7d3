"""Poses made elsewhere: COLMAP, TUM, transforms.json (nerfstudio, instant-ngp), ScanNet, Record3D.

Each format has a reader that turns its conventions into cam_from_world, OpenCV axes, COLMAP pixels;
`read_poses` then finds the frame of each pose. Whether the conventions were those that the file
claims is judged later, by `checks`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.cameras import (
    CV_FROM_GL,
    NO_SCALE,
    Camera,
    Poses,
    checked_camera,
    invert_rigid,
    parse_camera,
    read_sparse_model,
)
from reobj.files import load_json, read_text, spans
from reobj.types import Array, IntArray, ReobjError


def read_poses(path: str | Path, video: Any, fmt: str = "auto", camera: str = "") -> Poses:
    """Read the poses of a video's frames from a file or folder of another tool.

    Args:
        path: file or folder. video: the frames they belong to.
        fmt: auto (recognised), colmap, tum, transforms, scannet or record3d.
        camera: intrinsics fx,fy,cx,cy[,k1,k2,p1,p2] in place of the file's.
    Returns:
        poses of the frames that the file knows, NaN for the others (counted in `messages`).
    Raises:
        ReobjError: damaged, unknown, not rigid, without intrinsics, or of another video.
    """
    path, size = Path(path), (int(video.size[0]), int(video.size[1]))
    if not path.exists():
        raise ReobjError(f"{path}: no such file; --poses takes auto, none, or a file of poses")
    reader = READERS.get(_pose_format(path) if fmt == "auto" else fmt)
    if reader is None:
        raise ReobjError(f"--pose-format {fmt}: unknown; known are auto, {', '.join(READERS)}")
    given = reader(path, size)
    intrinsics = parse_camera(camera, size) or given.camera
    if intrinsics is None:
        raise ReobjError(f"{path}: no intrinsics; add --camera fx,fy,cx,cy[,k1,k2,p1,p2], pixels")
    own = (intrinsics.width, intrinsics.height)
    if abs(own[0] * size[1] - own[1] * size[0]) > max(*own, *size):  # more than rounding
        raise ReobjError(
            f"{path}: the poses are of {own[0]}x{own[1]} images, the frames are "
            f"{size[0]}x{size[1]}; expected the same shape (rotated or cropped video?)"
        )
    intrinsics = checked_camera(intrinsics.resized(size), str(path))
    numbers = [(frame.index, frame.time_s) for frame in video]
    if not numbers:
        raise ReobjError("the video has no frame that can be read: poses belong to nothing")
    frame, time_s = np.array([n for n, _ in numbers], np.int64), np.array([t for _, t in numbers])
    names = [video.names[n] for n in frame if video.names]
    row, messages = _rows_of_frames(given, path, frame, time_s, names)
    poses = np.full((len(frame), 3, 4), np.nan)
    poses[row >= 0] = given.cam_from_world[row[row >= 0]]
    known = np.isfinite(poses).all((1, 2))
    if not known.all():
        lost = spans(frame[~known].tolist())
        messages.append(f"{path}: poses for {known.sum()} of {len(frame)} frames, none for {lost}")
    status = np.where(known, "supplied", "none")
    row_of = np.full(len(given.cam_from_world), -1)
    row_of[row[row >= 0]] = np.flatnonzero(row >= 0)
    seen = given.visibility[row_of[given.visibility[:, 0]] >= 0]
    return Poses(
        intrinsics,
        frame,
        time_s,
        poses,
        status,
        "user",
        given.metric,
        given.up_in_world,
        given.points,
        given.colors,
        np.column_stack([row_of[seen[:, 0]], seen[:, 1]]),
        messages=tuple(messages),
    )


@dataclass(frozen=True, slots=True)
class _PoseFile:
    """What a reader returns: N poses in the order of the file.

    Attributes:
        cam_from_world: (N, 3, 4), NaN where the file says that there is no pose.
        names, stamps_s: of the images, or their times: how their frames are found.
        visibility: (M, 2) which poses observed which points: rows.
    """

    cam_from_world: Array
    camera: Camera | None = None
    names: tuple[str, ...] = ()
    stamps_s: Array | None = None
    metric: bool = False
    up_in_world: Array | None = None
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    visibility: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))


def _pose_format(path: Path) -> str:
    """Recognise a format from the names in a folder, or from a file's name."""
    if path.is_dir():
        if (path / "transforms.json").exists():
            return "transforms"
        return "scannet" if (path / "pose").is_dir() or any(path.glob("*.pose.txt")) else "colmap"
    if path.name.startswith("images."):
        return "colmap"
    if path.suffix == ".json" or path.name == "metadata":
        return "record3d" if "poses" in _json_object(path) else "transforms"
    return "tum"


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield where each line of a text file is (for messages) and its words, without comments."""
    for number, text in enumerate(read_text(path).splitlines(), 1):
        if not text.lstrip().startswith("#"):
            yield f"{path}, line {number}", text.split()


def _numbers(words: Sequence[str], at: str, expected: str, finite: bool = True) -> list[float]:
    """Convert the words of a line; `at` and `expected` are for messages."""
    try:
        row = [float(word) for word in words]
    except ValueError:
        what = f"{' '.join(words)[:60]!r} is not a row of numbers"
        raise ReobjError(f"{at}: {what}; expected {expected}") from None
    if finite and not np.isfinite(row).all():
        raise ReobjError(f"{at}: a number is not finite; leave out rows of frames without pose")
    return row


def _read_table(
    path: Path, columns: tuple[int, ...], expected: str, finite: bool = True
) -> tuple[Array, list[str]]:
    """Read a table of numbers.

    Args:
        columns: how many there may be. expected: what a message says. finite: refuse inf and nan.
    Returns:
        rows: (N, C), C in `columns`. where: file and line of each.
    """
    rows: list[list[float]] = []
    where = []
    for at, words in _lines(path):
        if not words:
            continue
        row = _numbers(" ".join(words).replace(",", " ").split(), at, expected, finite)
        if len(row) not in columns or (rows and len(row) != len(rows[0])):
            raise ReobjError(f"{at}: {len(row)} numbers; expected {expected}")
        rows.append(row)
        where.append(at)
    if not rows:
        raise ReobjError(f"{path}: no poses in it; expected {expected}")
    return np.array(rows), where


def _json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object."""
    content = load_json(path)
    if not isinstance(content, dict):
        raise ReobjError(f"{path}: expected an object with `frames` (nerfstudio) or `poses`")
    return content


POSE_TOLERANCE = 0.005  # of rotations and quaternions, in their numbers (7-Scenes: off by 1e-3)


def _checked_rigid(matrix: Array, where: Sequence[str]) -> Array:
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
    _raise_where(last_row.max(1) > POSE_TOLERANCE, where, what)
    rotation = matrix[:, :3, :3]
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3))  # (N, 3, 3)
    what = "the 3x3 part is no rotation (rows not of length 1 and perpendicular)"
    what += "; expected a row-major rigid pose without scale"
    _raise_where(error.max((1, 2)) > POSE_TOLERANCE, where, what)
    what = "the rotation is mirrored (determinant -1); turn two axes, not one"
    _raise_where(np.linalg.det(rotation) < 0, where, what)
    u, _, vt = np.linalg.svd(rotation)
    exact = np.concatenate([u @ vt, matrix[:, :3, 3:]], 2)
    return np.where(lost[:, None, None], np.nan, exact)


def _raise_where(bad: Any, where: Sequence[str], problem: str) -> None:
    """Refuse the input if anything in it is bad (N,): the first place and the problem."""
    if np.any(bad):
        raise ReobjError(f"{where[int(np.argmax(bad))]}: {problem}")


def _from_quaternions(xyzw: Array, translation: Array, where: Sequence[str]) -> Array:
    """Make rigid transforms (N, 3, 4) of unit quaternions (N, 4) and translations (N, 3)."""
    finite = np.isfinite(np.column_stack([xyzw, translation])).all(1)
    _raise_where(~finite, where, "a number is not finite")
    norm = np.linalg.norm(xyzw, axis=1)
    what = "the quaternion is not of length 1; expected the columns of the format in its order"
    _raise_where(np.abs(norm - 1) > POSE_TOLERANCE, where, what)
    return np.concatenate([Rotation.from_quat(xyzw).as_matrix(), translation[:, :, None]], 2)


def _read_tum(path: Path, size: tuple[int, int]) -> _PoseFile:
    """Read TUM rows: seconds, world_from_cam; metres unless the header is our own and says no."""
    rows, where = _read_table(path, (8,), "TUM rows: t tx ty tz qx qy qz qw")
    world_from_cam = _from_quaternions(rows[:, 4:], rows[:, 1:4], where)
    metric = re.search(f"^#.*{NO_SCALE}", read_text(path), re.MULTILINE) is None
    return _PoseFile(invert_rigid(world_from_cam), stamps_s=rows[:, 0], metric=metric)


def _read_record3d(path: Path, size: tuple[int, int]) -> _PoseFile:
    """Read Record3D's metadata: `poses` qx qy qz qw tx ty tz, world_from_cam, OpenGL axes, y up."""
    data = _json_object(path)
    try:
        rows = np.array(data["poses"], np.float64).reshape(-1, 7)
        fx, fy, cx, cy = (float(data["K"][i]) for i in (0, 4, 6, 7))
        camera = Camera("PINHOLE", int(data["w"]), int(data["h"]), (fx, fy, cx, cy))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ReobjError(
            f"{path}: no Record3D metadata ({error!r}); expected poses (N x 7), K (9), w and h"
        ) from None
    where = [f"{path}, poses[{i}]" for i in range(len(rows))]
    world_from_gl = _from_quaternions(rows[:, :4], rows[:, 4:], where)
    poses = CV_FROM_GL @ invert_rigid(world_from_gl)
    return _PoseFile(poses, camera, metric=True, up_in_world=np.array([0, 1.0, 0]))


def _read_scannet(path: Path, size: tuple[int, int]) -> _PoseFile:
    """Read ScanNet's `pose/<frame>.txt` (z up) or 7-Scenes' `*.pose.txt`: 4x4 world_from_cam.

    Metres; inf: no pose. ScanNet's intrinsics have the centre of the first pixel at (0, 0).
    """
    folder = path / "pose" if (path / "pose").is_dir() else path
    files = sorted(f for f in folder.glob("*.txt") if re.search(r"(\d|\.pose)$", f.stem))
    if not files:
        raise ReobjError(f"{folder}: no <frame number>.txt in it; expected a ScanNet pose folder")
    where, expected = [str(file) for file in files], "4 rows of 4 numbers"
    tables = [_read_table(file, (4,), expected, finite=False)[0] for file in files]
    _raise_where([len(table) != 4 for table in tables], where, f"expected {expected}")
    world_from_cam = _checked_rigid(np.array(tables), where)
    intrinsic = path / "intrinsic" / "intrinsic_color.txt"
    camera = None
    if intrinsic.exists():
        K, _ = _read_table(intrinsic, (3, 4), "a 3x3 or 4x4 matrix")
        camera = Camera("PINHOLE", *size, (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    up = np.array([0, 0, 1.0]) if folder.name == "pose" else None
    names = tuple(file.stem for file in files)
    return _PoseFile(invert_rigid(world_from_cam), camera, names, metric=True, up_in_world=up)


def _read_transforms(path: Path, size: tuple[int, int]) -> _PoseFile:
    """Read nerfstudio's or instant-ngp's transforms.json: world_from_cam, OpenGL axes; no scale.

    nerfstudio turned the world by `applied_transform` A; this is undone:
    world_from_cv = inv(A) world_from_gl diag(1, -1, -1, 1).
    """
    path = path / "transforms.json" if path.is_dir() else path
    data = _json_object(path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ReobjError(f"{path}: no `frames`; expected nerfstudio's or ngp's transforms.json")
    where = [f"{path}, frames[{i}]" for i in range(len(frames))]
    try:
        matrix = np.array([f["transform_matrix"] for f in frames], np.float64).reshape(-1, 4, 4)
        names = tuple(str(f["file_path"]) for f in frames)
        cameras = [_transforms_camera({**data, **f}, size) for f in frames]
        applied = np.eye(4)
        applied[:3] = np.array(data.get("applied_transform", applied), np.float64)[:3]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        what = f"a frame without a 4x4 transform_matrix and file_path ({error!r})"
        raise ReobjError(f"{path}: {what}") from None
    gl_from_world = invert_rigid(_checked_rigid(matrix, where)) @ applied  # (N, 3, 4)
    return _PoseFile(CV_FROM_GL @ gl_from_world, _one_camera(cameras, path), names)


def _transforms_camera(data: dict[str, Any], size: tuple[int, int]) -> Camera | None:
    """Make the camera of a frame of transforms.json; None without a focal length."""
    width, height = int(data.get("w", size[0])), int(data.get("h", size[1]))
    focal = data.get("fl_x")
    if focal is None and "camera_angle_x" in data:
        focal = 0.5 * width / math.tan(0.5 * float(data["camera_angle_x"]))
    if focal is None:
        return None
    fisheye = data.get("is_fisheye") or "FISHEYE" in str(data.get("camera_model", "")).upper()
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    centre = (data.get("cx", width / 2), data.get("cy", height / 2))
    terms = (focal, data.get("fl_y", focal), *centre, *(data.get(key, 0) for key in keys))
    params = tuple(float(value) for value in terms)
    if not fisheye and not any(params[4:]):
        return Camera("PINHOLE", width, height, params[:4])
    return Camera("OPENCV_FISHEYE" if fisheye else "OPENCV", width, height, params)


MAX_FOCAL_SPREAD = 0.02  # of the images of one camera, a share: autofocus (chosen)


def _one_camera(cameras: Sequence[Camera | None], path: Path) -> Camera | None:
    """Return the one camera of all images: the median of slightly different focal lengths."""
    found = sorted((c for c in cameras if c is not None), key=lambda c: c.params[0])
    if not found:
        return None
    kinds = {(c.model, c.width, c.height) for c in found}
    spread = found[-1].params[0] / found[0].params[0] - 1
    if len(kinds) > 1 or spread > MAX_FOCAL_SPREAD:
        raise ReobjError(f"{path}: several different cameras; expected one (single_camera)")
    return found[len(found) // 2]


def _read_colmap(path: Path, size: tuple[int, int]) -> _PoseFile:
    """Read a COLMAP model, binary (preferred) or text, with or without rigs; scale unknown."""
    start = path if path.is_dir() else path.parent
    folders = [start / part for part in ("", "sparse/0", "sparse", "0", "colmap/sparse/0")]
    found = [f for suffix in (".bin", ".txt") for f in folders if (f / f"images{suffix}").exists()]
    if not found:
        raise ReobjError(
            f"{path}: no images.bin or .txt; expected a COLMAP model, or see --pose-format"
        )
    if not (found[0] / "images.bin").exists():
        return _read_colmap_text(found[0])
    try:
        model = read_sparse_model(found[0])
    except (ValueError, RuntimeError, LookupError, MemoryError) as error:
        reason = str(error).splitlines()[0]
        raise ReobjError(f"{found[0]}: not a COLMAP model ({reason}); write it again") from None
    if not model.names:
        raise ReobjError(f"{found[0]}: the COLMAP model has no registered image")
    camera = _one_camera(model.cameras, found[0])
    return _PoseFile(
        model.cam_from_world,
        camera,
        model.names,
        points=model.points,
        colors=model.colors,
        visibility=np.column_stack([model.obs_image, model.obs_point]),
    )


def _read_colmap_text(folder: Path) -> _PoseFile:
    """Read a COLMAP text model, also one of poses alone.

    Many tools leave out points3D.txt, or the line of observations after each image: pycolmap
    refuses the first, and with the second takes every other image for observations.
    """
    cameras = _colmap_text_cameras(folder / "cameras.txt")
    rows: list[list[float]] = []
    names, used, where = [], [], []
    row_of: dict[str, int] = {}
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    observations_next = False
    for at, words in _lines(folder / "images.txt"):
        triples = len(words) % 3 == 0 and all(w.lstrip("-").isdigit() for w in words[2::3])
        if not words or (observations_next and triples):
            observations_next = False
            continue
        if len(words) < 10:
            raise ReobjError(f"{at}: expected {expected}")
        if words[8] not in cameras:
            raise ReobjError(f"{at}: no camera {words[8]} in cameras.txt")
        row_of[words[0]] = len(rows)
        rows.append(_numbers(words[1:8], at, expected))
        names.append(" ".join(words[9:]))
        used.append(cameras[words[8]])
        where.append(at)
        observations_next = True
    if not rows:
        raise ReobjError(f"{folder / 'images.txt'}: no images in it")
    quaternion_wxyz, translation = np.split(np.array(rows), [4], axis=1)  # (N, 4), (N, 3)
    poses = _from_quaternions(np.roll(quaternion_wxyz, -1, 1), translation, where)
    points = _colmap_text_points(folder / "points3D.txt", row_of)
    return _PoseFile(poses, _one_camera(used, folder), tuple(names), None, False, None, *points)


def _colmap_text_cameras(path: Path) -> dict[str, Camera]:
    """Read cameras.txt: camera of each id."""
    cameras = {}
    for at, words in _lines(path):
        try:
            _, _, width, height, *params = words
            camera = Camera(words[1], int(width), int(height), tuple(map(float, params)))
            valid = np.isfinite(camera.params).all() and camera.to_pycolmap().verify_params()
        except (ValueError, TypeError, IndexError, RuntimeError):
            valid = not words  # a blank line
        if not valid:
            expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], with COLMAP's models"
            raise ReobjError(f"{at}: expected {expected}")
        if words:
            cameras[words[0]] = camera
    return cameras


def _colmap_text_points(
    path: Path, row_of: dict[str, int]
) -> tuple[Array, npt.NDArray[np.uint8], IntArray]:
    """Read the points of a points3D.txt by ascending id, if it exists.

    Args:
        row_of: row of each image id; a track may name images that are left out.
    Returns:
        points (N, 3), colours (N, 3), and which images observed which points (M, 2): rows.
    """
    rows: list[list[float]] = []
    tracks, expected = {}, "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    for at, words in _lines(path) if path.exists() else ():
        if words and len(words) < 8:
            raise ReobjError(f"{at}: expected {expected}")
        if words:
            rows.append(_numbers(words[:7], at, expected))
            tracks[rows[-1][0]] = words[8::2]  # IMAGE_ID POINT2D_IDX ...
    table = np.array(sorted(rows)).reshape(-1, 7)
    seen = [
        (row_of[image], point)
        for point, number in enumerate(table[:, 0].tolist())
        for image in tracks[number]
        if image in row_of
    ]
    visibility = np.array(seen, np.int64).reshape(-1, 2)
    return table[:, 1:4], table[:, 4:].clip(0, 255).astype(np.uint8), visibility


def _rows_of_frames(
    given: _PoseFile, path: Path, frame: IntArray, time_s: Array, names: Sequence[str]
) -> tuple[IntArray, list[str]]:
    """Find the row of each frame in a file of poses by name, time stamp or order.

    Returns:
        row (F,), -1 where it has none; messages.
    """
    count = len(given.cam_from_world)
    messages: list[str] = []
    if given.names:
        row = _rows_by_name(given.names, frame, names)
        what = f"images {given.names[0]!r} ..., frames {names[0] if len(names) else frame[0]!r} ..."
    elif given.stamps_s is not None:
        row, messages = _rows_by_time(given.stamps_s, frame, time_s)
        what = f"{given.stamps_s[0]:.3f}-{given.stamps_s[-1]:.3f} s, "
        what += f"frames {time_s[0]:.3f}-{time_s[-1]:.3f} s"
    else:
        row = np.arange(count) if count == len(frame) else frame.copy()
        what = f"{count} rows, frame numbers up to {frame.max()}; expected one row a frame"
        row[row >= count] = -1
        if frame.max() >= count != len(frame):
            raise ReobjError(f"{path}: {what}")
    if (row < 0).all():
        raise ReobjError(f"{path}: none of its {count} poses belongs to a frame ({what})")
    return row, messages


def _rows_by_name(given: Sequence[str], frame: IntArray, names: Sequence[str]) -> IntArray:
    """Match by path, else file name, else stem, else the last number in the name.

    Numbers are frame numbers; they count from 1 where there is a 1, no 0, and one too many.
    """
    for key in (str, lambda n: Path(n).name, lambda n: Path(n).stem):
        rows = {key(name): r for r, name in enumerate(given)}
        found = np.array([rows.get(key(name), -1) for name in names], np.int64)
        if (found >= 0).any():
            return found
    digits = [re.findall(r"\d+", Path(name).stem) for name in given]
    numbers = np.array([int(d[-1]) if d else -1 for d in digits])  # (N,)
    from_one = 0 not in numbers and 1 in numbers and numbers.max() > frame.max()
    row_of = dict(zip((numbers - from_one).tolist(), range(len(given)), strict=True))
    return np.array([row_of.get(n, -1) for n in frame.tolist()], np.int64)


LONE_FRAME_S = 1 / 60  # half a frame interval where there is only one frame (chosen: 30 Hz)


def _rows_by_time(stamps_s: Array, frame: IntArray, time_s: Array) -> tuple[IntArray, list[str]]:
    """Match the nearest stamp within half a frame interval.

    Stamps of another clock (no overlap in time) are matched in order if there is one for each
    frame.

    Returns:
        row (F,) of each frame, -1: none; messages.
    """
    if len(stamps_s) == len(frame) and (stamps_s[0] > time_s[-1] or stamps_s[-1] < time_s[0]):
        message = "time stamps are of another clock than the frames: matched in order"
        return np.arange(len(frame)), [message]
    steps = np.diff(time_s) / np.maximum(np.diff(frame), 1)
    half = 0.5 * float(np.median(steps)) if len(steps) else LONE_FRAME_S
    nearest = np.abs(stamps_s[None] - time_s[:, None]).argmin(1)  # (F,)
    return np.where(np.abs(stamps_s[nearest] - time_s) <= half * (1 + 1e-6), nearest, -1), []


READERS: dict[str, Callable[[Path, tuple[int, int]], _PoseFile]] = {
    "colmap": _read_colmap,
    "tum": _read_tum,
    "transforms": _read_transforms,
    "scannet": _read_scannet,
    "record3d": _read_record3d,
}
