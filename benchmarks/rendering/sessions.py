"""Recordings of one room on several days: objects, light, camera path and focal length change.

All sessions share one room frame: origin in the middle of the floor, z up, metres. An object has
the same number in all sessions; a number is never used for another object.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rendering.camera import camera_matrix, walk
from rendering.changes import Placements, Space, next_session, settled
from rendering.config import Array, Image, RoomConfig, Size
from rendering.ground_truth import ground_truth
from rendering.light import DEFAULT_LIGHTING, Lighting
from rendering.models import Model, Part, Placement, furniture_models
from rendering.photograph import Frame
from rendering.plans import room_shell, session_plan, varied_models
from rendering.raster import patch_windows, rasterize
from rendering.room import Windows, build_room, texture_windows
from rendering.surfaces import Room, RoomObject, Surfaces, build_atlas, part_bounds
from rendering.texture_set import session_textures
from rendering.writers import write_clip

ZOOM = 1.2  # focal length of every second session, relative
SEEN_SHARE = 0.2  # visible part of an object's silhouette from which it counts as seen
SEEN_PX = 8.0  # least side of its box, as in gt_mot.txt
TEXTURED_GREY = 14.0  # of `contrast`: 3 to 13 for even colours, 30 to 50 for prints
LIT_MARGIN_M = 0.16  # the lit space reaches so far into the walls, on both sides together


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """What is recorded."""

    sessions: int = 2
    foreign: int | None = None  # seed of another room with the same object models
    mirror: bool = False  # x -> -x, textures too
    light_only: bool = False  # objects stay


@dataclass(frozen=True, slots=True)
class Session:
    """One recording."""

    room: Room
    config: RoomConfig  # seed: that of noise, hand shake and detector
    cameras: Array  # (F, 3, 4) cam_from_world


@dataclass(frozen=True, slots=True)
class Studio:
    """A room's plan and the looks of everything in it."""

    config: RoomConfig
    size_m: Size
    placements: Sequence[Placement]
    fixed: Sequence[Part]
    models: dict[str, tuple[Model, Windows]]
    background: tuple[Sequence[Part], Windows]
    atlas: tuple[Image, ...]

    def room(self, placements: Placements, number: int) -> Room:
        """The furnished room in the light of a session."""
        return build_room(
            self.size_m,
            self.background,
            placements,
            self.models,
            self.atlas,
            np.random.default_rng([self.config.seed, 25, 0]),
            self.config.light_rays,
            session_lighting(self.config.seed, number),
            LIT_MARGIN_M,
        )

    def contrast(self, name: str) -> float:
        """Mean over the area of a model of the standard deviation of grey levels."""
        grey = self.atlas[0].mean(2)
        model, windows = self.models[name]
        spread = [
            grey[int(y) : int(y + h) + 1, int(x) : int(x + w) + 1].std() for x, y, w, h in windows
        ]
        edges = [np.linalg.norm(part.obj_from_patch[:, :2], axis=0) for part in model.parts]
        return float(np.average(spread, weights=[a * b for a, b in edges]))


