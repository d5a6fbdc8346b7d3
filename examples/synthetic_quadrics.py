"""Measure quadrics.py on synthetic scenes with known truth: tables and plots of docs/quadrics.md.

Usage:
    python examples/synthetic_quadrics.py [--quick] [--only NAME ...] [-o docs]

All experiments are seeded. Boxes are the exact bounds of the projected solid (ellipsoid: dual
conic; cuboid: corners; cylinder: rims), each edge moved by Gaussian noise of a share of the box's width or height.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import quadrics
from quadrics import Array, Ellipsoids, Priors

IMAGE = (1280, 960)  # px
FOCAL = 1000.0  # px


def look_at(center: Array, target: Array, roll: Array) -> Array:
    """Cameras (F, 3, 4) img_from_world at `center` (F, 3) looking at `target`, rolled (F,) rad."""
    forward = target - center
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    rot = np.stack([c * right + s * down, c * down - s * right, forward], 1)  # (F, 3, 3)
    calib = np.array([[FOCAL, 0, IMAGE[0] / 2], [0, FOCAL, IMAGE[1] / 2], [0, 0, 1.0]])
    return calib @ np.concatenate([rot, -rot @ center[:, :, None]], 2)


def arc_cameras(
    n: int, arc_deg: float, rng: np.random.Generator, distance: float = 2.5, elevation_deg: float = 25.0
) -> Array:
    """n cameras on an arc around the origin, with jitter in place, aim and roll."""
    yaw = np.deg2rad(np.linspace(-0.5, 0.5, n) * arc_deg) + rng.uniform(0, 2 * np.pi)
    lift = np.deg2rad(elevation_deg + rng.normal(0, 4, n))
    center = np.stack([np.cos(yaw) * np.cos(lift), np.sin(yaw) * np.cos(lift), np.sin(lift)], 1)
    center = center * distance + rng.normal(0, 0.03, (n, 3))
    return look_at(center, rng.normal(0, 0.1, (n, 3)), rng.normal(0, 0.03, n))


def random_yaw(n: int, rng: np.random.Generator) -> Array:
    """Upright rotations (n, 3, 3)."""
    angle = rng.uniform(0, 2 * np.pi, n)
    return quadrics.rotations(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def noisy(boxes: Array, share: float, rng: np.random.Generator) -> Array:
    """Move left and right edges by Gaussian noise of `share` of the width, top and bottom of the height."""
    side = np.tile(boxes[..., 2:] - boxes[..., :2], 2)
    return boxes + rng.normal(0, share, boxes.shape) * side


def individual_priors(log_size: Array, sigma: float, support: str) -> tuple[Priors, list[str]]:
    """Priors with one category an object: mean log full size (O, 3), isotropic log sigma."""
    n = len(log_size)
    names = [f"object {k}" for k in range(n)]
    cov = np.tile(np.eye(3) * sigma**2, (n, 1, 1))
    diff = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])
    code = np.full(n, quadrics.SUPPORTS.index(support))
    flags = np.zeros(n, bool)
    ratio = (log_size @ diff.T, diff @ cov @ diff.T)
    return Priors(tuple(names), {}, log_size, cov, *ratio, code, flags, ~flags), names


def scenes(
    n_trials: int, n_views: int, arc_deg: float, noise: float, support: str, rng: np.random.Generator,
    sizes: tuple[float, float, float] | None = None, spread: float = 0.25,
) -> tuple[Array, Array, Ellipsoids, Priors, list[str]]:  # fmt: skip
    """Independent one-object scenes: boxes (T, V, 1, 4), cameras (T, V, 3, 4), truth, priors.

    Without `sizes` half axes are log-uniform in .1 to .4 m; the truth differs from the prior's
    mean by `spread` (log sigma) an axis, so that the prior is right in its own terms.
    """
    if sizes is None:
        mean = rng.uniform(np.log(0.1), np.log(0.4), (n_trials, 3)) + np.log(2.0)
    else:
        mean = np.tile(np.log(sizes), (n_trials, 1))
    log_size = mean + rng.normal(0, spread, mean.shape)
    rot = random_yaw(n_trials, rng)
    truth = Ellipsoids(rng.normal(0, 0.05, (n_trials, 3)), 0.5 * np.exp(log_size), rot)
    cams = np.stack([arc_cameras(n_views, arc_deg, rng) for _ in range(n_trials)])
    boxes = np.stack(
        [quadrics.solid_boxes(truth[k : k + 1], support, cams[k]) for k in range(n_trials)]
    )  # (T, V, 1, 4)
    return noisy(boxes, noise, rng), cams, truth, *individual_priors(mean, spread, support)


def as_one(boxes: Array, cams: Array) -> tuple[Array, Array]:
    """Put T scenes side by side: frames are concatenated, objects unseen elsewhere are NaN."""
    trials, views = boxes.shape[:2]
    joint = np.full((trials * views, trials, 4), np.nan)
    for k in range(trials):
        joint[k * views : (k + 1) * views, k] = boxes[k, :, 0]
    return joint, cams.reshape(-1, 3, 4)
