"""Cameras: intrinsics, poses of a video, rigid transforms, viewing rays, pycolmap's models.

Conventions: `cam_from_world` maps world points into the camera (x right, y down, z forward, as in
OpenCV and COLMAP); pixels are COLMAP's: the centre of the first pixel is (0.5, 0.5).
`reobj.poses` estimates and reads poses; this module holds their types and writers (npz, TUM,
COLMAP), and the index of the sparse points that a frame sees.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.files import atomic, load_npz, save_npz
from reobj.types import Array, BoolArray, IntArray, ReobjError, as_numbers, counted


def import_pycolmap() -> Any:
    """Import pycolmap on demand, without its log on stderr and its handler of SIGTERM.

    The handler would print a C++ trace when a process is ended.
    """
    if "pycolmap" not in sys.modules:
        import pycolmap

        pycolmap.logging.minloglevel = 3
        with contextlib.suppress(ValueError):  # handlers are set in the main thread only
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    import pycolmap  # waits for another thread that imports it

    return pycolmap


def camera_parameters(model: str) -> list[str]:
    """List the parameters of one of COLMAP's camera models in their order: fx, fy, cx, cy, ...

    Raises:
        ReobjError: the installed pycolmap lacks the model, or the model has no focal length.
    """
    pycolmap = import_pycolmap()
    models = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    if model not in models:
        raise ReobjError(f"no camera model {model}; pycolmap has {', '.join(models)}")
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2)
    if not camera.focal_length_idxs():
        raise ReobjError(f"a {model} camera has no focal length; cut perspective images out of it")
    return [name.strip() for name in camera.params_info.split(",")]


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics in COLMAP's conventions.

    Attributes:
        model: COLMAP's name of the camera model: PINHOLE, OPENCV, ...; any of pycolmap's.
        width, height: of the images, pixels.
        params: in the model's order: focal length(s), principal point, distortion.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def K(self) -> Array:
        """Calibration matrix (3, 3) without the distortion."""
        if self.model == "PINHOLE":  # needs no pycolmap
            fx, fy, cx, cy = self.params
            return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return np.asarray(self.to_pycolmap().calibration_matrix(), np.float64)

    def _to_pixels(self, in_cam: Array) -> Array:
        """Project points (N, 3) in front of the camera to pixels (N, 2) without distortion."""
        return in_cam[:, :2] / in_cam[:, 2:] @ self.K[:2, :2].T + self.K[:2, 2]

    @property
    def fold_radius(self) -> float:
        """Radius |xy| / z of a ray up to which the distortion keeps moving points outwards.

        Beyond it the model moves points back towards the image centre: they are in no image. At
        most that of rays of 90 deg (inf).
        """
        return _fold_radius(self.model, tuple(self.params))

    def project(self, in_cam: Array) -> Array:
        """Project points (..., 3) in the camera's frame to pixels (..., 2), with distortion.

        NaN for points that are not in front of the camera or lie beyond `fold_radius`.
        """
        flat = np.asarray(in_cam, np.float64).reshape(-1, 3)
        pixels = np.full((len(flat), 2), np.nan)
        radius = np.hypot(flat[:, 0], flat[:, 1]) / (1 + 1e-9)  # rounding at the fold
        with np.errstate(invalid="ignore"):  # inf * 0
            shown = (flat[:, 2] > 0) & ~(radius > self.fold_radius * flat[:, 2])
        if self.model == "PINHOLE":
            pixels[shown] = self._to_pixels(flat[shown])
        elif shown.any():
            pixels[shown] = self.to_pycolmap().img_from_cam(flat[shown])
        return pixels.reshape(*np.shape(in_cam)[:-1], 2)

    def distort(self, xy: Array) -> Array:
        """Map pixels (..., 2) of a pinhole camera with the same K to those of the image.

        NaN for NaN, and for pixels beyond `fold_radius`.
        """
        homogeneous = np.concatenate([xy, np.ones((*np.shape(xy)[:-1], 1))], -1)
        return self.project(homogeneous @ np.linalg.inv(self.K).T)

    def undistort(self, xy: Array) -> Array:
        """Map pixels (..., 2) to those of a pinhole camera with the same K.

        NaN for NaN, for rays 90 deg or more off the axis, and for pixels to which the distortion
        maps no point within `fold_radius`.
        """
        flat = np.asarray(xy, np.float64).reshape(-1, 2)
        ideal = np.full_like(flat, np.nan)
        rows = np.flatnonzero(np.isfinite(flat).all(1))
        if len(rows):
            ray = np.asarray(self.to_pycolmap().cam_ray_from_img(flat[rows]), np.float64)  # (n, 3)
            error = np.abs(self.project(ray) - flat[rows]).max(1)  # NaN, inf: no inverse
            inverted = error < 0.01  # px, negligible
            ideal[rows[inverted]] = self._to_pixels(ray[inverted])
        return ideal.reshape(np.shape(xy))

    def to_pycolmap(self) -> Any:
        """Convert to a `pycolmap.Camera` with id 1.

        Raises:
            ReobjError: the installed pycolmap lacks the model, or the model has other parameters.
        """
        names = camera_parameters(self.model)
        if len(self.params) != len(names):
            found = f"{len(self.params)} parameters of a {self.model} camera"
            raise ReobjError(f"{found}; expected {', '.join(names)}")
        fields = {"model": self.model, "width": self.width, "height": self.height}
        return import_pycolmap().Camera(camera_id=1, params=list(self.params), **fields)

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the camera of the same images resized to (w, h), distortion included."""
        if (self.width, self.height) == size:
            return self
        camera = self.to_pycolmap()
        camera.rescale(*size)
        return Camera(self.model, *size, tuple(camera.params.tolist()))


