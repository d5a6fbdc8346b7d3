"""Objects: one solid and ellipsoid each from all its boxes, and its description.

The geometry is that of `quadrics.fit_objects`; identity/linking.py decides which rows are one
object.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import quadrics
from reobj.cameras import Poses, quat_wxyz_from_matrix
from reobj.files import did_you_mean, load_json, numbers, rounded, shortened
from reobj.objects.likelihood import CLASS_KEPT
from reobj.objects.observations import NOTHING_KNOWN, Fit, Scene, Views
from reobj.poses.floor import floor_of
from reobj.results.result import Object, Part, World, significant
from reobj.types import Array, LinkEvent, ReobjError, Tracks, object_classes, option, rows_by

OURS, PUBLISHED = "solids", ("lfd", "sfmo", "psfmo")  # solvers


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """Fit one solid and its ellipsoid to every object, from tracks and cameras."""

    priors: str = option(
        "", "size priors, JSON (default: the priors.json that comes along)", "--priors"
    )
    known_size: str = option(
        "", "true heights that set the metric scale: 'chair=.82m,door=2m'", "--known-size"
    )
    support: str = option(
        "auto",
        "shape of the solids: box, cylinder, ellipsoid, or auto (by category, else by evidence)",
        "--support",
    )
    solver: str = option(
        OURS,
        "solids (ours), or ellipsoids by a published closed form: lfd, sfmo, psfmo",
        "--solver",
    )
    up: str = option("", "direction against gravity in the world, x,y,z (default: estimated)")
    link: bool = option(True, "join and split the tracker's tracklets after the video")
    min_views: int = option(3, "an object seen in fewer frames with a pose gets no ellipsoid")
    moving: str = option(
        "person,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe",
        "classes that move, comma-separated: they are tracked, but get no ellipsoid",
    )

    @property
    def moving_classes(self) -> tuple[str, ...]:
        """Names in `moving`."""
        return tuple(filter(None, (name.strip() for name in self.moving.split(","))))


def fitter(config: ObjectsConfig, poses: Poses, class_names: Sequence[str]) -> Fit:
    """Bind priors, known sizes, gravity and the kind of solid to `quadrics.fit_objects`.

    Raises:
        ReobjError, QuadricsError: an option cannot be read, or there are no such priors.
    """
    priors = size_priors(config)
    known = parse_known_size(config.known_size)
    if config.solver not in (OURS, *PUBLISHED):
        raise ReobjError(f"--solver {config.solver}: expected {OURS} or {', '.join(PUBLISHED)}")
    up = parse_up(config.up) if config.up else poses.up_in_world
    support = None if config.support == "auto" else config.support

    def fit(views: Views, classes: list[int], scene: Scene = NOTHING_KNOWN) -> quadrics.ObjectFits:
        categories = [class_names[c] if c < len(class_names) else "" for c in classes]
        fits = quadrics.fit_objects(
            views.boxes, views.img_from_world, views.image_size, categories, priors,
            up=scene.up if up is None else up, support=support, score=views.score,
            hidden=views.hidden, metric=poses.metric if scene.scale is None else scene.scale,
            known_size=known, floor=scene.floor, points=views.points,
            config=quadrics.FitConfig(wrong_class=0) if scene.trusts_classes else None,
        )  # fmt: skip
        known_up = up is not None or scene.up is None
        return fits if known_up else dataclasses.replace(fits, up_source="floor")

    return fit


def size_priors(config: ObjectsConfig) -> quadrics.Priors:
    """Load the size priors that a config names.

    Raises:
        ReobjError, QuadricsError: no JSON, too large, or no priors.
    """
    if config.priors:
        load_json(Path(config.priors))  # as large as our files may be
    return quadrics.load_priors(config.priors or None)


def parse_up(text: str) -> Array:
    """Parse a direction x,y,z into a unit vector (3,)."""
    try:
        up = np.array([float(x) for x in text.split(",")])
    except ValueError:
        up = np.empty(0)
    if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
        raise ReobjError(f"--set objects.up={text}: expected a direction x,y,z, such as 0,0,1")
    up /= np.abs(up).max()  # the squares of 1e300 are too large
    return np.asarray(up / np.linalg.norm(up))


def parse_known_size(text: str) -> dict[str | int, tuple[str | int, float]]:
    """Parse 'chair=0.82m,door=2.0m' into heights in metres by category.

    >>> parse_known_size("door=2.0m, chair=82cm")
    {'door': ('h', 2.0), 'chair': ('h', 0.82)}
    """
    per_metre = {"m": 1, "cm": 100, "mm": 1000}
    sizes: dict[str | int, tuple[str | int, float]] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        found = re.fullmatch(r"(.+?)\s*=\s*([0-9]*\.?[0-9]+|[0-9]+\.)\s*(m|cm|mm)", item)
        height_m = float(found[2]) / per_metre[found[3]] if found else 0.0
        if found is None or not KNOWN_SIZE_M[0] <= height_m <= KNOWN_SIZE_M[1]:
            expected = "CATEGORY=HEIGHT in m, cm or mm, from {:g} to {:g} m, such as door=2.0m"
            raise ReobjError(f"--known-size {item!r}: expected {expected.format(*KNOWN_SIZE_M)}")
        sizes[found[1]] = ("h", height_m)
    return sizes


KNOWN_SIZE_M = (0.001, 1000.0)  # chosen: objects of a room or a street are neither


def check_known_size(config: ObjectsConfig, class_names: Sequence[str]) -> None:
    """Refuse sizes of categories that no object can have; a misspelt one would set nothing."""
    names = list(map(str, parse_known_size(config.known_size)))
    priors = size_priors(config)
    known = set(priors.canonical(class_names))
    for name, plain in zip(names, priors.canonical(names), strict=True):
        if known and plain not in known:
            close = did_you_mean(name, class_names) or f"; there are {shortened(class_names)}"
            raise ReobjError(f"--known-size {name}: no such class{close}")


def unused_sizes(config: ObjectsConfig, objects: Sequence[Object]) -> list[str]:
    """Warn of sizes of categories that no object with a solid has: they set nothing."""
    priors = size_priors(config)
    seen = set(priors.canonical([o.class_name for o in objects if o.located]))
    names = list(map(str, parse_known_size(config.known_size)))
    return [
        f"--known-size {name}: no {name} with a solid was found, so this sets no scale"
        for name, plain in zip(names, priors.canonical(names), strict=True)
        if plain not in seen
    ]


def describe_objects(
    tracks: Tracks,
    class_names: Sequence[str],
    fits: quadrics.ObjectFits | None,
    views: Views | None,
    config: ObjectsConfig,
    confidence: Mapping[int, float] | None = None,
) -> list[Object]:
    """Describe every identity of the tracks: class, visits, and its solid or why it has none.

    Without cameras there is nothing to fit: all are "tracked".

    Args:
        fits, views: of the identities in ascending order; None without cameras.
        confidence: of identities, where it is known.
    Returns:
        one `Object` an identity, by id.
    """
    objects, moving, iou = [], config.moving_classes, np.empty(0)
    if fits is not None and views is not None:
        seen = (views.boxes, views.img_from_world, views.image_size)
        iou = quadrics.reprojection_iou(fits, *seen)  # (V, O)
    for i, (identity, class_id) in enumerate(object_classes(tracks).items()):
        rows = tracks[tracks.track_id == identity]
        spans = [rows.frame[r] for r in rows_by(rows.tracklet_id)]
        found = Object(
            identity,
            name_of(class_names, class_id),
            round(float(rows.score.mean()), 4),
            "tracked",
            "",
            frames_seen=len(np.unique(rows.frame)),
            tracklet_ids=np.unique(rows.tracklet_id).tolist(),
            visits=sorted([int(f.min()), int(f.max())] for f in spans),
            classes=_likeliest(rows, class_names, len(np.unique(tracks.class_id))),
        )
        if fits is not None and views is not None:
            found = _with_solid(found, fits, i, views, iou[:, i], moving, config.min_views)
        if confidence and identity in confidence and found.class_name not in moving:
            found = _with_confidence(found, confidence[identity])
        objects.append(found)
    return objects


VIEWS_ALIKE = 10  # frames in which a detector errs alike count as one (chosen: a third of a second)


def _likeliest(rows: Tracks, class_names: Sequence[str], count: int) -> dict[str, float]:
    """Return the probability of the likeliest two classes of an object, from all its detections.

    A detector names a thing wrongly in 1 - CLASS_KEPT of its detections, all other classes alike.

    Args:
        count: of classes that any object of the video may have.
    """
    classes, column = np.unique(rows.class_id, return_inverse=True)
    votes = np.bincount(column, rows.score) / VIEWS_ALIKE
    log_odds = votes * np.log(CLASS_KEPT / (1 - CLASS_KEPT) * max(count - 1, 1))
    share = np.exp(log_odds - log_odds.max())
    share /= share.sum() + (count - len(classes)) * np.exp(-log_odds.max())
    best = np.argsort(-share, kind="stable")[:2]
    return {name_of(class_names, int(classes[k])): round(float(share[k]), 3) for k in best}


def name_of(class_names: Sequence[str], class_id: int) -> str:
    """Return the name of a class, "object" where it has none."""
    return class_names[class_id] if 0 <= class_id < len(class_names) else "object"


MIN_SCORE = 0.05  # boxes of less, and filled gaps, shape nothing (of the weakest 1 in 25 is real)
DOUBTFUL = 0.5  # confidence below which an object is less likely there than not


def _with_confidence(found: Object, confidence: float) -> Object:
    """Add how sure an object is; one that is doubtful is kept with its solid, but not counted."""
    made = dataclasses.replace(found, confidence=round(confidence, 3))
    if confidence >= DOUBTFUL:
        return made
    why = f"{100 * confidence:.0f} % likely: its detections are weak, or in few of the frames"
    why += ", or things behind it are seen through its place"
    if found.status == "rejected":
        why += f"; {found.reason}"
    return dataclasses.replace(made, status="doubtful", reason=why)


def _with_solid(
    found: Object,
    fits: quadrics.ObjectFits,
    i: int,
    views: Views,
    iou: Array,
    moving: Sequence[str],
    min_views: int,
) -> Object:
    """Add solid i, its uncertainty and its evidence, or the reason why it is rejected."""
    seen = np.isfinite(views.boxes[:, i, 0])
    count = int(seen.sum())
    support: str | None = str(fits.support[i])
    status, reason = str(fits.status[i]), str(fits.reason[i])
    if found.class_name in moving:
        status, reason, support = "rejected", "objects of this class move", None
    elif count < min_views:
        seen_in = f"seen in {count} frame{'s' * (count != 1)} with a camera pose"
        status, reason, support = "rejected", f"{seen_in}; {min_views} are needed", None
    solid: dict[str, Any] = {}
    if status != "rejected":
        scale = fits.scale
        sigma2 = np.diag(fits.cov[i])[3:6] + scale.rel_sigma**2  # of log sizes in metres: both
        rotation = fits.ellipsoids.world_from_obj[i : i + 1]
        values = {
            "center": fits.ellipsoids.center_in_world[i],
            "half_axes": fits.ellipsoids.half_axes[i],
            "quat_wxyz": quat_wxyz_from_matrix(rotation)[0],
            "size": fits.size[i],
            "size_m": fits.size[i] * scale.value if scale.source != "none" else None,
            "size_rel_sigma": np.sqrt(sigma2),
            "cov": fits.cov[i],
        }
        unknown = {k for k, v in values.items() if v is None or not np.isfinite(v).all()}
        solid = {k: None if k in unknown else significant(v) for k, v in values.items()}
        if solid["center"] is not None:
            size = float(np.max(values["half_axes"]))
            solid["center"] = significant(values["center"], size)
    return dataclasses.replace(
        found,
        status=status,
        reason=reason,
        support=support,
        views=count,
        dropped_boxes=int((seen & ~fits.inlier[:, i]).sum()),
        parallax_deg=rounded(fits.parallax_deg[i], 2),
        reprojection_iou_median=rounded(np.median(iou[seen]), 3) if seen.any() else None,
        **solid,
    )


def describe_world(
    poses: Poses | None,
    fits: Sequence[quadrics.ObjectFits | None],
    events: Sequence[LinkEvent],
) -> World:
    """Describe the world of the poses: units, gravity, scale, floor, frames, joins and splits.

    Args:
        fits: of each part, None where nothing was fitted.
    """
    if poses is None:
        return World(links=tuple(events))
    parts = tuple(_describe_part(poses, k, fit) for k, fit in enumerate(fits))
    first = parts[0]
    return World(
        "m" if poses.metric else "arbitrary",
        poses.source,
        first.registered_frames,
        first.interpolated_frames,
        len(poses.frame),
        first.up_in_world,
        first.up_source,
        first.scale,
        tuple(events),
        parts,
        first.floor,
        first.floor_reason,
        poses.reading,
    )


def _describe_part(poses: Poses, part: int, fits: quadrics.ObjectFits | None) -> Part:
    """Describe one part of the poses from its frames and its fits."""
    row, poses = np.flatnonzero(poses.part == part), poses.of_part(part)
    runs = np.split(poses.frame, np.flatnonzero(np.diff(row) > 1) + 1)
    scale, up = None, poses.up_in_world
    up_source = "none" if up is None else "poses"
    if fits is not None:
        (value,), sigma = numbers(np.array([fits.scale.value]), 1.0), round(fits.scale.rel_sigma, 4)
        scale = quadrics.Scale(value, sigma, fits.scale.source)
        if fits.up.any():
            up, up_source = fits.up, fits.up_source
    up = None if up is None else significant(up)
    known = None if scale is None or scale.source == "none" else scale.value
    floor, reason = floor_of(poses, up, 1.0 if poses.metric else known)
    return Part(
        [[int(run[0]), int(run[-1])] for run in runs if len(run)],
        len(poses.frame),
        int(poses.known.sum()),
        int((poses.status == "interpolated").sum()),
        up,
        up_source,
        scale,
        floor,
        reason,
    )
