"""Poses of all frames of a video: keyframes, their reconstruction, the frames between them.

The chain alone; its links are `keyframes`, `mapping` and `localize`. Poses made elsewhere are read
by `readers`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, SparseModel, import_pycolmap, read_sparse_model
from reobj.files import Progress, spans
from reobj.poses.intrinsics import parse_camera
from reobj.poses.keyframes import MAX_FLOW, MIN_FLOW, ResizedFrame, ResizedVideo, pick_keyframes
from reobj.poses.localize import beside_held, fill_gaps, locate_between
from reobj.poses.mapping import FOCAL_GUESS, HOW_TO_FILM, Mapped, mapping_child, reconstruct
from reobj.types import Array, BoolArray, IntArray, ReobjError, option

MAX_GAP = 15  # most lost frames in a row that are interpolated (chosen: half a second at 30 Hz)


@dataclass(frozen=True, slots=True)
class PosesConfig:
    """Camera poses: where they come from, and how much is spent on a reconstruction."""

    mode: str = option(
        "auto",
        "auto: reconstruct them; none: identities in 2D only; or a file or folder of poses",
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
        "how supplied poses find their frames where the file leaves it open (an error names the "
        "ways): number0, number1, every6from1, time, order, ...",
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
        "folder of depth maps, 16-bit PNG in mm, or FOLDER:UNITS per metre: points, metric scale",
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
        boxes_to_mask: frame number -> (N, 4) xyxy boxes of moving things in native pixels, left out
            of the features.
    Returns:
        a pose for every frame that could be located, in the reconstruction's own world and scale. A
        failed reconstruction is no exception: all poses are NaN and `messages` say why and what
        helps.
    """
    if getattr(video, "is_live", False):
        raise ReobjError("a live camera gives no poses: record a video first, or --poses none")
    size = (int(video.size[0]), int(video.size[1]))
    camera, resized = parse_camera(config.camera, size), ResizedVideo(video, config.size_px)
    kept = work_dir / "first"
    with mapping_child(work_dir) as child:
        line = progress("keyframes", video.expected)
        keys = _enough_keyframes(resized, MAX_KEYFRAMES, line)
        focal = _exif_focal(video) or FOCAL_GUESS

        def attempt(keys: list[ResizedFrame]) -> _Attempt:
            found = reconstruct(
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
                focal_guess=focal,
                seed=config.seed,
                child=child,
                work_dir=work_dir,
                progress=progress,
            )  # fmt: skip
            models = [read_sparse_model(model) for model in found.models]
            part_rows = [np.array([row_of[name] for name in model.names]) for model in models]
            matched = np.array([k.row for k in keys if k.row + 1 not in found.alone], np.int64)
            line = progress("pnp", len(resized.frames))
            poses = _locate_all(models, part_rows, matched, resized, config, line)
            return _Attempt(poses, part_rows, matched, found)

        row_of = {_frame_name(video, number): row for row, number in enumerate(resized.frames)}
        best = attempt(keys)
        wanted = set(best.more_keyframes())
        extra = [k for k in resized if k.row in wanted and k.has_texture] if wanted else []
        if extra:
            _move_models(best.found.models, kept)
            again = attempt(sorted([*keys, *extra], key=lambda key: key.row))
            if again.located > best.located:
                best = again
            else:
                _move_models(sorted(kept.iterdir()), work_dir)
    for folder in (work_dir / "mapping", kept):
        shutil.rmtree(folder, ignore_errors=True)
    poses, messages = best.poses, best.found.messages
    if poses.known.any():
        messages = [*messages, *_breaks(poses), *_lost_frames(poses, best.reached, video)]
    return dataclasses.replace(poses, messages=tuple(messages))


def _move_models(models: list[Path], folder: Path) -> None:
    """Move COLMAP models into a folder, in the place of those that are there."""
    for old in folder.glob("sparse*"):
        shutil.rmtree(old)
    folder.mkdir(exist_ok=True)
    for model in models:
        model.replace(folder / model.name)


