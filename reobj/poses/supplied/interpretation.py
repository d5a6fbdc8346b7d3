"""Choose between readings of supplied poses by images and tracks, and check their convention.

A reading is right if its relative poses explain the images (epipolar geometry of matched features)
or the boxes (one object per track). Two readings are compared by the likelihood ratio of their
residuals with unknown spread: n log(b / a) for n independent residuals of sizes a and b (Laplace's
distribution, spread at its maximum likelihood). Without a clear winner nothing is chosen.

`check_poses` names a likely mistake in direction or axes; the accuracy is not judged here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import (
    CV_FROM_GL,
    Camera,
    Poses,
    invert_rigid,
    place_of,
    triangulate_rays,
    undistort_boxes,
)
from reobj.poses.features import MAX_RATIO
from reobj.sources.video import shrunk
from reobj.types import Array, Image, IntArray, Tracks, rows_by


@dataclass(frozen=True, slots=True)
class PoseReading:
    """The poses of a video by one reading of a file: assignment to frames, quaternion order.

    Attributes:
        key: its name in `--set poses.frames_by=`. rule: the same in words.
        kind: format of the file. measured: why it was chosen; "" if it is the only one.
    """

    key: str
    rule: str
    poses: Poses
    kind: str = ""
    measured: str = ""

    @property
    def described_poses(self) -> Poses:
        """The poses, with the format of the file and the rule of the assignment to frames."""
        text = f"{self.kind}, frames by {self.rule}"
        text += f" ({self.measured})" if self.measured else ""
        return dataclasses.replace(self.poses, reading=text)


# Residuals (n,) of one reading and of another, on shared data or on the data of each
Compare = Callable[[Poses, Poses], tuple[Array, Array]]


def likeliest(
    readings: Sequence[PoseReading], compare: Compare, data: str, min_ratio: float = 1000.0
) -> list[PoseReading]:
    """Return the one reading that is likelier than every other, else all of them.

    Args:
        data: that give the residuals, for the message.
        min_ratio: of its likelihood over that of every other (chosen; lower: chance may decide).
    """
    least_px = 1e-3  # residuals are not smaller: rounding of poses in text files
    for one in readings:
        sizes = list[str]()
        is_likeliest = True
        for other in readings:
            if other is one:
                continue
            residuals, other_residuals = compare(one.poses, other.poses)
            count = min(len(residuals), len(other_residuals))
            if not count:
                is_likeliest = False
                break
            size = float(np.exp(np.log(residuals.clip(least_px)).mean()))
            other_size = float(np.exp(np.log(other_residuals.clip(least_px)).mean()))
            is_likeliest &= count * math.log(other_size / size) > math.log(min_ratio)
            sizes.append(f"{size:.2g} px, by {other.rule} {other_size:.2g} px")
        if is_likeliest and sizes:
            measured = f"it fits {data} within {'; '.join(sizes)}"
            return [dataclasses.replace(one, measured=measured)]
    return list(readings)


# ---- By images -----------------------------------------------------------------------------------


MIN_PAIRS = 3  # with fewer there is no decision (chosen; lower: one wrong pair decides)


def by_images(readings: Sequence[PoseReading], video: Any) -> list[PoseReading]:
    """Choose a reading by the images of a video, read once more; all if none clearly wins."""
    if len(readings) < 2 or not getattr(video, "has_images", True):
        return list(readings)
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, one in enumerate(readings):
        for j in range(i):
            pairs[j, i] = _pairs_that_differ(readings[j].poses, one.poses)
    widest = [_pairs_that_differ(one.poses, None) for one in readings]
    rows = {row for some in [*pairs.values(), *widest] for pair in some for row in pair}
    poses = readings[0].poses
    wanted = set(poses.frame[sorted(rows)].tolist())
    row_of = {frame: row for row, frame in enumerate(poses.frame.tolist())}
    sift = cv2.SIFT.create(1000)  # more take long
    features = {
        row_of[frame.index]: _features(sift, frame.image, poses.camera)
        for frame in video
        if frame.index in wanted
    }
    matches: dict[tuple[int, int], tuple[Array, Array]] = {}

    def residuals(poses: Poses, some: Sequence[tuple[int, int]]) -> Array:
        sizes = []
        for pair in some:
            if pair not in matches:
                matches[pair] = _match(*(features.get(row) for row in pair))
            if len(matches[pair][0]) >= 20:  # fewer have no stable median
                sizes.append(_epipolar_px(poses, pair, *matches[pair]))
        return np.array(sizes)

    def compare(one: Poses, other: Poses) -> tuple[Array, Array]:
        i, j = (next(k for k, r in enumerate(readings) if r.poses is p) for p in (one, other))
        common = pairs[min(i, j), max(i, j)]
        if len(common) >= MIN_PAIRS:
            return residuals(one, common), residuals(other, common)
        return residuals(one, widest[i]), residuals(other, widest[j])

    return likeliest(readings, compare, "the images")


def _pairs_that_differ(one: Poses, other: Poses | None) -> list[tuple[int, int]]:
    """Choose pairs of frames whose relative pose differs most between two readings.

    Args:
        other: None: the pairs of one reading with the widest motion.
    Returns:
        rows of the poses, at most 20 pairs; [] with fewer than MIN_PAIRS that have poses in both.
    """
    most = 20  # more take long
    rows = np.flatnonzero(one.known if other is None else one.known & other.known)
    steps = (1, 2, 5, 10)
    pairs = np.array([p for s in steps for p in zip(rows[:-s], rows[s:], strict=True)], np.int64)
    if len(pairs) < MIN_PAIRS:
        return []
    turn, shift = _relative(one, pairs)
    turn_change = turn
    direction_deg = np.zeros(len(pairs))
    max_turn_deg = 30  # half of a usual field of view
    is_near = _angle_deg(turn) < max_turn_deg
    if other is not None:
        other_turn, other_shift = _relative(other, pairs)
        turn_change = np.swapaxes(turn, 1, 2) @ other_turn
        norm = np.linalg.norm(shift, axis=1) * np.linalg.norm(other_shift, axis=1)
        cosine = (shift * other_shift).sum(1) / np.maximum(norm, 1e-12)
        direction_deg = np.where(norm > 0, np.degrees(np.arccos(cosine.clip(-1, 1))), 0.0)
        is_near |= _angle_deg(other_turn) < max_turn_deg  # one of them is right
    difference_deg = _angle_deg(turn_change) + 0.1 * direction_deg  # directions count less
    score = np.where(is_near, difference_deg.clip(max=8), -1.0)  # narrow pairs match better
    chosen: list[tuple[int, int]] = []
    apart = len(rows) / (2 * most)  # so that they are spread over the video
    for k in np.argsort(-score, kind="stable").tolist():
        i, j = pairs[k].tolist()
        rank = np.searchsorted(rows, i)
        if score[k] <= 0 or len(chosen) == most:
            break
        if all(abs(rank - np.searchsorted(rows, c)) >= apart for c, _ in chosen):
            chosen.append((i, j))
    return chosen


def _relative(poses: Poses, pairs: IntArray) -> tuple[Array, Array]:
    """Return rotation (n, 3, 3) and translation (n, 3) of second_from_first."""
    world_from_first = invert_rigid(poses.cam_from_world[pairs[:, 0]])
    second = poses.cam_from_world[pairs[:, 1]]
    turn = second[:, :, :3] @ world_from_first[:, :, :3]
    shift = np.einsum("nij,nj->ni", second[:, :, :3], world_from_first[:, :, 3]) + second[:, :, 3]
    return turn, shift


def _angle_deg(turn: Array) -> Array:
    trace = np.trace(turn, axis1=1, axis2=2)
    return np.asarray(np.degrees(np.arccos(((trace - 1) / 2).clip(-1, 1))))


def _features(sift: Any, image: Image, camera: Camera) -> tuple[Array, Any]:
    """Find features: viewing rays (n, 3) with z = 1 in the camera (NaN: none), and descriptors."""
    small = shrunk(image, 640)  # as the reconstruction
    points, descriptors = sift.detectAndCompute(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), None)
    if descriptors is None:
        return np.empty((0, 3)), np.empty((0, 128), np.float32)
    scale = np.array([camera.width, camera.height]) / small.shape[1::-1]
    xy = (np.array([point.pt for point in points]) + 0.5) * scale  # COLMAP's pixels
    ideal = np.column_stack([camera.undistort(xy), np.ones(len(xy))])
    return ideal @ np.linalg.inv(camera.K).T, descriptors


def _match(first: Any, second: Any) -> tuple[Array, Array]:
    """Match two images' features; return the rays (n, 3) of both."""
    if first is None or second is None or min(len(first[1]), len(second[1])) < 2:
        return np.empty((0, 3)), np.empty((0, 3))
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first[1], second[1], k=2)
    good = [a for a, b in nearest if a.distance < MAX_RATIO * b.distance]
    rays = first[0][[m.queryIdx for m in good]], second[0][[m.trainIdx for m in good]]
    finite = np.isfinite(np.column_stack(rays)).all(1)
    return rays[0][finite], rays[1][finite]


