"""Camera intrinsics and camera paths."""

from __future__ import annotations

from typing import Any

import numpy as np

from rendering.config import PATHS, Array, Rng, RoomConfig
from rendering.surfaces import Room


def camera_matrix(config: RoomConfig) -> Array:
    """(3, 3) pinhole intrinsics in COLMAP pixels: the principal point is the image's middle."""
    focal = 0.5 * config.width / np.tan(np.radians(config.hfov_deg) / 2)
    return np.array([[focal, 0, config.width / 2], [0, focal, config.height / 2], [0, 0, 1.0]])


Keys = list[tuple[float, tuple[float, float], Any]]  # time in 0..1, camera x, y, what it looks at


def tour_keys(room: Room, seed: int) -> Keys:
    """Twice past every table, desk and couch, in another order and from another side."""
    rng = np.random.default_rng([seed, 6])
    large = [o for o in room.objects if o.class_name in ("dining table", "couch")]
    targets = np.array([o.center_in_world for o in large or room.objects])  # (T, 3)
    angle = rng.uniform(0, 2 * np.pi, len(targets))
    limit = np.array(room.size_m[:2]) / 2 - 0.5
    stops = []
    for _ in range(2):
        for t in rng.permutation(len(targets)):
            turn = angle[t] + rng.normal(0, 0.6)
            for step in (0.0, rng.normal(0, 0.5)):
                away = rng.uniform(1.1, 3.0) * np.array([np.cos(turn + step), np.sin(turn + step)])
                x, y = np.clip(targets[t, :2] + away, -limit, limit).tolist()
                stops.append(((x, y), targets[t] + rng.normal(0, 0.25, 3)))
    return [(i / (len(stops) - 1), spot, aim) for i, (spot, aim) in enumerate(stops)]


TURNS_FROM_TO = (0.3, 0.7)  # of the frames of the path "turn"


def spot_keys(room: Room) -> Keys:
    """Twice round on the free spot that is farthest from walls and objects, looking up and down."""
    limit = np.array(room.size_m[:2]) / 2
    grid = np.meshgrid(*(np.arange(-x + 0.4, x - 0.4, 0.1) for x in limit))
    spots = np.stack(grid, -1).reshape(-1, 2)
    free = (limit - np.abs(spots)).min(1)
    for o in room.objects:
        away = np.linalg.norm(spots - o.center_in_world[:2], axis=1)
        free = np.minimum(free, away - np.linalg.norm(o.size_m[:2]) / 2)
    x, y = spots[free.argmax()].tolist()
    steps = np.linspace(0, 1, 25)
    yaw = 4 * np.pi * steps
    down = np.radians(14 + 8 * np.sin(2.7 * yaw))
    aims = np.column_stack([x + np.cos(yaw), y + np.sin(yaw), RoomConfig().eye_m - np.tan(down)])
    return [(t, (x, y), aim) for t, aim in zip(steps.tolist(), aims, strict=True)]


def path_keys(room: Room, kind: str, seed: int) -> tuple[Array, Array, Array]:
    """Where the walk passes: time (K,) in 0..1, camera x, y (K, 2), what it looks at (K, 3)."""
    w, d, _ = room.size_m
    dining = (-w / 2 + 1.75, -0.9, 0.62)
    books = (0.3, -d / 2, 0.95)
    desk = (w / 2 - 0.5, -0.5, 0.85)
    couch = (0.6, d / 2 - 0.6, 0.62)
    side = (-w / 2 + 0.3, d / 2 - 1.5, 0.8)
    corner = (w / 2 - 0.4, d / 2 - 0.4, 0.9)
    revisit: Keys = [
        (0.00, (0.05, 0.85), dining), (0.08, (0.85, 0.45), dining), (0.15, (1.10, -0.35), dining),
        (0.20, (0.95, -0.75), dining), (0.29, (0.70, 0.30), books), (0.37, (0.15, 0.85), desk),
        (0.44, (-0.15, 0.10), desk), (0.51, (0.10, -0.80), desk), (0.57, (-0.35, -1.10), corner),
        (0.62, (0.00, -1.15), couch), (0.69, (0.95, -1.00), couch), (0.77, (1.35, -0.50), side),
        (0.86, (1.10, -0.10), dining), (1.00, (0.15, 0.85), dining),
    ]  # fmt: skip
    orbit = []
    for i, angle in enumerate(np.radians(np.linspace(-18, 82, 8))):
        spot = (dining[0] + 2.5 * np.cos(angle), dining[1] + 2.5 * np.sin(angle))
        orbit.append((i / 7, spot, dining))
    stop = (1.0, -0.2)
    first, last = TURNS_FROM_TO
    turn = [
        (0.00, (0.05, 0.85), dining), (0.15, (0.85, 0.45), dining), (first, stop, dining),
        ((first + last) / 2, stop, couch), (last, stop, desk), (0.85, (0.5, -0.9), desk),
        (1.00, (-0.4, -1.1), desk),
    ]  # fmt: skip
    ends = ((0.0, 1 - w / 2), (1.0, w / 2 - 1.8))
    paths: dict[str, Keys] = {
        "revisit": revisit,
        "walk": [(t / 0.77, xy, target) for t, xy, target in revisit if t <= 0.77],
        "orbit": orbit,
        "tour": tour_keys(room, seed),
        "turn": turn,
        "spot": spot_keys(room),
        "corridor": [(t, (x, -0.3), (x + 1.2, d / 2, 1.0)) for t, x in ends],
    }
    if kind not in paths:
        raise ValueError(f"path {kind!r} is unknown: use {', '.join(PATHS)}")
    times, spots_xy, targets = zip(*paths[kind], strict=True)
    return np.array(times), np.array(spots_xy), np.array(targets)


