#!/usr/bin/env python3
"""Halve and double each numeric constant and option of the object stage: which ones matter?

    python benchmarks/sensitivity.py DATA -o OUT --choosing [--module NAME ...] [--only CASE ...]

Options are the keyword-only fields of dataclasses, of which the defaults change. The objects of
each recording are made again with one constant halved, then doubled, from boxes with half a pixel
of noise; the losses are those of `eliminate.py`, against the same boxes with all constants as they
are. OUT/sensitivity.json keeps every evaluation, so that an interrupted run resumes;
OUT/sensitivity.md has a row for each constant: mean and largest absolute loss. Constants that are
copied when a module is imported (defaults of arguments, values computed from others) do not change;
whole numbers do not go below 1, fractions do not exceed 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import pkgutil
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
    values_of,
)

MODULES = (
    "quadrics",
    *(
        f"reobj.objects.{name}"
        for name in (
            "association", "component", "config", "description", "fit", "likelihood",
            "observations",
        )
    ),
)  # fmt: skip

CODES = ("AXIS_GROUPS", "AXIS_ORDERS")  # not quantities


def constants(module: str) -> Iterator[str]:
    """Yield the names of the numbers, or tuples and arrays of numbers, of a module.

    These are constants, and options as `CLASS.field`.
    """
    imported = importlib.import_module(module)
    source = Path(imported.__file__ or "").read_text()
    values = {}
    for name in re.findall(r"^([A-Z][A-Z0-9_]+)(?:: \w+)? = ", source, re.MULTILINE):
        values[name] = getattr(imported, name)
    for kind in filter(dataclasses.is_dataclass, vars(imported).values()):
        if isinstance(kind, type) and kind.__module__ == module:
            values |= {f"{kind.__name__}.{name}": v for name, v in values_of(kind).items()}
    for name, value in values.items():
        array = np.asarray(value)
        if name not in CODES and array.dtype.kind in "if" and np.any(array):
            yield name


def scaled(value: Any, factor: float) -> Any:
    """Scale a number, or all numbers of a tuple or array; integers stay integers, at least 1.

    Of a fraction above a half, which must stay below 1, the distance to 1 is halved or doubled.
    """
    if isinstance(value, tuple):
        return tuple(scaled(v, factor) for v in value)
    if isinstance(value, int):
        return max(round(value * factor), 1)
    if isinstance(value, float) and 0.5 < value < 1:
        return 1 - (1 - value) / factor
    return value * factor


def measure_changed(
    case: Case, data: Path, out: Path, module: str, name: str, factor: float
) -> Figures:
    """Score a case with one constant scaled, in this process, wherever it was imported to."""
    owner, _, name = f"{module}.{name}".rpartition(".")
    namespaces = [values_of(pkgutil.resolve_name(owner))]
    if owner == module:
        packages = ("reobj", "reobj_track", "quadrics")
        modules = list(sys.modules.items())
        namespaces += [vars(m) for title, m in modules if title.partition(".")[0] in packages]
    value = namespaces[0][name]
    for values in namespaces:
        if values.get(name) is value:
            values[name] = scaled(value, factor)
    folder = out / f"{name}-{factor:g}-{case.name}"  # the cases of other processes are not touched
    shutil.rmtree(folder, ignore_errors=True)  # of an interrupted run
    folder.mkdir()
    shutil.copytree(out / case.name, folder / case.name)
    for link in [*out.glob("poses-*"), *out.glob("rendered-*-clip")]:
        (folder / link.name).symlink_to(link.resolve())
    try:
        return measure(case, data, folder, seed=1)
    finally:
        shutil.rmtree(folder)


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
