"""Bake lamp light and ambient light by ray marching through voxels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import Array, Color, Rng
from rendering.models import rotation_z
from rendering.surfaces import Surfaces, apply, surface_points


@dataclass(frozen=True, slots=True)
class Lighting:
    """Strength, colour and direction of the light sources; defaults: a day with lamps on."""

    lamp: Color = (5.2, 6.0, 6.6)  # radiance of the ceiling panels
    window: Color = (4.6, 4.2, 3.8)  # radiance of the window
    panel_gains: tuple[float, ...] = ()  # relative, of the first panels; 1 for those without
    ambient: float = 1.0  # relative
    window_turn_rad: float = 0.0  # about z: direction of most daylight against the window's normal
    window_focus: float = 1.0  # exponent of the cosine to that direction; 1: a diffuse sky


DEFAULT_LIGHTING = Lighting()


@dataclass(frozen=True, slots=True)
class Voxels:
    """Where the furniture is, for shadows."""

    filled: npt.NDArray[np.bool_]  # (X, Y, Z), one cell of margin
    origin: Array  # (3,) m
    step_m: float

    def at(self, points: Array) -> npt.NDArray[np.bool_]:
        """Are (..., 3) world points inside furniture?"""
        index = ((points - self.origin) / self.step_m).astype(np.int32)
        index = np.clip(index, 0, np.array(self.filled.shape) - 1)
        return np.asarray(self.filled[index[..., 0], index[..., 1], index[..., 2]])


def voxelize(
    surfaces: Surfaces, size: tuple[float, float, float], first: int = 6, step_m: float = 0.04
) -> Voxels:
    """Mark the cells that surfaces pass through, all but the first patches (the room's shell)."""
    origin = np.array([-size[0] / 2, -size[1] / 2, 0.0]) - step_m
    shape = np.ceil((np.array(size) + 2 * step_m) / step_m).astype(int)
    filled = np.zeros(shape, bool)
    for i in range(first, len(surfaces.kind)):
        if surfaces.emission[i] > 0:
            continue
        lengths = np.maximum(surfaces.light_rect[i, 2:] * 0.08 / (0.7 * step_m), 3).astype(int)
        s, t = (v.ravel() for v in np.meshgrid(*((np.arange(n) + 0.5) / n for n in lengths)))
        points, _ = surface_points(
            int(surfaces.kind[i]), surfaces.world_from_patch[i], surfaces.radii[i], s, t
        )
        index = np.clip(((points - origin) / step_m).astype(int), 0, shape - 1)
        filled[index[:, 0], index[:, 1], index[:, 2]] = True
    return Voxels(filled, origin, step_m)


def light_samples(surfaces: Surfaces) -> tuple[Array, Array, list[slice]]:
    """Points and normals of all light-map texels, patch after patch (N = sum of w h)."""
    points = []
    normals = []
    slices = []
    start = 0
    for i in range(len(surfaces.kind)):
        w, h = surfaces.light_rect[i, 2:].astype(int)
        s, t = (v.ravel() for v in np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h))
        p, n = surface_points(
            int(surfaces.kind[i]), surfaces.world_from_patch[i], surfaces.radii[i], s, t
        )
        points.append(p)
        normals.append(n)
        slices.append(slice(start, start + w * h))
        start += w * h
    return np.concatenate(points), np.concatenate(normals), slices


