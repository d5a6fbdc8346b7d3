"""Stages of `run` and `refit`: detections, cameras, place in a map, objects, files.

`run` in `reobj_track` calls them in this order; the tracking between them is its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import quadrics
from reobj.cameras import Poses, without_copies
from reobj.config import Config, changed_options, read_config, write_config
from reobj.export.registry import Viewer
from reobj.files import Progress, component_path, shortened
from reobj.maps.stage import (
    OpenMap,
    Placed,
    finish_map,
    move_models,
    opened_map,
    place_recording,
)
from reobj.objects.config import ObjectsConfig, solve_again
from reobj.objects.description import components_message, scores_far_off
from reobj.objects.fit import fill, link_and_fit
from reobj.poses.stage import (
    checked_poses,
    reconstruct_cached,
    write_supplied_model,
)
from reobj.poses.supplied.check import Supplied
from reobj.poses.supplied.readers import open_video
from reobj.results.changes import read_changes
from reobj.results.edits import kept_edits
from reobj.results.entries import OutputFile, copy_models
from reobj.results.links import Links
from reobj.results.plausibility import implausible
from reobj.results.result import Result, VideoInfo, write_objects
from reobj.results.workspace import Workspace, detect_all, keep_detections
from reobj.sources.detection_files import read_tracks
from reobj.sources.detectors import DetectionSource, open_detections
from reobj.sources.video import InputConfig, Video
from reobj.types import Image, ReobjError, Tracks, log, log_message, without_secrets
from reobj.viewer.scene import write_pictures
from reobj.viewer.serve import LivePage, open_viewer
from reobj.words import (
    among,
    check_known_size,
    parse_known_size,
    parse_up,
    priors_used,
    unused_sizes,
)

DetectionInput = str | Path | Callable[[Image], Any] | None  # of `run`


@dataclass(frozen=True, slots=True)
class Job:
    """Inputs of every stage.

    Attributes:
        room: map of the room. viewer: live view of `--show`.
        seconds: wall time of each stage, added by the stage. step_seconds: of its steps; {} if its
            result was taken from the cache.
        lines: progress lines of the current stage.
    """

    video: Video
    workspace: Workspace
    config: Config
    room: OpenMap | None = None
    viewer: Viewer | LivePage | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    step_seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    lines: list[Progress] = field(default_factory=list)

    @property
    def runtime(self) -> tuple[int, bool, str]:
        """Return the options of networks: threads, offline, device."""
        return self.config.threads, self.config.offline, self.config.device

    def check_known_size(self, class_names: Sequence[str]) -> None:
        """Refuse known sizes of categories that the detector does not have."""
        config = self.config.objects
        check_known_size(config.known_size, config.size_priors(), class_names)

    def progress(self, step: str, total: int = 0) -> Progress:
        """Begin the progress line of a step of the current stage."""
        self.lines.append(Progress(step, total))
        return self.lines[-1]

    @contextlib.contextmanager
    def timed(self, stage: str, may_be_cached: bool = False) -> Iterator[None]:
        """Measure the wall time of a stage and of its steps.

        Args:
            may_be_cached: without any step, the result was taken from the cache.
        """
        started = time.monotonic()
        self.lines.clear()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.monotonic() - started
        steps = self.step_seconds.get(stage, {})
        for line in self.lines:
            steps[line.stage] = steps.get(line.stage, 0.0) + line.seconds
        if steps or may_be_cached:
            self.step_seconds[stage] = steps
        log.info("%s: %.1f s", stage, self.seconds[stage])


# ---- Beginning ----


@contextlib.contextmanager
def open_job(
    source: Video | str | Path | int | None,
    out: str | Path | None,
    config: Config,
    recorded: Any = None,
    overwrite: bool = False,
    show: bool = False,
) -> Iterator[Job]:
    """Open the video, output folder, map and live view of `run`.

    Args:
        recorded: the file of detections or identities, if there is one.
    """
    if config.threads:
        cv2.setNumThreads(config.threads)
    check_objects(config.objects)
    video = open_video(source, config.input, config.poses, recorded, config.detect)
    if config.input not in (InputConfig(), video.config):
        raise ReobjError(f"config.input is {config.input}, but the Video was opened with "
                         f"{video.config}: give these options to the Video only")  # fmt: skip
    with (
        Workspace(default_out(source) if out is None else out, overwrite) as workspace,
        opened_map(config.map) as room,
        contextlib.ExitStack() as opened,
    ):
        workspace.bind(video, overwrite)
        config = dataclasses.replace(
            config, input=video.config, map=config.map.absolute(), poses=config.poses.absolute()
        )
        log.info("input: %r", video)
        log.debug("options that differ from the defaults: %s", changed_options(config))
        viewer = open_viewer(VideoInfo.of(video), opened) if show else None
        yield Job(video, workspace, config, room, viewer)


def check_objects(config: ObjectsConfig) -> None:
    """Validate the options of the fit before the earlier stages take minutes."""
    config.size_priors()
    if config.up:
        parse_up(config.up)
    kinds = ("auto", *quadrics.SUPPORTS)
    if config.support not in kinds:
        raise ReobjError(f"--shape {config.support}: expected one of {', '.join(kinds)}")
    parse_known_size(config.known_size)


def default_out(source: Video | str | Path | int | None) -> Path:
    """Name the output folder of a source, in the working folder.

    >>> default_out("recordings/room.mp4").name
    'room_out'
    """
    if source is None:
        return Path("out")
    text = str(source.source if isinstance(source, Video) else source)
    name = re.sub(r"[^\w.-]+", "_", Path(without_secrets(text)).stem).strip("_.")
    return Path(f"{name}_out" if name else "out")


def last_config(out: str | Path) -> Config:
    """Read the options of the last run in an output folder; the defaults if it has none."""
    path = Path(out) / OutputFile.CONFIG
    return read_config(Config(), path) if path.is_file() else Config()


# ---- Detections, cameras, place in the map ----


def detect(
    job: Job, detections: DetectionInput, in_3d: bool, poses: Poses | None
) -> tuple[DetectionSource, Tracks]:
    """Open the detections; if cameras are estimated, detect in all frames of a recorded video.

    Args:
        poses: supplied cameras.
    Returns:
        the source, and the boxes of all frames (empty if they are detected frame by frame): the
        reconstruction leaves out moving objects, and supplied poses are checked with boxes.
    """
    opened = open_detections(job.video, job.config.detect, detections, *job.runtime, poses)
    source = keep_detections(opened, job.video, job.workspace)
    boxes = Tracks.empty()
    if in_3d and not job.video.is_live:
        with job.timed("detect", may_be_cached=source.recorded is None):
            source, boxes = detect_all(source, job.video, job.workspace, job.progress)
    log.info("detections: %d, of %d classes", len(boxes), len(np.unique(boxes.class_id)))
    job.check_known_size(source.class_names)
    return source, boxes


def given_tracks(job: Job, path: str | Path, before: Result | None) -> Result:
    """Build a result from identities in a file; they are never joined, split or renumbered.

    Args:
        before: last result of the folder.
    """
    known = (None, ()) if before is None else (before.tracks, before.class_names)
    tracks, class_names, messages = read_tracks(path, job.video, job.config.detect, *known)
    job.check_known_size(class_names)
    video = VideoInfo.of(job.video)
    return Result(tracks, class_names, video, identities_given=True, warnings=messages)


def check_cameras(job: Job, supplied: Supplied, tracks: Tracks) -> Poses:
    """Check supplied poses against images or tracks, and add points."""
    with job.timed("poses"):
        return checked_poses(
            supplied, tracks, job.video, job.config.poses, job.workspace, job.progress
        )


def reconstruct(job: Job, boxes: Tracks, class_names: Sequence[str]) -> tuple[Poses, list[Path]]:
    """Reconstruct the cameras from the images without features on moving objects.

    Returns:
        poses, and the folders of the COLMAP models.
    """
    with job.timed("poses", may_be_cached=True):
        moving = among([*class_names, ""], job.config.objects.moving_classes)[boxes.class_id]
        rows = boxes[moving & (boxes.score >= job.config.tracker.high_score)]
        return reconstruct_cached(job.video, job.config.poses, job.workspace, rows, job.progress)


def place(
    job: Job, poses: Poses | None, models: list[Path]
) -> tuple[Poses | None, list[Path], Placed | None]:
    """Place the cameras, and copies of their COLMAP models, in the world of the map, if any."""
    if poses is not None:
        log.info("%s", poses.cameras_text)
    room = job.room
    if room is None or poses is None or not poses.known.any():
        return poses, models, None
    with job.timed("map"):
        size_px = job.config.poses.size_px
        placed = place_recording(room, poses, job.video, size_px, job.progress)
        folder = job.workspace.path("placed", job.video.fingerprint).with_suffix(".sparse")
        models = move_models(models, poses, placed, lambda k: component_path(folder, k))
    return placed.poses, models, placed


def save_last(
    job: Job,
    result: Result,
    poses: Poses | None,
    models: list[Path] | None,
    placed: Placed | None = None,
) -> Result:
    """Keep tracks and cameras for `refit`; returns the result with its cameras.

    The boxes in 3D are left out if the cameras were moved into the world of a map.
    """
    warnings = list(result.warnings)
    moved = placed is not None and placed.placement is not None and not placed.placement.refused
    if moved and result.boxes_3d is not None:
        result = dataclasses.replace(result, boxes_3d=None)
        warnings += ["the 3D boxes are used as 2D boxes only: the map has another world"]
    result = dataclasses.replace(result, poses=poses, warnings=warnings)
    warnings += job.workspace.save_last(result, poses, models)
    return dataclasses.replace(result, warnings=warnings)


# ---- Objects, map, files ----


def finish(
    job: Job, result: Result, placed: Placed | None = None, links: Links | None = None
) -> Result:
    """Link tracklets, fit one shape per object, and write the map and the output folder.

    Args:
        placed: the recording in the map; None: not placed, as in a refit. links: of the last
            result of the folder.
    """
    with job.timed("objects"):
        result = _fit_objects(job, result, links)
    if job.room is not None:
        with job.timed("map"):
            path = job.workspace.out / OutputFile.CHANGES
            before = read_changes(path) if placed is None and path.is_file() else None
            embedder = f"{job.config.embed.model} {job.config.embed.head}"
            result = finish_map(job.room, result, job.video, embedder, placed, job.progress, before)
    warnings = [*result.warnings, *_warnings(job.config, result)]
    result = dataclasses.replace(result, warnings=warnings, out=job.workspace.out)
    with job.timed("write"):
        result = _write(job, result)
    for warning in result.warnings:
        log_message(warning)
    result = dataclasses.replace(result, seconds=job.seconds, step_seconds=job.step_seconds)
    if job.viewer is not None:
        shown = result.without_doubtful()
        job.viewer.show(shown, Path("rerun"), images=not job.viewer.followed)
    return result


def _fit_objects(job: Job, result: Result, links: Links | None) -> Result:
    """Link and fit; gaps of tracks are filled with the default solver's shapes."""
    config = job.config
    edits = result.edits or kept_edits(job.workspace.out)
    with job.progress("objects"):
        views, warnings = _views_once(result.poses, job.video)
        result = dataclasses.replace(result, edits=edits, warnings=[*result.warnings, *warnings])
        once = dataclasses.replace(result, poses=views)
        fitted = link_and_fit(once, config.objects, links)
        gap = 0 if result.identities_given else config.output.fill_gaps
        tracks = fill(fitted, job.video.size, gap)
        detected = np.flatnonzero(tracks.detection_index >= 0)  # rows that were not filled in
        return dataclasses.replace(
            solve_again(fitted, config.objects),
            poses=result.poses,
            tracks=tracks,
            embedding_row=detected[fitted.embedding_row],
        )


