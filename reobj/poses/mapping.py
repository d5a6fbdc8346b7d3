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
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.spatial.transform import Rotation

from reobj.cameras import import_pycolmap
from reobj.files import spans
from reobj.poses.bundle import (
    INLIER_PX,
    SAME_FOCAL,
    Adjusted,
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
    JOINT_POINTS,
    MIN_IMAGES,
    SURE_SIGMA,
    ZOOM_LOG,
    Component,
    FocalSource,
    confirmed,
    consistent_groups,
    constant_focal,
    count_explained,
    measured,
)
from reobj.types import Array, IntArray

ADVICE = (  # where no cause is established
    "what helps: textured objects in view, more overlap, sharp images, moving sideways instead of "
    "only turning, measured intrinsics (--camera)"
)

ADJUSTING = "adjusting"  # step of the progress: adjustment and verification of models

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


# Size of a component with directions only over the largest: it measures nothing, and identities end
# where it begins; frames of a smaller one join the tracks of their neighbours
LEAST_TURNING = 0.25


def directions_only(frames: str, problem: str) -> str:
    """Report that frames have rotations but no sound positions, and what that means."""
    return (
        f"frames {frames} have directions only: {problem}. Identities rest on directions, sizes "
        "and distances on usual sizes of the categories; one step to the side, with the objects in "
        "view, measures them"
    )


# Fraction of the keyframes and of the verified matches in sound components that ends the search
# (matches, measured: right .91-1, wrong up to .89; the same limit for keyframes)
NEARLY_ALL = 0.9
# Largest centre_sigma of a component of the incremental mapper that needs no second mapper, where a
# focal length that does not come from the model agrees: it is evidence of its own. A
# higher limit saves the time of second mappers (wrong models: from .0011 on,
# benchmarks/RESULTS.md)
ACCEPTED_SIGMA = 0.0012
# Weight of the verified matches that the global mapper explains: it is right more often where
# the parallax is weak. A higher weight prefers it with fewer matches
PREFERRED = 1.1


