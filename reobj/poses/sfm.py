"""Structure from motion by pycolmap, in a child process.

`reconstruct` maps keyframes of unknown poses; `triangulate` adds sparse points to supplied poses,
which stay as they are. Both hand keyframes and options over as files (`child_job`). Features and
matches are made by `features`; which of the mapped models is kept is decided by `mapping`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib
import json
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, import_pycolmap, write_colmap
from reobj.files import Progress, atomic, load_cached, load_json, load_npz, save_npz
from reobj.poses.child_job import (
    Child,
    ImageFile,
    read_job,
    send_progress,
    serve,
    write_job,
)
from reobj.poses.features import (
    MIN_MATCHES,
    UNORDERED,
    MatchedPairs,
    choose_pairs,
    choose_posed_pairs,
    extract_features,
    match_pairs,
    read_pairs,
    visual_words,
    vlad_vectors,
)
from reobj.poses.keyframes import choose_posed_keyframes, path_steps, sharpest_images
from reobj.poses.mapping import Focal, MapperSearch, estimate_focal, without_poses
from reobj.poses.redundancy import find_repeated, register
from reobj.poses.verification import FocalSource
from reobj.poses.windows import map_keyframes
from reobj.types import Array, IntArray

# ---- Keyframes of unknown poses ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Mapped:
    """Result of a reconstruction.

    Attributes:
        models: folders of COLMAP models, one for each component of the trajectory, the largest
            first; in native pixels, with the given image names. messages: for the user.
        unmatched: ids of keyframes without a verified match with another one.
    """

    models: list[Path]
    messages: list[str]
    unmatched: frozenset[int] = frozenset()


def mapping_child(work_dir: Path) -> Child:
    """Start the child process that maps below `work_dir`, with its log there."""
    return Child("reobj.poses.sfm", work_dir / "mapping", work_dir / "pycolmap.log")


def reconstruct(
    images: ImageFile,
    ids: Sequence[int],
    frames: Sequence[int],
    names: Sequence[str],
    moving_boxes: Sequence[Array],
    size: tuple[int, int],
    *,
    camera: Camera | None,
    focal_guess: float,
    is_video: bool,
    seed: int,
    child: Child,
    work_dir: Path,
    progress: Callable[[str, int], Progress],
) -> Mapped:
    """Reconstruct keyframes into COLMAP models below `work_dir`.

    Features and matches stay in `work_dir/mapping`: a run that was killed, or one with more
    keyframes of the same video, continues from there.

    Args:
        images: (h, w, 3) BGR, resized. ids: of each, above 0, in the order of time.
        frames: their numbers in the video, for messages. names: of the images in the models.
        moving_boxes: (N, 4) xyxy of each image, native pixels: no features there.
        size: (w, h), native. camera: kept as it is; None: calibrated.
        focal_guess: over the longer side, used where it cannot be estimated from the matches.
        is_video: there are frames between the keyframes.
        child: `mapping_child` of `work_dir`.
    """
    folder = work_dir / "mapping"
    for old in work_dir.glob("sparse*"):
        shutil.rmtree(old)
    if len(images) < 3:
        problem = "no image has texture that can be tracked (black, blank or blurred)"
        if len(images):
            problem = f"only {len(images)} different views"
        return Mapped([], [without_poses(problem)])
    scale = np.tile(np.array(images.shape[1::-1]) / size, 2)
    boxes = [(xyxy * scale).tolist() for xyxy in moving_boxes]
    job = {
        "task": "map",
        "ids": list(ids),
        "frames": list(frames),
        "names": list(names),
        "boxes": boxes,
        "camera": None if camera is None else [camera.model, list(camera.params)],
        "size": size,
        "guess": focal_guess,
        "seed": seed,
        "is_video": is_video,
        "images": {
            str(number): hashlib.sha256(image.tobytes() + json.dumps(box).encode()).hexdigest()
            for number, image, box in zip(ids, images, boxes, strict=True)
        },
    }
    if not _may_continue(folder, job):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    write_job(folder, job, images)
    (folder / "messages.json").unlink(missing_ok=True)
    imports = threading.Thread(target=_import_ahead)

    def begin(stage: str, total: int) -> Progress:
        if stage == "mapping" and imports.ident is None:  # the child uses one core from now on
            imports.start()
        return progress(stage, total)

    problem = child.run(begin)
    if imports.ident is not None:
        imports.join()
    if not (folder / "messages.json").exists():
        (folder / "job.json").unlink()  # start afresh the next time: its database may be the cause
        return Mapped([], [f"no camera poses: the reconstruction {problem}; give --poses"])
    models = [
        model.replace(work_dir / model.name)
        for model in sorted(folder.glob("sparse*"), key=lambda p: (len(p.name), p.name))
    ]
    result = json.loads((folder / "messages.json").read_text(encoding="utf-8"))
    return Mapped(models, result["messages"], frozenset(result["unmatched"]))


def _import_ahead() -> None:
    """Import packages of later stages while this process waits."""
    with contextlib.suppress(ImportError):
        import_pycolmap()  # leaves signals alone, which a plain import does not
    for name in ("onnxruntime", "filterpy.kalman", "av"):
        with contextlib.suppress(ImportError):  # optional, or reported where it is needed
            importlib.import_module(name)


def _may_continue(folder: Path, job: dict[str, Any]) -> bool:
    """True if the database in the folder serves this job: same camera, images and boxes.

    It may have fewer images, or more, which an interrupted second attempt added.
    """
    old = load_cached(folder / "job.json", load_json)
    new = json.loads(json.dumps(job))
    if not isinstance(old, dict) or not isinstance(old.get("images"), dict):
        return False
    same = all(old.get(key) == new[key] for key in ("camera", "size", "guess", "seed"))
    common = old["images"].keys() & new["images"].keys()
    is_subset = len(common) == min(len(old["images"]), len(new["images"]))
    return same and is_subset and all(old["images"][i] == new["images"][i] for i in common)


# ---- Points of supplied poses --------------------------------------------------------------------


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
    progress: Callable[[str, int], Progress] = Progress,
    check: CheckMatches = lambda *_: np.nan,
) -> Poses:
    """Triangulate sparse points of the images from known poses.

    Keyframes and the pairs to match are chosen by their poses. The fraction of the matched features
    that triangulate shows whether the poses explain the images.

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
    rows = sorted(images)
    if len(rows) < 2:
        return _without_points(poses, f"{len(rows)} images have a pose; two or more are needed")
    folder = work_dir / "points"
    job = {
        "task": "triangulate",
        "camera": [poses.camera.model, list(poses.camera.params)],
        "size": (poses.camera.width, poses.camera.height),
        "cam_from_world": poses.cam_from_world[rows].tolist(),
        "pairs": choose_posed_pairs(steps[rows]).tolist(),
        "seed": seed,
    }
    with Child("reobj.poses.sfm", folder, work_dir / "points.log") as child:
        shutil.rmtree(folder, ignore_errors=True)
        file = ImageFile(folder / "keyframes.raw")
        for row in rows:
            file.append(images[row])
        write_job(folder, job, file)
        problem = child.run(progress)
    if problem:
        return _without_points(poses, f"the triangulation {problem}")
    arrays, facts = load_npz(folder / "points.npz")
    shutil.rmtree(folder)
    explained = check(np.array(rows), arrays.pop("match_rows"), arrays.pop("match_rays"))
    image, point = arrays["visibility"].T
    views = np.bincount(point)[point]  # (M,) of the observed point
    # rays of two views often intersect by chance, as with sideways motion in another order
    triangulated = int((views >= min(3, len(rows))).sum())
    matched = int(facts["matched"])
    if not matched:
        return _without_points(poses, f"no features of {len(rows)} images could be matched")
    if not triangulated or triangulated < MIN_TRIANGULATED * matched:
        cause = "are the poses of this video, in this order, with this camera?"
        if explained > 0.5:  # chosen; of right poses .6 and more
            cause = "the poses agree with the matches: too few views, or too little parallax"
        return _without_points(
            poses,
            f"with the supplied poses only {triangulated} of {matched} matched features of "
            f"{len(rows)} images triangulate (usual: half of them); {cause}",
        )
    arrays["visibility"] = np.column_stack([np.array(rows)[image], point])
    messages = (*poses.messages, *_inconsistent(arrays.pop("ties"), poses.frame[rows]))
    return dataclasses.replace(poses, **arrays, messages=messages)


