"""Measure the metric scale from size priors: its error, and the calibration of its sigma.

Usage:
    python benchmarks/scale_table.py DATA [--choosing] [-o benchmarks]

Recordings with metric poses are scaled by a random factor and passed to `quadrics.fit_objects` with
metric=False; its `Scale` must undo the factor. No detector and no images are needed: rooms of
render_room.py are rendered as instance maps, the recordings have recorded boxes. DATA holds
redkitchen_7scenes, hololens_kitchen and tum_fr3_office; "none" uses the rooms only. The rooms are
those of splits.json for reporting that have a plan of their own; --choosing adds the recordings,
and --rooms more rooms, marked.

Sources of the assignment of boxes to objects:
    true     boxes of the true objects: amodal, occluded parts included; redkitchen: visible parts
    seen     rooms: boxes of the visible parts of objects, corners off by 1.2 % of the size
    given    detections, assigned to the true object of their class that they overlap (IoU >= .3)
    tracked  detections, `Tracker` with the poses, no appearance: duplicates, wrong classes included

Each recording is measured as a whole, by stretches of its path, and with random halves of its
objects and of its categories. Variants of one recording share path, objects and categories, so they
are not independent; neither are rooms of one generator. Seeded: the table is reproducible.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))
import render_room as rr
from splits import MARK, SPLITS, add_choosing, marked, room_of, usable
from synthetic_quadrics import table, write_table

import quadrics
import reobj_track as rt
from quadrics import Array, IntArray

COCO = rt.COCO_NAMES
MIN_SCORE = 0.3  # of recorded detections that are used (chosen)
MIN_VIEWS = 3  # as objects.min_views of the tool
MIN_VISIBLE = 0.3  # of an object; less is no box of it
ROOM_STEP = 8  # frames of a clip from one that is drawn to the next


@dataclass(frozen=True)
class Recording:
    """Boxes of O objects in F frames with metric cameras."""

    name: str
    boxes: Array  # (F, O, 4), NaN where unseen
    img_from_world: Array  # (F, 3, 4), world in metres
    image_size: tuple[int, int]
    names: tuple[str, ...]  # (O,) categories

    def part(self, frames: slice | None = None, objects: IntArray | None = None) -> Recording:
        """Keep some frames and objects; what is left with too few views goes."""
        frames = frames or slice(None)
        keep = np.arange(len(self.names)) if objects is None else objects
        seen = np.isfinite(self.boxes[frames][:, keep, 0]).sum(0) >= MIN_VIEWS
        keep = keep[seen]
        names = tuple(self.names[k] for k in keep)
        return replace(
            self, boxes=self.boxes[frames][:, keep], names=names,
            img_from_world=self.img_from_world[frames],
        )  # fmt: skip


# ---- Recordings --------------------------------------------------------------------------------


def bare_room(config: rr.RoomConfig) -> rr.Room:
    """Make a room of render_room.py without its looks: enough to draw maps of instances."""
    rng = np.random.default_rng([config.seed, 1])
    sides = rng.uniform((5.0, 4.4, 2.4), (8.6, 7.2, 3.1))
    w, d, h = (side * (1 + float(rng.uniform(-1, 1)) * config.room_jitter) for side in sides)
    models = rr.varied_models(rng, rr.furniture_models(rng))
    plan, fixed = rr.varied_plan(config, rng, (w, d, h))
    placed = [
        rr.place_object(i, place, models[place.model], list(models).index(place.model))
        for i, place in enumerate(plan)
    ]
    parts = rr.room_shell((w, d, h)) + fixed
    owners = [-1] * len(parts) + [truth.index for truth, own, _ in placed for _ in own]
    parts += [part for _, own, _ in placed for part in own]
    surfaces = rr.build_surfaces(parts, owners, [[0.0, 0.0, 1.0, 1.0]] * len(parts))[0]
    objects, outlines = tuple(t for t, _, _ in placed), tuple(o for _, _, o in placed)
    return rr.Room((w, d, h), objects, surfaces, (), np.zeros((1, 1, 3), np.float32), outlines)


def room(seed: int) -> list[Recording]:
    """Draw a room: boxes of whole objects, and a detector's boxes of what is seen of them."""
    config = rr.RoomConfig(seed=seed, plan="varied", path="tour")
    made, K, rng = bare_room(config), rr.camera_matrix(config), np.random.default_rng(seed)
    poses = rr.camera_path(made, config)[::ROOM_STEP]  # (F, 3, 4)
    size, count = (config.width, config.height), len(made.objects)
    whole, seen = (np.full((len(poses), count, 4), np.nan) for _ in range(2))
    for f, pose in enumerate(poses):
        patch = rr.rasterize(made.surfaces, K, pose, size).patch
        owner = np.where(patch < 0, -1, made.surfaces.owner[patch]).astype(np.int32)
        truth = rr.ground_truth(made, K, pose, owner)
        clear = truth.visibility >= MIN_VISIBLE
        whole[f, clear] = quadrics.clip_boxes(truth.amodal_xyxy[clear], size)
        seen[f, clear] = truth.visible_xyxy[clear]
    extent = np.tile(seen[..., 2:] - seen[..., :2], 2)
    noisy = seen + rr.DetectorConfig().box_sigma * extent * rng.normal(size=seen.shape)
    names = tuple(truth.class_name for truth in made.objects)
    kinds = {"true": whole, "seen": quadrics.clip_boxes(noisy, size)}
    title, cams = marked("rooms", room_of(seed, "varied"), f"room {seed}"), K @ poses
    return [Recording(f"{title}: {k}", b, cams, size, names).part() for k, b in kinds.items()]


