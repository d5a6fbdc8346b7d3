"""Reconstruction of the keyframes by pycolmap, in a child process.

`reconstruct` hands the keyframes over as files. The child (`mapping_child`) extracts features,
matches pairs, estimates the focal length from them and runs one or two mappers; it adjusts what
they make, takes apart what does not hold together (`consistency`, `zoom`) and keeps the parts that
are sound (`soundness`). Which frames are keyframes and where the frames between them are is not
decided here.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import itertools
import json
import shutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, import_pycolmap
from reobj.files import Progress, atomic, load_cached, load_json, spans, writing
from reobj.poses.adjustment import SAME_FOCAL, Adjusted, adjusted, refine
from reobj.poses.child_job import Child, send_progress, serve
from reobj.poses.features import choose_pairs, extract_features, match_pairs
from reobj.poses.soundness import MIN_PART_IMAGES, SURE_CENTRE_SIGMA, Part, confirmed, measured
from reobj.poses.verification import (
    MIN_MATCHES,
    MatchedPairs,
    consistent_groups,
    count_explained,
    focal_from_pairs,
    read_pairs,
)
from reobj.poses.zoom import MIN_ZOOM, constant_focal
from reobj.types import Array, Image, IntArray

HOW_TO_FILM = (  # said where no cause is established
    "what helps: things with texture in view, more overlap, sharp pictures, a camera that moves "
    "sideways and does not only turn, measured intrinsics (--camera)"
)
OR_POSES = "or give --poses; identities in 2D need none"


@dataclass(frozen=True, slots=True)
class Mapped:
    """What came of a reconstruction.

    Attributes:
        models: folders of COLMAP models, one for each rigid part, the largest first; in native
            pixels, with the names that were given. messages: what the user should know.
        alone: ids of keyframes without a verified match with another one.
    """

    models: list[Path]
    messages: list[str]
    alone: frozenset[int] = frozenset()


def mapping_child(work_dir: Path) -> Child:
    """Start the child process that maps below `work_dir`, with its log there."""
    return Child("reobj.poses.mapping", work_dir / "mapping", work_dir / "pycolmap.log")


def reconstruct(
    images: Sequence[Image],
    ids: Sequence[int],
    frames: Sequence[int],
    names: Sequence[str],
    moving_boxes: Sequence[Array],
    size: tuple[int, int],
    *,
    camera: Camera | None,
    focal_guess: float,
    seed: int,
    child: Child,
    work_dir: Path,
    progress: Callable[[str, int], Progress],
) -> Mapped:
    """Reconstruct keyframes into COLMAP models below `work_dir`.

    Features and matches stay in `work_dir/mapping`: a run that was killed, or one with more
    keyframes of the same video, goes on from there.

    Args:
        images: (h, w, 3) BGR, resized. ids: of each, above 0, in the order of time.
        frames: their numbers in the video, for messages. names: of the images in the models.
        moving_boxes: (N, 4) xyxy of each image, native pixels: no features there.
        size: (w, h), native. camera: kept as it is; None: calibrated.
        focal_guess: over the longer side, used where the matches do not tell the focal length.
        child: `mapping_child` of `work_dir`.
    """
    folder = work_dir / "mapping"
    for old in work_dir.glob("sparse*"):
        shutil.rmtree(old)
    if len(images) < 3:
        blank = "no picture shows anything that can be followed (black, blank or blurred)"
        what = f"only {len(images)} different views" if len(images) else blank
        return Mapped([], [f"no camera poses: {what}; {HOW_TO_FILM}; {OR_POSES}"])
    scale = np.tile(np.array(images[0].shape[1::-1]) / size, 2)
    boxes = [(xyxy * scale).tolist() for xyxy in moving_boxes]
    job = {
        "ids": list(ids),
        "frames": list(frames),
        "names": list(names),
        "boxes": boxes,
        "camera": None if camera is None else [camera.model, list(camera.params)],
        "size": size,
        "guess": focal_guess,
        "seed": seed,
        "images": {
            str(number): hashlib.sha256(image.tobytes() + json.dumps(box).encode()).hexdigest()
            for number, image, box in zip(ids, images, boxes, strict=True)
        },
    }
    path = folder / "job.json"
    if not _may_go_on(path, job):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    with writing(folder):
        np.save(folder / "keyframes.npy", np.stack(images))
    with atomic(path) as part:
        part.write_text(json.dumps(job))
    (folder / "messages.json").unlink(missing_ok=True)
    ahead = threading.Thread(target=_import_ahead)

    def begun(stage: str, total: int) -> Progress:
        if stage == MAPPING and ahead.ident is None:  # one core of the child's is idle from now on
            ahead.start()
        return progress(stage, total)

    problem = child.run(begun)
    if ahead.ident is not None:
        ahead.join()
    if not (folder / "messages.json").exists():
        path.unlink()  # from the beginning the next time: what it left may be why
        why = f"no camera poses: the reconstruction {problem}; give --poses"
        return Mapped([], [why])
    models = []
    for model in sorted(folder.glob("sparse*"), key=lambda p: (len(p.name), p.name)):
        models.append(model.replace(work_dir / model.name))
    said = json.loads((folder / "messages.json").read_text())
    return Mapped(models, said["messages"], frozenset(said["alone"]))


MAPPING = "mapping"  # stage of the child that takes one core
LATER = ("onnxruntime", "filterpy.kalman", "av")  # packages of later stages, beside pycolmap


def _import_ahead() -> None:
    """Import what later stages need, while this process waits."""
    with contextlib.suppress(ImportError):
        import_pycolmap()  # leaves signals alone, which a plain import does not
    for name in LATER:
        with contextlib.suppress(ImportError):  # optional, or said where it is needed
            importlib.import_module(name)


def _may_go_on(path: Path, job: dict[str, Any]) -> bool:
    """Tell whether the database beside a job serves another: same camera, images and boxes."""
    old, new = load_cached(path, load_json), json.loads(json.dumps(job))
    if not isinstance(old, dict) or not isinstance(old.get("images"), dict):
        return False
    same = all(old.get(key) == new[key] for key in ("camera", "size", "seed"))
    images = old["images"].items()
    return same and all(new["images"].get(number) == text for number, text in images)


def _reconstruct_job(folder: Path) -> None:
    """Reconstruct the keyframes of a job folder into messages.json and sparse*/ (child process)."""
    pc = import_pycolmap()
    pc.logging.minloglevel = 0  # stderr is the log file here
    job = json.loads((folder / "job.json").read_text())
    images = np.load(folder / "keyframes.npy", mmap_mode="r")  # (K, h, w, 3) BGR
    database, size = folder / "database.db", (images.shape[2], images.shape[1])
    camera = _start_camera(job, size)
    extract_features(database, images, job["ids"], job["boxes"], camera)
    match_pairs(database, choose_pairs(database, job["ids"], job["seed"]), job["seed"])
    pairs = read_pairs(database)
    focal = None if job["camera"] is not None else focal_from_pairs(pairs, size)
    frames = dict(zip(job["ids"], job["frames"], strict=True))
    search = _Search(database, frames, pairs, job["camera"] is not None, job["seed"])
    parts, messages = search.run(focal, job["guess"])
    for old in folder.glob("sparse*"):
        shutil.rmtree(old)
    for number, part in enumerate(parts):
        name = f"sparse_part{number}" if number else "sparse"
        _write_native_model(part, images, folder / name, job)
    alone = sorted(set(job["ids"]) - set(np.unique(pairs.image_ids[pairs.enough]).tolist()))
    (folder / "messages.json").write_text(json.dumps({"messages": messages, "alone": alone}))


FOCAL_GUESS = 0.8  # focal length over the longer side where nothing tells it (phones: .72-.85)


def _start_camera(job: dict[str, Any], size: tuple[int, int]) -> Any:
    """Make the camera of the resized images: as given, or to be calibrated."""
    if job["camera"] is None:
        pc, focal = import_pycolmap(), job["guess"] * max(size)
        return pc.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, *size)
    model, params = job["camera"]
    width, height = job["size"]
    camera = Camera(model, width, height, tuple(params)).to_pycolmap()
    _rescale(camera, size)
    camera.has_prior_focal_length = True
    return camera


GOOD_REGISTERED = 0.9  # share of the keyframes in sound parts that ends the search (chosen)
GOOD_EXPLAINED = 0.9  # and of the verified matches (measured: right .91-1, wrong up to .89)
# Largest centre_sigma of parts of the first mapper whose focal length the matches alone tell too
# (chosen: time; not of the second: it is asked where the first differs from what they tell)
TOLD_CENTRE_SIGMA = 0.0012
PREFERRED = 1.1  # weight of what the global mapper explains (chosen)
MAX_ROUNDS = 3  # of reconstructions without the images of other focal lengths (chosen)


class _Search:
    """Search for the mapper whose model holds together best.

    Attributes:
        ids: of the keyframes in the order of time. pairs: their verified matches.
        frames: numbers of the keyframes, for messages. fixed: the intrinsics are known.
        told: focal length that the matches tell, over the longer side.
    """

    def __init__(
        self, database: Path, frames: dict[int, int], pairs: MatchedPairs, fixed: bool, seed: int
    ) -> None:
        self.database, self.ids, self.pairs = database, list(frames), pairs
        self.frames, self.fixed, self.seed = frames, fixed, seed
        self.told: float | None = None

    def run(self, focal: float | None, guess: float) -> tuple[list[Any], list[str]]:
        """Try mappers until sound parts hold nearly all keyframes.

        Images of another focal length are left out as soon as they are found.

        Args:
            focal: what the matches tell, over the longer side. guess: used where they do not.
        Returns:
            models of the parts, the largest first ([]: none is sound); messages.
        """
        self.told, zooms = focal, list[tuple[int, int, float]]()
        for _ in range(MAX_ROUNDS):
            best, messages = self._best(guess)
            known = [p for p in best if self.fixed or self.told is not None or p.calibrated]
            known = [p for p in known if not p.problem] or known  # little parallax tells no zoom
            others, changes = constant_focal([part.arrays for part in known])
            if not len(others):
                break
            zooms += changes
            self.ids = [i for i in self.ids if i not in set(others.tolist())]
            self.pairs = self.pairs.only(self.ids)
            if self.told is not None:  # by pictures of several focal lengths so far
                camera = best[0].arrays.camera
                size = camera.width, camera.height
                self.told = focal_from_pairs(self.pairs, size)
        else:
            best = [replace(part, problem="the focal length keeps changing") for part in best]
        if self.fixed and zooms:  # which of the focal lengths is that of the camera?
            why = "its pictures were taken at another focal length than that of the given camera"
            best = [part if self._of_camera(part) else replace(part, problem=why) for part in best]
        sound = [part for part in best if not part.problem]
        if not sound:
            problem = best[0].problem if best else "no two keyframes make a first model"
            advice = (best[0].help if best else "") or HOW_TO_FILM
            return [], [f"no camera poses: {problem}; {self._matched()}; {advice}; {OR_POSES}"]
        messages = [
            f"the focal length changed between frames {self.frames[a]} and {self.frames[b]} "
            f"(x {ratio:.2f}): only the frames of one focal length have poses; do not zoom"
            for a, b, ratio in zooms
        ] + messages
        for part in sound:
            if len(unsure := np.setdiff1d(part.arrays.ids, part.held)):
                frames = spans([self.frames[i] for i in unsure.tolist()])
                messages.append(
                    f"keyframes {frames} are left out: where they are is uncertain, and no second "
                    "way of mapping puts them in the same place"
                )
        for part in best:
            ids = part.arrays.ids.tolist()
            if part.problem and len(ids) >= MIN_PART_IMAGES:
                ends = f"frames {self.frames[ids[0]]}-{self.frames[ids[-1]]}"
                messages.append(f"a part of the video ({ends}) has no poses: {part.problem}")
        return self._one_camera(sound), messages

    def _matched(self) -> str:
        """Say what the matches of the keyframes are like."""
        enough = self.pairs.enough
        flat = int(np.isnan(self.pairs.fundamental[enough, 0, 0]).sum())
        return (
            f"{enough.sum()} pairs of {len(self.ids)} keyframes have {MIN_MATCHES} verified "
            f"matches at least, {flat} of them as a plane or a mere turn gives them"
        )

    def _best(self, guess: float) -> tuple[list[Part], list[str]]:
        """Choose the mapper whose sound parts explain most of the verified matches.

        The incremental mapper is fast and right where the parallax is strong; where it is weak, it
        ends in a wrong one of many nearly equal solutions more often than the global mapper, which
        needs a focal length and is believed unless it explains clearly less. The focal length that
        the matches tell, or else the incremental mapper, is held: freed too early it drifts to a
        wrong one, and pieces are joined wrongly. The last adjustment frees it.

        Args:
            guess: focal length over the longer side, where the matches do not tell it.
        """
        start, told = self.told or guess, self.fixed or self.told is not None
        if not told:
            _set_focal(self.database, start, False)
            best = confirmed(self._parts("incremental", False), [], told)
            if best and best[0].calibrated:
                if self._is_sure(best):
                    return best, []
                start = best[0].focal
        if not self.fixed:
            _set_focal(self.database, start, True)
        best = self._parts("incremental", True)
        if not self._is_sure(best, TOLD_CENTRE_SIGMA):
            other = self._parts("global", True)
            if self._is_sure(other):
                best = other
            else:
                best, other = confirmed(best, other, told), confirmed(other, best, told)
                best = max(
                    other, best, key=lambda p: _explained(p) * (PREFERRED if p is other else 1)
                )
        if self.fixed or not best or best[0].problem or best[0].calibrated:
            return best, []
        ids = best[0].arrays.ids.tolist()
        return best, [
            f"the images of frames {self.frames[ids[0]]}-{self.frames[ids[-1]]} do not tell the "
            "focal length (a camera that moves should turn too): it is taken as "
            f"{start:.3g} x the longer side, depths are rough; give --camera fx,fy,cx,cy, or walk "
            "around the objects"
        ]

    def _one_camera(self, sound: list[Part]) -> list[Any]:
        """Adjust smaller parts with the camera of the largest: one camera took them all.

        Images that are not to be kept are left out; they are located by the rest, if it sees them.
        """
        models = list[Any]()
        for part in sound:
            model, all_held = part.model, len(part.held) == len(part.arrays.ids)
            if not all_held:
                model = _only(model, set(part.held.tolist()))
            if models:
                own, camera = model.camera(1), models[0].camera(1)
                own.model, own.params = camera.model, camera.params
            if models or not all_held:
                refine(model)
            models.append(model)
        return models

    def _of_camera(self, part: Part) -> bool:
        """True if a part's focal length comes out as the given one when it is freed."""
        free = adjusted(part.model, True)
        log = np.log(free.arrays.focal_over_size / part.focal)
        return free.calibrated and bool(abs(log) < MIN_ZOOM)

    def _is_sure(self, parts: list[Part], told_sigma: float = SURE_CENTRE_SIGMA) -> bool:
        """True if parts of strong geometry hold and explain nearly all.

        Args:
            told_sigma: limit of centre_sigma where the matches tell the same focal length.
        """
        sure = list[Part]()
        for part in parts:
            same = self.told is not None and abs(np.log(self.told / part.focal)) < SAME_FOCAL
            limit = told_sigma if self.fixed or same else SURE_CENTRE_SIGMA
            if not part.problem and part.centre_sigma <= limit:
                sure.append(part)
        registered, matched = sum(p.registered for p in sure), sum(map(len, self.pairs.inliers))
        return registered >= GOOD_REGISTERED and _explained(sure) >= GOOD_EXPLAINED * matched

    def _parts(self, mapper: str, held: bool) -> list[Part]:
        """Run a mapper and measure the parts of its models that hold together, largest first.

        What is checked is what comes out: the models are adjusted before.
        """
        taken, parts = set[int](), list[Part]()
        groups = list[tuple[IntArray, Adjusted]]()
        for model in _run_mapper(self.database, mapper, held, self.ids, self.seed):
            whole = adjusted(model, not self.fixed)
            groups += [(group, whole) for group in consistent_groups(whole.arrays, self.pairs)]
        for group, whole in sorted(groups, key=lambda found: -len(found[0])):
            kept, alone = set(group.tolist()) - taken, whole  # models may overlap
            if len(kept) < len(whole.arrays.ids):
                alone = adjusted(_only(whole.model, kept), not self.fixed)
            explained = int(count_explained(alone.arrays, self.pairs).sum())
            part = measured(
                alone.model,
                alone.arrays,
                alone.centre_sigma,
                count=len(self.ids),
                explained=explained,
                calibrated=alone.calibrated,
            )
            parts.append(part)
            taken |= set() if part.problem else kept
        return sorted(parts, key=lambda p: (bool(p.problem), -p.registered))


