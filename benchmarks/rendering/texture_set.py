"""The textures of one room, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rendering.config import Image, Rng, RoomConfig, Size
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
    varied_color,
    wallpaper,
    window_view,
    wood,
)

WALLS = ("north", "south", "east", "west")
WHITE_WOOD = (205.0, 214.0, 218.0)
FLOOR = (78.0, 122.0, 165.0)
CEILING = (222.0, 228.0, 230.0)
OAK = (70.0, 115.0, 165.0)
WALNUT = (42.0, 68.0, 104.0)
WOODS = {  # by texture
    "chair_wood": OAK, "table_wood": WALNUT, "desk_wood": (150.0, 185.0, 210.0),
    "case_wood": WALNUT, "side_wood": OAK,
}  # fmt: skip
PLAINS = {  # colour and strength of the tones by texture
    "plastic": ((38, 36, 36), 0.05),
    "paper": ((190, 215, 225), 0.05),
    "glass": ((60, 85, 50), 0.14),
    "china": ((225, 230, 232), 0.05),
    "china_blue": ((190, 140, 90), 0.05),
    "alu": ((175, 172, 170), 0.05),
    "soil": ((28, 40, 62), 0.14),
    "cap": ((45, 45, 170), 0.05),
    "orange": ((35, 130, 235), 0.14),
    "bear": ((60, 105, 160), 0.14),
    "bear_snout": ((150, 190, 220), 0.05),
    "lamp": ((250, 252, 255), 0.05),
}


def varied_textures(rng: Rng, size: tuple[int, int, int]) -> dict[str, Image]:
    """Walls, floor, woods and cloths of another look; `size` in texels."""

    def tone(strong: float) -> list[float]:
        pale = rng.random() > strong
        return pale_color(rng) if pale else random_color(rng, 60, 200)

    def paint(
        height: int, width: int, kinds: Sequence[Callable[..., Image]], strong: float
    ) -> Image:
        return kinds[int(rng.integers(len(kinds)))](rng, height, width, tone(strong))

    w, d, h = size
    kinds = (plain, plaster, plaster, wallpaper, bricks, planks)
    textures = {
        f"wall_{side}": paint(h, length, kinds, 0.3)
        for side, length in zip(WALLS, (w, w, d, d), strict=True)
    }
    if rng.random() < 0.5:  # as most rooms: all walls the same
        textures["wall_north"] = textures["wall_south"]
        textures["wall_east"] = textures["wall_west"]
    textures["floor"] = paint(d, w, (planks, planks, plain, fabric, plaster, bricks), 0.6)
    for name in WOODS:
        textures[name] = paint(512, 512, (wood, wood, plain), 0.8)
    for name in ("chair_cloth", "couch", "couch_cushion", "pillow"):
        textures[name] = fabric(rng, 512, 512, tone(0.8), bool(rng.random() < 0.4))
    for name in ("plastic", "china", "alu", "glass", "cap"):
        textures[name] = plain(rng, 256, 256, tone(0.6))
    return textures


def pale_color(rng: Rng) -> list[float]:
    """Nearly grey, from dim to white: most walls."""
    color = np.clip(rng.uniform(90, 235) + rng.normal(0, 9, 3), 20, 248)
    return color.tolist()  # type: ignore[no-any-return]


def make_textures(rng: Rng, config: RoomConfig, size: Size) -> dict[str, Image]:
    """Draw every texture, at `texels_per_m` where a patch shows a piece of it."""
    w, d, h = (int(v * config.texels_per_m) for v in size)
    textures = wall_textures(rng, w, d, h)
    for name, color in WOODS.items():
        textures[name] = wood(rng, 512, 512, varied_color(rng, color, 0.85, 1.12))
    textures["white_wood"] = wood(rng, 512, 512, WHITE_WOOD, 0.05)
    for name, motif in (("chair_cloth", True), ("couch", False), ("pillow", True)):
        textures[name] = fabric(rng, 512, 512, random_color(rng, 90, 170), motif)
    cushion = textures["couch"].mean((0, 1)) * 1.12
    textures["couch_cushion"] = fabric(rng, 400, 400, cushion.tolist())
    for name, (shade, tone) in PLAINS.items():
        textures[name] = plain(rng, 256, 256, shade, tone)
    return textures | drawn_textures(rng)


def wall_textures(rng: Rng, w: int, d: int, h: int) -> dict[str, Image]:
    """Four different walls, floor, ceiling; sizes in texels."""
    warm = np.array([188, 208, 220]) + rng.uniform(-12, 12, 3)
    sage = np.array([158, 184, 174]) + rng.uniform(-12, 12, 3)
    clay = varied_color(rng, (85, 105, 160), 0.9, 1.15)
    blue = np.array([178, 168, 150]) + rng.uniform(-9, 9, 3)
    return {
        "wall_north": wallpaper(rng, h, w, sage.tolist()),
        "wall_south": plaster(rng, h, w, warm.tolist()),
        "wall_east": bricks(rng, h, d, clay),
        "wall_west": plaster(rng, h, d, blue.tolist(), 0.1),
        "floor": planks(rng, d, w, FLOOR),
        "ceiling": plaster(rng, d // 3, w // 3, CEILING, 0.03),
    }


def drawn_textures(rng: Rng) -> dict[str, Image]:
    """Pictures that are fitted to one patch each."""
    textures = {f"poster{i}": poster(rng, 320, 360, i + int(rng.integers(2))) for i in range(12)}
    textures |= {f"book{i}": book_cover(rng, 256, 180) for i in range(3)}
    textures |= {f"spines{i}": book_row(rng, 110, 420) for i in range(5)}
    textures |= {f"leaf{i}": leaf(rng, 64, 160) for i in range(3)}
    for i in range(2):
        paper = random_color(rng, 170, 240)
        textures[f"bottle{i}"] = label(rng, 160, 256, (50, 90, 60), paper)
    white = (225.0, 230.0, 232.0)
    textures |= {
        "cup": label(rng, 128, 256, white, white),
        "vase": fabric(rng, 256, 512, random_color(rng, 90, 190), True),
        "pot": fabric(rng, 256, 512, (70, 105, 175)),
        "screen": screen(rng, 256, 420),
        "screen2": screen(rng, 230, 340),
        "keys": keys(rng, 120, 360),
        "clock": clock_face(rng, 256, 256),
        "rug": rug(rng, 450, 690),
        "door": panels(rng, 612, 285, WHITE_WOOD, 1, 3, 0.04),
        "cabinet": panels(rng, 256, 448, (80, 125, 170), 4, 1),
        "window": window_view(rng, 400, 540),
        "ball": fabric(rng, 256, 512, random_color(rng, 150, 230), True),
    }
    hue = 0.35 * np.array(random_color(rng, 150, 200)) + 0.65 * np.array([190.0, 203, 210])
    return textures | {
        "curtain": fabric(rng, 512, 128, hue.tolist(), True),
        "carton": label(rng, 200, 256, (105, 150, 190), (125, 168, 205)),
        "shade": fabric(rng, 128, 256, (190, 220, 235)),
        "basket": fabric(rng, 128, 256, (90, 140, 180), True),
        "suitcase": panels(rng, 300, 220, random_color(rng, 90, 170), 1, 4, 0.05),
    }


def session_textures(rng: Rng, config: RoomConfig, size: Size) -> dict[str, Image]:
    """All textures of a room, with strong patterns on walls and floor."""
    small = (0.5, 0.5, 0.5)  # the walls of the first two sets are replaced
    textures = make_textures(rng, config, small) | varied_textures(rng, (150, 150, 150))
    w, d, h = (int(side * config.texels_per_m) for side in size)
    kinds = (plaster, wallpaper, bricks, planks)
    walls = zip(WALLS, (w, w, d, d), rng.permutation(4), strict=True)
    for side, length, kind in walls:
        textures[f"wall_{side}"] = kinds[kind](rng, h, length, pale_color(rng))
    floor = (planks, fabric, planks, bricks)[int(rng.integers(4))]
    textures["floor"] = floor(rng, d, w, FLOOR)
    textures["ceiling"] = plaster(rng, d // 3, w // 3, CEILING, 0.03)
    for name in ("case_wood", "side_wood"):
        textures[name] = wood(rng, 512, 512, (60.0, 100.0, 150.0))
    return textures
