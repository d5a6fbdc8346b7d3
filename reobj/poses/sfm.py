"""Structure from motion by pycolmap, in a child process.

`reconstruct` maps keyframes of unknown poses; `triangulate` adds sparse points to supplied poses,
which stay as they are. A job is a dataclass that is sent to the child, which works in a folder:
aborts of COLMAP and its log stay there, progress is shown here. Features and matches are made by
`features`; which of the mapped models is kept is decided by `mapping`.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import os
import pickle
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, import_pycolmap, write_colmap
from reobj.files import Progress, writing
from reobj.poses.features import (
    MIN_MATCHES,
    UNORDERED,
    MatchedPairs,
    choose_pairs,
    choose_posed_pairs,
    extract_features,
    find_repeated,
    match_pairs,
    read_pairs,
    register,
    send_progress,
    visual_words,
    vlad_vectors,
)
from reobj.poses.keyframes import ImageFile, choose_posed_keyframes, path_steps, sharpest_images
from reobj.poses.mapping import (
    Focal,
    MapperSearch,
    directions_only,
    estimate_focal,
    map_keyframes,
    without_poses,
)
from reobj.poses.turning import estimate_turn, pin, turning_model
from reobj.poses.verification import FocalSource
from reobj.types import Array, IntArray

MakeProgress = Callable[[str, int], Progress]  # name and total of a step -> its progress line

# ---- The process ---------------------------------------------------------------------------------


class Child:
    """A process that does jobs of COLMAP in a folder, which is emptied.

    It starts at once, so that its imports take no time later. As a context manager it ends with the
    block, and is killed by an exception. It also ends when this process is killed.

    Args:
        log_path: receives the child's stderr; its folder is made.
    """

    def __init__(self, folder: Path, log_path: Path) -> None:
        self.folder = folder
        self.log_path = log_path
        shutil.rmtree(folder, ignore_errors=True)
        with writing(folder):
            folder.mkdir(parents=True)
        # -P: not the modules of the working directory; the package's own folder comes first
        command = [sys.executable, "-P", "-m", __name__, str(folder)]
        paths = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "OPENBLAS_NUM_THREADS": "1",  # pairs of images are matched side by side
        }
        pipe = subprocess.PIPE
        with open(log_path, "wb") as errors:
            self.process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=errors, env=environment
            )

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is not None:
            self.process.kill()
        with contextlib.suppress(BrokenPipeError):
            self.process.__exit__(kind, error, traceback)  # closes its pipes, waits

    def run(self, job: Any, progress: MakeProgress) -> Any:
        """Send a job, an object with a method `work(folder)`, and show its progress.

        Returns:
            what `work` returns; a text if the child stopped: why, and where its log is.
        """
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # why it ended is reported below
            pickle.dump(job, self.process.stdin)
            self.process.stdin.flush()
        line: Progress | None = None
        for words in self._messages():
            if words == DONE:
                break
            if not words and line is not None:
                line.step(0)
            if len(words) < 4 or words[0] != DONE[0]:
                continue
            stage = " ".join(words[1:-2])
            done, total = map(int, words[-2:])
            if line is None or line.stage != stage:
                if line is not None:
                    line.close()
                line = progress(stage, total)
            line.step(done - line.done)
        else:
            code = self.process.wait()
            reason = f"signal {-code}" if code < 0 else f"exit code {code}"
            return f"stopped ({reason}), see {self.log_path}"
        if line is not None:
            line.close()
        return pickle.loads((self.folder / RESULT).read_bytes())

    def _messages(self) -> Iterator[list[str]]:
        """Yield the words of each line up to DONE or the end; [] after ALIVE_S without one.

        One call of COLMAP takes minutes, in which the child can send nothing.
        """
        assert self.process.stdout is not None
        stream = self.process.stdout
        found = queue.SimpleQueue[list[str] | None]()

        def read() -> None:
            words: list[str] = []
            while words != DONE and (text := stream.readline()):
                words = text.decode(errors="replace").split()
                found.put(words)
            found.put(None)

        threading.Thread(target=read, daemon=True).start()
        while True:
            try:
                words = found.get(timeout=ALIVE_S)
            except queue.Empty:
                yield []
                continue
            if words is None:
                return
            yield words


DONE = ["reobj:", "done"]
ALIVE_S = 0.5  # of silence of the child, after which its progress line is drawn again
RESULT = "result.pickle"  # file of the child's folder


def serve(folder: Path) -> None:
    """Do the jobs that come on stdin (in the child).

    The process ends as soon as stdin does, also in the middle of a job: its parent is gone.
    """
    if sys.platform == "linux":  # at once, also in long calls of COLMAP that hold the interpreter
        pr_set_pdeathsig = 1  # of sys/prctl.h
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    jobs = queue.SimpleQueue[Any]()

    def read() -> None:
        try:
            with open(0, "rb", closefd=False) as stdin:  # sys.stdin's lock would block the end
                while True:
                    jobs.put(pickle.load(stdin))
        finally:
            os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    import_pycolmap().logging.minloglevel = 0  # stderr is the log file here
    while True:
        (folder / RESULT).write_bytes(pickle.dumps(jobs.get().work(folder)))
        print(*DONE, flush=True)


# ---- Keyframes of unknown poses ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Mapped:
    """Result of a reconstruction.

    Attributes:
        models: folders of COLMAP models, one for each component of the trajectory, the largest
            first; in native pixels, with the given image names. messages: for the user.
        direction_sigma: of each model, as of `Poses`.
        unmatched: ids of keyframes without a verified match with another one.
        view_of: as of `find_repeated`.
    """

    models: list[Path]
    messages: list[str]
    direction_sigma: Sequence[float] = ()
    unmatched: frozenset[int] = frozenset()
    view_of: Mapping[int, int] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MappingJob:
    """Keyframes to be mapped.

    Attributes:
        images: (h, w, 3) BGR by id, resized. frame_of: number in the video of each id, above 0, in
            the order of time. name_of: of the images in the models.
        boxes_of: (N, 4) xyxy of moving objects by id, native pixels: no features there.
        size: (w, h), native. camera: kept as it is; None: calibrated.
        focal_guess: over the longer side, used where it cannot be estimated from the matches.
        is_video: there are frames between the keyframes.
        view_of: of an earlier attempt with fewer keyframes (`Mapped`); its features and matches
            are in the folder.
    """

    images: ImageFile
    frame_of: Mapping[int, int]
    name_of: Mapping[int, str]
    boxes_of: Mapping[int, Array]
    size: tuple[int, int]
    camera: Camera | None
    focal_guess: float
    is_video: bool
    seed: int
    view_of: Mapping[int, int]

    def work(self, folder: Path) -> Mapped:
        """Reconstruct the keyframes into COLMAP models in the folder (child process)."""
        database = folder / "database.db"
        height, width = self.images.shape[:2]
        size = (width, height)
        guess = self.focal_guess
        if self.camera is not None:
            camera = _resized(self.camera, size)
        else:
            pc = import_pycolmap()
            focal_px = guess * max(size)
            camera = pc.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, *size)
        ids = list(self.frame_of)
        scale = np.tile(np.array(size) / self.size, 2)
        boxes = {number: xyxy * scale for number, xyxy in self.boxes_of.items()}

        def extract(chosen: Sequence[int]) -> None:
            extract_features(database, self.images, chosen, boxes, camera)

        view_of = find_repeated(
            database, ids, extract, width, self.seed, self.is_video, self.view_of
        )
        mapped = sorted({view for view in view_of.values() if view})
        vlad = vlad_vectors(database, mapped, visual_words(database, mapped, self.seed))
        path = [view_of[number] for number in ids if view_of[number]]
        match_pairs(database, choose_pairs(path, mapped, vlad), self.seed)
        every_pair = read_pairs(database)
        is_path = every_pair.only(mapped).in_order(mapped)
        if not is_path:
            more = choose_pairs(path, mapped, vlad, UNORDERED)
            match_pairs(database, more, self.seed, "match again")
            every_pair = read_pairs(database)
        pairs = dataclasses.replace(every_pair.only(mapped), is_path=is_path)
        focal = Focal(guess, FocalSource.GIVEN)
        if self.camera is None:
            focal = estimate_focal(pairs, size, guess)
        turn = estimate_turn(pairs, camera, False) if focal.source is FocalSource.GUESS else None
        turns = turn is not None and not turn.problem
        turn_focal = turn.camera.mean_focal_length() / max(size) if turn and turns else np.nan
        frames = {number: self.frame_of[number] for number in mapped}
        known = (focal, guess, self.seed)
        search = MapperSearch(database, frames, pairs, *known, turn_focal=turn_focal)
        models, messages, weak, sigma = map_keyframes(search)
        connected = sum(model.num_reg_images() ** 2 for model in models)
        if turn is None and 2 * connected < len(mapped) ** 2:
            turn = estimate_turn(pairs, camera, self.camera is not None)
        # models that connect half as many pairs of keyframes are better
        if turn is None or turn.problem or 2 * connected >= len(turn.ids) ** 2:
            turn = None
        else:
            model, moves = turning_model(turn, database)
            models = [model]
            sigma = [turn.spread_rad]
            turned = [self.frame_of[number] for number in turn.ids.tolist()]
            cause = f"the camera turns on one spot ({turn.quality})"
            messages = [directions_only(f"{min(turned)}-{max(turned)}", cause)]
        for model in models:
            inside = set(model.reg_image_ids())
            repeated = [i for i in ids if view_of[i] in inside and view_of[i] != i]
            added = register(model, database, [*repeated, *weak], self.seed)
            weak = [number for number in weak if number not in added]
            if turn is not None and not moves:
                pin(model)
        new = Path(tempfile.mkdtemp(dir=folder))
        paths = [new / str(k) for k in range(len(models))]
        for model, out in zip(models, paths, strict=True):
            self._write(model, out)
        matched = every_pair.image_ids[every_pair.enough]
        unmatched = frozenset(set(ids) - set(matched.ravel().tolist()))
        return Mapped(paths, messages, sigma, unmatched, view_of)

    def _write(self, model: Any, folder: Path) -> None:
        """Write a model in native pixels with the frames' names and coloured points."""
        height, width = self.images.shape[:2]
        for point_id, color in _colors(model, self.images).items():
            model.point3D(point_id).color = color
        scale = np.array(self.size) / (width, height)
        for image_id, image in model.images.items():
            image.name = self.name_of[image_id]
            for p in image.points2D if (scale != 1).any() else ():
                p.xy = p.xy * scale
        rescale(model.camera(1), self.size)
        folder.mkdir()
        model.write(str(folder))


