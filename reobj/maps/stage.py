"""The map in a run: opened and locked, cameras placed in it, objects numbered, the file updated."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import quadrics
from reobj.cameras import Poses, import_pycolmap
from reobj.files import Progress
from reobj.maps.contents import earlier_sessions, with_edits
from reobj.maps.fusion import scale_of
from reobj.maps.object_points import object_views, triangulated
from reobj.maps.placement import (
    COMPARED,
    DIRECTIONS_ONLY,
    MORE,
    ImageFeatures,
    Placement,
    image_features,
    keyframe_rows,
    place,
    points_with_descriptors,
)
from reobj.maps.room_map import RoomMap, Session, map_lock
from reobj.maps.update import Recording, add_recording
from reobj.results.changes import Changes
from reobj.results.entries import recording_name
from reobj.results.result import Result
from reobj.sources.video import Video, content_fingerprint, files_of
from reobj.types import NOTE_START, ReobjError, option
from reobj.viewer.scene import best_pictures


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Map of the room, in which objects keep their numbers over several recordings."""

    path: str = option(
        "",
        "map of the room: cameras and objects get its world and its numbers, changes are reported, "
        "and the file is updated; it is made if it does not exist",
        "--map",
    )
    frozen: bool = option(False, "compare with --map only: the file is not changed", "--map-frozen")
    pictures: bool = option(
        False,
        "keep a small picture of each object and recording in the map, for before and after in "
        "scene.html",
    )

    def absolute(self) -> MapConfig:
        """Return the options with the absolute path, to be found from any folder."""
        return dataclasses.replace(self, path=str(Path(self.path).absolute()) if self.path else "")


@dataclass(frozen=True, slots=True)
class OpenMap:
    """The map of a run.

    Attributes:
        path: of the file. room: its content, or an empty map. frozen: the file is not changed.
        pictures: keep a picture of each object.
    """

    path: Path
    room: RoomMap
    frozen: bool
    pictures: bool = False


@contextlib.contextmanager
def opened_map(config: MapConfig, must_exist: bool = False) -> Iterator[OpenMap | None]:
    """Open the map of a run, and hold its lock unless it is frozen; None without a map.

    Args:
        must_exist: also if it is not frozen; otherwise a missing map begins empty.
    Raises:
        ReobjError: damaged, another kind of file, used by another run, or missing.
    """
    if not config.path:
        if config.frozen:
            raise ReobjError("--map-frozen without --map: give the map to compare with")
        yield None
        return
    path = Path(config.path)
    if must_exist and not path.exists():
        raise ReobjError(
            f"{path}: this map of the last run is missing; restore it, or name another one by "
            "--set map.path=FILE (empty: none)"
        )
    if config.frozen:
        yield OpenMap(path, RoomMap.load(path), True, config.pictures)
        return
    with map_lock(path):
        room = RoomMap.load(path) if path.exists() else RoomMap()
        yield OpenMap(path, room, False, config.pictures)


@dataclass(frozen=True, slots=True)
class Placed:
    """Cameras of a recording in the world of its map.

    Attributes:
        poses: of the map's world, if the recording was placed (`placement.refused` is empty).
        features: of some of its images. placement: None for the first recording of a map, and for
            one without images.
        scale: metres per unit of the map, by supplied metric poses; None: not measured.
    """

    poses: Poses
    features: tuple[ImageFeatures, ...]
    placement: Placement | None
    scale: quadrics.Scale | None = None


