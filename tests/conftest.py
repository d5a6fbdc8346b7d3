"""Fixtures shared by several test files: computed once per session, read-only."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, FLAGS, Browser
from front_door.room import CAMERA, FEW, ROOM
from simulated import SIZE, finished, fitted, tracks_of, unlinked, walk

import reobj_track as rt
from reobj.files import locked
from reobj.results.workspace import Workspace

try:
    from hypothesis import settings
except ImportError:  # test_properties.py is skipped then
    pass
else:  # the same cases each time, within a minute; `--hypothesis-profile long` tries new ones
    settings.register_profile("ci", max_examples=25, deadline=None, derandomize=True, database=None)
    settings.register_profile("long", max_examples=2000, deadline=None, database=None)
    settings.load_profile("ci")

os.environ["REOBJ_RAISE"] = "1"  # an internal error while drawing fails the test


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --slow: without it, tests marked `slow` (more than some seconds each) are skipped."""
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip the slow tests without --slow."""
    if not config.getoption("--slow"):
        for item in items:
            if item.get_closest_marker("slow"):
                item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


@pytest.fixture
def no_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Supplied poses get no triangulated points, so that no child process is started."""
    monkeypatch.setattr("reobj.poses.stage.triangulate", lambda poses, *_, **__: poses)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One page of the system's Chromium."""
    api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    with api.sync_playwright() as playwright:
        yield Browser(playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS))


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder: every third frame of the first half of the example room, true cameras.

    Made by one worker for all of them. Copy it before you change it.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "room"
    folder.mkdir(exist_ok=True)
    with locked(folder / "lock", wait_s=600):
        if not (folder / "done").exists():
            make_room(folder / "out")
            (folder / "done").touch()
    return folder / "out"


def make_room(out: Path) -> None:
    args = ("--detections", ROOM / "detections.npz", "--poses", ROOM / "poses.txt")
    off = ("--set", "output.overlay=0", "--set", "output.scene=0")
    args = ("run", ROOM / "room.mp4", "-o", out, *args, "--camera", CAMERA, *FEW, *off)
    assert rt.main([str(a) for a in args]) == 0


@pytest.fixture(scope="session")
def chairs() -> rt.Result:
    """Three simulated chairs, fitted; not saved. Copy it before you change it."""
    poses = walk()
    return fitted(tracks_of(poses), poses)


@pytest.fixture(scope="session")
def broken_walk() -> rt.Result:
    """The chairs with a trajectory in two components; not saved. Copy it before you change it."""
    return finished(unlinked())


@pytest.fixture(scope="session")
def broken_walk_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of the two components with all its files, as `objects` writes them."""
    top = tmp_path_factory.mktemp("components")
    (top / "frames").mkdir()
    for i in range(64):
        image = np.full((SIZE[1], SIZE[0], 3), (60, 60 + 2 * i, 60), np.uint8)
        cv2.imwrite(str(top / f"frames/{i:03d}.jpg"), image)
    workspace, given = Workspace(top / "out"), unlinked()
    workspace.bind(rt.Video(top / "frames"))
    workspace.save_last(given, given.poses)
    assert rt.main(["objects", str(workspace.out)]) == 0
    return workspace.out
