"""The textures of one room, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rendering.config import Color, Image, Rng, RoomConfig
from rendering.textures import (
    book_cover,
    book_row,
    bricks,
    clock_face,
    fabric,
    keys,
    label,
    leaf,
    panels,
    plain,
    planks,
    plaster,
    poster,
    random_color,
    rug,
    screen,
    wallpaper,
    window_view,
    wood,
)


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
    if rng.random() < 0.5:  # as most rooms: all walls the same
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


def make_textures(
    rng: Rng, config: RoomConfig, size: tuple[float, float, float]
) -> dict[str, Image]:
    """Draw every texture, at `texels_per_m` where a patch shows a piece of it."""
    scale = config.texels_per_m
    w, d, h = (int(v * scale) for v in size)
    textures = wall_textures(rng, (w, d, h))
    oak = (70.0, 115.0, 165.0)
    walnut = (42.0, 68.0, 104.0)
    pale = (150.0, 185.0, 210.0)
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
