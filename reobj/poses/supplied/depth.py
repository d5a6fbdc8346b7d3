"""Points and metric scale from depth maps of the frames: 16-bit PNG, as many sensors write it.

Start at `add_depth`: it finds the maps of the frames, makes poses of unknown scale metric, and adds
points with their visibility. Frames without a map are unchanged.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from reobj.cameras import Camera, Poses, VisiblePoints, invert_rigid
from reobj.files import load_json
from reobj.poses.intrinsics import camera_of_keys
from reobj.poses.supplied.frame_assignment import rows_by_time
from reobj.poses.supplied.pose_formats import Size, scannet_camera
from reobj.sources.image_files import read_image
from reobj.types import Array, BoolArray, Floats, IntArray, ReobjError, log


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Depth maps of some frames, all of one camera.

    Attributes:
        files: by row of the poses. units_per_m: of their values.
        camera: of the maps. depth_from_color: (3, 4) rigid, metres.
    """

    files: dict[int, Path]
    units_per_m: float
    camera: Camera
    depth_from_color: Array

    def read(self, row: int) -> tuple[Floats, Array]:
        """Read a map, subsampled to a side of at most 320 px and without distortion.

        Returns:
            depth (h, w) in m, 0 where there is none, and K (3, 3) of its pixels.
        """
        image = _read_map(self.files[row])
        size = (self.camera.width, self.camera.height)
        if image.shape[::-1] != size:
            raise ReobjError(
                f"{self.files[row]}: {image.shape[1]}x{image.shape[0]} pixels; expected "
                f"{size[0]}x{size[1]} as the other maps"
            )
        step = -(-max(size) // 320)
        sides = (np.arange(0.5, side, step) for side in size)
        # pixels of an ideal pinhole camera lie elsewhere in the distorted image; NaN: outside
        at = np.nan_to_num(self.camera.distort(np.stack(np.meshgrid(*sides), -1)) - 0.5, nan=-9)
        x, y = np.moveaxis(at.astype(np.float32), -1, 0)
        depth = cv2.remap(image, x, y, cv2.INTER_NEAREST).astype(np.float32)  # outside: 0
        depth[depth == 65535] = 0  # 7-Scenes: none
        # a pixel x of the subsampled map has its centre at step x + .5 of the whole one
        small_from_full = np.diag([1 / step, 1 / step, 1])
        small_from_full[:2, 2] = 0.5 - 0.5 / step
        return depth / np.float32(self.units_per_m), small_from_full @ self.camera.K


def _read_map(path: Path) -> Any:
    """Read a depth map as it is stored, (h, w) uint16."""
    image = read_image(path, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        raise ReobjError(f"{path}: not a depth map; expected a 16-bit PNG with one channel")
    return image


# ---- The maps and their camera -------------------------------------------------------------------


def find_depth_maps(text: str, poses: Poses, video: Any) -> DepthMaps:
    """Find the depth maps of the frames of a video.

    Args:
        text: folder, or FOLDER:UNITS with units per metre (TUM: 5000; default: mm).
    Raises:
        ReobjError: no folder, no maps in it, none of a frame, or intrinsics that do not fit.
    """
    names = [video.name(int(frame)) for frame in poses.frame] if video.names else []
    match = re.fullmatch(r"(.*?)(?::([\d.eE+-]+))?", text)
    folder = Path(text)
    units = 1000.0
    if not folder.is_dir() and match and match[2]:
        folder = Path(match[1])
        units = float(match[2])
    if not folder.is_dir() or not 0 < units < np.inf:
        expected = "FOLDER, or FOLDER:UNITS with units per metre (1000: mm; TUM: 5000)"
        raise ReobjError(f"--depth {text}: no such folder; expected {expected}")
    paths = sorted(folder.glob("*.png"))
    if not paths:
        raise ReobjError(f"{folder}: no .png in it; --depth needs a folder of 16-bit depth maps")
    files = _files_of_rows(paths, poses.frame, names)
    if not files:
        first = names[0] if names else f"frame {poses.frame[0]}"
        raise ReobjError(
            f"{folder}: none of its {len(paths)} depth maps belongs to a frame ({paths[0].name!r}, "
            f"{first!r} ...); expected the same names, or frame numbers"
        )
    height, width = _read_map(paths[0]).shape
    camera, color_from_depth = _depth_camera(folder, (width, height), poses.camera)
    return DepthMaps(files, units, camera, invert_rigid(color_from_depth))


def _files_of_rows(paths: Sequence[Path], frame: IntArray, names: Sequence[str]) -> dict[int, Path]:
    """Match depth maps to frames: by name, else by time stamps, else by the last number.

    The word for the kind of image in a name, as in frame-000020.depth, does not count.
    """
    kind = re.compile("[._-]?(depth|color|colour|rgb)[._-]?", re.IGNORECASE)
    images = [kind.sub("", Path(name).stem) for name in names]
    maps = {kind.sub("", path.stem): path for path in paths}
    if maps.keys().isdisjoint(images):
        if images and all(re.fullmatch(r"\d+\.\d+", name) for name in (*images, *maps)):  # s (TUM)
            near = rows_by_time(np.array([*maps], float), frame, np.array(images, float))
            return {row: paths[k] for row, k in enumerate(near.tolist()) if k >= 0}
        images = list(map(_last_number, images or map(str, frame)))
        maps = {_last_number(name): path for name, path in maps.items()}
    return {row: maps[name] for row, name in enumerate(images) if name and name in maps}


def _last_number(text: str) -> str:
    """Return the last number in a text without leading zeros, "" if there is none."""
    return "".join(str(int(digits)) for digits in re.findall(r"\d+", text)[-1:])


def _depth_camera(folder: Path, size: Size, color: Camera) -> tuple[Camera, Array]:
    """Find the intrinsics of the maps: in a file beside them, else of the colour images.

    Returns:
        camera, and color_from_depth (3, 4).
    """
    identity = np.eye(3, 4)
    for path in (folder, folder.parent, folder.parent / "intrinsic"):
        if (file := path / "intrinsic_depth.txt").exists():
            return scannet_camera(file, size), identity
    for path in (folder / "intrinsics.json", folder.parent / "intrinsics.json"):
        content = load_json(path) if path.exists() else {}
        if not (keys := content.get("depth", content if path.parent == folder else None)):
            continue
        with contextlib.suppress(AttributeError, TypeError, ValueError):
            given = np.array(content.get("T_color_from_depth", [0, 0, 0]), np.float64)[:3]
            if camera := camera_of_keys(keys, size):
                matrix = np.column_stack([np.eye(3), given]) if given.ndim == 1 else given
                return camera.resized(size), matrix
        expected = "fx, fy, cx, cy of the depth maps, T_color_from_depth: 3 or 3x4 numbers in m"
        raise ReobjError(f"{path}: expected {expected}")
    if abs(color.width * size[1] - color.height * size[0]) > max(color.width, color.height, *size):
        raise ReobjError(
            f"{folder}: depth maps of {size[0]}x{size[1]}, frames of {color.width}x{color.height}: "
            "another aspect ratio; add the depth camera's intrinsics there: intrinsics.json with "
            "fx, fy, cx, cy"
        )
    return color.resized(size), identity


# ---- Scale and points ----------------------------------------------------------------------------


class UnusableError(ReobjError):
    """Depth maps do not give the scale, or no points; the poses are used without."""


def add_depth(poses: Poses, text: str, video: Any) -> Poses:
    """Add points from depth maps to poses, and make these metric if they were not.

    Args:
        text: FOLDER or FOLDER:UNITS. video: of the poses; its images give the points' colours.
    Returns:
        the poses with more points; a message says why not, or why the scale is unknown.
    """
    maps = find_depth_maps(text, poses, video)
    try:
        if not poses.metric:
            metres, sigma, used = depth_scale(poses, maps)
            log.info("metres per unit of the reconstruction by %d depth maps: %s", used, metres)
            poses = _scaled(poses, metres, sigma)
        return _with_points(poses, maps, video)
    except UnusableError as reason:
        return dataclasses.replace(poses, messages=(*poses.messages, f"--depth: {reason}"))


# Systematic relative sigma: of the depth camera itself (Khoshelham and Elberink 2012: ~1 %), of its
# extrinsics and the colour camera's focal length (redkitchen: 1 to 3 %).
SENSOR_SIGMA = 0.02


def depth_scale(poses: Poses, maps: DepthMaps, max_spread: float = 0.2) -> tuple[Array, Array, int]:
    """Estimate metres per unit of each component: the ratio of map depths to point depths.

    Args:
        max_spread: relative, between maps; more contradicts the poses.
    Returns:
        scale and relative sigma of each component, and the number of maps.
    Raises:
        UnusableError: too few maps show sparse points, or they contradict the poses.
    """
    visible = VisiblePoints(poses)
    found = []
    used = 0
    for component in range(poses.part_count):
        rows = [r for r in _spread_rows(poses, maps) if poses.part[r] == component]
        ratios = [_log_ratio(poses, maps, visible, row) for row in rows]
        logs = np.array([ratio for ratio in ratios if ratio is not None])
        where = f" of component {component}" * (poses.part_count > 1)
        middle = float(np.median(logs)) if len(logs) >= 3 else np.nan
        spread = 1.4826 * float(np.median(np.abs(logs - middle))) if len(logs) >= 3 else np.nan
        if not spread <= max_spread:
            raise UnusableError(
                f"the maps do not give the scale{where}, and no points are added from them: "
                f"{len(logs)} of {len(rows)} maps show enough sparse points (3 are needed), and "
                f"the ratio of depth to the poses varies by {100 * spread:.0f} % between them"
            )
        used += len(logs)
        # errors of neighbouring maps are correlated: 8 runs of them count as one measurement each
        runs = np.array([np.median(run) for run in np.array_split(logs, min(8, len(logs)))])
        sigma = float(runs.std(ddof=1)) / np.sqrt(len(runs))
        found.append((np.exp(middle), np.hypot(sigma, SENSOR_SIGMA)))
    scale, sigmas = np.array(found).T  # (C,) each
    return scale, sigmas, used


def _spread_rows(poses: Poses, maps: DepthMaps) -> list[int]:
    """Choose at most 60 rows with a pose and a map, evenly spread: all would take long."""
    rows = [row for row in sorted(maps.files) if poses.known[row]]
    spread = np.linspace(0, len(rows) - 1, min(len(rows), 60)).round().astype(int)
    return [rows[i] for i in spread]


def _log_ratio(poses: Poses, maps: DepthMaps, visible: VisiblePoints, row: int) -> float | None:
    """Return the median log of metres per unit of the points that a map sees; None: too few."""
    least = 10  # fewer points have no stable median
    points = poses.points[visible.in_frame(row)]
    if len(points) < least:
        return None
    depth, K = maps.read(row)
    in_color = moved(points, poses.cam_from_world[row])
    in_depth = in_color @ maps.depth_from_color[:, :3].T  # without the shift, which needs the scale
    measured = look_up_depth(depth, K, in_depth)
    good = measured > 0
    ratio = measured[good] / in_depth[good, 2]
    return float(np.median(np.log(ratio))) if len(ratio) >= least else None


def moved(points: Array, b_from_a: Array) -> Array:
    """Move points (N, 3) by a rigid transform (3, 4)."""
    return np.asarray(points @ b_from_a[:, :3].T + b_from_a[:, 3])


def look_up_depth(depth: Floats, K: Array, in_depth: Array) -> Array:
    """Return the depth (N,) of a map at points (N, 3) of its camera, 0 where there is none."""
    xyw = in_depth @ K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = xyw[:, :2] / xyw[:, 2:]  # (N, 2)
    inside: BoolArray = (xyw[:, 2] > 0) & ((xy >= 0) & (xy < depth.shape[::-1])).all(1)
    x, y = np.where(inside[:, None], xy, 0).astype(int).T
    return np.where(inside, depth[y, x], 0.0)


def _scaled(poses: Poses, scale: Array, sigma: Array) -> Poses:
    """Scale the components of the trajectory to metres; the poses get the largest sigma."""
    cam_from_world = poses.cam_from_world.copy()
    cam_from_world[:, :, 3] *= scale[poses.part][:, None]
    component = np.zeros(len(poses.points), np.int64)
    component[poses.visibility[:, 1]] = poses.part[poses.visibility[:, 0]]
    return dataclasses.replace(
        poses, cam_from_world=cam_from_world, points=poses.points * scale[component][:, None],
        metric=True, scale=(1.0, float(sigma.max())),
    )  # fmt: skip


AGREE = 0.04  # relative difference of equal depths: noise of the maps and errors of poses ...
AGREE_M = 0.03  # ... and at least


def compared(measured: Array, depth: Array) -> tuple[BoolArray, BoolArray]:
    """Compare the depth of points with a map that they are in.

    Args:
        measured: (N,) by the map, m; 0: nothing. depth: (N,) of the points, m.
    Returns:
        (N,) whether the map has a surface there, and whether it sees through the point.
    """
    limit = np.maximum(AGREE * depth, AGREE_M)
    return (measured > 0) & (np.abs(measured - depth) <= limit), measured > depth + limit


# Fraction of the views of points in other maps that see through the point; beyond it maps and poses
# contradict. Measured: redkitchen .14; its depths made 20 % shorter or longer .36, .40.
MAX_CONTRADICTED = 0.3


def _with_points(poses: Poses, maps: DepthMaps, video: Any) -> Poses:
    """Add thinned points of the maps, observed in the frames whose depth agrees."""
    rows = _spread_rows(poses, maps)
    depths = {row: maps.read(row) for row in rows}
    cams = {row: composed(maps.depth_from_color, poses.cam_from_world[row]) for row in rows}
    grids = [_grid_points(*depths[row]) for row in rows]
    if not sum(map(len, grids)):
        raise UnusableError(f"no points from depth: {len(rows)} maps of frames with a pose show no "
                            "surface; are they depth maps?")  # fmt: skip
    points = np.concatenate(
        [moved(g, invert_rigid(cams[r])) for r, g in zip(rows, grids, strict=True)]
    )
    origin = np.repeat(rows, list(map(len, grids)))
    kept = _thin(points, np.concatenate(grids)[:, 2], poses.part[origin])
    points, origin = points[kept], origin[kept]
    found = []
    for row in rows:
        in_depth = moved(points, cams[row])
        measured = look_up_depth(*depths[row], in_depth)
        measured[poses.part[origin] != poses.part[row]] = 0
        found.append(compared(measured, in_depth[:, 2]))
    agrees, through = np.moveaxis(np.array(found), 1, 0)  # (rows, N) each
    views = agrees.sum(0)  # (N,)
    contradicted = through.sum()
    count = (views - 1).clip(0).sum() + contradicted
    if contradicted > MAX_CONTRADICTED * count:
        raise UnusableError(
            f"no points from depth: in {contradicted} of {count} views another "
            "map sees through a point; are units, intrinsics and poses those of these maps?"
        )
    good = views > through.sum(0)  # else it moved, or is a stray pixel
    seen, point = np.nonzero(agrees[:, good])
    visibility = np.column_stack([np.array(rows)[seen], point + len(poses.points)])
    colors = _colors(points[good], origin[good], poses, video)
    return dataclasses.replace(
        poses,
        points=np.concatenate([poses.points, points[good]]),
        colors=np.concatenate([poses.colors, colors]),
        visibility=np.concatenate([poses.visibility, visibility]),
    )


def composed(c_from_b: Array, b_from_a: Array) -> Array:
    """Chain rigid transforms (3, 4)."""
    return np.asarray(c_from_b @ np.vstack([b_from_a, [0, 0, 0, 1]]))


def smooth_pixels(depth: Floats) -> BoolArray:
    """Find the pixels of a map (h, w) whose neighbours have nearly its depth: not at edges."""
    low, high = (f(depth, np.ones((3, 3), np.uint8)) for f in (cv2.erode, cv2.dilate))
    smooth: BoolArray = (low > 0) & (high - low <= 2 * 0.05 * depth)  # 5 % from pixel to pixel
    return smooth


def _grid_points(depth: Floats, K: Array) -> Array:
    """Return points (N, 3) of a coarse grid of a map, 80 across, in its camera; none at edges."""
    step = max(1, max(depth.shape) // 80)
    wanted = np.zeros(depth.shape, bool)
    wanted[step // 2 :: step, step // 2 :: step] = True
    return points_of(depth, K, wanted & smooth_pixels(depth))


def points_of(depth: Floats, K: Array, wanted: BoolArray) -> Array:
    """Return the points (N, 3), in its camera, of the wanted pixels (h, w) of a map."""
    y, x = np.nonzero(wanted)
    rays = np.column_stack([x + 0.5, y + 0.5, np.ones(len(x))]) @ np.linalg.inv(K).T  # (N, 3)
    return np.asarray(rays * depth[y, x][:, None], np.float64)


def _thin(points: Array, depth: Array, component: IntArray) -> IntArray:
    """Choose one point per voxel, that with the least depth; at most 20,000 rows.

    A reconstruction has about as many points.
    """
    order = np.argsort(depth, kind="stable")
    first = order
    size = 0.02  # m, a side of a voxel; larger where the points are too many
    while len(first) > 20000 or size == 0.02:
        cell = np.column_stack([component, np.floor(points / size)]).astype(np.int64)  # (N, 4)
        first = np.unique(cell[order], axis=0, return_index=True)[1]
        size *= 1.25
    return np.sort(order[first])


def _colors(points: Array, origin: IntArray, poses: Poses, video: Any) -> npt.NDArray[np.uint8]:
    """Return the colours (N, 3) of points in the images of the frames `origin` (N,): rows."""
    colors = np.full((len(points), 3), 128, np.uint8)  # where there is no image
    for frame in video:
        rows = np.flatnonzero(poses.frame[origin] == frame.index)
        if not len(rows) or frame.image is None:
            continue
        height, width = frame.image.shape[:2]
        in_cam = moved(points[rows], poses.cam_from_world[origin[rows[0]]])
        xy = np.nan_to_num(poses.camera.resized((width, height)).project(in_cam))  # (n, 2)
        x, y = xy.astype(int).clip(0, (width - 1, height - 1)).T
        colors[rows] = frame.image[y, x, ::-1]
    return colors
