"""Build a room from its plan: models, textures, surfaces, light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rendering.config import PLANS, Array, Image, Rect, Rng, RoomConfig, Size
from rendering.light import DEFAULT_LIGHTING, Lighting, bake_light
from rendering.models import Model, Part, Placement, furniture_models, placed, rotation_z
from rendering.plans import (
    fixed_furniture,
    home_plan,
    later_plan,
    room_shell,
    skirting,
    varied_models,
    varied_plan,
    wall_pictures,
)
from rendering.surfaces import (
    Room,
    RoomObject,
    Surfaces,
    build_atlas,
    build_surfaces,
    place_object,
    texture_window,
)
from rendering.texture_set import make_textures, varied_textures

Windows = Sequence[Sequence[float]]  # texture piece (x, y, w, h) in the atlas of every part


def texture_windows(
    parts: Sequence[Part], rects: dict[str, Rect], config: RoomConfig, rng: Rng
) -> Windows:
    """The texture pieces of parts."""
    return [texture_window(p, rects[p.texture], config.texels_per_m, rng) for p in parts]


def build_room(
    size: Size,
    background: tuple[Sequence[Part], Windows],
    placements: dict[int, Placement],
    models: dict[str, tuple[Model, Windows]],
    atlas: tuple[Image, ...],
    rng: Rng,
    rays: int,
    lighting: Lighting = DEFAULT_LIGHTING,
    margin_m: float = 0.0,
) -> Room:
    """Furnish and light a room.

    Args:
        background: parts without objects, the walls, floor and ceiling first.
        placements: by identity.
        models: by name; objects of one model look the same.
        margin_m: by which the lit space is wider than the room.
    """
    parts = list(background[0])
    windows = list(background[1])
    owners = [-1] * len(parts)
    objects: list[RoomObject] = []
    outlines: list[Array] = []
    names = list(models)
    for identity, placement in sorted(placements.items()):
        model, pieces = models[placement.model]
        group = names.index(placement.model)
        truth, own, outline = place_object(len(objects), identity, placement, model, group)
        owners += [len(objects)] * len(own)
        parts += own
        windows += pieces
        objects.append(truth)
        outlines.append(outline)
    surfaces, height = build_surfaces(parts, owners, windows)
    lit = (size[0] + margin_m, *size[1:])
    light = bake_light(surfaces, lit, height, rays, rng, lighting)
    return Room(size, tuple(objects), surfaces, atlas, light, tuple(outlines))


def make_room(config: RoomConfig) -> Room:
    """Plan, furnish, paint and light a room; the same config gives the same room.

    Raises: ValueError for an unknown plan.
    """
    if config.plan not in PLANS:
        raise ValueError(f"plan {config.plan!r} is unknown: use {', '.join(PLANS)}")
    if config.plan == "corridor":
        return rooms_in_a_row(make_room(replace(config, plan="home")), CORRIDOR_ROOMS)
    varied = config.plan == "varied"
    rng = np.random.default_rng([config.seed, 1])
    sides = rng.uniform((5.0, 4.4, 2.4), (8.6, 7.2, 3.1)) if varied else config.room_m
    w, d, h = (side * (1 + float(rng.uniform(-1, 1)) * config.room_jitter) for side in sides)
    size = (w, d, h)
    models = furniture_models(rng)
    gone = -1
    if varied:
        models = varied_models(rng, models)
        plan, fixed = varied_plan(rng, size)
    else:
        plan = home_plan(rng, size)
        if config.plan == "later":
            plan, gone = later_plan(plan)
        fixed = wall_pictures(size, rng) + fixed_furniture(size)
    background = room_shell(size) + skirting(size) + fixed
    textures = make_textures(rng, config, size)
    if varied:
        w, d, h = (int(side * config.texels_per_m) for side in size)
        textures |= varied_textures(rng, (w, d, h))
    atlas, rects = build_atlas(textures)
    windows = texture_windows(background, rects, config, rng)
    pieces: dict[str, Windows] = dict.fromkeys(models, ())
    for p in plan:
        if not pieces[p.model]:
            parts = placed(models[p.model].parts, rotation_z(p.yaw_rad), p.position)
            pieces[p.model] = texture_windows(parts, rects, config, rng)
    return build_room(
        size,
        (background, windows),
        {k + 1: placement for k, placement in enumerate(plan) if k != gone},
        {name: (model, pieces[name]) for name, model in models.items()},
        atlas,
        rng,
        config.light_rays,
    )


CORRIDOR_ROOMS = 3  # so that every view has two wrong positions
JOIN_M = 0.2  # what is so close to a wall that is left out goes with it: pictures, curtains


def rooms_in_a_row(room: Room, count: int) -> Room:
    """Repeat a room along x, without the walls between: every part looks the same, light too."""
    w, d, h = room.size_m
    x = room.surfaces.corners_in_world[..., 0]  # (S, 8)
    west, east = ((np.abs(x - side * w / 2) < JOIN_M).all(1) for side in (-1, 1))  # (S,)
    surfaces = []
    objects = []
    outlines = []
    for copy in range(count):
        keep = ~((east & (copy < count - 1)) | (west & (copy > 0)))
        shift = np.array([(copy - (count - 1) / 2) * w, 0.0, 0.0])
        first = copy * len(room.objects)
        part = {name: getattr(room.surfaces, name)[keep] for name in Surfaces.__slots__}
        offset = np.pad(shift[:, None], ((0, 0), (3, 0)))
        part["world_from_patch"] = part["world_from_patch"] + offset
        part["corners_in_world"] = part["corners_in_world"] + shift
        part["owner"] = np.where(part["owner"] < 0, -1, part["owner"] + first)
        surfaces.append(part)
        for o in room.objects:
            number = o.index + first
            center = o.center_in_world + shift
            objects.append(replace(o, index=number, identity=number + 1, center_in_world=center))
        outlines += [outline + shift for outline in room.outline_in_world]
    joined = {name: np.concatenate([s[name] for s in surfaces]) for name in Surfaces.__slots__}
    return replace(
        room,
        size_m=(count * w, d, h),
        objects=tuple(objects),
        surfaces=Surfaces(**joined),
        outline_in_world=tuple(outlines),
    )
