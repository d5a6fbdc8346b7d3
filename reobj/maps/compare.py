"""Decide for every object of a map and of a recording: stayed, moved, gone, not seen, or new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reobj.maps.fusion import ObjectState
from reobj.types import Array, Floats


@dataclass(frozen=True, slots=True, eq=False)
class FoundObject:
    """An object of the recording, in the world of the map.

    Attributes:
        id: identity in the recording. classes: weight of each class (sum of detection scores).
        support, center, half_axes, quat_wxyz, cov: shape as in `reobj.maps.room_map.Observation`.
        foreground, background: mean unit embeddings; empty: none.
        views: detections. confidence: probability that it exists.
        motion_of: numbers of map objects whose own points were recognised on this object, with the
            number of inliers of the rigid motion that they agree on.
    """

    id: int
    classes: dict[str, float]
    support: str
    center: Array
    half_axes: Array
    quat_wxyz: Array
    cov: Array
    foreground: Floats
    background: Floats
    views: int
    confidence: float
    motion_of: dict[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """How the cameras of the recording saw the places of the N objects of the map.

    Views less than 10 degrees apart fail together and count once.

    Attributes:
        expected: (N,) independent views in which the object would be in the image and unoccluded.
        seen_through: (N,) of those, views with a sparse point behind the object on a ray through
            its middle.
    """

    expected: Array
    seen_through: Array


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What happened to an object of the map, or of the recording.

    Attributes:
        kind: "stayed", "moved", "gone", "not_seen" (objects of the map) or "new".
        map_id: number in the map; 0: new. found_id: identity in the recording; 0: not detected.
        log_odds: of this decision over the best other one, in nats.
        candidates: numbers of the map that are as probable within the margin.
        evidence: one sentence.
    """

    kind: str
    map_id: int
    found_id: int
    log_odds: float
    candidates: tuple[int, ...]
    evidence: str


def compare(
    states: Sequence[ObjectState],
    found: Sequence[FoundObject],
    visibility: Visibility,
    alignment_cov: Array,
    metres_per_unit: float,
    same_embedder: bool,
) -> list[Decision]:
    """Decide what happened to each object, by one assignment over all of them.

    Args:
        states: N objects of the map. found: M objects of the recording.
        alignment_cov: (7, 7) of rotation vector, translation and log scale of the alignment.
        metres_per_unit: of the world of the map (its best estimate if the scale is unknown).
        same_embedder: embeddings of map and recording come from one model.
    """
    raise NotImplementedError


def no_visibility(count: int) -> Visibility:
    """Return the visibility of N objects that no view passed."""
    return Visibility(np.zeros(count), np.zeros(count))
