"""Recordings of one room on several days: objects, light, camera path and focal length change.

All sessions share one room frame: origin in the middle of the floor, z up, metres. An object has
the same number in all sessions; a number is never used for another object.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rendering.camera import camera_matrix, hand_shake, look_along, smooth
from rendering.changes import (
    ChangeOptions,
    Placements,
    Scene,
    Space,
    next_session,
    settled,
)
from rendering.config import Array, DetectorConfig, Image, RoomConfig
from rendering.flat import (
    RoomPlan,
    flat_models,
    model_windows,
    part_bounds,
    plan_room,
    room_surfaces,
    room_textures,
)
from rendering.ground_truth import ground_truth
from rendering.light import DEFAULT_LIGHTING, Lighting
from rendering.models import Model
from rendering.photograph import Frame
from rendering.raster import patch_windows, rasterize
from rendering.surfaces import Room, RoomObject, build_atlas
from rendering.writers import write_room


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """What is recorded."""

    sessions: int = 2
    foreign: int | None = None  # seed of another room with the same object models
    mirror: bool = False  # x -> -x, textures too
    light_only: bool = False  # objects stay
    zoom: float = 1.2  # focal length of every second session, relative
    seen_share: float = 0.2  # visible part of an object's silhouette from which it counts as seen
    seen_px: float = 8.0  # least side of its box, as in gt_mot.txt
    textured_grey: float = 14.0  # Studio.contrast: 3 to 13 for even colours, 30 to 50 for prints


@dataclass(frozen=True, slots=True)
class Session:
    """One recording."""

    room: Room
    config: RoomConfig  # seed: that of noise, hand shake and detector
    cameras: Array  # (F, 3, 4) cam_from_world
    lighting: Lighting


@dataclass(frozen=True, slots=True)
class Studio:
    """A room's plan and the looks of everything in it."""

    config: RoomConfig
    plan: RoomPlan
    models: dict[str, tuple[str, Model]]
    atlas: tuple[Image, ...]
    rects: dict[str, tuple[int, int, int, int]]
    windows: dict[str, list[list[float]]]
    numbers: dict[str, int]  # twin group by the key of the look

    def room(self, placements: Placements, lighting: Lighting) -> Room:
        """The furnished and lit room; objects in the order of their identities."""
        order = sorted(placements)
        plan = replace(self.plan, placements=tuple(placements[i] for i in order))
        looks = (self.rects, self.windows)
        made = room_surfaces(self.config, 0, plan, self.models, looks, self.numbers, lighting)
        objects = tuple(
            replace(truth, identity=identity)
            for truth, identity in zip(made.objects, order, strict=True)
        )
        return replace(made, objects=objects, atlas=self.atlas)

    def contrast(self) -> dict[str, float]:
        """By model: mean over its visible area of the standard deviation of grey levels."""
        found = {}
        grey = self.atlas[0].mean(2)
        for name, (key, model) in self.models.items():
            spread = []
            area = []
            for part, (x, y, w, h) in zip(model.parts, self.windows[key], strict=True):
                piece = grey[int(y) : int(y + h) + 1, int(x) : int(x + w) + 1]
                spread.append(piece.std())
                area.append(
                    np.linalg.norm(part.obj_from_patch[:, 0])
                    * np.linalg.norm(part.obj_from_patch[:, 1])
                )
            found[name] = float(np.average(spread, weights=area))
        return found


def make_studio(config: RoomConfig, foreign: int | None = None) -> Studio:
    """Plan and paint the room of a seed, or that of another seed with the objects of the first."""
    own = flat_models(config, 1)[0]
    models = {
        name: (
            name,
            replace(
                model,
                parts=tuple(
                    replace(p, texture=f"object/{p.texture.split('/', 1)[1]}") for p in model.parts
                ),
            ),
        )
        for name, (_, model) in own.items()
    }
    room_config = config if foreign is None else replace(config, seed=foreign)
    plan = plan_room(room_config, 0, 1, {name: model for name, (_, model) in models.items()})
    images = room_textures(room_config, 0, plan.size_m)
    textures = {f"0/{name}": image for name, image in images.items()}
    if foreign is not None:
        images = room_textures(config, 0, (1.0, 1.0, 1.0))
    used = {p.texture for _, model in models.values() for p in model.parts}
    textures |= {name: images[name.split("/", 1)[1]] for name in sorted(used)}
    atlas, rects = build_atlas(textures)
    numbers = {name: index for index, name in enumerate(models)}
    windows = {
        name: model_windows(config, models[name][1], rects, number)
        for name, number in numbers.items()
    }
    return Studio(room_config, plan, models, atlas, rects, windows, numbers)


