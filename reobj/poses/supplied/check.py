"""Check supplied poses against matched features or boxes; name the convention that would fit.

Poses are right if their relative poses explain the images (epipolar geometry of matched features)
or, without images, the boxes (one point per track). Nothing is converted: poses that fit less well
than another convention, or not at all, are refused. The accuracy is not judged here.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import Poses, invert_rigid, place_of, triangulate_rays
from reobj.types import Array, IntArray, ReobjError, Tracks, rows_by


@dataclass(frozen=True, slots=True)
class Supplied:
    """Poses of a file, before they are checked; axes: (3, 3) OpenCV's from those of the file."""

    poses: Poses
    axes: Array = field(default_factory=lambda: np.eye(3))


# ---- Conventions ---------------------------------------------------------------------------------

WORDS = (("right", "left"), ("down", "up"), ("forward", "backward"))  # + and - of OpenCV's axes
KNOWN = {
    "x right, y down, z forward": "OpenCV",
    "x right, y up, z backward": "OpenGL",
    "x right, y up, z forward": "Unity",
    "x left, y up, z forward": "images turned by 180 deg about the viewing axis",
    "x forward, y left, z up": "ROS",
    "x down, y right, z backward": "LLFF",
}


def _axes_text(cv_from_file: Array) -> str:
    """Describe camera axes (3, 3) by their directions."""
    axis = np.abs(cv_from_file).argmax(0)  # (3,) of OpenCV, of each axis of the file
    words = [WORDS[a][int(cv_from_file[a, k] < 0)] for k, a in enumerate(axis.tolist())]
    text = ", ".join(f"{name} {word}" for name, word in zip("xyz", words, strict=True))
    hand = "" if np.linalg.det(cv_from_file) > 0 else "left-handed "
    return f"{hand}camera axes {text}" + (f" ({KNOWN[text]})" if text in KNOWN else "")


def conventions(given: Supplied) -> Iterator[tuple[str, Array]]:
    """List poses (F, 3, 4) that the file may have meant: axes, direction, quaternions, order.

    Left-handed axes belong to a left-handed world, which is mirrored at its origin.
    """
    poses = given.poses.cam_from_world
    inverse = invert_rigid(poses)
    signs = itertools.product((1.0, -1.0), repeat=3)
    for order, sign in itertools.product(itertools.permutations(range(3)), signs):
        cv_from_read = np.diag(sign)[:, order]
        mirror = np.append(np.full(3, np.linalg.det(cv_from_read)), 1.0)  # columns of [R | t]
        if not (cv_from_read == np.eye(3)).all():
            yield _axes_text(cv_from_read @ given.axes), cv_from_read @ poses * mirror
        text = "" if (cv_from_read == given.axes).all() else f" and {_axes_text(cv_from_read)}"
        name = "the inverse direction (cam_from_world given as world_from_cam, or reversed)"
        yield name + text.replace(" (OpenCV)", ""), cv_from_read @ inverse * mirror
    for name, roll in (("first given as w last", -1), ("last given as w first", 1)):
        yield f"quaternions with w {name}", _rolled(poses, roll)
    (R, c), (Q, t) = (np.split(some, [3], 2) for some in (inverse, poses))
    yield "inverse rotations beside camera centres", np.dstack([R, -R @ c])
    yield "camera centres beside rotations of cam_from_world", np.dstack([Q, -Q @ t])
    name = "translations of cam_from_world beside rotations of world_from_cam"
    yield name, np.dstack([Q, c])
    # other orders; a frame that has no pose gets the one before
    at = np.arange(len(poses))
    known = np.isfinite(poses).all((1, 2))
    filled = np.maximum.accumulate(np.where(known, at, known.argmax()))  # (F,)
    rows = {"the order reversed": at[::-1]}
    for first in (0, 1):
        text = f"the order of numbers from {first} as text (1, 10, 2)"
        rows[text] = np.argsort(np.argsort([str(n + first) for n in at]))
    for k in range(1, 11):
        for step, word in ((k, "earlier"), (-k, "later")):
            rows[f"the order shifted (each pose is that of {k} frames {word})"] = at + step
    for k in (2, 3, 4, 5):
        rows[f"the order of {k} poses for each frame (frame n has pose {k}n)"] = k * at
        rows[f"the order of one pose for {k} frames (frame n has pose n/{k})"] = at // k
    for text, row in rows.items():
        yield text, poses[filled[row.clip(0, len(at) - 1)]]


def _rolled(cam_from_world: Array, count: int) -> Array:
    """Roll the components x, y, z, w of the rotations of world_from_cam (F, 3, 4)."""
    world_from_cam = invert_rigid(cam_from_world)
    known = np.isfinite(world_from_cam).all((1, 2))
    xyzw = Rotation.from_matrix(world_from_cam[known, :, :3]).as_quat()
    world_from_cam[known, :, :3] = Rotation.from_quat(np.roll(xyzw, count, 1)).as_matrix()
    return invert_rigid(world_from_cam)


