"""Checks of poses against the tracks: direction and axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reobj.cameras import CV_FROM_GL, Poses, invert_rigid, place_of, triangulate_rays
from reobj.types import Array, IntArray

CHECK_TRACKS = 3  # direction check: tracks needed
CHECK_MOST_TRACKS = 200  # direction check: tracks used at most
CHECK_ANGLE_DEG = 1.0  # direction check: good when the tracks meet within this
CHECK_RATIO = 0.3  # direction check: another reading must be better by this factor


def check_poses(poses: Poses, tracks: Sequence[tuple[IntArray, Array]]) -> str | None:
    """Find out whether poses are given in the wrong direction or with the wrong axes.

    Triangulates the box centres of tracks with the poses as they are, inverted, and with OpenGL
    axes; the residual is the angle between a ray and the direction to the point (180 deg when it is
    behind the camera).

    Args:
        tracks: per track frame numbers (n,) and centres (n, 2), native pixels.
    Returns:
        a message that names the likely mistake if another reading explains the tracks clearly
        better, else None.
    """
    usual = poses.cam_from_world
    readings = {
        "as they are": usual,
        "world_from_cam given as cam_from_world, or the other way round": invert_rigid(usual),
        "OpenGL axes (y up, z backward) given as OpenCV axes (y down, z forward), or reversed":
            CV_FROM_GL @ usual,
        "inverted and with OpenGL axes": CV_FROM_GL @ invert_rigid(usual),
    }  # fmt: skip
    views = [view for track in tracks if (view := _track_views(poses, *track)) is not None]
    views = sorted(views, key=lambda v: -len(v[0]))[:CHECK_MOST_TRACKS]
    if len(views) < CHECK_TRACKS:
        return None
    angle = {
        text: float(np.median([_ray_error_deg(reading[at], rays) for at, rays in views]))
        for text, reading in readings.items()
    }
    asis = angle.pop("as they are")
    best = min(angle.values())
    if asis < CHECK_ANGLE_DEG or best > CHECK_RATIO * asis:
        return None
    likely = " or ".join(text for text, value in angle.items() if value <= 1.5 * best)
    return (
        f"the poses look like {likely}: {len(views)} tracks meet in 3D within {best:.1f} deg when "
        f"read that way, {asis:.1f} deg as they are; check --pose-format and the file's convention"
    )


CHECK_VIEWS = 5  # direction check: frames of a track needed
CHECK_MOST_VIEWS = 40  # direction check: frames of a track used at most


def _track_views(poses: Poses, frame: IntArray, xy: Array) -> tuple[IntArray, Array] | None:
    """Rows of a track's frames with a pose, thinned, and unit rays (n, 3); None if too few."""
    place, known = place_of(poses, frame)
    use = np.flatnonzero(known & np.isfinite(xy).all(1))
    if len(use) < CHECK_VIEWS:
        return None
    thin = np.linspace(0, len(use) - 1, min(len(use), CHECK_MOST_VIEWS))
    use = use[np.unique(thin.round().astype(int))]
    ideal = poses.camera.undistort(xy[use])
    rays = np.column_stack([ideal, np.ones(len(use))]) @ np.linalg.inv(poses.camera.K).T  # (n, 3)
    return place[use], rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _ray_error_deg(cam_from_world: Array, rays_in_cam: Array) -> float:
    """Median angle of rays (n, 3) of n cameras to their nearest point or, if better, infinity."""
    ray, centre, point = triangulate_rays(cam_from_world, rays_in_cam)
    toward = np.stack([point - centre, np.broadcast_to(ray.mean(0), ray.shape)])  # (2, n, 3)
    cosine = (ray * toward).sum(2) / np.maximum(np.linalg.norm(toward, axis=2), 1e-12)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1).min()))