def mirrored(room: Room) -> Room:
    """The room with x -> -x, including its textures and light."""
    flip = np.array([-1.0, 1.0, 1.0])
    surfaces = replace(
        room.surfaces,
        world_from_patch=room.surfaces.world_from_patch * flip[:, None],
        corners_in_world=room.surfaces.corners_in_world * flip,
    )
    objects = tuple(
        replace(
            truth,
            center_in_world=truth.center_in_world * flip,
            yaw_rad=-truth.yaw_rad,
            world_from_obj=truth.world_from_obj * np.outer(flip, flip),
        )
        for truth in room.objects
    )
    outlines = tuple(outline * flip for outline in room.outline_in_world)
    return replace(room, surfaces=surfaces, objects=objects, outline_in_world=outlines)


def session_lighting(seed: int, number: int) -> Lighting:
    """Lamps, daylight and its direction of a session (from 0); the first has the defaults."""
    if number == 0:
        return DEFAULT_LIGHTING
    rng = np.random.default_rng([seed, 31, number])
    warm = np.array([1.0, 0.0, -1.0]) * rng.uniform(-0.18, 0.18)  # BGR: bluer or redder
    day = rng.uniform(0.4, 2.2) * (1 + warm)
    lamp = np.array(DEFAULT_LIGHTING.lamp) * rng.uniform(0.6, 1.1) * (1 + 0.5 * warm[::-1])
    window = np.array(DEFAULT_LIGHTING.window) * day
    gains = np.where(rng.random(2) < 0.35, 0.15, rng.uniform(0.7, 1.2, 2))
    return Lighting(
        lamp=(float(lamp[0]), float(lamp[1]), float(lamp[2])),
        window=(float(window[0]), float(window[1]), float(window[2])),
        panel_gains=(float(gains[0]), float(gains[1])),
        ambient=float(rng.uniform(0.7, 1.2)),
        window_turn_rad=float(rng.choice([-1, 1]) * rng.uniform(0.3, 0.9)),
        window_focus=float(rng.uniform(1.0, 4.0)),
    )


def exposed(room: Room, mean_light: float, rng: np.random.Generator) -> Room:
    """The room photographed with another exposure and white balance.

    Args:
        mean_light: of the first session: the camera's automatic exposure aims at it.
    """
    gain = mean_light / float(room.light.mean()) * rng.uniform(0.8, 1.25)
    balance = gain * rng.uniform(0.94, 1.06, 3)
    return replace(room, light=(room.light * balance).astype(np.float32))


def box_clearance_m(room: Room, fixed: Array, points: Array) -> float:
    """Least distance in m of points (P, 3) to boxes of objects and fixed parts (B, 2, 3)."""
    least = np.inf
    for truth in room.objects:
        local = (points - truth.center_in_world) @ truth.world_from_obj
        outside = np.maximum(np.abs(local) - truth.size_m / 2, 0)
        least = min(least, float(np.linalg.norm(outside, axis=1).min()))
    for low, high in fixed:
        outside = np.maximum(np.maximum(low - points, points - high), 0)
        least = min(least, float(np.linalg.norm(outside, axis=1).min()))
    return least


