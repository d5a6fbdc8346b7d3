#!/usr/bin/env python3
"""Run the command line on every recording with images and check the scores against thresholds.

    python benchmarks/recordings.py DATA [-o OUT] [--only NAME...] [--long] [--jobs 2]
        [--write-floors] [--rooms SEED...] [--without MECHANISM]

Every row is one command, as a user types it, in a process of its own: with the small detector
(--detector deimv2-femto, weights in REOBJ_MODELS) or recorded boxes, and with reconstructed or
supplied cameras. benchmarks/truth.py compares the output files with the ground truth. The exit code
is 1 if a command fails or a score misses its threshold in recordings.json beside this file;
run times are only printed. --write-floors derives new thresholds from this run with the margins of
`floors_of`. --rooms adds rendered rooms (render_room.py --plan varied, kept in OUT) with their
recorded boxes and our cameras. --without NAME runs all of it without a mechanism (without.py).

    IDF1     boxes of tracks.txt; overlap .5 (.4 on office_loop, livingroom13 and studio_room, .3 on
             hololens_kitchen, whose truth is of whole objects)
    found    true objects matched by a listed object, of those that are in view for long enough;
             bonsai, apple, teddybear: true objects of the classes whose number is known
    false    listed objects of annotated classes that match no true object, or one already matched
    solids   true objects with a shape of their class within .35 m, or a third of the longest side,
             of all those annotated in 3D; cm: median error of their centres
    cameras  frames with a pose, of those read; off: median error of the centres, own cameras after
             a similarity, in % of the extent of the path
    MB       peak memory of the largest process of the command
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import render_room
from tables import table
from truth import (
    Array,
    Found,
    Output,
    Truth,
    counted,
    read_centres,
    read_mot_truth,
    score_2d,
    score_cameras,
    score_solids,
)
from without import WITHOUT

ROOT = Path(__file__).resolve().parent.parent
FLOORS = Path(__file__).resolve().with_suffix(".json")
FAST, YOLO, RECORDED, MOT = "fast", "detections_yolov8s.csv", "detections.npz", "det"
TIMEOUT_S = 900.0
Figures = dict[str, Any]

COCO = {56: "chair", 57: "couch", 58: "potted plant", 60: "dining table", 62: "tv"}
RED_COMPLETE = ("chair", "dining table", "cup")  # classes of which all objects are annotated


@dataclass(frozen=True)
class Case:
    """One command: a recording, whose boxes, whose cameras, which frames.

    Attributes:
        name: recording, boxes, cameras. source: in DATA. poses: supplied, in DATA ("" none).
        every, stop: of the frames.
    """

    recording: str
    source: str
    boxes: str = FAST
    poses: str = ""
    every: int = 1
    stop: int = 0

    @property
    def name(self) -> str:
        """Return recording, boxes and cameras."""
        boxes = {FAST: "fast", YOLO: "yolov8s", RECORDED: "recorded", MOT: "recorded"}[self.boxes]
        return f"{self.recording} {boxes} {'supplied' if self.poses else 'own'}"


C2W = "poses_c2w.txt"
KITCHEN = ("hololens_kitchen", "hololens_kitchen/images")
RED = ("redkitchen_7scenes", "redkitchen_7scenes/images")
CASES = [
    Case(*KITCHEN, YOLO, C2W, 5),
    Case(*KITCHEN, FAST, C2W, 12),
    Case(*RED, YOLO, C2W, 5),
    Case(*RED, FAST, C2W, 16),
    Case("office_loop", "office_loop/images", YOLO, stop=120),
    Case("bonsai_mip360", "bonsai_mip360/images", FAST, every=6),
    Case("livingroom13", "livingroom13/images", FAST),
    Case("livingroom13", "livingroom13/images", YOLO),
    Case("studio_room", "studio_room/images", FAST),
    Case("studio_room", "studio_room/images", YOLO, "colmap_text"),
    Case("cubeslam_cabinet", "cubeslam_cabinet/images", FAST, "truth_cam_poses.txt", stop=30),
    Case("apple", "orbit_clips/apple.mp4", FAST),
    Case("teddybear", "orbit_clips/teddybear.mp4", FAST),
    Case("sun3d s1", "sun3d_studyroom_fragments/s1/images", FAST, C2W, 2),
    Case("tum_fr3", "tum_fr3_office/images17", FAST, "groundtruth.txt"),
    Case("tum_fr3", "tum_fr3_office/images17", FAST),
    Case("TUD-Campus", "mot/TUD-Campus/img1", FAST),
    Case("TUD-Campus", "mot/TUD-Campus/img1", MOT),
    Case("PETS-S3-MF1", "mot/PETS-S3-MF1/img1", MOT),
]
# With --long only: a minute each, or with floors that other cases include. office_loop: no object
# is found, and the cameras are those of its case with yolov8s. cubeslam: no cameras and no truth of
# objects, as TUD-Campus. sun3d s2: supplied cameras alone, as s1.
LONG = [
    Case("room", str(ROOT / "examples/room/room.mp4"), FAST, every=3),
    Case(*KITCHEN, YOLO, "", 1, 120),
    Case(*RED, YOLO, "", 5),
    Case("office_loop", "office_loop/images", FAST, every=2, stop=120),
    Case("cubeslam_cabinet", "cubeslam_cabinet/images", FAST, stop=30),
    Case("sun3d s2", "sun3d_studyroom_fragments/s2/images", FAST, C2W, 2),
]
CAMERAS = {  # where the file of poses has none
    "cubeslam_cabinet": "535.4,539.2,320.1,247.6",
    "tum_fr3": "535.4,539.2,320.1,247.6",
}


# ---- Commands ----------------------------------------------------------------------------------


def home(case: Case, data: Path) -> Path:
    """Return the folder of a recording's truth."""
    return (data / case.source).parent


