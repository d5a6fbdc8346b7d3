#!/usr/bin/env python3
"""Train the embedding of `reobj_track.py`: one backbone pass a frame, two vectors an object.

    python benchmarks/train_embedding.py -o OUT --rooms 1000:1150 --sparse IMAGES=SPARSE ...

writes OUT/reobj.onnx and OUT/reobj_head.onnx (use: `--embed OUT/reobj.onnx`; the checkpoint of the
best validation, OUT/best.pt), OUT/last.pt (go on with --resume) and OUT/log.csv.
Needs `pip install torch onnx`; the GPU is used when there is one.

Training data; every source may be given several times:
  --rooms A:B           seeds of rendered rooms with sets of identical instances (render_room.py
                        `--plan varied --path tour`), rendered on the fly into --cache.
  --sparse IMAGES=DIR   self-supervision from poses: a COLMAP model of the images, such as `sparse/`
                        of an output folder of `run`. A ball around a 3D point is a pseudo-object:
                        the views that observe the point show it from different directions.
  --tracks IMAGES=FILE  `tracks.txt` of `run` (MOTChallenge): identity by 3D object. Masks
                        are those of the detector (OUT/cache, or a detections .npz beside FILE).
Validation: --val-rooms A:B, --val-sparse.

Method: each step takes several scenes and several views of each, and augments every image
(colour, gamma, white balance, blur, noise, JPEG, jittered boxes, ellipses instead of masks half of
the time). Triplet loss on cosines of (foreground, background) together and of each alone. For every
anchor and positive the negative is the soft maximum over all (mostly an identical instance
elsewhere in the room). Ref: Bansal et al., re-OBJ, ICIAP 2019; Sandler et al., MobileNetV2, CVPR
2018 (inverted residual).

Axes: B frames of a batch, D detections of a frame, N of a batch, C channels of the map.
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]
from rendering.config import RoomConfig  # noqa: E402
from rendering.photograph import render_clip  # noqa: E402
from rendering.room import make_room  # noqa: E402

import reobj_track as rt  # noqa: E402
from reobj.appearance.embedding import PartSamples, occupancy_map, sample_parts  # noqa: E402
from reobj.files import atomic  # noqa: E402
from reobj.sources.recorded import RecordedDetections, read_npz  # noqa: E402
from reobj.types import Array, Image, IntArray, box_iou  # noqa: E402

try:
    import torch
    from torch import nn
    from torch.nn import functional as F
except ImportError:
    sys.exit("train_embedding.py needs PyTorch: pip install torch onnx")

SIZE_WH = (320, 240)  # of a training picture; in use the longer side is 320, any shape
STRIDE = 16  # sides of the network's input are multiples of it
# Channels of the map: fixed colours, learned from 15 pixels, learned from the surroundings.
COLOURS, NEAR, DEEP = 17, 24, 40
CHANNELS, WIDTH = COLOURS + NEAR + DEEP, 128  # of the map and of each embedding
FRAMES = 40  # views of each rendered room
SCENES, VIEWS = 3, 8  # of a batch: scenes, and views of each
MOST_IDENTITIES = 24  # of a scene
LOG_STEPS = 100  # between two rows of the log
LAYOUT = {
    "size_px": 320, "context": 0.5, "min_margin": 0.05, "samples": 3, "foreground_cells": 3,
    "background_cells": 4, "surround_scale": 1.5, "surround_min_margin": 0.2,
    "surround_cells": 4, "foreground_channels": COLOURS + NEAR,
}  # fmt: skip


# ---- Clips: pictures with identified boxes -------------------------------------------------------


@dataclass(slots=True)
class Clip:
    """Views of one scene, as lists over its F frames.

    Attributes:
        images: (H, W, 3) BGR. labels: (H, W) uint8 `identity` + 1 at each pixel, or None.
        xyxy: (D, 4) boxes. identity: (D,) within the clip. look: (D,) same for identical instances.
        sure: (D,) whether it masks the background of others (pseudo-objects do not).
    """

    name: str
    images: list[Image]
    labels: list[Image] | None
    xyxy: list[Array]
    identity: list[IntArray]
    look: list[IntArray]
    sure: bool

    def shared(self) -> npt.NDArray[np.float32]:
        """(F, F) number of identities that two frames have in common."""
        count = max((int(i.max(initial=-1)) for i in self.identity), default=-1) + 1
        seen = np.zeros((len(self.images), count), np.float32)
        for row, identity in zip(seen, self.identity, strict=True):
            row[identity] = 1
        return np.asarray(seen @ seen.T, np.float32)


def room_clip(seed: int, cache: Path) -> Clip:
    """Render a room, or read it from the cache."""
    path = room_path(seed, cache)
    if not path.exists():
        render_to(path, seed)
    data = np.load(path)
    boxes, visibility, labels = data["xyxy"], data["visibility"], data["instance"]
    sides = (boxes[..., 2:] - boxes[..., :2]).min(2)  # (F, O), NaN where not in view
    seen = (visibility > 0.3) & (np.nan_to_num(sides) >= 7)
    rows = [np.flatnonzero(row) for row in seen]
    return Clip(
        path.stem.replace("_", " "), list(data["image"]), [label + np.uint8(1) for label in labels],
        [box[row].astype(float) for box, row in zip(boxes, rows, strict=True)],
        rows, [data["look"][row] for row in rows], True,
    )  # fmt: skip


def room_path(seed: int, cache: Path) -> Path:
    """Where a rendered room is kept."""
    return cache / f"room_{seed}.npz"


def render_to(path: Path, seed: int) -> None:
    """Render a room into a cache file: small, in coarse light, its own lens and eye height."""
    rng = np.random.default_rng([seed, 8])
    lens = float(rng.uniform(52, 76))
    eye = float(rng.uniform(1.15, 1.75))
    config = RoomConfig(
        seed=seed, frames=FRAMES, width=SIZE_WH[0], height=SIZE_WH[1], texels_per_m=200.0,
        light_rays=4, shutter=0.0, noise=0.0, exposure=0.1, plan="varied", path="tour",
        hfov_deg=lens, eye_m=eye,
    )  # fmt: skip
    room = make_room(config)
    frames = list(render_clip(room, config))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            image=np.stack([f.image for f in frames]),
            instance=np.stack([f.instance for f in frames]).astype(np.uint8),  # -1 becomes 255
            xyxy=np.stack([f.truth.visible_xyxy for f in frames]).astype(np.float32),
            visibility=np.stack([f.truth.visibility for f in frames]).astype(np.float32),
            look=np.array([o.twin_group for o in room.objects]),
        )


@functools.lru_cache
def read_pictures(folder: Path) -> dict[str, tuple[Image, float]]:
    """All images of a folder with a longer side of twice the network's, and their scale."""
    pictures = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in (".jpg", ".jpeg", ".png"):
            continue
        image = cv2.imread(str(path))
        if image is None:
            raise SystemExit(f"error: {path}: not an image that OpenCV reads")
        scale = min(1.0, 2.0 * SIZE_WH[0] / max(image.shape[:2]))
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        pictures[path.name] = np.asarray(small, np.uint8), scale
    if not pictures:
        raise SystemExit(f"error: {folder}: no images (.jpg, .png) in it")
    return pictures


