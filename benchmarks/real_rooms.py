#!/usr/bin/env python3
"""Score the whole pipeline on recordings with annotated objects, in one table.

    python benchmarks/real_rooms.py DATA -o OUT --choosing [--only NAME...] [--seeds 901 902]
    python benchmarks/real_rooms.py DATA -o OUT --choosing --without all --noises 3
    python benchmarks/real_rooms.py DATA -o OUT --choosing --results benchmarks

DATA holds hololens_kitchen, redkitchen_7scenes, office_loop, livingroom13 and studio_room. The
example clip and rendered rooms (--seeds, made by render_room.py) need no data. All of them except
the rooms for reporting were used for choosing (splits.json); --choosing includes these, marked.
Every recording runs with the defaults in a process of its own. OUT keeps the cache of `run`:
detections, cameras and tracks of an earlier call are reused, so use another OUT after a change of
the detector, the cameras or the tracker; objects are always computed again. --without NAME turns a
mechanism off. --noises N estimates the objects N times, from boxes with Gaussian noise of half a
pixel, and prints the means, because this noise alone changes one or two objects. --results FOLDER
writes the tables between their markers in FOLDER/RESULTS.md. Writes OUT/real_rooms.md and .json;
with --without, OUT/left_out.md and .json.

Columns. An object is *listed* if it is not `doubtful`; only the shapes of listed objects count.
    IDF1       boxes of listed identities, as in tracks.txt. hololens_kitchen: six classes at
               IoU >= .3, because its boxes are amodal; objects less visible than .3 are optional.
               Recordings with object lists: IoU >= .4. Others: as `eval`; on redkitchen_7scenes
               the completely annotated classes.
    found      hololens_kitchen: chairs with a shape of that class within .35 m, or a third of the
               longest side if that is more, horizontally and one to one. Recordings for `eval`:
               true objects whose identity has a shape. Others: true objects matched by a listed
               object.
    doubles    further shapes within that distance of a matched chair; further listed objects of a
               matched true object
    elsewhere  shapes of chairs near no true chair; listed objects that match no true object. An
               object matches a true one if it overlaps it in half of its frames (IoU >= .4) and has
               its class or a confusable one; areas without annotation are ignored.
    centre, size   medians over objects found; own cameras are first aligned with the true ones
    in 2 sigma     sides of these objects whose log is within 2 sigma of the true one
    confidence     an object is real if no other object matches its true object better, in 3D
               (hololens_kitchen) or in 2D; classes without annotation are ignored
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import pkgutil
import resource
import shutil
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))
import render_room
from splits import add_choosing, marked, room_of, usable
from synthetic_quadrics import table, write_table

import quadrics
import reobj_track as rt
from reobj.objects.confidence import LOW_CONFIDENCE
from reobj.objects.fit import link_and_fit
from reobj.objects.observations import Views
from reobj.results.evaluation_3d import align_with_truth, fraction_within_2_sigma, sizes_in_sigma
from reobj.results.truth import LabelledBoxes, Role, read_result, read_truth
from reobj.types import Array, BoolArray, IntArray, box_area, box_iou, rows_by

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
YOLO, FEMTO, RECORDED = "detections_yolov8s.csv", "detections_femto.csv", "detections.npz"
TRUE = "true_boxes.csv"
DETECTOR = rt.DetectConfig(model="deimv2-femto")  # the default one cannot be had everywhere
BOXES = {
    "": DETECTOR.model,
    YOLO: "YOLOv8s",
    FEMTO: "deimv2-femto",
    RECORDED: "recorded",
    TRUE: "true",
}
# Classes of which all objects are annotated, where that is not so of all classes
COMPLETE = {"redkitchen_7scenes": ("chair", "dining table", "cup")}
Figures = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One run: a recording, whose boxes, whose cameras."""

    name: str
    data: str  # folder in DATA; "" for the example clip
    boxes: str = ""  # recorded detections; "" for the default detector
    supplied: bool = False  # poses and intrinsics
    min_score: float = DETECTOR.min_score
    seed: int | None = None  # of a rendered room

    @property
    def title(self) -> list[str]:
        """Return the recording, its boxes and its cameras."""
        boxes = BOXES[self.boxes] + (
            f" from {self.min_score:g}" if self.min_score != DETECTOR.min_score else ""
        )
        where = self.data or ("examples/room" if self.seed is None else f"rendered {self.seed}")
        return [marked(*self.split, where), boxes, "supplied" if self.supplied else "own"]

    @property
    def split(self) -> tuple[str, str]:
        """Return the kind and the name by which splits.json knows the recording."""
        if self.data:
            return "recordings", self.data
        return "rooms", "0" if self.seed is None else room_of(self.seed, "varied")


CASES = [
    Case("kitchen-true", "hololens_kitchen", TRUE, supplied=True),
    Case("kitchen-yolo", "hololens_kitchen", YOLO, supplied=True),
    Case("kitchen-femto", "hololens_kitchen", FEMTO, supplied=True, min_score=0.05),
    Case("kitchen-own", "hololens_kitchen", YOLO),
    Case("redkitchen", "redkitchen_7scenes", YOLO, supplied=True),
    Case("office-yolo", "office_loop", YOLO),
    Case("office-femto", "office_loop"),
    Case("livingroom-yolo", "livingroom13", YOLO),
    Case("livingroom-femto", "livingroom13"),
    Case("studio-yolo", "studio_room", YOLO),
    Case("studio-femto", "studio_room"),
    Case("example-recorded", "", RECORDED),
    Case("example-femto", ""),
]


def nothing(*_: Any) -> None:
    """Replace a function whose result is not used."""


def all_visible(views: Views, *_: Any) -> BoolArray:
    """Replace the detection of occluded edges."""
    return np.zeros(views.boxes.shape, bool)


def never_seen_through(solids: quadrics.Ellipsoids, *_: Any) -> Array:
    """Stand in for what finds points behind solids."""
    return np.zeros(len(solids))


