#!/usr/bin/env python3
"""Compare ellipsoids of real objects with the true ones, by solver and category, and by tracker.

    python benchmarks/real_solids.py solvers FOLDER... -o OUT [--choosing] [--picture FILE]
    python benchmarks/real_solids.py identities FOLDER... -o OUT --peers build/peers [--own-cameras]

Recordings used for choosing (splits.json) are left out; --choosing includes them, marked.

`solvers` (the thesis's figs 4.3-4.5): every box has the identity of its true object; SfMO, PSfMO,
LfD and `fit_objects` ("solids") get the same boxes and the same true cameras. Prints O3D by
category, writes OUT/solvers.md, .csv and .png.

`identities` (the thesis's figs 5.5-5.13): the same boxes, cameras and fit, with identities by SORT
and DeepSORT (in a venv that is made in --peers), by our tracker frame by frame, without and with
re-identification, by the whole pipeline and by the truth. Prints the scores of the objects, writes
OUT/identities.md and .csv, views from above, OUT/identities_FOLDER.png, and overlays on a video
frame, OUT/before_after_FOLDER.jpg.

FOLDER holds either of
  images/ or room.mp4; detections_yolov8s.csv or detections.npz (or the file of --boxes; `true`: the
  true boxes); gt_mot.txt, or gt_amodal.txt with boxes of whole objects (IoU >= .3); objects_gt.json
  or gt_objects.json; poses_c2w.txt and intrinsics.json, or poses.txt and camera.txt;
  a scene of ScanNet (`solvers` only; its label images give the boxes): color/, pose/, intrinsic/ of
  SensReader, instance-filt/, SCENE.aggregation.json, SCENE_vh_clean_2.0.010000.segs.json and
  SCENE_vh_clean_2.ply (needs trimesh). Truth: the upright box of least ground around an instance.

Scores. True objects are those of COCO's classes with boxes. An identity matches one of them if it
overlaps it in half of its frames (IoU >= .5) and has its class. The shape of a true object is that
of the identity with most of its frames; all other matching shapes are duplicates.
    O3D        volume IoU of ellipsoids, summed over true objects (0 without a shape), divided by
               the number of true objects and duplicates
    O3D, 1:1   the same divided by the number of true objects: without the cost of duplicates
    centre     median distance of the centres of the objects found
Ref: Gay, Del Bue et al., PSfMO, ICCV 2017; Rubino, Crocco, Del Bue, LfD, PAMI 2018.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))
import compare_deepsort as cd
from benchmark import ROWS
from rank_k import pyplot
from real_rooms import MIN_VISIBLE, identity_f1, judge, kinds_of, median, short, write_poses
from reid_scenes import scannet_scene
from splits import add_choosing, marked, split_name, usable
from synthetic_quadrics import table

import quadrics
import reobj_track as rt
from reobj.files import atomic, load_json
from reobj.results.evaluation_3d import MIN_HALF_AXIS, align_with_truth, read_true_objects
from reobj.results.overlay import draw_tracks, outline_of, surface_points
from reobj.results.truth import LabelledBoxes, Role, read_result, read_truth
from reobj.types import Array, Image, IntArray, box_iou, object_color, rows_by

SOLVERS = ("sfmo", "psfmo", "lfd", "solids")
TRACKERS = {
    "SORT": "rf-sort",
    "DeepSORT": "deepsort",
    "DeepSORT, tuned": "deepsort (1000 frames)",
}  # rows of benchmark.py
PLAIN, ONLINE = "ours, no re-identification", "ours, frame by frame"
CHAIN, TRUTH = "ours, whole chain", "true identities"
SHOWN = ("SORT", "DeepSORT, tuned", PLAIN, CHAIN)  # in pictures
Row = dict[str, Any]


# ---- Recordings ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Boxes:
    """N boxes of a video, by frame.

    Attributes:
        frame: (N,) from 0. xyxy: (N, 4) px. score: (N,). name: (N,) classes.
    """

    frame: IntArray
    xyxy: Array
    score: Array
    name: Any

    def write(self, path: Path, identity: IntArray | None = None) -> Path:
        """Write CSV for --detections, or of those with an identity (N,) from 1 for --tracks."""
        rows = np.arange(len(self.frame)) if identity is None else np.flatnonzero(identity > 0)
        with atomic(path) as part, part.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["frame", *["id"] * (identity is not None), *"x1 y1 x2 y2".split(),
                             "score", "class"])  # fmt: skip
            for i in rows:
                of = [] if identity is None else [identity[i]]
                box = [f"{x:.4f}" for x in self.xyxy[i]]
                writer.writerow([self.frame[i], *of, *box, self.score[i], self.name[i]])
        return path


@dataclass(frozen=True)
class Recording:
    """A video of a room whose objects are known.

    Attributes:
        poses: options of the true cameras. cameras: file of their centres, for an alignment.
        detections: file of the boxes; None: boxes are the true ones.
        truth: true boxes of G objects, with identity and class. min_iou: from which a box is one.
        ids, solids: (G,) identities and ellipsoids of the true objects. category: of each.
    """

    name: str
    video: Path
    poses: rt.PosesConfig
    cameras: Path | None
    detections: Path | None
    truth: LabelledBoxes
    min_iou: float
    ids: IntArray
    solids: quadrics.Ellipsoids
    category: list[str]

    def boxes(self) -> Boxes:
        """Read the boxes, of the classes of the true objects."""
        if self.detections is None:
            seen = self.truth[self.truth.role == Role.SCORED]
            return Boxes(seen.frame - 1, seen.xyxy, np.ones(len(seen)), seen.name)
        found = rt.read_detections(self.detections, rt.Video(self.video))
        name = np.array(found.class_names, str)[found.class_id]
        use = np.isin(name, self.category)
        return Boxes(found.frame[use], found.xyxy[use], found.score[use], name[use])


def first_of(folder: Path, *names: str) -> Path:
    """Return the first of these files that is there."""
    found = next((folder / name for name in names if (folder / name).exists()), None)
    if found is None:
        raise rt.ReobjError(f"{folder}: expected {' or '.join(names)} in it")
    return found


def recording(folder: Path, work: Path, boxes: str = "") -> Recording:
    """Open a folder as the head of this file describes it; work: for files of its cameras.

    boxes: file of detections in it, "true" for the true boxes, "" for what is there.
    """
    if (folder / "color").is_dir():
        return scannet_recording(folder)
    truth_file = first_of(folder, "gt_mot.txt", "gt_amodal.txt")
    whole = truth_file.name == "gt_amodal.txt"
    names: Sequence[str] = rt.COCO_NAMES
    if whole:
        classes = load_json(folder / "gt_amodal_format.json")["classes"]
        names = [classes.get(str(i), "") for i in range(max(map(int, classes)) + 1)]
    truth = read_truth(truth_file, names, MIN_VISIBLE if whole else 0.0)
    truth = truth[np.isin(truth.name, rt.COCO_NAMES)]
    ids, solids = read_true_objects(first_of(folder, "objects_gt.json", "gt_objects.json"))
    category = {int(truth.identity[r[0]]): str(truth.name[r[0]]) for r in rows_by(truth.identity)}
    keep = np.isin(ids, list(category))
    if (folder / "poses_c2w.txt").exists():
        write_poses(folder, work / f"poses-{folder.name}")
        given = (work / f"poses-{folder.name}", folder / "intrinsics.json")
    else:
        given = (first_of(folder, "poses.txt"), pinhole_file(folder / "camera.txt", work))
    detections = None if boxes == "true" else first_of(folder, *([boxes] if boxes else BOXES))
    return Recording(
        folder.name, first_of(folder, "images", "room.mp4"),
        rt.PosesConfig(mode=str(given[0]), camera=str(given[1])),
        first_of(folder, "poses_c2w.txt", "poses.txt"), detections, truth, 0.3 if whole else 0.5,
        np.array(ids)[keep], solids[keep], [category[i] for i in np.array(ids)[keep].tolist()],
    )  # fmt: skip


BOXES = ("detections_yolov8s.csv", "detections.npz")  # stronger ones first


def pinhole_file(path: Path, work: Path) -> Path:
    """Write the camera of a COLMAP line as the JSON that --camera takes."""
    words = path.read_text().split()
    if words[1:2] != ["PINHOLE"] or len(words) != 8:
        raise rt.ReobjError(f"{path}: expected ID PINHOLE WIDTH HEIGHT FX FY CX CY")
    numbers = dict(zip(("fx", "fy", "cx", "cy"), map(float, words[4:]), strict=True))
    found = work / f"camera-{path.parent.name}.json"
    with atomic(found) as part:
        part.write_text(json.dumps({"width": int(words[2]), "height": int(words[3]), **numbers}))
    return found


# ---- ScanNet -------------------------------------------------------------------------------------


def scannet_recording(folder: Path) -> Recording:
    """A scene of ScanNet: boxes of its label images, solids of its mesh."""
    scene = scannet_scene(folder)
    rows = scene.scored
    truth = LabelledBoxes(
        scene.row[rows] + 1, scene.identity[rows], scene.xyxy[rows], scene.name[rows],
        np.full(len(rows), Role.SCORED),
    )  # fmt: skip
    points = instance_points(folder)
    ids = [k for k in np.unique(truth.identity).tolist() if k in points]
    name_of = dict(zip(truth.identity.tolist(), truth.name.tolist(), strict=True))
    return Recording(
        folder.name, folder / "color", rt.PosesConfig(mode=str(folder)), None, None,
        truth[np.isin(truth.identity, ids)], 0.5, np.array(ids, np.int64),
        upright_ellipsoids([points[k] for k in ids]), [str(name_of[k]) for k in ids],
    )  # fmt: skip


def instance_points(folder: Path) -> dict[int, Array]:
    """Vertices (n, 3) of each instance of the mesh, by the value of its pixels: objectId + 1."""
    try:
        import trimesh
    except ImportError as error:
        raise rt.ReobjError("the mesh of ScanNet needs trimesh: pip install trimesh") from error
    files = {}
    for end in (".aggregation.json", "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.ply"):
        found = [p for p in sorted(folder.glob(f"*{end}")) if "_vh_clean.agg" not in p.name]
        if not found:
            raise rt.ReobjError(f"{folder}: expected SCENE{end} in it")
        files[end] = found[0]
    groups, segments, mesh = files.values()
    try:
        segment = np.array(load_json(segments)["segIndices"], np.int64)  # (V,)
        parts = {int(g["objectId"]) + 1: g["segments"] for g in load_json(groups)["segGroups"]}
    except (KeyError, TypeError, ValueError) as error:
        text = "segIndices, and segGroups with objectId and segments"
        raise rt.ReobjError(f"{segments}, {groups.name}: {error!r}; expected {text}") from error
    cloud: Any = trimesh.load(mesh, process=False)
    points = np.asarray(cloud.vertices, np.float64)  # (V, 3)
    if len(points) != len(segment):
        raise rt.ReobjError(f"{mesh}: {len(points)} vertices, {segments.name} has {len(segment)}")
    inside = {k: points[np.isin(segment, own)] for k, own in parts.items()}
    return {k: own for k, own in inside.items() if len(own)}


def upright_ellipsoids(points: Sequence[Array]) -> quadrics.Ellipsoids:
    """Ellipsoids inscribed in the upright boxes (z up) of least ground around points (n, 3)."""
    center, half, axes = [], [], []
    for own in points:
        (x, y), sides, angle = cv2.minAreaRect(own[:, :2].astype(np.float32))
        low, high = own[:, 2].min(), own[:, 2].max()
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        center.append([x, y, (low + high) / 2])
        half.append(np.maximum([*np.array(sides) / 2, (high - low) / 2], MIN_HALF_AXIS))
        axes.append([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    shaped = (np.reshape(center, (-1, 3)), np.reshape(half, (-1, 3)), np.reshape(axes, (-1, 3, 3)))
    return quadrics.Ellipsoids(*shaped)


# ---- Identities ----------------------------------------------------------------------------------


def true_identities(boxes: Boxes, truth: LabelledBoxes, min_iou: float) -> IntArray:
    """Identity (N,) of the true object that each box shows, one to one in a frame; 0: none."""
    identity = np.zeros(len(boxes.frame), np.int64)
    true_rows = {int(truth.frame[rows[0]]): rows for rows in rows_by(truth.frame)}
    for own in rows_by(boxes.frame):
        there = true_rows.get(int(boxes.frame[own[0]]) + 1)
        if there is None:
            continue
        iou = box_iou(boxes.xyxy[own], truth.xyxy[there])  # (D, T)
        iou[boxes.name[own][:, None] != truth.name[there]] = 0
        iou[iou < min_iou] = 0
        d, t = linear_sum_assignment(-iou)
        good = iou[d, t] > 0
        identity[own[d[good]]] = truth.identity[there[t[good]]]
    return identity


def tracked(name: str, rec: Recording, boxes: Boxes, peers: Path | None, work: Path) -> IntArray:
    """Identities (N,) by a tracker that decides frame by frame, kept in work."""
    class_id = np.array([rt.COCO_NAMES.index(n) for n in boxes.name.tolist()], np.int64)
    columns = np.c_[boxes.xyxy, boxes.score, class_id]
    frames = max(rt.Video(rec.video).frame_count, int(boxes.frame.max(initial=-1)) + 1)
    found = cd.split_frames(boxes.frame, columns, frames)
    seq = cd.Sequence(rec.name, "rooms", found, rec.truth, rec.video)
    own = name not in TRACKERS
    key = cd.digest(columns, boxes.frame, cd.SOURCE if own else "")

    def make() -> IntArray:
        if own:
            return cd.ours(seq, None, rt.TrackerConfig(remember=name == ONLINE))
        embedded = None
        if name != "SORT":
            nets = [net for net in cd.networks(seq).values() if isinstance(net, cd.CropNet)]
            if not nets:
                text = "DeepSORT needs mobilenetv2_feat.onnx in the folder REOBJ_MODELS"
                raise rt.ReobjError(text)
            embedded = cd.embed_all(seq, nets[0])
        peer = ROWS[TRACKERS[name]]
        return cd.peer_run(*peer, seq, peers or Path("build/peers"), embedded)

    return cd.cached(work / f"{rec.name}-{tag(name)}-{key}.npz", make)


def tag(name: str) -> str:
    """A name as a part of file names."""
    return name.replace(", ", "-").replace(" ", "_")


# ---- Fits and scores -----------------------------------------------------------------------------


def configured(rec: Recording, own_cameras: bool = False) -> rt.Config:
    """The defaults without pictures and filled gaps, with the true cameras."""
    output = rt.OutputConfig(overlay=False, scene=False, fill_gaps=0)
    return rt.Config(output=output, poses=rt.PosesConfig() if own_cameras else rec.poses)


def fitted(base: Path, folder: Path, tracks: Path, config: rt.Config, solver: str = "") -> Path:
    """Fit solids to given identities with the cameras that `base` holds, in `folder`."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(base, folder)
    if solver:
        config = dataclasses.replace(config, objects=rt.ObjectsConfig(solver=solver))
    rt.refit(folder, config, tracks)
    return folder