def reconstruct(job: MappingJob, child: Child, progress: MakeProgress) -> Mapped:
    """Reconstruct keyframes into COLMAP models in a new folder of the child's."""
    if (count := len(job.frame_of)) < 3:
        problem = "no image has texture that can be tracked (black, blank or blurred)"
        return Mapped([], [without_poses(f"only {count} different views" if count else problem)])
    found: Mapped | str = child.run(job, progress)
    if isinstance(found, str):
        return Mapped([], [f"no camera poses: the reconstruction {found}; give --poses"])
    return found


# ---- Points of supplied poses --------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PointsJob:
    """Keyframes with poses whose points are triangulated.

    Attributes:
        images: K of (h, w, 3) BGR by id, 1 to K, resized. camera: native.
        cam_from_world: (K, 3, 4). pairs: (P, 2) rows of the keyframes to match.
    """

    images: ImageFile
    camera: Camera
    cam_from_world: Array
    pairs: IntArray
    seed: int

    def work(self, folder: Path) -> tuple[dict[str, Any], MatchedPairs, Any]:
        """Triangulate in the folder (child process).

        Returns:
            points, colors and visibility as of `Poses`, by rows of the keyframes, and `counts`
            (`_count_triangulated_matches`); the verified matches; their rays.
        """
        pc = import_pycolmap()
        database = folder / "database.db"
        count = len(self.cam_from_world)
        ids = range(1, count + 1)
        height, width = self.images.shape[:2]
        camera = _resized(self.camera, (width, height))
        extract_features(database, self.images, ids, dict.fromkeys(ids, np.empty((0, 4))), camera)
        match_pairs(database, [(i + 1, j + 1) for i, j in self.pairs.tolist()], self.seed)
        send_progress("triangulating", 0, 0)
        rows = np.arange(count)
        params = tuple(camera.params.tolist())
        resized = Camera(camera.model.name, camera.width, camera.height, params)
        status = np.full(count, "supplied")
        given = Poses(resized, rows, rows.astype(float), self.cam_from_world, status, "user")
        write_colmap(folder / "posed", given, [f"{number:06d}" for number in ids])
        options = {"num_threads": 1, "random_seed": self.seed, "extract_colors": False}
        (folder / "sparse").mkdir()
        model = pc.triangulate_points(
            pc.Reconstruction(str(folder / "posed")),
            str(database),
            str(folder),
            str(folder / "sparse"),
            options=options,
        )
        color_of = _colors(model, self.images)
        points = sorted(model.points3D.items())
        seen = [(e.image_id - 1, k) for k, (_, p) in enumerate(points) for e in p.track.elements]
        pairs = read_pairs(database)
        arrays = {
            "points": np.array([point.xyz for _, point in points]).reshape(-1, 3),
            "colors": np.array([color_of[i] for i, _ in points], np.uint8).reshape(-1, 3),
            "visibility": np.array(seen, np.int64).reshape(-1, 2),
            "counts": _count_triangulated_matches(pairs, model, count),
        }
        rays = {i: np.asarray(camera.cam_ray_from_img(xy)) for i, xy in pairs.keypoints.items()}
        return arrays, pairs, rays


