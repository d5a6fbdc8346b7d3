"""examples/live_ar.py: identities and ellipsoids while poses arrive with the frames."""

from __future__ import annotations

import json
from pathlib import Path

import live_ar
import numpy as np
import pytest

from reobj.sources.tables import read_mot_rows

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def test_objects_have_true_positions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """60 frames of the example clip: the ellipsoids' centres are those of the true objects."""
    assert live_ar.main(["-o", str(tmp_path), "--frames", "60", "--embed", "none"]) == 0
    objects = json.loads((tmp_path / "live_objects.json").read_text())
    truth = json.loads((EXAMPLES / "room" / "gt_objects.json").read_text())["objects"]
    centers = np.array([t["center"] for t in truth])
    miss = [
        min(
            np.linalg.norm(np.array(o["center_in_world"]) - p)
            for p, t in zip(centers, truth, strict=True)
            if t["class"] == o["category"]
        )
        for o in objects
    ]
    assert len(objects) >= 8
    assert np.median(miss) < 0.15  # m
    assert read_mot_rows(tmp_path / "tracks.txt")[:, 0].max() == 60
    assert "ms" in capsys.readouterr().out


def test_a_session_continues_from_its_saved_state(tmp_path: Path) -> None:
    """The second session sees the same frames again: the same objects, no new identities."""
    state = ["--state", str(tmp_path / "state.npz"), "--frames", "40"]
    found = []
    for name in ("first", "second"):
        assert live_ar.main(["-o", str(tmp_path / name), *state]) == 0
        rows = read_mot_rows(tmp_path / name / "tracks.txt")
        last = rows[rows[:, 0] == 40]
        found.append({tuple(r[2:6].round()): int(r[1]) for r in last})
    assert len(found[0]) > 5
    assert found[0] == {box: found[1][box] for box in found[0]}


@pytest.mark.parametrize("option", ["--poses", "--detections"])
def test_a_missing_file_is_one_line(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert live_ar.main(["-o", str(tmp_path), option, str(tmp_path / "none.txt")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