def smooth(values: Array, sigma: float) -> Array:
    """Gaussian filter along the first axis of (F, C), ends mirrored in value."""
    reach = max(1, int(3 * sigma))
    padded = np.pad(values, ((reach, reach), (0, 0)), "reflect", reflect_type="odd")
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    columns = [np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T]
    return np.stack(columns, 1)


def hand_shake(rng: Rng, seconds: Array) -> Array:
    """(F, 6) smooth unrest of about unit size: steps, sway, tremble."""
    wave = np.zeros((len(seconds), 6))
    for low, high, size in ((0.15, 0.5, 0.8), (0.7, 1.2, 0.6), (1.6, 2.2, 0.5)):
        rates = rng.uniform(low, high, 6)
        phases = rng.uniform(0, 2 * np.pi, 6)
        wave += size * np.sin(2 * np.pi * rates * seconds[:, None] + phases)
    return wave


STEP_M = 0.28  # between two photos of the path "table" (those of a recorded orbit)
EYE_RANGE_M = (0.95, 1.85)  # their heights: kneeling to standing
WALL_MARGIN_M = 0.35  # of the path "table"


def table_path(room: Room, config: RoomConfig) -> Array:
    """Photos once round the table with most space about it, weaving up and down, looking at it.

    Returns:
        cam_from_world (F, 3, 4), STEP_M apart along the way; few photos go straight round.
    Raises: ValueError for a room without a table.
    """
    limit = np.array(room.size_m[:2]) / 2
    tables = [o.center_in_world for o in room.objects if o.class_name == "dining table"]
    if not tables:
        raise ValueError("path 'table' needs a room with a dining table")
    space, at = max(((limit - np.abs(t[:2])).min(), -i) for i, t in enumerate(tables))
    target = tables[-at]
    radius = space - WALL_MARGIN_M
    low, high = EYE_RANGE_M

    def way(waves: float) -> tuple[Array, Array]:
        """Dense points (N, 3) of the path with some waves, and the arc length (N,) of each."""
        turn = np.linspace(0, 2 * np.pi, 20000)
        up = 0.5 * (high + low + (high - low) * np.sin(waves * turn))
        xy = target[:2] + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        points = np.column_stack([xy, up])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return points, np.concatenate([[0.0], np.cumsum(steps)])

    waves = 0.0
    step = config.frames / 2
    for _ in range(40):  # the length grows with the waves
        if way(waves + step)[1][-1] <= STEP_M * (config.frames - 1):
            waves += step
        step /= 2
    points, length = way(waves)
    distances = np.linspace(0, length[-1], config.frames)
    centers = np.column_stack([np.interp(distances, length, x) for x in points.T])  # (F, 3)
    aim = target + np.random.default_rng([config.seed, 2]).normal(0, 0.05, centers.shape) - centers
    return look_along(centers, *angles_to(aim), np.zeros(config.frames))


def walk(config: RoomConfig, rng: Rng, times: Array, keys: Array, sigma: float) -> Array:
    """A hand-held path through keys: cam_from_world (F, 3, 4).

    Args:
        times: (K,) in increasing order. keys: (K, 5) centre (m), yaw and pitch (rad).
        sigma: of the smoothing, a fraction of the frames.
    """
    at = np.linspace(times[0], times[-1], config.frames)
    track = np.column_stack([np.interp(at, times, column) for column in keys.T])  # (F, 5)
    if config.frames > 20:
        track = smooth(track, sigma * config.frames)
    shake = hand_shake(rng, np.arange(config.frames) / config.fps)
    centers = track[:, :3] + config.shake_m * shake[:, :3]
    angles = np.radians(config.shake_deg) * shake[:, 3:] * [1, 1, 1.6]
    return look_along(centers, track[:, 3] + angles[:, 0], track[:, 4] + angles[:, 1], angles[:, 2])


def angles_to(aim: Array) -> tuple[Array, Array]:
    """Yaw and pitch (N,) in rad of directions (N, 3)."""
    return np.arctan2(aim[:, 1], aim[:, 0]), np.arctan2(aim[:, 2], np.hypot(aim[:, 0], aim[:, 1]))


def camera_path(room: Room, config: RoomConfig) -> Array:
    """Walk through the room by hand: cam_from_world (F, 3, 4), seeded."""
    if config.path == "table":
        return table_path(room, config)
    times, spots, targets = path_keys(room, config.path, config.seed)
    centers = np.column_stack([spots, np.full(len(spots), config.eye_m)])  # (K, 3)
    yaw, pitch = angles_to(targets - centers)
    keys = np.column_stack([centers, np.unwrap(yaw), pitch])
    return walk(config, np.random.default_rng([config.seed, 2]), times, keys, 0.03)


def look_along(centers_in_world: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """cam_from_world (F, 3, 4) from camera centres (F, 3) and viewing angles in rad."""
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], -1
    )
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], -1)
    down = np.cross(forward, right)
    c = np.cos(roll)[:, None]
    s = np.sin(roll)[:, None]
    rotation = np.stack([c * right + s * down, c * down - s * right, forward], 1)  # (F, 3, 3)
    offset = -np.einsum("fij,fj->fi", rotation, centers_in_world)
    return np.concatenate([rotation, offset[:, :, None]], 2)
