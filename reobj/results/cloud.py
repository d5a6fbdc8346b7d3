"""Dense coloured points for the viewer, of frames with known cameras.

`FlowFrames`: for up to 60 frames, the flow (DIS: Kroeger et al., ECCV 2016) to three others is
triangulated. A pixel becomes a point where flow there and back agree, the point projects onto both
pixels, the rays have enough parallax, and two of the three depths agree. Points are then averaged
in voxels. Points of depth maps: `depth_cloud`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from reobj.cameras import Poses
from reobj.sources.video import shrunk
from reobj.types import Array, BoolArray, Image, IntArray

REFERENCES = 60  # frames whose pixels become points
SIZE_PX = 480  # longer side of the frames
RETURN_PX = 1.5  # flow there and back
REPROJECTION_PX = 1.0
PARALLAX_DEG = 1.5
DEPTH_SHARE = 0.03  # by which two depths of a pixel may differ
BASELINE = (0.03, 0.12, 0.35)  # least, best, greatest, as a share of the median depth
ANGLE_DEG = 25.0  # between the optical axes of two frames
CELLS = 300  # voxels over the radius of the room; fewer where there would be too many points
MOST = 500_000  # points of a cloud


@dataclass(frozen=True, slots=True)
class Cloud:
    """Dense points of a component.

    Attributes:
        xyz: (N, 3), world. rgb: (N, 3) uint8. seen_from: (N, 3) unit vectors towards the cameras
            that observed them, mean. voxel: side, world units.
    """

    xyz: Array
    rgb: npt.NDArray[np.uint8]
    seen_from: Array
    voxel: float

    def __len__(self) -> int:
        """Number of points."""
        return len(self.xyz)

    def of_rows(self, rows: IntArray) -> Cloud:
        """Return the points of rows."""
        return Cloud(self.xyz[rows], self.rgb[rows], self.seen_from[rows], self.voxel)


Points = tuple[Array, npt.NDArray[np.uint8], Array]  # world, RGB, directions to the camera (N, 3)


class DenseFrames:
    """Frames of a recording for a dense cloud, and the cloud of each component.

    Attributes:
        rows: of the frames whose pixels become points. wanted: numbers of the frames to keep.
        images: these, undistorted, by number. spacing: usual distance of the points of a frame,
            world units; no voxel is smaller.
    """

    REASON = ""  # why there may be no points
    spacing = 0.0

    def __init__(self, poses: Poses, rows: Iterable[int]) -> None:
        self.poses = poses
        self.rows = list(rows)
        self.wanted = {int(poses.frame[row]) for row in self.rows}
        self.images: dict[int, Image] = {}
        self.centers = -np.einsum(
            "nji,nj->ni", poses.cam_from_world[:, :, :3], poses.cam_from_world[:, :, 3]
        )  # (F, 3)

    def take(self, number: int, image: Image) -> None:
        """Keep an undistorted frame."""
        self.images[number] = shrunk(image, SIZE_PX)

    def cloud(self, part: int) -> Cloud | None:
        """Return the cloud of a component; None: no frame of it gives points."""
        found = [
            points
            for row in self.rows
            if self.poses.part[row] == part and (points := self._points(row)) is not None
        ]
        if not found:
            return None
        xyz, rgb, seen_from = (np.concatenate(column) for column in zip(*found, strict=True))
        cloud = _voxels(xyz, rgb, seen_from, self.spacing) if len(xyz) else None
        return cloud if cloud is not None and len(cloud) else None

    def _points(self, row: int) -> Points | None:
        """Return the points of a frame."""
        raise NotImplementedError

    def _image(self, row: int) -> Image | None:
        return self.images.get(int(self.poses.frame[row]))

    def _K(self, image: Image) -> Array:
        return self.poses.camera.resized((image.shape[1], image.shape[0])).K


def evenly(rows: IntArray) -> IntArray:
    """Choose at most `REFERENCES` rows."""
    even = np.linspace(0, len(rows) - 1, min(REFERENCES, len(rows))).round().astype(np.int64)
    return np.asarray(rows[even])


class FlowFrames(DenseFrames):
    """Frames whose optical flow is triangulated."""

    REASON = "too few frames have a good baseline to others"

    def __init__(self, poses: Poses) -> None:
        """Choose frames: `REFERENCES`, and after each the next two with a good baseline."""
        super().__init__(poses, evenly(np.flatnonzero(poses.known)).tolist())
        self.points = [poses.of_part(part).points for part in range(poses.part_count)]
        self.depth = {row: self._median_depth(row) for row in self.rows}
        partners = [self._after(row, share) for row in self.rows for share in (0.1, 0.2)]
        self.used = sorted({*self.rows, *(row for row in partners if row >= 0)})
        self.wanted = {int(poses.frame[row]) for row in self.used}

    def _median_depth(self, row: int) -> float:
        """Return the median depth of the sparse points in a frame; NaN: fewer than 20."""
        pose = self.poses.cam_from_world[row]
        points = self.points[self.poses.part[row]]  # (N, 3), of the same world
        points = points[:: len(points) // 5000 + 1]
        x = points @ pose[:, :3].T + pose[:, 3]
        x = x[x[:, 2] > 0]
        uv = x @ self.poses.camera.K.T / x[:, 2:]
        size = (self.poses.camera.width, self.poses.camera.height)
        inside = ((uv[:, :2] > 0) & (uv[:, :2] < size)).all(1)
        return float(np.median(x[inside, 2])) if inside.sum() >= 20 else math.nan

    def _after(self, row: int, share: float) -> int:
        """Return the first later frame whose baseline is a share of the median depth; -1: none."""
        far = np.linalg.norm(self.centers - self.centers[row], axis=1) > share * self.depth[row]
        same = self.poses.part == self.poses.part[row]
        later = np.flatnonzero(far & same & self.poses.known)
        later = later[later > row]
        return int(later[0]) if len(later) else -1

    def _neighbours(self, row: int) -> list[int]:
        """List up to three frames whose baseline and direction are best for flow."""
        others = np.array([r for r in self.used if r != row and self._image(r) is not None], int)
        if not len(others) or not self.depth[row] > 0:
            return []
        least, best, greatest = BASELINE
        axis = self.poses.cam_from_world[:, 2, :3]
        cos = axis[others] @ axis[row]
        base = np.linalg.norm(self.centers[others] - self.centers[row], axis=1) / self.depth[row]
        good = (base > least) & (base < greatest) & (cos > math.cos(math.radians(ANGLE_DEG)))
        good &= self.poses.part[others] == self.poses.part[row]
        cost = np.abs(np.log(base[good] / best)) + 4 * (1 - cos[good])
        return [int(r) for r in others[good][np.argsort(cost, kind="stable")[:3]]]

    def _points(self, row: int) -> Points | None:
        image = self._image(row)
        others = self._neighbours(row)
        if image is None or len(others) < 2:
            return None
        rays = _rays(self._K(image), image.shape[1], image.shape[0])  # (H, W, 3)
        depths = np.stack([self._depth_map(row, other, rays) for other in others])  # (n, H, W)
        depth = _agreed(depths)
        ok = depth < 6 * self.depth[row]
        pose = self.poses.cam_from_world[row]
        xyz = (rays[ok] * depth[ok][:, None] - pose[:, 3]) @ pose[:, :3]
        towards = self.centers[row] - xyz
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        return xyz.astype(np.float32), image[ok][:, ::-1], towards.astype(np.float32)

    def _depth_map(self, row: int, other: int, rays: Array) -> Array:
        """Triangulate the flow from a frame to another one: depth (H, W); NaN: refused."""
        image = self._image(row)
        target = self._image(other)
        assert image is not None and target is not None
        there, ok = _flow(image, target)
        pose, moved = self.poses.cam_from_world[[row, other]]
        rotation = moved[:, :3] @ pose[:, :3].T
        K = self._K(image).astype(np.float32)
        # K (R z ray + t) is at the pixel `there`: two linear equations for z
        q = rays @ (K @ rotation.astype(np.float32)).T  # (H, W, 3)
        s = (K @ (moved[:, 3] - rotation @ pose[:, 3])).astype(np.float32)
        a = q[..., :2] - there * q[..., 2:]
        c = there * s[2] - s[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (a * c).sum(-1) / (a * a).sum(-1)
            seen = q * depth[..., None] + s
            error = np.linalg.norm(seen[..., :2] / seen[..., 2:] - there, axis=-1)
            point = rays * depth[..., None]
            base = pose[:, :3] @ (self.centers[other] - self.centers[row])
            ray = point - base.astype(np.float32)
            cos = (point * ray).sum(-1)
            cos /= np.linalg.norm(point, axis=-1) * np.linalg.norm(ray, axis=-1)
            ok &= (depth > 0) & (seen[..., 2] > 0) & (error < REPROJECTION_PX)
            ok &= cos < math.cos(math.radians(PARALLAX_DEG))
        return np.where(ok, depth, np.nan)


def _rays(K: Array, width: int, height: int) -> Array:
    """Return the rays of the pixels in the camera, with depth 1: (H, W, 3) float32."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], -1)
    return np.asarray((pixels @ np.linalg.inv(K).T).astype(np.float32))