def lamp_light(
    points: Array,
    normals: Array,
    lamp: tuple[Array, Array, float],
    voxels: Voxels,
    rays: int,
    rng: Rng,
) -> Array:
    """(N,) fraction of a rectangular lamp's light that arrives: cosines, distance, shadow.

    Args:
        lamp: (3, 4) frame of the emitting quad, (3,) unit direction of most of its light, and the
            exponent of the cosine to that direction.
    """
    frame, direction, focus = lamp
    total = np.zeros(len(points))
    steps = (
        np.arange(1, 44) * 0.06
    )  # m from the point; above 2.6 m of way nothing stands in this room
    area = float(np.linalg.norm(np.cross(frame[:, 0], frame[:, 1])))
    for _ in range(rays):
        spot = apply(
            frame,
            np.concatenate([rng.uniform(0, 1, (len(points), 2)), np.zeros((len(points), 1))], 1),
        )
        ray = spot - points
        distance = np.linalg.norm(ray, axis=1)  # (N,)
        ray /= distance[:, None]
        value = (
            np.maximum((ray * normals).sum(1), 0)
            * np.maximum(-ray @ direction, 0) ** focus
            * area
            / (distance**2 + 0.3)
        )
        alive = np.nonzero(value > 1e-5)[0]
        start = points + normals * 0.055 + ray * 0.03 * rng.random((len(points), 1))
        for step in steps:
            alive = alive[step < distance[alive] - 0.1]
            alive = alive[~voxels.at(start[alive] + ray[alive] * step)]
        total[alive] += value[alive]
    return total / rays


def ambient_open(
    points: Array, normals: Array, voxels: Voxels, size: tuple[float, float, float], rng: Rng
) -> Array:
    """(N,) fraction of the near half-space (0.6 m) that is open: contact shadows, dark corners."""
    opened = np.zeros(len(points))
    rays = 14
    half = np.array([size[0] / 2, size[1] / 2])
    for _ in range(rays):
        ray = rng.standard_normal(points.shape)
        ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) + normals
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
        free = np.ones(len(points))
        for step in np.arange(1, 8) * 0.085:
            where = points + normals * 0.05 + ray * step
            outside = (np.abs(where[:, :2]) > half).any(1) | (where[:, 2] < 0)
            hit = voxels.at(where) | outside
            free = np.where(hit & (free == 1), 0.1 + step, free)
        opened += np.minimum(free, 1)
    return np.asarray(opened / rays)


def bake_light(
    surfaces: Surfaces,
    size: tuple[float, float, float],
    height: int,
    rays: int,
    rng: Rng,
    shell: int = 6,
    lighting: Lighting = DEFAULT_LIGHTING,
) -> npt.NDArray[np.float32]:
    """Irradiance of every patch: ceiling panels (warm), window (cool), ambient; the first `shell`
    patches (walls, floor, ceiling) cast no shadow.
    """
    points, normals, slices = light_samples(surfaces)
    voxels = voxelize(surfaces, size, shell)
    opened = ambient_open(points, normals, voxels, size, rng)
    up = 0.5 + 0.5 * normals[:, 2:]  # (N, 1)
    total = (
        lighting.ambient
        * opened[:, None]
        * (up * [0.22, 0.205, 0.19] + (1 - up) * [0.12, 0.15, 0.19])
    )  # (N, 3) BGR
    gains = np.ones(len(surfaces.kind))  # relative, of the emitting patches
    panel_gains = iter(lighting.panel_gains)
    for lamp in np.nonzero(surfaces.emission >= 1)[0]:
        frame = surfaces.world_from_patch[lamp]
        is_window = abs(frame[2, 2]) < 0.5
        color = np.array(lighting.window if is_window else lighting.lamp)
        usual = DEFAULT_LIGHTING.window if is_window else DEFAULT_LIGHTING.lamp
        gain = 1.0 if is_window else next(panel_gains, 1.0)
        gains[lamp] = gain * color.mean() / np.mean(usual)
        direction = -frame[:, 2]
        focus = 1.0
        if is_window:
            direction = rotation_z(lighting.window_turn_rad) @ direction
            focus = lighting.window_focus
        arrived = lamp_light(points, normals, (frame, direction, focus), voxels, rays, rng)
        total += gain * arrived[:, None] * color
    light = np.zeros((height, 512, 3), np.float32)
    for i, part in enumerate(slices):
        x, y, w, h = surfaces.light_rect[i].astype(int)
        block = total[part].reshape(h, w, 3).astype(np.float32)
        if surfaces.emission[i] > 0:
            block[:] = surfaces.emission[i] * gains[i]
        light[y : y + h, x : x + w] = cv2.GaussianBlur(
            block, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE
        )
    return light
