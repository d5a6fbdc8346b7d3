"""The camera's walk through a flat and back."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from rendering.camera import hand_shake, look_along, smooth
from rendering.config import Array, Rng, RoomConfig
from rendering.flat import (
    CELL_M,
    ENTRY_M,
    WALL_M,
    Flat,
    RoomPlan,
    box_distances,
    grid_points,
    reachable,
)

WALK_M_S = 0.55  # fastest planned step; hand shake adds up to 0.2 m/s
TURN_DEG_S = 34.0  # fastest planned turn; hand shake adds up to 8 deg/s
LOOK_S = 0.8  # least time between two viewing directions
SMOOTH_S = 0.5  # standard deviation of the filter along the time
STOP_CLEARANCE_M = 0.4  # where the planned path changes its direction of view
STOPS = 60  # candidates per visit of a room
AIM_M = (1.2, 4.5)  # distance to what the camera looks at
WALL_AIM_M = 2.2  # least distance to a piece of wall: a close one shows little


@dataclass(frozen=True, slots=True)
class Key:
    """A point of the walk with a direction of view."""

    way: Array  # (M, 2) world points from the previous key to this one, both included
    yaw: float  # rad, not unwrapped
    pitch: float  # rad


class Router:
    """Shortest free ways between points of one room, in the room's frame."""

    def __init__(self, plan: RoomPlan) -> None:
        self.points, (self.columns, self.rows) = grid_points(plan.size_m)
        self.free = reachable(plan.size_m, plan.boxes, plan.doors).ravel()  # (P,) m, 0: not free
        self._known: dict[int, tuple[Array, list[int]]] = {}

    def cell(self, spot: Array) -> int:
        """The free cell nearest to a point (2,)."""
        away = np.linalg.norm(self.points - spot, axis=1)
        return int(np.where(self.free > 0, away, np.inf).argmin())

    def _from(self, start: int) -> tuple[Array, list[int]]:
        """Costs (P,) of the ways from a cell, and the cell before each (Dijkstra)."""
        if start in self._known:
            return self._known[start]
        weight = np.where(self.free > 0, 1 + (0.4 / np.maximum(self.free, 0.1)) ** 2, np.inf)
        price = weight.tolist()
        cost = [np.inf] * len(price)
        before = [-1] * len(price)
        cost[start] = 0.0
        steps = [(u, v, CELL_M * np.hypot(u, v)) for u in (-1, 0, 1) for v in (-1, 0, 1) if u or v]
        queue = [(0.0, start)]
        while queue:
            spent, cell = heapq.heappop(queue)
            if spent > cost[cell]:
                continue
            row, column = divmod(cell, self.columns)
            for u, v, length in steps:
                if not (0 <= column + u < self.columns and 0 <= row + v < self.rows):
                    continue
                other = cell + v * self.columns + u
                total = spent + length * price[other]
                if total < cost[other]:
                    cost[other] = total
                    before[other] = cell
                    heapq.heappush(queue, (total, other))
        self._known[start] = (np.array(cost), before)
        return self._known[start]

    def cost(self, start: int, ends: list[int]) -> Array:
        """(E,) costs of the ways from a cell to others: metres, more where it is narrow."""
        return np.asarray(self._from(start)[0][ends])

    def way(self, start: int, end: int) -> Array:
        """(M, 2) points from one cell to another, in the room's frame."""
        before = self._from(start)[1]
        cells = [end]
        while cells[-1] != start:
            cells.append(before[cells[-1]])
        return np.asarray(self.points[cells[::-1]])


@dataclass(frozen=True, slots=True)
class Stop:
    """Where the camera looks at something: a free cell of the room, and two angles in rad."""

    cell: int
    yaw: float
    pitch: float


def look_at(spot: Array, target: Array, eye_m: float) -> tuple[float, float]:
    """Yaw and pitch in rad from a standing point (2,) to a target (3,), same frame."""
    away = target - [*spot, eye_m]
    yaw = float(np.arctan2(away[1], away[0]))
    return yaw, float(np.arctan2(away[2], np.hypot(away[0], away[1])))


