"""Reconstruction of the keyframes by pycolmap, in a child process."""

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

from reobj.cameras import Camera, import_pycolmap, pycolmap_camera
from reobj.files import Progress, atomic
from reobj.types import Array, Image

_ADVICE = (
    "move the camera sideways around the objects (turning on the spot gives no depth), keep things "
    "with texture in view, avoid blurred frames, or give --poses; identities in 2D need none"
)


def reconstruct(
    images: Sequence[Image],
    names: list[str],
    boxes: list[Array],
    camera: Camera | None,
    size: tuple[int, int],
    guesses: list[float],
    seed: int,
    work_dir: Path,
    progress: Callable[[str, int], Progress],
) -> list[str]:
    """Reconstruct keyframes into `work_dir/sparse`; without a model the messages say why.

    Args:
        images: (h, w, 3) BGR at working size; names: of their frames; size: (w, h) native pixels.
        boxes: (N, 4) xyxy of moving things in each, native pixels: no features there.
        camera: None: self-calibrated, from each of the guesses (focal length / longer side).
    """
    folder = work_dir / "mapping"
    if len(images) < 3:
        return [f"no camera poses: only {len(images)} different views; {_ADVICE}"]
    digest = hashlib.sha256()
    for image in images:
        digest.update(image.tobytes())
    scale = np.tile(np.array(images[0].shape[1::-1]) / size, 2)
    job = {
        "names": names,
        "boxes": [(xyxy * scale).tolist() for xyxy in boxes],
        "camera": None if camera is None else [camera.model, list(camera.params)],
        "size": size,
        "guesses": guesses,
        "seed": seed,
        "images": digest.hexdigest(),
    }
    text, path = json.dumps(job), folder / "job.json"
    if not path.exists() or path.read_text() != text:  # else go on where a killed run stopped
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
    """Run `_sfm_child` in a fresh interpreter: COLMAP's aborts and chatter stay there."""
    command = [sys.executable, "-m", "reobj.poses.mapping", str(folder)]
    package = Path(__file__).resolve().parents[2]
    paths = [str(package), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    lines: list[Progress] = []
    with (
        open(log_path, "wb") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=environment) as child,
    ):
        try:
            for text in child.stdout or ():
                words = text.decode(errors="replace").split()
                if len(words) != 4 or words[0] != "reobj:":
                    continue
                if not lines or lines[-1].stage != words[1]:
                    for line in lines[-1:]:
                        line.close()
                    lines.append(progress(words[1], int(words[3])))
                lines[-1].step(int(words[2]) - lines[-1].done)
        except BaseException:
            child.kill()
            raise
    for line in lines[-1:]:
        line.close()
    if (folder / "messages.json").exists():
        return list(json.loads((folder / "messages.json").read_text()))
    why = f"signal {-child.returncode}" if child.returncode < 0 else f"exit code {child.returncode}"
    return [f"no camera poses: the reconstruction stopped ({why}), see {log_path}; give --poses"]


def _sfm_child(folder_name: str) -> None:
    """Child process: reconstruct the keyframes of a job folder into messages.json and sparse/."""
    pc = import_pycolmap()
    pc.logging.minloglevel = 0  # stderr is the log file here
    folder = Path(folder_name)
    job = json.loads((folder / "job.json").read_text())
    database, seed = folder / "database.db", int(job["seed"])
    images = np.load(folder / "keyframes.npy", mmap_mode="r")  # (K, h, w, 3) BGR
    if not (folder / "features").exists():
        database.unlink(missing_ok=True)
        _sfm_features(database, images, job)
        (folder / "features").touch()
    _sfm_match(database, seed)
    found = []
    for guess in job["guesses"] or [0.0]:  # 0: the intrinsics are given
        found.append(_sfm_ladder(database, len(images), guess, seed))
        if found[-1][2]:
            break
    model, messages, _ = max(found, key=lambda f: (f[2], f[0] is not None))
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    if model is not None:
        _sfm_write(model, images, folder / "sparse", job["names"], tuple(job["size"]))
    (folder / "messages.json").write_text(json.dumps(messages))


