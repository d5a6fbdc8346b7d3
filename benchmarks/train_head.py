#!/usr/bin/env python3
"""Train a head for a frozen backbone of `reobj_track.py`, such as MobileNetV2's ImageNet weights.

    python benchmarks/train_head.py -o OUT --backbone mobilenetv2_feat --rooms 1008:1193 ...

writes OUT/mobilenetv2_feat_head.onnx (two vectors an object from the cells of one pass over the
frame) or, with --crops, OUT/SETUP/crops_mobilenetv2_feat_head.onnx (re-OBJ's ConvBlock on two
masked crops an object), with checkpoints and log. Use them with `--embed mobilenetv2_feat`
or `--embed crops`, and `--set embed.head=FILE`. Sources, augmentation, loss and validation are
those of `train_embedding.py`. The backbone's features of every scene are computed once and cached.
As published, the maps of foreground and background are concatenated and merged by one ConvBlock;
--merge rows gives each crop a block of its own and concatenates the two embeddings, as in the
bundled weights. `reobj_folds.py` trains and tests re-OBJ's setups on one recording.
Ref: Bansal et al., re-OBJ, ICIAP 2019 (ConvBlock).
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]
import train_embedding as te  # noqa: E402  (first: it says so if there is no PyTorch)

# isort: split
import torch  # noqa: E402
from torch import nn  # noqa: E402
from torch.nn import functional as F  # noqa: E402

import reobj_track as rt  # noqa: E402
from reobj.files import atomic  # noqa: E402
from reobj.types import Image, IntArray  # noqa: E402

FROZEN_WH = (640, 480)  # of a picture for a frozen backbone
FROZEN: dict[str, Any] = {
    "size_px": 384, "context": 0.5, "min_margin": 0.05, "samples": 4, "foreground_cells": 3,
    "background_cells": 4, "surround_scale": 1.5, "surround_min_margin": 0.2,
    "surround_cells": 4,
}  # fmt: skip
CROPS: dict[str, Any] = {"context": 0.5, "min_margin": 0.05, "crop_px": 224}
CROP_SETUPS = {"concat": ("fg", "bg"), "fg": ("fg",), "bg": ("bg",), "full": ("full",)}


@dataclass(frozen=True, slots=True)
class Seen:
    """What a frozen backbone shows of the N objects of one augmented scene.

    Attributes:
        parts: (N, ...) float16 of each part: cells of the frame's map, or maps of crops.
        identity, look, frame: (N,).
    """

    parts: dict[str, npt.NDArray[np.float16]]
    identity: IntArray
    look: IntArray
    frame: IntArray

    def views(self, rng: np.random.Generator, count: int) -> Seen:
        """The rows of so many random frames; maps (N, C, h, w) in a mirror half of the time."""
        rows = np.isin(self.frame, rng.permutation(np.unique(self.frame))[:count])
        turn = rng.choice((1, -1))
        parts = {k: p[rows][..., ::turn] if p.ndim == 4 else p[rows] for k, p in self.parts.items()}
        return Seen(parts, self.identity[rows], self.look[rows], self.frame[rows])


Source = tuple[str, Callable[[], te.Clip]]  # name of a clip, and how to read it


class Frozen:
    """A frozen backbone: what its heads are fed with, cached on disk."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.crops, self.cache = args, bool(args.crops), args.cache / "seen"
        self.layout: dict[str, Any] = CROPS if self.crops else FROZEN
        layout = rt.SamplingLayout(**self.layout)
        kind = rt.CropEmbedder if self.crops else rt.Embedder
        self.embedder = kind(args.backbone, "none", layout, threads=args.threads)
        self.name = f"{'crops' if self.crops else 'frame'}_{Path(args.backbone).stem}"
        self.cache.mkdir(parents=True, exist_ok=True)

    def see(self, picture: Image, found: rt.Detections, rows: IntArray) -> dict[str, Any]:
        """The inputs of the heads for the chosen rows (N,)."""
        if isinstance(self.embedder, rt.CropEmbedder):
            crops, own = self.embedder.cut(picture, found, rows)
            three = np.concatenate([self.embedder.masked(crops, own), crops])
            parts = np.split(self.embedder.maps(three), 3)
            return dict(zip(("fg", "bg", "full"), parts, strict=True))
        fore, back = self.embedder.cells(picture, found, rows)
        return {"fg": fore.reshape(len(rows), -1), "bg": back.reshape(len(rows), -1)}

    def scene(self, source: Source, copy: int, parts: Sequence[str]) -> Seen:
        """Some frames of a clip, cached; copy 0 as they are, others augmented."""
        name, load = source
        path = self.cache / f"{self.name}_{name.replace('/', '_')}_{copy}.npz"
        if not path.exists():
            self.keep(path, load(), copy)
        with np.load(path) as data:
            return Seen({n: data[n] for n in parts}, data["identity"], data["look"], data["frame"])

    def keep(self, path: Path, clip: te.Clip, copy: int) -> None:
        """Augment, look, write. Odd copies have masks, even ones ellipses, as a video has."""
        rng = np.random.default_rng([copy, len(clip.images), sum(map(len, clip.identity))])
        tone, flip = (te.photo_tone(rng, 1.0) if copy else None), bool(copy and rng.random() < 0.5)
        everything, found_rows = np.unique(np.concatenate(clip.identity)), []
        count = min(self.args.seen, len(clip.images))
        shift = rng.uniform(0, 1) if copy else 0.5
        for frame in ((np.arange(count) + shift) * len(clip.images) / count).astype(int):
            picture, found, rows = te.augmented(
                clip, frame, rng, tone, flip, everything, FROZEN_WH, masked=copy % 2
            )
            rows = rng.permutation(rows)[:24]
            if len(rows):
                parts = {k: v.astype(np.float16) for k, v in self.see(picture, found, rows).items()}
                parts |= {"identity": clip.identity[frame][rows], "look": clip.look[frame][rows]}
                parts["frame"] = np.full(len(rows), frame)
                found_rows.append(parts)
        table: dict[str, Any] = {
            k: np.concatenate([r[k] for r in found_rows]) for k in found_rows[0]
        }
        with atomic(path) as part, part.open("wb") as file:
            np.savez(file, **table)


