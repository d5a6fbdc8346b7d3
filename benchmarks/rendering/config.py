"""Options of the renderer, shared types and constants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Rng = np.random.Generator
Color = Sequence[float]  # B, G, R in 0..255
Size = tuple[float, float, float]  # width, depth, height in m
Rect = tuple[int, int, int, int]  # x, y, w, h in the atlas, texels


NEAR_M = 0.05  # nothing closer to the camera plane is drawn


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


PATHS = {
    "revisit": "leaves its first view and comes back",
    "walk": "round the room without coming back",
    "orbit": "a quarter round the dining table",
    "tour": "twice past every table and couch, another way for every seed",
    "table": "photos STEP_M apart, taken standing still, once round a table, weaving up and down",
    "turn": "a walk that stops for two fifths of the frames, where the camera only turns",
    "spot": "twice round on one free spot, see --sway",
    "corridor": "straight on along x, looking to one side",
}
PLANS = {
    "home": "the plan of examples/room",
    "later": "the same room when objects have moved, gone and come, as in examples/room_later",
    "varied": "another room for every seed",
    "corridor": "CORRIDOR_ROOMS rooms of the home plan in a row that look the same",
}


@dataclass(frozen=True, slots=True)
class RoomConfig:
    """Everything that decides a clip."""

    seed: int = 0
    width: int = 640  # px
    height: int = 480  # px
    frames: int = 240
    fps: float = 12.0
    hfov_deg: float = 66.0  # a phone's main camera in video mode
    room_m: Size = (6.6, 5.4, 2.6)  # width, depth, height before jitter
    room_jitter: float = 0.06  # relative, uniform
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