POINTS = 400  # pseudo-objects of a clip


def sparse_clip(folder: Path, model: Path, seed: int = 0) -> Clip:
    """Pseudo-objects of a COLMAP model: balls around 3D points that three views or more observe."""
    import pycolmap

    pictures = read_pictures(folder)
    scene = pycolmap.Reconstruction(str(model))
    rng = np.random.default_rng([seed, 9])
    long = sorted(i for i, point in scene.points3D.items() if point.track.length() >= 3)
    keep = rng.permutation(long)[: 4 * POINTS]
    row_of = {int(point): row for row, point in enumerate(keep)}
    # box side over the picture's height
    relative = np.exp(rng.uniform(np.log(0.05), np.log(0.3), len(keep)))
    size = np.zeros(len(keep))  # ball's diameter, set by the first view
    clip = Clip(f"{folder.parent.name}/{folder.name}", [], None, [], [], [], False)
    for image in sorted(scene.images.values(), key=lambda image: str(image.name)):
        if image.name not in pictures or not image.has_pose:
            continue
        picture, _ = pictures[image.name]
        seen = [p for p in image.points2D if p.has_point3D() and int(p.point3D_id) in row_of]
        rows = np.array([row_of[int(p.point3D_id)] for p in seen], np.int64)
        world = np.array([scene.points3D[int(p.point3D_id)].xyz for p in seen]).reshape(-1, 3)
        pose = np.asarray(image.cam_from_world().matrix())
        depth = np.maximum(world @ pose[2, :3] + pose[2, 3], 1e-6)
        focal = image.camera.mean_focal_length() / image.camera.height
        size[rows] = np.where(size[rows] > 0, size[rows], relative[rows] * depth / focal)
        side = size[rows] * focal / depth * picture.shape[0]
        xy = np.array([p.xy for p in seen]).reshape(-1, 2) * (picture.shape[1] / image.camera.width)
        add_view(clip, picture, np.c_[xy - side[:, None] / 2, xy + side[:, None] / 2], rows)
    center = np.array([scene.points3D[int(point)].xyz for point in keep])
    return keep_identities(clip, apart(center, size)[:POINTS])


def apart(center: Array, size: Array) -> IntArray:
    """Rows of balls that were seen and hardly overlap with an earlier one.

    Overlapping balls would give one position two identities.
    """
    kept: list[int] = []
    for row in np.flatnonzero(size > 0):
        distance = np.linalg.norm(center[kept] - center[row], axis=1)
        if (distance > 0.375 * (size[kept] + size[row])).all():
            kept.append(int(row))
    return np.array(kept, np.int64)


def keep_identities(clip: Clip, wanted: IntArray) -> Clip:
    """Drop all boxes but those of the wanted identities."""
    for frame, identity in enumerate(clip.identity):
        keep = np.isin(identity, wanted)
        columns: tuple[list[Any], ...] = (clip.xyxy, clip.identity, clip.look)
        for column in columns:
            column[frame] = column[frame][keep]
    return clip


def tracks_clip(folder: Path, tracks: Path) -> Clip:
    """Identities of `tracks.txt` (frame, id, x, y, w, h, ...; frame 1 is the first image).

    Masks come from the detections beside it: OUT/cache of `run`, or a detections .npz.
    """
    rows, found = np.loadtxt(tracks, delimiter=",", ndmin=2), recorded_masks(tracks.parent)
    clip = Clip(f"{folder.parent.name}/{tracks.name}", [], [] if found else None, [], [], [], True)
    names, identity = np.unique(rows[:, 1], return_inverse=True)
    if len(names) > 254:
        clip.labels = None  # more than a byte holds
    for number, (picture, scale) in enumerate(read_pictures(folder).values(), 1):
        own = rows[:, 0] == number
        corners = np.c_[rows[own, 2:4], rows[own, 2:4] + rows[own, 4:6]] * scale
        label = np.zeros(picture.shape[:2], np.uint8)
        for recorded in found:
            paint(label, recorded.at(number - 1), corners, identity[own])
        add_view(clip, picture, corners, identity[own], label=label)
    return clip


def recorded_masks(folder: Path) -> list[RecordedDetections]:
    """Detections with masks in an output folder of `run` or beside a tracks.txt."""
    found = []
    for path in sorted([*folder.glob("cache/*/chunk_*.npz"), *folder.glob("*.npz")]):
        with np.load(path) as data:
            if "mask_counts" not in data or not len(data["mask_counts"]):
                continue
            size = tuple(data["image_size"].tolist())
        found.append(read_npz(path, size, size))
    return found


def paint(label: Image, found: rt.Detections, xyxy: Array, identity: IntArray) -> None:
    """Draw into a label image (H, W) the masks of detections that overlap with a box by 70 %."""
    if found.masks is None or not len(identity):
        return
    ratio = np.tile(np.divide(label.shape[::-1], found.masks.shape[:0:-1]), 2)
    overlap = box_iou(xyxy, found.xyxy * ratio)  # (D, M)
    for row in np.flatnonzero(overlap.max(1) > 0.7):
        mask = found.masks[overlap[row].argmax()].astype(np.uint8)
        label[cv2.resize(mask, label.shape[::-1]) > 0] = identity[row] + 1


