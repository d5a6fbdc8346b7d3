#!/usr/bin/env python3
"""Train and test re-OBJ's four setups on one recording, in three folds of its objects.

    python benchmarks/reobj_folds.py redkitchen_7scenes --backbone resnet50v2_gluon_s3.onnx \\
        --choosing -o OUT

prints Rank-1, 5, 10, 20 of full, fg, bg and concat, untrained and trained, and writes them with
their settings to OUT/reobj_folds.md and .csv. Needs `pip install torch onnx`; minutes on one core.
Without --choosing only recordings for reporting (splits.json) are accepted.

Every annotated view of an object gives three crops (object, surroundings, both); a frozen backbone
computes a feature map of each. A ConvBlock (for concat one for both concatenated maps) computes the
embedding; the four setups are trained alike with a triplet loss. Three folds: the objects of a
fold, assigned class by class, are the queries for blocks trained on the others. The gallery is all
views of all objects in frames further away than --away (open protocol of rank_k.py). "not trained"
compares the maps themselves (signed square roots, cosine; concat: the mean of both).

The published maps have 7x7x512. The last tensor of this size in the ONNX file is used (ResNet18,
ResNet34, ResNet50: inside the last block), else the last one with 512 channels, else the file's
spatial output, with a crop size that gives 7x7 cells. The choice is printed. Differences from the
paper: the size of the ConvBlock (--width 0 for the published one), ellipses where masks are
missing, crops whose masked area is grey with a soft edge, unit embeddings and a soft margin in the
loss, objects of one room instead of many scenes.
Ref: Bansal et al., re-OBJ, ICIAP 2019; Hermans et al., 2017 (hardest negatives, soft margin).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]
import train_embedding as te  # noqa: E402  (first: it says so if there is no PyTorch)

# isort: split
import torch  # noqa: E402
from rank_k import Pairs, hit, pairs_of, rank_queries, write_csv  # noqa: E402
from reid_scenes import Scene, recording_scene  # noqa: E402
from splits import add_choosing, marked, split_name, usable  # noqa: E402
from synthetic_quadrics import table  # noqa: E402
from train_head import CROP_SETUPS, ConvBlock  # noqa: E402

import reobj_track as rt  # noqa: E402
from reobj.appearance.crops import flat_maps  # noqa: E402
from reobj.files import atomic  # noqa: E402
from reobj.types import IntArray  # noqa: E402

SIDE, CHANNELS = 7, 512  # of the published maps
CROP_PX = 224  # of ImageNet's networks
RANKS = (1, 5, 10, 20)
VIEWS = 6  # of an object in a batch (chosen: several positives each, half a second a step)
Maps = dict[str, npt.NDArray[np.float32]]  # (N, C, n, n) of each crop: fg, bg, full


def published_map(path: Path, out: Path) -> tuple[Path, str]:
    """Cut a network behind its last tensor of 7x7x512, else of 512 channels; say what was taken."""
    import onnx

    model = onnx.load(path)
    shape = model.graph.input[0].type.tensor_type.shape.dim
    for dim, size in zip(shape, (1, 3, CROP_PX, CROP_PX), strict=True):
        dim.dim_value = size
    for one in model.graph.output:  # as large as the exporter said; inferred anew
        one.type.tensor_type.ClearField("shape")
    inferred = onnx.shape_inference.infer_shapes(model).graph
    sizes = {v.name: tuple(d.dim_value for d in v.type.tensor_type.shape.dim)[1:]
             for v in [*inferred.value_info, *inferred.output]}  # fmt: skip
    known = [n for node in model.graph.node for n in node.output if len(sizes.get(n, ())) == 3]
    wide = [n for n in known if sizes[n][0] == CHANNELS and sizes[n][1] >= SIDE]
    published = [n for n in wide if sizes[n] == (CHANNELS, SIDE, SIDE)]
    if not wide:
        return path, f"{path.name}: its own spatial output (published: 7x7x512)"
    name = (published or wide)[-1]
    out.mkdir(parents=True, exist_ok=True)
    cut = out / f"{path.stem}_512.onnx"
    onnx.utils.extract_model(str(path), str(cut), [model.graph.input[0].name], [name])
    return (
        cut,
        f"{path.name}: tensor {name}{', as published' if published else ' (published: 7x7)'}",
    )


def embedder_of(backbone: str, out: Path) -> tuple[rt.CropEmbedder, str]:
    """Make the embedder whose crops give maps of 7x7 where a size of them does, and name it."""
    path, text = published_map(rt.model_path(backbone), out)
    embedder = rt.CropEmbedder(str(path), "none", threads=1)
    side = embedder.maps(np.zeros((1, CROP_PX, CROP_PX, 3), np.uint8)).shape[-1]
    size = CROP_PX * SIDE // side
    if side != SIDE and CROP_PX % side == 0:
        layout = rt.SamplingLayout(crop_px=size)
        embedder = rt.CropEmbedder(str(path), "none", layout, threads=1)
    size = embedder.layout.crop_px
    shape = embedder.maps(np.zeros((1, size, size, 3), np.uint8)).shape[1:]
    return embedder, f"{text}; maps {shape[1]}x{shape[2]}x{shape[0]} of crops of {size} px"


def crop_maps(scene: Scene, embedder: rt.CropEmbedder) -> Maps:
    """Compute the maps of the three crops of every scored view of a scene."""
    found = list[Any]()
    for f in np.unique(scene.row[scene.scored]):
        image, boxes, rows = scene.at(int(f))
        crops, own = embedder.cut(image, boxes, rows)
        every = np.concatenate([embedder.masked(crops, own), crops])
        found.append(np.split(embedder.maps(every), 3))
    parts = (np.concatenate(part) for part in zip(*found, strict=True))
    return dict(zip(("fg", "bg", "full"), parts, strict=True))


def folds_of(pairs: Pairs, count: int) -> IntArray:
    """Deal the objects into folds, class by class: the fold (N,) of every row."""
    first = np.unique(pairs.identity, return_index=True)[1]
    order = np.lexsort((pairs.identity[first], pairs.name[first]))
    fold = np.empty(len(first), np.int64)
    fold[order] = np.arange(len(first)) % count
    return np.asarray(fold[np.unique(pairs.identity, return_inverse=True)[1]])


def trained_rows(maps: Any, pairs: Pairs, rows: IntArray, args: Any, seed: int) -> Any:
    """Train a block on some rows of maps (N, C, n, n); returns the embeddings (N, E) of all."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    block = ConvBlock(maps.shape[1], maps.shape[-1], args.width)
    with torch.no_grad():
        block.start(maps[rows])
    optimizer = torch.optim.AdamW(block.parameters(), args.rate, weight_decay=0.05)
    views = [rows[pairs.identity[rows] == k] for k in np.unique(pairs.identity[rows])]
    for step in range(args.steps):
        for group in optimizer.param_groups:
            group["lr"] = args.rate * (0.5 + 0.5 * np.cos(np.pi * step / args.steps))
        batch = np.concatenate([rng.permutation(own)[:VIEWS] for own in views])
        fed = maps[batch].flip(3) if rng.random() < 0.5 else maps[batch]
        of = (pairs.scene[batch], pairs.identity[batch], pairs.frame[batch])
        loss = te.parts_loss([block(fed)], of, False, args.loss)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    block.eval()
    with torch.no_grad():
        return torch.cat([block(part) for part in maps.split(64)]).numpy()