class CellHead(nn.Module):
    """Cells (N, cells * (C + 2)) of grids of a frozen map to unit rows (N, te.WIDTH).

    As `PartHead`: a linear map of the training-free descriptor (square roots, part-empty cells
    count less; starts as principal components) plus a perceptron; features are first narrowed.
    """

    def __init__(self, grids: Sequence[int], channels: int, narrow: int = 32) -> None:
        super().__init__()
        self.grids, self.cells, self.channels = grids, sum(n * n for n in grids), channels
        self.narrow = nn.Linear(channels, narrow, bias=False)
        self.project = nn.Linear(self.cells * narrow, te.WIDTH, bias=False)
        self.word = nn.Sequential(nn.Linear(narrow + 2, 48), nn.ReLU())
        rows = sum(grids) * 48
        self.mix = nn.Sequential(
            nn.Linear(self.cells * (narrow + 2) + rows, 128, bias=False), nn.BatchNorm1d(128),
            nn.ReLU(), nn.Linear(128, te.WIDTH),
        )  # fmt: skip
        nn.init.zeros_(self.mix[-1].weight)
        nn.init.zeros_(self.mix[-1].bias)

    def split(self, rows: Any) -> tuple[Any, Any]:
        """Unit features (N, cells, narrow) by part-empty cells, and the shares (N, cells, 2)."""
        cells = rows.reshape(-1, self.cells, self.channels + 2)
        share = cells[..., self.channels :]
        trust = [s / s.amax(1, keepdim=True).clamp_min(1e-6)
                 for s in share[..., :1].split([n * n for n in self.grids], 1)]  # fmt: skip
        roots = (cells[..., : self.channels].relu() * torch.cat(trust, 1) + 1e-9).sqrt()
        scale = roots.square().sum((1, 2), keepdim=True).clamp_min(1e-6).rsqrt()
        return self.narrow(roots * scale), share

    def forward(self, rows: Any) -> Any:
        plain, share = self.split(rows)
        seen = torch.cat([plain * 6.0, share], -1)
        if self.training:  # some cells are masked
            seen = seen * (torch.rand_like(seen[..., :1]) > 0.1)
        words, lines = self.word(seen), []
        for part, n in zip(words.split([n * n for n in self.grids], 1), self.grids, strict=True):
            lines.append(part.reshape(-1, n, n, 48).mean(2).flatten(1))  # left and right forgotten
        mixed = self.mix(torch.cat([seen.flatten(1), *lines], 1))
        return F.normalize(self.project(plain.flatten(1)) + mixed, dim=1)

    def start(self, rows: Any) -> None:
        """Begin with the principal components of features, then of cells side by side."""
        with torch.no_grad():
            wide, self.narrow = self.narrow, nn.Identity()
            te.principal(wide.weight, self.split(rows)[0].flatten(0, 1))
            self.narrow = wide
            te.principal(self.project.weight, self.split(rows)[0].flatten(1))


