"""Evaluation in 3D: ellipsoids against true solids, after an alignment by the cameras.

Start at `score_objects`. Writes nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import quadrics
from reobj.cameras import Poses, import_pycolmap, invert_rigid
from reobj.files import load_json
from reobj.results.result import Object, Result
from reobj.types import Array, ReobjError, log

MIN_HALF_AXIS = 0.005  # world units of the truth, metres: a sheet is taken as 1 cm thick (chosen)


def read_true_solids(path: Path) -> tuple[list[int], quadrics.Ellipsoids]:
    """Read ids and ellipsoids of a gt_objects.json: `half_axes`, or extents `size` with axes `R`.

    Where an object has a `visible_part`, that is the truth: no camera saw the rest.
    """
    try:
        entries = load_json(path)["objects"]
        seen = [e | e.get("visible_part", {}) for e in entries]
        half = [np.array(e["size"]) / 2 if "R" in e else np.array(e["half_axes"]) for e in seen]
        axes = [np.array(e["R"] if "R" in e else e["world_from_obj"])[:3, :3] for e in seen]
        center = np.array([e["center"] for e in seen], np.float64).reshape(-1, 3)
        half_axes = np.maximum(np.array(half, np.float64).reshape(-1, 3), MIN_HALF_AXIS)
        rotation = np.array(axes, np.float64).reshape(-1, 3, 3)
        return [int(e["id"]) for e in entries], quadrics.Ellipsoids(center, half_axes, rotation)
    except (IndexError, KeyError, TypeError, AttributeError) as error:
        expected = "objects with id, center, size and R, or half_axes and world_from_obj"
        raise ReobjError(f"{path}: {error!r}; expected {expected}") from error


def align_with_truth(result: Result, truth_poses: Path | None) -> tuple[float, Array, Array]:
    """Align the world of the largest part with the truth's by a similarity of the camera centres.

    Poses that the user supplied are in the truth's world already.

    Args:
        truth_poses: TUM, or a 4x4 world_from_cam a line; None is enough for supplied poses.
    Returns:
        scale, rotation (3, 3) and shift (3,): x_in_truth = scale * rotation @ x_in_ours + shift.
    """
    poses = result.of_part(0).poses
    if poses is None:
        raise ReobjError(f"{result.out}: no cameras here, so nothing to compare in 3D; see `run`")
    if poses.source == "user":
        return 1.0, np.eye(3), np.zeros(3)
    if truth_poses is None:
        raise ReobjError("reconstructed cameras have a world of their own: give --gt-poses")
    centers = _true_centers(truth_poses, poses)  # (F, 3)
    use = poses.known & np.isfinite(centers).all(1)
    ours = invert_rigid(poses.cam_from_world[use])[:, :, 3]  # (f, 3)
    true_from_ours = None
    if use.sum() >= 3:  # Umeyama, PAMI 1991
        true_from_ours = import_pycolmap().estimate_sim3d(ours, centers[use])
    if true_from_ours is None:
        raise ReobjError(f"{truth_poses}: {use.sum()} poses in common; 3 or more are needed")
    turn = np.asarray(true_from_ours.rotation.matrix(), np.float64)
    return float(true_from_ours.scale), turn, np.asarray(true_from_ours.translation)


SAME_TIME_S = 0.02  # of a frame and its true pose; chosen: half a frame at 25 Hz


def _true_centers(path: Path, poses: Poses) -> Array:
    """Read camera centres (F, 3) of the poses' frames, NaN where unknown.

    TUM rows belong to the frame of their time; of 4x4 world_from_cam, row n belongs to frame n.
    """
    try:
        table = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise ReobjError(f"{path}: {error}; expected TUM rows or 16 numbers a line") from error
    if table.shape[1] == 16:
        frame = poses.frame.clip(0, len(table) - 1)
        return np.where((frame == poses.frame)[:, None], table[frame][:, 3:12:4], np.nan)
    if table.shape[1] != 8:
        found = f"{table.shape[1]} columns"
        raise ReobjError(f"{path}: {found}; expected TUM rows of 8 numbers, or 16 numbers a line")
    nearest = np.abs(table[:, :1] - poses.time_s[None]).argmin(0)  # (F,)
    far = np.abs(table[nearest, 0] - poses.time_s) > SAME_TIME_S
    return np.where(far[:, None], np.nan, table[nearest, 1:4])


def score_objects(
    result: Result, solids: Path, truth_poses: Path | None, pairs: dict[int, int | None]
) -> dict[str, Any]:
    """Score the ellipsoids against the true ones: O3D (volume IoU), centre and size errors.

    Args:
        solids: gt_objects.json. truth_poses: as in `align_with_truth`.
        pairs: found identity of every true one, or None (`identity_map`): an object counts as found
            only if the identities say so.
    Returns:
        counts and errors by name, centre errors in units of the truth; `o3d_all` counts 0 for every
        true object without ellipsoid; `scale_error`: of our metres per unit, relative.
    """
    ids, truth = read_true_solids(solids)
    located, ours, scale_errors = _solids_in_truth(result, truth_poses)
    row_of = {o.id: row for row, o in enumerate(located)}
    rows = [i for i, t in enumerate(ids) if pairs.get(t) in row_of]  # of the truth
    if not rows:
        return {"true": len(pairs), "found": 0, "o3d_all": 0.0}
    own = np.array([row_of[pairs[ids[i]] or 0] for i in rows])  # of ours
    found, goal = ours[own], truth[np.array(rows)]
    o3d = quadrics.volume_overlap(found, goal)  # (n,)
    error = np.linalg.norm(found.center_in_world - goal.center_in_world, axis=1)  # (n,) truth units
    size = np.abs(np.log(found.half_axes.prod(1) / goal.half_axes.prod(1))) / 3  # (n,) mean side
    each = [
        {"id": ids[i], "object": located[j].id, "class": located[j].class_name, "o3d": a,
         "center_error": b}
        for i, j, a, b in zip(rows, own.tolist(), o3d.tolist(), error.tolist(), strict=True)
    ]  # fmt: skip
    return {
        "true": len(pairs),
        "found": len(rows),
        "o3d_found": float(o3d.mean()),
        "o3d_median": float(np.median(o3d)),
        "o3d_all": float(o3d.sum() / max(len(pairs), 1)),
        "center_error_median": float(np.median(error)),
        "size_error_median": float(np.expm1(np.median(size))),
        "scale_error": scale_errors[0],
        **({"part_scale_errors": scale_errors} if len(scale_errors) > 1 else {}),
        "objects": each,
    }


def _solids_in_truth(
    result: Result, truth_poses: Path | None
) -> tuple[list[Object], quadrics.Ellipsoids, list[float | None]]:
    """Bring the solids into the truth's world, each part by an alignment of its own.

    Returns:
        the located objects of the parts that can be aligned and their ellipsoids; of every part the
        relative error of its metres per unit, None where unknown.
    """
    objects: list[Object] = []
    centers, half_axes, axes = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty((0, 3, 3))]
    scale_errors: list[float | None] = []
    faults: dict[int, ReobjError] = {}
    parts = result.parts()
    for k, part in enumerate(parts):
        scale_errors.append(None)
        try:
            scale, turn, shift = align_with_truth(part, truth_poses)
        except ReobjError as error:
            faults[k] = error
            continue
        ours = part.ellipsoids()
        objects += part.located
        centers.append(ours.center_in_world @ (scale * turn).T + shift)
        half_axes.append(scale * ours.half_axes)
        axes.append(turn @ ours.world_from_obj)
        if part.world.scale is not None and part.world.scale.value:
            scale_errors[k] = abs(part.world.scale.value / scale - 1)
    if len(faults) == len(parts):
        raise faults[0]
    for k, fault in faults.items():
        log.warning("part %d of the cameras is not scored in 3D: %s", k, fault)
    solids = (np.concatenate(arrays) for arrays in (centers, half_axes, axes))
    return objects, quadrics.Ellipsoids(*solids), scale_errors