@dataclass(frozen=True)
class Scored:
    """Ellipsoids of an output folder beside the true ones (G).

    Attributes:
        result: without doubtful objects. solids: S ellipsoids in the truth's world, of `located`.
        located: (S,) identities. row: (G,) the solid of each true object, or -1.
        shows: (S,) row of the true object that each solid shows, or -1. duplicate: (S,) bool.
        o3d, error: (G,) volume IoU, 0 without a solid, and distance of the centres, NaN.
        up: (3,) in the truth's world, or None.
    """

    result: rt.Result
    located: list[int]
    solids: quadrics.Ellipsoids
    row: IntArray
    shows: IntArray
    duplicate: Any
    o3d: Array
    error: Array
    up: Array | None

    def figures(self, rows: Any = slice(None)) -> Row:
        """Sum up the true objects of these rows."""
        wanted = np.arange(len(self.row))[rows]
        extra = int((self.duplicate & np.isin(self.shows, wanted)).sum())
        total, true = float(self.o3d[wanted].sum()), len(wanted)
        found = self.row[wanted] >= 0
        return {
            "true": true, "found": int(found.sum()), "duplicates": extra,
            "centre_m": median(self.error[wanted][found]),
            "o3d": total / max(true + extra, 1), "o3d_1to1": total / max(true, 1),
        }  # fmt: skip


