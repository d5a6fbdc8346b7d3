"""Poses made elsewhere: COLMAP, TUM, transforms.json, ScanNet, 7-Scenes, Record3D, ARKit.

Each format has a reader that turns its conventions into cam_from_world, OpenCV axes, COLMAP pixels;
`read_poses` then finds the frame of each pose. Whether the conventions were those that the file
claims is judged later, by `checks`.
"""

from __future__ import annotations

import re
import struct
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
    WORLD_MAX,
    Camera,
    Poses,
    invert_rigid,
    read_sparse_model,
    usable,
)
from reobj.files import load_json, read_lines, spans
from reobj.poses.intrinsics import (
    CAMERA_FORMS,
    camera_from_json,
    colmap_camera,
    fitted_camera,
    image_side,
    parse_camera,
)
from reobj.poses.matching import interpolated, rows_by_name, rows_by_order, rows_by_time
from reobj.types import Array, IntArray, ReobjError


def read_poses(
    path: str | Path, video: Any, fmt: str = "auto", camera: str = "", metric: bool = False
) -> Poses:
    """Read the poses of a video's frames from a file or folder of another tool.

    Args:
        path: file or folder. video: the frames they belong to.
        fmt: auto (recognised), colmap, tum, transforms, scannet, record3d or arkit.
        camera: intrinsics in place of the file's, as `--camera` takes them.
        metric: the poses are in metres, also where the format does not say so.
    Returns:
        poses of the frames that the file knows, NaN for the others (counted in `messages`).
    Raises:
        ReobjError: damaged, unknown, not rigid, without intrinsics, or of another video.
    """
    path, size = Path(path), (int(video.size[0]), int(video.size[1]))
    given = read_pose_file(path, fmt, size)
    intrinsics = parse_camera(camera, size)
    if intrinsics is None:
        if given.camera is None:
            raise ReobjError(f"{path}: no intrinsics; add --camera {CAMERA_FORMS}")
        intrinsics = fitted_camera(given.camera, size, str(path))
    if not usable(intrinsics):
        raise ReobjError(f"{path}: {intrinsics}: expected finite numbers, focal lengths above 0")
    numbers = [(frame.index, frame.time_s) for frame in video]
    if not numbers:
        raise ReobjError("the video has no frame that can be read: poses belong to nothing")
    frame, time_s = np.array([n for n, _ in numbers], np.int64), np.array([t for _, t in numbers])
    row, what, messages = _rows_of_frames(given, path, frame, time_s, video)
    poses = np.full((len(frame), 3, 4), np.nan)
    poses[row >= 0] = given.cam_from_world[row[row >= 0]]
    if given.stamps_s is not None and len(given.stamps_s) > 1:
        exact, use = interpolated(given.cam_from_world, given.stamps_s, time_s)
        poses[use & (row >= 0)] = exact[row[use] >= 0]
    known = np.isfinite(poses).all((1, 2))
    if (np.abs(poses[known]) >= WORLD_MAX).any():
        raise ReobjError(f"{path}: a camera is more than {WORLD_MAX:g} units away from the origin")
    if not known.any():
        count = len(given.cam_from_world)
        raise ReobjError(f"{path}: none of its {count} poses belongs to a frame ({what})")
    if not known.all():
        step = int(np.median(np.diff(frame))) if len(frame) > 1 else 1
        lost = spans(frame[~known].tolist(), step)
        messages.append(f"{path}: poses for {known.sum()} of {len(frame)} frames, none for {lost}")
    status = np.where(known, "supplied", "none")
    return Poses(
        intrinsics, frame, time_s, poses, status, "user",
        metric=given.metric or metric, up_in_world=given.up_in_world, points=given.points,
        colors=given.colors, visibility=_in_frames(given.visibility, row), messages=tuple(messages),
    )  # fmt: skip


