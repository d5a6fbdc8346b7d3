#!/usr/bin/env python3
"""Numbers and changes over recordings of one room, through the command line.

    python benchmarks/map_sessions.py SESSIONS [SESSIONS ...] -o OUT

SESSIONS is a folder of `benchmarks/render_sessions.py` (session1, session2, ..., changes.json). The
sessions are run one after the other with one map, and compared with the truth:

    kept      objects found in an earlier session that get the number that they had there:
              all; of those that stayed, moved; of identical instances
    stolen    objects that get the number of another object
    changes   precision, recall and F1 of moved (by more than .25 m), gone and new objects, among
              those that were found where they are; a gone object counts if its place was seen
    not seen  objects of which no place was seen that are called gone
    %         time of the map over that of the rest of the run;  MB of the map

A track belongs to the true object that most of its boxes overlap (IoU .5).
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recordings import ROOT

from reobj.types import Array, box_iou

MOVED_M = 0.25
SEEN_FRAMES = 10  # in which the place of a gone object must be visible


def read_mot(path: Path) -> Array:
    """Read frame, id and box (x1, y1, x2, y2) of a MOTChallenge file, (N, 6)."""
    rows = np.loadtxt(path, delimiter=",", ndmin=2)[:, :6]
    return np.hstack([rows[:, :4], rows[:, 2:4] + rows[:, 4:6]])


def true_objects(tracks: Array, truth: Array, overlap: float = 0.5) -> dict[int, int]:
    """Return the true object of each track: that which most of its boxes overlap (IoU)."""
    votes: dict[int, Counter[int]] = defaultdict(Counter)
    for frame in np.intersect1d(tracks[:, 0], truth[:, 0]):
        found, true = (rows[rows[:, 0] == frame] for rows in (tracks, truth))
        iou = box_iou(found[:, 2:], true[:, 2:])
        for track, best, value in zip(found[:, 1], iou.argmax(1), iou.max(1), strict=True):
            if value >= overlap:
                votes[int(track)][int(true[best, 1])] += 1
    return {track: vote.most_common(1)[0][0] for track, vote in votes.items()}


def run_session(session: Path, out: Path, room: Path) -> dict[str, float]:
    """Run the command on a session; return the seconds of its stages."""
    command = [
        sys.executable, str(ROOT / "reobj_track.py"), "run", str(session / "room.mp4"),
        "--detections", str(session / "detections.npz"), "-o", str(out), "--map", str(room),
        "--set", "output.overlay=none",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{session}: {done.stderr}")
    line = next(x for x in done.stdout.splitlines() if x.startswith("seconds:"))
    stages = re.findall(r"(\w+) ([\d.]+)", re.sub(r"\([^)]*\)", "", line))
    return {name: float(value) for name, value in stages}


def score(sessions: Path, out: Path) -> list[dict[str, Any]]:
    """Run and score the sessions of a folder, one row for each after the first."""
    truth = json.loads((sessions / "changes.json").read_text())
    twins = Counter(o["twin_group"] for o in truth["objects"])
    twin_of = {o["id"]: twins[o["twin_group"]] > 1 for o in truth["objects"]}
    room = out / "room.map"
    room.unlink(missing_ok=True)
    number_of: dict[int, int] = {}  # true object -> number
    owner: dict[int, int] = {}  # number -> true object
    rows = []
    for k, entry in enumerate(truth["sessions"]):
        folder = sessions / entry["folder"]
        result = out / entry["folder"]
        seconds = run_session(folder, result, room)
        objects = json.loads((result / "objects.json").read_text())["objects"]
        located = {o["id"] for o in objects if o["status"] in ("ok", "prior_dominated")}
        true_of = true_objects(read_mot(result / "tracks.txt"), read_mot(folder / "gt_mot.txt"))
        true_of = {track: true for track, true in true_of.items() if track in located}
        if k:
            row = score_session(
                json.loads((result / "changes.json").read_text()),
                next(c for c in truth["changes"] if c["session"] == k + 1)["objects"],
                true_of, number_of, owner, twin_of,
            )  # fmt: skip
            others = sum(v for name, v in seconds.items() if name != "map")
            row |= {"map %": 100 * seconds.get("map", 0) / others,
                    "MB": room.stat().st_size / 1e6}  # fmt: skip
            rows.append({"session": str(folder)} | row)
        for track, true in true_of.items():
            owner.setdefault(track, true)
            number_of.setdefault(true, track)
    return rows


def score_session(
    changes: dict[str, Any],
    truth: Sequence[dict[str, Any]],
    true_of: dict[int, int],
    number_of: dict[int, int],
    owner: dict[int, int],
    twin_of: dict[int, bool],
) -> dict[str, Any]:
    """Compare a session with the truth.

    Args:
        true_of: true object of each number in this session. number_of, owner: of the sessions
            before.
    """
    state = {o["id"]: o for o in truth}
    again = [(n, true) for n, true in true_of.items() if true in number_of]
    kept = {n: number_of[true] == n for n, true in again}

    def ratio(numbers: Sequence[int]) -> tuple[int, int]:
        return sum(kept[n] for n in numbers), len(numbers)

    stolen = [n for n, true in true_of.items() if n in owner and owner[n] != true]
    row: dict[str, Any] = {"refused": changes["refused"], "kept": ratio([n for n, _ in again])}
    for kind in ("stayed", "moved"):
        row[f"kept {kind}"] = ratio([n for n, true in again if state[true]["state"] == kind])
    row["kept twins"] = ratio([n for n, true in again if twin_of[true]])
    row["stolen"] = [(n, owner[n], true_of[n]) for n in stolen]
    found = set(true_of.values())
    expected = {
        "moved": {t for t, o in state.items() if o["state"] == "moved"
                  and o["distance_m"] > MOVED_M and t in found and t in number_of},
        "gone": {t for t, o in state.items() if o["state"] == "gone" and t in number_of
                 and o.get("frames_old_place_seen", 0) >= SEEN_FRAMES},
        "new": {t for t in found if t not in number_of},
    }  # fmt: skip
    said = {
        "moved": {owner.get(c["id"], -c["id"]) for c in changes["moved"]
                  if c["distance_m"] is None or c["distance_m"] > MOVED_M},
        "gone": {owner.get(c["id"], -c["id"]) for c in changes["gone"]},
        "new": {true_of.get(c["id"], -c["id"]) for c in changes["new"]},
    }  # fmt: skip
    right = sum(len(expected[k] & said[k]) for k in said)
    row["changes said, true, right"] = (
        sum(map(len, said.values())), sum(map(len, expected.values())), right,
    )  # fmt: skip
    for name, first, second in (("wrong", said, expected), ("missed", expected, said)):
        row[name] = {k: sorted(first[k] - second[k]) for k in said if first[k] - second[k]}
    row["not seen, called gone"] = sum(
        t in state and state[t]["state"] != "gone" and not state[t].get("frames_old_place_seen", 0)
        for t in said["gone"]
    )
    return row


def main() -> None:
    """Run and score; print one line a session and the sums."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("sessions", type=Path, nargs="+")
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    rows = list[dict[str, Any]]()
    for sessions in args.sessions:
        out = args.out / sessions.name
        out.mkdir(parents=True, exist_ok=True)
        for row in score(sessions, out):
            rows.append(row)
            print(json.dumps(row), flush=True)
    total: dict[str, Any] = {}
    for key in ("kept", "kept stayed", "kept moved", "kept twins"):
        total[key] = [sum(row[key][i] for row in rows) for i in (0, 1)]
    said, true, right = (sum(row["changes said, true, right"][i] for row in rows) for i in range(3))
    total["changes"] = {"precision": right / max(said, 1), "recall": right / max(true, 1),
                        "F1": 2 * right / max(said + true, 1)}  # fmt: skip
    total["stolen"] = sum(len(row["stolen"]) for row in rows)
    total["not seen, called gone"] = sum(row["not seen, called gone"] for row in rows)
    total["refused"] = sum(bool(row["refused"]) for row in rows)
    print(json.dumps(total))
    text = json.dumps({"rows": rows, "total": total}, indent=1)
    (args.out / "map_sessions.json").write_text(text)


if __name__ == "__main__":
    main()