def untracked(rows: rt.Tracks) -> BoolArray:
    """Mark all detections that the tracker left out."""
    return np.asarray(rows.tracklet_id == 0)


# Ablations by name: replacements of values and functions of modules, and of defaults of options.
LIKELIHOOD = "reobj.objects.likelihood"
ASSOCIATION = "reobj.objects.association.AssociationOptions"
COMPONENT = "reobj.objects.component"
WITHOUT: dict[str, dict[str, Any]] = {
    "hidden edges": {f"{LIKELIHOOD}.OCCLUDED_EDGES": 0.0},
    "hidden edges in the fit": {
        "quadrics.RobustOptions.cauchy_hidden": quadrics.RobustOptions().cauchy,
        "quadrics.RobustOptions.huber_hidden": quadrics.RobustOptions().huber,
        "quadrics.RobustOptions.hidden_cap": quadrics.RobustOptions().outlier_cap,
    },
    "edges behind nearer objects": {"reobj.objects.occlusion._occluded_by_nearer": all_visible},
    "edges above the floor": {"reobj.objects.occlusion.ABOVE_FLOOR": np.inf},
    "widening": {f"{ASSOCIATION}.widening_rounds": 0},
    "limit of a box": {f"{LIKELIHOOD}.MAX_BOX_EXISTENCE": 8.0},
    "classes": {f"{LIKELIHOOD}.CLASS_KEPT": 0.0},
    "sizes": {"reobj.objects.categories.SIZE_SIGMAS": 0.0},
    "missed frames": {f"{ASSOCIATION}.missed": 0.0},
    "tracklets": {f"{ASSOCIATION}.same_tracklet": 0.0},
    "untracked detections": {f"{COMPONENT}._duplicates": untracked},
    "clear detections in refits": {f"{ASSOCIATION}.unambiguous_margin": -1e3},
    "alternation": {f"{ASSOCIATION}.max_rounds": 0},
    "merging": {f"{ASSOCIATION}.merge_distance": 0.0},
    "distances along rays": {"reobj.objects.hypotheses.DEPTHS": np.empty(0)},
    "floor": {
        f"{COMPONENT}.find_floor": nothing,
        "reobj.objects.fit.find_floor": nothing,
    },
    "proposals of untracked": {f"{COMPONENT}.HYPOTHESIS_SCORE": np.inf},
    "points in the fit": {"reobj.objects.fit.points_on": nothing},
    "seen through": {f"{COMPONENT}.see_through_ratio": never_seen_through},
    "duplicate boxes": {f"{COMPONENT}.DUPLICATE_IOU": 2.0},
    "classes that differ": {f"{ASSOCIATION}.similar_log_size": 0.0},
    "same position": {f"{ASSOCIATION}.same_position": 0.0},
    "limit of a proposal's gain": {f"{ASSOCIATION}.max_box_gain": np.inf},
    "boxes at the border": {"reobj.objects.hypotheses.BORDER_WEIGHT": 1.0},
    "heights of standing objects": {"reobj.objects.hypotheses.STANDING_HEIGHTS": (0.0, 1e6)},
    "quartic size prior": {"quadrics.SIZE_WALL": 1e3},
    "tie of round objects": {"quadrics.ROUND_LOG": 1e3},
    "lower part occluded": {"quadrics.OCCLUDED_BELOW": 1e-12},
    "pooled noise": {"quadrics.OBJECT_NOISE_DOF": 1e-3},
    "votes of occluded objects": {
        "quadrics.VOTES": ((0.75, 0.0, 0.0), (0.25, 0.0, quadrics.UNKNOWN_SIZE.size_log))
    },
}


def leave_out(name: str) -> None:
    """Switch a mechanism off, in this process."""
    for path, value in WITHOUT[name].items():
        owner, _, attribute = path.rpartition(".")
        values = values_of(pkgutil.resolve_name(owner))
        if attribute not in values:
            raise SystemExit(f"error: --without {name}: {path} is no longer there")
        values[attribute] = value


def values_of(owner: Any) -> dict[str, Any]:
    """Return the values of a module, or the defaults of an options class: both can be replaced."""
    names: dict[str, Any] = vars(owner)
    if isinstance(owner, type):  # keyword-only fields of a dataclass
        names = names["__init__"].__kwdefaults__ or {}
    return names


# ---- Runs --------------------------------------------------------------------------------------


WITH_DOUBTFUL = "with_doubtful"  # folder in a run's: the same with the tracks of doubtful objects


def run_case(case: Case, data: Path, out: Path) -> Figures:
    """Run the tool on a recording; returns seconds and the peak memory of this process."""
    folder, config = data / case.data, configured(case, data, out)
    source: Path | None = folder / "images"
    if not case.data:
        folder = ROOM if case.seed is None else rendered(case.seed, out)
        source = folder / "room.mp4"
    detections = folder / case.boxes if case.boxes else None
    result = rt.run(source, out / case.name, config, detections=detections)
    result.save(out / case.name / WITH_DOUBTFUL, doubtful=True)
    return spent(result)


def configured(case: Case, data: Path, out: Path) -> rt.Config:
    """Make the options of a case: the defaults, without pictures."""
    config = rt.Config(
        detect=dataclasses.replace(DETECTOR, min_score=case.min_score),
        output=rt.OutputConfig(overlay=False, scene=False),
    )
    if not case.supplied:
        return config
    poses, camera = out / f"poses-{case.data}", str(data / case.data / "intrinsics.json")
    return dataclasses.replace(config, poses=rt.PosesConfig(mode=str(poses), camera=camera))


