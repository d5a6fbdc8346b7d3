"""Simulate a photograph (motion blur, exposure, vignette, noise) and render clips."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendering.camera import camera_matrix, camera_path
from rendering.config import NEAR_M, Array, Image, Rng, RoomConfig
from rendering.ground_truth import FrameTruth, ground_truth
from rendering.raster import pixel_rays, render
from rendering.surfaces import Room, apply
from rendering.textures import to_image


def image_flow(depth: Array, K: Array, next_from_cam: Array) -> Array:
    """(H, W, 2) where each pixel's point goes in the next view, minus where it is, in pixels."""
    height, width = depth.shape
    rays = pixel_rays(K, (0, 0, width, height))
    pixels = apply(next_from_cam, rays * depth[..., None]) @ K.T
    middles = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    return np.asarray(pixels[..., :2] / np.maximum(pixels[..., 2:], NEAR_M) - middles)


def blur_motion(
    image: npt.NDArray[Any], flow: Array, shutter: float, taps: int = 5
) -> npt.NDArray[np.float32]:
    """Mean of the picture along the motion while the shutter is open."""
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    total = np.zeros(image.shape, np.float32)
    for fraction in (np.arange(taps) / (taps - 1) - 0.5) * shutter:
        map_u = u - (fraction * flow[..., 0]).astype(np.float32)
        map_v = v - (fraction * flow[..., 1]).astype(np.float32)
        total += cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(total / taps, np.float32)


def photograph(image: Image, flow: Array, config: RoomConfig, rng: Rng) -> Image:
    """Camera effects: motion blur, vignette, sensor noise that grows with the light."""
    picture = (
        blur_motion(image, flow, config.shutter) if config.shutter > 0 else image.astype(np.float32)
    )
    height, width = picture.shape[:2]
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    picture = picture * (1 - 0.10 * (u**2 + v**2))[..., None].astype(np.float32)
    grain = rng.standard_normal((height, width, 1), np.float32) + 0.5 * rng.standard_normal(
        picture.shape, np.float32
    )
    picture += np.float32(config.noise) * np.sqrt(0.4 + picture / 160) * grain
    return to_image(picture + 0.5)


def exposure_at(frame: int, config: RoomConfig) -> float:
    """Slow drift of the automatic exposure."""
    phase = np.random.default_rng([config.seed, 3]).uniform(0, 2 * np.pi, 2)
    seconds = frame / config.fps
    wave = 0.6 * np.sin(0.55 * seconds + phase[0]) + 0.4 * np.sin(1.3 * seconds + phase[1])
    return float(1 + config.exposure * wave)


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of a clip with its truth."""

    index: int
    image: Image  # (H, W, 3) BGR after the camera effects
    instance: npt.NDArray[np.int32]  # (H, W)
    depth: npt.NDArray[np.float32]  # (H, W) m
    cam_from_world: Array  # (3, 4)
    truth: FrameTruth


def render_frame(room: Room, config: RoomConfig, index: int, poses: Array) -> Frame:
    """One frame of a clip; it has its own random stream, so it does not depend on the others.

    Args:
        poses: cam_from_world (F, 3, 4) of the whole clip.
    """
    K = camera_matrix(config)
    pose = poses[index]
    rng = np.random.default_rng([config.seed, 4, index])
    size = (config.width, config.height)
    exposure = exposure_at(index, config)
    clean, instance, depth = render(room, K, pose, size, config.supersample, exposure)
    moves = index + 1 < len(poses) and config.path != "table"  # photos: nothing is blurred
    after = poses[index + 1] if moves else pose
    rotation = after[:, :3] @ pose[:, :3].T
    next_from_cam = np.concatenate([rotation, (after[:, 3] - rotation @ pose[:, 3])[:, None]], 1)
    flow = image_flow(depth.astype(np.float64), K, next_from_cam)
    image = photograph(clean, flow, config, rng)
    return Frame(index, image, instance, depth, pose, ground_truth(room, K, pose, instance))


def render_clip(room: Room, config: RoomConfig, cameras: Array | None = None) -> Iterator[Frame]:
    """Render frame after frame; each frame has its own random stream, so any subset repeats."""
    poses = camera_path(room, config) if cameras is None else cameras  # (F, 3, 4)
    for index in range(len(poses)):
        yield render_frame(room, config, index, poses)