# Fraction of their matches that must be one point (measured, least of a recording: rendered .71,
# studio_room .42, hololens_kitchen .14; redkitchen .09, and .003 where its Kinect lost track; ends
# of stretches that were moved 0 and .04)
MIN_TIED_SUPPLIED = 0.05


def _inconsistent(ties: IntArray, frame: IntArray) -> list[str]:
    """Report where matches of consecutive keyframes (K,) do not triangulate with supplied poses.

    Args:
        ties: (K - 1, 2) of `_count_ties`. frame: (K,).
    """
    matches, tied = ties.T
    breaks = np.flatnonzero((matches >= MIN_MATCHES) & (tied < MIN_TIED_SUPPLIED * matches))
    if not len(breaks):
        return []
    runs = np.split(breaks, np.flatnonzero(np.diff(breaks) > 1) + 1)
    where = [f"{frame[run[0]]} and {frame[run[-1] + 1]}" for run in runs]
    return [
        f"the supplied poses are inconsistent between frames {listed(where)}: matches across do "
        "not triangulate; objects seen mostly there are likely misplaced"
    ]


def listed(names: Sequence[str], most: int = 5) -> str:
    """Join names for a message; of those beyond `most` only the number."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _without_points(poses: Poses, reason: str) -> Poses:
    return dataclasses.replace(poses, messages=(*poses.messages, f"no sparse points: {reason}"))


# ---- The child process ---------------------------------------------------------------------------


def _do_job(folder: Path) -> None:
    """Do the job of a folder (child process)."""
    import_pycolmap().logging.minloglevel = 0  # stderr is the log file here
    job, images = read_job(folder)
    {"map": _map_job, "triangulate": _triangulate_job}[job["task"]](folder, job, images)


def _map_job(folder: Path, job: dict[str, Any], images: ImageFile) -> None:
    """Reconstruct the keyframes of a job folder into messages.json and sparse*/."""
    database = folder / "database.db"
    size = (images.shape[1], images.shape[0])
    guess = job["guess"]
    is_given = job["camera"] is not None
    if is_given:
        camera = _resized_camera(job, size)
    else:
        focal_px = guess * max(size)
        pc = import_pycolmap()
        camera = pc.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, *size)
    ids = job["ids"]
    row_of = {number: row for row, number in enumerate(ids)}
    seed = job["seed"]

    def extract(chosen: Sequence[int]) -> None:
        rows = [row_of[number] for number in chosen]
        boxes = [job["boxes"][row] for row in rows]
        extract_features(database, images.select(rows), chosen, boxes, camera)

    before = load_cached(folder / "views.json", load_json) or {}
    known = {0, *ids}
    before = {int(i): view for i, view in before.items() if {int(i), view} <= known}
    view_of = find_repeated(database, ids, extract, size[0], seed, job["is_video"], before)
    with atomic(folder / "views.json") as part:
        part.write_text(json.dumps(view_of), encoding="utf-8")
    mapped = sorted({view for view in view_of.values() if view})
    vlad = vlad_vectors(database, mapped, visual_words(database, mapped, seed))
    path = [view_of[number] for number in ids if view_of[number]]
    match_pairs(database, choose_pairs(path, mapped, vlad), seed)
    every_pair = read_pairs(database)
    is_path = every_pair.only(mapped).in_order(mapped)
    if not is_path:
        match_pairs(database, choose_pairs(path, mapped, vlad, UNORDERED), seed, "match again")
        every_pair = read_pairs(database)
    pairs = dataclasses.replace(every_pair.only(mapped), is_path=is_path)
    frames = {number: job["frames"][row_of[number]] for number in mapped}
    focal = Focal(guess, FocalSource.GIVEN) if is_given else estimate_focal(pairs, size, guess)
    search = MapperSearch(database, frames, pairs, focal, guess, seed)
    models, messages, weak = map_keyframes(search)
    for model in models:
        inside = set(model.reg_image_ids())
        repeated = [i for i in ids if view_of[i] in inside and view_of[i] != i]
        added = register(model, database, [*repeated, *weak], seed)
        weak = [number for number in weak if number not in added]
    for old in folder.glob("sparse*"):
        shutil.rmtree(old)
    for number, model in enumerate(models):
        name = f"sparse_part{number}" if number else "sparse"
        _write_native_model(model, images, folder / name, job)
    matched = np.unique(every_pair.image_ids[every_pair.enough])
    unmatched = sorted(set(ids) - set(matched.tolist()))
    result = {"messages": messages, "unmatched": unmatched}
    (folder / "messages.json").write_text(json.dumps(result), encoding="utf-8")


def _write_native_model(model: Any, images: ImageFile, folder: Path, job: dict[str, Any]) -> None:
    """Write a model in native pixels with the frames' names and coloured points."""
    height, width = images.shape[:2]
    row_of = {number: row for row, number in enumerate(job["ids"])}
    for point_id, color in _colors(model, images, row_of).items():
        model.point3D(point_id).color = color
    scale = np.array(job["size"]) / (width, height)
    for image_id, image in model.images.items():
        image.name = job["names"][row_of[image_id]]
        for p in image.points2D if (scale != 1).any() else ():
            p.xy = p.xy * scale
    rescale(model.camera(1), job["size"])
    folder.mkdir()
    model.write(str(folder))


