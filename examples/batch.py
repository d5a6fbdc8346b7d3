#!/usr/bin/env python3
"""Run a list of videos on Ray: retry crashed workers, skip finished videos.

    pip install ".[batch]"
    python examples/batch.py videos.csv -o results                  # all cores of this machine
    python examples/batch.py videos.csv -o results --workers 4 --cpus 2
    python examples/batch.py videos.csv -o results --address auto   # the Ray cluster of this node

The manifest is a CSV with a header, or JSONL; paths are relative to it:

    path,detections,poses,options
    kitchen.mp4,kitchen.json,,--every 2
    office.mp4,,office_colmap/,--classes chair,tv

`path` is required; `out` (default: its stem) is the folder under -o; `detections`, `poses`,
`tracks` and `options` are passed to `run`; `command` may be `track`. A video is finished if its
folder contains a `batch.json` made from the same files, options and version. All others are run;
interrupted ones resume from their cache. A video whose worker crashed is run again (--retries), bad
input is not. On a cluster all nodes must share the storage of the files.

Written: the output of `run` in results/NAME with its messages in batch.log; results/batch.log, one
line per event; results/summary.csv, one row per video. Exit code: 0 all finished, 1 some failed, 2
bad manifest, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import glob
import hashlib
import json
import os
import shlex
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reobj_track as rt

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = ("path", "out", "detections", "poses", "tracks", "options", "command")
FILES = ("detections", "poses", "tracks")
MARKER = "batch.json"  # in the folder of a finished video; written last, whole or not at all
KINDS = ("ok", "prior_dominated", "implausible", "rejected", "doubtful", "tracked")  # statuses
FACTS = ("frames", "frames_with_pose", "objects", *KINDS, "metres_per_unit", "warnings")
SUMMARY = ("name", "status", "attempts", "seconds", *FACTS, "path", "out", "error")


@dataclass(frozen=True)
class Item:
    """A video of the manifest: its folder, the command line of its run, the key of both."""

    name: str
    path: str
    out: str
    argv: tuple[str, ...]
    key: str


def read_manifest(manifest: Path, results: Path) -> list[Item]:
    """Read a CSV or JSONL manifest; a ReobjError names the invalid line."""
    try:
        text = manifest.read_text(encoding="utf-8-sig")
        lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
        if manifest.suffix.lower() in (".jsonl", ".json"):
            rows = [(n, json.loads(line)) for n, line in lines]
        else:
            table = list(csv.reader(line for _, line in lines))
            rows = [(lines[i][0], dict(zip(table[0], table[i], strict=True)))
                    for i in range(1, len(table))]  # fmt: skip
    except (OSError, ValueError) as error:
        raise rt.ReobjError(f"{manifest}: cannot be read as CSV with a header or JSONL ({error})"
                            ) from None  # fmt: skip
    items: dict[str, Item] = {}
    for number, row in rows:
        where = f"{manifest}, line {number}"
        if not isinstance(row, dict) or not row.get("path") or set(row) - set(COLUMNS):
            raise rt.ReobjError(
                f"{where}: expected a path, and no columns but {', '.join(COLUMNS)}"
            )
        item = make_item({k: v for k, v in row.items() if v}, manifest.parent, results)
        if item.out in items:
            raise rt.ReobjError(f"{where}: the folder {item.name} is taken; give another `out`")
        items[item.out] = item
    if not items:
        raise rt.ReobjError(f"{manifest}: no videos in it")
    return list(items.values())


def make_item(row: dict[str, str], folder: Path, results: Path) -> Item:
    """Turn a row of the manifest into a command line and a hash of what it depends on."""
    paths = {k: str(folder / row[k]) for k in ("path", *FILES) if k in row}
    if row.get("poses") in ("auto", "none"):
        paths["poses"] = row["poses"]
    name = row.get("out") or Path(row["path"]).stem
    out = str((results / name).resolve())
    given = [part for k in FILES if k in paths for part in (f"--{k}", paths[k])]
    argv = (row.get("command", "run"), paths["path"], "-o", out, *given,
            *shlex.split(row.get("options", "")))  # fmt: skip
    inputs = {k: fingerprint(Path(path)) for k, path in paths.items()}
    text = json.dumps([rt.__version__, inputs, argv])
    return Item(name, paths["path"], out, argv, hashlib.sha256(text.encode()).hexdigest())


def fingerprint(path: Path) -> list[tuple[str, int, int]]:
    """List name, size and time of a file, of a folder's files, or of the matches of a pattern."""
    found = path.iterdir() if path.is_dir() else map(Path, glob.glob(str(path)))
    files = [path] if path.is_file() else sorted(p for p in found if p.is_file())
    return [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files]


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` when the block ends without an exception."""
    part = path.with_name(f".part-{path.name}")
    yield part
    part.replace(path)


def finished(item: Item) -> dict[str, Any] | None:
    """Return the result of a finished video; None if its files, options or version changed."""
    try:
        marker = json.loads((Path(item.out) / MARKER).read_text())
    except (OSError, ValueError):
        return None
    whole = (Path(item.out) / "objects.json").is_file()
    return dict(marker["result"]) if marker.get("key") == item.key and whole else None


def run_item(item: Item, root: str) -> dict[str, Any]:
    """Run one video in a worker, unless a worker that was killed since has finished it."""
    sys.path.insert(0, root)
    import reobj_track as rt

    if done := finished(item):
        return done
    out = Path(item.out)
    started = time.monotonic()
    (out / "cache").mkdir(parents=True, exist_ok=True)  # marks an output folder of the tool
    (out / MARKER).unlink(missing_ok=True)
    (out / "cache" / "worker.pid").write_text(str(os.getpid()))
    sys.argv = ["reobj_track.py", *item.argv]
    with (
        (out / "batch.log").open("w") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        code = call(rt, item.argv)
    if code != 0:
        last = (out / "batch.log").read_text().strip().splitlines() or [""]
        return {"status": "failed", "error": last[-1].removeprefix("error: ")}
    result = {"status": "done", "error": "", "seconds": round(time.monotonic() - started, 1)}
    result |= facts(rt.Result.load(out))
    with replaced(out / MARKER) as part:
        part.write_text(json.dumps({"key": item.key, "result": result}))
    return result


def call(rt: Any, argv: Sequence[str]) -> int:
    """Run the command and return its exit code; log a traceback before the driver gets it."""
    try:
        return int(rt.main(list(argv)))
    except SystemExit as stop:  # argparse: unknown option
        return int(stop.code or 0)
    except Exception:
        traceback.print_exc()
        raise


def facts(found: rt.Result) -> dict[str, Any]:
    """Collect the figures of a finished folder for the summary."""
    status = [o.status for o in found.objects]
    return {
        "frames": len(set(found.tracks.frame.tolist())),
        "frames_with_pose": found.world.registered_frames,
        "objects": sum(o.counted for o in found.objects),
        **{s: status.count(s) for s in KINDS},
        "metres_per_unit": found.world.scale.value if found.world.scale else None,
        "warnings": len(found.warnings),
    }


class Batch:
    """The driver: submits items to Ray, counts attempts, writes the log and the summary."""

    def __init__(self, items: Sequence[Item], results: Path, retries: int) -> None:
        self.items = items
        self.results = results
        self.retries = retries
        self.rows: dict[str, dict[str, Any]] = {}
        self.attempts = {item.name: 0 for item in items}
        results.mkdir(parents=True, exist_ok=True)

    def say(self, event: str, item: Item | None = None, text: str = "") -> None:
        """Write a line to batch.log and stderr."""
        line = f"{time.strftime('%H:%M:%S')} {event:<9}{item.name if item else ''} {text}".rstrip()
        print(line, file=sys.stderr)
        with (self.results / "batch.log").open("a") as file:
            file.write(line + "\n")

    def skip_finished(self) -> list[Item]:
        """Record the finished items and return the others."""
        for item in self.items:
            if done := finished(item):
                self.rows[item.name] = done | {"status": "skipped"}
        left = [item for item in self.items if item.name not in self.rows]
        self.say("batch", text=f"{len(self.items)} videos, {len(self.rows)} finished before")
        return left

    def run(self, ray: Any, left: Sequence[Item], cpus: int) -> None:
        """Run the items; an item whose worker dies is submitted again up to `retries` times."""
        task = ray.remote(run_item).options(num_cpus=cpus, max_retries=0)
        running: dict[Any, Item] = {}

        def start(item: Item) -> None:
            self.attempts[item.name] += 1
            running[task.remote(item, str(ROOT))] = item

        for item in left:
            start(item)
        while running:
            (ref,), _ = ray.wait(list(running), num_returns=1)
            item = running.pop(ref)
            try:
                result = ray.get(ref)
            except ray.exceptions.RayError as error:
                reason = str(error).strip().splitlines()[-1] or type(error).__name__
                if self.attempts[item.name] <= self.retries:
                    self.say("again", item, f"attempt {self.attempts[item.name] + 1}: {reason}")
                    start(item)
                    continue
                result = {"status": "failed", "error": reason}
            self.rows[item.name] = result
            self.say(result["status"], item, result["error"] or f"{result['seconds']} s")

    def write_summary(self) -> None:
        """Write one row per video, in the manifest's order; without a result it is `missing`."""
        rows = []
        for item in self.items:
            known = {"name": item.name, "path": item.path, "out": item.out, "status": "missing",
                     "attempts": self.attempts[item.name]}  # fmt: skip
            row = known | self.rows.get(item.name, {})
            rows.append({k: row.get(k) for k in SUMMARY})
        with replaced(self.results / "summary.csv") as part, part.open("w", newline="") as file:
            writer = csv.DictWriter(file, SUMMARY, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def connect(address: str, workers: int, cpus: int) -> Any:
    """Start a local Ray for this number of workers, or join a cluster."""
    try:
        import ray
    except ImportError:
        raise rt.ReobjError("Ray is not installed: pip install ray") from None
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage statistics are sent
    quiet = {"include_dashboard": False, "logging_level": "ERROR", "log_to_driver": False}
    if address == "local":
        ray.init("local", num_cpus=workers * cpus, object_store_memory=10**8, **quiet)
    else:
        try:
            ray.init(address, log_to_driver=False)
        except ConnectionError as error:
            raise rt.ReobjError(f"{address}: no Ray cluster answers there ({error})") from None
    return ray


def main(argv: Sequence[str] | None = None) -> int:
    """Run the batch and return its exit code."""
    text = (__doc__ or "").splitlines()
    parser = argparse.ArgumentParser(
        description=text[0],
        epilog="\n".join(text[2:]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("manifest", type=Path, help="CSV with a header, or JSONL")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--address", default="local", help="a Ray cluster (default: this machine)")
    parser.add_argument("--workers", type=int, default=0, help="videos at once (default: cores)")
    parser.add_argument("--cpus", type=int, default=1, help="cores a video (default: 1)")
    parser.add_argument("--retries", type=int, default=2, help="after a crash (default: 2)")
    args = parser.parse_args(argv)
    try:
        batch = Batch(read_manifest(args.manifest, args.out), args.out, args.retries)
        left = batch.skip_finished()
        if left:
            workers = args.workers or max((os.cpu_count() or 1) // args.cpus, 1)
            ray = connect(args.address, workers, args.cpus)
            try:
                batch.run(ray, left, args.cpus)
            finally:
                ray.shutdown()
                batch.write_summary()
    except KeyboardInterrupt:
        print("interrupted: run the same command again to go on from there", file=sys.stderr)
        return 130
    except rt.ReobjError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    batch.write_summary()
    failed = sum(row["status"] == "failed" for row in batch.rows.values())
    batch.say("batch", text=f"{len(batch.rows) - failed} finished, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
