#!/usr/bin/env python3
"""Measure the cameras: reconstruct clips with known poses and print one table row each.

    python benchmarks/pose_accuracy.py -o OUT [--choosing] [--data FOLDER] [NAME...]

Clips: the recordings of FOLDER that are there, examples/room, and every folder made by
`benchmarks/render_room.py` and given with --room. Clips that were used for choosing (splits.json:
all but some rooms) are left out; --choosing includes them, marked. All clips run with the defaults,
each in a process of its own, so that its memory can be measured.

Columns: frames with a pose; error of the camera centres after a similarity alignment (Umeyama, PAMI
1991) as median, root mean square and largest, in % of the diagonal of the path's bounding box, and
the median in cm where the truth is metric; median angle between the orientations after the same
alignment; median error of the frames located by PnP over that of the keyframes; focal length over
the true one; frames per second of the whole step; memory (largest resident size of the parent plus
that of the mapper's process: an upper bound).

redkitchen's own poses (a Kinect's) are good to about 3 cm. `redkitchen-sfm` compares the same
cameras with a dense reconstruction made here: COLMAP's own features on every second frame at
full size, exhaustive neighbours, an OPENCV camera (about 10 min once, kept in OUT).
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))
from splits import add_choosing, marked, split_name, usable
from truth import similarity

import reobj_track as rt

Array = npt.NDArray[Any]
ROOT = Path(__file__).resolve().parent.parent
HEADER = (
    "| clip | with pose | error median / rmse / max, % | median, cm | turn, deg | "
    "PnP / keyframes | focal / true | frames/s | MB |\n|---|---|---|---|---|---|---|---|---|"
)


@dataclasses.dataclass(frozen=True)
class Clip:
    """A source, and how to get the true poses: a reader of reobj_track with its intrinsics."""

    source: Path
    truth: Path | None = None
    camera: str = ""
    metric: bool = False

    def title(self, name: str) -> str:
        """Return the name, marked where the clip was used for choosing."""
        return marked(*split_name(self.source.parent), name)


def clips(data: Path, rooms: list[Path]) -> dict[str, Clip]:
    """Name every clip that is on this machine."""
    kitchen, studio = data / "redkitchen_7scenes", data / "studio_room"
    office, cabinet = data / "office_loop" / "images", data / "cubeslam_cabinet"
    tum = data / "tum_fr3_office"
    found = {
        "redkitchen": Clip(kitchen / "images", kitchen / "poses_c2w.txt", "530,530,322,238", True),
        "studio_room": Clip(studio / "images", studio / "colmap_text"),
        "office_loop": Clip(office),
        "tum_fr3": Clip(tum / "images17", tum / "poses17_c2w.txt", "535.4,539.2,320.6,248.1", True),
        "cubeslam": Clip(cabinet / "images"),
    }
    for room in rooms:
        camera = ",".join((room / "camera.txt").read_text().split()[4:])
        found[room.name] = Clip(room / "room.mp4", room / "poses.txt", camera, True)
    return {name: clip for name, clip in found.items() if clip.source.exists()}


def main() -> int:
    """Run every clip in a process of its own and print its rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="only these clips")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument(
        "--room", type=Path, action="append", default=[], help="a rendered room (repeatable)"
    )
    add_choosing(parser)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    found = clips(args.data, [ROOT / "examples" / "room", *args.room])
    names = args.names or list(found)
    if unknown := sorted(set(names) - set(found)):
        parser.error(f"no such clip here: {', '.join(unknown)}; there are {', '.join(found)}")
    if args.child:
        print("\n".join(rows(names[0], found[names[0]], args)))
        return 0
    names = [n for n in names if usable(*split_name(found[n].source.parent), args.choosing)]
    if not names:
        parser.error("no clip is left: give --choosing, or --room with a room for reporting")
    print(HEADER, flush=True)
    for name in names:
        rest = [a for a in sys.argv[1:] if a not in args.names]
        subprocess.run([sys.executable, __file__, name, "--child", *rest], check=False)
    return 0


def rows(name: str, clip: Clip, args: argparse.Namespace) -> Iterator[str]:
    """Reconstruct one clip and format its row(s)."""
    video, work = rt.Video(clip.source), args.out / name
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    started = time.monotonic()
    poses = rt.estimate_poses(video, rt.PosesConfig(), work)
    seconds = time.monotonic() - started
    kib = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, -1))
    end = f"{len(poses.frame) / seconds:.1f} | {kib / 1000:.0f} |"
    truth = None
    if clip.truth is not None:
        path = as_tum(clip.truth, work, video) if "c2w" in clip.truth.name else clip.truth
        truth = rt.read_poses(path, video, camera=clip.camera)
    yield row(clip.title(name), poses, truth, clip.metric) + end
    for message in poses.messages:
        print(f"{name}: {message}", file=sys.stderr)
    if name == "redkitchen" and truth is not None:
        dense = metric_like(dense_reference(clip.source, video, args.out / "dense"), truth)
        yield row(clip.title("redkitchen-sfm"), poses, dense, True) + " | |"
        yield row(clip.title("(dense to Kinect)"), dense, truth, True) + " | |"