class MapperSearch:
    """Search for the mapper whose model is the most consistent.

    Attributes:
        ids: of the keyframes in the order of time. frames: their numbers in the video, for
            messages. pairs: their verified matches.
        focal: of all images, as far as it is known before mapping. guess: used in its place where
            the matches no longer determine it.
        show: as `send_progress`, of registered images. turn_focal: over the longer side, of a
            camera that turns on one spot (`turning`); NaN: unknown.
    """

    def __init__(
        self,
        database: Path,
        frames: dict[int, int],
        pairs: MatchedPairs,
        focal: Focal,
        guess: float,
        seed: int,
        show: Callable[[str, int, int], None] = send_progress,
        turn_focal: float = np.nan,
    ) -> None:
        self.database = database
        self.ids = list(frames)
        self.frames = frames
        self.pairs = pairs
        self.focal = focal
        self.guess = guess
        self.seed = seed
        self.show = show
        self.turn_focal = turn_focal

    def run(self) -> tuple[list[Any], list[str], list[str], list[float]]:
        """Try mappers until sound components contain nearly all keyframes.

        Images of another focal length are left out of `ids` as soon as they are found.

        Returns:
            models of the components ([]: none is sound), those of sound positions first, then the
            largest; messages about the focal length; messages about keyframes without poses;
            `direction_sigma` of each model.
        """
        zooms = list[tuple[int, int, float]]()
        for _ in range(3):  # each without the images of other focal lengths found before
            best, messages = self._best()
            others, changes = self._other_focal(best)
            if not len(others):
                break
            zooms += changes
            excluded = set(others.tolist())
            self.ids = [i for i in self.ids if i not in excluded]
            self.pairs = self.pairs.only(self.ids)
            if self.focal.source is FocalSource.MATCHES:  # of several focal lengths until now
                camera = best[0].arrays.camera
                self.focal = estimate_focal(self.pairs, (camera.width, camera.height), self.guess)
        else:
            changing = "the focal length keeps changing"
            best = [replace(c, problem=changing, direction_sigma=0.0) for c in best]
        if self.focal.source is FocalSource.GIVEN and zooms:  # which of them is the camera's?
            why = "its images were taken at another focal length than that of the given camera"
            best = [
                c if self._has_its_focal(c) else replace(c, problem=why, direction_sigma=0.0)
                for c in best
            ]
        sound = [component for component in best if not component.problem]
        largest = max((c.registered for c in best if not c.problem or c.direction_sigma), default=0)
        turning = [
            c
            for c in best
            if c.problem
            and c.direction_sigma
            and c.registered >= LEAST_TURNING * largest
            # at a wrong guess both mappers turn alike
            and (
                c.focal_source is not FocalSource.GUESS
                or abs(np.log(c.focal / self.turn_focal)) < ZOOM_LOG
            )
        ]
        if not sound and not turning:
            problem = best[0].problem if best else "no pair of keyframes initialises a model"
            advice = (best[0].advice if best else "") or ADVICE
            return [], [], [without_poses(f"{problem}; {self._match_counts()}", advice)], []
        messages = [
            f"the focal length changed between frames {self.frames[a]} and {self.frames[b]} "
            f"(x {ratio:.2f}): only the frames of one focal length have poses; do not zoom"
            for a, b, ratio in zooms
        ] + messages
        sigma = [0.0] * len(sound) + [component.direction_sigma for component in turning]
        lost = self._lost(best, sound + turning)
        return models_of_one_camera(sound + turning), messages, lost, sigma

    def _lost(self, components: list[Component], kept: list[Component]) -> list[str]:
        """Report the keyframes without poses, and those with directions only."""
        lost = list[str]()
        for component in kept:
            uncertain = np.setdiff1d(component.arrays.ids, component.kept)
            if len(uncertain):
                frames = spans([self.frames[i] for i in uncertain.tolist()])
                lost.append(
                    f"keyframes {frames} are left out: their poses are uncertain, and a second "
                    "mapper does not reproduce them"
                )
        for component in components:
            ids = component.arrays.ids.tolist()
            if component.problem and any(component is other for other in kept):
                lost.append(directions_only(self._range(ids), component.problem))
            elif component.problem and len(ids) >= MIN_IMAGES:
                lost.append(f"frames {self._range(ids)} have no poses: {component.problem}")
        return lost

    def _other_focal(
        self, components: list[Component]
    ) -> tuple[npt.NDArray[Any], list[tuple[int, int, float]]]:
        """Find images of another focal length than most, and the changes (`constant_focal`)."""
        if not self.pairs.is_path:  # the photo before does not show the same points
            return np.empty(0), []
        known = [c for c in components if c.focal_source is not FocalSource.GUESS]
        # with little parallax a zoom cannot be observed
        known = [c for c in known if not c.problem] or known
        return constant_focal([component.arrays for component in known])

    def _range(self, ids: list[int]) -> str:
        """Return the first and last frame of some keyframes; all, of photos without an order."""
        frames = [self.frames[i] for i in ids]
        return f"{frames[0]}-{frames[-1]}" if self.pairs.is_path else spans(frames)

    def _match_counts(self) -> str:
        """Describe the matches of the keyframes for a message."""
        enough = self.pairs.enough
        planar = int(np.isnan(self.pairs.fundamental[enough, 0, 0]).sum())
        return (
            f"{enough.sum()} pairs of {len(self.ids)} keyframes have at least {MIN_MATCHES} "
            f"verified matches, {planar} of them explained by a plane or a pure rotation"
        )

    def _best(self) -> tuple[list[Component], list[str]]:
        """Choose the mapper whose sound components explain most of the verified matches.

        The incremental mapper is fast, and right where the parallax is strong; where it is weak, it
        ends in a wrong one of many nearly equal solutions more often than the global mapper, which
        needs a focal length and is preferred unless it explains clearly fewer matches. The focal
        length from the matches, or else from the incremental mapper, is kept while mapping: freed
        too early it drifts off, and images are joined wrongly. The last adjustment frees it.
        """
        source = self.focal.source
        start = self.focal.value
        if source is FocalSource.GUESS:
            _set_focal(self.database, start, False)
            best = confirmed(self._components("incremental", False), [], source)
            if best and best[0].focal_source is FocalSource.MODEL:
                if self._is_sure(best, SURE_SIGMA):
                    return best, []
                start = best[0].focal
        if source is not FocalSource.GIVEN:
            _set_focal(self.database, start, True)
        best = self._components("incremental", True)
        if not self._is_sure(best, ACCEPTED_SIGMA):
            other = self._components("global", True)
            # its focal length was held: that it agrees with the matches proves nothing
            if self._is_sure(other, SURE_SIGMA):
                best = other
            else:
                by_incremental = confirmed(best, other, source)
                by_global = confirmed(other, best, source)
                weighted = PREFERRED * np.array(_explained(by_global))
                best = by_incremental
                if tuple(weighted) >= _explained(by_incremental):
                    best = by_global
        given = source is FocalSource.GIVEN
        if given or not best or best[0].problem or best[0].focal_source is FocalSource.MODEL:
            return best, []
        ids = best[0].arrays.ids.tolist()
        return best, [
            f"frames {self._range(ids)} do not determine the focal "
            "length (the camera should turn as well as move): it is assumed to be "
            f"{start:.3g} x the longer side, depths are rough; give --camera fx,fy,cx,cy, or walk "
            "around the objects"
        ]

    def _is_sure(self, components: list[Component], limit: float) -> bool:
        """True if sound components of strong geometry explain nearly all matches.

        Args:
            limit: of centre_sigma, where the focal length is given or the matches give the same.
        """
        accepted = list[Component]()
        for component in components:
            agrees = self.focal.source is FocalSource.GIVEN or (
                self.focal.source is FocalSource.MATCHES
                and abs(np.log(self.focal.value / component.focal)) < SAME_FOCAL
            )
            most = limit if agrees else SURE_SIGMA
            if not component.problem and component.centre_sigma <= most:
                accepted.append(component)
        registered = sum(component.registered for component in accepted)
        matched = sum(map(len, self.pairs.inliers))
        return registered >= NEARLY_ALL and _explained(accepted)[0] >= NEARLY_ALL * matched

    def _components(self, mapper: str, keep_intrinsics: bool) -> list[Component]:
        """Run a mapper and measure the consistent components of its models, largest first.

        The models are adjusted first: what is checked is what is returned.
        """
        done = itertools.count(2)
        count = len(self.ids)
        step = "second mapper" if mapper == "global" else "mapping"

        def tick() -> None:
            registered = next(done)
            if registered <= count:
                self.show(step, registered, count)
            if registered == count:  # a global adjustment follows
                self.show(ADJUSTING, 0, 0)

        self.show(step, 0, count if mapper == "incremental" else 0)
        models = _run_mapper(self.database, mapper, keep_intrinsics, self.ids, self.seed, tick)
        return self.components_of(models)

    def components_of(self, models: Sequence[Any]) -> list[Component]:
        """Adjust models and measure their consistent components, the largest first."""
        self.show(ADJUSTING, 0, 0)
        given = self.focal.source is FocalSource.GIVEN
        groups = list[tuple[IntArray, Adjusted]]()
        for model in models:
            whole = adjusted(model, not given)
            found = consistent_groups(whole.arrays, self.pairs)
            groups += [(group, whole) for group in found]
        taken = set[int]()
        components = list[Component]()
        for group, whole in sorted(groups, key=lambda found: -len(found[0])):
            kept = set(group.tolist()) - taken  # models may overlap
            own = whole
            if len(kept) < len(whole.arrays.ids):
                own = adjusted(submodel(whole.model, kept), not given)
            component = measured(
                own.model,
                own.arrays,
                own.centre_sigma,
                count=len(self.ids),
                explained=int(count_explained(own.arrays, self.pairs).sum()),
                focal_source=FocalSource.MODEL if own.calibrated else self.focal.source,
            )
            components.append(component)
            taken |= set() if component.problem else kept
        return sorted(components, key=lambda c: (bool(c.problem), -c.registered))

    def _has_its_focal(self, component: Component) -> bool:
        """True if the focal length of a component, when freed, comes out as the given one."""
        free = adjusted(component.model, True)
        log = np.log(free.arrays.focal_over_size / component.focal)
        return free.calibrated and bool(abs(log) < ZOOM_LOG)