@functools.lru_cache(64)
def _fold_radius(model: str, params: tuple[float, ...], step_deg: float = 0.1) -> float:
    """Find the fold of `Camera.fold_radius`, the nearest one of 16 directions.

    Args:
        step_deg: between the rays that are tried; near the fold the image moves by less than 1e-4
            focal lengths in a step.
    """
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return float("inf")
    camera = Camera(model, 1, 1, params)
    radius = np.tan(np.radians(np.arange(0, 90, step_deg)))  # (r,)
    turn = 2 * np.pi * np.arange(16) / 16
    xy = radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], 1)  # (r, 16, 2)
    pixels = camera.to_pycolmap().img_from_cam(np.insert(xy, 2, 1, 2).reshape(-1, 3))
    with np.errstate(all="ignore"):  # the terms of the distortion may diverge
        offset = (pixels.reshape(xy.shape) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
        outwards = (np.diff(np.linalg.norm(offset, axis=2), axis=0) > 0).all(1)  # (r - 1,)
    return float(np.append(radius[:-1], np.inf)[np.append(outwards, False).argmin()])


WORLD_MAX = 1e9  # world units, of a camera's position: the Earth in cm fits


def usable(camera: Camera) -> bool:
    """Test whether a camera has a size, finite parameters and positive focal lengths."""
    sized = min(camera.width, camera.height) > 0 and bool(np.isfinite(camera.params).all())
    return sized and bool((np.diag(camera.K)[:2] > 0).all())


def checked_pose(
    cam_from_world: Any, camera: Camera | None, points: Any = None, component: Any = 0
) -> Array | None:
    """Validate and return the pose (3, 4) of one frame; None for None or NaN.

    Args:
        points: (N, 3) in world, or None. component: number of the one that the pose is in.
    Raises:
        ReobjError: the pose is not rigid, or its camera, the points or the component are invalid.
    """

    if points is not None and (np.shape(points)[1:] != (3,) or not np.isfinite(points).all()):
        raise ReobjError(f"points of shape {np.shape(points)}, expected (N, 3), finite, in world")
    # an hour's walk has a few components
    if not isinstance(component, int | np.integer) or not 0 <= component <= 1000:
        raise ReobjError(f"part {component!r}, expected the number of a component, from 0")
    if cam_from_world is None:
        return None
    pose = as_numbers(cam_from_world, "cam_from_world").astype(np.float64)
    if pose.shape != (3, 4):
        raise ReobjError(f"cam_from_world of shape {pose.shape}, expected (3, 4): [R | t]")
    if np.isnan(pose).any():
        return None
    rotation = pose[:, :3].clip(-2, 2)  # the squares of 1e300 are too large
    determinant = np.linalg.det(rotation)
    is_rotation = determinant > 0 and np.abs(rotation @ rotation.T - np.eye(3)).max() <= 1e-3
    if not is_rotation or (np.abs(pose[:, 3]) > WORLD_MAX).any():
        raise ReobjError("cam_from_world: its 3x3 block is not a rotation (determinant "
                         f"{determinant:.2g}), or it is more than {WORLD_MAX:g} units away; "
                         "expected [R | t], x right, y down, z forward")  # fmt: skip
    if not isinstance(camera, Camera) or not usable(camera):
        raise ReobjError(f"cam_from_world with camera={camera}: expected rt.Camera(...) with a "
                         "size, and focal lengths above 0, in pixels")  # fmt: skip
    return pose


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """Return the pinhole camera, without distortion, of images resized by `scale`."""
    params = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] * scale
    size = (round(camera.width * scale), round(camera.height * scale))
    return Camera("PINHOLE", *size, tuple(params.tolist()))


