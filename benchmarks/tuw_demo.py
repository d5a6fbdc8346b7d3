"""Compare LfD with fit_objects on the demo of LfD's authors (TUW: 6 objects, 8 views).

Usage:
    python benchmarks/tuw_demo.py FOLDER [-o benchmarks]

FOLDER holds bounding_boxes.npy (8, 24), camera_poses.npy (32, 3), intrinsics.npy (3, 3) and gt.npy
(6, 4, 4) of IIT-PAVIS/LfD, Data/Aldoma (MIT; data after Aldoma et al., IROS 2014). The data is not
part of this project.

Official code, mean O3D: .716 with all views, .518 with three adjacent ones (two of six are not
ellipsoids there).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))
from synthetic_quadrics import table, write_table

import quadrics
from quadrics import Array, Ellipsoids

IMAGE = (640, 480)  # px
UP = (0.0, 0.0, 1.0)  # the table is the plane z = 0


def load(folder: Path) -> tuple[Array, Array, Ellipsoids]:
    """Read boxes (8, 6, 4), cameras (8, 3, 4) and true ellipsoids, in COLMAP pixels."""
    boxes = np.load(folder / "bounding_boxes.npy").reshape(8, 6, 4)
    cam_from_world = np.load(folder / "camera_poses.npy").reshape(8, 4, 3).transpose(0, 2, 1)
    img_from_world = np.load(folder / "intrinsics.npy") @ cam_from_world
    truth, real = Ellipsoids.from_dual_quadrics(np.load(folder / "gt.npy"))
    assert real.all()
    return boxes, img_from_world, truth


def lfd_score(boxes: Array, cams: Array, truth: Ellipsoids) -> tuple[Array, int]:
    """O3D (6,) of closed-form LfD with sqrt|eigenvalue| axes, and how many are ellipsoids."""
    dual_q, real = quadrics.fit_lfd(boxes, cams)
    found = Ellipsoids.from_dual_quadrics(dual_q)[0]
    return np.nan_to_num(quadrics.volume_overlap(found, truth)), int(real.sum())


def fit_score(boxes: Array, cams: Array, truth: Ellipsoids, up: Sequence[float] | None) -> Array:
    """O3D (6,) of fit_objects with support="ellipsoid" and no priors."""
    fits = quadrics.fit_objects(boxes, cams, IMAGE, up=up, support="ellipsoid")
    return quadrics.volume_overlap(fits.ellipsoids, truth)


def overlap_table(boxes: Array, cams: Array, truth: Ellipsoids) -> str:
    """O3D with all views, three adjacent and three wide ones."""
    adjacent = [range(k, k + 3) for k in range(6)]
    choices: dict[str, Sequence[Sequence[int]]] = {"all 8": [range(8)], "first 3": [range(3)]}
    choices |= {"3 adjacent, mean of 6": adjacent, "0, 2, 4": [[0, 2, 4]], "0, 3, 5": [[0, 3, 5]]}
    rows = []
    for name, subsets in choices.items():
        picks = [np.array(s) for s in subsets]
        lfd = [lfd_score(boxes[s], cams[s], truth) for s in picks]
        row: list[object] = [name, f"{np.mean([x[0].mean() for x in lfd]):.3f}"]
        row.append(f"{sum(x[1] for x in lfd)} of {6 * len(lfd)}")
        for up in (UP, None):
            ours = [fit_score(boxes[s], cams[s], truth, up).mean() for s in picks]
            row.append(f"{np.mean(ours):.3f}")
        rows.append(row)
    head = ["views", "LfD", "real ellipsoids", "fit_objects, up known", "fit_objects, up unknown"]
    return table(head, rows)


def shape_table(boxes: Array, cams: Array) -> str:
    """The shape that the evidence chooses and the edge residual in millimetres."""
    fits = quadrics.fit_objects(boxes, cams, IMAGE, up=UP, support="evidence")
    focal = np.linalg.norm(np.cross(cams[0, 0, :3], cams[0, 2, :3]))  # px
    rows = []
    for k in range(len(fits)):
        depth = float(np.mean(cams[:, 2] @ np.append(fits.ellipsoids.center_in_world[k], 1.0)))
        size = " x ".join(f"{1e3 * x:.0f}" for x in fits.size[k])
        px = fits.rms_px[k]
        shape = "carton" if k < 4 else "bottle"
        rows.append([shape, fits.support[k], size, f"{px:.2f}", f"{1e3 * px * depth / focal:.2f}"])
    return table(["object", "shape found", "size mm", "edge rms px", "edge rms mm"], rows)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", type=Path, metavar="FOLDER", help="fill in FOLDER/RESULTS.md")
    args = parser.parse_args(argv)
    if not (args.folder / "gt.npy").exists():
        print(f"error: {args.folder} has no gt.npy; see the top of this file", file=sys.stderr)
        return 2
    boxes, cams, truth = load(args.folder)
    text = overlap_table(boxes, cams, truth) + "\n\n" + shape_table(boxes, cams)
    print(text)
    if args.o:
        write_table(args.o / "RESULTS.md", "tuw", text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
