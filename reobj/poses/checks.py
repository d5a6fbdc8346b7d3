"""Check supplied poses against the tracks: whether they are inverted, or in other axes.

It names a likely mistake and changes nothing; the poses' accuracy is not judged here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import CV_FROM_GL, Poses, invert_rigid, place_of, triangulate_rays
from reobj.types import Array, IntArray

MIN_TRACKS = 4  # fewer say nothing (chosen: three meet by chance in a path read backwards)
MAX_TRACKS = 200  # the longest are enough (chosen: time)
GOOD_DEG = 1.0  # residual of poses that are beyond doubt (chosen: 9 px at 500 px focal length)
MAX_RATIO = 0.3  # of the residuals, above which another reading is not clearly better (chosen)
AS_GOOD = 1.5  # times the best residual: readings that are named beside the best (chosen)


def check_poses(poses: Poses, tracks: Sequence[tuple[IntArray, Array]]) -> str | None:
    """Detect poses that are given in the wrong direction or with the wrong axes.

    Triangulates the box centres of each track with the poses as they are, inverted, and with OpenGL
    axes. The residual of a reading is the angle between a viewing ray and the direction to the
    triangulated point (180 deg behind the camera), the median over rays and tracks.

    Args:
        tracks: per track frame numbers (n,) and centres (n, 2), native pixels.
    Returns:
        a message that names the likely mistake if another reading explains the tracks clearly
        better, else None.
    """
    given = poses.cam_from_world
    readings = {
        "as they are": given,
        "world_from_cam given as cam_from_world, or the other way round": invert_rigid(given),
        "OpenGL axes (y up, z backward) given as OpenCV axes (y down, z forward), or reversed":
            CV_FROM_GL @ given,
        "inverted and with OpenGL axes": CV_FROM_GL @ invert_rigid(given),
        "quaternions with w first given as ones with w last": _quaternions_rolled(given, -1),
        "quaternions with w last given as ones with w first": _quaternions_rolled(given, 1),
    }  # fmt: skip
    views = [view for track in tracks if (view := _rays_of_track(poses, *track)) is not None]
    views = sorted(views, key=lambda v: -len(v[0]))[:MAX_TRACKS]
    if len(views) < MIN_TRACKS:
        return None
    residual_deg = {
        text: float(np.median([_residual_deg(reading[at], rays) for at, rays in views]))
        for text, reading in readings.items()
    }
    as_given = residual_deg.pop("as they are")
    best = min(residual_deg.values())
    if as_given < GOOD_DEG or best > min(MAX_RATIO * as_given, GOOD_DEG):
        return None  # what fits better, and not well, is as wrong: poses of other frames do so
    likely = " or ".join(text for text, value in residual_deg.items() if value <= AS_GOOD * best)
    return (
        f"the poses look like {likely}: {len(views)} tracks meet in 3D within {best:.1f} deg when "
        f"read that way, {as_given:.1f} deg as they are; check --pose-format and the file's "
        "convention"
    )


def _quaternions_rolled(cam_from_world: Array, places: int) -> Array:
    """Roll the numbers x, y, z, w of the rotations (F, 3, 3) of world_from_cam."""
    world_from_cam = invert_rigid(cam_from_world)
    known = np.isfinite(world_from_cam).all((1, 2))
    xyzw = Rotation.from_matrix(world_from_cam[known, :, :3]).as_quat()
    world_from_cam[known, :, :3] = Rotation.from_quat(np.roll(xyzw, places, 1)).as_matrix()
    return invert_rigid(world_from_cam)


MIN_VIEWS = 5  # frames of a track that is used (chosen)
MAX_VIEWS = 40  # of them, evenly spread (chosen: time)


def _rays_of_track(poses: Poses, frame: IntArray, xy: Array) -> tuple[IntArray, Array] | None:
    """Return the viewing rays of a track's centres in the frames with a pose, thinned.

    Returns:
        rows (n,) of the poses and unit rays (n, 3) in camera axes; None of too short a track.
    """
    place, known = place_of(poses, frame)
    use = np.flatnonzero(known & np.isfinite(xy).all(1))
    if len(use) < MIN_VIEWS:
        return None
    thin = np.linspace(0, len(use) - 1, min(len(use), MAX_VIEWS))
    use = use[np.unique(thin.round().astype(int))]
    ideal = poses.camera.undistort(xy[use])
    whole = np.isfinite(ideal).all(1)
    use, ideal = use[whole], ideal[whole]
    if len(use) < MIN_VIEWS:
        return None
    rays = np.column_stack([ideal, np.ones(len(use))]) @ np.linalg.inv(poses.camera.K).T  # (n, 3)
    return place[use], rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _residual_deg(cam_from_world: Array, rays_in_cam: Array) -> float:
    """Return the median angle of rays (n, 3) to their nearest point or, if less, to infinity."""
    ray, centre, point = triangulate_rays(cam_from_world, rays_in_cam)
    toward = np.stack([point - centre, np.broadcast_to(ray.mean(0), ray.shape)])  # (2, n, 3)
    cosine = (ray * toward).sum(2) / np.maximum(np.linalg.norm(toward, axis=2), 1e-12)  # (2, n)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1).min()))