def _epipolar_px(poses: Poses, pair: tuple[int, int], first: Array, second: Array) -> float:
    """Return the median Sampson error of matched rays (n, 3), pixels of the native frames.

    Without a translation it is the distance to the rotated point.
    Ref: Hartley & Zisserman 2004, eq. 11.9.
    """
    turn, shift = (values[0] for values in _relative(poses, np.array([pair])))
    focal = float(poses.camera.K[0, 0])
    if np.linalg.norm(shift) < 1e-12:
        moved = first @ turn.T
        return focal * float(np.median(np.linalg.norm((moved / moved[:, 2:] - second), axis=1)))
    x, y, z = shift / np.linalg.norm(shift)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    second_line = first @ essential.T  # (n, 3)
    first_line = second @ essential  # (n, 3)
    slope = np.sqrt((second_line[:, :2] ** 2).sum(1) + (first_line[:, :2] ** 2).sum(1))
    distance = np.abs((second * second_line).sum(1)) / np.maximum(slope, 1e-12)
    return focal * float(np.median(distance))


# ---- By tracks -----------------------------------------------------------------------------------


def by_tracks(readings: Sequence[PoseReading], tracks: Tracks) -> list[PoseReading]:
    """Choose a reading by boxes: in the right one each tracklet shows one object.

    Objects are fitted to the 30 longest tracklets of at least 8 boxes. Five consecutive boxes count
    as one (chosen): a detector repeats its errors.
    """
    groups = sorted(rows_by(tracks.tracklet_id), key=len, reverse=True)[:30]
    least = 8

    def compare(one: Poses, other: Poses) -> tuple[Array, Array]:
        sizes: tuple[list[float], list[float]] = ([], [])
        for rows in groups:
            (a, known), (b, other_known) = (place_of(p, tracks.frame[rows]) for p in (one, other))
            both = known & other_known
            uses = [both, both] if both.sum() >= least else [known, other_known]
            if min(use.sum() for use in uses) < least:
                continue
            pair = [
                _object_px(poses, pose_rows[use], tracks.xyxy[rows[use]])
                for poses, pose_rows, use in zip((one, other), (a, b), uses, strict=True)
            ]
            count = min(int(use.sum()) for use in uses) // 5
            for size, values in zip(pair, sizes, strict=True):
                values += [size] * count
        return np.array(sizes[0]), np.array(sizes[1])

    return likeliest(readings, compare, "the boxes") if len(readings) > 1 else list(readings)


