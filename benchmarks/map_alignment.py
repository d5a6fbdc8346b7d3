#!/usr/bin/env python3
"""How often simulated rooms are aligned with a map by their objects alone.

    python benchmarks/map_alignment.py [--rooms 100]

Rooms of 5 x 4 m with 9, 12 or 20 objects of eight classes (a third are chairs). Between map and
recording a quarter of them changes: half of these are gone, half elsewhere. Centres have a sigma of
10 or 20 cm on both sides, sizes 10 %, the scale 7 %, gravity 1.7 deg; yaw and shift are arbitrary,
and there are no looks. `another` is another room of the same kind, `mirrored` the room x -> -x.
Right: half of the objects less than .5 m from their true places.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.maps.object_alignment import Landmarks, ObjectAlignment, align

SIZE = (5.0, 4.0)
SHARES = (0.35, 0.15, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)  # of classes
HALF_AXES = np.array([0.25, 0.45, 0.12, 0.3, 0.15, 0.4, 0.2, 0.35])  # m, of classes
HEIGHTS = (0.3, 0.45, 0.8, 1.1)
SCALE_SIGMA = 0.07
RIGHT_M = 0.5

Objects = tuple[np.ndarray, np.ndarray, np.ndarray]  # centre (K, 3), class (K,), log size (K,)


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return centres (count, 3) anywhere in the room."""
    height = rng.choice(HEIGHTS, count) + rng.normal(0, 0.1, count)
    return np.column_stack([rng.uniform((0, 0), SIZE, (count, 2)), height])


def simulated_room(rng: np.random.Generator, count: int) -> Objects:
    """Return objects of random classes."""
    kind = rng.choice(len(SHARES), count, p=SHARES)
    return places(rng, count), kind, np.log(HALF_AXES[kind]) + rng.normal(0, 0.15, count)


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


def measured(rng: np.random.Generator, objects: Objects, sigma: float) -> Landmarks:
    """Return objects with noise: `sigma` (m) of the centres, .1 of the log sizes."""
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


def trial(seed: int, count: int, sigma: float, kind: str) -> tuple[ObjectAlignment, bool]:
    """Align one room; return the alignment, and whether its best place is right."""
    rng = np.random.default_rng(seed)
    room = simulated_room(rng, count)
    of_map = measured(rng, room, sigma)
    now = simulated_room(rng, count) if kind == "another" else changed(rng, room)
    if kind == "mirrored":
        now = (now[0] * (-1, 1, 1), *now[1:])
    scale = np.exp(rng.normal(0, SCALE_SIGMA))
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    tilt = Rotation.from_rotvec([*rng.normal(0, 0.03, 2), 0])
    center = (tilt * turn).apply(now[0] - now[0].mean(0)) / scale + rng.normal(0, 3, 3)
    found = measured(rng, (center, now[1], now[2] - np.log(scale)), sigma)
    aligned = align(of_map, found, SCALE_SIGMA)
    if kind != "same" or len(found.center) < 2:
        return aligned, False
    placed = aligned.scale * found.center @ aligned.rotation.T + aligned.shift
    return aligned, bool(np.median(np.linalg.norm(placed - now[0], axis=1)) < RIGHT_M)


def main() -> None:
    """Print the shares of rooms that are placed rightly, wrongly, and refused."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--rooms", type=int, default=100)
    rooms = parser.parse_args().rooms
    print("sigma  objects  room      right  wrong  refused")
    for sigma in (0.1, 0.2):
        for count in (9, 12, 20):
            for kind in ("same", "another", "mirrored"):
                found = [trial(seed, count, sigma, kind) for seed in range(rooms)]
                placed = np.array([aligned.reason == "" for aligned, _ in found])
                right = np.array([good for _, good in found])
                shares = (placed & right).mean(), (placed & ~right).mean(), (~placed).mean()
                numbers = "  ".join(f"{share:5.3f}" for share in shares)
                print(f"{sigma:5.2f}  {count:7d}  {kind:8s}  {numbers}", flush=True)


if __name__ == "__main__":
    main()