@dataclass(frozen=True, slots=True)
class Poses:
    """Camera poses of a video.

    Attributes:
        camera: intrinsics at the frames' native size, the same for all frames.
        frame: (F,) source frame numbers of all frames that were read, ascending.
        time_s: (F,) seconds.
        cam_from_world: (F, 3, 4), NaN where there is no pose.
        status: (F,) "keyframe", "pnp", "interpolated", "supplied" or "none".
        source: "pycolmap", "user", "map" (located by the points of a map) or "none".
        metric: True when world units are metres.
        up_in_world: (3,) unit vector against gravity, or None if unknown.
        points: (N, 3) sparse points in world; colors (N, 3) uint8 RGB.
        visibility: (M, 2) observations of the points: row of the frame, row of the point.
        part: (F,) connected component of the trajectory of each frame, 0 the largest. Each has its
            own world frame and scale; the transform between two of them is unknown. A frame without
            a pose belongs to the component of the nearest frame with one.
        direction_sigma: (C,) of each component: 0 where its camera positions are sound; else only
            the directions of objects are known, and this is their sigma, rad.
        messages: warnings (frames without poses, and what to do about them).
        reading: how supplied poses were read: format, and the rule that matched their frames.
        scale: metres per world unit and its relative standard deviation, given by a map, or by
            depth maps that made the poses metric; None: estimated with the objects, or as supplied.
            map_id: of the map whose world this is; "": none.
    """

    camera: Camera
    frame: IntArray
    time_s: Array
    cam_from_world: Array
    status: npt.NDArray[np.str_]
    source: str
    metric: bool = False
    up_in_world: Array | None = None
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    visibility: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))
    part: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    direction_sigma: Array = field(default_factory=lambda: np.empty(0))
    messages: tuple[str, ...] = ()
    reading: str = ""
    scale: tuple[float, float] | None = None
    map_id: str = ""

    def __post_init__(self) -> None:
        if len(self.part) != len(self.frame):
            object.__setattr__(self, "part", np.zeros(len(self.frame), np.int64))
        if len(self.direction_sigma) != self.part_count:
            object.__setattr__(self, "direction_sigma", np.zeros(self.part_count))

    def __repr__(self) -> str:
        """Describe the poses in one line."""
        facts = [self.cameras_text, counted(len(self.points), "point", "points")]
        facts += ["in metres"] * self.metric
        if self.part_count > 1:
            facts.append(f"{self.part_count} components")
        return f"Poses({', '.join(facts)})"

    @property
    def measured(self) -> BoolArray:
        """Mark the frames (F,) whose pose was not interpolated."""
        return np.asarray(self.known & (self.status != "interpolated"), bool)

    @property
    def cameras_text(self) -> str:
        """Summarise the frames with a pose: number, source, grade, how many are interpolated."""
        known = int(self.known.sum())
        interpolated = int((self.known & ~self.measured).sum())
        origin = f"{self.source}: {self.reading}" if self.reading else self.source
        turning = int((self.known & (self.direction_sigma[self.part] > 0)).sum())
        if turning:
            few = f"{turning} with " if turning < known else ""
            origin += f"; {few}directions only"
        text = f"cameras: {known} of {len(self.frame)} frames ({origin})"
        return f"{text}, {interpolated} interpolated" if interpolated else text

    @property
    def is_spot(self) -> bool:
        """Whether all cameras have one position, as of a turn: objects have no parallax."""
        known = self.cam_from_world[self.known]
        centre = -np.einsum("fij,fi->fj", known[:, :, :3], known[:, :, 3])
        return len(centre) > 1 and bool((np.ptp(centre, axis=0) == 0).all())

    @property
    def part_count(self) -> int:
        """Number of components, at least 1."""
        return int(self.part.max(initial=0)) + 1

    def part_of(self, frame: IntArray) -> IntArray:
        """Return the component (n,) of frames (n,); frames that were not read: of the next one."""
        row = np.searchsorted(self.frame, frame).clip(max=len(self.frame) - 1)
        return np.asarray(self.part[row], np.int64)

    def of_part(self, part: int) -> Poses:
        """Return one component: its frames, poses and points, without messages."""
        rows = np.flatnonzero(self.part == part)
        row_of = np.full(len(self.frame), -1)
        row_of[rows] = np.arange(len(rows))
        seen = self.visibility[np.isin(self.visibility[:, 0], rows)]
        kept = np.unique(seen[:, 1]) if self.part_count > 1 else np.arange(len(self.points))
        return dataclasses.replace(
            self,
            **{k: getattr(self, k)[rows] for k in ("frame", "time_s", "cam_from_world", "status")},
            up_in_world=None if part else self.up_in_world,  # given in the world of component 0
            scale=None if part and not self.metric else self.scale,
            points=self.points[kept],
            colors=self.colors[kept],
            visibility=np.column_stack([row_of[seen[:, 0]], np.searchsorted(kept, seen[:, 1])]),
            part=np.zeros(len(rows), np.int64),
            direction_sigma=self.direction_sigma[part : part + 1],
            messages=(),
        )

    @property
    def known(self) -> BoolArray:
        """(F,) True where the frame has a pose."""
        return np.asarray(np.isfinite(self.cam_from_world).all((1, 2)), bool)


