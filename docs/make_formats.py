"""Write the tables of docs/input_formats.md, between their markers, from the registries of formats.

python docs/make_formats.py
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

from reobj.evaluation.truth import TRUTH
from reobj.formats import Format
from reobj.poses.intrinsics import CAMERAS
from reobj.poses.supplied.readers import POSES
from reobj.sources.detection_files import DETECTIONS
from reobj.sources.onnx_layouts import ENTRIES

PAGE = Path(__file__).parent / "input_formats.md"


def table(rows: Iterable[tuple[str, ...]]) -> str:
    """Format rows as a Markdown table; the first one is its head."""
    head, *others = rows
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, ("---",) * len(head), *others))


def formats_table(formats: Sequence[Format[Any]]) -> str:
    """Format the formats that are read, without the columns that are empty for all."""
    rows = [("format", "written by", "frames", "units", "not read")]
    rows += [(f"`{f.name}`", f.title, f.frames, f.units, f.unread) for f in formats]
    used = [k for k in range(len(rows[0])) if any(row[k] for row in rows[1:])]
    return table(tuple(row[k] for k in used) for row in rows)


def layouts_table() -> str:
    """Format the layouts of ONNX models."""
    rows = [("layout", "models", "outputs", "image", "not read")]
    for entry in ENTRIES:
        image = f"{entry.fit}, {entry.pixels.title}"
        rows.append((f"`{entry.name}`", entry.title, entry.shape, image, entry.unread))
    return table(rows)


TABLES = {
    "detections": formats_table(DETECTIONS.formats),
    "ground truth": f"Formats: {', '.join(f'`{f.name}`' for f in TRUTH.formats)}.\n",
    "poses": formats_table(POSES.formats),
    "cameras": formats_table(CAMERAS.formats),
    "layouts": layouts_table(),
}


def filled(text: str) -> str:
    """Return the page with the present tables."""
    for name, table in TABLES.items():
        begin = f"<!-- {name}: docs/make_formats.py -->\n"
        text = re.sub(f"{begin}.*?<!-- end -->", f"{begin}{table}<!-- end -->", text, flags=re.S)
    return text


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
