"""The output folder: stages under a hash of their inputs, objects.json, tracks.txt."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shutil
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import quadrics
from reobj import __version__
from reobj.cameras import Poses, load_poses, save_poses, write_colmap, write_tum
from reobj.files import atomic, load_json, without_password
from reobj.sources.detection_files import TrackResult
from reobj.sources.video import Video, source_fingerprint
from reobj.types import Array, IntArray, ReobjError, Tracks, object_color


@dataclass
class RunResult:
    """What `run` found; the same is in the files of `out`.

    Attributes:
        table: all track rows; objects: entries of objects.json; fits: quadrics.ObjectFits or None;
        seconds: wall time by stage; warnings: what the user should know.
    """

    out: Path
    table: Tracks
    class_names: tuple[str, ...]
    objects: list[dict[str, Any]]
    poses: Poses | None
    fits: Any
    seconds: dict[str, float]
    warnings: list[str]
    world: dict[str, Any] = field(default_factory=dict)


class Workspace:
    """The output folder: what belongs to which inputs and options.

    Every stage keeps its result in OUT/cache under a hash of its inputs and options: a killed run
    resumes, a changed option recomputes what depends on it.
    """

    def __init__(self, out: Path, overwrite: bool = False) -> None:
        self.out, self.cache = out, out / "cache"
        foreign = out.is_dir() and any(out.iterdir()) and not self.cache.is_dir()
        if out.exists() and not out.is_dir():
            raise ReobjError(f"{out}: is a file; -o wants a folder")
        if foreign and not overwrite:
            what = "is not empty and not made by reobj_track"
            raise ReobjError(f"{out}: {what}; choose another -o, or say --overwrite")
        if foreign and (out / "sparse").exists():
            raise ReobjError(f"{out}: a sparse/ of its own would be lost; choose another -o")
        self.cache.mkdir(parents=True, exist_ok=True)

    def claim(self, video: Video, overwrite: bool) -> None:
        """Bind the folder to one video, so that results of two videos never mix."""
        path = self.cache / "source.json"
        path_of = Path(str(video.source))
        fingerprint = {
            "source": str(path_of.absolute()) if path_of.exists() else str(video.source),
            "content": source_fingerprint(video.source),
            "input": dataclasses.asdict(video.config),
        }
        if path.exists() and not overwrite:
            old = json.loads(path.read_text())
            if old["content"] != fingerprint["content"]:
                raise ReobjError(
                    f"{self.out}: holds the results of {old['source']}, not of {video.source}; "
                    "choose another -o, or say --overwrite"
                )
        with atomic(path) as part:
            part.write_text(json.dumps(fingerprint))

    def path(self, stage: str, *key: Any) -> Path:
        """File of a stage's result for this key (configs and strings)."""
        columns = [f.name for x in (Tracks, TrackResult) for f in dataclasses.fields(x)]
        text = json.dumps([__version__, columns, key], sort_keys=True, default=dataclasses.asdict)
        return self.cache / f"{stage}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.npz"

    def remember(self, track: TrackResult, poses: Poses | None) -> None:
        """Keep the latest tracks and poses for `objects OUT`."""
        track.save(self.cache / "last-tracks.npz")
        if poses is None:
            (self.cache / "last-poses.npz").unlink(missing_ok=True)
        else:
            save_poses(self.cache / "last-poses.npz", poses)

    def show_model(self, model: Path | None) -> None:
        """Make OUT/sparse a copy of a COLMAP model; None: remove that of an earlier run."""
        shutil.rmtree(self.out / "sparse", ignore_errors=True)
        if model is not None and model.is_dir():
            shutil.copytree(model, self.out / "sparse")

    def last_tracks(self) -> TrackResult | None:
        """The latest tracks, None if there are none."""
        path = self.cache / "last-tracks.npz"
        return TrackResult.load(path) if path.exists() else None

    def recall(self) -> tuple[TrackResult, Poses | None]:
        """The latest tracks and poses."""
        track, poses = self.last_tracks(), self.cache / "last-poses.npz"
        if track is None:
            raise ReobjError(f"{self.out}: no tracks here; make them first with `run` or `track`")
        return track, load_poses(poses) if poses.exists() else None


