"""Bake lamp light and ambient light by ray marching through voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import Array, Color, Rng, Size
from rendering.models import rotation_z
from rendering.surfaces import LIGHT_WIDTH, Surfaces, apply, surface_points


@dataclass(frozen=True, slots=True)
class Lighting:
    """Strength, colour and direction of the light sources; defaults: a day with lamps on."""

    lamp: Color = (5.2, 6.0, 6.6)  # radiance of the ceiling panels
    window: Color = (4.6, 4.2, 3.8)  # radiance of the window
    panel_gains: Sequence[float] = (1.0, 1.0)  # relative
    ambient: float = 1.0  # relative
    window_turn_rad: float = 0.0  # about z: direction of most daylight against the window's normal
    window_focus: float = 1.0  # exponent of the cosine to that direction; 1: a diffuse sky


DEFAULT_LIGHTING = Lighting()
SHELL = 6  # the first patches, walls, floor and ceiling, cast no shadow
VOXEL_M = 0.04


@dataclass(frozen=True, slots=True)
class Voxels:
    """Where the furniture is, for shadows."""

    filled: npt.NDArray[np.bool_]  # (X, Y, Z), one cell of margin
    origin: Array  # (3,) m

    def index(self, points: Array) -> tuple[Any, ...]:
        """Cells (x, y, z) of (..., 3) world points, for those outside the nearest ones."""
        cells = ((points - self.origin) / VOXEL_M).astype(np.int32)
        cells = np.clip(cells, 0, np.array(self.filled.shape) - 1)
        return cells[..., 0], cells[..., 1], cells[..., 2]

    def at(self, points: Array) -> npt.NDArray[np.bool_]:
        """Are (..., 3) world points inside furniture?"""
        return np.asarray(self.filled[self.index(points)])


def voxelize(surfaces: Surfaces, size: Size) -> Voxels:
    """Mark the cells that the furniture's surfaces pass through."""
    origin = np.array([-size[0] / 2, -size[1] / 2, 0.0]) - VOXEL_M
    shape = np.ceil((np.array(size) + 2 * VOXEL_M) / VOXEL_M).astype(int)
    voxels = Voxels(np.zeros(shape, bool), origin)
    for i in range(SHELL, len(surfaces.kind)):
        if surfaces.emission[i] <= 0:
            w, h = np.maximum(surfaces.light_rect[i, 2:] * 0.08 / (0.7 * VOXEL_M), 3).astype(int)
            voxels.filled[voxels.index(surface_points(surfaces, i, (w, h))[0])] = True
    return voxels


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
    steps = np.arange(1, 44) * 0.06  # m from the point; nothing stands further away in this room
    area = float(np.linalg.norm(np.cross(frame[:, 0], frame[:, 1])))
    for _ in range(rays):
        spot = np.pad(rng.uniform(0, 1, (len(points), 2)), ((0, 0), (0, 1)))
        ray = apply(frame, spot) - points
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


def ambient_open(points: Array, normals: Array, voxels: Voxels, size: Size, rng: Rng) -> Array:
    """(N,) fraction of the near half-space (0.6 m) that is open: contact shadows, dark corners."""
    opened = np.zeros(len(points))
    rays = 14
    half = np.array(size[:2]) / 2
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
    surfaces: Surfaces, size: Size, height: int, rays: int, rng: Rng, lighting: Lighting
) -> npt.NDArray[np.float32]:
    """Irradiance of every patch: ceiling panels (warm), window (cool), ambient."""
    rects = surfaces.light_rect.astype(int)
    samples = [surface_points(surfaces, i, (w, h)) for i, (_, _, w, h) in enumerate(rects)]
    points, normals = (np.concatenate(column) for column in zip(*samples, strict=True))  # (N, 3)
    voxels = voxelize(surfaces, size)
    opened = ambient_open(points, normals, voxels, size, rng)
    up = 0.5 + 0.5 * normals[:, 2:]  # (N, 1)
    sky = up * [0.22, 0.205, 0.19] + (1 - up) * [0.12, 0.15, 0.19]
    total = lighting.ambient * opened[:, None] * sky  # (N, 3) BGR
    gains = np.ones(len(surfaces.kind))  # relative, of the emitting patches
    panel_gains = iter(lighting.panel_gains)
    for lamp in np.nonzero(surfaces.emission >= 1)[0]:
        frame = surfaces.world_from_patch[lamp]
        is_window = abs(frame[2, 2]) < 0.5
        source = "window" if is_window else "lamp"
        color = getattr(lighting, source)
        gain = 1.0 if is_window else next(panel_gains)
        direction = -frame[:, 2]
        focus = 1.0
        if is_window:
            direction = rotation_z(lighting.window_turn_rad) @ direction
            focus = lighting.window_focus
        gains[lamp] = gain * np.mean(color) / np.mean(getattr(DEFAULT_LIGHTING, source))
        arrived = lamp_light(points, normals, (frame, direction, focus), voxels, rays, rng)
        total += gain * arrived[:, None] * np.array(color)
    light = np.zeros((height, LIGHT_WIDTH, 3), np.float32)
    blocks = np.split(total, np.cumsum(rects[:, 2] * rects[:, 3])[:-1])
    for i, ((x, y, w, h), values) in enumerate(zip(rects, blocks, strict=True)):
        block = values.reshape(h, w, 3).astype(np.float32)
        if surfaces.emission[i] > 0:
            block[:] = surfaces.emission[i] * gains[i]
        light[y : y + h, x : x + w] = cv2.GaussianBlur(
            block, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE
        )
    return light