def write_poses(folder: Path, out: Path) -> None:
    """Write poses_c2w.txt, 4x4 world_from_cam a line, as one NAME.pose.txt for each image."""
    world_from_cam = np.loadtxt(folder / "poses_c2w.txt").reshape(-1, 4, 4)
    names = sorted(path.stem for path in (folder / "images").iterdir())
    if (folder / "images.txt").exists():  # the order of the rows
        names = [Path(line).stem for line in (folder / "images.txt").read_text().split()]
    out.mkdir(parents=True, exist_ok=True)
    for name, pose in zip(names, world_from_cam, strict=True):
        np.savetxt(out / f"{name}.pose.txt", pose)


def rendered(seed: int, out: Path) -> Path:
    """Render a room, once."""
    folder = out / f"rendered-{seed}-clip"
    if not (folder / "gt_objects.json").exists():  # written after the video
        render_room.main(["--seed", str(seed), "--plan", "varied", "-o", str(folder)])
    return folder


def spent(result: rt.Result) -> Figures:
    """Return the seconds of a run, and the peak memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # MB, where Linux counts KiB
    seconds = {k: round(v, 2) for k, v in result.seconds.items()}
    return {"objects_s": seconds["objects"], "seconds": seconds, "peak_mb": round(peak)}


def measure(case: Case, data: Path, out: Path, without: str = "", seed: int = 0) -> Figures:
    """Run and score a case; else the objects of a run are made again.

    Args:
        without: a mechanism, or several joined by " + ". seed: of the noise of the boxes; 0: as
            recorded.
    """
    if not without and not seed:
        return run_case(case, data, out) | score_case(case, data, out, out / case.name)
    for name in filter(None, without.split(" + ")):
        leave_out(name)
    if seed:
        shake(seed)
    folder = out / f"{case.name}-{zlib.crc32(without.encode()):08x}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(out / case.name, folder)
    for name in ("objects.json", "cache/last-links.npz"):  # else a refit keeps the identities
        (folder / name).unlink(missing_ok=True)
    result = rt.refit(folder, configured(case, data, out))
    result.save(folder / WITH_DOUBTFUL, doubtful=True)
    figures = spent(result) | score_case(case, data, out, folder)
    shutil.rmtree(folder)
    return figures


NOISE_PX = 0.5  # standard deviation of the edges


def shake(seed: int) -> None:
    """Add noise to all boxes before objects are made of them, in this process."""

    def shaken(
        result: rt.Result, config: rt.ObjectsConfig, phases: Any = None, last: Any = None
    ) -> rt.Result:
        rng = np.random.default_rng(seed)
        for name in ("tracks", "untracked"):
            rows = getattr(result, name)
            xyxy = rows.xyxy + rng.normal(0, NOISE_PX, rows.xyxy.shape)
            result = dataclasses.replace(result, **{name: dataclasses.replace(rows, xyxy=xyxy)})
        return link_and_fit(result, config, phases, last)

    rt.link_and_fit = shaken  # type: ignore[attr-defined]


def mean_of(runs: Sequence[Figures]) -> Figures:
    """Return the means of the figures of a case, and the confidence of the objects of all runs."""
    found: Figures = {"sure": [row for run in runs for row in run["sure"]], "runs": len(runs)}
    for key in {key for run in runs for key in run}:
        known = [run[key] for run in runs if isinstance(run.get(key), int | float)]
        if known:
            found[key] = float(np.mean(known))
    return found


def score_case(case: Case, data: Path, out: Path, folder: Path) -> Figures:
    """Score an output folder by the truth that there is for it."""
    truth = data / case.data
    if not case.data:
        truth = ROOM if case.seed is None else rendered(case.seed, out)
    if (truth / "gt_amodal.txt").exists():
        return score_solids(truth, folder)
    if (truth / "objects_2d.json").exists():
        return score_lists(truth, folder)
    figures = score_as_eval(truth, folder)
    if not case.data and case.seed is None:
        names = [o.class_name for o in rt.Result.load(folder).objects if o.counted]
        counts = Counter(names)
        figures["counts"] = {name: counts[name] for name in ("chair", "tv", "cup")}
    return figures


# ---- Identities and lists of objects, in 2D ----------------------------------------------------


def frames_of(truth: LabelledBoxes, found: LabelledBoxes) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the rows of truth (G,) and result (P,) of every frame that has both."""
    true_rows = {int(truth.frame[rows[0]]): rows for rows in rows_by(truth.frame)}
    for rows in rows_by(found.frame):
        if (frame := int(found.frame[rows[0]])) in true_rows:
            yield true_rows[frame], rows


def shares_inside(a_xyxy: Array, b_xyxy: Array) -> Array:
    """Return the fraction (A, B) of each box b inside each box a."""
    low = np.maximum(a_xyxy[:, None, :2], b_xyxy[:, :2])
    inter = (np.minimum(a_xyxy[:, None, 2:], b_xyxy[:, 2:]) - low).clip(0).prod(-1)
    return np.asarray(inter / np.maximum(box_area(b_xyxy), 1e-9))


def common_frames(truth: IntArray, found: IntArray) -> tuple[Array, IntArray, IntArray]:
    """Count pairs (K,) of a true and a found identity: table (G, P), its rows, its columns."""
    true_ids, g = np.unique(truth, return_inverse=True)
    ids, p = np.unique(found, return_inverse=True)
    common = np.zeros((len(true_ids), len(ids)))
    np.add.at(common, (g, p), 1)
    return common, true_ids, ids


INSIDE = 0.7  # fraction of a box inside that of an occluded object: assigned to it as well


def identity_f1(truth: LabelledBoxes, found: LabelledBoxes, min_iou: float) -> float:
    """Compute IDF1 within classes; boxes on nothing but Role.IGNORED truth are left out."""
    left_out = np.zeros(len(found), bool)
    true_id, found_id = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for t, f in frames_of(truth, found):
        same = truth.name[t][:, None] == found.name[f]  # (G, P)
        hit = same & (box_iou(truth.xyxy[t], found.xyxy[f]) >= min_iou)
        inside = same & (shares_inside(truth.xyxy[t], found.xyxy[f]) >= INSIDE)
        clear = truth.role[t] == Role.SCORED
        left_out[f] = (hit | inside)[~clear].any(0) & ~hit[clear].any(0)
        g, p = np.nonzero(hit & clear[:, None])
        true_id.append(truth.identity[t[g]])
        found_id.append(found.identity[f[p]])
    common, *_ = common_frames(np.concatenate(true_id), np.concatenate(found_id))
    right = common[linear_sum_assignment(-common)].sum()
    return float(2 * right / max((truth.role == Role.SCORED).sum() + (~left_out).sum(), 1))


