#!/usr/bin/env python3
"""Halve and double each numeric module constant of the object stage: which ones matter?

    python benchmarks/sensitivity.py DATA -o OUT --choosing [--module NAME ...] [--only CASE ...]

The objects of each recording are made again with one constant halved, then doubled, from boxes with
half a pixel of noise; the losses are those of `eliminate.py`, against the same boxes with all
constants as they are. OUT/sensitivity.json keeps every evaluation, so that an interrupted run
resumes; OUT/sensitivity.md has a row for each constant: mean and largest absolute loss. Constants
that are copied when a module is imported (defaults of arguments, values computed from others) do
not change; whole numbers do not go below 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from eliminate import losses
from real_rooms import (
    Case,
    Figures,
    add_cases,
    fresh_processes,
    measure,
    prepared_cases,
    run_missing,
)

MODULES = (
    "quadrics",
    *(
        f"reobj.objects.{name}"
        for name in (
            "association", "categories", "component", "confidence", "description", "fit",
            "hypotheses", "likelihood", "observations", "occlusion",
        )
    ),
)  # fmt: skip

CODES = ("AXIS_GROUPS", "AXIS_ORDERS")  # not quantities


def constants(module: str) -> Iterator[str]:
    """Yield the names of the numbers, or tuples and arrays of numbers, of a module.

    Of an object of options the fields: `ROBUST.huber`.
    """
    source = Path(importlib.import_module(module).__file__ or "").read_text()
    for name in re.findall(r"^([A-Z][A-Z0-9_]+)(?:: \w+)? = ", source, re.MULTILINE):
        value = getattr(importlib.import_module(module), name)
        if dataclasses.is_dataclass(value):
            yield from (f"{name}.{field.name}" for field in dataclasses.fields(value))
            continue
        numbers = np.asarray(value)
        if name not in CODES and numbers.dtype.kind in "if" and np.any(numbers):
            yield name


def scaled(value: Any, factor: float, field: str = "") -> Any:
    """Scale a number, all numbers of a tuple or array, or a field of an object of options.

    Integers stay integers, at least 1.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        number = scaled(getattr(value, field), factor)
        return dataclasses.replace(value, **{field: number})
    if isinstance(value, tuple):
        return tuple(scaled(v, factor) for v in value)
    if isinstance(value, int):
        return max(round(value * factor), 1)
    return value * factor


def measure_changed(
    case: Case, data: Path, out: Path, module: str, name: str, factor: float
) -> Figures:
    """Score a case with one constant scaled, in this process, wherever it was imported to."""
    constant, _, field = name.partition(".")
    value = getattr(importlib.import_module(module), constant)
    for title, other in list(sys.modules.items()):
        ours = title.partition(".")[0] in ("reobj", "reobj_track", "quadrics")
        if ours and getattr(other, constant, None) is value:
            setattr(other, constant, scaled(value, factor, field))
    own = out / f"{name}-{factor:g}-{case.name}"  # the cases of other processes are not touched
    own.mkdir(parents=True, exist_ok=True)
    shutil.copytree(out / case.name, own / case.name, dirs_exist_ok=True)
    for folder in [*out.glob("poses-*"), *out.glob("rendered-*-clip")]:
        (own / folder.name).symlink_to(folder.resolve())
    try:
        return measure(case, data, own, seed=1)
    finally:
        shutil.rmtree(own)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure all constants, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add_cases(parser)
    add("--module", nargs="+", default=MODULES, help="modules (all of the object stage)")
    add("--jobs", type=int, default=2, help="processes at once")
    args = parser.parse_args(argv)
    cases = prepared_cases(args)
    kept = args.out / "sensitivity.json"
    known: dict[str, list[Figures]] = json.loads(kept.read_text()) if kept.exists() else {}
    with fresh_processes(args.jobs) as pool:
        run_missing(pool, cases, args.data, args.out)

        def figures(key: str, *change: Any) -> list[list[Figures]]:
            if key not in known:
                tasks = [
                    pool.submit(measure_changed, c, args.data, args.out, *change) for c in cases
                ]
                known[key] = [task.result() for task in tasks]
                kept.write_text(json.dumps(known))
                print(f"measured: {key}", file=sys.stderr)
            return [[of_case] for of_case in known[key]]

        full = figures("as it is", "quadrics", "SMOOTH", 1.0)
        rows = []
        for module in args.module:
            for name in constants(module):
                changed = [
                    losses(full, figures(f"{module}.{name} x {f:g}", module, name, f))
                    for f in (0.5, 2.0)
                ]
                largest = max(float(np.abs(loss).max()) for loss in changed)
                means = " | ".join(f"{loss.mean():+.4f}" for loss in changed)
                rows.append((largest, f"| {module}.{name} | {means} | {largest:.4f} |"))
    rows.sort()
    head = ["| constant | halved: mean loss | doubled | largest change |", "|---|---|---|---|"]
    page = "\n".join([*head, *(row for _, row in rows)])
    (args.out / "sensitivity.md").write_text(page + "\n")
    print(page)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
