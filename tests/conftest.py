"""Results that several test files read: computed once a session, never changed."""

from __future__ import annotations

from pathlib import Path

import pytest
from simulated import fitted, tracks_of, walk

import reobj_track as rt

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
CAMERA = "492.756788421,492.756788421,320,240"  # of examples/room/camera.txt
FEW = ("--every", 3, "--stop", 120)  # frames of the example room that are enough for files


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder: every third frame of the first half of the example room, true cameras."""
    out = tmp_path_factory.mktemp("room") / "out"
    args = ("--detections", ROOM / "detections.npz", "--poses", ROOM / "poses.txt")
    off = ("--set", "output.overlay=0", "--set", "output.scene=0")
    args = ("run", ROOM / "room.mp4", "-o", out, *args, "--camera", CAMERA, *FEW, *off)
    assert rt.main([str(a) for a in args]) == 0
    return out


@pytest.fixture(scope="session")
def chairs() -> rt.Result:
    """Three simulated chairs, fitted; not saved. Copy it before you change it."""
    poses = walk()
    return fitted(tracks_of(poses), poses)
