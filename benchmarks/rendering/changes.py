"""Choose what changes between two recordings of a room: moved, taken away, added, returned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rendering.config import Array, Rng
from rendering.flat import part_bounds
from rendering.models import Model, Part, Placement, rotation_z
from rendering.surfaces import apply, patch_corners

FIXED_CLASSES = frozenset({"dining table", "couch"})  # objects stand on them or under them
TABLES = ("table", "desk", "coffee")
NEW_ON_FLOOR = ("chair", "ball", "suitcase", "plant", "bear")
NEW_ON_TABLE = ("cup", "bottle0", "bottle1", "book0", "book1", "vase", "bowl", "laptop", "bear")
COUCH_TOP_M = 0.78  # of couch_model, on which a bear sits at the height of lounge_placements


@dataclass(frozen=True, slots=True)
class ChangeOptions:
    """How much changes between one session and the next."""

    share: float = 1 / 3  # of the objects present
    moved: float = 0.5  # of the changes; half of the others are taken away, half are added
    floor_m: tuple[float, float] = (0.3, 2.0)  # distance of a move on the floor
    table_m: float = 0.3  # least distance of a move on a table
    returned: float = 0.5  # probability that an added object is one that was taken away before
    new_on_floor: float = 0.4  # probability; the others are put on tables
    gap_m: float = 0.03  # free space around what is put somewhere
    tries: int = 300  # positions per object, before the next object is taken


@dataclass(frozen=True, slots=True)
class Scene:
    """What the objects of a room may stand on and run into, in the room's frame."""

    size_m: tuple[float, float, float]
    fixed: tuple[Part, ...]
    models: dict[str, Model]
    textured: frozenset[str]  # names of models


Placements = dict[int, Placement]  # by identity


def model_box(model: Model) -> Array:
    """(2, 3) lowest and highest corner of a model in its own frame, m."""
    points = np.concatenate([apply(p.obj_from_patch, patch_corners(p)) for p in model.parts])
    return np.stack([points.min(0), points.max(0)])


def placed_box(box: Array, placement: Placement) -> tuple[Array, float, float]:
    """Corners (4, 2) of the turned rectangle seen from above, lowest and highest z, m.

    Args:
        box: (2, 3) of `model_box`.
    """
    low, high = box
    flat = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    corners = flat @ rotation_z(placement.yaw_rad)[:2, :2].T + placement.position[:2]
    return corners, float(low[2] + placement.position[2]), float(high[2] + placement.position[2])


def separated(first: Array, second: Array, gap: float) -> bool:
    """Are two convex quadrangles (4, 2) at least about `gap` apart? Separating axis theorem."""
    for polygon in (first, second):
        edges = np.roll(polygon, -1, 0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], 1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        one = normals @ first.T  # (4, 4)
        other = normals @ second.T
        apart = np.maximum(one.min(1) - other.max(1), other.min(1) - one.max(1))
        if apart.max() >= gap:
            return True
    return False


class Space:
    """The volume that is taken in a room, and positions that are free in it."""

    def __init__(self, scene: Scene, options: ChangeOptions) -> None:
        self.scene = scene
        self.options = options
        self.boxes = {name: model_box(model) for name, model in scene.models.items()}
        bounds = np.array([part_bounds(part) for part in scene.fixed]).reshape(-1, 2, 3)
        self.fixed = bounds[bounds[:, 1, 2] > 0.03]  # a rug is not in the way

    def free(self, candidate: Placement, others: Sequence[Placement]) -> bool:
        """Does a placed model neither leave the room nor touch others or fixed furniture?"""
        gap = self.options.gap_m
        corners, low, high = placed_box(self.boxes[candidate.model], candidate)
        if (np.abs(corners) > np.array(self.scene.size_m[:2]) / 2 - 0.05).any():
            return False
        x0, y0 = corners.min(0) - gap
        x1, y1 = corners.max(0) + gap
        hit = (self.fixed[:, 0] < [x1, y1, high]).all(1) & (
            self.fixed[:, 1] > [x0, y0, low + 0.005]
        ).all(1)
        if hit.any():
            return False
        for other in others:
            there, other_low, other_high = placed_box(self.boxes[other.model], other)
            meets = low < other_high - 0.005 and other_low < high - 0.005
            if meets and not separated(corners, there, gap):
                return False
        return True

    def on_floor(
        self, rng: Rng, model: str, start: Placement | None, others: Sequence[Placement]
    ) -> Placement | None:
        """A free position on the floor, at the distance of a move from `start` if given."""
        for _ in range(self.options.tries):
            turn = float(rng.uniform(-np.pi, np.pi))
            if start is None:
                spot = rng.uniform(-0.5, 0.5, 2) * self.scene.size_m[:2]
            else:
                heading = rng.uniform(-np.pi, np.pi)
                reach = rng.uniform(*self.options.floor_m)
                spot = start.position[:2] + reach * np.array([np.cos(heading), np.sin(heading)])
                turn = start.yaw_rad + float(rng.normal(0, 0.8))
            candidate = Placement(model, (float(spot[0]), float(spot[1]), 0.0), turn)
            if self.free(candidate, others):
                return candidate
        return None

    def on_table(
        self, rng: Rng, model: str, start: Placement | None, others: Sequence[Placement]
    ) -> Placement | None:
        """A free position on a table, at least `table_m` from `start` if given."""
        tables = [other for other in others if other.model in TABLES]
        for _ in range(self.options.tries if tables else 0):
            table = tables[int(rng.integers(len(tables)))]
            box = self.boxes[table.model]
            radius = float(np.abs(self.boxes[model][:, :2]).max())
            half = np.ptp(box[:, :2], axis=0) / 2 - radius - 0.01
            if (half <= 0).any():
                continue
            local = np.append(rng.uniform(-half, half) + box[:, :2].mean(0), box[1, 2])
            spot = rotation_z(table.yaw_rad) @ local + table.position
            turn = float(rng.uniform(-np.pi, np.pi))
            candidate = Placement(model, (float(spot[0]), float(spot[1]), float(spot[2])), turn)
            if start and np.linalg.norm(spot - start.position) < self.options.table_m:
                continue
            if self.free(candidate, others):
                return candidate
        return None