def read_pose_file(path: Path, fmt: str, size: tuple[int, int]) -> PoseFile:
    """Read a file or folder of poses in one of the formats of READERS, or the one recognised.

    Args:
        size: (w, h) of the images, for formats that do not state it.
    """
    if not path.exists():
        raise ReobjError(f"{path}: no such file; --poses takes auto, none, or a file of poses")
    reader = READERS.get(_pose_format(path) if fmt == "auto" else fmt)
    if reader is None:
        raise ReobjError(f"--pose-format {fmt}: unknown; known are auto, {', '.join(READERS)}")
    return reader(path, size)


def _rows_of_frames(
    given: PoseFile, path: Path, frame: IntArray, time_s: Array, video: Any
) -> tuple[IntArray, str, list[str]]:
    """Find the row of each frame in a file of poses by name, time stamp or order.

    Returns:
        row (F,), -1 where it has none; what was compared; messages.
    """
    images, names = video.names, [video.names[n] for n in frame if video.names]
    if given.names:
        what = f"images {given.names[0]!r} ..., frames {names[0] if len(names) else frame[0]!r} ..."
        return rows_by_name(given.names, frame, names, images), what, []
    if given.stamps_s is not None:
        what = f"{given.stamps_s[0]:.3f}-{given.stamps_s[-1]:.3f} s, "
        what += f"frames {time_s[0]:.3f}-{time_s[-1]:.3f} s; another clock: one for each frame"
        row, messages = rows_by_time(given.stamps_s, frame, time_s, video.frame_count)
        return row, what, messages
    try:
        row = rows_by_order(len(given.cam_from_world), frame, names, images)
        return row, "in order", []
    except ReobjError as error:
        raise ReobjError(f"{path}: {error}") from None


def _in_frames(visibility: IntArray, row: IntArray) -> IntArray:
    """Replace rows of poses (M, 2) by those of the frames that have them; others fall out."""
    frame_of = np.full(int(max(row.max(initial=-1), visibility[:, 0].max(initial=-1))) + 1, -1)
    frame_of[row[row >= 0]] = np.flatnonzero(row >= 0)
    at = frame_of[visibility[:, 0]]
    return np.column_stack([at, visibility[:, 1]])[at >= 0]


@dataclass(frozen=True, slots=True)
class PoseFile:
    """Hold what a reader returns: N poses in the order of the file, by time where they have one.

    Attributes:
        cam_from_world: (N, 3, 4), NaN where the file says that there is no pose.
        names, stamps_s: of the images, or their times: how their frames are found.
        visibility: (M, 2) row of the pose that observed a point, and row of the point.
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
        if path.name == "pose" or (path / "pose").is_dir() or any(path.glob("*.pose.txt")):
            return "scannet"
        return "arkit" if _arkit_files(path) else "colmap"
    if path.name.startswith("images."):
        return "colmap"
    if path.suffix == ".json" or path.name == "metadata":
        return "record3d" if "poses" in _json_object(path) else "transforms"
    return "tum"


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield where each line of a text file is (for messages) and its words, without comments."""
    for number, text in enumerate(read_lines(path), 1):
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
    _check_places(matrix[:, :3, 3], where)
    rotation = matrix[:, :3, :3].clip(-2, 2)  # the squares of 1e300 are too large
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3))  # (N, 3, 3)
    what = "the 3x3 part is no rotation (rows not of length 1 and perpendicular)"
    what += "; expected a row-major rigid pose without scale"
    _raise_where(error.max((1, 2)) > POSE_TOLERANCE, where, what)
    what = "the rotation is mirrored (determinant -1); turn two axes, not one"
    _raise_where(np.linalg.det(rotation) < 0, where, what)
    u, _, vt = np.linalg.svd(rotation)
    exact = np.concatenate([u @ vt, matrix[:, :3, 3:]], 2)
    return np.where(lost[:, None, None], np.nan, exact)


def _check_places(translation: Array, where: Sequence[str]) -> None:
    """Refuse translations (N, 3) beyond WORLD_MAX."""
    far = (np.abs(translation) >= WORLD_MAX).any(1)
    _raise_where(far, where, f"more than {WORLD_MAX:g} units away from the origin")


