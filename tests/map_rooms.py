"""Simulated rooms of objects for the alignment of a recording with a map, without images."""

from __future__ import annotations

import numpy as np

from reobj.maps.object_alignment import Landmarks

SIZE = (5.0, 4.0)  # of a room, m
SHARES = (0.35, 0.15, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)  # of classes; the first: chairs
HALF_AXES = np.array([0.25, 0.45, 0.12, 0.3, 0.15, 0.4, 0.2, 0.35])  # m, mean of each class
HEIGHTS = (0.3, 0.45, 0.8, 1.1)  # of centres, m

Objects = tuple[np.ndarray, np.ndarray, np.ndarray]  # centre (K, 3), class (K,), log size (K,)


def simulated_room(rng: np.random.Generator, count: int) -> Objects:
    """Return objects anywhere in a room."""
    kind = rng.choice(len(SHARES), count, p=SHARES)
    size = np.log(HALF_AXES[kind]) + rng.normal(0, 0.15, count)
    return places(rng, count), kind, size


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return centres (count, 3)."""
    height = rng.choice(HEIGHTS, count) + rng.normal(0, 0.1, count)
    return np.column_stack([rng.uniform((0, 0), SIZE, (count, 2)), height])


def changed(rng: np.random.Generator, room: Objects, share: float = 0.25) -> Objects:
    """Return a room of which a share changed: half of it is gone, half is elsewhere."""
    center, kind, size = room
    rows = rng.choice(len(kind), round(share * len(kind)), replace=False)
    gone = rows[: len(rows) // 2]
    moved = rows[len(rows) // 2 :]
    center = center.copy()
    center[moved] = places(rng, len(moved))
    kept = np.setdiff1d(np.arange(len(kind)), gone)
    return center[kept], kind[kept], size[kept]


def landmarks(rng: np.random.Generator, objects: Objects, sigma: float) -> Landmarks:
    """Measure objects: centres with `sigma` (m), log sizes with .1; without looks."""
    center, kind, size = objects
    count = len(center)
    return Landmarks(
        center + rng.normal(0, sigma, center.shape),
        np.tile(np.eye(3) * sigma**2, (count, 1, 1)),
        np.eye(len(SHARES))[kind],
        size + rng.normal(0, 0.1, count),
        np.full(count, 0.01),
        np.empty((count, 0), np.float32),
    )
