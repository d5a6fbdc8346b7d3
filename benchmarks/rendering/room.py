"""Build a room from its plan: models, textures, surfaces, light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rendering.config import PLANS, Rng, RoomConfig
from rendering.light import bake_light
from rendering.models import Part, Placement, furniture_models
from rendering.plans import (
    desk_placements,
    dining_placements,
    fixed_furniture,
    limit_placements,
    lounge_placements,
    room_shell,
    shelf_placements,
    skirting,
    varied_models,
    varied_plan,
    wall_pictures,
)
from rendering.surfaces import (
    Room,
    Surfaces,
    build_atlas,
    build_surfaces,
    place_object,
    texture_window,
)
from rendering.texture_set import make_textures, varied_textures


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
    gone: tuple[int, ...] = ()
    if varied:
        models = varied_models(rng, models)
        plan, fixed = varied_plan(config, rng, size)
    else:
        plan = limit_placements(home_plan(config, rng, size), config)
        if config.plan == "later":
            plan, gone = later_plan(plan)
        fixed = wall_pictures(size, rng) + fixed_furniture(size)
    placed = [
        place_object(i, placement, models[placement.model], list(models).index(placement.model))
        for i, placement in enumerate(plan)
    ]
    parts = room_shell(size) + skirting(size) + fixed
    owners = [-1] * len(parts) + [truth.index for truth, own, _ in placed for _ in own]
    parts += [part for _, own, _ in placed for part in own]
    textures = make_textures(rng, config, size)
    if varied:
        texels = (int(w * config.texels_per_m), int(d * config.texels_per_m))
        textures |= varied_textures(rng, config, (*texels, int(h * config.texels_per_m)))
    atlas, rects = build_atlas(textures)
    windows = object_windows(
        parts, owners, rects, config, rng, [truth.twin_group for truth, _, _ in placed]
    )
    shown = [part for part, owner in enumerate(owners) if owner not in gone]
    placed = [found for found in placed if found[0].index not in gone]
    parts = [parts[part] for part in shown]
    windows = [windows[part] for part in shown]
    new_index = {truth.index: index for index, (truth, _, _) in enumerate(placed)}
    owners = [new_index.get(owners[part], -1) for part in shown]
    placed = [(replace(t, index=k), own, origin) for k, (t, own, origin) in enumerate(placed)]
    surfaces, light_height = build_surfaces(parts, owners, windows)
    light = bake_light(surfaces, size, light_height, config.light_rays, rng)
    return Room(
        size, tuple(t for t, _, _ in placed), surfaces, atlas, light, tuple(o for _, _, o in placed)
    )


def home_plan(config: RoomConfig, rng: Rng, size: tuple[float, float, float]) -> list[Placement]:
    """Dining table, desk, lounge and shelves, each at its own position."""
    center = (
        -size[0] / 2 + 1.65 + float(rng.uniform(-0.1, 0.1)),
        -0.95 + float(rng.uniform(-0.1, 0.1)),
    )
    return (
        dining_placements(config, rng, center)
        + desk_placements(rng, size)
        + lounge_placements(rng, size)
        + shelf_placements(size)
    )


def later_plan(plan: list[Placement]) -> tuple[list[Placement], tuple[int, ...]]:
    """The home plan on another day: a chair and the bowl moved, a bottle is gone, a ball is new.

    Returns: the placements, in their order, new ones last; indices of those that are gone.
    """
    chair = 4
    bowl = 5
    bottle = 8
    later = list(plan)
    later[chair] = replace(plan[chair], position=(-2.75, -0.05, 0.0), yaw_rad=0.9)
    x, y, z = plan[bowl].position
    later[bowl] = replace(plan[bowl], position=(x - 0.29, y - 0.13, z))
    return [*later, Placement("ball", (-0.75, -1.5, 0.0))], (bottle,)


CORRIDOR_ROOMS = 3  # chosen: two wrong positions for every view
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
        part["world_from_patch"] = part["world_from_patch"] + np.pad(
            shift[:, None], ((0, 0), (3, 0))
        )
        part["corners_in_world"] = part["corners_in_world"] + shift
        part["owner"] = np.where(part["owner"] < 0, -1, part["owner"] + first)
        surfaces.append(part)
        objects += [
            replace(
                o,
                index=o.index + first,
                identity=o.index + first + 1,
                center_in_world=o.center_in_world + shift,
            )
            for o in room.objects
        ]
        outlines += [outline + shift for outline in room.outline_in_world]
    joined = {name: np.concatenate([s[name] for s in surfaces]) for name in Surfaces.__slots__}
    return Room(
        (count * w, d, h), tuple(objects), Surfaces(**joined), room.atlas, room.light,
        tuple(outlines),
    )  # fmt: skip


def object_windows(
    parts: Sequence[Part],
    owners: Sequence[int],
    rects: dict[str, tuple[int, int, int, int]],
    config: RoomConfig,
    rng: Rng,
    twin_groups: Sequence[int],
) -> list[list[float]]:
    """Texture pieces of all parts; identical instances share them and differ by position only."""
    windows: list[list[float]] = []
    known: dict[tuple[int, int], list[float]] = {}
    seen = 0
    for index, (part, owner) in enumerate(zip(parts, owners, strict=True)):
        seen = seen + 1 if index and owners[index - 1] == owner else 0
        if owner < 0:
            windows.append(texture_window(part, rects[part.texture], config.texels_per_m, rng))
            continue
        key = (twin_groups[owner], seen)
        if key not in known:
            known[key] = texture_window(part, rects[part.texture], config.texels_per_m, rng)
        windows.append(known[key])
    return windows