SOLID_FIELDS = ("center", "half_axes", "quat_wxyz", "size", "size_m", "size_rel_sigma", "cov")
OBJECT_FIELDS = (
    "id", "class", "score", "status", "reason", "support", *SOLID_FIELDS, "views", "frames_seen",
    "parallax_deg", "dropped_boxes", "reprojection_iou_median", "tracks", "frames",
)  # fmt: skip


def validate_objects(path: Path) -> list[str]:
    """Check an objects.json against objects.schema.json; returns one line for each fault."""
    try:
        import jsonschema
    except ImportError as error:
        raise ReobjError("jsonschema is not installed: pip install jsonschema") from error
    schema = json.loads(Path(__file__).with_name("objects.schema.json").read_text())
    faults = jsonschema.Draft202012Validator(schema).iter_errors(load_json(path))
    return sorted(f"{path}: {fault.json_path}: {fault.message[:200]}" for fault in faults)


def write_mot(path: Path, table: Tracks) -> None:
    """Write MOTChallenge results: frame (from 1), id, left, top, width, height, score, 3 x -1."""
    ltwh = np.column_stack([table.xyxy[:, :2], table.xyxy[:, 2:] - table.xyxy[:, :2]])
    rows = np.column_stack([table.frame + 1, table.track_id, ltwh, table.score])  # (N, 7)
    with atomic(path) as part:
        np.savetxt(part, rows, ("%d", "%d", *["%.2f"] * 4, "%.4f,-1,-1,-1"), ",")


PLY_DETAIL = 2  # subdivisions of the sphere: 512 triangles an object


