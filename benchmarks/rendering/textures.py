"""Procedural textures: functions (rng, height, width, ...) -> uint8 BGR."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendering.config import Color, Image, Rng

Floats = npt.NDArray[np.float32]
AA = cv2.LINE_AA


# ---- Noise and finish ----------------------------------------------------------------------------


def fractal_noise(rng: Rng, height: int, width: int, cells: Sequence[float]) -> Floats:
    """Sum smooth random grids with cells of these sizes (texels); large cells weigh more."""
    total = np.zeros((height, width), np.float32)
    weights = np.sqrt(np.asarray(cells)) / np.sqrt(np.asarray(cells)).sum()
    for cell, weight in zip(cells, weights, strict=True):
        shape = (max(2, int(height / cell)), max(2, int(width / cell)))
        grid = rng.standard_normal(shape).astype(np.float32)
        smooth = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        total += np.float32(weight) * smooth
    return total


def to_image(values: npt.NDArray[Any]) -> Image:
    """Clip to 0..255 and convert."""
    return np.asarray(np.clip(values, 0, 255), np.uint8)


def shade(base: Color, tone: npt.NDArray[Any]) -> Floats:
    """Colour a (H, W) relative tone map: base * (1 + tone)."""
    return np.asarray(np.asarray(base, np.float32) * (1 + tone[..., None]), np.float32)


def mottled(
    rng: Rng, height: int, width: int, base: Color, tone: float, cells: Sequence[float]
) -> Floats:
    """A ground of one colour with smooth tones."""
    return shade(base, tone * fractal_noise(rng, height, width, cells))


def speckle(rng: Rng, height: int, width: int, amplitude: float) -> Floats:
    """Fine grain that gives corners to a feature detector close by."""
    grain = rng.standard_normal((height, width)).astype(np.float32)
    return np.float32(amplitude) * cv2.GaussianBlur(grain, (0, 0), 0.8) * 2.2


def finished(
    rng: Rng, image: npt.NDArray[Any], grain: float, tone: float = 0.0, cells: Sequence[float] = ()
) -> Image:
    """The picture with fine grain, and with smooth tones if there are cells."""
    height, width = image.shape[:2]
    smooth = tone * fractal_noise(rng, height, width, cells) if cells else 0
    return to_image(image * (1 + (smooth + speckle(rng, height, width, grain))[..., None]))


# ---- Drawing -------------------------------------------------------------------------------------


def varied_color(rng: Rng, base: Color, low: float, high: float) -> list[float]:
    """The colour darker or lighter by a random factor."""
    factor = rng.uniform(low, high)
    return (np.asarray(base) * factor).tolist()  # type: ignore[no-any-return]


def random_color(rng: Rng, low: float = 30, high: float = 225) -> list[float]:
    """A colour that is neither grey nor neon."""
    natural = [
        (55, 85, 190), (70, 165, 215), (70, 130, 120),  # rust, mustard, olive
        (75, 105, 60), (130, 125, 45), (205, 170, 120),  # forest, teal, sky
        (120, 75, 40), (95, 60, 110), (60, 60, 165),  # navy, plum, brick
        (150, 190, 215), (200, 225, 235),  # sand, cream
        (70, 66, 62), (120, 140, 190),  # charcoal, clay
    ]  # fmt: skip
    color = np.array(natural[int(rng.integers(len(natural)))]) + rng.normal(0, 9, 3)
    color = 0.82 * color + 0.18 * color.mean()
    color = np.clip(color * rng.uniform(low, high) / color.max(), 5, 250)
    return color.tolist()  # type: ignore[no-any-return]


def ellipse(
    image: npt.NDArray[Any],
    center: tuple[int, int],
    axes: tuple[int, int],
    turn_deg: float,
    color: Color,
    thickness: int = -1,
) -> None:
    """Paint a whole ellipse, filled by default."""
    cv2.ellipse(image, center, axes, turn_deg, 0, 360, color, thickness, AA)


def bar(image: npt.NDArray[Any], x: int, y: int, x1: int, y1: int, color: Color) -> None:
    """Paint a filled rectangle, its last row and column included."""
    cv2.rectangle(image, (x, y), (x1, y1), color, -1)


def frame(
    image: npt.NDArray[Any], inset: int, color: Color, thickness: int, line: int = cv2.LINE_8
) -> None:
    """Paint a line around the picture, so far from its edge."""
    height, width = image.shape[:2]
    corner = (width - 1 - inset, height - 1 - inset)
    cv2.rectangle(image, (inset, inset), corner, color, thickness, line)


def stamp(
    image: npt.NDArray[Any], text: str, corner: tuple[int, int], size: float, color: Color
) -> None:
    """Write text into a float image (OpenCV 5 writes into 8-bit ones only)."""
    ink = np.zeros(image.shape[:2], np.uint8)
    thickness = max(1, int(size * 2))
    cv2.putText(ink, text, corner, cv2.FONT_HERSHEY_SIMPLEX, size, (255,), thickness, AA)
    where = np.nonzero(ink)
    opacity = ink[where][:, None] / np.float32(255)
    image[where] = image[where] * (1 - opacity) + np.asarray(color, np.float32) * opacity


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


# ---- Walls, floors, cloth ------------------------------------------------------------------------


def plaster(rng: Rng, height: int, width: int, base: Color, tone: float = 0.07) -> Image:
    """Painted wall: patches of tone, trowel marks, stains, specks."""
    image = mottled(rng, height, width, base, tone, (4, 12, 40, 130, 400))
    for _ in range(height * width // 9000):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.integers(2, 22)), int(rng.integers(1, 7)))
        color = varied_color(rng, base, 0.86, 1.1)
        ellipse(image, center, axes, float(rng.uniform(0, 180)), color)
    return finished(rng, 0.5 * image + 0.5 * cv2.GaussianBlur(image, (0, 0), 1.2), 0.03)


def wallpaper(rng: Rng, height: int, width: int, base: Color) -> Image:
    """Painted sprigs of leaves on a striped ground, all different."""
    stripes = 0.03 * np.sign(np.sin(np.arange(width) / 24.0))
    image = shade(base, stripes[None, :] + 0.05 * fractal_noise(rng, height, width, (5, 30, 160)))
    for _ in range(height * width // 2600):
        x, y, turn, size, tint = rng.uniform((0, 0, 0, 5, 0.68), (width, height, 360, 15, 1.14))
        color = (np.asarray(base) * tint * rng.uniform(0.93, 1.07, 3)).tolist()
        for leaf in range(int(rng.integers(2, 6))):
            angle = turn + leaf * rng.uniform(40, 75)
            step = size * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            center = (int(x + step[0]), int(y + step[1]))
            ellipse(image, center, (int(size), max(1, int(size / 3))), angle, color)
    return finished(rng, image, 0.025)


def bricks(rng: Rng, height: int, width: int, base: Color) -> Image:
    """Old brick wall with a tone of its own for each brick."""
    image = mottled(rng, height, width, (150, 158, 165), 0.08, (3, 15, 90))
    row_h = 26
    brick_w = 76
    joint = 3
    for y in range(0, height, row_h):
        shift = (y // row_h % 2) * brick_w // 2 + int(rng.integers(-5, 6))
        for x in (shift + brick_w * np.arange(-1, width // brick_w + 2)).tolist():
            color = np.asarray(base) * rng.uniform(0.7, 1.2) * rng.uniform(0.93, 1.07, 3)
            cut = int(rng.integers(0, 3))
            bar(image, x + joint, y + joint, x + brick_w - cut, y + row_h - 1, color.tolist())
    return finished(rng, image, 0.05, 0.16, (3, 7, 18, 60, 250))


def wood(rng: Rng, height: int, width: int, base: Color, contrast: float = 0.16) -> Image:
    """Grain along the width: stretched noise bent by a slow one, a few knots."""
    grain = fractal_noise(rng, height, max(8, width // 16), (2, 4, 9, 24))
    long = cv2.resize(grain, (width, height))
    bend = fractal_noise(rng, height, width, (90, 260))
    rings = np.sin(np.arange(height)[:, None] / 5.0 + 5.0 * bend + 1.5 * long).astype(np.float32)
    image = shade(base, contrast * (long + 0.35 * rings + 0.4 * bend))
    for _ in range(height * width // 60000):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        for radius in range(int(rng.integers(3, 8)), 0, -2):
            ellipse(image, center, (2 * radius, radius), 0, varied_color(rng, base, 0.4, 0.8), 1)
    return finished(rng, image, 0.035)


def planks(rng: Rng, height: int, width: int, base: Color) -> Image:
    """Floor boards along the width, each cut from its own piece of wood."""
    image = np.zeros((height, width, 3), np.uint8)
    board_h = 42
    stock = wood(rng, 1024, 1024, base)
    seam = (25, 35, 45)
    for y in range(0, height, board_h):
        x = -int(rng.integers(0, 300))
        rows = min(board_h, height - y)
        while x < width:
            length = int(rng.integers(220, 460))
            x0 = max(x, 0)
            x1 = max(0, min(x + length, width))
            v = int(rng.integers(0, 1024 - board_h))
            u = int(rng.integers(0, 1024 - 460))
            piece = stock[v : v + rows, u : u + x1 - x0] * rng.uniform(0.78, 1.15)
            image[y : y + rows, x0:x1] = to_image(piece)
            cv2.line(image, (x0, y), (x0, y + rows), seam, 1)
            x += length
        cv2.line(image, (0, y), (width, y), seam, 1)
    return finished(rng, image, 0.03, 0.06, (6, 60, 300))


def fabric(rng: Rng, height: int, width: int, base: Color, motif: bool = False) -> Image:
    """Woven cloth, with seams; optionally with a scattered print."""
    weave = 0.06 * np.sin(np.arange(height)[:, None] * 1.9) * np.sin(np.arange(width) * 1.9)
    image = shade(base, weave + 0.1 * fractal_noise(rng, height, width, (2, 5, 20, 90)))
    for _ in range(height * width // 900 if motif else 0):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        color = np.array(varied_color(rng, base, 0.5, 1.6)) + rng.uniform(-30, 30, 3)
        radius = int(rng.integers(2, 9))
        cv2.circle(image, center, radius, to_image(color).tolist(), int(rng.choice([-1, 1, 2])), AA)
    frame(image, 6, [c * 0.62 for c in base], 1, AA)
    return finished(rng, image, 0.05)


def plain(rng: Rng, height: int, width: int, base: Color, tone: float = 0.05) -> Image:
    """Plastic, metal, ceramics: nearly even, with scuffs."""
    smooth = tone * fractal_noise(rng, height, width, (3, 14, 60))
    image = shade(base, smooth + speckle(rng, height, width, 0.02))
    for _ in range(max(2, height * width // 3000)):
        start = rng.uniform(0, [width, height])
        end = start + rng.normal(0, 9, 2)
        color = varied_color(rng, base, 0.8, 1.15)
        cv2.line(image, start.astype(int).tolist(), end.astype(int).tolist(), color, 1, AA)
    return to_image(image)


def rug(rng: Rng, height: int, width: int) -> Image:
    """A carpet: borders, a field of motifs, worn spots."""
    base = random_color(rng, 70, 140)
    other = random_color(rng, 150, 220)
    image = mottled(rng, height, width, base, 0.12, (2, 8, 40, 200))
    for inset, color in ((10, other), (22, random_color(rng)), (46, other)):
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), color, 5)
    for _ in range(170):
        x = int(rng.uniform(55, width - 55))
        y = int(rng.uniform(55, height - 55))
        size = int(rng.integers(4, 20))
        color = random_color(rng, 60, 230)
        if rng.random() < 0.5:
            diamond = np.array([x, y]) + size * np.array([[-1, 0], [0, -1], [1, 0], [0, 1]])
            cv2.fillPoly(image, [diamond.astype(np.int32)], color, AA)
        else:
            ellipse(image, (x, y), (size, size // 2), float(rng.uniform(0, 180)), color, 2)
    return finished(rng, image, 0.07)


# ---- Pictures ------------------------------------------------------------------------------------


def art_abstract(rng: Rng, image: npt.NDArray[Any]) -> None:
    """Overlapping shapes in a palette of five colours."""
    height, width = image.shape[:2]
    palette = [random_color(rng, 60, 240) for _ in range(5)]
    for _ in range(46):
        color = palette[int(rng.integers(5))]
        center = rng.uniform(0, 1, 2) * [width, height]
        points = center + rng.normal(0, 0.16 * width, (int(rng.integers(3, 6)), 2))
        if rng.random() < 0.5:
            cv2.fillPoly(image, [points.astype(np.int32)], color, AA)
        else:
            radius = int(rng.uniform(0.02, 0.16) * width)
            middle = points[0].astype(int).tolist()
            cv2.circle(image, middle, radius, color, int(rng.choice([-1, 2, 5])), AA)


def art_landscape(rng: Rng, image: npt.NDArray[Any]) -> None:
    """Sky, sun and rows of hills with trees."""
    height, width = image.shape[:2]
    top = np.asarray(random_color(rng, 120, 220))
    bottom = np.asarray(random_color(rng, 180, 250))
    ramp = np.linspace(0, 1, height)[:, None, None]
    image[:] = top * (1 - ramp) + bottom * ramp
    sun = (int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.12, 0.35) * height))
    cv2.circle(image, sun, width // 11, (170, 225, 250), -1, AA)
    for layer in range(5):
        hills = 0.09 * height * fractal_noise(rng, 2, width, (30, 120))[0]
        ridge = height * (0.36 + 0.13 * layer) + hills
        color = np.asarray(random_color(rng, 60, 150)) * (1 - 0.13 * layer)
        outline = np.stack([np.arange(width), ridge], 1).astype(np.int32)
        ground = np.concatenate([outline, [[width, height], [0, height]]])
        cv2.fillPoly(image, [ground], color.tolist(), AA)
        for x in rng.integers(0, width, 14).tolist():
            tip = (x, int(ridge[x] - rng.uniform(4, 22)))
            cv2.line(image, (x, int(ridge[x])), tip, (color * 0.6).tolist(), 3, AA)


def art_type(rng: Rng, image: npt.NDArray[Any]) -> None:
    """A concert bill: large letters, bands, small print."""
    height, width = image.shape[:2]
    for _ in range(4):
        y = int(rng.uniform(0, height))
        bar(image, 0, y, width, y + int(rng.uniform(8, 60)), random_color(rng))
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
    image = mottled(rng, height, width, random_color(rng, 150, 240), 0.1, (3, 20, 90))
    (art_abstract, art_landscape, art_type, art_photos)[style % 4](rng, image)
    grain = 1 + speckle(rng, height, width, 0.05)
    image *= (grain + 0.06 * fractal_noise(rng, height, width, (3, 9)))[..., None]
    edge = max(5, height // 40)
    color = (25, 30, 35) if rng.random() < 0.5 else (90, 130, 165)
    frame(image, 0, (235, 238, 240), 2 * edge)
    frame(image, 0, color, edge)
    return to_image(image)


def screen(rng: Rng, height: int, width: int) -> Image:
    """A desktop: background picture, an editor window, a chart."""
    image = np.zeros((height, width, 3), np.float32)
    art_landscape(rng, image)
    x = width // 14
    y = height // 10
    right = x + int(width * 0.5)
    bottom = y + int(height * 0.74)
    bar(image, x, y, right, bottom, (45, 38, 34))
    bar(image, x, y, right, y + 12, (110, 100, 92))
    for line in range(y + 22, bottom - 4, 9):
        start = x + 8 + int(rng.integers(0, 4)) * 12
        for _ in range(int(rng.integers(1, 5))):
            end = min(start + int(rng.integers(8, 46)), right - 6)
            cv2.line(image, (start, line), (end, line), random_color(rng, 130, 250), 3)
            start = end + 7
    x = int(width * 0.63)
    bar(image, x, int(height * 0.2), width - width // 20, int(height * 0.7), (240, 240, 240))
    for column in range(x + 6, x + 6 + 7 * 20, 20):
        top = int(height * 0.66 - rng.uniform(0.05, 0.4) * height)
        bar(image, column, top, column + 13, int(height * 0.66), random_color(rng))
    frame(image, 0, (22, 22, 22), max(8, width // 40))
    return to_image(image)


def keys(rng: Rng, height: int, width: int) -> Image:
    """A keyboard's top: five rows of keys with letters."""
    image = np.full((height, width, 3), 40.0, np.float32)
    step = max(6, height // 5)
    for y in range(2, height - step + 2, step):
        for x in range(2, width - step + 2, step):
            bar(image, x, y, x + step - 4, y + step - 4, [float(rng.uniform(175, 225))] * 3)
            letter = chr(65 + int(rng.integers(26)))
            stamp(image, letter, (x + 4, y + step - 8), 0.4, (30, 30, 30))
    return to_image(image)


def label(rng: Rng, height: int, width: int, base: Color, paper: Color) -> Image:
    """A printed label around a bottle, a can or a cup: twice, front and back."""
    image = plain(rng, height, width, base).astype(np.float32)
    top = int(0.2 * height)
    bottom = int(0.82 * height)
    bar(image, 0, top, width, bottom, paper)
    for half in (0, width // 2):
        center = (half + width // 4, (top + bottom) // 2)
        ellipse(image, center, (width // 7, (bottom - top) // 4), 0, random_color(rng))
        area = (half + 6, top, width // 2 - 12, bottom - top)
        write_words(rng, image, area, random_color(rng, 20, 110), height / 300)
    for y in (top, bottom):
        cv2.line(image, (0, y), (width, y), random_color(rng), max(2, height // 40))
    return finished(rng, image, 0.03)


def book_cover(rng: Rng, height: int, width: int) -> Image:
    """A book's front: colour, picture, title."""
    image = mottled(rng, height, width, random_color(rng, 60, 200), 0.08, (3, 20))
    picture = np.zeros((height // 2, int(width * 0.8), 3), np.float32)
    art_abstract(rng, picture)
    top = height // 3
    left = width // 10
    image[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    write_words(rng, image, (left, 2, width - width // 5, top), (240, 240, 240), width / 170)
    return to_image(image)


def book_row(rng: Rng, height: int, width: int) -> Image:
    """Spines side by side, as seen on a shelf."""
    image = np.full((height, width, 3), 22.0, np.float32)
    x = 0
    while x < width:
        right = x + int(rng.integers(7, 22))
        tall = int(rng.uniform(0.68, 0.98) * height)
        bar(image, x, height - tall, right - 2, height, random_color(rng, 40, 220))
        for _ in range(2):
            y = height - int(rng.uniform(0.1, 0.95) * tall)
            low = y + int(rng.integers(2, 9))
            bar(image, x, y, right - 2, low, random_color(rng, 80, 250))
        x = right
    return finished(rng, image, 0.05, 0.1, (2, 6, 20))


def panels(
    rng: Rng, height: int, width: int, base: Color, columns: int, rows: int, contrast: float = 0.16
) -> Image:
    """Cabinet or door front: bevelled wooden panels with knobs."""
    image = wood(rng, height, width, base, contrast).astype(np.float32)
    dark = [0.6 * c for c in base]
    light = [min(255, 1.25 * c) for c in base]
    for row in range(rows):
        for col in range(columns):
            x0 = col * width // columns
            x1 = (col + 1) * width // columns - 1
            y0 = row * height // rows
            y1 = (row + 1) * height // rows - 1
            cv2.rectangle(image, (x0, y0), (x1, y1), (20, 24, 28), 2)
            inset = min(x1 - x0, y1 - y0) // 8
            corner = (x1 - inset, y1 - inset)
            cv2.rectangle(image, (x0 + inset, y0 + inset), corner, dark, 3, AA)
            cv2.line(image, (x0 + inset, y1 - inset), corner, light, 2, AA)
            x = x1 - inset // 2 - 2
            y = (y0 + y1) // 2
            cv2.circle(image, (x, y), 5, (60, 66, 70), -1, AA)
            cv2.circle(image, (x - 1, y - 1), 2, (215, 220, 225), -1, AA)
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
    base = rng.uniform((30, 95, 40), (60, 150, 85)).tolist()
    image = mottled(rng, height, width, base, 0.18, (3, 10, 30))
    rib = [min(255.0, 1.5 * c) for c in base]
    middle = height // 2
    cv2.line(image, (0, middle), (width, middle), rib, 2, AA)
    for x in range(0, width, 12):
        for y in (2, height - 2):
            cv2.line(image, (x, middle), (x + 14, y), rib, 1, AA)
    return to_image(image)


def clock_face(rng: Rng, height: int, width: int) -> Image:
    """Dial with marks and hands."""
    image = plain(rng, height, width, (225, 232, 236)).astype(np.float32)
    center = (width // 2, height // 2)
    radius = min(height, width) // 2

    def at(angle: float, reach: float) -> list[int]:
        """Pixel at a distance, relative to the radius, in a direction from 12 o'clock."""
        ray = np.array([np.sin(angle), -np.cos(angle)])
        return (np.array(center) + ray * radius * reach).astype(int).tolist()  # type: ignore[no-any-return]

    cv2.circle(image, center, radius - 5, (35, 35, 40), 11, AA)
    for angle in np.arange(12) * np.pi / 6:
        cv2.line(image, at(angle, 0.68), at(angle, 0.82), (30, 30, 30), 4, AA)
    for angle, reach in zip(rng.uniform(0, 2 * np.pi, 2), (0.42, 0.6), strict=True):
        cv2.line(image, center, at(angle, reach), (20, 20, 120), 4, AA)
    return to_image(image)