def without_copies(poses: Poses, copies: Mapping[int, int]) -> Poses:
    """Return poses without those of copies of an image, which show nothing new.

    Args:
        copies: numbers of frames, and of the frame that each is a copy of. Images to which the user
            gave different poses are no copies.
    """
    lost = np.zeros(len(poses.frame), bool)
    for pair in copies.items():
        row, known = place_of(poses, np.array(pair))
        same = poses.source != "user" or np.allclose(*poses.cam_from_world[row])
        lost[row[0]] |= known.all() and same
    return dataclasses.replace(
        poses,
        cam_from_world=np.where(lost[:, None, None], np.nan, poses.cam_from_world),
        status=np.where(lost, "none", poses.status),
        visibility=poses.visibility[~lost[poses.visibility[:, 0]]],
    )


_ARRAYS = ("frame", "time_s", "cam_from_world", "status", "points", "colors", "visibility", "part",
           "direction_sigma")  # fmt: skip
_FACTS = ("source", "metric", "messages", "reading", "scale", "map_id")


def save_poses(path: Path, poses: Poses, **more: Any) -> None:
    """Write poses as npz, atomically; `more` goes into its metadata."""
    facts = {name: getattr(poses, name) for name in _FACTS}
    up = None if poses.up_in_world is None else poses.up_in_world.tolist()
    arrays = {name: getattr(poses, name) for name in _ARRAYS}
    save_npz(path, arrays, camera=dataclasses.asdict(poses.camera), up=up, **facts, **more)


def load_poses(path: Path) -> Poses:
    """Read a file of `save_poses`."""
    arrays, facts = load_npz(path, sealed=True)
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in facts.items()}
    camera = given["camera"]
    return Poses(
        Camera(**{**camera, "params": tuple(camera["params"])}),
        up_in_world=None if given["up"] is None else np.array(given["up"]),
        **{name: given[name] for name in _FACTS},
        **arrays,
    )


def invert_rigid(b_from_a: Array) -> Array:
    """Invert rigid transforms: a_from_b (..., 3, 4) of b_from_a (..., 3, 4)."""
    # x_b = R x_a + t  <=>  x_a = R' x_b - R' t
    rotation = np.swapaxes(b_from_a[..., :3], -1, -2)
    return np.concatenate([rotation, -rotation @ b_from_a[..., 3:]], -1)


def quat_wxyz_from_matrix(rotation: Array) -> Array:
    """Return unit quaternions (N, 4) wxyz, w >= 0, of rotation matrices (N, 3, 3)."""
    if not len(rotation):
        return np.empty((0, 4))
    xyzw = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.asarray(xyzw[:, [3, 0, 1, 2]], np.float64)


