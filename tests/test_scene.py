"""The 3D viewer in a real browser, and its file: content, size and escaping."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import Browser
from scipy.spatial.transform import Rotation
from simulated import finished, fitted, into_component, turn, unlinked

import quadrics
import reobj.viewer.scene as scene
import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.files import Progress, decimals
from reobj.results.changes import Change, Changes, EarlierSession, Shape
from reobj.results.result import VideoInfo
from reobj.types import object_color
from reobj.viewer.scene import (
    Pictures,
    best_pictures,
    diverse_rows,
    page_text,
    write_pictures,
)

EVIL = "</script><script>window.hacked=1</script><img src=x onerror=hacked=1>"


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
        camera=rt.Camera("PINHOLE", WIDTH, HEIGHT, (250.0, 250.0, WIDTH / 2 + 10, HEIGHT / 2 - 8)),
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
    result = dataclasses.replace(result, world=dataclasses.replace(result.world, links=(link,)))
    result.save(folder / "out")
    write_pictures(result, folder / "out", video, overlay=False, scene=scene)
    return folder / "out/scene.html"


def data_of(page: Path) -> Any:
    """The data embedded in a page."""
    text = page.read_text()
    return json.loads(text.split('id="data">')[1].split("</script>")[0])


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("scene") / "a")


class Facts:
    """Replaces a video of which only the metadata are used."""

    config, fps, scale, source, is_live = rt.InputConfig(), 30.0, 1.0, "a.mp4", False
    files = ()
    has_images = True
    size = (WIDTH, HEIGHT)


VIDEO: Any = Facts()
VIEW = """[controls.getAzimuthalAngle(), controls.getPolarAngle(), controls.getDistance(),
    ...controls.target]"""


def center_of(browser: Browser, number: int) -> tuple[float, float]:
    """Position of an object's centre in the window."""
    x, y, left, top = browser.eval(
        f"(r => [...project(solid.find(o => o.id === {number}).at).slice(0, 2), r.left, r.top])"
        "($('view').getBoundingClientRect())"
    )
    return x + left, y + top


# ---- In the browser ----


