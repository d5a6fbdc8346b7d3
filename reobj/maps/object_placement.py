"""Place a recording in a map by its objects, where its images match too few points of the map."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

import quadrics
from reobj.maps.compare import FoundObject, class_names_of, class_shares
from reobj.maps.fusion import ObjectState, object_state, scale_of
from reobj.maps.object_alignment import AlignmentOptions, Landmarks, ObjectAlignment, align
from reobj.maps.placement import ComponentPlacement, Placement, Similarity, joined
from reobj.maps.room_map import RoomMap
from reobj.maps.update import found_objects
from reobj.maps.visibility import shapes_of, visibility_of
from reobj.results.result import Result
from reobj.types import Array


def place_by_objects(
    room: RoomMap,
    result: Result,
    embedder: str,
    placement: Placement,
    options: AlignmentOptions | None = None,
) -> Placement:
    """Place the largest component of a recording in a map by its objects.

    Args:
        result: with the objects of the recording, in its own world. embedder: of the recording.
        placement: by points, refused.
    Returns:
        the placement by objects; or the one given, with the reason why there is none.
    """
    options = options or AlignmentOptions()
    poses = result.poses
    assert poses is not None
    states = [object_state(o, room) for o in room.objects if not o.deleted]
    states = [s for s in states if s.present]
    found = found_objects(result, [o for o in result.located if o.part == 0])
    scale = scale_of(room)
    reason = _unknown(room, result, scale)
    if reason:
        return _refused(placement, reason)
    same_embedder = [s.embedder == embedder for s in states]
    found_scale = result.world.scale
    unit, sigma = _unit(states, found, scale, found_scale)
    turn = _upright(room.up)
    found_turn = _upright(result.world.up_in_world)
    both: list[ObjectState | FoundObject] = [*states, *found]
    names = class_names_of(both)
    width = max((len(o.foreground) for o in both), default=0)
    aligned = align(
        _landmarks(states, turn, scale.value, names, width, same_embedder),
        _landmarks(found, found_turn, unit, names, width, [True] * len(found)),
        sigma,
        options,
    )
    if aligned.reason:
        return _refused(placement, aligned.reason)
    similarity = _in_map(aligned, turn, scale.value, found_turn, unit)
    first = placement.components[0]
    component = ComponentPlacement(similarity, (), first.tried)
    components = (component, *placement.components[1:])
    moved = joined(poses, components, [0])
    seen = visibility_of(states, moved, shapes_of([]), result.looked).expected > 0
    seen[aligned.pairs[:, 1]] = True
    needed = max(options.least, int(np.ceil(options.share * seen.sum())))
    if seen.sum() < options.common or len(aligned.pairs) < needed:
        reason = (
            f"{len(aligned.pairs)} objects coincide with the map, of {int(seen.sum())} in view; "
            f"{needed} of at least {options.common} are needed"
        )
        return _refused(placement, reason)
    message = (
        f"{first.reason}: the recording was placed in the map by {len(aligned.pairs)} objects "
        f"({aligned.rival} coincide in the best other place), which is less exact"
    )
    moved = dataclasses.replace(moved, messages=(*moved.messages, message))
    return Placement(moved, components, by="objects")


def _unknown(room: RoomMap, result: Result, scale: quadrics.Scale) -> str:
    """Say what an alignment by objects lacks; "" if nothing."""
    if room.up is None or result.world.up_in_world is None:
        of = "the map" if room.up is None else "the recording"
        return f"the direction of gravity of {of} is unknown"
    if scale.source == "none":
        return "the scale of the map is unknown"
    return ""


def _refused(placement: Placement, reason: str) -> Placement:
    """Add the reason why a recording cannot be placed by objects either."""
    return dataclasses.replace(placement, refused=f"{placement.refused}; by objects: {reason}")


def _unit(
    states: Sequence[ObjectState],
    found: Sequence[FoundObject],
    scale: quadrics.Scale,
    found_scale: quadrics.Scale | None,
) -> tuple[float, float]:
    """Return metres per unit of the recording, and the sigma of the log ratio of both scales.

    Of an unknown scale (infinite sigma), the value is that with which objects have the sizes of
    those of the map.
    """
    if found_scale is not None and found_scale.source != "none":
        return found_scale.value, float(np.hypot(scale.rel_sigma, found_scale.rel_sigma))
    if not states or not found:
        return 1.0, np.inf
    size = np.median([np.log(s.half_axes).mean() for s in states])
    found_size = np.median([np.log(o.half_axes).mean() for o in found])
    return float(scale.value * np.exp(size - found_size)), np.inf


def _upright(up: Array | None) -> Array:
    """Return the smallest rotation (3, 3) of the upward direction to z."""
    return np.asarray(Rotation.align_vectors([[0.0, 0, 1]], [up])[0].as_matrix())


def _landmarks(
    objects: Sequence[ObjectState | FoundObject],
    turn: Array,
    unit: float,
    names: list[str],
    width: int,
    embedded: Sequence[bool],
) -> Landmarks:
    """Return objects in upright axes and metres.

    Args:
        turn: (3, 3) to these axes. unit: metres. names: of `class_names_of`. width: elements of an
            embedding. embedded: whether the embedding of each object can be compared.
    """
    looks = np.full((len(objects), width), np.nan, np.float32)
    for k, o in enumerate(objects):
        if embedded[k] and len(o.foreground) == width:
            looks[k] = o.foreground
    cov = np.array([o.cov[:3, :3] for o in objects]).reshape(-1, 3, 3)
    half_axes = np.array([o.half_axes for o in objects]).reshape(-1, 3)
    return Landmarks(
        np.array([o.center for o in objects]).reshape(-1, 3) @ turn.T * unit,
        turn @ cov @ turn.T * unit**2,
        class_shares(objects, names),
        np.log(half_axes * unit).mean(1),
        np.array([o.cov[3:6, 3:6].sum() / 9 for o in objects]),
        looks,
    )


def _in_map(
    aligned: ObjectAlignment, turn: Array, unit: float, found_turn: Array, found_unit: float
) -> Similarity:
    """Convert from upright axes and metres to the worlds of the map and of the recording."""
    convert = np.zeros((7, 7))
    convert[:3, :3] = turn.T
    convert[3:6, 3:6] = turn.T / unit
    convert[6, 6] = 1.0
    return Similarity(
        aligned.scale * found_unit / unit,
        turn.T @ aligned.rotation @ found_turn,
        turn.T @ aligned.shift / unit,
        convert @ aligned.cov @ convert.T,
    )