def place_of(poses: Poses, frame: IntArray) -> tuple[IntArray, BoolArray]:
    """Find the rows of frames (n,) in the poses.

    Returns:
        row: (n,) in `poses`, undefined where the frame is not in them. known: (n,) True where the
        frame has a pose.
    """
    row = np.searchsorted(poses.frame, frame).clip(0, len(poses.frame) - 1)
    return row, np.asarray((poses.frame[row] == frame) & poses.known[row], bool)


def undistort_boxes(xyxy: Array, camera: Camera) -> Array:
    """Undistort boxes (N, 4) by the midpoints of their edges; edges at the image border stay.

    A box is NaN where an edge cannot be undistorted.
    """
    if not len(xyxy) or camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return xyxy
    side = np.arange(4)
    edges = np.tile(((xyxy[:, :2] + xyxy[:, 2:]) / 2)[:, None], (1, 4, 1))  # (N, 4, 2) midpoints
    edges[:, side, side % 2] = xyxy
    undistorted = camera.undistort(edges)[:, side, side % 2]  # (N, 4)
    at_border = (xyxy <= 1) | (xyxy >= np.array([camera.width, camera.height] * 2) - 1)
    boxes = np.where(at_border, xyxy, undistorted)
    return np.where(np.isfinite(boxes).all(1, keepdims=True), boxes, np.nan)


def distort_boxes(xyxy: Array, camera: Camera) -> Array:
    """Return the bounds (..., 4), pixels of the image, of boxes (..., 4) of a pinhole camera.

    Only the part within `Camera.fold_radius` has an image; NaN for boxes without such a part.
    Bounds of a grid of points in equal steps of the viewing angle, as a box may extend to nearly 90
    deg, with the row and the column nearest to the optical axis, where the fold is farthest out.
    """
    if camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return xyxy
    focal = np.diag(camera.K)[:2]
    centre = camera.K[:2, 2]
    limit = min(np.arctan(camera.fold_radius), np.radians(89.9))
    ends = np.arctan((xyxy.reshape(-1, 2, 2) - centre) / focal).clip(-limit, limit)
    low, high = np.moveaxis(ends, 1, 0)  # (N, 2) rad
    share = np.linspace(0, 1, 5)[:, None, None]
    angle = np.append(low + share * (high - low), np.clip(0, low, high)[None], 0)
    x, y = np.moveaxis(np.tan(angle) * focal + centre, 2, 0)  # (6, N) each
    grid = camera.distort(np.stack(np.broadcast_arrays(x[:, None], y), -1)).reshape(36, -1, 2)
    bounds = np.hstack([
        np.nan_to_num(grid, nan=np.inf).min(0), np.nan_to_num(grid, nan=-np.inf).max(0)
    ])  # fmt: skip
    bounds[~(bounds[:, :2] < bounds[:, 2:]).all(1)] = np.nan
    return bounds.reshape(xyxy.shape)


def viewing_rays(xyxy: Array, img_from_world: Array) -> Array:
    """Return the viewing rays of the centres of boxes: unit vectors (N, 3) in world axes.

    Args:
        xyxy: (N, 4) undistorted pixels. img_from_world: K @ cam_from_world, (3, 4) for all or
            (N, 3, 4), NaN where unknown (the ray is NaN too).
    """
    # x ~ A X + a: the ray through x runs along A^-1 x (Hartley & Zisserman 2004, eq. 6.14)
    center = np.column_stack([(xyxy[:, :2] + xyxy[:, 2:]) / 2, np.ones(len(xyxy))])  # (N, 3)
    ray = (np.linalg.inv(img_from_world[..., :3]) @ center[..., None])[..., 0]
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def angle_deg(a: Array, b: Array) -> Array:
    """Return the angles in degrees between unit vectors (..., 3)."""
    return np.asarray(np.degrees(np.arccos((a * b).sum(-1).clip(-1, 1))))


