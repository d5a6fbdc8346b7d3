"""Keyframes of a long path: mapped in windows that overlap, whose models are joined.

A mapper adjusts all images again and again: twice as many take more than twice as long. Windows of
consecutive keyframes are mapped and verified separately. Two models are joined by the points
that both have triangulated, of images that are in both or of matches between them; this also closes
loops between far windows. All images are adjusted together at the end.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.spatial.transform import Rotation

from reobj.cameras import import_pycolmap
from reobj.files import atomic, load_cached, load_json
from reobj.poses.bundle import INLIER_PX, adjusted, read_arrays
from reobj.poses.child_job import send_progress
from reobj.poses.features import MatchedPairs
from reobj.poses.mapping import MapperSearch, models_of_one_camera, without_poses
from reobj.poses.verification import FocalSource
from reobj.types import Array, IntArray


@dataclass(frozen=True, slots=True)
class WindowOptions:
    """How a path is cut into windows, and which of their models are joined.

    Attributes:
        size: keyframes of a window (chosen: a mapper needs a minute for them).
        overlap: keyframes that two consecutive windows share.
        points: that both models triangulate and that a similarity maps onto each other: as many as
            prove how two pieces are joined (`ConfirmationOptions.joint_points`).
        error_px: largest reprojection error of such a point in the other model (COLMAP's
            abs_pose_max_error: windows are not adjusted together yet).
        contradiction: distance of joined points over their depth, median of two models, above which
            the other joins contradict theirs (chosen: drift of a window stays below).
    """

    size: int = 200
    overlap: int = 40
    points: int = 100
    error_px: float = 3 * INLIER_PX
    contradiction: float = 0.1


def _path(ids: list[int], pairs: MatchedPairs) -> list[int]:
    """Order images so that near ones match: by time, or, if that says nothing, by their matches.

    Ref: Cuthill and McKee, ACM 1969: an order in which the connections of a graph are short.
    """
    if pairs.is_path:
        return ids
    ends = np.searchsorted(ids, pairs.image_ids[pairs.enough])
    graph = csr_matrix((np.ones(len(ends)), ends.T), (len(ids), len(ids)))
    order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
    return [ids[k] for k in order.tolist()]


def split(ids: Sequence[int], options: WindowOptions = WindowOptions()) -> list[list[int]]:
    """Cut keyframes, in the order of their path, into windows of nearly equal size that overlap.

    Those of a window are in ascending order.
    """
    step = options.size - options.overlap
    count = max(1, round((len(ids) - options.overlap) / step))
    starts = np.linspace(0, max(len(ids) - options.overlap, 0), count + 1).round().astype(int)
    return [sorted(ids[a : b + options.overlap]) for a, b in itertools.pairwise(starts.tolist())]


def map_keyframes(
    search: MapperSearch, options: WindowOptions = WindowOptions()
) -> tuple[list[Any], list[str], list[int]]:
    """Map keyframes: at once, or in windows whose models are joined.

    Models of a window that is finished stay beside the database: a run that was interrupted
    continues from there.

    Args:
        search: with all keyframes; its database has their features and verified matches.
    Returns:
        models of the components, the largest first ([]: none is sound); messages; keyframes whose
        windows alone do not determine their poses, to be registered in the joined models.
    """
    ids = list(search.ids)
    folder = search.database.parent
    windows = split(_path(ids, search.pairs), options)
    if len(windows) == 1:
        models, found = _kept(folder / "whole", ids, lambda: _run(search))
        return models, [*found["messages"], *found["lost"]], []
    models, found = _kept(folder / "all", ids, lambda: _map_windows(windows, search, options))
    return models, found["messages"], found["weak"]


FINISHED = "finished"  # step of a window


def _map_windows(
    windows: list[list[int]], whole: MapperSearch, options: WindowOptions
) -> tuple[list[Any], dict[str, Any]]:
    """Map windows of keyframes and join their models.

    Args:
        whole: a search with all keyframes.
    Returns:
        models of the components; "messages" and "weak" keyframes as of `map_keyframes`.
    """
    database = whole.database
    pairs = whole.pairs
    done = [0] * len(windows)
    total = sum(map(len, windows))
    lock = threading.Lock()

    def map_window(k: int) -> tuple[list[Any], dict[str, Any]]:
        ids = windows[k]
        folder = database.parent / f"window{k}"
        folder.mkdir(exist_ok=True)
        path = folder / "database.db"

        def show(step: str, registered: int, count: int) -> None:
            # adjustment, verification and second mapper take as long as the first, or longer
            share = registered if step == FINISHED else registered // 2
            with lock:
                done[k] = max(done[k], share)
                send_progress("mapping", sum(done), total)

        frames = {i: whole.frames[i] for i in ids}
        known = (whole.focal, whole.guess, whole.seed, whole.options, show)
        search = MapperSearch(path, frames, pairs.only(ids), *known)

        def run() -> tuple[list[Any], dict[str, Any]]:
            with lock:
                copy_database(database, path, ids)
            return _run(search)

        models, found = _kept(folder, ids, run)
        path.unlink(missing_ok=True)
        show(FINISHED, len(ids), len(ids))
        return models, found

    with ThreadPoolExecutor(2) as pool:  # mappers use one core each: reproducible
        results = list(pool.map(map_window, range(len(windows))))
    models = [model for found, _ in results for model in found]
    messages = list(dict.fromkeys(text for _, found in results for text in found["messages"]))
    tried = {number for _, found in results for number in found["tried"]}
    if not models:
        return [], {"messages": [*messages, *results[0][1]["lost"]], "weak": []}
    posed = [_merged_poses(models, place) for place in aligned(models, pairs, options)]
    del models, results  # memory
    steps = itertools.count()

    def show_step() -> None:
        send_progress("joining", next(steps), 3 * len(posed) + 1)

    show_step()
    joined = list[Any]()
    for pose, camera in posed:
        model = triangulated(pose, camera, database, whole.seed)
        show_step()
        model = adjusted(model, whole.focal.source is not FocalSource.GIVEN).model
        show_step()
        pose = {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
        joined.append(triangulated(pose, model.camera(1), database, whole.seed))
        show_step()
    components = whole.components_of(joined)
    sound = [component for component in components if not component.problem]
    if not sound:
        problem = without_poses(components[0].problem)
        return [], {"messages": [*messages, problem], "weak": []}
    mapped = {number for component in sound for number in component.kept.tolist()}
    found = {"messages": messages, "weak": sorted(tried - mapped)}
    return models_of_one_camera(sound), found


def _run(search: MapperSearch) -> tuple[list[Any], dict[str, Any]]:
    """Search for consistent models.

    Returns:
        models; "messages" and "lost" as of `MapperSearch.run`, and "tried": ids of the images that
        have the focal length of the models.
    """
    models, messages, lost = search.run()
    return models, {"messages": messages, "lost": lost, "tried": search.ids}


def _kept(
    folder: Path, ids: list[int], search: Callable[[], tuple[list[Any], dict[str, Any]]]
) -> tuple[list[Any], dict[str, Any]]:
    """Search for models of some keyframes, or read those that the search before left in a folder.

    Returns:
        models, and what else the search has found.
    """
    folder.mkdir(exist_ok=True)
    path = folder / "search.json"
    last = load_cached(path, load_json) or {}
    if last.get("ids") == ids:
        pc = import_pycolmap()
        models = [pc.Reconstruction(str(folder / f"model{k}")) for k in range(last["models"])]
        return models, last
    models, found = search()
    path.unlink(missing_ok=True)
    for k, model in enumerate(models):
        (folder / f"model{k}").mkdir(exist_ok=True)
        model.write(str(folder / f"model{k}"))
    with atomic(path) as part:
        part.write_text(json.dumps({"ids": ids, "models": len(models)} | found), encoding="utf-8")
    return models, found


def copy_database(source: Path, path: Path, ids: Sequence[int], camera: Any = None) -> None:
    """Copy the keypoints and verified matches of some images into a database of their own.

    Args:
        camera: `pycolmap.Camera` instead of that of the source.
    """
    pc = import_pycolmap()
    path.unlink(missing_ok=True)
    inside = set(ids)
    opened = contextlib.ExitStack()
    with opened:
        old = opened.enter_context(contextlib.closing(pc.Database.open(str(source))))
        new = opened.enter_context(contextlib.closing(pc.Database.open(str(path))))
        with pc.DatabaseTransaction(new):
            new.write_camera(camera or old.read_camera(1), use_camera_id=True)
            for rig in old.read_all_rigs():
                new.write_rig(rig, use_rig_id=True)
            for number in ids:
                new.write_frame(old.read_frame(number), use_frame_id=True)
                new.write_image(old.read_image(number), use_image_id=True)
                new.write_keypoints(number, old.read_keypoints(number))
            for pair, geometry in zip(*old.read_two_view_geometries(), strict=True):
                one, other = pc.pair_id_to_image_pair(pair)
                if one in inside and other in inside:
                    new.write_two_view_geometry(one, other, geometry)


# ---- Joints --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Joint:
    """Points that two models share, and the similarity (`pycolmap.Sim3d`) between the models.

    Attributes:
        one, other: numbers of the models. xyz: (n, 3) positions in both.
    """

    one: int
    other: int
    xyz: tuple[Array, Array]
    other_from_one: Any


class _Piece:
    """A model of a window, with the points of its keypoints."""

    def __init__(self, model: Any, keypoints: dict[int, Array]) -> None:
        self.arrays = read_arrays(model)
        self.point_of: dict[int, IntArray] = {}
        arrays = self.arrays
        start = np.searchsorted(arrays.image, np.arange(len(arrays.ids) + 1))
        for row, number in enumerate(arrays.ids.tolist()):
            mine = slice(start[row], start[row + 1])
            points = np.full(len(keypoints[number]), -1)
            points[arrays.keypoint[mine]] = arrays.point[mine]
            self.point_of[number] = points
        self.first_seen = np.unique(arrays.point, return_index=True)[1]  # (N,) observations

    def errors_px(self, xyz: Array, points: IntArray) -> Array:
        """Return the reprojection errors (n,) of positions (n, 3) of points (n,) of the model."""
        arrays = self.arrays
        seen = self.first_seen[points]
        pose = arrays.cam_from_world[arrays.image[seen]]
        in_cam = np.einsum("nij,nj->ni", pose[:, :, :3], xyz) + pose[:, :, 3]
        depth = np.where(in_cam[:, 2] > 0, in_cam[:, 2], np.nan)
        error = np.linalg.norm(in_cam[:, :2] / depth[:, None] - arrays.ideal[seen], axis=1)
        return np.asarray(np.nan_to_num(arrays.focal * error, nan=np.inf))

    def depth(self) -> float:
        """Return the median depth of the observed points."""
        return float(np.median(self.arrays.points_in_cam()[:, 2]))


def _common_points(one: _Piece, other: _Piece, pairs: MatchedPairs) -> IntArray:
    """Return the points (n, 2) of two models that are the same keypoint, or matching ones."""
    ids = one.arrays.ids, other.arrays.ids
    found = [np.empty((0, 2), np.int64)]
    for number in np.intersect1d(*ids).tolist():
        found.append(np.column_stack([one.point_of[number], other.point_of[number]]))
    first, second = pairs.image_ids.T
    for swap, (a, b) in enumerate(((first, second), (second, first))):
        for row in np.flatnonzero(np.isin(a, ids[0]) & np.isin(b, ids[1])).tolist():
            match = pairs.inliers[row]
            points = one.point_of[int(a[row])][match[:, swap]]
            found.append(np.column_stack([points, other.point_of[int(b[row])][match[:, 1 - swap]]]))
    table = np.concatenate(found)
    return np.unique(table[(table >= 0).all(1)], axis=0)


def _joint(
    number: tuple[int, int], one: _Piece, other: _Piece, pairs: MatchedPairs, options: WindowOptions
) -> _Joint | None:
    """Estimate the similarity between two models; None where too few points agree with it."""
    pc = import_pycolmap()
    common = _common_points(one, other, pairs)
    if len(common) < options.points:
        return None
    a = one.arrays.xyz[common[:, 0]]
    b = other.arrays.xyz[common[:, 1]]
    nearby = other.depth() * options.error_px / other.arrays.focal * 3  # depths are less exact
    ransac = {"max_error": nearby, "max_num_trials": 1000, "random_seed": 0}
    estimate = pc.estimate_sim3d_robust(a, b, ransac)
    found = estimate["tgt_from_src"] if estimate else None
    for _ in range(3):
        if found is None:
            return None
        agree = other.errors_px(found * a, common[:, 1]) <= options.error_px
        agree &= one.errors_px(found.inverse() * b, common[:, 0]) <= options.error_px
        if agree.sum() < options.points:
            return None
        joint = _Joint(*number, (a[agree], b[agree]), found)
        found = pc.estimate_sim3d(a[agree], b[agree])
    return joint


def aligned(
    models: Sequence[Any], pairs: MatchedPairs, options: WindowOptions = WindowOptions()
) -> list[dict[int, Any]]:
    """Align the models of windows that have enough points in common.

    Args:
        models: `pycolmap.Reconstruction` of each window; they may be of several components.
        pairs: verified matches of all their images.
    Returns:
        of each group of joined models, the largest first: `pycolmap.Sim3d` by the number of the
        model, into the frame of the largest.
    """
    pieces = [_Piece(model, pairs.keypoints) for model in models]
    joints = [
        joint
        for a, b in itertools.combinations(range(len(pieces)), 2)
        if (joint := _joint((a, b), pieces[a], pieces[b], pairs, options)) is not None
    ]
    size = [len(piece.arrays.ids) for piece in pieces]
    depth = [piece.depth() for piece in pieces]
    while True:
        ends = np.array([(j.one, j.other) for j in joints], np.int64).reshape(-1, 2)
        graph = csr_matrix((np.ones(len(ends)), ends.T), (len(pieces), len(pieces)))
        label = connected_components(graph, directed=False)[1]
        groups = [np.flatnonzero(label == k).tolist() for k in range(label.max(initial=-1) + 1)]
        placed = [_adjusted(group, joints, size, depth) for group in groups]
        worst = 0.0
        for joint in joints:
            group = placed[int(label[joint.one])]
            root = max(group, key=lambda k: size[k])
            apart = group[joint.one] * joint.xyz[0] - group[joint.other] * joint.xyz[1]
            error = float(np.median(np.linalg.norm(apart, axis=1))) / depth[root]
            doubt = error / len(apart) ** 0.5  # around a loop errors are alike: few points decide
            if error > options.contradiction and doubt > worst:
                worst = doubt
                contradicted = joint
        if not worst:
            return sorted(placed, key=lambda group: -sum(size[k] for k in group))
        joints = [joint for joint in joints if joint is not contradicted]


def _adjusted(
    group: list[int], joints: list[_Joint], size: list[int], depth: list[float]
) -> dict[int, Any]:
    """Place the models of a group in the frame of its largest, by all joints together.

    They start along the joints with most points; then distances of joined points are minimised with
    a robust loss.
    """
    root = max(group, key=lambda k: size[k])
    pc = import_pycolmap()
    placed = {root: pc.Sim3d()}
    mine = sorted((j for j in joints if j.one in group), key=lambda j: -len(j.xyz[0]))
    while len(placed) < len(group):
        joint = next(j for j in mine if (j.one in placed) != (j.other in placed))
        if joint.other in placed:
            placed[joint.one] = placed[joint.other] * joint.other_from_one
        else:
            placed[joint.other] = placed[joint.one] * joint.other_from_one.inverse()
    others = [k for k in group if k != root]
    if len(mine) <= len(others):  # a tree has no loop to close
        return placed
    few = [slice(None, None, max(1, len(j.xyz[0]) // 100)) for j in mine]  # 100 of each: time

    def unpacked(values: Array) -> dict[int, Any]:
        return placed | {
            k: pc.Sim3d(np.exp(v[6]), pc.Rotation3d(v[:3]), v[3:6] * depth[root])
            for k, v in zip(others, values.reshape(-1, 7), strict=True)
        }

    def residuals(values: Array) -> Array:
        at = unpacked(values)
        apart = [
            at[j.one] * j.xyz[0][part] - at[j.other] * j.xyz[1][part]
            for j, part in zip(mine, few, strict=True)
        ]
        return np.concatenate(apart).ravel() / depth[root]

    start = [
        np.r_[
            Rotation.from_matrix(placed[k].rotation.matrix()).as_rotvec(),
            placed[k].translation / depth[root],
            np.log(placed[k].scale),
        ]
        for k in others
    ]
    # of the loss: 2 % of the depth, the usual error of a triangulated point
    found = least_squares(residuals, np.concatenate(start), loss="soft_l1", f_scale=0.02)
    return unpacked(found.x)


# ---- One model -----------------------------------------------------------------------------------


def _merged_poses(models: Sequence[Any], place: dict[int, Any]) -> tuple[dict[int, Array], Any]:
    """Move the models of a group into one frame, and choose one pose for each image.

    An image of several windows has the pose of that in which it observes most points.

    Args:
        models: of all windows. place: similarity of each model of the group, by its number.
    Returns:
        cam_from_world (3, 4) by the id of the image; the `pycolmap.Camera` of the largest model.
    """
    largest = max(place, key=lambda k: models[k].num_reg_images())
    pose: dict[int, Array] = {}
    observed: dict[int, int] = {}
    for k, similarity in place.items():
        models[k].transform(similarity)
        for number in models[k].reg_image_ids():
            image = models[k].image(number)
            if image.num_points3D > observed.get(number, -1):
                observed[number] = image.num_points3D
                pose[number] = image.cam_from_world().matrix()
    return pose, copy.copy(models[largest].camera(1))


def triangulated(pose: dict[int, Array], camera: Any, database: Path, seed: int) -> Any:
    """Triangulate the verified matches of images with poses.

    Args:
        pose: cam_from_world (3, 4) by the id of the image. camera: `pycolmap.Camera` of all.
    Returns:
        `pycolmap.Reconstruction`.
    """
    pc = import_pycolmap()
    path = database.with_name("joined.db")
    copy_database(database, path, sorted(pose), camera)
    with contextlib.closing(pc.Database.open(str(path))) as db:
        cache = pc.DatabaseCache.create(db, pc.DatabaseCacheOptions())
    model = pc.Reconstruction()
    model.load(cache)
    for number, cam_from_world in sorted(pose.items()):
        frame_id = model.image(number).frame_id
        model.frame(frame_id).rig_from_world = pc.Rigid3d(cam_from_world)
        model.register_frame(frame_id)
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed, "extract_colors": False}
    options["triangulation"] = {"min_angle": 0.5}
    options["mapper"] = {"filter_min_tri_angle": 0.5}
    out = database.parent / "joined"
    out.mkdir(exist_ok=True)
    folders = str(path), str(out), str(out)
    return pc.triangulate_points(model, *folders, options=options)