def as_tum(path: Path, folder: Path, video: rt.Video) -> Path:
    """Write rows of 16 numbers (world_from_cam, one row a frame) as TUM rows."""
    world_from_cam = np.loadtxt(path).reshape(-1, 4, 4)
    xyzw = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()
    seconds = [frame.time_s for frame in video]
    tum = folder / "truth.txt"
    np.savetxt(tum, np.column_stack([seconds, world_from_cam[:, :3, 3], xyzw]))
    return tum


def world_from_cam(poses: rt.Poses, rows: Array) -> tuple[Array, Array]:
    """Centres (n, 3) and orientations (n, 3, 3) of the cameras in some rows."""
    cams = poses.cam_from_world[rows]
    turn = np.swapaxes(cams[:, :, :3], 1, 2)
    return -(turn @ cams[:, :, 3:])[:, :, 0], turn


def row(name: str, found: rt.Poses, truth: rt.Poses | None, metric: bool) -> str:
    """Format the accuracy columns of one clip."""
    located = f"| {name} | {found.known.sum()} of {len(found.frame)} | "
    if truth is None or found.known.sum() < 3:
        return located + "- | - | - | - | - | "
    scores = score(found, truth)
    error = " / ".join(f"{scores[k]:.2f}" for k in ("median", "rmse", "max"))
    cm = f"{scores['cm']:.2f}" if metric else "-"
    ratio = f"{scores['pnp']:.2f}" if np.isfinite(scores["pnp"]) else "-"
    focal = found.camera.K[0, 0] / truth.camera.K[0, 0]
    return f"{located}{error} | {cm} | {scores['turn']:.2f} | {ratio} | {focal:.4f} | "


def score(found: rt.Poses, truth: rt.Poses) -> dict[str, float]:
    """Compare cameras after a similarity alignment: see the columns in the head of this file."""
    both = found.known & truth.known
    (a, turn_a), (b, turn_b) = (world_from_cam(poses, both) for poses in (found, truth))
    scale, rotation, shift = similarity(a, b)
    error = np.linalg.norm(scale * a @ rotation.T + shift - b, axis=1)  # (F,)
    turn = np.swapaxes(rotation @ turn_a, 1, 2) @ turn_b
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)
    percent = 100 / float(np.linalg.norm(np.ptp(b, axis=0)))
    status = found.status[both]
    ratio = float("nan")
    if (status == "pnp").any() and (status == "keyframe").any():
        ratio = np.median(error[status == "pnp"]) / np.median(error[status == "keyframe"])
    return {
        "median": percent * float(np.median(error)),
        "rmse": percent * float(np.sqrt((error**2).mean())),
        "max": percent * float(error.max()),
        "cm": 100 * float(np.median(error)),
        "turn": float(np.degrees(np.median(np.arccos(cosine)))),
        "pnp": float(ratio),
    }


def metric_like(poses: rt.Poses, truth: rt.Poses) -> rt.Poses:
    """Scale a reconstruction to the units of poses that are metric."""
    both = poses.known & truth.known
    (a, _), (b, _) = (world_from_cam(p, both) for p in (poses, truth))
    cams = poses.cam_from_world.copy()
    cams[:, :, 3] *= similarity(a, b)[0]
    return dataclasses.replace(poses, cam_from_world=cams)


def dense_reference(images: Path, video: rt.Video, folder: Path) -> rt.Poses:
    """Reconstruct every second frame with COLMAP's own features and an OPENCV camera."""
    import pycolmap

    if not (folder / "model").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        database, out = str(folder / "database.db"), folder / "out"
        pycolmap.logging.minloglevel = 3
        features: dict[str, Any] = {
            "image_names": video.names[::2],
            "camera_mode": pycolmap.CameraMode.SINGLE,
            "reader_options": {"camera_model": "OPENCV", "default_focal_length_factor": 0.8},
        }
        matching: dict[str, Any] = {
            "pairing_options": {"overlap": 12, "quadratic_overlap": True},
            "verification_options": {"ransac": {"random_seed": 0}},
        }
        mapping: Any = {"num_threads": 1, "random_seed": 0, "extract_colors": False}
        pycolmap.extract_features(database, images, device=pycolmap.Device.cpu, **features)
        pycolmap.match_sequential(database, device=pycolmap.Device.cpu, **matching)
        out.mkdir()
        models = pycolmap.incremental_mapping(database, images, out, options=mapping)
        best = max(models.values(), key=lambda model: model.num_reg_images())
        (folder / "part").mkdir()
        best.write(folder / "part")
        (folder / "part").replace(folder / "model")
    return rt.read_poses(folder / "model", video)


if __name__ == "__main__":
    sys.exit(main())