def stops_of(rng: Rng, plan: RoomPlan, router: Router, eye_m: float) -> list[Stop]:
    """Points spread over the free floor, looking at furniture and walls seen least so far."""
    w, d, _ = plan.size_m
    targets = [np.array([*p.position[:2], 0.7]) for p in plan.placements if p.position[2] < 0.1]
    targets += [np.array([x, y, 1.2]) for x in (-w / 2, 0, w / 2) for y in (-d / 2, d / 2)]
    targets += [np.array([x, 0.0, 1.2]) for x in (-w / 2, w / 2)]
    furniture = len(targets) - 8
    least = np.where(np.arange(len(targets)) < furniture, AIM_M[0], WALL_AIM_M)
    aims = np.array(targets)
    seen = np.zeros(len(aims))
    wide = np.nonzero(router.free >= min(STOP_CLEARANCE_M, 0.95 * router.free.max()))[0]
    nearest = np.full(len(wide), np.inf)
    chosen = int(rng.integers(len(wide)))
    stops = []
    for _ in range(min(STOPS, len(wide))):
        spot = router.points[wide[chosen]]
        away = np.linalg.norm(aims[:, :2] - spot, axis=1)
        fits = (away > least) & (away < AIM_M[1])
        order = seen + rng.uniform(0, 0.9, len(aims)) + 99 * ~fits
        pick = int(order.argmin())
        seen += np.linalg.norm(aims - aims[pick], axis=1) < 1.0
        yaw, pitch = look_at(spot, aims[pick] + rng.normal(0, 0.15, 3), eye_m)
        stops.append(Stop(int(wide[chosen]), yaw, pitch))
        nearest = np.minimum(nearest, np.linalg.norm(router.points[wide] - spot, axis=1))
        far = np.nonzero(nearest > 0.7 * nearest.max())[0]
        chosen = int(far[rng.integers(len(far))])
    return stops


def in_order(router: Router, first: int, stops: list[Stop]) -> list[Stop]:
    """The nearest stop next, from a first cell."""
    left = list(stops)
    ordered = []
    here = first
    while left:
        costs = router.cost(here, [s.cell for s in left])
        ordered.append(left.pop(int(costs.argmin())))
        here = ordered[-1].cell
    return ordered