def _triangulate_job(folder: Path, job: dict[str, Any], images: ImageFile) -> None:
    """Triangulate the points of a job folder into points.npz."""
    pc = import_pycolmap()
    database = folder / "database.db"
    camera = _resized_camera(job, (images.shape[1], images.shape[0]))
    ids = range(1, len(images) + 1)
    extract_features(database, images, ids, [np.empty((0, 4))] * len(images), camera)
    match_pairs(database, [(i + 1, j + 1) for i, j in job["pairs"]], job["seed"])
    send_progress("triangulating", 0, 0)
    model = _posed_model(camera, job, folder / "posed")
    options = {"num_threads": 1, "random_seed": job["seed"], "extract_colors": False}
    (folder / "sparse").mkdir()
    out = str(folder / "sparse")
    model = pc.triangulate_points(model, str(database), str(folder), out, options=options)
    row_of = {number: row for row, number in enumerate(ids)}
    points = []
    colors = []
    visibility = []
    color_of = _colors(model, images, row_of)
    for number, (point_id, point) in enumerate(sorted(model.points3D.items())):
        points.append(point.xyz)
        colors.append(color_of[point_id])
        visibility += [(row_of[element.image_id], number) for element in point.track.elements]
    arrays = {
        "points": np.array(points).reshape(-1, 3),
        "colors": np.array(colors, np.uint8).reshape(-1, 3),
        "visibility": np.array(visibility, np.int64).reshape(-1, 2),
        "ties": _count_ties(database, model, len(images)),
        **_matched_rays(read_pairs(database), camera),
    }
    save_npz(folder / "points.npz", arrays, matched=_count_matched(database))