def _tell(stage: str, done: int, total: int) -> None:
    """Send progress to the parent."""
    sys.stdout.write(f"reobj: {stage} {done} {total}\n")
    sys.stdout.flush()


def _sfm_features(database: Path, images: Any, job: dict[str, Any]) -> None:
    """Write one camera, the keyframes (ids from 1) and their RootSIFT features into a database."""
    pc, size = import_pycolmap(), (images.shape[2], images.shape[1])
    if job["camera"] is not None:
        model, params = job["camera"]
        width, height = job["size"]
        camera = pycolmap_camera(Camera(model, width, height, tuple(params)), size)
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
        boxes = map(np.array, job["boxes"])
        features = pool.map(_sift, images, boxes)
        for number, (xy, descriptors) in enumerate(features, 1):
            image = pc.Image(name=f"{number:06d}", camera_id=1, image_id=number)
            db.write_image(image, use_image_id=True)
            frame = pc.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
            db.write_keypoints(number, xy)
            sift = pc.FeatureDescriptors(pc.FeatureExtractorType.SIFT, descriptors)
            db.write_descriptors(number, sift)
            _tell("features", number, len(images))


SIFT_FEATURES = 2000  # SIFT features a keyframe (4096: slower, no better)
SIFT_CONTRAST = 0.02  # SIFT contrast threshold
SIFT_CONTRAST_LOW = 0.007  # the same where fewer than sift_few features are found
SIFT_FEW = 500  # see sift_contrast_low
FOCAL_GUESS = 0.8  # first focal length over the longer side (phones .72-.85)


def _sift(bgr: Image, boxes: Array) -> tuple[npt.NDArray[np.float32], Image]:
    """Detect RootSIFT features outside the boxes: COLMAP pixels (N, 2), uint8 (N, 128)."""
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
    xy = np.array([k.pt for k in keypoints], np.float32) + np.float32(0.5)  # COLMAP's pixels
    root = np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-9)) * 512
    return xy, np.minimum(root, 255).astype(np.uint8)


OVERLAP = 12  # sequential matching: neighbours at offsets 1, 2, 4 ... 2^(overlap-1)
EXHAUSTIVE_BELOW = 30  # match all pairs when there are no more keyframes than this
MATCH_CHUNK = 100  # pairs of keyframes matched between two ticks of the progress


def _sfm_match(database: Path, seed: int) -> None:
    """Match all pairs of a few keyframes, else those at offsets 1, 2, 4, 8 ... and look-alikes.

    (COLMAP skips the pairs that a killed run has matched.)
    """
    pc, listed = import_pycolmap(), database.parent / "pairs.txt"
    with contextlib.closing(pc.Database.open(str(database))) as db:
        count = db.num_images()
        descriptors = [np.asarray(db.read_descriptors(i + 1).data) for i in range(count)]
    pairs = set(itertools.combinations(range(count), 2))
    if count > EXHAUSTIVE_BELOW:
        steps = [1 << k for k in range(OVERLAP)]
        pairs = {(i, i + step) for step in steps for i in range(count - step)}
        pairs |= set(_look_alikes(descriptors, seed))
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
        _tell("match", start + len(chunk), len(ordered))


LOOP_PAIRS = 6  # look-alike keyframes matched with each keyframe, to close loops
LOOP_WORDS = 64  # visual words that describe the look of a keyframe
LOOP_SAMPLE = 20000  # descriptors clustered into words