def add_view(
    clip: Clip, picture: Image, xyxy: Array, identity: IntArray, label: Image | None = None
) -> None:
    """Append a view with those boxes that lie in it for the most part and are neither tiny nor
    huge. label: for clips that have labels.
    """
    limit = np.array(picture.shape[1::-1] * 2, float)
    inside = np.clip(xyxy, 0, limit)
    area = np.prod(inside[:, 2:] - inside[:, :2], axis=1)
    filled = area / np.maximum(np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1), 1e-9)
    side = (inside[:, 2:] - inside[:, :2]).min(1, initial=np.inf) / limit[0]
    keep = (filled > 0.6) & (side > 0.025) & (side < 0.8)
    clip.images.append(picture)
    clip.xyxy.append(inside[keep])
    clip.identity.append(identity[keep])
    clip.look.append(identity[keep])
    if clip.labels is not None and label is not None:
        clip.labels.append(label)


# ---- Augmentation --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class View:
    """One augmented picture with the samples of its boxes on the feature map."""

    picture: Image  # (H, W, 3)
    identity: IntArray  # (D,)
    look: IntArray  # (D,)
    samples: PartSamples


def photo_tone(rng: np.random.Generator, strength: float) -> Callable[[Image], Image]:
    """A random change of gamma, gain, white balance, contrast and saturation."""
    gamma = np.exp(rng.normal(0, 0.3 * strength))
    gains = np.exp(rng.normal(0, 0.16 * strength) + rng.normal(0, 0.09 * strength, 3))
    lift = rng.uniform(0, 0.1 * strength)
    fade = np.clip(rng.normal(1 - 0.15 * strength, 0.25 * strength), 0.1, 1.6)
    table = np.arange(256)[:, None] / 255.0
    curve = np.clip((table**gamma * gains) * (1 - lift) + lift, 0, 1) * 255
    lut = np.ascontiguousarray(curve.astype(np.uint8)[None])  # (1, 256, 3)

    def change(image: Image) -> Image:
        image = np.asarray(cv2.LUT(image, lut), np.uint8)
        gray = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
        return np.asarray(cv2.addWeighted(image, fade, gray, 1 - fade, 0), np.uint8)

    return change


def degrade(rng: np.random.Generator, image: Image) -> Image:
    """Blur of motion or focus, coarser resolution, sensor noise, JPEG."""
    kind = rng.random()
    if kind < 0.2:
        kernel = np.zeros((9, 9), np.float32)
        reach, turn = rng.uniform(1, 4), rng.uniform(0, np.pi)
        step = np.array([np.cos(turn), np.sin(turn)]) * reach
        ends = np.round(4 + np.stack([-step, step])).astype(int).tolist()
        cv2.line(kernel, ends[0], ends[1], (1.0,))
        image = np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)
    elif kind < 0.4:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.3)), np.uint8)
    if rng.random() < 0.5:
        noise = rng.standard_normal(image.shape, np.float32) * np.float32(rng.uniform(1, 6))
        image = np.asarray(np.clip(image + noise, 0, 255), np.uint8)
    if rng.random() < 0.4:
        code = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 95))]
        image = np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, code)[1], 1), np.uint8)
    return image


def crop_window(
    rng: np.random.Generator, image: Image, least: float, size_wh: tuple[int, int]
) -> tuple[Array, float]:
    """Corner (2,) and factor of a random window with the training picture's shape."""
    height, width = image.shape[:2]
    fit = min(width / size_wh[0], height / size_wh[1]) * least ** rng.uniform(0, 1)
    extent = np.array(size_wh) * fit
    return rng.uniform(0, 1, 2) * (np.array([width, height]) - extent), float(1 / fit)


def augmented(
    clip: Clip,
    frame: int,
    rng: np.random.Generator,
    change: Callable[[Image], Image] | None,
    flip: bool,
    wanted: IntArray,
    size_wh: tuple[int, int] = SIZE_WH,
    masked: float = 0.5,
) -> tuple[Image, rt.Detections, IntArray]:
    """Augment one frame (change None: leave it, for validation). masked: fraction that keeps masks.

    Returns a picture of this size, all boxes in it, and the rows (N,) of the wanted identities.
    """
    image, augment = clip.images[frame], change is not None
    least = np.clip(0.6 * size_wh[0] / image.shape[1], 0.3, 0.6) if augment else 1.0
    corner, factor = crop_window(rng, image, least, size_wh)
    warp = np.array([[factor, 0, -factor * corner[0]], [0, factor, -factor * corner[1]]])
    if flip:
        warp = np.array([[-1.0, 0, size_wh[0]], [0, 1.0, 0]]) @ np.vstack([warp, [0, 0, 1]])
    pixel = warp.copy()
    pixel[:, 2] += warp[:, :2] @ [0.5, 0.5] - 0.5  # pixel centres lie at .5
    flags = cv2.INTER_LINEAR if factor >= 1 else cv2.INTER_AREA
    picture = np.asarray(cv2.warpAffine(image, pixel, size_wh, flags=flags), np.uint8)
    xyxy = clip.xyxy[frame] @ np.kron(np.eye(2), warp[:, :2]).T + np.tile(warp[:, 2], 2)
    xyxy = np.c_[np.minimum(xyxy[:, :2], xyxy[:, 2:]), np.maximum(xyxy[:, :2], xyxy[:, 2:])]
    if change is not None:
        picture = degrade(rng, photo_tone(rng, 0.15)(change(picture)))
    keep, boxes = jittered(rng, xyxy, 0.04 if augment else 0.0, size_wh)
    keep &= np.isin(clip.identity[frame], wanted)
    masks = None
    if clip.labels is not None and (not augment or rng.random() < masked):
        label = cv2.warpAffine(clip.labels[frame], pixel, size_wh, flags=cv2.INTER_NEAREST)
        masks = label[None] == (clip.identity[frame] + 1)[:, None, None]
    score = np.full(len(boxes), float(clip.sure))
    if augment and not clip.sure:
        score = (rng.random(len(boxes)) < 0.03).astype(float)
    found = rt.Detections(boxes, score, np.zeros(len(boxes), np.int64), masks)
    return picture, found, np.flatnonzero(keep)