def session_path(
    room: Room, fixed: Array, config: RoomConfig, whole: bool, clearance_m: float = 0.3
) -> Array:
    """Once round the room, most views across it: cam_from_world (F, 3, 4).

    The path starts anywhere, in either direction, and rises and falls. The first session sees all
    sides; later ones leave out a part of the round and look aside for a third of the way.
    Args:
        fixed: (B, 2, 3) boxes of fixed furniture, m. whole: a full round.
    Raises: ValueError if no path keeps clear of all furniture.
    """
    half = np.array(room.size_m[:2]) / 2
    for attempt in range(200):
        rng = np.random.default_rng([config.seed, 32, attempt])
        count = 10
        start = rng.uniform(0, 2 * np.pi)
        sweep = np.radians(380 if whole else rng.uniform(260, 340)) * rng.choice([-1, 1])
        angle = start + np.linspace(0, 1, count) * sweep
        reach = rng.uniform(0.42, 0.56) + rng.normal(0, 0.05, count)  # of the half room
        spots = reach[:, None] * half * np.stack([np.cos(angle), np.sin(angle)], 1)  # (K, 2)
        heights = config.eye_m + rng.uniform(-0.12, 0.12, count)
        aims = -spots * rng.uniform(0.3, 0.8, (count, 1)) + rng.normal(0, 0.3, (count, 2))
        away = aims - spots
        yaw = np.arctan2(away[:, 1], away[:, 0])
        if not whole:
            first = int(rng.integers(count - 3))
            yaw[first : first + 3] += rng.choice([-1, 1]) * np.radians(rng.uniform(35, 60))
        drop = rng.uniform(0.4, 0.9, count) - heights
        pitch = np.arctan2(drop, np.linalg.norm(away, axis=1))
        keys = np.column_stack([spots, heights, np.unwrap(yaw), pitch])  # (K, 5)
        at = np.linspace(0, count - 1, config.frames)
        track = np.column_stack([np.interp(at, np.arange(count), key) for key in keys.T])
        if config.frames > 20:
            track = smooth(track, 0.035 * config.frames)
        shake = hand_shake(rng, np.arange(config.frames) / config.fps)
        centers = track[:, :3] + config.shake_m * shake[:, :3]
        if box_clearance_m(room, fixed, centers) < clearance_m:
            continue
        angles = np.radians(config.shake_deg) * shake[:, 3:] * [1, 1, 1.6]
        return look_along(
            centers, track[:, 3] + angles[:, 0], track[:, 4] + angles[:, 1], angles[:, 2]
        )
    raise ValueError(f"seed {config.seed}: no camera path keeps clear of the furniture")


def plan_sessions(studio: Studio, options: SessionOptions, seed: int) -> list[Placements]:
    """Where every object stands in each session, by identity."""
    contrast = studio.contrast()
    scene = Scene(
        studio.plan.size_m,
        studio.plan.fixed,
        {name: model for name, (_, model) in studio.models.items()},
        frozenset(name for name, value in contrast.items() if value >= options.textured_grey),
    )
    space = Space(scene, ChangeOptions())
    first = dict(enumerate(settled(space, studio.plan.placements), start=1))
    models = {identity: placement.model for identity, placement in first.items()}
    history = [first]
    rng = np.random.default_rng([seed, 30])
    for _ in range(1, options.sessions):
        last = history[-1]
        history.append(
            dict(last) if options.light_only else next_session(rng, space, history, models)
        )
    return history


def make_sessions(config: RoomConfig, options: SessionOptions) -> tuple[Studio, list[Session]]:
    """Build the room of every session, with its light, camera and path."""
    studio = make_studio(config, options.foreign)
    seed = studio.config.seed
    fixed = np.array([part_bounds(part) for part in studio.plan.fixed]).reshape(-1, 2, 3)
    if options.mirror:
        fixed = np.stack([fixed[:, 0] * [-1, 1, 1], fixed[:, 1] * [-1, 1, 1]], 1)
        fixed = np.sort(fixed, axis=1)
    sessions: list[Session] = []
    for number, placements in enumerate(plan_sessions(studio, options, seed)):
        rng = np.random.default_rng([seed, 33, number])
        lighting = session_lighting(seed, number)
        room = studio.room(placements, lighting)
        if number:
            room = exposed(room, float(sessions[0].room.light.mean()), rng)
        if options.mirror:
            room = mirrored(room)
        focal = options.zoom if number % 2 else 1.0
        half = np.radians(config.hfov_deg) / 2
        own = replace(
            config,
            seed=1000 * seed + number + 1,
            hfov_deg=float(np.degrees(2 * np.arctan(np.tan(half) / focal))),
            eye_m=config.eye_m if number == 0 else float(rng.uniform(1.35, 1.7)),
        )
        cameras = session_path(room, fixed, own, whole=number == 0)
        sessions.append(Session(room, own, cameras, lighting))
    return studio, sessions