def _look_alikes(descriptors: list[Image], seed: int) -> list[tuple[int, int]]:
    """Find pairs of keyframes that look most alike. Ref: VLAD, Jegou et al., CVPR 2010."""
    features = np.concatenate(descriptors).astype(np.float32)  # (N, 128)
    sample = features[:: max(1, len(features) // LOOP_SAMPLE)]
    if len(sample) < LOOP_WORDS:
        return []
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.1)
    start = cv2.KMEANS_PP_CENTERS
    words = cv2.kmeans(sample, LOOP_WORDS, np.empty(0), stop, 1, start)[2]  # (W, 128)
    looks = np.zeros((len(descriptors), *words.shape), np.float32)  # (K, W, 128) sums of residuals
    for look, found in zip(looks, descriptors, strict=True):
        nearest = (found @ words.T - 0.5 * (words**2).sum(1)).argmax(1)  # (n,)
        np.add.at(look, nearest, found - words[nearest])
    looks /= np.maximum(np.linalg.norm(looks, axis=2, keepdims=True), 1e-9)
    flat = looks.reshape(len(looks), -1)
    alike, at = flat @ flat.T, np.arange(len(flat))  # (K, K)
    alike[np.abs(at[:, None] - at) <= 2] = -np.inf  # matched already
    best = np.argsort(-alike, axis=1, kind="stable")[:, :LOOP_PAIRS]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(best) for j in row})


_RELAXED = {
    "mapper": {"init_min_tri_angle": 4, "init_min_num_inliers": 40, "abs_pose_min_num_inliers": 15,
               "abs_pose_min_inlier_ratio": 0.15, "filter_min_tri_angle": 0.5},
    "triangulation": {"min_angle": 0.5, "ignore_two_view_tracks": False},
}  # fmt: skip
STRONG_TRI_ANGLE_DEG = 5.0  # trust a self-calibrated focal length from this angle
STRONG_SPREAD = 0.1  # and from this spread of the cameras over the depth on
FOCAL_RANGE = (0.4, 2.0)  # and if focal / longer side lies in here


@dataclass(frozen=True, slots=True)
class _Attempt:
    """One mapper's largest model, and what tells a sound model from a wrong one.

    (The reprojection error does not: wrong models had the smallest.)
    """

    model: Any = None
    registered: float = 0.0  # share of the keyframes
    tri_angle_deg: float = 0.0  # median over points of the widest angle between two rays
    parallax_px: float = 0.0  # what turns of the camera alone cannot explain
    spread: float = 0.0  # rms distance of the cameras from their mean over the median depth
    focal: float = 0.0  # over the longer side
    problem: str = "no two keyframes show the same points from clearly different places"

    def trusted(self) -> bool:
        """True if the geometry is strong enough to calibrate the focal length."""
        low, high = FOCAL_RANGE
        wide = self.tri_angle_deg >= STRONG_TRI_ANGLE_DEG
        return wide and self.spread >= STRONG_SPREAD and low <= self.focal <= high


GOOD_REGISTERED = 0.9  # take the first sound model with this share of keyframes
MIN_PARALLAX_PX = 3.0  # refuse what turns explain to this (walks: > 4)


def _sfm_ladder(database: Path, count: int, guess: float, seed: int) -> tuple[Any, list[str], bool]:
    """Try mappers from strict to permissive.

    Returns:
        the best sound model (None if nothing is sound), messages, and whether its focal length is
        trusted.
    """
    tried: list[_Attempt] = []
    known_focal = not guess
    if not known_focal:
        _sfm_guess_focal(database, guess, False)
    for rung in ("strict", "relaxed", "global"):
        sound = [a for a in tried if not a.problem]
        turned = [a for a in tried if a.problem and a.parallax_px < MIN_PARALLAX_PX]
        good = any(a.registered >= GOOD_REGISTERED for a in sound + turned)
        if good or (sound and rung == "global"):
            break
        tried.append(_sfm_attempt(database, rung, known_focal, count, seed))
    best = max(tried, key=lambda a: (not a.problem, a.registered))
    messages = []
    if not best.problem and not known_focal and not best.trusted():
        angle = f"{best.tri_angle_deg:.1f} deg"
        weak = f"little parallax (rays meet at {angle}): the focal length cannot be calibrated"
        _sfm_guess_focal(database, guess, True)
        best = _sfm_attempt(database, "relaxed", True, count, seed)
        messages = [
            f"{weak} and is taken as {guess:.3g} x the longer side; sizes and depths "
            "are rough: give --camera fx,fy,cx,cy, or move the camera sideways around the objects"
        ]
    if best.problem:
        return None, [f"no camera poses: {best.problem}; {_ADVICE}"], known_focal
    _sfm_refine(best.model, bool(known_focal or messages))
    return best.model, messages, known_focal or not messages