def cameras(folder: Path) -> tuple[Array, tuple[int, int]]:
    """Read img_from_world (F, 3, 4) and the image size of a folder in the common form."""
    world_from_cam = np.loadtxt(folder / "poses_c2w.txt").reshape(-1, 4, 4)
    return projections(folder, world_from_cam)


def projections(folder: Path, world_from_cam: Array) -> tuple[Array, tuple[int, int]]:
    """Join poses (F, 4, 4) with intrinsics.json."""
    k = json.loads((folder / "intrinsics.json").read_text())
    matrix = np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1.0]])
    return matrix @ np.linalg.inv(world_from_cam)[:, :3], (k["w"], k["h"])


def true_boxes(folder: Path) -> tuple[Array, tuple[str, ...]]:
    """Read MOT truth: boxes (F, O, 4) of objects visible enough, and their categories."""
    file = "gt_amodal" if (folder / "gt_amodal.txt").exists() else "gt_mot"
    rows = np.loadtxt(folder / f"{file}.txt", delimiter=",")
    classes = json.loads((folder / f"{file}_format.json").read_text())["classes"]
    named = np.array([classes[str(int(c))] != "none" for c in rows[:, 7]])
    rows = rows[named & (rows[:, 8] >= MIN_VISIBLE)]
    ids, column = np.unique(rows[:, 1], return_inverse=True)
    frames = len(cameras(folder)[0])
    boxes = np.full((frames, len(ids), 4), np.nan)
    boxes[rows[:, 0].astype(int) - 1, column] = np.c_[rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]]
    first = [rows[column == k][0, 7] for k in range(len(ids))]
    return boxes, tuple(classes[str(int(c))] for c in first)


def given(truth: Array, names: Sequence[str], rows: Array) -> Array:
    """Give detections (frame, xyxy, score, class) to the true boxes of their class."""
    wanted = np.array([COCO.index(name) for name in names])
    out = np.full_like(truth, np.nan)
    for f in range(len(truth)):
        here = rows[(rows[:, 0] == f) & (rows[:, 5] >= MIN_SCORE)]
        overlap = quadrics.box_iou(truth[f][:, None], here[None, :, 1:5])  # (O, D)
        overlap = overlap * (wanted[:, None] == here[None, :, 6])
        a, b = linear_sum_assignment(-overlap)
        good = overlap[a, b] >= 0.3
        out[f, a[good]] = here[b[good], 1:5]
    return out


