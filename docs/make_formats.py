"""Write the tables of docs/input_formats.md, between their markers, from the registries of formats.

python docs/make_formats.py
"""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from reobj.evaluation.truth import TRUTH
from reobj.poses.intrinsics import CAMERAS
from reobj.poses.supplied.readers import POSES
from reobj.sources.detection_files import DETECTIONS
from reobj.sources.onnx_layouts import layouts_table

PAGE = Path(__file__).parent / "input_formats.md"
TABLES = {
    "detections": DETECTIONS.table(),
    "ground truth": dataclasses.replace(TRUTH, formats=TRUTH.readable).table(),
    "poses": POSES.table(),
    "cameras": CAMERAS.table(),
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
