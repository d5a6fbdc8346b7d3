"""Dense coloured points for the viewer, from depth maps of the frames.

The pixels of up to 60 maps, subsampled to 320 px, become points, except those at edges of depth.
A point is left out if more of the four maps from nearby see through it than have a surface there.
Points are then averaged in voxels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.cameras import Poses, invert_rigid
from reobj.poses.supplied.depth import (
    DepthMaps,
    compared,
    composed,
    find_depth_maps,
    look_up_depth,
    moved,
    points_of,
    smooth_pixels,
)
from reobj.sources.video import Video, shrunk
from reobj.types import Image, IntArray, ReobjError, log

REFERENCES = 60  # maps whose pixels become points
SIZE_PX = 480  # longer side of the frames that give the colours
NEIGHBOURS = 4  # maps that a point is compared with
CELLS = 300  # voxels over the radius of the room; fewer where there would be too many points
MOST = 500_000  # points of a cloud, 8 MB in the page

Reals = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Cloud:
    """Dense points of a component, the most observed ones first.

    Attributes:
        xyz: (N, 3), world. rgb: (N, 3) uint8. seen_from: (N, 3) unit vectors towards the cameras
            that observed them, mean. voxel: side, world units.
    """

    xyz: Reals
    rgb: npt.NDArray[np.uint8]
    seen_from: Reals
    voxel: float


Points = tuple[Reals, npt.NDArray[np.uint8], Reals]  # world, RGB, directions to the camera (N, 3)


def dense_frames(poses: Poses | None, video: Video, depth: str) -> DenseFrames | None:
    """Return the frames for a dense cloud; None, with a warning: there can be none.

    Args:
        depth: folder of maps, as `find_depth_maps` reads it.
    """
    try:
        if not depth:
            raise ReobjError("they are made from depth maps; give these with --depth FOLDER")
        if poses is None or not (poses.metric or poses.scale):
            raise ReobjError("--depth: the scale of the cameras is unknown")
        return DenseFrames(poses, find_depth_maps(depth, poses, video))
    except ReobjError as error:
        log.warning("no dense points: %s", error)
        return None


class DenseFrames:
    """Frames whose depth maps become points, and the cloud of each component.

    Attributes:
        rows: of the frames. wanted: their numbers. images: these, undistorted, by number.
        maps: depth (h, w) in m and K (3, 3) by row. metres: per world unit.
        spacing: usual distance of the points of a frame, world units; no voxel is smaller.
    """

    def __init__(self, poses: Poses, maps: DepthMaps) -> None:
        """Choose frames, and read their maps.

        Args:
            poses: in metres, or with the scale of a map.
        Raises:
            ReobjError: a map cannot be read, or no frame with a map has a pose.
        """
        known = np.array([row for row in sorted(maps.files) if poses.known[row]], np.int64)
        if not len(known):
            raise ReobjError("--depth: no frame with a depth map has a pose")
        even = np.linspace(0, len(known) - 1, min(REFERENCES, len(known))).round().astype(np.int64)
        self.poses = poses
        self.rows: list[int] = known[even].tolist()
        self.wanted = set(poses.frame[self.rows].tolist())
        self.images: dict[int, Image] = {}
        self.color_from_depth = invert_rigid(maps.depth_from_color)
        self.maps = {row: maps.read(row) for row in self.rows}
        self.metres = 1.0 if poses.metric or poses.scale is None else poses.scale[0]
        pixels = [self._median_depth(row) / self.maps[row][1][0, 0] for row in self.rows]
        self.spacing = float(np.median(pixels)) / self.metres
        cam_from_world = poses.cam_from_world.copy()
        cam_from_world[:, :, 3] *= self.metres
        self.centers = invert_rigid(cam_from_world)[:, :, 3]  # (F, 3), m
        self.depth_from_world = {
            row: composed(maps.depth_from_color, cam_from_world[row]) for row in self.rows
        }  # in metres

    def take(self, number: int, image: Image) -> None:
        """Keep an undistorted frame."""
        self.images[number] = shrunk(image, SIZE_PX)

    def cloud(self, component: int) -> Cloud | None:
        """Return the cloud of a component; None: no frame of it gives points."""
        rows = [row for row in self.rows if self.poses.part[row] == component]
        found = [self._points(row) for row in rows if int(self.poses.frame[row]) in self.images]
        xyz, rgb, seen_from = (
            np.concatenate(column) for column in zip(_NO_POINTS, *found, strict=True)
        )
        return _voxels(xyz, rgb, seen_from, self.spacing) if len(xyz) else None

    def _points(self, row: int) -> Points:
        """Return the points of a frame that other maps confirm."""
        image = self.images[int(self.poses.frame[row])]
        depth, K = self.maps[row]
        in_depth = points_of(depth, K, smooth_pixels(depth))
        K_color = self.poses.camera.resized((image.shape[1], image.shape[0])).K
        xyw = moved(in_depth, self.color_from_depth) @ K_color.T
        xy = np.floor(xyw[:, :2] / np.maximum(xyw[:, 2:], 1e-9)).astype(np.int64)
        inside = (xyw[:, 2] > 0) & ((xy >= 0) & (xy < image.shape[1::-1])).all(1)
        world_from_depth = invert_rigid(self.depth_from_world[row])
        world = moved(in_depth[inside], world_from_depth)  # (N, 3), m
        xy = xy[inside]
        votes = np.zeros(len(world), np.int64)
        for other in self._neighbours(row):
            there = moved(world, self.depth_from_world[other])
            agrees, seen_through = compared(look_up_depth(*self.maps[other], there), there[:, 2])
            votes += agrees.astype(np.int64) - seen_through
        good = votes >= 0
        towards = world_from_depth[:, 3] - world[good]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        xyz = (world[good] / self.metres).astype(np.float32)
        return xyz, image[xy[good, 1], xy[good, 0], ::-1], towards.astype(np.float32)

    def _median_depth(self, row: int) -> float:
        """Return the median depth of a map, m; of an empty one 1."""
        depth = self.maps[row][0]
        return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0

    def _neighbours(self, row: int) -> list[int]:
        """List the maps of the component whose cameras are nearest, by place and direction."""
        others = [r for r in self.rows if r != row and self.poses.part[r] == self.poses.part[row]]
        axis = self.poses.cam_from_world[:, 2, :3]
        base = np.linalg.norm(self.centers[others] - self.centers[row], axis=1)
        # a turn of 60 deg weighs as much as a baseline of twice the depth
        cost = base / self._median_depth(row) + 4 * (1 - axis[others] @ axis[row])
        return [others[k] for k in np.argsort(cost, kind="stable")[:NEIGHBOURS]]


_NO_POINTS: Points = (
    np.empty((0, 3), np.float32),
    np.empty((0, 3), np.uint8),
    np.empty((0, 3), np.float32),
)


def _voxels(xyz: Reals, rgb: npt.NDArray[np.uint8], seen_from: Reals, least: float) -> Cloud | None:
    """Average points in voxels; distant and isolated ones are left out; None: all are.

    Args:
        least: side of a voxel.
    """
    middle = np.median(xyz, 0)
    extent = np.percentile(np.abs(xyz - middle), 95, axis=0)
    voxel = max(float(np.linalg.norm(extent)) / CELLS, least)
    near = (np.abs(xyz - middle) <= 2 * np.maximum(extent, voxel)).all(1)  # a wall has no extent
    columns = [values[near] for values in (xyz, rgb, seen_from)]
    key = _cells(columns[0], voxel)
    while (filled := len(np.unique(key))) > MOST:
        voxel *= 1.01 * math.sqrt(filled / MOST)  # of a surface
        key = _cells(columns[0], voxel)
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(start, append=len(key))
    mean = [
        np.add.reduceat(values[order].astype(np.float32), start) / count[:, None]
        for values in columns
    ]
    _, coarse, near_by = np.unique(
        _cells(mean[0], 3 * voxel), return_inverse=True, return_counts=True
    )
    rows = np.flatnonzero(near_by[coarse] >= 4)  # of 27 voxels; a surface fills 9
    rows = rows[np.argsort(-count[rows], kind="stable")]
    seen = mean[2] / np.maximum(np.linalg.norm(mean[2], axis=1, keepdims=True), 1e-6)
    cloud = Cloud(mean[0][rows], mean[1][rows].round().astype(np.uint8), seen[rows], voxel)
    return cloud if len(rows) else None


def _cells(xyz: Reals, size: float) -> IntArray:
    """Return the number of the cell of each point."""
    cell = ((xyz - xyz.min(0)) / size).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(0) + 1)))
