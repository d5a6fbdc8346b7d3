"""Rasterise the patches: z-buffer, textures, light, object labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import NEAR_M, Array, Image
from rendering.models import DISC, QUAD, SPHERE
from rendering.surfaces import MIP_LEVELS, Room, Surfaces, apply
from rendering.textures import to_image


@dataclass(slots=True)
class Layers:
    """What the raster pass fills, per (super)sample."""

    inverse_depth: npt.NDArray[np.float32]  # (H, W) 1/m, 0 where nothing is
    patch: npt.NDArray[np.int32]  # (H, W) -1 where nothing is
    s: npt.NDArray[np.float32]
    t: npt.NDArray[np.float32]


def patch_windows(
    surfaces: Surfaces, img_from_world: Array, size: tuple[int, int]
) -> npt.NDArray[np.int64]:
    """(S, 4) pixel rectangles x0, y0, x1, y1 that hold each patch; empty if out of view."""
    homogeneous = apply(img_from_world, surfaces.corners_in_world)  # (S, 8, 3)
    depth = homogeneous[..., 2]
    crossing = (depth < NEAR_M).any(1)
    left_above = (homogeneous[..., :2] < 0).all(1)  # (S, 2)
    right_below = (homogeneous[..., :2] > depth[..., None] * np.array(size)).all(1)  # (S, 2)
    outside = np.any(left_above | right_below, axis=1) | (depth < NEAR_M).all(1)  # (S,)
    pixels = homogeneous[..., :2] / np.maximum(depth, NEAR_M)[..., None]  # (S, 8, 2)
    low = np.floor(pixels.min(1)) - 1
    high = np.ceil(pixels.max(1)) + 1
    low[crossing] = 0
    high[crossing] = size
    windows = np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)], 1).astype(np.int64)
    windows[outside] = 0
    return np.asarray(windows)


def faces_camera(surfaces: Surfaces, center_in_world: Array) -> npt.NDArray[np.bool_]:
    """(S,) False for flat one-sided patches seen from behind."""
    to_patch = surfaces.world_from_patch[:, :, 3] - center_in_world
    facing = (to_patch * surfaces.world_from_patch[:, :, 2]).sum(1) > 0
    return np.asarray(facing | surfaces.two_sided | (surfaces.kind >= SPHERE))


def draw_flat(
    layers: Layers, index: int, kind: int, patch_from_img: Array, window: npt.NDArray[np.int64]
) -> None:
    """Z-test a quad or disc. (s, t, 1) / z = patch_from_img (u, v, 1) is linear in the pixel."""
    x0, y0, x1, y1 = window
    u = np.arange(x0, x1, dtype=np.float32)[None, :] + np.float32(0.5)
    v = np.arange(y0, y1, dtype=np.float32)[:, None] + np.float32(0.5)
    m = patch_from_img.astype(np.float32)
    w = m[2, 0] * u + (m[2, 1] * v + m[2, 2])  # (h, w) 1/z
    nearer = w > layers.inverse_depth[y0:y1, x0:x1]
    s = m[0, 0] * u + (m[0, 1] * v + m[0, 2])
    t = m[1, 0] * u + (m[1, 1] * v + m[1, 2])
    edge = np.float32(1e-5) * w
    if kind == DISC:
        inside = (s - 0.5 * w) ** 2 + (t - 0.5 * w) ** 2 <= np.float32(0.25) * w * w
    else:
        inside = (s >= -edge) & (t >= -edge) & (s <= w + edge) & (t <= w + edge)
    rows, cols = np.nonzero(inside & nearer & (w < 1 / NEAR_M))
    depth_inv = w[rows, cols]
    store(
        layers,
        index,
        (rows + y0, cols + x0),
        (depth_inv, s[rows, cols] / depth_inv, t[rows, cols] / depth_inv),
    )


def store(layers: Layers, index: int, at: tuple[Any, Any], values: tuple[Any, Any, Any]) -> None:
    """Write 1/z, s, t of the samples that passed."""
    layers.inverse_depth[at], layers.s[at], layers.t[at] = values
    layers.patch[at] = index


def draw_round(
    layers: Layers,
    index: int,
    quadric: Array,
    patch_from_cam: Array,
    K: Array,
    window: npt.NDArray[np.int64],
) -> None:
    """Z-test a sphere or frustum: nearest root of the ray within the patch's z limits."""
    a, b, c, z_low, z_high = quadric
    x0, y0, x1, y1 = window
    u, v = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    rays = np.stack(
        [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1
    )  # (h, w, 3), z = 1
    d = rays @ patch_from_cam[:, :3].T
    o = patch_from_cam[:, 3]
    # (dx^2 + dy^2 + a dz^2) k^2 + (2 (o.d)_a + b dz) k + (ox^2 + oy^2 + a oz^2 + b oz + c) = 0
    qa = d[..., 0] ** 2 + d[..., 1] ** 2 + a * d[..., 2] ** 2
    qb = d[..., 0] * o[0] + d[..., 1] * o[1] + a * d[..., 2] * o[2] + 0.5 * b * d[..., 2]
    qc = o[0] ** 2 + o[1] ** 2 + a * o[2] ** 2 + b * o[2] + c
    root = np.sqrt(np.maximum(qb**2 - qa * qc, 0))
    safe = np.where(np.abs(qa) < 1e-12, 1e-12, qa)
    depth = np.full(u.shape, np.inf)
    for k in ((-qb - root) / safe, (-qb + root) / safe):
        z = o[2] + k * d[..., 2]
        good = (qb**2 >= qa * qc) & (k > NEAR_M) & (z >= z_low) & (z <= z_high) & (k < depth)
        depth = np.where(good, k, depth)
    rows, cols = np.nonzero(1 / depth > layers.inverse_depth[y0:y1, x0:x1])
    k = depth[rows, cols]
    x, y, z = (o[i] + k * d[rows, cols, i] for i in range(3))
    s = np.arctan2(y, x) / (2 * np.pi) + 0.5
    t = (z_high - z) / (z_high - z_low)
    store(layers, index, (rows + y0, cols + x0), (1 / k, s, t))


def rasterize(surfaces: Surfaces, K: Array, cam_from_world: Array, size: tuple[int, int]) -> Layers:
    """Fill the layers of one view, patch by patch."""
    width, height = size
    shape = (height, width)
    zero = np.zeros(shape, np.float32)
    layers = Layers(zero.copy(), np.full(shape, -1, np.int32), zero.copy(), zero.copy())
    windows = patch_windows(surfaces, K @ cam_from_world, size)
    center = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    drawn = (
        faces_camera(surfaces, center)
        & (windows[:, 2] > windows[:, 0])
        & (windows[:, 3] > windows[:, 1])
    )
    for i in np.nonzero(drawn)[0]:
        cam_from_patch = cam_from_world[:, :3] @ surfaces.world_from_patch[i]  # (3, 4)
        cam_from_patch[:, 3] += cam_from_world[:, 3]
        if surfaces.kind[i] in (QUAD, DISC):
            img_from_patch = K @ cam_from_patch[:, [0, 1, 3]]  # (3, 3) of (s, t, 1)
            if abs(np.linalg.det(img_from_patch)) > 1e-9:
                draw_flat(
                    layers, int(i), int(surfaces.kind[i]), np.linalg.inv(img_from_patch), windows[i]
                )
        else:
            linear = np.linalg.inv(cam_from_patch[:, :3])
            patch_from_cam = np.concatenate([linear, -linear @ cam_from_patch[:, 3:]], 1)
            draw_round(layers, int(i), surfaces.quadric[i], patch_from_cam, K, windows[i])
    return layers


def texel_rates(surfaces: Surfaces, K: Array, cam_from_world: Array) -> tuple[Array, Array]:
    """(S,) factor and power: texels per pixel = factor * depth**power (mean over the area)."""
    frames = cam_from_world[:, :3] @ surfaces.world_from_patch  # (S, 3, 4)
    frames[:, :, 3] += cam_from_world[:, 3]
    flat = np.abs(np.linalg.det(K @ frames[:, :, [0, 1, 3]]))  # (S,) |det of img_from_patch|
    texels = surfaces.texture_rect[:, 2] * surfaces.texture_rect[:, 3]
    lengths = np.linalg.norm(surfaces.world_from_patch[:, :, :3], axis=1)  # (S, 3)
    around = 2 * np.pi * np.where(surfaces.kind == SPHERE, lengths[:, 0], surfaces.radii.max(1))
    tall = np.where(surfaces.kind == SPHERE, np.pi, 1.0) * lengths[:, 2]
    is_flat = surfaces.kind < SPHERE
    factor = np.where(
        is_flat,
        np.sqrt(texels / np.maximum(flat, 1e-12)),
        np.sqrt(texels / (around * tall + 1e-9)) / K[0, 0],
    )
    return factor, np.where(is_flat, 1.5, 1.0)


def sample_atlas(
    atlas: Sequence[Image], u: Any, v: Any, level: npt.NDArray[np.int64]
) -> npt.NDArray[np.uint8]:
    """Texture colours (N, 3) at atlas positions u, v (N,), each from its own mip level."""
    colors = np.zeros((len(u), 3), np.uint8)
    for number, image in enumerate(atlas):
        chosen = np.nonzero(level == number)[0]
        if not len(chosen):
            continue
        columns = 1024  # remap wants an image: fold the list
        maps = np.zeros((2, -(-len(chosen) // columns) * columns), np.float32)
        maps[0, : len(chosen)] = u[chosen] / 2**number - 0.5
        maps[1, : len(chosen)] = v[chosen] / 2**number - 0.5
        folded = maps.reshape(2, -1, columns)
        picked = cv2.remap(image, folded[0], folded[1], cv2.INTER_LINEAR)
        colors[chosen] = picked.reshape(-1, 3)[: len(chosen)]
    return colors


def shade_layers(
    room: Room, layers: Layers, K: Array, cam_from_world: Array
) -> npt.NDArray[np.float32]:
    """Linear colours (H, W, 3) of all samples: texture times baked light."""
    surfaces = room.surfaces
    shape = layers.patch.shape
    patch = np.maximum(layers.patch, 0).ravel()
    s = layers.s.ravel()
    t = layers.t.ravel()
    rect = surfaces.texture_rect.astype(np.float32)[patch]  # (N, 4)
    factor, power = texel_rates(surfaces, K, cam_from_world)
    depth_log = -np.log2(np.maximum(layers.inverse_depth.ravel(), 1e-3))
    level = (
        np.log2(factor + 1e-12).astype(np.float32)[patch]
        + power.astype(np.float32)[patch] * depth_log
    )
    dither = np.tile(
        np.array([[0.1, 0.6], [0.85, 0.35]], np.float32), (-(-shape[0] // 2), -(-shape[1] // 2))
    )
    level = np.floor(
        level + dither[: shape[0], : shape[1]].ravel()
    )  # the mean over 2x2 samples blends two levels
    level = np.clip(level, 0, MIP_LEVELS - 1).astype(np.int64)
    albedo = sample_atlas(
        room.atlas, rect[:, 0] + s * rect[:, 2], rect[:, 1] + t * rect[:, 3], level
    )
    spot = surfaces.light_rect.astype(np.float32)[patch]
    light_u = spot[:, 0] + np.clip(s * spot[:, 2], 0.5, spot[:, 2] - 0.5) - 0.5
    light_v = spot[:, 1] + np.clip(t * spot[:, 3], 0.5, spot[:, 3] - 0.5) - 0.5
    light = cv2.remap(room.light, light_u.reshape(shape), light_v.reshape(shape), cv2.INTER_LINEAR)
    to_linear = ((np.arange(256) / 255.0) ** 2.2).astype(np.float32)
    return np.asarray(to_linear[albedo].reshape(*shape, 3) * light, np.float32)


def majority(samples: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Most frequent of the k x k sub-sample labels (H, W, n), the smaller one if tied."""
    ordered = np.sort(samples, axis=-1)  # (H, W, n)
    count = (ordered[..., :, None] == ordered[..., None, :]).sum(-1)
    return np.asarray(np.take_along_axis(ordered, count.argmax(-1)[..., None], -1)[..., 0])


def render(
    room: Room,
    K: Array,
    cam_from_world: Array,
    size: tuple[int, int],
    supersample: int = 2,
    exposure: float = 1.0,
) -> tuple[Image, npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """One clean picture.

    Args:
        K: (3, 3) in COLMAP pixels. cam_from_world: (3, 4). size: (width, height).
    Returns:
        image (H, W, 3) BGR, instance map (H, W) of object indices (-1: none), depth (H, W) in m.
    """
    width, height = size
    n = supersample
    K_fine = (
        np.diag([n, n, 1.0]) @ K
    )  # corner convention: scaling pixels scales K, nothing to shift
    layers = rasterize(room.surfaces, K_fine, cam_from_world, (n * width, n * height))
    fine = shade_layers(room, layers, K_fine, cam_from_world) * np.float32(exposure)
    linear = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA) if n > 1 else fine
    owner = np.where(layers.patch < 0, -1, room.surfaces.owner[layers.patch]).astype(np.int32)
    samples = owner.reshape(height, n, width, n).transpose(0, 2, 1, 3).reshape(height, width, n * n)
    instance = majority(samples)
    inverse = (
        layers.inverse_depth.reshape(height, n, width, n)
        .transpose(0, 2, 1, 3)
        .reshape(height, width, n * n)
    )
    same = samples == instance[..., None]
    depth = same.sum(-1) / np.maximum((inverse * same).sum(-1), 1e-6)
    return tone_map(linear), instance, depth.astype(np.float32)


def tone_map(linear: npt.NDArray[Any]) -> Image:
    """Linear light to 8-bit: soft shoulder, then gamma."""
    curved = linear * (1 + linear / 5.0) / (1 + linear)
    return to_image(255 * np.clip(curved * 1.68, 0, 1) ** (1 / 2.2) + 0.5)