@dataclass(frozen=True)
class Kind:
    """What is known of a true object in 2D; `names`: classes that it may have."""

    names: frozenset[str]
    ignore: bool = False  # an area that is not annotated: for `names`, or for all if there is none
    needed: bool = True  # False: it may be found

    @staticmethod
    def read(path: Path) -> dict[int, Kind]:
        """Read an objects_2d.json, by identity."""
        kinds = {}
        for entry in json.loads(path.read_text()):
            ignore = entry["class"] == "ignore"
            own = [entry["class"], *entry["also_ok"]]
            names = frozenset(entry.get("ignore_classes", ()) if ignore else own)
            kinds[entry["id"]] = Kind(names, ignore, entry.get("recall", True))
        return kinds

    def fits(self, name: str) -> bool:
        """Say whether an object of this class may be this one."""
        return name in self.names or (self.ignore and not self.names)


@dataclass(frozen=True)
class Verdicts:
    """Which of O objects show which of G true ones (K of them no areas).

    Attributes:
        shows: (O,) identity of the true object, or -1. unjudged: (O,) lies where nothing is
            annotated. common: (K, O) frames. boxes: (O,) that count. true_ids: (K,).
    """

    shows: IntArray
    unjudged: BoolArray
    common: IntArray
    boxes: IntArray
    true_ids: IntArray

    def best(self, able: BoolArray | None = None) -> BoolArray:
        """Mark the object (O,) with the most frames of each true one; able: (O,) candidates."""
        best = np.zeros(len(self.shows), bool)
        for k, true_id in enumerate(self.true_ids):
            own = (self.shows == true_id) & (True if able is None else able)
            if own.any():
                best[np.where(own, self.common[k], -1).argmax()] = True
        return best


def judge(
    truth: LabelledBoxes,
    kinds: dict[int, Kind],
    found: LabelledBoxes,
    objects: Sequence[rt.Object],
    min_iou: float = 0.4,
) -> Verdicts:
    """Say for every object which true one it shows in at least half of its frames."""
    row_of = {o.id: row for row, o in enumerate(objects)}
    true_ids = [k for k in kinds if not kinds[k].ignore]
    column = {k: i for i, k in enumerate(kinds)}
    fits = np.array([[kind.fits(o.class_name) for o in objects] for kind in kinds.values()], bool)
    fits = fits.reshape(len(kinds), len(objects))
    area = np.array([kind.ignore for kind in kinds.values()], bool)  # (G,)
    xyxy = np.clip(found.xyxy, 0, np.tile(truth.xyxy[:, 2:].max(0), 2))  # in the image
    use = (xyxy[:, 2:] > xyxy[:, :2]).all(1) & np.isin(found.identity, list(row_of))
    found = dataclasses.replace(found, xyxy=xyxy)[use]
    mine = np.array([row_of[i] for i in found.identity.tolist()], np.int64)  # (N,) object
    boxes = np.bincount(mine, minlength=len(objects))
    common, outside = np.zeros(fits.shape, np.int64), np.zeros(len(objects), np.int64)
    for t, f in frames_of(truth, found):
        g, o = np.array([column[i] for i in truth.identity[t].tolist()]), mine[f]
        able, here = fits[np.ix_(g, o)], area[g][:, None]  # (G, P), (G, 1)
        hit = able & ~here & (box_iou(truth.xyxy[t], found.xyxy[f]) >= min_iou)
        a, b = np.nonzero(hit)
        np.add.at(common, (g[a], o[b]), 1)
        within = able & here & (shares_inside(truth.xyxy[t], found.xyxy[f]) >= 0.5)
        np.add.at(outside, o[within.any(0) & ~hit.any(0)], 1)
    common = common[~area]
    most = common.max(0, initial=0)
    true = (most > 0) & (most >= 0.5 * (boxes - outside))
    shows = np.full(len(objects), -1)
    if len(true_ids):
        shows = np.where(true, np.array(true_ids)[common.argmax(0)], -1)
    unjudged = ~true & (boxes > 0) & (outside >= 0.5 * boxes)
    return Verdicts(shows, unjudged, common, boxes - outside, np.array(true_ids, np.int64))


# Frames of a true object that a list must hold: as many, or this fraction of those annotated
NEEDED_FRAMES, NEEDED_SHARE = 10, 0.25


def score_lists(truth_folder: Path, folder: Path) -> Figures:
    """Score the list of objects by true boxes with identities and areas (objects_2d.json)."""
    kinds = Kind.read(truth_folder / "objects_2d.json")
    truth = read_truth(truth_folder / "gt_mot.txt", rt.COCO_NAMES, 0.0)
    result = rt.Result.load(folder)
    every = judge(truth, kinds, read_result(folder / WITH_DOUBTFUL), result.objects)
    listed = [o for o in result.objects if o.counted]
    verdicts = judge(truth, kinds, read_result(folder), listed)
    frames = {k: int((truth.identity == k).sum()) for k in kinds}
    needed = {k for k, kind in kinds.items() if kind.needed and not kind.ignore}
    enough = min(NEEDED_FRAMES, NEEDED_SHARE * len(np.unique(truth.frame)))
    must = {k for k in needed if frames[k] >= enough}
    shown = verdicts.shows[verdicts.shows >= 0].tolist()
    judged = int((~verdicts.unjudged).sum())
    pairs = linear_sum_assignment(-verdicts.common)
    optional = np.array([k not in needed for k in verdicts.true_ids.tolist()], bool)
    right = verdicts.common[pairs]
    true_boxes = sum(frames[k] for k in needed) + right[optional[pairs[0]]].sum()
    return {
        "idf1": float(2 * right.sum() / max(true_boxes + verdicts.boxes.sum(), 1)),
        "true": len(must),
        "found": len(must & set(shown)),
        "doubles": len(shown) - len(set(shown)),
        "elsewhere": judged - len(shown),
        "precision": len(shown) / max(judged, 1),
        "recall": len(must & set(shown)) / max(len(must), 1),
        "sure": rated_objects(result.objects, every.best(), ~every.unjudged),
    }


