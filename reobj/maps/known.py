"""What a tracker knows of the objects of a map before the first frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import quadrics
from reobj.maps.fusion import ObjectState
from reobj.maps.visibility import shapes_of
from reobj.tracking.ellipsoid_map import EllipsoidMap
from reobj.types import Embeddings, IntArray
from reobj.words import meant


def class_ids(states: Sequence[ObjectState], class_names: Sequence[str]) -> IntArray:
    """Return the class id (N,) of each object: of its likeliest class in the names, -1: none."""
    found = [[k for word in (s.class_name, *s.classes) for k in meant(word, class_names)[:1]]
             for s in states]  # fmt: skip
    return np.array([ids[0] if ids else -1 for ids in found], np.int64)


def ellipsoid_map_of(states: Sequence[ObjectState]) -> EllipsoidMap:
    """Return the ellipsoids of objects, inscribed in their shapes; unknown of objects now gone."""
    made = EllipsoidMap()
    if states:
        shapes = shapes_of(states)
        present = np.array([s.present for s in states])
        center = np.where(present[:, None], shapes.center_in_world, np.nan)
        ellipsoids = quadrics.Ellipsoids(center, shapes.half_axes, shapes.world_from_obj)
        made.give(ellipsoids, np.array([s.cov[:3, :3] for s in states]))
    return made


def embeddings_of(states: Sequence[ObjectState], embedder: str) -> tuple[IntArray, Embeddings]:
    """Return the mean embeddings of the objects that have some of an embedder.

    Args:
        embedder: key of the model. "": none.
    Returns:
        rows (n,) of the objects, and their embeddings; zeros for a background that is missing.
    """
    rows = [k for k, s in enumerate(states) if embedder and s.embedder == embedder]
    rows = [k for k in rows if states[k].foreground.size]
    fore = [states[k].foreground for k in rows]
    if not rows:
        return np.empty(0, np.int64), Embeddings.empty()
    width = max(states[k].background.size for k in rows)
    back = np.zeros((len(rows), width), np.float32)
    for row, k in enumerate(rows):
        back[row, : states[k].background.size] = states[k].background
    return np.array(rows, np.int64), Embeddings(np.array(fore, np.float32), back)