def models_of_one_camera(sound: list[Component]) -> list[Any]:
    """Adjust smaller components with the camera of the largest: one camera took all images.

    Images outside `kept` are left out; the frames are located later by points of the others.
    """
    models = list[Any]()
    for component in sound:
        model = component.model
        all_kept = len(component.kept) == len(component.arrays.ids)
        if not all_kept:
            model = submodel(model, set(component.kept.tolist()))
        if models:
            own = model.camera(1)
            camera = models[0].camera(1)
            own.model = camera.model
            own.params = camera.params
        if models or not all_kept:
            refine(model)
        models.append(model)
    return models


def _explained(components: list[Component]) -> tuple[int, int]:
    """Count the verified matches that sound components explain, and those of directions only."""
    sound = sum(c.explained for c in components if not c.problem)
    return sound, sum(c.explained for c in components if c.problem and c.direction_sigma)


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
    # cheaper global adjustment while mapping (COLMAP's ratios: 1.1); a full one follows
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
# Largest reprojection error in the other model of a point that joins two models (COLMAP's
# abs_pose_max_error: windows are not adjusted together yet)
JOINT_PX = 3 * INLIER_PX
# Distance of joined points over their depth, median of two models, above which the other joins
# contradict theirs: the drift of a window stays below
CONTRADICTION = 0.1


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


