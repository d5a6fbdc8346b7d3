"""Make a priors.json from a folder of CAD meshes or from a table of sizes.

Usage:
    python examples/own_priors.py MESHES/ -o priors.json --up y   # MESHES/<category>/*.obj
    python examples/own_priors.py sizes.csv -o priors.json        # category, w, d, h in metres

Meshes (obj, ply, glb, stl, off) must be in metres (--scale multiplies) and stand upright: --up
names the vertical axis (up y: w = x, d = z; up z: w = x, d = y). Sizes are modelled as log-normal,
as in quadrics.py; axis ratios (log w/h, log d/h) follow from the same samples. Objects on which
sizes are evaluated must not be among them.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
MESH_SUFFIXES = (".obj", ".ply", ".glb", ".stl", ".off")
WDH_AXES = {"y": (0, 2, 1), "z": (0, 1, 2)}  # columns of (w, d, h) in mesh coordinates
MIN_LOG_STD = 0.05  # a handful of equal meshes must not make a category rigid
ALONE_LOG_STD = 0.3  # spread given to a category with a single sample
log = logging.getLogger("build_priors")


def read_meshes(folder: Path, up: str, scale: float) -> dict[str, Array]:
    """Read sizes (n, 3) w, d, h of each category folder; warn of unreadable meshes."""
    import trimesh

    sizes: dict[str, list[Array]] = {}
    for path in sorted(p for p in folder.glob("*/*") if p.suffix.lower() in MESH_SUFFIXES):
        try:
            extents = np.asarray(trimesh.load(path, force="mesh").extents, np.float64)
        except Exception as error:  # trimesh raises whatever its readers raise
            log.warning("%s left out: %s", path, error)
            continue
        if extents.shape == (3,) and np.isfinite(extents).all() and (extents > 0).all():
            wdh = extents[list(WDH_AXES[up])] * scale
            sizes.setdefault(path.parent.name.replace("_", " "), []).append(wdh)
        else:
            log.warning("%s left out: it has no volume", path)
    return {name: np.array(rows) for name, rows in sizes.items()}


def read_table(path: Path, scale: float) -> dict[str, Array]:
    """Read sizes (n, 3) of each category of a CSV with columns category, w, d, h."""
    sizes: dict[str, list[list[float]]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for number, row in enumerate(csv.DictReader(file), start=2):
            try:
                wdh = [scale * float(row[k]) for k in ("w", "d", "h")]
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{path}, line {number}: needs category, w, d, h ({error})"
                ) from error
            if min(wdh) <= 0:
                raise ValueError(f"{path}, line {number}: sizes must be positive, found {wdh}")
            sizes.setdefault(row["category"], []).append(wdh)
    return {name: np.array(rows) for name, rows in sizes.items()}


def prior_entry(wdh: Array, support: str, source: str) -> dict[str, Any]:
    """Make the entry of a category in priors.json from its samples (n, 3).

    `mean` is the geometric mean: the median of the log-normal that quadrics.py uses.
    """
    logs = np.log(wdh)
    several = len(wdh) > 1
    cov = np.cov(logs.T) if several else np.eye(3) * ALONE_LOG_STD**2
    std = np.maximum(np.sqrt(np.diagonal(cov)), MIN_LOG_STD)
    corr = cov / np.outer(std, std)
    full = corr * np.outer(std, std) + np.diag(std**2 - np.diagonal(cov))
    difference = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])
    mean = logs.mean(0)
    return {
        "size_m": {
            "mean": np.exp(mean).round(5).tolist(),
            "log_std": std.round(5).tolist(),
            "corr": [
                round(float(np.clip(corr[i, j], -0.95, 0.95)), 4)
                for i, j in ((0, 1), (0, 2), (1, 2))
            ],
        },
        "axis_ratio": {
            "mean_log": (difference @ mean).round(5).tolist(),
            "cov_log": (difference @ full @ difference.T).round(6).tolist(),
        },
        "support": support,
        "yaw_symmetric": bool(several and np.abs(logs[:, 0] - logs[:, 1]).max() < 0.02),
        "upright": True,
        "n": len(wdh),
        "source": source,
    }


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("input", type=Path, help="folder of category folders, or a CSV file")
    parser.add_argument("-o", type=Path, default=Path("priors.json"), metavar="FILE")
    parser.add_argument(
        "--up", choices=sorted(WDH_AXES), default="y", help="vertical axis (default: y)"
    )
    parser.add_argument(
        "--scale", type=float, default=1.0, help="metres per mesh unit (default: 1)"
    )
    parser.add_argument("--support", choices=("box", "cylinder", "ellipsoid"), default="box")
    args = parser.parse_args(argv)
    logging.basicConfig(format="%(levelname)s: %(message)s")
    try:
        if args.input.is_dir():
            sizes = read_meshes(args.input, args.up, args.scale)
        else:
            sizes = read_table(args.input, args.scale)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if not sizes:
        print(f"error: no meshes {MESH_SUFFIXES} in folders of {args.input}", file=sys.stderr)
        return 2
    priors: dict[str, Any] = {"aliases": {}}
    priors |= {name: prior_entry(wdh, args.support, str(args.input)) for name, wdh in sizes.items()}
    args.o.write_text(json.dumps(priors, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
