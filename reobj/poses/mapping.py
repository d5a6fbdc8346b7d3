"""Map keyframes: search for the mapper of pycolmap whose models of them are consistent.

Runs in the child process of `sfm`, on a database of features and matches. Models are adjusted
(`bundle`) and verified (`verification`): those of one component of the trajectory each are kept.

Start at `map_keyframes`. A mapper adjusts all images again and again: twice as many take more than
twice as long. Long paths are therefore cut into windows of consecutive keyframes, which overlap and
are mapped and verified separately. Two models are joined by the points that both have triangulated,
of images that are in both or of matches between them; this also closes loops between far windows.
All images are adjusted together at the end.
"""

from __future__ import annotations

import copy
import itertools
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from reobj.cameras import import_pycolmap
from reobj.files import spans
from reobj.poses.bundle import (
    INLIER_PX,
    SAME_FOCAL,
    adjusted,
    read_arrays,
    refine,
    submodel,
)
from reobj.poses.features import (
    MIN_MATCHES,
    MatchedPairs,
    focal_from_pairs,
    open_database,
    send_progress,
)
from reobj.poses.verification import (
    MIN_IMAGES,
    SURE_SIGMA,
    Component,
    FocalSource,
    by_size,
    confirmed,
    consistent_groups,
    measured,
)
from reobj.types import Array, IntArray

ADVICE = (  # where no cause is established
    "what helps: textured objects in view, more overlap, sharp images, moving sideways instead of "
    "only turning, measured intrinsics (--camera)"
)

FOCAL_GUESS = 0.8  # over the longer side, where it cannot be estimated (phones: .72-.85)


@dataclass(frozen=True, slots=True)
class Focal:
    """A focal length and how it is known.

    Attributes:
        value: over the longer side of the images; of a given camera it is not used.
    """

    value: float
    source: FocalSource


def estimate_focal(pairs: MatchedPairs, size: tuple[int, int], guess: float) -> Focal:
    """Estimate the focal length from verified matches, or fall back to a guess."""
    value = focal_from_pairs(pairs, size)
    if value is None:
        return Focal(guess, FocalSource.GUESS)
    return Focal(value, FocalSource.MATCHES)


def without_poses(problem: str, advice: str = ADVICE) -> str:
    """Report that there are no camera poses, why, and what helps."""
    return f"no camera poses: {problem}; {advice}; or give --poses; 2D identities need no poses"


# Fraction of the keyframes and of the verified matches in sound components that ends the search
# (measured: matches, right .91 to 1, wrong up to .89)
NEARLY_ALL = 0.9
# Largest centre_sigma of a component of the incremental mapper that needs no second mapper, where a
# focal length that does not come from the model agrees: it is evidence of its own
ACCEPTED_SIGMA = 0.0012
# Weight of the verified matches that the global mapper explains: it is right more often where the
# parallax is weak, and is preferred unless it explains clearly fewer
PREFERRED = 1.1