Rated = tuple[float, bool, bool]  # confidence, is it real, has it a shape


def rated_objects(objects: Sequence[rt.Object], real: BoolArray, counts: BoolArray) -> list[Rated]:
    """List the confidence of objects that count beside the truth."""
    able = zip(objects, real.tolist(), counts.tolist(), strict=True)
    rated = [(o.confidence, r, o.center is not None) for o, r, c in able if c]
    return [(c, r, solid) for c, r, solid in rated if c is not None]


# ---- Solids ------------------------------------------------------------------------------------

REACH_M, REACH_OF_SIDE = 0.35, 1 / 3  # of a true object's centre, and of its longest side
WALK_KINDS = ("chair", "dining table", "couch", "backpack", "potted plant", "cup")
MIN_VISIBLE, AMODAL_IOU = 0.3, 0.3


@dataclass(frozen=True)
class Placed:
    """Objects with solids in the truth's world."""

    objects: list[rt.Object]
    center: Array  # (S, 3)
    rotation: Array  # (S, 3, 3) truth_from_obj
    size: Array  # (S, 3) extents along own axes

    @staticmethod
    def of(result: rt.Result, truth_poses: Path) -> Placed:
        """Bring solids, those of doubtful objects too, to the truth's world, part by part."""
        placed = Placed([], np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3)))
        for part in result.parts():
            own = [o for o in part.objects if o.center is not None]
            try:
                scale, turn, shift = align_with_truth(part, truth_poses)
            except rt.ReobjError:
                continue  # a part of hardly any frame
            axes = np.empty((0, 3, 3))
            if own:
                wxyz = np.array([o.quat_wxyz for o in own])
                axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix()
            center = np.array([o.center for o in own]).reshape(-1, 3)
            size = np.array([o.size for o in own]).reshape(-1, 3)
            placed = Placed(
                placed.objects + own,
                np.append(placed.center, scale * center @ turn.T + shift, 0),
                np.append(placed.rotation, turn @ axes, 0),
                np.append(placed.size, scale * size, 0),
            )
        return placed

    def __getitem__(self, keep: BoolArray) -> Placed:
        own = [o for o, k in zip(self.objects, keep.tolist(), strict=True) if k]
        return Placed(own, self.center[keep], self.rotation[keep], self.size[keep])


@dataclass(frozen=True)
class Matched:
    """Solids beside true objects of their class: M pairs, and what is left over.

    Attributes:
        true, solid: (M,). center_error: (M,) m. size_error: (M, 3) relative; in_sigma: (M, 3).
        doubles, elsewhere: how many other shapes lie within reach of a true one, and of none.
    """

    true: IntArray
    solid: IntArray
    center_error: Array
    size_error: Array
    in_sigma: Array
    doubles: int
    elsewhere: int


def match_solids(true: Sequence[dict[str, Any]], placed: Placed) -> Matched:
    """Match solids to true objects of their class one to one, in reach over ground (x, z)."""
    center, size, axes = boxes_of(true)
    full, flat, same, able = distances(true, placed)
    a, b = linear_sum_assignment(np.where(able, full, 1e3))
    a, b = a[able[a, b]], b[able[a, b]]
    other = np.setdiff1d(np.flatnonzero(same.any(0)), b)
    nearest = np.where(same, flat, np.inf)[:, other].argmin(0) if len(true) else other
    double = able[nearest, other]
    extents = [matched_extents(axes[i], placed, j) for i, j in zip(a, b, strict=True)]
    errors = np.abs(np.reshape(extents, (-1, 3)) / size[a] - 1)
    found, goal = (
        quadrics.Ellipsoids(*arrays)
        for arrays in (
            (placed.center[b], placed.size[b] / 2, placed.rotation[b]),
            (center[a], size[a] / 2, axes[a]),
        )
    )
    in_sigma = sizes_in_sigma(placed.objects, b, found, goal) if len(b) else errors
    counts = int(double.sum()), int((~double).sum())
    return Matched(a, b, full[a, b], errors, in_sigma, *counts)


def boxes_of(true: Sequence[dict[str, Any]]) -> tuple[Array, Array, Array]:
    """Return centres (G, 3), sizes (G, 3) and axes (G, 3, 3), columns, of true objects."""
    center, size, axes = (
        np.array([t[key] for t in true], np.float64) for key in ("center", "size", "R")
    )
    return center.reshape(-1, 3), size.reshape(-1, 3), axes.reshape(-1, 3, 3)


def distances(
    true: Sequence[dict[str, Any]], placed: Placed
) -> tuple[Array, Array, BoolArray, BoolArray]:
    """Compare true objects with solids: (G, S) each.

    Returns:
        metres between them, and over ground; they are of one class; and near enough to be one.
    """
    center, size, _ = boxes_of(true)
    names = np.array([o.class_name for o in placed.objects], str)
    apart = placed.center - center[:, None]  # (G, S, 3)
    flat, full = np.linalg.norm(apart[..., [0, 2]], axis=2), np.linalg.norm(apart, axis=2)
    same = np.array([t["coco"] or "" for t in true], str)[:, None] == names
    reach = np.maximum(REACH_M, REACH_OF_SIDE * size.max(1, initial=0))
    return full, flat, same, same & (flat <= reach[:, None])


