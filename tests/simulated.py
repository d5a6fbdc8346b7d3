"""Simulated chairs observed by known cameras: tracks and poses with ground truth."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
import reobj_track as rt
from reobj.objects.config import make_fit
from reobj.objects.description import describe_objects, describe_world
from reobj.objects.fit import link_and_fit
from reobj.objects.observations import MIN_SCORE, Scene, gather_views
from reobj.results.result import VideoInfo
from reobj.types import object_classes

SIZE = (640, 480)
CAMERA = rt.Camera("PINHOLE", *SIZE, (520.0, 520.0, 320.0, 240.0))
CHAIR, CUP = rt.COCO_NAMES.index("chair"), rt.COCO_NAMES.index("cup")


def looking_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """cam_from_world (3, 4) of a camera at `eye` in a world with z up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.c_[rotation, -rotation @ eye]


def walk(frames: int = 40, arc_deg: float = 120.0, camera: rt.Camera = CAMERA) -> rt.Poses:
    """An arc around the origin at 3.5 m, z up, metres."""
    angles = np.radians(np.linspace(-arc_deg / 2, arc_deg / 2, frames))
    eyes = np.stack([3.5 * np.sin(angles), -3.5 * np.cos(angles), np.full(frames, 1.6)], 1)
    poses = np.stack([looking_at(eye, np.array([0, 0, 0.4])) for eye in eyes])
    number = np.arange(frames)
    up, status = np.array([0, 0, 1.0]), np.full(frames, "supplied")
    return rt.Poses(camera, number, number / 30, poses, status, "user", True, up)


def turn(frames: int = 40) -> tuple[rt.Poses, rt.Tracks]:
    """A camera that turns on one spot past the chairs, twice: directions only; tracks of them.

    The world of the poses has its axes and its origin on the spot, at `SPOT` of the chairs' world.
    """
    x = 0.6 * np.sin(np.linspace(0, 4 * np.pi, frames))
    cams = np.stack([looking_at(SPOT, np.array([to, 0, 0.4])) for to in x])
    true = dataclasses.replace(walk(frames), cam_from_world=cams)
    ours = dataclasses.replace(
        true, cam_from_world=cams * [1, 1, 1, 0], source="pycolmap", metric=False,
        up_in_world=None, direction_sigma=np.array([0.01]),
    )  # fmt: skip
    return ours, tracks_of(true)


SPOT = np.array([0, -3.5, 1.6])


