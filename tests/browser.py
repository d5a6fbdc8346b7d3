"""The system's Chromium without a window, driven by playwright."""

from __future__ import annotations

import contextlib
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser as Chromium
    from playwright.sync_api import Page

try:
    from playwright.sync_api import Error
except ImportError:  # tests with a browser are skipped then
    Error = RuntimeError  # type: ignore[misc,assignment]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--disable-gpu"]
IGNORED = ("GPU stall due to ReadPixels", "Multiple readback")
LOCAL = ("data:", "file:", "about:", "blob:", "http://127.0.0.1:")


class Browser:
    """One page of a browser.

    Attributes:
        page: of playwright. errors: of the page since it was opened, with its requests to the
            network. asked: number of dialogs that it has shown.
    """

    page: Page

    def __init__(self, chromium: Chromium) -> None:
        self.chromium = chromium
        self.errors: list[str] = []
        self.asked = 0

    def open(
        self, page: Path | str, width: int = 1280, height: int = 800, phone: bool = False,
        script: str = "", **more: Any,
    ) -> None:  # fmt: skip
        """Load a file, or an address, in a new window of this size; `script` runs before it."""
        for context in self.chromium.contexts:
            context.close()
        self.errors.clear()
        self.page = self.chromium.new_page(
            viewport={"width": width, "height": height}, is_mobile=phone, has_touch=phone, **more
        )
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda line: self._note(line.type, line.text))
        self.page.on("request", lambda asked: self._note("request", asked.url))
        self.page.on("dialog", self._accept)
        self.page.add_init_script(script)
        self.page.goto(page if isinstance(page, str) else page.resolve().as_uri())
        self.settle()

    def _note(self, kind: str, text: str) -> None:
        bad = not text.startswith(LOCAL) if kind == "request" else kind in ("error", "warning")
        if bad and not any(words in text for words in IGNORED):
            self.errors.append(f"{kind}: {text}")

    def _accept(self, dialog: Any) -> None:
        self.asked += 1
        dialog.accept()

    def eval(self, expression: str) -> Any:
        """Value of a JavaScript expression in the page."""
        return self.page.evaluate(expression)

    def settle(self) -> None:
        """Wait until two frames are drawn."""
        self.eval("new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))")

    def wait(self, condition: str, seconds: float = 60) -> None:
        """Wait until a JavaScript expression is true, also while the page is read again."""
        safe = f"(() => {{ try {{ return Boolean({condition}) }} catch {{ return false }} }})()"
        end = time.monotonic() + seconds
        is_true = False
        while not is_true:
            assert time.monotonic() < end, condition
            self.page.wait_for_timeout(50)
            with contextlib.suppress(Error):  # the page is read again
                is_true = self.eval(safe)

    def click(self, x: float, y: float) -> None:
        self.page.mouse.click(x, y)
        self.settle()

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: Any) -> None:
        self.page.mouse.move(*start)
        self.page.mouse.down(button=button)
        self.page.mouse.move(*end)
        self.page.mouse.up(button=button)
        self.settle()

    def press(self, key: str) -> None:
        self.page.keyboard.press(key)
        self.settle()

    def touch(self, *steps: list[tuple[float, float]]) -> None:
        """Touch with fingers at the first points, move them to the others, and lift them."""
        session = self.page.context.new_cdp_session(self.page)
        kinds = ["touchStart", *["touchMove"] * (len(steps) - 1), "touchEnd"]
        for kind, points in zip(kinds, [*steps, []], strict=True):
            touches = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})
            self.settle()
