"""Manual corrections: the file, its effect on tracks, and `objects OUT --edits`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reobj_track as rt
from reobj.results.edits import apply_edits, read_edits

NAMES = ("chair", "cup")


def table() -> rt.Tracks:
    """Objects 1 to 3 in ten frames each, 20 px apart; object 2 in two visits, 3 in three."""
    rows = []
    for obj in (1, 2, 3):
        for frame in range(10):
            tracklet = 10 * obj + (obj > 1) * (frame > 4) + (obj > 2) * (frame > 7)
            rows.append([frame, obj, tracklet, 20.0 * obj + frame, 0.5 + 0.1 * obj])
    frame, obj, tracklet, x, score = np.array(sorted(rows)).T
    box = np.column_stack([x, x, x + 18, x + 18])
    ints = (a.astype(np.int64) for a in (frame, obj, tracklet))
    zero = np.zeros(len(x), np.int64)
    return rt.Tracks(*ints, box, score, zero, zero)


def ref(obj: int, frame: int, named: int | None = None) -> dict[str, Any]:
    """A reference as the viewer writes it: a rounded box and the id of the object."""
    x = 20.04 * obj + frame
    return {"id": named or obj, "frame": frame, "box": [x, x, x + 18, x + 18]}


def write(path: Path, *edits: dict[str, Any], **more: Any) -> Path:
    path.write_text(json.dumps({"format": "reobj-edits", "version": 1, "edits": edits, **more}))
    return path


def applied(tmp_path: Path, *edits: dict[str, Any], tracks: rt.Tracks | None = None) -> Any:
    path = write(tmp_path / "e.json", *edits)
    return apply_edits(table() if tracks is None else tracks, NAMES, read_edits(path))


def members(made: Any) -> dict[int, set[int]]:
    """Tracklets of each object that is left."""
    kept = made.tracks[made.keep]
    return {int(i): set(kept.tracklet_id[kept.track_id == i].tolist()) for i in set(kept.track_id)}


ALL = {1: {10}, 2: {20, 21}, 3: {30, 31, 32}}
MERGE = {"do": "merge", "object": ref(3, 4), "with": ref(1, 9)}
SPLIT = {"do": "split", "object": ref(3, 2), "visits": [ref(3, 6), ref(3, 9)]}
CUT = {"do": "split", "object": ref(2, 2), "frames": [3, 5]}
RENAME = {"do": "rename", "object": ref(2, 0), "class": "mug"}
DELETE = {"do": "delete", "object": ref(2, 7)}


@pytest.mark.parametrize(
    ("edits", "left"),
    [
        ((), ALL),
        ((DELETE,), {1: {10}, 3: {30, 31, 32}}),
        ((SPLIT,), {1: {10}, 2: {20, 21}, 3: {30}, 4: {31, 32}}),
        # the second edit of the viewer names the result of the first
        ((SPLIT, {"do": "merge", "object": ref(3, 6, 4), "with": ref(2, 6)}),
         {1: {10}, 2: {20, 21, 31, 32} - {21}, 3: {30}}),
        ((SPLIT, SPLIT), {1: {10}, 2: {20, 21}, 3: {30}, 4: {31, 32}}),  # separate already
        ((MERGE, MERGE), {1: {30, 31, 32}, 2: {20, 21}}),  # and merged already
        ((MERGE, {**SPLIT, "object": ref(1, 3)}), {1: {10, 30}, 2: {20, 21}, 3: {31, 32}}),
        ((DELETE, SPLIT), {1: {10}, 3: {30}, 4: {31, 32}}),
        ((CUT,), {1: {10}, 2: {20, 21}, 3: {30, 31, 32}, 4: {20, 21}}),
        ((CUT, {"do": "delete", "object": ref(2, 5, 4)}), ALL),
    ],
)  # fmt: skip
def test_identities_after_edits(
    tmp_path: Path, edits: tuple[dict[str, Any], ...], left: dict[int, set[int]]
) -> None:
    """Of two boxes in one frame the one with the higher score stays: here the higher id."""
    made = applied(tmp_path, *edits)
    assert members(made) == left
    frames = made.tracks[made.keep]
    pairs = list(zip(frames.frame.tolist(), frames.track_id.tolist(), strict=True))
    assert len(pairs) == len(set(pairs))


def two_boxes(*boxes: list[float]) -> rt.Tracks:
    """Objects 1, 2, ... with one of these boxes each, in five frames; object 1 is the best."""
    frame, k = np.divmod(np.arange(5 * len(boxes)), len(boxes))
    box = np.array(boxes, float)[k] + frame[:, None]
    return rt.Tracks(frame, k + 1, k + 1, box, 0.9 - 0.1 * k, np.zeros_like(k), k)


@pytest.mark.parametrize(
    ("boxes", "whole"),
    [
        ([[100, 50, 200, 150], [190, 55, 300, 150]], [100, 50, 300, 150]),  # halves that overlap
        ([[100, 50, 195, 150], [205, 50, 300, 150]], [100, 50, 300, 150]),  # a gap of a twentieth
        ([[100, 50, 140, 150], [100, 110, 200, 150]], [100, 50, 200, 150]),  # back and seat
        ([[100, 50, 200, 150], [110, 55, 205, 150]], [100, 50, 200, 150]),  # the same twice
        ([[120, 60, 170, 120], [100, 50, 200, 150]], [100, 50, 200, 150]),  # a detail first
        ([[100, 50, 200, 150], [120, 60, 170, 120]], [100, 50, 200, 150]),
        ([[100, 50, 200, 150], [300, 50, 400, 150]], [100, 50, 200, 150]),  # elsewhere
        ([[100, 50, 200, 150], [195, 145, 300, 250]], [100, 50, 200, 150]),  # only corners meet
        # three thirds: the last box joins the first two, which are apart
        ([[100, 50, 200, 150], [300, 50, 400, 150], [200, 50, 300, 150]], [100, 50, 400, 150]),
    ],
)  # fmt: skip
def test_boxes_of_parts_are_joined(
    tmp_path: Path, boxes: list[list[float]], whole: list[float]
) -> None:
    tracks = two_boxes(*boxes)
    refs = [{"id": k + 1, "frame": 0, "box": box} for k, box in enumerate(boxes)]
    merges = [{"do": "merge", "object": refs[0], "with": other} for other in refs[1:]]
    made = applied(tmp_path, *merges, tracks=tracks)
    kept = made.tracks[made.keep]
    np.testing.assert_array_equal(kept.frame, np.arange(5))
    np.testing.assert_array_equal(kept.xyxy, np.array(whole) + kept.frame[:, None])
    assert set(kept.score) == {0.9} and set(kept.detection_index) == {0}


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({**DELETE, "object": ref(7, 2)}, "no object has the box 142.3"),
        ({**DELETE, "object": ref(2, 77)}, "in frame 77"),
        ({**SPLIT, "visits": [ref(3, 1), ref(3, 6), ref(3, 9)]}, "all boxes of the object"),
        ({**CUT, "frames": [0, 9]}, "all boxes of the object"),
        ({**MERGE, "with": ref(1, 30)}, "edit 1 (merge 3 with 1)"),
    ],
)
def test_unmatched_edits_are_reported(tmp_path: Path, edit: dict[str, Any], said: str) -> None:
    with pytest.raises(rt.ReobjError) as error:
        applied(tmp_path, edit)
    assert said in str(error.value) and "anew in scene.html" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", '"format": "reobj-edits"'),
        ('{"format": "reobj-edits", "version": 2, "edits": []}', '"version": 1'),
        ('{"format": "reobj-edits", "version": 1}', "missing .* edits"),
        ([3], r"\$\.edits\[0\]: Expected object"),
        ([DELETE, {"do": "delete"}], r"\$\.edits\[1\]: .*missing .* object"),
        ([{**DELETE, "do": "paint"}], r"\$\.edits\[0\]\.do: Invalid .*paint"),
        ([{**DELETE, "why": 1}], "unknown field why"),
        ([{**DELETE, "class": "cup"}], "delete has class besides object, expected nothing"),
        ([{**RENAME, "class": " "}], "rename has nothing besides object, expected class"),
        ([{**RENAME, "class": "a\nb"}], "cannot be printed"),
        ([{**SPLIT, "frames": [1, 2]}], "split has frames and visits .* expected frames or visits"),
        ([{**CUT, "frames": [5, 3]}], r"frames \[5, 3\] are not in order"),
        ([{**CUT, "frames": [-1, 3]}], r"\$\.edits\[0\]\.frames\[0\]: Expected int >= 0"),
        ([{**DELETE, "object": {"frame": 1, "box": [1, 2, 3]}}], r"object\.box: .* length 4"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, text: Any, said: str) -> None:
    path = tmp_path / "edits.json"
    if isinstance(text, str):
        path.write_text(text)
    else:
        write(path, *text)
    with pytest.raises(rt.ReobjError, match=said) as error:
        read_edits(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


# ---- In an output folder ----


@pytest.fixture
def folder(broken_walk_folder: Path, tmp_path: Path) -> Path:
    return shutil.copytree(broken_walk_folder, tmp_path / "out")


def refit(out: Path, *words: str | Path) -> int:
    """Run `objects OUT` without pictures."""
    off = ("--set", "output.overlay=none", "--set", "output.scene=false")
    return rt.main(["objects", str(out), *map(str, words), *off])


def box_of(out: Path, number: int) -> dict[str, Any]:
    """The reference of an object in an output folder: its first box."""
    rows = np.loadtxt(out / "tracks.txt", delimiter=",")
    frame, _, x, y, w, h = rows[(rows[:, 1] == number) & (rows[:, 6] > 0)][0, :6]
    return {"id": number, "frame": int(frame) - 1, "box": [x, y, x + w, y + h]}


def listed(out: Path) -> list[tuple[int, str]]:
    return [(o.id, o.class_name) for o in rt.Result.load(out).objects]


def test_edits_are_stored_in_the_folder(folder: Path, tmp_path: Path, capsys: Any) -> None:
    """A merge over the break of the cameras, a new name, a deletion; later fits keep them."""
    before = rt.Result.load(folder)
    path = write(
        tmp_path / "e.json",
        {"do": "merge", "object": box_of(folder, 1), "with": box_of(folder, 5)},
        {"do": "rename", "object": box_of(folder, 2), "class": "stool"},
        {"do": "delete", "object": box_of(folder, 6)},
    )
    assert refit(folder, "--edits", path) == 0
    expected = [(1, "chair"), (2, "stool"), (3, "chair"), (4, "chair")]
    result = rt.Result.load(folder)
    assert listed(folder) == expected
    assert len(result.objects[0].tracklet_ids) == 2 and result.objects[0].part == 0
    assert result.objects[1].confidence == 1.0
    assert result.objects[2].confidence == before.objects[2].confidence
    assert set(result.tracks.track_id) == {1, 2, 3, 4}
    assert "3 corrections by hand applied" in capsys.readouterr().err
    stored = json.loads((folder / "edits.json").read_text())
    assert stored["edits"] == json.loads(path.read_text())["edits"]
    for options in ([], ["--support", "cylinder"]):
        assert refit(folder, *options) == 0
        assert listed(folder) == expected
        assert "3 corrections by hand applied" in capsys.readouterr().err
    assert refit(folder, "--edits", write(path)) == 0  # none any more
    assert [o.id for o in rt.Result.load(folder).objects] == [1, 2, 3, 4, 5, 6]
    assert not (folder / "edits.json").exists()