def settled(space: Space, placements: Sequence[Placement]) -> list[Placement]:
    """The plan without objects that touch others, and with those on couches at their height.

    Chairs may stand under tables.
    """
    kept: list[Placement] = []
    couch_m = space.boxes["couch"][1, 2]
    for placement in placements:
        on_couch = placement.model == "bear" and placement.position[2] > 0.05
        if on_couch:
            x, y, z = placement.position
            placement = replace(placement, position=(x, y, z * couch_m / COUCH_TOP_M))
        fixed = space.scene.models[placement.model].class_name in FIXED_CLASSES
        chair = space.scene.models[placement.model].class_name == "chair"
        others = [
            other
            for other in kept
            if not (on_couch and other.model == "couch") and not (chair and other.model in TABLES)
        ]
        if fixed or space.free(placement, others):
            kept.append(placement)
    return kept


def next_session(
    rng: Rng, space: Space, history: Sequence[Placements], models: dict[int, str]
) -> Placements:
    """Change about a third of the objects of the last session.

    The first move is that of an object with an identical one on the floor; then textured and
    untextured objects take turns.
    Args:
        history: the sessions so far. models: of every identity so far; new ones are added here.
    """
    options = space.options
    scene = space.scene
    now = dict(history[-1])
    movable = [
        identity
        for identity, placement in now.items()
        if scene.models[placement.model].class_name not in FIXED_CLASSES
    ]
    total = max(1, round(options.share * len(now)))
    moves = max(1, round(options.moved * total))
    gone = (total - moves) // 2
    order = in_turns(rng, movable, lambda i: models[i] in scene.textured)
    count = Counter(placement.model for placement in now.values())
    floor_twins = [i for i in order if count[now[i].model] > 1 and now[i].position[2] < 0.05]
    order = [*floor_twins[:1], *(i for i in order if i not in floor_twins[:1])]
    moved = 0
    touched: set[int] = set()
    for identity in order:
        if moved == moves:
            break
        start = now[identity]
        others = [placement for other, placement in now.items() if other != identity]
        put = space.on_floor if start.position[2] < 0.05 else space.on_table
        found = put(rng, start.model, start, others)
        if found is not None:
            now[identity] = found
            touched.add(identity)
            moved += 1
    for identity in [i for i in order if i not in touched][:gone]:
        del now[identity]
        touched.add(identity)
    away = [i for i in models if i not in now and i not in touched]
    for _ in range(total - moves - gone):
        if away and rng.random() < options.returned:
            identity = away.pop(int(rng.integers(len(away))))
            name = models[identity]
            put = space.on_floor if name in NEW_ON_FLOOR else space.on_table
        else:
            identity = max(models) + 1
            floor = bool(rng.random() < options.new_on_floor)
            name = str(rng.choice(NEW_ON_FLOOR if floor else NEW_ON_TABLE))
            put = space.on_floor if floor else space.on_table
        found = put(rng, name, None, list(now.values()))
        if found is not None:
            models[identity] = name
            now[identity] = found
    return now


def in_turns(rng: Rng, items: Sequence[int], first_kind: Callable[[int], bool]) -> list[int]:
    """A random order in which the two kinds take turns as long as there are both."""
    shuffled = [items[int(i)] for i in rng.permutation(len(items))]
    one = [i for i in shuffled if first_kind(i)]
    other = [i for i in shuffled if not first_kind(i)]
    both = min(len(one), len(other))
    turns = [i for pair in zip(one[:both], other[:both], strict=True) for i in pair]
    return turns + one[both:] + other[both:]
