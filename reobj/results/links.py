"""Identities of the detections of a recording: kept in the output folder, so that a refit has them.

An identity keeps its number: a refit with other options of the fit uses the same identities. If
detections are linked again, identities get the numbers of earlier ones by the boxes they share.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

import quadrics
from reobj.cameras import Poses
from reobj.files import columns_of, from_columns, load_npz, save_npz
from reobj.types import Existence, IntArray, LinkEvent, ReobjError, Tracks

SAME_PX = 0.02  # between a box and the same one: twice the rounding of tracks.txt


class ComponentShapes(NamedTuple):
    """Shapes by which the detections of a component were associated.

    Attributes:
        floor: or None. ellipsoids: (O + 1,) of the objects, and NaN at the end.
    """

    floor: quadrics.Floor | None
    ellipsoids: quadrics.Ellipsoids


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Tracks with the identities of objects, of one or of all components, before edits.

    Attributes:
        tracks: N rows. source: (N,) row of the result's tracks, -1: an untracked detection.
        category: (N,) class whose size prior is used.
        events: joins and splits. confidence: of identities.
        shapes: of each component, None where no association was made. label_of: number of the
            object in these of an identity.
        number: (N,) identity of each row after edits, and in a map; 0: deleted.
        highest: number that an identity of the folder ever had.
        options: of the objects stage when they were linked. key: of the tracks and cameras
            (`tracked_key`).
        in_map: numbers that the map of the recording gave to some of its identities.
        before: numbers in the last result of the folder; none before a refit. changed: how many
            identities of the last result have other boxes, as the detections were linked again.
    """

    tracks: Tracks
    source: IntArray
    category: IntArray
    events: list[LinkEvent] = field(default_factory=list)
    confidence: dict[int, float] = field(default_factory=dict)
    shapes: list[ComponentShapes | None] = field(default_factory=list)
    label_of: dict[int, int] = field(default_factory=dict)
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    highest: int = 0
    options: Mapping[str, Any] = field(default_factory=dict)
    key: str = ""
    in_map: frozenset[int] = frozenset()
    before: frozenset[int] = frozenset()
    changed: int = 0

    def renumbered(self, numbers: Mapping[int, int]) -> Links:
        """Return the links with other numbers of identities, which must differ.

        An identity without a new number keeps its own one unless another identity gets it.
        """
        taken = set(numbers.values())
        own = {*np.unique(self.tracks.track_id).tolist(), *np.unique(self.number).tolist()} - {0}
        new = dict(numbers)
        free = max([self.highest, *taken, *own]) + 1
        for identity in sorted(own - new.keys()):
            new[identity] = identity
            if identity in taken:
                new[identity] = free
                free += 1
        return dataclasses.replace(
            self,
            tracks=dataclasses.replace(self.tracks, track_id=_mapped(self.tracks.track_id, new)),
            number=_mapped(self.number, new),
            in_map=frozenset(new.get(i, i) for i in self.in_map),
            confidence={new[i]: value for i, value in self.confidence.items()},
            label_of={new[i]: label for i, label in self.label_of.items()},
            highest=max([self.highest, *new.values()]),
        )

    def keep_numbers_of(self, last: Links) -> Links:
        """Number identities as those of the last result with which they share most boxes.

        The assignment is one to one, with most shared boxes in all. Identities without an earlier
        one get numbers that none had.
        """
        row = last.rows_of(self.tracks)
        new, new_of_row = np.unique(self.tracks.track_id, return_inverse=True)
        old, old_of_row = np.unique(last.tracks.track_id, return_inverse=True)
        shared = np.zeros((len(new), len(old)))
        np.add.at(shared, (new_of_row[row >= 0], old_of_row[row[row >= 0]]), 1)
        pairs = zip(*linear_sum_assignment(-shared), strict=True)
        numbers = {int(new[i]): int(old[j]) for i, j in pairs if shared[i, j]}
        free = itertools.count(last.highest + 1)
        numbers |= {i: next(free) for i in new.tolist() if i not in numbers}
        made = self.renumbered(numbers)
        return dataclasses.replace(
            made,
            in_map=last.in_map,
            highest=max([last.highest, *numbers.values()]),
            changed=last.count_changed(made.tracks, row),
        )

    def rows_of(self, tracks: Tracks) -> IntArray:
        """Return the row of the same detection (M,) of each row of `tracks`; -1: none."""
        if not len(self.tracks):
            return np.full(len(tracks), -1)
        own, others = (
            np.column_stack([t.frame, t.xyxy, t.detection_index]) for t in (self.tracks, tracks)
        )
        row = cKDTree(own).query(others, p=np.inf, distance_upper_bound=SAME_PX)[1]
        return np.where(row < len(own), row, -1)

    def count_changed(self, tracks: Tracks, row: IntArray) -> int:
        """Count the identities of these links that have other detections in `tracks`.

        Args:
            row: (M,) of the same detection here, or -1.
        """
        own = self.tracks.track_id
        kept = np.append(own, -1)[row] == tracks.track_id  # (M,)
        changed = {*np.delete(own, row[kept]).tolist(), *tracks.track_id[~kept].tolist()}
        return len(changed.intersection(own.tolist()))