def _refuse(given: Supplied, likely: Sequence[str], measured: str) -> None:
    """Refuse the poses; likely: conventions that fit, [] if none does."""
    text = (f"the poses fit in no convention ({measured}): are they the poses of this video, in "
            "this order, with this camera (--poses, --camera)?")  # fmt: skip
    if likely:
        text = (
            f"the poses look like ones with {' or '.join(likely[:3])}; they were read with "
            f"{_axes_text(given.axes)} ({measured}): convert them, or name their format with "
            "--pose-format"
        )
    raise ReobjError(text)


# ---- By images -----------------------------------------------------------------------------------

EXPLAINED = 0.7  # of the matches; measured, right poses: .72 and more in 11 recordings
BETTER = 0.15  # more than as given; right poses: all other conventions .17 and more below
UNEXPLAINED = 0.3  # right poses with a focal length that is 15 % wrong: .24 and more


def check_matches(
    given: Supplied, confirmed: bool, rows: IntArray, match_rows: IntArray, rays: Array
) -> float:
    """Refuse poses that contradict verified matches of features.

    Args:
        confirmed: the boxes agree with the poses; then matches that fit in no convention are wrong.
        rows: (K,) poses of the keyframes. match_rows: (M, 2) keyframes of each match.
        rays: (M, 2, 2) of it in both cameras, z = 1.
    Returns:
        the explained fraction of the matches; NaN where there are too few.
    """
    use = np.flatnonzero(np.isfinite(rays).all((1, 2)))
    if len(use) < 100:  # the matches of about two pairs of images
        return np.nan
    use = use[:: len(use) // 5000 + 1]
    views = rows[match_rows[use]]  # (m, 2)
    found = _explained(given.poses.cam_from_world, views, rays[use])
    shares = {name: _explained(poses, views, rays[use]) for name, poses in conventions(given)}
    best = max(shares.values())
    measured = f"{100 * found:.0f} % of the matched features agree"
    if best > max(EXPLAINED, found + BETTER):
        likely = [name for name, share in shares.items() if share > best - BETTER / 3]
        _refuse(given, likely, f"{measured}, then {100 * best:.0f} %")
    if found < UNEXPLAINED and not confirmed:
        _refuse(given, [], measured)
    return found


def _explained(cam_from_world: Array, views: IntArray, rays: Array) -> float:
    """Return the fraction of matches that lie near their epipolar lines, in front of both cameras.

    Sampson error up to .006 (4 px at a focal length of 640 px); points with a parallax below 1 deg
    have no depth.
    Ref: Hartley & Zisserman 2004, eq. 11.9.
    """
    one, other = cam_from_world[views[:, 0]], cam_from_world[views[:, 1]]  # (m, 3, 4)
    turn = other[:, :, :3] @ np.swapaxes(one[:, :, :3], 1, 2)  # other_from_one
    shift = other[:, :, 3] - (turn @ one[:, :, 3:])[..., 0]
    shift = shift / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-12)
    x, y = np.moveaxis(np.insert(rays, 2, 1, 2), 1, 0)  # (m, 3) each
    x = (turn @ x[..., None])[..., 0]
    line = np.cross(shift, x)  # E x = [t] R x
    back = np.einsum("mij,mi->mj", turn, np.cross(y, shift))  # E' y
    slope = np.linalg.norm(np.hstack([line[:, :2], back[:, :2]]), axis=1)
    distance = np.abs((y * line).sum(1)) / np.maximum(slope, 1e-12)
    # depth_y y = depth_x x + t
    xx, yy, xy, tx, ty = (
        (a * b).sum(1) for a, b in ((x, x), (y, y), (x, y), (shift, x), (shift, y))
    )
    in_front = (xy * ty > yy * tx) & (xx * ty > xy * tx)
    far = (xx * yy - xy**2 < np.sin(np.radians(1)) ** 2 * xx * yy) & (xy > 0)
    return float(((distance < 0.006) & (in_front | far)).mean())


# ---- By boxes ------------------------------------------------------------------------------------

GOOD_DEG = 1.0  # residual of poses that are certainly right: 9 px at 500 px focal length
MAX_RATIO = 0.3  # of residuals of a clearly better convention; higher: refuses right poses
WRONG_DEG = 6.0  # of poses that are certainly wrong; measured, right ones: up to 2.0
MIN_TRACKS = 4  # three triangulate by chance in a trajectory read backwards