def _object_px(poses: Poses, rows: IntArray, xyxy: Array) -> float:
    """Return the median distance of boxes (n, 4) from those of the object fitted to them, px."""
    camera = poses.camera
    size = np.array([camera.width, camera.height] * 2)
    boxes = undistort_boxes(xyxy, camera)
    img_from_world = camera.K @ poses.cam_from_world[rows]
    fits = quadrics.fit_objects(boxes[:, None], img_from_world, (camera.width, camera.height))
    if fits.status[0] == "rejected":
        return float(size.max())
    projected = quadrics.solid_boxes(fits.ellipsoids, list(fits.support), img_from_world)[:, 0]
    inside = (xyxy > 1) & (xyxy < size - 1) & np.isfinite(projected) & np.isfinite(boxes)
    if not inside.any():
        return float(size.max())
    return float(np.median(np.abs(projected - boxes)[inside]))


# ---- Direction and axes --------------------------------------------------------------------------


def check_poses(
    poses: Poses,
    tracks: Sequence[tuple[IntArray, Array]],
    min_tracks: int = 4,
    good_deg: float = 1.0,
    max_ratio: float = 0.3,
) -> str | None:
    """Detect poses that are given in the wrong direction or with the wrong axes.

    Triangulates the box centres of each track with the poses as they are, inverted, with OpenGL
    axes, and with quaternions in another order. The residual is the angle between a viewing ray and
    the direction to the triangulated point (180 deg behind the camera), the median over rays and
    tracks.

    Args:
        tracks: per track frame numbers (n,) and centres (n, 2), native pixels.
        min_tracks: with fewer nothing is detected (chosen: three triangulate by chance in a
            trajectory read backwards).
        good_deg: residual of poses that are certainly right (chosen: 9 px at 500 px focal length).
        max_ratio: residual of a clearly better convention, over that of the given one (chosen;
            higher: right poses of inaccurate tracks are refused).
    Returns:
        a message that names the likely mistake if another convention explains the tracks clearly
        better, else None.
    """
    given = poses.cam_from_world
    conventions = {
        "as they are": given,
        "world_from_cam given as cam_from_world, or the other way round": invert_rigid(given),
        "OpenGL axes (y up, z backward) given as OpenCV axes (y down, z forward), or reversed":
            CV_FROM_GL @ given,
        "inverted and with OpenGL axes": CV_FROM_GL @ invert_rigid(given),
        "quaternions with w first given as ones with w last": _quaternions_rolled(given, -1),
        "quaternions with w last given as ones with w first": _quaternions_rolled(given, 1),
    }  # fmt: skip
    views = [view for track in tracks if (view := _rays_of_track(poses, *track)) is not None]
    views = sorted(views, key=lambda v: -len(v[0]))[:200]  # the longest: all take long
    if len(views) < min_tracks:
        return None
    residual_deg = {
        text: float(np.median([_residual_deg(converted[rows], rays) for rows, rays in views]))
        for text, converted in conventions.items()
    }
    as_given = residual_deg.pop("as they are")
    best = min(residual_deg.values())
    if as_given < good_deg or best > min(max_ratio * as_given, good_deg):
        return None  # a better but still bad fit is wrong too, as with poses of other frames
    likely = " or ".join(text for text, value in residual_deg.items() if value <= 1.5 * best)
    return (
        f"the poses look like {likely}: {len(views)} tracks triangulate within {best:.1f} deg when "
        f"read that way, {as_given:.1f} deg as they are; check --pose-format and the file's "
        "convention"
    )