@dataclass(frozen=True, slots=True)
class _Attempt:
    """A reconstruction of some keyframes and the poses of all frames by it.

    Attributes:
        part_rows: row of each image of each model. key_rows: (K,) of all keyframes whose matches
            with another one were verified, ascending. found: the models and messages.
    """

    poses: Poses
    part_rows: list[IntArray]
    key_rows: IntArray
    found: Mapped

    @property
    def located(self) -> int:
        """Count the pairs of frames whose poses are measured in one world."""
        measured = self.poses.known & (self.poses.status != "interpolated")
        return int((np.bincount(self.poses.part[measured], minlength=1) ** 2).sum())

    @property
    def reached(self) -> BoolArray:
        """Mark the frames (F,) at or beside a keyframe that a model holds: others are not tried."""
        held = np.concatenate([np.empty(0, np.int64), *self.part_rows])
        return beside_held(self.key_rows, held, len(self.poses.frame))

    def more_keyframes(self) -> list[int]:
        """Choose frames for more keyframes: around breaks, and where frames were not located."""
        if not self.part_rows:
            return []
        lost = np.flatnonzero((self.poses.status == "none") | (self.poses.status == "interpolated"))
        around = rows_around_breaks(self.key_rows.tolist(), self.part_rows)
        return sorted({*around, *rows_of_lost(self.key_rows, lost)})


def _locate_all(
    models: list[SparseModel],
    part_rows: list[IntArray],
    key_rows: IntArray,
    video: ResizedVideo,
    config: PosesConfig,
    line: Progress,
) -> Poses:
    """Locate all frames in the parts of the reconstruction, each in the first that explains it.

    Args:
        part_rows: row of each image of each model in the video. key_rows: of all keyframes.
    """
    frame, time_s = np.array(video.frames, np.int64), np.array(video.times_s, np.float64)
    cam_from_world = np.full((len(frame), 3, 4), np.nan)
    status, part = np.full(len(frame), "none", "<U12"), np.full(len(frame), -1)
    if not models:
        size = (int(video.video.size[0]), int(video.video.size[1]))
        guess = (FOCAL_GUESS * max(size), size[0] / 2, size[1] / 2)
        camera = parse_camera(config.camera, size) or Camera("SIMPLE_PINHOLE", *size, guess)
        return Poses(camera, frame, time_s, cam_from_world, status, "none")
    seen, first = [], 0
    for number, (model, rows) in enumerate(zip(models, part_rows, strict=True)):
        left_out = np.setdiff1d(key_rows, rows)
        cameras, found = locate_between(model, rows, left_out, video, config.seed, line)
        size = model.cameras[0].width, model.cameras[0].height
        shrink = min(1.0, config.size_px / max(size))
        cameras, found = fill_gaps(
            model, rows, frame, time_s, cameras, found, MAX_GAP, shrink, left_out
        )
        mine = (found != "none") & (part < 0)
        mine |= np.isin(np.arange(len(frame)), rows)  # its own keyframes
        cam_from_world[mine], status[mine], part[mine] = cameras[mine], found[mine], number
        seen.append(np.column_stack([rows[model.obs_image], first + model.obs_point]))
        first += len(model.points)
    known = np.flatnonzero(part >= 0)
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
        visibility=np.concatenate(seen),
        part=part[known[nearest]],
    )


MAX_KEYFRAMES = 400  # a longer way takes wider steps (chosen: 150 tore a walk of 373 photos)
MIN_KEYFRAMES = 40  # below, the spacing is halved as long as there is motion (chosen)


