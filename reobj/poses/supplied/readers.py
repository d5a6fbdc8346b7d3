"""Read the poses of a video's frames from files of other tools: the registry POSES.

The reader of each format converts its conventions to cam_from_world, OpenCV axes, COLMAP pixels
(`pose_formats`); poses are then assigned to frames (`frame_assignment`). Whether the file follows
its conventions is checked later, against images or tracks (`check`). `open_video` opens a video, or
without one the frames of the files of poses and detections.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, camera_parameters, invert_rigid
from reobj.files import spans
from reobj.formats import AUTO, Format, Probe, Registry, frames_by_name
from reobj.poses.estimate import PosesConfig
from reobj.poses.intrinsics import (
    CAMERA_FORMS,
    fitted_camera,
    parse_camera,
    refuse_unusable,
    stated_camera,
)
from reobj.poses.supplied import pose_formats as formats
from reobj.poses.supplied.check import Supplied
from reobj.poses.supplied.frame_assignment import (
    SourceFrames,
    assign,
    by_numbers,
    interpolated,
    numbers_of_names,
    numbers_of_times,
    seconds_of,
    source_of,
)
from reobj.poses.supplied.pose_formats import PoseFile, Size
from reobj.sources.detection_files import DetectConfig, described_images, read_detections
from reobj.sources.image_files import exif_orientation, sorted_names
from reobj.sources.video import ImagelessVideo, InputConfig, Video
from reobj.types import NOTE_START, Array, BoolArray, IntArray, ReobjError


def read_poses(
    path: str | Path,
    video: Any,
    fmt: str = AUTO,
    camera: str = "",
    metric: bool = False,
    frames_by: str = "",
    camera_format: str = AUTO,
) -> Poses:
    """Read the poses of a video's frames from a file or folder of another tool.

    Args:
        path: file or folder. video: the frames they belong to.
        fmt: auto (recognised), or a format of POSES.
        camera: intrinsics in place of the file's, in the forms of `--camera`. camera_format: auto,
            or the format of its file, of CAMERAS.
        metric: the poses are in metres, whatever the format.
        frames_by: the assignment to frames, where the file is ambiguous: `number0`, `number1`,
            `time`, ... as listed in the error.
    Returns:
        poses of all frames, NaN where the file has none (counted in `messages`).
    Raises:
        ReobjError: damaged, unknown, not rigid, without intrinsics, of another video, or with
            several formats or assignments to frames.
    """
    config = PosesConfig(str(path), fmt, frames_by, camera, camera_format, metric)
    return read_supplied(video, config).poses


def read_supplied(video: Any, config: PosesConfig) -> Supplied:
    """Read poses as `read_poses` does, and keep what `check` needs to name a mistake."""
    path = Path(config.mode)
    size = (int(video.size[0]), int(video.size[1]))
    file = read_pose_file(path, config.fmt, size)
    stated = parse_camera(config.camera, size, config.camera_format)
    if stated is None and not any(file.cameras):
        raise ReobjError(f"{path}: no intrinsics; add --camera {CAMERA_FORMS}")
    source = source_of(video)
    stamps_s = None if file.stamps is None else seconds_of(file.stamps, file.unit)
    assignment = assign(file, stamps_s, source, str(path), config.frames_by)
    row = assignment.row
    used = np.flatnonzero(row >= 0)  # (n,)
    cam_from_world = np.where((row >= 0)[:, None, None], file.cam_from_world[row], np.nan)
    if assignment.key == "time" and stamps_s is not None:
        between, use = interpolated(file.cam_from_world, stamps_s, source.time_s)
        cam_from_world[use & (row >= 0)] = between[row[use] >= 0]
    turns = turns_of(source, size, file.cameras, row) if file.stored_pixels else {}
    cameras = file.cameras
    if len(cameras) == len(file.cam_from_world) > 1:  # those of the frames
        cameras = tuple(turned(cameras[row[f]], turns.get(f)) for f in used.tolist())
    for f, turn in turns.items():
        cam_from_world[f, :2] = turn @ cam_from_world[f, :2]
    camera = stated or one_camera(cameras, path, size)
    known = np.asarray(np.isfinite(cam_from_world).all((1, 2)), bool)
    metric = config.metric or file.metric is not False
    if metric:
        _check_units(cam_from_world, path)
    frame_of = np.full(len(file.cam_from_world), -1)
    frame_of[row[used]] = used
    seen = np.column_stack([frame_of[file.visibility[:, 0]], file.visibility[:, 1]])
    assumed = METRES_ASSUMED * (file.metric is None and not config.metric)
    messages: list[str] = []
    facts: list[str] = []
    if turns:
        messages = [f"{len(turns)} photos have an EXIF orientation, which COLMAP ignores: its "
                    "cameras are turned with them"]  # fmt: skip
    if not known.all():
        step = int(np.median(np.diff(source.frame))) if len(known) > 1 else 1
        without = spans(source.frame[~known].tolist(), step)
        facts.append(f"poses for {known.sum()} of {len(known)} frames, none for {without}")
    if lost := int((~np.isfinite(file.cam_from_world).all((1, 2))).sum()):
        facts.append(f"{lost} poses of lost frames (the identity, zeros, not finite)")
    messages += [f"{path}: {'; '.join(facts)}"] * bool(facts)
    poses = Poses(
        camera, source.frame, source.time_s, cam_from_world,
        np.where(known, "supplied", "none"), "user", metric=metric,
        up_in_world=file.up_in_world, points=file.points, colors=file.colors,
        visibility=seen[seen[:, 0] >= 0],
        messages=(*file.messages, *messages),
        reading=f"{file.kind}{assumed}, frames by {assignment.rule}",
    )  # fmt: skip
    return Supplied(poses, file.axes)


LARGE_M, FAST_M = 100.0, 0.5  # radius of a path, and a step in it, that none has indoors


def _check_units(cam_from_world: Array, path: Path) -> None:
    """Refuse a path (F, 3, 4) in metres that no camera takes indoors."""
    centre = invert_rigid(cam_from_world)[:, :, 3]
    centre = centre[np.isfinite(centre).all(1)]  # (n, 3)
    steps = np.linalg.norm(np.diff(centre, axis=0), axis=1)
    radius = np.linalg.norm(centre - np.median(centre, axis=0), axis=1).max(initial=0.0)
    if radius > LARGE_M and np.median(steps) > FAST_M:
        raise ReobjError(
            f"{path}: the cameras move by {np.median(steps):.3g} between frames, within a radius "
            f"of {radius:.3g}; expected metres (mm, cm? divide the translations by 1000, 100)"
        )


MAX_SPREAD = 0.02  # of focal lengths over the images of one camera, by autofocus


def one_camera(cameras: Sequence[Camera | None], path: Path, size: Size) -> Camera:
    """Return the single camera of images: the median of slightly different focal lengths.

    Args:
        size: (w, h) of the frames, to which it is resized.
    Raises:
        ReobjError: none, or they differ by more than MAX_SPREAD in focal length or principal point,
            or in model or size.
    """
    found = sorted(filter(None, cameras), key=lambda camera: camera.params[0])
    for camera in found:
        refuse_unusable(camera, str(path))
    kinds = sorted({f"{c.model} {c.width}x{c.height}" for c in found})
    K = np.array([camera.K for camera in found])  # (n, 3, 3)
    if len(kinds) > 1 or np.ptp(K, axis=0).max() > MAX_SPREAD * K[0, 0, 0]:
        spread = f"focal lengths {K[0, 0, 0]:.4g}-{K[-1, 0, 0]:.4g}"
        raise ReobjError(
            f"{path}: several different cameras took the frames ({', '.join(kinds[:3])}, {spread});"
            " expected one: give its intrinsics with --camera, or reconstruct with a single camera"
        )
    return fitted_camera(found[len(found) // 2], size, str(path))


# ---- EXIF orientations: COLMAP's cameras are those of the stored pixels --------------------------

# upright_from_stored (2, 2): of offsets from the middle of the image
TURNS = {3: -np.eye(2), 6: np.array([[0.0, -1], [1, 0]]), 8: np.array([[0.0, 1], [-1, 0]])}


def turns_of(
    source: SourceFrames, size: Size, cameras: Sequence[Camera | None], row: IntArray
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
    if unknown := [n for n in names if not re.fullmatch(r"[fc][xy]?|k\d?|p[12]|omega", n)]:
        raise ReobjError(
            f"a {camera.model} camera is not turned with the EXIF orientation of its photos "
            f"({', '.join(unknown)}); store them upright and reconstruct them again"
        )
    values = dict(zip(names, camera.params, strict=True))
    stored = np.array([camera.width, camera.height])
    size = np.abs(turn @ stored).astype(int)
    if "p2" in values:  # (p2, p1) r^2 + 2 ((p2, p1) x) x: a vector of the image
        values["p2"], values["p1"] = turn @ [values["p2"], values["p1"]]
    if "fx" in values:
        values["fx"], values["fy"] = np.abs(turn @ [values["fx"], values["fy"]])
    centre = turn @ (np.array([values["cx"], values["cy"]]) - stored / 2) + size / 2
    values["cx"], values["cy"] = centre
    width, height = size.tolist()
    return Camera(camera.model, width, height, tuple(float(values[name]) for name in names))


# ---- Formats -------------------------------------------------------------------------------------


def read_pose_file(path: Path, fmt: str, size: Size) -> PoseFile:
    """Read a file or folder of poses in a format of POSES, or recognise it.

    Args:
        size: (w, h) of the images, for formats that do not state it.
    """
    entry = POSES.find(path, fmt)
    try:
        found = entry.read(path, size)
    except ReobjError as error:
        text = str(error)  # of a file beside it, or without a name
        raise ReobjError(text if str(path) in text else f"{path}: {text}") from None
    except Exception as error:  # files of other tools lack any key, or hold any type
        text = f"damaged, or no file of format {entry.name} ({error!r:.100})"
        raise ReobjError(f"{path}: {text}") from None
    metric = {METRES: True, UNKNOWN: False}.get(entry.units, found.metric)
    kind = f"{entry.name} {found.kind}".strip()
    return _without_lost(dataclasses.replace(found, metric=metric, kind=kind), path)


def _without_lost(found: PoseFile, path: Path) -> PoseFile:
    """Sort poses by their time stamps, without repeated ones, and remove those of lost frames.

    These are the identity in the axes of the file. It is a pose where it begins the path, where it
    is the only one of poses with names, and where there is no other pose.
    """
    poses = found.cam_from_world
    stamps = found.stamps
    messages = found.messages
    if stamps is not None:
        if not np.isfinite(stamps).all():
            raise ReobjError(f"{path}: a time stamp is not finite")
        stamps, kept = np.unique(stamps, return_index=True)
        if repeated := len(poses) - len(kept):
            messages += (f"{path}: {repeated} rows repeat a time stamp and are left out",)
        poses = poses[kept]
    identity = np.column_stack([found.axes, np.zeros(3)])
    lost: BoolArray = np.all(np.abs(poses - identity) < 1e-9, axis=(1, 2))  # (N,)
    begins = lost[:1].any() and not lost[1:2].any()
    if begins or (found.names and lost.sum() == 1):
        lost[lost.argmax()] = False
    poses = np.where((lost & ~lost.all())[:, None, None], np.nan, poses)
    if not np.isfinite(poses).all((1, 2)).any():
        raise ReobjError(f"{path}: no poses in it, or only those of lost frames")
    return dataclasses.replace(found, cam_from_world=poses, stamps=stamps, messages=messages)


def _head(probe: Probe) -> tuple[str, list[str], str]:
    """Return the header, and words and text of the first row, of a table; else "", [], ""."""
    probe = Probe(formats._file(probe.path, *formats.TABLES)) if probe.is_dir else probe
    for k, line in enumerate(probe.lines):
        words = line.replace(",", " ").split()
        if words and all(map(formats.is_number, words)):
            return "\n".join(probe.lines[:k]), words, line
    return "", [], ""


def _is_ours(probe: Probe) -> bool:
    """Test for an output folder of this tool."""
    return {"poses.txt", "sparse"} <= probe.names and formats.OUR_HEADER in _head(probe)[0]


def _is_euroc(probe: Probe) -> bool:
    """Test for 17 columns, or for 8 with ns, and w first by a header, or commas without one."""
    header, words, line = _head(probe)
    if "data.csv" in probe.names or len(words) == 17 or "_RS_" in header:
        return True
    named = formats.named_columns(header, 8)
    w_first = named[6] < named[3] if named else "," in line
    in_ns = "ns" in re.split("[^a-z]+", header.lower())
    return len(words) == 8 and w_first and (in_ns or len(words[0].partition(".")[0]) >= 16)


def _is_tum(probe: Probe) -> bool:
    """Test for 8 columns; without a header ns with commas may be EuRoC's as well."""
    header, words, _ = _head(probe)
    is_euroc = formats.named_columns(header, 8) is not None and _is_euroc(probe)
    return len(words) == 8 and not is_euroc and "_RS_" not in header and not _is_ours(probe)


