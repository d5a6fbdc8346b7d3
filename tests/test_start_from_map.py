"""A tracker that starts from a map: known numbers from the first frames on."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from map_worlds import a_map, a_session, observed
from simulated import CAMERA, SIZE, walk

import quadrics
import reobj_track as rt
from reobj.cameras import quat_wxyz_from_matrix
from reobj.maps.fusion import class_ids
from reobj.types import Embeddings

NAMES = ("chair", "cup", "book", "bottle")
COUNT = 14
FIRST = 5  # numbers of the objects: 5, 7, 9, ...; another order than that of the rows


class Looks:
    """An embedder of objects with known appearance: the name in `frame[0, d]` is the object."""

    def __init__(self, table: np.ndarray, key: str = "net") -> None:
        self.table = table
        self.key = key

    def __call__(self, frame, detections, rows):
        shown = self.table[frame[0, rows, 0]]
        return Embeddings(shown[:, :32].astype(np.float32), shown[:, 32:].astype(np.float32))


@dataclasses.dataclass
class World:
    """Boxes on a floor: solids, classes (COUNT,), and unit embeddings (COUNT + 4, 64)."""

    solids: quadrics.Ellipsoids
    classes: np.ndarray
    looks: np.ndarray

    def room(self, objects: int = COUNT, **last: object) -> rt.RoomMap:
        """A map of the first objects; `last`: fields of a second observation of the first one."""
        rows = []
        for k in range(objects):
            shape = {
                "support": "ellipsoid", "center": self.solids.center_in_world[k],
                "half_axes": self.solids.half_axes[k],
                "quat_wxyz": quat_wxyz_from_matrix(self.solids.world_from_obj[k : k + 1])[0],
            }  # fmt: skip
            sigma = np.array([0.02] * 3 + [0.05] * 6)
            rows.append([observed(
                1, "new", shape, sigma=sigma, classes={NAMES[self.classes[k]]: 5.0}, embedded=6,
                foreground=self.looks[k, :32].astype(np.float32),
                background=self.looks[k, 32:].astype(np.float32),
            )])  # fmt: skip
        if last:
            rows[0].append(dataclasses.replace(rows[0][0], session=2, **last))
        made = a_map(rows, sessions=(a_session(1), a_session(2)), next_session=3)
        numbered = tuple(
            dataclasses.replace(o, id=FIRST + 2 * k) for k, o in enumerate(made.objects)
        )
        return dataclasses.replace(made, objects=numbered, next_id=100)

    def seen(self, cam_from_world: np.ndarray, rng: np.random.Generator):
        """Noisy boxes of the objects in view, their rows, and an image that names them."""
        boxes = quadrics.solid_boxes(self.solids, "ellipsoid", (CAMERA.K @ cam_from_world)[None])[0]
        inside = (boxes[:, :2] > 2).all(1) & (boxes[:, 2:] < np.array(SIZE) - 2).all(1)
        rows = np.flatnonzero(inside)
        xyxy = boxes[rows] + rng.normal(0, 1.0, (len(rows), 4))
        image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        image[0, : len(rows), 0] = rows
        return rt.Detections(xyxy, np.full(len(rows), 0.9), self.classes[rows]), rows, image


def world(seed: int = 0) -> World:
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.08, 0.2, (COUNT, 3))
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(3)), -1).reshape(-1, 2)[:COUNT]
    center = np.column_stack(
        [(grid - [2, 1]) * 0.55 + rng.uniform(-0.1, 0.1, (COUNT, 2)), half[:, 2]]
    )
    looks = rng.normal(size=(COUNT + 4, 64))
    for part in (slice(32), slice(32, None)):
        looks[:, part] /= np.linalg.norm(looks[:, part], axis=1, keepdims=True)
    turn = np.tile(np.eye(3), (COUNT, 1, 1))
    return World(quadrics.Ellipsoids(center, half, turn), np.arange(COUNT) % 4, looks)


CONFIG = rt.TrackerConfig(camera_motion=False)


def numbers_of_frames(tracker, scene, poses, given=None, embed=False, seed=1):
    """Track; return (object, number) of every detection, by frame. given: poses given instead."""
    rng = np.random.default_rng(seed)
    found = []
    for k, pose in enumerate(poses.cam_from_world):
        detections, rows, image = scene.seen(pose, rng)
        known = {} if given is None else {"cam_from_world": given[k], "camera": CAMERA}
        tracks = tracker.update(detections, image if embed else None, **known)
        found.append(
            (len(rows), [*zip(rows[tracks.detection_index], tracks.track_id, strict=True)])
        )
    return found


def test_known_numbers_from_the_first_frame_on():
    scene = world()
    poses = walk(20, 60.0)
    tracker = rt.Tracker(CONFIG)
    tracker.start_from(scene.room(COUNT - 2), NAMES)
    frames = numbers_of_frames(tracker, scene, poses, poses.cam_from_world)
    number = FIRST + 2 * np.arange(COUNT)
    number[COUNT - 2 :] = -1  # not in the map
    for count, pairs in (frames[0], frames[5], frames[-1]):
        old = [(obj, i) for obj, i in pairs if number[obj] > 0]
        assert count > 8 and len(pairs) > 0.9 * count
        assert np.mean([i == number[obj] for obj, i in old]) >= 0.9
    new = {i for _, pairs in frames for obj, i in pairs if number[obj] < 0}
    assert len(new) == 2 and min(new) >= 100
    given = {i for _, pairs in frames for _, i in pairs}
    assert {i for i in given if i < 100} <= set(number.tolist())


def test_poses_of_another_world_give_no_numbers():
    scene = world()
    poses = walk(20, 60.0)
    turned = poses.cam_from_world.copy()
    a = 0.5  # the session's world: turned and shifted against that of the map
    other = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    turned[:, :, :3] = poses.cam_from_world[:, :, :3] @ other
    turned[:, :, 3] += poses.cam_from_world[:, :, :3] @ np.array([0.6, -0.4, 0.1])
    tracker = rt.Tracker(CONFIG)
    tracker.start_from(scene.room(), NAMES)
    frames = numbers_of_frames(tracker, scene, poses, turned)
    numbers = {i for _, pairs in frames for _, i in pairs}
    assert len(numbers) > 8 and min(numbers) >= 100


def test_without_poses_the_appearance_decides():
    scene = world()
    poses = walk(12, 40.0)
    kept = {}
    for key in ("net", "another"):  # the map's sessions used "net"
        tracker = rt.Tracker(CONFIG, Looks(scene.looks, key))
        tracker.start_from(scene.room(), NAMES)
        (_, pairs), *_ = numbers_of_frames(tracker, scene, poses, embed=True)
        kept[key] = np.mean([i == FIRST + 2 * obj for obj, i in pairs])
    assert kept["net"] >= 0.9 and kept["another"] == 0


def test_deleted_objects_are_left_out_and_gone_ones_have_no_position():
    scene = world()
    poses = walk(3, 20.0)
    gone = scene.room(status="gone", support="")
    gone_state = rt.Tracker(CONFIG)
    gone_state.start_from(gone, NAMES)
    assert gone_state.state.numbers[0] == FIRST and not gone_state.ellipsoid_map.known[0]
    assert gone_state.ellipsoid_map.known[1:COUNT].all()
    deleted = scene.room()
    first = dataclasses.replace(deleted.objects[0], deleted=True)
    deleted = dataclasses.replace(deleted, objects=(first, *deleted.objects[1:]))
    tracker = rt.Tracker(CONFIG)
    tracker.start_from(deleted, NAMES)
    frames = numbers_of_frames(tracker, scene, poses, poses.cam_from_world)
    assert FIRST not in {i for _, pairs in frames for _, i in pairs}


def test_a_map_is_given_before_the_first_frame():
    scene = world()
    tracker = rt.Tracker(CONFIG)
    tracker.update(rt.Detections.empty())
    with pytest.raises(rt.ReobjError, match="call it first"):
        tracker.start_from(scene.room(), NAMES)
    tracker.reset()
    tracker.start_from(scene.room(), NAMES)
    tracker.start_from(rt.RoomMap())
    assert tracker.state.next_number == 1 and not len(tracker.state.numbers)


def test_classes_of_a_map_are_those_of_the_detector() -> None:
    """By name, else by a synonym; a less likely class where the detector lacks the first one."""
    names = ("chair", "couch", "tv", "monitor")
    classes = [("Sofa", {"sofa": 2.0}), ("monitor", {"monitor": 1.0}), ("screen", {"screen": 1.0}),
               ("lamp", {"lamp": 5.0, "chair": 1.0}), ("lamp", {"lamp": 1.0})]  # fmt: skip
    states = [SimpleNamespace(class_name=name, classes=of) for name, of in classes]
    assert class_ids(states, names).tolist() == [1, 3, 2, 0, -1]