def _enough_keyframes(video: ResizedVideo, most: int, line: Progress) -> list[ResizedFrame]:
    """Pick keyframes, at half the flow for as long as they are fewer than MIN_KEYFRAMES.

    Of so few pictures all are taken: they are photos, with wide steps.
    """
    keys, max_flow = pick_keyframes(video.first_pass(line), most), MAX_FLOW
    if not video.frames:
        raise ReobjError("the video has no frame that can be read: nothing to reconstruct")
    if len(video.frames) <= MIN_KEYFRAMES:
        return list(video)
    wanted = min(MIN_KEYFRAMES, most // 2)  # thinning leaves half of them
    while len(keys) < wanted and max_flow > 2 * MIN_FLOW:
        max_flow /= 2
        keys = pick_keyframes(video, most, max_flow)
    return keys


MAX_EXTRA = 8  # keyframes added between two where the reconstruction broke (chosen)


def rows_around_breaks(key_rows: list[int], part_rows: list[IntArray]) -> list[int]:
    """Choose frames for more keyframes where a reconstruction broke.

    A break is between two keyframes of different parts, or without one; the steps on its two sides
    are filled too.

    Args:
        key_rows: rows of all keyframes, ascending. part_rows: of those of each part.
    Returns:
        rows of frames that are no keyframes yet, ascending.
    """
    part_of = {int(row): part for part, rows in enumerate(part_rows) for row in rows}
    parts = [part_of.get(row, -1) for row in key_rows]
    broken = [k for k in range(len(parts) - 1) if parts[k] != parts[k + 1] or parts[k] < 0]
    steps = {s for k in broken for s in (k - 1, k, k + 1) if 0 <= s < len(key_rows) - 1}
    rows: set[int] = set()
    for a, b in ((key_rows[s], key_rows[s + 1]) for s in sorted(steps)):
        count = min(MAX_EXTRA, b - a - 1)
        rows |= set(np.linspace(a, b, count + 2).round().astype(int)[1:-1].tolist())
    return sorted(rows - set(key_rows))


def rows_of_lost(key_rows: IntArray, lost: IntArray) -> list[int]:
    """Choose of the lost frames between two keyframes at most MAX_EXTRA for more keyframes.

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


MAX_BREAKS = 5  # named in a message (chosen)


def _breaks(poses: Poses) -> list[str]:
    """Say between which frames the reconstruction broke and what was done; [] if it did not.

    For the consequences for objects see `components_message` of `reobj.objects.description`.
    """
    rows = np.flatnonzero(poses.known)
    at = np.flatnonzero(np.diff(poses.part[rows]))
    if not len(at):
        return []
    ends = zip(poses.frame[rows[at]].tolist(), poses.frame[rows[at + 1]].tolist(), strict=True)
    where = [f"{a} and {b}" for a, b in ends]
    more = f" and {len(where) - MAX_BREAKS} more" if len(where) > MAX_BREAKS else ""
    return [
        f"the reconstruction broke between frames {', '.join(where[:MAX_BREAKS])}{more}: no model "
        "of both sides holds together, also with more keyframes there; more overlap, slower turns, "
        "or --camera help"
    ]


MAX_NAMED = 5  # files named in a message (chosen)


def _lost_frames(poses: Poses, reached: BoolArray, video: Any) -> list[str]:
    """Say which frames have no camera, what is known of them, and what helps; [] if all have one.

    Args:
        reached: (F,) frames that the points of the reconstruction were followed to.
    """
    frame, lost = poses.frame, ~poses.known
    step, whys = int(np.median(np.diff(frame))) if len(frame) > 1 else 1, []
    for mine, why in (
        (lost & reached, "show too few points of the reconstruction again"),
        (lost & ~reached, "lie at keyframes that no part of the reconstruction holds for certain"),
    ):
        numbers = frame[mine].tolist()
        files = [str(video.names[number]) for number in numbers[:MAX_NAMED]] if video.names else []
        more = " ..." if files and len(numbers) > MAX_NAMED else ""
        named = f": {', '.join(files)}{more}" if files else ""
        whys += [f"{spans(numbers, step)} ({len(numbers)}{named}) {why}"] if numbers else []
    if not whys:
        return []
    return [
        f"{lost.sum()} of {len(frame)} frames have no camera: frames {'; frames '.join(whys)}; "
        f"{HOW_TO_FILM}, or --poses"
    ]