def _count_triangulated_matches(pairs: MatchedPairs, model: Any, count: int) -> IntArray:
    """Count (K - 1, 2) the matches of consecutive keyframes, and how many are triangulated."""
    point_of = {
        i: np.array([p.point3D_id if p.has_point3D() else -1 for p in model.image(i).points2D])
        for i in range(1, count + 1)
    }
    counts = np.zeros((count - 1, 2), np.int64)
    for (i, j), matches in zip(pairs.image_ids.tolist(), pairs.inliers, strict=True):
        if j == i + 1:
            points = point_of[i][matches[:, 0]]
            same = (points == point_of[j][matches[:, 1]]) & (points >= 0)
            counts[i - 1] = len(matches), same.sum()
    return counts


# Fraction of the matched features that must be points of three images and more. Measured:
# studio_room .73, redkitchen .55, hololens_kitchen .51; redkitchen with inverted poses .005.
MIN_TRIANGULATED = 0.15
CheckMatches = Callable[[IntArray, IntArray, Array], float]  # as `check_matches`


def triangulate(
    poses: Poses,
    video: Any,
    *,
    size_px: int,
    seed: int,
    work_dir: Path,
    progress: MakeProgress = Progress,
    check: CheckMatches = lambda *_: np.nan,
) -> Poses:
    """Triangulate sparse points of the images from known poses.

    Keyframes and the pairs to match are selected by their poses. The fraction of the matched
    features that triangulate shows whether the poses explain the images.

    Args:
        video: a `Video`, iterated once. size_px: longer side to which its images are shrunk.
        work_dir: receives `points.log`, and scratch files while it works.
        check: refuses poses that contradict the matches, as `check_matches` does.
    Returns:
        the poses with points, colours and visibility (of keyframes). Where there is nothing to
        triangulate, or the poses do not explain the images, the unchanged poses with a message.
    """
    steps = path_steps(poses)
    keys = choose_posed_keyframes(steps)
    images = sharpest_images(poses, video, keys, size_px, progress("keyframes", len(poses.frame)))
    rows = np.array(sorted(images), np.int64)
    count = len(rows)
    if count < 2:
        return _without_points(poses, f"{count} images have a pose; two or more are needed")
    folder = work_dir / "points"
    with Child(folder, work_dir / "points.log") as child:
        file = ImageFile(folder / "keyframes.raw")
        for number, row in enumerate(rows.tolist(), 1):
            file.add(number, images[row])
        pairs = choose_posed_pairs(steps[rows])
        job = PointsJob(file, poses.camera, poses.cam_from_world[rows], pairs, seed)
        found = child.run(job, progress)
    shutil.rmtree(folder, ignore_errors=True)
    if isinstance(found, str):
        return _without_points(poses, f"the triangulation {found}")
    arrays, pairs, rays = found
    explained = check(rows, *_matched_rays(pairs, rays))
    image, point = arrays["visibility"].T
    views = np.bincount(point)[point]  # (M,) of the observed point
    # rays of two views often intersect by chance, as with sideways motion in another order
    triangulated = int((views >= min(3, count)).sum())
    matched = _count_matched(pairs)
    if not matched:
        return _without_points(poses, f"no features of {count} images could be matched")
    if not triangulated or triangulated < MIN_TRIANGULATED * matched:
        cause = "are the poses of this video, in this order, with this camera?"
        if explained > 0.5:  # of the matches; right poses: .6 and more
            cause = "the poses agree with the matches: too few views, or too little parallax"
        return _without_points(
            poses,
            f"with the supplied poses only {triangulated} of {matched} matched features of "
            f"{count} images triangulate (usual: half of them); {cause}",
        )
    arrays["visibility"] = np.column_stack([rows[image], point])
    messages = (*poses.messages, *_inconsistent(arrays.pop("counts"), poses.frame[rows]))
    return dataclasses.replace(poses, **arrays, messages=messages)