def _sfm_guess_focal(database: Path, guess: float, trusted: bool) -> None:
    """Set the camera's focal length to a guess, a share of the longer side."""
    with contextlib.closing(import_pycolmap().Database.open(str(database))) as db:
        camera = db.read_all_cameras()[0]
        focal = guess * max(camera.width, camera.height)
        camera.params = [focal, *camera.params[1:3], 0.0]
        camera.has_prior_focal_length = trusted
        db.update_camera(camera)


MIN_REGISTERED = 0.5  # refuse a model with fewer of the keyframes than this
MIN_POINTS = 100  # refuse a model with fewer 3D points
MIN_TRI_ANGLE_DEG = 1.5  # refuse a model of a smaller median triangulation angle
MIN_POINTS_PER_IMAGE = 30  # refuse a model with fewer 3D points in the median image
TRI_SAMPLE = 2000  # points used for the median triangulation angle


def _sfm_attempt(database: Path, rung: str, fixed: bool, count: int, seed: int) -> _Attempt:
    """Run a mapper on `count` keyframes, measure its largest model and name its first problem."""
    models = _sfm_map(database, rung, fixed, count, seed)
    if not models:
        return _Attempt()
    model = max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()))  # others: stubs
    camera = next(iter(model.cameras.values()))
    centre = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    registered = len(centre) / count
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    seen = [model.image(i).num_points3D for i in centre]
    parallax = _sfm_parallax_px(model)
    angle, depth = _sfm_angle_and_depth(model, centre, TRI_SAMPLE)
    spread = float(np.sqrt(np.var(list(centre.values()), axis=0).sum()) / max(depth, 1e-12))
    tests = (
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
    problem = next((text for bad, text in tests if bad), "")
    return _Attempt(model, registered, angle, parallax, spread, focal, problem)


def _sfm_map(database: Path, rung: str, fixed: bool, count: int, seed: int) -> list[Any]:
    """Run a mapper: "strict" or "relaxed" incremental, "global"; `fixed` keeps the intrinsics."""
    pc, out = import_pycolmap(), database.parent / rung
    out.mkdir(exist_ok=True)
    paths = (str(database), str(out), str(out))
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed}  # one: reproducible
    if rung == "global":
        if fixed:
            kept = {"refine_focal_length": False, "refine_extra_params": False}
            options["mapper"] = {"bundle_adjustment": kept}
        else:  # with a wrong focal length global mapping is wrong and looks right
            pc.calibrate_view_graph(str(database))
        return list(pc.global_mapping(*paths, options=options).values())
    options |= {"multiple_models": True, "min_model_size": 3, "extract_colors": False}
    options |= {"ba_global_frames_ratio": 1.4, "ba_global_points_ratio": 1.4}
    options |= {"ba_global_function_tolerance": 1e-5}
    options |= {"ba_refine_focal_length": not fixed, "ba_refine_extra_params": not fixed}
    options |= _RELAXED if rung == "relaxed" else {}
    done = itertools.count(2)
    tick = {"next_image_callback": lambda: _tell("mapping", min(next(done), count), count)}
    return list(pc.incremental_mapping(*paths, options=options, **tick).values())


REFINE_PX = 0.5  # soft L1 loss of the last adjustment, px of the working image
MAX_CENTER_SHIFT = 0.05  # most that the principal point may move, over the size


