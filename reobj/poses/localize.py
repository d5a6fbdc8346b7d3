"""Poses of the frames between the keyframes: points followed from both sides, PnP."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from reobj.cameras import Camera, SparseModel, import_pycolmap, invert_rigid, pycolmap_camera
from reobj.files import Progress
from reobj.poses.keyframes import WorkVideo, follow_points
from reobj.types import Array, BoolArray, Image, IntArray

MAX_RUN = 1000  # frames held at once between two keyframes
MAX_STEP_RATIO = 5.0  # refuse PnP poses this many median steps from neighbours


def locate_between(
    model: SparseModel, places: IntArray, video: WorkVideo, seed: int, line: Progress
) -> tuple[Array, npt.NDArray[np.str_]]:
    """Locate every frame by PnP from points followed from the keyframes before and after it.

    Args:
        places: (R,) place in the video of each registered keyframe, ascending.
    Returns:
        cam_from_world (F, 3, 4), NaN where PnP was refused, and status (F,); see `Poses`.
    """
    count, camera = len(video.frames), model.cameras[0]
    cam_from_world, status = np.full((count, 3, 4), np.nan), np.full(count, "none", "<U12")
    cam_from_world[places], status[places] = model.cam_from_world, "keyframe"
    for before, after, run in _segments(places, video.grays(), MAX_RUN):
        images = [gray for _, gray in run]
        ahead = _follow(model, before, images)
        back = _follow(model, after, images[::-1])[::-1]
        for (place, gray), (rows_a, xy_a), (rows_b, xy_b) in zip(run, ahead, back, strict=True):
            if status[place] == "none":
                points, xy = model.points[np.r_[rows_a, rows_b]], np.r_[xy_a, xy_b]
                found = absolute_pose(xy, points, camera, gray.shape[1], seed)
                if found is not None:
                    cam_from_world[place], status[place] = found, "pnp"
        line.step(len(run) - 1)
    line.close()
    jump = _jumps(cam_from_world, MAX_STEP_RATIO) & (status == "pnp")
    cam_from_world[jump], status[jump] = np.nan, "none"
    return cam_from_world, status


def _segments(
    places: IntArray, grays: Iterator[Image], longest: int
) -> Iterator[tuple[int, int, list[tuple[int, Image]]]]:
    """Cut the video at the registered keyframes.

    Yields rows of the keyframes before and after (-1: none), and (place, image) of both and of all
    between. Of stretches without a keyframe that are longer than `longest`, the middle is left out.
    """
    row_of = {int(place): row for row, place in enumerate(places)}
    before, run = -1, deque[tuple[int, Image]](maxlen=longest)
    for place, gray in enumerate(grays):
        run.append((place, gray))
        row = row_of.get(place, -1)
        if row >= 0 or (before >= 0 and len(run) == longest):
            yield before, row, list(run)
            before, run = row, deque([(place, gray)], maxlen=longest)
    if before >= 0:
        yield before, -1, list(run)


PNP_POINTS = 200  # 3D points tracked from each keyframe into the frames between


def _follow(model: SparseModel, row: int, images: list[Image]) -> list[tuple[IntArray, Array]]:
    """Follow the longest-seen 3D points of a keyframe (row; -1: none) through the images.

    Returns:
        per image: rows of `model.points` (n,) and their native pixels (n, 2), COLMAP convention.
    """
    seen = np.flatnonzero(model.obs_image == row)
    longest = np.argsort(-model.track_length[model.obs_point[seen]], kind="stable")
    seen = seen[longest[:PNP_POINTS]]
    scale = np.array(images[0].shape[::-1]) / (model.cameras[0].width, model.cameras[0].height)
    rows, xy = model.obs_point[seen], model.obs_xy[seen] * scale - 0.5  # OpenCV: centres at 0
    followed = [(rows, model.obs_xy[seen])]
    for old, new in itertools.pairwise(images):
        ahead, kept = follow_points(old, new, xy)
        rows, xy = rows[kept], ahead[kept]
        followed.append((rows, (xy + 0.5) / scale))
    return followed


def _jumps(cam_from_world: Array, ratio: float) -> BoolArray:
    """Mark frames whose centre is a detour: far from both neighbours, which are near each other."""
    known = np.flatnonzero(np.isfinite(cam_from_world).all((1, 2)))
    jump = np.zeros(len(cam_from_world), bool)
    if len(known) > 2:
        centre = invert_rigid(cam_from_world[known])[:, :, 3]  # (N, 3)
        step = np.linalg.norm(np.diff(centre, axis=0), axis=1)  # (N-1,)
        direct = np.linalg.norm(centre[2:] - centre[:-2], axis=1)  # (N-2,)
        usual = np.maximum(direct, np.median(step))
        jump[known[1:-1]] = step[1:] + step[:-1] - direct > ratio * usual
    return jump


def fill_gaps(
    frame: IntArray, cam_from_world: Array, status: npt.NDArray[np.str_], max_gap: int
) -> tuple[Array, npt.NDArray[np.str_]]:
    """Interpolate over at most `max_gap` lost frames: rotation by slerp, camera centre on a line.

    (Interpolating t of cam_from_world instead would bend the path.)
    """
    filled, status = cam_from_world.copy(), status.copy()
    known = np.flatnonzero(np.isfinite(cam_from_world).all((1, 2)))
    for a, b in itertools.pairwise(known):
        if b - a > 1 and frame[b] - frame[a] - 1 <= max_gap:
            share = (frame[a + 1 : b] - frame[a]) / (frame[b] - frame[a])  # (n,)
            ends = invert_rigid(cam_from_world[[a, b]])  # (2, 3, 4) world_from_cam
            between = Slerp([0, 1], Rotation.from_matrix(ends[:, :, :3]))
            turn = between(share).as_matrix()  # (n, 3, 3)
            centre = ends[0, :, 3] + share[:, None] * (ends[1, :, 3] - ends[0, :, 3])  # (n, 3)
            filled[a + 1 : b] = invert_rigid(np.concatenate([turn, centre[:, :, None]], 2))
            status[a + 1 : b] = "interpolated"
    return filled, status


PNP_MIN_INLIERS = 15  # accept a PnP pose with at least this many inliers
PNP_MIN_RATIO = 0.5  # and at least this share of inliers
PNP_ERROR_PX = 4.0  # PnP inlier threshold on the working image


def absolute_pose(
    xy: Array, points: Array, camera: Camera, work_width: int, seed: int
) -> Array | None:
    """PnP from native pixels (n, 2) of world points (n, 3): cam_from_world (3, 4); None if it is
    not to be trusted.
    """
    if len(xy) < PNP_MIN_INLIERS:
        return None
    error_px = PNP_ERROR_PX * camera.width / work_width
    ransac = {"max_error": error_px, "confidence": 0.999, "random_seed": seed}
    made = pycolmap_camera(camera, (camera.width, camera.height))
    options = {"estimation_options": {"ransac": ransac}}
    found = import_pycolmap().estimate_and_refine_absolute_pose(xy, points, made, **options)
    least = max(PNP_MIN_INLIERS, PNP_MIN_RATIO * len(xy))
    if found is None or found["num_inliers"] < least:
        return None
    pose: Array = found["cam_from_world"].matrix()
    depth = points[found["inlier_mask"]] @ pose[2, :3] + pose[2, 3]
    return pose if np.isfinite(pose).all() and (depth > 0).all() else None