def _matched_rays(pairs: MatchedPairs, camera: Any) -> dict[str, Any]:
    """Return the keyframes (M, 2) of all verified matches, and their rays (M, 2, 2), z = 1."""
    rays = {i: np.asarray(camera.cam_ray_from_img(xy)) for i, xy in pairs.keypoints.items()}
    both = zip(pairs.image_ids.tolist(), pairs.inliers, strict=True)
    found = [np.stack([rays[i][rows[:, 0]], rays[j][rows[:, 1]]], 1) for (i, j), rows in both]
    matched = np.concatenate([np.empty((0, 2, 3)), *found])  # (M, 2, 3)
    return {
        "match_rows": np.repeat(pairs.image_ids - 1, pairs.matches, 0),
        "match_rays": matched[..., :2] / matched[..., 2:],
    }


def _posed_model(camera: Any, job: dict[str, Any], folder: Path) -> Any:
    """Make a model of the posed keyframes without points, named as in the database."""
    cam_from_world = np.array(job["cam_from_world"])
    count = len(cam_from_world)
    rows = np.arange(count)
    resized = Camera(camera.model.name, camera.width, camera.height, tuple(camera.params.tolist()))
    status = np.full(count, "supplied")
    poses = Poses(resized, rows, rows.astype(np.float64), cam_from_world, status, "user")
    write_colmap(folder, poses, [f"{number:06d}" for number in range(1, count + 1)])
    return import_pycolmap().Reconstruction(str(folder))


def _count_matched(database: Path) -> int:
    """Count the features that have a verified match in another keyframe."""
    pc = import_pycolmap()
    matched = set[tuple[int, int]]()
    with contextlib.closing(pc.Database.open(str(database))) as db:
        for pair, geometry in zip(*db.read_two_view_geometries(), strict=True):
            ids = pc.pair_id_to_image_pair(pair)
            for image_id, features in zip(ids, geometry.inlier_matches.T.tolist(), strict=True):
                matched |= {(image_id, feature) for feature in features}
    return len(matched)


def _count_ties(database: Path, model: Any, count: int) -> IntArray:
    """Count (K - 1, 2) the matches of consecutive keyframes, and those that are one point."""
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


def _colors(model: Any, images: ImageFile, row_of: Mapping[int, int]) -> dict[int, Any]:
    """Return the colour (3,) RGB of each point in the image that observed it first."""
    height, width = images.shape[:2]
    seen: dict[int, list[tuple[int, Any]]] = {}
    for point_id, point in model.points3D.items():
        first = point.track.elements[0]
        xy = model.image(first.image_id).point2D(first.point2D_idx).xy.astype(int)
        seen.setdefault(first.image_id, []).append((point_id, xy.clip(0, (width - 1, height - 1))))
    colors: dict[int, Any] = {}
    for image_id, points in seen.items():
        image = images[row_of[image_id]]
        colors |= {point_id: image[y, x, ::-1] for point_id, (x, y) in points}
    return colors


def _resized_camera(job: dict[str, Any], size: tuple[int, int]) -> Any:
    """Make the `pycolmap.Camera` of the resized images from the job's calibrated camera."""
    model, params = job["camera"]
    width, height = job["size"]
    camera = Camera(model, width, height, tuple(params)).to_pycolmap()
    rescale(camera, size)
    camera.has_prior_focal_length = True
    return camera


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
    import_pycolmap()  # before the first job, while the parent still chooses keyframes
    serve(_do_job)