def _raise_where(bad: Any, where: Sequence[str], problem: str) -> None:
    """Refuse the input if anything in it is bad (N,): the first place and the problem."""
    if np.any(bad):
        raise ReobjError(f"{where[int(np.argmax(bad))]}: {problem}")


def _from_quaternions(xyzw: Array, translation: Array, where: Sequence[str]) -> Array:
    """Make rigid transforms (N, 3, 4) of unit quaternions (N, 4) and translations (N, 3)."""
    finite = np.isfinite(np.column_stack([xyzw, translation])).all(1)
    _raise_where(~finite, where, "a number is not finite")
    _check_places(translation, where)
    norm = np.linalg.norm(xyzw.clip(-2, 2), axis=1)
    what = "the quaternion is not of length 1; expected the columns of the format in its order"
    _raise_where(np.abs(norm - 1) > POSE_TOLERANCE, where, what)
    return np.concatenate([Rotation.from_quat(xyzw).as_matrix(), translation[:, :, None]], 2)


def _read_tum(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read TUM rows: seconds, world_from_cam; metres unless the header is our own and says no."""
    rows, where = _read_table(path, (8,), "TUM rows: t tx ty tz qx qy qz qw")
    world_from_cam = _from_quaternions(rows[:, 4:], rows[:, 1:4], where)
    metric = not any(re.match(f"#.*{NO_SCALE}", line) for line in read_lines(path))
    order = np.unique(rows[:, 0], return_index=True)[1]
    return PoseFile(invert_rigid(world_from_cam)[order], stamps_s=rows[order, 0], metric=metric)


def _read_record3d(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read Record3D's metadata: `poses` qx qy qz qw tx ty tz, world_from_cam, OpenGL axes, y up."""
    data = _json_object(path)
    try:
        rows = np.array(data["poses"], np.float64).reshape(-1, 7)
        fx, fy, cx, cy = (float(data["K"][i]) for i in (0, 4, 6, 7))
        camera = Camera("PINHOLE", image_side(data["w"]), image_side(data["h"]), (fx, fy, cx, cy))
    except (KeyError, TypeError, ValueError, IndexError):
        raise ReobjError(
            f"{path}: no Record3D metadata; expected numbers poses (N x 7), K (9), w and h"
        ) from None
    where = [f"{path}, poses[{i}]" for i in range(len(rows))]
    world_from_gl = _from_quaternions(rows[:, :4], rows[:, 4:], where)
    poses = CV_FROM_GL @ invert_rigid(world_from_gl)
    return PoseFile(poses, camera, metric=True, up_in_world=np.array([0, 1.0, 0]))


def _read_scannet(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read ScanNet's `pose/<frame>.txt` (z up) or 7-Scenes' `*.pose.txt`: 4x4 world_from_cam.

    Metres; inf: no pose. ScanNet's intrinsics have the centre of the first pixel at (0, 0).
    """
    path = path.parent if path.name == "pose" else path
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
        K, where_K = _read_table(intrinsic, (3, 4), "a 3x3 or 4x4 matrix")
        _raise_where([len(K) != K.shape[1]], where_K, f"{len(K)} rows, expected 3x3 or 4x4")
        camera = Camera("PINHOLE", *size, (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    up = np.array([0, 0, 1.0]) if folder.name == "pose" else None
    names = tuple(file.stem for file in files)
    return PoseFile(invert_rigid(world_from_cam), camera, names, metric=True, up_in_world=up)


def _arkit_files(path: Path) -> list[Path]:
    """List the files of cameras, one an image, of a raw export of an app that uses ARKit."""
    polycam = [path / "keyframes" / name for name in ("corrected_cameras", "cameras")]
    found = [sorted(path.glob("frame_*.json")), *(sorted(p.glob("*.json")) for p in polycam)]
    return next((files for files in found if files), [])


def _read_arkit(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read a raw export of Polycam or of 3D Scanner App: a JSON file for each image.

    world_from_cam row by row, `t_00` to `t_23` or `cameraPoseARFrame`; ARKit's axes (those of
    OpenGL), metres, y up.
    """
    files = _arkit_files(path)
    if not files:
        raise ReobjError(f"{path}: no frame_*.json, nor keyframes/cameras/*.json in it")
    data = [_json_object(file) for file in files]
    where = [str(file) for file in files]
    matrices, cameras = [], []
    for at, d in zip(where, data, strict=True):
        try:
            rows = d.get("cameraPoseARFrame") or [
                d[f"t_{i}{j}"] for i in range(3) for j in range(4)
            ]
            matrices.append(np.array([*rows, 0, 0, 0, 1][:16], np.float64).reshape(4, 4))
            cameras.append(camera_from_json(d, size))
        except (KeyError, TypeError, ValueError):
            what = "4x4 cameraPoseARFrame or t_00 to t_23, and intrinsics"
            raise ReobjError(f"{at}: no camera; expected numbers {what}") from None
    poses = CV_FROM_GL @ invert_rigid(_checked_rigid(np.array(matrices), where))
    names, up = tuple(file.stem for file in files), np.array([0, 1.0, 0])
    return PoseFile(poses, _one_camera(cameras, path), names, metric=True, up_in_world=up)


def _read_transforms(path: Path, size: tuple[int, int]) -> PoseFile:
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
    matrices, names, cameras = list[Array](), list[str](), list[Camera | None]()
    for at, f in zip(where, frames, strict=True):
        try:
            matrices.append(np.array(f["transform_matrix"], np.float64).reshape(4, 4))
            names.append(str(f["file_path"]))
            cameras.append(camera_from_json({**data, **f}, size))
        except ReobjError as error:
            raise ReobjError(f"{at}: {error}") from None
        except (KeyError, TypeError, ValueError, IndexError):
            what = "expected a 4x4 transform_matrix, file_path, and intrinsics that are numbers"
            raise ReobjError(f"{at}: {what}") from None
    applied = np.eye(4)
    try:
        applied[:3] = np.array(data.get("applied_transform", applied), np.float64)[:3]
    except (TypeError, ValueError, IndexError):
        applied[:] = np.nan
    if not np.isfinite(applied).all():
        raise ReobjError(f"{path}: applied_transform: expected 3x4 or 4x4 finite numbers")
    applied[:3] = _checked_rigid(applied[None], [f"{path}, applied_transform"])[0]
    world_from_gl = _checked_rigid(np.array(matrices), where)
    poses = CV_FROM_GL @ invert_rigid(world_from_gl) @ applied  # (N, 3, 4)
    return PoseFile(poses, _one_camera(cameras, path), tuple(names))


MAX_FOCAL_SPREAD = 0.02  # of the images of one camera, a share: autofocus (chosen)


def _one_camera(cameras: Sequence[Camera | None], path: Path) -> Camera | None:
    """Return the one camera of all images: the median of slightly different focal lengths."""
    found = sorted((c for c in cameras if c is not None), key=lambda c: c.params[0])
    if not found:
        return None
    kinds = {(c.model, c.width, c.height) for c in found}
    least, most = found[0].params[0], found[-1].params[0]
    spread = (most - least) / max(abs(least), 1e-9)
    if len(kinds) > 1 or spread > MAX_FOCAL_SPREAD:
        raise ReobjError(f"{path}: several different cameras; expected one (single_camera)")
    return found[len(found) // 2]


def _read_colmap(path: Path, size: tuple[int, int]) -> PoseFile:
    """Read a COLMAP model, binary (preferred) or text, with or without rigs; scale unknown."""
    start = path if path.is_dir() else path.parent
    folders = [start / part for part in ("", "sparse/0", "sparse", "0", "colmap/sparse/0")]
    found = [f for suffix in (".bin", ".txt") for f in folders if (f / f"images{suffix}").exists()]
    if not found:
        raise ReobjError(
            f"{path}: no images.bin or .txt; expected a COLMAP model, or transforms.json, "
            "pose/N.txt, *.pose.txt or an ARKit export in the folder; or name a file"
        )
    if not (found[0] / "images.bin").exists():
        return _read_colmap_text(found[0])
    try:
        _check_counts(found[0])
        model = read_sparse_model(found[0])
    except (ValueError, RuntimeError, LookupError, MemoryError, struct.error) as error:
        reason = str(error).splitlines()[0]
        raise ReobjError(f"{found[0]}: not a COLMAP model ({reason}); write it again") from None
    if not model.names:
        raise ReobjError(f"{found[0]}: the COLMAP model has no registered image")
    camera = _one_camera(model.cameras, found[0])
    seen = np.column_stack([model.obs_image, model.obs_point])
    last_row = np.tile([0, 0, 0, 1.0], (len(model.names), 1, 1))
    where = [f"{found[0] / 'images.bin'}, {name}" for name in model.names]
    poses = _checked_rigid(np.concatenate([model.cam_from_world, last_row], 1), where)
    return PoseFile(
        poses, camera, model.names, points=model.points, colors=model.colors,
        visibility=seen,
    )  # fmt: skip


# Records of COLMAP's binary files: bytes before a name, or before the number of what follows; the
# format of that number; bytes of each that follows
RECORDS = {
    "cameras.bin": (24, "", 0),
    "images.bin": (64, "<Q", 24),  # with a name
    "points3D.bin": (43, "<Q", 8),
    "frames.bin": (64, "<I", 16),
    "rigs.bin": (8, "", 0),
}


def _check_counts(folder: Path) -> None:
    """Refuse a binary model that claims more than it holds: pycolmap takes memory for the claim."""
    for name, (head, number, size) in RECORDS.items():
        if not (folder / name).exists():
            continue
        data = (folder / name).read_bytes()
        (count,), at = struct.unpack_from("<Q", data), 8
        if at + count * head > len(data):
            raise ValueError(f"{name} claims {count} records in {len(data)} bytes")
        for _ in range(count if number else 0):
            at += head
            if name == "images.bin":
                at = data.index(b"\0", at) + 1
            (n,) = struct.unpack_from(number, data, at)
            at += struct.calcsize(number) + n * size
            if at > len(data):
                raise ValueError(f"{name} claims {n} entries in {len(data)} bytes")


def _read_colmap_text(folder: Path) -> PoseFile:
    """Read a COLMAP text model, also one of poses alone.

    Many tools leave out points3D.txt, or the line of observations after each image: pycolmap
    refuses the first, and with the second takes every other image for observations.
    """
    cameras = _colmap_text_cameras(folder / "cameras.txt")
    names, used, where = [], [], []
    rows: list[list[float]] = []
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
    xyz, colors, seen = _colmap_text_points(folder / "points3D.txt", row_of)
    camera = _one_camera(used, folder)
    return PoseFile(poses, camera, tuple(names), points=xyz, colors=colors, visibility=seen)


def _colmap_text_cameras(path: Path) -> dict[str, Camera]:
    """Read cameras.txt: camera of each id."""
    cameras = {}
    for at, words in _lines(path):
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
    tracks, expected = [], "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    for at, words in _lines(path) if path.exists() else ():
        if words and len(words) < 8:
            raise ReobjError(f"{at}: expected {expected}")
        if words:
            rows.append(_numbers(words[:7], at, expected))
            tracks.append([row_of[i] for i in words[8::2] if i in row_of])
    table = np.array(rows).reshape(-1, 7)
    order = np.argsort(table[:, 0], kind="stable")
    seen = [(image, point) for point, at in enumerate(order) for image in tracks[at]]
    table = table[order]
    colors = table[:, 4:].clip(0, 255).astype(np.uint8)
    return table[:, 1:4], colors, np.array(seen, np.int64).reshape(-1, 2)


READERS: dict[str, Callable[[Path, tuple[int, int]], PoseFile]] = {
    "colmap": _read_colmap,
    "tum": _read_tum,
    "transforms": _read_transforms,
    "scannet": _read_scannet,
    "record3d": _read_record3d,
    "arkit": _read_arkit,
}