def _views_once(poses: Poses | None, video: Video) -> tuple[Poses | None, list[str]]:
    """Return the poses without those of copied images, and a warning about these."""
    if poses is None:
        return None, []
    views = without_copies(poses, video.copies)
    names = [video.name(frame) for frame in views.frame[poses.known & ~views.known].tolist()]
    text = f"{len(names)} images are copies of others, of which each is one view: "
    return views, [text + shortened(names)] if names else []


def _warnings(config: Config, result: Result) -> list[str]:
    """Collect warnings about cameras, objects and options."""
    poses = result.poses
    tracker = config.tracker
    fit = config.objects
    located = [o.class_name for o in result.located]
    return [
        *([] if poses is None else [*poses.messages, *components_message(poses)]),
        *implausible(result, tracker.high_score, fit.moving_classes, tracker.new_score),
        *scores_far_off(result),
        *unused_sizes(fit.known_size, fit.size_priors(), located),
        *priors_used(fit.priors, fit.prior, located),
    ]


def _write(job: Job, result: Result) -> Result:
    """Write all files; pictures last, so that a failure of theirs loses no results.

    Returns:
        the result, with a warning for each picture that could not be made.
    """
    out = job.workspace.out
    output = job.config.output
    models = job.workspace.last_models()

    def write_more(folder: Path) -> None:
        write_config(job.config, folder / OutputFile.CONFIG)
        if models is not None:
            copy_models(models, folder)
            write_supplied_model(result.poses, job.video, folder)

    stale = (OutputFile.MODEL,) if models is not None or result.poses is None else ()
    result.save(out, output.doubtful, write_more, stale)
    failures = write_pictures(
        result,
        out,
        job.video,
        output.overlay,
        output.scene,
        output.doubtful,
        job.progress("write", job.video.expected),
        command=f"{program(absolute=True)} objects {shlex.quote(str(out.absolute()))}",
        cloud=output.cloud,
        depth=job.config.poses.depth,
    )
    if failures:
        result = dataclasses.replace(result, warnings=[*result.warnings, *failures])
        write_objects(result, out / OutputFile.OBJECTS)
    return result


def program(absolute: bool = False) -> str:
    """Return the command that this program was started with; absolute: from any folder."""
    path = Path(sys.argv[0])
    if path.name == "reobj_track.py":
        return f"python {shlex.quote(str(path.absolute() if absolute else path))}"
    return "reobj-track" if path.stem == "reobj-track" else "python -m reobj_track"
