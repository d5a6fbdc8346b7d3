"""Dense coloured points for the viewer, from depth maps of the frames.

The pixels of up to 60 maps, subsampled to 320 px, become points, except those at edges of depth.
A point is left out if more of the four maps from nearby see through it than have a surface there.
Points are then averaged in voxels, as those from optical flow are.
"""

from __future__ import annotations

import numpy as np

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
from reobj.results.cloud import DenseFrames, FlowFrames, Points, evenly
from reobj.sources.video import Video
from reobj.types import ReobjError, log

NEIGHBOURS = 4  # maps that a point is compared with


def dense_frames(poses: Poses, video: Video, depth: str) -> DenseFrames:
    """Return the frames for a dense cloud: with depth maps where these are given.

    Args:
        depth: folder of maps, as `find_depth_maps` reads it; "": none. If it cannot be read, or the
            scale of the poses is unknown, a warning says so, and optical flow is used.
    """
    if not depth:
        return FlowFrames(poses)
    try:
        if not poses.metric and poses.scale is None:
            raise ReobjError("--depth: the scale of the cameras is unknown")
        return DepthFrames(poses, find_depth_maps(depth, poses, video))
    except ReobjError as error:
        log.warning("%s; dense points are made from optical flow, not from depth maps", error)
        return FlowFrames(poses)


class DepthFrames(DenseFrames):
    """Frames whose depth maps become points."""

    REASON = "the depth maps contradict each other; are units, intrinsics and poses right?"

    def __init__(self, poses: Poses, maps: DepthMaps) -> None:
        """Choose frames, and read their maps.

        Args:
            poses: in metres, or with the scale of a map.
        Raises:
            ReobjError: a map cannot be read, or no frame with a map has a pose.
        """
        rows = np.array([row for row in sorted(maps.files) if poses.known[row]], np.int64)
        if not len(rows):
            raise ReobjError("--depth: no frame with a depth map has a pose")
        super().__init__(poses, evenly(rows).tolist())
        self.color_from_depth = invert_rigid(maps.depth_from_color)
        self.maps = {row: maps.read(row) for row in self.rows}  # depth (h, w) in m, K (3, 3)
        self.metres = 1.0 if poses.metric or poses.scale is None else poses.scale[0]  # per unit
        pixels = [self._median_depth(row) / self.maps[row][1][0, 0] for row in self.rows]
        self.spacing = float(np.median(pixels)) / self.metres
        cam_from_world = poses.cam_from_world.copy()
        cam_from_world[:, :, 3] *= self.metres
        self.depth_from_world = {
            row: composed(maps.depth_from_color, cam_from_world[row]) for row in self.rows
        }  # in metres

    def _points(self, row: int) -> Points | None:
        image = self._image(row)
        if image is None:
            return None
        depth, K = self.maps[row]
        in_depth = points_of(depth, K, smooth_pixels(depth))
        if not len(in_depth):
            return None
        xyw = moved(in_depth, self.color_from_depth) @ self._K(image).T
        xy = np.floor(xyw[:, :2] / np.maximum(xyw[:, 2:], 1e-9)).astype(np.int64)
        inside = (xyw[:, 2] > 0) & ((xy >= 0) & (xy < image.shape[1::-1])).all(1)
        world_from_depth = invert_rigid(self.depth_from_world[row])
        world = moved(in_depth[inside], world_from_depth)  # (N, 3), m
        xy = xy[inside]
        rgb = image[xy[:, 1], xy[:, 0], ::-1]
        agree = np.zeros(len(world), np.int64)
        through = np.zeros(len(world), np.int64)
        for other in self._neighbours(row):
            there = moved(world, self.depth_from_world[other])
            agrees, seen_through = compared(look_up_depth(*self.maps[other], there), there[:, 2])
            agree += agrees
            through += seen_through
        good = through <= agree
        towards = world_from_depth[:, 3] - world[good]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        xyz = world[good] / self.metres
        return xyz.astype(np.float32), rgb[good], towards.astype(np.float32)

    def _median_depth(self, row: int) -> float:
        """Return the median depth of a map, m; of an empty one 1."""
        depth = self.maps[row][0]
        measured = depth[depth > 0]
        return float(np.median(measured)) if len(measured) else 1.0

    def _neighbours(self, row: int) -> list[int]:
        """List the maps of the component whose cameras are nearest, by place and direction."""
        others = [r for r in self.rows if r != row and self.poses.part[r] == self.poses.part[row]]
        axis = self.poses.cam_from_world[:, 2, :3]
        base = self.metres * np.linalg.norm(self.centers[others] - self.centers[row], axis=1)
        cost = base / self._median_depth(row) + 4 * (1 - axis[others] @ axis[row])  # as for flow
        return [others[k] for k in np.argsort(cost, kind="stable")[:NEIGHBOURS]]