def check_boxes(given: Supplied, tracks: Tracks, refuse: bool = True) -> bool:
    """Refuse poses that contradict the boxes of tracks.

    Triangulates the box centres of each track. The residual is the angle between a viewing ray and
    the direction to the triangulated point (180 deg behind the camera), the median over rays and
    tracks. A track is used while consecutive boxes overlap by half: then they show one object.

    Returns:
        True if the boxes agree with the poses; False: they do not, or are too few.
    """
    runs = (_overlapping(tracks, rows) for rows in rows_by(tracks.tracklet_id))
    found = [view for run in runs if len((view := _rays(given.poses, tracks[run]))[0]) >= 5]
    views = sorted(found, key=lambda view: -len(view[0]))[:60]  # the longest: all take long
    if len(views) < MIN_TRACKS:
        return False
    as_given = _residual_deg(given.poses.cam_from_world, views)
    if as_given < GOOD_DEG or not refuse:
        return as_given < GOOD_DEG
    measured = f"{len(views)} tracks triangulate within {as_given:.1f} deg"
    residuals = {name: _residual_deg(poses, views) for name, poses in conventions(given)}
    best = min(residuals.values())
    if best <= min(MAX_RATIO * as_given, 2 * GOOD_DEG):
        likely = [n for n in residuals if residuals[n] <= 1.5 * best]
        likely.sort(key=residuals.__getitem__)
        _refuse(given, likely, f"{measured}, then {best:.1f} deg")
    if as_given > WRONG_DEG:
        _refuse(given, [], measured)
    return False


def _overlapping(tracks: Tracks, rows: IntArray) -> IntArray:
    """Return the longest run of a track's rows (n,) whose edges move by at most 1/3 side."""
    xyxy = tracks.xyxy[rows]
    side = np.tile(xyxy[:, 2:] - xyxy[:, :2], 2)  # (n, 4)
    moved = np.abs(np.diff(xyxy, axis=0)) > side[1:] / 3
    return max(np.split(rows, np.flatnonzero(moved.any(1)) + 1), key=len)


def _rays(poses: Poses, track: Tracks) -> tuple[IntArray, Array]:
    """Return the viewing rays of a track's centres in the frames with a pose, thinned.

    Returns:
        rows (n,) of the poses and unit rays (n, 3) in camera axes, n up to 40.
    """
    rows, known = place_of(poses, track.frame)
    xy = poses.camera.undistort((track.xyxy[:, :2] + track.xyxy[:, 2:]) / 2)  # (n, 2)
    use = np.flatnonzero(known & np.isfinite(xy).all(1))
    use = use[np.unique(np.linspace(0, len(use) - 1, 40).round().astype(int))] if len(use) else use
    rays = np.insert(xy[use], 2, 1, 1) @ np.linalg.inv(poses.camera.K).T  # (n, 3)
    return rows[use], rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _residual_deg(cam_from_world: Array, views: Sequence[tuple[IntArray, Array]]) -> float:
    """Return the median over tracks of the median angle of rays to their point, or to infinity."""
    medians = []
    for rows, rays in views:
        ray, centre, point = triangulate_rays(cam_from_world[rows], rays)
        toward = np.stack([point - centre, np.broadcast_to(ray.mean(0), ray.shape)])  # (2, n, 3)
        cosine = (ray * toward).sum(2) / np.maximum(np.linalg.norm(toward, axis=2), 1e-12)
        medians.append(np.median(np.arccos(cosine.clip(-1, 1)), axis=1).min())  # (2, n)
    return float(np.degrees(np.median(medians)))


# ---- Frozen poses --------------------------------------------------------------------------------


def without_frozen(poses: Poses, tracks: Tracks) -> Poses:
    """Remove repeats of a pose while boxes move: a program that lost track repeats the last pose.

    Runs of three and more frames; without boxes in them, all are removed.
    """
    steps = np.abs(np.diff(poses.cam_from_world, axis=0)).max((1, 2))  # NaN where one has no pose
    frozen = np.zeros(len(poses.frame), bool)
    for run in np.split(np.arange(len(frozen)), np.flatnonzero(~(steps < 1e-9)) + 1):
        frozen[run[1:]] = len(run) >= 3 and _boxes_move(tracks, *poses.frame[run[[0, -1]]])
    if not frozen.any():
        return poses
    text = f"{frozen.sum()} poses repeat the one before while the view changes: no poses"
    return dataclasses.replace(
        poses, cam_from_world=np.where(frozen[:, None, None], np.nan, poses.cam_from_world),
        status=np.where(frozen, "none", poses.status), messages=(*poses.messages, text),
    )  # fmt: skip


def _boxes_move(tracks: Tracks, first: int, last: int) -> bool:
    """Test whether the boxes of tracks move by more than 3 px between two frames."""
    start, end = (tracks[tracks.frame == frame] for frame in (first, last))
    _, i, j = np.intersect1d(start.tracklet_id, end.tracklet_id, True, True)
    moves = (start.xyxy[i] - end.xyxy[j]).reshape(-1, 2, 2).mean(1)  # of the centres
    return not len(moves) or bool(np.median(np.linalg.norm(moves, axis=1)) > 3)
