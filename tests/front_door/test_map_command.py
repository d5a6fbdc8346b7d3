"""The command `map`: what it prints, corrects and exports."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from map_worlds import a_map, a_session, observed, some_points, true_shape

from front_door.room import cli
from reobj.maps.room_map import Observation, RoomMap, map_lock

CHAIR = true_shape(half_axes=(0.25, 0.3, 0.45))
SOFA = true_shape(center=(-2, 1, 0.4), half_axes=(1.0, 0.45, 0.4))
LAMP = true_shape(center=(0, -2, 0.8), half_axes=(0.2, 0.2, 0.8), support="cylinder")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Three sessions: the chair moved, the sofa stayed, the lamp went, object 4 is from day 3."""
    objects = [
        [observed(1, "new", CHAIR), observed(2, "stayed", CHAIR), observed(3, "moved", CHAIR)],
        [observed(k, "stayed" if k > 1 else "new", SOFA, classes={"sofa": 2.0}) for k in (1, 3)],
        [observed(1, "new", LAMP, classes={"=lamp": 1.0}), Observation(2, "gone")],
        [observed(3, "new", SOFA, classes={"sofa": 1.0})],
    ]
    sessions = [
        a_session(1, name="monday.mp4", localised_frames=0, tried_frames=0, metres_per_unit=0.5),
        a_session(2, name="tuesday.mp4", metres_per_unit=0.5),
        a_session(3, name="friday\x1b.mp4", metres_per_unit=0.5, scale_source="none"),
    ]
    room = a_map(objects, sessions=tuple(sessions))
    points = dataclasses.replace(some_points(60, 3, []), session=np.repeat([1, 2, 3], 20))
    path = tmp_path / "flat.map"
    dataclasses.replace(room, points=points).save(path)
    return path


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    found = capsys.readouterr()
    assert found.err == ""
    return found.out.splitlines()


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The line of a call that fails; the map stays as it is."""
    path = Path(str(words[0]))
    before = path.read_bytes() if path.is_file() else None
    capsys.readouterr()
    assert cli("map", *words) == 2
    found = capsys.readouterr()
    assert found.out == "" and found.err.count("\n") == 1 and found.err.startswith("error: ")
    assert (path.read_bytes() if path.is_file() else None) == before
    return found.err


def test_listing(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = path.read_bytes()
    assert cli("map", path) == 0
    assert [re.sub(" +", " ", line) for line in said(capsys)] == [
        f"{path}: 4 objects, 3 sessions, 60 points, 0.0 MB; 1 unit = 0.5 m +- 5.0 % (priors)",
        "",
        "session name date localised frames metres per unit",
        "1 monday.mp4 2026-03-01T10:00:00Z - 0.5 +- 5.0 % (priors)",
        "2 tuesday.mp4 2026-03-02T10:00:00Z 9 of 10 0.5 +- 5.0 % (priors)",
        "3 friday\N{REPLACEMENT CHARACTER}.mp4 2026-03-03T10:00:00Z 9 of 10 -",
        "",
        "object class size in m sigma sessions moved state",
        "1 chair 0.25 x 0.30 x 0.45 0.01 x 0.02 x 0.03 1-3 1 x present",
        "2 sofa 1.00 x 0.45 x 0.40 0.06 x 0.03 x 0.02 1, 3 - present",
        "3 =lamp 0.20 x 0.20 x 0.80 0.01 x 0.01 x 0.06 1 - gone",
        "4 sofa 1.00 x 0.45 x 0.40 0.07 x 0.03 x 0.03 3 - present",
    ]
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == ["flat.map"]


def test_corrections_are_stored(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("map", path, "--merge", 2, 4, "--rename", 1, "armchair", "--delete", 3) == 0
    assert said(capsys) == [
        "merged: object 4 into 2",
        "renamed: object 1 is called armchair",
        "deleted: object 3",
    ]
    room = RoomMap.load(path)
    assert [(o.id, o.name, o.deleted) for o in room.objects] == [
        (1, "armchair", False), (2, "", False), (3, "", True),
    ]  # fmt: skip
    assert room.merged == {4: 2} and room.next_id == 5
    assert cli("map", path) == 0
    printed = said(capsys)
    assert "2 objects (1 deleted), 3 s" in printed[0] and printed[-1] == "merged: 4 into 2"
    assert [line.split()[-1] for line in printed if "=lamp" in line] == ["deleted"]
    assert cli("map", path, "--undelete", 3, "--rename", 4, "sofa bed") == 0  # 4 means 2 now
    assert said(capsys) == ["renamed: object 2 is called sofa bed", "no longer deleted: object 3"]
    assert not RoomMap.load(path).objects[2].deleted


def test_forgotten_session(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli("map", path, "--forget", "friday\x1b.mp4") == 0
    name = "friday\N{REPLACEMENT CHARACTER}.mp4"
    lost = "20 points, and what it alone saw: objects 4"
    assert said(capsys) == [f"forgotten: session 3 ({name}), {lost}"]
    room = RoomMap.load(path)
    assert [s.number for s in room.sessions] == [1, 2] and [o.id for o in room.objects] == [1, 2, 3]
    assert len(room.points) == 40 and room.next_id == 5 and room.next_session == 4
    assert cli("map", path, "--forget", 1, "--forget", 2) == 0
    said(capsys)
    assert cli("map", path) == 0
    assert "0 objects, 0 sessions, 0 points" in said(capsys)[0]
    for to in ("ply", "csv", "json"):
        assert cli("map", path, "--export", to) == 0


def test_exports(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh = pytest.importorskip("trimesh")
    assert cli("map", path, "--merge", 2, 4, "--export", "csv") == 0
    assert said(capsys) == ["merged: object 4 into 2", str(path.with_suffix(".csv"))]
    with path.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == ["chair", "sofa", "'=lamp"]
    assert [row["state"] for row in rows] == ["present", "present", "gone"]
    assert [row["moved"] for row in rows] == ["1", "0", "0"]
    center = [float(rows[1][f"center_{axis}"]) for axis in "xyz"]
    np.testing.assert_allclose(center, SOFA["center"], atol=1e-5)
    size = [float(rows[1][f"size_m_{axis}"]) for axis in "xyz"]
    np.testing.assert_allclose(size, (1, 0.45, 0.4), rtol=1e-5)
    target = path.parent / "made" / "room.json"
    assert cli("map", path, "--export", "json", "-o", target) == 0
    data = json.loads(target.read_text())
    assert (data["format"], data["version"]) == ("reobj-map-objects", 1)
    assert data["scale"] == {"metres_per_unit": 0.5, "rel_sigma": 0.05, "source": "priors"}
    assert [s["name"] for s in data["sessions"]] == ["monday.mp4", "tuesday.mp4", "friday\x1b.mp4"]
    assert data["merged"] == {"4": 2}
    chair, _, lamp = data["objects"]
    assert (chair["sessions"], chair["moved"], lamp["gone"]) == ([1, 2, 3], [3], [2])
    sigma = np.sqrt(np.diag(chair["cov"]))
    np.testing.assert_allclose(sigma[3:6], 0.05 / np.sqrt(3), rtol=1e-4)
    np.testing.assert_allclose(chair["size_rel_sigma"], np.hypot(sigma[3:6], 0.05), rtol=1e-4)
    assert cli("map", path, "--export", "ply") == 0  # of the present objects
    pieces = trimesh.load(path.with_suffix(".ply")).split(only_watertight=False)
    centers = np.array(sorted(piece.bounds.mean(0).tolist() for piece in pieces))
    np.testing.assert_allclose(centers, [SOFA["center"], CHAIR["center"]], atol=1e-6)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--forget", "sunday"), "no session 'sunday' in the map; it has 1 (monday.mp4), 2 (tue"),
        (("--delete", 1, "--merge", 1, 9), "no object 9 in the map; it has 1, 2, 3, 4"),
        (("--merge", 2, 2), "objects 2 and 2 are the same"),
        (("--rename", 1, "a\x1bb"), "is no name of an object"),
        (("--rename", "chair", "x"), "expected the number of an object"),
        (("-o", "a.ply"), "give --export too"),
        (("--export", "csv", "-o", "flat.map"), "is the map; give another file"),
    ],
)
def test_invalid_calls_leave_the_map(
    words: tuple[object, ...],
    text: str,
    path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(path.parent)
    assert text in refused(capsys, path, *words)


def test_unusable_maps_are_named(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no such map" in refused(capsys, path.parent / "house.map", "--delete", 1)
    assert not (path.parent / ".house.map.lock").exists()
    with map_lock(path):
        assert "another run is updating this map" in refused(capsys, path, "--delete", 1)
        assert cli("map", path) == 0
    path.write_bytes(path.read_bytes()[:-100])
    assert "damaged" in refused(capsys, path)