def make_view(
    clip: Clip,
    frame: int,
    rng: np.random.Generator,
    change: Callable[[Image], Image] | None,
    flip: bool,
    wanted: IntArray,
) -> View:
    """Augment one frame as `augmented` does and sample its boxes."""
    picture, found, rows = augmented(clip, frame, rng, change, flip, wanted)
    shape = (SIZE_WH[1] // 4, SIZE_WH[0] // 4)
    objects = occupancy_map(found, SIZE_WH[::-1], shape, layout().object_score)
    samples = sample_parts(found, [rows, rows], SIZE_WH[::-1], objects, layout())
    return View(picture, clip.identity[frame][rows], clip.look[frame][rows], samples)


def layout() -> rt.SamplingLayout:
    """Where the map is sampled."""
    return rt.SamplingLayout(**LAYOUT)  # type: ignore[arg-type]


def jittered(
    rng: np.random.Generator, xyxy: Array, sigma: float, size_wh: tuple[int, int]
) -> tuple[npt.NDArray[np.bool_], Array]:
    """Boxes as a detector would draw them, and which of them are still in view (40 %)."""
    extent = np.tile(xyxy[:, 2:] - xyxy[:, :2], 2)
    moved = xyxy + rng.normal(0, 1, xyxy.shape) * sigma * extent
    cut = np.clip(moved, 0, [*size_wh, *size_wh])
    sides = cut[:, 2:] - cut[:, :2]
    keep = (sides.prod(1) > 0.4 * extent[:, :2].prod(1)) & (
        sides.min(1, initial=np.inf) >= size_wh[0] / 50
    )
    return keep, cut


def pick_frames(clip: Clip, shared: Any, rng: np.random.Generator) -> IntArray:
    """A frame, frames that show some of the same objects, and two of anywhere."""
    first = int(rng.choice(len(shared), p=shared.diagonal() / shared.diagonal().sum()))
    chance = np.minimum(shared[first], 3) + 0.0  # so that the other visit is not outnumbered
    chance[first] = 0
    friends = rng.permutation(np.flatnonzero(chance))
    weights = chance[friends] / max(chance.sum(), 1e-9)
    count = min(VIEWS - 3, len(friends))
    picked = rng.choice(friends, count, replace=False, p=weights) if count else friends
    rest = np.setdiff1d(np.arange(len(shared)), [first, *picked])
    others = rng.choice(rest, min(VIEWS - 1 - count, len(rest)), replace=False)
    return np.concatenate([[first], picked, others]).astype(np.int64)


def draw_scene(clip: Clip, shared: Any, rng: np.random.Generator) -> list[View]:
    """Several augmented views of one scene."""
    frames = pick_frames(clip, shared, rng)
    tone, flip = photo_tone(rng, 1.0), bool(rng.random() < 0.5)
    seen, times = np.unique(np.concatenate([clip.identity[f] for f in frames]), return_counts=True)
    order = np.argsort(-times + rng.random(len(times)))
    wanted = seen[order[:MOST_IDENTITIES]]
    return [make_view(clip, int(f), rng, tone, flip, wanted) for f in frames]


# ---- Network -------------------------------------------------------------------------------------


def block(inner: int, outer: int, kernel: int = 3, stride: int = 1, groups: int = 1) -> nn.Module:
    """Convolution, batch norm, ReLU."""
    conv = nn.Conv2d(inner, outer, kernel, stride, kernel // 2, groups=groups, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outer), nn.ReLU(inplace=True))


class Residual(nn.Module):
    """Inverted residual: widen, filter each channel, narrow again."""

    def __init__(self, inner: int, outer: int, stride: int = 1, widen: int = 2) -> None:
        super().__init__()
        wide = widen * inner
        self.body = nn.Sequential(
            block(inner, wide, 1),
            block(wide, wide, 3, stride, wide),
            nn.Conv2d(wide, outer, 1, bias=False),
            nn.BatchNorm2d(outer),
        )
        self.same = stride == 1 and inner == outer

    def forward(self, x: Any) -> Any:
        return x + self.body(x) if self.same else self.body(x)


class ColourMap(nn.Module):
    """Soft histogram of Lab colour and gradients at 1/4 of the picture; nothing of it is trained.

    Three colour values of 0 to 255 (B, 3, H, W), BGR, to (B, 17, H / 4, W / 4).
    """

    def __init__(self) -> None:
        """Put in one convolution each what is linear: mean and range of the pixels; of the roots of
        X, Y, Z: chroma, its length in every direction, four times the lightness; its edges.
        """
        super().__init__()
        turn = torch.arange(6) * (2 * np.pi / 6)
        turns = torch.stack([turn.cos(), turn.sin()], 1)  # (6, 2)
        xyz = [[0.1805 / 0.9505, 0.3576 / 0.9505, 0.4124 / 0.9505], [0.0722, 0.7152, 0.2126],
               [0.9505 / 1.089, 0.1192 / 1.089, 0.0193 / 1.089]]  # fmt: skip
        sobel = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]]) * 0.58
        sobel = torch.stack([sobel, sobel.T])  # (2, 3, 3)
        chroma = torch.tensor([[12.5, -12.5, 0], [0, 5, -5]])
        level = torch.tensor([[0, 4.64, 0]]).repeat(5, 1)
        parts = {
            "mean": torch.eye(3)[..., None, None].repeat(1, 1, 4, 4) / (16 * 255),
            "xyz": torch.tensor(xyz)[..., None, None],  # sRGB, D65, BGR order
            "linear": torch.cat([chroma, turns @ chroma, level])[..., None, None],
            "offset": torch.cat([torch.zeros(8), -0.64 - torch.arange(5.0)]),
            "edges": torch.cat([sobel, torch.einsum("kc,cij->kij", turns, sobel)])[:, None],
        }
        for name, value in parts.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, x: Any) -> Any:
        x = F.conv2d(x, self.mean, stride=4)
        x = x * (x * (x * 0.305306011 + 0.682171111) + 0.012522878)  # sRGB to linear light
        f = (F.conv2d(x, self.xyz).clamp_min(0.001).log() / 3).exp()  # cube root, vectorised
        chroma, ahead, levels = F.conv2d(f, self.linear, self.offset).split([2, 6, 5], 1)
        lightness = F.pad(f[:, 1:2], (1, 1, 1, 1), mode="replicate")  # but for factor and offset
        edges, across = F.conv2d(lightness, self.edges).split([2, 6], 1)
        levels = F.relu(1 - levels.abs()) * 0.5
        return torch.cat(
            [self.directions(chroma, ahead), levels, self.directions(edges, across)], 1
        )

    def directions(self, vector: Any, ahead: Any) -> Any:
        """Cosine^4 with every direction, times the length up to 1; ahead: length along each."""
        square = (vector * vector).sum(1, keepdim=True) + 1e-8
        ahead = F.relu(ahead)
        ahead = ahead * ahead
        return ahead * ahead * (square.sqrt().clamp_max(1.0) / (square * square))