def score(folder: Path, rec: Recording) -> Scored:
    """Compare the solids of an output folder with the true ones."""
    result = rt.Result.load(folder).without_doubtful()
    ids, parts, up = list[int](), list[quadrics.Ellipsoids](), None
    for part in result.parts():
        try:
            scale, turn, shift = align_with_truth(part, rec.cameras)
        except rt.ReobjError:
            continue  # a part of hardly any frame
        own = part.ellipsoids()
        center = own.center_in_world @ (scale * turn).T + shift
        parts.append(quadrics.Ellipsoids(center, scale * own.half_axes, turn @ own.world_from_obj))
        ids += [o.id for o in part.located]
        if up is None and part.world.up_in_world is not None:
            up = turn @ part.world.up_in_world
    arrays = ("center_in_world", "half_axes", "world_from_obj")
    solids = quadrics.Ellipsoids(*(np.concatenate([getattr(p, n) for p in parts]) for n in arrays))
    truth = rec.truth[np.isin(rec.truth.identity, rec.ids)]
    verdicts = judge(truth, kinds_of(truth), read_result(folder), result.objects, rec.min_iou)
    index = {o.id: i for i, o in enumerate(result.objects)}
    of_solid = np.array([index[i] for i in ids], np.int64)
    best = verdicts.best(np.isin(np.arange(len(index)), of_solid))[of_solid]  # (S,)
    column = {int(k): g for g, k in enumerate(rec.ids)}
    shows = np.array([column.get(int(k), -1) for k in verdicts.shows[of_solid]], np.int64)
    count = len(rec.ids)
    row, o3d, error = np.full(count, -1), np.zeros(count), np.full(count, np.nan)
    row[shows[best]] = np.flatnonzero(best)
    has = np.flatnonzero(row >= 0)
    own, goal = solids[row[has]], rec.solids[has]
    o3d[has] = np.nan_to_num(quadrics.volume_overlap(own, goal))
    error[has] = np.linalg.norm(own.center_in_world - goal.center_in_world, axis=1)
    return Scored(result, ids, solids, row, shows, (shows >= 0) & ~best, o3d, error, up)