def _flow(image: Image, target: Image) -> tuple[Array, BoolArray]:
    """Return where the pixels of an image are in another one (H, W, 2), and whether it is sure."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    first, second = (cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in (image, target))
    height, width = first.shape
    flow, back = (
        np.asarray(dis.calc(a, b, np.zeros((height, width, 2), np.float32)), np.float32)
        for a, b in ((first, second), (second, first))
    )
    pixel = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)
    there = pixel + flow
    outside = (1e3, 1e3)
    returned = cv2.remap(
        back,
        there[..., 0],
        there[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=outside,
    )
    ok = np.asarray(np.abs(flow + returned).sum(-1) < RETURN_PX)
    return np.asarray(there + np.float32(0.5)), ok


def _agreed(depths: Array) -> Array:
    """Return the mean (H, W) of depths (n, H, W) that agree; inf: fewer than two do."""
    count = np.isfinite(depths).sum(0)
    middle = np.maximum((count - 1) // 2, 0)[None]
    median = np.take_along_axis(np.sort(depths, 0), middle, 0)[0]  # NaN are last
    near = np.abs(depths / median - 1) < DEPTH_SHARE
    agree = near.sum(0)
    mean = np.where(near, depths, 0).sum(0) / np.maximum(agree, 1)
    return np.where(agree >= 2, mean, np.inf)


def _voxels(xyz: Array, rgb: npt.NDArray[np.uint8], seen_from: Array, least: float = 0.0) -> Cloud:
    """Average points in voxels; distant and isolated ones are left out, the most observed first.

    Args:
        least: side of a voxel.
    """
    middle = np.median(xyz, 0)
    extent = np.percentile(np.abs(xyz - middle), 95, axis=0)
    voxel = max(float(np.linalg.norm(extent)) / CELLS, least)
    near = (np.abs(xyz - middle) <= 2 * np.maximum(extent, voxel)).all(1)  # a wall has no extent
    xyz = xyz[near]
    rgb = rgb[near]
    seen_from = seen_from[near]
    key = _cells(xyz, voxel)
    while (filled := len(np.unique(key))) > MOST:
        voxel *= 1.01 * math.sqrt(filled / MOST)  # of a surface
        key = _cells(xyz, voxel)
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(start, append=len(key))
    mean = [
        np.add.reduceat(values[order].astype(np.float32), start) / count[:, None]
        for values in (xyz, rgb, seen_from)
    ]
    _, coarse, near_by = np.unique(
        _cells(mean[0], 3 * voxel), return_inverse=True, return_counts=True
    )
    rows = np.flatnonzero(near_by[coarse] >= 4)  # of 27 voxels; a surface fills 9
    rows = rows[np.argsort(-count[rows], kind="stable")]
    seen = mean[2] / np.maximum(np.linalg.norm(mean[2], axis=1, keepdims=True), 1e-6)
    cloud = Cloud(mean[0], mean[1].round().astype(np.uint8), seen, voxel)
    return cloud.of_rows(rows)


def _cells(xyz: Array, size: float) -> IntArray:
    """Return the number of the cell of each point."""
    cell = ((xyz - xyz.min(0)) / size).astype(np.int64)
    side = cell.max(0) + 1
    return np.asarray((cell[:, 0] * side[1] + cell[:, 1]) * side[2] + cell[:, 2])
