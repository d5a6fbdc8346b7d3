"""Reconstruction of the keyframes by pycolmap, in a child process.

`reconstruct` hands the keyframes over as files; the child (`python -m reobj.poses.mapping FOLDER`)
extracts features, matches pairs, runs mappers from strict to permissive until one model is sound,
and adjusts it once more. COLMAP's aborts and its log stay in the child. Which frames are keyframes
and where the frames between them are is not decided here.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from reobj.cameras import Camera, import_pycolmap
from reobj.files import Progress, atomic
from reobj.types import Array, Image

HOW_TO_FILM = (
    "move the camera sideways around the objects (turning on the spot gives no depth), keep things "
    "with texture in view, avoid blurred frames, or give --poses; identities in 2D need none"
)


def reconstruct(
    images: Sequence[Image],
    names: list[str],
    moving_boxes: Sequence[Array],
    size: tuple[int, int],
    *,
    camera: Camera | None,
    focal_guesses: Sequence[float],
    seed: int,
    work_dir: Path,
    progress: Callable[[str, int], Progress],
) -> list[str]:
    """Reconstruct keyframes into the COLMAP model `work_dir/sparse`, in native pixels.

    A run that was killed left features and matches in `work_dir/mapping`: with the same input the
    next one goes on from there.

    Args:
        images: (h, w, 3) BGR, resized. names: of the images in the model.
        moving_boxes: (N, 4) xyxy of each image, native pixels: no features there.
        size: (w, h), native. camera: kept as it is; None: calibrated, starting from each of
            `focal_guesses` (over the longer side) until a model can be trusted.
    Returns:
        messages. Without a model there is no `work_dir/sparse`, and the message says why.
    """
    folder = work_dir / "mapping"
    if len(images) < 3:
        return [f"no camera poses: only {len(images)} different views; {HOW_TO_FILM}"]
    digest = hashlib.sha256()
    for image in images:
        digest.update(image.tobytes())
    scale = np.tile(np.array(images[0].shape[1::-1]) / size, 2)
    job = {
        "names": names,
        "boxes": [(xyxy * scale).tolist() for xyxy in moving_boxes],
        "camera": None if camera is None else [camera.model, list(camera.params)],
        "size": size,
        "guesses": list(focal_guesses),
        "seed": seed,
        "images": digest.hexdigest(),
    }
    text, path = json.dumps(job), folder / "job.json"
    if not path.exists() or path.read_text() != text:
        for old in (work_dir / "sparse", folder):
            shutil.rmtree(old, ignore_errors=True)
        folder.mkdir(parents=True)
        np.save(folder / "keyframes.npy", np.stack(images))
        with atomic(path) as part:
            part.write_text(text)
    (folder / "messages.json").unlink(missing_ok=True)
    messages = _run_child(folder, work_dir / "pycolmap.log", progress)
    if (folder / "sparse").exists():
        (folder / "sparse").replace(work_dir / "sparse")
    return messages


def _run_child(folder: Path, log_path: Path, progress: Callable[[str, int], Progress]) -> list[str]:
    """Run `_reconstruct_job` in a fresh interpreter, show its progress, return its messages."""
    # -P: not the modules of the working directory; the package's own folder comes first
    command = [sys.executable, "-P", "-m", "reobj.poses.mapping", str(folder)]
    paths = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    line: Progress | None = None
    with (
        open(log_path, "wb") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=environment) as child,
    ):
        try:
            for text in child.stdout or ():
                words = text.decode(errors="replace").split()
                if len(words) != 4 or words[0] != "reobj:":
                    continue
                stage, done, total = words[1], int(words[2]), int(words[3])
                if line is None or line.stage != stage:
                    if line is not None:
                        line.close()
                    line = progress(stage, total)
                line.step(done - line.done)
        except BaseException:
            child.kill()
            raise
    if line is not None:
        line.close()
    if (folder / "messages.json").exists():
        return list(json.loads((folder / "messages.json").read_text()))
    why = f"signal {-child.returncode}" if child.returncode < 0 else f"exit code {child.returncode}"
    return [f"no camera poses: the reconstruction stopped ({why}), see {log_path}; give --poses"]


def _reconstruct_job(folder: Path) -> None:
    """Reconstruct the keyframes of a job folder into messages.json and sparse/ (child process)."""
    pc = import_pycolmap()
    pc.logging.minloglevel = 0  # stderr is the log file here
    job = json.loads((folder / "job.json").read_text())
    database, seed = folder / "database.db", int(job["seed"])
    images = np.load(folder / "keyframes.npy", mmap_mode="r")  # (K, h, w, 3) BGR
    if not (folder / "features").exists():
        database.unlink(missing_ok=True)
        _extract_features(database, images, job)
        (folder / "features").touch()
    _match_features(database, seed)
    found = []
    for guess in job["guesses"] or [None]:  # None: the intrinsics are given
        found.append(_best_model(database, len(images), guess, seed))
        if found[-1][2]:
            break
    model, messages, _ = max(found, key=lambda f: (f[2], f[0] is not None))
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    if model is not None:
        _write_native_model(model, images, folder / "sparse", job["names"], tuple(job["size"]))
    (folder / "messages.json").write_text(json.dumps(messages))


def _send_progress(stage: str, done: int, total: int) -> None:
    """Print a line for `_run_child`."""
    print("reobj:", stage, done, total, flush=True)


FOCAL_GUESS = 0.8  # first focal length over the longer side (phones: .72-.85)


def _extract_features(database: Path, images: Any, job: dict[str, Any]) -> None:
    """Write one camera, the keyframes (ids from 1) and their RootSIFT features into a database."""
    pc, size = import_pycolmap(), (images.shape[2], images.shape[1])
    if job["camera"] is not None:
        model, params = job["camera"]
        width, height = job["size"]
        camera = Camera(model, width, height, tuple(params)).resized(size).to_pycolmap()
    else:
        focal = FOCAL_GUESS * max(size)
        camera = pc.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, *size)
    camera.has_prior_focal_length = job["camera"] is not None
    cv2.setNumThreads(1)
    with contextlib.closing(pc.Database.open(str(database))) as db, ThreadPoolExecutor(2) as pool:
        db.write_camera(camera, use_camera_id=True)
        rig = pc.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        db.write_rig(rig, use_rig_id=True)
        features = pool.map(_root_sift, images, map(np.array, job["boxes"]))
        for number, (xy, descriptors) in enumerate(features, 1):
            image = pc.Image(name=f"{number:06d}", camera_id=1, image_id=number)
            db.write_image(image, use_image_id=True)
            frame = pc.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
            db.write_keypoints(number, xy)
            sift = pc.FeatureDescriptors(pc.FeatureExtractorType.SIFT, descriptors)
            db.write_descriptors(number, sift)
            _send_progress("features", number, len(images))


SIFT_FEATURES = 2000  # a keyframe, the strongest (chosen; 4096 was slower and no better)
SIFT_CONTRAST = 0.02  # contrast threshold (chosen; OpenCV's default: .04)
SIFT_CONTRAST_LOW = 0.007  # the same for plain walls, where that finds too few (chosen)
SIFT_FEW = 500  # features that are too few (chosen)


def _root_sift(bgr: Image, boxes: Array) -> tuple[npt.NDArray[np.float32], Image]:
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
    for contrast in (SIFT_CONTRAST, SIFT_CONTRAST_LOW):
        sift: Any = cv2.SIFT.create(nfeatures=SIFT_FEATURES, contrastThreshold=contrast)
        keypoints, found = sift.detectAndCompute(gray, mask)
        if len(keypoints) >= SIFT_FEW:
            break
    if found is None or not len(keypoints):
        return np.empty((0, 2), np.float32), np.empty((0, 128), np.uint8)
    # OpenCV has the centre of the first pixel at (0, 0), COLMAP at (.5, .5)
    xy = np.array([k.pt for k in keypoints], np.float32) + np.float32(0.5)  # (N, 2)
    root = np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-9)) * 512
    return xy, np.minimum(root, 255).astype(np.uint8)


MAX_EXHAUSTIVE = 30  # keyframes of which all pairs are matched (chosen: 435 pairs)
OFFSETS = [1 << k for k in range(12)]  # of more, pairs so far apart (COLMAP: quadratic overlap)
MATCH_CHUNK = 100  # pairs between two lines of progress (chosen)


def _match_features(database: Path, seed: int) -> None:
    """Match and verify all pairs of a few keyframes, else sequential pairs and retrieved ones.

    COLMAP skips the pairs that a killed run has matched.
    """
    pc, listed = import_pycolmap(), database.parent / "pairs.txt"
    with contextlib.closing(pc.Database.open(str(database))) as db:
        count = db.num_images()
        descriptors = [np.asarray(db.read_descriptors(i + 1).data) for i in range(count)]
    pairs = set(itertools.combinations(range(count), 2))
    if count > MAX_EXHAUSTIVE:
        pairs = {(i, i + offset) for offset in OFFSETS for i in range(count - offset)}
        pairs |= set(_pairs_from_retrieval(descriptors, seed))
    ordered = sorted(pairs)
    for start in range(0, len(ordered), MATCH_CHUNK):
        chunk = ordered[start : start + MATCH_CHUNK]
        listed.write_text("".join(f"{i + 1:06d} {j + 1:06d}\n" for i, j in chunk))
        pc.match_image_pairs(
            str(database),
            pairing_options={"match_list_path": str(listed)},
            verification_options={"ransac": {"random_seed": seed}},  # else two runs differ
            device=pc.Device.cpu,
        )
        _send_progress("match", start + len(chunk), len(ordered))


RETRIEVED_PAIRS = 6  # most similar keyframes matched with each, to close loops (chosen)
VISUAL_WORDS = 64  # of a VLAD vector (its paper: 16-256)
WORD_SAMPLE = 20000  # descriptors clustered into words, at least (chosen: time)


def _pairs_from_retrieval(descriptors: list[Image], seed: int) -> list[tuple[int, int]]:
    """Find the pairs of keyframes with the most similar VLAD vectors.

    Args:
        descriptors: (n, 128) of each keyframe.
    Ref: Jegou et al., CVPR 2010.
    """
    features = np.concatenate(descriptors).astype(np.float32)  # (N, 128)
    sample = features[:: max(1, len(features) // WORD_SAMPLE)]
    if len(sample) < VISUAL_WORDS:
        return []
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.1)
    start = cv2.KMEANS_PP_CENTERS
    words = cv2.kmeans(sample, VISUAL_WORDS, np.empty(0), stop, 1, start)[2]  # (W, 128)
    vlad = np.zeros((len(descriptors), *words.shape), np.float32)  # (K, W, 128) sums of residuals
    for sums, found in zip(vlad, descriptors, strict=True):
        # argmin |d - w|^2 = argmax d'w - |w|^2 / 2
        nearest = (found @ words.T - 0.5 * (words**2).sum(1)).argmax(1)  # (n,)
        np.add.at(sums, nearest, found - words[nearest])
    vlad /= np.maximum(np.linalg.norm(vlad, axis=2, keepdims=True), 1e-9)
    flat = vlad.reshape(len(vlad), -1)
    similarity, at = flat @ flat.T, np.arange(len(flat))  # (K, K)
    similarity[np.abs(at[:, None] - at) <= 2] = -np.inf  # matched already
    best = np.argsort(-similarity, axis=1, kind="stable")[:, :RETRIEVED_PAIRS]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(best) for j in row})


STRONG_TRI_ANGLE_DEG = 5.0  # triangulation angle that calibrates a focal length (chosen)
STRONG_SPREAD = 0.1  # and spread of the cameras over the depth that does (chosen)
FOCAL_RANGE = (0.4, 2.0)  # plausible focal length over the longer side (chosen: 28-103 deg wide)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """The largest model of one mapper, and the measures that tell a sound model from a wrong one.

    The reprojection error is none of them: wrong models had the smallest.
    """

    model: Any = None
    registered: float = 0.0  # share of the keyframes
    tri_angle_deg: float = 0.0  # median over points of the widest angle between two rays
    parallax_px: float = 0.0  # what turns of the camera alone cannot explain
    spread: float = 0.0  # rms distance of the cameras from their mean over the median depth
    focal: float = 0.0  # over the longer side
    problem: str = "no two keyframes show the same points from clearly different places"

    @property
    def calibrates(self) -> bool:
        """True if the geometry is strong enough to trust the focal length that came out."""
        low, high = FOCAL_RANGE
        wide = self.tri_angle_deg >= STRONG_TRI_ANGLE_DEG
        return wide and self.spread >= STRONG_SPREAD and low <= self.focal <= high


GOOD_REGISTERED = 0.9  # share of the keyframes in a sound model that ends the search (chosen)
MIN_PARALLAX_PX = 3.0  # refuse a model with less (chosen; walks have more than 4)


def _best_model(
    database: Path, count: int, focal_guess: float | None, seed: int
) -> tuple[Any, list[str], bool]:
    """Run mappers from strict to permissive on `count` keyframes until a model is sound.

    Args:
        focal_guess: start of the calibration, over the longer side; None: the intrinsics are known.
    Returns:
        the best sound model (None if nothing is sound), messages, and whether its focal length is
        to be trusted.
    """
    tried: list[_Candidate] = []
    if focal_guess is not None:
        _set_focal(database, focal_guess, False)
    for mapper in ("strict", "relaxed", "global"):
        sound = [c for c in tried if not c.problem]
        turned = [c for c in tried if c.problem and c.parallax_px < MIN_PARALLAX_PX]
        good = any(c.registered >= GOOD_REGISTERED for c in sound + turned)
        if good or (sound and mapper == "global"):
            break
        tried.append(_candidate(database, mapper, focal_guess is None, count, seed))
    best = max(tried, key=lambda c: (not c.problem, c.registered))
    messages = []
    if not best.problem and focal_guess is not None and not best.calibrates:
        angle = f"{best.tri_angle_deg:.1f} deg"
        weak = f"little parallax (rays meet at {angle}): the focal length cannot be calibrated"
        _set_focal(database, focal_guess, True)
        best = _candidate(database, "relaxed", True, count, seed)
        messages = [
            f"{weak} and is taken as {focal_guess:.3g} x the longer side; sizes and depths "
            "are rough: give --camera fx,fy,cx,cy, or move the camera sideways around the objects"
        ]
    if best.problem:
        return None, [f"no camera poses: {best.problem}; {HOW_TO_FILM}"], focal_guess is None
    _refine(best.model, calibrate=focal_guess is not None and not messages)
    return best.model, messages, not messages


def _set_focal(database: Path, guess: float, trusted: bool) -> None:
    """Set the focal length in the database to a guess over the longer side, without distortion."""
    with contextlib.closing(import_pycolmap().Database.open(str(database))) as db:
        camera = db.read_all_cameras()[0]
        focal = guess * max(camera.width, camera.height)
        camera.params = [focal, *camera.params[1:3], 0.0]
        camera.has_prior_focal_length = trusted
        db.update_camera(camera)


MIN_REGISTERED = 0.5  # share of the keyframes; refuse a model with fewer (chosen)
MIN_POINTS = 100  # refuse a model with fewer (chosen)
MIN_POINTS_PER_IMAGE = 30  # of the median image; refuse a model with fewer (chosen)
MIN_TRI_ANGLE_DEG = 1.5  # median; refuse a model with less (chosen; COLMAP's points: 1.5)


def _candidate(database: Path, mapper: str, fixed: bool, count: int, seed: int) -> _Candidate:
    """Run a mapper on `count` keyframes, measure its largest model and name its first problem."""
    models = _run_mapper(database, mapper, fixed, count, seed)
    if not models:
        return _Candidate()
    model = max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()))
    camera = next(iter(model.cameras.values()))
    centre = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    registered = len(centre) / count
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    seen = [model.image(i).num_points3D for i in centre]
    parallax = _parallax_px(model)
    angle, depth = _angle_and_depth(model, centre)
    spread = float(np.sqrt(np.var(list(centre.values()), axis=0).sum()) / max(depth, 1e-12))
    checks = (
        (registered < MIN_REGISTERED, f"only {len(centre)} of {count} keyframes connect"),
        (model.num_points3D() < MIN_POINTS,
         f"only {model.num_points3D()} points could be triangulated"),
        (np.median(seen) < MIN_POINTS_PER_IMAGE, "the images share too few points"),
        (parallax < MIN_PARALLAX_PX,
         "a mere turn of the camera explains all images, so there is no depth"),
        (angle < MIN_TRI_ANGLE_DEG,
         f"rays meet at {angle:.1f} deg only: the camera hardly moved sideways"),
        (camera.has_bogus_params(*FOCAL_RANGE, 1.0),
         f"the focal length came out as {focal:.2f} x the width"),
    )  # fmt: skip
    problem = next((text for bad, text in checks if bad), "")
    return _Candidate(model, registered, angle, parallax, spread, focal, problem)


RELAXED = {  # COLMAP's options of the second mapper: weak parallax is taken too (chosen)
    "mapper": {"init_min_tri_angle": 4, "init_min_num_inliers": 40, "abs_pose_min_num_inliers": 15,
               "abs_pose_min_inlier_ratio": 0.15, "filter_min_tri_angle": 0.5},
    "triangulation": {"min_angle": 0.5, "ignore_two_view_tracks": False},
}  # fmt: skip


def _run_mapper(database: Path, mapper: str, fixed: bool, count: int, seed: int) -> list[Any]:
    """Run a mapper ("strict" or "relaxed": incremental; "global"), return all its models.

    Args:
        fixed: the intrinsics in the database are kept.
    """
    pc, out = import_pycolmap(), database.parent / mapper
    out.mkdir(exist_ok=True)
    paths = (str(database), str(out), str(out))
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed}  # one: reproducible
    if mapper == "global":
        if fixed:
            kept = {"refine_focal_length": False, "refine_extra_params": False}
            options["mapper"] = {"bundle_adjustment": kept}
        else:  # with a wrong focal length global mapping is wrong and looks right
            pc.calibrate_view_graph(str(database))
        return list(pc.global_mapping(*paths, options=options).values())
    options |= {"multiple_models": True, "min_model_size": 3, "extract_colors": False}
    # global adjustment more rarely and less exactly than by default (chosen: time; see `_refine`)
    options |= {"ba_global_frames_ratio": 1.4, "ba_global_points_ratio": 1.4}
    options |= {"ba_global_function_tolerance": 1e-5}
    options |= {"ba_refine_focal_length": not fixed, "ba_refine_extra_params": not fixed}
    options |= RELAXED if mapper == "relaxed" else {}
    done = itertools.count(2)
    tick = {"next_image_callback": lambda: _send_progress("mapping", min(next(done), count), count)}
    return list(pc.incremental_mapping(*paths, options=options, **tick).values())


MAX_CENTRE_SHIFT = 0.05  # of the principal point when it is freed, over the size (chosen)


def _refine(model: Any, calibrate: bool) -> None:
    """Adjust cameras and points once more, with a robust loss.

    Args:
        calibrate: the intrinsics too, with a second distortion term and the principal point, unless
            that drifts off.
    """
    if not calibrate:
        _bundle_adjust(model, False, False)
        return
    camera = model.camera(1)
    size = np.array([camera.width, camera.height])
    focal, _, _, distortion = camera.params
    camera.model = import_pycolmap().CameraModelId.RADIAL
    for free_centre in (True, False):
        camera.params = [focal, *size / 2, distortion, 0]
        _bundle_adjust(model, True, free_centre)
        shift = np.abs(np.array([camera.principal_point_x, camera.principal_point_y]) - size / 2)
        if (shift <= MAX_CENTRE_SHIFT * size).all():
            break


SOFT_L1_PX = 0.5  # from where a residual counts less, pixels of the resized image (chosen)


def _bundle_adjust(model: Any, calibrate: bool, free_centre: bool) -> None:
    """Adjust all images and points; the first two cameras fix the gauge."""
    pc = import_pycolmap()
    options, chosen = pc.BundleAdjustmentOptions(), pc.BundleAdjustmentConfig()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = calibrate
    options.refine_principal_point = free_centre
    options.ceres.loss_function_type = pc.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = SOFT_L1_PX
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1  # the same result every time
    for i in model.reg_image_ids():
        chosen.add_image(i)
    chosen.fix_gauge(pc.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pc.create_default_bundle_adjuster(options, chosen, model).solve()


ANGLE_SAMPLE = 2000  # points of which the median angle is taken, at least (chosen: time)


def _angle_and_depth(model: Any, centre: dict[int, Array]) -> tuple[float, float]:
    """Measure how well points are triangulated.

    Args:
        centre: of the camera of each image id.
    Returns:
        medians over points of the widest angle between two of its rays, in degrees, and of its
        distance from the cameras.
    """
    ids = sorted(model.point3D_ids())
    if not ids:
        return 0.0, 0.0
    angles, depths = [], []
    for point_id in ids[:: max(1, len(ids) // ANGLE_SAMPLE)]:
        point = model.point3D(point_id)
        rays = point.xyz - np.array([centre[e.image_id] for e in point.track.elements])  # (L, 3)
        length = np.linalg.norm(rays, axis=1)
        unit = rays / length[:, None]
        angles.append(math.degrees(math.acos(float(np.clip((unit @ unit.T).min(), -1, 1)))))
        depths.append(float(np.median(length)))
    return float(np.median(angles)), float(np.median(depths))


MIN_SHARED = 15  # points of a pair of images whose parallax counts (chosen)


def _parallax_px(model: Any) -> float:
    """Measure the parallax that turns of the camera cannot explain.

    Of each pair of images the rays of the shared points are aligned by a rotation; the median
    residual is the pair's parallax. Returned is the 95th percentile over pairs, in pixels. A camera
    that only turned looks sound otherwise: a wrong focal length makes up triangulation angles.
    """
    rays: dict[int, dict[int, Array]] = {}
    for image_id in sorted(model.reg_image_ids()):
        seen = model.image(image_id).get_observation_points2D()
        xy = np.array([p.xy for p in seen]).reshape(-1, 2)
        ideal = np.reshape(model.camera(1).cam_from_img(xy), (-1, 2))
        unit = np.column_stack([ideal, np.ones(len(seen))])  # (n, 3)
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        rays[image_id] = dict(zip([p.point3D_id for p in seen], unit, strict=True))
    residuals = []
    for a, b in itertools.combinations(rays, 2):
        if (b - a) & (b - a - 1) == 0:  # 1, 2, 4, 8 ... keyframes apart
            both = sorted(rays[a].keys() & rays[b].keys())
            if len(both) >= MIN_SHARED:
                one, other = (np.array([rays[i][p] for p in both]) for i in (a, b))  # (n, 3)
                turned = Rotation.align_vectors(other, one)[0].apply(one)
                residuals.append(np.median(np.linalg.norm(turned - other, axis=1)))
    widest = float(np.percentile(residuals, 95)) if residuals else 0.0
    return widest * float(model.camera(1).mean_focal_length())


def _write_native_model(
    model: Any, images: Any, folder: Path, names: list[str], size: tuple[int, int]
) -> None:
    """Write the model in native pixels (w, h) with the frames' names; points get a colour."""
    height, width = images.shape[1:3]
    for point_id in model.point3D_ids():
        point = model.point3D(point_id)
        seen = point.track.elements[0]  # the colour is that of the first observation
        xy = model.image(seen.image_id).point2D(seen.point2D_idx).xy.astype(int)
        x, y = xy.clip(0, (width - 1, height - 1))
        point.color = images[seen.image_id - 1, y, x, ::-1]
    scale = np.array(size) / (width, height)
    for image_id, image in model.images.items():
        image.name = names[image_id - 1]
        for p in image.points2D:
            p.xy = p.xy * scale
    model.camera(1).rescale(*size)
    folder.mkdir()
    model.write(str(folder))


if __name__ == "__main__":
    _reconstruct_job(Path(sys.argv[1]))