class ConvBlock(nn.Module):
    """re-OBJ: the maps (N, C, n, n) of one crop, or of two concatenated in C, to unit rows.

    Convolution 3x3, batch norm, ReLU and max-pooling by two, until one cell is left: 7, 4, 2, 1.
    Ref: Bansal et al., ICIAP 2019; widths as in ut-amrl/CLOVER: of 2 x 512 channels 1024, 2048,
    4096, here `width` and its multiples by 2 (0: C, as published).
    """

    def __init__(self, channels: int, side: int, width: int = 0) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels, affine=False)
        stages, inner, width = list[Any](), channels, width or channels
        while side > 1 or not stages:
            pool = nn.MaxPool2d(2, 2, padding=side % 2) if side > 1 else nn.Identity()
            stages.append(nn.Sequential(te.block(inner, width), pool))
            inner, width, side = width, 2 * width, (side + 1) // 2
        self.stages = nn.Sequential(*stages)

    def forward(self, maps: Any) -> Any:
        return F.normalize(self.stages(self.norm(maps)).flatten(1), dim=1)

    def start(self, maps: Any) -> None:
        """Take over mean and deviation of every channel."""
        self.norm.running_mean[:] = maps.mean((0, 2, 3))
        self.norm.running_var[:] = maps.var((0, 2, 3))


