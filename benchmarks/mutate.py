#!/usr/bin/env python3
"""Mutation testing: change operators and constants one at a time and count what no test detects.

    python benchmarks/mutate.py -o OUT [--count 250] [--seed 0] [--only FILE...] [--jobs 2]

A copy of the checkout is changed, never the checkout. First the tests run once with a tracer that
records the lines executed by each test and its run time. Mutants are drawn by the seed among the
covered lines, equally over the modules. For each mutant, the tests that cover its line
run until one fails: the mutant is killed. Tests longer than LONGEST_S are left out. Prints
the fraction of killed mutants by module and the survivors; OUT/mutants.json lists all of them. A
survivor may be an equivalent program (`<` for `<=` where equality never occurs), a tuning constant,
or a gap in the tests; this needs reading.
"""

from __future__ import annotations

import argparse
import ast
import copy
import itertools
import json
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ("reobj_track.py", "quadrics.py", "reobj/**/*.py")
UNTRACED = ("test_batch.py", "test_docs.py", "test_wheel.py")  # they run other processes
Lines = dict[str, set[int]]  # by file
LONGEST_S = 8.0  # of a test that is used
TESTS_S = 30.0  # of all tests of a mutant, the shortest first


# ---- Which tests execute which lines -----------------------------------------------------------


class Tracer:
    """A pytest plugin that records the source lines and the seconds of each test."""

    def __init__(self, root: Path, files: Sequence[str]) -> None:
        self.names = {str(root / name): name for name in files}
        self.lines: Lines = defaultdict(set)
        self.by_test: dict[str, tuple[float, dict[str, list[int]]]] = {}

    def trace(self, frame: Any, event: str, arg: Any) -> Any:
        """Trace the lines of the source files and no others."""
        name = self.names.get(frame.f_code.co_filename)
        if name is None:
            return None
        lines = self.lines[name]

        def local(frame: Any, event: str, arg: Any) -> Any:
            lines.add(frame.f_lineno)
            return local

        lines.add(frame.f_lineno)
        return local

    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> None:
        """Begin a test."""
        self.lines = defaultdict(set)
        self.began = time.monotonic()
        threading.settrace(self.trace)
        sys.settrace(self.trace)

    def pytest_runtest_logfinish(self, nodeid: str, location: Any) -> None:
        """End a test."""
        sys.settrace(None)
        spent = time.monotonic() - self.began
        self.by_test[nodeid] = spent, {k: sorted(v) for k, v in self.lines.items()}


def run_pytest(words: Sequence[str], plugins: Sequence[Any] = ()) -> int:
    """Run tests of the working folder in this process; returns pytest's exit code."""
    import pytest

    sys.path.insert(0, os.getcwd())
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    options = ["-n", "0", "-q", "-x", "-p", "no:cacheprovider", "--no-header", "--tb=no"]
    return int(pytest.main([*options, *words], plugins=list(plugins)))


def trace_tests(copy_of: Path, files: Sequence[str], names: Sequence[str], out: Path) -> None:
    """Run the tests, traced, in a child process; writes what they execute to OUT/lines.json."""

    def child() -> None:
        os.chdir(copy_of)
        tracer = Tracer(copy_of, files)
        run_pytest(["--maxfail=1000", *(f"tests/{name}" for name in names)], [tracer])
        (out / "lines.json").write_text(json.dumps(tracer.by_test))

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join()


# ---- Changes -----------------------------------------------------------------------------------

COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE), ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}  # fmt: skip


def changed(node: ast.AST, rng: random.Random) -> ast.AST | None:
    """Return a changed copy of a node, None if it cannot be changed."""
    new: Any = copy.deepcopy(node)
    if isinstance(node, ast.Compare):
        new.ops[0] = rng.choice(COMPARED[type(node.ops[0])])()
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        new.op = COMPUTED[type(node.op)]()
    elif isinstance(node, ast.BoolOp):
        new.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        new = new.operand
    elif isinstance(node, ast.Return) and node.value is not None:
        new.value = ast.Constant(None)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        new.value = not node.value
    elif isinstance(node, ast.Constant) and isinstance(node.value, int):
        new.value = node.value + rng.choice((1, -1))
    elif isinstance(node, ast.Constant) and isinstance(node.value, float):
        new.value = node.value * rng.choice((2.0, 0.5)) or 1.0
    else:
        return None
    return None if ast.dump(new) == ast.dump(node) else new


def mutable_nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that may be changed: no annotations, messages, strings."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for node in value if isinstance(value, list) else [value]:
            if isinstance(node, ast.JoinedStr | ast.Raise | ast.Assert) or not isinstance(
                node, ast.AST
            ):
                continue
            yield node
            yield from mutable_nodes(node)


@dataclass
class Mutant:
    """A change: bytes `begin` to `end` of a file become `text`."""

    file: str
    line: int
    before: str
    text: str
    begin: int
    end: int
    killed_by: str = ""
    seconds: float = 0.0


def mutants_of(root: Path, file: str, executed: set[int], rng: random.Random) -> list[Mutant]:
    """Return all changes of executed lines of a file, in an order by chance."""
    source = (root / file).read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in mutable_nodes(ast.parse(source)):
        at: Any = node
        if getattr(node, "lineno", None) not in executed:
            continue
        if (new := changed(node, rng)) is None:
            continue
        begin = starts[at.lineno - 1] + at.col_offset
        end = starts[at.end_lineno - 1] + at.end_col_offset
        text = ast.unparse(new) if isinstance(node, ast.Return) else f"({ast.unparse(new)})"
        before = " ".join(source[begin:end].decode().split())
        found.append(Mutant(file, at.lineno, before[:100], text, begin, end))
    rng.shuffle(found)
    return found