def place_recording(
    opened: OpenMap,
    poses: Poses,
    video: Video,
    size_px: int = 640,
    progress: Callable[[str, int], Progress] = Progress,
) -> Placed:
    """Place the cameras of a recording in a map; the first recording defines the map's world.

    Args:
        size_px: longer side of the images for features.
    """
    room = opened.room
    if not video.has_images or poses.direction_sigma.all():
        return Placed(poses, (), None)
    keyframes = keyframe_rows(poses)
    known = np.flatnonzero(poses.known)
    # the mapped part of the room may be in view for a short time
    dense = np.union1d(known[:: -(-len(known) // MORE)], keyframes)
    features = list[ImageFeatures]()
    for rows, most in ((keyframes, COMPARED), (dense, len(dense))):
        missing = np.setdiff1d(rows, [image.row for image in features])
        with progress("map features", 0) as line:
            features += image_features(poses, video, missing, size_px, line)
        features.sort(key=lambda image: image.row)
        if not room.sessions:
            return Placed(dataclasses.replace(poses, map_id=room.map_id), tuple(features), None)
        with progress("map", 0) as line:
            placement = place(poses, features, room.points, size_px, most, line.step)
        if not placement.refused:
            break
    if placement.refused:
        return Placed(poses, tuple(features), placement)
    scale_of_map = scale_of(room)
    scale = None
    if poses.metric and not room.metric:
        best = placement.best
        sigma = float(np.sqrt(best.similarity.cov[6, 6]))
        scale_of_map = scale = quadrics.Scale(1 / best.similarity.scale, sigma, "poses")
    moved = dataclasses.replace(
        placement.poses,
        metric=room.metric and placement.poses.part_count == 1,
        scale=None if scale_of_map.source == "none" else scale_of_map[:2],
        up_in_world=room.up,
        map_id=room.map_id,
    )
    return Placed(moved, tuple(features), placement, scale)


def move_models(
    models: Sequence[Path], poses: Poses, placed: Placed, folder: Callable[[int], Path]
) -> list[Path]:
    """Move the COLMAP models of placed components into the world of the map.

    The models of further components that were placed too are left out: a model is one component.

    Args:
        models: one a component of `poses`, before they were placed. folder: for the copy of a
            component's model, by its number.
    Returns:
        the folders, one a component of `placed.poses`.
    """
    placement = placed.placement
    if placement is None or placement.refused or not models:
        return list(models)
    refused = [c.refused for c in placement.components]
    others = [model for model, reason in zip(models, refused, strict=True) if reason]
    mine = [k for k, model in enumerate(models) if not refused[k] and model.is_dir()]
    if not mine:
        return others
    largest = max(mine, key=lambda k: int((poses.part == k).sum()))
    similarity = placement.components[largest].similarity
    target = folder(largest)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    pc = import_pycolmap()
    reconstruction = pc.Reconstruction(str(models[largest]))
    rotation = pc.Rotation3d(similarity.rotation)
    reconstruction.transform(pc.Sim3d(similarity.scale, rotation, similarity.translation))
    reconstruction.write(str(target))
    return [target, *others]


def finish_map(
    opened: OpenMap,
    result: Result,
    video: Video,
    embedder: str,
    placed: Placed | None,
    progress: Callable[[str, int], Progress] = Progress,
    before: Changes | None = None,
) -> Result:
    """Number the objects of a recording, write the map, and return the result with `changes`.

    A map that cannot be written is a warning, as results are written after it.

    Args:
        placed: None: the cameras are those of the last run, with the points that the map has.
        before: of the last run if `placed` is None; a frozen map does not have its alignment.
    """
    room = opened.room
    placement = None if placed is None else placed.placement
    if refused := _refusal(opened, result, video, placed):
        kept = "the map is unchanged, the objects lack its numbers"
        text = f"{refused}; {kept}" if room.sessions else f"not made: {refused}"
        tried = 0 if placement is None else sum(c.tried for c in placement.components)
        return dataclasses.replace(
            result,
            changes=Changes(str(opened.path), session_name(video), refused, 0, tried),
            warnings=[*result.warnings, f"map {opened.path}: {text}"],
        )
    assert result.poses is not None
    if result.edits is not None:
        room = with_edits(room, result.edits)
    recording = _recording(opened, result, video, embedder, placed, before)
    old = room.session_of(recording.session.fingerprint)
    if placed is not None:
        objects = [o for o in result.located if o.part == 0]
        with progress("object features", 0) as line:
            views = object_views(objects, result.poses, result.tracks, video, line)
        recording = dataclasses.replace(recording, views=views)
        if not opened.frozen:
            points = triangulated(objects, views, result.poses)
            recording = dataclasses.replace(recording, object_points=points)
    if opened.pictures and not opened.frozen:
        pictures = None
        if video.has_images and not video.is_live:
            pictures = best_pictures(result, video, progress("map pictures", video.expected))
        recording = dataclasses.replace(recording, pictures=pictures)
    new_room, numbered = add_recording(room, result, recording)
    warnings = list(numbered.warnings)
    if old is not None and placed is not None:  # perhaps a copy under another name
        replaced = "" if opened.frozen else ", which is replaced"
        text = f"it has this recording as session {old.number} ({old.name}){replaced}"
        warnings.append(f"{NOTE_START}map {opened.path}: {text}")
    if not opened.frozen:
        try:
            new_room.save(opened.path)
        except ReobjError as error:
            text = f"map {error}; the results are complete, but the map lacks this recording"
            warnings.append(text)
    earlier = earlier_sessions(new_room, opened.path, recording.session.fingerprint)
    return dataclasses.replace(numbered, earlier=earlier, warnings=warnings)


def _refusal(opened: OpenMap, result: Result, video: Video, placed: Placed | None) -> str:
    """Explain why a recording is not in the world of the map; "" if it is."""
    if placed is not None and placed.placement is not None and placed.placement.refused:
        return (
            f"this is not the room of {opened.path.name}, or nothing in view matches it: "
            f"{placed.placement.refused}"
        )
    if result.poses is None or not result.poses.known.any():
        return "the recording has no camera poses"
    if result.poses.direction_sigma.all():
        return f"{DIRECTIONS_ONLY}: film again with steps to the side, the objects in view"
    if not video.has_images and placed is not None:
        return "a recording without images cannot be placed in a map"
    if result.poses.map_id != opened.room.map_id:
        return "its cameras were not placed in this map; run the video again with --map"
    return ""


def session_name(video: Video) -> str:
    """Name a recording as its viewer does, and by the part of it that is read."""
    name = recording_name(str(video.source))
    part = video.config
    return f"{name} {part.start}-{part.stop or ''}" if part.start or part.stop else name


def session_key(video: Video) -> str:
    """Identify a recording: the content of its files, and the part of it that is read."""
    files = video.files or files_of(video.source)
    content = content_fingerprint(files) or video.fingerprint
    return f"{content} {video.config.start}-{video.config.stop}"


def _recording(
    opened: OpenMap,
    result: Result,
    video: Video,
    embedder: str,
    placed: Placed | None,
    before: Changes | None,
) -> Recording:
    """Collect the facts of a recording; a refitted one has its facts in the map.

    Args:
        before: of the last run; of the covariance of the placement it has that of the shift.
    """
    room = opened.room
    key = session_key(video)
    old = room.session_of(key)
    session = Session(1, session_name(video), "", key, embedder)
    changed = partial(dataclasses.replace, session)
    placed_by = "" if not room.sessions or old is room.sessions[0] else "points"
    if placed is None:
        if old is not None:
            session = dataclasses.replace(old, name=session.name, embedder=embedder)
        elif before is not None:
            sigma = (before.sigma_m or 0.0) / scale_of(room).value  # of a vector
            session = changed(
                alignment_cov=np.diag([0, 0, 0, 1, 1, 1, 0]) * sigma**2 / 3,
                localised_frames=before.localised_frames, tried_frames=before.tried_frames,
            )  # fmt: skip
            placed_by = before.placed_by
        return Recording(opened.path, session, placed_by)
    if placed.placement is None:
        count = len(placed.features)
        session = changed(localised_frames=count, tried_frames=count)
        scale = quadrics.Scale(1.0, 0.0, "poses") if placed.poses.metric else result.world.scale
    else:
        best = placed.placement.best
        session = changed(
            alignment_cov=best.similarity.cov, localised_frames=len(best.images),
            tried_frames=best.tried,
        )  # fmt: skip
        scale = placed.scale or (None if old is None else old.scale)
    if scale is not None:
        sigma = float(scale.rel_sigma) if np.isfinite(scale.rel_sigma) else 0.0
        session = dataclasses.replace(
            session, metres_per_unit=float(scale.value), scale_rel_sigma=sigma,
            scale_source=scale.source,
        )  # fmt: skip
    poses = placed.poses.of_part(0)
    row_of = {int(row): k for k, row in enumerate(np.flatnonzero(placed.poses.part == 0))}
    features = [
        dataclasses.replace(f, row=row_of[f.row]) for f in placed.features if f.row in row_of
    ]
    points = points_with_descriptors(poses, features)
    return Recording(opened.path, session, placed_by, points)
