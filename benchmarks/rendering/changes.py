"""Choose what changes between two recordings of a room: moved, taken away, added, returned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rendering.config import Array, Rng, Size
from rendering.models import Model, Part, Placement, rotation_z
from rendering.surfaces import part_bounds

FIXED_CLASSES = frozenset({"dining table", "couch"})  # objects stand on them or under them
TABLES = ("table", "desk", "coffee")
NEW_ON_FLOOR = ("chair", "ball", "suitcase", "plant", "bear")
NEW_ON_TABLE = ("cup", "bottle0", "bottle1", "book0", "book1", "vase", "bowl", "laptop", "bear")
COUCH_TOP_M = 0.78  # of couch_model, on which a bear sits at the height of lounge_placements


SHARE = 1 / 3  # of the objects present that change between two sessions
MOVED = 0.5  # of the changes; half of the others are taken away, half are added
FLOOR_M = (0.3, 2.0)  # distance of a move on the floor
TABLE_M = 0.3  # least distance of a move on a table
RETURNED = 0.5  # probability that an added object is one that was taken away before
NEW_FLOOR_SHARE = 0.4  # of the added objects; the others are put on tables
GAP_M = 0.03  # free space around what is put somewhere
TRIES = 300  # positions per object, before the next object is taken
LOW_M = 0.05  # what stands lower stands on the floor

Placements = dict[int, Placement]  # by identity


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
    """The volume that is taken in a room, and positions that are free in it.

    Args:
        fixed: parts in the room's frame that objects may not run into. textured: names of models.
    """

    def __init__(
        self, size: Size, fixed: Sequence[Part], models: dict[str, Model], textured: frozenset[str]
    ) -> None:
        self.half = np.array(size[:2]) / 2
        self.models = models
        self.textured = textured
        boxes = {name: [part_bounds(p) for p in model.parts] for name, model in models.items()}
        self.boxes = {
            name: np.stack([np.min(box, (0, 1)), np.max(box, (0, 1))])
            for name, box in boxes.items()
        }  # (2, 3) lowest and highest corner of each model in its own frame, m
        bounds = np.array([part_bounds(part) for part in fixed])  # (B, 2, 3)
        self.fixed = bounds[bounds[:, 1, 2] > 0.03]  # a rug is not in the way

    def free(self, candidate: Placement, others: Sequence[Placement]) -> bool:
        """Does a placed model neither leave the room nor touch others or fixed furniture?"""
        corners, low, high = placed_box(self.boxes[candidate.model], candidate)
        if (np.abs(corners) > self.half - 0.05).any():
            return False
        start = [*(corners.min(0) - GAP_M), low + 0.005]
        end = [*(corners.max(0) + GAP_M), high]
        if ((self.fixed[:, 0] < end) & (self.fixed[:, 1] > start)).all(1).any():
            return False
        for other in others:
            there, other_low, other_high = placed_box(self.boxes[other.model], other)
            meets = low < other_high - 0.005 and other_low < high - 0.005
            if meets and not separated(corners, there, GAP_M):
                return False
        return True

    def put(
        self, rng: Rng, model: str, low: bool, start: Placement | None, others: Sequence[Placement]
    ) -> Placement | None:
        """A free position on the floor (low) or on a table, at the distance of a move from `start`
        if given.
        """
        tables = [other for other in others if other.model in TABLES]
        for _ in range(TRIES if low or tables else 0):
            candidate = (
                self.on_floor(rng, model, start)
                if low
                else self.on_table(rng, model, start, tables)
            )
            if candidate and self.free(candidate, others):
                return candidate
        return None

    def on_floor(self, rng: Rng, model: str, start: Placement | None) -> Placement:
        """A position on the floor, free or not."""
        turn = float(rng.uniform(-np.pi, np.pi))
        if start is None:
            spot = rng.uniform(-0.5, 0.5, 2) * (2 * self.half)
        else:
            heading = rng.uniform(-np.pi, np.pi)
            reach = rng.uniform(*FLOOR_M)
            spot = start.position[:2] + reach * np.array([np.cos(heading), np.sin(heading)])
            turn = start.yaw_rad + float(rng.normal(0, 0.8))
        return Placement(model, (float(spot[0]), float(spot[1]), 0.0), turn)

    def on_table(
        self, rng: Rng, model: str, start: Placement | None, tables: Sequence[Placement]
    ) -> Placement | None:
        """A position on one of the tables; None if it is too small or too close to `start`."""
        table = tables[int(rng.integers(len(tables)))]
        box = self.boxes[table.model]
        radius = float(np.abs(self.boxes[model][:, :2]).max())
        half = np.ptp(box[:, :2], axis=0) / 2 - radius - 0.01
        if (half <= 0).any():
            return None
        local = np.append(rng.uniform(-half, half) + box[:, :2].mean(0), box[1, 2])
        spot = rotation_z(table.yaw_rad) @ local + table.position
        turn = float(rng.uniform(-np.pi, np.pi))
        if start and np.linalg.norm(spot - start.position) < TABLE_M:
            return None
        x, y, z = spot.tolist()
        return Placement(model, (x, y, z), turn)


def settled(space: Space, placements: Sequence[Placement]) -> list[Placement]:
    """The plan without objects that touch others, and with those on couches at their height.

    Chairs may stand under tables.
    """
    kept: list[Placement] = []
    couch_m = space.boxes["couch"][1, 2]
    for placement in placements:
        may_touch: Sequence[str] = ()
        if placement.model == "bear" and placement.position[2] > LOW_M:
            x, y, z = placement.position
            placement = replace(placement, position=(x, y, z * couch_m / COUCH_TOP_M))
            may_touch = ("couch",)
        class_name = space.models[placement.model].class_name
        if class_name == "chair":
            may_touch = TABLES
        others = [other for other in kept if other.model not in may_touch]
        if class_name in FIXED_CLASSES or space.free(placement, others):
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
    now = dict(history[-1])
    movable = [i for i in now if space.models[models[i]].class_name not in FIXED_CLASSES]
    total = max(1, round(SHARE * len(now)))
    moves = max(1, round(MOVED * total))
    gone = (total - moves) // 2
    order = in_turns(rng, movable, lambda i: models[i] in space.textured)
    low = {i for i in order if now[i].position[2] < LOW_M}
    count = Counter(models[i] for i in now)
    twin = next((i for i in order if count[models[i]] > 1 and i in low), None)
    order.sort(key=lambda i: i != twin)
    touched: set[int] = set()
    for identity in order:
        if len(touched) == moves:
            break
        others = [placement for other, placement in now.items() if other != identity]
        found = space.put(rng, models[identity], identity in low, now[identity], others)
        if found is not None:
            now[identity] = found
            touched.add(identity)
    for identity in [i for i in order if i not in touched][:gone]:
        del now[identity]
        touched.add(identity)
    away = [i for i in models if i not in now and i not in touched]
    for _ in range(total - moves - gone):
        if away and rng.random() < RETURNED:
            identity = away.pop(int(rng.integers(len(away))))
            name = models[identity]
            floor = name in NEW_ON_FLOOR
        else:
            identity = max(models) + 1
            floor = bool(rng.random() < NEW_FLOOR_SHARE)
            name = str(rng.choice(NEW_ON_FLOOR if floor else NEW_ON_TABLE))
        found = space.put(rng, name, floor, None, list(now.values()))
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