def test_a_click_on_an_object_opens_its_panel(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert browser.eval("!!gl && document.title") == "a: 3 objects with a shape, 1 without"
    for number, name in zip((1, 2, 3), NAMES, strict=False):
        browser.click(*center_of(browser, number))
        assert browser.eval("state.selected.id") == number
        text = browser.eval("$('panel').innerText")
        assert f"{name} {number}" in text
        assert all(side in text for side in ("width", "depth", "height", "±", " m (", "tracklets"))
        wide = browser.eval("""Promise.all([...document.querySelectorAll('.crops img')]
            .map(i => i.decode().then(() => i.naturalWidth)))""")
        assert len(wide) == 8 and min(wide) > 8
    browser.press("Escape")
    assert browser.eval("[$('panel').innerText, state.selected]") == ["", None]
    assert browser.eval("window.hacked") is None and browser.errors == []


def test_the_list_has_reasons_joins_and_statuses(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert browser.eval("here[3].row.innerText").startswith("person 4")
    browser.eval("here[3].row.click()")
    assert "rejected: objects of this class move" in browser.eval("$('panel').innerText")
    assert "a <b>warning</b>" in browser.eval("$('list').innerText")
    browser.eval("select(objects[1])")
    text = browser.eval("$('panel').innerText")
    assert "overlap in 3D 0.12, log odds of the appearance 1.99" in text
    state = "[here[2].row.hidden, here[2].group.visible, here[2].group.parts.wire.material.dashed]"
    browser.eval("S.objects[2].status = 'doubtful'; replay(); draw()")
    assert browser.eval(state)[:2] == [True, False]
    assert browser.eval("$('notes').innerText").startswith("1 object of low confidence")
    browser.eval("$('doubtful').click(); draw()")
    assert browser.eval(state)[:2] == [False, True]
    browser.eval("""Object.assign(S.objects[2], { status: 'implausible',
        reason: 'size is 7.2 sigma' }); replay(); fillScene(); draw()""")
    assert browser.eval(state) == [False, True, True]
    assert browser.eval("here[2].row.title") == "size is 7.2 sigma"
    assert browser.errors == []


def test_the_slider_plays_the_cameras(browser: Browser, page: Path) -> None:
    browser.open(page)
    before = browser.page.screenshot()
    browser.eval("$('slider').focus()")
    browser.press("End")
    assert browser.eval("[state.step, $('clock').textContent]") == [23, "frame 23"]
    assert browser.eval("$('frame').querySelector('img').naturalWidth") > 100
    assert browser.page.screenshot() != before
    browser.eval("goTo(10)")
    seen = "here.filter(o => o.row.classList.contains('now')).map(o => o.id)"
    assert browser.eval(seen) == [1, 3, 4]
    browser.eval("goTo(5)")
    assert browser.eval("$('clock').textContent") == "frame 5 (no pose)"
    browser.eval("S.steps.seconds = .2; $('play').click()")
    assert browser.eval("$('play').getAttribute('aria-label')") == "pause"
    browser.wait("state.step === 6")
    browser.eval("$('play').click()")
    assert browser.eval("$('play').getAttribute('aria-label')") == "play"
    assert browser.errors == []


def test_wireframes_have_the_extent_of_the_shapes(browser: Browser, page: Path) -> None:
    """The drawn edges, projected, span the box of the shape projected by quadrics."""
    browser.open(page)
    browser.eval("setRide(true); goTo(9)")
    browser.settle()
    poses, scale = poses_of_walk(), browser.eval("pictureRect()")
    for obj in data_of(page)["objects"][:3]:
        axes = Rotation.from_quat(np.array(obj["quat_wxyz"])[[1, 2, 3, 0]]).as_matrix()
        columns = (np.array(obj[n])[None] for n in ("center", "half_axes"))
        solid = quadrics.Ellipsoids(*columns, axes[None])
        img_from_world = poses.camera.K @ poses.cam_from_world[9:10]
        (true,) = quadrics.solid_boxes(solid, obj["support"], img_from_world)[0]
        found = browser.eval(f"""(o => {{ const at = [];
            for (let i = 0; i < EDGES[o.support].length; i += 3) at.push(project(new THREE.Vector3(
              ...EDGES[o.support].slice(i, i + 3)).applyMatrix4(o.group.matrix).toArray()));
            return [Math.min, Math.max].flatMap(f => [0, 1].map(k => f(...at.map(a => a[k]))));
            }})(solid.find(o => o.id === {obj["id"]}))""")
        shift = np.array([scale["x"], scale["y"]] * 2)
        np.testing.assert_allclose((np.array(found) - shift) / scale["scale"], true, atol=0.6)


def test_following_a_camera_shows_its_frame(browser: Browser, page: Path) -> None:
    """Only frames with an image and a pose are shown, aligned with the camera's pixels."""
    browser.open(page)
    browser.eval("S.thumbs = S.thumbs.filter(([frame]) => frame % 4 === 0); goTo(10)")
    browser.eval("setRide(true)")
    browser.settle()
    shown = "[state.step, $('back').dataset.frame, $('back').hidden]"
    assert browser.eval(shown) == [8, "8", False]
    rect = browser.eval("pictureRect()")
    box = browser.eval("(({left, top, width}) => [left, top, width])($('back').style)")
    expected = [rect["x"], rect["y"], WIDTH * rect["scale"]]
    np.testing.assert_allclose([float(x.removesuffix("px")) for x in box], expected, atol=0.01)
    browser.eval("$('boxes').click()")
    browser.settle()
    assert browser.eval("document.querySelectorAll('#drawn .box').length") == 4
    for key, step in (("ArrowRight", 12), ("ArrowLeft", 8)):
        browser.press(key)
        assert browser.eval("state.step") == step
    browser.drag((700, 300), (760, 320), "left")
    assert browser.eval("[state.ride, $('back').hidden]") == [False, True]
    browser.eval("setFollow(true); goTo(22)")
    x, y, _ = browser.eval("project(cams[22].at)")
    width, height = browser.eval("[canvas.clientWidth, canvas.clientHeight]")
    assert 0.2 * width < x < 0.8 * width and 0.1 * height < y < 0.9 * height
    assert browser.errors == []


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_first_view_frames_the_room_below_the_buttons(
    browser: Browser, page: Path, width: int, height: int
) -> None:
    """A distant object has no effect; points and trajectory are in the view and fill it."""
    browser.open(page, width, height, phone=width < 700)
    start = browser.eval(VIEW)
    top = browser.eval("$('tools').offsetTop + $('tools').offsetHeight")
    size = np.array(browser.eval("[canvas.clientWidth, canvas.clientHeight]"))
    for view in ("top", "front", "reset"):
        browser.eval(f"VIEWS.{view}(); draw()")
        seen = np.array(browser.eval("room.anchors.map(a => project(a).slice(0, 2))"))
        assert (seen >= [0, top]).all() and (seen <= size).all(), view
    assert (np.ptp(seen, axis=0) / size).max() > 0.7
    browser.eval("S.objects[0].center = [400, 300, 0]; replay(); enter(0)")
    np.testing.assert_allclose(browser.eval(VIEW), start)
    bar = browser.eval("[$('bar').innerText, $('bar').querySelector('i').offsetWidth]")
    assert bar[0].endswith(" m") and 40 < bar[1] < 200


def test_a_distance_has_the_sigma_of_both_ends_and_of_the_scale(
    browser: Browser, page: Path
) -> None:
    """Against finite differences of the end points, and the covariances of the file."""
    browser.open(page)
    browser.eval("S.parts[0].scale.rel_sigma = .1; enter(0); setMeasure(true)")
    for number in (1, 3):
        browser.click(*center_of(browser, number))
    ends = browser.eval("state.measured.map(({ at, object }) => [at, object.id])")
    assert [number for _, number in ends] == [1, 3]
    rows = np.array(browser.eval("level.rows"))  # level from world; both in metres here
    height = browser.eval("level.height")
    points = [(np.array(at) + np.array([0, 0, height])) @ rows for at, _ in ends]
    along = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
    variance = (0.1 * np.linalg.norm(points[1] - points[0])) ** 2
    for point, (_, number) in zip(points, ends, strict=True):
        obj = data_of(page)["objects"][number - 1]
        turn = Rotation.from_quat(np.array(obj["quat_wxyz"])[[1, 2, 3, 0]])
        half = np.array(obj["half_axes"])
        local = turn.inv().apply(point - obj["center"]) / half
        assert np.abs(local).max() == pytest.approx(1, abs=1e-4)  # it lies on the surface

        def moved(p: np.ndarray, o: Any = obj, t: Any = turn, h: Any = half, x: Any = local) -> Any:
            return o["center"] + p[:3] + (t * Rotation.from_rotvec(p[6:])).apply(
                np.exp(p[3:6]) * h * x)  # fmt: skip

        step = 1e-6 * np.eye(9)
        jacobian = np.array([(moved(e) - moved(-e)) / 2e-6 for e in step]).T  # (3, 9)
        cov = np.frombuffer(base64.b64decode(obj["cov"]), "<f4").reshape(9, 9)
        variance += along @ jacobian @ cov @ jacobian.T @ along
    value, sigma = browser.eval("distanceOf(state.measured)")
    assert value == pytest.approx(np.linalg.norm(points[1] - points[0]))
    assert sigma == pytest.approx(np.sqrt(variance), rel=1e-3)
    digits = decimals(sigma)
    text = browser.eval("document.querySelector('.measure text').textContent")
    assert text == f"{value:.{digits}f} ± {sigma:.{digits}f} m"
    for sigma in (0.2, 0.046, 0.0099, 0.01, 3.0, 30.0, 0.0):
        assert browser.eval(f"decimals({sigma})") == decimals(sigma)
    browser.press("Escape")
    assert browser.eval("document.querySelector('.measure text')") is None
    browser.open(page)  # the scale of the file again
    browser.eval("setMeasure(true); state.hidden = new Set(here.map(o => o.class)); draw()")
    array = "cloud.geometry.attributes.position.array"
    for i in (30, 300):
        browser.eval(f"measureAt(...project([...{array}.slice({i}, {i} + 3)]).slice(0, 2))")
    noise = data_of(page)["parts"][0]["point_sigma"]
    assert browser.eval("distanceOf(state.measured)[1]") == pytest.approx(noise * 2**0.5)
    assert browser.errors == []


def test_the_list_is_searched_sorted_and_filtered(browser: Browser, page: Path) -> None:
    browser.open(page)
    objects = data_of(page)["objects"]
    sides = " \u00d7 ".join(side for side, _ in objects[0]["sides"])
    mark = "≈ " if objects[0]["status"] == "prior_dominated" else ""
    assert browser.eval("here[0].row.innerText").strip() == f"chair 1 · {mark}{sides} m"
    order = """[...document.querySelectorAll('.row')].filter(r => !r.hidden)
        .map(r => +r.querySelector('b').textContent.split(' ').at(-1))"""
    opacity = "(draw(), solid.map(o => o.group.parts.wire.material.opacity))"
    before = browser.eval(opacity)
    for words, found in (("SUIT", [3]), ("case 3", [3]), ("zebra", []), ("", [1, 2, 3, 4])):
        browser.eval(f"$('search').value = '{words}'; $('search').oninput()")
        assert browser.eval(order) == found
        dimmed = np.array(browser.eval(opacity)) < 0.3 * min(before)
        assert dimmed.tolist() == [number not in found for number in (1, 2, 3)]
    browser.eval("$('sort').value = 'seen'; $('sort').onchange()")
    assert browser.eval(order) == [1, 3, 4, 2]
    state = "(draw(), [here.map(o => o.row.hidden), solid.map(o => o.group.visible)])"
    button = "[...document.querySelectorAll('{}')].find(b => b.textContent.includes('{}')).click()"
    for place, name, hidden in (
        ("#classes label", "suitcase", [3]), ("#classes button", "none", [1, 2, 3, 4]),
        ("#classes button", "all", []),
    ):  # fmt: skip
        browser.eval(button.format(place, name))
        rows = [i in hidden for i in (1, 2, 3, 4)]
        assert browser.eval(state) == [rows, [not row for row in rows[:3]]], name
    browser.eval("select(here[1]);" + button.format("#panel button", "Hide"))
    assert browser.eval(state)[1] == [True, False, True]
    browser.eval("select(here[2]);" + button.format("#panel button", "Show only this"))
    assert browser.eval(state)[1] == [False, False, True]
    browser.eval("$('show-all').click()")
    assert browser.eval(state) == [[False] * 4, [True] * 3] and browser.errors == []


def test_corrections_made_in_the_viewer_are_applied(
    browser: Browser, broken_walk_folder: Path, tmp_path: Path
) -> None:
    """Merge, rename, delete, undo; the saved file gives the same objects in Python."""
    out = shutil.copytree(broken_walk_folder, tmp_path / "out")
    browser.open(out / "scene.html")
    browser.eval("select(here[0])")
    browser.eval("[...document.querySelectorAll('#panel button')]"
                 ".find(b => b.textContent.startsWith('Merge')).click()")  # fmt: skip
    assert "chair 1" in browser.eval("$('hint').textContent")
    browser.press("Escape")
    browser.eval("state.merging = here[1]; enter(1)")
    browser.click(*center_of(browser, 4))
    assert browser.eval("pending.map(said)") == ["merge 2 with 4"]
    browser.eval("enter(0); edit(edits.rename(here.find(o => o.id === 1), 'armchair'))")
    browser.eval("edit(edits.delete(objects.find(o => o.id === 5)))")
    browser.eval("edit(edits.delete(objects.find(o => o.id === 6)))")
    browser.press("u")
    merged = "(o => [o.visits.length, o.tracklets.length])(objects.find(o => o.id === 2))"
    assert browser.eval(merged) == [1, 2]
    shown = browser.eval("objects.map(o => [o.id, o.class])")
    assert [number for number, _ in shown] == [1, 2, 3, 6]
    with browser.page.expect_download() as download:
        browser.eval("$('save').click()")
    download.value.save_as(tmp_path / "edits.json")
    command = browser.eval("$('saved').querySelector('code').innerText")
    assert command == f"python -m reobj_track objects {broken_walk_folder} --edits edits.json"
    assert rt.main(["objects", str(out), "--edits", str(tmp_path / "edits.json")]) == 0
    assert [[o.id, o.class_name] for o in rt.Result.load(out).objects] == shown
    browser.open(out / "scene.html")
    assert browser.eval("[objects.map(o => [o.id, o.class]), S.edits.length]") == [shown, 3]
    browser.eval("document.querySelector('#edits li button').click()")  # take the merge back
    browser.eval("edit(edits.splitTracklet(objects[1], objects[1].tracklets[1][0]))")
    assert browser.eval("objects.map(o => [o.id, o.tracklets.length])")[-1] == [7, 1]
    assert [e["do"] for e in json.loads(browser.eval("editsFile()"))["edits"]] == [
        "rename", "delete", "split"
    ]  # fmt: skip
    assert browser.errors == []
    browser.click(700, 780)  # else the browser shows no dialog
    before = browser.asked
    browser.page.reload()  # unsaved corrections: the browser shows a dialog
    assert browser.asked == before + 1


def test_a_visit_is_split_at_the_slider(
    browser: Browser, broken_walk_folder: Path, tmp_path: Path
) -> None:
    """The preview has the frames that the split gives in Python, also after a second split."""
    out = shutil.copytree(broken_walk_folder, tmp_path / "out")
    browser.open(out / "scene.html")
    browser.eval("select(here[1]); goTo(13); $('cut').querySelector('button').click()")
    assert browser.eval("pending.map(said)") == ["split frames 13\u201339 off 2"]
    browser.eval("select(here.find(o => o.id === 7)); goTo(30)")
    browser.eval("$('cut').querySelector('button').click()")
    browser.eval("edit(edits.rename(objects.find(o => o.id === 8), 'stool'))")
    shown = browser.eval("objects.map(o => [o.id, o.class, o.visits, pairs(o.seen)])")
    assert {i: v for i, _, v, _ in shown if i in (2, 7, 8)} == {
        2: [[0, 12]], 7: [[13, 29]], 8: [[30, 39]],
    }  # fmt: skip
    assert all(visits == seen for _, _, visits, seen in shown)  # each step is a frame here
    (tmp_path / "e.json").write_text(browser.eval("editsFile()"))
    assert rt.main(["objects", str(out), "--edits", str(tmp_path / "e.json")]) == 0
    found = [[o.id, o.class_name, o.visits] for o in rt.Result.load(out).objects]
    assert found == [row[:3] for row in shown] and browser.errors == []


def test_a_link_leads_to_the_view_and_the_object(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.drag((700, 300), (760, 320), "left")
    browser.eval("goTo(7); select(here[1]); $('copy-link').click()")
    browser.settle()
    link, view = browser.eval("[location.href, " + VIEW + "]")
    browser.open(link)
    np.testing.assert_allclose(browser.eval(VIEW), view, atol=1e-3)
    assert browser.eval("[state.selected.id, frameOf(state.step)]") == [2, 7]
    for bad in ("#eye=1,2&target=3", "#part=0&eye=1,2,3&target=0,0,0&object=77&frame=-5"):
        browser.open(link.split("#")[0] + bad)
        assert browser.eval("[state.selected, state.step]") == [None, -1]
    assert browser.errors == []


def image_of(png: bytes) -> np.ndarray:
    """A screenshot, BGR."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))


def test_a_picture_of_the_view_is_saved(browser: Browser, page: Path) -> None:
    """It has the pixels of the 3D view, and its labels."""
    browser.open(page)
    with browser.page.expect_download() as download:
        browser.eval("$('save-picture').click()")
    image = image_of(Path(download.value.path()).read_bytes())
    width, height = browser.eval("[$('view').clientWidth, $('view').clientHeight]")
    assert image.shape[:2] == (height, width)
    left, top = browser.eval("(r => [r.left, r.top])($('view').getBoundingClientRect())")
    shown = image_of(browser.page.screenshot())
    same = shown[int(top) : int(top) + height, int(left) : int(left) + width].astype(int)
    assert (np.abs(same - image).max(-1)[60:] < 12).mean() > 0.97 and browser.errors == []


def test_the_top_view_is_aligned_with_the_walls(
    browser: Browser, page: Path, tmp_path: Path
) -> None:
    """Points of four walls, turned by 31 degrees."""
    rng = np.random.default_rng(4)
    along = rng.uniform(-3, 3, 2000)
    across = np.where(rng.random(2000) < 0.5, -2.0, 2.0)
    first = rng.random(2000) < 0.6
    xy = np.stack([np.where(first, along, 1.5 * across), np.where(first, across, along * 2 / 3)], 1)
    turn = Rotation.from_euler("z", 31, degrees=True).as_matrix()[:2, :2]
    xy = xy @ turn.T + rng.normal(scale=0.02, size=(2000, 2))
    points = np.column_stack([xy, rng.uniform(0, 2.5, 2000)])
    data = data_of(page)
    data["parts"][0]["points"] = base64.b64encode(points.astype("<f4").tobytes()).decode()
    data["parts"][0]["colors"] = base64.b64encode(bytes(6000)).decode()
    (tmp_path / "a.html").write_text(scene._page_of(data, None))
    browser.open(tmp_path / "a.html")
    browser.press("1")
    ends = [[0.0, 0.0, 1.0], [*turn[:, 0].tolist(), 1.0]]  # along a wall
    a, b = (browser.eval(f"project(level.place({end})).slice(0, 2)") for end in ends)
    off = np.degrees(np.arctan2(b[1] - a[1], b[0] - a[0])) % 90
    assert min(off, 90 - off) < 1.5 and browser.errors == []


def test_fingers_on_a_phone_screen(browser: Browser, page: Path) -> None:
    """Turn, zoom, select, rotate around an object, and end merging without a merge."""
    browser.open(page, 390, 844, phone=True)
    start = browser.eval(VIEW)
    browser.touch([(200, 200)], [(260, 200)])
    assert browser.eval(VIEW)[0] != start[0]
    browser.touch([(180, 200), (220, 200)], [(120, 200), (280, 200)])
    assert browser.eval(VIEW)[2] < start[2] / 2
    browser.eval("VIEWS.reset(); draw()")
    at = center_of(browser, 3)
    for _ in range(2):
        browser.touch([at])
    browser.wait("state.selected?.id === 3")
    target = browser.eval("controls.target.toArray()")
    np.testing.assert_allclose(target, browser.eval("state.selected.at"), atol=1e-9)
    merge = "[...document.querySelectorAll('#panel button')].find(b => /^Merge/.test(b.innerText))"
    browser.eval(f"{merge}.click()")
    hint = browser.eval("$('hint').textContent")
    assert hint.startswith("tap the object") and "Esc" not in hint
    browser.eval(f"{merge}.click()")
    assert browser.eval("[state.merging, $('hint').hidden, pending.length]") == [None, True, 0]
    assert browser.errors == []


def test_menus_and_targets_fit_a_phone(browser: Browser, page: Path) -> None:
    """Nothing extends beyond the screen; what a finger taps has 44 px at least."""
    browser.open(page, 390, 844, phone=True)
    targets = """[...document.querySelectorAll('button, select, summary, label, ' +
        'input[type=range], input[type=search], input[type=text], .crops figure')]
        .filter(e => e.offsetParent).map(e => [e.id || e.textContent,
        ...(r => [r.left, r.right, r.width, r.height])(e.getBoundingClientRect())])"""
    found = []
    for action in (
        "goTo(3); $('show').open = true; $('classes').open = true",
        "$('show').open = false; select(here[1]); edit(edits.rename(here[1], 'box'));"
        "document.querySelector('#panel details').open = true",
        "[...document.querySelectorAll('#panel button')]"
        ".find(b => b.textContent.startsWith('Rename')).click()",
        "$('help').showModal()",
    ):
        browser.eval(action)
        found += browser.eval(targets)
        assert browser.eval("document.documentElement.scrollWidth") <= 390
    assert len(found) > 60
    for name, left, right, width, height in found:
        assert left >= 0 and right <= 390 and min(width, height) >= 43.9, name
    assert browser.errors == []


def test_selecting_a_component_updates_everything(
    browser: Browser, broken_walk_folder: Path
) -> None:
    browser.open(broken_walk_folder / "scene.html")
    rows = "[...document.querySelectorAll('.row b')].map(b => +b.textContent.split(' ').at(-1))"
    shown = (
        "[solid.map(o => o.id), steps.length, posed.length, +$('slider').max, "
        "cloud.geometry.attributes.position.count]"
    )
    name = broken_walk_folder.parent.name
    assert browser.eval("document.title") == f"{name}: 6 objects with a shape in 2 components"
    assert browser.eval(rows) == [1, 2, 3]
    assert browser.eval(shown) == [[1, 2, 3], 40, 38, 39, 3]
    before = browser.eval("[level.size, room.radius]")
    browser.eval("select(solid[0]); goTo(20); $('part').value = 1; $('part').onchange()")
    browser.settle()
    assert browser.eval(rows) == [4, 5, 6]
    assert browser.eval(shown) == [[4, 5, 6], 24, 23, 23, 3]
    assert browser.eval("[state.step, state.selected, $('panel').innerHTML]") == [-1, None, ""]
    assert browser.eval("$('facts').textContent").startswith("cameras of 23 of 24 frames")
    after = browser.eval("[level.size, room.radius]")
    assert 4 < before[0] / after[0] < 9  # 3 units a metre instead of .5
    assert 0.4 < before[1] / after[1] < 2.5  # metres both
    solid = browser.eval("solid[1].center")
    np.testing.assert_allclose(solid, into_component(1, np.array([[0, 0.1, 0.41]]))[0], atol=0.1)
    browser.eval("$('slider').value = 23; $('slider').oninput()")
    assert browser.eval("[state.step, $('clock').textContent]") == [63, "frame 63"]
    browser.eval("goTo(3)")  # of the other component
    assert browser.eval(f"[+$('part').value, +$('slider').value, {rows}]") == [0, 3, [1, 2, 3]]
    assert browser.errors == []


def test_a_turn_shows_directions_on_a_phone(browser: Browser, tmp_path: Path) -> None:
    result = finished(unlinked(*turn()))
    scene.write_scene(result, Pictures(result, VIDEO), tmp_path / "scene.html", VIDEO)
    browser.open(tmp_path / "scene.html", 390, 844, phone=True)
    assert 10 < browser.eval("$('grade').getBoundingClientRect().height") < 20  # one line
    assert browser.eval("$('grade').innerText").startswith("directions only: sizes and distances")
    browser.eval("select(here[0])")
    text = " ".join(browser.eval("$('panel').innerText").split())
    seen = r"angular size 1[\d.]+° direction 1\d° left of the first view, \d+° down"
    assert re.search(seen, text)
    assert re.search(r"distance ≈ [34][.\d]+ m, guessed from the category", text)
    assert browser.errors == []


def test_a_2d_result_opens(browser: Browser, tmp_path: Path) -> None:
    """No cameras: images and a timeline, and the reason."""
    browser.open(write_page(tmp_path / "flat", in_3d=False))
    assert "No 3D view: no camera poses" in browser.eval("$('why').innerText")
    browser.eval("here[1].row.click(); goTo(3)")
    browser.settle()
    assert browser.eval("document.querySelectorAll('.crops img').length") == 8
    assert browser.eval("here[1].row.querySelectorAll('.bar span:not(.head)').length") == 1
    assert "tracked" in browser.eval("$('panel').innerText") and browser.errors == []


def test_without_webgl_the_list_remains(browser: Browser, page: Path) -> None:
    browser.open(page, script="HTMLCanvasElement.prototype.getContext = () => null")
    assert "no WebGL" in browser.eval("$('why').innerText")
    browser.eval("here[1].row.click()")
    assert "width" in browser.eval("$('panel').innerText") and browser.errors == []


# ---- Changes since a map ----

EIGHTH_TURN = np.array([np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)])


def changes_of_walk(objects: list[rt.Object]) -> Changes:
    """The chair moved, the second object stayed, the suitcase is new, two of the map are absent."""
    chair, second, suitcase = objects[:3]
    shape = Shape("box", chair.half_axes, EIGHTH_TURN)
    lamp = Shape("cylinder", np.array([0.2, 0.2, 0.5]), np.array([1.0, 0, 0, 0]))
    return Changes(
        "flat.map", "tuesday", "", 20, 24, sigma_m=0.01,
        stayed=(Change(2, second.class_name, second.center, second.center, 0.0, 0.02),),
        moved=(Change(1, "chair", chair.center + np.array([0, 1.0, 0]), chair.center, 1.0, 0.034,
                      "12 own points agree", (9,), shape),),
        gone=(Change(9, EVIL, np.array([1.0, 1.0, 0.5]), None, evidence="seen through in 3 views",
                     before_shape=lamp),),
        new=(Change(3, "suitcase", None, suitcase.center),),
        not_seen=(Change(7, "bowl", np.array([-1.0, 1.0, 0.5]), None, before_shape=lamp),),
    )  # fmt: skip


def page_with(page: Path, name: str, **more: Any) -> Path:
    """The page of the small scene with changes or other recordings."""
    out = page.parent.parent / name
    out.mkdir()
    result = dataclasses.replace(rt.Result.load(page.parent), **more)
    write_pictures(result, out, rt.Video(page.parent.parent / "frames"), overlay=False)
    return out / "scene.html"


@pytest.fixture(scope="module")
def changed_page(page: Path) -> Path:
    """The page of the small scene after a run with a map."""
    changes = changes_of_walk(rt.Result.load(page.parent).objects)
    return page_with(page, "changed", changes=changes)


def test_an_arrow_leads_from_the_ghost_to_the_moved_object(
    browser: Browser, changed_page: Path
) -> None:
    """Ghost: the former shape at the former place; the tip of the arrow is the present centre."""
    browser.open(changed_page)
    moved = browser.eval("""(g => ({ at: g.at, to: g.object.at, shown: g.group.visible,
        dashed: g.group.parts.wire.material.dashed,
        matrix: g.group.matrix.elements, arrow: g.arrow.map(n => n.visible),
        start: [...g.arrow[0].geometry.attributes.instanceStart.array],
        tip: new THREE.Vector3(0, .5, 0).applyMatrix4(g.arrow[1].matrix).toArray() }))
        (ghosts.find(g => g.kind === "moved"))""")
    distance = np.linalg.norm(np.subtract(moved["at"], moved["to"]))
    assert distance == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(moved["start"][:3], moved["at"], atol=1e-5)
    np.testing.assert_allclose(moved["tip"], moved["to"], atol=1e-5)
    assert moved["shown"] and moved["dashed"] and moved["arrow"] == [True] * 2
    half = data_of(changed_page)["objects"][0]["half_axes"]
    columns = np.array(moved["matrix"]).reshape(4, 4)[:3, :3]
    np.testing.assert_allclose(np.linalg.norm(columns, axis=1), half, rtol=1e-5)
    turned = columns[0] @ browser.eval("level.turn([Math.SQRT1_2, Math.SQRT1_2, 0])")
    assert turned == pytest.approx(half[0], rel=1e-5)  # the former rotation, 45 degrees
    browser.eval("edit(edits.merge(objects[0], objects[1]))")
    assert browser.eval("ghosts.map(g => [g.id, g.object?.id ?? null, g.arrow.length])") == [
        [1, 1, 2], [9, None, 0], [7, None, 0]
    ]  # fmt: skip
    browser.eval("undo(); edit(edits.delete(objects[0]))")
    assert browser.eval("ghosts.map(g => g.id)") == [9, 7] and browser.errors == []


def test_the_list_shows_and_filters_changes(browser: Browser, changed_page: Path) -> None:
    browser.open(changed_page)
    rows = """[...document.querySelectorAll('.row')].filter(r => !r.hidden)
        .map(r => [+r.querySelector('b').textContent.split(' ').at(-1),
                   r.querySelector('.kind')?.textContent || ''])"""
    every = [[1, "moved 1.00 m"], [9, "gone"], [3, "new"], [2, ""], [4, ""]]
    assert browser.eval(rows) == every
    assert browser.eval("$('since').innerText") == (
        f"map flat.map: 1 stayed, 1 moved (chair 1 by 1.00 m), 1 gone ({EVIL} 9), "
        "1 new (suitcase 3), 1 not seen"
    )
    visible = "[solid, ghosts].map(list => list.filter(o => o.group.visible).map(o => o.id))"
    assert browser.eval(visible) == [[1, 2, 3], [1, 9]]
    for kind, shown in (
        ("stayed", [[1, 3], [1, 9]]), ("not seen", [[1, 3], [1, 9, 7]]),
        ("moved", [[3], [9, 7]]), ("gone", [[3], [7]]),
    ):  # fmt: skip
        box = f"l => l.innerText.startsWith('{kind}')).querySelector('input')"
        browser.eval(f"[...document.querySelectorAll('#kinds label')].find({box}.click()")
        browser.settle()
        assert browser.eval(visible) == shown, kind
    browser.eval("$('changes').click()")
    browser.settle()  # off: like a page without a map
    assert browser.eval(rows) == [[1, ""], [3, ""], [2, ""], [4, ""]]
    assert browser.eval(visible) == [[1, 2, 3], []] and browser.errors == []


@pytest.fixture(scope="module")
def page_with_sessions(page: Path) -> Path:
    """The page of the small scene on Friday: the map has Monday and Tuesday.

    The lamp, 9, was there on both days; the chair, 1, moved on Tuesday and again on Friday.
    """
    result = rt.Result.load(page.parent)
    chair, second = result.objects[:2]
    changes = changes_of_walk(result.objects)
    (lamp,) = changes.gone
    gone = dataclasses.replace(
        chair, id=9, class_name=EVIL, center=lamp.before, support="cylinder", size=np.full(3, 0.4)
    )
    start = dataclasses.replace(chair, center=chair.center + np.array([0, 2.0, 0]))
    middle = dataclasses.replace(chair, center=changes.moved[0].before)
    shape = Shape("box", chair.half_axes, chair.quat_wxyz)
    move = Change(1, "chair", start.center, middle.center, 1.0, before_shape=shape)
    tuesday = Changes("flat.map", "tuesday", stayed=(Change(2, EVIL),), moved=(move,))
    red, green = (
        cv2.imencode(".jpg", np.full((40, 60, 3), color, np.uint8))[1].tobytes()
        for color in ((0, 0, 255), (0, 255, 0))
    )
    times = ("2026-03-02T10:15:20+00:00", "2026-03-03T11:30:00+00:00")
    earlier = (
        EarlierSession("monday", times[0], (start, second, gone), None, {1: red, 9: red}),
        EarlierSession("tuesday", times[1], (middle, second, gone), tuesday, {1: green}),
    )
    return page_with(page, "sessions", changes=changes, earlier=earlier)


def test_other_recordings_are_shown(browser: Browser, page_with_sessions: Path) -> None:
    """Their objects, changes and pictures; corrections are those of this recording."""
    browser.open(page_with_sessions)
    switch = "(value => {{ $('session').value = value; $('session').onchange(); }})({})"
    options = browser.eval("[...$('session').options].map(o => o.text)")
    assert options == ["this recording: tuesday", "monday, 2026-03-02 10:15",
                       "tuesday, 2026-03-03 11:30"]  # fmt: skip
    sessions = data_of(page_with_sessions)["earlier"]
    pair = "[...document.querySelectorAll('.pair img')].map(i => i.src.split(',')[1])"
    browser.eval("select(here[0])")
    before, after = browser.eval(pair)
    assert before == sessions[1]["pictures"]["1"]  # Tuesday's
    chair = data_of(page_with_sessions)["objects"][0]
    assert [chair["best"], after] in chair["crops"]
    browser.eval("selectGhost(ghosts.find(g => g.kind === 'gone'))")
    assert browser.eval(pair) == [sessions[0]["pictures"]["9"]]
    here = """(draw(), [solid.map(o => [o.id, o.group.visible]), ghosts.map(g => [g.id, g.kind]),
        [...document.querySelectorAll('.row')].filter(r => !r.hidden).length])"""
    now = browser.eval(here)
    gap = "(([a, b]) => Math.hypot(...add(a, b, -1)))([solid[0].at, {}])"
    browser.eval("window.chair = solid[0].at")
    browser.eval(switch.format(0))  # Monday: no changes, the lamp, no suitcase
    assert browser.eval(here) == [[[1, True], [2, True], [9, True]], [], 3]
    assert browser.eval(gap.format("chair")) == pytest.approx(2, abs=1e-5)
    assert "First recording of the map: 3" in browser.eval("$('since').innerText")
    browser.eval("select(solid[0])")
    text = browser.eval("$('panel').innerText")
    assert "2.00 m from here" in text and "Correct it" not in text and "Visits" not in text
    browser.press("Delete")
    assert browser.eval("[pending.length, solid.length]") == [0, 3]
    browser.eval(switch.format(1))  # Tuesday: the chair moved, with an arrow from Monday's place
    assert browser.eval(here)[1] == [[1, "moved"]]
    assert browser.eval(gap.format("ghosts[0].at")) == pytest.approx(1, abs=1e-5)
    browser.press("Escape")
    browser.eval(switch.format(-1))
    assert browser.eval(here) == now and browser.eval(gap.format("chair")) == 0
    assert browser.eval("window.hacked") is None and browser.errors == []


def test_the_best_pictures_show_the_objects(tmp_path: Path) -> None:
    """Of the largest box in the video, with a margin; only of objects with a shape."""
    poses = poses_of_walk()
    tracks = tracks_of_walk(poses)
    row = np.flatnonzero(tracks.track_id == 3)[7]
    tracks.xyxy[row] = [20, 20, 300, 220]
    for i in range(FRAMES):
        image = np.full((HEIGHT, WIDTH, 3), (255, 0, 0), np.uint8)
        image[20:220, 20:300] = (0, 255, 0) if i == tracks.frame[row] else (0, 0, 255)
        cv2.imwrite(str(tmp_path / f"{i:02d}.png"), image)
    result = fitted(tracks, poses, names=NAMES)
    found = best_pictures(result, rt.Video(tmp_path), Progress("pictures"))
    assert sorted(found) == [o.id for o in result.located]
    crop = cv2.imdecode(np.frombuffer(found[3], np.uint8), cv2.IMREAD_COLOR)
    assert max(crop.shape) == 160
    assert crop[40:-40, 40:-40].mean((0, 1)) == pytest.approx([0, 255, 0], abs=9)


# ---- Without a browser ----


def test_same_input_gives_the_same_page(page: Path, tmp_path: Path) -> None:
    assert write_page(tmp_path / "a").read_bytes() == page.read_bytes()


def test_the_page_is_complete_and_escaped(page: Path) -> None:
    """Strict JSON without "<", no address besides names of XML, the licence of three.js."""
    text = page.read_text()
    assert EVIL not in text and text.count("</script>") == text.count("<script") == 4
    data = text.split('id="data">')[1].split("</script>")[0]
    assert json.loads(data, parse_constant=pytest.fail)["objects"][1]["class"] == EVIL
    hosts = set(re.findall(r"https?://([\w.]+)", text))
    assert hosts == {"www.w3.org"} and "default-src 'none'" in text
    folder = Path(scene.__file__).with_name("page")
    licence = (folder / "three.LICENSE.txt").read_text().strip()
    assert "Permission is hereby granted" in licence and licence in text
    assert len(page_text()) < 7e5 and "@{" not in text


def test_the_page_contains_the_scene(page: Path) -> None:
    data, poses = data_of(page), poses_of_walk()
    found = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(-1, 3, 4)
    np.testing.assert_allclose(found, invert_rigid(poses.cam_from_world), atol=1e-6)
    (component,) = data["parts"]
    points = np.frombuffer(base64.b64decode(component["points"]), "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, poses.points, atol=1e-6)
    assert data["objects"][1]["seen"] == [0, 8, 15, 23] and component["up"] == [0, 0, 1]
    assert [tuple(o["color"]) for o in data["objects"]] == [
        object_color(i)[::-1] for i in (1, 2, 3, 4)
    ]
    assert component["facts"] == "cameras of 23 of 24 frames · scale from poses, ± 0 %"
    assert data["steps"] == {
        "frame": list(range(24)), "seconds": pytest.approx(1 / 30), "part": [0] * 24,
        "time": pytest.approx(np.arange(24) / 30, abs=1e-4), "frame_s": pytest.approx(1 / 30),
    }  # fmt: skip
    cov = np.frombuffer(base64.b64decode(data["objects"][0]["cov"]), "<f4").reshape(9, 9)
    assert (np.diag(cov) > 0).all() and data["objects"][3]["cov"] == data["why_flat"] == ""
    assert data["camera"] == {"width": 320, "height": 240, "fx": 250, "fy": 250,
                              "cx": 170, "cy": 112, "lens": None}  # fmt: skip
    assert 0.02 < component["point_sigma"] < 0.1
    assert "floor" not in component  # too few points for a floor


def test_crops_show_the_object(tmp_path: Path) -> None:
    """Crops and frames of a video that is read at half its size: the green box is centred."""
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


def test_crops_show_different_views() -> None:
    """The selected views of an object are spread over time and directions."""
    poses = poses_of_walk()
    tracks = tracks_of_walk(poses)
    found = rt.Object(3, "suitcase", 1.0, "ok", "", center=np.array(CENTERS[2]))
    frames = np.sort(tracks.frame[diverse_rows(tracks, found, poses, 4)])
    assert len(frames) == 4 and np.diff(frames).min() >= 4 and 5 not in frames
    assert set(tracks.track_id[diverse_rows(tracks, found, None, 30)]) == {3}


def test_background_frames_are_undistorted(tmp_path: Path) -> None:
    """A distorted line is straight again, at the projection of the viewer's pinhole camera."""
    lens = rt.Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (250.0, WIDTH / 2, HEIGHT / 2, -0.15))
    y = np.linspace(20, HEIGHT - 20, 400)
    line = np.column_stack([np.full(400, 60.0), y])  # of the pinhole
    rays = np.column_stack([(line - [WIDTH / 2, HEIGHT / 2]) / 250, np.ones(400)])
    bent = np.asarray(lens.to_pycolmap().img_from_cam(rays)).reshape(-1, 2)
    assert (bent[:, 0] > 62).all()
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    path = (bent[:, None] * 16 - 8).round().astype(int)
    cv2.polylines(image, [path], False, (255, 255, 255), 3, cv2.LINE_AA, 4)
    poses = dataclasses.replace(poses_of_walk(), camera=lens)
    result = rt.Result(tracks_of_walk(poses_of_walk()), NAMES, VideoInfo("a", WIDTH, HEIGHT, 25.0))
    result = dataclasses.replace(result, poses=poses)
    pictures = Pictures(result, VIDEO)
    pictures.take(rt.Frame(0, 0.0, image))
    ((_, text),) = pictures.frames
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_GRAYSCALE)
    rows = shown[30:-30].astype(float)
    found = (rows * (np.arange(WIDTH) + 0.5)).sum(1) / rows.sum(1)
    np.testing.assert_allclose(found, 60, atol=0.7)