def _is_colmap(probe: Probe) -> bool:
    """Test for a model; not that from which nerfstudio's transforms.json beside it was made."""
    if probe.is_dir:
        has_copy = {"transforms.json", "colmap"} <= probe.names or _is_ours(probe)
        return not has_copy and bool(formats.find_models(probe.path))
    return probe.path.stem in ("cameras", "images", "points3D", "frames", "rigs") and (
        probe.suffix in (".bin", ".txt")
    )


def _has(name: str, *keys: str) -> Callable[[Probe], bool]:
    """Make a test for a folder with a file, or a JSON file whose (first) object has these keys."""

    def test(probe: Probe) -> bool:
        data = probe.json if not probe.is_dir else None
        if not isinstance(data, dict | list):
            return name in probe.names
        first = next(iter(data.values() if isinstance(data, dict) else data), None)
        return any(isinstance(one, dict) and {*keys} <= one.keys() for one in (data, first))

    return test


ReadPoses = Callable[[Path, Size], PoseFile]
NAME, TIME, ORDER = "name, number", "time", "order"
METRES, UNKNOWN = "metres", "unknown"
UNSTATED = "not stated: metres, or as `# units: arbitrary` in the file says"
METRES_ASSUMED = ", metres assumed (no `# units:` in the file)"
GIVE = "no intrinsics (`--camera`)"
POSES: Registry[ReadPoses] = Registry("poses", "--pose-format", [
    Format("colmap", "COLMAP: model, binary (preferred) or text, with its points", _is_colmap,
           formats.read_colmap, NAME, UNKNOWN, "cameras of images that are no frames"),
    Format("tum", "TUM, ORB-SLAM3: rows `t tx ty tz qx qy qz qw`, or as a header names them",
           _is_tum, formats.read_tum, TIME, UNSTATED, GIVE),
    Format("reobj", "this tool: output folder, `poses.txt` with the camera of `sparse/`", _is_ours,
           formats.read_ours, TIME, "as the header says", "points"),
    Format("euroc", "EuRoC: CSV of 8 or 17 columns, ns, body, quaternion w first; `T_BS` of "
           "`sensor.yaml` beside it or in `cam0`", _is_euroc, formats.read_euroc, TIME, METRES,
           "velocities, biases"),
    Format("matrices", "KITTI (12), Replica, NICE-SLAM (16): rows of matrices, row-major",
           lambda p: len(_head(p)[1]) in (12, 16), formats.read_matrices, ORDER, UNSTATED, GIVE),
    Format("transforms", "nerfstudio, instant-ngp, NeRF synthetic: `transforms.json`, OpenGL axes; "
           "`applied_transform` is undone", _has("transforms.json", "frames"),
           formats.read_transforms, NAME, UNKNOWN, "`applied_scale`"),
    Format("scannet", "ScanNet: folder `pose/N.txt`, z up; 7-Scenes: `*.pose.txt`",
           lambda p: p.is_dir and bool(formats.scannet_files(p.path)), formats.read_scannet, NAME,
           METRES, "7-Scenes: no intrinsics"),
    Format("scannetpp", "ScanNet++ (iPhone): `pose_intrinsic_imu.json`, `aligned_pose` (z up) or "
           "`pose`", _has("pose_intrinsic_imu.json", "intrinsic"),
           formats.read_scannetpp, NAME, METRES, "IMU"),
    Format("arkitscenes", "ARKitScenes: `.traj`, axis-angle of cam_from_world; `.pincam` beside it",
           lambda p: any(name.endswith(".traj") for name in (*p.names, p.path.name)),
           formats.read_traj, TIME, METRES),
    Format("arkit", "Polycam (`keyframes/`), 3D Scanner App (`frame_*.json`): raw exports, OpenGL "
           "axes, y up", lambda p: p.is_dir and bool(formats.arkit_files(p.path)),
           formats.read_arkit, NAME, METRES),
    Format("record3d", "Record3D: `metadata`, its folder, or `.r3d`; OpenGL axes, y up",
           lambda p: p.suffix == ".r3d" or _has("metadata", "poses", "K")(p),
           formats.read_record3d, ORDER, METRES),
    Format("stray", "Stray Scanner: `odometry.csv` with `camera_matrix.csv`, y up; its `rgb.mp4`",
           lambda p: "odometry.csv" in {*p.names, p.path.name}, formats.read_stray, "number",
           METRES, "IMU"),
    Format("llff", "LLFF: `poses_bounds.npy`; axes down, right, backwards",
           lambda p: p.suffix == ".npy" or "poses_bounds.npy" in p.names, formats.read_llff,
           "order of the names as text: 1, 10, 2", UNKNOWN, "depth bounds"),
    Format("splatting", "3D Gaussian splatting: `cameras.json`",
           _has("cameras.json", "img_name", "position"), formats.read_splatting, NAME,
           UNKNOWN),
], "; of other tools, export a COLMAP model")  # fmt: skip