def same_pose(first: RoomObject, second: RoomObject) -> bool:
    """Is an object where it was, to 0.1 mm and 1e-4 rad?"""
    shift = np.abs(first.center_in_world - second.center_in_world).max()
    return bool(shift < 1e-4 and abs(turn_of(first, second)) < 1e-4)


def turn_of(first: RoomObject, second: RoomObject) -> float:
    """Turn about z in rad, -pi to pi."""
    return float((second.yaw_rad - first.yaw_rad + np.pi) % (2 * np.pi) - np.pi)


def by_identity(room: Room) -> dict[int, RoomObject]:
    """Objects of a room by their number."""
    return {truth.identity: truth for truth in room.objects}


def only(room: Room, index: int) -> Room:
    """A room that holds one of its objects and nothing else."""
    keep = room.surfaces.owner == index
    part = {name: getattr(room.surfaces, name)[keep] for name in room.surfaces.__slots__}
    part["owner"] = np.zeros(int(keep.sum()), np.int64)
    return replace(
        room,
        objects=(replace(room.objects[index], index=0),),
        surfaces=type(room.surfaces)(**part),
        outline_in_world=(room.outline_in_world[index],),
    )


class Sightings:
    """Counts the frames that see each object, and each place where an object was before."""

    def __init__(self, options: SessionOptions, config: RoomConfig, room: Room) -> None:
        self.options = options
        self.K = camera_matrix(config)
        self.identities = [truth.identity for truth in room.objects]
        self.objects = dict.fromkeys(self.identities, 0)
        self.ghosts: dict[tuple[int, int], Room] = {}  # by reference session and identity
        self.places: dict[tuple[int, int], int] = {}

    def expect(self, reference: int, room: Room, index: int) -> None:
        """Count the views of the place that an object has in a reference session."""
        key = (reference, room.objects[index].identity)
        self.ghosts[key] = only(room, index)
        self.places[key] = 0

    def seen(self, visibility: float, box: Array) -> bool:
        """Does a view show enough of an object, whose visible box is (4,)?"""
        side = float(min(box[2] - box[0], box[3] - box[1]))
        return visibility >= self.options.seen_share and side >= self.options.seen_px

    def watch(self, frame: Frame) -> None:
        """Add a frame."""
        for index, identity in enumerate(self.identities):
            box = frame.truth.visible_xyxy[index]
            self.objects[identity] += self.seen(float(frame.truth.visibility[index]), box)
        height, width = frame.depth.shape
        nearest = 1 / np.maximum(frame.depth, 1e-6) * 0.998  # of the scene, 1/m, with 0.2 % slack
        for key, ghost in self.ghosts.items():
            windows = patch_windows(ghost.surfaces, self.K @ frame.cam_from_world, (width, height))
            if not (windows[:, 2:] > windows[:, :2]).all(1).any():
                continue
            layers = rasterize(ghost.surfaces, self.K, frame.cam_from_world, (width, height))
            shown = (layers.patch >= 0) & (layers.inverse_depth > nearest)
            instance = np.where(shown, 0, -1).astype(np.int32)
            truth = ground_truth(ghost, self.K, frame.cam_from_world, instance)
            self.places[key] += self.seen(float(truth.visibility[0]), truth.visible_xyxy[0])