class Backbone(nn.Module):
    """BGR bytes (B, H, W, 3) to a map (B, H / 4, W / 4, CHANNELS).

    Fixed colours, features that see 15 pixels (for the foreground), and features of a way down to
    1/16 and up again, which see the surroundings.
    """

    def __init__(self) -> None:
        super().__init__()
        self.scaled = True  # pictures are divided by 64; in the exported graph the weights are
        self.colour = ColourMap()
        self.stem = nn.Sequential(
            block(3, 16, 3, 2),
            block(16, 16, 3, 2, 16),
            block(16, 24, 1),
            Residual(24, 24, widen=1),
        )
        self.near = block(24, NEAR, 1)
        self.down8 = nn.Sequential(block(24, 40, 3, 2), Residual(40, 40))
        self.down16 = nn.Sequential(Residual(40, 80, 2), Residual(80, 80), Residual(80, 80))
        self.side16 = nn.Conv2d(80, DEEP, 1)
        self.side8 = nn.Conv2d(40, DEEP, 1)
        self.side4 = nn.Conv2d(24, DEEP, 1)
        self.mix8 = nn.Sequential(block(DEEP, DEEP, 3, 1, DEEP), block(DEEP, DEEP, 1))
        self.mix4 = block(DEEP, DEEP, 3, 1, DEEP)

    def forward(self, image: Any) -> Any:
        x = image.permute(0, 3, 1, 2).float()
        x4 = self.stem(x / 64 if self.scaled else x)
        x8 = self.down8(x4)
        x16 = self.side16(self.down16(x8))
        y8 = self.mix8(self.side8(x8) + F.interpolate(x16, scale_factor=2.0, mode="nearest"))
        y4 = self.mix4(self.side4(x4) + F.interpolate(y8, scale_factor=2.0, mode="nearest"))
        with torch.no_grad():
            fixed = self.colour(x)
        return torch.cat([fixed, self.near(x4), y4], 1).permute(0, 2, 3, 1)


class PartHead(nn.Module):
    """Cells of one part, (N, cells * (C + 2)) of grids of the same side, to unit rows (N, WIDTH).

    A linear map of the colour histogram, which starts as its principal components (so that
    training starts from the training-free descriptor), plus a perceptron that sees the cells as
    they lie and their rows, left and right forgotten: what is beside an object from the front is
    behind it from the side, but above stays above.
    """

    def __init__(self, grids: int, side: int, channels: int, word: int = 64) -> None:
        super().__init__()
        self.grids, self.side, self.channels = grids, side, channels
        self.cells, brief = grids * side * side, 24
        self.project = nn.Linear(self.cells * COLOURS, WIDTH, bias=False)
        self.word = nn.Sequential(
            nn.Linear(channels + 2, word), nn.ReLU(), nn.Linear(word, word), nn.ReLU()
        )
        self.brief = nn.Linear(word, brief, bias=False)
        self.mix = nn.Sequential(
            nn.Linear(self.cells * brief + grids * side * word * 2, 144, bias=False),
            nn.BatchNorm1d(144),
            nn.ReLU(),
            nn.Linear(144, WIDTH),
        )
        nn.init.zeros_(self.mix[-1].weight)
        nn.init.zeros_(self.mix[-1].bias)

    def histogram(self, colours: Any, share: Any) -> Any:
        """Unit rows (N, cells * COLOURS) of square roots; part-empty cells count less."""
        share = share.reshape(-1, self.grids, self.side**2)
        trust = (share / share.amax(2, keepdim=True).clamp_min(1e-6)).reshape(-1, 1)
        return unit((colours * trust + 1e-12).sqrt().reshape(-1, self.cells * COLOURS))

    def seen(self, words: Any, share: Any) -> Any:
        """What the perceptron sees: short words of all cells, mean and maximum of every row."""
        words = words * share.sign()
        wide = self.brief.in_features
        word, weight = words.reshape(-1, self.side, wide), share.reshape(-1, 1, self.side)
        mean = weight @ word / weight.sum(2, keepdim=True).clamp_min(1e-6)  # (rows, 1, word)
        brief = self.brief(words).reshape(-1, self.cells * self.brief.out_features)
        lines = [part.reshape(-1, self.grids * self.side * wide) for part in (mean, word.amax(1))]
        return torch.cat([brief, *lines], 1)

    def forward(self, rows: Any) -> Any:
        cells = rows.reshape(-1, self.channels + 2)  # of all objects: exports as few, plain nodes
        if self.training:  # some cells are masked
            cells = cells * (torch.rand_like(cells[:, :1]) > 0.1)
        colours, rest, share, others = cells.split([COLOURS, self.channels - COLOURS, 1, 1], 1)
        words = self.word(torch.cat([(colours + 1e-6).sqrt(), rest, share, others], 1))
        joint = self.project(self.histogram(colours, share)) + self.mix(self.seen(words, share))
        return unit(joint)


