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


def tour_keys(room: Room, seed: int) -> list[tuple[float, tuple[float, float], Any]]:
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
                spot = np.clip(targets[t, :2] + away, -limit, limit)
                aim = targets[t] + rng.normal(0, 0.25, 3)
                stops.append(((float(spot[0]), float(spot[1])), aim))
    return [(i / (len(stops) - 1), spot, aim) for i, (spot, aim) in enumerate(stops)]


TURNS_FROM_TO = (0.3, 0.7)  # of the frames of the path "turn"


def path_keys(room: Room, kind: str, seed: int = 0) -> tuple[Array, Array, Array]:
    """Where the walk passes: time (K,) in 0..1, camera x, y (K, 2), what it looks at (K, 3)."""
    w, d, _ = room.size_m
    dining = (-w / 2 + 1.75, -0.9, 0.62)
    books = (0.3, -d / 2, 0.95)
    desk = (w / 2 - 0.5, -0.5, 0.85)
    couch = (0.6, d / 2 - 0.6, 0.62)
    side = (-w / 2 + 0.3, d / 2 - 1.5, 0.8)
    corner = (w / 2 - 0.4, d / 2 - 0.4, 0.9)
    keys = [
        (0.00, (0.05, 0.85), dining),
        (0.08, (0.85, 0.45), dining),
        (0.15, (1.10, -0.35), dining),
        (0.20, (0.95, -0.75), dining),
        (0.29, (0.70, 0.30), books),
        (0.37, (0.15, 0.85), desk),
        (0.44, (-0.15, 0.10), desk),
        (0.51, (0.10, -0.80), desk),
        (0.57, (-0.35, -1.10), corner),
        (0.62, (0.00, -1.15), couch),
        (0.69, (0.95, -1.00), couch),
        (0.77, (1.35, -0.50), side),
        (0.86, (1.10, -0.10), dining),
        (1.00, (0.15, 0.85), dining),
    ]
    if kind == "walk":
        keys = [(t / 0.77, xy, target) for t, xy, target in keys if t <= 0.77]
    elif kind == "orbit":
        turns = np.radians(np.linspace(-18, 82, 8))
        spots = [(dining[0] + 2.5 * np.cos(a), dining[1] + 2.5 * np.sin(a)) for a in turns]
        keys = [(i / 7, spot, dining) for i, spot in enumerate(spots)]
    elif kind == "tour":
        keys = tour_keys(room, seed)
    elif kind == "turn":
        stop = (1.0, -0.2)
        (first, last) = TURNS_FROM_TO
        keys = [(0.00, (0.05, 0.85), dining), (0.15, (0.85, 0.45), dining), (first, stop, dining)]
        keys += [((first + last) / 2, stop, couch), (last, stop, desk)]
        keys += [(0.85, (0.5, -0.9), desk), (1.00, (-0.4, -1.1), desk)]
    elif kind == "corridor":
        keys = [
            (t, (x, -0.3), (x + 1.2, d / 2, 1.0)) for t, x in ((0, 1 - w / 2), (1, w / 2 - 1.8))
        ]
    elif kind != "revisit":
        raise ValueError(f"path {kind!r} is unknown: use {', '.join(PATHS)}")
    times, spots_xy, targets = zip(*keys, strict=True)
    return np.array(times), np.array(spots_xy), np.array(targets)


def smooth(values: Array, sigma: float) -> Array:
    """Gaussian filter along the first axis of (F, C), ends mirrored in value."""
    reach = max(1, int(3 * sigma))
    head = 2 * values[:1] - values[reach:0:-1]
    tail = 2 * values[-1:] - values[-2 : -reach - 2 : -1]
    padded = np.concatenate([head, values, tail])
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

    fewest = 0.0
    most = float(config.frames)
    for _ in range(40):  # the length grows with the waves
        middle = (fewest + most) / 2
        longer = way(middle)[1][-1] > STEP_M * (config.frames - 1)
        fewest, most = (fewest, middle) if longer else (middle, most)
    points, length = way(fewest)
    distances = np.linspace(0, length[-1], config.frames)
    centers = np.column_stack(
        [np.interp(distances, length, column) for column in points.T]
    )  # (F, 3)
    aim = target + np.random.default_rng([config.seed, 2]).normal(0, 0.05, centers.shape) - centers
    pitch = np.arctan2(aim[:, 2], np.hypot(aim[:, 0], aim[:, 1]))
    return look_along(centers, np.arctan2(aim[:, 1], aim[:, 0]), pitch, np.zeros(config.frames))


def camera_path(room: Room, config: RoomConfig) -> Array:
    """Walk through the room by hand: cam_from_world (F, 3, 4), seeded."""
    if config.path == "table":
        return table_path(room, config)
    rng = np.random.default_rng([config.seed, 2])
    times, spots, targets = path_keys(room, config.path, config.seed)
    aim = targets - np.column_stack([spots, np.full(len(spots), config.eye_m)])  # (K, 3)
    yaw = np.unwrap(np.arctan2(aim[:, 1], aim[:, 0]))
    pitch = np.arctan2(aim[:, 2], np.hypot(aim[:, 0], aim[:, 1]))
    keys = np.column_stack([spots, yaw, pitch])  # (K, 4)
    progress = np.linspace(0, 1, config.frames)
    track = np.column_stack([np.interp(progress, times, column) for column in keys.T])  # (F, 4)
    if config.frames > 20:
        track = smooth(track, 0.03 * config.frames)
    shake = hand_shake(rng, np.arange(config.frames) / config.fps)
    centers = (
        np.column_stack([track[:, :2], np.full(config.frames, config.eye_m)])
        + config.shake_m * shake[:, :3]
    )
    angles = np.radians(config.shake_deg) * shake[:, 3:] * [1, 1, 1.6]
    return look_along(centers, track[:, 2] + angles[:, 0], track[:, 3] + angles[:, 1], angles[:, 2])


def look_along(centers_in_world: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """cam_from_world (F, 3, 4) from camera centres (F, 3) and viewing angles in rad."""
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], -1
    )
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], -1)
    down = np.cross(forward, right)
    c = np.cos(roll)[:, None]
    s = np.sin(roll)[:, None]
    rotation = np.stack(
        [c * right + s * down, c * down - s * right, forward], 1
    )  # (F, 3, 3) rows x, y, z
    offset = -np.einsum("fij,fj->fi", rotation, centers_in_world)
    return np.concatenate([rotation, offset[:, :, None]], 2)
