"""Maps of a simulated room with known truth, for the tests of maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reobj.cameras import Camera, quat_wxyz_from_matrix
from reobj.maps.room_map import MapObject, MapPoints, Observation, RoomMap, Session
from reobj.types import Array

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
SIGMA = np.array([0.03] * 3 + [0.05] * 3 + [0.04] * 3)  # centre, log half axes, rotation vector


def true_shape(
    rng: np.random.Generator | None = None,
    center: Sequence[float] = (1.0, 2.0, 0.5),
    half_axes: Sequence[float] = (0.2, 0.3, 0.45),
    yaw_deg: float = 20.0,
    support: str = "box",
) -> dict[str, Any]:
    """Return the fields of an upright shape; with `rng`: a random one of a room."""
    if rng is not None:
        center = (*rng.uniform(-3, 3, 2), rng.uniform(0.2, 1.5))
        half_axes = rng.uniform(0.05, 0.6, 3)
        yaw_deg = rng.uniform(-180, 180)
    rot = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return {
        "support": support, "center": np.array(center, float),
        "half_axes": np.array(half_axes, float), "quat_wxyz": quat_wxyz_from_matrix(rot[None])[0],
    }  # fmt: skip


def turned(shape: dict[str, Any], turn: Array) -> dict[str, Any]:
    """Return the same solid in other axes; turn: (3, 3) rotation of the axes onto themselves."""
    return shape | {
        "half_axes": np.abs(turn).T @ shape["half_axes"],
        "quat_wxyz": quat_wxyz_from_matrix((rotation(shape) @ turn)[None])[0],
    }


def rotation(shape: Any) -> Array:
    """Return world_from_obj (3, 3) of a shape, an observation or a state."""
    quat = shape["quat_wxyz"] if isinstance(shape, dict) else shape.quat_wxyz
    return np.asarray(Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix())


def observed(
    session: int,
    status: str,
    shape: dict[str, Any],
    rng: np.random.Generator | None = None,
    sigma: Array = SIGMA,
    **fields: Any,
) -> Observation:
    """Return an observation with errors drawn from its covariance; without `rng`: exact."""
    error = np.zeros(9) if rng is None else rng.normal(0, sigma)
    rot = rotation(shape) @ Rotation.from_rotvec(error[6:]).as_matrix()
    measured = shape | {
        "center": shape["center"] + error[:3],
        "half_axes": shape["half_axes"] * np.exp(error[3:6]),
        "quat_wxyz": quat_wxyz_from_matrix(rot[None])[0],
    }
    usual = {"classes": {"chair": 5.0}, "views": 10, "expected": 10, "log_odds": 2.0}
    return Observation(session, status, cov=np.diag(sigma**2), **measured, **usual | fields)


def a_session(number: int, **fields: Any) -> Session:
    """Return a session of a recording with metric scale from size priors of 5 %."""
    usual: dict[str, Any] = {
        "name": f"day{number}.mp4", "date": f"2026-03-{number:02d}T10:00:00Z",
        "fingerprint": f"{number:064x}", "embedder": "net", "metres_per_unit": 1.0,
        "scale_rel_sigma": 0.05, "scale_source": "priors", "localised_frames": 9,
        "tried_frames": 10,
    }  # fmt: skip
    return Session(number, **usual | fields)


def descriptors(rng: np.random.Generator, count: int) -> Any:
    """Random descriptors of the norm of RootSIFT."""
    values = rng.gamma(0.3, size=(count, 128))
    return np.minimum(512 * np.sqrt(values / values.sum(1, keepdims=True)), 255).astype(np.uint8)


def some_points(count: int, sessions: int, ids: Sequence[int], seed: int = 0) -> MapPoints:
    """Return points with random descriptors; a quarter of them lie on objects."""
    rng = np.random.default_rng(seed)
    ray = rng.normal(size=(count, 3))
    object_id = rng.choice([0, 0, 0, *([0] if not ids else [1])], count)
    object_id[object_id > 0] = rng.choice([*ids, 0], int((object_id > 0).sum()))
    return MapPoints(
        rng.uniform(-3, 3, (count, 3)), rng.integers(0, 120, (count, 128), np.uint8),
        rng.integers(1, sessions + 1, count), object_id,
        ray / np.linalg.norm(ray, axis=1, keepdims=True), rng.uniform(1, 5, count),
    )  # fmt: skip


def a_map(objects: Sequence[Sequence[Observation]], **fields: Any) -> RoomMap:
    """Return an upright map of objects numbered from 1, with the sessions of their observations."""
    numbers = sorted({o.session for observations in objects for o in observations})
    found = tuple(MapObject(k, tuple(o)) for k, o in enumerate(objects, 1))
    usual: dict[str, Any] = {
        "map_id": "0" * 32, "sessions": tuple(a_session(n) for n in numbers), "objects": found,
        "up": np.array([0.0, 0.0, 1.0]), "next_id": len(found) + 1,
        "next_session": max(numbers, default=0) + 1,
    }  # fmt: skip
    return RoomMap(**usual | fields)


def random_map(objects: int, sessions: int, points: int, embedding: int, seed: int = 0) -> RoomMap:
    """Return a map of random objects, each detected in every session at the same place."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(objects):
        shape = true_shape(rng)
        row = []
        for number in range(1, sessions + 1):
            o = observed(number, "new" if number == 1 else "stayed", shape, rng, embedded=8)
            mixed = rng.normal(size=(9, 9)) * SIGMA[:, None]
            vectors = rng.normal(size=(2, embedding)).astype(np.float32)
            vectors /= np.linalg.norm(vectors, axis=1, keepdims=True).clip(1e-9)
            cov = mixed @ mixed.T / 9 + np.diag(SIGMA**2)
            means = {"foreground": vectors[0], "background": vectors[1]}
            row.append(dataclasses.replace(o, cov=cov, **means))
        rows.append(row)
    found = a_map(rows)
    ids = [o.id for o in found.objects]
    return dataclasses.replace(found, points=some_points(points, max(sessions, 1), ids, seed))
