"""Poses of the frames between the keyframes: 3D points followed from both sides, PnP, gaps.

Needs a reconstruction of the keyframes (`mapping`); changes nothing in it.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from reobj.cameras import Camera, SparseModel, import_pycolmap, invert_rigid
from reobj.files import Progress
from reobj.poses.keyframes import ResizedVideo, follow_points
from reobj.types import Array, BoolArray, Image, IntArray


def locate_between(
    model: SparseModel,
    key_rows: IntArray,
    left_out: IntArray,
    video: ResizedVideo,
    seed: int,
    line: Progress,
) -> tuple[Array, npt.NDArray[np.str_]]:
    """Locate every frame by PnP from points followed from the keyframes before and after it.

    Points are not followed to or past a keyframe that the model does not hold: what mapping took
    out, with better matches, PnP must not put back.

    Args:
        model: of the keyframes, native pixels. key_rows: (R,) row of each of its images in the
            video, ascending. left_out: (L,) rows of the other keyframes, ascending.
    Returns:
        cam_from_world: (F, 3, 4), NaN where PnP was refused or the camera jumped. status: (F,) as
        in `Poses`.
    """
    count, camera = len(video.frames), model.cameras[0]
    cam_from_world, status = np.full((count, 3, 4), np.nan), np.full(count, "none", "<U12")
    cam_from_world[key_rows], status[key_rows] = model.cam_from_world, "keyframe"
    keys, rows = np.union1d(key_rows, left_out), np.arange(count)
    held = np.concatenate([[False], np.isin(keys, key_rows), [False]])  # -1 and K: no keyframe
    reached = held[np.searchsorted(keys, rows, "right")] | held[np.searchsorted(keys, rows) + 1]

    def locate(segment: tuple[int, int, list[tuple[int, Image]]]) -> int:
        before, after, run = segment
        images = [gray for _, gray in run]
        ahead = _follow_model_points(model, before, images)
        back = _follow_model_points(model, after, images[::-1])[::-1]
        for (row, gray), (seen_a, xy_a), (seen_b, xy_b) in zip(run, ahead, back, strict=True):
            if reached[row] and status[row] == "none":
                points, xy = model.points[np.r_[seen_a, seen_b]], np.r_[xy_a, xy_b]
                found = absolute_pose(xy, points, camera, gray.shape[1], seed)
                if found is not None:
                    cam_from_world[row], status[row] = found, "pnp"
        return len(run) - 1

    segments, threads = _segments(key_rows, video.grays()), cv2.getNumThreads()
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(2) as pool:  # segments share nothing; OpenCV's own threads gain less
        while batch := list(itertools.islice(segments, 2)):
            for done in pool.map(locate, batch):
                line.step(done)
    cv2.setNumThreads(threads)
    line.close()
    jump = _detours(cam_from_world) & (status == "pnp")
    cam_from_world[jump], status[jump] = np.nan, "none"
    return cam_from_world, status


MAX_RUN = 1000  # frames held in memory between two keyframes (chosen: .3 GB of 640x480)


def _segments(
    key_rows: IntArray, grays: Iterator[Image]
) -> Iterator[tuple[int, int, list[tuple[int, Image]]]]:
    """Cut the video at the registered keyframes.

    Yields:
        the image of the model before and after (-1: none), and (row, gray image) of both and of all
        frames between them. Of a stretch longer than MAX_RUN the middle is left out.
    """
    image_of = {int(row): image for image, row in enumerate(key_rows)}
    before, run = -1, deque[tuple[int, Image]](maxlen=MAX_RUN)
    for row, gray in enumerate(grays):
        run.append((row, gray))
        image = image_of.get(row, -1)
        if image >= 0 or (before >= 0 and len(run) == MAX_RUN):
            yield before, image, list(run)
            before, run = image, deque([(row, gray)], maxlen=MAX_RUN)
    if before >= 0:
        yield before, -1, list(run)


PNP_POINTS = 200  # followed from each keyframe, those with the longest tracks first (chosen)


def _follow_model_points(
    model: SparseModel, image: int, grays: list[Image]
) -> list[tuple[IntArray, Array]]:
    """Follow the 3D points that an image of the model sees (-1: none) through gray images.

    Returns:
        per gray image, the first being the keyframe itself: rows (n,) of `model.points` and their
        native pixels (n, 2).
    """
    seen = np.flatnonzero(model.obs_image == image)
    longest = np.argsort(-model.track_length[model.obs_point[seen]], kind="stable")
    seen = seen[longest[:PNP_POINTS]]
    scale = np.array(grays[0].shape[::-1]) / (model.cameras[0].width, model.cameras[0].height)
    # COLMAP has the centre of the first pixel at (.5, .5), OpenCV at (0, 0)
    points, xy = model.obs_point[seen], model.obs_xy[seen] * scale - 0.5
    followed = [(points, model.obs_xy[seen])]
    for old, new in itertools.pairwise(grays):
        ahead, kept = follow_points(old, new, xy, and_back=False)  # RANSAC takes out the rest
        points, xy = points[kept], ahead[kept]
        followed.append((points, (xy + 0.5) / scale))
    return followed


PNP_MIN_INLIERS = 15  # of an accepted pose (chosen; COLMAP registers images from 30 on)
PNP_MIN_RATIO = 0.5  # of inliers among the followed points (chosen; COLMAP: .25 of raw matches)
PNP_ERROR_PX = 4.0  # of an inlier, pixels of the resized image (chosen; COLMAP: 12)


def absolute_pose(
    xy: Array, points: Array, camera: Camera, resized_width: int, seed: int
) -> Array | None:
    """Estimate the pose of a frame from 3D points and their pixels (PnP, RANSAC, refinement).

    Args:
        xy: (n, 2) native pixels, COLMAP's. points: (n, 3) in world. resized_width: pixels of the
            image in which the points were found; the error allowed is counted in its pixels.
    Returns:
        cam_from_world (3, 4); None with too few inliers or an inlier behind the camera.
    """
    if len(xy) < PNP_MIN_INLIERS:
        return None
    error_px = PNP_ERROR_PX * camera.width / resized_width
    ransac = {"max_error": error_px, "confidence": 0.999, "random_seed": seed}
    found = import_pycolmap().estimate_and_refine_absolute_pose(
        xy, points, camera.to_pycolmap(), estimation_options={"ransac": ransac}
    )
    if found is None or found["num_inliers"] < max(PNP_MIN_INLIERS, PNP_MIN_RATIO * len(xy)):
        return None
    pose: Array = found["cam_from_world"].matrix()
    depth = points[found["inlier_mask"]] @ pose[2, :3] + pose[2, 3]
    return pose if np.isfinite(pose).all() and (depth > 0).all() else None


MAX_DETOUR_STEPS = 5.0  # of a PnP pose, in usual steps of the camera (chosen)


def _detours(cam_from_world: Array) -> BoolArray:
    """Mark frames (F,) whose centre is far from both neighbours, while these are near each other.

    The detour over a centre, compared with the way past it, counts in steps: the distance of the
    neighbours or the median step of the path, whichever is longer.
    """
    known = np.flatnonzero(np.isfinite(cam_from_world).all((1, 2)))
    detour = np.zeros(len(cam_from_world), bool)
    if len(known) > 2:
        centre = invert_rigid(cam_from_world[known])[:, :, 3]  # (N, 3)
        step = np.linalg.norm(np.diff(centre, axis=0), axis=1)  # (N-1,)
        direct = np.linalg.norm(centre[2:] - centre[:-2], axis=1)  # (N-2,)
        usual = np.maximum(direct, np.median(step))
        detour[known[1:-1]] = step[1:] + step[:-1] - direct > MAX_DETOUR_STEPS * usual
    return detour


def fill_gaps(
    frame: IntArray,
    cam_from_world: Array,
    status: npt.NDArray[np.str_],
    max_gap: int,
    left_out: Sequence[int] | IntArray = (),
) -> tuple[Array, npt.NDArray[np.str_]]:
    """Interpolate the poses of at most `max_gap` lost frames in a row, never beyond the ends.

    Nor past a row of `left_out`, a keyframe that mapping took out.

    The rotation is interpolated by slerp and the camera's centre along a line; the translation of
    cam_from_world on a line would bend the path.

    Args:
        frame: (F,) source numbers: frames that were not read count too. cam_from_world: (F, 3, 4),
            NaN where lost. status: (F,) as in `Poses`.
    Returns:
        copies of cam_from_world and status, the latter "interpolated" where filled.
    """
    filled, status = cam_from_world.copy(), status.copy()
    known = np.flatnonzero(np.isfinite(cam_from_world).all((1, 2)))
    for a, b in itertools.pairwise(known):
        taken_out = any(a < row < b for row in left_out)
        if b - a > 1 and frame[b] - frame[a] - 1 <= max_gap and not taken_out:
            share = (frame[a + 1 : b] - frame[a]) / (frame[b] - frame[a])  # (n,)
            ends = invert_rigid(cam_from_world[[a, b]])  # (2, 3, 4) world_from_cam
            between = Slerp([0, 1], Rotation.from_matrix(ends[:, :, :3]))
            turn = between(share).as_matrix()  # (n, 3, 3)
            centre = ends[0, :, 3] + share[:, None] * (ends[1, :, 3] - ends[0, :, 3])  # (n, 3)
            filled[a + 1 : b] = invert_rigid(np.concatenate([turn, centre[:, :, None]], 2))
            status[a + 1 : b] = "interpolated"
    return filled, status
