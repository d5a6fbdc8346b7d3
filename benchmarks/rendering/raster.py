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

    def store(self, index: int, window: Any, at: tuple[Any, ...], w: Any, s: Any, t: Any) -> None:
        """Write 1/z, s, t of the samples that passed, at rows and columns of a window."""
        where = (at[0] + window[1], at[1] + window[0])
        self.inverse_depth[where] = w
        self.s[where] = s
        self.t[where] = t
        self.patch[where] = index


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
    s, t, w = (a * u + (b * v + c) for a, b, c in patch_from_img.astype(np.float32))  # (h, w)
    nearer = w > layers.inverse_depth[y0:y1, x0:x1]
    edge = np.float32(1e-5) * w
    if kind == DISC:
        inside = (s - 0.5 * w) ** 2 + (t - 0.5 * w) ** 2 <= np.float32(0.25) * w * w
    else:
        inside = (s >= -edge) & (t >= -edge) & (s <= w + edge) & (t <= w + edge)
    at = np.nonzero(inside & nearer & (w < 1 / NEAR_M))
    layers.store(index, window, at, w[at], s[at] / w[at], t[at] / w[at])


def pixel_rays(K: Array, window: Any) -> Array:
    """(h, w, 3) rays with z = 1 through the middles of the pixels in x0, y0, x1, y1."""
    x0, y0, x1, y1 = window
    u, v = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)


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
    d = pixel_rays(K, window) @ patch_from_cam[:, :3].T
    o = patch_from_cam[:, 3]
    # (dx^2 + dy^2 + a dz^2) k^2 + (2 (o.d)_a + b dz) k + (ox^2 + oy^2 + a oz^2 + b oz + c) = 0
    qa = d[..., 0] ** 2 + d[..., 1] ** 2 + a * d[..., 2] ** 2
    qb = d[..., 0] * o[0] + d[..., 1] * o[1] + a * d[..., 2] * o[2] + 0.5 * b * d[..., 2]
    qc = o[0] ** 2 + o[1] ** 2 + a * o[2] ** 2 + b * o[2] + c
    root = np.sqrt(np.maximum(qb**2 - qa * qc, 0))
    safe = np.where(np.abs(qa) < 1e-12, 1e-12, qa)
    depth = np.full(qa.shape, np.inf)
    for k in ((-qb - root) / safe, (-qb + root) / safe):
        z = o[2] + k * d[..., 2]
        good = (qb**2 >= qa * qc) & (k > NEAR_M) & (z >= z_low) & (z <= z_high) & (k < depth)
        depth = np.where(good, k, depth)
    x0, y0, x1, y1 = window
    at = np.nonzero(1 / depth > layers.inverse_depth[y0:y1, x0:x1])
    k = depth[at]
    x, y, z = o[:, None] + k * d[at].T
    s = np.arctan2(y, x) / (2 * np.pi) + 0.5
    layers.store(index, window, at, 1 / k, s, (z_high - z) / (z_high - z_low))


def cam_from_patch(surfaces: Surfaces, cam_from_world: Array) -> Array:
    """(S, 3, 4) patches in the camera's frame."""
    frames = cam_from_world[:, :3] @ surfaces.world_from_patch
    frames[:, :, 3] += cam_from_world[:, 3]
    return np.asarray(frames)


def rasterize(surfaces: Surfaces, K: Array, cam_from_world: Array, size: tuple[int, int]) -> Layers:
    """Fill the layers of one view, patch by patch."""
    zero = np.zeros(size[::-1], np.float32)
    layers = Layers(zero.copy(), np.full(zero.shape, -1, np.int32), zero.copy(), zero.copy())
    windows = patch_windows(surfaces, K @ cam_from_world, size)
    center = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    drawn = faces_camera(surfaces, center) & (windows[:, 2:] > windows[:, :2]).all(1)
    frames = cam_from_patch(surfaces, cam_from_world)
    for i in np.nonzero(drawn)[0].tolist():
        if surfaces.kind[i] in (QUAD, DISC):
            img_from_patch = K @ frames[i][:, [0, 1, 3]]  # (3, 3) of (s, t, 1)
            if abs(np.linalg.det(img_from_patch)) > 1e-9:
                patch_from_img = np.linalg.inv(img_from_patch)
                draw_flat(layers, i, surfaces.kind[i], patch_from_img, windows[i])
        else:
            linear = np.linalg.inv(frames[i][:, :3])
            patch_from_cam = np.concatenate([linear, -linear @ frames[i][:, 3:]], 1)
            draw_round(layers, i, surfaces.quadric[i], patch_from_cam, K, windows[i])
    return layers


