"""Reconstruct the poses of all frames of a video.

Keyframes are chosen (`keyframes`) and mapped (`sfm`); the frames between them are located by PnP or
interpolated (`localize`). Where the trajectory broke, this is repeated once with more keyframes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, Poses, SparseModel, import_pycolmap, read_sparse_model
from reobj.files import Progress, atomic, load_cached, load_json, spans
from reobj.poses.child_job import ImageFile
from reobj.poses.intrinsics import parse_camera
from reobj.poses.keyframes import (
    MIN_KEYFRAMES,
    FlowOptions,
    Keyframe,
    ResizedFrame,
    ResizedVideo,
    pick_keyframes,
)
from reobj.poses.localize import Located, beside_mapped, fill_gaps, locate_between
from reobj.poses.mapping import ADVICE, FOCAL_GUESS
from reobj.poses.sfm import Mapped, listed, mapping_child, reconstruct
from reobj.types import Array, BoolArray, IntArray, ReobjError, nearest_of, option

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
    camera = parse_camera(config.camera, size, config.camera_format)
    resized = ResizedVideo(video, config.size_px)
    first_models = work_dir / "first"
    with mapping_child(work_dir) as child:
        store = KeyframeStore(work_dir, _keyframes_key(video, config))
        keys = store.load(resized)
        if keys is None:
            keys = _enough_keyframes(resized, MAX_KEYFRAMES, store, progress)
            store.save(resized, keys)
        focal_guess = _exif_focal(video) or FOCAL_GUESS
        row_of = {_frame_name(video, number): row for row, number in enumerate(resized.frames)}

        def attempt(keys: list[Keyframe], before: Sequence[Located] = ()) -> _Attempt:
            mapped = reconstruct(
                store.images_of(keys),
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
                is_video=len(resized.frames) >= 3 * len(keys),
                seed=config.seed,
                child=child,
                work_dir=work_dir,
                progress=progress,
            )  # fmt: skip
            models = [read_sparse_model(model) for model in mapped.models]
            component_rows = [np.array([row_of[name] for name in model.names]) for model in models]
            matched = [key.row for key in keys if key.row + 1 not in mapped.unmatched]
            key_rows = np.array(matched, np.int64)
            line = progress("pnp", len(models) * len(resized.frames))
            poses, located = _locate_all(
                models, component_rows, key_rows, resized, config, line, before
            )
            return _Attempt(poses, component_rows, key_rows, mapped, located)

        best = attempt(keys)
        wanted = set(best.more_keyframes())
        extra = []
        if wanted:
            frames = resized.shown(progress("more keyframes", len(resized.frames)))
            extra = [store.keep(f) for f in frames if f.row in wanted and f.has_texture]
        if extra:
            _move_models(best.mapped.models, first_models)
            second = attempt(sorted([*keys, *extra], key=lambda key: key.row), best.located)
            if second.pairs > best.pairs:
                best = second
            else:
                _move_models(sorted(first_models.iterdir()), work_dir)
    for folder in (work_dir / "mapping", first_models):
        shutil.rmtree(folder, ignore_errors=True)
    store.remove()
    poses = best.poses
    messages = best.mapped.messages
    if poses.known.any():
        messages = [*messages, *_breaks(poses), *_lost_frames(poses, best.tried, video)]
    messages = [*_frames_far_apart(poses, video.config.every), *messages]
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
        located: the frames by each model.
    """

    poses: Poses
    component_rows: list[IntArray]
    key_rows: IntArray
    mapped: Mapped
    located: list[Located]

    @property
    def pairs(self) -> int:
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
    before: Sequence[Located],
) -> tuple[Poses, list[Located]]:
    """Locate all frames, each in the first component of the trajectory that explains it.

    Args:
        component_rows: row of each image of each model in the video. key_rows: of all keyframes.
        before: the frames by each model of an earlier call with fewer keyframes.
    Returns:
        poses of all frames, and the frames by each model.
    """
    frame = np.array(video.frames, np.int64)
    time_s = np.array(video.times_s, np.float64)
    cam_from_world = np.full((len(frame), 3, 4), np.nan)
    status = np.full(len(frame), "none", "<U12")
    component = np.full(len(frame), -1)
    if not models:
        line.close()
        size = (int(video.video.size[0]), int(video.video.size[1]))
        guess = (FOCAL_GUESS * max(size), size[0] / 2, size[1] / 2)
        camera = parse_camera(config.camera, size, config.camera_format) or Camera(
            "SIMPLE_PINHOLE", *size, guess
        )
        return Poses(camera, frame, time_s, cam_from_world, status, "none"), []
    visibility = []
    by_model = list[Located]()
    first_point = 0
    for number, (model, rows) in enumerate(zip(models, component_rows, strict=True)):
        unmapped = np.setdiff1d(key_rows, rows)
        earlier = next((old for old in before if old.is_of(model, rows)), None)
        by_model.append(locate_between(model, rows, unmapped, video, config.seed, line, earlier))
        size = model.cameras[0].width, model.cameras[0].height
        shrink = min(1.0, config.size_px / max(size))
        located, how = fill_gaps(by_model[-1], frame, time_s, MAX_GAP, shrink, unmapped)
        own = (how != "none") & (component < 0)
        own |= np.isin(np.arange(len(frame)), rows)  # keyframes of the model
        cam_from_world[own] = located[own]
        status[own] = how[own]
        component[own] = number
        visibility.append(np.column_stack([rows[model.obs_image], first_point + model.obs_point]))
        first_point += len(model.points)
    line.close()
    known = np.flatnonzero(component >= 0)
    poses = Poses(
        models[0].cameras[0],
        frame,
        time_s,
        cam_from_world,
        status,
        "pycolmap",
        points=np.concatenate([model.points for model in models]),
        colors=np.concatenate([model.colors for model in models]),
        visibility=np.concatenate(visibility),
        part=component[known[nearest_of(np.arange(len(frame)), known)]],
    )
    return poses, by_model