# ---- Without a video -----------------------------------------------------------------------------


def open_video(
    source: Video | str | Path | int | None,
    config: InputConfig,
    poses: PosesConfig,
    boxes: Any = None,
    detect: DetectConfig | None = None,
) -> Video:
    """Open a video, or without one the frames of the files of detections and poses.

    Args:
        source: a `Video`, or its source; None: there is none.
        poses, boxes: file of poses, and of detections or identities; used without a video.
        detect: how the detections are read.
    Raises:
        ReobjError: no video, and no file of detections, poses or size of the images either;
            options that need a video or camera poses.
    """
    if poses.mode == "none" and (poses.depth or poses.metric):
        raise ReobjError("--depth and --metric need camera poses, but --poses is none")
    if source is not None:
        return source if isinstance(source, Video) else Video(source, config)
    if poses.depth:
        raise ReobjError(f"--depth {poses.depth}: depth maps are matched to images; name the video")
    if not isinstance(boxes, str | Path) or not boxes or poses.mode in ("auto", "none"):
        raise ReobjError(
            "no video: name one, or use `run` without images: --detections FILE (or --tracks "
            "FILE), --poses FILE and --camera MODEL WIDTH HEIGHT PARAMS, or a file"
        )
    path = Path(boxes)
    detect = detect or DetectConfig()
    size = described_images(path, detect)[0]
    camera = stated_camera(poses.camera, size, poses.camera_format)
    of_camera = [(camera.width, camera.height)] if camera else []
    file = read_pose_file(Path(poses.mode), poses.fmt, size or (*of_camera, (1, 1))[0])
    of_camera += [(one.width, one.height) for one in file.cameras if one]
    size = size or next(iter(of_camera), None)
    if size is None or size == (1, 1):
        raise ReobjError(
            f"{poses.mode}: no image size in it; give --camera MODEL WIDTH HEIGHT PARAMS"
        )
    video = _frames_of(file, path, size, poses.mode, config, detect)
    video.messages.append(
        f"{NOTE_START}no images: {video.frame_count} frames of {size[0]}x{size[1]} from "
        f"{poses.mode} and {path}; tracked by motion and cameras alone, without appearance and "
        "overlay video"
    )
    return video