def unit(rows: Any) -> Any:
    """Rows (N, E) of unit length."""
    return rows / rows.norm(dim=1, keepdim=True)


class Head(nn.Module):
    """Cells of foreground and background to two unit embeddings."""

    def __init__(self) -> None:
        super().__init__()
        fore, near, wide = (
            int(LAYOUT[f"{k}_cells"]) for k in ("foreground", "background", "surround")
        )
        assert near == wide
        self.parts = nn.ModuleList(
            [PartHead(1, fore, int(LAYOUT["foreground_channels"])), PartHead(2, near, CHANNELS)]
        )

    def forward(self, fg: Any, bg: Any) -> tuple[Any, Any]:
        return self.parts[0](fg), self.parts[1](bg)


class Net(nn.Module):
    """Backbone, pooling as in `reobj_track.Embedder`, head."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone, self.head = Backbone(), Head()

    def forward(self, views: Sequence[View], device: Any) -> tuple[Any, Any]:
        images = torch.from_numpy(np.stack([v.picture for v in views])).to(device)
        result: tuple[Any, Any] = self.head(*self.cells(views, images))
        return result

    def cells(self, views: Sequence[View], images: Any) -> list[Any]:
        """What the heads see of all objects of the views."""
        maps = self.backbone(images)
        flat, size = maps.reshape(-1, CHANNELS), maps.shape[1] * maps.shape[2]
        fore, back = pooled(flat, [v.samples for v in views], size)
        own = torch.cat([fore[..., : LAYOUT["foreground_channels"]], fore[..., CHANNELS:]], -1)
        return [own.flatten(1), back.flatten(1)]

    def start_from_colour(self, views: Sequence[View], device: Any) -> None:
        """Set the heads' linear maps to the principal components of these views' histograms."""
        with torch.no_grad():
            images = torch.from_numpy(np.stack([v.picture for v in views])).to(device)
            for head, cells in zip(self.head.parts, self.cells(views, images), strict=True):
                cells = cells.reshape(-1, head.channels + 2)
                rows = head.histogram(cells[:, :COLOURS], cells[:, head.channels])
                principal(head.project.weight, rows)


def principal(weight: Any, rows: Any) -> None:
    """Set the first rows of a weight (K, C) to the principal components of rows (N, C)."""
    axes = torch.linalg.svd(rows.T @ rows)[0].T[: len(weight)]
    weight[: len(axes)] = axes


def pooled(flat: Any, samples: Sequence[PartSamples], cells_a_map: int) -> list[Any]:
    """Pool cells (N, cells, C + 2) of all foregrounds and backgrounds, as
    `reobj.appearance.embedding.pool_cells` does; flat: all maps' cells, one map after the other.
    """
    index = np.concatenate([s.index + i * cells_a_map for i, s in enumerate(samples)])
    weight = np.concatenate([s.weight for s in samples]).astype(np.float32)  # (cells, S)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1)
    share = np.concatenate([s.share for s in samples])
    rows, weights, shares = (torch.from_numpy(a).to(flat.device) for a in (index, weight, share))
    mean = F.embedding_bag(rows, flat, mode="sum", per_sample_weights=weights)
    views = torch.cat([mean, shares], 1).split([len(s.index) for s in samples])
    parts = [s.split(cells) for s, cells in zip(samples, views, strict=True)]
    return [torch.cat(part) for part in zip(*parts, strict=True)]


# ---- Loss ----------------------------------------------------------------------------------------


def triplet_loss(rows: Any, same: Any, different: Any, temperature: float = 0.1) -> Any:
    """Soft-margin triplet loss log(1 + exp((s_an - s_ap) / T)) over all anchors and positives.

    The negative s_an of an anchor is the soft maximum of all of them.

    Args:
        rows: (N, E) unit rows. same, different: (N, N) bool, positives and negatives of each row.
    """
    cosine = rows @ rows.T
    anchor, positive = torch.nonzero(same & different.any(1)[:, None], as_tuple=True)
    if not len(anchor):
        return rows.sum() * 0
    others = cosine[anchor].masked_fill(~different[anchor], -2.0)  # (P, N)
    far = temperature * torch.logsumexp(others / temperature, 1)
    return (F.softplus((far - cosine[anchor, positive]) / temperature) * temperature).mean()


def parts_loss(parts: Sequence[Any], scene: IntArray, identity: IntArray, frame: IntArray) -> Any:
    """Triplet loss of all parts (N, E) together, and a quarter as much of each, if there are two.

    Args:
        scene, identity, frame: (N,) of each row; identities are those within the scene.
    """
    identity = identity + 10000 * scene
    one = identity[:, None] == identity
    apart = frame[:, None] != frame
    same, different = (torch.from_numpy(x).to(parts[0].device) for x in (one & apart, ~one))
    loss = triplet_loss(torch.cat(list(parts), 1) * len(parts) ** -0.5, same, different)
    for alone in parts if len(parts) > 1 else ():
        loss = loss + 0.25 * triplet_loss(alone, same, different)
    return loss


# ---- Validation ----------------------------------------------------------------------------------


def rank_one(net: Net, clips: Sequence[Clip], device: Any) -> dict[str, float]:
    """Rank-1 among objects of one scene: `single`: identical instances, where there are two or
    more, among one random view of each (ten draws); `all`: any. Queries search frames at least
    30 % of the clip away from their own.
    """
    net.eval()
    found = []
    for clip in clips:
        rng = np.random.default_rng(0)
        everything = np.unique(np.concatenate(clip.identity))
        step = max(1, len(clip.images) // 40)
        views = [make_view(clip, f, rng, None, False, everything)
                 for f in range(0, len(clip.images), step)]  # fmt: skip
        with torch.no_grad():
            done = [net(views[i : i + 10], device) for i in range(0, len(views), 10)]
        rows = [torch.cat([d[k] for d in done]).cpu().numpy() for k in (0, 1)]
        frame = np.concatenate([np.full(len(v.identity), f) for f, v in enumerate(views)])
        identity = np.concatenate([v.identity for v in views])
        found.append((rows, frame, identity, np.concatenate([v.look for v in views])))
    net.train()
    return mean_hits(found)


def mean_hits(clips: Sequence[Any]) -> dict[str, float]:
    """Rank-1 of all parts together, from (rows of parts, frame, identity, look) of each clip."""
    hits: dict[str, list[float]] = {"single": [], "all": []}
    for rows, frame, identity, look in clips:
        cosine = sum(part @ part.T for part in rows)
        far = np.abs(frame[:, None] - frame) >= max(1, int(0.3 * (frame.max() + 1)))
        identical = far & (look[:, None] == look)
        for gallery in single_views(identical, identity):
            hits["single"] += first_hits(cosine, identity, gallery)
        hits["all"] += first_hits(cosine, identity, far)
    return {name: float(np.mean(found)) if found else float("nan") for name, found in hits.items()}


def single_views(gallery: Any, identity: IntArray, draws: int = 10) -> list[Any]:
    """Keep one random view of each identity in every query's gallery (N, N)."""
    rng, kept = np.random.default_rng(0), []
    for _ in range(draws):
        order = np.where(gallery, rng.random(len(identity)), -1.0)
        keep = np.zeros_like(gallery)
        for one in np.unique(identity):
            columns = np.flatnonzero(identity == one)
            best = columns[order[:, columns].argmax(1)]
            keep[np.arange(len(gallery)), best] = True
        kept.append(keep & gallery)
    return kept


