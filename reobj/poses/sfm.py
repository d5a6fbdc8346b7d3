"""Sparse points of supplied poses, triangulated from the images by pycolmap, in a child process.

Keyframes and the pairs to match are chosen by their poses, which stay as they are. The share of the
matched features that meet in points tells whether the poses explain the images.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reobj.cameras import Camera, Poses, import_pycolmap, invert_rigid, write_colmap
from reobj.files import Progress, load_npz, save_npz, writing
from reobj.poses.child_job import Child, serve
from reobj.poses.features import extract_features, match_pairs
from reobj.sources.video import shrunk
from reobj.types import Array, Image, IntArray

MAX_KEYFRAMES = 150  # as in a reconstruction (chosen: time)
MIN_KEYFRAMES = 40  # below, steps are halved as long as there are frames (chosen)
TURN_STEP_DEG = 8.0  # turn that makes a keyframe (chosen: an eighth of a usual field of view)
SPREAD_STEP = 1 / 8  # move that makes one, over the rms spread of the path: an orbit's 7 deg
OFFSETS = (1, 2, 4)  # keyframes so far apart are matched (chosen)
NEAR_PAIRS = 4  # and with each the nearest others by pose, of a return to a place (chosen)
MAX_PAIR_STEPS = 8.0  # but none with more turn and move between them, in steps (chosen)
# Share of the matched features that must meet in points of three images and more. Measured:
# studio_room .73, redkitchen .55, hololens_kitchen .51; redkitchen with inverted poses .005.
MIN_EXPLAINED = 0.15


def triangulate(
    poses: Poses,
    video: Any,
    *,
    size_px: int,
    seed: int,
    work_dir: Path,
    progress: Callable[[str, int], Progress] = Progress,
) -> Poses:
    """Triangulate sparse points of the images from known poses.

    Args:
        video: a `Video`, iterated once. size_px: longer side to which its images are shrunk.
        work_dir: receives `points.log`, and scratch files while it works.
    Returns:
        the poses with points, colours and visibility (of keyframes). Where there is nothing to
        triangulate, or the poses do not explain the images, as they were with a message; this is no
        exception.
    """
    steps = path_steps(poses)
    keys = choose_keyframes(steps)
    images = _sharp_images(poses, video, keys, size_px, progress("keyframes", len(poses.frame)))
    rows, size = sorted(images), (poses.camera.width, poses.camera.height)
    if len(rows) < 2:
        why = f"{len(rows)} images have a pose; two or more are needed"
        return _without_points(poses, why)
    folder = work_dir / "points"
    job = {
        "camera": [poses.camera.model, list(poses.camera.params)],
        "size": size,
        "cam_from_world": poses.cam_from_world[rows].tolist(),
        "pairs": choose_pairs(steps[rows]).tolist(),
        "seed": seed,
    }
    with Child("reobj.poses.sfm", folder, work_dir / "points.log") as child, writing(folder):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        np.save(folder / "keyframes.npy", np.stack([images[row] for row in rows]))
        (folder / "job.json").write_text(json.dumps(job))
        problem = child.run(progress)
    if problem:
        return _without_points(poses, f"the triangulation {problem}")
    found, facts = load_npz(folder / "points.npz")
    shutil.rmtree(folder)
    views = np.bincount(found["visibility"][:, 1])[found["visibility"][:, 1]]  # (M,) of its point
    # two views often meet somewhere by chance: sideways motion in another order is one such case
    observed, matched = int((views >= min(3, len(rows))).sum()), int(facts["matched"])
    if not observed or observed < MIN_EXPLAINED * matched:
        share = f"{observed} of {matched} matched features of {len(rows)} images"
        why = f"only {share} meet in 3D, as the supplied poses have it"
        advice = "are these poses of this video, in this order, with this camera?"
        if not matched:
            return _without_points(poses, f"nothing in {len(rows)} images could be matched")
        return _without_points(poses, f"{why} (good poses: half of them); {advice}")
    seen = np.array(rows)[found["visibility"][:, 0]]
    found["visibility"] = np.column_stack([seen, found["visibility"][:, 1]])
    messages = (*poses.messages, *_torn(found.pop("ties"), poses.frame[rows]))
    return dataclasses.replace(poses, **found, messages=messages)


MIN_MATCHES = 30  # of two keyframes that say something (COLMAP registers from 30 on)
# Share of them that must be one point (measured, least of a recording: rendered .71, studio_room
# .42, hololens_kitchen .14; redkitchen .09, and .003 where its Kinect lost track; ends of stretches
# that were moved 0 and .04)
MIN_TIED = 0.05
MAX_TEARS = 5  # named in a message (chosen)


def _torn(ties: IntArray, frame: IntArray) -> list[str]:
    """Say where supplied poses tear: what keyframes (K,) that follow each other show is not one.

    Args:
        ties: (K - 1, 2) of `_neighbours_tied`. frame: (K,).
    """
    count, tied = ties.T
    at = np.flatnonzero((count >= MIN_MATCHES) & (tied < MIN_TIED * count))
    if not len(at):
        return []
    runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    where = [f"{frame[run[0]]} and {frame[run[-1] + 1]}" for run in runs]
    more = f" and {len(where) - MAX_TEARS} more" if len(where) > MAX_TEARS else ""
    return [
        f"the supplied poses tear between frames {', '.join(where[:MAX_TEARS])}{more}: what both "
        "sides see does not meet in 3D; objects that are seen mostly there are likely misplaced"
    ]


def _without_points(poses: Poses, why: str) -> Poses:
    return dataclasses.replace(poses, messages=(*poses.messages, f"no sparse points: {why}"))


# ---- Keyframes and pairs -------------------------------------------------------------------------


def path_steps(poses: Poses) -> Array:
    """Express poses as coordinates (F, 6) in which keyframes are 1 apart; NaN: no pose.

    The first three are the viewing direction over TURN_STEP_DEG, the others the camera's centre
    over SPREAD_STEP of the path's rms spread: distances have no unit, so any scale will do.
    """
    world_from_cam = invert_rigid(poses.cam_from_world)  # (F, 3, 4)
    centre = world_from_cam[:, :, 3]
    spread = np.sqrt(np.nanvar(centre, axis=0).sum()) if poses.known.any() else 0.0
    # of a small angle the distance on the unit sphere is the angle
    turn = world_from_cam[:, :, 2] / np.radians(TURN_STEP_DEG)
    return np.column_stack([turn, centre / max(SPREAD_STEP * spread, 1e-12)])


def choose_keyframes(steps: Array) -> IntArray:
    """Choose keyframes along a path: each a step (or evenly more, or less) from the last.

    Args:
        steps: (F, 6) of `path_steps`.
    Returns:
        rows, ascending; at most MAX_KEYFRAMES, and if there are so many frames, MIN_KEYFRAMES.
    """
    rows = np.flatnonzero(np.isfinite(steps).all(1))
    length, chosen = 1.0, _rows_apart(steps, rows, 1.0)
    while len(chosen) < min(MIN_KEYFRAMES, len(rows)) and length > 1e-6:
        length /= 2
        chosen = _rows_apart(steps, rows, length)
    while len(chosen) > MAX_KEYFRAMES:
        length *= 1.1
        chosen = _rows_apart(steps, rows, length)
    return chosen


def _rows_apart(steps: Array, rows: IntArray, length: float) -> IntArray:
    """Choose the rows that lie at least `length` from the last one chosen."""
    chosen = rows[:1].tolist()
    for row in rows[1:].tolist():
        if np.linalg.norm(steps[row] - steps[chosen[-1]]) >= length:
            chosen.append(row)
    return np.array(chosen, np.int64)


def choose_pairs(steps: Array) -> IntArray:
    """Choose the pairs of K keyframes to match: neighbours in time, and the nearest others.

    Args:
        steps: (K, 6) of `path_steps`.
    Returns:
        (P, 2) rows of the keyframes, the lower one first.
    """
    count = len(steps)
    pairs = {(i, i + offset) for offset in OFFSETS for i in range(count - offset)}
    distance = np.linalg.norm(steps[:, None] - steps, axis=2)  # (K, K)
    at = np.arange(count)
    distance[np.abs(at[:, None] - at) <= max(OFFSETS)] = np.inf
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEAR_PAIRS]  # (K, near)
    for i, j in zip(
        np.repeat(at, nearest.shape[1]).tolist(), nearest.ravel().tolist(), strict=True
    ):
        if distance[i, j] <= MAX_PAIR_STEPS:
            pairs.add((min(i, j), max(i, j)))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def _sharp_images(
    poses: Poses, video: Any, keys: IntArray, size_px: int, line: Progress
) -> dict[int, Image]:
    """Read the sharpest image near each keyframe, within a quarter of the way to its neighbours.

    Returns:
        image by row of the poses, shrunk; none where there are no images.
    """
    nearest: dict[int, int] = {}  # keyframe of each row that may stand for it
    for before, key, after in zip([-1, *keys], keys, [*keys[1:], len(poses.frame)], strict=False):
        for row in range(key - (key - before) // 4, key + (after - key) // 4 + 1):
            if poses.known[row]:
                nearest[row] = int(key)
    row_of = {frame: row for row, frame in enumerate(poses.frame.tolist())}
    best: dict[int, tuple[float, int, Image]] = {}
    for frame in video if len(keys) else ():
        line.step()
        key = nearest.get(row_of.get(frame.index, -1), -1)
        if key < 0 or frame.image is None:
            continue
        image = shrunk(frame.image, size_px)
        sharpness = float(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.CV_32F).var())
        if key not in best or sharpness > best[key][0]:
            best[key] = (sharpness, row_of[frame.index], image)
    line.close()
    return {row: image for _, row, image in best.values()}


# ---- The child process ---------------------------------------------------------------------------


def _triangulate_job(folder: Path) -> None:
    """Triangulate the points of a job folder into points.npz (child process)."""
    pc = import_pycolmap()
    pc.logging.minloglevel = 0  # stderr is the log file here
    job = json.loads((folder / "job.json").read_text())
    database, seed = folder / "database.db", int(job["seed"])
    images = np.load(folder / "keyframes.npy", mmap_mode="r")  # (K, h, w, 3) BGR
    (width, height), (kind, params) = job["size"], job["camera"]
    size = (images.shape[2], images.shape[1])
    camera = Camera(kind, width, height, tuple(params)).resized(size).to_pycolmap()
    camera.has_prior_focal_length = True
    ids = range(1, len(images) + 1)
    extract_features(database, images, ids, [np.empty((0, 4))] * len(images), camera)
    match_pairs(database, [(i + 1, j + 1) for i, j in job["pairs"]], seed)
    model = _posed_model(images, job, folder / "posed")
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed, "extract_colors": False}
    (folder / "sparse").mkdir()
    out = str(folder / "sparse")
    model = pc.triangulate_points(model, str(database), str(folder), out, options=options)
    xyz, colors, seen = [], [], []
    for row, (_, point) in enumerate(sorted(model.points3D.items())):
        first = point.track.elements[0]  # the colour is that of the first observation
        xy = model.image(first.image_id).point2D(first.point2D_idx).xy.astype(int)
        x, y = xy.clip(0, (images.shape[2] - 1, images.shape[1] - 1))
        xyz.append(point.xyz)
        colors.append(images[first.image_id - 1, y, x, ::-1])
        seen += [(element.image_id - 1, row) for element in point.track.elements]
    arrays = {
        "points": np.array(xyz).reshape(-1, 3),
        "colors": np.array(colors, np.uint8).reshape(-1, 3),
        "visibility": np.array(seen, np.int64).reshape(-1, 2),
    }
    arrays["ties"] = _neighbours_tied(database, model, len(images))
    save_npz(folder / "points.npz", arrays, matched=_count_matched(database))


def _posed_model(images: Any, job: dict[str, Any], folder: Path) -> Any:
    """Make a model of the posed keyframes without points, named as in the database."""
    count, size = len(images), (images.shape[2], images.shape[1])
    (width, height), (kind, params) = job["size"], job["camera"]
    camera = Camera(kind, width, height, tuple(params)).resized(size)
    at, status = np.arange(count), np.full(count, "supplied")
    poses = Poses(camera, at, at / 1.0, np.array(job["cam_from_world"]), status, "user")
    write_colmap(folder, poses, [f"{number:06d}" for number in range(1, count + 1)])
    return import_pycolmap().Reconstruction(str(folder))


def _count_matched(database: Path) -> int:
    """Count the features that have a verified match in another keyframe."""
    pc, matched = import_pycolmap(), set()
    with contextlib.closing(pc.Database.open(str(database))) as db:
        for pair, geometry in zip(*db.read_two_view_geometries(), strict=True):
            ids = pc.pair_id_to_image_pair(pair)
            for image_id, features in zip(ids, geometry.inlier_matches.T.tolist(), strict=True):
                matched |= {(image_id, feature) for feature in features}
    return len(matched)


def _neighbours_tied(database: Path, model: Any, count: int) -> IntArray:
    """Count (K - 1, 2) matches of keyframes that follow each other, and those that are a point."""
    point_of = {
        i: np.array([p.point3D_id if p.has_point3D() else -1 for p in model.image(i).points2D])
        for i in range(1, count + 1)
    }
    ties = np.zeros((count - 1, 2), np.int64)
    with contextlib.closing(import_pycolmap().Database.open(str(database))) as db:
        for i in range(1, count):
            if db.exists_two_view_geometry(i, i + 1):
                one, other = db.read_two_view_geometry(i, i + 1).inlier_matches.T.astype(np.int64)
                points = point_of[i][one]
                ties[i - 1] = len(one), ((points == point_of[i + 1][other]) & (points >= 0)).sum()
    return ties


if __name__ == "__main__":
    serve(_triangulate_job)