def split(ids: Sequence[int], size: int = WINDOW, overlap: int = OVERLAP) -> list[list[int]]:
    """Cut keyframes, in the order of their path, into windows of nearly equal size that overlap.

    Those of a window are in ascending order.
    """
    count = max(1, round((len(ids) - overlap) / (size - overlap)))
    starts = np.linspace(0, max(len(ids) - overlap, 0), count + 1).round().astype(int)
    return [sorted(ids[a : b + overlap]) for a, b in itertools.pairwise(starts.tolist())]


def map_keyframes(
    search: MapperSearch, size: int = WINDOW, overlap: int = OVERLAP
) -> tuple[list[Any], list[str], list[int], list[float]]:
    """Map keyframes: at once, or in windows whose models are joined.

    Args:
        search: with all keyframes; its database has their features and verified matches.
        size, overlap: keyframes, as of `split`.
    Returns:
        models of the components, the largest first ([]: none is sound); messages; keyframes whose
        windows alone do not determine their poses, to be registered in the joined models;
        `direction_sigma` of each model.
    """
    windows = split(_path(search.ids, search.pairs), size, overlap)
    if len(windows) == 1:
        models, messages, lost, sigma = search.run()
        return models, [*messages, *lost], [], sigma
    models, messages, tried = _map_windows(windows, search)
    if not models:
        return [], messages, [], []
    posed = [_merged_poses(models, place) for place in aligned(models, search.pairs)]
    del models  # memory
    sound, problem = _joined(posed, search)
    if problem:
        return [], [*messages, without_poses(problem)], [], []
    mapped = {number for component in sound for number in component.kept.tolist()}
    models = models_of_one_camera(sound)
    return models, messages, sorted(tried - mapped), [0.0] * len(models)


