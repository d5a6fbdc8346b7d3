#!/usr/bin/env python3
"""Render hand-held videos of furnished rooms with exact ground truth, on the CPU.

    python benchmarks/render_room.py -o DIR --seed 0 --frames 240

writes `room.mp4`, `detections.npz` (detector-like boxes with masks), `gt_mot.txt`,
`gt_objects.json`, `poses.txt` (TUM) and `camera.txt` (COLMAP). Needs numpy and OpenCV only; same
seed, same bytes (the video file itself depends on the codec of the OpenCV build). The clip in
`examples/room` was made with `--seed 0 --frames 240 --crf 21`.

How it works:
  1. `make_room`: a seeded floor plan (`--plan varied --path tour`: another room, other sets of
     identical instances, another look and walk for every seed, for training); furniture made of
     textured parallelograms, discs, spheres and frustums ("patches"); procedural textures in one
     atlas; light baked by ray marching through voxels.
  2. `camera_path`: a smooth walk with hand shake that leaves its first view and returns.
  3. `render`: per patch, 1/z, s/z, t/z are linear in the pixel (quads) or follow from the
     intersection of ray and quadric (round patches); z-buffer at twice the resolution, then one
     texture and one light look-up.
  4. `photograph`: motion blur along the true image flow, exposure drift, vignette, sensor noise.
  5. `ground_truth`, `simulate_detections`, writers.

Conventions: metres, world z up; camera x right, y down, z forward; `b_from_a` maps a to b; pixels
as in COLMAP, the centre of the top-left pixel is (0.5, 0.5), pixel i spans [i, i + 1]; frames
0-based (1-based in MOT files); object frame: origin in the centre, x width, y depth (front is -y),
z height.
Axes: S patches, O objects, F frames, N samples.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Rng = np.random.Generator
Color = tuple[float, float, float]  # B, G, R in 0..255

QUAD, DISC, SPHERE, FRUSTUM = range(4)
NEAR_M = 0.05  # nothing closer to the camera plane is drawn
MIP_LEVELS = 5
ATLAS_WIDTH = 4096  # texels; OpenCV's remap refuses images of 32,768 and more
ATLAS_PAD = 16  # texels of replicated border, 2**(MIP_LEVELS - 1): keeps mip levels from bleeding
COCO_NAMES = tuple(
    (
        "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,"
        "stop sign,parking meter,bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,"
        "backpack,umbrella,handbag,tie,suitcase,frisbee,skis,snowboard,sports ball,kite,"
        "baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,"
        "knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,"
        "chair,couch,potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,"
        "cell phone,microwave,oven,toaster,sink,refrigerator,book,clock,vase,scissors,teddy bear,"
        "hair drier,toothbrush"
    ).split(",")
)


# ---- Configuration ------------------------------------------------------------------------------

PATHS = {
    "revisit": "leaves its first view and comes back",
    "walk": "round the room without coming back",
    "orbit": "a quarter round the dining table",
    "tour": "twice past every table and couch, another way for every seed",
    "table": "photos STEP_M apart, taken standing still, once round a table, weaving up and down",
    "turn": "a walk that stops for two fifths of the frames, where the camera only turns",
    "corridor": "straight on along x, looking to one side",
}
PLANS = {
    "home": "the plan of examples/room",
    "varied": "another room for every seed",
    "corridor": "CORRIDOR_ROOMS rooms of the home plan in a row that look the same",
}


@dataclass(frozen=True, slots=True)
class RoomConfig:
    """Everything that decides a clip. Counts are upper limits of what the plan has places for."""

    seed: int = 0
    width: int = 640  # px
    height: int = 480  # px
    frames: int = 240
    fps: float = 12.0
    hfov_deg: float = 66.0  # a phone's main camera in video mode
    room_m: tuple[float, float, float] = (6.6, 5.4, 2.6)  # width, depth, height before jitter
    room_jitter: float = 0.06  # relative, uniform
    chairs: int = 6  # identical ones: 4 at the table, 2 at the desk
    monitors: int = 2
    cups: int = 4
    bottles: int = 3
    books: int = 5
    plants: int = 2
    couch: bool = True
    extras: bool = True  # laptop, keyboard, mouse, vase, clock, teddy bear, ball, suitcase, bowl
    path: str = "revisit"  # one of PATHS
    plan: str = "home"  # one of PLANS
    eye_m: float = 1.5  # camera height
    shake_deg: float = 0.5  # amplitude of the hand's rotation
    shake_m: float = 0.012  # amplitude of the hand's translation
    texels_per_m: float = 300.0  # motifs (bricks, boards) keep their size in texels
    supersample: int = 2
    shutter: float = 0.18  # of the frame interval: motion blur
    noise: float = 0.9  # sensor noise, grey levels at mid grey
    exposure: float = 0.08  # relative slow drift of the exposure
    light_rays: int = 10  # shadow rays per lamp and light texel


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """How the simulated detector errs."""

    box_sigma: float = 0.012  # of the box side, each edge
    miss_rate: float = 0.03  # of clearly visible objects
    min_visibility: float = 0.25  # half of the objects this visible are found
    min_side_px: float = 10.0  # half of the objects this small are found
    false_positives: float = 0.04  # per frame
    class_confusion: float = 0.0  # probability of a wrong class
    mask_erosion_px: float = 0.6  # mean shift of the mask's outline, inwards
    score_sigma: float = 0.05


# ---- Textures: (rng, height, width, ...) -> uint8 BGR -------------------------------------------


def fractal_noise(
    rng: Rng, height: int, width: int, cells: Sequence[float]
) -> npt.NDArray[np.float32]:
    """Sum smooth random grids with cells of these sizes (texels); large cells weigh more."""
    total = np.zeros((height, width), np.float32)
    weights = np.sqrt(np.asarray(cells)) / np.sqrt(np.asarray(cells)).sum()
    for cell, weight in zip(cells, weights, strict=True):
        rows, cols = max(2, int(height / cell)), max(2, int(width / cell))
        grid = rng.standard_normal((rows, cols)).astype(np.float32)
        total += np.float32(weight) * cv2.resize(
            grid, (width, height), interpolation=cv2.INTER_CUBIC
        )
    return total


def to_image(values: npt.NDArray[Any]) -> Image:
    """Clip to 0..255 and convert."""
    return np.asarray(np.clip(values, 0, 255), np.uint8)


def paint_ellipse(
    image: npt.NDArray[Any],
    center: tuple[int, int],
    axes: tuple[int, int],
    turn_deg: float,
    color: Sequence[float],
    thickness: int = -1,
) -> None:
    """Whole ellipse, filled by default."""
    cv2.ellipse(image, center, axes, turn_deg, 0, 360, color, thickness, cv2.LINE_AA)


def shade(base: Color, tone: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Colour a (H, W) relative tone map: base * (1 + tone)."""
    return np.asarray(np.asarray(base, np.float32) * (1 + tone[..., None]), np.float32)


def speckle(rng: Rng, height: int, width: int, amplitude: float) -> npt.NDArray[np.float32]:
    """Fine grain that gives corners to a feature detector close by."""
    grain = rng.standard_normal((height, width)).astype(np.float32)
    return np.float32(amplitude) * cv2.GaussianBlur(grain, (0, 0), 0.8) * 2.2