# ---- Figs 4.3-4.5: solvers by category -----------------------------------------------------------


def compare_solvers(rec: Recording, work: Path) -> dict[str, Scored]:
    """Fit the boxes, each with the identity of the object that it shows, by every solver."""
    boxes = rec.boxes()
    identity = true_identities(boxes, rec.truth, rec.min_iou)
    if not (identity > 0).any():
        raise rt.ReobjError(f"{rec.name}: no box shows a true object")
    path = boxes.write(work / f"true-{rec.name}.csv", identity)
    config, base = configured(rec), work / f"{rec.name}-cameras"
    rt.run(rec.video, base, config, tracks=path, overwrite=True)
    return {
        solver: score(fitted(base, work / f"{rec.name}-{solver}", path, config, solver), rec)
        for solver in SOLVERS
    }


def solver_rows(name: str, rec: Recording, found: dict[str, Scored]) -> Iterator[Row]:
    """A row for each category, then one for all."""
    category = np.array(rec.category)
    for wanted in (*sorted(set(rec.category)), "all"):
        rows = np.flatnonzero((category == wanted) | (wanted == "all"))
        line: Row = {"recording": name, "category": wanted, "true": len(rows)}
        for solver, scored in found.items():
            own = scored.figures(rows)
            line |= {f"{solver}_{k}": own[k] for k in ("found", "centre_m", "o3d")}
        yield line


