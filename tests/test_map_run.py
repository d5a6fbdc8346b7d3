"""`run` with a map: numbers of the next recording, and photos located in the map one by one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reobj_track as rt
from reobj.cameras import Camera, Poses, invert_rigid
from reobj.files import Progress
from reobj.maps import stage
from reobj.maps.placement import PlacementOptions, keyframe_features
from reobj.maps.single_frames import locate_frames, locate_rest

ROOM = Path(__file__).resolve().parent.parent / "examples" / "room"
CAMERA = "492.7568,492.7568,320,240"
PHOTOS = (21, 42, 63)  # frames of the example clip; the map is made from others


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


def test_photos_that_cannot_be_reconstructed_are_located_in_the_map(made, tmp_path):
    path, first = made
    folder = tmp_path / "photos"
    folder.mkdir()
    for frame in rt.Video(ROOM / "room.mp4", rt.InputConfig(stop=64)):
        if frame.index in PHOTOS:
            cv2.imwrite(str(folder / f"{PHOTOS.index(frame.index)}.png"), frame.image)
    with np.load(ROOM / "detections.npz") as file:
        rows = np.isin(file["frame"], PHOTOS)
        given = {k: file[k][rows] for k in ("xyxy", "score", "class_id")}
        given["frame"] = np.searchsorted(PHOTOS, file["frame"][rows])
        whole = {k: file[k] for k in ("image_size", "class_names")}
    np.savez(tmp_path / "photos.npz", **given, **whole)
    config = dataclasses.replace(options(0, 0), input=rt.InputConfig())
    found = rt.run(
        folder, tmp_path / "out", config, detections=tmp_path / "photos.npz", map=path,
        map_frozen=True,
    )  # fmt: skip
    poses = found.poses
    assert poses.source == "map" and poses.status.tolist() == ["pnp"] * 3
    text = "the recording alone could not be reconstructed: 3 of 3 images were located in the map"
    assert any(w.startswith(text) for w in found.warnings)
    centre = invert_rigid(poses.cam_from_world)[:, :, 3]
    truth = invert_rigid(true_poses(np.array(PHOTOS)))[:, :, 3]
    assert np.linalg.norm(centre - truth, axis=1).max() < 0.05  # m
    classes = {o.id: o.class_name for o in first.located}
    assert len(found.changes.stayed) >= 3 and not found.changes.gone
    assert all(classes[c.id] == c.class_name for c in found.changes.stayed)


def test_frames_between_located_images_are_located_too(made):
    path, _ = made
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(start=10, stop=36))
    frame = np.arange(10, 36)
    size = video.size
    guess = Camera("SIMPLE_PINHOLE", *size, (700.0, size[0] / 2, size[1] / 2))
    none = np.full((len(frame), 3, 4), np.nan)
    poses = Poses(guess, frame, frame / 12, none, np.full(len(frame), "none"), "none")
    features = keyframe_features(poses, video, PlacementOptions(), Progress("features", 0), most=4)
    assert len(features) == 4
    placement = locate_frames(poses, features, rt.RoomMap.load(path).points)
    assert placement.refused == ""
    found = locate_rest(placement, video, Progress("pnp", 0))
    assert found.known[:22].all() and (found.status[:22] == "pnp").all()
    centre = invert_rigid(found.cam_from_world[found.known])[:, :, 3]
    truth = invert_rigid(true_poses(frame[found.known]))[:, :, 3]
    assert np.median(np.linalg.norm(centre - truth, axis=1)) < 0.04  # m
    assert found.camera.params[0] == pytest.approx(492.76, rel=0.02)


def test_images_between_keyframes_place_a_recording(made, monkeypatch):
    """Its keyframes show nothing of the map."""
    path, _ = made
    video = rt.Video(ROOM / "room.mp4", rt.InputConfig(start=12, stop=24))
    truth = true_poses(np.arange(12, 24))
    supplied = Poses(
        Camera("PINHOLE", *video.size, tuple(map(float, CAMERA.split(",")))),
        np.arange(12, 24), np.arange(12, 24) / 12, truth, np.full(12, "user"), "user",
    )  # fmt: skip
    monkeypatch.setattr(stage, "keyframe_rows", lambda *args: np.empty(0, np.int64))
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
