"""The map in a run: opened and locked, cameras placed in it, objects numbered, the file updated."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import quadrics
from reobj.cameras import Camera, Poses, import_pycolmap
from reobj.files import Progress
from reobj.maps.corrections import with_edits
from reobj.maps.earlier import earlier_sessions
from reobj.maps.fusion import scale_of
from reobj.maps.object_placement import place_by_objects
from reobj.maps.object_points import object_views, triangulated
from reobj.maps.placement import (
    ImageFeatures,
    Placement,
    PlacementOptions,
    compared_rows,
    image_features,
    keyframe_rows,
    place,
    points_with_descriptors,
)
from reobj.maps.room_map import RoomMap, Session, map_lock
from reobj.maps.single_frames import locate_frames, locate_rest
from reobj.maps.update import Recording, add_recording
from reobj.results.changes import Changes
from reobj.results.entries import recording_name
from reobj.results.result import Result
from reobj.results.scene import best_pictures
from reobj.sources.video import Video, content_fingerprint, files_of
from reobj.types import NOTE_START, ReobjError, option


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

    @property
    def unmatched(self) -> bool:
        """True if the images of the recording match too few points of the map."""
        if self.placement is None or not self.poses.known.any():
            return False
        return self.placement.unmatched


def place_recording(
    opened: OpenMap,
    poses: Poses,
    video: Video,
    options: PlacementOptions | None = None,
    progress: Callable[[str, int], Progress] = Progress,
    camera: Camera | None = None,
) -> Placed:
    """Place the cameras of a recording in a map; the first recording defines the map's world.

    The frames of a recording without poses are located in the map one by one.

    Args:
        camera: intrinsics that the user gave; None: unknown.
    """
    options = options or PlacementOptions()
    if not video.has_images:
        return Placed(poses, (), None)
    room = opened.room
    rows = keyframe_rows(poses, options)
    if opened.frozen and poses.known.any():  # a map that learns needs features of all of them
        rows = compared_rows(poses, rows, options)
    line = progress("map features", 0)
    features = tuple(image_features(poses, video, rows, options, line))
    if not room.sessions:
        return Placed(dataclasses.replace(poses, map_id=room.map_id), features, None)
    points = room.points
    with progress("map", 0) as line:
        if poses.known.any():
            placement = place(poses, features, points, options, line.step)
        else:
            placement = locate_frames(poses, features, points, camera, options, report=line.step)
    if placement.refused and poses.known.any():
        features = _denser(features, poses, video, options, progress)
        every = dataclasses.replace(options, images=len(features))
        with progress("map", 0) as line:
            placement = place(poses, features, points, every, line.step)
    if not placement.refused and placement.poses.source == "map":
        placement = _all_frames(placement, video, progress)
    return _placed(room, poses, features, placement)


def _placed(
    room: RoomMap, poses: Poses, features: tuple[ImageFeatures, ...], placement: Placement
) -> Placed:
    """Give the cameras of a recording that was placed the units and gravity of the map.

    Args:
        poses: before. placement: refused ones leave them as they are.
    """
    if placement.refused:
        return Placed(poses, features, placement)
    known = scale_of(room)
    scale = None
    if poses.metric and not room.metric:
        best = placement.best
        assert best.similarity is not None
        sigma = float(np.sqrt(best.similarity.cov[6, 6]))
        scale = quadrics.Scale(1 / best.similarity.scale, sigma, "poses")
        known = scale
    moved = dataclasses.replace(
        placement.poses,
        metric=room.metric and placement.poses.part_count == 1,
        scale=None if known.source == "none" else (known.value, known.rel_sigma),
        up_in_world=room.up,
        map_id=room.map_id,
    )
    return Placed(moved, features, placement, scale)


def place_objects(room: RoomMap, result: Result, embedder: str, placed: Placed) -> Placed:
    """Place a recording by its objects, as too few points of its images match.

    Args:
        result: with the objects of the recording, in its own world. embedder: of the recording.
        placed: refused, by points.
    """
    assert placed.placement is not None
    placement = place_by_objects(room, result, embedder, placed.placement)
    return _placed(room, placed.poses, placed.features, placement)


def _denser(
    features: Sequence[ImageFeatures],
    poses: Poses,
    video: Video,
    options: PlacementOptions,
    progress: Callable[[str, int], Progress],
    most: int = 200,
) -> tuple[ImageFeatures, ...]:
    """Add features of frames between: the mapped part of the room may be in view for a short time.

    Args:
        most: images, spread over the frames with a pose; more find shorter times and take longer.
    """
    rows = np.flatnonzero(poses.known)
    rows = np.union1d(rows[:: -(-len(rows) // most)], keyframe_rows(poses, options))
    rows = np.setdiff1d(rows, [image.row for image in features])
    added = image_features(poses, video, rows, options, progress("map features", 0))
    return tuple(sorted([*features, *added], key=lambda image: image.row))


def _all_frames(
    placement: Placement, video: Video, progress: Callable[[str, int], Progress]
) -> Placement:
    """Locate the frames between the images that were located one by one; say how many there are."""
    with progress("pnp", len(placement.poses.frame)) as line:
        poses = locate_rest(placement, video, line)
    (component,) = placement.components
    message = (
        "the recording alone could not be reconstructed: "
        f"{len(component.images)} of {component.tried} images were located in the map one by one"
    )
    between = int(poses.known.sum()) - len(component.images)
    if between:
        message += f", and {between} frames between them"
    return dataclasses.replace(placement, poses=dataclasses.replace(poses, messages=(message,)))


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
    pc = import_pycolmap()
    found = list[Path]()
    others = list[Path]()
    most = 0
    for k, model in enumerate(models):
        similarity = placement.components[k].similarity
        if similarity is None:
            others.append(model)
            continue
        count = int((poses.part == k).sum())
        if not model.is_dir() or count <= most:
            continue
        most = count
        target = folder(k)
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        reconstruction = pc.Reconstruction(str(model))
        rotation = pc.Rotation3d(similarity.rotation)
        reconstruction.transform(pc.Sim3d(similarity.scale, rotation, similarity.translation))
        reconstruction.write(str(target))
        found = [target]
    return [*found, *others]


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
    name = session_name(video)
    if refused := _refusal(opened, result.poses, video, placed):
        text = f"map {opened.path}: {refused}; the map is unchanged, the objects lack its numbers"
        if not room.sessions:
            text = f"map {opened.path}: not made: {refused}"
        tried = 0
        if placed is not None and placed.placement is not None:
            tried = sum(c.tried for c in placed.placement.components)
        return dataclasses.replace(
            result,
            changes=Changes(str(opened.path), name, refused=refused, tried_frames=tried),
            warnings=[*result.warnings, text],
        )
    if result.edits is not None:
        room = with_edits(room, result.edits)
    recording = _recording(opened, result, video, name, embedder, placed)
    recording = _as_placed_before(recording, before, room)
    if placed is not None and video.has_images:
        recording = _with_object_points(recording, result, video, progress, opened.frozen)
    if opened.pictures and not opened.frozen:
        pictures = None
        if video.has_images and not video.is_live:
            pictures = best_pictures(result, video, progress("map pictures", video.expected))
        recording = dataclasses.replace(recording, pictures=pictures)
    new_room, numbered = add_recording(room, result, recording)
    earlier = earlier_sessions(new_room, opened.path, recording.fingerprint)
    numbered = dataclasses.replace(numbered, earlier=earlier)
    warnings = [*numbered.warnings, *_notes_of_known(opened, recording, placed)]
    numbered = dataclasses.replace(numbered, warnings=warnings)
    if opened.frozen:
        return numbered
    try:
        new_room.save(opened.path)
    except ReobjError as error:
        text = f"map {error}; the results are complete, but the map lacks this recording"
        return dataclasses.replace(numbered, warnings=[*numbered.warnings, text])
    return numbered


def _notes_of_known(opened: OpenMap, recording: Recording, placed: Placed | None) -> list[str]:
    """Say that the map has this recording, perhaps as a copy under another name; [] of a refit."""
    old = opened.room.session_of(recording.fingerprint)
    if old is None or placed is None:
        return []
    replaced = "" if opened.frozen else ", which is replaced"
    text = f"it has this recording as session {old.number} ({old.name}){replaced}"
    return [f"{NOTE_START}map {opened.path}: {text}"]


def _with_object_points(
    recording: Recording,
    result: Result,
    video: Video,
    progress: Callable[[str, int], Progress],
    frozen: bool,
) -> Recording:
    """Add features in the boxes of objects, and the points that they give to a map that learns."""
    assert result.poses is not None
    objects = [o for o in result.located if o.part == 0]
    with progress("object features", 0) as line:
        views = object_views(objects, result.poses, result.tracks, video, line)
    recording = dataclasses.replace(recording, views=tuple(views))
    if frozen:
        return recording
    points = triangulated(objects, views, result.poses)
    return dataclasses.replace(recording, object_points=points)


def _refusal(opened: OpenMap, poses: Poses | None, video: Video, placed: Placed | None) -> str:
    """Say why a recording is not in the world of the map; "" if it is."""
    if placed is not None and placed.placement is not None and placed.placement.refused:
        return (
            f"this is not the room of {opened.path.name}, or nothing in view matches it: "
            f"{placed.placement.refused}"
        )
    if poses is None or not poses.known.any():
        return "the recording has no camera poses"
    if not video.has_images and placed is not None:
        return "a recording without images cannot be placed in a map"
    if poses.map_id != opened.room.map_id:
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
    name: str,
    embedder: str,
    placed: Placed | None,
) -> Recording:
    """Collect the facts of a recording; those of a refitted one are in the map."""
    old = opened.room.session_of(session_key(video))
    none = quadrics.Scale(1.0, np.inf, "none")
    if placed is None:
        scale = none
        if old is not None:
            scale = quadrics.Scale(old.metres_per_unit, old.scale_rel_sigma, old.scale_source)
        return Recording(
            opened.path, name, session_key(video), embedder,
            np.zeros((7, 7)) if old is None else old.alignment_cov,
            0 if old is None else old.localised_frames, 0 if old is None else old.tried_frames,
            scale, None, placed_by=_placed_by(opened.room, old),
        )  # fmt: skip
    poses = placed.poses
    points = None  # of a recording located by the map's points: it has no others
    by_objects = placed.placement is not None and placed.placement.by == "objects"
    if poses.source != "map" and not by_objects:  # objects do not locate points well enough
        points = points_with_descriptors(poses.of_part(0), _of_first_component(placed), 0)
    if placed.placement is None:
        own = result.world.scale or none
        scale = quadrics.Scale(1.0, 0.0, "poses") if poses.metric else own
        count = len(placed.features)
        cov = np.zeros((7, 7))
        return Recording(
            opened.path, name, session_key(video), embedder, cov, count, count, scale, points
        )
    best = placed.placement.best
    assert best.similarity is not None
    made_the_map = old is not None and not _placed_by(opened.room, old)
    if old is not None and placed.scale is None:
        scale = quadrics.Scale(old.metres_per_unit, old.scale_rel_sigma, old.scale_source)
    else:
        scale = placed.scale or none
    return Recording(
        opened.path, name, session_key(video), embedder, best.similarity.cov,
        len(best.images), best.tried, scale, points,
        placed_by="" if made_the_map else placed.placement.by,
    )  # fmt: skip


def _as_placed_before(recording: Recording, before: Changes | None, room: RoomMap) -> Recording:
    """Return a recording that the map does not have, with the placement of its last run.

    Args:
        before: of the last run; of the covariance of the placement it has that of the shift. None:
            the recording was placed in this run.
    """
    if before is None or room.session_of(recording.fingerprint) is not None:
        return recording
    sigma = (before.sigma_m or 0.0) / scale_of(room).value  # of a vector
    return dataclasses.replace(
        recording,
        alignment_cov=np.diag([0, 0, 0, 1, 1, 1, 0]) * sigma**2 / 3,
        localised_frames=before.localised_frames,
        tried_frames=before.tried_frames,
        placed_by=before.placed_by,
        moved=before.moved,
    )


def _placed_by(room: RoomMap, session: Session | None) -> str:
    """Say by what a session of the map was placed; "": it made the map, or is not in it."""
    if session is None or session.number == min(s.number for s in room.sessions):
        return ""
    return "points" if session.localised_frames else "objects"


def _of_first_component(placed: Placed) -> list[ImageFeatures]:
    """Return the features of images of the first component, by their row in it."""
    rows = np.flatnonzero(placed.poses.part == 0)
    row_of = {int(row): k for k, row in enumerate(rows)}
    return [
        dataclasses.replace(image, row=row_of[image.row])
        for image in placed.features
        if image.row in row_of
    ]