def _matched_rays(pairs: MatchedPairs, rays: Mapping[int, Array]) -> tuple[IntArray, Array]:
    """Return the keyframes (M, 2) of all verified matches, and their rays (M, 2, 2), z = 1.

    Args:
        rays: (N, 3) of the keypoints by image id.
    """
    both = zip(pairs.image_ids.tolist(), pairs.inliers, strict=True)
    found = [np.stack([rays[i][rows[:, 0]], rays[j][rows[:, 1]]], 1) for (i, j), rows in both]
    matched = np.concatenate([np.empty((0, 2, 3)), *found])  # (M, 2, 3)
    return np.repeat(pairs.image_ids - 1, pairs.matches, 0), matched[..., :2] / matched[..., 2:]


def _count_matched(pairs: MatchedPairs) -> int:
    """Count the features that have a verified match in another keyframe."""
    matched = [
        np.column_stack([np.full(len(rows), number), rows[:, side]])
        for ids, rows in zip(pairs.image_ids.tolist(), pairs.inliers, strict=True)
        for side, number in enumerate(ids)
    ]
    return len(np.unique(np.concatenate([np.empty((0, 2)), *matched]), axis=0))


# Fraction of their matches that must be one point (measured, least of a recording: rendered .71,
# studio_room .42, hololens_kitchen .14; redkitchen .09, and .003 where its Kinect lost track; ends
# of stretches that were moved 0 and .04)
MIN_TRIANGULATED_PAIR = 0.05