def make_studio(config: RoomConfig, foreign: int | None = None) -> Studio:
    """Plan and paint the room of a seed, or that of another seed with the objects of the first."""
    rng = np.random.default_rng([config.seed, 20, 0])
    models = varied_models(rng, furniture_models(rng))
    room_config = config if foreign is None else replace(config, seed=foreign)
    size, placements, fixed = session_plan(room_config.seed, models)

    def painted(config: RoomConfig, size: Size) -> dict[str, Image]:
        return session_textures(np.random.default_rng([config.seed, 22, 0]), config, size)

    textures = painted(room_config, size)
    images = textures if foreign is None else painted(config, (1.0, 1.0, 1.0))
    used = {part.texture for model in models.values() for part in model.parts}
    textures = textures | {f"object/{name}": images[name] for name in sorted(used)}
    atlas, rects = build_atlas(textures)
    looks = {}
    for number, (name, model) in enumerate(models.items()):
        rng = np.random.default_rng([config.seed, 24, number])
        own = {name: rects[f"object/{name}"] for name in used}
        looks[name] = (model, texture_windows(model.parts, own, config, rng))
    parts = [*room_shell(size), *fixed]
    rng = np.random.default_rng([room_config.seed, 23, 0])
    background = (parts, texture_windows(parts, rects, room_config, rng))
    return Studio(room_config, size, placements, fixed, looks, background, atlas)


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
    gains = np.where(rng.random(2) < 0.35, 0.15, rng.uniform(0.7, 1.2, 2))
    return Lighting(
        lamp=lamp.tolist(),
        window=(np.array(DEFAULT_LIGHTING.window) * day).tolist(),
        panel_gains=gains.tolist(),
        ambient=rng.uniform(0.7, 1.2),
        window_turn_rad=rng.choice([-1, 1]) * rng.uniform(0.3, 0.9),
        window_focus=rng.uniform(1.0, 4.0),
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
    outside = [np.maximum(low - points, points - high) for low, high in fixed]
    for truth in room.objects:
        local = (points - truth.center_in_world) @ truth.world_from_obj
        outside.append(np.abs(local) - truth.size_m / 2)
    return float(np.linalg.norm(np.maximum(outside, 0), axis=2).min())


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
    count = 10
    for attempt in range(200):
        rng = np.random.default_rng([config.seed, 32, attempt])
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
        cameras = walk(config, rng, np.arange(float(count)), keys, 0.035)
        centers = -np.einsum("fij,fi->fj", cameras[:, :, :3], cameras[:, :, 3])
        if box_clearance_m(room, fixed, centers) >= clearance_m:
            return cameras
    raise ValueError(f"seed {config.seed}: no camera path keeps clear of the furniture")


def plan_sessions(studio: Studio, options: SessionOptions) -> list[Placements]:
    """Where every object stands in each session, by identity."""
    models = {name: model for name, (model, _) in studio.models.items()}
    textured = frozenset(name for name in models if studio.contrast(name) >= TEXTURED_GREY)
    space = Space(studio.size_m, studio.fixed, models, textured)
    first = dict(enumerate(settled(space, studio.placements), start=1))
    names = {identity: placement.model for identity, placement in first.items()}
    history = [first]
    rng = np.random.default_rng([studio.config.seed, 30])
    for _ in range(1, options.sessions):
        history.append(first if options.light_only else next_session(rng, space, history, names))
    return history


def make_sessions(config: RoomConfig, options: SessionOptions) -> list[Session]:
    """Build the room of every session, with its light, camera and path."""
    studio = make_studio(config, options.foreign)
    seed = studio.config.seed
    fixed = np.array([part_bounds(part) for part in studio.fixed])  # (B, 2, 3)
    if options.mirror:
        fixed = np.sort(fixed * [-1, 1, 1], axis=1)
    sessions: list[Session] = []
    for number, placements in enumerate(plan_sessions(studio, options)):
        rng = np.random.default_rng([seed, 33, number])
        room = studio.room(placements, number)
        if number:
            room = exposed(room, float(sessions[0].room.light.mean()), rng)
        if options.mirror:
            room = mirrored(room)
        half = np.radians(config.hfov_deg) / 2
        own = replace(
            config,
            seed=1000 * seed + number + 1,
            hfov_deg=float(np.degrees(2 * np.arctan(np.tan(half) / (ZOOM if number % 2 else 1)))),
            eye_m=rng.uniform(1.35, 1.7) if number else config.eye_m,
        )
        sessions.append(Session(room, own, session_path(room, fixed, own, whole=number == 0)))
    return sessions


# ---- The truth about changes ---------------------------------------------------------------------


def same_pose(first: RoomObject, second: RoomObject) -> bool:
    """Is an object where it was, to 0.1 mm and 1e-4 rad?"""
    shift = np.abs(first.center_in_world - second.center_in_world).max()
    turn = (second.yaw_rad - first.yaw_rad + np.pi) % (2 * np.pi) - np.pi
    return bool(shift < 1e-4 and abs(turn) < 1e-4)


def by_identity(room: Room) -> dict[int, RoomObject]:
    """Objects of a room by their number."""
    return {truth.identity: truth for truth in room.objects}


def only(room: Room, index: int) -> Room:
    """A room that holds one of its objects and nothing else."""
    keep = room.surfaces.owner == index
    part = {name: getattr(room.surfaces, name)[keep] for name in Surfaces.__slots__}
    part["owner"] = np.zeros(int(keep.sum()), np.int64)
    return replace(
        room,
        objects=(replace(room.objects[index], index=0),),
        surfaces=Surfaces(**part),
        outline_in_world=(room.outline_in_world[index],),
    )


class Sightings:
    """Counts the frames that see each object, and each place where an object was before."""

    def __init__(self, session: Session) -> None:
        self.K = camera_matrix(session.config)
        self.now = by_identity(session.room)
        self.objects = dict.fromkeys(self.now, 0)
        self.ghosts: dict[tuple[int, int], Room] = {}  # by reference session and identity
        self.places: dict[tuple[int, int], int] = {}

    def expect(self, reference: int, room: Room) -> None:
        """Count the views of the places that objects had in a reference session."""
        for truth in room.objects:
            here = self.now.get(truth.identity)
            if here is None or not same_pose(truth, here):
                self.ghosts[reference, truth.identity] = only(room, truth.index)
                self.places[reference, truth.identity] = 0

    def watch(self, frame: Frame) -> None:
        """Add a frame."""

        def seen(visibility: float, box: Array) -> bool:
            """Does a view show enough of an object, whose visible box is (4,)?"""
            return bool(visibility >= SEEN_SHARE and (box[2:] - box[:2]).min() >= SEEN_PX)

        for identity, item in self.now.items():
            truth = frame.truth
            visible = seen(truth.visibility[item.index], truth.visible_xyxy[item.index])
            self.objects[identity] += visible
        size = frame.depth.shape[::-1]
        nearest = 1 / np.maximum(frame.depth, 1e-6) * 0.998  # of the scene, 1/m, with 0.2 % slack
        for key, ghost in self.ghosts.items():
            windows = patch_windows(ghost.surfaces, self.K @ frame.cam_from_world, size)
            if (windows[:, 2:] > windows[:, :2]).all(1).any():
                layers = rasterize(ghost.surfaces, self.K, frame.cam_from_world, size)
                shown = (layers.patch >= 0) & (layers.inverse_depth > nearest)
                instance = np.where(shown, 0, -1).astype(np.int32)
                truth = ground_truth(ghost, self.K, frame.cam_from_world, instance)
                self.places[key] += seen(truth.visibility[0], truth.visible_xyxy[0])


def change_entries(
    rooms: Sequence[Room], session: int, reference: int, sightings: Sightings
) -> list[dict[str, Any]]:
    """What happened to each object between two sessions (from 0), for `changes.json`."""
    before = by_identity(rooms[reference])
    now = sightings.now
    earlier = {i for room in rooms[:reference] for i in by_identity(room)}
    entries: list[dict[str, Any]] = []
    for identity in sorted(before | now):
        entry: dict[str, Any] = {"id": identity, "class": (before | now)[identity].class_name}
        if identity not in before:
            entry["state"] = "returned" if identity in earlier else "new"
        elif identity not in now:
            entry["state"] = "gone"
        else:
            old = before[identity]
            new = now[identity]
            entry["state"] = "stayed" if same_pose(old, new) else "moved"
            shift = np.linalg.norm(new.center_in_world - old.center_in_world)
            entry["distance_m"] = round(float(shift), 6)
        if identity in before:
            views = sightings.objects.get(identity, 0)  # where it stayed
            entry["frames_old_place_seen"] = sightings.places.get((reference, identity), views)
        entries.append(entry)
    return entries


def write_sessions(
    out: Path,
    config: RoomConfig,
    options: SessionOptions,
    png: bool = False,
    crf: int | None = None,
) -> dict[str, Any]:
    """Render all sessions into OUT/session1, ... and write OUT/changes.json."""
    out.mkdir(parents=True, exist_ok=True)
    sessions = make_sessions(config, options)
    rooms = [session.room for session in sessions]
    counts = []
    changes = []
    for number, session in enumerate(sessions):
        references = sorted({0, number - 1}) if number else []
        seen = Sightings(session)
        for reference in references:
            seen.expect(reference, rooms[reference])
        folder = out / f"session{number + 1}"
        counts.append(
            write_clip(
                folder, session.config, png, crf, room=session.room, cameras=session.cameras,
                watch=seen.watch,
            )
        )  # fmt: skip
        changes += [
            {
                "session": number + 1,
                "against": reference + 1,
                "objects": change_entries(rooms, number, reference, seen),
            }
            for reference in references
        ]
    known = {i: truth for room in rooms for i, truth in sorted(by_identity(room).items())}
    truth = {
        "format": "reobj-room-changes",
        "version": 1,
        "sessions": [{"folder": f"session{n + 1}"} for n in range(len(sessions))],
        "objects": [
            {"id": i, "class": truth.class_name, "twin_group": truth.twin_group}
            for i, truth in sorted(known.items())
        ],
        "changes": changes,
    }
    (out / "changes.json").write_text(json.dumps(truth, indent=1) + "\n")
    return {"sessions": counts}