@dataclass
class MapperSearch:
    """Search for the mapper whose model is the most consistent.

    Attributes:
        frames: number in the video of each keyframe, by id, in the order of time.
        pairs: their verified matches. focal: of all images, as far as it is known before mapping.
        show: as `send_progress`, of registered images.
    """

    database: Path
    frames: dict[int, int]
    pairs: MatchedPairs
    focal: Focal
    seed: int
    show: Callable[[str, int, int], None] = send_progress

    def report(self, components: Sequence[Component]) -> list[str]:
        """Report an uncertain focal length, and keyframes without poses; why, if none has one."""
        if not sound(components):
            problem = "no pair of keyframes initialises a model"
            advice = ""
            if components:
                problem = components[0].problem
                advice = components[0].advice
            enough = self.pairs.enough
            planar = np.isnan(self.pairs.fundamental[enough, 0, 0]).sum()
            problem += (
                f"; {enough.sum()} pairs of {len(self.frames)} keyframes have at least "
                f"{MIN_MATCHES} verified matches, {planar} of them explained by a plane or a pure "
                "rotation"
            )
            return [without_poses(problem, advice or ADVICE)]
        messages = list[str]()
        largest = components[0]
        if largest.focal_source not in (FocalSource.GIVEN, FocalSource.MODEL):
            messages.append(
                f"frames {self._spans(largest.arrays.ids)} do not determine the focal "
                "length (the camera should turn as well as move): it is assumed to be "
                f"{largest.focal:.3g} x the longer side, depths are rough; give --camera "
                "fx,fy,cx,cy, or walk around the objects"
            )
        for component in components:
            ids = component.arrays.ids
            uncertain = np.setdiff1d(ids, component.kept)
            if component.problem and len(ids) >= MIN_IMAGES:
                messages.append(f"frames {self._spans(ids)} have no poses: {component.problem}")
            elif len(uncertain) and not component.problem:
                left_out = spans([self.frames[i] for i in uncertain.tolist()])
                messages.append(
                    f"keyframes {left_out} are left out: their poses are uncertain, "
                    "and a second mapper does not reproduce them"
                )
        return messages

    def _spans(self, ids: IntArray) -> str:
        """Name the frames of some keyframes, or of a path the first and the last."""
        frames = [self.frames[i] for i in ids.tolist()]
        return f"{frames[0]}-{frames[-1]}" if self.pairs.is_path else spans(frames)

    def best(self) -> list[Component]:
        """Choose the mapper whose sound components explain most of the verified matches.

        The incremental mapper is fast, and right where the parallax is strong; where it is weak, it
        ends in a wrong one of many nearly equal solutions more often than the global mapper, which
        needs a focal length. The focal length from the matches, or else from the incremental
        mapper, is kept while mapping: freed too early it drifts off, and images are joined wrongly.
        The last adjustment frees it.

        Returns:
            components, sound ones first, the largest first.
        """
        source = self.focal.source
        start = self.focal.value
        if source is FocalSource.GUESS:
            _set_focal(self.database, start, False)
            best = confirmed(self._components("incremental", False), [], source)
            if best and best[0].focal_source is FocalSource.MODEL:
                if self._is_sure(best, SURE_SIGMA):
                    return best
                start = best[0].focal
        if source is not FocalSource.GIVEN:
            _set_focal(self.database, start, True)
        best = self._components("incremental", True)
        if self._is_sure(best, ACCEPTED_SIGMA):
            return best
        other = self._components("global", True)
        # its focal length was held: that it agrees with the matches proves nothing
        if self._is_sure(other, SURE_SIGMA):
            return other
        by_incremental = confirmed(best, other, source)
        by_global = confirmed(other, best, source)
        is_global = PREFERRED * _explained(by_global) >= _explained(by_incremental)
        return by_global if is_global else by_incremental

    def _is_sure(self, components: list[Component], limit: float) -> bool:
        """True if sound components of strong geometry explain nearly all matches.

        Args:
            limit: of centre_sigma, where the focal length is given or the matches give the same.
        """
        known = self.focal.source
        accepted = list[Component]()
        for component in components:
            agrees = known is FocalSource.GIVEN or (
                known is FocalSource.MATCHES
                and abs(np.log(self.focal.value / component.focal)) < SAME_FOCAL
            )
            if component.centre_sigma <= (limit if agrees else SURE_SIGMA):
                accepted.append(component)
        registered = sum(component.registered for component in sound(accepted))
        matched = sum(map(len, self.pairs.inliers))
        return registered >= NEARLY_ALL and _explained(accepted) >= NEARLY_ALL * matched

    def _components(self, mapper: str, keep_intrinsics: bool) -> list[Component]:
        """Run a mapper and measure the consistent components of its models, largest first."""
        done = itertools.count(2)
        count = len(self.frames)
        step = "second mapper" if mapper == "global" else "mapping"

        def tick() -> None:
            self.show(step, min(next(done), count), count)

        self.show(step, 0, count if mapper == "incremental" else 0)
        ids = list(self.frames)
        models = _run_mapper(self.database, mapper, keep_intrinsics, ids, self.seed, tick)
        return self.components_of(models)

    def components_of(self, models: Sequence[Any]) -> list[Component]:
        """Adjust models and measure their consistent components, the largest first.

        The models are adjusted first: what is checked is what is returned.
        """
        self.show("adjusting", 0, 0)
        calibrate = self.focal.source is not FocalSource.GIVEN
        groups = [
            (group, whole)
            for whole in (adjusted(model, calibrate) for model in models)
            for group in consistent_groups(whole.arrays, self.pairs)
        ]
        taken = set[int]()
        components = list[Component]()
        for group, whole in sorted(groups, key=lambda found: -len(found[0])):
            kept = set(group.tolist()) - taken  # models may overlap
            own = whole
            if len(kept) < len(whole.arrays.ids):
                own = adjusted(submodel(whole.model, kept), calibrate)
            component = measured(own, self.pairs, self.frames, self.focal.source)
            components.append(component)
            taken |= set() if component.problem else kept
        return by_size(components)