def rendered(seed: int, out: Path) -> Case:
    """Return the case of a rendered room; render it if it is not there."""
    folder = out / f"room_{seed}"
    if not (folder / "gt_objects.json").exists():  # written after the video
        render_room.main(["--seed", str(seed), "--plan", "varied", "-o", str(folder)])
    return Case(f"rendered {seed}", str(folder / "room.mp4"), RECORDED)


def command(case: Case, data: Path, work: Path) -> list[str]:
    """Return the words of a command; writes what it needs into `work`."""
    folder = home(case, data)
    words = ["run", str(data / case.source), "-o", str(work / "out"), "--every", str(case.every)]
    if case.stop:
        words += ["--stop", str(case.stop)]
    if case.boxes == FAST:
        words += ["--detector", "deimv2-femto"]
    elif case.boxes == MOT:
        words += ["--detections", str(recorded_people(case, data))]
    else:
        words += ["--detections", str(folder / case.boxes)]
    if case.poses:
        poses = folder / case.poses
        if case.poses == C2W:
            poses = work / "poses"
            write_seven_scenes(folder, poses)
            words += ["--camera", str(folder / "intrinsics.json")]
        elif case.recording in CAMERAS:
            words += ["--camera", CAMERAS[case.recording]]
        words += ["--poses", str(poses)]
    return words


def recorded_people(case: Case, data: Path) -> Path:
    """Return the file of recorded boxes of pedestrians."""
    if case.recording == "TUD-Campus":
        return data / "mot/MOT15-train/TUD-Campus/det/det_sort_frcnn.txt"
    return home(case, data) / "det/det.txt"


def image_names(folder: Path) -> list[str]:
    """Return the names of the images in the order of the rows of the files beside them."""
    if (folder / "images.txt").exists():
        return [Path(line).stem for line in (folder / "images.txt").read_text().split()]
    return sorted(path.stem for path in (folder / "images").iterdir())


def write_seven_scenes(folder: Path, out: Path) -> None:
    """Write poses_c2w.txt, 4x4 world_from_cam a line, as one NAME.pose.txt for each image."""
    out.mkdir()
    poses = np.loadtxt(folder / C2W).reshape(-1, 4, 4)
    for name, pose in zip(image_names(folder), poses, strict=True):
        np.savetxt(out / f"{name}.pose.txt", pose)