def solver_table(rows: Sequence[Row]) -> str:
    """O3D over all true objects of a category, solids found and centre errors, by solver."""
    head = ["recording", "category", "true", *SOLVERS]
    return table(head, [
        [r["recording"], r["category"], r["true"],
         *(f"{short(r[f'{s}_o3d'])} ({r[f'{s}_found']}, {metres(r[f'{s}_centre_m'])})"
           for s in SOLVERS)]
        for r in rows
    ])  # fmt: skip


def metres(value: float | None) -> str:
    """Format a distance."""
    return "-" if value is None else f"{value:.2f} m"


def draw_solvers(rows: Sequence[Row], path: Path) -> None:
    """Draw O3D by category, a bar for each solver, a panel for each recording."""
    plt = pyplot()
    names = list(dict.fromkeys(r["recording"] for r in rows))
    figure, panels = plt.subplots(
        len(names), 1, figsize=(7.5, 2.3 * len(names)), squeeze=False, layout="constrained"
    )
    for axes, name in zip(panels[:, 0], names, strict=True):
        own = [r for r in rows if r["recording"] == name]
        for k, solver in enumerate(SOLVERS):
            x = np.arange(len(own)) + 0.2 * (k - 1.5)
            axes.bar(x, [r[f"{solver}_o3d"] for r in own], 0.18, label=LABELS[solver])
        ticks = [f"{r['category']} ({r['true']})" for r in own]
        axes.set_xticks(np.arange(len(own)), ticks, fontsize=8)
        axes.set_title(name, fontsize=9)
        axes.set_ylabel("O3D")
        axes.spines[["top", "right"]].set_visible(False)
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, fontsize=8, frameon=False, ncols=4, loc="outside upper center")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