def sound(components: Iterable[Component]) -> list[Component]:
    """Select the components without a problem."""
    return [component for component in components if not component.problem]


def _explained(components: list[Component]) -> int:
    """Count the verified matches that sound components explain."""
    return sum(component.explained for component in sound(components))


def models_of_one_camera(components: Iterable[Component]) -> list[Any]:
    """Adjust smaller sound components with the camera of the largest: one camera took all images.

    Images outside `kept` are left out; the frames are located later by points of the others.
    """
    models = list[Any]()
    for component in sound(components):
        model = component.model
        all_kept = len(component.kept) == len(component.arrays.ids)
        if not all_kept:
            model = submodel(model, set(component.kept.tolist()))
        if models:
            model.camera(1).model = models[0].camera(1).model
            model.camera(1).params = models[0].camera(1).params
        if models or not all_kept:
            refine(model)
        models.append(model)
    return models


# ---- Mappers of pycolmap -------------------------------------------------------------------------


def _set_focal(database: Path, focal: float, is_prior: bool) -> None:
    """Set the focal length in the database, over the longer side, without distortion."""
    with open_database(database) as db:
        camera = db.read_camera(1)
        focal_px = focal * max(camera.width, camera.height)
        camera.params = [focal_px, *camera.params[1:3], 0.0]
        camera.has_prior_focal_length = is_prior
        db.update_camera(camera)


def _run_mapper(
    database: Path,
    mapper: str,
    keep_intrinsics: bool,
    ids: list[int],
    seed: int,
    tick: Callable[[], None],
) -> list[Any]:
    """Run a mapper ("incremental" or "global") on some images and return all its models.

    Args:
        tick: is called by the incremental mapper for each image that it registers.
    """
    pc = import_pycolmap()
    out = database.parent / mapper
    out.mkdir(exist_ok=True)
    paths = (str(database), str(out), str(out))
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed}  # one: reproducible
    options["image_names"] = [f"{number:06d}" for number in ids]
    if mapper == "global":  # it does not recover from a wrong focal length, and shows no sign of it
        kept = {"refine_focal_length": False, "refine_extra_params": False}
        options["mapper"] = {"bundle_adjustment": kept}
        return list(pc.global_mapping(*paths, options=options).values())
    options |= {"multiple_models": True, "min_model_size": 3, "extract_colors": False}
    # cheaper global adjustment while mapping than by default: a full one follows
    options |= {"ba_global_frames_ratio": 2.0, "ba_global_points_ratio": 2.0}
    options |= {"ba_global_function_tolerance": 1e-5, "ba_global_max_refinements": 1}
    options |= {"ba_local_max_refinements": 1}
    options["ba_refine_focal_length"] = not keep_intrinsics
    options["ba_refine_extra_params"] = not keep_intrinsics
    # weak parallax is accepted too: the models are verified
    options["mapper"] = {"init_min_tri_angle": 4, "init_min_num_inliers": 40}
    options["mapper"] |= {"abs_pose_min_num_inliers": 15, "abs_pose_min_inlier_ratio": 0.15}
    options["mapper"] |= {"filter_min_tri_angle": 0.5}
    options["triangulation"] = {"min_angle": 0.5}
    found = pc.incremental_mapping(*paths, options=options, next_image_callback=tick)
    return list(found.values())


# ---- Windows -------------------------------------------------------------------------------------