def write_ply(path: Path, ellipsoids: quadrics.Ellipsoids, object_id: Sequence[int]) -> None:
    """Write ellipsoids as one coloured triangle mesh (PLY, binary little endian), in world."""
    sphere, faces = _icosphere(PLY_DETAIL)  # (P, 3), (T, 3)
    half = ellipsoids.half_axes[:, None] * sphere  # (O, P, 3)
    points = half @ np.swapaxes(ellipsoids.world_from_obj, 1, 2)
    points += ellipsoids.center_in_world[:, None]
    colors = np.array([object_color(i)[::-1] for i in object_id], np.uint8).reshape(-1, 3)  # RGB
    vertex = np.zeros(points.shape[:2], [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertex["xyz"], vertex["rgb"] = points, colors[:, None]
    face = np.zeros((len(points), len(faces)), [("n", "u1"), ("i", "<i4", 3)])
    face["n"], face["i"] = 3, faces + (np.arange(len(points)) * len(sphere))[:, None, None]
    names = [f"property float {n}\n" for n in "xyz"]
    names += [f"property uchar {n}\n" for n in ("red", "green", "blue")]
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment reobj_track ellipsoids\n"
        f"element vertex {vertex.size}\n{''.join(names)}"
        f"element face {face.size}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with atomic(path) as part:
        part.write_bytes(header.encode() + vertex.tobytes() + face.tobytes())


def _icosphere(detail: int) -> tuple[Array, IntArray]:
    """Unit sphere as points (P, 3) and triangles (T, 3): an octahedron `detail` + 1 times finer."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
                      [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])  # fmt: skip
    for _ in range(detail + 1):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], 2).reshape(-1, 2)
        edges, edge_of = np.unique(edges, axis=0, return_inverse=True)
        middle = points[edges].sum(1)  # (E, 3)
        (a, b, c), (ab, bc, ca) = faces.T, len(points) + edge_of.reshape(-1, 3).T
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        faces = np.array([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)])  # (4, 3, T)
        faces = faces.transpose(2, 0, 1).reshape(-1, 3)
    return points, faces


CONVENTIONS = {
    "pose": "cam_from_world",
    "camera_axes": "x right, y down, z forward",
    "quaternion": "wxyz, world_from_obj",
    "pixels": "centre of the top-left pixel at (0.5, 0.5) (COLMAP)",
    "frames": "0-based",
    "size": "full extents of the solid along its own axes",
    "ellipsoid": "inscribed in a box or cylinder",
    "cov": "9x9: center, log half axes, rotation vector in object axes",
}


def write_cameras(out: Path, poses: Poses, video: Video) -> None:
    """Write poses.txt, and sparse/ for supplied poses (pycolmap's own model has its points too)."""
    if poses.known.any():
        write_tum(out / "poses.txt", poses)
        if poses.source == "user":
            names = [video.name(int(f)) or f"{f:06d}" for f in poses.frame]
            write_colmap(out / "sparse", poses, names)


def write_objects_json(result: RunResult, video: Video) -> None:
    from importlib.metadata import version

    packages = ("numpy", "scipy", "opencv-python-headless", "pycolmap", "onnxruntime")
    versions = {}
    for name in packages:
        with contextlib.suppress(Exception):  # installed under another name: no version to tell
            versions[name] = version(name)
    width, height = video.size
    data = {
        "format": "reobj-objects",
        "version": 1,
        "command": without_password(" ".join(sys.argv)),
        "reobj_track": __version__,
        "versions": versions,
        "conventions": CONVENTIONS,
        "video": {
            "path": str(video.source),
            "width": width,
            "height": height,
            "fps": video.fps,
            "tracked_frames": len(np.unique(result.table.frame)),
        },
        "world": result.world,
        "objects": result.objects,
        "warnings": result.warnings,
    }
    with atomic(result.out / "objects.json") as part:
        part.write_text(json.dumps(data, indent=1) + "\n")


def summary(result: RunResult) -> str:
    """The table that `run` prints: object, class, frames seen, size with sigma, status."""
    scaled = any(o["size_m"] for o in result.objects)
    lines = [
        f"{'object':>6}  {'class':<14} {'frames':>6} {'visits':>6}  "
        f"{'width x depth x height, ' + ('m' if scaled else 'units'):<26} {'sigma':>6}  status"
    ]
    for o in result.objects:
        size = o["size_m"] or o["size"]
        text = " x ".join(f"{s:.2f}" for s in size) if size else "-"
        sigma = f"{100 * max(o['size_rel_sigma']):.0f} %" if o["size_rel_sigma"] else "-"
        reason = f" ({o['reason']})" if o["reason"] else ""
        lines.append(
            f"{o['id']:>6}  {o['class']:<14} {o['frames_seen']:>6} {len(o['frames']):>6}  "
            f"{text:<26} {sigma:>6}  {o['status']}{reason}"
        )
    counts = sorted(Counter(o["class"] for o in result.objects).items())
    lines.append("distinct objects: " + (", ".join(f"{n} {c}" for c, n in counts) or "none"))
    return "\n".join(lines + _summary_world(result))


def _summary_world(result: RunResult) -> list[str]:
    """Lines on cameras, scale, time and where to look."""
    lines, world = [], result.world
    if result.poses is not None:
        known, count = world["registered_frames"], len(result.poses.frame)
        lines.append(f"cameras: {known} of {count} frames ({result.poses.source})")
    if scale := world.get("scale"):
        sigma = 100 * (scale["rel_sigma"] or 0)
        facts = f"{scale['metres_per_unit']} m per unit, sigma {sigma:.0f} %"
        lines.append(f"scale: {facts} (from {scale['source']})")
    lines.append("seconds: " + ", ".join(f"{k} {v:.1f}" for k, v in result.seconds.items()))
    files = [result.out / name for name in ("scene.html", "overlay.mp4", "objects.json")]
    lines.append("look at: " + ", ".join(str(file) for file in files if file.exists()))
    return lines
