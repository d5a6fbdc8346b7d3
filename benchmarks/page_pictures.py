#!/usr/bin/env python3
"""Make the pictures of the viewer in README and docs/ from the output folder of the example.

    python reobj_track.py run examples/room/room.mp4 -o OUT \
        --detections examples/room/detections.npz
    python benchmarks/page_pictures.py OUT -o docs/img

Needs Chromium. scene.jpg: a chair is selected, the camera is at frame 20. scene_ride.jpg: another
chair, through the camera of frame 108, in dark colours.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from browser import CHROMIUM, FLAGS, Browser

PICTURES = {  # file: dark, x of the chair in the frame (0 left, 1 right), frame, more
    "scene.jpg": (False, 0.3, 20, ""),
    "scene_ride.jpg": (True, 0.4, 108, "setRide(true)"),
}
LEAST_WAIT_S = 1.0  # for fonts and pictures


def select_chair(browser: Browser, x: float, frame: int) -> None:
    """Select the chair that is seen in a frame nearest to x, a share of the picture's width."""
    browser.eval(f"goTo({frame})")
    browser.eval(f"""select(here.filter(o => o.class === 'chair' && o.center && seenAt(o, {frame}))
        .map(o => [Math.abs((o.refs.map(r => [Math.abs(r[0] - {frame}), (r[2] + r[4]) / 2])
            .sort((a, b) => a[0] - b[0])[0][1]) / S.size.width - {x}), o])
        .sort((a, b) => a[0] - b[0])[0][1])""")


def main(argv: Sequence[str] | None = None) -> int:
    """Write the pictures; says their sizes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="output folder of the example")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/img"))
    parser.add_argument("--quality", type=int, default=72, help="JPEG quality, 1 to 100")
    args = parser.parse_args(argv)
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        browser = Browser(chromium)
        for name, (dark, x, frame, more) in PICTURES.items():
            scheme = "dark" if dark else "light"
            browser.open(args.out / "scene.html", color_scheme=scheme)
            select_chair(browser, x, frame)
            browser.eval(f"VIEWS.reset(); {more}")
            time.sleep(LEAST_WAIT_S)
            browser.settle()
            path = args.output / name
            browser.page.screenshot(path=path, type="jpeg", quality=args.quality)
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