WINDOW = 200  # keyframes of a window, for which a mapper needs a minute
OVERLAP = 40  # keyframes that two consecutive windows share
# Points in common that prove how two models are joined: they fix rotation, shift and scale
# (measured: right joins 191 to 386, a mirrored stretch 24, a free scale 0 to 3)
JOINT_POINTS = 100
# Largest reprojection error in the other model of a point that joins two models (COLMAP's
# abs_pose_max_error: windows are not adjusted together yet)
JOINT_PX = 3 * INLIER_PX
# Distance of joined points over their depth, median of two models, above which the other joins
# contradict theirs: five times the usual error of a triangulated point, more than a window drifts
CONTRADICTION = 0.1


def split(ids: Sequence[int], size: int = WINDOW, overlap: int = OVERLAP) -> list[Sequence[int]]:
    """Cut keyframes, in the order of time, into windows of nearly equal size that overlap."""
    count = max(1, round((len(ids) - overlap) / (size - overlap)))
    starts = np.linspace(0, max(len(ids) - overlap, 0), count + 1).round().astype(int)
    return [ids[a : b + overlap] for a, b in itertools.pairwise(starts.tolist())]


def map_keyframes(
    search: MapperSearch, size: int = WINDOW, overlap: int = OVERLAP
) -> tuple[list[Any], list[str]]:
    """Map keyframes: at once, or in windows whose models are joined.

    Photos without an order have no consecutive ones: they are mapped at once.

    Args:
        search: with all keyframes; its database has their features and verified matches.
        size, overlap: keyframes, as of `split`.
    Returns:
        models of the components, the largest first ([]: none is sound); messages.
    """
    windows = split(list(search.frames), size, overlap)
    in_windows = len(windows) > 1 and search.pairs.is_path
    components = _map_windows(windows, search) if in_windows else search.best()
    return models_of_one_camera(components), search.report(components)


