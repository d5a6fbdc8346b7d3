#!/usr/bin/env python3
"""Render several recordings of one furnished room, between which objects move, go and come.

    python benchmarks/render_sessions.py -o DIR --seed 7 --sessions 3 --frames 240

writes DIR/session1, DIR/session2, ..., each with the files of render_room.py, and
DIR/changes.json: the difference of each session to the first and to the one before. All sessions
share one room frame, in which `poses.txt` and `gt_objects.json` are given. An object has the same
number in all sessions, and identical objects have different numbers.

Between two sessions, about a third of the objects change: half of the changes are moves (0.3 to
2 m on the floor, or elsewhere on a table or on another table; at least one move is that of one of
several identical objects if there are any), a quarter are removals and a quarter additions, some
of them objects that were taken away before. Tables and couches stay. Lamps, daylight, exposure and
white balance change too, the camera takes another path at another height, and every second session
has 1.2 times the focal length.

changes.json lists, against the first session and the one before, each object's `state`: stayed,
moved, gone, new (not present in the session compared with, nor earlier) or returned (not present
in it, but earlier). `frames_old_place_seen` counts the frames of this session that show at least
20 % of the object's silhouette at its earlier place, or would show it if it were still there;
where it is 0, `gone` cannot be observed.

`--foreign SEED` renders another room, that of SEED, with the same kinds of objects; `--mirror` the
room with x -> -x, with its textures; with `--light-only` no object changes. Conventions are those
of render_room.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from render_room import build_parser, report, room_config
from rendering.sessions import SessionOptions, write_sessions


def main(argv: Sequence[str] | None = None) -> int:
    """Command line entry; 0 on success, 2 on bad input."""
    parser = build_parser("Render several recordings of one room, and the truth about changes.")
    add: Callable[..., Any] = parser.add_argument
    add("--sessions", type=int, default=2, help="recordings (default %(default)s)")
    add("--foreign", type=int, metavar="SEED", help="the room of this seed, with the same objects")
    add("--mirror", action="store_true", help="mirror the room: x -> -x, textures too")
    add("--light-only", action="store_true", help="light, path and camera change, objects stay")
    args = parser.parse_args(argv)
    options = SessionOptions(max(args.sessions, 1), args.foreign, args.mirror, args.light_only)
    return report(
        lambda: write_sessions(
            args.out,
            room_config(args, plan="session", path="session"),
            options,
            args.png,
            args.crf,
        )
    )


if __name__ == "__main__":
    raise SystemExit(main())
