"""Which of several readings of a file of poses is right: images and tracks decide, or nobody.

A reading is right where its relative poses explain the images (epipolar geometry of matched
features) or the boxes (one solid a track). Two readings are compared by the likelihood ratio of
their residuals with unknown spread: n log(b / a) of n independent residuals of sizes a and b
(Laplace's distribution, spread at its maximum likelihood). What is between them is not decided.
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
from reobj.sources.video import shrunk
from reobj.types import Array, Image, IntArray, Tracks, rows_by

DECIDED = math.log(1000)  # log likelihood ratio from which a reading counts as right (chosen)


@dataclass(frozen=True, slots=True)
class PoseReading:
    """Hold the poses of a video as one reading of a file gives them.

    Attributes:
        key: what `--set poses.frames_by=` calls it. rule: the same in words.
        kind: what the file was taken for. measured: what decided for it; "" if it is the only one.
    """

    key: str
    rule: str
    poses: Poses
    kind: str = ""
    measured: str = ""

    @property
    def described_poses(self) -> Poses:
        """The poses, with what the file was taken for and how its frames were found."""
        text = f"{self.kind}, frames by {self.rule}"
        text += f" ({self.measured})" if self.measured else ""
        return dataclasses.replace(self.poses, reading=text)


# Residuals of one reading and another: (n,) each, of what both explain, or of what each does
Compare = Callable[[Poses, Poses], tuple[Array, Array]]


def likeliest(found: Sequence[PoseReading], compare: Compare, of: str) -> list[PoseReading]:
    """Return the one reading that is likelier than every other by DECIDED, else all of them.

    Args:
        of: what the residuals are of, for the message.
    """
    for one in found:
        sizes, won = list[str](), True
        for other in found:
            if other is one:
                continue
            a, b = compare(one.poses, other.poses)
            count = min(len(a), len(b))
            if not count:
                won = False
                break
            mine, theirs = float(np.exp(np.log(a).mean())), float(np.exp(np.log(b).mean()))
            won = won and count * math.log(theirs / mine) > DECIDED
            sizes.append(f"{mine:.2g} px, by {other.rule} {theirs:.2g} px")
        if won and sizes:
            measured = f"it fits {of} within {'; '.join(sizes)}"
            return [dataclasses.replace(one, measured=measured)]
    return list(found)


LEAST_PX = 1e-3  # residuals below are as good as none: rounding of poses in text files (chosen)


# ---- By images -----------------------------------------------------------------------------------


SIZE_PX = 640  # longer side of the images in which features are matched (as the reconstruction)
FEATURES = 1000  # SIFT features an image (chosen: time)
RATIO = 0.8  # of the distances to the nearest and the second descriptor (Lowe, IJCV 2004)
MIN_MATCHES = 20  # of a pair that says something (chosen)
PAIRS = 20  # pairs of images that two readings are compared by (chosen: time)
MIN_PAIRS = 3  # fewer say nothing (chosen)
STEPS = (1, 2, 5, 10)  # frames with a pose between the two of a pair (chosen)
MAX_TURN_DEG = 30.0  # between the two of a pair: half of a usual field of view (chosen)
ENOUGH_DEG = 8.0  # of difference: more says no more, and narrow pairs match better (chosen)
TURN_PER_DEG = 0.1  # a translation's direction counts so much less than the rotation (chosen)


def by_images(found: Sequence[PoseReading], video: Any) -> list[PoseReading]:
    """Decide by the images of a video, read once more; all readings where they say too little."""
    if len(found) < 2 or not getattr(video, "has_images", True):
        return list(found)
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, one in enumerate(found):
        for j in range(i):
            pairs[j, i] = _pairs_that_differ(found[j].poses, one.poses)
    own = [_pairs_that_differ(one.poses, None) for one in found]
    rows = {row for some in [*pairs.values(), *own] for pair in some for row in pair}
    wanted = set(found[0].poses.frame[sorted(rows)].tolist())
    row_of = {frame: row for row, frame in enumerate(found[0].poses.frame.tolist())}
    sift = cv2.SIFT.create(FEATURES)
    features = {
        row_of[frame.index]: _features(sift, frame.image, found[0].poses.camera)
        for frame in video
        if frame.index in wanted
    }
    matches: dict[tuple[int, int], tuple[Array, Array]] = {}

    def residuals(poses: Poses, some: Sequence[tuple[int, int]]) -> Array:
        sizes = []
        for pair in some:
            if pair not in matches:
                matches[pair] = _match(*(features.get(row) for row in pair))
            if len(matches[pair][0]) >= MIN_MATCHES:
                sizes.append(_epipolar_px(poses, pair, *matches[pair]))
        return np.array(sizes).clip(LEAST_PX)

    def compare(one: Poses, other: Poses) -> tuple[Array, Array]:
        i, j = (next(k for k, r in enumerate(found) if r.poses is p) for p in (one, other))
        common = pairs[min(i, j), max(i, j)]
        if len(common) >= MIN_PAIRS:
            return residuals(one, common), residuals(other, common)
        return residuals(one, own[i]), residuals(other, own[j])

    return likeliest(found, compare, "the images")


def _pairs_that_differ(one: Poses, other: Poses | None) -> list[tuple[int, int]]:
    """Choose pairs of frames whose relative pose differs most between two readings.

    Args:
        other: None: pairs of one reading, those with the widest motion.
    Returns:
        rows of the poses; [] with fewer than MIN_PAIRS pairs that have poses in both.
    """
    rows = np.flatnonzero(one.known if other is None else one.known & other.known)
    pairs = np.array([p for s in STEPS for p in zip(rows[:-s], rows[s:], strict=True)], np.int64)
    if len(pairs) < MIN_PAIRS:
        return []
    turn, way = _relative(one, pairs)
    change, slide = turn, np.zeros(len(pairs))
    near = _angle_deg(turn) < MAX_TURN_DEG
    if other is not None:
        other_turn, other_way = _relative(other, pairs)
        change = np.swapaxes(turn, 1, 2) @ other_turn
        norm = np.linalg.norm(way, axis=1) * np.linalg.norm(other_way, axis=1)
        cosine = (way * other_way).sum(1) / np.maximum(norm, 1e-12)
        slide = np.where(norm > 0, np.degrees(np.arccos(cosine.clip(-1, 1))), 0.0)
        near |= _angle_deg(other_turn) < MAX_TURN_DEG  # one of them is right
    differ = (_angle_deg(change) + TURN_PER_DEG * slide).clip(max=ENOUGH_DEG)
    score = np.where(near, differ, -1.0)
    chosen: list[tuple[int, int]] = []
    apart = len(rows) / (2 * PAIRS)  # so that they are spread over the video
    for k in np.argsort(-score, kind="stable").tolist():
        i, j = pairs[k].tolist()
        place = np.searchsorted(rows, i)
        if score[k] <= 0 or len(chosen) == PAIRS:
            break
        if all(abs(place - np.searchsorted(rows, c)) >= apart for c, _ in chosen):
            chosen.append((i, j))
    return chosen


def _relative(poses: Poses, pairs: IntArray) -> tuple[Array, Array]:
    """Return rotation (n, 3, 3) and translation (n, 3) of second_from_first."""
    first, second = (poses.cam_from_world[pairs[:, k]] for k in (0, 1))
    back = invert_rigid(first)
    turn = second[:, :, :3] @ back[:, :, :3]
    way = np.einsum("nij,nj->ni", second[:, :, :3], back[:, :, 3]) + second[:, :, 3]
    return turn, way


def _angle_deg(turn: Array) -> Array:
    trace = np.trace(turn, axis1=1, axis2=2)
    return np.asarray(np.degrees(np.arccos(((trace - 1) / 2).clip(-1, 1))))


def _features(sift: Any, image: Image, camera: Camera) -> tuple[Array, Any]:
    """Find features: viewing rays (n, 3) with z = 1 in the camera, NaN: none; descriptors."""
    small = shrunk(image, SIZE_PX)
    points, descriptors = sift.detectAndCompute(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), None)
    if descriptors is None:
        return np.empty((0, 3)), np.empty((0, 128), np.float32)
    share = np.array([camera.width, camera.height]) / small.shape[1::-1]
    xy = (np.array([point.pt for point in points]) + 0.5) * share  # COLMAP's pixels
    ideal = np.column_stack([camera.undistort(xy), np.ones(len(xy))])
    return ideal @ np.linalg.inv(camera.K).T, descriptors


def _match(first: Any, second: Any) -> tuple[Array, Array]:
    """Match two images' features; the rays (n, 3) of both."""
    if first is None or second is None or min(len(first[1]), len(second[1])) < 2:
        return np.empty((0, 3)), np.empty((0, 3))
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first[1], second[1], k=2)
    good = [a for a, b in nearest if a.distance < RATIO * b.distance]
    rays = first[0][[m.queryIdx for m in good]], second[0][[m.trainIdx for m in good]]
    finite = np.isfinite(np.column_stack(rays)).all(1)
    return rays[0][finite], rays[1][finite]


