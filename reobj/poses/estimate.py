"""Reconstruct the poses of all frames of a video.

Keyframes are selected (`keyframes`) and mapped (`sfm`); the frames between them are located by PnP
or interpolated (`localize`). Where the trajectory broke, this is repeated once with more keyframes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, SparseModel, import_pycolmap, read_sparse_model
from reobj.files import Progress, component_path, spans
from reobj.poses.intrinsics import parse_camera
from reobj.poses.keyframes import (
    MAX_FLOW,
    MIN_FLOW,
    MIN_KEYFRAMES,
    ImageFile,
    ResizedFrame,
    ResizedVideo,
    pick_keyframes,
)
from reobj.poses.localize import beside_mapped, fill_gaps, locate_between
from reobj.poses.mapping import ADVICE, FOCAL_GUESS
from reobj.poses.sfm import Child, MakeProgress, Mapped, MappingJob, listed, reconstruct
from reobj.types import Array, BoolArray, IntArray, ReobjError, nearest_of, option

MAX_KEYFRAMES = 6000  # a longer video has wider steps


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
        "matrices, euroc, stray, arkitscenes, scannetpp, llff, splatting, reobj",
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
    camera_format: str = option(
        "auto",
        "format of the file of --camera: auto, colmap, numbers, kitti, matrix, pincam, json, yaml, "
        "xml, npz",
        "--camera-format",
    )
    metric: bool = option(False, "supplied poses are in metres, whatever their format", "--metric")
    depth: str = option(
        "",
        "folder of depth maps, 16-bit PNG in mm, or FOLDER:UNITS per metre: adds points and scale",
        "--depth",
    )
    size_px: int = option(640, "longer side to which frames are shrunk for the reconstruction, px")
    seed: int = option(0, "random seed of the reconstruction")

    def absolute(self) -> PosesConfig:
        """Return the options with the absolute path of depth maps, to be found from any folder."""
        depth = str(Path(self.depth).absolute()) if self.depth else ""
        return dataclasses.replace(self, depth=depth)


def estimate_poses(
    video: Any,
    config: PosesConfig,
    work_dir: Path,
    progress: MakeProgress = Progress,
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
    folder = work_dir / "mapping"
    for old in work_dir.glob("sparse*"):
        shutil.rmtree(old)
    with Child(folder, work_dir / "pycolmap.log") as child:
        made = _Reconstruction(video, config, boxes_to_mask, child, progress)
        keys = made.keyframes()
        best = made.attempt(keys, {})
        if extra := made.add_keyframes(sorted({*best.more_keyframes()} - {*keys})):
            second = made.attempt(sorted([*keys, *extra]), best.mapped.view_of)
            best = second if second.improves(best) else best
    for k, model in enumerate(best.mapped.models):
        model.replace(component_path(work_dir / "sparse", k))
    shutil.rmtree(folder, ignore_errors=True)
    poses = best.poses
    messages = best.mapped.messages
    if poses.known.any():
        messages = [*messages, *_breaks(poses), *_lost_frames(poses, best.tried, video)]
    messages = [*_frames_far_apart(poses, video.config.every), *messages]
    return dataclasses.replace(poses, messages=tuple(messages))


class _Reconstruction:
    """A video whose keyframes are mapped in a child process, once or twice.

    Args:
        boxes_to_mask: as of `estimate_poses`.
    """

    def __init__(
        self,
        video: Any,
        config: PosesConfig,
        boxes_to_mask: Callable[[int], Array] | None,
        child: Child,
        progress: MakeProgress,
    ) -> None:
        self.size = (int(video.size[0]), int(video.size[1]))
        self.camera = parse_camera(config.camera, self.size, config.camera_format)
        self.video = video
        self.resized = ResizedVideo(video, config.size_px)
        self.config = config
        self.boxes_of = boxes_to_mask or (lambda frame: np.empty((0, 4)))
        self.child = child
        self.progress = progress
        self.images = ImageFile(child.folder / "keyframes.raw")

    def _keep(self, frame: ResizedFrame) -> None:
        self.images.add(frame.row + 1, frame.bgr)

    def keyframes(self) -> list[int]:
        """Pick keyframes, halving the flow between them while they are fewer than MIN_KEYFRAMES.

        Of so few images all are keyframes: they are photos, with wide steps.

        Returns:
            their rows.
        """
        video = self.resized
        max_flow = MAX_FLOW
        line = self.progress("keyframes", self.video.expected)
        keys = pick_keyframes(video.first_pass(line), MAX_KEYFRAMES, max_flow, self._keep)
        if not video.frames:
            raise ReobjError("no readable frame in the video: nothing to reconstruct")
        if len(video.frames) <= MIN_KEYFRAMES:
            for frame in video:
                self._keep(frame)
            return list(range(len(video.frames)))
        while len(keys) < MIN_KEYFRAMES and max_flow > 2 * MIN_FLOW:
            max_flow /= 2
            frames = video.shown(self.progress("keyframes", len(video.frames)))
            keys = pick_keyframes(frames, MAX_KEYFRAMES, max_flow, self._keep)
        return keys

    def add_keyframes(self, rows: Sequence[int]) -> list[int]:
        """Read the images of more keyframes; return the rows of images with texture."""
        added = list[int]()
        if rows:
            line = self.progress("more keyframes", len(self.resized.frames))
            for frame in self.resized.shown(line):
                if frame.row in rows and frame.has_texture:
                    self._keep(frame)
                    added.append(frame.row)
        return added

    def attempt(self, keys: list[int], view_of: Mapping[int, int]) -> _Attempt:
        """Map keyframes and locate all frames.

        Args:
            keys: rows of the keyframes. view_of: of the first attempt, with fewer (`Mapped`).
        """
        frames = self.resized.frames
        names = [_frame_name(self.video, number) for number in frames]
        job = MappingJob(
            self.images,
            frame_of={row + 1: frames[row] for row in keys},
            name_of={row + 1: names[row] for row in keys},
            boxes_of={row + 1: self.boxes_of(frames[row]) for row in keys},
            size=self.size,
            camera=self.camera,
            focal_guess=_exif_focal(self.video) or FOCAL_GUESS,
            is_video=len(frames) >= 3 * len(keys),
            seed=self.config.seed,
            view_of=view_of,
        )
        mapped = reconstruct(job, self.child, self.progress)
        models = [read_sparse_model(model) for model in mapped.models]
        row_of = {name: row for row, name in enumerate(names)}
        rows = [np.array([row_of[name] for name in model.names]) for model in models]
        key_rows = np.array([row for row in keys if row + 1 not in mapped.unmatched], np.int64)
        poses = self._locate(models, rows, key_rows)
        poses = dataclasses.replace(poses, direction_sigma=np.array(mapped.direction_sigma))
        return _Attempt(poses, rows, key_rows, mapped)

    def _locate(
        self, models: list[SparseModel], component_rows: list[IntArray], key_rows: IntArray
    ) -> Poses:
        """Locate all frames, each in the first component of the trajectory that explains it.

        Args:
            component_rows: row of each image of each model. key_rows: of all keyframes.
        """
        video = self.resized
        frame = np.array(video.frames, np.int64)
        time_s = np.array(video.times_s, np.float64)
        cam_from_world = np.full((len(frame), 3, 4), np.nan)
        status = np.full(len(frame), "none", "<U12")
        component = np.full(len(frame), -1)
        line = self.progress("pnp", len(models) * len(frame))
        if not models:
            line.close()
            guess = (FOCAL_GUESS * max(self.size), self.size[0] / 2, self.size[1] / 2)
            camera = self.camera or Camera("SIMPLE_PINHOLE", *self.size, guess)
            return Poses(camera, frame, time_s, cam_from_world, status, "none")
        visibility = []
        points = []
        colors = []
        first_point = 0
        for number, (model, rows) in enumerate(zip(models, component_rows, strict=True)):
            unmapped = np.setdiff1d(key_rows, rows)
            located = locate_between(model, rows, unmapped, video, self.config.seed, line)
            shrink = min(1.0, self.config.size_px / max(self.size))
            filled, how = fill_gaps(located, frame, time_s, shrink, unmapped)
            is_turn = not model.cam_from_world[:, :, 3].any()
            if is_turn:
                filled[:, :, 3] *= 0  # keeps NaN
            own = (how != "none") & (component < 0)
            own[rows] = True  # keyframes of the model
            cam_from_world[own] = filled[own]
            status[own] = how[own]
            component[own] = number
            if is_turn:  # its points are directions, without depth
                model = dataclasses.replace(
                    model, points=model.points[:0], colors=model.colors[:0],
                    obs_image=model.obs_image[:0], obs_point=model.obs_point[:0],
                )  # fmt: skip
            visibility.append(
                np.column_stack([rows[model.obs_image], first_point + model.obs_point])
            )
            points.append(model.points)
            colors.append(model.colors)
            first_point += len(model.points)
        line.close()
        known = np.flatnonzero(component >= 0)
        return Poses(
            models[0].cameras[0],
            frame,
            time_s,
            cam_from_world,
            status,
            "pycolmap",
            points=np.concatenate(points),
            colors=np.concatenate(colors),
            visibility=np.concatenate(visibility),
            part=component[known[nearest_of(np.arange(len(frame)), known)]],
        )


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
    def pairs(self) -> int:
        """Count the pairs of frames with measured poses in one component."""
        return int((np.bincount(self.poses.part[self.poses.measured], minlength=1) ** 2).sum())

    def improves(self, first: _Attempt) -> bool:
        """Whether it connects more frames; with less certain directions twice as many pairs."""
        more = self.poses.direction_sigma.max() - first.poses.direction_sigma.max()
        factor = 2 ** np.sign(round(float(more), 3))
        return bool(self.pairs > factor * first.pairs)

    @property
    def tried(self) -> BoolArray:
        """Mark the frames (F,) at or beside a mapped keyframe: PnP is not tried for others."""
        mapped = np.concatenate([np.empty(0, np.int64), *self.component_rows])
        return beside_mapped(self.key_rows, mapped, len(self.poses.frame))

    def more_keyframes(self) -> list[int]:
        """Choose frames for more keyframes: around breaks, and where frames were not located."""
        if not self.component_rows:
            return []
        lost = np.flatnonzero(~self.poses.measured)
        around = rows_around_breaks(self.key_rows.tolist(), self.component_rows)
        return sorted({*around, *rows_of_lost(self.key_rows, lost)})


# ---- More keyframes ------------------------------------------------------------------------------


MAX_EXTRA = 8  # keyframes added between two at a break; matching them takes time


def rows_around_breaks(key_rows: list[int], component_rows: list[IntArray]) -> list[int]:
    """Choose frames for more keyframes where the trajectory broke.

    A break is between two keyframes of different components, or without one; more keyframes are
    also selected in the steps before and after it.

    Args:
        key_rows: rows of all keyframes, ascending. component_rows: of those of each component.
    Returns:
        rows of frames that are no keyframes yet, ascending.
    """
    component_of = {int(row): k for k, rows in enumerate(component_rows) for row in rows}
    components = [component_of.get(row, -1) for row in key_rows]
    steps = set[int]()
    for k, (one, other) in enumerate(itertools.pairwise(components)):
        if one != other or one < 0:
            steps |= {k - 1, k, k + 1} & set(range(len(key_rows) - 1))
    rows = set[int]()
    for a, b in ((key_rows[s], key_rows[s + 1]) for s in steps):
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


def _frames_far_apart(poses: Poses, every: int) -> list[str]:
    """Advise to read more frames where some have no camera or do not connect; else []."""
    if every == 1 or (poses.known.all() and poses.part_count == 1):
        return []
    return [
        f"--every {every} may leave too few points in common between frames: first try a smaller "
        f"one (--every {every // 2})"
    ]


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
    lost = ~poses.known
    step = int(np.median(np.diff(poses.frame))) if len(lost) > 1 else 1
    groups = []
    for mask, reason in (
        (lost & tried, "show too few points of the reconstruction"),
        (lost & ~tried, "are next to keyframes that could not be mapped with certainty"),
    ):
        if numbers := poses.frame[mask].tolist():
            files = [video.names[n] for n in numbers[:5]] if video.names else []
            named = f": {', '.join(files)}" if files else ""
            named += " ..." if len(numbers) > len(files) > 0 else ""
            groups.append(f"{spans(numbers, step)} ({len(numbers)}{named}) {reason}")
    if not groups:
        return []
    return [
        f"{lost.sum()} of {len(lost)} frames have no camera: frames {'; frames '.join(groups)}; "
        f"{ADVICE}, or --poses"
    ]
