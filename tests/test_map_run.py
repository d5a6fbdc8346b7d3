"""`run` with a map: pictures of its objects, more images, recordings without images."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import invert_rigid
from reobj.maps import stage

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
CAMERA = "492.7568,492.7568,320,240"


def options(start: int, stop: int, **poses: str) -> rt.Config:
    """Few frames, no embeddings, no pictures."""
    return rt.Config(
        input=rt.InputConfig(every=8, start=start, stop=stop),
        embed=rt.EmbedConfig(model="none"),
        poses=rt.PosesConfig(camera=CAMERA, **poses),
        output=rt.OutputConfig(overlay="none", scene=False),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, rt.Result]:
    """A map of ten frames with supplied poses, and the result of that run."""
    folder = tmp_path_factory.mktemp("made")
    path = folder / "flat.map"
    config = options(0, 80, mode=str(ROOM / "poses.txt"))
    config = dataclasses.replace(config, map=rt.MapConfig(pictures=True))
    detections = ROOM / "detections.npz"
    return path, rt.run(ROOM / "room.mp4", folder / "a", config, detections=detections, map=path)


def test_the_map_has_pictures_on_request(made):
    """One of each object, as the option of the configuration says."""
    path, first = made
    objects = rt.RoomMap.load(path).objects
    assert [o.id for o in objects] == [o.id for o in first.located] and len(objects) > 5
    for found in objects:
        jpeg = np.frombuffer(found.observations[0].picture, np.uint8)
        assert max(cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape) <= 160


def true_poses(frames: np.ndarray) -> np.ndarray:
    """cam_from_world (n, 3, 4) of frames of the example clip."""
    rows = np.loadtxt(ROOM / "poses.txt")[frames]
    rotation = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return invert_rigid(np.concatenate([rotation, rows[:, 1:4, None]], 2))


def test_images_between_keyframes_place_a_recording(made):
    """One keyframe alone is too few."""
    path, _ = made
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(start=12, stop=24))
    truth = true_poses(np.arange(12, 24))
    supplied = rt.Poses(
        rt.Camera("PINHOLE", *video.size, tuple(map(float, CAMERA.split(",")))),
        np.arange(12, 24), np.arange(12, 24) / 12, truth, np.full(12, "user"), "user",
        points=np.zeros((1, 3)), visibility=np.zeros((1, 2), np.int64),
    )  # fmt: skip
    room = rt.RoomMap.load(path)
    placed = stage.place_recording(stage.OpenMap(path, room, True), supplied, video)
    assert placed.placement.refused == "" and len(placed.features) == 12
    centre, expected = (invert_rigid(p)[:, :, 3] for p in (placed.poses.cam_from_world, truth))
    assert np.linalg.norm(centre - expected, axis=1).max() < 0.03  # m


def test_a_recording_without_images_is_not_placed(made, tmp_path):
    """Its boxes and poses are used as without a map."""
    path, _ = made
    before = path.read_bytes()
    config = options(0, 80, mode=str(ROOM / "poses.txt"))
    result = rt.run(None, tmp_path, config, detections=ROOM / "detections.npz", map=path)
    assert result.changes.refused == "a recording without images cannot be placed in a map"
    assert result.located and path.read_bytes() == before
