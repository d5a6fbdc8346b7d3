"""Shapes of objects from boxes in 3D that a detector gives, in place of the fit to boxes in 2D."""

from __future__ import annotations

import dataclasses

import numpy as np

import quadrics
from reobj.sources.tables import Boxes3D
from reobj.types import Array, IntArray, Tracks, rows_by

OUTLIER = 3.0  # robust sigmas; a box beyond is not used
BOXES_PER_ERROR = 10.0  # errors of ten boxes count as one: those of neighbouring frames are alike
FLOOR = 0.05  # sigma common to all boxes, relative to the size, and in rad (chosen: unknown)


def with_given_boxes(
    fits: quadrics.ObjectFits, boxes: Boxes3D | None, tracks: Tracks, group: IntArray
) -> quadrics.ObjectFits:
    """Replace the shapes of objects that have boxes in 3D by the robust mean of their boxes.

    Args:
        tracks: N rows. group: (N,) object of each.
    """
    row = np.full(len(tracks), -1) if boxes is None else boxes.of_rows(tracks)
    given = np.flatnonzero(row >= 0)
    if boxes is None or not len(given):
        return fits
    e = fits.ellipsoids
    center = e.center_in_world.copy()
    half_axes = e.half_axes.copy()
    turn = e.world_from_obj.copy()
    cov = fits.cov.copy()
    size = fits.size.copy()
    support = np.array(fits.support, object)
    status = np.array(fits.status, object)
    reason = list(fits.reason)
    for rows in rows_by(group[given]):
        i = int(group[given[rows[0]]])
        of_object = row[given[rows]]
        center[i], half_axes[i], turn[i], cov[i] = mean_box(
            boxes.box[of_object], boxes.score[of_object], fits.up
        )
        size[i] = 2 * half_axes[i]
        support[i] = "box"
        status[i] = "ok"
        reason[i] = ""
    replaced = np.unique(group[given])
    prior_share = fits.prior_share.copy()
    prior_share[replaced] = 0.0
    return dataclasses.replace(
        fits, ellipsoids=quadrics.Ellipsoids(center, half_axes, turn), size=size, cov=cov,
        support=support.astype(str), status=status.astype(str), reason=reason,
        prior_share=prior_share,
    )  # fmt: skip


def mean_box(box: Array, score: Array, up: Array) -> tuple[Array, Array, Array, Array]:
    """Average boxes (n, 15) of one object, robustly; a box may have its axes in any order.

    The mean is weighted by the score, without boxes of which a value is more than OUTLIER robust
    sigmas from the median. Its covariance is that of the boxes over their number (of which
    BOXES_PER_ERROR count as one, each as much as its score), and FLOOR.

    Args:
        up: (3,) the third axis of the mean is the one nearest to it; zeros: unknown.
    Returns:
        centre (3,), half extents (3,), rotation (3, 3), covariance (9, 9) of centre, log half
        extents and rotation vector in the frame of the box.
    """
    turn = box[:, 6:].reshape(-1, 3, 3)
    first = _vertical_last(turn[int(score.argmax())], up)
    turn, half = _aligned(turn, box[:, 3:6], first)
    values = np.hstack([box[:, :3], np.log(half), quadrics.rotation_vectors(first.T @ turn)])
    middle = np.median(values, 0)
    off = np.abs(values - middle)
    sigma = 1.4826 * np.median(off, 0)  # of a normal distribution
    usual = np.append(np.full(3, FLOOR * half.mean()), np.full(6, FLOOR))  # boxes may be identical
    keep = (off <= OUTLIER * np.maximum(sigma, usual)).all(1)
    keep = keep if keep.any() else off.max(1) == off.max(1).min()
    weight = np.maximum(score[keep], 1e-3)
    mean = np.average(values[keep], axis=0, weights=weight)
    difference = values[keep] - mean
    scatter = (weight[:, None] * difference).T @ difference / weight.sum()
    cov = scatter / max(weight.sum() / BOXES_PER_ERROR, 1.0)
    half_mean = np.exp(mean[3:6])
    cov += np.diag(FLOOR**2 * np.concatenate([np.full(3, (half_mean**2).mean()), np.ones(6)]))
    return mean[:3], half_mean, first @ quadrics.rotations(mean[None, 6:])[0], cov


def _vertical_last(turn: Array, up: Array) -> Array:
    """Reorder the axes of a rotation (3, 3) so that the third is the one nearest to up."""
    along = up @ turn
    if not along.any():
        return turn
    last = int(np.abs(along).argmax())
    turn = np.roll(turn, 2 - last, 1)  # cyclic: it stays right-handed
    return np.asarray(turn * ([-1, 1, -1] if along[last] < 0 else [1, 1, 1]))


def _aligned(turn: Array, half: Array, first: Array) -> tuple[Array, Array]:
    """Order the axes of boxes so that their rotations (n, 3, 3) are nearest to one of them."""
    cosine = np.swapaxes(turn, 1, 2) @ first  # (n, own axis, axis of the first)
    orders = quadrics.AXIS_ORDERS  # (6, 3)
    total = np.abs(cosine[:, orders, np.arange(3)]).sum(2)  # (n, 6)
    order = orders[total.argmax(1)]  # (n, 3) own axis for each axis of the first
    sign = np.take_along_axis(cosine, order[:, :, None].repeat(3, 2), 1)
    sign = np.where(np.einsum("nii->ni", sign) < 0, -1.0, 1.0)
    axes = np.take_along_axis(turn, order[:, None, :].repeat(3, 1), 2) * sign[:, None]
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return axes, np.take_along_axis(half, order, 1)
