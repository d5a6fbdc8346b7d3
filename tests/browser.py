"""A headless Chromium, controlled by its DevTools protocol over two pipes, without a package."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --use-angle=swiftshader "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --hide-scrollbars --remote-debugging-pipe"
)


class Browser:
    """One page of a headless Chromium."""

    def __init__(self, profile: Path) -> None:
        theirs_in, self.out = os.pipe()
        self.inp, theirs_out = os.pipe()
        command = f'exec "$0" {FLAGS} --user-data-dir="$1" 3<&{theirs_in} 4>&{theirs_out}'
        self.process = subprocess.Popen(
            ["bash", "-c", command, str(CHROMIUM), str(profile)],
            pass_fds=(theirs_in, theirs_out),
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self.rest = b""
        self.number = 0
        self.session = ""
        self.errors: list[str] = []
        self.asked = 0  # number of unload dialogs of the page
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        attach = {"targetId": target, "flatten": True}
        self.session = self.send("Target.attachToTarget", **attach)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and wait for its answer."""
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self.receive()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def receive(self, seconds: float = 60) -> dict[str, Any]:
        """Read the next message; errors and network requests of the page are recorded."""
        while b"\0" not in self.rest:
            assert select.select([self.inp], [], [], seconds)[0], "the browser does not answer"
            chunk = os.read(self.inp, 1 << 20)
            assert chunk, "the browser is gone"
            self.rest += chunk
        text, self.rest = self.rest.split(b"\0", 1)
        message = json.loads(text)
        kind = message.get("method")
        about = message.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(about))
        if kind == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning", "assert"):
            self.errors.append(json.dumps(about["args"]))
        if kind == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            self.errors.append(about["entry"]["text"])
        if kind == "Page.javascriptDialogOpening":  # "leave without saving?"
            answer = {"id": 0, "method": "Page.handleJavaScriptDialog", "params": {"accept": True}}
            os.write(self.out, json.dumps(answer | {"sessionId": self.session}).encode() + b"\0")
            self.asked += 1
        if kind == "Network.requestWillBeSent":
            url = about["request"]["url"]
            if not url.startswith(("data:", "file:", "about:")):
                self.errors.append(f"asked the network for {url}")
        return dict(message)

    def open(
        self, page: Path | str, width: int = 1280, height: int = 800, phone: bool = False
    ) -> None:
        """Load a file, or an address, in a window of this size."""
        url = page if isinstance(page, str) else page.resolve().as_uri()
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )
        self.send("Emulation.setTouchEmulationEnabled", enabled=phone)
        self.send("Page.navigate", url=url)
        while self.receive().get("method") != "Page.loadEventFired":
            pass
        self.settle()

    def eval(self, expression: str) -> Any:
        """Value of a JavaScript expression in the page."""
        wanted = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        answer = self.send("Runtime.evaluate", **wanted)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def settle(self) -> None:
        """Wait until two frames are drawn."""
        self.eval("new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))")

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)
        self.settle()

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str) -> None:
        self.mouse("mousePressed", *start, button=button, clickCount=1)
        buttons = {"left": 1, "right": 2}[button]
        self.mouse("mouseMoved", *end, button=button, buttons=buttons)
        self.mouse("mouseReleased", *end, button=button, clickCount=1)
        self.settle()

    def press(self, key: str) -> None:
        """Press a key on the page."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)
        self.settle()

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        touches = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=touches)
        self.settle()

    def picture(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot")["data"]))

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self.out)
        self.process.terminate()
        self.process.wait(20)
        os.close(self.inp)

    def wait(self, condition: str, seconds: float = 60) -> None:
        """Wait until a JavaScript expression is true, also while the page is read again."""
        end = time.monotonic() + seconds
        safe = f"(() => {{ try {{ return Boolean({condition}) }} catch {{ return false }} }})()"
        while not self.eval(safe):
            assert time.monotonic() < end, condition
            time.sleep(0.05)


def complaints(browser: Browser) -> list[str]:
    """Errors of the page, without the driver's message on screenshots."""
    return [e for e in browser.errors if "GPU stall due to ReadPixels" not in e]