def _inconsistent(counts: IntArray, frame: IntArray) -> list[str]:
    """Report where matches of consecutive keyframes (K,) do not triangulate with supplied poses.

    Args:
        counts: (K - 1, 2) of `_count_triangulated_matches`. frame: (K,).
    """
    matches, triangulated = counts.T
    breaks = np.flatnonzero(
        (matches >= MIN_MATCHES) & (triangulated < MIN_TRIANGULATED_PAIR * matches)
    )
    if not len(breaks):
        return []
    runs = np.split(breaks, np.flatnonzero(np.diff(breaks) > 1) + 1)
    where = [f"{frame[run[0]]} and {frame[run[-1] + 1]}" for run in runs]
    return [
        f"the supplied poses are inconsistent between frames {listed(where)}: matches across do "
        "not triangulate; objects seen mostly there are likely misplaced"
    ]


def listed(names: Sequence[str], most: int = 5) -> str:
    """Join at most `most` names for a message, and count the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _without_points(poses: Poses, reason: str) -> Poses:
    return dataclasses.replace(poses, messages=(*poses.messages, f"no sparse points: {reason}"))


# ---- Colours and cameras -------------------------------------------------------------------------


def _colors(model: Any, images: ImageFile) -> dict[int, Any]:
    """Return the colour (3,) RGB of each point in the image that observed it first."""
    height, width = images.shape[:2]
    seen: dict[int, list[tuple[int, Any]]] = {}
    for point_id, point in model.points3D.items():
        first = point.track.elements[0]
        xy = model.image(first.image_id).point2D(first.point2D_idx).xy.astype(int)
        seen.setdefault(first.image_id, []).append((point_id, xy.clip(0, (width - 1, height - 1))))
    colors: dict[int, Any] = {}
    for image_id, points in seen.items():
        image = images[image_id]
        colors |= {point_id: image[y, x, ::-1] for point_id, (x, y) in points}
    return colors


def _resized(camera: Camera, size: tuple[int, int]) -> Any:
    """Make the `pycolmap.Camera` of resized images from a calibrated camera."""
    made = camera.to_pycolmap()
    rescale(made, size)
    made.has_prior_focal_length = True
    return made


def rescale(camera: Any, size: Sequence[int]) -> None:
    """Rescale a `pycolmap.Camera` to (w, h); of another aspect ratio: with two focal lengths."""
    width, height = size
    one_focal = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}
    two_focals = one_focal.get(camera.model.name)
    if abs(width / camera.width * camera.height - height) > 2 and two_focals:
        focal, x, y, *terms = camera.params
        camera.model = getattr(import_pycolmap().CameraModelId, two_focals)
        most = len(camera.params_info.split(",")) - 4
        camera.params = [focal, focal, x, y, *terms, *[0.0] * (most - len(terms))]
    camera.rescale(*size)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