def try_mutant(root: Path, mutant: Mutant, tests: Sequence[str], limit_s: float) -> None:
    """Change the copy, run the tests, change it back."""
    path = root / mutant.file
    source = path.read_bytes()
    new = source[: mutant.begin] + mutant.text.encode() + source[mutant.end :]
    compile(new, mutant.file, "exec")
    path.write_bytes(new)
    began = time.monotonic()

    def child() -> None:
        os.chdir(root)
        os._exit(run_pytest(tests))

    process = multiprocessing.get_context("fork").Process(target=child)
    try:
        process.start()
        process.join(limit_s)
        if process.is_alive():
            process.kill()
            process.join()
            mutant.killed_by = "time"
        elif process.exitcode:
            mutant.killed_by = "a test"
    finally:
        path.write_bytes(source)
        mutant.seconds = round(time.monotonic() - began, 1)


def affordable(tests: Sequence[str], seconds_of: dict[str, float]) -> list[str]:
    """Return the first tests that together take TESTS_S, at least one."""
    total = list(itertools.accumulate(seconds_of[test] for test in tests))
    return [test for k, test in enumerate(tests) if not k or total[k] <= TESTS_S]


def in_turn(by_file: dict[str, list[Mutant]], count: int) -> list[Mutant]:
    """Take changes in turn from all files, those of small files all."""
    rounds = itertools.zip_longest(*(reversed(mutants) for mutants in by_file.values()))
    return [mutant for taken in rounds for mutant in taken if mutant][:count]


def report(mutants: Sequence[Mutant]) -> str:
    """Format the fraction of killed changes of each file, and the survivors."""
    done = [m for m in mutants if m.seconds]
    lines = []
    for file in [*sorted({m.file for m in done}), "all"]:
        own = [m for m in done if file in (m.file, "all")]
        lines.append(f"{file:<36} {sum(bool(m.killed_by) for m in own):3d} of {len(own):3d}")
    lines += [
        f"survived: {m.file}:{m.line}: {m.before}  ->  {m.text[:100]}"
        for m in done
        if not m.killed_by
    ]
    return "\n".join(lines)


def copy_checkout(folder: Path) -> Path:
    """Copy the files of the checkout tracked by git."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


def names_of_tests(root: Path) -> list[str]:
    """List the test files and the folders of test files in tests/."""
    found = [p for p in sorted((root / "tests").iterdir()) if p.name not in UNTRACED]
    return [p.name for p in found if p.match("test_*.py") or any(p.glob("test_*.py"))]


def tests_by_line(by_test: dict[str, Any]) -> dict[tuple[str, int], list[str]]:
    """Return the tests that execute each line, the shortest first."""
    tests_of: dict[tuple[str, int], list[str]] = defaultdict(list)
    for test, (seconds, lines) in sorted(by_test.items(), key=lambda item: item[1][0]):
        if seconds <= LONGEST_S:
            for file, numbers in lines.items():
                for number in numbers:
                    tests_of[file, number].append(test)
    return tests_of


def main(argv: Sequence[str] | None = None) -> int:
    """Trace the tests, try the changes, print the report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add: Callable[..., Any] = parser.add_argument
    add("-o", "--out", type=Path, required=True, help="folder for the copy, lines and results")
    add("--count", type=int, default=250, help="number of mutants")
    add("--seed", type=int, default=0)
    add("--only", nargs="+", default=[], metavar="FILE", help="source files, as in the report")
    add("--jobs", type=int, default=1, help="mutants at once")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    root = copy_checkout(args.out.resolve() / "copy")
    sys.dont_write_bytecode = True
    files = [str(p.relative_to(root)) for glob in SOURCES for p in sorted(root.glob(glob))]
    import cv2  # noqa: F401  loaded once, before the forks
    import pytest  # noqa: F401
    import scipy.optimize
    import scipy.spatial.transform  # noqa: F401

    if not (args.out / "lines.json").exists():
        trace_tests(root, files, names_of_tests(root), args.out.resolve())
    if not (by_test := json.loads((args.out / "lines.json").read_text())):
        raise SystemExit(f"error: no test ran: python -m pytest in {root} says why")
    tests_of = tests_by_line(by_test)
    rng = random.Random(args.seed)
    by_file = {
        file: mutants_of(root, file, {n for f, n in tests_of if f == file}, rng)
        for file in files
        if not args.only or file in args.only
    }
    mutants = in_turn(by_file, args.count)
    seconds_of = {test: seconds for test, (seconds, _) in by_test.items()}

    def work(job: int) -> None:
        own = args.out.resolve() / f"copy{job}"
        shutil.copytree(root, own, dirs_exist_ok=True)
        for number, mutant in enumerate(mutants):
            if number % args.jobs == job:
                tests = affordable(tests_of[mutant.file, mutant.line], seconds_of)
                limit = 60 + 5 * sum(seconds_of[test] for test in tests)
                try_mutant(own, mutant, tests, limit)
                state = f"{mutant.killed_by or 'SURVIVED'} {mutant.seconds}"
                print(number, mutant.file, mutant.line, state, file=sys.stderr, flush=True)

    with ThreadPoolExecutor(args.jobs) as pool:
        list(pool.map(work, range(args.jobs)))
    (args.out / "mutants.json").write_text(json.dumps([asdict(m) for m in mutants], indent=1))
    print(report(mutants))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