def _mapped(identity: IntArray, numbers: Mapping[int, int]) -> IntArray:
    """Return the new numbers (N,) of identities (N,); 0 stays."""
    return np.array([numbers[i] if i else 0 for i in identity.tolist()], np.int64)


def tracked_key(tables: Sequence[Tracks], poses: Poses | None) -> str:
    """Hash the tables of tracks before linking, and the cameras."""
    arrays = [array for table in tables for array in columns_of(table).values()]
    if poses is not None:
        arrays += [poses.cam_from_world, poses.part]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()


# ---- File --------------------------------------------------------------------------------------


def save_links(links: Links, path: Path) -> None:
    """Write links as npz."""
    arrays = columns_of(links.tracks)
    arrays |= {name: getattr(links, name) for name in ("source", "category", "number")}
    for name in ("confidence", "label_of"):
        arrays[f"{name}_id"] = np.array(list(getattr(links, name)), np.int64)
    arrays["label_of"] = np.array([*links.label_of.values()])
    evidence = [_evidence_row(value) for value in links.confidence.values()]
    arrays["confidence"] = np.reshape(np.array(evidence, np.float64), (-1, 4))
    floors = []
    for k, shapes in enumerate(links.shapes):
        floor = None if shapes is None else shapes.floor
        floors.append(None if floor is None else (floor.normal.tolist(), *floor[1:]))
        if shapes is not None:
            arrays |= columns_of(shapes.ellipsoids, f"{{}}_{k}")
    facts = {name: getattr(links, name) for name in ("highest", "options", "key")}
    events = [dataclasses.asdict(event) for event in links.events]
    save_npz(path, arrays, events=events, floors=floors, in_map=sorted(links.in_map), **facts)


def _evidence_row(value: float) -> tuple[float, float, float, float]:
    """Return a confidence and its evidence; NaN where it was given by hand."""
    if isinstance(value, Existence):
        return float(value), value.score, value.hit_rate, value.see_through
    return value, np.nan, np.nan, np.nan


def load_links(path: Path) -> Links:
    """Read what `save_links` wrote.

    Raises:
        ReobjError: damaged, or of another version.
    """
    data, facts = load_npz(path, sealed=True)
    try:
        label_of = dict(zip(data["label_of_id"].tolist(), data["label_of"].tolist(), strict=True))
        confidence = {
            identity: row[0] if np.isnan(row[1]) else Existence(*row)
            for identity, row in zip(
                data["confidence_id"].tolist(), data["confidence"].tolist(), strict=True
            )
        }
        shapes = list[ComponentShapes | None]()
        for k, values in enumerate(facts["floors"]):
            floor = values and quadrics.Floor(np.array(values[0]), *values[1:])
            shapes.append(None)
            if f"half_axes_{k}" in data:
                ellipsoids = from_columns(quadrics.Ellipsoids, data, f"{{}}_{k}")
                shapes[k] = ComponentShapes(floor, ellipsoids)
        events = [LinkEvent(**e | {"tracklets": tuple(e["tracklets"])}) for e in facts["events"]]
        return Links(
            from_columns(Tracks, data),
            data["source"],
            data["category"],
            events,
            confidence,
            shapes,
            label_of,
            data["number"],
            facts["highest"],
            facts["options"],
            facts["key"],
            in_map=frozenset(facts["in_map"]),
            before=frozenset(data["number"].tolist()) - {0},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ReobjError(f"{path}: written by another version ({error})") from error
