"""Keyframes of a long video that repeat the view of an earlier one: they are not mapped.

A camera that comes back takes keyframes of views that are mapped already. They add little to a
model, and a mapper takes longer for each image in it. They are registered by PnP after mapping.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import import_pycolmap
from reobj.poses.bundle import INLIER_PX
from reobj.poses.child_job import send_progress
from reobj.poses.features import MIN_MATCHES, match_pairs, visual_words, vlad_vectors
from reobj.types import Array, Floats


@dataclass(frozen=True, slots=True)
class RedundancyOptions:
    """When a keyframe repeats the view of an earlier one.

    Attributes:
        map_all_of: up to this number all keyframes are mapped (chosen: it takes a minute).
        map_more_to: keyframes that are added in a second attempt are all mapped, but only
            registered where more than this number are mapped already (chosen: it takes minutes).
        flow: median displacement of the matches, over the width: half of that between consecutive
            keyframes (`FlowOptions.max_flow`).
        matches: verified ones, which register a keyframe with certainty (chosen: three times those
            from which COLMAP registers an image).
        candidates: mapped keyframes with which one is compared (chosen; more take longer).
        block: keyframes that are compared at once with those mapped before them.
    """

    map_all_of: int = 100
    map_more_to: int = 300
    flow: float = 0.06
    matches: int = 3 * MIN_MATCHES
    candidates: int = 4
    block: int = 32


def find_repeated(
    database: Path,
    ids: Sequence[int],
    extract: Callable[[Sequence[int]], None],
    width: int,
    seed: int,
    is_video: bool,
    before: Mapping[int, int] | None = None,
    options: RedundancyOptions = RedundancyOptions(),
) -> dict[int, int]:
    """Find for each keyframe the mapped one whose view it repeats.

    Keyframes are compared with those mapped before them. Of a video every second one comes first:
    between two that repeat mapped views the third is left out, as frames are located by either.

    Args:
        ids: of keyframes, in the order of time. extract: writes the features of some of them into
            the database. width: of the images, px. is_video: there are frames between keyframes.
        before: result of an earlier attempt with fewer keyframes, which is kept.
    Returns:
        by id: the keyframe whose view is repeated; its own id: it is to be mapped; 0: left out.
    """
    if len(ids) <= options.map_all_of:
        extract(ids)
        return {number: number for number in ids}
    view_of = dict(before or {})
    new = [number for number in ids if number not in view_of]
    mapped = sum(number == view for number, view in view_of.items())
    if before and mapped <= options.map_more_to:  # they are where the steps were too wide
        extract(new)
        return view_of | {number: number for number in new}
    first = [*ids[::2], *ids[1::2][-1:]] if is_video and not before else new
    extract(first)
    compared = {*first, *(number for number, view in view_of.items() if view)}
    words = visual_words(database, sorted(compared), seed)
    limit_px = np.inf if before else options.flow * width
    search = _ViewSearch(database, words, view_of, limit_px, seed, options)

    def add(numbers: Sequence[int], step: str) -> None:
        for start in range(0, len(numbers), options.block):
            block = numbers[start : start + options.block]
            search.add(block)
            send_progress(step, start + len(block), len(numbers))

    add(first, "views")
    around = zip(ids, ids[1:], ids[2:], strict=False)
    is_repeat = {number: view not in (0, number) for number, view in view_of.items()}
    for one, number, other in around:
        if number not in view_of and is_repeat.get(one) and is_repeat.get(other):
            view_of[number] = 0
    rest = [number for number in ids if number not in view_of]
    extract(rest)
    add(rest, "views again")
    return view_of


class _ViewSearch:
    """Compare keyframes with those that are to be mapped.

    Attributes:
        words: (W, 128) of `features.visual_words`. view_of: as of `find_repeated`, is extended.
        limit_px: largest displacement of a repeated view; infinite: no further one is mapped.
        mapped: keyframes to map. vlad: (M, D) of them.
    """

    def __init__(
        self,
        database: Path,
        words: Floats,
        view_of: dict[int, int],
        limit_px: float,
        seed: int,
        options: RedundancyOptions,
    ) -> None:
        self.database = database
        self.words = words
        self.view_of = view_of
        self.seed = seed
        self.options = options
        self.keypoints: dict[int, Array] = {}
        self.mapped = np.array([i for i, view in view_of.items() if i == view], np.int64)
        self.vlad = vlad_vectors(database, self.mapped.tolist(), words)
        self.limit_px = limit_px

    def add(self, block: Sequence[int]) -> None:
        """Find whether some keyframes repeat the view of one that is mapped already."""
        vlad = vlad_vectors(self.database, block, self.words)
        count = self.options.candidates
        ranked = np.argsort(-vlad @ self.vlad.T, axis=1, kind="stable")[:, :count]  # (b, count)
        candidates = dict(zip(block, self.mapped[ranked].tolist(), strict=True))
        self.view_of |= {number: number for number in block}
        for few in (slice(count // 2), slice(count // 2, count)):  # the most similar often suffice
            others = {i: candidates[i][few] for i in block if self.view_of[i] == i}
            pairs = sorted({(min(i, j), max(i, j)) for i, js in others.items() for j in js})
            match_pairs(self.database, pairs, self.seed, stage="")
            with contextlib.closing(import_pycolmap().Database.open(str(self.database))) as db:
                for number, js in others.items():
                    flow = [self._flow(db, j, number) for j in js]
                    if min(flow, default=np.inf) <= self.limit_px:
                        self.view_of[number] = js[int(np.argmin(flow))]
        is_mapped = np.array([self.view_of[number] == number for number in block], bool)
        self.mapped = np.concatenate([self.mapped, np.array(block, np.int64)[is_mapped]])
        self.vlad = np.concatenate([self.vlad, vlad[is_mapped]])

    def _flow(self, db: Any, one: int, other: int) -> float:
        """Return the median displacement of the verified matches, px; infinite with too few."""
        low, high = sorted((one, other))
        matches = np.asarray(db.read_two_view_geometry(low, high).inlier_matches, np.int64)
        if len(matches) < self.options.matches:
            return float("inf")
        for image in (low, high):
            if image not in self.keypoints:
                self.keypoints[image] = np.asarray(db.read_keypoints(image))[:, :2]
        shift = self.keypoints[low][matches[:, 0]] - self.keypoints[high][matches[:, 1]]
        return float(np.median(np.linalg.norm(shift, axis=1)))


def register(model: Any, database: Path, ids: Sequence[int], seed: int) -> list[int]:
    """Register images in a model by PnP on its points, which do not change.

    Args:
        model: `pycolmap.Reconstruction`; gets the images. ids: of images with verified matches.
    Returns:
        those that were registered.
    """
    if ids:
        send_progress("registering", 0, 0)
    pc = import_pycolmap()
    names = [f"{number:06d}" for number in sorted({*model.reg_image_ids(), *ids})]
    with contextlib.closing(pc.Database.open(str(database))) as db:
        initial = db.read_camera(1)
        db.update_camera(model.camera(1))  # a cache takes it from the database
        cache = pc.DatabaseCache.create(db, pc.DatabaseCacheOptions({"image_names": set(names)}))
        db.update_camera(initial)
    mapper = pc.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    options = pc.IncrementalMapperOptions(
        {
            "abs_pose_max_error": INLIER_PX,
            "abs_pose_min_num_inliers": MIN_MATCHES,
            "abs_pose_min_inlier_ratio": 0.5,
            "abs_pose_refine_focal_length": False,
            "abs_pose_refine_extra_params": False,
            "num_threads": 1,
            "random_seed": seed,
        }
    )
    matched = [number for number in ids if cache.exists_image(number)]  # it has no others
    registered = [number for number in matched if mapper.register_next_image(options, number)]
    mapper.end_reconstruction(False)
    return registered