def triangulate_rays(cam_from_world: Array, rays_in_cam: Array) -> tuple[Array, Array, Array]:
    """Triangulate one point from the viewing rays of n cameras.

    Args:
        cam_from_world: (n, 3, 4). rays_in_cam: (n, 3) unit vectors.
    Returns:
        ray: (n, 3) unit vectors in world axes. centre: (n, 3) of the cameras in world. point: (3,)
        in world of least squared distances from the rays (for parallel rays: nearest to the
        origin).
    """
    world_from_cam = invert_rigid(cam_from_world)
    ray = np.einsum("nij,nj->ni", world_from_cam[:, :, :3], rays_in_cam)
    centre = world_from_cam[:, :, 3]
    # sum_i (I - d_i d_i') (X - c_i) = 0
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]  # (n, 3, 3)
    point = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centre), rcond=1e-9)[0]
    return ray, centre, point


CV_FROM_GL = np.diag([1.0, -1.0, -1.0])  # camera axes; OpenGL: y up, z backward


def write_tum(path: Path, poses: Poses) -> None:
    """Write the known poses as TUM rows: time in s, position, quaternion xyzw (world_from_cam)."""
    world_from_cam = invert_rigid(poses.cam_from_world[poses.known])
    xyzw = np.roll(quat_wxyz_from_matrix(world_from_cam[:, :, :3]), -1, 1)
    table = np.column_stack([poses.time_s[poses.known], world_from_cam[:, :, 3], xyzw])  # (N, 8)
    units = f"units: {'metres' if poses.metric else 'arbitrary'}"  # `read_tum` reads it
    rows = [" ".join([f"{row[0]:.9f}", *(f"{v:.12g}" for v in row[1:])]) for row in table]
    header = f"# t tx ty tz qx qy qz qw (world_from_cam, seconds, {units})"
    with atomic(path) as part:
        part.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def write_colmap(path: Path, poses: Poses, image_names: Sequence[str]) -> None:
    """Write a COLMAP text model of all known poses and points, without observations.

    A binary model of the same reconstruction by pycolmap is kept: it has the observations.

    Args:
        image_names: (F,) of the frames of `poses`.
    """
    path.mkdir(parents=True, exist_ok=True)
    if poses.source == "pycolmap" and (path / "images.bin").exists():
        return
    for old in path.glob("*.bin"):
        old.unlink()
    camera = poses.camera
    rows = np.flatnonzero(poses.known).tolist()
    known = poses.cam_from_world[rows]
    values = np.column_stack([quat_wxyz_from_matrix(known[:, :, :3]), known[:, :, 3]])  # (N, 7)
    params = map(float, camera.params)
    points = zip(poses.points.tolist(), poses.colors.tolist(), strict=True)
    tables: dict[str, list[Sequence[Any]]] = {
        "cameras": [(1, camera.model, camera.width, camera.height, *params)],
        "images": [(row + 1, *value, 1, f"{image_names[row]}\n")
                   for row, value in zip(rows, values.tolist(), strict=True)],
        "points3D": [(i, *xyz, *rgb, 0) for i, (xyz, rgb) in enumerate(points, 1)],
    }  # fmt: skip
    for name, table in tables.items():
        text = "".join(f"{' '.join(map(str, row))}\n" for row in table)
        (path / f"{name}.txt").write_text(text, "utf-8", "surrogateescape")


@dataclass(frozen=True, slots=True)
class SparseModel:
    """A COLMAP model as arrays: R registered images by ascending id, N points, M observations.

    Attributes:
        names: (R,) of the images. cameras: (R,) of each image. cam_from_world: (R, 3, 4).
        points: (N, 3) in world. colors: (N, 3) RGB. track_length: (N,) observations of each.
        obs_image, obs_point: (M,) row of the image and of the point. obs_xy: (M, 2) pixels.
    """

    names: tuple[str, ...]
    cameras: list[Camera]
    cam_from_world: Array
    points: Array
    colors: npt.NDArray[np.uint8]
    track_length: IntArray
    obs_image: IntArray
    obs_point: IntArray
    obs_xy: Array


def checked_points(xyz: Sequence[Any], ids: Sequence[Any], where: Path) -> Array:
    """Return points (N, 3) of a model; refuse one that is not finite, or far away, by its id."""
    points = np.array(xyz, np.float64).reshape(-1, 3)
    far = ~(np.abs(points) < WORLD_MAX).all(1)  # also NaN
    if far.any():
        raise ReobjError(f"{where}: point {ids[int(far.argmax())]} is not finite, or more than "
                         f"{WORLD_MAX:g} units away from the origin; remove it")  # fmt: skip
    return points


