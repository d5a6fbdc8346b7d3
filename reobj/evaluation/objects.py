"""Evaluation in 3D: ellipsoids against true objects, after an alignment of the cameras.

Start at `score_objects`. Writes no files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.cameras import Poses, import_pycolmap, invert_rigid
from reobj.files import load_json
from reobj.formats import AUTO
from reobj.poses.supplied.frame_assignment import rows_by_time, seconds_of
from reobj.poses.supplied.readers import read_pose_file
from reobj.results.result import Object, Result
from reobj.types import Array, ReobjError, log

MIN_HALF_AXIS = 0.005  # m, as the truth: sheets count as 1 cm thick; volume IoU needs a volume


def read_true_objects(path: Path) -> tuple[list[int], quadrics.Ellipsoids]:
    """Read ids and ellipsoids of a gt_objects.json: `half_axes`, or extents `size` with axes `R`.

    The `visible_part` of an object, if given, is the truth: no camera saw the rest.
    """
    rows = []  # (15,) each: centre, half axes, axes
    data = load_json(path)
    try:
        entries = data["objects"]
        ids = [int(entry["id"]) for entry in entries]
        for entry in entries:
            seen = entry | entry.get("visible_part", {})
            half = np.array(seen["size"]) / 2 if "R" in seen else seen["half_axes"]
            axes = np.array(seen["R"] if "R" in seen else seen["world_from_obj"])[:3, :3]
            rows.append(np.concatenate([seen["center"], half, axes.ravel()]).astype(np.float64))
        table = np.array(rows).reshape(-1, 15)
        if not np.isfinite(table).all():
            raise ValueError("a number is not finite")
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        expected = "objects with id, center, size and R, or half_axes and world_from_obj"
        raise ReobjError(f"{path}: {error!r}; expected {expected}") from error
    half_axes = np.maximum(table[:, 3:6], MIN_HALF_AXIS)
    return ids, quadrics.Ellipsoids(table[:, :3], half_axes, table[:, 6:].reshape(-1, 3, 3))


def align_with_truth(result: Result, truth_poses: Path | None) -> tuple[float, Array, Array]:
    """Align the world of the largest component with the truth's by a similarity of the cameras.

    Supplied poses are in the world of the truth already. Camera centres of a short trajectory
    determine the rotation poorly, which displaces distant objects: if the camera axes follow the
    same convention as the truth's, their directions are aligned too.

    Args:
        truth_poses: in any format of poses; may be None for supplied poses.
    Returns:
        scale, rotation (3, 3) and shift (3,): x_in_truth = scale * rotation @ x_in_ours + shift.
    """
    poses = result.of_part(0).poses
    if poses is None:
        raise ReobjError(f"{result.out}: no cameras, so there is no evaluation in 3D; see `run`")
    if poses.source == "user":
        return 1.0, np.eye(3), np.zeros(3)
    if truth_poses is None:
        raise ReobjError(
            "reconstructed cameras use an arbitrary frame; give --gt-poses to align them"
        )
    truth = _true_cameras(truth_poses, poses)  # (F, 3, 4)
    use = poses.known & np.isfinite(truth[:, :, 3]).all(1)
    estimated = invert_rigid(poses.cam_from_world[use])  # (f, 3, 4)
    truth = truth[use]
    if poses.is_spot and len(truth):  # only directions, in metres by the usual sizes
        turn = Rotation.from_matrix(truth[:, :, :3] @ estimated[:, :, :3].swapaxes(1, 2)).mean()
        return 1.0, turn.as_matrix(), np.median(truth[:, :, 3], axis=0)
    similarity = _similarity(estimated[:, :, 3], truth[:, :, 3]) if use.sum() >= 3 else None
    if similarity is None:
        raise ReobjError(f"{truth_poses}: {use.sum()} poses in common; 3 or more are needed")
    scale, rotation, _ = similarity
    residual = rotation @ estimated[:, :, :3] @ truth[:, :, :3].swapaxes(1, 2)  # (f, 3, 3)
    cosine = (np.trace(residual, axis1=1, axis2=2) - 1) / 2  # of its angle
    centers = result.of_part(0).ellipsoids().center_in_world  # (S, 3)
    # other conventions of the camera axes differ by 90 or 180 deg
    if not len(centers) or not np.median(cosine) > math.cos(math.radians(10)):
        return similarity
    distance = float(np.median(np.linalg.norm(centers[:, None] - estimated[:, :, 3], axis=2)))
    points = [
        np.concatenate([cams[:, :, 3], *(cams[:, :, 3] + d * cams[:, :, k] for k in range(3))])
        for cams, d in ((estimated, distance), (truth, scale * distance))
    ]  # (4 f, 3) each: centres, and points on the camera axes at the distance of the objects
    return _similarity(*points) or similarity


def _similarity(estimated: Array, truth: Array) -> tuple[float, Array, Array] | None:
    """Estimate scale, rotation and translation from points (N, 3) to points; None: degenerate."""
    similarity = import_pycolmap().estimate_sim3d(estimated, truth)
    if similarity is None:
        return None
    rotation = np.asarray(similarity.rotation.matrix(), np.float64)
    return float(similarity.scale), rotation, np.asarray(similarity.translation)


def _true_cameras(path: Path, poses: Poses) -> Array:
    """Read world_from_cam (F, 3, 4) of the poses' frames, NaN where unknown.

    Rows with time stamps are matched to frames by time; of others, row n is frame n.
    """
    found = read_pose_file(path, AUTO, (poses.camera.width, poses.camera.height))
    if found.stamps is None:
        row = np.where(poses.frame < len(found.cam_from_world), poses.frame, -1)
    else:
        stamps_s = seconds_of(found.stamps, found.unit)
        row = rows_by_time(stamps_s, poses.frame, poses.time_s)
    return np.where((row < 0)[:, None, None], np.nan, invert_rigid(found.cam_from_world)[row])


def score_objects(
    result: Result, solids: Path, truth_poses: Path | None, pairs: dict[int, int | None]
) -> dict[str, Any]:
    """Score the ellipsoids against the true ones: O3D (volume IoU), centre and size errors.

    Args:
        solids: gt_objects.json. truth_poses: as in `align_with_truth`.
        pairs: identity matched to each true one, or None (`identity_map`); objects are matched by
            identity only.
    Returns:
        counts and errors by name, centre errors in units of the truth; `o3d_all`: 0 for every true
        object without an ellipsoid; `sizes_inside`: fraction of the sides within 2 sigma, apart
        from the scale; `scale_error`: relative error of our metres per unit.
    """
    ids, truth = read_true_objects(solids)
    located, estimated, scale_errors = _ellipsoids_in_truth(result, truth_poses)
    row_of = {o.id: row for row, o in enumerate(located)}
    rows = [i for i, t in enumerate(ids) if pairs.get(t) in row_of]  # of the truth
    if not rows:
        return {"true": len(pairs), "found": 0, "o3d_all": 0.0}
    our_rows = np.array([row_of[pairs[ids[i]] or 0] for i in rows])
    fitted = estimated[our_rows]
    true = truth[np.array(rows)]
    o3d = quadrics.volume_overlap(fitted, true)  # (n,)
    error = np.linalg.norm(
        fitted.center_in_world - true.center_in_world, axis=1
    )  # (n,) truth units
    size = np.abs(np.log(fitted.half_axes.prod(1) / true.half_axes.prod(1))) / 3  # (n,) mean side
    each = [
        {"id": ids[i], "object": located[j].id, "class": located[j].class_name, "o3d": a,
         "center_error": b}
        for i, j, a, b in zip(rows, our_rows.tolist(), o3d.tolist(), error.tolist(), strict=True)
    ]  # fmt: skip
    return {
        "true": len(pairs),
        "found": len(rows),
        "o3d_found": float(o3d.mean()),
        "o3d_median": float(np.median(o3d)),
        "o3d_all": float(o3d.sum() / max(len(pairs), 1)),
        "center_error_median": float(np.median(error)),
        "size_error_median": float(np.expm1(np.median(size))),
        "sizes_inside": _sizes_inside([located[row].cov for row in our_rows], fitted, true),
        "scale_error": scale_errors[0],
        **({"part_scale_errors": scale_errors} if len(scale_errors) > 1 else {}),
        "objects": each,
    }


def _sizes_inside(
    covs: Sequence[Array | None], fitted: quadrics.Ellipsoids, true: quadrics.Ellipsoids
) -> float | None:
    """Return the fraction of the log sides along the true axes within 2 sigma of the truth.

    Args:
        covs: (9, 9) each (`Object.cov`), or None: its sides do not count. fitted, true: the
            ellipsoids and the true ones, in one world.
    Returns:
        None if no side counts.
    """
    cosine = np.abs(true.world_from_obj.swapaxes(1, 2) @ fitted.world_from_obj)  # (n, true, own)
    orders = quadrics.AXIS_ORDERS
    best = orders[cosine[:, np.arange(3), orders].sum(2).argmax(1)]  # (n, 3) own axis of each true
    variance = np.array([np.full(3, np.nan) if c is None else c.diagonal()[3:6] for c in covs])
    error = np.log(np.take_along_axis(fitted.half_axes, best, 1) / true.half_axes)
    in_sigma = error / np.sqrt(np.take_along_axis(variance, best, 1))
    known = np.abs(in_sigma[np.isfinite(in_sigma)])
    return float((known < 2).mean()) if len(known) else None


def _ellipsoids_in_truth(
    result: Result, truth_poses: Path | None
) -> tuple[list[Object], quadrics.Ellipsoids, list[float | None]]:
    """Transform the ellipsoids to the world of the truth; each component is aligned separately.

    Returns:
        the located objects of the components that can be aligned and their ellipsoids; of every
        component the relative error of its metres per unit, None where unknown.
    """
    objects: list[Object] = []
    solids: list[quadrics.Ellipsoids] = []
    scale_errors: list[float | None] = []
    faults: dict[int, ReobjError] = {}
    for k, component in enumerate(result.parts()):
        scale_errors.append(None)
        try:
            scale, turn, shift = align_with_truth(component, truth_poses)
        except ReobjError as error:
            faults[k] = error
            continue
        ours = component.ellipsoids()
        objects += component.located
        center = ours.center_in_world @ (scale * turn).T + shift
        axes = turn @ ours.world_from_obj
        solids.append(quadrics.Ellipsoids(center, scale * ours.half_axes, axes))
        poses = component.poses
        if poses is not None and poses.is_spot and not poses.metric:
            continue  # its cameras measure no scale
        if component.world.scale is not None and component.world.scale.value:
            scale_errors[k] = abs(component.world.scale.value / scale - 1)
    if not solids:
        raise faults[0]
    for k, fault in faults.items():
        log.warning("component %d of the trajectory is not evaluated in 3D: %s", k, fault)
    columns = ("center_in_world", "half_axes", "world_from_obj")
    joined = (np.concatenate([getattr(own, name) for own in solids]) for name in columns)
    return objects, quadrics.Ellipsoids(*joined), scale_errors
