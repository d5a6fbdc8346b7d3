"""Features and matches of keyframes in a pycolmap database, and the focal length from matches.

RootSIFT by OpenCV; pairs in sequence and by retrieval, or by supplied poses; verification by
pycolmap. Results in the database are kept, so that keyframes can be added. Keyframes that repeat
the view of an earlier one are not mapped but registered by PnP afterwards: they add little to a
model, and a mapper takes longer for each image in it.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from reobj.cameras import import_pycolmap
from reobj.poses.bundle import FOCAL_RANGE, INLIER_PX
from reobj.types import Array, BoolArray, Floats, Image, IntArray


def send_progress(stage: str, done: int, total: int) -> None:
    """Print a line of progress for `sfm.Child.run`; total 0: the stage has no steps."""
    print("reobj:", stage, done, total, flush=True)


def open_database(path: Path) -> Any:
    """Open a `pycolmap.Database`, a context manager."""
    return import_pycolmap().Database.open(str(path))


def extract_features(
    database: Path, images: Any, ids: Sequence[int], boxes: Mapping[int, Array], camera: Any
) -> None:
    """Write keyframes and their RootSIFT features into a database that does not have them yet.

    Args:
        images: (h, w, 3), BGR, by id. ids: of the keyframes, above 0. boxes: (M, 4) xyxy by id,
            pixels of the images: no features there. camera: `pycolmap.Camera` with id 1.
    """
    pc = import_pycolmap()
    threads = cv2.getNumThreads()
    with open_database(database) as db, ThreadPoolExecutor(2) as pool:
        if not db.exists_camera(1):
            db.write_camera(camera, use_camera_id=True)
            rig = pc.Rig(rig_id=1)
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
        todo = [number for number in ids if not db.exists_image(number)]
        cv2.setNumThreads(1)
        if todo:
            send_progress("features", 0, len(todo))
        features = pool.map(lambda number: root_sift(images[number], boxes[number]), todo)
        for done, (number, (xy, descriptors)) in enumerate(zip(todo, features, strict=True), 1):
            image = pc.Image(name=f"{number:06d}", camera_id=1, image_id=number)
            db.write_image(image, use_image_id=True)
            frame = pc.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
            db.write_keypoints(number, xy)
            sift = pc.FeatureDescriptors(pc.FeatureExtractorType.SIFT, descriptors)
            db.write_descriptors(number, sift)
            send_progress("features", done, len(todo))
        cv2.setNumThreads(threads)


def root_sift(bgr: Image, boxes: Array) -> tuple[npt.NDArray[np.float32], Image]:
    """Detect features outside the boxes and describe them by RootSIFT.

    Args:
        boxes: (M, 4) xyxy, pixels of the image.
    Returns:
        xy: (N, 2) COLMAP pixels. descriptors: (N, 128).
    Ref: Lowe, IJCV 2004; Arandjelovic and Zisserman, CVPR 2012.
    """
    gray = cv2.cvtColor(np.ascontiguousarray(bgr), cv2.COLOR_BGR2GRAY)
    mask = np.full(gray.shape, 255, np.uint8)
    for x1, y1, x2, y2 in np.maximum(boxes.reshape(-1, 4), 0):
        mask[math.floor(y1) : math.ceil(y2), math.floor(x1) : math.ceil(x2)] = 0
    for contrast in (0.02, 0.007):  # OpenCV's default: .04; the second for plain walls
        # the 1200 strongest: 2000 are slower and no better (measured)
        sift: Any = cv2.SIFT.create(nfeatures=1200, contrastThreshold=contrast)
        keypoints, descriptors = sift.detectAndCompute(gray, mask)
        if len(keypoints) >= 500:
            break
    if descriptors is None or not len(keypoints):
        return np.empty((0, 2), np.float32), np.empty((0, 128), np.uint8)
    # OpenCV has the centre of the first pixel at (0, 0), COLMAP at (.5, .5)
    xy = np.array([k.pt for k in keypoints], np.float32) + np.float32(0.5)  # (N, 2)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)) * 512
    return xy, np.minimum(root, 255).astype(np.uint8)


MAX_RATIO = 0.8  # of angles or distances to the best and the second best (Lowe, IJCV 2004; COLMAP)
RETRIEVED = 6  # most similar keyframes with which one is matched; time grows with it
UNORDERED = 20  # the same of photos whose order says nothing (usual: 20 to 50)
ALL_PAIRS = 30  # keyframes of which all pairs are matched: 435 pairs
MIN_MATCHES = 30  # verified matches of a pair that count as evidence (COLMAP registers from 30 on)


def choose_pairs(
    path: Sequence[int], ids: Sequence[int], vlad: Floats, retrieved: int = RETRIEVED
) -> list[tuple[int, int]]:
    """Choose all pairs of a few keyframes, else sequential pairs and retrieved ones.

    Sequential: COLMAP's quadratic overlap.

    Args:
        path: ids along the path of the camera, which may pass a keyframe several times.
        ids: of the keyframes, in the order of time. vlad: (K, D) of `vlad_vectors`.
        retrieved: most similar keyframes of each.
    """
    count = len(ids)
    if count <= ALL_PAIRS:
        return list(itertools.combinations(ids, 2))
    pairs = {(ids[i], ids[i + (1 << k)]) for k in range(12) for i in range(count - (1 << k))}
    for offset in (1, 2, 4):  # neighbours where the path comes back to earlier keyframes
        pairs |= set(zip(path[:-offset], path[offset:], strict=True))
    if vlad.shape[1]:  # the most similar keyframes close loops
        similarity = vlad @ vlad.T  # (K, K)
        order = np.arange(count)
        similarity[np.abs(order[:, None] - order) <= 2] = -np.inf  # matched already
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :retrieved]
        pairs |= {(ids[i], ids[j]) for i, row in enumerate(best.tolist()) for j in row}
    return sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})


def match_pairs(
    database: Path, pairs: Sequence[tuple[int, int]], seed: int, stage: str = "match"
) -> None:
    """Match pairs of images and verify them by two-view geometry; verified pairs are skipped.

    Args:
        pairs: ids of images in the database. stage: of the line of progress; "": none.
    """
    pc = import_pycolmap()
    listed = database.parent / "pairs.txt"
    verification = pc.TwoViewGeometryOptions()
    ransac = verification.ransac
    ransac.random_seed = seed  # else two runs differ
    # COLMAP: 100 and 3; the same inliers in less time (measured)
    ransac.min_num_trials = 30
    ransac.dyn_num_trials_multiplier = 1.0
    with open_database(database) as db:
        todo = [pair for pair in pairs if not db.exists_two_view_geometry(*pair)]
    if stage and todo:
        send_progress(stage, 0, len(todo))
    unit: dict[int, Floats] = {}
    step = 100  # pairs between two lines of progress; their descriptors are in memory
    with ThreadPoolExecutor(2) as pool:
        for start in range(0, len(todo), step):
            chunk = todo[start : start + step]
            numbers = {number for pair in chunk for number in pair}
            with open_database(database) as db:
                unit = {n: unit[n] if n in unit else _unit_descriptors(db, n) for n in numbers}
                one, other = ([unit[pair[side]] for pair in chunk] for side in (0, 1))
                for pair, match in zip(chunk, pool.map(_matches, one, other), strict=True):
                    db.write_matches(*pair, match)
            listed.write_text("".join(f"{i:06d} {j:06d}\n" for i, j in chunk), encoding="utf-8")
            pc.verify_matches(str(database), str(listed), verification)
            if stage:
                send_progress(stage, start + len(chunk), len(todo))


def _descriptors(db: Any, number: int) -> Image:
    """Read the descriptors (n, 128) of an image."""
    return np.asarray(db.read_descriptors(number).data)


def _unit_descriptors(db: Any, number: int) -> Floats:
    """Read the descriptors (n, 128) of an image as unit vectors."""
    descriptors = _descriptors(db, number).astype(np.float32)
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.asarray(descriptors / np.maximum(norm, 1e-9))


def _matches(a: Floats, b: Floats) -> npt.NDArray[np.uint32]:
    """Match unit descriptors (N, 128) and (M, 128): mutual nearest neighbours, with ratio test.

    Returns:
        (n, 2) rows of a and of b.
    """
    if min(len(a), len(b)) < 2:
        return np.empty((0, 2), np.uint32)
    cosine = a @ b.T  # (N, M)
    rows = np.arange(len(a))
    best = cosine.argmax(1)
    top = cosine[rows, best]
    cosine[rows, best] = -1
    good = _distinct(top, cosine.max(1))
    cosine[rows, best] = top
    rows = rows[good]
    best = best[good]
    top = top[good]
    rivals = cosine[:, best]  # (N, n)
    rivals[rows, np.arange(len(rows))] = -1
    mutual = _distinct(top, rivals.max(0, initial=-1))
    return np.column_stack([rows[mutual], best[mutual]]).astype(np.uint32)


def _distinct(top: Floats, second: Floats) -> BoolArray:
    """Apply the ratio test to cosines of the best and of the second best."""
    angle, rival = (np.arccos(np.clip(cosine, -1, 1)) for cosine in (top, second))
    most = 0.7  # radians (COLMAP's max_distance)
    return np.asarray((angle < MAX_RATIO * rival) & (angle < most), bool)


WORDS = 64  # visual words (Jegou et al.: 16 to 256)


def visual_words(database: Path, ids: Sequence[int], seed: int) -> Floats:
    """Cluster the descriptors of some keyframes.

    Args:
        ids: of the keyframes in the database.
    Returns:
        (W, 128); W is 0 where the keyframes have too few features.
    """
    with open_database(database) as db:
        found = [db.num_descriptors_for_image(number) for number in ids]
        step = max(1, sum(found) // 6000)  # to cluster all takes long
        offset = -np.cumsum([0, *found[:-1]]) % step
        sample = np.concatenate([
            _descriptors(db, number)[first::step]
            for number, first in zip(ids, offset.tolist(), strict=True)
        ]).astype(np.float32)  # fmt: skip
    if len(sample) < WORDS:
        return np.empty((0, 128), np.float32)
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.1)
    start = cv2.KMEANS_PP_CENTERS
    return np.asarray(cv2.kmeans(sample, WORDS, np.empty(0), stop, 1, start)[2], np.float32)


def vlad_vectors(database: Path, ids: Sequence[int], words: Floats) -> Floats:
    """Describe each keyframe by one vector (K, D): unit sums of residuals to each visual word.

    Args:
        ids: of the keyframes in the database. words: (W, 128) of `visual_words`.
    Ref: Jegou et al., CVPR 2010.
    """
    vlad = np.zeros((len(ids), *words.shape), np.float32)  # (K, W, 128)
    with open_database(database) as db:
        for number, sums in zip(ids if len(words) else (), vlad, strict=False):
            rows = _descriptors(db, number)
            # argmin |d - w|^2 = argmax d'w - |w|^2 / 2
            nearest = (rows @ words.T - 0.5 * (words**2).sum(1)).argmax(1)  # (n,)
            np.add.at(sums, nearest, rows - words[nearest])
    vlad /= np.maximum(np.linalg.norm(vlad, axis=2, keepdims=True), 1e-9)
    return vlad.reshape(len(ids), words.size)


def choose_posed_pairs(steps: Array) -> IntArray:
    """Choose the pairs of K keyframes with supplied poses to match: neighbours in time and in pose.

    In pose, to close loops: the 4 nearest of those up to 8 keyframe steps away.

    Args:
        steps: (K, 6) of `keyframes.path_steps`.
    Returns:
        (P, 2) rows of the keyframes, the lower one first.
    """
    rows = np.arange(len(steps))
    apart = np.abs(rows[:, None] - rows)
    distance = np.linalg.norm(steps[:, None] - steps, axis=2)  # (K, K)
    distance[apart <= 4] = np.inf
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :4]  # (K, 4)
    i, rank = np.nonzero(np.take_along_axis(distance, nearest, 1) <= 8)
    loops = np.column_stack([i, nearest[i, rank]])
    pairs = np.concatenate([np.argwhere(np.isin(apart, (1, 2, 4))), loops])
    return np.unique(np.sort(pairs, 1), axis=0)


# ---- Verified matches and their focal length -----------------------------------------------------


@dataclass(frozen=True, slots=True)
class MatchedPairs:
    """Verified matches of the image pairs in a database.

    Attributes:
        image_ids: (P, 2) of each pair, the lower first. inliers: of each pair the matching
            keypoints (n, 2). keypoints: (N, 2) pixels by image id.
        fundamental: (P, 3, 3), NaN where the pair has none (planar, or a pure rotation).
        is_path: consecutive images show the same scene (`in_order`); of photos without an order
            neighbours in the list say nothing.
    """

    image_ids: IntArray
    inliers: list[IntArray]
    keypoints: dict[int, Array]
    fundamental: Array
    is_path: bool = True

    @property
    def matches(self) -> IntArray:
        """Count the verified matches of each pair (P,)."""
        return np.array([len(found) for found in self.inliers], np.int64)

    @property
    def enough(self) -> BoolArray:
        """Mark the pairs (P,) with as many verified matches as register an image."""
        return np.asarray(self.matches >= MIN_MATCHES, bool)

    def in_order(self, ids: Sequence[int]) -> bool:
        """True if at least half of consecutive images match: they follow a path."""
        matched = set(map(tuple, self.image_ids[self.enough].tolist()))
        steps = list(itertools.pairwise(ids))
        return 2 * sum(step in matched for step in steps) >= len(steps)

    def only(self, ids: Sequence[int]) -> MatchedPairs:
        """Return the pairs of some images."""
        rows = np.flatnonzero(np.isin(self.image_ids, ids).all(1))
        return dataclasses.replace(
            self,
            image_ids=self.image_ids[rows],
            inliers=[self.inliers[row] for row in rows],
            keypoints={i: self.keypoints[i] for i in ids},
            fundamental=self.fundamental[rows],
        )


def read_pairs(database: Path) -> MatchedPairs:
    """Read keypoints and verified matches."""
    pc = import_pycolmap()
    general = {int(pc.TwoViewGeometryConfiguration.UNCALIBRATED),
               int(pc.TwoViewGeometryConfiguration.CALIBRATED)}  # fmt: skip
    with open_database(database) as db:
        pair_ids, geometries = db.read_two_view_geometries()
        keypoints = {
            image.image_id: np.asarray(db.read_keypoints(image.image_id), np.float64)[:, :2]
            for image in db.read_all_images()
        }
    unknown = np.full((3, 3), np.nan)
    fundamental = [
        g.F if int(g.config) in general and g.F is not None else unknown for g in geometries
    ]
    return MatchedPairs(
        np.array([pc.pair_id_to_image_pair(p) for p in pair_ids], np.int64).reshape(-1, 2),
        [np.asarray(g.inlier_matches, np.int64) for g in geometries],
        keypoints,
        np.array(fundamental).reshape(-1, 3, 3),
    )


def focal_from_pairs(pairs: MatchedPairs, size: tuple[int, int]) -> float | None:
    """Estimate the focal length that turns fundamental matrices into essential ones.

    E = K' F K has two equal singular values for the true K. The cost of each focal length on a grid
    is the median over pairs of 1 - s2 / s1: half of the pairs may be wrong, and there is no start
    value and no local minimum. Photos without an order have many pairs of few matches, which
    determine a fundamental matrix badly: there a pair counts once for each MIN_MATCHES of them.

    Args:
        size: (w, h) of the images.
    Returns:
        focal length over the longer side; None with too few pairs.
    Ref: Mendonca and Cipolla, CVPR 1999.
    """
    used = pairs.enough & np.isfinite(pairs.fundamental[:, 0, 0])
    F = pairs.fundamental[used]  # (P, 3, 3)
    if len(F) < 10:  # among fewer, some wrong pairs decide
        return None
    tried = np.geomspace(*FOCAL_RANGE, 161)  # (S,) 1 % apart
    K = np.zeros((len(tried), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = tried * max(size)
    K[:, 0, 2] = size[0] / 2
    K[:, 1, 2] = size[1] / 2
    K[:, 2, 2] = 1
    E = np.swapaxes(K, 1, 2)[:, None] @ F[None] @ K[:, None]  # (S, P, 3, 3)
    s = np.linalg.svd(E, compute_uv=False)
    counts = 1 if pairs.is_path else pairs.matches[used] // MIN_MATCHES
    cost = np.median(np.repeat(1 - s[..., 1] / s[..., 0], counts, axis=1), 1)  # (S,)
    best = int(cost.argmin())
    is_inside = 0 < best < len(cost) - 1
    return float(tried[best]) if is_inside else None


# ---- Repeated views ------------------------------------------------------------------------------


MAP_ALL_OF = 100  # keyframes up to which all are mapped, in about a minute
# Keyframes added in a second attempt are all mapped, but only registered where more than this
# number are mapped already: mapping takes minutes
MAP_MORE_TO = 300
# Median displacement of the matches, over the width: half of that between consecutive keyframes
REPEATED_FLOW = 0.06
REPEATED_MATCHES = 3 * MIN_MATCHES  # verified ones, which register a keyframe with certainty
CANDIDATES = 4  # mapped keyframes with which one is compared; time grows with it
BLOCK = 32  # keyframes that are compared at once with mapped ones


def find_repeated(
    database: Path,
    ids: Sequence[int],
    extract: Callable[[Sequence[int]], None],
    width: int,
    seed: int,
    is_video: bool,
    before: Mapping[int, int],
    map_all_of: int = MAP_ALL_OF,
    map_more_to: int = MAP_MORE_TO,
    block: int = BLOCK,
) -> dict[int, int]:
    """Find for each keyframe the mapped one whose view it repeats.

    Keyframes are compared with those mapped before them. Of a video every second one comes first:
    between two that repeat mapped views the third is left out, as frames are located by either.

    Args:
        ids: of keyframes, in the order of time. extract: writes the features of some of them into
            the database. width: of the images, px. is_video: there are frames between keyframes.
        before: result of an earlier attempt with fewer keyframes, which is kept; or empty.
    Returns:
        by id: the keyframe whose view is repeated; its own id: it is to be mapped; 0: left out.
    """
    if len(ids) <= map_all_of:
        extract(ids)
        return {number: number for number in ids}
    view_of = dict(before)
    new = [number for number in ids if number not in view_of]
    mapped = sum(number == view for number, view in view_of.items())
    if before and mapped <= map_more_to:  # they are where the steps were too wide
        extract(new)
        return view_of | {number: number for number in new}
    first = [*ids[::2], *ids[1::2][-1:]] if is_video and not before else new
    extract(first)
    compared = {*first, *(number for number, view in view_of.items() if view)}
    words = visual_words(database, sorted(compared), seed)
    limit_px = np.inf if before else REPEATED_FLOW * width
    search = _ViewSearch(database, words, view_of, limit_px, seed)
    search.add(first, "views", block)
    is_repeat = {number: view not in (0, number) for number, view in view_of.items()}
    for one, number, other in zip(ids, ids[1:], ids[2:], strict=False):
        if number not in view_of and is_repeat.get(one) and is_repeat.get(other):
            view_of[number] = 0
    rest = [number for number in ids if number not in view_of]
    extract(rest)
    search.add(rest, "views again", block)
    return view_of


class _ViewSearch:
    """Compare keyframes with the ones that will be mapped.

    Attributes:
        words: (W, 128) of `visual_words`. view_of: as of `find_repeated`, is extended.
        limit_px: largest displacement of a repeated view; infinite: no further one is mapped.
        mapped: keyframes to map. vlad: (M, D) of them.
    """

    def __init__(
        self, database: Path, words: Floats, view_of: dict[int, int], limit_px: float, seed: int
    ) -> None:
        self.database = database
        self.words = words
        self.view_of = view_of
        self.limit_px = limit_px
        self.seed = seed
        self.keypoints: dict[int, Array] = {}
        self.mapped = np.array([i for i, view in view_of.items() if i == view], np.int64)
        self.vlad = vlad_vectors(database, self.mapped.tolist(), words)

    def add(self, numbers: Sequence[int], step: str, size: int) -> None:
        """Find whether keyframes repeat the view of one that is mapped already, `size` at once."""
        for start in range(0, len(numbers), size):
            block = numbers[start : start + size]
            self._add_block(block)
            send_progress(step, start + len(block), len(numbers))

    def _add_block(self, block: Sequence[int]) -> None:
        vlad = vlad_vectors(self.database, block, self.words)
        ranked = np.argsort(-vlad @ self.vlad.T, axis=1, kind="stable")[:, :CANDIDATES]
        candidates = dict(zip(block, self.mapped[ranked].tolist(), strict=True))
        self.view_of |= {number: number for number in block}
        half = CANDIDATES // 2
        for few in (slice(half), slice(half, None)):  # the most similar often suffice
            others = {i: candidates[i][few] for i in block if self.view_of[i] == i}
            pairs = sorted({(min(i, j), max(i, j)) for i, js in others.items() for j in js})
            match_pairs(self.database, pairs, self.seed, stage="")
            with open_database(self.database) as db:
                for number, js in others.items():
                    flow = [self._flow(db, j, number) for j in js]
                    if min(flow, default=np.inf) <= self.limit_px:
                        self.view_of[number] = js[int(np.argmin(flow))]
        is_mapped = np.array([self.view_of[number] == number for number in block], bool)
        self.mapped = np.concatenate([self.mapped, np.array(block, np.int64)[is_mapped]])
        self.vlad = np.concatenate([self.vlad, vlad[is_mapped]])

    def _flow(self, db: Any, one: int, other: int) -> float:
        """Return the median displacement of the verified matches, px; infinite with too few."""
        ends = sorted((one, other))
        matches = np.asarray(db.read_two_view_geometry(*ends).inlier_matches, np.int64)
        if len(matches) < REPEATED_MATCHES:
            return float("inf")
        for image in ends:
            if image not in self.keypoints:
                self.keypoints[image] = np.asarray(db.read_keypoints(image))[:, :2]
        low, high = (self.keypoints[i][rows] for i, rows in zip(ends, matches.T, strict=True))
        return float(np.median(np.linalg.norm(low - high, axis=1)))


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
    names = {f"{number:06d}" for number in {*model.reg_image_ids(), *ids}}
    with open_database(database) as db:
        initial = db.read_camera(1)
        db.update_camera(model.camera(1))  # a cache takes it from the database
        cache = pc.DatabaseCache.create(db, pc.DatabaseCacheOptions({"image_names": names}))
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