def _explained(parts: list[Part]) -> int:
    """Count the verified matches that sound parts explain."""
    return sum(part.explained for part in parts if not part.problem)


def _only(model: Any, image_ids: set[int]) -> Any:
    """Return a copy of a model with some of its images alone."""
    made = import_pycolmap().Reconstruction(model)
    for image_id in sorted(made.reg_image_ids()):
        if image_id not in image_ids:
            made.deregister_frame(made.image(image_id).frame_id)
    return made


def _set_focal(database: Path, guess: float, trusted: bool) -> None:
    """Set the focal length in the database to a guess over the longer side, without distortion."""
    with contextlib.closing(import_pycolmap().Database.open(str(database))) as db:
        camera = db.read_all_cameras()[0]
        focal = guess * max(camera.width, camera.height)
        camera.params = [focal, *camera.params[1:3], 0.0]
        camera.has_prior_focal_length = trusted
        db.update_camera(camera)


WEAK_GEOMETRY = {  # COLMAP's options, so that weak parallax is taken too (chosen)
    "mapper": {"init_min_tri_angle": 4, "init_min_num_inliers": 40, "abs_pose_min_num_inliers": 15,
               "abs_pose_min_inlier_ratio": 0.15, "filter_min_tri_angle": 0.5},
    "triangulation": {"min_angle": 0.5},
}  # fmt: skip


