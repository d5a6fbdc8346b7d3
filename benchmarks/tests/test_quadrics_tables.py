"""benchmarks/synthetic_quadrics.py and tuw_demo.py: tables and errors."""

from __future__ import annotations

from pathlib import Path

import pytest
import synthetic_quadrics
import tuw_demo


def test_a_table_is_written_between_its_markers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "RESULTS.md"
    page.write_text("head\n<!-- table cuboids -->\nold\n<!-- end cuboids -->\ntail\n")
    assert synthetic_quadrics.main(["--quick", "--only", "cuboids", "-o", str(tmp_path)]) == 0
    text = page.read_text()
    assert "% boxes)" in text and "old" not in text and text.endswith("tail\n")
    assert "cuboids" in capsys.readouterr().out


def test_a_folder_without_the_demo_data_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tuw_demo.main([str(tmp_path)]) == 2
    assert "gt.npy" in capsys.readouterr().err