def read_sparse_model(folder: Path) -> SparseModel:
    """Read a COLMAP model, binary or text, with pycolmap."""
    model = import_pycolmap().Reconstruction(str(folder))
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    ids, points = zip(*sorted(model.points3D.items()), strict=True) if model.points3D else ((), ())
    row = {point_id: r for r, point_id in enumerate(ids)}
    seen = [
        (r, row[p.point3D_id], *p.xy)
        for r, image in enumerate(images)
        for p in image.get_observation_points2D()
    ]
    table = np.array(seen).reshape(-1, 4)
    of_image = [model.cameras[image.camera_id] for image in images]
    poses = [image.cam_from_world().matrix() for image in images]
    return SparseModel(
        tuple(image.name for image in images),
        [Camera(c.model.name, c.width, c.height, tuple(c.params.tolist())) for c in of_image],
        np.array(poses).reshape(-1, 3, 4),
        checked_points([point.xyz for point in points], ids, folder),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.array([point.track.length() for point in points], np.int64),
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        table[:, 2:],
    )


# ---- Sparse points that a frame sees -----------------------------------------------------------


class VisiblePoints:
    """Index of the sparse points that each frame sees.

    A frame without observations of its own (between two keyframes, or without a depth map) is
    assumed to see what the nearest observing frames before and after it, of its component of the
    trajectory, observed. Occlusion is not tested: such a point may lie behind a nearer object.
    """

    def __init__(self, poses: Poses) -> None:
        self.poses = poses
        observer, self._point = np.unique(poses.visibility, axis=0).T  # (M,) rows each
        self._start = np.searchsorted(observer, np.arange(len(poses.frame) + 1))
        self._observers = np.flatnonzero(np.diff(self._start))  # frames with observations
        self._img_from_world = poses.camera.K @ poses.cam_from_world  # (F, 3, 4)

    def observed(self, row: int) -> IntArray:
        """Return the points that the frame in this row of the poses observed itself."""
        return np.asarray(self._point[self._start[row] : self._start[row + 1]], np.int64)

    def nearby(self, row: int) -> IntArray:
        """Return the points that a frame observed, else those of its neighbours, ascending.

        Neighbours' points may project outside the image of this frame (see `in_frame`).
        """
        if len(observed := self.observed(row)):
            return observed
        same_component = self.poses.part[self._observers] == self.poses.part[row]
        observers = self._observers[same_component]
        after = np.searchsorted(observers, row)
        sets = [self.observed(other) for other in observers[max(after - 1, 0) : after + 1]]
        return np.unique(np.concatenate([np.empty(0, np.int64), *sets]))

    def in_frame(self, row: int) -> IntArray:
        """Return the rows of the points in the image of a frame, ascending; none without a pose."""
        points = self.nearby(row)
        if not self.poses.known[row] or len(self.observed(row)):
            return points[: None if self.poses.known[row] else 0]
        image = np.array([[0.0, 0.0, self.poses.camera.width, self.poses.camera.height]])
        _, inside, _ = points_in_boxes(self.poses.points[points], self._img_from_world[row], image)
        return points[inside]


def points_in_boxes(
    points: Array, img_from_world: Array, xyxy: Array
) -> tuple[IntArray, IntArray, Array]:
    """Find the points in front of a camera that project into boxes.

    Args:
        points: (N, 3) in world. img_from_world: (3, 4) K @ cam_from_world of a pinhole camera.
        xyxy: (D, 4) undistorted boxes in its pixels; NaN: none.
    Returns:
        one entry for each of K pairs of a box and a point in it, by box: rows of the boxes (K,)
        and of the points (K,), depth (K,) of the point along the optical axis, in world units.
    """
    projected = points @ img_from_world[:, :3].T + img_from_world[:, 3]  # (N, 3)
    depth = projected[:, 2]
    xy = projected[:, :2] / np.where(depth > 0, depth, np.nan)[:, None]  # (N, 2)
    boxes = xyxy[:, None]  # (D, 1, 4)
    inside = ((xy >= boxes[..., :2]) & (xy <= boxes[..., 2:])).all(2)  # (D, N)
    box, point = np.nonzero(inside)
    return box, point, depth[point]
