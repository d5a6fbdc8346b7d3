"""Association: jointly estimate the objects, their shapes and the detection-to-object assignment.

The objective is a sum of log odds (`likelihood`): of every detection with its object, against every
frame that should show an object and does not, and against every object. It is maximised by
alternating steps.

 1. select   greedily from many hypotheses those that explain most of what is not yet explained
             (at most one detection per frame counts for an object; further overlapping ones are
             free, since detectors emit duplicates and boxes of object parts)
 2. assign   in every frame each detection to at most one object and back; tracklets stay together
 3. refit    each shape to its unambiguous detections
 4. prune    objects with negative marginal gain, as others take over their detections
 5. merge    two objects if one explains the detections of both
 6. widen    refit, ignoring the unreliable edges of boxes that end above the floor
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from reobj.objects.likelihood import Evidence, PosedDetections, Shapes, gather_evidence
from reobj.types import Array, BoolArray, IntArray

# Log odds unless a unit is given; measured on hololens_kitchen and redkitchen
# (benchmarks/RESULTS.md).
MISSED = 0.5  # against an object, for each frame in which it is expected and not detected
NEW_OBJECT = 10.0  # against each object: needs agreeing detections in at least three frames
SAME_TRACKLET = 2.5  # for the object of the previous or next detection of the tracklet
# Of a pair of an object and a detection that is kept: below it the detection is not assigned, even
# if both of its neighbours in the tracklet are
MIN_LOG_ODDS = -6.0
# Largest gain by a better box in step 1: without it a compromise between two objects goes first
MAX_BOX_GAIN = 1.5
# Over the runner-up, that a detection needs to take part in refitting (1 and 4 gain less)
UNAMBIGUOUS_MARGIN = 2.0
MERGE_DISTANCE = 1.5  # of the centres to merge, over the sum of the mean half widths
# Half extents of an object, along its axes; one with its centre nearer than this is a duplicate or
# a part of it, whatever the evidence for two (.4 to .6 are alike but for deimv2-femto)
SAME_POSITION = 0.5
# Largest difference of mean log sizes to merge objects of different classes (laptop and tv)
SIMILAR_LOG_SIZE = float(np.log(1.4))
MIN_DETECTIONS = 3  # of an object; fewer do not determine it
MAX_ROUNDS = 10  # of steps 2 to 5, if no state is repeated before; bounds the time
WIDENING_ROUNDS = 2  # of step 6: more, and wide shapes take over neighbours


# detections (K,), the object of each (K,), the classes (O,) of the objects, their current shapes if
# box edges above the floor are to be ignored (else None) -> O shapes
FitShapes = Callable[[IntArray, IntArray, IntArray, Shapes | None], Shapes]
SizeLogOdds = Callable[[Shapes], Array]  # (O,) of the sizes by the categories


@dataclass(frozen=True, slots=True)
class Association:
    """Objects and the detections assigned to them.

    Attributes:
        shapes: of O objects. label: (N,) object of each detection, or -1.
        evidence: of the objects. size_log_odds: (O,) by the categories.
    """

    shapes: Shapes
    label: IntArray
    evidence: Evidence
    size_log_odds: Array

    @property
    def count(self) -> IntArray:
        """(O,) detections of each object."""
        return np.bincount(self.label[self.label >= 0], minlength=len(self.shapes))

    @property
    def assigned_pairs(self) -> BoolArray:
        """(M,) pairs of the evidence whose detection is assigned to their object."""
        return np.asarray(self.label[self.evidence.row] == self.evidence.obj)

    def gains(self, detections: PosedDetections) -> Array:
        """Return the log odds (O,) of each object: its detections, missed frames and size."""
        pairs = self.assigned_pairs
        obj = self.evidence.obj[pairs]
        row = self.evidence.row[pairs]
        hit = MISSED * self.evidence.expected[detections.view[row], obj]
        gain = np.bincount(obj, self.evidence.existence[pairs] + hit, len(self.shapes))
        return np.asarray(gain - self.costs())

    def unambiguous(self) -> BoolArray:
        """Mark detections (N,) that fit their object clearly better than any other.

        All detections of an object with fewer than `min_detections` such detections are marked.
        """
        evidence = self.evidence
        assigned = self.label >= 0
        pairs = self.assigned_pairs
        best, runner_up = np.full((2, len(assigned)), -np.inf)
        best[evidence.row[pairs]] = evidence.assignment[pairs]
        np.maximum.at(runner_up, evidence.row[~pairs], evidence.assignment[~pairs])
        clear = assigned & (runner_up < best - UNAMBIGUOUS_MARGIN)
        count = np.bincount(self.label[clear], minlength=len(self.shapes) + 1)
        few = count < MIN_DETECTIONS
        return np.asarray(clear | assigned & few[self.label])

    def costs(self) -> Array:
        """Return the log odds (O,) against each object without any detection."""
        missed = MISSED * self.evidence.expected.sum(0)
        return np.asarray(missed + NEW_OBJECT - self.size_log_odds)


@dataclass(slots=True)
class Associator:
    """Estimate the objects of a scene and assign the detections to them.

    Args:
        detections: of all frames. fit_shapes: fits shapes to detections. size_log_odds: of shapes
            by the size priors of their categories.
    """

    detections: PosedDetections
    fit_shapes: FitShapes
    size_log_odds: SizeLogOdds

    def run(self, hypotheses: Shapes, floor_known: bool) -> Association:
        """Select among hypotheses, then alternate between assignment and shapes."""
        selected = self._select_greedily(self._unassigned(hypotheses, 0.0))
        current = self.assign(hypotheses[selected], np.full(len(self.detections.view), -1))
        visited = {current.label.tobytes()}
        for _ in range(MAX_ROUNDS):
            for step in (self._refit, self._prune, self._merge):
                current = step(current)
            if (state := current.label.tobytes()) in visited:
                break
            visited.add(state)
        # last, as wide shapes take over the detections of their neighbours
        for _ in range(WIDENING_ROUNDS if floor_known else 0):
            current = self._refit(current, widen=True)
        return current

    def _unassigned(self, shapes: Shapes, min_log_odds: float = MIN_LOG_ODDS) -> Association:
        """Gather the evidence of shapes without any assigned detection."""
        evidence = gather_evidence(shapes, self.detections, min_log_odds)
        return self._association(shapes, np.full_like(self.detections.view, -1), evidence)

    def _association(self, shapes: Shapes, label: IntArray, evidence: Evidence) -> Association:
        """Make the association of shapes with this label of each detection."""
        return Association(shapes, label, evidence, self.size_log_odds(shapes))

    def _select_greedily(self, hypotheses: Association) -> IntArray:
        """Select hypotheses greedily: each gains most beside the ones selected before.

        Returns:
            the selected hypotheses, the best first.
        """
        view = self.detections.view
        evidence = hypotheses.evidence
        cost = hypotheses.costs()
        value = np.minimum(evidence.assignment, evidence.existence + MAX_BOX_GAIN)
        positive = value > 0
        obj = evidence.obj[positive]
        row = evidence.row[positive]
        log_odds = value[positive]
        start = np.searchsorted(obj, np.arange(len(cost) + 1))
        expected = evidence.expected  # (V, O)
        explained = np.zeros(len(view))  # log odds of each row
        selected = list[int]()

        def marginal_gain(k: int) -> float:
            """Return the gain of adding hypothesis k, with its best detection of each frame."""
            rows = row[start[k] : start[k + 1]]
            best = np.zeros(len(expected))
            np.maximum.at(best, view[rows], log_odds[start[k] : start[k + 1]] - explained[rows])
            hits = np.count_nonzero(expected[best > 0, k])
            return float(best.sum() + MISSED * hits - cost[k])

        # The marginal gain only decreases as others are selected: a hypothesis that still leads
        # after its gain was updated is the best (lazy greedy, Minoux 1978).
        queue = [(-marginal_gain(k), k) for k in range(len(cost))]
        heapq.heapify(queue)
        while queue and queue[0][0] < 0:
            k = queue[0][1]
            gain = marginal_gain(k)
            if -gain > queue[0][0]:
                heapq.heapreplace(queue, (-gain, k))
                continue
            heapq.heappop(queue)
            selected.append(k)
            rows = row[start[k] : start[k + 1]]
            explained[rows] = np.maximum(explained[rows], log_odds[start[k] : start[k + 1]])
        return np.array(selected, np.int64)

    def assign(self, shapes: Shapes, label: IntArray) -> Association:
        """Assign detections to objects frame by frame, given the neighbours in their tracklets.

        Args:
            label: (N,) initial object of each detection, or -1.
        """
        detections = self.detections
        evidence = gather_evidence(shapes, detections, MIN_LOG_ODDS)
        has_evidence = np.bincount(evidence.row, minlength=len(label)) > 0
        label = np.where(has_evidence, label, -1)
        expected = evidence.expected[detections.view[evidence.row], evidence.obj]
        value = evidence.assignment + MISSED * expected
        order = np.argsort(evidence.row, kind="stable")
        starts = np.searchsorted(evidence.row[order], detections.start_of_view)
        for low, high in itertools.pairwise(starts):
            pairs = order[low:high]
            obj = evidence.obj[pairs]
            row = evidence.row[pairs]
            gain = value[pairs]
            for neighbour in (detections.before[row], detections.after[row]):
                same = (neighbour >= 0) & (label[neighbour] == obj)
                gain = gain + SAME_TRACKLET * same
            label[row] = -1
            unique_obj, i = np.unique(obj, return_inverse=True)
            unique_row, j = np.unique(row, return_inverse=True)
            table = np.zeros((len(unique_obj), len(unique_row)))
            table[i, j] = gain.clip(0)
            i, j = linear_sum_assignment(table, maximize=True)
            good = table[i, j] > 0
            label[unique_row[j[good]]] = unique_obj[i[good]]
        return self._association(shapes, label, evidence)

    def _refit(self, current: Association, widen: bool = False) -> Association:
        """Fit the shapes to their unambiguous detections, in the majority class of all of theirs.

        Args:
            widen: ignore the unreliable edges of boxes that end above the floor.
        """
        assigned = np.flatnonzero(current.label >= 0)
        rows = np.flatnonzero(current.unambiguous())
        class_id = self.detections.class_id[assigned].clip(0)
        votes = np.zeros((len(current.shapes), int(class_id.max(initial=0)) + 1))
        np.add.at(votes, (current.label[assigned], class_id), self.detections.score[assigned])
        classes = np.where(votes.any(1), votes.argmax(1), current.shapes.class_id)
        fitted = self.fit_shapes(
            rows, current.label[rows], classes, current.shapes if widen else None
        )
        succeeded = np.isfinite(fitted.ellipsoids.center_in_world).all(1)
        both = Shapes.concatenate([current.shapes, fitted])
        pick = np.arange(len(fitted)) + np.where(succeeded, len(fitted), 0)
        return self.assign(both[pick], current.label)

    def _prune(self, current: Association) -> Association:
        """Prune objects with negative marginal gain, as others take over their detections.

        Only the worse half (by box fit) is removed per round, because each of two duplicates is
        redundant given the other.
        """
        evidence = current.evidence
        label = current.label
        view = self.detections.view
        assigned = label >= 0
        pairs = current.assigned_pairs
        shown = np.zeros_like(evidence.expected)
        shown[view[assigned], label[assigned]] = True
        other = assigned[evidence.row] & ~pairs
        row = evidence.row[other]
        obj = evidence.obj[other]
        missed = evidence.expected & ~shown
        hit = MISSED * missed[view[row], obj]

        def best_of_others(value: Array) -> Array:
            """Return the gain (O,) if the best other objects take over the detections of each."""
            best = np.zeros(len(label))
            np.maximum.at(best, row, value[other] + hit)
            gain = np.bincount(label[assigned], best[assigned], len(current.shapes))
            return np.asarray(gain, np.float64)

        marginal = current.gains(self.detections) - best_of_others(evidence.existence)  # (O,)
        fit = np.bincount(evidence.obj[pairs], evidence.assignment[pairs], len(current.shapes))
        advantage = fit - best_of_others(evidence.assignment)  # (O,)
        weak = np.flatnonzero((marginal < 0) | (current.count < MIN_DETECTIONS))
        worst = weak[np.argsort(advantage[weak])][: (len(weak) + 1) // 2]
        return self._remove(current, worst) if len(worst) else current

    def _remove(self, current: Association, removed: IntArray) -> Association:
        """Remove some of the objects and assign again."""
        keep = np.setdiff1d(np.arange(len(current.shapes)), removed)
        number = np.full(len(current.shapes) + 1, -1)
        number[keep] = np.arange(len(keep))
        return self.assign(current.shapes[keep], number[current.label])

    def _merge(self, current: Association) -> Association:
        """Merge pairs of nearby objects if one object explains the detections of both."""
        gain = current.gains(self.detections)
        strong, weak = _near_pairs(current.shapes, gain)
        if not len(strong):
            return current
        row, pair = self._joint_rows(current.label, strong, weak)
        fitted = self.fit_shapes(row, pair, current.shapes.class_id[strong], None)
        more = self._joint_gains(current.label, strong, weak, fitted) - gain[strong] - gain[weak]
        duplicate = _coincide(current.shapes)[strong, weak]
        more[duplicate & np.isfinite(more)] = np.inf
        pick = np.arange(len(current.shapes))
        removed = set[int]()
        label = current.label.copy()
        for p in np.argsort(-more):
            i = int(strong[p])
            j = int(weak[p])
            untouched = pick[i] == i and pick[j] == j and not {i, j} & removed
            if more[p] > 0 and untouched:
                pick[i] = len(current.shapes) + p
                removed.add(j)
                label[row[pair == p]] = i
        if not removed:
            return current
        both = Shapes.concatenate([current.shapes, fitted])
        merged = replace(current, shapes=both[pick], label=label)
        return self._remove(merged, np.array(sorted(removed), np.int64))

    def _joint_rows(
        self, label: IntArray, strong: IntArray, weak: IntArray
    ) -> tuple[IntArray, IntArray]:
        """List the rows of both objects of each pair, one per frame: rows (K,), pairs (K,)."""
        view = self.detections.view
        rows_of_pair = list[IntArray]()
        for i, j in zip(strong, weak, strict=True):
            rows = np.flatnonzero(label == i)
            other = np.flatnonzero(label == j)
            rows_of_pair.append(np.append(rows, other[~np.isin(view[other], view[rows])]))
        pair = np.repeat(np.arange(len(strong)), [len(rows) for rows in rows_of_pair])
        return np.concatenate(rows_of_pair), pair

    def _joint_gains(
        self, label: IntArray, strong: IntArray, weak: IntArray, fitted: Shapes
    ) -> Array:
        """Return the gain (P,) of one fitted object with the detections of each pair."""
        view = self.detections.view
        joint = self._unassigned(fitted)
        evidence = joint.evidence
        row_label = label[evidence.row]
        pairs = (row_label == strong[evidence.obj]) | (row_label == weak[evidence.obj])
        obj = evidence.obj[pairs]
        row = evidence.row[pairs]
        log_odds = evidence.existence[pairs]
        key = obj * len(evidence.expected) + view[row]
        order = np.lexsort((-log_odds, key))
        best_of_frame = np.zeros(len(key), bool)  # of its object
        best_of_frame[order] = np.append(True, np.diff(key[order]) != 0)[: len(key)]
        hit = MISSED * evidence.expected[view[row], obj]
        worth = log_odds + hit * best_of_frame
        gain = np.bincount(obj, worth.clip(0), len(strong)) - joint.costs()
        return np.where(np.isfinite(fitted.ellipsoids.center_in_world).all(1), gain, -np.inf)


def _coincide(shapes: Shapes) -> BoolArray:
    """Mark pairs (O, O) of shapes in one position, where no two objects can be.

    The smaller has its centre in the middle of the larger: a part of the object, or a duplicate.
    """
    centre = shapes.ellipsoids.center_in_world
    half = shapes.ellipsoids.half_axes
    a_in_b = np.einsum("abi,bij->abj", centre[:, None] - centre, shapes.ellipsoids.world_from_obj)
    inside = (np.abs(a_in_b) < SAME_POSITION * half).all(2)  # (O, O) a's centre in the middle of b
    volume = half.prod(1)
    inside &= volume[:, None] <= volume
    return np.asarray(inside | inside.T, bool)


def _near_pairs(shapes: Shapes, gain: Array) -> tuple[IntArray, IntArray]:
    """List pairs (P,) of nearby shapes, the one of larger gain first.

    They have one class, or similar sizes and one position.
    """
    centre = shapes.ellipsoids.center_in_world
    half = shapes.ellipsoids.half_axes
    distance = np.linalg.norm(centre[:, None] - centre, axis=2)  # (O, O)
    width = half[:, :2].mean(1)
    near = distance < MERGE_DISTANCE * (width[:, None] + width)
    size = np.log(half).mean(1)
    similar = np.abs(size[:, None] - size) < SIMILAR_LOG_SIZE
    similar &= _coincide(shapes)
    same_class = shapes.class_id[:, None] == shapes.class_id
    a, b = np.nonzero(np.triu(near & (same_class | similar), 1))
    first = gain[a] >= gain[b]
    return np.where(first, a, b), np.where(first, b, a)