def tracked(name: str, rows: Array, cams: tuple[Array, tuple[int, int]], K: Array) -> Recording:
    """Track detections (frame, xyxy, score, class) by motion and position."""
    img_from_world, size = cams
    camera = rt.Camera("PINHOLE", *size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    cam_from_world = np.linalg.inv(K) @ img_from_world
    tracker, steps = rt.Tracker(), []
    for f, pose in enumerate(cam_from_world):
        found = rt.Detections.from_array(rows[rows[:, 0] == f, 1:])
        steps.append(tracker.update(found, cam_from_world=pose, camera=camera))
    tracks = rt.Tracks.concatenate(range(len(steps)), steps)
    tracks = tracks[tracks.score >= MIN_SCORE]
    ids, column = np.unique(tracks.track_id, return_inverse=True)
    boxes = np.full((len(steps), len(ids), 4), np.nan)
    boxes[tracks.frame, column] = tracks.xyxy
    votes = [np.bincount(tracks.class_id[column == k]).argmax() for k in range(len(ids))]
    return Recording(name, boxes, img_from_world, size, tuple(COCO[v] for v in votes)).part()


def calibration(folder: Path) -> Array:
    """Read K (3, 3) of intrinsics.json."""
    k = json.loads((folder / "intrinsics.json").read_text())
    return np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1.0]])


def kitchen(folder: Path) -> list[Recording]:
    """All boxes of redkitchen_7scenes or hololens_kitchen."""
    cams, (boxes, names) = cameras(folder), true_boxes(folder)
    short = marked("recordings", folder.name, folder.name.split("_")[0])
    out = [Recording(f"{short}: true", boxes, *cams, names)]
    for file in sorted(folder.glob("detections_*.csv")):
        rows, kind = np.loadtxt(file, delimiter=","), file.stem.split("_")[1]
        out.append(Recording(f"{short}: given, {kind}", given(boxes, names, rows), *cams, names))
        out.append(tracked(f"{short}: tracked, {kind}", rows, cams, calibration(folder)))
    return [recording.part() for recording in out]


def office(folder: Path, every: int = 4) -> list[Recording]:
    """tum_fr3_office: YOLO boxes, tracked; every n-th frame."""
    table_ = np.loadtxt(folder / "detections_yolo.csv", delimiter=",", skiprows=1)
    truth = np.loadtxt(folder / "groundtruth.txt")  # t, xyz, quaternion xyzw
    times = np.unique(table_[:, 0])[::every]
    near = np.abs(truth[:, 0] - times[:, None]).argmin(1)  # motion capture has 100 poses a second
    x, y, z, w = truth[near, 4:].T
    double = 2.0 * np.arctan2(np.sqrt(x**2 + y**2 + z**2), w)
    axis = np.stack([x, y, z], 1) / np.maximum(np.linalg.norm([x, y, z], axis=0), 1e-12)[:, None]
    world_from_cam = np.tile(np.eye(4), (len(times), 1, 1))
    world_from_cam[:, :3, :3] = quadrics.rotations(axis * double[:, None])
    world_from_cam[:, :3, 3] = truth[near, 1:4]
    frame = np.searchsorted(times, table_[:, 0])
    use = np.isin(table_[:, 0], times)
    corner, extent = table_[use, 2:4], table_[use, 4:6]
    rows = np.c_[frame[use], corner, corner + extent, table_[use, 6], table_[use, 1]]
    cams = projections(folder, world_from_cam)
    title = marked("recordings", folder.name)
    return [tracked(f"{title}: tracked, yolo", rows, cams, calibration(folder))]


READERS = {"redkitchen_7scenes": kitchen, "hololens_kitchen": kitchen, "tum_fr3_office": office}

# ---- Variants and the table --------------------------------------------------------------------