def plaster(rng: Rng, height: int, width: int, base: Color, tone: float = 0.07) -> Image:
    """Painted wall: patches of tone, trowel marks, stains, specks."""
    image = shade(base, tone * fractal_noise(rng, height, width, (4, 12, 40, 130, 400)))
    for _ in range(height * width // 9000):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.integers(2, 22)), int(rng.integers(1, 7)))
        color = np.asarray(base) * rng.uniform(0.86, 1.1)
        paint_ellipse(image, center, axes, float(rng.uniform(0, 180)), color.tolist())
    image = 0.5 * image + 0.5 * cv2.GaussianBlur(image, (0, 0), 1.2)
    return to_image(image * (1 + speckle(rng, height, width, 0.03)[..., None]))


def wallpaper(rng: Rng, height: int, width: int, base: Color) -> Image:
    """Painted sprigs of leaves on a striped ground, no two alike."""
    stripes = 0.03 * np.sign(np.sin(np.arange(width) / 24.0))
    image = shade(base, stripes[None, :] + 0.05 * fractal_noise(rng, height, width, (5, 30, 160)))
    for _ in range(height * width // 2600):
        x, y, turn = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, 360)
        size, tint = rng.uniform(5, 15), rng.uniform(0.68, 1.14)
        color = (np.asarray(base) * tint * rng.uniform(0.93, 1.07, 3)).tolist()
        for leaf in range(int(rng.integers(2, 6))):
            angle = turn + leaf * rng.uniform(40, 75)
            step = size * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            center = (int(x + step[0]), int(y + step[1]))
            paint_ellipse(image, center, (int(size), max(1, int(size / 3))), angle, color)
    return to_image(image * (1 + speckle(rng, height, width, 0.025)[..., None]))


def bricks(rng: Rng, height: int, width: int, base: Color) -> Image:
    """Old brick wall with a tone of its own for each brick."""
    image = shade((150, 158, 165), 0.08 * fractal_noise(rng, height, width, (3, 15, 90)))
    row_h, brick_w, joint = 26, 76, 3
    for row in range(-(-height // row_h)):
        shift = (row % 2) * brick_w // 2 + int(rng.integers(-5, 6))
        for col in range(-1, width // brick_w + 2):
            x, y = col * brick_w + shift, row * row_h
            color = np.asarray(base) * rng.uniform(0.7, 1.2) * rng.uniform(0.93, 1.07, 3)
            cut = int(rng.integers(0, 3))
            cv2.rectangle(
                image,
                (x + joint, y + joint),
                (x + brick_w - cut, y + row_h - 1),
                color.tolist(),
                -1,
            )
    tone = 0.16 * fractal_noise(rng, height, width, (3, 7, 18, 60, 250)) + speckle(
        rng, height, width, 0.05
    )
    return to_image(image * (1 + tone[..., None]))


def wood(rng: Rng, height: int, width: int, base: Color, contrast: float = 0.16) -> Image:
    """Grain along the width: stretched noise bent by a slow one, a few knots."""
    long = cv2.resize(
        fractal_noise(rng, height, max(8, width // 16), (2, 4, 9, 24)), (width, height)
    )
    bend = fractal_noise(rng, height, width, (90, 260))
    rings = np.sin(np.arange(height)[:, None] / 5.0 + 5.0 * bend + 1.5 * long).astype(np.float32)
    image = shade(base, contrast * (long + 0.35 * rings + 0.4 * bend))
    for _ in range(height * width // 60000):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        for radius in range(int(rng.integers(3, 8)), 0, -2):
            color = (np.asarray(base) * rng.uniform(0.4, 0.8)).tolist()
            paint_ellipse(image, center, (2 * radius, radius), 0, color, 1)
    return to_image(image * (1 + speckle(rng, height, width, 0.035)[..., None]))


def planks(rng: Rng, height: int, width: int, base: Color) -> Image:
    """Floor boards along the width, each cut from its own piece of wood."""
    image = np.zeros((height, width, 3), np.uint8)
    board_h = 42
    stock = wood(rng, 1024, 1024, base)
    for y in range(0, height, board_h):
        x = -int(rng.integers(0, 300))
        while x < width:
            length, rows = int(rng.integers(220, 460)), min(board_h, height - y)
            x0, x1 = max(x, 0), max(0, min(x + length, width))
            v, u = int(rng.integers(0, 1024 - board_h)), int(rng.integers(0, 1024 - 460))
            piece = stock[v : v + rows, u : u + x1 - x0] * rng.uniform(0.78, 1.15)
            image[y : y + rows, x0:x1] = to_image(piece)
            cv2.line(image, (x0, y), (x0, y + rows), (25, 35, 45), 1)
            x += length
        cv2.line(image, (0, y), (width, y), (25, 35, 45), 1)
    tone = 0.06 * fractal_noise(rng, height, width, (6, 60, 300)) + speckle(
        rng, height, width, 0.03
    )
    return to_image(image * (1 + tone[..., None]))


def fabric(rng: Rng, height: int, width: int, base: Color, motif: bool = False) -> Image:
    """Woven cloth, with seams; optionally with a scattered print."""
    rows, cols = np.arange(height)[:, None], np.arange(width)[None, :]
    weave = 0.06 * np.sin(rows * 1.9) * np.sin(cols * 1.9)
    image = shade(base, weave + 0.1 * fractal_noise(rng, height, width, (2, 5, 20, 90)))
    for _ in range(height * width // 900 if motif else 0):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        color = to_image(
            np.asarray(base) * rng.uniform(0.5, 1.6) + rng.uniform(-30, 30, 3)
        ).tolist()
        cv2.circle(
            image, center, int(rng.integers(2, 9)), color, int(rng.choice([-1, 1, 2])), cv2.LINE_AA
        )
    edge = tuple(float(c) * 0.62 for c in base)
    cv2.rectangle(image, (6, 6), (width - 7, height - 7), edge, 1, cv2.LINE_AA)
    return to_image(image * (1 + speckle(rng, height, width, 0.05)[..., None]))


def plain(rng: Rng, height: int, width: int, base: Color, tone: float = 0.05) -> Image:
    """Plastic, metal, ceramics: nearly even, with scuffs."""
    image = shade(
        base,
        tone * fractal_noise(rng, height, width, (3, 14, 60)) + speckle(rng, height, width, 0.02),
    )
    for _ in range(max(2, height * width // 3000)):
        start = rng.uniform(0, [width, height])
        end = start + rng.normal(0, 9, 2)
        color = (np.asarray(base) * rng.uniform(0.8, 1.15)).tolist()
        cv2.line(image, start.astype(int).tolist(), end.astype(int).tolist(), color, 1, cv2.LINE_AA)
    return to_image(image)


def stamp(
    image: npt.NDArray[Any], text: str, corner: tuple[int, int], size: float, color: Color
) -> None:
    """Write text into a float image (OpenCV 5 writes into 8-bit ones only)."""
    ink = np.zeros(image.shape[:2], np.uint8)
    thickness = max(1, int(size * 2))
    cv2.putText(ink, text, corner, cv2.FONT_HERSHEY_SIMPLEX, size, (255,), thickness, cv2.LINE_AA)
    where = np.nonzero(ink)
    share = ink[where][:, None] / np.float32(255)
    image[where] = image[where] * (1 - share) + np.asarray(color, np.float32) * share


def write_words(
    rng: Rng, image: npt.NDArray[Any], area: tuple[int, int, int, int], color: Color, size: float
) -> None:
    """Fill the rectangle x, y, w, h with lines of made-up words."""
    x, y, width, height = area
    letters = np.array(list("aeionrstlumdcpbgkv"))
    step = max(4, int(30 * size))
    for line in range(y + step, y + height, step):
        count = max(2, int(width / (19 * size)))
        text = "".join(rng.choice(letters, count))
        for space in rng.integers(1, count, max(1, count // 6)):
            text = text[:space] + " " + text[space + 1 :]
        stamp(image, text, (x, line), size, color)


def random_color(rng: Rng, low: float = 30, high: float = 225) -> Color:
    """A colour that is neither grey nor neon."""
    natural = [
        (55, 85, 190),
        (70, 165, 215),
        (70, 130, 120),
        (75, 105, 60),
    ]  # rust, mustard, olive, forest
    natural += [
        (130, 125, 45),
        (205, 170, 120),
        (120, 75, 40),
        (95, 60, 110),
    ]  # teal, sky, navy, plum
    natural += [(60, 60, 165), (150, 190, 215), (200, 225, 235)]  # brick, sand, cream
    natural += [(70, 66, 62), (120, 140, 190)]  # charcoal, clay
    color = np.array(natural[int(rng.integers(len(natural)))]) + rng.normal(0, 9, 3)
    color = 0.82 * color + 0.18 * color.mean()
    color = np.clip(color * rng.uniform(low, high) / color.max(), 5, 250)
    return float(color[0]), float(color[1]), float(color[2])


def art_abstract(rng: Rng, image: npt.NDArray[Any]) -> None:
    """Overlapping shapes in a palette of five colours."""
    height, width = image.shape[:2]
    palette = [random_color(rng, 60, 240) for _ in range(5)]
    for _ in range(46):
        color = palette[int(rng.integers(5))]
        points = rng.uniform(0, 1, 2) * [width, height] + rng.normal(
            0, 0.16 * width, (int(rng.integers(3, 6)), 2)
        )
        if rng.random() < 0.5:
            cv2.fillPoly(image, [points.astype(np.int32)], color, cv2.LINE_AA)
        else:
            radius = int(rng.uniform(0.02, 0.16) * width)
            cv2.circle(
                image,
                points[0].astype(int).tolist(),
                radius,
                color,
                int(rng.choice([-1, 2, 5])),
                cv2.LINE_AA,
            )


def art_landscape(rng: Rng, image: npt.NDArray[Any]) -> None:
    """Sky, sun and rows of hills with trees."""
    height, width = image.shape[:2]
    top, bottom = np.asarray(random_color(rng, 120, 220)), np.asarray(random_color(rng, 180, 250))
    ramp = np.linspace(0, 1, height)[:, None, None]
    image[:] = top * (1 - ramp) + bottom * ramp
    sun = (int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.12, 0.35) * height))
    cv2.circle(image, sun, width // 11, (170, 225, 250), -1, cv2.LINE_AA)
    for layer in range(5):
        ridge = (
            height * (0.36 + 0.13 * layer)
            + 0.09 * height * fractal_noise(rng, 2, width, (30, 120))[0]
        )
        color = np.asarray(random_color(rng, 60, 150)) * (1 - 0.13 * layer)
        outline = np.stack([np.arange(width), ridge], 1).astype(np.int32)
        cv2.fillPoly(
            image,
            [np.concatenate([outline, [[width, height], [0, height]]])],
            color.tolist(),
            cv2.LINE_AA,
        )
        for x in rng.integers(0, width, 14):
            tip = (int(x), int(ridge[x] - rng.uniform(4, 22)))
            cv2.line(image, (int(x), int(ridge[x])), tip, (color * 0.6).tolist(), 3, cv2.LINE_AA)


def art_type(rng: Rng, image: npt.NDArray[Any]) -> None:
    """A concert bill: large letters, bands, small print."""
    height, width = image.shape[:2]
    for _ in range(4):
        y = int(rng.uniform(0, height))
        cv2.rectangle(image, (0, y), (width, y + int(rng.uniform(8, 60))), random_color(rng), -1)
    ink = random_color(rng, 15, 90)
    write_words(rng, image, (8, 4, width - 30, height // 2), ink, width / 150)
    write_words(rng, image, (8, height // 2, width - 20, height // 2 - 10), ink, 0.42)


def art_photos(rng: Rng, image: npt.NDArray[Any]) -> None:
    """A pin board of small prints."""
    height, width = image.shape[:2]
    cell = width // 3
    for y in range(6, height - cell // 2, cell - 4):
        for x in range(6, width - cell // 2, cell):
            size = int(rng.uniform(0.72, 0.95) * cell)
            print_ = np.zeros((size, size, 3), np.float32)
            (art_landscape if rng.random() < 0.6 else art_abstract)(rng, print_)
            view = image[y : y + size, x : x + size]
            view[:] = print_[: view.shape[0], : view.shape[1]]


def poster(rng: Rng, height: int, width: int, style: int) -> Image:
    """A framed picture of one of four styles."""
    image = shade(random_color(rng, 150, 240), 0.1 * fractal_noise(rng, height, width, (3, 20, 90)))
    image = np.ascontiguousarray(image)
    (art_abstract, art_landscape, art_type, art_photos)[style % 4](rng, image)
    image *= (
        1
        + speckle(rng, height, width, 0.05)[..., None]
        + 0.06 * fractal_noise(rng, height, width, (3, 9))[..., None]
    )
    frame = max(5, height // 40)
    color = (25, 30, 35) if rng.random() < 0.5 else (90, 130, 165)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (235, 238, 240), 2 * frame)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), color, frame)
    return to_image(image)


def screen(rng: Rng, height: int, width: int) -> Image:
    """A desktop: background picture, an editor window, a chart."""
    image = np.zeros((height, width, 3), np.float32)
    art_landscape(rng, image)
    x, y, w, h = width // 14, height // 10, int(width * 0.5), int(height * 0.74)
    cv2.rectangle(image, (x, y), (x + w, y + h), (45, 38, 34), -1)
    cv2.rectangle(image, (x, y), (x + w, y + 12), (110, 100, 92), -1)
    for line in range(y + 22, y + h - 4, 9):
        left = x + 8 + int(rng.integers(0, 4)) * 12
        for _ in range(int(rng.integers(1, 5))):
            right = min(left + int(rng.integers(8, 46)), x + w - 6)
            cv2.line(image, (left, line), (right, line), random_color(rng, 130, 250), 3)
            left = right + 7
    x2, y2 = int(width * 0.63), int(height * 0.2)
    cv2.rectangle(image, (x2, y2), (width - width // 20, int(height * 0.7)), (240, 240, 240), -1)
    for bar in range(7):
        top = int(height * 0.66 - rng.uniform(0.05, 0.4) * height)
        cv2.rectangle(
            image,
            (x2 + 6 + 20 * bar, top),
            (x2 + 19 + 20 * bar, int(height * 0.66)),
            random_color(rng),
            -1,
        )
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (22, 22, 22), max(8, width // 40))
    return to_image(image)


def keys(rng: Rng, height: int, width: int) -> Image:
    """A keyboard's top: five rows of keys with letters."""
    image = np.full((height, width, 3), 40.0, np.float32)
    step = max(6, height // 5)
    for y in range(2, height - step + 2, step):
        for x in range(2, width - step + 2, step):
            tone = float(rng.uniform(175, 225))
            cv2.rectangle(image, (x, y), (x + step - 4, y + step - 4), (tone, tone, tone), -1)
            letter = chr(65 + int(rng.integers(26)))
            stamp(image, letter, (x + 4, y + step - 8), 0.4, (30, 30, 30))
    return to_image(image)


def label(rng: Rng, height: int, width: int, base: Color, paper: Color) -> Image:
    """A printed label around a bottle, a can or a cup: twice, front and back."""
    image = plain(rng, height, width, base).astype(np.float32)
    top, bottom = int(0.2 * height), int(0.82 * height)
    cv2.rectangle(image, (0, top), (width, bottom), paper, -1)
    for half in (0, width // 2):
        center = (half + width // 4, (top + bottom) // 2)
        paint_ellipse(image, center, (width // 7, (bottom - top) // 4), 0, random_color(rng))
        write_words(
            rng,
            image,
            (half + 6, top, width // 2 - 12, bottom - top),
            random_color(rng, 20, 110),
            height / 300,
        )
    for y in (top, bottom):
        cv2.line(image, (0, y), (width, y), random_color(rng), max(2, height // 40))
    return to_image(image * (1 + speckle(rng, height, width, 0.03)[..., None]))


def book_cover(rng: Rng, height: int, width: int) -> Image:
    """A book's front: colour, picture, title."""
    image = np.ascontiguousarray(
        shade(random_color(rng, 60, 200), 0.08 * fractal_noise(rng, height, width, (3, 20)))
    )
    picture = np.zeros((height // 2, int(width * 0.8), 3), np.float32)
    art_abstract(rng, picture)
    image[height // 3 : height // 3 + height // 2, width // 10 : width // 10 + picture.shape[1]] = (
        picture
    )
    write_words(
        rng, image, (width // 10, 2, width - width // 5, height // 3), (240, 240, 240), width / 170
    )
    return to_image(image)


def book_row(rng: Rng, height: int, width: int) -> Image:
    """Spines side by side, as seen on a shelf."""
    image = np.full((height, width, 3), 22.0, np.float32)
    x = 0
    while x < width:
        w, h = int(rng.integers(7, 22)), int(rng.uniform(0.68, 0.98) * height)
        color = random_color(rng, 40, 220)
        cv2.rectangle(image, (x, height - h), (x + w - 2, height), color, -1)
        for _ in range(2):
            y = height - int(rng.uniform(0.1, 0.95) * h)
            cv2.rectangle(
                image,
                (x, y),
                (x + w - 2, y + int(rng.integers(2, 9))),
                random_color(rng, 80, 250),
                -1,
            )
        x += w
    tone = 0.1 * fractal_noise(rng, height, width, (2, 6, 20)) + speckle(rng, height, width, 0.05)
    return to_image(image * (1 + tone[..., None]))


def rug(rng: Rng, height: int, width: int) -> Image:
    """A carpet: borders, a field of motifs, worn places."""
    base, other = random_color(rng, 70, 140), random_color(rng, 150, 220)
    image = np.ascontiguousarray(
        shade(base, 0.12 * fractal_noise(rng, height, width, (2, 8, 40, 200)))
    )
    for inset, color in ((10, other), (22, random_color(rng)), (46, other)):
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), color, 5)
    for _ in range(170):
        x, y = int(rng.uniform(55, width - 55)), int(rng.uniform(55, height - 55))
        size, color = int(rng.integers(4, 20)), random_color(rng, 60, 230)
        if rng.random() < 0.5:
            diamond = np.array(
                [[x - size, y], [x, y - size], [x + size, y], [x, y + size]], np.int32
            )
            cv2.fillPoly(image, [diamond], color, cv2.LINE_AA)
        else:
            paint_ellipse(image, (x, y), (size, size // 2), float(rng.uniform(0, 180)), color, 2)
    return to_image(image * (1 + speckle(rng, height, width, 0.07)[..., None]))


def panels(
    rng: Rng, height: int, width: int, base: Color, columns: int, rows: int, contrast: float = 0.16
) -> Image:
    """Cabinet or door front: bevelled wooden panels with knobs."""
    image = wood(rng, height, width, base, contrast).astype(np.float32)
    for row in range(rows):
        for col in range(columns):
            x0, x1 = col * width // columns, (col + 1) * width // columns - 1
            y0, y1 = row * height // rows, (row + 1) * height // rows - 1
            cv2.rectangle(image, (x0, y0), (x1, y1), (20, 24, 28), 2)
            inset = min(x1 - x0, y1 - y0) // 8
            dark, light = [0.6 * c for c in base], [min(255, 1.25 * c) for c in base]
            cv2.rectangle(
                image, (x0 + inset, y0 + inset), (x1 - inset, y1 - inset), dark, 3, cv2.LINE_AA
            )
            cv2.line(
                image, (x0 + inset, y1 - inset), (x1 - inset, y1 - inset), light, 2, cv2.LINE_AA
            )
            knob = (x1 - inset // 2 - 2, (y0 + y1) // 2)
            cv2.circle(image, knob, 5, (60, 66, 70), -1, cv2.LINE_AA)
            cv2.circle(image, (knob[0] - 1, knob[1] - 1), 2, (215, 220, 225), -1, cv2.LINE_AA)
    return to_image(image)


def window_view(rng: Rng, height: int, width: int) -> Image:
    """What is outside: bright sky, hills, bars of the window."""
    image = np.zeros((height, width, 3), np.float32)
    art_landscape(rng, image)
    image = 120 + 0.55 * image
    for x in (0, width // 2, width - 1):
        cv2.line(image, (x, 0), (x, height), (232, 235, 236), 16)
    for y in (0, int(height * 0.4), height - 1):
        cv2.line(image, (0, y), (width, y), (232, 235, 236), 14)
    return to_image(image)


def leaf(rng: Rng, height: int, width: int) -> Image:
    """A green blade with ribs."""
    base = (float(rng.uniform(30, 60)), float(rng.uniform(95, 150)), float(rng.uniform(40, 85)))
    image = np.ascontiguousarray(shade(base, 0.18 * fractal_noise(rng, height, width, (3, 10, 30))))
    rib = tuple(min(255.0, 1.5 * c) for c in base)
    cv2.line(image, (0, height // 2), (width, height // 2), rib, 2, cv2.LINE_AA)
    for x in range(0, width, 12):
        cv2.line(image, (x, height // 2), (x + 14, 2), rib, 1, cv2.LINE_AA)
        cv2.line(image, (x, height // 2), (x + 14, height - 2), rib, 1, cv2.LINE_AA)
    return to_image(image)


def clock_face(rng: Rng, height: int, width: int) -> Image:
    """Dial with marks and hands."""
    image = plain(rng, height, width, (225, 232, 236)).astype(np.float32)
    center, radius = (width // 2, height // 2), min(height, width) // 2
    cv2.circle(image, center, radius - 5, (35, 35, 40), 11, cv2.LINE_AA)
    for hour in range(12):
        ray = np.array([np.sin(hour * np.pi / 6), -np.cos(hour * np.pi / 6)])
        ends = [(np.array(center) + ray * radius * k).astype(int).tolist() for k in (0.68, 0.82)]
        cv2.line(image, ends[0], ends[1], (30, 30, 30), 4, cv2.LINE_AA)
    for angle, reach in rng.uniform(0, 2 * np.pi, 2)[:, None] * [1, 0] + [[0, 0.42], [0, 0.6]]:
        tip = (
            (np.array(center) + radius * reach * np.array([np.sin(angle), -np.cos(angle)]))
            .astype(int)
            .tolist()
        )
        cv2.line(image, center, tip, (20, 20, 120), 4, cv2.LINE_AA)
    return to_image(image)


# ---- Patches and models -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Part:
    """One textured patch. Local coordinates (s, t) for flat parts, (x, y, z) for round ones.

    QUAD: origin + s a + t b with s, t in 0..1; a runs right, b down, a x b into the surface.
    DISC: the ellipse inscribed in that quad. SPHERE: |x, y, z| = 1.
    FRUSTUM: x^2 + y^2 = (r0 + (r1 - r0) z)^2, z in 0..1.
    """

    kind: int
    obj_from_patch: Array  # (3, 4) columns a, b, third axis, origin
    texture: str
    fit: bool = True  # whole texture over the patch; else a piece of it at its natural scale
    radii: tuple[float, float] = (0.0, 0.0)  # FRUSTUM, m at z = 0 and z = 1
    two_sided: bool = False
    emission: float = 0.0  # > 0: shines by itself, not lit


@dataclass(frozen=True, slots=True)
class Model:
    """A piece of furniture in its own frame: footprint around the origin, floor at z = 0."""

    class_name: str
    support: str  # the solid that describes it: box | cylinder | ellipsoid
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Place:
    """Where a model stands: its origin in world and its turn about z."""

    model: str
    position: tuple[float, float, float]
    yaw_rad: float = 0.0


def rotation_z(yaw_rad: float) -> Array:
    """(3, 3) rotation about z."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle_rad: float) -> Array:
    """(3, 3) rotation about x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def quad(
    origin: npt.ArrayLike, right: npt.ArrayLike, down: npt.ArrayLike, texture: str, **options: Any
) -> Part:
    """Parallelogram from its top left corner and two edges (m)."""
    a, b = np.asarray(right, float), np.asarray(down, float)
    into = np.cross(a, b)
    frame = np.stack(
        [a, b, into / np.linalg.norm(into), np.asarray(origin, float)], axis=1
    )  # (3, 4)
    return Part(options.pop("kind", QUAD), frame, texture, **options)


def box(
    center: Sequence[float],
    size: Sequence[float],
    texture: str,
    faces: dict[str, str] | None = None,
    rotation: Array | None = None,
) -> list[Part]:
    """Six quads; `faces`: textures fitted to front (-y), back, left (-x), right, top, bottom."""
    hx, hy, hz = (0.5 * float(v) for v in size)
    layout: dict[str, tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]] = {
        "front": ((-hx, -hy, hz), (2 * hx, 0, 0), (0, 0, -2 * hz)),
        "back": ((hx, hy, hz), (-2 * hx, 0, 0), (0, 0, -2 * hz)),
        "left": ((-hx, hy, hz), (0, -2 * hy, 0), (0, 0, -2 * hz)),
        "right": ((hx, -hy, hz), (0, 2 * hy, 0), (0, 0, -2 * hz)),
        "top": ((-hx, hy, hz), (2 * hx, 0, 0), (0, -2 * hy, 0)),
        "bottom": ((-hx, -hy, -hz), (2 * hx, 0, 0), (0, 2 * hy, 0)),
    }
    own = faces or {}
    parts = []
    for face, (origin, right, down) in layout.items():
        if face not in own and np.linalg.norm(down) > 1.5 * np.linalg.norm(
            right
        ):  # grain lengthwise
            origin, right, down = np.add(origin, right), np.asarray(down), -np.asarray(right)
        parts.append(quad(origin, right, down, own.get(face, texture), fit=face in own))
    turn = np.eye(3) if rotation is None else rotation
    return [moved(part, turn, np.asarray(center, float)) for part in parts]


def moved(part: Part, rotation: Array, offset: Array) -> Part:
    """Turn, then shift a part."""
    frame = rotation @ part.obj_from_patch  # (3, 4)
    frame[:, 3] += offset
    return Part(part.kind, frame, part.texture, part.fit, part.radii, part.two_sided, part.emission)


def frustum(
    base: Sequence[float], height: float, radii: tuple[float, float], texture: str, **options: Any
) -> Part:
    """Lateral surface of a cone piece that stands on `base` (m)."""
    frame = np.concatenate([np.eye(3), np.asarray(base, float)[:, None]], axis=1)  # (3, 4)
    frame[:, 2] *= height
    return Part(FRUSTUM, frame, texture, radii=radii, **options)


def disc(
    center: Sequence[float], radius: float, texture: str, up: bool = True, **options: Any
) -> Part:
    """Horizontal circle, seen from above or from below."""
    x, y, z = center
    sign = 1.0 if up else -1.0
    corner, down = (x - radius, y + sign * radius, z), (0.0, -2 * sign * radius, 0.0)
    return quad(corner, (2 * radius, 0, 0), down, texture, kind=DISC, **options)


def upright(
    base: Sequence[float], height: float, radii: tuple[float, float], side: str, cap: str
) -> list[Part]:
    """A closed cylinder or cone piece."""
    x, y, z = base
    lids = [
        disc((x, y, z + height), radii[1], cap, fit=False),
        disc((x, y, z), radii[0], cap, up=False, fit=False),
    ]
    return [frustum(base, height, radii, side), *lids]


def ball(
    center: Sequence[float], half_axes: Sequence[float], texture: str, rotation: Array | None = None
) -> Part:
    """An ellipsoid."""
    axes = (
        np.diag(np.asarray(half_axes, float))
        if rotation is None
        else rotation * np.asarray(half_axes, float)
    )
    return Part(SPHERE, np.concatenate([axes, np.asarray(center, float)[:, None]], axis=1), texture)


def chair_model() -> Model:
    """Wooden chair: seat, cushion, four legs, back rest with slats."""
    parts = box((0, 0, 0.44), (0.43, 0.43, 0.035), "chair_wood")
    parts += box(
        (0, -0.005, 0.478),
        (0.40, 0.39, 0.045),
        "chair_cloth",
        {"top": "chair_cloth", "front": "chair_cloth"},
    )
    for x in (-0.195, 0.195):
        parts += box((x, -0.195, 0.212), (0.04, 0.04, 0.424), "chair_wood")
        parts += box((x, 0.205, 0.45), (0.04, 0.04, 0.90), "chair_wood")
    for z, height in ((0.84, 0.11), (0.69, 0.06), (0.58, 0.05)):
        parts += box((0, 0.205, z), (0.35, 0.024, height), "chair_wood")
    for y in (-0.195, 0.205):
        parts += box((0, y, 0.2), (0.35, 0.02, 0.03), "chair_wood")
    return Model("chair", "box", tuple(parts))


def office_chair_model() -> Model:
    """Swivel chair: five-armed foot, gas lift, padded seat and back."""
    parts = [frustum((0, 0, 0.1), 0.34, (0.03, 0.025), "plastic")]
    for turn in np.arange(5) * 2 * np.pi / 5:
        tip = (0.15 * float(np.sin(turn)), -0.15 * float(np.cos(turn)), 0.08)
        parts += box(tip, (0.05, 0.3, 0.04), "plastic", None, rotation_z(float(turn)))
    cloth = {side: "chair_cloth" for side in ("top", "front", "back")}
    parts += box((0, -0.02, 0.47), (0.48, 0.46, 0.08), "chair_cloth", cloth)
    parts += box((0, 0.24, 0.56), (0.07, 0.04, 0.3), "plastic")
    parts += box((0, 0.22, 0.84), (0.44, 0.07, 0.46), "chair_cloth", cloth, rotation_x(-0.12))
    for x in (-0.27, 0.27):
        parts += box((x, 0.02, 0.66), (0.05, 0.26, 0.03), "plastic")
        parts += box((x, 0.1, 0.57), (0.03, 0.04, 0.18), "plastic")
    return Model("chair", "box", tuple(parts))


def tub_chair_model() -> Model:
    """Low arm chair of one colour on a round plinth."""
    parts = upright((0, 0, 0), 0.22, (0.2, 0.24), "plastic", "plastic")
    parts += upright((0, 0, 0.22), 0.2, (0.3, 0.33), "chair_cloth", "chair_cloth")
    for turn in np.linspace(-1.9, 1.9, 9):
        spot = (0.3 * np.sin(turn), 0.3 * np.cos(turn), 0.55)
        parts += box(spot, (0.16, 0.08, 0.3), "chair_cloth", None, rotation_z(-float(turn)))
    return Model("chair", "box", tuple(parts))


def stretched(model: Model, factors: npt.ArrayLike) -> Model:
    """The model with other proportions: (3,) factors along x, y, z."""
    parts = []
    for part in model.parts:
        frame = np.diag(np.asarray(factors, float)) @ part.obj_from_patch
        if part.kind in (QUAD, DISC):
            into = np.cross(frame[:, 0], frame[:, 1])
            frame[:, 2] = into / np.linalg.norm(into)
        parts.append(replace(part, obj_from_patch=frame))
    return Model(model.class_name, model.support, tuple(parts))


def table_model(size: tuple[float, float, float], wood_name: str) -> Model:
    """Four-legged table with aprons."""
    w, d, h = size
    parts = box((0, 0, h - 0.02), (w, d, 0.04), wood_name, {"top": wood_name})
    for x in (-w / 2 + 0.06, w / 2 - 0.06):
        for y in (-d / 2 + 0.06, d / 2 - 0.06):
            parts += box((x, y, (h - 0.04) / 2), (0.07, 0.07, h - 0.04), wood_name)
    for y in (-d / 2 + 0.07, d / 2 - 0.07):
        parts += box((0, y, h - 0.08), (w - 0.2, 0.02, 0.08), wood_name)
    for x in (-w / 2 + 0.07, w / 2 - 0.07):
        parts += box((x, 0, h - 0.08), (0.02, d - 0.2, 0.08), wood_name)
    return Model("dining table", "box", tuple(parts))


def monitor_model() -> Model:
    """Screen on a foot."""
    parts = box((0, 0.02, 0.008), (0.24, 0.18, 0.016), "plastic")
    parts += box((0, 0.05, 0.13), (0.06, 0.03, 0.23), "plastic")
    parts += box((0, 0, 0.28), (0.56, 0.04, 0.34), "plastic")
    face = quad((-0.28, -0.021, 0.45), (0.56, 0, 0), (0, 0, -0.34), "screen", emission=0.55)
    return Model("tv", "box", (*parts, face))


def couch_model() -> Model:
    """Two-seater with arms, cushions and two pillows."""
    parts = box((0, 0.0, 0.16), (1.74, 0.86, 0.22), "couch")
    parts += box((0, 0.33, 0.47), (1.74, 0.20, 0.62), "couch")
    for x in (-0.79, 0.79):
        parts += box((x, -0.02, 0.36), (0.18, 0.84, 0.42), "couch")
    for x in (-0.35, 0.35):
        cloth = {"top": "couch_cushion", "front": "couch_cushion"}
        parts += box((x, -0.08, 0.35), (0.68, 0.68, 0.17), "couch_cushion", cloth)
        parts += box(
            (x, 0.19, 0.60),
            (0.66, 0.15, 0.36),
            "couch_cushion",
            {"front": "couch_cushion"},
            rotation_x(-0.15),
        )
    parts += box(
        (-0.48, 0.06, 0.60), (0.40, 0.12, 0.36), "pillow", {"front": "pillow"}, rotation_x(-0.35)
    )
    for x in (-0.78, 0.78):
        for y in (-0.36, 0.36):
            parts += box((x, y, 0.025), (0.06, 0.06, 0.05), "chair_wood")
    return Model("couch", "box", tuple(parts))


def plant_model(rng: Rng, height: float) -> Model:
    """Leaves (ellipses) around stems in a conical pot."""
    parts = upright((0, 0, 0), 0.30, (0.12, 0.16), "pot", "soil")
    for _ in range(64):
        turn, lift = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1)
        reach = 0.05 + 0.27 * np.sin(np.pi * (0.15 + 0.75 * lift)) * rng.uniform(0.6, 1.0)
        center = np.array(
            [reach * np.cos(turn), reach * np.sin(turn), 0.36 + (height - 0.45) * lift]
        )
        droop = rng.uniform(-0.5, 0.9)
        along = np.array(
            [np.cos(turn) * np.cos(droop), np.sin(turn) * np.cos(droop), np.sin(droop)]
        )
        across = np.cross(along, rng.normal(0, 0.35, 3) + np.array([0.0, 0, 1]))
        along, across = (
            along * rng.uniform(0.2, 0.32),
            across / np.linalg.norm(across) * rng.uniform(0.08, 0.12),
        )
        texture = f"leaf{int(rng.integers(3))}"
        parts.append(
            quad(center - along / 2 - across / 2, along, across, texture, kind=DISC, two_sided=True)
        )
    for _ in range(6):
        turn = rng.uniform(0, 2 * np.pi)
        tip = np.array([0.06 * np.cos(turn), 0.06 * np.sin(turn), height - 0.5])
        parts.append(
            quad(
                (0, 0, 0.3),
                tip,
                (0.012 * np.sin(turn), -0.012 * np.cos(turn), 0),
                "leaf0",
                two_sided=True,
            )
        )
    return Model("potted plant", "cylinder", tuple(parts))


def bottle_model(texture: str) -> Model:
    """Body, shoulder, neck, cap."""
    parts = upright((0, 0, 0), 0.19, (0.038, 0.038), texture, "glass")
    parts.append(frustum((0, 0, 0.19), 0.05, (0.038, 0.015), "glass"))
    parts.append(frustum((0, 0, 0.24), 0.045, (0.015, 0.014), "glass"))
    parts += upright((0, 0, 0.285), 0.02, (0.017, 0.017), "cap", "cap")
    return Model("bottle", "cylinder", tuple(parts))


def cup_model() -> Model:
    """Mug with coffee and a handle."""
    parts = upright((0, 0, 0), 0.10, (0.038, 0.043), "cup", "china")[::2]
    parts.append(frustum((0, 0, 0.0), 0.1, (0.037, 0.042), "china"))
    parts.append(disc((0, 0, 0.085), 0.041, "soil", fit=False))
    for x, z, size in ((0.052, 0.075, (0.026, 0.012, 0.012)), (0.052, 0.03, (0.026, 0.012, 0.012))):
        parts += box((x, 0, z), size, "china")
    parts += box((0.066, 0, 0.0525), (0.012, 0.012, 0.057), "china")
    return Model("cup", "cylinder", tuple(parts))


def bowl_model(rng: Rng) -> Model:
    """Bowl heaped with oranges (all one object)."""
    parts = [
        frustum((0, 0, 0), 0.07, (0.07, 0.14), "china_blue"),
        disc((0, 0, 0.055), 0.125, "soil", fit=False),
    ]
    for turn in np.arange(5) * 2 * np.pi / 5:
        parts.append(
            ball((0.07 * np.cos(turn), 0.07 * np.sin(turn), 0.085), (0.037,) * 3, "orange")
        )
    parts.append(
        ball((0.0, 0.0, 0.125), (0.037,) * 3, "orange", rotation_z(float(rng.uniform(0, 6))))
    )
    return Model("bowl", "cylinder", tuple(parts))


def book_model(index: int, upright_book: bool) -> Model:
    """A book lying flat, or standing with its cover to the front."""
    faces = {"top": f"book{index}", "bottom": f"book{index}"}
    parts = box((0, 0, 0.0175), (0.17, 0.24, 0.035), "paper", faces)
    parts += box((-0.087, 0, 0.0175), (0.004, 0.24, 0.036), f"book{index}")
    if upright_book:
        stand = rotation_x(np.pi / 2 - 0.18)
        parts = [moved(part, stand, np.array([0, 0, 0.118])) for part in parts]
    return Model("book", "box", tuple(parts))


def bear_model() -> Model:
    """Teddy bear of ellipsoids, sitting."""
    bear = [
        ball((0, 0, 0.13), (0.11, 0.095, 0.13), "bear"),
        ball((0, -0.02, 0.31), (0.09, 0.08, 0.08), "bear"),
    ]
    bear += [ball((x, 0, 0.385), (0.032, 0.018, 0.032), "bear") for x in (-0.065, 0.065)]
    bear += [ball((x, -0.08, 0.19), (0.035, 0.07, 0.035), "bear") for x in (-0.1, 0.1)]
    bear += [ball((x, -0.12, 0.045), (0.045, 0.085, 0.045), "bear") for x in (-0.07, 0.07)]
    bear += [
        ball((0, -0.095, 0.29), (0.035, 0.025, 0.026), "bear_snout"),
        ball((0, -0.122, 0.3), (0.012, 0.01, 0.008), "plastic"),
    ]
    bear += [ball((x, -0.088, 0.335), (0.009, 0.008, 0.009), "plastic") for x in (-0.035, 0.035)]
    return Model("teddy bear", "ellipsoid", tuple(bear))


def small_models(rng: Rng) -> dict[str, Model]:
    """Things for desks, shelves and corners."""
    laptop = box((0, 0, 0.01), (0.34, 0.24, 0.02), "alu", {"top": "keys"})
    laptop += box(
        (0, 0.16, 0.12), (0.34, 0.01, 0.23), "alu", {"front": "screen2"}, rotation_x(-0.3)
    )
    vase = upright((0, 0, 0), 0.12, (0.05, 0.09), "vase", "soil")
    vase.append(frustum((0, 0, 0.12), 0.14, (0.09, 0.035), "vase"))
    vase.append(frustum((0, 0, 0.26), 0.04, (0.035, 0.05), "vase"))
    clock = [disc((0, 0, 0.04), 0.16, "clock"), frustum((0, 0, 0), 0.04, (0.16, 0.16), "plastic")]
    hang = rotation_x(np.pi / 2)
    case = box(
        (0, 0, 0.35), (0.42, 0.25, 0.56), "suitcase", {"front": "suitcase", "back": "suitcase"}
    )
    case += [
        p
        for x in (-0.17, 0.17)
        for p in upright((x, 0, 0), 0.07, (0.03, 0.03), "plastic", "plastic")
    ]
    case += box((0, 0.1, 0.68), (0.2, 0.02, 0.02), "plastic")
    case += [p for x in (-0.1, 0.1) for p in box((x, 0.1, 0.655), (0.02, 0.02, 0.05), "plastic")]
    return {
        "laptop": Model("laptop", "box", tuple(laptop)),
        "keyboard": Model(
            "keyboard",
            "box",
            tuple(box((0, 0, 0.013), (0.44, 0.15, 0.026), "plastic", {"top": "keys"})),
        ),
        "mouse": Model("mouse", "ellipsoid", (ball((0, 0, 0.018), (0.033, 0.055, 0.018), "alu"),)),
        "vase": Model("vase", "cylinder", tuple(vase)),
        "clock": Model(
            "clock", "box", tuple(moved(p, hang, np.array([0.0, 0.0, 0.16])) for p in clock)
        ),
        "bear": bear_model(),
        "ball": Model(
            "sports ball",
            "ellipsoid",
            (ball((0, 0, 0.12), (0.12,) * 3, "ball", rotation_x(float(rng.uniform(0.4, 1.2)))),),
        ),
        "suitcase": Model("suitcase", "box", tuple(case)),
        "bowl": bowl_model(rng),
    }


def furniture_models(rng: Rng) -> dict[str, Model]:
    """Every model that a plan may place."""
    models = {
        "chair": chair_model(),
        "table": table_model((1.5, 0.9, 0.74), "table_wood"),
        "desk": table_model((1.6, 0.7, 0.73), "desk_wood"),
        "coffee": table_model((0.9, 0.5, 0.42), "desk_wood"),
        "monitor": monitor_model(),
        "couch": couch_model(),
        "plant": plant_model(rng, 1.25),
        "cup": cup_model(),
        "bottle0": bottle_model("bottle0"),
        "bottle1": bottle_model("bottle1"),
    }
    models |= {f"book{i}": book_model(i, upright_book=False) for i in range(3)}
    models |= {f"stood{i}": book_model(i, upright_book=True) for i in range(3)}
    return models | small_models(rng)


# ---- Floor plan ---------------------------------------------------------------------------------


def dining_places(config: RoomConfig, rng: Rng, center: tuple[float, float]) -> list[Place]:
    """Table in the middle, up to four chairs around it, things on top."""
    x, y = center
    turn = float(rng.uniform(-0.12, 0.12))
    seats = [(-0.36, -0.72, np.pi), (0.38, -0.70, np.pi), (-0.37, 0.71, 0.0), (0.36, 0.73, 0.0)]
    tops = [
        ("bowl", 0.02, 0.03),
        ("cup", -0.5, -0.2),
        ("cup", 0.45, 0.22),
        ("bottle0", 0.27, -0.06),
    ]
    tops += [("bottle1", -0.24, 0.2), ("cup", 0.52, -0.26), ("book0", -0.52, 0.16)]

    def place(model: str, dx: float, dy: float, z: float, yaw: float) -> Place:
        px, py, _ = rotation_z(turn) @ [dx, dy, 0.0]
        return Place(model, (x + float(px), y + float(py), z), turn + yaw)

    places = [place("table", 0, 0, 0, 0)]
    for dx, dy, yaw in seats:
        nudge = rng.normal(0, [0.03, 0.03, 0.1])
        places.append(place("chair", dx + nudge[0], dy + nudge[1], 0, yaw + nudge[2]))
    return places + [place(name, dx, dy, 0.74, float(rng.uniform(0, 6))) for name, dx, dy in tops]


def desk_places(rng: Rng, size: tuple[float, float, float]) -> list[Place]:
    """Desk on the +x wall, screens facing the room, two chairs of the same kind as at the table."""
    x, y, z = size[0] / 2 - 0.40, -0.55 + float(rng.uniform(-0.15, 0.15)), 0.73
    face = -np.pi / 2  # the front looks along -x
    places = [Place("desk", (x, y, 0.0), face)]
    places += [
        Place("monitor", (x + 0.1, y + dy, z), face + tilt)
        for dy, tilt in ((0.33, 0.18), (-0.33, -0.18))
    ]
    places += [
        Place("keyboard", (x - 0.17, y + 0.1, z), face),
        Place("mouse", (x - 0.16, y - 0.24, z), face),
    ]
    places += [
        Place("cup", (x - 0.2, y + 0.55, z), 1.0),
        Place("bottle1", (x + 0.05, y - 0.72, z), 2.0),
    ]
    places += [Place("book1", (x - 0.12, y - 0.58, z), face + 0.4)]
    for dy in (0.42, -0.40):
        nudge = rng.normal(0, [0.04, 0.04, 0.15])
        places.append(
            Place(
                "chair",
                (x - 0.72 + nudge[0], y + dy + nudge[1], 0.0),
                face + np.pi + 0.25 * dy + nudge[2],
            )
        )
    return places


def lounge_places(rng: Rng, size: tuple[float, float, float]) -> list[Place]:
    """Couch on the +y wall, coffee table, plants, toys."""
    x, y = 0.55 + float(rng.uniform(-0.15, 0.15)), size[1] / 2 - 0.5
    places = [
        Place("couch", (x, y, 0.0)),
        Place("coffee", (x + 0.05, y - 1.0, 0.0), float(rng.uniform(-0.1, 0.1))),
    ]
    places += [
        Place("plant", (x + 1.35, y + 0.02, 0.0), 0.4),
        Place("plant", (-size[0] / 2 + 0.5, y, 0.0), 2.2),
    ]
    places += [
        Place("bear", (x + 0.42, y - 0.16, 0.435), 0.25),
        Place("ball", (x - 1.2, y - 0.35, 0.0)),
    ]
    places += [
        Place("laptop", (x - 0.12, y - 1.0, 0.42), 0.2),
        Place("cup", (x + 0.33, y - 0.92, 0.42), 2.0),
    ]
    places += [
        Place("book2", (x + 0.3, y - 1.1, 0.42), 0.8),
        Place("suitcase", (size[0] / 2 - 0.55, y - 0.1, 0.0), -0.5),
    ]
    return places


def shelf_places(size: tuple[float, float, float]) -> list[Place]:
    """On the sideboard of the -x wall and on top of the bookcase of the -y wall."""
    x, y = -size[0] / 2 + 0.26, size[1] / 2 - 1.75
    side = -np.pi / 2 + np.pi  # the front looks along +x
    places = [Place("vase", (x, y + 0.45, 0.8)), Place("stood0", (x - 0.05, y + 0.05, 0.8), side)]
    places += [
        Place("stood1", (x - 0.05, y - 0.2, 0.8), side),
        Place("bottle0", (x + 0.03, y - 0.48, 0.8), 1.0),
    ]
    return [*places, Place("clock", (1.9, -size[1] / 2 + 0.03, 1.75), np.pi)]


def limit_places(places: list[Place], config: RoomConfig) -> list[Place]:
    """Keep the first so many of each counted kind."""
    left = {
        "chair": config.chairs,
        "monitor": config.monitors,
        "cup": config.cups,
        "bottle": config.bottles,
    }
    left |= {"book": config.books, "plant": config.plants, "couch": int(config.couch)}
    extras = {"bowl", "laptop", "keyboard", "mouse", "vase", "clock", "bear", "ball", "suitcase"}
    kept = []
    for place in places:
        kind = place.model.rstrip("0123456789").replace("stood", "book")
        if kind in left:
            left[kind] -= 1
        floats = kind == "bear" and not config.couch  # it sits on the couch
        if left.get(kind, 0) >= 0 and (config.extras or kind not in extras) and not floats:
            kept.append(place)
    return kept


def room_shell(size: tuple[float, float, float]) -> list[Part]:
    """Walls, floor, ceiling (inward), without furniture."""
    w, d, h = size
    x, y = w / 2, d / 2
    down = (0.0, 0.0, -h)
    return [
        quad((-x, y, h), (w, 0, 0), down, "wall_north"),
        quad((x, -y, h), (-w, 0, 0), down, "wall_south"),
        quad((x, y, h), (0, -d, 0), down, "wall_east"),
        quad((-x, -y, h), (0, d, 0), down, "wall_west"),
        quad((-x, y, 0), (w, 0, 0), (0, -d, 0), "floor"),
        quad((-x, -y, h), (w, 0, 0), (0, d, 0), "ceiling"),
    ]


def skirting(size: tuple[float, float, float]) -> list[Part]:
    """Boards along the foot of the walls."""
    w, d, _ = size
    parts = box((0, d / 2 - 0.01, 0.05), (w, 0.02, 0.1), "white_wood") + box(
        (0, 0.01 - d / 2, 0.05), (w, 0.02, 0.1), "white_wood"
    )
    return (
        parts
        + box((w / 2 - 0.01, 0, 0.05), (0.02, d, 0.1), "white_wood")
        + box((0.01 - w / 2, 0, 0.05), (0.02, d, 0.1), "white_wood")
    )


def wall_pictures(size: tuple[float, float, float], rng: Rng) -> list[Part]:
    """Framed posters on the four walls, at hand-picked places with seeded shifts."""
    w, d, _ = size
    spots = [
        ("n", -0.2, 1.55, 0.8, 0.6),
        ("n", 1.0, 1.6, 0.5, 0.7),
        ("n", -1.75, 1.5, 0.9, 0.65),
        ("n", 2.35, 1.6, 0.7, 0.9),
    ]
    spots += [
        ("e", -0.55, 1.75, 1.0, 0.6),
        ("e", 0.75, 1.5, 0.6, 0.85),
        ("e", 1.7, 1.6, 0.55, 0.55),
        ("e", -1.85, 1.5, 0.6, 0.8),
    ]
    spots += [
        ("w", 0.95, 1.55, 0.8, 0.6),
        ("w", 1.9, 1.55, 0.5, 0.7),
        ("s", -2.6, 1.6, 0.6, 0.8),
        ("s", -1.7, 1.5, 0.7, 0.5),
    ]
    turns = {"n": 0.0, "e": -np.pi / 2, "s": np.pi, "w": np.pi / 2}
    parts: list[Part] = []
    for index, (wall, along, z, width, height) in enumerate(spots):
        reach = (d if wall in "ns" else w) / 2 - 0.015
        shift = rng.uniform(-0.06, 0.06, 2)
        center = rotation_z(turns[wall]) @ [0.0, reach, z + shift[1]]
        center += (np.array([1.0, 0, 0]) if wall in "ns" else np.array([0, 1.0, 0])) * (
            along + shift[0]
        )
        parts += box(
            center,
            (width, 0.03, height),
            "plastic",
            {"front": f"poster{index}"},
            rotation_z(turns[wall]),
        )
    return parts


def fixed_furniture(size: tuple[float, float, float]) -> list[Part]:
    """Bookcase, sideboard, rug, door, window: background, not objects to track."""
    w, d, h = size
    shelf: list[Part] = box((0, 0.14, 0.98), (1.3, 0.02, 1.96), "case_wood")
    for x in (-0.65, 0.65):
        shelf += box((x, 0, 0.98), (0.03, 0.3, 1.96), "case_wood")
    for row in range(6):
        shelf += box((0, 0, 0.03 + 0.38 * row), (1.3, 0.3, 0.03), "case_wood")
    for row in range(5):
        shelf += box(
            (0.02 * row - 0.04, 0.03, 0.19 + 0.38 * row),
            (1.18, 0.2, 0.28),
            "paper",
            {"front": f"spines{row}"},
        )
    place = np.array([0.35, -d / 2 + 0.17, 0.0])
    parts = [moved(part, rotation_z(np.pi), place) for part in shelf]
    side = box((0, 0, 0.4), (1.4, 0.45, 0.8), "side_wood", {"front": "cabinet"})
    parts += [
        moved(part, rotation_z(np.pi / 2), np.array([0.25 - w / 2, d / 2 - 1.75, 0.0]))
        for part in side
    ]
    parts += box((0.55, d / 2 - 1.55, 0.006), (2.3, 1.5, 0.012), "rug", {"top": "rug"})
    door = box((0, 0, 1.02), (0.95, 0.05, 2.04), "white_wood", {"front": "door"})
    parts += [
        moved(part, rotation_z(np.pi), np.array([w / 2 - 0.75, -d / 2 + 0.025, 0.0]))
        for part in door
    ]
    parts.append(
        quad((-w / 2 + 0.02, -1.75, 2.15), (0, 1.7, 0), (0, 0, -1.25), "window", emission=1.5)
    )
    parts += box((0.06 - w / 2, -0.9, 0.87), (0.16, 1.8, 0.04), "white_wood")
    parts += clutter(size)
    lamp = [
        quad((x - 0.4, y - 0.4, h - 0.01), (0.8, 0, 0), (0, 0.8, 0), "lamp", emission=3.0)
        for x, y in lamp_spots()
    ]
    return parts + lamp


def clutter(size: tuple[float, float, float]) -> list[Part]:
    """Curtains, floor lamp, cartons, basket, wall board: they make places differ."""
    w, d, _ = size
    parts: list[Part] = []
    for y in (-1.98, 0.18):
        for fold in range(5):
            parts.append(
                frustum(
                    (0.09 - w / 2, y - 0.16 + 0.08 * fold, 0.25), 2.05, (0.05, 0.045), "curtain"
                )
            )
    parts += box((0.09 - w / 2, -0.9, 2.32), (0.03, 2.7, 0.03), "case_wood")
    x, y = -0.95, d / 2 - 0.4
    parts += upright((x, y, 0), 0.03, (0.15, 0.15), "plastic", "plastic")
    parts += [
        frustum((x, y, 0.03), 1.45, (0.013, 0.013), "plastic"),
        frustum((x, y, 1.45), 0.3, (0.2, 0.13), "shade"),
    ]
    parts += box(
        (w / 2 - 0.3, -d / 2 + 1.55, 0.17),
        (0.45, 0.38, 0.34),
        "carton",
        {"left": "carton"},
        rotation_z(0.15),
    )
    parts += box(
        (w / 2 - 0.31, -d / 2 + 1.53, 0.46),
        (0.34, 0.30, 0.24),
        "carton",
        {"left": "carton"},
        rotation_z(-0.2),
    )
    parts += [
        frustum((w / 2 - 0.3, 0.55, 0), 0.32, (0.12, 0.16), "basket"),
        disc((w / 2 - 0.3, 0.55, 0.2), 0.14, "paper"),
    ]
    parts += box((-1.0, -d / 2 + 0.12, 1.35), (1.0, 0.22, 0.03), "side_wood")
    for i, dx in enumerate((-0.36, -0.22, 0.05, 0.3)):
        size_m = (0.1, 0.16, 0.2 + 0.03 * (i % 3)) if i < 2 else (0.2, 0.18, 0.16 + 0.05 * i)
        name = ("pillow", "couch", "carton", "basket")[i]
        parts += box(
            (-1.0 + dx, -d / 2 + 0.12, 1.365 + size_m[2] / 2), size_m, name, {"back": name}
        )
    return parts


def turned(places: Sequence[Place], yaw_rad: float, x: float, y: float) -> list[Place]:
    """Turn a group about the origin and move it there."""
    turn, at = rotation_z(yaw_rad), np.array([x, y, 0.0])
    spots = [turn @ np.asarray(place.position) + at for place in places]
    return [
        Place(
            place.model, (float(spot[0]), float(spot[1]), float(spot[2])), place.yaw_rad + yaw_rad
        )
        for place, spot in zip(places, spots, strict=True)
    ]


def varied_group(config: RoomConfig, rng: Rng) -> list[Place]:
    """A table with chairs, a desk or a lounge around the origin; some things missing."""
    kind = rng.choice(3, p=[0.4, 0.4, 0.2])
    if kind == 0:
        group = dining_places(config, rng, (0.0, 0.0))
    elif kind == 1:
        group = turned(desk_places(rng, (0.8, 0.0, 0.0)), 0.0, 0.35, 0.55)
    else:
        group = turned(lounge_places(rng, (3.4, 1.0, 0.0)), 0.0, -0.55, 0.4)
        group = [place for place in group if place.position[0] < 1.6]
    second = rng.random() < 0.3
    names = {"chair": "chair2"} if second else {}
    names |= {
        f"{kind}{i}": f"{kind}{rng.integers(2)}" for kind in ("bottle", "book") for i in (0, 1)
    }
    large = ("table", "desk", "couch", "coffee")
    return [
        replace(place, model=names.get(place.model, place.model))
        for place in group
        if place.model in large or rng.random() < 0.8
    ]


def varied_plan(
    config: RoomConfig, rng: Rng, size: tuple[float, float, float]
) -> tuple[list[Place], list[Part]]:
    """Groups on a jittered grid, each turned by its own right angle; furniture and pictures on
    walls of this seed's choice.
    """
    w, d, h = size
    columns, rows = max(int((w - 0.6) / 2.5), 1), max(int((d - 0.6) / 2.3), 1)
    plan: list[Place] = []
    for cell in rng.permutation(columns * rows)[: max(2, columns * rows - int(rng.integers(2)))]:
        x = (cell % columns + 0.5) / columns * (w - 0.8) - (w - 0.8) / 2
        y = (cell // columns + 0.5) / rows * (d - 0.8) - (d - 0.8) / 2
        yaw = float(rng.integers(4)) * np.pi / 2 + float(rng.normal(0, 0.08))
        jitter = rng.normal(0, 0.12, 2)
        plan += turned(varied_group(config, rng), yaw, x + jitter[0], y + jitter[1])
    quarter = int(rng.integers(4))
    fixed = fixed_furniture((d, w, h) if quarter % 2 else size)
    parts = [moved(part, rotation_z(quarter * np.pi / 2), np.zeros(3)) for part in fixed]
    inside = np.array([w / 2 - 0.3, d / 2 - 0.3])
    kept = [place for place in plan if (np.abs(place.position[:2]) < inside).all()]
    return kept, parts + wall_things(rng, size)


def wall_things(rng: Rng, size: tuple[float, float, float]) -> list[Part]:
    """Pictures, boxes, boards and radiators along all walls: background of which no two spots are
    alike.
    """
    names = ["carton", "basket", "side_wood", "case_wood", "white_wood", "curtain", "plastic"]
    names += [f"poster{i}" for i in range(12)] + [f"spines{i}" for i in range(5)]
    parts: list[Part] = []
    for _ in range(int(rng.integers(14, 34))):
        side = int(rng.integers(4))
        reach, length = (size[1], size[0]) if side % 2 == 0 else (size[0], size[1])
        hung = rng.random() < 0.6
        extent = rng.uniform([0.12, 0.02, 0.15], [0.9, 0.06 if hung else 0.45, 0.9])
        z = rng.uniform(0.9, 2.0) if hung else extent[2] / 2
        along = rng.uniform(-0.5, 0.5) * (length - 1.0)
        center = rotation_z(side * np.pi / 2) @ [along, reach / 2 - extent[1] / 2 - 0.01, z]
        name = names[int(rng.integers(len(names)))]
        faces = {"front": name}
        parts += box(center, extent.tolist(), name, faces, rotation_z(side * np.pi / 2))
    return parts


def varied_models(rng: Rng, models: dict[str, Model]) -> dict[str, Model]:
    """Other proportions for everything and two kinds of chairs."""
    chairs = [chair_model(), office_chair_model(), tub_chair_model()]
    first, second = rng.permutation(3)[:2]
    models = models | {"chair": chairs[first], "chair2": chairs[second]}
    return {
        name: stretched(model, rng.uniform(0.87, 1.15) * rng.uniform(0.93, 1.07, 3))
        if name not in ("table", "desk", "coffee")  # things stand on them
        else stretched(model, (*rng.uniform(0.9, 1.2, 2), 1.0))
        for name, model in models.items()
    }


def varied_textures(rng: Rng, config: RoomConfig, size: tuple[int, int, int]) -> dict[str, Image]:
    """Walls, floor, woods and cloths of another look; `size` in texels."""

    def tone(strong: float) -> Color:
        pale = rng.random() > strong
        return pale_color(rng) if pale else random_color(rng, 60, 200)

    def paint(
        height: int, width: int, kinds: Sequence[Callable[..., Image]], strong: float
    ) -> Image:
        return kinds[int(rng.integers(len(kinds)))](rng, height, width, tone(strong))

    w, d, h = size
    walls = (plain, plaster, plaster, wallpaper, bricks, planks)
    textures = {
        f"wall_{side}": paint(h, w if side in ("north", "south") else d, walls, 0.3)
        for side in ("north", "south", "east", "west")
    }
    if rng.random() < 0.5:  # as most rooms: all walls alike
        textures["wall_north"] = textures["wall_south"]
        textures["wall_east"] = textures["wall_west"]
    textures["floor"] = paint(d, w, (planks, planks, plain, fabric, plaster, bricks), 0.6)
    for name in ("chair_wood", "table_wood", "desk_wood", "case_wood", "side_wood"):
        textures[name] = paint(512, 512, (wood, wood, plain), 0.8)
    for name in ("chair_cloth", "couch", "couch_cushion", "pillow"):
        textures[name] = fabric(rng, 512, 512, tone(0.8), bool(rng.random() < 0.4))
    for name in ("plastic", "china", "alu", "glass", "cap"):
        textures[name] = plain(rng, 256, 256, tone(0.6))
    return textures


def pale_color(rng: Rng) -> Color:
    """Nearly grey, from dim to white: most walls."""
    color = np.clip(rng.uniform(90, 235) + rng.normal(0, 9, 3), 20, 248)
    return float(color[0]), float(color[1]), float(color[2])


def lamp_spots() -> tuple[tuple[float, float], ...]:
    """Where the two ceiling panels hang (x, y in m)."""
    return ((-1.4, -0.5), (1.5, 0.4))


# ---- Building the room --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Surfaces:
    """All patches of a room as arrays."""

    kind: npt.NDArray[np.int64]  # (S,)
    world_from_patch: Array  # (S, 3, 4)
    quadric: Array  # (S, 5) a, b, c, zmin, zmax of x^2 + y^2 + a z^2 + b z + c = 0
    radii: Array  # (S, 2)
    texture_rect: Array  # (S, 4) x, y, w, h in the atlas
    light_rect: Array  # (S, 4) x, y, w, h in the light map
    owner: npt.NDArray[np.int64]  # (S,) object index, -1 for the room itself
    two_sided: npt.NDArray[np.bool_]  # (S,)
    emission: Array  # (S,)
    corners_in_world: Array  # (S, 8, 3) of a bounding parallelepiped


@dataclass(frozen=True, slots=True)
class RoomObject:
    """The truth about one object."""

    index: int  # 0-based; the identity in MOT files is index + 1
    class_name: str
    class_id: int  # COCO-80
    twin_group: int  # objects of one model share it: they look the same
    support: str  # box | cylinder | ellipsoid
    center_in_world: Array  # (3,) m
    size_m: Array  # (3,) full width, depth, height
    yaw_rad: float
    world_from_obj: Array  # (3, 3)


@dataclass(frozen=True, slots=True)
class Room:
    """Geometry, looks and truth of one room."""

    size_m: tuple[float, float, float]
    objects: tuple[RoomObject, ...]
    surfaces: Surfaces
    atlas: tuple[Image, ...]  # mip levels, BGR
    light: npt.NDArray[np.float32]  # (h, w, 3) linear irradiance
    outline_in_world: tuple[Array, ...] = field(
        repr=False
    )  # per object (parts, P, 3) hull points of each part


def make_textures(
    rng: Rng, config: RoomConfig, size: tuple[float, float, float]
) -> dict[str, Image]:
    """Draw every texture, at `texels_per_m` where a patch shows a piece of it."""
    scale = config.texels_per_m
    w, d, h = (int(v * scale) for v in size)
    textures = wall_textures(rng, (w, d, h))
    oak, walnut, pale = (70.0, 115.0, 165.0), (42.0, 68.0, 104.0), (150.0, 185.0, 210.0)
    tones = {
        "chair_wood": oak,
        "table_wood": walnut,
        "desk_wood": pale,
        "case_wood": walnut,
        "side_wood": oak,
    }
    for name, tone in tones.items():
        factor = float(rng.uniform(0.85, 1.12))
        textures[name] = wood(rng, 512, 512, (tone[0] * factor, tone[1] * factor, tone[2] * factor))
    textures["white_wood"] = wood(rng, 512, 512, (205, 214, 218), 0.05)
    cloths = ("chair_cloth", "couch", "pillow")
    for name, motif in zip(cloths, (True, False, True), strict=True):
        textures[name] = fabric(rng, 512, 512, random_color(rng, 90, 170), motif)
    blue, green, red = textures["couch"].mean((0, 1)) * 1.12
    textures["couch_cushion"] = fabric(rng, 400, 400, (float(blue), float(green), float(red)))
    plains = {
        "plastic": (38, 36, 36),
        "paper": (190, 215, 225),
        "glass": (60, 85, 50),
        "china": (225, 230, 232),
    }
    plains |= {
        "china_blue": (190, 140, 90),
        "alu": (175, 172, 170),
        "soil": (28, 40, 62),
        "cap": (45, 45, 170),
    }
    plains |= {
        "orange": (35, 130, 235),
        "bear": (60, 105, 160),
        "bear_snout": (150, 190, 220),
        "lamp": (250, 252, 255),
    }
    for name, tone in plains.items():
        textures[name] = plain(
            rng, 256, 256, tone, 0.14 if name in ("bear", "soil", "orange", "glass") else 0.05
        )
    return textures | drawn_textures(rng)


def wall_textures(rng: Rng, size: tuple[int, int, int]) -> dict[str, Image]:
    """Four different walls, floor, ceiling; `size` in texels."""
    w, d, h = size
    warm = tuple(float(c) for c in np.array([188, 208, 220]) + rng.uniform(-12, 12, 3))
    sage = tuple(float(c) for c in np.array([158, 184, 174]) + rng.uniform(-12, 12, 3))
    clay = tuple(float(c) for c in np.array([85, 105, 160]) * rng.uniform(0.9, 1.15))
    blue = tuple(float(c) for c in np.array([178, 168, 150]) + rng.uniform(-9, 9, 3))
    return {
        "wall_north": wallpaper(rng, h, w, (sage[0], sage[1], sage[2])),
        "wall_south": plaster(rng, h, w, (warm[0], warm[1], warm[2])),
        "wall_east": bricks(rng, h, d, (clay[0], clay[1], clay[2])),
        "wall_west": plaster(rng, h, d, (blue[0], blue[1], blue[2]), 0.1),
        "floor": planks(rng, d, w, (78.0, 122.0, 165.0)),
        "ceiling": plaster(rng, d // 3, w // 3, (222.0, 228.0, 230.0), 0.03),
    }


def drawn_textures(rng: Rng) -> dict[str, Image]:
    """Pictures that are fitted to one patch each."""
    textures = {f"poster{i}": poster(rng, 320, 360, i + int(rng.integers(2))) for i in range(12)}
    textures |= {f"book{i}": book_cover(rng, 256, 180) for i in range(3)}
    textures |= {f"spines{i}": book_row(rng, 110, 420) for i in range(5)}
    textures |= {f"leaf{i}": leaf(rng, 64, 160) for i in range(3)}
    textures |= {
        f"bottle{i}": label(rng, 160, 256, (50, 90, 60), random_color(rng, 170, 240))
        for i in range(2)
    }
    white = (225.0, 230.0, 232.0)
    textures |= {
        "cup": label(rng, 128, 256, white, white),
        "vase": fabric(rng, 256, 512, random_color(rng, 90, 190), True),
    }
    textures |= {
        "pot": fabric(rng, 256, 512, (70, 105, 175)),
        "screen": screen(rng, 256, 420),
        "screen2": screen(rng, 230, 340),
    }
    textures |= {
        "keys": keys(rng, 120, 360),
        "clock": clock_face(rng, 256, 256),
        "rug": rug(rng, 450, 690),
    }
    textures |= {
        "door": panels(rng, 612, 285, (205, 214, 218), 1, 3, 0.04),
        "cabinet": panels(rng, 256, 448, (80, 125, 170), 4, 1),
    }
    textures |= {
        "window": window_view(rng, 400, 540),
        "ball": fabric(rng, 256, 512, random_color(rng, 150, 230), True),
    }
    hue = 0.35 * np.array(random_color(rng, 150, 200)) + 0.65 * np.array([190.0, 203, 210])
    textures |= {
        "curtain": fabric(rng, 512, 128, (float(hue[0]), float(hue[1]), float(hue[2])), True)
    }
    textures |= {
        "carton": label(rng, 200, 256, (105, 150, 190), (125, 168, 205)),
        "shade": fabric(rng, 128, 256, (190, 220, 235)),
    }
    textures |= {"basket": fabric(rng, 128, 256, (90, 140, 180), True)}
    return textures | {"suitcase": panels(rng, 300, 220, random_color(rng, 90, 170), 1, 4, 0.05)}


def pack(
    sizes: Sequence[tuple[int, int]], width: int, grid: int
) -> tuple[list[tuple[int, int]], int]:
    """Place rectangles (w, h) on shelves of an image; positions are multiples of `grid`."""
    places = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: (-sizes[i][1], i)):
        w, h = (-(-side // grid) * grid for side in sizes[index])
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        places[index] = (x, y)
        x, shelf = x + w, max(shelf, h)
    return places, y + shelf


def build_atlas(
    textures: dict[str, Image],
) -> tuple[tuple[Image, ...], dict[str, tuple[int, int, int, int]]]:
    """Pack all textures, with replicated borders, and shrink by two for each mip level."""
    pad = ATLAS_PAD
    padded = [
        cv2.copyMakeBorder(t, pad, pad, pad, pad, cv2.BORDER_REPLICATE) for t in textures.values()
    ]
    places, height = pack([(p.shape[1], p.shape[0]) for p in padded], ATLAS_WIDTH, ATLAS_PAD)
    level = np.zeros((height, ATLAS_WIDTH, 3), np.uint8)
    rects = {}
    for (name, texture), image, (x, y) in zip(textures.items(), padded, places, strict=True):
        level[y : y + image.shape[0], x : x + image.shape[1]] = image
        rects[name] = (x + pad, y + pad, texture.shape[1], texture.shape[0])
    levels = [level]
    for _ in range(MIP_LEVELS - 1):
        half = (levels[-1].shape[1] // 2, levels[-1].shape[0] // 2)
        levels.append(
            np.asarray(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA), np.uint8)
        )
    return tuple(levels), rects


def patch_extent_m(part: Part) -> tuple[float, float]:
    """Size of a patch along s and t."""
    lengths = np.linalg.norm(part.obj_from_patch[:, :3], axis=0)
    if part.kind == SPHERE:
        return float(2 * np.pi * lengths[:2].mean()), float(np.pi * lengths[2])
    if part.kind == FRUSTUM:
        return float(2 * np.pi * max(part.radii)), float(lengths[2])
    return float(lengths[0]), float(lengths[1])


def texture_window(
    part: Part, rect: tuple[int, int, int, int], scale: float, rng: Rng
) -> list[float]:
    """What of the texture a patch shows: all of it, or a piece at natural scale somewhere."""
    x, y, w, h = rect
    if part.fit:
        return [x, y, w, h]
    width, height = (
        min(scale * side, limit) for side, limit in zip(patch_extent_m(part), (w, h), strict=True)
    )
    return [x + rng.uniform(0, w - width), y + rng.uniform(0, h - height), width, height]


def quadric_of(part: Part) -> list[float]:
    """Coefficients a, b, c and z limits of x^2 + y^2 + a z^2 + b z + c = 0 in the patch's frame."""
    if part.kind == SPHERE:
        return [1.0, 0.0, -1.0, -1.0, 1.0]
    r0, slope = part.radii[0], part.radii[1] - part.radii[0]
    return [-(slope**2), -2 * r0 * slope, -(r0**2), 0.0, 1.0]


def patch_corners(part: Part) -> Array:
    """(8, 3) corners of a parallelepiped around the patch, in the patch's own coordinates."""
    if part.kind in (QUAD, DISC):
        low, high = np.zeros(3), np.array([1.0, 1.0, 0.0])
    elif part.kind == SPHERE:
        low, high = -np.ones(3), np.ones(3)
    else:
        r = max(part.radii)
        low, high = np.array([-r, -r, 0.0]), np.array([r, r, 1.0])
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
    return np.where(picks == 0, low, high)


def apply(b_from_a: Array, points_in_a: Array) -> Array:
    """(3, 4) transform of (..., 3) points."""
    return np.asarray(points_in_a @ b_from_a[:, :3].T + b_from_a[:, 3])


def build_surfaces(
    parts: Sequence[Part], owners: Sequence[int], windows: Sequence[Sequence[float]]
) -> tuple[Surfaces, int]:
    """Stack world parts into arrays and give each a piece of the light map (and its height)."""
    cells = []
    for part in parts:
        step = 0.06 if max(patch_extent_m(part)) > 1.2 else 0.08
        cells.append(
            tuple(int(np.clip(np.ceil(side / step), 3, 160)) for side in patch_extent_m(part))
        )
    places, height = pack([(w, h) for w, h in cells], 512, 1)
    surfaces = Surfaces(
        kind=np.array([p.kind for p in parts]),
        world_from_patch=np.stack([p.obj_from_patch for p in parts]),
        quadric=np.array([quadric_of(p) for p in parts]),
        radii=np.array([p.radii for p in parts]),
        texture_rect=np.array(windows, float),
        light_rect=np.array(
            [(*place, *cell) for place, cell in zip(places, cells, strict=True)], float
        ),
        owner=np.array(owners),
        two_sided=np.array([p.two_sided for p in parts]),
        emission=np.array([p.emission for p in parts]),
        corners_in_world=np.stack([apply(p.obj_from_patch, patch_corners(p)) for p in parts]),
    )
    return surfaces, height


def surface_points(
    kind: int, frame: Array, radii: Array, s: Array, t: Array
) -> tuple[Array, Array]:
    """Points and outward normals of a patch at texture coordinates s, t in 0..1.

    Args:
        frame: (3, 4) b_from_patch. s, t: (N,).
    Returns:
        points (N, 3) and unit normals (N, 3), both in b.
    """
    if kind in (QUAD, DISC):
        local = np.stack([s, t, np.zeros_like(s)], -1)
        normals = np.broadcast_to(-frame[:, 2], (len(s), 3))
        return apply(frame, local), normals
    angle = 2 * np.pi * (s - 0.5)
    if kind == SPHERE:
        z = 1 - 2 * t
        ring, slope = np.sqrt(np.maximum(1 - z**2, 0)), z
    else:
        z = 1 - t
        ring, slope = radii[0] + (radii[1] - radii[0]) * z, np.full_like(s, radii[0] - radii[1])
    local = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)  # (N, 3)
    flat = np.ones_like(s) if kind == FRUSTUM else ring
    gradient = np.stack([flat * np.cos(angle), flat * np.sin(angle), slope], -1) @ np.linalg.inv(
        frame[:, :3]
    )
    length = np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    return apply(frame, local), np.asarray(gradient / length)


def part_outline(part: Part) -> Array:
    """(96, 3) points whose convex hull is that of the part (round rims to 1e-3 of the radius)."""
    turn = np.arange(48) * 2 * np.pi / 48
    c, s = np.cos(turn), np.sin(turn)
    if part.kind == QUAD:
        local = np.tile(patch_corners(part), (12, 1))
    elif part.kind == DISC:
        local = np.tile(np.stack([0.5 + 0.5 * c, 0.5 + 0.5 * s, 0 * c], -1), (2, 1))
    elif part.kind == FRUSTUM:
        rims = [
            np.stack([r * c, r * s, np.full(48, z)], -1)
            for r, z in zip(part.radii, (0.0, 1.0), strict=True)
        ]
        local = np.concatenate(rims)
    else:
        z = 1 - 2 * (np.arange(96) + 0.5) / 96  # Fibonacci lattice
        golden = np.arange(96) * np.pi * (3 - np.sqrt(5))
        ring = np.sqrt(1 - z**2)
        local = np.stack([ring * np.cos(golden), ring * np.sin(golden), z], -1)
    return apply(part.obj_from_patch, local)


def place_object(
    index: int, place: Place, model: Model, twin_group: int
) -> tuple[RoomObject, list[Part], Array]:
    """Move a model into the room: truth, world parts, outline points (parts, 96, 3)."""
    rotation = rotation_z(place.yaw_rad)
    extent = np.concatenate([part_extremes(part) for part in model.parts])
    low, high = extent.min(0), extent.max(0)  # (3,) in the model's frame
    offset = np.asarray(place.position, float)
    parts = [moved(part, rotation, offset) for part in model.parts]
    truth = RoomObject(
        index=index,
        class_name=model.class_name,
        class_id=COCO_NAMES.index(model.class_name),
        twin_group=twin_group,
        support=model.support,
        center_in_world=rotation @ ((low + high) / 2) + offset,
        size_m=high - low,
        yaw_rad=float((place.yaw_rad + np.pi) % (2 * np.pi) - np.pi),
        world_from_obj=rotation,
    )
    return truth, parts, np.stack([part_outline(part) for part in parts])


def part_extremes(part: Part) -> Array:
    """(P, 3) points that hold the exact axis-aligned extent of a part."""
    if part.kind != SPHERE:
        return part_outline(part)
    reach = np.linalg.norm(part.obj_from_patch[:, :3], axis=1)  # (3,) half extent along each axis
    return np.asarray(part.obj_from_patch[:, 3] + np.stack([-reach, reach]))


def make_room(config: RoomConfig) -> Room:
    """Plan, furnish, paint and light a room; the same config gives the same room.

    Raises: ValueError for an unknown plan.
    """
    if config.plan not in PLANS:
        raise ValueError(f"plan {config.plan!r} is unknown: use {', '.join(PLANS)}")
    if config.plan == "corridor":
        return rooms_in_a_row(make_room(replace(config, plan="home")), CORRIDOR_ROOMS)
    varied = config.plan == "varied"
    rng = np.random.default_rng([config.seed, 1])
    sides = rng.uniform((5.0, 4.4, 2.4), (8.6, 7.2, 3.1)) if varied else config.room_m
    w, d, h = (side * (1 + float(rng.uniform(-1, 1)) * config.room_jitter) for side in sides)
    size = (w, d, h)
    models = furniture_models(rng)
    if varied:
        models = varied_models(rng, models)
        plan, fixed = varied_plan(config, rng, size)
    else:
        plan = limit_places(home_plan(config, rng, size), config)
        fixed = wall_pictures(size, rng) + fixed_furniture(size)
    placed = [
        place_object(i, place, models[place.model], list(models).index(place.model))
        for i, place in enumerate(plan)
    ]
    parts = room_shell(size) + skirting(size) + fixed
    owners = [-1] * len(parts) + [truth.index for truth, own, _ in placed for _ in own]
    parts += [part for _, own, _ in placed for part in own]
    textures = make_textures(rng, config, size)
    if varied:
        texels = (int(w * config.texels_per_m), int(d * config.texels_per_m))
        textures |= varied_textures(rng, config, (*texels, int(h * config.texels_per_m)))
    atlas, rects = build_atlas(textures)
    windows = object_windows(
        parts, owners, rects, config, rng, [truth.twin_group for truth, _, _ in placed]
    )
    surfaces, light_height = build_surfaces(parts, owners, windows)
    light = bake_light(surfaces, size, light_height, config.light_rays, rng)
    return Room(
        size, tuple(t for t, _, _ in placed), surfaces, atlas, light, tuple(o for _, _, o in placed)
    )


def home_plan(config: RoomConfig, rng: Rng, size: tuple[float, float, float]) -> list[Place]:
    """Dining table, desk, lounge and shelves, each at its own place."""
    center = (
        -size[0] / 2 + 1.65 + float(rng.uniform(-0.1, 0.1)),
        -0.95 + float(rng.uniform(-0.1, 0.1)),
    )
    return (
        dining_places(config, rng, center)
        + desk_places(rng, size)
        + lounge_places(rng, size)
        + shelf_places(size)
    )


CORRIDOR_ROOMS = 3  # chosen: two wrong places for every view
JOIN_M = 0.2  # what is so close to a wall that is left out goes with it: pictures, curtains


def rooms_in_a_row(room: Room, count: int) -> Room:
    """Repeat a room along x, without the walls between: every part looks the same, light too."""
    w, d, h = room.size_m
    x = room.surfaces.corners_in_world[..., 0]  # (S, 8)
    west, east = ((np.abs(x - side * w / 2) < JOIN_M).all(1) for side in (-1, 1))  # (S,)
    surfaces, objects, outlines = [], [], []
    for copy in range(count):
        keep = ~((east & (copy < count - 1)) | (west & (copy > 0)))
        shift, first = np.array([(copy - (count - 1) / 2) * w, 0.0, 0.0]), copy * len(room.objects)
        part = {name: getattr(room.surfaces, name)[keep] for name in Surfaces.__slots__}
        part["world_from_patch"] = part["world_from_patch"] + np.pad(
            shift[:, None], ((0, 0), (3, 0))
        )
        part["corners_in_world"] = part["corners_in_world"] + shift
        part["owner"] = np.where(part["owner"] < 0, -1, part["owner"] + first)
        surfaces.append(part)
        objects += [
            replace(o, index=o.index + first, center_in_world=o.center_in_world + shift)
            for o in room.objects
        ]
        outlines += [outline + shift for outline in room.outline_in_world]
    joined = {name: np.concatenate([s[name] for s in surfaces]) for name in Surfaces.__slots__}
    return Room(
        (count * w, d, h), tuple(objects), Surfaces(**joined), room.atlas, room.light,
        tuple(outlines),
    )  # fmt: skip


def object_windows(
    parts: Sequence[Part],
    owners: Sequence[int],
    rects: dict[str, tuple[int, int, int, int]],
    config: RoomConfig,
    rng: Rng,
    twin_groups: Sequence[int],
) -> list[list[float]]:
    """Texture pieces of all parts; twins get the very same: only the place tells them apart."""
    windows: list[list[float]] = []
    known: dict[tuple[int, int], list[float]] = {}
    seen = 0
    for index, (part, owner) in enumerate(zip(parts, owners, strict=True)):
        seen = seen + 1 if index and owners[index - 1] == owner else 0
        if owner < 0:
            windows.append(texture_window(part, rects[part.texture], config.texels_per_m, rng))
            continue
        key = (twin_groups[owner], seen)
        if key not in known:
            known[key] = texture_window(part, rects[part.texture], config.texels_per_m, rng)
        windows.append(known[key])
    return windows


# ---- Light --------------------------------------------------------------------------------------


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
    points, normals, slices, start = [], [], [], 0
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
    points: Array, normals: Array, lamp: tuple[Array, Array], voxels: Voxels, rays: int, rng: Rng
) -> Array:
    """(N,) share of a rectangular lamp's light that arrives: cosines, distance, shadow.

    Args:
        lamp: (3, 4) frame of the emitting quad and its (3,) unit direction.
    """
    frame, direction = lamp
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
            * np.maximum(-ray @ direction, 0)
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
    """(N,) share of the near half-space (0.6 m) that is open: contact shadows, dark corners."""
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
    surfaces: Surfaces, size: tuple[float, float, float], height: int, rays: int, rng: Rng
) -> npt.NDArray[np.float32]:
    """Irradiance of every patch: ceiling panels (warm), window (cool), ambient."""
    points, normals, slices = light_samples(surfaces)
    voxels = voxelize(surfaces, size)
    opened = ambient_open(points, normals, voxels, size, rng)
    up = 0.5 + 0.5 * normals[:, 2:]  # (N, 1)
    total = opened[:, None] * (
        up * [0.22, 0.205, 0.19] + (1 - up) * [0.12, 0.15, 0.19]
    )  # (N, 3) BGR
    for lamp in np.nonzero(surfaces.emission >= 1)[0]:
        frame = surfaces.world_from_patch[lamp]
        is_window = abs(frame[2, 2]) < 0.5
        color = np.array([4.6, 4.2, 3.8]) if is_window else np.array([5.2, 6.0, 6.6])
        arrived = lamp_light(points, normals, (frame, -frame[:, 2]), voxels, rays, rng)
        total += arrived[:, None] * color
    light = np.zeros((height, 512, 3), np.float32)
    for i, part in enumerate(slices):
        x, y, w, h = surfaces.light_rect[i].astype(int)
        block = total[part].reshape(h, w, 3).astype(np.float32)
        if surfaces.emission[i] > 0:
            block[:] = surfaces.emission[i]
        light[y : y + h, x : x + w] = cv2.GaussianBlur(
            block, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE
        )
    return light


# ---- Rendering ----------------------------------------------------------------------------------


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
    low, high = np.floor(pixels.min(1)) - 1, np.ceil(pixels.max(1)) + 1
    low[crossing], high[crossing] = 0, size
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
    s, t = np.arctan2(y, x) / (2 * np.pi) + 0.5, (z_high - z) / (z_high - z_low)
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
    surfaces, shape = room.surfaces, layers.patch.shape
    patch = np.maximum(layers.patch, 0).ravel()
    s, t = layers.s.ravel(), layers.t.ravel()
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


# ---- Camera -------------------------------------------------------------------------------------


def camera_matrix(config: RoomConfig) -> Array:
    """(3, 3) pinhole intrinsics in COLMAP pixels: the principal point is the image's middle."""
    focal = 0.5 * config.width / np.tan(np.radians(config.hfov_deg) / 2)
    return np.array([[focal, 0, config.width / 2], [0, focal, config.height / 2], [0, 0, 1.0]])


def tour_keys(room: Room, seed: int) -> list[tuple[float, tuple[float, float], Any]]:
    """Twice past every table, desk and couch, in another order and from another side."""
    rng = np.random.default_rng([seed, 6])
    large = [o for o in room.objects if o.class_name in ("dining table", "couch")]
    targets = np.array([o.center_in_world for o in large or room.objects])  # (T, 3)
    angle = rng.uniform(0, 2 * np.pi, len(targets))
    limit = np.array(room.size_m[:2]) / 2 - 0.5
    stops = []
    for _ in range(2):
        for t in rng.permutation(len(targets)):
            turn = angle[t] + rng.normal(0, 0.6)
            for step in (0.0, rng.normal(0, 0.5)):
                away = rng.uniform(1.1, 3.0) * np.array([np.cos(turn + step), np.sin(turn + step)])
                spot = np.clip(targets[t, :2] + away, -limit, limit)
                aim = targets[t] + rng.normal(0, 0.25, 3)
                stops.append(((float(spot[0]), float(spot[1])), aim))
    return [(i / (len(stops) - 1), spot, aim) for i, (spot, aim) in enumerate(stops)]


TURNS_FROM_TO = (0.3, 0.7)  # of the frames of the path "turn"


def path_keys(room: Room, kind: str, seed: int = 0) -> tuple[Array, Array, Array]:
    """Where the walk passes: time (K,) in 0..1, camera x, y (K, 2), what it looks at (K, 3)."""
    w, d, _ = room.size_m
    dining = (-w / 2 + 1.75, -0.9, 0.62)
    books, desk, couch = (0.3, -d / 2, 0.95), (w / 2 - 0.5, -0.5, 0.85), (0.6, d / 2 - 0.6, 0.62)
    side, corner = (-w / 2 + 0.3, d / 2 - 1.5, 0.8), (w / 2 - 0.4, d / 2 - 0.4, 0.9)
    keys = [
        (0.00, (0.05, 0.85), dining),
        (0.08, (0.85, 0.45), dining),
        (0.15, (1.10, -0.35), dining),
        (0.20, (0.95, -0.75), dining),
        (0.29, (0.70, 0.30), books),
        (0.37, (0.15, 0.85), desk),
        (0.44, (-0.15, 0.10), desk),
        (0.51, (0.10, -0.80), desk),
        (0.57, (-0.35, -1.10), corner),
        (0.62, (0.00, -1.15), couch),
        (0.69, (0.95, -1.00), couch),
        (0.77, (1.35, -0.50), side),
        (0.86, (1.10, -0.10), dining),
        (1.00, (0.15, 0.85), dining),
    ]
    if kind == "walk":
        keys = [(t / 0.77, xy, target) for t, xy, target in keys if t <= 0.77]
    elif kind == "orbit":
        turns = np.radians(np.linspace(-18, 82, 8))
        spots = [(dining[0] + 2.5 * np.cos(a), dining[1] + 2.5 * np.sin(a)) for a in turns]
        keys = [(i / 7, spot, dining) for i, spot in enumerate(spots)]
    elif kind == "tour":
        keys = tour_keys(room, seed)
    elif kind == "turn":
        stop, (first, last) = (1.0, -0.2), TURNS_FROM_TO
        keys = [(0.00, (0.05, 0.85), dining), (0.15, (0.85, 0.45), dining), (first, stop, dining)]
        keys += [((first + last) / 2, stop, couch), (last, stop, desk)]
        keys += [(0.85, (0.5, -0.9), desk), (1.00, (-0.4, -1.1), desk)]
    elif kind == "corridor":
        keys = [
            (t, (x, -0.3), (x + 1.2, d / 2, 1.0)) for t, x in ((0, 1 - w / 2), (1, w / 2 - 1.8))
        ]
    elif kind != "revisit":
        raise ValueError(f"path {kind!r} is unknown: use {', '.join(PATHS)}")
    times, spots_xy, targets = zip(*keys, strict=True)
    return np.array(times), np.array(spots_xy), np.array(targets)


def smooth(values: Array, sigma: float) -> Array:
    """Gaussian filter along the first axis of (F, C), ends mirrored in value."""
    reach = max(1, int(3 * sigma))
    head, tail = 2 * values[:1] - values[reach:0:-1], 2 * values[-1:] - values[-2 : -reach - 2 : -1]
    padded = np.concatenate([head, values, tail])
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    columns = [np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T]
    return np.stack(columns, 1)


def hand_shake(rng: Rng, seconds: Array) -> Array:
    """(F, 6) smooth unrest of about unit size: steps, sway, tremble."""
    wave = np.zeros((len(seconds), 6))
    for low, high, size in ((0.15, 0.5, 0.8), (0.7, 1.2, 0.6), (1.6, 2.2, 0.5)):
        rates, phases = rng.uniform(low, high, 6), rng.uniform(0, 2 * np.pi, 6)
        wave += size * np.sin(2 * np.pi * rates * seconds[:, None] + phases)
    return wave


STEP_M = 0.28  # between two photos of the path "table" (those of a recorded orbit)
EYE_RANGE_M = (0.95, 1.85)  # their heights: kneeling to standing
WALL_MARGIN_M = 0.35  # of the path "table"


def table_path(room: Room, config: RoomConfig) -> Array:
    """Photos once round the table with most space about it, weaving up and down, looking at it.

    Returns:
        cam_from_world (F, 3, 4), STEP_M apart along the way; few photos go straight round.
    Raises: ValueError for a room without a table.
    """
    limit = np.array(room.size_m[:2]) / 2
    tables = [o.center_in_world for o in room.objects if o.class_name == "dining table"]
    if not tables:
        raise ValueError("path 'table' needs a room with a dining table")
    space, at = max(((limit - np.abs(t[:2])).min(), -i) for i, t in enumerate(tables))
    target, radius = tables[-at], space - WALL_MARGIN_M
    low, high = EYE_RANGE_M

    def way(waves: float) -> tuple[Array, Array]:
        """Fine points (N, 3) of the way with so many waves, and the length (N,) up to each."""
        turn = np.linspace(0, 2 * np.pi, 20000)
        up = 0.5 * (high + low + (high - low) * np.sin(waves * turn))
        xy = target[:2] + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        points = np.column_stack([xy, up])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return points, np.concatenate([[0.0], np.cumsum(steps)])

    fewest, most = 0.0, float(config.frames)
    for _ in range(40):  # the length grows with the waves
        middle = (fewest + most) / 2
        longer = way(middle)[1][-1] > STEP_M * (config.frames - 1)
        fewest, most = (fewest, middle) if longer else (middle, most)
    points, length = way(fewest)
    places = np.linspace(0, length[-1], config.frames)
    centers = np.column_stack([np.interp(places, length, column) for column in points.T])  # (F, 3)
    aim = target + np.random.default_rng([config.seed, 2]).normal(0, 0.05, centers.shape) - centers
    pitch = np.arctan2(aim[:, 2], np.hypot(aim[:, 0], aim[:, 1]))
    return look_along(centers, np.arctan2(aim[:, 1], aim[:, 0]), pitch, np.zeros(config.frames))


def camera_path(room: Room, config: RoomConfig) -> Array:
    """Walk through the room by hand: cam_from_world (F, 3, 4), seeded."""
    if config.path == "table":
        return table_path(room, config)
    rng = np.random.default_rng([config.seed, 2])
    times, spots, targets = path_keys(room, config.path, config.seed)
    aim = targets - np.column_stack([spots, np.full(len(spots), config.eye_m)])  # (K, 3)
    yaw = np.unwrap(np.arctan2(aim[:, 1], aim[:, 0]))
    pitch = np.arctan2(aim[:, 2], np.hypot(aim[:, 0], aim[:, 1]))
    keys = np.column_stack([spots, yaw, pitch])  # (K, 4)
    progress = np.linspace(0, 1, config.frames)
    track = np.column_stack([np.interp(progress, times, column) for column in keys.T])  # (F, 4)
    if config.frames > 20:
        track = smooth(track, 0.03 * config.frames)
    shake = hand_shake(rng, np.arange(config.frames) / config.fps)
    centers = (
        np.column_stack([track[:, :2], np.full(config.frames, config.eye_m)])
        + config.shake_m * shake[:, :3]
    )
    angles = np.radians(config.shake_deg) * shake[:, 3:] * [1, 1, 1.6]
    return look_along(centers, track[:, 2] + angles[:, 0], track[:, 3] + angles[:, 1], angles[:, 2])


def look_along(centers_in_world: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """cam_from_world (F, 3, 4) from camera centres (F, 3) and viewing angles in rad."""
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], -1
    )
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], -1)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    rotation = np.stack(
        [c * right + s * down, c * down - s * right, forward], 1
    )  # (F, 3, 3) rows x, y, z
    offset = -np.einsum("fij,fj->fi", rotation, centers_in_world)
    return np.concatenate([rotation, offset[:, :, None]], 2)


# ---- Photograph ---------------------------------------------------------------------------------


def image_flow(depth: Array, K: Array, next_from_cam: Array) -> Array:
    """(H, W, 2) where each pixel's point goes in the next view, minus where it is, in pixels."""
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    moved_points = apply(next_from_cam, rays * depth[..., None])
    pixels = moved_points @ K.T
    return np.asarray(pixels[..., :2] / np.maximum(pixels[..., 2:], NEAR_M) - np.stack([u, v], -1))


def blur_motion(
    image: npt.NDArray[Any], flow: Array, shutter: float, taps: int = 5
) -> npt.NDArray[np.float32]:
    """Mean of the picture along the motion while the shutter is open."""
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    total = np.zeros(image.shape, np.float32)
    for share in (np.arange(taps) / (taps - 1) - 0.5) * shutter:
        map_u, map_v = (
            u - (share * flow[..., 0]).astype(np.float32),
            v - (share * flow[..., 1]).astype(np.float32),
        )
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


def render_clip(room: Room, config: RoomConfig, cameras: Array | None = None) -> Iterator[Frame]:
    """Render frame after frame; each frame has its own random stream, so any subset repeats."""
    K = camera_matrix(config)
    poses = camera_path(room, config) if cameras is None else cameras  # (F, 3, 4)
    size = (config.width, config.height)
    for index, pose in enumerate(poses):
        rng = np.random.default_rng([config.seed, 4, index])
        clean, instance, depth = render(
            room, K, pose, size, config.supersample, exposure_at(index, config)
        )
        moves = index + 1 < len(poses) and config.path != "table"  # photos: nothing is blurred
        after = poses[index + 1] if moves else pose
        rotation = after[:, :3] @ pose[:, :3].T
        next_from_cam = np.concatenate(
            [rotation, (after[:, 3] - rotation @ pose[:, 3])[:, None]], 1
        )
        flow = image_flow(depth.astype(np.float64), K, next_from_cam)
        image = photograph(clean, flow, config, rng)
        yield Frame(index, image, instance, depth, pose, ground_truth(room, K, pose, instance))


# ---- Ground truth -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """What one frame shows; NaN boxes where there is nothing to box."""

    visible_px: npt.NDArray[np.int64]  # (O,) pixels of each object in the instance map
    visible_xyxy: Array  # (O, 4) tight box of those pixels
    amodal_xyxy: Array  # (O, 4) box of the whole object, hidden and cut parts too
    solid_xyxy: Array  # (O, 4) box of the solid (box, cylinder, ellipsoid) that stands for it
    visibility: Array  # (O,) visible pixels / pixels of the whole silhouette


def project_points(points_in_world: Array, K: Array, cam_from_world: Array) -> tuple[Array, Array]:
    """Pixels (..., 2) and depths (...,)."""
    in_cam = apply(cam_from_world, points_in_world)
    pixels = in_cam @ K.T
    return pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-9), in_cam[..., 2]


def sphere_rim(world_from_patch: Array, center_in_world: Array, count: int = 96) -> Array:
    """(count, 3) points where rays from the camera centre touch an ellipsoid.

    Where it is the unit sphere and the camera is at o, they are the circle x . o = 1, |x| = 1.
    """
    linear = world_from_patch[:, :3]
    o = np.linalg.solve(linear, center_in_world - world_from_patch[:, 3])
    squared = max(float(o @ o), 1.0 + 1e-9)
    first = np.cross(o, np.eye(3)[int(np.abs(o).argmin())])
    first /= np.linalg.norm(first)
    second = np.cross(o, first) / np.linalg.norm(o)
    turn = np.arange(count)[:, None] * 2 * np.pi / count
    ring = np.sqrt(1 - 1 / squared) * (np.cos(turn) * first + np.sin(turn) * second)
    return apply(world_from_patch, o / squared + ring)


def object_outline(room: Room, index: int, center_in_world: Array) -> Array:
    """(parts, 96, 3) points whose projections span the object's outline from this camera centre."""
    points = room.outline_in_world[index].copy()
    own = np.nonzero(room.surfaces.owner == index)[0]
    for k in np.nonzero(room.surfaces.kind[own] == SPHERE)[0]:
        points[k] = sphere_rim(room.surfaces.world_from_patch[own[k]], center_in_world)
    return points


def solid_outline(truth: RoomObject, center_in_world: Array) -> Array:
    """(P, 3) points whose projections span the outline of the object's solid."""
    half = truth.size_m / 2
    frame = np.concatenate(
        [truth.world_from_obj * half, truth.center_in_world[:, None]], 1
    )  # (3, 4)
    if truth.support == "ellipsoid":
        return sphere_rim(frame, center_in_world)
    if truth.support == "box":
        signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), -1).reshape(8, 3)
        return apply(frame, signs)
    turn = np.arange(96) * 2 * np.pi / 96
    rims = [np.stack([np.cos(turn), np.sin(turn), np.full(96, z)], -1) for z in (-1.0, 1.0)]
    return apply(frame, np.concatenate(rims))


def box_of(points: Array) -> Array:
    """(4,) x0, y0, x1, y1 of (..., 2) pixels."""
    flat = points.reshape(-1, 2)
    return np.concatenate([flat.min(0), flat.max(0)])


def silhouette_area(part_pixels: Array, canvas: int = 640) -> float:
    """Area in px^2 of the union of the parts' convex hulls, uncut; part_pixels (n, P, 2)."""
    x0, y0, x1, y1 = box_of(part_pixels)
    scale = (canvas - 8) / max(x1 - x0, y1 - y0, 1e-6)
    mask = np.zeros((canvas, canvas), np.uint8)
    for pixels in part_pixels:
        hull = cv2.convexHull(((pixels - [x0, y0]) * scale + 3.5).astype(np.float32))
        cv2.fillConvexPoly(mask, np.round(hull * 16).astype(np.int32), (1,), cv2.LINE_8, 4)
    return float(mask.sum() / scale**2)


def visible_boxes(
    instance: npt.NDArray[np.int32], count: int
) -> tuple[npt.NDArray[np.int64], Array]:
    """Pixel counts (O,) and tight boxes (O, 4) of the labels 0 .. count - 1."""
    pixels = np.bincount(instance.ravel() + 1, minlength=count + 1)[1:]
    boxes = np.full((count, 4), np.nan)
    for index in np.nonzero(pixels)[0]:
        rows, cols = np.nonzero(instance == index)
        boxes[index] = cols.min(), rows.min(), cols.max() + 1, rows.max() + 1
    return pixels, boxes


def ground_truth(
    room: Room, K: Array, cam_from_world: Array, instance: npt.NDArray[np.int32]
) -> FrameTruth:
    """Boxes and visibility of every object in one view; `instance` is `render`'s map."""
    count = len(room.objects)
    pixels, visible = visible_boxes(instance, count)
    center = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    amodal, solid = np.full((count, 4), np.nan), np.full((count, 4), np.nan)
    visibility = np.zeros(count)
    for truth in room.objects:
        spread, depth = project_points(solid_outline(truth, center), K, cam_from_world)
        if depth.min() < NEAR_M:
            continue
        solid[truth.index] = box_of(spread)
        parts, _ = project_points(
            object_outline(room, truth.index, center), K, cam_from_world
        )  # (n, 96, 2)
        amodal[truth.index] = box_of(parts)
        if pixels[truth.index]:
            visibility[truth.index] = min(1.0, pixels[truth.index] / silhouette_area(parts))
    return FrameTruth(pixels, visible, amodal, solid, visibility)


# ---- Simulated detector -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """What a detector would say about one frame."""

    xyxy: Array  # (D, 4) px, corner convention
    score: Array  # (D,)
    class_id: npt.NDArray[np.int64]  # (D,)
    masks: tuple[npt.NDArray[np.bool_], ...]  # D times (H, W); an empty array where there is none
    truth_index: npt.NDArray[np.int64]  # (D,) object index, -1 for a false positive; not written


def sigmoid(x: Array) -> Array:
    """1 / (1 + exp(-x))."""
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -30, 30))))


def jitter_mask(
    mask: npt.NDArray[np.bool_], config: DetectorConfig, rng: Rng
) -> npt.NDArray[np.bool_]:
    """Move the outline a little: smooth noise on a blurred mask, a high threshold erodes."""
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.5)
    wobble = fractal_noise(rng, mask.shape[0], mask.shape[1], (12, 40))
    return np.asarray((soft > 0.5 + 0.25 * config.mask_erosion_px + 0.12 * wobble) & (soft > 0.05))


def simulate_detections(
    room: Room, truth: FrameTruth, instance: npt.NDArray[np.int32], config: DetectorConfig, rng: Rng
) -> FrameDetections:
    """Detector-like boxes and masks: jitter, misses, low scores when hidden, false positives."""
    height, width = instance.shape
    sides = np.nan_to_num(truth.visible_xyxy[:, 2:] - truth.visible_xyxy[:, :2]).min(1)  # (O,)
    clear = sigmoid((truth.visibility - config.min_visibility) / 0.06) * sigmoid(
        (sides - config.min_side_px) / 2
    )
    found = np.nonzero(
        (truth.visible_px > 0) & (rng.random(len(sides)) < (1 - config.miss_rate) * clear)
    )[0]
    boxes = truth.visible_xyxy[found]  # (D, 4)
    extent = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = np.clip(
        boxes + rng.normal(0, config.box_sigma, boxes.shape) * extent, 0, [width, height] * 2
    )
    score = 0.30 + 0.62 * clear[found] * (0.55 + 0.45 * truth.visibility[found])
    score = np.clip(score + rng.normal(0, config.score_sigma, len(found)), 0.05, 0.99)
    class_id = np.array([room.objects[i].class_id for i in found], np.int64)
    confused = rng.random(len(found)) < config.class_confusion
    class_id = np.where(confused, rng.integers(0, len(COCO_NAMES), len(found)), class_id)
    masks = [jitter_mask(instance == i, config, rng) for i in found]
    false = false_positives(room, (width, height), config, rng)
    masks += [np.zeros((0, 0), bool)] * len(false[0])
    return FrameDetections(
        np.concatenate([boxes, false[0]]),
        np.concatenate([score, false[1]]),
        np.concatenate([class_id, false[2]]),
        tuple(masks),
        np.concatenate([found, np.full(len(false[0]), -1)]),
    )


def false_positives(
    room: Room, size: tuple[int, int], config: DetectorConfig, rng: Rng
) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Boxes where nothing is: classes of this room, low scores."""
    count = int(rng.poisson(config.false_positives))
    extent = rng.uniform(20, 110, (count, 2))
    corner = rng.uniform(0, 1, (count, 2)) * (np.array(size) - extent)
    classes = np.array([truth.class_id for truth in room.objects], np.int64)
    picked = rng.choice(classes, count) if len(classes) else np.zeros(count, np.int64)
    return np.concatenate([corner, corner + extent], 1), rng.uniform(0.2, 0.5, count), picked


# ---- Writers ------------------------------------------------------------------------------------


def run_lengths(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint32]:
    """COCO-style run lengths, column-major, zeros first; none for an empty array."""
    flat = mask.ravel(order="F")
    if not flat.size:
        return np.zeros(0, np.uint32)
    turns = np.nonzero(flat[1:] != flat[:-1])[0] + 1
    edges = np.concatenate([[0] if not flat[0] else [0, 0], turns, [flat.size]])
    return np.diff(edges).astype(np.uint32)


def save_detections(path: Path, frames: Sequence[FrameDetections], size: tuple[int, int]) -> None:
    """Write `detections.npz`: arrays over all frames, masks as concatenated run lengths."""
    runs = [run_lengths(mask) for frame in frames for mask in frame.masks]
    lengths = np.array([len(run) for run in runs], np.int64)
    np.savez_compressed(
        path,
        frame=np.repeat(np.arange(len(frames), dtype=np.int64), [len(f.score) for f in frames]),
        xyxy=np.concatenate([f.xyxy for f in frames]).round(2),
        score=np.concatenate([f.score for f in frames]).round(4),
        class_id=np.concatenate([f.class_id for f in frames]).astype(np.int64),
        class_names=np.array(COCO_NAMES),
        image_size=np.array(size, np.int64),
        mask_counts=np.concatenate(runs) if runs else np.zeros(0, np.uint32),
        mask_offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
    )


def mot_lines(frame: int, truth: FrameTruth, room: Room, size: tuple[int, int]) -> list[str]:
    """MOTChallenge ground truth of one frame: visible boxes of objects seen well enough."""
    lines = []
    for item in room.objects:
        x0, y0, x1, y1 = truth.visible_xyxy[item.index]
        if truth.visibility[item.index] >= 0.1 and min(x1 - x0, y1 - y0) >= 8:
            box_text = f"{x0:.2f},{y0:.2f},{x1 - x0:.2f},{y1 - y0:.2f}"  # pixels as in tracks.txt
            tail = f"1,{item.class_id},{truth.visibility[item.index]:.3f}"
            lines.append(f"{frame + 1},{item.index + 1},{box_text},{tail}")
    return lines


def quaternion_xyzw(rotation: Array) -> Array:
    """Unit quaternion of a (3, 3) rotation: the eigenvector of its 4x4 form, w >= 0.

    Ref: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000.
    """
    r = rotation
    form = np.zeros((4, 4))
    form[:3, :3] = r + r.T - np.trace(r) * np.eye(3)
    form[:3, 3] = form[3, :3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    form[3, 3] = np.trace(r)
    quaternion = np.linalg.eigh(form)[1][:, -1]
    return np.asarray(quaternion * (1 if quaternion[3] >= 0 else -1))


def tum_line(seconds: float, cam_from_world: Array) -> str:
    """`t tx ty tz qx qy qz qw`, world_from_cam."""
    rotation = cam_from_world[:, :3].T
    center = -rotation @ cam_from_world[:, 3]
    return f"{seconds:.6f} " + " ".join(f"{v:.9f}" for v in (*center, *quaternion_xyzw(rotation)))


def objects_json(room: Room, config: RoomConfig) -> dict[str, Any]:
    """The truth about all objects, for `gt_objects.json`."""
    objects = [
        {
            "id": item.index + 1,
            "class": item.class_name,
            "class_id": item.class_id,
            "twin_group": item.twin_group,
            "support": item.support,
            "center": item.center_in_world.round(6).tolist(),
            "size_m": item.size_m.round(6).tolist(),
            "half_axes": (item.size_m / 2).round(6).tolist(),
            "yaw_rad": round(item.yaw_rad, 6),
            "world_from_obj": item.world_from_obj.round(9).tolist(),
        }
        for item in room.objects
    ]
    conventions = {
        "pose": "cam_from_world",
        "camera_axes": "x right, y down, z forward",
        "pixels": "corner (COLMAP)",
    }
    settings = {name: getattr(config, name) for name in config.__slots__}
    if config.plan == "home":
        del settings["plan"]
    head: dict[str, Any] = {
        "format": "reobj-room-truth",
        "version": 1,
        "units": "m",
        "up_axis": "+z",
    }
    head |= {
        "conventions": conventions,
        "config": settings,
        "room_m": [round(v, 6) for v in room.size_m],
    }
    return {**head, "K": camera_matrix(config).tolist(), "objects": objects}


def camera_line(config: RoomConfig) -> str:
    """One line of a COLMAP cameras.txt."""
    K = camera_matrix(config)
    focal = f"{K[0, 0]:.9f} {K[1, 1]:.9f}"
    return f"1 PINHOLE {config.width} {config.height} {focal} {K[0, 2]:.1f} {K[1, 2]:.1f}"


class VideoSink:
    """A video file to write BGR frames to.

    OpenCV's wheels write MPEG-4 part 2 at a rate of their own; `crf` asks PyAV for H.264 instead,
    which is sharper at the same size and plays in browsers.
    """

    def __init__(self, path: Path, config: RoomConfig, crf: int | None = None) -> None:
        self._stream: Any = None
        if crf is None:
            code, size = cv2.VideoWriter.fourcc(*"mp4v"), (config.width, config.height)
            self._file: Any = cv2.VideoWriter(str(path), code, config.fps, size)
            if not self._file.isOpened():
                raise OSError(f"{path}: this OpenCV cannot write MPEG-4 video")
            return
        try:
            self._av = importlib.import_module("av")
        except ImportError as error:
            raise ImportError("--crf needs PyAV: pip install av") from error
        self._file = self._av.open(str(path), "w", options={"movflags": "+faststart"})
        options = {"crf": str(crf), "preset": "veryslow", "threads": "1"}
        rate = Fraction(config.fps).limit_denominator(1000)
        self._stream = self._file.add_stream("libx264", rate=rate, options=options)
        self._stream.width, self._stream.height = config.width, config.height
        self._stream.pix_fmt = "yuv420p"

    def write(self, image: Image) -> None:
        """Append a frame."""
        if self._stream is None:
            self._file.write(image)
            return
        frame = self._av.VideoFrame.from_ndarray(image, format="bgr24")
        self._file.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file."""
        if self._stream is None:
            self._file.release()
            return
        self._file.mux(self._stream.encode())
        self._file.close()


def write_clip(
    out: Path,
    config: RoomConfig,
    detector: DetectorConfig,
    png: bool = False,
    crf: int | None = None,
) -> dict[str, int]:
    """Render a clip into a folder, with all truth files."""
    out.mkdir(parents=True, exist_ok=True)
    room = make_room(config)
    size = (config.width, config.height)
    mot: list[str] = []
    tum: list[str] = []
    found: list[FrameDetections] = []
    writer = VideoSink(out / "room.mp4", config, crf)
    for frame in render_clip(room, config):
        writer.write(frame.image)
        if png:
            cv2.imwrite(str(out / f"frame_{frame.index:05d}.png"), frame.image)
        rng = np.random.default_rng([config.seed, 5, frame.index])
        found.append(simulate_detections(room, frame.truth, frame.instance, detector, rng))
        mot += mot_lines(frame.index, frame.truth, room, size)
        tum.append(tum_line(frame.index / config.fps, frame.cam_from_world))
        show_progress(frame.index + 1, config.frames)
    writer.close()
    save_detections(out / "detections.npz", found, size)
    (out / "gt_mot.txt").write_text("\n".join(mot) + "\n")
    (out / "poses.txt").write_text("\n".join(tum) + "\n")
    (out / "camera.txt").write_text(camera_line(config) + "\n")
    (out / "gt_objects.json").write_text(json.dumps(objects_json(room, config), indent=1) + "\n")
    return {
        "frames": config.frames,
        "objects": len(room.objects),
        "boxes": len(mot),
        "detections": sum(len(f.score) for f in found),
    }


def show_progress(done: int, total: int) -> None:
    """A counter on stderr, only on a terminal."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\rrender {done}/{total}" + ("\n" if done == total else ""))
        sys.stderr.flush()


# ---- Command line -------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """Options come from the config's defaults."""
    base = RoomConfig()
    parser = argparse.ArgumentParser(
        description="Render a hand-held video of a furnished room with ground truth."
    )
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder to write to")
    add("--seed", type=int, default=base.seed, help="random seed")
    add("--frames", type=int, default=base.frames)
    add(
        "--size",
        default=f"{base.width}x{base.height}",
        help="WIDTHxHEIGHT in pixels (default %(default)s)",
    )
    add("--fps", type=float, default=base.fps)
    add(
        "--path",
        choices=PATHS,
        default=base.path,
        help="camera path: " + "; ".join(f"{k}: {v}" for k, v in PATHS.items()),
    )
    add(
        "--plan",
        choices=PLANS,
        default=base.plan,
        help="; ".join(f"{k}: {v}" for k, v in PLANS.items()),
    )
    add("--chairs", type=int, default=base.chairs, help="identical chairs, up to 6")
    add("--monitors", type=int, default=base.monitors)
    add("--noise", type=float, default=base.noise, help="sensor noise in grey levels")
    add(
        "--shutter",
        type=float,
        default=base.shutter,
        help="motion blur as a fraction of the frame interval",
    )
    add("--texels", type=float, default=base.texels_per_m, help="texture resolution per metre")
    add("--crf", type=int, help="write H.264 of this quality with PyAV (pip install av), e.g. 26")
    add("--png", action="store_true", help="also write every frame as PNG")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    args = build_parser().parse_args(argv)
    try:
        width, height = (int(side) for side in args.size.lower().split("x"))
        if width < 16 or height < 16 or args.frames < 1:
            raise ValueError
    except ValueError:
        print(
            f"error: --size {args.size} --frames {args.frames}: expected e.g. 640x480 and >= 1",
            file=sys.stderr,
        )
        return 2
    config = RoomConfig(
        seed=args.seed,
        width=width,
        height=height,
        frames=args.frames,
        fps=args.fps,
        path=args.path,
        plan=args.plan,
        chairs=args.chairs,
        monitors=args.monitors,
        noise=args.noise,
        shutter=args.shutter,
        texels_per_m=args.texels,
    )
    print(json.dumps(write_clip(args.out, config, DetectorConfig(), args.png, args.crf)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