LABELS = {"sfmo": "SfMO", "psfmo": "PSfMO", "lfd": "LfD", "solids": "fit_objects"}


# ---- Figs 5.5-5.13: identities and ellipsoids ----------------------------------------------------


def compare_identities(
    rec: Recording, work: Path, peers: Path | None, own_cameras: bool
) -> tuple[dict[str, Scored], list[Row]]:
    """Fit the same boxes with the same cameras under the identities of every tracker."""
    boxes, config = rec.boxes(), configured(rec, own_cameras)
    file = boxes.write(work / f"boxes-{rec.name}.csv")
    base = work / f"{rec.name}{'-own' if own_cameras else ''}-chain"
    rt.run(rec.video, base, config, detections=file)
    folders = {}
    for name in (*(TRACKERS if peers else ()), PLAIN, ONLINE, TRUTH):
        identity = (
            true_identities(boxes, rec.truth, rec.min_iou)
            if name == TRUTH
            else tracked(name, rec, boxes, peers, work)
        )
        tracks = boxes.write(work / f"{rec.name}-{tag(name)}.csv", identity)
        folders[name] = fitted(base, work / f"{base.name}-{tag(name)}", tracks, config)
        if name == ONLINE:
            folders[CHAIN] = base
    found = {name: score(folder, rec) for name, folder in folders.items()}
    truth = rec.truth[np.isin(rec.truth.identity, rec.ids)]
    lines = []
    for name, scored in found.items():
        every = read_result(folders[name])
        every = every[np.isin(every.name, rec.category)]
        line = {"recording": rec.name, "cameras": "own" if own_cameras else "true", "by": name}
        line |= {"idf1": identity_f1(truth, every, rec.min_iou), **scored.figures()}
        lines.append(line)
    return found, lines


