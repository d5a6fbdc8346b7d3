"""docs/transcripts/detectors.md has every kind of `--detector` of docs/input_formats.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from detector_lines import lines

DOCS = Path(__file__).resolve().parent.parent / "docs"


def test_every_detector_of_the_table_is_run() -> None:
    text = (DOCS / "input_formats.md").read_text()
    table = text.partition("## Detectors (`--detector`)")[2].partition("\n\n")[2].partition("\n\n")
    values = re.findall(r"^\| (`.*?) \|", table[0], re.M)
    assert len(values) == 7
    titles = {line.name.partition(" ")[0] for line in lines("a.onnx", "a.pt")}
    for value in values:
        assert titles & set(re.findall(r"`([^`]+)`", value)), value


@pytest.mark.parametrize("line", lines("yolo11n-seg.onnx", "yolo11n-seg.pt"), ids=lambda k: k.name)
def test_the_transcript_has_its_command_and_an_outcome(line: object) -> None:
    page = (DOCS / "transcripts" / "detectors.md").read_text()
    (section,) = re.findall(rf"^## {re.escape(line.name)}\n(.*?)(?=^## |\Z)", page, re.M | re.S)
    assert f" {line.words}\n" in section and line.note in section
    assert re.search(r"^(\d+ detections|\d+ boxes in tracks\.txt|Exit code 2)\.$", section, re.M)