# ---- Keyframes -----------------------------------------------------------------------------------


MAX_KEYFRAMES = 6000  # a longer video has wider steps


class KeyframeStore:
    """The images of keyframes in a file, which also serves the next run after an interruption.

    Args:
        folder: of the files. key: of the video and the options; keyframes of another are not used.
    Attributes:
        file: with an image for each row of the video that was kept. position: of each in it.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.file = ImageFile(folder / "keyframes.raw")
        self.table = folder / "keyframes.json"
        self.key = key
        self.position: dict[int, int] = {}

    def keep(self, frame: ResizedFrame) -> Keyframe:
        """Write the image of a frame, unless it is in the file."""
        if not self.position:
            self.table.unlink(missing_ok=True)  # it describes the file that is replaced
        if frame.row not in self.position:
            self.position[frame.row] = len(self.file)
            self.file.append(frame.bgr)
        return Keyframe.of(frame)

    def images_of(self, keys: Sequence[Keyframe]) -> ImageFile:
        """Return the images of some keyframes."""
        return self.file.select([self.position[key.row] for key in keys])

    def save(self, video: ResizedVideo, keys: Sequence[Keyframe]) -> None:
        """Keep the choice of keyframes for the next run."""
        rows = [key.row for key in keys]
        table = {
            "key": self.key,
            "shape": self.file.shape,
            "rows": rows,
            "slots": [self.position[row] for row in rows],
            "frames": video.frames,
            "times_s": video.times_s,
        }
        with atomic(self.table) as part:
            part.write_text(json.dumps(table), encoding="utf-8")

    def load(self, video: ResizedVideo) -> list[Keyframe] | None:
        """Read the keyframes that an interrupted run chose; None if there are none.

        Args:
            video: gets the numbers and times of its frames.
        """
        table = load_cached(self.table, load_json)
        if not isinstance(table, dict) or table.get("key") != self.key:
            return None
        count = 1 + max(table["slots"], default=-1)
        size = count * math.prod(table["shape"])
        if not self.file.path.exists() or self.file.path.stat().st_size < size:
            return None
        os.truncate(self.file.path, size)  # images after them have no number in the table
        video.frames = table["frames"]
        video.times_s = table["times_s"]
        self.file = ImageFile(self.file.path, table["shape"], range(count))
        self.position = dict(zip(table["rows"], table["slots"], strict=True))
        return [Keyframe(row, video.frames[row]) for row in table["rows"]]

    def remove(self) -> None:
        """Remove the files."""
        self.table.unlink(missing_ok=True)
        self.file.path.unlink(missing_ok=True)


def _keyframes_key(video: Any, config: PosesConfig) -> str:
    """Identify what the choice of keyframes depends on."""
    return repr((video.fingerprint, video.config, config.size_px, FlowOptions(), MAX_KEYFRAMES))


def _enough_keyframes(
    video: ResizedVideo,
    most: int,
    store: KeyframeStore,
    progress: Callable[[str, int], Progress],
) -> list[Keyframe]:
    """Pick keyframes, halving the flow between them while they are fewer than MIN_KEYFRAMES.

    Of so few images all are keyframes: they are photos, with wide steps.
    """
    options = FlowOptions()
    line = progress("keyframes", video.video.expected)
    keys = pick_keyframes(video.first_pass(line), most, options, store.keep)
    if not video.frames:
        raise ReobjError("no readable frame in the video: nothing to reconstruct")
    if len(video.frames) <= MIN_KEYFRAMES:
        return [store.keep(frame) for frame in video]
    wanted = min(MIN_KEYFRAMES, most // 2)  # thinning leaves half of them
    while len(keys) < wanted and options.max_flow > 2 * options.min_flow:
        options = dataclasses.replace(options, max_flow=options.max_flow / 2)
        frames = video.shown(progress("keyframes", len(video.frames)))
        keys = pick_keyframes(frames, most, options, store.keep)
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