def _epipolar_px(poses: Poses, pair: tuple[int, int], first: Array, second: Array) -> float:
    """Return the median Sampson error of matched rays (n, 3), pixels of the native frames.

    Without a translation it is the distance to the rotated point.
    Ref: Hartley & Zisserman 2004, eq. 11.9.
    """
    turn, way = (values[0] for values in _relative(poses, np.array([pair])))
    focal = float(poses.camera.K[0, 0])
    if np.linalg.norm(way) < 1e-12:
        moved = first @ turn.T
        return focal * float(np.median(np.linalg.norm((moved / moved[:, 2:] - second), axis=1)))
    x, y, z = way / np.linalg.norm(way)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    line, back = first @ essential.T, second @ essential  # (n, 3) in the second, first image
    slope = np.sqrt((line[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    return focal * float(np.median(np.abs((second * line).sum(1)) / np.maximum(slope, 1e-12)))


# ---- By tracks -----------------------------------------------------------------------------------


MIN_FITTED_VIEWS = 8  # boxes of a track that a solid is fitted to (chosen)
MAX_FITTED_TRACKS = 30  # the longest (chosen: time)
ALIKE = 5  # consecutive boxes whose errors count as one: a detector repeats them (chosen)


def by_tracks(found: Sequence[PoseReading], tracks: Tracks) -> list[PoseReading]:
    """Decide by boxes: in the right reading each tracklet shows one solid."""
    groups = sorted(rows_by(tracks.tracklet_id), key=len, reverse=True)[:MAX_FITTED_TRACKS]

    def compare(one: Poses, other: Poses) -> tuple[Array, Array]:
        sizes: tuple[list[float], list[float]] = ([], [])
        for rows in groups:
            (a, known), (b, other_known) = (place_of(p, tracks.frame[rows]) for p in (one, other))
            both = known & other_known
            uses = [both, both] if both.sum() >= MIN_FITTED_VIEWS else [known, other_known]
            if min(use.sum() for use in uses) < MIN_FITTED_VIEWS:
                continue
            pair = [
                _solid_px(poses, place[use], tracks.xyxy[rows[use]])
                for poses, place, use in zip((one, other), (a, b), uses, strict=True)
            ]
            count = min(int(use.sum()) for use in uses) // ALIKE
            for size, values in zip(pair, sizes, strict=True):
                values += [size] * count
        return np.array(sizes[0]), np.array(sizes[1])

    return likeliest(found, compare, "the boxes") if len(found) > 1 else list(found)


def _solid_px(poses: Poses, place: IntArray, xyxy: Array) -> float:
    """Return the median distance of boxes (n, 4) from those of the solid fitted to them, pixels."""
    camera = poses.camera
    size = np.array([camera.width, camera.height] * 2)
    boxes = undistort_boxes(xyxy, camera)
    img_from_world = camera.K @ poses.cam_from_world[place]
    fits = quadrics.fit_objects(boxes[:, None], img_from_world, (camera.width, camera.height))
    if fits.status[0] == "rejected":
        return float(size.max())  # as wrong as can be
    shown = quadrics.solid_boxes(fits.ellipsoids, list(fits.support), img_from_world)[:, 0]
    inside = (xyxy > 1) & (xyxy < size - 1) & np.isfinite(shown) & np.isfinite(boxes)
    if not inside.any():
        return float(size.max())
    return max(float(np.median(np.abs(shown - boxes)[inside])), LEAST_PX)


# ---- Direction and axes --------------------------------------------------------------------------


MIN_CHECKED_TRACKS = 4  # fewer say nothing (chosen: three meet by chance in a path read backwards)
MAX_CHECKED_TRACKS = 200  # the longest are enough (chosen: time)
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
    views = sorted(views, key=lambda v: -len(v[0]))[:MAX_CHECKED_TRACKS]
    if len(views) < MIN_CHECKED_TRACKS:
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


MIN_CHECKED_VIEWS = 5  # frames of a track that is used (chosen)
MAX_CHECKED_VIEWS = 40  # of them, evenly spread (chosen: time)


def _rays_of_track(poses: Poses, frame: IntArray, xy: Array) -> tuple[IntArray, Array] | None:
    """Return the viewing rays of a track's centres in the frames with a pose, thinned.

    Returns:
        rows (n,) of the poses and unit rays (n, 3) in camera axes; None of too short a track.
    """
    place, known = place_of(poses, frame)
    use = np.flatnonzero(known & np.isfinite(xy).all(1))
    if len(use) < MIN_CHECKED_VIEWS:
        return None
    thin = np.linspace(0, len(use) - 1, min(len(use), MAX_CHECKED_VIEWS))
    use = use[np.unique(thin.round().astype(int))]
    ideal = poses.camera.undistort(xy[use])
    whole = np.isfinite(ideal).all(1)
    use, ideal = use[whole], ideal[whole]
    if len(use) < MIN_CHECKED_VIEWS:
        return None
    rays = np.column_stack([ideal, np.ones(len(use))]) @ np.linalg.inv(poses.camera.K).T  # (n, 3)
    return place[use], rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _residual_deg(cam_from_world: Array, rays_in_cam: Array) -> float:
    """Return the median angle of rays (n, 3) to their nearest point or, if less, to infinity."""
    ray, centre, point = triangulate_rays(cam_from_world, rays_in_cam)
    toward = np.stack([point - centre, np.broadcast_to(ray.mean(0), ray.shape)])  # (2, n, 3)
    cosine = (ray * toward).sum(2) / np.maximum(np.linalg.norm(toward, axis=2), 1e-12)  # (2, n)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1).min()))