def matched_extents(axes: Array, placed: Placed, solid: int) -> Array:
    """Return the extents (3,) of a solid along true axes, each along the one nearest to it."""
    _, own = linear_sum_assignment(-np.abs(axes.T @ placed.rotation[solid]))
    return np.asarray(placed.size[solid][own])


def score_solids(truth_folder: Path, folder: Path) -> Figures:
    """Score identities against boxes of whole objects, and solids of chairs (hololens_kitchen)."""
    classes = json.loads((truth_folder / "gt_amodal_format.json").read_text())["classes"]
    names = [classes.get(str(i), "") for i in range(max(map(int, classes)) + 1)]
    true = json.loads((truth_folder / "objects_gt.json").read_text())["objects"]
    boxes = (
        read_truth(truth_folder / "gt_amodal.txt", names, MIN_VISIBLE),
        read_result(folder),
        read_result(folder / WITH_DOUBTFUL),
    )
    truth, found, every = (x[np.isin(x.name, WALK_KINDS)] for x in boxes)
    placed = Placed.of(rt.Result.load(folder), truth_folder / "poses_c2w.txt")
    listed = placed[np.array([o.counted for o in placed.objects], bool)]
    chairs = [t for t in true if t["coco"] == "chair"]
    matched = match_solids(chairs, listed)
    return {
        "idf1_chairs": identity_f1(
            truth[truth.name == "chair"], found[found.name == "chair"], AMODAL_IOU
        ),
        "idf1": identity_f1(truth, found, AMODAL_IOU),
        "true": len(chairs),
        "found": len(matched.true),
        "doubles": matched.doubles,
        "elsewhere": matched.elsewhere,
        "centre_m": median(matched.center_error),
        "size_error": median(matched.size_error),
        "inside": fraction_within_2_sigma(matched.in_sigma),
        "sure": rated_shapes(true, placed, truth, every, rt.Result.load(folder).objects),
    }


def median(values: Array) -> float | None:
    """Return the median, None of nothing."""
    return float(np.median(values)) if values.size else None


def rated_shapes(
    true: Sequence[dict[str, Any]],
    placed: Placed,
    truth: LabelledBoxes,
    found: LabelledBoxes,
    objects: Sequence[rt.Object],
) -> list[Rated]:
    """Decide which objects are real, by their shapes, else by their boxes on the other objects.

    The most confident one takes the nearest true object first, as in COCO's average precision.
    """
    known = [t for t in true if t["coco"]]
    full, _, _, able = distances(known, placed)
    confidence = np.array([o.confidence or 0.0 for o in placed.objects])
    taken, real_ids = list[int](), set[int]()
    for s in np.argsort(-confidence, kind="stable").tolist():
        if able[:, s].any():
            nearest = int(np.where(able[:, s], full[:, s], np.inf).argmin())
            able[nearest] = False
            taken.append(known[nearest]["id"])
            real_ids.add(placed.objects[s].id)
    verdicts = judge(truth, kinds_of(truth), found, objects, AMODAL_IOU)
    bare = np.array([o.center is None for o in objects], bool)
    real = np.array([o.id in real_ids for o in objects], bool)
    real |= verdicts.best(bare & ~np.isin(verdicts.shows, taken))
    counted = np.array([o.class_name in WALK_KINDS for o in objects], bool)
    return rated_objects(objects, real, counted)


def kinds_of(truth: LabelledBoxes) -> dict[int, Kind]:
    """Make kinds of true objects that have the class of their boxes."""
    return {
        int(truth.identity[rows[0]]): Kind(frozenset([str(truth.name[rows[0]])]))
        for rows in rows_by(truth.identity)
    }


def score_as_eval(truth_folder: Path, folder: Path) -> Figures:
    """Score an output folder as `eval` does."""
    solids = truth_folder / "gt_objects.json"
    if not solids.exists():
        solids = truth_folder / "objects_gt.json"
    beside = (truth_folder / name for name in ("poses_c2w.txt", "poses.txt"))
    poses = next((path for path in beside if path.exists()), None)
    classes = COMPLETE.get(truth_folder.name, ())
    scores = rt.evaluate(folder, truth_folder / "gt_mot.txt", solids, poses, classes)
    tracks, in_3d = scores["tracks"], scores["objects"]
    truth = read_truth(truth_folder / "gt_mot.txt", rt.COCO_NAMES, 0.0)
    names = sorted(classes or set(truth.name))
    objects = rt.Result.load(folder).objects
    verdicts = judge(truth, kinds_of(truth), read_result(folder / WITH_DOUBTFUL), objects)
    annotated = np.array([o.class_name in names for o in objects], bool)
    return {
        "idf1_chairs": tracks["chair"]["IDF1"],
        "idf1": tracks["all"]["IDF1"],
        "ids": tracks["all"]["ids_per_object"],
        "true": in_3d["true"],
        "found": in_3d["found"],
        "centre_m": in_3d.get("center_error_median"),
        "size_error": in_3d.get("size_error_median"),
        "inside": in_3d.get("sizes_inside"),
        "o3d": in_3d.get("o3d_found"),
        "sure": rated_objects(objects, verdicts.best(), annotated),
    }


# ---- Tables and the picture --------------------------------------------------------------------


def percent(value: float) -> str:
    """Format a fraction as a percentage."""
    return f"{100 * value:.0f} %"


def short(value: float) -> str:
    """Format a score as .449."""
    return f"{value:.3f}".removeprefix("0")


def count(value: float) -> str:
    """Format a number of objects, or a mean of such."""
    return f"{value:.1f}".removesuffix(".0")