def _frames_of(
    file: PoseFile,
    boxes: Path,
    size: Size,
    source: str,
    config: InputConfig,
    detect: DetectConfig,
) -> ImagelessVideo:
    """Number the frames of poses and detections as a folder of their images would be.

    Times in a CSV of detections are those of the frames. Else images of a COCO dataset or of the
    poses are numbered in the order of the numbers in their names; if the detections have more
    frames, by these numbers. Poses without names: evenly spaced times from 0 on are numbers;
    otherwise each row is one frame.
    """
    video = functools.partial(ImagelessVideo, source, size, config)
    _, given, times_s = described_images(boxes, detect)
    if times_s is not None:
        return video(times_s=times_s)
    named = {Path(name.replace("\\", "/")).name for name in given}
    posed = {Path(name).name for name in file.names}
    if named and posed and (frames_by_name(sorted(named), sorted(posed))[0] >= 0).all():
        named = posed  # all of the detections' images and more, with suffixes
    names = sorted_names(named or posed)
    unfiltered = dataclasses.replace(detect, min_score=0.0, classes="", max_detections=0)
    first = video(names=names if named else ())
    count = int(read_detections(boxes, first, unfiltered).frame.max(initial=-1)) + 1
    if names and count > len(names):
        number = numbers_of_names(names, source)
        frames = SourceFrames(np.arange(count), np.arange(count) / 1.0, count)
        inside = [a for a in by_numbers(number, frames, "numbers") if not a.outside]
        if len(inside) != 1:
            return video(count=count if inside else max(count, int(number.max()) + 1))
        names = [names[row] if row >= 0 else "" for row in inside[0].row]
    if names:
        return video(names=names)
    rows = len(file.cam_from_world)
    if file.stamps is not None:
        stamps_s = seconds_of(file.stamps, file.unit)
        number = numbers_of_times(stamps_s)
        rows = int(number[-1]) + 1
        if count <= rows:
            return video(times_s=np.interp(np.arange(rows), number, stamps_s))
    if count > rows:
        raise ReobjError(
            f"{boxes}: frame {count - 1}, but {source} has {rows} poses without names; expected a "
            "pose for each frame, or a CSV with a `timestamp`"
        )
    return video(count=rows)