def texel_rates(surfaces: Surfaces, K: Array, cam_from_world: Array) -> tuple[Array, Array]:
    """(S,) factor and power: texels per pixel = factor * depth**power (mean over the area)."""
    frames = cam_from_patch(surfaces, cam_from_world)
    flat = np.abs(np.linalg.det(K @ frames[:, :, [0, 1, 3]]))  # (S,) |det of img_from_patch|
    texels = surfaces.texture_rect[:, 2] * surfaces.texture_rect[:, 3]
    lengths = np.linalg.norm(surfaces.world_from_patch[:, :, :3], axis=1)  # (S, 3)
    is_sphere = surfaces.kind == SPHERE
    around = 2 * np.pi * np.where(is_sphere, lengths[:, 0], surfaces.radii.max(1))
    tall = np.where(is_sphere, np.pi, 1.0) * lengths[:, 2]
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
    columns = 1024  # remap wants an image: fold the list
    for number, image in enumerate(atlas):
        rows = np.nonzero(level == number)[0]
        maps = np.zeros((2, -(-len(rows) // columns) * columns), np.float32)
        maps[:, : len(rows)] = np.stack([u[rows], v[rows]]) / 2**number - 0.5
        if len(rows):
            map_u, map_v = maps.reshape(2, -1, columns)
            picked = cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR)
            colors[rows] = picked.reshape(-1, 3)[: len(rows)]
    return colors


def shade_layers(
    room: Room, layers: Layers, K: Array, cam_from_world: Array
) -> npt.NDArray[np.float32]:
    """Linear colours (H, W, 3) of all samples: texture times baked light."""
    surfaces = room.surfaces
    shape = layers.patch.shape
    patch = np.maximum(layers.patch, 0).ravel()
    st = np.stack([layers.s.ravel(), layers.t.ravel()], 1)  # (N, 2)
    factor, power = texel_rates(surfaces, K, cam_from_world)
    depth_log = -np.log2(np.maximum(layers.inverse_depth.ravel(), 1e-3))
    level = np.log2(factor + 1e-12).astype(np.float32)[patch]
    level = level + power.astype(np.float32)[patch] * depth_log
    dither = np.array([[0.1, 0.6], [0.85, 0.35]], np.float32)
    tiles = np.tile(dither, (-(-shape[0] // 2), -(-shape[1] // 2)))[: shape[0], : shape[1]]
    level = np.floor(level + tiles.ravel())  # the mean over 2x2 samples blends two levels
    level = np.clip(level, 0, MIP_LEVELS - 1).astype(np.int64)
    rect = surfaces.texture_rect.astype(np.float32)[patch]  # (N, 4)
    u, v = (rect[:, :2] + st * rect[:, 2:]).T
    albedo = sample_atlas(room.atlas, u, v, level)
    spot = surfaces.light_rect.astype(np.float32)[patch]
    at = spot[:, :2] + np.clip(st * spot[:, 2:], 0.5, spot[:, 2:] - 0.5) - 0.5
    u, v = (np.ascontiguousarray(column).reshape(shape) for column in at.T)
    light = cv2.remap(room.light, u, v, cv2.INTER_LINEAR)
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
    K_fine = np.diag([n, n, 1.0]) @ K  # corner convention: nothing to shift
    layers = rasterize(room.surfaces, K_fine, cam_from_world, (n * width, n * height))
    fine = shade_layers(room, layers, K_fine, cam_from_world) * np.float32(exposure)
    linear = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA) if n > 1 else fine

    def samples(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(H, W, n * n) of each pixel."""
        blocks = values.reshape(height, n, width, n).transpose(0, 2, 1, 3)
        return blocks.reshape(height, width, n * n)

    owner = np.where(layers.patch < 0, -1, room.surfaces.owner[layers.patch]).astype(np.int32)
    owners = samples(owner)
    instance = majority(owners)
    same = owners == instance[..., None]
    inverse = samples(layers.inverse_depth) * same
    depth = same.sum(-1) / np.maximum(inverse.sum(-1), 1e-6)
    return tone_map(linear), instance, depth.astype(np.float32)


def tone_map(linear: npt.NDArray[Any]) -> Image:
    """Linear light to 8-bit: soft shoulder, then gamma."""
    curved = linear * (1 + linear / 5.0) / (1 + linear)
    return to_image(255 * np.clip(curved * 1.68, 0, 1) ** (1 / 2.2) + 0.5)
