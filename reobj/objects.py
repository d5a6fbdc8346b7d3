"""Objects: one solid and ellipsoid each from all its boxes, and its entry in objects.json."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import quadrics
from reobj.cameras import Poses, quat_wxyz_from_matrix
from reobj.files import numbers, rounded
from reobj.identity.linking import LinkEvent
from reobj.results.workspace import OBJECT_FIELDS, SOLID_FIELDS
from reobj.types import Array, ReobjError, Tracks, object_classes, option, rows_by
from reobj.views import Views


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """From tracks and cameras to one solid and ellipsoid per object."""

    priors: str = option(
        "", "size priors, JSON (default: priors.json beside this file)", "--priors"
    )
    known_size: str = option(
        "", "known heights for the scale: 'chair=.82m,door=2m'", "--known-size"
    )
    support: str = option(
        "auto", "shape of the solids: auto, box, cylinder, ellipsoid", "--support"
    )
    up: str = option("", "up in the world: x,y,z (default: from the poses or the objects)")
    link: bool = option(True, "join and split tracklets by 3D evidence")
    min_views: int = option(
        3, "objects with fewer detections in frames with poses get no ellipsoid"
    )
    min_score: float = option(0.3, "boxes below this score do not shape the ellipsoid")
    moving: str = option(
        "person,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe",
        "classes that move: tracked, but without ellipsoid",
    )


def fitter(
    config: ObjectsConfig, poses: Poses, class_names: Sequence[str]
) -> Callable[[Views, list[int]], Any]:
    """Bind priors, scale and gravity to `quadrics.fit_objects`."""
    priors = quadrics.load_priors(config.priors or None)
    known = parse_known_size(config.known_size)
    up = parse_up(config.up) if config.up else poses.up_in_world
    support = None if config.support == "auto" else config.support

    def fit(views: Views, classes: list[int]) -> Any:
        categories = [class_names[c] if c < len(class_names) else "" for c in classes]
        return quadrics.fit_objects(
            views.boxes, views.img_from_world, views.image_size, categories, priors, up=up,
            support=support, score=views.score, metric=poses.metric, known_size=known,
        )  # fmt: skip

    return fit


def parse_up(text: str) -> Array:
    """Parse a direction x,y,z into a unit vector (3,)."""
    try:
        up = np.array([float(x) for x in text.split(",")])
    except ValueError:
        up = np.empty(0)
    if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
        raise ReobjError(f"--set objects.up={text}: expected a direction x,y,z, such as 0,0,1")
    return np.asarray(up / np.linalg.norm(up))


def parse_known_size(text: str) -> dict[str | int, tuple[str | int, float]]:
    """Parse 'chair=0.82m,door=2.0m' into heights in metres by category.

    >>> parse_known_size("door=2.0m, chair=82cm")
    {'door': ('h', 2.0), 'chair': ('h', 0.82)}
    """
    per_metre = {"m": 1, "cm": 100, "mm": 1000}
    sizes: dict[str | int, tuple[str | int, float]] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        found = re.fullmatch(r"(.+?)\s*=\s*([0-9.]+)\s*(m|cm|mm)", item)
        if found is None:
            expected = "CATEGORY=HEIGHT in m, cm or mm, such as door=2.0m"
            raise ReobjError(f"--known-size {item!r}: expected {expected}")
        sizes[found[1]] = ("h", float(found[2]) / per_metre[found[3]])
    return sizes


def object_entries(
    table: Tracks,
    class_names: Sequence[str],
    fits: Any,
    views: Views | None,
    config: ObjectsConfig,
) -> list[dict[str, Any]]:
    """Entries of objects.json, one an object."""
    entries, moving, iou = [], set(config.moving.split(",")), np.empty(0)
    if views is not None:
        seen = (views.boxes, views.img_from_world, views.image_size)
        iou = quadrics.reprojection_iou(fits, *seen)  # (V, O)
    for i, (obj, cls) in enumerate(object_classes(table).items()):
        rows = table[table.track_id == obj]
        entry: dict[str, Any] = dict.fromkeys(OBJECT_FIELDS)
        name = class_names[cls] if 0 <= cls < len(class_names) else "object"
        entry |= {
            "id": obj,
            "class": name,
            "score": round(float(rows.score.mean()), 4),
            "status": "rejected",
            "reason": "no camera poses",
            "views": 0,
            "frames_seen": len(np.unique(rows.frame)),
            "dropped_boxes": 0,
            "tracks": np.unique(rows.tracklet_id).tolist(),
            "frames": _spans_of(rows),
        }
        if fits is not None and views is not None:
            _add_fit(entry, fits, i, views, iou[:, i])
            if name in moving:
                _reject(entry, "objects of this class move")
            elif (count := entry["views"]) < config.min_views:
                seen_in = f"seen in {count} frame{'s' * (count != 1)} with a camera pose"
                _reject(entry, f"{seen_in}; {config.min_views} are needed")
        entries.append(entry)
    return entries


def _add_fit(entry: dict[str, Any], fits: Any, i: int, views: Views, iou: Array) -> None:
    """Add the solid, its uncertainty and its evidence to an entry."""
    solid, scale = fits.ellipsoids, fits.scale
    seen = np.isfinite(views.boxes[:, i, 0])
    entry |= {
        "status": str(fits.status[i]),
        "reason": str(fits.reason[i]),
        "support": str(fits.support[i]),
        "views": int(seen.sum()),
        "dropped_boxes": int((seen & ~fits.inlier[:, i]).sum()),
        "parallax_deg": rounded(fits.parallax_deg[i], 2),
        "reprojection_iou_median": rounded(np.median(iou[seen]), 3) if seen.any() else None,
    }
    if entry["status"] != "rejected":
        size = fits.size[i]
        entry |= {
            "center": numbers(solid.center_in_world[i]),
            "half_axes": numbers(solid.half_axes[i]),
            "quat_wxyz": numbers(quat_wxyz_from_matrix(solid.world_from_obj[i : i + 1])[0]),
            "size": numbers(size),
            "cov": [numbers(row) for row in fits.cov[i]],
            "size_m": numbers(size * scale.value) if scale.source != "none" else None,
            "size_rel_sigma": numbers(np.sqrt(np.diag(fits.cov[i])[3:6] + scale.rel_sigma**2)),
        }


def _reject(entry: dict[str, Any], reason: str) -> None:
    entry |= dict.fromkeys(SOLID_FIELDS) | {"support": None}
    entry |= {"status": "rejected", "reason": reason}


def _spans_of(rows: Tracks) -> list[list[int]]:
    """First and last frame of every tracklet, by time."""
    frames = [rows.frame[r] for r in rows_by(rows.tracklet_id)]
    return sorted([int(f.min()), int(f.max())] for f in frames)


def world_entry(poses: Poses | None, fits: Any, events: Sequence[LinkEvent]) -> dict[str, Any]:
    """The "world" of objects.json: units, gravity, scale, registered frames, joins and splits."""
    links = [dataclasses.asdict(event) for event in events]
    if poses is None:
        return {"units": None, "source": "none", "registered_frames": 0, "links": links}
    scale = None
    if fits is not None:
        scale = {
            "metres_per_unit": rounded(fits.scale.value, 6),
            "rel_sigma": rounded(fits.scale.rel_sigma, 4),
            "source": fits.scale.source,
        }
    up = fits.up if fits is not None and fits.up.any() else poses.up_in_world
    return {
        "units": "m" if poses.metric else "arbitrary",
        "source": poses.source,
        "registered_frames": int(poses.known.sum()),
        "interpolated_frames": int((poses.status == "interpolated").sum()),
        "frames": len(poses.frame),
        "up_in_world": None if up is None else numbers(up),
        "up_source": fits.up_source if fits is not None else "none" if up is None else "poses",
        "scale": scale,
        "links": links,
    }
