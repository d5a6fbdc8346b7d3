"""Current state of the map: each object fused from its observations, and the scale of the world."""

from __future__ import annotations

from dataclasses import dataclass

from reobj.maps.room_map import MapObject, RoomMap
from reobj.types import Array, Floats


@dataclass(frozen=True, slots=True, eq=False)
class ObjectState:
    """What the map knows of an object after its last session.

    Attributes:
        id: number. class_name: given by the user, or the one with the largest weight.
        classes: weight of each class, over all sessions.
        present: False if it was gone in the last session that saw its place.
        deleted: by the user.
        support, center, half_axes, quat_wxyz, cov: shape as in `Observation`, with the uncertainty
            of the alignment of the sessions; the place where it was last seen.
        foreground, background: mean unit embeddings of one model (`embedder`); empty: none.
        detection_rate: probability of a detection in a view in which it is expected.
        log_odds: that it is a real object.
        last_seen: number of the last session in which it was detected.
    """

    id: int
    class_name: str
    classes: dict[str, float]
    present: bool
    deleted: bool
    support: str
    center: Array
    half_axes: Array
    quat_wxyz: Array
    cov: Array
    foreground: Floats
    background: Floats
    embedder: str
    detection_rate: float
    log_odds: float
    last_seen: int


def object_state(found: MapObject, room: RoomMap) -> ObjectState:
    """Fuse the observations of an object."""
    raise NotImplementedError