def identity_table(rows: Sequence[Row]) -> str:
    """What every tracker's identities make of the objects."""
    head = "recording, cameras, identities, IDF1, found, duplicates, centre, O3D, O3D 1:1"
    return table(head.split(", "), [
        [r["recording"], r["cameras"], r["by"], f"{100 * r['idf1']:.1f}",
         f"{r['found']} of {r['true']}", r["duplicates"], metres(r["centre_m"]), short(r["o3d"]),
         short(r["o3d_1to1"])]
        for r in rows
    ])  # fmt: skip


def draw_above(rec: Recording, found: dict[str, Scored], path: Path) -> None:
    """Draw true and found ellipsoids from above, a panel for each tracker."""
    plt = pyplot()
    up = next((s.up for s in found.values() if s.up is not None), np.array([0, 0, 1.0]))
    side = np.linalg.svd(up[None])[2][1:]  # (2, 3) axes of the ground
    figure, panels = plt.subplots(
        1, len(found), figsize=(3.6 * len(found), 3.8), sharex=True, sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    middle = rec.solids.center_in_world @ side.T
    low, high = middle.min(0) - 1, middle.max(0) + 1
    for axes, (name, scored) in zip(panels[0], found.items(), strict=True):
        for outline in outlines(rec.solids, side):
            axes.fill(*outline.T, color="0.85")
        for k, outline in enumerate(outlines(scored.solids, side)):
            color = "tab:red" if scored.duplicate[k] else "tab:blue"
            if scored.shows[k] >= 0:
                axes.plot(*outline.T, color=color, lw=1.2)
        own = scored.figures()
        text = f"{own['found']} of {own['true']}, {own['duplicates']} duplicates"
        axes.set_title(f"{name}\n{text}, O3D {short(own['o3d'])}", fontsize=8)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.tick_params(labelsize=7)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def outlines(solids: quadrics.Ellipsoids, side: Array) -> Iterator[Array]:
    """Outlines (48, 2) of ellipsoids seen along the normal of two axes (2, 3), metres."""
    angle = np.linspace(0, 2 * np.pi, 48)
    circle = np.stack([np.cos(angle), np.sin(angle)])  # (2, 48)
    for center, half, axes in zip(
        solids.center_in_world, solids.half_axes, solids.world_from_obj, strict=True
    ):
        spread = side @ axes * half  # (2, 3)
        root = np.linalg.svd(spread, full_matrices=False)
        yield (root[0] * root[1] @ circle).T + side @ center


def draw_frame(rec: Recording, found: dict[str, Scored], path: Path) -> None:
    """Draw boxes and ellipsoids over the last frame in which most objects are in view, in turn."""
    frames = rec.truth.frame[rec.truth.role == Role.SCORED] - 1
    last = int(frames.max()) // 2
    count = np.bincount(frames[frames > last])
    chosen = int(np.flatnonzero(count == count.max())[-1])
    image = next(f.image for f in rt.Video(rec.video) if f.index == chosen)
    both = np.hstack([over(image, scored, chosen, name) for name, scored in found.items()])
    with atomic(path) as part:
        part.write_bytes(cv2.imencode(".jpg", both, (cv2.IMWRITE_JPEG_QUALITY, 85))[1].tobytes())


def over(image: Image, scored: Scored, frame: int, title: str) -> Image:
    """One picture of `draw_frame`."""
    picture, result = image.copy(), scored.result
    rows = result.tracks[result.tracks.frame == frame]
    draw_tracks(picture, rows, {}, 1.0, thin=frozenset(scored.located))
    for part in result.parts():
        if part.poses is None or not part.located:
            continue
        at = np.flatnonzero((part.poses.frame == frame) & part.poses.known)
        for k in at:
            for row, found in enumerate(part.located):
                one = part.ellipsoids()[row]
                points = surface_points(
                    one.center_in_world, one.half_axes, one.world_from_obj, "ellipsoid"
                )
                outline = outline_of(part.poses.camera, part.poses.cam_from_world[k], points)
                if outline is not None:
                    width = 2 if found.id in rows.track_id else 1
                    line = [outline.round().astype(np.int32)]
                    cv2.polylines(picture, line, True, object_color(found.id), width, cv2.LINE_AA)
    own = scored.figures()
    text = f"{title}: {own['found']} of {own['true']}, {own['duplicates']} duplicates"
    picture[:24] = 255
    cv2.putText(picture, text, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return picture


# ---- Command line --------------------------------------------------------------------------------


def write_rows(out: Path, name: str, rows: Sequence[Row], text: str) -> None:
    """Write OUT/NAME.csv and .md, and print the table."""
    with atomic(out / f"{name}.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    with atomic(out / f"{name}.md") as part:
        part.write_text(text + "\n")
    print(text)


def run_solvers(args: argparse.Namespace) -> None:
    """Compare the solvers on all folders."""
    rows = list[Row]()
    for folder in args.folder:
        for boxes in args.boxes or [""]:
            rec = recording(folder, args.out, boxes)
            title = marked(*split_name(folder), rec.name)
            title += f", {boxes} boxes" if boxes and rec.detections is None else ""
            rows += solver_rows(title, rec, compare_solvers(rec, args.out))
    write_rows(args.out, "solvers", rows, solver_table(rows))
    draw_solvers(rows, args.picture or args.out / "solvers.png")


def run_identities(args: argparse.Namespace) -> None:
    """Compare the trackers on all folders."""
    rows = list[Row]()
    for folder in args.folder:
        rec = recording(folder, args.out, (args.boxes or [""])[0])
        for own in (False, True) if args.own_cameras else (False,):
            found, lines = compare_identities(rec, args.out, args.peers, own)
            title = marked(*split_name(folder), rec.name)
            rows += [{**line, "recording": title} for line in lines]
            file = f"{rec.name}{'_own' if own else ''}"
            shown = {n: found[n] for n in SHOWN if n in found}
            draw_above(rec, shown, args.out / f"identities_{file}.png")
            if rec.video.suffix == ".mp4":
                ends = {n: s for n, s in shown.items() if n in (next(iter(shown)), CHAIN)}
                draw_frame(rec, ends, args.out / f"before_after_{file}.jpg")
    write_rows(args.out, "identities", rows, identity_table(rows))


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    for name, function in (("solvers", run_solvers), ("identities", run_identities)):
        own = commands.add_parser(name)
        own.set_defaults(run=function)
        add: Callable[..., Any] = own.add_argument
        add("folder", type=Path, nargs="+", help="recordings")
        add("-o", "--out", type=Path, required=True, help="folder for runs, tables and pictures")
        add("--boxes", nargs="+", metavar="FILE", help="boxes of the folders; `true`: true ones")
        if name == "solvers":
            add("--picture", type=Path, help="where to draw (default OUT/solvers.png)")
        else:
            add("--peers", type=Path, help="folder for the venv of SORT and DeepSORT")
            add("--own-cameras", action="store_true", help="also with reconstructed cameras")
        add_choosing(own)
    args = parser.parse_args(argv)
    try:
        args.folder = [f for f in args.folder if usable(*split_name(f), args.choosing)]
        if not args.folder:
            raise rt.ReobjError("nothing left to score")
        args.out.mkdir(parents=True, exist_ok=True)
        args.run(args)
    except (rt.ReobjError, quadrics.QuadricsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