def _map_windows(
    windows: list[list[int]], whole: MapperSearch
) -> tuple[list[Any], list[str], set[int]]:
    """Map windows of keyframes.

    Args:
        whole: a search with all keyframes.
    Returns:
        models of all windows; messages; ids of the images that have the focal length of the models.
    """
    lock = threading.Lock()

    def map_window(k: int) -> tuple[list[Any], list[str], list[str], list[int]]:
        ids = windows[k]
        path = whole.database.parent / f"window{k}" / "database.db"
        path.parent.mkdir(exist_ok=True)
        frames = {i: whole.frames[i] for i in ids}
        known = (whole.focal, whole.guess, whole.seed, lambda *_: None)
        search = MapperSearch(path, frames, whole.pairs.only(ids), *known)
        with lock:
            copy_database(whole.database, path, ids)
        found, messages, lost, sigma = search.run()
        path.unlink()
        sound = [model for model, value in zip(found, sigma, strict=True) if not value]
        return sound, messages, lost, search.ids

    results = []
    send_progress("mapping", 0, len(windows))
    with ThreadPoolExecutor(2) as pool:  # mappers use one core each: reproducible
        for found in pool.map(map_window, range(len(windows))):
            results.append(found)
            send_progress("mapping", len(results), len(windows))
    models = [model for found, *_ in results for model in found]
    messages = [text for _, found, _, _ in results for text in found]
    if not models:
        messages += results[0][2]
    tried = {number for *_, found in results for number in found}
    return models, list(dict.fromkeys(messages)), tried


def _joined(
    posed: list[tuple[dict[int, Array], Any]], whole: MapperSearch
) -> tuple[list[Component], str]:
    """Triangulate the matches of all images of joined windows, and adjust them together.

    Args:
        posed: poses by image id, and camera, of each group of windows, as of `_merged_poses`.
    Returns:
        sound components; why there is none.
    """
    steps = itertools.count()

    def show_step() -> None:
        send_progress("joining", next(steps), 3 * len(posed) + 1)

    show_step()
    joined = list[Any]()
    for pose, camera in posed:
        model = triangulated(pose, camera, whole.database, whole.seed)
        show_step()
        model = adjusted(model, whole.focal.source is not FocalSource.GIVEN).model
        show_step()
        pose = {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
        joined.append(triangulated(pose, model.camera(1), whole.database, whole.seed))
        show_step()
    components = whole.components_of(joined)
    sound = [component for component in components if not component.problem]
    return sound, "" if sound else components[0].problem


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
    """A model of a window, with the points of its keypoints."""

    def __init__(self, model: Any, keypoints: dict[int, Array]) -> None:
        arrays = self.arrays = read_arrays(model)
        self.point_of = arrays.point_of_keypoints(keypoints)
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
    found = [np.empty((0, 2), np.int64)]
    for number in one.point_of.keys() & other.point_of.keys():
        found.append(np.column_stack([one.point_of[number], other.point_of[number]]))
    for (a, b), match in zip(pairs.image_ids.tolist(), pairs.inliers, strict=True):
        for i, j, ends in ((a, b, match.T), (b, a, match.T[::-1])):
            if i in one.point_of and j in other.point_of:
                found.append(
                    np.column_stack([one.point_of[i][ends[0]], other.point_of[j][ends[1]]])
                )
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
    nearby = other.depth() * JOINT_PX / other.arrays.focal * 3  # depths are less exact
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


def posed(pose: dict[int, Array], camera: Any, database: Path, path: Path) -> Any:
    """Make a `pycolmap.Reconstruction` of images with poses, without points.

    Args:
        pose: cam_from_world (3, 4) by the id of the image. camera: `pycolmap.Camera` of all.
        path: of a database of the images alone, which is made.
    """
    pc = import_pycolmap()
    copy_database(database, path, sorted(pose), camera)
    with open_database(path) as db:
        cache = pc.DatabaseCache.create(db, pc.DatabaseCacheOptions())
    model = pc.Reconstruction()
    model.load(cache)
    for number, cam_from_world in sorted(pose.items()):
        frame_id = model.image(number).frame_id
        model.frame(frame_id).rig_from_world = pc.Rigid3d(cam_from_world)
        model.register_frame(frame_id)
    return model


def triangulated(pose: dict[int, Array], camera: Any, database: Path, seed: int) -> Any:
    """Triangulate the verified matches of images with poses, as of `posed`."""
    path = database.with_name("joined.db")
    model = posed(pose, camera, database, path)
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed, "extract_colors": False}
    options["triangulation"] = {"min_angle": 0.5}
    options["mapper"] = {"filter_min_tri_angle": 0.5}
    out = database.parent / "joined"
    out.mkdir(exist_ok=True)
    folders = str(path), str(out), str(out)
    return import_pycolmap().triangulate_points(model, *folders, options=options)