def measure(scene: Scene, maps: Maps, args: Any) -> list[dict[str, Any]]:
    """Rank-k of every setup, not trained and trained: the mean of all repeats."""
    pairs = pairs_of([scene])
    allowed, same = pairs.gallery("open", args.away), pairs.same()
    fold, found = folds_of(pairs, args.folds), list[dict[str, Any]]()

    def add(setup: str, trained: str, cosines: Sequence[Any]) -> None:
        ranks = [rank_queries(np.round(c, 5), same, allowed)[0] for c in cosines]
        rank = np.array([r[np.isfinite(r)] for r in ranks])  # (repeats, queries)
        first = 100 * hit(rank, 1).mean(1)
        line = {"setup": setup, "trained": trained, "queries": rank.shape[1]}
        line |= {f"rank{k}": 100 * float(hit(rank, k).mean()) for k in RANKS}
        found.append(line | {"rank1_least": float(first.min()), "rank1_most": float(first.max())})

    for setup, names in CROP_SETUPS.items():
        flat = [flat_maps(maps[n]) for n in names]
        add(setup, "no", [np.mean([f @ f.T for f in flat], 0)])
        stacked = torch.from_numpy(np.concatenate([maps[n] for n in names], 1))
        cosines = np.zeros((args.repeats, *same.shape))
        for r, k in np.ndindex(args.repeats, args.folds):
            train = np.flatnonzero(fold != k)
            rows = trained_rows(stacked, pairs, train, args, args.folds * r + k)
            cosines[r, fold == k] = (rows @ rows.T)[fold == k]
        add(setup, "yes", list(cosines))
        print(f"{setup}: done", file=sys.stderr)
    return found


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add("recording", type=Path, help="folder with images/ and gt_mot.txt")
    add("-o", "--out", type=Path, required=True)
    add("--backbone", default="mobilenetv2_feat", help="ONNX file or name (default %(default)s)")
    add("--every", type=int, default=20, help="use every n-th frame (default %(default)s)")
    add("--away", type=int, default=30, help="minimum frames between query and gallery")
    add("--folds", type=int, default=3)
    add_choosing(parser)
    add("--width", type=int, default=64,
        help="channels of the ConvBlock's first stage (0: of its maps, as published)")  # fmt: skip
    add("--loss", choices=te.LOSSES, default="hardest", help="the negative (default %(default)s)")
    add("--steps", type=int, default=150)
    add("--rate", type=float, default=3e-4, help="learning rate (AdamW, cosine)")
    add(
        "--repeats",
        type=int,
        default=3,
        help="trainings of each setup and fold, with different seeds",
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    args = build_parser().parse_args(argv)
    torch.set_num_threads(1)
    split = split_name(args.recording)
    try:
        if not usable(*split, args.choosing):
            raise rt.ReobjError("nothing left to train and test on")
        scene = recording_scene(args.recording, args.every)
        objects = len(np.unique(scene.identity[scene.scored]))
        if objects < 2 * args.folds:
            text = f"{objects} annotated objects; {2 * args.folds} or more are needed"
            raise rt.ReobjError(f"{args.recording}: {text} for {args.folds} folds")
        args.out.mkdir(parents=True, exist_ok=True)
        embedder, text = embedder_of(args.backbone, args.out)
        print(text, file=sys.stderr)
        rows = measure(scene, crop_maps(scene, embedder), args)
    except rt.ReobjError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_csv(args.out / "reobj_folds.csv", rows)
    head = ["setup", "trained", "queries", *(f"Rank-{k}" for k in RANKS), "Rank-1 of each"]
    lines = table(head, [
        [r["setup"], r["trained"], r["queries"], *(f"{r[f'rank{k}']:.1f}" for k in RANKS),
         f"{r['rank1_least']:.1f} to {r['rank1_most']:.1f}"] for r in rows
    ])  # fmt: skip
    used = (f"{marked(*split)}: {text}; first width {args.width or 'as published'}, "
            f"{args.steps} steps, loss {args.loss}, {args.repeats} repeats")  # fmt: skip
    with atomic(args.out / "reobj_folds.md") as part:
        part.write_text(f"{used}\n\n{lines}\n")
    print(f"{used}\n\n{lines}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