def run(case: Case, data: Path, out: Path, without: str = "") -> Figures:
    """Run a case; returns its exit code, seconds, memory and figures."""
    work = out / case.name.replace(" ", "_")
    work.mkdir(parents=True)
    tool = ["benchmarks/without.py", without] if without else ["reobj_track.py"]
    words = [sys.executable, str(ROOT / tool[0]), *tool[1:], *command(case, data, work)]
    began = time.monotonic()
    with open(work / "log.txt", "w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, cwd=work)
        exit_code, peak_mb = wait(process)
    figures: Figures = {"exit": exit_code, "seconds": time.monotonic() - began, "mb": peak_mb}
    if exit_code == 0:
        figures |= score(case, data, work / "out")
    else:
        figures["said"] = (work / "log.txt").read_text().strip().splitlines()[-1:]
    print(f"{case.name}: {figures['seconds']:.0f} s", file=sys.stderr, flush=True)
    return figures


def wait(process: subprocess.Popen[bytes]) -> tuple[int, int]:
    """Wait for a process; returns its exit code, and the peak memory of its largest one, MB."""
    end = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end:
        pid, status, used = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, used.ru_maxrss // 1024  # KiB in Linux
        time.sleep(0.1)
    process.kill()
    process.wait()
    return 124, 0


# ---- Figures -----------------------------------------------------------------------------------


def truth_2d(case: Case, data: Path) -> tuple[Truth, float, float] | None:
    """Return true boxes, and the overlaps at which boxes and lists are compared."""
    folder = home(case, data)
    if (folder / "gt_objects.json").exists():
        objects = json.loads((folder / "gt_objects.json").read_text())["objects"]
        names = {o["class_id"]: o["class"] for o in objects}
        return read_mot_truth(folder / "gt_mot.txt", names), 0.5, 0.4
    if (folder / "objects_2d.json").exists():
        return read_mot_truth(folder / "gt_mot.txt", COCO, folder / "objects_2d.json"), 0.4, 0.4
    if case.recording == RED[0]:
        names, complete = classes(folder / "gt_mot_format.json"), RED_COMPLETE
        return read_mot_truth(folder / "gt_mot.txt", names, complete=complete), 0.5, 0.4
    if case.recording == KITCHEN[0]:
        names = classes(folder / "gt_amodal_format.json")
        every = set(names.values()) - {"none"}
        truth = read_mot_truth(folder / "gt_amodal.txt", names, None, every, 0.3)
        return truth, 0.3, 0.3
    if case.boxes == MOT or case.recording == "TUD-Campus":
        mot15 = data / "mot/MOT15-train/TUD-Campus"
        path = (mot15 if case.recording == "TUD-Campus" else folder) / "gt/gt.txt"
        name = "person" if case.boxes == FAST else "object"  # recorded boxes have no class
        return read_mot_truth(path, name, complete=[name]), 0.5, 0.5
    return None


def classes(path: Path) -> dict[int, str]:
    """Read the names of the class numbers of a file of truth."""
    return {int(k): v for k, v in json.loads(path.read_text())["classes"].items()}


KNOWN_NUMBERS = {
    "bonsai_mip360": {"potted plant": 1, "dining table": 1, "bicycle": 2},
    "apple": {"apple": 1},
    "teddybear": {"teddy bear": 1},
}


def true_cameras(case: Case, data: Path) -> dict[int, Array]:
    """Return the true centres by frame of the source; empty where none are known."""
    folder = home(case, data)
    files = {
        "cubeslam_cabinet": "truth_cam_poses.txt",
        "tum_fr3": "poses17_c2w.txt",
    }
    rendered = (folder / "gt_objects.json").exists()
    path = folder / files.get(case.recording, "poses.txt" if rendered else C2W)
    return dict(enumerate(read_centres(path))) if path.exists() else {}


def times_of(case: Case, data: Path) -> list[float]:
    """Return the times of images whose names are times."""
    if case.recording != "tum_fr3":
        return []
    return sorted(float(path.stem) for path in (data / case.source).iterdir())


def true_solids(case: Case, data: Path) -> list[dict[str, Any]]:
    """Return true objects in 3D, of the classes that are annotated completely."""
    folder = home(case, data)
    if (folder / "gt_objects.json").exists():
        return list(json.loads((folder / "gt_objects.json").read_text())["objects"])
    if not (folder / "objects_gt.json").exists():
        return []
    found = truth_2d(case, data)
    complete = found[0].complete if found else frozenset()
    return [
        {"class": o["coco"], "center": o["center"], "size_m": o["size"], "world_from_obj": o["R"]}
        for o in json.loads((folder / "objects_gt.json").read_text())["objects"]
        if o["coco"] in complete
    ]


def score(case: Case, data: Path, out: Path) -> Figures:
    """Score an output folder by all the truth that there is."""
    output = Output.read(out, times_of(case, data))
    world = output.data["world"] or {}
    figures: Figures = {
        "warnings": len(output.data["warnings"]),
        "cameras": int(world.get("registered_frames") or 0),
        "frames": int(world.get("frames") or 0),
    }
    found: Found | None = None
    if case.recording in KNOWN_NUMBERS:
        found = counted(output, KNOWN_NUMBERS[case.recording])
    elif given := truth_2d(case, data):
        truth, *overlaps = given
        every = range(0, case.stop or 1 << 20, case.every)
        shown = truth.of_frames([f for f in np.unique(truth.frame) if f in every])
        found = score_2d(shown, output, *overlaps)
        figures["idf1"] = found.idf1
    if found:
        figures |= {"found": found.found, "true": found.true, "false": found.false}
    true = true_cameras(case, data)
    if true and (cameras := score_cameras(output, true, own=not case.poses)):
        figures["off"] = 100 * cameras.median / cameras.extent
        if goal := true_solids(case, data):
            solids = score_solids(goal, output, cameras.truth_from_ours)
            figures |= {"solids": solids.found, "solids_true": solids.true}
            if solids.found:
                figures["cm"] = 100 * solids.centre_m
    return figures


# ---- Floors and the table ----------------------------------------------------------------------

LEAST, MOST = ("idf1", "found", "solids", "cameras"), ("false", "cm", "off", "mb")


def floors_of(figures: Figures) -> Figures:
    """Return the bounds that figures like these must keep.

    Half a pixel of box noise, or another order of sums on another processor, changes one or two
    objects (benchmarks/shape_checks.py). The margins: one object in ten and at least one,
    IDF1 .03, one camera in twenty, half of an error and a constant, half of the memory.
    """
    if figures["exit"]:
        return {}
    margins: dict[str, Callable[[float], float]] = {
        "idf1": lambda v: round(max(v - 0.03, 0), 3),
        "found": lambda v: max(math.floor(0.9 * v), 0) if v > 9 else max(v - 1, min(v, 1)),
        "solids": lambda v: math.floor(0.9 * v) if v > 9 else max(v - 1, 0),
        "cameras": lambda v: math.floor(0.95 * v),
        "false": lambda v: math.ceil(1.2 * v + 1),
        "cm": lambda v: round(1.5 * v + 1, 1),
        "off": lambda v: round(1.5 * v + 0.1, 2),
        "mb": lambda v: round(1.5 * v, -1),
    }
    return {key: form(figures[key]) for key, form in margins.items() if key in figures}


def missed(figures: Figures, floors: Mapping[str, float] | None) -> list[str]:
    """Say what a case misses."""
    if figures["exit"]:
        return [f"exit code {figures['exit']}: {' '.join(figures.get('said', []))[:200]}"]
    if floors is None:
        return ["no thresholds: run with --write-floors"]
    short = [f"{k} {figures.get(k)} < {floors[k]}" for k in LEAST
             if k in floors and not figures.get(k, -1) >= floors[k]]  # fmt: skip
    return short + [f"{k} {figures.get(k)} > {floors[k]}" for k in MOST
                    if k in floors and not figures.get(k, math.inf) <= floors[k]]  # fmt: skip


COLUMNS = {  # of the table: figure, format, figure of the total
    "IDF1": ("idf1", ".3f", ""), "found": ("found", "d", "true"), "false": ("false", "d", ""),
    "solids": ("solids", "d", "solids_true"), "cm": ("cm", ".1f", ""),
    "cameras": ("cameras", "d", "frames"), "off %": ("off", ".2f", ""), "s": ("seconds", ".0f", ""),
    "MB": ("mb", "d", ""), "warnings": ("warnings", "d", ""), "exit": ("exit", "d", ""),
}  # fmt: skip


def cells(figures: Figures) -> list[str]:
    """Format the figures of a command."""
    return [
        format(figures[key], form) + (f" of {figures[of]}" if of else "") if key in figures else "-"
        for key, form, of in COLUMNS.values()
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cases, print the table, compare with the floors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add("data", type=Path, help="folder of the recordings")
    add("-o", "--out", type=Path, help="keep the output folders here (default: delete them)")
    add("--only", nargs="+", default=[], metavar="NAME", help="prefixes of names")
    add("--long", action="store_true", help="also the runs that CI leaves out")
    add("--rooms", nargs="+", type=int, default=[], metavar="SEED", help="also rendered rooms")
    add("--without", default="", choices=list(WITHOUT), help="a mechanism to turn off")
    add("--jobs", type=int, default=2, help="commands at once")
    add(
        "--write-floors",
        action="store_true",
        help="replace the thresholds of these runs",
    )
    args = parser.parse_args(argv)
    floors = json.loads(FLOORS.read_text()) if FLOORS.exists() else {}
    every = CASES + LONG if args.long else CASES
    cases = [c for c in every if not args.only or c.name.startswith(tuple(args.only))]
    cases += [rendered(seed, (args.out or Path("build")).resolve()) for seed in args.rooms]
    order = sorted(cases, key=lambda c: -floors.get(c.name, {}).get("seconds", math.inf))
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(args.jobs) as pool:
        out = (args.out or Path(temporary)).resolve()
        tasks = {c.name: pool.submit(run, c, args.data.resolve(), out, args.without) for c in order}
        made = {c.name: tasks[c.name].result() for c in cases}
    print(table(["command", *COLUMNS], ([name, *cells(f)] for name, f in made.items())))
    if args.out:
        (args.out / "recordings.json").write_text(json.dumps(made, indent=1) + "\n")
    if args.write_floors:
        floors |= {n: floors_of(f) | {"seconds": round(f["seconds"])} for n, f in made.items()}
        FLOORS.write_text(json.dumps(floors, indent=1) + "\n")
        return 0
    checked = {n: f for n, f in made.items() if not n.startswith("rendered ")}
    faults = [f"{n}: {text}" for n, f in checked.items() for text in missed(f, floors.get(n))]
    print(*faults, sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
