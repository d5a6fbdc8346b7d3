"""Search for the mapper of pycolmap whose models of the keyframes are consistent.

Runs in the child process of `sfm`, on a database of features and matches. Models are adjusted
(`bundle`) and verified (`verification`): those of one component of the trajectory each are kept.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reobj.cameras import import_pycolmap
from reobj.files import spans
from reobj.poses.bundle import SAME_FOCAL, Adjusted, adjusted, refine, submodel
from reobj.poses.child_job import send_progress
from reobj.poses.features import MIN_MATCHES, MatchedPairs, focal_from_pairs
from reobj.poses.verification import (
    Component,
    ConfirmationOptions,
    ConsistencyOptions,
    FocalSource,
    SoundnessOptions,
    ZoomOptions,
    confirmed,
    consistent_groups,
    constant_focal,
    count_explained,
    measured,
)
from reobj.types import IntArray

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


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Thresholds of `MapperSearch`: of its checks of models, and of the choice between mappers.

    Attributes:
        consistency, soundness, confirmation, zoom: of the checks (`verification`).
        nearly_all: fraction of the keyframes and of the verified matches in sound components that
            ends the search (matches, measured: right .91-1, wrong up to .89; keyframes: chosen).
        accepted_sigma: largest centre_sigma of a component of the incremental mapper that needs no
            second mapper, where a focal length that does not come from the model agrees: it is
            evidence of its own (chosen: time).
        preferred: weight of the verified matches that the global mapper explains (chosen: it is
            right more often where the parallax is weak; higher: it is kept with fewer matches).
    """

    consistency: ConsistencyOptions = field(default_factory=ConsistencyOptions)
    soundness: SoundnessOptions = field(default_factory=SoundnessOptions)
    confirmation: ConfirmationOptions = field(default_factory=ConfirmationOptions)
    zoom: ZoomOptions = field(default_factory=ZoomOptions)
    nearly_all: float = 0.9
    accepted_sigma: float = 0.0012
    preferred: float = 1.1


