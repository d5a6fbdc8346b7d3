"""The scene page in a real browser, and its bytes: what it holds, how large it is, that it is
safe.

The browser is driven through Chromium's own protocol over two pipes, so no package is needed.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import os
import select
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from simulated import fitted, into_part, tracks_of, walk, with_columns

import quadrics
import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.results.result import VideoInfo
from reobj.results.scene import Pictures, diverse_rows, write_pictures, write_scene
from reobj.types import object_color

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --use-angle=swiftshader "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --hide-scrollbars --remote-debugging-pipe"
)
EVIL = "</script><script>window.hacked=1</script><img src=x onerror=hacked=1>"


class Browser:
    """One page of a headless Chromium."""

    def __init__(self, profile: Path) -> None:
        (theirs_in, self.out), (self.inp, theirs_out) = os.pipe(), os.pipe()
        command = f'exec "$0" {FLAGS} --user-data-dir="$1" 3<&{theirs_in} 4>&{theirs_out}'
        self.process = subprocess.Popen(
            ["bash", "-c", command, str(CHROMIUM), str(profile)],
            pass_fds=(theirs_in, theirs_out),
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self.rest, self.number, self.session = b"", 0, ""
        self.errors: list[str] = []
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
        """The next message; what the page complains about, or asks the network for, is kept."""
        while b"\0" not in self.rest:
            assert select.select([self.inp], [], [], seconds)[0], "the browser does not answer"
            chunk = os.read(self.inp, 1 << 20)
            assert chunk, "the browser is gone"
            self.rest += chunk
        text, self.rest = self.rest.split(b"\0", 1)
        message = json.loads(text)
        kind, about = message.get("method"), message.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(about))
        if kind == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning", "assert"):
            self.errors.append(json.dumps(about["args"]))
        if kind == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            self.errors.append(about["entry"]["text"])
        if kind == "Network.requestWillBeSent":
            url = about["request"]["url"]
            if not url.startswith(("data:", "file:", "about:")):
                self.errors.append(f"asked the network for {url}")
        return dict(message)

    def open(self, path: Path, width: int = 1280, height: int = 800, phone: bool = False) -> None:
        """Load a file in a window of this size."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )
        self.send("Emulation.setTouchEmulationEnabled", enabled=phone)
        self.send("Page.navigate", url=path.resolve().as_uri())
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

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=places)
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


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    page = Browser(tmp_path_factory.mktemp("profile"))
    yield page
    page.close()


# ---- A small scene ----

NAMES = ("chair", EVIL, "suitcase", "person")
CENTERS = ((-1.6, 0.0, 0.4), (0.0, 0.2, 0.5), (1.6, 0.0, 0.3), (0.0, 1.5, 0.6))
FRAMES, WIDTH, HEIGHT = 24, 320, 240


