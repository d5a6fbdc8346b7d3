#!/usr/bin/env python3
"""Checks of the fitted shapes that need no ground truth, on finished output folders of `run`.

    python benchmarks/shape_checks.py OUT [OUT ...]

Cameras, sparse points, boxes and options are those of the run; its boxes are linked and fitted
again by the code of this checkout, corrections by hand are left out. A folder called "out" has the
name of its parent. Printed is one row for each recording, and one for all.

Depths, of the objects listed (status "ok" or "prior_dominated"):
    depth       depth of the centre, divided by the median depth of the sparse points that project
                into the inner 60 % of the object's box (at least 5 points, also occluded ones); the
                median over up to 40 boxes of the object. Printed: median and 5 to 95 % of objects
    runaway     objects whose depth is outside .5 to 2
    absurd      objects whose longest side is more than 3 times that of their category
    implausible objects that the fit set aside for their size; not among those listed

Repeatability, twice: every second frame against the others ("halves"), and all boxes against the
same boxes with Gaussian noise of 1 px ("noise"). Halves have the cameras, points and tracks of the
run; linking and fitting are done for each. Two listed objects share the boxes of tracks of the
tracker that both contain: of each track the smaller of their two numbers of boxes. They are a pair
if they share at least half of the boxes of the one with fewer; one to one, with the largest sum of
shared boxes. Places and sizes do not matter: a wrong shape in one of the fits is a pair far apart,
if it is listed.
    a, b, both  objects of the first and of the second fit, and pairs
    one only    objects of either fit that are in no pair
    centres     pairs whose difference of centres is in the 95 % region of the sum of their
                covariances (chi-squared, 3 degrees of freedom: 7.81); .95 is expected of
                independent errors. What both fits share (cameras, priors, for "noise" the boxes) is
                ignored, so that more may lie inside
    sizes       the same for the logarithms of the three half axes, the axes of the second shape in
                the order that agrees best with the first
    sides       median ratio of the longest sides, the longer to the shorter
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from tables import table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import quadrics
import reobj_track as rt
from reobj.cameras import place_of, points_in_boxes, undistort_boxes
from reobj.config import read_config
from reobj.objects.fit import link_and_fit
from reobj.results.entries import OutputFile
from reobj.results.result import Object, Result
from reobj.results.workspace import Workspace
from reobj.types import Array, BoolArray, Embeddings, IntArray, ReobjError, Tracks

INNER = 0.6  # share of a box's width and height
MIN_POINTS, MAX_BOXES = 5, 40
NOISE_PX = 1.0
REGION = 7.81  # chi-squared, 3 degrees of freedom, 95 %
ORDERS = np.array(list(itertools.permutations(range(3))))  # (6, 3) of axes


# ---- Depths ------------------------------------------------------------------------------------


def depth_ratios(result: Result) -> dict[int, float]:
    """Return the depth of each listed object over that of the points in its boxes, NaN unknown."""
    return {
        o.id: _depth_ratio(o, component.tracks[component.tracks.track_id == o.id], component.poses)
        for component in result.parts()
        if component.poses is not None
        for o in component.located
    }


def _depth_ratio(o: Object, boxes: Tracks, poses: rt.Poses) -> float:
    """Return the median ratio over the boxes of an object."""
    assert o.center is not None
    row, known = place_of(poses, boxes.frame)
    rows = np.flatnonzero(known)
    rows = rows[:: -(-len(rows) // MAX_BOXES) or 1]
    xyxy = undistort_boxes(boxes.xyxy[rows], poses.camera)
    margin = (xyxy[:, 2:] - xyxy[:, :2]) * (1 - INNER) / 2
    inner = xyxy + np.hstack([margin, -margin])
    ratios = []
    for cam_from_world, box in zip(poses.cam_from_world[row[rows]], inner, strict=True):
        img_from_world = poses.camera.K @ cam_from_world
        depth = points_in_boxes(poses.points, img_from_world, box[None])[2]
        if len(depth) >= MIN_POINTS:
            center = cam_from_world[2] @ np.append(o.center, 1.0)
            ratios.append(center / np.median(depth))
    return float(np.median(ratios)) if ratios else np.nan


def oversizes(objects: Sequence[Object], priors: quadrics.Priors) -> Array:
    """Return the longest sides (O,) over those of the categories, NaN unknown."""
    if not objects:
        return np.empty(0)
    category = priors.index([o.class_name for o in objects])
    usual = np.append(np.exp(priors.log_mean).max(1), np.nan)[category]
    side = [np.nan if o.size_m is None else float(np.max(o.size_m)) for o in objects]
    return np.asarray(side / usual, np.float64)


# ---- Repeatability -----------------------------------------------------------------------------


def only_in(result: Result, frames: IntArray) -> Result:
    """Return an unlinked result with the boxes of some frames, the only ones searched."""
    kept = np.isin(result.tracks.frame, frames)
    shown = kept[result.embedding_row]
    return dataclasses.replace(
        result,
        tracks=result.tracks[kept],
        untracked=result.untracked[np.isin(result.untracked.frame, frames)],
        embeddings=Embeddings(
            result.embeddings.foreground[shown], result.embeddings.background[shown]
        ),
        embedding_row=(np.cumsum(kept) - 1)[result.embedding_row[shown]],
        looked=frames,
    )


def with_noise(result: Result, sigma_px: float, seed: int = 0) -> Result:
    """Return an unlinked result with Gaussian noise on the edges of its boxes."""
    rng = np.random.default_rng(seed)

    def moved(rows: Tracks) -> Tracks:
        corners = (rows.xyxy + rng.normal(0, sigma_px, rows.xyxy.shape)).reshape(-1, 2, 2)
        return dataclasses.replace(rows, xyxy=np.sort(corners, axis=1).reshape(-1, 4))

    return dataclasses.replace(
        result, tracks=moved(result.tracks), untracked=moved(result.untracked)
    )


@dataclass(frozen=True, slots=True)
class Comparison:
    """Listed objects of two fits of one recording.

    Attributes:
        a, b: number of objects of each fit.
        centre, size: (P,) squared Mahalanobis distances of the pairs. sides: (P,) ratios, from 1.
    """

    a: int = 0
    b: int = 0
    centre: Array = field(default_factory=lambda: np.empty(0))
    size: Array = field(default_factory=lambda: np.empty(0))
    sides: Array = field(default_factory=lambda: np.empty(0))

    def figures(self) -> list[str]:
        """Return the cells of COMPARED."""
        both = len(self.sides)
        shares = [_mean(self.centre <= REGION), _mean(self.size <= REGION)]
        counts = map(str, (self.a, self.b, both, self.a + self.b - 2 * both))
        return [*counts, *shares, _percentile(self.sides, 50)]


def compare(first: Result, second: Result, tracked: Result) -> Comparison:
    """Compare the listed objects of two fits of the boxes of `tracked`."""
    a, b = first.located, second.located
    pairs = matched(a, b, votes(first, tracked), votes(second, tracked))
    values = [differences(a[i], b[j]) for i, j in pairs]
    return Comparison(len(a), len(b), *np.array(values).reshape(-1, 3).T)


def votes(fitted: Result, tracked: Result) -> IntArray:
    """Count the boxes (O, T) of each listed object in each track of the tracker."""
    tracks = tracked.tracks
    boxes = zip(tracks.frame.tolist(), tracks.detection_index.tolist(), strict=True)
    track_of = dict(zip(boxes, tracks.tracklet_id.tolist(), strict=True))
    row_of = {o.id: row for row, o in enumerate(fitted.located)}
    count = np.zeros((len(row_of), int(tracks.tracklet_id.max(initial=0)) + 1), np.int64)
    columns = (fitted.tracks.track_id, fitted.tracks.frame, fitted.tracks.detection_index)
    for identity, *box in zip(*(column.tolist() for column in columns), strict=True):
        if identity in row_of and tuple(box) in track_of:
            count[row_of[identity], track_of[tuple(box)]] += 1
    return count


def matched(
    first: Sequence[Object], second: Sequence[Object], a: IntArray, b: IntArray
) -> list[tuple[int, int]]:
    """Pair the objects of two fits one to one; returns their rows.

    Args:
        a, b: (O, T) boxes of each object in each track.
    """
    shared = np.minimum(a[:, None], b).sum(2)  # (A, B)
    component = [np.array([o.part for o in objects], np.int64) for objects in (first, second)]
    enough = 2 * shared >= np.minimum(a.sum(1)[:, None], b.sum(1))
    allowed = enough & (shared > 0) & (component[0][:, None] == component[1])
    rows, columns = linear_sum_assignment(np.where(allowed, shared, 0), maximize=True)
    return [(i, j) for i, j in zip(rows, columns, strict=True) if allowed[i, j]]


def differences(a: Object, b: Object) -> tuple[float, float, float]:
    """Return squared Mahalanobis distances of centres and log half axes, and the ratio of sides."""
    (center_a, log_a, axes_a, cov_a), (center_b, log_b, axes_b, cov_b) = map(_shape, (a, b))
    agreement = np.abs(axes_a.T @ axes_b)  # (3, 3) cosines of the axes of a and b
    order = ORDERS[agreement[np.arange(3), ORDERS].sum(1).argmax()]
    size_cov = cov_a[3:6, 3:6] + cov_b[3:6, 3:6][np.ix_(order, order)]
    return (
        _square(center_a - center_b, cov_a[:3, :3] + cov_b[:3, :3]),
        _square(log_a - log_b[order], size_cov),
        float(np.exp(abs(log_a.max() - log_b.max()))),
    )


def _shape(o: Object) -> tuple[Array, Array, Array, Array]:
    """Return centre, log half axes, axes as columns and covariance of a listed object."""
    assert o.center is not None and o.half_axes is not None
    assert o.quat_wxyz is not None and o.cov is not None
    axes = Rotation.from_quat(np.roll(o.quat_wxyz, -1)).as_matrix()
    return o.center, np.log(o.half_axes), axes, o.cov


def _square(difference: Array, cov: Array) -> float:
    """Return a squared Mahalanobis distance."""
    return float(difference @ np.linalg.solve(cov, difference))


# ---- Table -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Checks:
    """Checks of one recording, or of several.

    Attributes:
        depth: (O,) of the listed objects. oversize: (O,) longest side over the usual one.
        implausible: number of objects. halves, noise: comparisons.
    """

    depth: Array
    oversize: Array
    implausible: int
    halves: Comparison
    noise: Comparison

    def figures(self) -> list[str]:
        """Return the cells of HEAD but the first."""
        off = (self.depth < 0.5) | (self.depth > 2)
        low, median, high = (_percentile(self.depth, p) for p in (5, 50, 95))
        counts = (off.sum(), (self.oversize > 3).sum(), self.implausible)
        return [str(len(self.depth)), f"{median} ({low}-{high})", *map(str, counts),
                *self.halves.figures(), *self.noise.figures()]  # fmt: skip


def pooled(checks: Sequence[Any]) -> Any:
    """Join the checks of several recordings: numbers are added, arrays joined."""
    if isinstance(checks[0], int):
        return sum(checks)
    if isinstance(checks[0], np.ndarray):
        return np.concatenate(checks)
    names = [f.name for f in dataclasses.fields(checks[0])]
    return type(checks[0])(*(pooled([getattr(c, name) for c in checks]) for name in names))


def check(out: Path) -> Checks:
    """Check the shapes of an output folder."""
    tracked = Workspace.open(out).load_last()
    if tracked.identities_given:
        raise ReobjError(f"{out}: its identities were given; run it with a tracker")
    options = out / OutputFile.CONFIG
    config = read_config(rt.Config(), options).objects if options.is_file() else rt.ObjectsConfig()
    whole, noisy = (
        link_and_fit(result, config) for result in (tracked, with_noise(tracked, NOISE_PX))
    )
    frames = np.unique(tracked.tracks.frame) if tracked.poses is None else tracked.poses.frame
    frames = frames if tracked.looked is None else tracked.looked
    even, odd = (link_and_fit(only_in(tracked, frames[k::2]), config) for k in (0, 1))
    ratios = depth_ratios(whole)
    return Checks(
        np.array([ratios[o.id] for o in whole.located]),
        oversizes(whole.located, config.size_priors()),
        sum(o.status == "implausible" for o in whole.objects),
        compare(even, odd, tracked),
        compare(whole, noisy, tracked),
    )


COMPARED = ("a", "b", "both", "one only", "centres", "sizes", "sides")
HEAD = ("recording", "objects", "depth (5-95 %)", "runaway", "absurd", "implausible",
        *(f"{kind}: {name}" for kind in ("halves", "noise") for name in COMPARED))  # fmt: skip


def _mean(values: BoolArray) -> str:
    return f"{np.mean(values):.2f}" if len(values) else "-"


def _percentile(values: Array, percent: float) -> str:
    known = values[np.isfinite(values)]
    return f"{np.percentile(known, percent):.2f}" if len(known) else "-"


def name_of(out: Path) -> str:
    """Return the name of the recording of an output folder."""
    path = out.resolve()
    return path.parent.name if path.name == "out" else path.name


def main(argv: Sequence[str] | None = None) -> int:
    """Check all folders; print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("out", type=Path, nargs="+", metavar="OUT", help="output folders of `run`")
    args = parser.parse_args(argv)
    try:
        checks = {name_of(out): check(out) for out in args.out}
    except ReobjError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    checks["all"] = pooled(list(checks.values()))
    print(table(HEAD, ([name, *found.figures()] for name, found in checks.items())))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