# Key of the figures, column of the table, format
COLUMNS: list[tuple[str, str, Callable[[Any], str]]] = [
    ("idf1_chairs", "IDF1 chairs", short),
    ("idf1", "IDF1", short),
    ("ids", "identities per object", "{:.2f}".format),
    ("found", "found", count),
    ("doubles", "doubles", count),
    ("elsewhere", "elsewhere", count),
    ("precision", "precision", short),
    ("recall", "recall", short),
    ("centre_m", "centre, m", short),
    ("size_error", "size", percent),
    ("inside", "in 2 sigma", percent),
    ("o3d", "O3D", short),
    ("objects_s", "objects step, s", "{:.1f}".format),
    ("peak_mb", "peak, MB", "{:.0f}".format),
]


def cells(figures: Figures) -> list[str]:
    """Format the columns of a row."""
    row = ["-" if figures.get(key) is None else form(figures[key]) for key, _, form in COLUMNS]
    at = [key for key, *_ in COLUMNS].index("found")
    row[at] = f"{row[at]} of {count(figures['true'])}"
    if counts := figures.get("counts"):
        row[at] += "; listed " + ", ".join(f"{number} {name}" for name, number in counts.items())
    return row


def figures_table(first: Sequence[str], rows: Sequence[tuple[Sequence[str], Figures]]) -> str:
    """Format rows of figures, without the columns that none of them has."""
    lines = [[*start, *cells(figures)] for start, figures in rows]
    head = [*first, *(title for _, title, _ in COLUMNS)]
    used = [i for i in range(len(head)) if any(line[i] != "-" for line in lines)]
    return table([head[i] for i in used], [[line[i] for i in used] for line in lines])


def left_out_table(made: dict[str, list[Figures]]) -> str:
    """Format a row for everything that is left out: means and sums over the recordings."""
    rows = []
    for without, figures in made.items():

        def values(key: str, of: Sequence[Figures] = figures) -> Array:
            return np.array([f.get(key) for f in of], np.float64)  # None: NaN

        change = np.nan_to_num(values("idf1") - values("idf1", made[""]))
        sums = [count(float(np.nansum(values(key)))) for key in ("found", "doubles", "elsewhere")]
        listed = [
            (f.get("runs", 1), r) for f in figures for c, r, _ in f["sure"] if c >= LOW_CONFIDENCE
        ]
        real, every = sum(r / runs for runs, r in listed), sum(1 / runs for runs, _ in listed)
        rows.append(
            [
                without or "nothing",
                short(float(np.nanmean(values("idf1")))),
                f"{change.min():+.3f} to {change.max():+.3f}" if without else "",
                *sums,
                f"{count(real)} of {count(every)}",
                short(float(np.nanmean(values("centre_m")))),
                percent(float(np.nanmean(values("size_error")))),
                f"{np.nansum(values('objects_s')):.0f}",
            ]
        )
    head = "without,IDF1,change,found,doubles,elsewhere,real of listed,centre m,size,objects step s"
    return table(head.split(","), rows)


BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def reliability(rated: Sequence[Rated]) -> list[tuple[int, float, float, float, float]]:
    """Bin objects by confidence.

    Returns:
        of every bin: objects, mean confidence, fraction that is real, and the 95 % interval of it
        (Wilson, JASA 1927); NaN in an empty bin.
    """
    confidence, real = np.array([row[:2] for row in rated], np.float64).reshape(-1, 2).T
    bin_of = np.digitize(confidence, BINS[1:-1])
    rows, z2 = [], 1.96**2
    for k in range(len(BINS) - 1):
        own = bin_of == k
        n = int(own.sum())
        if not n:
            rows.append((0, np.nan, np.nan, np.nan, np.nan))
            continue
        rate = float(real[own].mean())
        middle = (rate + z2 / (2 * n)) / (1 + z2 / n)
        reach = np.sqrt(z2 * (rate * (1 - rate) / n + z2 / (4 * n**2))) / (1 + z2 / n)
        rows.append((n, float(confidence[own].mean()), rate, middle - reach, middle + reach))
    return rows


def reliability_table(groups: dict[str, list[Rated]]) -> str:
    """Format the bins of the first group, and how many are real in the others."""
    lines = []
    for k, bins in enumerate(zip(*map(reliability, groups.values()), strict=True)):
        n, *numbers = bins[0]
        mean, rate, low, high = map(short, numbers)
        of = [f"{round(b[0] * b[2])} of {b[0]}" if b[0] else "-" for b in bins]
        whole = [mean, f"{rate} ({low} to {high})"] if n else ["-", "-"]
        lines.append([f"{BINS[k]:g} to {BINS[k + 1]:g}", *whole, *of])
    return table(["confidence", "mean", "real (95 %)", *(f"real: {g}" for g in groups)], lines)


def draw_reliability(groups: dict[str, list[Rated]], path: Path) -> None:
    """Draw the fraction of real objects over their confidence, a line for each group."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(3.8, 3.4), dpi=110, layout="constrained")
    axes.plot([0, 1], [0, 1], ":", color="0.5", lw=1)
    for name, rated in groups.items():
        count, mean, rate, low, high = np.array([row for row in reliability(rated) if row[0]]).T
        error = [rate - low, high - rate]
        label = f"{name}, {count.sum():.0f} objects"
        axes.errorbar(mean, rate, error, fmt="o-", ms=5, lw=1.4, capsize=3, label=label)
    axes.legend(frameon=False, fontsize=8)
    axes.set(xlim=(0, 1), ylim=(-0.02, 1.02), xlabel="confidence", ylabel="share that is real")
    axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)


# ---- Command line ------------------------------------------------------------------------------


def every_without(names: Sequence[str]) -> list[str]:
    """Name what is left out, in turn; "all" for everything that can be."""
    unknown = set(names) - {*WITHOUT, "all"}
    if unknown:
        known = ", ".join(WITHOUT)
        raise SystemExit(f"error: --without {', '.join(sorted(unknown))}: not among all, {known}")
    return list(WITHOUT) if "all" in names else list(names)


def chosen(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """Choose cases whose names begin with one of these; all if none is given."""
    found = [c for c in cases if not names or any(c.name.startswith(name) for name in names)]
    if not found:
        raise SystemExit(f"error: --only: not among {', '.join(c.name for c in cases)}")
    return found


def add_cases(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that choose recordings and the folder of their runs."""
    add: Callable[..., Any] = parser.add_argument
    add("data", type=Path, help="folder of the recordings")
    add("-o", "--out", type=Path, required=True, help="folder for the runs and the tables")
    text = "\n".join(f"{c.name:<14} {', '.join(c.title)}" for c in CASES)
    add("--only", nargs="+", default=[], metavar="NAME", help=f"prefixes of names:\n{text}")
    add("--seeds", nargs="*", type=int, default=[], help="also rooms rendered with these seeds")
    add_choosing(parser)


