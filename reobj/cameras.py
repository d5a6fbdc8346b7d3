"""Cameras and poses: intrinsics, rigid transforms, the pycolmap adapter, TUM and COLMAP."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.files import atomic, load_npz, save_npz
from reobj.types import Array, BoolArray, IntArray, ReobjError


def import_pycolmap() -> Any:
    """Import pycolmap without its log on stderr and without its handler of SIGTERM."""
    if "pycolmap" in sys.modules:
        return sys.modules["pycolmap"]
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, handler or signal.SIG_DFL)
    pycolmap.logging.minloglevel = 3
    return pycolmap


@dataclass(frozen=True, slots=True)
class Camera:
    """A COLMAP camera: model, size in pixels, parameters in its order (centre of pixel 0 at .5)."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def K(self) -> Array:
        """(3, 3) pinhole part of the intrinsics."""
        one_focal = self.model.startswith("SIMPLE_") or self.model in ("RADIAL", "RADIAL_FISHEYE")
        fx, fy, cx, cy = (self.params[0], *self.params[:3]) if one_focal else self.params[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def undistort(self, xy: Array) -> Array:
        """Map (..., 2) pixels to those of an ideal pinhole camera with the same K; NaN stays."""
        camera = pycolmap_camera(self, (self.width, self.height))
        flat = np.asarray(xy, np.float64).reshape(-1, 2)
        ideal = np.full_like(flat, np.nan)
        good = np.isfinite(flat).all(1)
        if good.any():
            rays = np.asarray(camera.cam_from_img(flat[good]), np.float64)
            ideal[good] = rays @ self.K[:2, :2].T + self.K[:2, 2]
        return ideal.reshape(np.shape(xy))


def pycolmap_camera(camera: Camera, size: tuple[int, int]) -> Any:
    """Make pycolmap's camera, for images of another size."""
    facts = {"model": camera.model, "width": camera.width, "height": camera.height}
    made = import_pycolmap().Camera(camera_id=1, params=list(camera.params), **facts)
    if (camera.width, camera.height) != size:
        made.rescale(*size)
    return made


def parse_camera(text: str, size: tuple[int, int]) -> Camera | None:
    """Read `fx,fy,cx,cy[,k1,k2,p1,p2]`, native pixels, as a PINHOLE or OPENCV camera; "": None.

    >>> parse_camera("500,500,320,240", (640, 480)).model
    'PINHOLE'
    """
    if not text.strip():
        return None
    with contextlib.suppress(ValueError):
        numbers = [float(part) for part in text.split(",")]
        if 4 <= len(numbers) <= 8 and np.isfinite(numbers).all() and min(numbers[:2]) > 0:
            numbers += [0.0] * (8 - len(numbers) if len(numbers) > 4 else 0)
            camera = Camera("OPENCV" if len(numbers) == 8 else "PINHOLE", *size, tuple(numbers))
            return checked_camera(camera, f"--camera {text}")
    raise ReobjError(
        f"--camera {text!r}: expected fx,fy,cx,cy[,k1,k2,p1,p2], pixels of frames "
        f"of {size[0]}x{size[1]}"
    )


def checked_camera(camera: Camera, where: str) -> Camera:
    """Refuse intrinsics that belong to another image size."""
    size, centre, focal = np.array([camera.width, camera.height]), camera.K[:2, 2], camera.K[0, 0]
    if (np.abs(centre - size / 2) > 0.2 * size).any() or not 0.1 < focal / size.max() < 10:
        raise ReobjError(
            f"{where}: focal length {focal:.0f} px and centre ({centre[0]:.0f}, {centre[1]:.0f}) "
            f"do not fit frames of {size[0]}x{size[1]} as they are read (rotated? resized?)"
        )
    return camera


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """The pinhole part of a camera for images resized by `scale`."""
    K = camera.K
    params = (K[0, 0] * scale, K[1, 1] * scale, K[0, 2] * scale, K[1, 2] * scale)
    return Camera("PINHOLE", round(camera.width * scale), round(camera.height * scale), params)


@dataclass(frozen=True, slots=True)
class Poses:
    """Cameras of a video.

    Attributes:
        camera: intrinsics at the frames' native size.
        frame: (F,) source frame numbers, ascending, one for every frame that was read.
        time_s: (F,) seconds.
        cam_from_world: (F, 3, 4), NaN where there is no pose.
        status: (F,) "keyframe", "pnp", "interpolated", "supplied" or "none".
        source: "pycolmap", "user" or "none".
        metric: True when world units are metres.
        up_in_world: (3,) unit vector against gravity, or None if unknown.
        points: (N, 3) sparse points in world; colors (N, 3) uint8 RGB.
        messages: what the user should know (spans without poses and what helps).
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
    messages: tuple[str, ...] = ()

    @property
    def known(self) -> BoolArray:
        """(F,) True where the frame has a pose."""
        return np.asarray(np.isfinite(self.cam_from_world).all((1, 2)), bool)


_POSE_ARRAYS = ("frame", "time_s", "cam_from_world", "status", "points", "colors")


def save_poses(path: Path, poses: Poses) -> None:
    """Write poses as npz, atomically."""
    facts = {
        "camera": dataclasses.asdict(poses.camera),
        "source": poses.source,
        "metric": poses.metric,
        "up": None if poses.up_in_world is None else poses.up_in_world.tolist(),
        "messages": poses.messages,
    }
    save_npz(path, {k: getattr(poses, k) for k in _POSE_ARRAYS}, **facts)


def load_poses(path: Path) -> Poses:
    """Read what `save_poses` wrote."""
    data, facts = load_npz(path)
    arrays = {k: data[k] for k in _POSE_ARRAYS}
    camera = Camera(**facts["camera"] | {"params": tuple(facts["camera"]["params"])})
    up = None if facts["up"] is None else np.array(facts["up"])
    return Poses(
        camera=camera,
        source=facts["source"],
        metric=facts["metric"],
        up_in_world=up,
        messages=tuple(facts["messages"]),
        **arrays,
    )


def invert_rigid(b_from_a: Array) -> Array:
    """Return a_from_b (..., 3, 4) of a rigid b_from_a (..., 3, 4)."""
    rotation = np.swapaxes(b_from_a[..., :3], -1, -2)
    return np.concatenate([rotation, -rotation @ b_from_a[..., 3:]], -1)


def quat_wxyz_from_matrix(rotation: Array) -> Array:
    """Unit quaternions (N, 4), w first and >= 0, of rotation matrices (N, 3, 3)."""
    if not len(rotation):
        return np.empty((0, 4))
    xyzw = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.asarray(xyzw[:, [3, 0, 1, 2]], np.float64)


def place_of(poses: Poses, frame: IntArray) -> tuple[IntArray, BoolArray]:
    """Rows (n,) of frames in the poses, and whether these have a pose there."""
    place = np.searchsorted(poses.frame, frame).clip(0, len(poses.frame) - 1)
    return place, np.asarray((poses.frame[place] == frame) & poses.known[place], bool)


def undistort_boxes(xyxy: Array, camera: Camera) -> Array:
    """Boxes (N, 4) whose edges go through their undistorted middles; at the border they stay."""
    if not len(xyxy) or camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return xyxy
    edges = np.tile(((xyxy[:, :2] + xyxy[:, 2:]) / 2)[:, None], (1, 4, 1))  # (N, 4, 2) middles
    side, axis = np.arange(4), np.array([0, 1, 0, 1])
    edges[:, side, axis] = xyxy
    undistorted = camera.undistort(edges)[:, side, axis]  # (N, 4)
    limit = np.array([camera.width, camera.height] * 2)
    at_border = (xyxy <= 1) | (xyxy >= limit - 1)
    return np.where(at_border, xyxy, undistorted)


def viewing_rays(xyxy: Array, img_from_world: Array) -> Array:
    """Unit vectors (N, 3) in world axes from the camera to the centres of boxes (N, 4); one
    (3, 4) matrix for all or one each, NaN: unknown.
    """
    center = np.column_stack([(xyxy[:, :2] + xyxy[:, 2:]) / 2, np.ones(len(xyxy))])  # (N, 3)
    ray = (np.linalg.inv(img_from_world[..., :3]) @ center[..., None])[..., 0]
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def angle_deg(a: Array, b: Array) -> Array:
    """Degrees between unit vectors (..., 3)."""
    return np.asarray(np.degrees(np.arccos((a * b).sum(-1).clip(-1, 1))))


def triangulate_rays(cam_from_world: Array, rays_in_cam: Array) -> tuple[Array, Array, Array]:
    """World directions (n, 3) of unit rays, camera centres (n, 3), point (3,) nearest to all."""
    world_from_cam = invert_rigid(cam_from_world)
    ray = np.einsum("nij,nj->ni", world_from_cam[:, :, :3], rays_in_cam)
    centre = world_from_cam[:, :, 3]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]  # (n, 3, 3) sum_i (I - d d') (X - c) = 0
    point = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centre), rcond=1e-9)[0]
    return ray, centre, point


CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
NO_SCALE = "units: arbitrary"


def write_tum(path: Path, poses: Poses) -> None:
    """Write the known poses as TUM rows: world_from_cam, seconds, quaternion xyzw."""
    world_from_cam = invert_rigid(poses.cam_from_world[poses.known])
    xyzw = np.roll(quat_wxyz_from_matrix(world_from_cam[:, :, :3]), -1, 1)
    table = np.column_stack([poses.time_s[poses.known], world_from_cam[:, :, 3], xyzw])  # (N, 8)
    units = "units: metres" if poses.metric else NO_SCALE
    rows = [" ".join(f"{value:.9f}" for value in row) for row in table]
    header = f"# t tx ty tz qx qy qz qw (world_from_cam, seconds, {units})"
    with atomic(path) as part:
        part.write_text("\n".join([header, *rows]) + "\n")


def write_colmap(path: Path, poses: Poses, image_names: Sequence[str]) -> None:
    """Write a COLMAP text model of all known poses and points, unless pycolmap's own is there.

    Args:
        image_names: (F,) name of every frame of `poses`.
    """
    path.mkdir(parents=True, exist_ok=True)
    if poses.source == "pycolmap" and (path / "images.bin").exists():
        return
    for old in path.glob("*.bin"):
        old.unlink()
    camera = poses.camera
    numbers = " ".join(repr(float(p)) for p in camera.params)
    facts = f"1 {camera.model} {camera.width} {camera.height} {numbers}\n"
    (path / "cameras.txt").write_text(facts)
    known = poses.cam_from_world[poses.known]
    values = np.column_stack([quat_wxyz_from_matrix(known[:, :, :3]), known[:, :, 3]])  # (N, 7)
    lines = [
        f"{i + 1} {' '.join(map(repr, row))} 1 {image_names[i]}\n\n"
        for i, row in zip(np.flatnonzero(poses.known).tolist(), values.tolist(), strict=True)
    ]
    (path / "images.txt").write_text("".join(lines))
    points = zip(poses.points.tolist(), poses.colors.tolist(), strict=True)
    rows = [" ".join(map(repr, (i, *xyz, *rgb, 0))) for i, (xyz, rgb) in enumerate(points, 1)]
    (path / "points3D.txt").write_text("".join(f"{row}\n" for row in rows))


@dataclass(frozen=True, slots=True)
class SparseModel:
    """A COLMAP model as arrays; images by ascending id."""

    names: tuple[str, ...]
    cameras: list[Camera]  # (R,) of each image
    cam_from_world: Array  # (R, 3, 4)
    points: Array  # (N, 3)
    colors: npt.NDArray[np.uint8]  # (N, 3) RGB
    track_length: IntArray  # (N,)
    obs_image: IntArray  # (M,) row of the image
    obs_point: IntArray  # (M,) row of the point
    obs_xy: Array  # (M, 2) COLMAP pixels


def read_model(folder: Path) -> SparseModel:
    model = import_pycolmap().Reconstruction(str(folder))
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    points = sorted(model.points3D.items())
    row = {point_id: r for r, (point_id, _) in enumerate(points)}
    seen = [
        (r, row[p.point3D_id], *p.xy)
        for r, image in enumerate(images)
        for p in image.get_observation_points2D()
    ]
    table = np.array(seen).reshape(-1, 4)
    cameras = {
        i: Camera(c.model.name, c.width, c.height, tuple(c.params.tolist()))
        for i, c in model.cameras.items()
    }
    poses = [image.cam_from_world().matrix() for image in images]
    return SparseModel(
        names=tuple(image.name for image in images),
        cameras=[cameras[image.camera_id] for image in images],
        cam_from_world=np.array(poses).reshape(-1, 3, 4),
        points=np.array([point.xyz for _, point in points]).reshape(-1, 3),
        colors=np.array([point.color for _, point in points], np.uint8).reshape(-1, 3),
        track_length=np.array([point.track.length() for _, point in points], np.int64),
        obs_image=table[:, 0].astype(np.int64),
        obs_point=table[:, 1].astype(np.int64),
        obs_xy=table[:, 2:],
    )
