"""Which detection is of which object: objects and their detections found in turn.

Objects are solids. Which detection is of which solid, where the solids are, and which of them exist
is decided by log odds (`evidence`): of every detection with its solid, against every frame that
should show a solid and does not, and against every solid.

 1. pursue   from many proposed solids choose those that explain most of what is not yet explained
             (in a frame one detection speaks for a solid; others that it explains as well cost
             nothing: detectors box parts, and things twice)
 2. assign   in every frame each detection to at most one solid and back; tracklets stay together
 3. refit    each solid to the detections that are clearly its own
 4. thin     drop solids that bring less than they cost, as others explain their detections too
 5. merge    two solids where one explains the detections of both
 6. widen    refit, but boxes that end above the floor do not tell how wide a thing is
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from reobj.objects.likelihood import MIN_LOG_ODDS, Detected, Evidence, Solids, gather_evidence
from reobj.types import Array, BoolArray, IntArray

# Log odds, chosen on hololens_kitchen and redkitchen (docs/tracking.md).
MISSED = 0.5  # against a solid, for each frame that should show it and has no detection of it
NEW_SOLID = 10.0  # against each solid: three frames and more must speak for it
# What a better box may add in step 1, so that no compromise between two things comes first
PURSUED_CHOICE = 1.5
# A detection tells where its solid is if that explains it so much better than others do (chosen:
# 1 and 4 gain less, docs/trials.md)
CLEARLY = 2.0
KEPT_TRACKLET = 2.5  # for the solid of the detection before or after in the tracklet
MERGE_REACH = 1.5  # merge only solids whose centres are nearer than so many mean half widths
# Half extents of a solid, along its axes; what has its centre nearer to its own is the same thing
# or a part of it, whatever else speaks for two (chosen; .4 to .6 are alike but for deimv2-femto)
COINCIDE = 0.5
ALIKE = float(np.log(1.4))  # of mean sizes; if so, also where the classes differ (laptop and tv)
MIN_DETECTIONS = 3  # of a solid; fewer do not determine it
MAX_ROUNDS = 10  # of steps 2 to 5 (chosen)
WIDENED = 2  # rounds of step 6 (chosen)

# detections (K,), the solid of each (K,), the classes (S,) of the solids, and the solids so far if
# edges of boxes may be hidden by the floor's place (else None) -> S solids
Refit = Callable[[IntArray, IntArray, IntArray, Solids | None], Solids]
SizeLogOdds = Callable[[Solids], Array]  # (S,) of the sizes by the categories


@dataclass(frozen=True, slots=True)
class Association:
    """Solids and the detections that show them.

    Attributes:
        solids: S. owner: (N,) solid of each detection, or -1. evidence: of these solids.
        size_log_odds: (S,) by the categories.
    """

    solids: Solids
    owner: IntArray
    evidence: Evidence
    size_log_odds: Array

    @property
    def count(self) -> IntArray:
        """(S,) detections of each solid."""
        return np.bincount(self.owner[self.owner >= 0], minlength=len(self.solids))

    def gains(self, detected: Detected) -> Array:
        """Return the log odds (S,) of each solid: its detections, missed frames and size."""
        own = self.evidence
        mine = self.owner[own.row] == own.solid
        solid, row = own.solid[mine], own.row[mine]
        worth = own.log_odds[mine] + MISSED * own.expected[detected.view[row], solid]
        return np.asarray(np.bincount(solid, worth, len(self.solids)) - self.costs())

    def clear(self) -> BoolArray:
        """Mark detections (N,) that their solid explains clearly better than any other does.

        Of a solid that has fewer than `MIN_DETECTIONS` such all its detections are marked.
        """
        evidence, owned = self.evidence, self.owner >= 0
        mine = self.owner[evidence.row] == evidence.solid
        own, other = np.full((2, len(owned)), -np.inf)
        own[evidence.row[mine]] = evidence.choice[mine]
        np.maximum.at(other, evidence.row[~mine], evidence.choice[~mine])
        clear = owned & (other < own - CLEARLY)
        few = np.bincount(self.owner[clear], minlength=len(self.solids) + 1) < MIN_DETECTIONS
        return np.asarray(clear | owned & few[self.owner])

    def costs(self) -> Array:
        """Return the log odds (S,) against each solid if nothing showed it."""
        missed = MISSED * self.evidence.expected.sum(0)
        return np.asarray(missed + NEW_SOLID - self.size_log_odds)


class Associator:
    """Find the solids of a scene and their detections.

    Args:
        detected: of all frames. refit: fits solids to detections. size_log_odds: what the
            categories say of sizes.
    """

    def __init__(self, detected: Detected, refit: Refit, size_log_odds: SizeLogOdds) -> None:
        self.detected, self.refit, self.size_log_odds = detected, refit, size_log_odds

    def run(self, proposed: Solids, floor_known: bool) -> Association:
        """Choose among proposed solids, then improve them and their detections in turn."""
        chosen = self._pursue(self._empty(proposed, 0.0))
        now = self._assign(proposed[chosen], np.full(len(self.detected.view), -1))
        known = {now.owner.tobytes()}
        for _ in range(MAX_ROUNDS):
            for step in (self._refitted, self._thinned, self._merged):
                now = step(now)
            if (state := now.owner.tobytes()) in known:
                break
            known.add(state)
        # Not before: wide solids swallow their neighbours.
        for _ in range(WIDENED if floor_known else 0):
            now = self._refitted(now, widened=True)
        return now

    def _empty(self, solids: Solids, least: float = MIN_LOG_ODDS) -> Association:
        """Look at solids of which nothing is a detection yet, by pairs of more than `least`."""
        evidence = gather_evidence(solids, self.detected, least)
        nothing = np.full_like(self.detected.view, -1)
        return Association(solids, nothing, evidence, self.size_log_odds(solids))

    def _pursue(self, of: Association) -> IntArray:
        """Choose solids one by one: each explains most of what those before do not.

        Returns:
            the chosen solids, the best first.
        """
        view, evidence, cost = self.detected.view, of.evidence, of.costs()
        value = np.minimum(evidence.choice, evidence.log_odds + PURSUED_CHOICE)
        positive = value > 0
        solid, row, log_odds = evidence.solid[positive], evidence.row[positive], value[positive]
        start = np.searchsorted(solid, np.arange(len(cost) + 1))
        not_missed = MISSED * evidence.expected  # (V, S)
        explained, chosen = np.zeros(len(view)), list[int]()  # explained: log odds of each row

        def added(k: int) -> float:
            """Return what solid k adds to those chosen, by the best of its detections a frame."""
            own = row[start[k] : start[k + 1]]
            best = np.zeros(len(not_missed))
            np.maximum.at(best, view[own], log_odds[start[k] : start[k + 1]] - explained[own])
            return float(best.sum() + not_missed[best > 0, k].sum() - cost[k])

        # What a solid adds only falls as others are chosen: one that still leads after it was
        # looked at again is the best (lazy greedy, Minoux 1978).
        queue = [(-added(k), k) for k in range(len(cost))]
        heapq.heapify(queue)
        while queue and queue[0][0] < 0:
            k = queue[0][1]
            gain = added(k)
            if -gain > queue[0][0]:
                heapq.heapreplace(queue, (-gain, k))
                continue
            heapq.heappop(queue)
            chosen.append(k)
            own = row[start[k] : start[k + 1]]
            explained[own] = np.maximum(explained[own], log_odds[start[k] : start[k + 1]])
        return np.array(chosen, np.int64)

    def _assign(self, solids: Solids, owner: IntArray) -> Association:
        """Assign detections to solids frame by frame, given the neighbours in their tracklets.

        Args:
            owner: (N,) of the start, or -1.
        """
        detected = self.detected
        evidence = gather_evidence(solids, detected)
        seen = np.bincount(evidence.row, minlength=len(owner)) > 0
        owner = np.where(seen, owner, -1)
        expected = evidence.expected[detected.view[evidence.row], evidence.solid]
        value = evidence.choice + MISSED * expected
        order = np.argsort(evidence.row, kind="stable")
        starts = np.searchsorted(evidence.row[order], detected.rows_of_view)
        for low, high in itertools.pairwise(starts):
            pairs = order[low:high]
            solid, row = evidence.solid[pairs], evidence.row[pairs]
            gain = value[pairs]
            for beside in (detected.before[row], detected.after[row]):
                gain = gain + KEPT_TRACKLET * ((beside >= 0) & (owner[beside] == solid))
            owner[row] = -1
            solid_at, i = np.unique(solid, return_inverse=True)
            row_at, j = np.unique(row, return_inverse=True)
            table = np.zeros((len(solid_at), len(row_at)))
            table[i, j] = gain.clip(0)
            i, j = linear_sum_assignment(table, maximize=True)
            good = table[i, j] > 0
            owner[row_at[j[good]]] = solid_at[i[good]]
        return Association(solids, owner, evidence, self.size_log_odds(solids))

    def _refitted(self, now: Association, widened: bool = False) -> Association:
        """Fit the solids to the detections clearly theirs, in the class that most of all have."""
        owned, clear = np.flatnonzero(now.owner >= 0), np.flatnonzero(now.clear())
        solid, label = now.owner[owned], self.detected.class_id[owned].clip(0)
        votes = np.zeros((len(now.solids), int(label.max(initial=0)) + 1))
        np.add.at(votes, (solid, label), self.detected.score[owned])
        classes = np.where(votes.any(1), votes.argmax(1), now.solids.class_id)
        fitted = self.refit(clear, now.owner[clear], classes, now.solids if widened else None)
        well = np.isfinite(fitted.ellipsoids.center_in_world).all(1)
        both = Solids.concatenate([now.solids, fitted])
        pick = np.arange(len(fitted)) + np.where(well, len(fitted), 0)
        return self._assign(both[pick], now.owner)

    def _thinned(self, now: Association) -> Association:
        """Drop solids that bring less than they cost, as others would explain their detections.

        Of those the worse half goes at once: that whose boxes others fit as well. Two that stand
        for one thing are both superfluous, and only the boxes tell which of them is the thing.
        """
        evidence, owner, view = now.evidence, now.owner, self.detected.view
        owned, mine = owner >= 0, owner[evidence.row] == evidence.solid
        busy = np.zeros_like(evidence.expected)
        busy[view[owned], owner[owned]] = True
        other = owned[evidence.row] & ~mine
        row, solid = evidence.row[other], evidence.solid[other]
        expected = evidence.expected & ~busy  # and not shown
        worth = MISSED * expected[view[row], solid]

        def instead(value: Array) -> Array:
            """Return what the best others would bring for the detections of each solid, (S,)."""
            best = np.zeros(len(owner))
            np.maximum.at(best, row, value[other] + worth)
            return np.asarray(np.bincount(owner[owned], best[owned], len(now.solids)), np.float64)

        marginal = now.gains(self.detected) - instead(evidence.log_odds)  # (S,)
        fit = np.bincount(evidence.solid[mine], evidence.choice[mine], len(now.solids))
        better = fit - instead(evidence.choice)  # (S,) than others
        weak = np.flatnonzero((marginal < 0) | (now.count < MIN_DETECTIONS))
        worst = weak[np.argsort(better[weak])][: (len(weak) + 1) // 2]
        return self._without(now, worst) if len(worst) else now

    def _without(self, now: Association, gone: IntArray) -> Association:
        """Assign anew without some of the solids."""
        keep = np.setdiff1d(np.arange(len(now.solids)), gone)
        number = np.full(len(now.solids) + 1, -1)
        number[keep] = np.arange(len(keep))
        return self._assign(now.solids[keep], number[now.owner])

    def _merged(self, now: Association) -> Association:
        """Merge pairs of near solids of a class where one explains the detections of both."""
        gain = now.gains(self.detected)
        strong, weak = _near_pairs(now.solids, gain)
        if not len(strong):
            return now
        row, pair = self._joint_rows(now.owner, strong, weak)
        fitted = self.refit(row, pair, now.solids.class_id[strong], None)
        more = self._joint_gains(now.owner, strong, weak, fitted) - gain[strong] - gain[weak]
        one_place = _coincide(now.solids)[strong, weak]
        more[one_place & np.isfinite(more)] = np.inf
        pick, gone, owner = np.arange(len(now.solids)), set[int](), now.owner.copy()
        for p in np.argsort(-more):
            i, j = int(strong[p]), int(weak[p])
            untouched = pick[i] == i and pick[j] == j and not {i, j} & gone
            if more[p] > 0 and untouched:
                pick[i] = len(now.solids) + p
                gone.add(j)
                owner[row[pair == p]] = i
        both = Solids.concatenate([now.solids, fitted])
        merged = replace(now, solids=both[pick], owner=owner)
        return self._without(merged, np.array(sorted(gone), np.int64)) if gone else now

    def _joint_rows(
        self, owner: IntArray, strong: IntArray, weak: IntArray
    ) -> tuple[IntArray, IntArray]:
        """List the rows of both of each pair, one a frame: rows (K,) and their pairs (K,)."""
        view, found = self.detected.view, list[IntArray]()
        for i, j in zip(strong, weak, strict=True):
            mine, other = np.flatnonzero(owner == i), np.flatnonzero(owner == j)
            found.append(np.append(mine, other[~np.isin(view[other], view[mine])]))
        pair = np.repeat(np.arange(len(strong)), [len(rows) for rows in found])
        return np.concatenate(found), pair

    def _joint_gains(
        self, owner: IntArray, strong: IntArray, weak: IntArray, fitted: Solids
    ) -> Array:
        """Return what one fitted solid brings for the detections of each pair, (P,)."""
        view, alone = self.detected.view, self._empty(fitted)
        evidence = alone.evidence
        own = owner[evidence.row]
        mine = (own == strong[evidence.solid]) | (own == weak[evidence.solid])
        solid, row, log_odds = (x[mine] for x in (evidence.solid, evidence.row, evidence.log_odds))
        key = solid * len(evidence.expected) + view[row]
        order = np.lexsort((-log_odds, key))
        leading = np.zeros(len(key), bool)  # the best of its solid in its frame
        leading[order] = np.append(True, np.diff(key[order]) != 0)[: len(key)]
        not_missed = MISSED * evidence.expected[view[row], solid]
        worth = log_odds + not_missed * leading
        gain = np.bincount(solid, worth.clip(0), len(strong)) - alone.costs()
        return np.where(np.isfinite(fitted.ellipsoids.center_in_world).all(1), gain, -np.inf)


def _coincide(solids: Solids) -> BoolArray:
    """Mark pairs (S, S) of solids that are in one place: no two things are.

    The smaller has its centre in the middle of the larger: its back, its seat, or the same again.
    """
    centre, half = solids.ellipsoids.center_in_world, solids.ellipsoids.half_axes
    a_in_b = np.einsum("abi,bij->abj", centre[:, None] - centre, solids.ellipsoids.world_from_obj)
    inside = (np.abs(a_in_b) < COINCIDE * half).all(2)  # (S, S) a's centre in the middle of b
    volume = half.prod(1)
    inside &= volume[:, None] <= volume
    return np.asarray(inside | inside.T, bool)


def _near_pairs(solids: Solids, gain: Array) -> tuple[IntArray, IntArray]:
    """List pairs (P,) of solids near each other; of each that of more gain first.

    They are of one class, or of about one size and in one place.
    """
    centre, half = solids.ellipsoids.center_in_world, solids.ellipsoids.half_axes
    distance = np.linalg.norm(centre[:, None] - centre, axis=2)  # (S, S)
    width = half[:, :2].mean(1)
    adjacent = distance < MERGE_REACH * (width[:, None] + width)
    size = np.log(half).mean(1)
    alike = (np.abs(size[:, None] - size) < ALIKE) & _coincide(solids)
    one_kind = (solids.class_id[:, None] == solids.class_id) | alike
    a, b = np.nonzero(np.triu(adjacent & one_kind, 1))
    first = gain[a] >= gain[b]
    return np.where(first, a, b), np.where(first, b, a)