def _sfm_refine(model: Any, fixed: bool) -> None:
    """Adjust cameras and points once more; unless the intrinsics are `fixed`, with a second
    distortion term and the principal point (if that stays near the centre).
    """
    if fixed:
        _sfm_adjust(model, REFINE_PX, False, False)
        return
    camera = model.camera(1)
    size = np.array([camera.width, camera.height])
    focal, _, _, distortion = camera.params
    camera.model = import_pycolmap().CameraModelId.RADIAL
    for move_center in (True, False):
        camera.params = [focal, *size / 2, distortion, 0]
        _sfm_adjust(model, REFINE_PX, True, move_center)
        shift = np.abs(np.array([camera.principal_point_x, camera.principal_point_y]) - size / 2)
        if (shift <= MAX_CENTER_SHIFT * size).all():
            break


def _sfm_adjust(model: Any, loss_px: float, calibrate: bool, move_center: bool) -> None:
    """Bundle adjustment of all images with a robust loss, first and second camera as gauge."""
    pc = import_pycolmap()
    options, chosen = pc.BundleAdjustmentOptions(), pc.BundleAdjustmentConfig()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = calibrate
    options.refine_principal_point = move_center
    options.ceres.loss_function_type = pc.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1  # the same result every time
    for i in model.reg_image_ids():
        chosen.add_image(i)
    chosen.fix_gauge(pc.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pc.create_default_bundle_adjuster(options, chosen, model).solve()


def _sfm_angle_and_depth(model: Any, centre: dict[int, Array], sample: int) -> tuple[float, float]:
    """Medians over points: widest triangulation angle (degrees), distance from the cameras."""
    ids = sorted(model.point3D_ids())
    angles, depths = [0.0][: not ids], [0.0][: not ids]
    for point_id in ids[:: max(1, len(ids) // sample)]:
        point = model.point3D(point_id)
        rays = point.xyz - np.array([centre[e.image_id] for e in point.track.elements])  # (L, 3)
        length = np.linalg.norm(rays, axis=1)
        unit = rays / length[:, None]
        angles.append(math.degrees(math.acos(float(np.clip((unit @ unit.T).min(), -1, 1)))))
        depths.append(float(np.median(length)))
    return float(np.median(angles)), float(np.median(depths))


def _sfm_parallax_px(model: Any) -> float:
    """Measure what pure turns cannot explain: median residual of the best turn; 95 % of the image
    pairs are below. (A camera that only turned looks sound otherwise: a wrong focal length makes
    up triangulation angles.)
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
            if len(both) >= 15:
                one, other = (np.array([rays[i][p] for p in both]) for i in (a, b))  # (n, 3)
                turned = Rotation.align_vectors(other, one)[0].apply(one)
                residuals.append(np.median(np.linalg.norm(turned - other, axis=1)))
    widest = float(np.percentile(residuals, 95)) if residuals else 0.0
    return widest * float(model.camera(1).mean_focal_length())


def _sfm_write(
    model: Any, images: Any, folder: Path, names: list[str], native: tuple[int, int]
) -> None:
    """Write a COLMAP model in native pixels with the real names; points get their first colour."""
    height, width = images.shape[1:3]
    for point_id in model.point3D_ids():
        point = model.point3D(point_id)
        seen = point.track.elements[0]
        xy = model.image(seen.image_id).point2D(seen.point2D_idx).xy.astype(int)
        x, y = xy.clip(0, (width - 1, height - 1))
        point.color = images[seen.image_id - 1, y, x, ::-1]
    scale = np.array(native) / (width, height)
    for image_id, image in model.images.items():
        image.name = names[image_id - 1]
        for p in image.points2D:
            p.xy = p.xy * scale
    model.camera(1).rescale(*native)
    folder.mkdir()
    model.write(str(folder))


if __name__ == "__main__":
    _sfm_child(sys.argv[1])
