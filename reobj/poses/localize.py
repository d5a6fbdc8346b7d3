"""Locate the frames between the mapped keyframes: PnP on tracked 3D points, interpolated gaps.

The reconstruction of the keyframes is not changed.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from reobj.cameras import Camera, SparseModel, import_pycolmap, invert_rigid
from reobj.files import Progress
from reobj.poses.bundle import INLIER_PX
from reobj.poses.keyframes import ResizedVideo, follow_points
from reobj.types import Array, BoolArray, Image, IntArray


@dataclass(frozen=True, slots=True)
class Located:
    """Poses of all frames by one model.

    Attributes:
        key_rows: (R,) row of each image of the model.
        cam_from_world: (F, 3, 4), NaN where PnP failed or the camera jumped. status: (F,) as in
            `Poses`.
    """

    model: SparseModel
    key_rows: IntArray
    cam_from_world: Array
    status: npt.NDArray[np.str_]


def locate_between(
    model: SparseModel,
    key_rows: IntArray,
    unmapped: IntArray,
    video: ResizedVideo,
    seed: int,
    line: Progress,
) -> Located:
    """Locate every frame by PnP on points tracked from the keyframes before and after it.

    Points are not tracked to or past a keyframe that is not in the model: mapping rejected it with
    better matches than PnP has.

    Args:
        model: of the keyframes, native pixels. key_rows: (R,) row of each of its images in the
            video, ascending. unmapped: (L,) rows of the other keyframes, ascending.
    """
    count = len(video.frames)
    camera = model.cameras[0]
    cam_from_world = np.full((count, 3, 4), np.nan)
    status = np.full(count, "none", "<U12")
    cam_from_world[key_rows] = model.cam_from_world
    status[key_rows] = "keyframe"
    tried = beside_mapped(np.union1d(key_rows, unmapped), key_rows, count) & (status == "none")

    def locate(segment: tuple[int, int, list[tuple[int, Image]]]) -> int:
        before, after, run = segment
        if not tried[[row for row, _ in run]].any():
            return len(run) - 1
        images = [gray for _, gray in run]
        ahead = _track_model_points(model, before, images)
        back = _track_model_points(model, after, images[::-1])[::-1]
        for (row, gray), (seen_a, xy_a), (seen_b, xy_b) in zip(run, ahead, back, strict=True):
            if tried[row]:
                points = model.points[np.r_[seen_a, seen_b]]
                pose = absolute_pose(np.r_[xy_a, xy_b], points, camera, gray.shape[1], seed)
                if pose is not None:
                    cam_from_world[row] = pose
                    status[row] = "pnp"
        return len(run) - 1

    segments = _segments(key_rows, video.grays())
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(2) as pool:  # segments are independent; OpenCV's own threads gain less
        while batch := list(itertools.islice(segments, 2)):
            for done in pool.map(locate, batch):
                line.step(done)
    cv2.setNumThreads(threads)
    jump = _detours(cam_from_world) & (status == "pnp")
    cam_from_world[jump] = np.nan
    status[jump] = "none"
    return Located(model, key_rows, cam_from_world, status)


def beside_mapped(keys: IntArray, mapped: IntArray, count: int) -> BoolArray:
    """Mark the frames (F,) that are a mapped keyframe, or next to one before or after them.

    Args:
        keys: (K,) rows of all keyframes, ascending. mapped: of those in a model. count: F.
    """
    rows = np.arange(count)
    is_mapped = np.concatenate([[False], np.isin(keys, mapped), [False]])  # -1 and K: no keyframe
    before = is_mapped[np.searchsorted(keys, rows, "right")]
    after = is_mapped[np.searchsorted(keys, rows) + 1]
    return np.asarray(before | after, bool)


MAX_SEGMENT = 1000  # frames of a segment held in memory: .3 GB of 640x480


def _segments(
    key_rows: IntArray, grays: Iterator[Image]
) -> Iterator[tuple[int, int, list[tuple[int, Image]]]]:
    """Cut the video at the mapped keyframes.

    Yields:
        the image of the model before and after (-1: none), and (row, gray image) of both and of all
        frames between them. The middle of a longer segment is left out.
    """
    image_of = {int(row): image for image, row in enumerate(key_rows)}
    before = -1
    run = deque[tuple[int, Image]](maxlen=MAX_SEGMENT)
    for row, gray in enumerate(grays):
        run.append((row, gray))
        image = image_of.get(row, -1)
        if image >= 0 or (before >= 0 and len(run) == MAX_SEGMENT):
            yield before, image, list(run)
            before = image
            run = deque([(row, gray)], maxlen=MAX_SEGMENT)
    if before >= 0:
        yield before, -1, list(run)


def _track_model_points(
    model: SparseModel, image: int, grays: list[Image]
) -> list[tuple[IntArray, Array]]:
    """Track the 3D points that an image of the model observes (-1: none) through gray images.

    Returns:
        per gray image, the first being the keyframe itself: rows (n,) of `model.points` and their
        native pixels (n, 2).
    """
    seen = np.flatnonzero(model.obs_image == image)
    longest = np.argsort(-model.track_length[model.obs_point[seen]], kind="stable")
    seen = seen[longest[:200]]
    scale = np.array(grays[0].shape[::-1]) / (model.cameras[0].width, model.cameras[0].height)
    # COLMAP has the centre of the first pixel at (.5, .5), OpenCV at (0, 0)
    points = model.obs_point[seen]
    xy = model.obs_xy[seen] * scale - 0.5
    tracked = [(points, model.obs_xy[seen])]
    for old, new in itertools.pairwise(grays):
        ahead, kept = follow_points(old, new, xy, and_back=False)  # RANSAC rejects outliers
        points = points[kept]
        xy = ahead[kept]
        tracked.append((points, (xy + 0.5) / scale))
    return tracked


MIN_INLIERS = 15  # of an accepted pose; half of COLMAP's abs_pose_min_num_inliers
MIN_RATIO = 0.5  # of inliers among the tracked points (COLMAP: .25 of raw matches)


def absolute_pose(
    xy: Array, points: Array, camera: Camera, resized_width: int, seed: int
) -> Array | None:
    """Estimate the pose of a frame from 3D points and their pixels (PnP, RANSAC, refinement).

    Args:
        xy: (n, 2) native pixels, COLMAP's. points: (n, 3) in world. resized_width: pixels of the
            image in which the points were tracked; INLIER_PX is in its pixels.
    Returns:
        cam_from_world (3, 4); None with too few inliers or an inlier behind the camera.
    """
    if len(xy) < MIN_INLIERS:
        return None
    error_px = INLIER_PX * camera.width / resized_width
    ransac = {"max_error": error_px, "confidence": 0.999, "random_seed": seed}
    # COLMAP: 100 and 3; the same poses in less time (measured)
    ransac |= {"min_num_trials": 10, "dyn_num_trials_multiplier": 1.0}
    estimate = import_pycolmap().estimate_and_refine_absolute_pose(
        xy, points, camera.to_pycolmap(), estimation_options={"ransac": ransac}
    )
    if estimate is None or estimate["num_inliers"] < max(MIN_INLIERS, MIN_RATIO * len(xy)):
        return None
    pose: Array = estimate["cam_from_world"].matrix()
    depth = points[estimate["inlier_mask"]] @ pose[2, :3] + pose[2, 3]
    return pose if np.isfinite(pose).all() and (depth > 0).all() else None


MAX_DETOUR = 5.0  # in the unit of `_detours`; a lower limit drops frames of a shaking camera


def _detours(cam_from_world: Array) -> BoolArray:
    """Mark frames (F,) whose centre is far from both neighbours, while these are near each other.

    The unit of the detour is the distance of the neighbours or the median step of the trajectory,
    whichever is longer.
    """
    known = np.flatnonzero(np.isfinite(cam_from_world).all((1, 2)))
    detour = np.zeros(len(cam_from_world), bool)
    if len(known) > 2:
        centre = invert_rigid(cam_from_world[known])[:, :, 3]  # (N, 3)
        step = np.linalg.norm(np.diff(centre, axis=0), axis=1)  # (N-1,)
        direct = np.linalg.norm(centre[2:] - centre[:-2], axis=1)  # (N-2,)
        usual = np.maximum(direct, np.median(step))
        detour[known[1:-1]] = step[1:] + step[:-1] - direct > MAX_DETOUR * usual
    return detour


MAX_GAP = 15  # consecutive lost frames that are interpolated: half a second at 30 Hz
# Gap lengths, before and after it, in which the error is measured: farther motion may differ
NEAR_GAPS = 2.0


def fill_gaps(
    located: Located,
    frame: IntArray,
    time_s: Array,
    shrink: float,
    unmapped: Sequence[int] | IntArray = (),
) -> tuple[Array, npt.NDArray[np.str_]]:
    """Interpolate the poses of at most MAX_GAP consecutive lost frames where the error is small.

    It must be below `INLIER_PX`, as that of PnP (`_interpolation_px`). There is no
    extrapolation, and no interpolation past a row of `unmapped`, a keyframe that mapping rejected.
    The rotation is interpolated by slerp and the camera's centre linearly.

    Args:
        frame: (F,) numbers in the source: frames that were not read count too. time_s: (F,).
        shrink: side of the resized image over the native one; errors are in resized pixels.
    Returns:
        cam_from_world (F, 3, 4) and status (F,), "interpolated" where filled.
    """
    model = located.model
    cam_from_world = located.cam_from_world
    filled = cam_from_world.copy()
    status = located.status.copy()
    known = np.flatnonzero(np.isfinite(cam_from_world).all((1, 2)))
    for k in np.flatnonzero(np.diff(known) > 1).tolist():
        a, b = known[k : k + 2].tolist()
        if frame[b] - frame[a] - 1 > MAX_GAP or any(a < row < b for row in unmapped):
            continue
        camera = model.cameras[0]
        points = _points_around(model, located.key_rows, a, b)
        size = shrink * np.array([camera.width, camera.height])
        sides = known[: k + 1], known[k + 1 :]
        focal = float(shrink * camera.K[0, 0])
        error = _interpolation_px(sides, time_s, cam_from_world, points, focal, size)
        if error <= INLIER_PX:
            inner = np.arange(a + 1, b, dtype=np.int64)
            filled[inner] = _interpolated(cam_from_world[[a, b]], time_s[[a, b]], time_s[inner])
            status[inner] = "interpolated"
    return filled, status


def _interpolated(ends: Array, times_s: Array, wanted_s: Array) -> Array:
    """Interpolate between two poses (2, 3, 4) at times (n,): slerp, and linearly in the centre.

    Linear in the translation of cam_from_world would bend the trajectory.
    """
    world_from_cam = invert_rigid(ends)
    turn = Slerp(times_s, Rotation.from_matrix(world_from_cam[:, :, :3]))(wanted_s).as_matrix()
    fraction = ((wanted_s - times_s[0]) / (times_s[1] - times_s[0]))[:, None]
    centre = world_from_cam[0, :, 3] + fraction * (world_from_cam[1] - world_from_cam[0])[:, 3]
    return invert_rigid(np.concatenate([turn, centre[:, :, None]], 2))


def _points_around(model: SparseModel, key_rows: IntArray, a: int, b: int) -> Array:
    """Return the points (n, 3) that the keyframes around the rows a to b observe."""
    margin = round(NEAR_GAPS * (b - a))
    first = int(np.searchsorted(key_rows, a - margin, "right")) - 1  # one before that, one after
    images = np.arange(max(first, 0), int(np.searchsorted(key_rows, b + margin)) + 1)
    seen = np.unique(model.obs_point[np.isin(model.obs_image, images)])
    return model.points[seen[:: max(1, len(seen) // 200)]]  # fewer take less time


def _interpolation_px(
    sides: tuple[IntArray, IntArray],
    time_s: Array,
    cam_from_world: Array,
    points: Array,
    focal: float,
    size: Array,
) -> float:
    """Estimate the error of interpolation over a gap, as a shift of points in the image.

    It is the largest of: the errors at located frames on each side of the gap, where as long a gap
    is left out; and the distance between linear interpolation and a cubic Hermite curve with the
    velocities measured at the ends of the gap. The first is large where the camera shakes, and
    between photos; the second where its velocity changes across the gap.

    Args:
        sides: located rows before and after the gap, ascending. points: (N, 3). focal, size: px.
    Returns:
        pixels; infinite where too few frames are located beside the gap.
    """
    before, after = sides
    start_s = time_s[before[-1]]
    end_s = time_s[after[0]]
    gap_s = float(end_s - start_s)
    worst = 0.0
    if min(len(before), len(after)) < 2:
        return np.inf
    for side, edge_s in ((before, start_s), (after, end_s)):
        near = side[np.abs(time_s[side] - edge_s) <= NEAR_GAPS * gap_s * (1 + 1e-6)]
        until = np.searchsorted(time_s[near], time_s[near] + gap_s * (1 - 1e-6))
        errors = []
        for i, j in enumerate(until.tolist()):
            if j < len(near) and j > i + 1:
                ends = near[[i, j]]
                inner = near[i + 1 : j]
                line = _interpolated(cam_from_world[ends], time_s[ends], time_s[inner])
                errors.append(_shift_px(line, cam_from_world[inner], points, focal, size))
        if not errors:
            return np.inf
        worst = max(worst, *errors)
    four = np.array([before[-2], before[-1], after[0], after[1]])
    ends = four[[1, 2]]
    inner_s = np.linspace(start_s, end_s, 9)[1:-1]
    line = _interpolated(cam_from_world[ends], time_s[ends], inner_s)
    curve = _hermite(cam_from_world[four], time_s[four], inner_s)
    return max(worst, _shift_px(line, curve, points, focal, size))


def _hermite(poses: Array, times_s: Array, wanted_s: Array) -> Array:
    """Interpolate between the inner two of four poses (4, 3, 4) by a cubic in (rotation, centre).

    The velocities at its ends are those from the first to the second and from the third to the
    fourth; rotations count as rotation vectors from the second.
    """
    world_from_cam = invert_rigid(poses)
    turn = Rotation.from_matrix(world_from_cam[:, :, :3])
    path = np.hstack([(turn[1].inv() * turn).as_rotvec(), world_from_cam[:, :, 3]])  # (4, 6)
    speed = np.diff(path, axis=0) / np.diff(times_s)[:, None]  # (3, 6)
    curve = CubicHermiteSpline(times_s[1:3], path[1:3], speed[[0, 2]])(wanted_s)  # (n, 6)
    turned = (turn[1] * Rotation.from_rotvec(curve[:, :3])).as_matrix()
    return invert_rigid(np.concatenate([turned, curve[:, 3:, None]], 2))


def _shift_px(one: Array, other: Array, points: Array, focal: float, size: Array) -> float:
    """Return the largest shift of the image over n pairs of poses (n, 3, 4).

    The shift of a pair is the median over the points that project into the image of the second
    pose; it is infinite where there are none.
    """
    (x1, z1), (x2, z2) = (
        (focal * found[..., :2] / found[..., 2:], found[..., 2])
        for found in (np.einsum("nij,pj->npi", p[:, :, :3], points) + p[:, None, :, 3]
                      for p in (one, other))
    )  # fmt: skip
    inside = (z2 > 0) & (np.abs(x2) < size / 2).all(2)  # (n, N)
    shift = np.where(z1 > 0, np.linalg.norm(x1 - x2, axis=2), np.inf)
    medians = [np.median(s[i]) if i.any() else np.inf for s, i in zip(shift, inside, strict=True)]
    return float(max(medians))