def _quaternions_rolled(cam_from_world: Array, count: int) -> Array:
    """Roll the components x, y, z, w of the rotations of world_from_cam (F, 3, 4)."""
    world_from_cam = invert_rigid(cam_from_world)
    known = np.isfinite(world_from_cam).all((1, 2))
    xyzw = Rotation.from_matrix(world_from_cam[known, :, :3]).as_quat()
    world_from_cam[known, :, :3] = Rotation.from_quat(np.roll(xyzw, count, 1)).as_matrix()
    return invert_rigid(world_from_cam)


def _rays_of_track(poses: Poses, frame: IntArray, xy: Array) -> tuple[IntArray, Array] | None:
    """Return the viewing rays of a track's centres in the frames with a pose, thinned.

    Returns:
        rows (n,) of the poses and unit rays (n, 3) in camera axes, n from 5 to 40; None if the
        track is too short.
    """
    least = 5
    rows, known = place_of(poses, frame)
    use = np.flatnonzero(known & np.isfinite(xy).all(1))
    if len(use) < least:
        return None
    spread = np.linspace(0, len(use) - 1, min(len(use), 40))
    use = use[np.unique(spread.round().astype(int))]
    ideal = poses.camera.undistort(xy[use])
    finite = np.isfinite(ideal).all(1)
    use = use[finite]
    ideal = ideal[finite]
    if len(use) < least:
        return None
    rays = np.column_stack([ideal, np.ones(len(use))]) @ np.linalg.inv(poses.camera.K).T  # (n, 3)
    return rows[use], rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _residual_deg(cam_from_world: Array, rays_in_cam: Array) -> float:
    """Return the median angle of rays (n, 3) to their nearest point or, if less, to infinity."""
    ray, centre, point = triangulate_rays(cam_from_world, rays_in_cam)
    toward = np.stack([point - centre, np.broadcast_to(ray.mean(0), ray.shape)])  # (2, n, 3)
    cosine = (ray * toward).sum(2) / np.maximum(np.linalg.norm(toward, axis=2), 1e-12)  # (2, n)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1).min()))