class Walk:
    """The keys of a walk through all rooms and back, with any number of stops."""

    def __init__(self, config: RoomConfig, plans: list[RoomPlan], offsets: Array) -> None:
        self.plans = plans
        self.offsets = offsets[:, :2]
        self.visits = [*range(len(plans)), *range(len(plans) - 2, -1, -1)]
        self.routers = [Router(plan) for plan in plans]
        self.stops = []
        for number, index in enumerate(self.visits):
            rng = np.random.default_rng([config.seed, 26, number])
            self.stops.append(stops_of(rng, plans[index], self.routers[index], config.eye_m))
        self.start = self.stops[0][0]

    def entry(self, index: int, side: int) -> tuple[int, Array]:
        """The cell in front of a door of a room, and the point there (2,) in the room's frame."""
        plan = self.plans[index]
        spot = np.array([side * (plan.size_m[0] / 2 - ENTRY_M), plan.doors[side]])
        return self.routers[index].cell(spot), spot

    def keys(self, count: int) -> list[Key]:
        """The walk with this many stops in all, spread over the visits."""
        keys = []
        here = self.start.cell
        last = len(self.visits) - 1
        for number, index in enumerate(self.visits):
            router = self.routers[index]
            origin = self.offsets[index]
            stops = self.stops[number][: (count + number) // (last + 1)]
            if number == 0:
                stops = [self.start, *in_order(router, here, stops[1:])]
            else:
                stops = in_order(router, here, stops)
            if number == last:
                stops.append(self.start)
            for stop in stops:
                keys.append(Key(router.way(here, stop.cell) + origin, stop.yaw, stop.pitch))
                here = stop.cell
            if number < last:
                step = self.visits[number + 1] - index
                exit_cell, spot = self.entry(index, step)
                yaw = 0.0 if step > 0 else np.pi
                way = np.concatenate([router.way(here, exit_cell), [spot]])
                keys.append(Key(way + origin, yaw, -0.12))
                here, beyond = self.entry(index + step, -step)
                next_origin = self.offsets[index + step]
                through = np.stack([spot + origin, beyond + next_origin])
                keys.append(Key(through, yaw, -0.12))
        return keys


def timed(keys: list[Key]) -> tuple[Array, Array]:
    """Times (M,) in s at the planned limits, and x, y in m, yaw, pitch in rad (M, 4) at them."""
    times = [0.0]
    rows = [[*keys[0].way[-1], keys[0].yaw, keys[0].pitch]]
    for key in keys[1:]:
        turn = (key.yaw - rows[-1][2] + np.pi) % (2 * np.pi) - np.pi
        tilt = key.pitch - rows[-1][3]
        steps = np.linalg.norm(np.diff(np.concatenate([[rows[-1][:2]], key.way]), axis=0), axis=1)
        length = np.cumsum(steps)
        limit = np.radians(TURN_DEG_S)
        needed = max(float(length[-1]) / WALK_M_S, np.hypot(turn, tilt) / limit, LOOK_S)
        start = times[-1]
        yaw, pitch = rows[-1][2:]
        for point, gone in zip(key.way, length / max(length[-1], 1e-9), strict=True):
            times.append(start + needed * float(gone))
            rows.append([*point, yaw + turn * gone, pitch + tilt * gone])
        if length[-1] == 0:  # a turn on the spot
            times[-1] = start + needed
            rows[-1] = [*key.way[-1], yaw + turn, key.pitch]
    kept = np.concatenate([[True], np.diff(times) > 0])
    return np.array(times)[kept], np.array(rows)[kept]


def walk_path(config: RoomConfig, plans: list[RoomPlan], offsets: Array) -> Array:
    """cam_from_world (F, 3, 4) of a walk through all rooms and back to its first view.

    The number of stops is chosen so that the walk takes the clip's time below the limits of speed.
    Args:
        plans: the rooms. offsets: (R, 3) their origins in world, m.
    Raises: ValueError if the clip is too short for the walk.
    """
    walk = Walk(config, plans, offsets)
    seconds = (config.frames - 1) / config.fps
    fewest = len(walk.visits)
    most = STOPS * len(walk.visits)
    shortest = timed(walk.keys(fewest))[0][-1]
    if shortest > seconds:
        raise ValueError(
            f"{config.frames} frames at {config.fps:g} fps are too few for a walk through "
            f"{len(plans)} rooms: use at least {int(shortest * config.fps) + 2} (and --stride)"
        )
    while most - fewest > 1:
        middle = (fewest + most) // 2
        if timed(walk.keys(middle))[0][-1] <= seconds:
            fewest = middle
        else:
            most = middle
    times, rows = timed(walk.keys(fewest))
    frame_s = np.arange(config.frames) / config.fps
    at = frame_s * (times[-1] / max(seconds, 1e-9))
    track = np.column_stack([np.interp(at, times, column) for column in rows.T])  # (F, 4)
    track = smooth(track, SMOOTH_S * config.fps)
    shake = hand_shake(np.random.default_rng([config.seed, 27]), frame_s)
    eyes = np.full(config.frames, config.eye_m)
    centers = np.column_stack([track[:, :2], eyes]) + config.shake_m * shake[:, :3]
    angles = np.radians(config.shake_deg) * shake[:, 3:] * [1, 1, 1.6]
    return look_along(centers, track[:, 2] + angles[:, 0], track[:, 3] + angles[:, 1], angles[:, 2])


def clearance_m(flat: Flat, points: Array) -> Array:
    """(P,) distance in m from world points (P, 3) to furniture and walls beside them, seen from
    above; furniture counts with the rectangle that holds it.
    """
    rooms = (points[:, :1] > flat.doors[:, 0]).sum(1)  # (P,)
    distance = np.full(len(points), np.inf)
    for index, boxes in enumerate(flat.boxes):
        reach = flat.sizes[index, 0] / 2 + WALL_M + 1.0
        near = np.abs(points[:, 0] - flat.offsets[index, 0]) < reach
        near &= np.abs(rooms - index) < 2
        for chunk in np.array_split(np.nonzero(near)[0], 1 + near.sum() // 4000):
            if len(chunk):
                found = box_distances(points[chunk, :2], boxes)
                distance[chunk] = np.minimum(distance[chunk], found)
    return distance