def first_hits(cosine: Any, identity: IntArray, gallery: Any) -> list[float]:
    """For each query with a positive and a negative in its gallery: is the nearest one right?"""
    same = identity[:, None] == identity
    asked = (gallery & same).any(1) & (gallery & ~same).any(1)
    best = np.where(gallery, cosine, -9.0).argmax(1)
    return [float(hit) for hit in (identity[best] == identity)[asked]]


# ---- Training ------------------------------------------------------------------------------------


def real_clips(args: argparse.Namespace) -> list[Clip]:
    """Clips of recordings; other pseudo-objects of the same pictures for each of four draws."""
    clips = [
        sparse_clip(images, model, 4 * args.seed + draw)
        for images, model in args.sparse
        for draw in range(4)
    ]
    return clips + [tracks_clip(images, tracks) for images, tracks in args.tracks]


class Pool:
    """Training clips, each with the objects that its frames share."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.clips = [real_clips(args), [room_clip(seed, args.cache) for seed in args.rooms]]
        self.shared = [[clip.shared() for clip in clips] for clips in self.clips]
        if not any(self.clips):
            raise SystemExit("error: nothing to train on: give --rooms, --sparse or --tracks")

    def draw(self, rng: np.random.Generator) -> list[list[View]]:
        """Scenes of one batch: recordings for a third of them, if there are any."""
        real, rooms = self.clips
        scenes: list[list[View]] = []
        while len(scenes) < SCENES:
            kind = 0 if real and (not rooms or rng.random() < 0.34) else 1
            row = int(rng.integers(len(self.clips[kind])))
            views = draw_scene(self.clips[kind][row], self.shared[kind][row], rng)
            if sum(len(v.identity) for v in views) >= 4:
                scenes.append(views)
        return scenes


class Trainer:
    """Network, optimiser and where training stands."""

    def __init__(self, args: argparse.Namespace) -> None:
        torch.manual_seed(args.seed)
        torch.set_num_threads(1)
        self.args = args
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.pool = self.make_pool()
        self.net = self.make_net().to(self.device)
        self.optimizer = torch.optim.AdamW(self.net.parameters(), args.rate, weight_decay=0.05)
        self.step, self.seconds, self.best = 0, 0.0, -1.0
        args.out.mkdir(parents=True, exist_ok=True)
        if args.resume and (args.out / "last.pt").exists():
            self.restore("last.pt")
        else:
            self.start()
        self.val = self.make_val()

    def make_pool(self) -> Any:
        """What to learn from."""
        return Pool(self.args)

    def make_net(self) -> Any:
        """What learns."""
        return Net()

    def make_val(self) -> dict[str, Any]:
        """Clips to validate with."""
        return {
            "room": [room_clip(seed, self.args.cache) for seed in self.args.val_rooms],
            "real": [sparse_clip(*source) for source in self.args.val_sparse],
        }

    def start(self) -> None:
        """Start the heads from the training-free descriptor."""
        rng = np.random.default_rng([self.args.seed, 10])
        views = [view for _ in range(12) for scene in self.pool.draw(rng) for view in scene]
        self.net.eval()
        self.net.start_from_colour(views, self.device)
        self.net.train()

    def progress(self) -> float:
        """Fraction of the training that is done, by steps or by time."""
        limit = self.args.minutes * 60
        return float(max(self.step / self.args.steps, self.seconds / limit if limit else 0.0))

    def learn(self) -> float:
        """One step; returns the loss."""
        done = min(self.progress(), 1.0)
        rate = min((self.step + 1) / 40, max(0.02, 0.5 + 0.5 * float(np.cos(np.pi * done))))
        for group in self.optimizer.param_groups:
            group["lr"] = self.args.rate * rate
        rng = np.random.default_rng([self.args.seed, self.step])
        loss = self.loss(self.pool.draw(rng))
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        self.optimizer.step()
        self.step += 1
        return float(np.asarray(loss.detach().cpu()))

    def loss(self, scenes: Any) -> Any:
        """Loss of one batch."""
        views = [(s, f, v) for s, scene in enumerate(scenes) for f, v in enumerate(scene)]
        count = [len(v.identity) for _, _, v in views]
        scene, frame = (np.repeat([view[k] for view in views], count) for k in (0, 1))
        identity = np.concatenate([v.identity for _, _, v in views])
        parts = self.net([v for _, _, v in views], self.device)
        return parts_loss(parts, scene, identity, frame)

    def score(self, clips: Any) -> dict[str, float]:
        """Rank-1 on validation clips."""
        return rank_one(self.net, clips, self.device)

    def summary(self) -> dict[str, Any]:
        """How it was trained, for the files."""
        return {
            "steps": self.step, "seed": self.args.seed, "minutes": round(self.seconds / 60, 1),
            "rooms": len(self.args.rooms), "torch": torch.__version__,
        }  # fmt: skip

    def run(self) -> None:
        """Train to the end, with a log and checkpoints; go back to the best validation (the last
        of equals).
        """
        losses: list[float] = []
        while self.progress() < 1:
            began = time.monotonic()
            losses.append(self.learn())
            self.seconds += time.monotonic() - began
            if self.step % LOG_STEPS == 0 or self.progress() >= 1:
                self.report(float(np.mean(losses)))
                losses.clear()
        self.restore("best.pt")

    def report(self, loss: float) -> None:
        """A row of the log and a checkpoint."""
        row: dict[str, float] = {"step": self.step, "minutes": round(self.seconds / 60, 2)}
        row["loss"] = round(loss, 5)
        for name, clips in self.val.items():
            row |= {f"{name}_{k}": round(v, 4) for k, v in self.score(clips).items()}
        log = self.args.out / "log.csv"
        fresh = not log.exists()
        with log.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        print(json.dumps(row), flush=True)
        score = float(np.nan_to_num([row["room_single"], row["real_all"]]).sum())
        names = ["last.pt", "best.pt"] if score >= self.best else ["last.pt"]
        self.best = max(self.best, score)
        state = {"net": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}
        state |= {"step": self.step, "seconds": self.seconds, "best": self.best}
        for name in names:
            with atomic(self.args.out / name) as part:
                torch.save(state, part)

    def restore(self, name: str) -> None:
        """Go back to a checkpoint."""
        state = torch.load(self.args.out / name, map_location=self.device, weights_only=True)
        self.net.load_state_dict(state["net"])
        self.optimizer.load_state_dict(state["optimizer"])
        for name in ("step", "seconds", "best"):
            setattr(self, name, state[name])


# ---- Export --------------------------------------------------------------------------------------


def export(net: Net, out: Path, summary: dict[str, Any]) -> None:
    """Write `reobj.onnx` (BGR bytes to map; metadata "reobj") and `reobj_head.onnx`."""
    import onnx

    net = net.cpu().eval()
    with torch.no_grad():
        net.backbone.stem[0][0].weight /= 64
    net.backbone.scaled = False
    image = torch.zeros(1, SIZE_WH[1], SIZE_WH[0], 3, dtype=torch.uint8)
    sizes = {0: "n", 1: "h", 2: "w"}
    rows = tuple(torch.zeros(2, p.cells * (p.channels + 2)) for p in net.head.parts)
    names = ["fg", "bg", "foreground", "background"]
    to_onnx(net.backbone, (image,), out / "reobj.onnx", ["image"], ["map"], sizes)
    to_onnx(net.head, rows, out / "reobj_head.onnx", names[:2], names[2:])
    facts = {"layout": LAYOUT, "multiple": STRIDE, "head": "reobj_head.onnx", "trained": summary}
    model = onnx.load(out / "reobj.onnx")
    onnx.helper.set_model_props(model, {"reobj": json.dumps(facts)})
    onnx.save(model, out / "reobj.onnx")


def to_onnx(
    net: nn.Module, fed: Any, path: Path, inputs: list[str], outputs: list[str], sizes: Any = None
) -> None:
    """Write a network as ONNX; sizes: names of the axes that may vary (default: the first, one
    name for each input and its output).
    """
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    warnings.filterwarnings("ignore", message=".*(legacy|Constant folding|removed).*")
    torch.onnx.export(
        net, fed, str(path), input_names=inputs, output_names=outputs, dynamo=False,
        dynamic_axes={name: sizes or {0: f"n{k % len(inputs)}"}
                      for k, name in enumerate([*inputs, *outputs])}, opset_version=17,
    )  # fmt: skip


# ---- Command line --------------------------------------------------------------------------------


def parse_range(text: str) -> range:
    """A:B as a range, A as one number."""
    first, _, last = text.partition(":")
    return range(int(first), int(last) if last else int(first) + 1)


def pair(text: str) -> tuple[Path, Path]:
    """IMAGES=OTHER as two paths that exist."""
    left, _, right = text.partition("=")
    for part in (left, right):
        if not part or not Path(part).exists():
            raise argparse.ArgumentTypeError(f"{text}: {part or 'IMAGES=PATH'} does not exist")
    return Path(left), Path(right)


def common_options(description: str | None) -> argparse.ArgumentParser:
    """Options of every training."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder for models, checkpoint, log")
    for name, use in (("--rooms", "train on"), ("--val-rooms", "validate with")):
        add(name, type=parse_range, default=range(0), metavar="A:B",
            help=f"seeds of rendered rooms to {use}")  # fmt: skip
    add("--cache", type=Path, default=Path("rooms_cache"), help="folder of rendered rooms")
    for name in ("--sparse", "--val-sparse", "--tracks"):
        add(name, type=pair, action="append", default=[], metavar="IMAGES=PATH")
    add("--steps", type=int, default=3000)
    add("--minutes", type=float, default=0.0, help="stop after N minutes of steps (0: never)")
    add("--rate", type=float, default=1e-3, help="peak learning rate (AdamW, cosine)")
    add("--seed", type=int, default=0)
    add("--resume", action="store_true", help="resume from OUT/last.pt")
    return parser


def parsed(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the options; warns of rooms that both train and validate."""
    args = parser.parse_args(argv)
    cv2.setNumThreads(0)  # a forked process has no threads of its parent
    if both := set(args.rooms) & set(args.val_rooms):
        print(f"warning: rooms {sorted(both)} both train and validate", file=sys.stderr)
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Train and export."""
    args = parsed(common_options(__doc__), argv)
    trainer = Trainer(args)
    trainer.run()
    out: Path = args.out
    export(trainer.net, out, trainer.summary())
    print(f"{out / 'reobj.onnx'}: use it with --embed {out / 'reobj.onnx'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