def chair_solids() -> quadrics.Ellipsoids:
    """Three chairs of .56 x .6 x .82 m in a row."""
    centers = np.array([[-1.1, 0, 0.41], [0, 0.1, 0.41], [1.1, 0, 0.41]])
    turn = [[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
            for a in (0.2, 1.1, -0.5)]  # fmt: skip
    return quadrics.Ellipsoids(centers, np.tile([0.28, 0.3, 0.41], (3, 1)), np.array(turn))


def tracks_of(
    poses: rt.Poses, noise_px: float = 1.0, solids: quadrics.Ellipsoids | None = None
) -> rt.Tracks:
    """Noisy boxes of solids (the chairs), a tracklet each, by frame; detection_index: the solid."""
    solids = solids or chair_solids()
    img_from_world = poses.camera.K @ poses.cam_from_world
    boxes = quadrics.solid_boxes(solids, "box", img_from_world)  # (F, O, 4)
    boxes = boxes + np.random.default_rng(0).normal(0, noise_px, boxes.shape)
    row, chair = np.divmod(np.arange(boxes.shape[0] * len(solids)), len(solids))
    n = len(row)
    columns = (boxes.reshape(-1, 4), np.full(n, 0.9), np.full(n, CHAIR), chair)
    return rt.Tracks(poses.frame[row], chair + 1, chair + 1, *columns)


def fitted(
    tracks: rt.Tracks,
    poses: rt.Poses | None,
    config: rt.ObjectsConfig | None = None,
    names: tuple[str, ...] = rt.COCO_NAMES,
) -> rt.Result:
    """Fit and describe tracks with the right identities, without linking."""
    config, fits, views = config or rt.ObjectsConfig(), None, None
    if poses is not None:
        classes = object_classes(tracks)
        group = np.searchsorted(list(classes), tracks.track_id)
        views = gather_views(tracks, poses, group, len(classes), MIN_SCORE)
        fits = make_fit(config, poses, names)(views, list(classes.values()), Scene())
    objects = describe_objects(tracks, names, fits, views, config.min_views, config.moving_classes)
    video = VideoInfo("walk.mp4", *SIZE, 30.0)
    world = describe_world(poses, [fits], [])
    return rt.Result(tracks, names, video, objects, world, poses, fits)


def with_columns(tracks: rt.Tracks, **columns: object) -> rt.Tracks:
    """The tracks with other columns; a scalar applies to all rows."""
    n = len(tracks)
    arrays = {k: np.full(n, v) if np.isscalar(v) else v for k, v in columns.items()}
    return dataclasses.replace(tracks, **arrays)  # type: ignore[arg-type]


BREAK = 40  # first frame of the second component in `two_components`
COMPONENTS = (  # scale, rotation vector, shift: x_in_component = scale * R @ x_in_true + shift
    (0.5, (0.2, 0.1, -0.3), (1.0, 2.0, -1.0)),
    (3.0, (-1.0, 0.7, 0.4), (-5.0, 0.5, 4.0)),
)


def into_component(component: int, points: np.ndarray) -> np.ndarray:
    """Transform points (N, 3) from the true world to that of a component."""
    scale, turn, shift = COMPONENTS[component]
    return scale * points @ Rotation.from_rotvec(turn).as_matrix().T + shift


def two_components(frames: int = 64) -> rt.Poses:
    """A walk around the chairs that breaks at frame 40: two components; 38 to 40 have no pose.

    Every chair's centre is a sparse point that all frames of its component observe.
    """
    true = walk(frames, 200.0)
    component = (np.arange(frames) >= BREAK).astype(np.int64)
    cams = true.cam_from_world.copy()
    for k, (scale, turn, shift) in enumerate(COMPONENTS):
        rows = (
            component == k
        )  # X_cam = R_c X + t_c; times the scale, with X = R' (X_own - shift) / s
        rotation = cams[rows, :, :3] @ Rotation.from_rotvec(turn).as_matrix().T
        cams[rows, :, 3] = scale * cams[rows, :, 3] - rotation @ np.array(shift)
        cams[rows, :, :3] = rotation
    cams[BREAK - 2 : BREAK + 1] = np.nan
    status = np.where(np.isfinite(cams[:, 0, 0]), "pnp", "none")
    centers = chair_solids().center_in_world
    row, point = np.divmod(np.arange(frames * 3), 3)
    return dataclasses.replace(
        true, cam_from_world=cams, status=status, source="pycolmap", metric=False,
        up_in_world=None, points=np.concatenate([into_component(k, centers) for k in (0, 1)]),
        colors=np.repeat(np.array([[0], [9]], np.uint8), 3, 0) * np.ones(3, np.uint8),
        visibility=np.column_stack([row, point + 3 * component[row]]), part=component,
    )  # fmt: skip


def tracks_in_two_components(poses: rt.Poses) -> rt.Tracks:
    """Boxes of the chairs in `two_components`: all three tracks continue over the break."""
    true = dataclasses.replace(walk(len(poses.frame), 200.0), frame=poses.frame)
    return tracks_of(true, 0.5)


def with_fitted_covariance(result: rt.Result, variance: float) -> rt.Result:
    """The result of `fitted`, had the fit given all parameters of all objects this variance."""
    assert result.fits is not None and result.poses is not None
    classes = object_classes(result.tracks)
    group = np.searchsorted(list(classes), result.tracks.track_id)
    views = gather_views(result.tracks, result.poses, group, len(classes), MIN_SCORE)
    cov = np.tile(variance * np.eye(9), (len(classes), 1, 1))
    fits = dataclasses.replace(result.fits, cov=cov)
    objects = describe_objects(result.tracks, result.class_names, fits, views)
    return dataclasses.replace(result, objects=objects, fits=fits)


def unlinked(poses: rt.Poses | None = None, tracks: rt.Tracks | None = None) -> rt.Result:
    """Output of tracker and reconstruction, before linking: by default two components."""
    poses = two_components() if poses is None else poses
    tracks = tracks_in_two_components(poses) if tracks is None else tracks
    return rt.Result(tracks, rt.COCO_NAMES, VideoInfo("walk.mp4", *SIZE, 30.0), poses=poses)


def finished(result: rt.Result, **options: Any) -> rt.Result:
    """The same, linked and fitted."""
    return link_and_fit(result, rt.ObjectsConfig(**options))