def _run_mapper(database: Path, mapper: str, held: bool, ids: list[int], seed: int) -> list[Any]:
    """Run a mapper ("incremental" or "global") on some images, return all its models.

    Args:
        held: the intrinsics in the database are kept.
    """
    pc, out, count = import_pycolmap(), database.parent / mapper, len(ids)
    out.mkdir(exist_ok=True)
    paths = (str(database), str(out), str(out))
    options: dict[str, Any] = {"num_threads": 1, "random_seed": seed}  # one: reproducible
    options["image_names"] = [f"{number:06d}" for number in ids]
    if mapper == "global":  # only with a known focal length: with a wrong one it looks right
        kept = {"refine_focal_length": False, "refine_extra_params": False}
        options["mapper"] = {"bundle_adjustment": kept}
        return list(pc.global_mapping(*paths, options=options).values())
    options |= {"multiple_models": True, "min_model_size": 3, "extract_colors": False}
    # global adjustment more rarely and less exactly than by default (chosen: time; one follows)
    options |= {"ba_global_frames_ratio": 2.0, "ba_global_points_ratio": 2.0}
    options |= {"ba_global_function_tolerance": 1e-5, "ba_global_max_refinements": 1}
    options |= {"ba_local_max_refinements": 1}
    options |= {"ba_refine_focal_length": not held, "ba_refine_extra_params": not held}
    options |= WEAK_GEOMETRY
    done = itertools.count(2)
    tick = {"next_image_callback": lambda: send_progress(MAPPING, min(next(done), count), count)}
    return list(pc.incremental_mapping(*paths, options=options, **tick).values())