def variants(whole: Recording, count: int, rng: np.random.Generator) -> Iterator[Recording]:
    """The recording, `count` stretches of its path, halves of its objects and of its categories."""
    yield replace(whole, name=f"{whole.name} | all")
    frames = len(whole.boxes)
    for _ in range(count):
        length = int(frames * rng.uniform(0.25, 0.6))
        start = int(rng.integers(0, frames - length))
        part = whole.part(slice(start, start + length))
        yield replace(part, name=f"{whole.name} | path")
    for _ in range(count):
        objects = rng.permutation(len(whole.names))[: (len(whole.names) + 1) // 2]
        yield replace(whole.part(objects=np.sort(objects)), name=f"{whole.name} | objects")
    for _ in range(count):
        kinds = rng.permutation(np.unique(whole.names))
        kept = np.isin(whole.names, kinds[: (len(kinds) + 1) // 2])
        yield replace(whole.part(objects=np.flatnonzero(kept)), name=f"{whole.name} | categories")


@dataclass(frozen=True)
class Row:
    """One fit: what went in, and its scale against the truth."""

    name: str
    frames: int
    objects: int  # with a solid
    kinds: int
    true: float  # metres per unit
    scale: quadrics.Scale

    @property
    def error(self) -> float:
        """Log of estimated / true, NaN without a scale."""
        known = self.scale.source == "priors"
        return float(np.log(self.scale.value / self.true)) if known else np.nan

    def cells(self) -> list[object]:
        """Return the row as text."""
        start = [self.name, self.frames, self.objects, self.kinds, f"{self.true:.3g}"]
        if np.isnan(self.error):
            return [*start, "none", "-", "-", "-"]
        percent, sigma = 100 * (np.exp(self.error) - 1), self.scale.rel_sigma
        figures = [f"{percent:+.1f}", f"{100 * sigma:.1f}", f"{abs(self.error) / sigma:.2f}"]
        return [*start, f"{self.scale.value:.3g}", *figures]


def measure(case: tuple[Recording, float]) -> Row:
    """Fit a recording whose world has another unit, so many metres."""
    recording, metres = case
    fits = quadrics.fit_objects(
        recording.boxes, recording.img_from_world @ np.diag([metres] * 3 + [1.0]),
        recording.image_size, recording.names, quadrics.load_priors(), metric=False,
    )  # fmt: skip
    frames = int(np.isfinite(recording.boxes[..., 0]).any(1).sum())
    good, kinds = int((fits.status != "rejected").sum()), len(set(recording.names))
    return Row(recording.name, frames, good, kinds, metres, fits.scale)


def summary(rows: Sequence[Row]) -> str:
    """Fraction within 2 sigma and typical errors by recording, and of all of a kind."""
    kinds: dict[str, list[Row]] = {}
    for row in rows:
        name = re.sub(r"^room \d+", "rooms", row.name.split(" | ")[0])
        whole = "all rooms" if name.startswith("rooms") else "all real recordings"
        for key in (name, whole + MARK * (MARK in name)):
            kinds.setdefault(key, []).append(row)
    lines: list[list[object]] = []
    for name in sorted(kinds, key=lambda key: key.startswith("all")):
        error = np.array([row.error for row in kinds[name]])
        sigma = np.array([row.scale.rel_sigma for row in kinds[name]])[np.isfinite(error)]
        error = np.abs(error[np.isfinite(error)])
        runs: list[object] = [name, len(kinds[name]), len(error)]
        if not len(error):
            lines.append([*runs, "-", "-", "-", "-"])
            continue
        typical = [f"{100 * np.median(error):.0f} %", f"{100 * np.median(sigma):.0f} %"]
        worst, inside = np.max(error / sigma), np.mean(error <= 2 * sigma)
        lines.append([*runs, *typical, f"{worst:.1f}", f"{inside:.0%}"])
    head = ["boxes", "runs", "with a scale", "median error", "median sigma"]
    return table([*head, "worst error / sigma", "within 2 sigma"], lines)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("data", help="folder of the recordings, or none")
    parser.add_argument("-o", type=Path, metavar="FOLDER", help="fill in FOLDER/RESULTS.md")
    parser.add_argument("--rooms", type=int, default=10, help="rooms for choosing (--choosing)")
    parser.add_argument("--parts", type=int, default=2, help="variants of each kind a recording")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    add_choosing(parser)
    args = parser.parse_args(argv)
    seeds = [int(name[1:]) for name in SPLITS["reporting"]["rooms"] if name.startswith("v")]
    seeds += range(50, 50 + args.rooms) if args.choosing else []
    with ProcessPoolExecutor(args.jobs) as pool:
        recordings = []
        for made in pool.map(room, seeds):
            recordings += made
        for name in READERS if args.data != "none" else ():
            if usable("recordings", name, args.choosing):
                recordings += READERS[name](Path(args.data) / name)
        rng = np.random.default_rng(0)
        parts = [part for whole in recordings for part in variants(whole, args.parts, rng)]
        cases = [(part, float(10 ** rng.uniform(-1, 1))) for part in parts if part.names]
        rows = list(pool.map(measure, cases))
    head = ["recording", "frames", "objects", "categories", "true", "estimated", "error %"]
    text = table([*head, "sigma %", "error / sigma"], [row.cells() for row in rows])
    print(text + "\n\n" + summary(rows))
    if args.o:
        write_table(args.o / "RESULTS.md", "scales", summary(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
