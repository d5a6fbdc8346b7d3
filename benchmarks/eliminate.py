#!/usr/bin/env python3
"""Backward elimination: which mechanisms of the object stage can go together?

    python benchmarks/eliminate.py DATA -o OUT --choosing [--seeds 911 912 ...] [--noises 2]

Each mechanism of `real_rooms.py --without` is left out alone. Then they are removed together, in
the order of what that cost: a removal is kept if the loss of the whole set stays within its noise;
three refusals in a row end the search. The loss of a run is that of IDF1, of found objects and of
false ones (duplicates and elsewhere), each as a fraction of the true ones, and of the overlap in 3D
where it is measured, all added. The loss of a set is the mean over recordings and box noises; its
noise is two standard errors of the paired differences against the full set. OUT/elimination.json
keeps every evaluation, so that an interrupted run resumes; OUT/elimination.md has the tables.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from real_rooms import (
    WITHOUT,
    add_cases,
    fresh_processes,
    measure,
    prepared_cases,
    run_missing,
)

Figures = dict[str, Any]
FIGURES = ("idf1", "o3d", "found", "doubles", "elsewhere")  # that make up a loss


class Evaluations:
    """Figures of sets of removed mechanisms, measured once and kept in a file."""

    def __init__(self, path: Path, run: Callable[[str], list[list[Figures]]]) -> None:
        self.path = path
        self.run = run
        self.known: dict[str, list[list[Figures]]] = {}
        if path.exists():
            self.known = json.loads(path.read_text())

    def __call__(self, removed: Sequence[str]) -> list[list[Figures]]:
        """Return the figures by case and noise without some mechanisms."""
        key = " + ".join(sorted(removed))
        if key not in self.known:
            self.known[key] = self.run(key)
            self.path.write_text(json.dumps(self.known))
        return self.known[key]


def losses(full: list[list[Figures]], reduced: list[list[Figures]]) -> np.ndarray:
    """Return the loss of each run (n,) of `reduced` against the same run of `full`."""
    found = []
    for before, after in zip(full, reduced, strict=True):
        true = max(before[0].get("true") or before[0].get("found") or 0, 1)
        for a, b in zip(before, after, strict=True):
            lost = {k: (a.get(k) or 0) - (b.get(k) or 0) for k in FIGURES}
            objects = lost["found"] - lost["doubles"] - lost["elsewhere"]
            found.append(lost["idf1"] + lost["o3d"] + objects / true)
    return np.array(found)


def noise(loss: np.ndarray) -> float:
    """Return two standard errors of the mean of paired differences (n,)."""
    return float(2 * loss.std(ddof=1) / np.sqrt(len(loss)))


def eliminate(evaluate: Evaluations, names: Sequence[str]) -> list[tuple[str, str, float, float]]:
    """Remove mechanisms together; returns rows: what was done, name, loss of the set, its noise."""
    full = evaluate([])

    def loss_without(step: str, name: str, removed: Sequence[str]) -> tuple[str, str, float, float]:
        loss = losses(full, evaluate(removed))
        row = (step, name, float(loss.mean()), noise(loss))
        print(f"{step}: {name}: loss {row[2]:+.4f}, noise {row[3]:.4f}", flush=True)
        return row

    rows = [loss_without("alone", name, [name]) for name in names]
    removed: list[str] = []
    refused = 0
    for _, name, *_ in sorted(rows, key=lambda row: row[2]):
        step, _, loss, of_noise = loss_without("together", name, [*removed, name])
        kept = loss <= of_noise
        rows.append((step if kept else "refused", name, loss, of_noise))
        refused = 0 if kept else refused + 1
        if kept:
            removed.append(name)
        elif refused == 3:
            break
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, eliminate, and write the curve."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add_cases(parser)
    add("--noises", type=int, default=1, metavar="N", help="box noises of half a pixel each")
    text = "mechanisms that may go (all); quote names with spaces"
    add("--candidates", nargs="+", default=list(WITHOUT), metavar="NAME", help=text)
    add("--jobs", type=int, default=2, help="processes at once")
    args = parser.parse_args(argv)
    cases = prepared_cases(args)
    with fresh_processes(args.jobs) as pool:

        def run(key: str) -> list[list[Figures]]:
            seeds = range(1, args.noises + 1)
            tasks = [
                [pool.submit(measure, c, args.data, args.out, key, seed) for seed in seeds]
                for c in cases
            ]
            print(f"evaluated without: {key or 'nothing'}", file=sys.stderr)
            return [[task.result() for task in of_case] for of_case in tasks]

        run_missing(pool, cases, args.data, args.out)
        rows = eliminate(Evaluations(args.out / "elimination.json", run), args.candidates)
    head = ["| removed | mechanism | loss of the set | noise |", "|---|---|---|---|"]
    page = "\n".join([*head, *(f"| {a} | {b} | {c:+.4f} | {d:.4f} |" for a, b, c, d in rows)])
    (args.out / "elimination.md").write_text(page + "\n")
    print(page)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