def change_entries(
    rooms: Sequence[Room], session: int, reference: int, sightings: Sequence[Sightings]
) -> list[dict[str, Any]]:
    """What happened to each object between two sessions (from 0), for `changes.json`."""
    before = by_identity(rooms[reference])
    now = by_identity(rooms[session])
    earlier = {i for room in rooms[:reference] for i in by_identity(room)}
    entries: list[dict[str, Any]] = []
    for identity in sorted(before | now):
        old = before.get(identity)
        new = now.get(identity)
        known = old or new
        assert known is not None
        if old is None:
            state = "returned" if identity in earlier else "new"
        elif new is None:
            state = "gone"
        else:
            state = "stayed" if same_pose(old, new) else "moved"
        views = sightings[session].objects.get(identity, 0)
        entry: dict[str, Any] = {"id": identity, "class": known.class_name, "state": state}
        if old is not None:
            entry["from"] = old.center_in_world.round(6).tolist()
        if new is not None:
            entry["to"] = new.center_in_world.round(6).tolist()
        if old is not None and new is not None:
            shift = np.linalg.norm(new.center_in_world - old.center_in_world)
            entry["distance_m"] = round(float(shift), 6)
            entry["turn_rad"] = round(turn_of(old, new), 6)
        entry["frames_seen_before"] = sightings[reference].objects.get(identity, 0)
        entry["frames_seen"] = views
        if old is not None:
            place = sightings[session].places.get((reference, identity), views)
            entry["frames_old_place_seen"] = place
        entries.append(entry)
    return entries


def changes_json(
    studio: Studio,
    sessions: Sequence[Session],
    options: SessionOptions,
    sightings: Sequence[Sightings],
) -> dict[str, Any]:
    """The truth of all sessions, for `changes.json`."""
    rooms = [session.room for session in sessions]
    names = list(studio.models)
    contrast = studio.contrast()
    known = {i: truth for room in rooms for i, truth in by_identity(room).items()}
    objects = [
        {
            "id": i,
            "class": truth.class_name,
            "twin_group": truth.twin_group,
            "texture_contrast": round(contrast[names[truth.twin_group]], 2),
            "textured": contrast[names[truth.twin_group]] >= options.textured_grey,
            "sessions": [n + 1 for n, room in enumerate(rooms) if i in by_identity(room)],
        }
        for i, truth in sorted(known.items())
    ]
    pairs = [(s, r) for s in range(1, len(rooms)) for r in sorted({0, s - 1})]
    return {
        "format": "reobj-room-changes",
        "version": 1,
        "units": "m",
        "frame": "one room frame for all sessions, z up",
        "seen": {"visible_share": options.seen_share, "box_side_px": options.seen_px},
        "options": asdict(options),
        "sessions": [
            {
                "session": n + 1,
                "folder": f"session{n + 1}",
                "focal_px": round(float(camera_matrix(session.config)[0, 0]), 6),
                "eye_m": round(session.config.eye_m, 6),
                "lighting": asdict(session.lighting),
                "frames_seen": {str(i): n for i, n in sorted(sightings[n].objects.items())},
            }
            for n, session in enumerate(sessions)
        ],
        "objects": objects,
        "changes": [
            {
                "session": s + 1,
                "against": r + 1,
                "objects": change_entries(rooms, s, r, sightings),
            }
            for s, r in pairs
        ],
    }


def write_sessions(
    out: Path,
    config: RoomConfig,
    options: SessionOptions,
    detector: DetectorConfig,
    png: bool = False,
    crf: int | None = None,
) -> dict[str, Any]:
    """Render all sessions into OUT/session1, ... and write OUT/changes.json."""
    out.mkdir(parents=True, exist_ok=True)
    studio, sessions = make_sessions(config, options)
    sightings: list[Sightings] = []
    counts = []
    for number, session in enumerate(sessions):
        seen = Sightings(options, session.config, session.room)
        now = by_identity(session.room)
        for reference in sorted({0, number - 1} - {-1, number}):
            for truth in sessions[reference].room.objects:
                here = now.get(truth.identity)
                if here is None or not same_pose(truth, here):
                    seen.expect(reference, sessions[reference].room, truth.index)
        folder = out / f"session{number + 1}"
        counts.append(
            write_room(
                folder,
                session.room,
                session.config,
                detector,
                session.cameras,
                seen.watch,
                png,
                crf,
            )
        )
        sightings.append(seen)
    changes = changes_json(studio, sessions, options, sightings)
    (out / "changes.json").write_text(json.dumps(changes, indent=1) + "\n")
    return {"sessions": counts}
