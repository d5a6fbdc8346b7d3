"""benchmarks/splits.json: reporting and choosing sets, and their use by the scripts."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import compare_deepsort
import pose_accuracy
import pytest
import rank_k
import real_rooms
import real_solids
import scale_table
from benchmark import TUNED
from splits import SPLITS, held_out, marked, room_name, split_name

ROOT = Path(__file__).resolve().parents[2]


def test_the_sets_are_disjoint() -> None:
    for kind in ("rooms", "recordings", "pedestrians"):
        assert not set(SPLITS["reporting"][kind]) & set(SPLITS["choosing"][kind])
    assert len(SPLITS["reporting"]["rooms"]) >= 8


def test_reported_rooms_are_not_used_in_training() -> None:
    """By the commands in the docs and the scripts: lists and ranges of seeds."""
    pages = [*ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")]
    texts = [p.read_text() for p in [*pages, *ROOT.glob("benchmarks/*.py")]]
    words = r"--(?:rooms|seeds?|calibrate|val-rooms)((?:[ ,]v?\d+)+)"
    lists = (found for t in texts for found in re.findall(words, t))
    named = {int(n) for found in lists for n in re.findall(r"\d+", found)}
    ranges = r"(?<!--fine-rooms )\b(\d{3,4}):(\d{3,4})\b"  # that network was discarded
    for low, high in (r for t in texts for r in re.findall(ranges, t)):
        named |= set(range(int(low), int(high)))
    assert {900, 1008, 1192} <= named
    assert not named & {int(n.lstrip("v")) for n in SPLITS["reporting"]["rooms"]}


def test_a_room_is_named_by_its_seed_and_options(tmp_path: Path) -> None:
    assert room_name(ROOT / "examples" / "room") == "0" and not held_out("rooms", "0")
    truth = {"config": {"seed": 2006, "plan": "varied"}}
    (tmp_path / "gt_objects.json").write_text(json.dumps(truth))
    assert room_name(tmp_path) == "v2006" and held_out("rooms", "v2006")


@pytest.mark.parametrize(
    ("words", "used", "left_out"),
    [
        ([], [], ["0"]),
        (["--choosing"], ["room 0 (choosing)"], []),  # marked
        (["--tune"], ["room 0 (choosing)"], []),
        (["--tune", "--rooms", "2001"], [], ["2001"]),
        (["--tune", "--choosing", "--rooms", "2001"], [], ["2001"]),
    ],
)
def test_excluded_sequences_are_left_out(
    words: list[str], used: list[str], left_out: list[str],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def rendered(names: list[str], folder: Path) -> list[Path]:
        assert not set(names) - {"0"}
        return [ROOT / "examples" / "room" for _ in names]

    monkeypatch.setattr(compare_deepsort, "rendered", rendered)
    args = compare_deepsort.make_parser().parse_args(["--rooms", "0", *words, "-o", str(tmp_path)])
    assert [s.name for s in compare_deepsort.wanted(args)] == used
    said = capsys.readouterr().err
    assert re.findall(r"left out \(benchmarks/splits.json\): (\w+) is", said) == left_out


def test_every_peer_has_a_setting_within_its_sweep() -> None:
    assert set(TUNED) == set(compare_deepsort.SWEEP)
    for peer, options in TUNED.items():
        for option, value in options.items():
            assert value in compare_deepsort.SWEEP[peer][option][1:]


def test_the_table_of_real_rooms_marks_choosing_recordings() -> None:
    rooms = [real_rooms.Case("", "", seed=seed).title[0] for seed in (901, 2006)]
    assert rooms == ["rendered 901 (choosing)", "rendered 2006"]
    assert all(case.title[0].endswith(" (choosing)") for case in real_rooms.CASES)


RECORDING = "redkitchen_7scenes"


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (real_rooms, ["FOLDER/..", "--only", "redkitchen", "-o", "OUT"]),
        (real_solids, ["solvers", "FOLDER", "-o", "OUT"]),
        (real_solids, ["identities", "FOLDER", "-o", "OUT"]),
        (rank_k, ["--recording", "FOLDER", "-o", "OUT"]),
        (rank_k, ["--depth", "FOLDER", "-o", "OUT"]),
        (rank_k, ["--rooms", "901", "--plan", "varied", "-o", "OUT"]),
        (rank_k, ["--calibrate", "REPORTED", "--plan", "home", "-o", "OUT"]),
        (rank_k, ["--calibrate", "REPORTED", "--plan", "home", "--choosing", "-o", "OUT"]),
        (pose_accuracy, ["redkitchen", "--data", "FOLDER/..", "-o", "OUT"]),
    ],
)
def test_every_script_leaves_out_excluded_sequences(
    script: Any, words: list[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Before anything is computed or written."""
    (tmp_path / RECORDING / "images").mkdir(parents=True)
    said = {"FOLDER": str(tmp_path / RECORDING), "OUT": str(tmp_path / "out"), "REPORTED": "2001"}
    for word, value in said.items():
        words = [w.replace(word, value) for w in words]
    monkeypatch.setattr(sys, "argv", ["script", *words])
    try:
        code = script.main() if script is pose_accuracy else script.main(words)
    except SystemExit as error:
        code = error.code
    assert code not in (0, None)
    left_out = {"901": "v901", "2001": "2001"}.get(words[1], RECORDING)
    assert f"left out (benchmarks/splits.json): {left_out} is " in capsys.readouterr().err
    assert not (tmp_path / "out" / "work").exists() and not list(tmp_path.glob("out/*"))


def test_a_folder_is_a_scan_a_room_or_a_recording(tmp_path: Path) -> None:
    for name in ("scene0000_00/color", "17DRP5sb8fy/house_segmentations", "mine/images"):
        (tmp_path / name).mkdir(parents=True)
    folders = [tmp_path / n for n in ("scene0000_00", "17DRP5sb8fy", "mine")]
    folders.append(ROOT / "examples" / "room")
    found = [split_name(folder) for folder in folders]
    assert [kind for kind, _ in found] == ["scans", "scans", "recordings", "rooms"]
    assert [marked(*f) for f in found] == [
        "scene0000_00", "17DRP5sb8fy", "mine (choosing)", "0 (choosing)",
    ]  # fmt: skip


def test_the_table_of_scales_has_the_rooms_for_reporting(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """With --choosing, the others are listed separately."""
    made: list[int] = []

    class Pool:
        def __init__(self, jobs: int) -> None: ...
        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None: ...
        def map(self, function: Any, jobs: Any) -> list[Any]:
            made.extend(jobs if function is scale_table.room else [])
            return []

    monkeypatch.setattr(scale_table, "ProcessPoolExecutor", Pool)
    assert scale_table.main([str(tmp_path)]) == 0
    assert [f"v{seed}" for seed in made] == [
        n for n in SPLITS["reporting"]["rooms"] if n.startswith("v")
    ]
    assert "redkitchen_7scenes is not for reporting" in capsys.readouterr().err
    scale = scale_table.quadrics.Scale(1.0, 0.1, "priors")
    rows = [
        scale_table.Row(f"room {r}: true | all", 1, 1, 1, 1.0, scale)
        for r in ("2006", "2007", "50 (choosing)")
    ]
    lines = [line.split("|")[1:3] for line in scale_table.summary(rows).splitlines()[2:]]
    assert {name.strip(): int(runs) for name, runs in lines} == {
        "rooms: true": 2, "rooms (choosing): true": 1, "all rooms": 2, "all rooms (choosing)": 1,
    }  # fmt: skip
