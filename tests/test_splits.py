"""examples/splits.json: what may be reported, and that the scripts obey it."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples"))
import compare_deepsort  # noqa: E402
import real_rooms  # noqa: E402
from benchmark import TUNED  # noqa: E402
from splits import SPLITS, held_out, room_name  # noqa: E402


def test_nothing_is_for_both() -> None:
    for kind in ("rooms", "recordings", "pedestrians"):
        assert not set(SPLITS["reporting"][kind]) & set(SPLITS["choosing"][kind])
    assert len(SPLITS["reporting"]["rooms"]) >= 8


def test_no_room_of_the_reports_was_trained_on_or_named_elsewhere() -> None:
    """By the commands in the documents and in the examples: lists and ranges of seeds."""
    texts = [p.read_text() for p in [*ROOT.glob("docs/*.md"), *ROOT.glob("examples/*.py")]]
    words = r"--(?:rooms|seeds?|calibrate|val-rooms)((?:[ ,]v?\d+)+)"
    lists = (found for t in texts for found in re.findall(words, t))
    named = {int(n) for found in lists for n in re.findall(r"\d+", found)}
    ranges = r"(?<!--fine-rooms )\b(\d{3,4}):(\d{3,4})\b"  # that network was thrown away
    for low, high in (r for t in texts for r in re.findall(ranges, t)):
        named |= set(range(int(low), int(high)))
    assert {900, 1008, 1192} <= named
    assert not named & {int(n.lstrip("v")) for n in SPLITS["reporting"]["rooms"]}


def test_a_room_is_named_by_what_it_was_made_of(tmp_path: Path) -> None:
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
def test_what_may_not_be_used_is_left_out(
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
    assert re.findall(r"left out: (\w+) is for", said) == left_out


def test_every_peer_has_a_setting_within_its_sweep() -> None:
    assert set(TUNED) == set(compare_deepsort.SWEEP)
    for peer, options in TUNED.items():
        for option, value in options.items():
            assert value in compare_deepsort.SWEEP[peer][option][1:]


def test_the_table_of_real_rooms_says_what_was_chosen_on() -> None:
    rooms = [real_rooms.Case("", "", seed=seed) for seed in (901, 2006)]
    assert [case.held_out for case in rooms] == [False, True]
    assert not any(case.held_out for case in real_rooms.CASES)
