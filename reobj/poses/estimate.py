"""Reconstruct the poses of all frames of a video.

Keyframes are chosen (`keyframes`) and mapped (`sfm`); the frames between them are located by PnP or
interpolated (`localize`). Where the trajectory broke, this is repeated once with more keyframes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, SparseModel, import_pycolmap, read_sparse_model
from reobj.files import Progress, spans
from reobj.poses.intrinsics import parse_camera
from reobj.poses.keyframes import (
    MIN_KEYFRAMES,
    FlowOptions,
    ResizedFrame,
    ResizedVideo,
    pick_keyframes,
)
from reobj.poses.localize import beside_mapped, fill_gaps, locate_between
from reobj.poses.mapping import ADVICE, FOCAL_GUESS
from reobj.poses.sfm import Mapped, listed, mapping_child, reconstruct
from reobj.types import Array, BoolArray, IntArray, ReobjError, option

MAX_GAP = 15  # consecutive lost frames that are interpolated: half a second at 30 Hz


@dataclass(frozen=True, slots=True)
class PosesConfig:
    """Source of the camera poses, and options of the reconstruction."""

    mode: str = option(
        "auto",
        "auto: reconstruct them; none: 2D identities only; or a file or folder of poses",
        "--poses",
    )
    fmt: str = option(
        "auto",
        "format of supplied poses: auto, colmap, tum, transforms, scannet, record3d, arkit, "
        "matrices, euroc, stray, arkitscenes, scannetpp, llff, splatting, rows",
        "--pose-format",
    )
    frames_by: str = option(
        "",
        "how supplied poses are assigned to frames where the file is ambiguous (an error lists the "
        "choices): number0, number1, every6from1, time, order, ...",
    )
    camera: str = option(
        "",
        "intrinsics, native pixels (COLMAP: centre + .5): fx,fy,cx,cy[,k1,k2,p1,p2[,k3]], "
        "MODEL WIDTH HEIGHT PARAMS, or a file (cameras.txt, K.txt, intrinsics.json, camera.yaml)",
        "--camera",
    )
    metric: bool = option(False, "supplied poses are in metres, whatever their format", "--metric")
    depth: str = option(
        "",
        "folder of depth maps, 16-bit PNG in mm, or FOLDER:UNITS per metre: adds points and scale",
        "--depth",
    )
    size_px: int = option(640, "longer side to which frames are shrunk for the reconstruction, px")
    seed: int = option(0, "random seed of the reconstruction")


def estimate_poses(
    video: Any,
    config: PosesConfig,
    work_dir: Path,
    progress: Callable[[str, int], Progress] = Progress,
    boxes_to_mask: Callable[[int], Array] | None = None,
) -> Poses:
    """Reconstruct the cameras of a video of a static scene.

    Args:
        video: a `Video`, iterated several times.
        work_dir: receives `sparse/` (COLMAP model of the keyframes, native pixels) and
            `pycolmap.log`.
        progress: makes the progress line of a stage from its name and total.
        boxes_to_mask: frame number -> (N, 4) xyxy boxes of moving objects in native pixels, where
            no features are used.
    Returns:
        a pose for every frame that could be located, in an arbitrary frame and scale. A failed
        reconstruction is no exception: all poses are NaN and `messages` give reason and advice.
    """
    if getattr(video, "is_live", False):
        raise ReobjError("a live camera has no poses: record a video first, or use --poses none")
    size = (int(video.size[0]), int(video.size[1]))
    camera = parse_camera(config.camera, size)
    resized = ResizedVideo(video, config.size_px)
    first_models = work_dir / "first"
    with mapping_child(work_dir) as child:
        line = progress("keyframes", video.expected)
        keys = _enough_keyframes(resized, MAX_KEYFRAMES, line)
        focal_guess = _exif_focal(video) or FOCAL_GUESS
        row_of = {_frame_name(video, number): row for row, number in enumerate(resized.frames)}

        def attempt(keys: list[ResizedFrame]) -> _Attempt:
            mapped = reconstruct(
                [key.bgr for key in keys],
                [key.row + 1 for key in keys],
                [key.frame for key in keys],
                [_frame_name(video, key.frame) for key in keys],
                [
                    np.empty((0, 4)) if boxes_to_mask is None
                    else np.reshape(boxes_to_mask(key.frame), (-1, 4))
                    for key in keys
                ],
                size,
                camera=camera,
                focal_guess=focal_guess,
                seed=config.seed,
                child=child,
                work_dir=work_dir,
                progress=progress,
            )  # fmt: skip
            models = [read_sparse_model(model) for model in mapped.models]
            component_rows = [np.array([row_of[name] for name in model.names]) for model in models]
            matched = [key.row for key in keys if key.row + 1 not in mapped.unmatched]
            key_rows = np.array(matched, np.int64)
            line = progress("pnp", len(resized.frames))
            poses = _locate_all(models, component_rows, key_rows, resized, config, line)
            return _Attempt(poses, component_rows, key_rows, mapped)

        best = attempt(keys)
        wanted = set(best.more_keyframes())
        extra = [key for key in resized if key.row in wanted and key.has_texture] if wanted else []
        if extra:
            _move_models(best.mapped.models, first_models)
            second = attempt(sorted([*keys, *extra], key=lambda key: key.row))
            if second.located > best.located:
                best = second
            else:
                _move_models(sorted(first_models.iterdir()), work_dir)
    for folder in (work_dir / "mapping", first_models):
        shutil.rmtree(folder, ignore_errors=True)
    poses = best.poses
    messages = best.mapped.messages
    if poses.known.any():
        messages = [*messages, *_breaks(poses), *_lost_frames(poses, best.tried, video)]
    return dataclasses.replace(poses, messages=tuple(messages))


def _move_models(models: list[Path], folder: Path) -> None:
    """Move COLMAP models into a folder, replacing those in it."""
    for old in folder.glob("sparse*"):
        shutil.rmtree(old)
    folder.mkdir(exist_ok=True)
    for model in models:
        model.replace(folder / model.name)


@dataclass(frozen=True, slots=True)
class _Attempt:
    """A reconstruction of some keyframes and the poses of all frames by it.

    Attributes:
        component_rows: row of each image of each model. key_rows: (K,) of all keyframes with a
            verified match with another one, ascending. mapped: the models and messages.
    """

    poses: Poses
    component_rows: list[IntArray]
    key_rows: IntArray
    mapped: Mapped

    @property
    def located(self) -> int:
        """Count the pairs of frames with measured poses in one component."""
        measured = self.poses.known & (self.poses.status != "interpolated")
        return int((np.bincount(self.poses.part[measured], minlength=1) ** 2).sum())

    @property
    def tried(self) -> BoolArray:
        """Mark the frames (F,) at or beside a mapped keyframe: PnP is not tried for others."""
        mapped = np.concatenate([np.empty(0, np.int64), *self.component_rows])
        return beside_mapped(self.key_rows, mapped, len(self.poses.frame))

    def more_keyframes(self) -> list[int]:
        """Choose frames for more keyframes: around breaks, and where frames were not located."""
        if not self.component_rows:
            return []
        lost = np.flatnonzero((self.poses.status == "none") | (self.poses.status == "interpolated"))
        around = rows_around_breaks(self.key_rows.tolist(), self.component_rows)
        return sorted({*around, *rows_of_lost(self.key_rows, lost)})


def _locate_all(
    models: list[SparseModel],
    component_rows: list[IntArray],
    key_rows: IntArray,
    video: ResizedVideo,
    config: PosesConfig,
    line: Progress,
) -> Poses:
    """Locate all frames, each in the first component of the trajectory that explains it.

    Args:
        component_rows: row of each image of each model in the video. key_rows: of all keyframes.
    """
    frame = np.array(video.frames, np.int64)
    time_s = np.array(video.times_s, np.float64)
    cam_from_world = np.full((len(frame), 3, 4), np.nan)
    status = np.full(len(frame), "none", "<U12")
    component = np.full(len(frame), -1)
    if not models:
        size = (int(video.video.size[0]), int(video.video.size[1]))
        guess = (FOCAL_GUESS * max(size), size[0] / 2, size[1] / 2)
        camera = parse_camera(config.camera, size) or Camera("SIMPLE_PINHOLE", *size, guess)
        return Poses(camera, frame, time_s, cam_from_world, status, "none")
    visibility = []
    first_point = 0
    for number, (model, rows) in enumerate(zip(models, component_rows, strict=True)):
        unmapped = np.setdiff1d(key_rows, rows)
        located, how = locate_between(model, rows, unmapped, video, config.seed, line)
        size = model.cameras[0].width, model.cameras[0].height
        shrink = min(1.0, config.size_px / max(size))
        located, how = fill_gaps(
            model, rows, frame, time_s, located, how, MAX_GAP, shrink, unmapped
        )
        own = (how != "none") & (component < 0)
        own |= np.isin(np.arange(len(frame)), rows)  # keyframes of the model
        cam_from_world[own] = located[own]
        status[own] = how[own]
        component[own] = number
        visibility.append(np.column_stack([rows[model.obs_image], first_point + model.obs_point]))
        first_point += len(model.points)
    known = np.flatnonzero(component >= 0)
    nearest = np.abs(known[:, None] - np.arange(len(frame))).argmin(0)  # (F,)
    return Poses(
        models[0].cameras[0],
        frame,
        time_s,
        cam_from_world,
        status,
        "pycolmap",
        points=np.concatenate([model.points for model in models]),
        colors=np.concatenate([model.colors for model in models]),
        visibility=np.concatenate(visibility),
        part=component[known[nearest]],
    )


# ---- Keyframes -----------------------------------------------------------------------------------


MAX_KEYFRAMES = 400  # a longer video has wider steps (measured: 150 broke a walk of 373 photos)


def _enough_keyframes(video: ResizedVideo, most: int, line: Progress) -> list[ResizedFrame]:
    """Pick keyframes, halving the flow between them while they are fewer than MIN_KEYFRAMES.

    Of so few images all are keyframes: they are photos, with wide steps.
    """
    keys = pick_keyframes(video.first_pass(line), most)
    options = FlowOptions()
    if not video.frames:
        raise ReobjError("no readable frame in the video: nothing to reconstruct")
    if len(video.frames) <= MIN_KEYFRAMES:
        return list(video)
    wanted = min(MIN_KEYFRAMES, most // 2)  # thinning leaves half of them
    while len(keys) < wanted and options.max_flow > 2 * options.min_flow:
        options = dataclasses.replace(options, max_flow=options.max_flow / 2)
        keys = pick_keyframes(video, most, options)
    return keys


MAX_EXTRA = 8  # keyframes added between two at a break (chosen; more take longer)


def rows_around_breaks(key_rows: list[int], component_rows: list[IntArray]) -> list[int]:
    """Choose frames for more keyframes where the trajectory broke.

    A break is between two keyframes of different components, or without one; more keyframes are
    also chosen in the steps before and after it.

    Args:
        key_rows: rows of all keyframes, ascending. component_rows: of those of each component.
    Returns:
        rows of frames that are no keyframes yet, ascending.
    """
    component_of = {int(row): k for k, rows in enumerate(component_rows) for row in rows}
    components = [component_of.get(row, -1) for row in key_rows]
    broken = [
        k
        for k, (one, other) in enumerate(itertools.pairwise(components))
        if one != other or one < 0
    ]
    steps = {s for k in broken for s in (k - 1, k, k + 1) if 0 <= s < len(key_rows) - 1}
    rows: set[int] = set()
    for a, b in ((key_rows[s], key_rows[s + 1]) for s in sorted(steps)):
        count = min(MAX_EXTRA, b - a - 1)
        rows |= set(np.linspace(a, b, count + 2).round().astype(int)[1:-1].tolist())
    return sorted(rows - set(key_rows))


def rows_of_lost(key_rows: IntArray, lost: IntArray) -> list[int]:
    """Choose at most MAX_EXTRA of the lost frames between two keyframes for more keyframes.

    Args:
        key_rows: rows of the keyframes, ascending. lost: (L,) rows of frames without a measured
            pose, ascending.
    Returns:
        rows of frames that are no keyframes yet, ascending.
    """
    lost = np.setdiff1d(lost, key_rows)
    rows: list[int] = []
    for run in np.split(lost, np.flatnonzero(np.diff(np.searchsorted(key_rows, lost))) + 1):
        rows += run[np.linspace(0, len(run) - 1, min(MAX_EXTRA, len(run))).astype(int)].tolist()
    return rows


def _frame_name(video: Any, number: int) -> str:
    return str(video.names[number]) if video.names else f"frame_{number:06d}.jpg"


def _exif_focal(video: Any) -> float:
    """Read the focal length over the longer side from the first photo's EXIF; 0: there is none."""
    for path in video.files[:1]:
        with contextlib.suppress(ValueError, RuntimeError):  # formats that pycolmap cannot read
            camera = import_pycolmap().infer_camera_from_image(str(path))
            if camera.has_prior_focal_length:
                return float(camera.mean_focal_length() / max(camera.width, camera.height))
    return 0.0