class MapperSearch:
    """Search for the mapper whose model is the most consistent.

    Attributes:
        ids: of the keyframes in the order of time. frames: their numbers in the video, for
            messages. pairs: their verified matches.
        focal: of all images, as far as it is known before mapping. guess: used in its place where
            the matches no longer determine it. options: of the checks and of the choice.
        show: is called with the name of the step, the number of registered images and of all.
    """

    def __init__(
        self,
        database: Path,
        frames: dict[int, int],
        pairs: MatchedPairs,
        focal: Focal,
        guess: float,
        seed: int,
        options: SearchOptions = SearchOptions(),
        show: Callable[[str, int, int], None] = send_progress,
    ) -> None:
        self.options = options
        self.show = show
        self.attempts = 0
        self.database = database
        self.ids = list(frames)
        self.frames = frames
        self.pairs = pairs
        self.focal = focal
        self.guess = guess
        self.seed = seed

    def run(self) -> tuple[list[Any], list[str], list[str]]:
        """Try mappers until sound components contain nearly all keyframes.

        Images of another focal length are left out of `ids` as soon as they are found.

        Returns:
            models of the components, the largest first ([]: none is sound); messages about the
            focal length; messages about keyframes without poses.
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
            best = [replace(c, problem="the focal length keeps changing") for c in best]
        if self.focal.source is FocalSource.GIVEN and zooms:  # which of them is the camera's?
            why = "its images were taken at another focal length than that of the given camera"
            best = [c if self._has_its_focal(c) else replace(c, problem=why) for c in best]
        sound = [component for component in best if not component.problem]
        if not sound:
            problem = best[0].problem if best else "no pair of keyframes initialises a model"
            advice = (best[0].advice if best else "") or ADVICE
            return [], [], [without_poses(f"{problem}; {self._match_counts()}", advice)]
        messages = [
            f"the focal length changed between frames {self.frames[a]} and {self.frames[b]} "
            f"(x {ratio:.2f}): only the frames of one focal length have poses; do not zoom"
            for a, b, ratio in zooms
        ] + messages
        lost = list[str]()
        for component in sound:
            uncertain = np.setdiff1d(component.arrays.ids, component.kept)
            if len(uncertain):
                frames = spans([self.frames[i] for i in uncertain.tolist()])
                lost.append(
                    f"keyframes {frames} are left out: their poses are uncertain, and a second "
                    "mapper does not reproduce them"
                )
        for component in best:
            ids = component.arrays.ids.tolist()
            if component.problem and len(ids) >= self.options.soundness.images:
                lost.append(f"frames {self._range(ids)} have no poses: {component.problem}")
        return models_of_one_camera(sound), messages, lost

    def _other_focal(
        self, components: list[Component]
    ) -> tuple[npt.NDArray[Any], list[tuple[int, int, float]]]:
        """Find images of another focal length than most, and the changes (`constant_focal`)."""
        if not self.pairs.is_path:  # the photo before does not show the same points
            return np.empty(0), []
        known = [c for c in components if c.focal_source is not FocalSource.GUESS]
        # with little parallax a zoom cannot be observed
        known = [c for c in known if not c.problem] or known
        return constant_focal([component.arrays for component in known], self.options.zoom)

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
        limits = self.options.confirmation
        if source is FocalSource.GUESS:
            _set_focal(self.database, start, False)
            best = confirmed(self._components("incremental", False), [], source, limits)
            if best and best[0].focal_source is FocalSource.MODEL:
                if self._is_sure(best, limits.sure_sigma):
                    return best, []
                start = best[0].focal
        if source is not FocalSource.GIVEN:
            _set_focal(self.database, start, True)
        best = self._components("incremental", True)
        if not self._is_sure(best, self.options.accepted_sigma):
            other = self._components("global", True)
            # its focal length was held: that it agrees with the matches proves nothing
            if self._is_sure(other, limits.sure_sigma):
                best = other
            else:
                by_incremental = confirmed(best, other, source, limits)
                by_global = confirmed(other, best, source, limits)
                weighted = self.options.preferred * _explained(by_global)
                best = by_global if weighted >= _explained(by_incremental) else by_incremental
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
            most = limit if agrees else self.options.confirmation.sure_sigma
            if not component.problem and component.centre_sigma <= most:
                accepted.append(component)
        registered = sum(component.registered for component in accepted)
        matched = sum(map(len, self.pairs.inliers))
        least = self.options.nearly_all
        return registered >= least and _explained(accepted) >= least * matched

    def _components(self, mapper: str, keep_intrinsics: bool) -> list[Component]:
        """Run a mapper and measure the consistent components of its models, largest first.

        The models are adjusted first: what is checked is what is returned.
        """
        done = itertools.count(2)
        count = len(self.ids)
        self.attempts += 1
        step = "mapping" if self.attempts == 1 else "mapping again"
        if mapper == "global":
            step = "second mapper"

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
            found = consistent_groups(whole.arrays, self.pairs, self.options.consistency)
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
                options=self.options.soundness,
            )
            components.append(component)
            taken |= set() if component.problem else kept
        return sorted(components, key=lambda c: (bool(c.problem), -c.registered))

    def _has_its_focal(self, component: Component) -> bool:
        """True if the focal length of a component, when freed, comes out as the given one."""
        free = adjusted(component.model, True)
        log = np.log(free.arrays.focal_over_size / component.focal)
        return free.calibrated and bool(abs(log) < self.options.zoom.log)


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


def _explained(components: list[Component]) -> int:
    """Count the verified matches that sound components explain."""
    return sum(component.explained for component in components if not component.problem)


# ---- Mappers of pycolmap -------------------------------------------------------------------------


def _set_focal(database: Path, focal: float, is_prior: bool) -> None:
    """Set the focal length in the database, over the longer side, without distortion."""
    with contextlib.closing(import_pycolmap().Database.open(str(database))) as db:
        camera = db.read_all_cameras()[0]
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
    # global adjustment more rarely and less exactly than by default (chosen: time; one follows)
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