def poses_of_walk() -> rt.Poses:
    """Cameras that walk past the objects, looking at them, z up; frame 5 has no pose."""
    at = np.stack([np.linspace(-2, 2, FRAMES), np.full(FRAMES, -4.0), np.full(FRAMES, 1.5)], 1)
    forward = np.array([0, 0, 0.5]) - at
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    cam_from_world = np.empty((FRAMES, 3, 4))
    cam_from_world[:, :, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    cam_from_world[:, :, 3] = -np.einsum("fij,fj->fi", cam_from_world[:, :, :3], at)
    cam_from_world[5] = np.nan
    rng = np.random.default_rng(0)
    return rt.Poses(
        camera=rt.Camera("PINHOLE", WIDTH, HEIGHT, (250.0, 250.0, WIDTH / 2, HEIGHT / 2)),
        frame=np.arange(FRAMES),
        time_s=np.arange(FRAMES) / 25,
        cam_from_world=cam_from_world,
        status=np.where(np.arange(FRAMES) == 5, "none", "supplied"),
        source="user",
        metric=True,
        up_in_world=np.array([0, 0, 1.0]),
        points=rng.uniform(-2, 2, (500, 3)),
        colors=rng.integers(0, 255, (500, 3)).astype(np.uint8),
    )


def tracks_of_walk(poses: rt.Poses) -> rt.Tracks:
    """Boxes of the objects in every frame; the second one is out of sight for a while."""
    n = len(CENTERS)
    half = np.tile([0.3, 0.25, 0.4], (n, 1))
    solids = quadrics.Ellipsoids(np.array(CENTERS), half, np.tile(np.eye(3), (n, 1, 1)))
    cams = np.nan_to_num(poses.cam_from_world)
    cams[5] = cams[4]
    boxes = quadrics.solid_boxes(solids, "box", poses.camera.K @ cams)  # (F, O, 4)
    frame, obj = np.nonzero(np.ones((FRAMES, n)))
    keep = ~((obj == 1) & (frame > 8) & (frame < 15))
    frame, obj = frame[keep], obj[keep]
    tracklet = obj + 1 + n * ((obj == 1) & (frame > 8))
    score = np.full(len(frame), 0.9)
    return rt.Tracks(frame, obj + 1, tracklet, boxes[frame, obj], score, obj, obj)


def write_page(folder: Path, in_3d: bool = True, scene: bool = True) -> Path:
    """An output folder with the page of the small scene."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    (folder / "frames").mkdir()
    for i in range(FRAMES):
        image = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), (0, 0), 3)
        cv2.imwrite(str(folder / f"frames/{i:03d}.png"), image)
    video, poses = rt.Video(folder / "frames"), poses_of_walk()
    result = fitted(tracks_of_walk(poses), poses if in_3d else None, names=NAMES)
    result.warnings.append("a <b>warning</b>")
    link = rt.LinkEvent("join", (2, 6), 0.123456, 1.98765, True)
    result.world = dataclasses.replace(result.world, links=(link,))
    result.save(folder / "out")
    write_pictures(result, folder / "out", video, overlay="none", scene=scene)
    return folder / "out/scene.html"


def data_of(page: Path) -> Any:
    """The data embedded in a page."""
    text = page.read_text()
    return json.loads(text.split('id="data">')[1].split("</script>")[0])


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("scene") / "a")


class Facts:
    """Stands in for a video where only its facts are asked for."""

    config, fps, scale, source, is_live = rt.InputConfig(), 30.0, 1.0, "a.mp4", False
    size = (WIDTH, HEIGHT)


VIDEO: Any = Facts()
SCREENSHOTS = Path(__file__).resolve().parent.parent / "build/screenshots"


def complaints(browser: Browser) -> list[str]:
    """Errors of the page; the driver's remark on screenshots is not the page's."""
    return [e for e in browser.errors if "GPU stall due to ReadPixels" not in e]


def center_of(browser: Browser, number: int) -> tuple[float, float]:
    """Place of an object's centre in the window."""
    x, y, left, top = browser.eval(
        f"(r => [...project(solid.find(o => o.id === {number}).center).slice(0, 2), r.left, r.top])"
        "($('view').getBoundingClientRect())"
    )
    return x + left, y + top


# ---- In the browser ----


def test_a_click_on_an_object_opens_its_panel(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert browser.eval("!!gl && document.title") == "frames: 4 objects"
    for number, name in zip((1, 2, 3), NAMES, strict=False):
        browser.click(*center_of(browser, number))
        assert browser.eval("state.selected.id") == number
        text = browser.eval("$('panel').innerText")
        assert f"{number} {name}" in text
        assert "size, m" in text and "±" in text and "tracklets" in text
        wide = browser.eval("""Promise.all([...document.querySelectorAll('.crops img')]
            .map(i => i.decode().then(() => i.naturalWidth)))""")
        assert len(wide) == 8 and min(wide) > 8
    browser.picture(SCREENSHOTS / "desktop.png")
    browser.eval("$('close').click()")
    assert browser.eval("$('panel').innerText") == "" and browser.eval("state.selected") is None
    assert browser.eval("window.hacked") is None and complaints(browser) == []


def test_rejected_objects_are_listed_with_their_reason(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert browser.eval("solid.length") == 3
    row = browser.eval("S.objects[3].row.innerText")
    assert "4" in row and "objects of this class move" in row
    browser.eval("S.objects[3].row.click()")
    assert "rejected: objects of this class move" in browser.eval("$('panel').innerText")
    assert "a <b>warning</b>" in browser.eval("$('list').innerText")


def test_merges_and_splits_are_told(browser: Browser, page: Path) -> None:
    browser.open(page)
    data = data_of(page)
    assert data["links"] == [{"kind": "join", "tracklets": [2, 6], "place_iou": 0.12,
                              "appearance_log_odds": 1.99, "kept": True}]  # fmt: skip
    browser.eval("""S.links.push(
        {kind: "join", tracklets: [1, 3], place_iou: 0.2, appearance_log_odds: 0.9, kept: false},
        {kind: "split", tracklets: [1, 1], place_iou: 0, appearance_log_odds: 1, kept: true})""")
    browser.eval("select(S.objects[0])")
    text = browser.eval("$('panel').innerText")
    assert "tracklets 1 (object 1), 3 (object 3): overlap of places 0.2" in text
    assert "tried and undone" in text and "parts of tracklets 1 (object 1) show different" in text
    assert "undefined" not in text and "NaN" not in text
    browser.eval("select(S.objects[1])")
    assert "overlap of places 0.12, likeness 1.99" in browser.eval("$('panel').innerText")


def test_the_slider_plays_the_cameras(browser: Browser, page: Path) -> None:
    browser.open(page)
    before = browser.send("Page.captureScreenshot")["data"]
    browser.eval("$('slider').focus()")
    for kind in ("keyDown", "keyUp"):
        browser.send("Input.dispatchKeyEvent", type=kind, key="End", windowsVirtualKeyCode=35)
    browser.settle()
    assert browser.eval("[state.step, $('clock').textContent]") == [23, "frame 23"]
    assert browser.eval("$('frame').naturalWidth") > 100
    assert browser.send("Page.captureScreenshot")["data"] != before
    seen = "S.objects.filter(o => o.row.classList.contains('now')).map(o => o.id)"
    assert browser.eval(seen) == [1, 2, 3, 4]
    browser.eval("goTo(10)")
    assert browser.eval(seen) == [1, 3, 4]
    browser.eval("goTo(5)")
    assert browser.eval("$('clock').textContent") == "frame 5 (no pose)"
    browser.eval("$('play').click()")
    moved = "new Promise(f => setInterval(() => state.step !== 5 && f(state.step), 20))"
    assert browser.eval(moved) == 6
    browser.eval("$('play').click()")
    assert browser.eval("$('play').textContent") == "▶" and complaints(browser) == []


def test_riding_along_sees_what_the_camera_saw(browser: Browser, page: Path) -> None:
    """The page's projection against K [R | t]."""
    browser.open(page)
    poses = poses_of_walk()
    browser.eval("$('ride').checked = true; goTo(17)")
    browser.settle()
    width, height = browser.eval("[canvas.clientWidth, canvas.clientHeight]")
    scale = min(width / WIDTH, height / HEIGHT)
    for obj in data_of(page)["objects"][:3]:
        x, y, z = poses.camera.K @ poses.cam_from_world[17] @ [*obj["center"], 1]
        expected = [width / 2 + (x / z - WIDTH / 2) * scale, height / 2 + (y / z - 120) * scale]
        index = obj["id"]
        found = browser.eval(f"project(solid.find(o => o.id === {index}).center).slice(0, 2)")
        np.testing.assert_allclose(found, expected, atol=0.1)


def test_classes_can_be_hidden(browser: Browser, page: Path) -> None:
    browser.open(page)
    at = center_of(browser, 3)
    labels = "[...$('labels').children].map(l => l.textContent)"
    assert "3 suitcase" in browser.eval(labels)
    x, y = browser.eval("""(r => [r.left + r.width / 2, r.top + r.height / 2])(
        [...document.querySelectorAll('.class')].find(l => l.innerText.includes('suitcase'))
        .querySelector('input').getBoundingClientRect())""")
    browser.click(x, y)
    assert "3 suitcase" not in browser.eval(labels)
    browser.click(*at)
    assert browser.eval("state.selected") is None
    assert browser.eval("S.objects[2].row.hidden") is True


def test_mouse_turns_zooms_and_pans(browser: Browser, page: Path) -> None:
    browser.open(page)
    view = "[state.yaw, state.pitch, state.distance, ...state.target]"
    start = browser.eval(view)
    browser.drag((700, 300), (760, 320), "left")
    turned = browser.eval(view)
    assert turned[0] != start[0] and turned[1] != start[1] and turned[2:] == start[2:]
    browser.mouse("mouseWheel", 700, 300, deltaX=0, deltaY=-200)
    browser.settle()
    zoomed = browser.eval(view)
    assert zoomed[2] < turned[2]
    browser.drag((700, 300), (640, 300), "right")
    assert browser.eval(view)[3:] != zoomed[3:] and browser.eval("state.selected") is None


def test_fingers_and_a_phone_screen(browser: Browser, page: Path) -> None:
    browser.open(page, 390, 844, phone=True)
    view = "[state.yaw, state.distance]"
    start = browser.eval(view)
    browser.touch("touchStart", (200, 200))
    browser.touch("touchMove", (260, 200))
    browser.touch("touchEnd")
    assert browser.eval(view)[0] != start[0]
    browser.touch("touchStart", (180, 200), (220, 200))
    browser.touch("touchMove", (120, 200), (280, 200))
    browser.touch("touchEnd")
    assert browser.eval(view)[1] < start[1] / 2
    browser.open(page, 390, 844, phone=True)
    at = center_of(browser, 1)
    browser.touch("touchStart", at)
    browser.touch("touchEnd")
    assert browser.eval("state.selected?.id") == 1
    assert browser.eval("document.documentElement.scrollWidth") <= 390
    browser.picture(SCREENSHOTS / "phone.png")
    assert complaints(browser) == []


def test_parts_are_chosen_and_everything_follows(browser: Browser, parted_folder: Path) -> None:
    browser.open(parted_folder / "scene.html")
    rows = "[...document.querySelectorAll('.row b')].map(b => +b.textContent)"
    shown = "[solid.map(o => o.id), steps.length, posed.length, +$('slider').max, G.cloud.count]"
    assert browser.eval("[$('part').hidden, $('part').options.length]") == [False, 2]
    assert browser.eval("document.title") == "frames: 6 objects in 2 parts"
    assert browser.eval(rows) == [1, 2, 3]
    assert browser.eval(shown) == [[1, 2, 3], 40, 38, 39, 3]
    assert browser.eval("$('facts').textContent").startswith("cameras of 38 of 40 frames")
    before = browser.eval("radius")
    browser.eval("select(solid[0]); goTo(20)")
    browser.eval("$('part').value = 1; $('part').onchange()")
    browser.settle()
    assert browser.eval(rows) == [4, 5, 6]
    assert browser.eval(shown) == [[4, 5, 6], 24, 23, 23, 3]
    assert browser.eval("[state.step, state.selected, $('panel').innerHTML]") == [-1, None, ""]
    assert browser.eval("$('facts').textContent").startswith("cameras of 23 of 24 frames")
    assert 4 < browser.eval("radius") / before < 9  # 3 units a metre instead of .5
    solid = browser.eval("solid[1].center")
    np.testing.assert_allclose(solid, into_part(1, np.array([[0, 0.1, 0.41]]))[0], atol=0.1)
    browser.eval("S.parts[1].scale.rel_sigma = .77")
    browser.click(*center_of(browser, 5))
    assert browser.eval("$('panel').querySelector('h2').textContent") == "5 chair"
    assert "from priors, ± 77 %" in browser.eval("$('panel').querySelector('dl').textContent")
    picture = "document.querySelectorAll('.crops figure')"
    browser.eval(f"[...{picture}].forEach(f => {{ f.click(); }})")
    assert browser.eval("S.steps.part[state.step]") == 1
    browser.eval("$('slider').value = 23; $('slider').oninput()")
    assert browser.eval("[state.step, $('clock').textContent]") == [63, "frame 63"]
    browser.eval("$('play').click()")  # from the end of the part to its first frame
    moved = "new Promise(f => setInterval(() => state.step !== 63 && f(state.step), 20))"
    assert 40 <= browser.eval(moved) < 60
    browser.eval("$('play').click(); goTo(3)")  # of the other part
    assert browser.eval(f"[+$('part').value, +$('slider').value, {rows}]") == [0, 3, [1, 2, 3]]
    for phone in (False, True):
        size = {"width": 390, "height": 780} if phone else {"width": 1280, "height": 800}
        browser.open(parted_folder / "scene.html", **size, phone=phone)
        browser.eval("enter(1); goTo(50)")
        browser.settle()
        assert browser.eval("document.documentElement.scrollWidth <= innerWidth")
        browser.picture(SCREENSHOTS / f"parts-{'phone' if phone else 'desktop'}.png")
    assert complaints(browser) == []


def test_one_part_has_no_selector(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert browser.eval("[$('part').hidden, $('part').offsetWidth]") == [True, 0]


def test_identities_only_still_open(browser: Browser, tmp_path: Path) -> None:
    """No cameras: pictures and a timeline, and the reason."""
    browser.open(write_page(tmp_path / "flat", in_3d=False))
    assert "No 3D view: no camera poses" in browser.eval("$('why').innerText")
    browser.eval("S.objects[1].row.click(); goTo(3)")
    browser.settle()
    assert browser.eval("document.querySelectorAll('.crops img').length") == 8
    assert browser.eval("S.objects[1].row.querySelectorAll('.bar span').length") == 2
    rows = "[...document.querySelectorAll('.row')].map((row) => row.className.split(' ')[1])"
    assert set(browser.eval(rows)) == {"tracked"}
    assert "tracked" in browser.eval("$('panel').innerText")
    colors = "[S.objects[0].row, $('list')].map((e) => getComputedStyle(e).color)"
    assert len(set(browser.eval(colors))) == 1  # not dimmed: there is nothing to set it apart from
    browser.picture(SCREENSHOTS / "flat.png")
    assert complaints(browser) == []


def test_without_webgl_the_list_remains(browser: Browser, page: Path) -> None:
    source = "HTMLCanvasElement.prototype.getContext = () => null"
    script = browser.send("Page.addScriptToEvaluateOnNewDocument", source=source)
    browser.open(page)
    browser.send("Page.removeScriptToEvaluateOnNewDocument", **script)
    assert "no WebGL" in browser.eval("$('why').innerText")
    browser.eval("S.objects[1].row.click()")
    assert "size, m" in browser.eval("$('panel').innerText") and complaints(browser) == []


# ---- Without a browser ----


def test_same_input_same_page(page: Path, tmp_path: Path) -> None:
    assert write_page(tmp_path / "again").read_bytes() == page.read_bytes()


def test_no_name_can_leave_the_data(page: Path) -> None:
    text = page.read_text()
    assert EVIL not in text and text.count("</script>") == 2 and text.count("<script") == 2
    assert data_of(page)["objects"][1]["class"] == EVIL
    assert "http://" not in text and "https://" not in text and "default-src 'none'" in text


def test_the_page_holds_the_scene(page: Path) -> None:
    data, poses = data_of(page), poses_of_walk()
    found = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(-1, 3, 4)
    np.testing.assert_allclose(found, invert_rigid(poses.cam_from_world), atol=1e-6)
    (part,) = data["parts"]
    points = np.frombuffer(base64.b64decode(part["points"]), "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, poses.points, atol=1e-6)
    assert data["objects"][1]["seen"] == [0, 8, 15, 23] and part["up"] == [0, 0, 1]
    assert [tuple(o["color"]) for o in data["objects"]] == [
        object_color(i)[::-1] for i in (1, 2, 3, 4)
    ]
    assert part["facts"] == "cameras of 23 of 24 frames · scale from poses, ± 0 %"
    assert data["steps"] == {
        "frame": list(range(24)), "seconds": pytest.approx(1 / 30), "part": [0] * 24,
    }  # fmt: skip
    assert "cov" not in data["objects"][0] and data["why_flat"] == ""


def test_the_data_are_strict_json(page: Path) -> None:
    """Browsers refuse NaN and Infinity; frame 5 has no pose."""

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    text = page.read_text().split('id="data">')[1].split("</script>")[0]
    json.loads(text, parse_constant=refuse)
    assert "<" not in text  # no name can end the script


def test_scene_can_be_switched_off(tmp_path: Path) -> None:
    assert not write_page(tmp_path / "off", scene=False).exists()


def test_three_minutes_stay_below_ten_megabytes(tmp_path: Path) -> None:
    """5,400 frames, 50 objects, 100,000 points, and pictures that do not compress at all."""
    frames, objects = 5400, 50
    rng = np.random.default_rng(0)
    at = poses_of_walk()
    frame, obj = (a.ravel() for a in np.mgrid[:frames, :objects])
    corner = rng.uniform(0, 100, (len(frame), 2))
    box = np.hstack([corner, corner + rng.uniform(30, 130, (len(frame), 2))])
    score = np.full(len(frame), 0.9)
    tracks = rt.Tracks(frame, obj + 1, obj + 1, box, score, 0 * obj, obj)
    poses = dataclasses.replace(
        at,
        frame=np.arange(frames),
        time_s=np.arange(frames) / 30,
        cam_from_world=np.repeat(at.cam_from_world, frames // FRAMES, 0),
        status=np.full(frames, "pnp"),
        points=rng.normal(size=(100_000, 3)),
        colors=rng.integers(0, 255, (100_000, 3)).astype(np.uint8),
    )
    result = dataclasses.replace(fitted(tracks, None, names=("chair",)), poses=poses)
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    video = rt.Video(tmp_path / "0.png")
    pictures = Pictures(result, video)
    noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for index in sorted({*frame[pictures.wanted].tolist(), *pictures.whole}):
        pictures.take(rt.Frame(int(index), index / 30, noise))
    write_scene(result, pictures, tmp_path / "scene.html", video)
    assert 2e6 < (tmp_path / "scene.html").stat().st_size < 10e6


def test_pictures_show_the_object(tmp_path: Path) -> None:
    """Crops and frames of a video that is read at half its size: the green box is in place."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[60:120, 200:280] = (0, 255, 0)
    cv2.imwrite(str(tmp_path / "0.png"), image)
    zero, one = np.zeros(1, np.int64), np.ones(1, np.int64)
    box = np.array([[200.0, 60, 280, 120]])
    result = fitted(rt.Tracks(zero, one, one, box, np.ones(1), zero, zero), None)
    video = rt.Video(tmp_path / "0.png", rt.InputConfig(max_size=WIDTH // 2))
    pictures = Pictures(result, video)
    for frame in video:
        pictures.take(frame)
    jpeg = [np.frombuffer(base64.b64decode(d), np.uint8) for d in
            (pictures.crops[1][0][1], pictures.frames[0][1])]  # fmt: skip
    crop, whole = (cv2.imdecode(data, cv2.IMREAD_COLOR) for data in jpeg)
    assert crop.shape[1] / crop.shape[0] == pytest.approx(80 / 60, abs=0.1)
    assert crop[8:-8, 8:-8, 1].min() > 200  # the margin is 10 % on each side, 3 or 4 pixels here
    assert crop[[0, -1]].max() < 60 and crop[:, [0, -1]].max() < 60
    assert whole.shape[:2] == (HEIGHT // 2, WIDTH // 2) and whole[45, 120, 1] > 200


def test_pictures_show_different_views() -> None:
    """The views chosen of an object are spread over time and directions, not neighbours."""
    poses = poses_of_walk()
    tracks = tracks_of_walk(poses)
    found = rt.Object(3, "suitcase", 1.0, "ok", "", center=np.array(CENTERS[2]))
    frames = np.sort(tracks.frame[diverse_rows(tracks, found, poses, 4)])
    assert len(frames) == 4 and np.diff(frames).min() >= 4 and 5 not in frames
    assert set(tracks.track_id[diverse_rows(tracks, found, None, 30)]) == {3}


def test_views_from_other_sides_are_shown() -> None:
    """The camera stands still for 21 frames, then it looks from three other sides, a frame each."""
    poses = poses_of_walk()
    tracks = tracks_of_walk(poses)
    found = rt.Object(3, "suitcase", 1.0, "ok", "", center=np.array(CENTERS[2]))
    cams = np.repeat(poses.cam_from_world[:1], FRAMES, 0)
    eyes = np.array([[4.0, 0, 1], [0, 4, 1], [0, 0, 5]]) + found.center
    cams[-3:, :, 3] = -np.einsum("fij,fj->fi", cams[-3:, :, :3], eyes)
    still = dataclasses.replace(poses, cam_from_world=cams)
    own = np.flatnonzero(tracks.track_id == 3)
    tracks.xyxy[own] = [0, 0, 50, 50]  # equally good
    late = [(tracks.frame[diverse_rows(tracks, found, p, 4)] > 20).sum() for p in (still, None)]
    assert late[0] >= 2 and late[1] == 1  # by time alone: the last one


def test_views_are_those_of_the_cameras_of_the_part(parted: rt.Result) -> None:
    wanted = set(Pictures(parted, VIDEO).wanted.tolist())
    for o in parted.objects:
        chosen = [
            diverse_rows(parted.tracks, o, poses, 8).tolist()
            for poses in (parted.poses.of_part(o.part), parted.poses.of_part(1 - o.part))
        ]
        assert chosen[0] != chosen[1] and wanted >= set(chosen[0])


def test_boxes_are_drawn_in_small_frames(tmp_path: Path) -> None:
    """A frame of 960 px is shown with 320, and its boxes too."""
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((720, 960, 3), np.uint8))
    zero, one = np.zeros(1, np.int64), np.ones(1, np.int64)
    box = np.array([[300.0, 300, 600, 600]])
    result = fitted(rt.Tracks(zero, one, one, box, np.ones(1), zero, zero), None)
    video = rt.Video(tmp_path / "0.png")
    pictures = Pictures(result, video)
    for frame in video:
        pictures.take(frame)
    ((_, text),) = pictures.frames
    image = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (240, 320, 3)
    x = np.flatnonzero(image[150].max(1) > 80)
    np.testing.assert_allclose([x.min(), x.max()], [100, 200], atol=2)


def test_the_best_picture_comes_first() -> None:
    tracks = tracks_of_walk(poses_of_walk())
    own = np.flatnonzero(tracks.track_id == 3)
    tracks.xyxy[own[7]] = [0, 0, 300, 200]  # the largest box
    found = rt.Object(3, "suitcase", 1.0, "rejected", "")
    assert diverse_rows(tracks, found, None, 3)[0] == own[7]
    weak = with_columns(tracks, score=np.where(np.arange(len(tracks)) == own[7], 0.01, 0.9))
    assert diverse_rows(weak, found, None, 3)[0] != own[7]


def test_pictures_are_cut_of_wanted_frames_only() -> None:
    """Each picture has the number of the frame that it was cut from, and is there once."""
    tracks = tracks_of_walk(poses_of_walk())
    pictures = Pictures(fitted(tracks, None, names=NAMES), VIDEO)
    rows = pictures.wanted
    wanted = set(zip(tracks.frame[rows].tolist(), tracks.track_id[rows].tolist(), strict=True))
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for index in range(FRAMES):
        pictures.take(rt.Frame(index, index / 30, image))
    cut = [(f, i) for i, crops in pictures.crops.items() for f, _ in crops]
    assert set(cut) == wanted and len(cut) == len(wanted) and {i for _, i in cut} == {1, 2, 3, 4}
    assert all(4 <= len(crops) <= 8 for crops in pictures.crops.values())
    assert [f for f, _ in pictures.frames] == list(range(FRAMES))


def test_up_is_guessed_from_level_cameras(tmp_path: Path) -> None:
    """Without objects or poses that tell: the cameras of the walk are level, z is up."""
    poses = dataclasses.replace(poses_of_walk(), up_in_world=None)
    result = rt.Result(tracks_of_walk(poses), NAMES, VideoInfo("a", WIDTH, HEIGHT, 25.0))
    result.poses, result.world = poses, rt.World("m", "user", 23, 0, 24)
    write_scene(result, Pictures(result, VIDEO), tmp_path / "a.html", VIDEO)
    (part,) = data_of(tmp_path / "a.html")["parts"]
    np.testing.assert_allclose(part["up"], [0, 0, 1], atol=0.05)
    assert part["facts"].endswith("units: m · up is guessed from the cameras")


def test_long_videos_are_thinned(tmp_path: Path) -> None:
    """4,000 frames: the slider has every third one, and plays as long as the video."""
    poses = walk(4000)
    tracks = tracks_of(poses, 0.0)
    result = dataclasses.replace(fitted(tracks[tracks.frame < 9], None), poses=poses)
    result.tracks = tracks[np.isin(tracks.frame, [30, 31, 32, 33, 300])]
    write_scene(result, Pictures(result, VIDEO), tmp_path / "a.html", VIDEO)
    data = data_of(tmp_path / "a.html")
    assert data["steps"]["frame"] == list(range(0, 4000, 3))
    assert data["steps"]["seconds"] * 1334 == pytest.approx(4000 / 30)
    assert data["objects"][0]["seen"] == [10, 11, 100, 100]
    assert len(base64.b64decode(data["poses"])) == 1334 * 48


class Source:
    """A video that counts how often its frames are read, and can be interrupted."""

    has_images = True

    def __init__(self, video: Any, live: bool = False) -> None:
        self.config, self.size, self.scale, self.fps = (
            getattr(video, name) for name in ("config", "size", "scale", "fps")
        )
        self.video, self.is_live, self.source, self.expected = video, live, "a.mp4", FRAMES
        self.read, self.stop_at = 0, -1

    def __iter__(self) -> Iterator[rt.Frame]:
        assert not self.is_live, "it cannot be read again"
        for frame in self.video:
            self.read += 1
            if self.read == self.stop_at:
                raise KeyboardInterrupt
            yield frame


def test_one_pass_writes_both_and_leaves_nothing_half(tmp_path: Path) -> None:
    """Interrupted in the middle: no film, no page. Else each frame is read once for both."""
    write_page(tmp_path / "a", scene=False)
    out, source = tmp_path / "a/out", Source(rt.Video(tmp_path / "a/frames"))
    result = fitted(tracks_of_walk(poses_of_walk()), None, names=NAMES)
    source.stop_at = 10
    with pytest.raises(KeyboardInterrupt):
        write_pictures(result, out, source)  # type: ignore[arg-type]
    made = {p.name for p in out.iterdir()}
    assert not made & {"overlay.mp4", "scene.html"} and not [n for n in made if n[0] == "."]
    source.read, source.stop_at = 0, -1
    write_pictures(result, out, source)  # type: ignore[arg-type]
    assert source.read == FRAMES
    assert {"overlay.mp4", "scene.html"} <= {p.name for p in out.iterdir()}
    source.read = 0
    write_pictures(result, out, source, overlay="none", scene=False)  # type: ignore[arg-type]
    assert source.read == 0


def test_a_live_source_has_a_page_without_pictures(tmp_path: Path) -> None:
    result = fitted(tracks_of_walk(poses_of_walk()), None, names=NAMES)
    result.warnings.append("a live source cannot be read twice: identities only")
    write_pictures(result, tmp_path, Source(VIDEO, live=True))  # type: ignore[arg-type]
    assert [p.name for p in tmp_path.iterdir()] == ["scene.html"]
    data = data_of(tmp_path / "scene.html")
    assert data["thumbs"] == [] and "identities only" in data["why_flat"]
    assert [o["crops"] for o in data["objects"]] == [[]] * 4