TWO_FOCALS = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}


def _rescale(camera: Any, size: Sequence[int]) -> None:
    """Rescale a pycolmap camera to (w, h); to pixels of another shape with two focal lengths."""
    width, height = size
    if abs(width / camera.width * camera.height - height) > 2 and camera.model.name in TWO_FOCALS:
        focal, x, y, *terms = camera.params
        camera.model = getattr(import_pycolmap().CameraModelId, TWO_FOCALS[camera.model.name])
        most = len(camera.params_info.split(",")) - 4
        camera.params = [focal, focal, x, y, *terms, *[0.0] * (most - len(terms))]
    camera.rescale(*size)


def _write_native_model(model: Any, images: Any, folder: Path, job: dict[str, Any]) -> None:
    """Write the model in native pixels with the frames' names; points get a colour."""
    height, width = images.shape[1:3]
    images = images.view(np.ndarray)  # a memmap's own rows are slow
    index = {number: k for k, number in enumerate(job["ids"])}
    for point_id in model.point3D_ids():
        point = model.point3D(point_id)
        seen = point.track.elements[0]  # the colour is that of the first observation
        xy = model.image(seen.image_id).point2D(seen.point2D_idx).xy.astype(int)
        x, y = xy.clip(0, (width - 1, height - 1))
        point.color = images[index[seen.image_id], y, x, ::-1]
    scale = np.array(job["size"]) / (width, height)
    for image_id, image in model.images.items():
        image.name = job["names"][index[image_id]]
        for p in image.points2D if (scale != 1).any() else ():
            p.xy = p.xy * scale
    _rescale(model.camera(1), job["size"])
    folder.mkdir()
    model.write(str(folder))


if __name__ == "__main__":
    import_pycolmap()  # before there is something to do
    serve(_reconstruct_job)