# ---- Messages ------------------------------------------------------------------------------------


def _breaks(poses: Poses) -> list[str]:
    """Report between which frames the trajectory broke; [] if it did not."""
    rows = np.flatnonzero(poses.known)
    last = np.flatnonzero(np.diff(poses.part[rows]))
    if not len(last):
        return []
    ends = zip(poses.frame[rows[last]].tolist(), poses.frame[rows[last + 1]].tolist(), strict=True)
    where = [f"{a} and {b}" for a, b in ends]
    return [
        f"the reconstruction broke between frames {listed(where)}: no consistent model has both "
        "sides, even with more keyframes there; more overlap, slower rotation, or --camera help"
    ]


def _lost_frames(poses: Poses, tried: BoolArray, video: Any) -> list[str]:
    """Report which frames have no camera, why, and what helps; [] if all have one.

    Args:
        tried: (F,) frames for which PnP was tried.
    """
    frame = poses.frame
    lost = ~poses.known
    step = int(np.median(np.diff(frame))) if len(frame) > 1 else 1
    groups = []
    for mask, reason in (
        (lost & tried, "show too few points of the reconstruction"),
        (lost & ~tried, "are next to keyframes that could not be mapped with certainty"),
    ):
        numbers = frame[mask].tolist()
        if not numbers:
            continue
        files = [str(video.names[number]) for number in numbers[:5]] if video.names else []
        more = " ..." if len(numbers) > len(files) > 0 else ""
        named = f": {', '.join(files)}{more}" if files else ""
        groups.append(f"{spans(numbers, step)} ({len(numbers)}{named}) {reason}")
    if not groups:
        return []
    return [
        f"{lost.sum()} of {len(frame)} frames have no camera: frames {'; frames '.join(groups)}; "
        f"{ADVICE}, or --poses"
    ]