def prepared_cases(args: argparse.Namespace) -> list[Case]:
    """Return the chosen cases that may be used; write the poses that they are supplied with."""
    rooms = [Case(f"rendered-{s}", "", RECORDED, seed=s) for s in args.seeds]
    cases = chosen([*CASES, *rooms], args.only)
    used = [s for s in dict.fromkeys(c.split for c in cases) if usable(*s, args.choosing)]
    cases = [case for case in cases if case.split in used]
    if not cases:
        raise SystemExit("error: nothing left to score")
    args.out.mkdir(parents=True, exist_ok=True)
    for folder in {case.data for case in cases if case.supplied}:
        write_poses(args.data / folder, args.out / f"poses-{folder}")
    return cases


def main(argv: Sequence[str] | None = None) -> int:
    """Run, score, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add_cases(parser)
    text = "mechanisms to turn off one after the other: all, " + ", ".join(WITHOUT)
    add("--without", nargs="+", default=[], metavar="NAME", help=text)
    text = "fill in FOLDER/RESULTS.md and draw the picture in FOLDER/img"
    add("--results", "--docs", type=Path, metavar="FOLDER", help=text)
    text = "estimate the objects N times with box noise of half a pixel, print means"
    add("--noises", type=int, default=0, metavar="N", help=text)
    add("--jobs", type=int, default=1, help="processes at once")
    args = parser.parse_args(argv)
    if args.noises and args.results and not args.without:
        parser.error("--results: the tables of recordings have no box noise: leave out --noises")
    left_out = every_without(args.without)
    cases = prepared_cases(args)
    with fresh_processes(args.jobs) as pool:
        made = {"": scores(pool, cases, args.data, args.out)}  # leaves in OUT what the others need
        for without in ["", *left_out] if args.noises else left_out:
            seeds = range(1, args.noises + 1) if args.noises else [0]
            made[without] = scores(pool, cases, args.data, args.out, without, seeds)
    name = "left_out" if left_out else "real_rooms"
    found = tables(cases, made)
    page = "\n\n".join(found.values()) + "\n"
    print(page, end="")
    (args.out / f"{name}.md").write_text(page)
    by_name = {w: dict(zip((c.name for c in cases), of, strict=True)) for w, of in made.items()}
    (args.out / f"{name}.json").write_text(json.dumps(by_name, indent=1))
    if args.results:
        for title, rows in found.items():
            write_table(args.results / "RESULTS.md", title, rows)
        if not left_out:
            groups = rated_by_group(cases, made[""])
            drawn = {k: v for k, v in groups.items() if v and k in ("other boxes", DETECTOR.model)}
            draw_reliability(drawn, args.results / "img" / "confidence.png")
    return 0


def run_missing(pool: ProcessPoolExecutor, cases: Sequence[Case], data: Path, out: Path) -> None:
    """Run the cases that have no finished run in `out`: objects are made again from them."""
    runs = [
        pool.submit(measure, case, data, out)
        for case in cases
        if not (out / case.name / WITH_DOUBTFUL / "objects.json").exists()
    ]
    for run in runs:
        run.result()


def fresh_processes(jobs: int) -> ProcessPoolExecutor:
    """Make a pool with a process for each task: memory and patches end with it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["real_rooms"])
    return ProcessPoolExecutor(jobs, context, max_tasks_per_child=1)


def scores(
    pool: ProcessPoolExecutor,
    cases: Sequence[Case],
    data: Path,
    out: Path,
    without: str = "",
    seeds: Sequence[int] = (0,),
) -> list[Figures]:
    """Measure the cases, each with the noise of every seed."""
    tasks = [[pool.submit(measure, c, data, out, without, seed) for seed in seeds] for c in cases]
    found = list[Figures]()
    for case, own in zip(cases, tasks, strict=True):
        try:
            runs = [task.result() for task in own]
        except rt.ReobjError as error:
            raise SystemExit(f"error: {case.name}: {error}") from None
        found.append(runs[0] if len(runs) == 1 else mean_of(runs))
        print(f"done: {case.name} without {without or 'nothing'}", file=sys.stderr)
    return found


def rated_by_group(cases: Sequence[Case], figures: Sequence[Figures]) -> dict[str, list[Rated]]:
    """List the confidence of the objects of all runs, and by what they were detected."""
    groups: dict[str, list[Rated]] = {"all": [], "other boxes": [], DETECTOR.model: []}
    for case, of in zip(cases, figures, strict=True):
        boxes = DETECTOR.model if BOXES[case.boxes] == DETECTOR.model else "other boxes"
        groups[boxes] += of["sure"]
        groups["all"] += of["sure"]
    return groups | {"without a solid": [row for row in groups["all"] if not row[2]]}


def tables(cases: Sequence[Case], made: dict[str, list[Figures]]) -> dict[str, str]:
    """Format tables by name: the recordings and confidence; or what is left out in turn."""
    if len(made) > 1:
        return {"left out": left_out_table(made)}
    rows = [(case.title, figures) for case, figures in zip(cases, made[""], strict=True)]
    return {
        "real rooms": figures_table(["recording", "boxes", "cameras"], rows),
        "confidence": reliability_table(rated_by_group(cases, made[""])),
    }


if __name__ == "__main__":
    raise SystemExit(main())