def _map_windows(windows: list[Sequence[int]], whole: MapperSearch) -> list[Component]:
    """Map windows of keyframes and join their models.

    Args:
        whole: a search with all keyframes.
    Returns:
        components as of `MapperSearch.best`; those of the first window if none is sound.
    """
    lock = threading.Lock()

    def map_window(k: int) -> list[Component]:
        path = whole.database.parent / f"window{k}" / "database.db"
        path.parent.mkdir(exist_ok=True)
        with lock:
            copy_database(whole.database, path, windows[k])
        pairs = whole.pairs.only(windows[k])
        frames = {i: whole.frames[i] for i in windows[k]}
        search = MapperSearch(path, frames, pairs, whole.focal, whole.seed, lambda *_: None)
        return search.best()

    found = list[list[Component]]()
    send_progress("mapping", 0, len(windows))
    with ThreadPoolExecutor(2) as pool:  # mappers use one core each: reproducible
        for components in pool.map(map_window, range(len(windows))):
            found.append(components)
            send_progress("mapping", len(found), len(windows))
    models = [model for components in found for model in models_of_one_camera(components)]
    if not models:
        return found[0]
    send_progress("joining", 0, 0)
    calibrate = whole.focal.source is not FocalSource.GIVEN
    joined = list[Any]()
    for place in aligned(models, whole.pairs):
        pose, camera = _merged_poses(models, place)
        model = triangulated(pose, camera, whole.database, whole.seed)
        model = adjusted(model, calibrate).model
        pose = {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
        joined.append(triangulated(pose, model.camera(1), whole.database, whole.seed))
    return whole.components_of(joined)


def copy_database(source: Path, path: Path, ids: Sequence[int], camera: Any = None) -> None:
    """Copy the keypoints and verified matches of some images into a database of their own.

    Args:
        camera: `pycolmap.Camera` instead of that of the source.
    """
    pc = import_pycolmap()
    path.unlink(missing_ok=True)
    inside = set(ids)
    with open_database(source) as old, open_database(path) as new, pc.DatabaseTransaction(new):
        new.write_camera(camera or old.read_camera(1), use_camera_id=True)
        new.write_rig(old.read_rig(1), use_rig_id=True)
        for number in ids:
            new.write_frame(old.read_frame(number), use_frame_id=True)
            new.write_image(old.read_image(number), use_image_id=True)
            new.write_keypoints(number, old.read_keypoints(number))
        for pair, geometry in zip(*old.read_two_view_geometries(), strict=True):
            ends = pc.pair_id_to_image_pair(pair)
            if inside.issuperset(ends):
                new.write_two_view_geometry(*ends, geometry)


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
    """A model of a window, with the points of its keypoints and their median depth."""

    def __init__(self, model: Any, keypoints: dict[int, Array]) -> None:
        arrays = self.arrays = read_arrays(model)
        self.point_of = arrays.point_of_keypoints(keypoints)
        self.first_seen = np.unique(arrays.point, return_index=True)[1]  # (N,) observations
        self.depth = float(np.median(arrays.points_in_cam()[:, 2]))

    def errors_px(self, xyz: Array, points: IntArray) -> Array:
        """Return the reprojection errors (n,) of positions (n, 3) of points (n,) of the model."""
        arrays = self.arrays
        seen = self.first_seen[points]
        pose = arrays.cam_from_world[arrays.image[seen]]
        in_cam = np.einsum("nij,nj->ni", pose[:, :, :3], xyz) + pose[:, :, 3]
        depth = np.where(in_cam[:, 2] > 0, in_cam[:, 2], np.nan)
        error = np.linalg.norm(in_cam[:, :2] / depth[:, None] - arrays.ideal[seen], axis=1)
        return np.asarray(np.nan_to_num(arrays.focal * error, nan=np.inf))


def _common_points(one: _Piece, other: _Piece, pairs: MatchedPairs) -> IntArray:
    """Return the points (n, 2) of two models that are the same keypoint, or matching ones."""
    found = [np.empty((0, 2), np.int64)]
    for number in one.point_of.keys() & other.point_of.keys():
        found.append(np.column_stack([one.point_of[number], other.point_of[number]]))
    for ends, match in zip(pairs.image_ids.tolist(), pairs.inliers, strict=True):
        for (i, rows), (j, other_rows) in itertools.permutations(zip(ends, match.T, strict=True)):
            if i in one.point_of and j in other.point_of:
                points = one.point_of[i][rows], other.point_of[j][other_rows]
                found.append(np.column_stack(points))
    table = np.concatenate(found)
    return np.unique(table[(table >= 0).all(1)], axis=0)


def _joint(
    number: tuple[int, int], one: _Piece, other: _Piece, pairs: MatchedPairs
) -> _Joint | None:
    """Estimate the similarity between two models; None where too few points agree with it."""
    pc = import_pycolmap()
    common = _common_points(one, other, pairs)
    if len(common) < JOINT_POINTS:
        return None
    a = one.arrays.xyz[common[:, 0]]
    b = other.arrays.xyz[common[:, 1]]
    nearby = other.depth * JOINT_PX / other.arrays.focal * 3  # depths are less exact
    ransac = {"max_error": nearby, "max_num_trials": 1000, "random_seed": 0}
    estimate = pc.estimate_sim3d_robust(a, b, ransac)
    found = estimate["tgt_from_src"] if estimate else None
    for _ in range(3):
        if found is None:
            return None
        agree = other.errors_px(found * a, common[:, 1]) <= JOINT_PX
        agree &= one.errors_px(found.inverse() * b, common[:, 0]) <= JOINT_PX
        if agree.sum() < JOINT_POINTS:
            return None
        joint = _Joint(*number, (a[agree], b[agree]), found)
        found = pc.estimate_sim3d(a[agree], b[agree])
    return joint


def aligned(models: Sequence[Any], pairs: MatchedPairs) -> list[dict[int, Any]]:
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
        if (joint := _joint((a, b), pieces[a], pieces[b], pairs)) is not None
    ]
    size = [len(piece.arrays.ids) for piece in pieces]
    depth = [piece.depth for piece in pieces]
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
            if error > CONTRADICTION and doubt > worst:
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
            at[j.one] * j.xyz[0][rows] - at[j.other] * j.xyz[1][rows]
            for j, rows in zip(mine, few, strict=True)
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
    with open_database(path) as db:
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