class CropBlock(nn.Module):
    """Maps (N, C, n, n) of one crop to unit rows; two crops have one each, their rows make one.

    re-OBJ style, not as published: better by 3 points of Rank-1 on the validation rooms than a
    block in common, and the bundled one (benchmarks/RESULTS.md).
    """

    def __init__(self, channels: int, side: int, width: int, inner: int = 64) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels, affine=False)
        self.squeeze = te.block(channels, inner, 1)
        self.mix = nn.Sequential(te.block(inner, inner), te.block(inner, 64, 3, 2), nn.Dropout(0.2))
        self.out = nn.Linear(64 * ((side + 1) // 2) ** 2, width)
        self.short = nn.Conv2d(channels, 20, 1, bias=False)
        self.project = nn.Linear(20 * side**2, width, bias=False)

    def forward(self, maps: Any) -> Any:
        maps = self.norm(maps)
        if self.training:  # some channels, and some positions of all of them, are masked
            maps = F.dropout2d(maps, 0.1) * (torch.rand_like(maps[:, :1]) > 0.1)
        deep = self.out(self.mix(self.squeeze(maps)).flatten(1))
        return F.normalize(deep + self.project(self.short(maps).flatten(1)), dim=1)

    def start(self, maps: Any) -> None:
        """Begin with the principal components of features, then of adjacent positions."""
        self.norm.running_mean[:] = maps.mean((0, 2, 3))
        self.norm.running_var[:] = maps.var((0, 2, 3))
        maps = self.norm(maps)
        te.principal(self.short.weight[..., 0, 0], maps.movedim(1, 3).flatten(0, 2))
        self.short.weight /= 20
        te.principal(self.project.weight, self.short(maps).flatten(1))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)


def room_sources(args: argparse.Namespace, rooms: str, fine: bool = False) -> list[Source]:
    """Rooms A:B, those of the cache if no others shall be rendered. fine: half as many views."""
    frames = args.frames // 2 if fine else args.frames
    load = functools.partial(te.room_clip, cache=args.cache, frames=frames, fine=fine)
    paths = {s: te.room_path(s, args.cache, fine) for s in te.parse_range(rooms or "0:0")}
    return [(path.stem.replace("_", " "), functools.partial(load, seed))
            for seed, path in paths.items() if not args.no_render or path.exists()]  # fmt: skip


def sources(args: argparse.Namespace) -> list[Source]:
    """Names of all training clips, and how to read them."""
    found = room_sources(args, args.rooms) + room_sources(args, args.fine_rooms, True)
    for kind, given in ((te.sparse_clip, args.sparse), (te.tracks_clip, args.tracks)):
        found += [(f"{a.parent.name}/{a.name}", functools.partial(kind, a, b)) for a, b in given]
    return found


class SeenPool:
    """Scenes as a frozen backbone sees them, each augmented once or more."""

    def __init__(self, args: argparse.Namespace, frozen: Frozen, names: Sequence[str]) -> None:
        self.args, self.rooms = args, []
        for source in sources(args):
            for copy in range(1, args.copies + 1):
                self.rooms.append(frozen.scene(source, copy, names))
        if not self.rooms:
            raise SystemExit("error: nothing to train on: give --rooms, --sparse or --tracks")

    def fill(self) -> None:
        """Everything is here from the start."""

    def draw(self, rng: np.random.Generator) -> list[Seen]:
        """Some views of some scenes."""
        return [
            self.rooms[i].views(rng, self.args.views)
            for i in rng.choice(len(self.rooms), min(self.args.scenes, len(self.rooms)), False)
        ]


class HeadTrainer(te.Trainer):
    """Trains heads on what a frozen backbone shows: of cells, or ConvBlocks of crops."""

    def __init__(self, args: argparse.Namespace, frozen: Frozen, names: Sequence[str]) -> None:
        self.frozen, self.names = frozen, names
        super().__init__(args)

    def make_pool(self) -> Any:
        return SeenPool(self.args, self.frozen, self.names)

    def make_net(self) -> Any:
        shapes = [self.pool.rooms[0].parts[n].shape[1:] for n in self.names]
        if self.frozen.crops and self.args.merge == "maps":
            channels = sum(shape[0] for shape in shapes)
            return nn.ModuleList([ConvBlock(channels, shapes[0][-1], self.args.width)])
        if self.frozen.crops:
            return nn.ModuleList(CropBlock(c, n, 192 // len(shapes)) for c, n, _ in shapes)
        fore, *back = (FROZEN[f"{k}_cells"] for k in ("foreground", "background", "surround"))
        channels = shapes[0][0] // int(fore) ** 2 - 2
        return nn.ModuleList([CellHead([int(fore)], channels),
                              CellHead([int(n) for n in back], channels)])  # fmt: skip

    def make_val(self) -> dict[str, Any]:
        rooms = room_sources(self.args, self.args.val_rooms)
        real = [(f"{a.parent.name}/{a.name}", functools.partial(te.sparse_clip, a, b))
                for a, b in self.args.val_sparse]  # fmt: skip
        return {
            name: [self.frozen.scene(source, 0, self.names) for source in found]
            for name, found in (("room", rooms), ("real", real))
        }

    def start(self) -> None:
        """Start from the principal components of the training-free descriptors."""
        rng = np.random.default_rng([self.args.seed, 10])
        scenes = [scene for _ in range(5) for scene in self.pool.draw(rng)]
        self.net.eval()
        with torch.no_grad():
            for head, rows in zip(self.net, self.inputs(scenes), strict=True):
                head.start(rows)
        self.net.train()

    def inputs(self, scenes: Sequence[Seen]) -> list[Any]:
        """What each head takes of all objects of the scenes."""
        parts = [torch.from_numpy(np.concatenate([s.parts[n] for s in scenes])).float()
                 for n in self.names]  # fmt: skip
        one = self.frozen.crops and self.args.merge == "maps"
        return [torch.cat(parts, 1)] if one else parts

    def embed(self, net: Any, scenes: Sequence[Seen]) -> list[Any]:
        """Unit rows of each part by these heads."""
        parts = self.inputs(scenes)
        return [head(part.to(self.device)) for head, part in zip(net, parts, strict=True)]

    def loss(self, scenes: Any, late: bool) -> Any:
        parts = self.embed(self.net, scenes)
        scene = np.repeat(np.arange(len(scenes)), [len(s.identity) for s in scenes])
        identity = np.concatenate([s.identity for s in scenes])
        frame = np.concatenate([s.frame for s in scenes])
        return te.parts_loss(parts, (scene, identity, frame), late)

    def score(self, clips: Sequence[Seen]) -> dict[str, float]:
        net = self.taken().eval()
        with torch.no_grad():
            done = [[p.cpu().numpy() for p in self.embed(net, [clip])] for clip in clips]
        net.train()
        return te.mean_hits([(parts, c.frame, c.identity, c.look)
                          for parts, c in zip(done, clips, strict=True)])  # fmt: skip


def train_heads(args: argparse.Namespace) -> None:
    """Train and export the heads of a frozen backbone."""
    frozen, out = Frozen(args), args.out
    setups = CROP_SETUPS if args.crops else {"": ("fg", "bg")}
    for setup in args.setups if args.crops else setups:
        args.out = out / setup
        trainer = HeadTrainer(args, frozen, setups[setup])
        trainer.run()
        trainer.take_best()
        export_head(trainer, args.out)


def export_head(trainer: HeadTrainer, out: Path) -> None:
    """Write OUT/[crops_]BACKBONE_head.onnx, large weights as float16."""
    import onnx

    fed = tuple(part[:2] for part in trainer.inputs(trainer.pool.rooms[:1]))
    net, crops = trainer.taken().cpu().eval(), trainer.frozen.crops
    path = out / f"{'crops_' if crops else ''}{Path(trainer.args.backbone).stem}_head.onnx"
    if crops:
        whole = Heads(net, fed[0].shape[1])
        te.to_onnx(whole, (torch.cat(fed, 1),), path, ["maps"], ["row"])
    else:
        te.to_onnx(Heads(net), fed, path, ["fg", "bg"], ["foreground", "background"])
    file = halved(onnx.load(path))
    facts = {"layout": trainer.frozen.layout, "trained": trainer.summary()}
    onnx.helper.set_model_props(file, {"reobj": json.dumps(facts)})
    onnx.save(file, path)
    print(f"{path}: use it with --set embed.head={path}")


class Heads(nn.Module):
    """All heads in one graph, each with its own input; of crops: stacked maps (N, n * C, 7, 7) to
    one unit row. channels: C of crops, else 0.
    """

    def __init__(self, heads: Any, channels: int = 0) -> None:
        super().__init__()
        self.heads, self.channels = heads, channels

    def forward(self, *parts: Any) -> Any:
        fed = parts[0].split(self.channels, 1) if self.channels else parts
        rows = tuple(head(part) for head, part in zip(self.heads, fed, strict=True))
        return torch.cat(rows, 1) * len(rows) ** -0.5 if self.channels else rows


def halved(model: Any) -> Any:
    """Keep large weights as float16 with a cast behind them: half the file."""
    import onnx

    casts = []
    for weight in model.graph.initializer:
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype == np.float32 and values.size > 2000:
            name = weight.name
            weight.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), name + "_half"))
            casts.append(onnx.helper.make_node("Cast", [name + "_half"], [name], to=1))
    for node in reversed(casts):
        model.graph.node.insert(0, node)
    return model


# ---- Command line --------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """Options."""
    parser = te.common_options(__doc__)
    add: Callable[..., Any] = parser.add_argument
    add("--backbone", required=True, help="name or ONNX file of the frozen backbone")
    add("--crops", action="store_true", help="for two crops an object (re-OBJ's ConvBlock)")
    add("--setups", nargs="*", default=["concat"], choices=CROP_SETUPS, help="setups of --crops")
    add("--merge", choices=("maps", "rows"), default="maps",
        help="of two crops: their maps, by one ConvBlock, or the rows of a block each")  # fmt: skip
    add("--width", type=int, default=64,
        help="channels of the ConvBlock's first stage (0: of its maps, as published)")  # fmt: skip
    add("--copies", type=int, default=1, help="augmented copies of each scene")
    add("--seen", type=int, default=20, help="frames of each scene")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Train and export."""
    train_heads(te.parsed(build_parser(), argv))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
