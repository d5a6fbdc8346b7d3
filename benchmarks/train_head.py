#!/usr/bin/env python3
"""Train a head for a frozen backbone of `reobj_track.py`, such as MobileNetV2's ImageNet weights.

    python benchmarks/train_head.py -o OUT --backbone mobilenetv2_feat --rooms 1008:1193 ...

writes OUT/mobilenetv2_feat_head.onnx (two vectors an object from the cells of one pass over the
frame) or, with --crops, OUT/crops_mobilenetv2_feat_head.onnx (re-OBJ style: a block for each of two
masked crops of an object, whose embeddings are concatenated), with checkpoints and log. Use them
with `--embed mobilenetv2_feat` or `--embed crops`, and `--set embed.head=FILE`. Sources,
augmentation, loss and validation are those of `train_embedding.py`. The backbone's features of
every scene are computed once and cached.
Ref: Bansal et al., re-OBJ, ICIAP 2019 (there one block for the maps of both crops, which is worse
by 3 points of Rank-1 on the validation rooms).
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

COPIES = 1  # augmented, of each scene
SEEN_FRAMES = 20  # of each scene
SEEN_OBJECTS = 24  # of each frame
FROZEN_WH = (640, 480)  # of a picture for a frozen backbone
FROZEN: dict[str, Any] = {
    "size_px": 384, "context": 0.5, "min_margin": 0.05, "samples": 4, "foreground_cells": 3,
    "background_cells": 4, "surround_scale": 1.5, "surround_min_margin": 0.2,
    "surround_cells": 4,
}  # fmt: skip
CROPS: dict[str, Any] = {"context": 0.5, "min_margin": 0.05, "crop_px": 224}
PARTS = ("fg", "bg")


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
        self.cache = args.cache / "seen"
        self.layout: dict[str, Any] = CROPS if args.crops else FROZEN
        layout = rt.SamplingLayout(**self.layout)
        kind = rt.CropEmbedder if args.crops else rt.Embedder
        self.embedder = kind(args.backbone, "none", layout, threads=1)
        self.name = f"{'crops' if args.crops else 'frame'}_{Path(args.backbone).stem}"
        self.cache.mkdir(parents=True, exist_ok=True)

    def see(self, picture: Image, found: rt.Detections, rows: IntArray) -> Sequence[Any]:
        """The inputs of the heads, by part, for some rows (N,)."""
        if isinstance(self.embedder, rt.CropEmbedder):
            crops, own = self.embedder.cut(picture, found, rows)
            return np.split(self.embedder.maps(self.embedder.masked(crops, own)), 2)
        return [cells.reshape(len(rows), -1) for cells in self.embedder.cells(picture, found, rows)]

    def scene(self, source: Source, copy: int) -> Seen:
        """Some frames of a clip, cached; copy 0 as they are, others augmented."""
        name, load = source
        path = self.cache / f"{self.name}_{name.replace('/', '_')}_{copy}.npz"
        if not path.exists():
            self.keep(path, load(), copy)
        with np.load(path) as data:
            return Seen({n: data[n] for n in PARTS}, data["identity"], data["look"], data["frame"])

    def keep(self, path: Path, clip: te.Clip, copy: int) -> None:
        """Augment, look, write. Odd copies have masks, even ones ellipses, as a video has."""
        rng = np.random.default_rng([copy, len(clip.images), sum(map(len, clip.identity))])
        tone, flip = (te.photo_tone(rng, 1.0) if copy else None), bool(copy and rng.random() < 0.5)
        everything = np.unique(np.concatenate(clip.identity))
        seen = []
        count = min(SEEN_FRAMES, len(clip.images))
        shift = rng.uniform(0, 1) if copy else 0.5
        for frame in ((np.arange(count) + shift) * len(clip.images) / count).astype(int):
            picture, found, rows = te.augmented(
                clip, frame, rng, tone, flip, everything, FROZEN_WH, masked=copy % 2
            )
            rows = rng.permutation(rows)[:SEEN_OBJECTS]
            if len(rows):
                parts = [part.astype(np.float16) for part in self.see(picture, found, rows)]
                look = clip.look[frame][rows]
                seen.append([*parts, clip.identity[frame][rows], look, np.full(len(rows), frame)])
        columns = [np.concatenate(column) for column in zip(*seen, strict=True)]
        names = (*PARTS, "identity", "look", "frame")
        table: dict[str, Any] = dict(zip(names, columns, strict=True))
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


class CropBlock(nn.Module):
    """Maps (N, C, n, n) of one crop to unit rows."""

    def __init__(self, channels: int, side: int, width: int = 96, inner: int = 64) -> None:
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


def sources(rooms: Sequence[int], args: argparse.Namespace, *given: Any) -> list[Source]:
    """Names of clips, and how to read them.

    Args:
        rooms: seeds. given: pairs of a reader and the paths that it takes.
    """
    found: list[Source] = [
        (f"room {seed}", functools.partial(te.room_clip, seed, args.cache)) for seed in rooms
    ]
    for read, pairs in given:
        found += [(f"{a.parent.name}/{a.name}", functools.partial(read, a, b)) for a, b in pairs]
    return found


class SeenPool:
    """Scenes as a frozen backbone sees them, each augmented once or more."""

    def __init__(self, args: argparse.Namespace, frozen: Frozen) -> None:
        given = ((te.sparse_clip, args.sparse), (te.tracks_clip, args.tracks))
        copies = range(1, COPIES + 1)
        self.rooms = [
            frozen.scene(s, copy) for s in sources(args.rooms, args, *given) for copy in copies
        ]
        if not self.rooms:
            raise SystemExit("error: nothing to train on: give --rooms, --sparse or --tracks")

    def draw(self, rng: np.random.Generator) -> list[Seen]:
        """Some views of some scenes."""
        rows = rng.choice(len(self.rooms), min(te.SCENES, len(self.rooms)), False)
        return [self.rooms[i].views(rng, te.VIEWS) for i in rows]


class HeadTrainer(te.Trainer):
    """Trains heads on what a frozen backbone shows: of cells, or blocks of crops."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.frozen = Frozen(args)
        super().__init__(args)

    def make_pool(self) -> Any:
        return SeenPool(self.args, self.frozen)

    def make_net(self) -> Any:
        shapes = [self.pool.rooms[0].parts[n].shape[1:] for n in PARTS]
        if self.args.crops:
            return nn.ModuleList(CropBlock(c, n) for c, n, _ in shapes)
        fore, *back = (FROZEN[f"{k}_cells"] for k in ("foreground", "background", "surround"))
        channels = shapes[0][0] // fore**2 - 2
        return nn.ModuleList([CellHead([fore], channels), CellHead(back, channels)])

    def make_val(self) -> dict[str, Any]:
        args = self.args
        found = {
            "room": sources(args.val_rooms, args),
            "real": sources((), args, (te.sparse_clip, args.val_sparse)),
        }
        return {name: [self.frozen.scene(s, 0) for s in of] for name, of in found.items()}

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
        return [
            torch.from_numpy(np.concatenate([s.parts[n] for s in scenes])).float() for n in PARTS
        ]

    def embed(self, scenes: Sequence[Seen]) -> list[Any]:
        """Unit rows of each part."""
        parts = zip(self.net, self.inputs(scenes), strict=True)
        return [head(part.to(self.device)) for head, part in parts]

    def loss(self, scenes: Any) -> Any:
        scene = np.repeat(np.arange(len(scenes)), [len(s.identity) for s in scenes])
        identity, frame = (
            np.concatenate([getattr(s, name) for s in scenes]) for name in ("identity", "frame")
        )
        return te.parts_loss(self.embed(scenes), scene, identity, frame)

    def score(self, clips: Sequence[Seen]) -> dict[str, float]:
        self.net.eval()
        with torch.no_grad():
            done = [[p.cpu().numpy() for p in self.embed([clip])] for clip in clips]
        self.net.train()
        return te.mean_hits([(parts, c.frame, c.identity, c.look)
                          for parts, c in zip(done, clips, strict=True)])  # fmt: skip

    def export(self) -> None:
        """Write OUT/[crops_]BACKBONE_head.onnx, large weights as float16."""
        import onnx

        fed = tuple(part[:2] for part in self.inputs(self.pool.rooms[:1]))
        net = self.net.cpu().eval()
        args = self.args
        name = f"{'crops_' if args.crops else ''}{Path(args.backbone).stem}_head.onnx"
        path = args.out / name
        if args.crops:
            whole = Heads(net, fed[0].shape[1])
            te.to_onnx(whole, (torch.cat(fed, 1),), path, ["maps"], ["row"])
        else:
            te.to_onnx(Heads(net), fed, path, list(PARTS), ["foreground", "background"])
        file = halved(onnx.load(path))
        facts = {"layout": self.frozen.layout, "trained": self.summary()}
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


def main(argv: Sequence[str] | None = None) -> int:
    """Train and export."""
    parser = te.common_options(__doc__)
    parser.add_argument("--backbone", required=True, help="name or ONNX file of the backbone")
    parser.add_argument("--crops", action="store_true", help="for two crops an object (re-OBJ)")
    trainer = HeadTrainer(te.parsed(parser, argv))
    trainer.run()
    trainer.export()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
