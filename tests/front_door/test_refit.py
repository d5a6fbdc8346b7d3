"""`objects OUT`: identities keep their numbers, whatever option changes.

The example clip with supplied cameras. Sizes far from the true ones are given, with which another
scale would assign other detections to the objects.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from front_door.room import DETECTIONS, POSES, ROOM, SMALL, cli, info

PLAIN = ("--set", "output.overlay=none", "--set", "output.scene=0", "--set", "output.doubtful=1")
FEW = ("--every", 8, *SMALL)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An output folder; tracks.txt has the doubtful objects too."""
    out = tmp_path_factory.mktemp("refit") / "out"
    assert cli("run", ROOM / "room.mp4", *DETECTIONS, *POSES, *FEW, *PLAIN, "-o", out) == 0
    return out


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    """A copy of the folder."""
    return shutil.copytree(made, tmp_path / "out")


Boxes = dict[int, set[tuple[float, ...]]]


def boxes(out: Path) -> Boxes:
    """The detections of each identity in tracks.txt: frame and box."""
    rows = np.loadtxt(out / "tracks.txt", delimiter=",")
    found: Boxes = {int(i): set() for i in rows[:, 1]}
    for row in rows[rows[:, 6] > 0]:
        found[int(row[1])].add((row[0], *row[2:6]))
    return {number: detections for number, detections in found.items() if detections}


def described(out: Path) -> dict[int, str]:
    return {o["id"]: o["class"] for o in info(out)["objects"]}


def refit(out: Path, *more: object) -> None:
    assert cli("objects", out, *more) == 0


@pytest.mark.parametrize(
    "options",
    [
        ("--known-size", "chair=2m"),
        ("--prior", "chair=.1x.1x.2m"),
        ("--solver", "lfd"),
        ("--set", "objects.up=0.1,0.1,1", "--set", "objects.min_views=8", "--shape", "cylinder"),
    ],
)
def test_options_of_the_fit_keep_the_identities(
    made: Path, out: Path, options: tuple[str, ...]
) -> None:
    refit(out, *options)
    assert boxes(out) == boxes(made) and described(out) == described(made)
    old, new = (info(folder)["objects"] for folder in (made, out))
    assert [o["confidence"] for o in new] == [o["confidence"] for o in old]
    assert [o["center"] for o in new] != [o["center"] for o in old]  # they were fitted again


def test_identities_linked_again_keep_the_numbers_of_those_with_most_boxes(
    made: Path, out: Path, capsys: Any
) -> None:
    """Without linking, returns are identities of their own; the summary counts the changes once."""
    capsys.readouterr()
    refit(out, "--set", "objects.link=0")
    found = re.findall(r"linked again: (\d+) of (\d+) identities", capsys.readouterr().out)
    before, after = boxes(made), boxes(out)
    changed = {i for i in before if after.get(i) != before[i]}
    assert found == [(str(len(changed)), str(len(before)))] and 2 <= len(changed) < len(before) / 2
    for number in before.keys() & after.keys():
        shared = len(before[number] & after[number])
        assert shared == max(len(before[number] & other) for other in after.values())
    refit(out, "--set", "objects.link=1")
    assert len(re.findall("linked again", capsys.readouterr().out)) == 1
    again = boxes(out)
    kept = before.keys() & after.keys()
    assert {i: again[i] for i in kept} == {i: before[i] for i in kept}
    assert not again.keys() & (before.keys() - kept)  # numbers of identities that were gone
    refit(out, "--known-size", "chair=2m")
    assert boxes(out) == again and "linked again" not in capsys.readouterr().out


def edits(path: Path, *entries: dict[str, Any]) -> tuple[str, Path]:
    path.write_text(json.dumps({"format": "reobj-edits", "version": 1, "edits": entries}))
    return "--edits", path


def box_of(out: Path, number: int) -> dict[str, Any]:
    """The first box of an object, as an edit names it."""
    frame, x, y, w, h = min(boxes(out)[number])
    return {"id": number, "frame": int(frame) - 1, "box": [x, y, x + w, y + h]}


def split(out: Path, number: int) -> dict[str, Any]:
    """Split the later half of an object off."""
    frames = sorted(int(row[0]) - 1 for row in boxes(out)[number])
    return {
        "do": "split",
        "object": box_of(out, number),
        "frames": [frames[len(frames) // 2], frames[-1]],
    }


@pytest.mark.slow
def test_numbers_of_edited_objects_are_never_reassigned(
    made: Path, out: Path, tmp_path: Path
) -> None:
    """A split object keeps its number; after an undo no other object gets it."""
    first, second, third = list(boxes(made))[:3]
    merged = {"do": "merge", "object": box_of(made, first), "with": box_of(made, third)}
    path = tmp_path / "e.json"
    refit(out, *edits(path, split(made, second), merged))
    edited = boxes(out)
    (number,) = edited.keys() - boxes(made).keys()
    assert number > max(boxes(made)) and edited[number] < boxes(made)[second]
    assert third not in edited and edited[first] < boxes(made)[first] | boxes(made)[third]
    refit(out, "--known-size", "chair=2m")
    assert boxes(out) == edited
    other = list(boxes(made))[4]
    refit(out, *edits(path, split(made, other), split(made, second)))
    (another,) = boxes(out).keys() - edited.keys() - {third}
    assert boxes(out)[number] == edited[number]
    assert another > number and boxes(out)[another] < boxes(made)[other]
    assert boxes(out)[third] == boxes(made)[third]
    refit(out, *edits(path))
    assert boxes(out) == boxes(made)
    last = list(boxes(made))[5]
    refit(out, *edits(path, split(made, last)))
    (new,) = boxes(out).keys() - boxes(made).keys()
    assert new > another
